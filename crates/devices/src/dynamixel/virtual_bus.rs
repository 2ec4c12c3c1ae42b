//! An emulated servo bus: servos of both protocols on one wire that can also go wrong.
//!
//! Runs on a pseudo-terminal, which any Dynamixel program opens like a serial port, or on a
//! [`Pipe`](super::transport::Pipe) in memory. It answers what real servos answer to ping, read,
//! write, sync read and write, prepared writes and reboot, after the time that the bytes need on the
//! wire and the servo's return delay. [`Trouble`] adds noise, torn and damaged packets, and latency.
//!
//! Not emulated: baud rates per servo (a pseudo-terminal has none), bulk and indirect access, current
//! and velocity modes.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::packet::{Decoder, Frame, Protocol, instruction};
use super::transport::Transport;
use super::virtual_servo::VirtualServo;

/// What goes wrong on the wire; nothing by default.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trouble {
    /// Chance that an answer is preceded by random bytes.
    pub noise: f64,
    /// Chance that an answer loses its end.
    pub cut: f64,
    /// Chance that an answer has a wrong bit.
    pub damage: f64,
    /// Extra delay of every answer, as a USB adapter has.
    pub latency: Duration,
    /// Bits per second, for the time on the wire; `None` for an infinitely fast wire.
    pub baud: Option<u32>,
    /// Seed of the chances.
    pub seed: u64,
}

impl Default for Trouble {
    fn default() -> Self {
        Trouble {
            noise: 0.0,
            cut: 0.0,
            damage: 0.0,
            latency: Duration::ZERO,
            baud: Some(1_000_000),
            seed: 0,
        }
    }
}

/// A running bus; stops when dropped.
pub struct VirtualBus {
    servos: Arc<Mutex<Vec<VirtualServo>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl VirtualBus {
    /// Serves a transport until dropped or until the other end is gone.
    pub fn serve(
        servos: Vec<VirtualServo>,
        trouble: Trouble,
        mut transport: impl Transport + 'static,
    ) -> Self {
        let servos = Arc::new(Mutex::new(servos));
        let stop = Arc::new(AtomicBool::new(false));
        let mut device = Device {
            servos: servos.clone(),
            trouble,
            random: Pcg64Mcg::seed_from_u64(trouble.seed),
        };
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            let mut decoder = Decoder::default();
            let mut buffer = [0u8; 512];
            while !stopped.load(Ordering::Relaxed) {
                match transport.receive(&mut buffer, Duration::from_millis(20)) {
                    Ok(0) => decoder.clear(),
                    Ok(count) => decoder.push(&buffer[..count]),
                    Err(_) => break,
                }
                while let Some(frame) = decoder.next_frame() {
                    for answer in device.answers(&frame) {
                        if transport.send(&answer).is_err() {
                            return;
                        }
                    }
                }
            }
        });
        VirtualBus { servos, stop, thread: Some(thread) }
    }

    /// Serves a new pseudo-terminal; the path is what a master opens as its serial port.
    #[cfg(target_os = "linux")]
    pub fn on_pty(servos: Vec<VirtualServo>, trouble: Trouble) -> std::io::Result<(Self, PathBuf)> {
        use std::os::fd::AsRawFd;
        let (ours, theirs) = serial2::SerialPort::pair()?;
        for mut port in [ours.try_clone()?, theirs.try_clone()?] {
            let mut settings = port.get_configuration()?;
            settings.set_raw();
            port.set_configuration(&settings)?;
        }
        let path = std::fs::read_link(format!("/proc/self/fd/{}", theirs.as_raw_fd()))?;
        // Holding their end open keeps ours alive while masters come and go.
        let bus = Self::serve(servos, trouble, Pty { ours, _theirs: theirs });
        Ok((bus, path))
    }

    /// The servos, to look at or to harm.
    pub fn servos(&self) -> MutexGuard<'_, Vec<VirtualServo>> {
        self.servos.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for VirtualBus {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic there has been reported already.
            let _ = thread.join();
        }
    }
}

struct Pty {
    ours: serial2::SerialPort,
    _theirs: serial2::SerialPort,
}

impl Transport for Pty {
    fn send(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.ours.send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], timeout: Duration) -> std::io::Result<usize> {
        self.ours.receive(buffer, timeout)
    }

    fn discard(&mut self) -> std::io::Result<()> {
        self.ours.discard()
    }
}

struct Device {
    servos: Arc<Mutex<Vec<VirtualServo>>>,
    trouble: Trouble,
    random: Pcg64Mcg,
}

