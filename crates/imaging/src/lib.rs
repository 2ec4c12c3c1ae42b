//! Grey images and frames, and the few kernels that landmark finding, pose and simulation share.
//!
//! [`Image`] is a plain row-major grid; [`Frame`] adds what a camera knows of a picture (when it was
//! exposed); [`kernel`] has blur and gradients written as slice loops that the compiler turns into
//! vector code; [`codec`] reads and writes PNG and JPEG; [`Canvas`] draws the pictures of `--save`.
//! Pixel (0, 0) is the centre of the top-left pixel.

pub mod canvas;
pub mod codec;
mod frame;
mod grid;
pub mod kernel;

pub use canvas::Canvas;
pub use codec::CodecError;
pub use frame::Frame;
pub use grid::Image;
