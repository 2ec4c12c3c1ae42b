//! One grasp from start to end, carried out by the arm and judged by the physics.
//!
//! The arm does what a plan says through [`devices::Arm`](vergence_devices::Arm) alone. Whether that
//! worked is read from the world: the object's true height, what the robot touched on the way, whether
//! it broke. The gripper's own opinion is kept beside it, so that a false success shows.

use std::time::Duration;

use vergence_devices::{Arm, DeviceError, Execution, GripCommand, MotionLimits};
use vergence_geometry::Transform;
use vergence_grasp::Plan;

use crate::arm::PhysicsArm;
use crate::world::Touch;

/// Contact before the fingers close above which the arm has run into something (N).
const BUMP: f64 = 0.5;
/// Part of the lift that the object must rise to count as lifted.
const RISEN: f64 = 0.8;
/// How long it must stay up (s).
const HOLD: f64 = 1.0;
/// Time for the fingers to open or close.
const FINGERS: Duration = Duration::from_secs(10);

/// What came of a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    /// The object is up, whole, and nothing was bumped into.
    pub succeeded: bool,
    /// The gripper believes that it holds something, at the end.
    pub believed: bool,
    /// What was touched before the fingers closed.
    pub collision: Option<Touch>,
    /// The object was squeezed harder than it bears.
    pub broken: bool,
    /// How far the object rose (m).
    pub risen: f64,
    /// How far it moved in the hand between closing and the end (m).
    pub slipped: f64,
    /// How far closing the fingers shifted the object (m): the closing error.
    pub centred: f64,
    /// Force of the fingers at the end (N).
    pub force: f64,
    /// Duration of all motions (s).
    pub duration: f64,
}

/// Carries out a plan without a second look: transfer, approach, close, lift, hold.
pub fn run(arm: &mut PhysicsArm, plan: &Plan) -> Result<Verdict, DeviceError> {
    let began = arm.world().time();
    let collision = reach(arm, plan)?;
    close_and_lift(arm, plan, collision, began)
}

/// Opens the fingers and brings them to the pre-grasp and, when nothing is bumped into, to the grasp.
fn reach(arm: &mut PhysicsArm, plan: &Plan) -> Result<Option<Touch>, DeviceError> {
    to_pregrasp(arm, plan)?;
    approach(arm, plan)
}

/// Opens the fingers and moves to the pre-grasp.
pub fn to_pregrasp(arm: &mut PhysicsArm, plan: &Plan) -> Result<Execution, DeviceError> {
    let force = arm.world().jaws().effort();
    arm.world().take_touch();
    arm.grip(GripCommand { width: plan.grasp.opening, force }, FINGERS)?;
    arm.execute(&plan.transfer, &MotionLimits::default())
}

/// Moves straight to the grasp; gives what was touched since the start.
pub fn approach(arm: &mut PhysicsArm, plan: &Plan) -> Result<Option<Touch>, DeviceError> {
    if arm.world().touch().is_none_or(|t| t.force < BUMP) {
        arm.execute(&plan.approach, &MotionLimits::default())?;
    }
    Ok(arm.world().take_touch().filter(|t| t.force >= BUMP))
}

/// Closes the fingers and lifts, unless the way there has ended in a collision.
pub fn close_and_lift(
    arm: &mut PhysicsArm,
    plan: &Plan,
    collision: Option<Touch>,
    began: f64,
) -> Result<Verdict, DeviceError> {
    let place = arm.world().base_from_object();
    let mut verdict = Verdict {
        succeeded: false,
        believed: false,
        collision,
        broken: false,
        risen: 0.0,
        slipped: 0.0,
        centred: 0.0,
        force: 0.0,
        duration: arm.world().time() - began,
    };
    if verdict.collision.is_some() {
        return Ok(verdict);
    }
    let grip = arm.grip(GripCommand { width: 0.0, force: plan.force }, FINGERS)?;
    let closed = arm.world().base_from_object();
    verdict.centred = (closed.translation.vector - place.translation.vector).xy().norm();
    let hand_from_object = in_hand(arm);
    if grip.holding {
        // While the object is in the hand, contact is wanted.
        let limits = MotionLimits { contact_force: f64::INFINITY, ..MotionLimits::default() };
        arm.execute(&plan.lift, &limits)?;
        arm.wait(Duration::from_secs_f64(HOLD));
    }
    let moved = hand_from_object.inverse() * in_hand(arm);
    let reading = arm.gripper(FINGERS)?;
    let world = arm.world();
    let height = |t: &Transform| t.translation.vector.z;
    verdict.slipped = moved.translation.vector.norm();
    verdict.risen = height(&world.base_from_object()) - height(&place);
    verdict.broken = world.broken();
    verdict.believed = reading.holding;
    verdict.force = reading.force;
    verdict.duration = world.time() - began;
    let lift = plan.lift_motion(world.arm()).map_or(0.0, |m| height(&m));
    verdict.succeeded = !verdict.broken && lift > 0.0 && verdict.risen > RISEN * lift;
    Ok(verdict)
}

fn in_hand(arm: &PhysicsArm) -> Transform {
    let world = arm.world();
    world.arm().forward(world.joints()).inverse() * world.base_from_object()
}
