//! The thread between the kernel and the reader: buffers in, copies of the newest few out.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rustix::io::Errno;

use super::sys::{self, Device, Filled, Mapping};
use crate::traits::Clock;

/// Pictures kept for a reader that is busy for a moment.
const KEPT: usize = 4;
/// How long the thread waits before it looks whether it is still wanted.
const TICK: Duration = Duration::from_millis(100);
/// Rest before a poll that announced nothing is tried again.
const REST: Duration = Duration::from_millis(5);
/// A stream that breaks so often without a picture in between is given up.
const RESTARTS: u32 = 3;

/// What became of the frames so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Came undamaged.
    pub good: u64,
    /// Never came: the device or the kernel had no room or dropped them.
    pub lost: u64,
    /// Came damaged, by the device's own word or because they could not be read.
    pub damaged: u64,
    /// Came, but were replaced by newer ones before they were asked for.
    pub skipped: u64,
    /// Times the stream broke and was started again.
    pub restarts: u64,
}

/// Undecoded picture.
pub(super) struct Picture {
    pub bytes: Vec<u8>,
    pub stamp: Duration,
    pub sequence: u64,
}

/// How a stream ended for good.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum End {
    Unplugged(String),
    Broken(String),
}

#[derive(Default)]
pub(super) struct Shared {
    state: Mutex<State>,
    pub news: Condvar,
}

#[derive(Default)]
pub(super) struct State {
    pub pictures: VecDeque<Picture>,
    pub counts: Counts,
    pub end: Option<End>,
    pub stop: bool,
}

impl Shared {
    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Frame numbers that never go back, from the kernel's 32 bits, which do when a stream starts anew.
#[derive(Debug, Default)]
pub(super) struct Numbering {
    last: Option<(u32, u64)>,
    restarted: bool,
}

impl Numbering {
    /// The next number, and how many frames are missing before it.
    pub fn next(&mut self, raw: u32) -> (u64, u64) {
        let (number, missing) = match self.last {
            None => (u64::from(raw), 0),
            // At least one is gone; how many, nobody knows.
            Some((_, number)) if self.restarted => (number + 2, 1),
            Some((last, number)) => {
                let step = match raw.wrapping_sub(last) {
                    // A device that repeats numbers or counts backwards does not count.
                    0 | 0x8000_0000.. => 1,
                    step => u64::from(step),
                };
                (number + step, step - 1)
            }
        };
        self.restarted = false;
        self.last = Some((raw, number));
        (number, missing)
    }

    /// The kernel counts from zero again.
    pub fn restart(&mut self) {
        self.restarted = self.last.is_some();
    }
}

/// The kernel's monotonic clock and the robot's, read at one time.
#[derive(Debug, Clone, Copy)]
pub(super) struct ClockPair {
    monotonic: Duration,
    robot: Duration,
}

impl ClockPair {
    /// Reads both; of some tries, the one that took least.
    pub fn read(clock: &dyn Clock) -> Self {
        let tries = (0..5).map(|_| {
            let before = monotonic();
            let robot = clock.now();
            let took = monotonic().saturating_sub(before);
            (took, ClockPair { monotonic: before + took / 2, robot })
        });
        let best = tries.min_by_key(|(took, _)| *took);
        best.map_or(ClockPair { monotonic: Duration::ZERO, robot: Duration::ZERO }, |(_, p)| p)
    }

    /// A kernel stamp on the robot's clock.
    pub fn to_robot(self, stamp: Duration) -> Duration {
        match stamp.checked_sub(self.monotonic) {
            Some(later) => self.robot + later,
            None => self.robot.saturating_sub(self.monotonic - stamp),
        }
    }
}

/// The kernel's monotonic clock.
fn monotonic() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Duration::new(now.tv_sec.try_into().unwrap_or(0), now.tv_nsec.try_into().unwrap_or(0))
}

/// The thread's side.
pub(super) struct Reader {
    pub device: Device,
    pub buffers: Vec<Mapping>,
    pub shared: Arc<Shared>,
    pub clock: Arc<dyn Clock>,
    pub clocks: ClockPair,
    pub exposure: Duration,
    pub numbering: Numbering,
    /// Restarts since the last picture.
    pub restarts: u32,
}

