//! Packets of the Dynamixel protocols 1.0 and 2.0: bytes to frames and back, both directions.
//!
//! ```text
//! 1.0   FF FF ID LEN BODY.. SUM              LEN = body + 1,  SUM = ~(ID + LEN + BODY..)
//! 2.0   FF FF FD 00 ID LEN_L LEN_H BODY.. CRC_L CRC_H
//!                                            LEN = stuffed body + 2,  CRC-16, polynomial 8005
//! ```
//!
//! The body of an instruction is its code and parameters; that of an answer is (in 2.0 after the code
//! 55h) an error byte and the data. In 2.0 `FF FF FD` within a body is followed by a stuffed `FD`.
//! Both protocols share one wire: `FF FF FD 00` would be an empty packet to ID 253 in 1.0, which
//! does not exist.
//!
//! Source: ROBOTIS e-Manual, "Protocol 1.0" and "Protocol 2.0"; checked against packets of ROBOTIS'
//! own SDK (`golden` test below).

/// Longest body that is believed, bytes; longer ones are noise in a length field.
pub const MAX_BODY: usize = 512;

/// Code that starts the body of an answer in protocol 2.0.
pub const STATUS: u8 = 0x55;

/// Which of the two protocols.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Protocol {
    /// 1.0: AX, old MX.
    One,
    /// 2.0: X series, MX with new firmware.
    Two,
}

/// What a packet is to do.
pub mod instruction {
    /// Are you there?
    pub const PING: u8 = 0x01;
    /// Read from the control table.
    pub const READ: u8 = 0x02;
    /// Write to the control table.
    pub const WRITE: u8 = 0x03;
    /// Write later, on ACTION.
    pub const REG_WRITE: u8 = 0x04;
    /// Do what REG_WRITE prepared.
    pub const ACTION: u8 = 0x05;
    /// Restart (2.0).
    pub const REBOOT: u8 = 0x08;
    /// Read one place of several servos (2.0).
    pub const SYNC_READ: u8 = 0x82;
    /// Write one place of several servos.
    pub const SYNC_WRITE: u8 = 0x83;
    /// All servos on the bus.
    pub const BROADCAST: u8 = 0xFE;
}

/// One packet without its wrapping.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Protocol it came in.
    pub protocol: Protocol,
    /// Receiver of an instruction, sender of an answer.
    pub id: u8,
    /// Instruction or error byte, then parameters; in 2.0 an answer starts with [`STATUS`].
    pub body: Vec<u8>,
}

impl Frame {
    /// An instruction with its parameters.
    pub fn instruction(protocol: Protocol, id: u8, code: u8, parameters: &[u8]) -> Self {
        let mut body = vec![code];
        body.extend_from_slice(parameters);
        Frame { protocol, id, body }
    }

    /// An answer with its error byte and data.
    pub fn answer(protocol: Protocol, id: u8, error: u8, data: &[u8]) -> Self {
        let mut body = match protocol {
            Protocol::One => vec![error],
            Protocol::Two => vec![STATUS, error],
        };
        body.extend_from_slice(data);
        Frame { protocol, id, body }
    }

    /// The frame read as an answer: error byte and data. `None` for an instruction (in 1.0 both
    /// look alike, and everything is taken for an answer).
    pub fn as_answer(&self) -> Option<(u8, &[u8])> {
        match (self.protocol, self.body.as_slice()) {
            (Protocol::One, [error, data @ ..]) => Some((*error, data)),
            (Protocol::Two, [STATUS, error, data @ ..]) => Some((*error, data)),
            _ => None,
        }
    }

    /// The bytes on the wire.
    pub fn encode(&self) -> Vec<u8> {
        match self.protocol {
            Protocol::One => {
                let mut out = vec![0xFF, 0xFF, self.id, (self.body.len() + 1) as u8];
                out.extend_from_slice(&self.body);
                out.push(sum(&out[2..]));
                out
            }
            Protocol::Two => {
                let body = stuffed(&self.body);
                let length = (body.len() + 2) as u16;
                let mut out = vec![0xFF, 0xFF, 0xFD, 0x00, self.id];
                out.extend_from_slice(&length.to_le_bytes());
                out.extend_from_slice(&body);
                out.extend_from_slice(&crc16(&out).to_le_bytes());
                out
            }
        }
    }
}

/// Finds packets in a stream of bytes that may hold noise, cut and damaged packets.
#[derive(Debug, Default)]
pub struct Decoder {
    buffer: Vec<u8>,
    /// Packets that were dropped for a wrong check sum.
    damaged: usize,
}

enum Found {
    Frame(Frame, usize),
    /// May still become a packet.
    Incomplete,
    Noise,
    Damaged,
}

impl Decoder {
    /// Takes bytes from the wire.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// The next packet, when there is a whole one.
    pub fn next_frame(&mut self) -> Option<Frame> {
        loop {
            match parse(&self.buffer) {
                Found::Frame(frame, used) => {
                    self.buffer.drain(..used);
                    return Some(frame);
                }
                Found::Incomplete => return None,
                Found::Noise => self.buffer.drain(..1),
                Found::Damaged => {
                    self.damaged += 1;
                    // A whole good packet may begin within what a damaged length claimed.
                    self.buffer.drain(..1)
                }
            };
        }
    }

