//! Writes a recording.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::Duration;

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions};

use super::error::RecordingError;
use crate::message::Message;

/// The quality of service that `rosbag2` notes for a topic whose last message late subscribers get.
const LATCHED: &str = "\
- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
";

/// Writes messages of any type to an MCAP file with the profile `ros2`.
///
/// Chunks are not compressed: pictures with sensor noise hardly shrink, and the default build stays
/// free of C. Each chunk (1 MiB) goes to the file in one piece, so after a crash everything but the
/// last chunk can be read; dropping the writer finishes the file, [`Writer::finish`] also tells
/// whether that worked.
pub struct Writer {
    path: PathBuf,
    mcap: mcap::Writer<BufWriter<File>>,
    channels: BTreeMap<String, Channel>,
}

struct Channel {
    id: u16,
    message_type: &'static str,
    messages: u32,
}

impl Writer {
    /// Creates the file, over an old one.
    pub fn create(path: &Path) -> Result<Self, RecordingError> {
        let file = File::create(path)
            .map_err(|source| RecordingError::File { path: path.into(), source })?;
        let mcap = WriteOptions::new()
            .compression(None)
            .profile("ros2")
            .library(concat!("vergence/", env!("CARGO_PKG_VERSION")))
            // Whole chunks, instead of a header that is filled in later by seeking back.
            .disable_seeking(true)
            .create(BufWriter::new(file))
            .map_err(|source| RecordingError::Container { path: path.into(), source })?;
        Ok(Writer { path: path.into(), mcap, channels: BTreeMap::new() })
    }

    /// Appends a message; `stamp` is the time of recording.
    pub fn write<M: Message>(
        &mut self,
        topic: &str,
        stamp: Duration,
        message: &M,
    ) -> Result<(), RecordingError> {
        self.append(topic, stamp, message, "")
    }

    /// Appends a message of a topic that keeps its last message for late subscribers, such as
    /// `/robot_description` and `/tf_static`.
    pub fn write_latched<M: Message>(
        &mut self,
        topic: &str,
        stamp: Duration,
        message: &M,
    ) -> Result<(), RecordingError> {
        self.append(topic, stamp, message, LATCHED)
    }

    /// Writes what is left and the index.
    pub fn finish(mut self) -> Result<(), RecordingError> {
        self.mcap.finish().map_err(|source| self.failed(source))?;
        let file = self.mcap.into_inner().into_inner().map_err(|error| error.into_error());
        file.and_then(|file| file.sync_all())
            .map_err(|source| RecordingError::File { path: self.path, source })
    }

    fn append<M: Message>(
        &mut self,
        topic: &str,
        stamp: Duration,
        message: &M,
        qos: &str,
    ) -> Result<(), RecordingError> {
        if !self.channels.contains_key(topic) {
            let channel = self.open_channel::<M>(topic, qos).map_err(|e| self.failed(e))?;
            self.channels.insert(topic.into(), channel);
        }
        let Some(channel) = self.channels.get_mut(topic) else { return Ok(()) };
        if channel.message_type != M::TYPE {
            return Err(RecordingError::TwoTypes {
                topic: topic.into(),
                first: channel.message_type.into(),
                second: M::TYPE.into(),
            });
        }
        // 584 years of nanoseconds fit.
        let time = u64::try_from(stamp.as_nanos()).unwrap_or(u64::MAX);
        let header = MessageHeader {
            channel_id: channel.id,
            sequence: channel.messages,
            log_time: time,
            publish_time: time,
        };
        channel.messages = channel.messages.wrapping_add(1);
        let bytes = message.to_cdr();
        self.mcap.write_to_known_channel(&header, &bytes).map_err(|source| self.failed(source))
    }

    fn open_channel<M: Message>(&mut self, topic: &str, qos: &str) -> Result<Channel, McapError> {
        let schema = self.mcap.add_schema(M::TYPE, "ros2msg", M::schema().as_bytes())?;
        let metadata = BTreeMap::from([("offered_qos_profiles".into(), qos.into())]);
        let id = self.mcap.add_channel(schema, topic, "cdr", &metadata)?;
        Ok(Channel { id, message_type: M::TYPE, messages: 0 })
    }

    fn failed(&self, source: McapError) -> RecordingError {
        RecordingError::Container { path: self.path.clone(), source }
    }
}
