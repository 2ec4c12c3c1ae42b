//! What the owner of the board chooses, as a TOML file.
//!
//! ```toml
//! store = "/var/lib/vergence-tag/tag.flash"   # record, bonds and address
//! passkey = 123456                            # printed on the tag
//! controller = { linux = 0 }                  # hci0; or { serial = "/dev/ttyUSB0", baud = 1000000 }
//! lights = [{ led = "ir" }, { gpio = "/dev/gpiochip0", line = 17 }]
//! ```

use std::fmt;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use vergence_firmware::{Access, Config};

/// Settings of a tag. Relative paths are relative to the working directory.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// File of the tag's memory; made when it is not there.
    pub store: PathBuf,
    /// The Bluetooth controller.
    pub controller: ControllerAt,
    /// Infrared LEDs in the order of the record's landmarks.
    #[serde(default)]
    pub lights: Vec<Light>,
    /// Six digits that are printed on the tag. With them only robots that know them may write; without,
    /// any robot that pairs may.
    pub passkey: Option<u32>,
    /// Who may read the record.
    #[serde(default = "open")]
    pub record_access: AccessName,
    /// Who may command the lights.
    #[serde(default = "open")]
    pub command_access: AccessName,
    /// Name of a battery in `/sys/class/power_supply`, or a path; a board on the mains has none.
    pub battery: Option<PathBuf>,
    /// Watchdog device that resets the board when the tag hangs, usually `/dev/watchdog`.
    pub watchdog: Option<PathBuf>,
}

/// Where the controller is; exactly one of the three.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
pub enum ControllerAt {
    /// A controller of this computer: 0 is `hci0`.
    Linux {
        /// Its number.
        linux: u16,
    },
    /// H4 on a serial line.
    Serial {
        /// The device.
        serial: PathBuf,
        /// Its speed (baud).
        baud: u32,
    },
    /// H4 over TCP.
    Tcp {
        /// Host and port.
        tcp: String,
    },
}

/// An LED.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
pub enum Light {
    /// Of the kernel's LED class.
    Led {
        /// Name in `/sys/class/leds`, or a path.
        led: PathBuf,
    },
    /// On a line of a GPIO chip.
    Gpio {
        /// The chip's device.
        gpio: PathBuf,
        /// Number of the line.
        line: u32,
        /// The LED is on while the line is low.
        #[serde(default)]
        active_low: bool,
    },
}

impl fmt::Display for Light {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Light::Led { led } => write!(f, "{}", led.display()),
            Light::Gpio { gpio, line, .. } => write!(f, "{} line {line}", gpio.display()),
        }
    }
}

/// Names of the access levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AccessName {
    /// Everybody.
    Open,
    /// Robots that paired.
    Encrypted,
    /// Robots that paired with the passkey.
    Authenticated,
}

fn open() -> AccessName {
    AccessName::Open
}

impl From<AccessName> for Access {
    fn from(name: AccessName) -> Self {
        match name {
            AccessName::Open => Access::Open,
            AccessName::Encrypted => Access::Encrypted,
            AccessName::Authenticated => Access::Authenticated,
        }
    }
}

/// Why settings were refused.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The file could not be read.
    #[error("{path}: {source}")]
    Read {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, or an unknown, missing or wrong key; the text shows the line.
    #[error("{path}: {message}")]
    Parse {
        /// Which file.
        path: PathBuf,
        /// The parser's message.
        message: String,
    },
    /// A passkey has six digits.
    #[error("passkey {0} has more than six digits")]
    Passkey(u32),
    /// Without a passkey nobody could ever prove that he knows it.
    #[error("access \"authenticated\" needs a passkey")]
    NoPasskey,
}

impl Settings {
    /// Reads and checks a file.
    pub fn read(path: &Path) -> Result<Self, SettingsError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| SettingsError::Read { path: path.into(), source })?;
        let settings: Settings = toml::from_str(&text).map_err(|error| SettingsError::Parse {
            path: path.into(),
            message: error.to_string(),
        })?;
        settings.check()?;
        Ok(settings)
    }

    fn check(&self) -> Result<(), SettingsError> {
        match self.passkey {
            Some(passkey) if passkey > 999_999 => Err(SettingsError::Passkey(passkey)),
            None if [self.record_access, self.command_access]
                .contains(&AccessName::Authenticated) =>
            {
                Err(SettingsError::NoPasskey)
            }
            _ => Ok(()),
        }
    }

    /// As the firmware takes them.
    pub fn firmware(&self, address: [u8; 6]) -> Config<'static> {
        Config {
            address,
            model: "Linux board",
            passkey: self.passkey,
            record_access: self.record_access.into(),
            write_access: match self.passkey {
                Some(_) => Access::Authenticated,
                None => Access::Encrypted,
            },
            command_access: self.command_access.into(),
            ..Config::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Settings, String> {
        let settings: Settings = toml::from_str(text).map_err(|error| error.to_string())?;
        settings.check().map_err(|error| error.to_string())?;
        Ok(settings)
    }

    #[test]
    fn a_file_is_read() {
        let text = r#"
            store = "tag.flash"
            passkey = 123456
            command_access = "encrypted"
            controller = { serial = "/dev/ttyUSB0", baud = 1000000 }
            lights = [{ led = "ir" }, { gpio = "/dev/gpiochip0", line = 17, active_low = true }]
        "#;
        let settings = parse(text).unwrap();
        assert_eq!(settings.lights.len(), 2);
        let config = settings.firmware([1, 2, 3, 4, 5, 0xC0]);
        assert_eq!(
            (config.record_access, config.command_access),
            (Access::Open, Access::Encrypted)
        );
        assert_eq!((config.write_access, config.passkey), (Access::Authenticated, Some(123_456)));
        let plain = parse("store = \"a\"\ncontroller = { linux = 0 }").unwrap();
        assert_eq!(plain.controller, ControllerAt::Linux { linux: 0 });
        assert_eq!(plain.firmware([0; 6]).write_access, Access::Encrypted);
    }

    #[test]
    fn what_cannot_be_is_refused() {
        let refused = |text: &str, reason: &str| {
            let all = format!("store = \"a\"\ncontroller = {{ linux = 0 }}\n{text}");
            let error = parse(&all).unwrap_err();
            assert!(error.contains(reason), "{text}: {error}");
        };
        refused("passkey = 1234567", "six digits");
        refused("record_access = \"authenticated\"", "needs a passkey");
        refused("ligths = []", "ligths");
        refused("lights = [{ line = 3 }]", "Light");
        assert!(parse("store = \"a\"").unwrap_err().contains("controller"));
    }
}
