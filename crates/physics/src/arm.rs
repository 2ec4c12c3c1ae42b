//! The simulated arm behind [`devices::Arm`](vergence_devices::Arm): playing a trajectory steps the
//! world.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use vergence_devices::{
    Arm, ArmReading, Clock, DeviceError, Execution, GripCommand, GripperReading, MotionLimits,
};
use vergence_geometry::{JointAngles, Trajectory, Waypoint};

use crate::world::{STEP, World};

/// A world that the arm moves in and that others look at.
pub type SharedWorld = Arc<Mutex<World>>;

/// Largest distance (rad) between where the arm stands and a trajectory's start.
const START: f64 = 1e-3;
/// Time for the fingers to press before a grip counts as done (s).
const SETTLE: f64 = 0.15;

/// Speed and angles are sampled at each of the world's steps.
pub struct PhysicsArm {
    world: SharedWorld,
    /// Moves along with the world when the rest of the simulation has a clock of its own.
    clock: Option<Arc<dyn Clock>>,
    velocities: JointAngles,
}

impl PhysicsArm {
    /// An arm in a world. With a clock, the clock is moved on by each step and gives the stamps;
    /// without, time is the world's.
    pub fn new(world: SharedWorld, clock: Option<Arc<dyn Clock>>) -> Self {
        Self { world, clock, velocities: [0.0; 6] }
    }

    /// The world, for truth and pictures.
    pub fn world(&self) -> MutexGuard<'_, World> {
        self.world.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets time pass with the arm at rest.
    pub fn wait(&mut self, duration: Duration) {
        for _ in 0..(duration.as_secs_f64() / STEP).ceil() as usize {
            let joints = *self.world().joints();
            self.step(&joints);
        }
    }

    fn now(&self) -> Duration {
        match &self.clock {
            Some(clock) => clock.now(),
            None => Duration::from_secs_f64(self.world().time()),
        }
    }

    fn step(&mut self, joints: &JointAngles) {
        self.world().step(joints);
        if let Some(clock) = &self.clock {
            clock.sleep(Duration::from_secs_f64(STEP));
        }
    }

    fn reading(&self) -> GripperReading {
        let stamp = self.now();
        let world = self.world();
        let jaws = world.jaws();
        GripperReading {
            stamp,
            width: jaws.opening(),
            force: jaws.squeeze(),
            holding: jaws.holding(),
        }
    }

    /// Refuses what a controller refuses: a start elsewhere, times that do not rise.
    fn check(&self, trajectory: &Trajectory) -> Result<(), DeviceError> {
        let unsupported =
            |what: &str| Err(DeviceError::Unsupported { device: "arm".into(), what: what.into() });
        let Some(first) = trajectory.waypoints.first() else {
            return unsupported("a trajectory without waypoints");
        };
        let rising = |pair: &[Waypoint]| pair[0].time < pair[1].time;
        if first.time < 0.0 || !trajectory.waypoints.windows(2).all(rising) {
            return unsupported("a trajectory whose times do not rise");
        }
        let finite = |w: &Waypoint| w.positions.iter().chain(&w.velocities).all(|v| v.is_finite());
        if !trajectory.waypoints.iter().all(finite) {
            return unsupported("a trajectory with numbers that are not finite");
        }
        let world = self.world();
        let far = vergence_grasp::kinematics::distance(world.joints(), &first.positions);
        if far > START {
            return unsupported("a trajectory that starts elsewhere than where the arm stands");
        }
        if !trajectory.waypoints.iter().all(|w| world.arm().within_limits(&w.positions)) {
            return unsupported("a trajectory that leaves the range of a joint");
        }
        Ok(())
    }
}

impl Arm for PhysicsArm {
    fn joint_names(&self) -> [String; 6] {
        let world = self.world();
        let joints = &world.arm().chain().joints;
        std::array::from_fn(|k| joints[k].name.clone())
    }

    fn read(&mut self, _timeout: Duration) -> Result<ArmReading, DeviceError> {
        let (stamp, velocities) = (self.now(), self.velocities);
        Ok(ArmReading { stamp, positions: *self.world().joints(), velocities })
    }

    fn execute(
        &mut self,
        trajectory: &Trajectory,
        limits: &MotionLimits,
    ) -> Result<Execution, DeviceError> {
        self.check(trajectory)?;
        let steps = (trajectory.duration() / STEP).ceil() as usize;
        for n in 1..=steps {
            if limits.cancel.pressed() {
                self.velocities = [0.0; 6];
                return Ok(Execution::Stopped);
            }
            let Some(point) = trajectory.at(n as f64 * STEP) else { break };
            self.velocities = point.velocities;
            self.step(&point.positions);
            let world = self.world();
            let felt = world.felt().filter(|t| t.force > limits.contact_force);
            if let Some(touch) = felt {
                let (link, force) = (touch.link.clone(), touch.force);
                drop(world);
                self.velocities = [0.0; 6];
                return Ok(Execution::Contact { link, force });
            }
        }
        self.velocities = [0.0; 6];
        Ok(Execution::Reached)
    }

    fn grip(
        &mut self,
        command: GripCommand,
        timeout: Duration,
    ) -> Result<GripperReading, DeviceError> {
        if !(command.width.is_finite() && command.force > 0.0 && command.force.is_finite()) {
            let what = format!("a grip of {} m with {} N", command.width, command.force);
            return Err(DeviceError::Unsupported { device: "gripper".into(), what });
        }
        self.world().jaws_mut().command(command.width, command.force);
        let allowed = (timeout.as_secs_f64() / STEP) as usize;
        let mut settled = 0.0;
        for _ in 0..allowed {
            let joints = *self.world().joints();
            self.step(&joints);
            settled = if self.world().jaws().settled() { settled + STEP } else { 0.0 };
            if settled >= SETTLE {
                return Ok(self.reading());
            }
        }
        Err(DeviceError::Timeout { device: "gripper".into(), timeout })
    }

    fn gripper(&mut self, _timeout: Duration) -> Result<GripperReading, DeviceError> {
        Ok(self.reading())
    }
}
