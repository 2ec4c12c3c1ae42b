//! What can be wrong with a recording.

use std::path::PathBuf;

use vergence_geometry::CameraError;
use vergence_imaging::CodecError;

use super::pixels::PixelError;
use crate::cdr::CdrError;

/// Why a recording could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file could not be opened, read or written.
    #[error("{path}: {source}")]
    File {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not MCAP, or damaged.
    #[error("{path}: not a readable MCAP recording: {source}")]
    Container {
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        source: mcap::McapError,
    },
    /// The recording has no message on the topic.
    #[error("{path} has no message on \"{topic}\"; it has {}", list(.found))]
    NoTopic {
        /// Which file.
        path: PathBuf,
        /// The topic asked for.
        topic: String,
        /// The topics that carry messages.
        found: Vec<String>,
    },
    /// The topic carries another type.
    #[error("\"{topic}\" carries {found}, not {expected}")]
    OtherType {
        /// Which topic.
        topic: String,
        /// The type asked for.
        expected: String,
        /// The type in the file.
        found: String,
    },
    /// A message does not decode.
    #[error("\"{topic}\" message {index}: {source}")]
    Message {
        /// Which topic.
        topic: String,
        /// Running number on the topic, from 0.
        index: u64,
        /// What is wrong.
        source: CdrError,
    },
    /// A stamp before zero, or with more than 10^9 nanoseconds.
    #[error("\"{topic}\" message {index}: the stamp {sec} s {nanosec} ns cannot be")]
    Stamp {
        /// Which topic.
        topic: String,
        /// Running number on the topic, from 0.
        index: u64,
        /// Seconds as recorded.
        sec: i32,
        /// Nanoseconds as recorded.
        nanosec: u32,
    },
    /// A picture's pixels cannot be used.
    #[error("\"{topic}\" picture {index}: {source}")]
    Pixels {
        /// Which topic.
        topic: String,
        /// Running number on the topic, from 0.
        index: u64,
        /// What is wrong.
        source: PixelError,
    },
    /// A compressed picture does not decode.
    #[error("\"{topic}\" picture {index}: {source}")]
    Codec {
        /// Which topic.
        topic: String,
        /// Running number on the topic, from 0.
        index: u64,
        /// What is wrong.
        source: CodecError,
    },
    /// The camera's numbers cannot be.
    #[error("\"{topic}\": {source}")]
    Camera {
        /// Which topic.
        topic: String,
        /// What is wrong.
        source: CameraError,
    },
    /// The camera has a lens model that Vergence does not have.
    #[error(
        "\"{topic}\": distortion model \"{model}\" with {count} numbers; only plumb_bob is known"
    )]
    Lens {
        /// Which topic.
        topic: String,
        /// The model's name.
        model: String,
        /// How many coefficients it has.
        count: usize,
    },
    /// The camera's numbers are for a larger picture than the one that is recorded.
    #[error("\"{topic}\": binning and regions of interest are not read; record whole pictures")]
    Part {
        /// Which topic.
        topic: String,
    },
    /// A topic was written with two different types.
    #[error("\"{topic}\" already carries {first}; {second} cannot be written to it")]
    TwoTypes {
        /// Which topic.
        topic: String,
        /// The type of the first message.
        first: String,
        /// The type of the refused message.
        second: String,
    },
}

fn list(topics: &[String]) -> String {
    match topics {
        [] => "no message at all".into(),
        _ => topics.join(", "),
    }
}
