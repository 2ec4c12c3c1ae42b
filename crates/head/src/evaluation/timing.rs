//! Time from the command to both heads' fixation, against the least that any head would need.

use nalgebra::{Matrix3, Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vergence_geometry::GaussianPoint;

use super::world::described_heads;
use crate::triangulation::nearest_to_rays;
use crate::{Field, Fixator, FixatorConfig, NextMove, PanTiltHead, Search, SearchConfig};

/// Time (s) to tell a tag's pattern at one view: 15 frames at 30 a second.
const CODE: f64 = 0.5;
/// Rest after a move before pictures count (s).
const SETTLE: f64 = 0.05;
/// Seeing the light again after a move, its pattern known (s): two frames.
const LOOK: f64 = 2.0 / 30.0;
/// How far (m, one sigma per axis) a light lies from where it was last seen.
const MOVED: f64 = 0.1;

/// Times of many placements.
#[derive(Debug, Clone, PartialEq)]
pub struct Timing {
    /// Median of the time over its lower bound (slew straight to the light plus code), the light last
    /// seen some 0.1 m from where it is.
    pub ratio_last_seen: f64,
    /// The same, the light within the first view of both heads.
    pub ratio_in_sight: f64,
    /// The same, the light anywhere in the field, nothing known.
    pub ratio_anywhere: f64,
    /// Median time (s) when nothing is known.
    pub seconds_anywhere: f64,
    /// Placements at which a search ended without both heads seeing the light.
    pub not_found: usize,
}

/// Runs search and fixation for random placements with ideal servos at 3.6 rad/s.
pub fn time_to_fixation(placements: usize, baseline: f64, seed: u64) -> Timing {
    let heads = described_heads(baseline);
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let (mut last_seen, mut in_sight, mut anywhere) = (vec![], vec![], vec![]);
    let (mut seconds, mut not_found) = (vec![], 0);
    for _ in 0..placements {
        let light = place(&mut random, 1.2, [-0.3, 0.8]);
        let off = Vector3::from_fn(|_, _| random.random_range(-1.0..1.0)) * MOVED * 3f64.sqrt();
        let prior = GaussianPoint {
            position: light + off,
            covariance: Matrix3::identity() * MOVED * MOVED,
        };
        match run(&heads, &light, Some(&prior)) {
            Some((time, bound)) => last_seen.push(time / bound),
            None => not_found += 1,
        }
        match run(&heads, &light, None) {
            Some((time, bound)) => {
                anywhere.push(time / bound);
                seconds.push(time);
            }
            None => not_found += 1,
        }
        let near = place(&mut random, 0.3, [-0.2, 0.2]);
        match run(&heads, &near, None) {
            Some((time, bound)) => in_sight.push(time / bound),
            None => not_found += 1,
        }
    }
    Timing {
        ratio_last_seen: median(last_seen),
        ratio_in_sight: median(in_sight),
        ratio_anywhere: median(anywhere),
        seconds_anywhere: median(seconds),
        not_found,
    }
}

/// A light within bearings and slopes as seen from the heads, 0.6 m to 1.5 m away.
fn place(random: &mut Pcg64Mcg, bearing: f64, slopes: [f64; 2]) -> Point3<f64> {
    let pan: f64 = random.random_range(-bearing..bearing);
    let tilt: f64 = random.random_range(slopes[0]..slopes[1]);
    let direction = Vector3::new(tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), -tilt.sin());
    Point3::new(0.04, 0.0, 0.55) + direction * random.random_range(0.6..1.5)
}

/// Time to fixation and its lower bound; `None` when a head never sees the light.
fn run(
    heads: &[PanTiltHead; 2],
    light: &Point3<f64>,
    prior: Option<&GaussianPoint>,
) -> Option<(f64, f64)> {
    let config = SearchConfig { dwell: CODE, ..SearchConfig::default() };
    let start = [[0.0; 2]; 2];
    let goals = [heads[0].look_at(light)?, heads[1].look_at(light)?];
    let slew = |from: &[[f64; 2]; 2], to: &[[f64; 2]; 2]| {
        heads[0].slew_time(from[0], to[0]).max(heads[1].slew_time(from[1], to[1]))
    };
    let bound = slew(&start, &goals) + CODE;
    let mut search = Search::new(heads, &Field::reachable(heads), prior, &config);
    let (mut at, mut time, mut seen) = (start, 0.0, [false; 2]);
    while seen != [true; 2] {
        let next = search.next(at)?;
        let way = slew(&at, &next);
        time += way + if way > 0.0 { SETTLE } else { 0.0 } + CODE;
        at = next;
        for k in 0..2 {
            if !seen[k] && heads[k].sees(at[k], light, 4.0) {
                seen[k] = true;
                search.sighted(k, at[k], &heads[k].project(at[k], light)?);
            }
        }
    }
    let mut fixators =
        [0, 1].map(|_| Fixator::new(FixatorConfig { backlash: 0.0, ..FixatorConfig::default() }));
    loop {
        let mut next = at;
        let pixels = [heads[0].project(at[0], light)?, heads[1].project(at[1], light)?];
        // Both see it, so the distance is known and one move is enough.
        let point = nearest_to_rays(&[0, 1].map(|k| heads[k].ray(at[k], &pixels[k])))?;
        for k in 0..2 {
            let eye = heads[k].base_from_optical(at[k]).translation.vector;
            let distance = Some((point.coords - eye).norm());
            let step = fixators[k].next(&heads[k], at[k], &pixels[k], distance);
            if let NextMove::Go { goal, .. } = step {
                next[k] = goal;
            }
        }
        if next == at {
            return Some((time, bound));
        }
        // Both heads move at once, then look again.
        time += slew(&at, &next) + SETTLE + LOOK;
        at = next;
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
