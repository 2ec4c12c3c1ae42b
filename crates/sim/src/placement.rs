//! Composes the scene: table, room, lamps, tagged objects and clutter, chosen by the seed.
//!
//! Promises: nothing interpenetrates; every tagged object stands on the table, its landmark faces
//! the heads and is in line of sight of both; at the heads' rest it is outside both pictures; in the
//! scenario "occluded" something hides a part of the cup but not its landmark.

use std::ops::Range;

use nalgebra::{Point3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_geometry::{Camera, Transform};
use vergence_tag::{LandmarkSite, Record, Shape};

use crate::config::{LightSettings, ObjectSettings, Scenario, SimConfig, Surface};
use crate::error::SimError;
use crate::noise::stream;
use crate::scene::{Body, Emitter, Lamp, Layer, Material, Scene};
use crate::trace::{LANES, Placed, Solid, Texture, V3, is_clear};

/// Extent of the table top (m, base): x from, x to, |y| up to.
const TABLE: [f64; 3] = [0.15, 1.35, 0.9];
/// Where objects may stand (m, base).
const FIELD: [f64; 3] = [0.42, 1.05, 0.6];
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
        views: *views,
        eyes: views.map(|v| Point3::from(v.base_from_optical.translation.vector)),
        housing: config.led.housing,
        clutter: Vec::new(),
    };
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

/// Bodies of a tagged object and of the housing of its tag.
pub fn object_bodies(
    settings: &ObjectSettings,
    base_from_object: &Transform,
    housing: bool,
    rng: &mut Pcg64Mcg,
) -> Result<Vec<Body>, SimError> {
    let record = &settings.record;
    let [w, l, h] = record.bounding_box.sides();
    let solid = match &record.shape {
        Shape::Box => Solid::Box([w, l, h].map(|s| 0.5 * s as f32)),
        Shape::Cylinder { diameter, height } => Solid::Frustum {
            bottom: 0.5 * *diameter as f32,
            top: 0.5 * *diameter as f32,
            half: 0.5 * *height as f32,
        },
        Shape::Cup { top_diameter, bottom_diameter, height } => Solid::Cup {
            bottom: 0.5 * *bottom_diameter as f32,
            top: 0.5 * *top_diameter as f32,
            half: 0.5 * *height as f32,
            wall: (0.04 * *top_diameter as f32).clamp(0.0015, 0.005),
        },
        Shape::Sphere { diameter } => Solid::Sphere(0.5 * *diameter as f32),
        Shape::Prism { .. } | Shape::Convex { .. } => {
            return Err(SimError::Shape(record.object_id.to_string()));
        }
    };
    let surface = material(settings.surface, &solid, rng);
    let mut bodies = vec![Body::new(solid, base_from_object, surface)];
    if let (Shape::Cup { top_diameter, bottom_diameter, height }, true) =
        (&record.shape, settings.handle)
    {
        let radius = 0.25 * (top_diameter + bottom_diameter);
        bodies.extend(handle(radius, *height, base_from_object, surface));
    }
    if housing {
        for site in &record.landmarks {
            bodies.push(tag_housing(site, base_from_object));
        }
    }
    Ok(bodies)
}

/// A bow of capsules opposite to the usual place of the landmark.
fn handle(
    radius: f64,
    height: f64,
    base_from_object: &Transform,
    surface: Material,
) -> impl Iterator<Item = Body> {
    let (reach, rise, thick) = (0.3 * height, 0.3 * height, 0.05 * height);
    let plain = Material { texture: Texture::Plain, ..surface };
    let base_from_object = *base_from_object;
    let at = move |k: usize| {
        let angle = std::f64::consts::PI * (k as f64 / 7.0 - 0.5);
        Point3::new(0.0, -radius - reach * angle.cos(), rise * angle.sin())
    };
    (0..7).map(move |k| {
        let (a, b) = (at(k), at(k + 1));
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &(b - a)).unwrap_or_default();
        let place = Transform::from_parts(Translation3::from(nalgebra::center(&a, &b)), turn);
        let solid = Solid::Capsule { half: 0.5 * (b - a).norm() as f32, radius: thick as f32 };
        Body::new(solid, &(base_from_object * place), plain)
    })
}

