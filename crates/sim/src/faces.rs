//! Flat faces of prisms and convex bodies: what is drawn of them, what they rest on, where a tag sits.
//!
//! **In:** an outline or vertices as a record has them. **Out:** plane polygons in the object frame, seen
//! from outside counter-clockwise.

use nalgebra::{Point3, Vector3, center};
use vergence_tag::Shape;

/// Points nearer to a plane than this (m) lie in it: records are rounded.
const IN_PLANE: f64 = 1e-6;

/// A plane face.
#[derive(Debug, Clone, PartialEq)]
pub struct Face {
    /// Unit outward normal.
    pub normal: Vector3<f64>,
    /// Corners (m).
    pub corners: Vec<Point3<f64>>,
}

/// The faces of a shape; `None` when it has round ones or encloses nothing.
pub fn faces(shape: &Shape) -> Option<Vec<Face>> {
    match shape {
        Shape::Prism { outline, height } => {
            let end = |z: f64| outline.iter().map(move |c| Point3::new(c[0], c[1], z));
            let (bottom, top): (Vec<_>, Vec<_>) =
                (end(-0.5 * height).collect(), end(0.5 * height).collect());
            let n = outline.len();
            let wall = |k: usize| {
                let next = (k + 1) % n;
                Face::new(vec![bottom[k], bottom[next], top[next], top[k]])
            };
            let mut faces: Vec<Face> = (0..n).filter_map(wall).collect();
            faces.push(Face { normal: Vector3::z(), corners: top });
            faces.push(Face { normal: -Vector3::z(), corners: bottom.into_iter().rev().collect() });
            Some(faces)
        }
        Shape::Convex { vertices } => {
            let vertices: Vec<_> = vertices.iter().map(|v| Point3::from(*v)).collect();
            Some(hull(&vertices)).filter(|faces| faces.len() > 3)
        }
        _ => None,
    }
}

/// The faces that a body with these faces can lie on: those of its convex hull.
pub fn outermost(faces: &[Face]) -> Vec<Face> {
    let mut points: Vec<Point3<f64>> = Vec::new();
    for corner in faces.iter().flat_map(|face| &face.corners) {
        if points.iter().all(|p| (p - corner).norm() > IN_PLANE) {
            points.push(*corner);
        }
    }
    hull(&points)
}

/// Faces of the convex hull, from all planes through three points that have no point outside. A record
/// has few vertices.
pub fn hull(points: &[Point3<f64>]) -> Vec<Face> {
    let mut faces: Vec<Face> = Vec::new();
    for (i, a) in points.iter().enumerate() {
        for (j, b) in points.iter().enumerate().skip(i + 1) {
            for c in &points[j + 1..] {
                let normal = (b - a).cross(&(c - a));
                // Three points on a line span no plane.
                if normal.norm() < IN_PLANE * (b - a).norm() {
                    continue;
                }
                for normal in [normal.normalize(), -normal.normalize()] {
                    let height = |p: &Point3<f64>| normal.dot(&(p - a));
                    let known = |f: &Face| f.normal.dot(&normal) > 0.0 && f.spans(&[*a, *b, *c]);
                    if points.iter().any(|p| height(p) > IN_PLANE) || faces.iter().any(known) {
                        continue;
                    }
                    let inside = points.iter().filter(|p| height(p) > -IN_PLANE);
                    faces
                        .push(Face { normal, corners: around(&normal, inside.copied().collect()) });
                }
            }
        }
    }
    faces
}

/// Points of a plane that are corners of their convex hull, counter-clockwise about the normal.
fn around(normal: &Vector3<f64>, points: Vec<Point3<f64>>) -> Vec<Point3<f64>> {
    let left_of = |a: &Point3<f64>, b: &Point3<f64>, p: &Point3<f64>| {
        (b - a).cross(&(p - a)).dot(normal) / (b - a).norm()
    };
    let far = |a: &Point3<f64>, p: &Point3<f64>| (p - a).norm_squared();
    // From a corner, always on to the point that has all others on its left.
    let middle =
        points.iter().fold(Vector3::zeros(), |sum, p| sum + p.coords) / points.len() as f64;
    let middle = Point3::from(middle);
    let by_distance =
        |a: &&Point3<f64>, b: &&Point3<f64>| far(&middle, a).total_cmp(&far(&middle, b));
    let Some(first) = points.iter().max_by(by_distance) else { return Vec::new() };
    let mut corners = vec![*first];
    loop {
        let here = corners[corners.len() - 1];
        let mut next = here;
        for p in points.iter().filter(|p| far(&here, p) > IN_PLANE * IN_PLANE) {
            let side = if next == here { -1.0 } else { left_of(&here, &next, p) };
            let further = far(&here, p) > far(&here, &next);
            if side < -IN_PLANE || (side.abs() <= IN_PLANE && further) {
                next = *p;
            }
        }
        if far(first, &next) < IN_PLANE * IN_PLANE || corners.len() > points.len() {
            return corners;
        }
        corners.push(next);
    }
}

