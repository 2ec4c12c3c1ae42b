//! All six unknowns together, from the edges of all views, the landmark and gravity.
//!
//! **In:** a pose that is right to a few pixels. **Out:** the pose that maximises the likelihood of
//! a mixture: every site's edge is one of its candidates with Gaussian error, or none. Solved by
//! Gauss-Newton on the expected assignments (EM), the edge deviation shrinking from pass to pass
//! (annealing). The cameras' small turns are nuisance unknowns with a prior, eliminated view by
//! view (Schur complement). The landmark is a measurement of three numbers with its covariance.

use nalgebra::{Matrix2, Matrix3, Matrix3x6, Matrix6, Matrix6x2, Vector2, Vector3, Vector6};
use vergence_geometry::gaussian::{perturb, skew};
use vergence_geometry::Transform;

use super::search::Search;
use super::sites::{Layout, Site, sites};
use crate::model::Kind;

/// Standard deviation of an edge's place once the pose is right (px): aliasing, gamma, blooming and
/// bent edges, not only noise.
pub const EDGE_SD_PX: f64 = 0.35;
/// Neighbouring sites err alike: contour length (px) that counts as one independent measurement.
pub const CORRELATION_PX: f64 = 4.0;
/// Density of edges that have nothing to do with the contour (per px of normal).
pub const STRAY_DENSITY: f64 = 0.08;
/// Deviation of a standing object's axis from gravity (rad): tables and heads are not quite level.
const STANDING_SD: f64 = 0.006;
/// Beyond this tilt (rad) an object is not taken to stand.
const STANDING_LIMIT: f64 = 0.05;

/// Probability that a visible contour shows no edge: occluded or without contrast.
pub fn absence(kind: Kind) -> f64 {
    match kind {
        Kind::Silhouette => 0.2,
        Kind::Crease => 0.45,
    }
}

/// One pass of the refinement.
#[derive(Debug, Clone, Copy)]
pub struct Pass {
    /// Deviation of edges (picture px).
    pub sd_px: f64,
    /// How sites are laid out.
    pub layout: Layout,
    /// At full resolution instead of the working scale.
    pub fine: bool,
}

/// A refined pose.
#[derive(Debug, Clone)]
pub struct Refined {
    /// `base_from_object`.
    pub pose: Transform,
    /// Information matrix of the pose's tangent, nuisances eliminated.
    pub information: Matrix6<f64>,
    /// Small turns of the cameras about their x and y axes (rad).
    pub turns: Vec<[f64; 2]>,
    /// The sites of the last pass, at the pose before its last step.
    pub sites: Vec<Site>,
}

/// Sums of one view's normal equations.
#[derive(Default, Clone)]
struct Normal {
    pose: Matrix6<f64>,
    mixed: Matrix6x2<f64>,
    turn: Matrix2<f64>,
    pose_rhs: Vector6<f64>,
    turn_rhs: Vector2<f64>,
}

