//! The tag itself: advertises, serves one robot at a time, plays its light, keeps its record.
//!
//! ```text
//!   advertise fast -> advertise slow -> link: serve, play -> (light off) -> advertise fast ...
//! ```
//! [`run`] never returns unless the controller fails; a board resets then.

use core::cell::{Cell, RefCell};
use core::convert::Infallible;

use embassy_futures::select::{Either, Either3, select, select3};
use embassy_time::{Duration, Instant, Timer, with_timeout};
use embedded_storage_async::nor_flash::NorFlash;
use trouble_host::advertise::{Advertisement, AdvertisementParameters};
use trouble_host::att::{AttClient, AttErrorCode};
use trouble_host::connection::{Connection, SecurityLevel};
use trouble_host::gatt::{GattConnection, GattConnectionEvent, GattEvent, WriteEvent};
use trouble_host::peripheral::Peripheral;
use trouble_host::{
    Address, BleHostError, BondInformation, Controller, Error, HostResources, IoCapabilities,
    PacketPool, Stack,
};
use vergence_tag::cbor::{self, MAX_BYTES};
use vergence_tag::upload::crc32;
use vergence_tag::{Command, State, Text, Upload, beacon, gatt};

use crate::board::{Battery, Board, Lights, Watchdog};
use crate::config::Config;
use crate::guard::Guard;
use crate::led::{self, Remote};
use crate::server::{Server, Target, Values};
use crate::store::{BONDS, Store};

/// How often the watchdog is fed.
const FEEDING: Duration = Duration::from_secs(8);
/// Time for the last packets of a link.
const FAREWELL: Duration = Duration::from_millis(200);
/// Longest time in which a link ends: the longest supervision timeout there is.
const LONGEST_FAREWELL: Duration = Duration::from_secs(32);
/// Wait after the first failed pairing; doubles with every further one.
const FIRST_PENALTY: Duration = Duration::from_secs(2);
/// Most doublings: 17 minutes, 6 hours for the 20 digits of a passkey.
const LONGEST_PENALTY: u32 = 9;

/// Why a tag stopped: its controller no longer answers.
#[derive(Debug)]
pub struct Stopped<E>(pub BleHostError<E>);

/// What the parts of a running tag share.
struct Tag<'a, 'v, P: PacketPool, F: NorFlash, L, B, W> {
    config: &'a Config<'v>,
    server: &'a Server<'v, P>,
    remote: &'a Remote,
    store: &'a mut Store<F>,
    lights: &'a mut L,
    battery: &'a mut B,
    watchdog: &'a RefCell<&'a mut W>,
    /// The record in force, or the one that is being uploaded.
    record: &'a mut [u8; MAX_BYTES],
    object_id: Text,
    battery_level: Option<u8>,
    pairing: Pairing,
}

/// Runs a tag on a controller for ever. `P` is the memory pool of trouble-host; its packets must
/// hold 251 bytes.
pub async fn run<C, P, F, L, B, W>(
    controller: C,
    config: &Config<'_>,
    store: &mut Store<F>,
    board: &mut Board<L, B, W>,
) -> Result<Infallible, Stopped<C::Error>>
where
    C: Controller,
    P: PacketPool,
    F: NorFlash,
    L: Lights,
    B: Battery,
    W: Watchdog,
{
    let mut resources: HostResources<P, 1, 2, 1, { BONDS + 1 }> = HostResources::new();
    let io = match config.passkey {
        Some(_) => IoCapabilities::DisplayOnly,
        None => IoCapabilities::NoInputNoOutput,
    };
    let stack = trouble_host::new(Guard::<C, 1>::new(controller), &mut resources)
        .set_random_address(Address::random(config.address))
        .set_io_capabilities(io)
        .set_passkey(config.passkey)
        .build();
    for index in 0..BONDS {
        // A bond that cannot be read is a robot that must pair again.
        if let Ok(Some(bond)) = store.bond(index).await
            && admits(config, bond.security_level)
        {
            let _ = stack.add_bond_information(bond);
        }
    }
    let mut values = Values::default();
    let server = Server::new(&mut values, config);
    let remote = Remote::default();
    let watchdog = RefCell::new(&mut board.watchdog);
    let mut record = [0; MAX_BYTES];
    let mut tag = Tag {
        config,
        server: &server,
        remote: &remote,
        store,
        lights: &mut board.lights,
        battery: &mut board.battery,
        watchdog: &watchdog,
        record: &mut record,
        object_id: Text::new(),
        battery_level: None,
        pairing: Pairing::default(),
    };
    let mut runner = stack.runner();
    let work = async {
        tag.load_record().await;
        loop {
            tag.cycle(&stack).await?;
        }
    };
    match select(runner.run(), work).await {
        Either::First(Ok(())) => Err(Stopped(Error::InvalidState.into())),
        Either::First(Err(error)) => Err(Stopped(error)),
        Either::Second(result) => result,
    }
}

