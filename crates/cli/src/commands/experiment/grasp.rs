//! `vergence experiment 2`: a cup is found, grasped and lifted in as many simulated workcells as there
//! are seeds.
//!
//! The robot says whether it holds the cup; the physics says whether that is so. Refusals come before
//! anything moves and are counted apart.

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;
use vergence::{FindConfig, GraspConfig, Report};
use vergence_sim::Scenario;

use super::{Experiment, quantile};
use crate::commands::find::MethodArg;
use crate::failure::Failure;
use crate::output::{outln, rounded, told};
use crate::progress::Progress;
use crate::robot::{Errors, Opened};
use crate::save::{Saver, fresh, is_ours};

/// What is grasped.
const OBJECT: &str = "cup";

#[derive(Serialize)]
struct Output {
    experiment: u8,
    seeds: u64,
    /// The robot says that the cup is in its hand, lifted.
    grasped: usize,
    /// The physics says so too, and that nothing was bumped into or broken.
    lifted: usize,
    /// The robot says so and the physics does not.
    false_successes: usize,
    /// Runs in which the arm bumped into something before the fingers closed.
    collisions: usize,
    /// Runs that ended before the arm moved.
    refused: usize,
    find_seconds_median: Option<f64>,
    total_seconds_median: Option<f64>,
    total_seconds_p90: Option<f64>,
    /// How far the pose was from the truth when the plan was made.
    position_median_mm: Option<f64>,
    /// How far the second look moved the grasp.
    corrected_median_mm: Option<f64>,
    /// How far closing the fingers shifted the cup.
    closing_error_median_mm: Option<f64>,
    closing_error_p90_mm: Option<f64>,
    runs: Vec<Run>,
}

#[derive(Serialize)]
struct Run {
    seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    report: Report,
}

/// Runs the experiment; achieved when every run succeeded or was refused, and none was false.
pub fn run(args: &Experiment) -> Result<bool, Failure> {
    if args.method != MethodArg::Directional {
        return Err(Failure::misuse(
            "experiment 2 knows no --method: the paper's does not tell how sure it is",
            "leave --method out",
        ));
    }
    let progress = Progress::runs(args.seeds as usize);
    if let Some(dir) = &args.save {
        told(clear(dir), args.json, json!({ "experiment": args.number }))?;
    }
    let runs = (1..=args.seeds)
        .into_par_iter()
        .map(|seed| {
            let run = grasp(args, seed);
            progress.advance(OBJECT);
            run
        })
        .collect::<Result<Vec<_>, Failure>>();
    drop(progress);
    let runs = told(runs, args.json, json!({ "experiment": args.number }))?;
    let output = statistics(args, runs);
    match args.json {
        true => crate::output::json(&output)?,
        false => print(args, &output),
    }
    let bad = output.false_successes + output.collisions;
    Ok(bad == 0 && output.lifted + output.refused == output.runs.len() && output.lifted > 0)
}

/// Rids the folder of the seeds of an earlier run, which may have had more of them.
fn clear(dir: &Path) -> Result<(), Failure> {
    for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
        let path = entry.path();
        let name = entry.file_name();
        let seed = name.to_str().and_then(|name| name.parse::<u64>().ok());
        if path.is_dir() && seed.is_some_and(|seed| folder(dir, seed) == path) {
            fresh(&path, is_ours)?;
            // What else is in it stays.
            let _ = std::fs::remove_dir(&path);
        }
    }
    Ok(())
}

/// Where the files of one seed are.
fn folder(dir: &Path, seed: u64) -> PathBuf {
    dir.join(format!("{seed:03}"))
}

fn grasp(args: &Experiment, seed: u64) -> Result<Run, Failure> {
    let mut robot = Opened::embedded(seed, Scenario::Reach)?;
    robot.attach_arm(OBJECT, args.save.is_some())?;
    let find = FindConfig { seed, ..FindConfig::default() };
    let config = GraspConfig { find, ..GraspConfig::default() };
    let dir = args.save.as_ref().map(|dir| folder(dir, seed));
    let mut saver =
        dir.as_ref().map(|dir| Saver::create(dir, &robot, config.find.method)).transpose()?;
    let truth = robot.truth(OBJECT);
    let mut report = vergence::grasp(&mut robot.system, OBJECT, &config, &mut saver);
    report.truth = truth;
    if let Some(grasp) = &mut report.grasp {
        grasp.physics = robot.physics();
    }
    if let (Some(saver), Some(dir)) = (saver, &dir) {
        robot.save_grasp(dir)?;
        saver.finish(&report)?;
    }
    let reason = report.reason.clone();
    let reason = reason.or_else(|| report.grasp.as_ref()?.reason.clone());
    Ok(Run { seed, reason, report })
}

