//! The light that a pattern would give over a window, for a bank of phases and clock rates.

use std::f64::consts::TAU;

use vergence_tag::Pattern;

use super::nuisance::{Nuisance, dot};

/// Finest step of the phase in the bank, as a share of a chip or of the time between frames.
const PHASE_STEP: f64 = 0.25;

/// Share of light in every frame (0 to 1) for a pattern that is `phase` seconds into its period at
/// time zero and whose clock runs `rate` times as fast as the camera's.
pub fn light(pattern: &Pattern, times: &[(f64, f64)], phase: f64, rate: f64, out: &mut Vec<f32>) {
    out.clear();
    let share = |&(t, e): &(f64, f64)| pattern.on_fraction(phase + rate * t, rate * e) as f32;
    out.extend(times.iter().map(share));
}

/// One phase and rate of a bank.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Seconds into the pattern at time zero.
    pub phase: f64,
    /// Tag seconds per camera second.
    pub rate: f64,
    /// Squared length of the expected light, nuisances taken out (frames).
    pub norm2: f64,
}

/// The expected light for all phases and rates of one pattern, freed of nuisances, of unit length.
#[derive(Debug, Clone)]
pub struct Bank {
    /// The hypotheses.
    pub hypotheses: Vec<Hypothesis>,
    templates: Vec<f32>,
    frames: usize,
    /// Step of the phase (s).
    pub step: f64,
}

impl Bank {
    /// The bank of a pattern over a window.
    pub fn new(
        pattern: &Pattern,
        tolerance: f64,
        times: &[(f64, f64)],
        nuisance: &Nuisance,
    ) -> Self {
        let rates = rates(pattern, tolerance, times);
        Bank::with_rates(pattern, &rates, times, nuisance)
    }

    /// The bank of a pattern for given clock rates.
    pub fn with_rates(
        pattern: &Pattern,
        rates: &[f64],
        times: &[(f64, f64)],
        nuisance: &Nuisance,
    ) -> Self {
        let (period, chip) = (pattern.period().as_secs_f64(), pattern.chip.as_secs_f64());
        let between = gap(times).max(1e-4);
        let mut fine = PHASE_STEP * chip.min(between).max(0.25 * chip);
        // Where a chip lasts a whole number of frames, every change falls at the same point of an
        // exposure: inside it, all frames are half lit, and only a step as fine as that tells.
        let frames = chip / between;
        if (frames - frames.round()).abs() < 0.05 * frames {
            let exposure = times.first().map_or(0.0, |t| t.1);
            fine = fine.min((0.5 * exposure).max(chip / 16.0));
        }
        let phases = (period / fine).ceil() as usize;
        let step = period / phases as f64;
        let mut bank = Bank {
            hypotheses: Vec::with_capacity(phases * rates.len()),
            templates: Vec::with_capacity(phases * rates.len() * times.len()),
            frames: times.len(),
            step,
        };
        let mut expected = Vec::with_capacity(times.len());
        for &rate in rates {
            for k in 0..phases {
                let phase = k as f64 * step;
                light(pattern, times, phase, rate, &mut expected);
                nuisance.remove(&mut expected);
                let norm2 = f64::from(dot(&expected, &expected));
                // A phase whose light never changes within the window says nothing.
                if norm2 > 1e-3 {
                    let scale = norm2.sqrt().recip() as f32;
                    bank.templates.extend(expected.iter().map(|v| v * scale));
                    bank.hypotheses.push(Hypothesis { phase, rate, norm2 });
                }
            }
        }
        bank
    }

    /// Scalar product of a series with every hypothesis.
    pub fn correlate(&self, series: &[f32], out: &mut Vec<f32>) {
        out.clear();
        out.extend(self.templates.chunks_exact(self.frames.max(1)).map(|t| dot(t, series)));
    }
}

/// Clock rates close enough that the pattern stays within a quarter of a chip over the window.
fn rates(pattern: &Pattern, tolerance: f64, times: &[(f64, f64)]) -> Vec<f64> {
    let span = times.last().map_or(0.0, |l| l.0) - times.first().map_or(0.0, |f| f.0);
    let drift = tolerance * span / (PHASE_STEP * pattern.chip.as_secs_f64());
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

/// The lines of a pattern's spectrum as an orthonormal set, freed of nuisances: any phase of the
/// pattern lies in its span, so one pass over a pixel tests all phases at once.
pub fn lines(pattern: &Pattern, times: &[(f64, f64)], nuisance: &Nuisance) -> Vec<Vec<f32>> {
    let (period, n) = (pattern.period().as_secs_f64(), pattern.bits.len());
    let mut strengths: Vec<(usize, f64)> = Vec::new();
    for k in 1..=n.max(3) {
        let turn = TAU * k as f64 / n as f64;
        let (mut re, mut im) = (0.0, 0.0);
        for (j, _) in pattern.bits.chips().enumerate().filter(|(_, on)| *on) {
            re += (turn * j as f64).cos();
            im += (turn * j as f64).sin();
        }
        let half = 0.5 * turn;
        strengths.push((k, f64::hypot(re, im) * (half.sin() / half).abs()));
    }
    let largest = strengths.iter().map(|s| s.1).fold(0.0, f64::max);
    strengths.retain(|s| s.1 > 0.3 * largest);
    let mut set: Vec<Vec<f32>> = Vec::new();
    for (k, _) in strengths {
        for quarter in [0.0, 0.25] {
            // The middle of the exposure is where a line's phase is read.
            let angle = |&(t, e): &(f64, f64)| TAU * (k as f64 * (t + 0.5 * e) / period + quarter);
            let mut line: Vec<f32> = times.iter().map(|t| angle(t).cos() as f32).collect();
            nuisance.remove(&mut line);
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
