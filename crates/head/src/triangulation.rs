//! Where the light is, from the angles and pixels at which both heads see it.
//!
//! In: per head one or more [`Fixation`]s (encoder angles, residual pixel and its covariance) and the
//! [`Noise`] of the joints. Out: the point in `base` with an honest covariance, and by how many sigmas
//! the two lines of sight miss each other.
//!
//! Method: maximum likelihood. The rays' midpoint starts Gauss-Newton on the point `p` and, per head,
//! one error `b` of each joint angle that all its fixations share (backlash, zero offset):
//!
//! ```text
//! minimise  sum_i |project(angles_i + b_head, p) - pixel_i|^2_(W_i)  +  |b|^2 / sigma_common^2
//! W_i = pixel covariance + J_angles J_angles^T sigma_step^2
//! ```
//!
//! The covariance is the block of `p` in the inverse of the normal matrix, so `b` is marginalised.
//! With one fixation a head this is the optimal intersection of two rays. More fixations at slightly
//! different angles ([`crate::Reaim`]) narrow the encoder's steps down but not what they share: each
//! head's are first made into one, which uses that rounding is bounded (module `bounded`).
//!
//! What it cannot do: tell a light from its image in a mirror that both heads see. Both rays then
//! meet, behind the mirror. A mirror that shows different images to the heads, or a wrong pairing,
//! fails the gate ([`GATE_SIGMAS`]).

use nalgebra::{Matrix2, Matrix3, Point2, Point3, SMatrix, SVector, Vector2, Vector3};
use vergence_geometry::{GaussianPoint, Ray};

use crate::PanTiltHead;
use crate::bounded;

/// Rays that miss each other by more sigmas than this do not belong to one light: one right pair in
/// fifteen thousand is refused.
pub const GATE_SIGMAS: f64 = 4.0;

/// From so many fixations of each head on, what they have in common is told by the bounds of their
/// errors; below, the bounds tell nothing that the variance does not.
const FEWEST_TO_COMBINE: usize = 3;

/// Point and two joint errors for each of two heads.
const UNKNOWNS: usize = 7;

/// What one head saw when it looked at the light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fixation {
    /// Pan and tilt as the encoders tell them (rad).
    pub angles: [f64; 2],
    /// Where the light was in the picture; need not be the centre.
    pub pixel: Point2<f64>,
    /// Covariance of `pixel` (px^2).
    pub pixel_covariance: Matrix2<f64>,
}

/// How far the true joint angles may be from what the encoders tell (rad, one standard deviation).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Differs from fixation to fixation: the encoder's step, friction.
    pub step_sigma: f64,
    /// The same for all fixations of a joint: backlash taken from one side, errors of the zero, what
    /// calibration left.
    pub common_sigma: f64,
}

impl Noise {
    /// Noise of a servo with an encoder step and backlash (rad), both uniform: variance
    /// `width^2 / 12`.
    pub fn of_servo(resolution: f64, backlash: f64) -> Self {
        let uniform = 12f64.sqrt();
        Noise { step_sigma: resolution / uniform, common_sigma: backlash / uniform }
    }

    fn total_variance(&self) -> f64 {
        // The floor keeps ideal servos from making the problem singular: 1e-7 rad is 0.1 um at 1 m.
        self.step_sigma.powi(2) + self.common_sigma.powi(2) + 1e-14
    }
}

/// A light in space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Landmark {
    /// Where it is, in base.
    pub point: GaussianPoint,
    /// By how many sigmas the measurements disagree: root of chi-squared per degree of freedom.
    pub gap_sigmas: f64,
}