impl Run {
    fn grasped(&self) -> bool {
        self.report.grasp.as_ref().is_some_and(|grasp| grasp.succeeded)
    }

    fn physics(&self) -> Option<&vergence::report::PhysicsReport> {
        self.report.grasp.as_ref()?.physics.as_ref()
    }

    fn lifted(&self) -> bool {
        self.grasped() && self.physics().is_some_and(|physics| physics.lifted)
    }

    fn collided(&self) -> bool {
        self.physics().is_some_and(|physics| physics.collision.is_some())
    }

    /// When a step ended (s).
    fn end(&self, name: &str) -> Option<f64> {
        self.report.timeline.iter().find(|step| step.step == name).map(|step| step.end)
    }

    /// The arm never moved.
    fn refused(&self) -> bool {
        self.end("transfer").is_none()
    }
}

fn statistics(args: &Experiment, runs: Vec<Run>) -> Output {
    let count = |test: &dyn Fn(&Run) -> bool| runs.iter().filter(|run| test(run)).count();
    let lifted = || runs.iter().filter(|run| run.lifted());
    let total = || lifted().filter_map(|run| run.report.timeline.last()).map(|step| step.end);
    let of_grasp = |value: fn(&vergence::report::GraspReport) -> Option<f64>| {
        quantile(runs.iter().filter_map(|run| value(run.report.grasp.as_ref()?)), 0.5)
    };
    let closing = || runs.iter().filter_map(|run| run.physics()).filter_map(|p| p.closing_error_mm);
    let errors = runs.iter().filter_map(|run| Errors::of(&run.report)).map(|e| e.position_mm);
    Output {
        experiment: args.number,
        seeds: args.seeds,
        grasped: count(&Run::grasped),
        lifted: count(&Run::lifted),
        false_successes: count(&|run| run.grasped() && !run.lifted()),
        collisions: count(&Run::collided),
        refused: count(&Run::refused),
        find_seconds_median: quantile(runs.iter().filter_map(|run| run.end("recognise")), 0.5),
        total_seconds_median: quantile(total(), 0.5),
        total_seconds_p90: quantile(total(), 0.9),
        position_median_mm: quantile(errors, 0.5),
        corrected_median_mm: of_grasp(|grasp| grasp.corrected_by_mm),
        closing_error_median_mm: quantile(closing(), 0.5),
        closing_error_p90_mm: quantile(closing(), 0.9),
        runs,
    }
}

fn print(args: &Experiment, output: &Output) {
    let number = |value: Option<f64>| value.map_or("-".into(), |v| format!("{:.1}", rounded(v, 1)));
    for run in &output.runs {
        let grasp = run.report.grasp.as_ref();
        let said = if run.grasped() { "grasped" } else { "not grasped" };
        let physics = run.physics();
        outln!(
            "seed {:>3}  {:<11}  {:<5}  rose {:>5} mm, closing shifted it {:>4} mm, {:>5} s{}{}{}",
            run.seed,
            said,
            grasp.and_then(|g| g.approach).unwrap_or("-"),
            number(physics.map(|p| p.risen_mm)),
            number(physics.and_then(|p| p.closing_error_mm)),
            number(run.report.timeline.last().map(|step| step.end)),
            if physics.is_some_and(|p| p.broken) { ", BROKEN" } else { "" },
            physics.and_then(|p| p.collision.as_ref()).map_or("".into(), |c| format!(", HIT: {c}")),
            run.reason.as_ref().map_or("".into(), |r| format!(": {r}")),
        );
    }
    outln!(
        "experiment 2, {} seeds: {} grasped by the robot's word, {} lifted by the physics' \
         ({} false successes), {} collisions, {} refused",
        output.seeds,
        output.grasped,
        output.lifted,
        output.false_successes,
        output.collisions,
        output.refused
    );
    outln!(
        "found after {} s, in the hand after {} s (median; p90 {} s); pose off by {} mm, \
         second look moved the grasp by {} mm, closing shifted the cup by {} mm (p90 {} mm)",
        number(output.find_seconds_median),
        number(output.total_seconds_median),
        number(output.total_seconds_p90),
        number(output.position_median_mm),
        number(output.corrected_median_mm),
        number(output.closing_error_median_mm),
        number(output.closing_error_p90_mm)
    );
    if let Some(dir) = &args.save {
        outln!("pictures and recordings are in {}", dir.display());
    }
}
