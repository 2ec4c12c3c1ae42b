//! Ctrl-C and SIGTERM: the run ends by its own way out, so that lights go out and servos let go.
//!
//! A signal raises a flag that every device asks before it does anything: the next call fails, and the
//! command ends as with any device that fails. A second signal ends the program on the spot.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;
use vergence_devices::{Camera, DeviceError, JointReading, PanTilt};
use vergence_imaging::Frame;

/// Exit status of a program that a second signal ends (128 + SIGINT).
const KILLED: i32 = 130;

/// Raised once the user wants the program to end.
#[derive(Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Listens to the signals from now on.
    pub fn listen() -> std::io::Result<Self> {
        let raised = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM] {
            // In this order: the shutdown looks whether an earlier signal has raised the flag.
            flag::register_conditional_shutdown(signal, KILLED, raised.clone())?;
            flag::register(signal, raised.clone())?;
        }
        Ok(Interrupt(raised))
    }

    /// A signal has come.
    pub fn raised(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    fn check(&self, device: &str) -> Result<(), DeviceError> {
        match self.raised() {
            false => Ok(()),
            true => Err(DeviceError::Fault {
                device: device.into(),
                fault: "the program was told to end".into(),
            }),
        }
    }
}

/// A device that works until the interrupt.
pub struct Until<D> {
    /// Who ends it.
    pub interrupt: Interrupt,
    /// The device.
    pub device: D,
}

impl<C: Camera> Camera for Until<C> {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        self.interrupt.check("camera")?;
        self.device.next_frame(timeout)
    }
}

impl<P: PanTilt> PanTilt for Until<P> {
    fn move_to(&mut self, pan: f64, tilt: f64) -> Result<(), DeviceError> {
        self.interrupt.check("servos")?;
        self.device.move_to(pan, tilt)
    }

    fn read(&mut self) -> Result<JointReading, DeviceError> {
        self.interrupt.check("servos")?;
        self.device.read()
    }

    fn resolution(&self) -> f64 {
        self.device.resolution()
    }

    fn backlash(&self) -> f64 {
        self.device.backlash()
    }

    fn speed(&self) -> Option<f64> {
        self.device.speed()
    }
}
