//! Opens the robot that a command works with: the configured devices, or the simulated workcell.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use rand::TryRng;
use rand::rngs::SysRng;
use vergence::System;
use vergence::report::{PhysicsReport, Report, TruthReport, numbers};
use vergence_devices::{Config, Description, Robot, Side};
use vergence_geometry::Transform;
use vergence_sim::{Scenario, SimConfig, Workcell};
use vergence_tag::signature::TrustedKeys;

use crate::bench::{self, SharedBench};
use crate::drivers::{self, BLUEZ, HCI, RECORDING, SIM};
use crate::failure::Failure;
use crate::radio::{self, Radio};
use crate::signing;

/// Key of `[sim]` for [`built`].
pub const BUILT: &str = "built";

/// Which robot.
#[derive(Args, Clone, Default)]
pub struct RobotArgs {
    /// Wiring of the robot (TOML); the embedded simulated workcell without it.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Seed of the simulated workcell and of every random choice; with real devices the operating
    /// system's randomness decides.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// A robot ready to work.
pub struct Opened {
    /// Devices and geometry.
    pub system: System,
    /// Wiring.
    pub config: Config,
    /// URDF.
    pub description: Description,
    /// The simulator, when it serves the devices.
    workcell: Option<Arc<Workcell>>,
    /// The contacts of the simulated arm, when it is attached.
    bench: Option<SharedBench>,
}

/// How far a reported pose is from the simulator's truth.
pub struct Errors {
    /// Distance of the centres (mm).
    pub position_mm: f64,
    /// Angle, the object's symmetry considered (degrees).
    pub rotation_deg: f64,
}

impl RobotArgs {
    /// Opens what the configuration names.
    pub fn open(&self) -> Result<Opened, Failure> {
        match &self.config {
            Some(path) => {
                let (config, description) = read(path)?;
                check_drivers(&config)?;
                let signers = signing::required(&config, folder(path))?;
                if !drivers::simulated(&config)? {
                    let devices = drivers::open(&config, &description, folder(path))?;
                    let opened = Opened::wired(config, description, devices)?;
                    return Ok(opened.signed_by(signers));
                }
                let workcell = self.workcell(path, &config, &description)?;
                let mut devices = workcell.robot();
                if config.radio.driver != SIM {
                    devices.radio = radio::open(&config, folder(path))?.link;
                }
                let opened = Opened::new(workcell, devices, config, description)?;
                Ok(opened.signed_by(signers))
            }
            None => Opened::embedded(self.seed, Scenario::Default),
        }
    }

    /// What a simulated workcell is made of: the configuration's, else the embedded one's.
    pub fn simulation(&self) -> Result<(Config, Description, SimConfig), Failure> {
        let (config, description) = match &self.config {
            Some(path) => {
                let (config, description) = read(path)?;
                match built(path, &config)? {
                    Some(other) => read(&other)?,
                    None => (config, description),
                }
            }
            None => vergence_sim::embedded_files().map_err(unusable)?,
        };
        let settings = vergence_sim::settings(&config).map_err(unusable)?;
        Ok((config, description, settings))
    }

    /// Opens the tag radio alone.
    pub fn open_radio(&self) -> Result<Radio, Failure> {
        let (workcell, trusted) = match &self.config {
            Some(path) => {
                let (config, description) = read(path)?;
                check_drivers(&config)?;
                if config.radio.driver != SIM {
                    return radio::open(&config, folder(path));
                }
                let trusted = signing::trusted(&config, folder(path))?;
                (self.workcell(path, &config, &description)?, trusted)
            }
            None => (Workcell::embedded(self.seed).map_err(unusable)?, TrustedKeys::default()),
        };
        Ok(Radio::simulated(&workcell, trusted))
    }

    /// The simulated workcell of a configuration. A calibrated configuration names the one from which
    /// the head was built, which stays as it is whatever is now believed of it.
    fn workcell(
        &self,
        path: &Path,
        config: &Config,
        description: &Description,
    ) -> Result<Workcell, Failure> {
        let workcell = match built(path, config)? {
            Some(other) => {
                let (config, description) = read(&other)?;
                Workcell::from_config(&config, &description, self.seed)
            }
            None => Workcell::from_config(config, description, self.seed),
        };
        workcell.map_err(unusable)
    }
}

impl Opened {
    /// The embedded workcell in one of its scenarios.
    pub fn embedded(seed: u64, scenario: Scenario) -> Result<Self, Failure> {
        let workcell = Workcell::embedded_as(scenario, seed).map_err(unusable)?;
        let devices = workcell.robot();
        let (config, description) = (workcell.config().clone(), workcell.description().clone());
        Self::new(workcell, devices, config, description)
    }

    /// A robot whose devices are not the simulator's.
    fn wired(config: Config, description: Description, devices: Robot) -> Result<Self, Failure> {
        let system = System::new(devices, &config, &description).map_err(unusable)?;
        Ok(Opened { system, config, description, workcell: None, bench: None })
    }

    fn new(
        workcell: Workcell,
        devices: Robot,
        config: Config,
        description: Description,
    ) -> Result<Self, Failure> {
        let system = System::new(devices, &config, &description).map_err(unusable)?;
        let workcell = Some(Arc::new(workcell));
        Ok(Opened { system, config, description, workcell, bench: None })
    }

    /// What random choices are drawn from: in simulation and with recorded pictures `given`, so that a
    /// run repeats exactly. Of real tags nobody may know beforehand what they will be told to blink, so
    /// that the operating system's randomness decides.
    pub fn seed(&self, given: u64) -> Result<u64, Failure> {
        let recorded = |side| self.config.head(side).camera.driver == RECORDING;
        if self.workcell.is_some() || Side::BOTH.into_iter().any(recorded) {
            return Ok(given);
        }
        SysRng.try_next_u64().map_err(|error| {
            Failure::failed(error, "the system gives no random numbers: is its start over?")
        })
    }

