//! Rays in space, as a camera pixel or an aimed head gives them.

use nalgebra::{Point3, Unit, Vector3};

use crate::Transform;

/// A half line from `origin` along `direction`, both in one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Start, metres.
    pub origin: Point3<f64>,
    /// Unit direction.
    pub direction: Unit<Vector3<f64>>,
}

impl Ray {
    /// The point `distance` metres along the ray.
    pub fn at(&self, distance: f64) -> Point3<f64> {
        self.origin + self.direction.into_inner() * distance
    }

    /// The same ray in another frame.
    pub fn transformed(&self, a_from_b: &Transform) -> Ray {
        Ray {
            origin: a_from_b * self.origin,
            direction: Unit::new_unchecked(a_from_b.rotation * self.direction.into_inner()),
        }
    }

    /// Distance of a point to the line through this ray.
    pub fn distance_to(&self, point: &Point3<f64>) -> f64 {
        (point - self.origin).cross(&self.direction).norm()
    }

    /// Distances along `self` and `other` of their points of closest approach; `None` when the
    /// rays are parallel to within 1e-6 rad, where depth is undefined.
    pub fn closest(&self, other: &Ray) -> Option<(f64, f64)> {
        let (a, b) = (self.direction.into_inner(), other.direction.into_inner());
        let cos = a.dot(&b);
        let denominator = 1.0 - cos * cos;
        if denominator < 1e-12 {
            return None;
        }
        let w = other.origin - self.origin;
        let (wa, wb) = (w.dot(&a), w.dot(&b));
        Some(((wa - cos * wb) / denominator, (cos * wa - wb) / denominator))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ray_to(origin: Point3<f64>, target: Point3<f64>) -> Ray {
        Ray { origin, direction: Unit::new_normalize(target - origin) }
    }

    proptest! {
        #[test]
        fn rays_to_one_point_meet_there(x in 0.3f64..3.0, y in -1.0f64..1.0, z in -1.0f64..1.0) {
            let target = Point3::new(x, y, z);
            let (left, right) = (ray_to(Point3::new(0.0, 0.1, 0.0), target), ray_to(Point3::new(0.0, -0.1, 0.0), target));
            let (s, t) = left.closest(&right).unwrap();
            prop_assert!((left.at(s) - target).norm() < 1e-9);
            prop_assert!((right.at(t) - target).norm() < 1e-9);
        }
    }

    #[test]
    fn parallel_rays_have_no_depth() {
        let left = Ray { origin: Point3::new(0.0, 0.1, 0.0), direction: Vector3::x_axis() };
        let right = Ray { origin: Point3::new(0.0, -0.1, 0.0), direction: Vector3::x_axis() };
        assert!(left.closest(&right).is_none());
        assert!((left.distance_to(&Point3::new(5.0, 0.3, 0.0)) - 0.2).abs() < 1e-12);
    }
}
