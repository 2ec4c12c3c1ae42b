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
    let mut kept = vec![0; width];
    for row in (1..height.saturating_sub(1)).map(|y| y * width) {
        // Lists without branches: which pixels pass cannot be foreseen.
        let mut count = 0;
        for (x, m) in magnitude[row..row + width].iter().enumerate() {
            kept[count] = x;
            count += usize::from(*m > threshold2);
        }
        let strong = count;
        count = 0;
        for k in 0..strong {
            let x = kept[k];
            kept[count] = x;
            let i = row + x;
            count += usize::from(is_ridge(&magnitude, width, i, gx[i], gy[i]));
        }
        out.extend(kept[..count].iter().map(|&x| Edgel {
            x: x as u16,
            y: (row / width) as u16,
            direction: line_direction(-gy[row + x], gx[row + x]),
        }));
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
    let (most, least, straight) = if ax >= ay { (ax, ay, 1) } else { (ay, ax, width) };
    // Down, a column to the right or to the left; where right goes with up, the way back.
    let same = (gx < 0.0) == (gy < 0.0);
    let diagonal = if same { width + 1 } else { width - 1 };
    let (ahead, behind) = (i + diagonal, i - diagonal);
    let (ahead, behind) = if !same && ax >= ay { (behind, ahead) } else { (ahead, behind) };
    // How much lower it is there, times the larger slope.
    let here = magnitude[i];
    let drop = |straight: usize, diagonal: usize| {
        most * (here - magnitude[straight]) + least * (magnitude[straight] - magnitude[diagonal])
    };
    (drop(i + straight, ahead) > 0.0) & (drop(i - straight, behind) >= 0.0)
}
