//! The radio without a radio: virtual Bluetooth Low Energy controllers in one process.
//!
//! [`Air`] is the medium; [`Air::controller`] gives controllers that a host stack drives through
//! bt-hci's transport trait, or a foreign stack through TCP ([`serve`]). The host stacks above are
//! the real ones, the same that run on a tag and on a robot; what is simulated ends at the Host
//! Controller Interface: advertising with scan responses, passive and active scans, accept lists,
//! connections with connection events, flow control, supervision timeouts, connection updates,
//! encryption as far as hosts can see it, signal strength by a closure, and faults by a hook on
//! every data fragment.
//!
//! [`Executor`] runs stacks and medium on one thread, on real or on virtual [`time`]. On virtual
//! time a run repeats bit for bit and takes no longer than its computations.
//!
//! Not simulated: extended and periodic advertising, resolution of private addresses, the cipher
//! itself, collisions and interference.

mod advertising;
mod controller;
mod executor;
mod hci;
mod link;
mod medium;
mod stream;
pub mod time;
mod user_channel;

pub use controller::{Controller, TransportError};
pub use executor::{Executor, Stalled, TaskId};
pub use link::{Fate, Fragment};
pub use medium::{Air, AirConfig, DeviceId};
pub use stream::{StreamTransport, serve};
