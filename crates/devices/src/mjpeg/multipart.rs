//! The multipart stream: an HTTP answer, then parts between boundaries, each with headers and a body.
//!
//! Servers differ: with or without `Content-Length`, boundary with or without its dashes in the header,
//! bare line feeds. All sizes are bounded.

use std::io::{self, BufRead, Read};

/// Longest header line, and most header lines of a part.
const MAX_LINE: usize = 4096;
const MAX_LINES: usize = 64;
/// Largest picture.
const MAX_BODY: usize = 16 << 20;

/// Why a stream came to its end.
#[derive(Debug, thiserror::Error)]
pub(super) enum StreamError {
    #[error("the stream ended")]
    Ended,
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("the server answers \"{0}\"")]
    Status(String),
    #[error("the server sends {0}, not multipart/x-mixed-replace")]
    ContentType(String),
    #[error("a {0} is longer than any camera's")]
    TooLong(&'static str),
}

/// One picture of the stream.
pub(super) struct Part<T> {
    pub body: Vec<u8>,
    /// When its header arrived.
    pub arrival: T,
    /// The camera's own stamp (s).
    pub timestamp: Option<f64>,
}

/// The parts of a stream.
pub(super) struct Parts<R> {
    stream: R,
    boundary: Vec<u8>,
    /// The boundary before the next part has been read already.
    at_part: bool,
}

impl<R: BufRead> Parts<R> {
    /// Reads the head of the HTTP answer.
    pub(super) fn open(mut stream: R) -> Result<Self, StreamError> {
        let status = line(&mut stream)?;
        if status.split_whitespace().nth(1) != Some("200") {
            return Err(StreamError::Status(status));
        }
        let mut content_type = String::new();
        for (name, value) in headers(&mut stream)? {
            if name == "content-type" {
                content_type = value;
            }
        }
        let boundary = content_type
            .split(';')
            .map(str::trim)
            .find_map(|p| p.strip_prefix("boundary="))
            .map(|b| b.trim_matches('"').trim_start_matches('-').to_owned());
        match boundary {
            Some(b) if content_type.starts_with("multipart/") && !b.is_empty() => {
                Ok(Parts { stream, boundary: b.into_bytes(), at_part: false })
            }
            _ => Err(StreamError::ContentType(content_type)),
        }
    }

    /// Reads the next part; `now` is called when its header has come.
    pub(super) fn next_part<T>(&mut self, now: impl FnOnce() -> T) -> Result<Part<T>, StreamError> {
        while !std::mem::take(&mut self.at_part) {
            let text = line(&mut self.stream)?;
            let bare = text.trim_start_matches('-').as_bytes();
            if text.starts_with("--") && bare == self.boundary {
                break;
            }
            // "--boundary--" ends the stream.
            if text.starts_with("--") && bare.strip_suffix(b"--") == Some(&self.boundary) {
                return Err(StreamError::Ended);
            }
        }
        let (mut length, mut timestamp) = (None, None);
        for (name, value) in headers(&mut self.stream)? {
            match name.as_str() {
                "content-length" => length = value.parse::<usize>().ok(),
                "x-timestamp" => timestamp = value.parse::<f64>().ok().filter(|t| t.is_finite()),
                _ => {}
            }
        }
        let arrival = now();
        let body = match length {
            Some(length) if length > MAX_BODY => return Err(StreamError::TooLong("picture")),
            Some(length) => {
                let mut body = Vec::new();
                let read = (&mut self.stream).take(length as u64).read_to_end(&mut body)?;
                if read < length {
                    return Err(StreamError::Ended);
                }
                body
            }
            None => self.until_boundary()?,
        };
        Ok(Part { body, arrival, timestamp })
    }

