//! The planner on the arm of `assets/arm.urdf`: plans are sound, refusals say why.

#![allow(clippy::unwrap_used)]

use std::f64::consts::TAU;
use std::path::Path;

use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use vergence_devices::Description;
use vergence_geometry::{Body, GaussianPose, JointAngles, Solid, Trajectory, Transform};
use vergence_grasp::{
    Config, Hold, Obstacle, Plan, Refusal, Request, Robot, correct, next_best, plan, turn_in_sight,
};
use vergence_tag::Record;

const HOME: JointAngles = [-0.9, -0.6, 1.3, 0.0, 0.9, 0.0];

fn robot() -> Robot {
    let text = include_str!("../assets/arm.urdf");
    let description = Description::parse(text, Path::new("arm.urdf")).unwrap();
    let chain = description.chain("base", "tcp").unwrap();
    let mut bodies = description.bodies("base", &chain).unwrap();
    // The heads: a mast and the ball in which each camera turns.
    for y in [-0.1, 0.1] {
        bodies.push(Body {
            name: "head".into(),
            joints: 0,
            frame_from_solid: Translation3::new(0.0, y, 0.45).into(),
            slide: Vector3::zeros(),
            solid: Solid::Sphere { radius: 0.08 },
        });
    }
    let gripper = description.gripper("hand").unwrap();
    Robot::new(chain, &bodies, gripper.travel, gripper.effort).unwrap()
}

fn table() -> Obstacle {
    block("table", [0.5, 0.0, -0.05], [1.0, 1.0, 0.05])
}

fn block(name: &str, at: [f64; 3], half: [f64; 3]) -> Obstacle {
    Obstacle {
        name: name.into(),
        base_from_solid: Translation3::from(Vector3::from(at)).into(),
        solid: Solid::Cuboid { half: half.into() },
    }
}

fn record(size: [f64; 3], shape: &str, landmark: [f64; 3], normal: [f64; 3]) -> Record {
    let [w, l, h] = size;
    serde_json::from_str(&format!(
        r#"{{"object_id": "thing-1", "landmarks": [{{"position": {landmark:?}, "normal": {normal:?}}}],
            "bounding_box": {{"width": {w}, "length": {l}, "height": {h}}}, "shape": {shape},
            "physical": {{"weight": 0.3, "material": "ceramic"}}, "semantic": {{"name": "thing"}}}}"#
    ))
    .unwrap()
}

fn cup() -> Record {
    let shape = r#"{"kind": "cup", "top_diameter": 0.08, "bottom_diameter": 0.06, "height": 0.09}"#;
    record([0.08, 0.08, 0.09], shape, [-0.035, 0.0, 0.0], [-1.0, 0.0, 0.0])
}

