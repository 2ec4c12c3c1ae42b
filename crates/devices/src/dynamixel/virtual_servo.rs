//! One emulated servo: a control table, and a shaft that follows it.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use super::model::{Model, Register, number};
use super::packet::Protocol;

/// What turns when a servo is told to; angles (rad) from mid travel, in the servo's own direction.
/// The simulated workcell puts its own joints here.
pub trait Shaft: Send {
    /// Go to `goal` no faster than `speed` (rad/s).
    fn drive(&mut self, goal: f64, speed: f64);
    /// Let go: the shaft stays where it is.
    fn release(&mut self);
    /// The angle at the encoder now, and whether it is on its way.
    fn encoder(&mut self) -> (f64, bool);
}

/// A motor in real time: constant speed, gears with slack behind the encoder, able to stall.
#[derive(Debug)]
pub struct Motor {
    goal: f64,
    speed: f64,
    angle: f64,
    output: f64,
    backlash: f64,
    held: bool,
    stalled: bool,
    updated: Instant,
}

/// A motor that a test can watch and hinder while a servo drives it.
pub type SharedMotor = Arc<Mutex<Motor>>;

impl Motor {
    /// A motor at mid travel with this much slack (rad) between encoder and output.
    pub fn new(backlash: f64) -> SharedMotor {
        Arc::new(Mutex::new(Motor {
            goal: 0.0,
            speed: 0.0,
            angle: 0.0,
            output: 0.0,
            backlash,
            held: false,
            stalled: false,
            updated: Instant::now(),
        }))
    }

    /// Something holds the shaft fast, or lets go of it.
    pub fn stall(&mut self, stalled: bool) {
        self.step();
        self.stalled = stalled;
    }

    /// Angle behind the gears (rad): lags the encoder by up to half the slack.
    pub fn output(&mut self) -> f64 {
        self.step();
        self.output
    }

    fn step(&mut self) {
        let elapsed = self.updated.elapsed().as_secs_f64();
        self.updated = Instant::now();
        if self.held && !self.stalled {
            let way = (self.goal - self.angle).clamp(-self.speed * elapsed, self.speed * elapsed);
            self.angle += way;
            let half = self.backlash / 2.0;
            self.output = self.output.clamp(self.angle - half, self.angle + half);
        }
    }
}

impl Shaft for SharedMotor {
    fn drive(&mut self, goal: f64, speed: f64) {
        let mut motor = self.lock().unwrap_or_else(PoisonError::into_inner);
        motor.step();
        (motor.goal, motor.speed, motor.held) = (goal, speed, true);
    }

    fn release(&mut self) {
        let mut motor = self.lock().unwrap_or_else(PoisonError::into_inner);
        motor.step();
        motor.held = false;
    }

    fn encoder(&mut self) -> (f64, bool) {
        let mut motor = self.lock().unwrap_or_else(PoisonError::into_inner);
        motor.step();
        let moving = motor.held && !motor.stalled && (motor.goal - motor.angle).abs() > 1e-9;
        (motor.angle, moving)
    }
}

/// Fastest no-load speed (rad/s) when the profile velocity is 0, "as fast as it can".
const FULL_SPEED: f64 = 6.0;

/// An emulated servo.
pub struct VirtualServo {
    /// Its ID.
    pub id: u8,
    pub(super) model: &'static Model,
    /// True for a servo that does not answer: unplugged.
    pub missing: bool,
    /// Fault bits, as in the error byte (1.0) or the hardware error register (2.0).
    pub fault: u8,
    table: Vec<u8>,
    prepared: Option<(u16, Vec<u8>)>,
    shaft: Box<dyn Shaft>,
}

/// Error numbers of protocol 2.0 and bits of 1.0, in this order.
const RANGE: (u8, u8) = (4, 0x08);
const LIMIT: (u8, u8) = (6, 0x02);
const ACCESS: (u8, u8) = (7, 0x08);

impl VirtualServo {
    /// A servo of a model with factory settings, torque off.
    pub fn new(id: u8, model: &'static Model, shaft: impl Shaft + 'static) -> Self {
        let mut servo = VirtualServo {
            id,
            model,
            missing: false,
            fault: 0,
            table: vec![0; 256],
            prepared: None,
            shaft: Box::new(shaft),
        };
        let r = &model.registers;
        servo.set(Register { address: 0, size: 2 }, i32::from(model.number));
        servo.set(r.return_delay, 250);
        servo.set(r.status_return, 2);
        servo.set(r.upper_limit, model.last_tick);
        servo.set(r.goal_position, model.centre_tick);
        servo.set(r.voltage, 120);
        servo.set(r.temperature, 35);
        if let Some(mode) = r.operating_mode {
            servo.set(mode, 3);
        }
        servo.refresh();
        servo
    }

