//! Equation (1) of the paper over the workspace, next to exact triangulation.

use nalgebra::{Point3, Vector3};

use super::world::described_heads;
use crate::calibration::middle;
use crate::{PaperAngles, paper_distance};

/// Error of equation (1) for one light, angles free of noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EquationError {
    /// Distance from the middle of the head (m).
    pub distance: f64,
    /// Bearing of the light (rad), positive to the left.
    pub bearing: f64,
    /// Slope (rad), positive downwards.
    pub slope: f64,
    /// Relative error for an ideal head: axes that cross in the optical centre. `None` when the
    /// equation gives no distance.
    pub ideal: Option<f64>,
    /// Relative error with the lever arms of a real head (some centimetres).
    pub real: Option<f64>,
}

/// Errors over bearings and slopes at some distances.
pub fn equation_errors(baseline: f64) -> Vec<EquationError> {
    let heads = described_heads(baseline);
    let mut out = Vec::new();
    for distance in [0.5, 1.0, 2.0] {
        for slope_deg in [0.0f64, 30.0] {
            for bearing_deg in [0.0f64, 10.0, 20.0, 30.0, -30.0] {
                let (bearing, slope) = (bearing_deg.to_radians(), slope_deg.to_radians());
                let direction = Vector3::new(
                    slope.cos() * bearing.cos(),
                    slope.cos() * bearing.sin(),
                    -slope.sin(),
                );
                let relative = |angles: [[f64; 2]; 2]| {
                    let angles = PaperAngles::from_pan_tilt(angles[0], angles[1]);
                    paper_distance(&angles, baseline).map(|d| d / distance - 1.0)
                };
                let p = direction * distance;
                let ideal = relative([baseline / 2.0, -baseline / 2.0].map(|y| {
                    let y = p.y - y;
                    [y.atan2(p.x), (-p.z).atan2(p.x.hypot(y))]
                }));
                let light: Point3<f64> = middle(&heads) + p;
                let real = heads[0].look_at(&light).zip(heads[1].look_at(&light));
                let real = real.and_then(|(left, right)| relative([left, right]));
                out.push(EquationError { distance, bearing, slope, ideal, real });
            }
        }
    }
    out
}
