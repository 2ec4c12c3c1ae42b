//! Writes a recording with a message of every type and with what a run records, for
//! `scripts/check_recording.py` to read with another implementation:
//!
//! ```sh
//! cargo run -p vergence-ros --example write_sample -- sample.mcap
//! python3 scripts/check_recording.py sample.mcap --samples crates/ros/tests/data/samples.json
//! ```

use std::error::Error;
use std::path::Path;
use std::time::Duration;

use nalgebra::{Matrix3, Matrix6, Point3, UnitQuaternion};
use serde_json::Value;
use vergence_devices::Description;
use vergence_geometry::{Camera, GaussianPoint, GaussianPose, Transform};
use vergence_imaging::{Frame, Image};
use vergence_ros::msg::{
    builtin_interfaces as builtin, geometry_msgs as geometry, sensor_msgs as sensor, std_msgs,
    tf2_msgs, trajectory_msgs as trajectory,
};
use vergence_ros::recording::Writer;
use vergence_ros::{Message, convert, tf};

const SAMPLES: &str = include_str!("../tests/data/samples.json");
const ROBOT: &str = r#"<robot name="head"><link name="base"/><link name="pan"/><link name="eye"/>
  <joint name="pan_joint" type="revolute"><parent link="base"/><child link="pan"/><axis xyz="0 0 1"/>
    <origin xyz="0 0.1 0.5"/><limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
  <joint name="eye_joint" type="fixed"><parent link="pan"/><child link="eye"/>
    <origin xyz="0.02 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint></robot>"#;

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("usage: write_sample RECORDING.mcap")?;
    let mut writer = Writer::create(Path::new(&path))?;
    every_type(&mut writer)?;
    run(&mut writer)?;
    Ok(writer.finish()?)
}

/// Each sample, decoded and encoded by us, on the topic `/sample/<package>/<name>`.
fn every_type(writer: &mut Writer) -> Result<(), Box<dyn Error>> {
    let samples: Vec<Value> = serde_json::from_str(SAMPLES)?;
    for sample in &samples {
        let name = sample["type"].as_str().unwrap_or_default();
        let bytes = unhex(sample["cdr_little_endian"].as_str().unwrap_or_default())?;
        macro_rules! write_as {
            ($($message:ty),*) => {
                $(if <$message>::TYPE == name {
                    let topic = format!("/sample/{}", name.replace("/msg/", "/"));
                    writer.write(&topic, Duration::ZERO, &<$message>::from_cdr(&bytes)?)?;
                })*
            };
        }
        write_as!(
            builtin::Time,
            builtin::Duration,
            std_msgs::Header,
            std_msgs::String,
            sensor::Image,
            sensor::CompressedImage,
            sensor::RegionOfInterest,
            sensor::CameraInfo,
            sensor::JointState,
            geometry::Point,
            geometry::Vector3,
            geometry::Quaternion,
            geometry::Pose,
            geometry::PoseStamped,
            geometry::PoseWithCovariance,
            geometry::PoseWithCovarianceStamped,
            geometry::PointStamped,
            geometry::Transform,
            geometry::TransformStamped,
            tf2_msgs::TFMessage,
            trajectory::JointTrajectoryPoint,
            trajectory::JointTrajectory
        );
    }
    Ok(())
}

/// Half a second of a head that turns, with what it found.
fn run(writer: &mut Writer) -> Result<(), Box<dyn Error>> {
    let robot = Description::parse(ROBOT, Path::new("head.urdf"))?;
    let camera = Camera::centred(320, 240, 300.0);
    let text = std_msgs::String { data: robot.text.clone() };
    writer.write_latched("/robot_description", Duration::ZERO, &text)?;
    writer.write_latched("/tf_static", Duration::ZERO, &tf::fixed_frames(&robot))?;
    for sequence in 0..15 {
        let stamp = Duration::from_secs(100) + sequence as u32 * Duration::from_micros(33_333);
        let shift = 2 * sequence as usize;
        let frame = Frame {
            image: Image::from_fn(320, 240, |x, y| (x + y + shift) as u8),
            stamp,
            exposure: Duration::from_millis(8),
            row_time: None,
            sequence,
        };
        let joints = [("pan_joint", 0.01 * sequence as f64)];
        writer.write("/left/image_raw", stamp, &convert::image(&frame, "eye"))?;
        writer.write("/left/image_raw/compressed", stamp, &convert::jpeg(&frame, "eye", 90)?)?;
        let info = convert::camera_info(&camera, stamp, "eye");
        writer.write("/left/camera_info", stamp, &info)?;
        writer.write("/joint_states", stamp, &convert::joint_state(stamp, &joints))?;
        writer.write("/tf", stamp, &tf::moving_frames(&robot, stamp, &joints))?;
    }
    let stamp = Duration::from_millis(100_500);
    let position = Point3::new(0.6, -0.1, 0.05);
    let covariance = Matrix3::from_diagonal(&[1e-6, 2e-6, 3e-6].into());
    let landmark = GaussianPoint { position, covariance };
    writer.write("/landmark", stamp, &convert::point_stamped(&position, stamp, "base"))?;
    let with_covariance = convert::point_with_covariance(&landmark, stamp, "base");
    writer.write("/landmark_with_covariance", stamp, &with_covariance)?;
    let rotation = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.7);
    let estimate = GaussianPose {
        pose: Transform::from_parts(position.into(), rotation),
        covariance: Matrix6::from_diagonal(&[1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6].into()),
    };
    let pose = convert::pose_with_covariance(&estimate, stamp, "base");
    writer.write("/object_pose", stamp, &pose)?;
    Ok(())
}

fn unhex(text: &str) -> Result<Vec<u8>, Box<dyn Error>> {
    let pairs = text.as_bytes().chunks(2);
    pairs.map(|pair| Ok(u8::from_str_radix(std::str::from_utf8(pair)?, 16)?)).collect()
}
