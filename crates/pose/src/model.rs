//! Size models: which contour segments of an object a camera sees.
//!
//! **In:** the record's shape, and the eye (camera centre) in the object frame. **Out:** straight
//! [`Segment`]s with 3D end points in the object frame; curved contours (rims) come as chords.
//! Hidden lines are removed. Contours of curved surfaces (a cylinder's limbs, a sphere's outline)
//! are those seen from exactly that eye, so they must be asked for again when the pose changes;
//! to first order they move with the body (the surface's normal is across the line of sight), so a
//! refinement may use the points as if they were fixed.
//!
//! Adding a shape means a variant here and its arm in [`Model::new`] and [`Model::contour`].

mod polyhedron;
mod revolution;

use nalgebra::{Matrix3, Vector3};
use vergence_geometry::Transform;
use vergence_tag::{Record, Shape};

use polyhedron::Polyhedron;
use revolution::Frustum;

/// What makes a contour segment visible.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The outline where a face ends: object on one side, whatever is behind on the other.
    Silhouette,
    /// The outline where a curved wall turns away smoothly.
    Limb,
    /// An edge between two visible faces of the object; its contrast may be poor.
    Crease,
    /// The open rim of a cup: a lip of unknown thickness, of which the outer or the inner edge may be
    /// the one that shows.
    Rim,
}

/// A straight piece of visible contour, object frame (m).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// One end.
    pub from: Vector3<f64>,
    /// Other end.
    pub to: Vector3<f64>,
    /// What it is.
    pub kind: Kind,
    /// Outward normal of the flat face that turns away at a silhouette, or of the wall at a limb: where
    /// an object rests on that face or line there is a shadow, not a background, on the other side.
    pub away: Option<Vector3<f64>>,
    /// Which part of the body it lies on: the same number means the same edge of a polyhedron, rim
    /// or side of a wall for every eye.
    pub part: u16,
    /// How far along the part it begins (m).
    pub along: f64,
}

/// The visible contour: reused between calls so that the search does not allocate.
pub type Contour = Vec<Segment>;

/// The visible contour as lines between shared points: what the search projects, each point once.
#[derive(Debug, Clone, Default)]
pub(crate) struct Outline {
    /// End points, object frame (m).
    pub points: Vec<Vector3<f64>>,
    /// Lines between them.
    pub lines: Vec<Line>,
}

/// A line of an [`Outline`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct Line {
    /// Its ends.
    pub ends: [u16; 2],
    /// What it is.
    pub kind: Kind,
    /// As in [`Segment`].
    pub away: Option<Vector3<f64>>,
    /// As in [`Segment`].
    pub part: u16,
    /// As in [`Segment`].
    pub along: f64,
}

/// Where a ray meets an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hit {
    /// How far from the eye, in lengths of the ray's direction.
    pub distance: f64,
    /// Outward unit normal of the surface there.
    pub normal: Vector3<f64>,
    /// Which of its smooth surfaces: the same number means the same one for every eye.
    pub part: u16,
}

impl Outline {
    fn with_capacity(count: usize) -> Self {
        Outline { points: Vec::with_capacity(count), lines: Vec::with_capacity(count) }
    }

    fn clear(&mut self) {
        self.points.clear();
        self.lines.clear();
    }
}

/// Chords of a whole circle: true to a thousandth of the radius.
const FINE_CHORDS: usize = 72;
/// Chords of a whole circle in the search.
const COARSE_CHORDS: usize = 16;

/// An object's form.
#[derive(Debug, Clone, PartialEq)]
pub enum Model {
    /// Flat faces: box, prism, convex body.
    Polyhedron(Polyhedron),
    /// Cylinder or cup.
    Frustum(Frustum),
    /// Ball of this radius (m).
    Sphere(f64),
}

impl Model {
    /// The model of a record's shape; the record must have passed its own validation.
    pub fn new(record: &Record) -> Self {
        match &record.shape {
            Shape::Box => Self::bounding_box(record),
            Shape::Cylinder { diameter, height } => {
                Model::Frustum(Frustum::new(diameter / 2.0, diameter / 2.0, *height, false))
            }
            Shape::Cup { top_diameter, bottom_diameter, height } => Model::Frustum(Frustum::new(
                top_diameter / 2.0,
                bottom_diameter / 2.0,
                *height,
                true,
            )),
            Shape::Sphere { diameter } => Model::Sphere(diameter / 2.0),
            Shape::Prism { outline, height } => {
                Model::Polyhedron(Polyhedron::prism(outline, *height))
            }
            Shape::Convex { vertices } => Model::Polyhedron(Polyhedron::hull(
                &vertices.iter().map(|&v| v.into()).collect::<Vec<_>>(),
            )),
        }
    }

