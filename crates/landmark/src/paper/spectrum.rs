//! The spectrum of the brightness at a place, and the line that a pattern was commanded to make.

use std::f64::consts::{PI, TAU};

use vergence_tag::Pattern;

/// Frequencies a sample, at the most. Even sampling gives two; as many times more as the span is longer than
/// the median gap would have it.
const MOST_FREQUENCIES: usize = 16;

/// The strongest line of a pattern's spectrum; a plain flicker's is its frequency.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Hz.
    pub frequency: f64,
    /// Amplitude of the cosine for a light of unit difference.
    pub amplitude: f64,
    /// Phase of the cosine at the start of the pattern (rad).
    pub phase: f64,
}

impl Line {
    /// The strongest among the first harmonics of the pattern's period.
    pub fn strongest(pattern: &Pattern) -> Line {
        let (n, period) = (pattern.bits.len(), pattern.period().as_secs_f64());
        let harmonic = |k: usize| {
            let turn = TAU * k as f64 / n as f64;
            let (mut re, mut im) = (0.0, 0.0);
            for (j, _) in pattern.bits.chips().enumerate().filter(|(_, on)| *on) {
                re += (turn * j as f64).cos();
                im -= (turn * j as f64).sin();
            }
            // A chip is a rectangle: its transform damps and delays the line by half a chip.
            let half = PI * k as f64 / n as f64;
            Line {
                frequency: k as f64 / period,
                amplitude: 2.0 * f64::hypot(re, im) / n as f64 * half.sin() / half,
                phase: im.atan2(re) - half,
            }
        };
        let mut best = harmonic(1);
        for k in 2..=n / 2 {
            let line = harmonic(k);
            if line.amplitude > best.amplitude {
                best = line;
            }
        }
        best
    }
}

/// Whether samples lie so close together for the time that they span that their spectrum means something:
/// lost frames are no matter, a clock that jumped is.
pub fn are_regular(times: &[f64]) -> bool {
    frequencies(times).1 <= MOST_FREQUENCIES * times.len()
}

/// Step between frequencies (Hz) and their number up to half the sampling rate.
fn frequencies(times: &[f64]) -> (f64, usize) {
    let (first, last) = (times.first().copied(), times.last().copied());
    let span = (last.unwrap_or(0.0) - first.unwrap_or(0.0)).max(1e-6);
    let mut gaps: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
    gaps.sort_by(f64::total_cmp);
    let rate = 1.0 / gaps.get(gaps.len() / 2).copied().unwrap_or(span).max(1e-6);
    let step = 0.25 / span;
    (step, ((0.5 * rate / step) as usize).saturating_add(1))
}

/// Amplitudes over frequency of a series sampled at uneven times.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// Hz between two entries of `amplitudes`: a quarter of the resolution.
    pub step: f64,
    /// Amplitude of the cosine at 0, step, 2 step ... up to half the sampling rate (grey levels).
    pub amplitudes: Vec<f64>,
    phases: Vec<f64>,
}

impl Spectrum {
    /// The discrete Fourier transform of `values` at `times` (s), mean removed; cut off at the frequencies
    /// that so few samples can tell when the times are too irregular, see [`are_regular`].
    pub fn new(times: &[f64], values: &[f64]) -> Self {
        let (step, count) = frequencies(times);
        let count = count.min(MOST_FREQUENCIES * times.len().max(1));
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        let scale = 2.0 / values.len().max(1) as f64;
        let line = |k: usize| {
            let omega = TAU * step * k as f64;
            let (mut re, mut im) = (0.0, 0.0);
            for (t, v) in times.iter().zip(values) {
                re += (v - mean) * (omega * t).cos();
                im -= (v - mean) * (omega * t).sin();
            }
            (scale * f64::hypot(re, im), im.atan2(re))
        };
        let (amplitudes, phases) = (0..count).map(line).unzip();
        Spectrum { step, amplitudes, phases }
    }

    /// Where a frequency shows when it is sampled at this spectrum's rate: index and whether mirrored.
    fn folded(&self, frequency: f64) -> (usize, bool) {
        let top = (self.amplitudes.len() - 1).max(1) as f64 * self.step;
        let rest = frequency.rem_euclid(2.0 * top);
        let mirrored = rest > top;
        let seen = if mirrored { 2.0 * top - rest } else { rest };
        ((seen / self.step).round() as usize, mirrored)
    }

    /// Amplitude at a frequency (grey levels); one above half the rate is looked for at its alias.
    pub fn amplitude(&self, frequency: f64) -> f64 {
        self.amplitudes.get(self.folded(frequency).0).copied().unwrap_or(0.0)
    }

    /// Median amplitude: the level that noise alone gives.
    pub fn median(&self) -> f64 {
        let mut sorted = self.amplitudes.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(0.0).max(1e-9)
    }

    /// Whether the largest line is the commanded one and stands `ratio` times above the median.
    pub fn shows(&self, frequency: f64, ratio: f64) -> bool {
        // The lowest entries hold the drift of the background.
        let lowest = 6.min(self.amplitudes.len());
        let largest = (lowest..self.amplitudes.len())
            .max_by(|&a, &b| self.amplitudes[a].total_cmp(&self.amplitudes[b]));
        let commanded = self.folded(frequency).0;
        largest.is_some_and(|k| {
            k.abs_diff(commanded) <= 2 && self.amplitudes[k] >= ratio * self.median()
        })
    }

    /// Seconds since the last crest-aligned start of the pattern whose strongest line is `line`, at
    /// `time` (s); whole periods of the line remain open.
    pub fn time_into(&self, line: &Line, time: f64) -> f64 {
        let (index, mirrored) = self.folded(line.frequency);
        let seen = self.phases.get(index).copied().unwrap_or(0.0);
        let phase = if mirrored { -seen } else { seen };
        time + (phase - line.phase) / (TAU * line.frequency)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_sampled_pattern_shows_its_own_line_and_phase() {
        let pattern = Pattern::new("10".parse().unwrap(), Duration::from_millis(70)).unwrap();
        let line = Line::strongest(&pattern);
        assert!((line.frequency - 1.0 / 0.14).abs() < 1e-9);
        assert!((line.amplitude - 2.0 / PI).abs() < 1e-9);
        let times: Vec<f64> = (0..90).map(|k| k as f64 / 30.0).collect();
        let light = |t: &f64| 10.0 * pattern.on_fraction(t + 0.05, 0.005);
        let values: Vec<f64> = times.iter().map(light).collect();
        let spectrum = Spectrum::new(&times, &values);
        assert!(spectrum.shows(line.frequency, 4.0));
        assert!(!spectrum.shows(1.3 * line.frequency, 4.0));
        let into = spectrum.time_into(&line, 0.0).rem_euclid(0.14);
        assert!((into - 0.05).abs() < 0.01, "{into}");
    }

    #[test]
    fn a_clock_that_jumps_does_not_ask_for_frequencies_without_end() {
        let mut times: Vec<f64> = (0..90).map(|k| k as f64 / 30.0).collect();
        assert!(are_regular(&times));
        // Two thirds of the frames lost, most of them in one outage.
        let lossy: Vec<f64> =
            (0..90).map(|k| f64::from(if k < 45 { k } else { 180 + k }) / 30.0).collect();
        assert!(are_regular(&lossy));
        times.iter_mut().enumerate().for_each(|(k, t)| *t = 1e-6 * k as f64);
        times[89] = 36_000.0;
        assert!(!are_regular(&times));
        assert!(Spectrum::new(&times, &[1.0; 90]).amplitudes.len() <= MOST_FREQUENCIES * 90);
    }
}