impl Face {
    /// A face of corners in order; `None` when its first three span no plane.
    fn new(corners: Vec<Point3<f64>>) -> Option<Self> {
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
        Some(Face { normal: normal.try_normalize(1e-12)?, corners })
    }

    /// Distance of its plane from the origin, outwards (m).
    pub fn offset(&self) -> f64 {
        self.corners.first().map_or(0.0, |corner| self.normal.dot(&corner.coords))
    }

    /// The middle of its corners.
    pub fn middle(&self) -> Point3<f64> {
        let sum: Vector3<f64> = self.corners.iter().map(|corner| corner.coords).sum();
        Point3::from(sum / self.corners.len().max(1) as f64)
    }

    /// How far within a convex face the origin's foot lies (m), negative when it is outside.
    pub fn margin(&self) -> f64 {
        let foot = Point3::from(self.normal * self.offset());
        let next = self.corners.iter().cycle().skip(1);
        let sides = self.corners.iter().zip(next).map(|(a, b)| {
            let inwards = self.normal.cross(&(b - a)).normalize();
            inwards.dot(&(foot - center(a, b)))
        });
        sides.fold(f64::INFINITY, f64::min)
    }

    /// Whether points lie in its plane.
    fn spans(&self, points: &[Point3<f64>]) -> bool {
        let offset = self.offset();
        points.iter().all(|p| (self.normal.dot(&p.coords) - offset).abs() < IN_PLANE)
    }

    /// Whether another face is in its plane and looks the same way.
    pub fn holds(&self, other: &Face) -> bool {
        self.normal.dot(&other.normal) > 0.0 && self.spans(&other.corners)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(inner: &[[f64; 3]]) -> Vec<Point3<f64>> {
        let corner = |k: usize| [0, 1, 2].map(|axis| if k >> axis & 1 == 1 { 0.1 } else { -0.1 });
        (0..8).map(corner).chain(inner.iter().copied()).map(Point3::from).collect()
    }

    #[test]
    fn a_cube_has_six_faces_whatever_lies_within_it_or_on_it() {
        // In the middle, within a face, on an edge.
        for inner in [&[][..], &[[0.0; 3], [0.1, 0.02, -0.03], [0.1, 0.1, 0.04]]] {
            let faces = hull(&cube(inner));
            assert_eq!(faces.len(), 6, "{faces:?}");
            for face in &faces {
                assert_eq!(face.corners.len(), 4, "{face:?}");
                assert!((face.offset() - 0.1).abs() < 1e-12 && (face.margin() - 0.1).abs() < 1e-12);
                let again = Face::new(face.corners.clone()).unwrap();
                assert!((again.normal - face.normal).norm() < 1e-9, "{face:?} turns the wrong way");
            }
        }
    }

    #[test]
    fn an_angle_iron_lies_on_the_plane_over_its_notch() {
        let outline = [
            [-0.04, -0.04],
            [0.04, -0.04],
            [0.04, -0.02],
            [-0.02, -0.02],
            [-0.02, 0.04],
            [-0.04, 0.04],
        ];
        let shape = Shape::Prism { outline: outline.into_iter().collect(), height: 0.1 };
        let all = faces(&shape).unwrap();
        assert_eq!(all.len(), 8);
        let lies = outermost(&all);
        // Two ends, four walls, and what spans the notch.
        assert_eq!(lies.len(), 7);
        let slant = Vector3::new(1.0, 1.0, 0.0).normalize();
        assert!(lies.iter().any(|face| (face.normal - slant).norm() < 1e-9));
        assert!(all.iter().all(|face| (face.normal - slant).norm() > 0.1));
    }
}
