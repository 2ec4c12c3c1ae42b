//! Frames out of a ROS 2 recording: `sensor_msgs/msg/Image` in CDR, in an MCAP file.

use std::path::Path;
use std::time::Duration;

use vergence_imaging::{Frame, Image};

use crate::failure::Failure;

/// The images of one topic in the order of the file. Exposure and row time are not in the message:
/// they come out as zero and unknown.
pub fn frames(
    path: &Path,
    topic: &str,
) -> Result<impl Iterator<Item = Result<Frame, Failure>>, Failure> {
    let name = path.display().to_string();
    let hint = "give an MCAP recording of ROS 2 images (mono8)";
    let bytes = std::fs::read(path).map_err(|e| Failure::misuse(format!("{name}: {e}"), hint))?;
    let mut frames = Vec::new();
    let messages = mcap::MessageStream::new(&bytes)
        .map_err(|e| Failure::misuse(format!("{name}: {e}"), hint))?;
    for message in messages {
        let message = message.map_err(|e| Failure::misuse(format!("{name}: {e}"), hint))?;
        if message.channel.topic != topic {
            continue;
        }
        let sequence = frames.len() as u64;
        let frame = image(&message.data, sequence)
            .ok_or_else(|| Failure::misuse(format!("{name}: image {sequence} is damaged"), hint));
        frames.push(frame);
    }
    Ok(frames.into_iter())
}

/// Decodes one mono8 image message.
fn image(cdr: &[u8], sequence: u64) -> Option<Frame> {
    let mut cursor = Cursor { body: cdr.get(4..)?, at: 0 };
    let (seconds, nanos) = (cursor.u32()?, cursor.u32()?);
    let _frame_id = cursor.bytes()?;
    let (height, width) = (cursor.u32()? as usize, cursor.u32()? as usize);
    let encoding = cursor.bytes()?;
    cursor.at += 1; // is_bigendian
    let step = cursor.u32()? as usize;
    let data = cursor.bytes()?;
    if encoding.strip_suffix(&[0])? != b"mono8"
        || step < width
        || width == 0
        || nanos >= 1_000_000_000
    {
        return None;
    }
    let mut pixels = Vec::with_capacity(width.checked_mul(height)?);
    for row in data.chunks_exact(step).take(height) {
        pixels.extend_from_slice(&row[..width]);
    }
    Some(Frame {
        image: Image::from_vec(width, height, pixels)?,
        stamp: Duration::new(u64::from(seconds), nanos),
        exposure: Duration::ZERO,
        row_time: None,
        sequence,
    })
}

/// A little-endian CDR body.
struct Cursor<'a> {
    body: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    fn u32(&mut self) -> Option<u32> {
        let at = self.at.next_multiple_of(4);
        let bytes = self.body.get(at..at + 4)?;
        self.at = at + 4;
        Some(u32::from_le_bytes(bytes.try_into().ok()?))
    }

    fn bytes(&mut self) -> Option<&'a [u8]> {
        let length = self.u32()? as usize;
        let bytes = self.body.get(self.at..self.at.checked_add(length)?)?;
        self.at += length;
        Some(bytes)
    }
}
