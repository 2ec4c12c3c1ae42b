//! Recordings written and read back, made by others, cut off, and damaged on purpose.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::path::{Path, PathBuf};
use std::time::Duration;

use proptest::prelude::*;
use vergence_devices::{Camera as _, Clock, DeviceError};
use vergence_geometry::{Camera, Distortion};
use vergence_imaging::{Frame, Image};
use vergence_ros::msg::sensor_msgs::{self, CameraInfo, JointState};
use vergence_ros::msg::std_msgs;
use vergence_ros::recording::{Reader, RecordingError, Topic, Writer, camera_info, frames};
use vergence_ros::{RecordingCamera, ReplayClock, convert};

const EXPOSURE: Duration = Duration::from_millis(8);
const IMAGES: &str = "/left/image_raw";

/// A file in the system's folder for temporary files that is removed again.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let file = format!("vergence-ros-{}-{name}.mcap", std::process::id());
        Scratch(std::env::temp_dir().join(file))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn frame(number: u64) -> Frame {
    Frame {
        image: Image::from_fn(64, 48, |x, y| (3 * x + 5 * y + number as usize) as u8),
        stamp: Duration::from_millis(1000 + 33 * number),
        exposure: EXPOSURE,
        row_time: None,
        sequence: number,
    }
}

fn camera() -> Camera {
    let distortion = Distortion { k1: 0.1, k2: -0.02, p1: 0.003, p2: -0.004, k3: 0.005 };
    Camera { distortion, ..Camera::centred(64, 48, 60.0) }
}

