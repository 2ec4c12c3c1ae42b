//! Stereo pictures of one tagged object with its truth, for measuring pose recognition in bulk.
//!
//! In: a seed. Out: two pictures of a random box, can or cup (fallen: or ball) among clutter, taken by
//! heads that have turned to its landmark; the record, the landmark as a triangulation would report it,
//! and the true pose. The light is dark in the pictures. Cameras are exact: what the head does not know
//! is in the landmark's error.

use std::sync::Arc;

use nalgebra::{Matrix3, Point3, Vector3};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_geometry::{Camera as Lens, GaussianPoint, Ray, Transform};
use vergence_imaging::Image;
use vergence_tag::{BoundingBox, LandmarkSite, Record, Semantic, Shape};

use crate::camera::{Capture, Sensor};
use crate::config::{ObjectSettings, Scenario, SimConfig, Surface};
use crate::error::SimError;
use crate::faces;
use crate::noise::{normal, stream};
use crate::placement::{RestView, compose};
use crate::trace::Stage;
use crate::workcell::{embedded_files, settings};

/// Standard deviation of the simulated landmark's direction from either camera (rad).
const ANGLE_SIGMA: f64 = 0.002;

/// A stereo pair of one object.
#[derive(Debug, Clone)]
pub struct StereoScene {
    /// Left and right picture.
    pub images: [Image<u8>; 2],
    /// Left and right lens.
    pub cameras: [Lens; 2],
    /// Left and right camera's pose.
    pub base_from_optical: [Transform; 2],
    /// What the tag tells.
    pub record: Record,
    /// The landmark as found (base), with its covariance.
    pub landmark: GaussianPoint,
    /// The true pose.
    pub base_from_object: Transform,
}

/// The scene of a seed.
pub fn stereo_scene(scenario: Scenario, seed: u64) -> Result<StereoScene, SimError> {
    let (config, description) = embedded_files()?;
    let mut rng = stream(seed, "stereo scene", 0);
    let mut sim: SimConfig = settings(&config)?;
    sim.scenario = scenario;
    sim.light.status_hz = 0.0;
    sim.led.housing = rng.random::<bool>();
    sim.objects = vec![random_object(scenario, &mut rng)];
    let mut chains = Vec::new();
    for side in vergence_devices::Side::BOTH {
        chains.push(description.chain("base", &config.head(side).optical_frame)?);
    }
    let lenses = [config.left.camera.model(), config.right.camera.model()];
    let rest = [0, 1]
        .map(|k| RestView { camera: lenses[k], base_from_optical: chains[k].forward(&[0.0, 0.0]) });
    let composition = compose(&sim, &rest, seed)?;
    let object = composition
        .objects
        .into_iter()
        .next()
        .ok_or_else(|| SimError::Table("no object".into()))?;
    let landmark =
        object.record.landmarks.first().map_or(Point3::origin(), |site| object.landmark(site));
    // The heads have fixated the landmark to within a servo step.
    let base_from_optical = [0, 1].map(|k| {
        let mut angles = [0.0, 0.0];
        for _ in 0..20 {
            let p = chains[k].forward(&angles).inverse_transform_point(&landmark);
            angles[0] -= p.x.atan2(p.z);
            angles[1] += p.y.atan2(p.z);
        }
        chains[k].forward(&angles.map(|a| a + rng.random_range(-0.003..0.003)))
    });
    let capture = Capture {
        sequence: 0,
        start: rng.random::<f64>(),
        base_from_optical,
        blinkers: Vec::new(),
        stage: Arc::new(Stage::new(composition.scene)),
    };
    let images = [0, 1].map(|side| {
        Sensor::new(lenses[side], sim.camera, &sim.light, seed, side).picture(&capture)
    });
    Ok(StereoScene {
        images,
        cameras: lenses,
        base_from_optical,
        landmark: triangulated(&landmark, &base_from_optical, &mut rng),
        record: object.record,
        base_from_object: object.base_from_object,
    })
}

