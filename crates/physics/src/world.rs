//! The workcell as rigid bodies with contacts and friction.
//!
//! In: the robot's chain, solids and gripper, fixed obstacles, one loose object with its true pose,
//! mass, friction and strength. Out, step by step: where the object is, what touches the robot and how
//! hard.
//!
//! Method: `rapier3d`. The arm's links follow the commanded joint angles as kinematic bodies: the arm
//! is infinitely strong, as a geared arm nearly is, so contact forces must be *watched*: a link
//! that is driven into something shows up in [`World::take_touch`]. The fingers are light dynamic
//! bodies on prismatic joints with stiff springs, so that what is between them feels the commanded
//! force and no more. The same inputs give the same bits on every run and platform
//! (`enhanced-determinism`).

use nalgebra::{UnitQuaternion, Vector3};
use rapier3d::prelude::*;
use vergence_devices::GripperJoints;
use vergence_geometry::{Body, Chain, JointAngles, Transform};
use vergence_grasp::collision::Part;
use vergence_grasp::object::Placed;
use vergence_grasp::{Arm, Obstacle};

use crate::jaws::Jaws;

/// Duration of a step (s): the tool moves 0.1 mm in it.
pub const STEP: f64 = 0.002;
/// Friction of everything loose on tables and clutter.
const TABLE_FRICTION: f32 = 0.3;
/// Overlap of a link and a fixed thing that counts as a collision (m).
const OVERLAP: f32 = 2e-4;
/// The squeezing force counts when it lasts: the solver's single peaks are not forces (s).
const LASTING: f64 = 0.010;

/// The loose object as it truly is.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueObject {
    /// For messages.
    pub name: String,
    /// Its solids in its own frame.
    pub solids: Vec<Placed>,
    /// Where it stands at first.
    pub base_from_object: Transform,
    /// Mass (kg).
    pub mass: f64,
    /// Coefficient of friction between it and the fingers.
    pub friction: f64,
    /// Squeezing force at which it breaks (N).
    pub strength: f64,
}

/// Everything that a world is made of.
#[derive(Debug, Clone)]
pub struct Setup<'a> {
    /// From base to the gripper's tip.
    pub chain: &'a Chain,
    /// The robot's solids.
    pub bodies: &'a [Body],
    /// The gripper's joints.
    pub gripper: &'a GripperJoints,
    /// Mass of one finger (kg).
    pub finger_mass: f64,
    /// Where the arm stands at first.
    pub start: &'a JointAngles,
    /// Fixed things.
    pub obstacles: &'a [Obstacle],
    /// The loose thing.
    pub object: &'a TrueObject,
}

/// Why no world could be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SetupError {
    /// The arm.
    #[error(transparent)]
    Arm(#[from] vergence_grasp::kinematics::NotAnArm),
    /// A solid without volume, or a mass that is none.
    #[error("\"{0}\" has no volume or no mass")]
    Empty(String),
    /// Other than two fingers.
    #[error("the robot has {0} sliding bodies, two fingers are needed")]
    Fingers(usize),
}

/// A contact of the robot.
#[derive(Debug, Clone, PartialEq)]
pub struct Touch {
    /// Part of the robot.
    pub link: String,
    /// What it touched.
    pub other: String,
    /// Force (N); infinite for a link that overlaps a fixed thing.
    pub force: f64,
}

/// The physics of one grasp.
pub struct World {
    physics: PhysicsWorld,
    arm: Arm,
    /// The arm's bodies: index 0 stands still, k moves with the k-th joint.
    links: [RigidBodyHandle; 7],
    object: RigidBodyHandle,
    jaws: Jaws,
    /// Names of the colliders and whether they belong to the robot.
    names: std::collections::HashMap<ColliderHandle, (String, bool)>,
    object_name: String,
    joints: JointAngles,
    steps: u64,
    strength: f64,
    squeezed: f64,
    broken: bool,
    /// The strongest contact in the newest step.
    felt: Option<Touch>,
    /// And since it was last taken.
    touch: Option<Touch>,
}

impl World {
    /// Puts everything in its place, the fingers open.
    pub fn new(setup: &Setup) -> Result<Self, SetupError> {
        let arm = Arm::new(setup.chain.clone())?;
        let mut physics = PhysicsWorld::new();
        physics.gravity = Vector::new(0.0, 0.0, -9.81);
        let p = &mut physics.integration_parameters;
        p.dt = STEP as f32;
        // Things of 0.1 m: tolerances a tenth of those for things of 1 m.
        p.length_unit = 0.1;
        p.num_solver_iterations = 8;
        // A finger of 80 g that presses with 20 N sinks in by 0.1 mm; at the default 30 Hz it would
        // sink in by 7 mm and come out on the other side of a cup's wall.
        p.contact_softness = SpringCoefficients::new(240.0, 5.0);
        p.static_contact_softness = SpringCoefficients::new(240.0, 5.0);
        // Contacts are computed anew at every step: the recycling distance is a finger's thickness.
        p.contact_recycling = false;
        let mut builder = Builder { physics, names: Default::default() };
        let links = builder.links(&arm, setup)?;
        for obstacle in setup.obstacles {
            builder.obstacle(obstacle)?;
        }
        let object = builder.object(setup.object)?;
        let jaws = builder.jaws(setup, links[6])?;
        let Builder { physics, names } = builder;
        Ok(Self {
            physics,
            arm,
            links,
            object,
            jaws,
            names,
            object_name: setup.object.name.clone(),
            joints: *setup.start,
            steps: 0,
            strength: setup.object.strength,
            squeezed: 0.0,
            broken: false,
            felt: None,
            touch: None,
        })
    }

