//! Two pictures of a printed body, drawn by rays, against what print should say about its pose.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix2, Matrix3, Point3, UnitQuaternion, Vector2, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use vergence_geometry::gaussian::perturb;
use vergence_geometry::{Camera, GaussianPoint, Transform};
use vergence_imaging::Image;
use vergence_tag::Record;

use super::square::Place;
use super::*;
use crate::directional::equations::Move;
use crate::directional::level::{Reduced, Region};
use crate::directional::refine::{FINAL, STEPS};
use crate::directional::sites::FORM_AT;
use crate::directional::{Config, prepare};
use crate::model::Model;
use crate::types::{Query, View};

const BODIES: [&str; 4] = [
    r#""bounding_box": {"width": 0.14, "length": 0.12, "height": 0.18}, "shape": {"kind": "box"}"#,
    r#""bounding_box": {"width": 0.1, "length": 0.1, "height": 0.16},
        "shape": {"kind": "cylinder", "diameter": 0.1, "height": 0.16}"#,
    r#""bounding_box": {"width": 0.12, "length": 0.12, "height": 0.16},
        "shape": {"kind": "cup", "top_diameter": 0.12, "bottom_diameter": 0.09, "height": 0.16}"#,
    r#""bounding_box": {"width": 0.14, "length": 0.14, "height": 0.14},
        "shape": {"kind": "sphere", "diameter": 0.14}"#,
];

/// A body whose landmark is below, where no camera sees it.
fn record(body: &str) -> Record {
    let text = format!(
        r#"{{"object_id": "printed", "landmarks": [{{"position": [0, 0, -0.06], "normal": [0, 0, -1]}}], {body}}}"#
    );
    serde_json::from_str(&text).unwrap()
}

/// Two cameras beside each other that look at the body's place from a little above.
fn cameras() -> [(Camera, Transform); 2] {
    [0.1, -0.1].map(|y| {
        let turn = UnitQuaternion::from_euler_angles(-1.9, 0.0, -FRAC_PI_2 - 1.4 * y);
        let place = Vector3::new(0.0, y, 0.3);
        (Camera::centred(320, 240, 380.0), Transform::from_parts(place.into(), turn))
    })
}

/// `base_from_object`, turned so that a box shows three faces.
fn pose() -> Transform {
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.5);
    Transform::from_parts(Vector3::new(0.75, 0.01, 0.05).into(), turn)
}

/// What there is to see beside the object's form.
#[derive(Clone, Copy)]
struct Scene {
    /// The object has print.
    printed: bool,
    /// Below it there is a table with grain, this far from it (m).
    table: Option<f64>,
    /// How much the grain differs from the table's mean, and the sensor's noise (grey levels).
    grain: f64,
    noise: f64,
    /// What is known of how it rests.
    standing: Option<bool>,
}

const PRINTED: Scene =
    Scene { printed: true, table: None, grain: 20.0, noise: 0.0, standing: Some(true) };
/// A plain object on a table.
const PLAIN: Scene = Scene { printed: false, table: Some(0.0), ..PRINTED };

/// The object under a lamp at one side; the background is dark.
fn picture(
    model: &Model,
    (camera, base_from_optical): &(Camera, Transform),
    scene: Scene,
    seed: u64,
) -> Image<u8> {
    let mut noise = rand_pcg::Pcg32::seed_from_u64(seed);
    let object_from_optical = pose().inverse() * base_from_optical;
    let eye = object_from_optical.translation.vector;
    let lamp = Vector3::new(-0.6, 0.5, 0.6).normalize();
    const RAYS: usize = 4;
    let level = |x: f64, y: f64| {
        let ray = object_from_optical.rotation * camera.unproject(&Point2::new(x, y));
        let Some(hit) = model.first_hit(&eye, &ray) else {
            let Some(gap) = scene.table.filter(|_| ray.z < -0.05) else { return 20.0 };
            let p = (eye + ray * ((eye.z + gap + model.reach(&-Vector3::z())) / -ray.z)) * 1e3;
            let grain = (p.x / 4.3 + (p.y / 9.0).sin()).sin() + (p.y / 5.2).sin();
            return 90.0 + scene.grain * grain;
        };
        let p = (eye + ray * hit.distance) * 1e3;
        let print = (p.x / 4.1).sin() * (p.y / 3.3 + 0.4).sin() + (p.z / 3.7 + p.x / 6.1).sin();
        let print = if scene.printed { 35.0 * print } else { 0.0 };
        (110.0 + print) * (0.5 + 0.5 * hit.normal.dot(&lamp).max(0.0))
    };
    Image::from_fn(camera.width, camera.height, |x, y| {
        let part = |k: usize| (k as f64 + 0.5) / RAYS as f64 - 0.5;
        let rays = (0..RAYS * RAYS).map(|k| (part(k % RAYS), part(k / RAYS)));
        let sum: f64 = rays.map(|(dx, dy)| level(x as f64 + dx, y as f64 + dy)).sum();
        let gauss: f64 = (0..4).map(|_| noise.random_range(-1.0..1.0)).sum::<f64>() * 0.866;
        (sum / (RAYS * RAYS) as f64 + scene.noise * gauss).round() as u8
    })
}

