//! What a smart tag is: its record of the object, its LED pattern, the commands it obeys.
//!
//! Shared by the robot and the firmware, therefore `no_std` and without a heap: strings and lists
//! have fixed capacities. [`Record`] is Table 1 of the paper and a little more; [`cbor`] is its wire
//! form (RFC 8949, schema in `docs/record.cddl`); [`Pattern`] is what the LED plays, [`Command`] how
//! it is told, [`gatt`] where on the tag's Bluetooth server, [`Upload`] how a new record gets there,
//! and [`Beacon`] what the tag says of itself to everybody. A record may be wrapped in a signature
//! ([`cose`]). With the feature `std` (default) the record also reads and writes as JSON or TOML
//! through serde; with `signature` records are signed, and signatures judged.
#![cfg_attr(not(feature = "std"), no_std)]

pub mod beacon;
pub mod cbor;
pub mod codebook;
pub mod command;
pub mod cose;
pub mod gatt;
pub mod pattern;
pub mod record;
mod shown;
#[cfg(feature = "signature")]
pub mod signature;
pub mod upload;

pub use beacon::Beacon;
pub use cbor::RecordError;
pub use command::{Command, CommandError, State};
pub use pattern::{Pattern, PatternError};
pub use record::{
    BoundingBox, Invalid, LandmarkSite, Mobility, Physical, Record, Semantic, Shape, Text,
};
pub use shown::Shown;
pub use upload::Upload;

/// A position, direction or pair in the object frame as plain numbers (m).
pub type Vec3 = [f64; 3];
