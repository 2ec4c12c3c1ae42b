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
//! frames, one that resembles it gathers evidence for one of them.

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

/// Time (s) over which chips are told apart at most: a camera may pause, and the number of chips that a
/// longer time tells apart grows without need.
const LONGEST: f64 = 20.0;

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
        let (phase, rate) = (evidence.best.phase, evidence.best.rate);
        let (times, amplitude) = (self.history.times(), evidence.amplitude());
        let mut rest = Vec::new();
        series.expect(pattern, times, (phase, rate), self.nuisance, &mut rest);
        for (r, v) in rest.iter_mut().zip(&series.values) {
            *r = v - amplitude as f32 * *r;
        }
        let chip = chip(&self.requests[request]);
        let position = |t: f64| (phase + rate * t) / chip;
        let shares = times.iter().zip(&rest).map(|(&(t, e), r)| (position(t), position(t + e), *r));
        let length = pattern.bits.len();
        let mut folded = vec![0.0; length];
        let flip = |ChipSeen { number, rest, light }: ChipSeen| {
            let sign = if pattern.bits.chip(number) { -1.0 } else { 1.0 };
            let flip = amplitude * (sign * rest - 0.5 * amplitude * light) / series.noise;
            folded[number.rem_euclid(length as i64) as usize] += flip;
            flip
        };
        let once = chips_seen(shares).into_iter().map(flip).collect();
        // What is projected out cannot speak against the request.
        let told = series.freedom / times.len().max(1) as f64;
        Flips { once, folded, told }
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

