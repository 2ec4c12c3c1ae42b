//! How a new record comes to a tag: in pieces that each fit one write, then a commit.
//!
//! A piece is its offset (u16) and up to 240 bytes; the commit is 0xFFFF, the record's length (u16)
//! and its CRC-32 (u32), all little endian. The tag collects pieces in memory, and at the commit
//! checks length, CRC and that the record can be true before it stores it. The old record stays in
//! force until then.

use crate::cbor::MAX_BYTES;

/// Most record bytes of one piece: fits an attribute value at the usual 247-byte MTU.
pub const PIECE: usize = 240;
/// Offset that marks the commit.
const COMMIT: u16 = 0xFFFF;

/// One write of an upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Upload<'a> {
    /// Bytes of the record from an offset on.
    Piece {
        /// Where they belong.
        offset: u16,
        /// The bytes.
        data: &'a [u8],
    },
    /// All pieces were sent.
    Commit {
        /// Length of the record (bytes).
        length: u16,
        /// CRC-32 of the record.
        crc: u32,
    },
}

impl<'a> Upload<'a> {
    /// Reads one write; `None` when it is neither.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let (offset, data) = bytes.split_first_chunk::<2>()?;
        let offset = u16::from_le_bytes(*offset);
        if offset != COMMIT {
            let fits = usize::from(offset) + data.len() <= MAX_BYTES && !data.is_empty();
            return fits.then_some(Upload::Piece { offset, data });
        }
        let [a, b, c, d, e, f] = *data else { return None };
        Some(Upload::Commit {
            length: u16::from_le_bytes([a, b]),
            crc: u32::from_le_bytes([c, d, e, f]),
        })
    }

    /// The writes that upload a record, in order. Records longer than [`MAX_BYTES`] have none.
    pub fn messages(
        record: &'a [u8],
    ) -> impl Iterator<Item = heapless::Vec<u8, { PIECE + 2 }>> + 'a {
        let record = if record.len() <= MAX_BYTES { record } else { &[] };
        let pieces = record
            .chunks(PIECE)
            .enumerate()
            .map(|(k, data)| Upload::Piece { offset: (k * PIECE) as u16, data });
        let commit = Upload::Commit { length: record.len() as u16, crc: crc32(record) };
        pieces.chain((!record.is_empty()).then_some(commit)).map(|message| message.encode())
    }

    /// The bytes of one write. A piece holds at most [`PIECE`] bytes; the rest would be cut off.
    pub fn encode(&self) -> heapless::Vec<u8, { PIECE + 2 }> {
        let mut bytes = heapless::Vec::new();
        let _ = match self {
            Upload::Piece { offset, data } => bytes
                .extend_from_slice(&offset.to_le_bytes())
                .and_then(|()| bytes.extend_from_slice(&data[..data.len().min(PIECE)])),
            Upload::Commit { length, crc } => bytes
                .extend_from_slice(&COMMIT.to_le_bytes())
                .and_then(|()| bytes.extend_from_slice(&length.to_le_bytes()))
                .and_then(|()| bytes.extend_from_slice(&crc.to_le_bytes())),
        };
        bytes
    }
}

/// CRC-32 as of IEEE 802.3, bit by bit: records are short and tables are not.
pub fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| {
            if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_crc_is_the_usual_one() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }

    proptest! {
        #[test]
        fn pieces_make_the_record(record in prop::collection::vec(any::<u8>(), 1..=MAX_BYTES)) {
            let mut collected = [0; MAX_BYTES];
            let mut committed = false;
            for message in Upload::messages(&record) {
                prop_assert!(!committed);
                match Upload::decode(&message) {
                    Some(Upload::Piece { offset, data }) => {
                        let at = usize::from(offset);
                        collected[at..at + data.len()].copy_from_slice(data);
                    }
                    Some(Upload::Commit { length, crc }) => {
                        prop_assert_eq!(usize::from(length), record.len());
                        prop_assert_eq!(crc, crc32(&record));
                        committed = true;
                    }
                    None => prop_assert!(false, "unreadable message"),
                }
            }
            prop_assert!(committed);
            prop_assert_eq!(&collected[..record.len()], &record[..]);
        }

        #[test]
        fn pieces_beyond_the_end_are_refused(offset in 0u16..0xFFFE, length in 1usize..=PIECE) {
            let message = Upload::Piece { offset, data: &[0; PIECE][..length] }.encode();
            let fits = usize::from(offset) + length <= MAX_BYTES;
            prop_assert_eq!(Upload::decode(&message).is_some(), fits);
        }
    }

    #[test]
    fn what_is_no_upload_has_no_messages() {
        assert_eq!(Upload::decode(&[0]), None);
        assert_eq!(Upload::decode(&[0, 0]), None);
        assert_eq!(Upload::decode(&[0xFF, 0xFF, 1]), None);
        assert_eq!(Upload::messages(&[0; MAX_BYTES + 1]).count(), 0);
        assert_eq!(Upload::messages(&[]).count(), 0);
    }
}
