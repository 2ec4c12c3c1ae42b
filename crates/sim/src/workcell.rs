//! The workcell as its user sees it: built from a configuration, opened as a robot.

use std::collections::VecDeque;
use std::io;
use std::net::TcpListener;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use nalgebra::{Matrix3, Point3, Rotation3, Unit, UnitQuaternion, Vector3};
use rand::RngExt;
use vergence_devices::config::HandTag;
use vergence_devices::{Clock, Config, Description, Head, Robot, Side};
use vergence_geometry::{Camera as Lens, Chain, Solid, Transform};
use vergence_imaging::Image;
use vergence_link::HciLink;
use vergence_tag::{Pattern, Record, pattern::Bits};

use crate::camera::{Blinker, Capture, Sensor};
use crate::config::{GeometryError, ObjectSettings, Scenario, SimConfig};
use crate::devices::{SimCamera, SimClock, SimPanTilt};
use crate::error::SimError;
use crate::faces::hull;
use crate::lights::Play;
use crate::noise::{normal, stream};
use crate::placement::{RestView, TaggedObject, compose};
use crate::radio::{self, Radio};
use crate::scene::{Body, Material};
use crate::servo::Servo;
use crate::trace::{self, Stage, Texture};
use crate::world::{Shared, Shutter, TrueHead, World, lock};
use crate::{EMBEDDED_CONFIG, EMBEDDED_URDF};

/// A simulated workcell.
pub struct Workcell {
    config: Config,
    description: Description,
    settings: SimConfig,
    seed: u64,
    world: Shared,
}

/// What is really so: for judging results, never for producing them.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    /// Tagged objects.
    pub objects: Vec<TrueObject>,
    /// Left and right camera as they are now.
    pub cameras: [TrueCamera; 2],
    /// Untagged things on the table: place and form, cups and cones as the cylinder around them.
    pub clutter: Vec<(Transform, Solid)>,
}

/// A tagged object as it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueObject {
    /// Its identifier.
    pub id: String,
    /// Its record, as its tag tells it.
    pub record: Record,
    /// Its pose.
    pub base_from_object: Transform,
    /// Its LEDs (base frame).
    pub landmarks: Vec<Point3<f64>>,
}

/// A camera as it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrueCamera {
    /// Lens.
    pub lens: Lens,
    /// Pose.
    pub base_from_optical: Transform,
}

impl Workcell {
    /// The embedded workcell.
    pub fn embedded(seed: u64) -> Result<Self, SimError> {
        Self::embedded_as(Scenario::Default, seed)
    }

    /// The embedded workcell in another scenario.
    pub fn embedded_as(scenario: Scenario, seed: u64) -> Result<Self, SimError> {
        let (mut config, description) = embedded_files()?;
        let mut settings = settings(&config)?;
        settings.scenario = scenario;
        if let (Scenario::Reach, Some(arm)) = (scenario, &mut config.arm) {
            // An arm that grasps has a light on its gripper.
            arm.tag = Some(HandTag { object_id: "gripper".into(), link: "gripper_tag".into() });
        }
        Self::new(config, description, settings, seed)
    }

    /// A workcell from a user's files. A configuration without `[sim]` gets the embedded table.
    pub fn from_config(
        config: &Config,
        description: &Description,
        seed: u64,
    ) -> Result<Self, SimError> {
        Self::new(config.clone(), description.clone(), settings(config)?, seed)
    }

