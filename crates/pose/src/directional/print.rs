//! Print on the object's surface that both views see.
//!
//! **In:** a pose, the model, two prepared views. **Out:** [`Patch`]es: small squares of the first
//! picture, carried over to the second by the surface that the pose puts there, and how far from that
//! place the second picture shows the same print. An outline says how far away an object is by where
//! it ends, which a rounded edge, a shadow or a lamp at one side move; print has no such faults, it is
//! as far away as the surface that it is on. Which print it is nobody needs to know.
//!
//! Only the shift along the epipolar line is measured: it is what depth is in. The surface's curve
//! within a square is followed to second order, without which a can seems to be millimetres further
//! away than it is. A slope of brightness across the square belongs to lamp and shading, not to print,
//! and is taken out of both; so is their contrast ([`square`]).

mod square;
#[cfg(test)]
mod tests;

use std::ops::Range;

use nalgebra::{Matrix2, Point2, Point3, RowVector2, Vector2, Vector3};
use vergence_geometry::Transform;

use super::equations::{Move, VIEWS};
use super::level::Level;
use super::refine::Refined;
use super::search::{Search, Sight};
use super::sites::{ByShared, FORM_AT, Site};
use square::{HALF, Place, find, print_at};

/// Distance from square to square (px), times the working scale: large objects have enough of them.
const STEP: usize = 2;
/// Squares keep this far from the surface's border (px): edges of other surfaces blur into it.
const MARGIN_PX: f64 = 0.5;
/// Cosine to the line of sight from which on a surface is seen well enough.
const FACING: f64 = 0.3;
/// Around a landmark there is the tag's housing, which is higher than the surface (m).
const HOUSING: f64 = 0.012;
/// Where a surface comes nearer by a metre, its print must move by more than this (px).
const LEAST_BY_SURFACE: f64 = 40.0;

/// Deviation of a whole surface from where the record has it (m): bulging sides, labels.
pub(super) const SURFACE_SD: f64 = 0.0004;
/// Deviation of where one view sees a surface's print from where the other does (px), and its degrees of
/// freedom.
pub(super) const PRINT_SD_PX: f64 = 0.06;
pub(super) const PRINT_TAIL: f64 = 3.0;
/// How many measurements a square is worth, as squares overlap, and the degrees of freedom of its shift.
pub(super) const SQUARE_WORTH: f64 = 0.15;
pub(super) const SQUARE_TAIL: f64 = 3.0;
/// Squares that a surface must have: fewer are a highlight, or the shadow of a handle.
const LEAST_SQUARES: usize = 4;

/// A square of print seen by both views.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// Its middle in the first picture.
    pub pixel: Point2<f64>,
    /// Which surface of the object it is on.
    pub part: u16,
    /// How far along the epipolar line of the second view it is from where the pose puts it (px).
    pub residual: f64,
    /// Deviation of that by noise (px).
    pub noise_px: f64,
    /// Shift by the surface along its own normal (px per m).
    pub by_surface: f64,
    /// Shift by the shared unknowns (px per unit).
    pub by_shared: ByShared,
    /// Shift by small turns of each camera about its own x and y axes (px per rad).
    pub by_turn: [RowVector2<f64>; VIEWS],
}

/// A point of the object that the first view sees.
#[derive(Clone, Copy)]
struct Seen {
    /// Where it is (object frame).
    p: Vector3<f64>,
    /// The surface's number.
    part: u16,
    /// Its outward unit normal there (object frame).
    normal: Vector3<f64>,
}

impl Patch {
    /// What is left of the residual (px) when the unknowns have moved.
    pub(super) fn left(&self, moved: &Move) -> f64 {
        let turns = self.by_turn.iter().zip(&moved.own).map(|(by, turn)| (by * turn).x);
        self.residual - (self.by_shared * moved.shared).x - turns.sum::<f64>()
    }
}

impl Search<'_> {
    /// The squares of print that both views show of a refined object.
    pub(super) fn patches(&self, refined: &Refined) -> Vec<Patch> {
        let [first, second] = self.sights else { return Vec::new() };
        let level = &first.fine;
        let pair = Pair::new(self, refined, [first, second]);
        let step = STEP * first.coarse.scale;
        let [columns, rows] = extent(&refined.sites, level);
        let mut out = Vec::new();
        for y in rows.step_by(step) {
            for x in columns.clone().step_by(step) {
                let Some(middle) = pair.surface(pixel_of(level, x, y)) else { continue };
                let Some(here) = print_at(level, x, y) else { continue };
                let Some((place, by_surface)) = pair.carry_over(x, y, middle) else { continue };
                let Some(found) = find(&here, level, &second.fine, &place) else { continue };
                out.push(Patch {
                    pixel: pixel_of(level, x, y).into(),
                    part: middle.part,
                    residual: found.shift,
                    noise_px: found.noise_px,
                    by_surface,
                    by_shared: pair.by_shared(&middle) * by_surface,
                    by_turn: place.by_turn.map(|by| found.along.transpose() * by),
                });
            }
        }
        out.sort_by_key(|p: &Patch| p.part);
        let surfaces = out.chunk_by(|a, b| a.part == b.part);
        surfaces.filter(|squares| squares.len() >= LEAST_SQUARES).flatten().cloned().collect()
    }
}

