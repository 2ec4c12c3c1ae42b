//! Where to look next until both heads see the light.
//!
//! In: both heads, the [`Field`] in which the light may be, a prior place when there is one. Out, one
//! at a time: the angles of both heads for the next dwell.
//!
//! The field is a set of sample points (directions times a few distances) with weights; a view covers
//! the samples that it would show, lever arms and parallax included. Every call picks, for both heads
//! together, the views with the most uncovered weight per second of slew and dwell:
//!
//! - what no head has looked at counts full, what only the other head has looked at counts
//!   [`SECOND_LOOK`] (the light may shine past one of them): so the heads first share the field, then
//!   exchange halves;
//! - samples near the prior place weigh so much that both heads look there first;
//! - once one head has seen the light ([`Search::sighted`]), the samples are points along its line of
//!   sight, near and likely distances first, and only the other head moves.
//!
//! No view is given twice. Without a prior the first is where the heads look already, so a light in
//! sight costs no move; the others lie on a grid that covers all that a head can reach.

use nalgebra::{Point2, Point3, Vector3};
use vergence_geometry::GaussianPoint;

use crate::PanTiltHead;

/// Worth of a sample that the other head has looked at without success.
const SECOND_LOOK: f64 = 0.05;
/// Worth of a sample that the other head looks at in the same dwell: if the light is there, both have
/// it at once.
const SHARED_LOOK: f64 = 0.3;
/// How much surer the prior is than all other places together: four times.
const PRIOR_GAIN: f64 = 4.0;
/// Smallest width of the prior (m): the object may have been pushed since.
const PRIOR_WIDTH: f64 = 0.15;
/// Points along a line of sight.
const ARC_SAMPLES: usize = 96;

/// Where the light may be: directions from the middle of the head, in base, and distances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Field {
    /// Bearings (rad), positive to the left.
    pub pan: [f64; 2],
    /// Slopes (rad), positive downwards.
    pub tilt: [f64; 2],
    /// Nearest and farthest distance (m).
    pub distance: [f64; 2],
}

impl Field {
    /// All directions that either head can turn to, 0.4 m to 2.5 m away.
    pub fn reachable(heads: &[PanTiltHead; 2]) -> Self {
        let limits = [heads[0].limits(), heads[1].limits()];
        let span = |joint: usize| {
            [
                limits[0][joint].lower.min(limits[1][joint].lower),
                limits[0][joint].upper.max(limits[1][joint].upper),
            ]
        };
        Field { pan: span(0), tilt: span(1), distance: [0.4, 2.5] }
    }
}

/// How views are valued.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchConfig {
    /// Part of the picture's smaller side, at each border, that does not count as seen: the finder
    /// needs room around the light, and servos do not stop where they should.
    pub margin: f64,
    /// Time of one dwell (s): the longer, the less slewing matters for the order.
    pub dwell: f64,
}

impl Default for SearchConfig {
    /// A tenth of the picture; half a second, 15 frames at 30 a second.
    fn default() -> Self {
        SearchConfig { margin: 0.1, dwell: 0.5 }
    }
}

struct Sample {
    point: Point3<f64>,
    weight: f64,
    /// Looked at by the left, by the right head.
    seen: [bool; 2],
}

struct View {
    angles: [f64; 2],
    /// Indices of the samples that it shows.
    covers: Vec<u32>,
}

/// The search's state, see the module's text.
pub struct Search {
    heads: [PanTiltHead; 2],
    config: SearchConfig,
    field: Field,
    samples: Vec<Sample>,
    views: [Vec<View>; 2],
    started: bool,
    has_prior: bool,
    sighted: [bool; 2],
}

impl Search {
    /// Plans a search. `prior` is where the light was last seen, or is likely.
    pub fn new(
        heads: &[PanTiltHead; 2],
        field: &Field,
        prior: Option<&GaussianPoint>,
        config: &SearchConfig,
    ) -> Self {
        let mut search = Search {
            heads: heads.clone(),
            config: *config,
            field: *field,
            samples: field_samples(heads, field, prior, config),
            views: [vec![], vec![]],
            started: false,
            has_prior: prior.is_some(),
            sighted: [false; 2],
        };
        search.views = [0, 1].map(|k| search.grid_of_views(k));
        search
    }

