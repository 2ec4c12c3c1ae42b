//! False reports over hours of simulated tag-free video, each traced to what lies there.
//!
//! Recordings of 8 s of 96x96 pixels with lamps, a screen, a passing thing, two foreign tags, shake,
//! lost frames, heavy tails and JPEG, and none of the requested tags.

use std::fmt::Write;
use std::time::Duration;

use serde::Serialize;
use vergence_landmark::sequential::{Config, SequentialFinder};
use vergence_landmark::synthetic::{Light, Patch, Scene};
use vergence_landmark::{Finder, Request, Sighting};
use vergence_tag::Pattern;
use vergence_tag::codebook;
use vergence_tag::pattern::Bits;

use super::bound::{ALPHA, FILTER_NOISE, draw};
use crate::failure::Failure;

/// Length of a recording (s).
const SECONDS: f64 = 8.0;

/// Side of a picture (px).
const SIDE: usize = 96;

/// Chip of the foreign tags with a code of their own: that of most requests.
const CHIP: Duration = Duration::from_millis(33);

/// Phases at which a pattern is compared with a foreign light.
const PHASES: usize = 256;

/// Distance (px) within which a report is put down to a light.
const AT_LIGHT: f64 = 8.0;

/// What was reported where no tag was.
#[derive(Debug, Serialize)]
pub struct TagFree {
    /// Simulated video (s).
    seconds: f64,
    recordings: usize,
    /// Reports of any requested tag.
    false_reports: Vec<FalseReport>,
    /// Reports that the stated rate allows on average: each recording may have `ALPHA`.
    allowed: f64,
}

/// A report of a tag that is not there.
#[derive(Debug, Serialize)]
struct FalseReport {
    /// Number of the recording; it is the seed as well.
    recording: usize,
    /// The tag that was reported.
    request: String,
    /// Frames used.
    frames: usize,
    /// Signal-to-noise ratio that was stated.
    snr: f64,
    /// Where (px).
    pixel: [f64; 2],
    /// The foreign tag that lies there; `None`: none, so a screen, an edge or noise.
    light: Option<Blame>,
}

/// A foreign tag that was taken for a requested one.
#[derive(Debug, Serialize)]
struct Blame {
    /// Its code is one that is requested, at another rate.
    code_is_requested: bool,
    /// Its rate relative to that of its pattern.
    rate: f64,
    /// Amplitude over the noise after the matched filter, in one frame, before JPEG.
    rho: f64,
    /// Share of its changes' energy that the reported pattern explains at the best phase, over the
    /// frames used.
    likeness: f64,
}

/// Simulates so many minutes.
pub fn run(minutes: f64) -> Result<TagFree, Failure> {
    let requests = requests()?;
    let recordings = (60.0 * minutes / SECONDS).ceil() as usize;
    let mut false_reports = Vec::new();
    for recording in 0..recordings {
        let scene = hostile(recording, &requests);
        let mut film = scene.film(recording as u64);
        let config = Config { false_alarm: ALPHA, wrong_identity: ALPHA, ..Config::default() };
        let mut finder =
            SequentialFinder::new(requests.clone(), config).map_err(|e| super::refused(&e))?;
        let mut stamps = Vec::new();
        for _ in 0..(SECONDS * scene.frame_rate) as usize {
            let frame = film.next_frame();
            let frame = frame.map_err(|e| Failure::failed(e, "report this as a defect"))?;
            stamps.push(frame.stamp);
            finder.push(&frame).map_err(|e| super::refused(&e))?;
        }
        finder.finish();
        for (request, decision) in requests.iter().zip(finder.decisions()) {
            let Some(sighting) = decision.brightest() else { continue };
            let times = stamps[..sighting.frames.min(stamps.len())].iter();
            let times: Vec<f64> = times.map(|s| (*s - stamps[0]).as_secs_f64()).collect();
            false_reports.push(FalseReport {
                recording,
                request: request.id.clone(),
                frames: sighting.frames,
                snr: sighting.snr,
                pixel: [sighting.pixel.x, sighting.pixel.y],
                light: blame(&scene, &requests, request, sighting, &times),
            });
        }
    }
    let seconds = recordings as f64 * SECONDS;
    Ok(TagFree { seconds, recordings, false_reports, allowed: ALPHA * recordings as f64 })
}

/// Eight patterns of the code book, and four that only flicker.
fn requests() -> Result<Vec<Request>, Failure> {
    let mut requests = super::bound::requests()?;
    requests.truncate(8);
    for (k, ms) in [57, 83, 104, 125].into_iter().enumerate() {
        let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(ms))
            .map_err(|e| Failure::failed(e, "report this as a defect"))?;
        requests.push(Request { id: format!("flicker-{k}"), pattern, clock_tolerance: 2e-4 });
    }
    Ok(requests)
}

/// The foreign tag at a sighting.
fn blame(
    scene: &Scene,
    requests: &[Request],
    reported: &Request,
    sighting: &Sighting,
    times: &[f64],
) -> Option<Blame> {
    let distance = |l: &&Light| (l.place - sighting.pixel).norm();
    let nearest = scene.lights.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let light = nearest.filter(|l| distance(l) < AT_LIGHT)?;
    let row = light.place.y * scene.row_time;
    let course = |pattern: &Pattern, phase: f64, rate: f64| {
        let share = |t: &f64| pattern.on_fraction(phase + rate * (t + row), rate * scene.exposure);
        let course: Vec<f64> = times.iter().map(share).collect();
        let mean = course.iter().sum::<f64>() / course.len().max(1) as f64;
        course.into_iter().map(move |v| v - mean).collect::<Vec<f64>>()
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let own = course(&light.pattern, light.phase, light.rate);
    let likeness = |k: usize| {
        let phase = reported.pattern.period().as_secs_f64() * k as f64 / PHASES as f64;
        let other = course(&reported.pattern, phase, 1.0);
        let product = dot(&own, &other).max(0.0);
        product * product / (dot(&own, &own) * dot(&other, &other)).max(1e-9)
    };
    Some(Blame {
        code_is_requested: requests.iter().any(|r| r.pattern.bits == light.pattern.bits),
        rate: light.rate,
        rho: light.amplitude / (scene.noise * FILTER_NOISE),
        likeness: (0..PHASES).map(likeness).fold(0.0, f64::max),
    })
}

/// One tag-free scene: everything at once, differently in every run.
fn hostile(run: usize, requests: &[Request]) -> Scene {
    let at = |purpose: u64| 12.0 + draw(run, purpose) * (SIDE as f64 - 24.0);
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
        CHIP,
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
        ..Scene::textured(SIDE, SIDE, run as u64)
    }
}

impl TagFree {
    /// A line, and one more for every false report.
    pub fn text(&self) -> String {
        let mut text = format!(
            "tag-free video: {:.0} s in {} recordings, {} false reports (the stated rate allows {:.2})\n",
            self.seconds,
            self.recordings,
            self.false_reports.len(),
            self.allowed
        );
        for r in &self.false_reports {
            let cause = match &r.light {
                None => "no light is near".to_owned(),
                Some(b) => format!(
                    "a foreign tag of rho {:.1} with {} at rate {:.3}, explained to {:.2}",
                    b.rho,
                    if b.code_is_requested { "a requested code" } else { "another code" },
                    b.rate,
                    b.likeness
                ),
            };
            let [x, y] = r.pixel;
            let _ = writeln!(
                text,
                "  recording {}: {} at ({x:.1}, {y:.1}) after {} frames, snr {:.1}: {cause}",
                r.recording, r.request, r.frames, r.snr
            );
        }
        text
    }
}
