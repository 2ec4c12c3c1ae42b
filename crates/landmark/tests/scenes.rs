//! Whole finders against simulated scenes with known truth.

#![allow(clippy::unwrap_used)]

use std::time::Duration;

use nalgebra::Point2;
use proptest::prelude::*;
use vergence_imaging::Image;
use vergence_landmark::sequential::{Config, SequentialFinder};
use vergence_landmark::synthetic::{Light, Patch, Scene};
use vergence_landmark::{Decision, Finder, Request};
use vergence_tag::{Pattern, codebook};

const SIDE: usize = 64;

fn request(id: &str, bits: &str, chip_ms: f64) -> Request {
    let chip = Duration::from_secs_f64(1e-3 * chip_ms);
    let pattern = Pattern::new(bits.parse().unwrap(), chip).unwrap();
    Request { id: id.into(), pattern, clock_tolerance: 2e-4 }
}

fn light(request: &Request, x: f64, y: f64, amplitude: f64) -> Light {
    let place = Point2::new(x, y);
    Light { place, amplitude, pattern: request.pattern, phase: 0.113, rate: 1.0001 }
}

/// Pushes `count` frames of a scene into a new finder.
fn watch(scene: &Scene, requests: &[Request], count: usize, seed: u64) -> SequentialFinder {
    let mut finder = SequentialFinder::new(requests.to_vec(), Default::default()).unwrap();
    let mut film = scene.film(seed);
    for _ in 0..count {
        finder.push(&film.next_frame().unwrap()).unwrap();
    }
    finder.finish();
    finder
}

fn place(decision: &Decision) -> Option<Point2<f64>> {
    decision.brightest().map(|s| s.pixel)
}

#[test]
fn two_tags_and_an_absent_one_under_everything_at_once() {
    let requests =
        [request("a", "1110010", 63.0), request("b", "10", 83.0), request("c", "1110010", 75.0)];
    let foreign = request("status", "10", 110.0);
    let scene = Scene {
        lights: vec![
            light(&requests[0], 40.3, 22.8, 25.0),
            light(&requests[1], 18.6, 44.1, 12.0),
            light(&foreign, 50.0, 50.0, 80.0),
        ],
        patches: vec![
            Patch { rect: [8.0, 10.0, 12.0, 9.0], speed: [0.0; 2], depth: 30.0, rate: 12.0 },
            Patch { rect: [-30.0, 50.0, 20.0, 14.0], speed: [25.0, 0.0], depth: 50.0, rate: 0.0 },
        ],
        lamps: vec![(100.0, 0.15)],
        shake: 0.15,
        dropped: 0.06,
        row_time: 6e-5,
        heavy_tail: 0.005,
        jpeg: Some(90),
        ..Scene::textured(SIDE, SIDE, 3)
    };
    let finder = watch(&scene, &requests, 110, 5);
    let [a, b, c] = finder.decisions() else { panic!("one decision a request") };
    for (decision, truth) in [(a, &scene.lights[0]), (b, &scene.lights[1])] {
        let found = place(decision).unwrap_or_else(|| panic!("missed: {decision:?}"));
        assert!((found - truth.place).norm() < 0.5, "{found} is not {}", truth.place);
    }
    assert_eq!(place(c), None, "reported a tag that is not there: {c:?}");
}

#[test]
fn a_mirror_is_a_second_place_less_bright() {
    let requests = [request("a", "1011000", 71.0)];
    let scene = Scene {
        lights: vec![light(&requests[0], 20.2, 20.7, 40.0), light(&requests[0], 44.6, 47.1, 15.0)],
        ..Scene::flat(SIDE, SIDE)
    };
    let finder = watch(&scene, &requests, 60, 1);
    let Decision::Here(places) = &finder.decisions()[0] else { panic!("missed") };
    assert_eq!(places.len(), 2, "{places:?}");
    assert!((places[0].pixel - scene.lights[0].place).norm() < 0.2);
    assert!((places[1].pixel - scene.lights[1].place).norm() < 0.3);
}

