//! How accurate the head is, measured in simulation: the figures of `vergence evaluate head`.
//!
//! A head is drawn whose true geometry differs from its description (up to 3 degrees, 10 mm, 10 % of
//! focal length, evenly). Its servos round to their step, rest anywhere within it, and lag by their
//! backlash. It is calibrated from a light at unknown places of which some are a known length apart,
//! then asked how far new lights are, before and after. Only angles as encoders tell them and noisy
//! pixels reach the mathematics.

use nalgebra::{Matrix2, Point2, Point3, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vergence_geometry::{Camera, Chain, Joint, Limits, Ray, Transform, optical_from_body};

use crate::calibration::{
    Calibration, CalibrationConfig, HEAD_UNKNOWNS, HeadVector, KnownLength, LightPlace, apply,
    calibrate, middle,
};
use crate::triangulation::nearest_to_rays;
use crate::{
    Fixation, Fixator, FixatorConfig, NextMove, Noise, PanTiltHead, dither, triangulate_many,
};

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
    /// Re-aims per head over which a measurement averages.
    pub aims: usize,
    /// Centroid noise (px, one sigma, per coordinate).
    pub pixel_sigma: f64,
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
            aims: 64,
            pixel_sigma: 0.1,
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
    /// Distance error (m, rms) after calibration, `aims` fixations a head.
    pub depth_rms_after: f64,
    /// Prediction of held-out sightings with all four joints moving (px, rms over both coordinates),
    /// encoder and centroid noise included.
    pub held_out_rms_px: f64,
    /// The same against the true projection: the calibration's own error.
    pub model_rms_px: f64,
    /// Part of the lights whose distance error, free of measurement noise, lies within the predicted
    /// 95 % interval.
    pub coverage: f64,
    /// Heads that the calibration refused.
    pub refused_calibrations: usize,
}

/// A true head and what is believed of it.
struct World {
    truth: [PanTiltHead; 2],
    nominal: [PanTiltHead; 2],
    kind: ServoKind,
    pixel_sigma: f64,
}

/// What a calibration is given, and where its lights really are.
#[derive(Default)]
struct Session {
    lights: Vec<Point3<f64>>,
    places: Vec<LightPlace>,
    lengths: Vec<KnownLength>,
}

/// One servo pair: told angles, true angles.
struct Servos {
    told: [f64; 2],
    shaft: [f64; 2],
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
    for h in 0..heads {
        let world = World::draw(kind, config, &mut random);
        let session = world.session(config.light, &mut random);
        let settings = CalibrationConfig {
            noise: Noise::of_servo(kind.step, 0.0),
            ..CalibrationConfig::default()
        };
        let calibration = calibrate(&world.nominal, &session.places, &session.lengths, &settings);
        let share = config.placements / heads + usize::from(h < config.placements % heads);
        if let Err(e) = &calibration {}
        let Ok(calibration) = calibration else {
            sums.refused_calibrations += 1;
            continue;
        };
        world.hold_out(&session, &calibration, &mut random, &mut sums);
        for _ in 0..share {
            let light = world.new_light(config.distance, &mut random);
            world.measure(&light, &calibration, config, &mut random, &mut sums);
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
    covered: Vec<f64>,
    held_out: Vec<f64>,
    model: Vec<f64>,
    refused_calibrations: usize,
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
            held_out_rms_px: rms(&self.held_out),
            model_rms_px: rms(&self.model),
            coverage: mean(&self.covered),
            refused_calibrations: self.refused_calibrations,
        }
    }
}

impl World {
    fn draw(kind: &ServoKind, config: &EvaluationConfig, random: &mut Pcg64Mcg) -> World {
        let nominal = described_heads(config.baseline);
        let truth = [0, 1].map(|k| {
            let mut change = HeadVector::zeros();
            for i in 0..HEAD_UNKNOWNS {
                let bound = match i {
                    0..18 if i % 6 < 3 => 3f64.to_radians(),
                    0..18 => 0.010,
                    18 => 0.10,
                    19 | 20 => 5.0,
                    _ => 0.05,
                };
                change[i] = random.random_range(-bound..bound);
            }
            apply(&nominal[k], &change)
        });
        World { truth, nominal, kind: *kind, pixel_sigma: config.pixel_sigma }
    }

