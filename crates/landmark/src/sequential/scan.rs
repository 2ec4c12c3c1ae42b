//! Which pixels deserve the full bank: energy first, then the lines of each pattern's spectrum.
//!
//! A light too weak to stand out of the noise in any single frame still varies a little more than its
//! neighbours, and varies at its pattern's frequencies only. The pixels that vary more than their
//! neighbours, about one in nine, and not much less than a light would that is nearly decided, are
//! tested for the lines of the patterns; patterns of one length and chip have the same lines and are
//! tested at once. The best few places go on. Choosing by rank, not by a threshold on the evidence,
//! keeps the cost constant and needs no noise model. A scan is spread over frames, as no single one may
//! take long.

use std::ops::Range;

use super::front::{GAIN, NOISE_GAIN};
use super::history::History;
use super::median::median;
use super::nuisance::{Nuisance, dot_columns, squares_of_columns};

/// Side of a block (px).
pub const BLOCK: usize = 16;

/// Places that go on from a scan for a family of patterns, and for each pattern beyond the first.
const PER_FAMILY: (usize, usize) = (24, 1);

/// Most places that go on for a family.
const MOST_PER_FAMILY: usize = 64;

/// Places that go on for their energy alone.
pub const BY_ENERGY: usize = 48;

/// Distance from the border (px) within which nothing is looked for.
pub const MARGIN: usize = 4;

/// Pixels, over all frames of the window, that a scan reads at one frame; more of a large picture, so
/// that it takes no longer than an eighth of the window.
const STEP: usize = LEAST_FRAMES * 640 * 480;

/// Frames that a scan reads of a large picture at one frame.
const LEAST_FRAMES: usize = 8;

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
                // Neighbours see the same noise; every second pixel says nearly as much as all.
                values.extend(row.iter().skip(y / 2 % 2).step_by(2));
            }
            let energy = median(&values);
            variance.push((energy / frames.saturating_sub(1).max(1) as f32).max(LEAST_VARIANCE));
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

    /// `factor` times the noise along a row (filter units squared), for every column.
    fn along(&self, y: usize, factor: f32, out: &mut [f32]) {
        let blocks = &self.variance[y / BLOCK * self.across..];
        for (part, variance) in out.chunks_mut(BLOCK).zip(blocks) {
            part.fill(factor * variance);
        }
    }

    /// Median over the picture of the noise variance (grey levels squared).
    pub fn median(&self) -> f64 {
        let mut sorted = self.variance.clone();
        sorted.sort_by(f32::total_cmp);
        f64::from(sorted.get(sorted.len() / 2).copied().unwrap_or(LEAST_VARIANCE) / (GAIN * GAIN))
    }
}

/// A pixel that may hold a light.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Column and row in the first frame.
    pub pixel: (usize, usize),
    /// The requests for which it was chosen.
    pub requests: Vec<usize>,
}

/// A pixel that varies far more than its block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strong {
    /// Column and row in the first frame.
    pub pixel: (usize, usize),
    /// Whether chance would not explain it in any picture.
    pub restless: bool,
}

