//! Whether a light that nobody asked for explains the place as well: another tag, a status LED.
//!
//! Nothing is known of such a light but what lights of its kind have in common, so the request is
//! weighed against all of them together, each kind a mixture with a proper prior:
//! - *another code*: as many chips as the request has and of the same length, two or more of them
//!   different; every such code is as likely as every other;
//! - *no period*: chips of the same length, each on or off by chance: what a longer code shows so far;
//! - *another clock*: any brightness in each chip (Gaussian), any phase, any length of code that is
//!   requested, and a chip that is shorter or longer than the request's.
//!
//! The request must be as many times likelier than each kind as Ville's inequality asks for the lights
//! that there may be. A light that plays the request gathers evidence against all three from its first
//! frames; one that resembles it does not, however weak it is.

use std::f64::consts::LN_2;

use super::super::evidence::{Evidence, Series, log_sum, over_prior, weigh};
use super::super::history::History;
use super::banks::Banks;
use super::{NOISE_SLACK, Round, Seen};
use crate::Request;

/// Foreign tags that a picture shows on average, where there may be any.
const FOREIGN: f64 = 2.0;

/// Kinds of foreign light, which share the stated rate.
const KINDS: f64 = 3.0;

/// Chance that a foreign light has the chip of a request, to within what can be told, if no other
/// request has: chips spread over a decade, and it takes a few to tell a thirtieth.
const SAME_CHIP: f64 = 1.0 / 32.0;

/// Share of a light's power that is never quite as expected: edges between the phases of the bank,
/// saturation, shake, JPEG.
const MODEL: f64 = 0.02;

/// Codes of fewer chips have no other code beside them.
const FEWEST_CHIPS: usize = 4;

/// Chips up to this many times as long or short as those requested are reckoned with.
const SPREAD: f64 = 1.5;

/// Offsets of the chips' edges that are tried, as shares of a chip.
const OFFSETS: usize = 4;

