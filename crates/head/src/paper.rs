//! Equation (1) of the paper: the distance of the light from the middle of the head.
//!
//! ```text
//! d = s/2 * 1 / sin((phi1 + phi2)/2) * sin(theta1) / sin((pi - theta1 - theta2)/2)
//! ```
//!
//! The paper does not print how the angles count. The reading under which the formula is right where
//! it can be: `s` is the distance of the two pan axes; `theta` is the pan angle from the baseline,
//! inside the triangle (both axes look straight ahead at pi/2, less means inwards); `phi` is the tilt
//! angle from the vertical (level is pi/2). Then `s/2 sin(theta)/cos(theta)` is the height of the
//! isosceles triangle of the two lines of sight in plan, and `1/sin(phi)` lifts it along the slope.
//!
//! So (1) is exact only for `theta1 == theta2` and level axes. Off these it errs by its own geometry,
//! noise and lever arms apart:
//!
//! - equal pans, light at slope `t` (tilt): too short by about `1/2 tan(t)^2 cos(theta)^2` of d,
//!   since `phi` is measured at the cameras and not in the middle: 0.2 % at 30 degrees and
//!   s = 0.2 m, d = 1 m;
//! - to one side the isosceles triangle is wrong: `theta1` alone stands in the numerator, so the
//!   same light gets another distance when left and right are exchanged, and the error grows with
//!   the bearing: at 30 degrees 5 % of 1 m and 10 % of 0.5 m (`docs/head.md` has the table).
//!
//! [`crate::triangulate`] has none of these errors; this function is here to be compared with.

/// The paper's angles of one fixation of both heads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaperAngles {
    /// Pan angles from the baseline, left and right (rad).
    pub theta: [f64; 2],
    /// Tilt angles from the upward vertical, left and right (rad).
    pub phi: [f64; 2],
}

impl PaperAngles {
    /// From pan (positive to the left) and tilt (positive downwards) of the left and right head.
    pub fn from_pan_tilt(left: [f64; 2], right: [f64; 2]) -> Self {
        let quarter = std::f64::consts::FRAC_PI_2;
        PaperAngles {
            theta: [quarter + left[0], quarter - right[0]],
            phi: [quarter + left[1], quarter + right[1]],
        }
    }
}

/// Equation (1): distance (m) of the light from the middle of a baseline of `baseline` metres.
/// `None` when the lines of sight do not meet in front (theta1 + theta2 >= pi) or are vertical.
pub fn paper_distance(angles: &PaperAngles, baseline: f64) -> Option<f64> {
    let [theta1, theta2] = angles.theta;
    let [phi1, phi2] = angles.phi;
    let apex = (std::f64::consts::PI - theta1 - theta2) / 2.0;
    let slope = ((phi1 + phi2) / 2.0).sin();
    if apex <= 1e-9 || slope <= 1e-9 || theta1.sin() <= 0.0 {
        return None;
    }
    Some(baseline / 2.0 / slope * theta1.sin() / apex.sin())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Angles of an ideal head (axes cross, no lever arms) that looks at (x, y, z) from the height 0.
    fn ideal(point: [f64; 3], baseline: f64) -> PaperAngles {
        let look = |camera_y: f64| {
            let (x, y, z) = (point[0], point[1] - camera_y, point[2]);
            [y.atan2(x), (-z).atan2(x.hypot(y))]
        };
        PaperAngles::from_pan_tilt(look(baseline / 2.0), look(-baseline / 2.0))
    }

    #[test]
    fn a_worked_case() {
        // 45 degrees inwards from both sides, level: the height of a right isosceles triangle over
        // its base of 2 m is 1 m.
        let quarter = std::f64::consts::FRAC_PI_4;
        let angles = PaperAngles { theta: [quarter; 2], phi: [2.0 * quarter; 2] };
        assert!((paper_distance(&angles, 2.0).unwrap() - 1.0).abs() < 1e-12);
        // The same under a slope of 30 degrees: 1 / sin(60 degrees).
        let angles = PaperAngles { phi: [std::f64::consts::FRAC_PI_3; 2], ..angles };
        assert!((paper_distance(&angles, 2.0).unwrap() - 2.0 / 3f64.sqrt()).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn exact_straight_ahead_and_level(x in 0.2f64..5.0, s in 0.05f64..0.5) {
            let d = paper_distance(&ideal([x, 0.0, 0.0], s), s).unwrap();
            prop_assert!((d - x).abs() < 1e-9 * x, "{d} against {x}");
        }

        #[test]
        fn slope_error_is_as_documented(x in 0.5f64..2.0, t in -0.6f64..0.6) {
            let (s, z) = (0.2, -x * t.tan());
            let angles = ideal([x, 0.0, z], s);
            let true_d = x.hypot(z);
            let error = paper_distance(&angles, s).unwrap() / true_d - 1.0;
            let predicted = -0.5 * (t.tan() * angles.theta[0].cos()).powi(2);
            prop_assert!(error <= 1e-12 && (error - predicted).abs() < 0.8 * predicted.abs() + 1e-9,
                "{error} against {predicted}");
        }
    }

    #[test]
    fn to_one_side_it_depends_on_which_head_is_first() {
        let point = [0.8, 0.5, 0.0];
        let left = paper_distance(&ideal(point, 0.2), 0.2).unwrap();
        let right = paper_distance(&ideal([0.8, -0.5, 0.0], 0.2), 0.2).unwrap();
        let d = 0.8f64.hypot(0.5);
        assert!((left - right).abs() > 0.05 * d, "{left} {right}");
    }

    #[test]
    fn diverging_lines_have_no_distance() {
        let angles = PaperAngles::from_pan_tilt([0.1, 0.0], [-0.1, 0.0]);
        assert_eq!(paper_distance(&angles, 0.2), None);
    }
}
