//! The driver: two servos as one [`PanTilt`].
//!
//! Opening checks what is on the bus: both servos answer, are the model that the configuration
//! says, are in position mode and allow the joint's range; it sets the return delay to zero and the
//! speed, and switches the torque on where the head stands. A move is one sync write that is read back;
//! a reading is one sync read of goal, position and moving flag. A goal that got lost on the wire is
//! sent again. Faults that the servos report (heat, overload, voltage) and shafts that stop far from
//! their goal become [`DeviceError::Fault`]; every call is bounded by the bus's time-outs.

use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use vergence_geometry::Limits;

use super::bus::{Bus, BusConfig, BusError, conditions};
use super::config::{DynamixelConfig, ServoConfig};
use super::model::{Model, Register, number};
use super::packet::Protocol;
use super::transport::open_port;
use crate::traits::{Clock, DeviceError, JointReading, PanTilt};

/// A shaft that has not come nearer to its goal for so long has come to rest or stalls.
const NO_PROGRESS: Duration = Duration::from_millis(300);
/// Rest further from the goal than this (rad) is a stall, not friction.
const STALL_ANGLE: f64 = 0.05;

/// A bus that several heads share.
pub type SharedBus = Arc<Mutex<Bus>>;

/// One servo and how its ticks count.
#[derive(Debug, Clone, Copy)]
struct Servo {
    id: u8,
    zero_tick: i32,
    /// Joint radians per tick, signed.
    scale: f64,
    /// In the model's units.
    speed: i32,
    limits: Limits,
}

/// A move that is under way.
#[derive(Debug, Clone, Copy)]
struct Move {
    goal: [i32; 2],
    nearest: i32,
    since: Duration,
}

/// Two Dynamixel servos that turn one camera.
pub struct DynamixelPanTilt {
    name: String,
    bus: SharedBus,
    clock: Arc<dyn Clock>,
    model: &'static Model,
    servos: [Servo; 2],
    backlash: f64,
    release_on_exit: bool,
    moving: Option<Move>,
}

/// Temperature, voltage and fault of one servo.
#[derive(Debug, Clone, PartialEq)]
pub struct Health {
    /// Its ID.
    pub id: u8,
    /// Degrees Celsius.
    pub temperature: i32,
    /// Volts.
    pub voltage: f64,
    /// What it complains about.
    pub faults: Vec<&'static str>,
}

/// Opens the servos of both heads; heads that name the same port share it.
pub fn open_heads(
    configs: [&DynamixelConfig; 2],
    limits: [[Limits; 2]; 2],
    clock: Arc<dyn Clock>,
) -> Result<[DynamixelPanTilt; 2], DeviceError> {
    let mut ports: HashMap<String, SharedBus> = HashMap::new();
    let mut open = |k: usize, name: &str| {
        let config = configs[k];
        let bus = match ports.get(&config.port) {
            Some(bus) => bus.clone(),
            None => {
                let path = Path::new(&config.port);
                let port = open_port(path, config.baud).map_err(|e| DeviceError::Disconnected {
                    device: format!("servo port {}", config.port),
                    reason: e.to_string(),
                })?;
                let times = BusConfig { baud: config.baud, ..BusConfig::default() };
                let bus = Arc::new(Mutex::new(Bus::new(port, times)));
                ports.insert(config.port.clone(), bus.clone());
                bus
            }
        };
        DynamixelPanTilt::open(name, bus, config, limits[k], clock.clone())
    };
    Ok([open(0, "left head servos")?, open(1, "right head servos")?])
}

impl DynamixelPanTilt {
    /// Opens the two servos of one head on a bus, see the module's text.
    pub fn open(
        name: &str,
        bus: SharedBus,
        config: &DynamixelConfig,
        limits: [Limits; 2],
        clock: Arc<dyn Clock>,
    ) -> Result<Self, DeviceError> {
        let model = Model::by_name(&config.model).ok_or_else(|| DeviceError::Unsupported {
            device: name.into(),
            what: format!(
                "servo model \"{}\" is not known; known are {}",
                config.model,
                super::model::MODELS.map(|m| m.name).join(", ")
            ),
        })?;
        let units = |speed: f64| (speed / model.speed_unit).round().clamp(1.0, 1023.0) as i32;
        let servo = |servo: &ServoConfig, limits: Limits| Servo {
            id: servo.id,
            zero_tick: servo.zero_tick.unwrap_or(model.centre_tick),
            scale: if servo.reversed { -model.tick } else { model.tick },
            speed: units(config.speed.unwrap_or(limits.velocity)),
            limits,
        };
        let servos = [servo(&config.pan, limits[0]), servo(&config.tilt, limits[1])];
        let head = DynamixelPanTilt {
            name: name.into(),
            bus,
            clock,
            model,
            servos,
            backlash: config.backlash,
            release_on_exit: config.release_on_exit,
            moving: None,
        };
        for servo in &head.servos {
            head.prepare(servo)?;
        }
        Ok(head)
    }

