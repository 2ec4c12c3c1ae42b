//! How accurate the head is, measured in simulation: the figures of `vergence evaluate head`.
//!
//! A head is drawn whose true geometry differs from its description (up to 3 degrees, 10 mm, 10 % of
//! focal length, evenly). Its servos round to their step, rest anywhere within it, and lag by their
//! backlash. It is calibrated from a light at unknown places of which some are a known length apart,
//! then asked how far new lights are, before and after. Only angles as encoders tell them and noisy
//! pixels reach the mathematics.

mod equation;
mod timing;
mod world;

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use crate::calibration::{CalibrationConfig, calibrate};
use crate::{Noise, ReaimConfig};
pub use equation::{EquationError, equation_errors};
pub use timing::{Timing, time_to_fixation};
use world::World;
#[cfg(test)]
pub(crate) use world::described_head;

/// A servo as a maker describes it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ServoKind {
    /// Name in the table.
    pub name: &'static str,
    /// Step of moves and encoder (rad).
    pub step: f64,
    /// Slack of the gears (rad).
    pub backlash: f64,
}

/// The paper's servos, and today's with the backlash that their maker states.
pub const SERVO_KINDS: [ServoKind; 2] = [
    ServoKind { name: "0.35 degree", step: 0.35 * std::f64::consts::PI / 180.0, backlash: 0.0 },
    ServoKind {
        name: "12 bit, 15 arcmin backlash",
        step: std::f64::consts::TAU / 4096.0,
        backlash: 0.25 * std::f64::consts::PI / 180.0,
    },
];

/// What the calibration knows of the light that it is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LightSource {
    /// Moved by hand: unknown places, pairs of which are 0.5 m apart by a ruler read to 0.3 mm.
    Ruler,
    /// Held by the arm: places in base known to 0.5 mm.
    Arm,
}

/// What is evaluated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EvaluationConfig {
    /// New lights whose distance is measured.
    pub placements: usize,
    /// Heads that are drawn and calibrated; the placements are shared out among them.
    pub heads: usize,
    /// Baseline (m).
    pub baseline: f64,
    /// Distance of the lights (m).
    pub distance: f64,
    /// Re-aims of one measurement: a find's.
    pub reaim: ReaimConfig,
    /// Re-aims per head of a patient measurement.
    pub patient_aims: usize,
    /// Centroid noise (px, one sigma, per coordinate).
    pub pixel_sigma: f64,
    /// Places of the light for the calibration, in pairs.
    pub places: usize,
    /// Sightings by each head of each place: with 40 places some ten minutes of a real head's time.
    pub views: usize,
    /// Trials of the predicted error: short calibrations (20 places, 24 sightings each) of other heads.
    pub trials: usize,
    /// How the light of the calibration is moved.
    pub light: LightSource,
    /// Seed.
    pub seed: u64,
}

impl Default for EvaluationConfig {
    /// The wanted figure: 200 placements 1 m away, baseline 0.2 m.
    fn default() -> Self {
        EvaluationConfig {
            placements: 200,
            heads: 20,
            baseline: 0.2,
            distance: 1.0,
            reaim: ReaimConfig::default(),
            patient_aims: 64,
            pixel_sigma: 0.1,
            places: 40,
            views: 48,
            trials: 100,
            light: LightSource::Ruler,
            seed: 1,
        }
    }
}