    /// The wire has been silent for long: what waits for its rest will not get it. Gives the first
    /// whole packet after the torn one, if any.
    pub fn after_silence(&mut self) -> Option<Frame> {
        while !self.buffer.is_empty() {
            if let Some(frame) = self.next_frame() {
                return Some(frame);
            }
            if !self.buffer.is_empty() {
                self.buffer.drain(..1);
            }
        }
        None
    }

    /// Forgets all bytes.
    pub fn clear(&mut self) {
        self.buffer.clear();
        self.damaged = 0;
    }

    /// Packets dropped for a wrong check sum since the last [`Decoder::clear`].
    pub fn damaged(&self) -> usize {
        self.damaged
    }
}

fn parse(bytes: &[u8]) -> Found {
    match bytes {
        [] | [0xFF] | [0xFF, 0xFF] | [0xFF, 0xFF, 0xFD] => Found::Incomplete,
        [0xFF, 0xFF, 0xFF, ..] => Found::Noise,
        [0xFF, 0xFF, 0xFD, 0x00, ..] => parse_two(bytes),
        [0xFF, 0xFF, ..] => parse_one(bytes),
        _ => Found::Noise,
    }
}

fn parse_one(bytes: &[u8]) -> Found {
    let Some(&length) = bytes.get(3) else { return Found::Incomplete };
    let total = 4 + usize::from(length);
    if length < 2 {
        return Found::Noise;
    }
    let Some(packet) = bytes.get(..total) else { return Found::Incomplete };
    if sum(&packet[2..total - 1]) != packet[total - 1] {
        return Found::Damaged;
    }
    let body = packet[4..total - 1].to_vec();
    Found::Frame(Frame { protocol: Protocol::One, id: packet[2], body }, total)
}

fn parse_two(bytes: &[u8]) -> Found {
    let &[_, _, _, _, id, low, high, ..] = bytes else { return Found::Incomplete };
    let length = usize::from(u16::from_le_bytes([low, high]));
    let total = 7 + length;
    if !(3..=MAX_BODY + 2).contains(&length) {
        return Found::Noise;
    }
    let Some(packet) = bytes.get(..total) else { return Found::Incomplete };
    if crc16(&packet[..total - 2]).to_le_bytes() != packet[total - 2..] {
        return Found::Damaged;
    }
    let body = unstuffed(&packet[7..total - 2]);
    Found::Frame(Frame { protocol: Protocol::Two, id, body }, total)
}

fn stuffed(body: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(body.len());
    for &byte in body {
        out.push(byte);
        if out.ends_with(&[0xFF, 0xFF, 0xFD]) {
            out.push(0xFD);
        }
    }
    out
}

fn unstuffed(body: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(body.len());
    let mut just_stuffed = false;
    for &byte in body {
        // The byte after FF FF FD is the stuffing, and does not itself start another pattern.
        if byte == 0xFD && !just_stuffed && out.ends_with(&[0xFF, 0xFF, 0xFD]) {
            just_stuffed = true;
            continue;
        }
        just_stuffed = false;
        out.push(byte);
    }
    out
}

fn sum(bytes: &[u8]) -> u8 {
    !bytes.iter().fold(0u8, |sum, &byte| sum.wrapping_add(byte))
}

