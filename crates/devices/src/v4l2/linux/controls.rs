//! Exposure and gain, taken out of the camera's own hands.
//!
//! What adapts by itself (exposure, gain, white balance, a frame rate that drops in the dark) makes a
//! steady scene blink and a blinking light steady. All of it is switched off where the device lets
//! us, and what the device lacks is told.

use std::time::Duration;

use rustix::io::{Errno, Result};

use super::sys::{ControlRange, Device};

const AUTO_WHITE_BALANCE: u32 = 0x0098_090C;
const AUTOGAIN: u32 = 0x0098_0912;
const GAIN: u32 = 0x0098_0913;
const EXPOSURE_AUTO: u32 = 0x009A_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009A_0902;
/// The frame rate may drop for longer exposures.
const EXPOSURE_AUTO_PRIORITY: u32 = 0x009A_0903;
/// `V4L2_EXPOSURE_MANUAL`.
const MANUAL: i32 = 1;
/// Unit of [`EXPOSURE_ABSOLUTE`].
const EXPOSURE_UNIT: f64 = 100e-6;

/// What of the picture's brightness is held constant.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Locked {
    /// Exposure time in force; `None` when the device does not tell.
    pub exposure: Option<Duration>,
    /// Gain in force, in the device's own units; `None` when the device does not tell.
    pub gain: Option<i32>,
    /// What could not be locked, in words.
    pub remarks: Vec<String>,
}

/// Why a camera cannot be locked as asked.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum LockError {
    /// The device cannot do it.
    Unsupported(String),
    /// The device failed.
    System(Errno),
}

impl From<Errno> for LockError {
    fn from(error: Errno) -> Self {
        LockError::System(error)
    }
}

/// A device's controls.
pub(super) trait Controls {
    fn range(&self, id: u32) -> Result<Option<ControlRange>>;
    fn get(&self, id: u32) -> Result<i32>;
    fn set(&self, id: u32, value: i32) -> Result<()>;
}

impl Controls for Device {
    fn range(&self, id: u32) -> Result<Option<ControlRange>> {
        self.control_range(id)
    }

    fn get(&self, id: u32) -> Result<i32> {
        self.control(id)
    }

    fn set(&self, id: u32, value: i32) -> Result<()> {
        self.set_control(id, value)
    }
}

/// Locks exposure (s) and gain (device units) to what is asked, or to what they are.
pub(super) fn lock(
    controls: &impl Controls,
    exposure: Option<f64>,
    gain: Option<i32>,
) -> std::result::Result<Locked, LockError> {
    let mut locked = Locked::default();
    // The modes first: while automatic, devices refuse or ignore the values.
    for (id, name, fixed) in [
        (EXPOSURE_AUTO, "automatic exposure", MANUAL),
        (EXPOSURE_AUTO_PRIORITY, "frame rate that depends on light", 0),
        (AUTOGAIN, "automatic gain", 0),
        (AUTO_WHITE_BALANCE, "automatic white balance", 0),
    ] {
        if controls.range(id)?.is_none() {
            continue;
        }
        match controls.set(id, fixed) {
            Ok(()) => {}
            Err(gone @ (Errno::NODEV | Errno::NXIO)) => return Err(gone.into()),
            Err(error) => locked.remarks.push(format!("{name} cannot be switched off: {error}")),
        }
    }
    let units = match exposure {
        Some(seconds) if !(seconds.is_finite() && seconds > 0.0 && seconds < 10.0) => {
            let what = format!("exposure {seconds} s is not between 0 and 10 s");
            return Err(LockError::Unsupported(what));
        }
        asked => asked.map(|seconds| (seconds / EXPOSURE_UNIT).round() as i32),
    };
    let in_force =
        hold(controls, EXPOSURE_ABSOLUTE, ("exposure", " x 100 us"), units, &mut locked)?;
    locked.exposure = in_force
        .and_then(|units| Duration::try_from_secs_f64(f64::from(units) * EXPOSURE_UNIT).ok());
    locked.gain = hold(controls, GAIN, ("gain", ""), gain, &mut locked)?;
    Ok(locked)
}