/// The landmark is measured this much too far away (m).
const TOO_FAR: Vector3<f64> = Vector3::new(0.003, 0.0, 0.0);

/// Calls back with a search on the pictures of a printed body.
fn with(body: &str, check: impl Fn(&Search)) {
    with_all(body, PRINTED, Default::default(), check);
}

/// The same of some scene, whose cameras were turned a little more than told.
fn with_all(body: &str, scene: Scene, turns: [Vector2<f64>; 2], mut check: impl FnMut(&Search)) {
    let record = record(body);
    let model = Model::new(&record);
    let cameras = cameras();
    let images = [0, 1].map(|v| {
        let turned = Transform::rotation(turns[v].push(0.0));
        picture(&model, &(cameras[v].0, cameras[v].1 * turned.inverse()), scene, v as u64)
    });
    let views = [0, 1].map(|v| View {
        image: &images[v],
        camera: cameras[v].0,
        base_from_optical: cameras[v].1,
        turn_sd: 1e-3,
    });
    let on_body = Vector3::new(0.0, 0.0, -0.06);
    let landmark = GaussianPoint {
        position: pose() * Point3::from(on_body) + TOO_FAR,
        covariance: Matrix3::identity() * 1e-5,
    };
    let (up, standing) = (Some(Vector3::z_axis()), scene.standing);
    let query = Query { record: &record, landmark, landmark_index: 0, up, standing };
    let config = Config::default();
    let sights = prepare(&views, &query, on_body, &config, false);
    let search = Search::new(&sights, &model, &query, (on_body, -Vector3::z()), &config);
    check(&search);
}

/// The squares in a pose that is off the true one by this tangent.
fn seen(search: &Search, off: &Vector6<f64>) -> Vec<Patch> {
    let mut refined = Refined::new(&perturb(&pose(), off), false);
    search.lay_out(&mut refined, &FINAL.layout);
    [search.print(&refined), search.ground(&refined, &ON_GROUND[0], ENOUGH)].concat()
}

fn mean(patches: &[Patch], of: impl Fn(&Patch) -> f64) -> f64 {
    patches.iter().map(of).sum::<f64>() / patches.len() as f64
}

#[test]
fn print_is_where_the_true_pose_puts_it_on_flat_and_on_curved_surfaces() {
    for body in BODIES {
        with(body, |search| {
            let patches = seen(search, &Vector6::zeros());
            assert!(patches.len() > 100, "{} squares of {body}", patches.len());
            for surface in patches.chunk_by(|a, b| a.part == b.part) {
                // A hundredth of a pixel is a tenth of a millimetre here.
                let off = mean(surface, |p| p.residual);
                let what = format!("{off:.3} px, {} squares of {body}", surface.len());
                assert!(surface.len() < 20 || off.abs() < 0.02, "{what}");
            }
        });
    }
}

#[test]
fn print_says_how_far_a_pose_is_off() {
    // Turned by 0.2 deg about the base's axes, moved by up to 2 mm.
    let off = Vector6::new(0.003, -0.003, 0.003, 0.002, 0.001, -0.001);
    for body in BODIES {
        with(body, |search| {
            let patches = seen(search, &off);
            assert!(patches.len() > 100, "{} squares of {body}", patches.len());
            let predicted = |p: &Patch| -(p.by_shared.fixed_columns::<6>(0) * off).x;
            let left = mean(&patches, |p| (p.residual - predicted(p)).abs());
            let moved = mean(&patches, |p| predicted(p).abs());
            assert!(moved > 0.2 && left < 0.2 * moved, "{left:.3} of {moved:.3} px, {body}");
        });
    }
}

