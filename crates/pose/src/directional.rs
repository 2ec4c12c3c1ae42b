//! The default method: a search over all rotations on directional distance fields, refinement of
//! all six unknowns, and a verdict.
//!
//! Reads top to bottom: gradients where the object can be ([`level`]), oriented edges ([`edges`]),
//! directional fields ([`field`]), rotations that explain them ([`search`]), refinement on sub-pixel
//! edges with several candidates a site ([`sites`], [`refine`]), the tops nearby and the print that both
//! views see on the object and on what it rests on ([`neighbours`], [`print`]), and how much the best
//! explains that a different pose would not ([`verdict`]).

mod ascent;
pub mod edges;
mod equations;
pub mod field;
pub mod landmark;
pub mod level;
mod neighbours;
pub mod picture;
pub mod print;
pub mod refine;
pub mod search;
pub mod sites;
pub mod verdict;

use std::f64::consts::PI;

use nalgebra::{Point2, Point3, Vector2, Vector3};
use vergence_geometry::{GaussianPose, Transform};

use crate::model::Model;
use crate::rotations;
use crate::types::{Alternative, ObjectPose, Query, Refusal, View, check};
use field::Field;
use level::{Reduced, Region};
use print::Patch;
use refine::{FINAL, Pass, Refined};
use search::{Search, Sight};
use sites::Site;
use verdict::Explained;

/// Roughly refined poses that get their chance however far behind (nats) they are, and how far behind
/// others may be: the rough contour of a tilted or hidden object may explain little.
const SURE_FINALISTS: usize = 3;
const BEHIND: f64 = 15.0;

/// What a refined pose may be behind (nats) and still turn out to be the best once it has ascended.
const OVERTAKES: f64 = 10.0;

/// Smoothing before the search's edges (px of the working scale): enough to average noise.
const SEARCH_BLUR_PX: f32 = 0.7;
/// Smoothing before edges are placed (px): hardly any, or neighbouring edges shift each other. Noise
/// is averaged along the contour instead, where nothing else is lost.
const PLACE_BLUR_PX: f32 = 0.35;

/// Passes at full resolution, down to how well edges fit.
const FINE: [Pass; 2] = [Pass::new(0.6, 4.0, 2.5, true), FINAL];

/// Passes from a pose that is off by some pixels: what is wider than [`FINE`], and that.
const NEAR: [Pass; 4] =
    [Pass::new(2.0, 8.0, 4.0, true), Pass::new(1.0, 4.0, 2.5, true), FINE[0], FINE[1]];

/// Alternatives reported.
const MOST_ALTERNATIVES: usize = 4;

/// Settings of the directional method.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// The working scale is halved until the object's reach around its landmark is at most this
    /// (px): the search needs no more, and its time grows with the square.
    pub reach_px: f64,
    /// Spacing of the grid of all rotations (rad).
    pub grid_spacing: f64,
    /// Step of a standing object's turn about the vertical (rad).
    pub turn_step: f64,
    /// Rotations that the other views judge after the first has ranked all.
    pub shortlist: usize,
    /// Hypotheses improved on the fields.
    pub seeds: usize,
    /// Halvings of the step while improving, from half the grid's spacing.
    pub climb_halvings: usize,
    /// Shares of the best one's evidence that a hypothesis must have to be improved on the fields,
    /// and then to be refined: what is far behind there has never won.
    pub worth_a_climb: f32,
    /// See `worth_a_climb`.
    pub worth: f32,
    /// Hypotheses refined on the pictures at the working scale, at most.
    pub refined: usize,
    /// Of those, how many are refined at full resolution at most.
    pub finalists: usize,
    /// Cosine between the landmark's normal and the line of sight below which no camera sees it.
    pub grazing: f64,
    /// Roughly refined poses nearer than this (rad) are one: the finer refinement joins them.
    pub distinct: f64,
    /// Poses that differ by more than this turn (rad), or are as far apart as a turn by this about the
    /// object's middle moves its furthest corner, count as different in the verdict.
    pub different: f64,
    /// So do those that are further apart than this (m), however large the object.
    pub different_place: f64,
    /// Share of the contour that must lie on edges.
    pub least_coverage: f64,
    /// Evidence against chance (nats) below which the best pose is refused: odds as against other
    /// poses.
    pub least_evidence: f64,
    /// Belief in the best pose below which it is refused.
    pub least_confidence: f64,
    /// Turn (rad) between two pictures beyond which a tracked object counts as lost.
    pub most_turn: f64,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            reach_px: 115.0,
            grid_spacing: 9f64.to_radians(),
            turn_step: 3f64.to_radians(),
            shortlist: 400,
            seeds: 32,
            climb_halvings: 3,
            worth_a_climb: 0.4,
            worth: 0.6,
            refined: 16,
            finalists: 6,
            grazing: 0.1,
            distinct: 2f64.to_radians(),
            different: 12f64.to_radians(),
            different_place: 0.01,
            least_coverage: 0.55,
            least_evidence: 2.2,
            least_confidence: 0.9,
            most_turn: 15f64.to_radians(),
        }
    }
}

