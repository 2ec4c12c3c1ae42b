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
//! bright side over outer, inner and "changes". So is which edge of a lip shows: the outer one, the
//! inner one, or both, which tells an open rim from a closed one.

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

/// Sites whose ratios are multiplied before a logarithm is taken: it stays far from overflow.
const PRODUCT: usize = 24;
/// Edges further than this many deviations from all places that the grid allows count nothing.
const FAR: f64 = 5.0;

/// How often the outer and the inner edge of a lip show along a rim, any of the three as likely: a lip
/// has one colour, and what is beside it seldom changes.
const LIP_SHOWS: [[f64; 2]; 3] = [[1.0, 0.1], [0.1, 1.0], [1.0, 1.0]];

/// Log-likelihood ratio of one part in one view, with its offset, its bright side and what shows of a
/// lip summed out.
fn part_evidence(part: &[Site], sd_px: f64, density: f64) -> f64 {
    let at = |j: usize| (j as f64 - REACH as f64) * STEP;
    let lip = part.iter().any(|site| site.inner.is_some());
    let shows = if lip { &LIP_SHOWS[..] } else { &[[1.0, 0.0]] };
    // By what shows, by bright side (outer, inner, either) and by offset.
    let mut sums = vec![[[0.0f64; GRID]; 3]; shows.len()];
    let mut product = sums.clone();
    for sites in part.chunks(PRODUCT) {
        product.fill([[1.0; GRID]; 3]);
        for site in sites {
            let missing = absence(site);
            let scale = (1.0 - missing) / density;
            let outer = likelihoods(site, 0.0, sd_px, scale);
            let inner = site.inner.map(|place| (place, likelihoods(site, place, sd_px, scale)));
            for (product, shows) in product.iter_mut().zip(shows) {
                let [dark, bright] = shown(&outer, inner.as_ref(), shows, sd_px);
                for j in 0..GRID {
                    let (a, b) = (bright[j], dark[j]);
                    product[0][j] *= missing + 2.0 * (a + WRONG_SIDE * (b - a));
                    product[1][j] *= missing + 2.0 * (b + WRONG_SIDE * (a - b));
                    product[2][j] *= missing + a + b;
                }
            }
        }
        let factors = product.iter().flatten().flatten();
        sums.iter_mut().flatten().flatten().zip(factors).for_each(|(s, f)| *s += f.ln());
    }
    let worth = part.iter().map(independent).sum::<f64>() / part.len() as f64;
    let most = sums.iter().flatten().flatten().fold(f64::NEG_INFINITY, |a, &b| a.max(b));
    let (mut total, mut priors) = (0.0, 0.0);
    for j in 0..GRID {
        // Student's t.
        let prior = (1.0 + at(j).powi(2) / OFFSET_TAIL).powf(-0.5 * (OFFSET_TAIL + 1.0));
        for sums in &sums {
            let [outer, inner, either] = [0, 1, 2].map(|m| (worth * (sums[m][j] - most)).exp());
            total += prior * (0.5 * (1.0 - CHANGES) * (outer + inner) + CHANGES * either);
            priors += prior;
        }
    }
    worth * most + (total / priors).ln()
}

/// By bright side and for every offset of the grid.
type Likelihoods = [[f64; GRID]; 2];

/// Likelihoods of a lip's outer edge and, with its place (px), of the inner, as often as either shows.
fn shown(
    outer: &Likelihoods,
    inner: Option<&(f64, Likelihoods)>,
    shows: &[f64; 2],
    sd_px: f64,
) -> Likelihoods {
    let mut edge = outer.map(|side| side.map(|l| shows[0] * l));
    if let Some((place, inner)) = inner {
        // Edges too close to be two must not count twice.
        let same = (-0.25 * (place / sd_px).powi(2)).exp();
        let share = shows[1] * (1.0 - same * shows[0].min(shows[1]));
        for (edge, l) in edge.iter_mut().flatten().zip(inner.iter().flatten()) {
            *edge += share * l;
        }
    }
    edge
}

/// How likely the edges of a site are for a contour at this place (px along the normal), those brighter
/// inside and those brighter outside, for every offset of the grid; all times `scale`.
fn likelihoods(site: &Site, place: f64, sd_px: f64, scale: f64) -> Likelihoods {
    let mut sums = [[0.0; GRID]; 2];
    let common = site.offset_sd() * site.px_per_metre;
    let local = sd_px.powi(2) + (BENT * common).powi(2);
    for c in site.edges() {
        let r = c.offset - place;
        let sd = (local + c.noise_px * c.noise_px).sqrt();
        let step = STEP * common / sd;
        let first = r / sd + REACH as f64 * step;
        if r.abs() > FAR * sd + REACH as f64 * STEP * common {
            continue;
        }
        let peak = scale * c.weight / (sd * (2.0 * std::f64::consts::PI).sqrt());
        add_gaussian(&mut sums[usize::from(c.slope > 0.0)], peak, first, step);
    }
    sums
}

