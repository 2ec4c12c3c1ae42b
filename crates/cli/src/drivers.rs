//! Opens the drivers that a configuration names, on real time.
//!
//! The workcell's own devices (driver "sim") live on virtual time and are opened by
//! [`crate::robot`]; both kinds do not mix, except that the radio may be real in any case.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use vergence_devices::clock::SystemClock;
use vergence_devices::config::CameraConfig;
use vergence_devices::dynamixel::{self, DynamixelPanTilt};
use vergence_devices::mjpeg::MjpegCamera;
use vergence_devices::{
    Camera, Clock, Config, Description, DeviceError, Head, PanTilt, Robot, Side,
};
use vergence_imaging::Frame;
use vergence_ros::recording::RecordingError;
use vergence_ros::{RecordingCamera, ReplayClock};

use crate::failure::Failure;
use crate::interrupt::{Interrupt, Until};
use crate::radio;

/// The driver of simulated devices.
pub const SIM: &str = "sim";
/// The radio driver for Bluetooth controllers.
pub const HCI: &str = "hci";
/// The radio driver for the Bluetooth daemon of desktop Linux.
pub const BLUEZ: &str = "bluez";
/// Driver of a camera that is played back.
pub const RECORDING: &str = "recording";
const DYNAMIXEL: &str = "dynamixel";

/// The heads' devices are the simulator's; an error when some are and some are not.
pub fn simulated(config: &Config) -> Result<bool, Failure> {
    let heads = Side::BOTH.map(|side| config.head(side));
    let drivers: Vec<&str> = heads
        .iter()
        .flat_map(|head| [head.camera.driver.as_str(), head.servos.driver.as_str()])
        .collect();
    let simulated = drivers.iter().filter(|driver| **driver == SIM).count();
    match simulated {
        0 => Ok(false),
        _ if simulated == drivers.len() => Ok(true),
        _ => Err(Failure::misuse(
            format!("simulated and real devices do not mix: the heads have {}", drivers.join(", ")),
            "write the same kind for both cameras and both servo pairs; `vergence sim` offers \
             simulated devices over real wires",
        )),
    }
}

/// Opens all devices of a robot without simulated ones.
pub fn open(config: &Config, description: &Description, folder: &Path) -> Result<Robot, Failure> {
    let clock = SystemClock::start();
    let interrupt = Interrupt::listen()
        .map_err(|error| Failure::failed(error, "the system refuses signal handlers"))?;
    if config.radio.driver == SIM {
        return Err(Failure::misuse(
            "the heads are real and the radio is simulated",
            "`vergence sim` offers simulated tags to the radio driver \"hci\"",
        ));
    }
    if config.arm.is_some() {
        return Err(Failure::misuse(
            "the heads are real and the arm is simulated",
            "leave the table [arm] out: the robot then finds but does not grasp",
        ));
    }
    // The radio first: it needs no time to warm up, and fails soonest when the wiring is wrong.
    let radio = radio::open(config, folder)?;
    let [left, right] = servos(config, description, clock)?;
    let head = |side: Side, pan_tilt: Box<dyn PanTilt>| {
        let camera = camera(config, side, folder, clock)?;
        let camera = Box::new(Until { interrupt: interrupt.clone(), device: camera });
        Ok::<Head, Failure>(Head { camera, pan_tilt })
    };
    let until = |device: DynamixelPanTilt| Until { interrupt: interrupt.clone(), device };
    let heads =
        [head(Side::Left, Box::new(until(left)))?, head(Side::Right, Box::new(until(right)))?];
    Ok(Robot { clock: Box::new(clock), heads, radio: radio.link, arm: None })
}

/// The servos of both heads.
fn servos(
    config: &Config,
    description: &Description,
    clock: SystemClock,
) -> Result<[DynamixelPanTilt; 2], Failure> {
    let mut settings = Vec::new();
    let mut limits = Vec::new();
    for side in Side::BOTH {
        let head = config.head(side);
        let table = format!("[{}.servos.dynamixel]", side.name());
        if head.servos.driver != DYNAMIXEL {
            return Err(unknown("servos", &head.servos.driver, DYNAMIXEL));
        }
        let Some(dynamixel) = &head.servos.dynamixel else {
            return Err(missing(&table, "docs/head.md shows one"));
        };
        let names = [head.pan_joint.as_str(), head.tilt_joint.as_str()];
        let chain =
            description.chain_with("base", &head.optical_frame, &names).map_err(|error| {
                Failure::misuse(error, "joints and frames must be those of the URDF")
            })?;
        settings.push(dynamixel);
        limits.push([chain.joints[0].limits, chain.joints[1].limits]);
    }
    let opened =
        dynamixel::open_heads([settings[0], settings[1]], [limits[0], limits[1]], Arc::new(clock));
    opened.map_err(|error| {
        Failure::failed(error, "check the servos' cable, power, IDs and baud rate")
    })
}

