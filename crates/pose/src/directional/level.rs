//! One scale of one picture: slopes where the object can be, and their noise.
//!
//! **In:** a view, the region that the object can reach around its landmark, a scale (a power of
//! two), how much to smooth. **Out:** the picture within the region, averaged down by the scale and
//! smoothed, its slopes and profiles across contours, and the standard deviation that sensor noise
//! gives those. Only the region is worked on, so the time depends on the object's size in pixels, not
//! on the camera's resolution.

use multiversion::multiversion;
use nalgebra::Point2;
use vergence_imaging::{Image, kernel};

/// A gradient's noise is never taken to be lower (grey levels per pixel): quantisation.
const NOISE_FLOOR: f32 = 0.12;

/// Binary places of a pixel in fixed point.
const PLACES: u32 = 24;

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Region {
    /// Leftmost column.
    pub left: usize,
    /// Topmost row.
    pub top: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Region {
    /// The part of a picture within `beside` pixels of some places; `None` when there is none.
    pub fn around(
        places: &[Point2<f64>],
        beside: f64,
        width: usize,
        height: usize,
    ) -> Option<Self> {
        let range = |axis: usize, size: usize| {
            let along = places.iter().map(|p| p[axis]);
            let low = along.clone().fold(f64::INFINITY, f64::min) - beside;
            let high = along.fold(f64::NEG_INFINITY, f64::max) + beside;
            let inside = |c: f64| c.clamp(0.0, size as f64) as usize;
            let (low, high) = (inside(low.floor()), inside(high.ceil()));
            (high > low + 7).then(|| (low, high - low))
        };
        let ((left, width), (top, height)) = (range(0, width)?, range(1, height)?);
        Some(Region { left, top, width, height })
    }
}

/// Where along a line the values of [`Level::across`] lie (px of the level from the given point).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossings {
    /// Of the first value.
    pub first: f64,
    /// From value to value: 1 to 1.42.
    pub step: f64,
}

/// A region of a picture at one scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Level {
    /// Pixels of the picture to one of this level, each way.
    pub scale: usize,
    /// Picture pixel of the region's top-left pixel (its own top-left corner pixel).
    pub origin: (usize, usize),
    /// The smoothed picture (grey levels).
    pub smooth: Image<f32>,
    /// Standard deviation of a central difference of it (grey levels per level pixel) where there is
    /// nothing but noise.
    pub slope_noise: f32,
    /// The same of a difference of two neighbours.
    pub step_noise: f32,
}

/// A region of a picture averaged down by a scale: what levels share that are smoothed differently.
pub struct Reduced {
    scale: usize,
    origin: (usize, usize),
    grey: Image<f32>,
    /// Standard deviation of its noise (grey levels).
    noise: f32,
}

impl Reduced {
    /// Averages squares of `scale` x `scale` pixels and measures the noise that is left.
    pub fn new(image: &Image<u8>, region: &Region, scale: usize) -> Self {
        let grey = reduce(image, region, scale);
        let noise = grey_noise(&grey);
        Reduced { scale, origin: (region.left, region.top), grey, noise }
    }

    /// The level with this much smoothing (standard deviation, px of the level).
    pub fn smoothed(&self, smoothing_px: f32) -> Level {
        let taps = kernel::gaussian_taps(smoothing_px);
        // White noise through the taps, then the difference of two neighbours.
        let at_lag = |lag: usize| taps.iter().zip(&taps[lag..]).map(|(a, b)| a * b).sum::<f32>();
        let gain = |lag: usize| (2.0 * at_lag(0) * (at_lag(0) - at_lag(lag))).sqrt();
        Level {
            scale: self.scale,
            origin: self.origin,
            smooth: kernel::convolve_separable(&self.grey, &taps),
            slope_noise: (self.noise * 0.5 * gain(2)).max(NOISE_FLOOR),
            step_noise: (self.noise * gain(1)).max(NOISE_FLOOR),
        }
    }
}

