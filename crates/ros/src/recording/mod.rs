//! Recordings in MCAP, the container of ROS 2 bags.
//!
//! [`Reader`] lists topics and reads typed messages; [`frames`] gives the pictures of an image topic
//! and [`camera_info`] its camera. Chunks may be plain, zstd or lz4; both decoders are pure Rust.
//! [`Writer`] writes.
//! A recording that was cut off (a crash, a full disk) reads up to its last whole message.
//!
//! ```no_run
//! use std::{path::Path, time::Duration};
//! use vergence_ros::recording::{camera_info, frames};
//!
//! let path = Path::new("recording.mcap");
//! let camera = camera_info(path, "/left/camera_info")?;
//! for frame in frames(path, "/left/image_raw", Duration::from_millis(10))? {
//!     let frame = frame?;
//!     println!("{:?}: {} columns, {} px focal length", frame.stamp, frame.image.width(), camera.fx);
//! }
//! # Ok::<(), vergence_ros::recording::RecordingError>(())
//! ```

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
