//! The simulated devices through the traits alone, and their agreement with the geometry.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use nalgebra::{Point2, Point3};
use vergence_devices::{DeviceError, Head, LedCommand, Robot, Side, TagAddress};
use vergence_geometry::Transform;
use vergence_imaging::{Frame, Image};
use vergence_sim::{Scenario, SimConfig, Truth, Workcell, embedded_files, settings};
use vergence_tag::{Pattern, cbor, pattern::Bits};

const SECOND: Duration = Duration::from_secs(1);

fn cell(change: impl Fn(&mut SimConfig), seed: u64) -> Workcell {
    let (config, description) = embedded_files().unwrap();
    let mut sim = settings(&config).unwrap();
    change(&mut sim);
    Workcell::new(config, description, sim, seed).unwrap()
}

/// Turns both cameras to a point, as well as the servos can.
fn aim(cell: &Workcell, robot: &mut Robot, point: &Point3<f64>) {
    for (k, head) in robot.heads.iter_mut().enumerate() {
        let wiring = cell.config().head(Side::BOTH[k]);
        let chain = cell.description().chain("base", &wiring.optical_frame).unwrap();
        let mut angles = [0.0, 0.0];
        for _ in 0..20 {
            let p = chain.forward(&angles).inverse_transform_point(point);
            angles[0] -= p.x.atan2(p.z);
            angles[1] += p.y.atan2(p.z);
        }
        head.pan_tilt.move_to(angles[0], angles[1]).unwrap();
    }
    robot.clock.sleep(2 * SECOND);
}

fn next(head: &mut Head) -> Frame {
    head.camera.next_frame(SECOND).unwrap()
}

fn address(robot: &mut Robot, id: &str) -> TagAddress {
    let heard = robot.radio.scan(3 * SECOND).unwrap();
    heard.iter().find(|a| a.object_id == id).unwrap().address
}

fn slow_flicker() -> Pattern {
    Pattern::new(Bits::FLICKER, Duration::from_millis(500)).unwrap()
}

/// Mean picture with the light on less that with the light off, told apart at the target's pixel.
fn on_minus_off(head: &mut Head, near: Point2<f64>) -> Image<f32> {
    let (x, y) = (near.x.round() as usize, near.y.round() as usize);
    let frames: Vec<_> = (0..60).map(|_| next(head).image).collect();
    let levels: Vec<u8> = frames.iter().map(|image| image.get(x, y).unwrap()).collect();
    let (low, high) = (levels.iter().min().unwrap(), levels.iter().max().unwrap());
    let middle = low / 2 + high / 2;
    let on = levels.iter().filter(|l| **l > middle).count() as f32;
    let mut sum = Image::filled(frames[0].width(), frames[0].height(), 0.0f32);
    for (frame, level) in frames.iter().zip(&levels) {
        let weight = if *level > middle { 1.0 / on } else { -1.0 / (60.0 - on) };
        for (s, p) in sum.data_mut().iter_mut().zip(frame.data()) {
            *s += weight * f32::from(*p);
        }
    }
    sum
}

fn centroid(image: &Image<f32>, near: Point2<f64>, radius: i64) -> Point2<f64> {
    let (cx, cy) = (near.x.round() as i64, near.y.round() as i64);
    let (mut sum, mut u, mut v) = (0.0, 0.0, 0.0);
    for y in cy - radius..=cy + radius {
        for x in cx - radius..=cx + radius {
            let value = f64::from(image.get(x as usize, y as usize).unwrap());
            (sum, u, v) = (sum + value, u + value * x as f64, v + value * y as f64);
        }
    }
    Point2::new(u / sum, v / sum)
}

fn landmark_of(truth: &Truth, id: &str) -> Point3<f64> {
    truth.objects.iter().find(|o| o.id == id).unwrap().landmarks[0]
}

/// Where a camera sees a point, by the geometry.
fn pixel_of(cell: &Workcell, side: usize, point: &Point3<f64>) -> Point2<f64> {
    let camera = cell.truth().cameras[side];
    let p = camera.base_from_optical.inverse_transform_point(point);
    camera.lens.project(&p).unwrap()
}

