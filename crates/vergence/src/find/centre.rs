//! Steps 2 and 3 of the paper: the light is brought to the centre of both pictures, and the joint
//! angles give its place.

use nalgebra::Point3;
use vergence_devices::{JointReading, Side, TagAddress};
use vergence_geometry::GaussianPoint;
use vergence_head::{
    Fixation, Fixator, FixatorConfig, GATE_SIGMAS, NextMove, Noise, PaperAngles, epipolar_gap,
    paper_distance, triangulate,
};
use vergence_landmark::Sighting;
use vergence_tag::Pattern;

use super::search::Seen;
use super::{Missing, Run, Stop};
use crate::event::Event;
use crate::report::LandmarkReport;

/// Moves after which the rest is left in the pixel.
const MAX_MOVES: usize = 3;

impl Run<'_> {
    /// Centres the light in both pictures.
    pub(super) fn centre(
        &mut self,
        pattern: &Pattern,
        seen: [Seen; 2],
    ) -> Result<[Fixation; 2], Stop> {
        let mut held = self.same_light([&seen[0], &seen[1]]);
        let mut fixators = [0, 1].map(|k| {
            let servos = &self.system.robot.heads[k].pan_tilt;
            Fixator::new(FixatorConfig {
                resolution: servos.resolution(),
                backlash: servos.backlash(),
                max_moves: MAX_MOVES,
            })
        });
        loop {
            let moves: [NextMove; 2] = std::array::from_fn(|k| {
                let (joints, sighting) = &held[k];
                let angles = [joints.pan, joints.tilt];
                fixators[k].next(&self.system.heads[k], angles, &sighting.pixel, None)
            });
            if moves == [NextMove::Hold; 2] {
                break;
            }
            let joints = self.approach(&moves)?;
            let moved: [bool; 2] = std::array::from_fn(|k| moves[k] != NextMove::Hold);
            let readings = std::array::from_fn(|k| moved[k].then_some(joints[k]));
            let sightings = self.watch(pattern, readings)?;
            for (k, sightings) in sightings.into_iter().enumerate().filter(|(k, _)| moved[*k]) {
                let nearest = self.nearest_to_centre(k, sightings);
                held[k] = (joints[k], nearest.ok_or(Stop::Lost(Side::BOTH[k].name()))?);
            }
        }
        for (side, (joints, sighting)) in Side::BOTH.iter().zip(&held) {
            self.observer.notice(&Event::Centred(*side, *joints, sighting));
        }
        Ok(held.map(|(joints, sighting)| fixation(&joints, &sighting)))
    }

    /// Looks with both heads at a place where the light should be: what each sees no further than
    /// `reach` (m) from it. Mirrors and what the hand reflects lie further away.
    pub(crate) fn watch_near(
        &mut self,
        pattern: &Pattern,
        near: &Point3<f64>,
        reach: f64,
    ) -> Result<[Seen; 2], Stop> {
        let targets = [0, 1].map(|k| self.system.heads[k].look_at(near));
        let joints = self.system.turn(targets)?;
        let [left, right] = self.watch(pattern, joints.map(Some))?;
        let seen = [(0, left), (1, right)].map(|(k, sightings)| {
            let seen = Seen { joints: joints[k], sightings };
            self.within(k, seen, near, reach)
        });
        Ok(seen)
    }

    /// What a head saw no further than `reach` (m) from a place.
    pub(crate) fn within(&self, side: usize, seen: Seen, near: &Point3<f64>, reach: f64) -> Seen {
        let head = &self.system.heads[side];
        let angles = [seen.joints.pan, seen.joints.tilt];
        let noise = self.noise();
        let sigma = noise.step_sigma.hypot(noise.common_sigma);
        let eye = head.base_from_optical(angles).translation.vector;
        let radius = head.camera.fx * (reach / (near.coords - eye).norm() + 3.0 * sigma);
        let expected = head.project(angles, near);
        let keep = |s: &Sighting| expected.is_some_and(|e| (s.pixel - e).norm() <= radius);
        Seen { sightings: seen.sightings.into_iter().filter(keep).collect(), ..seen }
    }

    /// Centres and measures a light that both heads saw; gives the heads' angles too.
    pub(crate) fn locate_seen(
        &mut self,
        tag: TagAddress,
        pattern: &Pattern,
        seen: [Seen; 2],
    ) -> Result<(GaussianPoint, [[f64; 2]; 2]), Stop> {
        let missing = match [0, 1].map(|k| seen[k].sightings.is_empty()) {
            [false, false] => return self.fixate(tag, pattern, seen),
            [true, true] => Missing::Either,
            [true, false] => Missing::One(Side::Left),
            [false, true] => Missing::One(Side::Right),
        };
        Err(Stop::NotSeen { views: 2, missing })
    }

    /// Of all places that either head saw, the pair that can be one light: the brightest whose lines
    /// of sight meet, else the pair that comes nearest. Mirrors show the pattern elsewhere.
    pub(super) fn same_light(&self, seen: [&Seen; 2]) -> [(JointReading, Sighting); 2] {
        let noise = self.noise();
        let gap = |left: &Sighting, right: &Sighting| {
            let pair = [fixation(&seen[0].joints, left), fixation(&seen[1].joints, right)];
            epipolar_gap(&self.system.heads, &pair, &noise)
        };
        let brightest = [&seen[0].sightings[0], &seen[1].sightings[0]];
        let mut best = (gap(brightest[0], brightest[1]), brightest);
        for left in &seen[0].sightings {
            for right in &seen[1].sightings {
                let other = gap(left, right);
                if best.0 > GATE_SIGMAS && other < best.0 {
                    best = (other, [left, right]);
                }
            }
        }
        std::array::from_fn(|k| (seen[k].joints, best.1[k].clone()))
    }

    /// Moves the heads that have to, by way of the waypoint that takes up the backlash.
    fn approach(&mut self, moves: &[NextMove; 2]) -> Result<[JointReading; 2], Stop> {
        let via = moves.map(|m| match m {
            NextMove::Go { via, .. } => via,
            NextMove::Hold => None,
        });
        if via != [None, None] {
            self.system.turn(via)?;
        }
        let goals = moves.map(|m| match m {
            NextMove::Go { goal, .. } => Some(goal),
            NextMove::Hold => None,
        });
        Ok(self.system.turn(goals)?)
    }

    fn nearest_to_centre(&self, side: usize, sightings: Vec<Sighting>) -> Option<Sighting> {
        let camera = &self.system.heads[side].camera;
        let centre = nalgebra::Point2::new(camera.cx, camera.cy);
        let distance = |s: &Sighting| (s.pixel - centre).norm();
        sightings.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }

    /// The landmark in the base frame from one fixation of either head.
    pub(super) fn triangulate(&mut self, held: &[Fixation; 2]) -> Result<GaussianPoint, Stop> {
        let heads = &self.system.heads;
        let landmark = triangulate(heads, held, &self.noise())?.point;
        self.located(&landmark, held);
        Ok(landmark)
    }

    /// Reports where the landmark is, with equation (1) of the paper for the same angles.
    pub(super) fn located(&mut self, landmark: &GaussianPoint, held: &[Fixation; 2]) {
        let heads = &self.system.heads;
        let axes = [0, 1].map(|k| heads[k].chain.joints[0].parent_from_joint.translation.vector);
        let baseline = (axes[0] - axes[1]).norm();
        let angles = PaperAngles::from_pan_tilt(held[0].angles, held[1].angles);
        let distance = paper_distance(&angles, baseline).unwrap_or(f64::INFINITY);
        self.landmark = Some(LandmarkReport::new(landmark, distance));
        self.observer.notice(&Event::Landmark(landmark, distance));
    }

    /// Angle noise of the coarser head.
    pub(super) fn noise(&self) -> Noise {
        let system = &self.system;
        self.with_zeros(Noise::of_servo(system.resolution(), system.backlash()))
    }

    /// A servo's noise with what its zero may be off by.
    pub(super) fn with_zeros(&self, servo: Noise) -> Noise {
        Noise { common_sigma: servo.common_sigma.hypot(self.zero_sd), ..servo }
    }
}

pub(super) fn fixation(joints: &JointReading, sighting: &Sighting) -> Fixation {
    Fixation {
        angles: [joints.pan, joints.tilt],
        pixel: sighting.pixel,
        pixel_covariance: sighting.covariance,
    }
}
