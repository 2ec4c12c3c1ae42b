//! `vergence find`: an object's name in, its pose in the robot's base frame out.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use vergence::{FindConfig, Method, Report};

use crate::failure::Failure;
use crate::output::{outln, rounded, told};
use crate::progress::Progress;
use crate::robot::{Errors, RobotArgs};
use crate::save::Saver;

/// Find an object and recognise its pose (steps 1 to 9 of the paper).
#[derive(Args)]
pub struct Find {
    /// Object id, as the tag advertises it.
    object: String,
    #[command(flatten)]
    robot: RobotArgs,
    /// Which recognition is used.
    #[arg(long, value_enum, default_value_t)]
    method: MethodArg,
    /// Folder for the picture of every step and `recording.mcap`.
    #[arg(long, value_name = "DIR")]
    save: Option<PathBuf>,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// `--method` as it is written on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum MethodArg {
    /// The 2005 paper as published.
    Paper,
    /// Coded light, directional distance fields, joint refinement.
    #[default]
    Directional,
}

impl From<MethodArg> for Method {
    fn from(arg: MethodArg) -> Self {
        match arg {
            MethodArg::Paper => Method::Paper,
            MethodArg::Directional => Method::Directional,
        }
    }
}

/// Runs the command.
pub fn run(args: &Find) -> Result<bool, Failure> {
    let (report, saver) = told(find(args), args.json, unfound(&args.object))?;
    // What was found is told first: it must not be lost to a full disk.
    print(args, &report)?;
    if let Some(saver) = saver {
        saver.finish(&report)?;
    }
    Ok(report.found)
}

/// What `--json` says of an object that could not even be looked for; the reason is added.
pub fn unfound(object: &str) -> Value {
    json!({ "object_id": object, "found": false, "alternatives": [], "timeline": [] })
}

fn find(args: &Find) -> Result<(Report, Option<Saver>), Failure> {
    let mut robot = args.robot.open()?;
    let seed = robot.seed(args.robot.seed)?;
    let config = FindConfig { method: args.method.into(), seed, ..FindConfig::default() };
    let saver =
        args.save.as_deref().map(|dir| Saver::create(dir, &robot, config.method)).transpose()?;
    let mut observer = (Progress::steps(), saver);
    let mut report = vergence::find(&mut robot.system, &args.object, &config, &mut observer);
    report.truth = robot.truth(&args.object);
    let (progress, saver) = observer;
    drop(progress);
    Ok((report, saver))
}

fn print(args: &Find, report: &Report) -> Result<(), Failure> {
    if args.json {
        return crate::output::json(report);
    }
    if let Some(reason) = &report.reason {
        outln!("{}: not found: {reason}", report.object_id);
        outln!("  what to do: {}", report.hint.unwrap_or_default());
    }
    if let Some(landmark) = &report.landmark {
        let [x, y, z] = landmark.position.map(|v| rounded(v, 4));
        let sigma = [0, 4, 8].map(|k| 1e3 * landmark.covariance[k].sqrt());
        outln!(
            "landmark  x {x:.4}  y {y:.4}  z {z:.4} m  (+- {:.1}, {:.1}, {:.1} mm)",
            sigma[0],
            sigma[1],
            sigma[2]
        );
    }
    if let Some(pose) = &report.pose {
        let [x, y, z] = pose.position.map(|v| rounded(v, 4));
        let [qx, qy, qz, qw] = pose.orientation.map(|v| rounded(v, 4));
        outln!("position  x {x:.4}  y {y:.4}  z {z:.4} m in base");
        outln!("rotation  x {qx:.4}  y {qy:.4}  z {qz:.4}  w {qw:.4}");
        outln!("confidence {:.3}", report.confidence.unwrap_or_default());
    }
    if let (Some(errors), true) = (Errors::of(report), report.found) {
        outln!(
            "truth     off by {:.1} mm and {:.2} degrees",
            errors.position_mm,
            errors.rotation_deg
        );
    }
    let took = report.timeline.last().map_or(0.0, |step| step.end);
    outln!("{took:.1} s on the robot's clock");
    match &args.save {
        Some(dir) => outln!("pictures and recording.mcap are in {}", dir.display()),
        None => outln!("add --save DIR for the pictures of every step and a ROS 2 recording"),
    }
    Ok(())
}
