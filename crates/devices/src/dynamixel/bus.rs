//! The master's side of the bus: one instruction, one bounded wait, one checked answer.
//!
//! Every exchange throws away what lies in the input, sends, and reads packets until the wanted
//! servo has answered or the time is over: noise before an answer is skipped, damaged and torn
//! answers are asked for again, [`BusConfig::attempts`] times. A packet of another servo, or the echo
//! of our own, is not taken for an answer: adapters on the one wire of a half-duplex bus hear themselves,
//! and in protocol 1.0 an instruction looks like an answer with an error.

use std::io;
use std::time::{Duration, Instant};

use super::model::Register;
use super::packet::{Decoder, Frame, Protocol, instruction};
use super::transport::Transport;

/// Times of a bus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BusConfig {
    /// Bits per second, for the time that packets need on the wire.
    pub baud: u32,
    /// Wait for an answer beyond its time on the wire: return delay of the servo (at most 0.5 ms)
    /// and latency of a USB adapter (16 ms as delivered).
    pub latency: Duration,
    /// How often an instruction is sent before it counts as failed.
    pub attempts: usize,
}

impl Default for BusConfig {
    /// The factory's 1 Mbaud of AX; attempts of 34 ms, the time that ROBOTIS' SDK waits too, for a quarter
    /// of a second: a busy computer may not come to its port for a tenth.
    fn default() -> Self {
        BusConfig { baud: 1_000_000, latency: Duration::from_millis(34), attempts: 8 }
    }
}

/// Why an exchange failed.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// No answer at all.
    #[error("servo {id} does not answer (power, cable, ID, baud rate, protocol?)")]
    Silent {
        /// Which servo.
        id: u8,
    },
    /// Answers came, none whole.
    #[error("answers of servo {id} arrive damaged ({damaged} check sums wrong)")]
    Damaged {
        /// Which servo.
        id: u8,
        /// Packets with wrong check sums, last attempt.
        damaged: usize,
    },
    /// The servo understood and refused.
    #[error("servo {id} refuses: {reason}")]
    Refused {
        /// Which servo.
        id: u8,
        /// In words.
        reason: String,
    },
    /// The port is gone.
    #[error("the port fails: {0}")]
    Port(#[from] io::Error),
}

/// What a servo answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// Data asked for.
    pub data: Vec<u8>,
    /// What the servo complains about beside answering, see [`conditions`].
    pub error: u8,
}

/// A bus with servos of one or both protocols.
pub struct Bus {
    transport: Box<dyn Transport>,
    config: BusConfig,
    decoder: Decoder,
}

impl Bus {
    /// Talks over a transport.
    pub fn new(transport: impl Transport + 'static, config: BusConfig) -> Self {
        Bus { transport: Box::new(transport), config, decoder: Decoder::default() }
    }

    /// Model number of a servo.
    pub fn ping(&mut self, protocol: Protocol, id: u8) -> Result<u16, BusError> {
        // That of a 1.0 servo stands at the start of its table. Its answer to a ping would be the echo of
        // that ping when it complains about its voltage.
        if protocol == Protocol::One {
            let answer = self.read(protocol, id, Register { address: 0, size: 2 })?;
            return Ok(super::model::number(&answer.data) as u16);
        }
        let answer = self.exchange(protocol, id, instruction::PING, &[], 3)?;
        match answer.data.as_slice() {
            [low, high, ..] => Ok(u16::from_le_bytes([*low, *high])),
            _ => Err(BusError::Refused { id, reason: "the answer is too short".into() }),
        }
    }

    /// Reads a stretch of one control table.
    pub fn read(
        &mut self,
        protocol: Protocol,
        id: u8,
        register: Register,
    ) -> Result<Answer, BusError> {
        let parameters = match protocol {
            Protocol::One => vec![register.address as u8, register.size],
            Protocol::Two => place(register),
        };
        let size = usize::from(register.size);
        let answer = self.exchange(protocol, id, instruction::READ, &parameters, size)?;
        whole(protocol, id, answer, size)
    }