/// CRC-16 with polynomial 8005h, from zero, most significant bit first.
fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0u16, |crc, &byte| {
        (0..8).fold(crc ^ u16::from(byte) << 8, |crc, _| match crc & 0x8000 {
            0 => crc << 1,
            _ => crc << 1 ^ 0x8005,
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frames() -> impl Strategy<Value = Frame> {
        let byte = prop_oneof![Just(0xFFu8), Just(0xFD), Just(0x00), any::<u8>()];
        (any::<bool>(), 0u8..=252, prop::collection::vec(byte, 1..40)).prop_map(
            |(two, id, body)| Frame {
                protocol: if two { Protocol::Two } else { Protocol::One },
                id,
                body,
            },
        )
    }

    proptest! {
        #[test]
        fn decode_inverts_encode_in_any_pieces(frames in prop::collection::vec(frames(), 1..4), piece in 1usize..9) {
            let wire: Vec<u8> = frames.iter().flat_map(Frame::encode).collect();
            let mut decoder = Decoder::default();
            let mut got = Vec::new();
            for part in wire.chunks(piece) {
                decoder.push(part);
                got.extend(std::iter::from_fn(|| decoder.next_frame()));
            }
            prop_assert_eq!(got, frames);
        }

        #[test]
        fn rubbish_never_panics_and_never_hides_a_packet(
            noise in prop::collection::vec(any::<u8>(), 0..60), frame in frames(),
        ) {
            let mut decoder = Decoder::default();
            decoder.push(&noise);
            decoder.push(&frame.encode());
            let mut got: Vec<Frame> = std::iter::from_fn(|| decoder.next_frame()).collect();
            got.extend(std::iter::from_fn(|| decoder.after_silence()));
            // Noise that ends like a header may swallow the packet's start; then none is right.
            let clean = !noise.ends_with(&[0xFF]);
            prop_assert!(!clean || got.contains(&frame), "{got:?}");
        }

        #[test]
        fn one_wrong_bit_is_noticed(frame in frames(), at in any::<prop::sample::Index>(), bit in 0u8..8) {
            let mut wire = frame.encode();
            let at = at.index(wire.len());
            wire[at] ^= 1 << bit;
            let mut decoder = Decoder::default();
            decoder.push(&wire);
            prop_assert_ne!(decoder.next_frame(), Some(frame));
        }
    }

    #[test]
    fn packets_of_the_manual() {
        use Protocol::{One, Two};
        let encoded = |protocol, id, code, parameters: &[u8]| {
            Frame::instruction(protocol, id, code, parameters).encode()
        };
        assert_eq!(encoded(One, 1, instruction::PING, &[]), [0xFF, 0xFF, 1, 2, 1, 0xFB]);
        assert_eq!(
            encoded(One, 1, instruction::READ, &[0x2B, 1]),
            [0xFF, 0xFF, 1, 4, 2, 0x2B, 1, 0xCC]
        );
        assert_eq!(
            encoded(Two, 1, instruction::PING, &[]),
            [0xFF, 0xFF, 0xFD, 0, 1, 3, 0, 1, 0x19, 0x4E]
        );
        assert_eq!(
            encoded(Two, 1, instruction::READ, &[0x84, 0, 4, 0]),
            [0xFF, 0xFF, 0xFD, 0, 1, 7, 0, 2, 0x84, 0, 4, 0, 0x1D, 0x15]
        );
    }

    /// What ROBOTIS' SDK sends (`scripts/check_dynamixel_sdk.py --packets`), and the manual's answer.
    #[test]
    fn packets_of_the_makers_sdk() {
        use Protocol::{One, Two};
        use instruction::*;
        let golden: &[(Protocol, u8, u8, &[u8], &str)] = &[
            (One, 1, ACTION, &[], "ff ff 01 02 05 f7"),
            (One, 1, WRITE, &[0x1E, 0xD0, 0x07], "ff ff 01 05 03 1e d0 07 01"),
            (One, 1, REG_WRITE, &[0x1E, 0x20, 0x03], "ff ff 01 05 04 1e 20 03 b4"),
            (
                One,
                BROADCAST,
                SYNC_WRITE,
                &[0x1E, 2, 1, 0x90, 1, 2, 0xFF, 2],
                "ff ff fe 0a 83 1e 02 01 90 01 02 ff 02 bf",
            ),
            (Two, 11, REBOOT, &[], "ff ff fd 00 0b 03 00 08 2f c6"),
            (Two, BROADCAST, PING, &[], "ff ff fd 00 fe 03 00 01 31 42"),
            (Two, 12, WRITE, &[0x40, 0, 1], "ff ff fd 00 0c 06 00 03 40 00 01 08 eb"),
            (
                Two,
                BROADCAST,
                SYNC_READ,
                &[0x84, 0, 4, 0, 11, 12],
                "ff ff fd 00 fe 09 00 82 84 00 04 00 0b 0c e9 46",
            ),
            (
                Two,
                BROADCAST,
                SYNC_WRITE,
                &[0x74, 0, 4, 0, 11, 0xDC, 5, 0, 0, 12, 0xC4, 9, 0, 0],
                "ff ff fd 00 fe 11 00 83 74 00 04 00 0b dc 05 00 00 0c c4 09 00 00 ad 6a",
            ),
            (
                Two,
                11,
                WRITE,
                &[0xE0, 0, 0xFF, 0xFF, 0xFD, 0],
                "ff ff fd 00 0b 0a 00 03 e0 00 ff ff fd fd 00 e2 7a",
            ),
            (
                Two,
                11,
                WRITE,
                &[0xE0, 0, 0xFF, 0xFF, 0xFD, 0xFD],
                "ff ff fd 00 0b 0a 00 03 e0 00 ff ff fd fd fd ef f8",
            ),
            (Two, 1, STATUS, &[0, 6, 4, 0x26], "ff ff fd 00 01 07 00 55 00 06 04 26 65 5d"),
        ];
        for (protocol, id, code, parameters, hex) in golden {
            let frame = Frame::instruction(*protocol, *id, *code, parameters);
            let bytes: Vec<u8> =
                hex.split(' ').map(|h| u8::from_str_radix(h, 16).unwrap()).collect();
            assert_eq!(frame.encode(), bytes, "{hex}");
            let mut decoder = Decoder::default();
            decoder.push(&bytes);
            assert_eq!(decoder.next_frame(), Some(frame), "{hex}");
        }
    }

    #[test]
    fn a_damaged_length_does_not_hide_the_next_packet() {
        let good = Frame::answer(Protocol::One, 3, 0, &[7, 8]);
        let mut wire = good.encode();
        wire[3] = 200;
        wire.extend(good.encode());
        let mut decoder = Decoder::default();
        decoder.push(&wire);
        assert_eq!(decoder.next_frame(), None, "it waits for the 200 bytes");
        assert_eq!(decoder.after_silence(), Some(good));
    }
}
