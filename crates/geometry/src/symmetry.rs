//! Symmetry groups of objects, so that a pose result can say which turns cannot be told apart.

use nalgebra::{UnitQuaternion, Vector3};

use crate::Transform;

/// The motions of the object frame that map the object onto itself.
#[derive(Debug, Clone, PartialEq)]
pub enum Symmetry {
    /// A finite set, the identity included: turns about axes that need not pass the frame's origin.
    Finite(Vec<Transform>),
    /// Any turn about the object's z axis; when `flip`, also upside down.
    Revolution {
        /// Top and bottom are alike.
        flip: bool,
    },
    /// Any rotation (a sphere).
    Full,
}

impl Symmetry {
    /// No symmetry but the identity.
    pub fn none() -> Self {
        Symmetry::Finite(vec![Transform::identity()])
    }

    /// Smallest rotation angle (rad) between two attitudes when symmetric ones count as equal.
    pub fn angle_between(&self, a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
        match self {
            Symmetry::Finite(motions) => {
                motions.iter().map(|s| a.angle_to(&(b * s.rotation))).fold(f64::INFINITY, f64::min)
            }
            Symmetry::Revolution { flip } => {
                let cos = (a * Vector3::z()).dot(&(b * Vector3::z()));
                let cos = if *flip { cos.abs() } else { cos };
                cos.clamp(-1.0, 1.0).acos()
            }
            Symmetry::Full => 0.0,
        }
    }

    /// The pose among `pose`'s symmetric twins that is nearest in rotation to `reference`; for
    /// solids of revolution the turn about the axis that cannot be seen is taken from `reference`.
    pub fn nearest(&self, pose: &Transform, reference: &Transform) -> Transform {
        let (a, b) = (pose.rotation, reference.rotation);
        let rotation = match self {
            Symmetry::Finite(motions) => {
                let off = |p: &Transform| p.rotation.angle_to(&b);
                let twins = motions.iter().map(|s| pose * s);
                return twins.min_by(|x, y| off(x).total_cmp(&off(y))).unwrap_or(*pose);
            }
            Symmetry::Revolution { flip } => {
                let axis = a * Vector3::z();
                let wanted = b * Vector3::z();
                let axis = if *flip && axis.dot(&wanted) < 0.0 { -axis } else { axis };
                UnitQuaternion::rotation_between(&wanted, &axis).map_or(a, |turn| turn * b)
            }
            Symmetry::Full => b,
        };
        Transform::from_parts(pose.translation, rotation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_about_the_axis_does_not_count() {
        let a = UnitQuaternion::from_euler_angles(0.2, 0.3, 0.4);
        let turned = a * UnitQuaternion::from_euler_angles(0.0, 0.0, 1.0);
        let flipped = a * UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, 0.0);
        assert!(Symmetry::Revolution { flip: false }.angle_between(&a, &turned) < 1e-6);
        assert!(Symmetry::Revolution { flip: false }.angle_between(&a, &flipped) > 3.0);
        assert!(Symmetry::Revolution { flip: true }.angle_between(&a, &flipped) < 1e-6);
        let pose = |rotation| Transform::from_parts(Default::default(), rotation);
        let near = Symmetry::Revolution { flip: true }.nearest(&pose(flipped), &pose(turned));
        assert!(near.rotation.angle_to(&turned) < 1e-6);
    }

    #[test]
    fn an_axis_beside_the_origin_takes_the_origin_along() {
        // Half a turn about the vertical through (1, 0, 0).
        let half = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
        let swap = Transform::from_parts(Vector3::new(2.0, 0.0, 0.0).into(), half);
        let symmetry = Symmetry::Finite(vec![Transform::identity(), swap]);
        let pose = Transform::from_parts(
            Vector3::new(0.3, 0.2, 0.1).into(),
            UnitQuaternion::from_euler_angles(0.2, 0.3, 0.4),
        );
        let near = symmetry.nearest(&(pose * swap), &pose);
        assert!((near.translation.vector - pose.translation.vector).norm() < 1e-12);
        assert!(near.rotation.angle_to(&pose.rotation) < 1e-6);
    }
}