    /// A body without length: everything up to the line that is the boundary.
    fn until_boundary(&mut self) -> Result<Vec<u8>, StreamError> {
        let mut body = Vec::new();
        loop {
            let start = body.len();
            let limit = (MAX_BODY - start.min(MAX_BODY)) as u64 + 1;
            if (&mut self.stream).take(limit).read_until(b'\n', &mut body)? == 0 {
                return Err(StreamError::Ended);
            }
            if body.len() > MAX_BODY {
                return Err(StreamError::TooLong("picture"));
            }
            // JPEG data hold line feeds, too; only a whole line that is the boundary counts.
            let text = body[start..].trim_ascii_end();
            let dashes = text.iter().take_while(|b| **b == b'-').count();
            if dashes >= 2 && text[dashes..] == self.boundary {
                body.truncate(start);
                while body.last().is_some_and(|b| matches!(b, b'\r' | b'\n')) {
                    body.pop();
                }
                self.at_part = true;
                return Ok(body);
            }
        }
    }
}

/// A line of text without its end.
fn line(stream: &mut impl BufRead) -> Result<String, StreamError> {
    let mut bytes = Vec::new();
    let count = stream.take(MAX_LINE as u64 + 1).read_until(b'\n', &mut bytes)?;
    match count {
        0 => Err(StreamError::Ended),
        n if n > MAX_LINE => Err(StreamError::TooLong("header line")),
        _ => Ok(String::from_utf8_lossy(bytes.trim_ascii_end()).into_owned()),
    }
}

/// Header lines up to the empty one: names in lower case.
fn headers(stream: &mut impl BufRead) -> Result<Vec<(String, String)>, StreamError> {
    let mut out = Vec::new();
    for _ in 0..MAX_LINES {
        let text = line(stream)?;
        if text.is_empty() {
            return Ok(out);
        }
        if let Some((name, value)) = text.split_once(':') {
            out.push((name.trim().to_ascii_lowercase(), value.trim().to_owned()));
        }
    }
    Err(StreamError::TooLong("header"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    type Picture = (Vec<u8>, Option<f64>);

    fn bodies(stream: &[u8]) -> (Vec<Picture>, StreamError) {
        let mut out = Vec::new();
        let mut parts = match Parts::open(stream) {
            Ok(parts) => parts,
            Err(e) => return (out, e),
        };
        loop {
            match parts.next_part(|| ()) {
                Ok(part) => out.push((part.body, part.timestamp)),
                Err(e) => return (out, e),
            }
        }
    }

    #[test]
    fn servers_of_all_manners_are_understood() {
        let with_length = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=b\r\n\r\n\
            --b\r\nContent-Length: 5\r\nX-Timestamp: 12.5\r\n\r\n\xFF\n--b\r\n--b\r\ncontent-length: 1\r\n\r\nz";
        let (parts, end) = bodies(with_length);
        assert_eq!(parts, [(b"\xFF\n--b".to_vec(), Some(12.5)), (b"z".to_vec(), None)]);
        assert!(matches!(end, StreamError::Ended));
        let without =
            b"HTTP/1.1 200 OK\nContent-type: multipart/x-mixed-replace; boundary=\"--b\"\n\n\
            junk\n--b\nContent-Type: image/jpeg\n\n\xFF\n-b\n\xD9\r\n--b\n\nsecond\n--b--\n";
        let (parts, end) = bodies(without);
        assert_eq!(parts, [(b"\xFF\n-b\n\xD9".to_vec(), None)]);
        assert!(matches!(end, StreamError::Ended), "{end}");
    }

    #[test]
    fn what_is_no_stream_is_told() {
        assert!(
            matches!(bodies(b"HTTP/1.0 404 Not Found\r\n\r\n").1, StreamError::Status(s) if s.contains("404"))
        );
        let page = b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n<html>";
        assert!(matches!(bodies(page).1, StreamError::ContentType(t) if t == "text/html"));
        let huge = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=b\r\n\r\n\
            --b\r\nContent-Length: 99999999999\r\n\r\n";
        assert!(matches!(bodies(huge).1, StreamError::TooLong("picture")));
    }

    proptest! {
        #[test]
        fn rubbish_ends(noise in prop::collection::vec(any::<u8>(), 0..300)) {
            let mut stream = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=b\r\n\r\n--b\r\n".to_vec();
            stream.extend(noise);
            bodies(&stream);
        }
    }
}
