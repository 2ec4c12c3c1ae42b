//! Recordings in MCAP, the container of ROS 2 bags.
//!
//! [`Reader`] lists topics and reads typed messages; [`frames`] gives the pictures of an image topic
//! and [`camera_info`] its camera. Chunks may be plain, zstd or lz4; both decoders are pure Rust.
//! [`Writer`] writes.
//! A recording that was cut off (a crash, a full disk) reads up to its last whole message.

mod chunk;
mod error;
mod frames;
mod pixels;
mod reader;
mod stream;
mod writer;

pub use error::RecordingError;
pub use frames::{Frames, camera_info, frames};
pub use pixels::PixelError;
pub use reader::{Messages, Reader, Recorded, Topic};
pub use writer::Writer;