/// Why two fixations give no point.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum TriangulateError {
    /// The lines of sight are parallel to within their noise: the light is too far for a distance.
    #[error(
        "the lines of sight meet at {vergence:.5} rad, not three times their noise of {sigma:.5} rad"
    )]
    Parallel {
        /// Angle between the lines (rad), negative when they diverge.
        vergence: f64,
        /// Its standard deviation (rad).
        sigma: f64,
    },
    /// The lines of sight meet behind a camera.
    #[error("the lines of sight meet behind the cameras: wrong pair, or left and right exchanged")]
    Behind,
    /// The lines of sight pass each other too far away to come from one light.
    #[error(
        "the lines of sight miss each other by {sigmas:.1} sigmas: different lights, a reflection, or the head needs calibration"
    )]
    Gap {
        /// How far, in standard deviations.
        sigmas: f64,
    },
    /// A head has no fixation, or the numbers are not finite.
    #[error("no usable fixation of both heads")]
    NoFixation,
}

/// Triangulates one fixation of each head, see the module's text.
pub fn triangulate(
    heads: &[PanTiltHead; 2],
    fixations: &[Fixation; 2],
    noise: &Noise,
) -> Result<Landmark, TriangulateError> {
    triangulate_many(heads, [&fixations[..1], &fixations[1..]], noise)
}

/// Triangulates all fixations of both heads on one light that did not move.
pub fn triangulate_many(
    heads: &[PanTiltHead; 2],
    fixations: [&[Fixation]; 2],
    noise: &Noise,
) -> Result<Landmark, TriangulateError> {
    let usable = |f: &Fixation| {
        f.angles
            .iter()
            .chain(f.pixel.iter())
            .chain(f.pixel_covariance.iter())
            .all(|v| v.is_finite())
    };
    let (Some(left), Some(right)) = (fixations[0].first(), fixations[1].first()) else {
        return Err(TriangulateError::NoFixation);
    };
    if !fixations.iter().flat_map(|f| f.iter()).all(usable) {
        return Err(TriangulateError::NoFixation);
    }
    let start = midpoint(heads, &[*left, *right], noise)?;
    let problem = Problem { heads, fixations, noise };
    let (mut state, mut information, chi2) =
        problem.solve(start).ok_or(TriangulateError::Behind)?;
    let freedom = 2 * (fixations[0].len() + fixations[1].len()) - 3;
    let gap_sigmas = (chi2 / freedom as f64).sqrt();
    if gap_sigmas > GATE_SIGMAS {
        return Err(TriangulateError::Gap { sigmas: gap_sigmas });
    }
    if fixations.iter().all(|f| f.len() >= FEWEST_TO_COMBINE) && noise.step_sigma > 0.0 {
        let about = Point3::new(state[0], state[1], state[2]);
        let combine =
            |k: usize| bounded::combine(&heads[k], fixations[k], noise.step_sigma, &about);
        if let (Some(left), Some(right)) = (combine(0), combine(1)) {
            // The encoder's steps are part of the combined fixations' covariance.
            let noise = Noise { step_sigma: 0.0, ..*noise };
            let combined = Problem { heads, fixations: [&[left], &[right]], noise: &noise };
            (state, information, _) = combined.solve(about).ok_or(TriangulateError::Behind)?;
        }
    }
    let covariance = information.try_inverse().ok_or(TriangulateError::Behind)?;
    let covariance = covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let point = GaussianPoint {
        position: Point3::new(state[0], state[1], state[2]),
        covariance: 0.5 * (covariance + covariance.transpose()),
    };
    Ok(Landmark { point, gap_sigmas })
}

