//! How the outside comes in: traits for cameras, pan-tilt heads, tag radios and the arm, their
//! drivers, and the robot's description (URDF) and wiring (TOML).
//!
//! Everything above talks to [`Camera`], [`PanTilt`], [`TagLink`], [`Arm`] and [`Clock`] only; whether a wire
//! or the simulator answers is a line in the configuration. All calls block and all are bounded in
//! time. Times are of one clock per robot, see [`Clock`].

mod arm;
pub mod bodies;
pub mod calibrated;
pub mod clock;
pub mod config;
pub mod description;
pub mod dynamixel;
pub mod mjpeg;
mod traits;
pub mod v4l2;

pub use arm::{Arm, ArmReading, Cancel, Execution, GripCommand, GripperReading, MotionLimits};
pub use bodies::GripperJoints;
pub use config::{Config, ConfigError};
pub use description::{Description, DescriptionError};
pub use traits::{
    Advertisement, Camera, Clock, DeviceError, Head, JointReading, LedCommand, PanTilt, Robot,
    Side, TagAddress, TagLink, TagState,
};