    /// Writes a number and waits for the servo's confirmation.
    pub fn write(
        &mut self,
        protocol: Protocol,
        id: u8,
        register: Register,
        value: i32,
    ) -> Result<(), BusError> {
        let mut parameters = match protocol {
            Protocol::One => vec![register.address as u8],
            Protocol::Two => register.address.to_le_bytes().to_vec(),
        };
        parameters.extend_from_slice(&value.to_le_bytes()[..usize::from(register.size.min(4))]);
        let answer = self.exchange(protocol, id, instruction::WRITE, &parameters, 0)?;
        match refusal(protocol, answer.error) {
            Some(reason) => Err(BusError::Refused { id, reason: reason.into() }),
            None => Ok(()),
        }
    }

    /// Writes one number to each of several servos in one packet, which all obey at the same
    /// instant and none confirms.
    pub fn sync_write(
        &mut self,
        protocol: Protocol,
        register: Register,
        values: &[(u8, i32)],
    ) -> Result<(), BusError> {
        let size = usize::from(register.size.min(4));
        let mut parameters = match protocol {
            Protocol::One => vec![register.address as u8, register.size],
            Protocol::Two => place(register),
        };
        for (id, value) in values {
            parameters.push(*id);
            parameters.extend_from_slice(&value.to_le_bytes()[..size]);
        }
        let id = instruction::BROADCAST;
        let frame = Frame::instruction(protocol, id, instruction::SYNC_WRITE, &parameters);
        Ok(self.transport.send(&frame.encode())?)
    }

    /// Reads the same stretch of several servos: in one exchange with protocol 2.0, one after the
    /// other with 1.0, which has no such instruction.
    pub fn sync_read(
        &mut self,
        protocol: Protocol,
        register: Register,
        ids: &[u8],
    ) -> Result<Vec<Answer>, BusError> {
        if protocol == Protocol::One {
            return ids.iter().map(|&id| self.read(protocol, id, register)).collect();
        }
        let mut parameters = place(register);
        parameters.extend_from_slice(ids);
        let id = instruction::BROADCAST;
        let frame = Frame::instruction(protocol, id, instruction::SYNC_READ, &parameters);
        let mut last = BusError::Silent { id: ids.first().copied().unwrap_or(id) };
        for _ in 0..self.config.attempts.max(1) {
            match self.attempt(&frame, ids, usize::from(register.size)) {
                Err(BusError::Port(e)) => return Err(BusError::Port(e)),
                Err(e) => last = e,
                Ok(answers) => {
                    let size = usize::from(register.size);
                    let checked = ids.iter().zip(answers);
                    return checked.map(|(&id, a)| whole(protocol, id, a, size)).collect();
                }
            }
        }
        Err(last)
    }

    fn exchange(
        &mut self,
        protocol: Protocol,
        id: u8,
        code: u8,
        parameters: &[u8],
        expected: usize,
    ) -> Result<Answer, BusError> {
        let frame = Frame::instruction(protocol, id, code, parameters);
        let mut last = BusError::Silent { id };
        for _ in 0..self.config.attempts.max(1) {
            match self.attempt(&frame, &[id], expected) {
                Ok(mut answers) => return Ok(answers.remove(0)),
                Err(BusError::Port(e)) => return Err(BusError::Port(e)),
                Err(e) => last = e,
            }
        }
        Err(last)
    }