/// A tag with a passkey has no use for pairings that went without it.
fn admits(config: &Config<'_>, level: SecurityLevel) -> bool {
    config.passkey.is_none() || level == SecurityLevel::EncryptedAuthenticated
}

/// Guesses at the passkey so far. Every failed pairing tells an attacker one more binary digit, so
/// that the next one must wait, twice as long every time; everything else is served meanwhile.
#[derive(Default)]
struct Pairing {
    failures: u32,
    again: Option<Instant>,
    /// The passkey is being tried.
    trying: bool,
}

impl Pairing {
    /// The link has ended. Whoever leaves in the middle may know one digit more as well.
    fn left(&mut self) {
        if self.trying {
            self.failed();
        }
    }

    /// Only a robot that knows the passkey clears the count.
    fn completed(&mut self, level: SecurityLevel) {
        if level == SecurityLevel::EncryptedAuthenticated {
            *self = Pairing::default();
        }
    }

    fn failed(&mut self) {
        self.trying = false;
        let wait = FIRST_PENALTY * (1 << self.failures.min(LONGEST_PENALTY));
        self.failures = self.failures.saturating_add(1);
        self.again = Some(Instant::now() + wait);
    }

    fn allowed(&self) -> bool {
        self.again.is_none_or(|again| Instant::now() >= again)
    }
}

impl<P: PacketPool, F: NorFlash, L: Lights, B: Battery, W: Watchdog> Tag<'_, '_, P, F, L, B, W> {
    /// Serves the stored record. One that is missing or damaged leaves the tag without: it still
    /// advertises, under an empty name, and takes a new record.
    async fn load_record(&mut self) {
        let stored = self.store.record(self.record).await;
        let record = stored.ok().flatten().and_then(|n| self.record.get(..n));
        match record.map(|bytes| (bytes, cbor::decode(bytes))) {
            Some((bytes, Ok(record))) => {
                self.server.set_record(bytes);
                self.object_id = record.object_id;
            }
            _ => self.object_id = Text::new(),
        }
    }

    fn state(&self) -> State {
        State {
            playing: self.remote.playing(),
            has_record: !self.object_id.is_empty(),
            battery: self.battery_level,
        }
    }

    /// One advertising and one link.
    async fn cycle<C: Controller>(
        &mut self,
        stack: &Stack<'_, Guard<C, 1>, P>,
    ) -> Result<(), Stopped<C::Error>> {
        self.battery_level = self.battery.level();
        let connection = self.advertise(&mut stack.peripheral()).await?;
        let _ = connection.set_bondable(true);
        let Ok(connection) = connection.with_attribute_server(&self.server.attributes) else {
            return Ok(());
        };
        let ended = self.serve(&connection).await;
        self.pairing.left();
        self.keep_bonds(stack).await;
        if ended {
            return Ok(());
        }
        connection.raw().disconnect();
        // The one link must be gone before there can be another: a robot that connects too early
        // would be refused, and would have ended the advertising.
        let gone = async {
            while !matches!(connection.next().await, GattConnectionEvent::Disconnected { .. }) {}
        };
        let _ = with_timeout(LONGEST_FAREWELL, self.fed(gone)).await;
        Ok(())
    }

    /// Makes store and stack agree on the bonds. A pairing is told by an event, which is lost when the
    /// robot leaves at once; the stack does not know which bond made room for a new one, and it lets
    /// any pairing take the place of an earlier one under the same address.
    async fn keep_bonds<C: Controller>(&mut self, stack: &Stack<'_, Guard<C, 1>, P>) {
        type Bonds = heapless::Vec<BondInformation, { BONDS + 1 }>;
        let known = stack.with_bond_information(|bonds| bonds.iter().cloned().collect::<Bonds>());
        let admitted = |bond: &BondInformation| admits(self.config, bond.security_level);
        for bond in known.iter().filter(|bond| bond.is_bonded && admitted(bond)) {
            if !matches!(self.store.holds(bond).await, Ok(true)) {
                // A bond that is not kept costs the robot another pairing.
                let _ = self.store.add_bond(bond).await;
            }
        }
        for bond in &known {
            if let Ok(false) = self.store.holds(bond).await {
                let _ = stack.remove_bond_information(bond.identity);
            }
        }
        for index in 0..BONDS {
            if let Ok(Some(bond)) = self.store.bond(index).await
                && admitted(&bond)
                && !known.contains(&bond)
            {
                let _ = stack.add_bond_information(bond);
            }
        }
    }

