//! What a configuration says about the Dynamixel servos of one head.
//!
//! ```toml
//! [left.servos]
//! driver = "dynamixel"
//!
//! [left.servos.dynamixel]
//! port = "/dev/ttyUSB0"            # both heads may share one port
//! baud = 1000000
//! model = "XM430-W350"             # AX-12A, MX-28, XL430-W250, XM430-W350, XM430-W210
//! pan = { id = 1 }
//! tilt = { id = 2, reversed = true, zero_tick = 2060 }
//! ```

use serde::Deserialize;

/// Servos of one head.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DynamixelConfig {
    /// Serial device or pseudo-terminal.
    pub port: String,
    /// Bits per second.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// Servo model, the same for pan and tilt; fixes protocol and control table.
    pub model: String,
    /// The servo that pans.
    pub pan: ServoConfig,
    /// The servo that tilts.
    pub tilt: ServoConfig,
    /// Speed of moves (rad/s); the joint's limit in the URDF when left out.
    #[serde(default)]
    pub speed: Option<f64>,
    /// Slack of the gears (rad), for the approach from one side and the covariance.
    #[serde(default)]
    pub backlash: f64,
    /// Let go of the head when the program ends. Off, the head keeps looking where it looks.
    #[serde(default = "default_true")]
    pub release_on_exit: bool,
}

/// One servo.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServoConfig {
    /// ID on the bus.
    pub id: u8,
    /// Position (ticks) at joint angle zero; mid travel when left out.
    #[serde(default)]
    pub zero_tick: Option<i32>,
    /// The servo counts against the joint's positive direction.
    #[serde(default)]
    pub reversed: bool,
}

fn default_baud() -> u32 {
    1_000_000
}

fn default_true() -> bool {
    true
}