impl Round<'_> {
    /// Whether the request explains a place so much better than any light that nobody asked for.
    pub(super) fn leads_foreign(&self, request: usize, seen: &Seen, banks: &mut Banks) -> bool {
        let Some(gap) = self.config.foreign_rate else { return true };
        let requests = self.requests.len() as f64;
        let lead = (KINDS * FOREIGN * requests / self.config.wrong_identity).ln();
        let (own, folds) = (seen.evidence.correlation.powi(2), self.folds(&seen.series));
        // What the freest light leaves is noise, but not when it is far beyond that of the surroundings:
        // then it is light that none of them explains.
        let free = folds.iter().map(|f| (f.explained(), f.chips.len()));
        let (explained, chips) = free.fold((own, 1), |a, b| if b.0 > a.0 { b } else { a });
        let mut series = seen.series.settled(explained, chips);
        series.noise = series.noise.min(NOISE_SLACK * seen.series.noise);
        series.noise += MODEL * own / series.freedom;
        let chips = self.flips(request, &seen.evidence, &series);
        let kin = lead + self.same_chip(request, gap).ln();
        if chips.no_period() < kin || chips.another_code() < kin {
            return false;
        }
        let own = weigh(&series, banks.own(self, request), 0.0, &mut Vec::new());
        let another_clock = self.another_clock(request, gap, &series, &folds);
        own.is_some_and(|own| own.log_ratio - another_clock >= lead)
    }

    /// Chance that a foreign light has the chip of a request: tags of one system share theirs.
    fn same_chip(&self, request: usize, gap: f64) -> f64 {
        let own = chip(&self.requests[request]);
        let kin = self.requests.iter().filter(|r| (chip(r) / own - 1.0).abs() < gap).count() - 1;
        let share = kin as f64 / (self.requests.len() - 1).max(1) as f64;
        SAME_CHIP + (1.0 - SAME_CHIP) * share
    }

    /// How likely each chip of a request was the other way round.
    fn flips(&self, request: usize, evidence: &Evidence, series: &Series) -> Flips {
        let pattern = &self.requests[request].pattern;
        let times = self.history.times();
        let at = (evidence.best.phase, evidence.best.rate);
        let mut rest = Vec::new();
        series.expect(pattern, times, at, self.nuisance, &mut rest);
        let amplitude = evidence.amplitude();
        for (r, v) in rest.iter_mut().zip(&series.values) {
            *r = v - amplitude as f32 * *r;
        }
        let chip = chip(&self.requests[request]);
        // Chips counted on from the first that the window shows.
        let position = |t: f64| (at.0 + at.1 * t) / chip;
        let start = times.first().map_or(0.0, |t| position(t.0)).floor();
        let end = times.last().map_or(0.0, |t| position(t.0 + t.1)).floor();
        let mut seen_chips = vec![[0.0; 2]; (end - start).max(0.0) as usize + 1];
        for (&(t, e), r) in times.iter().zip(&rest) {
            let (from, to) = (position(t) - start, position(t + e) - start);
            for k in from as usize..=(to as usize).min(seen_chips.len() - 1) {
                let within = to.min(k as f64 + 1.0) - from.max(k as f64);
                let share = if to > from { within / (to - from) } else { 1.0 };
                seen_chips[k][0] += share * f64::from(*r);
                seen_chips[k][1] += share * share;
            }
        }
        let length = pattern.bits.len();
        let log_flip = |k: usize, [rest, light]: [f64; 2]| {
            let sign = if pattern.bits.chip(start as i64 + k as i64) { -1.0 } else { 1.0 };
            (sign * amplitude * rest - 0.5 * amplitude * amplitude * light) / series.noise
        };
        let once: Vec<f64> =
            seen_chips.iter().enumerate().map(|(k, chip)| log_flip(k, *chip)).collect();
        let mut folded = vec![0.0; length.min(once.len())];
        for (k, flip) in once.iter().enumerate() {
            folded[k % length] += flip;
        }
        // What is projected out cannot speak against the request.
        let told = series.freedom / times.len().max(1) as f64;
        Flips { once, folded, told, phases: length as f64 }
    }

    /// The series laid over itself with the chips and lengths of code that are reckoned with.
    fn folds(&self, series: &Series) -> Vec<Fold> {
        let mut lengths: Vec<usize> = self.requests.iter().map(|r| r.pattern.bits.len()).collect();
        lengths.sort_unstable();
        lengths.dedup();
        let times = self.history.times();
        let mut folds = Vec::new();
        for length in lengths {
            let of_length = self.requests.iter().filter(|r| r.pattern.bits.len() == length);
            let (short, long) =
                of_length.map(chip).fold((f64::INFINITY, 0.0f64), |(a, b), c| (a.min(c), b.max(c)));
            for chip in grid(short / SPREAD, long * SPREAD, span(self.history)) {
                folds.extend((0..OFFSETS).map(|k| {
                    let offset = k as f64 / OFFSETS as f64;
                    Fold::new(&series.values, times, chip, offset, length)
                }));
            }
        }
        folds
    }

    /// Log likelihood ratio of a light of another chip than the request's: the mean over lengths,
    /// chips and offsets.
    fn another_clock(&self, request: usize, gap: f64, series: &Series, folds: &[Fold]) -> f64 {
        let own = chip(&self.requests[request]);
        // Nearer than this it is the request itself; codes of as many chips are told from it before.
        let few = self.requests[request].pattern.bits.len() < FEWEST_CHIPS;
        let apart = if few { gap } else { gap.min(step(own, span(self.history))) };
        let others: Vec<&Fold> =
            folds.iter().filter(|f| (f.chip / own - 1.0).abs() >= apart).collect();
        let of_length = others.chunk_by(|a, b| a.chips.len() == b.chips.len());
        let means: Vec<f64> = of_length
            .map(|folds| {
                let ratios: Vec<f64> = folds.iter().map(|f| f.log_ratio(series)).collect();
                log_sum(&ratios) - (ratios.len() as f64).ln()
            })
            .collect();
        log_sum(&means) - (means.len().max(1) as f64).ln()
    }
}

fn chip(request: &Request) -> f64 {
    request.pattern.chip.as_secs_f64()
}

/// Seconds from the first to the last frame of the window.
fn span(history: &History) -> f64 {
    let times = history.times();
    times.last().map_or(0.0, |l| l.0) - times.first().map_or(0.0, |f| f.0)
}

