//! The bundle adjustment: Levenberg-Marquardt with priors.
//!
//! Sightings are weighed by Cauchy's rule in three rounds. A last round takes the encoders' rounding for
//! what it is, an error that lies anywhere within half a step but not outside (module `bounded`): its
//! steps are Fisher's scoring, and its information is that of the predicted error.

use nalgebra::{DMatrix, DVector, Matrix2, Point3, SMatrix, SVector, Vector2, Vector3};

use super::{BOTH, CalibrationConfig, HEAD_UNKNOWNS, HeadVector, KnownLength, LightPlace, apply};
use crate::bounded::Rounding;
use crate::{Fixation, PanTiltHead};

/// Residuals beyond this many sigmas lose weight (Cauchy's constant), in rounds: from the description
/// every sighting is far off, so at first all must count; the last is generous since encoder errors
/// are uniform, not Gaussian.
const CAUCHY: [f64; 3] = [1000.0, 30.0, 4.0];
/// Least sigma (m) of known lengths in these rounds: taken at its word while the lights are still half
/// a metre off, a length can hold a light on the wrong side of the other.
const LOOSE_LENGTH: [f64; 3] = [1.0, 0.02, 0.0];
/// A sighting that is off by more sigmas counts as wrong.
const OUTLIER: f64 = 6.0;
/// Mean chi-squared of a sighting (2 when the noise is as stated) up to which a solution explains them.
pub(super) const EXPLAINED: f64 = 4.0;
const MAX_ITERATIONS: usize = 60;

pub(super) struct Problem<'a> {
    pub nominal: &'a [PanTiltHead; 2],
    pub places: &'a [LightPlace],
    pub lengths: &'a [KnownLength],
    pub config: &'a CalibrationConfig,
}

pub(super) struct Solution {
    pub heads: [PanTiltHead; 2],
    pub lights: Vec<Point3<f64>>,
    pub covariance: DMatrix<f64>,
    pub rms_px: f64,
    pub outliers: f64,
    /// Largest change of an unknown, in sigmas of its prior, and of which head.
    pub farthest: (f64, usize),
    /// Mean of the sightings' chi-squared (two degrees of freedom), wrong ones capped.
    pub chi2_mean: f64,
}

#[derive(Clone)]
struct State {
    heads: [PanTiltHead; 2],
    /// Sum of all changes since the description, for the priors.
    moved: [HeadVector; 2],
    lights: Vec<Point3<f64>>,
}

struct Normal {
    information: DMatrix<f64>,
    gradient: DVector<f64>,
    cost: f64,
}

/// One sighting, linearised.
struct Row {
    residual: Vector2<f64>,
    by_head: SMatrix<f64, 2, HEAD_UNKNOWNS>,
    by_light: SMatrix<f64, 2, 3>,
    weight: Matrix2<f64>,
    chi2: f64,
    /// Joint angles by the pixel (rad/px), and the pixel's part of their variances (rad^2).
    angles_by_pixel: Matrix2<f64>,
    angle_variances: [f64; 2],
}

/// How much a sighting counts.
enum Weighing {
    /// As normal noise, less beyond this many sigmas: cost `c^2 log(1 + chi2 / c^2)`, weight its
    /// derivative.
    Cauchy(f64),
    /// By the encoders' rounding.
    Rounding(InformationTable),
}

/// A sighting as the normal equations take it.
struct Weighed {
    weight: Matrix2<f64>,
    /// Minus half the derivative of the cost by the predicted pixel.
    pull: Vector2<f64>,
    cost: f64,
}

impl Weighing {
    fn weigh(&self, row: &Row) -> Weighed {
        match self {
            Weighing::Cauchy(sigmas) => {
                let scale = sigmas * sigmas;
                let weight = row.weight / (1.0 + row.chi2 / scale);
                let cost = scale * (row.chi2 / scale).ln_1p();
                Weighed { weight, pull: weight * row.residual, cost }
            }
            Weighing::Rounding(table) => {
                let errors = row.angles_by_pixel * row.residual;
                let (mut cost, mut slopes) = (0.0, Vector2::zeros());
                let mut information = Vector2::zeros();
                for joint in 0..2 {
                    let noise = row.angle_variances[joint].sqrt();
                    let (its_cost, slope) =
                        Rounding::new(table.step_sigma, noise).cost(errors[joint]);
                    cost += its_cost;
                    slopes[joint] = slope;
                    information[joint] = table.at(noise);
                }
                let by_pixel = row.angles_by_pixel.transpose();
                let weight = by_pixel * Matrix2::from_diagonal(&information) * row.angles_by_pixel;
                Weighed { weight, pull: by_pixel * slopes, cost }
            }
        }
    }
}

/// Fisher's information of a rounded angle by the noise beside the rounding.
struct InformationTable {
    step_sigma: f64,
    /// For noise of this table's ratios to the step's sigma.
    values: Vec<f64>,
}

