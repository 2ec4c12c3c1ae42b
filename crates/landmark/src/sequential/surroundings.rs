//! What changes in the surroundings of one place: the edge of a screen, a passing shadow.
//!
//! Points on two rings, too far away to see much of the light itself, are searched for time courses that they
//! share. A course that is stronger on the ring than at the place leaks in from outside and is
//! projected out there; one that is weaker on the ring leaks out (the ghosts that JPEG makes of a
//! strong light) and is left alone.

use super::history::History;
use super::nuisance::{Nuisance, dot, strongest};

/// The rings. The outer lies beyond the reach of filter and light together; on the inner the place's
/// own light shows with a twentieth at most, so that it cannot pass for something from outside.
const RING: [(i64, i64); 24] = [
    (6, 0),
    (6, 3),
    (5, 5),
    (3, 6),
    (0, 6),
    (-3, 6),
    (-5, 5),
    (-6, 3),
    (-6, 0),
    (-6, -3),
    (-5, -5),
    (-3, -6),
    (0, -6),
    (3, -6),
    (5, -5),
    (6, -3),
    (3, 0),
    (3, 3),
    (0, 3),
    (-3, 3),
    (-3, 0),
    (-3, -3),
    (0, -3),
    (3, -3),
];

/// A course counts when it carries this many times the energy that noise gives one point.
const OUTSTANDING: f32 = 4.0;

/// Most courses that are taken out.
const MOST: usize = 3;

/// The courses that leak into a place (unit length, free of the common nuisances).
pub fn intruders(
    history: &History,
    (x, y): (usize, usize),
    centre: &[f32],
    nuisance: &Nuisance,
    noise: f64,
) -> Vec<Vec<f32>> {
    let (width, height) = (history.size().0 as i64, history.size().1 as i64);
    let n = history.len();
    let mut table = Vec::with_capacity(RING.len() * n);
    let mut series = Vec::with_capacity(n);
    for (dx, dy) in RING {
        let (u, v) = (x as i64 + dx, y as i64 + dy);
        if u >= 0 && v >= 0 && u < width && v < height {
            history.series_at((u as usize, v as usize), &mut series);
            nuisance.remove(&mut series);
            table.extend_from_slice(&series);
        }
    }
    let mut centre = centre.to_vec();
    nuisance.remove(&mut centre);
    let limit = OUTSTANDING * noise as f32 * n as f32;
    let mut found: Vec<Vec<f32>> = Vec::new();
    while found.len() < MOST {
        let Some((course, strengths)) = strongest(&table, n) else { break };
        let largest = strengths.iter().fold(0.0f32, |m, s| m.max(s.abs()));
        if largest * largest < limit {
            break;
        }
        for (row, strength) in table.chunks_exact_mut(n).zip(&strengths) {
            row.iter_mut().zip(&course).for_each(|(v, c)| *v -= strength * c);
        }
        if dot(&centre, &course).abs() > largest {
            break;
        }
        found.push(course);
    }
    found
}
