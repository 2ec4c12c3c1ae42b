//! Grasp: find the object, plan, and carry the plan out with the heads looking on.
//!
//! ```text
//! find -> plan -> transfer -> look again -> correct -> approach -> close -> lift -> verify
//!                                ^                |                |
//!                                '--- back off ---+----------------'   once
//! ```
//!
//! In: an object's name. Out: the [`Report`] of the find with its `grasp` part; it is complete also
//! when the grasp is refused or fails, and then says why. What the planner knows is what the robot
//! knows: the tag's record, the recognised pose with its covariance, and the table's plane, which is
//! z = 0 of the base frame by the convention of the URDF. Untagged things are not known to it; the
//! arm watches for contact while it moves and stops at the first.
//!
//! Success is claimed only when the gripper feels the object after the lift *and* the heads have seen
//! the landmark move as the hand did: both measure its place, or, when the hand hides it from one, the
//! other sees it in the direction where the hand must have carried it. The second look is a correction,
//! not a need: when the hand hides the object, the grasp stands on the first. When it hides the lifted
//! landmark from both heads, the hand turns and they look once more.
//!
//! A way that turns out to be blocked is gone back and the next best grasp tried; when the fingers close on
//! nothing, the heads look again. Both happen once.

use std::time::Duration;

use nalgebra::{Translation3, Vector3};
use vergence_devices::{DeviceError, Execution, GripCommand, GripperReading, MotionLimits, Side};
use vergence_geometry::{Solid, Trajectory, Transform};
use vergence_grasp::{
    LiftVerdict, Obstacle, Plan, Refusal, Request, correct, next_best, plan, relative_to_hand,
    timing, turn_in_sight, verify_lift,
};

use look::Sight;

use crate::event::{Event, Observer};
use crate::find::{FindConfig, Found, Run, Stop, describe};
use crate::report::{GraspReport, Report};
use crate::system::{Hand, System};

mod look;

/// Longest wait for the fingers to reach their goal.
const FINGERS: Duration = Duration::from_secs(10);
/// Longest wait for an answer of the arm's encoders.
const ANSWER: Duration = Duration::from_secs(1);

/// Turns (rad) of the lifted hand that bring a landmark below it in sight: from under the palm's length
/// to under its thickness, its light still turned to the heads. To one side, then to the other.
const TURNS: [f64; 2] = [0.8, -1.6];

/// Settings of a grasp.
#[derive(Debug, Clone, Default)]
pub struct GraspConfig {
    /// Of the find.
    pub find: FindConfig,
    /// Of the planner.
    pub planner: vergence_grasp::Config,
    /// Of every motion: the stop button and the force at which the arm stops by itself.
    pub limits: MotionLimits,
}

