//! Where a parallel gripper could hold the object, from shape and record alone.
//!
//! In: record, gripper. Out: candidates in the object frame, each with the error of pose that it
//! bears. Nothing here knows where the object stands or whether the arm gets there.
//!
//! - **faces**: two opposite faces of a box, a prism or a convex body within the opening, approached
//!   from eight sides.
//! - **side**: across a cylinder, a cup or a ball, at several heights and tilts.
//! - **top**: from above across a cylinder or a cup.
//! - **rim**: one finger in the cup, one outside.
//!
//! **Unknown handle.** A record's cup may have a handle at an azimuth that nobody tells. The place of
//! a landmark's housing is free of it, and so are the azimuths that the caller has seen free. A finger
//! may only come down outside a cup where no handle can be: at the azimuth of a housing that is at
//! least as wide as the finger, above or below it, or within a free range. So a cup is held by its rim
//! above its landmark unless more is known.

use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use parry3d::math::Vector;
use parry3d::shape::ConvexPolyhedron;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};
use vergence_geometry::{Solid, Transform};
use vergence_tag::{Record, Shape};

use crate::gripper::{Gripper, Levers};
use crate::object;

/// How the object is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hold {
    /// On two opposite faces.
    Faces,
    /// Across a round body, from its side.
    Side,
    /// Across a round body, from its end.
    Top,
    /// On the wall at the rim.
    Rim,
}

impl Hold {
    /// For people and machine output.
    pub fn name(self) -> &'static str {
        match self {
            Hold::Faces => "faces",
            Hold::Side => "side",
            Hold::Top => "top",
            Hold::Rim => "rim",
        }
    }
}

/// Error of the object's pose that a grasp bears on either side (m), along the tip's axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reserve {
    /// Across (x): until the pad leaves the surface.
    pub across: f64,
    /// Closing (y): until an open finger comes down on the object.
    pub closing: f64,
    /// Approach (z): until the palm touches, or too little is between the fingers.
    pub approach: f64,
}

/// A grasp in the object frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Grasp {
    /// How.
    pub hold: Hold,
    /// The gripper's tip: z along the approach, y along the closing.
    pub object_from_tip: Transform,
    /// What is between the fingers (m).
    pub width: f64,
    /// Opening before closing (m).
    pub opening: f64,
    /// Error of pose that it bears.
    pub reserve: Reserve,
    /// Prying lever and contact length; the twist depends on how the object stands.
    pub levers: Levers,
}

/// Assumptions about what the record does not tell.
#[derive(Debug, Clone, PartialEq)]
pub struct Assumptions {
    /// Thickness of a cup's wall (m).
    pub wall: f64,
    /// Radius of the ball that holds a landmark's housing (m): a 24 mm wide tag.
    pub housing: f64,
    /// Half the thickness of a handle, along the cup's circumference (m).
    pub handle: f64,
}

impl Default for Assumptions {
    fn default() -> Self {
        Self { wall: 0.004, housing: 0.012, handle: 0.008 }
    }
}

/// Free space that the fingers take beside the object when nothing is known better (m).
const SPREAD: f64 = 0.030;
/// Least length of finger on the object (m).
const LEAST_CONTACT: f64 = 0.012;
/// Distance that the palm keeps from the object (m).
const PALM_GAP: f64 = 0.004;
/// Distance that the fingertips keep from the plane behind the object: it may lie on a table (m).
const TABLE_GAP: f64 = 0.012;
/// How deep fingers reach over a rim (m).
const RIM_DEPTH: f64 = 0.028;
/// Distance between a finger and a housing (m).
const HOUSING_GAP: f64 = 0.003;

/// All candidates; those wider than the opening are left out. `free` are ranges of azimuth (rad,
/// object frame, counter-clockwise) where the caller knows that a cup has no handle.
pub fn candidates(
    record: &Record,
    gripper: &Gripper,
    free: &[(f64, f64)],
    assumed: &Assumptions,
) -> Vec<Grasp> {
    let maker = Maker { record, gripper, free, assumed };
    let mut grasps = match &record.shape {
        Shape::Box => maker.of_box(),
        Shape::Cylinder { height, .. } => maker.of_revolution(*height),
        Shape::Cup { height, .. } => {
            let mut grasps = maker.of_revolution(*height);
            grasps.extend(maker.of_rim(*height));
            grasps
        }
        Shape::Sphere { diameter } => maker.of_sphere(*diameter),
        Shape::Prism { .. } | Shape::Convex { .. } => maker.of_hull(),
    };
    grasps.retain(|g| maker.clear_of_housings(g) && g.reserve.closing > 0.0);
    grasps
}