/// Pictures with camera and joints, and a robot description at the start.
fn write(path: &Path, pictures: u64) {
    let mut writer = Writer::create(path).unwrap();
    let urdf = std_msgs::String { data: "<robot/>".into() };
    writer.write_latched("/robot_description", Duration::from_secs(1), &urdf).unwrap();
    for frame in (0..pictures).map(frame) {
        let info = convert::camera_info(&camera(), frame.stamp, "eye");
        writer.write(IMAGES, frame.stamp, &convert::image(&frame, "eye")).unwrap();
        writer.write("/left/camera_info", frame.stamp, &info).unwrap();
        let joints = convert::joint_state(frame.stamp, &[("pan", 0.1), ("tilt", -0.2)]);
        writer.write("/joint_states", frame.stamp, &joints).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn what_is_written_is_read() {
    let file = Scratch::new("round-trip");
    write(&file.0, 40);
    let reader = Reader::open(&file.0).unwrap();
    assert!(reader.is_complete());
    let topic = |name: &str, message_type: &str, messages| Topic {
        name: name.into(),
        message_type: message_type.into(),
        messages,
    };
    assert_eq!(
        reader.topics(),
        [
            topic("/joint_states", "sensor_msgs/msg/JointState", 40),
            topic("/left/camera_info", "sensor_msgs/msg/CameraInfo", 40),
            topic(IMAGES, "sensor_msgs/msg/Image", 40),
            topic("/robot_description", "std_msgs/msg/String", 1),
        ]
    );
    let read: Vec<Frame> = frames(&file.0, IMAGES, EXPOSURE).unwrap().map(Result::unwrap).collect();
    assert_eq!(read, (0..40).map(frame).collect::<Vec<_>>());
    assert_eq!(camera_info(&file.0, "/left/camera_info").unwrap(), camera());
    let joints = reader.messages::<JointState>("/joint_states").unwrap().last().unwrap().unwrap();
    assert_eq!(joints.log_time, frame(39).stamp);
    assert_eq!(joints.message.name, ["pan", "tilt"]);
    assert_eq!(joints.message.position, [0.1, -0.2]);
}

#[test]
fn the_same_content_gives_the_same_bytes() {
    let files = [Scratch::new("first"), Scratch::new("second")];
    let bytes = files.each_ref().map(|file| {
        write(&file.0, 5);
        std::fs::read(&file.0).unwrap()
    });
    assert!(bytes[0] == bytes[1]);
}

#[test]
fn recordings_of_others_are_read_and_put_in_order() {
    for name in ["zstd.mcap", "lz4.mcap", "plain.mcap"] {
        let read = frames(&data(name), "/camera/image_raw", EXPOSURE).unwrap();
        let read: Vec<Frame> = read.map(Result::unwrap).collect();
        let stamps: Vec<u64> = read.iter().map(|frame| frame.stamp.as_secs()).collect();
        assert_eq!(stamps, [0, 1, 2, 3, 4, 5], "{name}");
        let numbers: Vec<u64> = read.iter().map(|frame| frame.sequence).collect();
        assert_eq!(numbers, [0, 1, 2, 3, 4, 6], "{name}: the second number 4 is left out");
        for (number, frame) in read.iter().enumerate() {
            let expected = Image::from_fn(40, 30, |x, y| (x + 2 * y + number) as u8);
            assert_eq!(frame.image, expected, "{name}, picture {number}");
        }
    }
}

#[test]
fn a_crash_leaves_a_readable_start() {
    let file = Scratch::new("crash");
    write(&file.0, 800);
    let bytes = std::fs::read(&file.0).unwrap();
    assert!(bytes.len() > 2 << 20, "several chunks");
    // Somewhere inside the last chunk, and just before the index.
    for (cut, least) in [(bytes.len() * 9 / 10, 300), (bytes.len() - 8, 800)] {
        let cut_off = Scratch::new(&format!("cut-{cut}"));
        std::fs::write(&cut_off.0, &bytes[..cut]).unwrap();
        let count = frames(&cut_off.0, IMAGES, EXPOSURE).unwrap().map(Result::unwrap).count();
        assert!(count >= least, "{count} pictures of 800 in the first {cut} bytes");
        // The data is all there when only the index is damaged.
        let reader = Reader::open(&cut_off.0).unwrap();
        assert_eq!(reader.is_complete(), count == 800);
    }
}

#[test]
fn a_damaged_chunk_does_not_take_the_others_with_it() {
    let file = Scratch::new("bit-rot");
    write(&file.0, 800);
    let mut bytes = std::fs::read(&file.0).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&file.0, &bytes).unwrap();
    let read: Vec<_> = frames(&file.0, IMAGES, EXPOSURE).unwrap().collect();
    let errors: Vec<String> =
        read.iter().filter_map(|f| f.as_ref().err().map(ToString::to_string)).collect();
    assert!(matches!(errors.as_slice(), [only] if only.contains("Chunk CRC failed")), "{errors:?}");
    let last = read.into_iter().filter_map(Result::ok).last();
    assert_eq!(last.unwrap().stamp, frame(799).stamp);
}

#[test]
fn errors_say_what_is_there() {
    let file = Scratch::new("errors");
    write(&file.0, 2);
    let message = camera_info(&file.0, "/right/camera_info").unwrap_err().to_string();
    assert!(message.contains("it has /joint_states, /left/camera_info"), "{message}");
    let message = camera_info(&file.0, IMAGES).unwrap_err().to_string();
    assert!(message.contains("carries sensor_msgs/msg/Image in cdr"), "{message}");
    let missing = Reader::open(Path::new("no-such.mcap")).unwrap_err();
    assert!(matches!(missing, RecordingError::File { .. }));
    let not_mcap = Reader::open(&data("samples.json")).unwrap_err().to_string();
    assert!(not_mcap.contains("not a readable MCAP recording"), "{not_mcap}");

    let mut writer = Writer::create(&Scratch::new("types").0).unwrap();
    writer.write("/a", Duration::ZERO, &std_msgs::String::default()).unwrap();
    let error = writer.write("/a", Duration::ZERO, &CameraInfo::default()).unwrap_err();
    assert!(error.to_string().contains("already carries std_msgs/msg/String"), "{error}");
}

/// One picture message, written and read back as a frame.
fn through(name: &str, image: sensor_msgs::Image) -> Result<Frame, RecordingError> {
    let file = Scratch::new(name);
    let mut writer = Writer::create(&file.0).unwrap();
    writer.write(IMAGES, Duration::from_secs(7), &image).unwrap();
    writer.finish().unwrap();
    frames(&file.0, IMAGES, EXPOSURE).unwrap().next().unwrap()
}

fn picture(encoding: &str, width: u32, height: u32, step: u32, data: &[u8]) -> sensor_msgs::Image {
    let encoding = encoding.into();
    let header = convert::header(Duration::from_secs(3), "eye");
    sensor_msgs::Image { header, height, width, encoding, is_bigendian: 0, step, data: data.into() }
}

#[test]
fn encodings_become_grey() {
    let cases: [(&str, u32, &[u8], &[u8]); 8] = [
        ("mono8", 1, &[9, 8], &[9, 8]),
        ("mono16", 2, &[1, 9, 2, 8], &[9, 8]),
        ("rgb8", 3, &[255, 0, 0, 0, 255, 0], &[54, 182]),
        ("bgr8", 3, &[255, 0, 0, 0, 255, 0], &[18, 182]),
        ("rgba8", 4, &[10, 10, 10, 0, 255, 255, 255, 0], &[10, 255]),
        ("bgra8", 4, &[0, 0, 255, 7, 255, 255, 255, 7], &[54, 255]),
        ("yuv422", 2, &[100, 1, 101, 2], &[1, 2]),
        ("yuv422_yuy2", 2, &[100, 1, 101, 2], &[100, 101]),
    ];
    for (encoding, bytes, pixels, grey) in cases {
        let frame = through(encoding, picture(encoding, 2, 1, 2 * bytes, pixels)).unwrap();
        assert_eq!(frame.image.data(), grey, "{encoding}");
        assert_eq!(frame.stamp, Duration::from_secs(3), "{encoding}");
    }
    let big = sensor_msgs::Image { is_bigendian: 1, ..picture("mono16", 1, 1, 2, &[200, 3]) };
    assert_eq!(through("big", big).unwrap().image.data(), [200]);
}

#[test]
fn unusable_pictures_are_refused() {
    let refused = |name: &str, image| through(name, image).unwrap_err().to_string();
    let huge = refused("huge", picture("mono8", u32::MAX, u32::MAX, u32::MAX, &[0]));
    assert!(huge.contains("4294967295x4294967295"), "{huge}");
    let empty = refused("empty", picture("mono8", 0, 4, 0, &[]));
    assert!(empty.contains("0x4"), "{empty}");
    let short = refused("short", picture("rgb8", 4, 4, 12, &[0; 47]));
    assert!(short.contains("47 bytes"), "{short}");
    let overlap = refused("overlap", picture("mono8", 4, 2, 3, &[0; 8]));
    assert!(overlap.contains("3 bytes a row"), "{overlap}");
    let unknown = refused("unknown", picture("bayer_rggb8", 2, 1, 2, &[0; 2]));
    assert!(unknown.contains("\"bayer_rggb8\" is not read"), "{unknown}");
    let mut early = picture("mono8", 1, 1, 1, &[0]);
    early.header.stamp.sec = -1;
    assert!(refused("early", early).contains("-1 s"));
}

#[test]
fn a_stamp_of_zero_is_replaced_by_the_time_of_recording() {
    let mut image = picture("mono8", 1, 1, 1, &[5]);
    image.header.stamp = Default::default();
    assert_eq!(through("unstamped", image).unwrap().stamp, Duration::from_secs(7));
}

#[test]
fn jpeg_topics_are_read_and_rubbish_does_not_end_them() {
    let file = Scratch::new("jpeg");
    let mut writer = Writer::create(&file.0).unwrap();
    for number in 0..3 {
        let mut message = convert::jpeg(&frame(number), "eye", 95).unwrap();
        if number == 1 {
            message.data.truncate(20);
        }
        writer.write("/c", frame(number).stamp, &message).unwrap();
    }
    writer.finish().unwrap();
    let read: Vec<_> = frames(&file.0, "/c", EXPOSURE).unwrap().collect();
    let (good, bad): (Vec<_>, Vec<_>) = read.into_iter().partition(Result::is_ok);
    assert_eq!(bad.len(), 1);
    let numbers: Vec<u64> = good.into_iter().map(|f| f.unwrap().sequence).collect();
    assert_eq!(numbers, [0, 2], "the lost picture leaves a gap");
}

#[test]
fn the_camera_replays_in_virtual_time() {
    let file = Scratch::new("camera");
    write(&file.0, 3);
    let clock = ReplayClock::default();
    let mut camera = RecordingCamera::open(&file.0, IMAGES, EXPOSURE, &clock).unwrap();
    assert_eq!(clock.now(), frame(0).stamp);
    let timeout = Duration::from_millis(20);
    assert_eq!(camera.next_frame(timeout).unwrap(), frame(0));
    assert_eq!(clock.now(), frame(0).stamp + EXPOSURE);
    // The second ends 33 ms after the first.
    assert!(matches!(camera.next_frame(timeout), Err(DeviceError::Timeout { .. })));
    assert_eq!(camera.next_frame(timeout).unwrap(), frame(1));
    clock.sleep(Duration::from_secs(1));
    assert_eq!(camera.next_frame(Duration::ZERO).unwrap(), frame(2));
    assert_eq!(clock.now(), frame(1).stamp + EXPOSURE + Duration::from_secs(1));
    assert!(matches!(camera.next_frame(timeout), Err(DeviceError::Disconnected { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Damage anywhere gives pictures or errors, in bounded memory, never a panic and never a loop.
    #[test]
    fn damaged_files_never_panic(
        which in 0usize..3,
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
        cut in any::<prop::sample::Index>(),
        whole in any::<bool>(),
    ) {
        let name = ["zstd.mcap", "lz4.mcap", "plain.mcap"][which];
        let mut bytes = std::fs::read(data(name)).unwrap();
        for (place, value) in damage {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        if !whole {
            bytes.truncate(cut.index(bytes.len()));
        }
        let file = Scratch::new("damaged");
        std::fs::write(&file.0, &bytes).unwrap();
        if let Ok(frames) = frames(&file.0, "/camera/image_raw", EXPOSURE) {
            prop_assert!(frames.count() <= 8);
        }
        let _ = Reader::open(&file.0);
    }

    #[test]
    fn arbitrary_records_never_panic(
        records in prop::collection::vec(
            (0u8..18, prop::collection::vec(any::<u8>(), 0..80), any::<Option<u64>>()), 0..12),
    ) {
        let mut bytes = b"\x89MCAP0\r\n".to_vec();
        for (opcode, body, length) in records {
            bytes.push(opcode);
            bytes.extend(length.unwrap_or(body.len() as u64).to_le_bytes());
            bytes.extend(body);
        }
        let file = Scratch::new("arbitrary");
        std::fs::write(&file.0, &bytes).unwrap();
        let _ = Reader::open(&file.0);
    }
}
