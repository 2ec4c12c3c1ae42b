//! How much better a pattern explains a series than the absence of a light does.
//!
//! The series y and the expected light s (both freed of nuisances) are compared by a likelihood ratio
//! in which amplitude, phase, clock rate and noise are averaged over instead of guessed:
//! the amplitude under half-normal priors of several widths, phase and rate over the bank, the noise
//! under an inverse-gamma prior around the noise of the neighbourhood. The last makes it Student's t:
//! a neighbourhood noisier than thought weakens the evidence by itself. The mean of likelihood ratios
//! over a proper prior is a likelihood ratio again, so that Ville's bound holds for it:
//! the chance of ever passing `exp(h)` without a tag is at most `exp(-h)`.

use std::f64::consts::LN_2;

use vergence_tag::Pattern;

use super::nuisance::{Nuisance, dot};
use super::template::{Bank, Hypothesis, light};

/// Weight of the neighbourhood's noise against the place's own, in frames: a block holds about 23
/// independent places, so after 40 frames it knows its noise this well.
const NOISE_FRAMES: f64 = 1000.0;

/// Widths of the amplitude priors, in noise standard deviations, and their weights. A strong light is
/// decided within frames whatever its prior; most of the weight goes where it saves frames.
const WIDTHS: [(f64, f64); 3] = [(2.0, 0.8), (8.0, 0.15), (32.0, 0.05)];

/// Standard deviations by which a place must be noisier than its neighbourhood to have noise of its
/// own: less is chance, and taking the larger of the two every time would only cost frames.
const OWN_NOISE: f64 = 1.5;

/// Share of the floor that the best of the coarse phases must reach: at the worst, when every change
/// of the light falls into an exposure, they show two thirds of it.
const COARSE: f64 = 0.6;

/// Amplitude (grey levels) from which a light may be too bright for the picture.
const WHITE: f64 = 100.0;

/// Degrees of freedom from which what is left over tells the noise.
const FREE: f64 = 10.0;

/// A deviation this many times the ninth decile of all deviations is cut to it: something passed.
const CLIP: f32 = 3.0;

/// A series ready to be compared: nuisances out, outliers cut.
#[derive(Debug, Clone)]
pub struct Series {
    /// Deviations (grey levels).
    pub values: Vec<f32>,
    /// Sum of their squares.
    pub energy: f64,
    /// Variance of the noise around (grey levels squared).
    pub noise: f64,
    /// Degrees of freedom left by the nuisances.
    pub freedom: f64,
    /// Courses of the surroundings that were taken out as well (unit length).
    pub local: Vec<Vec<f32>>,
    /// Whether `noise` is known to hold here as well.
    settled: bool,
}

impl Series {
    /// Prepares the brightness over time of one place.
    pub fn new(raw: &[f32], nuisance: &Nuisance, local: Vec<Vec<f32>>, noise: f64) -> Self {
        let taken = (nuisance.rank() + local.len()) as f64;
        let freedom = (raw.len() as f64 - taken).max(1.0);
        let mut series =
            Series { values: Vec::new(), energy: 0.0, noise, freedom, local, settled: false };
        let mut values = raw.to_vec();
        series.clear(nuisance, &mut values);
        if clip(&mut values) {
            series.clear(nuisance, &mut values);
        }
        series.energy = f64::from(dot(&values, &values));
        series.values = values;
        series
    }

    /// Takes the nuisances of the picture and of this place out of a time course.
    pub fn clear(&self, nuisance: &Nuisance, values: &mut [f32]) {
        nuisance.remove(values);
        for course in &self.local {
            let share = dot(course, values);
            values.iter_mut().zip(course).for_each(|(v, c)| *v -= share * c);
        }
    }

    /// The light that a pattern would give here under a hypothesis, cleared of nuisances.
    pub fn expect(
        &self,
        pattern: &Pattern,
        times: &[(f64, f64)],
        hypothesis: &Hypothesis,
        nuisance: &Nuisance,
        out: &mut Vec<f32>,
    ) {
        light(pattern, times, hypothesis, out);
        self.clear(nuisance, out);
    }

    /// Energy with the prior's share added.
    fn total(&self, explained: f64) -> f64 {
        self.energy + NOISE_FRAMES * self.noise_beside(explained)
    }

    /// Variance of the noise of this place when so much of its energy is a light. A place that stays
    /// noisier than its neighbourhood, by more than chance explains, has noise of its own.
    fn noise_beside(&self, explained: f64) -> f64 {
        if self.settled {
            return self.noise;
        }
        let own = (self.energy - explained).max(0.0) / self.freedom;
        self.noise.max(own / (1.0 + OWN_NOISE * (2.0 / self.freedom).sqrt()))
    }

