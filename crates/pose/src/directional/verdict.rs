//! How well a pose explains the edges, as a log-likelihood ratio against chance.
//!
//! **In:** a refined pose's sites with the edges across them. **Out:** the sum over the contour's
//! parts of `log(P(edges | the contour is here) / P(edges | something else is here))`, and the share
//! of the contour explained. How often chance puts an edge near a place is measured along the very
//! profiles, away from the contour: in print and clutter an edge in the right place proves little,
//! on a plain table much.
//!
//! A part (an edge of a box, a rim, the side of a wall) is judged as a whole. Where the record has
//! it is not quite where it is, but then all its edges are off by the same; and which side of it is
//! the brighter seldom changes along it. Chance edges agree in neither. Both are unknown, so both
//! are summed out: the offset on a grid with the heavy-tailed prior that the refinement uses, the
//! bright side over outer, inner and "changes".

use super::equations::OFFSET_TAIL;
use super::refine::{absence, deviation, independent};
use super::sites::Site;
use crate::model::Kind;

/// What a pose explains.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Explained {
    /// Log-likelihood ratio against chance (nats).
    pub evidence: f64,
    /// Share of the visible contour that lies on edges, creases counted half.
    pub coverage: f64,
}

/// Nats of edges to one of evidence: neighbouring parts, and what both views see of a part, fail
/// together (an occluder, a lamp), so edges prove less than their number says.
const NATS_TO_ONE: f64 = 2.0;
/// Chance edges per pixel are never taken to be fewer.
const LEAST_DENSITY: f64 = 0.02;
/// Length of profile (px) that the whole contour's density of chance edges counts for in a part's.
const DENSITY_PRIOR_PX: f64 = 30.0;
/// An edge belongs to the contour within this many deviations.
const BELONGS: f64 = 2.5;
/// Points of the grid of a part's offset to either side, and their spacing (deviations).
const REACH: usize = 6;
const STEP: f64 = 0.5;
const GRID: usize = 2 * REACH + 1;
/// Deviation of a site from its part's offset, against the deviation of the offset: parts are tilted
/// and bent too.
const BENT: f64 = 0.3;
/// Probability that the bright side changes along a part, as the background's or the print's
/// brightness does, and that a single edge of a part that keeps it shows the wrong side.
const CHANGES: f64 = 0.3;
const WRONG_SIDE: f64 = 0.1;

/// Weighs the sites of a pose; `range_px` is how far they looked, `sd_px` the edges' deviation.
pub fn weigh(sites: &[Site], range_px: f64, sd_px: f64) -> Explained {
    let near = (3.0 * sd_px).min(0.5 * range_px);
    let strays = |sites: &[Site]| -> f64 {
        let edges = sites.iter().flat_map(Site::edges);
        edges.filter(|c| c.offset.abs() > near).map(|c| c.weight).sum()
    };
    let swept = |sites: &[Site]| 2.0 * (range_px - near) * sites.len() as f64;
    let usual = ((strays(sites) + 1.0) / (swept(sites) + 10.0)).max(LEAST_DENSITY);
    let (mut evidence, mut covered, mut length) = (0.0, 0.0, 0.0);
    for part in sites.chunk_by(|a, b| (a.view, a.part, a.kind) == (b.view, b.part, b.kind)) {
        let density = (strays(part) + DENSITY_PRIOR_PX * usual) / (swept(part) + DENSITY_PRIOR_PX);
        evidence += part_evidence(part, sd_px, density.max(LEAST_DENSITY));
        for site in part {
            let weight = site.length * if site.kind == Kind::Crease { 0.5 } else { 1.0 };
            let within = BELONGS * deviation(site, sd_px);
            let on = |place: f64| site.edges().iter().any(|c| (c.offset - place).abs() < within);
            length += weight;
            covered += if site.places().any(|(place, _)| on(place)) { weight } else { 0.0 };
        }
    }
    Explained {
        evidence: evidence / NATS_TO_ONE,
        coverage: if length > 0.0 { covered / length } else { 0.0 },
    }
}

/// Log-likelihood ratio of one part in one view, its offset and its bright side summed out.
fn part_evidence(part: &[Site], sd_px: f64, density: f64) -> f64 {
    let at = |j: usize| (j as f64 - REACH as f64) * STEP;
    // By offset, and by bright side: outer, inner, either.
    let mut sums = [[0.0f64; 3]; GRID];
    for site in part {
        let missing = absence(site.kind);
        let common = site.offset_sd() * site.px_per_metre;
        let local = sd_px.hypot(BENT * common);
        let places = if site.inner.is_some() { 2.0 } else { 1.0 };
        let mut likelihood = [[0.0f64; 2]; GRID];
        for (place, _) in site.places() {
            for c in site.edges() {
                let sd = local.hypot(c.noise_px);
                let peak = c.weight / (places * sd * (2.0 * std::f64::consts::PI).sqrt() * density);
                let outer = usize::from(c.slope > 0.0);
                for (j, l) in likelihood.iter_mut().enumerate() {
                    let r = (c.offset - place - at(j) * common) / sd;
                    l[outer] += peak * (-0.5 * r * r).exp();
                }
            }
        }
        let worth = independent(site);
        for (sum, [inner, outer]) in sums.iter_mut().zip(likelihood) {
            let one_side = |l: f64, other: f64| 2.0 * (l + WRONG_SIDE * (other - l));
            let sides = [one_side(outer, inner), one_side(inner, outer), inner + outer];
            for (s, l) in sum.iter_mut().zip(sides) {
                *s += worth * (missing + (1.0 - missing) * l).ln();
            }
        }
    }
    let most = sums.iter().flatten().fold(f64::NEG_INFINITY, |a, &b| a.max(b));
    let (mut total, mut priors) = (0.0, 0.0);
    for (j, sum) in sums.iter().enumerate() {
        // Student's t.
        let prior = (1.0 + at(j).powi(2) / OFFSET_TAIL).powf(-0.5 * (OFFSET_TAIL + 1.0));
        let [outer, inner, either] = sum.map(|s| (s - most).exp());
        total += prior * (0.5 * (1.0 - CHANGES) * (outer + inner) + CHANGES * either);
        priors += prior;
    }
    most + (total / priors).ln()
}
