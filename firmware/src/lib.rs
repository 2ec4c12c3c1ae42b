//! The firmware of a smart tag, as far as it is the same on every board.
//!
//! In: a Bluetooth controller (anything that is a `trouble_host::Controller`: a chip's own radio, an
//! HCI transport, a virtual controller), a NOR flash, lights, a battery gauge, a watchdog. Out: a tag
//! that advertises itself, hands out its record, blinks as it is told and keeps its record and bonds
//! over power cuts. `no_std`, no heap; [`run`] is the whole of it, and a board's program is a call of
//! it. The same function runs on chips, as a Linux process and in the simulated workcell.
//!
//! [`power`] computes how long a battery lasts.
#![no_std]

pub mod board;
pub mod config;
pub mod frame;
pub mod guard;
pub mod led;
pub mod power;
pub mod server;
pub mod store;
mod tag;

pub use board::{Battery, Board, Lights, Play, Watchdog};
pub use config::{Access, Config};
pub use guard::Guard;
pub use store::{Store, StoreError};
pub use tag::{Stopped, run};
