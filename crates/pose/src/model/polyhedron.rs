//! Bodies with flat faces: cuboid, extruded polygon, convex hull.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use vergence_geometry::Transform;

use super::{Hit, Kind, Line, Outline};

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

/// Points closer than this (m) count as one, and a point this near to a plane lies on it.
const WELD: f64 = 1e-6;
/// Faces that bend by less than this (rad) show no edge: a record's corners are rounded, and a face of
/// more than three of them comes as several that are nearly in one plane.
const BEND: f64 = 0.03;
/// Faces that are looked at: of a prism there are at most 26, of a hull of 48 corners 92.
const MOST_FACES: usize = 128;
/// A concave body's edges are cut into so many pieces to see which are hidden, and into so many in the
/// search.
const FINE_PIECES: usize = 12;
const COARSE_PIECES: usize = 3;

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

    /// The convex hull of a few points, by trying every plane through three of them, of which a record
    /// has at most 48. Points that are no corner of it do not matter.
    pub fn hull(points: &[Vector3<f64>]) -> Self {
        let mut corners: Vec<Vector3<f64>> = Vec::new();
        for p in points {
            if corners.iter().all(|c| (c - p).norm() > WELD) {
                corners.push(*p);
            }
        }
        let mut planes: Vec<(Vector3<f64>, f64)> = Vec::new();
        for (i, a) in corners.iter().enumerate() {
            for (j, b) in corners.iter().enumerate().skip(i + 1) {
                for c in &corners[j + 1..] {
                    let Some(n) = (b - a).cross(&(c - a)).try_normalize(WELD * WELD) else {
                        continue;
                    };
                    for n in [n, -n] {
                        let offset = n.dot(a);
                        let outside = |p: &Vector3<f64>| n.dot(p) > offset + WELD;
                        // Three points of a plane that is there already make no other.
                        let known = |(m, o): &(Vector3<f64>, f64)| {
                            m.dot(&n) > 0.0 && [a, b, c].iter().all(|p| lies_on(m, *o, p))
                        };
                        if !corners.iter().any(outside) && !planes.iter().any(known) {
                            planes.push((n, offset));
                        }
                    }
                }
            }
        }
        let loops = planes.iter().map(|(n, offset)| {
            let on = |&i: &usize| lies_on(n, *offset, &corners[i]);
            around(&corners, n, (0..corners.len()).filter(on))
        });
        let loops = loops.filter(|l| l.len() > 2).take(MOST_FACES).collect();
        Self::from_loops(corners, loops, true)
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
        // Between two faces of one plane, as at a corner within an edge of a prism's outline, there is
        // nothing to see.
        let bends = |e: &Edge| (faces[e.faces[0]].normal - faces[e.faces[1]].normal).norm() > BEND;
        edges.retain(bends);
        Polyhedron { vertices, faces, edges, convex }
    }

    /// Outward normals of the faces.
    pub fn face_normals(&self) -> impl Iterator<Item = Vector3<f64>> {
        self.faces.iter().map(|f| f.normal)
    }

    /// The motions of the object frame that put every edge onto an edge, to within a tolerance (m);
    /// the identity first.
    pub fn symmetries(&self, tolerance: f64) -> Vec<Transform> {
        let middle = self.middle();
        let corner = |i: usize| self.vertices[i] - middle;
        let used: Vec<usize> = (0..self.vertices.len())
            .filter(|i| self.edges.iter().any(|e| e.ends.contains(i)))
            .collect();
        let mut found = vec![Transform::identity()];
        // Two corners that span a plane with the middle say how the body is turned.
        let size = |i: &usize| corner(*i).norm();
        let Some(&a) = used.iter().max_by(|i, j| size(i).total_cmp(&size(j))) else { return found };
        let spanned = |i: &usize| corner(a).cross(&corner(*i)).norm();
        let Some(&b) = used.iter().max_by(|i, j| spanned(i).total_cmp(&spanned(j))) else {
            return found;
        };
        let near = |x: f64, y: f64| (x - y).abs() <= 2.0 * tolerance;
        let Some(here) = frame(corner(a), corner(b)) else { return found };
        for &i in used.iter().filter(|i| near(size(i), size(&a))) {
            for &j in used.iter().filter(|j| near(size(j), size(&b))) {
                if !near((corner(i) - corner(j)).norm(), (corner(a) - corner(b)).norm()) {
                    continue;
                }
                let Some(there) = frame(corner(i), corner(j)) else { continue };
                let turn = Rotation3::from_matrix_unchecked(there * here.transpose());
                let turn = UnitQuaternion::from_rotation_matrix(&turn);
                let shift = middle - turn * middle;
                let motion = Transform::from_parts(shift.into(), turn);
                let new = found.iter().all(|f| f.rotation.angle_to(&turn) > 0.01);
                if new && self.is_kept(&motion, tolerance) {
                    found.push(motion);
                }
            }
        }
        found
    }

    /// The middle of the body's edges: every symmetry leaves it where it is.
    fn middle(&self) -> Vector3<f64> {
        let ends = self.edges.iter().flat_map(|e| e.ends);
        ends.map(|i| self.vertices[i]).sum::<Vector3<f64>>() / (2 * self.edges.len()).max(1) as f64
    }

    /// Whether a motion puts every edge onto an edge.
    fn is_kept(&self, motion: &Transform, tolerance: f64) -> bool {
        let moved = |i: usize| motion.rotation * self.vertices[i] + motion.translation.vector;
        let near = |p: &Vector3<f64>, i: usize| (p - self.vertices[i]).norm() <= tolerance;
        self.edges.iter().all(|edge| {
            let [p, q] = edge.ends.map(moved);
            let onto = |[i, j]: [usize; 2]| near(&p, i) && near(&q, j);
            self.edges.iter().any(|e| onto(e.ends) || onto([e.ends[1], e.ends[0]]))
        })
    }

    /// Writes the visible contour; `fine` cuts the edges of a concave body into more pieces.
    pub(super) fn outline(&self, eye: &Vector3<f64>, fine: bool, out: &mut Outline) {
        // A bit a face.
        const { assert!(MOST_FACES <= u128::BITS as usize) };
        let mut seen = 0u128;
        for (k, face) in self.faces.iter().enumerate() {
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
                let pieces = if fine { FINE_PIECES } else { COARSE_PIECES };
                self.visible_pieces(eye, (edge, line), seen, pieces, out);
            }
        }
    }

    fn visible_pieces(
        &self,
        eye: &Vector3<f64>,
        (edge, whole): (&Edge, Line),
        seen: u128,
        pieces: usize,
        out: &mut Outline,
    ) {
        let [from, to] = edge.ends.map(|v| self.vertices[v]);
        let first = out.points.len();
        let step = (to - from).norm() / pieces as f64;
        out.points.extend((0..=pieces).map(|k| from.lerp(&to, k as f64 / pieces as f64)));
        for k in first..first + pieces {
            let middle = (out.points[k] + out.points[k + 1]) / 2.0;
            if !self.hides(&middle, eye, edge, seen) {
                let along = step * (k - first) as f64;
                out.lines.push(Line { ends: [k as u16, k as u16 + 1], along, ..whole });
            }
        }
    }

    /// As [`super::Model::reach`].
    pub(super) fn reach(&self, direction: &Vector3<f64>) -> f64 {
        self.vertices.iter().map(|v| v.dot(direction)).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Where a ray from the eye first meets the body: the distance in lengths of the direction, and the
    /// face.
    pub(super) fn first_hit(&self, eye: &Vector3<f64>, along: &Vector3<f64>) -> Option<Hit> {
        let faces = self.faces.iter().enumerate();
        let hits =
            faces.filter(|(_, face)| face.normal.dot(along) < 0.0).filter_map(|(k, face)| {
                let distance = (face.offset - face.normal.dot(eye)) / face.normal.dot(along);
                let met = distance > 0.0 && self.inside(face, &(eye + along * distance));
                met.then_some(Hit { distance, normal: face.normal, part: k as u16 })
            });
        hits.min_by(|a, b| a.distance.total_cmp(&b.distance))
    }

    /// Whether some face other than the edge's own lies between a point and the eye. A line of sight
    /// comes into a body through a face that is seen, so only those need be looked at.
    fn hides(&self, point: &Vector3<f64>, eye: &Vector3<f64>, edge: &Edge, seen: u128) -> bool {
        let faces = self.faces.iter().enumerate();
        let others = faces.filter(|(f, _)| seen >> f & 1 == 1 && !edge.faces.contains(f));
        others.map(|(_, face)| face).any(|face| {
            let (behind, before) =
                (face.normal.dot(point) - face.offset, face.normal.dot(eye) - face.offset);
            if behind > -WELD {
                return false;
            }
            self.inside(face, &point.lerp(eye, behind / (behind - before)))
        })
    }

    /// Whether a point of a face's plane lies within the face: a ray in the plane crosses its border
    /// an odd number of times. The plane is looked at along the axis that it faces most.
    fn inside(&self, face: &Face, point: &Vector3<f64>) -> bool {
        let along = face.normal.iamax();
        let flat = |p: &Vector3<f64>| (p[(along + 1) % 3], p[(along + 2) % 3]);
        let (x, y) = flat(point);
        let mut inside = false;
        let mut from = flat(&self.vertices[face.loop_[face.loop_.len() - 1]]);
        for &corner in &face.loop_ {
            let to = flat(&self.vertices[corner]);
            if (from.1 > y) != (to.1 > y)
                && x < from.0 + (to.0 - from.0) * (y - from.1) / (to.1 - from.1)
            {
                inside = !inside;
            }
            from = to;
        }
        inside
    }
}

