//! The commands as outsiders script against them: JSON, exit status, messages that say what to do.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn vergence(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vergence")).args(args).output().unwrap()
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stdout)))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

fn distance(a: &Value, b: &Value) -> f64 {
    let squares = numbers(a).iter().zip(numbers(b)).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
    squares.sqrt()
}

/// A folder of this test's own.
fn folder(name: &str) -> std::path::PathBuf {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    dir
}

#[test]
fn a_cup_is_found_where_it_is_and_twice_alike() {
    let output = vergence(&["find", "cup", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stdout));
    let report = json(&output);
    assert_eq!(report["found"], true);
    assert_eq!(report["object_id"], "cup");
    let (pose, truth) = (&report["pose"], &report["truth"]);
    let error = distance(&pose["position"], &truth["position"]);
    assert!(error < 0.010, "position off by {:.1} mm", 1e3 * error);
    // A cup's turn about its own axis cannot be seen: what counts is where its axis points.
    let axis = |q: &Value| {
        let q = numbers(q);
        let (x, y, z, w) = (q[0], q[1], q[2], q[3]);
        [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)]
    };
    let cos: f64 = axis(&pose["orientation"])
        .iter()
        .zip(axis(&truth["orientation"]))
        .map(|(a, b)| a * b)
        .sum();
    assert!(cos > 10f64.to_radians().cos(), "axis off by {:.1} degrees", cos.acos().to_degrees());
    // One look through encoders of 0.35 degrees would be worth a centimetre.
    let off = distance(&report["landmark"]["position"], &truth["landmark"]);
    let covariance = numbers(&report["landmark"]["covariance"]);
    let sigma = (covariance[0] + covariance[4] + covariance[8]).sqrt();
    assert!(off < 0.006 && sigma < 0.004 && off < 3.5 * sigma, "off {off}, claims {sigma}");
    assert_eq!(covariance.len(), 9);
    assert_eq!(numbers(&pose["covariance"]).len(), 36);
    let steps = report["timeline"].as_array().unwrap();
    assert!(steps.iter().all(|s| s["end"].as_f64() >= s["start"].as_f64()), "{steps:?}");
    assert_eq!(vergence(&["find", "cup", "--json"]).stdout, output.stdout);
}

#[test]
fn the_papers_method_runs_and_saves_every_picture() {
    let dir = folder("paper");
    let path = dir.to_str().unwrap();
    // What an earlier run left goes, what is not of a run stays.
    let (left, other) = (["7-lifted-left.png", "directional-view0-3-best.png"], "7-sins-left.png");
    left.iter().chain([&other]).for_each(|name| std::fs::write(dir.join(name), "").unwrap());
    let output = vergence(&["find", "can", "--method", "paper", "--save", path, "--json"]);
    let report = json(&output);
    assert!(report["landmark"].is_object(), "{report}");
    for name in ["1-difference", "2-spectrum", "3-centred", "4-edges", "5-field", "6-template"] {
        for side in ["left", "right"] {
            let picture = dir.join(format!("{name}-{side}.png"));
            vergence_imaging::codec::read(&picture).unwrap();
        }
    }
    assert!(left.iter().all(|name| !dir.join(name).exists()) && dir.join(other).exists());
    let saved = std::fs::read(dir.join("result.json")).unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&saved).unwrap(), report);
    let reader = vergence_ros::recording::Reader::open(&dir.join("recording.mcap")).unwrap();
    assert!(reader.is_complete());
    for topic in ["/left/image_raw", "/right/camera_info", "/joint_states", "/tf", "/result"] {
        let found = reader.topics().iter().find(|t| t.name == topic);
        assert!(found.is_some_and(|t| t.messages > 0), "{topic}");
    }
}

#[test]
fn an_unknown_object_is_not_achieved_and_says_who_answers() {
    let output = vergence(&["find", "teapot", "--json"]);
    assert_eq!(output.status.code(), Some(1));
    let report = json(&output);
    assert_eq!(report["found"], false);
    let reason = report["reason"].as_str().unwrap();
    assert!(reason.contains("teapot") && reason.contains("cup"), "{reason}");
    assert!(report["hint"].as_str().unwrap().contains("vergence tags"));
}

#[test]
fn tags_lists_the_records() {
    let output = vergence(&["tags", "--json"]);
    assert_eq!(output.status.code(), Some(0));
    let tags = json(&output)["tags"].as_array().unwrap().clone();
    let mut ids: Vec<&str> = tags.iter().map(|tag| tag["id"].as_str().unwrap()).collect();
    ids.sort_unstable();
    assert_eq!(ids, ["box", "can", "cup"]);
    for tag in &tags {
        assert_eq!(tag["record"]["object_id"], tag["id"]);
        assert!(tag["rssi"].is_i64());
    }
}