impl InformationTable {
    /// Logarithms of the smallest and largest ratio of noise to rounding, and entries between.
    const RANGE: [f64; 2] = [-4.0, 4.0];
    const ENTRIES: usize = 64;

    fn new(step_sigma: f64) -> Self {
        // A servo without steps still has some noise: a microradian.
        let step_sigma = step_sigma.max(1e-6);
        let [low, high] = Self::RANGE;
        let values = (0..Self::ENTRIES).map(|i| {
            let log = low + (high - low) * i as f64 / (Self::ENTRIES - 1) as f64;
            Rounding::new(step_sigma, step_sigma * log.exp()).information()
        });
        InformationTable { step_sigma, values: values.collect() }
    }

    fn at(&self, noise: f64) -> f64 {
        let [low, high] = Self::RANGE;
        let place = ((noise / self.step_sigma).max(1e-9).ln().clamp(low, high) - low)
            / (high - low)
            * (Self::ENTRIES - 1) as f64;
        let below = (place as usize).min(Self::ENTRIES - 2);
        let part = place - below as f64;
        self.values[below] * (1.0 - part) + self.values[below + 1] * part
    }
}

impl Problem<'_> {
    /// Solves from each of several first guesses of the lights until one explains the sightings.
    pub(super) fn solve(&self, starts: impl Iterator<Item = Vec<Point3<f64>>>) -> Option<Solution> {
        let mut best: Option<Solution> = None;
        for lights in starts {
            let solution = self.solve_from(lights);
            if let Some(solution) = solution
                && best.as_ref().is_none_or(|b| solution.chi2_mean < b.chi2_mean)
            {
                best = Some(solution);
            }
            if best.as_ref().is_some_and(|b| b.chi2_mean < EXPLAINED && b.outliers < 0.05) {
                break;
            }
        }
        best
    }

    fn solve_from(&self, lights: Vec<Point3<f64>>) -> Option<Solution> {
        let mut state =
            State { heads: self.nominal.clone(), moved: [HeadVector::zeros(); 2], lights };
        let mut first = true;
        for (cauchy, loose) in CAUCHY.into_iter().zip(LOOSE_LENGTH) {
            if !std::mem::take(&mut first) {
                self.free_stray_lights(&mut state)?;
            }
            (state, _) = self.descend(state, &Weighing::Cauchy(cauchy), loose)?;
        }
        let rounding = Weighing::Rounding(InformationTable::new(self.config.noise.step_sigma));
        let (state, normal) = self.descend(state, &rounding, 0.0)?;
        self.finish(state, normal)
    }

    /// Puts lights that most of their own sightings contradict back to where the rays of the head, as it
    /// is known by now, meet: a known length has two solutions, and the start may lie near the wrong one.
    fn free_stray_lights(&self, state: &mut State) -> Option<()> {
        let mut chi2 = vec![Vec::new(); self.places.len()];
        self.for_each_row(state, |_, place, row| chi2[place].push(row.chi2))?;
        for (i, mut values) in chi2.into_iter().enumerate() {
            values.sort_by(f64::total_cmp);
            if values.get(values.len() / 2).is_some_and(|&median| median > OUTLIER * OUTLIER) {
                state.lights[i] = super::first_guess(&state.heads, &self.places[i], None);
            }
        }
        Some(())
    }

    /// Levenberg-Marquardt until the cost stands still.
    fn descend(
        &self,
        mut state: State,
        weighing: &Weighing,
        loose: f64,
    ) -> Option<(State, Normal)> {
        let mut normal = self.normal(&state, weighing, loose)?;
        let mut damping = 1e-3;
        for _ in 0..MAX_ITERATIONS {
            let mut damped = normal.information.clone();
            for i in 0..damped.nrows() {
                damped[(i, i)] *= 1.0 + damping;
            }
            let step = damped.cholesky()?.solve(&normal.gradient);
            let candidate = moved(&state, &step);
            let trial = self.normal(&candidate, weighing, loose).filter(|t| t.cost < normal.cost);
            let Some(trial) = trial else {
                damping *= 8.0;
                if damping > 1e8 {
                    break;
                }
                continue;
            };
            let gain = normal.cost - trial.cost;
            (state, normal) = (candidate, trial);
            damping = (damping / 6.0).max(1e-12);
            if gain < 1e-7 * (1.0 + normal.cost) {
                break;
            }
        }
        Some((state, normal))
    }

    fn finish(&self, state: State, normal: Normal) -> Option<Solution> {
        let covariance =
            normal.information.cholesky()?.inverse().view((0, 0), (BOTH, BOTH)).into_owned();
        let (mut count, mut chi2) = (0usize, 0.0);
        let (mut squares, mut counted) = (0.0, 0usize);
        self.for_each_row(&state, |_, _, row| {
            count += 1;
            // Capped, so that a few wrong sightings do not hide that all others fit.
            chi2 += row.chi2.min(OUTLIER * OUTLIER);
            if row.chi2 < OUTLIER * OUTLIER {
                squares += row.residual.norm_squared();
                counted += 2;
            }
        })?;
        let sigmas = self.config.priors.sigmas();
        let change = |k: usize| state.moved[k].component_div(&sigmas).amax();
        let farther = usize::from(change(1) > change(0));
        Some(Solution {
            farthest: (change(farther), farther),
            chi2_mean: chi2 / count.max(1) as f64,
            outliers: 1.0 - counted as f64 / 2.0 / count.max(1) as f64,
            rms_px: (squares / counted.max(1) as f64).sqrt(),
            covariance,
            heads: state.heads,
            lights: state.lights,
        })
    }

    fn for_each_row(
        &self,
        state: &State,
        mut use_row: impl FnMut(usize, usize, Row),
    ) -> Option<()> {
        for (place, light) in
            self.places.iter().zip(&state.lights).enumerate().map(|(i, (p, l))| ((i, p), l))
        {
            for k in 0..2 {
                for fixation in &place.1.fixations[k] {
                    let row = self.row(&state.heads[k], light, fixation)?;
                    use_row(k, place.0, row);
                }
            }
        }
        Some(())
    }

    fn normal(&self, state: &State, weighing: &Weighing, loose: f64) -> Option<Normal> {
        let size = BOTH + 3 * state.lights.len();
        let mut information = DMatrix::zeros(size, size);
        let mut gradient = DVector::zeros(size);
        let mut cost = 0.0;
        self.for_each_row(state, |k, place, row| {
            let (head, light) = (k * HEAD_UNKNOWNS, BOTH + 3 * place);
            let Weighed { weight, pull, cost: its_cost } = weighing.weigh(&row);
            cost += its_cost;
            let weighted_head = row.by_head.transpose() * weight;
            let weighted_light = row.by_light.transpose() * weight;
            let cross = weighted_head * row.by_light;
            let mut block = information.fixed_view_mut::<HEAD_UNKNOWNS, HEAD_UNKNOWNS>(head, head);
            block += weighted_head * row.by_head;
            let mut block = information.fixed_view_mut::<3, 3>(light, light);
            block += weighted_light * row.by_light;
            let mut block = information.fixed_view_mut::<HEAD_UNKNOWNS, 3>(head, light);
            block += cross;
            let mut block = information.fixed_view_mut::<3, HEAD_UNKNOWNS>(light, head);
            block += cross.transpose();
            let mut part = gradient.fixed_rows_mut::<HEAD_UNKNOWNS>(head);
            part += row.by_head.transpose() * pull;
            let mut part = gradient.fixed_rows_mut::<3>(light);
            part += row.by_light.transpose() * pull;
        })?;
        let mut normal = Normal { information, gradient, cost };
        self.add_priors(state, &mut normal);
        self.add_places(state, loose, &mut normal);
        normal.cost.is_finite().then_some(normal)
    }

    fn add_priors(&self, state: &State, normal: &mut Normal) {
        let sigmas = self.config.priors.sigmas();
        for k in 0..2 {
            for i in 0..HEAD_UNKNOWNS {
                let (at, weight) = (k * HEAD_UNKNOWNS + i, sigmas[i].powi(-2));
                normal.information[(at, at)] += weight;
                normal.gradient[at] -= weight * state.moved[k][i];
                normal.cost += weight * state.moved[k][i].powi(2);
            }
        }
    }

    fn add_places(&self, state: &State, loose: f64, normal: &mut Normal) {
        for (i, place) in self.places.iter().enumerate() {
            let at = BOTH + 3 * i;
            // A light is somewhere within some metres; this only keeps one that nobody saw finite.
            for axis in 0..3 {
                normal.information[(at + axis, at + axis)] += 1e-4;
            }
            if let Some((position, sigma)) = place.known {
                let sigma = sigma.max(loose);
                let off: Vector3<f64> = state.lights[i] - position;
                for axis in 0..3 {
                    normal.information[(at + axis, at + axis)] += sigma.powi(-2);
                    normal.gradient[at + axis] -= sigma.powi(-2) * off[axis];
                }
                normal.cost += off.norm_squared() / (sigma * sigma);
            }
        }
        for l in self.lengths {
            let [a, b] = l.places;
            let apart = state.lights[b] - state.lights[a];
            let Some(along) = apart.try_normalize(1e-9) else { continue };
            let (weight, residual) = (l.sigma.max(loose).powi(-2), l.length - apart.norm());
            let ends = [(BOTH + 3 * a, -along), (BOTH + 3 * b, along)];
            for (i, di) in ends {
                let mut part = normal.gradient.fixed_rows_mut::<3>(i);
                part += weight * residual * di;
                for (j, dj) in ends {
                    let mut block = normal.information.fixed_view_mut::<3, 3>(i, j);
                    block += weight * di * dj.transpose();
                }
            }
            normal.cost += weight * residual * residual;
        }
    }

    /// Residual and derivatives of one sighting; `None` when the light is behind the camera.
    fn row(&self, head: &PanTiltHead, light: &Point3<f64>, fixation: &Fixation) -> Option<Row> {
        let projection = head.linearise(fixation.angles, light)?;
        let by_head =
            by_unknowns(head, fixation.angles, light, &projection.by_point, &projection.pixel);
        let step = self.config.noise.step_sigma;
        let covariance = fixation.pixel_covariance
            + projection.by_angles * projection.by_angles.transpose() * step * step
            + Matrix2::identity() * 1e-6;
        let weight = covariance.try_inverse()?;
        let residual = fixation.pixel - projection.pixel;
        let chi2 = residual.dot(&(weight * residual));
        let angles_by_pixel = projection.by_angles.try_inverse()?;
        let centroid = fixation.pixel_covariance + Matrix2::identity() * 1e-6;
        let variances = angles_by_pixel * centroid * angles_by_pixel.transpose();
        Some(Row {
            residual,
            by_head,
            by_light: projection.by_point,
            weight,
            chi2,
            angles_by_pixel,
            angle_variances: [variances[(0, 0)], variances[(1, 1)]],
        })
    }
}

