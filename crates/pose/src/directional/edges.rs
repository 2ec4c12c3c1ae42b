//! Oriented edge points of a level, for the search.
//!
//! **In:** a [`Level`]. **Out:** pixels where the gradient is largest across the edge and above the
//! noise, with the direction of the edge. No threshold is set by hand: the noise is measured in the
//! picture and the factor gives about one false point in three thousand pixels of pure noise.

use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use multiversion::multiversion;

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
    if width < 3 || height < 3 {
        return Vec::new();
    }
    let threshold2 = (NOISE_FACTOR * level.slope_noise).powi(2);
    let (gx, gy) = level.slopes();
    let squares = gx.data().iter().zip(gy.data()).map(|(gx, gy)| gx * gx + gy * gy);
    let magnitude: Vec<f32> = squares.collect();
    let mut out = Vec::new();
    let mut on_ridge = vec![0; width - 2];
    for y in 1..height - 1 {
        let around = [y - 1, y, y + 1].map(|y| &magnitude[y * width..][..width]);
        ridges(around, gx.row(y), gy.row(y), threshold2, &mut on_ridge);
        let found = (1..).zip(&on_ridge).filter(|(_, on)| **on != 0);
        out.extend(found.map(|(x, _)| Edgel {
            x: x as u16,
            y: y as u16,
            direction: line_direction(-gy.row(y)[x], gx.row(y)[x]),
        }));
    }
    out
}

/// Which pixels of a row but its first and last are above a threshold and largest along the gradient,
/// against their neighbours interpolated on the 3x3 square. Without branches: it is as fast as a
/// vector, and which pixels pass cannot be foreseen.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn ridges(around: [&[f32]; 3], gx: &[f32], gy: &[f32], threshold: f32, out: &mut [u32]) {
    let n = out.len();
    let [above, here, below] = around;
    let (a, b, c) = (&above[..n], &above[1..][..n], &above[2..][..n]);
    let (d, e, f) = (&here[..n], &here[1..][..n], &here[2..][..n]);
    let (g, h, i) = (&below[..n], &below[1..][..n], &below[2..][..n]);
    let (gx, gy) = (&gx[1..][..n], &gy[1..][..n]);
    // As masks, or the compiler makes branches of them.
    let choose = |first: bool, this: f32, that: f32| {
        let mask = u32::from(first).wrapping_neg();
        f32::from_bits((mask & this.to_bits()) | (!mask & that.to_bits()))
    };
    for k in 0..n {
        let (ax, ay) = (gx[k].abs(), gy[k].abs());
        let flat = ax >= ay;
        let (most, least) = (choose(flat, ax, ay), choose(flat, ay, ax));
        let (ahead, behind) = (choose(flat, f[k], h[k]), choose(flat, d[k], b[k]));
        // Down and to the right along the gradient, or down and to the left.
        let same = gx[k] * gy[k] >= 0.0;
        let (down, up) = (choose(flat, c[k], g[k]), choose(flat, g[k], c[k]));
        let (beyond, before) = (choose(same, i[k], down), choose(same, a[k], up));
        // How much lower it is there, times the larger slope.
        let drop =
            |straight: f32, diagonal: f32| most * (e[k] - straight) + least * (straight - diagonal);
        let largest = (drop(ahead, beyond) > 0.0) & (drop(behind, before) >= 0.0);
        out[k] = u32::from(largest & (e[k] > threshold));
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directional::level::{Reduced, Region};
    use vergence_imaging::Image;

    fn level(width: usize, height: usize, scale: usize) -> Level {
        // Dark on the left, bright on the right of the middle.
        let image = Image::from_fn(width, height, |x, _| if x < width / 2 { 40u8 } else { 160 });
        let whole = Region { left: 0, top: 0, width, height };
        Reduced::new(&image, &whole, scale).smoothed(0.7)
    }

    #[test]
    fn an_upright_step_has_one_upright_edge_point_a_row() {
        let found = edgels(&level(16, 10, 1));
        assert_eq!(found.len(), 8, "{found:?}");
        for (e, y) in found.iter().zip(1..) {
            assert_eq!(e.y, y);
            assert!((7..=8).contains(&e.x), "{e:?}");
            assert!((e.direction - FRAC_PI_2).abs() < 0.01, "{e:?}");
        }
    }

    #[test]
    fn a_level_too_narrow_for_slopes_has_none() {
        // The object is large and all but outside of the picture.
        for (width, height) in [(8, 64), (64, 8), (16, 64), (8, 8)] {
            assert_eq!(edgels(&level(width, height, 8)), []);
        }
    }
}
