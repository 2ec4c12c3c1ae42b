//! The object as the record tells it: its solids, and the housings of its landmarks.
//!
//! In: a [`Record`]. Out: convex solids in the object frame. A cup is hollow: a ring of wall segments
//! and a bottom, so that a finger may reach inside. The wall's thickness is not in the record and is
//! assumed; the handle is not either, see [`crate::candidates`].

use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use vergence_geometry::{Solid, Transform};
use vergence_tag::{Record, Shape};

/// Wall segments of a cup: with 20 the flats lie within 1.2 % of the round.
const SEGMENTS: usize = 20;

/// A solid in the object frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// Where it sits.
    pub object_from_solid: Transform,
    /// Its form.
    pub solid: Solid,
}

/// The solids of a record's shape; `wall` is the thickness (m) assumed for cups.
pub fn solids(record: &Record, wall: f64) -> Vec<Placed> {
    let centred = |solid| vec![Placed { object_from_solid: Transform::identity(), solid }];
    match &record.shape {
        Shape::Box => {
            centred(Solid::Cuboid { half: Vector3::from(record.bounding_box.sides()) / 2.0 })
        }
        Shape::Cylinder { diameter, height } => {
            centred(Solid::Cylinder { radius: diameter / 2.0, half_height: height / 2.0 })
        }
        Shape::Sphere { diameter } => centred(Solid::Sphere { radius: diameter / 2.0 }),
        Shape::Cup { top_diameter, bottom_diameter, height } => {
            cup(bottom_diameter / 2.0, top_diameter / 2.0, *height, wall)
        }
        Shape::Prism { outline, height } => {
            let end = |z: f64| outline.iter().map(move |c| Point3::new(c[0], c[1], z));
            let vertices = end(-height / 2.0).chain(end(height / 2.0)).collect();
            centred(Solid::Convex { vertices })
        }
        Shape::Convex { vertices } => {
            centred(Solid::Convex { vertices: vertices.iter().map(|&v| Point3::from(v)).collect() })
        }
    }
}

/// The housings that stand out around the landmarks, as balls.
pub fn housings(record: &Record, radius: f64) -> Vec<Placed> {
    let ball = |position: [f64; 3]| Placed {
        object_from_solid: Translation3::from(Vector3::from(position)).into(),
        solid: Solid::Sphere { radius },
    };
    record.landmarks.iter().map(|site| ball(site.position)).collect()
}

/// Outer radius of a solid of revolution about z at a height, `None` for other shapes (m).
pub fn radius_at(record: &Record, z: f64) -> Option<f64> {
    match record.shape {
        Shape::Cylinder { diameter, .. } => Some(diameter / 2.0),
        Shape::Cup { top_diameter, bottom_diameter, height } => {
            let s = (z / height + 0.5).clamp(0.0, 1.0);
            Some(0.5 * (bottom_diameter + s * (top_diameter - bottom_diameter)))
        }
        _ => None,
    }
}

/// Volume that the record's shape fills (m^3); a cup counts as full.
pub fn volume(record: &Record) -> f64 {
    let [x, y, z] = record.bounding_box.sides();
    let fraction = match &record.shape {
        Shape::Box => 1.0,
        Shape::Cylinder { .. } | Shape::Cup { .. } => std::f64::consts::FRAC_PI_4,
        Shape::Sphere { .. } => std::f64::consts::PI / 6.0,
        // At most the box: an upper bound is what a payload check wants.
        Shape::Prism { .. } | Shape::Convex { .. } => 1.0,
    };
    fraction * x * y * z
}

/// Wall segments, each the hull of eight corners, and a bottom plate.
fn cup(bottom: f64, top: f64, height: f64, wall: f64) -> Vec<Placed> {
    let step = std::f64::consts::TAU / SEGMENTS as f64;
    // Corners outside the round so that the flats' middles lie inside it by as much: equal volume.
    let bulge = (step / step.sin()).sqrt();
    let mut placed: Vec<Placed> = (0..SEGMENTS)
        .map(|n| {
            let mut vertices = Vec::with_capacity(8);
            for turn in [n as f64, n as f64 + 1.0] {
                let (sin, cos) = (turn * step).sin_cos();
                for (radius, z) in [(bottom, -height / 2.0), (top, height / 2.0)] {
                    for r in [radius * bulge, (radius * bulge - wall).max(0.0)] {
                        vertices.push(Point3::new(r * cos, r * sin, z));
                    }
                }
            }
            Placed { object_from_solid: Isometry3::identity(), solid: Solid::Convex { vertices } }
        })
        .collect();
    placed.push(Placed {
        object_from_solid: Translation3::new(0.0, 0.0, (wall - height) / 2.0).into(),
        solid: Solid::Cylinder { radius: (bottom - wall).max(wall), half_height: wall / 2.0 },
    });
    placed
}