impl Reader {
    /// Reads until nobody wants more or the device is gone.
    pub fn run(mut self) {
        let end = loop {
            if self.shared.lock().stop {
                return;
            }
            let outcome = match self.device.wait(TICK) {
                Ok(true) => self.take(),
                Ok(false) => Ok(()),
                Err(error) => Err(error),
            };
            let Err(error) = outcome else { continue };
            match error {
                Errno::NODEV | Errno::NXIO | Errno::BADF => {
                    break End::Unplugged(error.to_string());
                }
                error if self.restarts < RESTARTS => {
                    self.restarts += 1;
                    if let Err(again) = self.restart() {
                        break match again {
                            Errno::NODEV | Errno::NXIO => End::Unplugged(again.to_string()),
                            _ => End::Broken(format!("{error}, then {again}")),
                        };
                    }
                }
                error => break End::Broken(error.to_string()),
            }
        };
        self.shared.lock().end = Some(end);
        self.shared.news.notify_all();
    }

    /// Takes one filled buffer and gives it back.
    fn take(&mut self) -> rustix::io::Result<()> {
        let Some(filled) = self.device.dequeue()? else {
            std::thread::sleep(REST);
            return Ok(());
        };
        let arrival = self.clock.now();
        let bytes = match self.buffers.get(filled.index as usize) {
            Some(buffer) if filled.flags & sys::FLAG_ERROR == 0 => {
                buffer.copy(filled.bytes_used as usize)
            }
            _ => Vec::new(),
        };
        let (sequence, missing) = self.numbering.next(filled.sequence);
        let stamp = self.stamp(&filled, arrival);
        self.device.queue(filled.index)?;
        let mut state = self.shared.lock();
        state.counts.lost += missing;
        if bytes.is_empty() {
            state.counts.damaged += 1;
            return Ok(());
        }
        self.restarts = 0;
        state.counts.good += 1;
        state.pictures.push_back(Picture { bytes, stamp, sequence });
        if state.pictures.len() > KEPT {
            state.pictures.pop_front();
            state.counts.skipped += 1;
        }
        self.shared.news.notify_all();
        Ok(())
    }

    /// Start of the exposure on the robot's clock.
    fn stamp(&self, filled: &Filled, arrival: Duration) -> Duration {
        if filled.flags & sys::TIMESTAMP_MASK != sys::TIMESTAMP_MONOTONIC {
            return arrival;
        }
        let stamp = self.clocks.to_robot(filled.stamp);
        let start = match filled.flags & sys::STAMP_SOURCE_MASK {
            sys::STAMP_START_OF_EXPOSURE => stamp,
            _ => stamp.saturating_sub(self.exposure),
        };
        // Nothing is seen before it happens, whatever a device claims.
        start.min(arrival)
    }

    fn restart(&mut self) -> rustix::io::Result<()> {
        self.device.stop()?;
        for index in 0..self.buffers.len() {
            self.device.queue(index as u32)?;
        }
        self.device.start()?;
        self.numbering.restart();
        self.shared.lock().counts.restarts += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::SystemClock;

    #[test]
    fn numbers_never_go_back_and_show_what_is_missing() {
        let mut numbering = Numbering::default();
        let mut next = |raw| numbering.next(raw);
        assert_eq!(next(u32::MAX - 1), (u64::from(u32::MAX) - 1, 0));
        assert_eq!(next(u32::MAX), (u64::from(u32::MAX), 0));
        assert_eq!(next(0), (u64::from(u32::MAX) + 1, 0));
        assert_eq!(next(4), (u64::from(u32::MAX) + 5, 3));
        assert_eq!(next(4), (u64::from(u32::MAX) + 6, 0));
        assert_eq!(next(2), (u64::from(u32::MAX) + 7, 0));
        numbering.restart();
        assert_eq!(numbering.next(0), (u64::from(u32::MAX) + 9, 1));
        assert_eq!(numbering.next(1), (u64::from(u32::MAX) + 10, 0));
    }

    #[test]
    fn stamps_before_and_after_the_clocks_were_read_keep_their_distance() {
        let seconds = Duration::from_secs_f64;
        let clocks = ClockPair { monotonic: seconds(1000.0), robot: seconds(3.0) };
        assert_eq!(clocks.to_robot(seconds(1000.5)), seconds(3.5));
        assert_eq!(clocks.to_robot(seconds(999.0)), seconds(2.0));
        assert_eq!(clocks.to_robot(seconds(1.0)), Duration::ZERO);
        // The robot's clock runs as the kernel's.
        let clock = SystemClock::start();
        let clocks = ClockPair::read(&clock);
        let difference = clocks.to_robot(monotonic()).abs_diff(clock.now());
        assert!(difference < Duration::from_millis(50), "{difference:?}");
    }
}
