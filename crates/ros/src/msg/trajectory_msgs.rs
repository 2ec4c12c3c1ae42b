//! Motions of an arm.

use super::builtin_interfaces::Duration;
use super::std_msgs::Header;

crate::message::messages! {
    "trajectory_msgs";

    /// One way point, in the order of the trajectory's joint names; an empty list says nothing.
    #[derive(Default)]
    JointTrajectoryPoint {
        /// Positions (rad or m).
        positions: Vec<f64>,
        /// Speeds.
        velocities: Vec<f64>,
        /// Accelerations.
        accelerations: Vec<f64>,
        /// Efforts (N m or N).
        effort: Vec<f64>,
        /// When, after the start.
        time_from_start: Duration,
    }

    /// A motion of several joints.
    #[derive(Default)]
    JointTrajectory {
        /// Time of the start, zero for at once.
        header: Header,
        /// Joint names as in the URDF.
        joint_names: Vec<String>,
        /// Way points in order of time.
        points: Vec<JointTrajectoryPoint>,
    }
}
