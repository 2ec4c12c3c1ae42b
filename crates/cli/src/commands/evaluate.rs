//! `vergence evaluate head`: how accurate and how fast the head is, in simulation; `vergence evaluate
//! equation`: equation (1) of the paper over the workspace; `vergence evaluate pose`: the pose
//! recogniser on simulated stereo pairs.

mod pose;

use clap::{Args as ClapArgs, Subcommand, ValueEnum};
use serde_json::json;
use vergence_head::evaluation::{
    EvaluationConfig, LightSource, SERVO_KINDS, ServoFigures, Timing, equation_errors,
    evaluate_kind, time_to_fixation,
};

use vergence_head::ReaimConfig;

use crate::failure::Failure;
use crate::output::{outln, rounded};

/// What to evaluate.
#[derive(ClapArgs)]
pub struct Evaluate {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Distance error before and after self-calibration, its predicted error, and time to fixation.
    Head(Head),
    /// Accuracy, honesty and time of the pose recogniser.
    Pose(pose::Pose),
    /// Error of the paper's equation (1) over the workspace, free of noise.
    Equation {
        /// Print one JSON document.
        #[arg(long)]
        json: bool,
    },
}

#[derive(ClapArgs)]
struct Head {
    /// New lights whose distance is measured.
    #[arg(long, default_value_t = EvaluationConfig::default().placements)]
    placements: usize,
    /// Heads that are drawn and calibrated.
    #[arg(long, default_value_t = EvaluationConfig::default().heads)]
    heads: usize,
    /// Most re-aims of one measurement, a find's when left out.
    #[arg(long, default_value_t = EvaluationConfig::default().reaim.most)]
    aims: usize,
    /// Places of the light for the calibration.
    #[arg(long, default_value_t = EvaluationConfig::default().places)]
    places: usize,
    /// How the light of the calibration is moved.
    #[arg(long, value_enum, default_value_t = Light::Ruler)]
    light: Light,
    /// Seed.
    #[arg(long, default_value_t = EvaluationConfig::default().seed)]
    seed: u64,
    /// Print one JSON document.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Light {
    /// By hand, pairs of places 0.5 m apart.
    Ruler,
    /// By the arm, places known to 0.5 mm.
    Arm,
}

/// Runs the command.
pub fn run(args: Evaluate) -> Result<bool, Failure> {
    match args.what {
        What::Head(args) => run_head(&args),
        What::Pose(args) => pose::run(&args),
        What::Equation { json } => {
            run_equation(json);
            Ok(true)
        }
    }
}

fn run_equation(json: bool) {
    let errors = equation_errors(EvaluationConfig::default().baseline);
    if json {
        let rows: Vec<_> = errors
            .iter()
            .map(|e| {
                json!({
                    "distance": e.distance,
                    "bearing": e.bearing,
                    "slope": e.slope,
                    "relative_error_ideal": e.ideal,
                    "relative_error_real": e.real,
                })
            })
            .collect();
        outln!("{}", json!({ "errors": rows }));
        return;
    }
    outln!("distance [m]  slope  bearing   error, ideal head   with lever arms");
    let percent = |e: Option<f64>| match e.map(|e| rounded(100.0 * e, 2)) {
        None => "none".into(),
        Some(0.0) => "0.00 %".into(),
        Some(e) => format!("{e:+.2} %"),
    };
    for e in errors {
        outln!(
            "{:>12.1}{:>7.0}{:>9.0}{:>20}{:>18}",
            e.distance,
            e.slope.to_degrees(),
            e.bearing.to_degrees(),
            percent(e.ideal),
            percent(e.real)
        );
    }
}

