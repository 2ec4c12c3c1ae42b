//! The driver `v4l2`: cameras of the Linux kernel (USB and built-in ones, `/dev/video*`).
//!
//! Out come grey [`Frame`](vergence_imaging::Frame)s with the kernel's own stamps and numbers. A
//! thread takes filled buffers from the kernel as they come and keeps the newest few, so that a busy
//! reader gets fresh pictures; what it missed, what the device lost and what came damaged is counted
//! and seen as gaps in the numbers. Exposure and gain are locked.
//!
//! Stamps are of the start of exposure if the kernel says so (USB cameras). Stamps of a frame's end
//! are brought forward by the exposure time; the time that the sensor takes to read out stays in
//! them. Where the stamp is of another clock than the monotonic one, or later than the arrival, the
//! arrival is the stamp.
//!
//! A device that is unplugged is [`Disconnected`](crate::DeviceError::Disconnected) for good and must
//! be opened again; one whose stream breaks is started again a few times. The kernel is asked
//! directly, no library is needed; single-planar devices on 64-bit machines only.

mod config;
#[cfg(all(target_os = "linux", target_pointer_width = "64"))]
mod linux;

pub use config::{PixelFormat, V4l2Config};
#[cfg(all(target_os = "linux", target_pointer_width = "64"))]
pub use linux::{Counts, Locked, V4l2Camera};
