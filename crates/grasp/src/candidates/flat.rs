//! Flat bodies: two opposite faces of a box, a prism or a convex body.

use std::f64::consts::FRAC_PI_4;

use nalgebra::Vector3;
use parry3d::math::Vector;
use parry3d::shape::ConvexPolyhedron;
use vergence_geometry::Solid;
use vergence_tag::{Record, Shape};

use super::{Grasp, Hold, Maker, Pinch};
use crate::object;

impl Maker<'_> {
    pub(super) fn of_box(&self) -> Vec<Grasp> {
        let half = Vector3::from(self.record.bounding_box.sides()) / 2.0;
        let solid = Solid::Cuboid { half };
        let mut grasps = Vec::new();
        for k in 0..3 {
            let mut closing = Vector3::zeros();
            closing[k] = 1.0;
            let (a, b) = (unit((k + 1) % 3), unit((k + 2) % 3));
            for n in 0..8 {
                let (sin, cos) = (n as f64 * FRAC_PI_4).sin_cos();
                let approach = a * cos + b * sin;
                let lateral = approach.cross(&closing);
                let side = solid.support(&lateral);
                for offset in [0.0, -0.5, 0.5] {
                    let reach = solid.support(&approach);
                    let shift = offset * (side - self.gripper.width).max(0.0);
                    grasps.extend(self.pinch(Pinch {
                        hold: Hold::Faces,
                        centre: lateral * shift,
                        closing,
                        approach,
                        width: 2.0 * half[k],
                        front: reach,
                        back: reach,
                        across: side - shift.abs() - 0.003,
                    }));
                }
            }
        }
        grasps
    }

    /// Pairs of opposite faces of the convex hull, their middles facing each other.
    pub(super) fn of_hull(&self) -> Vec<Grasp> {
        let mut grasps = Vec::new();
        for placed in object::solids(self.record, self.assumed.wall) {
            let faces = faces(&placed.solid, self.record);
            for (i, (normal, middle)) in faces.iter().enumerate() {
                for (other, opposite) in &faces[..i] {
                    let (centre, offset) = ((middle + opposite) / 2.0, middle - opposite);
                    let slid = offset - normal * offset.dot(normal);
                    // Within 4 degrees of parallel, and overlapping.
                    if normal.dot(other) > -0.9976 || slid.norm() > self.gripper.width {
                        continue;
                    }
                    grasps.extend(self.around(&placed.solid, centre, *normal, offset.norm()));
                }
            }
        }
        grasps
    }

    fn around(
        &self,
        solid: &Solid,
        centre: Vector3<f64>,
        closing: Vector3<f64>,
        width: f64,
    ) -> Vec<Grasp> {
        let first = closing.cross(&unit(closing.iamin())).normalize();
        let second = closing.cross(&first);
        let sides = (0..8).map(|n| (n as f64 * FRAC_PI_4).sin_cos());
        sides
            .filter_map(|(sin, cos)| {
                let approach = first * cos + second * sin;
                let lateral = approach.cross(&closing);
                let reach = |d: &Vector3<f64>| solid.support(d) - centre.dot(d);
                self.pinch(Pinch {
                    hold: Hold::Faces,
                    centre,
                    closing,
                    approach,
                    width,
                    front: reach(&-approach),
                    back: reach(&approach),
                    across: f64::min(reach(&lateral), reach(&-lateral)) - 0.003,
                })
            })
            .collect()
    }
}

/// Outward normals and middles of the faces; for a prism, walls of the hull that its outline does not
/// have are left out.
fn faces(solid: &Solid, record: &Record) -> Vec<(Vector3<f64>, Vector3<f64>)> {
    let Solid::Convex { vertices } = solid else { return Vec::new() };
    let points: Vec<Vector> =
        vertices.iter().map(|v| Vector::new(v.x as f32, v.y as f32, v.z as f32)).collect();
    let Some(hull) = ConvexPolyhedron::from_convex_hull(&points) else { return Vec::new() };
    let corner = |i: u32| {
        let p = hull.points()[i as usize];
        Vector3::new(f64::from(p.x), f64::from(p.y), f64::from(p.z))
    };
    let mut faces = Vec::new();
    for face in hull.faces() {
        let first = face.first_vertex_or_edge as usize;
        let range = first..first + face.num_vertices_or_edges as usize;
        let Some(corners) = hull.vertices_adj_to_face().get(range) else { continue };
        let middle =
            corners.iter().map(|&i| corner(i)).sum::<Vector3<f64>>() / corners.len().max(1) as f64;
        let normal = Vector3::new(
            f64::from(face.normal.x),
            f64::from(face.normal.y),
            f64::from(face.normal.z),
        );
        if real(record, &normal, &middle) {
            faces.push((normal.normalize(), middle));
        }
    }
    faces
}

fn real(record: &Record, normal: &Vector3<f64>, middle: &Vector3<f64>) -> bool {
    let Shape::Prism { outline, .. } = &record.shape else { return true };
    let n = outline.len();
    let on_edge = |i: usize| {
        let (a, b) = (outline[i], outline[(i + 1) % n]);
        let (a, b) = (Vector3::new(a[0], a[1], 0.0), Vector3::new(b[0], b[1], 0.0));
        let p = Vector3::new(middle.x, middle.y, 0.0);
        (p - a).norm() + (p - b).norm() - (a - b).norm() < 1e-3
    };
    normal.z.abs() > 0.5 || (0..n).any(on_edge)
}

fn unit(k: usize) -> Vector3<f64> {
    let mut v = Vector3::zeros();
    v[k] = 1.0;
    v
}
