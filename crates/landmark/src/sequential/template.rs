//! The light that a pattern would give over a window, for a bank of phases and clock rates.

use std::f64::consts::TAU;
use std::ops::Range;

use vergence_tag::Pattern;

use super::nuisance::{Nuisance, dot, dot_columns};

/// Finest step of the phase in the bank, as a share of a chip or of the time between frames.
const PHASE_STEP: f64 = 0.25;

/// Share of light in every frame (0 to 1) that a pattern gives under a hypothesis.
pub fn light(pattern: &Pattern, times: &[(f64, f64)], h: &Hypothesis, out: &mut Vec<f32>) {
    out.clear();
    let share = |&(t, e): &(f64, f64)| pattern.on_fraction(h.phase + h.rate * t, h.rate * e);
    out.extend(times.iter().map(|time| h.shown(share(time)) as f32));
}

/// Time (s) over which clock rates are told apart at most. A window that is longer has a jump of the
/// camera's clock in it, and the number of rates must not grow with that.
const LONGEST: f64 = 60.0;

/// How long a pattern has been lit since its start, from a table: a bank asks for it hundreds of times a
/// frame.
#[derive(Debug, Clone)]
struct Lit {
    /// Chips a second.
    pace: f64,
    /// Chips of a period.
    length: f64,
    /// Lit chips before each chip of a period, and once more at its end.
    before: Vec<f64>,
}

impl Lit {
    fn new(pattern: &Pattern) -> Self {
        let length = pattern.bits.len();
        let mut before = vec![0.0; length + 2];
        for k in 0..=length {
            before[k + 1] = before[k] + f64::from(u8::from(pattern.bits.chip(k as i64)));
        }
        Lit { pace: pattern.chip.as_secs_f64().recip(), length: length as f64, before }
    }

    /// Lit chips between the start and `time`, which is not before it.
    fn chips(&self, time: f64) -> f64 {
        let chips = time * self.pace;
        let periods = (chips / self.length) as i64 as f64;
        // Time stamps may be anything: beyond what a float tells apart, the chip is arbitrary.
        let rest = (chips - periods * self.length).clamp(0.0, self.length);
        let chip = rest as usize;
        let (before, after) = (self.before[chip], self.before[chip + 1]);
        periods * self.before[self.length as usize]
            + before
            + (after - before) * (rest - chip as f64)
    }

    /// Share of light in `span` seconds from `time` on.
    fn share(&self, time: f64, span: f64) -> f64 {
        (self.chips(time + span) - self.chips(time)) / (span * self.pace)
    }
}

/// How many times too bright for the picture a light is taken to be that is: half or a sixth of the
/// exposure makes it white. What lies between is told by the phase.
const EXCESSES: [f64; 2] = [2.0, 6.0];
/// Chance that a light is, where it would matter: one that is has evidence to spare.
const EXCESSIVE: f64 = 0.05;

/// One phase and rate of a bank.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Seconds into the pattern at time zero.
    pub phase: f64,
    /// Tag seconds per camera second.
    pub rate: f64,
    /// How many times too bright for the picture the light is; one is not.
    pub excess: f64,
    /// Squared length of the expected light, nuisances taken out (frames).
    pub norm2: f64,
}

impl Hypothesis {
    /// What a picture shows of a share of light.
    fn shown(&self, share: f64) -> f64 {
        (self.excess * share).min(1.0)
    }
}

/// The expected light for all phases and rates of one pattern. It grows by a row a frame: nothing is
/// computed twice.
#[derive(Debug, Clone)]
pub struct Bank {
    lit: Lit,
    /// The hypotheses; `norm2` is that of the last [`Bank::fit`].
    pub hypotheses: Vec<Hypothesis>,
    /// So many come first that are a quarter of a chip apart: enough for a look.
    pub coarse: usize,
    /// So many come before those of lights too bright for the picture.
    pub plain: usize,
    /// Share of light, frame by frame for all hypotheses.
    templates: Vec<f32>,
    /// Frames of `templates` that have left the window.
    left: usize,
    /// Longest window (frames).
    window: usize,
    /// Numbers of the frames of the window, counted from the first frame ever.
    frames: Range<usize>,
    /// Reciprocal length of every expected light, nuisances taken out; zero where too short.
    scales: Vec<f32>,
    /// Step of the phase (s).
    pub step: f64,
}

