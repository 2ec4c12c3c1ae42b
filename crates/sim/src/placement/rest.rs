//! On which side an object rests.

use std::f64::consts::{PI, TAU};

use nalgebra::{UnitQuaternion, Vector3};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_tag::Shape;

use crate::config::ObjectSettings;
use crate::faces::{self, Face};

/// An object lies on a face that holds the foot of its middle by as much (m): less, and it tips over.
const STABLE: f64 = 0.004;

/// How an object stands on the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rest {
    /// Attitude before it is turned about the vertical.
    pub turn: UnitQuaternion<f64>,
    /// Height of its origin (m).
    pub height: f64,
    /// Radius of the disc on the table that it takes (m).
    pub radius: f64,
}

/// The faces that a prism or a convex body can lie on; none of other shapes.
pub(super) fn lies_on(shape: &Shape) -> Vec<Face> {
    let mut lies = faces::faces(shape).map_or_else(Vec::new, |all| faces::outermost(&all));
    lies.retain(|face| face.margin() > STABLE);
    lies
}

impl Rest {
    /// Upright.
    pub fn upright(settings: &ObjectSettings) -> Self {
        let [w, l, h] = settings.record.bounding_box.sides();
        let handle = if settings.handle { 0.35 * h } else { 0.0 };
        Rest {
            turn: UnitQuaternion::identity(),
            height: 0.5 * h,
            radius: 0.5 * w.hypot(l) + handle,
        }
    }

    /// On any side on which it can rest: a face (of a prism or a convex body one of [`lies_on`]), the line of
    /// a wall, any point of a ball. A cup does not lie on its handle, so one with a handle stands on its
    /// foot or on its rim.
    pub fn any(settings: &ObjectSettings, lies_on: &[Face], rng: &mut Pcg64Mcg) -> Self {
        let record = &settings.record;
        let sides = record.bounding_box.sides();
        let (down, height) = match &record.shape {
            Shape::Cylinder { diameter, height } => round([*diameter; 2], *height, true, rng),
            Shape::Cup { top_diameter, bottom_diameter, height } => {
                round([*top_diameter, *bottom_diameter], *height, !settings.handle, rng)
            }
            Shape::Sphere { diameter } => {
                let (z, azimuth) = (rng.random_range(-1.0..1.0f64), rng.random_range(0.0..TAU));
                let across = (1.0 - z * z).sqrt();
                (Vector3::new(across * azimuth.cos(), across * azimuth.sin(), z), 0.5 * diameter)
            }
            Shape::Box => {
                let (axis, sign) = (rng.random_range(0..3), [-1.0, 1.0][rng.random_range(0..2)]);
                (Vector3::ith(axis, sign), 0.5 * sides[axis])
            }
            Shape::Prism { .. } | Shape::Convex { .. } => match lies_on.len() {
                0 => (-Vector3::z(), 0.5 * sides[2]),
                n => {
                    let face = &lies_on[rng.random_range(0..n)];
                    (face.normal, face.offset())
                }
            },
        };
        let over = || UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
        Rest {
            turn: UnitQuaternion::rotation_between(&down, &-Vector3::z()).unwrap_or_else(over),
            height,
            radius: Self::upright(settings).radius.max(0.5 * record.bounding_box.diagonal()),
        }
    }
}

/// Foot, top or, when it can lie, wall of a frustum of these diameters (top, bottom): which direction
/// of it is below, and how high its middle is then.
fn round(
    [top, bottom]: [f64; 2],
    height: f64,
    lies: bool,
    rng: &mut Pcg64Mcg,
) -> (Vector3<f64>, f64) {
    match rng.random_range(0..if lies { 3 } else { 2 }) {
        0 => (-Vector3::z(), 0.5 * height),
        1 => (Vector3::z(), 0.5 * height),
        _ => {
            let azimuth: f64 = rng.random_range(0.0..TAU);
            let slope = 0.5 * (top - bottom) / height;
            let wall = Vector3::new(azimuth.cos(), azimuth.sin(), -slope);
            (wall.normalize(), 0.25 * (top + bottom) / wall.norm())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::stream;
    use nalgebra::Point3;

    #[test]
    fn nothing_sinks_into_the_table_or_floats() {
        let shapes = [
            Shape::Box,
            Shape::Cylinder { diameter: 0.08, height: 0.12 },
            Shape::Cup { top_diameter: 0.08, bottom_diameter: 0.05, height: 0.12 },
        ];
        let mut rng = stream(1, "rest", 0);
        for shape in shapes {
            let (top, bottom) = match shape {
                Shape::Cup { top_diameter, bottom_diameter, .. } => (top_diameter, bottom_diameter),
                _ => (0.08, 0.08),
            };
            let record = vergence_tag::Record {
                object_id: "object".parse().unwrap(),
                landmarks: Default::default(),
                bounding_box: vergence_tag::BoundingBox { width: 0.08, length: 0.08, height: 0.12 },
                shape,
                physical: Default::default(),
                semantic: Default::default(),
            };
            let square = record.shape == Shape::Box;
            let settings = ObjectSettings {
                record,
                surface: crate::config::Surface::Plain,
                handle: false,
                passkey: None,
                at: None,
                yaw_deg: None,
            };
            for _ in 0..200 {
                let rest = Rest::any(&settings, &[], &mut rng);
                let lowest = (0..720).map(|k| {
                    let angle = TAU * f64::from(k / 2) / 360.0;
                    let (z, diameter) = if k % 2 == 0 { (0.06, top) } else { (-0.06, bottom) };
                    let (x, y) = match square {
                        true => (angle.cos().signum(), angle.sin().signum()),
                        false => (angle.cos(), angle.sin()),
                    };
                    let p = Point3::new(0.5 * diameter * x, 0.5 * diameter * y, z);
                    (rest.turn * p).z + rest.height
                });
                let lowest = lowest.fold(f64::INFINITY, f64::min);
                assert!(lowest.abs() < 1e-4, "{lowest} of {:?}", settings.record.shape);
            }
        }
    }
}
