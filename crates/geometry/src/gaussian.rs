//! Points and poses with a covariance.
//!
//! The tangent of a pose `a_from_b` is `(w, v)`: a rotation vector `w` (rad) about the axes of the
//! parent frame `a`, at the origin of `b`, and a shift `v` (m) along the axes of `a`:
//!
//! ```text
//! perturb(a_from_b, (w, v)):  R -> exp(w) R,   t -> t + v
//! ```
//!
//! Rotation and translation do not mix (unlike the SE(3) exponential), so the lower right 3x3 block
//! of a covariance is the covariance of the object's position, and it reads without a table.

use nalgebra::{Matrix3, Matrix6, Point3, UnitQuaternion, Vector3, Vector6};

use crate::Transform;

/// A point with its covariance in the same frame (m, m^2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussianPoint {
    /// Where it is.
    pub position: Point3<f64>,
    /// Covariance of the position in the frame of `position`.
    pub covariance: Matrix3<f64>,
}

/// A pose with its covariance in the tangent order of this module: rotation, translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussianPose {
    /// `parent_from_body`.
    pub pose: Transform,
    /// Covariance of the tangent `(w, v)`; rad^2, rad m, m^2.
    pub covariance: Matrix6<f64>,
}

/// Moves a pose along a tangent vector, see the module's text.
pub fn perturb(pose: &Transform, tangent: &Vector6<f64>) -> Transform {
    let w: Vector3<f64> = tangent.fixed_rows::<3>(0).into_owned();
    let v: Vector3<f64> = tangent.fixed_rows::<3>(3).into_owned();
    Transform::from_parts(
        (pose.translation.vector + v).into(),
        UnitQuaternion::from_scaled_axis(w) * pose.rotation,
    )
}

/// The tangent that takes `from` to `to`: `perturb(from, difference(from, to)) == to`.
pub fn difference(from: &Transform, to: &Transform) -> Vector6<f64> {
    let w = (to.rotation * from.rotation.inverse()).scaled_axis();
    let v = to.translation.vector - from.translation.vector;
    Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z)
}

/// The matrix `[v]x` with `[v]x u = v x u`.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

impl GaussianPose {
    /// Normalised estimation error squared of `truth` under this estimate: chi-squared with six
    /// degrees of freedom when the covariance is honest. `None` when the covariance is singular.
    pub fn nees(&self, truth: &Transform) -> Option<f64> {
        let error = difference(&self.pose, truth);
        Some((error.transpose() * self.covariance.cholesky()?.inverse() * error).x)
    }
}

impl GaussianPoint {
    /// Normalised estimation error squared: chi-squared with three degrees of freedom when honest.
    pub fn nees(&self, truth: &Point3<f64>) -> Option<f64> {
        let error = truth - self.position;
        Some((error.transpose() * self.covariance.cholesky()?.inverse() * error).x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tangent() -> impl Strategy<Value = Vector6<f64>> {
        prop::array::uniform6(-1.0f64..1.0).prop_map(|v| Vector6::from_row_slice(&v))
    }

    proptest! {
        #[test]
        fn difference_inverts_perturb(a in tangent(), b in tangent()) {
            let pose = perturb(&Transform::identity(), &a);
            let back = difference(&pose, &perturb(&pose, &b));
            prop_assert!((back - b).norm() < 1e-9, "{back} against {b}");
        }
    }

    #[test]
    fn nees_of_a_known_error() {
        let estimate =
            GaussianPose { pose: Transform::identity(), covariance: Matrix6::identity() * 4.0 };
        let truth = perturb(&estimate.pose, &Vector6::new(0.0, 0.0, 2.0, 0.0, 2.0, 0.0));
        assert!((estimate.nees(&truth).unwrap() - 2.0).abs() < 1e-12);
    }
}