/// Figures of one kind of servo.
#[derive(Debug, Clone, PartialEq)]
pub struct ServoFigures {
    /// Which.
    pub kind: ServoKind,
    /// Distance error (m, rms) with the description as it is; lights that got no distance count as an
    /// error of the whole distance.
    pub depth_rms_before: f64,
    /// Lights that got no distance from the description.
    pub refused_before: usize,
    /// Distance error (m, rms) after calibration, one fixation a head.
    pub depth_rms_single: f64,
    /// Distance error (m, rms) after calibration, with the re-aims of a find.
    pub depth_rms_after: f64,
    /// How many those were, in the mean.
    pub mean_aims: f64,
    /// Distance error (m, rms) after calibration, with the re-aims of a patient measurement.
    pub depth_rms_patient: f64,
    /// Prediction of held-out sightings with all four joints moving (px, rms over both coordinates),
    /// encoder and centroid noise included.
    pub held_out_rms_px: f64,
    /// The same with the joint angles told by the re-aims of a find instead of one encoder reading.
    pub held_out_again_rms_px: f64,
    /// The single prediction against the true projection: the calibration's own error.
    pub model_rms_px: f64,
    /// Part of the trials, each with a head and a short calibration of its own, in which the distance
    /// error, free of measurement noise, lies within the predicted 95 % interval.
    pub coverage: f64,
    /// Heads that the calibration refused.
    pub refused_calibrations: usize,
    /// Trials of the predicted error whose short calibration was refused.
    pub refused_trials: usize,
}

/// Evaluates both kinds of servo.
pub fn evaluate(config: &EvaluationConfig) -> Vec<ServoFigures> {
    SERVO_KINDS.iter().map(|kind| evaluate_kind(kind, config)).collect()
}

/// Evaluates one kind of servo.
pub fn evaluate_kind(kind: &ServoKind, config: &EvaluationConfig) -> ServoFigures {
    let mut random = Pcg64Mcg::seed_from_u64(config.seed);
    let mut sums = Sums::default();
    let heads = config.heads.clamp(1, config.placements.max(1));
    let settings = CalibrationConfig {
        noise: Noise::of_servo(kind.step, 0.0),
        ..CalibrationConfig::default()
    };
    for h in 0..heads {
        let world = World::draw(kind, config, &mut random);
        let session = world.session(config, &mut random);
        let calibration = calibrate(&world.nominal, &session.places, &session.lengths, &settings);
        let share = config.placements / heads + usize::from(h < config.placements % heads);
        let Ok(calibration) = calibration else {
            sums.refused_calibrations += 1;
            continue;
        };
        world.hold_out(&session, &calibration, config, &mut random, &mut sums);
        for _ in 0..share {
            let light = world.new_light(config.distance, &mut random);
            world.measure(&light, &calibration, config, &mut random, &mut sums);
        }
    }
    // A calibration errs alike for all lights, so every trial of its prediction has a head of its own.
    let short = EvaluationConfig { places: 20, views: 24, ..*config };
    for _ in 0..config.trials {
        let world = World::draw(kind, config, &mut random);
        let session = world.session(&short, &mut random);
        let calibrated = calibrate(&world.nominal, &session.places, &session.lengths, &settings);
        match calibrated {
            Ok(calibration) => {
                let light = world.new_light(config.distance, &mut random);
                world.cover(&light, &calibration, &mut sums);
            }
            Err(_) => sums.refused_trials += 1,
        }
    }
    sums.figures(*kind)
}

#[derive(Default)]
struct Sums {
    before: Vec<f64>,
    refused_before: usize,
    single: Vec<f64>,
    after: Vec<f64>,
    aims: Vec<f64>,
    patient: Vec<f64>,
    covered: Vec<f64>,
    held_out: Vec<f64>,
    held_out_again: Vec<f64>,
    model: Vec<f64>,
    refused_calibrations: usize,
    refused_trials: usize,
}

impl Sums {
    fn figures(&self, kind: ServoKind) -> ServoFigures {
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        let rms = |v: &[f64]| (v.iter().map(|e| e * e).sum::<f64>() / v.len().max(1) as f64).sqrt();
        ServoFigures {
            kind,
            depth_rms_before: rms(&self.before),
            refused_before: self.refused_before,
            depth_rms_single: rms(&self.single),
            depth_rms_after: rms(&self.after),
            mean_aims: mean(&self.aims),
            depth_rms_patient: rms(&self.patient),
            held_out_rms_px: rms(&self.held_out),
            held_out_again_rms_px: rms(&self.held_out_again),
            model_rms_px: rms(&self.model),
            coverage: mean(&self.covered),
            refused_calibrations: self.refused_calibrations,
            refused_trials: self.refused_trials,
        }
    }
}

#[cfg(test)]
mod tests;
