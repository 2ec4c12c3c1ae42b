//! The pictures of an image topic, and the camera that took them.

use std::collections::VecDeque;
use std::path::Path;
use std::time::Duration;

use vergence_geometry::{Camera, Distortion};
use vergence_imaging::{Frame, Image, codec};

use super::error::RecordingError;
use super::pixels;
use super::reader::{Messages, OfTopic, decode, type_of};
use super::stream::Raw;
use crate::message::Message;
use crate::msg::sensor_msgs::{CameraInfo, CompressedImage, RegionOfInterest};
use crate::msg::std_msgs::Header;
use crate::msg::{builtin_interfaces::Time, sensor_msgs};

/// How many pictures are held back to put those that were recorded out of order in their place.
const HELD_BACK: usize = 4;

/// The pictures of an image topic, see [`frames`].
pub struct Frames {
    raw: OfTopic,
    exposure: Duration,
    held: VecDeque<Frame>,
    last: Option<Duration>,
}

/// The pictures of a `sensor_msgs/Image` or `CompressedImage` topic as grey frames.
///
/// ROS does not record how long a picture was exposed: `exposure` says it. `stamp` is the header's,
/// which by ROS's convention is the start of the exposure (the recording time, where a driver left
/// the stamp at zero); stamps strictly increase: pictures recorded a few places out of order are put
/// in order, one that comes later than that or repeats a stamp is left out. `sequence` is the
/// running number on the topic, `row_time` unknown.
///
/// A picture or a chunk that cannot be decoded is an error, after which the next one follows;
/// damage to the file's framing ends the iteration.
pub fn frames(path: &Path, topic: &str, exposure: Duration) -> Result<Frames, RecordingError> {
    Ok(Frames {
        raw: OfTopic::open(path, topic)?,
        exposure,
        held: VecDeque::with_capacity(HELD_BACK + 1),
        last: None,
    })
}

impl Iterator for Frames {
    type Item = Result<Frame, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        while self.held.len() <= HELD_BACK {
            let Some(found) = self.raw.next() else { break };
            match found.and_then(|(index, raw)| self.frame(index, &raw)) {
                Ok(frame) => self.hold(frame),
                Err(error) => return Some(Err(error)),
            }
        }
        let frame = self.held.pop_front()?;
        self.last = Some(frame.stamp);
        Some(Ok(frame))
    }
}

impl Frames {
    /// Puts a frame in its place by stamp, unless that place has passed or is taken.
    fn hold(&mut self, frame: Frame) {
        let place = self.held.partition_point(|held| held.stamp < frame.stamp);
        let taken = self.held.get(place).is_some_and(|held| held.stamp == frame.stamp);
        if !taken && self.last.is_none_or(|last| last < frame.stamp) {
            self.held.insert(place, frame);
            // Numbers follow the order of delivery, so that a consumer never sees one go down.
            for later in place + 1..self.held.len() {
                let number = self.held[later].sequence;
                self.held[later].sequence = self.held[later - 1].sequence;
                self.held[later - 1].sequence = number;
            }
        }
    }

    fn frame(&self, index: u64, raw: &Raw) -> Result<Frame, RecordingError> {
        let topic = || raw.channel.topic.clone();
        let (header, image): (Header, Image<u8>) =
            if type_of(&raw.channel) == CompressedImage::TYPE {
                let message: CompressedImage = decode(raw, index)?;
                let image = codec::decode(&message.data)
                    .map_err(|source| RecordingError::Codec { topic: topic(), index, source })?;
                (message.header, image)
            } else {
                let mut message: sensor_msgs::Image = decode(raw, index)?;
                let header = std::mem::take(&mut message.header);
                let image = pixels::grey(message).map_err(|source| RecordingError::Pixels {
                    topic: topic(),
                    index,
                    source,
                })?;
                (header, image)
            };
        let stamp = match header.stamp {
            Time { sec: 0, nanosec: 0 } => Duration::from_nanos(raw.log_time),
            Time { sec, nanosec } => header
                .stamp
                .to_duration()
                .ok_or_else(|| RecordingError::Stamp { topic: topic(), index, sec, nanosec })?,
        };
        Ok(Frame { image, stamp, exposure: self.exposure, row_time: None, sequence: index })
    }
}

