//! What every finder takes and gives.

use std::time::Duration;

use nalgebra::{Matrix2, Point2};
use vergence_imaging::Frame;
use vergence_tag::Pattern;

/// A pattern to look for.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// Name of the tag, for messages and tables.
    pub id: String,
    /// What its LED plays.
    pub pattern: Pattern,
    /// How far the tag's clock may run off the camera's, relative (200 ppm is 2e-4).
    pub clock_tolerance: f64,
}

/// One place where a pattern is seen.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// Where, in pixels of the newest frame; (0, 0) is the centre of the top-left pixel.
    pub pixel: Point2<f64>,
    /// Covariance of `pixel` (px^2).
    pub covariance: Matrix2<f64>,
    /// How much brighter the brightest pixel is with the LED on (grey levels).
    pub amplitude: f64,
    /// Root of the evidence: amplitude over its own standard deviation.
    pub snr: f64,
    /// Seconds into the pattern, in [0, period), at `decided_at` on the row of the sighting.
    pub phase: f64,
    /// Stamp of the frame with which the decision fell.
    pub decided_at: Duration,
    /// Frames used up to the decision.
    pub frames: usize,
}

/// What is known about one request.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Decision {
    /// The evidence does not suffice yet.
    #[default]
    Undecided,
    /// The pattern is seen at these places, brightest first: a mirror carries the same pattern, and
    /// only geometry can tell it from the tag.
    Here(Vec<Sighting>),
    /// A tag of the configured least contrast would have been found by now.
    Absent,
}

impl Decision {
    /// The brightest sighting, when there is one.
    pub fn brightest(&self) -> Option<&Sighting> {
        match self {
            Decision::Here(sightings) => sightings.first(),
            _ => None,
        }
    }
}

/// Why a finder cannot start or go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FinderError {
    /// No pattern to look for.
    #[error("nothing to look for: the list of requests is empty")]
    NoRequests,
    /// Two requests that no camera could tell apart.
    #[error("`{0}` and `{1}` play the same pattern: give one of them another")]
    SamePattern(String, String),
    /// A clock tolerance that is negative, not a number or larger than a tenth.
    #[error("`{0}`: a clock tolerance lies between 0 and 0.1")]
    ClockTolerance(String),
    /// A frame without pixels or too small to hold a light and its surroundings.
    #[error("a picture of {width}x{height} pixels is too small")]
    TooSmall {
        /// Columns of the frame.
        width: usize,
        /// Rows of the frame.
        height: usize,
    },
    /// A frame with so many pixels that those which must be remembered would not fit in memory.
    #[error(
        "a picture of {width}x{height} pixels is too large, {most} are the most that {frames} frames are \
         remembered of: have the camera deliver smaller ones"
    )]
    TooLarge {
        /// Columns of the frame.
        width: usize,
        /// Rows of the frame.
        height: usize,
        /// Frames that are remembered.
        frames: usize,
        /// Most pixels of a frame.
        most: usize,
    },
    /// A frame of another size than the first.
    #[error("the picture size changed from {before:?} to {now:?} (columns, rows)")]
    SizeChanged {
        /// Columns and rows of the first frame.
        before: (usize, usize),
        /// Columns and rows of this one.
        now: (usize, usize),
    },
    /// A stamp not later than the one before.
    #[error("frame {sequence} is stamped {stamp:?}, not after the one before it ({before:?})")]
    Backwards {
        /// Number of the frame.
        sequence: u64,
        /// Its stamp.
        stamp: Duration,
        /// Stamp of the frame before.
        before: Duration,
    },
}

/// A method that finds blinking landmarks in one camera's video.
pub trait Finder {
    /// Takes the next frame; frames come in order of their stamps, gaps are allowed.
    fn push(&mut self, frame: &Frame) -> Result<(), FinderError>;

    /// Says that no more frames come: a last decision with what there is.
    fn finish(&mut self) {}

    /// What is known so far, one decision a request and in their order.
    fn decisions(&self) -> &[Decision];