/// What a recognition saw on its way, for pictures.
pub struct Trace<'a> {
    /// The prepared views.
    pub sights: Vec<Sight<'a>>,
    /// The object's form.
    pub model: Model,
    /// Refined poses that differ, best first.
    pub poses: Vec<Transform>,
    /// The sites of the best pose.
    pub sites: Vec<Site>,
    /// The print that two views share of it.
    pub patches: Vec<Patch>,
}

/// The object's pose from the edges of one or two pictures, its rotation unknown. Of more pictures the
/// first two that can show the object count.
pub fn recognise(views: &[View], query: &Query, config: &Config) -> Result<ObjectPose, Refusal> {
    recognise_traced(views, query, config).map_or_else(Err, |(result, _)| result)
}

/// [`recognise`] with what it saw, unless it could not even begin.
pub fn recognise_traced<'a>(
    views: &[View<'a>],
    query: &Query,
    config: &Config,
) -> Result<(Result<ObjectPose, Refusal>, Trace<'a>), Refusal> {
    let (landmark, normal) = check(views, query)?;
    let model = Model::new(query.record);
    let sights = prepare(views, query, landmark, config, true);
    if sights.is_empty() {
        return Err(Refusal::OutOfView);
    }
    let search = Search::new(&sights, &model, query, (landmark, normal), config);
    let hypotheses = search.hypotheses();
    let rough = hypotheses.iter().map(|h| search.refine_roughly(&h.pose, h.rests)).collect();
    let rough = search.ranked(rough, |a, b| search.are_alike(a, b, config.distinct, f64::INFINITY));
    let fine = search.finalists(rough).into_iter().map(|r| search.refine_finely(r)).collect();
    let mut fine = search.ranked(fine, |a, b| search.is_same(a, b));
    let least = fine.first().map_or(0.0, |best| best.1.evidence) - OVERTAKES;
    for found in fine.iter_mut().filter(|found| found.1.evidence > least) {
        search.ascend(found);
    }
    let mut fine = search.ranked(fine, |a, b| search.is_same(a, b));
    if let Some(twins) = fine.first().map(|best| search.twins(&best.0)) {
        fine.extend(twins);
    }
    let mut different = search.ranked(fine, |a, b| search.is_same(a, b));
    search.heed_ground(&mut different);
    if let Some(best) = different.first_mut() {
        search.settle(best);
    }
    let result = search.verdict(&different);
    let poses = different.iter().map(|(r, _)| r.pose).collect();
    let best = different.into_iter().next().map(|(best, _)| (best.sites, best.patches));
    let (sites, patches) = best.unwrap_or_default();
    Ok((result, Trace { sights, model, poses, sites, patches }))
}

/// Follows an object from picture to picture: the pose near the `last` one, without a search, or
/// that it was lost. The landmark need not blink meanwhile, but its place must be kept up to date
/// (the last pose gives it), with a covariance that says how far the object may have moved.
pub fn track(
    views: &[View],
    query: &Query,
    last: &Transform,
    config: &Config,
) -> Result<ObjectPose, Refusal> {
    let (landmark, normal) = check(views, query)?;
    let model = Model::new(query.record);
    let sights = prepare(views, query, landmark, config, false);
    if sights.is_empty() {
        return Err(Refusal::OutOfView);
    }
    let search = Search::new(&sights, &model, query, (landmark, normal), config);
    let (rough, _) = search.refine_roughly(last, false);
    let mut best = search.refine_finely(rough);
    if search.scale() > 1.0 {
        // From one picture to the next there is little to make up for, and what is right to a pixel of a
        // reduced picture can lead away from it.
        for passes in [&NEAR[..], &FINE] {
            let mut near = Refined::new(last, false);
            search.refine(&mut near, passes);
            let near = search.both(near);
            if near.1.evidence > best.1.evidence {
                best = near;
            }
        }
    }
    search.settle(&mut best);
    let found = search.verdict(&[best])?;
    let turned = search.symmetry.angle_between(&found.pose.pose.rotation, &last.rotation);
    if turned > config.most_turn {
        return Err(Refusal::Lost { turned_deg: turned.to_degrees(), best: Box::new(found) });
    }
    Ok(found)
}

