//! Which rotations explain the edges: all are tried, the landmark holding the place.
//!
//! **In:** the views' [`Sight`]s, the model, the query. **Out:** a few poses that differ from one
//! another, best first, good to about a degree or two. Method: evidence of the visible contour in
//! the directional fields of all views (silhouettes count more than creases, since a crease may
//! have no contrast) on a grid of rotations, standing ones first; then the best are improved by
//! turning them in shrinking steps.

use nalgebra::{Unit, UnitQuaternion, Vector3};
use vergence_geometry::{Symmetry, Transform};

use super::Config;
use super::field::Field;
use super::landmark::Landmark;
use super::level::Level;
use crate::model::{Kind, Model, Outline};
use crate::rotations;
use crate::types::{Query, View};

/// Weight of a crease's length against a silhouette's.
const CREASE_WEIGHT: f32 = 0.5;

/// A view prepared for the search and the refinement.
pub struct Sight<'a> {
    /// The view.
    pub view: View<'a>,
    /// Base to optical frame.
    pub optical_from_base: Transform,
    /// The lens does not distort.
    pub straight: bool,
    /// The picture at the working scale.
    pub coarse: Level,
    /// The picture at full resolution, hardly smoothed.
    pub fine: Level,
    /// Directional distances at the working scale.
    pub field: Field,
}

/// An attitude and what speaks for it.
#[derive(Debug, Clone, Copy)]
pub struct Hypothesis {
    /// `base_from_object`.
    pub pose: Transform,
    /// Evidence of the contour in all views (px^2 of the working scale).
    pub evidence: f32,
    /// The object rests on something level.
    pub rests: bool,
}

/// The search's fixed inputs.
pub struct Search<'a> {
    /// Prepared views.
    pub sights: &'a [Sight<'a>],
    /// The object's form.
    pub model: &'a Model,
    /// What is known.
    pub query: &'a Query<'a>,
    /// What the landmark says about the object's place.
    pub measured: Landmark,
    /// The motions of the object that nobody can tell apart.
    pub symmetry: Symmetry,
    /// The landmark in the object frame.
    pub landmark: Vector3<f64>,
    /// Its outward normal in the object frame.
    pub normal: Vector3<f64>,
    /// Settings.
    pub config: &'a Config,
}

/// Storage that the search uses over and over.
#[derive(Default)]
struct Scratch {
    outline: Outline,
    pixels: Vec<(f32, f32)>,
}

impl Sight<'_> {
    /// Where a point of the optical frame appears on the working scale; not a number when it
    /// does not.
    fn place(&self, p: &Vector3<f64>) -> (f32, f32) {
        let camera = &self.view.camera;
        if p.z < 1e-6 {
            return (f32::NAN, f32::NAN);
        }
        let inverse = 1.0 / p.z;
        let (x, y) = (p.x * inverse, p.y * inverse);
        let (x, y) = match self.straight {
            true => (x, y),
            false if camera.is_one_to_one(x, y) => camera.distort(x, y),
            false => return (f32::NAN, f32::NAN),
        };
        let (u, v) = self.coarse.from_picture(camera.fx * x + camera.cx, camera.fy * y + camera.cy);
        (u as f32, v as f32)
    }
}

impl<'a> Search<'a> {
    /// A search for a query that has been checked, with its landmark's place and normal in the object.
    pub fn new(
        sights: &'a [Sight<'a>],
        model: &'a Model,
        query: &'a Query<'a>,
        (landmark, normal): (Vector3<f64>, Vector3<f64>),
        config: &'a Config,
    ) -> Self {
        let (measured, symmetry) = (Landmark::new(sights, query), query.symmetry_of(model));
        Search { sights, model, query, measured, symmetry, landmark, normal, config }
    }
}

