//! Emulated servos on a pseudo-terminal for any Dynamixel program to talk to.
//!
//! Two AX-12A (IDs 1, 2, protocol 1.0) and two XL430-W250 (IDs 11, 12, protocol 2.0) on one bus.
//! Prints the path of the pseudo-terminal and serves until its standard input closes.
//! `scripts/check_dynamixel_sdk.py` runs ROBOTIS' own SDK against it.

use std::io::Read;

use vergence_devices::dynamixel::{Model, Motor, Trouble, VirtualBus, VirtualServo};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut servos = Vec::new();
    for (name, ids) in [("AX-12A", [1, 2]), ("XL430-W250", [11, 12])] {
        let model = Model::by_name(name).ok_or("unknown model")?;
        servos.extend(ids.map(|id| VirtualServo::new(id, model, Motor::new(0.0))));
    }
    let (_bus, path) = VirtualBus::on_pty(servos, Trouble::default())?;
    println!("{}", path.display());
    std::io::stdin().read_to_end(&mut Vec::new())?;
    Ok(())
}