    /// Angles of both heads for the next dwell; `None` when everything has been looked at, or both
    /// heads have sighted the light. A head with nothing to look at stays where it is.
    pub fn next(&mut self, current: [[f64; 2]; 2]) -> Option<[[f64; 2]; 2]> {
        // At its limit a joint's encoder, which counts in steps, may tell an angle beyond it.
        let current = [0, 1].map(|k| self.heads[k].clamp(current[k]));
        if !self.started {
            self.started = true;
            let mut useful = false;
            for k in 0..2 {
                let here = self.view(k, current[k]);
                if self.has_prior {
                    self.views[k].push(here);
                } else if !self.sighted[k] && !self.useless(k, &here) {
                    useful = true;
                    here.covers.iter().for_each(|&i| self.samples[i as usize].seen[k] = true);
                }
            }
            if useful && !self.has_prior {
                return Some(current);
            }
        }
        let mut best: Option<(f64, [Option<usize>; 2])> = None;
        for first in 0..2 {
            // Greedy for one head, then for the other given the first; the better order wins.
            let mut choice = [None, None];
            let mut taken = vec![false; self.samples.len()];
            let (mut gain, mut slew) = (0.0, 0.0f64);
            for k in [first, 1 - first] {
                let Some((index, worth, time)) = self.best_view(k, current[k], slew, gain, &taken)
                else {
                    continue;
                };
                choice[k] = Some(index);
                gain += worth;
                slew = slew.max(time);
                for &i in &self.views[k][index].covers {
                    taken[i as usize] = true;
                }
            }
            let rate = gain / (slew + self.config.dwell);
            if gain > 0.0 && best.is_none_or(|(r, _)| rate > r) {
                best = Some((rate, choice));
            }
        }
        let (_, choice) = best?;
        let mut target = current;
        for k in 0..2 {
            if let Some(index) = choice[k] {
                let view = self.views[k].swap_remove(index);
                view.covers.iter().for_each(|&i| self.samples[i as usize].seen[k] = true);
                target[k] = view.angles;
            }
        }
        Some(target)
    }

    /// One head (0 left, 1 right) has seen the light at these angles and this pixel: from now on
    /// the other looks along that line of sight.
    pub fn sighted(&mut self, head: usize, angles: [f64; 2], pixel: &Point2<f64>) {
        self.sighted[head] = true;
        let other = 1 - head;
        if self.sighted[other] {
            self.samples.clear();
            self.views = [vec![], vec![]];
            return;
        }
        let ray = self.heads[head].ray(angles, pixel);
        let [near, far] = self.field.distance;
        let ratio = (far / near).max(1.0 + 1e-9);
        self.samples = (0..ARC_SAMPLES)
            .map(|i| {
                let distance = near * ratio.powf(i as f64 / (ARC_SAMPLES - 1) as f64);
                // Even in the logarithm of the distance: what is near gets more, as robots reach it.
                Sample { point: ray.at(distance), weight: 1.0, seen: [false; 2] }
            })
            .collect();
        self.views[head].clear();
        self.views[other] = (0..ARC_SAMPLES)
            .filter_map(|i| self.heads[other].look_at(&self.samples[i].point))
            .map(|angles| self.view(other, angles))
            .collect();
        // The light may be in the other's sight already: `next` first offers to stay.
        (self.started, self.has_prior) = (false, false);
    }

    /// True when `next` has nothing left to offer.
    pub fn exhausted(&self) -> bool {
        self.sighted == [true; 2]
            || (self.started && (0..2).all(|k| self.views[k].iter().all(|v| self.useless(k, v))))
    }

    /// Part of the reachable field (by weight) that at least one head has been sent to look at.
    pub fn coverage(&self) -> f64 {
        let total: f64 = self.samples.iter().map(|s| s.weight).sum();
        let seen = self.samples.iter().filter(|s| s.seen != [false; 2]).map(|s| s.weight);
        seen.sum::<f64>() / total.max(f64::MIN_POSITIVE)
    }

    fn useless(&self, head: usize, view: &View) -> bool {
        view.covers.iter().all(|&i| self.samples[i as usize].seen[head])
    }

    /// The view of one head with the best rate for both, given what the other already gains.
    fn best_view(
        &self,
        head: usize,
        current: [f64; 2],
        slew: f64,
        gain: f64,
        taken: &[bool],
    ) -> Option<(usize, f64, f64)> {
        let value = |view: &View| -> f64 {
            let worth = |&i: &u32| {
                let sample = &self.samples[i as usize];
                if sample.seen[head] {
                    0.0
                } else if taken[i as usize] {
                    SHARED_LOOK * sample.weight
                } else if sample.seen[1 - head] {
                    SECOND_LOOK * sample.weight
                } else {
                    sample.weight
                }
            };
            view.covers.iter().map(worth).sum()
        };
        let mut best: Option<(f64, usize, f64, f64)> = None;
        for (index, view) in self.views[head].iter().enumerate() {
            let worth = value(view);
            if worth <= 0.0 {
                continue;
            }
            let time = self.heads[head].slew_time(current, view.angles);
            let rate = (gain + worth) / (slew.max(time) + self.config.dwell);
            if best.is_none_or(|(r, ..)| rate > r) {
                best = Some((rate, index, worth, time));
            }
        }
        best.map(|(_, index, worth, time)| (index, worth, time))
    }