#[test]
fn the_light_is_where_the_geometry_projects_it() {
    // Without gamma, saturation and noise the centroid is exact; other lights must stand still.
    let cell = cell(
        |sim| {
            sim.camera.gamma = 1.0;
            sim.camera.full_well = 1e7;
            sim.camera.read_noise = 0.0;
            sim.led.flux_px = 0.6;
            sim.light.lamp_depth = 0.0;
            sim.light.screen = false;
            sim.clutter = 0;
        },
        5,
    );
    let mut robot = cell.robot();
    for id in ["box", "cup", "can"] {
        let landmark = landmark_of(&cell.truth(), id);
        aim(&cell, &mut robot, &landmark);
        let tag = address(&mut robot, id);
        let state = robot.radio.command(tag, LedCommand::Play(slow_flicker()), SECOND).unwrap();
        assert!(state.playing);
        for k in 0..2 {
            let expected = pixel_of(&cell, k, &landmark);
            let seen = centroid(&on_minus_off(&mut robot.heads[k], expected), expected, 3);
            let error = (seen - expected).norm();
            assert!(error < 0.05, "{id} {k}: {error:.3} px, {seen} for {expected}");
        }
        robot.radio.command(tag, LedCommand::Stop, SECOND).unwrap();
    }
}

#[test]
fn equal_seeds_give_equal_bytes() {
    let run = |seed: u64| {
        let cell = Workcell::embedded(seed).unwrap();
        let mut robot = cell.robot();
        let heard = robot.radio.scan(3 * SECOND).unwrap();
        let record = robot.radio.read_record(heard[0].address, 5 * SECOND).unwrap();
        let landmark = cell.truth().objects[0].landmarks[0];
        aim(&cell, &mut robot, &landmark);
        let frames = [0, 1].map(|k| next(&mut robot.heads[k]));
        (heard, record, frames, robot.clock.now())
    };
    assert!(run(3) == run(3), "a run repeats bit for bit");
    let (a, b) = (run(3), run(4));
    assert!(a.2[0].image != b.2[0].image && a.0 != b.0, "another seed is another world");
}

#[test]
fn both_cameras_expose_together_and_late_readers_lose_frames() {
    let cell = Workcell::embedded(1).unwrap();
    let mut robot = cell.robot();
    let (left, right) = (next(&mut robot.heads[0]), next(&mut robot.heads[1]));
    assert_eq!((left.stamp, left.sequence), (right.stamp, right.sequence));
    let now = robot.clock.now();
    assert!(now >= left.stamp + left.exposure, "a frame is there when its exposure is over");
    assert_eq!(next(&mut robot.heads[0]).sequence, left.sequence + 1);
    robot.clock.sleep(SECOND);
    let late = next(&mut robot.heads[0]);
    let lost = late.sequence - left.sequence - 2;
    assert!((25..30).contains(&lost), "{lost} frames lost in a second");
    assert_eq!(next(&mut robot.heads[0]).sequence, late.sequence + 1, "two frames were kept");
    let now = robot.clock.now();
    let nothing = robot.heads[0].camera.next_frame(Duration::from_millis(1));
    assert!(matches!(nothing, Err(DeviceError::Timeout { .. })));
    assert_eq!(robot.clock.now(), now + Duration::from_millis(1));
}

#[test]
fn heads_obey_their_limits() {
    let cell = Workcell::embedded(1).unwrap();
    let mut robot = cell.robot();
    let head = &mut robot.heads[0].pan_tilt;
    assert!(matches!(head.move_to(3.0, 0.0), Err(DeviceError::Unsupported { .. })));
    assert!(matches!(head.move_to(f64::NAN, 0.0), Err(DeviceError::Unsupported { .. })));
    head.move_to(1.0, 0.2).unwrap();
    let mut last = head.read().unwrap();
    assert!(last.moving);
    while last.moving {
        let reading = head.read().unwrap();
        let (turn, time) = (reading.pan - last.pan, (reading.stamp - last.stamp).as_secs_f64());
        // Readings jump by whole steps.
        assert!(turn <= 3.6 * time + head.resolution() + 1e-9, "{turn} rad in {time} s");
        last = reading;
    }
    assert!((last.pan - 1.0).abs() <= 0.5 * head.resolution() + 1e-9);
}

