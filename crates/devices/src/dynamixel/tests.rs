//! The driver against the emulated bus, over memory and over a pseudo-terminal, in good and bad
//! conditions.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use vergence_geometry::Limits;

use super::model::Register;
use super::transport::{Pipe, Transport, open_port, pipe};
use super::*;
use crate::clock::SystemClock;
use crate::traits::{DeviceError, PanTilt};

fn config(model: &str, port: &str) -> DynamixelConfig {
    DynamixelConfig {
        port: port.into(),
        baud: 1_000_000,
        model: model.into(),
        pan: ServoConfig { id: 1, zero_tick: None, reversed: false },
        tilt: ServoConfig { id: 2, zero_tick: Some(500), reversed: true },
        speed: Some(5.0),
        backlash: 0.0,
        release_on_exit: true,
    }
}

const LIMITS: [Limits; 2] = [Limits { lower: -0.7, upper: 0.7, velocity: 3.6 }; 2];

fn quick() -> BusConfig {
    BusConfig { latency: Duration::from_millis(15), ..BusConfig::default() }
}

fn servos(model: &str) -> (Vec<VirtualServo>, [SharedMotor; 2]) {
    let motors = [Motor::new(0.0), Motor::new(0.004)];
    let model = Model::by_name(model).unwrap();
    let servos =
        [1, 2].map(|id| VirtualServo::new(id, model, motors[usize::from(id) - 1].clone())).into();
    (servos, motors)
}

/// A head on an emulated bus in memory.
fn head(model: &str, trouble: Trouble) -> (DynamixelPanTilt, VirtualBus, [SharedMotor; 2]) {
    let (servos, motors) = servos(model);
    let (ours, theirs) = pipe();
    let virtual_bus = VirtualBus::serve(servos, trouble, theirs);
    let bus = Arc::new(Mutex::new(Bus::new(ours, quick())));
    let config = config(model, "memory");
    let clock = Arc::new(SystemClock::start());
    let head = DynamixelPanTilt::open("test head", bus, &config, LIMITS, clock).unwrap();
    (head, virtual_bus, motors)
}

fn settle(head: &mut DynamixelPanTilt) -> Result<crate::JointReading, DeviceError> {
    let start = Instant::now();
    loop {
        let reading = head.read()?;
        if !reading.moving {
            return Ok(reading);
        }
        assert!(start.elapsed() < Duration::from_secs(3), "never comes to rest: {reading:?}");
    }
}

#[test]
fn moves_and_reads_in_radians_with_both_protocols() {
    for model in ["AX-12A", "XL430-W250"] {
        let (mut head, bus, _) = head(model, Trouble::default());
        head.move_to(0.3, -0.2).unwrap();
        let reading = settle(&mut head).unwrap();
        let step = head.resolution();
        assert!((reading.pan - 0.3).abs() <= step / 2.0 + 1e-9, "{model}: {reading:?}");
        assert!((reading.tilt + 0.2).abs() <= step / 2.0 + 1e-9, "{model}: {reading:?}");
        // The tilt servo is mounted the other way round: its ticks fall with the angle.
        let r = &Model::by_name(model).unwrap().registers;
        let tick = bus.servos()[1].get(r.present_position);
        assert_eq!(tick, 500 + (0.2 / step).round() as i32);
        assert_eq!(bus.servos()[0].get(r.return_delay), 0);
        drop(head);
        assert_eq!(bus.servos()[0].get(r.torque_enable), 0, "released on exit");
    }
}

/// An adapter on the one wire of a half-duplex bus: it hears what it says.
struct Echoing {
    wire: Pipe,
    echo: Vec<u8>,
}

impl Transport for Echoing {
    fn send(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.echo.extend_from_slice(bytes);
        self.wire.send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], timeout: Duration) -> std::io::Result<usize> {
        if self.echo.is_empty() {
            return self.wire.receive(buffer, timeout);
        }
        let count = self.echo.len().min(buffer.len());
        buffer[..count].copy_from_slice(&self.echo[..count]);
        self.echo.drain(..count);
        Ok(count)
    }

    fn discard(&mut self) -> std::io::Result<()> {
        self.echo.clear();
        self.wire.discard()
    }
}

#[test]
fn an_echo_of_our_own_words_is_no_answer() {
    for name in ["AX-12A", "XL430-W250"] {
        let (servos, _) = servos(name);
        let (ours, theirs) = pipe();
        let _bus = VirtualBus::serve(servos, Trouble::default(), theirs);
        let mut bus = Bus::new(Echoing { wire: ours, echo: Vec::new() }, quick());
        let model = Model::by_name(name).unwrap();
        let (protocol, r) = (model.protocol, &model.registers);
        assert_eq!(bus.ping(protocol, 1).unwrap(), model.number);
        bus.write(protocol, 1, r.goal_position, 600).unwrap();
        let answer = bus.read(protocol, 1, r.goal_position).unwrap();
        assert_eq!((model::number(&answer.data), answer.error), (600, 0), "{name}");
        // Nobody has this number; the echo alone is silence.
        assert!(matches!(bus.ping(protocol, 9), Err(BusError::Silent { id: 9 })), "{name}");
    }
}

#[test]
fn a_head_tells_the_speed_that_its_servos_were_given() {
    let (head, bus, _) = head("AX-12A", Trouble::default());
    let model = Model::by_name("AX-12A").unwrap();
    let units = bus.servos()[0].get(model.registers.profile_velocity);
    assert_eq!(head.speed(), Some(f64::from(units) * model.speed_unit));
    assert!((head.speed().unwrap() - 5.0).abs() < model.speed_unit);
}

