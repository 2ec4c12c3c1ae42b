//! The arm and its gripper as the rest of the system sees them.
//!
//! Made to fit ROS 2: [`Arm::execute`] is a `control_msgs/FollowJointTrajectory` goal (its
//! cancellation is [`Cancel`]), [`Arm::grip`] a `control_msgs/GripperCommand` goal,
//! [`Arm::read`] a `joint_states` message. Calls block and are bounded in time.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use vergence_geometry::{JointAngles, Trajectory};

use crate::DeviceError;

/// A stop button that any thread may press; clones share it.
#[derive(Debug, Clone, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Stops whatever runs under this button, now and later.
    pub fn press(&self) {
        self.0.store(true, Ordering::SeqCst);
    }

    /// Whether it was pressed.
    pub fn pressed(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}

/// Angles and speeds of the arm at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmReading {
    /// When the encoders were read.
    pub stamp: Duration,
    /// Angles (rad).
    pub positions: JointAngles,
    /// Speeds (rad/s).
    pub velocities: JointAngles,
}

/// How a motion ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Execution {
    /// At the trajectory's end.
    Reached,
    /// The stop button was pressed; the arm stands still, holding its place.
    Stopped,
    /// The arm felt more than the allowed force on itself and stands still.
    Contact {
        /// What touched, as far as the arm can tell.
        link: String,
        /// The force that it felt (N).
        force: f64,
    },
    /// The arm could not follow the trajectory and stands still.
    Lost {
        /// What the controller said.
        reason: String,
    },
}

/// Limits of one motion.
#[derive(Debug, Clone)]
pub struct MotionLimits {
    /// Stops the motion at once.
    pub cancel: Cancel,
    /// Force on the arm at which it stops by itself (N); infinite where contact is wanted.
    pub contact_force: f64,
    /// Allowed beyond the trajectory's own duration before the call fails with a time-out.
    pub grace: Duration,
}

impl Default for MotionLimits {
    fn default() -> Self {
        // 15 N is below what tips a full cup over at its rim and above a light cable's drag.
        Self { cancel: Cancel::default(), contact_force: 15.0, grace: Duration::from_secs(5) }
    }
}

/// What the gripper shall do, as `control_msgs/GripperCommand`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripCommand {
    /// Opening between the fingers (m).
    pub width: f64,
    /// Largest force of the fingers on what is between them (N).
    pub force: f64,
}

/// What the gripper feels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripperReading {
    /// When it was read.
    pub stamp: Duration,
    /// Opening between the fingers (m).
    pub width: f64,
    /// Force of the fingers on what is between them (N).
    pub force: f64,
    /// The fingers stopped on something before they reached the commanded width.
    pub holding: bool,
}

/// A six-axis arm with a parallel gripper.
pub trait Arm: Send {
    /// Names of the six joints in the order of every [`JointAngles`].
    fn joint_names(&self) -> [String; 6];
    /// Reads the encoders, waiting at most `timeout`.
    fn read(&mut self, timeout: Duration) -> Result<ArmReading, DeviceError>;
    /// Plays a trajectory that starts where the arm stands, and returns when it has come to rest.
    fn execute(
        &mut self,
        trajectory: &Trajectory,
        limits: &MotionLimits,
    ) -> Result<Execution, DeviceError>;
    /// Moves the fingers until they reach the width or hold something with the force.
    fn grip(
        &mut self,
        command: GripCommand,
        timeout: Duration,
    ) -> Result<GripperReading, DeviceError>;
    /// Reads the gripper, waiting at most `timeout`.
    fn gripper(&mut self, timeout: Duration) -> Result<GripperReading, DeviceError>;
}
