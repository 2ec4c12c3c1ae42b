//! Speed of recording and of reading back, in bytes of pixels: 90 pictures (3 s at 30 Hz).
//!
//! `cargo bench -p vergence-ros`
#![expect(clippy::unwrap_used, reason = "a bench that cannot work stops")]

use std::path::{Path, PathBuf};
use std::time::Duration;

use divan::counter::BytesCount;
use divan::{Bencher, black_box};
use vergence_imaging::{Frame, Image};
use vergence_ros::msg::sensor_msgs;
use vergence_ros::recording::{Writer, frames};
use vergence_ros::{Message, convert};

const PICTURES: u32 = 90;
const SIZES: [(usize, usize); 2] = [(320, 240), (640, 480)];

fn main() {
    divan::main();
}

fn frame(size: (usize, usize)) -> Frame {
    Frame {
        image: Image::from_fn(size.0, size.1, |x, y| (x * y) as u8),
        stamp: Duration::from_secs(1),
        exposure: Duration::from_millis(8),
        row_time: None,
        sequence: 0,
    }
}

fn record(path: &Path, frame: &Frame) {
    let mut writer = Writer::create(path).unwrap();
    for number in 0..PICTURES {
        let stamp = frame.stamp + number * Duration::from_millis(33);
        let mut image = convert::image(frame, "eye");
        image.header.stamp = stamp.into();
        writer.write("/left/image_raw", stamp, &image).unwrap();
    }
    writer.finish().unwrap();
}

fn file(size: (usize, usize)) -> PathBuf {
    std::env::temp_dir().join(format!("vergence-ros-bench-{}-{}.mcap", std::process::id(), size.0))
}

fn pixels(size: (usize, usize)) -> BytesCount {
    BytesCount::new(size.0 * size.1 * PICTURES as usize)
}

#[divan::bench(args = SIZES)]
fn write(bencher: Bencher, size: (usize, usize)) {
    let (frame, path) = (frame(size), file(size));
    bencher.counter(pixels(size)).bench(|| record(&path, &frame));
    let _ = std::fs::remove_file(&path);
}

#[divan::bench(args = SIZES)]
fn read(bencher: Bencher, size: (usize, usize)) {
    let path = file(size);
    record(&path, &frame(size));
    bencher.counter(pixels(size)).bench(|| {
        let read = frames(&path, "/left/image_raw", Duration::from_millis(8)).unwrap();
        assert_eq!(read.map(Result::unwrap).map(black_box).count(), PICTURES as usize);
    });
    let _ = std::fs::remove_file(&path);
}

#[divan::bench(args = SIZES)]
fn encode_and_decode_one(bencher: Bencher, size: (usize, usize)) {
    let frame = frame(size);
    bencher.counter(BytesCount::new(size.0 * size.1)).bench(|| {
        let bytes = convert::image(black_box(&frame), "eye").to_cdr();
        sensor_msgs::Image::from_cdr(&bytes).unwrap()
    });
}