    /// The simulator, when it serves the devices.
    pub fn simulator(&self) -> Option<Arc<Workcell>> {
        self.workcell.clone()
    }

    /// Gives the robot its arm, when it has one: contacts are simulated around one object. With
    /// `photographs` the stages are kept for [`Opened::save_grasp`].
    pub fn attach_arm(&mut self, object: &str, photographs: bool) -> Result<(), Failure> {
        let (Some(workcell), Some(_)) = (&self.workcell, &self.config.arm) else { return Ok(()) };
        let built = bench::build(workcell, &self.description, object, photographs)?;
        if let Some((arm, bench)) = built {
            self.system.robot.arm = Some(Box::new(arm));
            self.system.hand = Some(bench::hand(&self.config, &self.description)?);
            self.bench = Some(bench);
        }
        Ok(())
    }

    /// Writes the grasp as an onlooker saw it (`stages.png`) and for a second physics engine
    /// (`replay.json`), in simulation.
    pub fn save_grasp(&self, dir: &Path) -> Result<(), Failure> {
        self.bench.as_ref().map_or(Ok(()), |bench| bench::lock(bench).save(dir))
    }

    /// The physics' verdict on what the arm did, in simulation.
    pub fn physics(&self) -> Option<PhysicsReport> {
        self.bench.as_ref().map(|bench| bench::lock(bench).verdict())
    }

    /// The same, for records that one of these keys signed.
    fn signed_by(mut self, signers: Option<TrustedKeys>) -> Self {
        self.system.required_signers = signers;
        self
    }

    /// The simulator's truth of an object.
    pub fn truth(&self, object: &str) -> Option<TruthReport> {
        let truth = self.workcell.as_ref()?.truth();
        let object = truth.objects.iter().find(|o| o.id == object)?;
        let (position, orientation) = numbers(&object.base_from_object);
        let landmark = object.landmarks.first()?.coords.into();
        Some(TruthReport { position, orientation, landmark })
    }
}

impl Errors {
    /// Compares a report with the truth that it carries; `None` without a pose or a truth.
    pub fn of(report: &Report) -> Option<Self> {
        let (pose, truth) = (report.pose.as_ref()?, report.truth.as_ref()?);
        let transform = |p: [f64; 3], q: [f64; 4]| {
            let rotation = nalgebra::Quaternion::new(q[3], q[0], q[1], q[2]);
            Transform::from_parts(p.into(), nalgebra::UnitQuaternion::from_quaternion(rotation))
        };
        let reported = transform(pose.position, pose.orientation);
        let real = transform(truth.position, truth.orientation);
        let distance = (reported.translation.vector - real.translation.vector).norm();
        let angle = report.symmetry.angle_between(&reported.rotation, &real.rotation);
        Some(Errors { position_mm: 1e3 * distance, rotation_deg: angle.to_degrees() })
    }
}

/// Reads the configuration and the description that it names.
fn read(path: &Path) -> Result<(Config, Description), Failure> {
    let config = Config::read(path).map_err(unusable)?;
    let urdf = urdf(path, &config);
    let text = std::fs::read_to_string(&urdf).map_err(|error| {
        Failure::misuse(
            format!("cannot read {}: {error}", urdf.display()),
            "the key `robot` names the URDF, relative to the configuration's folder",
        )
    })?;
    let description = Description::parse(&text, &urdf).map_err(unusable)?;
    Ok((config, description))
}

/// Where the URDF is that the configuration at this path names.
pub fn urdf(path: &Path, config: &Config) -> PathBuf {
    folder(path).join(&config.robot)
}

/// Refuses a name for a configuration whose URDF, beside it, would have the same.
pub fn not_urdf(path: &Path) -> Result<(), Failure> {
    if path.extension().is_none_or(|extension| extension != "urdf") {
        return Ok(());
    }
    Err(Failure::misuse(
        format!("{} would be both the configuration and its URDF", path.display()),
        "name the configuration FILE.toml; its URDF goes beside it",
    ))
}

/// The folder that a configuration's paths are relative to.
fn folder(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

/// The configuration that a calibrated one of the simulated workcell was made from: `[sim] built`.
fn built(path: &Path, config: &Config) -> Result<Option<PathBuf>, Failure> {
    let Some(named) = config.sim.as_ref().and_then(|sim| sim.get(BUILT)) else { return Ok(None) };
    match named.as_str() {
        Some(name) => Ok(Some(folder(path).join(name))),
        None => Err(Failure::misuse("[sim] built is not a path", "calibrate anew")),
    }
}

/// Refuses drivers of radio and arm that do not exist.
fn check_drivers(config: &Config) -> Result<(), Failure> {
    match config.radio.driver.as_str() {
        SIM | HCI | BLUEZ => {}
        other => return Err(drivers::unknown("radio", other, "hci, bluez")),
    }
    match &config.arm {
        Some(arm) if arm.driver != SIM => Err(drivers::unknown("arm", &arm.driver, "no other")),
        _ => Ok(()),
    }
}

/// A configuration that cannot be used.
pub fn unusable(error: impl std::fmt::Display) -> Failure {
    Failure::misuse(error, "compare with the workcell that is built in: `vergence workcell DIR`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_simulation_repeats_its_choices() {
        let mut robot = Opened::embedded(1, Scenario::Default).unwrap();
        assert_eq!(robot.seed(7).unwrap(), 7);
        robot.workcell = None;
        assert_ne!(robot.seed(7).unwrap(), robot.seed(7).unwrap());
    }
}
