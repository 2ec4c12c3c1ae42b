//! ROS 2 messages and recordings: how Vergence's data goes to ROS tools, and how theirs comes in.
//!
//! - [`cdr`] is the wire format, [`message`] what a message type is, [`msg`] the message types.
//! - [`recording`] reads and writes MCAP files that `ros2 bag`, Foxglove and Rerun open.
//! - [`convert`] takes frames, cameras and poses to messages, [`tf`] a URDF to its tree of frames.
//! - [`RecordingCamera`] is the camera driver `recording`.
//!
//! Pure Rust; no ROS installation is needed. Recorded bytes come from outside: every reader here
//! bounds its memory and returns an error instead of panicking.

mod camera;
pub mod cdr;
pub mod convert;
pub mod message;
pub mod msg;
pub mod recording;
pub mod tf;

pub use camera::{RecordingCamera, ReplayClock};
pub use message::Message;