    /// Keeps the watchdog fed while something takes its time.
    async fn fed<T>(&self, work: impl Future<Output = T>) -> T {
        let feeding = async {
            loop {
                self.watchdog.borrow_mut().feed();
                Timer::after(FEEDING).await;
            }
        };
        match select(work, feeding).await {
            Either::First(done) => done,
            Either::Second(never) => never,
        }
    }

    /// Advertises, fast at first, until a robot connects.
    async fn advertise<'s, C: Controller>(
        &mut self,
        peripheral: &mut Peripheral<'s, C, P>,
    ) -> Result<Connection<'s, P>, Stopped<C::Error>> {
        let mut fast = true;
        loop {
            let state = self.state();
            self.server.set_state(state);
            let adv_data = beacon::advertisement(&self.object_id);
            let scan_data = beacon::scan_response(&self.object_id, state.battery, state.playing);
            let interval = match fast {
                true => self.config.fast_interval,
                false => self.config.slow_interval,
            };
            let parameters = AdvertisementParameters {
                interval_min: interval,
                interval_max: interval,
                ..Default::default()
            };
            let data = Advertisement::ConnectableScannableUndirected {
                adv_data: &adv_data,
                scan_data: &scan_data,
            };
            let advertiser = peripheral.advertise(&parameters, data).await.map_err(Stopped)?;
            // The battery is looked at again every so often.
            let again = if fast { self.config.fast_time } else { Duration::from_secs(3600) };
            match self.fed(with_timeout(again, advertiser.accept())).await {
                Ok(Ok(connection)) => return Ok(connection),
                Ok(Err(_)) => {}
                Err(_) => {
                    fast = false;
                    self.battery_level = self.battery.level();
                }
            }
        }
    }

    /// Serves a robot until the link has ended (true) or is to be ended (false). The light goes out
    /// with it.
    async fn serve(&mut self, connection: &GattConnection<'_, '_, P>) -> bool {
        let Tag { config, server, remote, store, lights, watchdog, record, pairing, .. } = self;
        let (config, server, remote) = (*config, *server, *remote);
        let battery = self.battery_level;
        let has_record = Cell::new(!self.object_id.is_empty());
        let led_count = lights.count();
        let state = || State { playing: remote.playing(), has_record: has_record.get(), battery };
        let mut session = Session { server, remote, store, record, led_count, new_record: None };
        // What a subscribed robot was told last; only changes are worth a notification.
        let told = Cell::new(state());
        let requests = async {
            let mut last = Instant::now();
            loop {
                let event = match with_timeout(FEEDING, connection.next()).await {
                    Ok(event) => event,
                    Err(_) => {
                        watchdog.borrow_mut().feed();
                        if last.elapsed() >= config.idle_link && !remote.playing() {
                            return false;
                        }
                        continue;
                    }
                };
                last = Instant::now();
                watchdog.borrow_mut().feed();
                match event {
                    GattConnectionEvent::Disconnected { .. } => return true,
                    GattConnectionEvent::PairingFailed(_) => {
                        pairing.failed();
                        // The reason must reach the robot before the link ends.
                        Timer::after(FAREWELL).await;
                        return false;
                    }
                    // The passkey is about to be tried.
                    GattConnectionEvent::PassKeyDisplay(_) if !pairing.allowed() => return false,
                    GattConnectionEvent::PassKeyDisplay(_) => pairing.trying = true,
                    GattConnectionEvent::PairingComplete { security_level, bond } => {
                        pairing.completed(security_level);
                        if !admits(config, security_level) {
                            return false;
                        }
                        if let Some(bond) = bond {
                            // At once: the power may fail before the link ends.
                            let _ = session.store.add_bond(&bond).await;
                        }
                    }
                    GattConnectionEvent::Gatt { event } => {
                        session.answer(event).await;
                        if let Some(id) = &session.new_record {
                            has_record.set(!id.is_empty());
                        }
                        let now = state();
                        server.set_state(now);
                        if told.replace(now) != now {
                            server.notify(connection, now).await;
                        }
                    }
                    _ => {}
                }
            }
        };
        let ends = async {
            loop {
                remote.ended().await;
                let now = state();
                told.set(now);
                server.set_state(now);
                server.notify(connection, now).await;
            }
        };
        let playing = led::play(*lights, remote, config.longest_play);
        let ended = match select3(requests, ends, playing).await {
            Either3::First(ended) => ended,
            Either3::Second(never) => never,
            Either3::Third(never) => never,
        };
        if let Some(id) = session.new_record.take() {
            self.object_id = id;
        }
        // The player was dropped with the link, maybe with the light on.
        remote.reset();
        for led in 0..led_count {
            self.lights.set(led, 0);
        }
        self.lights.playing(None);
        ended
    }
}

