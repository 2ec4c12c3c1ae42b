//! Whether a light that nobody asked for explains the place as well: another tag, a status LED.
//!
//! Nothing is known of such a light but what lights of its kind have in common, so the request is
//! weighed against all of them together, a mixture of three kinds with a proper prior:
//! - *another code*: as many chips as the request has and of the same length, two or more of them
//!   different; every such code is as likely as every other;
//! - *no period*: chips of the same length, each on or off by chance: what a longer code shows so far;
//! - *another clock*: any code of as many chips as any request has, each on or off by chance, with a
//!   chip that is shorter or longer than the request's.
//!
//! The request must be as many times likelier than the mixture as Ville's inequality asks for the
//! lights that there may be. A light that plays the request gathers evidence against all three kinds
//! from its first frames, one that resembles it gathers evidence for one of them.

use super::super::evidence::log_sum;
use super::super::template::light;
use super::codes::{Clock, Lit, Ring};
use super::{Round, Seen};
use crate::Request;

/// Foreign lights that a picture shows on average, where there may be any.
const FOREIGN: f64 = 2.0;

/// Chance that a foreign light has the chip of a request, to within what can be told, if no other
/// request has: chips spread over a decade, and it takes a few to tell a thirtieth.
const SAME_CHIP: f64 = 1.0 / 32.0;

/// Share of a light's power that is never quite as expected: saturation, shake, JPEG.
const MODEL: f64 = 0.02;

/// Codes of fewer chips have no other code beside them.
const FEWEST_CHIPS: usize = 4;

/// Chips up to this many times as long or short as those requested are reckoned with.
const SPREAD: f64 = 1.5;

/// Time (s) over which chips are told apart at most: a camera may pause, and the number of chips that a
/// longer time tells apart grows without need.
const LONGEST: f64 = 20.0;

impl Round<'_> {
    /// Whether the request explains a place so much better than any light that nobody asked for.
    pub(super) fn leads_foreign(&self, request: usize, seen: &Seen) -> bool {
        let Some(gap) = self.config.foreign_rate else { return true };
        let foreign = FOREIGN * self.requests.len() as f64;
        let lead = (foreign / self.config.wrong_identity).ln();
        Rivals::new(self, request, seen, gap).trail_by(lead)
    }
}

/// A request at a place, to be weighed against foreign lights. All levels are log likelihood ratios
/// against no light.
struct Rivals<'a> {
    requests: &'a [Request],
    own: &'a Request,
    /// What the place shows, with the amplitude that the request has there.
    lit: Lit<'a>,
    /// Level of the request.
    level: f64,
    /// The request's chips at the middle of the window.
    middle: f64,
    /// Time (s) over which chips are told apart.
    span: f64,
    /// Relative difference of clocks from which they are to be told apart.
    gap: f64,
}

impl<'a> Rivals<'a> {
    fn new(round: &'a Round, request: usize, seen: &'a Seen, gap: f64) -> Self {
        let Seen { evidence, series, .. } = seen;
        let (own, times) = (&round.requests[request], round.history.times());
        let (phase, rate) = (evidence.best.phase, evidence.best.rate);
        let energy = evidence.correlation.powi(2);
        let mut lit = Lit {
            series,
            nuisance: round.nuisance,
            times,
            amplitude: evidence.amplitude(),
            noise: series.noise + MODEL * energy / series.freedom,
            light: Vec::new(),
        };
        light(&own.pattern, times, &evidence.best, &mut lit.light);
        Rivals {
            requests: round.requests,
            own,
            // The edges at their best, as those of all others, and the mean over the chips to start with.
            level: 0.5 * energy / lit.noise - (own.pattern.bits.len() as f64).ln(),
            middle: (phase + rate * lit.middle()) / chip(own),
            lit,
            span: round.history.span().min(LONGEST),
            gap,
        }
    }

    /// Whether the mixture of all foreign lights trails the request by so much.
    fn trail_by(&self, lead: f64) -> bool {
        let same_chip = self.same_chip();
        let kinds: [(f64, &dyn Fn() -> f64); 3] = [
            (0.5 * same_chip, &|| self.no_period()),
            (0.5 * same_chip, &|| self.another_code()),
            (1.0 - same_chip, &|| self.another_clock()),
        ];
        let mut levels = Vec::new();
        // The dearest comes last: mostly an earlier one is too much already.
        kinds.iter().all(|(share, level)| {
            levels.push(share.ln() + level());
            self.level - log_sum(&levels) >= lead
        })
    }

