//! The solids of a robot and its gripper, read from a URDF's collision shapes.
//!
//! Links that hang on joints outside the arm's chain (the pan-tilt heads) are replaced by the ball
//! that holds them at every angle of those joints: a planner must not hit a head that turns.

use nalgebra::Vector3;
use urdf_rs::{Geometry, JointType};
use vergence_geometry::{Body, Chain, Solid, Transform};

use crate::description::{Description, DescriptionError, transform};

/// The two coupled fingers of a parallel gripper, as the URDF's prismatic joints tell.
#[derive(Debug, Clone, PartialEq)]
pub struct GripperJoints {
    /// Joint names, the finger along +y of the tool first.
    pub names: [String; 2],
    /// How far each finger moves outwards from the middle (m): half of the largest opening.
    pub travel: f64,
    /// Largest speed of one finger (m/s).
    pub velocity: f64,
    /// Largest closing force (N).
    pub effort: f64,
}

/// Where a link sits: on the chain, on a finger, or below a joint of something else.
struct Place {
    joints: usize,
    frame_from_link: Transform,
    slide: Vector3<f64>,
    /// Distance by which foreign joints can move the link's origin about the place.
    swing: Option<f64>,
}

impl Description {
    /// Every collision solid of the description, placed on `chain` (from `root`). Meshes are an
    /// error: they would be left out of the collision check.
    pub fn bodies(&self, root: &str, chain: &Chain) -> Result<Vec<Body>, DescriptionError> {
        let mut bodies = Vec::new();
        for link in &self.robot().links {
            let Some(place) = self.place(root, chain, &link.name)? else { continue };
            for collision in &link.collision {
                let solid = solid_of(&link.name, &collision.geometry)?;
                let link_from_solid = transform(&collision.origin);
                let body = match place.swing {
                    None => Body {
                        name: link.name.clone(),
                        joints: place.joints,
                        frame_from_solid: place.frame_from_link * link_from_solid,
                        slide: place.slide,
                        solid,
                    },
                    Some(swing) => {
                        let lever = link_from_solid.translation.vector.norm();
                        let radius = swing + lever + solid.bounding_radius();
                        Body {
                            name: link.name.clone(),
                            joints: place.joints,
                            frame_from_solid: place.frame_from_link,
                            slide: Vector3::zeros(),
                            solid: Solid::Sphere { radius },
                        }
                    }
                };
                bodies.push(body);
            }
        }
        Ok(bodies)
    }

    /// The two prismatic finger joints of the gripper below a link.
    pub fn gripper(&self, hand: &str) -> Result<GripperJoints, DescriptionError> {
        let fingers: Vec<_> = self
            .robot()
            .joints
            .iter()
            .filter(|j| j.joint_type == JointType::Prismatic && j.parent.link == hand)
            .collect();
        let [a, b] = fingers[..] else {
            return Err(DescriptionError::NoGripper(hand.into()));
        };
        let axis = |j: &urdf_rs::Joint| transform(&j.origin).rotation * Vector3::from(j.axis.xyz.0);
        if (axis(a) + axis(b)).norm() > 1e-6 || (a.limit.upper - b.limit.upper).abs() > 1e-6 {
            return Err(DescriptionError::NoGripper(hand.into()));
        }
        let (a, b) = if axis(a).y >= axis(b).y { (a, b) } else { (b, a) };
        Ok(GripperJoints {
            names: [a.name.clone(), b.name.clone()],
            travel: a.limit.upper,
            velocity: a.limit.velocity,
            effort: a.limit.effort,
        })
    }

    /// Walks up from a link to the chain or the root. `None` for links that hang on neither.
    fn place(
        &self,
        root: &str,
        chain: &Chain,
        name: &str,
    ) -> Result<Option<Place>, DescriptionError> {
        let mut place = Place {
            joints: 0,
            frame_from_link: Transform::identity(),
            slide: Vector3::zeros(),
            swing: None,
        };
        let mut link = name;
        // No path is longer than all joints; a loop in a broken URDF must end too.
        for _ in 0..=self.robot().joints.len() {
            if link == root {
                return Ok(Some(place));
            }
            let Some(joint) = self.robot().joints.iter().find(|j| j.child.link == link) else {
                return Ok(None);
            };
            if let Some(k) = chain.joints.iter().position(|j| j.name == joint.name) {
                place.joints = k + 1;
                return Ok(Some(place));
            }
            let origin = transform(&joint.origin);
            match joint.joint_type {
                JointType::Fixed => {}
                JointType::Prismatic => place.slide = Vector3::from(joint.axis.xyz.0),
                JointType::Revolute | JointType::Continuous => {
                    let lever = place.frame_from_link.translation.vector.norm();
                    place.swing = Some(place.swing.unwrap_or(0.0) + lever);
                    place.frame_from_link = Transform::identity();
                }
                _ => return Err(DescriptionError::Joint(joint.name.clone())),
            }
            place.frame_from_link = origin * place.frame_from_link;
            place.slide = origin.rotation * place.slide;
            link = &joint.parent.link;
        }
        Ok(None)
    }
}

