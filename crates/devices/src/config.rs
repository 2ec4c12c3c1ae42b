//! The wiring of a robot: which driver serves which camera, servo pair and radio (TOML).
//!
//! ```toml
//! robot = "workcell.urdf"          # relative to this file
//!
//! [left]                           # and [right]
//! pan_joint = "left_pan_joint"
//! tilt_joint = "left_tilt_joint"
//! optical_frame = "left_optical_frame"
//! camera = { driver = "sim", width = 320, height = 240, fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5 }
//! servos = { driver = "sim" }
//!
//! [radio]
//! driver = "sim"                   # or "hci" with tcp = "host:port", device = "/dev/ttyACM0" or linux = 0, or "bluez"
//! ```
//!
//! Unknown keys are errors that name the key. What only one driver needs stands in that driver's own
//! table and is read by it: `[sim]` for the simulated workcell.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use vergence_geometry::{Camera, CameraError, Distortion};

use crate::dynamixel::DynamixelConfig;
use crate::mjpeg::MjpegConfig;
use crate::traits::Side;
use crate::v4l2::V4l2Config;

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, an unknown or a missing key; the text shows the line.
    #[error("{path}: {message}")]
    Parse {
        /// Which file.
        path: PathBuf,
        /// The parser's message with line and key.
        message: String,
    },
    /// The camera's numbers cannot be.
    #[error("[{side}.camera]: {source}")]
    Camera {
        /// Which camera.
        side: &'static str,
        /// What is wrong.
        source: CameraError,
    },
    /// The camera sees too little at a time to look for anything with it.
    #[error("[{side}.camera]: the lens sees only {narrow:.2} degrees: are fx and fy in pixels?")]
    Narrow {
        /// Which camera.
        side: &'static str,
        /// Its field of view (degrees), across or upright, whichever is less.
        narrow: f64,
    },
}

/// A robot's wiring.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The URDF file, relative to the configuration's folder.
    pub robot: PathBuf,
    /// Left head.
    pub left: HeadConfig,
    /// Right head.
    pub right: HeadConfig,
    /// Tag radio.
    pub radio: RadioConfig,
    /// The arm; without it the robot finds but does not grasp. The URDF's links `hand` and `tcp`
    /// are its gripper and the point midway between the fingertips.
    #[serde(default)]
    pub arm: Option<ArmConfig>,
    /// The simulated workcell's own table, read by the simulator.
    #[serde(default)]
    pub sim: Option<toml::Table>,
}

/// Wiring of one head.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadConfig {
    /// URDF joint of the pan axis.
    pub pan_joint: String,
    /// URDF joint of the tilt axis.
    pub tilt_joint: String,
    /// URDF link of the camera's optical frame.
    pub optical_frame: String,
    /// The camera.
    pub camera: CameraConfig,
    /// The servos.
    pub servos: ServosConfig,
    /// Standard deviation of the joints' zeros (degrees): how far the description may be from where the
    /// joints really are. Zero when left out; a calibration writes what it leaves.
    #[serde(default)]
    pub zero_sd_deg: f64,
}

/// A camera's driver and its nominal lens.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Driver name.
    pub driver: String,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal length (px).
    pub fx: f64,
    /// Focal length (px).
    pub fy: f64,
    /// Principal point (px).
    pub cx: f64,
    /// Principal point (px).
    pub cy: f64,
    /// Distortion k1, k2, p1, p2, k3.
    #[serde(default)]
    pub distortion: [f64; 5],
    /// For the driver `mjpeg`.
    #[serde(default)]
    pub mjpeg: Option<MjpegConfig>,
    /// For the driver `v4l2`.
    #[serde(default)]
    pub v4l2: Option<V4l2Config>,
    /// For the driver `recording`.
    #[serde(default)]
    pub recording: Option<RecordingConfig>,
}

/// A camera that plays a recording.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingConfig {
    /// MCAP file, relative to the configuration's folder.
    pub file: PathBuf,
    /// Topic of its pictures.
    pub topic: String,
    /// Exposure time (s), when known.
    #[serde(default)]
    pub exposure: f64,
}

/// The servos' driver; what only one driver needs stands in the table of its name.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServosConfig {
    /// Driver name.
    pub driver: String,
    /// For the driver `dynamixel`.
    #[serde(default)]
    pub dynamixel: Option<DynamixelConfig>,
}

/// The arm.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmConfig {
    /// Driver name.
    pub driver: String,
    /// A tag on the gripper, whose light tells the heads where the hand is beside the object.
    #[serde(default)]
    pub tag: Option<HandTag>,
}

/// A tag on the gripper. Its record tells where its lights are.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HandTag {
    /// Object id that it advertises.
    pub object_id: String,
    /// The URDF's link that is the frame of its record.
    pub link: String,
}

