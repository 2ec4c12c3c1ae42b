//! The simulated clock, cameras and pan-tilt heads behind the traits of `vergence-devices`.

use std::time::Duration;

use vergence_devices::{Camera, Clock, DeviceError, JointReading, PanTilt, Side};
use vergence_imaging::Frame;

use crate::camera::Sensor;
use crate::world::{Shared, lock};

/// Virtual time.
pub struct SimClock {
    pub(crate) world: Shared,
}

impl Clock for SimClock {
    fn now(&self) -> Duration {
        lock(&self.world).now
    }

    fn sleep(&self, duration: Duration) {
        lock(&self.world).pass(duration);
    }
}

/// One camera.
pub struct SimCamera {
    pub(crate) world: Shared,
    pub(crate) side: Side,
    pub(crate) sensor: Sensor,
    /// Number of the first frame that was not delivered yet.
    pub(crate) next: u64,
}

impl Camera for SimCamera {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let (capture, settings) = {
            let mut world = lock(&self.world);
            let world = &mut *world;
            if !world.captures.iter().any(|c| c.sequence >= self.next) {
                let end = Duration::from_secs_f64(world.shutter.end(world.frame.max(self.next)));
                let deadline = world.now.saturating_add(timeout);
                // A nanosecond more, so that rounding cannot leave the frame unfinished.
                world.advance_to((end + Duration::from_nanos(1)).min(deadline));
            }
            let ready = world.captures.iter().find(|c| c.sequence >= self.next).cloned();
            let capture = ready.ok_or_else(|| DeviceError::Timeout {
                device: format!("{} camera", self.side.name()),
                timeout,
            })?;
            (capture, world.settings.camera)
        };
        self.next = capture.sequence + 1;
        // Rendered without the lock: the other camera may work at the same time.
        Ok(Frame {
            image: self.sensor.picture(&capture),
            stamp: Duration::from_secs_f64(capture.start),
            exposure: Duration::from_secs_f64(settings.exposure),
            row_time: Some(Duration::from_secs_f64(settings.row_time)),
            sequence: capture.sequence,
        })
    }

    /// Rendering is work.
    fn skip_before(&mut self, since: Duration) {
        let shutter = lock(&self.world).shutter;
        let frames = (since.as_secs_f64() - shutter.phase) / shutter.period;
        let mut first = (frames - 1.0).max(0.0) as u64;
        while Duration::from_secs_f64(shutter.start(first)) < since {
            first += 1;
        }
        self.next = self.next.max(first);
    }
}

/// The servos of one head.
pub struct SimPanTilt {
    pub(crate) world: Shared,
    pub(crate) side: Side,
}

impl PanTilt for SimPanTilt {
    fn move_to(&mut self, pan: f64, tilt: f64) -> Result<(), DeviceError> {
        let mut world = lock(&self.world);
        let now = world.seconds();
        let head = &mut world.heads[self.side as usize];
        for (joint, angle) in head.chain.joints.iter().zip([pan, tilt]) {
            if !joint.limits.contains(angle) {
                let (lower, upper) = (joint.limits.lower, joint.limits.upper);
                let what = format!("cannot turn to {angle:.3} rad, only from {lower} to {upper}");
                return Err(DeviceError::Unsupported { device: joint.name.clone(), what });
            }
        }
        for (servo, goal) in head.servos.iter_mut().zip([pan, tilt]) {
            servo.command(now, goal);
        }
        Ok(())
    }

    fn read(&mut self) -> Result<JointReading, DeviceError> {
        let mut world = lock(&self.world);
        let time = Duration::from_secs_f64(world.settings.servos.bus_time);
        world.pass(time);
        let [pan, tilt] = &world.heads[self.side as usize].servos;
        Ok(JointReading {
            stamp: world.now,
            pan: pan.encoder(),
            tilt: tilt.encoder(),
            moving: pan.moving() || tilt.moving(),
        })
    }

    fn resolution(&self) -> f64 {
        lock(&self.world).heads[self.side as usize].servos[0].resolution()
    }

    fn backlash(&self) -> f64 {
        lock(&self.world).heads[self.side as usize].servos[0].stated_backlash()
    }
}
