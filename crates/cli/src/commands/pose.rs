//! `vergence pose`: recognise the object in every scene of a pose set, write a BOP results CSV.

pub mod set;
mod table;

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::{Args, ValueEnum};
use vergence_imaging::codec;
use vergence_pose::{ObjectPose, Query, Refusal, View, directional, paper};

use crate::failure::Failure;
use set::Scene;

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
    #[arg(long, default_value_t = 1)]
    threads: usize,
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

/// What came of one scene.
pub struct Outcome {
    /// Its number.
    pub id: u32,
    /// The object's number in the set.
    pub object: u32,
    /// Pose, or why there is none.
    pub result: Result<ObjectPose, Refusal>,
    /// `base_from_optical` of the left camera.
    pub base_from_left: vergence_geometry::Transform,
    /// Seconds for all pictures of the scene, decoding them aside.
    pub seconds: f64,
}

/// Runs the command; `true` when at least one scene was answered.
pub fn run(args: PoseArgs) -> Result<bool, Failure> {
    let folders = set::scenes(&args.set)?;
    let outcomes: Result<Vec<Outcome>, Failure> = pool(args.threads)?.install(|| {
        use rayon::prelude::*;
        folders.par_iter().map(|(id, folder)| recognise(*id, folder, &args)).collect()
    });
    let outcomes = outcomes?;
    table::write(&args.out, &outcomes)?;
    table::summary(&outcomes, &args.out);
    Ok(outcomes.iter().any(|o| o.result.is_ok()))
}

/// Threads for as many scenes at a time; at least one.
pub fn pool(threads: usize) -> Result<rayon::ThreadPool, Failure> {
    let builder = rayon::ThreadPoolBuilder::new().num_threads(threads.max(1));
    builder.build().map_err(|e| Failure::failed(e, "ask for fewer --threads"))
}

fn recognise(id: u32, folder: &Path, args: &PoseArgs) -> Result<Outcome, Failure> {
    let scene = Scene::read(folder)?;
    let (views, query) = (scene.views(), scene.query());
    let start = Instant::now();
    let result = args.method.recognise(&views, &query);
    let seconds = start.elapsed().as_secs_f64();
    if let Some(folder) = &args.save {
        save_pictures(folder, id, &views, &query, args.method)?;
    }
    let base_from_left = views[0].base_from_optical;
    Ok(Outcome { id, object: scene.object, result, base_from_left, seconds })
}

/// Writes the pictures of one scene; the recognition runs once more, so that the time stays pure.
fn save_pictures(
    folder: &Path,
    id: u32,
    views: &[View],
    query: &Query,
    method: Method,
) -> Result<(), Failure> {
    let hint = "name a folder that can be written to";
    std::fs::create_dir_all(folder)
        .map_err(|e| Failure::misuse(format!("{}: {e}", folder.display()), hint))?;
    let pictures = match method {
        Method::Directional => {
            match directional::recognise_traced(views, query, &directional::Config::default()) {
                Ok((_, trace)) => directional::picture::draw(&trace),
                Err(_) => Vec::new(),
            }
        }
        Method::Paper => paper::draw(views, query, &paper::Config::default()),
    };
    for (name, canvas) in pictures {
        let path = folder.join(format!("{id:06}-{name}.png"));
        codec::write_canvas(&path, &canvas).map_err(|e| Failure::misuse(e, hint))?;
    }
    Ok(())
}
