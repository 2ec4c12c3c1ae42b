//! The per-frame work on every pixel: a small matched filter and running statistics of its output.
//!
//! The filter is the image of a point light less its mean over 7x7 pixels: `[1 3 1] x [1 3 1]` minus
//! a box of the same sum. Its response to a constant and to a ramp is zero, so lamps and shadows that
//! change a neighbourhood as a whole drop out before anything is counted.

use multiversion::multiversion;
use vergence_imaging::Image;

/// Half the side of the filter's support (px).
pub const REACH: usize = 3;

/// Standard deviation of the image of a light (px).
pub const LIGHT_PX: f64 = 0.68;

/// Filter output per grey level of a light whose image is a Gaussian of 0.68 px on a pixel centre.
pub const GAIN: f32 = 12.03;

/// What the box takes from a light, relative to what is left.
pub const BOX_SHARE: f64 = 1.42 / 12.03;

/// Standard deviation of the filter output per grey level of white pixel noise.
pub const NOISE_GAIN: f32 = 10.4;

/// Variance (px^2) of the blob that a point light makes in the filtered image.
pub const BLOB_VARIANCE: f64 = 2.0 * LIGHT_PX * LIGHT_PX;

/// Covariance of the filter output between two pixels that lie `dx` and `dy` (px, up to 4) apart,
/// relative to its variance, when the noise of the pixels is white.
pub fn noise_correlation(dx: usize, dy: usize) -> f32 {
    // Peak with peak, peak with box, box with box: all are products of one dimension each.
    const PEAK: [f32; 5] = [11.0, 6.0, 1.0, 0.0, 0.0];
    const CROSS: [f32; 5] = [5.0, 5.0, 5.0, 4.0, 1.0];
    const BOX: [f32; 5] = [7.0, 6.0, 5.0, 4.0, 3.0];
    let level = 25.0 / 49.0;
    let at = |x: usize, y: usize| {
        let product = |of: &[f32; 5]| of[x.min(4)] * of[y.min(4)];
        product(&PEAK) - 2.0 * level * product(&CROSS) + level * level * product(&BOX)
    };
    at(dx, dy) / at(0, 0)
}