#[test]
fn a_user_edits_the_workcell() {
    let dir = folder("workcell");
    assert_eq!(vergence(&["workcell", dir.to_str().unwrap()]).status.code(), Some(0));
    assert_eq!(vergence(&["workcell", dir.to_str().unwrap()]).status.code(), Some(1));
    let path = dir.join("workcell.toml");
    let config = path.to_str().unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let with = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
        vergence(&["find", "cup", "--config", config, "--json"])
    };
    let far = with("range = 10.0", "range = 0.1");
    assert_eq!(far.status.code(), Some(1));
    assert!(json(&far)["reason"].as_str().unwrap().contains("heard: nobody"));
    let dark = with("flux_px = 4.0", "flux_px = 0.0001");
    assert_eq!(dark.status.code(), Some(1));
    let reason = json(&dark)["reason"].as_str().unwrap().to_string();
    assert!(reason.contains("light was not seen"), "{reason}");
    for (from, to, said) in [
        ("driver = \"sim\"", "driver = \"gps\"", "gps"),
        ("[radio]\ndriver = \"sim\"", "[radio]\ndriver = \"hci\"", "controller"),
        ("clutter = 9", "cluter = 9", "cluter"),
        ("pan_joint = \"left_pan_joint\"", "pan_joint = \"neck\"", "neck"),
        ("robot = \"workcell.urdf\"", "robot = \"nowhere.urdf\"", "nowhere.urdf"),
    ] {
        let output = with(from, to);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{to}: {message}");
        assert!(message.contains(said) && message.contains("what to do"), "{message}");
        assert!(output.stdout.is_empty());
    }
}

/// Devices that are not there, and output that cannot be kept: exit status 1 comes with its reason.
/// Finds an object in the built-in workcell as edited, which must succeed; how far off the position is (m).
fn found_in_edited(name: &str, edit: impl Fn(&str) -> String, find: &[&str]) -> f64 {
    let dir = folder(name);
    assert_eq!(vergence(&["workcell", dir.to_str().unwrap()]).status.code(), Some(0));
    let path = dir.join("workcell.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let edited = edit(&text);
    assert_ne!(text, edited);
    std::fs::write(&path, edited).unwrap();
    let config = ["--config", path.to_str().unwrap(), "--json"];
    let report = json(&vergence(&[&["find"], find, &config].concat()));
    assert_eq!(report["found"], true, "{report}");
    distance(&report["pose"]["position"], &report["truth"]["position"])
}

#[test]
fn a_light_thirty_times_white_is_found_and_not_its_reflection() {
    let edit = |text: &str| text.replace("flux_px = 4.0", "flux_px = 30.0");
    let off = found_in_edited("bright", edit, &["cup", "--seed", "8"]);
    assert!(off < 0.01, "{off} m");
}

#[test]
fn an_angle_iron_is_found() {
    let iron = r#"
[[sim.objects]]
surface = "printed"
[sim.objects.record]
object_id = "iron"
bounding_box = { width = 0.09, length = 0.07, height = 0.05 }
shape = { kind = "prism", outline = [[-0.045, -0.035], [0.045, -0.035], [0.045, -0.005], [-0.015, -0.005], [-0.015, 0.035], [-0.045, 0.035]], height = 0.05 }
landmarks = [{ position = [0.0, -0.036, 0.0], normal = [0.0, -1.0, 0.0] }]
"#;
    let off = found_in_edited("iron", |text| text.to_owned() + iron, &["iron", "--seed", "2"]);
    assert!(off < 0.01, "{off} m");
}

#[test]
fn what_fails_under_json_says_why() {
    let dir = folder("failing");
    assert_eq!(vergence(&["workcell", dir.to_str().unwrap()]).status.code(), Some(0));
    let path = dir.join("workcell.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    // A port that was free a moment ago: nobody listens there.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let radio = format!("[radio]\ndriver = \"hci\"\ntcp = \"127.0.0.1:{port}\"");
    let wired = text.replacen("[radio]\ndriver = \"sim\"", &radio, 1);
    assert_ne!(wired, text);
    std::fs::write(&path, wired).unwrap();
    let config = ["--config", path.to_str().unwrap()];
    let out = dir.join("calibrated.toml");
    let below = path.join("below");
    let save = ["--save", below.to_str().unwrap()];
    let calibrate = ["calibrate", "--out", out.to_str().unwrap()];
    for (command, more, said) in [
        (&["find", "cup"][..], &config, "refused"),
        (&["grasp", "cup"], &config, "refused"),
        (&["tags"], &config, "refused"),
        (&["tag", "info", "cup"], &config, "refused"),
        (&calibrate, &config, "refused"),
        (&["find", "cup"], &save, "below"),
        (&["grasp", "cup"], &save, "below"),
        (&["experiment", "1", "--seeds", "1"], &save, "below"),
        (&["experiment", "2", "--seeds", "1"], &save, "below"),
    ] {
        let output = vergence(&[command, more, &["--json"]].concat());
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{command:?}: {errors}");
        let told = json(&output);
        let reason = told["reason"].as_str().unwrap();
        assert!(reason.contains(said) && errors.contains(reason), "{command:?}: {told} {errors}");
        assert!(told["hint"].as_str().is_some_and(|hint| !hint.is_empty()), "{told}");
        match command[0] {
            "find" => {
                assert_eq!((&told["found"], &told["object_id"]), (&false.into(), &"cup".into()))
            }
            "grasp" => assert_eq!(told["grasp"]["succeeded"], false),
            "calibrate" => assert_eq!(told["calibrated"], false),
            _ => {}
        }
    }
}

/// More than the air holds: such a tag is known by its record.
#[test]
fn an_object_with_a_long_id_is_found() {
    let dir = folder("long-id");
    assert_eq!(vergence(&["workcell", dir.to_str().unwrap()]).status.code(), Some(0));
    let path = dir.join("workcell.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let (id, other) = ("left-kitchen-drawer-cup", "left-kitchen-drawer-mug");
    let long = text.replacen("object_id = \"cup\"", &format!("object_id = \"{id}\""), 1);
    assert_ne!(long, text);
    std::fs::write(&path, long).unwrap();
    let find = |id| vergence(&["find", id, "--config", path.to_str().unwrap(), "--json"]);
    assert_eq!(json(&find(id))["found"], true);
    let wrong = find(other);
    assert_eq!(wrong.status.code(), Some(1));
    assert!(json(&wrong)["reason"].as_str().unwrap().contains(id), "{}", json(&wrong));
}

/// Output that nobody wants to read on, and output that cannot be kept.
#[cfg(target_os = "linux")]
#[test]
fn a_reader_may_leave_and_a_full_disk_is_told() {
    let command = || Command::new(env!("CARGO_BIN_EXE_vergence"));
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = command().args(["evaluate", "equation"]).stdout(writer).output().unwrap();
    assert_eq!((output.status.code(), output.stderr.len()), (Some(0), 0));
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = command().args(["evaluate", "equation"]).stdout(full).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("cannot write to standard output"), "{said}");
}

/// The table of docs/head.md, in which what is nothing has no sign.
#[test]
fn the_error_of_the_paper_s_equation_is_as_documented() {
    let output = vergence(&["evaluate", "equation"]);
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    let printed: Vec<&str> = table.lines().skip(1).flat_map(percentages).collect();
    let docs = include_str!("../../../docs/head.md");
    let documented: Vec<&str> = docs
        .lines()
        .filter(|l| l.starts_with("| ") && l.contains("°"))
        .flat_map(percentages)
        .collect();
    assert!(printed.len() == 60 && printed.contains(&"0.00"), "{table}");
    assert_eq!(printed, documented);
}

/// The numbers of a line that stand before a per cent sign.
fn percentages(line: &str) -> Vec<&str> {
    let words: Vec<&str> = line.split_whitespace().collect();
    words.windows(2).filter(|pair| pair[1] == "%").map(|pair| pair[0]).collect()
}

#[test]
fn misuse_is_two() {
    let missing = vergence(&["find", "cup", "--config", "no/such/file.toml"]);
    assert_eq!(missing.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&missing.stderr).contains("no/such/file.toml"));
    assert_eq!(vergence(&["find"]).status.code(), Some(2));
    assert_eq!(vergence(&["experiment", "9"]).status.code(), Some(2));
}

