//! `vergence calibrate` in a workcell whose heads are not as described, and what it is good for.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

/// The embedded workcell with heads that differ from their URDF, and 12-bit servos.
fn perturbed(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("vergence-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let mut config = vergence_sim::EMBEDDED_CONFIG.to_owned();
    for (key, before, after) in [
        ("joint_zero_deg", "0.0", "1.0"),
        ("axis_skew_deg", "0.0", "0.5"),
        ("lever_arm", "0.0", "0.004"),
        ("focal_ratio", "0.0", "0.03"),
        ("resolution_deg", "0.35", "0.088"),
    ] {
        let (from, to) = (format!("{key} = {before} "), format!("{key} = {after} "));
        assert!(config.contains(&from), "the embedded workcell has {from}");
        config = config.replace(&from, &to);
    }
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
    assert!(!folder.join("taken.toml").exists());
    assert_eq!(std::fs::read_to_string(folder.join("kept.toml")).unwrap(), "kept");
    std::fs::remove_dir_all(&folder).unwrap();
}
