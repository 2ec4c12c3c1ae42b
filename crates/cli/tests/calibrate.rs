//! `vergence calibrate` in a workcell whose heads are not as described, and what it is good for.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::Command;

use nalgebra::{Matrix3, Vector3};
use serde_json::Value;

/// Squared deviations that 95 % of points in space are within.
const CHI2_95: f64 = 7.815;
/// Between the heads of the embedded workcell (m).
const BASELINE: f64 = 0.2;

/// The embedded workcell's configuration with other values of some keys, wherever they stand.
fn embedded_with(changes: &[(&str, &str, &str)]) -> String {
    let mut config = vergence_sim::EMBEDDED_CONFIG.to_owned();
    for (key, before, after) in changes {
        let (from, to) = (format!("{key} = {before} "), format!("{key} = {after} "));
        assert!(config.contains(&from), "the embedded workcell has {from}");
        config = config.replace(&from, &to);
    }
    config
}

/// The embedded workcell with heads that differ from their URDF, and 12-bit servos.
fn perturbed(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("vergence-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let config = embedded_with(&[
        ("joint_zero_deg", "0.0", "1.0"),
        ("axis_skew_deg", "0.0", "0.5"),
        ("lever_arm", "0.0", "0.004"),
        ("focal_ratio", "0.0", "0.03"),
        ("resolution_deg", "0.35", "0.088"),
    ]);
    std::fs::write(folder.join("robot.toml"), config).unwrap();
    std::fs::write(folder.join("workcell.urdf"), vergence_sim::EMBEDDED_URDF).unwrap();
    folder
}

/// Runs the program; its exit status and its JSON.
fn vergence(folder: &Path, arguments: &[&str]) -> (Option<i32>, Value) {
    let output = Command::new(env!("CARGO_BIN_EXE_vergence"))
        .args(arguments)
        .arg("--json")
        .current_dir(folder)
        .output()
        .unwrap();
    let told = serde_json::from_slice(&output.stdout);
    let told = told.unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    (output.status.code(), told)
}

