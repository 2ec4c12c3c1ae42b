//! Where a light is: the sub-pixel maximum for the tests, a fit of its spot for the answer.

use nalgebra::{Matrix2, Point2, Vector2};

use super::super::evidence::{Series, refine, unexplained, weigh};
use super::super::front::{BLOB_VARIANCE, BOX_SHARE};
use super::super::history::noise_share;
use super::super::nuisance::dot;
use super::super::scan::MARGIN;
use super::super::spot;
use super::super::surroundings::intruders;
use super::banks::Banks;
use super::{GHOST, Round, Seen};
use crate::Sighting;

/// Systematic part of a position's standard deviation (px): a light is no perfect point.
const FLOOR_PX: f64 = 0.02;

impl Round<'_> {
    /// Moves a place to the sub-pixel maximum of its light, and weighs it again there.
    pub(super) fn sharpen(&self, request: usize, seen: Seen, banks: &mut Banks) -> Option<Seen> {
        let pattern = &self.requests[request].pattern;
        let step = banks.own(self, request).step;
        let (mut place, mut evidence, mut series) = (seen.place, seen.evidence, seen.series);
        let (mut raw, mut expected, mut scratch) = (Vec::new(), Vec::new(), Vec::new());
        if series.local.is_empty() {
            let pixel = (place.x as usize, place.y as usize);
            self.history.series_at(pixel, &mut raw);
            let local = intruders(self.history, pixel, &raw, self.nuisance, series.noise);
            if !local.is_empty() {
                series = Series::new(&raw, self.nuisance, local, series.noise);
                evidence = weigh(&series, banks.own(self, request), self.floor(), &mut scratch)?;
            }
        }
        for _ in 0..2 {
            evidence =
                refine(&series, pattern, self.history.times(), self.nuisance, evidence, step);
            let times = self.history.times();
            series.expect(pattern, times, &evidence.best, self.nuisance, &mut expected);
            let moved = self.peak(place, &expected, &mut raw);
            let (dx, dy) = (moved.x - seen.place.x, moved.y - seen.place.y);
            if dx.abs().max(dy.abs()) > 2.0 {
                return None;
            }
            place = moved;
            self.history.series(place, &mut raw);
            let noise = self.noise.at(place.x as usize, place.y as usize) * noise_share(place);
            series = Series::new(&raw, self.nuisance, series.local, noise);
            let own = evidence.correlation.powi(2);
            if self.add_brighter(place, own, &mut series.local) {
                series = Series::new(&raw, self.nuisance, series.local, noise);
            }
            let again = weigh(&series, banks.own(self, request), self.floor(), &mut scratch)?;
            evidence = again;
        }
        evidence = refine(&series, pattern, self.history.times(), self.nuisance, evidence, step);
        Some(Seen { at: seen.at, place, evidence, series })
    }

    /// Adds the courses of lights close by that are so much brighter than a light of this energy that
    /// filter and JPEG blocks leave ghosts of them, however they blink. Whether there are any.
    fn add_brighter(&self, place: Point2<f64>, own: f64, local: &mut Vec<Vec<f32>>) -> bool {
        let before = local.len();
        let mut course = Vec::new();
        for other in self.restless.iter().filter(|p| (*p - place).norm() < GHOST.0) {
            self.history.series_at((other.x as usize, other.y as usize), &mut course);
            self.nuisance.remove(&mut course);
            for known in local.iter() {
                let share = dot(known, &course);
                course.iter_mut().zip(known).for_each(|(c, k)| *c -= share * k);
            }
            let energy = dot(&course, &course);
            if GHOST.1 * GHOST.1 * f64::from(energy) > own {
                let scale = energy.sqrt().recip();
                local.push(course.iter().map(|c| c * scale).collect());
            }
        }
        local.len() > before
    }

    /// Where the light is strongest near a place: on whole pixels, where nothing is interpolated, the
    /// logarithms of a Gaussian blob and of its neighbours are a parabola.
    fn peak(&self, start: Point2<f64>, expected: &[f32], raw: &mut Vec<f32>) -> Point2<f64> {
        let far = |n: usize| n - 1 - MARGIN;
        let mut at = |x: usize, y: usize| {
            self.history.series_at((x, y), raw);
            f64::from(dot(expected, raw))
        };
        let (mut x, mut y) = (start.x.round() as usize, start.y.round() as usize);
        for _ in 0..3 {
            (x, y) = (x.clamp(MARGIN, far(self.size.0)), y.clamp(MARGIN, far(self.size.1)));
            let around = [(x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
            let best = around.map(|(u, v)| (at(u, v), (u, v)));
            let top = best.iter().fold(best[0], |a, b| if b.0 > a.0 { *b } else { a });
            if top.1 == (x, y) {
                // The box that the filter subtracts takes the same from all five.
                let level = |k: usize| (best[k].0 + BOX_SHARE * best[0].0).max(1e-9).ln();
                let offset = |before: usize, after: usize| {
                    let curvature = level(before) - 2.0 * level(0) + level(after);
                    let slope = level(before) - level(after);
                    if curvature < -1e-9 { (0.5 * slope / curvature).clamp(-0.6, 0.6) } else { 0.0 }
                };
                return Point2::new(x as f64 + offset(1, 2), y as f64 + offset(3, 4));
            }
            (x, y) = top.1;
        }
        Point2::new(x as f64, y as f64)
    }

    pub(super) fn sighting(&self, request: usize, seen: &Seen) -> Sighting {
        let (evidence, series) = (&seen.evidence, &seen.series);
        // The larger of the noise around and of what this place leaves unexplained.
        let noise = series.noise.max(unexplained(series, evidence) / series.freedom);
        let snr = evidence.correlation / noise.sqrt();
        let (place, covariance) = self.centre(request, seen, noise);
        let period = self.requests[request].pattern.period().as_secs_f64();
        let last = self.history.times().last().map_or(0.0, |t| t.0);
        Sighting {
            pixel: self.shown(place),
            covariance: covariance + Matrix2::identity() * (FLOOR_PX * FLOOR_PX),
            amplitude: evidence.amplitude(),
            snr,
            phase: (evidence.best.phase + evidence.best.rate * last).rem_euclid(period),
            decided_at: self.stamp,
            frames: self.frames,
        }
    }

    /// The centre of the light and its covariance, by a fit of the spot; `noise` is that of the place.
    fn centre(&self, request: usize, seen: &Seen, noise: f64) -> (Point2<f64>, Matrix2<f64>) {
        let (x, y) = (seen.place.x.round(), seen.place.y.round());
        let mut expected = Vec::new();
        let pattern = &self.requests[request].pattern;
        let (times, best) = (self.history.times(), &seen.evidence.best);
        seen.series.expect(pattern, times, best, self.nuisance, &mut expected);
        let length = seen.evidence.best.norm2.sqrt();
        let mut raw = Vec::new();
        let patch: [f64; spot::PIXELS] = std::array::from_fn(|k| {
            let side = 2 * spot::HALF as usize + 1;
            let at = |c: f64, k: usize| (c as usize + k).saturating_sub(spot::HALF as usize);
            self.history.series_at((at(x, k % side), at(y, k / side)), &mut raw);
            f64::from(dot(&expected, &raw)) / length
        });
        // Noise of the fit is that of pixels; the place between pixels has less.
        let noise = noise / noise_share(seen.place);
        let start = Vector2::new(seen.place.x - x, seen.place.y - y);
        match spot::fit(&patch, start) {
            Some(spot) => (Point2::new(x, y) + spot.offset, spot.covariance * noise),
            // Cramer-Rao: the slope of the matched filter's output against its curvature.
            None => {
                let snr2 = seen.evidence.correlation.powi(2) / noise;
                (seen.place, Matrix2::identity() * (BLOB_VARIANCE / snr2))
            }
        }
    }

    /// A place of the first frame in the mean picture of the window.
    pub(super) fn shown(&self, place: Point2<f64>) -> Point2<f64> {
        let (dx, dy) = self.history.mean_shift();
        Point2::new(place.x + dx, place.y + dy)
    }
}