impl Bank {
    /// An empty bank for a window of so many frames, at the clock rates `rates`.
    pub fn new(pattern: &Pattern, rates: &[f64], times: &[(f64, f64)], window: usize) -> Self {
        let period = pattern.period().as_secs_f64();
        let phases = (period / phase_step(pattern, times)).ceil() as usize;
        let step = period / phases as f64;
        let stride = ((PHASE_STEP * pattern.chip.as_secs_f64() / step) as usize).max(1);
        let coarse = |k: &usize| k.is_multiple_of(stride);
        let (first, rest): (Vec<usize>, Vec<usize>) = (0..phases).partition(coarse);
        let at = |k: usize, rate: f64| Hypothesis {
            phase: k as f64 * step,
            rate,
            excess: 1.0,
            norm2: 0.0,
        };
        let of = |phases: &[usize]| -> Vec<Hypothesis> {
            rates.iter().flat_map(|&rate| phases.iter().map(move |&k| at(k, rate))).collect()
        };
        let mut hypotheses = [of(&first), of(&rest)].concat();
        let plain = hypotheses.len();
        // A light so near that it is white as soon as it shines through a part of the exposure: where all
        // changes fall into exposures it seems to play another pattern.
        if is_in_step(pattern, times) {
            let (start, exposure) = times.first().copied().unwrap_or_default();
            let chip = pattern.chip.as_secs_f64();
            let cut =
                |h: &&Hypothesis| (h.phase + h.rate * start).rem_euclid(chip) + exposure > chip;
            let white: Vec<_> = hypotheses.iter().filter(cut).copied().collect();
            let with = |excess| white.iter().map(move |h| Hypothesis { excess, ..*h });
            hypotheses.extend(EXCESSES.into_iter().flat_map(with));
        }
        Bank {
            lit: Lit::new(pattern),
            templates: Vec::new(),
            scales: vec![0.0; hypotheses.len()],
            coarse: first.len() * rates.len(),
            hypotheses,
            plain,
            left: 0,
            window,
            frames: 0..0,
            step,
        }
    }

    /// Chance of a hypothesis before anything is seen, where lights too bright for the picture are reckoned
    /// with or not.
    pub fn prior(&self, h: &Hypothesis, white: bool) -> f64 {
        let share = if white { EXCESSIVE } else { 0.0 };
        if h.excess > 1.0 {
            share / (self.hypotheses.len() - self.plain) as f64
        } else {
            (1.0 - share) / self.plain as f64
        }
    }

    /// Whether the bank has so many clock rates.
    pub fn has_rates(&self, count: usize) -> bool {
        let first = self.hypotheses.first().map(|h| h.phase);
        let at_first = |h: &&Hypothesis| Some(h.phase) == first && h.excess == 1.0;
        self.hypotheses.iter().filter(at_first).count() == count
    }

    /// Brings the bank up to a window whose frames have the numbers `frames` (from the first frame
    /// ever) and whose nuisances are given.
    pub fn fit(&mut self, times: &[(f64, f64)], frames: Range<usize>, nuisance: &Nuisance) {
        if self.frames == frames {
            return;
        }
        self.advance(times, frames);
        let (mut scratch, mut rest) = (Vec::new(), Vec::new());
        nuisance.rest2(self.table(), self.hypotheses.len(), &mut scratch, &mut rest);
        for ((h, scale), norm2) in self.hypotheses.iter_mut().zip(&mut self.scales).zip(rest) {
            h.norm2 = f64::from(norm2);
            // A phase whose light never changes within the window says nothing.
            *scale = if norm2 > 1e-3 { norm2.sqrt().recip() } else { 0.0 };
        }
    }

    /// The rows of the window.
    fn table(&self) -> &[f32] {
        &self.templates[self.left * self.hypotheses.len()..]
    }

    /// Drops the frames that left the window and adds those that entered.
    fn advance(&mut self, times: &[(f64, f64)], frames: Range<usize>) {
        let width = self.hypotheses.len();
        let known = self.frames.end.max(frames.start);
        self.left += (frames.start - self.frames.start).min(self.frames.len());
        // The past is thrown away once a window, not every frame.
        if self.left >= self.window {
            self.templates.drain(..self.left * width);
            self.left = 0;
        }
        for &(t, e) in &times[times.len() - (frames.end - known).min(times.len())..] {
            // An exposure of no length sees one chip.
            let span = e.max(1e-6);
            let share =
                |h: &Hypothesis| h.shown(self.lit.share(h.phase + h.rate * t, h.rate * span));
            self.templates.extend(self.hypotheses.iter().map(|h| share(h) as f32));
        }
        self.frames = frames;
    }

    /// Scalar product of a series that is free of nuisances with the first `count` expected lights, of
    /// unit length.
    pub fn correlate(&self, series: &[f32], count: usize, out: &mut Vec<f32>) {
        out.resize(count, 0.0);
        dot_columns(series, self.table(), self.hypotheses.len(), out);
        out.iter_mut().zip(&self.scales).for_each(|(product, scale)| *product *= scale);
    }
}

/// Step of the phase in a bank (s).
fn phase_step(pattern: &Pattern, times: &[(f64, f64)]) -> f64 {
    let chip = pattern.chip.as_secs_f64();
    let between = gap(times).max(1e-4);
    let step = PHASE_STEP * chip.min(between).max(0.25 * chip);
    // Inside an exposure all frames are half lit, and only a step as fine as that tells.
    if is_in_step(pattern, times) {
        let exposure = times.first().map_or(0.0, |t| t.1);
        return step.min((0.25 * exposure).max(chip / 32.0));
    }
    step
}

