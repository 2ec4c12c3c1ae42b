//! Times of recognition on a drawn stereo pair of 320x240, rotation unknown.

use nalgebra::{Matrix3, Point3, UnitQuaternion, Vector3};
use vergence_geometry::{Camera, GaussianPoint, Transform};
use vergence_imaging::Image;
use vergence_pose::{Query, View, canny, directional, distance, paper};
use vergence_tag::{Record, Shape};

fn main() {
    divan::main();
}

/// A bright square on a dark ground with a fine texture.
fn image() -> Image<u8> {
    Image::from_fn(320, 240, |x, y| {
        let inside = (120..200).contains(&x) && (80..160).contains(&y);
        (if inside { 150 } else { 60 }) + ((x * 7 + y * 13) % 5) as u8
    })
}

fn record() -> Record {
    let text = r#"{"object_id": "box", "landmarks": [{"position": [0, 0, 0.05], "normal": [0, 0, 1]}],
        "bounding_box": {"width": 0.2, "length": 0.2, "height": 0.1}, "shape": {"kind": "box"}}"#;
    serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}"))
}

fn with_scene<R>(up: bool, f: impl FnOnce(&[View], &Query) -> R) -> R {
    with_object(&record(), up, f)
}

fn with_object<R>(record: &Record, up: bool, f: impl FnOnce(&[View], &Query) -> R) -> R {
    let image = image();
    let down = UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, 0.0);
    let views = [0.1, -0.1].map(|x| View {
        image: &image,
        camera: Camera::centred(320, 240, 300.0),
        base_from_optical: Transform::from_parts(Vector3::new(x, 0.0, 0.8).into(), down),
        turn_sd: 0.0,
    });
    let landmark = GaussianPoint {
        position: Point3::new(0.0, 0.0, 0.05),
        covariance: Matrix3::identity() * 1e-5,
    };
    let up = up.then(Vector3::z_axis);
    f(&views, &Query { record, landmark, landmark_index: 0, up, standing: up.map(|_| true) })
}

#[divan::bench]
fn directional_any_attitude(bencher: divan::Bencher) {
    with_scene(false, |views, query| {
        bencher.bench_local(|| directional::recognise(views, query, &Default::default()));
    });
}

#[divan::bench]
fn directional_standing(bencher: divan::Bencher) {
    with_scene(true, |views, query| {
        bencher.bench_local(|| directional::recognise(views, query, &Default::default()));
    });
}

/// A star of twelve points: every piece of its edges may be hidden by any of its faces.
#[divan::bench]
fn directional_concave(bencher: divan::Bencher) {
    let corner = |k: usize| {
        let (angle, radius) =
            (std::f64::consts::TAU * k as f64 / 24.0, if k.is_multiple_of(2) { 0.1 } else { 0.06 });
        [radius * angle.cos(), radius * angle.sin()]
    };
    let outline = (0..24).map(corner).collect();
    let record = Record { shape: Shape::Prism { outline, height: 0.1 }, ..record() };
    with_object(&record, false, |views, query| {
        bencher.bench_local(|| directional::recognise(views, query, &Default::default()));
    });
}

#[divan::bench]
fn track(bencher: divan::Bencher) {
    with_scene(false, |views, query| {
        let last = Transform::from_parts(
            Vector3::new(0.002, -0.001, 0.0).into(),
            UnitQuaternion::from_euler_angles(0.02, -0.01, 0.03),
        );
        bencher.bench_local(|| directional::track(views, query, &last, &Default::default()));
    });
}

#[divan::bench]
fn paper_standing(bencher: divan::Bencher) {
    with_scene(true, |views, query| {
        bencher.bench_local(|| paper::recognise(views, query, &Default::default()));
    });
}

#[divan::bench]
fn canny_320x240(bencher: divan::Bencher) {
    let image = image();
    bencher.bench_local(|| canny::canny(&image, 40, 100));
}

#[divan::bench]
fn exact_distance_320x240(bencher: divan::Bencher) {
    let edges = canny::canny(&image(), 40, 100);
    bencher.bench_local(|| distance::transform(&edges));
}
