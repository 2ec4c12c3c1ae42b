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
//!    pattern and over look-alikes at other rates, quality of the fit; absence when a tag of the least
//!    contrast would have been found.
//!
//! A rolling shutter needs no row time: phase is free at every place, and a place lies on one row.
//! Memory is a window of frames of constant length. The mathematics is that of `docs/landmark.md`.

pub mod evidence;
pub mod front;
pub mod history;
pub mod motion;
pub mod nuisance;
pub mod scan;
pub mod shift;
pub mod surroundings;
pub mod template;
mod verdict;

use std::time::Duration;

use vergence_imaging::{Frame, Image};
use vergence_tag::Pattern;

use crate::finder::{Sequence, check_requests};
use crate::{Decision, Finder, FinderError, Request};
use front::Variation;
use history::{History, Past};
use motion::{Placement, Reference};
use nuisance::{Nuisance, STILL_PX};
use scan::{BlockNoise, Candidate};
use verdict::Round;

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
    /// Blinkers whose clock differs by this much (relative) and more are told from the tag. It costs
    /// the time in which that difference shows; `None` where nothing foreign can blink a code.
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

/// First frame count at which the picture is scanned for weak lights.
const FIRST_SCAN: usize = 16;

/// The sequential method as a [`Finder`].
#[derive(Debug, Clone)]
pub struct SequentialFinder {
    requests: Vec<Request>,
    config: Config,
    sequence: Sequence,
    reference: Reference,
    variation: Option<Variation>,
    history: History,
    noise: BlockNoise,
    weak: Vec<Candidate>,
    decisions: Vec<Decision>,
    frames: usize,
    next_round: usize,
    next_scan: usize,
    size: (usize, usize),
}

impl SequentialFinder {
    /// A finder for these requests.
    pub fn new(requests: Vec<Request>, config: Config) -> Result<Self, FinderError> {
        check_requests(&requests)?;
        Ok(SequentialFinder {
            decisions: vec![Decision::Undecided; requests.len()],
            requests,
            sequence: Sequence::default(),
            reference: Reference::default(),
            variation: None,
            history: History::new(config.window_frames.max(FIRST_SCAN)),
            noise: BlockNoise::default(),
            weak: Vec::new(),
            frames: 0,
            next_round: FIRST_FRAMES,
            next_scan: FIRST_SCAN,
            size: (0, 0),
            config,
        })
    }

    /// Frames seen so far.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Weighs the evidence of the window, after a scan of the whole picture where that is due.
    fn round(&mut self, scan: bool, stamp: Duration) {
        let Some(variation) = &self.variation else { return };
        let ((width, height), n) = (self.size, self.history.len());
        let energy = variation.energy();
        if scan || self.noise.is_empty() || self.frames <= FIRST_SCAN {
            self.noise = BlockNoise::new(energy, width, height, n);
        }
        let nuisance = Nuisance::of(&self.history);
        if scan {
            let patterns: Vec<Option<&Pattern>> =
                self.requests.iter().map(|r| Some(&r.pattern)).collect();
            self.weak = scan::by_lines(
                &self.history,
                energy,
                width,
                height,
                &self.noise,
                &nuisance,
                &patterns,
            );
        }
        let mut candidates = scan::by_energy(energy, width, height, n, &self.noise);
        candidates.extend(&self.weak);
        let round = Round {
            requests: &self.requests,
            config: &self.config,
            history: &self.history,
            noise: &self.noise,
            nuisance: &nuisance,
            times: self.history.times(),
            frames: self.frames,
            stamp,
            size: self.size,
        };
        round.decide(&candidates, &mut self.decisions);
    }
}

/// The filtered frame, moved back to where the first frame lay.
fn still(filtered: Image<i16>, placement: &Placement) -> Image<i16> {
    if placement.dx.hypot(placement.dy) < STILL_PX {
        return filtered;
    }
    shift::shifted(&filtered, placement.dx, placement.dy).map(|v| v.round() as i16)
}

impl Finder for SequentialFinder {
    fn push(&mut self, frame: &Frame) -> Result<(), FinderError> {
        let time = self.sequence.accept(frame)?;
        self.size = (frame.image.width(), frame.image.height());
        let placement = self.reference.place(&frame.image);
        let filtered = still(front::filter(&frame.image), &placement);
        let pixels = self.size.0 * self.size.1;
        let window = self.config.window_frames;
        let variation = self.variation.get_or_insert_with(|| Variation::new(pixels, window));
        variation.push(filtered.data());
        let exposure = frame.exposure.as_secs_f64();
        self.history.push(Past { time, exposure, placement, filtered });
        self.frames += 1;
        if self.frames >= self.next_round {
            let scan = self.frames >= self.next_scan;
            self.round(scan, frame.stamp);
            self.next_round = self.frames + (self.frames / 16).max(1);
            if scan {
                self.next_scan = self.frames + (self.frames.min(window) / 5).max(8);
            }
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