/// The camera of a `sensor_msgs/CameraInfo` topic, from its first message.
pub fn camera_info(path: &Path, topic: &str) -> Result<Camera, RecordingError> {
    let missing = |found| RecordingError::NoTopic { path: path.into(), topic: topic.into(), found };
    let mut messages = Messages::<CameraInfo>::open(path, topic)?;
    let info = messages.next().ok_or_else(|| missing(Vec::new()))??.message;
    camera(&info, topic)
}

fn camera(info: &CameraInfo, topic: &str) -> Result<Camera, RecordingError> {
    let lens = || RecordingError::Lens {
        topic: topic.into(),
        model: info.distortion_model.clone(),
        count: info.d.len(),
    };
    let none = |d: &[f64]| d.iter().all(|value| *value == 0.0);
    let (roi, whole) = (&info.roi, RegionOfInterest::default());
    let full = RegionOfInterest { width: info.width, height: info.height, ..whole };
    if info.binning_x > 1 || info.binning_y > 1 || (*roi != whole && *roi != full) {
        return Err(RecordingError::Part { topic: topic.into() });
    }
    let distortion = match (info.distortion_model.as_str(), info.d.as_slice()) {
        ("plumb_bob" | "rational_polynomial" | "", d) if none(d) => Distortion::default(),
        ("plumb_bob" | "", &[k1, k2, p1, p2]) => Distortion { k1, k2, p1, p2, k3: 0.0 },
        // The rational model is the same as long as its further numbers are zero.
        ("plumb_bob" | "rational_polynomial" | "", &[k1, k2, p1, p2, k3, ref more @ ..])
            if none(more) =>
        {
            Distortion { k1, k2, p1, p2, k3 }
        }
        _ => return Err(lens()),
    };
    let [fx, _, cx, _, fy, cy, ..] = info.k;
    let (width, height) = (info.width as usize, info.height as usize);
    let camera = Camera { width, height, fx, fy, cx, cy, distortion };
    camera.validate().map_err(|source| RecordingError::Camera { topic: topic.into(), source })?;
    Ok(camera)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::convert;

    fn info(model: &str, d: &[f64]) -> CameraInfo {
        let info = convert::camera_info(&Camera::centred(320, 240, 300.0), Duration::ZERO, "eye");
        CameraInfo { distortion_model: model.into(), d: d.into(), ..info }
    }

    #[test]
    fn lens_models_that_are_the_same_are_read_and_others_refused() {
        let rational = [0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0];
        let camera_of = |info: CameraInfo| camera(&info, "/info");
        let expected = Distortion { k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4, k3: 0.5 };
        assert_eq!(camera_of(info("plumb_bob", &rational[..5])).unwrap().distortion, expected);
        assert_eq!(camera_of(info("rational_polynomial", &rational)).unwrap().distortion, expected);
        assert!(camera_of(info("", &[])).unwrap().distortion.is_none());
        let refused = |info| camera_of(info).unwrap_err().to_string();
        // Even without coefficients this is no pinhole camera.
        let fisheye = refused(info("equidistant", &[0.0; 4]));
        assert!(fisheye.contains("\"equidistant\" with 4 numbers"), "{fisheye}");
        let full_rational = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0, 0.0];
        assert!(refused(info("rational_polynomial", &full_rational)).contains("8 numbers"));
    }

    #[test]
    fn numbers_that_cannot_be_and_parts_of_a_picture_are_refused() {
        let refused = |info: CameraInfo| camera(&info, "/info").unwrap_err();
        let uncalibrated = CameraInfo { k: [0.0; 9], ..info("plumb_bob", &[]) };
        assert!(refused(uncalibrated).to_string().contains("fx"));
        let binned = CameraInfo { binning_x: 2, ..info("plumb_bob", &[]) };
        assert!(matches!(refused(binned), RecordingError::Part { .. }));
        let roi = RegionOfInterest { x_offset: 8, width: 64, height: 48, ..Default::default() };
        let cropped = CameraInfo { roi, ..info("plumb_bob", &[]) };
        assert!(matches!(refused(cropped), RecordingError::Part { .. }));
    }
}
