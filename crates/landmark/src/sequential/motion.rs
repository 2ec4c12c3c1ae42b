//! Registration of the background: how far the picture has moved since the first frame.
//!
//! Robust least squares over the whole picture at half size: two numbers for the motion, and for every
//! row a brightness of its own, because a lamp under a rolling shutter lights rows differently. The
//! brightness of a row is the median over its pixels; in the fit, pixels that differ far from what the
//! motion explains (people, things, screens, tags) count nothing (Tukey's biweight).

use std::borrow::Cow;

use vergence_imaging::Image;

use super::median::median;
use super::shift::shifted;

/// Independent partial sums, which always add up in the same order. With eight the compiler leaves the
/// loop scalar, four times as slow.
const LANES: usize = 16;

/// Residuals (grey levels) at which a pixel counts nothing: wide while the motion is unknown, narrow
/// in the end.
const CUT: (f32, f32) = (30.0, 10.0);

/// Passes at most.
const PASSES: usize = 5;

/// The slopes hold this far from where they were taken (px of the half-size picture).
const LINEAR_PX: f64 = 0.1;

/// Every so manieth row takes part: there are far more pixels than two numbers need.
const ROW_STEP: usize = 2;

/// Slopes must carry this many times the energy that noise gives them.
const STRUCTURE: f64 = 3.0;

/// Largest shift that is followed (px of the half-size picture): sway, not a moving head.
const MOST_PX: f64 = 8.0;

/// Frames that make up the reference picture.
const REFERENCE_FRAMES: f32 = 8.0;

/// The picture against which frames are registered.
#[derive(Debug, Clone, Default)]
pub struct Reference {
    picture: Option<Image<f32>>,
    /// The newest frame at half size.
    half: Image<f32>,
    frames: f32,
    last: (f64, f64),
}

/// How one frame lies against the reference.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Placement {
    /// Shift of the picture content along columns (px).
    pub dx: f64,
    /// Shift along rows (px).
    pub dy: f64,
    /// Brightness of every second row relative to the reference's.
    pub row_gain: Vec<f32>,
}

impl Reference {
    /// Registers a frame and, while the reference is young, adds it.
    pub fn place(&mut self, image: &Image<u8>) -> Placement {
        half_size(image, &mut self.half);
        let half = &self.half;
        let Some(reference) = &mut self.picture else {
            let row_gain = vec![1.0; half.height()];
            self.picture = Some(half.clone());
            self.frames = 1.0;
            return Placement { row_gain, ..Placement::default() };
        };
        let placement = fit(reference, half, self.last);
        self.last = (placement.dx, placement.dy);
        if self.frames < REFERENCE_FRAMES {
            self.frames += 1.0;
            let back = shifted(half, 0.5 * placement.dx, 0.5 * placement.dy);
            for (y, gain) in placement.row_gain.iter().enumerate() {
                for (r, v) in reference.row_mut(y).iter_mut().zip(back.row(y)) {
                    *r += (v / gain.max(0.1) - *r) / self.frames;
                }
            }
        }
        placement
    }
}

/// Least squares by Gauss-Newton from a first guess of the shift (px of the full picture).
fn fit(reference: &Image<f32>, half: &Image<f32>, guess: (f64, f64)) -> Placement {
    let (w, h) = (half.width(), half.height());
    let mut ratios = Vec::with_capacity(w);
    let row_gain: Vec<f32> =
        (0..h).map(|y| brightness(reference.row(y), half.row(y), &mut ratios)).collect();
    let (mut dx, mut dy) = (0.5 * guess.0, 0.5 * guess.1);
    let (mut error, mut structure) = ([0.0; 2], 0.0);
    let mut cut = CUT.0;
    // Where the slopes are taken: the reference moved to the best guess so far.
    let (mut at, mut moved) = ((dx, dy), moved_to(reference, dx, dy));
    for _ in 0..PASSES {
        if (dx - at.0).hypot(dy - at.1) > LINEAR_PX {
            (at, moved) = ((dx, dy), moved_to(reference, dx, dy));
        }
        let mut normal = [0.0f64; 7];
        for (y, &gain) in row_gain.iter().enumerate().take(h - 1).skip(1).step_by(ROW_STEP) {
            let rows = [moved.row(y - 1), moved.row(y), moved.row(y + 1)];
            reduce(&accumulate(rows, half.row(y), gain, cut), &mut normal);
        }
        let [xx, xy, yy, xr, yr, rr, weight] = normal;
        let determinant = xx * yy - xy * xy;
        if determinant <= 1e-3 * xx * yy || xx <= 1.0 || yy <= 1.0 {
            return Placement { row_gain, ..Placement::default() };
        }
        let noise = rr / weight.max(1.0);
        structure = xx.min(yy) / (noise * weight).max(1.0);
        error = [(noise / xx).sqrt(), (noise / yy).sqrt()];
        let step = ((yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant);
        dx = (at.0 - step.0.clamp(-1.5, 1.5)).clamp(-MOST_PX, MOST_PX);
        dy = (at.1 - step.1.clamp(-1.5, 1.5)).clamp(-MOST_PX, MOST_PX);
        let near = step.0.hypot(step.1) < LINEAR_PX;
        if near && cut == CUT.1 {
            break;
        }
        if near {
            cut = CUT.1;
        }
    }
    // Noise alone gives slopes of half its variance. Where the slopes are little more than that in
    // some direction, the picture has no structure that could tell of motion along it.
    if structure < 0.5 * STRUCTURE {
        return Placement { row_gain, ..Placement::default() };
    }
    // A shift within its own uncertainty is none: moving a still picture only blurs it.
    let real = |d: f64, e: f64| if d.abs() > 2.5 * e { 2.0 * d } else { 0.0 };
    Placement { dx: real(dx, error[0]), dy: real(dy, error[1]), row_gain }
}

/// The content of the reference moved by `(dx, dy)`: shows at x what the reference shows at x - d.
fn moved_to(reference: &Image<f32>, dx: f64, dy: f64) -> Cow<'_, Image<f32>> {
    if dx == 0.0 && dy == 0.0 {
        return Cow::Borrowed(reference);
    }
    Cow::Owned(shifted(reference, -dx, -dy))
}

