//! Opens the tag radio alone: no camera or servo is needed to talk to tags.

use std::path::{Path, PathBuf};

use vergence_devices::clock::SystemClock;
use vergence_devices::config::RadioConfig;
use vergence_devices::{Clock, Config};
use vergence_link::{Bond, HciLink, LinkConfig, TagRadio};
use vergence_sim::Workcell;
use vergence_tag::signature::TrustedKeys;

use crate::bonds;
use crate::drivers::BLUEZ;
use crate::failure::Failure;
use crate::signing;

/// An opened radio.
pub struct Radio {
    /// The radio.
    pub link: Box<dyn TagRadio>,
    /// The time that it runs on.
    pub clock: Box<dyn Clock>,
    /// Whose signatures on records count.
    pub trusted: TrustedKeys,
    /// Where its bonds are kept.
    bonds: Option<PathBuf>,
}

/// Opens the radio that the configuration names, with the bonds of earlier runs.
pub fn open(config: &Config, folder: &Path) -> Result<Radio, Failure> {
    let radio = &config.radio;
    let link: Box<dyn TagRadio> = match radio.driver.as_str() {
        BLUEZ => bluez(radio.adapter.as_deref())?,
        _ => Box::new(hci(radio)?),
    };
    let trusted = signing::trusted(config, folder)?;
    let bonds = radio.bonds.as_ref().map(|file| folder.join(file));
    let mut radio = Radio { link, clock: Box::new(SystemClock::start()), trusted, bonds };
    radio.load()?;
    Ok(radio)
}

/// Opens the controller that the driver `hci` names.
fn hci(radio: &RadioConfig) -> Result<HciLink, Failure> {
    let config = LinkConfig::default();
    let link = match (&radio.tcp, &radio.device, radio.linux) {
        (Some(address), None, None) => HciLink::tcp(address, config),
        (None, Some(path), None) => HciLink::serial(path, radio.baud, config),
        (None, None, Some(controller)) => HciLink::linux(controller, config),
        _ => {
            return Err(Failure::misuse(
                "the radio driver \"hci\" needs one controller",
                "write tcp = \"host:port\", device = \"/dev/ttyACM0\" or linux = 0 into [radio]",
            ));
        }
    };
    link.map_err(|error| Failure::failed(error, "is the controller there and free?"))
}

#[cfg(feature = "bluez")]
fn bluez(adapter: Option<&str>) -> Result<Box<dyn TagRadio>, Failure> {
    let link = vergence_link::BluezLink::open(adapter);
    Ok(Box::new(link.map_err(|error| Failure::failed(error, "does bluetoothd run?"))?))
}

#[cfg(not(feature = "bluez"))]
fn bluez(_: Option<&str>) -> Result<Box<dyn TagRadio>, Failure> {
    Err(Failure::misuse(
        "this program was built without the radio driver \"bluez\"",
        "build it with --features bluez, or use the driver \"hci\"",
    ))
}

impl Radio {
    /// The radio of a simulated workcell, whose tags and bonds live as long as the program.
    pub fn simulated(workcell: &Workcell, trusted: TrustedKeys) -> Self {
        Radio { link: Box::new(workcell.radio()), clock: workcell.clock(), trusted, bonds: None }
    }

    /// Takes up the bonds of earlier runs.
    fn load(&mut self) -> Result<(), Failure> {
        let Some(path) = &self.bonds else { return Ok(()) };
        let kept = bonds::read(path).map_err(|error| unusable(path, error))?;
        if kept.torn {
            eprintln!("warning: {}: the last key is cut short and left out", path.display());
        }
        for bond in kept.bonds {
            self.link.add_bond(bond).map_err(|error| unusable(path, error))?;
        }
        Ok(())
    }

    /// Keeps a bond for later runs; false when no file is configured.
    pub fn keep(&self, bond: &Bond) -> Result<bool, Failure> {
        let Some(path) = &self.bonds else { return Ok(false) };
        bonds::keep(path, bond).map_err(|error| unusable(path, error))?;
        Ok(true)
    }
}

fn unusable(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::failed(
        format!("{}: {error}", path.display()),
        "the file of the key `bonds` must be writable; remove it to pair with all tags anew",
    )
}
