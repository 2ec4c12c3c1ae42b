//! `vergence evaluate pose`: how right, how honest and how fast the pose recogniser is on stereo
//! pairs that the simulator draws, one a seed, or on a pose set with its truth.
//!
//! In simulated scenes nobody tells the recogniser whether the object stands; gravity is known. Every
//! figure but those of honesty counts a refusal as wrong.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use nalgebra::Vector3;
use rayon::prelude::*;
use serde_json::json;
use vergence_geometry::{Symmetry, Transform};
use vergence_pose::{ObjectPose, Query, Refusal, View};
use vergence_sim::{Scenario, stereo_scene};

use crate::commands::pose::Method;
use crate::commands::pose::set::{self, Purpose, Worked};
use crate::failure::Failure;
use crate::output::{outln, told};

/// Recognise objects in simulated stereo pairs, or in a pose set, and compare with the truth.
#[derive(Args)]
pub struct Pose {
    /// Folder of a pose set with its truth (scene_gt_left.json), instead of simulated scenes.
    #[arg(long, conflicts_with_all = ["scenes", "seed"])]
    set: Option<PathBuf>,
    /// Scenes to draw.
    #[arg(long, default_value_t = 300)]
    scenes: u64,
    /// Seed of the first scene; the others follow.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Draw objects on any side that they can rest on, balls, prisms and convex bodies among them, instead
    /// of standing ones.
    #[arg(long, conflicts_with = "set")]
    fallen: bool,
    /// Folder to write the scenes to that are drawn, as a pose set with its truth (docs/pose.md).
    #[arg(long, conflicts_with = "set")]
    save: Option<PathBuf>,
    /// How to recognise.
    #[arg(long, value_enum, default_value_t = Method::Directional)]
    method: Method,
    /// Scenes worked on at the same time; the times are right only with one.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=set::MOST_THREADS))]
    threads: u16,
    /// Print one JSON document.
    #[arg(long)]
    json: bool,
}

