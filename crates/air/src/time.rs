//! The time of a radio thread: `embassy-time`'s driver over a clock that each thread owns.
//!
//! `embassy-time` knows one driver a process. This one keeps a clock and a list of timers per thread,
//! so that a real radio on one thread, a simulated workcell on another and the tests of a parallel
//! test run do not disturb each other. A thread starts on real time; [`use_virtual`] puts it on
//! virtual time, which stands still until [`Executor`](crate::Executor) moves it to the next timer:
//! the same events then happen at the same instants in every run.
//!
//! Futures that wait for a timer must stay on the thread that polls them first; the futures of this
//! project are not `Send`, which sees to that.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::OnceLock;
use std::task::Waker;
use std::time::{Duration, Instant};

// The stacks' wakers and cells need one implementation in the program: that of `std`.
use critical_section as _;
use embassy_time_driver::{Driver, TICK_HZ};

/// Ticks are microseconds: `embassy-time`'s default rate.
const TICKS_PER_MICRO: u64 = TICK_HZ / 1_000_000;

struct Timeline {
    /// `None` on real time.
    now: Option<u64>,
    timers: BTreeMap<u64, Vec<Waker>>,
}

thread_local! {
    static TIMELINE: RefCell<Timeline> =
        const { RefCell::new(Timeline { now: None, timers: BTreeMap::new() }) };
}

/// Puts this thread on virtual time that starts at `now`. Timers that were set before are forgotten.
pub fn use_virtual(now: Duration) {
    TIMELINE.with_borrow_mut(|line| {
        line.now = Some(ticks(now));
        line.timers.clear();
    });
}

/// This thread's time since its epoch: the start of the process, or what [`use_virtual`] said.
pub fn now() -> Duration {
    Duration::from_micros(now_ticks() / TICKS_PER_MICRO)
}

/// When the next timer of this thread is due.
pub(crate) fn next_timer() -> Option<Duration> {
    TIMELINE.with_borrow(|line| {
        line.timers.keys().next().map(|at| Duration::from_micros(at / TICKS_PER_MICRO))
    })
}

/// Moves virtual time ahead, never back; real time cannot be moved.
pub(crate) fn advance_to(time: Duration) {
    TIMELINE.with_borrow_mut(|line| {
        if let Some(now) = &mut line.now {
            *now = (*now).max(ticks(time));
        }
    });
}

/// This thread is on virtual time.
pub(crate) fn is_virtual() -> bool {
    TIMELINE.with_borrow(|line| line.now.is_some())
}

/// Wakes whoever waits for a time that has come; true when there was one.
pub(crate) fn fire() -> bool {
    let now = now_ticks();
    let due: Vec<Waker> = TIMELINE.with_borrow_mut(|line| {
        let later = line.timers.split_off(&(now + 1));
        std::mem::replace(&mut line.timers, later).into_values().flatten().collect()
    });
    let any = !due.is_empty();
    due.into_iter().for_each(Waker::wake);
    any
}

fn ticks(time: Duration) -> u64 {
    time.as_micros() as u64 * TICKS_PER_MICRO
}

fn now_ticks() -> u64 {
    static START: OnceLock<Instant> = OnceLock::new();
    // `try_with`: a future that is dropped while its thread ends may still ask for the time.
    TIMELINE
        .try_with(|line| line.borrow().now)
        .ok()
        .flatten()
        .unwrap_or_else(|| ticks(START.get_or_init(Instant::now).elapsed()))
}

struct ThreadTime;

impl Driver for ThreadTime {
    fn now(&self) -> u64 {
        now_ticks()
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        let _ = TIMELINE.try_with(|line| {
            let mut line = line.borrow_mut();
            let waiting = line.timers.entry(at).or_default();
            // A timer registers itself at every poll of its task.
            if !waiting.iter().any(|w| w.will_wake(waker)) {
                waiting.push(waker.clone());
            }
        });
    }
}

embassy_time_driver::time_driver_impl!(static DRIVER: ThreadTime = ThreadTime);
