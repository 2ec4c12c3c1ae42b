//! Registration of the background: how far the picture has moved since the first frame.
//!
//! Least squares over the whole picture at half size: two numbers for the motion, and for every row
//! an offset and a gain of its own, because a lamp under a rolling shutter lights rows differently.

use vergence_imaging::Image;

/// Independent partial sums: they vectorise, and always add up in the same order.
const LANES: usize = 8;

/// Frames that make up the reference picture.
const REFERENCE_FRAMES: f32 = 8.0;

/// The picture against which frames are registered.
#[derive(Debug, Clone, Default)]
pub struct Reference {
    picture: Vec<f32>,
    width: usize,
    frames: f32,
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
        let half = half_size(image);
        if self.frames == 0.0 {
            self.width = half.width();
            self.picture = half.data().to_vec();
            self.frames = 1.0;
            return Placement { row_gain: vec![1.0; half.height()], ..Placement::default() };
        }
        let (placement, change) = self.fit(&half);
        if self.frames < REFERENCE_FRAMES {
            self.frames += 1.0;
            for (p, c) in self.picture.iter_mut().zip(change) {
                *p += c / self.frames;
            }
        }
        placement
    }

    /// The placement, and what the frame differs by from the reference once it is accounted for.
    fn fit(&self, half: &Image<f32>) -> (Placement, Vec<f32>) {
        let (w, h) = (self.width, half.height());
        let mut normal = [[0.0f64; 3]; 2];
        let mut rows: Vec<RowSums> = Vec::with_capacity(h);
        for y in 0..h {
            let sums = RowSums::new(&self.picture, half.data(), w, h, y);
            if y > 0 && y + 1 < h {
                sums.reduce(&mut normal);
            }
            rows.push(sums);
        }
        let [[xx, xy, xr], [_, yy, yr]] = normal;
        let determinant = xx * yy - xy * xy;
        // A picture without structure in some direction says nothing about motion along it.
        let solvable = determinant > 1e-3 * xx * yy && xx > 1.0 && yy > 1.0;
        let (a, b) = if solvable {
            ((yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant)
        } else {
            (0.0, 0.0)
        };
        let gain = rows.iter().map(|row| row.gain(a, b)).collect();
        let mut change = vec![0.0; if self.frames < REFERENCE_FRAMES { w * h } else { 0 }];
        if !change.is_empty() {
            for y in 1..h - 1 {
                for x in 1..w - 1 {
                    let (gx, gy) = slopes(&self.picture, w, x, y);
                    let i = y * w + x;
                    change[i] = half.data()[i] - self.picture[i] - a as f32 * gx - b as f32 * gy;
                }
            }
        }
        // The content moved by d: I(x) = B(x - d), so the slope's factor is -d, at half size.
        (Placement { dx: -2.0 * a, dy: -2.0 * b, row_gain: gain }, change)
    }
}

/// Derivatives of a picture along x and y (grey levels per pixel).
fn slopes(picture: &[f32], width: usize, x: usize, y: usize) -> (f32, f32) {
    let i = y * width + x;
    (0.5 * (picture[i + 1] - picture[i - 1]), 0.5 * (picture[i + width] - picture[i - width]))
}

/// Products of the regressors of one row: 1, brightness, slope x, slope y, and the residual.
#[derive(Debug, Clone, Copy, Default)]
struct RowSums {
    sum: [f32; 5],
    product: [[f32; 5]; 5],
}

impl RowSums {
    fn new(reference: &[f32], frame: &[f32], w: usize, h: usize, y: usize) -> Self {
        let mut sums = RowSums::default();
        if y == 0 || y + 1 >= h {
            return sums;
        }
        let row = y * w;
        let (here, above, below) =
            (&reference[row..row + w], &reference[row - w..row], &reference[row + w..row + 2 * w]);
        let frame = &frame[row..row + w];
        let lane = accumulate(here, above, below, frame);
        let [b, x, yy, r, bb, bx, by, br, xx, xy, xr, yyy, yr] = lane;
        let n = (w.saturating_sub(2) / LANES * LANES) as f32;
        sums.sum = [n, b, x, yy, r];
        sums.product[1] = [0.0, bb, bx, by, br];
        sums.product[2] = [0.0, bx, xx, xy, xr];
        sums.product[3] = [0.0, by, xy, yyy, yr];
        sums
    }

    /// A product of two regressors with the row's mean taken out.
    fn centred(&self, i: usize, j: usize) -> f64 {
        let (si, sj) = (f64::from(self.sum[i]), f64::from(self.sum[j]));
        f64::from(self.product[i][j]) - si * sj / f64::from(self.sum[0].max(1.0))
    }

    /// Adds this row to the normal equations of the motion, its own offset and gain eliminated.
    fn reduce(&self, normal: &mut [[f64; 3]; 2]) {
        let brightness = self.centred(1, 1).max(1.0);
        for (i, equation) in normal.iter_mut().enumerate() {
            for (j, entry) in equation.iter_mut().enumerate() {
                let (p, q) = (i + 2, j + 2);
                *entry += self.centred(p, q) - self.centred(1, p) * self.centred(1, q) / brightness;
            }
        }
    }

    /// Brightness of the row relative to the reference's, the motion accounted for.
    fn gain(&self, a: f64, b: f64) -> f32 {
        let change =
            f64::from(self.sum[4]) - a * f64::from(self.sum[2]) - b * f64::from(self.sum[3]);
        (1.0 + change / f64::from(self.sum[1].max(1.0))) as f32
    }
}

#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn accumulate(here: &[f32], above: &[f32], below: &[f32], frame: &[f32]) -> [f32; 13] {
    let n = here.len();
    let (above, below, frame) = (&above[..n], &below[..n], &frame[..n]);
    let mut lanes = [[0.0f32; LANES]; 13];
    let mut x = 1;
    while x + LANES < n {
        let (left, right) = (&here[x - 1..x - 1 + LANES], &here[x + 1..x + 1 + LANES]);
        let (b, up, down) = (&here[x..x + LANES], &above[x..x + LANES], &below[x..x + LANES]);
        let f = &frame[x..x + LANES];
        for k in 0..LANES {
            let (gx, gy) = (0.5 * (right[k] - left[k]), 0.5 * (down[k] - up[k]));
            let (v, r) = (b[k], f[k] - b[k]);
            lanes[0][k] += v;
            lanes[1][k] += gx;
            lanes[2][k] += gy;
            lanes[3][k] += r;
            lanes[4][k] += v * v;
            lanes[5][k] += v * gx;
            lanes[6][k] += v * gy;
            lanes[7][k] += v * r;
            lanes[8][k] += gx * gx;
            lanes[9][k] += gx * gy;
            lanes[10][k] += gx * r;
            lanes[11][k] += gy * gy;
            lanes[12][k] += gy * r;
        }
        x += LANES;
    }
    lanes.map(|lane| lane.iter().sum())
}

/// The picture at half size: means of 2x2 pixels.
fn half_size(image: &Image<u8>) -> Image<f32> {
    let (w, h) = (image.width() / 2, image.height() / 2);
    let mut half = Image::filled(w, h, 0.0f32);
    for y in 0..h {
        halve(half.row_mut(y), image.row(2 * y), image.row(2 * y + 1));
    }
    half
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
