//! Times. Both types count whole seconds downwards, so that `nanosec` is never negative.

crate::message::messages! {
    "builtin_interfaces";

    /// A point in time since the epoch of the recording's clock.
    #[derive(Copy, Eq, PartialOrd, Ord, Default)]
    Time {
        /// Whole seconds.
        sec: i32,
        /// Nanoseconds, below 10^9.
        nanosec: u32,
    }

    /// A span of time.
    #[derive(Copy, Eq, PartialOrd, Ord, Default)]
    Duration {
        /// Whole seconds.
        sec: i32,
        /// Nanoseconds, below 10^9.
        nanosec: u32,
    }
}

macro_rules! from_duration {
    ($($name:ident),*) => {$(
        impl From<std::time::Duration> for $name {
            /// Spans beyond 68 years do not fit ROS's 32 bits and stop at the largest value.
            fn from(time: std::time::Duration) -> Self {
                match i32::try_from(time.as_secs()) {
                    Ok(sec) => $name { sec, nanosec: time.subsec_nanos() },
                    Err(_) => $name { sec: i32::MAX, nanosec: 999_999_999 },
                }
            }
        }

        impl $name {
            /// The same as a `Duration`; `None` before zero or when `nanosec` is out of range.
            pub fn to_duration(self) -> Option<std::time::Duration> {
                let sec = u64::try_from(self.sec).ok()?;
                (self.nanosec < 1_000_000_000)
                    .then(|| std::time::Duration::new(sec, self.nanosec))
            }
        }
    )*};
}

from_duration!(Time, Duration);
