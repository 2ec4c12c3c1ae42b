//! `vergence blink --bound`: how far the sequential finder is from what is possible, by simulation.
//!
//! Two tables: frames to a confirmed identity among 16 codes against Wald's bound, and false reports
//! over hours of tag-free video. Small pictures (tiles) are simulated; the false-alarm rate that a
//! tile is given is its share of a 640x480 picture, so that thresholds are those of the whole picture.

use std::fmt::Write;
use std::time::Duration;

use serde::Serialize;
use vergence_landmark::sequential::{Config, SequentialFinder};
use vergence_landmark::synthetic::{Light, Patch, Scene};
use vergence_landmark::{Decision, Finder, Request};
use vergence_tag::Pattern;
use vergence_tag::codebook;
use vergence_tag::pattern::Bits;

use crate::failure::Failure;

/// Side of a tile (px).
const TILE: usize = 32;

/// Frames after which a run counts as undecided.
const LONGEST: usize = 400;

/// Noise of the simulated pixels (grey levels).
const NOISE: f64 = 4.0;

/// Standard deviation of the matched filter's output for unit noise: amplitude over this is rho.
const FILTER_NOISE: f64 = 0.865;

/// Chance of a false report or a wrong name that the bounds are computed for.
const ALPHA: f64 = 1e-3;

/// Hypotheses over a whole picture in the Wald bound: 24.4 k places, 16 codes of 18 phases.
const HYPOTHESES: f64 = 24.4e3 * 16.0 * 18.0;

/// Everything that was simulated.
#[derive(Debug, Serialize)]
pub struct Bound {
    frames_to_decision: Vec<Row>,
    tag_free: TagFree,
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
    runs: usize,
    undecided: usize,
    wrong: usize,
}

/// What was reported where no tag was.
#[derive(Debug, Serialize)]
struct TagFree {
    /// Simulated video (s).
    seconds: f64,
    recordings: usize,
    /// Reports of any requested tag.
    false_reports: usize,
    /// Reports that the stated rate allows on average: each recording may have `ALPHA`.
    allowed: f64,
}

/// Runs both simulations.
pub fn run(runs: usize, minutes: f64) -> Result<Bound, Failure> {
    let mut frames_to_decision = Vec::new();
    for exposure in [0.15, 1.0] {
        for rho in [1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 20.0] {
            frames_to_decision.push(row(rho, exposure, runs)?);
        }
    }
    Ok(Bound { frames_to_decision, tag_free: tag_free(minutes)? })
}