fn run_head(args: &Head) -> Result<bool, Failure> {
    for (name, value) in [
        ("placements", args.placements),
        ("heads", args.heads),
        ("aims", args.aims),
        ("places", args.places),
    ] {
        if value == 0 || value > 100_000 {
            return Err(Failure::misuse(
                format!("--{name} {value} is not between 1 and 100000"),
                "give a number in that range",
            ));
        }
    }
    let defaults = EvaluationConfig::default();
    let config = EvaluationConfig {
        placements: args.placements,
        heads: args.heads,
        reaim: ReaimConfig { most: args.aims, ..defaults.reaim },
        places: args.places,
        light: match args.light {
            Light::Ruler => LightSource::Ruler,
            Light::Arm => LightSource::Arm,
        },
        seed: args.seed,
        ..defaults
    };
    let mut figures = Vec::new();
    for kind in &SERVO_KINDS {
        eprintln!("calibrating {} heads with servos of {}", config.heads, kind.name);
        figures.push(evaluate_kind(kind, &config));
    }
    let timing = time_to_fixation(config.placements.min(100), config.baseline, config.seed);
    if args.json {
        outln!("{}", document(&config, &figures, &timing));
    } else {
        print_table(&config, &figures, &timing);
    }
    Ok(true)
}

fn document(
    config: &EvaluationConfig,
    figures: &[ServoFigures],
    timing: &Timing,
) -> serde_json::Value {
    let servos: Vec<_> = figures
        .iter()
        .map(|f| {
            json!({
                "name": f.kind.name,
                "step": f.kind.step,
                "backlash": f.kind.backlash,
                "depth_rms_m": {
                    "before": f.depth_rms_before,
                    "after": f.depth_rms_after,
                    "after_patient": f.depth_rms_patient,
                    "after_single_fixation": f.depth_rms_single,
                },
                "mean_aims": f.mean_aims,
                "refused_before": f.refused_before,
                "held_out_rms_px": f.held_out_rms_px,
                "held_out_again_rms_px": f.held_out_again_rms_px,
                "model_rms_px": f.model_rms_px,
                "calibration_coverage": f.coverage,
                "coverage_trials": config.trials,
                "refused_trials": f.refused_trials,
                "refused_calibrations": f.refused_calibrations,
            })
        })
        .collect();
    json!({
        "placements": config.placements,
        "heads": config.heads,
        "aims": config.reaim.most,
        "patient_aims": config.patient_aims,
        "baseline": config.baseline,
        "distance": config.distance,
        "seed": config.seed,
        "servos": servos,
        "time_ratio_median": timing.ratio_last_seen,
        "time_ratio_median_in_sight": timing.ratio_in_sight,
        "time_ratio_median_anywhere": timing.ratio_anywhere,
        "time_median_anywhere": timing.seconds_anywhere,
        "not_found": timing.not_found,
    })
}

fn print_table(config: &EvaluationConfig, figures: &[ServoFigures], timing: &Timing) {
    outln!(
        "{} lights {} m away, baseline {} m, {} heads off by up to 3 degrees, 10 mm, 10 %",
        config.placements,
        config.distance,
        config.baseline,
        config.heads
    );
    outln!("{:<38}{:>16}{:>28}", "", figures[0].kind.name, figures[1].kind.name);
    let row = |name: &str, unit: &str, value: &dyn Fn(&ServoFigures) -> f64| {
        let label = format!("{name} [{unit}]");
        outln!("{label:<38}{:>16.2}{:>28.2}", value(&figures[0]), value(&figures[1]));
    };
    row("distance error before, rms", "mm", &|f| 1e3 * f.depth_rms_before);
    row("  calibrated, one fixation", "mm", &|f| 1e3 * f.depth_rms_single);
    row("  calibrated, re-aims of a find", "mm", &|f| 1e3 * f.depth_rms_after);
    row("  how many re-aims those were", "mean", &|f| f.mean_aims);
    let patient = format!("  calibrated, {} re-aims", config.patient_aims);
    row(&patient, "mm", &|f| 1e3 * f.depth_rms_patient);
    row("prediction of held-out views, rms", "px", &|f| f.held_out_rms_px);
    row("  angles by the re-aims of a find", "px", &|f| f.held_out_again_rms_px);
    row("  without encoder and pixel noise", "px", &|f| f.model_rms_px);
    let trials = format!("within the predicted 95 %, {} heads", config.trials);
    row(&trials, "%", &|f| 100.0 * f.coverage);
    row("calibrations refused", "of all", &|f| f.refused_calibrations as f64);
    outln!(
        "time to fixation over (slew + code), median: {:.2} last seen within 0.1 m, {:.2} in sight, \
         {:.2} anywhere ({:.1} s)",
        timing.ratio_last_seen,
        timing.ratio_in_sight,
        timing.ratio_anywhere,
        timing.seconds_anywhere
    );
}