/// Whether a chip lasts a whole number of frames: every change falls at the same point of an exposure.
fn is_in_step(pattern: &Pattern, times: &[(f64, f64)]) -> bool {
    let frames = pattern.chip.as_secs_f64() / gap(times).max(1e-4);
    (frames - frames.round()).abs() < 0.05 * frames
}

/// Clock rates close enough that the pattern stays within a quarter of a chip over `span` seconds.
pub fn rates(pattern: &Pattern, tolerance: f64, span: f64) -> Vec<f64> {
    let drift = tolerance * span.min(LONGEST) / (PHASE_STEP * pattern.chip.as_secs_f64());
    let each_side = if drift > 0.5 { drift.ceil() as i64 } else { 0 };
    let rate = |k: i64| 1.0 + tolerance * k as f64 / each_side.max(1) as f64;
    (-each_side..=each_side).map(rate).collect()
}

/// Median time between frames (s).
fn gap(times: &[(f64, f64)]) -> f64 {
    let mut gaps: Vec<f64> = times.windows(2).map(|w| w[1].0 - w[0].0).collect();
    gaps.sort_by(f64::total_cmp);
    gaps.get(gaps.len() / 2).copied().unwrap_or(0.0)
}

/// How often the light changes within the window.
pub fn transitions(pattern: &Pattern, times: &[(f64, f64)]) -> f64 {
    let n = pattern.bits.len() as i64;
    let changes = (0..n).filter(|&k| pattern.bits.chip(k) != pattern.bits.chip(k + 1)).count();
    let span = times.last().map_or(0.0, |l| l.0 + l.1) - times.first().map_or(0.0, |f| f.0);
    changes as f64 * span / pattern.period().as_secs_f64()
}

/// The lines of the spectra of patterns that share length and chip, as an orthonormal set freed of
/// nuisances: any phase of any of them lies in its span, so one pass over a pixel tests all at once.
pub fn lines(patterns: &[&Pattern], times: &[(f64, f64)], nuisance: &Nuisance) -> Vec<Vec<f32>> {
    let Some(first) = patterns.first() else { return Vec::new() };
    let mut strengths = vec![0.0f64; first.bits.len().max(3)];
    for pattern in patterns {
        for (s, own) in strengths.iter_mut().zip(spectrum(pattern)) {
            *s = s.max(own);
        }
    }
    let strong = strengths.iter().enumerate().filter(|(_, s)| **s > 0.3).map(|(k, _)| k + 1);
    orthonormal(first.period().as_secs_f64(), strong, times, |line| nuisance.remove(line))
}

/// Cosine and sine at multiples of the fundamental, orthonormal.
fn orthonormal(
    period: f64,
    multiples: impl Iterator<Item = usize>,
    times: &[(f64, f64)],
    clear: impl Fn(&mut [f32]),
) -> Vec<Vec<f32>> {
    let mut set: Vec<Vec<f32>> = Vec::new();
    for k in multiples {
        for quarter in [0.0, 0.25] {
            // The middle of the exposure is where a line's phase is read.
            let angle = |&(t, e): &(f64, f64)| TAU * (k as f64 * (t + 0.5 * e) / period + quarter);
            let mut line: Vec<f32> = times.iter().map(|t| angle(t).cos() as f32).collect();
            clear(&mut line);
            for other in &set {
                let share = dot(other, &line);
                line.iter_mut().zip(other).for_each(|(l, o)| *l -= share * o);
            }
            let length = dot(&line, &line).sqrt();
            if length > 0.1 * (times.len() as f32).sqrt() {
                line.iter_mut().for_each(|l| *l /= length);
                set.push(line);
            }
        }
    }
    set
}

/// Strength of the multiples of a pattern's fundamental, from the first, relative to the strongest.
fn spectrum(pattern: &Pattern) -> Vec<f64> {
    let n = pattern.bits.len();
    let strength = |k: usize| {
        let turn = TAU * k as f64 / n as f64;
        let (mut re, mut im) = (0.0, 0.0);
        for (j, _) in pattern.bits.chips().enumerate().filter(|(_, on)| *on) {
            re += (turn * j as f64).cos();
            im += (turn * j as f64).sin();
        }
        let half = 0.5 * turn;
        f64::hypot(re, im) * (half.sin() / half).abs()
    };
    let mut strengths: Vec<f64> = (1..=n.max(3)).map(strength).collect();
    let largest = strengths.iter().copied().fold(1e-9, f64::max);
    strengths.iter_mut().for_each(|s| *s /= largest);
    strengths
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_table_says_what_the_pattern_says_and_takes_any_time() {
        let pattern = Pattern::new("1110010".parse().unwrap(), Duration::from_millis(63)).unwrap();
        let lit = Lit::new(&pattern);
        for k in 0..500 {
            let (time, span) = (0.0173 * f64::from(k), 0.001 * f64::from(1 + k % 40));
            let (found, expected) = (lit.share(time, span), pattern.on_fraction(time, span));
            assert!((found - expected).abs() < 1e-9, "{time} s: {found} is not {expected}");
        }
        for exponent in 9..300 {
            let _ = lit.share(10f64.powi(exponent), 0.005);
        }
    }
}
