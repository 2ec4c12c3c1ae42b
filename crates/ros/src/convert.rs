//! Vergence's frames, cameras and poses as ROS 2 messages.
//!
//! In and out: SI units, frames named by the caller. **Order of covariances**: ROS's
//! `PoseWithCovariance` has translation before rotation, Vergence's tangent rotation before
//! translation; both rotate about the fixed axes of the parent frame, so the blocks just change
//! places.

use std::f64::consts::PI;
use std::time::Duration;

use nalgebra::{Matrix3, Matrix6, Point3, Quaternion, UnitQuaternion};
use vergence_geometry::{Camera, GaussianPoint, GaussianPose, Trajectory, Transform, Waypoint};
use vergence_imaging::{CodecError, Frame, codec};

use crate::msg::geometry_msgs::{
    self, Point, PointStamped, Pose, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped,
    TransformStamped, Vector3,
};
use crate::msg::sensor_msgs::{CameraInfo, CompressedImage, Image, JointState, RegionOfInterest};
use crate::msg::std_msgs::Header;
use crate::msg::trajectory_msgs::{JointTrajectory, JointTrajectoryPoint};

/// Index in ROS's order (translation, rotation) of each index of ours (rotation, translation).
const ROS_FROM_OURS: [usize; 6] = [3, 4, 5, 0, 1, 2];

/// A header.
pub fn header(stamp: Duration, frame_id: &str) -> Header {
    Header { stamp: stamp.into(), frame_id: frame_id.into() }
}

/// A frame as plain `mono8` pixels, stamped with the start of its exposure.
pub fn image(frame: &Frame, frame_id: &str) -> Image {
    Image {
        header: header(frame.stamp, frame_id),
        height: frame.image.height() as u32,
        width: frame.image.width() as u32,
        encoding: "mono8".into(),
        is_bigendian: 0,
        step: frame.image.width() as u32,
        data: frame.image.data().into(),
    }
}

/// A frame as JPEG of the given quality (1 to 100).
pub fn jpeg(frame: &Frame, frame_id: &str, quality: u8) -> Result<CompressedImage, CodecError> {
    let data = codec::encode_jpeg(&frame.image, quality)?;
    Ok(CompressedImage { header: header(frame.stamp, frame_id), format: "jpeg".into(), data })
}

/// A camera with its lens.
pub fn camera_info(camera: &Camera, stamp: Duration, frame_id: &str) -> CameraInfo {
    let Camera { fx, fy, cx, cy, distortion: d, .. } = *camera;
    CameraInfo {
        header: header(stamp, frame_id),
        height: camera.height as u32,
        width: camera.width as u32,
        distortion_model: "plumb_bob".into(),
        d: vec![d.k1, d.k2, d.p1, d.p2, d.k3],
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        binning_x: 0,
        binning_y: 0,
        roi: RegionOfInterest::default(),
    }
}

/// Joint positions (rad or m) by name.
pub fn joint_state(stamp: Duration, joints: &[(&str, f64)]) -> JointState {
    JointState {
        header: header(stamp, ""),
        name: joints.iter().map(|(name, _)| name.to_string()).collect(),
        position: joints.iter().map(|(_, position)| *position).collect(),
        ..JointState::default()
    }
}

/// A motion of six joints as a controller is told it; `start` is when it begins.
pub fn joint_trajectory(
    trajectory: &Trajectory,
    names: &[String; 6],
    start: Duration,
) -> JointTrajectory {
    let point = |waypoint: &Waypoint| JointTrajectoryPoint {
        positions: waypoint.positions.to_vec(),
        velocities: waypoint.velocities.to_vec(),
        time_from_start: Duration::from_secs_f64(waypoint.time.max(0.0)).into(),
        ..JointTrajectoryPoint::default()
    };
    JointTrajectory {
        header: header(start, ""),
        joint_names: names.to_vec(),
        points: trajectory.waypoints.iter().map(point).collect(),
    }
}

/// An edge of the tree of frames.
pub fn transform_stamped(
    parent_from_child: &Transform,
    stamp: Duration,
    parent: &str,
    child: &str,
) -> TransformStamped {
    let t = parent_from_child.translation.vector;
    TransformStamped {
        header: header(stamp, parent),
        child_frame_id: child.into(),
        transform: geometry_msgs::Transform {
            translation: Vector3 { x: t.x, y: t.y, z: t.z },
            rotation: quaternion(&parent_from_child.rotation),
        },
    }
}

/// The transform of an edge; `None` when its numbers are no transform.
pub fn parent_from_child(edge: &TransformStamped) -> Option<Transform> {
    let (t, q) = (edge.transform.translation, edge.transform.rotation);
    let quaternion = Quaternion::new(q.w, q.x, q.y, q.z);
    let finite = [t.x, t.y, t.z].iter().all(|v| v.is_finite());
    // Other programs round quaternions, to 32 bits at worst.
    let unit = (quaternion.norm() - 1.0).abs() < 1e-3;
    (finite && unit).then(|| {
        let translation = nalgebra::Translation3::new(t.x, t.y, t.z);
        Transform::from_parts(translation, UnitQuaternion::from_quaternion(quaternion))
    })
}

