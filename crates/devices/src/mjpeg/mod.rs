//! The driver `mjpeg`: cameras that stream JPEG pictures over HTTP (`multipart/x-mixed-replace`), as
//! network cameras, mjpg-streamer and single-board computers do.
//!
//! A thread reads the stream as fast as it comes, so that pictures never queue up in the network, and
//! keeps the newest few; the rest are seen as gaps in [`Frame::sequence`]. It reconnects when the
//! stream ends, breaks or falls silent. Pictures are stamped with the `X-Timestamp` header of their
//! part when there is one: the camera's clock is brought to ours by the smallest delay seen lately, and
//! pictures that the camera or the network lost are counted by it. Else the arrival of the part's
//! header is the stamp, late by the transport. Stamps always grow, also when the camera's clock is set.
//! A picture that is the one before, byte for byte, comes from a camera that froze, and is not taken. One
//! that cannot be decoded is skipped, and told of when no other comes in time.
//!
//! Exposure is not told by such cameras; the configuration may.
//!
//! [`MjpegServer`] is the other side: it offers pictures as such cameras do.

mod multipart;
mod server;
mod timing;

use std::collections::VecDeque;
use std::io::{BufReader, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde::Deserialize;
use vergence_imaging::codec::{self, CodecError};
use vergence_imaging::{Frame, Image};

use crate::traits::{Camera, Clock, DeviceError};
use multipart::{Part, StreamError};
pub use server::MjpegServer;
use timing::Timing;

/// A stream that says nothing for so long is dead.
const SILENCE: Duration = Duration::from_secs(2);
/// Longest wait for a connection, the look-up of the host's name included.
const CONNECT: Duration = Duration::from_secs(2);
/// Wait between attempts to connect.
const RETRY: Duration = Duration::from_millis(200);
/// Pictures kept for a reader that is busy for a moment: half a second at 30 a second.
const KEPT: usize = 16;
/// Equal pictures after which the camera counts as frozen: a sensor's noise never repeats.
const FROZEN: usize = 5;

/// Settings of one such camera.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MjpegConfig {
    /// Address, `http://host[:port]/path`.
    pub url: String,
    /// Exposure time (s), when known.
    #[serde(default)]
    pub exposure: f64,
    /// Time (s) from the start of an exposure until the first bytes of its picture arrive, at the least.
    /// Pictures whose exposure began before a head came to rest are thrown away by their stamp: too much
    /// costs a picture after each move, too little lets in one of the move, which shows the light
    /// elsewhere.
    #[serde(default = "default_latency")]
    pub latency: f64,
}

/// A picture interval and a little: cameras expose, read out, compress and send in turn.
fn default_latency() -> f64 {
    0.05
}

/// A camera behind HTTP.
pub struct MjpegCamera {
    url: String,
    size: (usize, usize),
    exposure: Duration,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    news: Condvar,
}

#[derive(Default)]
struct State {
    pictures: VecDeque<Picture>,
    /// To end a read that blocks.
    stream: Option<TcpStream>,
    /// Why there is no connection now.
    trouble: Option<String>,
    stop: bool,
}

struct Picture {
    jpeg: Vec<u8>,
    stamp: Duration,
    sequence: u64,
}

impl MjpegCamera {
    /// Connects to a camera that delivers pictures of this size, or fails when it does not answer.
    pub fn open(
        config: &MjpegConfig,
        size: (usize, usize),
        clock: Arc<dyn Clock>,
    ) -> Result<Self, DeviceError> {
        let unsupported =
            |what: String| DeviceError::Unsupported { device: config.url.clone(), what };
        let target = Target::parse(&config.url)
            .ok_or_else(|| unsupported("the address is not http://host[:port]/path".into()))?;
        for (name, seconds) in [("exposure", config.exposure), ("latency", config.latency)] {
            if !(0.0..10.0).contains(&seconds) {
                return Err(unsupported(format!("{name} {seconds} s is not between 0 and 10 s")));
            }
        }
        let shared = Arc::new(Shared::default());
        let first = target.connect(&shared).map_err(|e| DeviceError::Disconnected {
            device: config.url.clone(),
            reason: e.to_string(),
        })?;
        let reader = Reader {
            target,
            shared: shared.clone(),
            clock,
            timing: Timing::default(),
            latency: Duration::from_secs_f64(config.latency),
            last: Vec::new(),
            repeats: 0,
        };
        let thread = std::thread::spawn(move || reader.run(first));
        Ok(MjpegCamera {
            url: config.url.clone(),
            size,
            exposure: Duration::from_secs_f64(config.exposure),
            shared,
            thread: Some(thread),
        })
    }
}

