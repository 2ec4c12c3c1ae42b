//! The header of stamped messages, and plain text.

use super::builtin_interfaces::Time;

crate::message::messages! {
    "std_msgs";

    /// When and in which frame.
    #[derive(Eq, Default)]
    Header {
        /// When the data was taken.
        stamp: Time,
        /// Name of the frame that coordinates refer to.
        frame_id: std::string::String,
    }

    /// Text, such as a robot's URDF.
    #[derive(Eq, Default)]
    String {
        /// The text.
        data: std::string::String,
    }
}
