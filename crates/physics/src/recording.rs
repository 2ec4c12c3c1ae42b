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
use vergence_geometry::{Solid, Trajectory, Transform};
use vergence_grasp::Plan;

use crate::experiment::Trial;

/// The motions of a trial's plan, from the posture in which its transfer starts; `None` when there was
/// no plan.
pub fn of_trial(trial: &Trial) -> Option<Value> {
    let plan = trial.plan.as_ref().ok()?;
    let object = &trial.object;
    let solids: Vec<Value> =
        object.solids.iter().map(|p| solid(&p.object_from_solid, &p.solid)).collect();
    let obstacles: Vec<Value> =
        trial.obstacles.iter().map(|o| solid(&o.base_from_solid, &o.solid)).collect();
    Some(json!({
        "start": plan.transfer.waypoints.first()?.positions,
        "object": {
            "pose": pose(&object.base_from_object),
            "mass": object.mass,
            "friction": object.friction,
            "solids": solids,
        },
        "obstacles": obstacles,
        "motions": motions(plan),
    }))
}

fn motions(plan: &Plan) -> Vec<Value> {
    let grip = |width: f64, force: f64| json!({"grip": {"width": width, "force": force}});
    vec![
        grip(plan.grasp.opening, plan.force),
        along(&plan.transfer),
        along(&plan.approach),
        grip(0.0, plan.force),
        along(&plan.lift),
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
