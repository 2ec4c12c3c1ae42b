//! What a robot tells a tag's LED, and what the tag answers, as bytes (little endian).
//!
//! A play command has 20 bytes, the most that one write carries on a link of the smallest size:
//!
//! | byte | 0 | 1 | 2 | 3 | 4..12 | 12..16 | 16..18 | 18..20 |
//! |---|---|---|---|---|---|---|---|---|
//! | | 1 | LED | brightness | chips | chips, bit 0 first | chip (us) | repeats, 0 endless | longest play (s), 0 the tag's own |
//!
//! A stop command is the byte 0.

use core::time::Duration;

use crate::pattern::{Bits, Pattern, PatternError};

/// Bytes of the longest command.
pub const MAX_COMMAND_BYTES: usize = 20;
/// Bytes of a state.
pub const STATE_BYTES: usize = 2;

/// Longest play that a command can ask for: its limit has 16 bits of whole seconds.
pub const LONGEST_LIMIT: Duration = Duration::from_secs(u16::MAX as u64);

/// A command to the LED.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Dark.
    Stop,
    /// Play from now on, in place of what was played.
    Play {
        /// What to play.
        pattern: Pattern,
        /// Dark after this time (whole seconds, 1 to 65535) at the latest; `None`: after the tag's
        /// own longest time.
        limit: Option<Duration>,
    },
}

/// Why bytes are no command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// Neither a stop nor a play command.
    #[error("not a command")]
    Unknown,
    /// A play command is cut short or too long.
    #[error("a play command has {MAX_COMMAND_BYTES} bytes, not {0}")]
    Length(usize),
    /// The pattern cannot be played.
    #[error(transparent)]
    Pattern(#[from] PatternError),
}

impl Command {
    /// The command's bytes. A limit is rounded up to whole seconds, [`LONGEST_LIMIT`] at most.
    pub fn encode(&self) -> heapless::Vec<u8, MAX_COMMAND_BYTES> {
        let mut bytes = heapless::Vec::new();
        let Command::Play { pattern, limit } = self else {
            let _ = bytes.push(0);
            return bytes;
        };
        let limit = limit.map_or(0, |limit| {
            let up = limit.as_secs() + u64::from(limit.subsec_nanos() > 0);
            up.clamp(1, LONGEST_LIMIT.as_secs()) as u16
        });
        // `Pattern::new` keeps chips below ten seconds; microseconds of more would be cut off here.
        let chip = u32::try_from(pattern.chip.as_micros()).unwrap_or(u32::MAX);
        let parts: [&[u8]; 6] = [
            &[1, pattern.landmark, pattern.brightness],
            &[pattern.bits.len() as u8],
            &pattern.bits.raw().to_le_bytes(),
            &chip.to_le_bytes(),
            &pattern.repeats.unwrap_or(0).to_le_bytes(),
            &limit.to_le_bytes(),
        ];
        // The parts are 20 bytes together, the vector's capacity.
        let _ = parts.into_iter().try_for_each(|part| bytes.extend_from_slice(part));
        bytes
    }

    /// Reads a command.
    pub fn decode(bytes: &[u8]) -> Result<Self, CommandError> {
        match bytes {
            [0] => return Ok(Command::Stop),
            [1, ..] => {}
            _ => return Err(CommandError::Unknown),
        }
        let bytes: &[u8; MAX_COMMAND_BYTES] =
            bytes.try_into().map_err(|_| CommandError::Length(bytes.len()))?;
        let [
            _,
            landmark,
            brightness,
            len,
            b0,
            b1,
            b2,
            b3,
            b4,
            b5,
            b6,
            b7,
            c0,
            c1,
            c2,
            c3,
            r0,
            r1,
            l0,
            l1,
        ] = *bytes;
        let raw = u64::from_le_bytes([b0, b1, b2, b3, b4, b5, b6, b7]);
        let bits = Bits::new(raw, usize::from(len))?;
        let chip = Duration::from_micros(u64::from(u32::from_le_bytes([c0, c1, c2, c3])));
        let repeats = match u16::from_le_bytes([r0, r1]) {
            0 => None,
            repeats => Some(repeats),
        };
        let pattern = Pattern { repeats, brightness, landmark, ..Pattern::new(bits, chip)? };
        let limit = match u16::from_le_bytes([l0, l1]) {
            0 => None,
            seconds => Some(Duration::from_secs(u64::from(seconds))),
        };
        Ok(Command::Play { pattern, limit })
    }
}

/// What a tag tells of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct State {
    /// The LED is playing.
    pub playing: bool,
    /// The tag holds a record.
    pub has_record: bool,
    /// Battery level (percent), when it is known.
    pub battery: Option<u8>,
}

impl State {
    /// The state's bytes: flags (1 playing, 2 has a record) and battery level (255 unknown).
    pub fn encode(self) -> [u8; STATE_BYTES] {
        let flags = u8::from(self.playing) | u8::from(self.has_record) << 1;
        [flags, self.battery.map_or(255, |level| level.min(100))]
    }

    /// Reads a state; further bytes are of later versions and read over.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let [flags, battery, ..] = bytes else { return None };
        Some(State {
            playing: flags & 1 != 0,
            has_record: flags & 2 != 0,
            battery: (*battery <= 100).then_some(*battery),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn commands() -> impl Strategy<Value = Command> {
        let pattern = (2usize..=64, any::<u64>(), 1_000u32..10_000_000, any::<[u8; 2]>())
            .prop_filter_map("constant", |(len, raw, chip, [brightness, landmark])| {
                let bits = Bits::new(raw, len).ok()?;
                let chip = Duration::from_micros(u64::from(chip));
                Some(Pattern { brightness, landmark, ..Pattern::new(bits, chip).ok()? })
            });
        let counts = (prop::option::of(1u16..), prop::option::of(1u16..));
        prop_oneof![
            1 => Just(Command::Stop),
            9 => (pattern, counts).prop_map(|(pattern, (repeats, limit))| Command::Play {
                pattern: Pattern { repeats, ..pattern },
                limit: limit.map(|s| Duration::from_secs(u64::from(s))),
            }),
        ]
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back(command in commands()) {
            prop_assert_eq!(Command::decode(&command.encode()), Ok(command));
        }

        #[test]
        fn other_bytes_are_refused_or_a_command(bytes in prop::collection::vec(any::<u8>(), 0..32)) {
            if let Ok(command) = Command::decode(&bytes) {
                prop_assert_eq!(&command.encode()[..], &bytes[..]);
            }
        }

        #[test]
        fn states_read_back(playing: bool, has_record: bool, battery in prop::option::of(0u8..=100)) {
            let state = State { playing, has_record, battery };
            prop_assert_eq!(State::decode(&state.encode()), Some(state));
        }
    }

    #[test]
    fn what_is_wrong_is_said() {
        assert_eq!(Command::decode(&[]), Err(CommandError::Unknown));
        assert_eq!(Command::decode(&[7; 20]), Err(CommandError::Unknown));
        assert_eq!(Command::decode(&[1; 19]), Err(CommandError::Length(19)));
        let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap();
        let mut bytes = Command::Play { pattern, limit: None }.encode();
        bytes[3] = 65;
        assert_eq!(Command::decode(&bytes), Err(PatternError::Length(65).into()));
        bytes[3] = 2;
        bytes[12..16].fill(0);
        assert_eq!(Command::decode(&bytes), Err(PatternError::Chip.into()));
        assert_eq!(State::decode(&[1]), None);
    }
}
