//! From evidence to decisions.
//!
//! A request is "here" when at some place all of these hold, each a module:
//! - [`presence`]: no noise explains what is seen, anywhere in the picture, at any time;
//! - [`identity`]: no other requested pattern does;
//! - [`foreign`]: no light that nobody asked for does;
//! - the light has changed often enough that no single event looks like it.
//!
//! All are likelihood ratios, and all thresholds are `ln(alternatives / alpha)` by Ville's inequality.
//! [`position`] measures where the light is, [`absence`] says when it would have been found.

mod absence;
mod banks;
mod codes;
mod foreign;
pub mod identity;
mod position;
pub mod presence;

use std::time::Duration;

use nalgebra::Point2;

use super::Config;
use super::evidence::{Evidence, Series, weigh};
use super::history::History;
use super::nuisance::Nuisance;
use super::places::{Place, Watch};
use super::scan::BlockNoise;
use super::surroundings::intruders;
use super::template::transitions;
use crate::{Decision, Request, Sighting};
pub use banks::Banks;

/// Changes of the light that must have been seen: one more than a passing thing and its shadow make.
const TRANSITIONS: f64 = 5.0;

/// Factor on the noise of the neighbourhood before anything counts as unexplained.
const NOISE_SLACK: f64 = 1.5;

/// Places of one pattern that are reported at most.
const MOST_PLACES: usize = 8;

/// Distance (px) within which two sightings are one light.
const ONE_LIGHT: f64 = 5.0;

/// Distance (px) up to which filter and JPEG blocks leave ghosts of a light, and their share of it.
const GHOST: (f64, f64) = (16.0, 0.3);

/// Share of the presence threshold from which a pixel is looked at closer: the rest may be lost
/// between pixels.
const CLOSER: f64 = 0.5;

/// A place of whose changes a request explains this share is likely to play it: a foreign code that
/// resembles it shows less.
const LIKELY: f64 = 0.8;

/// A place that passes every test waits for a brighter one that is likely to play the request this share of
/// the frames so far: of a light and its reflection the dim one is as often decided first.
const PATIENCE: f64 = 0.5;

/// Requests that are weighed at one frame where nothing is near.
const AT_ONCE: usize = 8;

/// Frames within which every request has its turn.
pub fn turns(requests: usize) -> usize {
    requests.div_ceil(AT_ONCE)
}

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

impl Round<'_> {
    /// Log likelihood ratio from which a pixel is looked at closer.
    fn floor(&self) -> f64 {
        CLOSER * self.presence()
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
                self.sightings(request, seen, &decisions[request], places, banks)
            } else {
                Vec::new()
            };
            self.conclude(sightings, &mut decisions[request]);
        }
    }

    /// Weighs every watch that is due; whether any reached the floor, for every request. Request by
    /// request, as a bank fits the cache and all banks together do not. Requests take turns where they
    /// are many; what falls due before the next turn is weighed early, and what is near at every frame.
    fn weigh_due(&self, places: &mut [Place], banks: &mut Banks, thorough: bool) -> Vec<bool> {
        let turns = turns(self.requests.len());
        let is_due = |w: &Watch| {
            let turn = w.request % turns == self.frames % turns && w.due < self.frames + turns;
            thorough || turn || (w.level >= self.floor() && w.due <= self.frames)
        };
        let (mut raw, mut scratch) = (Vec::new(), Vec::new());
        let mut due = Vec::new();
        for (p, place) in places.iter().enumerate() {
            if place.watches.iter().any(is_due) {
                self.history.series_at(place.pixel, &mut raw);
                due.push((p, self.series_of(place.pixel, &raw)));
            }
        }
        let mut near = vec![false; self.requests.len()];
        for (request, near) in near.iter_mut().enumerate() {
            for (p, series) in &due {
                let own = |w: &&mut Watch| w.request == request && is_due(w);
                let Some(watch) = places[*p].watches.iter_mut().find(own) else { continue };
                let bank = banks.own(self, request);
                let evidence = weigh(series, bank, self.floor(), &mut scratch);
                watch.level = evidence.map_or(0.0, |e| e.log_ratio);
                watch.due = self.due(watch.level, self.floor(), self.frames / 4);
                *near |= watch.level >= self.floor();
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

    /// The places of one request that pass every test, or did before, brightest first.
    fn sightings(
        &self,
        request: usize,
        mut seen: Vec<Seen>,
        before: &Decision,
        places: &mut [Place],
        banks: &mut Banks,
    ) -> Vec<Sighting> {
        let before = if let Decision::Here(before) = before { before.as_slice() } else { &[] };
        if transitions(&self.requests[request].pattern, self.history.times()) < TRANSITIONS {
            return Vec::new();
        }
        seen.sort_by(|a, b| b.evidence.correlation.total_cmp(&a.evidence.correlation));
        let mut kept: Vec<Sighting> = Vec::new();
        let mut brighter = false;
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
            // Ville's bound is that of the first time; no need to pass again.
            let decided = before.iter().any(|s| (s.pixel - pixel).norm() < ONE_LIGHT);
            if kept.iter().any(ghost) {
                continue;
            }
            if !decided {
                if !self.stands(request, &sharp, banks) {
                    let explained = sharp.evidence.correlation.powi(2);
                    brighter |= explained > LIKELY * sharp.series.energy;
                    continue;
                }
                let since = *places[p].watches[w].stood.get_or_insert(self.frames);
                if brighter && ((self.frames - since) as f64) < PATIENCE * since as f64 {
                    continue;
                }
            }
            kept.push(self.sighting(request, &sharp));
        }
        kept.sort_by(|a, b| b.amplitude.total_cmp(&a.amplitude));
        kept
    }

    /// Whether noise, the other requests and whatever else may blink are beaten.
    fn stands(&self, request: usize, seen: &Seen, banks: &mut Banks) -> bool {
        // A light too bright for the picture runs chips together, and parts of codes are alike then: where
        // others are requested, all of it must have been seen.
        let period = self.requests[request].pattern.period().as_secs_f64();
        let whole = self.requests.len() == 1 || self.history.span() >= period;
        (seen.evidence.best.excess == 1.0 || whole)
            && self.is_present(request, seen)
            && self.leads_requests(request, seen, banks)
            && self.leads_foreign(request, seen)
    }
}
