//! What carries the bytes: a serial port, a pseudo-terminal, or a pair of pipes in memory.

use std::io;
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use serial2::SerialPort;

/// A byte stream to servos, half duplex.
pub trait Transport: Send {
    /// Sends all bytes.
    fn send(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Receives what is there, waiting at most `timeout` for the first byte; 0 when none came. An
    /// error means that the other end is gone.
    fn receive(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize>;
    /// Throws away what has arrived and was not received yet.
    fn discard(&mut self) -> io::Result<()>;
}

impl Transport for SerialPort {
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.set_write_timeout(Duration::from_millis(200))?;
        self.write_all(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        // The port counts milliseconds; zero would not wait at all.
        self.set_read_timeout(timeout.max(Duration::from_millis(1)))?;
        match self.read(buffer) {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            Err(e) if e.kind() == io::ErrorKind::TimedOut => Ok(0),
            Err(e) if e.kind() == io::ErrorKind::Interrupted => Ok(0),
            other => other,
        }
    }

    fn discard(&mut self) -> io::Result<()> {
        self.discard_input_buffer()
    }
}

/// Opens a serial device, 8 bits, no parity.
pub fn open_port(path: &Path, baud: u32) -> io::Result<SerialPort> {
    SerialPort::open(path, |mut settings: serial2::Settings| {
        settings.set_raw();
        settings.set_baud_rate(baud)?;
        Ok(settings)
    })
}

/// One end of a stream in memory.
pub struct Pipe {
    out: Sender<Vec<u8>>,
    inbox: Receiver<Vec<u8>>,
    rest: Vec<u8>,
}

/// Two connected ends.
pub fn pipe() -> (Pipe, Pipe) {
    let ((a, from_a), (b, from_b)) = (channel(), channel());
    let end = |out, inbox| Pipe { out, inbox, rest: Vec::new() };
    (end(a, from_b), end(b, from_a))
}

impl Transport for Pipe {
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.out.send(bytes.to_vec()).map_err(|_| io::ErrorKind::BrokenPipe.into())
    }

    fn receive(&mut self, buffer: &mut [u8], timeout: Duration) -> io::Result<usize> {
        if self.rest.is_empty() {
            match self.inbox.recv_timeout(timeout) {
                Ok(bytes) => self.rest = bytes,
                Err(RecvTimeoutError::Timeout) => return Ok(0),
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(io::ErrorKind::BrokenPipe.into());
                }
            }
        }
        let count = self.rest.len().min(buffer.len());
        buffer[..count].copy_from_slice(&self.rest[..count]);
        self.rest.drain(..count);
        Ok(count)
    }

    fn discard(&mut self) -> io::Result<()> {
        self.rest.clear();
        while self.inbox.try_recv().is_ok() {}
        Ok(())
    }
}
