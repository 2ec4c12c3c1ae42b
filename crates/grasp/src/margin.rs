//! Is the pose sure enough for this grasp?
//!
//! In: the object's pose with covariance, a grasp. Out: for each of the tip's axes the half axis of
//! the 95 % ellipsoid of position at the fingers, against the error that the grasp bears.
//!
//! The position of a point of the object at `r` from its origin has the covariance `J S J'` with
//! `J = [-[r]x P | I]` in the tangent order of `geometry::gaussian`; `P` removes the turn about an
//! axis of symmetry, which moves nothing.

use nalgebra::{Matrix3, Matrix3x6, Vector3};
use vergence_geometry::{GaussianPose, Transform, gaussian::skew};
use vergence_tag::{Record, Shape};

use crate::candidates::Grasp;

/// Square root of the 95 % quantile of chi-squared with three degrees of freedom.
pub const ELLIPSOID_95: f64 = 2.795_483;

/// How a grasp's reserves compare with the pose's uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Margin {
    /// Reserve over need on the worst axis; the grasp fits at one and above.
    pub ratio: f64,
    /// The worst axis: "across", "closing", "approach".
    pub axis: &'static str,
    /// What it bears there (m).
    pub reserve: f64,
    /// What it must bear: half axis of the ellipsoid and the arm's own error (m).
    pub needed: f64,
}

/// The margin of a grasp; `tolerance` is the arm's own error (m).
pub fn margin(record: &Record, object: &GaussianPose, grasp: &Grasp, tolerance: f64) -> Margin {
    let base_from_tip = object.pose * grasp.object_from_tip;
    let axes = base_from_tip.rotation.to_rotation_matrix();
    let tip = base_from_tip.translation.vector;
    let root = tip - axes * Vector3::z() * grasp.levers.contact;
    let covariances = [tip, root].map(|p| at_point(record, object, &p));
    let sides = [
        ("across", grasp.reserve.across, axes * Vector3::x()),
        ("closing", grasp.reserve.closing, axes * Vector3::y()),
        ("approach", grasp.reserve.approach, axes * Vector3::z()),
    ];
    let of_axis = |(axis, reserve, d): (&'static str, f64, Vector3<f64>)| {
        let variance = covariances.iter().map(|c| d.dot(&(c * d))).fold(0.0, f64::max);
        let needed = ELLIPSOID_95 * variance.sqrt() + tolerance;
        Margin { ratio: reserve / needed, axis, reserve, needed }
    };
    let [a, b, c] = sides.map(of_axis);
    [b, c].into_iter().fold(a, |worst, m| if m.ratio < worst.ratio { m } else { worst })
}

/// Covariance of the position of a point that is fixed to the object, at `point` in base (m^2).
fn at_point(record: &Record, object: &GaussianPose, point: &Vector3<f64>) -> Matrix3<f64> {
    let lever = point - object.pose.translation.vector;
    let mut jacobian = Matrix3x6::zeros();
    let turn = -skew(&lever) * observable(record, &object.pose);
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    jacobian.fixed_view_mut::<3, 3>(0, 3).fill_with_identity();
    jacobian * object.covariance * jacobian.transpose()
}

/// Projector on the turns that move the shape's surface.
fn observable(record: &Record, base_from_object: &Transform) -> Matrix3<f64> {
    match record.shape {
        Shape::Sphere { .. } => Matrix3::zeros(),
        Shape::Cylinder { .. } | Shape::Cup { .. } => {
            let axis = base_from_object.rotation * Vector3::z();
            Matrix3::identity() - axis * axis.transpose()
        }
        _ => Matrix3::identity(),
    }
}
