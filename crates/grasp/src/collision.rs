//! Does the arm touch anything at these joint angles?
//!
//! In: the robot's solids on its chain, obstacles in the base frame, joint angles, finger opening.
//! Out: `Ok` when every pair keeps its distance, else the pair that does not.
//!
//! Pairs that are tested: every moving body against every obstacle and fixed body, and moving bodies
//! against each other. Neighbours (bodies of one joint, or of adjacent joints that meet with all axes
//! at zero) are left out: a bearing joins them. Distances are those of `parry3d` between
//! convex solids, after a test of bounding balls. A motion is tested at samples so dense that no point
//! of the arm moves further than [`STEP`] between two of them; a clearance above half of that leaves
//! no gap.

use nalgebra::{Translation3, Vector3};
use parry3d::math::{Pose, Vector};
use parry3d::query;
use parry3d::shape::SharedShape;
use vergence_geometry::{Body, JointAngles, Solid, Transform};

use crate::kinematics::Arm;

/// Largest motion of any point of the arm between two tested samples (m).
pub const STEP: f64 = 0.010;

/// Bodies of adjacent joints that are nearer than this at zero meet in a bearing (m).
const BOLTED: f64 = 0.025;

/// Something solid that stands in the base frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Obstacle {
    /// For messages: "table", "lamp".
    pub name: String,
    /// Where it stands.
    pub base_from_solid: Transform,
    /// Its form.
    pub solid: Solid,
}

/// Two things that touch, or come too near.
#[derive(Debug, Clone, PartialEq)]
pub struct Hit {
    /// One of them, a link of the robot.
    pub link: String,
    /// The other.
    pub other: String,
    /// Their distance (m), zero when they overlap.
    pub distance: f64,
}

/// Distances that a motion must keep (m).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clearances {
    /// Between the arm and obstacles, and between parts of the arm.
    pub world: f64,
    /// Between the arm and the object.
    pub object: f64,
}

/// A solid made ready for distance queries, in some frame.
#[derive(Clone)]
pub struct Part {
    name: String,
    shape: SharedShape,
    frame_from_shape: Transform,
    radius: f64,
}

impl Part {
    /// `None` for a convex hull of points that enclose no volume.
    pub fn new(name: &str, frame_from_solid: &Transform, solid: &Solid) -> Option<Self> {
        let (shape, solid_from_shape) = shape_of(solid)?;
        Some(Self {
            name: name.into(),
            shape,
            frame_from_shape: frame_from_solid * solid_from_shape,
            radius: solid.bounding_radius(),
        })
    }

    /// The library's shape, and where it sits in the part's frame.
    pub fn shape(&self) -> (&SharedShape, &Transform) {
        (&self.shape, &self.frame_from_shape)
    }

    /// The name for messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The same part in another frame.
    pub fn moved(&self, new_from_frame: &Transform) -> Self {
        Self { frame_from_shape: new_from_frame * self.frame_from_shape, ..self.clone() }
    }

    fn posed(&self, base_from_frame: &Transform) -> Posed<'_> {
        let base_from_shape = base_from_frame * self.frame_from_shape;
        Posed {
            part: self,
            centre: base_from_shape.translation.vector,
            pose: pose(&base_from_shape),
        }
    }
}

struct Posed<'a> {
    part: &'a Part,
    centre: Vector3<f64>,
    pose: Pose,
}

impl Posed<'_> {
    /// The distance when it is below `needed`.
    fn nearer_than(&self, other: &Posed, needed: f64) -> Option<f64> {
        let balls = (self.centre - other.centre).norm() - self.part.radius - other.part.radius;
        if balls > needed {
            return None;
        }
        let (a, b) = (&*self.part.shape, &*other.part.shape);
        // Unsupported pairs do not occur among these shapes; if one did it must count as touching.
        let distance = query::distance(&self.pose, a, &other.pose, b).map_or(0.0, |d| d.distance);
        (f64::from(distance) < needed).then_some(f64::from(distance))
    }
}

