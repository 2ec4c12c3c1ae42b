//! Time stamp and number of each picture of a stream.
//!
//! In: when a picture's header arrived (our clock) and the camera's own stamp, if it sends one. Out: when
//! the picture was taken on our clock, and its running number with those counted that were lost.
//!
//! Method: the smallest arrival delay of the last seconds is taken for the transport's constant part,
//! so a stamp is late by that part but even; the caller takes off what it knows of it. The median step
//! between two stamps tells how many pictures a longer step lost. Promise: stamps and numbers grow strictly while arrivals do.

use std::collections::VecDeque;
use std::time::Duration;

/// Pictures over which the smallest delay is sought: ten seconds at 30 a second.
const DELAY_WINDOW: usize = 300;
/// Steps whose median is the camera's interval, and how many are needed for one.
const STEPS: usize = 15;
const FEWEST_STEPS: usize = 4;
/// A gap of more intervals is another run of the camera; its pictures are not counted.
const LONGEST_GAP: f64 = 1000.0;

/// What is known of a stream's times.
#[derive(Debug, Default)]
pub(super) struct Timing {
    /// Arrival minus the camera's stamp (s) of the last pictures.
    delays: VecDeque<f64>,
    /// Between the last stamps of the camera (s).
    steps: VecDeque<f64>,
    camera: Option<f64>,
    stamp: Option<Duration>,
    next: u64,
}

impl Timing {
    /// The camera's clock may be another from now on.
    pub(super) fn forget_clock(&mut self) {
        self.delays.clear();
        self.camera = None;
    }

    /// Stamp and number of a picture.
    pub(super) fn place(&mut self, arrival: Duration, camera: Option<f64>) -> (Duration, u64) {
        let mut stamp = camera.map_or(arrival, |camera| self.on_our_clock(arrival, camera));
        if self.stamp.is_some_and(|last| stamp <= last) {
            // The camera's clock was set back. (Set ahead, it makes the smallest delay at once.)
            self.forget_clock();
            stamp = camera.map_or(arrival, |camera| self.on_our_clock(arrival, camera));
        }
        let sequence = self.next + camera.map_or(0, |camera| self.lost_before(camera));
        self.camera = camera;
        self.stamp = Some(stamp);
        self.next = sequence + 1;
        (stamp, sequence)
    }

    fn on_our_clock(&mut self, arrival: Duration, camera: f64) -> Duration {
        let delay = arrival.as_secs_f64() - camera;
        self.delays.push_back(delay);
        if self.delays.len() > DELAY_WINDOW {
            self.delays.pop_front();
        }
        let least = self.delays.iter().copied().fold(f64::INFINITY, f64::min);
        Duration::try_from_secs_f64(camera + least).unwrap_or(arrival)
    }

    /// Pictures that were lost between the last one and that of this stamp of the camera.
    fn lost_before(&mut self, camera: f64) -> u64 {
        let step = camera - self.camera.unwrap_or(camera);
        if step <= 0.0 {
            return 0;
        }
        let mut sorted: Vec<f64> = self.steps.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        self.steps.push_back(step);
        if self.steps.len() > STEPS {
            self.steps.pop_front();
        }
        if sorted.len() < FEWEST_STEPS {
            return 0;
        }
        let intervals = step / sorted[sorted.len() / 2];
        if intervals > LONGEST_GAP { 0 } else { (intervals.round() as u64).saturating_sub(1) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seconds(s: f64) -> Duration {
        Duration::from_secs_f64(s)
    }

    #[test]
    fn lost_pictures_are_counted_and_late_ones_are_not_lost() {
        let mut timing = Timing::default();
        let mut numbers = Vec::new();
        for k in [0u32, 1, 2, 3, 4, 5, 8, 9] {
            let taken = 0.1 * f64::from(k);
            let late = if k == 5 { 0.25 } else { 0.01 };
            numbers.push(timing.place(seconds(10.0 + taken + late), Some(500.0 + taken)).1);
        }
        assert_eq!(numbers, [0, 1, 2, 3, 4, 5, 8, 9]);
    }

    #[test]
    fn stamps_grow_when_the_cameras_clock_is_set() {
        let mut timing = Timing::default();
        let mut last = Duration::ZERO;
        for k in 0..40u32 {
            let taken = 0.05 * f64::from(k);
            // Set back by 0.4 s, later ahead by 0.7 s, then by an hour.
            let set = [0.0, -0.4, 0.3, 3600.0][k as usize / 10];
            let (stamp, _) = timing.place(seconds(20.0 + taken + 0.01), Some(700.0 + taken + set));
            assert!(stamp > last, "picture {k}: {stamp:?} after {last:?}");
            let off = stamp.as_secs_f64() - (20.0 + taken);
            assert!(off.abs() < 0.02, "picture {k} is stamped {off} s late");
            last = stamp;
        }
    }
}
