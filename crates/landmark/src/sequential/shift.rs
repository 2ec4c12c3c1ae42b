//! Moving a whole picture by a fraction of a pixel.

use multiversion::multiversion;
use vergence_imaging::Image;

/// Weights of Catmull-Rom interpolation for the pixels at -1, 0, 1, 2 around a fraction in [0, 1).
pub fn weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// The picture sampled at `(x + dx, y + dy)` for every pixel `(x, y)`, clamped to the border: takes
/// out a shift of the content by `(dx, dy)`.
pub fn shifted<T: Copy + Into<f32>>(image: &Image<T>, dx: f64, dy: f64) -> Image<f32> {
    let (width, height) = (image.width(), image.height());
    let (fx, fy) = (dx.floor(), dy.floor());
    let (wx, wy) = (weights((dx - fx) as f32), weights((dy - fy) as f32));
    let (x0, y0) = (fx as i64 - 1, fy as i64 - 1);
    let mut out = Image::filled(width, height, 0.0f32);
    let mut column = vec![0.0f32; width];
    let mut padded = vec![0.0f32; width + 3];
    for y in 0..height {
        column.fill(0.0);
        for (j, &weight) in wy.iter().enumerate() {
            let from = (y as i64 + y0 + j as i64).clamp(0, height as i64 - 1) as usize;
            for (c, &v) in column.iter_mut().zip(image.row(from)) {
                *c += weight * v.into();
            }
        }
        for (i, p) in padded.iter_mut().enumerate() {
            *p = column[(i as i64 + x0).clamp(0, width as i64 - 1) as usize];
        }
        along_row(out.row_mut(y), &padded, wx);
    }
    out
}

/// The nearest whole number, without a call of the C library for every pixel.
pub fn rounded(value: f32) -> i16 {
    ((value + 32_768.5) as i32 - 32_768) as i16
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn along_row(out: &mut [f32], padded: &[f32], w: [f32; 4]) {
    let n = out.len();
    let (a, b) = (&padded[..n], &padded[1..n + 1]);
    let (c, d) = (&padded[2..n + 2], &padded[3..n + 3]);
    for x in 0..n {
        out[x] = w[0] * a[x] + w[1] * b[x] + w[2] * c[x] + w[3] * d[x];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_smooth_picture_is_moved_to_a_hundredth() {
        let wave = |x: f64, y: f64| 50.0 + 20.0 * (0.5 * x).sin() * (0.4 * y).cos();
        let image = Image::from_fn(40, 30, |x, y| wave(x as f64, y as f64) as f32);
        for (dx, dy) in [(0.3, -0.6), (-2.25, 1.5)] {
            let moved = shifted(&image, dx, dy);
            for y in 5..25 {
                for x in 5..35 {
                    let expected = wave(x as f64 + dx, y as f64 + dy);
                    assert!((f64::from(moved.row(y)[x]) - expected).abs() < 0.3);
                }
            }
        }
    }
}
