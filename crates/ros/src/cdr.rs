//! CDR, the wire format of ROS 2 messages: values in, bytes out, and back.
//!
//! Method: plain CDR of XCDR version 1 (OMG DDSI-RTPS, "CDR encapsulation"). Four bytes of header
//! tell the byte order; then each number stands at a multiple of its own size, counted from the end
//! of the header. Strings carry their length with the closing zero byte, sequences their count.
//!
//! [`Writer`] writes little endian. [`Reader`] takes either byte order and bytes from anywhere: it
//! never panics, and it checks a length against the bytes that are left before it reserves memory.

/// Bytes of the encapsulation header.
const HEADER: usize = 4;
/// Plain CDR, little endian: second byte of the header.
const LITTLE_ENDIAN: u8 = 1;

/// Why bytes are no message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The bytes end inside a value.
    #[error("the message ends at byte {at}: {needed} more bytes were expected, {left} are left")]
    Truncated {
        /// Where reading stopped.
        at: usize,
        /// How many bytes the next value takes.
        needed: usize,
        /// How many bytes there are.
        left: usize,
    },
    /// A sequence claims more elements than the bytes that are left can hold.
    #[error("the message claims {count} elements at byte {at}, but only {left} bytes are left")]
    Count {
        /// Where the count stands.
        at: usize,
        /// The count claimed.
        count: usize,
        /// How many bytes there are.
        left: usize,
    },
    /// A string is not UTF-8.
    #[error("the text at byte {at} is not UTF-8")]
    Text {
        /// Where the text starts.
        at: usize,
    },
    /// A header other than plain CDR of either byte order.
    #[error("encapsulation {0:02x}{1:02x} is not plain CDR")]
    Encapsulation(u8, u8),
}

/// Writes values one after another, little endian.
#[derive(Debug, Clone)]
pub struct Writer {
    bytes: Vec<u8>,
}

impl Default for Writer {
    fn default() -> Self {
        Writer { bytes: vec![0, LITTLE_ENDIAN, 0, 0] }
    }
}

impl Writer {
    /// The bytes of the message with their header.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends a number of `N` bytes (little endian) at a multiple of `N`.
    pub fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        let used = self.bytes.len() - HEADER;
        self.bytes.resize(HEADER + used.next_multiple_of(N), 0);
        self.bytes.extend_from_slice(&bytes);
    }

    /// Appends the count of a sequence. CDR has 32 bits for it; a longer sequence is cut by the
    /// caller, see [`Writer::fits`].
    pub fn count(&mut self, count: usize) {
        self.number((Self::fits(count) as u32).to_le_bytes());
    }

    /// How many of `count` elements a sequence can hold.
    pub fn fits(count: usize) -> usize {
        count.min(u32::MAX as usize)
    }

    /// Appends bytes as they are.
    pub fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// Appends a string with its closing zero byte.
    pub fn text(&mut self, text: &str) {
        self.count(text.len() + 1);
        self.raw(text.as_bytes());
        self.raw(&[0]);
    }
}

/// Reads values one after another from bytes that may be wrong.
#[derive(Debug, Clone)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    little: bool,
}

impl<'a> Reader<'a> {
    /// Starts after the header, which tells the byte order.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        let Some((&[first, second, _, _], _)) = bytes.split_first_chunk::<HEADER>() else {
            return Err(CdrError::Truncated { at: 0, needed: HEADER, left: bytes.len() });
        };
        if first != 0 || second > LITTLE_ENDIAN {
            return Err(CdrError::Encapsulation(first, second));
        }
        Ok(Reader { bytes, at: HEADER, little: second == LITTLE_ENDIAN })
    }

    /// How many bytes are left.
    pub fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// The next `count` bytes as they are.
    pub fn raw(&mut self, count: usize) -> Result<&'a [u8], CdrError> {
        let left = self.left();
        let taken = self
            .bytes
            .get(self.at..)
            .and_then(|rest| rest.get(..count))
            .ok_or(CdrError::Truncated { at: self.at, needed: count, left })?;
        self.at += count;
        Ok(taken)
    }

    /// The next number of `N` bytes, skipping the padding before it, as little endian bytes.
    pub fn number<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let used = self.at - HEADER;
        self.raw(used.next_multiple_of(N) - used)?;
        let mut number = [0; N];
        number.copy_from_slice(self.raw(N)?);
        if !self.little {
            number.reverse();
        }
        Ok(number)
    }

    /// The count of a sequence whose elements take at least `smallest` bytes each.
    pub fn count(&mut self, smallest: usize) -> Result<usize, CdrError> {
        let count = u32::from_le_bytes(self.number()?) as usize;
        let (at, left) = (self.at, self.left());
        match count.checked_mul(smallest) {
            Some(needed) if needed <= left => Ok(count),
            _ => Err(CdrError::Count { at, count, left }),
        }
    }

    /// A string. The closing zero byte is not part of it; writers that leave it out are understood.
    pub fn text(&mut self) -> Result<&'a str, CdrError> {
        let length = self.count(1)?;
        let at = self.at;
        let bytes = self.raw(length)?;
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        std::str::from_utf8(bytes).map_err(|_| CdrError::Text { at })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_stand_at_multiples_of_their_size() {
        let mut writer = Writer::default();
        writer.number([7u8]);
        writer.number(0x0102_0304u32.to_le_bytes());
        writer.text("ab");
        writer.number(1.5f64.to_le_bytes());
        let bytes = writer.finish();
        // Worked by hand: byte, 3 padding, u32, count 3 with "ab\0", 1 padding up to 16, f64.
        let mut expected = vec![0, 1, 0, 0, 7, 0, 0, 0, 4, 3, 2, 1, 3, 0, 0, 0, b'a', b'b', 0, 0];
        expected.extend(1.5f64.to_le_bytes());
        assert_eq!(bytes, expected);
    }

    #[test]
    fn big_endian_is_read() {
        let bytes = [0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 1, 2];
        let mut reader = Reader::new(&bytes).unwrap();
        assert_eq!(reader.number::<1>().unwrap(), [9]);
        assert_eq!(u32::from_le_bytes(reader.number().unwrap()), 258);
        assert_eq!(reader.left(), 0);
    }

    #[test]
    fn a_count_beyond_the_bytes_is_refused() {
        let bytes = [0, 1, 0, 0, 255, 255, 255, 255, 1, 2];
        let mut reader = Reader::new(&bytes).unwrap();
        assert_eq!(
            reader.count(8),
            Err(CdrError::Count { at: 8, count: u32::MAX as usize, left: 2 })
        );
        assert!(Reader::new(&[0, 7, 0, 0]).is_err());
        assert!(Reader::new(&[0, 1]).is_err());
    }
}
