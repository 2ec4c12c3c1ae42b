//! Optima beside the best pose.
//!
//! **In:** the best refined pose. **Out:** the best of its neighbourhood, with a covariance that
//! holds the others. Print, lips and shadows run parallel to the contour a pixel or two away, and a
//! refinement stops at the first place that fits: the likelihood has several tops. The refinement is
//! started again from where the contour lies a few pixels off, in every direction in which a pose can
//! move it. The distinct tops are components of a mixture with their odds as weights; its second
//! moment about the best is the covariance. So a pose whose edges are certain gets a small one, and a
//! pose that might sit on the wrong line of print says so.

use nalgebra::{Matrix6, Vector6};
use vergence_geometry::Transform;
use vergence_geometry::gaussian::{difference, perturb};

use super::refine::{EDGE_SD_PX, Pass, Refined};
use super::search::Search;
use super::verdict::Explained;

/// How far the contour is moved (px of the working scale, which is at most two of the picture's).
const HOP_PX: f64 = 2.5;
/// Optima whose contours are nearer than this (px) are one.
const SAME_PX: f64 = 0.2;
/// A direction is left out when it takes more than this (rad or m) to move the contour that far: a
/// turn about the axis of a solid of revolution.
const BLIND: f64 = 0.2;
/// Nats to one that count: edges along a contour are not independent of each other, so evidence
/// comes cheaper than it is.
pub const NATS_TO_ONE: f64 = 6.0;

impl Search<'_> {
    /// Moves to the best optimum nearby and widens the covariance by the others.
    pub(super) fn settle(&self, best: &mut (Refined, Explained)) {
        let metric = contour_metric(&best.0);
        let apart = |a: &Refined, b: &Refined| {
            let d = difference(&a.pose, &b.pose);
            (d.transpose() * metric * d).x.sqrt()
        };
        let mut optima = vec![best.clone()];
        for start in self.starts(&best.0, &metric) {
            let mut trial = Refined { pose: start, ..best.0.clone() };
            self.refine(
                &mut trial,
                &[
                    Pass::new(1.0, 5.0, 3.0, true),
                    Pass::new(0.6, 4.0, 2.5, true),
                    Pass::new(EDGE_SD_PX, 4.0, 2.0, true),
                    Pass::new(EDGE_SD_PX, 4.0, 2.0, true),
                ],
            );
            let trial = self.both(trial);
            match optima.iter_mut().find(|o| apart(&o.0, &trial.0) < SAME_PX) {
                Some(known) if known.1.evidence < trial.1.evidence => *known = trial,
                Some(_) => {}
                None => optima.push(trial),
            }
        }
        *best = mixture(optima);
    }

    /// Poses whose contours lie off the given one's, one for every direction and sense.
    fn starts(&self, from: &Refined, metric: &Matrix6<f64>) -> Vec<Transform> {
        let hop = HOP_PX * self.scale().min(2.0);
        let eigen = metric.symmetric_eigen();
        let lengths = eigen.eigenvalues.map(|e| hop / e.max(1e-9).sqrt());
        let steps = (0..6).filter(|&k| lengths[k] < BLIND);
        let steps = steps.map(|k| eigen.eigenvectors.column(k) * lengths[k]);
        steps
            .flat_map(|d: Vector6<f64>| [perturb(&from.pose, &d), perturb(&from.pose, &-d)])
            .collect()
    }
}

/// Mean square shift of the contour across itself (px^2) by a tangent: `d' M d`.
fn contour_metric(refined: &Refined) -> Matrix6<f64> {
    let mut metric = Matrix6::zeros();
    for site in &refined.sites {
        let j = site.by_pose.fixed_columns::<6>(0);
        metric += j.transpose() * j;
    }
    metric / refined.sites.len().max(1) as f64
}

/// The best of some optima with the second moment of all about it.
fn mixture(optima: Vec<(Refined, Explained)>) -> (Refined, Explained) {
    let mut best = 0;
    for (k, o) in optima.iter().enumerate() {
        if o.1.evidence > optima[best].1.evidence {
            best = k;
        }
    }
    let top = &optima[best];
    let (mut covariance, mut total) = (Matrix6::zeros(), 0.0);
    for o in &optima {
        let odds = ((o.1.evidence - top.1.evidence) / NATS_TO_ONE).exp();
        let d = difference(&top.0.pose, &o.0.pose);
        covariance += (o.0.covariance + d * d.transpose()) * odds;
        total += odds;
    }
    let covariance = covariance / total;
    (Refined { covariance, ..top.0.clone() }, top.1)
}
