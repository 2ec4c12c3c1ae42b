//! Second look, measurement relative to the hand, and the check after the lift.

#![allow(clippy::unwrap_used)]

use nalgebra::{Matrix3, Matrix6, Point3, Translation3, Vector3};
use vergence_geometry::{GaussianPoint, GaussianPose, Transform};
use vergence_grasp::{LiftVerdict, relative_to_hand, verify_lift};

fn at(z: f64, sigma: f64) -> GaussianPoint {
    GaussianPoint {
        position: Point3::new(0.6, 0.0, z),
        covariance: Matrix3::identity() * sigma * sigma,
    }
}

#[test]
fn the_lift_is_believed_only_when_the_landmark_moved_with_the_hand() {
    let up: Transform = Translation3::new(0.0, 0.0, 0.1).into();
    assert_eq!(verify_lift(&at(0.05, 0.002), &at(0.149, 0.002), &up), LiftVerdict::Held);
    assert_eq!(verify_lift(&at(0.05, 0.002), &at(0.051, 0.002), &up), LiftVerdict::Left);
    let halfway = verify_lift(&at(0.05, 0.002), &at(0.10, 0.002), &up);
    assert!(matches!(halfway, LiftVerdict::Slipped { by } if (by.z + 0.05).abs() < 1e-9));
    assert_eq!(verify_lift(&at(0.05, 0.05), &at(0.149, 0.05), &up), LiftVerdict::Unclear);
    let still = Transform::identity();
    assert_eq!(verify_lift(&at(0.05, 0.002), &at(0.05, 0.002), &still), LiftVerdict::Unclear);
    let nan = at(f64::NAN, 0.002);
    assert_ne!(verify_lift(&at(0.05, 0.002), &nan, &up), LiftVerdict::Held);
}

#[test]
fn what_the_heads_get_wrong_alike_cancels() {
    let truth = Vector3::new(0.6, 0.1, 0.05);
    let hand = Point3::new(0.55, 0.1, 0.15);
    let bias = Vector3::new(0.006, -0.004, 0.003);
    let seen = GaussianPose {
        pose: Translation3::from(truth + bias).into(),
        covariance: Matrix6::identity() * 1e-4,
    };
    let difference = Matrix3::identity() * 1e-6;
    let corrected = relative_to_hand(&seen, &hand, &(hand + bias), &difference);
    assert!((corrected.pose.translation.vector - truth).norm() < 1e-12);
    assert!((corrected.covariance[(4, 4)] - 1e-6).abs() < 1e-15);
    assert!((corrected.covariance[(1, 1)] - 1e-4).abs() < 1e-15);
}