/// By how many sigmas two lines of sight miss each other (Sampson's first-order distance of the
/// epipolar constraint `baseline . (d1 x d2) = 0`). Cheap enough to try every light that the left
/// camera sees against every light of the right; distance needs no vergence, so it also works for
/// far lights.
pub fn epipolar_gap(heads: &[PanTiltHead; 2], fixations: &[Fixation; 2], noise: &Noise) -> f64 {
    let rays = [0, 1].map(|k| heads[k].ray(fixations[k].angles, &fixations[k].pixel));
    let constraint = |rays: &[Ray; 2]| {
        (rays[1].origin - rays[0].origin).dot(&rays[0].direction.cross(&rays[1].direction))
    };
    let mut variance = 0.0;
    for k in 0..2 {
        let slope = |h: f64, change: &dyn Fn(&mut Fixation, f64)| {
            let at = |h: f64| {
                let mut moved = fixations[k];
                change(&mut moved, h);
                let mut both = rays;
                both[k] = heads[k].ray(moved.angles, &moved.pixel);
                constraint(&both)
            };
            (at(h) - at(-h)) / (2.0 * h)
        };
        for joint in 0..2 {
            let by_angle = slope(1e-6, &|f, h| f.angles[joint] += h);
            variance += by_angle * by_angle * noise.total_variance();
        }
        let by_pixel =
            Vector2::new(slope(1e-3, &|f, h| f.pixel.x += h), slope(1e-3, &|f, h| f.pixel.y += h));
        variance += by_pixel.dot(&(fixations[k].pixel_covariance * by_pixel));
    }
    constraint(&rays).abs() / variance.max(f64::MIN_POSITIVE).sqrt()
}

/// The midpoint of the rays' closest approach; refuses rays without a usable distance.
fn midpoint(
    heads: &[PanTiltHead; 2],
    fixations: &[Fixation; 2],
    noise: &Noise,
) -> Result<Point3<f64>, TriangulateError> {
    let rays = [0, 1].map(|k| heads[k].ray(fixations[k].angles, &fixations[k].pixel));
    let [a, b] = [rays[0].direction.into_inner(), rays[1].direction.into_inner()];
    let baseline = rays[1].origin - rays[0].origin;
    // Vergence counts in the plane of the baseline and is positive when the rays close in.
    let across = baseline.try_normalize(1e-9).ok_or(TriangulateError::NoFixation)?;
    let vergence = a.angle(&b).copysign((a - b).dot(&across));
    let pixel_variance =
        |k: usize| fixations[k].pixel_covariance.trace() / 2.0 / heads[k].camera.fx.powi(2);
    let sigma = (2.0 * noise.total_variance() + pixel_variance(0) + pixel_variance(1)).sqrt();
    if vergence.abs() < 3.0 * sigma {
        return Err(TriangulateError::Parallel { vergence, sigma });
    }
    let (s, t) = rays[0].closest(&rays[1]).ok_or(TriangulateError::Parallel { vergence, sigma })?;
    if s <= 0.0 || t <= 0.0 {
        return Err(TriangulateError::Behind);
    }
    Ok(nalgebra::center(&rays[0].at(s), &rays[1].at(t)))
}

/// The point nearest to all rays, in the sense of least squares; `None` when they are parallel.
pub(crate) fn nearest_to_rays(rays: &[Ray]) -> Option<Point3<f64>> {
    let mut matrix = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for ray in rays {
        let d = ray.direction.into_inner();
        let across = Matrix3::identity() - d * d.transpose();
        matrix += across;
        right += across * ray.origin.coords;
    }
    Some(Point3::from(matrix.try_inverse()? * right))
}

struct Problem<'a> {
    heads: &'a [PanTiltHead; 2],
    fixations: [&'a [Fixation]; 2],
    noise: &'a Noise,
}

type State = SVector<f64, UNKNOWNS>;
type Information = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