/// Whether a point lies on a plane, to the accuracy with which planes through three points are known.
fn lies_on(normal: &Vector3<f64>, offset: f64, point: &Vector3<f64>) -> bool {
    (normal.dot(point) - offset).abs() < 10.0 * WELD
}

/// The corners of a convex face among points of its plane, counter-clockwise from outside: Andrew's
/// monotone chain. What lies within the face or on one of its edges is left out.
fn around(
    points: &[Vector3<f64>],
    normal: &Vector3<f64>,
    on: impl Iterator<Item = usize>,
) -> Vec<usize> {
    let x = normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize();
    let y = normal.cross(&x);
    let mut on: Vec<(f64, f64, usize)> =
        on.map(|i| (points[i].dot(&x), points[i].dot(&y), i)).collect();
    on.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    // Left of the line from a to b by more than the tolerance.
    let left = |a: &(f64, f64, usize), b: &(f64, f64, usize), p: &(f64, f64, usize)| {
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        dx * (p.1 - a.1) - dy * (p.0 - a.0) > WELD * dx.hypot(dy)
    };
    let half = |on: &mut dyn Iterator<Item = &(f64, f64, usize)>| {
        let mut chain: Vec<(f64, f64, usize)> = Vec::new();
        for p in on {
            while chain.len() > 1 && !left(&chain[chain.len() - 2], &chain[chain.len() - 1], p) {
                chain.pop();
            }
            chain.push(*p);
        }
        chain.pop();
        chain
    };
    let (below, above) = (half(&mut on.iter()), half(&mut on.iter().rev()));
    below.into_iter().chain(above).map(|p| p.2).collect()
}

