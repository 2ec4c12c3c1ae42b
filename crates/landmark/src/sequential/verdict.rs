//! From evidence to decisions.
//!
//! A request is "here" when at some place all of these hold:
//! - presence: the log likelihood ratio passes `ln(M / alpha)`, M the number of places times requests
//!   (Ville's bound over the whole picture and all frames; phases, rates and amplitudes are averaged
//!   over and cost nothing more);
//! - identity: it leads every other request at that place by `ln(others / alpha)`, and the same
//!   pattern played too fast or too slow as well;
//! - the light has changed often enough that no single event looks like it;
//! - what it leaves unexplained is small: a foreign blinker may resemble a pattern, but not fit it.

use std::time::Duration;

use nalgebra::{Matrix2, Point2, Vector2};

use super::Config;
use super::evidence::{Evidence, Series, refine, refined_gain, unexplained, weigh};
use super::front::{BLOB_VARIANCE, BOX_SHARE};
use super::history::{History, noise_share};
use super::nuisance::{Nuisance, dot};
use super::places::{Place, Watch};
use super::scan::{BlockNoise, MARGIN};
use super::spot;
use super::surroundings::intruders;
use super::template::{Bank, every_line, rates, transitions};
use crate::{Decision, Request, Sighting};

/// Changes of the light that must have been seen: one more than a passing thing and its shadow make.
const TRANSITIONS: f64 = 5.0;

/// Share of the explained energy that may stay unexplained beyond the noise: what phase, saturation,
/// shake and JPEG leave of a tag's light is below a twentieth, a foreign code leaves more than a tenth.
const MISFIT: f64 = 0.1;

/// Standard deviations of chance by which another code must fit better to be believed.
const CHANCE: f64 = 4.0;

/// Degrees of freedom from which what is left over tells the noise.
const FREE: f64 = 10.0;

/// Factor on the noise of the neighbourhood before anything counts as unexplained.
const NOISE_SLACK: f64 = 1.5;

/// Places of one pattern that are reported at most.
const MOST_PLACES: usize = 8;

/// Distance (px) within which two sightings are one light.
const ONE_LIGHT: f64 = 5.0;

/// Distance (px) up to which filter and JPEG blocks leave ghosts of a light, and their share of it.
const GHOST: (f64, f64) = (16.0, 0.3);

/// Multiples of the foreign rate that are tried on either side.
const FOREIGN: [f64; 6] = [1.0, 1.5, 2.0, 3.0, 4.0, 6.0];

/// Systematic part of a position's standard deviation (px): a light is no perfect point.
const FLOOR_PX: f64 = 0.02;

/// Restless places to reckon with where the picture shows none but the one in question: so many in so
/// many pixels.
const UNSEEN: (f64, f64) = (0.002, 640.0 * 480.0);

/// Foreign codes to reckon with in a picture, however many places are restless.
const MOST_FOREIGN: f64 = 4.0;

/// Share of the presence threshold from which a pixel is looked at closer: the rest may be lost
/// between pixels.
const CLOSER: f64 = 0.5;

/// Everything that the decisions of one moment rest on.
pub struct Round<'a> {
    pub requests: &'a [Request],
    pub config: &'a Config,
    pub history: &'a History,
    pub noise: &'a BlockNoise,
    pub nuisance: &'a Nuisance,
    pub frames: usize,
    pub stamp: Duration,
    pub size: (usize, usize),
    /// Places that vary more than the noise around explains.
    pub restless: &'a [Point2<f64>],
    /// Places of the lights that are known.
    pub known: Vec<Point2<f64>>,
}

/// A place with the evidence for one request.
struct Seen {
    /// Index of the place and of its watch in the short list.
    at: (usize, usize),
    place: Point2<f64>,
    evidence: Evidence,
    series: Series,
}

/// Banks of the requests, built when first needed and kept from frame to frame.
#[derive(Debug, Clone)]
pub struct Banks {
    own: Vec<Option<Bank>>,
    foreign: Vec<Option<Bank>>,
}

