//! The robot's description: a URDF, reduced to the chains that the mathematics uses.

use std::path::{Path, PathBuf};

use nalgebra::{Translation3, Unit, UnitQuaternion, Vector3};
use urdf_rs::JointType;
use vergence_geometry::{Chain, Joint, Limits, Transform};

/// Why a description was refused.
#[derive(Debug, thiserror::Error)]
pub enum DescriptionError {
    /// Not a readable URDF.
    #[error("{path}: not a readable URDF: {message}")]
    Parse {
        /// Which file.
        path: PathBuf,
        /// What the parser said.
        message: String,
    },
    /// A link that is asked for does not exist.
    #[error("the URDF has no link \"{0}\"")]
    NoLink(String),
    /// The tip does not hang below the root.
    #[error("the URDF has no chain from \"{root}\" to \"{tip}\"")]
    NoChain {
        /// Where the chain should start.
        root: String,
        /// Where it should end.
        tip: String,
    },
    /// The chain's moving joints are not the ones that were named.
    #[error("the chain to \"{tip}\" moves by {found:?}, not by {expected:?}")]
    OtherJoints {
        /// End of the chain.
        tip: String,
        /// Joints in the URDF.
        found: Vec<String>,
        /// Joints in the configuration.
        expected: Vec<String>,
    },
    /// A joint that is not revolute, or has no axis.
    #[error("joint \"{0}\" is neither fixed nor revolute with an axis")]
    Joint(String),
    /// A collision shape that is neither box, cylinder nor sphere, or has no size.
    #[error("link \"{0}\": collision shapes must be boxes, cylinders or spheres")]
    Shape(String),
    /// The hand does not carry two opposite fingers.
    #[error("link \"{0}\" does not carry two prismatic fingers that move against each other")]
    NoGripper(String),
}

/// A parsed URDF.
#[derive(Debug, Clone)]
pub struct Description {
    /// The URDF as it was read, for `robot_description`.
    pub text: String,
    robot: urdf_rs::Robot,
}

impl Description {
    /// Parses URDF text; `path` is for messages only.
    pub fn parse(text: &str, path: &Path) -> Result<Self, DescriptionError> {
        let robot = urdf_rs::read_from_string(text).map_err(|error| DescriptionError::Parse {
            path: path.into(),
            message: error.to_string(),
        })?;
        Ok(Description { text: text.into(), robot })
    }

    /// The URDF's content, for visual and collision geometry.
    pub fn robot(&self) -> &urdf_rs::Robot {
        &self.robot
    }

    /// The chain of revolute joints from one link to another, fixed joints folded in.
    pub fn chain(&self, root: &str, tip: &str) -> Result<Chain, DescriptionError> {
        let mut joints = Vec::new();
        let mut pending = Transform::identity();
        for joint in self.path(root, tip)? {
            let parent_from_joint = pending * transform(&joint.origin);
            match joint.joint_type {
                JointType::Fixed => pending = parent_from_joint,
                JointType::Revolute | JointType::Continuous => {
                    joints.push(revolute(joint, parent_from_joint)?);
                    pending = Transform::identity();
                }
                _ => return Err(DescriptionError::Joint(joint.name.clone())),
            }
        }
        Ok(Chain { joints, last_from_tip: pending })
    }

    /// The joints from one link to another, in this order.
    pub(crate) fn path(
        &self,
        root: &str,
        tip: &str,
    ) -> Result<Vec<&urdf_rs::Joint>, DescriptionError> {
        for link in [root, tip] {
            if !self.robot.links.iter().any(|l| l.name == link) {
                return Err(DescriptionError::NoLink(link.into()));
            }
        }
        let mut upwards = Vec::new();
        let mut link = tip;
        // A URDF that is not a tree must not loop for ever: no path is longer than all joints.
        while link != root && upwards.len() <= self.robot.joints.len() {
            let Some(joint) = self.robot.joints.iter().find(|j| j.child.link == link) else {
                break;
            };
            upwards.push(joint);
            link = &joint.parent.link;
        }
        if link != root {
            return Err(DescriptionError::NoChain { root: root.into(), tip: tip.into() });
        }
        upwards.reverse();
        Ok(upwards)
    }

