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

mod flat;
mod round;

use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use vergence_geometry::Transform;
use vergence_tag::{Record, Shape};

use crate::gripper::{Gripper, Levers};

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

fn frame(origin: Vector3<f64>, approach: Vector3<f64>, closing: Vector3<f64>) -> Transform {
    let (z, y) = (approach.normalize(), closing.normalize());
    let matrix = Matrix3::from_columns(&[y.cross(&z), y, z]);
    Transform::from_parts(
        Translation3::from(origin),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix)),
    )
}
