//! Which pixels deserve the full bank: energy first, then the lines of each pattern's spectrum.
//!
//! A light too weak to stand out of the noise in any single frame still varies a little more than its
//! neighbours, and varies at its pattern's frequencies only. The pixels that vary more than their
//! neighbours, about one in nine, are tested for every pattern's lines; the best few places a pattern
//! go on. Choosing by rank, not by a threshold, keeps the cost constant and needs no noise model.

use vergence_tag::Pattern;

use super::front::{GAIN, NOISE_GAIN};
use super::history::History;
use super::nuisance::{Nuisance, dot};
use super::template::lines;

/// Side of a block (px).
pub const BLOCK: usize = 16;

/// Places a pattern that go on from a scan.
const PER_PATTERN: usize = 24;

/// Places that go on for their energy alone.
const BY_ENERGY: usize = 48;

/// Distance from the border (px) within which nothing is looked for.
pub const MARGIN: usize = 4;

/// Variance that rounding to grey levels alone leaves (filter units squared).
const LEAST_VARIANCE: f32 = NOISE_GAIN * NOISE_GAIN / 12.0;

/// Noise of every block.
#[derive(Debug, Clone, Default)]
pub struct BlockNoise {
    across: usize,
    /// Median variance of the filter output (filter units squared).
    variance: Vec<f32>,
}

impl BlockNoise {
    /// From the running energy of `frames` frames: the median of a block, which a tag cannot move.
    pub fn new(energy: &[f32], width: usize, height: usize, frames: usize) -> Self {
        let (across, down) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        let mut variance = Vec::with_capacity(across * down);
        let mut values = Vec::with_capacity(BLOCK * BLOCK / 2);
        for block in 0..across * down {
            let (x0, y0) = (block % across * BLOCK, block / across * BLOCK);
            values.clear();
            for y in (y0..(y0 + BLOCK).min(height)).step_by(2) {
                let row = &energy[y * width + x0..y * width + (x0 + BLOCK).min(width)];
                values.extend_from_slice(row);
            }
            let middle = values.len() / 2;
            let median = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
            variance.push((median / frames.saturating_sub(1).max(1) as f32).max(LEAST_VARIANCE));
        }
        BlockNoise { across, variance }
    }

    /// Whether nothing has been measured yet.
    pub fn is_empty(&self) -> bool {
        self.variance.is_empty()
    }

    /// Noise variance of a light's amplitude in one frame at a pixel (grey levels squared).
    pub fn at(&self, x: usize, y: usize) -> f64 {
        let block = y / BLOCK * self.across + x / BLOCK;
        f64::from(self.variance.get(block).copied().unwrap_or(LEAST_VARIANCE) / (GAIN * GAIN))
    }

    /// Median over the picture of the noise variance (grey levels squared).
    pub fn median(&self) -> f64 {
        let mut sorted = self.variance.clone();
        sorted.sort_by(f32::total_cmp);
        f64::from(sorted.get(sorted.len() / 2).copied().unwrap_or(LEAST_VARIANCE) / (GAIN * GAIN))
    }
}

/// A pixel that may hold a light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Column and row in the first frame.
    pub pixel: (usize, usize),
    /// The request for whose lines it was chosen; `None`: it varies strongly, whatever its pattern.
    pub request: Option<usize>,
}

