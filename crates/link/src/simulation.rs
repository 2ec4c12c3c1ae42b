//! Tags and robot in one process: the firmware, the host and the air between them on virtual time.
//!
//! A [`VirtualRadio`] is a thread that holds everything that is not `Send`, and that runs only while
//! a call of its [`HciLink`], or of [`VirtualRadio::advance_to`], is under way. A call of the link
//! brings the radio's time up to the robot's clock, lets everything happen until the answer is there,
//! and makes the robot's clock sleep for the time that it took. So a run is a function of its inputs,
//! and no faster or slower machine changes it.
//!
//! A tag's light is known ahead: see [`Plays`]. What is told of the time before
//! [`VirtualRadio::advance_to`] is final.

use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, Sender};
use std::time::Duration;

use vergence_air::{Air, AirConfig, Executor, time};
use vergence_devices::{Clock, DeviceError};

use crate::central::{self, LinkConfig};
use crate::hci::{Hci, HciLink, SimulatedRequest};
use crate::job::{Answer, Fault, Inbox};
use crate::virtual_tag::{Plays, VirtualTag, spawn_tags};

/// Signal strength of guests (dBm).
const GUEST_RSSI: i8 = -50;

/// How the simulated radio behaves.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RadioConfig {
    /// The air; its seed decides everything that is random.
    pub air: AirConfig,
    /// The robot's host.
    pub link: LinkConfig,
}

/// Tags, robot and air.
#[derive(Debug)]
pub struct VirtualRadio {
    requests: Sender<SimulatedRequest>,
    plays: Plays,
}

impl VirtualRadio {
    /// Starts the tags at the time `now` of the robot's clock. `hearing` tells the strength (dBm) of
    /// the signal between the robot and a tag (its index), `None` out of range; it is asked at every
    /// transmission, from the radio's thread, while the robot waits.
    pub fn new(
        config: RadioConfig,
        tags: Vec<VirtualTag>,
        now: Duration,
        hearing: impl Fn(usize) -> Option<i8> + Send + 'static,
    ) -> Result<Self, DeviceError> {
        Self::with_guests(config, tags, now, hearing, |_, _| {})
    }

    /// The same with devices of the caller's own on the air, which everybody hears at -50 dBm, or
    /// with faults: `guests` is called on the radio's thread before anything runs.
    pub fn with_guests(
        config: RadioConfig,
        tags: Vec<VirtualTag>,
        now: Duration,
        hearing: impl Fn(usize) -> Option<i8> + Send + 'static,
        guests: impl FnOnce(&Executor, &Air) + Send + 'static,
    ) -> Result<Self, DeviceError> {
        let (requests, incoming) = mpsc::channel();
        let plays = Plays::new(tags.len());
        let thread_plays = plays.clone();
        let started = std::thread::Builder::new()
            .name("virtual radio".into())
            .spawn(move || work(config, tags, thread_plays, now, hearing, guests, &incoming));
        started.map_err(|error| DeviceError::Disconnected {
            device: "virtual radio".into(),
            reason: error.to_string(),
        })?;
        Ok(VirtualRadio { requests, plays })
    }

    /// The robot's radio. Its calls move `clock` ahead by the time that they take.
    pub fn link(&self, clock: Arc<dyn Clock>) -> HciLink {
        HciLink::simulated(self.requests.clone(), clock)
    }

    /// Lets everything happen up to a time of the robot's clock; the past is ignored.
    pub fn advance_to(&self, time: Duration) {
        let (reply, done) = mpsc::channel();
        if self.requests.send((time, None, reply)).is_ok() {
            // A radio thread that is gone has nothing more to tell.
            let _ = done.recv();
        }
    }

    /// The light of the tags.
    pub fn plays(&self) -> &Plays {
        &self.plays
    }
}

/// The radio's thread.
fn work(
    config: RadioConfig,
    tags: Vec<VirtualTag>,
    plays: Plays,
    now: Duration,
    hearing: impl Fn(usize) -> Option<i8> + 'static,
    guests: impl FnOnce(&Executor, &Air),
    requests: &Receiver<SimulatedRequest>,
) {
    time::use_virtual(now);
    let executor = Executor::new();
    let air = Air::new(config.air);
    let robot = air.controller([0, 0, 0, 0, 0, 1]);
    let mut ids = vec![robot.id()];
    ids.extend(spawn_tags(&executor, &air, tags, &plays));
    air.set_hearing(move |from, to| {
        let place = |device| ids.iter().position(|id| *id == device);
        match (place(from), place(to)) {
            // The robot comes first, the tags behind it; tags do not listen to each other.
            (Some(0), Some(tag)) | (Some(tag), Some(0)) => hearing(tag - 1),
            (Some(_), Some(_)) => None,
            _ => Some(GUEST_RSSI),
        }
    });
    guests(&executor, &air);
    executor.spawn(air.run());
    let inbox = Inbox::default();
    executor.spawn(central::run(Hci::new(robot), config.link, inbox.clone()));
    while let Ok((start, job, reply)) = requests.recv() {
        executor.run_until(start);
        let Some(job) = job else {
            let _ = reply.send((Ok(Answer::Done), time::now()));
            continue;
        };
        let (sender, receiver) = mpsc::channel();
        inbox.push(job, sender);
        let mut outcome = None;
        let ended = executor.run_while(|| {
            outcome = receiver.try_recv().ok();
            outcome.is_none()
        });
        let stalled = || Err(Fault::Dead(ended.err().map_or(String::new(), |e| e.to_string())));
        // Whoever no longer waits does not want the outcome.
        let _ = reply.send((outcome.unwrap_or_else(stalled), time::now()));
    }
}
