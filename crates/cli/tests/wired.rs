//! `vergence find` over wires in real time: servos on a pseudo-terminal, cameras over HTTP, tags over
//! HCI on TCP. The simulated workcell at the other end knows the truth, and can be harmed.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::io::{BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nalgebra::{Point3, Vector3};
use serde_json::Value;
use vergence_sim::{
    GeometryError, WiredWorkcell, Workcell, embedded_files, fitting_servo, settings,
};

/// No run may take longer, whatever happens to its devices.
const BOUND: Duration = Duration::from_secs(180);
/// Into the search, when the servos move: the radio alone listens for 2.5 s.
const UNDER_WAY: Duration = Duration::from_millis(4500);

/// One at a time: on two cores, several workcells in real time would starve each other.
static TURN: Mutex<()> = Mutex::new(());

struct Bench {
    _turn: MutexGuard<'static, ()>,
    wired: Option<WiredWorkcell>,
    folder: PathBuf,
}

impl Bench {
    fn start(name: &str) -> Self {
        Self::built(name, GeometryError::default())
    }

    /// With heads that are not as described.
    fn built(name: &str, geometry_error: GeometryError) -> Self {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let (config, description) = embedded_files().unwrap();
        let mut settings = settings(&config).unwrap();
        let model = fitting_servo(settings.servos.resolution_deg);
        settings.servos.resolution_deg = model.tick.to_degrees();
        settings.geometry_error = geometry_error;
        let urdf = description.text.clone();
        let workcell = Workcell::new(config, description, settings, 3).unwrap();
        let wired = WiredWorkcell::start(workcell, model).unwrap();
        let folder = std::env::temp_dir().join(format!("vergence-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("wired.urdf"), urdf).unwrap();
        std::fs::write(folder.join("wired.toml"), wired.wiring("wired.urdf")).unwrap();
        Bench { _turn: turn, wired: Some(wired), folder }
    }

    fn wired(&self) -> &WiredWorkcell {
        self.wired.as_ref().unwrap()
    }

    fn find(&self) -> Child {
        self.find_with("wired.toml")
    }

    fn find_with(&self, config: &str) -> Child {
        self.run(&["find", "cup", "--config", config])
    }

    fn run(&self, arguments: &[&str]) -> Child {
        Command::new(env!("CARGO_BIN_EXE_vergence"))
            .args(arguments)
            .arg("--json")
            .current_dir(&self.folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    }

    fn torque_is_off(&self) -> bool {
        let switch = fitting_servo(0.35).registers.torque_enable;
        self.wired().servos().iter().all(|servo| servo.get(switch) == 0)
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

/// Waits for the end, which must come in time.
fn ended(mut child: Child) -> (Option<i32>, Value) {
    let begin = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if begin.elapsed() > BOUND {
            child.kill().unwrap();
            panic!("still running after {BOUND:?}");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let Output { status, stdout, stderr } = child.wait_with_output().unwrap();
    let report = serde_json::from_slice(&stdout);
    let report =
        report.unwrap_or_else(|_| panic!("no report: {}", String::from_utf8_lossy(&stderr)));
    (status.code(), report)
}

/// A run whose devices fail must say so: no answer, a reason with these words, and torque off where the
/// servos can still be reached.
fn fails_with(child: Child, words: &[&str]) {
    let (status, report) = ended(child);
    assert_eq!((status, report["found"].as_bool()), (Some(1), Some(false)), "{report}");
    let reason = report["reason"].as_str().unwrap();
    assert!(words.iter().any(|word| reason.contains(word)), "{reason}");
}

#[test]
fn the_cup_is_found_over_wires() {
    let bench = Bench::start("found");
    let (status, report) = ended(bench.find());
    assert_eq!(status, Some(0), "{report}");
    let truth = bench.wired().truth();
    let cup = truth.objects.iter().find(|o| o.id == "cup").unwrap();
    let told = &report["pose"]["position"];
    let told = nalgebra::Vector3::from_fn(|k, _| told[k].as_f64().unwrap());
    let off = (told - cup.base_from_object.translation.vector).norm();
    assert!(off < 0.015, "off by {:.1} mm", 1e3 * off);
    assert!(bench.torque_is_off(), "the torque is released at the end");
}

/// Waits until the program asks for the light at its next place.
fn asks(child: &mut Child) {
    const PROMPT: &[u8] = b"(q ends) ";
    let stderr = child.stderr.as_mut().unwrap();
    let (mut said, mut byte) = (Vec::new(), [0]);
    while stderr.read(&mut byte).unwrap() == 1 {
        said.push(byte[0]);
        if said.ends_with(PROMPT) {
            return;
        }
    }
    panic!("ends before it has seen all places: {}", String::from_utf8_lossy(&said));
}

#[test]
fn heads_that_are_not_as_described_are_calibrated_over_wires() {
    let errors = GeometryError { joint_zero_deg: 1.0, focal_ratio: 0.03, ..Default::default() };
    let bench = Bench::built("calibrated", errors);
    let (places, views, out) = (["--places", "8"], ["--views", "8"], ["--out", "better.toml"]);
    let what = ["calibrate", "--config", "wired.toml", "--measured"];
    let mut child = bench.run(&[&what[..], &places, &views, &out].concat());
    let at = |bearing: f64, distance: f64, height: f64| {
        Point3::new(distance * bearing.cos(), distance * bearing.sin(), height)
    };
    // Near and far, left and right, high and low; the second of a pair half a metre from the first.
    let pairs = [
        (at(-0.4, 0.7, 0.2), Vector3::new(0.3, 0.4, 0.0)),
        (at(0.2, 1.3, 0.5), Vector3::new(-0.3, -0.4, 0.0)),
        (at(0.45, 0.8, 0.4), Vector3::new(0.0, -0.5, 0.0)),
        (at(-0.35, 1.4, 0.15), Vector3::new(-0.4, 0.0, 0.3)),
    ];
    for place in pairs.into_iter().flat_map(|(first, way)| [first, first + way]) {
        asks(&mut child);
        assert!(bench.wired().hold_light("cup", &place));
        let typed = format!("{} {} {}\n", place.x, place.y, place.z);
        child.stdin.as_mut().unwrap().write_all(typed.as_bytes()).unwrap();
    }
    let (status, told) = ended(child);
    assert_eq!(status, Some(0), "{told}");
    assert!(bench.wired().hold_light("cup", &at(0.1, 0.9, 0.2)));
    let off = |config: &str| {
        let (_, report) = ended(bench.find_with(config));
        let told = &report["landmark"]["position"];
        let told = Point3::from([0, 1, 2].map(|k| told[k].as_f64().unwrap_or(f64::INFINITY)));
        (told - at(0.1, 0.9, 0.2)).norm()
    };
    let (before, after) = (off("wired.toml"), off("better.toml"));
    assert!(before > 0.03 && after < 0.012, "{before} m before, {after} m after");
}

#[test]
fn a_hot_servo_ends_the_run() {
    let bench = Bench::start("hot");
    let child = bench.find();
    std::thread::sleep(UNDER_WAY);
    bench.wired().servos()[0].fault = 0x04;
    fails_with(child, &["servo 1 reports overheated"]);
    assert!(bench.torque_is_off());
}

#[test]
fn pulled_cables_end_the_run() {
    let mut bench = Bench::start("pulled");
    let child = bench.find();
    std::thread::sleep(UNDER_WAY);
    // Servos, cameras and tags go at once; which is missed first is chance.
    bench.wired = None;
    fails_with(child, &["not connected", "no answer", "the port fails"]);
}

#[test]
fn an_interrupt_leaves_by_the_way_out() {
    let bench = Bench::start("interrupt");
    let child = bench.find();
    std::thread::sleep(UNDER_WAY);
    let asked = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(asked.success());
    fails_with(child, &["told to end"]);
    assert!(bench.torque_is_off());
}

#[test]
fn the_command_offers_its_devices_until_it_is_told_to_end() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = std::env::temp_dir().join(format!("vergence-sim-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let config = folder.join("wired.toml");
    let mut sim = Command::new(env!("CARGO_BIN_EXE_vergence"))
        .args(["sim", "--json", "--seconds", "60", "--hold", "--write-config"])
        .arg(&config)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(sim.stdout.take().unwrap()).lines();
    let told: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
    assert!(told["servos"].as_str().unwrap().starts_with("/dev/"), "{told}");
    assert_eq!(told["cameras"].as_array().unwrap().len(), 2);
    assert_eq!(told["truth"].as_array().unwrap().len(), 3);
    let tags = Command::new(env!("CARGO_BIN_EXE_vergence"))
        .args(["tags", "--json", "--config"])
        .arg(&config)
        .output()
        .unwrap();
    let tags: Value = serde_json::from_slice(&tags.stdout).unwrap();
    assert_eq!(tags["tags"].as_array().unwrap().len(), 3, "{tags}");
    let mut stdin = sim.stdin.take().unwrap();
    let mut answers = BufReader::new(sim.stderr.take().unwrap()).lines();
    for (typed, answer) in [
        ("cup 0.8 0.1 0.3", "cup is held"),
        ("jug 0.8 0.1 0.3", "there is no object \"jug\""),
        ("cup 0.8", "type OBJECT X Y Z"),
    ] {
        writeln!(stdin, "{typed}").unwrap();
        let said = answers.next().unwrap().unwrap();
        assert!(said.starts_with(answer), "{said}");
    }
    assert!(Command::new("kill").arg(sim.id().to_string()).status().unwrap().success());
    assert_eq!(sim.wait().unwrap().code(), Some(0), "ends in order at SIGTERM");
    std::fs::remove_dir_all(&folder).unwrap();
}
