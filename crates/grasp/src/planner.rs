//! The planner: from a pose and a record to a tested motion.
//!
//! Steps: refuse what must not or cannot be held; make candidates; drop those that the pose's
//! covariance, strength or friction forbids; rank the rest; for the best ones find postures and
//! straight lines that touch nothing, then a way to the pre-grasp; take the best of the first few.

use vergence_geometry::{Body, Chain, GaussianPose, JointAngles, Transform};
use vergence_tag::{Mobility, Record};

use crate::candidates::{self, Assumptions, Grasp, Hold};
use crate::collision::{Clearances, Hit, Obstacle, RobotShape};
use crate::gripper::{self, Gripper, NoGripper};
use crate::kinematics::{Arm, NotAnArm};
use crate::margin::{Margin, margin};
use crate::motion::{self, Motion, NoMotion, Scene};
use crate::object;
use crate::path::SearchEffort;
use crate::plan::{Plan, Refusal, Rejected};
use crate::timing::Speeds;

/// Why a robot cannot grasp.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RobotError {
    /// The arm.
    #[error(transparent)]
    Arm(#[from] NotAnArm),
    /// The hand.
    #[error(transparent)]
    Gripper(#[from] NoGripper),
}

/// A robot that can grasp.
#[derive(Clone)]
pub struct Robot {
    /// Kinematics from the base to the gripper's tip.
    pub arm: Arm,
    /// Its solids.
    pub shape: RobotShape,
    /// Its hand.
    pub gripper: Gripper,
}

impl Robot {
    /// From the chain to the gripper's tip, all solids of the robot (heads included), the way of one
    /// finger (m) and the gripper's force (N).
    pub fn new(chain: Chain, bodies: &[Body], travel: f64, force: f64) -> Result<Self, RobotError> {
        let gripper = Gripper::measure(bodies, &chain, travel, force)?;
        let arm = Arm::new(chain)?;
        let shape = RobotShape::new(&arm, bodies);
        Ok(Self { arm, shape, gripper })
    }
}

/// Settings of the planner.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Heaviest object (kg): the arm's 3 kg less the hand's 0.86 kg.
    pub payload: f64,
    /// Factor on the force that would just hold: friction varies by half.
    pub safety: f64,
    /// Part of the object's strength that the commanded force may take: when the object leaves the
    /// table and settles between the pads, contact forces reach twice the commanded one.
    pub peak: f64,
    /// Least force of a grip (N): below it fingers do not close reliably.
    pub least_force: f64,
    /// Error of the arm and its calibration to the heads that no covariance tells of (m).
    pub tolerance: f64,
    /// Distance of the pre-grasp from the grasp (m): more than a finger's length.
    pub standoff: f64,
    /// Height of the lift (m).
    pub lift: f64,
    /// Distances kept on the way to the pre-grasp (m).
    pub far: Clearances,
    /// Distances kept from the pre-grasp on (m).
    pub near: Clearances,
    /// How far a second look may move the object before the plan is void (m).
    pub correction: f64,
    /// How many complete motions are compared.
    pub compared: usize,
    /// What the record does not tell.
    pub assumptions: Assumptions,
    /// How fast.
    pub speeds: Speeds,
    /// Search for a way round obstacles.
    pub effort: SearchEffort,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            payload: 2.1,
            safety: 1.6,
            peak: 0.45,
            least_force: 5.0,
            tolerance: 0.002,
            standoff: 0.080,
            lift: 0.100,
            far: Clearances { world: 0.010, object: 0.010 },
            near: Clearances { world: 0.008, object: 0.002 },
            correction: 0.040,
            compared: 3,
            assumptions: Assumptions::default(),
            speeds: Speeds::default(),
            effort: SearchEffort::default(),
        }
    }
}

/// What is to be grasped, where, among what.
#[derive(Debug, Clone, Copy)]
pub struct Request<'a> {
    /// The tag's record.
    pub record: &'a Record,
    /// `base_from_object` with covariance.
    pub object: &'a GaussianPose,
    /// The landmark that was seen: the hand should not hide it.
    pub landmark: usize,
    /// Where the arm stands.
    pub start: &'a JointAngles,
    /// What else is there: table, clutter.
    pub obstacles: &'a [Obstacle],
    /// Azimuths (rad, object frame, from, to counter-clockwise) that were seen free of a handle.
    pub free_azimuths: &'a [(f64, f64)],
    /// Seed of the search for a way.
    pub seed: u64,
}

/// A candidate that the pose, the strength and the friction allow.
pub(crate) struct Allowed {
    pub(crate) grasp: Grasp,
    pub(crate) margin: Margin,
    pub(crate) force: f64,
    score: f64,
}

impl Allowed {
    /// A grasp that was chosen before and still holds.
    pub(crate) fn corrected(grasp: Grasp, margin: Margin, force: f64) -> Self {
        Self { grasp, margin, force, score: 0.0 }
    }
}

