//! The paper's second experiment without the eyes: grasp a cup whose pose is known with an error.
//!
//! A seed places a cup on the table, with or without a handle that its record does not tell of, draws
//! the error of its pose from the covariance that the planner is told, draws the true friction, plans,
//! and lets the physics judge. With `look_again` the pose is measured once more from the pre-grasp, as
//! the heads do, with a smaller error.

use std::f64::consts::{PI, TAU};
use std::path::Path;
use std::sync::{Arc, Mutex};

use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use vergence_devices::{Description, DescriptionError, GripperJoints};
use vergence_geometry::gaussian::perturb;
use vergence_geometry::{Body, Chain, GaussianPose, JointAngles, Solid, Transform};
use vergence_grasp::object::{self, Placed};
use vergence_grasp::{Config, Obstacle, Plan, Refusal, Request, Robot, RobotError, gripper};
use vergence_tag::{Record, Shape};

use crate::arm::PhysicsArm;
use crate::trial::{self, Verdict};
use crate::world::{Setup, SetupError, TrueObject, World};

/// The arm of `crates/grasp/assets`, folded beside the heads.
pub const HOME: JointAngles = [-0.9, -0.6, 1.3, 0.0, 0.9, 0.0];

/// Why an experiment could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum ExperimentError {
    /// The URDF.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The robot cannot grasp.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// The world could not be made.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// The simulated arm refused.
    #[error(transparent)]
    Device(#[from] vergence_devices::DeviceError),
}

/// A robot as the planner and the physics need it.
#[derive(Clone)]
pub struct Cell {
    /// For the planner.
    pub robot: Robot,
    /// From base to the gripper's tip.
    pub chain: Chain,
    /// The robot's solids.
    pub bodies: Vec<Body>,
    /// The gripper's joints.
    pub gripper: GripperJoints,
    /// Mass of a finger (kg).
    pub finger_mass: f64,
    /// The URDF's text.
    pub urdf: String,
}

impl Cell {
    /// Reads a URDF with links `base`, `hand` and `tcp`.
    pub fn parse(urdf: &str, path: &Path) -> Result<Self, ExperimentError> {
        let description = Description::parse(urdf, path)?;
        let chain = description.chain("base", "tcp")?;
        let bodies = description.bodies("base", &chain)?;
        let gripper = description.gripper("hand")?;
        let robot = Robot::new(chain.clone(), &bodies, gripper.travel, gripper.effort)?;
        let finger = bodies.iter().find(|b| b.slide.norm() > 0.5).map(|b| b.name.as_str());
        let links = &description.robot().links;
        let finger_mass = links
            .iter()
            .find(|l| Some(l.name.as_str()) == finger)
            .map_or(0.0, |l| l.inertial.mass.value);
        Ok(Self { robot, chain, bodies, gripper, finger_mass, urdf: urdf.into() })
    }

    /// A world with this robot in it.
    pub fn world(
        &self,
        start: &JointAngles,
        obstacles: &[Obstacle],
        object: &TrueObject,
    ) -> Result<World, SetupError> {
        World::new(&Setup {
            chain: &self.chain,
            bodies: &self.bodies,
            gripper: &self.gripper,
            finger_mass: self.finger_mass,
            start,
            obstacles,
            object,
        })
    }
}

/// How sure a pose is: standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sureness {
    /// Of the position, each axis (m).
    pub position: f64,
    /// Of the tilt away from the table's normal (rad).
    pub tilt: f64,
    /// Of the turn about the vertical (rad).
    pub turn: f64,
}

impl Sureness {
    fn covariance(&self) -> Matrix6<f64> {
        let [t, r, p] = [self.tilt, self.turn, self.position].map(|s| s * s);
        Matrix6::from_diagonal(&Vector6::new(t, t, r, p, p, p))
    }
}

/// Settings of a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Conditions {
    /// Of the first look: what `find` reaches at 0.7 m.
    pub first: Sureness,
    /// Of the second look from the pre-grasp, `None` to go on without.
    pub second: Option<Sureness>,
    /// True friction is this factor times what the planner assumes, drawn between the two.
    pub friction: [f64; 2],
    /// Fixed error added to the pose that the planner is told, along base axes (m).
    pub offset: Vector3<f64>,
    /// True mass is this factor times what the record says.
    pub mass: f64,
    /// A handle at a random azimuth, kept off the landmark's housing, in half of the trials.
    pub handles: bool,
}

