//! Optima beside the best pose.
//!
//! **In:** the best refined pose. **Out:** the mean of its neighbourhood, with a covariance that holds
//! all of it. Print, lips and shadows run parallel to the contour a pixel or two away, and a
//! refinement stops at the first place that fits: the likelihood has several tops. The contour is
//! moved a few pixels in every direction in which a pose can move it and there are edges, and glides
//! from there on the edges that were found around the best pose, which takes most starts back to it.
//! What ends elsewhere and explains enough is refined on its own. The distinct tops are components of
//! a mixture: its mean is the estimate, its second moment about that, with the odds taken less
//! seriously, the covariance. So a pose whose edges are certain gets a small one, and a pose that might
//! sit on the wrong line of print says so.
//!
//! Which top is as far away as the object's surface is, print that both views see can tell ([`print`]).
//! Whether the object rests on the ground about it is a belief of its own, and makes a mixture, too.

use nalgebra::{Matrix6, Vector6};
use vergence_geometry::gaussian::{difference, perturb};

use super::equations::{Move, by_part};
use super::print::{self, Patch};
use super::refine::{EDGE_SD_PX, FINAL, Pass, Refined, STEPS};
use super::search::Search;
use super::sites::Site;
use super::verdict::Explained;

/// How far the contour is moved (px of the working scale, counted as two of the picture's at most).
const HOP_PX: f64 = 2.5;
/// How the edges around are looked at before: range to either side (hops) and spacing of sites (px).
const AROUND: (f64, f64) = (1.8, 4.0);
/// There is something to find when this share of the contour that moves, by at least so much of a
/// hop, comes this near (hops) to an edge. In simulated and real scenes more starts found no other top.
const WORTH_A_START: f64 = 0.3;
const MOVES: f64 = 0.4;
const NEAR: f64 = 0.5;
/// What comes this near (px) to a known optimum will end there.
pub(super) const CAUGHT_PX: f64 = 0.4;
/// Deviations (px) with which a start glides, one after the other.
const GLIDES: [f64; 2] = [1.0, 0.6];
/// Passes that refine what did not glide back.
const PASSES: [Pass; 2] = [FINAL, FINAL];
/// What it may be behind the best pose before (nats of doubt), the edges around either looked at alike.
const HOPELESS: f64 = 6.0;
/// What the tops that count in the mean, those less behind than this (nats), are refined by at last: a
/// site at every pixel. Where sites happen to fall on print and noise no longer matters, and the long
/// passes before it can do with fewer. Print that both views see has its say only here: it needs a pose
/// that is right to a pixel or two.
const POLISH: Pass = Pass::new(EDGE_SD_PX, 4.0, 1.0, true);
const POLISHED: f64 = 6.0;
/// Belief from which on an object rests on the ground, or does not, without a second thought.
const SURE: f64 = 0.98;
/// A direction is left out when it takes more than this (rad or m) to move the contour that far: a
/// turn about the axis of a solid of revolution.
const BLIND: f64 = 0.2;
/// When a higher top is found, by this many nats, its own neighbourhood is searched; so many at most.
const HIGHER: f64 = 1.0;
const MOST_TOPS: usize = 3;
/// Nats of evidence to one of doubt, by which the covariance weighs optima: a line of print runs along
/// a whole part, so all its sites agree in the wrong place together.
const DOUBT_NATS: f64 = 6.0;
/// Optima further behind than this (nats of doubt) do not count.
const MOST_BEHIND: f64 = 4.6;

