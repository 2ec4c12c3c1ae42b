//! The last filtered frames, and the brightness over time at any place between pixels.

use std::array::from_fn;
use std::collections::VecDeque;
use std::ops::Range;

use nalgebra::Point2;
use vergence_imaging::Image;

use super::front::{GAIN, noise_correlation};
use super::motion::Placement;
use super::shift::weights;
use crate::FinderError;

/// Most memory for pictures (bytes): full HD over the usual window takes three quarters of it.
const MOST_MEMORY: usize = 1 << 30;

/// One frame of the past.
#[derive(Debug, Clone)]
pub struct Past {
    /// Seconds since the first frame.
    pub time: f64,
    /// Exposure of a row (s).
    pub exposure: f64,
    /// Where the picture lay; the brightness of its rows is smoothed.
    pub placement: Placement,
}

/// A window of frames of constant length.
#[derive(Debug, Clone)]
pub struct History {
    frames: VecDeque<Past>,
    capacity: usize,
    /// Columns and rows.
    size: (usize, usize),
    /// The filtered pictures, moved back to where the first frame lay. All frames of a row lie side by
    /// side, as whoever looks back looks at few rows; a new frame takes the place of the oldest.
    pictures: Vec<i16>,
    /// Frames that have left.
    gone: usize,
    /// Times since the first frame and exposures (s).
    times: Vec<(f64, f64)>,
    /// Sums of the shifts and of their squares: dx, dy, dx^2 + dy^2.
    shifts: [f64; 3],
}

impl History {
    /// An empty window.
    pub fn new(capacity: usize) -> Self {
        History {
            frames: VecDeque::new(),
            capacity,
            size: (0, 0),
            pictures: Vec::new(),
            gone: 0,
            times: Vec::new(),
            shifts: [0.0; 3],
        }
    }

    /// Takes all memory for pictures of so many columns and rows. It is written, so that no frame has to
    /// wait until the system hands it out. Pictures that would need too much are refused and none is taken.
    pub fn prepare(&mut self, (width, height): (usize, usize)) -> Result<(), FinderError> {
        if self.size != (width, height) {
            let (frames, most) =
                (self.capacity, MOST_MEMORY / size_of::<i16>() / self.capacity.max(1));
            if width.saturating_mul(height) > most {
                return Err(FinderError::TooLarge { width, height, frames, most });
            }
            self.size = (width, height);
            self.pictures = vec![i16::MIN; width * height * self.capacity];
        }
        Ok(())
    }

    /// Adds a frame and its filtered picture; when the window is full the oldest leaves.
    pub fn push(&mut self, past: Past, filtered: &Image<i16>) -> Result<(), FinderError> {
        self.prepare((filtered.width(), filtered.height()))?;
        if self.frames.len() == self.capacity {
            if let Some(oldest) = self.frames.pop_front() {
                self.count(&oldest.placement, -1.0);
            }
            self.times.remove(0);
            self.gone += 1;
        }
        self.times.push((past.time, past.exposure));
        self.count(&past.placement, 1.0);
        self.frames.push_back(past);
        let (slot, width) = (self.numbers().last().unwrap_or(0) % self.capacity, self.size.0);
        let places = self.pictures.chunks_exact_mut(width).skip(slot).step_by(self.capacity);
        for (place, row) in places.zip(filtered.data().chunks_exact(width)) {
            place.copy_from_slice(row);
        }
        Ok(())
    }

    /// One row of the filtered pictures, frame by frame.
    fn row(&self, y: usize) -> impl Iterator<Item = &[i16]> {
        let (width, length) = (self.size.0, self.size.0 * self.capacity);
        let (newer, older) =
            self.pictures[y * length..][..length].split_at(self.gone % self.capacity * width);
        older.chunks_exact(width).chain(newer.chunks_exact(width)).take(self.frames.len())
    }

    fn count(&mut self, Placement { dx, dy, .. }: &Placement, sign: f64) {
        for (sum, v) in self.shifts.iter_mut().zip([*dx, *dy, dx * dx + dy * dy]) {
            *sum += sign * v;
        }
    }

    /// Longest window (frames).
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Numbers of the frames of the window, counted from the first frame ever.
    pub fn numbers(&self) -> Range<usize> {
        self.gone..self.gone + self.frames.len()
    }

    /// The frames, oldest first.
    pub fn frames(&self) -> &VecDeque<Past> {
        &self.frames
    }

