//! `vergence grasp` as outsiders script against it: the contract, a grasp from start to end, and
//! refusals by name.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn vergence(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vergence")).args(args).output().unwrap()
}

/// A workcell of this test's own; `cup` changes what is written of the cup.
fn workcell(name: &str, cup: impl Fn(&str) -> String) -> PathBuf {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&dir);
    assert!(vergence(&["workcell", dir.to_str().unwrap()]).status.success());
    let path = dir.join("workcell.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let text = text.replace("scenario = \"default\"", "scenario = \"reach\"");
    let (before, after) = text.split_once("object_id = \"cup\"").unwrap();
    std::fs::write(&path, format!("{before}object_id = \"cup\"{}", cup(after))).unwrap();
    path
}

fn grasp(config: &Path, more: &[&str]) -> (Option<i32>, Value) {
    let config = config.to_str().unwrap();
    let args = [&["grasp", "cup", "--config", config, "--json"], more].concat();
    let output = vergence(&args);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let report = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {said}"));
    (output.status.code(), report)
}

#[test]
fn a_cup_is_found_grasped_and_lifted() {
    let path = workcell("grasp", |cup| cup.into());
    let save = path.with_file_name("saved");
    let (status, report) = grasp(&path, &["--save", save.to_str().unwrap()]);
    assert_eq!(status, Some(0), "{report}");
    for name in ["1-edges", "2-field", "3-best", "5-residuals"] {
        let picture = save.join(format!("directional-view1-{name}.png"));
        vergence_imaging::codec::read(&picture).unwrap();
    }
    let grasp = &report["grasp"];
    assert_eq!(grasp["succeeded"], true, "{grasp}");
    assert_eq!(grasp["verified"], true, "the heads saw the landmark rise: {grasp}");
    assert_eq!(grasp["approach"], "rim", "nobody tells whether the cup has a handle");
    assert!(grasp["margin"].as_f64().unwrap() >= 1.0, "{grasp}");
    assert!(grasp["width"].as_f64().unwrap() > 0.0 && grasp["force"].as_f64().unwrap() > 0.0);
    assert_eq!(grasp["physics"]["lifted"], true, "the robot's word is true: {grasp}");
    assert!(grasp["physics"]["collision"].is_null(), "{grasp}");
    let steps: Vec<&str> = report["timeline"]
        .as_array()
        .unwrap()
        .iter()
        .map(|s| s["step"].as_str().unwrap())
        .collect();
    let order = [
        "recognise",
        "plan",
        "transfer",
        "look again",
        "correct",
        "approach",
        "close",
        "lift",
        "verify",
    ];
    let places: Vec<usize> =
        order.iter().map(|step| steps.iter().position(|s| s == step).unwrap()).collect();
    assert!(places.is_sorted(), "{steps:?}");
    for name in ["stages.png", "7-pregrasp-left.png", "7-closed-right.png", "7-lifted-left.png"] {
        vergence_imaging::codec::read(&save.join(name)).unwrap();
    }
    let reader = vergence_ros::recording::Reader::open(&save.join("recording.mcap")).unwrap();
    let trajectories = reader.topics().iter().find(|t| t.name == "/arm/joint_trajectory").unwrap();
    assert_eq!(trajectories.messages, 4, "transfer, correction, approach, lift");
    let replay = std::fs::read(save.join("replay.json")).unwrap();
    let replay: Value = serde_json::from_slice(&replay).unwrap();
    // Four trajectories, and the fingers: open, as wide as the corrected grasp wants them, closed.
    assert_eq!(replay["motions"].as_array().unwrap().len(), 7);
}

/// Heads whose joints are off by a few degrees' tenths put object and hand alike beside where they are.
#[test]
fn a_light_on_the_gripper_tells_how_far_the_heads_are_off() {
    let path = workcell("hand-light", |cup| cup.into());
    let text = std::fs::read_to_string(&path).unwrap();
    let text = text.replace("# tag = {", "tag = {");
    let text = text.replace("joint_zero_deg = 0.0", "joint_zero_deg = 0.2");
    // To say so changes nothing: what zeros get wrong is not in what the two lights differ by.
    let text = text.replace("zero_sd_deg = 0.0", "zero_sd_deg = 0.2");
    std::fs::write(&path, &text).unwrap();
    // Hand and landmark are apart, and the servos' steps alone make up to some four millimetres.
    for seed in ["3", "8"] {
        let (_, report) = grasp(&path, &["--seed", seed]);
        let grasp = &report["grasp"];
        let off = grasp["hand_off_mm"].as_f64().unwrap_or_else(|| panic!("{grasp}"));
        let truth = [0, 1, 2].map(|k| report["truth"]["landmark"][k].as_f64().unwrap());
        let told = [0, 1, 2].map(|k| report["landmark"]["position"][k].as_f64().unwrap());
        let wrong = 1e3 * truth.iter().zip(told).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(
            wrong > 5.0 && (off - wrong).abs() < 4.0,
            "off by {wrong:.1} mm, told {off:.1}: {grasp}"
        );
        assert_eq!(grasp["succeeded"], true, "{grasp}");
    }
    // A hand that is not seen after all ends the grasp where the plan counted on it.
    let unseen = text.replace("tag = { object_id = \"gripper\"", "tag = { object_id = \"nobody\"");
    for (stated, ends) in [("0.2", true), ("0.0", false)] {
        let stated = format!("zero_sd_deg = {stated}");
        std::fs::write(&path, unseen.replace("zero_sd_deg = 0.2", &stated)).unwrap();
        let (_, report) = grasp(&path, &["--seed", "8"]);
        let why = report["grasp"]["reason"].as_str().unwrap_or_default();
        assert_eq!(why.contains("\"nobody\" answers"), ends, "{report}");
        assert_eq!(report["grasp"]["hand_unseen"].is_null(), ends, "{report}");
        assert_eq!(report["grasp"]["closed_width"].is_null(), ends, "{report}");
    }
    // Without the light nothing is known well enough, whoever says so.
    std::fs::write(&path, text.replace("tag = {", "# tag = {")).unwrap();
    refused(&path, "the pose is too uncertain");
}

#[test]
fn what_must_not_or_cannot_be_lifted_is_refused_by_name() {
    let fixed = workcell("fixed", |cup| cup.replacen("\"movable\"", "\"fixed\"", 1));
    refused(&fixed, "is fixed");
    let heavy = workcell("heavy", |cup| cup.replacen("weight = 0.28", "weight = 9.0", 1));
    refused(&heavy, "weighs 9.00 kg");
}

/// The arm must not have moved, and the message must say why.
fn refused(path: &Path, said: &str) {
    let (status, report) = grasp(path, &[]);
    assert_eq!(status, Some(1), "{report}");
    assert_eq!(report["found"], true, "{report}");
    let grasp = &report["grasp"];
    assert_eq!(grasp["succeeded"], false);
    assert!(grasp["reason"].as_str().unwrap().contains(said), "{grasp}");
    assert!(!grasp["hint"].as_str().unwrap().is_empty());
    let moved = |step: &Value| step["step"] == "transfer";
    assert!(!report["timeline"].as_array().unwrap().iter().any(moved), "{report}");
    assert_eq!(grasp["physics"]["risen_mm"].as_f64().map(f64::abs).map(|mm| mm < 1.0), Some(true));
}

#[test]
fn an_object_that_nobody_knows_is_not_grasped() {
    let output = vergence(&["grasp", "teapot", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(report["reason"].as_str().unwrap().contains("teapot"));
    assert_eq!(report["grasp"]["succeeded"], false);
    assert_eq!(vergence(&["grasp"]).status.code(), Some(2));
}
