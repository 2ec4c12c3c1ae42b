//! Serial chains of revolute joints: a head's pan and tilt, an arm's six axes.
//!
//! A chain is what a URDF says between two links once its fixed joints are folded in: for every
//! joint a fixed transform from its parent, then a rotation about an axis; last a fixed transform
//! to the tip (an optical frame, a tool).

use nalgebra::{Matrix6xX, Translation3, Unit, UnitQuaternion, Vector3};

use crate::Transform;

/// Range and speed of a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Smallest angle (rad).
    pub lower: f64,
    /// Largest angle (rad).
    pub upper: f64,
    /// Largest speed (rad/s).
    pub velocity: f64,
}

impl Limits {
    /// True when the angle lies within the range.
    pub fn contains(&self, angle: f64) -> bool {
        (self.lower..=self.upper).contains(&angle)
    }
}

/// One revolute joint.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// The URDF's joint name.
    pub name: String,
    /// Fixed transform from the parent (the joint before, or the chain's root) at angle zero.
    pub parent_from_joint: Transform,
    /// Axis in the joint's frame.
    pub axis: Unit<Vector3<f64>>,
    /// Range and speed.
    pub limits: Limits,
}

/// A serial chain from a root link to a tip link.
#[derive(Debug, Clone, PartialEq)]
pub struct Chain {
    /// Joints from root to tip.
    pub joints: Vec<Joint>,
    /// Fixed transform from the last joint's moving frame to the tip.
    pub last_from_tip: Transform,
}

impl Chain {
    /// `root_from_tip` at the given joint angles (rad), one an axis.
    ///
    /// # Panics
    /// When the number of angles is not the number of joints: a programming error.
    pub fn forward(&self, angles: &[f64]) -> Transform {
        self.frames(angles).last().copied().unwrap_or_else(Transform::identity) * self.last_from_tip
    }

    /// `root_from_joint` of every joint's moving frame, in order.
    ///
    /// # Panics
    /// When the number of angles is not the number of joints: a programming error.
    pub fn frames(&self, angles: &[f64]) -> Vec<Transform> {
        assert_eq!(angles.len(), self.joints.len(), "one angle a joint");
        let mut root_from = Transform::identity();
        self.joints
            .iter()
            .zip(angles)
            .map(|(joint, &angle)| {
                let turn = UnitQuaternion::from_axis_angle(&joint.axis, angle);
                root_from = root_from
                    * joint.parent_from_joint
                    * Transform::from_parts(Translation3::identity(), turn);
                root_from
            })
            .collect()
    }

    /// Geometric Jacobian in the root frame: column k is `(rotation, translation)` of the tip per
    /// radian of joint k, in the tangent order of [`crate::gaussian`].
    pub fn jacobian(&self, angles: &[f64]) -> Matrix6xX<f64> {
        let frames = self.frames(angles);
        let tip = self.forward(angles).translation.vector;
        let mut jacobian = Matrix6xX::zeros(frames.len());
        for (k, (frame, joint)) in frames.iter().zip(&self.joints).enumerate() {
            let axis = frame.rotation * joint.axis.into_inner();
            let lever = axis.cross(&(tip - frame.translation.vector));
            jacobian.fixed_view_mut::<3, 1>(0, k).copy_from(&axis);
            jacobian.fixed_view_mut::<3, 1>(3, k).copy_from(&lever);
        }
        jacobian
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussian::difference;
    use proptest::prelude::*;

    fn head() -> Chain {
        let limits = Limits { lower: -2.0, upper: 2.0, velocity: 3.6 };
        let joint = |name: &str, x: f64, z: f64, axis| Joint {
            name: name.into(),
            parent_from_joint: Transform::translation(x, 0.0, z),
            axis,
            limits,
        };
        Chain {
            joints: vec![
                joint("pan", 0.0, 0.5, Vector3::z_axis()),
                joint("tilt", 0.01, 0.04, Vector3::y_axis()),
            ],
            last_from_tip: Transform::from_parts(
                Translation3::new(0.02, 0.0, 0.01),
                crate::optical_from_body().inverse(),
            ),
        }
    }

    #[test]
    fn pan_is_left_and_tilt_is_down() {
        let forward = |pan, tilt| head().forward(&[pan, tilt]).rotation * Vector3::z();
        assert!((forward(0.0, 0.0) - Vector3::x()).norm() < 1e-12);
        assert!(forward(0.3, 0.0).y > 0.2, "positive pan looks left");
        assert!(forward(0.0, 0.3).z < -0.2, "positive tilt looks down");
    }

    proptest! {
        #[test]
        fn jacobian_equals_finite_differences(pan in -1.5f64..1.5, tilt in -1.0f64..1.0) {
            let (chain, h) = (head(), 1e-6);
            let jacobian = chain.jacobian(&[pan, tilt]);
            for k in 0..2 {
                let mut ahead = [pan, tilt];
                ahead[k] += h;
                let numeric = difference(&chain.forward(&[pan, tilt]), &chain.forward(&ahead)) / h;
                prop_assert!((numeric - jacobian.column(k)).norm() < 1e-5, "{numeric} {jacobian}");
            }
        }
    }
}
