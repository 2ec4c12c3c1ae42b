//! Checks the driver `v4l2` against the kernel's test camera (vivid), whose faults can be ordered.
//!
//! ```text
//! v4l2_probe /dev/video0
//! ```
//! `scripts/qemu_v4l2.sh` runs it on a real kernel in a virtual machine. One line a check; the exit
//! status is 0 when all passed. Faults are ordered, and pictures compared, with `v4l2-ctl`.

use std::error::Error;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use vergence_devices::clock::SystemClock;
use vergence_devices::v4l2::{Counts, PixelFormat, V4l2Camera, V4l2Config};
use vergence_devices::{Camera, Clock, DeviceError};
use vergence_imaging::{Frame, Image};

type Outcome = Result<String, Box<dyn Error>>;
type Check = fn(&Probe) -> Outcome;

const SIZE: (usize, usize) = (640, 360);
/// An emulated processor is slow.
const SOON: Duration = Duration::from_secs(5);

struct Probe {
    device: String,
    clock: SystemClock,
}

fn main() {
    let device = std::env::args().nth(1).unwrap_or("/dev/video0".into());
    let probe = Probe { device, clock: SystemClock::start() };
    let checks: [(&str, Check); 15] = [
        ("grey", |p| p.pictures(PixelFormat::Grey)),
        ("yuyv", |p| p.pictures(PixelFormat::Yuyv)),
        ("nv12", |p| p.pictures(PixelFormat::Nv12)),
        ("stamps of the frame's end", Probe::end_stamps),
        ("rows with padding", Probe::padding),
        ("what it does not offer", Probe::not_offered),
        ("rate", Probe::rate),
        ("gain locked, exposure missing", Probe::locks),
        ("second reader", Probe::second_reader),
        ("slow reader", Probe::slow_reader),
        ("lost frames", Probe::lost),
        ("damaged frames", Probe::damaged),
        ("no frames", Probe::silent),
        ("broken stream", Probe::broken),
        ("unplugged, plugged in", Probe::unplugged),
    ];
    let mut failed = 0;
    for (name, check) in checks {
        match check(&probe) {
            Ok(figures) => println!("ok    {name}: {figures}"),
            Err(error) => {
                failed += 1;
                println!("FAIL  {name}: {error}");
            }
        }
    }
    println!("{} of {} checks passed", checks.len() - failed, checks.len());
    std::process::exit(i32::from(failed > 0));
}

fn ensure(good: bool, what: impl FnOnce() -> String) -> Result<(), Box<dyn Error>> {
    if good { Ok(()) } else { Err(what().into()) }
}

impl Probe {
    fn config(&self, format: PixelFormat) -> V4l2Config {
        V4l2Config {
            device: self.device.clone().into(),
            format: Some(format),
            exposure: None,
            gain: None,
            rate: None,
        }
    }

    fn open(&self, config: &V4l2Config) -> Result<V4l2Camera, DeviceError> {
        V4l2Camera::open(config, SIZE, Arc::new(self.clock))
    }

    fn grey(&self) -> Result<V4l2Camera, DeviceError> {
        self.open(&self.config(PixelFormat::Grey))
    }

    /// The error of opening, which must not succeed.
    fn refusal(&self, config: &V4l2Config) -> Result<DeviceError, Box<dyn Error>> {
        self.open(config).err().ok_or_else(|| "opened all the same".into())
    }

    /// Runs the kernel developers' own tool.
    fn v4l2_ctl(&self, arguments: &[&str]) -> Outcome {
        let output =
            Command::new("v4l2-ctl").arg("-d").arg(&self.device).args(arguments).output()?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        ensure(output.status.success(), || format!("v4l2-ctl {arguments:?}: {text}{error}"))?;
        Ok(text)
    }

    fn set(&self, control: &str) -> Result<(), Box<dyn Error>> {
        self.v4l2_ctl(&["--set-ctrl", control]).map(drop)
    }

