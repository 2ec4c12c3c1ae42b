//! From a path to a trajectory: when the arm is where.
//!
//! In: a list of postures, so close together that the tool moves nearly straight between two. Out:
//! waypoints with times and speeds, at rest at both ends.
//!
//! Each step of the path has a shortest duration: that in which no joint exceeds its speed and the
//! tool does not exceed its own. Laid end to end these durations are a clock `u` in which the path
//! runs as fast as it may. Real time runs ahead of that clock by a trapezoid: `du/dt` rises from zero
//! to one over the ramp, stays, and falls to zero. So no limit is ever exceeded, whatever the path.

use vergence_geometry::{JointAngles, Trajectory, Waypoint};

use crate::collision::blend;
use crate::kinematics::{Arm, distance};

/// Step in time (s) in which the place on a trajectory is sought where the arm has stopped.
const STOPPED_STEP: f64 = 1e-3;

/// How fast the arm may move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Speeds {
    /// Of the tool's tip (m/s). The paper's arm moves at 50 mm/s.
    pub tool: f64,
    /// Of the tool's turning (rad/s).
    pub turning: f64,
    /// Part of each joint's own largest speed that is used: below one, so that the controller has
    /// something left to catch up with.
    pub joints: f64,
    /// Duration of the ramps at start and end (s): 50 mm/s in 0.25 s is 0.2 m/s^2, a spill-free start.
    pub ramp: f64,
    /// Time between waypoints (s).
    pub period: f64,
}

impl Default for Speeds {
    fn default() -> Self {
        Self { tool: 0.050, turning: 1.0, joints: 0.5, ramp: 0.25, period: 0.05 }
    }
}

/// Times a path. Empty for an empty path; a path that goes nowhere is one waypoint.
pub fn parameterise(arm: &Arm, path: &[JointAngles], speeds: &Speeds) -> Trajectory {
    let Some(first) = path.first() else { return Trajectory::default() };
    let clock = fastest(arm, path, speeds);
    let total = clock.last().copied().unwrap_or(0.0);
    if total <= 0.0 {
        let rest = Waypoint { time: 0.0, positions: *first, velocities: [0.0; 6] };
        return Trajectory { waypoints: vec![rest] };
    }
    // A trapezoid whose area is `total`; a triangle when the ramps alone cover it.
    let peak = f64::min(1.0, (total / speeds.ramp).sqrt());
    let ramp = speeds.ramp * peak;
    let duration = total / peak + ramp;
    let u = |t: f64| {
        let rising = |t: f64| 0.5 * t * t * peak / ramp;
        if t < ramp {
            rising(t)
        } else if t > duration - ramp {
            total - rising(duration - t)
        } else {
            peak * (t - 0.5 * ramp)
        }
    };
    let count = (duration / speeds.period).ceil().max(2.0) as usize;
    let times: Vec<f64> = (0..=count).map(|n| duration * n as f64 / count as f64).collect();
    let positions: Vec<JointAngles> = times.iter().map(|&t| at(path, &clock, u(t))).collect();
    let waypoint = |n: usize| {
        let mut velocities = [0.0; 6];
        if n > 0 && n < count {
            for (k, v) in velocities.iter_mut().enumerate() {
                *v = (positions[n + 1][k] - positions[n - 1][k]) / (times[n + 1] - times[n - 1]);
            }
        }
        Waypoint { time: times[n], positions: positions[n], velocities }
    };
    Trajectory { waypoints: (0..=count).map(waypoint).collect() }
}

/// The way back to the start of a trajectory on which the arm has stopped at a posture: the same postures in
/// the opposite order, timed anew, since the arm stands still and a controller refuses a start at speed.
pub fn back(arm: &Arm, way: &Trajectory, stands: &JointAngles, speeds: &Speeds) -> Trajectory {
    let time = nearest_time(way, stands);
    let before = way.waypoints.iter().rev().filter(|w| w.time < time).map(|w| w.positions);
    let path: Vec<JointAngles> = std::iter::once(*stands).chain(before).collect();
    parameterise(arm, &path, speeds)
}

/// The time of a trajectory at which it is nearest to a posture.
fn nearest_time(trajectory: &Trajectory, stands: &JointAngles) -> f64 {
    let far = |time: f64| trajectory.at(time).map_or(0.0, |w| distance(&w.positions, stands));
    let steps = (trajectory.duration() / STOPPED_STEP).ceil() as usize;
    let times = (0..=steps).map(|n| (n as f64 * STOPPED_STEP).min(trajectory.duration()));
    times.min_by(|a, b| far(*a).total_cmp(&far(*b))).unwrap_or(0.0)
}

