//! `vergence calibrate`: the heads' geometry and lenses from the blinking light alone.

use std::path::{Path, PathBuf};

use clap::Args;
use nalgebra::{Point3, Vector3};
use serde::Serialize;
use serde_json::json;
use vergence::{CollectConfig, FindConfig, Session, System};
use vergence_devices::calibrated::WriteError;
use vergence_devices::{Description, Side};
use vergence_head::calibration::{Calibration, CalibrationConfig, middle};
use vergence_head::{Noise, PanTiltHead};

use crate::failure::Failure;
use crate::light::{Person, Ruler, SimulatedPerson};
use crate::out;
use crate::output::{outln, told};
use crate::progress::Progress;
use crate::robot::{BUILT, Opened, RobotArgs, not_urdf, urdf};

/// Calibrate both heads from a tag's blinking light: joint zeros, axes, lever arms, lenses. The tag is
/// moved from place to place; every second place is a known length from the one before.
#[derive(Args)]
pub struct Calibrate {
    /// Wiring of the robot (TOML).
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Configuration to write; the calibrated URDF goes beside it.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Object id of the tag whose light is moved.
    #[arg(long, default_value = "cup")]
    object: String,
    /// Places of the light, in pairs.
    #[arg(long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(2..=1000))]
    places: u16,
    /// Angles from which each head looks at each place.
    #[arg(long, default_value_t = CollectConfig::default().views as u16, value_parser = clap::value_parser!(u16).range(4..=1000))]
    views: u16,
    /// Length (m) between the two places of a pair.
    #[arg(long, default_value_t = 0.5)]
    length: f64,
    /// Standard deviation (m) of that length.
    #[arg(long, default_value_t = 0.0005)]
    length_sigma: f64,
    /// Each place is measured in the base frame, to --place-sigma, and asked for on the terminal: then
    /// the heads know where they stand in base.
    #[arg(long)]
    measured: bool,
    /// Standard deviation (m) of each coordinate of a measured place.
    #[arg(long, default_value_t = 0.001)]
    place_sigma: f64,
    /// Seed of the simulated workcell.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// What came out.
#[derive(Serialize)]
struct Outcome {
    calibrated: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    places: usize,
    /// Sightings of the left and of the right head.
    sightings: [usize; 2],
    missed: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    figures: Option<Figures>,
}

#[derive(Serialize)]
struct Figures {
    /// Residual of the sightings (px, rms).
    rms_px: f64,
    outliers: f64,
    /// Predicted error of a distance (m): half width of the 95 % interval.
    distance_95: Vec<DistanceError>,
    focal_px: [f64; 2],
}

#[derive(Serialize)]
struct DistanceError {
    distance: f64,
    error: f64,
}

/// Two sigmas of a normal distribution hold 95 %.
const SIGMAS_95: f64 = 1.96;

/// Runs the command.
pub fn run(args: &Calibrate) -> Result<bool, Failure> {
    let fits = |value: f64, high: f64| value > 0.0 && value < high;
    if !fits(args.length, 10.0)
        || !fits(args.length_sigma, args.length)
        || !fits(args.place_sigma, 1.0)
    {
        return Err(Failure::misuse(
            "--length, --length-sigma and --place-sigma are not a length and its uncertainties",
            "give them in metres, for example --length 0.5 --length-sigma 0.0005",
        ));
    }
    not_urdf(&args.out)?;
    let outcome = told(calibrate(args), args.json, json!({ "calibrated": false }))?;
    print(args, &outcome)?;
    Ok(outcome.calibrated)
}

/// Measures, and writes what came out if it is good.
fn calibrate(args: &Calibrate) -> Result<Outcome, Failure> {
    for path in [&args.out, &args.out.with_extension("urdf")] {
        out::check(path)?;
    }
    let robot = RobotArgs { config: Some(args.config.clone()), seed: args.seed };
    let mut opened = robot.open()?;
    keeps_what_was_read(args, &opened)?;
    // A description that cannot take what will come out is told of before anybody measures.
    with_heads(&opened, &opened.system.heads).map_err(|e| cannot_write(&args.out, &e))?;
    let session = sightings(args, &mut opened)?;
    let noise = noise(&opened.system);
    let config = CalibrationConfig { noise, ..CalibrationConfig::default() };
    let outcome =
        vergence_head::calibrate(&opened.system.heads, &session.places, &session.lengths, &config);
    let count = |k: usize| session.places.iter().map(|p| p.fixations[k].len()).sum();
    let mut summary = Outcome {
        calibrated: outcome.is_ok(),
        reason: outcome.as_ref().err().map(ToString::to_string),
        places: session.places.len(),
        sightings: [count(0), count(1)],
        missed: session.missed,
        figures: None,
    };
    if let Ok(calibration) = &outcome {
        summary.figures = Some(figures(calibration));
        write(args, &opened, calibration)?;
    }
    Ok(summary)
}

/// Looks at the light wherever a person, real or simulated, puts it.
fn sightings(args: &Calibrate, opened: &mut Opened) -> Result<Session, Failure> {
    let config = CollectConfig {
        views: usize::from(args.views),
        find: FindConfig { seed: opened.seed(args.seed)?, ..FindConfig::default() },
    };
    let ruler = Ruler {
        places: usize::from(args.places).next_multiple_of(2),
        length: (args.length, args.length_sigma),
        measured: args.measured.then_some(args.place_sigma),
    };
    let mut progress = Progress::steps();
    let collected = match opened.simulator() {
        Some(workcell) => {
            let mut person = SimulatedPerson::new(workcell, &args.object, ruler, args.seed);
            vergence::collect(&mut opened.system, &args.object, &mut person, &config, &mut progress)
        }
        None => {
            let mut person = Person::new(ruler);
            // A person reads and answers: nothing may overwrite the prompt.
            vergence::collect(&mut opened.system, &args.object, &mut person, &config, &mut ())
        }
    };
    collected.map_err(|error| Failure::failed(&error, error.hint))
}

/// Encoder noise of the coarser servos; slack that always lies on one side is part of the zeros.
fn noise(system: &System) -> Noise {
    Noise::of_servo(system.resolution(), 0.0)
}

fn figures(calibration: &Calibration) -> Figures {
    let at = |distance: f64| {
        let ahead = ahead(calibration, distance);
        let sigma = calibration.distance_sigma(&ahead).unwrap_or(f64::INFINITY);
        DistanceError { distance, error: SIGMAS_95 * sigma }
    };
    Figures {
        rms_px: calibration.rms_px,
        outliers: calibration.outliers,
        distance_95: [0.5, 1.0, 2.0].map(at).into(),
        focal_px: [0, 1].map(|k| calibration.heads[k].camera.fx),
    }
}

/// A place on a table before the heads, so far away (m).
fn ahead(calibration: &Calibration, distance: f64) -> Point3<f64> {
    middle(&calibration.heads) + Vector3::new(0.9, 0.0, -0.4).normalize() * distance
}

/// Refuses to write over what was read, before anything is measured.
fn keeps_what_was_read(args: &Calibrate, opened: &Opened) -> Result<(), Failure> {
    let urdf = urdf(&args.config, &opened.config);
    let read = [args.config.as_path(), &urdf].map(std::fs::canonicalize);
    let written = [args.out.clone(), args.out.with_extension("urdf")].map(std::fs::canonicalize);
    let same = |w: &PathBuf| read.iter().flatten().any(|r| r == w);
    match written.iter().flatten().find(|w| same(w)) {
        None => Ok(()),
        Some(path) => Err(Failure::misuse(
            format!("{} is what the calibration starts from", path.display()),
            "give --out another name; the robot can then be used with either",
        )),
    }
}

/// The description with other heads.
fn with_heads(opened: &Opened, heads: &[PanTiltHead; 2]) -> Result<Description, WriteError> {
    Side::BOTH.into_iter().zip(heads).try_fold(
        opened.description.clone(),
        |before, (side, head)| {
            before.with_chain("base", &opened.config.head(side).optical_frame, &head.chain)
        },
    )
}

fn cannot_write(path: &Path, error: &dyn std::fmt::Display) -> Failure {
    Failure::failed(
        format!("cannot write {}: {error}", path.display()),
        "choose a file that you may write; the URDF must be plain, without macros",
    )
}

/// Writes URDF and configuration.
fn write(args: &Calibrate, opened: &Opened, calibration: &Calibration) -> Result<(), Failure> {
    let failed = |error: &dyn std::fmt::Display| cannot_write(&args.out, error);
    let description = with_heads(opened, &calibration.heads).map_err(|e| failed(&e))?;
    let urdf = args.out.with_extension("urdf");
    let text = std::fs::read_to_string(&args.config).map_err(|e| failed(&e))?;
    let mut table: toml::Table = text.parse().map_err(|e| failed(&e))?;
    let name = urdf.file_name().unwrap_or_default().to_string_lossy().into_owned();
    table.insert("robot".into(), name.into());
    let ahead = ahead(calibration, 1.0);
    let zero_sd = calibration.zero_sigma(&ahead);
    for (side, head) in Side::BOTH.into_iter().zip(&calibration.heads) {
        let Some(toml::Value::Table(wiring)) = table.get_mut(side.name()) else { continue };
        // Where nothing can be said what was stated stays.
        if let Some(zero_sd) = zero_sd {
            wiring.insert("zero_sd_deg".into(), zero_sd.to_degrees().into());
        }
        if let Some(toml::Value::Table(camera)) = wiring.get_mut("camera") {
            set_lens(camera, head);
        }
    }
    if opened.simulator().is_some() {
        // The simulated head stays as it was built, whatever is now believed of it.
        let built = built_from(&args.config, &args.out).map_err(|e| failed(&e))?;
        let built = toml::Value::String(built.to_string_lossy().into_owned());
        table.insert("sim".into(), toml::Table::from_iter([(BUILT.to_owned(), built)]).into());
    }
    let text = toml::to_string(&table).map_err(|e| failed(&e))?;
    let header = "# Written by `vergence calibrate`.\n";
    std::fs::write(&urdf, &description.text)
        .and_then(|()| std::fs::write(&args.out, format!("{header}{text}")))
        .map_err(|e| failed(&e))
}

/// The path of the configuration that was read, from that of the one that is written.
fn built_from(read: &Path, written: &Path) -> std::io::Result<PathBuf> {
    let folder = |path: &Path| {
        let folder = path.parent().filter(|f| !f.as_os_str().is_empty());
        std::fs::canonicalize(folder.unwrap_or(Path::new(".")))
    };
    let name = read.file_name().unwrap_or_default();
    match folder(read)? {
        here if here == folder(written)? => Ok(name.into()),
        other => Ok(other.join(name)),
    }
}

fn set_lens(table: &mut toml::Table, head: &PanTiltHead) {
    let camera = &head.camera;
    for (key, value) in [("fx", camera.fx), ("fy", camera.fy), ("cx", camera.cx), ("cy", camera.cy)]
    {
        table.insert(key.into(), value.into());
    }
    let d = camera.distortion;
    let distortion = [d.k1, d.k2, d.p1, d.p2, d.k3].map(toml::Value::from);
    table.insert("distortion".into(), toml::Value::Array(distortion.into()));
}

fn print(args: &Calibrate, outcome: &Outcome) -> Result<(), Failure> {
    if args.json {
        return crate::output::json(outcome);
    }
    outln!(
        "{} places, {} and {} sightings, {} looks without the light",
        outcome.places,
        outcome.sightings[0],
        outcome.sightings[1],
        outcome.missed
    );
    match (&outcome.figures, &outcome.reason) {
        (Some(figures), _) => {
            outln!("residual {:.2} px rms", figures.rms_px);
            for at in &figures.distance_95 {
                outln!(
                    "distance {:.1} m: right to {:.1} mm with 95 % (calibration alone)",
                    at.distance,
                    1e3 * at.error
                );
            }
            outln!("written: {0}; try `vergence find OBJECT --config {0}`", args.out.display());
        }
        (None, reason) => {
            outln!("not calibrated: {}", reason.as_deref().unwrap_or("unknown reason"));
        }
    }
    Ok(())
}
