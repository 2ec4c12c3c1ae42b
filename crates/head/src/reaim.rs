//! Aiming at one light again and again, an encoder step further each time, until its distance is known.
//!
//! In: the heads, the angles at which both see the light, how far encoders can be trusted. Out: the
//! angles to go to next, and the landmark from all fixations that were added. What sees and turns is the
//! caller's: a find does it with devices, [`crate::evaluation`] with simulated servos.
//!
//! A servo rests anywhere within the step that its encoder reads, and pixels tell how the angles of two
//! fixations differ. So every further step is a new draw: where it happens to rest near the end of its
//! step, it cuts what the angles' common error can be (module `bounded`). Nobody can choose where in a
//! step a servo comes to rest, so no order of steps cuts better than another; the next one upwards is
//! the quickest, and leaves the slack of the gears on one side.
//!
//! **When to stop.** After every [`BATCH`] of aims: when the distance is known to
//! [`ReaimConfig::depth_sigma`], when another batch would narrow it by less than
//! [`ReaimConfig::least_gain`], or after [`ReaimConfig::most`].

use vergence_geometry::GaussianPoint;

use crate::calibration::{distance_sigma, middle};
use crate::{Fixation, Landmark, Noise, PanTiltHead, TriangulateError, triangulate_many};

/// Aims between two looks at what has been reached.
const BATCH: usize = 4;

/// When a light is known well enough.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReaimConfig {
    /// Standard deviation of the landmark's distance that is good enough (m).
    pub depth_sigma: f64,
    /// Part by which another four aims, half a second, must narrow it.
    pub least_gain: f64,
    /// Most times that the heads aim again; fewer than four switch it off.
    pub most: usize,
}

impl Default for ReaimConfig {
    /// What a grasp can use of a landmark, and the most that one is worth waiting for: some three seconds.
    fn default() -> Self {
        ReaimConfig { depth_sigma: 0.0015, least_gain: 0.05, most: 24 }
    }
}

/// The aims at one light.
#[derive(Debug)]
pub struct Reaim<'a> {
    heads: &'a [PanTiltHead; 2],
    centre: [[f64; 2]; 2],
    /// Encoder step of either head (rad).
    steps: [f64; 2],
    noise: Noise,
    config: ReaimConfig,
    aims: usize,
    /// What was seen, left and right.
    seen: [Vec<Fixation>; 2],
}

impl<'a> Reaim<'a> {
    /// Aims around `centre`, the angles of both heads at which they see the light. `noise` is that of
    /// joints that come from below.
    pub fn new(
        heads: &'a [PanTiltHead; 2],
        centre: [[f64; 2]; 2],
        steps: [f64; 2],
        noise: Noise,
        config: ReaimConfig,
    ) -> Self {
        Reaim { heads, centre, steps, noise, config, aims: 0, seen: Default::default() }
    }

    /// Whether a light that is known so far is to be aimed at again at all.
    pub fn begins(&self, known: &GaussianPoint) -> bool {
        let known = Landmark { point: *known, gap_sigmas: 0.0 };
        let sigma = known.distance_from(&middle(self.heads)).1;
        self.config.most >= BATCH && sigma > self.config.depth_sigma
    }

    /// Where to start from: below the first aim by more than the slack (rad) of either head.
    pub fn run_up(&self, backlash: [f64; 2]) -> [[f64; 2]; 2] {
        [0, 1].map(|k| {
            let run_up = 1.5 * backlash[k] + self.steps[k];
            self.heads[k].clamp(self.aim(k, 0).map(|angle| angle - run_up))
        })
    }

    /// The next angles of both heads; `None` when the light is known well enough.
    pub fn next_aim(&mut self) -> Result<Option<[[f64; 2]; 2]>, TriangulateError> {
        let full = self.aims > 0 && self.aims.is_multiple_of(BATCH);
        if self.aims >= self.config.most || full && self.enough()? {
            return Ok(None);
        }
        self.aims += 1;
        Ok(Some([0, 1].map(|k| self.aim(k, self.aims))))
    }

    /// Adds what a head saw at the angles that [`Self::next_aim`] gave; a head that saw nothing adds nothing.
    pub fn add(&mut self, head: usize, fixation: Fixation) {
        self.seen[head].push(fixation);
    }

    /// The fixations so far, left and right.
    pub fn seen(&self) -> &[Vec<Fixation>; 2] {
        &self.seen
    }

    /// Aims so far.
    pub fn aims(&self) -> usize {
        self.aims
    }

    /// The light from all fixations so far; `None` when a head has fewer than a batch of them.
    pub fn landmark(&self) -> Result<Option<Landmark>, TriangulateError> {
        if self.seen.iter().any(|seen| seen.len() < BATCH) {
            return Ok(None);
        }
        let [left, right] = &self.seen;
        triangulate_many(self.heads, [left, right], &self.noise).map(Some)
    }

    /// The angles of an aim: one step upwards each, the light passing the image centre half way.
    fn aim(&self, head: usize, aim: usize) -> [f64; 2] {
        let offset = (aim as f64 - 0.5 * self.config.most as f64) * self.steps[head];
        self.heads[head].clamp(self.centre[head].map(|angle| angle + offset))
    }

    fn enough(&self) -> Result<bool, TriangulateError> {
        let Some(landmark) = self.landmark()? else { return Ok(false) };
        let from = middle(self.heads);
        let sigma = landmark.distance_from(&from).1;
        // What the angles have in common stays however often the heads aim; the rest is an interval's
        // width, which falls as one over the number of its cuts.
        let common = self.common_sigma(&landmark);
        let batches = (self.aims / BATCH) as f64;
        let cut = (sigma * sigma - common * common).max(0.0) * (batches / (batches + 1.0)).powi(2);
        let next = (cut + common * common).sqrt();
        Ok(sigma <= self.config.depth_sigma || next > (1.0 - self.config.least_gain) * sigma)
    }

    /// Standard deviation of the distance if encoders had no steps.
    fn common_sigma(&self, landmark: &Landmark) -> f64 {
        let common = self.noise.common_sigma;
        distance_sigma(self.heads, &landmark.point.position, common).unwrap_or(0.0)
    }
}
