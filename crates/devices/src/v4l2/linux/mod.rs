//! The camera on a Linux kernel: opening, and reading what the stream's thread brings.

mod controls;
mod huffman;
mod pixels;
mod stream;
mod sys;

use std::sync::{Arc, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use vergence_imaging::Frame;

use super::{PixelFormat, V4l2Config};
use crate::traits::{Camera, Clock, DeviceError};
use controls::LockError;
use pixels::Layout;
use stream::{ClockPair, End, Numbering, Reader, Shared};
use sys::{Device, PixelLayout};

pub use controls::Locked;
pub use stream::Counts;

/// Buffers that the kernel fills in turn.
const BUFFERS: u32 = 6;
/// Frames a second that may be asked for.
const RATES: std::ops::RangeInclusive<f64> = 0.1..=10_000.0;

/// A camera of the Linux kernel.
pub struct V4l2Camera {
    name: String,
    layout: Layout,
    rate: Option<f64>,
    locked: Locked,
    exposure: Duration,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl V4l2Camera {
    /// Opens a camera that delivers pictures of this size and starts its stream.
    pub fn open(
        config: &V4l2Config,
        size: (usize, usize),
        clock: Arc<dyn Clock>,
    ) -> Result<Self, DeviceError> {
        let path = &config.device;
        let name = path.display().to_string();
        let device = Device::open(path).map_err(|e| match e.raw_os_error() {
            Some(code) => system(&name, Errno::from_raw_os_error(code)),
            None => DeviceError::Disconnected { device: name.clone(), reason: e.to_string() },
        })?;
        let setup = Setup { device: &device, name: &name };
        setup.check_kind()?;
        let layout = setup.choose_layout(config.format, size)?;
        let rate = setup.choose_rate(config.rate)?;
        let locked =
            controls::lock(&device, config.exposure, config.gain).map_err(|e| match e {
                LockError::Unsupported(what) => setup.unsupported(what),
                LockError::System(error) => system(&name, error),
            })?;
        let exposure = locked.exposure.unwrap_or_default();
        let buffers = device.map_buffers(BUFFERS).map_err(|e| system(&name, e))?;
        device.start().map_err(|e| system(&name, e))?;
        let shared = Arc::new(Shared::default());
        let clocks = ClockPair::read(&*clock);
        let reader = Reader {
            device,
            buffers,
            shared: shared.clone(),
            clock,
            clocks,
            exposure,
            numbering: Numbering::default(),
            restarts: 0,
        };
        let thread = std::thread::Builder::new()
            .name("camera".into())
            .spawn(move || reader.run())
            .map_err(|e| DeviceError::Fault { device: name.clone(), fault: e.to_string() })?;
        Ok(V4l2Camera { name, layout, rate, locked, exposure, shared, thread: Some(thread) })
    }

    /// The pixel format in force.
    pub fn format(&self) -> PixelFormat {
        self.layout.format
    }

    /// Bytes from one row to the next in the device's buffers; zero for JPEG.
    pub fn stride(&self) -> usize {
        self.layout.stride
    }

    /// Frames a second that the device promised, when it was asked for a rate.
    pub fn rate(&self) -> Option<f64> {
        self.rate
    }

    /// Exposure and gain, and what could not be locked.
    pub fn locked(&self) -> &Locked {
        &self.locked
    }

    /// What became of the frames so far.
    pub fn counts(&self) -> Counts {
        self.shared.lock().counts
    }
}

impl Camera for V4l2Camera {
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let deadline = Instant::now() + timeout;
        let mut damage = None;
        let mut state = self.shared.lock();
        loop {
            if let Some(picture) = state.pictures.pop_front() {
                drop(state);
                match self.layout.grey(&picture.bytes) {
                    Ok(image) => {
                        return Ok(Frame {
                            image,
                            stamp: picture.stamp,
                            exposure: self.exposure,
                            row_time: None,
                            sequence: picture.sequence,
                        });
                    }
                    Err(what) => damage = Some(what),
                }
                state = self.shared.lock();
                state.counts.good -= 1;
                state.counts.damaged += 1;
                continue;
            }
            let device = self.name.clone();
            match state.end.clone() {
                Some(End::Unplugged(reason)) => {
                    return Err(DeviceError::Disconnected { device, reason });
                }
                Some(End::Broken(fault)) => return Err(DeviceError::Fault { device, fault }),
                None => {}
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(match damage {
                    Some(what) => {
                        let fault = format!("nothing readable within {timeout:?}, last: {what}");
                        DeviceError::Fault { device, fault }
                    }
                    None => DeviceError::Timeout { device, timeout },
                });
            }
            let waited = self.shared.news.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Drop for V4l2Camera {
    fn drop(&mut self) {
        self.shared.lock().stop = true;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A failure of the system as callers of the device traits see it.
fn system(device: &str, error: Errno) -> DeviceError {
    let device = device.to_owned();
    match error {
        Errno::NODEV | Errno::NXIO | Errno::NOENT => {
            DeviceError::Disconnected { device, reason: error.to_string() }
        }
        Errno::BUSY => DeviceError::Fault { device, fault: "in use by another program".into() },
        _ => DeviceError::Fault { device, fault: error.to_string() },
    }
}

/// A device on its way to a stream.
struct Setup<'a> {
    device: &'a Device,
    name: &'a str,
}

impl Setup<'_> {
    fn unsupported(&self, what: String) -> DeviceError {
        DeviceError::Unsupported { device: self.name.into(), what }
    }

    fn check_kind(&self) -> Result<(), DeviceError> {
        let identity = match self.device.identity() {
            Ok(identity) => identity,
            Err(Errno::NOTTY | Errno::INVAL) => {
                return Err(self.unsupported("not a video device".into()));
            }
            Err(error) => return Err(system(self.name, error)),
        };
        let can = |ability| identity.capabilities & ability != 0;
        let lack = if can(sys::CAP_CAPTURE) && can(sys::CAP_STREAMING) {
            return Ok(());
        } else if can(sys::CAP_CAPTURE_MULTIPLANAR) {
            "delivers its pictures in several planes, which this driver does not read"
        } else {
            "delivers no video"
        };
        Err(self.unsupported(format!("{} {lack}", identity.card)))
    }

    /// Brings the device to the format and size, unless it is there already: what else was set up
    /// before (rows with padding, a crop) then stays.
    fn choose_layout(
        &self,
        asked: Option<PixelFormat>,
        (width, height): (usize, usize),
    ) -> Result<Layout, DeviceError> {
        let offered = self.device.formats().map_err(|e| system(self.name, e))?;
        let choice = PixelFormat::ALL.into_iter().find(|format| {
            asked.is_none_or(|asked| asked == *format) && offered.contains(&format.code())
        });
        let Some(format) = choice else {
            let names: Vec<String> = offered.iter().map(|code| four_characters(*code)).collect();
            return Err(self.unsupported(format!(
                "offers the formats {}, not {}",
                names.join(", "),
                asked.map_or("one that is read".into(), |format| four_characters(format.code()))
            )));
        };
        let fits = |layout: &PixelLayout| {
            layout.pixel_format == format.code()
                && (layout.width as usize, layout.height as usize) == (width, height)
        };
        let mut layout = self.device.layout().map_err(|e| system(self.name, e))?;
        if !fits(&layout) {
            let pixels = |count: usize| count.try_into().unwrap_or(u32::MAX);
            let wanted = PixelLayout::wanted(pixels(width), pixels(height), format.code());
            layout = self.device.set_layout(wanted).map_err(|e| system(self.name, e))?;
        }
        if !fits(&layout) {
            return Err(self.unsupported(format!(
                "delivers {} of {}x{}, the configuration says {} of {width}x{height}",
                four_characters(layout.pixel_format),
                layout.width,
                layout.height,
                four_characters(format.code()),
            )));
        }
        if layout.field != sys::FIELD_NONE {
            return Err(self.unsupported("delivers interlaced pictures".into()));
        }
        let stride = match format {
            PixelFormat::Mjpeg => 0,
            _ => layout.bytes_per_line as usize,
        };
        Layout::new(format, width, height, stride)
            .ok_or_else(|| self.unsupported(format!("tells rows of {stride} bytes")))
    }

    /// Brings the device to the rate (frames a second), as near as it can.
    fn choose_rate(&self, asked: Option<f64>) -> Result<Option<f64>, DeviceError> {
        let Some(rate) = asked else { return Ok(None) };
        if !RATES.contains(&rate) {
            return Err(self.unsupported(format!("a rate of {rate} frames a second")));
        }
        // Thousandths, as 29.97 is 30000/1001 in the video world.
        let time = [1000, (rate * 1000.0).round() as u32];
        let [numerator, denominator] = match self.device.set_time_per_frame(time) {
            Ok(time) => time,
            Err(Errno::INVAL | Errno::NOTTY) => {
                return Err(self.unsupported("its frame rate cannot be set".into()));
            }
            Err(error) => return Err(system(self.name, error)),
        };
        let got = f64::from(denominator) / f64::from(numerator.max(1));
        if (got / rate - 1.0).abs() > 0.02 {
            return Err(self.unsupported(format!("delivers {got:.3} frames a second, not {rate}")));
        }
        Ok(Some(got))
    }
}

/// A format's code as text.
fn four_characters(code: u32) -> String {
    String::from_utf8_lossy(&code.to_le_bytes()).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::SystemClock;

    fn open(device: &str) -> Result<V4l2Camera, DeviceError> {
        let config = V4l2Config {
            device: device.into(),
            format: None,
            exposure: None,
            gain: None,
            rate: None,
        };
        V4l2Camera::open(&config, (640, 480), Arc::new(SystemClock::start()))
    }

    #[test]
    fn what_is_no_camera_is_told() {
        let absent = open("/dev/no-such-video").err();
        assert!(matches!(absent, Some(DeviceError::Disconnected { .. })), "{absent:?}");
        let Some(DeviceError::Unsupported { what, .. }) = open("/dev/null").err() else {
            panic!("opened")
        };
        assert_eq!(what, "not a video device");
    }
}