    /// A workcell with the simulator's settings given directly.
    pub fn new(
        config: Config,
        description: Description,
        mut settings: SimConfig,
        seed: u64,
    ) -> Result<Self, SimError> {
        let mut heads = Vec::new();
        let mut views = Vec::new();
        for side in Side::BOTH {
            let wiring = config.head(side);
            let names = [wiring.pan_joint.as_str(), wiring.tilt_joint.as_str()];
            let chain = description.chain_with(ROOT, &wiring.optical_frame, &names)?;
            let lens = wiring.camera.model();
            let base_from_optical = chain.forward(&[0.0, 0.0]);
            views.push(RestView { camera: lens, base_from_optical });
            heads.push(true_head(&settings, chain, lens, seed, side));
        }
        let [left, right]: [TrueHead; 2] =
            heads.try_into().map_err(|_| SimError::Table("two heads".into()))?;
        let views = [views[0], views[1]];
        let mut composition = compose(&settings, &views, seed)?;
        let on_table = composition.objects.len();
        let tag = config.arm.as_ref().and_then(|arm| arm.tag.as_ref());
        if let (Some(_), Some(record)) = (tag, settings.gripper_record.clone()) {
            // Behind the heads until the arm is shown.
            let base_from_object = Transform::translation(-0.5, 0.0, 0.5);
            composition.objects.push(TaggedObject { record: record.clone(), base_from_object });
            composition.bodies_of.push(0..0);
            settings.objects.push(ObjectSettings::of(record));
        }
        let radio = Radio::new(&settings, &composition.objects, seed)?;
        let status = composition.status.map(|emitter| {
            let half = Duration::from_secs_f64(0.5 / settings.light.status_hz);
            let plays = status_play(half, seed).into_iter().collect();
            Blinker { emitter, plays }
        });
        let c = &settings.camera;
        let rows = left.lens.height.max(right.lens.height) as f64;
        let (period, readout) = (1.0 / c.frame_rate, c.row_time * (rows - 1.0));
        if readout + c.exposure > period {
            return Err(SimError::Range {
                key: "camera.row_time",
                value: c.row_time,
                low: 0.0,
                high: (period - c.exposure) / (rows - 1.0).max(1.0),
            });
        }
        let phase = stream(seed, "shutter", 0).random::<f64>() * period;
        let world = World {
            heads: [left, right],
            objects: composition.objects,
            on_table,
            bodies_of: composition.bodies_of,
            without_arm: composition.scene.bodies.len(),
            clutter: composition.clutter,
            radio,
            status,
            stage: Arc::new(Stage::new(composition.scene)),
            shutter: Shutter { phase, period, exposure: c.exposure, readout },
            now: Duration::ZERO,
            frame: 0,
            exposing: None,
            captures: VecDeque::new(),
            settings: settings.clone(),
        };
        Ok(Workcell { config, description, settings, seed, world: Arc::new(Mutex::new(world)) })
    }

    /// Opens the devices. All robots of one workcell share its world and time.
    pub fn robot(&self) -> Robot {
        let head = |side: Side| {
            let (sensor, world) = (self.sensor(side), self.world.clone());
            Head {
                camera: Box::new(SimCamera { world: world.clone(), side, sensor, next: 0 }),
                pan_tilt: Box::new(SimPanTilt { world, side }),
            }
        };
        Robot {
            clock: self.clock(),
            heads: Side::BOTH.map(head),
            radio: Box::new(self.radio()),
            // Contacts are simulated by another crate, which moves objects by `place_object`.
            arm: None,
        }
    }

    /// The sensor of a camera.
    pub(crate) fn sensor(&self, side: Side) -> Sensor {
        let lens = lock(&self.world).heads[side as usize].lens;
        let (camera, light) = (self.settings.camera, &self.settings.light);
        Sensor::new(lens, camera, light, self.seed, side as usize)
    }

    /// What its devices share.
    pub(crate) fn world(&self) -> &Shared {
        &self.world
    }

    /// Takes the tags to real time and to a listener, see [`crate::WiredWorkcell`].
    pub(crate) fn serve_tags(&self, listener: TcpListener) -> io::Result<()> {
        let world = &mut *lock(&self.world);
        world.radio.serve(&self.settings, &world.objects, self.seed, listener, world.now)
    }

    /// The clock of all its devices.
    pub fn clock(&self) -> Box<dyn Clock> {
        Box::new(SimClock { world: self.world.clone() })
    }

    /// Opens the tag radio alone. All radios of one workcell are the same.
    pub fn radio(&self) -> HciLink {
        radio::link(&self.world)
    }

