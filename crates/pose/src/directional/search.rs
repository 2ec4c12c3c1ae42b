//! Which rotations explain the edges: all are tried, the landmark holding the place.
//!
//! **In:** the views' [`Sight`]s, the model, the query. **Out:** a few poses that differ from one
//! another, best first, good to about a degree or two. Method: evidence of the visible contour in
//! the directional fields of all views (silhouettes count more than creases, since a crease may
//! have no contrast) on a grid of rotations, standing ones first; then the best are improved by
//! turning them in shrinking steps.

use nalgebra::{Point3, Unit, UnitQuaternion, Vector3};
use vergence_geometry::Transform;

use super::Config;
use super::field::Field;
use super::level::Level;
use crate::model::{Contour, Kind, Model};
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
    /// Gradient at the working scale.
    pub coarse: Level,
    /// Gradient at full resolution, when the working scale is coarser.
    pub fine: Option<Level>,
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
}

/// The search's fixed inputs.
pub struct Search<'a> {
    /// Prepared views.
    pub sights: &'a [Sight<'a>],
    /// The object's form.
    pub model: &'a Model,
    /// What is known.
    pub query: &'a Query<'a>,
    /// The landmark in the object frame.
    pub landmark: Vector3<f64>,
    /// Its outward normal in the object frame.
    pub normal: Vector3<f64>,
    /// Settings.
    pub config: &'a Config,
}

impl Search<'_> {
    /// Different poses worth refining, best first.
    pub fn hypotheses(&self) -> Vec<Hypothesis> {
        let mut contour = Contour::new();
        let mut found: Vec<Hypothesis> = self
            .rotations()
            .into_iter()
            .filter_map(|turn| self.judge(turn, &mut contour))
            .collect();
        found.sort_by(|a, b| b.evidence.total_cmp(&a.evidence));
        let mut seeds = distinct(&found, self.config.seeds, self.config.grid_spacing);
        for seed in &mut seeds {
            self.climb(seed, &mut contour);
        }
        seeds.sort_by(|a, b| b.evidence.total_cmp(&a.evidence));
        distinct(&seeds, self.config.refined, 0.5 * self.config.grid_spacing)
    }

    /// The rotations to try.
    fn rotations(&self) -> Vec<UnitQuaternion<f64>> {
        let steps = (std::f64::consts::TAU / self.config.turn_step).round() as usize;
        let mut turns = Vec::new();
        if let Some(up) = self.query.up {
            let downs = match self.query.standing {
                Some(true) => vec![-Vector3::z()],
                Some(false) => Vec::new(),
                None => self.model.resting_directions(),
            };
            for down in downs {
                turns.extend(rotations::standing(up, Unit::new_normalize(down), steps));
            }
        }
        if self.query.standing != Some(true) || self.query.up.is_none() {
            turns.extend(rotations::spread(rotations::count_for_spacing(self.config.grid_spacing)));
        }
        turns
    }

    /// The pose with the landmark in its place, unless that hides the landmark from a camera.
    fn judge(&self, turn: UnitQuaternion<f64>, contour: &mut Contour) -> Option<Hypothesis> {
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
        Some(Hypothesis { pose, evidence: self.evidence(&pose, contour) })
    }

    fn evidence(&self, pose: &Transform, contour: &mut Contour) -> f32 {
        let mut sum = 0.0;
        for sight in self.sights {
            let optical_from_object = sight.optical_from_base * pose;
            let eye = optical_from_object.inverse_transform_point(&Point3::origin());
            self.model.contour(&eye.coords, false, contour);
            for segment in contour.iter() {
                let ends = [segment.from, segment.to].map(|p| {
                    let p = sight.view.camera.project(&(optical_from_object * Point3::from(p)))?;
                    let (x, y) = sight.coarse.from_picture(p.x, p.y);
                    Some((x as f32, y as f32))
                });
                let [Some(from), Some(to)] = ends else { continue };
                let weight = if segment.kind == Kind::Crease { CREASE_WEIGHT } else { 1.0 };
                sum += weight * sight.field.evidence(from, to).0;
            }
        }
        sum
    }

    /// Turns a hypothesis about the landmark in shrinking steps as long as that helps.
    fn climb(&self, hypothesis: &mut Hypothesis, contour: &mut Contour) {
        let mut step = 0.5 * self.config.grid_spacing;
        for _ in 0..self.config.climb_halvings {
            for _ in 0..3 {
                let here = *hypothesis;
                for axis in [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()] {
                    for sign in [-1.0, 1.0] {
                        let turn = here.pose.rotation
                            * UnitQuaternion::from_axis_angle(&axis, sign * step);
                        if let Some(next) = self.judge(turn, contour)
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
}

/// The first `count` of a sorted list that are at least `apart` (rad) from every earlier one.
fn distinct(sorted: &[Hypothesis], count: usize, apart: f64) -> Vec<Hypothesis> {
    let mut kept: Vec<Hypothesis> = Vec::with_capacity(count);
    for h in sorted {
        if kept.len() == count {
            break;
        }
        if kept.iter().all(|k| k.pose.rotation.angle_to(&h.pose.rotation) > apart) {
            kept.push(*h);
        }
    }
    kept
}