    /// The chain from `root` to `tip`, refused unless it moves by exactly the named joints.
    pub fn chain_with(
        &self,
        root: &str,
        tip: &str,
        names: &[&str],
    ) -> Result<Chain, DescriptionError> {
        let chain = self.chain(root, tip)?;
        let found: Vec<String> = chain.joints.iter().map(|j| j.name.clone()).collect();
        if found != names {
            let expected = names.iter().map(|n| n.to_string()).collect();
            return Err(DescriptionError::OtherJoints { tip: tip.into(), found, expected });
        }
        Ok(chain)
    }
}

/// A URDF origin as a transform (xyz, then roll pitch yaw about fixed axes).
pub fn transform(origin: &urdf_rs::Pose) -> Transform {
    let [x, y, z] = origin.xyz.0;
    let [roll, pitch, yaw] = origin.rpy.0;
    Transform::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    )
}

fn revolute(
    joint: &urdf_rs::Joint,
    parent_from_joint: Transform,
) -> Result<Joint, DescriptionError> {
    let axis = Unit::try_new(Vector3::from(joint.axis.xyz.0), 1e-9)
        .ok_or_else(|| DescriptionError::Joint(joint.name.clone()))?;
    let bounded = joint.joint_type == JointType::Revolute;
    let (lower, upper) = match bounded {
        true => (joint.limit.lower, joint.limit.upper),
        false => (-std::f64::consts::PI, std::f64::consts::PI),
    };
    let limits = Limits { lower, upper, velocity: joint.limit.velocity };
    Ok(Joint { name: joint.name.clone(), parent_from_joint, axis, limits })
}

#[cfg(test)]
mod tests {
    use super::*;

    const URDF: &str = r#"<robot name="r"><link name="base"/><link name="mast"/><link name="pan"/>
        <link name="tilt"/><link name="eye"/><link name="island"/>
        <joint name="m" type="fixed"><parent link="base"/><child link="mast"/><origin xyz="0 0.1 0.5"/></joint>
        <joint name="p" type="revolute"><parent link="mast"/><child link="pan"/><axis xyz="0 0 1"/>
          <limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
        <joint name="t" type="revolute"><parent link="pan"/><child link="tilt"/><axis xyz="0 1 0"/>
          <origin xyz="0.02 0 0"/><limit lower="-1" upper="1" velocity="3.6" effort="1"/></joint>
        <joint name="e" type="fixed"><parent link="tilt"/><child link="eye"/>
          <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint></robot>"#;

    fn description() -> Description {
        Description::parse(URDF, Path::new("r.urdf")).unwrap()
    }

    #[test]
    fn fixed_joints_are_folded_in() {
        let chain = description().chain_with("base", "eye", &["p", "t"]).unwrap();
        let base_from_eye = chain.forward(&[0.0, 0.3]);
        let forward = base_from_eye.rotation * Vector3::z();
        assert!((forward - Vector3::new(0.3f64.cos(), 0.0, -0.3f64.sin())).norm() < 1e-9);
        assert!((base_from_eye.translation.vector - Vector3::new(0.02, 0.1, 0.5)).norm() < 1e-9);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let d = description();
        assert!(matches!(d.chain("base", "nose"), Err(DescriptionError::NoLink(n)) if n == "nose"));
        assert!(matches!(d.chain("base", "island"), Err(DescriptionError::NoChain { .. })));
        assert!(matches!(
            d.chain_with("base", "eye", &["t", "p"]),
            Err(DescriptionError::OtherJoints { .. })
        ));
        assert!(Description::parse("<robot", Path::new("x")).is_err());
    }
}