#[test]
fn a_reflection_is_not_taken_for_the_light_because_it_is_decided_first() {
    let pattern = codebook::assign(0, 30.0).unwrap();
    let request = Request { id: "a".into(), pattern, clock_tolerance: 2e-4 };
    for step in 0..40 {
        let phase = pattern.period().as_secs_f64() * f64::from(step) / 40.0;
        let at = |y: f64, amplitude: f64| {
            let light = light(&request, 30.3, y, amplitude);
            Light { phase, rate: 1.0, ..light }
        };
        let lights = vec![at(14.8, 3000.0), at(52.1, 14.0)];
        let scene = Scene { lights, exposure: 0.004, ..Scene::flat(SIDE, SIDE) };
        let mut finder = SequentialFinder::new(vec![request.clone()], Default::default()).unwrap();
        let mut film = scene.film(7);
        for _ in 0..60 {
            finder.push(&film.next_frame().unwrap()).unwrap();
            if finder.is_done() {
                break;
            }
        }
        let found = place(&finder.decisions()[0]).expect("a light like this is found");
        assert!((found - scene.lights[0].place).norm() < 0.5, "{found} at phase {phase:.3} s");
    }
}

#[test]
fn an_empty_scene_is_said_to_be_empty() {
    let requests = [request("a", "10", 83.0), request("b", "1110010", 60.0)];
    let finder = watch(&Scene::textured(SIDE, SIDE, 9), &requests, 150, 2);
    assert_eq!(finder.decisions(), [Decision::Absent, Decision::Absent]);
}

/// Position errors over their stated covariance: near one on average, so the covariance is honest,
/// and the covariance is near the Cramer-Rao bound.
#[test]
fn positions_are_as_good_as_stated_and_near_the_bound() {
    let requests = [request("a", "110100100101", 61.0)];
    let (runs, frames, amplitude, noise) = (80, 90, 12.0, 2.0);
    let (mut nees, mut square) = (0.0, 0.0);
    for run in 0..runs {
        let (dx, dy) = (0.37 * run as f64 % 1.0, 0.73 * run as f64 % 1.0);
        let scene = Scene {
            lights: vec![light(&requests[0], 24.0 + dx, 24.0 + dy, amplitude)],
            noise,
            ..Scene::flat(48, 48)
        };
        let finder = watch(&scene, &requests, frames, 100 + run);
        let sighting = finder.decisions()[0].brightest().expect("a clear light is found");
        let error = sighting.pixel - scene.lights[0].place;
        let weight = sighting.covariance.try_inverse().expect("a covariance has an inverse");
        nees += (error.transpose() * weight * error)[(0, 0)] / runs as f64;
        square += error.norm_squared() / (2 * runs) as f64;
    }
    // sigma_x >= s sqrt(2) / rho over the frames: 0.80 noise / amplitude at s = 1, rounding included.
    let per_frame = 2f64.sqrt() * 0.68
        / (std::f64::consts::PI.sqrt() * 0.68 * amplitude / (noise * noise + 1.0 / 12.0f64).sqrt());
    let bound = per_frame / (frames as f64 * 0.25).sqrt();
    assert!((1.0..2.5).contains(&nees), "normalised error squared {nees:.2}, 2 expected");
    assert!(square.sqrt() < 1.15 * bound, "{:.4} px against {bound:.4} px", square.sqrt());
}

/// A plain lock-in: every pixel with every phase over all frames, the peak against eight medians.
fn lock_in(frames: &[(f64, f64, Image<u8>)], pattern: &Pattern) -> Option<Point2<f64>> {
    let pixels = frames[0].2.data().len();
    let mut best = vec![0.0f64; pixels];
    for step in 0..32 {
        let phase = pattern.period().as_secs_f64() * step as f64 / 32.0;
        let mut expected: Vec<f64> =
            frames.iter().map(|(t, e, _)| pattern.on_fraction(t + phase, *e)).collect();
        let mean = expected.iter().sum::<f64>() / expected.len() as f64;
        expected.iter_mut().for_each(|v| *v -= mean);
        for (i, b) in best.iter_mut().enumerate() {
            let sum: f64 =
                frames.iter().zip(&expected).map(|(f, e)| e * f64::from(f.2.data()[i])).sum();
            *b = b.max(sum);
        }
    }
    let peak = (0..pixels).max_by(|&a, &b| best[a].total_cmp(&best[b]))?;
    let mut sorted = best.clone();
    sorted.sort_by(f64::total_cmp);
    let width = frames[0].2.width();
    (best[peak] > 8.0 * sorted[pixels / 2])
        .then(|| Point2::new((peak % width) as f64, (peak / width) as f64))
}

