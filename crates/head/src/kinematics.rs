//! One pan-tilt head: angles and pixels to rays in base, and points in base back to angles.
//!
//! The chain is whatever the URDF says: axes need not cross, the camera need not sit on them. So
//! "look at that point" has no closed form; [`PanTiltHead::look_at`] solves it by Newton's method from
//! the best of a coarse grid of starts, which is exact to rounding.

use nalgebra::{Matrix2, Matrix2x3, Point2, Point3, Vector2, Vector3};
use vergence_geometry::{Camera, CameraError, Chain, Limits, Ray, Transform};

/// Distance (m) assumed by [`PanTiltHead::aim`] when the caller knows none.
const USUAL_DISTANCE: f64 = 1.0;

/// Why a head was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum HeadError {
    /// The chain is not a pan and a tilt joint.
    #[error("a pan-tilt head has two joints, this chain has {0}")]
    Joints(usize),
    /// A joint's range is empty or not a number.
    #[error("joint \"{joint}\" has the unusable range {lower}..{upper} rad")]
    Range {
        /// Which joint.
        joint: String,
        /// Its lower limit.
        lower: f64,
        /// Its upper limit.
        upper: f64,
    },
    /// The camera's numbers cannot be.
    #[error(transparent)]
    Camera(#[from] CameraError),
}

/// A camera on a pan and a tilt joint.
#[derive(Debug, Clone, PartialEq)]
pub struct PanTiltHead {
    /// `base` to the camera's optical frame by the joints pan and tilt, in this order.
    pub chain: Chain,
    /// The camera.
    pub camera: Camera,
}

/// A projected point with its derivatives.
pub(crate) struct Projection {
    /// Where it appears.
    pub pixel: Point2<f64>,
    /// Derivative of the pixel by the point in base (px/m).
    pub by_point: Matrix2x3<f64>,
    /// Derivative of the pixel by pan and tilt (px/rad).
    pub by_angles: Matrix2<f64>,
}

impl PanTiltHead {
    /// Joins a chain of two joints and a camera.
    pub fn new(chain: Chain, camera: Camera) -> Result<Self, HeadError> {
        if chain.joints.len() != 2 {
            return Err(HeadError::Joints(chain.joints.len()));
        }
        for joint in &chain.joints {
            let Limits { lower, upper, .. } = joint.limits;
            if !(lower.is_finite() && upper.is_finite() && lower <= upper) {
                return Err(HeadError::Range { joint: joint.name.clone(), lower, upper });
            }
        }
        camera.validate()?;
        Ok(PanTiltHead { chain, camera })
    }

    /// Limits of pan and tilt.
    pub fn limits(&self) -> [Limits; 2] {
        [self.chain.joints[0].limits, self.chain.joints[1].limits]
    }

    /// The nearest angles within the limits.
    pub fn clamp(&self, angles: [f64; 2]) -> [f64; 2] {
        let limits = self.limits();
        [0, 1].map(|k| angles[k].clamp(limits[k].lower, limits[k].upper))
    }

    /// Time (s) that the slower joint needs from one pair of angles to another at full speed.
    pub fn slew_time(&self, from: [f64; 2], to: [f64; 2]) -> f64 {
        let limits = self.limits();
        (0..2).map(|k| (to[k] - from[k]).abs() / limits[k].velocity.max(1e-3)).fold(0.0, f64::max)
    }

    /// Pose of the optical frame in base.
    pub fn base_from_optical(&self, angles: [f64; 2]) -> Transform {
        self.chain.forward(&angles)
    }

    /// What a pixel sees at these angles, as a ray in base.
    pub fn ray(&self, angles: [f64; 2], pixel: &Point2<f64>) -> Ray {
        let direction = nalgebra::Unit::new_normalize(self.camera.unproject(pixel));
        Ray { origin: Point3::origin(), direction }.transformed(&self.base_from_optical(angles))
    }

    /// Pixel of a point in base; `None` behind the camera. May lie outside the picture.
    pub fn project(&self, angles: [f64; 2], point: &Point3<f64>) -> Option<Point2<f64>> {
        self.camera.project(&self.base_from_optical(angles).inverse_transform_point(point))
    }

