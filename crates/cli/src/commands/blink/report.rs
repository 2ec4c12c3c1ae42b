//! What `vergence blink` answers, as JSON and as text.

use std::fmt::Write;
use std::time::Duration;

use serde::Serialize;
use vergence_landmark::{Decision, Sighting};

use super::request::BlinkRequest;

/// The answer for one recording.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Tags that are seen, in the order of the request.
    detections: Vec<Detection>,
    /// Tags that are not in the picture.
    absent: Vec<String>,
    /// Tags for which the recording is too short or their light too weak.
    undecided: Vec<String>,
    /// Frames of the recording.
    frames: usize,
    /// Wall time of reading and looking (s).
    seconds: f64,
}

#[derive(Debug, Serialize)]
struct Detection {
    id: String,
    #[serde(flatten)]
    place: Place,
    /// Further places that show the same pattern, less bright: mirrors.
    others: Vec<Place>,
}

#[derive(Debug, Serialize)]
struct Place {
    /// Column and row (px).
    uv: [f64; 2],
    /// Row-major covariance of `uv` (px^2).
    covariance: [f64; 4],
    /// Brightness of the LED over its surroundings (grey levels).
    amplitude: f64,
    snr: f64,
    /// Seconds into the pattern at `decided_at`.
    phase: f64,
    /// Seconds from the first frame.
    decided_at: f64,
    /// Frames used.
    frames: usize,
}

impl Place {
    fn new(sighting: &Sighting, first: Duration) -> Self {
        let c = &sighting.covariance;
        Place {
            uv: [sighting.pixel.x, sighting.pixel.y],
            covariance: [c[(0, 0)], c[(0, 1)], c[(1, 0)], c[(1, 1)]],
            amplitude: sighting.amplitude,
            snr: sighting.snr,
            phase: sighting.phase,
            decided_at: sighting.decided_at.saturating_sub(first).as_secs_f64(),
            frames: sighting.frames,
        }
    }
}

impl Report {
    /// Gathers the decisions; `first` is the stamp of the first frame.
    pub fn new(
        request: &BlinkRequest,
        decisions: &[Decision],
        first: Duration,
        frames: usize,
        seconds: f64,
    ) -> Self {
        let (mut detections, mut absent, mut undecided) = (Vec::new(), Vec::new(), Vec::new());
        for (tag, decision) in request.tags.iter().zip(decisions) {
            let id = tag.id.clone();
            match decision {
                Decision::Absent => absent.push(id),
                Decision::Undecided => undecided.push(id),
                Decision::Here(sightings) => {
                    let mut places = sightings.iter().map(|s| Place::new(s, first));
                    if let Some(place) = places.next() {
                        detections.push(Detection { id, place, others: places.collect() });
                    }
                }
            }
        }
        Report { detections, absent, undecided, frames, seconds }
    }

    /// Whether every tag is decided.
    pub fn is_complete(&self) -> bool {
        self.undecided.is_empty()
    }

    /// Whether any tag is decided.
    pub fn is_answered(&self) -> bool {
        !self.detections.is_empty() || !self.absent.is_empty()
    }

    /// One JSON document.
    pub fn json(&self) -> String {
        serde_json::to_string_pretty(self).unwrap_or_default()
    }

    /// One line for a table of episodes.
    pub fn line(&self) -> String {
        let ids: Vec<&str> = self.detections.iter().map(|d| d.id.as_str()).collect();
        format!("{} in {} frames, {:.0} ms", ids.join(" "), self.frames, 1e3 * self.seconds)
    }

    /// Text for people.
    pub fn text(&self) -> String {
        let mut text = String::new();
        for d in &self.detections {
            let p = &d.place;
            let _ = writeln!(
                text,
                "{}: here, at ({:.2}, {:.2}) +- ({:.2}, {:.2}) px, {:.1} grey levels, snr {:.1}, after {:.2} s",
                d.id,
                p.uv[0],
                p.uv[1],
                p.covariance[0].sqrt(),
                p.covariance[3].sqrt(),
                p.amplitude,
                p.snr,
                p.decided_at
            );
            for p in &d.others {
                let _ = writeln!(
                    text,
                    "  also at ({:.2}, {:.2}), {:.1} grey levels",
                    p.uv[0], p.uv[1], p.amplitude
                );
            }
        }
        for id in &self.absent {
            let _ = writeln!(text, "{id}: not here");
        }
        for id in &self.undecided {
            let _ = writeln!(text, "{id}: not decided within {} frames", self.frames);
        }
        text
    }
}
