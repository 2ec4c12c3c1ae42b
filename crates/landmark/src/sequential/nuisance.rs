//! What changes the picture without being a tag: background, drift, motion, lamps.
//!
//! All of these are the same functions of time at every pixel, only their strengths differ. They are
//! made an orthonormal basis, and both the series of a pixel and the expected light of a pattern are
//! freed of it before they are compared. Whatever strength a nuisance has at a pixel, it has no
//! effect on the evidence; the price is one degree of freedom each.

use super::history::History;

/// Shake below this (px rms) is the noise of the registration, not motion.
pub const STILL_PX: f64 = 0.02;

/// A lamp shows in at least this share of the rows, or it is no lamp.
const LAMP_SPREAD: f64 = 0.5;

/// Lamps below this change of the rows' brightness (relative, rms) drown in the noise of a pixel.
const LAMP_FLOOR: f64 = 1e-3;

/// Frames from which a drift of the background can be told from a pattern.
const DRIFT_FRAMES: usize = 24;

/// An orthonormal basis of the nuisances over the frames of a window.
#[derive(Debug, Clone, PartialEq)]
pub struct Nuisance {
    basis: Vec<Vec<f32>>,
    frames: usize,
}

impl Nuisance {
    /// The nuisances of a window: a constant always, the others when they are there.
    pub fn of(history: &History, lamps: &Lamps) -> Self {
        let n = history.len();
        let mut nuisance = Nuisance { basis: Vec::new(), frames: n };
        nuisance.add(vec![1.0; n]);
        if n >= DRIFT_FRAMES {
            nuisance.add(history.frames().iter().map(|p| p.time as f32).collect());
        }
        if history.shake() > STILL_PX {
            nuisance.add(history.frames().iter().map(|p| p.placement.dx as f32).collect());
            nuisance.add(history.frames().iter().map(|p| p.placement.dy as f32).collect());
        }
        for strengths in &lamps.strengths {
            nuisance.add(
                history.frames().iter().map(|p| dot(&p.placement.row_gain, strengths)).collect(),
            );
        }
        nuisance
    }

    /// Number of degrees of freedom taken.
    pub fn rank(&self) -> usize {
        self.basis.len()
    }

    /// The orthonormal basis.
    pub fn basis(&self) -> &[Vec<f32>] {
        &self.basis
    }

    /// Frames of the window.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Takes the nuisances out of a series.
    pub fn remove(&self, series: &mut [f32]) {
        for vector in &self.basis {
            let share = dot(vector, series);
            for (s, v) in series.iter_mut().zip(vector) {
                *s -= share * v;
            }
        }
    }

    /// Squared length of every column of a table of time courses once the nuisances are taken out;
    /// `scratch` is overwritten.
    pub fn rest2(&self, table: &[f32], width: usize, scratch: &mut Vec<f32>, out: &mut Vec<f32>) {
        out.resize(width, 0.0);
        scratch.resize(width, 0.0);
        squares_of_columns(table, width, out);
        for vector in &self.basis {
            dot_columns(vector, table, width, scratch);
            for (rest, share) in out.iter_mut().zip(scratch.iter()) {
                *rest = (*rest - share * share).max(0.0);
            }
        }
    }

    fn add(&mut self, mut vector: Vec<f32>) {
        let before = dot(&vector, &vector);
        // Twice, as rounding leaves a rest the first time.
        self.remove(&mut vector);
        self.remove(&mut vector);
        let rest = dot(&vector, &vector);
        if rest > 1e-4 * before && rest > 0.0 {
            let scale = rest.sqrt().recip();
            vector.iter_mut().for_each(|v| *v *= scale);
            self.basis.push(vector);
        }
    }
}

/// The two strongest common changes of the rows' brightness: one lamp under a rolling shutter has a
/// sine and a cosine part.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Lamps {
    /// Strength in every row; the brightness of the rows of a frame times it is the lamp's course.
    strengths: Vec<Vec<f32>>,
}