/// Sets a control when asked; its value in force.
fn hold(
    controls: &impl Controls,
    id: u32,
    (name, unit): (&str, &str),
    asked: Option<i32>,
    locked: &mut Locked,
) -> std::result::Result<Option<i32>, LockError> {
    let Some(range) = controls.range(id)? else {
        return match asked {
            Some(_) => Err(LockError::Unsupported(format!("the device has no {name} control"))),
            None => {
                locked.remarks.push(format!("the device has no {name} control"));
                Ok(None)
            }
        };
    };
    if let Some(value) = asked {
        let ControlRange { minimum, maximum, .. } = range;
        if !(minimum..=maximum).contains(&value) {
            return Err(LockError::Unsupported(format!(
                "{name} {value}{unit} is not between {minimum} and {maximum}"
            )));
        }
        controls.set(id, value)?;
    }
    // Devices round to what they can do.
    Ok(Some(controls.get(id)?))
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::collections::BTreeMap;

    use super::*;

    /// Controls as a USB camera has them: values may not be set while automatic.
    struct Fake(RefCell<BTreeMap<u32, (ControlRange, i32)>>);

    fn fake(controls: &[(u32, i32, i32, i32)]) -> Fake {
        let entry = |&(id, minimum, maximum, value): &(u32, i32, i32, i32)| {
            (id, (ControlRange { minimum, maximum, step: 1 }, value))
        };
        Fake(RefCell::new(controls.iter().map(entry).collect()))
    }

    impl Controls for Fake {
        fn range(&self, id: u32) -> Result<Option<ControlRange>> {
            Ok(self.0.borrow().get(&id).map(|c| c.0))
        }

        fn get(&self, id: u32) -> Result<i32> {
            self.0.borrow().get(&id).map(|c| c.1).ok_or(Errno::INVAL)
        }

        fn set(&self, id: u32, value: i32) -> Result<()> {
            let automatic = |id, manual| self.get(id).is_ok_and(|mode| mode != manual);
            match id {
                EXPOSURE_ABSOLUTE if automatic(EXPOSURE_AUTO, MANUAL) => return Err(Errno::ACCESS),
                GAIN if automatic(AUTOGAIN, 0) => return Err(Errno::ACCESS),
                _ => {}
            }
            let mut controls = self.0.borrow_mut();
            let (range, now) = controls.get_mut(&id).ok_or(Errno::INVAL)?;
            if !(range.minimum..=range.maximum).contains(&value) {
                return Err(Errno::RANGE);
            }
            *now = value;
            Ok(())
        }
    }

    fn usb_camera() -> Fake {
        fake(&[
            (AUTO_WHITE_BALANCE, 0, 1, 1),
            (AUTOGAIN, 0, 1, 1),
            (GAIN, 0, 255, 64),
            (EXPOSURE_AUTO, 0, 3, 3),
            (EXPOSURE_ABSOLUTE, 3, 2047, 250),
            (EXPOSURE_AUTO_PRIORITY, 0, 1, 1),
        ])
    }

    #[test]
    fn everything_automatic_is_switched_off() {
        let camera = usb_camera();
        let locked = lock(&camera, Some(0.004), Some(10)).unwrap();
        assert_eq!(locked.exposure, Some(Duration::from_millis(4)));
        assert_eq!((locked.gain, &locked.remarks[..]), (Some(10), &[][..]));
        for (id, value) in [(EXPOSURE_AUTO, MANUAL), (EXPOSURE_AUTO_PRIORITY, 0), (AUTOGAIN, 0)] {
            assert_eq!(camera.get(id), Ok(value));
        }
        // Nothing asked: held where it was.
        let locked = lock(&usb_camera(), None, None).unwrap();
        assert_eq!((locked.exposure, locked.gain), (Some(Duration::from_millis(25)), Some(64)));
    }

    #[test]
    fn what_the_device_lacks_is_told_and_refused_when_asked() {
        let plain = fake(&[(GAIN, 0, 255, 64)]);
        let locked = lock(&plain, None, None).unwrap();
        assert_eq!((locked.exposure, locked.gain), (None, Some(64)));
        assert!(locked.remarks[0].contains("no exposure"), "{locked:?}");
        let error = lock(&plain, Some(0.01), None).unwrap_err();
        assert!(matches!(&error, LockError::Unsupported(what) if what.contains("no exposure")));
        for (exposure, gain) in [(Some(0.3), None), (Some(f64::NAN), None), (None, Some(256))] {
            let error = lock(&usb_camera(), exposure, gain).unwrap_err();
            assert!(matches!(error, LockError::Unsupported(_)), "{error:?}");
        }
    }

    #[test]
    fn a_mode_that_cannot_be_switched_off_is_a_remark() {
        // Aperture priority (3) only.
        let camera = fake(&[(EXPOSURE_AUTO, 3, 3, 3), (EXPOSURE_ABSOLUTE, 3, 2047, 250)]);
        let locked = lock(&camera, None, None).unwrap();
        assert!(locked.remarks[0].starts_with("automatic exposure cannot"), "{locked:?}");
    }
}