/// What surrounds the arm in one phase of a motion.
#[derive(Clone, Default)]
pub struct Surroundings {
    /// Obstacles in the base frame.
    pub world: Vec<Part>,
    /// The object where it lies, in the base frame; empty when it is in the hand.
    pub object: Vec<Part>,
    /// The object in the hand, in the tip's frame.
    pub carried: Vec<Part>,
}

/// The robot's solids, ready for distance queries.
#[derive(Clone)]
pub struct RobotShape {
    parts: Vec<(Body, Part)>,
    pairs: Vec<(usize, usize)>,
    /// For each joint, how far any body that it moves can be from its axis (m).
    levers: JointAngles,
}

impl RobotShape {
    /// Prepares the bodies of a robot; bodies without volume are left out.
    pub fn new(arm: &Arm, bodies: &[Body]) -> Self {
        let ready = |body: &Body| {
            let part = Part::new(&body.name, &body.frame_from_solid, &body.solid)?;
            (body.joints <= 6).then(|| (body.clone(), part))
        };
        let parts: Vec<(Body, Part)> = bodies.iter().filter_map(ready).collect();
        let mut shape = Self { parts, pairs: Vec::new(), levers: [0.0; 6] };
        let at_zero = shape.posed(arm, &[0.0; 6], 0.0);
        let mut pairs = Vec::new();
        for a in 0..shape.parts.len() {
            for b in 0..a {
                let (i, j) = (shape.parts[a].0.joints, shape.parts[b].0.joints);
                let bolted =
                    i.abs_diff(j) == 1 && at_zero[a].nearer_than(&at_zero[b], BOLTED).is_some();
                if i != j && !bolted {
                    pairs.push((a, b));
                }
            }
        }
        drop(at_zero);
        shape.pairs = pairs;
        shape.levers = shape.measure_levers(arm);
        shape
    }

    /// Sum of the links' lengths from each joint to the far end of what it moves.
    fn measure_levers(&self, arm: &Arm) -> JointAngles {
        let offset = |m: usize| arm.chain().joints[m].parent_from_joint.translation.vector.norm();
        let mut levers = [0.0f64; 6];
        for (body, part) in &self.parts {
            for (k, lever) in levers.iter_mut().enumerate().take(body.joints) {
                let links: f64 = (k + 1..body.joints).map(offset).sum();
                let own = body.frame_from_solid.translation.vector.norm() + part.radius;
                *lever = lever.max(links + own);
            }
        }
        levers
    }

    /// Upper bound of the way of any point of the robot between two postures on a straight line in
    /// joint space (m).
    pub fn travel(&self, a: &JointAngles, b: &JointAngles) -> f64 {
        (0..6).map(|k| (a[k] - b[k]).abs() * self.levers[k]).sum()
    }

    fn posed(&self, arm: &Arm, joints: &JointAngles, opening: f64) -> Vec<Posed<'_>> {
        let frames = arm.chain().frames(joints);
        let frame = |body: &Body| match body.joints {
            0 => Transform::identity(),
            n => frames[n - 1],
        };
        let slid = |body: &Body| frame(body) * Translation3::from(body.slide * (opening / 2.0));
        self.parts.iter().map(|(body, part)| part.posed(&slid(body))).collect()
    }

    /// Tests one posture.
    pub fn check(
        &self,
        arm: &Arm,
        joints: &JointAngles,
        opening: f64,
        around: &Surroundings,
        clearances: &Clearances,
    ) -> Result<(), Hit> {
        let posed = self.posed(arm, joints, opening);
        for &(a, b) in &self.pairs {
            hit(&posed[a], &posed[b], clearances.world)?;
        }
        let identity = Transform::identity();
        let moving = || self.parts.iter().zip(&posed).filter(|((body, _), _)| body.joints > 0);
        for part in &around.world {
            let fixed = part.posed(&identity);
            for (_, link) in moving() {
                hit(link, &fixed, clearances.world)?;
            }
        }
        for part in &around.object {
            let object = part.posed(&identity);
            for (_, link) in moving() {
                hit(link, &object, clearances.object)?;
            }
        }
        if !around.carried.is_empty() {
            self.check_carried(arm, joints, &posed, around, clearances)?;
        }
        Ok(())
    }

    /// The object in the hand against the world and the arm up to the wrist.
    fn check_carried(
        &self,
        arm: &Arm,
        joints: &JointAngles,
        posed: &[Posed],
        around: &Surroundings,
        clearances: &Clearances,
    ) -> Result<(), Hit> {
        let base_from_tip = arm.forward(joints);
        for part in &around.carried {
            let carried = part.posed(&base_from_tip);
            for fixed in &around.world {
                hit(&carried, &fixed.posed(&Transform::identity()), clearances.world)?;
            }
            for ((body, _), link) in self.parts.iter().zip(posed) {
                if body.joints < 6 {
                    hit(&carried, link, clearances.world)?;
                }
            }
        }
        Ok(())
    }

    /// Tests a straight line in joint space, both ends included.
    pub fn check_line(
        &self,
        arm: &Arm,
        from: &JointAngles,
        to: &JointAngles,
        opening: f64,
        around: &Surroundings,
        clearances: &Clearances,
    ) -> Result<(), Hit> {
        let steps = (self.travel(from, to) / STEP).ceil().max(1.0) as usize;
        // Ends and coarse samples first: most lines that collide do so in the middle.
        for n in coarse_first(steps) {
            let joints = blend(from, to, n as f64 / steps as f64);
            self.check(arm, &joints, opening, around, clearances)?;
        }
        Ok(())
    }
}