impl Banks {
    /// No bank yet, for so many requests.
    pub fn new(requests: usize) -> Self {
        Banks { own: vec![None; requests], foreign: vec![None; requests] }
    }

    /// The bank of a request at the clock rates it may have.
    fn own(&mut self, round: &Round, request: usize) -> &Bank {
        let Request { pattern, clock_tolerance, .. } = &round.requests[request];
        let times = round.history.times();
        let span = times.last().map_or(0.0, |l| l.0) - times.first().map_or(0.0, |f| f.0);
        let rates = rates(pattern, *clock_tolerance, span);
        let slot = &mut self.own[request];
        if slot.as_ref().is_some_and(|bank| !bank.has_rates(rates.len())) {
            *slot = None;
        }
        fitted(slot, round, || Bank::new(pattern, &rates, times, round.history.capacity(), true))
    }

    /// The bank of the same pattern played too slow or too fast.
    fn foreign(&mut self, round: &Round, request: usize, rate: f64) -> &Bank {
        let Request { pattern, clock_tolerance, .. } = &round.requests[request];
        let gap = rate + clock_tolerance;
        let rates: Vec<f64> =
            FOREIGN.iter().flat_map(|k| [1.0 / (1.0 + k * gap), 1.0 + k * gap]).collect();
        let (times, window) = (round.history.times(), round.history.capacity());
        let new = || Bank::new(pattern, &rates, times, window, false);
        fitted(&mut self.foreign[request], round, new)
    }
}

/// The bank of a slot, brought up to the window of this round.
fn fitted<'a>(slot: &'a mut Option<Bank>, round: &Round, new: impl FnOnce() -> Bank) -> &'a Bank {
    let bank = slot.get_or_insert_with(new);
    bank.fit(round.history.times(), round.history.numbers(), round.nuisance);
    bank
}

/// Log likelihood ratio that presence needs in a picture of this size.
pub fn presence(size: (usize, usize), requests: usize, false_alarm: f64) -> f64 {
    // Places that are independent under the blur of a light: area over 4 pi s^2.
    let cells = (size.0 * size.1) as f64 / (2.0 * std::f64::consts::PI * BLOB_VARIANCE);
    (cells * requests as f64 / false_alarm).ln()
}

/// Log likelihood ratio by which each of so many other explanations must be beaten.
pub fn margin(others: usize, wrong_identity: f64) -> f64 {
    (others.max(1) as f64 / wrong_identity).ln()
}