/// Plans a grasp.
pub fn plan(robot: &Robot, request: &Request, config: &Config) -> Result<Plan, Refusal> {
    let mass = check_object(request, config)?;
    check_start(robot, request, config)?;
    let mut rejected = Rejected::default();
    let allowed = allowed(robot, request, config, mass, &mut rejected)?;
    let scene = Scene::new(request, &config.assumptions);
    let mut complete: Vec<(f64, &Allowed, Motion)> = Vec::new();
    let mut feasible: Vec<(Grasp, f64)> = Vec::new();
    let mut nearest: Option<Hit> = None;
    for candidate in &allowed {
        match motion::find(robot, request, config, &scene, &candidate.grasp) {
            Ok(found) => {
                let score = candidate.score + found.score(&robot.arm);
                feasible.push((candidate.grasp.clone(), score));
                complete.push((score, candidate, found));
            }
            Err(NoMotion::Unreachable) => rejected.unreachable += 1,
            Err(NoMotion::Blocked(hit)) => {
                rejected.blocked += 1;
                nearest.get_or_insert(hit);
            }
        }
        if complete.len() >= config.compared {
            break;
        }
    }
    complete.sort_by(|a, b| b.0.total_cmp(&a.0));
    feasible.sort_by(|a, b| b.1.total_cmp(&a.1));
    let Some((score, candidate, motion)) = complete.into_iter().next() else {
        return Err(match nearest {
            Some(hit) => Refusal::Occupied(hit),
            None => Refusal::Unreachable(request.object.pose.translation.vector),
        });
    };
    let reasons = reasons(candidate, score, mass);
    let alternatives = feasible.into_iter().skip(1).collect();
    Ok(assemble(robot, request, config, candidate, motion, mass, reasons, alternatives, rejected))
}

/// Times the motions and puts the plan together.
pub(crate) fn assemble(
    robot: &Robot,
    request: &Request,
    config: &Config,
    chosen: &Allowed,
    motion: Motion,
    mass: f64,
    reasons: Vec<String>,
    alternatives: Vec<(Grasp, f64)>,
    rejected: Rejected,
) -> Plan {
    let [transfer, approach, lift] = motion.timed(robot, &config.speeds);
    Plan {
        base_from_tip: request.object.pose * chosen.grasp.object_from_tip,
        grasp: chosen.grasp.clone(),
        transfer,
        approach,
        lift,
        force: chosen.force,
        mass,
        margin: chosen.margin,
        reasons,
        alternatives,
        rejected,
    }
}

/// The name for messages.
pub(crate) fn name_of(record: &Record) -> String {
    let name = record.semantic.name.trim();
    if name.is_empty() { record.object_id.to_string() } else { name.to_string() }
}

/// Refuses what must not or cannot be lifted; gives the mass (kg).
pub(crate) fn check_object(request: &Request, config: &Config) -> Result<f64, Refusal> {
    let record = request.record;
    record.validate()?;
    if request.landmark >= record.landmarks.len() {
        return Err(Refusal::NoLandmark(request.landmark));
    }
    let pose = request.object.pose.to_homogeneous();
    if !pose.iter().all(|v| v.is_finite()) {
        return Err(Refusal::Pose("it is not finite"));
    }
    let covariance = &request.object.covariance;
    let sane = covariance.iter().all(|v| v.is_finite());
    if !sane || (0..6).any(|k| covariance[(k, k)] < 0.0) {
        return Err(Refusal::Pose("its covariance is not a covariance"));
    }
    if record.semantic.mobility == Mobility::Fixed {
        return Err(Refusal::Fixed(name_of(record)));
    }
    // A thing of unknown weight is taken to be full of water.
    let mass = record.physical.weight.unwrap_or_else(|| object::volume(record) * 1000.0);
    if mass > config.payload {
        return Err(Refusal::TooHeavy { name: name_of(record), mass, payload: config.payload });
    }
    Ok(mass)
}

fn check_start(robot: &Robot, request: &Request, config: &Config) -> Result<(), Refusal> {
    if !robot.arm.within_limits(request.start) {
        return Err(Refusal::Start("a joint is outside its range".into()));
    }
    let scene = Scene::new(request, &config.assumptions);
    let around = scene.before();
    robot
        .shape
        .check(&robot.arm, request.start, robot.gripper.opening, &around, &config.far)
        .map_err(|hit| Refusal::Start(format!("{} touches {}", hit.link, hit.other)))
}