    /// A light this far from the middle of the true head, within easy reach.
    fn new_light(&self, distance: f64, random: &mut Pcg64Mcg) -> Point3<f64> {
        let pan: f64 = random.random_range(-0.5..0.5);
        let tilt: f64 = random.random_range(-0.1..0.6);
        let direction = Vector3::new(tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), -tilt.sin());
        middle(&self.truth) + direction * distance
    }

    /// What the calibration is given: a light at 20 places, pairs of which are 0.4 m apart by a ruler
    /// that is read to 0.3 mm; at every place each head looks at it and twelve times past it.
    fn session(&self, source: LightSource, random: &mut Pcg64Mcg) -> Session {
        const PAIRS: usize = 12;
        const VIEWS: usize = 48;
        const ARM: f64 = 0.0005;
        const RULER: (f64, f64) = (0.5, 0.0003);
        let mut session = Session::default();
        for pair in 0..PAIRS {
            let distance = random.random_range(0.6..1.5);
            let first = self.new_light(distance, random);
            // Along a table's edge: sideways and a little to the back.
            let turn: f64 = random.random_range(-0.7..0.7);
            let second = first + Vector3::new(turn.sin(), turn.cos(), 0.0) * RULER.0;
            let length = RULER.0 + RULER.1 * normal(random);
            if source == LightSource::Ruler {
                session.lengths.push(KnownLength {
                    places: [2 * pair, 2 * pair + 1],
                    length,
                    sigma: RULER.1,
                });
            }
            for light in [first, second] {
                let fixations =
                    [0, 1].map(|k| self.look_around(k, &light, VIEWS, [0.35, 0.25], random));
                let known = (source == LightSource::Arm).then(|| {
                    let shake = Vector3::from_fn(|_, _| normal(random)) * ARM;
                    (light + shake, ARM)
                });
                session.places.push(LightPlace { fixations, known });
                session.lights.push(light);
            }
        }
        session
    }

    /// Sightings of a light from angles spread evenly within `reach` of looking at it.
    fn look_around(
        &self,
        k: usize,
        light: &Point3<f64>,
        views: usize,
        reach: [f64; 2],
        random: &mut Pcg64Mcg,
    ) -> Vec<Fixation> {
        let centre = self.truth[k].aim_at(light);
        let mut servos = Servos::at(centre);
        (0..views)
            .filter_map(|_| {
                let goal = [0, 1].map(|j| centre[j] + reach[j] * random.random_range(-1.0..1.0));
                servos.arrive(self.truth[k].clamp(goal), &self.kind, random);
                self.sight(k, light, &servos, random)
            })
            .collect()
    }

    /// What is seen of a light where the servos stand: told angles, noisy pixel.
    fn sight(
        &self,
        k: usize,
        light: &Point3<f64>,
        servos: &Servos,
        random: &mut Pcg64Mcg,
    ) -> Option<Fixation> {
        let pixel = self.truth[k].project(servos.shaft, light)?;
        if !self.truth[k].camera.contains(&pixel, 4.0) {
            return None;
        }
        let shake = Vector2::new(normal(random), normal(random)) * self.pixel_sigma;
        Some(Fixation {
            angles: servos.told,
            pixel: pixel + shake,
            pixel_covariance: Matrix2::identity() * self.pixel_sigma.powi(2),
        })
    }

    /// Fixates a light as the robot would, then re-aims around it.
    fn fixate(
        &self,
        k: usize,
        believed: &PanTiltHead,
        light: &Point3<f64>,
        aims: usize,
        random: &mut Pcg64Mcg,
    ) -> Vec<Fixation> {
        let mut start = self.truth[k].aim_at(light);
        start =
            [start[0] + random.random_range(-0.2..0.2), start[1] + random.random_range(-0.2..0.2)];
        let mut servos = Servos::at(self.truth[k].clamp(start));
        servos.arrive(servos.told, &self.kind, random);
        let mut fixator = Fixator::new(FixatorConfig {
            resolution: self.kind.step,
            backlash: self.kind.backlash,
            ..FixatorConfig::default()
        });
        while let Some(seen) = self.sight(k, light, &servos, random) {
            match fixator.next(believed, servos.told, &seen.pixel, None) {
                NextMove::Hold => break,
                NextMove::Go { via, goal } => {
                    via.into_iter().for_each(|v| servos.go(v, &self.kind, random));
                    servos.go(goal, &self.kind, random);
                }
            }
        }
        // Far enough apart that every aim falls into another part of a step.
        let reach = 6.0 * self.kind.step;
        dither(servos.told, reach, aims)
            .into_iter()
            .filter_map(|goal| {
                servos.arrive(goal, &self.kind, random);
                self.sight(k, light, &servos, random)
            })
            .collect()
    }

    /// Distances of one new light, before and after calibration.
    fn measure(
        &self,
        light: &Point3<f64>,
        calibration: &Calibration,
        config: &EvaluationConfig,
        random: &mut Pcg64Mcg,
        sums: &mut Sums,
    ) {
        let true_distance = (light - middle(&self.truth)).norm();
        let raw = [0, 1].map(|k| self.fixate(k, &self.nominal[k], light, config.aims, random));
        match self.described_distance(&raw) {
            Some(distance) => sums.before.push(distance - true_distance),
            None => {
                sums.refused_before += 1;
                sums.before.push(true_distance);
            }
        }
        let heads = &calibration.heads;
        let noise = Noise { common_sigma: 5e-4, ..Noise::of_servo(self.kind.step, 0.0) };
        let seen = [0, 1].map(|k| self.fixate(k, &heads[k], light, config.aims, random));
        let [left, right] = &seen;
        let error = |left: &[Fixation], right: &[Fixation]| {
            triangulate_many(heads, [left, right], &noise).map_or(true_distance, |l| {
                (l.point.position - middle(heads)).norm() - true_distance
            })
        };
        sums.after.push(error(left, right));
        if let (Some(a), Some(b)) = (left.first(), right.first()) {
            sums.single.push(error(&[*a], &[*b]));
        }
        self.cover(light, calibration, sums);
    }

    /// Distance by the description, from the point nearest to all rays; `None` when that is behind.
    fn described_distance(&self, seen: &[Vec<Fixation>; 2]) -> Option<f64> {
        let rays: Vec<Ray> = (0..2)
            .flat_map(|k| seen[k].iter().map(move |f| (k, f)))
            .map(|(k, f)| self.nominal[k].ray(f.angles, &f.pixel))
            .collect();
        let off = nearest_to_rays(&rays)? - middle(&self.nominal);
        (off.dot(&rays[0].direction) > 0.0).then(|| off.norm())
    }

    /// Distance error of noise-free sightings against what the calibration predicts of itself.
    fn cover(&self, light: &Point3<f64>, calibration: &Calibration, sums: &mut Sums) {
        let slack = self.kind.backlash / 2.0;
        let rays = [0, 1].map(|k| {
            // The slack from one side is part of the calibrated zero: encoders tell more by half.
            let shaft = self.truth[k].aim_at(light);
            let told = shaft.map(|a| a + slack);
            let pixel = self.truth[k].project(shaft, light).unwrap_or_else(Point2::origin);
            calibration.heads[k].ray(told, &pixel)
        });
        let Some(point) = nearest_to_rays(&rays) else { return };
        let error =
            (point - middle(&calibration.heads)).norm() - (light - middle(&self.truth)).norm();
        let Some(sigma) = calibration.distance_sigma(&point) else { return };
        sums.covered.push(f64::from(u8::from(error.abs() <= 1.96 * sigma)));
    }

    /// Predicts sightings of the calibration's lights from new angles of all joints.
    fn hold_out(
        &self,
        session: &Session,
        calibration: &Calibration,
        random: &mut Pcg64Mcg,
        sums: &mut Sums,
    ) {
        for (light, found) in session.lights.iter().zip(&calibration.lights) {
            for k in 0..2 {
                for seen in self.look_around(k, light, 4, [0.35, 0.25], random) {
                    let predicted = calibration.heads[k].project(seen.angles, found);
                    let Some(predicted) = predicted else { continue };
                    let off = predicted - seen.pixel;
                    if off.norm() > 5.0 {
                        eprintln!(
                            session
                                .places
                                .iter()
                                .map(|p| [p.fixations[0].len(), p.fixations[1].len()])
                                .collect::<Vec<_>>()
                        );
                    }
                    sums.held_out.extend([off.x, off.y]);
                    let slack = self.kind.backlash / 2.0;
                    let shaft = seen.angles.map(|a| a - slack);
                    if let Some(real) = self.truth[k].project(shaft, light) {
                        let off = predicted - real;
                        sums.model.extend([off.x, off.y]);
                    }
                }
            }
        }
    }
}

