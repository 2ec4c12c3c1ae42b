//! The directional method on rendered boxes with known truth: pose, refusal, tracking.

use nalgebra::{Matrix3, Point3, Unit, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use vergence_geometry::gaussian::perturb;
use vergence_geometry::{Camera, GaussianPoint, Transform};
use vergence_imaging::Image;
use vergence_pose::directional::{self, Config};
use vergence_pose::{Query, Refusal, View};
use vergence_tag::{BoundingBox, Record, Shape};

const SIDES: [f64; 3] = [0.10, 0.16, 0.07];

fn record() -> Record {
    let text = r#"{"object_id": "box", "landmarks": [{"position": [0.05, 0.03, 0.01], "normal": [1, 0, 0]}],
        "bounding_box": {"width": 0.10, "length": 0.16, "height": 0.07}, "shape": {"kind": "box"}}"#;
    serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}"))
}

/// A camera at `eye` that looks at `target`, in base coordinates.
fn looking(eye: Point3<f64>, target: Point3<f64>) -> Transform {
    let forward = (target - eye).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(axes);
    Transform::from_parts(eye.coords.into(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// Grey value that a ray sees: the box's faces each of one shade, over a plain ground.
fn shade(base_from_object: &Transform, eye: &Point3<f64>, ray: &Vector3<f64>) -> f64 {
    let o = base_from_object.inverse_transform_point(eye);
    let d = base_from_object.inverse_transform_vector(ray);
    let (mut enter, mut leave, mut face) = (0.0, f64::INFINITY, 0);
    for k in 0..3 {
        let h = SIDES[k] / 2.0;
        let (a, b) = ((-h - o[k]) / d[k], (h - o[k]) / d[k]);
        if a.min(b) > enter {
            enter = a.min(b);
            face = 2 * k + usize::from(b < a);
        }
        leave = leave.min(a.max(b));
    }
    if enter < leave && enter > 0.0 { [70.0, 90.0, 120.0, 150.0, 60.0, 190.0][face] } else { 105.0 }
}

/// A picture with nine rays a pixel and sensor noise of two grey levels.
fn picture(camera: &Camera, pose: &Transform, object: &Transform, seed: u64) -> Image<u8> {
    let mut noise = rand_pcg::Pcg32::seed_from_u64(seed);
    let eye = Point3::from(pose.translation.vector);
    Image::from_fn(camera.width, camera.height, |x, y| {
        let mut sum = 0.0;
        for k in 0..9 {
            let at = |i: usize| (i as f64 - 1.0) / 3.0;
            let pixel = nalgebra::Point2::new(x as f64 + at(k % 3), y as f64 + at(k / 3));
            sum += shade(object, &eye, &(pose * camera.unproject(&pixel)));
        }
        let gauss: f64 = (0..4).map(|_| noise.random_range(-1.0..1.0)).sum::<f64>() * 1.73;
        (sum / 9.0 + gauss).clamp(0.0, 255.0) as u8
    })
}

struct Scene {
    images: Vec<Image<u8>>,
    cameras: Vec<(Camera, Transform)>,
    truth: Transform,
    landmark: GaussianPoint,
}

impl Scene {
    fn new(rotation: UnitQuaternion<f64>, seed: u64) -> Self {
        let truth = Transform::from_parts(Vector3::new(0.8, 0.05, 0.04).into(), rotation);
        let camera = Camera::centred(320, 240, 300.0);
        let cameras: Vec<_> = [0.15, -0.15]
            .map(|y| (camera, looking(Point3::new(0.0, y, 0.45), Point3::new(0.8, 0.05, 0.04))))
            .into();
        let images = cameras
            .iter()
            .zip(seed..)
            .map(|((camera, pose), seed)| picture(camera, pose, &truth, seed))
            .collect();
        let error = Vector3::new(0.0015, -0.0005, -0.001);
        let position = truth * Point3::new(0.05, 0.03, 0.01) + error;
        let covariance = Matrix3::from_diagonal(&Vector3::new(4e-6, 1e-6, 2e-6));
        Scene { images, cameras, truth, landmark: GaussianPoint { position, covariance } }
    }

    fn views(&self) -> Vec<View<'_>> {
        let views = self.images.iter().zip(&self.cameras);
        views
            .map(|(image, (camera, pose))| View {
                image,
                camera: *camera,
                base_from_optical: *pose,
                turn_sd: 0.0,
            })
            .collect()
    }

    fn query<'a>(&self, record: &'a Record, up: bool) -> Query<'a> {
        let up: Option<Unit<Vector3<f64>>> = up.then(Vector3::z_axis);
        Query { record, landmark: self.landmark, landmark_index: 0, up, standing: None }
    }

    fn error(&self, pose: &Transform) -> (f64, f64) {
        let turn = pose.rotation.angle_to(&self.truth.rotation).to_degrees();
        ((pose.translation.vector - self.truth.translation.vector).norm() * 1000.0, turn)
    }
}