    /// Advances by [`STEP`], the arm moving to these angles.
    pub fn step(&mut self, joints: &JointAngles) {
        self.joints = *joints;
        for (frame, &link) in self.arm.chain().frames(joints).iter().zip(&self.links[1..]) {
            self.physics.bodies[link].set_next_kinematic_position(pose(frame));
        }
        let base_from_hand = self.frame(6);
        self.jaws.drive(&mut self.physics, &base_from_hand);
        self.physics.step();
        self.steps += 1;
        self.watch();
    }

    /// Seconds since the start.
    pub fn time(&self) -> f64 {
        self.steps as f64 * STEP
    }

    /// The commanded joint angles.
    pub fn joints(&self) -> &JointAngles {
        &self.joints
    }

    /// The arm's kinematics.
    pub fn arm(&self) -> &Arm {
        &self.arm
    }

    /// The fingers.
    pub fn jaws(&self) -> &Jaws {
        &self.jaws
    }

    /// The fingers, to command them.
    pub fn jaws_mut(&mut self) -> &mut Jaws {
        &mut self.jaws
    }

    /// Where the object truly is.
    pub fn base_from_object(&self) -> Transform {
        transform(self.physics.bodies[self.object].position())
    }

    /// Whether the object was squeezed harder than it bears.
    pub fn broken(&self) -> bool {
        self.broken
    }

    /// The strongest contact of the robot with anything since the last call.
    pub fn take_touch(&mut self) -> Option<Touch> {
        self.touch.take()
    }

    /// The strongest contact of the robot with anything since the last [`World::take_touch`].
    pub fn touch(&self) -> Option<&Touch> {
        self.touch.as_ref()
    }

    /// The strongest contact of the robot in the newest step: what a motion feels now, whatever motions
    /// before it have touched.
    pub fn felt(&self) -> Option<&Touch> {
        self.felt.as_ref()
    }

    fn frame(&self, k: usize) -> Transform {
        self.arm.chain().frames(&self.joints)[k - 1]
    }

    /// Contacts between robot and rest, and the squeeze on the object.
    fn watch(&mut self) {
        self.felt = None;
        let mut squeeze = [0.0f64; 2];
        for pair in self.physics.narrow_phase.contact_pairs() {
            let names = (self.names.get(&pair.collider1), self.names.get(&pair.collider2));
            let (Some((a, robot_a)), Some((b, robot_b))) = names else { continue };
            if robot_a == robot_b {
                continue;
            }
            let mut force = f64::from(pair.total_impulse_magnitude()) / STEP;
            let (link, other) = if *robot_a { (a, b) } else { (b, a) };
            if *other != self.object_name && deepest(pair) > OVERLAP {
                force = f64::INFINITY;
            }
            let finger = self.jaws.which([pair.collider1, pair.collider2]);
            if let (Some(n), true) = (finger, *other == self.object_name) {
                squeeze[n] += force;
            }
            if force > self.felt.as_ref().map_or(1e-3, |t| t.force) {
                self.felt = Some(Touch { link: link.clone(), other: other.clone(), force });
            }
        }
        if let Some(felt) = &self.felt
            && self.touch.as_ref().is_none_or(|t| felt.force > t.force)
        {
            self.touch = self.felt.clone();
        }
        // Squeezed is what both fingers press; a push from one side is not.
        let over = squeeze[0].min(squeeze[1]) > self.strength;
        self.squeezed = if over { self.squeezed + STEP } else { 0.0 };
        self.broken |= self.squeezed > LASTING;
    }
}

/// How far two colliders overlap (m).
fn deepest(pair: &ContactPair) -> f32 {
    pair.find_deepest_contact().map_or(0.0, |(_, contact)| -contact.dist)
}

/// Bodies and names while the world is made.
struct Builder {
    physics: PhysicsWorld,
    names: std::collections::HashMap<ColliderHandle, (String, bool)>,
}

const ROBOT: Group = Group::GROUP_1;
const REST: Group = Group::GROUP_2;

impl Builder {
    /// A collider of a part; friction multiplies with that of the other side.
    fn collider(part: &Part, friction: f32, robot: bool) -> ColliderBuilder {
        let (shape, frame_from_shape) = part.shape();
        let (own, others) = if robot { (ROBOT, REST) } else { (REST, ROBOT | REST) };
        ColliderBuilder::new(shape.clone())
            .position(pose(frame_from_shape))
            .friction(friction)
            .friction_combine_rule(CoefficientCombineRule::Multiply)
            .restitution(0.0)
            .collision_groups(InteractionGroups::new(own, others, InteractionTestMode::And))
            .active_collision_types(
                ActiveCollisionTypes::default() | ActiveCollisionTypes::KINEMATIC_FIXED,
            )
    }