    /// Columns and rows of the pictures.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Number of frames.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Times since the first frame and exposures (s).
    pub fn times(&self) -> &[(f64, f64)] {
        &self.times
    }

    /// Time from the window's first frame to its last (s).
    pub fn span(&self) -> f64 {
        self.times.last().map_or(0.0, |l| l.0) - self.times.first().map_or(0.0, |f| f.0)
    }

    /// Mean shift of the picture over the window (px).
    pub fn mean_shift(&self) -> (f64, f64) {
        let n = self.frames.len().max(1) as f64;
        (self.shifts[0] / n, self.shifts[1] / n)
    }

    /// Root mean square of the shift about its mean (px).
    pub fn shake(&self) -> f64 {
        let (mx, my) = self.mean_shift();
        let n = self.frames.len().max(1) as f64;
        (self.shifts[2] / n - mx * mx - my * my).max(0.0).sqrt()
    }

    /// Brightness over time (grey levels of a light there) at a place of the first frame: Catmull-Rom
    /// interpolation between pixels, clamped to the border.
    pub fn series(&self, place: Point2<f64>, out: &mut Vec<f32>) {
        let (fx, fy) = (place.x.floor(), place.y.floor());
        let (wx, wy) = (weights((place.x - fx) as f32), weights((place.y - fy) as f32));
        let clamp = |v: f64, k: usize, n: usize| (v as i64 - 1 + k as i64).clamp(0, n as i64 - 1);
        let columns: [usize; 4] = from_fn(|k| clamp(fx, k, self.size.0) as usize);
        out.clear();
        out.resize(self.len(), 0.0);
        for (k, wy) in wy.iter().enumerate() {
            let row = self.row(clamp(fy, k, self.size.1) as usize);
            for (sum, row) in out.iter_mut().zip(row) {
                let along: f32 = columns.iter().zip(wx).map(|(x, w)| w * f32::from(row[*x])).sum();
                *sum += wy / GAIN * along;
            }
        }
    }

    /// The same on a pixel.
    pub fn series_at(&self, (x, y): (usize, usize), out: &mut Vec<f32>) {
        out.clear();
        out.extend(self.row(y).map(|row| f32::from(row[x]) * (1.0 / GAIN)));
    }

    /// Change of brightness since the first frame of the window for many pixels of one row, frame by
    /// frame for all pixels: memory is read and written in the order in which it lies.
    pub fn changes_of_row(&self, y: usize, columns: &[usize], out: &mut Vec<f32>) {
        out.resize(columns.len() * self.len(), 0.0);
        let Some(first) = self.row(y).next() else { return };
        let first: Vec<i16> = columns.iter().map(|&x| first[x]).collect();
        for (row, out) in self.row(y).zip(out.chunks_exact_mut(columns.len().max(1))) {
            for ((change, &x), first) in out.iter_mut().zip(columns).zip(&first) {
                *change = f32::from(row[x].wrapping_sub(*first)) * (1.0 / GAIN);
            }
        }
    }
}

/// Noise variance of a series between pixels relative to that on a pixel: interpolation averages
/// neighbours, whose noise the filter has made alike but not the same.
pub fn noise_share(place: Point2<f64>) -> f64 {
    let along = |v: f64| {
        let w = weights((v - v.floor()) as f32);
        // Sum of products of weights that lie k pixels apart.
        let lag = |k: usize| (0..4 - k).map(|i| w[i] * w[i + k]).sum::<f32>();
        [lag(0), 2.0 * lag(1), 2.0 * lag(2), 2.0 * lag(3)]
    };
    let (x, y) = (along(place.x), along(place.y));
    let mut share = 0.0;
    for (dy, wy) in y.iter().enumerate() {
        for (dx, wx) in x.iter().enumerate() {
            share += wx * wy * noise_correlation(dx, dy);
        }
    }
    f64::from(share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_that_would_take_the_memory_are_refused() {
        let mut history = History::new(192);
        let error = history.prepare((1 << 15, 1 << 15)).unwrap_err();
        assert!(matches!(error, FinderError::TooLarge { width: 32768, .. }), "{error}");
        assert!(history.prepare((usize::MAX, 2)).is_err());
        assert!(history.pictures.is_empty());
        history.prepare((64, 48)).unwrap();
        assert_eq!(history.pictures.len(), 64 * 48 * 192);
    }
}
