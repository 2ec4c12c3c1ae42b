//! Soft evidence, weighed frame by frame, with a stated rate of false alarms.
//!
//! In: frames with time stamps and exposure. Out: for every request "here" with all places, "absent"
//! or "not yet", after every frame. The method:
//! 1. [`motion`]: registration of the background against the first frames; gain of every row;
//! 2. [`front`]: a small matched filter on every frame, running mean and variance of its output;
//! 3. [`scan`]: the pixels that vary more than their neighbours, then the lines of each pattern's
//!    spectrum, choose a few places;
//! 4. [`template`], [`nuisance`]: the light that a pattern would give, averaged over each exposure at
//!    its time stamp, for all phases and clock rates; drift, motion and lamps projected out of both
//!    sides;
//! 5. [`evidence`]: a likelihood ratio with amplitude, phase and noise averaged over;
//! 6. [`verdict`]: presence by Ville's bound over the whole picture, margin over every other requested
//!    pattern and over lights that nobody asked for; absence when a tag of the least contrast would
//!    have been found.
//!
//! A rolling shutter needs no row time: phase is free at every place, and a place lies on one row.
//! Memory is a window of frames of constant length. The mathematics is that of `docs/landmark.md`.

pub mod evidence;
pub mod explain;
pub mod front;
pub mod history;
mod median;
pub mod motion;
pub mod nuisance;
pub mod places;
pub mod scan;
pub mod shift;
pub mod spot;
pub mod surroundings;
pub mod template;
mod verdict;

use std::time::Duration;

use nalgebra::Point2;
use vergence_imaging::{Frame, Image};
use vergence_tag::Pattern;

use crate::finder::{Sequence, check_requests};
use crate::{Decision, Finder, FinderError, Request};
use front::Variation;
use history::{History, Past};
use motion::{Placement, Reference};
use nuisance::{Lamps, Nuisance, STILL_PX};
use places::Places;
use scan::{BlockNoise, Family, Strong, Sweep, View};
use verdict::{Banks, Round};

/// Settings of the sequential finder.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Frames that are remembered; evidence older than this is forgotten. Two bytes a pixel each.
    pub window_frames: usize,
    /// Chance that any request is ever reported in a picture without its tag.
    pub false_alarm: f64,
    /// Chance that a tag is reported under the name of another requested one.
    pub wrong_identity: f64,
    /// A tag of this contrast (grey levels) would have been found before "absent" is said.
    pub least_contrast: f64,
    /// A foreign light that plays a requested pattern is told from the tag when its clock differs by
    /// this much (relative) and more. `None` where nothing blinks but what is requested: decisions need
    /// fewer frames then.
    pub foreign_rate: Option<f64>,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            window_frames: 192,
            false_alarm: 1e-3,
            wrong_identity: 1e-3,
            least_contrast: 3.0,
            foreign_rate: Some(0.04),
        }
    }
}

/// First frame count at which evidence is weighed.
const FIRST_FRAMES: usize = 6;

/// First frame count at which the picture has been scanned for weak lights.
const FIRST_SCAN: usize = 16;

/// How often (frames) places that vary strongly are added to the short list after the first frames.
const STRONG_EVERY: usize = 4;

/// Share of the presence threshold from which a place stays on the short list whatever a scan says.
const KEEP: f64 = 0.4;

/// The sequential method as a [`Finder`].
#[derive(Debug, Clone)]
pub struct SequentialFinder {
    requests: Vec<Request>,
    config: Config,
    /// Requests whose patterns share length and chip.
    families: Vec<Vec<usize>>,
    sequence: Sequence,
    reference: Reference,
    variation: Option<Variation>,
    history: History,
    /// Memory for the next filtered picture.
    spare: Option<Image<i16>>,
    noise: BlockNoise,
    lamps: Lamps,
    places: Places,
    /// Places that varied more than the noise explains when last looked.
    restless: Vec<Point2<f64>>,
    banks: Banks,
    decisions: Vec<Decision>,
    frames: usize,
    /// The scan that is under way.
    sweep: Option<Sweep>,
    /// Frame count at which the next scan is to be complete.
    next_scan: usize,
    size: (usize, usize),
}

impl SequentialFinder {
    /// Takes the memory for pictures of so many columns and rows, which takes as long as many frames do;
    /// otherwise the first frame does. Fails when it is too much.
    pub fn prepare(&mut self, size: (usize, usize)) -> Result<(), FinderError> {
        self.history.prepare(size)
    }

    /// A finder for these requests.
    pub fn new(requests: Vec<Request>, config: Config) -> Result<Self, FinderError> {
        check_requests(&requests)?;
        Ok(SequentialFinder {
            decisions: vec![Decision::Undecided; requests.len()],
            families: families(&requests),
            banks: Banks::new(requests.len()),
            requests,
            sequence: Sequence::default(),
            reference: Reference::default(),
            variation: None,
            history: History::new(config.window_frames.max(FIRST_SCAN)),
            spare: None,
            noise: BlockNoise::default(),
            lamps: Lamps::default(),
            places: Places::default(),
            restless: Vec::new(),
            frames: 0,
            sweep: None,
            next_scan: FIRST_SCAN,
            size: (0, 0),
            config,
        })
    }