/// Seconds from the first to the last frame of the window, pauses cut.
fn span(history: &History) -> f64 {
    let times = history.times();
    let span = times.last().map_or(0.0, |l| l.0) - times.first().map_or(0.0, |f| f.0);
    span.min(LONGEST)
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

/// What the frames say about one chip.
struct ChipSeen {
    /// Its number, counted from the first of the pattern.
    number: i64,
    /// Sum of what the request leaves unexplained (grey levels).
    rest: f64,
    /// Squared length of the chip's light (frames).
    light: f64,
}

/// The chips that frames show: each with the chips at which its exposure starts and ends, and what is
/// unexplained.
fn chips_seen(frames: impl Iterator<Item = (f64, f64, f32)>) -> Vec<ChipSeen> {
    let mut seen: Vec<ChipSeen> = Vec::new();
    for (from, to, rest) in frames {
        for number in from.floor() as i64..=to.floor() as i64 {
            let within = to.min(number as f64 + 1.0) - from.max(number as f64);
            let share = if to > from { within / (to - from) } else { 1.0 };
            let (rest, light) = (share * f64::from(rest), share * share);
            // Exposures may share a chip, and no more than the last few.
            match seen.iter_mut().rev().take_while(|s| s.number >= number).last() {
                Some(s) if s.number == number => {
                    s.rest += rest;
                    s.light += light;
                }
                _ => seen.push(ChipSeen { number, rest, light }),
            }
        }
    }
    seen
}

/// Log likelihood ratios of every chip the other way round to the chip as requested.
struct Flips {
    /// Of every chip that the window shows.
    once: Vec<f64>,
    /// Of every chip of the period; zero where it is not seen.
    folded: Vec<f64>,
    /// Share of the frames' information that the nuisances leave.
    told: f64,
}

impl Flips {
    /// Phases at which a code of chance may look like the request (nats).
    fn phases(&self) -> f64 {
        (self.folded.len() as f64).ln()
    }

    /// Lead of the request over chips of chance (nats).
    fn no_period(&self) -> f64 {
        let lead: f64 = self.once.iter().map(|f| LN_2 - log_one_plus_exp(*f)).sum();
        self.told * lead - self.phases()
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
        self.folded.len() as f64 * LN_2 - self.phases() - others
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
        // On and off lie half an amplitude either side of the mean.
        over_prior(series, |width| self.normal(0.25 * width * width))
    }

    /// Half the logarithm of the determinant of the covariance relative to the noise, and the energy
    /// explained, when the chips' variance is `gain` times that of the noise. The mean of the series is
    /// zero: what all chips have in common is no evidence.
    fn normal(&self, gain: f64) -> (f64, f64) {
        let frames: f64 = self.chips.iter().map(|c| c[1]).sum();
        let (mut log_det, mut product, mut explained) = (0.0, 1.0f64, 0.0);
        let (mut squares, mut sums) = (0.0, 0.0);
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
        // The mean that is taken out is a matrix of rank one (Sherman and Morrison).
        let rest = (1.0 - squares / frames).max(1e-9);
        log_det += product.ln() + rest.ln();
        explained += sums * sums / (frames * rest);
        (0.5 * log_det, explained)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    #[test]
    fn a_normal_brightness_in_each_chip_is_weighed_as_by_matrices() {
        let times: Vec<(f64, f64)> = (0..40).map(|k| (0.033 * k as f64, 0.005)).collect();
        let mut values: Vec<f32> = (0..40).map(|k| ((k * k * 7) % 23) as f32).collect();
        let mean = values.iter().sum::<f32>() / 40.0;
        values.iter_mut().for_each(|v| *v -= mean);
        let (chip, length, gain) = (0.061, 7, 3.0);
        let fold = Fold::new(&values, &times, chip, 0.25, length);
        let in_chip = |t: usize, k: usize| {
            let position = (times[t].0 + 0.0025) / chip + 0.25;
            f64::from(u8::from(position as usize % length == k))
        };
        let design = DMatrix::from_fn(40, length, in_chip);
        let centred = &design - DMatrix::from_fn(40, length, |_, k| design.column(k).mean());
        let covariance = DMatrix::identity(length, length) + gain * centred.transpose() * &centred;
        let series = DVector::from_iterator(40, values.iter().map(|v| f64::from(*v)));
        let product = centred.transpose() * series;
        let inverse = covariance.clone().try_inverse().unwrap();
        let explained = gain * (product.transpose() * inverse * &product)[(0, 0)];
        let (half_log_det, energy) = fold.normal(gain);
        assert!((half_log_det - 0.5 * covariance.determinant().ln()).abs() < 1e-9);
        assert!((energy / explained - 1.0).abs() < 1e-6, "{energy} is not {explained}");
    }

    /// All other codes one by one, against the sum over sets of flipped chips.
    #[test]
    fn all_codes_with_two_other_chips_are_weighed() {
        let folded = vec![-3.0, 0.5, -7.0, -1.0, -2.5];
        let likelihood = |code: u32| -> f64 {
            let flipped = (0..5).filter(|k| code >> k & 1 == 1);
            flipped.map(|k| folded[k]).sum::<f64>().exp()
        };
        let others: f64 = (0..32u32).filter(|c| c.count_ones() >= 2).map(likelihood).sum();
        let flips = Flips { once: Vec::new(), folded, told: 1.0 };
        let lead = (1.0 / 5.0f64).ln() - (others / 32.0).ln();
        assert!((flips.another_code() - lead).abs() < 1e-9, "{}", flips.another_code());
    }

    #[test]
    fn chips_that_are_certain_count_a_bit_each() {
        let flips = |f: f64| Flips { once: vec![f; 20], folded: vec![f; 8], told: 1.0 };
        assert!((flips(-50.0).no_period() - (20.0 * LN_2 - 8f64.ln())).abs() < 1e-9);
        assert!(flips(0.0).no_period() < 0.0, "chips of which nothing is known say nothing");
        assert!(flips(2000.0).no_period() < -1e4, "no overflow");
    }

    #[test]
    fn a_frame_is_shared_by_the_chips_of_its_exposure() {
        let frames = [(-0.5, -0.25, 1.0), (0.75, 1.25, 4.0), (1.5, 1.5, 3.0), (1e9, 1e9, 2.0)];
        let seen = chips_seen(frames.into_iter());
        let found: Vec<_> = seen.iter().map(|s| (s.number, s.rest, s.light)).collect();
        let expected = [(-1, 1.0, 1.0), (0, 2.0, 0.25), (1, 5.0, 1.25), (1_000_000_000, 2.0, 1.0)];
        assert_eq!(found, expected);
    }
}
