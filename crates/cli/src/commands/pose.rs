//! `vergence pose`: recognise the object of every tag in a pose set, write a BOP results CSV.

pub mod set;
mod table;

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Instant;

use clap::{Args, ValueEnum};
use vergence_imaging::codec;
use vergence_pose::{ObjectPose, Query, Refusal, View, directional, paper};

use crate::failure::Failure;
use crate::out;
use crate::save::{fresh, unwritten};
use set::{Case, Purpose};

/// Recognise objects of known size in a set of pictures (BOP multi-sensor layout).
#[derive(Args)]
pub struct PoseArgs {
    /// Folder of the set: SET/test/<scene>/ with gray_left, gray_right and the JSON files.
    set: PathBuf,
    /// BOP results CSV to write: poses in the left camera's frame, millimetres.
    #[arg(long)]
    out: PathBuf,
    /// How to recognise.
    #[arg(long, value_enum, default_value_t = Method::Directional)]
    method: Method,
    /// Scenes worked on at the same time; the times in the CSV are right only with one.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=set::MOST_THREADS))]
    threads: u16,
    /// Folder for pictures of what was seen: edges, field, best and second-best pose, residuals.
    #[arg(long)]
    save: Option<PathBuf>,
}

/// How to recognise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// The 2005 paper's: Canny, box template, distance transform, correlation.
    Paper,
    /// Directional distance fields, a search over all rotations, refinement, a verdict.
    Directional,
}

impl Method {
    /// Recognises with the method's default settings.
    pub fn recognise(self, views: &[View], query: &Query) -> Result<ObjectPose, Refusal> {
        match self {
            Method::Paper => paper::recognise(views, query, &paper::Config::default()),
            Method::Directional => {
                directional::recognise(views, query, &directional::Config::default())
            }
        }
    }
}

/// What came of one case of the set.
pub struct Outcome {
    /// The scene's number.
    pub scene: u32,
    /// The image's number in the scene.
    pub image: u32,
    /// The object's number in the set.
    pub object: u32,
    /// Pose, or why there is none.
    pub result: Result<ObjectPose, Refusal>,
    /// `base_from_optical` of the left camera.
    pub base_from_left: vergence_geometry::Transform,
    /// Seconds for this object in all pictures of the image, decoding them aside.
    pub seconds: f64,
}

/// Runs the command; `true` when at least one object was answered.
pub fn run(args: PoseArgs) -> Result<bool, Failure> {
    out::check(&args.out)?;
    let pictures = args.save.as_deref().map(Pictures::create).transpose()?;
    let worked = set::each(&args.set, args.threads, Purpose::Answers, |case| {
        Ok(recognise(case, args.method, pictures.as_ref()))
    })?;
    if !worked.results.is_empty() {
        table::write(&args.out, &worked.results)?;
        table::summary(&worked.results, &args.out);
    }
    worked.whole()?;
    pictures.map_or(Ok(()), Pictures::finish)?;
    Ok(worked.results.iter().any(|o| o.result.is_ok()))
}

fn recognise(case: &Case, method: Method, pictures: Option<&Pictures>) -> Outcome {
    let (views, query) = (case.views(), case.query());
    let start = Instant::now();
    let result = method.recognise(&views, &query);
    let seconds = start.elapsed().as_secs_f64();
    if let Some(pictures) = pictures {
        pictures.save(case, &views, &query, method);
    }
    let base_from_left = views[0].base_from_optical;
    let (scene, image, object) = (case.scene, case.image, case.object());
    Outcome { scene, image, object, result, base_from_left, seconds }
}

/// Whether `--save` writes a file of this name: `<scene>[-<image>-<position>]-view...png`.
fn is_ours(name: &str) -> bool {
    let Some((case, _)) = name.strip_suffix(".png").and_then(|stem| stem.split_once("-view"))
    else {
        return false;
    };
    let is_number = |part: &str| part.bytes().all(|b| b.is_ascii_digit());
    let numbers: Vec<&str> = case.split('-').collect();
    matches!(numbers.len(), 1 | 3) && numbers[0].len() >= 6 && numbers.into_iter().all(is_number)
}

/// Pictures of what was seen, in a folder.
struct Pictures {
    folder: PathBuf,
    /// First thing that could not be written; told at the end, the results come first.
    failed: OnceLock<Failure>,
}

impl Pictures {
    fn create(folder: &Path) -> Result<Self, Failure> {
        fresh(folder, is_ours)?;
        Ok(Pictures { folder: folder.into(), failed: OnceLock::new() })
    }

    /// Writes the pictures of one case; the recognition runs once more, so that the time stays pure.
    fn save(&self, case: &Case, views: &[View], query: &Query, method: Method) {
        let pictures = match method {
            Method::Directional => {
                match directional::recognise_traced(views, query, &directional::Config::default()) {
                    Ok((_, trace)) => directional::picture::draw(&trace),
                    Err(_) => Vec::new(),
                }
            }
            Method::Paper => paper::draw(views, query, &paper::Config::default()),
        };
        let of = match case.first {
            true => format!("{:06}", case.scene),
            false => format!("{:06}-{:06}-{}", case.scene, case.image, case.position),
        };
        for (name, canvas) in pictures {
            let path = self.folder.join(format!("{of}-{name}.png"));
            if let Err(error) = codec::write_canvas(&path, &canvas) {
                let _ = self.failed.set(unwritten(error));
            }
        }
    }

    fn finish(self) -> Result<(), Failure> {
        self.failed.into_inner().map_or(Ok(()), Err)
    }
}
