//! Reads some pictures of an MJPEG camera and prints one line for each: number, stamp (s), mean grey.
//!
//! `mjpeg_probe URL WIDTH HEIGHT COUNT`; `scripts/check_mjpeg.py` runs it against an independent server.

use std::sync::Arc;
use std::time::Duration;

use vergence_devices::Camera;
use vergence_devices::clock::SystemClock;
use vergence_devices::mjpeg::{MjpegCamera, MjpegConfig};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, width, height, count] = arguments.as_slice() else {
        return Err("mjpeg_probe URL WIDTH HEIGHT COUNT".into());
    };
    let config = MjpegConfig { url: url.clone(), exposure: 0.0, latency: 0.05 };
    let size = (width.parse()?, height.parse()?);
    let mut camera = MjpegCamera::open(&config, size, Arc::new(SystemClock::start()))?;
    for _ in 0..count.parse::<usize>()? {
        let frame = camera.next_frame(Duration::from_secs(5))?;
        let pixels = frame.image.data();
        let mean = pixels.iter().map(|&p| f64::from(p)).sum::<f64>() / pixels.len() as f64;
        println!("{} {:.6} {mean:.1}", frame.sequence, frame.stamp.as_secs_f64());
    }
    Ok(())
}