    /// Numbers, stamps and every pixel of a run of frames.
    fn pictures(&self, format: PixelFormat) -> Outcome {
        let mut camera = self.open(&V4l2Config { rate: Some(30.0), ..self.config(format) })?;
        ensure(camera.format() == format, || format!("format {:?}", camera.format()))?;
        let mut frames: Vec<Frame> = Vec::new();
        let mut latency = Duration::ZERO;
        for _ in 0..30 {
            let frame = camera.next_frame(SOON)?;
            let now = self.clock.now();
            ensure(frame.stamp <= now, || format!("a stamp of {:?} at {now:?}", frame.stamp))?;
            latency = latency.max(now - frame.stamp);
            frames.push(frame);
        }
        let counts = camera.counts();
        drop(camera);
        let mut periods: Vec<Duration> = Vec::new();
        for pair in frames.windows(2) {
            let step = pair[1].sequence - pair[0].sequence;
            ensure(pair[1].stamp > pair[0].stamp, || "stamps do not grow".into())?;
            periods.push((pair[1].stamp - pair[0].stamp) / step as u32);
        }
        periods.sort();
        let gaps = frames[29].sequence - frames[0].sequence - 29;
        ensure(counts.damaged == 0 && gaps <= counts.lost + counts.skipped, || {
            format!("{gaps} frames missing, counted {counts:?}")
        })?;
        self.compare(&frames[29].image, format)?;
        Ok(format!(
            "30 frames, numbers {} to {}, {gaps} missing and counted, period {:.1} ms (median), \
             {:.1} ms old at most, every pixel as v4l2-ctl reads it",
            frames[0].sequence,
            frames[29].sequence,
            periods[14].as_secs_f64() * 1e3,
            latency.as_secs_f64() * 1e3,
        ))
    }

    /// The still test picture as another program reads it from the same device.
    fn compare(&self, image: &Image<u8>, format: PixelFormat) -> Result<(), Box<dyn Error>> {
        let file = std::env::temp_dir().join("v4l2_probe.raw");
        let to = format!("--stream-to={}", file.display());
        self.v4l2_ctl(&["--stream-mmap", "--stream-count=1", &to])?;
        let raw = std::fs::read(&file)?;
        let step = if format == PixelFormat::Yuyv { 2 } else { 1 };
        let luma: Vec<u8> = raw.iter().step_by(step).take(SIZE.0 * SIZE.1).copied().collect();
        let (least, most) = (luma.iter().min(), luma.iter().max());
        ensure(least < most, || "the test picture is blank".into())?;
        let different = luma.iter().zip(image.data()).filter(|(a, b)| a != b).count();
        ensure(luma.len() == image.data().len() && different == 0, || {
            format!("{different} of {} pixels differ from v4l2-ctl's", luma.len())
        })
    }

    /// This device stamps the end of a frame before it comes.
    fn end_stamps(&self) -> Outcome {
        self.set("timestamp_source=0")?;
        let mut camera = self.grey()?;
        for _ in 0..10 {
            let frame = camera.next_frame(SOON)?;
            let now = self.clock.now();
            ensure(frame.stamp <= now, || format!("a stamp of {:?} at {now:?}", frame.stamp))?;
        }
        drop(camera);
        self.set("timestamp_source=1")?;
        Ok("none later than its arrival".into())
    }

    fn padding(&self) -> Outcome {
        let plain = self.grey()?.next_frame(SOON)?.image;
        self.v4l2_ctl(&[
            "--set-fmt-video=width=640,height=360,pixelformat=GREY,bytesperline=1024",
        ])?;
        let mut camera = self.grey()?;
        let stride = camera.stride();
        let padded = camera.next_frame(SOON)?.image;
        drop(camera);
        self.v4l2_ctl(&["--set-fmt-video=width=640,height=360,pixelformat=GREY,bytesperline=640"])?;
        ensure(stride == 1024, || format!("rows of {stride} bytes"))?;
        ensure(plain == padded, || "the picture changes with the padding".into())?;
        Ok("rows of 1024 bytes hold the picture of rows of 640".into())
    }

