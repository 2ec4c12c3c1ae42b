//! Exact Euclidean distance transform.
//!
//! **In:** a mask. **Out:** at every pixel the distance (px) to the nearest non-zero pixel of the
//! mask; infinite when there is none. Method: Felzenszwalb and Huttenlocher, the lower envelope of
//! parabolas along columns, then along rows; exact, linear in the number of pixels.

use vergence_imaging::Image;

/// Distance (px) of every pixel to the nearest non-zero pixel.
pub fn transform(mask: &Image<u8>) -> Image<f32> {
    let (width, height) = (mask.width(), mask.height());
    let mut squared =
        Image::from_fn(width, height, |x, y| if mask.row(y)[x] != 0 { 0.0 } else { f32::INFINITY });
    let mut envelope = Envelope::default();
    let mut column = vec![0.0f32; height];
    for x in 0..width {
        for (y, value) in column.iter_mut().enumerate() {
            *value = squared.row(y)[x];
        }
        envelope.apply(&mut column);
        for (y, &value) in column.iter().enumerate() {
            squared.row_mut(y)[x] = value;
        }
    }
    for y in 0..height {
        envelope.apply(squared.row_mut(y));
    }
    squared.map(f32::sqrt)
}

/// Lower envelope of parabolas; keeps its storage between lines.
#[derive(Default)]
struct Envelope {
    /// Apex position and height of the parabolas of the envelope.
    apexes: Vec<(f32, f32)>,
    /// Where each takes over from the one before.
    starts: Vec<f32>,
}

impl Envelope {
    /// Replaces `f(q)` by `min_p f(p) + (q - p)^2`.
    fn apply(&mut self, line: &mut [f32]) {
        self.apexes.clear();
        self.starts.clear();
        for (q, &value) in line.iter().enumerate().filter(|(_, v)| v.is_finite()) {
            let q = q as f32;
            let mut start = f32::NEG_INFINITY;
            while let Some(&(p, height)) = self.apexes.last() {
                start = ((value + q * q) - (height + p * p)) / (2.0 * (q - p));
                if start > self.starts[self.apexes.len() - 1] {
                    break;
                }
                self.apexes.pop();
                self.starts.pop();
                start = f32::NEG_INFINITY;
            }
            self.apexes.push((q, value));
            self.starts.push(start);
        }
        if self.apexes.is_empty() {
            return;
        }
        let mut k = 0;
        for (q, value) in line.iter_mut().enumerate() {
            let q = q as f32;
            while k + 1 < self.starts.len() && self.starts[k + 1] < q {
                k += 1;
            }
            let (p, height) = self.apexes[k];
            *value = height + (q - p) * (q - p);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn equals_the_definition(points in prop::collection::vec((0usize..23, 0usize..17), 1..12)) {
            let mut mask = Image::filled(23, 17, 0u8);
            for &(x, y) in &points {
                mask.set(x, y, 255);
            }
            let field = transform(&mask);
            for y in 0..17 {
                for x in 0..23 {
                    let nearest = points
                        .iter()
                        .map(|&(px, py)| px.abs_diff(x).pow(2) + py.abs_diff(y).pow(2))
                        .min();
                    let expected = (nearest.unwrap() as f32).sqrt();
                    prop_assert!((field.row(y)[x] - expected).abs() < 1e-4);
                }
            }
        }
    }

    #[test]
    fn no_edge_is_infinitely_far() {
        assert!(transform(&Image::filled(5, 4, 0u8)).data().iter().all(|d| d.is_infinite()));
    }
}