impl Default for Conditions {
    fn default() -> Self {
        let degree = PI / 180.0;
        Self {
            first: Sureness { position: 0.0025, tilt: 0.8 * degree, turn: 2.0 * degree },
            second: Some(Sureness { position: 0.0012, tilt: 0.5 * degree, turn: 1.5 * degree }),
            friction: [0.9, 1.5],
            offset: Vector3::zeros(),
            mass: 1.0,
            handles: true,
        }
    }
}

/// Everything about one trial.
#[derive(Debug, Clone)]
pub struct Trial {
    /// The object's record.
    pub record: Record,
    /// The truth that the physics uses.
    pub object: TrueObject,
    /// Table and clutter.
    pub obstacles: Vec<Obstacle>,
    /// What the planner was told first.
    pub told: GaussianPose,
    /// The plan that was carried out, or why there was none.
    pub plan: Result<Plan, Refusal>,
    /// What came of it; `None` without a plan.
    pub verdict: Option<Verdict>,
    /// Wall-clock time of planning (s); the only figure here that does not repeat.
    pub planning: f64,
}

/// The table of the workcell, its top at z = 0.
pub fn table() -> Obstacle {
    Obstacle {
        name: "table".into(),
        base_from_solid: Translation3::new(0.75, 0.0, -0.02).into(),
        solid: Solid::Cuboid { half: Vector3::new(0.6, 0.9, 0.02) },
    }
}

/// A cup of random size, weight and material with its landmark at mid height.
pub fn random_cup(random: &mut Pcg32) -> Record {
    let top = random.random_range(0.070..0.095);
    let bottom = top * random.random_range(0.75..0.98);
    let height = random.random_range(0.080..0.105);
    let materials = [("ceramic", 0.25..0.40), ("plastic", 0.05..0.15), ("steel", 0.15..0.30)];
    let (material, weights) = materials[random.random_range(0..materials.len())].clone();
    let at = (top + bottom) / 4.0 + 0.003;
    let azimuth: f64 = random.random_range(0.0..TAU);
    let mut record = Record {
        object_id: vergence_tag::Text::new(),
        landmarks: Default::default(),
        bounding_box: vergence_tag::BoundingBox { width: top, length: top, height },
        shape: Shape::Cup { top_diameter: top, bottom_diameter: bottom, height },
        physical: Default::default(),
        semantic: Default::default(),
    };
    // The texts fit: they are shorter than any of the record's fields.
    let _ = record.object_id.push_str("cup");
    let _ = record.semantic.name.push_str("cup");
    let mut text = vergence_tag::Text::new();
    let _ = text.push_str(material);
    record.physical.material = Some(text);
    record.physical.weight = Some(random.random_range(weights));
    let site = vergence_tag::LandmarkSite {
        position: [at * azimuth.cos(), at * azimuth.sin(), -0.004],
        normal: [azimuth.cos(), azimuth.sin(), 0.0],
    };
    let _ = record.landmarks.push(site);
    record
}

/// Where a seed puts the object: on the table, its landmark roughly towards the heads.
fn place(random: &mut Pcg32, record: &Record) -> Transform {
    let (x, y) = (random.random_range(0.5..0.8), random.random_range(-0.25..0.2));
    let [nx, ny, _] = record.landmarks.first().map_or([-1.0, 0.0, 0.0], |l| l.normal);
    let facing = f64::atan2(-y, -x) + random.random_range(-0.6..0.6);
    let yaw = facing - ny.atan2(nx);
    Transform::from_parts(
        Translation3::new(x, y, record.bounding_box.height / 2.0),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
    )
}

/// A handle: three bars of 16 x 8 mm off the wall.
fn handle(record: &Record, azimuth: f64) -> Vec<Placed> {
    let height = record.bounding_box.height;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), azimuth);
    let bar = |x: f64, z: f64, half: [f64; 3]| Placed {
        object_from_solid: Transform::from_parts(
            Translation3::from(turn * Vector3::new(x, 0.0, z)),
            turn,
        ),
        solid: Solid::Cuboid { half: half.into() },
    };
    let radius = |z: f64| object::radius_at(record, z).unwrap_or(0.0);
    let (z, reach) = (0.28 * height, 0.028);
    let outer = radius(z) + reach;
    let arm = |z: f64| {
        let inner = radius(z) - 0.002;
        bar((outer + inner) / 2.0, z, [(outer - inner) / 2.0, 0.008, 0.004])
    };
    vec![arm(z), arm(-z), bar(outer, 0.0, [0.004, 0.008, z + 0.004])]
}

