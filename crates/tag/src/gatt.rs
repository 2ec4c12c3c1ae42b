//! Where things are on a tag's Bluetooth server: services, characteristics, sizes.
//!
//! | characteristic | access | value |
//! |---|---|---|
//! | [`RECORD`] | read | the record's CBOR, its first 512 bytes |
//! | [`RECORD_REST`] | read | what follows byte 512, empty for nearly all records |
//! | [`RECORD_WRITE`] | write | [`Upload`](crate::Upload) messages |
//! | [`COMMAND`] | write | [`Command`](crate::Command) |
//! | [`STATE`] | read, notify | [`State`](crate::State) |
//!
//! Beside the tag service there are the standard Device Information (0x180A) and Battery (0x180F)
//! services. The UUIDs are drawn from one random 128-bit number, as the Bluetooth SIG wants it for
//! services of one's own.

/// The tag service, also what tags advertise.
pub const SERVICE: u128 = 0x6f1c0001_8a52_4d3b_b1f7_2e90c45ad617;
/// The record's first 512 bytes, the longest value an attribute may have.
pub const RECORD: u128 = 0x6f1c0002_8a52_4d3b_b1f7_2e90c45ad617;
/// The record from byte 512 on.
pub const RECORD_REST: u128 = 0x6f1c0003_8a52_4d3b_b1f7_2e90c45ad617;
/// A new record, in pieces.
pub const RECORD_WRITE: u128 = 0x6f1c0004_8a52_4d3b_b1f7_2e90c45ad617;
/// Commands to the LED.
pub const COMMAND: u128 = 0x6f1c0005_8a52_4d3b_b1f7_2e90c45ad617;
/// What the tag is doing.
pub const STATE: u128 = 0x6f1c0006_8a52_4d3b_b1f7_2e90c45ad617;

/// Device Information.
pub const DEVICE_INFORMATION: u16 = 0x180A;
/// Manufacturer name string.
pub const MANUFACTURER: u16 = 0x2A29;
/// Model number string.
pub const MODEL: u16 = 0x2A24;
/// Firmware revision string.
pub const FIRMWARE: u16 = 0x2A26;
/// Battery service.
pub const BATTERY: u16 = 0x180F;
/// Battery level (percent).
pub const BATTERY_LEVEL: u16 = 0x2A19;

/// Longest value of one attribute (Bluetooth Core 5.4, volume 3, part F, 3.2.9).
pub const LONGEST_VALUE: usize = 512;

/// Application error of a write whose bytes are no command or no record.
pub const ERROR_MALFORMED: u8 = 0x80;
/// Application error of a record that cannot be true.
pub const ERROR_IMPOSSIBLE: u8 = 0x81;
/// Application error of a record that the tag could not store.
pub const ERROR_STORAGE: u8 = 0x82;