    /// A number in the control table, as the master would read it.
    pub fn get(&self, register: Register) -> i32 {
        let start = usize::from(register.address);
        number(&self.table[start..start + usize::from(register.size)])
    }

    fn set(&mut self, register: Register, value: i32) {
        let start = usize::from(register.address);
        let size = usize::from(register.size);
        self.table[start..start + size].copy_from_slice(&value.to_le_bytes()[..size]);
    }

    /// Delay before its answer (us).
    pub(super) fn return_delay_us(&self) -> u64 {
        2 * self.get(self.model.registers.return_delay) as u64
    }

    /// True when it confirms writes.
    pub(super) fn confirms(&self) -> bool {
        self.get(self.model.registers.status_return) == 2
    }

    /// The error byte of its answers, `refused` being the pair of codes for 2.0 and 1.0.
    pub(super) fn error_byte(&self, refused: Option<(u8, u8)>) -> u8 {
        match self.model.protocol {
            Protocol::One => refused.map_or(0, |r| r.1) | self.fault,
            Protocol::Two => refused.map_or(0, |r| r.0) | if self.fault != 0 { 0x80 } else { 0 },
        }
    }

    /// Reads a stretch of the table.
    pub(super) fn read(&mut self, address: u16, size: u16) -> Result<Vec<u8>, (u8, u8)> {
        self.refresh();
        let (start, end) = (usize::from(address), usize::from(address) + usize::from(size));
        self.table.get(start..end).map(<[u8]>::to_vec).ok_or(RANGE)
    }

    /// Writes a stretch of the table, and obeys.
    pub(super) fn write(&mut self, address: u16, data: &[u8]) -> Result<(), (u8, u8)> {
        let start = usize::from(address);
        let end = start + data.len();
        if end > self.table.len() {
            return Err(RANGE);
        }
        let r = &self.model.registers;
        // The non-volatile part lies below the torque switch in both tables.
        let locked = self.model.protocol == Protocol::Two && address < r.torque_enable.address;
        if locked && self.get(r.torque_enable) == 1 {
            return Err(ACCESS);
        }
        let before = self.table[start..end].to_vec();
        self.table[start..end].copy_from_slice(data);
        let goal = self.get(r.goal_position);
        if !(self.get(r.lower_limit)..=self.get(r.upper_limit)).contains(&goal) {
            self.table[start..end].copy_from_slice(&before);
            return Err(LIMIT);
        }
        let covers = |register: Register| {
            (start..end).contains(&usize::from(register.address)) && !data.is_empty()
        };
        let (goal_written, torque_written) = (covers(r.goal_position), covers(r.torque_enable));
        if goal_written && self.model.protocol == Protocol::One {
            // An AX switches its torque on when it is given a goal.
            self.set(r.torque_enable, 1);
        }
        if goal_written || torque_written || covers(r.profile_velocity) {
            self.obey(torque_written && !goal_written);
        }
        Ok(())
    }

    /// Keeps a write for [`VirtualServo::action`].
    pub(super) fn prepare(&mut self, address: u16, data: &[u8]) {
        self.prepared = Some((address, data.to_vec()));
    }

    /// Does the prepared write.
    pub(super) fn action(&mut self) {
        if let Some((address, data)) = self.prepared.take() {
            // The confirmation went out when it was prepared; a refusal now stays unheard.
            let _ = self.write(address, &data);
        }
    }

    /// Restart: torque off, faults forgotten.
    pub(super) fn reboot(&mut self) {
        self.fault = 0;
        self.set(self.model.registers.torque_enable, 0);
        self.shaft.release();
    }

    fn obey(&mut self, just_enabled: bool) {
        let r = &self.model.registers;
        // A servo with a latched fault has cut its torque until it is restarted.
        if self.get(r.torque_enable) == 0 || self.fault != 0 {
            self.shaft.release();
            return;
        }
        if just_enabled {
            // Holding starts where the shaft is, not at a goal of long ago.
            let here = self.tick_of_shaft().0;
            self.set(r.goal_position, here);
        }
        let speed = f64::from(self.get(r.profile_velocity)) * self.model.speed_unit;
        let goal = f64::from(self.get(r.goal_position) - self.model.centre_tick) * self.model.tick;
        self.shaft.drive(goal, if speed > 0.0 { speed.min(FULL_SPEED) } else { FULL_SPEED });
    }

    fn tick_of_shaft(&mut self) -> (i32, bool) {
        let (angle, moving) = self.shaft.encoder();
        ((angle / self.model.tick).round() as i32 + self.model.centre_tick, moving)
    }

    fn refresh(&mut self) {
        let (tick, moving) = self.tick_of_shaft();
        let r = &self.model.registers;
        self.set(r.present_position, tick);
        self.set(r.moving, i32::from(moving));
        if let Some(register) = r.hardware_error {
            self.set(register, i32::from(self.fault));
        }
    }
}
