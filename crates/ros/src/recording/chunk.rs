//! Chunk compression: zstd and lz4 by pure Rust decoders, as plug-ins of the MCAP reader.
//!
//! The MCAP reader pushes compressed bytes, the decoders pull them. So a chunk's compressed bytes
//! are collected first (the reader bounds how many), then decoded piece by piece as they are asked
//! for: a small chunk that claims to unpack to gigabytes costs no memory.

use std::io::{Cursor, Read};

use lz4_flex::frame::FrameDecoder;
use mcap::sans_io::decompressor::{DecompressResult, Decompressor};
use mcap::{McapError, McapResult};
use ruzstd::decoding::StreamingDecoder;

type Source = Box<dyn Read + Send>;

/// A decoder of one compression format.
pub(super) struct Decoder {
    name: &'static str,
    open: fn(Cursor<Vec<u8>>) -> McapResult<Source>,
    open_chunk: Option<Source>,
}

/// The decoder for chunks that are marked `zstd`.
pub(super) fn zstd() -> Decoder {
    Decoder {
        name: "zstd",
        open: |bytes| match StreamingDecoder::new(bytes) {
            Ok(decoder) => Ok(Box::new(decoder)),
            Err(error) => Err(McapError::DecompressionError(error.to_string())),
        },
        open_chunk: None,
    }
}

/// The decoder for chunks that are marked `lz4`.
pub(super) fn lz4() -> Decoder {
    Decoder { name: "lz4", open: |bytes| Ok(Box::new(FrameDecoder::new(bytes))), open_chunk: None }
}

impl Decompressor for Decoder {
    fn next_read_size(&self) -> usize {
        match self.open_chunk {
            Some(_) => 0,
            // The reader cuts this to what the chunk has, and to its own limit.
            None => usize::MAX,
        }
    }

    fn decompress(&mut self, src: &[u8], dst: &mut [u8]) -> McapResult<DecompressResult> {
        let source = match &mut self.open_chunk {
            Some(source) => source,
            None => self.open_chunk.insert((self.open)(Cursor::new(src.to_vec()))?),
        };
        let wrote = source.read(dst)?;
        Ok(DecompressResult { consumed: src.len(), wrote })
    }

    fn reset(&mut self) -> McapResult<()> {
        self.open_chunk = None;
        Ok(())
    }

    fn name(&self) -> &'static str {
        self.name
    }
}