fn camera(
    config: &Config,
    side: Side,
    folder: &Path,
    clock: SystemClock,
) -> Result<Box<dyn Camera>, Failure> {
    let camera = &config.head(side).camera;
    let size = (camera.width, camera.height);
    let table = |name: &str| missing(&format!("{name} in [{}.camera]", side.name()), DRIVERS);
    let failed = |error: &dyn std::fmt::Display| {
        Failure::failed(format!("{} camera: {error}", side.name()), "is it switched on and free?")
    };
    match camera.driver.as_str() {
        "mjpeg" => {
            let settings = camera.mjpeg.as_ref().ok_or_else(|| table("mjpeg"))?;
            let opened = MjpegCamera::open(settings, size, Arc::new(clock));
            Ok(Box::new(opened.map_err(|error| failed(&error))?))
        }
        RECORDING => {
            let opened = Playback::open(camera, folder, clock).ok_or_else(|| table(RECORDING))?;
            Ok(Box::new(opened.map_err(|error| failed(&error))?))
        }
        #[cfg(all(target_os = "linux", target_pointer_width = "64"))]
        "v4l2" => {
            let settings = camera.v4l2.as_ref().ok_or_else(|| table("v4l2"))?;
            let opened = vergence_devices::v4l2::V4l2Camera::open(settings, size, Arc::new(clock));
            Ok(Box::new(opened.map_err(|error| failed(&error))?))
        }
        other => Err(unknown("camera", other, "v4l2 (on 64-bit Linux), mjpeg, recording")),
    }
}

const DRIVERS: &str = "what a driver needs stands in the table of its name, see docs/hardware.md";

fn missing(table: &str, hint: &str) -> Failure {
    Failure::misuse(format!("the configuration lacks {table}"), hint)
}

/// Refuses a driver that does not exist.
pub fn unknown(what: &str, driver: &str, known: &str) -> Failure {
    Failure::misuse(
        format!("there is no {what} driver \"{driver}\""),
        format!("{what} drivers are: {SIM}, {known}"),
    )
}

/// A recording that runs on the robot's clock, from the moment in which it is opened.
struct Playback {
    camera: RecordingCamera,
    clock: SystemClock,
    /// The robot's time at the recording's first stamp, and that stamp.
    start: Duration,
    first: Option<Duration>,
    /// Read, but not due yet.
    waiting: Option<Frame>,
}

impl Playback {
    /// `None` when the configuration does not say which recording.
    fn open(
        config: &CameraConfig,
        folder: &Path,
        clock: SystemClock,
    ) -> Option<Result<Self, RecordingError>> {
        let settings = config.recording.as_ref()?;
        let exposure = Duration::try_from_secs_f64(settings.exposure).unwrap_or_default();
        let file = folder.join(&settings.file);
        let opened =
            RecordingCamera::open(&file, &settings.topic, exposure, &ReplayClock::default());
        Some(opened.map(|camera| {
            let start = clock.now();
            Playback { camera, clock, start, first: None, waiting: None }
        }))
    }
}

/// How long a recorded picture waits for its reader.
const KEPT: Duration = Duration::from_millis(100);

impl Camera for Playback {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let frame = loop {
            if let Some(frame) = self.waiting.take() {
                break frame;
            }
            // The recording has its own time; how long we wait is decided below.
            let mut frame = self.camera.next_frame(Duration::MAX)?;
            let first = *self.first.get_or_insert(frame.stamp);
            frame.stamp = self.start + frame.stamp.saturating_sub(first);
            // A camera that nobody read meanwhile does not keep its pictures either.
            if frame.stamp + KEPT >= self.clock.now() {
                break frame;
            }
        };
        let wait = (frame.stamp + frame.exposure).saturating_sub(self.clock.now());
        if wait > timeout {
            self.waiting = Some(frame);
            self.clock.sleep(timeout);
            return Err(DeviceError::Timeout { device: "recording".into(), timeout });
        }
        self.clock.sleep(wait);
        Ok(frame)
    }
}