impl Round<'_> {
    /// Log likelihood ratio that presence needs.
    fn presence(&self) -> f64 {
        presence(self.size, self.requests.len(), self.config.false_alarm)
    }

    /// Whether a place passes if it is one of those that vary more than the noise around explains.
    /// They are few, but nothing is known of how they vary: with a noise of their own, or as a light
    /// that blinks some other code.
    fn stands_if_restless(&self, request: usize, seen: &Seen) -> bool {
        // Places close by may be ghosts of this one, and a light that is known already is no riddle.
        let far = |a: &Point2<f64>, b: &Point2<f64>| (a - b).norm() > GHOST.0;
        let others = self.restless.iter().filter(|p| far(p, &seen.place));
        let unknown = others.filter(|p| self.known.iter().all(|k| far(p, k))).count() as f64;
        let requests = self.requests.len() as f64;
        let area = (self.size.0 * self.size.1) as f64 / UNSEEN.1;
        let chances = (unknown + UNSEEN.0 * area) * requests / self.config.false_alarm;
        if seen.evidence.restless < chances.ln() {
            return false;
        }
        // A code of random chips looks like this pattern at one of its phases by chance; what is
        // projected out cannot speak against it.
        let pattern = &self.requests[request].pattern;
        let times = self.history.times();
        let span = times.last().map_or(0.0, |l| l.0) - times.first().map_or(0.0, |f| f.0);
        let frames = times.len() as f64;
        let chips = (span / pattern.chip.as_secs_f64() + 1.0).min(frames);
        let left = chips * seen.series.freedom / frames;
        let phases = pattern.bits.len() as f64;
        let foreign = unknown.clamp(UNSEEN.0, MOST_FOREIGN);
        left >= (foreign * requests * phases / self.config.wrong_identity).log2()
    }

    /// Log likelihood ratio from which a pixel is looked at closer.
    fn floor(&self) -> f64 {
        CLOSER * self.presence()
    }

    /// Log likelihood ratio by which another explanation must be beaten.
    fn margin(&self, others: usize) -> f64 {
        margin(others, self.config.wrong_identity)
    }

    /// Frame count at which a place of this evidence is worth another look: evidence grows by its
    /// mean so far, or by three times that with luck.
    fn due(&self, level: f64, target: f64, longest: usize) -> usize {
        let growth = 3.0 * level.max(2.0) / self.frames as f64;
        let wait = ((target - level) / growth) as usize;
        self.frames + wait.clamp(1, longest.max(1))
    }

    /// Brings the decisions up to date: weighs the places that are due. `thorough`: all of them.
    pub fn decide(
        &self,
        places: &mut [Place],
        banks: &mut Banks,
        thorough: bool,
        decisions: &mut [Decision],
    ) {
        let near = self.weigh_due(places, banks, thorough);
        for (request, near) in near.into_iter().enumerate() {
            let sightings = if near {
                let seen = self.seen(request, places, banks);
                self.sightings(request, seen, places, banks)
            } else {
                Vec::new()
            };
            self.conclude(sightings, &mut decisions[request]);
        }
    }

    /// Weighs every watch that is due; whether any reached the floor, for every request.
    fn weigh_due(&self, places: &mut [Place], banks: &mut Banks, thorough: bool) -> Vec<bool> {
        let mut near = vec![false; self.requests.len()];
        let (mut raw, mut scratch) = (Vec::new(), Vec::new());
        for place in places {
            if !thorough && place.watches.iter().all(|w| w.due > self.frames) {
                continue;
            }
            self.history.series_at(place.pixel, &mut raw);
            let series = self.series_of(place.pixel, &raw);
            for watch in &mut place.watches {
                if !thorough && watch.due > self.frames {
                    continue;
                }
                let bank = banks.own(self, watch.request);
                let evidence = weigh(&series, bank, self.floor(), &mut scratch);
                watch.level = evidence.map_or(0.0, |e| e.log_ratio);
                watch.due = self.due(watch.level, self.floor(), self.frames / 4);
                near[watch.request] |= watch.level >= self.floor();
            }
        }
        near
    }

    /// The places that reach the floor for a request.
    fn seen(&self, request: usize, places: &[Place], banks: &mut Banks) -> Vec<Seen> {
        let (mut raw, mut scratch) = (Vec::new(), Vec::new());
        let mut seen = Vec::new();
        for (p, place) in places.iter().enumerate() {
            let hot = |w: &Watch| w.request == request && w.level >= self.floor();
            let Some(w) = place.watches.iter().position(hot) else { continue };
            self.history.series_at(place.pixel, &mut raw);
            let series = self.series_of(place.pixel, &raw);
            let bank = banks.own(self, request);
            if let Some(evidence) = weigh(&series, bank, self.floor(), &mut scratch) {
                let place = Point2::new(place.pixel.0 as f64, place.pixel.1 as f64);
                seen.push(Seen { at: (p, w), place, evidence, series });
            }
        }
        seen
    }

    /// The series of a pixel; where it varies beyond the noise, what leaks in is taken out.
    fn series_of(&self, pixel: (usize, usize), raw: &[f32]) -> Series {
        let noise = self.noise.at(pixel.0, pixel.1);
        let plain = Series::new(raw, self.nuisance, Vec::new(), noise);
        if plain.energy < NOISE_SLACK * noise * plain.freedom {
            return plain;
        }
        let local = intruders(self.history, pixel, raw, self.nuisance, noise);
        if local.is_empty() { plain } else { Series::new(raw, self.nuisance, local, noise) }
    }

    /// Sets one decision from the sightings of this round.
    fn conclude(&self, mut sightings: Vec<Sighting>, decision: &mut Decision) {
        if let Decision::Here(before) = decision {
            // The moment of decision stays; position and amplitude keep improving.
            for s in &mut sightings {
                let same = |b: &&Sighting| (b.pixel - s.pixel).norm() < ONE_LIGHT;
                if let Some(b) = before.iter().find(same) {
                    (s.phase, s.decided_at, s.frames) = (b.phase, b.decided_at, b.frames);
                }
            }
            if !sightings.is_empty() {
                *decision = Decision::Here(sightings);
            }
        } else if !sightings.is_empty() {
            *decision = Decision::Here(sightings);
        }
    }

    /// Says "absent" of what would have been found by now; to be asked after a scan.
    pub fn rule_out(&self, decisions: &mut [Decision]) {
        for (request, decision) in decisions.iter_mut().enumerate() {
            if *decision == Decision::Undecided && self.would_have_seen(request) {
                *decision = Decision::Absent;
            }
        }
    }

    /// Whether a tag of the least contrast would have been found by now.
    fn would_have_seen(&self, request: usize) -> bool {
        let pattern = &self.requests[request].pattern;
        let duty = f64::from(pattern.bits.weight()) / pattern.bits.len() as f64;
        let light = self.history.len() as f64 * duty * (1.0 - duty);
        let evidence = self.config.least_contrast.powi(2) * light / (2.0 * self.noise.median());
        let changes = transitions(pattern, self.history.times());
        evidence > 2.0 * self.presence() + 10.0 && changes > 2.0 * TRANSITIONS
    }

    /// The places of one request that pass every test, brightest first.
    fn sightings(
        &self,
        request: usize,
        mut seen: Vec<Seen>,
        places: &mut [Place],
        banks: &mut Banks,
    ) -> Vec<Sighting> {
        if transitions(&self.requests[request].pattern, self.history.times()) < TRANSITIONS {
            return Vec::new();
        }
        seen.sort_by(|a, b| b.evidence.correlation.total_cmp(&a.evidence.correlation));
        let mut kept: Vec<Sighting> = Vec::new();
        for candidate in seen {
            if kept.len() == MOST_PLACES {
                break;
            }
            let (p, w) = candidate.at;
            let due = &mut places[p].watches[w].due;
            // At every frame while presence is near; what else fails takes longer to mend.
            *due = self.frames + (self.frames / 16).max(1);
            let Some(sharp) = self.sharpen(request, candidate, banks) else { continue };
            let level = sharp.evidence.log_ratio;
            if level < self.presence() {
                *due = self.due(level, self.presence() - 1.0, self.frames / 16);
            }
            let pixel = self.shown(sharp.place);
            let ghost = |s: &Sighting| {
                let distance = (s.pixel - pixel).norm();
                distance < ONE_LIGHT
                    || (distance < GHOST.0 && sharp.evidence.amplitude() < GHOST.1 * s.amplitude)
            };
            if kept.iter().any(ghost) || !self.stands(request, &sharp, banks) {
                continue;
            }
            kept.push(self.sighting(request, &sharp));
        }
        kept.sort_by(|a, b| b.amplitude.total_cmp(&a.amplitude));
        kept
    }

    /// Moves a place to the sub-pixel maximum of its light, and weighs it again there.
    fn sharpen(&self, request: usize, seen: Seen, banks: &mut Banks) -> Option<Seen> {
        let pattern = &self.requests[request].pattern;
        let step = banks.own(self, request).step;
        let (mut place, mut evidence, mut series) = (seen.place, seen.evidence, seen.series);
        let (mut raw, mut expected, mut scratch) = (Vec::new(), Vec::new(), Vec::new());
        if series.local.is_empty() {
            let pixel = (place.x as usize, place.y as usize);
            self.history.series_at(pixel, &mut raw);
            let local = intruders(self.history, pixel, &raw, self.nuisance, series.noise);
            if !local.is_empty() {
                series = Series::new(&raw, self.nuisance, local, series.noise);
                evidence = weigh(&series, banks.own(self, request), self.floor(), &mut scratch)?;
            }
        }
        for _ in 0..2 {
            evidence =
                refine(&series, pattern, self.history.times(), self.nuisance, evidence, step);
            let best = (evidence.best.phase, evidence.best.rate);
            series.expect(pattern, self.history.times(), best, self.nuisance, &mut expected);
            let moved = self.peak(place, &expected, &mut raw);
            let (dx, dy) = (moved.x - seen.place.x, moved.y - seen.place.y);
            if dx.abs().max(dy.abs()) > 2.0 {
                return None;
            }
            place = moved;
            self.history.series(place, &mut raw);
            let noise = self.noise.at(place.x as usize, place.y as usize) * noise_share(place);
            series = Series::new(&raw, self.nuisance, series.local, noise);
            let again = weigh(&series, banks.own(self, request), self.floor(), &mut scratch)?;
            evidence = again;
        }
        evidence = refine(&series, pattern, self.history.times(), self.nuisance, evidence, step);
        Some(Seen { at: seen.at, place, evidence, series })
    }

    /// Where the light is strongest near a place: on whole pixels, where nothing is interpolated, the
    /// logarithms of a Gaussian blob and of its neighbours are a parabola.
    fn peak(&self, start: Point2<f64>, expected: &[f32], raw: &mut Vec<f32>) -> Point2<f64> {
        let far = |n: usize| n - 1 - MARGIN;
        let mut at = |x: usize, y: usize| {
            self.history.series_at((x, y), raw);
            f64::from(dot(expected, raw))
        };
        let (mut x, mut y) = (start.x.round() as usize, start.y.round() as usize);
        for _ in 0..3 {
            (x, y) = (x.clamp(MARGIN, far(self.size.0)), y.clamp(MARGIN, far(self.size.1)));
            let around = [(x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
            let best = around.map(|(u, v)| (at(u, v), (u, v)));
            let top = best.iter().fold(best[0], |a, b| if b.0 > a.0 { *b } else { a });
            if top.1 == (x, y) {
                // The box that the filter subtracts takes the same from all five.
                let level = |k: usize| (best[k].0 + BOX_SHARE * best[0].0).max(1e-9).ln();
                let offset = |before: usize, after: usize| {
                    let curvature = level(before) - 2.0 * level(0) + level(after);
                    let slope = level(before) - level(after);
                    if curvature < -1e-9 { (0.5 * slope / curvature).clamp(-0.6, 0.6) } else { 0.0 }
                };
                return Point2::new(x as f64 + offset(1, 2), y as f64 + offset(3, 4));
            }
            (x, y) = top.1;
        }
        Point2::new(x as f64, y as f64)
    }

    /// Presence, quality of the fit, margins.
    fn stands(&self, request: usize, seen: &Seen, banks: &mut Banks) -> bool {
        let (own, series) = (seen.evidence, &seen.series);
        if own.log_ratio < self.presence() || !self.stands_if_restless(request, seen) {
            return false;
        }
        let rest = unexplained(series, &own) - NOISE_SLACK * series.freedom * series.noise;
        if rest > MISFIT * own.correlation * own.correlation {
            return false;
        }
        if self.is_another_code(request, seen) {
            return false;
        }
        let series = &series.settled(&own);
        let mut scratch = Vec::new();
        let others = self.requests.len() - 1;
        for other in (0..self.requests.len()).filter(|o| *o != request) {
            let limit = own.log_ratio - self.margin(others);
            let bank = banks.own(self, other);
            let Some(rival) = weigh(series, bank, 0.0, &mut scratch) else { continue };
            // A strong light tells phases apart that the bank does not have.
            let pattern = &self.requests[other].pattern;
            let times = self.history.times();
            let gain = refined_gain(series, pattern, times, self.nuisance, rival, bank.step);
            if rival.log_ratio + gain > limit {
                return false;
            }
        }
        let Some(rate) = self.config.foreign_rate else { return true };
        let bank = banks.foreign(self, request, rate);
        let limit = own.log_ratio - self.margin(bank.hypotheses.len());
        let foreign = weigh(series, bank, limit, &mut scratch);
        foreign.is_none_or(|evidence| evidence.log_ratio <= limit)
    }

    /// Whether some other code of the same length and chip would fit much better: any such code lies in
    /// the span of the lines of its period.
    fn is_another_code(&self, request: usize, seen: &Seen) -> bool {
        let (own, series) = (&seen.evidence, &seen.series);
        let pattern = &self.requests[request].pattern;
        let lines = every_line(pattern, self.history.times(), |line| {
            series.clear(self.nuisance, line);
        });
        let free = series.freedom - lines.len() as f64;
        let any: f64 = lines.iter().map(|l| f64::from(dot(l, &series.values)).powi(2)).sum();
        let explained = own.correlation * own.correlation;
        // The noise is what even the freest code leaves, as far as that can be told.
        let rest = (series.energy - any).max(0.0);
        let noise = if free > FREE { rest / free } else { NOISE_SLACK * series.noise };
        let chance = (lines.len() as f64 - 1.0).max(1.0);
        let better = any - explained - chance * noise;
        better > (MISFIT * explained).max(CHANCE * (2.0 * chance).sqrt() * noise)
    }

    fn sighting(&self, request: usize, seen: &Seen) -> Sighting {
        let (evidence, series) = (&seen.evidence, &seen.series);
        // The larger of the noise around and of what this place leaves unexplained.
        let noise = series.noise.max(unexplained(series, evidence) / series.freedom);
        let snr = evidence.correlation / noise.sqrt();
        let (place, covariance) = self.centre(request, seen, noise);
        let period = self.requests[request].pattern.period().as_secs_f64();
        let last = self.history.times().last().map_or(0.0, |t| t.0);
        Sighting {
            pixel: self.shown(place),
            covariance: covariance + Matrix2::identity() * (FLOOR_PX * FLOOR_PX),
            amplitude: evidence.amplitude(),
            snr,
            phase: (evidence.best.phase + evidence.best.rate * last).rem_euclid(period),
            decided_at: self.stamp,
            frames: self.frames,
        }
    }

    /// The centre of the light and its covariance, by a fit of the spot; `noise` is that of the place.
    fn centre(&self, request: usize, seen: &Seen, noise: f64) -> (Point2<f64>, Matrix2<f64>) {
        let (x, y) = (seen.place.x.round(), seen.place.y.round());
        let mut expected = Vec::new();
        let pattern = &self.requests[request].pattern;
        let best = (seen.evidence.best.phase, seen.evidence.best.rate);
        seen.series.expect(pattern, self.history.times(), best, self.nuisance, &mut expected);
        let length = seen.evidence.best.norm2.sqrt();
        let mut raw = Vec::new();
        let patch: [f64; spot::PIXELS] = std::array::from_fn(|k| {
            let side = 2 * spot::HALF as usize + 1;
            let at = |c: f64, k: usize| (c as usize + k).saturating_sub(spot::HALF as usize);
            self.history.series_at((at(x, k % side), at(y, k / side)), &mut raw);
            f64::from(dot(&expected, &raw)) / length
        });
        // Noise of the fit is that of pixels; the place between pixels has less.
        let noise = noise / noise_share(seen.place);
        let start = Vector2::new(seen.place.x - x, seen.place.y - y);
        match spot::fit(&patch, start) {
            Some(spot) => (Point2::new(x, y) + spot.offset, spot.covariance * noise),
            // Cramer-Rao: the slope of the matched filter's output against its curvature.
            None => {
                let snr2 = seen.evidence.correlation.powi(2) / noise;
                (seen.place, Matrix2::identity() * (BLOB_VARIANCE / snr2))
            }
        }
    }

    /// A place of the first frame in the mean picture of the window.
    fn shown(&self, place: Point2<f64>) -> Point2<f64> {
        let (dx, dy) = self.history.mean_shift();
        Point2::new(place.x + dx, place.y + dy)
    }
}
