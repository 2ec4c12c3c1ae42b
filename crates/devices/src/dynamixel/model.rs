//! Control tables of the servos: which number stands where, and in which unit.
//!
//! Source: ROBOTIS e-Manual pages of the named models. Only what a pan-tilt head needs is listed.

use super::packet::Protocol;

/// A place in the control table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Register {
    /// First byte.
    pub address: u16,
    /// Bytes, little endian.
    pub size: u8,
}

const fn at(address: u16, size: u8) -> Register {
    Register { address, size }
}

/// A servo model.
#[derive(Debug, PartialEq)]
pub struct Model {
    /// Name as printed on it, and as written in configurations.
    pub name: &'static str,
    /// Model number at address 0.
    pub number: u16,
    /// Protocol it speaks.
    pub protocol: Protocol,
    /// Radians per position tick.
    pub tick: f64,
    /// Largest position in joint mode; the smallest is zero.
    pub last_tick: i32,
    /// Position at mid travel.
    pub centre_tick: i32,
    /// Radians per second of one unit of `profile_velocity`.
    pub speed_unit: f64,
    /// Ticks by which it may rest off its goal without a fault (friction, no integral gain).
    pub rest_ticks: i32,
    /// Addresses.
    pub registers: Registers,
}

/// Places in the control table.
#[derive(Debug, PartialEq)]
pub struct Registers {
    /// Delay before an answer, units of 2 us.
    pub return_delay: Register,
    /// 3 for position control; AX has none.
    pub operating_mode: Option<Register>,
    /// Whether writes are answered: 2 for always.
    pub status_return: Register,
    /// Smallest position allowed.
    pub lower_limit: Register,
    /// Largest position allowed.
    pub upper_limit: Register,
    /// 1 to hold and move.
    pub torque_enable: Register,
    /// Why the servo cut its torque; AX tells in the error byte.
    pub hardware_error: Option<Register>,
    /// Speed of moves, in `speed_unit`.
    pub profile_velocity: Register,
    /// Goal position, ticks.
    pub goal_position: Register,
    /// Present position, ticks.
    pub present_position: Register,
    /// 1 while it moves.
    pub moving: Register,
    /// Voltage, 0.1 V.
    pub voltage: Register,
    /// Temperature, degrees Celsius.
    pub temperature: Register,
}

const AX: Registers = Registers {
    return_delay: at(5, 1),
    operating_mode: None,
    status_return: at(16, 1),
    lower_limit: at(6, 2),
    upper_limit: at(8, 2),
    torque_enable: at(24, 1),
    hardware_error: None,
    profile_velocity: at(32, 2),
    goal_position: at(30, 2),
    present_position: at(36, 2),
    moving: at(46, 1),
    voltage: at(42, 1),
    temperature: at(43, 1),
};

const X: Registers = Registers {
    return_delay: at(9, 1),
    operating_mode: Some(at(11, 1)),
    status_return: at(68, 1),
    lower_limit: at(52, 4),
    upper_limit: at(48, 4),
    torque_enable: at(64, 1),
    hardware_error: Some(at(70, 1)),
    profile_velocity: at(112, 4),
    goal_position: at(116, 4),
    present_position: at(132, 4),
    moving: at(122, 1),
    voltage: at(144, 2),
    temperature: at(146, 1),
};

const RPM: f64 = std::f64::consts::TAU / 60.0;

const fn twelve_bit(name: &'static str, number: u16) -> Model {
    Model {
        name,
        number,
        protocol: Protocol::Two,
        tick: std::f64::consts::TAU / 4096.0,
        last_tick: 4095,
        centre_tick: 2048,
        speed_unit: 0.229 * RPM,
        // MX-28 rest 4 to 5 ticks off without integral gain.
        rest_ticks: 8,
        registers: X,
    }
}

/// All models that are known.
pub const MODELS: [Model; 5] = [
    Model {
        name: "AX-12A",
        number: 12,
        protocol: Protocol::One,
        tick: 300.0 / 1023.0 * std::f64::consts::PI / 180.0,
        last_tick: 1023,
        centre_tick: 512,
        speed_unit: 0.111 * RPM,
        rest_ticks: 4,
        registers: AX,
    },
    twelve_bit("MX-28", 30),
    twelve_bit("XL430-W250", 1060),
    twelve_bit("XM430-W350", 1020),
    twelve_bit("XM430-W210", 1030),
];

impl Model {
    /// The model of this name, upper or lower case.
    pub fn by_name(name: &str) -> Option<&'static Model> {
        MODELS.iter().find(|m| m.name.eq_ignore_ascii_case(name))
    }

    /// The model that answers with this number.
    pub fn by_number(number: u16) -> Option<&'static Model> {
        MODELS.iter().find(|m| m.number == number)
    }

    /// One contiguous stretch with goal, speed, present position and the moving flag, so that one
    /// read is a consistent snapshot.
    pub fn snapshot(&self) -> Register {
        let r = &self.registers;
        let parts = [r.goal_position, r.present_position, r.moving];
        let start = parts.iter().map(|p| p.address).min().unwrap_or(0);
        let end = parts.iter().map(|p| p.address + u16::from(p.size)).max().unwrap_or(0);
        Register { address: start, size: (end - start) as u8 }
    }
}

/// A little-endian number, sign extended when it has four bytes.
pub fn number(bytes: &[u8]) -> i32 {
    let mut wide = [0u8; 4];
    for (to, from) in wide.iter_mut().zip(bytes) {
        *to = *from;
    }
    i32::from_le_bytes(wide)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_units() {
        let ax = Model::by_name("ax-12a").unwrap();
        assert!((ax.tick.to_degrees() - 0.293).abs() < 1e-3);
        // 59 rpm at 12 V is 531 units of 0.111 rpm.
        assert!((ax.speed_unit * 531.0 - 59.0 * RPM).abs() < 0.01);
        assert_eq!(Model::by_number(1020).unwrap().name, "XM430-W350");
        assert_eq!(Model::by_name("XM430-W350").unwrap().snapshot(), at(116, 20));
        assert_eq!(ax.snapshot(), at(30, 17));
        assert_eq!(number(&[0xFE, 0xFF, 0xFF, 0xFF]), -2);
        assert_eq!(number(&[0x00, 0x02]), 512);
    }
}
