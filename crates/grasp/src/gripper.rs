//! What the hand is like, and how hard it must press.

use vergence_geometry::{Body, Chain, Solid};
use vergence_tag::Physical;

/// A parallel gripper in its tip's frame: z along the approach, y along the closing, x across both;
/// the origin lies midway between the fingertips.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gripper {
    /// Largest opening (m).
    pub opening: f64,
    /// Thickness of a finger along the closing (m).
    pub thickness: f64,
    /// Width of a finger across (m).
    pub width: f64,
    /// From the palm to the fingertips (m).
    pub depth: f64,
    /// Largest force (N).
    pub force: f64,
}

/// Why the hand could not be measured.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NoGripper {
    /// Other than two sliding boxes.
    #[error("the robot's solids have {0} sliding fingers made of a box, two are needed")]
    Fingers(usize),
    /// Fingers that do not slide along the tip's y axis.
    #[error("the fingers do not slide along the y axis of the tip \"{0}\"")]
    Axis(String),
}

impl Gripper {
    /// Measures the hand from the robot's bodies: the two that slide are the fingers. `travel` is how
    /// far one finger moves (m), `force` the largest force (N).
    pub fn measure(
        bodies: &[Body],
        chain: &Chain,
        travel: f64,
        force: f64,
    ) -> Result<Self, NoGripper> {
        let tip_from_last = chain.last_from_tip.inverse();
        let fingers: Vec<&Body> = bodies.iter().filter(|b| b.slide.norm() > 0.5).collect();
        let boxes: Vec<_> = fingers
            .iter()
            .filter_map(|body| match body.solid {
                Solid::Cuboid { half } => Some((body, half)),
                _ => None,
            })
            .collect();
        let [(a, half), _] = boxes[..] else { return Err(NoGripper::Fingers(boxes.len())) };
        let slide = tip_from_last.rotation * a.slide;
        if slide.y.abs() < 0.999 {
            return Err(NoGripper::Axis(a.name.clone()));
        }
        let turn = (tip_from_last * a.frame_from_solid).rotation.to_rotation_matrix();
        let size = turn.matrix().abs() * half * 2.0;
        Ok(Self { opening: 2.0 * travel, thickness: size.y, width: size.x, depth: size.z, force })
    }
}

/// How a material behaves between rubber-faced fingers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Coefficient of friction, cautious: dry, not clean.
    pub friction: f64,
    /// Squeezing force that is taken as borne when the record does not tell (N).
    pub strength: f64,
}

/// Friction against rubber and strength by the record's material; cautious when unknown.
pub fn surface(physical: &Physical) -> Surface {
    let material = physical.material.as_deref().unwrap_or("").to_lowercase();
    let (friction, strength) = match material.as_str() {
        "rubber" => (0.8, 60.0),
        "wood" | "cork" => (0.5, 100.0),
        "paper" | "cardboard" => (0.5, 30.0),
        "plastic" => (0.4, 60.0),
        "ceramic" | "stone" => (0.45, 100.0),
        "steel" | "aluminium" | "aluminum" | "metal" => (0.4, 120.0),
        "glass" => (0.35, 60.0),
        _ => (0.3, 40.0),
    };
    Surface { friction, strength: physical.strength.unwrap_or(strength) }
}

/// Levers of the object's weight about the contact.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Levers {
    /// From the line through both fingers to the centre of mass, level (m): twists the pads.
    pub twist: f64,
    /// Along the fingers' line, when both press on one wall (m): pries the fingers apart.
    pub pry: f64,
    /// Length of the contact along the approach (m): what resists the prying.
    pub contact: f64,
}

/// Radius at which a pad's friction resists twisting (m): a rubber pad 22 mm wide.
const TWIST_RADIUS: f64 = 0.008;

/// Force with which the fingers must press to hold `mass` (kg) with the given safety factor (N).
///
/// Both pads carry the weight by friction, `2 mu F >= m g`; a level offset of the centre of mass
/// twists the pads; a wall gripped at its edge pries them apart. The terms are added, which is
/// cautious: a pad that carries and twists at once does both with one friction.
pub fn needed_force(mass: f64, friction: f64, levers: &Levers, safety: f64) -> f64 {
    let weight = mass * 9.81;
    let carry = weight / (2.0 * friction);
    let twist = carry * levers.twist / TWIST_RADIUS;
    let pry = if levers.pry > 0.0 { weight * levers.pry / levers.contact.max(0.005) } else { 0.0 };
    safety * (carry + twist + pry)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;
    use vergence_devices::Description;

    #[test]
    fn the_hand_is_measured_from_the_urdf() {
        let text = include_str!("../assets/arm.urdf");
        let description = Description::parse(text, Path::new("arm.urdf")).unwrap();
        let chain = description.chain("base", "tcp").unwrap();
        let bodies = description.bodies("base", &chain).unwrap();
        let joints = description.gripper("hand").unwrap();
        let gripper = Gripper::measure(&bodies, &chain, joints.travel, joints.effort).unwrap();
        let wanted =
            Gripper { opening: 0.14, thickness: 0.012, width: 0.022, depth: 0.065, force: 100.0 };
        let close = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(close(gripper.opening, wanted.opening) && close(gripper.force, wanted.force));
        assert!(close(gripper.thickness, wanted.thickness), "{gripper:?}");
        assert!(close(gripper.width, wanted.width) && close(gripper.depth, wanted.depth));
        assert_eq!(Gripper::measure(&bodies[..3], &chain, 0.07, 1.0), Err(NoGripper::Fingers(0)));
    }

    #[test]
    fn force_of_a_worked_case() {
        // 0.3 kg, mu 0.45, centred: 0.3 * 9.81 / 0.9 = 3.27 N.
        let centred = needed_force(0.3, 0.45, &Levers::default(), 1.0);
        assert!((centred - 3.27).abs() < 1e-9);
        // Held by the rim 36 mm from the axis over 24 mm: 3.27 + 2.943 * 1.5 = 7.6845 N.
        let rim = Levers { pry: 0.036, contact: 0.024, twist: 0.0 };
        assert!((needed_force(0.3, 0.45, &rim, 1.0) - 7.6845).abs() < 1e-9);
    }
}
