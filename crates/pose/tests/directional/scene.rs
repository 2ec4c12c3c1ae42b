//! Rendered scenes of one object with known truth, for the tests of whole recognitions.

use nalgebra::{Matrix3, Point3, Unit, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use vergence_geometry::{Camera, GaussianPoint, Transform};
use vergence_imaging::Image;
use vergence_pose::{Query, View};
use vergence_tag::Record;

/// What is drawn: bodies made of convex pieces.
pub enum Piece {
    /// The points p with `normal . p <= offset` for every plane.
    Flat(Vec<(Vector3<f64>, f64)>),
    /// About z, from `-half` to `half`.
    Cylinder { radius: f64, half: f64 },
    /// Of this radius, about a centre.
    Ball(f64, Point3<f64>),
}

impl Piece {
    /// A box between two corners.
    pub fn cuboid(low: [f64; 3], high: [f64; 3]) -> Self {
        let sides = (0..3).flat_map(|k| {
            let axis = Vector3::ith(k, 1.0);
            [(axis, high[k]), (-axis, -low[k])]
        });
        Piece::Flat(sides.collect())
    }

    /// Where a ray comes in, and the outward normal there.
    fn hit(&self, from: &Point3<f64>, ray: &Vector3<f64>) -> Option<(f64, Vector3<f64>)> {
        match self {
            Piece::Flat(planes) => {
                let (mut enter, mut leave) = ((0.0, Vector3::zeros()), f64::INFINITY);
                for (n, offset) in planes {
                    let (speed, gap) = (n.dot(ray), offset - n.dot(&from.coords));
                    match speed < 0.0 {
                        true if gap / speed > enter.0 => enter = (gap / speed, *n),
                        true => {}
                        false if speed > 0.0 => leave = leave.min(gap / speed),
                        false if gap < 0.0 => return None,
                        false => {}
                    }
                }
                (enter.0 > 0.0 && enter.0 < leave).then_some(enter)
            }
            Piece::Cylinder { radius, half } => {
                let (o, d) = (from.coords.xy(), ray.xy());
                let (a, b, c) = (d.norm_squared(), o.dot(&d), o.norm_squared() - radius * radius);
                let root = (b * b - a * c).max(0.0).sqrt();
                let wall = (-b - root) / a;
                let end = (half * -ray.z.signum() - from.z) / ray.z;
                let (t, n) = if wall > end {
                    (wall, (o + wall * d).push(0.0) / *radius)
                } else {
                    (end, Vector3::z() * -ray.z.signum())
                };
                let p = from + t * ray;
                let within = p.coords.xy().norm() < radius + 1e-9 && p.z.abs() < half + 1e-9;
                (t > 0.0 && within && b * b > a * c).then_some((t, n))
            }
            Piece::Ball(radius, centre) => {
                let o = from - centre;
                let (a, b) = (ray.norm_squared(), o.dot(ray));
                let inside = b * b - a * (o.norm_squared() - radius * radius);
                let t = (-b - inside.max(0.0).sqrt()) / a;
                (inside > 0.0 && t > 0.0).then(|| (t, (o + t * ray) / *radius))
            }
        }
    }
}

/// A camera at `eye` that looks at `target`, in base coordinates.
pub fn looking(eye: Point3<f64>, target: Point3<f64>) -> Transform {
    let forward = (target - eye).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(axes);
    Transform::from_parts(eye.coords.into(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// Grey value that a ray sees: matt pieces lit from one side, over a plain ground.
fn shade(pieces: &[Piece], object: &Transform, eye: &Point3<f64>, ray: &Vector3<f64>) -> f64 {
    let o = object.inverse_transform_point(eye);
    let d = object.inverse_transform_vector(ray);
    let hits = pieces.iter().filter_map(|piece| piece.hit(&o, &d));
    match hits.min_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((_, n)) => 145.0 + 55.0 * n.dot(&Vector3::new(-0.48, 0.37, 0.795)),
        None => 60.0,
    }
}

/// A picture with nine rays a pixel and sensor noise of two grey levels.
pub fn picture(
    camera: &Camera,
    pose: &Transform,
    (pieces, object): (&[Piece], &Transform),
    seed: u64,
) -> Image<u8> {
    let mut noise = rand_pcg::Pcg32::seed_from_u64(seed);
    let eye = Point3::from(pose.translation.vector);
    Image::from_fn(camera.width, camera.height, |x, y| {
        let mut sum = 0.0;
        for k in 0..9 {
            let at = |i: usize| (i as f64 - 1.0) / 3.0;
            let pixel = nalgebra::Point2::new(x as f64 + at(k % 3), y as f64 + at(k / 3));
            sum += shade(pieces, object, &eye, &(pose * camera.unproject(&pixel)));
        }
        let gauss: f64 = (0..4).map(|_| noise.random_range(-1.0..1.0)).sum::<f64>() * 1.73;
        (sum / 9.0 + gauss).clamp(0.0, 255.0) as u8
    })
}

/// Two cameras before an object.
pub struct Scene {
    pub images: Vec<Image<u8>>,
    pub cameras: Vec<(Camera, Transform)>,
    pub truth: Transform,
    pub landmark: GaussianPoint,
}

impl Scene {
    /// The object of a record, drawn by pieces in its frame, in this attitude.
    pub fn new(
        record: &Record,
        pieces: &[Piece],
        rotation: UnitQuaternion<f64>,
        seed: u64,
    ) -> Self {
        let truth = Transform::from_parts(Vector3::new(0.8, 0.05, 0.04).into(), rotation);
        let camera = Camera::centred(320, 240, 300.0);
        let cameras: Vec<_> = [0.15, -0.15]
            .map(|y| (camera, looking(Point3::new(0.0, y, 0.45), Point3::new(0.8, 0.05, 0.04))))
            .into();
        let images = cameras
            .iter()
            .zip(seed..)
            .map(|((camera, pose), seed)| picture(camera, pose, (pieces, &truth), seed))
            .collect();
        let error = Vector3::new(0.0015, -0.0005, -0.001);
        let position = truth * Point3::from(record.landmarks[0].position) + error;
        let covariance = Matrix3::from_diagonal(&Vector3::new(4e-6, 1e-6, 2e-6));
        Scene { images, cameras, truth, landmark: GaussianPoint { position, covariance } }
    }

    pub fn views(&self) -> Vec<View<'_>> {
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

    pub fn query<'a>(&self, record: &'a Record, up: bool) -> Query<'a> {
        let up: Option<Unit<Vector3<f64>>> = up.then(Vector3::z_axis);
        Query { record, landmark: self.landmark, landmark_index: 0, up, standing: None }
    }
}