#[test]
fn any_attitude_is_found_from_the_landmark_alone() {
    let record = record();
    for (seed, angles) in [(1, [0.5, 0.7, 2.8]), (2, [-0.4, -0.5, -2.7]), (3, [0.1, 0.3, 3.4])] {
        let rotation = UnitQuaternion::from_euler_angles(angles[0], angles[1], angles[2]);
        let scene = Scene::new(rotation, seed);
        let query = scene.query(&record, false);
        let found = directional::recognise(&scene.views(), &query, &Config::default()).unwrap();
        let (mm, deg) = scene.error(&found.pose.pose);
        assert!(mm < 2.0 && deg < 1.0, "seed {seed}: off by {mm:.2} mm, {deg:.2} degrees");
        assert!(found.confidence > 0.9 && found.coverage > 0.8);
    }
}

#[test]
fn a_standing_box_is_found_with_gravity() {
    let record = record();
    let scene = Scene::new(UnitQuaternion::from_euler_angles(0.0, 0.0, 2.6), 7);
    let query = scene.query(&record, true);
    let found = directional::recognise(&scene.views(), &query, &Config::default()).unwrap();
    let (mm, deg) = scene.error(&found.pose.pose);
    assert!(mm < 2.0 && deg < 0.5, "off by {mm:.2} mm, {deg:.2} degrees");
    let again = directional::recognise(&scene.views(), &query, &Config::default()).unwrap();
    assert_eq!(found, again);
}

#[test]
fn the_covariance_holds_the_truth_and_is_not_wide() {
    // 95 % points of chi-squared with six degrees of freedom.
    const CHI2_95: f64 = 12.592;
    let record = record();
    let mut noise = rand_pcg::Pcg32::seed_from_u64(5);
    let (mut answered, mut held, mut widest) = (0, 0, 0.0f64);
    for seed in 0..24 {
        let turn = noise.random_range(2.4..3.4);
        let tilts = [noise.random_range(-0.5..0.5), noise.random_range(-0.5..0.5)];
        let scene = Scene::new(UnitQuaternion::from_euler_angles(tilts[0], tilts[1], turn), seed);
        let query = scene.query(&record, false);
        let found = directional::recognise(&scene.views(), &query, &Config::default());
        let Ok(found) = found else { continue };
        let nees = found.pose.nees(&scene.truth).unwrap();
        answered += 1;
        held += usize::from(nees < CHI2_95);
        let variance: f64 = found.pose.covariance.diagonal().rows(3, 3).sum();
        widest = widest.max(variance.sqrt());
    }
    assert!(answered >= 22, "only {answered} of 24 answered");
    assert!(held * 10 >= answered * 9, "the 95 % ellipsoid holds {held} of {answered}");
    assert!(widest < 0.006, "a box 0.8 m away is stated to {:.1} mm only", 1e3 * widest);
}