    /// Checks and sets up one servo.
    fn prepare(&self, servo: &Servo) -> Result<(), DeviceError> {
        let (model, r) = (self.model, &self.model.registers);
        let (protocol, id) = (model.protocol, servo.id);
        let mut bus = self.lock();
        let found = bus.ping(protocol, id).map_err(|e| self.error(e))?;
        if found != model.number {
            let is = Model::by_number(found).map_or("an unknown model", |m| m.name);
            return Err(self.unsupported(format!(
                "servo {id} is {is} (number {found}), the configuration says {}",
                model.name
            )));
        }
        let read = |bus: &mut Bus, register: Register| {
            let answer = bus.read(protocol, id, register).map_err(|e| self.error(e))?;
            Ok::<i32, DeviceError>(number(&answer.data))
        };
        self.check_range(servo, read(&mut bus, r.lower_limit)?, read(&mut bus, r.upper_limit)?)?;
        let write = |bus: &mut Bus, register: Register, value: i32| {
            bus.write(protocol, id, register, value).map_err(|e| self.error(e))
        };
        if read(&mut bus, r.status_return)? != 2 {
            return Err(self.unsupported(format!(
                "servo {id} does not confirm writes: set its status return level to 2"
            )));
        }
        // The non-volatile part can be written only without torque.
        let mode_wrong = match r.operating_mode {
            Some(mode) => read(&mut bus, mode)? != 3,
            None => false,
        };
        if mode_wrong || read(&mut bus, r.return_delay)? != 0 {
            write(&mut bus, r.torque_enable, 0)?;
            if let (true, Some(mode)) = (mode_wrong, r.operating_mode) {
                write(&mut bus, mode, 3)?;
            }
            write(&mut bus, r.return_delay, 0)?;
        }
        write(&mut bus, r.profile_velocity, servo.speed)?;
        // Hold where it stands: an AX given torque runs to its last goal, so that is set first.
        let here = read(&mut bus, r.present_position)?.clamp(0, model.last_tick);
        if protocol == Protocol::One {
            write(&mut bus, r.goal_position, here)?;
        }
        write(&mut bus, r.torque_enable, 1)
    }

    fn check_range(&self, servo: &Servo, lower: i32, upper: i32) -> Result<(), DeviceError> {
        let ends = [servo.limits.lower, servo.limits.upper].map(|a| servo.tick(a));
        let (need_low, need_high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        let (lower, upper) = (lower.max(0), upper.min(self.model.last_tick));
        if need_low < lower || need_high > upper {
            return Err(self.unsupported(format!(
                "the joint's range needs ticks {need_low} to {need_high} of servo {}, which allows \
                 {lower} to {upper}: correct the URDF's limits, zero_tick, or the servo's limits",
                servo.id
            )));
        }
        Ok(())
    }

    /// Temperature, voltage and faults of both servos.
    pub fn health(&mut self) -> Result<[Health; 2], DeviceError> {
        let mut bus = self.lock();
        let mut of = |servo: &Servo| {
            let (r, protocol) = (&self.model.registers, self.model.protocol);
            let mut read = |register| bus.read(protocol, servo.id, register);
            let temperature = read(r.temperature)?;
            let voltage = read(r.voltage)?;
            let bits = match r.hardware_error {
                Some(register) => read(register)?.data[0],
                None => voltage.error,
            };
            Ok::<Health, BusError>(Health {
                id: servo.id,
                temperature: number(&temperature.data),
                voltage: f64::from(number(&voltage.data)) / 10.0,
                faults: conditions(protocol, bits),
            })
        };
        let both = [of(&self.servos[0]), of(&self.servos[1])];
        let [a, b] = both.map(|h| h.map_err(|e| self.error(e)));
        Ok([a?, b?])
    }

    fn lock(&self) -> MutexGuard<'_, Bus> {
        // A panic in another holder leaves no half state: every exchange starts afresh.
        self.bus.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn ids(&self) -> [u8; 2] {
        self.servos.map(|s| s.id)
    }

    fn send_goal(&self, goal: [i32; 2]) -> Result<(), DeviceError> {
        let register = self.model.registers.goal_position;
        let values = [(self.servos[0].id, goal[0]), (self.servos[1].id, goal[1])];
        let mut bus = self.lock();
        bus.sync_write(self.model.protocol, register, &values).map_err(|e| self.error(e))
    }

    /// Goal, position and moving flag of both servos; faults become errors.
    fn snapshot(&self) -> Result<[[i32; 3]; 2], DeviceError> {
        let (model, r) = (self.model, &self.model.registers);
        let stretch = model.snapshot();
        let mut bus = self.lock();
        let answers =
            bus.sync_read(model.protocol, stretch, &self.ids()).map_err(|e| self.error(e))?;
        let mut out = [[0; 3]; 2];
        for (k, answer) in answers.iter().enumerate().take(2) {
            let id = self.servos[k].id;
            let bits = match (model.protocol, r.hardware_error) {
                (Protocol::Two, Some(register)) if answer.error & 0x80 != 0 => {
                    let read = bus.read(model.protocol, id, register).map_err(|e| self.error(e))?;
                    read.data[0]
                }
                (Protocol::Two, _) => 0,
                (Protocol::One, _) => answer.error,
            };
            let faults = conditions(model.protocol, bits);
            if !faults.is_empty() {
                return Err(self.fault(format!("servo {id} reports {}", faults.join(" and "))));
            }
            let field = |register: Register| {
                let start = usize::from(register.address - stretch.address);
                number(&answer.data[start..start + usize::from(register.size)])
            };
            out[k] = [field(r.goal_position), field(r.present_position), field(r.moving)];
        }
        Ok(out)
    }

    fn fault(&self, fault: String) -> DeviceError {
        DeviceError::Fault { device: self.name.clone(), fault }
    }

    fn unsupported(&self, what: String) -> DeviceError {
        DeviceError::Unsupported { device: self.name.clone(), what }
    }

    fn error(&self, error: BusError) -> DeviceError {
        let device = self.name.clone();
        match error {
            BusError::Silent { id } => {
                let times = BusConfig::default();
                let timeout = times.latency * times.attempts as u32;
                DeviceError::Timeout { device: format!("{device} (servo {id})"), timeout }
            }
            BusError::Port(e) => DeviceError::Disconnected { device, reason: e.to_string() },
            other => self.fault(other.to_string()),
        }
    }
}

impl Servo {
    fn tick(&self, angle: f64) -> i32 {
        (angle / self.scale).round() as i32 + self.zero_tick
    }

