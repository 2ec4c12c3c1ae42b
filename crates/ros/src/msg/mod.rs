//! The ROS 2 messages that Vergence reads and writes, by package, as in the ROS 2 definitions.

pub mod builtin_interfaces;
pub mod geometry_msgs;
pub mod sensor_msgs;
pub mod std_msgs;
pub mod tf2_msgs;
pub mod trajectory_msgs;