#[test]
fn a_picture_without_the_object_is_refused() {
    let record = record();
    let mut scene = Scene::new(UnitQuaternion::from_euler_angles(0.0, 0.0, 2.6), 7);
    let away = Transform::translation(0.8, 5.0, 0.04);
    for (image, (camera, pose)) in scene.images.iter_mut().zip(&scene.cameras) {
        *image = picture(camera, pose, &away, 9);
    }
    let query = scene.query(&record, false);
    let result = directional::recognise(&scene.views(), &query, &Config::default());
    assert!(
        matches!(result, Err(Refusal::TooFewEdges { .. } | Refusal::Ambiguous { .. })),
        "{result:?}"
    );
}

#[test]
fn tracking_follows_a_small_move_and_reports_a_loss() {
    let record = record();
    let scene = Scene::new(UnitQuaternion::from_euler_angles(0.5, 0.7, 2.8), 11);
    let query = scene.query(&record, false);
    let step = nalgebra::Vector6::new(0.05, -0.03, 0.04, 0.002, 0.001, -0.002);
    let last = perturb(&scene.truth, &step);
    let found = directional::track(&scene.views(), &query, &last, &Config::default()).unwrap();
    let (mm, deg) = scene.error(&found.pose.pose);
    assert!(mm < 2.0 && deg < 1.0, "off by {mm:.2} mm, {deg:.2} degrees");
    let wrong = perturb(&scene.truth, &nalgebra::Vector6::new(0.8, 0.5, 0.0, 0.0, 0.0, 0.0));
    assert!(directional::track(&scene.views(), &query, &wrong, &Config::default()).is_err());
}

#[test]
fn nonsense_is_refused_by_name() {
    let record = record();
    let scene = Scene::new(UnitQuaternion::identity(), 1);
    let mut query = scene.query(&record, false);
    let config = Config::default();
    assert_eq!(directional::recognise(&[], &query, &config), Err(Refusal::NoView));
    query.landmark_index = 3;
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_eq!(result, Err(Refusal::NoLandmark(3)));
    query.landmark_index = 0;
    query.landmark.position = Point3::new(-1.0, 0.0, 0.0);
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_eq!(result, Err(Refusal::OutOfView));
    query.landmark.position.x = f64::NAN;
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_eq!(result, Err(Refusal::BadLandmark));
    let mut query = scene.query(&record, false);
    query.landmark.covariance *= 1e160;
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_eq!(result, Err(Refusal::BadLandmark));
    let mut query = scene.query(&record, false);
    query.up = Some(Unit::new_unchecked(Vector3::new(0.0, f64::NAN, 1.0)));
    let result = directional::recognise(&scene.views(), &query, &config);
    assert_eq!(result, Err(Refusal::BadVertical));
    let query = scene.query(&record, false);
    let mut views = scene.views();
    views[1].base_from_optical.translation.x = f64::NAN;
    let result = directional::recognise(&views, &query, &config);
    assert_eq!(result, Err(Refusal::BadPlace { view: 1 }));
}

#[test]
fn a_lens_that_bends_the_contour_far_outwards_takes_no_more_time() {
    // 30 cm from a large box with such a lens, ends of its edges are at billions of pixels.
    let mut record = record();
    record.bounding_box = BoundingBox { width: 0.3, length: 0.5, height: 0.4 };
    record.shape = Shape::Box;
    record.landmarks[0].position = [-0.15, 0.0, 0.0];
    record.landmarks[0].normal = [-1.0, 0.0, 0.0];
    let scene = Scene::new(UnitQuaternion::identity(), 1);
    let mut views = scene.views();
    for view in &mut views {
        view.camera.distortion.k1 = 0.1;
        view.camera.distortion.k3 = 5.0;
    }
    let eye = views[0].eye();
    let ahead = views[0].base_from_optical.rotation * Vector3::z();
    let mut query = scene.query(&record, false);
    query.landmark.position = eye + 0.2 * ahead;
    // Any answer will do, as long as it comes: without a bound this takes hours.
    let _ = directional::recognise(&views[..1], &query, &Config::default());
}
