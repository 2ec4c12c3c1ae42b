//! Procedural surfaces: albedo at a point of a solid.
//!
//! Octaves and edges fade out as their size nears the pixel's footprint, so that nothing aliases.

use super::packet::{LANES, Lane, Lane3, V3};

/// How the albedo varies over a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Texture {
    /// One tone.
    Plain,
    /// Fractal grain: size of the coarsest grain (m) and contrast.
    Grain {
        /// Coarsest wavelength (m).
        size: f32,
        /// Relative amplitude.
        contrast: f32,
    },
    /// Boards along x.
    Wood,
    /// Bands of two tones across z, on horizontal faces across x.
    Stripes {
        /// Band width (m).
        width: f32,
        /// Albedo of every second band relative to the first.
        ratio: f32,
    },
    /// A label: frame, a picture and lines of lettering; size of the label (m).
    Print {
        /// Label width and height (m).
        size: [f32; 2],
    },
    /// Large soft patches, shelves and frames, as a room behind the table shows.
    Backdrop,
}

/// What a label is wrapped around.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Extent {
    /// A box of these half sides: one label on every face.
    Flat(V3),
    /// A round body of this radius: one label around it.
    Round(f32),
}

/// Hash of lattice coordinates to [0, 1).
#[inline(always)]
fn lattice(x: i32, y: i32, z: i32, seed: u32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1)
        ^ (y as u32).wrapping_mul(0x85EB_CA77)
        ^ (z as u32).wrapping_mul(0xC2B2_AE3D)
        ^ seed.wrapping_mul(0x27D4_EB2F);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    // Through a signed number, which vector units convert.
    (h >> 8) as i32 as f32 * (1.0 / 16_777_216.0)
}

/// Largest whole number not above; without a library call.
#[inline(always)]
fn floor(x: f32) -> i32 {
    // Plain casts saturate, which keeps them out of vector code; coordinates are far below 2^31.
    let whole = x as i32;
    whole - i32::from(x < whole as f32)
}

/// Points scaled about the origin.
#[inline(always)]
fn stretched(p: &Lane3, scale: f32) -> Lane3 {
    let mut out = *p;
    for value in out.iter_mut().flatten() {
        *value *= scale;
    }
    out
}

/// `1 + contrast g`.
#[inline(always)]
fn raised(mut g: Lane, contrast: f32) -> Lane {
    for value in &mut g {
        *value = 1.0 + contrast * *value;
    }
    g
}

/// Smooth value noise in [-1, 1] at eight points.
#[inline(always)]
fn noise(p: &Lane3, seed: u32) -> Lane {
    let mut out = [0.0; LANES];
    for i in 0..LANES {
        let (x, y, z) = (floor(p[0][i]), floor(p[1][i]), floor(p[2][i]));
        let ease = |t: f32| t * t * (3.0 - 2.0 * t);
        let (fx, fy, fz) =
            (ease(p[0][i] - x as f32), ease(p[1][i] - y as f32), ease(p[2][i] - z as f32));
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let edge = |y, z| mix(lattice(x, y, z, seed), lattice(x + 1, y, z, seed), fx);
        let face = |z| mix(edge(y, z), edge(y + 1, z), fy);
        out[i] = 2.0 * mix(face(z), face(z + 1), fz) - 1.0;
    }
    out
}

/// Octaves of noise, from wavelength `size` down, faded at the footprint.
#[inline(always)]
fn grain(p: &Lane3, size: f32, octaves: u32, footprint: &Lane, seed: u32) -> Lane {
    let (mut sum, mut amplitude, mut wave) = ([0.0; LANES], 0.6, size);
    for octave in 0..octaves {
        let mut visible = [0.0; LANES];
        for i in 0..LANES {
            visible[i] = (wave / (2.5 * footprint[i]) - 1.0).clamp(0.0, 1.0);
        }
        if visible.iter().all(|v| *v <= 0.0) {
            break;
        }
        let values = noise(&stretched(p, 1.0 / wave), seed.wrapping_add(octave));
        for i in 0..LANES {
            sum[i] += amplitude * visible[i] * values[i];
        }
        (amplitude, wave) = (amplitude * 0.6, wave * 0.5);
    }
    sum
}

/// 0 below `edge`, 1 above, a ramp as wide as the footprint between.
fn step(edge: f32, x: f32, footprint: f32) -> f32 {
    ((x - edge) / footprint + 0.5).clamp(0.0, 1.0)
}

