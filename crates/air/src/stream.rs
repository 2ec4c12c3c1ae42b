//! HCI over byte streams (H4: an indicator byte, then the packet): both ends of a TCP connection or
//! a serial line.
//!
//! Reading blocks, so a thread of its own reads packets into a queue that the executor waits on;
//! writing happens where it is called, as packets are short.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::fs::File;
use std::future::poll_fn;
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Poll, Waker};
use std::time::{Duration, Instant};

use bt_hci_transport::{PacketToController, PacketToHost, Transport};
use serial2::{FlowControl, SerialPort};

use crate::controller::{TransportError, parse, serialise};
use crate::hci::kind;
use crate::medium::Air;
use crate::user_channel;

/// Longest wait for a peer on TCP, to answer or to take a packet: both ends write on the thread that runs
/// everything else.
const PATIENCE: Duration = Duration::from_secs(3);

/// Packets are short and answered at once; a peer that takes none is not waited for.
fn prompt(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(PATIENCE))
}

/// Writes a packet. A peer that takes it in crumbs, each in time, is not waited for either.
fn send(writer: &mut impl Write, mut packet: &[u8]) -> io::Result<()> {
    let start = Instant::now();
    while !packet.is_empty() && start.elapsed() < PATIENCE {
        match writer.write(packet) {
            Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
            Ok(count) => packet = &packet[count..],
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    if packet.is_empty() { Ok(()) } else { Err(io::ErrorKind::TimedOut.into()) }
}

/// Reads one packet with its indicator; `None` at the end of the stream.
fn read_packet(reader: &mut impl Read) -> io::Result<Option<Vec<u8>>> {
    let mut packet = vec![0; 1];
    if let Err(error) = reader.read_exact(&mut packet) {
        return if error.kind() == io::ErrorKind::UnexpectedEof { Ok(None) } else { Err(error) };
    }
    // Bytes of the header, and where in it the length stands.
    let (header, wide) = match packet[0] {
        kind::COMMAND => (3, false),
        kind::EVENT => (2, false),
        kind::ACL | 5 => (4, true),
        3 => (3, false),
        other => {
            let what = format!("{other:#04x} begins no HCI packet");
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
    };
    packet.resize(1 + header, 0);
    reader.read_exact(&mut packet[1..])?;
    let length = match wide {
        // The upper two bits of an isochronous packet's length are reserved.
        true => usize::from(u16::from_le_bytes([packet[header - 1], packet[header]]) & 0x3FFF),
        false => usize::from(packet[header]),
    };
    packet.resize(1 + header + length, 0);
    reader.read_exact(&mut packet[1 + header..])?;
    Ok(Some(packet))
}

/// Things that another thread sends to a task.
struct Mailbox<T>(Mutex<Mail<T>>);

struct Mail<T> {
    items: VecDeque<T>,
    waker: Option<Waker>,
    closed: bool,
}

impl<T> Mailbox<T> {
    fn new() -> Arc<Self> {
        let mail = Mail { items: VecDeque::new(), waker: None, closed: false };
        Arc::new(Mailbox(Mutex::new(mail)))
    }

    /// Sends one, or (`None`) says that there will be no more.
    fn send(&self, item: Option<T>) {
        let mut mail = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match item {
            Some(item) => mail.items.push_back(item),
            None => mail.closed = true,
        }
        if let Some(waker) = mail.waker.take() {
            waker.wake();
        }
    }

    async fn next(&self) -> Option<T> {
        poll_fn(|cx| {
            let mut mail = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            match mail.items.pop_front() {
                Some(item) => Poll::Ready(Some(item)),
                None if mail.closed => Poll::Ready(None),
                None => {
                    mail.waker = Some(cx.waker().clone());
                    Poll::Pending
                }
            }
        })
        .await
    }
}

/// A thread that reads packets until the stream ends.
fn packets(mut reader: impl Read + Send + 'static) -> Arc<Mailbox<Vec<u8>>> {
    let mailbox = Mailbox::new();
    let sender = mailbox.clone();
    std::thread::spawn(move || {
        while let Ok(Some(packet)) = read_packet(&mut reader) {
            sender.send(Some(packet));
        }
        sender.send(None);
    });
    mailbox
}

/// A controller at the other end of a stream, as its host sees it.
pub struct StreamTransport<W> {
    incoming: Arc<Mailbox<Vec<u8>>>,
    writer: RefCell<W>,
    socket: Option<TcpStream>,
}

impl<W> Drop for StreamTransport<W> {
    fn drop(&mut self) {
        // The reading thread holds the socket open, and waits in it, until somebody shuts it.
        if let Some(socket) = &self.socket {
            let _ = socket.shutdown(Shutdown::Both);
        }
    }
}

impl StreamTransport<TcpStream> {
    /// Connects to a controller that speaks H4 over TCP at `host:port`. One whose name is not found, that
    /// does not answer, or that later takes no packet is given up after [`PATIENCE`].
    pub fn connect(address: &str) -> io::Result<Self> {
        let stream = vergence_dial::connect(address, PATIENCE)?;
        prompt(&stream)?;
        let socket = Some(stream.try_clone()?);
        let mut transport = StreamTransport::new(stream.try_clone()?, stream);
        transport.socket = socket;
        Ok(transport)
    }
}

impl StreamTransport<File> {
    /// Takes over a Bluetooth controller of this computer (0 is `hci0`). It must be powered off and
    /// left alone by bluetoothd; the caller needs CAP_NET_ADMIN.
    pub fn user_channel(controller: u16) -> io::Result<Self> {
        let (reader, writer) = user_channel::open(controller)?;
        Ok(StreamTransport::new(reader, writer))
    }
}

impl StreamTransport<SerialPort> {
    /// A controller on a serial line (8 bits, no parity) with H4 at this speed (baud). Hardware flow
    /// control is on, as the H4 transport layer demands.
    pub fn serial(path: &Path, baud: u32) -> io::Result<Self> {
        let port = SerialPort::open(path, |mut settings: serial2::Settings| {
            settings.set_raw();
            settings.set_flow_control(FlowControl::RtsCts);
            settings.set_baud_rate(baud)?;
            Ok(settings)
        })?;
        Ok(StreamTransport::new(Patient(port.try_clone()?), port))
    }
}

/// A serial line that is quiet for long without being at its end.
struct Patient(SerialPort);

impl Read for Patient {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            match self.0.read(buffer) {
                Err(error) if error.kind() == io::ErrorKind::TimedOut => {}
                other => return other,
            }
        }
    }
}

impl<W: Write> StreamTransport<W> {
    /// Over the two directions of a stream.
    pub fn new(reader: impl Read + Send + 'static, writer: W) -> Self {
        StreamTransport { incoming: packets(reader), writer: RefCell::new(writer), socket: None }
    }
}

impl<W> embedded_io::ErrorType for StreamTransport<W> {
    type Error = TransportError;
}

impl<W: Write> Transport for StreamTransport<W> {
    async fn read<'a, P: PacketToHost<'a>>(&self, rx: &'a mut [u8]) -> Result<P, TransportError> {
        let packet = self.incoming.next().await.ok_or(TransportError::CLOSED)?;
        parse(&packet, rx)
    }

    async fn write<P: PacketToController>(&self, packet: &P) -> Result<(), TransportError> {
        let bytes = serialise(packet);
        send(&mut *self.writer.borrow_mut(), &bytes).map_err(|_| TransportError::CLOSED)
    }
}

/// Offers virtual controllers of an air on TCP: every connection gets a new one, with an address
/// that counts up. Spawn it on the executor that runs the air.
pub async fn serve(air: Air, listener: TcpListener) {
    let connections = Mailbox::new();
    let sender = connections.clone();
    std::thread::spawn(move || {
        for stream in listener.incoming().map_while(Result::ok) {
            sender.send(Some(stream));
        }
        sender.send(None);
    });
    let mut guests = Vec::new();
    let mut count = 0u8;
    loop {
        // All guests are polled whenever one of them has something to say: they are few.
        let stream = poll_fn(|cx| {
            guests.retain_mut(|guest: &mut std::pin::Pin<Box<dyn Future<Output = ()>>>| {
                guest.as_mut().poll(cx).is_pending()
            });
            std::pin::pin!(connections.next()).poll(cx)
        })
        .await;
        let Some(stream) = stream else { return };
        count = count.wrapping_add(1);
        guests.push(Box::pin(guest(air.clone(), stream, count)));
    }
}

/// One foreign host on its own controller, until it hangs up.
async fn guest(air: Air, stream: TcpStream, number: u8) {
    let Ok(reader) = stream.try_clone() else { return };
    if prompt(&stream).is_err() {
        return;
    }
    let mut writer = stream;
    let controller = air.controller([0x00, 0x56, 0x45, 0x52, 0x47, number]);
    let incoming = packets(reader);
    loop {
        let next = poll_fn(|cx| {
            if let Poll::Ready(packet) = std::pin::pin!(incoming.next()).poll(cx) {
                return Poll::Ready(Err(packet));
            }
            std::pin::pin!(controller.next_for_host()).poll(cx).map(Ok)
        });
        match next.await {
            Ok(packet) => {
                if send(&mut writer, &packet).is_err() {
                    break;
                }
            }
            Err(Some(packet)) => controller.host_sends(&packet),
            Err(None) => break,
        }
    }
    air.power_off(controller.id());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_that_does_not_answer_is_given_up() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let silent = StreamTransport::connect(&address.to_string()).unwrap();
        // More than all buffers on the way hold.
        let given_up = (0..1 << 17).any(|_| {
            let start = Instant::now();
            let sent = send(&mut *silent.writer.borrow_mut(), &[0; 1000]);
            let waited = start.elapsed();
            assert!(waited < 3 * PATIENCE, "{waited:?}");
            sent.is_err()
        });
        assert!(given_up);

        // When nobody accepts, the system at last leaves further callers without an answer.
        let brief = Duration::from_millis(200);
        let mut callers = Vec::new();
        while let Ok(caller) = TcpStream::connect_timeout(&address, brief) {
            callers.push(caller);
        }
        let start = Instant::now();
        assert!(StreamTransport::connect(&address.to_string()).is_err());
        let waited = start.elapsed();
        assert!(waited < 2 * PATIENCE, "{waited:?} after {} callers", callers.len());
    }

    #[test]
    fn packets_are_cut_where_they_end() {
        let bytes = [4, 0x0E, 2, 7, 8, 2, 1, 0x20, 3, 0, 9, 9, 9, 1, 3, 0x0C, 0];
        let mut reader = &bytes[..];
        let mut next = || read_packet(&mut reader).unwrap().unwrap();
        assert_eq!(next(), [4, 0x0E, 2, 7, 8]);
        assert_eq!(next(), [2, 1, 0x20, 3, 0, 9, 9, 9]);
        assert_eq!(next(), [1, 3, 0x0C, 0]);
        assert!(read_packet(&mut reader).unwrap().is_none());
        assert!(read_packet(&mut &[9u8][..]).is_err());
        assert!(read_packet(&mut &[4u8, 1][..]).is_err());
    }
}
