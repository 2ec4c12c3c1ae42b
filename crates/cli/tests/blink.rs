//! `vergence blink` on a recording: the answer, what it writes, and options that exclude each other.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};
use vergence_landmark::synthetic::{Light, Scene};
use vergence_ros::convert;
use vergence_ros::recording::Writer;
use vergence_tag::codebook;

const CAMERA: &str = "/left/image_raw";

fn vergence(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vergence")).args(args).output().unwrap()
}

/// Two seconds of a light that plays the first pattern of the code book, and a request for it.
fn episode(folder: &Path) {
    let pattern = codebook::assign(0, 30.0).unwrap();
    let light =
        Light { place: [20.0, 30.0].into(), amplitude: 60.0, pattern, phase: 0.1, rate: 1.0 };
    let scene = Scene { lights: vec![light], ..Scene::flat(64, 48) };
    let mut film = scene.film(1);
    let mut writer = Writer::create(&folder.join("recording.mcap")).unwrap();
    for _ in 0..60 {
        let frame = film.next_frame().unwrap();
        writer.write(CAMERA, frame.stamp, &convert::image(&frame, "eye")).unwrap();
    }
    writer.finish().unwrap();
    let request = json!({
        "camera": CAMERA, "clock_tolerance_ppm": 100.0, "exposure_seconds": 0.005,
        "tags": [{
            "id": "tag-0",
            "pattern": pattern.bits.to_string(),
            "chip_seconds": pattern.chip.as_secs_f64(),
        }],
    });
    std::fs::write(folder.join("request.json"), request.to_string()).unwrap();
}

#[test]
fn a_light_is_named_alike_in_every_run() {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("blink");
    let _ = std::fs::remove_dir_all(&dir);
    let (one, save) = (dir.join("episodes/0001"), dir.join("pictures"));
    [&one, &save].iter().for_each(|dir| std::fs::create_dir_all(dir).unwrap());
    episode(&one);
    // What an earlier run left goes: all three pictures of a tag. One alone is somebody else's.
    let left = ["tag-9-evidence.png", "tag-9-decision.png", "tag-9-light.png"];
    left.iter().chain(&["night-light.png"]).for_each(|name| {
        std::fs::write(save.join(name), "").unwrap();
    });
    let (recording, request) = (one.join("recording.mcap"), one.join("request.json"));
    let (out, answers) = (dir.join("answer.json"), dir.join("answers"));
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    let look = |more: &[&str]| {
        let args = ["blink", &text(&recording), "--request", &text(&request), "--json"];
        vergence(&[&args, more].concat())
    };
    let output = look(&["--save", &text(&save), "--out", &text(&out)]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    // All but the wall time is the same in every run.
    let told = |bytes: &[u8]| {
        let mut told: Value = serde_json::from_slice(bytes).unwrap();
        assert!(told["seconds"].as_f64().unwrap() > 0.0, "{told}");
        told.as_object_mut().unwrap().remove("seconds");
        told
    };
    let report = told(&output.stdout);
    assert_eq!(report["detections"][0]["id"], "tag-0", "{report}");
    assert_eq!(told(&look(&[]).stdout), report);
    let mut names: Vec<String> = std::fs::read_dir(&save)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    let [evidence, decision, light] = left.map(|name| name.replace("tag-9", "tag-0"));
    assert_eq!(names, ["night-light.png", &decision, &evidence, &light]);

    let read = |path: &Path| told(&std::fs::read(path).unwrap());
    assert_eq!(read(&out), report);
    let set = ["blink", "--episodes", &text(&dir.join("episodes")), "--out", &text(&answers)];
    assert_eq!(vergence(&set).status.code(), Some(0));
    assert_eq!(read(&answers.join("0001.json")), report);

    // An answer that cannot be kept is told nevertheless.
    let output = look(&["--out", &text(&dir.join("nowhere/answer.json"))]);
    assert_eq!(output.status.code(), Some(1));
    assert_eq!(told(&output.stdout), report);
}

#[test]
fn an_episode_that_cannot_be_read_stops_no_other() {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("blink-unreadable");
    let _ = std::fs::remove_dir_all(&dir);
    let [torn, silent, good] = ["0001", "0002", "0003"].map(|name| dir.join("set").join(name));
    for folder in [&torn, &silent, &good] {
        std::fs::create_dir_all(folder).unwrap();
        episode(folder);
    }
    std::fs::write(torn.join("request.json"), "{").unwrap();
    std::fs::remove_file(silent.join("recording.mcap")).unwrap();
    let answers = dir.join("answers");
    std::fs::create_dir(&answers).unwrap();
    // An earlier run could still read it.
    std::fs::write(answers.join("0001.json"), "{}").unwrap();
    let (set, out) = (dir.join("set"), answers.to_str().unwrap());
    let output = vergence(&["blink", "--episodes", set.to_str().unwrap(), "--out", out]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("0001: ") && said.contains("0002: "), "{said}");
    assert!(said.contains("2 of 3 episodes"), "{said}");
    let answered = [("0001", false), ("0002", false), ("0003", true)];
    for (name, there) in answered {
        assert_eq!(answers.join(format!("{name}.json")).exists(), there, "{name}: {said}");
    }
}

#[test]
fn what_a_request_has_wrong_is_told_with_its_file_and_tag() {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join("blink-requests");
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    episode(&dir);
    let path = dir.join("request.json");
    let good: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    for (place, bad, said) in [
        ("/tags/0/chip_seconds", json!(-1.0), "tag tag-0: chip_seconds"),
        ("/tags/0/chip_seconds", json!(1e-9), "tag tag-0: "),
        ("/exposure_seconds", json!(11.0), "not between 0 and 10 s"),
        ("/tags/0/pattern", json!("012"), "line 1"),
    ] {
        let mut request = good.clone();
        *request.pointer_mut(place).unwrap() = bad;
        std::fs::write(&path, request.to_string()).unwrap();
        let recording = dir.join("recording.mcap");
        let arguments = [recording.to_str().unwrap(), "--request", path.to_str().unwrap()];
        let output = vergence(&[&["blink"][..], &arguments].concat());
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains("request.json: ") && told.contains(said), "{place}: {told}");
    }
}

#[test]
fn options_without_effect_are_misuse() {
    for args in [
        &["--bound", "--runs", "0"][..],
        &["--bound", "--minutes", "nan"],
        &["--bound", "--minutes", "inf"],
        &["--bound", "--minutes=-1"],
        &["--bound", "--out", "out"],
        &["--bound", "--method", "paper"],
        &["--bound", "--save", "out"],
        &["--episodes", "set", "--out", "out", "--json"],
        &["recording.mcap", "--request", "request.json", "--runs", "3"],
    ] {
        let output = vergence(&[&["blink"], args].concat());
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{args:?}");
    }
}