/// The landmark as two rays with independent angle errors give it.
fn triangulated(
    landmark: &Point3<f64>,
    base_from_optical: &[Transform; 2],
    rng: &mut Pcg64Mcg,
) -> GaussianPoint {
    // Each ray informs across its direction only: sigma = distance * angle.
    let mut information = Matrix3::zeros();
    for pose in base_from_optical {
        let eye = Point3::from(pose.translation.vector);
        let way = landmark - eye;
        let ray = Ray { origin: eye, direction: nalgebra::Unit::new_normalize(way) };
        let d = ray.direction.into_inner();
        let sigma = ANGLE_SIGMA * way.norm();
        information += (Matrix3::identity() - d * d.transpose()) / (sigma * sigma);
    }
    let covariance = information.try_inverse().unwrap_or_else(|| Matrix3::identity() * 1e-4);
    let root = covariance.cholesky().map_or_else(Matrix3::zeros, |c| c.l());
    let error = root * Vector3::from_fn(|_, _| normal(rng));
    GaussianPoint { position: landmark + error, covariance }
}

/// Cross-sections of prisms in a square of side one: triangle, house, trapezium, hexagon, angle iron.
const PROFILES: [&[[f64; 2]]; 5] = [
    &[[-0.5, -0.5], [0.5, -0.5], [0.0, 0.5]],
    &[[-0.5, -0.5], [0.5, -0.5], [0.5, 0.1], [0.0, 0.5], [-0.5, 0.1]],
    &[[-0.5, -0.5], [0.5, -0.5], [0.3, 0.5], [-0.3, 0.5]],
    &[[-0.5, 0.0], [-0.25, -0.5], [0.25, -0.5], [0.5, 0.0], [0.25, 0.5], [-0.25, 0.5]],
    &[[-0.5, -0.5], [0.5, -0.5], [0.5, -0.1], [-0.1, -0.1], [-0.1, 0.5], [-0.5, 0.5]],
];

/// A length between two, to the millimetre, as a record would have it.
fn length(rng: &mut Pcg64Mcg, low: f64, high: f64) -> f64 {
    (1e3 * rng.random_range(low..high)).round() / 1e3
}

/// A box, can or cup, or where things have fallen a ball, prism or blunt pyramid too, of everyday size with
/// its landmark on the side.
fn random_object(scenario: Scenario, rng: &mut Pcg64Mcg) -> ObjectSettings {
    let surfaces = [Surface::Plain, Surface::Printed, Surface::Striped, Surface::Speckled];
    let surface = surfaces[rng.random_range(0..surfaces.len())];
    let kinds = if scenario == Scenario::Fallen { 6 } else { 3 };
    let kind = (length(rng, 0.0, f64::from(kinds)) as u32).min(kinds - 1);
    let height = length(rng, 0.05, 0.14);
    let (shape, sides) = match kind {
        0 => (Shape::Box, [length(rng, 0.05, 0.14), length(rng, 0.04, 0.1), height]),
        1 => {
            let diameter = length(rng, 0.05, 0.09);
            (Shape::Cylinder { diameter, height }, [diameter, diameter, height])
        }
        2 => {
            let top_diameter = length(rng, 0.06, 0.09);
            let bottom_diameter = (1e3 * top_diameter * length(rng, 0.65, 1.0)).round() / 1e3;
            let shape = Shape::Cup { top_diameter, bottom_diameter, height };
            (shape, [top_diameter, top_diameter, height])
        }
        3 => {
            let diameter = length(rng, 0.05, 0.1);
            (Shape::Sphere { diameter }, [diameter; 3])
        }
        4 => {
            let profile = PROFILES[rng.random_range(0..PROFILES.len())];
            let [x, y] = [0, 1].map(|_| length(rng, 0.05, 0.1));
            let outline = profile.iter().map(|c| [c[0] * x, c[1] * y]).collect();
            (Shape::Prism { outline, height }, [x, y, height])
        }
        _ => {
            let bottom = [0, 1].map(|_| length(rng, 0.06, 0.12));
            let top = bottom.map(|side| side * length(rng, 0.3, 0.9));
            let ring = |[x, y]: [f64; 2], z: f64| {
                [[-x, -y], [x, -y], [x, y], [-x, y]].map(|c| [0.5 * c[0], 0.5 * c[1], z])
            };
            let vertices = [ring(bottom, -0.5 * height), ring(top, 0.5 * height)];
            let vertices = vertices.into_iter().flatten().collect();
            (Shape::Convex { vertices }, [bottom[0], bottom[1], height])
        }
    };
    let (place, normal) = on_the_side(&shape, sides, rng);
    let position = place + normal * 0.001;
    let site = LandmarkSite { position: position.into(), normal: normal.into() };
    let text = |name: &str| name.parse().unwrap_or_default();
    let [width, length, height] = sides;
    ObjectSettings {
        record: Record {
            object_id: text("object"),
            landmarks: [site].into_iter().collect(),
            bounding_box: BoundingBox { width, length, height },
            shape,
            physical: Default::default(),
            semantic: Semantic { name: text("object"), ..Default::default() },
        },
        surface,
        handle: kind == 2 && rng.random::<bool>(),
        passkey: None,
        at: None,
        yaw_deg: None,
    }
}

