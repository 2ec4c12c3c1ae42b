//! A recording as a list of topics and typed messages.

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::time::Duration;

use mcap::Channel;

use super::error::RecordingError;
use super::stream::{End, Raw, Stream};
use crate::message::Message;

/// One topic of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Name, such as `/left/image_raw`.
    pub name: String,
    /// Message type, such as `sensor_msgs/msg/Image`; empty when the file does not tell.
    pub message_type: String,
    /// How many messages it has.
    pub messages: u64,
}

/// A recording that was looked through once.
#[derive(Debug, Clone)]
pub struct Reader {
    path: PathBuf,
    topics: Vec<Topic>,
    complete: bool,
}

/// A message and when it was recorded.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded<M> {
    /// Time of recording, on the recorder's clock; the message's own stamp may differ.
    pub log_time: Duration,
    /// The message.
    pub message: M,
}

impl Reader {
    /// Reads the file once from start to end to count its messages, in memory that does not grow
    /// with the file. Any damage but a missing end is an error.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let mut stream = Stream::open(path)?;
        let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
        while let Some(raw) = stream.next() {
            let raw = raw?;
            let name = &raw.channel.topic;
            let topic = topics.entry(name.clone()).or_insert_with(|| Topic {
                name: name.clone(),
                message_type: type_of(&raw.channel).into(),
                messages: 0,
            });
            topic.messages += 1;
        }
        Ok(Reader {
            path: path.into(),
            topics: topics.into_values().collect(),
            complete: stream.end() == Some(End::Complete),
        })
    }

    /// The topics that carry messages, by name.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// False when the file was cut off before its end: what is there can be read all the same.
    pub fn is_complete(&self) -> bool {
        self.complete
    }

    /// The messages of one topic in the order of recording.
    pub fn messages<M: Message>(&self, topic: &str) -> Result<Messages<M>, RecordingError> {
        Messages::open(&self.path, topic)
    }
}

/// Messages of one topic and type in the order of recording.
///
/// After a message or a chunk that does not decode the next one follows; damage to the file's framing
/// ends the iteration.
pub struct Messages<M> {
    raw: OfTopic,
    message: PhantomData<M>,
}

impl<M: Message> Messages<M> {
    pub(super) fn open(path: &Path, topic: &str) -> Result<Self, RecordingError> {
        Ok(Messages { raw: OfTopic::open(path, topic)?, message: PhantomData })
    }
}

impl<M: Message> Iterator for Messages<M> {
    type Item = Result<Recorded<M>, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let (index, raw) = match self.raw.next()? {
            Ok(found) => found,
            Err(error) => return Some(Err(error)),
        };
        Some(
            decode(&raw, index)
                .map(|message| Recorded { log_time: Duration::from_nanos(raw.log_time), message }),
        )
    }
}

/// Undecoded messages of one topic with their running number.
pub(super) struct OfTopic {
    stream: Stream,
    topic: String,
    count: u64,
    others: Vec<String>,
}

impl OfTopic {
    pub(super) fn open(path: &Path, topic: &str) -> Result<Self, RecordingError> {
        let stream = Stream::open(path)?;
        Ok(OfTopic { stream, topic: topic.into(), count: 0, others: Vec::new() })
    }

    fn missing(&mut self) -> RecordingError {
        self.others.sort();
        RecordingError::NoTopic {
            path: self.stream.path().into(),
            topic: self.topic.clone(),
            found: std::mem::take(&mut self.others),
        }
    }
}

impl Iterator for OfTopic {
    type Item = Result<(u64, Raw), RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let ended = self.stream.end().is_some();
        while let Some(raw) = self.stream.next() {
            let raw = match raw {
                Ok(raw) => raw,
                Err(error) => return Some(Err(error)),
            };
            if raw.channel.topic == self.topic {
                let index = self.count;
                self.count += 1;
                return Some(Ok((index, raw)));
            }
            if !self.others.contains(&raw.channel.topic) {
                self.others.push(raw.channel.topic.clone());
            }
        }
        (!ended && self.count == 0).then(|| Err(self.missing()))
    }
}

/// The type's name of a channel; empty when the file does not tell.
pub(super) fn type_of<'a>(channel: &'a Channel<'_>) -> &'a str {
    channel.schema.as_ref().map_or("", |schema| &schema.name)
}

/// Decodes a message of the type `M`.
pub(super) fn decode<M: Message>(raw: &Raw, index: u64) -> Result<M, RecordingError> {
    let topic = &raw.channel.topic;
    let (found, encoding) = (type_of(&raw.channel), &raw.channel.message_encoding);
    if found != M::TYPE || encoding != "cdr" {
        return Err(RecordingError::OtherType {
            topic: topic.clone(),
            expected: format!("{} in cdr", M::TYPE),
            found: format!("{found} in {encoding}"),
        });
    }
    M::from_cdr(&raw.data).map_err(|source| RecordingError::Message {
        topic: topic.clone(),
        index,
        source,
    })
}
