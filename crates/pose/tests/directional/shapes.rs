//! Shapes beside boxes: their symmetries, how they rest, what is ambiguous.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::{Point3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use serde_json::json;
use vergence_geometry::{Symmetry, Transform};
use vergence_pose::directional::{self, Config};
use vergence_pose::{ObjectPose, Refusal};
use vergence_tag::Record;

use crate::scene::{Piece, Scene};

/// A record of these sides (m) with a landmark.
fn record(
    sides: [f64; 3],
    shape: serde_json::Value,
    landmark: [f64; 3],
    normal: [f64; 3],
) -> Record {
    let [width, length, height] = sides;
    let record = json!({
        "object_id": "object",
        "landmarks": [{"position": landmark, "normal": normal}],
        "bounding_box": {"width": width, "length": length, "height": height},
        "shape": shape,
    });
    serde_json::from_value(record).unwrap_or_else(|e| panic!("{e}"))
}

fn recognise(scene: &Scene, record: &Record, up: bool) -> Result<ObjectPose, Refusal> {
    directional::recognise(&scene.views(), &scene.query(record, up), &Config::default())
}

/// Fails unless the pose is right but for what its symmetry leaves open.
fn assert_right(found: &Result<ObjectPose, Refusal>, truth: &Transform) {
    let found = found.as_ref().unwrap_or_else(|e| panic!("{e}"));
    let (pose, symmetry) = (&found.pose.pose, &found.symmetry);
    let near = symmetry.nearest(truth, pose);
    let mm = 1e3 * (near.translation.vector - pose.translation.vector).norm();
    let deg = symmetry.angle_between(&truth.rotation, &pose.rotation).to_degrees();
    assert!(mm < 3.0 && deg < 2.0, "off by {mm:.2} mm, {deg:.2} degrees");
    let nees = found.nees(truth).map(|(squares, freedoms)| squares / freedoms as f64);
    assert!(nees.is_some_and(|nees| nees < 3.0), "{nees:?}");
}

/// Corners of a regular polygon about a place.
fn regular(corners: usize, radius: f64, [x, y]: [f64; 2]) -> Vec<[f64; 2]> {
    let angle = |k: usize| TAU * k as f64 / corners as f64;
    (0..corners).map(|k| [x + radius * angle(k).cos(), y + radius * angle(k).sin()]).collect()
}

/// A convex prism as it is drawn.
fn drawn(outline: &[[f64; 2]], height: f64) -> Piece {
    let next = outline.iter().cycle().skip(1);
    let walls = outline.iter().zip(next).map(|(a, b)| {
        let n = Vector3::new(b[1] - a[1], a[0] - b[0], 0.0).normalize();
        (n, n.x * a[0] + n.y * a[1])
    });
    let ends = [Vector3::z(), -Vector3::z()].map(|n| (n, height / 2.0));
    Piece::Flat(walls.chain(ends).collect())
}

#[test]
fn a_regular_prism_is_found_but_for_its_symmetry() {
    // Six corners, the landmark in the middle of the lid: it says nothing about sixths of a turn.
    let outline = regular(6, 0.05, [0.0, 0.0]);
    let shape = json!({"kind": "prism", "outline": outline, "height": 0.08});
    let sides = [0.1, 2.0 * 0.05 * 0.75f64.sqrt(), 0.08];
    let record = record(sides, shape, [0.0, 0.0, 0.04], [0.0, 0.0, 1.0]);
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.3);
    let scene = Scene::new(&record, &[drawn(&outline, 0.08)], turn, 3);
    for up in [true, false] {
        let found = recognise(&scene, &record, up);
        assert_right(&found, &scene.truth);
        let Symmetry::Finite(turns) = found.unwrap().symmetry else { panic!("not a finite group") };
        assert_eq!(turns.len(), 6);
    }
}

#[test]
fn the_axis_of_a_symmetry_need_not_pass_the_origin() {
    // Three corners: the middle of the bounding box is not the middle of the triangle.
    let radius = 0.06;
    let outline = regular(3, radius, [-radius / 4.0, 0.0]);
    let shape = json!({"kind": "prism", "outline": outline, "height": 0.12});
    let sides = [1.5 * radius, radius * 3f64.sqrt(), 0.12];
    let landmark = [-radius / 4.0, 0.0, 0.06];
    let record = record(sides, shape, landmark, [0.0, 0.0, 1.0]);
    let turn = UnitQuaternion::from_euler_angles(0.2, -0.1, 0.5);
    let scene = Scene::new(&record, &[drawn(&outline, 0.12)], turn, 4);
    assert_right(&recognise(&scene, &record, false), &scene.truth);
}