    /// Chance that a foreign light has the chip of the request: tags of one system share theirs.
    fn same_chip(&self) -> f64 {
        let alike = |r: &&Request| (chip(r) / chip(self.own) - 1.0).abs() < self.gap;
        let kin = self.requests.iter().filter(alike).count() - 1;
        let share = kin as f64 / (self.requests.len() - 1).max(1) as f64;
        SAME_CHIP + (1.0 - SAME_CHIP) * share
    }

    /// The request's chip, and by how much (relative) another may differ and still pass for it.
    fn own_chip(&self) -> (f64, f64) {
        let own = chip(self.own);
        (own, step(own, self.span))
    }

    /// Level of chips of chance, as long as the request's.
    fn no_period(&self) -> f64 {
        let own = self.own_chip();
        let shown = (self.span / own.0) as usize + 3;
        self.lit.over_clocks(&[own], shown, |ring, _| ring.log_mean())
    }

    /// Level of the codes of the request's length and chip that differ from it in two chips or more.
    fn another_code(&self) -> f64 {
        let length = self.own.pattern.bits.len();
        if length < FEWEST_CHIPS {
            return f64::NEG_INFINITY;
        }
        self.lit.over_clocks(&[self.own_chip()], length, |ring, clock| self.others(ring, clock, 1))
    }

    /// Level of lights of another chip than the request's: the mean over lengths and chips.
    fn another_clock(&self) -> f64 {
        let ((own, step), own_length) = (self.own_chip(), self.own.pattern.bits.len());
        // Nearer than this it is the request itself; codes of as many chips are told from it before.
        let apart = if own_length < FEWEST_CHIPS { self.gap } else { step.min(self.gap) };
        let mut lengths: Vec<usize> = self.requests.iter().map(|r| r.pattern.bits.len()).collect();
        lengths.sort_unstable();
        lengths.dedup();
        let of_length = |&length: &usize| {
            let kin = self.requests.iter().filter(|r| r.pattern.bits.len() == length).map(chip);
            let (short, long) = kin.fold((f64::INFINITY, 0.0f64), |(a, b), c| (a.min(c), b.max(c)));
            let mut chips = grid(short / SPREAD, long * SPREAD, self.span);
            chips.retain(|c| (c.0 / own - 1.0).abs() >= apart);
            self.lit.over_clocks(&chips, length, |ring, clock| {
                // A code of more and shorter chips may be the request itself.
                let parts = (own / clock.chip).round().max(1.0);
                let same = (own / (parts * clock.chip) - 1.0).abs() < apart;
                if same && length.is_multiple_of(own_length * parts as usize) {
                    self.others(ring, clock, parts as i64)
                } else {
                    ring.log_mean()
                }
            })
        };
        log_sum(&lengths.iter().map(of_length).collect::<Vec<_>>()) - (lengths.len() as f64).ln()
    }

    /// Level of the codes of a clock, `parts` of whose chips make one of the request's, without the
    /// request and what differs from it in one chip.
    fn others(&self, ring: &Ring, clock: Clock, parts: i64) -> f64 {
        let bits = &self.own.pattern.bits;
        // Edges elsewhere than the request's: it may be meant with the chip before or after.
        let turn = (self.middle * parts as f64 - clock.offset).floor() as i64;
        let before = |k: usize| bits.chip((k as i64 + turn).div_euclid(parts));
        let after = |k: usize| bits.chip((k as i64 + turn + 1).div_euclid(parts));
        ring.log_mean_without(&[&before, &after])
    }
}

fn chip(request: &Request) -> f64 {
    request.pattern.chip.as_secs_f64()
}

/// By how much, relative, a chip must differ for the edges to drift by half a chip over `span` seconds
/// (a quarter at the most).
fn step(chip: f64, span: f64) -> f64 {
    (0.5 * chip / span.max(1e-3)).min(0.25)
}

/// Chips so close that over `span` seconds the edges stay within half a chip, each with its distance to
/// the next.
fn grid(short: f64, long: f64, span: f64) -> Vec<(f64, f64)> {
    let mut chips = Vec::new();
    let mut chip = short;
    while chip < long {
        let step = step(chip, span);
        chips.push((chip, step));
        chip *= 1.0 + step;
    }
    chips
}
