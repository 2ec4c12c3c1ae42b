//! Does with the tags of the example `tag_server` what a robot does, and checks the answers.
//!
//! ```text
//! bluez_probe bluez     # through BlueZ
//! bluez_probe hci0      # our own host on the kernel's user channel; bluetoothd must not run
//! ```
//! `scripts/qemu_bluez.sh` runs it on a real kernel with a real daemon in a virtual machine. One line
//! a check; the exit status is 0 when all passed.

use std::error::Error;

use vergence_link::{BluezLink, HciLink, LinkConfig, TagRadio};

#[path = "../tests/support/conformance.rs"]
mod conformance;

fn main() -> Result<(), Box<dyn Error>> {
    let mut link: Box<dyn TagRadio> = match std::env::args().nth(1).as_deref() {
        Some("bluez") => Box::new(BluezLink::open(None)?),
        Some("hci0") => Box::new(HciLink::linux(0, LinkConfig::default())?),
        _ => return Err("bluez_probe bluez|hci0".into()),
    };
    let failed = conformance::conform(&mut *link);
    drop(link);
    std::process::exit(i32::from(failed > 0));
}
