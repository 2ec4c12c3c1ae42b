//! A robot's opened devices together with its geometry, and the two things that every step does
//! with them: turn the heads and wait until they are still, take pictures.

use std::time::Duration;

use vergence_devices::{
    Config, Description, DescriptionError, DeviceError, JointReading, PanTilt, Robot, Side,
};
use vergence_geometry::Chain;
use vergence_head::{HeadError, PanTiltHead};
use vergence_imaging::Frame;
use vergence_tag::signature::TrustedKeys;

/// How often moving servos are asked whether they are still.
const POLL: Duration = Duration::from_millis(10);
/// Allowance over the time that the slew needs at the servos' speed.
const SLEW_SLACK: Duration = Duration::from_secs(2);
/// Slowest speed (rad/s) that a joint's description is believed: some leave it at zero.
const SLOWEST: f64 = 0.05;
/// Longest wait for one picture.
const FRAME_TIMEOUT: Duration = Duration::from_secs(2);
/// How far from its goal a servo may rest beside its step (rad): friction keeps small ones half a degree off.
const SHORT_OF_GOAL: f64 = 0.03;
/// How far a stamp may lie ahead of the robot's clock: a picture of the future was stamped by a clock that
/// was set, and may show the head before it came to rest.
const AHEAD: Duration = Duration::from_millis(100);
/// Pictures that may have been exposed before the heads stood still, at the most.
const STALE_FRAMES: usize = 30;

/// Heads whose zeros may be further off (degrees) do not look where they are sent.
const MOST_ZERO_SD_DEG: f64 = 5.0;

