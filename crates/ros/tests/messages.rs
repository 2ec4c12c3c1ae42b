//! Every message type against bytes and definitions that another implementation made, and against
//! arbitrary bytes.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use proptest::prelude::*;
use serde_json::Value;
use vergence_ros::Message;
use vergence_ros::msg::{
    builtin_interfaces as builtin, geometry_msgs as geometry, sensor_msgs as sensor, std_msgs,
    tf2_msgs, trajectory_msgs as trajectory,
};

/// Calls `$check::<T>($arguments)` for every message type; returns an array of the answers.
macro_rules! for_every_type {
    ($check:ident($($argument:expr),*)) => {
        for_every_type!(@ $check($($argument),*)
            builtin::Time, builtin::Duration, std_msgs::Header, std_msgs::String, sensor::Image,
            sensor::CompressedImage, sensor::RegionOfInterest, sensor::CameraInfo,
            sensor::JointState, geometry::Point, geometry::Vector3, geometry::Quaternion,
            geometry::Pose, geometry::PoseStamped, geometry::PoseWithCovariance,
            geometry::PoseWithCovarianceStamped, geometry::PointStamped, geometry::Transform,
            geometry::TransformStamped, tf2_msgs::TFMessage, trajectory::JointTrajectoryPoint,
            trajectory::JointTrajectory)
    };
    (@ $check:ident $arguments:tt $($message:ty),*) => {
        [$(for_every_type!(# $check $arguments $message)),*]
    };
    (# $check:ident ($($argument:expr),*) $message:ty) => {
        $check::<$message>($($argument),*)
    };
}

fn samples() -> Vec<Value> {
    serde_json::from_str(include_str!("data/samples.json")).unwrap()
}

fn unhex(text: &Value) -> Vec<u8> {
    let text = text.as_str().unwrap();
    (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect()
}

fn agrees_with_sample<M: Message>(samples: &[Value]) {
    let sample = samples.iter().find(|sample| sample["type"] == M::TYPE).expect(M::TYPE);
    assert_eq!(M::schema(), sample["definition"].as_str().unwrap(), "definition of {}", M::TYPE);
    let bytes = unhex(&sample["cdr_little_endian"]);
    let message = M::from_cdr(&bytes).expect(M::TYPE);
    assert_eq!(message.to_cdr(), bytes, "bytes of {}", M::TYPE);
    let from_big = M::from_cdr(&unhex(&sample["cdr_big_endian"])).expect(M::TYPE);
    assert_eq!(from_big.to_cdr(), bytes, "{} from big endian", M::TYPE);
    for cut in 0..bytes.len() {
        assert!(M::from_cdr(&bytes[..cut]).is_err(), "{} cut at {cut}", M::TYPE);
    }
}

#[test]
fn bytes_and_definitions_are_those_of_another_implementation() {
    let samples = samples();
    assert_eq!(for_every_type!(agrees_with_sample(&samples)).len(), samples.len());
}

/// What decodes must encode to bytes that decode to the same again.
fn survives<M: Message>(bytes: &[u8]) {
    if let Ok(message) = M::from_cdr(bytes) {
        let once = message.to_cdr();
        let again = M::from_cdr(&once).expect(M::TYPE).to_cdr();
        assert_eq!(once, again, "{}", M::TYPE);
    }
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic(
        mut bytes in prop::collection::vec(any::<u8>(), 0..400),
        little in any::<bool>(),
    ) {
        survives::<std_msgs::Header>(&bytes);
        // With a valid header, so that the fields are reached.
        for (byte, value) in bytes.iter_mut().zip([0, u8::from(little), 0, 0]) {
            *byte = value;
        }
        for_every_type!(survives(&bytes));
    }

    #[test]
    fn damaged_samples_never_panic(
        which in 0usize..22,
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut bytes = unhex(&samples()[which]["cdr_little_endian"]);
        for (place, value) in damage {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        for_every_type!(survives(&bytes));
    }

    #[test]
    fn a_picture_survives(
        sec in any::<i32>(), nanosec in any::<u32>(), frame_id in ".{0,12}",
        height in any::<u32>(), step in any::<u32>(),
        data in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let header = std_msgs::Header { stamp: builtin::Time { sec, nanosec }, frame_id };
        let image = sensor::Image { header, height, step, data, ..Default::default() };
        prop_assert_eq!(sensor::Image::from_cdr(&image.to_cdr()).unwrap(), image);
    }

    #[test]
    fn a_trajectory_survives(
        joint_names in prop::collection::vec(".{0,9}", 0..5),
        points in prop::collection::vec(
            (prop::collection::vec(-1e9f64..1e9, 0..5), any::<i32>(), any::<u32>()), 0..5),
    ) {
        let points = points.into_iter().map(|(positions, sec, nanosec)| {
            let time_from_start = builtin::Duration { sec, nanosec };
            trajectory::JointTrajectoryPoint { positions, time_from_start, ..Default::default() }
        });
        let points = points.collect();
        let sent = trajectory::JointTrajectory { joint_names, points, ..Default::default() };
        prop_assert_eq!(trajectory::JointTrajectory::from_cdr(&sent.to_cdr()).unwrap(), sent);
    }
}

#[test]
fn a_hostile_count_reserves_no_memory() {
    // A joint state that claims 2^32 - 1 names.
    let mut bytes = std_msgs::Header::default().to_cdr();
    bytes.extend([0; 3]);
    bytes.extend([0xff; 4]);
    let error = sensor::JointState::from_cdr(&bytes).unwrap_err().to_string();
    assert!(error.contains("4294967295 elements"), "{error}");
}