impl Search<'_> {
    /// Moves to the mean of the optima nearby and widens the covariance by them.
    pub(super) fn settle(&self, best: &mut (Refined, Explained)) {
        let starts =
            |_: &Refined, around: &[Site], metric: &Matrix6<f64>| self.starts(around, metric);
        *best = self.mixture(self.tops(best, starts, HOPELESS * DOUBT_NATS));
    }

    /// The distinct tops around a pose, highest first: where the starts around the highest lead that are
    /// behind by no more than this (nats), the edges around looked at alike.
    pub(super) fn tops(
        &self,
        of: &(Refined, Explained),
        starts: impl Fn(&Refined, &[Site], &Matrix6<f64>) -> Vec<Vector6<f64>>,
        behind: f64,
    ) -> Vec<(Refined, Explained)> {
        let metric = contour_metric(&of.0);
        let apart = |a: &Refined, b: &Refined| moves_px(&metric, &difference(&a.pose, &b.pose));
        let mut optima = vec![of.clone()];
        for _ in 0..MOST_TOPS {
            let top = optima[0].clone();
            let (around, explains) = self.weigh(top.0.without_sites(), &self.wide());
            let parts = by_part(&around.sites);
            let least = explains.evidence - behind;
            for start in starts(&top.0, &around.sites, &metric) {
                let known = |r: &Refined| optima.iter().any(|o| apart(&o.0, r) < CAUGHT_PX);
                optima.extend(self.other_top(&top.0, &start, &parts, least, known));
            }
            optima.sort_by(|a, b| b.1.evidence.total_cmp(&a.1.evidence));
            if optima[0].1.evidence < top.1.evidence + HIGHER {
                break;
            }
        }
        optima
    }

    /// Where a start ends that is off the top by a tangent, on the sites around the top; `None` where
    /// that is known or explains less than the least.
    fn other_top(
        &self,
        top: &Refined,
        start: &Vector6<f64>,
        parts: &[&Site],
        least: f64,
        known: impl Fn(&Refined) -> bool,
    ) -> Option<(Refined, Explained)> {
        let mut trial = Refined { offsets: top.offsets.clone(), ..top.without_sites() };
        let mut moved = Move::default();
        moved.shared.fixed_rows_mut::<6>(0).copy_from(start);
        for sd_px in GLIDES {
            for _ in 0..STEPS {
                self.advance(&mut trial, parts, sd_px, &mut moved);
            }
            let mut here = trial.without_sites();
            here.apply(&moved);
            if known(&here) {
                return None;
            }
        }
        trial.apply(&moved);
        let (mut trial, explains) = self.weigh(trial, &self.wide());
        if explains.evidence < least {
            return None;
        }
        for pass in PASSES {
            self.refine(&mut trial, &[pass]);
            if known(&trial) {
                return None;
            }
        }
        Some(self.both(trial))
    }

    /// How the edges around a pose are looked at: further off than a refinement does.
    fn wide(&self) -> Pass {
        Pass::new(GLIDES[1], AROUND.0 * self.hop(), AROUND.1, true)
    }

    /// How far the contour is moved (px).
    fn hop(&self) -> f64 {
        HOP_PX * self.scale().min(2.0)
    }

    /// Tangents by which the contour comes off the pose and near other edges, one for every direction
    /// and sense at most.
    fn starts(&self, around: &[Site], metric: &Matrix6<f64>) -> Vec<Vector6<f64>> {
        let hop = self.hop();
        let eigen = metric.symmetric_eigen();
        let lengths = eigen.eigenvalues.map(|e| hop / e.max(1e-9).sqrt());
        let steps = (0..6).filter(|&k| lengths[k] < BLIND);
        let steps = steps.map(|k| eigen.eigenvectors.column(k) * lengths[k]);
        let both = steps.flat_map(|d: Vector6<f64>| [d, -d]);
        both.filter(|d| edges_elsewhere(around, d, hop) > WORTH_A_START).collect()
    }
}

/// Share of the contour moved by a tangent that comes near other edges.
fn edges_elsewhere(sites: &[Site], by: &Vector6<f64>, hop: f64) -> f64 {
    let (mut moved, mut near) = (0.0, 0.0);
    for site in sites {
        let shift = (site.by_shared.fixed_columns::<6>(0) * by).x;
        if shift.abs() < MOVES * hop {
            continue;
        }
        moved += site.length;
        // Nearer than to where it is now.
        let within = (NEAR * hop).min(0.75 * shift.abs());
        if site.edges().iter().any(|c| (c.offset - shift).abs() < within) {
            near += site.length;
        }
    }
    near / f64::max(moved, 1e-9)
}

/// Mean square shift of the contour across itself (px^2) by a tangent: `d' M d`.
fn contour_metric(refined: &Refined) -> Matrix6<f64> {
    let mut metric = Matrix6::zeros();
    for site in &refined.sites {
        let j = site.by_shared.fixed_columns::<6>(0);
        metric += j.transpose() * j;
    }
    metric / refined.sites.len().max(1) as f64
}

