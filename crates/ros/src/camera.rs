//! The camera driver `recording`: an image topic of a recording, played back.
//!
//! Time is virtual: the frames' own stamps move a [`ReplayClock`] that all cameras of a robot share,
//! so a replay runs as fast as it is read and always alike.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use vergence_devices::{Camera, Clock, DeviceError};
use vergence_imaging::Frame;

use crate::recording::{Frames, RecordingError, frames};

/// The time of a replay: the latest moment that a camera has shown or a sleep has reached.
#[derive(Debug, Clone, Default)]
pub struct ReplayClock(Arc<Mutex<Option<Duration>>>);

impl ReplayClock {
    /// Moves ahead to a time, never back.
    fn reach(&self, time: Duration) {
        let mut now = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *now = (*now).max(Some(time));
    }

    fn started(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }
}

impl Clock for ReplayClock {
    fn now(&self) -> Duration {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).unwrap_or_default()
    }

    fn sleep(&self, duration: Duration) {
        self.reach(self.now().saturating_add(duration));
    }
}

/// Plays an image topic as a camera. No frame is dropped, however slowly it is read.
pub struct RecordingCamera {
    name: String,
    frames: Frames,
    /// Read, but not due yet.
    waiting: Option<Frame>,
    clock: ReplayClock,
}

impl RecordingCamera {
    /// Opens the topic; refuses a recording without a readable first picture. The first camera to
    /// open sets the clock to the start of its first picture. `exposure` as in [`frames`].
    pub fn open(
        path: &Path,
        topic: &str,
        exposure: Duration,
        clock: &ReplayClock,
    ) -> Result<Self, RecordingError> {
        let mut frames = frames(path, topic, exposure)?;
        let waiting = frames.next().transpose()?;
        if let (Some(first), false) = (&waiting, clock.started()) {
            clock.reach(first.stamp);
        }
        Ok(RecordingCamera { name: topic.into(), frames, waiting, clock: clock.clone() })
    }
}

impl Camera for RecordingCamera {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let frame = match self.waiting.take().map(Ok).or_else(|| self.frames.next()) {
            Some(Ok(frame)) => frame,
            Some(Err(error)) => {
                let device = self.name.clone();
                return Err(DeviceError::Fault { device, fault: error.to_string() });
            }
            None => {
                let reason = "the recording is over".into();
                return Err(DeviceError::Disconnected { device: self.name.clone(), reason });
            }
        };
        let due = frame.stamp.saturating_add(frame.exposure);
        let limit = self.clock.now().saturating_add(timeout);
        if due > limit {
            self.waiting = Some(frame);
            self.clock.reach(limit);
            return Err(DeviceError::Timeout { device: self.name.clone(), timeout });
        }
        self.clock.reach(due);
        Ok(frame)
    }
}