    /// One try: sends, then collects one answer of each servo in order. `expected` is the answer's
    /// data length, for the time-out and to refuse late answers to another question.
    fn attempt(
        &mut self,
        frame: &Frame,
        ids: &[u8],
        expected: usize,
    ) -> Result<Vec<Answer>, BusError> {
        self.decoder.clear();
        self.transport.discard()?;
        let bytes = frame.encode();
        self.transport.send(&bytes)?;
        let on_wire = bytes.len() + ids.len() * (expected + 12);
        let wire_time = Duration::from_secs_f64(10.0 * on_wire as f64 / self.config.baud as f64);
        let deadline = Instant::now() + wire_time + self.config.latency;
        let mut answers: Vec<Answer> = Vec::new();
        let mut echoed = false;
        let mut heard = |packet: &Frame, answers: &mut Vec<Answer>| {
            if !echoed && packet == frame {
                echoed = true;
                return;
            }
            take(packet, frame, ids, expected, answers);
        };
        let mut buffer = [0u8; 256];
        loop {
            while let Some(answer) = self.decoder.next_frame() {
                heard(&answer, &mut answers);
            }
            if answers.len() == ids.len() {
                return Ok(answers);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            let count = self.transport.receive(&mut buffer, left)?;
            self.decoder.push(&buffer[..count]);
        }
        while let Some(answer) = self.decoder.after_silence() {
            heard(&answer, &mut answers);
        }
        match (answers.len() == ids.len(), self.decoder.damaged()) {
            (true, _) => Ok(answers),
            (false, 0) => Err(BusError::Silent { id: ids[answers.len()] }),
            (false, damaged) => Err(BusError::Damaged { id: ids[answers.len()], damaged }),
        }
    }
}

fn take(answer: &Frame, question: &Frame, ids: &[u8], expected: usize, answers: &mut Vec<Answer>) {
    let wanted = ids.get(answers.len()) == Some(&answer.id);
    if answer.protocol != question.protocol || !wanted {
        return;
    }
    if let Some((error, data)) = answer.as_answer() {
        // An answer with an error may come without its data; else the length must fit.
        let fits = data.len() == expected || error != 0 || question.body[0] == instruction::PING;
        if fits {
            answers.push(Answer { data: data.to_vec(), error });
        }
    }
}

/// An answer whose data are all there; a servo that refuses to read sends none.
fn whole(protocol: Protocol, id: u8, answer: Answer, size: usize) -> Result<Answer, BusError> {
    if answer.data.len() == size {
        return Ok(answer);
    }
    let reason = refusal(protocol, answer.error).unwrap_or("the answer is too short");
    Err(BusError::Refused { id, reason: reason.into() })
}

fn place(register: Register) -> Vec<u8> {
    let [a, b] = register.address.to_le_bytes();
    vec![a, b, register.size, 0]
}

/// Why a servo refused an instruction, from the error byte of its answer; `None` when it obeyed.
pub fn refusal(protocol: Protocol, error: u8) -> Option<&'static str> {
    match protocol {
        Protocol::One if error & 0x40 != 0 => Some("unknown instruction"),
        Protocol::One if error & 0x10 != 0 => Some("wrong check sum"),
        Protocol::One if error & 0x08 != 0 => Some("value out of range"),
        Protocol::One if error & 0x02 != 0 => Some("position beyond the servo's own limits"),
        Protocol::One => None,
        Protocol::Two => match error & 0x7F {
            0 => None,
            1 => Some("could not process the packet"),
            2 => Some("unknown instruction"),
            3 => Some("wrong check sum"),
            4 => Some("value out of range"),
            5 => Some("wrong data length"),
            6 => Some("value beyond the servo's own limits"),
            7 => Some("place is read-only, or locked while torque is on"),
            _ => Some("unknown error"),
        },
    }
}

/// Faults of the servo itself in the error byte of a 1.0 answer (bit set) or, for 2.0, in the
/// hardware error register.
pub fn conditions(protocol: Protocol, bits: u8) -> Vec<&'static str> {
    let named: &[(u8, &str)] = match protocol {
        Protocol::One => &[(0, "voltage out of range"), (2, "overheated"), (5, "overload")],
        Protocol::Two => &[
            (0, "voltage out of range"),
            (2, "overheated"),
            (3, "encoder failure"),
            (4, "electrical shock or motor failure"),
            (5, "overload"),
        ],
    };
    named.iter().filter(|(bit, _)| bits >> bit & 1 == 1).map(|(_, name)| *name).collect()
}