/// How far a tangent moves the contour across itself (root mean square, px), by its metric.
pub(super) fn moves_px(metric: &Matrix6<f64>, by: &Vector6<f64>) -> f64 {
    (by.transpose() * metric * by).x.sqrt()
}

impl Search<'_> {
    /// The mean of some optima by belief, with the second moment about it of all by doubt.
    fn mixture(&self, optima: Vec<(Refined, Explained)>) -> (Refined, Explained) {
        // Which of the tops of the edges is as far away as the surface is, print knows.
        let seen: Vec<Vec<Patch>> = optima.iter().map(|o| self.print(&o.0)).collect();
        // The ground is looked for once: from top to top it is but a little higher or lower.
        let top = &optima[0].0;
        let ground = self.grounds(&[top], print::ENOUGH).remove(0);
        let from = |refined: &Refined| {
            let moved = top.to(refined);
            ground.iter().map(|p| p.after(&moved)).collect()
        };
        let grounds: Vec<Vec<Patch>> = optima.iter().map(|o| from(&o.0)).collect();
        let told = print::supported(&grounds);
        let all = optima.into_iter().zip(seen.into_iter().zip(grounds)).zip(told);
        let all = all.map(|(((mut refined, explained), (on_object, on_ground)), told)| {
            let evidence = explained.evidence + print::evidence(&on_object) + told;
            refined.patches = [on_object, on_ground].concat();
            (evidence, refined, explained)
        });
        let mut optima: Vec<(f64, Refined, Explained)> = all.collect();
        optima.sort_by(|a, b| b.0.total_cmp(&a.0));
        let most = optima[0].0;
        optima.retain(|o| most - o.0 < MOST_BEHIND * DOUBT_NATS);
        for (evidence, refined, _) in &mut optima {
            if most - *evidence < POLISHED {
                self.polish(refined);
            } else {
                self.doubt(refined, &FINAL);
            }
        }
        let place = optima[0].1.pose;
        let (mut mean, mut beliefs) = (Vector6::zeros(), 0.0);
        for (evidence, refined, _) in &optima {
            let belief = (*evidence - most).exp();
            mean += difference(&place, &refined.pose) * belief;
            beliefs += belief;
        }
        let pose = perturb(&place, &(mean / beliefs));
        let (mut covariance, mut odds) = (Matrix6::zeros(), 0.0);
        for (evidence, refined, _) in &optima {
            let doubt = ((evidence - most) / DOUBT_NATS).exp();
            let d = difference(&pose, &refined.pose);
            covariance += (refined.covariance + d * d.transpose()) * doubt;
            odds += doubt;
        }
        let (_, top, explained) = optima.swap_remove(0);
        (Refined { pose, covariance: covariance / odds, ..top }, explained)
    }

    /// Refines a top by all there is to see, its covariance included. Where it is open whether the object
    /// rests on the ground about it, it gets the mean of both.
    fn polish(&self, top: &mut Refined) {
        let finish = |refined: &mut Refined| {
            // Print was looked for where the contour had the object: where both have it is better.
            if !refined.patches.is_empty() {
                self.refine(refined, &[FINAL]);
                refined.patches.retain(Patch::on_ground);
                refined.patches.extend(self.print(refined));
            }
            self.refine(refined, &[POLISH]);
            self.doubt(refined, &FINAL);
        };
        let (ground, print): (Vec<Patch>, Vec<Patch>) =
            top.patches.iter().cloned().partition(Patch::on_ground);
        if ground.is_empty() {
            return finish(top);
        }
        let mut lifted = Refined { patches: print, ..top.clone() };
        self.doubt(&mut lifted, &FINAL);
        let contact = print::contact(&ground, &lifted.covariance);
        if contact < 1.0 - SURE {
            *top = lifted;
            return finish(top);
        }
        finish(top);
        if contact < SURE {
            finish(&mut lifted);
            let apart = difference(&top.pose, &lifted.pose);
            top.pose = perturb(&top.pose, &(apart * (1.0 - contact)));
            top.covariance = top.covariance * contact
                + lifted.covariance * (1.0 - contact)
                + apart * apart.transpose() * (contact * (1.0 - contact));
        }
    }
}