    /// The same series with the noise that it has beside a light that explains so much of its energy,
    /// whatever it is compared with: explanations are weighed with one and the same noise.
    pub fn settled(&self, explained: f64) -> Series {
        // With few frames, nothing is left to tell the noise by.
        let noise = if self.freedom < FREE { self.noise } else { self.noise_beside(explained) };
        Series { noise, settled: true, ..self.clone() }
    }
}

/// Cuts outliers; whether there were any.
fn clip(values: &mut [f32]) -> bool {
    let mut sizes: Vec<f32> = values.iter().map(|v| v.abs()).collect();
    let rank = sizes.len() * 9 / 10;
    if rank >= sizes.len() {
        return false;
    }
    let limit = CLIP * *sizes.select_nth_unstable_by(rank, f32::total_cmp).1;
    let mut cut = false;
    for v in values.iter_mut().filter(|v| v.abs() > limit) {
        *v = limit.copysign(*v);
        cut = true;
    }
    cut
}

/// What a series says about one pattern.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evidence {
    /// Natural logarithm of the likelihood ratio against "no light, and the noise of the surroundings".
    pub log_ratio: f64,
    /// The same against "no light, but a restless place with a noise of its own", of which nothing is
    /// known: an edge that sways, a screen.
    pub restless: f64,
    /// The best phase and rate.
    pub best: Hypothesis,
    /// Scalar product of series and expected light of unit length there (grey levels).
    pub correlation: f64,
}

impl Evidence {
    /// Amplitude of the light (grey levels).
    pub fn amplitude(&self) -> f64 {
        self.correlation / self.best.norm2.sqrt()
    }
}

/// Weighs a series against a bank; `None` when no hypothesis of the bank is testable.
///
/// Where even the best hypothesis falls short of `floor`, its value is returned instead of the mean:
/// an upper bound, and cheaper. Where the best of the coarse phases falls far short of it, so does that.
pub fn weigh(series: &Series, bank: &Bank, floor: f64, scratch: &mut Vec<f32>) -> Option<Evidence> {
    let (coarse, _) = best(series, bank, bank.coarse, scratch)?;
    if coarse.log_ratio < COARSE * floor {
        return Some(coarse);
    }
    let (mut best, mut kept) = self::best(series, bank, bank.plain, scratch)?;
    let white = best.amplitude() > WHITE && bank.plain < bank.hypotheses.len();
    if white {
        (best, kept) = self::best(series, bank, bank.hypotheses.len(), scratch)?;
    }
    if best.log_ratio < floor {
        return Some(best);
    }
    let (mut sum, mut restless_sum) = (0.0, 0.0);
    for (k, c) in scratch.iter().enumerate().filter(|(_, c)| **c > 0.0) {
        let (c, norm2) = (f64::from(*c), scaled(bank, &kept, k).norm2);
        let (log_ratio, restless) = log_ratios(series, best.correlation, c, norm2);
        let prior = bank.prior(&bank.hypotheses[k], white);
        sum += prior * (log_ratio - best.log_ratio).exp();
        restless_sum += prior * (restless - best.restless).exp();
    }
    let log_ratio = best.log_ratio + sum.ln();
    Some(Evidence { log_ratio, restless: best.restless + restless_sum.ln(), ..best })
}

/// The best of the first `count` hypotheses, and what the surroundings leave of each; `scratch` holds
/// the scalar products afterwards.
fn best(
    series: &Series,
    bank: &Bank,
    count: usize,
    scratch: &mut Vec<f32>,
) -> Option<(Evidence, Vec<f32>)> {
    bank.correlate(&series.values, count, scratch);
    let kept = kept(series, bank, count);
    // What the surroundings took from the expected light shortens it.
    for (c, share) in scratch.iter_mut().zip(&kept) {
        *c /= share.sqrt();
    }
    let best = (0..count).max_by(|&a, &b| scratch[a].total_cmp(&scratch[b]))?;
    let (correlation, best) = (f64::from(scratch[best]), scaled(bank, &kept, best));
    let (log_ratio, restless) = log_ratios(series, correlation, correlation, best.norm2);
    Some((Evidence { log_ratio, restless, best, correlation }, kept))
}

/// A hypothesis with what the surroundings leave of its light.
fn scaled(bank: &Bank, kept: &[f32], k: usize) -> Hypothesis {
    let h = bank.hypotheses[k];
    Hypothesis { norm2: h.norm2 * f64::from(kept.get(k).copied().unwrap_or(1.0)), ..h }
}

/// Log likelihood ratios of one phase and rate against the noise around and that of a restless place;
/// `best`: the correlation of the best.
fn log_ratios(series: &Series, best: f64, correlation: f64, norm2: f64) -> (f64, f64) {
    let total = series.total(best * best);
    (
        log_ratio(series.freedom, NOISE_FRAMES, total, correlation, norm2),
        log_ratio(series.freedom, 0.0, series.energy, correlation, norm2),
    )
}