/// Pixels that vary far more than their block: strong lights, found without waiting for a scan.
pub fn by_energy(
    energy: &[f32],
    width: usize,
    height: usize,
    frames: usize,
    noise: &BlockNoise,
) -> Vec<Candidate> {
    // Five standard deviations of the chi-square above its mean.
    let freedom = frames.saturating_sub(1).max(1) as f32;
    let limit = freedom * (1.0 + 5.0 * (2.0 / freedom).sqrt());
    let mut found: Vec<(f32, (usize, usize))> = Vec::new();
    for y in MARGIN..height - MARGIN {
        let blocks = &noise.variance[y / BLOCK * noise.across..];
        for (bx, variance) in blocks[..noise.across].iter().enumerate() {
            let (from, to) = ((bx * BLOCK).max(MARGIN), ((bx + 1) * BLOCK).min(width - MARGIN));
            if from >= to {
                continue;
            }
            let row = &energy[y * width + from..y * width + to];
            if !exceeds(row, limit * variance) {
                continue;
            }
            let around = [y - 1, y, y + 1].map(|v| &energy[v * width..(v + 1) * width]);
            for x in from..to {
                let here = energy[y * width + x];
                if here > limit * variance && is_peak(around, x) {
                    found.push((here / variance, (x, y)));
                }
            }
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut kept: Vec<Candidate> = Vec::new();
    for (_, pixel) in found {
        if kept.len() == BY_ENERGY {
            break;
        }
        kept.push(Candidate { pixel, request: None });
    }
    kept
}

#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn exceeds(values: &[f32], limit: f32) -> bool {
    values.iter().fold(false, |any, v| any | (*v > limit))
}

fn is_peak(rows: [&[f32]; 3], x: usize) -> bool {
    let here = rows[1][x];
    rows.iter().all(|row| row[x - 1..=x + 1].iter().all(|v| *v <= here))
}

/// Tests the varying pixels for every pattern's lines; the best places a pattern, best first.
pub fn by_lines(
    history: &History,
    energy: &[f32],
    width: usize,
    height: usize,
    noise: &BlockNoise,
    nuisance: &Nuisance,
    patterns: &[Option<&Pattern>],
) -> Vec<Candidate> {
    let times = history.times();
    let sets: Vec<Vec<Vec<f32>>> = patterns
        .iter()
        .map(|p| p.map_or_else(Vec::new, |pattern| lines(pattern, &times, nuisance)))
        .collect();
    let mut best: Vec<Vec<(f32, (usize, usize))>> = vec![Vec::new(); patterns.len()];
    let mut series = Vec::with_capacity(times.len());
    for (x, y) in peaks(energy, width, height) {
        history.series_at((x, y), &mut series);
        nuisance.remove(&mut series);
        let total = dot(&series, &series) + 40.0 * noise.at(x, y) as f32;
        for (request, set) in sets.iter().enumerate().filter(|(_, set)| !set.is_empty()) {
            let explained: f32 = set.iter().map(|line| dot(line, &series).powi(2)).sum();
            let freedom = times.len() as f32 + 40.0;
            // Twice the log likelihood ratio, less what the number of lines gains by chance.
            let score = -freedom * (-explained / total).ln_1p() - set.len() as f32;
            keep_best(&mut best[request], score, (x, y));
        }
    }
    let candidate = |request| move |(_, pixel)| Candidate { pixel, request: Some(request) };
    best.into_iter().enumerate().flat_map(|(r, list)| list.into_iter().map(candidate(r))).collect()
}

/// Keeps a list of the best places, no two of them neighbours.
fn keep_best(list: &mut Vec<(f32, (usize, usize))>, score: f32, pixel: (usize, usize)) {
    if list.len() == PER_PATTERN && list.last().is_some_and(|worst| worst.0 >= score) {
        return;
    }
    let near = |p: (usize, usize)| p.0.abs_diff(pixel.0).max(p.1.abs_diff(pixel.1)) <= 2;
    if let Some(k) = list.iter().position(|(_, p)| near(*p)) {
        if list[k].0 >= score {
            return;
        }
        list.remove(k);
    }
    let at = list.partition_point(|(s, _)| *s >= score);
    list.insert(at, (score, pixel));
    list.truncate(PER_PATTERN);
}

/// The pixels that vary more than their eight neighbours, one in nine: an edge that sways is a ridge
/// of many pixels but few peaks, and cannot crowd out a light.
fn peaks(energy: &[f32], width: usize, height: usize) -> Vec<(usize, usize)> {
    let mut chosen = Vec::new();
    for y in MARGIN..height - MARGIN {
        let row = |y: usize| &energy[y * width..(y + 1) * width];
        let (above, here, below) = (row(y - 1), row(y), row(y + 1));
        for x in MARGIN..width - MARGIN {
            let e = here[x];
            if e >= here[x - 1] && e > here[x + 1] && is_peak([above, here, below], x) {
                chosen.push((x, y));
            }
        }
    }
    chosen
}
