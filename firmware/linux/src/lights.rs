//! Infrared LEDs of a Linux board: entries of the kernel's LED class, or lines of a GPIO chip.
//!
//! The LED class drives brightness as far as its driver can; a GPIO line is on at any level above 0.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use gpiocdev::Request;
use gpiocdev::line::Value;
use vergence_firmware::Lights;

use crate::settings::Light;

/// Where the kernel shows its LEDs.
const LED_CLASS: &str = "/sys/class/leds";

enum Output {
    Led { brightness: PathBuf, full: u64 },
    Gpio { request: Request, line: u32 },
}

impl Output {
    fn open(light: &Light) -> io::Result<Self> {
        match light {
            Light::Led { led } => {
                // A name of the class; a path is taken as it is.
                let folder = Path::new(LED_CLASS).join(led);
                let full = fs::read_to_string(folder.join("max_brightness"))?;
                let full = full.trim().parse().map_err(io::Error::other)?;
                let trigger = folder.join("trigger");
                if trigger.exists() {
                    // Else the kernel may switch the LED as it likes.
                    fs::write(trigger, "none")?;
                }
                Ok(Output::Led { brightness: folder.join("brightness"), full })
            }
            Light::Gpio { gpio, line, active_low } => {
                let mut builder = Request::builder();
                builder.on_chip(gpio).with_consumer("vergence-tagd").with_line(*line);
                if *active_low {
                    builder.as_active_low();
                }
                let request = builder.as_output(Value::Inactive).request();
                Ok(Output::Gpio { request: request.map_err(io::Error::other)?, line: *line })
            }
        }
    }

    /// 0 dark, 255 full.
    fn set(&self, level: u8) -> io::Result<()> {
        match self {
            Output::Led { brightness, full } => {
                fs::write(brightness, (u64::from(level) * full).div_ceil(255).to_string())
            }
            Output::Gpio { request, line } => {
                let value = if level > 0 { Value::Active } else { Value::Inactive };
                request.set_value(*line, value).map(drop).map_err(io::Error::other)
            }
        }
    }
}

/// The board's lights. Clones drive the same LEDs.
#[derive(Clone)]
pub struct BoardLights(Arc<Mutex<Vec<Output>>>);

impl BoardLights {
    /// Opens all of them, dark.
    pub fn open(lights: &[Light]) -> io::Result<Self> {
        let named = |light: &Light, error: io::Error| {
            io::Error::new(error.kind(), format!("light {light}: {error}"))
        };
        let mut outputs = Vec::new();
        for light in lights {
            let output = Output::open(light).map_err(|error| named(light, error))?;
            output.set(0).map_err(|error| named(light, error))?;
            outputs.push(output);
        }
        Ok(BoardLights(Arc::new(Mutex::new(outputs))))
    }

    /// Switches all of them off for good, for the end of the process.
    pub fn darken(&self) {
        let outputs = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        for output in &outputs {
            // Nothing more can be done for one that fails.
            let _ = output.set(0);
        }
    }
}

impl Lights for BoardLights {
    fn count(&self) -> u8 {
        let outputs = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        u8::try_from(outputs.len()).unwrap_or(u8::MAX)
    }

    fn set(&mut self, led: u8, level: u8) {
        let outputs = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(output) = outputs.get(usize::from(led)) {
            // An LED that cannot be driven is dark, and nothing here can repair it.
            let _ = output.set(level);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_scaled_to_the_led() {
        let dir = std::env::temp_dir().join(format!("leds-{}", std::process::id()));
        fs::create_dir_all(&dir).unwrap();
        for (file, text) in [("max_brightness", "15\n"), ("brightness", "7\n")] {
            fs::write(dir.join(file), text).unwrap();
        }
        fs::write(dir.join("trigger"), "heartbeat").unwrap();
        let led = Light::Led { led: dir.clone() };
        let mut lights = BoardLights::open(&[led]).unwrap();
        let shown = || fs::read_to_string(dir.join("brightness")).unwrap();
        assert_eq!((shown(), lights.count()), ("0".into(), 1));
        assert_eq!(fs::read_to_string(dir.join("trigger")).unwrap(), "none");
        for (level, expected) in [(255, "15"), (128, "8"), (1, "1"), (0, "0")] {
            lights.set(0, level);
            assert_eq!(shown(), expected);
        }
        lights.set(0, 255);
        lights.set(1, 9);
        lights.darken();
        assert_eq!(shown(), "0");
    }

    #[test]
    fn a_light_that_is_not_there_is_named() {
        let led = Light::Led { led: "no-such-led".into() };
        let error = BoardLights::open(&[led]).err().unwrap().to_string();
        assert!(error.contains("no-such-led"), "{error}");
        let line = Light::Gpio { gpio: "/dev/no-such-chip".into(), line: 17, active_low: false };
        let error = BoardLights::open(&[line]).err().unwrap().to_string();
        assert!(error.contains("no-such-chip") && error.contains("17"), "{error}");
    }
}