#[test]
fn the_radio_has_a_reach_and_keeps_records() {
    let far = cell(|sim| sim.radio.range = 0.01, 1);
    assert!(far.robot().radio.scan(SECOND).unwrap().is_empty());

    let near = cell(|sim| sim.radio.loss = 0.4, 1);
    let mut robot = near.robot();
    for advertisement in robot.radio.scan(3 * SECOND).unwrap() {
        let before = robot.clock.now();
        let bytes = robot.radio.read_record(advertisement.address, 10 * SECOND).unwrap();
        let record = cbor::decode(&bytes).unwrap();
        assert_eq!(record.object_id.as_str(), advertisement.object_id);
        assert!(bytes.len() <= 512, "{} bytes", bytes.len());
        assert!(
            robot.clock.now() > before + Duration::from_millis(50),
            "connection events take time"
        );
    }
    let before = robot.clock.now();
    let nobody = robot.radio.read_record(TagAddress([1; 6]), 2 * SECOND);
    assert!(matches!(nobody, Err(DeviceError::Timeout { .. })));
    assert_eq!(robot.clock.now(), before + 2 * SECOND);
    let tag = address(&mut robot, "can");
    let wrong = Pattern { landmark: 3, ..slow_flicker() };
    let refused = robot.radio.command(tag, LedCommand::Play(wrong), SECOND);
    assert!(matches!(refused, Err(DeviceError::Fault { .. })));
}

#[test]
fn objects_stand_free_and_out_of_the_first_pictures() {
    for seed in 0..12 {
        for scenario in [Scenario::Default, Scenario::Occluded] {
            let truth = Workcell::embedded_as(scenario, seed).unwrap().truth();
            assert_eq!(truth.objects.len(), 3);
            for (k, object) in truth.objects.iter().enumerate() {
                let p = object.base_from_object.translation.vector;
                assert!((0.3..1.3).contains(&p.xy().norm()), "seed {seed}: {p}");
                for other in &truth.objects[..k] {
                    let gap = (other.base_from_object.translation.vector - p).xy().norm();
                    assert!(gap > 0.07, "seed {seed}: {} and {}", object.id, other.id);
                }
                for camera in &truth.cameras {
                    let seen = camera.base_from_optical.inverse_transform_point(&p.into());
                    let pixel = camera.lens.project(&seen);
                    let inside = pixel.is_some_and(|pixel| camera.lens.contains(&pixel, 0.0));
                    assert!(!inside, "seed {seed}: {} is in view at rest", object.id);
                }
            }
        }
    }
}

#[test]
fn the_landmark_is_seen_behind_the_occluder() {
    for scenario in [Scenario::Default, Scenario::Occluded] {
        for seed in [1, 2] {
            let cell = Workcell::embedded_as(scenario, seed).unwrap();
            let mut robot = cell.robot();
            let landmark = landmark_of(&cell.truth(), "cup");
            aim(&cell, &mut robot, &landmark);
            let tag = address(&mut robot, "cup");
            robot.radio.command(tag, LedCommand::Play(slow_flicker()), SECOND).unwrap();
            for k in 0..2 {
                let pixel = pixel_of(&cell, k, &landmark);
                let difference = on_minus_off(&mut robot.heads[k], pixel);
                let peak = difference.sample(pixel.x as f32, pixel.y as f32);
                assert!(peak > 20.0, "{scenario:?} {seed} {k}: {peak}");
            }
        }
    }
}

#[test]
fn geometry_errors_move_the_true_cameras_only() {
    let exact = cell(|_| (), 1);
    let off = cell(
        |sim| {
            sim.geometry_error.joint_zero_deg = 0.5;
            sim.geometry_error.lever_arm = 0.002;
            sim.geometry_error.focal_ratio = 0.01;
        },
        1,
    );
    assert_eq!(exact.config(), off.config());
    let nominal = |cell: &Workcell| -> Transform {
        let frame = &cell.config().left.optical_frame;
        cell.description().chain("base", frame).unwrap().forward(&[0.0, 0.0])
    };
    let [a, b] = [&exact, &off].map(|cell| cell.truth().cameras[0]);
    assert!((a.base_from_optical.inverse() * nominal(&exact)).rotation.angle() < 1e-9);
    let error = b.base_from_optical.inverse() * nominal(&off);
    assert!((1e-4..0.05).contains(&error.rotation.angle()));
    assert!((1e-4..0.01).contains(&error.translation.vector.norm()));
    assert!(a.lens.fx == 300.0 && b.lens.fx != 300.0);
}