/// Pixels that vary far more than their block: strong lights, found without waiting for a scan, and
/// whatever else is restless; most outstanding first.
pub fn by_energy(
    energy: &[f32],
    width: usize,
    height: usize,
    frames: usize,
    noise: &BlockNoise,
) -> Vec<Strong> {
    // Five standard deviations of the chi-square above its mean.
    let limit = chi_square(frames, 5.0);
    let mut limits = vec![0.0; width];
    let mut found: Vec<(f32, (usize, usize))> = Vec::new();
    for y in MARGIN..height - MARGIN {
        if y == MARGIN || y % BLOCK == 0 {
            noise.along(y, limit, &mut limits);
        }
        let columns = MARGIN..width - MARGIN;
        let row = &energy[y * width..(y + 1) * width];
        if !exceeds(&row[columns.clone()], &limits[columns.clone()]) {
            continue;
        }
        let around = [y - 1, y, y + 1].map(|v| &energy[v * width..(v + 1) * width]);
        for x in columns {
            if row[x] > limits[x] && is_peak(around, x) {
                found.push((row[x] / limits[x], (x, y)));
            }
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let certain = certain(frames) / limit;
    let strong = |(excess, pixel)| Strong { pixel, restless: excess > certain };
    found.into_iter().map(strong).collect()
}

/// What noise of unit variance adds up to by chance once in three million times (Wilson and
/// Hilferty's cube for the chi-square, at five standard deviations).
fn certain(frames: usize) -> f32 {
    let freedom = frames.saturating_sub(1).max(1) as f32;
    let spread = 2.0 / (9.0 * freedom);
    freedom * (1.0 - spread + 5.0 * spread.sqrt()).powi(3)
}

/// What noise of unit variance adds up to over so many frames, and `above` standard deviations more.
fn chi_square(frames: usize, above: f32) -> f32 {
    let freedom = frames.saturating_sub(1).max(1) as f32;
    freedom * (1.0 + above * (2.0 / freedom).sqrt())
}

#[multiversion::multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn exceeds(values: &[f32], limits: &[f32]) -> bool {
    values.iter().zip(limits).fold(false, |any, (v, limit)| any | (v > limit))
}

fn is_peak(rows: [&[f32]; 3], x: usize) -> bool {
    let here = rows[1][x];
    rows.iter().all(|row| row[x - 1..=x + 1].iter().all(|v| *v <= here))
}

/// Patterns whose spectra have the same lines.
pub struct Family {
    /// Their requests.
    pub requests: Vec<usize>,
    /// The lines over the window, orthonormal and free of nuisances.
    pub lines: Vec<Vec<f32>>,
}

/// A scan of the whole picture, some rows of it at every frame.
#[derive(Debug, Clone)]
pub struct Sweep {
    /// The best places so far of every family.
    best: Vec<Best>,
    /// The rows that are still to be looked at.
    rows: Range<usize>,
}

impl Sweep {
    /// Frames over which a scan of a window of so many frames is spread.
    pub fn frames((width, height): (usize, usize), window: usize) -> usize {
        (width * height * window).div_ceil(STEP).min(window.div_ceil(LEAST_FRAMES))
    }

    /// A scan that has not begun; `families`: the number of requests of each.
    pub fn new(height: usize, families: impl Iterator<Item = usize>) -> Self {
        Sweep { best: families.map(Best::of).collect(), rows: MARGIN..height - MARGIN }
    }

    /// Looks at the next rows, as many as make `steps` steps of the picture; all that are left when it
    /// is one. The best places of every family once all rows have been looked at.
    pub fn step(
        &mut self,
        view: &View,
        families: &[Family],
        steps: usize,
    ) -> Option<Vec<Candidate>> {
        let from = self.rows.start;
        self.rows.start = (from + view.size.1.div_ceil(steps)).min(self.rows.end);
        by_lines(view, families, from..self.rows.start, &mut self.best);
        if !self.rows.is_empty() {
            return None;
        }
        let mut candidates = Vec::new();
        for (family, best) in families.iter().zip(&mut self.best) {
            let candidate = |(_, pixel)| Candidate { pixel, requests: family.requests.clone() };
            candidates.extend(best.list.drain(..).map(candidate));
        }
        Some(candidates)
    }
}

/// What a scan looks at.
pub struct View<'a> {
    /// The window.
    pub history: &'a History,
    /// Columns and rows.
    pub size: (usize, usize),
    /// Energy of every pixel.
    pub energy: &'a [f32],
    /// Noise of every block.
    pub noise: &'a BlockNoise,
    /// What else changes.
    pub nuisance: &'a Nuisance,
    /// Log likelihood ratio of a light that is decided.
    pub presence: f64,
}

/// Tests the varying pixels of some rows for the lines of every family; adds to the best places of each.
fn by_lines(view: &View, families: &[Family], rows: Range<usize>, best: &mut [Best]) {
    let View { history, energy, noise, nuisance, .. } = *view;
    let width = view.size.0;
    let n = history.len();
    let limit = chi_square(n, least_excess(n, view.presence));
    let vectors = families.iter().flat_map(|f| &f.lines).chain(nuisance.basis());
    let vectors: Vec<&[f32]> = vectors.map(Vec::as_slice).collect();
    let (mut series, mut columns) = (Vec::new(), Vec::with_capacity(width / 2));
    let (mut shares, mut totals) = (Vec::new(), Vec::new());
    let mut limits = vec![0.0; width];
    for y in rows.clone() {
        if y == rows.start || y % BLOCK == 0 {
            noise.along(y, limit, &mut limits);
        }
        columns.clear();
        peaks(energy, width, y, &limits, &mut columns);
        let count = columns.len();
        if count == 0 {
            continue;
        }
        history.changes_of_row(y, &columns, &mut series);
        totals.resize(count, 0.0);
        squares_of_columns(&series, count, &mut totals);
        shares.resize(count * vectors.len(), 0.0);
        for (vector, share) in vectors.iter().zip(shares.chunks_exact_mut(count)) {
            dot_columns(vector, &series, count, share);
            share.iter_mut().for_each(|s| *s *= *s);
        }
        // The lines are free of nuisances, so that these need taking out of the total only.
        let lines: usize = families.iter().map(|f| f.lines.len()).sum();
        for (k, &x) in columns.iter().enumerate() {
            let taken = shares[lines * count..].iter().skip(k).step_by(count);
            let total = totals[k] - taken.sum::<f32>() + 40.0 * noise.at(x, y) as f32;
            let mut from = 0;
            for (family, best) in families.iter().zip(&mut *best) {
                let to = from + family.lines.len();
                let own = shares[from * count..to * count].iter().skip(k).step_by(count);
                let explained = own.sum::<f32>();
                let freedom = n as f32 + 40.0;
                // Twice the log likelihood ratio, less what the number of lines gains by chance.
                let score = -freedom * (-explained / total).ln_1p() - family.lines.len() as f32;
                best.keep(score, (x, y));
                from = to;
            }
        }
    }
}