    /// What is really so, at this moment.
    pub fn truth(&self) -> Truth {
        let world = lock(&self.world);
        let objects = world.objects.iter().take(world.on_table).map(|object| TrueObject {
            id: object.record.object_id.to_string(),
            record: object.record.clone(),
            base_from_object: object.base_from_object,
            landmarks: object.record.landmarks.iter().map(|site| object.landmark(site)).collect(),
        });
        let cameras = [0, 1].map(|side| {
            let head = &world.heads[side];
            TrueCamera { lens: head.lens, base_from_optical: head.base_from_optical() }
        });
        let clutter = world.clutter.iter().map(|(place, solid)| (*place, solid_of(solid)));
        Truth { objects: objects.collect(), cameras, clutter: clutter.collect() }
    }

    /// Moves a tagged object, as an arm does; pictures that are taken from now on show it there.
    /// `false` when there is no such object.
    pub fn place_object(&self, id: &str, base_from_object: &Transform) -> bool {
        lock(&self.world).place_object(id, base_from_object)
    }

    /// Holds a tagged object upright so that its first light is at a place (base, m) and shines towards
    /// the foot of the heads' mast, as a person would who calibrates. `false` when there is no such light.
    pub fn hold_light(&self, id: &str, place: &Point3<f64>) -> bool {
        let world = &mut *lock(&self.world);
        let record = world.objects.iter().map(|object| &object.record);
        let held = record.into_iter().find(|record| record.object_id.as_str() == id);
        let Some(site) = held.and_then(|record| record.landmarks.first()) else { return false };
        let yaw = (-place.y).atan2(-place.x) - site.normal[1].atan2(site.normal[0]);
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        let centre = place.coords - turned * Vector3::from(site.position);
        world.place_object(id, &Transform::from_parts(centre.into(), turned))
    }

    /// Shows the arm's parts where they are now, in place of where they were; the cameras see them
    /// from the next picture on.
    pub fn show_arm(&self, parts: &[ArmPart]) {
        lock(&self.world).show_arm(parts.iter().map(|part| {
            let surface = Material::matt(part.albedo, Texture::Plain, 1).glossy(0.03);
            Body::new(rendered(&part.solid), &part.base_from_solid, surface)
        }));
    }

    /// A photograph by an onlooker who stands at `eye` and looks at `target` (base, m): for people,
    /// no part of the robot.
    pub fn photograph(&self, eye: &Point3<f64>, target: &Point3<f64>, lens: Lens) -> Image<u8> {
        let ahead = Unit::new_normalize(target - eye);
        let right = ahead.cross(&Vector3::z()).normalize();
        let axes = [right, ahead.cross(&right), ahead.into_inner()];
        let turn = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&axes));
        let pose = Transform::from_parts(eye.coords.into(), turn.into());
        let world = lock(&self.world);
        let capture = Capture {
            sequence: 0,
            start: world.seconds(),
            base_from_optical: [pose; 2],
            blinkers: Vec::new(),
            stage: world.stage.clone(),
        };
        drop(world);
        Sensor::new(lens, self.settings.camera, &self.settings.light, self.seed, 0)
            .picture(&capture)
    }

    /// The wiring: what the robot knows of its cameras and joints.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The robot's description: what it knows of its geometry.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// The simulator's settings.
    pub fn settings(&self) -> &SimConfig {
        &self.settings
    }
}

/// A part of the arm as cameras see it.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmPart {
    /// Where it is.
    pub base_from_solid: Transform,
    /// Its form.
    pub solid: Solid,
    /// Share of light that it gives back.
    pub albedo: f32,
}

/// The rendered form of a solid.
fn rendered(solid: &Solid) -> trace::Solid {
    let round = |radius: f64, half: f64| trace::Solid::Frustum {
        bottom: radius as f32,
        top: radius as f32,
        half: half as f32,
    };
    match solid {
        Solid::Cuboid { half } => trace::Solid::Box([half.x, half.y, half.z].map(|h| h as f32)),
        Solid::Cylinder { radius, half_height } => round(*radius, *half_height),
        Solid::Sphere { radius } => trace::Solid::Sphere(*radius as f32),
        Solid::Convex { vertices } => {
            trace::Solid::Faceted(Arc::new(trace::Facets::new(&hull(vertices))))
        }
    }
}

