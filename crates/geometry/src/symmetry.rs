//! Symmetry groups of objects, so that a pose result can say which turns cannot be told apart.

use nalgebra::{UnitQuaternion, Vector3};

use crate::Transform;

/// The rotations of the object frame that map the object onto itself.
#[derive(Debug, Clone, PartialEq)]
pub enum Symmetry {
    /// A finite set, the identity included.
    Finite(Vec<UnitQuaternion<f64>>),
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
        Symmetry::Finite(vec![UnitQuaternion::identity()])
    }

    /// The rotations of a box of these sides (m) onto itself; sides that differ by less than
    /// `tolerance` count as equal.
    pub fn of_box(sides: [f64; 3], tolerance: f64) -> Self {
        let mut rotations: Vec<UnitQuaternion<f64>> = Vec::new();
        let permutations = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
        for p in permutations {
            if (0..3).any(|k| (sides[p[k]] - sides[k]).abs() > tolerance) {
                continue;
            }
            for signs in 0..8u8 {
                let mut m = nalgebra::Matrix3::zeros();
                for k in 0..3 {
                    m[(k, p[k])] = if signs >> k & 1 == 0 { 1.0 } else { -1.0 };
                }
                if m.determinant() > 0.0 {
                    let rotation = nalgebra::Rotation3::from_matrix_unchecked(m);
                    rotations.push(UnitQuaternion::from_rotation_matrix(&rotation));
                }
            }
        }
        rotations.sort_by(|a, b| a.angle().total_cmp(&b.angle()));
        Symmetry::Finite(rotations)
    }

    /// Smallest rotation angle (rad) between two attitudes when symmetric ones count as equal.
    pub fn angle_between(&self, a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
        match self {
            Symmetry::Finite(rotations) => {
                rotations.iter().map(|s| a.angle_to(&(b * s))).fold(f64::INFINITY, f64::min)
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
            Symmetry::Finite(rotations) => rotations
                .iter()
                .map(|s| a * s)
                .min_by(|x, y| x.angle_to(&b).total_cmp(&y.angle_to(&b)))
                .unwrap_or(a),
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
    fn boxes_have_four_eight_and_twenty_four_rotations() {
        let count = |sides| match Symmetry::of_box(sides, 1e-4) {
            Symmetry::Finite(r) => r.len(),
            _ => 0,
        };
        assert_eq!(count([0.1, 0.2, 0.3]), 4);
        assert_eq!(count([0.1, 0.1, 0.3]), 8);
        assert_eq!(count([0.1, 0.1, 0.1]), 24);
    }

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
}
