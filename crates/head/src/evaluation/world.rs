//! The simulated truth behind the figures: a head that differs from its description, its servos, and
//! what is seen.

use nalgebra::{Matrix2, Point2, Point3, Vector2, Vector3};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_geometry::{Camera, Chain, Joint, Limits, Transform, optical_from_body};

use crate::calibration::{
    Calibration, HEAD_UNKNOWNS, HeadVector, KnownLength, LightPlace, apply, middle,
};
use crate::triangulation::nearest_to_rays;
use crate::{
    Fixation, Fixator, FixatorConfig, Landmark, NextMove, Noise, PanTiltHead, Reaim, ReaimConfig,
    bounded, triangulate,
};

use super::{EvaluationConfig, LightSource, ServoKind, Sums};

/// What a find takes for unknown of the slack once it lies on one side, as a part of the stated slack.
const OWN_SLACK_SIGMA: f64 = 0.072;

/// A true head and what is believed of it.
pub(super) struct World {
    truth: [PanTiltHead; 2],
    pub(super) nominal: [PanTiltHead; 2],
    kind: ServoKind,
    pixel_sigma: f64,
}

/// What a calibration is given, and where its lights really are.
#[derive(Default)]
pub(super) struct Session {
    lights: Vec<Point3<f64>>,
    pub(super) places: Vec<LightPlace>,
    pub(super) lengths: Vec<KnownLength>,
}

/// One servo pair: told angles, true angles.
struct Servos {
    told: [f64; 2],
    shaft: [f64; 2],
}

impl World {
    pub(super) fn draw(
        kind: &ServoKind,
        config: &EvaluationConfig,
        random: &mut Pcg64Mcg,
    ) -> World {
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
    pub(super) fn new_light(&self, distance: f64, random: &mut Pcg64Mcg) -> Point3<f64> {
        let pan: f64 = random.random_range(-0.5..0.5);
        let tilt: f64 = random.random_range(-0.1..0.6);
        let direction = Vector3::new(tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), -tilt.sin());
        middle(&self.truth) + direction * distance
    }

