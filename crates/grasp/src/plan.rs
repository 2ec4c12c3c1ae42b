//! What the planner answers: a plan, or the reason why there is none.

use nalgebra::Vector3;
use vergence_geometry::{JointAngles, Trajectory, Transform};

use crate::candidates::Grasp;
use crate::collision::Hit;
use crate::margin::Margin;

/// A grasp with the motions that carry it out. Every posture of every motion has been tested.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The grasp in the object frame.
    pub grasp: Grasp,
    /// Where the tip closes its fingers.
    pub base_from_tip: Transform,
    /// From where the arm stands to before the object; fingers at the grasp's opening.
    pub transfer: Trajectory,
    /// Straight to the grasp.
    pub approach: Trajectory,
    /// Straight up with the object in the hand.
    pub lift: Trajectory,
    /// Force of the fingers (N).
    pub force: f64,
    /// Mass that the force was made for (kg).
    pub mass: f64,
    /// What the pose's uncertainty leaves.
    pub margin: Margin,
    /// Why this grasp, in words.
    pub reasons: Vec<String>,
    /// Other grasps that were feasible as postures, best first, with their scores.
    pub alternatives: Vec<(Grasp, f64)>,
    /// How many candidates fell for which reason.
    pub rejected: Rejected,
}

impl Plan {
    /// Posture before the object.
    pub fn pregrasp(&self) -> Option<JointAngles> {
        self.approach.waypoints.first().map(|w| w.positions)
    }

    /// What the lift does to the hand and what it holds, in base: `after_from_before`.
    pub fn lift_motion(&self, arm: &crate::kinematics::Arm) -> Option<Transform> {
        let (first, last) = (self.lift.waypoints.first()?, self.lift.waypoints.last()?);
        Some(arm.forward(&last.positions) * arm.forward(&first.positions).inverse())
    }
}

/// Counts of candidates by what stopped them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Rejected {
    /// The pose is not sure enough.
    pub uncertain: usize,
    /// The object would slip or break.
    pub force: usize,
    /// From below, or out of reach.
    pub unreachable: usize,
    /// Something is in the way.
    pub blocked: usize,
}

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The record contradicts itself.
    #[error("the record of the object is not usable: {0}")]
    Record(#[from] vergence_tag::Invalid),
    /// The record has no such landmark.
    #[error("the record has no landmark {0}")]
    NoLandmark(usize),
    /// The pose or its covariance is not a number.
    #[error("the object's pose is not usable: {0}")]
    Pose(&'static str),
    /// The object stays where it is.
    #[error("\"{0}\" is fixed and must not be moved")]
    Fixed(String),
    /// Beyond the arm's payload.
    #[error("\"{name}\" weighs {mass:.2} kg, the arm lifts {payload:.2} kg")]
    TooHeavy {
        /// The object.
        name: String,
        /// Its mass (kg).
        mass: f64,
        /// What the arm lifts (kg).
        payload: f64,
    },
    /// Nothing of it fits between the fingers.
    #[error(
        "\"{name}\" is {width_mm:.0} mm wide where it is narrowest, the gripper opens {opening_mm:.0} mm"
    )]
    TooWide {
        /// The object.
        name: String,
        /// Its narrowest width.
        width_mm: f64,
        /// The gripper's opening.
        opening_mm: f64,
    },
    /// A finger has no place to go that is surely free: housing and a handle that may be anywhere.
    #[error("\"{0}\" may have a handle wherever a finger could go; look at it from the side first")]
    HandleUnknown(String),
    /// The grasp does not fit into the 95 % ellipsoid.
    #[error(
        "the pose is too uncertain: +-{needed_mm:.1} mm along the gripper's {axis} axis, the best grasp bears {reserve_mm:.1} mm"
    )]
    TooUncertain {
        /// The worst axis of the best grasp.
        axis: &'static str,
        /// Needed.
        needed_mm: f64,
        /// Borne.
        reserve_mm: f64,
    },
    /// It would break.
    #[error("holding \"{name}\" takes {needed:.0} N, it bears {strength:.0} N")]
    TooWeak {
        /// The object.
        name: String,
        /// Force needed (N).
        needed: f64,
        /// Force borne (N).
        strength: f64,
    },
    /// It would slip.
    #[error("holding \"{name}\" takes {needed:.0} N, the gripper presses with {force:.0} N")]
    TooSlippery {
        /// The object.
        name: String,
        /// Force needed (N).
        needed: f64,
        /// Force that there is (N).
        force: f64,
    },
    /// Out of the arm's reach.
    #[error("the arm does not reach a grasp at ({:.2}, {:.2}, {:.2}) m", .0.x, .0.y, .0.z)]
    Unreachable(Vector3<f64>),
    /// Something is in the way of every grasp.
    #[error("every grasp is blocked; the best by {} and {}", .0.link, .0.other)]
    Occupied(Hit),
    /// The arm itself stands in something, or outside its limits.
    #[error("the arm cannot start from where it stands: {0}")]
    Start(String),
    /// The second look disagrees with the first by more than a correction may mend.
    #[error("the object is {moved_mm:.0} mm from where it was: plan again")]
    Moved {
        /// How far.
        moved_mm: f64,
    },
}