impl Lamps {
    /// The lamps of a window.
    pub fn of(history: &History) -> Self {
        let n = history.len();
        let rows = history.frames().front().map_or(0, |p| p.placement.row_gain.len());
        let mut table = vec![0.0f32; rows * n];
        for (t, past) in history.frames().iter().enumerate() {
            for (row, gain) in past.placement.row_gain.iter().enumerate() {
                table[row * n + t] = *gain;
            }
        }
        for row in table.chunks_exact_mut(n.max(1)) {
            let mean = row.iter().sum::<f32>() / n as f32;
            row.iter_mut().for_each(|v| *v -= mean);
        }
        let mut lamps = Lamps::default();
        if n < DRIFT_FRAMES {
            return lamps;
        }
        for _ in 0..2 {
            let everything = dot(&table, &table) / table.len().max(1) as f32;
            if f64::from(everything) < LAMP_FLOOR * LAMP_FLOOR {
                break;
            }
            let Some((direction, strengths)) = strongest(&table, n) else { break };
            let total: f64 = strengths.iter().map(|s| f64::from(s * s)).sum();
            let fourth: f64 = strengths.iter().map(|s| f64::from(s * s).powi(2)).sum();
            let spread = total * total / (fourth * rows as f64).max(1e-300);
            let level = (total / (rows * n) as f64).sqrt();
            if level < LAMP_FLOOR || spread < LAMP_SPREAD {
                break;
            }
            for (row, strength) in table.chunks_exact_mut(n).zip(&strengths) {
                row.iter_mut().zip(&direction).for_each(|(v, d)| *v -= strength * d);
            }
            lamps.strengths.push(strengths);
        }
        lamps
    }
}

/// The brightness of every row relative to the reference, smoothed over a band of rows: a tag fills
/// few columns of few rows and must not pass for a lamp.
pub fn smoothed(gain: &[f32]) -> Vec<f32> {
    let mut sums = Vec::with_capacity(gain.len() + 1);
    sums.push(0.0f64);
    for g in gain {
        sums.push(sums[sums.len() - 1] + f64::from(*g));
    }
    let band = |r: usize| (r.saturating_sub(4), (r + 5).min(gain.len()));
    (0..gain.len())
        .map(band)
        .map(|(from, to)| ((sums[to] - sums[from]) / (to - from) as f64) as f32)
        .collect()
}

/// The strongest common time course of the rows (unit length) and its strength in each: power
/// iteration.
pub fn strongest(table: &[f32], n: usize) -> Option<(Vec<f32>, Vec<f32>)> {
    let energy = |row: &&[f32]| dot(row, row);
    let start = table.chunks_exact(n).max_by(|a, b| energy(a).total_cmp(&energy(b)))?;
    let mut direction = start.to_vec();
    for _ in 0..12 {
        let mut next = vec![0.0f32; n];
        for row in table.chunks_exact(n) {
            let strength = dot(row, &direction);
            next.iter_mut().zip(row).for_each(|(s, v)| *s += strength * v);
        }
        let length = dot(&next, &next).sqrt();
        if length <= 0.0 || length.is_nan() {
            return None;
        }
        direction = next.iter().map(|v| v / length).collect();
    }
    let strengths = table.chunks_exact(n).map(|row| dot(row, &direction)).collect();
    Some((direction, strengths))
}

/// Scalar product, in eight partial sums that vectorise.
#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 8];
    let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
    let tail: f32 = a8.remainder().iter().zip(b8.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a8.zip(b8) {
        for k in 0..8 {
            lanes[k] += x[k] * y[k];
        }
    }
    lanes.iter().sum::<f32>() + tail
}

/// Scalar product of `vector` with the first columns of a table of rows of `width` numbers, as many
/// rows as the vector is long: many series, or many expected lights, side by side.
#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn dot_columns(vector: &[f32], table: &[f32], width: usize, out: &mut [f32]) {
    out.fill(0.0);
    for (v, row) in vector.iter().zip(table.chunks_exact(width)) {
        for (sum, t) in out.iter_mut().zip(row) {
            *sum += v * t;
        }
    }
}

/// Squared length of every column of a table, see [`dot_columns`].
#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn squares_of_columns(table: &[f32], width: usize, out: &mut [f32]) {
    let out = &mut out[..width];
    out.fill(0.0);
    for row in table.chunks_exact(width) {
        for (sum, v) in out.iter_mut().zip(row) {
            *sum += v * v;
        }
    }
}