    /// What the calibration is given: the light at some places, seen by each head from angles that
    /// bring it all over the picture. The places are known from the arm, or pairs of them are a ruler's
    /// length apart.
    pub(super) fn session(&self, config: &EvaluationConfig, random: &mut Pcg64Mcg) -> Session {
        const ARM: f64 = 0.0005;
        const RULER: (f64, f64) = (0.5, 0.0003);
        let mut session = Session::default();
        for pair in 0..config.places.div_ceil(2) {
            let distance = random.random_range(0.6..1.5);
            let first = self.new_light(distance, random);
            // Along a table's edge: sideways and a little to the back.
            let turn: f64 = random.random_range(-0.7..0.7);
            let second = first + Vector3::new(turn.sin(), turn.cos(), 0.0) * RULER.0;
            let length = RULER.0 + RULER.1 * normal(random);
            if config.light == LightSource::Ruler {
                session.lengths.push(KnownLength {
                    places: [2 * pair, 2 * pair + 1],
                    length,
                    sigma: RULER.1,
                });
            }
            for light in [first, second] {
                let fixations =
                    [0, 1].map(|k| self.look_around(k, &light, config.views, [0.35, 0.25], random));
                let known = (config.light == LightSource::Arm).then(|| {
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
        (0..views)
            .filter_map(|_| {
                let servos = self.turned_by(k, light, reach, random);
                self.sight(k, light, &servos, random)
            })
            .collect()
    }

    /// The servos turned from looking at a light to anywhere within `reach`.
    fn turned_by(
        &self,
        k: usize,
        light: &Point3<f64>,
        reach: [f64; 2],
        random: &mut Pcg64Mcg,
    ) -> Servos {
        let centre = self.truth[k].aim_at(light);
        let goal = [0, 1].map(|j| centre[j] + reach[j] * random.random_range(-1.0..1.0));
        let mut servos = Servos::at(centre);
        servos.arrive(self.truth[k].clamp(goal), &self.kind, random);
        servos
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

    /// Fixates a light as the robot would.
    fn fixate(
        &self,
        k: usize,
        believed: &PanTiltHead,
        light: &Point3<f64>,
        random: &mut Pcg64Mcg,
    ) -> Servos {
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
        servos
    }

    /// Aims at a light again and again, as a find does.
    fn reaim<'h>(
        &self,
        believed: &'h [PanTiltHead; 2],
        light: &Point3<f64>,
        mut servos: [Servos; 2],
        config: ReaimConfig,
        random: &mut Pcg64Mcg,
    ) -> Reaim<'h> {
        let common_sigma = OWN_SLACK_SIGMA * self.kind.backlash;
        let noise = Noise { common_sigma, ..Noise::of_servo(self.kind.step, 0.0) };
        let centre = [0, 1].map(|k| servos[k].told);
        let mut reaim = Reaim::new(believed, centre, [self.kind.step; 2], noise, config);
        let below = reaim.run_up([self.kind.backlash; 2]);
        (0..2).for_each(|k| servos[k].go(below[k], &self.kind, random));
        // A light that got no distance has none with more aims either.
        while let Ok(Some(goals)) = reaim.next_aim() {
            for k in 0..2 {
                servos[k].go(goals[k], &self.kind, random);
                if let Some(fixation) = self.sight(k, light, &servos[k], random) {
                    reaim.add(k, fixation);
                }
            }
        }
        reaim
    }

    /// Distances of one new light, before and after calibration.
    pub(super) fn measure(
        &self,
        light: &Point3<f64>,
        calibration: &Calibration,
        config: &EvaluationConfig,
        random: &mut Pcg64Mcg,
        sums: &mut Sums,
    ) {
        let true_distance = (light - middle(&self.truth)).norm();
        let raw = [0, 1].map(|k| {
            let servos = self.fixate(k, &self.nominal[k], light, random);
            self.sight(k, light, &servos, random)
        });
        match self.described_distance(&raw) {
            Some(distance) => sums.before.push(distance - true_distance),
            None => {
                sums.refused_before += 1;
                sums.before.push(true_distance);
            }
        }
        let heads = &calibration.heads;
        let from = middle(heads);
        let error = |landmark: Option<Landmark>| {
            landmark.map_or(true_distance, |l| (l.point.position - from).norm() - true_distance)
        };
        let servos = [0, 1].map(|k| self.fixate(k, &heads[k], light, random));
        let single = [0, 1].map(|k| self.sight(k, light, &servos[k], random));
        let noise = Noise::of_servo(self.kind.step, self.kind.backlash);
        sums.single.push(error(match single {
            [Some(left), Some(right)] => triangulate(heads, &[left, right], &noise).ok(),
            _ => None,
        }));
        let found = self.reaim(heads, light, servos, config.reaim, random);
        sums.after.push(error(found.landmark().ok().flatten()));
        sums.aims.push(found.aims() as f64);
        let patience = ReaimConfig { depth_sigma: 0.0, least_gain: 0.0, most: config.patient_aims };
        let servos = [0, 1].map(|k| self.fixate(k, &heads[k], light, random));
        let patient = self.reaim(heads, light, servos, patience, random);
        sums.patient.push(error(patient.landmark().ok().flatten()));
    }

    /// Distance by the description, from the point nearest to both rays; `None` when that is behind.
    fn described_distance(&self, seen: &[Option<Fixation>; 2]) -> Option<f64> {
        let ray = |k: usize| seen[k].map(|f| self.nominal[k].ray(f.angles, &f.pixel));
        let rays = [ray(0)?, ray(1)?];
        let off = nearest_to_rays(&rays)? - middle(&self.nominal);
        (off.dot(&rays[0].direction) > 0.0).then(|| off.norm())
    }

    /// Distance error of noise-free sightings against what the calibration predicts of itself.
    pub(super) fn cover(&self, light: &Point3<f64>, calibration: &Calibration, sums: &mut Sums) {
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

    /// Predicts sightings of the calibration's lights from new angles of all joints: a single one, and
    /// what the re-aims of a find make of the angles there.
    pub(super) fn hold_out(
        &self,
        session: &Session,
        calibration: &Calibration,
        config: &EvaluationConfig,
        random: &mut Pcg64Mcg,
        sums: &mut Sums,
    ) {
        const POSES: usize = 4;
        let (heads, reach) = (&calibration.heads, [0.35, 0.25]);
        let step_sigma = Noise::of_servo(self.kind.step, 0.0).step_sigma;
        for (light, found) in session.lights.iter().zip(&calibration.lights) {
            for _ in 0..POSES {
                let servos = [0, 1].map(|k| self.turned_by(k, light, reach, random));
                for k in 0..2 {
                    let Some(seen) = self.sight(k, light, &servos[k], random) else { continue };
                    let Some(predicted) = heads[k].project(seen.angles, found) else { continue };
                    let off = predicted - seen.pixel;
                    sums.held_out.extend([off.x, off.y]);
                    let shaft = seen.angles.map(|a| a - self.kind.backlash / 2.0);
                    if let Some(real) = self.truth[k].project(shaft, light) {
                        let off = predicted - real;
                        sums.model.extend([off.x, off.y]);
                    }
                }
                let again = self.reaim(heads, light, servos, config.reaim, random);
                for k in 0..2 {
                    let seen = bounded::combine(&heads[k], &again.seen()[k], step_sigma, found);
                    let Some(seen) = seen else { continue };
                    let Some(predicted) = heads[k].project(seen.angles, found) else { continue };
                    let off = predicted - seen.pixel;
                    sums.held_out_again.extend([off.x, off.y]);
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

/// The heads as described, left and right of the middle.
pub(super) fn described_heads(baseline: f64) -> [PanTiltHead; 2] {
    [baseline / 2.0, -baseline / 2.0].map(described_head)
}

/// A head as described: lever arms of some centimetres, 320x240 pixels, 0.5 m above base; `y` is the
/// place of its pan axis in base.
pub(crate) fn described_head(y: f64) -> PanTiltHead {
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
}

/// A standard normal number (Box-Muller).
fn normal(random: &mut Pcg64Mcg) -> f64 {
    let radius = (-2.0 * random.random_range(f64::MIN_POSITIVE..1.0).ln()).sqrt();
    radius * (std::f64::consts::TAU * random.random::<f64>()).cos()
}