/// The convex solid around a rendered one.
fn solid_of(solid: &trace::Solid) -> Solid {
    let cylinder = |radius: f32, half: f32| Solid::Cylinder {
        radius: f64::from(radius),
        half_height: f64::from(half),
    };
    match solid {
        trace::Solid::Box(half) => Solid::Cuboid { half: half.map(f64::from).into() },
        trace::Solid::Frustum { bottom, top, half }
        | trace::Solid::Cup { bottom, top, half, .. } => cylinder(bottom.max(*top), *half),
        trace::Solid::Faceted(facets) => {
            Solid::Cuboid { half: facets.half().map(f64::from).into() }
        }
        trace::Solid::Sphere(radius) => Solid::Sphere { radius: f64::from(*radius) },
        trace::Solid::Capsule { half, radius } => cylinder(*radius, half + radius),
    }
}

/// Root link of all chains.
const ROOT: &str = "base";

/// The embedded wiring and description.
pub fn embedded_files() -> Result<(Config, Description), SimError> {
    let config = Config::parse(EMBEDDED_CONFIG, Path::new("embedded workcell.toml"))?;
    let description = Description::parse(EMBEDDED_URDF, Path::new("embedded workcell.urdf"))?;
    Ok((config, description))
}

/// The `[sim]` table of a configuration, else the embedded one.
pub fn settings(config: &Config) -> Result<SimConfig, SimError> {
    match &config.sim {
        Some(table) => SimConfig::from_table(table),
        None => match embedded_files()?.0.sim {
            Some(table) => SimConfig::from_table(&table),
            None => Ok(SimConfig::default()),
        },
    }
}

/// The head as built: the URDF's, off by the configured errors.
fn true_head(
    settings: &SimConfig,
    mut chain: Chain,
    mut lens: Lens,
    seed: u64,
    side: Side,
) -> TrueHead {
    let GeometryError { joint_zero_deg, axis_skew_deg, lever_arm, focal_ratio } =
        settings.geometry_error;
    let mut rng = stream(seed, "geometry", side as u64);
    for joint in &mut chain.joints {
        let skew = Vector3::from_fn(|_, _| normal(&mut rng)) * axis_skew_deg.to_radians();
        joint.axis =
            Unit::new_normalize(UnitQuaternion::from_scaled_axis(skew) * joint.axis.into_inner());
        let zero = normal(&mut rng) * joint_zero_deg.to_radians();
        let turn = UnitQuaternion::from_axis_angle(&joint.axis, zero);
        joint.parent_from_joint *= Transform::from_parts(Default::default(), turn);
    }
    let lever = Vector3::from_fn(|_, _| normal(&mut rng)) * lever_arm;
    chain.last_from_tip.translation.vector += lever;
    let stretch = 1.0 + normal(&mut rng) * focal_ratio;
    (lens.fx, lens.fy) = (lens.fx * stretch, lens.fy * stretch);
    let speed = |k: usize| chain.joints.get(k).map_or(1.0, |joint| joint.limits.velocity);
    let servos = [0, 1].map(|k| {
        let rng = stream(seed, "servo", 2 * side as u64 + k as u64);
        Servo::new(&settings.servos, speed(k), rng)
    });
    TrueHead { chain, lens, servos }
}

/// The status light has always been blinking.
fn status_play(half: Duration, seed: u64) -> Option<Play> {
    let pattern = Pattern::new(Bits::FLICKER, half).ok()?;
    let begin = -2.0 * half.as_secs_f64() * stream(seed, "status", 0).random::<f64>() - 1.0;
    Some(Play { begin, end: f64::INFINITY, pattern, rate: 1.0 })
}
