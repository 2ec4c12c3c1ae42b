//! Simple solids and where they sit on a chain: what a robot, a table or an object fills in space.

use nalgebra::{Point3, Vector3};

use crate::Transform;

/// A convex solid about its own origin.
#[derive(Debug, Clone, PartialEq)]
pub enum Solid {
    /// Box along the axes.
    Cuboid {
        /// Half sides (m).
        half: Vector3<f64>,
    },
    /// Cylinder about z.
    Cylinder {
        /// Radius (m).
        radius: f64,
        /// Half the height (m).
        half_height: f64,
    },
    /// Ball.
    Sphere {
        /// Radius (m).
        radius: f64,
    },
    /// Convex hull.
    Convex {
        /// Vertices (m).
        vertices: Vec<Point3<f64>>,
    },
}

impl Solid {
    /// Radius of the smallest ball about the origin that holds the solid (m).
    pub fn bounding_radius(&self) -> f64 {
        match self {
            Solid::Cuboid { half } => half.norm(),
            Solid::Cylinder { radius, half_height } => radius.hypot(*half_height),
            Solid::Sphere { radius } => *radius,
            Solid::Convex { vertices } => {
                vertices.iter().map(|v| v.coords.norm()).fold(0.0, f64::max)
            }
        }
    }

    /// How far the solid reaches from its origin along a unit direction (m).
    pub fn support(&self, direction: &Vector3<f64>) -> f64 {
        match self {
            Solid::Cuboid { half } => half.dot(&direction.abs()),
            Solid::Cylinder { radius, half_height } => {
                radius * direction.xy().norm() + half_height * direction.z.abs()
            }
            Solid::Sphere { radius } => *radius,
            Solid::Convex { vertices } => {
                vertices.iter().map(|v| v.coords.dot(direction)).fold(f64::NEG_INFINITY, f64::max)
            }
        }
    }
}

/// A solid that moves with a joint of a [`crate::Chain`], or stands still.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// The link's name, for messages.
    pub name: String,
    /// How many of the chain's joints move it: 0 is fixed to the root, n moves with the n-th joint.
    pub joints: usize,
    /// The solid in the moving frame of that joint (or in the root frame).
    pub frame_from_solid: Transform,
    /// Direction in the same frame along which a gripper's finger slides: metres of motion per metre
    /// of half opening. Zero for everything else.
    pub slide: Vector3<f64>,
    /// Its form.
    pub solid: Solid,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn supports_are_the_known_ones() {
        let d = Vector3::new(0.6, 0.0, 0.8);
        let cuboid = Solid::Cuboid { half: Vector3::new(1.0, 2.0, 3.0) };
        let cylinder = Solid::Cylinder { radius: 1.0, half_height: 3.0 };
        let corners =
            [-1.0, 1.0].iter().flat_map(|x| [-3.0, 3.0].map(|z| Point3::new(*x, 2.0, z))).collect();
        assert!((cuboid.support(&d) - 3.0).abs() < 1e-12);
        assert!((cylinder.support(&d) - 3.0).abs() < 1e-12);
        assert!((Solid::Sphere { radius: 0.5 }.support(&d) - 0.5).abs() < 1e-12);
        assert!((Solid::Convex { vertices: corners }.support(&d) - 3.0).abs() < 1e-12);
        assert!((cylinder.bounding_radius() - 10f64.sqrt()).abs() < 1e-12);
    }
}
