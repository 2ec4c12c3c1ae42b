//! The computer's own clock.

use std::time::{Duration, Instant};

use crate::traits::Clock;

/// Time since the program's start, monotonic. Copies count from the same start.
#[derive(Debug, Clone, Copy)]
pub struct SystemClock {
    epoch: Instant,
}

impl SystemClock {
    /// A clock whose epoch is now.
    pub fn start() -> Self {
        SystemClock { epoch: Instant::now() }
    }
}

impl Clock for SystemClock {
    fn now(&self) -> Duration {
        self.epoch.elapsed()
    }

    fn sleep(&self, duration: Duration) {
        std::thread::sleep(duration);
    }
}
