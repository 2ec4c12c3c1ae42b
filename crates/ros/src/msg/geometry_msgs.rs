//! Points, poses and transforms (m, unit quaternions).

use super::std_msgs::Header;

crate::message::messages! {
    "geometry_msgs";

    /// A position (m).
    #[derive(Copy, Default)]
    Point {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    }

    /// A direction or displacement.
    #[derive(Copy, Default)]
    Vector3 {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    }

    /// A rotation as a unit quaternion.
    #[derive(Copy)]
    Quaternion {
        /// Imaginary part i.
        x: f64,
        /// Imaginary part j.
        y: f64,
        /// Imaginary part k.
        z: f64,
        /// Real part.
        w: f64,
    }

    /// A position and an orientation.
    #[derive(Copy, Default)]
    Pose {
        /// Where.
        position: Point,
        /// Which way round.
        orientation: Quaternion,
    }

    /// A pose in a frame, at a time.
    #[derive(Default)]
    PoseStamped {
        /// Time and frame.
        header: Header,
        /// The pose.
        pose: Pose,
    }

    /// A pose and how sure it is.
    #[derive(Copy)]
    PoseWithCovariance {
        /// The pose.
        pose: Pose,
        /// Row-major 6x6 in the order x, y, z, rotation about x, about y, about z (fixed axes).
        covariance: [f64; 36],
    }

    /// The same in a frame, at a time.
    #[derive(Default)]
    PoseWithCovarianceStamped {
        /// Time and frame.
        header: Header,
        /// The pose.
        pose: PoseWithCovariance,
    }

    /// A position in a frame, at a time.
    #[derive(Default)]
    PointStamped {
        /// Time and frame.
        header: Header,
        /// The position.
        point: Point,
    }

    /// `parent_from_child`.
    #[derive(Copy, Default)]
    Transform {
        /// Origin of the child in the parent.
        translation: Vector3,
        /// Orientation of the child in the parent.
        rotation: Quaternion,
    }

    /// One edge of the tree of frames.
    #[derive(Default)]
    TransformStamped {
        /// Time and parent frame.
        header: Header,
        /// Child frame.
        child_frame_id: String,
        /// `parent_from_child`.
        transform: Transform,
    }
}

impl Default for Quaternion {
    /// No rotation.
    fn default() -> Self {
        Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
    }
}

impl Default for PoseWithCovariance {
    fn default() -> Self {
        PoseWithCovariance { pose: Pose::default(), covariance: [0.0; 36] }
    }
}
