//! Contact physics of the simulated arm: grasps that slip, break or collide do so here.
//!
//! [`World`] holds the workcell as rigid bodies; [`PhysicsArm`] moves in it behind the same trait as a
//! real arm; [`trial`] carries out one plan and reads the verdict from the physics, not from the plan;
//! [`experiment`] repeats that over seeds; [`recording`] writes what the arm did for a second judge.

pub mod arm;
pub mod experiment;
pub mod jaws;
pub mod recording;
pub mod trial;
pub mod world;

pub use arm::{PhysicsArm, SharedWorld};
pub use world::{Setup, SetupError, Touch, TrueObject, World};
