//! `vergence sim`: the simulated workcell as a process, its devices behind the wires of real ones.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use clap::Args;
use serde_json::json;
use vergence::report::numbers;
use vergence_devices::Side;
use vergence_devices::dynamixel::Model;
use vergence_sim::{WiredWorkcell, Workcell, fitting_servo};

use crate::failure::Failure;
use crate::interrupt::Interrupt;
use crate::light::coordinates;
use crate::output::{outln, told};
use crate::robot::RobotArgs;

/// Offer the simulated workcell's devices over the wires of real ones: servos on a pseudo-terminal,
/// cameras as MJPEG over HTTP, tags behind Bluetooth controllers on TCP. Runs in real time until
/// it is interrupted.
#[derive(Args)]
pub struct Sim {
    #[command(flatten)]
    robot: RobotArgs,
    /// Write the configuration of a robot with these devices; its URDF goes beside it.
    #[arg(long, value_name = "FILE")]
    write_config: Option<PathBuf>,
    /// End after so many seconds.
    #[arg(long, value_name = "SECONDS")]
    seconds: Option<f64>,
    /// Read lines "OBJECT X Y Z" from standard input and hold that object's light there (m, base), shining
    /// towards the heads: for `vergence calibrate` over the wires.
    #[arg(long)]
    hold: bool,
    /// Print where the devices are as one line of JSON.
    #[arg(long)]
    json: bool,
}

/// How often the end is looked for.
const POLL: Duration = Duration::from_millis(50);

/// Runs the command.
pub fn run(args: &Sim) -> Result<bool, Failure> {
    let lasting = match args.seconds.map(Duration::try_from_secs_f64).transpose() {
        Ok(lasting) => lasting,
        Err(_) => {
            return Err(Failure::misuse("--seconds is not a time", "give a positive number"));
        }
    };
    let (interrupt, wired) = told(start(args), args.json, json!({}))?;
    print(args, &wired)?;
    let lines = args.hold.then(typed);
    let start = Instant::now();
    while !interrupt.raised() && lasting.is_none_or(|lasting| start.elapsed() < lasting) {
        std::thread::sleep(POLL);
        lines.iter().flat_map(Receiver::try_iter).for_each(|line| hold(&wired, &line));
    }
    Ok(true)
}

/// Offers the devices.
fn start(args: &Sim) -> Result<(Interrupt, WiredWorkcell), Failure> {
    let failed = |error: std::io::Error| {
        Failure::failed(format!("cannot offer the devices: {error}"), "are ports and ptys free?")
    };
    let interrupt = Interrupt::listen().map_err(failed)?;
    let (config, description, mut settings) = args.robot.simulation()?;
    let model = servo_model(&config, settings.servos.resolution_deg)?;
    // The servos step as their model does.
    settings.servos.resolution_deg = model.tick.to_degrees();
    let urdf = description.text.clone();
    let workcell = Workcell::new(config, description, settings, args.robot.seed)
        .map_err(crate::robot::unusable)?;
    let wired = WiredWorkcell::start(workcell, model).map_err(failed)?;
    if let Some(path) = &args.write_config {
        write_config(&wired, path, &urdf)?;
    }
    Ok((interrupt, wired))
}

/// What is typed, line by line.
fn typed() -> Receiver<String> {
    let (sender, lines) = channel();
    std::thread::spawn(move || {
        let mut typed = std::io::stdin().lines().map_while(Result::ok);
        while typed.next().is_some_and(|line| sender.send(line).is_ok()) {}
    });
    lines
}

/// Holds a light where a line says; a line that says nothing is answered with what it should say.
fn hold(wired: &WiredWorkcell, line: &str) {
    let said =
        line.trim().split_once(' ').and_then(|(object, at)| Some((object, coordinates(at)?)));
    match said {
        Some((object, at)) if wired.hold_light(object, &at) => eprintln!("{object} is held"),
        Some((object, _)) => eprintln!("there is no object \"{object}\" with a light"),
        None => eprintln!("type OBJECT X Y Z, for example: cup 0.8 0.1 0.3"),
    }
}

/// The model that the wiring names for the left head, else the one nearest to the settings.
fn servo_model(
    config: &vergence_devices::Config,
    resolution_deg: f64,
) -> Result<&'static Model, Failure> {
    let Some(named) = &config.left.servos.dynamixel else {
        return Ok(fitting_servo(resolution_deg));
    };
    Model::by_name(&named.model).ok_or_else(|| {
        Failure::misuse(
            format!("servo model \"{}\" is not known", named.model),
            "docs/hardware.md lists the models",
        )
    })
}

fn write_config(wired: &WiredWorkcell, path: &Path, urdf: &str) -> Result<(), Failure> {
    crate::robot::not_urdf(path)?;
    let robot = path.with_extension("urdf");
    let name = robot.file_name().unwrap_or_default().to_string_lossy().into_owned();
    std::fs::write(&robot, urdf).and_then(|()| std::fs::write(path, wired.wiring(&name))).map_err(
        |error| {
            Failure::failed(
                format!("cannot write {}: {error}", path.display()),
                "choose a file that you may write",
            )
        },
    )
}

fn print(args: &Sim, wired: &WiredWorkcell) -> Result<(), Failure> {
    let urls = Side::BOTH.map(|side| wired.camera_url(side));
    let port = wired.servo_port().display().to_string();
    let tags = wired.tags().to_string();
    if args.json {
        let objects: Vec<_> = wired
            .truth()
            .objects
            .iter()
            .map(|object| {
                let (position, orientation) = numbers(&object.base_from_object);
                let landmark = object.landmarks.first().map(|p| [p.x, p.y, p.z]);
                json!({
                    "object_id": object.id,
                    "position": position,
                    "orientation": orientation,
                    "landmark": landmark,
                })
            })
            .collect();
        let document = json!({
            "servos": port,
            "cameras": urls,
            "tags": tags,
            "config": args.write_config,
            "truth": objects,
        });
        outln!("{document}");
    } else {
        outln!("servos   {port} (IDs 1 to 4: left pan, left tilt, right pan, right tilt)");
        outln!("cameras  {} {}", urls[0], urls[1]);
        outln!("tags     {tags} (HCI, H4 over TCP)");
        match &args.write_config {
            Some(path) => outln!("try      vergence find cup --config {}", path.display()),
            None => outln!("add --write-config FILE for a configuration that uses them"),
        }
    }
    // Whoever started this waits for the line.
    let flushed = std::io::stdout().flush();
    flushed.map_err(|error| Failure::failed(error, "is standard output open?"))
}