fn solid_of(link: &str, geometry: &Geometry) -> Result<Solid, DescriptionError> {
    let solid = match geometry {
        Geometry::Box { size } => Solid::Cuboid { half: Vector3::from(size.0) / 2.0 },
        Geometry::Cylinder { radius, length } => {
            Solid::Cylinder { radius: *radius, half_height: length / 2.0 }
        }
        Geometry::Sphere { radius } => Solid::Sphere { radius: *radius },
        _ => return Err(DescriptionError::Shape(link.into())),
    };
    let reach = solid.bounding_radius();
    match reach.is_finite() && reach > 0.0 {
        true => Ok(solid),
        false => Err(DescriptionError::Shape(link.into())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const URDF: &str = r#"<robot name="r"><link name="base"/>
        <link name="mast"><collision><origin xyz="0 0 0.2"/><geometry><box size="0.1 0.1 0.4"/></geometry></collision></link>
        <link name="arm"/><link name="hand"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
        <link name="a"><collision><geometry><box size="0.02 0.01 0.06"/></geometry></collision></link><link name="b"/>
        <link name="pan"/><link name="eye"><collision><origin xyz="0 0 0.03"/><geometry><sphere radius="0.02"/></geometry></collision></link>
        <joint name="f" type="fixed"><parent link="base"/><child link="mast"/><origin xyz="0 0.3 0"/></joint>
        <joint name="p" type="revolute"><parent link="mast"/><child link="pan"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
          <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
        <joint name="t" type="revolute"><parent link="pan"/><child link="eye"/><origin xyz="0.04 0 0"/><axis xyz="0 1 0"/>
          <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
        <joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
          <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
        <joint name="h" type="fixed"><parent link="arm"/><child link="hand"/><origin xyz="0.4 0 0" rpy="0 1.5707963267948966 0"/></joint>
        <joint name="fa" type="prismatic"><parent link="hand"/><child link="a"/><origin xyz="0 0 0.1"/><axis xyz="0 -1 0"/>
          <limit lower="0" upper="0.04" velocity="0.1" effort="60"/></joint>
        <joint name="fb" type="prismatic"><parent link="hand"/><child link="b"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
          <limit lower="0" upper="0.04" velocity="0.1" effort="60"/></joint></robot>"#;

    #[test]
    fn bodies_sit_on_their_joints_and_heads_become_balls() {
        let description = Description::parse(URDF, Path::new("r.urdf")).unwrap();
        let chain = description.chain("base", "hand").unwrap();
        let bodies = description.bodies("base", &chain).unwrap();
        let body = |name: &str| bodies.iter().find(|b| b.name == name).unwrap();
        assert_eq!((body("mast").joints, body("hand").joints, body("a").joints), (0, 1, 1));
        assert!((body("mast").frame_from_solid.translation.vector.z - 0.2).abs() < 1e-12);
        let finger = body("a");
        assert!((finger.slide - Vector3::new(0.0, -1.0, 0.0)).norm() < 1e-12);
        let at = finger.frame_from_solid.translation.vector;
        assert!((at - Vector3::new(0.5, 0.0, 0.0)).norm() < 1e-9, "{at}");
        let eye = body("eye");
        assert!(
            (eye.frame_from_solid.translation.vector - Vector3::new(0.0, 0.3, 0.5)).norm() < 1e-12
        );
        assert!((eye.solid.bounding_radius() - 0.09).abs() < 1e-12, "{eye:?}");
    }

    #[test]
    fn the_gripper_is_found_and_meshes_are_refused() {
        let description = Description::parse(URDF, Path::new("r.urdf")).unwrap();
        let gripper = description.gripper("hand").unwrap();
        assert_eq!(gripper.names, ["fb".to_string(), "fa".to_string()]);
        assert_eq!((gripper.travel, gripper.effort), (0.04, 60.0));
        assert!(matches!(description.gripper("arm"), Err(DescriptionError::NoGripper(_))));
        let mesh = URDF.replace(r#"<box size="0.1 0.1 0.4"/>"#, r#"<mesh filename="m.stl"/>"#);
        let mesh = Description::parse(&mesh, Path::new("m.urdf")).unwrap();
        let chain = mesh.chain("base", "hand").unwrap();
        assert!(
            matches!(mesh.bodies("base", &chain), Err(DescriptionError::Shape(l)) if l == "mast")
        );
    }
}
