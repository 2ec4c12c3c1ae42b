//! `vergence experiment 1`: the paper's first experiment over many seeds.
//!
//! A small box, a cup, and the cup behind an occluder are found one after the other in as many
//! simulated workcells as there are seeds; every run is judged by the simulator's truth.

use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;
use vergence::{FindConfig, Report};
use vergence_sim::Scenario;

use super::{Experiment, quantile};
use crate::commands::find::MethodArg;
use crate::failure::Failure;
use crate::output::{outln, told};
use crate::progress::Progress;
use crate::robot::{Errors, Opened};
use crate::save::Saver;

/// What is looked for, in which scene.
const CONDITIONS: [Condition; 3] = [
    Condition { name: "small box", object: "box", scenario: Scenario::Default },
    Condition { name: "cup", object: "cup", scenario: Scenario::Default },
    Condition { name: "cup, occluded", object: "cup", scenario: Scenario::Occluded },
];

/// A find counts as right when it is this near to the truth.
const RIGHT_MM: f64 = 10.0;
const RIGHT_DEG: f64 = 10.0;

#[derive(Clone, Copy)]
struct Condition {
    name: &'static str,
    object: &'static str,
    scenario: Scenario,
}

#[derive(Serialize)]
struct Output {
    experiment: u8,
    method: &'static str,
    seeds: u64,
    conditions: Vec<Statistics>,
}

#[derive(Serialize)]
struct Statistics {
    condition: &'static str,
    runs: usize,
    /// A pose was reported.
    found: usize,
    /// ... and it is within 10 mm and 10 degrees of the truth.
    right: usize,
    /// ... and it is not: the robot would reach for the wrong place.
    wrong: usize,
    position_median_mm: Option<f64>,
    position_p90_mm: Option<f64>,
    rotation_median_deg: Option<f64>,
    rotation_p90_deg: Option<f64>,
    landmark_median_mm: Option<f64>,
    simulated_seconds_median: Option<f64>,
    reasons: Vec<String>,
}

/// One find with its judgement.
struct Outcome {
    seed: u64,
    report: Report,
    errors: Option<Errors>,
}

/// Runs the command.
pub fn run(args: &Experiment) -> Result<bool, Failure> {
    let progress = Progress::runs(CONDITIONS.len() * args.seeds as usize);
    let jobs: Vec<(usize, u64)> =
        (0..CONDITIONS.len()).flat_map(|c| (1..=args.seeds).map(move |seed| (c, seed))).collect();
    let outcomes = jobs
        .par_iter()
        .map(|&(index, seed)| {
            let condition = &CONDITIONS[index];
            let outcome = find(args, condition, seed);
            progress.advance(condition.name);
            outcome.map(|outcome| (index, outcome))
        })
        .collect::<Result<Vec<_>, Failure>>();
    drop(progress);
    let outcomes = told(outcomes, args.json, json!({ "experiment": args.number }))?;
    let conditions: Vec<Statistics> = CONDITIONS
        .iter()
        .enumerate()
        .map(|(index, condition)| {
            let mine = outcomes.iter().filter(|(i, _)| *i == index).map(|(_, outcome)| outcome);
            statistics(condition.name, &mine.collect::<Vec<_>>())
        })
        .collect();
    let all_found = conditions.iter().all(|c| c.right > 0);
    let method = match args.method {
        MethodArg::Paper => "paper",
        MethodArg::Directional => "directional",
    };
    let output = Output { experiment: args.number, method, seeds: args.seeds, conditions };
    match args.json {
        true => crate::output::json(&output)?,
        false => print(args, &output),
    }
    Ok(all_found)
}

/// Finds once; saves the pictures of the first seed.
fn find(args: &Experiment, condition: &Condition, seed: u64) -> Result<Outcome, Failure> {
    let mut robot = Opened::embedded(seed, condition.scenario)?;
    let config = FindConfig { method: args.method.into(), seed, ..FindConfig::default() };
    let save = args.save.as_ref().filter(|_| seed == 1);
    let mut saver = save
        .map(|dir| {
            let name = condition.name.replace(", ", "-").replace(' ', "-");
            Saver::create(&dir.join(name), &robot, config.method)
        })
        .transpose()?;
    let mut report = vergence::find(&mut robot.system, condition.object, &config, &mut saver);
    report.truth = robot.truth(condition.object);
    let errors = Errors::of(&report);
    if let Some(saver) = saver {
        saver.finish(&report)?;
    }
    Ok(Outcome { seed, report, errors })
}

fn statistics(condition: &'static str, outcomes: &[&Outcome]) -> Statistics {
    let found: Vec<&Outcome> = outcomes.iter().copied().filter(|o| o.report.found).collect();
    let errors: Vec<&Errors> = found.iter().filter_map(|o| o.errors.as_ref()).collect();
    let right =
        errors.iter().filter(|e| e.position_mm <= RIGHT_MM && e.rotation_deg <= RIGHT_DEG).count();
    let position = || errors.iter().map(|e| e.position_mm);
    let rotation = || errors.iter().map(|e| e.rotation_deg);
    let landmark = outcomes.iter().filter_map(|o| landmark_error_mm(&o.report));
    let seconds = found.iter().filter_map(|o| o.report.timeline.last()).map(|step| step.end);
    let reasons = outcomes
        .iter()
        .filter_map(|o| Some(format!("seed {}: {}", o.seed, o.report.reason.as_ref()?)))
        .collect();
    Statistics {
        condition,
        runs: outcomes.len(),
        found: found.len(),
        right,
        wrong: found.len() - right,
        position_median_mm: quantile(position(), 0.5),
        position_p90_mm: quantile(position(), 0.9),
        rotation_median_deg: quantile(rotation(), 0.5),
        rotation_p90_deg: quantile(rotation(), 0.9),
        landmark_median_mm: quantile(landmark, 0.5),
        simulated_seconds_median: quantile(seconds, 0.5),
        reasons,
    }
}

fn landmark_error_mm(report: &Report) -> Option<f64> {
    let (landmark, truth) = (report.landmark.as_ref()?, report.truth.as_ref()?);
    let squares = landmark.position.iter().zip(truth.landmark).map(|(a, b)| (a - b) * (a - b));
    Some(1e3 * squares.sum::<f64>().sqrt())
}

fn print(args: &Experiment, output: &Output) {
    outln!("experiment 1, method {}, {} seeds", output.method, output.seeds);
    outln!(
        "{:<14} {:>5} {:>6} {:>6} {:>6} {:>9} {:>8} {:>9} {:>8} {:>12} {:>8}",
        "condition",
        "runs",
        "found",
        "right",
        "wrong",
        "med mm",
        "p90 mm",
        "med deg",
        "p90 deg",
        "landmark mm",
        "sim s"
    );
    let number = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}"));
    for c in &output.conditions {
        outln!(
            "{:<14} {:>5} {:>6} {:>6} {:>6} {:>9} {:>8} {:>9} {:>8} {:>12} {:>8}",
            c.condition,
            c.runs,
            c.found,
            c.right,
            c.wrong,
            number(c.position_median_mm),
            number(c.position_p90_mm),
            number(c.rotation_median_deg),
            number(c.rotation_p90_deg),
            number(c.landmark_median_mm),
            number(c.simulated_seconds_median)
        );
    }
    for c in &output.conditions {
        for reason in &c.reasons {
            outln!("  {}, {reason}", c.condition);
        }
    }
    outln!("right: within {RIGHT_MM} mm and {RIGHT_DEG} degrees of the simulator's truth");
    if let Some(dir) = &args.save {
        outln!("pictures are in {}", dir.display());
    }
}