/// 1 between `low` and `high`.
fn bar(low: f32, high: f32, x: f32, footprint: f32) -> f32 {
    step(low, x, footprint) - step(high, x, footprint)
}

/// Share of a square wave of unit period and half duty, box-filtered.
fn bands(x: f32, footprint: f32) -> f32 {
    let phase = x - x.floor();
    let soft = bar(0.0, 0.5, phase, footprint) + step(1.0, phase, footprint);
    let visible = (1.5 - 2.0 * footprint).clamp(0.0, 1.0);
    0.5 + (soft - 0.5) * visible
}

/// Lines of lettering on a label of size `size`, coordinates from its lower left corner: 1 is ink.
fn lettering(u: f32, v: f32, size: [f32; 2], footprint: f32, seed: u32) -> f32 {
    let [w, h] = size;
    let (x, y) = (u / w, v / h);
    let f = footprint / h;
    let frame = 1.0 - bar(0.05, 0.95, x, f) * bar(0.05, 0.95, y, f);
    // A round emblem, a title in block letters, and rows of small words.
    let r = ((x - 0.27) * w).hypot((y - 0.6) * h) / h;
    let emblem = bar(0.13, 0.22, r, f) + bar(-1.0, 0.07, r, f);
    let word = |row: i32, cell: f32| {
        let k = (x / cell).floor() as i32;
        if lattice(k, row, 0, seed) > 0.3 {
            bar(0.12, 0.88, x / cell - k as f32, f / cell)
        } else {
            0.0
        }
    };
    let title = bar(0.66, 0.84, y, f) * word(0, 0.09) * bar(0.46, 0.92, x, f);
    let row = (y / 0.09).floor() as i32;
    let fine = (0.05 / f.max(1e-6) - 0.5).clamp(0.0, 1.0);
    let text = bar(0.18, 0.74, y / 0.09 - row as f32, f / 0.09)
        * word(row, 0.045)
        * bar(0.48, 0.92, x, f)
        * bar(0.14, 0.58, y, f)
        * fine;
    let foot = bar(0.12, 0.26, y, f) * bar(0.1, 0.42, x, f) * bands(x * 31.0, 31.0 * f);
    (0.8 * frame + emblem + title + text + foot).clamp(0.0, 1.0)
}

impl Texture {
    /// Factors on the material's albedo at eight local points with local normals; `footprint` is
    /// the width of a pixel there (m).
    #[inline(always)]
    pub fn factors(
        &self,
        p: &Lane3,
        n: &Lane3,
        extent: Extent,
        footprint: &Lane,
        seed: u32,
    ) -> Lane {
        let mut out = match *self {
            Texture::Plain => raised(grain(p, 0.03, 2, footprint, seed), 0.04),
            Texture::Grain { size, contrast } => {
                raised(grain(p, size, 4, footprint, seed), contrast)
            }
            Texture::Wood => wood(p, footprint, seed),
            Texture::Backdrop => backdrop(p, n, footprint, seed),
            Texture::Stripes { .. } | Texture::Print { .. } => {
                let mut out = [0.0; LANES];
                for i in 0..LANES {
                    let (at, normal) = ([p[0][i], p[1][i], p[2][i]], [n[0][i], n[1][i], n[2][i]]);
                    out[i] = self.drawn(at, normal, extent, footprint[i], seed);
                }
                out
            }
        };
        for o in &mut out {
            *o = o.clamp(0.02, 2.0);
        }
        out
    }

    /// Textures with sharp edges, point by point.
    fn drawn(&self, p: V3, n: V3, extent: Extent, footprint: f32, seed: u32) -> f32 {
        let flat = (0..3).fold(0, |best, k| if n[k].abs() > n[best].abs() { k } else { best });
        match *self {
            Texture::Stripes { width, ratio } => {
                let s = if flat == 2 { p[0] } else { p[2] };
                let share = bands(s / (2.0 * width) + 0.25, footprint / (2.0 * width));
                (1.0 - share) + ratio * share
            }
            Texture::Print { size } => {
                let (u, v, size) = match (extent, flat) {
                    (Extent::Round(_), 2) => return 1.0,
                    (Extent::Round(radius), _) => {
                        let around = p[1].atan2(p[0]) * radius;
                        ((around + 0.5 * size[0]).rem_euclid(size[0]), p[2] + 0.5 * size[1], size)
                    }
                    (Extent::Flat(half), _) => {
                        let (a, b) = [(1, 2), (0, 2), (0, 1)][flat];
                        (p[a] + half[a], p[b] + half[b], [2.0 * half[a], 2.0 * half[b]])
                    }
                };
                1.0 - 0.78 * lettering(u, v, size, footprint, seed.wrapping_add(flat as u32))
            }
            _ => 1.0,
        }
    }
}