/// Distance (m) of the landmark that a find reports from the true one.
fn landmark_error(folder: &Path, config: &str) -> f64 {
    let (_, report) = vergence(folder, &["find", "cup", "--config", config]);
    let numbers = |value: &Value| [0, 1, 2].map(|k| value[k].as_f64().unwrap());
    let found = numbers(&report["landmark"]["position"]);
    let truth = numbers(&report["truth"]["landmark"]);
    found.iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

#[test]
fn a_calibrated_head_finds_what_the_described_one_misses() {
    let folder = perturbed("calibrated");
    let before = landmark_error(&folder, "robot.toml");
    let arguments = ["calibrate", "--config", "robot.toml", "--out", "better.toml", "--measured"];
    let few = ["--places", "6", "--views", "8"];
    let (status, told) = vergence(&folder, &[&arguments[..], &few[..]].concat());
    assert_eq!((status, told["calibrated"].as_bool()), (Some(0), Some(true)), "{told}");
    let predicted = told["figures"]["distance_95"][1]["error"].as_f64().unwrap();
    assert!(predicted < 0.012, "{told}");
    let after = landmark_error(&folder, "better.toml");
    assert!(before > 0.03 && after < 0.008, "{before} m before, {after} m after");
    // What the calibration leaves unknown, finds are told: as zeros that are off by so much.
    let better: toml::Table =
        std::fs::read_to_string(folder.join("better.toml")).unwrap().parse().unwrap();
    let zero_sd = ["left", "right"].map(|side| better[side]["zero_sd_deg"].as_float().unwrap());
    let by_zeros = 1.96 * std::f64::consts::SQRT_2 * zero_sd[0].to_radians() / BASELINE;
    assert!((0.5..2.0).contains(&(by_zeros / predicted)), "{zero_sd:?} for {predicted} m");
    std::fs::remove_dir_all(&folder).unwrap();
}

/// Position (m) that a find reports, its covariance, and the true position.
fn found(report: &Value) -> (Vector3<f64>, Matrix3<f64>, Vector3<f64>) {
    let number = |value: &Value| value.as_f64().unwrap();
    let position = |value: &Value| Vector3::from_fn(|k, _| number(&value["position"][k]));
    let covariance = &report["pose"]["covariance"];
    let block = Matrix3::from_fn(|i, j| number(&covariance[6 * (i + 3) + j + 3]));
    (position(&report["pose"]), block, position(&report["truth"]))
}

#[test]
fn heads_that_say_how_far_their_zeros_may_be_off_are_trusted_no_further() {
    let folder = perturbed("zeros");
    let off = ("joint_zero_deg", "0.0", "0.3");
    let config = embedded_with(&[off]);
    let told = embedded_with(&[off, ("zero_sd_deg", "0.0", "0.3")]);
    let (mut held, mut sums, mut runs) = ([0, 0], [0.0, 0.0], 0);
    for seed in ["1", "2", "4"] {
        for object in ["box", "cup", "can"] {
            let reports = [&config, &told].map(|text| {
                std::fs::write(folder.join("zeros.toml"), text).unwrap();
                vergence(&folder, &["find", object, "--config", "zeros.toml", "--seed", seed]).1
            });
            if !reports.iter().all(|r| r["found"].as_bool().unwrap()) {
                continue;
            }
            runs += 1;
            for (k, report) in reports.iter().enumerate() {
                let (position, covariance, truth) = found(report);
                let error = position - truth;
                let squared = error.dot(&(covariance.try_inverse().unwrap() * error));
                held[k] += usize::from(squared < CHI2_95);
                sums[k] += error.norm();
            }
        }
    }
    // The angles alone put objects a centimetre or two too near or too far and are sure of it.
    assert!(runs >= 7 && held[0] <= runs / 4 && held[1] + 1 >= runs, "{held:?} of {runs}");
    assert!(sums[1] < 0.6 * sums[0], "{sums:?} m in {runs} runs");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn deviations_of_zeros_that_cannot_be_are_refused() {
    let folder = perturbed("zeros-refused");
    for bad in ["-0.1", "nan", "inf", "30.0"] {
        let config = embedded_with(&[("zero_sd_deg", "0.0", bad)]);
        std::fs::write(folder.join("bad.toml"), config).unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_vergence"))
            .args(["find", "cup", "--config", "bad.toml"])
            .current_dir(&folder)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(
            !output.status.success() && said.contains("left head: zero_sd_deg"),
            "{bad}: {said}"
        );
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn too_little_is_refused_with_what_is_missing() {
    let folder = perturbed("refused");
    let arguments = ["calibrate", "--config", "robot.toml", "--out", "better.toml"];
    let few = ["--places", "2", "--views", "6"];
    let (status, told) = vergence(&folder, &[&arguments[..], &few[..]].concat());
    assert_eq!(status, Some(1), "{told}");
    let reason = told["reason"].as_str().unwrap();
    assert!(reason.contains("24 are needed"), "{reason}");
    assert!(!folder.join("better.toml").exists());
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn what_was_read_is_not_written_over() {
    let folder = perturbed("calibrate-over");
    let read = || ["robot.toml", "workcell.urdf"].map(|f| std::fs::read(folder.join(f)).unwrap());
    let before = read();
    for out in ["robot.toml", "./workcell.toml", "new.urdf"] {
        let arguments = ["calibrate", "--config", "robot.toml", "--out", out];
        let output = Command::new(env!("CARGO_BIN_EXE_vergence"))
            .args(arguments)
            .current_dir(&folder)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{out}: {said}");
    }
    assert!(read() == before);
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn what_cannot_be_written_is_refused_before_the_measurement() {
    let folder = perturbed("calibrate-unwritable");
    // The configuration could be written, the URDF beside it not.
    std::fs::create_dir(folder.join("taken.urdf")).unwrap();
    std::fs::write(folder.join("kept.toml"), "kept").unwrap();
    std::fs::create_dir(folder.join("kept.urdf")).unwrap();
    for out in ["nowhere/better.toml", "taken.toml", "kept.toml"] {
        // No such tag: a measurement that begins fails with other words.
        let arguments = ["--config", "robot.toml", "--object", "nobody", "--out", out];
        let (status, told) = vergence(&folder, &[&["calibrate"][..], &arguments].concat());
        assert_eq!((status, told["calibrated"].as_bool()), (Some(1), Some(false)), "{told}");
        let reason = told["reason"].as_str().unwrap();
        assert!(reason.contains("cannot write"), "{out}: {reason}");
    }
    // There is no joint in which to write how a camera is mounted.
    let bare = vergence_sim::EMBEDDED_CONFIG.replace("\"left_optical_frame\"", "\"left_tilt\"");
    std::fs::write(folder.join("bare.toml"), bare).unwrap();
    let arguments = ["--config", "bare.toml", "--object", "nobody", "--out", "better.toml"];
    let (status, told) = vergence(&folder, &[&["calibrate"][..], &arguments].concat());
    let reason = told["reason"].as_str().unwrap();
    assert!(status == Some(1) && reason.contains("no fixed joint"), "{reason}");
    assert!(!folder.join("taken.toml").exists());
    assert_eq!(std::fs::read_to_string(folder.join("kept.toml")).unwrap(), "kept");
    std::fs::remove_dir_all(&folder).unwrap();
}
