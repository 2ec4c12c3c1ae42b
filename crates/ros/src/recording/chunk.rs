//! One chunk of an MCAP file: its bytes in, its records out. Plain, zstd and lz4, in pure Rust.
//!
//! Nothing that the chunk's header claims is believed: memory grows with the bytes that really come
//! out of the decoder, up to a limit, and a record must lie inside the chunk.

use std::io::Read;

use mcap::records::ChunkHeader;
use mcap::{McapError, McapResult};

/// Opcode (1 byte) and length (8 bytes) of a record.
const RECORD_HEADER: usize = 9;

/// A chunk's records, unpacked.
#[derive(Default)]
pub(super) struct Chunk {
    bytes: Vec<u8>,
    at: usize,
}

impl Chunk {
    /// Unpacks a chunk of at most `largest` bytes and checks its sum.
    pub(super) fn unpack(header: &ChunkHeader, data: &[u8], largest: usize) -> McapResult<Chunk> {
        let size = match usize::try_from(header.uncompressed_size) {
            Ok(size) if size <= largest => size,
            _ => return Err(McapError::ChunkTooLarge(header.uncompressed_size)),
        };
        let bytes = match header.compression.as_str() {
            "" => data.to_vec(),
            "zstd" => {
                let decoder = ruzstd::decoding::StreamingDecoder::new(data)
                    .map_err(|error| McapError::DecompressionError(error.to_string()))?;
                pull(decoder, size)?
            }
            "lz4" => pull(lz4_flex::frame::FrameDecoder::new(data), size)?,
            other => return Err(McapError::UnsupportedCompression(other.into())),
        };
        if bytes.len() != size {
            let message = format!("{} bytes instead of {size}", bytes.len());
            return Err(McapError::DecompressionError(message));
        }
        let (saved, calculated) = (header.uncompressed_crc, crc32fast::hash(&bytes));
        // Zero means that the writer took no sum.
        if saved != 0 && saved != calculated {
            return Err(McapError::BadChunkCrc { saved, calculated });
        }
        Ok(Chunk { bytes, at: 0 })
    }

    /// The next record's opcode and body; `None` at the end of the chunk.
    pub(super) fn next(&mut self) -> Option<McapResult<(u8, &[u8])>> {
        let rest = self.bytes.get(self.at..).filter(|rest| !rest.is_empty())?;
        let Some((&[opcode, ref length @ ..], body)) = rest.split_first_chunk::<RECORD_HEADER>()
        else {
            return Some(Err(McapError::UnexpectedEoc));
        };
        let length = usize::try_from(u64::from_le_bytes(*length)).ok();
        let Some(body) = length.and_then(|length| body.get(..length)) else {
            return Some(Err(McapError::UnexpectedEoc));
        };
        self.at += RECORD_HEADER + body.len();
        Some(Ok((opcode, body)))
    }
}

/// Reads what a decoder gives, one byte more than `size` at most.
fn pull(decoder: impl Read, size: usize) -> McapResult<Vec<u8>> {
    let mut bytes = Vec::new();
    decoder.take(size as u64 + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(compression: &str, size: u64) -> ChunkHeader {
        ChunkHeader {
            message_start_time: 0,
            message_end_time: 0,
            uncompressed_size: size,
            uncompressed_crc: 0,
            compression: compression.into(),
            compressed_size: 0,
        }
    }

    /// A chunk of one record of opcode 5 that says it is `length` bytes long and has three.
    fn record(length: u64) -> Vec<u8> {
        let mut bytes = vec![5];
        bytes.extend(length.to_le_bytes());
        bytes.extend([1, 2, 3]);
        bytes
    }

    #[test]
    fn a_record_must_lie_inside_its_chunk() {
        for (length, fits) in [(3, true), (4, false), (u64::MAX, false)] {
            let bytes = record(length);
            let mut chunk = Chunk::unpack(&header("", 12), &bytes, 100).unwrap();
            assert_eq!(chunk.next().unwrap().is_ok(), fits, "length {length}");
        }
    }

    #[test]
    fn claims_are_checked() {
        let bytes = record(3);
        let unpack = |header: ChunkHeader| Chunk::unpack(&header, &bytes, 100);
        assert!(matches!(unpack(header("", 101)), Err(McapError::ChunkTooLarge(101))));
        assert!(matches!(unpack(header("", 11)), Err(McapError::DecompressionError(_))));
        assert!(matches!(unpack(header("xz", 12)), Err(McapError::UnsupportedCompression(_))));
        assert!(unpack(header("zstd", 12)).is_err());
        assert!(unpack(header("lz4", 12)).is_err());
        let wrong_sum = ChunkHeader { uncompressed_crc: 1, ..header("", 12) };
        assert!(matches!(unpack(wrong_sum), Err(McapError::BadChunkCrc { .. })));
    }
}
