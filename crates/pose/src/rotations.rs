//! Sets of rotations to try: all of them, evenly spread, or those of a standing object.

use std::f64::consts::TAU;

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};

/// `count` rotations spread evenly over all rotations.
///
/// Super-Fibonacci spirals (Alexa, CVPR 2022): two golden angles on the Hopf tori, no table and no
/// clumping at poles. The largest gap is about `1.2 (8 pi^2 / count)^(1/3)` radians.
pub fn spread(count: usize) -> impl Iterator<Item = UnitQuaternion<f64>> {
    const PHI: f64 = std::f64::consts::SQRT_2;
    const PSI: f64 = 1.533_751_168_755_204_3;
    (0..count).map(move |i| {
        let s = i as f64 + 0.5;
        let t = s / count as f64;
        let (a, b) = (TAU * s / PHI, TAU * s / PSI);
        let (r, q) = (t.sqrt(), (1.0 - t).sqrt());
        UnitQuaternion::new_unchecked(Quaternion::new(
            q * b.cos(),
            r * a.sin(),
            r * a.cos(),
            q * b.sin(),
        ))
    })
}

/// How many rotations [`spread`] needs for a mean spacing (rad).
pub fn count_for_spacing(spacing: f64) -> usize {
    (TAU * TAU * 2.0 / spacing.powi(3)).ceil() as usize
}

/// Rotations `base_from_object` that put the object's direction `down` at the bottom and turn it
/// about the vertical `up` in `steps` even steps.
pub fn standing(
    up: Unit<Vector3<f64>>,
    down: Unit<Vector3<f64>>,
    steps: usize,
) -> impl Iterator<Item = UnitQuaternion<f64>> {
    let upright = UnitQuaternion::rotation_between(&down, &-up.into_inner())
        .unwrap_or_else(|| half_turn(&down));
    (0..steps)
        .map(move |k| UnitQuaternion::from_axis_angle(&up, TAU * k as f64 / steps as f64) * upright)
}

/// A half turn about some axis perpendicular to the given one.
fn half_turn(axis: &Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    let other = if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let across = Unit::new_normalize(axis.cross(&other));
    UnitQuaternion::from_axis_angle(&across, TAU / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_rotation_has_a_neighbour() {
        let spacing = 0.3;
        let grid: Vec<_> = spread(count_for_spacing(spacing)).collect();
        let worst = spread(997)
            .map(|q| UnitQuaternion::from_euler_angles(0.3, 0.2, 0.1) * q)
            .map(|q| grid.iter().map(|g| g.angle_to(&q)).fold(f64::INFINITY, f64::min))
            .fold(0.0, f64::max);
        assert!(worst < 0.85 * spacing, "largest gap {worst} at spacing {spacing}");
    }

    #[test]
    fn standing_puts_the_face_down() {
        for down in [Vector3::z_axis(), -Vector3::z_axis(), Vector3::x_axis()] {
            for q in standing(Vector3::z_axis(), down, 7) {
                assert!((q * down.into_inner() + Vector3::z()).norm() < 1e-12);
            }
        }
    }
}
