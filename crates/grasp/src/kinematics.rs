//! Closed-form inverse kinematics of a six-axis arm with spherical wrist.
//!
//! In: a [`Chain`] of six revolute joints (from a URDF). Out: every set of joint angles within the
//! limits that brings the tip to a pose.
//!
//! Method: the "ortho-parallel basis, spherical wrist" family of Brandstötter, Angerer and Hofbaur
//! (2014), which nearly all industrial arms belong to: axes 2 and 3 are parallel and at right angles
//! to axis 1, axes 4, 5 and 6 meet in one point. The seven lengths, signs and zero offsets of that
//! model are measured from the chain at angle zero; `rs-opw-kinematics` then solves it. What comes
//! out is compared with the chain's own forward kinematics, first over a set of postures when the
//! arm is built (an arm of another family is refused) and again for each solution.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};
use rs_opw_kinematics::kinematic_traits::Kinematics;
use rs_opw_kinematics::kinematics_impl::OPWKinematics;
use rs_opw_kinematics::parameters::opw_kinematics::Parameters;
use rs_opw_kinematics::pose::Pose;
use vergence_geometry::{Chain, JointAngles, Transform};

/// Why a chain cannot be used as an arm.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotAnArm {
    /// Not six joints.
    #[error("the arm's chain has {0} revolute joints, six are needed")]
    Joints(usize),
    /// Axes that do not fit the family.
    #[error("the arm has no closed-form solution here: {0}")]
    Family(&'static str),
    /// A joint whose range or speed is empty or not a number.
    #[error("joint \"{0}\" has no usable range and speed")]
    Limits(String),
}

/// A six-axis arm: the chain and its closed-form inverse.
#[derive(Clone)]
pub struct Arm {
    chain: Chain,
    solver: OPWKinematics,
    /// From the chain's root to the solver's base, and from the solver's flange to the chain's tip.
    root_from_base: Transform,
    tip_from_flange: Transform,
}

/// Largest deviation (m, rad) of a solution from the pose that was asked for.
const EXACT: f64 = 1e-6;

impl Arm {
    /// Measures the chain at angle zero.
    pub fn new(chain: Chain) -> Result<Self, NotAnArm> {
        if chain.joints.len() != 6 {
            return Err(NotAnArm::Joints(chain.joints.len()));
        }
        for joint in &chain.joints {
            let l = joint.limits;
            let sane = l.lower < l.upper && l.upper - l.lower < 8.0 * PI && l.velocity > 0.0;
            if !sane || !l.velocity.is_finite() {
                return Err(NotAnArm::Limits(joint.name.clone()));
            }
        }
        let tip = chain.forward(&[0.0; 6]);
        if !tip.to_homogeneous().iter().all(|v| v.is_finite()) {
            return Err(NotAnArm::Family("its lengths are not finite numbers"));
        }
        let (parameters, root_from_base) = measure(&chain)?;
        let solver = OPWKinematics::new(parameters);
        let flange = solver.try_forward(&[0.0; 6]).map_err(|_| NotAnArm::Family("it overflows"))?;
        let tip_from_flange = tip.inverse() * root_from_base * from_pose(&flange);
        let arm = Self { chain, solver, root_from_base, tip_from_flange };
        arm.check_postures()?;
        Ok(arm)
    }

    /// The chain that it was made from.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    /// `root_from_tip` at these angles.
    pub fn forward(&self, joints: &JointAngles) -> Transform {
        self.chain.forward(joints)
    }

    /// Whether every angle is within its joint's range.
    pub fn within_limits(&self, joints: &JointAngles) -> bool {
        self.chain.joints.iter().zip(joints).all(|(j, &q)| j.limits.contains(q))
    }