    fn view(&self, head: usize, angles: [f64; 2]) -> View {
        let margin = margin_px(&self.heads[head], &self.config);
        let covers = (0..self.samples.len() as u32)
            .filter(|&i| self.heads[head].sees(angles, &self.samples[i as usize].point, margin))
            .collect();
        View { angles, covers }
    }

    /// Views of one head that cover all it can reach: rows of tilt, columns of pan, as wide apart
    /// as the picture without its margin; then a view at every sample that still lacks one.
    fn grid_of_views(&self, head: usize) -> Vec<View> {
        let body = &self.heads[head];
        let limits = body.limits();
        let margin = margin_px(body, &self.config);
        let angle = |size: usize, focal: f64| 2.0 * ((size as f64 / 2.0 - margin) / focal).atan();
        let spacing =
            [angle(body.camera.width, body.camera.fx), angle(body.camera.height, body.camera.fy)];
        let range = |joint: usize, wanted: [f64; 2]| {
            let (lower, upper) = (limits[joint].lower, limits[joint].upper);
            // The outermost view need not be centred on the field's border, but half a picture in.
            let half = spacing[joint] / 2.0;
            let (low, high) = (wanted[0] + half, wanted[1] - half);
            let middle = (wanted[0] + wanted[1]) / 2.0;
            let (low, high) = if low > high { (middle, middle) } else { (low, high) };
            (low.clamp(lower, upper), high.clamp(lower, upper))
        };
        let (pan_low, pan_high) = range(0, self.field.pan);
        let (tilt_low, tilt_high) = range(1, self.field.tilt);
        let mut views = Vec::new();
        for tilt in evenly(tilt_low, tilt_high, spacing[1]) {
            // Off the horizon a picture spans more bearing.
            for pan in evenly(pan_low, pan_high, spacing[0] / tilt.cos().max(0.3)) {
                views.push(self.view(head, [pan, tilt]));
            }
        }
        let mut covered = vec![false; self.samples.len()];
        views.iter().flat_map(|v| &v.covers).for_each(|&i| covered[i as usize] = true);
        while let Some(missing) = covered.iter().position(|c| !c) {
            covered[missing] = true;
            let Some(angles) = body.look_at(&self.samples[missing].point) else { continue };
            let view = self.view(head, angles);
            view.covers.iter().for_each(|&i| covered[i as usize] = true);
            views.push(view);
        }
        views
    }
}

fn margin_px(head: &PanTiltHead, config: &SearchConfig) -> f64 {
    config.margin * head.camera.width.min(head.camera.height) as f64
}

/// Values from `low` to `high`, both included, no farther apart than `spacing`.
fn evenly(low: f64, high: f64, spacing: f64) -> Vec<f64> {
    let gaps = ((high - low) / spacing.max(1e-3)).ceil().max(0.0) as usize;
    (0..=gaps)
        .map(|i| match gaps {
            0 => (low + high) / 2.0,
            _ => low + (high - low) * i as f64 / gaps as f64,
        })
        .collect()
}

