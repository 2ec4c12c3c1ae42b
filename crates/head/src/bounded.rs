//! Many fixations of one head on one light, made into one: encoder errors are bounded, and that tells
//! more than their variance.
//!
//! In: fixations from angles a few encoder steps apart, and about where the light is. Out: one fixation
//! whose covariance says how well the line of sight is known, encoder steps included.
//!
//! **Method.** Pixels tell how the angles at which a head looked differ from each other much better than
//! encoders do; what is left is one common error `u` per joint. Fixation `i` gives `q_i = u + e_i`, and
//! the encoder's rounding `e_i` lies anywhere within half a step, but never outside. So `u` lies in the
//! intersection of intervals around all `q_i`, which shrinks with the number of fixations, where a mean
//! improves with its root only. The posterior of `u`, each `e_i` uniform plus the pixel's normal noise,
//! is summed over a grid; its mean and variance go on.
//!
//! What it relies on: the encoder rounds to its step. Rare readings that are off by more than a step do
//! no harm ([`STRAY`]); a servo whose reading wanders by a good part of a step needs a larger step stated.

use nalgebra::{Matrix2, Point3, Vector2};

use crate::{Fixation, PanTiltHead};

/// Part of the readings that may lie anywhere within three steps.
const STRAY: f64 = 1e-3;
/// Softness of the interval's ends as a part of its half width: encoders are not perfectly even.
const SOFTNESS: f64 = 0.05;
/// Points of the grid.
const GRID: usize = 400;

/// The error of an encoder that rounds, plus normal noise: its log likelihood and what follows from it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rounding {
    half: f64,
    sigma: f64,
}

impl Rounding {
    /// Rounding with this standard deviation, and noise (both in the error's unit). Noise is taken no
    /// smaller than encoders are uneven.
    pub(crate) fn new(step_sigma: f64, noise: f64) -> Self {
        let half = step_sigma * 3f64.sqrt();
        Rounding { half, sigma: noise.hypot(SOFTNESS * half).max(1e-9) }
    }

    /// Twice the negative log likelihood, as chi-squared counts, least for no error; and half its
    /// derivative.
    pub(crate) fn cost(&self, error: f64) -> (f64, f64) {
        let Rounding { half, sigma } = *self;
        let density = |x: f64| (-0.5 * x * x).exp() / (sigma * std::f64::consts::TAU.sqrt());
        let value = likelihood(error, half, sigma);
        let slope = density((half + error) / sigma) - density((half - error) / sigma);
        let least = likelihood(0.0, half, sigma);
        (-2.0 * (value / least).ln(), -(1.0 - STRAY) * slope / value)
    }

    /// Fisher's information: what one reading tells of the error's centre, one over its variance.
    pub(crate) fn information(&self) -> f64 {
        const POINTS: usize = 200;
        let reach = self.half + 5.0 * self.sigma;
        let step = 2.0 * reach / POINTS as f64;
        let (mut told, mut total) = (0.0, 0.0);
        for i in 0..POINTS {
            let error = -reach + step * (i as f64 + 0.5);
            let weight = likelihood(error, self.half, self.sigma);
            told += weight * self.cost(error).1.powi(2);
            total += weight;
        }
        told / total
    }
}

/// One fixation that stands for all; `None` when the light is behind the camera. `step_sigma` is the
/// standard deviation of the encoder's rounding (rad).
pub(crate) fn combine(
    head: &PanTiltHead,
    fixations: &[Fixation],
    step_sigma: f64,
    near: &Point3<f64>,
) -> Option<Fixation> {
    let mut offsets: [Vec<f64>; 2] = [Vec::new(), Vec::new()];
    let mut noise = [0.0; 2];
    for fixation in fixations {
        let expected = head.linearise(fixation.angles, near)?;
        let by_pixel = expected.by_angles.try_inverse()?;
        let off = by_pixel * (fixation.pixel - expected.pixel);
        let variance = by_pixel * fixation.pixel_covariance * by_pixel.transpose();
        for joint in 0..2 {
            offsets[joint].push(off[joint]);
            noise[joint] += variance[(joint, joint)] / fixations.len() as f64;
        }
    }
    let found = [0, 1]
        .map(|joint| common(&offsets[joint], &Rounding::new(step_sigma, noise[joint].sqrt())));
    // At the middle of the angles the common error is known best.
    let mean = |joint: usize| {
        fixations.iter().map(|f| f.angles[joint]).sum::<f64>() / fixations.len() as f64
    };
    let angles = [mean(0), mean(1)];
    let at = head.linearise(angles, near)?;
    let shift = Vector2::new(found[0].0, found[1].0);
    let spread = Matrix2::from_diagonal(&Vector2::new(found[0].1, found[1].1));
    Some(Fixation {
        angles,
        pixel: at.pixel + at.by_angles * shift,
        pixel_covariance: at.by_angles * spread * at.by_angles.transpose(),
    })
}