/// A dark plate around the LED, just below the emitter's face.
fn tag_housing(site: &LandmarkSite, base_from_object: &Transform) -> Body {
    let normal = Vector3::from(site.normal);
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &normal).unwrap_or_default();
    // Its outer face lies 0.5 mm behind the emitter, its inner one within the wall.
    let centre = Vector3::from(site.position) - normal * 0.0013;
    let place = Transform::from_parts(Translation3::from(centre), turn);
    let solid = Solid::Frustum { bottom: 0.006, top: 0.006, half: 0.0008 };
    let mut body = Body::new(
        solid,
        &(base_from_object * place),
        Material::matt(0.06, Texture::Plain, 1).glossy(0.02),
    );
    body.shadow = false;
    body
}

fn material(surface: Surface, solid: &Solid, rng: &mut Pcg64Mcg) -> Material {
    let seed: u32 = rng.random();
    let albedo = rng.random_range(0.2..0.75f32);
    let (around, height) = match *solid {
        Solid::Frustum { bottom, top, half } | Solid::Cup { bottom, top, half, .. } => {
            (std::f32::consts::PI * (bottom + top), 2.0 * half)
        }
        _ => (0.1, 0.1),
    };
    let texture = match surface {
        Surface::Plain => Texture::Plain,
        Surface::Printed => Texture::Print { size: [0.5 * around, height] },
        Surface::Striped => Texture::Stripes { width: 0.18 * height, ratio: 0.4 },
        Surface::Speckled => Texture::Grain { size: 0.02, contrast: 0.5 },
    };
    Material::matt(albedo, texture, seed).glossy(rng.random_range(0.01..0.05))
}

/// Table, floor, walls and lamps.
fn room(light: &LightSettings, rng: &mut Pcg64Mcg) -> Scene {
    let slab = |half: V3, x: f64, y: f64, z: f64, material: Material| {
        let mut body = Body::new(Solid::Box(half), &Transform::translation(x, y, z), material);
        body.shadow = false;
        body
    };
    let seed: u32 = rng.random();
    let wood = Material::matt(0.34, Texture::Wood, seed).glossy(0.035);
    let wall = |albedo, k| Material::matt(albedo, Texture::Backdrop, seed.wrapping_add(k));
    let floor = Material::matt(0.2, Texture::Grain { size: 0.3, contrast: 0.6 }, seed);
    let half_x = (0.5 * (TABLE[1] - TABLE[0])) as f32;
    let mid_x = 0.5 * (TABLE[0] + TABLE[1]);
    let mut table = slab([half_x, TABLE[2] as f32, 0.02], mid_x, 0.0, -0.02, wood);
    table.mirror = true;
    let mut bodies = vec![
        table,
        slab([3.0, 3.0, 0.05], 1.0, 0.0, -0.8, floor),
        slab([0.05, 3.0, 1.8], 2.6, 0.0, 1.0, wall(0.55, 1)),
        slab([2.5, 0.05, 1.8], 0.8, 2.2, 1.0, wall(0.5, 2)),
        slab([2.5, 0.05, 1.8], 0.8, -2.2, 1.0, wall(0.5, 3)),
        slab([3.0, 3.0, 0.05], 1.0, 0.0, 2.7, Material::matt(0.7, Texture::Plain, seed)),
    ];
    if light.screen {
        let picture = Texture::Grain { size: 0.2, contrast: 0.9 };
        let dark = Material { glow: 0.5, ..Material::matt(0.5, picture, seed) };
        bodies.push(slab([0.01, 0.3, 0.17], 2.4, rng.random_range(-0.8..0.8), 0.35, dark));
    }
    let b = light.brightness as f32;
    let side = if rng.random::<bool>() { 1.0f32 } else { -1.0 };
    let at = |x: f32, y: f32, z: f32| [x, side * y, z];
    let lamps = vec![
        // A ceiling tube, flickering with the mains, and a window beside the table.
        Lamp {
            centre: at(rng.random_range(0.3..0.9), rng.random_range(0.1..0.6), 2.2),
            edges: [[0.6, 0.0, 0.0], [0.0, 0.06, 0.0]],
            intensity: 2.4 * b,
            layer: Layer::Lamp,
        },
        Lamp {
            centre: at(rng.random_range(-0.2..0.5), -1.9, 1.3),
            edges: [[0.16, 0.0, 0.0], [0.0, 0.0, 0.22]],
            intensity: 5.0 * b,
            layer: Layer::Steady,
        },
    ];
    Scene { bodies, lamps, ambient: [0.1 * b, 0.06 * b], table_height: 0.0 }
}