impl Problem<'_> {
    /// Gauss-Newton; the final state, normal matrix and chi-squared. `None` when the point runs
    /// behind a camera or to infinity.
    fn solve(&self, start: Point3<f64>) -> Option<(State, Information, f64)> {
        let mut state = State::zeros();
        state.fixed_rows_mut::<3>(0).copy_from(&start.coords);
        let mut best = self.normal_equations(&state)?;
        for _ in 0..20 {
            let mut step = best.0.cholesky()?.solve(&best.1);
            // Halving keeps far points, where the pixel is nearly flat in depth, from overshooting.
            let mut next = None;
            for _ in 0..8 {
                let candidate = state + step;
                if let Some(trial) = self.normal_equations(&candidate)
                    && trial.2 <= best.2 + 1e-12
                {
                    next = Some((candidate, trial));
                    break;
                }
                step *= 0.5;
            }
            let Some((candidate, trial)) = next else { break };
            (state, best) = (candidate, trial);
            if step.norm() < 1e-12 {
                break;
            }
        }
        Some((state, best.0, best.2))
    }

    fn normal_equations(&self, state: &State) -> Option<(Information, State, f64)> {
        let point = Point3::new(state[0], state[1], state[2]);
        let mut information = Information::zeros();
        let mut gradient = State::zeros();
        let mut chi2 = 0.0;
        // A tiny prior width stands for "no common error": the unknown is then pinned to zero.
        let common = 1.0 / (self.noise.common_sigma.powi(2) + 1e-16);
        for joint in 3..UNKNOWNS {
            information[(joint, joint)] += common;
            gradient[joint] -= common * state[joint];
            chi2 += common * state[joint].powi(2);
        }
        for (k, head) in self.heads.iter().enumerate() {
            let column = 3 + 2 * k;
            let shared = [state[column], state[column + 1]];
            for fixation in self.fixations[k] {
                let angles = [fixation.angles[0] + shared[0], fixation.angles[1] + shared[1]];
                let projection = head.linearise(angles, &point)?;
                let by_angles = projection.by_angles;
                // 1e-6 px^2: a centroid that claims no error at all would be singular.
                let covariance = fixation.pixel_covariance
                    + by_angles * by_angles.transpose() * self.noise.step_sigma.powi(2)
                    + Matrix2::identity() * 1e-6;
                let weight = covariance.try_inverse()?;
                let mut jacobian = SMatrix::<f64, 2, UNKNOWNS>::zeros();
                jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&projection.by_point);
                jacobian.fixed_view_mut::<2, 2>(0, column).copy_from(&by_angles);
                let residual = fixation.pixel - projection.pixel;
                information += jacobian.transpose() * weight * jacobian;
                gradient += jacobian.transpose() * weight * residual;
                chi2 += (residual.transpose() * weight * residual).x;
            }
        }
        chi2.is_finite().then_some((information, gradient, chi2))
    }
}