/// Smallest width between opposite surfaces, for the message when nothing fits (m).
pub fn narrowest(record: &Record) -> f64 {
    let [x, y, z] = record.bounding_box.sides();
    match record.shape {
        Shape::Cylinder { diameter, .. } | Shape::Sphere { diameter } => diameter,
        Shape::Cup { top_diameter, bottom_diameter, .. } => top_diameter.min(bottom_diameter),
        _ => x.min(y).min(z),
    }
}

struct Maker<'a> {
    record: &'a Record,
    gripper: &'a Gripper,
    free: &'a [(f64, f64)],
    assumed: &'a Assumptions,
}

/// A pinch of two parallel surfaces before it is known how deep the fingers go.
struct Pinch {
    hold: Hold,
    /// Middle between the surfaces.
    centre: Vector3<f64>,
    closing: Vector3<f64>,
    approach: Vector3<f64>,
    width: f64,
    /// How far the object reaches from the centre against and along the approach, and across (m).
    front: f64,
    back: f64,
    across: f64,
}

impl Maker<'_> {
    /// Puts the tip so that the fingers hold the centre, or as deep as the palm allows.
    fn pinch(&self, p: Pinch) -> Option<Grasp> {
        let g = self.gripper;
        let opening = f64::min(g.opening, p.width + 2.0 * SPREAD);
        let deepest = g.depth - p.front - PALM_GAP;
        // Half of the finger beyond the centre, not beyond the object's far side.
        let wanted = f64::min(g.depth / 2.0, p.back - TABLE_GAP).max(LEAST_CONTACT - p.front);
        let depth = wanted.min(deepest);
        let contact = f64::min(depth, p.back) + p.front;
        if contact < LEAST_CONTACT {
            return None;
        }
        let palm = deepest - depth + PALM_GAP;
        Some(Grasp {
            hold: p.hold,
            object_from_tip: frame(p.centre + p.approach * depth, p.approach, p.closing),
            width: p.width,
            opening,
            reserve: Reserve {
                across: p.across,
                closing: (opening - p.width) / 2.0,
                approach: f64::min(palm, contact - LEAST_CONTACT / 2.0),
            },
            levers: Levers { twist: 0.0, pry: 0.0, contact: contact.min(g.depth) },
        })
    }

    fn of_box(&self) -> Vec<Grasp> {
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

    fn of_revolution(&self, height: f64) -> Vec<Grasp> {
        let mut grasps = Vec::new();
        for n in 0..24 {
            let azimuth = n as f64 * TAU / 24.0;
            let outward = radial(azimuth);
            let closing = radial(azimuth + FRAC_PI_2);
            if !self.no_handle(azimuth + FRAC_PI_2, None)
                || !self.no_handle(azimuth - FRAC_PI_2, None)
            {
                continue;
            }
            for tilt in [-60.0f64, -30.0, 0.0, 30.0, 60.0].map(f64::to_radians) {
                let approach = -outward * tilt.cos() - Vector3::z() * tilt.sin();
                for z in [0.0, 0.2, -0.2, 0.35, -0.35].map(|s| s * height) {
                    grasps.extend(self.across(azimuth, approach, closing, z, height));
                }
            }
            if n < 12 {
                for end in [1.0, -1.0] {
                    grasps.extend(self.over_the_end(closing, end, height));
                }
            }
        }
        grasps
    }

    fn across(
        &self,
        azimuth: f64,
        approach: Vector3<f64>,
        closing: Vector3<f64>,
        z: f64,
        height: f64,
    ) -> Option<Grasp> {
        // The palm must not meet a handle either.
        if !self.no_handle(azimuth, None) {
            return None;
        }
        let lateral = approach.cross(&closing);
        let radius = object::radius_at(self.record, z)?;
        let (level, upright) = (lateral.z.abs(), approach.z.abs());
        let solid = Solid::Cylinder { radius, half_height: height / 2.0 - z.abs() };
        // Across: up and down the wall when the hand is level; a tilted pad also leaves the round.
        let along = (height / 2.0 - z.abs()) * level + self.gripper.width / 2.0 * upright - 0.003;
        self.pinch(Pinch {
            hold: Hold::Side,
            centre: Vector3::z() * z,
            closing,
            approach,
            width: 2.0 * radius,
            front: radius * level + f64::min(solid.support(&approach), radius * upright),
            back: radius * level,
            across: along,
        })
    }

    fn over_the_end(&self, closing: Vector3<f64>, end: f64, height: f64) -> Option<Grasp> {
        let depth = f64::min(self.gripper.depth - PALM_GAP, height * 0.6);
        let z = end * (height / 2.0 - depth / 2.0);
        let width = [z, end * height / 2.0, end * (height / 2.0 - depth)]
            .into_iter()
            .filter_map(|z| object::radius_at(self.record, z))
            .fold(0.0, f64::max)
            * 2.0;
        self.pinch(Pinch {
            hold: Hold::Top,
            centre: Vector3::z() * z,
            closing,
            approach: -Vector3::z() * end,
            width,
            front: depth / 2.0,
            back: depth / 2.0,
            across: self.gripper.width / 2.0 - 0.002,
        })
    }

    /// One finger inside the cup, one outside; the tip above the wall, its y axis outwards. The hand
    /// leans with the wall, so that both pads lie flat on it: on an edge they would turn the cup.
    fn of_rim(&self, height: f64) -> Vec<Grasp> {
        let landmarks = self.record.landmarks.iter().map(|s| s.position[1].atan2(s.position[0]));
        let azimuths: Vec<f64> = landmarks.chain((0..24).map(|n| n as f64 * TAU / 24.0)).collect();
        azimuths.into_iter().filter_map(|azimuth| self.over_the_rim(azimuth, height)).collect()
    }

    fn over_the_rim(&self, azimuth: f64, height: f64) -> Option<Grasp> {
        let g = self.gripper;
        let top = height / 2.0;
        let room = self.room_above_housing(azimuth, height);
        let inside = height - self.assumed.wall - 0.004;
        // Half way between holding too little of the wall and touching housing or bottom.
        let balanced = |space: f64| (space + HOUSING_GAP + LEAST_CONTACT / 2.0) / 2.0;
        let depth = RIM_DEPTH.min(balanced(room)).min(balanced(inside));
        if depth < LEAST_CONTACT || !self.no_handle(azimuth, Some(top - depth / 2.0)) {
            return None;
        }
        let outer = object::radius_at(self.record, top - depth / 2.0)?;
        let tip = object::radius_at(self.record, top - depth)?.min(outer);
        // The inner finger in the middle of the hole at the depth of its tip.
        let hole = 2.0 * (tip - self.assumed.wall);
        let inner = (hole - g.thickness) / 2.0;
        let side = inner.min(SPREAD).min((g.opening - self.assumed.wall) / 2.0);
        let rim = object::radius_at(self.record, top)?;
        let lean = (rim - object::radius_at(self.record, top - depth)?).atan2(depth);
        let (sin, cos) = lean.sin_cos();
        let down = -Vector3::z() * cos - radial(azimuth) * sin;
        let outwards = radial(azimuth) * cos - Vector3::z() * sin;
        let middle = outer - self.assumed.wall / 2.0;
        Some(Grasp {
            hold: Hold::Rim,
            object_from_tip: frame(
                radial(azimuth) * middle
                    + Vector3::z() * (top - depth / 2.0)
                    + down * (depth / 2.0),
                down,
                outwards,
            ),
            width: self.assumed.wall,
            opening: self.assumed.wall + 2.0 * side,
            reserve: Reserve {
                // A flat pad on a round wall keeps its hold while it meets it within its width.
                across: g.width / 2.0,
                closing: side,
                approach: f64::min(depth - LEAST_CONTACT / 2.0, inside - depth + HOUSING_GAP)
                    .min(room - depth + HOUSING_GAP)
                    .min(g.depth - depth),
            },
            levers: Levers { twist: 0.0, pry: middle, contact: depth * 0.7 },
        })
    }

    /// Length of wall between the rim and the nearest housing below the finger (m).
    fn room_above_housing(&self, azimuth: f64, height: f64) -> f64 {
        let radius = self.assumed.housing;
        let below = |site: &vergence_tag::LandmarkSite| {
            let at = Vector3::from(site.position);
            let across = at.dot(&radial(azimuth + FRAC_PI_2)).abs();
            let outside = at.dot(&radial(azimuth)) > 0.0;
            (outside && across < radius + self.gripper.width / 2.0)
                .then(|| height / 2.0 - at.z - radius - HOUSING_GAP)
        };
        self.record.landmarks.iter().filter_map(below).fold(height, f64::min)
    }

    /// Whether a cup certainly has no handle where a finger comes down outside it. With `height`, the
    /// place above or below a housing counts as free.
    fn no_handle(&self, azimuth: f64, height: Option<f64>) -> bool {
        if !matches!(self.record.shape, Shape::Cup { .. }) {
            return true;
        }
        let Some(radius) = object::radius_at(self.record, height.unwrap_or(0.0)) else {
            return true;
        };
        let taken = (self.gripper.width / 2.0 + self.assumed.handle) / radius;
        let taken = taken.min(1.0).asin();
        let inside = |&(from, to): &(f64, f64)| {
            let span = (to - from).rem_euclid(TAU);
            let at = (azimuth - from).rem_euclid(TAU);
            at >= taken && at + taken <= span
        };
        let by_housing = |site: &vergence_tag::LandmarkSite| {
            // No handle's middle is nearer to a landmark than both half widths together.
            let kept = ((self.assumed.housing + self.assumed.handle) / radius).min(1.0).asin();
            let off = azimuth - site.position[1].atan2(site.position[0]);
            ((off + PI).rem_euclid(TAU) - PI).abs() <= kept - taken
        };
        self.free.iter().any(inside)
            || (height.is_some() && self.record.landmarks.iter().any(by_housing))
    }

    fn of_sphere(&self, diameter: f64) -> Vec<Grasp> {
        let mut grasps = Vec::new();
        for n in 0..12 {
            let azimuth = n as f64 * TAU / 12.0;
            let closing = radial(azimuth + FRAC_PI_2);
            for tilt in [0.0, FRAC_PI_4, FRAC_PI_2] {
                let approach = -radial(azimuth) * tilt.cos() - Vector3::z() * tilt.sin();
                grasps.extend(self.pinch(Pinch {
                    hold: Hold::Side,
                    centre: Vector3::zeros(),
                    closing,
                    approach,
                    width: diameter,
                    front: diameter / 2.0,
                    back: diameter / 2.0,
                    across: self.gripper.width / 2.0 - 0.002,
                }));
            }
        }
        grasps
    }

    /// Pairs of opposite faces of the convex hull, their middles facing each other.
    fn of_hull(&self) -> Vec<Grasp> {
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

    /// Fingers, open, closed and between, must not meet a housing; nor may the palm.
    fn clear_of_housings(&self, grasp: &Grasp) -> bool {
        let g = self.gripper;
        let tip_from_object = grasp.object_from_tip.inverse();
        self.record.landmarks.iter().all(|site| {
            let p = tip_from_object * Point3::from(site.position);
            let needed = self.assumed.housing + HOUSING_GAP;
            let (inner, outer) = (grasp.width / 2.0, grasp.opening / 2.0 + g.thickness);
            let x = (p.x.abs() - g.width / 2.0).max(0.0);
            let y = (inner - p.y.abs()).max(p.y.abs() - outer).max(0.0);
            let z = (p.z.max(-g.depth - p.z)).max(0.0);
            let fingers = Vector3::new(x, y, z).norm() > needed;
            let palm = p.z > -g.depth + needed;
            fingers && palm
        })
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

fn radial(azimuth: f64) -> Vector3<f64> {
    Vector3::new(azimuth.cos(), azimuth.sin(), 0.0)
}

fn frame(origin: Vector3<f64>, approach: Vector3<f64>, closing: Vector3<f64>) -> Transform {
    let (z, y) = (approach.normalize(), closing.normalize());
    let matrix = Matrix3::from_columns(&[y.cross(&z), y, z]);
    Transform::from_parts(
        Translation3::from(origin),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix)),
    )
}
