//! Bringing the light to the centre of one picture in one or two moves.
//!
//! In: the angles now and the pixel where the light is. Out: the angles to go to. The first move is
//! the whole way (the kinematics are exact); the second corrects what the servos and the unknown
//! distance left. A servo that moves in steps cannot null the pixel, so the fixation ends when the
//! remaining turn is below a step, and the residual pixel stays in the ray
//! ([`crate::Fixation::pixel`]).
//!
//! Against backlash every joint arrives from below (smaller angles): then the slack lies on the same
//! side each time, a constant that calibration takes for part of the zero offset.

use nalgebra::Point2;

use crate::PanTiltHead;

/// What the fixation needs to know about the servos.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FixatorConfig {
    /// Smallest turn that the servos make (rad).
    pub resolution: f64,
    /// Slack of the gears (rad); zero switches the approach from one side off.
    pub backlash: f64,
    /// Moves after which the rest is left in the pixel. Two are enough for a head that is anywhere
    /// near its description; a third is for one that is not.
    pub max_moves: usize,
}

impl Default for FixatorConfig {
    /// A 12-bit servo with the 15 arcmin of backlash that its maker states.
    fn default() -> Self {
        FixatorConfig {
            resolution: std::f64::consts::TAU / 4096.0,
            backlash: 15f64.to_radians() / 60.0,
            max_moves: 3,
        }
    }
}

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum NextMove {
    /// Go to `goal`, by way of `via` when there is one; wait until both have come to rest.
    Go {
        /// A waypoint below the goal, from which every joint arrives upwards.
        via: Option<[f64; 2]>,
        /// Where to end.
        goal: [f64; 2],
    },
    /// The light is as near to the centre as the servos can bring it.
    Hold,
}

/// Plans the moves of one head towards one light.
#[derive(Debug, Clone)]
pub struct Fixator {
    config: FixatorConfig,
    moves: usize,
}

impl Fixator {
    /// Starts a fixation.
    pub fn new(config: FixatorConfig) -> Self {
        Fixator { config, moves: 0 }
    }

    /// What to do when the light is seen at `pixel` while the joints are at `angles`. `distance` (m)
    /// of the light from the camera, when known, see [`PanTiltHead::aim`].
    pub fn next(
        &mut self,
        head: &PanTiltHead,
        angles: [f64; 2],
        pixel: &Point2<f64>,
        distance: Option<f64>,
    ) -> NextMove {
        let goal = head.aim(angles, pixel, distance);
        let rest = (0..2).map(|k| (goal[k] - angles[k]).abs()).fold(0.0, f64::max);
        if rest < self.config.resolution || self.moves >= self.config.max_moves {
            return NextMove::Hold;
        }
        self.moves += 1;
        NextMove::Go { via: run_up(head, angles, goal, &self.config), goal }
    }

    /// Moves planned so far.
    pub fn moves(&self) -> usize {
        self.moves
    }
}

/// The waypoint from which a move to `goal` ends upwards in both joints by more than the slack;
/// `None` when the direct way does that already.
pub fn run_up(
    head: &PanTiltHead,
    angles: [f64; 2],
    goal: [f64; 2],
    config: &FixatorConfig,
) -> Option<[f64; 2]> {
    // Servos round both the waypoint and the goal to their steps: one step more keeps them apart.
    let length = 1.5 * config.backlash + config.resolution;
    if config.backlash <= 0.0 || (0..2).all(|k| goal[k] - angles[k] >= length) {
        return None;
    }
    let via = [0, 1].map(|k| match goal[k] - angles[k] >= length {
        true => angles[k],
        false => goal[k] - length,
    });
    Some(head.clamp(via))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::head;
    use nalgebra::Point3;
    use proptest::prelude::*;

    /// A servo that rounds to steps and whose shaft lags by the slack.
    struct Servo {
        step: f64,
        slack: f64,
        told: [f64; 2],
        shaft: [f64; 2],
    }

    impl Servo {
        fn go(&mut self, goal: [f64; 2]) {
            for k in 0..2 {
                self.told[k] = (goal[k] / self.step).round() * self.step;
                let half = self.slack / 2.0;
                self.shaft[k] = self.shaft[k].clamp(self.told[k] - half, self.told[k] + half);
            }
        }
    }

    proptest! {
        #[test]
        fn two_moves_centre_the_light_and_end_on_one_side(
            x in 0.5f64..2.0, y in -0.4f64..0.4, du in -0.4f64..0.4, dv in -0.3f64..0.3,
        ) {
            let (head, point) = (head(0.1), Point3::new(x, y, 0.4));
            let wanted = head.look_at(&point).unwrap();
            let config = FixatorConfig::default();
            let start = [wanted[0] + du, wanted[1] + dv];
            let mut servo =
                Servo { step: config.resolution, slack: config.backlash, told: start, shaft: start };
            let mut fixator = Fixator::new(config);
            loop {
                let pixel = head.project(servo.shaft, &point).unwrap();
                match fixator.next(&head, servo.told, &pixel, None) {
                    NextMove::Hold => break,
                    NextMove::Go { via, goal } => {
                        via.into_iter().for_each(|via| servo.go(via));
                        servo.go(goal);
                    }
                }
            }
            prop_assert!(fixator.moves() <= 3, "{} moves", fixator.moves());
            let pixel = head.project(servo.shaft, &point).unwrap();
            let off = (pixel - Point2::new(159.5, 119.5)).norm();
            prop_assert!(off < 300.0 * (2.0 * config.resolution + 1e-3), "{off} px");
            if fixator.moves() > 0 {
                for k in 0..2 {
                    let lag = servo.told[k] - servo.shaft[k];
                    prop_assert!((lag - config.backlash / 2.0).abs() < 1e-9, "joint {k}: {lag}");
                }
            }
        }
    }

    #[test]
    fn a_centred_light_needs_no_move() {
        let (head, point) = (head(0.1), Point3::new(1.0, 0.0, 0.4));
        let angles = head.look_at(&point).unwrap();
        let pixel = head.project(angles, &point).unwrap();
        let mut fixator = Fixator::new(FixatorConfig::default());
        assert_eq!(fixator.next(&head, angles, &pixel, None), NextMove::Hold);
    }
}
