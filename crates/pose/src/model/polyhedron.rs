//! Bodies with flat faces: cuboid, extruded polygon, convex hull.

use nalgebra::Vector3;

use super::{Kind, Line, Outline};

/// A closed body of flat faces.
#[derive(Debug, Clone, PartialEq)]
pub struct Polyhedron {
    vertices: Vec<Vector3<f64>>,
    faces: Vec<Face>,
    edges: Vec<Edge>,
    /// Faces can hide each other only in a body that is not convex.
    convex: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct Face {
    /// Outward unit normal.
    normal: Vector3<f64>,
    /// `normal . p` on the face.
    offset: f64,
    /// Corners in order, counter-clockwise from outside.
    loop_: Vec<usize>,
}

#[derive(Debug, Clone, PartialEq)]
struct Edge {
    ends: [usize; 2],
    faces: [usize; 2],
}

/// Points closer than this (m) count as one; faces closer in direction than this as one plane.
const WELD: f64 = 1e-6;
/// A concave body's edges are cut into pieces of this share of their length to see which are hidden.
const PIECES: usize = 12;

impl Polyhedron {
    /// A box of these sides (m).
    pub fn cuboid(sides: Vector3<f64>) -> Self {
        let h = sides / 2.0;
        Self::prism(&[[-h.x, -h.y], [h.x, -h.y], [h.x, h.y], [-h.x, h.y]], sides.z)
    }