/// Boards of 14 cm along x.
#[inline(always)]
fn wood(p: &Lane3, footprint: &Lane, seed: u32) -> Lane {
    const BOARD: f32 = 0.14;
    let mut at = *p;
    let sway = noise(&stretched(p, 3.0), seed);
    for i in 0..LANES {
        let board = floor(p[1][i] / BOARD);
        at[0][i] = p[0][i] * 0.12 + board as f32 * 7.3;
        at[1][i] = p[1][i] + 0.02 * sway[i];
    }
    let fibre = grain(&at, 0.03, 4, footprint, seed);
    let mut out = [0.0; LANES];
    for i in 0..LANES {
        let board = floor(p[1][i] / BOARD);
        let tone = 0.16 * (lattice(board, 0, 0, seed) - 0.5);
        let off = (p[1][i] / BOARD - board as f32 - 0.5).abs() * BOARD;
        let joint = 1.0 - 0.5 * bar(0.5 * BOARD - 0.0012, BOARD, off, footprint[i]);
        out[i] = (1.0 + tone + 0.24 * fibre[i]) * joint;
    }
    out
}

/// A wall with shelves of things and dark and bright patches, soft as out of focus.
#[inline(always)]
fn backdrop(p: &Lane3, n: &Lane3, footprint: &Lane, seed: u32) -> Lane {
    let soft = grain(p, 0.8, 4, footprint, seed);
    let mut out = [0.0; LANES];
    for i in 0..LANES {
        let across = if n[0][i].abs() > 0.5 { p[1][i] } else { p[0][i] };
        // Two rows of shelves; on each, things of various widths and heights.
        let row = p[2][i] / 0.34;
        let shelf = floor(row);
        let height = row - shelf as f32;
        let cell = across / 0.11;
        let thing = floor(cell);
        let pick = |k| lattice(thing, shelf, k, seed);
        let f = (footprint[i] / 0.11).max(0.06);
        let body = bar(0.08, 0.5 + 0.5 * pick(1), cell - thing as f32, f)
            * bar(0.1, 0.35 + 0.55 * pick(2), height, f)
            * if pick(3) > 0.25 { 1.0 } else { 0.0 };
        let board = bar(0.0, 0.09, height, f);
        let wall = 1.0 + 0.4 * soft[i];
        let stocked = if (shelf == -1) | (shelf == 0) | (shelf == 2) { 1.0 } else { 0.0 };
        let tone = 0.25 + 1.2 * pick(4) + 0.3 * soft[i];
        let front = wall + stocked * (board * (0.55 - wall) + body * (tone - wall));
        out[i] = front * (0.85 + 0.15 * soft[i]);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_bounded_and_varies() {
        let row = |k: usize| [0.37, 0.11, 0.0].map(|s| [k as f32 * s; LANES]);
        let values: Vec<f32> = (0..1000).map(|k| noise(&row(k), 7)[0]).collect();
        assert!(values.iter().all(|v| v.abs() <= 1.0));
        let mean = values.iter().sum::<f32>() / 1000.0;
        let spread = values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 1000.0;
        assert!(mean.abs() < 0.1 && spread > 0.05, "mean {mean}, variance {spread}");
    }

    #[test]
    fn a_coarse_pixel_sees_the_mean() {
        let stripes = Texture::Stripes { width: 0.005, ratio: 0.2 };
        let at = |z: f32, footprint: f32| {
            stripes.drawn([0.03, 0.0, z], [1.0, 0.0, 0.0], Extent::Round(0.03), footprint, 1)
        };
        assert!((at(0.001, 0.2) - 0.6).abs() < 1e-5);
        let fine: Vec<f32> = (0..100).map(|k| at(k as f32 * 1e-4, 1e-4)).collect();
        assert!(fine.iter().any(|&v| v > 0.99) && fine.iter().any(|&v| v < 0.21));
    }
}
