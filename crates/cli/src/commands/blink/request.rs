//! The request file: what the finder is told.

use std::path::Path;
use std::time::Duration;

use serde::Deserialize;
use vergence_landmark::Request;
use vergence_tag::Pattern;
use vergence_tag::pattern::Bits;

use crate::failure::Failure;

/// The content of a request file.
#[derive(Debug, Deserialize)]
pub struct BlinkRequest {
    /// Topic of the images.
    pub camera: String,
    /// How far the clocks of tags and camera may differ (parts per million).
    clock_tolerance_ppm: f64,
    /// Exposure of a row (s).
    exposure_seconds: f64,
    /// Time between the starts of two rows (s) where it is known; zero is a global shutter.
    row_seconds: Option<f64>,
    /// The tags.
    pub tags: Vec<RequestedTag>,
}

/// One tag of a request.
#[derive(Debug, Deserialize)]
pub struct RequestedTag {
    /// Its name.
    pub id: String,
    /// What its LED plays.
    pattern: Bits,
    /// How long a chip lasts (s).
    chip_seconds: f64,
}

impl BlinkRequest {
    /// Reads and checks a request file.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let hint = "a request is JSON with camera, clock_tolerance_ppm, exposure_seconds and tags";
        let refuse = |e: String| Failure::misuse(format!("{}: {e}", path.display()), hint);
        let text = std::fs::read_to_string(path).map_err(|e| refuse(e.to_string()))?;
        let request: BlinkRequest =
            serde_json::from_str(&text).map_err(|e| refuse(e.to_string()))?;
        let seconds = |value: f64| (0.0..=10.0).contains(&value);
        if !seconds(request.exposure_seconds) || !request.row_seconds.is_none_or(seconds) {
            return Err(refuse("a time is not between 0 and 10 s".into()));
        }
        Ok(request)
    }

    /// Exposure of a row.
    pub fn exposure(&self) -> Duration {
        Duration::from_secs_f64(self.exposure_seconds)
    }

    /// Time between the starts of two rows, where it is known.
    pub fn row_time(&self) -> Option<Duration> {
        self.row_seconds.map(Duration::from_secs_f64)
    }

    /// The requests as the finder takes them.
    pub fn requests(&self) -> Result<Vec<Request>, Failure> {
        self.tags.iter().map(|tag| self.request(tag)).collect()
    }

    fn request(&self, tag: &RequestedTag) -> Result<Request, Failure> {
        let refuse = |e: String| Failure::misuse(format!("{}: {e}", tag.id), "correct the request");
        let chip =
            Duration::try_from_secs_f64(tag.chip_seconds).map_err(|e| refuse(e.to_string()))?;
        let pattern = Pattern::new(tag.pattern, chip).map_err(|e| refuse(e.to_string()))?;
        let clock_tolerance = 1e-6 * self.clock_tolerance_ppm;
        Ok(Request { id: tag.id.clone(), pattern, clock_tolerance })
    }
}