/// Share of each hypothesis' light (squared length) that the surroundings leave; empty: all.
fn kept(series: &Series, bank: &Bank, count: usize) -> Vec<f32> {
    if series.local.is_empty() {
        return Vec::new();
    }
    let mut kept = vec![1.0f32; count];
    let mut shares = Vec::new();
    for course in &series.local {
        bank.correlate(course, count, &mut shares);
        kept.iter_mut().zip(&shares).for_each(|(k, s)| *k -= s * s);
    }
    // Below a tenth nothing trustworthy is left.
    kept.iter().map(|k| if *k < 0.1 { f32::INFINITY } else { *k }).collect()
}

/// Log likelihood ratio of one phase and rate, amplitude and noise averaged over; the noise under a
/// prior that weighs as much as `prior` frames.
fn log_ratio(freedom: f64, prior: f64, total: f64, correlation: f64, norm2: f64) -> f64 {
    if correlation <= 0.0 {
        return 0.0;
    }
    let (half, share) = (0.5 * (freedom + prior), correlation * correlation / total);
    let by_width = WIDTHS.map(|(width, weight)| {
        let gain = width * width * norm2;
        let rest = (-share * gain / (1.0 + gain)).max(-0.999_999);
        weight.ln() - 0.5 * (1.0 + gain).ln() - half * rest.ln_1p()
    });
    // Half-normal: the amplitude is positive, so the prior is twice as dense there.
    log_sum(&by_width) + LN_2
}

/// Logarithm of the sum of the numbers whose logarithms are given.
pub fn log_sum(terms: &[f64]) -> f64 {
    let largest = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if largest == f64::NEG_INFINITY {
        return largest;
    }
    largest + terms.iter().map(|t| (t - largest).exp()).sum::<f64>().ln()
}

/// By how much the log likelihood ratio of the best phase grows when phases between those of the bank
/// are tried.
pub fn refined_gain(
    series: &Series,
    pattern: &Pattern,
    times: &[(f64, f64)],
    nuisance: &Nuisance,
    start: Evidence,
    step: f64,
) -> f64 {
    let at = |e: &Evidence| {
        let total = series.total(e.correlation * e.correlation);
        log_ratio(series.freedom, NOISE_FRAMES, total, e.correlation, e.best.norm2)
    };
    at(&refine(series, pattern, times, nuisance, start, step)) - at(&start)
}

/// The best phase between those of the bank: golden-section search around the best one. Where the best is
/// that of a light too bright for the picture, one that is not may be better once its phase fits.
pub fn refine(
    series: &Series,
    pattern: &Pattern,
    times: &[(f64, f64)],
    nuisance: &Nuisance,
    start: Evidence,
    step: f64,
) -> Evidence {
    let from =
        |start: Evidence, reach: f64| between(series, pattern, times, nuisance, start, reach);
    let found = from(start, step);
    if start.best.excess == 1.0 {
        return found;
    }
    let best = Hypothesis { excess: 1.0, ..start.best };
    let plain = from(Evidence { best, correlation: 0.0, ..start }, WHOLE * step);
    if plain.correlation > found.correlation { plain } else { found }
}

/// Steps of a bank's phase that an exposure has where lights too bright for the picture are reckoned with.
const WHOLE: f64 = 4.0;

/// The best phase within `reach` of a hypothesis' own, or the hypothesis itself.
fn between(
    series: &Series,
    pattern: &Pattern,
    times: &[(f64, f64)],
    nuisance: &Nuisance,
    start: Evidence,
    reach: f64,
) -> Evidence {
    let mut expected = Vec::with_capacity(times.len());
    let mut at = |phase: f64| {
        let at = Hypothesis { phase, ..start.best };
        series.expect(pattern, times, &at, nuisance, &mut expected);
        let norm2 = f64::from(dot(&expected, &expected)).max(1e-9);
        let correlation = f64::from(dot(&expected, &series.values)) / norm2.sqrt();
        let best = Hypothesis { norm2, ..at };
        Evidence { best, correlation, ..start }
    };
    let ratio = 0.5 * (5f64.sqrt() - 1.0);
    let (mut low, mut high) = (start.best.phase - reach, start.best.phase + reach);
    let inner = |low: f64, high: f64| (high - ratio * (high - low), low + ratio * (high - low));
    let (a, b) = inner(low, high);
    let (mut left, mut right) = (at(a), at(b));
    for _ in 0..12 {
        if left.correlation > right.correlation {
            high = right.best.phase;
            right = left;
            left = at(inner(low, high).0);
        } else {
            low = left.best.phase;
            left = right;
            right = at(inner(low, high).1);
        }
    }
    let better = if left.correlation > right.correlation { left } else { right };
    if better.correlation > start.correlation { better } else { start }
}

/// Sum of squares that the best light leaves unexplained.
pub fn unexplained(series: &Series, evidence: &Evidence) -> f64 {
    (series.energy - evidence.correlation * evidence.correlation).max(0.0)
}