/// `(1 - s) a + s b`, exact at both ends.
pub fn blend(a: &JointAngles, b: &JointAngles, s: f64) -> JointAngles {
    std::array::from_fn(|k| (1.0 - s) * a[k] + s * b[k])
}

/// 0..=steps, every eighth first, then the rest.
fn coarse_first(steps: usize) -> impl Iterator<Item = usize> {
    let coarse = move |n: &usize| n.is_multiple_of(8) || *n == steps;
    (0..=steps).filter(coarse).chain((0..=steps).filter(move |n| !coarse(n)))
}

fn hit(a: &Posed, b: &Posed, needed: f64) -> Result<(), Hit> {
    match a.nearer_than(b, needed) {
        None => Ok(()),
        Some(distance) => {
            Err(Hit { link: a.part.name.clone(), other: b.part.name.clone(), distance })
        }
    }
}

/// The world's solids as parts; solids without volume are left out.
pub fn parts_of(obstacles: &[Obstacle]) -> Vec<Part> {
    obstacles.iter().filter_map(|o| Part::new(&o.name, &o.base_from_solid, &o.solid)).collect()
}

/// Whether two sets of parts come nearer than a distance when placed in the base frame.
pub fn near(a: &Part, base_from_a: &Transform, b: &Part, distance: f64) -> bool {
    a.posed(base_from_a).nearer_than(&b.posed(&Transform::identity()), distance).is_some()
}

/// The library's shape and how it is turned: its cylinders stand along y, ours along z.
fn shape_of(solid: &Solid) -> Option<(SharedShape, Transform)> {
    let identity = Transform::identity();
    Some(match solid {
        Solid::Cuboid { half } => {
            (SharedShape::cuboid(half.x as f32, half.y as f32, half.z as f32), identity)
        }
        Solid::Cylinder { radius, half_height } => {
            let turn = Vector3::x() * std::f64::consts::FRAC_PI_2;
            (
                SharedShape::cylinder(*half_height as f32, *radius as f32),
                Transform::new(Vector3::zeros(), turn),
            )
        }
        Solid::Sphere { radius } => (SharedShape::ball(*radius as f32), identity),
        Solid::Convex { vertices } => {
            let points: Vec<Vector> =
                vertices.iter().map(|v| Vector::new(v.x as f32, v.y as f32, v.z as f32)).collect();
            (SharedShape::convex_hull(&points)?, identity)
        }
    })
}

fn pose(transform: &Transform) -> Pose {
    let (t, q) = (transform.translation.vector, transform.rotation.coords);
    let mut pose = Pose::identity();
    pose.translation = Vector::new(t.x as f32, t.y as f32, t.z as f32);
    (pose.rotation.x, pose.rotation.y) = (q.x as f32, q.y as f32);
    (pose.rotation.z, pose.rotation.w) = (q.z as f32, q.w as f32);
    pose
}