#[test]
fn works_over_a_pseudo_terminal() {
    let (servos, _) = servos("XM430-W350");
    let (_bus, path) = VirtualBus::on_pty(servos, Trouble::default()).unwrap();
    let port = open_port(&path, 1_000_000).unwrap();
    let bus = Arc::new(Mutex::new(Bus::new(port, BusConfig::default())));
    let config = config("XM430-W350", &path.display().to_string());
    let clock = Arc::new(SystemClock::start());
    let mut head = DynamixelPanTilt::open("test head", bus, &config, LIMITS, clock).unwrap();
    head.move_to(-0.4, 0.5).unwrap();
    let reading = settle(&mut head).unwrap();
    assert!((reading.pan + 0.4).abs() < 0.001 && (reading.tilt - 0.5).abs() < 0.001);
}

#[test]
fn a_bad_wire_costs_time_but_not_truth() {
    let trouble = Trouble { noise: 0.2, cut: 0.05, damage: 0.05, seed: 5, ..Trouble::default() };
    let (servos, _) = servos("XL430-W250");
    let (ours, theirs) = pipe();
    let bus = VirtualBus::serve(servos, trouble, theirs);
    let config = BusConfig { attempts: 8, ..quick() };
    let mut master = Bus::new(ours, config);
    let goal = Model::by_name("XL430-W250").unwrap().registers.goal_position;
    for value in 1000..1060 {
        master.write(Protocol::Two, 1, goal, value).unwrap();
        assert_eq!(bus.servos()[0].get(goal), value);
        let answers = master.sync_read(Protocol::Two, goal, &[1, 2]).unwrap();
        assert_eq!(model::number(&answers[0].data), value);
        assert_eq!(model::number(&answers[1].data), 2048);
    }
}

#[test]
fn late_answers_are_not_taken_for_others() {
    // The answer comes after its time-out: the next exchange must not believe it.
    let (servos, _) = servos("XL430-W250");
    let (ours, theirs) = pipe();
    let trouble = Trouble { latency: Duration::from_millis(30), ..Trouble::default() };
    let _bus = VirtualBus::serve(servos, trouble, theirs);
    let mut master = Bus::new(ours, BusConfig { attempts: 1, ..quick() });
    let place = Register { address: 116, size: 4 };
    assert!(matches!(master.read(Protocol::Two, 1, place), Err(BusError::Silent { id: 1 })));
    std::thread::sleep(Duration::from_millis(60));
    assert!(matches!(
        master.read(Protocol::Two, 2, Register { address: 144, size: 2 }),
        Err(BusError::Silent { id: 2 })
    ));
}

#[test]
fn a_stalled_servo_is_a_fault() {
    let (mut head, _bus, motors) = head("XL430-W250", Trouble::default());
    motors[0].lock().unwrap().stall(true);
    head.move_to(0.5, 0.1).unwrap();
    let Err(DeviceError::Fault { fault, .. }) = settle(&mut head) else {
        panic!("a held shaft must be told");
    };
    assert!(fault.starts_with("servo 1 stalls at tick 2048"), "{fault}");
}

#[test]
fn heat_and_overload_are_told_in_words() {
    for (model, bits) in [("AX-12A", 0x24), ("XL430-W250", 0x24)] {
        let (mut head, bus, _) = head(model, Trouble::default());
        bus.servos()[1].fault = bits;
        let Err(DeviceError::Fault { fault, .. }) = head.read() else {
            panic!("{model} has a fault");
        };
        assert_eq!(fault, "servo 2 reports overheated and overload", "{model}");
        let health = head.health().unwrap();
        assert_eq!((health[0].temperature, health[0].voltage), (35, 12.0));
        assert_eq!(health[1].faults, ["overheated", "overload"]);
    }
}

#[test]
fn a_missing_servo_is_told_in_bounded_time() {
    let (mut head, bus, _) = head("XL430-W250", Trouble::default());
    bus.servos()[1].missing = true;
    let start = Instant::now();
    let Err(DeviceError::Timeout { device, .. }) = head.read() else {
        panic!("servo 2 is gone");
    };
    assert_eq!(device, "test head (servo 2)");
    assert!(start.elapsed() < Duration::from_millis(500));
    drop(bus);
    assert!(matches!(head.read(), Err(DeviceError::Disconnected { .. })));
}

#[test]
fn what_does_not_fit_is_refused_at_once() {
    let open = |config: &DynamixelConfig, limits| {
        let (ours, theirs) = pipe();
        let _bus = VirtualBus::serve(servos("XL430-W250").0, Trouble::default(), theirs);
        let bus = Arc::new(Mutex::new(Bus::new(ours, quick())));
        let clock = Arc::new(SystemClock::start());
        let result = DynamixelPanTilt::open("test head", bus, config, limits, clock);
        result.err().map(|e| e.to_string()).unwrap_or_default()
    };
    let good = config("XL430-W250", "memory");
    let other = DynamixelConfig { model: "XM430-W350".into(), ..good.clone() };
    assert!(open(&other, LIMITS).contains("is XL430-W250 (number 1060)"));
    let unknown = DynamixelConfig { model: "SG90".into(), ..good.clone() };
    assert!(open(&unknown, LIMITS).contains("known are AX-12A"));
    let wide = [LIMITS[0], Limits { lower: -3.0, upper: 3.0, velocity: 3.6 }];
    let message = open(&good, wide);
    assert!(message.contains("of servo 2, which allows 0 to 4095"), "{message}");
    let (mut head, ..) = head("XL430-W250", Trouble::default());
    assert!(matches!(head.move_to(0.9, 0.0), Err(DeviceError::Unsupported { .. })));
}
