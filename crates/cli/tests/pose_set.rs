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

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Puts one more entry into a JSON file whose keys are images.
fn enter(path: &Path, image: u32, entry: Value) {
    let mut all = if path.exists() { read(path) } else { json!({}) };
    all[image.to_string()] = entry;
    write(path, &all);
}

/// A new folder for a set.
fn folder(name: &str) -> PathBuf {
    let set = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&set);
    set
}

/// Adds an image to a scene's folder, in the layout of docs/pose.md: a simulated scene, whose object has
/// these numbers, each with a tag.
fn add(folder: &Path, image: u32, scene: &StereoScene, objects: &[u32]) {
    for (view, side) in ["left", "right"].into_iter().enumerate() {
        std::fs::create_dir_all(folder.join(format!("gray_{side}"))).unwrap();
        let picture = folder.join(format!("gray_{side}/{image:06}.png"));
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
        enter(&folder.join(format!("scene_camera_{side}.json")), image, entry);
        let (rotation, translation) = rigid(&(optical_from_base * scene.base_from_object));
        let truth =
            |id: &u32| json!({"obj_id": id, "cam_R_m2c": rotation, "cam_t_m2c": translation});
        let truths = objects.iter().map(truth).collect();
        enter(&folder.join(format!("scene_gt_{side}.json")), image, truths);
    }
    let landmark = &scene.landmark;
    let mm = |v: &f64| 1e3 * v;
    let tag = |id: &u32| {
        json!({
            "obj_id": id, "tag": scene.record,
            "landmark_w": landmark.position.iter().map(mm).collect::<Vec<_>>(),
            "landmark_cov_w": landmark.covariance.iter().map(|v| 1e6 * v).collect::<Vec<_>>(),
        })
    };
    enter(&folder.join("scene_tags.json"), image, objects.iter().map(tag).collect());
}

fn scenes() -> [StereoScene; 2] {
    [1001, 1002].map(|seed| stereo_scene(Scenario::Default, seed).unwrap())
}

/// Two simulated scenes of one image each.
fn set(name: &str) -> (PathBuf, [StereoScene; 2]) {
    let (set, scenes) = (folder(name), scenes());
    for (k, scene) in scenes.iter().enumerate() {
        add(&set.join(format!("test/{k:06}")), 0, scene, &[1]);
    }
    (set, scenes)
}