/// Candidates that pose, strength and friction allow, best first.
fn allowed(
    robot: &Robot,
    request: &Request,
    config: &Config,
    mass: f64,
    rejected: &mut Rejected,
) -> Result<Vec<Allowed>, Refusal> {
    let (record, gripper) = (request.record, &robot.gripper);
    let grasps =
        candidates::candidates(record, gripper, request.free_azimuths, &config.assumptions);
    if grasps.is_empty() {
        let width = candidates::narrowest(record);
        return Err(match width < gripper.opening {
            true => Refusal::HandleUnknown(name_of(record)),
            false => Refusal::TooWide {
                name: name_of(record),
                width_mm: width * 1e3,
                opening_mm: gripper.opening * 1e3,
            },
        });
    }
    let mut allowed = Vec::new();
    let mut surest: Option<Margin> = None;
    let mut lightest: Option<Refusal> = None;
    let mut least = f64::INFINITY;
    for grasp in grasps {
        let margin = margin(record, request.object, &grasp, config.tolerance);
        if surest.is_none_or(|m| margin.ratio > m.ratio) {
            surest = Some(margin);
        }
        // NaN, from a covariance that is none, must not pass.
        if margin.ratio.is_nan() || margin.ratio < 1.0 {
            rejected.uncertain += 1;
            continue;
        }
        match force(robot, request, config, &grasp, mass) {
            Ok(force) => {
                let score = score(request, &grasp, &margin);
                allowed.push(Allowed { grasp, margin, force, score });
            }
            Err((needed, refusal)) => {
                rejected.force += 1;
                if needed < least {
                    (least, lightest) = (needed, Some(refusal));
                }
            }
        }
    }
    if allowed.is_empty() {
        return Err(match (lightest, surest) {
            (Some(refusal), _) => refusal,
            (None, Some(m)) => Refusal::TooUncertain {
                axis: m.axis,
                needed_mm: m.needed * 1e3,
                reserve_mm: m.reserve.max(0.0) * 1e3,
            },
            (None, None) => Refusal::HandleUnknown(name_of(record)),
        });
    }
    allowed.sort_by(|a, b| b.score.total_cmp(&a.score));
    Ok(allowed)
}

/// Part by which the force must exceed what holds the object by calculation.
const LEAST_SAFETY: f64 = 1.2;

/// The force for a grasp, or how much would be needed and why it cannot be had (N).
pub(crate) fn force(
    robot: &Robot,
    request: &Request,
    config: &Config,
    grasp: &Grasp,
    mass: f64,
) -> Result<f64, (f64, Refusal)> {
    let surface = gripper::surface(&request.record.physical);
    let base_from_tip = request.object.pose * grasp.object_from_tip;
    let axis = |v: nalgebra::Vector3<f64>| base_from_tip.rotation * v;
    let pad = base_from_tip.translation.vector
        - axis(nalgebra::Vector3::z()) * (grasp.levers.contact / 2.0);
    let lever = request.object.pose.translation.vector - pad;
    let twist = lever.cross(&nalgebra::Vector3::z()).dot(&axis(nalgebra::Vector3::y())).abs();
    let levers = gripper::Levers { twist, ..grasp.levers };
    let needed = gripper::needed_force(mass, surface.friction, &levers, config.safety);
    let bare = needed / config.safety.max(1.0);
    let needed = needed.max(config.least_force);
    let name = || name_of(request.record);
    // The safety shrinks before the object is pressed with what its strength does not bear at a peak.
    let borne = config.peak * surface.strength;
    if LEAST_SAFETY * bare > borne {
        let strength = surface.strength;
        return Err((needed, Refusal::TooWeak { name: name(), needed, strength }));
    }
    let needed = needed.min(borne);
    if needed > robot.gripper.force {
        let force = robot.gripper.force;
        return Err((needed, Refusal::TooSlippery { name: name(), needed, force }));
    }
    Ok(needed)
}

/// How good a grasp is before the arm is considered, 0 to about 1.
fn score(request: &Request, grasp: &Grasp, margin: &Margin) -> f64 {
    let base_from_tip = request.object.pose * grasp.object_from_tip;
    let approach = base_from_tip.rotation * nalgebra::Vector3::z();
    let site = &request.record.landmarks[request.landmark];
    let normal = request.object.pose.rotation * nalgebra::Vector3::from(site.normal);
    // The hand comes from where the approach comes from: it should not stand before the landmark.
    let seen = 0.5 * (1.0 + approach.dot(&normal));
    let sure = (margin.ratio / 3.0).min(1.0);
    // From above a gripper is furthest from the table, from the side it is nearest to the palm's
    // best hold; a rim carries the least.
    let hold = match grasp.hold {
        Hold::Faces | Hold::Side => 1.0,
        Hold::Top => 0.8,
        Hold::Rim => 0.6,
    };
    0.5 * sure + 0.3 * seen + 0.2 * hold
}

fn reasons(chosen: &Allowed, score: f64, mass: f64) -> Vec<String> {
    let (g, m) = (&chosen.grasp, &chosen.margin);
    vec![
        format!("{} grasp, {:.0} mm wide, score {score:.2}", g.hold.name(), g.width * 1e3),
        format!(
            "bears {:.1} mm along the {} axis, where the pose is sure to {:.1} mm (95 %)",
            m.reserve * 1e3,
            m.axis,
            m.needed * 1e3
        ),
        format!("{:.0} N hold {mass:.2} kg", chosen.force),
    ]
}

/// A pose of the tip with the same fingers exchanged: a parallel gripper does not care.
pub(crate) fn exchanged(base_from_tip: &Transform) -> Transform {
    let turn = nalgebra::UnitQuaternion::from_axis_angle(
        &nalgebra::Vector3::z_axis(),
        std::f64::consts::PI,
    );
    base_from_tip * turn
}