/// The field as points: directions a sixth of a picture apart, three distances.
fn field_samples(
    heads: &[PanTiltHead; 2],
    field: &Field,
    prior: Option<&GaussianPoint>,
    config: &SearchConfig,
) -> Vec<Sample> {
    let origin = |k: usize| heads[k].base_from_optical(heads[k].clamp([0.0; 2])).translation.vector;
    let middle = Point3::from((origin(0) + origin(1)) / 2.0);
    let camera = &heads[0].camera;
    let fine = |size: usize, focal: f64| (size as f64 / 6.0 / focal).max(0.02);
    let [near, far] = field.distance;
    let distances = [near, (near * far).sqrt(), far];
    let density = prior.map(|p| {
        let covariance = p.covariance + nalgebra::Matrix3::identity() * PRIOR_WIDTH * PRIOR_WIDTH;
        (p.position, covariance.try_inverse().unwrap_or_else(nalgebra::Matrix3::zeros))
    });
    let margins = [0, 1].map(|k| margin_px(&heads[k], config));
    let mut samples = Vec::new();
    for tilt in evenly(field.tilt[0], field.tilt[1], fine(camera.height, camera.fy)) {
        for pan in evenly(field.pan[0], field.pan[1], fine(camera.width, camera.fx)) {
            let (st, ct) = tilt.sin_cos();
            let direction = Vector3::new(ct * pan.cos(), ct * pan.sin(), -st);
            for distance in distances {
                let point = middle + direction * distance;
                let reachable = (0..2).any(|k| {
                    let angles = heads[k].aim_at(&point);
                    heads[k].sees(angles, &point, margins[k])
                });
                if !reachable {
                    continue;
                }
                // Solid angle.
                let weight = ct.max(0.05);
                samples.push(Sample { point, weight, seen: [false; 2] });
            }
        }
    }
    if let Some((place, inverse)) = density {
        let likely = |s: &Sample| {
            let off = s.point - place;
            s.weight * (-0.5 * off.dot(&(inverse * off))).exp()
        };
        let total: f64 = samples.iter().map(|s| s.weight).sum();
        let mass: f64 = samples.iter().map(likely).sum();
        for sample in &mut samples {
            sample.weight += PRIOR_GAIN * total * likely(sample) / mass.max(f64::MIN_POSITIVE);
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::heads;
    use nalgebra::Matrix3;

    fn search(prior: Option<&GaussianPoint>) -> Search {
        let heads = heads();
        Search::new(&heads, &Field::reachable(&heads), prior, &SearchConfig::default())
    }

    /// Runs until `stop` says so; dwells and seconds spent.
    fn run(
        search: &mut Search,
        mut stop: impl FnMut(&Search, [[f64; 2]; 2]) -> bool,
    ) -> (usize, f64) {
        let (mut at, mut dwells, mut seconds) = ([[0.0; 2]; 2], 0, 0.0);
        while let Some(next) = search.next(at) {
            let heads = heads();
            seconds += (0..2).map(|k| heads[k].slew_time(at[k], next[k])).fold(0.0, f64::max) + 0.5;
            (at, dwells) = (next, dwells + 1);
            if stop(search, at) {
                break;
            }
        }
        (dwells, seconds)
    }

    #[test]
    fn both_heads_together_need_half_the_views() {
        let mut search = search(None);
        let grid = search.views[0].len();
        let (dwells, seconds) = run(&mut search, |s, _| s.coverage() >= 0.98);
        assert!(search.coverage() >= 0.98, "{}", search.coverage());
        // 3.6 rad by 2 rad in pictures of 0.8 by 0.6 rad that overlap.
        assert!((20..=60).contains(&grid), "{grid}");
        assert!(dwells <= grid / 2, "{dwells} dwells of {grid} views");
        assert!(seconds < 0.8 * dwells as f64, "{seconds} s: slews are short");
    }

    #[test]
    fn every_reachable_light_is_seen_by_both_heads_in_the_end() {
        let heads = heads();
        let mut search = search(None);
        let points: Vec<Point3<f64>> = (0..200)
            .map(|i| {
                let (pan, tilt) = ((i % 20) as f64 * 0.15 - 1.45, (i / 20) as f64 * 0.17 - 0.6);
                let r = 0.5 + 0.1 * (i % 7) as f64;
                Point3::new(0.04, 0.0, 0.55)
                    + r * Vector3::new(tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), -tilt.sin())
            })
            .collect();
        let mut seen = vec![[false; 2]; points.len()];
        run(&mut search, |_, at| {
            for (point, seen) in points.iter().zip(&mut seen) {
                (0..2).for_each(|k| seen[k] |= heads[k].sees(at[k], point, 4.0));
            }
            false
        });
        assert!(search.exhausted());
        let missed = seen.iter().filter(|s| **s != [true; 2]).count();
        assert_eq!(missed, 0, "lights that a head never looked at");
    }

    #[test]
    fn what_is_in_sight_costs_no_move_and_a_prior_comes_first() {
        let at = [[0.1, 0.2]; 2];
        assert_eq!(search(None).next(at), Some(at));
        let place = Point3::new(0.1, -1.0, 0.3);
        let prior = GaussianPoint { position: place, covariance: Matrix3::identity() * 1e-3 };
        let heads = heads();
        let next = search(Some(&prior)).next(at).unwrap();
        assert!((0..2).any(|k| heads[k].sees(next[k], &place, 20.0)), "{next:?}");
    }

    #[test]
    fn the_other_head_follows_the_line_of_sight() {
        let heads = heads();
        for distance in [0.45, 0.8, 1.5, 2.4] {
            let mut search = search(None);
            let light =
                Point3::new(0.04, 0.0, 0.55) + distance * Vector3::new(0.5, 0.8, -0.3).normalize();
            let left = heads[0].look_at(&light).unwrap();
            search.next([left, [0.0, 0.0]]);
            let pixel = heads[0].project(left, &light).unwrap();
            search.sighted(0, left, &pixel);
            let (mut at, mut dwells) = ([left, [0.0, 0.0]], 0);
            while !heads[1].sees(at[1], &light, 10.0) {
                at = search.next(at).expect("the arc holds the light");
                assert_eq!(at[0], left, "the head that sees it stays");
                dwells += 1;
            }
            assert!(dwells <= 2, "{dwells} dwells at {distance} m");
            search.sighted(1, at[1], &heads[1].project(at[1], &light).unwrap());
            assert!(search.exhausted() && search.next(at).is_none());
        }
    }
}