/// Room for what the object's size and attitude may be off by (m), and for profiles across its
/// contour (px).
const SLACK: f64 = 0.01;
const MARGIN_PX: f64 = 8.0;

/// Points around all places of an object that is known to stand, whatever its turn about the
/// vertical: two rings about the landmark's vertical. Empty when it may have any attitude.
fn around(query: &Query, landmark: Vector3<f64>, half: Vector3<f64>) -> Vec<Point3<f64>> {
    let (Some(up), Some(true)) = (query.up, query.standing) else { return Vec::new() };
    const RING: usize = 16;
    // A polygon of so many corners holds the circle when it is that much larger.
    let slack = SLACK + 2.0 * query.landmark.covariance.trace().sqrt();
    let radius = ((landmark.abs() + half).xy().norm() + slack) / (PI / RING as f64).cos();
    let heights = [-half.z - slack, half.z + slack].map(|z| z - landmark.z);
    let ring = |z: f64| {
        rotations::standing(up, -Vector3::z_axis(), RING)
            .map(move |turn| query.landmark.position + turn * Vector3::new(radius, 0.0, z))
    };
    heights.into_iter().flat_map(ring).collect()
}

/// The part of a view that holds some points (base), but nothing further from the landmark's pixel than
/// the object reaches, however uncertain their place is. Without points, or when one is behind the
/// camera, all that the object reaches.
fn region(
    view: &View,
    around: &[Point3<f64>],
    pixel: &Point2<f64>,
    reach_px: f64,
) -> Option<Region> {
    let reach = Vector2::repeat(reach_px);
    let seen = |p: &Point3<f64>| {
        let place = view.camera.project(&view.base_from_optical.inverse_transform_point(p))?;
        Some((pixel - reach).sup(&(pixel + reach).inf(&place)))
    };
    let places: Option<Vec<_>> = around.iter().map(seen).collect();
    let (width, height) = (view.image.width(), view.image.height());
    match places.filter(|p| !p.is_empty()) {
        Some(places) => Region::around(&places, MARGIN_PX, width, height),
        None => Region::around(&[*pixel], reach_px, width, height),
    }
}

/// Levels of the views that can show the object; edges and fields when there is to be a search.
fn prepare<'a>(
    views: &[View<'a>],
    query: &Query,
    landmark: Vector3<f64>,
    config: &Config,
    search: bool,
) -> Vec<Sight<'a>> {
    let half = Vector3::from(query.record.bounding_box.sides()) / 2.0;
    // The corner furthest from the landmark bounds what the object can reach.
    let reach = (landmark.abs() + half).norm() + SLACK;
    let around = around(query, landmark, half);
    views
        .iter()
        .filter_map(|view| {
            let optical_from_base = view.base_from_optical.inverse();
            let p = optical_from_base * query.landmark.position;
            let pixel = view.camera.project(&p)?;
            let depth = (p.z - reach).max(0.5 * p.z);
            let reach_px = reach * view.camera.fx.max(view.camera.fy) / depth + MARGIN_PX;
            let mut scale = 1;
            let largest = view.image.width().max(view.image.height());
            while reach_px / scale as f64 > config.reach_px && scale < largest {
                scale *= 2;
            }
            let region = region(view, &around, &pixel, reach_px)?;
            let full = Reduced::new(view.image, &region, 1);
            let fine = full.smoothed(PLACE_BLUR_PX);
            let reduced = if scale > 1 { Reduced::new(view.image, &region, scale) } else { full };
            let coarse = reduced.smoothed(SEARCH_BLUR_PX);
            let field = if search {
                Field::new(&edges::edgels(&coarse), coarse.width(), coarse.height())
            } else {
                Field::default()
            };
            let straight = view.camera.distortion.is_none();
            Some(Sight { view: *view, optical_from_base, straight, coarse, fine, field })
        })
        .take(equations::VIEWS)
        .collect()
}

