//! A tighter landmark: both heads aim at the light again and again ([`Reaim`]).
//!
//! One fixation knows a joint's angle to the encoder's step only, which at 0.35 degrees and a baseline
//! of 0.2 m is a centimetre of distance. The tag plays a flicker of one and a half frames meanwhile:
//! among any three frames one is lit and one is dark, and an angle costs three frames and a move of one
//! step.
//!
//! The joints go upwards only, after one run-up, so that the slack always lies on the same side: the
//! camera trails its motor by half the slack. What remains unknown of that is small ([`LAG`]).
//!
//! The last angles are those of the pictures that follow. There the light's pixel and its averaged
//! place tell the angles better than the encoder does ([`settle`]).

use nalgebra::{Matrix2, Point3, Vector2};
use vergence_devices::{JointReading, LedCommand, PanTilt, Side, TagAddress};
use vergence_geometry::GaussianPoint;
use vergence_head::{Fixation, Noise, PanTiltHead, Reaim};
use vergence_imaging::Frame;
use vergence_landmark::near;
use vergence_tag::{Pattern, pattern::Bits};

use super::{Run, Stop};
use crate::event::Event;

/// Frames an angle is looked at for.
const FRAMES: usize = 3;
/// By how much a camera trails its motor when it came from below, and the standard deviation of that,
/// as shares of the slack that the maker states: a servo has between half of that and all of it.
const LAG: (f64, f64) = (0.375, 0.072);

impl Run<'_> {
    /// Measures the light again at other angles until its distance is known well enough; gives its
    /// place and the heads' angles at the end.
    pub(super) fn reaim(
        &mut self,
        tag: TagAddress,
        held: &[Fixation; 2],
        first: GaussianPoint,
    ) -> Result<(GaussianPoint, [[f64; 2]; 2]), Stop> {
        let angles = held.map(|fixation| fixation.angles);
        let heads = self.system.heads.clone();
        let servos = |servo: fn(&dyn PanTilt) -> f64| {
            [0, 1].map(|k| servo(self.system.robot.heads[k].pan_tilt.as_ref()))
        };
        let (steps, slack) = (servos(|s| s.resolution()), servos(|s| s.backlash()));
        let noise = self.noise_from_below();
        let mut reaim = Reaim::new(&heads, angles, steps, noise, self.config.reaim);
        if !reaim.begins(&first) {
            return Ok((first, angles));
        }
        // 1.5 frames: whatever the phase, one of three frames is fully lit and one fully dark.
        let Ok(flicker) = Pattern::new(Bits::FLICKER, self.interval.mul_f64(1.5)) else {
            return Ok((first, angles));
        };
        self.command(tag, LedCommand::Play(flicker))?;
        let mut readings = self.system.turn(reaim.run_up(slack).map(Some))?;
        while let Some(goals) = reaim.next_aim()? {
            readings = self.system.turn(goals.map(Some))?;
            for (side, fixation) in self.look_once(&first, &readings)?.into_iter().enumerate() {
                fixation.into_iter().for_each(|seen| reaim.add(side, seen));
            }
        }
        let landmark = reaim.landmark()?.map_or(first, |landmark| landmark.point);
        let last = [0, 1]
            .map(|k| self.last(k, &readings[k], &reaim.seen()[k], &landmark.position, &noise));
        self.located(&landmark, &last);
        Ok((landmark, last.map(|fixation| fixation.angles)))
    }

    /// Angle noise when every joint comes from below.
    pub(crate) fn noise_from_below(&self) -> Noise {
        let lag = LAG.1 * self.system.backlash();
        self.with_zeros(Noise { common_sigma: lag, ..self.noise() })
    }

    /// Looks at the light with both cameras from where the heads stand; a camera that does not see
    /// it now adds nothing.
    fn look_once(
        &mut self,
        first: &GaussianPoint,
        readings: &[JointReading; 2],
    ) -> Result<[Option<Fixation>; 2], Stop> {
        let since = self.system.robot.clock.now();
        let mut frames: [Vec<Frame>; 2] = [Vec::new(), Vec::new()];
        for _ in 0..FRAMES {
            for side in 0..2 {
                let frame = self.system.frame_since(side, since)?;
                self.observer.notice(&Event::Frame(Side::BOTH[side], &frame, readings[side]));
                frames[side].push(frame);
            }
        }
        let sigma = self.noise().step_sigma.hypot(self.noise().common_sigma);
        let seen = |side: usize| {
            let angles = self.camera_angles(side, &readings[side]);
            let head = &self.system.heads[side];
            // The first fixation and this one are off by a step's error each.
            let radius_px = 3.0 + 6.0 * sigma * head.camera.fx.max(head.camera.fy);
            let expected = head.project(angles, &first.position)?;
            let spot = near::locate(&frames[side], &expected, radius_px)?;
            Some(Fixation { angles, pixel: spot.pixel, pixel_covariance: spot.covariance })
        };
        Ok([seen(0), seen(1)])
    }

    /// Where the camera is when the motor came from below.
    pub(crate) fn camera_angles(&self, side: usize, reading: &JointReading) -> [f64; 2] {
        let lag = LAG.0 * self.system.robot.heads[side].pan_tilt.backlash();
        [reading.pan - lag, reading.tilt - lag]
    }

    /// The fixation of the angles at which the heads stand now.
    fn last(
        &self,
        side: usize,
        reading: &JointReading,
        seen: &[Fixation],
        landmark: &Point3<f64>,
        noise: &Noise,
    ) -> Fixation {
        let angles = self.camera_angles(side, reading);
        let head = &self.system.heads[side];
        let here = seen.last().filter(|fixation| fixation.angles == angles);
        let pixel = nalgebra::Point2::new(head.camera.cx, head.camera.cy);
        let blind = Fixation { angles, pixel, pixel_covariance: Matrix2::identity() };
        let Some(here) = here else { return blind };
        let most = 6.0 * noise.step_sigma.hypot(noise.common_sigma);
        Fixation { angles: settle(head, here, landmark, most).unwrap_or(angles), ..*here }
    }
}

/// The angles, within `most` (rad) of the fixation's, at which a point is seen where the fixation saw
/// it: Newton on the projection. `None` when there are none.
pub(crate) fn settle(
    head: &PanTiltHead,
    fixation: &Fixation,
    point: &Point3<f64>,
    most: f64,
) -> Option<[f64; 2]> {
    const H: f64 = 1e-6;
    let off = |angles: [f64; 2]| Some(head.project(angles, point)? - fixation.pixel);
    let mut angles = fixation.angles;
    for _ in 0..8 {
        let rest = off(angles)?;
        let by = |k: usize| {
            let mut moved = angles;
            moved[k] += H;
            Some((off(moved)? - rest) / H)
        };
        let slope = Matrix2::from_columns(&[by(0)?, by(1)?]);
        let step: Vector2<f64> = slope.try_inverse()? * rest;
        angles = [angles[0] - step.x, angles[1] - step.y];
        if step.norm() < 1e-9 {
            break;
        }
    }
    let near = (0..2).all(|k| (angles[k] - fixation.angles[k]).abs() <= most);
    (near && off(angles)?.norm() < 1e-3).then_some(angles)
}