impl Device {
    /// Obeys one packet and gives the answers as they go over the wire, having waited their time.
    fn answers(&mut self, frame: &Frame) -> Vec<Vec<u8>> {
        let servos = self.servos.clone();
        let mut servos = servos.lock().unwrap_or_else(PoisonError::into_inner);
        let [code, parameters @ ..] = frame.body.as_slice() else { return Vec::new() };
        let mut out = Vec::new();
        let mut delay_us = 0;
        let mut reply = |servo: &VirtualServo, refused, data: &[u8]| {
            let error = servo.error_byte(refused);
            delay_us += servo.return_delay_us();
            out.push(Frame::answer(frame.protocol, servo.id, error, data).encode());
        };
        let mine = |s: &VirtualServo| !s.missing && s.model.protocol == frame.protocol;
        match *code {
            instruction::SYNC_WRITE => sync_write(&mut servos, frame.protocol, parameters),
            instruction::SYNC_READ => {
                let [a, b, c, d, ids @ ..] = parameters else { return Vec::new() };
                let (address, size) = (u16::from_le_bytes([*a, *b]), u16::from_le_bytes([*c, *d]));
                for id in ids {
                    // Each waits for the answer of the one before; a missing one silences the rest.
                    let found = servos.iter_mut().find(|s| s.id == *id && mine(s));
                    let Some(servo) = found else { break };
                    match servo.read(address, size) {
                        Ok(data) => reply(servo, None, &data),
                        Err(refused) => reply(servo, Some(refused), &[]),
                    }
                }
            }
            code => {
                let broadcast = frame.id == instruction::BROADCAST;
                for servo in servos.iter_mut().filter(|s| mine(s)) {
                    if servo.id != frame.id && !broadcast {
                        continue;
                    }
                    let result = obey(servo, frame.protocol, code, parameters);
                    let heard = match code {
                        instruction::PING => true,
                        instruction::READ => !broadcast,
                        _ => !broadcast && servo.confirms(),
                    };
                    if heard {
                        match result {
                            Ok(data) => reply(servo, None, &data),
                            Err(refused) => reply(servo, Some(refused), &[]),
                        }
                    }
                }
            }
        }
        drop(servos);
        let bytes = frame.encode().len() + out.iter().map(Vec::len).sum::<usize>();
        let wire = self.trouble.baud.map_or(0.0, |baud| 10.0 * bytes as f64 / f64::from(baud));
        let late = self.trouble.latency + Duration::from_micros(delay_us);
        if !out.is_empty() {
            std::thread::sleep(Duration::from_secs_f64(wire) + late);
        }
        out.into_iter().map(|answer| self.spoil(answer)).collect()
    }

    fn spoil(&mut self, mut answer: Vec<u8>) -> Vec<u8> {
        let Trouble { noise, cut, damage, .. } = self.trouble;
        if self.random.random_bool(damage) {
            let at = self.random.random_range(0..answer.len());
            answer[at] ^= 1 << self.random.random_range(0..8);
        }
        if self.random.random_bool(cut) {
            answer.truncate(self.random.random_range(0..answer.len()));
        }
        if self.random.random_bool(noise) {
            let length = self.random.random_range(1..8);
            let mut noisy: Vec<u8> = (0..length).map(|_| self.random.random()).collect();
            noisy.append(&mut answer);
            return noisy;
        }
        answer
    }
}

/// Numbers of an address and what follows it.
fn addressed(protocol: Protocol, parameters: &[u8]) -> Option<(u16, &[u8])> {
    match (protocol, parameters) {
        (Protocol::One, [address, rest @ ..]) => Some((u16::from(*address), rest)),
        (Protocol::Two, [low, high, rest @ ..]) => Some((u16::from_le_bytes([*low, *high]), rest)),
        _ => None,
    }
}

fn obey(
    servo: &mut VirtualServo,
    protocol: Protocol,
    code: u8,
    parameters: &[u8],
) -> Result<Vec<u8>, (u8, u8)> {
    const UNKNOWN: (u8, u8) = (2, 0x40);
    const LENGTH: (u8, u8) = (5, 0x40);
    match code {
        instruction::PING if protocol == Protocol::One => Ok(Vec::new()),
        instruction::PING => {
            let mut data = servo.model.number.to_le_bytes().to_vec();
            // Firmware version.
            data.push(45);
            Ok(data)
        }
        instruction::READ => {
            let (address, rest) = addressed(protocol, parameters).ok_or(LENGTH)?;
            let size = match rest {
                [size] => u16::from(*size),
                [low, high] => u16::from_le_bytes([*low, *high]),
                _ => return Err(LENGTH),
            };
            servo.read(address, size)
        }
        instruction::WRITE => {
            let (address, data) = addressed(protocol, parameters).ok_or(LENGTH)?;
            servo.write(address, data).map(|()| Vec::new())
        }
        instruction::REG_WRITE => {
            let (address, data) = addressed(protocol, parameters).ok_or(LENGTH)?;
            servo.prepare(address, data);
            Ok(Vec::new())
        }
        instruction::ACTION => {
            servo.action();
            Ok(Vec::new())
        }
        instruction::REBOOT if protocol == Protocol::Two => {
            servo.reboot();
            Ok(Vec::new())
        }
        _ => Err(UNKNOWN),
    }
}

fn sync_write(servos: &mut [VirtualServo], protocol: Protocol, parameters: &[u8]) {
    let Some((address, rest)) = addressed(protocol, parameters) else { return };
    let (size, items) = match (protocol, rest) {
        (Protocol::One, [size, items @ ..]) => (usize::from(*size), items),
        (Protocol::Two, [low, high, items @ ..]) => {
            (usize::from(u16::from_le_bytes([*low, *high])), items)
        }
        _ => return,
    };
    for item in items.chunks_exact(size + 1) {
        let target =
            |s: &&mut VirtualServo| s.id == item[0] && s.model.protocol == protocol && !s.missing;
        if let Some(servo) = servos.iter_mut().find(target) {
            // Nobody hears a refusal of a sync write.
            let _ = servo.write(address, &item[1..]);
        }
    }
}