#[test]
fn print_alone_brings_surfaces_back() {
    for body in BODIES {
        with(body, |search| {
            let off = Vector6::new(0.0, 0.0, 0.0, TOO_FAR.x, TOO_FAR.y, TOO_FAR.z);
            let mut refined = Refined::new(&perturb(&pose(), &off), false);
            let mut shifts = Vec::new();
            for _ in 0..3 {
                search.lay_out(&mut refined, &FINAL.layout);
                refined.patches = search.print(&refined);
                shifts.push(mean(&refined.patches, |p| p.residual.abs()));
                let mut moved = Move::default();
                (0..STEPS).for_each(|_| search.advance(&mut refined, &[], 0.2, &mut moved));
                refined.apply(&moved);
            }
            assert!(shifts[0] > 0.2 && shifts[2] < 0.25 * shifts[0], "{shifts:?} px, {body}");
        });
    }
}

#[test]
fn the_second_view_sees_a_point_move_by_the_derivatives() {
    // Standing, and lying on a side, on which some can roll.
    let lying = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), FRAC_PI_2);
    let lying = Transform::from_parts(pose().translation, lying * pose().rotation);
    let rests = [(Some(true), pose()), (None, lying)];
    for (body, (standing, place)) in BODIES.iter().flat_map(|b| rests.map(|r| (b, r))) {
        with_all(body, Scene { standing, ..PRINTED }, Default::default(), |search| {
            let level = &search.sights[0].fine;
            let at = |refined: &Refined, x: usize, y: usize| {
                let pair = Pair::new(search, refined)?;
                let middle = pair.surface(pixel_of(level, x, y))?;
                let (place, by_surface) = pair.carry_over(x, y, 3, middle)?;
                let on_ground = middle.part == GROUND;
                Some((place, pair.by_shared(&middle) * by_surface, on_ground))
            };
            // On its wall a cup leans.
            let down = search.model.rest(&(place.rotation.inverse() * -Vector3::z())).down;
            let upright =
                UnitQuaternion::rotation_between(&(place.rotation * down), &-Vector3::z());
            let place = Transform::from_parts(place.translation, upright.unwrap() * place.rotation);
            let still = Refined::new(&place, true);
            let mut checked = [0, 0];
            let inner = |k: usize, size: usize| size / 3 + k * size / 30;
            let outer = |k: usize, size: usize| size / 10 + k * size * 8 / 100;
            let (width, height) = (level.width(), level.height());
            let grid = |spread: fn(usize, usize) -> usize| {
                (0..100).map(move |k| (spread(k % 10, width), spread(k / 10, height)))
            };
            for (x, y) in grid(inner).chain(grid(outer)) {
                let Some((place, by_shared, on_ground)) = at(&still, x, y) else { continue };
                const STEP: f64 = 1e-5;
                let derivative = |change: &dyn Fn(&mut Refined)| {
                    let mut moved = still.clone();
                    change(&mut moved);
                    let (there, ..) = at(&moved, x, y)?;
                    Some((there.there - place.there).dot(&place.epipolar) / STEP)
                };
                let by_pose = (0..6).map(|k| {
                    let tangent = Vector6::ith(k, STEP);
                    let by = derivative(&|r| r.pose = perturb(&r.pose, &tangent));
                    (by, by_shared[k])
                });
                let by_turn = (0..4).map(|k| {
                    let by = derivative(&|r| r.turns[k / 2][k % 2] = STEP);
                    (by, place.epipolar.dot(&place.by_turn[k / 2].column(k % 2)))
                });
                let by_size = (derivative(&|r| r.form.x = STEP), by_shared[FORM_AT]);
                for (k, (by, told)) in by_pose.chain(by_turn).chain([by_size]).enumerate() {
                    let Some(by) = by else { continue };
                    let close = (by - told).abs() < 0.01 * told.abs() + 0.5;
                    assert!(close, "unknown {k} at ({x}, {y}): {by:.2}, told {told:.2}, {body}");
                    checked[usize::from(on_ground)] += 1;
                }
            }
            assert!(checked.iter().all(|&n| n > 100), "{checked:?} of {body}");
        });
    }
}