/// The tag radio's driver. The driver `hci` needs to know where its controller is: `tcp`, `device` or
/// `linux`. The driver `bluez` may name its adapter.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RadioConfig {
    /// Driver name.
    pub driver: String,
    /// Host and port of a Bluetooth controller that speaks H4 over TCP.
    #[serde(default)]
    pub tcp: Option<String>,
    /// Serial line of a Bluetooth controller.
    #[serde(default)]
    pub device: Option<PathBuf>,
    /// Speed of that line (baud). The one of Zephyr's `hci_uart`, which most boards run, when left out;
    /// a line over USB knows none.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// Number of a Bluetooth controller of this computer (0 is `hci0`), taken from the kernel's own
    /// host ("user channel"): it must be off, bluetoothd stopped; needs CAP_NET_ADMIN.
    #[serde(default)]
    pub linux: Option<u16>,
    /// Adapter of BlueZ (`hci0`); without it BlueZ's default one.
    #[serde(default)]
    pub adapter: Option<String>,
    /// File that keeps the keys of tags that the robot paired with, relative to the configuration's
    /// folder. It is secret: whoever has it commands the tags.
    #[serde(default)]
    pub bonds: Option<PathBuf>,
    /// Public keys (PEM) whose signatures on records the robot trusts, relative to the
    /// configuration's folder.
    #[serde(default)]
    pub trusted_keys: Vec<PathBuf>,
    /// Refuse to find objects whose records are not signed by one of them.
    #[serde(default)]
    pub require_signature: bool,
}

/// Least field of view (degrees). The views in which a head looks for a light grow with its inverse square: at
/// ten degrees 600 of them took a simulated head nine minutes. What is this narrow is a focal length in
/// another unit.
const LEAST_FIELD_DEG: f64 = 3.0;

fn default_baud() -> u32 {
    1_000_000
}

impl Config {
    /// Reads a configuration file.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Read { path: path.into(), source })?;
        Self::parse(&text, path)
    }

    /// Reads a configuration from text; `path` is for messages only.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let config: Config = toml::from_str(text).map_err(|error| ConfigError::Parse {
            path: path.into(),
            message: error.to_string(),
        })?;
        for side in Side::BOTH {
            let camera = config.head(side).camera.model();
            camera
                .validate()
                .map_err(|source| ConfigError::Camera { side: side.name(), source })?;
            let field = |pixels: usize, focal: f64| 2.0 * (0.5 * pixels as f64 / focal).atan();
            let fields = [field(camera.width, camera.fx), field(camera.height, camera.fy)];
            let narrow = fields[0].min(fields[1]).to_degrees();
            if narrow < LEAST_FIELD_DEG {
                return Err(ConfigError::Narrow { side: side.name(), narrow });
            }
        }
        Ok(config)
    }

    /// The wiring of one head.
    pub fn head(&self, side: Side) -> &HeadConfig {
        match side {
            Side::Left => &self.left,
            Side::Right => &self.right,
        }
    }
}

impl CameraConfig {
    /// The nominal camera model.
    pub fn model(&self) -> Camera {
        let [k1, k2, p1, p2, k3] = self.distortion;
        Camera {
            width: self.width,
            height: self.height,
            fx: self.fx,
            fy: self.fy,
            cx: self.cx,
            cy: self.cy,
            distortion: Distortion { k1, k2, p1, p2, k3 },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = r#"
        pan_joint = "p"
        tilt_joint = "t"
        optical_frame = "o"
        camera = { driver = "sim", width = 320, height = 240, fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5 }
        servos = { driver = "sim" }"#;

    fn parse(extra: &str) -> Result<Config, ConfigError> {
        let text = format!(
            "robot = 'r.urdf'\n{extra}\n[left]\n{HEAD}\n[right]\n{HEAD}\n[radio]\ndriver = 'sim'\n"
        );
        Config::parse(&text, Path::new("robot.toml"))
    }

    #[test]
    fn a_wrong_key_is_named_with_its_line() {
        assert_eq!(parse("").unwrap().left.camera.model().fx, 300.0);
        let message = parse("colour = 'red'").unwrap_err().to_string();
        assert!(message.contains("colour") && message.contains("robot.toml"), "{message}");
    }

    #[test]
    fn an_impossible_camera_is_named() {
        let text = format!(
            "robot = 'r'\n[left]\n{}\n[right]\n{HEAD}\n[radio]\ndriver = 'sim'\n",
            HEAD.replace("fx = 300.0", "fx = -1.0")
        );
        let message = Config::parse(&text, Path::new("x")).unwrap_err().to_string();
        assert!(message.starts_with("[left.camera]: camera fx"), "{message}");
        // 240 rows of a lens that was stated in tenths of pixels.
        let text = text.replace("fx = -1.0, fy = 300.0", "fx = 300.0, fy = 5000.0");
        let message = Config::parse(&text, Path::new("x")).unwrap_err().to_string();
        assert!(message.starts_with("[left.camera]: the lens sees only 2.75 degrees"), "{message}");
    }
}