impl Servos {
    fn at(angles: [f64; 2]) -> Self {
        Servos { told: angles, shaft: angles }
    }

    /// A move: the motor rests anywhere within the step that the encoder tells, the shaft follows it
    /// once the slack is taken up.
    fn go(&mut self, goal: [f64; 2], kind: &ServoKind, random: &mut Pcg64Mcg) {
        for j in 0..2 {
            self.told[j] = (goal[j] / kind.step).round() * kind.step;
            let motor = self.told[j] + kind.step * random.random_range(-0.5..0.5);
            let half = kind.backlash / 2.0;
            self.shaft[j] = self.shaft[j].clamp(motor - half, motor + half);
        }
    }

    /// A move that ends upwards in both joints.
    fn arrive(&mut self, goal: [f64; 2], kind: &ServoKind, random: &mut Pcg64Mcg) {
        if kind.backlash > 0.0 {
            self.go(goal.map(|g| g - 1.5 * kind.backlash), kind, random);
        }
        self.go(goal, kind, random);
    }
}

/// The head as described: lever arms of some centimetres, 320x240 pixels, 0.5 m above base.
fn described_heads(baseline: f64) -> [PanTiltHead; 2] {
    [baseline / 2.0, -baseline / 2.0].map(|y| {
        let joint = |name: &str, origin: [f64; 3], axis, lower, upper| Joint {
            name: name.into(),
            parent_from_joint: Transform::translation(origin[0], origin[1], origin[2]),
            axis,
            limits: Limits { lower, upper, velocity: 3.6 },
        };
        let chain = Chain {
            joints: vec![
                joint("pan", [0.0, y, 0.5], Vector3::z_axis(), -1.8, 1.8),
                joint("tilt", [0.012, 0.0, 0.04], Vector3::y_axis(), -0.8, 1.2),
            ],
            last_from_tip: Transform::from_parts(
                [0.025, 0.0, 0.015].into(),
                optical_from_body().inverse(),
            ),
        };
        PanTiltHead { chain, camera: Camera::centred(320, 240, 300.0) }
    })
}

/// A standard normal number (Box-Muller).
fn normal(random: &mut Pcg64Mcg) -> f64 {
    let radius = (-2.0 * random.random_range(f64::MIN_POSITIVE..1.0).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}
