//! `vergence blink --bound`: how far the sequential finder is from what is possible, by simulation.
//!
//! Two tables: frames to a confirmed identity among 16 codes against Wald's bound, and false reports
//! over hours of tag-free video. Small pictures (tiles) are simulated; the false-alarm rate that a
//! tile is given is its share of a 640x480 picture, so that thresholds are those of the whole picture.

use std::fmt::Write;

use serde::Serialize;
use vergence_landmark::sequential::{Config, SequentialFinder};
use vergence_landmark::synthetic::{Light, Scene};
use vergence_landmark::{Decision, Finder, Request};
use vergence_tag::codebook;

use super::tag_free;
use crate::failure::Failure;

/// Side of a tile (px).
const TILE: usize = 32;

/// Frames after which a run counts as undecided.
const LONGEST: usize = 400;

/// Noise of the simulated pixels (grey levels).
const NOISE: f64 = 4.0;

/// Standard deviation of the matched filter's output for unit noise: amplitude over this is rho.
pub const FILTER_NOISE: f64 = 0.865;

/// Chance of a false report or a wrong name that the bounds are computed for.
pub const ALPHA: f64 = 1e-3;

/// Hypotheses over a whole picture in the Wald bound: 24.4 k places, 16 codes of 18 phases.
const HYPOTHESES: f64 = 24.4e3 * 16.0 * 18.0;

/// Everything that was simulated.
#[derive(Debug, Serialize)]
pub struct Bound {
    frames_to_decision: Vec<Row>,
    tag_free: tag_free::TagFree,
}

/// Frames to a decision at one signal-to-noise ratio and exposure.
#[derive(Debug, Serialize)]
struct Row {
    /// LED-on amplitude over the noise after the matched filter, in one frame.
    rho: f64,
    /// Exposure as a share of a chip.
    exposure: f64,
    /// Wald's expected number of frames for these error rates, background unknown.
    wald: f64,
    median: usize,
    p95: usize,
    runs: u32,
    undecided: usize,
    wrong: usize,
}

/// Runs both simulations.
pub fn run(runs: u32, minutes: f64) -> Result<Bound, Failure> {
    let mut frames_to_decision = Vec::new();
    for exposure in [0.15, 1.0] {
        for rho in [1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0] {
            frames_to_decision.push(row(rho, exposure, runs)?);
        }
    }
    Ok(Bound { frames_to_decision, tag_free: tag_free::run(minutes)? })
}

/// The first sixteen patterns that the system assigns at 30 frames/s: 18 chips of one frame.
pub fn requests() -> Result<Vec<Request>, Failure> {
    let missing = || Failure::failed("the code book is too short", "report this as a defect");
    let request = |k: usize| {
        let pattern = codebook::assign(k, 30.0).ok_or_else(missing)?;
        Ok(Request { id: k.to_string(), pattern, clock_tolerance: 1e-4 })
    };
    (0..16).map(request).collect()
}

/// The finder of a tile: its share of the false alarms of a 640x480 picture.
fn finder(requests: Vec<Request>) -> Result<SequentialFinder, Failure> {
    let share = (TILE * TILE) as f64 / (640.0 * 480.0);
    let config = Config {
        false_alarm: ALPHA * share,
        wrong_identity: ALPHA,
        window_frames: LONGEST,
        // The question is which of sixteen: nothing else blinks.
        foreign_rate: None,
        ..Config::default()
    };
    SequentialFinder::new(requests, config).map_err(|e| super::refused(&e))
}

/// A draw in [0, 1) that depends on the run and a purpose only.
pub fn draw(run: usize, purpose: u64) -> f64 {
    let mut z = (run as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ purpose.wrapping_mul(0xd6e8_feb8_6659_fd93);
    for _ in 0..3 {
        z = (z ^ (z >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    }
    (z >> 11) as f64 / (1u64 << 53) as f64
}

fn row(rho: f64, exposure: f64, runs: u32) -> Result<Row, Failure> {
    let requests = requests()?;
    let (mut counts, mut undecided, mut wrong) = (Vec::new(), 0, 0);
    for run in 0..runs as usize {
        let own = (draw(run, 1) * requests.len() as f64) as usize;
        let pattern = requests[own].pattern;
        let centre = TILE as f64 / 2.0 - 1.0;
        let light = Light {
            place: [centre + draw(run, 2), centre + draw(run, 3)].into(),
            amplitude: rho * FILTER_NOISE * NOISE,
            pattern,
            phase: draw(run, 4) * pattern.period().as_secs_f64(),
            rate: 1.0 + 2e-4 * (draw(run, 5) - 0.5),
        };
        let scene = Scene {
            noise: NOISE,
            exposure: exposure / 30.0,
            lights: vec![light.clone()],
            ..Scene::flat(TILE, TILE)
        };
        let mut film = scene.film(run as u64);
        let mut finder = finder(requests.clone())?;
        let decided = (1..=LONGEST).find(|_| {
            let pushed = film.next_frame().ok().is_some_and(|f| finder.push(&f).is_ok());
            !pushed || finder.decisions().iter().any(|d| d.brightest().is_some())
        });
        let Some(frames) = decided else {
            undecided += 1;
            continue;
        };
        let right = |(k, d): (usize, &Decision)| {
            d.brightest().is_none_or(|s| k == own && (s.pixel - light.place).norm() < 2.0)
        };
        wrong += usize::from(!finder.decisions().iter().enumerate().all(right));
        counts.push(frames);
    }
    counts.sort_unstable();
    let quantile = |q: f64| counts.get((q * counts.len() as f64) as usize).copied();
    Ok(Row {
        rho,
        exposure,
        wald: (HYPOTHESES / ALPHA).ln() * 8.0 / (rho * rho),
        median: quantile(0.5).unwrap_or(LONGEST),
        p95: quantile(0.95).unwrap_or(LONGEST),
        runs,
        undecided,
        wrong,
    })
}

impl Bound {
    /// Tables for people.
    pub fn text(&self) -> String {
        let mut text = String::from(
            "frames to a confirmed identity among 16 codes, 640x480, false alarms and wrong names 1e-3\n\
             rho   exposure  Wald   median  x Wald  p95   undecided  wrong  runs\n",
        );
        for r in &self.frames_to_decision {
            let _ = writeln!(
                text,
                "{:<5} {:<8} {:>6.1} {:>7} {:>7.2} {:>5} {:>9} {:>7} {:>6}",
                r.rho,
                r.exposure,
                r.wald,
                r.median,
                r.median as f64 / r.wald,
                r.p95,
                r.undecided,
                r.wrong,
                r.runs
            );
        }
        text.push_str(&self.tag_free.text());
        text
    }
}
