//! Where a point of light lies between pixels: generalised least squares on the filtered picture.
//!
//! In: the light of a tag on 5x5 filtered pixels (the series of each, weighed with the expected light).
//! Out: its centre, and the covariance of that. The model is a Gaussian spot passed through the same
//! filter. The filter has made the noise of neighbours alike; with its covariance taken into account
//! the fit is as good as one on the unfiltered picture, and the bound of Cramer and Rao is met.

use std::sync::OnceLock;

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::front::{GAIN, LIGHT_PX, noise_correlation};

/// Half the side of the patch (px).
pub const HALF: i64 = 2;

/// Pixels of the patch.
pub const PIXELS: usize = 25;

/// Variance that the model lacks at each pixel, relative to the noise: real spots are no Gaussians, and
/// without it the differences of neighbours would be trusted too much.
const MODEL: f64 = 0.01;

/// Farthest from the middle of the patch that a centre is believed (px).
const FAR: f64 = 1.2;

/// The centre of a light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// From the middle pixel of the patch (px).
    pub offset: Vector2<f64>,
    /// Covariance of the offset for unit noise variance on a filtered pixel (px^2).
    pub covariance: Matrix2<f64>,
}

/// Fits the spot to a patch, rows from the top; `start` is a first guess of the offset. `None` where it
/// does not converge near the middle.
pub fn fit(patch: &[f64; PIXELS], start: Vector2<f64>) -> Option<Spot> {
    let weight = weights();
    let measured = SVector::<f64, PIXELS>::from_column_slice(patch);
    let mut state = Vector3::new(patch[PIXELS / 2].max(1e-9), start.x, start.y);
    for _ in 0..8 {
        let (model, slopes) = spot(&state);
        let weighed = slopes.transpose() * weight;
        let normal: Matrix3<f64> = weighed * slopes;
        let inverse = normal.try_inverse()?;
        let step = inverse * (weighed * (measured - model));
        state += step;
        if state.y.abs().max(state.z.abs()) > FAR || state.x <= 0.0 {
            return None;
        }
        if step.y.abs().max(step.z.abs()) < 1e-4 {
            let covariance = inverse.fixed_view::<2, 2>(1, 1).into_owned();
            return Some(Spot { offset: Vector2::new(state.y, state.z), covariance });
        }
    }
    None
}

/// The inverse of the noise covariance of a patch.
fn weights() -> &'static SMatrix<f64, PIXELS, PIXELS> {
    static WEIGHTS: OnceLock<SMatrix<f64, PIXELS, PIXELS>> = OnceLock::new();
    WEIGHTS.get_or_init(|| {
        let side = 2 * HALF as usize + 1;
        let noise = SMatrix::<f64, PIXELS, PIXELS>::from_fn(|a, b| {
            let (dx, dy) = ((a % side).abs_diff(b % side), (a / side).abs_diff(b / side));
            f64::from(noise_correlation(dx, dy)) + if a == b { MODEL } else { 0.0 }
        });
        // A correlation matrix with something added to its diagonal has an inverse.
        noise.try_inverse().unwrap_or_else(SMatrix::identity)
    })
}

/// The filtered spot of amplitude, x, y on every pixel, and its slopes by these three.
fn spot(state: &Vector3<f64>) -> (SVector<f64, PIXELS>, SMatrix<f64, PIXELS, 3>) {
    let side = 2 * HALF + 1;
    let along = |centre: f64| -> Vec<[[f64; 2]; 2]> {
        (-HALF..=HALF).map(|k| profile(k as f64 - centre)).collect()
    };
    let (xs, ys) = (along(state.y), along(state.z));
    let mut model = SVector::<f64, PIXELS>::zeros();
    let mut slopes = SMatrix::<f64, PIXELS, 3>::zeros();
    let level = 25.0 / 49.0;
    for (k, value) in model.iter_mut().enumerate() {
        let [peak_x, box_x] = xs[k % side as usize];
        let [peak_y, box_y] = ys[k / side as usize];
        let scale = 1.0 / f64::from(GAIN);
        let shape = scale * (peak_x[0] * peak_y[0] - level * box_x[0] * box_y[0]);
        *value = state.x * shape;
        slopes[(k, 0)] = shape;
        slopes[(k, 1)] = state.x * scale * (peak_x[1] * peak_y[0] - level * box_x[1] * box_y[0]);
        slopes[(k, 2)] = state.x * scale * (peak_x[0] * peak_y[1] - level * box_x[0] * box_y[1]);
    }
    (model, slopes)
}

/// One dimension of the peak `[1 3 1]` and of the box of seven over a spot `d` away: each the value and
/// its slope when the spot moves.
fn profile(d: f64) -> [[f64; 2]; 2] {
    let mut peak = [0.0; 2];
    let mut whole = [0.0; 2];
    for k in -3..=3i32 {
        let at = d + f64::from(k);
        let value = (-0.5 * at * at / (LIGHT_PX * LIGHT_PX)).exp();
        let slope = value * at / (LIGHT_PX * LIGHT_PX);
        let tap = match k.abs() {
            0 => 3.0,
            1 => 1.0,
            _ => 0.0,
        };
        peak = [peak[0] + tap * value, peak[1] + tap * slope];
        whole = [whole[0] + value, whole[1] + slope];
    }
    [peak, whole]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sequential::front;
    use vergence_imaging::Image;

    /// The filter applied to a rendered spot gives the model, and the fit its centre.
    #[test]
    fn a_spot_between_pixels_is_found_where_it_is() {
        for (x, y) in [(0.0, 0.0), (0.31, -0.44), (-0.5, 0.12)] {
            let image = Image::from_fn(21, 21, |u, v| {
                let r2 = (u as f64 - 10.0 - x).powi(2) + (v as f64 - 10.0 - y).powi(2);
                (20.0 + 200.0 * (-0.5 * r2 / (LIGHT_PX * LIGHT_PX)).exp()).round() as u8
            });
            let filtered = front::filter(&image, None);
            let patch = std::array::from_fn(|k| {
                f64::from(filtered.row(8 + k / 5)[8 + k % 5]) / f64::from(GAIN)
            });
            let spot = fit(&patch, Vector2::zeros()).unwrap();
            assert!((spot.offset - Vector2::new(x, y)).norm() < 0.01, "{spot:?} for ({x}, {y})");
        }
    }

    #[test]
    fn slopes_are_those_of_the_model() {
        let state = Vector3::new(3.0, 0.2, -0.3);
        let (_, slopes) = spot(&state);
        for k in 0..3 {
            let mut step = Vector3::zeros();
            step[k] = 1e-5;
            let numeric = (spot(&(state + step)).0 - spot(&(state - step)).0) / 2e-5;
            assert!((numeric - slopes.column(k)).norm() < 1e-6, "parameter {k}");
        }
    }
}