/// By how much, relative, a chip must differ for the edges to drift by half a chip over `span` seconds
/// (a quarter at the most).
fn step(chip: f64, span: f64) -> f64 {
    (0.5 * chip / span.max(1e-3)).min(0.25)
}

/// Chips so close that over `span` seconds the edges stay within half a chip.
fn grid(short: f64, long: f64, span: f64) -> Vec<f64> {
    let mut chips = Vec::new();
    let mut chip = short;
    while chip < long {
        chips.push(chip);
        chip *= 1.0 + step(chip, span);
    }
    chips
}

/// Log likelihood ratios of every chip the other way round to the chip as requested.
struct Flips {
    /// Of every chip in the window.
    once: Vec<f64>,
    /// Of every chip of the period.
    folded: Vec<f64>,
    /// Share of the frames' information that the nuisances leave.
    told: f64,
    /// Phases at which a code of chance may look like the request.
    phases: f64,
}

impl Flips {
    /// Lead of the request over chips of chance (nats).
    fn no_period(&self) -> f64 {
        let told: f64 = self.once.iter().map(|f| LN_2 - log_one_plus_exp(*f)).sum();
        self.told * told - self.phases.ln()
    }

    /// Lead of the request over the codes of its length that differ in two chips or more (nats).
    fn another_code(&self) -> f64 {
        if self.folded.len() < FEWEST_CHIPS {
            return f64::INFINITY;
        }
        // Sum over all sets of flipped chips less that over none and one; the largest taken out.
        let all: f64 = self.folded.iter().map(|f| log_one_plus_exp(*f)).sum();
        let few = self.folded.iter().map(|f| (f - all).exp()).sum::<f64>() + (-all).exp();
        let others = all + (1.0 - few).max(f64::MIN_POSITIVE).ln();
        self.folded.len() as f64 * LN_2 - self.phases.ln() - others
    }
}

/// `ln(1 + e^x)`, for large `x` too.
fn log_one_plus_exp(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// A series laid over itself with some period.
struct Fold {
    /// Length of a chip (s).
    chip: f64,
    /// Sum and number of frames of every chip.
    chips: Vec<[f64; 2]>,
}

impl Fold {
    /// Lays `values` over itself with `length` chips of `chip` seconds; `offset`: share of a chip.
    fn new(values: &[f32], times: &[(f64, f64)], chip: f64, offset: f64, length: usize) -> Self {
        let mut chips = vec![[0.0; 2]; length];
        let (per_second, period) = (1.0 / chip, length as f64);
        for (&(t, e), v) in times.iter().zip(values) {
            let position = (t + 0.5 * e) * per_second + offset;
            let turns = (position / period) as i64 as f64;
            let k = (position - turns * period) as usize;
            let [sum, count] = &mut chips[k.min(length - 1)];
            *sum += f64::from(*v);
            *count += 1.0;
        }
        Fold { chip, chips }
    }

    /// Energy that the best brightness in each chip explains.
    fn explained(&self) -> f64 {
        self.chips.iter().map(|[sum, count]| sum * sum / count.max(1.0)).sum()
    }

    /// Log likelihood ratio when the chips' brightness is normal about their mean, with the standard
    /// deviations that lights of the amplitudes' priors have.
    fn log_ratio(&self, series: &Series) -> f64 {
        let frames: f64 = self.chips.iter().map(|c| c[1]).sum();
        over_prior(series, |width| {
            // On and off lie half an amplitude either side of the mean.
            let gain = 0.25 * width * width;
            let (mut log_det, mut explained) = (0.0, 0.0);
            let (mut product, mut squares, mut sums) = (1.0f64, 0.0, 0.0);
            for &[sum, count] in &self.chips {
                let shrink = gain / (1.0 + gain * count);
                product *= 1.0 + gain * count;
                if product > 1e200 {
                    log_det += product.ln();
                    product = 1.0;
                }
                explained += shrink * sum * sum;
                squares += shrink * count * count;
                sums += shrink * sum * count;
            }
            // The mean is free: what all chips have in common is no evidence.
            let rest = (1.0 - squares / frames).max(1e-9);
            log_det += product.ln() + rest.ln();
            explained += sums * sums / (frames * rest);
            (0.5 * log_det, explained)
        })
    }
}