    /// Frames seen so far.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Looks at the places that are due, after the next step of a scan where one is due or under way.
    fn round(&mut self, last: bool, stamp: Duration) {
        let Some(variation) = &self.variation else { return };
        let ((width, height), n) = (self.size, self.history.len());
        let (energy, presence) = (variation.energy(), self.presence());
        // A scan under way would not see the last frames everywhere.
        let steps = if last { 1 } else { Sweep::frames(self.size, n) };
        let begins = last || (self.sweep.is_none() && self.frames + steps > self.next_scan);
        if begins || self.frames <= FIRST_SCAN {
            self.noise = BlockNoise::new(energy, width, height, n);
        }
        if begins {
            self.lamps = Lamps::of(&self.history);
            self.sweep = Some(Sweep::new(height, self.families.iter().map(Vec::len)));
        }
        let nuisance = Nuisance::of(&self.history, &self.lamps);
        let candidates = match &mut self.sweep {
            Some(sweep) => {
                let families = lines(&self.requests, &self.families, &self.history, &nuisance);
                let view = View {
                    history: &self.history,
                    size: self.size,
                    energy,
                    noise: &self.noise,
                    nuisance: &nuisance,
                    presence,
                };
                sweep.step(&view, &families, steps)
            }
            None => None,
        };
        let scanned = candidates.is_some();
        if let Some(candidates) = candidates {
            self.sweep = None;
            self.places.renew(candidates, KEEP * presence);
            // A third more evidence; a full window gains none, it only forgets.
            let longest = self.config.window_frames / 2;
            self.next_scan = self.frames + (self.frames / 3).clamp(FIRST_SCAN / 2, longest);
        }
        if scanned || self.frames <= FIRST_SCAN || self.frames.is_multiple_of(STRONG_EVERY) {
            let strong = scan::by_energy(energy, width, height, n, &self.noise);
            let point = |s: &Strong| Point2::new(s.pixel.0 as f64, s.pixel.1 as f64);
            self.restless = strong.iter().filter(|s| s.restless).map(point).collect();
            for Strong { pixel, .. } in strong.into_iter().take(scan::BY_ENERGY) {
                self.places.add(pixel, 0..self.requests.len());
            }
        }
        let before_next_turn = self.frames + verdict::turns(self.requests.len()) - 1;
        if !scanned && !self.places.any_due(before_next_turn) {
            return;
        }
        let known =
            self.decisions.iter().filter_map(Decision::brightest).map(|s| s.pixel).collect();
        let round = Round {
            requests: &self.requests,
            config: &self.config,
            history: &self.history,
            noise: &self.noise,
            nuisance: &nuisance,
            frames: self.frames,
            stamp,
            size: self.size,
            restless: &self.restless,
            known,
        };
        let places = self.places.as_mut_slice();
        round.decide(places, &mut self.banks, last, &mut self.decisions);
        if scanned {
            round.rule_out(&mut self.decisions);
        }
    }

    /// Log likelihood ratio that presence needs.
    fn presence(&self) -> f64 {
        verdict::presence::presence(self.size, self.requests.len(), self.config.false_alarm)
    }
}

/// The lines of the spectra of every family over the window.
fn lines(
    requests: &[Request],
    families: &[Vec<usize>],
    history: &History,
    nuisance: &Nuisance,
) -> Vec<Family> {
    let family = |kin: &Vec<usize>| {
        let patterns: Vec<&Pattern> = kin.iter().map(|r| &requests[*r].pattern).collect();
        Family {
            requests: kin.clone(),
            lines: template::lines(&patterns, history.times(), nuisance),
        }
    };
    families.iter().map(family).collect()
}

/// Requests grouped by length and chip of their patterns.
fn families(requests: &[Request]) -> Vec<Vec<usize>> {
    let mut families: Vec<Vec<usize>> = Vec::new();
    for (k, request) in requests.iter().enumerate() {
        let kin = |r: usize| {
            let other = &requests[r].pattern;
            other.chip == request.pattern.chip && other.bits.len() == request.pattern.bits.len()
        };
        match families.iter_mut().find(|f| kin(f[0])) {
            Some(family) => family.push(k),
            None => families.push(vec![k]),
        }
    }
    families
}

/// Registers and filters a frame.
fn past(
    reference: &mut Reference,
    frame: &Frame,
    time: f64,
    reuse: Option<Image<i16>>,
) -> (Past, Image<i16>) {
    let mut placement = reference.place(&frame.image);
    placement.row_gain = nuisance::smoothed(&placement.row_gain);
    let filtered = still(front::filter(&frame.image, reuse), &placement);
    (Past { time, exposure: frame.exposure.as_secs_f64(), placement }, filtered)
}

/// The filtered frame, moved back to where the first frame lay.
fn still(filtered: Image<i16>, placement: &Placement) -> Image<i16> {
    if placement.dx.hypot(placement.dy) < STILL_PX {
        return filtered;
    }
    let mut moved = Image::filled(filtered.width(), filtered.height(), 0);
    shift::shift_rows(&filtered, placement.dx, placement.dy, |y, row| {
        shift::round(moved.row_mut(y), row);
    });
    moved
}

impl Finder for SequentialFinder {
    fn push(&mut self, frame: &Frame) -> Result<(), FinderError> {
        let time = self.sequence.accept(frame)?;
        self.size = (frame.image.width(), frame.image.height());
        self.history.prepare(self.size)?;
        let (past, filtered) = past(&mut self.reference, frame, time, self.spare.take());
        let pixels = self.size.0 * self.size.1;
        let window = self.config.window_frames;
        let variation = self.variation.get_or_insert_with(|| Variation::new(pixels, window));
        variation.push(filtered.data());
        self.history.push(past, &filtered)?;
        self.spare = Some(filtered);
        self.frames += 1;
        if self.frames >= FIRST_FRAMES {
            self.round(false, frame.stamp);
        }
        Ok(())
    }

    fn finish(&mut self) {
        let last = self.sequence.last_stamp();
        if let (Some(stamp), true) = (last, self.frames >= FIRST_FRAMES) {
            self.round(true, stamp);
        }
    }

    fn decisions(&self) -> &[Decision] {
        &self.decisions
    }
}
