//! The tree of frames of a robot: its URDF and joint positions in, `/tf` and `/tf_static` out.

use std::time::Duration;

use nalgebra::{Unit, UnitQuaternion, Vector3};
use urdf_rs::{Joint, JointType};
use vergence_devices::Description;
use vergence_devices::description::transform;
use vergence_geometry::Transform;

use crate::convert::transform_stamped;
use crate::msg::tf2_msgs::TFMessage;

/// The edges that never change: the URDF's fixed joints.
pub fn fixed_frames(robot: &Description) -> TFMessage {
    let joints = robot.robot().joints.iter();
    let fixed = joints.filter(|joint| matches!(joint.joint_type, JointType::Fixed));
    TFMessage { transforms: fixed.map(|joint| edge(joint, Duration::ZERO, 0.0)).collect() }
}

/// The edges of the joints that are named, at the positions given (rad, m for prismatic joints).
/// Names that the URDF does not have are left out.
pub fn moving_frames(robot: &Description, stamp: Duration, joints: &[(&str, f64)]) -> TFMessage {
    let edges = joints.iter().filter_map(|(name, position)| {
        let joint = robot.robot().joints.iter().find(|joint| joint.name == *name)?;
        Some(edge(joint, stamp, *position))
    });
    TFMessage { transforms: edges.collect() }
}

fn edge(
    joint: &Joint,
    stamp: Duration,
    position: f64,
) -> crate::msg::geometry_msgs::TransformStamped {
    let parent_from_child = transform(&joint.origin) * motion(joint, position);
    transform_stamped(&parent_from_child, stamp, &joint.parent.link, &joint.child.link)
}

fn motion(joint: &Joint, position: f64) -> Transform {
    let Some(axis) = Unit::try_new(Vector3::from(joint.axis.xyz.0), 1e-9) else {
        return Transform::identity();
    };
    match joint.joint_type {
        JointType::Revolute | JointType::Continuous => Transform::from_parts(
            Default::default(),
            UnitQuaternion::from_axis_angle(&axis, position),
        ),
        JointType::Prismatic => {
            Transform::from_parts((axis.into_inner() * position).into(), UnitQuaternion::identity())
        }
        _ => Transform::identity(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::convert::parent_from_child;
    use std::path::Path;

    const URDF: &str = r#"<robot name="r"><link name="base"/><link name="mast"/><link name="pan"/>
        <link name="tilt"/><link name="eye"/>
        <joint name="m" type="fixed"><parent link="base"/><child link="mast"/><origin xyz="0 0.1 0.5"/></joint>
        <joint name="p" type="revolute"><parent link="mast"/><child link="pan"/><axis xyz="0 0 1"/>
          <limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
        <joint name="t" type="revolute"><parent link="pan"/><child link="tilt"/><axis xyz="0 1 0"/>
          <origin xyz="0.02 0 0"/><limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
        <joint name="e" type="fixed"><parent link="tilt"/><child link="eye"/>
          <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint></robot>"#;

    #[test]
    fn the_edges_lead_where_the_chain_leads() {
        let robot = Description::parse(URDF, Path::new("r.urdf")).unwrap();
        let (pan, tilt) = (0.4, -0.3);
        let mut edges = fixed_frames(&robot).transforms;
        edges.extend(
            moving_frames(&robot, Duration::ZERO, &[("p", pan), ("t", tilt), ("?", 1.0)])
                .transforms,
        );
        assert_eq!(edges.len(), 4);
        // Walk from the eye to the base over the edges, as tf does.
        let (mut frame, mut base_from_eye) = ("eye".to_string(), Transform::identity());
        while frame != "base" {
            let edge = edges.iter().find(|edge| edge.child_frame_id == frame).unwrap();
            base_from_eye = parent_from_child(edge).unwrap() * base_from_eye;
            frame = edge.header.frame_id.clone();
        }
        let expected = robot.chain("base", "eye").unwrap().forward(&[pan, tilt]);
        let difference = base_from_eye.to_homogeneous() - expected.to_homogeneous();
        assert!(difference.norm() < 1e-12, "{difference}");
    }
}
