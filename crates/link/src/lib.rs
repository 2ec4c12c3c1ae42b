//! The robot's side of the tag radio, over Bluetooth Low Energy.
//!
//! [`HciLink`] is a [`TagLink`](vergence_devices::TagLink) on a real host stack (trouble-host) over
//! any HCI controller: a serial line, TCP, or a virtual one. [`VirtualRadio`] puts robot, tags (the
//! real firmware) and the air between them into one process on virtual time; [`TagServer`] serves such
//! tags on TCP to anybody's Bluetooth host.
//!
//! Every call is bounded in time. A scan lasts its whole window and reports every address, so that
//! two tags that claim one object are both seen. A record whose object id is not the advertised one
//! is refused. Links are ended after use, but held while a tag's light plays.

#[cfg(feature = "bluez")]
mod bluez;
mod central;
mod conversation;
mod ears;
mod flash;
mod hci;
mod job;
mod pool;
mod radio;
mod server;
mod simulation;
mod virtual_tag;

#[cfg(feature = "bluez")]
pub use bluez::BluezLink;
pub use central::LinkConfig;
pub use flash::{BLOCK, MemoryFlash, OutOfBounds};
pub use hci::HciLink;
pub use job::{BOND_BYTES, Bond, TagInfo};
pub use pool::{HeapPacket, HeapPool};
pub use radio::TagRadio;
pub use server::TagServer;
pub use simulation::{RadioConfig, VirtualRadio};
pub use virtual_tag::{LightPlay, Plays, VirtualTag};