/// What came of one object.
enum Outcome {
    Answer(Answer),
    /// Why there is none, without the numbers.
    Refused(&'static str),
}

/// An answer against the truth.
struct Answer {
    /// Seed, or number in the set.
    scene: u64,
    position_mm: f64,
    rotation_deg: f64,
    /// Normalised squared error over its degrees of freedom; whether the 95 % ellipsoid holds the
    /// truth.
    nees: Option<(f64, bool)>,
}

/// Runs the command.
pub fn run(args: &Pose) -> Result<bool, Failure> {
    if args.scenes == 0 || args.scenes > 100_000 {
        let what = format!("--scenes {} is not between 1 and 100000", args.scenes);
        return Err(Failure::misuse(what, "give a number in that range"));
    }
    if let Some(folder) = &args.save
        && folder.join("test").exists()
    {
        let what = format!("{} holds a pose set already", folder.display());
        return Err(Failure::misuse(what, "give --save a new folder"));
    }
    let last = args.seed.checked_add(args.scenes - 1);
    if args.save.is_some() && last.is_none_or(|last| u32::try_from(last).is_err()) {
        let what = "a scene of a pose set has its seed as its number, which is below 2^32";
        return Err(Failure::misuse(what, "give a smaller --seed"));
    }
    let worked = match &args.set {
        Some(set) => set::each(set, args.threads, Purpose::Comparison, |case| {
            let truth = case.truth()?;
            Ok(recognise(case.scene.into(), &case.views(), &case.query(), &truth, args.method))
        }),
        None => simulation(args),
    };
    let worked = told(worked, args.json, json!({}))?;
    if worked.results.is_empty() {
        worked.whole()?;
    }
    let figures = Figures::of(&worked);
    if args.json {
        outln!("{}", figures.document(args));
    } else {
        figures.print(args);
    }
    worked.whole()?;
    Ok(figures.answered > 0)
}

/// Every simulated scene, with the seconds that its recognition took.
fn simulation(args: &Pose) -> Result<Worked<(Outcome, f64)>, Failure> {
    // After the largest seed comes the smallest.
    let scene = |k: u64| simulated(args.seed.wrapping_add(k), args);
    let results: Result<Vec<(Outcome, f64)>, Failure> =
        set::pool(args.threads)?.install(|| (0..args.scenes).into_par_iter().map(scene).collect());
    Ok(Worked { results: results?, scenes: args.scenes as usize, bad: BTreeMap::new() })
}

/// One of them.
fn simulated(seed: u64, args: &Pose) -> Result<(Outcome, f64), Failure> {
    let scenario = if args.fallen { Scenario::Fallen } else { Scenario::Default };
    let scene =
        stereo_scene(scenario, seed).map_err(|e| Failure::failed(e, "take another --seed"))?;
    if let Some(folder) = &args.save {
        set::write(folder, seed, &scene)?;
    }
    let views = [0, 1].map(|k| View {
        image: &scene.images[k],
        camera: scene.cameras[k],
        base_from_optical: scene.base_from_optical[k],
        turn_sd: 0.0,
    });
    let query = Query {
        record: &scene.record,
        landmark: scene.landmark,
        landmark_index: 0,
        up: Some(Vector3::z_axis()),
        standing: None,
    };
    Ok(recognise(seed, &views, &query, &scene.base_from_object, args.method))
}

fn recognise(
    scene: u64,
    views: &[View],
    query: &Query,
    truth: &Transform,
    method: Method,
) -> (Outcome, f64) {
    let start = Instant::now();
    let result = method.recognise(views, query);
    let seconds = start.elapsed().as_secs_f64();
    let outcome = match result {
        Ok(found) => Outcome::Answer(Answer::new(scene, &found, truth)),
        Err(refusal) => Outcome::Refused(match refusal {
            Refusal::Ambiguous { .. } => "another pose explains the edges about as well",
            Refusal::Chance { .. } => "the edges fit little better than chance would",
            Refusal::TooFewEdges { .. } => "too little of the contour lies on edges",
            _ => "the scene could not be worked on",
        }),
    };
    (outcome, seconds)
}

impl Answer {
    fn new(scene: u64, found: &ObjectPose, truth: &Transform) -> Self {
        let pose = &found.pose.pose;
        // 95 % quantiles of chi-squared with six, five and three degrees of freedom.
        let limit = match found.symmetry {
            Symmetry::Finite(_) => 12.592,
            Symmetry::Revolution { .. } => 11.070,
            Symmetry::Full => 7.815,
        };
        Answer {
            scene,
            position_mm: 1e3 * (pose.translation.vector - truth.translation.vector).norm(),
            rotation_deg: found
                .symmetry
                .angle_between(&pose.rotation, &truth.rotation)
                .to_degrees(),
            nees: found
                .nees(truth)
                .map(|(squares, freedoms)| (squares / freedoms as f64, squares < limit)),
        }
    }