impl Search<'_> {
    /// Different poses worth refining: those at rest, then the others, each best first. They do not
    /// compete here: a free attitude always finds edges that explain it a little better.
    pub fn hypotheses(&self) -> Vec<Hypothesis> {
        let (resting, free) = (self.resting(), self.free());
        let share = if resting.is_empty() || free.is_empty() { 1 } else { 2 };
        let mut found = self.best_of(resting, self.config.refined / share, self.query.up);
        found.extend(self.best_of(free, self.config.refined / share, None));
        found
    }

    /// The best of these rotations, each climbed to the top near it; where an axis (base frame) is
    /// given, by turns about it only.
    fn best_of(
        &self,
        turns: Vec<UnitQuaternion<f64>>,
        count: usize,
        about: Option<Unit<Vector3<f64>>>,
    ) -> Vec<Hypothesis> {
        let mut scratch = Scratch::default();
        // One view ranks all; the others judge only what it leaves.
        let (first, others) = self.sights.split_at(1);
        let mut found: Vec<Hypothesis> =
            turns.into_iter().filter_map(|turn| self.judge(turn, first, &mut scratch)).collect();
        if !others.is_empty() {
            let keep = self.config.shortlist.min(found.len());
            if keep < found.len() {
                found.select_nth_unstable_by(keep, |a, b| b.evidence.total_cmp(&a.evidence));
                found.truncate(keep);
            }
            for hypothesis in &mut found {
                hypothesis.evidence += self.evidence(&hypothesis.pose, others, &mut scratch);
            }
        }
        found.sort_by(|a, b| b.evidence.total_cmp(&a.evidence));
        let share = self.config.worth_a_climb;
        let least = found.first().map_or(0.0, |best| best.evidence.min(share * best.evidence));
        found.retain(|h| h.evidence >= least);
        let mut seeds = self.distinct(&found, self.config.seeds, self.config.grid_spacing);
        for seed in &mut seeds {
            self.climb(seed, about, &mut scratch);
        }
        seeds.sort_by(|a, b| b.evidence.total_cmp(&a.evidence));
        let share = self.config.worth;
        let least = seeds.first().map_or(0.0, |best| best.evidence.min(share * best.evidence));
        seeds.retain(|h| h.evidence >= least);
        let mut best = self.distinct(&seeds, count, 0.5 * self.config.grid_spacing);
        for hypothesis in &mut best {
            hypothesis.rests = about.is_some();
        }
        best
    }

    /// Rotations in which the object rests on something level.
    fn resting(&self) -> Vec<UnitQuaternion<f64>> {
        let Some(up) = self.query.up else { return Vec::new() };
        let downs = match self.query.standing {
            Some(true) => vec![-Vector3::z()],
            Some(false) => Vec::new(),
            None => self.model.resting_directions(),
        };
        let steps = (std::f64::consts::TAU / self.config.turn_step).round() as usize;
        let around = |down| rotations::standing(up, Unit::new_normalize(down), steps);
        downs.into_iter().flat_map(around).collect()
    }

    /// Rotations of an object that may have any attitude.
    fn free(&self) -> Vec<UnitQuaternion<f64>> {
        match self.query.standing == Some(true) && self.query.up.is_some() {
            true => Vec::new(),
            false => {
                rotations::spread(rotations::count_for_spacing(self.config.grid_spacing)).collect()
            }
        }
    }

    /// The pose with the landmark in its place, unless that hides the landmark from a camera.
    fn judge(
        &self,
        turn: UnitQuaternion<f64>,
        sights: &[Sight],
        scratch: &mut Scratch,
    ) -> Option<Hypothesis> {
        let n = turn * self.normal;
        let landmark = self.query.landmark.position;
        for sight in self.sights {
            let to_eye = sight.view.eye() - landmark;
            if n.dot(&to_eye) < self.config.grazing * to_eye.norm() {
                return None;
            }
        }
        let centre = landmark - turn * self.landmark;
        let pose = Transform::from_parts(centre.coords.into(), turn);
        Some(Hypothesis { pose, evidence: self.evidence(&pose, sights, scratch), rests: false })
    }

    fn evidence(&self, pose: &Transform, sights: &[Sight], scratch: &mut Scratch) -> f32 {
        let mut sum = 0.0;
        for sight in sights {
            let optical_from_object = sight.optical_from_base * pose;
            let turn = optical_from_object.rotation.to_rotation_matrix().into_inner();
            let shift = optical_from_object.translation.vector;
            let eye = turn.tr_mul(&-shift);
            self.model.outline(&eye, false, &mut scratch.outline);
            scratch.pixels.clear();
            scratch
                .pixels
                .extend(scratch.outline.points.iter().map(|p| sight.place(&(turn * p + shift))));
            for line in &scratch.outline.lines {
                let [from, to] = line.ends.map(|k| scratch.pixels[usize::from(k)]);
                let weight = if line.kind == Kind::Crease { CREASE_WEIGHT } else { 1.0 };
                sum += weight * sight.field.evidence(from, to);
            }
        }
        sum
    }

    /// Turns a hypothesis about the landmark in shrinking steps as long as that helps: about all
    /// axes of the object, or about the one given (base frame) so that it stays at rest.
    fn climb(
        &self,
        hypothesis: &mut Hypothesis,
        about: Option<Unit<Vector3<f64>>>,
        scratch: &mut Scratch,
    ) {
        let mut step = 0.5 * self.config.grid_spacing;
        for _ in 0..self.config.climb_halvings {
            for _ in 0..3 {
                let here = *hypothesis;
                let axes = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()]
                    .map(|axis| here.pose.rotation * axis);
                for axis in about.as_ref().map_or(&axes[..], std::slice::from_ref) {
                    for angle in [-step, step] {
                        let turn =
                            UnitQuaternion::from_axis_angle(axis, angle) * here.pose.rotation;
                        if let Some(next) = self.judge(turn, self.sights, scratch)
                            && next.evidence > hypothesis.evidence
                        {
                            *hypothesis = next;
                        }
                    }
                }
                if here.pose == hypothesis.pose {
                    break;
                }
            }
            step *= 0.5;
        }
    }

    /// The first `count` of a sorted list that are not within a turn (rad) of an earlier one.
    fn distinct(&self, sorted: &[Hypothesis], count: usize, turn: f64) -> Vec<Hypothesis> {
        let mut kept: Vec<Hypothesis> = Vec::with_capacity(count);
        for h in sorted {
            if kept.len() == count {
                break;
            }
            if kept.iter().all(|k| !self.are_alike(&k.pose, &h.pose, turn, f64::INFINITY)) {
                kept.push(*h);
            }
        }
        kept
    }

    /// Whether two poses differ by no more than a turn (rad), and are no further from each other than
    /// such a turn about the object's middle moves its corners, nor than so far (m). Of symmetric twins
    /// the nearest counts.
    pub(super) fn are_alike(&self, a: &Transform, b: &Transform, turn: f64, far: f64) -> bool {
        if self.symmetry.angle_between(&a.rotation, &b.rotation) > turn {
            return false;
        }
        let reach = 0.5 * Vector3::from(self.query.record.bounding_box.sides()).norm();
        let near = self.symmetry.nearest(b, a);
        (near.translation.vector - a.translation.vector).norm() <= far.min(turn * reach)
    }
}