    /// All solutions within the limits, the one that is nearest to `near` first; angles of joints
    /// that turn further than once round are taken nearest to `near`. Empty when out of reach.
    pub fn solutions(&self, root_from_tip: &Transform, near: &JointAngles) -> Vec<JointAngles> {
        let base_from_flange = self.root_from_base.inverse() * root_from_tip * self.tip_from_flange;
        let Some(pose) = to_pose(&base_from_flange) else { return Vec::new() };
        let mut solutions: Vec<JointAngles> = self
            .solver
            .inverse_continuing(&pose, near)
            .into_iter()
            .filter_map(|raw| self.unwind(raw, near))
            .filter(|joints| deviation(&self.forward(joints), root_from_tip) < EXACT)
            .collect();
        let far = |q: &JointAngles| distance(q, near);
        solutions.sort_by(|a, b| far(a).total_cmp(&far(b)));
        solutions.dedup_by(|a, b| distance(a, b) < 1e-9);
        solutions
    }

    /// Whole turns added so that each angle is in its range and as near as can be to `near`.
    fn unwind(&self, raw: JointAngles, near: &JointAngles) -> Option<JointAngles> {
        let mut joints = raw;
        for k in 0..6 {
            let limits = self.chain.joints[k].limits;
            let nearest = raw[k] + TAU * ((near[k] - raw[k]) / TAU).round();
            joints[k] = [nearest, nearest - TAU, nearest + TAU]
                .into_iter()
                .filter(|&q| limits.contains(q))
                .min_by(|a, b| (a - near[k]).abs().total_cmp(&(b - near[k]).abs()))?;
        }
        Some(joints)
    }

    /// Forward kinematics of chain and solver must agree everywhere, not only at zero.
    fn check_postures(&self) -> Result<(), NotAnArm> {
        for n in 0..24 {
            let mut joints = [0.0; 6];
            for (k, q) in joints.iter_mut().enumerate() {
                *q = 2.0 * f64::sin(1.7 * n as f64 + 2.3 * k as f64);
            }
            let flange =
                self.solver.try_forward(&joints).map_err(|_| NotAnArm::Family("it overflows"))?;
            let tip = self.root_from_base * from_pose(&flange) * self.tip_from_flange.inverse();
            if deviation(&tip, &self.forward(&joints)) > EXACT {
                return Err(NotAnArm::Family("its axes do not fit the model"));
            }
        }
        Ok(())
    }
}

/// Largest difference of any joint (rad).
pub fn distance(a: &JointAngles, b: &JointAngles) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn deviation(a: &Transform, b: &Transform) -> f64 {
    let shift = (a.translation.vector - b.translation.vector).norm();
    shift.max(a.rotation.angle_to(&b.rotation))
}

