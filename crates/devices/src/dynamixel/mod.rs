//! Dynamixel servos: packets, control tables, the bus, the pan-tilt driver, and an emulated bus.
//!
//! ```text
//! pan_tilt (PanTilt) -> bus (exchanges) -> packet (frames) -> transport (port, pty, memory)
//!                                                             virtual_bus -> virtual_servo -> Shaft
//! ```
//!
//! Why not a crate: the emulated bus needs the servo's side of both protocols, which none has; and
//! noise before an answer, torn packets and a deadline for the whole exchange must be handled, not
//! left to the caller. Master and servo share one codec of 200 lines that is checked against
//! ROBOTIS' own SDK from both sides.

pub mod bus;
pub mod config;
pub mod model;
pub mod packet;
pub mod pan_tilt;
pub mod transport;
pub mod virtual_bus;
pub mod virtual_servo;

pub use bus::{Bus, BusConfig, BusError};
pub use config::{DynamixelConfig, ServoConfig};
pub use model::Model;
pub use packet::Protocol;
pub use pan_tilt::{DynamixelPanTilt, SharedBus, open_heads};
pub use virtual_bus::{Trouble, VirtualBus};
pub use virtual_servo::{Motor, Shaft, SharedMotor, VirtualServo};

#[cfg(test)]
mod tests;
