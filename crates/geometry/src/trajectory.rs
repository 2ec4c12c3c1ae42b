//! Timed joint angles of a six-axis arm: what a planner writes and an arm driver plays.

/// Angles of the six axes (rad), in the chain's order.
pub type JointAngles = [f64; 6];

/// One point of a trajectory, as in ROS `trajectory_msgs/JointTrajectoryPoint`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Waypoint {
    /// Seconds since the start.
    pub time: f64,
    /// Angles (rad).
    pub positions: JointAngles,
    /// Speeds (rad/s).
    pub velocities: JointAngles,
}

/// Waypoints with strictly rising times; between them a cubic joins angles and speeds, which is how
/// ROS joint trajectory controllers read such a list.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trajectory {
    /// The waypoints; the first is the start at time zero.
    pub waypoints: Vec<Waypoint>,
}

impl Trajectory {
    /// Seconds from start to end.
    pub fn duration(&self) -> f64 {
        self.waypoints.last().map_or(0.0, |w| w.time)
    }

    /// Angles and speeds at a time, held at the ends; `None` when there are no waypoints.
    pub fn at(&self, time: f64) -> Option<Waypoint> {
        let (first, last) = (self.waypoints.first()?, self.waypoints.last()?);
        if time <= first.time || time >= last.time {
            let end = if time <= first.time { first } else { last };
            return Some(Waypoint { time, ..*end });
        }
        let next = self.waypoints.partition_point(|w| w.time <= time);
        let (a, b) = (&self.waypoints[next - 1], &self.waypoints[next]);
        let span = b.time - a.time;
        let s = (time - a.time) / span;
        let mut point = Waypoint { time, ..*a };
        for k in 0..6 {
            let (p, q) = (a.positions[k], b.positions[k]);
            let (u, v) = (a.velocities[k] * span, b.velocities[k] * span);
            let (c2, c3) = (3.0 * (q - p) - 2.0 * u - v, 2.0 * (p - q) + u + v);
            point.positions[k] = p + s * (u + s * (c2 + s * c3));
            point.velocities[k] = (u + s * (2.0 * c2 + s * 3.0 * c3)) / span;
        }
        Some(point)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_reproduced() {
        let cubic = |t: f64| (t * t * t - 2.0 * t, 3.0 * t * t - 2.0);
        let waypoint =
            |t: f64| Waypoint { time: t, positions: [cubic(t).0; 6], velocities: [cubic(t).1; 6] };
        let trajectory = Trajectory { waypoints: [0.0, 0.7, 1.5].map(waypoint).to_vec() };
        for t in [0.0, 0.3, 0.7, 1.1, 1.5] {
            let point = trajectory.at(t).unwrap();
            assert!((point.positions[2] - cubic(t).0).abs() < 1e-12, "at {t}");
            assert!((point.velocities[2] - cubic(t).1).abs() < 1e-12, "at {t}");
        }
        assert_eq!(trajectory.at(9.0).unwrap().positions, waypoint(1.5).positions);
        assert!(Trajectory::default().at(0.0).is_none());
    }
}