/// Adds a Gaussian's values on an even grid that begins `first` deviations from its middle and goes on in
/// steps of so many: its logarithm has constant second differences.
#[inline]
pub(super) fn add_gaussian<const N: usize>(sums: &mut [f64; N], peak: f64, first: f64, step: f64) {
    let mut value = peak * (-0.5 * first * first).exp();
    let mut ratio = (step * first - 0.5 * step * step).exp();
    let change = (-step * step).exp();
    for sum in sums {
        *sum += value;
        value *= ratio;
        ratio *= change;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directional::sites::Candidate;

    /// Forty sites of one part with an edge each, at these offsets (px) and slopes.
    fn part(edge: impl Fn(usize) -> (f64, f32)) -> Vec<Site> {
        let site = |k: usize| {
            let (offset, slope) = edge(k);
            let found = Candidate { offset, weight: 1.0, noise_px: 0.1, slope };
            let candidates = [found, Candidate::default(), found, found];
            Site { along: 0.002 * k as f64, candidates, count: 1, ..Site::bare() }
        };
        (0..40).map(site).collect()
    }

    fn evidence(sites: &[Site]) -> f64 {
        weigh(sites, 4.0, 0.4).evidence
    }

    #[test]
    fn edges_that_agree_prove_more_than_edges_that_scatter() {
        // All half a pixel off to one side against half a pixel off to either side in turn.
        let shifted = evidence(&part(|_| (0.5, 5.0)));
        let scattered = evidence(&part(|k| (if k % 2 == 0 { 0.5 } else { -0.5 }, 5.0)));
        assert!(shifted > scattered + 1.0, "{shifted:.1} against {scattered:.1}");
        let flickering = evidence(&part(|k| (0.5, if k % 2 == 0 { 5.0 } else { -5.0 })));
        assert!(shifted > flickering + 1.0, "{shifted:.1} against {flickering:.1}");
    }

    #[test]
    fn a_lip_proves_more_when_it_shows_alike_all_along_and_most_by_both_edges() {
        let lip = |sites: Vec<Site>| {
            let rim = |s| Site { kind: Kind::Rim, inner: Some(-1.0), ..s };
            evidence(&sites.into_iter().map(rim).collect::<Vec<_>>())
        };
        let outer = lip(part(|_| (0.0, 5.0)));
        let flickering = lip(part(|k| (if k % 2 == 0 { 0.0 } else { -1.0 }, 5.0)));
        assert!(outer > flickering + 0.5, "{outer:.1} against {flickering:.1}");
        let mut both = part(|_| (0.0, 5.0));
        for site in &mut both {
            site.candidates[1] = Candidate { offset: -1.0, ..site.candidates[0] };
            site.count = 2;
        }
        let both = lip(both);
        assert!(both > outer + 0.5, "{both:.1} against {outer:.1}");
        // A lip too thin to be seen: its one edge proves no more than a plain one.
        let thin = |s| Site { kind: Kind::Rim, inner: Some(-0.1), ..s };
        let thin: Vec<Site> = part(|_| (0.0, 5.0)).into_iter().map(thin).collect();
        let plain: Vec<Site> = thin.iter().map(|s| Site { inner: None, ..s.clone() }).collect();
        let (thin, plain) = (evidence(&thin), evidence(&plain));
        assert!((thin - plain).abs() < 0.2, "{thin:.2} against {plain:.2}");
    }

    #[test]
    fn a_part_without_edges_speaks_against_the_pose_and_covers_nothing() {
        let missing = weigh(&part(|_| (3.9, 5.0)), 4.0, 0.4);
        assert!(missing.evidence < -2.0, "{:.1}", missing.evidence);
        assert_eq!(missing.coverage, 0.0);
    }

    #[test]
    fn a_long_part_overflows_nothing() {
        let sites: Vec<Site> = (0..60).flat_map(|_| part(|_| (0.0, 5.0))).collect();
        let explained = weigh(&sites, 4.0, 0.4);
        assert!(explained.evidence.is_finite(), "{}", explained.evidence);
        assert_eq!(explained.coverage, 1.0);
    }
}
