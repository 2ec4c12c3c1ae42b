//! The physics itself: fingers, forces, and grasps that must fail.

#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use nalgebra::{Translation3, Vector3};
use vergence_devices::{Arm, Execution, GripCommand, MotionLimits};
use vergence_geometry::{Solid, Trajectory, Transform, Waypoint};
use vergence_grasp::object::Placed;
use vergence_grasp::{Config, Obstacle, Plan};
use vergence_physics::experiment::{self, Cell, Conditions, HOME, table};
use vergence_physics::trial::{self, Verdict};
use vergence_physics::{PhysicsArm, TrueObject};

fn cell() -> Cell {
    Cell::parse(include_str!("../../grasp/assets/arm.urdf"), Path::new("arm.urdf")).unwrap()
}

fn block() -> TrueObject {
    let half = Vector3::new(0.03, 0.03, 0.04);
    TrueObject {
        name: "block".into(),
        solids: vec![Placed {
            object_from_solid: Transform::identity(),
            solid: Solid::Cuboid { half },
        }],
        base_from_object: Translation3::new(0.7, 0.0, 0.04).into(),
        mass: 0.3,
        friction: 0.5,
        strength: 60.0,
    }
}

/// A trial whose first look is all there is.
fn trial(seed: u64, change: impl Fn(&mut Conditions)) -> experiment::Trial {
    let mut conditions = Conditions { second: None, handles: false, ..Conditions::default() };
    change(&mut conditions);
    experiment::run(&cell(), seed, &conditions, &Config::default(), &|| 0.0).unwrap().0
}

fn verdict(seed: u64, change: impl Fn(&mut Conditions)) -> Verdict {
    trial(seed, change).verdict.unwrap()
}

#[test]
fn fingers_go_where_they_are_told_and_things_stay_put() {
    let world = cell().world(&HOME, &[table()], &block()).unwrap();
    let mut arm = PhysicsArm::new(Arc::new(Mutex::new(world)), None);
    let command = GripCommand { width: 0.08, force: 50.0 };
    let reading = arm.grip(command, Duration::from_secs(5)).unwrap();
    assert!((reading.width - 0.08).abs() < 5e-4 && !reading.holding, "{reading:?}");
    let moved = arm.world().base_from_object().translation.vector - Vector3::new(0.7, 0.0, 0.04);
    assert!(moved.norm() < 5e-4, "the block crept by {moved:?}");
    assert_eq!(arm.world().take_touch(), None);
}

#[test]
fn a_cup_is_lifted_and_the_trial_repeats_bit_for_bit() {
    let (a, b) = (trial(2, |_| ()), trial(2, |_| ()));
    let (a, b) = (a.verdict.unwrap(), b.verdict.unwrap());
    assert!(a.succeeded && a.believed && a.collision.is_none(), "{a:?}");
    assert_eq!(a, b);
}

#[test]
fn too_slippery_is_not_lifted() {
    let verdict = verdict(2, |c| c.friction = [0.05, 0.05]);
    assert!(!verdict.succeeded && verdict.risen < 0.05, "{verdict:?}");
}

#[test]
fn much_heavier_than_the_record_says_is_not_lifted() {
    let verdict = verdict(2, |c| c.mass = 15.0);
    assert!(!verdict.succeeded && verdict.risen < 0.05, "{verdict:?}");
}

#[test]
fn a_pose_45_mm_off_is_not_lifted() {
    for shift in [Vector3::x(), Vector3::y(), -Vector3::y()] {
        let verdict = verdict(2, |c| c.offset = shift * 0.045);
        assert!(!verdict.succeeded, "{shift:?}: {verdict:?}");
    }
}

/// Something that the planner was not told of stands on the way of the approach.
fn with_a_shelf() -> (PhysicsArm, Plan) {
    let planned = trial(2, |_| ());
    let plan = planned.plan.unwrap();
    let mut obstacles = planned.obstacles.clone();
    let at = plan.base_from_tip.translation.vector + Vector3::z() * 0.06;
    obstacles.push(Obstacle {
        name: "shelf".into(),
        base_from_solid: Translation3::from(at).into(),
        solid: Solid::Cuboid { half: Vector3::new(0.2, 0.2, 0.005) },
    });
    let world = cell().world(&HOME, &obstacles, &planned.object).unwrap();
    (PhysicsArm::new(Arc::new(Mutex::new(world)), None), plan)
}

#[test]
fn occupied_space_is_felt_and_the_arm_stops() {
    let (mut arm, plan) = with_a_shelf();
    let verdict = trial::run(&mut arm, &plan).unwrap();
    assert!(!verdict.succeeded);
    assert_eq!(verdict.collision.unwrap().other, "shelf");
}

#[test]
fn a_motion_does_not_report_what_an_earlier_one_has_touched() {
    let (mut arm, plan) = with_a_shelf();
    trial::to_pregrasp(&mut arm, &plan).unwrap();
    let watched = MotionLimits::default();
    let outcome = arm.execute(&plan.approach, &watched).unwrap();
    assert!(matches!(outcome, Execution::Contact { .. }), "{outcome:?}");
    let point = |time: f64, positions| Waypoint { time, positions, velocities: [0.0; 6] };
    let stands = arm.read(Duration::ZERO).unwrap().positions;
    let pregrasp = plan.pregrasp().unwrap();
    let back = Trajectory { waypoints: vec![point(0.0, stands), point(2.0, pregrasp)] };
    let blind = MotionLimits { contact_force: f64::INFINITY, ..watched.clone() };
    assert_eq!(arm.execute(&back, &blind), Ok(Execution::Reached));
    let stay = Trajectory { waypoints: vec![point(0.0, pregrasp), point(0.2, pregrasp)] };
    assert_eq!(arm.execute(&stay, &watched), Ok(Execution::Reached));
    // The judge has not forgotten it.
    assert_eq!(arm.world().take_touch().unwrap().other, "shelf");
}

#[test]
fn squeezing_beyond_the_strength_breaks() {
    let planned = trial(2, |_| ());
    let object = TrueObject { strength: 3.0, ..planned.object };
    let world = cell().world(&HOME, &planned.obstacles, &object).unwrap();
    let mut arm = PhysicsArm::new(Arc::new(Mutex::new(world)), None);
    let verdict = trial::run(&mut arm, &planned.plan.unwrap()).unwrap();
    assert!(verdict.broken && !verdict.succeeded, "{verdict:?}");
}

#[test]
fn the_stop_button_stops_at_once_and_bad_trajectories_are_refused() {
    let plan = trial(2, |_| ()).plan.unwrap();
    let world = cell().world(&HOME, &[table()], &block()).unwrap();
    let mut arm = PhysicsArm::new(Arc::new(Mutex::new(world)), None);
    let limits = MotionLimits::default();
    limits.cancel.press();
    assert_eq!(arm.execute(&plan.transfer, &limits), Ok(Execution::Stopped));
    assert_eq!(arm.read(Duration::ZERO).unwrap().positions, HOME);
    // The approach starts elsewhere.
    assert!(arm.execute(&plan.approach, &MotionLimits::default()).is_err());
}
