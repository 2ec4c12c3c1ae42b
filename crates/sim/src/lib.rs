//! The simulated workcell: two cameras on pan-tilt heads before a table with tagged objects.
//!
//! In: a robot's configuration and description (embedded ones by default) and a seed. Out: the
//! devices of [`vergence_devices::Robot`], behind which pictures are ray-traced, servos turn, tags
//! answer and virtual time passes. [`Workcell::truth`] tells what is really so, for judging results;
//! nothing of it passes through the devices.
//!
//! Equal configuration, seed and sequence of calls give equal bytes. What is simulated and how is
//! said in the private modules: `trace` (light), `camera` (sensor), `servo`, `radio`, `lights`.
//! [`WiredWorkcell`] offers the same devices over the wires of real ones, in real time.
//! [`stereo_scene`] gives single stereo pairs with their truth, for measuring pose recognition.

mod camera;
mod config;
mod devices;
mod error;
mod faces;
mod lights;
mod noise;
mod placement;
mod radio;
mod scene;
mod servo;
mod stereo_scene;
mod trace;
mod wired;
mod workcell;
mod world;

pub use config::{
    CameraSettings, GeometryError, LedSettings, LightSettings, ObjectSettings, RadioSettings,
    Scenario, ServoSettings, SimConfig, Surface,
};
pub use error::SimError;
pub use stereo_scene::{StereoScene, stereo_scene};
pub use vergence_link::HciLink;
pub use wired::{WiredWorkcell, fitting_servo};
pub use workcell::{ArmPart, TrueCamera, TrueObject, Truth, Workcell, embedded_files, settings};

/// The embedded robot's description.
pub const EMBEDDED_URDF: &str = include_str!("../assets/workcell.urdf");
/// The embedded robot's wiring and the simulator's table.
pub const EMBEDDED_CONFIG: &str = include_str!("../assets/workcell.toml");
