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

use std::collections::HashMap;
use std::time::Duration;

use nalgebra::{Matrix2, Point2};

use super::Config;
use super::evidence::{Evidence, Series, refine, unexplained, weigh};
use super::front::{BLOB_VARIANCE, BOX_SHARE};
use super::history::{History, noise_share};
use super::nuisance::{Nuisance, dot};
use super::scan::{BlockNoise, Candidate, MARGIN};
use super::surroundings::intruders;
use super::template::{Bank, transitions};
use crate::{Decision, Request, Sighting};

/// Changes of the light that must have been seen: one more than a passing thing and its shadow make.
const TRANSITIONS: f64 = 5.0;

/// Share of the explained energy that may stay unexplained beyond the noise.
const MISFIT: f64 = 0.35;

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

/// Everything that the decisions of one moment rest on.
pub struct Round<'a> {
    pub requests: &'a [Request],
    pub config: &'a Config,
    pub history: &'a History,
    pub noise: &'a BlockNoise,
    pub nuisance: &'a Nuisance,
    pub times: Vec<(f64, f64)>,
    pub frames: usize,
    pub stamp: Duration,
    pub size: (usize, usize),
}

/// A place with the evidence for one request.
struct Seen {
    place: Point2<f64>,
    evidence: Evidence,
    series: Series,
}

/// Banks of the requests, built when first needed.
struct Banks<'a> {
    round: &'a Round<'a>,
    banks: HashMap<usize, Bank>,
    foreign: HashMap<usize, Bank>,
}

impl<'a> Banks<'a> {
    fn get(&mut self, request: usize) -> &Bank {
        let round = self.round;
        self.banks.entry(request).or_insert_with(|| {
            let r = &round.requests[request];
            Bank::new(&r.pattern, r.clock_tolerance, &round.times, round.nuisance)
        })
    }

    fn foreign(&mut self, request: usize, rate: f64) -> &Bank {
        let round = self.round;
        self.foreign.entry(request).or_insert_with(|| {
            let r = &round.requests[request];
            let gap = rate + r.clock_tolerance;
            let rates: Vec<f64> =
                FOREIGN.iter().flat_map(|k| [1.0 / (1.0 + k * gap), 1.0 + k * gap]).collect();
            Bank::with_rates(&r.pattern, &rates, &round.times, round.nuisance)
        })
    }
}