/// Mean and variance of what all offsets have in common.
fn common(offsets: &[f64], rounding: &Rounding) -> (f64, f64) {
    let Rounding { half, sigma } = *rounding;
    let mean = offsets.iter().sum::<f64>() / offsets.len().max(1) as f64;
    let reach = half + 4.0 * sigma;
    let step = 2.0 * reach / (GRID - 1) as f64;
    let places: Vec<f64> = (0..GRID).map(|i| mean - reach + step * i as f64).collect();
    let logs: Vec<f64> = places
        .iter()
        .map(|u| offsets.iter().map(|q| likelihood(q - u, half, sigma).ln()).sum())
        .collect();
    let highest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let (mut total, mut first, mut second) = (0.0, 0.0, 0.0);
    for (u, log) in places.iter().zip(&logs) {
        let weight = (log - highest).exp();
        total += weight;
        first += weight * (u - mean);
        second += weight * (u - mean).powi(2);
    }
    let shift = first / total;
    // The grid's own step is the least that can be known.
    let variance = (second / total - shift * shift).max(step * step / 12.0);
    (mean + shift, variance)
}

/// Uniform within `half`, blurred by `sigma`, on a floor for strays; up to a factor.
fn likelihood(error: f64, half: f64, sigma: f64) -> f64 {
    let inside = 0.5 * (erf((half - error) / sigma) - erf((-half - error) / sigma));
    let stray = if error.abs() < 6.0 * half { STRAY / 6.0 } else { 1e-12 };
    (1.0 - STRAY) * inside + stray
}

/// Twice the normal distribution's integral from zero, by its logistic approximation (error < 2e-4).
fn erf(x: f64) -> f64 {
    (0.797_884_56 * (x + 0.044_715 * x.powi(3))).tanh()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    /// Rounding to within one.
    fn unit(noise: f64) -> Rounding {
        Rounding::new(1.0 / 3f64.sqrt(), noise)
    }

    #[test]
    fn the_cost_falls_off_as_its_derivative_says_and_tells_what_it_tells() {
        for noise in [0.05, 0.4, 3.0] {
            let rounding = unit(noise);
            for error in [-1.2, -0.95, -0.3, 0.0, 0.5, 1.05] {
                let at = |h: f64| rounding.cost(error + h).0;
                let numeric = 0.5 * (at(1e-5) - at(-1e-5)) / 2e-5;
                let (_, analytic) = rounding.cost(error);
                let off = (numeric - analytic).abs();
                assert!(
                    off < 0.02 * (1.0 + analytic.abs()),
                    "{noise} {error}: {numeric} {analytic}"
                );
            }
        }
        // Much noise: a normal error again, the variances added.
        let wide = unit(3.0).information() * (9.0 + 1.0 / 3.0);
        assert!((wide - 1.0).abs() < 0.05, "{wide}");
        // Little noise: more than the variance of the rounding tells.
        assert!(unit(0.05).information() > 3.0 * 3.0);
    }

    /// Errors of the common offset by this method and by the mean, and by how many of its own sigmas.
    fn trial(count: usize, seed: u64) -> (f64, f64, f64) {
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let (half, sigma) = (1.0, 0.1);
        let mut normal = |s: f64| s * ((0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0);
        let noise: Vec<f64> = (0..count).map(|_| normal(sigma)).collect();
        let offsets: Vec<f64> =
            noise.into_iter().map(|n| 0.3 + n + random.random_range(-half..half)).collect();
        let (found, variance) = common(&offsets, &unit(sigma));
        let mean = offsets.iter().sum::<f64>() / count as f64;
        (found - 0.3, mean - 0.3, (found - 0.3) / variance.sqrt())
    }

    #[test]
    fn bounded_errors_tell_more_than_their_mean_and_their_variance_is_honest() {
        for count in [1, 4, 16, 36] {
            let (mut ours, mut mean, mut scaled) = (0.0, 0.0, 0.0);
            const TRIALS: usize = 400;
            for seed in 0..TRIALS as u64 {
                let (a, b, c) = trial(count, seed);
                ours += a * a / TRIALS as f64;
                mean += b * b / TRIALS as f64;
                scaled += c * c / TRIALS as f64;
            }
            let gain = (mean / ours).sqrt();
            assert!(gain > [0.98, 1.0, 1.3, 1.6][count.ilog2() as usize / 2], "{count}: {gain}");
            assert!((0.75..1.3).contains(&scaled), "{count}: squared error {scaled} of predicted");
        }
    }

    #[test]
    fn a_stray_reading_does_no_harm() {
        let mut offsets: Vec<f64> = (0..16).map(|i| 0.1 * f64::from(i) - 0.75).collect();
        let (clean, _) = common(&offsets, &unit(0.1));
        offsets.push(3.0);
        let (found, _) = common(&offsets, &unit(0.1));
        assert!((found - clean).abs() < 0.25, "{found} instead of {clean}");
    }
}