/// A place on an object's surface with the normal there: on a wall, or amid a face that nothing of the object
/// hides.
fn on_the_side(shape: &Shape, sides: [f64; 3], rng: &mut Pcg64Mcg) -> (Vector3<f64>, Vector3<f64>) {
    if let Some(all) = faces::faces(shape) {
        let outermost = faces::outermost(&all);
        let shown: Vec<_> =
            all.iter().filter(|face| outermost.iter().any(|o| o.holds(face))).collect();
        if !shown.is_empty() {
            let face = shown[rng.random_range(0..shown.len())];
            return (face.middle().coords, face.normal);
        }
    }
    if matches!(shape, Shape::Sphere { .. }) {
        return (Vector3::x() * (0.5 * sides[0]), Vector3::x());
    }
    let z = length(rng, -0.1, 0.35) * sides[2];
    match *shape {
        Shape::Cup { top_diameter, bottom_diameter, height } => {
            let slope = 0.5 * (top_diameter - bottom_diameter) / height;
            let radius = 0.25 * (top_diameter + bottom_diameter) + slope * z;
            (Vector3::new(radius, 0.0, z), Vector3::new(1.0, 0.0, -slope).normalize())
        }
        _ => (Vector3::new(0.5 * sides[0], 0.0, z), Vector3::x()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_landmark_errors_are_honest() {
        // Normalised squared errors have mean 3 over many seeds; poses need no pictures for it.
        let poses = [0.1, -0.1].map(|y| Transform::translation(0.0, y, 0.45));
        let landmark = Point3::new(0.7, 0.2, 0.05);
        let mut rng = stream(1, "test", 0);
        let mean = (0..2000)
            .filter_map(|_| triangulated(&landmark, &poses, &mut rng).nees(&landmark))
            .sum::<f64>()
            / 2000.0;
        assert!((mean - 3.0).abs() < 0.2, "{mean}");
    }

    #[test]
    fn scenes_are_sound_and_repeat() {
        for seed in 0..6 {
            let scene = stereo_scene(Scenario::Default, seed).unwrap();
            assert_eq!(scene.record.validate(), Ok(()), "seed {seed}");
            let again = stereo_scene(Scenario::Default, seed).unwrap();
            assert!(scene.images == again.images && scene.landmark == again.landmark);
            for k in 0..2 {
                let centre = Point3::from(scene.base_from_object.translation.vector);
                let p = scene.base_from_optical[k].inverse_transform_point(&centre);
                let pixel = scene.cameras[k].project(&p).unwrap();
                assert!(scene.cameras[k].contains(&pixel, 20.0), "seed {seed}: {pixel}");
            }
        }
    }
}