#[test]
fn cameras_that_are_turned_shift_print_as_the_derivatives_say() {
    // Up to a fifth of a pixel, along and across the epipolar line.
    let turns = [Vector2::new(3e-4, -2e-4), Vector2::new(-2e-4, 3e-4)];
    for body in BODIES {
        with_all(body, PRINTED, turns, |search| {
            let patches = seen(search, &Vector6::zeros());
            let predicted = |p: &Patch| {
                p.by_turn.iter().zip(&turns).map(|(by, turn)| (by * turn).x).sum::<f64>()
            };
            let left = mean(&patches, |p| (p.residual - predicted(p)).abs());
            let moved = mean(&patches, |p| predicted(p).abs());
            assert!(moved > 0.1 && left < 0.25 * moved, "{left:.3} of {moved:.3} px, {body}");
        });
    }
}

#[test]
fn what_is_far_off_and_what_is_little_says_nothing() {
    let patch = Patch {
        pixel: Point2::origin(),
        part: 0,
        residual: 0.0,
        noise_px: 0.1,
        worth: ON_OBJECT.worth,
        by_surface: 100.0,
        by_shared: ByShared::zeros(),
        by_slope: Default::default(),
        by_turn: Default::default(),
    };
    let squares = |n: usize, residual: f64| vec![Patch { residual, ..patch.clone() }; n];
    assert_eq!(evidence(&[]), 0.0);
    assert_eq!(evidence(&squares(4, 1.5)), 0.0);
    assert!(evidence(&squares(40, 0.0)) > evidence(&squares(10, 0.0)));
    assert!(evidence(&squares(40, 0.0)) > evidence(&squares(40, 0.3)));
    // A second surface that is right adds to the first.
    let mut two = squares(10, 0.0);
    two.extend(squares(10, 0.0).into_iter().map(|p| Patch { part: 1, ..p }));
    assert!((evidence(&two) - 2.0 * evidence(&squares(10, 0.0))).abs() < 1e-9);
}

/// A small picture's level, and the pixel of it that shows the picture's middle.
fn level(grey: impl Fn(f64, f64) -> f64) -> (Level, (usize, usize)) {
    let image = Image::from_fn(64, 64, |x, y| grey(x as f64, y as f64).round() as u8);
    let region = Region::around(&[Point2::new(32.0, 32.0)], 24.0, 64, 64).unwrap();
    let level = Reduced::new(&image, &region, 1).smoothed(0.35);
    let (x, y) = level.from_picture(32.0, 32.0);
    (level, (x.round() as usize, y.round() as usize))
}

#[test]
fn a_lamp_that_lights_one_view_from_the_side_does_not_move_print() {
    const NEEDS: Needs = ON_OBJECT.needs;
    let print = |x: f64, y: f64| 110.0 + 25.0 * (x / 1.9).sin() * (y / 2.3 + 0.5).cos();
    let (first, middle) = level(print);
    let here = square::print_at::<8, 7>(&first, middle.0, middle.1, &NEEDS).unwrap();
    for shift in [-0.4, 0.0, 0.3] {
        let moved = |x: f64, y: f64| print(x - shift, y);
        let (second, there) = level(|x, y| 0.8 * moved(x, y) + 2.0 * (x - 32.0) - 1.5 * (y - 32.0));
        let place = Place {
            middle,
            there: Vector2::new(there.0 as f64, there.1 as f64),
            affine: Matrix2::identity(),
            bend: Default::default(),
            epipolar: Vector2::x(),
            by_turn: Default::default(),
        };
        let found = square::find(&here, &first, &second, &place, &NEEDS).unwrap();
        assert!((found.shift - shift).abs() < 0.05, "{:.3}, it is {shift}", found.shift);
    }
}