    /// The bounding box of a record, whatever its shape: the paper's model.
    pub fn bounding_box(record: &Record) -> Self {
        Model::Polyhedron(Polyhedron::cuboid(record.bounding_box.sides().into()))
    }

    /// Visible contour for an eye in the object frame, written into `out` (cleared first).
    /// `fine` asks for enough chords that a rim is true to a thousandth of its radius, else a coarse
    /// polygon is given, good for ranking.
    pub fn contour(&self, eye: &Vector3<f64>, fine: bool, out: &mut Contour) {
        let mut outline = Outline::with_capacity(2 * FINE_CHORDS);
        self.outline(eye, fine, &mut outline);
        let at = |k: u16| outline.points[usize::from(k)];
        out.clear();
        out.extend(outline.lines.iter().map(|line| Segment {
            from: at(line.ends[0]),
            to: at(line.ends[1]),
            kind: line.kind,
            away: line.away,
            part: line.part,
            along: line.along,
        }));
    }

    /// [`Model::contour`] with shared points.
    pub(crate) fn outline(&self, eye: &Vector3<f64>, fine: bool, out: &mut Outline) {
        out.clear();
        let chords = if fine { FINE_CHORDS } else { COARSE_CHORDS };
        match self {
            Model::Polyhedron(body) => body.outline(eye, fine, out),
            Model::Frustum(body) => body.outline(eye, chords, out),
            Model::Sphere(radius) => revolution::sphere_outline(*radius, eye, chords, out),
        }
    }

    /// Where a ray from the eye (object frame, as the direction) first meets the object.
    pub(crate) fn first_hit(&self, eye: &Vector3<f64>, along: &Vector3<f64>) -> Option<Hit> {
        match self {
            Model::Polyhedron(body) => body.first_hit(eye, along),
            Model::Frustum(body) => body.first_hit(eye, along),
            Model::Sphere(radius) => revolution::sphere_hit(*radius, eye, along),
        }
    }

    /// How far the object reaches from its frame's origin in a direction (unit).
    pub(crate) fn reach(&self, direction: &Vector3<f64>) -> f64 {
        match self {
            Model::Polyhedron(body) => body.reach(direction),
            Model::Frustum(body) => body.reach(direction),
            Model::Sphere(radius) => *radius,
        }
    }

    /// The motions of the object frame that leave its form as it is to within a tolerance (m), of a
    /// body with flat faces.
    pub fn symmetries(&self, tolerance: f64) -> Vec<Transform> {
        match self {
            Model::Polyhedron(body) => body.symmetries(tolerance),
            Model::Frustum(_) | Model::Sphere(_) => vec![Transform::identity()],
        }
    }

    /// Directions (object frame, unit) in which flat faces are, on which the object may stand.
    pub fn resting_directions(&self) -> Vec<Vector3<f64>> {
        match self {
            Model::Polyhedron(body) => body.face_normals().collect(),
            Model::Frustum(_) => vec![-Vector3::z(), Vector3::z()],
            Model::Sphere(_) => vec![-Vector3::z()],
        }
    }

    /// How the object rests that has this direction (object frame, unit) below: on the face, the line
    /// of its wall or the point that is nearest.
    pub fn rest(&self, below: &Vector3<f64>) -> Rest {
        let near = |a: &Vector3<f64>, b: &Vector3<f64>| a.dot(below).total_cmp(&b.dot(below));
        match self {
            // Any point of a ball is as good, and nothing keeps it from rolling.
            Model::Sphere(_) => Rest { down: *below, held: Matrix3::zeros() },
            Model::Polyhedron(body) => {
                Rest::on(body.face_normals().max_by(near).unwrap_or(-Vector3::z()))
            }
            Model::Frustum(body) => {
                let (wall, end) = (body.wall(below), Vector3::z() * 1f64.copysign(below.z));
                if near(&wall, &end).is_lt() {
                    return Rest::on(end);
                }
                let axis = wall.cross(&Vector3::z()).normalize();
                Rest { down: wall, held: axis * axis.transpose() }
            }
        }
    }
}