#[test]
fn a_prism_with_a_notch_is_found() {
    let outline =
        [[-0.06, -0.06], [0.06, -0.06], [0.06, 0.0], [0.0, 0.0], [0.0, 0.06], [-0.06, 0.06]];
    let shape = json!({"kind": "prism", "outline": outline, "height": 0.1});
    let record = record([0.12, 0.12, 0.1], shape, [-0.06, 0.01, 0.02], [-1.0, 0.0, 0.0]);
    let pieces = [
        Piece::cuboid([-0.06, -0.06, -0.05], [0.06, 0.0, 0.05]),
        Piece::cuboid([-0.06, 0.0, -0.05], [0.0, 0.06, 0.05]),
    ];
    let turn = UnitQuaternion::from_euler_angles(0.3, 0.2, -0.4);
    let scene = Scene::new(&record, &pieces, turn, 5);
    assert_right(&recognise(&scene, &record, false), &scene.truth);
}

#[test]
fn a_can_is_rather_upright_than_upside_down_where_its_landmark_hardly_tells() {
    let shape = json!({"kind": "cylinder", "diameter": 0.066, "height": 0.12});
    let can = |height: f64| {
        record([0.066, 0.066, 0.12], shape.clone(), [0.033, 0.0, height], [1.0, 0.0, 0.0])
    };
    let piece = [Piece::Cylinder { radius: 0.033, half: 0.06 }];
    let upright = UnitQuaternion::from_euler_angles(0.0, 0.0, PI);
    let over = UnitQuaternion::from_euler_angles(PI, 0.0, PI);
    let is_upright = |pose: &Transform| (pose.rotation * Vector3::z()).z > 0.9;
    // The cameras are upright, too.
    for gravity in [true, false] {
        // Its light is 2.5 mm above the middle, seen at this height above it.
        let seen_at = |height: f64| {
            let record = can(0.0025);
            let mut scene = Scene::new(&record, &piece, upright, 71);
            let middle = scene.truth.translation.vector;
            let off = scene.truth.rotation * Vector3::new(0.033, 0.0, height);
            scene.landmark.position = Point3::from(middle + off);
            (recognise(&scene, &record, gravity), scene.truth)
        };
        // About the middle it does not tell, and then nothing does.
        let (tied, _) = seen_at(-0.0004);
        let Err(Refusal::Ambiguous { best }) = tied else { panic!("{tied:?}") };
        assert!(is_upright(&best.pose.pose) && best.confidence > 0.75, "{}", best.confidence);
        assert!(best.alternatives.iter().any(|other| !is_upright(&other.pose)));
        // For itself this would be five to one.
        let (found, truth) = seen_at(0.001);
        assert_right(&found, &truth);
        // What it does tell is believed.
        let record = can(0.02);
        let scene = Scene::new(&record, &piece, over, 72);
        assert_right(&recognise(&scene, &record, gravity), &scene.truth);
    }
}

#[test]
fn a_can_on_its_side_rests() {
    let shape = json!({"kind": "cylinder", "diameter": 0.066, "height": 0.12});
    let record = record([0.066, 0.066, 0.12], shape, [0.033, 0.0, 0.02], [1.0, 0.0, 0.0]);
    for (seed, roll, turn) in [(6, 2.2, 0.6), (7, 3.6, -0.4), (8, 2.9, 1.0)] {
        // On its side, rolled and turned; the landmark looks towards the cameras.
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, turn)
            * UnitQuaternion::from_euler_angles(FRAC_PI_2, 0.0, 0.0)
            * UnitQuaternion::from_euler_angles(0.0, 0.0, roll);
        let scene =
            Scene::new(&record, &[Piece::Cylinder { radius: 0.033, half: 0.06 }], turn, seed);
        let found = recognise(&scene, &record, true);
        assert_right(&found, &scene.truth);
        let axis = found.unwrap().pose.pose.rotation * Vector3::z();
        assert!(axis.z.abs() < 0.01, "gravity should hold the axis level, not at {:.3}", axis.z);
    }
}