/// Why a robot could not be put together.
#[derive(Debug, thiserror::Error)]
pub enum SystemError {
    /// The URDF lacks what the configuration names.
    #[error("{side} head: {source}")]
    Description {
        /// Which head.
        side: &'static str,
        /// What is wrong.
        source: DescriptionError,
    },
    /// The URDF's joints or the configuration's lens cannot be those of a head.
    #[error("{side} head: {source}: correct the joints' limits in the URDF")]
    Head {
        /// Which head.
        side: &'static str,
        /// What is wrong.
        source: HeadError,
    },
    /// Nobody can work with joints of which nothing is known.
    #[error(
        "{side} head: zero_sd_deg = {degrees} is no deviation of a joint's zero: give one from 0 to {MOST_ZERO_SD_DEG} degrees"
    )]
    ZeroSd {
        /// Which head.
        side: &'static str,
        /// What the configuration says.
        degrees: f64,
    },
    /// The URDF's arm or gripper lacks something.
    #[error("arm: {0}")]
    Arm(#[from] DescriptionError),
    /// The arm is of a kind that the planner does not know.
    #[error("arm: {0}")]
    Kind(#[from] vergence_grasp::RobotError),
}

/// A robot: devices and geometry.
pub struct System {
    /// The opened devices.
    pub robot: Robot,
    /// Left and right head: kinematics in the base frame and the camera's lens.
    pub heads: [PanTiltHead; 2],
    /// Standard deviation of the joints' zeros (rad), of the worse known head.
    pub zero_sd: f64,
    /// Whose signature a record must bear; without, unsigned records do as well.
    pub required_signers: Option<TrustedKeys>,
    /// The arm's geometry for the planner, on robots that have an arm.
    pub hand: Option<Hand>,
}

/// What the robot knows of its arm and gripper.
#[derive(Clone)]
pub struct Hand {
    /// Kinematics, solids and gripper.
    pub robot: vergence_grasp::Robot,
    /// The tag on the gripper, when there is one.
    pub light: Option<HandLight>,
}

/// The tag on a gripper.
#[derive(Clone)]
pub struct HandLight {
    /// Object id that it advertises.
    pub object_id: String,
    /// From base to the frame of its record, over the arm's joints.
    pub chain: Chain,
}

/// The links that every description of an arm has.
const ARM_LINKS: [&str; 3] = ["base", "tcp", "hand"];

impl Hand {
    /// Reads the links `tcp` and `hand` of a description, and that of the gripper's tag.
    pub fn read(config: &Config, description: &Description) -> Result<Self, SystemError> {
        let [base, tcp, hand] = ARM_LINKS;
        let chain = description.chain(base, tcp)?;
        let bodies = description.bodies(base, &chain)?;
        let gripper = description.gripper(hand)?;
        let robot = vergence_grasp::Robot::new(chain, &bodies, gripper.travel, gripper.effort)?;
        let tag = config.arm.as_ref().and_then(|arm| arm.tag.as_ref());
        let light = tag.map(|tag| {
            let chain = description.chain(base, &tag.link)?;
            Ok::<_, DescriptionError>(HandLight { object_id: tag.object_id.clone(), chain })
        });
        Ok(Hand { robot, light: light.transpose()? })
    }
}

impl System {
    /// Joins opened devices with the geometry of the URDF's link `base`.
    pub fn new(
        robot: Robot,
        config: &Config,
        description: &Description,
    ) -> Result<Self, SystemError> {
        let hand = robot.arm.is_some().then(|| Hand::read(config, description)).transpose()?;
        let heads =
            [head(config, description, Side::Left)?, head(config, description, Side::Right)?];
        let zero_sd = zero_sd(config, Side::Left)?.max(zero_sd(config, Side::Right)?);
        Ok(System { robot, heads, zero_sd, required_signers: None, hand })
    }

    /// Encoder step of the coarser servos (rad).
    pub fn resolution(&self) -> f64 {
        self.coarsest(|servos| servos.resolution())
    }

    /// Slack of the coarser servos' gears, as the maker states it (rad).
    pub fn backlash(&self) -> f64 {
        self.coarsest(|servos| servos.backlash())
    }

    fn coarsest(&self, of: impl Fn(&dyn PanTilt) -> f64) -> f64 {
        self.robot.heads.iter().map(|head| of(head.pan_tilt.as_ref())).fold(0.0, f64::max)
    }

    /// Reads the encoders of both heads.
    pub fn joints(&mut self) -> Result<[JointReading; 2], DeviceError> {
        let [left, right] = &mut self.robot.heads;
        Ok([left.pan_tilt.read()?, right.pan_tilt.read()?])
    }

    /// Turns the heads that have a target (pan, tilt; rad) and waits until both are still.
    pub fn turn(
        &mut self,
        targets: [Option<[f64; 2]>; 2],
    ) -> Result<[JointReading; 2], DeviceError> {
        let before = self.joints()?;
        let mut longest = Duration::ZERO;
        for ((head, target), (geometry, from)) in
            self.robot.heads.iter_mut().zip(targets).zip(self.heads.iter().zip(before))
        {
            // A reading may lie beyond the limit by half a step; nobody can be sent back there.
            let Some([pan, tilt]) = target.map(|angles| geometry.clamp(angles)) else { continue };
            head.pan_tilt.move_to(pan, tilt)?;
            for (joint, turn) in
                geometry.chain.joints.iter().zip([pan - from.pan, tilt - from.tilt])
            {
                let told = head.pan_tilt.speed();
                longest = longest.max(slew_time(turn, joint.limits.velocity, told));
            }
        }
        let deadline = self.robot.clock.now() + longest + SLEW_SLACK;
        loop {
            self.robot.clock.sleep(POLL);
            let joints = self.joints()?;
            if joints.iter().all(|j| !j.moving) {
                self.arrived(&targets, &joints)?;
                return Ok(joints);
            }
            if self.robot.clock.now() > deadline {
                let side = Side::BOTH[usize::from(!joints[0].moving)];
                return Err(DeviceError::Fault {
                    device: format!("{} head", side.name()),
                    fault: "the servos did not reach their goal in time".into(),
                });
            }
        }
    }

    /// Fails when a head rests elsewhere than it was sent to.
    fn arrived(
        &self,
        targets: &[Option<[f64; 2]>; 2],
        joints: &[JointReading; 2],
    ) -> Result<(), DeviceError> {
        for k in 0..2 {
            let Some(target) = targets[k].map(|angles| self.heads[k].clamp(angles)) else {
                continue;
            };
            let off = [joints[k].pan - target[0], joints[k].tilt - target[1]];
            let allowed = SHORT_OF_GOAL + self.robot.heads[k].pan_tilt.resolution();
            if let Some(joint) = (0..2).find(|&joint| off[joint].abs() > allowed) {
                return Err(DeviceError::Fault {
                    device: format!("{} head", Side::BOTH[k].name()),
                    fault: format!(
                        "{} rests {:.1} degrees from where it was sent to",
                        ["pan", "tilt"][joint],
                        off[joint].abs().to_degrees()
                    ),
                });
            }
        }
        Ok(())
    }

    /// Pictures of both heads that were taken together, at most `apart` from each other, and not
    /// before `since`. Cameras that are not triggered by one signal are half an interval apart at
    /// the most; one that lost a picture is made up for by the next.
    pub fn pair_since(
        &mut self,
        since: Duration,
        apart: Duration,
    ) -> Result<[Frame; 2], DeviceError> {
        let mut pair = [self.frame_since(0, since)?, self.frame_since(1, since)?];
        for _ in 0..STALE_FRAMES {
            let [left, right] = [pair[0].stamp, pair[1].stamp];
            if left.abs_diff(right) <= apart {
                return Ok(pair);
            }
            let earlier = usize::from(right < left);
            pair[earlier] = self.frame_since(earlier, since)?;
        }
        Err(DeviceError::Fault {
            device: "cameras".into(),
            fault: format!("no two pictures of theirs were taken within {apart:?} of each other"),
        })
    }

    /// The next picture of one head whose exposure began at or after `since`.
    pub fn frame_since(&mut self, side: usize, since: Duration) -> Result<Frame, DeviceError> {
        self.robot.heads[side].camera.skip_before(since);
        for _ in 0..STALE_FRAMES {
            let frame = self.robot.heads[side].camera.next_frame(FRAME_TIMEOUT)?;
            if frame.stamp > self.robot.clock.now() + AHEAD {
                return Err(untimely(side, "ahead of"));
            }
            if frame.stamp >= since {
                return Ok(frame);
            }
        }
        Err(untimely(side, "behind"))
    }
}

/// Time for a turn (rad) at the slower of the joint's own speed and that which the servos were told (rad/s).
fn slew_time(turn: f64, rated: f64, told: Option<f64>) -> Duration {
    let rated = rated.max(SLOWEST);
    let speed = told.filter(|told| *told > 0.0).map_or(rated, |told| told.min(rated));
    Duration::try_from_secs_f64(turn.abs() / speed).unwrap_or(Duration::ZERO)
}

/// How well a head's zeros are known (rad).
fn zero_sd(config: &Config, side: Side) -> Result<f64, SystemError> {
    let degrees = config.head(side).zero_sd_deg;
    let known = (0.0..=MOST_ZERO_SD_DEG).contains(&degrees);
    known.then(|| degrees.to_radians()).ok_or(SystemError::ZeroSd { side: side.name(), degrees })
}

/// The geometry of one head as configuration and URDF have it.
fn head(
    config: &Config,
    description: &Description,
    side: Side,
) -> Result<PanTiltHead, SystemError> {
    let (wiring, name) = (config.head(side), side.name());
    let joints = [wiring.pan_joint.as_str(), wiring.tilt_joint.as_str()];
    let chain = description
        .chain_with("base", &wiring.optical_frame, &joints)
        .map_err(|source| SystemError::Description { side: name, source })?;
    PanTiltHead::new(chain, wiring.camera.model())
        .map_err(|source| SystemError::Head { side: name, source })
}

fn untimely(side: usize, how: &str) -> DeviceError {
    DeviceError::Fault {
        device: format!("{} camera", Side::BOTH[side].name()),
        fault: format!("its time stamps lie {how} the robot's clock"),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const HEAD: &str = r#"
        pan_joint = "p"
        tilt_joint = "t"
        optical_frame = "eye"
        camera = { driver = "sim", width = 320, height = 240, fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5 }
        servos = { driver = "sim" }"#;

    fn with_tilt_from(lower: &str) -> Result<PanTiltHead, SystemError> {
        let urdf = format!(
            r#"<robot name="r"><link name="base"/><link name="pan"/><link name="eye"/>
            <joint name="p" type="revolute"><parent link="base"/><child link="pan"/><axis xyz="0 0 1"/>
              <limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
            <joint name="t" type="revolute"><parent link="pan"/><child link="eye"/><axis xyz="0 1 0"/>
              <limit lower="{lower}" upper="1" velocity="3.6" effort="1"/></joint></robot>"#
        );
        let text =
            format!("robot = 'r.urdf'\n[left]\n{HEAD}\n[right]\n{HEAD}\n[radio]\ndriver = 'sim'\n");
        let description = Description::parse(&urdf, Path::new("r.urdf")).unwrap();
        head(&Config::parse(&text, Path::new("r.toml")).unwrap(), &description, Side::Right)
    }

    #[test]
    fn servos_that_were_told_to_be_slow_get_the_time_for_it() {
        assert_eq!(slew_time(-1.0, 4.0, None), Duration::from_millis(250));
        assert_eq!(slew_time(-1.0, 4.0, Some(0.25)), Duration::from_secs(4));
        assert_eq!(slew_time(1.0, 0.5, Some(5.0)), Duration::from_secs(2));
        // Slower than any description is believed, since the driver knows.
        assert_eq!(slew_time(0.5, 4.0, Some(0.01)), Duration::from_secs(50));
        assert_eq!(slew_time(0.5, 0.0, Some(0.0)), Duration::from_secs(10));
    }

    #[test]
    fn a_joint_whose_range_is_none_is_refused_by_its_name() {
        assert_eq!(with_tilt_from("-1").unwrap().clamp([0.0, -2.0]), [0.0, -1.0]);
        for lower in ["2", "NaN"] {
            let error = with_tilt_from(lower).unwrap_err().to_string();
            assert!(error.starts_with("right head: joint \"t\""), "{error}");
            assert!(error.contains("URDF"), "{error}");
        }
    }
}