impl Camera for MjpegCamera {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let device = self.url.clone();
        let deadline = Instant::now() + timeout;
        let mut damage = None;
        let mut state = self.shared.lock();
        loop {
            if let Some(picture) = state.pictures.pop_front() {
                drop(state);
                match self.grey(&picture.jpeg)? {
                    Ok(image) => {
                        return Ok(Frame {
                            image,
                            stamp: picture.stamp,
                            exposure: self.exposure,
                            row_time: None,
                            sequence: picture.sequence,
                        });
                    }
                    // One that the network spoilt is made up for by the next.
                    Err(what) => damage = Some(what),
                }
                state = self.shared.lock();
                continue;
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(match (damage, state.trouble.clone()) {
                    (Some(what), _) => {
                        let fault = format!("nothing readable within {timeout:?}, last: {what}");
                        DeviceError::Fault { device, fault }
                    }
                    (None, Some(reason)) => DeviceError::Disconnected { device, reason },
                    (None, None) => DeviceError::Timeout { device, timeout },
                });
            }
            let waited = self.shared.news.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl MjpegCamera {
    /// Decodes a picture, or says what is wrong with this one; fails when the camera delivers another size.
    /// The header is asked first, as a picture that nobody wants may be a large one.
    fn grey(&self, jpeg: &[u8]) -> Result<Result<Image<u8>, CodecError>, DeviceError> {
        let (width, height) = match codec::size(jpeg) {
            Ok(size) => size,
            Err(damage) => return Ok(Err(damage)),
        };
        if (width, height) == self.size {
            return Ok(codec::decode(jpeg));
        }
        let (columns, rows) = self.size;
        Err(DeviceError::Unsupported {
            device: self.url.clone(),
            what: format!("pictures are {width}x{height}, the configuration says {columns}x{rows}"),
        })
    }
}

impl Drop for MjpegCamera {
    fn drop(&mut self) {
        let mut state = self.shared.lock();
        state.stop = true;
        if let Some(stream) = state.stream.take() {
            // It may have ended by itself.
            let _ = stream.shutdown(Shutdown::Both);
        }
        drop(state);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Host and path of an address.
struct Target {
    host: String,
    path: String,
}

impl Target {
    fn parse(url: &str) -> Option<Target> {
        let rest = url.strip_prefix("http://")?;
        let (host, path) = rest.split_once('/').unwrap_or((rest, ""));
        let clean = |s: &str| !s.chars().any(|c| c.is_control() || c == ' ');
        if host.is_empty() || !clean(host) || !clean(path) {
            return None;
        }
        let host = if host.contains(':') { host.into() } else { format!("{host}:80") };
        Some(Target { host, path: format!("/{path}") })
    }

    /// Connects and asks; the answer is still to be read. HTTP 1.0, so that nothing comes in chunks.
    fn connect(&self, shared: &Shared) -> std::io::Result<TcpStream> {
        let mut stream = vergence_dial::connect(&self.host, CONNECT)?;
        stream.set_read_timeout(Some(SILENCE))?;
        stream.set_write_timeout(Some(CONNECT))?;
        let request = format!("GET {} HTTP/1.0\r\nHost: {}\r\n\r\n", self.path, self.host);
        stream.write_all(request.as_bytes())?;
        shared.lock().stream = Some(stream.try_clone()?);
        Ok(stream)
    }
}

/// The thread's side.
struct Reader {
    target: Target,
    shared: Arc<Shared>,
    clock: Arc<dyn Clock>,
    timing: Timing,
    latency: Duration,
    /// The picture before, and how often it came again.
    last: Vec<u8>,
    repeats: usize,
}

impl Reader {
    fn run(mut self, first: TcpStream) {
        let mut stream = Some(first);
        while !self.shared.lock().stop {
            let trouble = match stream.take() {
                Some(stream) => self.read(stream).to_string(),
                None => match self.target.connect(&self.shared) {
                    Ok(fresh) => {
                        stream = Some(fresh);
                        continue;
                    }
                    Err(e) => e.to_string(),
                },
            };
            let mut state = self.shared.lock();
            if state.stop {
                break;
            }
            state.trouble = Some(trouble);
            drop(state);
            std::thread::sleep(RETRY);
        }
    }

    /// Reads pictures until the stream fails; gives the reason.
    fn read(&mut self, stream: TcpStream) -> StreamError {
        // Another connection may be another run of the camera, with another clock.
        self.timing.forget_clock();
        let mut parts = match multipart::Parts::open(BufReader::new(stream)) {
            Ok(parts) => parts,
            Err(e) => return e,
        };
        loop {
            let clock = self.clock.clone();
            match parts.next_part(|| clock.now()) {
                Ok(part) => self.deliver(part),
                Err(e) => return e,
            }
            if self.shared.lock().stop {
                return StreamError::Ended;
            }
        }
    }

    fn deliver(&mut self, part: Part<Duration>) {
        if part.body == self.last {
            self.repeats += 1;
            if self.repeats >= FROZEN {
                let trouble = format!("the same picture came {} times: it froze", self.repeats + 1);
                self.shared.lock().trouble = Some(trouble);
            }
            return;
        }
        self.repeats = 0;
        let (stamp, sequence) =
            self.timing.place(part.arrival.saturating_sub(self.latency), part.timestamp);
        self.last.clone_from(&part.body);
        let picture = Picture { jpeg: part.body, stamp, sequence };
        let mut state = self.shared.lock();
        state.trouble = None;
        state.pictures.push_back(picture);
        if state.pictures.len() > KEPT {
            state.pictures.pop_front();
        }
        self.shared.news.notify_all();
    }
}

#[cfg(test)]
mod tests;
