//! What is missing when sightings do not determine a head.

use nalgebra::{Point3, Vector3};

use super::{Calibration, KnownLength, LightPlace, Missing, middle};
use crate::PanTiltHead;

/// Fewest sightings of one head: each gives two numbers for 22 unknowns and a share in the lights.
const FEWEST_FIXATIONS: usize = 24;
/// A joint that turns less (rad) leaves its axis undetermined.
const SMALLEST_SPAN: f64 = 0.35;
/// The light must cross this part of the picture for focal length and lens.
const SMALLEST_PART: f64 = 0.4;
/// Farthest over nearest place.
const SMALLEST_RATIO: f64 = 1.3;
const SIDES: [&str; 2] = ["left", "right"];
const JOINTS: [&str; 2] = ["pan", "tilt"];

/// What is missing before any calculation: too few sightings.
pub(super) fn missing_at_sight(heads: &[PanTiltHead; 2], places: &[LightPlace]) -> Vec<Missing> {
    (0..heads.len())
        .filter_map(|k| {
            let have = places.iter().map(|p| p.fixations[k].len()).sum();
            let need = FEWEST_FIXATIONS;
            (have < need).then_some(Missing::Fixations { head: SIDES[k], have, need })
        })
        .collect()
}

/// Largest predicted error of a distance 1 m away: ahead, to both sides, below.
pub(super) fn worst_distance_sigma(calibration: &Calibration) -> f64 {
    let from = middle(&calibration.heads);
    let directions = [(0.0, 0.0), (0.5, 0.2), (-0.5, 0.2), (0.0, 0.5)];
    directions
        .into_iter()
        .map(|(pan, tilt): (f64, f64)| {
            let direction =
                Vector3::new(tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), -tilt.sin());
            let point: Point3<f64> = from + direction;
            calibration.distance_sigma(&point).unwrap_or(f64::INFINITY)
        })
        .fold(0.0, f64::max)
}

/// What to add, judged by how the head and the light were moved.
pub(super) fn missing_after(
    calibration: &Calibration,
    places: &[LightPlace],
    lengths: &[KnownLength],
) -> Vec<Missing> {
    let mut missing = Vec::new();
    // One known place says where, two say how far apart.
    if lengths.is_empty() && places.iter().filter(|p| p.known.is_some()).count() < 2 {
        missing.push(Missing::Scale);
    }
    for k in 0..2 {
        let fixations = || places.iter().flat_map(|p| p.fixations[k].iter());
        for joint in 0..2 {
            let span = span(fixations().map(|f| f.angles[joint]));
            if span < SMALLEST_SPAN {
                missing.push(Missing::Turn { head: SIDES[k], joint: JOINTS[joint], span });
            }
        }
        let camera = &calibration.heads[k].camera;
        let part = span(fixations().map(|f| f.pixel.x)) / camera.width as f64;
        if part < SMALLEST_PART {
            missing.push(Missing::Picture { head: SIDES[k], part });
        }
    }
    let from = middle(&calibration.heads);
    let distances = || calibration.lights.iter().map(|p| (p - from).norm());
    let nearest = distances().fold(f64::INFINITY, f64::min);
    let ratio = distances().fold(0.0, f64::max) / nearest.max(1e-6);
    if ratio < SMALLEST_RATIO {
        missing.push(Missing::Depth { ratio });
    }
    if missing.is_empty() {
        missing.push(Missing::More);
    }
    missing
}

fn span(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let highest = values.clone().fold(f64::NEG_INFINITY, f64::max);
    highest - values.fold(f64::INFINITY, f64::min)
}
