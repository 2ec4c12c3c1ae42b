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
    let mut out = Image::filled(image.width(), image.height(), 0.0f32);
    shift_rows(image, dx, dy, |y, row| out.row_mut(y).copy_from_slice(row));
    out
}

/// The same, row by row from the top, for who wants no picture of such numbers.
pub fn shift_rows<T: Copy + Into<f32>>(
    image: &Image<T>,
    dx: f64,
    dy: f64,
    mut take: impl FnMut(usize, &[f32]),
) {
    let (width, height) = (image.width(), image.height());
    let (fx, fy) = (dx.floor(), dy.floor());
    let (wx, wy) = (weights((dx - fx) as f32), weights((dy - fy) as f32));
    let (x0, y0) = (fx as i64 - 1, fy as i64 - 1);
    let (mut out, mut column) = (vec![0.0f32; width], vec![0.0f32; width]);
    let mut padded = vec![0.0f32; width + 3];
    // The part of a padded row that lies inside the picture; so much of the row is left of it.
    let inside = |x: i64| x.clamp(0, width as i64 + 3) as usize;
    let (before, after) = (inside(-x0), inside(width as i64 - x0));
    let from = x0.clamp(0, width as i64) as usize;
    for y in 0..height {
        column.fill(0.0);
        for (j, &weight) in wy.iter().enumerate() {
            let from = (y as i64 + y0 + j as i64).clamp(0, height as i64 - 1) as usize;
            add(&mut column, image.row(from), weight);
        }
        padded[..before].fill(column[0]);
        padded[before..after].copy_from_slice(&column[from..from + after - before]);
        padded[after..].fill(column[width - 1]);
        along_row(&mut out, &padded, wx);
        take(y, &out);
    }
}

#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn add<T: Copy + Into<f32>>(sums: &mut [f32], row: &[T], weight: f32) {
    for (sum, &v) in sums.iter_mut().zip(row) {
        *sum += weight * v.into();
    }
}

/// The nearest whole numbers, without a call of the C library for each.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn round(out: &mut [i16], values: &[f32]) {
    for (out, value) in out.iter_mut().zip(values) {
        *out = ((value + 32_768.5) as i32 - 32_768) as i16;
    }
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
