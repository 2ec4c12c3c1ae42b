//! The last filtered frames, and the brightness over time at any place between pixels.

use std::collections::VecDeque;
use std::ops::Range;

use nalgebra::Point2;
use vergence_imaging::Image;

use super::front::{GAIN, noise_correlation};
use super::motion::Placement;
use super::shift::weights;

/// One frame of the past.
#[derive(Debug, Clone)]
pub struct Past {
    /// Seconds since the first frame.
    pub time: f64,
    /// Exposure of a row (s).
    pub exposure: f64,
    /// Where the picture lay; the brightness of its rows is smoothed.
    pub placement: Placement,
    /// The filtered picture, moved back to where the first frame lay.
    pub filtered: Image<i16>,
}

/// A window of frames of constant length.
#[derive(Debug, Clone)]
pub struct History {
    frames: VecDeque<Past>,
    capacity: usize,
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
        History { frames: VecDeque::new(), capacity, gone: 0, times: Vec::new(), shifts: [0.0; 3] }
    }

    /// Adds a frame; when the window is full the oldest leaves, and its picture is given back to be
    /// used again.
    pub fn push(&mut self, past: Past) -> Option<Image<i16>> {
        let mut left = None;
        if self.frames.len() == self.capacity {
            left = self.frames.pop_front().map(|p| {
                self.count(&p.placement, -1.0);
                p.filtered
            });
            self.times.remove(0);
            self.gone += 1;
        }
        self.times.push((past.time, past.exposure));
        self.count(&past.placement, 1.0);
        self.frames.push_back(past);
        left
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

    /// Number of frames.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Times since the first frame and exposures (s).
    pub fn times(&self) -> &[(f64, f64)] {
        &self.times
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

    /// Brightness over time (grey levels of a light there) at a place of the first frame.
    pub fn series(&self, place: Point2<f64>, out: &mut Vec<f32>) {
        out.clear();
        out.extend(self.frames.iter().map(|p| cubic(&p.filtered, place.x, place.y) / GAIN));
    }

    /// The same on a pixel.
    pub fn series_at(&self, (x, y): (usize, usize), out: &mut Vec<f32>) {
        out.clear();
        let scale = 1.0 / GAIN;
        out.extend(self.frames.iter().map(|p| f32::from(p.filtered.row(y)[x]) * scale));
    }

    /// Change of brightness since the first frame of the window for many pixels of one row, frame by
    /// frame for all pixels: memory is read and written in the order in which it lies.
    pub fn changes_of_row(&self, y: usize, columns: &[usize], out: &mut Vec<f32>) {
        out.clear();
        let Some(first) = self.frames.front().map(|p| p.filtered.row(y)) else { return };
        for past in &self.frames {
            let row = past.filtered.row(y);
            let change = |&x: &usize| f32::from(row[x].wrapping_sub(first[x])) * (1.0 / GAIN);
            out.extend(columns.iter().map(change));
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

/// Catmull-Rom interpolation between pixels, clamped to the border.
fn cubic(image: &Image<i16>, x: f64, y: f64) -> f32 {
    let (fx, fy) = (x.floor(), y.floor());
    let (wx, wy) = (weights((x - fx) as f32), weights((y - fy) as f32));
    let (x0, y0) = (fx as i64 - 1, fy as i64 - 1);
    let clamp = |v: i64, n: usize| v.clamp(0, n as i64 - 1) as usize;
    let mut sum = 0.0;
    for (j, wy) in wy.iter().enumerate() {
        let row = image.row(clamp(y0 + j as i64, image.height()));
        let mut line = 0.0;
        for (i, wx) in wx.iter().enumerate() {
            line += wx * f32::from(row[clamp(x0 + i as i64, image.width())]);
        }
        sum += wy * line;
    }
    sum
}
