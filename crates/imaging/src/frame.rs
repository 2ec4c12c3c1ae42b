//! One picture of a camera with its times.

use std::time::Duration;

use crate::Image;

/// A grey picture and when it was taken.
///
/// Row `r` was exposed from `stamp + r * row_time` for `exposure` seconds. Stamps are those of
/// capture, not of arrival, and count since the epoch of the clock that the camera uses.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// 8-bit grey pixels.
    pub image: Image<u8>,
    /// Start of the exposure of the first row.
    pub stamp: Duration,
    /// How long a row is exposed.
    pub exposure: Duration,
    /// Time between the starts of two rows: zero for a global shutter, `None` when unknown.
    pub row_time: Option<Duration>,
    /// Running number given by the camera; a gap is a lost frame.
    pub sequence: u64,
}
