//! `recording.mcap`: a run as ROS 2 messages, for any ROS 2 tool.
//!
//! | topic | type |
//! |---|---|
//! | `/{left,right}/image_raw`, `/{left,right}/camera_info` | `sensor_msgs/msg/Image`, `CameraInfo` |
//! | `/joint_states` | `sensor_msgs/msg/JointState` of heads, arm and fingers |
//! | `/arm/joint_trajectory` | `trajectory_msgs/msg/JointTrajectory`, as the arm is told |
//! | `/tf`, `/tf_static` | `tf2_msgs/msg/TFMessage` |
//! | `/robot_description` | `std_msgs/msg/String` |
//! | `/landmark`, `/object_pose` | `geometry_msgs/msg/PoseWithCovarianceStamped` in `base` |
//! | `/result` | `std_msgs/msg/String`, the JSON that `--json` prints |

use std::path::Path;
use std::time::Duration;

use vergence::{Event, Report};
use vergence_devices::{JointReading, Side};
use vergence_geometry::{Camera, Trajectory, Transform};
use vergence_imaging::Frame;
use vergence_ros::msg::std_msgs;
use vergence_ros::msg::tf2_msgs::TFMessage;
use vergence_ros::recording::{RecordingError, Writer};
use vergence_ros::{convert, tf};

use crate::failure::Failure;
use crate::robot::Opened;

/// Time between two joint states of a moving arm.
const PERIOD: Duration = Duration::from_millis(100);
/// The link that carries the fingers.
const HAND: &str = "hand";
/// The frame of results.
const BASE: &str = "base";

/// One head's names and lens.
struct HeadNames {
    joints: [String; 2],
    optical_frame: String,
    camera: Camera,
}

/// Writes the recording of one run.
pub struct Recorder {
    writer: Option<Writer>,
    description: vergence_devices::Description,
    heads: [HeadNames; 2],
    /// Stamp of the newest picture or joint reading: the time of what has no stamp of its own.
    now: Duration,
}

impl Recorder {
    /// Opens the file and writes what does not change.
    pub fn create(path: &Path, robot: &Opened) -> Result<Self, Failure> {
        let heads = Side::BOTH.map(|side| {
            let wiring = robot.config.head(side);
            HeadNames {
                joints: [wiring.pan_joint.clone(), wiring.tilt_joint.clone()],
                optical_frame: wiring.optical_frame.clone(),
                camera: wiring.camera.model(),
            }
        });
        let now = robot.system.robot.clock.now();
        let description = robot.description.clone();
        let mut writer = Writer::create(path).map_err(unwritten)?;
        let urdf = std_msgs::String { data: description.text.clone() };
        writer.write_latched("/robot_description", now, &urdf).map_err(unwritten)?;
        let fixed = tf::fixed_frames(&description);
        writer.write_latched("/tf_static", now, &fixed).map_err(unwritten)?;
        Ok(Recorder { writer: Some(writer), description, heads, now })
    }

    /// Writes what an event has for ROS 2.
    pub fn record(&mut self, event: &Event<'_>) -> Result<(), Failure> {
        let Some(mut writer) = self.writer.take() else { return Ok(()) };
        let written = self.write(&mut writer, event);
        self.writer = Some(writer);
        written.map_err(unwritten)
    }

    fn write(&mut self, writer: &mut Writer, event: &Event<'_>) -> Result<(), RecordingError> {
        match event {
            Event::Frame(side, frame, joints) => {
                self.now = self.now.max(frame.stamp);
                self.frame(writer, *side, frame, joints)
            }
            Event::Landmark(point, _) => {
                let message = convert::point_with_covariance(point, self.now, BASE);
                writer.write("/landmark", self.now, &message)
            }
            Event::Motion { start, names, trajectory } => {
                self.now = self.now.max(*start);
                let message = convert::joint_trajectory(trajectory, names, *start);
                writer.write("/arm/joint_trajectory", self.now, &message)
            }
            Event::Moved { start, end, names, trajectory } => {
                self.motion(writer, [*start, *end], names, trajectory)
            }
            Event::Gripped(reading) => {
                let Ok(joints) = self.description.gripper(HAND) else { return Ok(()) };
                let [a, b] = &joints.names;
                let way = 0.5 * reading.width;
                self.joints(writer, reading.stamp, &[(a.as_str(), way), (b.as_str(), way)])
            }
            Event::Recognised(_, query, Ok(object)) => {
                let message = convert::pose_with_covariance(&object.pose, self.now, BASE);
                writer.write("/object_pose", self.now, &message)?;
                let name = query.record.object_id.as_str();
                self.object_frame(writer, name, &object.pose.pose)
            }
            _ => Ok(()),
        }
    }

    /// Where the arm was from start to end.
    fn motion(
        &mut self,
        writer: &mut Writer,
        [start, end]: [Duration; 2],
        names: &[String; 6],
        trajectory: &Trajectory,
    ) -> Result<(), RecordingError> {
        let mut stamp = start;
        loop {
            let Some(point) = trajectory.at((stamp - start).as_secs_f64()) else { return Ok(()) };
            let positions: [(&str, f64); 6] =
                std::array::from_fn(|k| (names[k].as_str(), point.positions[k]));
            self.joints(writer, stamp, &positions)?;
            if stamp >= end {
                return Ok(());
            }
            stamp = (stamp + PERIOD).min(end);
        }
    }

    /// Joint states with the frames that they move.
    fn joints(
        &mut self,
        writer: &mut Writer,
        stamp: Duration,
        positions: &[(&str, f64)],
    ) -> Result<(), RecordingError> {
        let stamp = stamp.max(self.now);
        self.now = stamp;
        writer.write("/joint_states", stamp, &convert::joint_state(stamp, positions))?;
        writer.write("/tf", stamp, &tf::moving_frames(&self.description, stamp, positions))
    }

    fn frame(
        &self,
        writer: &mut Writer,
        side: Side,
        frame: &Frame,
        joints: &JointReading,
    ) -> Result<(), RecordingError> {
        let head = &self.heads[side as usize];
        let (name, stamp) = (side.name(), frame.stamp);
        let image = convert::image(frame, &head.optical_frame);
        writer.write(&format!("/{name}/image_raw"), stamp, &image)?;
        let info = convert::camera_info(&head.camera, stamp, &head.optical_frame);
        writer.write(&format!("/{name}/camera_info"), stamp, &info)?;
        let [pan, tilt] = &head.joints;
        let positions = [(pan.as_str(), joints.pan), (tilt.as_str(), joints.tilt)];
        let state = convert::joint_state(stamp, &positions);
        writer.write("/joint_states", stamp, &state)?;
        writer.write("/tf", stamp, &tf::moving_frames(&self.description, stamp, &positions))
    }

    fn object_frame(
        &self,
        writer: &mut Writer,
        name: &str,
        base_from_object: &Transform,
    ) -> Result<(), RecordingError> {
        let edge = convert::transform_stamped(base_from_object, self.now, BASE, name);
        writer.write("/tf", self.now, &TFMessage { transforms: vec![edge] })
    }

    /// Writes the result and closes the file.
    pub fn finish(&mut self, report: &Report) -> Result<(), Failure> {
        let Some(mut writer) = self.writer.take() else { return Ok(()) };
        let data = serde_json::to_string(report)
            .map_err(|error| Failure::failed(error, "report this as a defect"))?;
        writer.write("/result", self.now, &std_msgs::String { data }).map_err(unwritten)?;
        writer.finish().map_err(unwritten)
    }
}

fn unwritten(error: RecordingError) -> Failure {
    Failure::failed(error, "check the folder given with --save: is it writable, is the disk full?")
}
