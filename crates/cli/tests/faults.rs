//! Devices that fail in the middle of a find: each ends in a clear error or a right answer, and in bounded
//! time. The simulated workcell's devices, spoiled from a moment on; `wired.rs` has the same over wires.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::time::Duration;

use nalgebra::Point3;
use vergence::{FindConfig, Report, System};
use vergence_devices::{Camera, Clock, DeviceError, Head, JointReading, PanTilt, Robot};
use vergence_imaging::Frame;
use vergence_sim::Workcell;

/// No find takes longer on the robot's clock, whatever happens: three searches of the whole field.
const BOUND: Duration = Duration::from_secs(300);
/// When it begins (robot's clock): the radio has answered, the heads are searching.
const BEGIN: Duration = Duration::from_secs(5);

/// What a camera does from then on.
#[derive(Clone, Copy)]
enum Spoilt {
    /// The last picture again and again.
    Frozen,
    Silent,
    /// Of five pictures three are lost.
    Lossy,
    /// Its stamps are off by so many seconds.
    Clock(f64),
}

struct BadCamera {
    device: Box<dyn Camera>,
    clock: Box<dyn Clock>,
    how: Spoilt,
    last: Option<Frame>,
    count: usize,
}

impl Camera for BadCamera {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        if self.clock.now() < BEGIN {
            let frame = self.device.next_frame(timeout)?;
            self.last = Some(frame.clone());
            return Ok(frame);
        }
        match self.how {
            Spoilt::Frozen => Ok(self.last.clone().unwrap()),
            Spoilt::Silent => {
                self.clock.sleep(timeout);
                Err(DeviceError::Timeout { device: "left camera".into(), timeout })
            }
            Spoilt::Lossy => {
                self.count += 1;
                for _ in 0..[2, 1][self.count % 2] {
                    self.device.next_frame(timeout)?;
                }
                self.device.next_frame(timeout)
            }
            Spoilt::Clock(off) => {
                let mut frame = self.device.next_frame(timeout)?;
                let stamp = (frame.stamp.as_secs_f64() + off).max(0.0);
                frame.stamp = Duration::from_secs_f64(stamp);
                Ok(frame)
            }
        }
    }
}

/// What servos do from then on.
#[derive(Clone, Copy)]
enum Stuck {
    /// They never arrive.
    Moving,
    /// They rest where they are and say so.
    Resting,
    Hot,
    Unplugged,
}

struct BadServos {
    device: Box<dyn PanTilt>,
    clock: Box<dyn Clock>,
    how: Stuck,
}

impl PanTilt for BadServos {
    fn move_to(&mut self, pan: f64, tilt: f64) -> Result<(), DeviceError> {
        match self.clock.now() < BEGIN {
            true => self.device.move_to(pan, tilt),
            false => Ok(()),
        }
    }

    fn read(&mut self) -> Result<JointReading, DeviceError> {
        let reading = self.device.read()?;
        let device = || "left servos".to_owned();
        match self.how {
            _ if self.clock.now() < BEGIN => Ok(reading),
            Stuck::Moving => Ok(JointReading { moving: true, ..reading }),
            Stuck::Resting => Ok(reading),
            Stuck::Hot => Err(DeviceError::Fault {
                device: device(),
                fault: "servo 1 reports overheated".into(),
            }),
            Stuck::Unplugged => {
                Err(DeviceError::Disconnected { device: device(), reason: "no such device".into() })
            }
        }
    }

    fn resolution(&self) -> f64 {
        self.device.resolution()
    }

    fn backlash(&self) -> f64 {
        self.device.backlash()
    }
}

/// A find with a spoilt left head; checks that it ends in time, and that an answer is right.
fn find(spoil: impl FnOnce(Head, &Workcell) -> Head) -> Report {
    let workcell = Workcell::embedded(1).unwrap();
    let Robot { clock, heads: [left, right], radio, arm } = workcell.robot();
    let robot = Robot { clock, heads: [spoil(left, &workcell), right], radio, arm };
    let mut system = System::new(robot, workcell.config(), workcell.description()).unwrap();
    let report = vergence::find(&mut system, "cup", &FindConfig::default(), &mut ());
    let took = system.robot.clock.now();
    assert!(took < BOUND, "{took:?}: {:?}", report.reason);
    assert!(report.found || report.reason.is_some() && report.hint.is_some(), "{report:?}");
    if report.found {
        let truth = workcell.truth();
        let cup = truth.objects.iter().find(|o| o.id == "cup").unwrap();
        let told = Point3::from(report.landmark.as_ref().unwrap().position);
        let off = (told - cup.landmarks[0]).norm();
        assert!(off < 0.01, "found {:.1} mm from where it is", 1e3 * off);
    }
    report
}

fn with_camera(how: Spoilt) -> Report {
    find(|head, workcell| {
        let clock = workcell.clock();
        let camera = BadCamera { device: head.camera, clock, how, last: None, count: 0 };
        Head { camera: Box::new(camera), ..head }
    })
}

fn with_servos(how: Stuck) -> Report {
    find(|head, workcell| {
        let pan_tilt = BadServos { device: head.pan_tilt, clock: workcell.clock(), how };
        Head { pan_tilt: Box::new(pan_tilt), ..head }
    })
}

fn says(report: &Report, words: &str) {
    let reason = report.reason.as_deref().unwrap_or("found");
    assert!(reason.contains(words), "{reason}");
}

#[test]
fn a_camera_that_stops_is_named() {
    says(&with_camera(Spoilt::Frozen), "left camera's pictures were refused");
    says(&with_camera(Spoilt::Silent), "left camera: no answer within 2s");
}

#[test]
fn lost_pictures_do_no_harm() {
    assert!(with_camera(Spoilt::Lossy).found);
}

#[test]
fn a_clock_that_jumps_gives_no_wrong_answer() {
    says(&with_camera(Spoilt::Clock(-2.0)), "left camera: its time stamps lie behind");
    // Pictures of the head on its way must not pass for new ones.
    says(&with_camera(Spoilt::Clock(2.0)), "left camera: its time stamps lie ahead");
    says(&with_camera(Spoilt::Clock(0.3)), "left camera: its time stamps lie ahead");
}

#[test]
fn servos_that_fail_are_named() {
    says(&with_servos(Stuck::Moving), "left head: the servos did not reach their goal");
    says(&with_servos(Stuck::Hot), "servo 1 reports overheated");
    says(&with_servos(Stuck::Unplugged), "not connected");
    says(&with_servos(Stuck::Resting), "degrees from where it was sent to");
}
