//! Two views of an object in a pose: which point a pixel of the first shows, and where the second
//! should show the square about it.
//!
//! **In:** a refined pose. **Out:** a [`Place`] for every pixel of the first view that shows the object or
//! what it rests on, with what the unknowns do to it.

use nalgebra::{Matrix2, Point3, RowVector2, Vector2, Vector3};
use vergence_geometry::Transform;

use super::GROUND;
use super::square::Place;
use crate::directional::equations::VIEWS;
use crate::directional::level::Level;
use crate::directional::refine::Refined;
use crate::directional::search::{Search, Sight};
use crate::directional::sites::{ByShared, FORM_AT};
use crate::model::Rest;

/// Squares keep this far from the surface's border (px): edges of other surfaces blur into it.
const MARGIN_PX: f64 = 0.5;
/// Cosine to the line of sight from which on a surface of the object is seen well enough, and the ground,
/// which has more to see.
const FACING: f64 = 0.3;
const GRAZING: f64 = 0.15;
/// Around a landmark there is the tag's housing, which is higher than the surface (m).
const HOUSING: f64 = 0.012;
/// Where a surface comes nearer by a metre, its print must move by more than this (px).
const LEAST_BY_SURFACE: f64 = 40.0;

/// The plane on which the object rests.
struct Ground {
    rest: Rest,
    /// Where the vertical through the object's middle meets it (object frame, m).
    foot: Vector3<f64>,
    /// Two unit vectors along it (object frame).
    across: [Vector3<f64>; 2],
}

/// A point that the first view sees.
#[derive(Clone, Copy)]
pub struct Seen {
    /// Where it is (object frame).
    p: Vector3<f64>,
    /// The surface's number.
    pub part: u16,
    /// Its outward unit normal there (object frame).
    normal: Vector3<f64>,
}

/// Two views of an object in a pose.
pub struct Pair<'a> {
    search: &'a Search<'a>,
    pub sights: [&'a Sight<'a>; VIEWS],
    pose: Transform,
    size: f64,
    /// `optical_from_object` of either view.
    from_object: [Transform; VIEWS],
    object_from_first: Transform,
    /// The views' eyes in the object frame.
    eyes: [Vector3<f64>; VIEWS],
    /// Where the first picture shows the tag's lights, and how far around there may be its housing (px).
    tags: Vec<(Vector2<f64>, f64)>,
    /// What the object rests on, if it seems to.
    ground: Option<Ground>,
}

impl<'a> Pair<'a> {
    /// The two views as a refined state has them turned; `None` when there is but one.
    pub fn new(search: &'a Search, refined: &Refined) -> Option<Self> {
        let [first, second] = search.sights else { return None };
        let sights = [first, second];
        let from_object = std::array::from_fn(|v| {
            let turned = Transform::rotation(refined.turns[v].push(0.0));
            turned * sights[v].optical_from_base * refined.pose
        });
        let [object_from_first, object_from_second] = from_object.map(|t: Transform| t.inverse());
        let eyes = [object_from_first, object_from_second].map(|t| t.translation.vector);
        let (pose, size) = (refined.pose, refined.form.x.exp());
        let camera = &sights[0].view.camera;
        let landmarks = search.query.record.landmarks.iter();
        let tags = landmarks.filter_map(|l| {
            let p = from_object[0] * Point3::from(Vector3::from(l.position) * size);
            Some((camera.project(&p)?.coords, HOUSING * camera.fx / p.z))
        });
        let tags = tags.collect();
        let ground = search.rest(refined).map(|(rest, _)| {
            let foot = rest.down * search.model.reach(&rest.down) * size;
            let across = rest.down.cross(&Vector3::ith(rest.down.iamin(), 1.0)).normalize();
            Ground { rest, foot, across: [across, across.cross(&rest.down)] }
        });
        Some(Pair {
            search,
            sights,
            pose,
            size,
            from_object,
            object_from_first,
            eyes,
            tags,
            ground,
        })
    }

    /// The object seems to rest on something.
    pub fn rests(&self) -> bool {
        self.ground.is_some()
    }

    /// The point that a pixel of the first picture shows, of the object or of what it rests on.
    pub fn surface(&self, pixel: Vector2<f64>) -> Option<Seen> {
        let ray =
            self.object_from_first.rotation * self.sights[0].view.camera.unproject(&pixel.into());
        let eye = self.eyes[0] / self.size;
        let Some(hit) = self.search.model.first_hit(&eye, &ray) else { return self.ground(&ray) };
        let seen = hit.normal.dot(&ray) < -FACING;
        let p = (eye + ray * hit.distance) * self.size;
        seen.then_some(Seen { p, part: hit.part, normal: hit.normal })
    }

    /// Where a ray of the first view meets what the object rests on.
    fn ground(&self, ray: &Vector3<f64>) -> Option<Seen> {
        let Ground { rest, foot, .. } = self.ground.as_ref()?;
        let descent = rest.down.dot(ray);
        if descent < GRAZING {
            return None;
        }
        let eye = self.eyes[0];
        let p = eye + ray * (rest.down.dot(&(foot - eye)) / descent);
        Some(Seen { p, part: GROUND, normal: -rest.down })
    }