    /// A counter-clockwise polygon in x-y extruded along z over `height`, centred in z.
    pub fn prism(outline: &[[f64; 2]], height: f64) -> Self {
        let n = outline.len();
        let at = |z: f64| outline.iter().map(move |c| Vector3::new(c[0], c[1], z));
        let vertices: Vec<_> = at(-height / 2.0).chain(at(height / 2.0)).collect();
        let mut loops = vec![(0..n).rev().collect::<Vec<_>>(), (n..2 * n).collect()];
        loops.extend((0..n).map(|i| vec![i, (i + 1) % n, (i + 1) % n + n, i + n]));
        let turn = |i: usize| {
            let (a, b, c) = (outline[i], outline[(i + 1) % n], outline[(i + 2) % n]);
            (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
        };
        Self::from_loops(vertices, loops, (0..n).all(|i| turn(i) >= 0.0))
    }

    /// The convex hull of a few points, by trying every plane through three of them: cubic in
    /// their number, which a record bounds by 48.
    pub fn hull(points: &[Vector3<f64>]) -> Self {
        let mut planes: Vec<(Vector3<f64>, f64)> = Vec::new();
        for (i, a) in points.iter().enumerate() {
            for (j, b) in points.iter().enumerate().skip(i + 1) {
                for c in &points[j + 1..] {
                    let Some(n) = (b - a).cross(&(c - a)).try_normalize(WELD * WELD) else {
                        continue;
                    };
                    for n in [n, -n] {
                        let offset = n.dot(a);
                        let outside = |p: &Vector3<f64>| n.dot(p) > offset + WELD;
                        let known = |(m, o): &(Vector3<f64>, f64)| {
                            (m - n).norm() < 1e-4 && (o - offset).abs() < 10.0 * WELD
                        };
                        if !points.iter().any(outside) && !planes.iter().any(known) {
                            planes.push((n, offset));
                        }
                    }
                }
            }
        }
        let loops = planes.iter().map(|(n, offset)| {
            let mut on: Vec<usize> = (0..points.len())
                .filter(|&i| (n.dot(&points[i]) - offset).abs() < 10.0 * WELD)
                .collect();
            let middle = on.iter().map(|&i| points[i]).sum::<Vector3<f64>>() / on.len() as f64;
            let x = (points[on[0]] - middle).normalize();
            let y = n.cross(&x);
            let angle = |i: &usize| {
                let d = points[*i] - middle;
                d.dot(&y).atan2(d.dot(&x))
            };
            on.sort_by(|i, j| angle(i).total_cmp(&angle(j)));
            on
        });
        let loops = loops.collect();
        Self::from_loops(points.to_vec(), loops, true)
    }

    fn from_loops(vertices: Vec<Vector3<f64>>, loops: Vec<Vec<usize>>, convex: bool) -> Self {
        let faces: Vec<Face> = loops
            .into_iter()
            .map(|loop_| {
                // Newell's normal: right for any simple polygon, also a concave one.
                let n = loop_.len();
                let normal: Vector3<f64> = (0..n)
                    .map(|k| vertices[loop_[k]].cross(&vertices[loop_[(k + 1) % n]]))
                    .sum::<Vector3<f64>>()
                    .normalize();
                Face { normal, offset: normal.dot(&vertices[loop_[0]]), loop_ }
            })
            .collect();
        let mut edges: Vec<Edge> = Vec::new();
        for (f, face) in faces.iter().enumerate() {
            let n = face.loop_.len();
            for k in 0..n {
                let ends = [face.loop_[k], face.loop_[(k + 1) % n]];
                match edges.iter_mut().find(|e| e.ends == [ends[1], ends[0]]) {
                    Some(edge) => edge.faces[1] = f,
                    None => edges.push(Edge { ends, faces: [f, f] }),
                }
            }
        }
        Polyhedron { vertices, faces, edges, convex }
    }

    /// Outward normals of the faces.
    pub fn face_normals(&self) -> Vec<Vector3<f64>> {
        self.faces.iter().map(|f| f.normal).collect()
    }

    /// Writes the visible contour.
    pub(super) fn outline(&self, eye: &Vector3<f64>, out: &mut Outline) {
        // A bit a face; records have at most 26 faces of prisms, hulls at most 92.
        let mut seen = 0u128;
        for (k, face) in self.faces.iter().enumerate().take(128) {
            seen |= u128::from(face.normal.dot(eye) > face.offset) << k;
        }
        out.points.extend_from_slice(&self.vertices);
        for (part, edge) in self.edges.iter().enumerate() {
            let [a, b] = edge.faces.map(|f| seen >> f & 1 == 1);
            if !(a || b) {
                continue;
            }
            let hidden = edge.faces[usize::from(a)];
            let (kind, away) = match a && b {
                true => (Kind::Crease, None),
                false => (Kind::Silhouette, Some(self.faces[hidden].normal)),
            };
            let line = Line {
                ends: edge.ends.map(|v| v as u16),
                kind,
                away,
                part: part as u16,
                along: 0.0,
            };
            if self.convex {
                out.lines.push(line);
            } else {
                self.visible_pieces(eye, edge, line, out);
            }
        }
    }

    fn visible_pieces(&self, eye: &Vector3<f64>, edge: &Edge, whole: Line, out: &mut Outline) {
        let [from, to] = edge.ends.map(|v| self.vertices[v]);
        let first = out.points.len();
        let step = (to - from).norm() / PIECES as f64;
        out.points.extend((0..=PIECES).map(|k| from.lerp(&to, k as f64 / PIECES as f64)));
        for k in first..first + PIECES {
            let middle = (out.points[k] + out.points[k + 1]) / 2.0;
            if !self.hides(&middle, eye, edge) {
                let along = step * (k - first) as f64;
                out.lines.push(Line { ends: [k as u16, k as u16 + 1], along, ..whole });
            }
        }
    }

    /// Whether some face other than the edge's own lies between a point and the eye.
    fn hides(&self, point: &Vector3<f64>, eye: &Vector3<f64>, edge: &Edge) -> bool {
        let others = self.faces.iter().enumerate().filter(|(f, _)| !edge.faces.contains(f));
        others.map(|(_, face)| face).any(|face| {
            let (a, b) = (face.normal.dot(point) - face.offset, face.normal.dot(eye) - face.offset);
            if a * b >= 0.0 || a.abs() < WELD {
                return false;
            }
            let hit = point.lerp(eye, a / (a - b));
            self.inside(face, &hit)
        })
    }

    /// Whether a point of a face's plane lies within the face: winding number by summed angles.
    fn inside(&self, face: &Face, point: &Vector3<f64>) -> bool {
        let n = face.loop_.len();
        let turn: f64 = (0..n)
            .map(|k| {
                let a = self.vertices[face.loop_[k]] - point;
                let b = self.vertices[face.loop_[(k + 1) % n]] - point;
                face.normal.dot(&a.cross(&b)).atan2(a.dot(&b))
            })
            .sum();
        turn.abs() > 1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Contour, Model};

    fn lengths(body: &Polyhedron, eye: Vector3<f64>, kind: Kind) -> f64 {
        let mut out = Contour::new();
        Model::Polyhedron(body.clone()).contour(&eye, true, &mut out);
        out.iter().filter(|s| s.kind == kind).map(|s| (s.to - s.from).norm()).sum()
    }

    #[test]
    fn a_box_from_a_corner_shows_six_outer_and_three_inner_edges() {
        let body = Polyhedron::cuboid(Vector3::new(0.1, 0.2, 0.3));
        let eye = Vector3::new(1.0, 1.0, 1.0);
        assert!((lengths(&body, eye, Kind::Silhouette) - 1.2).abs() < 1e-12);
        assert!((lengths(&body, eye, Kind::Crease) - 0.6).abs() < 1e-12);
    }

    #[test]
    fn a_hull_of_a_box_is_the_box() {
        let body = Polyhedron::cuboid(Vector3::new(0.1, 0.2, 0.3));
        let mut points = body.vertices.clone();
        points.push(Vector3::new(0.01, 0.0, 0.02));
        let hull = Polyhedron::hull(&points);
        assert_eq!((hull.faces.len(), hull.edges.len()), (6, 12));
        let eye = Vector3::new(0.8, -1.0, 1.2);
        for kind in [Kind::Silhouette, Kind::Crease] {
            assert!((lengths(&body, eye, kind) - lengths(&hull, eye, kind)).abs() < 1e-12);
        }
    }

    #[test]
    fn a_notch_hides_its_own_floor() {
        // An L from above-left: the notch's inner corner is seen only from its open side.
        let outline = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.0], [0.0, 0.0], [0.0, 0.1], [-0.1, 0.1]];
        let body = Polyhedron::prism(&outline, 0.2);
        assert!(!body.convex);
        let inner = |eye| {
            let mut out = Contour::new();
            Model::Polyhedron(body.clone()).contour(&eye, true, &mut out);
            out.iter()
                .filter(|s| [s.from, s.to].iter().all(|p| p.x.abs() < 1e-9 && p.y.abs() < 1e-9))
                .map(|s| (s.to - s.from).norm())
                .sum::<f64>()
        };
        assert!((inner(Vector3::new(1.0, 1.0, 0.0)) - 0.2).abs() < 1e-9);
        assert!(inner(Vector3::new(-1.0, -1.0, 0.3)) < 1e-9);
    }
}
