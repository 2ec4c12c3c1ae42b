//! The simulated arm: joins the workcell, which shows what cameras see, with the contact physics,
//! which says what really happens.
//!
//! The object that is to be grasped is loose; the table, the other objects and the untagged things
//! are fixed. After every motion the object and the arm's links are put into the workcell where the
//! physics has them, so that the cameras see them there and what they hide is hidden.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use nalgebra::{Point3, Vector3};
use vergence::Hand;
use vergence::report::PhysicsReport;
use vergence_devices::{
    Arm, ArmReading, Config as Wiring, Description, DescriptionError, DeviceError, Execution,
    GripCommand, GripperReading, MotionLimits,
};
use vergence_geometry::{Body, Camera, Chain, Trajectory, Transform};
use vergence_grasp::{Config, Obstacle, gripper, object};
use vergence_imaging::canvas::{Canvas, colour};
use vergence_imaging::{Image, codec};
use vergence_physics::experiment::{Cell, HOME, table};
use vergence_physics::recording::{self, Motion};
use vergence_physics::{PhysicsArm, SharedWorld, Touch, TrueObject};
use vergence_sim::{ArmPart, Workcell};

use crate::failure::Failure;
use crate::save::{cannot_write, unwritten};

/// Contact before the fingers close above which the arm has run into something (N).
const BUMP: f64 = 0.5;
/// Size of a photograph (px).
const PHOTOGRAPH: [usize; 2] = [320, 320];
/// Height that the object must rise to count as lifted (mm): most of the planned lift of 100 mm.
const LIFTED_MM: f64 = 80.0;

/// What the physics noted of a grasp, shared between the arm and the judge.
pub struct Bench {
    world: SharedWorld,
    start: Transform,
    /// 1 when the fingers have opened, 2 when they have closed; 1 again when they let go for another try.
    grips: usize,
    collision: Option<Touch>,
    closing_error_mm: Option<f64>,
    /// What stood where before the first motion, and the motions since: for a second opinion.
    object: TrueObject,
    obstacles: Vec<Obstacle>,
    motions: Vec<Motion>,
    /// Photographs of the stages, when they are wanted.
    photographs: Option<Vec<Image<u8>>>,
}

impl Bench {
    fn pose(&self) -> Transform {
        self.world.lock().unwrap_or_else(PoisonError::into_inner).base_from_object()
    }

    /// Contacts since the last call are collisions as long as the fingers have not closed; with the object
    /// in the hand they are wanted.
    fn note_contacts(&mut self) {
        let touch = self.take_touch().filter(|touch| touch.force >= BUMP && self.grips < 2);
        self.collision = self.collision.take().or(touch);
    }

    /// The fingers have opened after they had closed: what moves from here on is another try and judged as
    /// the first was. That they touched the object while they let go of it is no collision.
    fn note_release(&mut self) {
        self.grips = 1;
        let touch = self
            .take_touch()
            .filter(|touch| touch.force >= BUMP && touch.other != self.object.name);
        self.collision = self.collision.take().or(touch);
    }

    fn take_touch(&self) -> Option<Touch> {
        self.world.lock().unwrap_or_else(PoisonError::into_inner).take_touch()
    }

    /// Writes the motions for `scripts/replay_mujoco.py` and the photographs side by side.
    pub fn save(&self, dir: &Path) -> Result<(), Failure> {
        let replay =
            recording::of_motions(&HOME, &self.object, &self.obstacles, &self.motions).to_string();
        let path = dir.join("replay.json");
        std::fs::write(&path, replay).map_err(|error| cannot_write(&path, error))?;
        let Some(strip) = self.strip() else { return Ok(()) };
        let path = dir.join("stages.png");
        codec::write_canvas(&path, &strip).map_err(unwritten)
    }

    /// The stages so far as an onlooker sees them, from left to right; `None` when none was taken.
    fn strip(&self) -> Option<Canvas> {
        let photographs = self.photographs.as_ref()?;
        let first = photographs.first()?;
        let mut strip =
            Canvas::new(first.width() * photographs.len(), first.height(), colour::WHITE);
        for (k, photograph) in photographs.iter().enumerate() {
            strip.blit_gray(photograph, k * first.width(), 0, 1);
        }
        Some(strip)
    }

    /// What really happened.
    pub fn verdict(&mut self) -> PhysicsReport {
        self.note_contacts();
        let risen = self.pose().translation.vector.z - self.start.translation.vector.z;
        let broken = self.world.lock().unwrap_or_else(PoisonError::into_inner).broken();
        let collision = self.collision.as_ref();
        PhysicsReport {
            lifted: 1e3 * risen > LIFTED_MM && !broken && collision.is_none(),
            risen_mm: 1e3 * risen,
            broken,
            collision: collision.map(|t| format!("{} touched {}", t.link, t.other)),
            closing_error_mm: self.closing_error_mm,
        }
    }
}

