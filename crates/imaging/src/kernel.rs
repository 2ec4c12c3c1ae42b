//! Blur and gradients as slice loops.
//!
//! Every loop runs over row slices of one common length, so that the bounds checks vanish and the
//! compiler vectorises; `multiversion` compiles it once more for AVX2 and picks at run time. Borders
//! repeat the outermost pixel. Results are exact sums of the stated taps, so they repeat bit for bit
//! on one kind of machine.

use multiversion::multiversion;

use crate::Image;

/// Normalised taps of a Gaussian of the given standard deviation (pixels), cut at three of them.
pub fn gaussian_taps(sigma_px: f32) -> Vec<f32> {
    let radius = (3.0 * sigma_px).ceil().max(1.0) as i32;
    let taps: Vec<f32> =
        (-radius..=radius).map(|k| (-0.5 * (k as f32 / sigma_px).powi(2)).exp()).collect();
    let sum: f32 = taps.iter().sum();
    taps.iter().map(|t| t / sum).collect()
}

/// Gaussian blur of the given standard deviation (pixels).
pub fn gaussian_blur<T: Copy + Into<f32>>(image: &Image<T>, sigma_px: f32) -> Image<f32> {
    convolve_separable(image, &gaussian_taps(sigma_px))
}

/// Convolution of rows, then columns, with one symmetric odd set of taps.
pub fn convolve_separable<T: Copy + Into<f32>>(image: &Image<T>, taps: &[f32]) -> Image<f32> {
    let (width, height, radius) = (image.width(), image.height(), taps.len() / 2);
    let mut rows = Image::filled(width, height, 0.0f32);
    if width == 0 || height == 0 {
        return rows;
    }
    let mut padded = vec![0.0f32; width + 2 * radius];
    for y in 0..height {
        let source = image.row(y);
        padded[..radius].fill(source[0].into());
        padded[radius + width..].fill(source[width - 1].into());
        for (p, &s) in padded[radius..].iter_mut().zip(source) {
            *p = s.into();
        }
        let target = rows.row_mut(y);
        for (k, &tap) in taps.iter().enumerate() {
            add_scaled(target, &padded[k..k + width], tap);
        }
    }
    let mut out = Image::filled(width, height, 0.0f32);
    for y in 0..height {
        let target = out.row_mut(y);
        for (k, &tap) in taps.iter().enumerate() {
            let from = (y + k).saturating_sub(radius).min(height - 1);
            add_scaled(target, rows.row(from), tap);
        }
    }
    out
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add_scaled(target: &mut [f32], source: &[f32], scale: f32) {
    let source = &source[..target.len()];
    for (t, s) in target.iter_mut().zip(source) {
        *t += s * scale;
    }
}

/// Sobel derivatives along x and y (grey levels per 8 pixels, as OpenCV's 3x3 kernel).
pub fn sobel(image: &Image<u8>) -> (Image<i16>, Image<i16>) {
    let (width, height) = (image.width(), image.height());
    let mut dx = Image::filled(width, height, 0i16);
    let mut dy = Image::filled(width, height, 0i16);
    if width == 0 || height == 0 {
        return (dx, dy);
    }
    let mut smooth = vec![0i16; width + 2];
    let mut slope = vec![0i16; width + 2];
    for y in 0..height {
        let (above, here, below) =
            (image.row(y.saturating_sub(1)), image.row(y), image.row((y + 1).min(height - 1)));
        sobel_columns(&mut smooth[1..=width], &mut slope[1..=width], above, here, below);
        (smooth[0], smooth[width + 1]) = (smooth[1], smooth[width]);
        (slope[0], slope[width + 1]) = (slope[1], slope[width]);
        sobel_row(dx.row_mut(y), dy.row_mut(y), &smooth, &slope);
    }
    (dx, dy)
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn sobel_columns(smooth: &mut [i16], slope: &mut [i16], above: &[u8], here: &[u8], below: &[u8]) {
    let n = smooth.len();
    let (slope, above, here, below) = (&mut slope[..n], &above[..n], &here[..n], &below[..n]);
    for x in 0..n {
        let (a, h, b) = (i16::from(above[x]), i16::from(here[x]), i16::from(below[x]));
        smooth[x] = a + 2 * h + b;
        slope[x] = b - a;
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn sobel_row(dx: &mut [i16], dy: &mut [i16], smooth: &[i16], slope: &[i16]) {
    let n = dx.len();
    let (dy, smooth, slope) = (&mut dy[..n], &smooth[..n + 2], &slope[..n + 2]);
    for x in 0..n {
        dx[x] = smooth[x + 2] - smooth[x];
        dy[x] = slope[x] + 2 * slope[x + 1] + slope[x + 2];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_stays_constant_under_blur() {
        let blurred = gaussian_blur(&Image::filled(33, 17, 80u8), 1.3);
        assert!(blurred.data().iter().all(|v| (v - 80.0).abs() < 1e-3));
    }

    #[test]
    fn a_point_spreads_to_the_gaussian() {
        let mut point = Image::filled(21, 21, 0.0f32);
        point.set(10, 10, 1.0);
        let blurred = gaussian_blur(&point, 1.0);
        let taps = gaussian_taps(1.0);
        let centre = taps.len() / 2;
        let expected = taps[centre + 1] * taps[centre - 2];
        assert!((blurred.row(8)[11] - expected).abs() < 1e-7);
    }

    #[test]
    fn sobel_of_a_plane_is_its_slope() {
        let plane = Image::from_fn(20, 12, |x, y| (3 * x + 5 * y) as u8);
        let (dx, dy) = sobel(&plane);
        for y in 1..11 {
            for x in 1..19 {
                assert_eq!((dx.row(y)[x], dy.row(y)[x]), (24, 40));
            }
        }
    }
}