    fn not_offered(&self) -> Outcome {
        let format = self.refusal(&self.config(PixelFormat::Mjpeg))?;
        let odd =
            V4l2Camera::open(&self.config(PixelFormat::Grey), (641, 361), Arc::new(self.clock));
        let size = odd.err().ok_or("641x361 opened")?;
        for error in [&format, &size] {
            ensure(matches!(error, DeviceError::Unsupported { .. }), || error.to_string())?;
        }
        Ok(format!("\"{size}\"; \"...{}\"", last(&format.to_string(), 20)))
    }

    fn rate(&self) -> Outcome {
        let at = |rate| V4l2Config { rate: Some(rate), ..self.config(PixelFormat::Grey) };
        let mut camera = self.open(&at(15.0))?;
        let first = camera.next_frame(SOON)?;
        for _ in 0..14 {
            camera.next_frame(SOON)?;
        }
        let end = camera.next_frame(SOON)?;
        let frames = (end.sequence - first.sequence) as f64;
        let rate = frames / (end.stamp - first.stamp).as_secs_f64();
        drop(camera);
        ensure((rate / 15.0 - 1.0).abs() < 0.05, || format!("{rate} frames a second, not 15"))?;
        let error = self.refusal(&at(1234.0))?;
        self.open(&at(30.0))?;
        Ok(format!("{rate:.2} frames a second when asked for 15; \"{error}\""))
    }

    fn locks(&self) -> Outcome {
        self.set("gain_automatic=1")?;
        let camera = self.open(&V4l2Config { gain: Some(42), ..self.config(PixelFormat::Grey) })?;
        let locked = camera.locked().clone();
        let told = self.v4l2_ctl(&["--get-ctrl", "gain,gain_automatic"])?;
        drop(camera);
        ensure(locked.gain == Some(42), || format!("{locked:?}"))?;
        ensure(told.contains("gain: 42") && told.contains("gain_automatic: 0"), || told.clone())?;
        ensure(locked.exposure.is_none() && locked.remarks.len() == 1, || format!("{locked:?}"))?;
        let asked = V4l2Config { exposure: Some(0.004), ..self.config(PixelFormat::Grey) };
        let error = self.refusal(&asked)?;
        ensure(matches!(error, DeviceError::Unsupported { .. }), || error.to_string())?;
        let beyond = V4l2Config { gain: Some(100_000), ..self.config(PixelFormat::Grey) };
        let range = self.refusal(&beyond)?;
        Ok(format!("gain 42, automatic gain off; \"{error}\"; \"{range}\""))
    }

    fn second_reader(&self) -> Outcome {
        let mut first = self.grey()?;
        let error = self.refusal(&self.config(PixelFormat::Grey))?;
        first.next_frame(SOON)?;
        ensure(error.to_string().contains("in use"), || error.to_string())?;
        Ok(format!("\"{error}\", the first goes on"))
    }

    fn slow_reader(&self) -> Outcome {
        let mut camera = self.grey()?;
        let first = camera.next_frame(SOON)?;
        std::thread::sleep(Duration::from_secs(1));
        let next = camera.next_frame(SOON)?;
        let age = self.clock.now() - next.stamp;
        let counts = camera.counts();
        ensure(counts.skipped > 0 && next.sequence > first.sequence + 5, || format!("{counts:?}"))?;
        ensure(age < Duration::from_millis(500), || format!("a picture {age:?} old"))?;
        Ok(format!(
            "after 1 s without reading: frame {} after frame {}, {} skipped, {:.0} ms old",
            next.sequence,
            first.sequence,
            counts.skipped,
            age.as_secs_f64() * 1e3
        ))
    }

    fn lost(&self) -> Outcome {
        let mut camera = self.grey()?;
        let mut numbers = vec![camera.next_frame(SOON)?.sequence];
        self.set("percentage_of_dropped_buffers=30")?;
        while numbers.len() < 60 {
            numbers.push(camera.next_frame(SOON)?.sequence);
        }
        self.set("percentage_of_dropped_buffers=0")?;
        let counts = camera.counts();
        let missing = numbers[59] - numbers[0] - 59;
        ensure(counts.lost > 5 && counts.damaged == 0, || format!("{counts:?}"))?;
        ensure(missing <= counts.lost + counts.skipped, || format!("{missing}: {counts:?}"))?;
        Ok(format!("told to drop 30 %: 60 frames read, {missing} missing, {counts:?}"))
    }