/// Why a grasp ended without the object in the hand.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error("this robot has no arm")]
    NoArm,
    #[error("{0}")]
    Refused(#[from] Refusal),
    #[error("{step}: {what}")]
    Motion { step: &'static str, what: String },
    #[error("{step}: {link} touched something with {force:.1} N")]
    Contact { step: &'static str, link: String, force: f64 },
    #[error("the fingers closed on nothing")]
    Empty,
    #[error("the object left the fingers during the lift")]
    Dropped,
    #[error("after the lift the landmark is not where the hand would have carried it: {0}")]
    NotLifted(&'static str),
    #[error("looking again: {0}")]
    Look(#[from] Stop),
    #[error("{0}")]
    Device(#[from] DeviceError),
}

impl Failure {
    /// Before the object was lifted, and not for good: what is in the way or where the object is may be
    /// otherwise for the next grasp or after another look.
    fn is_worth_another_try(&self) -> bool {
        matches!(
            self,
            Failure::Contact { .. }
                | Failure::Empty
                | Failure::Refused(Refusal::Occupied(_) | Refusal::Unreachable(_))
        )
    }

    /// What a person can do about it.
    fn hint(&self) -> &'static str {
        match self {
            Failure::NoArm => "name the arm's driver in the configuration's table [arm]",
            Failure::Refused(Refusal::Fixed(_) | Refusal::TooHeavy { .. }) => {
                "if the record is wrong, write a correct one to the tag"
            }
            Failure::Refused(Refusal::Unreachable(_)) => "move the object nearer to the arm",
            Failure::Refused(_) => "free the object's surroundings, or look from nearer",
            Failure::Motion { .. } | Failure::Contact { .. } => {
                "see what the arm touched, then bring it home"
            }
            Failure::Empty | Failure::Dropped | Failure::NotLifted(_) => {
                "check the record's size, weight and material"
            }
            Failure::Look(stop) => stop.hint(),
            Failure::Device(_) => "check cables, power and the configuration file",
        }
    }
}

/// Finds an object and lifts it.
pub fn grasp(
    system: &mut System,
    object: &str,
    config: &GraspConfig,
    observer: &mut dyn Observer,
) -> Report {
    let mut run = Run::new(system, &config.find, observer);
    if run.system.hand.as_ref().is_some_and(|hand| hand.light.is_some()) {
        // The object is wanted where the hand's light is seen beside it: zeros move both alike.
        run.zero_sd = 0.0;
    }
    let found = run.all(object);
    let mut outcome = GraspReport::default();
    let failure = match &found {
        Ok(found) => {
            let way = Vec::new();
            Attempt { run: &mut run, config, found, report: &mut outcome, way }.all().err()
        }
        Err(_) => None,
    };
    let mut report = describe(object, run, found.as_ref());
    match failure {
        None => outcome.succeeded = report.found,
        Some(failure) => {
            outcome.reason = Some(failure.to_string());
            outcome.hint = Some(failure.hint());
        }
    }
    if !report.found {
        outcome.reason = Some("the object was not found".into());
    }
    report.grasp = Some(outcome);
    report
}

/// The table's plane as the robot knows it; wider than any table, which does no harm.
fn table() -> Obstacle {
    Obstacle {
        name: "table".into(),
        base_from_solid: Translation3::new(0.75, 0.0, -0.02).into(),
        solid: Solid::Cuboid { half: Vector3::new(1.5, 1.5, 0.02) },
    }
}

/// One grasp of an object that was found.
struct Attempt<'a, 'r> {
    run: &'a mut Run<'r>,
    config: &'a GraspConfig,
    found: &'a Found,
    report: &'a mut GraspReport,
    /// What the arm has done since it last was where nothing is near.
    way: Vec<Trajectory>,
}

impl Attempt<'_, '_> {
    fn all(&mut self) -> Result<(), Failure> {
        let hand = self.run.system.hand.clone().ok_or(Failure::NoArm)?;
        let planned = self.step("plan", |a| a.plan(&hand))?;
        match self.carry_out(&hand, &planned) {
            Err(failure) if failure.is_worth_another_try() => {
                self.report.first_failure = Some(failure.to_string());
                self.step("back off", |a| a.back_off(&hand, &planned))?;
                let other = match failure {
                    Failure::Empty => None,
                    _ => next_best(&planned, &self.found.object.pose),
                };
                self.carry_out(&hand, &other.unwrap_or(planned))
            }
            outcome => outcome,
        }
    }

    /// From where the arm stands to the object in the hand.
    fn carry_out(&mut self, hand: &Hand, planned: &Plan) -> Result<(), Failure> {
        self.describe(planned);
        if self.report.first_failure.is_none() {
            self.step("transfer", |a| a.transfer(planned))?;
        }
        let again = self.step("look again", |a| a.look_again(hand))?;
        self.run.observer.notice(&Event::Stage("pregrasp"));
        let corrected = self.step("correct", |a| a.correct(hand, planned, &again))?;
        self.describe(&corrected);
        self.report.corrected_by_mm = Some(shift_mm(planned, &corrected));
        self.step("approach", |a| {
            // As wide as the planner took the hand to be: another grasp may need another opening than
            // that with which the fingers came here.
            a.grip(corrected.grasp.opening, corrected.force)?;
            a.play("correction", &corrected.transfer, &a.config.limits.clone())?;
            a.play("approach", &corrected.approach, &a.config.limits.clone())
        })?;
        self.step("close", |a| a.close(&corrected))?;
        self.picture("closed")?;
        self.step("lift", |a| a.lift(&corrected))?;
        self.step("verify", |a| a.verify(hand, &corrected, &again))
    }

    /// Opens the fingers and goes back the way that the arm has come; what it touched there lets go of
    /// it, so only the stop button ends this motion.
    fn back_off(&mut self, hand: &Hand, plan: &Plan) -> Result<(), Failure> {
        self.grip(plan.grasp.opening, plan.force)?;
        let limits = MotionLimits { contact_force: f64::INFINITY, ..self.config.limits.clone() };
        while let Some(last) = self.way.pop() {
            let stands = self.arm()?.read(ANSWER)?.positions;
            let back = timing::back(&hand.robot.arm, &last, &stands, &self.config.planner.speeds);
            self.play("back off", &back, &limits)?;
            self.way.pop();
        }
        Ok(())
    }

    fn step<T>(
        &mut self,
        name: &'static str,
        work: impl FnOnce(&mut Self) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        let start = self.run.begin(name);
        let outcome = work(self);
        self.run.end(name, start);
        outcome
    }

    /// Takes a picture of a stage.
    fn picture(&mut self, stage: &'static str) -> Result<(), Failure> {
        self.run.look()?;
        self.run.observer.notice(&Event::Stage(stage));
        Ok(())
    }

    fn describe(&mut self, plan: &Plan) {
        self.report.approach = Some(plan.grasp.hold.name());
        self.report.width = Some(plan.grasp.width);
        self.report.force = Some(plan.force);
        self.report.margin = Some(plan.margin.ratio);
    }

    fn plan(&mut self, hand: &Hand) -> Result<Plan, Failure> {
        let start = self.arm()?.read(ANSWER)?.positions;
        let obstacles = [table()];
        let request = self.request(self.found, &start, &obstacles);
        Ok(plan(&hand.robot, &request, &self.config.planner)?)
    }

    fn correct(&mut self, hand: &Hand, first: &Plan, again: &Found) -> Result<Plan, Failure> {
        let start = self.arm()?.read(ANSWER)?.positions;
        let obstacles = [table()];
        let request = self.request(again, &start, &obstacles);
        Ok(correct(&hand.robot, first, &request, &self.config.planner)?)
    }

    fn request<'q>(
        &self,
        seen: &'q Found,
        start: &'q [f64; 6],
        obstacles: &'q [Obstacle],
    ) -> Request<'q> {
        Request {
            record: &seen.record,
            object: &seen.object.pose,
            landmark: 0,
            start,
            obstacles,
            free_azimuths: &[],
            seed: self.config.find.seed,
        }
    }

    /// Opens the fingers and goes to before the object.
    fn transfer(&mut self, plan: &Plan) -> Result<(), Failure> {
        self.grip(plan.grasp.opening, plan.force)?;
        self.play("transfer", &plan.transfer, &self.config.limits.clone())
    }

    /// The landmark is measured anew and the object recognised anew, and placed beside the hand when that has
    /// a light. The plan was sure enough of the first look, so that holds when the second gives nothing; but
    /// not where it was sure only because the hand would be seen beside the object.
    fn look_again(&mut self, hand: &Hand) -> Result<Found, Failure> {
        let mut found = match self.run.again(self.found) {
            Ok(found) => found,
            Err(Stop::Device(error)) => return Err(error.into()),
            Err(stop) if self.needs_the_hand() => return Err(stop.into()),
            Err(stop) => {
                self.report.second_look = Some(stop.to_string());
                return Ok(self.found.clone());
            }
        };
        let Some(light) = &hand.light else { return Ok(found) };
        let joints = self.arm()?.read(ANSWER)?.positions;
        match self.run.hand_beside(light, &joints, &found) {
            Ok(sight) => {
                let pose = &mut found.object.pose;
                // What the pose is unsure of beside what the heads get wrong is not told apart: all stays.
                let unsure = pose.covariance.fixed_view::<3, 3>(3, 3) + sight.difference;
                *pose = relative_to_hand(pose, &sight.by_joints, &sight.seen, &unsure);
                self.report.hand_off_mm = Some(1e3 * (sight.by_joints - sight.seen).norm());
            }
            Err(Stop::Device(error)) => return Err(error.into()),
            Err(stop) if self.needs_the_hand() => return Err(stop.into()),
            Err(stop) => self.report.hand_unseen = Some(stop.to_string()),
        }
        Ok(found)
    }

    /// Whether nothing is known well enough without the hand's light.
    fn needs_the_hand(&self) -> bool {
        self.run.zero_sd < self.run.system.zero_sd
    }

    fn close(&mut self, plan: &Plan) -> Result<(), Failure> {
        let reading = self.grip(0.0, plan.force)?;
        self.report.closed_width = Some(reading.width);
        if reading.holding { Ok(()) } else { Err(Failure::Empty) }
    }

    fn lift(&mut self, plan: &Plan) -> Result<(), Failure> {
        self.carry("lift", &plan.lift)
    }

    /// With the object in the hand contact is wanted: only the stop button ends this motion.
    fn carry(&mut self, step: &'static str, trajectory: &Trajectory) -> Result<(), Failure> {
        let limits = MotionLimits { contact_force: f64::INFINITY, ..self.config.limits.clone() };
        self.play(step, trajectory, &limits)?;
        let held = self.arm()?.gripper(ANSWER)?.holding;
        if held { Ok(()) } else { Err(Failure::Dropped) }
    }

    /// Looks where the landmark is now and compares with how the hand has moved.
    fn verify(&mut self, hand: &Hand, plan: &Plan, before: &Found) -> Result<(), Failure> {
        let unclear = Failure::NotLifted("the plan has no lift");
        let mut motion = plan.lift_motion(&hand.robot.arm).ok_or(unclear)?;
        let mut sight = self.run.sight(before.tag, &(motion * before.landmark.position));
        for angle in TURNS {
            if !matches!(sight, Err(Stop::NotSeen { .. } | Stop::Lost(_))) {
                break;
            }
            if let Some(turn) = self.turn(hand, plan, before, angle)? {
                motion = turn * motion;
                sight = self.run.sight(before.tag, &(motion * before.landmark.position));
            }
        }
        let sight = sight?;
        self.picture("lifted")?;
        let (by, verdict) = match sight {
            Sight::Place(after) => ("both heads", verify_lift(&before.landmark, &after, &motion)),
            Sight::Direction(Side::Left) => ("left head", LiftVerdict::Held),
            Sight::Direction(Side::Right) => ("right head", LiftVerdict::Held),
        };
        self.report.verified_by = Some(by);
        self.report.verified = Some(verdict == LiftVerdict::Held);
        match verdict {
            LiftVerdict::Held => Ok(()),
            LiftVerdict::Slipped { .. } => Err(Failure::NotLifted("it slipped")),
            LiftVerdict::Left => Err(Failure::NotLifted("it stayed where it was")),
            LiftVerdict::Unclear => Err(Failure::NotLifted("the measurements do not tell")),
        }
    }

    /// Turns the hand with the object in it about the vertical; how it has moved (base), `None` when it
    /// cannot.
    fn turn(
        &mut self,
        hand: &Hand,
        plan: &Plan,
        before: &Found,
        angle: f64,
    ) -> Result<Option<Transform>, Failure> {
        let start = self.arm()?.read(ANSWER)?.positions;
        let obstacles = [table()];
        let request = self.request(before, &start, &obstacles);
        let planner = &self.config.planner;
        let Some(turn) = turn_in_sight(&hand.robot, plan, &request, planner, &start, angle) else {
            return Ok(None);
        };
        self.carry("turn", &turn)?;
        let end = self.arm()?.read(ANSWER)?.positions;
        let arm = &hand.robot.arm;
        Ok(Some(arm.forward(&end) * arm.forward(&start).inverse()))
    }

    fn arm(&mut self) -> Result<&mut Box<dyn vergence_devices::Arm>, Failure> {
        self.run.system.robot.arm.as_mut().ok_or(Failure::NoArm)
    }

    fn grip(&mut self, width: f64, force: f64) -> Result<GripperReading, Failure> {
        let reading = self.arm()?.grip(GripCommand { width, force }, FINGERS)?;
        self.run.observer.notice(&Event::Gripped(&reading));
        Ok(reading)
    }

    /// Plays a motion to its end; anything else is a failure that says what happened.
    fn play(
        &mut self,
        step: &'static str,
        trajectory: &Trajectory,
        limits: &MotionLimits,
    ) -> Result<(), Failure> {
        let (start, names) = (self.run.system.robot.clock.now(), self.arm()?.joint_names());
        self.run.observer.notice(&Event::Motion { start, names: &names, trajectory });
        self.way.push(trajectory.clone());
        let outcome = self.arm()?.execute(trajectory, limits)?;
        let end = self.run.system.robot.clock.now();
        self.run.observer.notice(&Event::Moved { start, end, names: &names, trajectory });
        let what = match outcome {
            Execution::Reached => return Ok(()),
            Execution::Stopped => "stopped on command".into(),
            Execution::Contact { link, force } => {
                self.report.contact = Some(link.clone());
                return Err(Failure::Contact { step, link, force });
            }
            Execution::Lost { reason } => reason,
        };
        Err(Failure::Motion { step, what })
    }
}

/// How far the second look moved the grasp (mm).
fn shift_mm(first: &Plan, second: &Plan) -> f64 {
    let (a, b) = (first.base_from_tip.translation.vector, second.base_from_tip.translation.vector);
    1e3 * (a - b).norm()
}
