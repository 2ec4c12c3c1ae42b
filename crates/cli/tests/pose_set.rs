//! `vergence pose SET` and `vergence evaluate pose --set SET` on a set as others write it.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::{Value, json};
use vergence_geometry::Transform;
use vergence_sim::{Scenario, StereoScene, stereo_scene};

fn vergence(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vergence")).args(args).output().unwrap()
}

/// Rotation by rows, translation in millimetres.
fn rigid(pose: &Transform) -> (Vec<f64>, Vec<f64>) {
    let rotation = pose.rotation.to_rotation_matrix();
    let rows = rotation.matrix().transpose().as_slice().to_vec();
    (rows, pose.translation.vector.iter().map(|v| 1e3 * v).collect())
}

fn write(path: &Path, value: &Value) {
    std::fs::write(path, value.to_string()).unwrap();
}

/// Two simulated scenes in the layout of docs/pose.md.
fn set(name: &str) -> (PathBuf, [StereoScene; 2]) {
    let set = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&set);
    let scenes = [1000, 1001].map(|seed| stereo_scene(Scenario::Default, seed).unwrap());
    for (k, scene) in scenes.iter().enumerate() {
        let folder = set.join("test").join(format!("{k:06}"));
        for (view, side) in ["left", "right"].into_iter().enumerate() {
            std::fs::create_dir_all(folder.join(format!("gray_{side}"))).unwrap();
            let picture = folder.join(format!("gray_{side}/000000.png"));
            vergence_imaging::codec::write_png(&picture, &scene.images[view]).unwrap();
            let camera = scene.cameras[view];
            let optical_from_base = scene.base_from_optical[view].inverse();
            let (rotation, translation) = rigid(&optical_from_base);
            let d = camera.distortion;
            let entry = json!({
                "cam_K": [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0],
                "cam_R_w2c": rotation, "cam_t_w2c": translation, "pan": 0.0,
                "cam_dist": [d.k1, d.k2, d.p1, d.p2, d.k3],
            });
            write(&folder.join(format!("scene_camera_{side}.json")), &json!({"0": entry}));
            let (rotation, translation) = rigid(&(optical_from_base * scene.base_from_object));
            let truth = json!({"obj_id": 1, "cam_R_m2c": rotation, "cam_t_m2c": translation});
            write(&folder.join(format!("scene_gt_{side}.json")), &json!({"0": [truth]}));
        }
        let landmark = &scene.landmark;
        let mm = |v: &f64| 1e3 * v;
        let tag = json!({
            "obj_id": 1, "tag": scene.record,
            "landmark_w": landmark.position.iter().map(mm).collect::<Vec<_>>(),
            "landmark_cov_w": landmark.covariance.iter().map(|v| 1e6 * v).collect::<Vec<_>>(),
        });
        write(&folder.join("scene_tags.json"), &json!({"0": [tag]}));
    }
    (set, scenes)
}

#[test]
fn a_set_is_recognised_into_the_left_camera_s_frame() {
    let (set, scenes) = set("pose-set");
    let out = set.join("results.csv");
    let output = vergence(&["pose", set.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let table = std::fs::read_to_string(out).unwrap();
    let mut rows = table.lines();
    assert_eq!(rows.next(), Some("scene_id,im_id,obj_id,score,R,t,time"));
    for (row, scene) in rows.by_ref().zip(&scenes) {
        let fields: Vec<&str> = row.split(',').collect();
        let found: Vec<f64> = fields[5].split(' ').map(|v| v.parse().unwrap()).collect();
        let (_, truth) = rigid(&(scene.base_from_optical[0].inverse() * scene.base_from_object));
        let squares: f64 = found.iter().zip(truth).map(|(f, t)| (f - t).powi(2)).sum();
        assert!(squares.sqrt() < 5.0, "{row}");
    }
    assert_eq!(rows.next(), None);
}

#[test]
fn a_set_is_compared_with_its_truth() {
    let (set, _) = set("pose-set-truth");
    let evaluate = |more: &[&str]| {
        vergence(&[&["evaluate", "pose", "--set", set.to_str().unwrap()], more].concat())
    };
    let output = evaluate(&["--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(figures["scenes"], 2, "{figures}");
    assert_eq!(figures["within_5mm_5deg"], 1.0, "{figures}");
    assert_eq!(figures["ellipsoid_95_coverage"], 1.0, "{figures}");
    assert!(figures["wrong_scenes"].as_array().unwrap().is_empty(), "{figures}");

    // A truth that is elsewhere is noticed, one that is no pose or is missing refused.
    let truth = set.join("test/000001/scene_gt_left.json");
    let mut moved: Value = serde_json::from_slice(&std::fs::read(&truth).unwrap()).unwrap();
    let x = &mut moved["0"][0]["cam_t_m2c"][0];
    *x = json!(x.as_f64().unwrap() + 20.0);
    write(&truth, &moved);
    let figures: Value = serde_json::from_slice(&evaluate(&["--json"]).stdout).unwrap();
    assert_eq!(figures["wrong_scenes"], json!([1]), "{figures}");
    moved["0"][0]["cam_R_m2c"][0] = json!(7.0);
    write(&truth, &moved);
    for _ in 0..2 {
        let output = evaluate(&[]);
        assert_eq!(output.status.code(), Some(2));
        assert!(String::from_utf8_lossy(&output.stderr).contains("scene_gt_left.json"));
        let _ = std::fs::remove_file(&truth);
    }
    assert_eq!(evaluate(&["--seed", "3"]).status.code(), Some(2));
}