impl Level {
    /// Columns of the level.
    pub fn width(&self) -> usize {
        self.smooth.width()
    }

    /// Rows of the level.
    pub fn height(&self) -> usize {
        self.smooth.height()
    }

    /// Level coordinates of a picture pixel: both count from pixel centres.
    pub fn from_picture(&self, u: f64, v: f64) -> (f64, f64) {
        let s = self.scale as f64;
        ((u - self.origin.0 as f64 + 0.5) / s - 0.5, (v - self.origin.1 as f64 + 0.5) / s - 0.5)
    }

    /// Smoothed grey values along a line through (x, y), to `reach` (px of the level) and a little more on
    /// either side, in `out`; not a number where the level ends. The values are taken where the line
    /// crosses columns, or rows when it is steep: an upright edge is then sampled at pixel centres,
    /// while values between them would shift it by up to a tenth of a pixel, all along.
    pub fn across(
        &self,
        (x, y): (f64, f64),
        (nx, ny): (f64, f64),
        reach: f64,
        out: &mut Vec<f32>,
    ) -> Crossings {
        let width = self.width();
        let flat = nx.abs() >= ny.abs();
        let (main, cross, along, lean) =
            if flat { (x, y, nx, ny / nx) } else { (y, x, ny, nx / ny) };
        let (size, cross_size, stride, cross_stride) =
            if flat { (width, self.height(), 1, width) } else { (self.height(), width, width, 1) };
        let sense = along.signum();
        let half = (reach * along.abs()).ceil() + 2.0;
        let first = main.round() - sense * half;
        let data = self.smooth.data();
        // The place between rows in fixed point: whole and share by a shift and a mask, which cost
        // less than conversions that saturate.
        const ONE: i64 = 1 << PLACES;
        let fixed = |v: f64| (v * ONE as f64) as i64;
        let (start, slant) = (fixed(cross + lean * (first - main)), fixed(sense * lean));
        let (forward, last, count) = (sense as i64, size as i64 - 1, 2 * half as i64 + 1);
        let (least, most) = (fixed(1.0), fixed(cross_size as f64 - 2.0));
        let at = |k: i64| (first as i64 + forward * k, start + slant * k);
        let inside =
            |(at, place): (i64, i64)| at >= 1 && at < last && place >= least && place < most;
        let value = |(at, place): (i64, i64)| {
            let share = (place & (ONE - 1)) as f32 * (1.0 / ONE as f32);
            let i = at as usize * stride + (place >> PLACES) as usize * cross_stride;
            let (a, b) = (data[i], data[i + cross_stride]);
            a + share * (b - a)
        };
        out.clear();
        if inside(at(0)) && inside(at(count - 1)) {
            out.extend((0..count).map(|k| value(at(k))));
        } else {
            let within = |k| Some(at(k)).filter(|p| inside(*p)).map_or(f32::NAN, value);
            out.extend((0..count).map(within));
        }
        Crossings { first: (first - main) / along, step: along.abs().recip() }
    }

    /// Derivatives along columns and rows: central differences, zero on the border.
    pub fn slopes(&self) -> (Image<f32>, Image<f32>) {
        slopes(&self.smooth)
    }
}

/// Means of `scale` x `scale` squares of a region.
fn reduce(image: &Image<u8>, region: &Region, scale: usize) -> Image<f32> {
    let (width, height) = ((region.width / scale).max(1), (region.height / scale).max(1));
    let mut out = Image::filled(width, height, 0.0f32);
    if scale == 1 {
        for y in 0..height {
            let row = &image.row(region.top + y)[region.left..][..width];
            out.row_mut(y).iter_mut().zip(row).for_each(|(o, &v)| *o = f32::from(v));
        }
        return out;
    }
    let mut sums = vec![0u32; width];
    let weight = 1.0 / (scale * scale) as f32;
    for y in 0..height {
        sums.fill(0);
        for dy in 0..scale {
            let row = image.row((region.top + y * scale + dy).min(image.height() - 1));
            let row = &row[region.left..region.left + region.width];
            for (sum, square) in sums.iter_mut().zip(row.chunks_exact(scale.min(row.len()))) {
                *sum += square.iter().map(|&v| u32::from(v)).sum::<u32>();
            }
        }
        for (o, &s) in out.row_mut(y).iter_mut().zip(&sums) {
            *o = s as f32 * weight;
        }
    }
    out
}

