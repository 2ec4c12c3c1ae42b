//! Whether noise explains what is seen.
//!
//! Against noise as it is around the place, the log likelihood ratio must pass `ln(M / alpha)`, M the
//! number of independent places times requests: Ville's bound over the whole picture and all frames;
//! phases, rates and amplitudes are averaged over and cost nothing more. Against a restless place, whose
//! noise is its own and unknown (a swaying edge, a screen), M is the number of such places.

use nalgebra::Point2;

use super::super::front::BLOB_VARIANCE;
use super::super::nuisance::dot;
use super::{GHOST, Round, Seen};

/// Restless places to reckon with where the picture shows none but the one in question: so many in so
/// many pixels.
const UNSEEN: (f64, f64) = (0.002, 640.0 * 480.0);

/// Log likelihood ratio that presence needs in a picture of this size.
pub fn presence(size: (usize, usize), requests: usize, false_alarm: f64) -> f64 {
    // Places that are independent under the blur of a light: area over 4 pi s^2.
    let cells = (size.0 * size.1) as f64 / (2.0 * std::f64::consts::PI * BLOB_VARIANCE);
    (cells * requests as f64 / false_alarm).ln()
}

impl Round<'_> {
    /// Log likelihood ratio that presence needs.
    pub(super) fn presence(&self) -> f64 {
        presence(self.size, self.requests.len(), self.config.false_alarm)
    }

    /// Whether noise is beaten: that around, and the unknown one of a restless place.
    pub(super) fn is_present(&self, request: usize, seen: &Seen) -> bool {
        // Places close by may be ghosts of this one, and a light that is known already is no riddle.
        let far = |a: &Point2<f64>, b: &Point2<f64>| (a - b).norm() > GHOST.0;
        let others = self.restless.iter().filter(|p| far(p, &seen.place));
        let unknown = others.filter(|p| self.known.iter().all(|k| far(p, k))).count() as f64;
        let area = (self.size.0 * self.size.1) as f64 / UNSEEN.1;
        let chances = (unknown + UNSEEN.0 * area) * self.requests.len() as f64;
        let restless = seen.evidence.restless * self.whiteness(request, seen);
        seen.evidence.log_ratio >= self.presence()
            && restless >= (chances / self.config.false_alarm).ln()
    }

    /// Share of the evidence that counts where what the request leaves has a memory of some frames, as a
    /// screen has that changes more slowly than the camera looks: so many fewer frames tell anything.
    fn whiteness(&self, request: usize, seen: &Seen) -> f64 {
        let (evidence, series) = (&seen.evidence, &seen.series);
        let (pattern, times) = (&self.requests[request].pattern, self.history.times());
        let mut rest = Vec::new();
        series.expect(pattern, times, &evidence.best, self.nuisance, &mut rest);
        let amplitude = evidence.amplitude() as f32;
        rest.iter_mut().zip(&series.values).for_each(|(r, v)| *r = v - amplitude * *r);
        let (energy, n) = (dot(&rest, &rest).max(1e-9), rest.len());
        // Beyond what chance shows of white noise.
        let memory =
            f64::from(dot(&rest[1..], &rest[..n - 1]) / energy) - (n as f64).sqrt().recip();
        // The variance of a mean under a memory that fades by this share from frame to frame.
        (1.0 - memory.max(0.0)) / (1.0 + memory.max(0.0))
    }
}
