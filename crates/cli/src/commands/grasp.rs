//! `vergence grasp`: an object's name in, the object in the gripper out.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;
use vergence::{FindConfig, GraspConfig, Report};

use super::find::unfound;
use crate::failure::Failure;
use crate::output::{outln, rounded, told};
use crate::progress::Progress;
use crate::robot::{Opened, RobotArgs};
use crate::save::Saver;

/// Find an object, grasp it and lift it.
#[derive(Args)]
pub struct Grasp {
    /// Object id, as the tag advertises it.
    object: String,
    #[command(flatten)]
    robot: RobotArgs,
    /// Folder for the picture of every step and `recording.mcap`.
    #[arg(long, value_name = "DIR")]
    save: Option<PathBuf>,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Grasp) -> Result<bool, Failure> {
    let mut unfound = unfound(&args.object);
    unfound["grasp"] = json!({ "succeeded": false });
    let (report, robot, saver) = told(grasp(args), args.json, unfound)?;
    // What was done is told first: it must not be lost to a full disk.
    match args.json {
        true => crate::output::json(&report)?,
        false => print(&report),
    }
    if let (Some(saver), Some(dir)) = (saver, &args.save) {
        robot.save_grasp(dir)?;
        saver.finish(&report)?;
    }
    Ok(report.grasp.is_some_and(|grasp| grasp.succeeded))
}

fn grasp(args: &Grasp) -> Result<(Report, Opened, Option<Saver>), Failure> {
    let mut robot = args.robot.open()?;
    robot.attach_arm(&args.object, args.save.is_some())?;
    let seed = robot.seed(args.robot.seed)?;
    let find = FindConfig { seed, ..FindConfig::default() };
    let config = GraspConfig { find, ..GraspConfig::default() };
    let saver = args
        .save
        .as_deref()
        .map(|dir| Saver::create(dir, &robot, config.find.method))
        .transpose()?;
    let mut observer = (Progress::steps(), saver);
    let truth = robot.truth(&args.object);
    let mut report = vergence::grasp(&mut robot.system, &args.object, &config, &mut observer);
    report.truth = truth;
    if let Some(grasp) = &mut report.grasp {
        grasp.physics = robot.physics();
    }
    let (progress, saver) = observer;
    drop(progress);
    Ok((report, robot, saver))
}

fn print(report: &Report) {
    let Some(grasp) = &report.grasp else { return };
    let object = &report.object_id;
    let reason = report.reason.as_ref().or(grasp.reason.as_ref());
    let hint = report.hint.or(grasp.hint).unwrap_or_default();
    match (grasp.succeeded, reason) {
        (true, _) => outln!("{object}: in the hand"),
        (false, reason) => {
            outln!("{object}: not grasped: {}", reason.map_or("", String::as_str));
            outln!("  what to do: {hint}");
        }
    }
    if let (Some(approach), Some(width), Some(force), Some(margin)) =
        (grasp.approach, grasp.width, grasp.force, grasp.margin)
    {
        let width = 1e3 * width;
        outln!("{approach} grasp, {width:.0} mm wide, {force:.0} N, margin {margin:.1}");
    }
    if let Some(shift) = grasp.corrected_by_mm {
        outln!("the second look moved it by {shift:.1} mm");
    }
    if let Some(physics) = &grasp.physics {
        outln!("the simulator says: it rose by {:.0} mm", rounded(physics.risen_mm, 0));
        if let Some(collision) = &physics.collision {
            outln!("the simulator says: {collision}");
        }
    }
    let took = report.timeline.last().map_or(0.0, |step| step.end);
    outln!("{took:.1} s on the robot's clock");
}
