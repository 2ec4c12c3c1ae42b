//! Tags that live in this process: the firmware on a virtual controller, with a flash in memory and
//! lights that are written down instead of lit.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use vergence_air::{Air, Controller, DeviceId, Executor, time};
use vergence_devices::TagAddress;
use vergence_firmware::{Battery, Board, Config, Lights, Store, Watchdog};
use vergence_tag::Pattern;

use crate::flash::MemoryFlash;
use crate::hci::Hci;
use crate::pool::HeapPool;

/// Erase blocks of a tag's flash.
const BLOCKS: usize = 4;

/// A tag of a simulation.
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

/// The light of a tag over some time, on the clock of the simulation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightPlay {
    /// When the first chip begins.
    pub begin: Duration,
    /// When the light goes out for good.
    pub end: Duration,
    /// What is played.
    pub pattern: Pattern,
}

type Log = Arc<Mutex<Vec<LightPlay>>>;

/// What the lights of all tags play and played. Plays are known ahead: each tells when it will end,
/// unless a later command or a lost link ends it, which is then told in its place.
#[derive(Debug, Clone)]
pub struct Plays {
    logs: Vec<Log>,
    clocks: Clocks,
}

/// One moment on two clocks, either of which may be ahead.
#[derive(Debug, Clone, Copy, Default)]
struct Clocks {
    radio: Duration,
    simulation: Duration,
}

impl Clocks {
    /// A time of the radio's on the clock of the simulation.
    fn simulation(self, radio: Duration) -> Duration {
        (radio + self.simulation).saturating_sub(self.radio)
    }
}

impl Plays {
    /// For this many tags, on the radio's own clock.
    pub(crate) fn new(tags: usize) -> Self {
        Plays { logs: (0..tags).map(|_| Log::default()).collect(), clocks: Clocks::default() }
    }

    /// All plays of a tag (its index) that are not forgotten, in order of time.
    pub fn of(&self, tag: usize) -> Vec<LightPlay> {
        let plays = |log: &Log| log.lock().unwrap_or_else(PoisonError::into_inner).clone();
        self.logs.get(tag).map(plays).unwrap_or_default()
    }

    /// Forgets plays that ended before a time, which no frame can show any more.
    pub fn forget_before(&self, time: Duration) {
        for log in &self.logs {
            log.lock().unwrap_or_else(PoisonError::into_inner).retain(|play| play.end >= time);
        }
    }

    /// The same on a clock that shows `simulation` now.
    pub(crate) fn on_clock(self, simulation: Duration) -> Self {
        Plays { clocks: Clocks { radio: time::now(), simulation }, ..self }
    }
}

/// Lights whose plays are written down.
struct LoggedLights {
    count: u8,
    log: Log,
    clocks: Clocks,
}

impl Lights for LoggedLights {
    fn count(&self) -> u8 {
        self.count
    }

    fn set(&mut self, _led: u8, _level: u8) {}

    fn playing(&mut self, play: Option<&vergence_firmware::Play>) {
        let mut log = self.log.lock().unwrap_or_else(PoisonError::into_inner);
        let at = |time: embassy_time::Instant| {
            self.clocks.simulation(Duration::from_micros(time.as_micros()))
        };
        match play {
            Some(play) => log.push(LightPlay {
                begin: at(play.begin),
                end: at(play.end),
                pattern: play.pattern,
            }),
            None => {
                if let Some(last) = log.last_mut() {
                    last.end = last.end.min(self.clocks.simulation(time::now())).max(last.begin);
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

/// Starts tags on an air; their controllers, in the same order.
pub(crate) fn spawn_tags(
    executor: &Executor,
    air: &Air,
    tags: Vec<VirtualTag>,
    plays: &Plays,
) -> Vec<DeviceId> {
    let start = |(tag, log): (VirtualTag, &Log)| {
        let controller = air.controller(tag.address.0);
        let id = controller.id();
        let lights = LoggedLights { count: tag.lights, log: log.clone(), clocks: plays.clocks };
        executor.spawn(run_tag(Hci::new(controller), tag, lights));
        id
    };
    tags.into_iter().zip(&plays.logs).map(start).collect()
}

/// One tag: the firmware on a board of memory.
async fn run_tag(controller: Hci<Controller>, tag: VirtualTag, lights: LoggedLights) {
    let flash = MemoryFlash::new(BLOCKS);
    let range = flash.range();
    let Ok(mut store) = Store::new(flash, range) else { return };
    if !tag.record.is_empty() && store.set_record(&tag.record).await.is_err() {
        return;
    }
    let mut address = tag.address.0;
    address.reverse();
    let config = Config { address, ..tag.config };
    let mut board = Board { lights, battery: FixedBattery(tag.battery), watchdog: NoWatchdog };
    // A virtual controller does not fail.
    let _ = vergence_firmware::run::<_, HeapPool, _, _, _, _>(
        controller, &config, &mut store, &mut board,
    )
    .await;
}