    /// Where the square of half a side about a pixel of the first level is in the second, and its shift along
    /// the epipolar line by the surface along its own normal (px per m).
    pub fn carry_over(&self, x: usize, y: usize, half: usize, seen: Seen) -> Option<(Place, f64)> {
        let Seen { p, part, normal } = seen;
        let [first, second] = self.sights;
        let pixel = pixel_of(&first.fine, x, y);
        let to_second = (self.eyes[1] - p).normalize();
        let on_ground = part == GROUND;
        if normal.dot(&to_second) < if on_ground { GRAZING } else { FACING } {
            return None;
        }
        let half = half as f64;
        let corner = half + MARGIN_PX;
        let beside_tag = |(tag, radius): &(Vector2<f64>, f64)| {
            (tag - pixel).map(|d| (d.abs() - half).max(0.0)).norm() < *radius
        };
        if self.tags.iter().any(beside_tag) {
            return None;
        }
        for (dx, dy) in [(-corner, -corner), (corner, -corner), (corner, corner), (-corner, corner)]
        {
            let at = self.surface(pixel + Vector2::new(dx, dy))?;
            if at.part != part {
                return None;
            }
        }
        let project = |p: &Vector3<f64>| {
            let q = self.from_object[1] * Point3::from(*p);
            second.view.camera.project_with_jacobian(&q).map(|(pixel, by)| (pixel.coords, q, by))
        };
        let (there, q, by_point) = project(&p)?;
        let beside =
            |dx: f64, dy: f64| Some(project(&self.surface(pixel + Vector2::new(dx, dy))?.p)?.0);
        let [left, right] = [beside(-half, 0.0)?, beside(half, 0.0)?];
        let [above, below] = [beside(0.0, -half)?, beside(0.0, half)?];
        let slope = |a: Vector2<f64>, b: Vector2<f64>| (b - a) / (2.0 * half);
        let bend = |a: Vector2<f64>, b: Vector2<f64>| (a + b - there * 2.0) / (2.0 * half * half);
        // Along the first view's ray: the epipolar line.
        let ray = (p - self.eyes[0]).normalize();
        let by_object = by_point * self.from_object[1].rotation.to_rotation_matrix().into_inner();
        let along: Vector2<f64> = by_object * ray / normal.dot(&ray);
        let by_surface = along.norm();
        if by_surface < LEAST_BY_SURFACE {
            return None;
        }
        let epipolar = along / by_surface;
        let (u, v) = second.fine.from_picture(there.x, there.y);
        // A turned first camera casts its ray elsewhere onto the surface.
        let distance = (p - self.eyes[0]).norm();
        let in_first = self.from_object[0].rotation * ray;
        let by_first = |axis: Vector3<f64>| {
            let turned = self.object_from_first.rotation * in_first.cross(&axis);
            let moved = turned - ray * (normal.dot(&turned) / normal.dot(&ray));
            by_object * moved * distance
        };
        let by_second = |axis: Vector3<f64>| by_point * axis.cross(&q.coords);
        let place = Place {
            middle: (x, y),
            there: Vector2::new(u, v),
            affine: Matrix2::from_columns(&[slope(left, right), slope(above, below)]),
            bend: [bend(left, right), bend(above, below)],
            epipolar,
            by_turn: [
                Matrix2::from_columns(&[Vector3::x(), Vector3::y()].map(by_first)),
                Matrix2::from_columns(&[Vector3::x(), Vector3::y()].map(by_second)),
            ],
        };
        Some((place, by_surface))
    }

    /// How far a point's surface moves there along its normal (m) by the shared unknowns.
    pub fn by_shared(&self, at: &Seen) -> ByShared {
        let (lever, out) = (self.pose.rotation * at.p, self.pose.rotation * at.normal);
        // What the object rests on turns with it only where that keeps it from turning.
        let turn = match &self.ground {
            Some(ground) if at.part == GROUND => ground.rest.held * at.p.cross(&at.normal),
            _ => at.p.cross(&at.normal),
        };
        let mut by_shared = ByShared::zeros();
        by_shared.fixed_columns_mut::<3>(0).copy_from(&(self.pose.rotation * turn).transpose());
        by_shared.fixed_columns_mut::<3>(3).copy_from(&out.transpose());
        by_shared[FORM_AT] = out.dot(&lever);
        by_shared
    }

    /// How far a point's surface moves there along its normal (m) where what the object rests on slopes
    /// against it, in two directions (m per rad).
    pub fn by_slope(&self, at: &Seen) -> RowVector2<f64> {
        match &self.ground {
            Some(ground) if at.part == GROUND => {
                let beside = at.p - ground.foot;
                ground.across.map(|across| beside.dot(&across)).into()
            }
            _ => RowVector2::zeros(),
        }
    }
}

/// Picture pixel of a pixel of a level at full resolution.
pub fn pixel_of(level: &Level, x: usize, y: usize) -> Vector2<f64> {
    Vector2::new((x + level.origin.0) as f64, (y + level.origin.1) as f64)
}