/// Under a lamp, shake and a screen the lock-in fails where the sequential finder does not.
#[test]
fn more_is_found_than_by_a_plain_lock_in() {
    let wanted = request("a", "110100100101", 67.0);
    let (mut ours, mut plain) = (0, 0);
    for run in 0..6u64 {
        let scene = Scene {
            lights: vec![light(&wanted, 30.4, 33.2, 9.0)],
            patches: vec![Patch {
                rect: [8.0, 8.0, 12.0, 12.0],
                speed: [0.0; 2],
                depth: 30.0,
                rate: 9.0,
            }],
            lamps: vec![(100.0, 0.1)],
            shake: 0.15,
            ..Scene::textured(SIDE, SIDE, run)
        };
        let mut film = scene.film(run);
        let near =
            |p: Option<Point2<f64>>| p.is_some_and(|p| (p - scene.lights[0].place).norm() < 2.0);
        let frames: Vec<_> = (0..100).map(|_| film.next_frame().unwrap()).collect();
        let mut finder = SequentialFinder::new(vec![wanted.clone()], Default::default()).unwrap();
        frames.iter().for_each(|f| finder.push(f).unwrap());
        finder.finish();
        ours += usize::from(near(place(&finder.decisions()[0])));
        let start = frames[0].stamp;
        let timed: Vec<_> = frames
            .into_iter()
            .map(|f| ((f.stamp - start).as_secs_f64(), f.exposure.as_secs_f64(), f.image))
            .collect();
        plain += usize::from(near(lock_in(&timed, &wanted.pattern)));
    }
    assert!(ours >= 5 && ours > plain, "ours {ours}, plain lock-in {plain} of 6");
}

/// Codes that nobody asked for, from faint to bright, on the chip of the requests. Without the lead that
/// foreign lights demand, some pass for a request within their first chips.
#[test]
fn codes_that_nobody_asked_for_are_told_from_the_requested() {
    let chip = Duration::from_millis(40);
    let requests: Vec<Request> = (0..8)
        .map(|k| {
            let code = codebook::assign(k, 25.0).unwrap().bits;
            let pattern = Pattern::new(code, chip).unwrap();
            Request { id: k.to_string(), pattern, clock_tolerance: 2e-4 }
        })
        .collect();
    let known: Vec<_> = requests.iter().map(|r| r.pattern.bits).collect();
    let reports = |foreign_rate: Option<f64>| -> usize {
        let report = |run: u64| {
            let pattern = codebook::challenge(run, chip, &known).unwrap();
            let amplitude = 4.0 * 1.2f64.powi(run as i32);
            let place = Point2::new(20.3, 19.6);
            let phase = 0.037 * run as f64;
            let lights = vec![Light { place, amplitude, pattern, phase, rate: 1.0 }];
            let scene = Scene { lights, frame_rate: 25.0, ..Scene::flat(40, 40) };
            let config = Config { foreign_rate, ..Config::default() };
            let mut finder = SequentialFinder::new(requests.clone(), config).unwrap();
            let mut film = scene.film(run);
            (0..100).for_each(|_| finder.push(&film.next_frame().unwrap()).unwrap());
            finder.decisions().iter().filter(|d| d.brightest().is_some()).count()
        };
        (0..16).map(report).sum()
    };
    assert_eq!(reports(Config::default().foreign_rate), 0);
    assert!(reports(None) > 0, "the scenes are too easy to show anything");
}

/// A flicker is also a code of twice as many chips of half the length, and each of those is requested too.
#[test]
fn what_is_the_request_itself_in_shorter_chips_is_no_rival() {
    let requests = [request("flicker", "10", 80.0), request("code", "10010011", 40.0)];
    let scene =
        Scene { lights: vec![light(&requests[0], 20.3, 19.6, 30.0)], ..Scene::flat(40, 40) };
    let finder = watch(&scene, &requests, 60, 1);
    let frames = finder.decisions()[0].brightest().map(|s| s.frames);
    assert!(frames.is_some_and(|f| f <= 30), "decided after {frames:?} frames");
}