/// Derivative of a pixel by a head's unknowns. Turning and shifting a fixed transform moves the light
/// the other way, seen from the camera.
fn by_unknowns(
    head: &PanTiltHead,
    angles: [f64; 2],
    light: &Point3<f64>,
    by_point: &SMatrix<f64, 2, 3>,
    pixel: &nalgebra::Point2<f64>,
) -> SMatrix<f64, 2, HEAD_UNKNOWNS> {
    let mut out = SMatrix::<f64, 2, HEAD_UNKNOWNS>::zeros();
    let frames = head.chain.frames(&angles);
    let base_from_optical = head.base_from_optical(angles);
    // Parent axes in base, and the place about which each transform's rotation turns.
    let parents = [nalgebra::UnitQuaternion::identity(), frames[0].rotation, frames[1].rotation];
    let pivots = [
        frames[0].translation.vector,
        frames[1].translation.vector,
        base_from_optical.translation.vector,
    ];
    for block in 0..3 {
        for axis in 0..3 {
            let mut unit = Vector3::zeros();
            unit[axis] = 1.0;
            let turned = parents[block] * unit;
            let swept = turned.cross(&(light.coords - pivots[block]));
            out.set_column(6 * block + axis, &(by_point * -swept));
            out.set_column(6 * block + 3 + axis, &(by_point * -turned));
        }
    }
    let camera = &head.camera;
    let p = base_from_optical.inverse_transform_point(light);
    let (x, y) = (p.x / p.z, p.y / p.z);
    let r2 = x * x + y * y;
    out.set_column(18, &Vector2::new(pixel.x - camera.cx, pixel.y - camera.cy));
    out.set_column(19, &Vector2::x());
    out.set_column(20, &Vector2::y());
    out.set_column(21, &Vector2::new(camera.fx * x * r2, camera.fy * y * r2));
    out
}