    fn angle(&self, tick: i32) -> f64 {
        f64::from(tick - self.zero_tick) * self.scale
    }
}

impl PanTilt for DynamixelPanTilt {
    fn move_to(&mut self, pan: f64, tilt: f64) -> Result<(), DeviceError> {
        for (servo, (angle, axis)) in self.servos.iter().zip([(pan, "pan"), (tilt, "tilt")]) {
            if !servo.limits.contains(angle) {
                return Err(self.unsupported(format!(
                    "{axis} {angle:.3} rad is outside {:.3} to {:.3} rad",
                    servo.limits.lower, servo.limits.upper
                )));
            }
        }
        let goal = [self.servos[0].tick(pan), self.servos[1].tick(tilt)];
        // Nobody confirms a sync write, so the goals are read back.
        let attempts = BusConfig::default().attempts;
        for attempt in 1.. {
            self.send_goal(goal)?;
            let told = self.snapshot()?.map(|s| s[0]);
            if told == goal {
                break;
            }
            if attempt >= attempts {
                return Err(self.fault(format!(
                    "servos {:?} keep the goals {told:?} instead of {goal:?}",
                    self.ids()
                )));
            }
        }
        self.moving = Some(Move { goal, nearest: i32::MAX, since: self.clock.now() });
        Ok(())
    }

    fn read(&mut self) -> Result<JointReading, DeviceError> {
        let before = self.clock.now();
        let now = self.snapshot()?;
        let after = self.clock.now();
        // The servos sampled somewhere between question and answer.
        let stamp = before + (after.saturating_sub(before)) / 2;
        let [pan, tilt] = [0, 1].map(|k| self.servos[k].angle(now[k][1]));
        let mut moving = now.iter().any(|s| s[2] == 1);
        if let Some(mut run) = self.moving {
            let off = [0, 1].map(|k| (run.goal[k] - now[k][1]).abs());
            let farthest = off[0].max(off[1]);
            if farthest < run.nearest {
                (run.nearest, run.since) = (farthest, after);
            }
            let stuck = after.saturating_sub(run.since) > NO_PROGRESS;
            if off.iter().all(|&ticks| ticks <= 1) && !moving {
                self.moving = None;
            } else if stuck && !moving {
                self.moving = None;
                if f64::from(farthest) * self.model.tick > STALL_ANGLE {
                    let k = usize::from(off[1] > off[0]);
                    return Err(self.fault(format!(
                        "servo {} stalls at tick {}, its goal is {}",
                        self.servos[k].id, now[k][1], run.goal[k]
                    )));
                }
            } else {
                // Within the ticks that friction may leave, waiting for no progress is not worth it.
                moving |= farthest > self.model.rest_ticks
                    || after.saturating_sub(run.since) < NO_PROGRESS / 6;
                self.moving = Some(run);
            }
        }
        Ok(JointReading { stamp, pan, tilt, moving })
    }

    fn resolution(&self) -> f64 {
        self.model.tick
    }

    fn backlash(&self) -> f64 {
        self.backlash
    }

    fn speed(&self) -> Option<f64> {
        let [pan, tilt] = self.servos.map(|servo| servo.speed);
        Some(f64::from(pan.min(tilt)) * self.model.speed_unit)
    }
}

impl Drop for DynamixelPanTilt {
    fn drop(&mut self) {
        if self.release_on_exit {
            let register = self.model.registers.torque_enable;
            for id in self.ids() {
                // The program ends; whoever wanted to know of a dead bus has been told.
                let _ = self.lock().write(self.model.protocol, id, register, 0);
            }
        }
    }
}