/// One link's requests.
struct Session<'a, 's, P: PacketPool, F: NorFlash> {
    server: &'a Server<'s, P>,
    remote: &'a Remote,
    store: &'a mut Store<F>,
    record: &'a mut [u8; MAX_BYTES],
    led_count: u8,
    /// Object id of a record that was stored on this link.
    new_record: Option<Text>,
}

impl<P: PacketPool, F: NorFlash> Session<'_, '_, P, F> {
    /// Answers one request.
    async fn answer(&mut self, event: GattEvent<'_, '_, P>) {
        let reply = match event {
            GattEvent::Write(write) => match self.server.target(write.handle()) {
                Some(target) => {
                    let outcome = self.write(target, &write).await;
                    // A command of the attribute protocol has no answer, not even an error.
                    let silent = matches!(write.payload().incoming(), AttClient::Command(_));
                    match outcome {
                        Err(code) if !silent => write.reject(code),
                        _ => write.accept_unprocessed(),
                    }
                }
                None => write.accept(),
            },
            other => other.accept(),
        };
        if let Ok(reply) = reply {
            reply.send().await;
        }
    }

    async fn write(
        &mut self,
        target: Target,
        write: &WriteEvent<'_, '_, P>,
    ) -> Result<(), AttErrorCode> {
        match target {
            Target::Command => write.with_data(|_, data| self.command(data)),
            Target::Upload => {
                let commit = write.with_data(|_, data| self.collect(data))?;
                match commit {
                    Some(length) => self.commit(length).await,
                    None => Ok(()),
                }
            }
        }
    }

    fn command(&mut self, data: &[u8]) -> Result<(), AttErrorCode> {
        let command = Command::decode(data).map_err(|_| error(gatt::ERROR_MALFORMED))?;
        match &command {
            Command::Play { pattern, .. } if pattern.landmark >= self.led_count => {
                return Err(error(gatt::ERROR_IMPOSSIBLE));
            }
            _ => self.remote.send(command),
        }
        Ok(())
    }

    /// Takes a piece; at the commit the length of a record that is complete and can be true.
    fn collect(&mut self, data: &[u8]) -> Result<Option<usize>, AttErrorCode> {
        match Upload::decode(data).ok_or(error(gatt::ERROR_MALFORMED))? {
            Upload::Piece { offset, data } => {
                let at = usize::from(offset);
                let space = self.record.get_mut(at..at + data.len());
                space.ok_or(error(gatt::ERROR_MALFORMED))?.copy_from_slice(data);
                Ok(None)
            }
            Upload::Commit { length, crc } => {
                let length = usize::from(length);
                let record = self.record.get(..length).ok_or(error(gatt::ERROR_MALFORMED))?;
                if crc32(record) != crc {
                    return Err(error(gatt::ERROR_MALFORMED));
                }
                let decoded = cbor::decode(record).map_err(|_| error(gatt::ERROR_IMPOSSIBLE))?;
                self.new_record = Some(decoded.object_id);
                Ok(Some(length))
            }
        }
    }

    async fn commit(&mut self, length: usize) -> Result<(), AttErrorCode> {
        let record = self.record.get(..length).ok_or(error(gatt::ERROR_MALFORMED))?;
        if self.store.set_record(record).await.is_err() {
            self.new_record = None;
            return Err(error(gatt::ERROR_STORAGE));
        }
        self.server.set_record(record);
        Ok(())
    }
}

fn error(code: u8) -> AttErrorCode {
    AttErrorCode::new(code)
}