    /// True when a point in base appears in the picture, `margin_px` away from its border.
    pub fn sees(&self, angles: [f64; 2], point: &Point3<f64>, margin_px: f64) -> bool {
        self.project(angles, point).is_some_and(|pixel| self.camera.contains(&pixel, margin_px))
    }

    /// Angles that bring a point in base onto the optical axis; `None` when the limits or the
    /// mechanism do not allow it.
    pub fn look_at(&self, point: &Point3<f64>) -> Option<[f64; 2]> {
        let angles = self.solve(point)?;
        let limits = self.limits();
        (0..2).all(|k| limits[k].contains(angles[k])).then_some(angles)
    }

    /// Angles that bring what is seen at `pixel` onto the optical axis, within the limits. How far
    /// the thing is (m) matters only through the lever arms; 1 m is assumed when unknown.
    pub fn aim(&self, angles: [f64; 2], pixel: &Point2<f64>, distance: Option<f64>) -> [f64; 2] {
        let point = self.ray(angles, pixel).at(distance.unwrap_or(USUAL_DISTANCE));
        self.clamp(self.newton(angles, &point).or_else(|| self.solve(&point)).unwrap_or(angles))
    }

    /// Angles within the limits that come nearest to looking at a point.
    pub(crate) fn aim_at(&self, point: &Point3<f64>) -> [f64; 2] {
        self.clamp(self.solve(point).unwrap_or([0.0; 2]))
    }

    /// Projection of a point with its derivatives.
    pub(crate) fn linearise(&self, angles: [f64; 2], point: &Point3<f64>) -> Option<Projection> {
        let base_from_optical = self.base_from_optical(angles);
        let p_optical = base_from_optical.inverse_transform_point(point);
        let (pixel, by_optical) = self.camera.project_with_jacobian(&p_optical)?;
        let optical_from_base = base_from_optical.rotation.inverse().to_rotation_matrix();
        let by_point = by_optical * optical_from_base.matrix();
        let motion = self.point_motion(angles, point);
        let by_angles = Matrix2::from_columns(&[by_point * motion[0], by_point * motion[1]]);
        Some(Projection { pixel, by_point, by_angles })
    }

    /// How a point fixed in base moves relative to the camera, expressed in base axes, per radian
    /// of pan and of tilt: `-(axis x (point - place of the axis))`.
    fn point_motion(&self, angles: [f64; 2], point: &Point3<f64>) -> [Vector3<f64>; 2] {
        let frames = self.chain.frames(&angles);
        [0, 1].map(|k| {
            let axis = frames[k].rotation * self.chain.joints[k].axis.into_inner();
            -axis.cross(&(point.coords - frames[k].translation.vector))
        })
    }

    /// Angles that look at a point, limits ignored.
    fn solve(&self, point: &Point3<f64>) -> Option<[f64; 2]> {
        const PAN_STARTS: usize = 9;
        const TILT_STARTS: usize = 5;
        let limits = self.limits();
        let start = |k: usize, i: usize, n: usize| {
            limits[k].lower + (limits[k].upper - limits[k].lower) * i as f64 / (n - 1) as f64
        };
        let alignment = |angles: [f64; 2]| {
            let p = self.base_from_optical(angles).inverse_transform_point(point);
            p.z / p.coords.norm().max(1e-9)
        };
        let best = (0..PAN_STARTS * TILT_STARTS)
            .map(|i| [start(0, i % PAN_STARTS, PAN_STARTS), start(1, i / PAN_STARTS, TILT_STARTS)])
            .max_by(|a, b| alignment(*a).total_cmp(&alignment(*b)))?;
        self.newton(best, point)
    }