/// Response bins to a grey level of [`grey_noise`], and the last bin.
const FINE: f32 = 4.0;
const MOST: f32 = 1023.0;

/// Bins of a row's responses, its neighbours above and below.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn responses(above: &[f32], row: &[f32], below: &[f32], bins: &mut [u16]) {
    let n = bins.len();
    let [a, b, c] = [&above[..n], &above[1..][..n], &above[2..][..n]];
    let [d, e, f] = [&row[..n], &row[1..][..n], &row[2..][..n]];
    let [g, h, i] = [&below[..n], &below[1..][..n], &below[2..][..n]];
    for k in 0..n {
        let (corners, sides) = (a[k] + c[k] + g[k] + i[k], b[k] + h[k] + d[k] + f[k]);
        let response = (corners - 2.0 * sides + 4.0 * e[k]).abs();
        bins[k] = (response * FINE).min(MOST) as u16;
    }
}

/// Standard deviation of the noise (grey levels), from the median response to a mask that is blind
/// to planes and to straight steps along rows and columns (Immerkaer's, with a median so that
/// corners and texture do not count).
fn grey_noise(image: &Image<f32>) -> f32 {
    let (width, height) = (image.width(), image.height());
    if width < 3 || height < 3 {
        return 0.0;
    }
    let mut histogram = [0usize; 1024];
    let mut bins = vec![0u16; width - 2];
    for y in (1..height - 1).step_by(2) {
        responses(image.row(y - 1), image.row(y), image.row(y + 1), &mut bins);
        bins.iter().for_each(|&b| histogram[usize::from(b)] += 1);
    }
    let half = histogram.iter().sum::<usize>() / 2;
    let mut below = 0;
    let median = histogram.iter().position(|n| {
        below += n;
        below > half
    });
    (median.unwrap_or(0) as f32 + 0.5) / FINE / (6.0 * 0.6745)
}

/// Central differences; the outermost rows and columns get zero.
fn slopes(smooth: &Image<f32>) -> (Image<f32>, Image<f32>) {
    let (width, height) = (smooth.width(), smooth.height());
    let mut gx = Image::filled(width, height, 0.0f32);
    let mut gy = gx.clone();
    if width < 3 || height < 3 {
        return (gx, gy);
    }
    for y in 1..height - 1 {
        let (above, here, below) = (smooth.row(y - 1), smooth.row(y), smooth.row(y + 1));
        for (x, g) in gx.row_mut(y)[1..width - 1].iter_mut().enumerate() {
            *g = 0.5 * (here[x + 2] - here[x]);
        }
        for (x, g) in gy.row_mut(y)[1..width - 1].iter_mut().enumerate() {
            *g = 0.5 * (below[x + 1] - above[x + 1]);
        }
    }
    (gx, gy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_that_is_in_no_picture_has_no_region() {
        let around = |x: f64, y: f64| Region::around(&[Point2::new(x, y)], 20.0, 320, 240);
        let corner = Region { left: 0, top: 200, width: 30, height: 40 };
        assert_eq!(around(10.0, 220.0), Some(corner));
        for (x, y) in [(-30.0, 100.0), (100.0, 261.0), (1e300, 100.0), (f64::NAN, f64::NAN)] {
            assert_eq!(around(x, y), None, "({x}, {y})");
        }
    }
}
