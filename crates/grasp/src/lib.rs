//! Grasp planning: from an object's pose and record to a tested motion of the arm, or a refusal.
//!
//! ```text
//! Record ---------> candidates --.                          .--> Plan (transfer, approach, lift)
//! GaussianPose ---> margin ------+--> planner --> motion ---+
//! Chain, bodies --> kinematics, collision, path, timing     '--> Refusal (why not)
//!                                     closing: correct after a second look, verify after the lift
//! ```
//!
//! Pure functions over plain data: no device, no clock. The gripper's tip frame has z along the
//! approach, y along the closing of the fingers; the origin is midway between the fingertips.

pub mod candidates;
pub mod closing;
pub mod collision;
pub mod gripper;
pub mod kinematics;
pub mod margin;
mod motion;
pub mod object;
pub mod path;
mod plan;
mod planner;
pub mod timing;

pub use candidates::{Grasp, Hold};
pub use closing::{LiftVerdict, correct, next_best, relative_to_hand, turn_in_sight, verify_lift};
pub use collision::{Clearances, Hit, Obstacle};
pub use kinematics::Arm;
pub use plan::{Plan, Refusal, Rejected};
pub use planner::{Config, Request, Robot, RobotError, plan};
