//! Oriented edge points of a level, for the search.
//!
//! **In:** a [`Level`]. **Out:** pixels where the gradient is largest across the edge and above the
//! noise, with the direction of the edge. No threshold is set by hand: the noise is measured in the
//! picture and the factor gives about one false point in three thousand pixels of pure noise.

use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use super::level::Level;

/// How many noise deviations a gradient must exceed: exp(-k^2 / 2) of noise pixels do.
const NOISE_FACTOR: f32 = 4.0;

/// An edge point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edgel {
    /// Column in the level.
    pub x: u16,
    /// Row in the level.
    pub y: u16,
    /// Direction of the edge line in the picture (x right, y down), 0 to pi (rad).
    pub direction: f32,
}

/// The edge points of a level.
pub fn edgels(level: &Level) -> Vec<Edgel> {
    let (width, height) = (level.width(), level.height());
    let threshold2 = (NOISE_FACTOR * level.slope_noise).powi(2);
    let (gx, gy) = level.slopes();
    let (gx, gy) = (gx.data(), gy.data());
    let magnitude: Vec<f32> = gx.iter().zip(gy).map(|(gx, gy)| gx * gx + gy * gy).collect();
    let mut out = Vec::new();
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            let m = magnitude[i];
            if m <= threshold2 {
                continue;
            }
            let (gx, gy) = (gx[i], gy[i]);
            if is_ridge(&magnitude, width, i, gx, gy) {
                out.push(Edgel { x: x as u16, y: y as u16, direction: line_direction(-gy, gx) });
            }
        }
    }
    out
}

/// Direction of a line along this vector: 0 to pi (rad), right to 0.004, which shifts no edge and is
/// an eighth of what rounding to a direction of the fields does.
pub fn line_direction(dx: f32, dy: f32) -> f32 {
    // The arc tangent on [-1, 1].
    let atan = |t: f32| t * (FRAC_PI_4 + 0.273 * (1.0 - t.abs()));
    if dx.abs() < dy.abs() {
        return FRAC_PI_2 - atan(dx / dy);
    }
    let direction = if dx == 0.0 { 0.0 } else { atan(dy / dx) };
    if direction < 0.0 { direction + PI } else { direction }
}

/// Largest along the gradient: against its neighbours interpolated on the 3x3 square.
fn is_ridge(magnitude: &[f32], width: usize, i: usize, gx: f32, gy: f32) -> bool {
    let (ax, ay) = (gx.abs(), gy.abs());
    let diagonal = if (gx < 0.0) == (gy < 0.0) { width + 1 } else { width - 1 };
    let (straight, share) = if ax >= ay { (1, ay / ax) } else { (width, ax / ay) };
    let (ahead, behind) = if ax >= ay && diagonal == width - 1 {
        // Right goes with up here: the neighbour pair is (right, right-up) and (left, left-down).
        ((i + straight, i - diagonal), (i - straight, i + diagonal))
    } else {
        ((i + straight, i + diagonal), (i - straight, i - diagonal))
    };
    let mix = |(a, b): (usize, usize)| magnitude[a] + share * (magnitude[b] - magnitude[a]);
    magnitude[i] > mix(ahead) && magnitude[i] >= mix(behind)
}
