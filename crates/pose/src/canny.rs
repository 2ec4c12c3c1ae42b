//! Canny's edge detector, bit-equal to OpenCV's `cv2.Canny(image, low, high)` with the default
//! 3x3 Sobel aperture and the L1 magnitude.
//!
//! **In:** a grey picture. **Out:** 255 on edge pixels, 0 elsewhere. Method: Sobel derivatives,
//! suppression of pixels that are not largest across the edge (in four directions), hysteresis:
//! pixels above `high` and everything above `low` connected to them. Tie-breaks are OpenCV's: the
//! left or upper neighbour must be strictly smaller, the right or lower one may be equal; on the
//! diagonals both strictly.

use vergence_imaging::{Image, kernel};

/// tan(22.5 deg) with 15 fraction bits, rounded as OpenCV does.
const TAN_22_5: i32 = 13573;

const NOT: u8 = 0;
const MAYBE: u8 = 1;
const EDGE: u8 = 255;

/// Edge pixels (255) of a picture for thresholds on the L1 norm of the Sobel derivatives.
pub fn canny(image: &Image<u8>, low: i32, high: i32) -> Image<u8> {
    let (width, height) = (image.width(), image.height());
    let (dx, dy) = kernel::sobel(image);
    // A frame of zeros spares the neighbourhood every bounds case.
    let stride = width + 2;
    let mut magnitude = vec![0i32; stride * (height + 2)];
    for y in 0..height {
        let row = &mut magnitude[(y + 1) * stride + 1..][..width];
        for ((m, gx), gy) in row.iter_mut().zip(dx.row(y)).zip(dy.row(y)) {
            *m = i32::from(gx.abs()) + i32::from(gy.abs());
        }
    }
    let mut map = vec![NOT; stride * (height + 2)];
    let mut strong: Vec<usize> = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let i = (y + 1) * stride + x + 1;
            if magnitude[i] > low && is_peak(&magnitude, stride, i, dx.row(y)[x], dy.row(y)[x]) {
                map[i] = MAYBE;
                if magnitude[i] > high {
                    map[i] = EDGE;
                    strong.push(i);
                }
            }
        }
    }
    while let Some(i) = strong.pop() {
        for row in [i - stride, i, i + stride] {
            for neighbour in row - 1..=row + 1 {
                if map[neighbour] == MAYBE {
                    map[neighbour] = EDGE;
                    strong.push(neighbour);
                }
            }
        }
    }
    let result = |x, y| if map[(y + 1) * stride + x + 1] == EDGE { EDGE } else { NOT };
    Image::from_fn(width, height, result)
}

fn is_peak(magnitude: &[i32], stride: usize, i: usize, gx: i16, gy: i16) -> bool {
    let m = magnitude[i];
    let (x, y) = (i32::from(gx).abs(), i32::from(gy).abs() << 15);
    let flat = x * TAN_22_5;
    if y < flat {
        m > magnitude[i - 1] && m >= magnitude[i + 1]
    } else if y > flat + (x << 16) {
        m > magnitude[i - stride] && m >= magnitude[i + stride]
    } else if (gx ^ gy) < 0 {
        m > magnitude[i - stride + 1] && m > magnitude[i + stride - 1]
    } else {
        m > magnitude[i - stride - 1] && m > magnitude[i + stride + 1]
    }
}
