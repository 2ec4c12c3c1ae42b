//! The request file: what the finder is told.

use std::path::Path;
use std::time::Duration;

use serde::Deserialize;
use vergence_landmark::Request;
use vergence_tag::Pattern;
use vergence_tag::pattern::Bits;

use crate::failure::Failure;

/// A request that has been read and checked.
#[derive(Debug)]
pub struct BlinkRequest {
    /// Topic of the images.
    pub camera: String,
    /// Exposure of a row.
    pub exposure: Duration,
    /// Time between the starts of two rows where it is known; zero is a global shutter.
    pub row_time: Option<Duration>,
    /// What the finder is to look for.
    pub tags: Vec<Request>,
}

/// The content of a request file.
#[derive(Deserialize)]
struct Content {
    camera: String,
    /// How far the clocks of tags and camera may differ (parts per million).
    clock_tolerance_ppm: f64,
    exposure_seconds: f64,
    row_seconds: Option<f64>,
    tags: Vec<Tag>,
}

/// One tag of a request.
#[derive(Deserialize)]
struct Tag {
    id: String,
    /// What its LED plays.
    pattern: Bits,
    /// How long a chip lasts (s).
    chip_seconds: f64,
}

impl BlinkRequest {
    /// Reads and checks a request file.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let hint = "a request is JSON with camera, clock_tolerance_ppm, exposure_seconds and tags";
        let text = std::fs::read_to_string(path).map_err(|e| e.to_string());
        let request = text.and_then(|text| Self::parse(&text));
        request.map_err(|e| Failure::misuse(format!("{}: {e}", path.display()), hint))
    }

    fn parse(text: &str) -> Result<Self, String> {
        let content: Content = serde_json::from_str(text).map_err(|e| e.to_string())?;
        let seconds = |value: f64| match (0.0..=10.0).contains(&value) {
            true => Ok(Duration::from_secs_f64(value)),
            false => Err("a time is not between 0 and 10 s".to_owned()),
        };
        let request = |tag: Tag| {
            let of_tag = |e: String| format!("tag {}: {e}", tag.id);
            let chip = Duration::try_from_secs_f64(tag.chip_seconds);
            let chip = chip.map_err(|e| of_tag(format!("chip_seconds: {e}")))?;
            let pattern = Pattern::new(tag.pattern, chip).map_err(|e| of_tag(e.to_string()))?;
            let clock_tolerance = 1e-6 * content.clock_tolerance_ppm;
            Ok(Request { id: tag.id, pattern, clock_tolerance })
        };
        Ok(BlinkRequest {
            camera: content.camera,
            exposure: seconds(content.exposure_seconds)?,
            row_time: content.row_seconds.map(seconds).transpose()?,
            tags: content.tags.into_iter().map(request).collect::<Result<_, String>>()?,
        })
    }
}