    fn within(&self, mm: f64, deg: f64) -> bool {
        self.position_mm <= mm && self.rotation_deg <= deg
    }
}

/// What the command prints.
struct Figures {
    scenes: usize,
    /// Scenes that could not be read whole.
    bad: Vec<u32>,
    /// What was to be recognised: one in every simulated scene, in a set what its tags name.
    objects: usize,
    answered: usize,
    within_5: f64,
    within_2: f64,
    median_mm: f64,
    median_deg: f64,
    /// Seeds (or numbers in the set) of answers off by more than 10 mm or 5 degrees.
    wrong: Vec<u64>,
    /// Share of the answers whose ellipsoid holds the truth.
    held: f64,
    /// Median over the answers of the squared error over its degrees of freedom.
    nees: f64,
    refused: BTreeMap<&'static str, usize>,
    median_ms: f64,
}

impl Figures {
    fn of(worked: &Worked<(Outcome, f64)>) -> Self {
        let outcomes = &worked.results;
        let (mut answers, mut refused) = (Vec::new(), BTreeMap::new());
        for (outcome, _) in outcomes {
            match outcome {
                Outcome::Answer(answer) => answers.push(answer),
                Outcome::Refused(why) => *refused.entry(*why).or_default() += 1,
            }
        }
        let share = |of: &dyn Fn(&Answer) -> bool, all: usize| {
            answers.iter().filter(|a| of(a)).count() as f64 / all.max(1) as f64
        };
        let of_all = |value: fn(&Answer) -> f64| {
            let missing = std::iter::repeat_n(f64::INFINITY, outcomes.len() - answers.len());
            median(answers.iter().map(|a| value(a)).chain(missing))
        };
        Figures {
            scenes: worked.scenes,
            bad: worked.bad.keys().copied().collect(),
            objects: outcomes.len(),
            answered: answers.len(),
            within_5: share(&|a| a.within(5.0, 5.0), outcomes.len()),
            within_2: share(&|a| a.within(2.0, 2.0), outcomes.len()),
            median_mm: of_all(|a| a.position_mm),
            median_deg: of_all(|a| a.rotation_deg),
            wrong: answers.iter().filter(|a| !a.within(10.0, 5.0)).map(|a| a.scene).collect(),
            held: share(&|a| a.nees.is_some_and(|(_, held)| held), answers.len()),
            nees: median(answers.iter().filter_map(|a| a.nees).map(|(n, _)| n)),
            refused,
            median_ms: 1e3 * median(outcomes.iter().map(|o| o.1)),
        }
    }

    fn document(&self, args: &Pose) -> serde_json::Value {
        let wrong = if args.set.is_some() { "wrong_scenes" } else { "wrong_seeds" };
        json!({
            "scenes": self.scenes,
            "bad_scenes": self.bad,
            "objects": self.objects,
            "seed": args.set.is_none().then_some(args.seed),
            "answered": self.answered,
            "within_5mm_5deg": self.within_5,
            "within_2mm_2deg": self.within_2,
            "median_position_mm": self.median_mm,
            "median_rotation_deg": self.median_deg,
            wrong: self.wrong,
            "ellipsoid_95_coverage": self.held,
            "nees_over_freedoms_median": self.nees,
            "refused": self.refused,
            "median_ms": self.median_ms,
        })
    }

    fn print(&self, args: &Pose) {
        match &args.set {
            Some(set) => {
                let (objects, scenes, set) = (self.objects, self.scenes, set.display());
                outln!("{objects} objects in {scenes} scenes of {set}");
            }
            None => outln!("{} simulated stereo scenes from seed {}", self.scenes, args.seed),
        }
        outln!("answered                          {}", self.answered);
        outln!("within 5 mm, 5 deg (of all)       {:.3}", self.within_5);
        outln!("within 2 mm, 2 deg (of all)       {:.3}", self.within_2);
        outln!(
            "median error (of all)             {:.2} mm, {:.2} deg",
            self.median_mm,
            self.median_deg
        );
        outln!(
            "answers beyond 10 mm or 5 deg     {} {}",
            self.wrong.len(),
            if self.wrong.is_empty() { String::new() } else { format!("{:?}", self.wrong) }
        );
        outln!("95 % ellipsoid holds the truth    {:.3} of the answers", self.held);
        outln!("squared error over its freedoms   {:.2} median", self.nees);
        for (why, count) in &self.refused {
            outln!("refused: {why}: {count}");
        }
        outln!("time                              {:.1} ms median", self.median_ms);
    }
}

/// The median, between the middle two of an even number; not a number when there is none.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let at = |k: usize| values.get(k).copied().unwrap_or(f64::NAN);
    0.5 * (at(values.len().saturating_sub(1) / 2) + at(values.len() / 2))
}
