//! What the arm did, as JSON, for a second physics engine to judge (`scripts/replay_mujoco.py`).
//!
//! ```text
//! { "start": [6 angles], "object": {"pose": POSE, "mass", "friction", "solids": [SOLID]},
//!   "obstacles": [SOLID], "motions": [ {"grip": {"width", "force"}}
//!                                    | {"move": {"times": [..], "positions": [[6 angles], ..]}} ] }
//! POSE  = [x, y, z, qw, qx, qy, qz]
//! SOLID = {"pose": POSE, "box": [half sides]} | {.., "cylinder": [radius, half height]}
//!       | {.., "sphere": [radius]} | {.., "hull": [[x, y, z], ..]}
//! ```
//!
//! SI units, base frame; a solid of the object in the object frame. The fingers are fully open at the
//! start.

use serde_json::{Value, json};
use vergence_devices::GripCommand;
use vergence_geometry::{JointAngles, Solid, Trajectory, Transform};
use vergence_grasp::{Obstacle, Plan};

use crate::experiment::Trial;
use crate::world::TrueObject;

/// One thing that arm or gripper were told and did.
#[derive(Debug, Clone, PartialEq)]
pub enum Motion {
    /// The fingers.
    Grip(GripCommand),
    /// The arm.
    Move(Trajectory),
}

/// The motions of a trial's plan, from the posture in which its transfer starts; `None` when there was
/// no plan.
pub fn of_trial(trial: &Trial) -> Option<Value> {
    let plan = trial.plan.as_ref().ok()?;
    let start = plan.transfer.waypoints.first()?.positions;
    Some(of_motions(&start, &trial.object, &trial.obstacles, &motions(plan)))
}

/// Motions from a posture on, the object and the obstacles being where they were before the first.
pub fn of_motions(
    start: &JointAngles,
    object: &TrueObject,
    obstacles: &[Obstacle],
    motions: &[Motion],
) -> Value {
    let solids: Vec<Value> =
        object.solids.iter().map(|p| solid(&p.object_from_solid, &p.solid)).collect();
    let obstacles: Vec<Value> =
        obstacles.iter().map(|o| solid(&o.base_from_solid, &o.solid)).collect();
    let motions: Vec<Value> = motions
        .iter()
        .map(|motion| match motion {
            Motion::Grip(g) => json!({"grip": {"width": g.width, "force": g.force}}),
            Motion::Move(trajectory) => along(trajectory),
        })
        .collect();
    json!({
        "start": start,
        "object": {
            "pose": pose(&object.base_from_object),
            "mass": object.mass,
            "friction": object.friction,
            "solids": solids,
        },
        "obstacles": obstacles,
        "motions": motions,
    })
}

fn motions(plan: &Plan) -> Vec<Motion> {
    let grip = |width: f64| Motion::Grip(GripCommand { width, force: plan.force });
    vec![
        grip(plan.grasp.opening),
        Motion::Move(plan.transfer.clone()),
        Motion::Move(plan.approach.clone()),
        grip(0.0),
        Motion::Move(plan.lift.clone()),
    ]
}

fn along(trajectory: &Trajectory) -> Value {
    let times: Vec<f64> = trajectory.waypoints.iter().map(|w| w.time).collect();
    let positions: Vec<[f64; 6]> = trajectory.waypoints.iter().map(|w| w.positions).collect();
    json!({"move": {"times": times, "positions": positions}})
}

fn pose(transform: &Transform) -> [f64; 7] {
    let (t, q) = (transform.translation.vector, transform.rotation);
    [t.x, t.y, t.z, q.w, q.i, q.j, q.k]
}

fn solid(frame_from_solid: &Transform, solid: &Solid) -> Value {
    let pose = pose(frame_from_solid);
    match solid {
        Solid::Cuboid { half } => json!({"pose": pose, "box": [half.x, half.y, half.z]}),
        Solid::Cylinder { radius, half_height } => {
            json!({"pose": pose, "cylinder": [radius, half_height]})
        }
        Solid::Sphere { radius } => json!({"pose": pose, "sphere": [radius]}),
        Solid::Convex { vertices } => {
            let hull: Vec<[f64; 3]> = vertices.iter().map(|v| [v.x, v.y, v.z]).collect();
            json!({"pose": pose, "hull": hull})
        }
    }
}