    fn add(
        &mut self,
        collider: ColliderBuilder,
        body: RigidBodyHandle,
        name: &str,
        robot: bool,
    ) -> ColliderHandle {
        let handle = self.physics.insert_collider(collider, Some(body));
        self.names.insert(handle, (name.into(), robot));
        handle
    }

    fn links(&mut self, arm: &Arm, setup: &Setup) -> Result<[RigidBodyHandle; 7], SetupError> {
        let frames = arm.chain().frames(setup.start);
        let links = std::array::from_fn(|k| {
            self.physics.insert_body(match k {
                0 => RigidBodyBuilder::fixed(),
                k => RigidBodyBuilder::kinematic_position_based().pose(pose(&frames[k - 1])),
            })
        });
        for body in setup.bodies.iter().filter(|b| b.slide.norm() < 0.5 && b.joints <= 6) {
            let part = part(&body.name, &body.frame_from_solid, &body.solid)?;
            // What stands still takes part as an obstacle.
            let moves = body.joints > 0;
            let collider = Self::collider(&part, TABLE_FRICTION, moves);
            // The pedestal and the masts touch the first link and the table; they hit nothing.
            if moves {
                self.add(collider, links[body.joints], &body.name, true);
            } else {
                self.add(
                    collider.collision_groups(InteractionGroups::none()),
                    links[0],
                    &body.name,
                    false,
                );
            }
        }
        Ok(links)
    }

    fn obstacle(&mut self, obstacle: &Obstacle) -> Result<(), SetupError> {
        let part = part(&obstacle.name, &obstacle.base_from_solid, &obstacle.solid)?;
        let body = self.physics.insert_body(RigidBodyBuilder::fixed());
        self.add(Self::collider(&part, TABLE_FRICTION, false), body, &obstacle.name, false);
        Ok(())
    }

    /// The object: friction one, so that the other side's friction holds; mass spread by volume.
    fn object(&mut self, object: &TrueObject) -> Result<RigidBodyHandle, SetupError> {
        let start = pose(&object.base_from_object);
        let body = RigidBodyBuilder::dynamic().pose(start).can_sleep(false);
        let body = self.physics.insert_body(body);
        let parts: Vec<Part> = object
            .solids
            .iter()
            .map(|p| part(&object.name, &p.object_from_solid, &p.solid))
            .collect::<Result<_, _>>()?;
        let volume: f32 = parts.iter().map(|p| p.shape().0.mass_properties(1.0).mass()).sum();
        let density = object.mass as f32 / volume;
        if !(density.is_finite() && density > 0.0) {
            return Err(SetupError::Empty(object.name.clone()));
        }
        for part in &parts {
            let collider = Self::collider(part, 1.0, false).density(density);
            self.add(collider, body, &object.name, false);
        }
        Ok(body)
    }

    fn jaws(&mut self, setup: &Setup, hand: RigidBodyHandle) -> Result<Jaws, SetupError> {
        let fingers: Vec<&Body> = setup.bodies.iter().filter(|b| b.slide.norm() > 0.5).collect();
        let [a, b] = fingers[..] else { return Err(SetupError::Fingers(fingers.len())) };
        let base_from_hand = transform(self.physics.bodies[hand].position());
        let mut jaws = Jaws::new(setup.gripper);
        for finger in [a, b] {
            let slide = Transform::from_parts(
                (finger.slide * setup.gripper.travel).into(),
                UnitQuaternion::identity(),
            );
            let place = base_from_hand * slide * finger.frame_from_solid;
            let body = self.physics.insert_body(
                RigidBodyBuilder::dynamic().pose(pose(&place)).can_sleep(false).gravity_scale(0.0),
            );
            let part = part(&finger.name, &Transform::identity(), &finger.solid)?;
            let collider = Self::collider(&part, setup.object.friction as f32, true)
                .mass(setup.finger_mass as f32);
            let collider = self.add(collider, body, &finger.name, true);
            jaws.add(&mut self.physics, hand, body, collider, finger);
        }
        Ok(jaws)
    }
}

fn part(
    name: &str,
    frame_from_solid: &Transform,
    solid: &vergence_geometry::Solid,
) -> Result<Part, SetupError> {
    Part::new(name, frame_from_solid, solid).ok_or_else(|| SetupError::Empty(name.into()))
}

/// To the library's single precision.
pub(crate) fn pose(transform: &Transform) -> Pose {
    let (t, q) = (transform.translation.vector, transform.rotation.coords);
    Pose::from_parts(
        Vector::new(t.x as f32, t.y as f32, t.z as f32),
        Rotation::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32),
    )
}

/// From the library's single precision.
pub(crate) fn transform(pose: &Pose) -> Transform {
    let (t, q) = (pose.translation, pose.rotation);
    let rotation = nalgebra::Quaternion::new(q.w.into(), q.x.into(), q.y.into(), q.z.into());
    Transform::from_parts(
        Vector3::new(t.x.into(), t.y.into(), t.z.into()).into(),
        UnitQuaternion::from_quaternion(rotation),
    )
}
