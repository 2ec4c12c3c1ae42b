//! The messages of an MCAP file, one after another, in the order in which they were written.

use std::borrow::Cow;
use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::read::ChannelAccumulator;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Channel, McapError, McapResult, parse_record};

use super::chunk::Chunk;
use super::error::RecordingError;

/// Largest record and largest chunk, packed or not, that is read (bytes): a bound on memory.
const LARGEST_RECORD: usize = 128 << 20;
/// Most bytes read at once; a record that claims more than the file holds costs no more than this.
const READ_AT_ONCE: usize = 1 << 20;

/// One message, not decoded yet.
pub(super) struct Raw {
    /// Topic, type and encoding.
    pub channel: Arc<Channel<'static>>,
    /// When it was recorded (ns).
    pub log_time: u64,
    /// The message's bytes.
    pub data: Vec<u8>,
}

/// Reads a file from its start.
pub(super) struct Stream {
    path: PathBuf,
    file: File,
    reader: LinearReader,
    chunk: Chunk,
    channels: ChannelAccumulator<'static>,
    end: Option<End>,
}

/// How a stream ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    /// With the end of the data section.
    Complete,
    /// In the middle: the writer never finished.
    CutOff,
    /// With an error, which was returned.
    Damaged,
}

impl Stream {
    pub(super) fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path)
            .map_err(|source| RecordingError::File { path: path.into(), source })?;
        let options = LinearReaderOptions::default()
            .with_record_length_limit(LARGEST_RECORD)
            .with_emit_chunks(true);
        Ok(Stream {
            path: path.into(),
            file,
            reader: LinearReader::new_with_options(options),
            chunk: Chunk::default(),
            channels: ChannelAccumulator::default(),
            end: None,
        })
    }

    /// The file.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// How the stream ended, once it has.
    pub(super) fn end(&self) -> Option<End> {
        self.end
    }

    /// The next message; `None` at the end of the data, or where a cut-off file stops. After an
    /// error in one chunk the messages of the next chunk follow; damage between chunks is the end.
    pub(super) fn next(&mut self) -> Option<Result<Raw, RecordingError>> {
        if self.end.is_some() {
            return None;
        }
        loop {
            if let Some(raw) = self.next_of_chunk() {
                return Some(raw.map_err(|source| self.failed(source)));
            }
            match self.next_outside() {
                Ok(Outside::Message(raw)) => return Some(Ok(raw)),
                Ok(Outside::Chunk(Ok(chunk))) => self.chunk = chunk,
                Ok(Outside::Chunk(Err(source))) => return Some(Err(self.failed(source))),
                Ok(Outside::End) => {
                    self.end = Some(End::Complete);
                    return None;
                }
                // No magic at all is another kind of file, not a recording cut off.
                Err(McapError::UnexpectedEof) if self.started() => {
                    self.end = Some(End::CutOff);
                    return None;
                }
                Err(source) => {
                    self.end = Some(End::Damaged);
                    return Some(Err(self.failed(source)));
                }
            }
        }
    }

    fn failed(&self, source: McapError) -> RecordingError {
        let path = self.path.clone();
        match source {
            McapError::Io(source) if self.end.is_some() => RecordingError::File { path, source },
            source => RecordingError::Container { path, source },
        }
    }

    fn started(&self) -> bool {
        use std::io::Seek;
        (&self.file).stream_position().is_ok_and(|position| position >= mcap::MAGIC.len() as u64)
    }

    /// The next message of the chunk that was read last.
    fn next_of_chunk(&mut self) -> Option<McapResult<Raw>> {
        loop {
            let record = self.chunk.next()?;
            match record.and_then(|(opcode, data)| take(&mut self.channels, opcode, data)) {
                Ok(None) => {}
                Ok(Some(raw)) => return Some(Ok(raw)),
                Err(error) => {
                    self.chunk = Chunk::default();
                    return Some(Err(error));
                }
            }
        }
    }

    /// The next chunk, or message outside a chunk.
    fn next_outside(&mut self) -> McapResult<Outside> {
        loop {
            let Some(event) = self.reader.next_event() else { return Ok(Outside::End) };
            match event? {
                LinearReadEvent::ReadRequest(wanted) => {
                    let buffer = self.reader.insert(wanted.min(READ_AT_ONCE));
                    let got = read_some(&mut self.file, buffer)?;
                    self.reader.notify_read(got);
                }
                // The summary behind it repeats what we know.
                LinearReadEvent::Record { opcode: op::DATA_END, .. } => return Ok(Outside::End),
                LinearReadEvent::Record { opcode: op::CHUNK, data } => {
                    if let Record::Chunk { header, data } = parse_record(op::CHUNK, data)? {
                        let chunk = Chunk::unpack(&header, &data, LARGEST_RECORD);
                        return Ok(Outside::Chunk(chunk));
                    }
                }
                LinearReadEvent::Record { opcode, data } => {
                    if let Some(raw) = take(&mut self.channels, opcode, data)? {
                        return Ok(Outside::Message(raw));
                    }
                }
            }
        }
    }
}

/// What stands next to each other in a file.
enum Outside {
    Message(Raw),
    Chunk(McapResult<Chunk>),
    End,
}

fn read_some(file: &mut File, buffer: &mut [u8]) -> std::io::Result<usize> {
    loop {
        match file.read(buffer) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            result => return result,
        }
    }
}

/// Remembers schemas and channels, returns messages. Attachments, indexes and metadata are skipped
/// without being parsed.
fn take(
    channels: &mut ChannelAccumulator<'static>,
    opcode: u8,
    data: &[u8],
) -> McapResult<Option<Raw>> {
    if ![op::SCHEMA, op::CHANNEL, op::MESSAGE].contains(&opcode) {
        return Ok(None);
    }
    match parse_record(opcode, data)? {
        Record::Schema { header, data } => {
            channels.add_schema(header, Cow::Owned(data.into_owned()))?;
        }
        Record::Channel(channel) => channels.add_channel(channel)?,
        Record::Message { header, data } => {
            let channel = channels
                .get(header.channel_id)
                .ok_or(McapError::UnknownChannel(header.sequence, header.channel_id))?;
            let data = data.into_owned();
            return Ok(Some(Raw { channel, log_time: header.log_time, data }));
        }
        _ => {}
    }
    Ok(None)
}