/// Brightness of a row relative to the reference: median of the ratios of its brighter pixels.
fn brightness(reference: &[f32], row: &[f32], ratios: &mut Vec<f32>) -> f32 {
    let step = (row.len() / 40).max(1);
    ratios.clear();
    let pairs = reference.iter().zip(row).step_by(step);
    ratios.extend(pairs.filter(|(r, _)| **r > 16.0).map(|(r, v)| v / r));
    if ratios.len() < 8 {
        return 1.0;
    }
    median(ratios)
}

/// Weighted sums over one row: weight; slope x, slope y, residual; products xx, xy, yy, xr, yr, rr.
#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn accumulate([above, here, below]: [&[f32]; 3], frame: &[f32], gain: f32, cut: f32) -> [f32; 10] {
    let n = here.len();
    let (above, below, frame) = (&above[..n], &below[..n], &frame[..n]);
    let scale = 1.0 / (cut * cut);
    let mut lanes = [[0.0f32; LANES]; 10];
    let mut x = 1;
    while x + 1 < n {
        // The last piece is shorter.
        let count = LANES.min(n - 1 - x);
        let (left, right) = (&here[x - 1..x - 1 + count], &here[x + 1..x + 1 + count]);
        let (b, up, down) = (&here[x..x + count], &above[x..x + count], &below[x..x + count]);
        let f = &frame[x..x + count];
        for k in 0..count {
            let (gx, gy) = (0.5 * (right[k] - left[k]), 0.5 * (down[k] - up[k]));
            let r = f[k] - gain * b[k];
            let near = (1.0 - r * r * scale).max(0.0);
            let weight = near * near;
            let (wx, wy) = (weight * gx, weight * gy);
            lanes[0][k] += weight;
            lanes[1][k] += wx;
            lanes[2][k] += wy;
            lanes[3][k] += weight * r;
            lanes[4][k] += wx * gx;
            lanes[5][k] += wx * gy;
            lanes[6][k] += wy * gy;
            lanes[7][k] += wx * r;
            lanes[8][k] += wy * r;
            lanes[9][k] += weight * r * r;
        }
        x += count;
    }
    lanes.map(|lane| lane.iter().sum())
}

/// Adds a row to the normal equations (xx, xy, yy, xr, yr, rr, weight), its own offset
/// eliminated.
fn reduce(sums: &[f32; 10], normal: &mut [f64; 7]) {
    let [weight, x, y, r, xx, xy, yy, xr, yr, rr] = sums.map(f64::from);
    if weight < 8.0 {
        return;
    }
    let centred = [xx - x * x / weight, xy - x * y / weight, yy - y * y / weight];
    let right = [xr - x * r / weight, yr - y * r / weight, rr - r * r / weight, weight];
    for (n, c) in normal.iter_mut().zip(centred.into_iter().chain(right)) {
        *n += c;
    }
}

/// The picture at half size: means of 2x2 pixels.
fn half_size(image: &Image<u8>, half: &mut Image<f32>) {
    let (w, h) = (image.width() / 2, image.height() / 2);
    if (half.width(), half.height()) != (w, h) {
        *half = Image::filled(w, h, 0.0);
    }
    for y in 0..h {
        halve(half.row_mut(y), image.row(2 * y), image.row(2 * y + 1));
    }
}

#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn halve(out: &mut [f32], upper: &[u8], lower: &[u8]) {
    let n = out.len();
    let (upper, lower) = (&upper[..2 * n], &lower[..2 * n]);
    for x in 0..n {
        let sum = u16::from(upper[2 * x])
            + u16::from(upper[2 * x + 1])
            + u16::from(lower[2 * x])
            + u16::from(lower[2 * x + 1]);
        out[x] = 0.25 * f32::from(sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(dx: f64, dy: f64, lamp: f64) -> Image<u8> {
        Image::from_fn(160, 120, |x, y| {
            let (u, v) = (x as f64 - dx, y as f64 - dy);
            let light = 1.0 + lamp * (v * 0.08).sin();
            let value = 110.0
                + 40.0 * (0.11 * u).sin() * (0.09 * v).cos()
                + 30.0 * (0.21 * u - 0.17 * v).sin();
            (light * value).clamp(0.0, 255.0).round() as u8
        })
    }

    #[test]
    fn a_shift_is_measured_under_a_lamp() {
        let mut reference = Reference::default();
        reference.place(&scene(0.0, 0.0, 0.0));
        let placed = reference.place(&scene(0.7, -0.4, 0.1));
        assert!((placed.dx - 0.7).abs() < 0.05, "{placed:?}");
        assert!((placed.dy + 0.4).abs() < 0.05, "{placed:?}");
    }

    #[test]
    fn an_empty_picture_stays_where_it_is() {
        let mut reference = Reference::default();
        let flat = Image::filled(64, 48, 90u8);
        reference.place(&flat);
        let placed = reference.place(&flat);
        assert_eq!((placed.dx, placed.dy), (0.0, 0.0));
    }
}