/// Follows one trajectory by another that starts where the first ends.
pub fn append(first: &mut Trajectory, then: &Trajectory) {
    let start = first.duration();
    let skip = usize::from(!first.waypoints.is_empty());
    let shifted = then.waypoints.iter().skip(skip).map(|w| Waypoint { time: w.time + start, ..*w });
    first.waypoints.extend(shifted);
}

/// Shortest time from the start to each posture.
fn fastest(arm: &Arm, path: &[JointAngles], speeds: &Speeds) -> Vec<f64> {
    let mut clock = vec![0.0];
    let mut now = 0.0;
    for pair in path.windows(2) {
        let (a, b) = (arm.forward(&pair[0]), arm.forward(&pair[1]));
        let shift = (a.translation.vector - b.translation.vector).norm() / speeds.tool;
        let turn = a.rotation.angle_to(&b.rotation) / speeds.turning;
        let joints = arm.chain().joints.iter().zip(pair[0].iter().zip(&pair[1]));
        let joint = |(j, (p, q)): (&vergence_geometry::Joint, (&f64, &f64))| {
            (p - q).abs() / (j.limits.velocity * speeds.joints)
        };
        now += joints.map(joint).fold(shift.max(turn), f64::max);
        clock.push(now);
    }
    clock
}

fn at(path: &[JointAngles], clock: &[f64], u: f64) -> JointAngles {
    let next = clock.partition_point(|&c| c <= u).clamp(1, path.len() - 1);
    let span = clock[next] - clock[next - 1];
    let s = if span > 0.0 { ((u - clock[next - 1]) / span).clamp(0.0, 1.0) } else { 1.0 };
    blend(&path[next - 1], &path[next], s)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use vergence_devices::Description;

    use super::*;

    #[test]
    fn the_way_back_starts_and_ends_at_rest_and_keeps_the_limits() {
        let text = include_str!("../assets/arm.urdf");
        let description = Description::parse(text, Path::new("arm.urdf")).unwrap();
        let arm = Arm::new(description.chain("base", "tcp").unwrap()).unwrap();
        let (from, to) = ([-0.9, -0.6, 1.3, 0.0, 0.9, 0.0], [0.4, 0.2, 0.8, 0.3, 0.6, -0.5]);
        let path: Vec<JointAngles> =
            (0..=100).map(|n| blend(&from, &to, f64::from(n) / 100.0)).collect();
        let speeds = Speeds::default();
        let way = parameterise(&arm, &path, &speeds);
        // Stopped by a contact at full speed, a little beside the way.
        let stopped = way.at(0.6 * way.duration()).unwrap();
        assert!(stopped.velocities.iter().any(|v| v.abs() > 0.01), "{stopped:?}");
        let stands = stopped.positions.map(|q| q + 3e-4);
        let back = back(&arm, &way, &stands, &speeds);
        let (first, last) = (back.waypoints[0], back.waypoints[back.waypoints.len() - 1]);
        assert_eq!((first.positions, first.velocities), (stands, [0.0; 6]));
        assert_eq!(last.velocities, [0.0; 6]);
        assert!(distance(&last.positions, &from) < 1e-9, "{last:?}");
        let step = 1e-3;
        for n in 0..(back.duration() / step) as usize {
            let [a, b] = [n, n + 1].map(|n| back.at(n as f64 * step).unwrap());
            for (joint, v) in arm.chain().joints.iter().zip(b.velocities) {
                assert!(v.abs() <= joint.limits.velocity, "{} at {n}: {v}", joint.name);
            }
            let [p, q] = [a, b].map(|w| arm.forward(&w.positions).translation.vector);
            let speed = (p - q).norm() / step;
            assert!(speed < 1.1 * speeds.tool, "tool at {n} ms: {speed} m/s");
            // On the way that was free when the arm came.
            let near = path.windows(2).map(|w| distance(&w[0], &b.positions)).fold(1.0, f64::min);
            assert!(near < 0.02, "{near} rad off at {n} ms");
        }
    }

    #[test]
    fn an_arm_that_has_not_left_the_start_stays() {
        let text = include_str!("../assets/arm.urdf");
        let description = Description::parse(text, Path::new("arm.urdf")).unwrap();
        let arm = Arm::new(description.chain("base", "tcp").unwrap()).unwrap();
        let start = [-0.9, -0.6, 1.3, 0.0, 0.9, 0.0];
        let speeds = Speeds::default();
        let way = parameterise(&arm, &[start, start.map(|q| q + 0.01)], &speeds);
        assert_eq!(back(&arm, &way, &start, &speeds).waypoints.len(), 1);
    }
}
