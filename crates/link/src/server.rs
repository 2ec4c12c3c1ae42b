//! Tags on TCP: virtual controllers for anybody who speaks HCI, with virtual tags on the same air.
//!
//! Everybody who connects gets a Bluetooth controller of his own, as if he had opened a dongle. This
//! is how another program's stack, in whatever language, meets simulated tags; time is real.

use std::io;
use std::net::TcpListener;
use std::time::Duration;

use vergence_air::{Air, AirConfig, Executor, serve};

use crate::virtual_tag::{Plays, VirtualTag, spawn_tags};

/// Tags that are served on TCP for as long as the process lives.
pub struct TagServer {
    plays: Plays,
}

impl TagServer {
    /// Starts the tags. `now` is the time on the clock on which [`TagServer::plays`] shall be told;
    /// `hearing` tells the strength (dBm) of the signal between a tag (its index) and everybody who
    /// connects.
    pub fn start(
        listener: TcpListener,
        air: AirConfig,
        tags: Vec<VirtualTag>,
        now: Duration,
        hearing: impl Fn(usize) -> Option<i8> + Send + 'static,
    ) -> io::Result<Self> {
        let plays = Plays::new(tags.len()).on_clock(now);
        let thread_plays = plays.clone();
        std::thread::Builder::new().name("tag server".into()).spawn(move || {
            let executor = Executor::new();
            let air = Air::new(air);
            let ids = spawn_tags(&executor, &air, tags, &thread_plays);
            air.set_hearing(move |from, to| {
                let place = |device| ids.iter().position(|id| *id == device);
                match (place(from), place(to)) {
                    (Some(tag), None) | (None, Some(tag)) => hearing(tag),
                    _ => None,
                }
            });
            executor.spawn(air.clone().run());
            // Ends when the listener fails; on real time the executor never stalls.
            let _ = executor.block_on(serve(air, listener));
        })?;
        Ok(TagServer { plays })
    }

    /// The light of the tags.
    pub fn plays(&self) -> &Plays {
        &self.plays
    }
}
