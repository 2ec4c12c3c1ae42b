//! Geometry that every Vergence crate shares: frames, cameras, rays, Gaussian points and poses.
//!
//! **Conventions** (ROS REP-103/105), stated once, here:
//!
//! - `base` frame: x forward, y left, z up. `*_optical_frame`: x right, y down, z forward.
//! - Object frame: origin at the centre of the bounding box, x along width, y along length,
//!   z along height (up when the object stands).
//! - A transform variable is named `a_from_b`: it takes coordinates in `b` to coordinates in `a`,
//!   so that names cancel: `a_from_c = a_from_b * b_from_c`.
//! - SI units and radians; a suffix (`_mm`, `_px`, `_deg`) says otherwise.
//! - Pixel (0, 0) is the centre of the top-left pixel.
//! - `pan` is positive to the left (about +z), `tilt` positive downwards (about +y); both are zero
//!   looking along +x.
//! - The tangent of a pose is `(rotation, translation)`, six numbers, both parts in the *parent*
//!   frame and independent of each other, see [`gaussian`].

pub mod camera;
pub mod chain;
pub mod gaussian;
pub mod ray;
pub mod solid;
pub mod symmetry;
pub mod trajectory;

pub use camera::{Camera, CameraError, Distortion};
pub use chain::{Chain, Joint, Limits};
pub use gaussian::{GaussianPoint, GaussianPose};
pub use ray::Ray;
pub use solid::{Body, Solid};
pub use symmetry::Symmetry;
pub use trajectory::{JointAngles, Trajectory, Waypoint};

/// A rigid transform. `a_from_b * p_b` gives `p_a`.
pub type Transform = nalgebra::Isometry3<f64>;

/// The rotation that takes `base`-like axes (x forward, y left, z up) to optical axes
/// (x right, y down, z forward): `optical_from_body * v_body`.
pub fn optical_from_body() -> nalgebra::UnitQuaternion<f64> {
    let m = nalgebra::Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(m))
}
