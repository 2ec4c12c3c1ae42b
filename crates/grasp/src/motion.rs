//! Postures and lines that carry out one grasp: transfer, approach, lift.
//!
//! In: a grasp, the scene. Out: three paths in joint space, each posture tested, or what is in the
//! way. The grasp posture is found first (closed form, both exchanges of the fingers), then the
//! straight line back to the pre-grasp and the straight line up, then the way from the start.

use nalgebra::{UnitQuaternion, Vector3};
use vergence_geometry::{JointAngles, Trajectory, Transform};

use crate::candidates::{Assumptions, Grasp};
use crate::collision::{self, Hit, Part, Surroundings};
use crate::kinematics::{Arm, distance};
use crate::object;
use crate::path;
use crate::planner::{Config, Request, Robot, exchanged, name_of};
use crate::timing::{self, Speeds};

/// Length of a step of a straight line (m).
const LINE_STEP: f64 = 0.005;
/// A step of a turn (rad): 8 mm at a cup's far side.
const TURN_STEP: f64 = 0.1;
/// Largest change of a joint over such a step (rad): more is a change of branch or a singularity.
const LARGEST_JUMP: f64 = 0.25;
/// Distance at which the object counts as standing on something (m).
const SUPPORT: f64 = 0.020;
/// Approaches that rise more steeply than this come from under the table.
const RISE: f64 = 0.3;

/// Why a grasp cannot be carried out.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum NoMotion {
    Unreachable,
    Blocked(Hit),
}

/// The object and what stands around it, ready for distance queries.
pub(crate) struct Scene {
    world: Vec<Part>,
    object: Vec<Part>,
    /// The object's parts in its own frame, and the obstacles that do not carry it.
    in_object: Vec<Part>,
    unsupporting: Vec<Part>,
}

impl Scene {
    pub(crate) fn new(request: &Request, assumed: &Assumptions) -> Self {
        let name = name_of(request.record);
        let mut placed = object::solids(request.record, assumed.wall);
        placed.extend(object::housings(request.record, assumed.housing));
        let base_from_object = request.object.pose;
        let part = |base: Transform| {
            let name = name.clone();
            move |p: &object::Placed| Part::new(&name, &(base * p.object_from_solid), &p.solid)
        };
        let object: Vec<Part> = placed.iter().filter_map(part(base_from_object)).collect();
        let in_object: Vec<Part> = placed.iter().filter_map(part(Transform::identity())).collect();
        let world = collision::parts_of(request.obstacles);
        let carries = |fixed: &Part| {
            in_object.iter().any(|p| collision::near(p, &base_from_object, fixed, SUPPORT))
        };
        let unsupporting = world.iter().filter(|w| !carries(w)).cloned().collect();
        Self { world, object, in_object, unsupporting }
    }

    /// With the object in its place.
    pub(crate) fn before(&self) -> Surroundings {
        Surroundings { world: self.world.clone(), object: self.object.clone(), carried: Vec::new() }
    }

    /// With the object in the hand; what it stands on or beside is not held against it.
    fn after(&self, grasp: &Grasp) -> (Surroundings, Surroundings) {
        let tip_from_object = grasp.object_from_tip.inverse();
        let carried = self.in_object.iter().map(|p| p.moved(&tip_from_object)).collect();
        let hand = Surroundings { world: self.world.clone(), ..Surroundings::default() };
        let load = Surroundings { world: self.unsupporting.clone(), object: Vec::new(), carried };
        (hand, load)
    }
}

/// The three paths.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Motion {
    transfer: Vec<JointAngles>,
    approach: Vec<JointAngles>,
    lift: Vec<JointAngles>,
}

impl Motion {
    /// How good it is for the arm, 0 to about 0.5: far from the joints' limits, a short way.
    pub(crate) fn score(&self, arm: &Arm) -> f64 {
        let room = |q: &JointAngles| {
            arm.chain()
                .joints
                .iter()
                .zip(q)
                .map(|(j, q)| (q - j.limits.lower).min(j.limits.upper - q))
                .fold(f64::INFINITY, f64::min)
        };
        let room = self.approach.iter().chain(&self.lift).map(room).fold(f64::INFINITY, f64::min);
        let way: f64 = self.transfer.windows(2).map(|w| distance(&w[0], &w[1])).sum();
        0.2 * room.min(0.5) / 0.5 + 0.3 / (1.0 + way)
    }

    /// The trajectories: transfer (at rest at every corner), approach, lift.
    pub(crate) fn timed(&self, robot: &Robot, speeds: &Speeds) -> [Trajectory; 3] {
        let mut transfer = Trajectory::default();
        for corner in self.transfer.windows(2) {
            let steps = (robot.shape.travel(&corner[0], &corner[1]) / LINE_STEP).ceil().max(1.0);
            let path: Vec<JointAngles> = (0..=steps as usize)
                .map(|n| collision::blend(&corner[0], &corner[1], n as f64 / steps))
                .collect();
            timing::append(&mut transfer, &timing::parameterise(&robot.arm, &path, speeds));
        }
        let line = |path: &[JointAngles]| timing::parameterise(&robot.arm, path, speeds);
        [transfer, line(&self.approach), line(&self.lift)]
    }
}

