//! What the LED plays: a cyclic string of chips, on or off.

use core::fmt;
use core::str::FromStr;
use core::time::Duration;

/// A cyclic on/off sequence of up to 64 chips, `true` first in time at index 0.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "std", serde(try_from = "std::string::String", into = "std::string::String"))]
pub struct Bits {
    bits: u64,
    len: u8,
}

/// Why a bit string is no pattern.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PatternError {
    /// Not 2 to 64 chips long.
    #[error("a pattern has 2 to 64 chips, not {0}")]
    Length(usize),
    /// A character other than 0 and 1.
    #[error("a pattern is made of 0 and 1 only")]
    Character,
    /// Never changes, so that nothing blinks.
    #[error("a pattern must hold at least one 0 and one 1")]
    Constant,
    /// Chip duration outside 1 ms to 10 s.
    #[error("a chip lasts 1 ms to 10 s")]
    Chip,
}

impl Bits {
    /// The plain flicker of the paper: on, off.
    pub const FLICKER: Bits = Bits { bits: 0b01, len: 2 };

    /// From the lowest `len` bits of `bits`, bit 0 first in time.
    pub fn new(bits: u64, len: usize) -> Result<Self, PatternError> {
        if !(2..=64).contains(&len) {
            return Err(PatternError::Length(len));
        }
        let mask = if len == 64 { u64::MAX } else { (1 << len) - 1 };
        let bits = bits & mask;
        if bits == 0 || bits == mask {
            return Err(PatternError::Constant);
        }
        Ok(Bits { bits, len: len as u8 })
    }

    /// Number of chips; never zero.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        usize::from(self.len)
    }

    /// The chips as an integer, bit 0 first in time.
    pub fn raw(&self) -> u64 {
        self.bits
    }

    /// The chip at a cyclic index.
    pub fn chip(&self, index: i64) -> bool {
        self.bits >> index.rem_euclid(i64::from(self.len)) & 1 == 1
    }

    /// Number of chips that are on.
    pub fn weight(&self) -> u32 {
        self.bits.count_ones()
    }

    /// The chips in order of time.
    pub fn chips(&self) -> impl Iterator<Item = bool> + '_ {
        (0..self.len()).map(|k| self.bits >> k & 1 == 1)
    }
}

impl FromStr for Bits {
    type Err = PatternError;

    fn from_str(text: &str) -> Result<Self, PatternError> {
        if !(2..=64).contains(&text.len()) {
            return Err(PatternError::Length(text.len()));
        }
        let mut bits = 0;
        for (k, c) in text.bytes().enumerate() {
            match c {
                b'0' => {}
                b'1' => bits |= 1 << k,
                _ => return Err(PatternError::Character),
            }
        }
        Bits::new(bits, text.len())
    }
}

#[cfg(feature = "std")]
impl TryFrom<std::string::String> for Bits {
    type Error = PatternError;

    fn try_from(text: std::string::String) -> Result<Self, PatternError> {
        text.parse()
    }
}

impl fmt::Display for Bits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.chips().try_for_each(|on| f.write_str(if on { "1" } else { "0" }))
    }
}

impl fmt::Debug for Bits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Bits({self})")
    }
}

#[cfg(feature = "std")]
impl From<Bits> for std::string::String {
    fn from(bits: Bits) -> Self {
        std::string::ToString::to_string(&bits)
    }
}

/// A blink command: what to play, how fast, how often.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pattern {
    /// The chips.
    pub bits: Bits,
    /// How long a chip lasts on the tag's clock.
    pub chip: Duration,
    /// How many times the string is played; `None`: until stopped (the tag stops by itself after
    /// its own longest time, or when the link ends).
    pub repeats: Option<u16>,
    /// Drive level of the LED, 255 is full.
    pub brightness: u8,
    /// Which LED of the tag.
    pub landmark: u8,
}

impl Pattern {
    /// Endless play of `bits` at full brightness on the first LED.
    pub fn new(bits: Bits, chip: Duration) -> Result<Self, PatternError> {
        if !(Duration::from_millis(1)..=Duration::from_secs(10)).contains(&chip) {
            return Err(PatternError::Chip);
        }
        Ok(Pattern { bits, chip, repeats: None, brightness: 255, landmark: 0 })
    }

    /// Time of one pass of the string.
    pub fn period(&self) -> Duration {
        self.chip * self.bits.len() as u32
    }

    /// Share of the interval `[from, from + span]` (s since the start of the pattern) in which the
    /// LED is on, counted as if the pattern had always been playing: what an exposure integrates.
    pub fn on_fraction(&self, from: f64, span: f64) -> f64 {
        let chip = self.chip.as_secs_f64();
        if span <= 0.0 {
            return f64::from(u8::from(self.bits.chip(floor(from / chip))));
        }
        (self.on_time(from + span) - self.on_time(from)) / span
    }

    /// Seconds of light between the pattern's start and `time` (negative before it).
    fn on_time(&self, time: f64) -> f64 {
        let chip = self.chip.as_secs_f64();
        let chips = time / chip;
        let whole = floor(chips);
        let len = self.bits.len() as i64;
        let (periods, rest) = (whole.div_euclid(len), whole.rem_euclid(len));
        let before = (self.bits.raw() & ((1u64 << rest) - 1)).count_ones();
        let partial = if self.bits.chip(rest) { chips - whole as f64 } else { 0.0 };
        chip * (periods as f64 * f64::from(self.bits.weight()) + f64::from(before) + partial)
    }
}

/// Floor without `std`.
fn floor(x: f64) -> i64 {
    let whole = x as i64;
    if (whole as f64) > x { whole - 1 } else { whole }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn text_is_time_order() {
        let bits: Bits = "1101000".parse().unwrap();
        assert!(bits.chip(0) && bits.chip(1) && !bits.chip(2) && bits.chip(3) && bits.chip(-7));
        assert_eq!(bits.to_string(), "1101000");
        assert_eq!("10".parse::<Bits>().unwrap(), Bits::FLICKER);
    }

    #[test]
    fn what_cannot_blink_is_refused() {
        assert_eq!("1111".parse::<Bits>(), Err(PatternError::Constant));
        assert_eq!("1".parse::<Bits>(), Err(PatternError::Length(1)));
        assert_eq!("10x".parse::<Bits>(), Err(PatternError::Character));
        assert_eq!(Pattern::new(Bits::FLICKER, Duration::ZERO), Err(PatternError::Chip));
    }

    proptest! {
        #[test]
        fn light_adds_up(raw in 1u64..65534, from in -3.0f64..3.0, span in 0.001f64..0.5, cut in 0.0f64..1.0) {
            let pattern = Pattern::new(Bits::new(raw, 16).unwrap(), Duration::from_millis(33)).unwrap();
            let whole = pattern.on_fraction(from, span) * span;
            let parts = pattern.on_fraction(from, span * cut) * span * cut
                + pattern.on_fraction(from + span * cut, span * (1.0 - cut)) * span * (1.0 - cut);
            prop_assert!(!(1e-6..1.0 - 1e-6).contains(&cut) || (whole - parts).abs() < 1e-9);
            let period = pattern.period().as_secs_f64();
            let mean = pattern.on_fraction(from, period);
            prop_assert!((mean - f64::from(pattern.bits.weight()) / 16.0).abs() < 1e-9);
        }
    }
}