impl Search<'_> {
    /// Refines a pose through the given passes.
    pub fn refine(&self, start: &Transform, passes: &[Pass]) -> Refined {
        let mut refined = Refined {
            pose: *start,
            information: Matrix6::identity(),
            turns: vec![[0.0; 2]; self.sights.len()],
            sites: Vec::new(),
        };
        for pass in passes {
            self.lay_out(&mut refined, pass);
            // Two steps on the same sites: the assignments settle while the geometry is linear.
            let mut moved = Vector6::zeros();
            let mut turned = vec![Vector2::zeros(); self.sights.len()];
            for _ in 0..2 {
                let step = self.step(&mut refined, pass, &moved, &turned);
                let Some((pose_step, turn_steps)) = step else { break };
                moved += pose_step;
                turned.iter_mut().zip(turn_steps).for_each(|(t, s)| *t += s);
            }
            refined.pose = perturb(&refined.pose, &moved);
            for (total, step) in refined.turns.iter_mut().zip(&turned) {
                total[0] += step.x;
                total[1] += step.y;
            }
        }
        refined
    }

    /// Looks for the edges around a refined pose anew.
    pub fn lay_out(&self, refined: &mut Refined, pass: &Pass) {
        let mut found = std::mem::take(&mut refined.sites);
        found.clear();
        for (view, sight) in self.sights.iter().enumerate() {
            let level = match &sight.fine {
                Some(fine) if pass.fine => fine,
                _ => &sight.coarse,
            };
            let turn = refined.turns[view];
            sites(&mut found, sight, view, level, self.model, &refined.pose, turn, &pass.layout);
        }
        refined.sites = found;
    }

    /// One Gauss-Newton step from `moved`, `turned`; keeps the information in `refined`.
    fn step(
        &self,
        refined: &mut Refined,
        pass: &Pass,
        moved: &Vector6<f64>,
        turned: &[Vector2<f64>],
    ) -> Option<(Vector6<f64>, Vec<Vector2<f64>>)> {
        let mut normals = vec![Normal::default(); self.sights.len()];
        for site in &refined.sites {
            let turn = &turned[site.view];
            let shift = (site.by_pose * moved).x + (site.by_turn * turn).x;
            let Some((weight, residual)) = assign(site, shift, pass.sd_px) else { continue };
            let n = &mut normals[site.view];
            let (jp, jt) = (site.by_pose.transpose(), site.by_turn.transpose());
            n.pose += jp * weight * site.by_pose;
            n.mixed += jp * weight * site.by_turn;
            n.turn += jt * weight * site.by_turn;
            n.pose_rhs += jp * (weight * residual);
            n.turn_rhs += jt * (weight * residual);
        }
        let (mut a, mut b) = self.prior(&perturb(&refined.pose, moved));
        let mut eliminated = Vec::with_capacity(normals.len());
        for (view, n) in normals.iter_mut().enumerate() {
            let sd = self.sights[view].view.turn_sd;
            a += n.pose;
            b += n.pose_rhs;
            let inverse = if sd > 0.0 {
                let prior = 1.0 / (sd * sd);
                n.turn += Matrix2::identity() * prior;
                n.turn_rhs -= (Vector2::from(refined.turns[view]) + turned[view]) * prior;
                n.turn.try_inverse()
            } else {
                None
            };
            if let Some(inverse) = inverse {
                a -= n.mixed * inverse * n.mixed.transpose();
                b -= n.mixed * inverse * n.turn_rhs;
            }
            eliminated.push(inverse);
        }
        refined.information = a;
        let step = a.cholesky()?.solve(&b);
        let turns = normals.iter().zip(eliminated).map(|(n, inverse)| {
            inverse.map_or(Vector2::zeros(), |i| i * (n.turn_rhs - n.mixed.transpose() * step))
        });
        Some((step, turns.collect()))
    }

    /// Information and right-hand side of the landmark and of gravity at a pose.
    fn prior(&self, pose: &Transform) -> (Matrix6<f64>, Vector6<f64>) {
        let lever = pose.rotation * self.landmark;
        let residual = self.query.landmark.position.coords - pose.translation.vector - lever;
        let mut j = Matrix3x6::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-skew(&lever));
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
        let weight = self.query.landmark.covariance.try_inverse().unwrap_or_default();
        let (mut a, mut b) = (j.transpose() * weight * j, j.transpose() * weight * residual);
        if let Some(turn) = self.tilt(pose) {
            let weight = 1.0 / (STANDING_SD * STANDING_SD);
            // Only the two turns that tilt the axis are measured, not the one about it.
            let up = self.query.up.map_or(Vector3::z(), |u| u.into_inner());
            let tilts = (Matrix3::identity() - up * up.transpose()) * weight;
            let mut block = a.fixed_view_mut::<3, 3>(0, 0);
            block += tilts;
            let mut rhs = b.fixed_rows_mut::<3>(0);
            rhs += tilts * turn;
        }
        // A solid of revolution says nothing about one turn: hold it.
        a += Matrix6::identity() * 1e-3;
        (a, b)
    }

    /// The small turn (base frame) that would make the object stand exactly, when it seems to.
    fn tilt(&self, pose: &Transform) -> Option<Vector3<f64>> {
        let up = self.query.up?.into_inner();
        let downs = match self.query.standing {
            Some(false) => return None,
            Some(true) => vec![-Vector3::z()],
            None => self.model.resting_directions(),
        };
        let nearest = downs
            .into_iter()
            .map(|down| pose.rotation * -down)
            .max_by(|a, b| a.dot(&up).total_cmp(&b.dot(&up)))?;
        let turn = nearest.cross(&up);
        let stands = nearest.dot(&up) > 0.0
            && (turn.norm() < STANDING_LIMIT || self.query.standing == Some(true));
        stands.then_some(turn)
    }
}

/// Weight and mean residual (px) of a site whose contour has moved by `shift`.
fn assign(site: &Site, shift: f64, sd: f64) -> Option<(f64, f64)> {
    let missing = absence(site.kind);
    let density = (1.0 - missing) / (sd * (2.0 * std::f64::consts::PI).sqrt());
    let stray = missing * STRAY_DENSITY;
    let (mut total, mut mean) = (0.0, 0.0);
    for c in site.edges() {
        let r = c.offset - shift;
        let likelihood = density * c.weight * (-0.5 * (r / sd).powi(2)).exp();
        total += likelihood;
        mean += likelihood * r;
    }
    if total <= 0.0 {
        return None;
    }
    let belief = total / (total + stray);
    let sd_now = sd.max(EDGE_SD_PX);
    let weight = belief * (site.length / CORRELATION_PX).min(1.0) / (sd_now * sd_now);
    Some((weight, mean / total))
}