    fn newton(&self, start: [f64; 2], point: &Point3<f64>) -> Option<[f64; 2]> {
        let mut angles = start;
        for _ in 0..20 {
            let base_from_optical = self.base_from_optical(angles);
            let p = base_from_optical.inverse_transform_point(point);
            if p.z <= 1e-6 {
                return None;
            }
            let off = Vector2::new(p.x / p.z, p.y / p.z);
            if off.norm() < 1e-13 {
                return Some(angles);
            }
            let motion = self.point_motion(angles, point).map(|v| {
                let v = base_from_optical.inverse_transform_vector(&v);
                Vector2::new((v.x - off.x * v.z) / p.z, (v.y - off.y * v.z) / p.z)
            });
            let step = Matrix2::from_columns(&motion).try_inverse()? * off;
            // A step beyond half a radian leaves the region where the tangent is linear.
            let step = step * (0.5 / step.norm()).min(1.0);
            angles = [angles[0] - step.x, angles[1] - step.y];
            if step.norm() < 1e-14 {
                return Some(angles);
            }
        }
        let p = self.base_from_optical(angles).inverse_transform_point(point);
        (p.z > 0.0 && p.x.hypot(p.y) < 1e-9 * p.z).then_some(angles)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::head;
    use proptest::prelude::*;

    fn reachable() -> impl Strategy<Value = Point3<f64>> {
        (0.4f64..3.0, -1.4f64..1.4, -0.5f64..0.9).prop_map(|(r, pan, tilt)| {
            Point3::new(0.0, 0.1, 0.5)
                + r * Vector3::new(tilt.cos() * pan.cos(), tilt.cos() * pan.sin(), -tilt.sin())
        })
    }

    proptest! {
        #[test]
        fn look_at_brings_a_point_onto_the_axis(point in reachable()) {
            let head = head(0.1);
            let angles = head.look_at(&point).unwrap();
            let pixel = head.project(angles, &point).unwrap();
            prop_assert!((pixel - Point2::new(159.5, 119.5)).norm() < 1e-8, "{pixel}");
            prop_assert!(head.ray(angles, &pixel).distance_to(&point) < 1e-9);
        }

        #[test]
        fn aim_centres_what_a_pixel_sees(point in reachable(), du in -0.3f64..0.3, dv in -0.2f64..0.2) {
            let head = head(0.1);
            let wanted = head.look_at(&point).unwrap();
            let angles = head.clamp([wanted[0] + du, wanted[1] + dv]);
            let pixel = head.project(angles, &point).unwrap();
            let distance = (point - head.base_from_optical(angles) * Point3::origin()).norm();
            let aimed = head.aim(angles, &pixel, Some(distance));
            prop_assert!((aimed[0] - wanted[0]).abs() + (aimed[1] - wanted[1]).abs() < 1e-8);
            let blind = head.aim(angles, &pixel, None);
            prop_assert!((blind[0] - wanted[0]).abs() + (blind[1] - wanted[1]).abs() < 0.06);
        }

        #[test]
        fn derivatives_equal_finite_differences(point in reachable(), du in -0.2f64..0.2) {
            let (head, h) = (head(0.1), 1e-6);
            let wanted = head.look_at(&point).unwrap();
            let angles = [wanted[0] + du, wanted[1] - 0.5 * du];
            let projection = head.linearise(angles, &point).unwrap();
            for k in 0..3 {
                let mut d = Vector3::zeros();
                d[k] = h;
                let pixel = |p| head.project(angles, &p).unwrap();
                let numeric = (pixel(point + d) - pixel(point - d)) / (2.0 * h);
                prop_assert!((numeric - projection.by_point.column(k)).norm() < 1e-4);
            }
            for k in 0..2 {
                let pixel = |h: f64| {
                    let mut moved = angles;
                    moved[k] += h;
                    head.project(moved, &point).unwrap()
                };
                let numeric = (pixel(h) - pixel(-h)) / (2.0 * h);
                prop_assert!((numeric - projection.by_angles.column(k)).norm() < 1e-3);
            }
        }
    }

    #[test]
    fn beyond_the_limits_is_none_and_aim_stops_there() {
        let head = head(0.1);
        assert_eq!(head.look_at(&Point3::new(-1.0, 0.1, 0.5)), None);
        let behind_left = head.aim([1.7, 0.0], &Point2::new(0.0, 119.5), None);
        assert_eq!(behind_left[0], 1.8);
    }

    #[test]
    fn one_joint_is_no_head() {
        let mut chain = head(0.1).chain;
        chain.joints.pop();
        let camera = Camera::centred(320, 240, 300.0);
        assert_eq!(PanTiltHead::new(chain, camera), Err(HeadError::Joints(1)));
    }
}