    /// Whether every request is decided, so that looking on brings nothing new.
    fn is_done(&self) -> bool {
        self.decisions().iter().all(|d| *d != Decision::Undecided)
    }
}

/// Refuses requests that cannot be answered.
pub(crate) fn check_requests(requests: &[Request]) -> Result<(), FinderError> {
    if requests.is_empty() {
        return Err(FinderError::NoRequests);
    }
    for (k, request) in requests.iter().enumerate() {
        if !(0.0..=0.1).contains(&request.clock_tolerance) {
            return Err(FinderError::ClockTolerance(request.id.clone()));
        }
        if let Some(twin) = requests[..k].iter().find(|r| same_light(&r.pattern, &request.pattern))
        {
            return Err(FinderError::SamePattern(twin.id.clone(), request.id.clone()));
        }
    }
    Ok(())
}

/// Whether two patterns differ by nothing but their phase.
fn same_light(a: &Pattern, b: &Pattern) -> bool {
    let n = a.bits.len() as i64;
    a.chip == b.chip
        && a.bits.len() == b.bits.len()
        && (0..n).any(|shift| (0..n).all(|k| a.bits.chip(k + shift) == b.bits.chip(k)))
}

/// What a finder remembers of the frames before: their size and the last stamp.
#[derive(Debug, Clone, Default)]
pub(crate) struct Sequence {
    first: Option<((usize, usize), Duration)>,
    last: Option<Duration>,
}

impl Sequence {
    /// Side of the smallest picture that is accepted (px).
    const MIN_SIDE: usize = 16;

    /// Stamp of the newest frame.
    pub fn last_stamp(&self) -> Option<Duration> {
        self.last
    }

    /// Accepts a frame and returns its time since the first frame (s).
    pub fn accept(&mut self, frame: &Frame) -> Result<f64, FinderError> {
        let now = (frame.image.width(), frame.image.height());
        if now.0.min(now.1) < Self::MIN_SIDE {
            return Err(FinderError::TooSmall { width: now.0, height: now.1 });
        }
        let (before, start) = *self.first.get_or_insert((now, frame.stamp));
        if before != now {
            return Err(FinderError::SizeChanged { before, now });
        }
        if let Some(before) = self.last.filter(|b| *b >= frame.stamp) {
            let (sequence, stamp) = (frame.sequence, frame.stamp);
            return Err(FinderError::Backwards { sequence, stamp, before });
        }
        self.last = Some(frame.stamp);
        Ok((frame.stamp - start).as_secs_f64())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vergence_imaging::Image;

    fn request(bits: &str, chip_ms: u64) -> Request {
        let pattern = Pattern::new(bits.parse().unwrap(), Duration::from_millis(chip_ms)).unwrap();
        Request { id: format!("{bits}@{chip_ms}"), pattern, clock_tolerance: 2e-4 }
    }

    #[test]
    fn patterns_that_differ_only_in_phase_are_refused() {
        let twins = [request("1110010", 50), request("1001011", 50)];
        assert!(matches!(check_requests(&twins), Err(FinderError::SamePattern(..))));
        check_requests(&[request("1110010", 50), request("1110010", 60)]).unwrap();
        assert_eq!(check_requests(&[]), Err(FinderError::NoRequests));
    }

    #[test]
    fn frames_out_of_order_or_of_another_size_are_refused() {
        let frame = |ms, side| Frame {
            image: Image::filled(side, side, 0u8),
            stamp: Duration::from_millis(ms),
            exposure: Duration::from_millis(5),
            row_time: None,
            sequence: 0,
        };
        let mut sequence = Sequence::default();
        assert_eq!(sequence.accept(&frame(1000, 32)), Ok(0.0));
        assert!((sequence.accept(&frame(1040, 32)).unwrap() - 0.04).abs() < 1e-12);
        assert!(matches!(sequence.accept(&frame(1040, 32)), Err(FinderError::Backwards { .. })));
        assert!(matches!(sequence.accept(&frame(1080, 33)), Err(FinderError::SizeChanged { .. })));
        assert!(matches!(sequence.accept(&frame(1080, 3)), Err(FinderError::TooSmall { .. })));
    }
}