#[test]
fn a_can_on_its_side_is_found_above_its_own_shadow() {
    let shape = json!({"kind": "cylinder", "diameter": 0.066, "height": 0.12});
    let record = record([0.066, 0.066, 0.12], shape, [0.033, 0.0, 0.02], [1.0, 0.0, 0.0]);
    for (seed, roll, turn) in [(6, 2.2, 0.6), (7, 3.6, -0.4), (8, 2.9, 1.0)] {
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, turn)
            * UnitQuaternion::from_euler_angles(FRAC_PI_2, 0.0, 0.0)
            * UnitQuaternion::from_euler_angles(0.0, 0.0, roll);
        // What of the wall looks down, by eighteen degrees or more, gets no light: it is as dark as the
        // ground, and the can seems to end where that begins.
        const DARK: f64 = 1.25;
        let down = turn.inverse() * -Vector3::z();
        let first = down.y.atan2(down.x) + DARK;
        let lit = (0..=84).map(|k| first + (TAU - 2.0 * DARK) * f64::from(k) / 84.0);
        let lit: Vec<[f64; 2]> = lit.map(|a| [0.033 * a.cos(), 0.033 * a.sin()]).collect();
        let scene = Scene::new(&record, &[drawn(&lit, 0.12)], turn, seed);
        let found = recognise(&scene, &record, true);
        assert_right(&found, &scene.truth);
        // The edge of the shadow is what such a wall is known to show.
        let coverage = found.unwrap().coverage;
        assert!(coverage > 0.75, "edges explain only {coverage:.2} of the contour");
    }
}

#[test]
fn a_ball_rests_on_any_point() {
    let shape = json!({"kind": "sphere", "diameter": 0.1});
    let record = record([0.1, 0.1, 0.1], shape, [0.05, 0.0, 0.0], [1.0, 0.0, 0.0]);
    for seed in 9..19 {
        let tilt = 0.15 * seed as f64 - 1.65;
        let turn = UnitQuaternion::from_euler_angles(0.2, tilt, PI - 0.1);
        let scene = Scene::new(&record, &[Piece::Ball(0.05, Point3::origin())], turn, seed);
        let found = recognise(&scene, &record, true);
        assert_right(&found, &scene.truth);
        // Nothing but the landmark tells how it is turned, and that says so whatever the turn about it.
        let landmark = found.unwrap().pose.pose * Point3::from(record.landmarks[0].position);
        let off = (landmark - scene.landmark.position).norm();
        assert!(off < 0.003, "the landmark is put {:.1} mm beside where it was seen", 1e3 * off);
    }
}

#[test]
fn a_turn_that_nothing_tells_stays_as_it_was() {
    // About the landmark a ball may turn as it likes, and so may a can whose landmark is in its lid.
    let ball = json!({"kind": "sphere", "diameter": 0.1});
    let ball = record([0.1; 3], ball, [0.0, 0.0, 0.05], [0.0, 0.0, 1.0]);
    let can = json!({"kind": "cylinder", "diameter": 0.066, "height": 0.12});
    let can = record([0.066, 0.066, 0.12], can, [0.0, 0.0, 0.06], [0.0, 0.0, 1.0]);
    let drawn_as =
        [Piece::Ball(0.05, Point3::origin()), Piece::Cylinder { radius: 0.033, half: 0.06 }];
    for (record, piece) in [ball, can].iter().zip(drawn_as) {
        // On its side, the landmark towards the cameras.
        let turn = UnitQuaternion::from_euler_angles(0.0, -FRAC_PI_2, 0.3);
        let scene = Scene::new(record, &[piece], turn, 14);
        let off = UnitQuaternion::from_euler_angles(0.04, -0.05, 0.03);
        let last = Transform::from_parts(scene.truth.translation, off * scene.truth.rotation);
        for up in [true, false] {
            let query = scene.query(record, up);
            let found = directional::track(&scene.views(), &query, &last, &Config::default());
            assert_right(&found, &scene.truth);
            let rotation = found.unwrap().pose.pose.rotation;
            let turned = (rotation * last.rotation.inverse()).scaled_axis();
            let about = turned.dot(&(rotation * Vector3::z())).to_degrees();
            assert!(about.abs() < 10.0, "{:?} turned by {about:.1} degrees", record.shape);
        }
    }
}

#[test]
fn of_two_balls_that_touch_at_the_landmark_both_are_considered() {
    // Nothing but the landmark could say which it is, and that is seen from where they touch.
    let shape = json!({"kind": "sphere", "diameter": 0.08});
    let record = record([0.08, 0.08, 0.08], shape, [0.04, 0.0, 0.0], [1.0, 0.0, 0.0]);
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, -FRAC_PI_2 - 0.2);
    let other = Point3::new(0.08, 0.0, 0.0);
    let pieces = [Piece::Ball(0.04, Point3::origin()), Piece::Ball(0.04, other)];
    let config = Config { grazing: -0.3, ..Config::default() };
    let scene = Scene::new(&record, &pieces, turn, 12);
    let query = scene.query(&record, false);
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_considers(&result, [Point3::origin(), other].map(|at| scene.truth * at));
}