/// A bench that the arm and the judge share.
pub type SharedBench = Arc<Mutex<Bench>>;

/// The arm behind its trait; the workcell follows what it does.
pub struct SimArm {
    arm: PhysicsArm,
    bench: SharedBench,
    workcell: Arc<Workcell>,
    object: String,
    links: Vec<Link>,
    /// Id of the tag on the gripper and the chain to it.
    tag: Option<(String, Chain)>,
}

/// A part of the arm and how bright it is.
struct Link {
    body: Body,
    albedo: f32,
}

/// Builds the physics of a workcell around one object; `None` when there is no such object.
pub fn build(
    workcell: &Arc<Workcell>,
    description: &Description,
    object: &str,
    photographs: bool,
) -> Result<Option<(SimArm, SharedBench)>, Failure> {
    let truth = workcell.truth();
    let Some(wanted) = truth.objects.iter().find(|o| o.id == object) else { return Ok(None) };
    let assumed = Config::default().assumptions;
    let solids = |record: &vergence_tag::Record| {
        let mut solids = object::solids(record, assumed.wall);
        solids.extend(object::housings(record, assumed.housing));
        solids
    };
    let mut obstacles = vec![table()];
    for other in truth.objects.iter().filter(|o| o.id != object) {
        obstacles.extend(solids(&other.record).into_iter().map(|part| Obstacle {
            name: other.id.clone(),
            base_from_solid: other.base_from_object * part.object_from_solid,
            solid: part.solid,
        }));
    }
    obstacles.extend(truth.clutter.iter().map(|(place, solid)| Obstacle {
        name: "clutter".into(),
        base_from_solid: *place,
        solid: solid.clone(),
    }));
    let surface = gripper::surface(&wanted.record.physical);
    let volume = object::volume(&wanted.record);
    let loose = TrueObject {
        name: wanted.id.clone(),
        solids: solids(&wanted.record),
        base_from_object: wanted.base_from_object,
        mass: wanted.record.physical.weight.unwrap_or(1000.0 * volume),
        friction: surface.friction,
        strength: surface.strength,
    };
    let unusable = |error: &dyn std::fmt::Display| {
        Failure::misuse(
            error,
            "compare with the workcell that is built in: `vergence workcell DIR`",
        )
    };
    let path = Path::new("workcell.urdf");
    let cell = Cell::parse(&description.text, path).map_err(|e| unusable(&e))?;
    let world = cell.world(&HOME, &obstacles, &loose).map_err(|e| unusable(&e))?;
    let world: SharedWorld = Arc::new(Mutex::new(world));
    let bench = Arc::new(Mutex::new(Bench {
        world: world.clone(),
        start: wanted.base_from_object,
        grips: 0,
        collision: None,
        closing_error_mm: None,
        object: loose,
        obstacles,
        motions: Vec::new(),
        photographs: photographs.then(Vec::new),
    }));
    let links = links(description, &cell);
    let arm = PhysicsArm::new(world, Some(Arc::from(workcell.clock())));
    let tag = workcell.config().arm.as_ref().and_then(|arm| arm.tag.as_ref());
    let tag = tag.map(|tag| Ok((tag.object_id.clone(), description.chain("base", &tag.link)?)));
    let tag = tag.transpose().map_err(|e: DescriptionError| unusable(&e))?;
    let (workcell, object) = (workcell.clone(), object.into());
    let arm = SimArm { arm, bench: bench.clone(), workcell, object, links, tag };
    arm.show();
    arm.photograph();
    Ok(Some((arm, bench)))
}

/// What cameras see of the arm: what its joints move, and the link that these stand on. The heads do
/// not see themselves.
fn links(description: &Description, cell: &Cell) -> Vec<Link> {
    let robot = description.robot();
    let first = cell.chain.joints.first().map(|joint| joint.name.as_str());
    let pedestal = robot.joints.iter().find(|joint| Some(joint.name.as_str()) == first);
    let pedestal = pedestal.map(|joint| joint.parent.link.as_str());
    let seen = |body: &&Body| body.joints > 0 || Some(body.name.as_str()) == pedestal;
    let bodies = cell.bodies.iter().filter(seen);
    bodies
        .map(|body| Link { body: body.clone(), albedo: albedo(description, &body.name) })
        .collect()
}

