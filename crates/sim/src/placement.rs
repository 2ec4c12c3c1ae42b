//! Composes the scene: table, room, lamps, tagged objects and clutter, chosen by the seed.
//!
//! Promises: nothing interpenetrates; every tagged object stands on the table (in the scenario "fallen"
//! on any of its sides), its landmark faces the heads and is in line of sight of both; at the heads'
//! rest it is outside both pictures; in the scenario "occluded" something hides a part of the cup but
//! not its landmark; in the scenario "reach" the first object called cup stands where the arm reaches
//! it.

use std::ops::Range;

use nalgebra::{Point3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_geometry::{Camera, Transform};
use vergence_tag::{LandmarkSite, Record};

use crate::config::{ObjectSettings, Scenario, SimConfig, Surface};
use crate::error::SimError;
use crate::noise::stream;
use crate::scene::{Body, Emitter, Material, Scene};
use crate::trace::{LANES, Placed, Solid, Texture, V3, is_clear};

mod bodies;
mod rest;
mod room;

pub use bodies::object_bodies;
use bodies::{clutter_solid, material};
use rest::{Rest, lies_on};
use room::room;

/// Extent of the table top (m, base): x from, x to, |y| up to.
const TABLE: [f64; 3] = [0.15, 1.35, 0.9];
/// Where objects may stand (m, base).
const FIELD: [f64; 3] = [0.42, 1.05, 0.6];
/// Where the object that the arm is to grasp stands: within its reach (m, base; x from, to, y from, to).
const REACH: [f64; 4] = [0.45, 0.78, -0.3, 0.15];
/// The disc on the table that the arm's pedestal takes: x, y, radius (m).
const PEDESTAL: [f64; 3] = [0.2, -0.38, 0.1];
/// Cosine between a fallen object's landmark and the way to an eye, at least.
const SHINES: f64 = 0.3;
/// Attempts to find a place for one thing before giving up.
const ATTEMPTS: usize = 1000;
/// Arrangements that are begun before giving up.
const ARRANGEMENTS: u64 = 20;

/// What the composition needs to know of a head: its camera at rest.
#[derive(Debug, Clone, Copy)]
pub struct RestView {
    /// Lens.
    pub camera: Camera,
    /// Pose at rest.
    pub base_from_optical: Transform,
}

/// A tagged object in its place.
#[derive(Debug, Clone)]
pub struct TaggedObject {
    /// Its record.
    pub record: Record,
    /// Its pose.
    pub base_from_object: Transform,
}

impl TaggedObject {
    /// Position of a landmark in the base frame.
    pub fn landmark(&self, site: &LandmarkSite) -> Point3<f64> {
        self.base_from_object * Point3::from(site.position)
    }

    /// Outward normal of a landmark in the base frame.
    pub fn normal(&self, site: &LandmarkSite) -> Unit<Vector3<f64>> {
        Unit::new_normalize(self.base_from_object.rotation * Vector3::from(site.normal))
    }
}

/// A scene with what blinks in it.
#[derive(Debug, Clone)]
pub struct Composition {
    /// What is seen.
    pub scene: Scene,
    /// Tagged objects in the order of the configuration.
    pub objects: Vec<TaggedObject>,
    /// Which bodies of the scene belong to each of them.
    pub bodies_of: Vec<Range<usize>>,
    /// Untagged things on the table with their places.
    pub clutter: Vec<(Transform, Solid)>,
    /// A status light that blinks by itself.
    pub status: Option<Emitter>,
}

/// Composes the scene of a seed. An arrangement that leaves no place for something is begun anew.
pub fn compose(
    config: &SimConfig,
    views: &[RestView; 2],
    seed: u64,
) -> Result<Composition, SimError> {
    let mut last = compose_once(config, views, stream(seed, "placement", 0));
    for attempt in 1..ARRANGEMENTS {
        match last {
            Err(SimError::NoPlace(_)) => {
                last = compose_once(config, views, stream(seed, "placement", attempt));
            }
            settled => return settled,
        }
    }
    last
}

fn compose_once(
    config: &SimConfig,
    views: &[RestView; 2],
    mut rng: Pcg64Mcg,
) -> Result<Composition, SimError> {
    let mut builder = Builder {
        scene: room(&config.light, &mut rng),
        taken: Vec::new(),
        scenario: config.scenario,
        views: *views,
        eyes: views.map(|v| Point3::from(v.base_from_optical.translation.vector)),
        housing: config.led.housing,
        clutter: Vec::new(),
    };
    if config.scenario == Scenario::Reach {
        builder.taken.push(PEDESTAL);
    }
    let (mut objects, mut bodies_of) = (Vec::new(), Vec::new());
    for settings in &config.objects {
        let first = builder.scene.bodies.len();
        objects.push(builder.place_object(settings, &mut rng)?);
        bodies_of.push(first..builder.scene.bodies.len());
    }
    // A later object may stand before an earlier one's light: then the arrangement is drawn anew.
    for (object, _) in objects.iter().zip(&config.objects).filter(|(_, s)| s.at.is_none()) {
        let mut lights = object.record.landmarks.iter().map(|site| object.landmark(site));
        if !lights.all(|light| builder.in_sight(&light)) {
            return Err(SimError::NoPlace(object.record.object_id.to_string()));
        }
    }
    if config.scenario == Scenario::Occluded {
        let cup = objects.iter().position(|o| o.record.object_id.as_str() == "cup");
        if let Some(target) = cup.or(objects.len().checked_sub(1)) {
            builder.occlude(&objects[target], &objects, &mut rng)?;
        }
    }
    let status = (config.light.status_hz > 0.0)
        .then(|| builder.status_box(&objects, &mut rng))
        .flatten()
        .map(|(position, normal)| Emitter {
            position,
            normal,
            lobe: 0.5,
            diameter: 0.003,
            flux_px: 2.0,
        });
    for _ in 0..config.clutter {
        builder.add_clutter(&objects, &mut rng);
    }
    let Builder { scene, clutter, .. } = builder;
    Ok(Composition { scene, objects, bodies_of, clutter, status })
}

struct Builder {
    scene: Scene,
    /// Discs on the table that are taken: x, y, radius (m).
    taken: Vec<[f64; 3]>,
    scenario: Scenario,
    views: [RestView; 2],
    eyes: [Point3<f64>; 2],
    housing: bool,
    /// Untagged things with their places.
    clutter: Vec<(Transform, Solid)>,
}

impl Builder {
    fn free(&self, x: f64, y: f64, radius: f64) -> bool {
        self.taken.iter().all(|&[a, b, r]| (x - a).hypot(y - b) > r + radius + 0.008)
    }

    /// True when no part of a ball is in a picture of the heads at rest.
    fn unseen_at_rest(&self, centre: &Point3<f64>, radius: f64) -> bool {
        self.views.iter().all(|view| {
            let p = view.base_from_optical.inverse_transform_point(centre);
            if p.z <= radius {
                return true;
            }
            view.camera.project(&p).is_none_or(|pixel| {
                let margin = -1.3 * radius * view.camera.fx / p.z - 4.0;
                !view.camera.contains(&pixel, margin)
            })
        })
    }

    /// True when nothing stands between a point and either eye.
    fn in_sight(&self, point: &Point3<f64>) -> bool {
        self.eyes.iter().all(|eye| {
            let from = to_single(point);
            let to = to_single(eye);
            is_clear(&self.scene, &[from; LANES], &[to; LANES])[0]
        })
    }

    /// True when an object's landmarks shine at both eyes.
    fn is_faced(&self, object: &TaggedObject) -> bool {
        object.record.landmarks.iter().all(|site| {
            let (place, normal) = (object.landmark(site), object.normal(site));
            self.eyes.iter().all(|eye| normal.dot(&(eye - place).normalize()) > SHINES)
        })
    }

    fn place_object(
        &mut self,
        settings: &ObjectSettings,
        rng: &mut Pcg64Mcg,
    ) -> Result<TaggedObject, SimError> {
        let record = &settings.record;
        let near = self.scenario == Scenario::Reach && record.object_id.as_str() == "cup";
        let [x0, x1, y0, y1] = if near { REACH } else { [FIELD[0], FIELD[1], -FIELD[2], FIELD[2]] };
        let lies_on = lies_on(&record.shape);
        for _ in 0..ATTEMPTS {
            let [x, y] =
                settings.at.unwrap_or_else(|| [rng.random_range(x0..x1), rng.random_range(y0..y1)]);
            let rest = match self.scenario {
                Scenario::Fallen => Rest::any(settings, &lies_on, rng),
                _ => Rest::upright(settings),
            };
            let radius = rest.radius;
            // The first landmark's azimuth, turned towards the heads and off by up to 35 degrees.
            let normal = record.landmarks.first().map_or([1.0, 0.0, 0.0], |site| site.normal);
            let normal = rest.turn * Vector3::from(normal);
            let facing = (-y).atan2(-x) - normal.y.atan2(normal.x);
            let yaw = match settings.yaw_deg {
                Some(degrees) => degrees.to_radians(),
                None => facing + rng.random_range(-0.6..0.6),
            };
            let base_from_object = Transform::from_parts(
                Translation3::new(x, y, rest.height),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw) * rest.turn,
            );
            let object = TaggedObject { record: record.clone(), base_from_object };
            let fixed = settings.at.is_some();
            let fits = self.free(x, y, radius)
                && (fixed
                    || self.unseen_at_rest(
                        &Point3::new(x, y, rest.height),
                        0.5 * record.bounding_box.diagonal(),
                    ))
                && record
                    .landmarks
                    .iter()
                    .all(|site| fixed || self.in_sight(&object.landmark(site)))
                && (self.scenario != Scenario::Fallen || self.is_faced(&object));
            if fits {
                let bodies = object_bodies(settings, &base_from_object, self.housing, rng)?;
                self.scene.bodies.extend(bodies);
                self.taken.push([x, y, radius]);
                return Ok(object);
            }
            if fixed {
                break;
            }
        }
        Err(SimError::NoPlace(record.object_id.to_string()))
    }

    /// Adds a body unless it hides more of the objects than allowed; returns whether it stayed.
    fn try_add(
        &mut self,
        body: Body,
        objects: &[TaggedObject],
        hides: impl Fn(&Self) -> bool,
    ) -> bool {
        let before = self.scene.bodies.len();
        self.scene.bodies.push(body);
        let landmarks_seen = objects
            .iter()
            .flat_map(|o| o.record.landmarks.first().map(|site| o.landmark(site)))
            .all(|p| self.in_sight(&p));
        let stays = landmarks_seen && hides(self);
        if !stays {
            self.scene.bodies.truncate(before);
        }
        stays
    }

    /// Share of an object's volume (probed at points of its box) that a body hides from an eye,
    /// larger of the two eyes.
    fn hidden_share(&self, object: &TaggedObject, blocker: &Placed) -> [f64; 2] {
        let half = object.record.bounding_box.sides().map(|s| 0.5 * s);
        let mut probe = Scene::default();
        probe.bodies.push(Body {
            placed: blocker.clone(),
            material: Material::matt(0.5, Texture::Plain, 0),
            shadow: true,
            mirror: false,
        });
        self.eyes.map(|eye| {
            let (mut hidden, mut count) = (0, 0);
            for k in 0..64u32 {
                let unit = [k & 3, k >> 2 & 3, k >> 4].map(|j| f64::from(j) / 1.5 - 1.0);
                let p = object.base_from_object
                    * Point3::new(unit[0] * half[0], unit[1] * half[1], unit[2] * half[2]);
                let clear = is_clear(&probe, &[to_single(&p); LANES], &[to_single(&eye); LANES]);
                hidden += usize::from(!clear[0]);
                count += 1;
            }
            f64::from(hidden as u32) / f64::from(count)
        })
    }

    /// Puts something upright before an object: it hides 15 to 50 % of it, but not the landmark.
    fn occlude(
        &mut self,
        target: &TaggedObject,
        objects: &[TaggedObject],
        rng: &mut Pcg64Mcg,
    ) -> Result<(), SimError> {
        let p = target.base_from_object.translation.vector;
        for _ in 0..ATTEMPTS {
            let half = [
                rng.random_range(0.012..0.03),
                rng.random_range(0.02..0.05),
                rng.random_range(0.02..0.09f64),
            ];
            let away = rng.random_range(0.06..0.16);
            let along = (-p.y).atan2(-p.x) + rng.random_range(-0.9..0.9);
            let (x, y) = (p.x + away * along.cos(), p.y + away * along.sin());
            let radius = half[0].hypot(half[1]);
            if !self.free(x, y, radius) || x < TABLE[0] + radius {
                continue;
            }
            let place = Transform::from_parts(
                Translation3::new(x, y, half[2]),
                UnitQuaternion::from_euler_angles(0.0, 0.0, along + rng.random_range(-0.5..0.5)),
            );
            let solid = Solid::Box(half.map(|h| h as f32));
            let surface = material(Surface::Printed, &solid, rng);
            let body = Body::new(solid.clone(), &place, surface);
            let share = self.hidden_share(target, &body.placed);
            let partly = share.iter().all(|s| (0.15..0.5).contains(s));
            if partly && self.try_add(body, objects, |_| true) {
                self.clutter.push((place, solid));
                self.taken.push([x, y, radius]);
                return Ok(());
            }
        }
        Err(SimError::NoPlace("occluder".into()))
    }

    /// A small box with a status light that faces the heads; the light's place and axis.
    fn status_box(
        &mut self,
        objects: &[TaggedObject],
        rng: &mut Pcg64Mcg,
    ) -> Option<(Point3<f64>, Unit<Vector3<f64>>)> {
        for _ in 0..ATTEMPTS {
            let (x, y): (f64, f64) = (rng.random_range(0.5..1.2), rng.random_range(-0.7..0.7));
            let yaw = (-y).atan2(-x) + rng.random_range(-0.3..0.3);
            let half = [0.05, 0.08, 0.018];
            if !self.free(x, y, 0.095) {
                continue;
            }
            let place = Transform::from_parts(
                Translation3::new(x, y, half[2]),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
            );
            let surface = Material::matt(0.09, Texture::Plain, 5).glossy(0.04);
            let solid = Solid::Box(half.map(|h| h as f32));
            let body = Body::new(solid.clone(), &place, surface);
            let clear_of = |builder: &Self| builder.hides_little(objects);
            if self.try_add(body, objects, clear_of) {
                self.clutter.push((place, solid));
                self.taken.push([x, y, 0.095]);
                let position = place * Point3::new(half[0] + 0.001, 0.04, 0.004);
                let normal = Unit::new_normalize(place.rotation * Vector3::x());
                return Some((position, normal));
            }
        }
        None
    }

    /// The newest body hides at most 3 % of every tagged object.
    fn hides_little(&self, objects: &[TaggedObject]) -> bool {
        let Some(newest) = self.scene.bodies.last() else { return true };
        objects.iter().all(|o| self.hidden_share(o, &newest.placed).iter().all(|&s| s < 0.03))
    }

    /// One untagged thing; left out when the table is full.
    fn add_clutter(&mut self, objects: &[TaggedObject], rng: &mut Pcg64Mcg) {
        for _ in 0..200 {
            let (solid, height, radius) = clutter_solid(rng);
            let x = rng.random_range(TABLE[0] + 0.15..TABLE[1] - 0.08);
            let y = rng.random_range(-TABLE[2] + 0.1..TABLE[2] - 0.1);
            if !self.free(x, y, radius) {
                continue;
            }
            let yaw = rng.random_range(-3.1..3.1);
            let place = Transform::from_parts(
                Translation3::new(x, y, height),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
            );
            let kind = [Surface::Plain, Surface::Printed, Surface::Striped, Surface::Speckled]
                [rng.random_range(0..4)];
            let surface = material(kind, &solid, rng);
            let body = Body::new(solid.clone(), &place, surface);
            if self.try_add(body, objects, |builder| builder.hides_little(objects)) {
                self.clutter.push((place, solid));
                self.taken.push([x, y, radius]);
                return;
            }
        }
    }
}

/// A point in single precision.
pub fn to_single(p: &Point3<f64>) -> V3 {
    [p.x as f32, p.y as f32, p.z as f32]
}
