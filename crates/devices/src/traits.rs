//! The traits that drivers implement and the plain data that crosses them.

use std::fmt;
use std::time::Duration;

use vergence_imaging::Frame;
use vergence_tag::Pattern;

use crate::arm::Arm;

/// What can go wrong with a device.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DeviceError {
    /// Nothing came within the time allowed.
    #[error("{device}: no answer within {timeout:?}")]
    Timeout {
        /// Which device.
        device: String,
        /// How long we waited.
        timeout: Duration,
    },
    /// The device is gone: cable, power, closed connection.
    #[error("{device}: not connected ({reason})")]
    Disconnected {
        /// Which device.
        device: String,
        /// What the system said.
        reason: String,
    },
    /// The device reports a fault of its own (overload, heat, bad voltage, refused command).
    #[error("{device}: {fault}")]
    Fault {
        /// Which device.
        device: String,
        /// The fault in words.
        fault: String,
    },
    /// The device was asked for something outside its abilities.
    #[error("{device}: {what}")]
    Unsupported {
        /// Which device.
        device: String,
        /// What was asked, and what it can do.
        what: String,
    },
}

/// The robot's time: a duration since an epoch that the clock owns. Simulated clocks are virtual.
pub trait Clock: Send + Sync {
    /// Now.
    fn now(&self) -> Duration;
    /// Waits; a virtual clock moves ahead.
    fn sleep(&self, duration: Duration);
}

/// A camera that delivers grey frames with the times of their capture.
pub trait Camera: Send {
    /// The first frame that was not delivered yet, waiting for it at most `timeout`. A camera that
    /// is read too slowly drops frames, seen as gaps in [`Frame::sequence`].
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError>;

    /// Frames whose exposure began before `since` (robot's clock) will be thrown away by the caller:
    /// a driver to which a frame is work may leave them out.
    fn skip_before(&mut self, _since: Duration) {}
}

impl<C: Camera + ?Sized> Camera for Box<C> {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        (**self).next_frame(timeout)
    }

    fn skip_before(&mut self, since: Duration) {
        (**self).skip_before(since);
    }
}

/// Angles of one head at one time, as the encoders tell them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointReading {
    /// When the encoders were read.
    pub stamp: Duration,
    /// Pan (rad), positive to the left.
    pub pan: f64,
    /// Tilt (rad), positive downwards.
    pub tilt: f64,
    /// A servo is still on its way.
    pub moving: bool,
}

/// A pair of servos that turns one camera.
pub trait PanTilt: Send {
    /// Starts a move to these angles (rad); returns at once. Angles outside the limits are an error.
    fn move_to(&mut self, pan: f64, tilt: f64) -> Result<(), DeviceError>;
    /// Reads the encoders.
    fn read(&mut self) -> Result<JointReading, DeviceError>;
    /// Smallest angle that the encoders resolve (rad).
    fn resolution(&self) -> f64;
    /// Slack of the gears that the encoders do not see (rad); zero when none is known.
    fn backlash(&self) -> f64 {
        0.0
    }
    /// Speed (rad/s) at which it turns; `None` when that is the joints' own.
    fn speed(&self) -> Option<f64> {
        None
    }
}

/// Address of a tag on the radio; opaque bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TagAddress(pub [u8; 6]);

impl fmt::Display for TagAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e, g] = self.0;
        write!(f, "{a:02X}:{b:02X}:{c:02X}:{d:02X}:{e:02X}:{g:02X}")
    }
}

/// One tag as heard in a scan.
#[derive(Debug, Clone, PartialEq)]
pub struct Advertisement {
    /// Who sent it.
    pub address: TagAddress,
    /// The object id that it claims, or the beginning of a long one; the record may say otherwise.
    pub object_id: String,
    /// Received signal strength (dBm).
    pub rssi: i8,
    /// Battery level (percent), when it tells.
    pub battery: Option<u8>,
}

impl Advertisement {
    /// It may be the tag of this object: a long id is advertised by its beginning only.
    pub fn may_be(&self, object_id: &str) -> bool {
        vergence_tag::beacon::may_be(&self.object_id, object_id)
    }
}

/// What the LED is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LedCommand {
    /// Play a pattern from now on.
    Play(Pattern),
    /// Dark.
    Stop,
}

/// What a tag answers to a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TagState {
    /// The LED is playing.
    pub playing: bool,
    /// Battery level (percent), when it tells.
    pub battery: Option<u8>,
}

/// The robot's side of the radio.
pub trait TagLink: Send {
    /// Listens for a whole window; every address heard, strongest first, duplicates of one object id
    /// under different addresses kept.
    fn scan(&mut self, window: Duration) -> Result<Vec<Advertisement>, DeviceError>;
    /// The record's bytes as the tag holds them.
    fn read_record(&mut self, tag: TagAddress, timeout: Duration) -> Result<Vec<u8>, DeviceError>;
    /// Sends a command to the LED and waits for the tag's answer.
    fn command(
        &mut self,
        tag: TagAddress,
        command: LedCommand,
        timeout: Duration,
    ) -> Result<TagState, DeviceError>;
}

/// Left or right, seen from the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Side {
    /// The robot's left (+y).
    Left,
    /// The robot's right (-y).
    Right,
}

impl Side {
    /// Both, left first: the order of every pair in this project.
    pub const BOTH: [Side; 2] = [Side::Left, Side::Right];

    /// "left" or "right", as in topic and link names.
    pub fn name(self) -> &'static str {
        match self {
            Side::Left => "left",
            Side::Right => "right",
        }
    }
}

/// One camera on its pair of servos.
pub struct Head {
    /// The camera.
    pub camera: Box<dyn Camera>,
    /// The servos below it.
    pub pan_tilt: Box<dyn PanTilt>,
}

/// All devices of a robot, opened.
pub struct Robot {
    /// The time of all stamps.
    pub clock: Box<dyn Clock>,
    /// Left and right head.
    pub heads: [Head; 2],
    /// The tag radio.
    pub radio: Box<dyn TagLink>,
    /// The arm, on robots that have one.
    pub arm: Option<Box<dyn Arm>>,
}