#[test]
fn of_two_slender_cans_that_touch_at_the_landmark_both_are_considered() {
    // They stand nearer to each other than a turn that makes another pose moves their ends.
    let shape = json!({"kind": "cylinder", "diameter": 0.024, "height": 0.26});
    let record = record([0.024, 0.024, 0.26], shape, [0.012, 0.0, 0.1], [1.0, 0.0, 0.0]);
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, -FRAC_PI_2);
    let places = [Point3::origin(), Point3::new(0.024, 0.0, 0.0)];
    let pieces = places.map(|at| drawn(&regular(48, 0.012, [at.x, at.y]), 0.26));
    let config = Config { grazing: -0.3, ..Config::default() };
    let scene = Scene::new(&record, &pieces, turn, 13);
    let query = scene.query(&record, true);
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_considers(&result, places.map(|at| scene.truth * at));
}

/// Fails unless there is a pose, the best one or another, at each of two places.
fn assert_considers(result: &Result<ObjectPose, Refusal>, places: [Point3<f64>; 2]) {
    let found = match result {
        Ok(found) => found,
        Err(refusal) => refusal.best_guess().unwrap_or_else(|| panic!("{refusal}")),
    };
    for place in places {
        let others = found.alternatives.iter().map(|other| other.pose);
        let near = |pose: &Transform| (pose.translation.vector - place.coords).norm() < 0.006;
        assert!(others.chain([found.pose.pose]).any(|pose| near(&pose)), "{place}: {found:?}");
    }
}

#[test]
fn every_record_that_is_valid_is_answered_or_refused() {
    let mut rng = rand_pcg::Pcg32::seed_from_u64(17);
    let piece = Piece::cuboid([-0.04, -0.03, -0.03], [0.05, 0.04, 0.05]);
    let any = record([0.1; 3], json!({"kind": "box"}), [0.0, 0.0, 0.05], [0.0, 0.0, 1.0]);
    let mut scene = Scene::new(&any, &[piece], UnitQuaternion::identity(), 1);
    let mut judged = 0;
    for seed in 0..20 {
        let mut size = |low: f64, high: f64| rng.random_range(low..high);
        let corners = size(4.0, 48.0) as usize;
        let shape = match seed % 4 {
            // Any hull, the corners of a lattice among them: many lie in one plane or within a face.
            0 => {
                let steps = size(1.5, 6.0).floor();
                let mut at = || (steps * size(-1.0, 1.0)).round() / steps * 0.05;
                json!({"kind": "convex", "vertices": (0..corners).map(|_| [at(), at(), at()]).collect::<Vec<_>>()})
            }
            // Any star, some of its points nearly in its middle.
            1 => {
                let corners = corners.clamp(3, 24);
                let point = |k: usize| {
                    let (angle, r) = (TAU * k as f64 / corners as f64, size(1e-4, 0.05));
                    [r * angle.cos(), r * angle.sin()]
                };
                let outline: Vec<[f64; 2]> = (0..corners).map(point).collect();
                json!({"kind": "prism", "outline": outline, "height": 0.1})
            }
            2 => {
                let (top, bottom) = (size(1e-4, 0.1), size(1e-4, 0.1));
                json!({"kind": "cup", "top_diameter": top, "bottom_diameter": bottom, "height": 0.1})
            }
            _ => {
                json!({"kind": "cylinder", "diameter": size(1e-4, 0.1), "height": size(1e-4, 0.1)})
            }
        };
        // As wide as the shape says: the origin is the box's middle.
        let widest =
            |values: Vec<f64>| 2.0 * values.into_iter().fold(0.0, |a: f64, v| a.max(v.abs()));
        let number = |key: &str| shape[key].as_f64().unwrap_or(0.0);
        let along = |key: &str, axis: usize| {
            let points = shape[key].as_array().into_iter().flatten();
            widest(points.map(|p| p[axis].as_f64().unwrap()).collect())
        };
        let sides = match shape["kind"].as_str().unwrap() {
            "convex" => [0, 1, 2].map(|axis| along("vertices", axis)),
            "prism" => [along("outline", 0), along("outline", 1), 0.1],
            "cup" => {
                let wide = number("top_diameter").max(number("bottom_diameter"));
                [wide, wide, 0.1]
            }
            _ => [number("diameter"), number("diameter"), number("height")],
        };
        let landmark = [0.0, 0.0, 0.5 * sides[2]];
        let record = record(sides, shape, landmark, [0.0, 0.0, 1.0]);
        if record.validate().is_err() {
            continue;
        }
        judged += 1;
        // The same pictures of a box for all: what they show does not matter.
        scene.landmark.position = scene.truth * Point3::from(landmark);
        for up in [true, false] {
            if let Ok(found) = recognise(&scene, &record, up) {
                assert!((0.0..=1.0).contains(&found.confidence), "{found:?}");
                assert!(found.pose.covariance.cholesky().is_some(), "{found:?}");
            }
        }
    }
    assert!(judged > 14, "only {judged} records were valid");
}