    /// Orders a fault and reads until it was counted and frames are missing, which a reader that lags
    /// behind sees later, and three frames more; the numbers of the first and the last frame and how many
    /// are missing between them, all of which must be counted.
    fn after_fault(
        &self,
        camera: &mut V4l2Camera,
        fault: &str,
        happened: fn(&Counts) -> bool,
    ) -> Result<(u64, u64, u64), Box<dyn Error>> {
        let first = camera.next_frame(SOON)?.sequence;
        self.set(fault)?;
        let begin = Instant::now();
        let (mut read, mut more) = (1, 3);
        let (last, missing) = loop {
            let last = camera.next_frame(SOON)?.sequence;
            read += 1;
            let missing = last + 1 - first - read;
            if happened(&camera.counts()) && missing > 0 {
                more -= 1;
            }
            if more == 0 {
                break (last, missing);
            }
            ensure(begin.elapsed() < SOON, || {
                format!("{missing} missing from {first} to {last}, counted {:?}", camera.counts())
            })?;
        };
        let counts = camera.counts();
        ensure(missing <= counts.lost + counts.damaged + counts.skipped, || {
            format!("{missing} missing from {first} to {last}, counted {counts:?}")
        })?;
        Ok((first, last, missing))
    }

    fn damaged(&self) -> Outcome {
        let mut camera = self.grey()?;
        let fault = "inject_v4l2_buf_flag_error=1";
        let (first, last, missing) =
            self.after_fault(&mut camera, fault, |counts| counts.damaged == 1)?;
        let counts = camera.counts();
        Ok(format!("frames {first} to {last}, {missing} missing, {counts:?}"))
    }

    fn silent(&self) -> Outcome {
        let mut camera = self.grey()?;
        camera.next_frame(SOON)?;
        self.set("percentage_of_dropped_buffers=100")?;
        let limit = Duration::from_millis(400);
        let error = loop {
            let begin = Instant::now();
            if let Err(error) = camera.next_frame(limit) {
                ensure(begin.elapsed() < limit * 3, || format!("{:?}", begin.elapsed()))?;
                break error;
            }
        };
        self.set("percentage_of_dropped_buffers=0")?;
        camera.next_frame(SOON)?;
        ensure(matches!(error, DeviceError::Timeout { .. }), || error.to_string())?;
        Ok(format!("\"{error}\", then frames again"))
    }

    fn broken(&self) -> Outcome {
        let mut camera = self.grey()?;
        let fault = "inject_fatal_streaming_error=1";
        let (first, last, missing) =
            self.after_fault(&mut camera, fault, |counts| counts.restarts == 1)?;
        let counts = camera.counts();
        Ok(format!("goes on by itself, frames {first} to {last}, {missing} missing, {counts:?}"))
    }

    fn unplugged(&self) -> Outcome {
        let mut camera = self.grey()?;
        camera.next_frame(SOON)?;
        self.set("disconnect=1")?;
        let begin = Instant::now();
        let error = loop {
            match camera.next_frame(SOON) {
                Ok(_) => ensure(begin.elapsed() < SOON, || "still delivers".into())?,
                Err(error) => break error,
            }
        };
        let took = begin.elapsed();
        for error in [error.clone(), camera.next_frame(SOON).err().ok_or("delivers again")?] {
            ensure(matches!(error, DeviceError::Disconnected { .. }), || error.to_string())?;
        }
        drop(camera);
        // The test camera is plugged in again when nobody has it open any more.
        self.grey()?.next_frame(SOON)?;
        Ok(format!(
            "\"{error}\" after {:.0} ms and for good; opened again, it delivers",
            took.as_secs_f64() * 1e3
        ))
    }
}

/// The end of a text.
fn last(text: &str, count: usize) -> String {
    let skip = text.chars().count().saturating_sub(count);
    text.chars().skip(skip).collect()
}