/// Time stamps come from outside: a clock that jumps by ages must not end the robot.
#[test]
fn a_light_too_bright_for_the_picture_is_found_however_it_falls_into_the_exposures() {
    // A chip a frame, as `find` asks for: where the changes fall into the exposures they do so every time,
    // and a light so bright is white although it shines through a small part of one.
    let pattern = codebook::assign(0, 30.0).unwrap();
    let request = Request { id: "a".into(), pattern, clock_tolerance: 2e-4 };
    let missed = |amplitude: f64| {
        let misses = |step: &u32| {
            // Within half a millisecond to either side of what an exposure of 4 ms cuts.
            let phase = 1e-3 * (33.333 - 4.5 + 5.0 * f64::from(*step) / 20.0);
            let light = Light { phase, rate: 1.0, ..light(&request, 30.3, 32.8, amplitude) };
            let scene = Scene { lights: vec![light], exposure: 0.004, ..Scene::flat(SIDE, SIDE) };
            let finder = watch(&scene, std::slice::from_ref(&request), 36, 7);
            place(&finder.decisions()[0]).is_none()
        };
        (0..20).filter(misses).count()
    };
    for amplitude in [60.0, 400.0, 600.0, 1500.0, 6000.0] {
        assert_eq!(missed(amplitude), 0, "of 20 with {amplitude} grey levels");
    }
}

#[test]
fn a_clock_that_jumps_by_ages_does_no_harm() {
    let requests = [request("a", "1110010", 63.0), request("b", "110100100101", 40.0)];
    for jump in [1u64 << 33, 1 << 45, 1 << 53, 1 << 62] {
        let scene =
            Scene { lights: vec![light(&requests[0], 20.3, 19.6, 30.0)], ..Scene::flat(40, 40) };
        let mut finder = SequentialFinder::new(requests.to_vec(), Default::default()).unwrap();
        let mut film = scene.film(1);
        for k in 0..60 {
            let mut frame = film.next_frame().unwrap();
            frame.stamp += Duration::from_secs(if k < 20 { 0 } else { jump });
            finder.push(&frame).unwrap();
        }
        finder.finish();
    }
}

/// Patterns that are requested, played by somebody else at another rate.
#[test]
fn a_requested_pattern_at_another_rate_is_not_reported() {
    let requests: Vec<Request> = [("10", 83.0), ("10", 125.0), ("110100100101", 40.0)]
        .iter()
        .enumerate()
        .map(|(k, (bits, chip))| request(&k.to_string(), bits, *chip))
        .collect();
    for run in 0..18usize {
        let rate = [0.8, 0.88, 0.93, 1.07, 1.12, 1.2][run % 6];
        let mut lamp = light(&requests[run % 3], 20.3, 19.6, 12.0 * 1.1f64.powi(run as i32));
        (lamp.rate, lamp.phase) = (rate, 0.037 * run as f64);
        let scene =
            Scene { lights: vec![lamp], exposure: 0.01, frame_rate: 25.0, ..Scene::flat(40, 40) };
        let finder = watch(&scene, &requests, 100, run as u64);
        let found: Vec<_> = finder.decisions().iter().map(place).collect();
        assert_eq!(found, [None; 3], "run {run}, rate {rate}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// Where, when and how fast a light blinks does not matter.
    #[test]
    fn any_phase_place_and_frame_rate(
        x in 12.0f64..36.0, y in 12.0f64..36.0, phase in 0.0f64..2.0,
        rate in prop::sample::select(vec![25.0, 30.0, 60.0, 120.0]), seed: u64,
    ) {
        let request = request("a", "1110100", 2100.0 / rate);
        let mut lamp = light(&request, x, y, 30.0);
        lamp.phase = phase;
        let scene = Scene { lights: vec![lamp], frame_rate: rate, exposure: 0.2 / rate, ..Scene::flat(48, 48) };
        let finder = watch(&scene, &[request], 70, seed);
        let found = place(&finder.decisions()[0]);
        prop_assert!(found.is_some_and(|p| (p - Point2::new(x, y)).norm() < 0.3), "{:?}", found);
    }
}