#[test]
fn a_table_below_a_plain_object_is_where_the_true_pose_puts_it() {
    for body in BODIES {
        with_all(body, PLAIN, Default::default(), |search| {
            let patches = seen(search, &Vector6::zeros());
            let on_object = patches.iter().filter(|p| !p.on_ground()).count();
            assert!(
                patches.len() > 50 && on_object == 0,
                "{on_object} of {}, {body}",
                patches.len()
            );
            let off = mean(&patches, |p| p.residual);
            assert!(off.abs() < 0.02, "{off:.3} px, {} squares of {body}", patches.len());
        });
    }
}

#[test]
fn large_squares_see_grain_that_noise_hides_from_small_ones() {
    let faint = Scene { grain: 5.0, noise: 3.0, ..PLAIN };
    let bare = Scene { grain: 0.0, ..faint };
    let ground = |body, scene, sampling: usize, up: f64| {
        let mut squares = Vec::new();
        let raised = perturb(&pose(), &Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, up));
        with_all(body, scene, Default::default(), |search| {
            let refined = Refined::new(&raised, false);
            squares = search.ground(&refined, &ON_GROUND[sampling], ENOUGH);
        });
        squares
    };
    // Beside the box there is too little of the table.
    for body in &BODIES[1..] {
        assert!(ground(body, faint, 0, 0.0).is_empty(), "{body}");
        assert!(ground(body, bare, 1, 0.0).is_empty(), "{body}");
        let [low, high] = [0.0, 0.003].map(|up| {
            let squares = ground(body, faint, 1, up);
            assert!(squares.len() >= 24, "{} squares of {body}", squares.len());
            mean(&squares, |p| p.residual / p.by_surface)
        });
        // A hundredth of a pixel is a tenth of a millimetre here, and noise moves the mean by some.
        assert!(low.abs() < 0.0007, "{low:.5} m, {body}");
        assert!((low - high - 0.003).abs() < 0.0005, "{low:.5} {high:.5} m, {body}");
    }
}

#[test]
fn how_high_the_table_is_says_how_far_away_a_plain_object_is() {
    for body in BODIES {
        with_all(body, PLAIN, Default::default(), |search| {
            // Along the line of sight, as edges hardly notice: further away and lower.
            let sight = pose().translation.vector - Vector3::new(0.0, 0.0, 0.3);
            let off = sight.normalize() * 0.004;
            let mut refined = Refined::new(
                &perturb(&pose(), &Vector6::new(0.0, 0.0, 0.0, off.x, off.y, off.z)),
                false,
            );
            let height = |r: &Refined| r.pose.translation.vector.z - pose().translation.vector.z;
            let before = height(&refined);
            for _ in 0..3 {
                refined.patches = search.ground(&refined, &ON_GROUND[0], ENOUGH);
                let mut moved = Move::default();
                (0..STEPS).for_each(|_| search.advance(&mut refined, &[], 0.2, &mut moved));
                refined.apply(&moved);
            }
            let after = height(&refined);
            assert!(after.abs() < 0.35 * before.abs(), "{before:.5} {after:.5} m, {body}");
        });
    }
}

#[test]
fn an_object_that_stands_on_something_else_is_not_drawn_to_the_table() {
    // What edges leave: half a millimetre upwards.
    let edges = Matrix6::identity() * 2.5e-7;
    for (gap, rests) in [(0.0, true), (0.0003, true), (0.005, false), (0.1, false)] {
        let scene = Scene { table: Some(gap), ..PLAIN };
        for body in BODIES {
            with_all(body, scene, Default::default(), |search| {
                let patches = seen(search, &Vector6::zeros());
                let belief = contact(&patches, &edges);
                assert!(if rests { belief > 0.95 } else { belief < 0.05 }, "{belief} of {gap} m");
            });
        }
    }
}

#[test]
fn a_pose_that_rests_elsewhere_loses_evidence_against_one_that_does_not() {
    with_all(BODIES[0], PLAIN, Default::default(), |search| {
        let at = |up: f64| seen(search, &Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, up));
        let poses = [at(0.03), at(0.0), at(-0.003), Vec::new()];
        let told = supported(&poses);
        assert!(told[1] == 0.0 || told[1] > -0.5, "{told:?}");
        assert!([0, 2, 3].iter().all(|&k| told[k] < told[1] - 2.0), "{told:?}");
        // Where none has any, it is not known where the ground is.
        assert_eq!(supported(&[Vec::new(), Vec::new()]), [0.0, 0.0]);
    });
}