/// By how many standard deviations of chance the energy of a light exceeds the noise when its evidence
/// reaches `presence`: less what a place between pixels and bad luck cost.
fn least_excess(frames: usize, presence: f64) -> f32 {
    // Twice the log likelihood ratio is the light's energy over the noise; in the worst place between
    // pixels 0.6 of it shows. One standard deviation may be missing by chance.
    let excess = 0.6 * 2.0 * presence / (2.0 * frames as f64).sqrt();
    (excess - 1.0).max(0.0) as f32
}

/// A list of the best places, no two of them neighbours, best first.
#[derive(Debug, Clone)]
struct Best {
    list: Vec<(f32, (usize, usize))>,
    most: usize,
}

impl Best {
    fn of(patterns: usize) -> Self {
        let most = PER_FAMILY.0 + PER_FAMILY.1 * patterns.saturating_sub(1);
        Best { list: Vec::new(), most: most.min(MOST_PER_FAMILY) }
    }

    fn keep(&mut self, score: f32, pixel: (usize, usize)) {
        let list = &mut self.list;
        if list.len() == self.most && list.last().is_some_and(|worst| worst.0 >= score) {
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
        list.truncate(self.most);
    }
}

/// The columns of a row in which the pixels vary more than `limits` and than their eight neighbours:
/// an edge that sways is a ridge of many pixels but few peaks, and cannot crowd out a light.
fn peaks(energy: &[f32], width: usize, y: usize, limits: &[f32], columns: &mut Vec<usize>) {
    let row = |y: usize| &energy[y * width..(y + 1) * width];
    let (above, here, below) = (row(y - 1), row(y), row(y + 1));
    let inside: Range<usize> = MARGIN..width - MARGIN;
    columns.extend(inside.filter(|&x| {
        let e = here[x];
        e > limits[x] && e >= here[x - 1] && e > here[x + 1] && is_peak([above, here, below], x)
    }));
}

#[cfg(test)]
mod tests {
    use vergence_imaging::Image;

    use super::super::front::Variation;
    use super::super::history::Past;
    use super::super::motion::Placement;
    use super::super::nuisance::Lamps;
    use super::*;

    #[test]
    fn a_scan_in_steps_finds_what_one_at_once_finds() {
        let size = (48, 40);
        let (mut history, mut variation) = (History::new(16), Variation::new(48 * 40, 16));
        for t in 0..16usize {
            // Varies everywhere, most where the product is large.
            let value = |x: usize, y: usize| ((x * y * (t * t + 3) + 7 * x + t) % 97) as i16;
            let picture = Image::from_fn(size.0, size.1, value);
            variation.push(picture.data());
            let time = t as f64 / 30.0;
            let past = Past { time, exposure: 0.005, placement: Placement::default() };
            history.push(past, &picture).unwrap();
        }
        let noise = BlockNoise::new(variation.energy(), size.0, size.1, 16);
        let nuisance = Nuisance::of(&history, &Lamps::default());
        let mut line: Vec<f32> = (0..16).map(|t| if t % 2 == 0 { 0.25 } else { -0.25 }).collect();
        nuisance.remove(&mut line);
        let families = [Family { requests: vec![0], lines: vec![line] }];
        let energy = variation.energy();
        let (history, noise, nuisance) = (&history, &noise, &nuisance);
        let view = View { history, size, energy, noise, nuisance, presence: 1.0 };
        let scan = |steps: usize| {
            let mut sweep = Sweep::new(size.1, [1].into_iter());
            let mut results = (0..steps).filter_map(|_| sweep.step(&view, &families, steps));
            results.next().expect("the last step ends the scan")
        };
        let whole = scan(1);
        assert!(whole.len() > 8, "{}", whole.len());
        for steps in [2, 3, 7] {
            assert_eq!(scan(steps), whole, "{steps} steps");
        }
    }
}