struct Builder {
    scene: Scene,
    /// Discs on the table that are taken: x, y, radius (m).
    taken: Vec<[f64; 3]>,
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

    fn place_object(
        &mut self,
        settings: &ObjectSettings,
        rng: &mut Pcg64Mcg,
    ) -> Result<TaggedObject, SimError> {
        let record = &settings.record;
        let [w, l, h] = record.bounding_box.sides();
        let mut radius = 0.5 * w.hypot(l);
        if settings.handle {
            radius += 0.35 * h;
        }
        for _ in 0..ATTEMPTS {
            let [x, y] = settings.at.unwrap_or_else(|| {
                [rng.random_range(FIELD[0]..FIELD[1]), rng.random_range(-FIELD[2]..FIELD[2])]
            });
            // The first landmark's azimuth, turned towards the heads and off by up to 35 degrees.
            let normal = record.landmarks.first().map_or([1.0, 0.0, 0.0], |site| site.normal);
            let facing = (-y).atan2(-x) - normal[1].atan2(normal[0]);
            let yaw = match settings.yaw_deg {
                Some(degrees) => degrees.to_radians(),
                None => facing + rng.random_range(-0.6..0.6),
            };
            let base_from_object = Transform::from_parts(
                Translation3::new(x, y, 0.5 * h),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
            );
            let object = TaggedObject { record: record.clone(), base_from_object };
            let fixed = settings.at.is_some();
            let fits = self.free(x, y, radius)
                && (fixed
                    || self.unseen_at_rest(
                        &Point3::new(x, y, 0.5 * h),
                        0.5 * record.bounding_box.diagonal(),
                    ))
                && record
                    .landmarks
                    .iter()
                    .all(|site| fixed || self.in_sight(&object.landmark(site)));
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
            let body = Body::new(solid, &place, surface);
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
            let body = Body::new(solid, &place, surface);
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
            let body = Body::new(solid, &place, material(kind, &solid, rng));
            if self.try_add(body, objects, |builder| builder.hides_little(objects)) {
                self.clutter.push((place, solid));
                self.taken.push([x, y, radius]);
                return;
            }
        }
    }
}

/// A box, book, can, cone, ball or mug; with the height of its centre and its radius on the table.
fn clutter_solid(rng: &mut Pcg64Mcg) -> (Solid, f64, f64) {
    let mut size = |low: f64, high: f64| rng.random_range(low..high);
    let pick = size(0.0, 6.0) as u32;
    match pick {
        0 | 1 => {
            let half = [size(0.02, 0.06), size(0.02, 0.06), size(0.02, 0.08)];
            (Solid::Box(half.map(|h| h as f32)), half[2], half[0].hypot(half[1]))
        }
        2 => {
            let half = [size(0.07, 0.1), size(0.09, 0.13), size(0.008, 0.02)];
            (Solid::Box(half.map(|h| h as f32)), half[2], half[0].hypot(half[1]))
        }
        3 => {
            let (radius, half) = (size(0.025, 0.05), size(0.03, 0.08));
            let r = radius as f32;
            (Solid::Frustum { bottom: r, top: r, half: half as f32 }, half, radius)
        }
        4 => {
            let (radius, half) = (size(0.03, 0.045), size(0.03, 0.06));
            let (top, bottom) = (radius as f32, 0.8 * radius as f32);
            (Solid::Cup { bottom, top, half: half as f32, wall: 0.003 }, half, radius)
        }
        _ => {
            let radius = size(0.025, 0.045);
            (Solid::Sphere(radius as f32), radius, radius)
        }
    }
}

/// A point in single precision.
pub fn to_single(p: &Point3<f64>) -> V3 {
    [p.x as f32, p.y as f32, p.z as f32]
}