/// The first sixteen patterns that the system assigns at 30 frames/s: 18 chips of one frame.
fn requests() -> Result<Vec<Request>, Failure> {
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
fn draw(run: usize, purpose: u64) -> f64 {
    let mut z = (run as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ purpose.wrapping_mul(0xd6e8_feb8_6659_fd93);
    for _ in 0..3 {
        z = (z ^ (z >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    }
    (z >> 11) as f64 / (1u64 << 53) as f64
}

fn row(rho: f64, exposure: f64, runs: usize) -> Result<Row, Failure> {
    let requests = requests()?;
    let (mut counts, mut undecided, mut wrong) = (Vec::new(), 0, 0);
    for run in 0..runs {
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

/// Recordings of 8 s with lamps, screens, foreign tags, passing things and heavy tails, no tag.
fn tag_free(minutes: f64) -> Result<TagFree, Failure> {
    const SECONDS: f64 = 8.0;
    const SIDE: usize = 96;
    let mut requests = requests()?;
    requests.truncate(8);
    let flicker = |ms: u64| Pattern::new(Bits::FLICKER, Duration::from_millis(ms));
    for (k, ms) in [57, 83, 104, 125].into_iter().enumerate() {
        let pattern = flicker(ms).map_err(|e| Failure::failed(e, "report this as a defect"))?;
        requests.push(Request { id: format!("flicker-{k}"), pattern, clock_tolerance: 2e-4 });
    }
    let recordings = (60.0 * minutes / SECONDS).ceil() as usize;
    let mut false_reports = 0;
    for run in 0..recordings {
        let scene = hostile(run, SIDE, &requests);
        let mut film = scene.film(run as u64);
        let config = Config { false_alarm: ALPHA, wrong_identity: ALPHA, ..Config::default() };
        let mut finder =
            SequentialFinder::new(requests.clone(), config).map_err(|e| super::refused(&e))?;
        for _ in 0..(SECONDS * scene.frame_rate) as usize {
            let frame = film.next_frame();
            let frame = frame.map_err(|e| Failure::failed(e, "report this as a defect"))?;
            finder.push(&frame).map_err(|e| super::refused(&e))?;
        }
        finder.finish();
        let reports = finder.decisions().iter().filter(|d| d.brightest().is_some()).count();
        false_reports += reports;
    }
    let seconds = recordings as f64 * SECONDS;
    Ok(TagFree { seconds, recordings, false_reports, allowed: ALPHA * recordings as f64 })
}

/// One tag-free scene: everything at once, differently in every run.
fn hostile(run: usize, side: usize, requests: &[Request]) -> Scene {
    let at = |purpose: u64| 12.0 + draw(run, purpose) * (side as f64 - 24.0);
    // Foreign tags: another code, and a requested pattern played at least 6 % too fast or too slow, and
    // not at the rate of another requested one either.
    let other = requests[(draw(run, 11) * requests.len() as f64) as usize].pattern;
    let off = |k: u64| {
        if draw(run, 12 + 100 * k) < 0.5 {
            0.70 + 0.24 * draw(run, 13 + 100 * k)
        } else {
            1.06 + 0.3 * draw(run, 13 + 100 * k)
        }
    };
    let chip = other.chip.as_secs_f64();
    let alike = |rate: &f64| {
        requests.iter().filter(|r| r.pattern.bits == other.bits).any(|r| {
            let ratio = chip / rate / r.pattern.chip.as_secs_f64();
            (0.95..1.05).contains(&ratio)
        })
    };
    let rate = (0..).map(off).find(|rate| !alike(rate)).unwrap_or(1.5);
    let foreign = codebook::challenge(
        run as u64,
        Duration::from_millis(33),
        &requests.iter().map(|r| r.pattern.bits).collect::<Vec<_>>(),
    );
    let light = |pattern, rate, k: u64| Light {
        place: [at(20 + k), at(30 + k)].into(),
        amplitude: 3.0 + 90.0 * draw(run, 40 + k).powi(2),
        pattern,
        phase: draw(run, 50 + k),
        rate,
    };
    let mut lights = vec![light(other, rate, 0)];
    lights.extend(foreign.map(|pattern| light(pattern, 1.0, 1)));
    let screen = Patch {
        rect: [at(61), at(62), 14.0, 10.0],
        speed: [0.0, 0.0],
        depth: 40.0 * draw(run, 63),
        rate: [24.0, 30.0, 60.0, 7.0][(4.0 * draw(run, 64)) as usize],
    };
    let passing = Patch {
        rect: [-30.0, at(65), 25.0, 30.0],
        speed: [10.0 + 60.0 * draw(run, 66), 0.0],
        depth: 60.0,
        rate: 0.0,
    };
    Scene {
        lights,
        patches: vec![screen, passing],
        lamps: vec![(100.0, 0.3 * draw(run, 67)), (120.0, 0.05)],
        heavy_tail: 0.01,
        shake: 0.2 * draw(run, 68),
        dropped: 0.05,
        frame_rate: [25.0, 30.0, 60.0][(3.0 * draw(run, 69)) as usize],
        exposure: 0.002 + 0.012 * draw(run, 70),
        row_time: 5e-5,
        jpeg: (draw(run, 71) < 0.5).then_some(85),
        ..Scene::textured(side, side, run as u64)
    }
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
        let t = &self.tag_free;
        let _ = writeln!(
            text,
            "tag-free video: {:.0} s in {} recordings, {} false reports (the stated rate allows {:.2})",
            t.seconds, t.recordings, t.false_reports, t.allowed
        );
        text
    }
}