/// The solver's parameters and where its base sits in the root.
fn measure(chain: &Chain) -> Result<(Parameters, Transform), NotAnArm> {
    let frames = chain.frames(&[0.0; 6]);
    let axis = |k: usize| frames[k].rotation * chain.joints[k].axis.into_inner();
    let point = |k: usize| frames[k].translation.vector;
    let (z, y) = (axis(0), axis(1));
    if z.dot(&y).abs() > EXACT {
        return Err(NotAnArm::Family("axis 2 is not at right angles to axis 1"));
    }
    let root_from_base = Transform::from_parts(
        Translation3::from(point(0)),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(
            Matrix3::from_columns(&[y.cross(&z), y, z]),
        )),
    );
    // From here on everything in the solver's base: z along axis 1, y along axis 2.
    let to_base = root_from_base.rotation.inverse();
    let direction = |k: usize| to_base * axis(k);
    let place = |k: usize| to_base * (point(k) - point(0));
    let sign3 = direction(2).y;
    if (sign3.abs() - 1.0).abs() > EXACT {
        return Err(NotAnArm::Family("axes 2 and 3 are not parallel"));
    }
    let wrist =
        wrist_centre([place(3), place(4), place(5)], [direction(3), direction(4), direction(5)])?;
    let (shoulder, elbow) = (place(1), place(2));
    let upper = elbow - shoulder;
    let lower = wrist - elbow;
    // The forearm's z: axis 4, taken so that it points from the elbow to the wrist.
    let sign4 = if direction(3).dot(&lower) < 0.0 { -1.0 } else { 1.0 };
    let forearm = direction(3) * sign4;
    if forearm.y.abs() > EXACT {
        return Err(NotAnArm::Family("axis 4 is not at right angles to axis 3"));
    }
    let lean2 = upper.x.atan2(upper.z);
    let lean23 = forearm.x.atan2(forearm.z);
    let forearm_from_base = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -lean23);
    let in_forearm = forearm_from_base * Vector3::new(lower.x, 0.0, lower.z);
    let five = forearm_from_base * direction(4);
    if five.z.abs() > EXACT {
        return Err(NotAnArm::Family("axis 5 is not at right angles to axis 4"));
    }
    // Turn of axis 5 about axis 4 away from y, then of axis 6 about axis 5 away from the forearm.
    let turn4 = (-five.x).atan2(five.y);
    let six = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -turn4)
        * (forearm_from_base * direction(5));
    let turn5 = six.x.atan2(six.z);
    let parameters = Parameters {
        a1: shoulder.x,
        a2: in_forearm.x,
        // Exactly zero for the solver's singular cases, not a rounding error.
        b: if wrist.y.abs() < 1e-12 { 0.0 } else { wrist.y },
        c1: shoulder.z,
        c2: upper.x.hypot(upper.z),
        c3: in_forearm.z,
        c4: 0.0,
        offsets: [0.0, -lean2, -wrap(lean23 - lean2), -turn4, -turn5, 0.0],
        sign_corrections: [1, 1, sign3.signum() as i8, sign4 as i8, 1, 1],
        dof: 6,
    };
    Ok((parameters, root_from_base))
}

/// Where axes 4, 5 and 6 meet.
fn wrist_centre(
    points: [Vector3<f64>; 3],
    axes: [Vector3<f64>; 3],
) -> Result<Vector3<f64>, NotAnArm> {
    // Normal equations of the point that is nearest to all three lines.
    let mut a = Matrix3::zeros();
    let mut b = Vector3::zeros();
    for (p, d) in points.iter().zip(&axes) {
        let across = Matrix3::identity() - d * d.transpose();
        a += across;
        b += across * p;
    }
    let centre = a.try_inverse().ok_or(NotAnArm::Family("the wrist's axes are parallel"))? * b;
    let off = |(p, d): (&Vector3<f64>, &Vector3<f64>)| (centre - p).cross(d).norm();
    match points.iter().zip(&axes).map(off).fold(0.0, f64::max) < EXACT {
        true => Ok(centre),
        false => Err(NotAnArm::Family("axes 4, 5 and 6 do not meet in one point")),
    }
}

fn wrap(angle: f64) -> f64 {
    angle - TAU * (angle / TAU).round()
}

fn from_pose(pose: &Pose) -> Transform {
    let (t, q) = (pose.translation, pose.rotation);
    Transform::from_parts(
        Translation3::new(t.x, t.y, t.z),
        UnitQuaternion::from_quaternion(Quaternion::new(q.w, q.x, q.y, q.z)),
    )
}

