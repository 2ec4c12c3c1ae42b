//! How well a pose explains the edges, as a log-likelihood ratio against chance.
//!
//! **In:** a refined pose's sites with the edges across them. **Out:** the sum over the contour of
//! `log(P(edges | the contour is here) / P(edges | something else is here))`, the share of the
//! contour explained, and the edges' scatter. How often chance puts an edge near a place is
//! measured along the very profiles, away from the contour: in print and clutter an edge in the
//! right place proves little, on a plain table much.

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
    /// Root mean square distance of the edges that belong (px).
    pub scatter_px: f64,
}

/// Chance edges per pixel are never taken to be fewer.
const LEAST_DENSITY: f64 = 0.02;
/// An edge belongs to the contour within this many deviations.
const BELONGS: f64 = 2.5;

/// Weighs the sites of a pose; `range_px` is how far they looked, `sd_px` the edges' deviation.
pub fn weigh(sites: &[Site], range_px: f64, sd_px: f64) -> Explained {
    let near = (3.0 * sd_px).min(0.5 * range_px);
    let (mut strays, mut swept) = (0.0, 0.0);
    for site in sites {
        strays += site.edges().iter().filter(|c| c.offset.abs() > near).count() as f64;
        swept += 2.0 * (range_px - near);
    }
    let density = ((strays + 1.0) / (swept + 10.0)).max(LEAST_DENSITY);
    let (mut evidence, mut covered, mut length) = (0.0, 0.0, 0.0);
    let (mut squares, mut belonging) = (0.0, 0.0);
    for site in sites {
        let missing = absence(site.kind);
        let sd_px = deviation(site, sd_px);
        let peak = 1.0 / (sd_px * (2.0 * std::f64::consts::PI).sqrt());
        let places = if site.inner.is_some() { 2.0 } else { 1.0 };
        let (mut likelihood, mut nearest) = (0.0, f64::INFINITY);
        for (place, _) in site.places() {
            for c in site.edges() {
                let r = c.offset - place;
                likelihood += c.weight * peak / places * (-0.5 * (r / sd_px).powi(2)).exp();
                nearest = nearest.min(r.abs());
            }
        }
        let ratio = missing + (1.0 - missing) * likelihood / density;
        evidence += ratio.ln() * independent(site);
        let weight = site.length * if site.kind == Kind::Crease { 0.5 } else { 1.0 };
        length += weight;
        if nearest < BELONGS * sd_px {
            covered += weight;
            squares += weight * nearest * nearest;
            belonging += weight;
        }
    }
    Explained {
        evidence,
        coverage: if length > 0.0 { covered / length } else { 0.0 },
        scatter_px: if belonging > 0.0 { (squares / belonging).sqrt() } else { sd_px },
    }
}