/// And is not taken for an option, with the advice that goes with that.
#[test]
fn a_negative_number_is_told_what_should_stand_there() {
    for (args, said) in [
        (&["tag", "blink", "cup", "--seconds", "-1"][..], "--seconds -1:"),
        (&["tag", "blink", "cup", "--chip-ms", "-1"], "--chip-ms -1:"),
        (&["sim", "--seconds", "-1"], "--seconds is not a time"),
        (&["blink", "--bound", "--minutes", "-1"], "not between 0 and"),
        (&["calibrate", "--config", "x", "--out", "y", "--length", "-1"], "give them in metres"),
        (&["find", "cup", "--seed", "-1"], "invalid value '-1' for '--seed <SEED>'"),
        (&["evaluate", "pose", "--scenes", "-3"], "invalid value '-3' for '--scenes <SCENES>'"),
        (&["experiment", "1", "--seeds", "-3"], "invalid value '-3' for '--seeds <SEEDS>'"),
    ] {
        let output = vergence(args);
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains(said) && !told.contains("unexpected argument"), "{told}");
    }
}

#[test]
fn poses_of_simulated_scenes_are_right_and_honest() {
    let output = vergence(&["evaluate", "pose", "--scenes", "24", "--seed", "1000", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let figures = json(&output);
    let number = |name: &str| figures[name].as_f64().unwrap();
    assert!(number("answered") >= 20.0, "{figures}");
    assert!(number("within_5mm_5deg") >= 0.75, "{figures}");
    assert!(number("ellipsoid_95_coverage") >= 0.75, "{figures}");
    assert!(figures["wrong_seeds"].as_array().unwrap().len() <= 2, "{figures}");

    let last = u64::MAX.to_string();
    let output = vergence(&["evaluate", "pose", "--scenes", "2", "--seed", &last, "--json"]);
    let figures = json(&output);
    let refused = figures["refused"].as_object().unwrap().values().filter_map(Value::as_u64);
    let told = figures["answered"].as_u64().unwrap() + refused.sum::<u64>();
    assert_eq!(told, 2, "{figures}");

    let none = vergence(&["evaluate", "pose", "--scenes", "0"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&none.stderr).contains("--scenes 0"));
}