/// What print says for the pose that it was found with (nats), the more the more of it both views see
/// on the object's surfaces and the nearer it is to where it should be. A surface that has it elsewhere
/// says nothing: it may be gloss.
pub(super) fn evidence(patches: &[Patch]) -> f64 {
    let of_surface = |squares: &[Patch]| {
        let (mut weight, mut shift, mut by_surface) = (0.0, 0.0, 0.0);
        for patch in squares {
            let w = SQUARE_WORTH / (patch.noise_px * patch.noise_px);
            weight += w;
            shift += w * patch.residual;
            by_surface += w * patch.by_surface;
        }
        let (shift, by_surface) = (shift / weight, by_surface / weight);
        let variance =
            PRINT_SD_PX * PRINT_SD_PX + (SURFACE_SD * by_surface).powi(2) + weight.recip();
        let off = 0.5 * (PRINT_TAIL + 1.0) * (shift * shift / (PRINT_TAIL * variance)).ln_1p();
        (SQUARE_WORTH * squares.len() as f64 - off).max(0.0)
    };
    patches.chunk_by(|a, b| a.part == b.part).map(of_surface).sum()
}

/// Two views of an object in a pose.
struct Pair<'a> {
    search: &'a Search<'a>,
    sights: [&'a Sight<'a>; VIEWS],
    pose: Transform,
    size: f64,
    /// `optical_from_object` of either view.
    from_object: [Transform; VIEWS],
    object_from_first: Transform,
    /// The views' eyes in the object frame.
    eyes: [Vector3<f64>; VIEWS],
    /// Where the first picture shows the tag's lights, and how far around there may be its housing (px).
    tags: Vec<(Vector2<f64>, f64)>,
}

impl<'a> Pair<'a> {
    fn new(search: &'a Search, refined: &Refined, sights: [&'a Sight; VIEWS]) -> Self {
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
        Pair { search, sights, pose, size, from_object, object_from_first, eyes, tags }
    }

    /// The point that a pixel of the first picture shows.
    fn surface(&self, pixel: Vector2<f64>) -> Option<Seen> {
        let ray =
            self.object_from_first.rotation * self.sights[0].view.camera.unproject(&pixel.into());
        let eye = self.eyes[0] / self.size;
        let hit = self.search.model.first_hit(&eye, &ray)?;
        let seen = hit.normal.dot(&ray) < -FACING;
        let p = (eye + ray * hit.distance) * self.size;
        seen.then_some(Seen { p, part: hit.part, normal: hit.normal })
    }

    /// Where the square about a pixel of the first level is in the second, and its shift along the epipolar
    /// line by the surface along its own normal (px per m).
    fn carry_over(&self, x: usize, y: usize, seen: Seen) -> Option<(Place, f64)> {
        let Seen { p, part, normal } = seen;
        let [first, second] = self.sights;
        let pixel = pixel_of(&first.fine, x, y);
        let to_second = (self.eyes[1] - p).normalize();
        if normal.dot(&to_second) < FACING {
            return None;
        }
        let half = HALF as f64;
        let corner = half + MARGIN_PX;
        let beside_tag = |(tag, radius): &(Vector2<f64>, f64)| {
            (tag - pixel).map(|d| (d.abs() - half).max(0.0)).norm() < *radius
        };
        if self.tags.iter().any(beside_tag) {
            return None;
        }
        for (dx, dy) in [(-corner, -corner), (corner, -corner), (corner, corner), (-corner, corner)]
        {
            if self.surface(pixel + Vector2::new(dx, dy))?.part != part {
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

    /// How far a point moves along its surface's normal (m) by the shared unknowns.
    fn by_shared(&self, at: &Seen) -> ByShared {
        let (lever, out) = (self.pose.rotation * at.p, self.pose.rotation * at.normal);
        let mut by_shared = ByShared::zeros();
        by_shared.fixed_columns_mut::<3>(0).copy_from(&lever.cross(&out).transpose());
        by_shared.fixed_columns_mut::<3>(3).copy_from(&out.transpose());
        by_shared[FORM_AT] = out.dot(&lever);
        by_shared
    }
}

/// Columns and rows of the first view's level in which squares may have their middles: those of the
/// contour, as far as whole squares and their slopes are within the level.
fn extent(sites: &[Site], level: &Level) -> [Range<usize>; 2] {
    let (mut low, mut high) = ((f64::INFINITY, f64::INFINITY), (0f64, 0f64));
    for site in sites.iter().filter(|s| s.view == 0) {
        low = (low.0.min(site.pixel.0), low.1.min(site.pixel.1));
        high = (high.0.max(site.pixel.0), high.1.max(site.pixel.1));
    }
    let range = |low: f64, high: f64, origin: usize, size: usize| {
        let least = (low - origin as f64).max((HALF + 1) as f64) as usize;
        let most = (high - origin as f64).max(0.0) as usize;
        least..most.min(size.saturating_sub(HALF + 1))
    };
    [
        range(low.0, high.0, level.origin.0, level.width()),
        range(low.1, high.1, level.origin.1, level.height()),
    ]
}

/// Picture pixel of a pixel of a level at full resolution.
fn pixel_of(level: &Level, x: usize, y: usize) -> Vector2<f64> {
    Vector2::new((x + level.origin.0) as f64, (y + level.origin.1) as f64)
}