/// A pose without its covariance.
pub fn pose_stamped(pose: &Transform, stamp: Duration, frame_id: &str) -> PoseStamped {
    PoseStamped { header: header(stamp, frame_id), pose: pose_message(pose) }
}

/// A pose with its covariance.
pub fn pose_with_covariance(
    estimate: &GaussianPose,
    stamp: Duration,
    frame_id: &str,
) -> PoseWithCovarianceStamped {
    PoseWithCovarianceStamped {
        header: header(stamp, frame_id),
        pose: PoseWithCovariance {
            pose: pose_message(&estimate.pose),
            covariance: ros_covariance(&estimate.covariance),
        },
    }
}

/// A point without its covariance: ROS has no message for both.
pub fn point_stamped(point: &Point3<f64>, stamp: Duration, frame_id: &str) -> PointStamped {
    PointStamped { header: header(stamp, frame_id), point: point_message(point) }
}

/// A point with its covariance, as a pose whose orientation means nothing: its variance is that of
/// an angle of which nothing is known (uniform over a turn, pi^2 / 3).
pub fn point_with_covariance(
    estimate: &GaussianPoint,
    stamp: Duration,
    frame_id: &str,
) -> PoseWithCovarianceStamped {
    let mut covariance = Matrix6::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * (PI * PI / 3.0)));
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&estimate.covariance);
    let pose = Transform::from_parts(estimate.position.into(), UnitQuaternion::identity());
    pose_with_covariance(&GaussianPose { pose, covariance }, stamp, frame_id)
}

fn ros_covariance(ours: &Matrix6<f64>) -> [f64; 36] {
    let mut ros = [0.0; 36];
    for row in 0..6 {
        for column in 0..6 {
            ros[6 * ROS_FROM_OURS[row] + ROS_FROM_OURS[column]] = ours[(row, column)];
        }
    }
    ros
}

fn pose_message(pose: &Transform) -> Pose {
    Pose {
        position: point_message(&pose.translation.vector.into()),
        orientation: quaternion(&pose.rotation),
    }
}

fn point_message(point: &Point3<f64>) -> Point {
    Point { x: point.x, y: point.y, z: point.z }
}

fn quaternion(rotation: &UnitQuaternion<f64>) -> geometry_msgs::Quaternion {
    geometry_msgs::Quaternion { x: rotation.i, y: rotation.j, z: rotation.k, w: rotation.w }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covariance_blocks_change_places() {
        // Rotation about x has variance 1, shift along z variance 6; they are correlated by 9.
        let mut covariance = Matrix6::from_diagonal(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0].into());
        covariance[(0, 5)] = 9.0;
        covariance[(5, 0)] = 9.0;
        let estimate = GaussianPose { pose: Transform::translation(0.1, 0.2, 0.3), covariance };
        let message = pose_with_covariance(&estimate, Duration::from_millis(1500), "base");
        let diagonal: Vec<f64> = (0..6).map(|i| message.pose.covariance[7 * i]).collect();
        assert_eq!(diagonal, [4.0, 5.0, 6.0, 1.0, 2.0, 3.0]);
        // z is third in ROS's order, rotation about x fourth.
        assert_eq!(
            (message.pose.covariance[6 * 2 + 3], message.pose.covariance[6 * 3 + 2]),
            (9.0, 9.0)
        );
        assert_eq!(message.pose.covariance.iter().filter(|v| **v != 0.0).count(), 8);
        assert_eq!((message.header.stamp.sec, message.header.stamp.nanosec), (1, 500_000_000));
        assert_eq!(message.pose.pose.position, Point { x: 0.1, y: 0.2, z: 0.3 });
    }

    #[test]
    fn a_point_keeps_its_covariance_in_the_translation_block() {
        let covariance = Matrix3::new(1.0, 0.1, 0.2, 0.1, 2.0, 0.3, 0.2, 0.3, 3.0);
        let estimate = GaussianPoint { position: Point3::new(1.0, 2.0, 3.0), covariance };
        let message = point_with_covariance(&estimate, Duration::ZERO, "base").pose;
        assert_eq!(message.covariance[..3], [1.0, 0.1, 0.2]);
        assert_eq!(message.covariance[6..9], [0.1, 2.0, 0.3]);
        assert!((message.covariance[21] - 3.289_868).abs() < 1e-6);
    }

    #[test]
    fn a_transform_survives_and_nonsense_does_not() {
        let rotation = UnitQuaternion::from_euler_angles(0.3, -0.2, 2.0);
        let sent = Transform::from_parts([0.1, -0.2, 0.3].into(), rotation);
        let mut edge = transform_stamped(&sent, Duration::ZERO, "base", "cup");
        let back = parent_from_child(&edge).unwrap();
        assert!((back.to_homogeneous() - sent.to_homogeneous()).norm() < 1e-12);
        edge.transform.rotation.w = f64::NAN;
        assert!(parent_from_child(&edge).is_none());
        edge.transform.rotation = geometry_msgs::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 0.0 };
        assert!(parent_from_child(&edge).is_none());
    }
}