/// Axes: along the first vector, and so that the second lies in the plane of the first two.
fn frame(a: Vector3<f64>, b: Vector3<f64>) -> Option<Matrix3<f64>> {
    let x = a.try_normalize(WELD)?;
    let z = a.cross(&b).try_normalize(WELD * WELD)?;
    Some(Matrix3::from_columns(&[x, z.cross(&x), z]))
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
        // Within the body, in a face, on an edge, and a corner again.
        points.push(Vector3::new(0.01, 0.0, 0.02));
        points.insert(0, Vector3::new(0.05, 0.01, 0.02));
        points.insert(3, Vector3::new(0.05, 0.1, 0.02));
        points.push(points[1]);
        let hull = Polyhedron::hull(&points);
        assert_eq!((hull.faces.len(), hull.edges.len()), (6, 12));
        let eye = Vector3::new(0.8, -1.0, 1.2);
        for kind in [Kind::Silhouette, Kind::Crease] {
            assert!((lengths(&body, eye, kind) - lengths(&hull, eye, kind)).abs() < 1e-12);
        }
    }

    #[test]
    fn a_corner_within_an_edge_shows_nothing() {
        let outline = [[-0.1, -0.1], [0.0, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]];
        let body = Polyhedron::prism(&outline, 0.3);
        let square = Polyhedron::cuboid(Vector3::new(0.2, 0.2, 0.3));
        let eye = Vector3::new(0.3, -1.0, 0.6);
        for kind in [Kind::Silhouette, Kind::Crease] {
            assert!((lengths(&body, eye, kind) - lengths(&square, eye, kind)).abs() < 1e-12);
        }
    }

    #[test]
    fn corners_that_are_rounded_are_those_of_the_same_body() {
        // Six trapezoids, whose corners to a tenth of a millimetre are in no plane.
        let rounded = |v: f64| (v * 1e4).round() / 1e4;
        let corner = |k: usize, radius: f64, z: f64| {
            let angle = std::f64::consts::TAU * k as f64 / 6.0;
            Vector3::new(rounded(radius * angle.cos()), rounded(radius * angle.sin()), z)
        };
        let ends = (0..6).flat_map(|k| [corner(k, 0.05, -0.04), corner(k, 0.0365, 0.04)]);
        let body = Polyhedron::hull(&ends.collect::<Vec<_>>());
        assert_eq!(body.edges.len(), 18);
        assert_eq!(body.symmetries(4e-4).len(), 6);
    }

    #[test]
    fn a_thin_plate_of_many_corners_has_no_more_faces_than_it_can() {
        let corner = |k: usize| {
            let (angle, r) = (2.4 * k as f64, 0.002 + 0.0001 * (k % 7) as f64);
            let z = 5e-5 * if k.is_multiple_of(2) { 1.0 } else { -1.0 };
            Vector3::new(r * angle.cos(), r * angle.sin(), z + 2e-6 * (k % 5) as f64)
        };
        let body = Polyhedron::hull(&(0..48).map(corner).collect::<Vec<_>>());
        assert!(body.faces.len() <= 92, "{} faces", body.faces.len());
        assert!(body.face_normals().all(|n| (n.norm() - 1.0).abs() < 1e-9));
    }

    #[test]
    fn a_body_is_mapped_onto_itself_by_the_turns_of_its_group() {
        let regular = |n: usize, at: [f64; 2]| -> Vec<[f64; 2]> {
            let angle = |k: usize| std::f64::consts::TAU * k as f64 / n as f64;
            (0..n).map(|k| [at[0] + 0.05 * angle(k).cos(), at[1] + 0.05 * angle(k).sin()]).collect()
        };
        let count = |body: &Polyhedron| body.symmetries(1e-4).len();
        // A regular prism: n turns about its axis, and n upside down.
        for n in [3, 5, 6] {
            assert_eq!(count(&Polyhedron::prism(&regular(n, [0.0, 0.0]), 0.2)), 2 * n);
        }
        for (sides, turns) in [([0.1, 0.2, 0.3], 4), ([0.1, 0.1, 0.3], 8), ([0.1, 0.1, 0.1], 24)] {
            assert_eq!(count(&Polyhedron::cuboid(sides.into())), turns);
        }
        let cube = Polyhedron::cuboid(Vector3::repeat(0.1));
        assert_eq!(count(&Polyhedron::hull(&cube.vertices)), 24);
        // Beside the origin its corners still come onto each other.
        let body = Polyhedron::prism(&regular(3, [0.02, -0.01]), 0.2);
        let turns = body.symmetries(1e-4);
        assert_eq!(turns.len(), 6);
        for turn in turns {
            for v in &body.vertices {
                let moved = turn.rotation * v + turn.translation.vector;
                assert!(body.vertices.iter().any(|w| (w - moved).norm() < 1e-9));
            }
        }
        // An L may only be turned over, about the diagonal of its notch.
        let outline = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.0], [0.0, 0.0], [0.0, 0.1], [-0.1, 0.1]];
        assert_eq!(count(&Polyhedron::prism(&outline, 0.2)), 2);
    }

    #[test]
    fn an_edge_that_is_hidden_in_part_is_seen_in_part() {
        // An L whose near arm hides the lower end of the far upright edge.
        let outline = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.0], [0.0, 0.0], [0.0, 0.1], [-0.1, 0.1]];
        let body = Polyhedron::prism(&outline, 0.2);
        let eye = Vector3::new(1.0, -1.0, 1.0);
        // The line of sight over the arm's far upper edge, at y = 0, ends on it at this height.
        let least = (0.1 - 0.1 / 1.1) / (1.0 / 1.1);
        for (fine, pieces) in [(true, FINE_PIECES), (false, COARSE_PIECES)] {
            let mut out = Contour::new();
            Model::Polyhedron(body.clone()).contour(&eye, fine, &mut out);
            let upright = |p: &Vector3<f64>| p.x.abs() < 1e-9 && (p.y - 0.1).abs() < 1e-9;
            out.retain(|s| upright(&s.from) && upright(&s.to));
            let seen: f64 = out.iter().map(|s| (s.to - s.from).norm()).sum();
            let rounding = 0.5 * 0.2 / pieces as f64;
            assert!((seen - (0.1 - least)).abs() <= rounding, "{fine}: {seen} m");
            assert!(seen > 0.0 && seen < 0.2, "{fine}: {seen} m");
            // Each piece knows its place on the edge, whose lower end is hidden.
            for s in &out {
                let middle = (s.from.z + s.to.z) / 2.0;
                let along = s.along + 0.1 / pieces as f64;
                let [up, down] = [along - 0.1, 0.1 - along];
                let place = if s.to.z > s.from.z { up } else { down };
                assert!(middle > least && (middle - place).abs() < 1e-9, "{fine}: {s:?}");
            }
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
