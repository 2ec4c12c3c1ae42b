//! Images A and B, subtracted: where a large difference is asserted continuously.

use std::collections::VecDeque;

use vergence_imaging::Image;

/// The differences of frames one lag apart, gathered over a window.
#[derive(Debug, Clone)]
pub struct PersistentDifference {
    lag: f64,
    large: f32,
    sum: Option<Image<f32>>,
    pairs: usize,
}

impl PersistentDifference {
    /// Pairs `lag` seconds apart; a difference counts when it is `large` times the picture's median.
    pub fn new(lag: f64, large: f32) -> Self {
        PersistentDifference { lag, large, sum: None, pairs: 0 }
    }

    /// Seconds between A and B.
    pub fn lag(&self) -> f64 {
        self.lag
    }

    /// Pairs a blurred frame with the earlier one that is nearest to one lag before.
    pub fn push(&mut self, time: f64, a: &Image<f32>, earlier: &VecDeque<(f64, Image<f32>)>) {
        let off = |t: f64| (time - t - self.lag).abs();
        let nearest = earlier.iter().min_by(|p, q| off(p.0).total_cmp(&off(q.0)));
        let Some((_, b)) = nearest.filter(|(t, _)| off(*t) <= 0.5 * self.lag) else { return };
        let difference =
            Image::from_fn(a.width(), a.height(), |x, y| (a.row(y)[x] - b.row(y)[x]).abs());
        let large = self.large * median(&difference).max(0.1);
        let sum = self.sum.get_or_insert_with(|| Image::filled(a.width(), a.height(), 0.0));
        for (s, &d) in sum.data_mut().iter_mut().zip(difference.data()) {
            *s += if d > large { d } else { 0.0 };
        }
        self.pairs += 1;
    }

    /// Mean large difference at every pixel (grey levels); one empty pixel before the first pair.
    pub fn mean(&self) -> Image<f32> {
        let scale = 1.0 / self.pairs.max(1) as f32;
        self.sum.as_ref().map_or_else(|| Image::filled(1, 1, 0.0), |sum| sum.map(|s| s * scale))
    }
}

/// Median of the picture, from every seventh pixel.
fn median(image: &Image<f32>) -> f32 {
    let mut values: Vec<f32> = image.data().iter().copied().step_by(7).collect();
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}