fn carton() -> Record {
    record([0.06, 0.1, 0.15], r#"{"kind": "box"}"#, [-0.03, 0.0, 0.05], [-1.0, 0.0, 0.0])
}

fn can() -> Record {
    let shape = r#"{"kind": "cylinder", "diameter": 0.066, "height": 0.115}"#;
    record([0.066, 0.066, 0.115], shape, [-0.033, 0.0, 0.02], [-1.0, 0.0, 0.0])
}

/// Standing on the table, turned by `yaw`; standard deviations in mm and rad.
fn standing(record: &Record, x: f64, y: f64, yaw: f64, sigma_mm: f64) -> GaussianPose {
    let pose = Transform::from_parts(
        Translation3::new(x, y, record.bounding_box.height / 2.0),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
    );
    let v = (sigma_mm * 1e-3).powi(2);
    let diagonal = Vector6::new(2e-4, 2e-4, 2e-4, v, v, v);
    GaussianPose { pose, covariance: Matrix6::from_diagonal(&diagonal) }
}

fn ask(record: &Record, object: &GaussianPose, obstacles: &[Obstacle]) -> Result<Plan, Refusal> {
    let request = Request {
        record,
        object,
        landmark: 0,
        start: &HOME,
        obstacles,
        free_azimuths: &[],
        seed: 1,
    };
    plan(&robot(), &request, &Config::default())
}

fn end(trajectory: &Trajectory) -> JointAngles {
    trajectory.waypoints.last().unwrap().positions
}

#[test]
fn plans_join_up_and_keep_the_limits() {
    let robot = robot();
    for record in [cup(), carton(), can()] {
        let plan = ask(&record, &standing(&record, 0.65, 0.0, 0.3, 2.0), &[table()]).unwrap();
        assert_eq!(plan.transfer.waypoints[0].positions, HOME);
        assert_eq!(end(&plan.transfer), plan.approach.waypoints[0].positions);
        assert_eq!(end(&plan.approach), plan.lift.waypoints[0].positions);
        let closed = robot.arm.forward(&end(&plan.approach));
        let off = (closed.translation.vector - plan.base_from_tip.translation.vector).norm();
        assert!(off < 1e-6, "the approach ends {off} m from the grasp");
        let raised = robot.arm.forward(&end(&plan.lift)).translation.vector;
        assert!((raised - closed.translation.vector - Vector3::z() * 0.1).norm() < 1e-6);
        for trajectory in [&plan.transfer, &plan.approach, &plan.lift] {
            assert_speeds(&robot, trajectory);
        }
    }
}

/// Tool at most 50 mm/s, joints within range and speed, at rest at both ends.
fn assert_speeds(robot: &Robot, trajectory: &Trajectory) {
    let (first, last) =
        (trajectory.waypoints.first().unwrap(), trajectory.waypoints.last().unwrap());
    assert!(first.velocities.iter().chain(&last.velocities).all(|v| *v == 0.0));
    let step = 0.004;
    let mut before = first.positions;
    for n in 1..=(trajectory.duration() / step) as usize {
        let now = trajectory.at(n as f64 * step).unwrap().positions;
        let tip = |q| robot.arm.forward(q).translation.vector;
        let speed = (tip(&now) - tip(&before)).norm() / step;
        assert!(speed < 0.0515, "the tool moves at {speed} m/s");
        assert!(robot.arm.within_limits(&now));
        for (k, joint) in robot.arm.chain().joints.iter().enumerate() {
            let rate = (now[k] - before[k]).abs() / step;
            assert!(rate < joint.limits.velocity, "joint {k} turns at {rate} rad/s");
        }
        before = now;
    }
}

#[test]
fn a_cup_is_taken_by_the_rim_above_its_landmark() {
    let record = cup();
    let plan = ask(&record, &standing(&record, 0.7, 0.1, 1.0, 2.0), &[table()]).unwrap();
    assert_eq!(plan.grasp.hold, Hold::Rim);
    let tip = plan.grasp.object_from_tip.translation.vector;
    assert!(tip.x < -0.03 && tip.y.abs() < 1e-3, "beside the landmark: {tip:?}");
    // Seen free all round, other holds become possible.
    let object = standing(&record, 0.7, 0.1, 1.0, 2.0);
    let request = Request {
        record: &record,
        object: &object,
        landmark: 0,
        start: &HOME,
        obstacles: &[table()],
        free_azimuths: &[(0.0, TAU - 1e-9)],
        seed: 1,
    };
    let seen = plan_with(&request).unwrap();
    assert_ne!(seen.grasp.hold, Hold::Rim, "{:?}", seen.reasons);
}

fn plan_with(request: &Request) -> Result<Plan, Refusal> {
    plan(&robot(), request, &Config::default())
}

#[test]
fn what_cannot_be_done_is_refused_by_name() {
    let here = |r: &Record| standing(r, 0.65, 0.0, 0.3, 2.0);
    let refusal = |record: &Record, object: &GaussianPose, obstacles: &[Obstacle]| {
        ask(record, object, obstacles).err().unwrap()
    };
    let table = [table()];
    let changed = |change: fn(&mut Record)| {
        let mut record = can();
        change(&mut record);
        let object = here(&record);
        refusal(&record, &object, &table)
    };
    let fixed = changed(|r| r.semantic.mobility = vergence_tag::Mobility::Fixed);
    assert_eq!(fixed, Refusal::Fixed("thing".into()));
    let heavy = changed(|r| r.physical.weight = Some(4.0));
    assert!(matches!(heavy, Refusal::TooHeavy { .. }), "{heavy}");
    let weak = changed(|r| r.physical.strength = Some(2.0));
    assert!(matches!(weak, Refusal::TooWeak { .. }), "{weak}");
    let bad = changed(|r| r.bounding_box.width = f64::NAN);
    assert!(matches!(bad, Refusal::Record(_)), "{bad}");
    let wide = record([0.2, 0.2, 0.2], r#"{"kind": "box"}"#, [-0.1, 0.0, 0.0], [-1.0, 0.0, 0.0]);
    let why = refusal(&wide, &here(&wide), &table);
    assert!(matches!(why, Refusal::TooWide { .. }), "{why}");
    let far = refusal(&can(), &standing(&can(), 1.6, 0.0, 0.0, 2.0), &table);
    assert!(matches!(far, Refusal::Unreachable(_)), "{far}");
    let unsure = refusal(&can(), &standing(&can(), 0.65, 0.0, 0.0, 15.0), &table);
    assert!(matches!(unsure, Refusal::TooUncertain { .. }), "{unsure}");
    let mut nan = here(&can());
    nan.covariance[(4, 4)] = f64::NAN;
    let nan = refusal(&can(), &nan, &table);
    assert!(matches!(nan, Refusal::Pose(_)), "{nan}");
}

#[test]
fn a_walled_in_object_is_occupied_and_says_by_what() {
    let record = can();
    let object = standing(&record, 0.65, 0.0, 0.0, 2.0);
    let lid = block("shelf", [0.65, 0.0, 0.2], [0.2, 0.2, 0.01]);
    let side = |x: f64, y: f64, hx: f64, hy: f64| block("shelf", [x, y, 0.1], [hx, hy, 0.1]);
    let shelf = [
        table(),
        lid,
        side(0.55, 0.0, 0.01, 0.1),
        side(0.75, 0.0, 0.01, 0.1),
        side(0.65, 0.1, 0.1, 0.01),
        side(0.65, -0.1, 0.1, 0.01),
    ];
    match ask(&record, &object, &shelf) {
        Err(Refusal::Occupied(hit)) => {
            assert!(hit.other == "shelf" || hit.link == "shelf", "{hit:?}")
        }
        other => panic!("{other:?}"),
    }
    // The same object without the shelf is no problem.
    assert!(ask(&record, &object, &[table()]).is_ok());
}

#[test]
fn plans_repeat_bit_for_bit() {
    let record = carton();
    let object = standing(&record, 0.6, 0.15, 0.7, 2.0);
    let lamp = block("lamp", [0.45, -0.25, 0.25], [0.02, 0.02, 0.25]);
    let obstacles = [table(), lamp];
    let first = ask(&record, &object, &obstacles).unwrap();
    assert_eq!(ask(&record, &object, &obstacles).unwrap(), first);
}

#[test]
fn a_second_look_corrects_the_rest_of_the_plan_or_voids_it() {
    let (record, robot, config) = (carton(), robot(), Config::default());
    let first = standing(&record, 0.6, 0.1, 0.7, 3.0);
    let made = ask(&record, &first, &[table()]).unwrap();
    let pregrasp = made.pregrasp().unwrap();
    let look = |x: f64| {
        let object = standing(&record, x, 0.1, 0.72, 1.0);
        let request = Request {
            record: &record,
            object: &object,
            landmark: 0,
            start: &pregrasp,
            obstacles: &[table()],
            free_azimuths: &[],
            seed: 1,
        };
        let wanted = object.pose * made.grasp.object_from_tip;
        (correct(&robot, &made, &request, &config), wanted)
    };
    let (corrected, wanted) = look(0.605);
    let corrected = corrected.unwrap();
    assert_eq!(corrected.transfer.waypoints[0].positions, pregrasp);
    let closed = robot.arm.forward(&end(&corrected.approach)).translation.vector;
    assert!((closed - wanted.translation.vector).norm() < 1e-6);
    assert!(matches!(look(0.66).0, Err(Refusal::Moved { .. })));
}

#[test]
fn a_lifted_object_is_turned_in_place_unless_something_stands_there() {
    let (record, robot, config) = (cup(), robot(), Config::default());
    let object = standing(&record, 0.6, 0.0, 0.0, 1.0);
    let made = ask(&record, &object, &[table()]).unwrap();
    let lifted = end(&made.lift);
    let turn = |obstacles: &[Obstacle], angle: f64| {
        let request = Request {
            record: &record,
            object: &object,
            landmark: 0,
            start: &lifted,
            obstacles,
            free_azimuths: &[],
            seed: 1,
        };
        turn_in_sight(&robot, &made, &request, &config, &lifted, angle)
    };
    let before = robot.arm.forward(&lifted);
    let turned = [0.8, -0.8].map(|angle| (angle, turn(&[table()], angle)));
    assert!(turned.iter().any(|(_, turn)| turn.is_some()), "the wrist turns neither way");
    for (angle, turn) in turned {
        let Some(turn) = turn else { continue };
        assert_eq!(turn.waypoints[0].positions, lifted);
        let after = robot.arm.forward(&end(&turn));
        assert!((after.translation.vector - before.translation.vector).norm() < 1e-6);
        let by = (after.rotation * before.rotation.inverse()).scaled_axis();
        assert!((by - Vector3::z() * angle).norm() < 1e-6, "{by} instead of {angle}");
    }
    // A wall where the cup is now.
    let at = object.pose.translation.vector + Vector3::new(0.0, 0.0, config.lift);
    let wall = block("wall", at.into(), [0.01, 0.01, 0.05]);
    assert!([0.8, -0.8].iter().all(|angle| turn(&[table(), wall.clone()], *angle).is_none()));
}

#[test]
fn the_next_best_grasp_is_another_that_can_be_carried_out() {
    let (record, robot, config) = (carton(), robot(), Config::default());
    let object = standing(&record, 0.6, 0.1, 0.7, 1.0);
    let made = ask(&record, &object, &[table()]).unwrap();
    let next = next_best(&made, &object).unwrap();
    assert_ne!(next.grasp, made.grasp);
    let request = Request {
        record: &record,
        object: &object,
        landmark: 0,
        start: &HOME,
        obstacles: &[table()],
        free_azimuths: &[],
        seed: 1,
    };
    let again = correct(&robot, &next, &request, &config).unwrap();
    let closed = robot.arm.forward(&end(&again.approach)).translation.vector;
    let wanted = object.pose * next.grasp.object_from_tip;
    assert!((closed - wanted.translation.vector).norm() < 1e-6);
}