/// Brightness of a link's first material; grey when the description gives none.
fn albedo(description: &Description, link: &str) -> f32 {
    let robot = description.robot();
    let visual = robot.links.iter().find(|l| l.name == link).and_then(|l| l.visual.first());
    let named = visual.and_then(|v| v.material.as_ref());
    let colour = named.and_then(|m| {
        let own = m.color.as_ref();
        own.or_else(|| robot.materials.iter().find(|o| o.name == m.name)?.color.as_ref())
    });
    colour.map_or(0.5, |c| (c.rgba.0.iter().take(3).sum::<f64>() / 3.0) as f32)
}

impl SimArm {
    /// Keeps a photograph of the object from the side that the arm does not come from.
    fn photograph(&self) {
        let mut bench = lock(&self.bench);
        let target = Point3::from(bench.start.translation.vector + Vector3::new(0.0, 0.0, 0.05));
        let Some(photographs) = &mut bench.photographs else { return };
        let eye = target + Vector3::new(-0.35, 0.5, 0.25);
        let lens = Camera::centred(PHOTOGRAPH[0], PHOTOGRAPH[1], 380.0);
        photographs.push(self.workcell.photograph(&eye, &target, lens));
    }

    fn show(&self) {
        let pose = lock(&self.bench).pose();
        self.workcell.place_object(&self.object, &pose);
        let world = self.arm.world();
        let frames = world.arm().chain().frames(world.joints());
        let open = 0.5 * world.jaws().opening();
        let tag = self.tag.as_ref().map(|(id, chain)| (id, chain.forward(world.joints())));
        drop(world);
        if let Some((id, base_from_tag)) = tag {
            self.workcell.place_object(id, &base_from_tag);
        }
        let parts: Vec<ArmPart> = self
            .links
            .iter()
            .map(|Link { body, albedo }| {
                let base = body.joints.checked_sub(1).map_or(Transform::identity(), |k| frames[k]);
                let slide = Transform::from_parts((body.slide * open).into(), Default::default());
                ArmPart {
                    base_from_solid: base * slide * body.frame_from_solid,
                    solid: body.solid.clone(),
                    albedo: *albedo,
                }
            })
            .collect();
        self.workcell.show_arm(&parts);
    }
}

/// Locks the bench; a panic elsewhere leaves plain data, which stays usable.
pub fn lock(bench: &SharedBench) -> std::sync::MutexGuard<'_, Bench> {
    bench.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Arm for SimArm {
    fn joint_names(&self) -> [String; 6] {
        self.arm.joint_names()
    }

    fn read(&mut self, timeout: Duration) -> Result<ArmReading, DeviceError> {
        self.arm.read(timeout)
    }

    fn execute(
        &mut self,
        trajectory: &Trajectory,
        limits: &MotionLimits,
    ) -> Result<Execution, DeviceError> {
        let outcome = self.arm.execute(trajectory, limits);
        let mut bench = lock(&self.bench);
        bench.motions.push(Motion::Move(trajectory.clone()));
        let moves = bench.motions.iter().filter(|m| matches!(m, Motion::Move(_))).count();
        let grips = bench.grips;
        drop(bench);
        self.show();
        // At the pre-grasp, and with the object lifted.
        if (moves, grips) == (1, 1) || grips == 2 {
            self.photograph();
        }
        outcome
    }

    fn grip(
        &mut self,
        command: GripCommand,
        timeout: Duration,
    ) -> Result<GripperReading, DeviceError> {
        let mut bench = lock(&self.bench);
        bench.note_contacts();
        // A grasp that is tried again opens the fingers more than once before it closes them.
        let closing = bench.grips == 1 && command.width == 0.0;
        let release = bench.grips == 2 && command.width > 0.0;
        bench.grips = if closing { 2 } else { bench.grips.max(1) };
        bench.motions.push(Motion::Grip(command));
        let before = bench.pose();
        drop(bench);
        let outcome = self.arm.grip(command, timeout);
        let mut bench = lock(&self.bench);
        if closing {
            let shift = bench.pose().translation.vector - before.translation.vector;
            bench.closing_error_mm = Some(1e3 * shift.xy().norm());
        }
        if release {
            bench.note_release();
        }
        drop(bench);
        self.show();
        if closing {
            self.photograph();
        }
        outcome
    }

    fn gripper(&mut self, timeout: Duration) -> Result<GripperReading, DeviceError> {
        self.arm.gripper(timeout)
    }
}

