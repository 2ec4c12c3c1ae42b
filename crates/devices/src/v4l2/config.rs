//! What a `v4l2` camera is asked for, on any system.

use std::path::PathBuf;

use serde::Deserialize;

/// Settings of one such camera; its size stands beside, with the lens.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct V4l2Config {
    /// Device node, `/dev/video0` or a name that outlives reboots, `/dev/v4l/by-id/...`.
    pub device: PathBuf,
    /// Pixel format; without it the first of grey, yuyv, nv12 and mjpeg that the device has.
    #[serde(default)]
    pub format: Option<PixelFormat>,
    /// Exposure time (s); without it the device's present one is kept. Never automatic, where the
    /// device lets us: a picture that adapts to the tag's light hides it.
    #[serde(default)]
    pub exposure: Option<f64>,
    /// Gain in the device's own units; without it the device's present one is kept.
    #[serde(default)]
    pub gain: Option<i32>,
    /// Frames a second; without it the device's present rate is kept.
    #[serde(default)]
    pub rate: Option<f64>,
}

/// Pixel formats from which grey is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelFormat {
    /// One byte a pixel.
    Grey,
    /// Two bytes a pixel, every other one luma.
    Yuyv,
    /// A plane of luma, then one of colour.
    Nv12,
    /// One JPEG file a picture.
    Mjpeg,
}