/// Applies the filter; the border repeats the outermost pixel. `reuse`: a picture whose memory may be
/// taken when it has the right size.
pub fn filter(image: &Image<u8>, reuse: Option<Image<i16>>) -> Image<i16> {
    let (width, height) = (image.width(), image.height());
    let fits = |old: &Image<i16>| (old.width(), old.height()) == (width, height);
    let mut out = reuse.filter(fits).unwrap_or_else(|| Image::filled(width, height, 0i16));
    let row = |y: i64| image.row(y.clamp(0, height as i64 - 1) as usize);
    let padded = width + 2 * REACH;
    let (mut three, mut seven) = (vec![0u16; padded], vec![0u16; padded]);
    let (mut pairs, mut fours) = (vec![0u16; padded], vec![0u16; padded]);
    for y in -4..3 {
        add_row(&mut seven[REACH..REACH + width], row(y));
    }
    for y in 0..height as i64 {
        slide(&mut seven[REACH..REACH + width], row(y + 3), row(y - 4));
        weigh(&mut three[REACH..REACH + width], row(y - 1), row(y), row(y + 1));
        for sums in [&mut three, &mut seven] {
            let (first, last) = (sums[REACH], sums[REACH + width - 1]);
            sums[..REACH].fill(first);
            sums[REACH + width..].fill(last);
        }
        combine(out.row_mut(y as usize), &three, &seven, &mut pairs, &mut fours);
    }
    out
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add_row(sums: &mut [u16], row: &[u8]) {
    for (s, &v) in sums.iter_mut().zip(row) {
        *s += u16::from(v);
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn slide(sums: &mut [u16], enters: &[u8], leaves: &[u8]) {
    let n = sums.len();
    let (enters, leaves) = (&enters[..n], &leaves[..n]);
    for x in 0..n {
        sums[x] = sums[x] + u16::from(enters[x]) - u16::from(leaves[x]);
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn weigh(sums: &mut [u16], above: &[u8], here: &[u8], below: &[u8]) {
    let n = sums.len();
    let (above, here, below) = (&above[..n], &here[..n], &below[..n]);
    for x in 0..n {
        sums[x] = u16::from(above[x]) + 3 * u16::from(here[x]) + u16::from(below[x]);
    }
}

/// Sums along the row: `[1 3 1]` of `three`, a box of seven of `seven`, and their difference.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn combine(out: &mut [i16], three: &[u16], seven: &[u16], pairs: &mut [u16], fours: &mut [u16]) {
    let (n, padded) = (out.len(), seven.len());
    let (a, b) = (&seven[..padded - 1], &seven[1..padded]);
    for (p, (a, b)) in pairs.iter_mut().zip(a.iter().zip(b)) {
        *p = a + b;
    }
    let (a, b) = (&pairs[..padded - 3], &pairs[2..padded - 1]);
    for (f, (a, b)) in fours.iter_mut().zip(a.iter().zip(b)) {
        *f = a + b;
    }
    let (fours, pairs, last) = (&fours[..n], &pairs[4..n + 4], &seven[6..n + 6]);
    let (left, here, right) = (&three[2..n + 2], &three[3..n + 3], &three[4..n + 4]);
    for x in 0..n {
        let peak = left[x] + 3 * here[x] + right[x];
        let sum = fours[x] + pairs[x] + last[x];
        // 25/49 in 16-bit fixed point: the box weighs as much as the peak.
        let mean = ((u32::from(sum) * 33_437) >> 16) as u16;
        out[x] = peak.wrapping_sub(mean) as i16;
    }
}

/// Running mean and variance of the filtered frames at every pixel.
#[derive(Debug, Clone)]
pub struct Variation {
    frames: usize,
    window: usize,
    mean: Vec<f32>,
    energy: Vec<f32>,
}

impl Variation {
    /// Statistics of pictures of a given size; frames older than `window` fade.
    pub fn new(pixels: usize, window: usize) -> Self {
        Variation { frames: 0, window, mean: vec![0.0; pixels], energy: vec![0.0; pixels] }
    }

    /// Takes the next filtered frame.
    pub fn push(&mut self, filtered: &[i16]) {
        let keep = if self.frames < self.window { 1.0 } else { 1.0 - 1.0 / self.window as f32 };
        self.frames = (self.frames + 1).min(self.window.max(2));
        let share = 1.0 / self.frames as f32;
        update(&mut self.mean, &mut self.energy, filtered, share, keep);
    }

    /// Sum of squared deviations from the mean at every pixel (filter units squared).
    pub fn energy(&self) -> &[f32] {
        &self.energy
    }
}

/// Welford's update of mean and sum of squares.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn update(mean: &mut [f32], energy: &mut [f32], value: &[i16], share: f32, keep: f32) {
    let n = mean.len();
    let weight = 1.0 - share;
    let (energy, value) = (&mut energy[..n], &value[..n]);
    for i in 0..n {
        let step = f32::from(value[i]) - mean[i];
        mean[i] += step * share;
        energy[i] = energy[i] * keep + step * step * weight;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ramps_vanish_and_a_light_keeps_its_amplitude() {
        let light = |x: usize, y: usize| {
            let r2 = (x as f64 - 20.0).powi(2) + (y as f64 - 15.0).powi(2);
            40.0 * (-r2 / (2.0 * 0.68 * 0.68)).exp()
        };
        let image =
            Image::from_fn(40, 30, |x, y| (50.0 + 2.0 * x as f64 + y as f64 + light(x, y)) as u8);
        let filtered = filter(&image, None);
        let peak = f32::from(filtered.row(15)[20]) / GAIN;
        assert!((peak - 40.0).abs() < 1.0, "{peak}");
        let flat = f32::from(filtered.row(8)[9]) / GAIN;
        assert!(flat.abs() < 0.2, "{flat}");
    }

    #[test]
    fn the_filter_equals_its_definition_at_every_pixel() {
        let image = Image::from_fn(33, 21, |x, y| (x * 37 + y * 91 + x * y) as u8);
        let at =
            |x: i64, y: i64| i64::from(image.row(y.clamp(0, 20) as usize)[x.clamp(0, 32) as usize]);
        let filtered = filter(&image, None);
        for y in 0..21i64 {
            for x in 0..33i64 {
                let taps = [1, 3, 1];
                let (mut peak, mut sum) = (0, 0);
                for (j, v) in (-3..=3).enumerate() {
                    for (i, u) in (-3..=3).enumerate() {
                        sum += at(x + u, y + v);
                        if (2..5).contains(&i) && (2..5).contains(&j) {
                            peak += taps[i - 2] * taps[j - 2] * at(x + u, y + v);
                        }
                    }
                }
                let expected = peak as f64 - sum as f64 * 25.0 / 49.0;
                let got = f64::from(filtered.row(y as usize)[x as usize]);
                assert!((got - expected).abs() <= 1.5, "({x}, {y}): {got} is not {expected}");
            }
        }
    }

    #[test]
    fn variation_is_the_sum_of_squares() {
        let mut variation = Variation::new(1, 10);
        for value in [3i16, -7, 12, 5] {
            variation.push(&[value]);
        }
        assert!((variation.energy()[0] - 184.75).abs() < 1e-3);
    }
}
