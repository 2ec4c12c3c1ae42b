//! Tags and robot in one process: the firmware, the host and the air between them on virtual time.
//!
//! A [`VirtualRadio`] is a thread that holds everything that is not `Send`, and that runs only while
//! a call of its [`HciLink`] is under way. A call brings the radio's time up to the robot's clock,
//! lets everything happen until the answer is there, and makes the robot's clock sleep for the time
//! that it took. So a run is a function of its inputs, and no faster or slower machine changes it.
//!
//! A tag's light is known ahead: [`VirtualRadio::plays`] tells when each play begins and will end,
//! unless a later command or a lost link ends it, which then is told in its place.

use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use vergence_air::{Air, AirConfig, Executor, time};
use vergence_devices::{Clock, DeviceError, TagAddress};
use vergence_firmware::{Battery, Board, Config, Lights, Store, Watchdog};
use vergence_tag::Pattern;

use crate::central::{self, LinkConfig};
use crate::flash::MemoryFlash;
use crate::hci::{Hci, HciLink, SimulatedRequest};
use crate::job::{Fault, Inbox};
use crate::pool::HeapPool;

/// Erase blocks of a tag's flash.
const BLOCKS: usize = 4;
/// Signal strength of guests (dBm).
const GUEST_RSSI: i8 = -50;

/// A tag of the simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct VirtualTag {
    /// Its address.
    pub address: TagAddress,
    /// Its record (CBOR); empty for a tag that was never written.
    pub record: Vec<u8>,
    /// Its LEDs.
    pub lights: u8,
    /// Battery level (percent).
    pub battery: u8,
    /// The owner's choices; its address is replaced by the one above.
    pub config: Config<'static>,
}

/// The light of a tag over some time, on the robot's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightPlay {
    /// When the first chip begins.
    pub begin: Duration,
    /// When the light goes out for good.
    pub end: Duration,
    /// What is played.
    pub pattern: Pattern,
}

/// How the simulated radio behaves.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RadioConfig {
    /// The air; its seed decides everything that is random.
    pub air: AirConfig,
    /// The robot's host.
    pub link: LinkConfig,
}

type Log = Arc<Mutex<Vec<LightPlay>>>;

/// Tags, robot and air.
pub struct VirtualRadio {
    requests: Sender<SimulatedRequest>,
    logs: Vec<Log>,
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
        let logs: Vec<Log> = tags.iter().map(|_| Log::default()).collect();
        let thread_logs = logs.clone();
        let started = std::thread::Builder::new()
            .name("virtual radio".into())
            .spawn(move || work(config, tags, thread_logs, now, hearing, guests, &incoming));
        started.map_err(|error| DeviceError::Disconnected {
            device: "virtual radio".into(),
            reason: error.to_string(),
        })?;
        Ok(VirtualRadio { requests, logs })
    }

    /// The robot's radio. Its calls move `clock` ahead by the time that they take.
    pub fn link(&self, clock: Arc<dyn Clock>) -> HciLink {
        HciLink::simulated(self.requests.clone(), clock)
    }

    /// All plays of a tag so far, in order of time.
    pub fn plays(&self, tag: usize) -> Vec<LightPlay> {
        let lock = |log: &Log| log.lock().unwrap_or_else(PoisonError::into_inner).clone();
        self.logs.get(tag).map(lock).unwrap_or_default()
    }

    /// Forgets plays that ended before a time, which no frame can show any more.
    pub fn forget_plays_before(&self, time: Duration) {
        for log in &self.logs {
            log.lock().unwrap_or_else(PoisonError::into_inner).retain(|play| play.end >= time);
        }
    }
}

/// Lights whose plays are written down.
struct LoggedLights {
    count: u8,
    log: Log,
}

impl Lights for LoggedLights {
    fn count(&self) -> u8 {
        self.count
    }

    fn set(&mut self, _led: u8, _level: u8) {}

    fn playing(&mut self, play: Option<&vergence_firmware::Play>) {
        let mut log = self.log.lock().unwrap_or_else(PoisonError::into_inner);
        let at = |instant: embassy_time::Instant| Duration::from_micros(instant.as_micros());
        match play {
            Some(play) => log.push(LightPlay {
                begin: at(play.begin),
                end: at(play.end),
                pattern: play.pattern,
            }),
            None => {
                if let Some(last) = log.last_mut() {
                    last.end = last.end.min(time::now()).max(last.begin);
                }
            }
        }
    }
}

struct FixedBattery(u8);

impl Battery for FixedBattery {
    fn level(&mut self) -> Option<u8> {
        Some(self.0)
    }
}

struct NoWatchdog;

impl Watchdog for NoWatchdog {
    fn feed(&mut self) {}
}

/// The radio's thread.
fn work(
    config: RadioConfig,
    tags: Vec<VirtualTag>,
    logs: Vec<Log>,
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
    for (tag, log) in tags.into_iter().zip(logs) {
        let controller = air.controller(tag.address.0);
        ids.push(controller.id());
        executor.spawn(run_tag(Hci::new(controller), tag, log));
    }
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

/// One tag: the firmware on a board of memory.
async fn run_tag(controller: Hci<vergence_air::Controller>, tag: VirtualTag, log: Log) {
    let flash = MemoryFlash::new(BLOCKS);
    let range = flash.range();
    let Ok(mut store) = Store::new(flash, range) else { return };
    if !tag.record.is_empty() && store.set_record(&tag.record).await.is_err() {
        return;
    }
    let mut address = tag.address.0;
    address.reverse();
    let config = Config { address, ..tag.config };
    let mut board = Board {
        lights: LoggedLights { count: tag.lights, log },
        battery: FixedBattery(tag.battery),
        watchdog: NoWatchdog,
    };
    // A virtual controller does not fail.
    let _ = vergence_firmware::run::<_, HeapPool, _, _, _, _>(
        controller, &config, &mut store, &mut board,
    )
    .await;
}