impl Search<'_> {
    /// Pixels of the picture to one of the working scale.
    fn scale(&self) -> f64 {
        self.sights.iter().map(|s| s.coarse.scale).max().unwrap_or(1) as f64
    }

    /// Refinement at the working scale, wide and coarse: enough to tell which hypothesis is right.
    fn refine_roughly(&self, start: &Transform, rests: bool) -> (Refined, Explained) {
        let s = self.scale();
        let passes = [(2.0, 5.0, 5.0), (1.0, 3.0, 5.0)]
            .map(|(sd, range, spacing)| Pass::new(s * sd, s * range, s * spacing, false));
        let mut refined = Refined::new(start, rests);
        self.refine(&mut refined, &passes);
        self.weigh(refined, &Pass::new(0.5 * s, 4.0 * s, 3.0 * s, false))
    }

    /// Those worth the full resolution: the best, and as long as they are not far behind, others.
    fn finalists(&self, rough: Vec<(Refined, Explained)>) -> Vec<Refined> {
        let best = rough.first().map_or(0.0, |r| r.1.evidence);
        let few = rough.into_iter().take(self.config.finalists).enumerate();
        let worth = few.filter(|(k, r)| *k < SURE_FINALISTS || best - r.1.evidence < BEHIND);
        worth.map(|(_, r)| r.0).collect()
    }

    /// Refinement down to full resolution.
    fn refine_finely(&self, mut refined: Refined) -> (Refined, Explained) {
        let mut passes = Vec::new();
        let mut s = self.scale();
        while s > 1.0 {
            s /= 2.0;
            passes.push(Pass::new(s, 4.0 * s, 2.5 * s, true));
        }
        passes.extend(FINE);
        self.refine(&mut refined, &passes);
        self.both(refined)
    }

    /// What a refined pose explains at both scales.
    fn both(&self, refined: Refined) -> (Refined, Explained) {
        // Print is fine, outlines are coarse: both scales have their say in what is explained.
        let s = self.scale();
        let fine = Pass::new(0.4, 4.0, 2.0, true);
        if s == 1.0 {
            return self.weigh(refined, &fine);
        }
        let (refined, coarse) = self.weigh(refined, &Pass::new(0.5 * s, 4.0 * s, 2.0 * s, false));
        let (refined, mut fine) = self.weigh(refined, &fine);
        fine.evidence = 0.5 * (fine.evidence + coarse.evidence);
        fine.coverage = fine.coverage.min(coarse.coverage);
        (refined, fine)
    }

    /// What a refined pose explains, priors included.
    fn weigh(&self, mut refined: Refined, pass: &Pass) -> (Refined, Explained) {
        self.lay_out(&mut refined, &pass.layout);
        let mut explained = verdict::weigh(&refined.sites, pass.layout.range_px, pass.sd_px);
        explained.evidence -= self.strain(&refined);
        (refined, explained)
    }

    /// Whether two poses are one answer to the verdict.
    fn is_same(&self, a: &Transform, b: &Transform) -> bool {
        self.are_alike(a, b, self.config.different, self.config.different_place)
    }

    /// Best first, without those that are alike a better one.
    fn ranked(
        &self,
        mut found: Vec<(Refined, Explained)>,
        alike: impl Fn(&Transform, &Transform) -> bool,
    ) -> Vec<(Refined, Explained)> {
        found.sort_by(|a, b| b.1.evidence.total_cmp(&a.1.evidence));
        let mut kept: Vec<(Refined, Explained)> = Vec::new();
        for candidate in found {
            let pose = &candidate.0.pose;
            if kept.iter().all(|k| !alike(&k.0.pose, pose)) {
                kept.push(candidate);
            }
        }
        kept
    }

    /// Poses whose contour is the same but for the tolerance of form, refined on their own: little
    /// but the landmark's place tells them apart.
    fn twins(&self, of: &Refined) -> Vec<(Refined, Explained)> {
        let stands = |p: &Transform| {
            let up = self.query.up.map_or(0.0, |up| (p.rotation * Vector3::z()).dot(&up));
            self.query.standing != Some(true) || up > 0.9
        };
        // Cut corners and rounded numbers make several motions of what is one.
        let mut twins = vec![of.pose];
        for pose in self.query.near_symmetries(self.model).iter().map(|s| of.pose * s) {
            if stands(&pose) && twins.iter().all(|twin| !self.is_same(&pose, twin)) {
                twins.push(pose);
            }
        }
        twins
            .into_iter()
            .skip(1)
            .map(|pose| {
                let mut twin = Refined { pose, ..of.without_sites() };
                self.refine(&mut twin, &FINE);
                self.both(twin)
            })
            .collect()
    }

    /// The best pose with its belief against the different ones, or a refusal.
    #[expect(clippy::neg_cmp_op_on_partial_ord, reason = "what is not a number is refused")]
    fn verdict(&self, different: &[(Refined, Explained)]) -> Result<ObjectPose, Refusal> {
        let Some(((best, explained), others)) = different.split_first() else {
            return Err(Refusal::NoAttitude);
        };
        let odds = |e: &Explained| (e.evidence - explained.evidence).exp();
        // That there is nothing is one more way to explain the edges: it has no evidence.
        let total =
            1.0 + odds(&Explained::default()) + others.iter().map(|o| odds(&o.1)).sum::<f64>();
        let others = others.iter().map(|o| (o.0.pose, odds(&o.1)));
        let mut alternatives: Vec<Alternative> =
            others.map(|(pose, odds)| Alternative { pose, confidence: odds / total }).collect();
        alternatives.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
        alternatives.truncate(MOST_ALTERNATIVES);
        let found = ObjectPose {
            pose: GaussianPose { pose: best.pose, covariance: best.covariance },
            confidence: 1.0 / total,
            coverage: explained.coverage,
            alternatives,
            symmetry: self.symmetry.clone(),
        };
        if !(found.coverage >= self.config.least_coverage) {
            return Err(Refusal::TooFewEdges { best: Box::new(found) });
        }
        if !(explained.evidence >= self.config.least_evidence) {
            return Err(Refusal::Chance { nats: explained.evidence, best: Box::new(found) });
        }
        if !(found.confidence >= self.config.least_confidence) {
            return Err(Refusal::Ambiguous { best: Box::new(found) });
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Unit};
    use vergence_geometry::GaussianPoint;
    use vergence_tag::Record;

    #[test]
    fn the_rings_hold_every_corner_of_a_standing_object() {
        let text = r#"{"object_id": "box", "landmarks": [{"position": [0.05, -0.03, 0.01], "normal": [1, 0, 0]}],
            "bounding_box": {"width": 0.10, "length": 0.16, "height": 0.07}, "shape": {"kind": "box"}}"#;
        let record: Record = serde_json::from_str(text).unwrap();
        let (landmark, half) = (Vector3::new(0.05, -0.03, 0.01), Vector3::new(0.05, 0.08, 0.035));
        for up in [Vector3::z(), -Vector3::z(), Vector3::new(0.3, -0.2, 0.9)] {
            let up = Unit::new_normalize(up);
            let position = Point3::new(0.6, 0.1, 0.2);
            let covariance = Matrix3::identity() * 1e-6;
            let mut query = Query {
                record: &record,
                landmark: GaussianPoint { position, covariance },
                landmark_index: 0,
                up: Some(up),
                standing: Some(true),
            };
            let rings = around(&query, landmark, half);
            let (below, above) = rings.split_at(rings.len() / 2);
            let height = |p: &Point3<f64>| (p - position).dot(&up);
            for turn in rotations::standing(up, -Vector3::z_axis(), 40) {
                for k in 0..8 {
                    let side = |bit: i32| if k & bit == 0 { -1.0 } else { 1.0 };
                    let corner = half.component_mul(&Vector3::new(side(1), side(2), side(4)));
                    let corner = position + turn * (corner - landmark);
                    assert!(height(&corner) > height(&below[0]));
                    assert!(height(&corner) < height(&above[0]));
                    // Inside of the polygon: on the inner side of each of its edges.
                    for (a, b) in above.iter().zip(above.iter().cycle().skip(1)) {
                        let outwards = (b - a).cross(&up);
                        let out = |p: &Point3<f64>| outwards.dot(&(p - a));
                        assert!(out(&corner) * out(&position) > 0.0, "{corner} by {up:?}");
                    }
                }
            }
            query.standing = None;
            assert!(around(&query, landmark, half).is_empty());
        }
    }
}