/// `None` when a number is not finite. The library's vectors are of another crate: numbers cross.
fn to_pose(transform: &Transform) -> Option<Pose> {
    let (t, q) = (transform.translation.vector, transform.rotation.coords);
    let mut pose = Pose::IDENTITY;
    (pose.translation.x, pose.translation.y, pose.translation.z) = (t.x, t.y, t.z);
    (pose.rotation.x, pose.rotation.y, pose.rotation.z, pose.rotation.w) = (q.x, q.y, q.z, q.w);
    Pose::try_from_parts(pose.translation, pose.rotation).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::path::Path;
    use vergence_devices::Description;

    fn arm() -> Arm {
        let text = include_str!("../assets/arm.urdf");
        let description = Description::parse(text, Path::new("arm.urdf")).unwrap();
        Arm::new(description.chain("base", "tcp").unwrap()).unwrap()
    }

    fn angles() -> impl Strategy<Value = JointAngles> {
        // Within the limits of every joint, the wrist's singularity at zero included.
        prop::array::uniform6(-1.3f64..1.3).prop_map(|mut q| {
            q[4] = if q[4].abs() < 0.2 { 0.0 } else { q[4] };
            q
        })
    }

    proptest! {
        #[test]
        fn forward_of_every_solution_is_the_pose(q in angles()) {
            let arm = arm();
            let pose = arm.forward(&q);
            let solutions = arm.solutions(&pose, &q);
            prop_assert!(!solutions.is_empty());
            prop_assert!(distance(&solutions[0], &q) < 1e-5, "{solutions:?} against {q:?}");
            for s in solutions {
                prop_assert!(arm.within_limits(&s));
                prop_assert!(deviation(&arm.forward(&s), &pose) < EXACT);
            }
        }
    }

    #[test]
    fn there_are_eight_solutions_in_the_open_and_none_out_of_reach() {
        let arm = arm();
        let down = UnitQuaternion::from_euler_angles(PI, 0.0, 0.0);
        let at = |x: f64| Transform::from_parts(Translation3::new(x, -0.38, 0.45), down);
        let unlimited = |mut arm: Arm| {
            for joint in &mut arm.chain.joints {
                (joint.limits.lower, joint.limits.upper) = (-3.2, 3.2);
            }
            arm
        };
        assert_eq!(unlimited(arm.clone()).solutions(&at(0.55), &[0.1; 6]).len(), 8);
        assert!(arm.solutions(&at(1.6), &[0.0; 6]).is_empty());
        assert!(arm.solutions(&at(f64::NAN), &[0.0; 6]).is_empty());
    }

    #[test]
    fn other_arms_are_refused_with_the_reason() {
        let chain = arm().chain().clone();
        let refused = |change: fn(&mut Chain)| {
            let mut chain = chain.clone();
            change(&mut chain);
            Arm::new(chain).err()
        };
        assert_eq!(refused(|c| c.joints.truncate(5)), Some(NotAnArm::Joints(5)));
        assert_eq!(
            refused(|c| c.joints[5].parent_from_joint.translation.vector.y += 0.01),
            Some(NotAnArm::Family("axes 4, 5 and 6 do not meet in one point"))
        );
        assert_eq!(
            refused(|c| c.joints[2].axis = Vector3::x_axis()),
            Some(NotAnArm::Family("axes 2 and 3 are not parallel"))
        );
        assert_eq!(
            refused(|c| c.joints[0].parent_from_joint.translation.vector.x = f64::NAN),
            Some(NotAnArm::Family("its lengths are not finite numbers"))
        );
        let limits = refused(|c| c.joints[3].limits.velocity = 0.0);
        assert_eq!(limits, Some(NotAnArm::Limits("arm_joint_4".into())));
    }

    #[test]
    fn signs_and_zero_positions_of_the_urdf_do_not_matter() {
        let mut chain = arm().chain().clone();
        for k in [1, 2, 3, 5] {
            chain.joints[k].axis = -chain.joints[k].axis;
        }
        for joint in &mut chain.joints {
            let turn = UnitQuaternion::from_axis_angle(&joint.axis, 0.4);
            joint.parent_from_joint.rotation *= turn;
            (joint.limits.lower, joint.limits.upper) = (-3.2, 3.2);
        }
        let arm = Arm::new(chain).unwrap();
        let q = [0.3, -0.2, 0.5, 0.7, -0.6, 1.1];
        let solutions = arm.solutions(&arm.forward(&q), &q);
        assert!(distance(&solutions[0], &q) < 1e-6, "{solutions:?}");
    }
}
