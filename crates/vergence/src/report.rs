//! The outcome of a find as outsiders script against it: plain numbers, JSON through serde.

use nalgebra::Matrix6;
use serde::Serialize;
use vergence_geometry::{GaussianPoint, GaussianPose, Symmetry, Transform};

/// What `find` prints as JSON. Positions in the base frame (m), orientations as quaternions
/// x, y, z, w, covariances row-major; a pose's in the order rotation, translation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The object that was asked for.
    pub object_id: String,
    /// The landmark was triangulated and the pose accepted.
    pub found: bool,
    /// Why not, in a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// What a person can do about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hint: Option<&'static str>,
    /// The landmark, as soon as both heads had it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub landmark: Option<LandmarkReport>,
    /// The object's pose.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseReport>,
    /// How sure the recogniser is of the pose, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub confidence: Option<f64>,
    /// Turns about which the pose says nothing; for judging, not part of the JSON.
    #[serde(skip)]
    pub symmetry: Symmetry,
    /// Other poses that explain the pictures less well, best first.
    pub alternatives: Vec<AlternativeReport>,
    /// What came of the grasp, when one was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grasp: Option<GraspReport>,
    /// What was done when, on the robot's clock.
    pub timeline: Vec<Step>,
    /// The simulator's truth; never present with real devices.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthReport>,
}

/// What came of a grasp.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct GraspReport {
    /// The object is in the hand, and the heads have seen that it was lifted.
    pub succeeded: bool,
    /// Why not, in a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// What a person can do about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hint: Option<&'static str>,
    /// How it is held: "faces", "side", "top", "rim".
    #[serde(skip_serializing_if = "Option::is_none")]
    pub approach: Option<&'static str>,
    /// What is to be between the fingers (m).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width: Option<f64>,
    /// Force of the fingers (N).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// How many times over the grasp bears the pose's doubt (95 %); at least 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub margin: Option<f64>,
    /// Why the second look, from the pre-grasp, gave nothing; the grasp then stands on the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub second_look: Option<String>,
    /// How far the second look moved the grasp (mm).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub corrected_by_mm: Option<f64>,
    /// How far from where the arm's joints put it the heads see the gripper's light, beside the object
    /// (mm): so far the object was moved to be where the hand will find it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hand_off_mm: Option<f64>,
    /// Why the gripper's light was not measured, on a robot that has one; the object then stands where the
    /// heads alone see it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hand_unseen: Option<String>,
    /// What was between the fingers when they had closed (m).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub closed_width: Option<f64>,
    /// Why the first try ended, when there was a second.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_failure: Option<String>,
    /// Part of the arm that touched something on its way.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub contact: Option<String>,
    /// After the lift the landmark was seen where the hand must have carried it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verified: Option<bool>,
    /// Who saw it there: "both heads" measured its place; one head alone ("left head", "right head")
    /// saw it in the right direction while the hand hid it from the other.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verified_by: Option<&'static str>,
    /// What really happened, in simulation only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics: Option<PhysicsReport>,
}

/// The simulator's verdict on a grasp; never present with real devices.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhysicsReport {
    /// The object is up and whole and nothing was bumped into.
    pub lifted: bool,
    /// How far it rose (mm).
    pub risen_mm: f64,
    /// It was squeezed harder than it bears.
    pub broken: bool,
    /// What the arm bumped into before the fingers closed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collision: Option<String>,
    /// How far closing the fingers shifted the object (mm).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub closing_error_mm: Option<f64>,
}

/// The triangulated landmark.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LandmarkReport {
    /// Base frame (m).
    pub position: [f64; 3],
    /// Base frame (m^2), row-major.
    pub covariance: Vec<f64>,
    /// Distance by equation (1) of the paper, for comparison (m).
    pub paper_distance: f64,
}

/// A pose with its covariance.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseReport {
    /// Centre of the bounding box, base frame (m).
    pub position: [f64; 3],
    /// `base_from_object` as x, y, z, w.
    pub orientation: [f64; 4],
    /// Rotation then translation, base frame, row-major 6x6 (rad^2, rad m, m^2).
    pub covariance: Vec<f64>,
}

/// A pose that lost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlternativeReport {
    /// Centre of the bounding box, base frame (m).
    pub position: [f64; 3],
    /// `base_from_object` as x, y, z, w.
    pub orientation: [f64; 4],
    /// Its share of belief, 0 to 1.
    pub confidence: f64,
}

/// One step with its times since the start of the robot's clock.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Step {
    /// Name of the step.
    pub step: &'static str,
    /// Start (s).
    pub start: f64,
    /// End (s).
    pub end: f64,
}

/// What the simulator knows.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthReport {
    /// Centre of the bounding box, base frame (m).
    pub position: [f64; 3],
    /// `base_from_object` as x, y, z, w.
    pub orientation: [f64; 4],
    /// The landmark, base frame (m).
    pub landmark: [f64; 3],
}

/// Position and quaternion of a transform as the report writes them.
pub fn numbers(transform: &Transform) -> ([f64; 3], [f64; 4]) {
    let q = transform.rotation.coords;
    (transform.translation.vector.into(), [q.x, q.y, q.z, q.w])
}

impl LandmarkReport {
    /// From the triangulated point and equation (1).
    pub fn new(point: &GaussianPoint, paper_distance: f64) -> Self {
        LandmarkReport {
            position: point.position.coords.into(),
            covariance: point.covariance.transpose().iter().copied().collect(),
            paper_distance,
        }
    }
}

impl PoseReport {
    /// From a pose of the recogniser.
    pub fn new(pose: &GaussianPose) -> Self {
        let (position, orientation) = numbers(&pose.pose);
        let row_major: Matrix6<f64> = pose.covariance.transpose();
        PoseReport { position, orientation, covariance: row_major.iter().copied().collect() }
    }
}