impl Landmark {
    /// Distance (m) from a point, for example from the middle of the head, with its sigma.
    pub fn distance_from(&self, origin: &Point3<f64>) -> (f64, f64) {
        let offset: Vector3<f64> = self.point.position - origin;
        let distance = offset.norm();
        let along = offset / distance.max(1e-12);
        let covariance: Matrix3<f64> = self.point.covariance;
        (distance, along.dot(&(covariance * along)).max(0.0).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::heads;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    fn exact(heads: &[PanTiltHead; 2], point: &Point3<f64>, off: f64) -> [Fixation; 2] {
        [0, 1].map(|k| {
            let angles = heads[k].look_at(point).unwrap();
            let angles = [angles[0] + off, angles[1] - off];
            let pixel = heads[k].project(angles, point).unwrap();
            Fixation { angles, pixel, pixel_covariance: Matrix2::identity() * 0.01 }
        })
    }

    fn normal(rng: &mut Pcg64Mcg) -> f64 {
        (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
    }

    proptest! {
        #[test]
        fn exact_measurements_give_the_point(
            x in 0.3f64..2.5, y in -0.8f64..0.8, z in 0.0f64..0.9, off in -0.15f64..0.15,
        ) {
            let (heads, point) = (heads(), Point3::new(x, y, z));
            let fixations = exact(&heads, &point, off);
            let noise = Noise::of_servo(1e-4, 0.0);
            let landmark = triangulate(&heads, &fixations, &noise).unwrap();
            prop_assert!((landmark.point.position - point).norm() < 1e-7, "{landmark:?}");
            prop_assert!(landmark.gap_sigmas < 1e-4);
            prop_assert!(epipolar_gap(&heads, &fixations, &noise) < 1e-4);
        }
    }

    #[test]
    fn the_covariance_is_honest_with_quantised_and_slack_servos() {
        let (heads, mut rng) = (heads(), Pcg64Mcg::seed_from_u64(3));
        let (step, backlash, pixel_sigma) = (0.0015, 0.0044, 0.1);
        let noise = Noise::of_servo(step, backlash);
        let (mut nees, mut gap2) = (0.0, 0.0);
        const RUNS: usize = 600;
        for _ in 0..RUNS {
            let point = Point3::new(
                rng.random_range(0.6..1.5),
                rng.random_range(-0.5..0.5),
                rng.random_range(0.1..0.7),
            );
            let mut fixations = [vec![], vec![]];
            for k in 0..2 {
                let slack = [0, 1].map(|_| backlash * (rng.random::<f64>() - 0.5));
                let centre = heads[k].look_at(&point).unwrap();
                for _ in 0..4 {
                    let told = centre.map(|a| a + rng.random_range(-0.01..0.01));
                    let real =
                        [0, 1].map(|j| told[j] + slack[j] + step * (rng.random::<f64>() - 0.5));
                    let shake = Vector2::new(normal(&mut rng), normal(&mut rng)) * pixel_sigma;
                    fixations[k].push(Fixation {
                        angles: told,
                        pixel: heads[k].project(real, &point).unwrap() + shake,
                        pixel_covariance: Matrix2::identity() * pixel_sigma.powi(2),
                    });
                }
            }
            let landmark =
                triangulate_many(&heads, [&fixations[0], &fixations[1]], &noise).unwrap();
            nees += landmark.point.nees(&point).unwrap() / RUNS as f64;
            gap2 += landmark.gap_sigmas.powi(2) / RUNS as f64;
        }
        // Chi-squared with 3 degrees of freedom: mean 3, the mean of 600 within 0.1 sigma of it.
        assert!((2.6..3.4).contains(&nees), "mean NEES {nees}");
        assert!((0.85..1.15).contains(&gap2), "mean chi-squared per degree of freedom {gap2}");
    }

    #[test]
    fn depth_sigma_equals_the_textbook_formula() {
        // sqrt(2) Z^2 / b sigma, with lever arms that shorten Z by their 40 mm.
        let (heads, point) = (heads(), Point3::new(1.0, 0.0, 0.555));
        let noise = Noise { step_sigma: 0.001, common_sigma: 0.0 };
        let mut fixations = exact(&heads, &point, 0.0);
        for f in &mut fixations {
            f.pixel_covariance = Matrix2::zeros();
        }
        let landmark = triangulate(&heads, &fixations, &noise).unwrap();
        let sigma_x = landmark.point.covariance[(0, 0)].sqrt();
        let textbook = 2f64.sqrt() * (1.0f64 + 0.01) / 0.2 * 0.001;
        assert!((sigma_x / textbook - 1.0).abs() < 0.05, "{sigma_x} against {textbook}");
    }

    #[test]
    fn refusals_say_why() {
        let heads = heads();
        let noise = Noise::of_servo(0.001, 0.0);
        let far = exact(&heads, &Point3::new(500.0, 0.0, 1.0), 0.0);
        assert!(matches!(
            triangulate(&heads, &far, &noise),
            Err(TriangulateError::Parallel { vergence, .. }) if vergence > 0.0
        ));
        let near = exact(&heads, &Point3::new(1.0, 0.0, 0.5), 0.0);
        let mut diverging = near;
        diverging[0].angles[0] += 0.3;
        diverging[1].angles[0] -= 0.3;
        assert_eq!(triangulate(&heads, &diverging, &noise), Err(TriangulateError::Behind));
        let mut other = near;
        other[1].angles[1] += 0.05;
        let Err(TriangulateError::Gap { sigmas }) = triangulate(&heads, &other, &noise) else {
            panic!("a gap of 5 cm must be refused");
        };
        let sampson = epipolar_gap(&heads, &other, &noise);
        assert!((sampson / sigmas - 1.0).abs() < 0.1, "{sampson} {sigmas}");
        assert_eq!(
            triangulate_many(&heads, [&near[..1], &[]], &noise),
            Err(TriangulateError::NoFixation)
        );
        other[0].pixel.x = f64::NAN;
        assert_eq!(triangulate(&heads, &other, &noise), Err(TriangulateError::NoFixation));
    }
}
