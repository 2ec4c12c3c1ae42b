//! Closing the loop: correct after a second look, verify after the lift.
//!
//! Before the fingers close the heads look once more. If they also see a light on the gripper, the
//! object is placed relative to the hand: what both heads get wrong alike (joint offsets, lens) moves
//! hand and object alike and cancels. After the lift the landmark must have moved as the hand has.

use nalgebra::{Matrix3, Point3, Vector3};
use vergence_geometry::{GaussianPoint, GaussianPose, JointAngles, Trajectory, Transform};

use crate::margin::{ELLIPSOID_95, margin};
use crate::motion::{self, NoMotion, Scene};
use crate::plan::{Plan, Refusal};
use crate::planner::{self, Allowed, Config, Request, Robot};
use crate::timing;

/// Plans the rest of a grasp anew after a second look: same grasp, object where it is seen now.
///
/// `request` holds the new pose and where the arm stands now (the pre-grasp). The plan's transfer is
/// the small move to the corrected pre-grasp. The new pose must allow the grasp as the first did.
pub fn correct(
    robot: &Robot,
    plan: &Plan,
    request: &Request,
    config: &Config,
) -> Result<Plan, Refusal> {
    let mass = planner::check_object(request, config)?;
    let grasp = &plan.grasp;
    let moved = request.object.pose * grasp.object_from_tip;
    let shift = (moved.translation.vector - plan.base_from_tip.translation.vector).norm();
    if shift > config.correction {
        return Err(Refusal::Moved { moved_mm: shift * 1e3 });
    }
    let margin = margin(request.record, request.object, grasp, config.tolerance);
    if margin.ratio.is_nan() || margin.ratio < 1.0 {
        return Err(Refusal::TooUncertain {
            axis: margin.axis,
            needed_mm: margin.needed * 1e3,
            reserve_mm: margin.reserve * 1e3,
        });
    }
    let force = planner::force(robot, request, config, grasp, mass).map_err(|(_, why)| why)?;
    let scene = Scene::new(request, &config.assumptions);
    let motion = motion::find(robot, request, config, &scene, grasp).map_err(|why| match why {
        NoMotion::Unreachable => Refusal::Unreachable(moved.translation.vector),
        NoMotion::Blocked(hit) => Refusal::Occupied(hit),
    })?;
    let chosen = Allowed::corrected(grasp.clone(), margin, force);
    let mut reasons = plan.reasons.clone();
    reasons.push(format!("corrected by {:.1} mm after the second look", shift * 1e3));
    Ok(planner::assemble(
        robot,
        request,
        config,
        &chosen,
        motion,
        mass,
        reasons,
        plan.alternatives.clone(),
        plan.rejected,
    ))
}

/// Turns the lifted object by an angle (rad) about the vertical, so that what the hand hides from the
/// heads is seen: the motion from where the lift ends. `request` is the one that the plan was made for;
/// `None` when the arm cannot, or something is in the way.
pub fn turn_in_sight(
    robot: &Robot,
    plan: &Plan,
    request: &Request,
    config: &Config,
    from: &JointAngles,
    angle: f64,
) -> Option<Trajectory> {
    let scene = Scene::new(request, &config.assumptions);
    let path = motion::turn(robot, config, &scene, &plan.grasp, from, angle).ok()?;
    Some(timing::parameterise(&robot.arm, &path, &config.speeds))
}

/// The same plan with its next best grasp, to be made anew by [`correct`]; `None` when there is no other.
pub fn next_best(plan: &Plan, object: &GaussianPose) -> Option<Plan> {
    let ((grasp, _), others) = plan.alternatives.split_first()?;
    Some(Plan {
        base_from_tip: object.pose * grasp.object_from_tip,
        grasp: grasp.clone(),
        alternatives: others.to_vec(),
        ..plan.clone()
    })
}

/// Places the object relative to the hand.
///
/// `hand_by_joints` is where the arm's kinematics put the gripper's light, `hand_seen` where the
/// heads see it; the object, seen by the same heads, is shifted by their difference. `difference` is
/// the covariance of a measured position *relative* to another one near it (m^2): what does not
/// cancel.
pub fn relative_to_hand(
    object: &GaussianPose,
    hand_by_joints: &Point3<f64>,
    hand_seen: &Point3<f64>,
    difference: &Matrix3<f64>,
) -> GaussianPose {
    let mut corrected = *object;
    corrected.pose.translation.vector += hand_by_joints - hand_seen;
    // Position no longer goes with attitude through the heads: the cross terms are dropped.
    corrected.covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(difference);
    corrected.covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
    corrected.covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
    corrected
}

/// What the look after the lift says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LiftVerdict {
    /// The landmark moved with the hand.
    Held,
    /// It moved, but not as the hand did.
    Slipped {
        /// Where it is against where it should be, base (m).
        by: Vector3<f64>,
    },
    /// It stayed where it was.
    Left,
    /// The measurements are too uncertain to tell held from left.
    Unclear,
}

/// Slip in the fingers that counts as held (m): the object turns a little as it leaves the table.
const ALLOWED_SLIP: f64 = 0.015;

/// Compares the landmark before and after the lift with the hand's motion
/// (`after_from_before` of the hand, both in base).
pub fn verify_lift(
    before: &GaussianPoint,
    after: &GaussianPoint,
    hand_motion: &Transform,
) -> LiftVerdict {
    let expected = hand_motion * before.position;
    let by = after.position - expected;
    let moved = after.position - before.position;
    let way = expected - before.position;
    // Both looks are uncertain; turning by the hand's motion does not change how much by.
    let turned = hand_motion.rotation.to_rotation_matrix();
    let covariance = turned * before.covariance * turned.transpose() + after.covariance;
    let sigma = |d: &Vector3<f64>| match d.try_normalize(1e-9) {
        Some(d) => d.dot(&(covariance * d)).max(0.0).sqrt(),
        None => 0.0,
    };
    // Held and left must lie further apart than both doubts together.
    let doubt = ELLIPSOID_95 * sigma(&way);
    if !(way.norm() > 2.0 * doubt && way.norm() > 2.0 * ALLOWED_SLIP) {
        return LiftVerdict::Unclear;
    }
    if by.norm() <= ALLOWED_SLIP + ELLIPSOID_95 * sigma(&by) {
        LiftVerdict::Held
    } else if moved.norm() <= ALLOWED_SLIP + ELLIPSOID_95 * sigma(&moved) {
        LiftVerdict::Left
    } else {
        LiftVerdict::Slipped { by }
    }
}