/// The error of one look.
fn error(random: &mut Pcg32, sureness: &Sureness) -> Vector6<f64> {
    let [t, r, p] = [sureness.tilt, sureness.turn, sureness.position];
    Vector6::from_fn(|k, _| normal(random) * [t, t, r, p, p, p][k])
}

/// Standard normal by Box and Muller.
fn normal(random: &mut Pcg32) -> f64 {
    let (u, v): (f64, f64) = (1.0 - random.random::<f64>(), random.random());
    (-2.0 * u.ln()).sqrt() * (TAU * v).cos()
}

/// Draws a trial and carries it out; `clock` gives seconds for the planning time.
pub fn run(
    cell: &Cell,
    seed: u64,
    conditions: &Conditions,
    config: &Config,
    clock: &dyn Fn() -> f64,
) -> Result<(Trial, Option<PhysicsArm>), ExperimentError> {
    let mut random = Pcg32::seed_from_u64(seed);
    let record = random_cup(&mut random);
    let truth = place(&mut random, &record);
    let surface = gripper::surface(&record.physical);
    let factor = random.random_range(conditions.friction[0]..=conditions.friction[1]);
    let object = TrueObject {
        name: "cup".into(),
        solids: solids(&record, conditions, config, &mut random),
        base_from_object: truth,
        mass: record.physical.weight.unwrap_or(0.2) * conditions.mass,
        friction: surface.friction * factor,
        strength: surface.strength,
    };
    let obstacles = vec![table()];
    let look = |sureness: &Sureness, random: &mut Pcg32| {
        let mut pose = perturb(&truth, &error(random, sureness));
        pose.translation.vector += conditions.offset;
        GaussianPose { pose, covariance: sureness.covariance() }
    };
    let told = look(&conditions.first, &mut random);
    let again = conditions.second.map(|sureness| look(&sureness, &mut random));
    let request = |object, start| Request {
        record: &record,
        object,
        landmark: 0,
        start,
        obstacles: &obstacles,
        free_azimuths: &[],
        seed,
    };
    let before = clock();
    let first = vergence_grasp::plan(&cell.robot, &request(&told, &HOME), config);
    let planning = clock() - before;
    let mut trial = Trial {
        record: record.clone(),
        object,
        obstacles: obstacles.clone(),
        told,
        plan: first,
        verdict: None,
        planning,
    };
    let Ok(plan) = &trial.plan else { return Ok((trial, None)) };
    let world = cell.world(&HOME, &obstacles, &trial.object)?;
    let mut arm = PhysicsArm::new(Arc::new(Mutex::new(world)), None);
    let began = arm.world().time();
    trial::to_pregrasp(&mut arm, plan)?;
    let mut carried = plan.clone();
    if let (Some(again), Some(pregrasp)) = (again, plan.pregrasp()) {
        match vergence_grasp::correct(&cell.robot, plan, &request(&again, &pregrasp), config) {
            Ok(corrected) => {
                trial::to_pregrasp(&mut arm, &corrected)?;
                carried = corrected;
            }
            Err(refusal) => {
                trial.plan = Err(refusal);
                return Ok((trial, Some(arm)));
            }
        }
    }
    let collision = trial::approach(&mut arm, &carried)?;
    trial.verdict = Some(trial::close_and_lift(&mut arm, &carried, collision, began)?);
    trial.plan = Ok(carried);
    Ok((trial, Some(arm)))
}

/// The true solids: walls as thick as assumed or not, housing, perhaps a handle.
fn solids(
    record: &Record,
    conditions: &Conditions,
    config: &Config,
    random: &mut Pcg32,
) -> Vec<Placed> {
    let wall = random.random_range(0.003..0.005);
    let mut solids = object::solids(record, wall);
    solids.extend(object::housings(record, config.assumptions.housing));
    let with = random.random_bool(0.5);
    let azimuth = random.random_range(0.0..TAU);
    let [x, y, _] = record.landmarks.first().map_or([1.0, 0.0, 0.0], |l| l.position);
    // Kept off the housing by their half widths, as hardware is.
    let kept = (config.assumptions.housing + 0.008) / x.hypot(y);
    let off = (azimuth - y.atan2(x) + PI).rem_euclid(TAU) - PI;
    let azimuth = if off.abs() < kept { azimuth + PI } else { azimuth };
    if conditions.handles && with {
        solids.extend(handle(record, azimuth));
    }
    solids
}
