//! The tree of frames.

use super::geometry_msgs::TransformStamped;

crate::message::messages! {
    "tf2_msgs";

    /// Edges of the tree of frames, on `/tf` and `/tf_static`.
    #[derive(Default)]
    TFMessage {
        /// The edges.
        transforms: Vec<TransformStamped>,
    }
}
