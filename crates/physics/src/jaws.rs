//! The parallel gripper: two fingers that move as one and press with a commanded force.
//!
//! Both fingers are held by stiff springs to one common opening, so the pair keeps its middle, as a
//! gripper with one spindle does. The force on what is between them is the springs' mean deflection:
//! the common opening follows the fingers at the distance that makes the commanded force.

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rapier3d::prelude::*;
use vergence_devices::GripperJoints;
use vergence_geometry::{Body, Transform};

use crate::world::{STEP, pose, transform};

/// Stiffness of a finger against its spindle (N/m): 1 mm at 20 N, as in a real gripper's gears.
const STIFFNESS: f64 = 20_000.0;
/// Damping (N s/m): critical for a finger of 80 g.
const DAMPING: f64 = 80.0;
/// Speed of a finger (m/s) when the command does not limit it.
const SPEED: f64 = 0.030;

struct Finger {
    body: RigidBodyHandle,
    collider: ColliderHandle,
    joint: ImpulseJointHandle,
    /// Where the finger's solid sits in the hand when closed, and its way outwards.
    hand_from_closed: Transform,
    slide: Vector3<f64>,
    /// Way outwards from the middle (m), as last measured.
    way: f64,
}

/// The two fingers.
pub struct Jaws {
    fingers: Vec<Finger>,
    travel: f64,
    effort: f64,
    speed: f64,
    /// Half opening that the spindle stands at, is commanded to, and the force allowed.
    spindle: f64,
    goal: f64,
    force: f64,
}

impl Jaws {
    pub(crate) fn new(gripper: &GripperJoints) -> Self {
        Self {
            fingers: Vec::new(),
            travel: gripper.travel,
            effort: gripper.effort,
            speed: SPEED.min(gripper.velocity),
            spindle: gripper.travel,
            goal: gripper.travel,
            force: gripper.effort,
        }
    }

    pub(crate) fn add(
        &mut self,
        physics: &mut PhysicsWorld,
        hand: RigidBodyHandle,
        body: RigidBodyHandle,
        collider: ColliderHandle,
        finger: &Body,
    ) {
        // The joint's x axis is the finger's way outwards.
        let turn = Rotation3::rotation_between(&Vector3::x(), &finger.slide).unwrap_or_else(|| {
            Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI)
        });
        let turn = UnitQuaternion::from_rotation_matrix(&turn);
        let closed = finger.frame_from_solid;
        let in_hand = Transform::from_parts(closed.translation, turn);
        let in_finger = Transform::from_parts(Default::default(), closed.rotation.inverse() * turn);
        let joint = GenericJointBuilder::new(JointAxesMask::LOCKED_PRISMATIC_AXES)
            .local_frame1(pose(&in_hand))
            .local_frame2(pose(&in_finger))
            .contacts_enabled(false)
            .motor_model(JointAxis::LinX, MotorModel::ForceBased);
        let joint = physics.insert_impulse_joint(hand, body, joint);
        self.fingers.push(Finger {
            body,
            collider,
            joint,
            hand_from_closed: closed,
            slide: finger.slide,
            way: self.travel,
        });
    }

    /// Sets where the fingers shall go and how hard they may press; opening in m, force in N.
    pub fn command(&mut self, opening: f64, force: f64) {
        self.goal = (opening / 2.0).clamp(0.0, self.travel);
        self.force = force.clamp(0.0, self.effort);
    }

    /// Largest force (N).
    pub fn effort(&self) -> f64 {
        self.effort
    }

    /// Opening between the fingers (m).
    pub fn opening(&self) -> f64 {
        self.fingers.iter().map(|f| f.way).sum()
    }

    /// Force on what is between the fingers (N): the springs' mean deflection.
    pub fn squeeze(&self) -> f64 {
        ((self.opening() / 2.0 - self.spindle) * STIFFNESS).max(0.0)
    }

    /// Whether the commanded opening is reached, or the commanded force.
    pub fn settled(&self) -> bool {
        let there = (self.opening() / 2.0 - self.goal).abs() < 2e-4;
        there || self.holding()
    }

    /// Whether the fingers press on something short of the commanded opening.
    pub fn holding(&self) -> bool {
        self.opening() / 2.0 > self.goal + 2e-4 && self.squeeze() > 0.9 * self.force
    }

    pub(crate) fn which(&self, colliders: [ColliderHandle; 2]) -> Option<usize> {
        self.fingers.iter().position(|f| colliders.contains(&f.collider))
    }

    /// One step of the spindle: towards the goal, no further ahead of the fingers than the force.
    pub(crate) fn drive(&mut self, physics: &mut PhysicsWorld, base_from_hand: &Transform) {
        for finger in &mut self.fingers {
            let place = transform(physics.bodies[finger.body].position());
            let in_hand = base_from_hand.inverse() * place;
            let shift = in_hand.translation.vector - finger.hand_from_closed.translation.vector;
            finger.way = shift.dot(&finger.slide);
        }
        let mean = self.opening() / 2.0;
        let before = self.spindle;
        let step = self.speed * STEP;
        let wanted = self.goal.clamp(before - step, before + step);
        let furthest = mean - self.force / STIFFNESS;
        // Closing stops where the force is reached; it backs off no faster than it opens.
        self.spindle = if wanted < furthest { furthest.min(before + step) } else { wanted };
        let speed = (self.spindle - before) / STEP;
        for finger in &self.fingers {
            let Some(joint) = physics.impulse_joints.get_mut(finger.joint, true) else { continue };
            joint.data.set_motor(
                JointAxis::LinX,
                self.spindle as f32,
                speed as f32,
                STIFFNESS as f32,
                DAMPING as f32,
            );
            joint.data.set_motor_max_force(JointAxis::LinX, 2.0 * self.effort as f32);
        }
    }
}