/// Finds the motion for one grasp.
pub(crate) fn find(
    robot: &Robot,
    request: &Request,
    config: &Config,
    scene: &Scene,
    grasp: &Grasp,
) -> Result<Motion, NoMotion> {
    let base_from_tip = request.object.pose * grasp.object_from_tip;
    if (base_from_tip.rotation * Vector3::z()).z > RISE {
        return Err(NoMotion::Unreachable);
    }
    let mut failure = NoMotion::Unreachable;
    for tip in [base_from_tip, exchanged(&base_from_tip)] {
        for joints in robot.arm.solutions(&tip, request.start) {
            match carry_out(robot, request, config, scene, grasp, &tip, &joints) {
                Ok(motion) => return Ok(motion),
                Err(NoMotion::Unreachable) => {}
                Err(blocked) => failure = blocked,
            }
        }
    }
    Err(failure)
}

fn carry_out(
    robot: &Robot,
    request: &Request,
    config: &Config,
    scene: &Scene,
    grasp: &Grasp,
    base_from_tip: &Transform,
    joints: &JointAngles,
) -> Result<Motion, NoMotion> {
    let (before, (hand, load)) = (scene.before(), scene.after(grasp));
    let blocked = NoMotion::Blocked;
    let test = |path: &[JointAngles], opening: f64, around: &Surroundings| {
        path.iter().try_for_each(|q| {
            robot.shape.check(&robot.arm, q, opening, around, &config.near).map_err(blocked)
        })
    };
    test(std::slice::from_ref(joints), grasp.opening, &before)?;
    let back = base_from_tip.rotation * Vector3::z() * -config.standoff;
    let mut approach = straight(&robot.arm, joints, base_from_tip, &back)?;
    test(&approach, grasp.opening, &before)?;
    approach.reverse();
    let lift = straight(&robot.arm, joints, base_from_tip, &(Vector3::z() * config.lift))?;
    test(&lift, grasp.width, &hand)?;
    test(&lift, grasp.width, &load)?;
    let transfer =
        transfer(robot, request, config, &before, grasp.opening, &approach[0]).map_err(blocked)?;
    Ok(Motion { transfer, approach, lift })
}

/// The hand turned by an angle (rad) about the vertical through its tip, the object in it, from a posture.
pub(crate) fn turn(
    robot: &Robot,
    config: &Config,
    scene: &Scene,
    grasp: &Grasp,
    from: &JointAngles,
    angle: f64,
) -> Result<Vec<JointAngles>, NoMotion> {
    let base_from_tip = robot.arm.forward(from);
    let steps = (angle.abs() / TURN_STEP).ceil().max(1.0) as usize;
    let path = follow(&robot.arm, from, steps, |part| {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), part * angle);
        let rotation = turn * base_from_tip.rotation;
        Transform::from_parts(base_from_tip.translation, rotation)
    })?;
    let (hand, load) = scene.after(grasp);
    for around in [hand, load] {
        for q in &path {
            let free = robot.shape.check(&robot.arm, q, grasp.width, &around, &config.near);
            free.map_err(NoMotion::Blocked)?;
        }
    }
    Ok(path)
}

/// The way from the start to the pre-grasp.
fn transfer(
    robot: &Robot,
    request: &Request,
    config: &Config,
    around: &Surroundings,
    opening: f64,
    goal: &JointAngles,
) -> Result<Vec<JointAngles>, Hit> {
    let (arm, shape) = (&robot.arm, &robot.shape);
    let limits = |k: usize| {
        let l = arm.chain().joints[k].limits;
        // Postures to try: no further than a bit beyond both ends, lest the wrist turns for nothing.
        let (a, b) = (request.start[k].min(goal[k]), request.start[k].max(goal[k]));
        ((a - 1.2).max(l.lower), (b + 1.2).min(l.upper))
    };
    let range = std::array::from_fn(limits);
    let mut free = |a: &JointAngles, b: &JointAngles| {
        shape.check_line(arm, a, b, opening, around, &config.far)
    };
    path::find(request.start, goal, &range, &config.effort, request.seed, &mut free)
}

/// Postures along a straight line of the tip, its attitude kept, from a posture by a shift in base.
fn straight(
    arm: &Arm,
    from: &JointAngles,
    base_from_tip: &Transform,
    shift: &Vector3<f64>,
) -> Result<Vec<JointAngles>, NoMotion> {
    let steps = (shift.norm() / LINE_STEP).ceil().max(1.0) as usize;
    follow(arm, from, steps, |part| {
        let mut tip = *base_from_tip;
        tip.translation.vector += shift * part;
        tip
    })
}

/// Postures at which the tip is where `tip` has it, for parts from 0 to 1 of the way.
fn follow(
    arm: &Arm,
    from: &JointAngles,
    steps: usize,
    tip: impl Fn(f64) -> Transform,
) -> Result<Vec<JointAngles>, NoMotion> {
    let mut path = vec![*from];
    let mut last = *from;
    for n in 1..=steps {
        let tip = tip(n as f64 / steps as f64);
        let next = arm.solutions(&tip, &last).into_iter().next().ok_or(NoMotion::Unreachable)?;
        if distance(&next, &last) > LARGEST_JUMP {
            return Err(NoMotion::Unreachable);
        }
        path.push(next);
        last = next;
    }
    Ok(path)
}