impl Round<'_> {
    /// Log likelihood ratio that presence needs.
    fn presence(&self) -> f64 {
        // Places that are independent under the blur of a light: area over 4 pi s^2.
        let cells =
            (self.size.0 * self.size.1) as f64 / (2.0 * std::f64::consts::PI * BLOB_VARIANCE);
        (cells * self.requests.len() as f64 / self.config.false_alarm).ln()
    }

    /// Log likelihood ratio from which a pixel is looked at closer: half of it may be lost between
    /// pixels.
    fn floor(&self) -> f64 {
        0.5 * self.presence()
    }

    /// Log likelihood ratio by which another explanation must be beaten.
    fn margin(&self, others: usize) -> f64 {
        (others.max(1) as f64 / self.config.wrong_identity).ln()
    }

    /// Brings the decisions up to date.
    pub fn decide(&self, candidates: &[Candidate], decisions: &mut [Decision]) {
        let mut banks = Banks { round: self, banks: HashMap::new(), foreign: HashMap::new() };
        let mut found: Vec<Vec<Seen>> = self.requests.iter().map(|_| Vec::new()).collect();
        let (mut raw, mut scratch) = (Vec::new(), Vec::new());
        for candidate in candidates {
            let (x, y) = candidate.pixel;
            let place = Point2::new(x as f64, y as f64);
            self.history.series_at(candidate.pixel, &mut raw);
            let series = self.series_of(candidate, &raw);
            let range = candidate.request.map_or(0..self.requests.len(), |r| r..r + 1);
            for request in range {
                let floor = self.floor();
                let bank = banks.get(request);
                let Some(evidence) = weigh(&series, bank, floor, &mut scratch) else { continue };
                if evidence.log_ratio >= floor {
                    found[request].push(Seen { place, evidence, series: series.clone() });
                }
            }
        }
        for (request, seen) in found.into_iter().enumerate() {
            let sightings = self.sightings(request, seen, &mut banks);
            self.conclude(request, sightings, &mut decisions[request]);
        }
    }

    /// The series of a candidate; where it varies beyond the noise, what leaks in is taken out.
    fn series_of(&self, candidate: &Candidate, raw: &[f32]) -> Series {
        let noise = self.noise.at(candidate.pixel.0, candidate.pixel.1);
        let plain = Series::new(raw, self.nuisance, Vec::new(), noise);
        if plain.energy < NOISE_SLACK * noise * plain.freedom {
            return plain;
        }
        let local = intruders(self.history, candidate.pixel, raw, self.nuisance, noise);
        if local.is_empty() { plain } else { Series::new(raw, self.nuisance, local, noise) }
    }

    /// Sets one decision from the sightings of this round.
    fn conclude(&self, request: usize, mut sightings: Vec<Sighting>, decision: &mut Decision) {
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
        } else if self.would_have_seen(request) {
            *decision = Decision::Absent;
        }
    }

    /// Whether a tag of the least contrast would have been found by now.
    fn would_have_seen(&self, request: usize) -> bool {
        let pattern = &self.requests[request].pattern;
        let duty = f64::from(pattern.bits.weight()) / pattern.bits.len() as f64;
        let light = self.times.len() as f64 * duty * (1.0 - duty);
        let evidence = self.config.least_contrast.powi(2) * light / (2.0 * self.noise.median());
        let changes = transitions(pattern, &self.times);
        evidence > 2.0 * self.presence() + 10.0 && changes > 2.0 * TRANSITIONS
    }

    /// The places of one request that pass every test, brightest first.
    fn sightings(&self, request: usize, mut seen: Vec<Seen>, banks: &mut Banks) -> Vec<Sighting> {
        if transitions(&self.requests[request].pattern, &self.times) < TRANSITIONS {
            return Vec::new();
        }
        seen.sort_by(|a, b| b.evidence.correlation.total_cmp(&a.evidence.correlation));
        let mut kept: Vec<Sighting> = Vec::new();
        for candidate in seen {
            if kept.len() == MOST_PLACES {
                break;
            }
            let Some(sharp) = self.sharpen(request, candidate, banks) else { continue };
            let pixel = self.shown(sharp.place);
            let ghost = |s: &Sighting| {
                let distance = (s.pixel - pixel).norm();
                distance < ONE_LIGHT
                    || (distance < GHOST.0 && sharp.evidence.amplitude() < GHOST.1 * s.amplitude)
            };
            if kept.iter().any(ghost) || !self.stands(request, &sharp, banks) {
                continue;
            }
            kept.push(self.sighting(request, &sharp, pixel));
        }
        kept.sort_by(|a, b| b.amplitude.total_cmp(&a.amplitude));
        kept
    }

    /// Moves a place to the sub-pixel maximum of its light, and weighs it again there.
    fn sharpen(&self, request: usize, seen: Seen, banks: &mut Banks) -> Option<Seen> {
        let pattern = &self.requests[request].pattern;
        let step = banks.get(request).step;
        let (mut place, mut evidence, mut series) = (seen.place, seen.evidence, seen.series);
        let (mut raw, mut expected, mut scratch) = (Vec::new(), Vec::new(), Vec::new());
        if series.local.is_empty() {
            let pixel = (place.x as usize, place.y as usize);
            self.history.series_at(pixel, &mut raw);
            let local = intruders(self.history, pixel, &raw, self.nuisance, series.noise);
            if !local.is_empty() {
                series = Series::new(&raw, self.nuisance, local, series.noise);
                evidence = weigh(&series, banks.get(request), self.floor(), &mut scratch)?;
            }
        }
        for _ in 0..2 {
            evidence = refine(&series, pattern, &self.times, self.nuisance, evidence, step);
            let best = (evidence.best.phase, evidence.best.rate);
            series.expect(pattern, &self.times, best, self.nuisance, &mut expected);
            let moved = self.peak(place, &expected, &mut raw);
            let (dx, dy) = (moved.x - seen.place.x, moved.y - seen.place.y);
            if dx.abs().max(dy.abs()) > 2.0 {
                return None;
            }
            place = moved;
            self.history.series(place, &mut raw);
            let noise = self.noise.at(place.x as usize, place.y as usize) * noise_share(place);
            series = Series::new(&raw, self.nuisance, series.local, noise);
            let again = weigh(&series, banks.get(request), self.floor(), &mut scratch)?;
            evidence = again;
        }
        evidence = refine(&series, pattern, &self.times, self.nuisance, evidence, step);
        Some(Seen { place, evidence, series })
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
        if own.log_ratio < self.presence() {
            return false;
        }
        let rest = unexplained(series, &own) - NOISE_SLACK * series.freedom * series.noise;
        if rest > MISFIT * own.correlation * own.correlation {
            return false;
        }
        let mut scratch = Vec::new();
        let others = self.requests.len() - 1;
        for other in (0..self.requests.len()).filter(|o| *o != request) {
            let limit = own.log_ratio - self.margin(others);
            match weigh(series, banks.get(other), limit, &mut scratch) {
                Some(evidence) if evidence.log_ratio > limit => return false,
                _ => {}
            }
        }
        let Some(rate) = self.config.foreign_rate else { return true };
        let bank = banks.foreign(request, rate);
        let limit = own.log_ratio - self.margin(bank.hypotheses.len());
        let foreign = weigh(series, bank, limit, &mut scratch);
        foreign.is_none_or(|evidence| evidence.log_ratio <= limit)
    }

    fn sighting(&self, request: usize, seen: &Seen, pixel: Point2<f64>) -> Sighting {
        let (evidence, series) = (&seen.evidence, &seen.series);
        // The larger of the noise around and of what this place leaves unexplained.
        let noise = series.noise.max(unexplained(series, evidence) / series.freedom);
        let snr = evidence.correlation / noise.sqrt();
        // Cramer-Rao: the slope of the matched filter's output against its curvature at the peak.
        let variance = BLOB_VARIANCE / (snr * snr) + FLOOR_PX * FLOOR_PX;
        let period = self.requests[request].pattern.period().as_secs_f64();
        let last = self.times.last().map_or(0.0, |t| t.0);
        Sighting {
            pixel,
            covariance: Matrix2::identity() * variance,
            amplitude: evidence.amplitude(),
            snr,
            phase: (evidence.best.phase + evidence.best.rate * last).rem_euclid(period),
            decided_at: self.stamp,
            frames: self.frames,
        }
    }

    /// A place of the first frame in the mean picture of the window.
    fn shown(&self, place: Point2<f64>) -> Point2<f64> {
        let (dx, dy) = self.history.mean_shift();
        Point2::new(place.x + dx, place.y + dy)
    }
}
