//! Find an object by asking it: the orchestration of Vergence over device traits only.
//!
//! [`System`] holds a robot's opened devices and its geometry. [`find`] runs the nine steps of the
//! paper on it: radio, blink, search, centring, triangulation, pictures, recognition. It sees
//! pixels, encoder angles and radio packets and nothing else; whether wires or the simulator
//! deliver them is decided by who opened the devices. [`grasp()`] goes on from there: plan, reach, look again, close,
//! lift, and look whether the object came along. [`collect`] looks at a light from all sides for the
//! heads' self-calibration. What happens on the way is told to an
//! [`Observer`] (progress, pictures, recordings), the outcome is a [`Report`].

pub mod event;
mod find;
mod grasp;
pub mod report;
mod system;

pub use event::{Event, Observer};
pub use find::{
    CollectConfig, CollectError, FindConfig, LightMover, Method, Placed, Session, collect, find,
    names,
};
pub use grasp::{GraspConfig, grasp};
pub use report::Report;
pub use system::{Hand, System, SystemError};
