//! What all virtual controllers share: who is there, who hears whom, what happens next.
//!
//! The medium is a discrete-event simulation. Every change of the future is an entry in one agenda,
//! ordered by time and then by the order of entry; [`Air::run`] carries out what is due and waits on
//! `embassy-time` for the rest. Nothing else moves, so that a run on virtual time repeats exactly.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::future::poll_fn;
use std::pin::pin;
use std::rc::Rc;
use std::task::{Poll, Waker};
use std::time::Duration;

use embassy_time::{Instant, Timer};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::controller::{Controller, Device};
use crate::link::{Fate, Fragment, Link};

/// Number of a controller on its air, in the order of their making.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct DeviceId(pub(crate) usize);

/// How the air behaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AirConfig {
    /// Data waits for the link's connection events, as on a radio. Without it data travels as fast
    /// as the bits (1 Mbit/s), which is good for tests that are not about time.
    pub connection_events: bool,
    /// Largest data packet of the controllers (bytes): 251 of modern ones, 27 of the oldest.
    pub acl_bytes: u16,
    /// Data packets that a controller buffers.
    pub acl_packets: u8,
    /// Seed of advertising delays and of the controllers' random numbers.
    pub seed: u64,
}

impl Default for AirConfig {
    fn default() -> Self {
        AirConfig { connection_events: true, acl_bytes: 251, acl_packets: 4, seed: 1 }
    }
}

/// Something that will happen.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Event {
    /// A device advertises, unless its advertising was restarted since.
    Advertise { device: usize, generation: u32 },
    /// Data moves on a link.
    Exchange { link: u32 },
    /// A link looks whether it still hears its peer.
    Supervise { link: u32 },
    /// A link takes up new timing.
    Update { link: u32, timing: crate::hci::LinkTiming },
    /// Encryption starts, if the keys match.
    Encrypt { link: u32, matches: Option<bool> },
    /// A link ends.
    Drop { link: u32, reasons: [u8; 2] },
}

type Hearing = Box<dyn Fn(DeviceId, DeviceId) -> Option<i8>>;
type Fault = Box<dyn FnMut(&Fragment<'_>) -> Fate>;

pub(crate) struct Medium {
    pub config: AirConfig,
    pub devices: Vec<Device>,
    pub links: BTreeMap<u32, Link>,
    pub rng: Pcg32,
    pub hearing: Hearing,
    pub fault: Option<Fault>,
    agenda: BTreeMap<(u64, u64), Event>,
    entries: u64,
    next_link: u32,
    runner: Option<Waker>,
}

impl Medium {
    /// Enters an event at a time (us).
    pub fn at(&mut self, time: u64, event: Event) {
        self.entries += 1;
        self.agenda.insert((time, self.entries), event);
        if let Some(runner) = &self.runner {
            runner.wake_by_ref();
        }
    }

    /// Enters an event some time from now (us).
    pub fn after(&mut self, delay: u64, event: Event) {
        self.at(now_micros() + delay, event);
    }

    /// Signal strength (dBm) at which `to` hears `from`; `None` when it does not.
    pub fn rssi(&self, from: usize, to: usize) -> Option<i8> {
        let on = |device: usize| self.devices.get(device).is_some_and(|d| d.powered);
        if on(from) && on(to) { (self.hearing)(DeviceId(from), DeviceId(to)) } else { None }
    }

    pub fn new_link_id(&mut self) -> u32 {
        self.next_link += 1;
        self.next_link
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Advertise { device, generation } => self.advertise(device, generation),
            Event::Exchange { link } => self.exchange(link),
            Event::Supervise { link } => self.supervise(link),
            Event::Update { link, timing } => self.update_link(link, timing),
            Event::Encrypt { link, matches } => self.encrypt(link, matches),
            Event::Drop { link, reasons } => self.drop_link(link, reasons),
        }
    }

    /// The next event if it is due, else the time of the next one.
    fn due(&mut self) -> Result<Event, Option<u64>> {
        let Some(entry) = self.agenda.first_entry() else { return Err(None) };
        let time = entry.key().0;
        if time <= now_micros() { Ok(entry.remove()) } else { Err(Some(time)) }
    }
}

pub(crate) fn now_micros() -> u64 {
    Instant::now().as_micros()
}

/// The air between virtual controllers. Clones are the same air.
#[derive(Clone)]
pub struct Air(pub(crate) Rc<RefCell<Medium>>);

impl Air {
    /// Empty air, in which everybody hears everybody at -50 dBm.
    pub fn new(config: AirConfig) -> Self {
        Air(Rc::new(RefCell::new(Medium {
            config,
            devices: Vec::new(),
            links: BTreeMap::new(),
            rng: Pcg32::seed_from_u64(config.seed),
            hearing: Box::new(|_, _| Some(-50)),
            fault: None,
            agenda: BTreeMap::new(),
            entries: 0,
            next_link: 0,
            runner: None,
        })))
    }

    /// A new controller with this public address (most significant byte first).
    pub fn controller(&self, address: [u8; 6]) -> Controller {
        let mut medium = self.0.borrow_mut();
        let seed = medium.rng.random();
        medium.devices.push(Device::new(address, seed));
        Controller { air: self.clone(), device: medium.devices.len() - 1 }
    }

    /// Who hears whom: signal strength (dBm) of the first device at the second, `None` for silence.
    /// Asked at every transmission, so that devices may move.
    pub fn set_hearing(&self, hearing: impl Fn(DeviceId, DeviceId) -> Option<i8> + 'static) {
        self.0.borrow_mut().hearing = Box::new(hearing);
    }

    /// Decides the fate of every data fragment: faults for tests.
    pub fn set_fault(&self, fault: impl FnMut(&Fragment<'_>) -> Fate + 'static) {
        self.0.borrow_mut().fault = Some(Box::new(fault));
    }

    /// Cuts a device's power: it falls silent at once, its links die of their supervision timeout.
    pub fn power_off(&self, device: DeviceId) {
        let mut medium = self.0.borrow_mut();
        if let Some(device) = medium.devices.get_mut(device.0) {
            device.powered = false;
            device.reset();
        }
    }

    /// Carries out what happens on the air, for ever. Spawn it on the executor of the controllers.
    pub async fn run(self) {
        loop {
            let next = loop {
                let mut medium = self.0.borrow_mut();
                match medium.due() {
                    Ok(event) => medium.happen(event),
                    Err(next) => break next,
                }
            };
            let mut timer = pin!(next.map(|at| Timer::at(Instant::from_micros(at))));
            poll_fn(|cx| {
                let mut medium = self.0.borrow_mut();
                medium.runner = Some(cx.waker().clone());
                let soonest = medium.agenda.keys().next().map(|(time, _)| *time);
                if soonest != next {
                    return Poll::Ready(());
                }
                drop(medium);
                match timer.as_mut().as_pin_mut() {
                    Some(timer) => timer.poll(cx),
                    None => Poll::Pending,
                }
            })
            .await;
        }
    }

    /// Time since the air's epoch, for entries of logs in tests.
    pub fn now(&self) -> Duration {
        Duration::from_micros(now_micros())
    }
}