/// What the robot knows of its arm.
pub fn hand(config: &Wiring, description: &Description) -> Result<Hand, Failure> {
    Hand::read(config, description).map_err(|error| {
        Failure::misuse(
            error,
            "compare with the workcell that is built in: `vergence workcell DIR`",
        )
    })
}

#[cfg(test)]
mod tests {
    use vergence::GraspConfig;
    use vergence_geometry::Waypoint;
    use vergence_sim::Scenario;

    use super::*;
    use crate::robot::Opened;

    /// An arm that stops half way of one motion, as if it had touched something.
    struct Stopped {
        arm: Box<dyn Arm>,
        motions: usize,
        at: usize,
        /// What it was told since then: the fingers' widths, `None` for a motion.
        told: Arc<Mutex<Vec<Option<f64>>>>,
    }

    impl Arm for Stopped {
        fn joint_names(&self) -> [String; 6] {
            self.arm.joint_names()
        }

        fn read(&mut self, timeout: Duration) -> Result<ArmReading, DeviceError> {
            self.arm.read(timeout)
        }

        fn execute(
            &mut self,
            trajectory: &Trajectory,
            limits: &MotionLimits,
        ) -> Result<Execution, DeviceError> {
            self.motions += 1;
            self.told.lock().unwrap().push(None);
            if self.motions != self.at {
                return self.arm.execute(trajectory, limits);
            }
            let half = trajectory.waypoints.len().div_ceil(2);
            let first = Trajectory { waypoints: trajectory.waypoints[..half].to_vec() };
            self.arm.execute(&first, limits)?;
            Ok(Execution::Contact { link: "hand".into(), force: 20.0 })
        }

        fn grip(
            &mut self,
            command: GripCommand,
            timeout: Duration,
        ) -> Result<GripperReading, DeviceError> {
            self.told.lock().unwrap().push(Some(command.width));
            self.arm.grip(command, timeout)
        }

        fn gripper(&mut self, timeout: Duration) -> Result<GripperReading, DeviceError> {
            self.arm.gripper(timeout)
        }
    }

    #[test]
    fn a_way_that_is_blocked_once_is_gone_back_and_the_cup_grasped() {
        // Transfer, correction, approach.
        for at in [1, 3] {
            let mut robot = Opened::embedded(3, Scenario::Reach).unwrap();
            robot.attach_arm("cup", false).unwrap();
            let arm = robot.system.robot.arm.take().unwrap();
            let told = Arc::new(Mutex::new(Vec::new()));
            let stopped = Stopped { arm, motions: 0, at, told: told.clone() };
            robot.system.robot.arm = Some(Box::new(stopped));
            let report =
                vergence::grasp(&mut robot.system, "cup", &GraspConfig::default(), &mut ());
            let grasp = report.grasp.unwrap();
            assert!(grasp.succeeded, "{grasp:?}");
            assert!(grasp.first_failure.as_ref().unwrap().contains("hand touched"), "{grasp:?}");
            // Another grasp has another opening; the fingers take it before the hand goes near.
            let told = told.lock().unwrap().clone();
            let close = told.iter().position(|grip| *grip == Some(0.0)).unwrap();
            let [Some(opening), None, None] = told[close - 3..close] else { panic!("{told:?}") };
            assert!(opening > grasp.width.unwrap(), "{told:?}, {grasp:?}");
            let physics = robot.physics().unwrap();
            assert!(physics.lifted && physics.collision.is_none(), "{physics:?}");
        }
    }

    #[test]
    fn what_the_arm_runs_into_in_a_second_try_is_a_collision_too() {
        let mut robot = Opened::embedded(3, Scenario::Reach).unwrap();
        robot.attach_arm("cup", false).unwrap();
        let mut arm = robot.system.robot.arm.take().unwrap();
        // Opened, closed on nothing, opened again.
        for width in [0.1, 0.0, 0.1] {
            arm.grip(GripCommand { width, force: 20.0 }, Duration::from_secs(10)).unwrap();
        }
        assert_eq!(robot.physics().unwrap().collision, None);
        let stands = arm.read(Duration::ZERO).unwrap().positions;
        let mut below = stands;
        // Shoulder and elbow stretch until the hand is in the table.
        below[1] += 1.9;
        below[2] -= 0.7;
        let point = |time, positions| Waypoint { time, positions, velocities: [0.0; 6] };
        let down = Trajectory { waypoints: vec![point(0.0, stands), point(4.0, below)] };
        let outcome = arm.execute(&down, &MotionLimits::default()).unwrap();
        assert!(matches!(outcome, Execution::Contact { .. }), "{outcome:?}");
        assert!(robot.physics().unwrap().collision.is_some());
    }
}
