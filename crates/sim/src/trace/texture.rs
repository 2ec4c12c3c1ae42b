//! Procedural surfaces: albedo at a point of a solid.
//!
//! Octaves and edges fade out as their size nears the pixel's footprint, so that nothing aliases.

use super::packet::V3;

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
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Smooth value noise in [-1, 1].
#[inline(always)]
fn noise(p: V3, seed: u32) -> f32 {
    let cell = p.map(f32::floor);
    let [x, y, z] = cell.map(|c| c as i32);
    let f = [0, 1, 2].map(|k| {
        let t = p[k] - cell[k];
        t * t * (3.0 - 2.0 * t)
    });
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let edge = |y, z| mix(lattice(x, y, z, seed), lattice(x + 1, y, z, seed), f[0]);
    let face = |z| mix(edge(y, z), edge(y + 1, z), f[1]);
    2.0 * mix(face(z), face(z + 1), f[2]) - 1.0
}

/// Octaves of noise, from wavelength `size` down, faded at the footprint.
fn grain(p: V3, size: f32, octaves: u32, footprint: f32, seed: u32) -> f32 {
    let (mut sum, mut amplitude, mut wave) = (0.0, 0.6, size);
    for octave in 0..octaves {
        let visible = (wave / (2.5 * footprint) - 1.0).clamp(0.0, 1.0);
        if visible <= 0.0 {
            break;
        }
        sum += amplitude * visible * noise(p.map(|x| x / wave), seed.wrapping_add(octave));
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
    /// Factor on the material's albedo at a local point with local normal; `footprint` is the
    /// width of a pixel there (m).
    pub fn factor(&self, p: V3, n: V3, extent: Extent, footprint: f32, seed: u32) -> f32 {
        let flat = (0..3).fold(0, |best, k| if n[k].abs() > n[best].abs() { k } else { best });
        match *self {
            Texture::Plain => 1.0 + 0.04 * grain(p, 0.03, 2, footprint, seed),
            Texture::Grain { size, contrast } => {
                (1.0 + contrast * grain(p, size, 4, footprint, seed)).max(0.05)
            }
            Texture::Wood => {
                let board = (p[1] / 0.14).floor() as i32;
                let tone = 0.12 * (lattice(board, 0, 0, seed) - 0.5);
                let joint =
                    1.0 - 0.5 * bar(-0.001, 0.001, p[1] - (p[1] / 0.14).round() * 0.14, footprint);
                let fibre = [p[0] * 0.12, p[1] + 0.02 * noise(p.map(|x| x * 3.0), seed), p[2]];
                let offset = [board as f32 * 7.3, 0.0, 0.0];
                let at = [0, 1, 2].map(|k| fibre[k] + offset[k]);
                (1.0 + tone + 0.22 * grain(at, 0.03, 4, footprint, seed)) * joint
            }
            Texture::Stripes { width, ratio } => {
                let s = match flat {
                    2 => p[0],
                    _ => p[2],
                };
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
            Texture::Backdrop => {
                let soft = grain(p, 0.9, 4, footprint, seed);
                let q = p.map(|x| x / 0.45);
                let tile = q.map(|x| x.floor() as i32);
                let tone = lattice(tile[0], tile[1], tile[2], seed);
                let shelf = if tone > 0.6 { 1.4 - 1.6 * (tone - 0.6) } else { 1.0 };
                (0.9 + 0.55 * soft) * shelf
            }
        }
        .clamp(0.02, 2.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_bounded_and_varies() {
        let values: Vec<f32> =
            (0..1000).map(|k| noise([k as f32 * 0.37, k as f32 * 0.11, 0.5], 7)).collect();
        assert!(values.iter().all(|v| v.abs() <= 1.0));
        let mean = values.iter().sum::<f32>() / 1000.0;
        let spread = values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 1000.0;
        assert!(mean.abs() < 0.1 && spread > 0.05, "mean {mean}, variance {spread}");
    }

    #[test]
    fn a_coarse_pixel_sees_the_mean() {
        let stripes = Texture::Stripes { width: 0.005, ratio: 0.2 };
        let at = |z: f32, footprint: f32| {
            stripes.factor([0.03, 0.0, z], [1.0, 0.0, 0.0], Extent::Round(0.03), footprint, 1)
        };
        assert!((at(0.001, 0.2) - 0.6).abs() < 1e-5);
        let fine: Vec<f32> = (0..100).map(|k| at(k as f32 * 1e-4, 1e-4)).collect();
        assert!(fine.iter().any(|&v| v > 0.99) && fine.iter().any(|&v| v < 0.21));
    }
}