/// How an object rests.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rest {
    /// Direction of what is below (object frame, unit).
    pub down: Vector3<f64>,
    /// Projection onto the turns (object frame) that this keeps it from: a face is kept from tilting, a
    /// wall may roll.
    pub held: Matrix3<f64>,
}

impl Rest {
    /// On a flat face that looks this way.
    pub fn on(down: Vector3<f64>) -> Self {
        Rest { down, held: Matrix3::identity() - down * down.transpose() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn convex_bodies() -> Vec<(Model, Vector3<f64>)> {
        let corners = [[0.0, 0.05, 0.04], [0.05, -0.03, 0.04], [-0.04, -0.03, 0.04]];
        let hull = corners.iter().flat_map(|c| [Vector3::from(*c), Vector3::from(*c) * -1.0]);
        let hull: Vec<_> = hull.collect();
        vec![
            (
                Model::Polyhedron(Polyhedron::cuboid(Vector3::new(0.1, 0.16, 0.06))),
                Vector3::new(0.05, 0.08, 0.03),
            ),
            (Model::Polyhedron(Polyhedron::hull(&hull)), Vector3::new(0.05, 0.05, 0.04)),
            (Model::Frustum(Frustum::new(0.04, 0.04, 0.12, false)), Vector3::new(0.04, 0.04, 0.06)),
            (Model::Frustum(Frustum::new(0.05, 0.03, 0.1, true)), Vector3::new(0.05, 0.05, 0.05)),
            (Model::Sphere(0.06), Vector3::repeat(0.06)),
        ]
    }

    proptest! {
        /// Outlines and surfaces are made in different ways: a line of sight just inside of an outline
        /// meets the body, one just outside of it does not.
        #[test]
        fn lines_of_sight_meet_a_body_within_its_outline(
            azimuth in -3.1..3.1f64, height in -1.0..1.0f64, distance in 0.4..1.5f64,
        ) {
            let around = Vector3::new(azimuth.cos(), azimuth.sin(), height).normalize();
            let eye = around * distance;
            for (model, half) in convex_bodies() {
                let mut contour = Contour::new();
                model.contour(&eye, true, &mut contour);
                let outer = contour.iter().filter(|s| matches!(s.kind, Kind::Silhouette | Kind::Limb));
                for segment in outer {
                    let ray = segment.from.lerp(&segment.to, 0.5) - eye;
                    // A line that is seen end on has no two sides.
                    if (segment.to - segment.from).cross(&ray.normalize()).norm() < 0.003 {
                        continue;
                    }
                    let across = (segment.to - segment.from).cross(&ray).normalize() * 0.001;
                    let hits = [ray + across, ray - across].map(|r| (r, model.first_hit(&eye, &r)));
                    prop_assert!(hits[0].1.is_some() != hits[1].1.is_some(), "{model:?} {segment:?}");
                    for (ray, hit) in hits.iter().filter_map(|(r, h)| h.map(|h| (r, h))) {
                        let p = eye + ray * hit.distance;
                        prop_assert!(hit.normal.dot(ray) < 0.0 && (hit.normal.norm() - 1.0).abs() < 1e-9);
                        prop_assert!((p.abs() - half).max() < 1e-9, "{p} of {model:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn what_is_seen_through_an_open_top_is_no_surface() {
        let (eye, down) = (Vector3::new(0.01, 0.0, 0.6), -Vector3::z());
        let hit =
            |open| Model::Frustum(Frustum::new(0.04, 0.04, 0.12, open)).first_hit(&eye, &down);
        assert_eq!(hit(true), None);
        assert_eq!(hit(false).map(|h| h.normal), Some(Vector3::z()));
        assert!((hit(false).unwrap().distance - 0.54).abs() < 1e-12);
    }

    #[test]
    fn a_notch_shows_the_surface_behind_it() {
        let outline =
            [[0.05, 0.05], [-0.05, 0.05], [-0.05, -0.05], [0.0, -0.05], [0.0, 0.0], [0.05, 0.0]];
        let angle = Model::Polyhedron(Polyhedron::prism(&outline, 0.1));
        let eye = Vector3::new(0.025, -0.5, 0.0);
        let hit = angle.first_hit(&eye, &Vector3::y()).unwrap();
        assert!((hit.distance - 0.5).abs() < 1e-12 && (hit.normal + Vector3::y()).norm() < 1e-9);
    }
}