/// The rows of a results file: scene, image, object. The position must be that of the scene with the index
/// that `truth` tells.
fn rows(out: &Path, truth: impl Fn(&[u32; 3]) -> usize, scenes: &[StereoScene]) -> Vec<[u32; 3]> {
    let table = std::fs::read_to_string(out).unwrap();
    let mut rows = table.lines();
    assert_eq!(rows.next(), Some("scene_id,im_id,obj_id,score,R,t,time"));
    rows.map(|row| {
        let fields: Vec<&str> = row.split(',').collect();
        let numbers = [0, 1, 2].map(|k| fields[k].parse().unwrap());
        let found: Vec<f64> = fields[5].split(' ').map(|v| v.parse().unwrap()).collect();
        let scene = &scenes[truth(&numbers)];
        let (_, truth) = rigid(&(scene.base_from_optical[0].inverse() * scene.base_from_object));
        let squares: f64 = found.iter().zip(truth).map(|(f, t)| (f - t).powi(2)).sum();
        assert!(squares.sqrt() < 5.0, "{row}");
        numbers
    })
    .collect()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn a_set_is_recognised_into_the_left_camera_s_frame() {
    let (set, scenes) = set("pose-set");
    let out = set.join("results.csv");
    let output = vergence(&["pose", set.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(rows(&out, |row| row[0] as usize, &scenes), [[0, 0, 1], [1, 0, 1]]);
}

/// Images are in the order of their numbers, not of their text, and each tag of each is asked for.
#[test]
fn every_tag_of_every_image_is_a_case() {
    let (set, scenes) = (folder("pose-set-images"), scenes());
    let scene = set.join("test/000007");
    add(&scene, 10, &scenes[1], &[3]);
    add(&scene, 2, &scenes[0], &[1, 5]);
    let (out, pictures) = (set.join("results.csv"), set.join("pictures"));
    std::fs::create_dir_all(&pictures).unwrap();
    for name in ["000099-view0-3-best.png", "000007-000001-0-view0-3-best.png", "mine-view0.png"] {
        std::fs::write(pictures.join(name), "").unwrap();
    }
    let [path, out_path, save] = [&set, &out, &pictures].map(|path| path.to_str().unwrap());
    let output = vergence(&["pose", path, "--out", out_path, "--save", save]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let of = |row: &[u32; 3]| usize::from(row[1] == 10);
    assert_eq!(rows(&out, of, &scenes), [[7, 2, 1], [7, 2, 5], [7, 10, 3]]);
    for name in ["000007", "000007-000002-1", "000007-000010-0"] {
        assert!(pictures.join(format!("{name}-view1-3-best.png")).exists(), "{name}");
    }
    // Those of an earlier run are gone, what is not of a run stays.
    for gone in ["000099-view0-3-best.png", "000007-000001-0-view0-3-best.png"] {
        assert!(!pictures.join(gone).exists(), "{gone}");
    }
    assert!(pictures.join("mine-view0.png").exists());
    // BOP: one time for all that was found in an image.
    let table = std::fs::read_to_string(&out).unwrap();
    let times: Vec<&str> = table.lines().skip(1).filter_map(|row| row.rsplit(',').next()).collect();
    assert!(times[0] == times[1] && times[1] != times[2], "{times:?}");

    // The truth of a tag is that of its number, of two the nearer one.
    let path = scene.join("scene_gt_left.json");
    let mut truths = read(&path);
    let right = truths["10"][0].clone();
    truths["10"][0]["cam_t_m2c"][0] = json!(right["cam_t_m2c"][0].as_f64().unwrap() + 300.0);
    truths["10"].as_array_mut().unwrap().push(right);
    let other = truths["10"][0].clone();
    truths["2"].as_array_mut().unwrap().insert(0, other);
    write(&path, &truths);
    let output = vergence(&["evaluate", "pose", "--set", set.to_str().unwrap(), "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&figures["objects"], &figures["scenes"]), (&json!(3), &json!(1)), "{figures}");
    assert_eq!(figures["within_5mm_5deg"], 1.0, "{figures}");
}

#[test]
fn a_bad_scene_is_named_and_stops_no_other() {
    let (set, scenes) = set("pose-set-bad");
    let out = set.join("results.csv");
    let pose = || vergence(&["pose", set.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    let cameras = set.join("test/000000/scene_camera_right.json");
    let good = read(&cameras);
    let with = |key: &str, value: Value| {
        let mut entry = good["0"].clone();
        entry[key] = value;
        json!({"0": entry})
    };
    let k = |index: usize, value: f64| {
        let mut k = good["0"]["cam_K"].clone();
        k[index] = json!(value);
        with("cam_K", k)
    };
    for (entry, said) in [
        (k(1, 0.5), "skew"),
        (k(3, 0.5), "skew"),
        (k(8, 2.0), "last row of cam_K"),
        (k(0, -300.0), "fx"),
        (with("turn_sd", json!(-0.01)), "turn_sd is negative"),
        (with("cam_R_w2c", json!([9, 9, 9, 9, 9, 9, 9, 9, 9])), "cam_R_w2c"),
        (json!({"1": good["0"]}), "image 0"),
        (json!({"first": good["0"]}), "\"first\" is no image number"),
        (json!({"0": good["0"], "00": good["0"]}), "twice"),
        (json!([]), "scene_camera_right.json"),
    ] {
        write(&cameras, &entry);
        let output = pose();
        let told = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains("scene 0: ") && told.contains(said), "{said}: {told}");
        assert!(told.contains("1 of 2 scenes") && told.contains("1 of 1 objects"), "{told}");
        assert_eq!(rows(&out, |row| row[0] as usize, &scenes), [[1, 0, 1]]);
    }
    let figures = vergence(&["evaluate", "pose", "--set", set.to_str().unwrap(), "--json"]);
    assert_eq!(figures.status.code(), Some(2));
    let figures: Value = serde_json::from_slice(&figures.stdout).unwrap();
    assert_eq!((&figures["bad_scenes"], &figures["answered"]), (&json!([0]), &json!(1)));

    // An image that is bad leaves the scene its others; a picture that is missing is named once.
    write(&cameras, &good);
    add(&set.join("test/000000"), 4, &scenes[0], &[1]);
    let picture = set.join("test/000000/gray_left/000000.png");
    std::fs::remove_file(&picture).unwrap();
    let told = text(&pose().stderr);
    assert_eq!(told.matches("000000.png").count(), 1, "{told}");
    assert_eq!(rows(&out, |row| row[0] as usize, &scenes), [[0, 4, 1], [1, 0, 1]]);
}

#[test]
fn results_that_cannot_be_written_are_refused_before_the_work() {
    let (set, _) = set("pose-set-out");
    let pose =
        |out: &Path| vergence(&["pose", set.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    let output = pose(&set.join("nowhere/results.csv"));
    let told = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{told}");
    assert!(told.contains("nowhere/results.csv") && !told.contains("answered"), "{told}");
    assert_eq!(pose(&set).status.code(), Some(1));

    // Work that fails leaves what was there, and nothing where nothing was.
    let (old, new) = (set.join("old.csv"), set.join("new.csv"));
    let (link, linked) = (set.join("link.csv"), set.join("linked.csv"));
    std::os::unix::fs::symlink(&linked, &link).unwrap();
    std::fs::write(&old, "kept").unwrap();
    std::fs::remove_dir_all(set.join("test/000000")).unwrap();
    std::fs::remove_file(set.join("test/000001/scene_tags.json")).unwrap();
    for out in [&old, &new, &link] {
        assert_eq!(pose(out).status.code(), Some(2));
    }
    assert_eq!(std::fs::read_to_string(&old).unwrap(), "kept");
    assert!(!new.exists() && !linked.exists() && link.is_symlink());
}

#[test]
fn so_many_threads_are_misuse() {
    for threads in ["0", "1025", "1000000"] {
        for args in [&["pose", "set", "--out", "out"][..], &["evaluate", "pose"]] {
            let output = vergence(&[args, &["--threads", threads]].concat());
            let told = text(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{told}");
            assert!(told.contains("1..=1024"), "{told}");
        }
    }
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
    let mut moved = read(&truth);
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

#[test]
fn scenes_that_were_drawn_and_written_are_answered_alike_when_read() {
    let set = folder("pose-set-saved");
    let set = set.to_str().unwrap();
    let evaluate = |args: &[&str]| vergence(&[&["evaluate", "pose", "--json"], args].concat());
    let figures = |args: &[&str]| -> Value {
        let output = evaluate(args);
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let drawn = figures(&["--scenes", "3", "--seed", "7", "--save", set]);
    let read = figures(&["--set", set]);
    assert_eq!(drawn["answered"], read["answered"]);
    assert_eq!(drawn["refused"], read["refused"]);
    for figure in ["median_position_mm", "median_rotation_deg", "nees_over_freedoms_median"] {
        let [drawn, read] = [&drawn, &read].map(|f| f[figure].as_f64().unwrap());
        assert!((drawn - read).abs() < 1e-3, "{figure}: {drawn} drawn, {read} read");
    }
    // What another run wrote is kept.
    let again = evaluate(&["--scenes", "1", "--save", set]);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("a new folder"));
    // The largest number of a scene, and one more.
    for (name, scenes, status) in [("last", "1", 0), ("beyond", "2", 2)] {
        let set = folder(&format!("pose-set-{name}"));
        let seed = u32::MAX.to_string();
        let args = ["--scenes", scenes, "--seed", &seed, "--save", set.to_str().unwrap()];
        let output = evaluate(&args);
        assert_eq!(output.status.code(), Some(status), "{}", text(&output.stderr));
        assert_eq!(set.exists(), status == 0, "{name}");
    }
}