fn moved(state: &State, step: &DVector<f64>) -> State {
    let change = |k: usize| -> HeadVector {
        SVector::from(step.fixed_rows::<HEAD_UNKNOWNS>(k * HEAD_UNKNOWNS))
    };
    State {
        heads: [0, 1].map(|k| apply(&state.heads[k], &change(k))),
        // Tangents of turned frames do not quite add up, which is far below the priors' width.
        moved: [0, 1].map(|k| state.moved[k] + change(k)),
        lights: state
            .lights
            .iter()
            .enumerate()
            .map(|(i, p)| p + step.fixed_rows::<3>(BOTH + 3 * i))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::head;

    #[test]
    fn derivatives_by_every_unknown_equal_finite_differences() {
        let head = head(0.1);
        let light = Point3::new(0.9, 0.3, 0.2);
        let angles = [0.1, 0.25];
        let projection = head.linearise(angles, &light).unwrap();
        let analytic = by_unknowns(&head, angles, &light, &projection.by_point, &projection.pixel);
        for i in 0..HEAD_UNKNOWNS {
            let at = |h: f64| {
                let mut change = HeadVector::zeros();
                change[i] = h;
                apply(&head, &change).project(angles, &light).unwrap()
            };
            let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
            let error = (numeric - analytic.column(i)).norm();
            assert!(
                error < 1e-3 * (1.0 + numeric.norm()),
                "unknown {i}: {numeric} {}",
                analytic.column(i)
            );
        }
    }
}
