//! The robot's Bluetooth host: one task that carries out jobs, one after the other.
//!
//! A link is made for a job and ended after it, but for a tag whose light plays: its link is held,
//! because a tag goes dark when its robot is gone. Jobs whose link breaks are tried again until their
//! time is up.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::time::Duration;

use bt_hci::cmd::le::LeSetScanParams;
use bt_hci::controller::ControllerCmdSync;
use bt_hci::uuid::declarations::CHARACTERISTIC;
use embassy_futures::select::{Either, select};
use embassy_time::{Timer, with_timeout};
use trouble_host::att::AttErrorCode;
use trouble_host::attribute::Uuid;
use trouble_host::connection::{
    ConnectConfig, Connection, ConnectionEvent, RequestedConnParams, ScanConfig,
};
use trouble_host::gatt::GattClient;
use trouble_host::prelude::{AddrKind, BdAddr};
use trouble_host::scan::Scanner;
use trouble_host::{
    Address, BleHostError, BondInformation, Controller, Error, HostResources, IoCapabilities, Stack,
};
use vergence_devices::{TagAddress, TagState};
use vergence_firmware::Guard;
use vergence_firmware::store::{decode_bond, encode_bond};
use vergence_tag::cbor::{self, MAX_BYTES};
use vergence_tag::gatt::{self, LONGEST_VALUE};
use vergence_tag::{Command, State, Upload};

use crate::ears::Ears;
use crate::job::{Answer, Bond, Fault, Inbox, Job, Outcome, TagInfo, Task};
use crate::pool::HeapPool;

/// Links at once: the tag that is being asked, and those that blink.
pub(crate) const LINKS: usize = 8;
const BONDS: usize = 64;

/// How the robot uses its radio.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkConfig {
    /// Static random address of the robot, most significant byte first; the two top bits are set.
    pub address: [u8; 6],
    /// Connection interval: a request and its answer take two. 15 ms is what phones allow at best
    /// and reads a record in half of the time that 30 ms takes.
    pub interval: Duration,
    /// A link on which nothing was heard for this long is lost.
    pub supervision_timeout: Duration,
}

impl Default for LinkConfig {
    fn default() -> Self {
        LinkConfig {
            address: [0xC0, 0x56, 0x45, 0x52, 0x47, 0x01],
            interval: Duration::from_millis(15),
            supervision_timeout: Duration::from_secs(2),
        }
    }
}

type Host<'s, C> = Stack<'s, Guard<C, LINKS>, HeapPool>;
type Client<'a, C> = GattClient<'a, Guard<C, LINKS>, HeapPool, 4>;

/// Where a tag's characteristics are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Handles {
    upload: u16,
    command: u16,
    state: u16,
}

struct Held<'a> {
    tag: TagAddress,
    connection: Connection<'a, HeapPool>,
}

struct Central<'a, 's, C: Controller> {
    stack: &'a Host<'s, C>,
    config: LinkConfig,
    ears: &'a Ears,
    held: RefCell<Vec<Held<'a>>>,
    handles: RefCell<BTreeMap<TagAddress, Handles>>,
}

/// Runs the host on a controller until the inbox is closed or the controller fails.
pub(crate) async fn run<C>(controller: C, config: LinkConfig, inbox: Inbox)
where
    C: Controller + ControllerCmdSync<LeSetScanParams>,
{
    let mut resources: HostResources<HeapPool, LINKS, 2, 1, BONDS> = HostResources::new();
    let mut address = config.address;
    address.reverse();
    let stack: Host<'_, C> = trouble_host::new(Guard::new(controller), &mut resources)
        .set_random_address(Address::random(address))
        .set_io_capabilities(IoCapabilities::NoInputNoOutput)
        .build();
    let ears = Ears::default();
    let central = Central {
        stack: &stack,
        config,
        ears: &ears,
        held: RefCell::default(),
        handles: RefCell::default(),
    };
    let mut runner = stack.runner();
    let work = async {
        while let Some((job, reply)) = inbox.next().await {
            // A caller that no longer waits does not want the outcome.
            let _ = reply.send(central.execute(job).await);
        }
    };
    let reason = match select(runner.run_with_handler(&ears), work).await {
        Either::First(Ok(())) => "the host stack ended".to_owned(),
        Either::First(Err(error)) => format!("controller: {}", describe(&error)),
        Either::Second(()) => return,
    };
    // Whoever asks from now on is told why there is no answer.
    while let Some((_, reply)) = inbox.next().await {
        let _ = reply.send(Err(Fault::Dead(reason.clone())));
    }
}

fn describe<E: core::fmt::Debug>(error: &BleHostError<E>) -> String {
    match error {
        BleHostError::Controller(error) => format!("{error:?}"),
        BleHostError::BleHost(error) => format!("{error:?}"),
    }
}

/// What a failure of the host means for the job.
fn fault<E: core::fmt::Debug>(error: BleHostError<E>) -> Fault {
    let refused = |what: &str| Fault::Refused(what.into());
    match error {
        BleHostError::BleHost(Error::Att(code)) => match code {
            AttErrorCode::INSUFFICIENT_AUTHENTICATION
            | AttErrorCode::INSUFFICIENT_ENCRYPTION
            | AttErrorCode::INSUFFICIENT_AUTHORISATION => {
                refused("refuses this to robots that are not paired with it")
            }
            code if code == AttErrorCode::new(gatt::ERROR_MALFORMED) => {
                refused("does not understand what it was sent")
            }
            code if code == AttErrorCode::new(gatt::ERROR_IMPOSSIBLE) => {
                refused("was asked for what it cannot do or hold")
            }
            code if code == AttErrorCode::new(gatt::ERROR_STORAGE) => {
                refused("could not store the record")
            }
            code => Fault::Refused(format!("refuses: {code:?}")),
        },
        BleHostError::BleHost(
            Error::Disconnected | Error::Timeout | Error::NotFound | Error::ConnectionLimitReached,
        ) => Fault::Lost,
        other => Fault::Refused(format!("answers nonsense ({})", describe(&other))),
    }
}

fn ticks(time: Duration) -> embassy_time::Duration {
    embassy_time::Duration::from_micros(time.as_micros() as u64)
}

fn uuid(uuid: u128) -> Uuid {
    Uuid::new_long(uuid.to_le_bytes())
}

impl<'a, C: Controller + ControllerCmdSync<LeSetScanParams>> Central<'a, '_, C> {
    async fn execute(&self, job: Job) -> Outcome {
        match job {
            Job::Scan(window) => self.scan(window).await,
            Job::AddBond(Bond(bytes)) => {
                let bond = decode_bond(&bytes);
                let added = bond.map(|bond| self.stack.add_bond_information(bond));
                match added {
                    Some(Ok(())) => Ok(Answer::Done),
                    _ => Err(Fault::Refused("is no bond, or there are too many".into())),
                }
            }
            Job::Attend { tag, task: Task::Release, .. } => {
                let held = self.take_held(tag);
                if let Some(connection) = held {
                    self.close(&connection).await;
                }
                Ok(Answer::Done)
            }
            Job::Attend { tag, task, timeout } => {
                let tries = async {
                    loop {
                        match self.attempt(tag, &task).await {
                            Err(Fault::Lost) => Timer::after_millis(20).await,
                            outcome => return outcome,
                        }
                    }
                };
                with_timeout(ticks(timeout), tries).await.unwrap_or(Err(Fault::Late))
            }
        }
    }

    async fn scan(&self, window: Duration) -> Outcome {
        self.ears.forget();
        let mut central = self.stack.central();
        let config = ScanConfig {
            active: true,
            interval: embassy_time::Duration::from_millis(100),
            window: embassy_time::Duration::from_millis(100),
            ..ScanConfig::default()
        };
        let mut scanner = Scanner::new(&mut central);
        let scan = async {
            let session = scanner.scan(&config).await.map_err(fault)?;
            Timer::after(ticks(window)).await;
            session.stop().await;
            Ok(())
        };
        // The controller's answers must not hold up the robot.
        let bound = ticks(window + Duration::from_secs(2));
        with_timeout(bound, scan).await.unwrap_or(Err(Fault::Late))?;
        Ok(Answer::Heard(self.ears.tags()))
    }

    /// A held link to this tag, if it is still there.
    fn take_held(&self, tag: TagAddress) -> Option<Connection<'a, HeapPool>> {
        let mut held = self.held.borrow_mut();
        held.retain(|h| h.connection.is_connected());
        let index = held.iter().position(|h| h.tag == tag)?;
        Some(held.swap_remove(index).connection)
    }

    async fn connect(&self, tag: TagAddress) -> Result<Connection<'a, HeapPool>, Fault> {
        if let Some(connection) = self.take_held(tag) {
            return Ok(connection);
        }
        if self.held.borrow().len() + 1 >= LINKS {
            let most = LINKS - 1;
            return Err(Fault::Refused(format!("cannot be reached: {most} others are blinking")));
        }
        let mut address = tag.0;
        address.reverse();
        let kind = if self.ears.is_public(tag) { AddrKind::PUBLIC } else { AddrKind::RANDOM };
        let peers = [Address::new(kind, BdAddr::new(address))];
        let interval = ticks(self.config.interval);
        let config = ConnectConfig {
            scan_config: ScanConfig {
                filter_accept_list: &peers,
                interval: embassy_time::Duration::from_millis(30),
                window: embassy_time::Duration::from_millis(30),
                ..ScanConfig::default()
            },
            connect_params: RequestedConnParams {
                min_connection_interval: interval,
                max_connection_interval: interval,
                max_latency: 0,
                min_event_length: embassy_time::Duration::from_ticks(0),
                max_event_length: embassy_time::Duration::from_ticks(0),
                supervision_timeout: ticks(self.config.supervision_timeout),
            },
        };
        self.stack.central().connect(&config).await.map_err(fault)
    }

    /// Ends a link and waits until the tag knows, or can be taken to be gone.
    async fn close(&self, connection: &Connection<'a, HeapPool>) {
        connection.disconnect();
        let gone = async {
            loop {
                if let ConnectionEvent::Disconnected { .. } = connection.next().await {
                    return;
                }
            }
        };
        let _ = with_timeout(ticks(self.config.interval * 10), gone).await;
    }

    /// One try of a task.
    async fn attempt(&self, tag: TagAddress, task: &Task) -> Outcome {
        let connection = self.connect(tag).await?;
        if let Task::Pair(passkey) = task {
            let outcome = self.pair(&connection, *passkey).await;
            self.close(&connection).await;
            return outcome;
        }
        let outcome = self.converse(&connection, tag, task).await;
        let plays = matches!(task, Task::Command(Command::Play { .. })) && outcome.is_ok();
        if plays && connection.is_connected() {
            self.held.borrow_mut().push(Held { tag, connection });
        } else {
            self.close(&connection).await;
        }
        outcome
    }

    async fn converse(
        &self,
        connection: &Connection<'a, HeapPool>,
        tag: TagAddress,
        task: &Task,
    ) -> Outcome {
        let client: Client<'a, C> = GattClient::new(self.stack, connection).await.map_err(fault)?;
        let work = async {
            match task {
                Task::Record => self.read_record(&client, connection, tag).await,
                Task::Info => self.info(&client, connection, tag).await,
                Task::Command(command) => {
                    let handles = self.handles(&client, tag).await?;
                    let bytes = command.encode();
                    self.write(&client, tag, handles.command, &bytes).await?;
                    let state = self.state(&client, handles.state).await?;
                    Ok(Answer::State(TagState { playing: state.playing, battery: state.battery }))
                }
                Task::Write(record) => {
                    let handles = self.handles(&client, tag).await?;
                    // Also when the answer to the last piece is lost.
                    self.ears.rewritten(tag);
                    for message in Upload::messages(record) {
                        self.write(&client, tag, handles.upload, &message).await?;
                    }
                    Ok(Answer::Done)
                }
                // These need no conversation.
                Task::Pair(_) | Task::Release => Ok(Answer::Done),
            }
        };
        match select(client.task(), work).await {
            Either::First(Ok(())) => Err(Fault::Lost),
            Either::First(Err(error)) => Err(fault(error)),
            Either::Second(outcome) => outcome,
        }
    }

    /// Handle and first bytes of the first attribute of a type.
    async fn find(
        &self,
        client: &Client<'a, C>,
        kind: &Uuid,
    ) -> Result<Option<(u16, Vec<u8>)>, Fault> {
        client
            .read_by_type(1, u16::MAX, kind, |handle, value| {
                ControlFlow::Break((handle, value.to_vec()))
            })
            .await
            .map_err(fault)
    }

    /// A whole attribute value: one request for short ones, no search for its handle before.
    async fn read(
        &self,
        client: &Client<'a, C>,
        connection: &Connection<'a, HeapPool>,
        kind: u128,
    ) -> Result<Vec<u8>, Fault> {
        let Some((handle, mut value)) = self.find(client, &uuid(kind)).await? else {
            return Err(Fault::Refused("is no tag: it lacks the tag service".into()));
        };
        // What fits the answer besides opcode, length and handle; the length has one byte.
        let fits = usize::from(connection.att_mtu()).saturating_sub(4).min(253);
        if value.len() >= fits {
            let at = value.len();
            value.resize(LONGEST_VALUE.max(at), 0);
            let more = client.read_handle_blob(handle, at as u16, &mut value[at..]);
            let more = more.await.map_err(fault)?;
            value.truncate(at + more);
        }
        Ok(value)
    }

    async fn read_record(
        &self,
        client: &Client<'a, C>,
        connection: &Connection<'a, HeapPool>,
        tag: TagAddress,
    ) -> Outcome {
        let mut record = self.read(client, connection, gatt::RECORD).await?;
        if record.len() >= LONGEST_VALUE {
            record.extend(self.read(client, connection, gatt::RECORD_REST).await?);
        }
        if record.is_empty() {
            return Err(Fault::Refused("holds no record".into()));
        }
        record.truncate(MAX_BYTES);
        let claimed = self.ears.object_id(tag);
        if let (Some(claimed), Ok(record)) = (claimed, cbor::decode(&record))
            && !claimed.matches(&record.object_id)
        {
            return Err(Fault::Refused(format!(
                "advertises \"{}\" but holds the record of \"{}\"",
                claimed.name, record.object_id
            )));
        }
        Ok(Answer::Record(record))
    }

    async fn info(
        &self,
        client: &Client<'a, C>,
        connection: &Connection<'a, HeapPool>,
        tag: TagAddress,
    ) -> Outcome {
        let mut texts = [const { String::new() }; 3];
        for (text, kind) in texts.iter_mut().zip([gatt::MANUFACTURER, gatt::MODEL, gatt::FIRMWARE])
        {
            let value = self.find(client, &Uuid::new_short(kind)).await?;
            *text =
                value.map(|(_, v)| String::from_utf8_lossy(&v).into_owned()).unwrap_or_default();
        }
        let [manufacturer, model, firmware] = texts;
        let handles = self.handles(client, tag).await?;
        let state = self.state(client, handles.state).await?;
        Ok(Answer::Info(TagInfo {
            manufacturer,
            model,
            firmware,
            battery: state.battery,
            has_record: state.has_record,
            playing: state.playing,
            rssi: connection.rssi(self.stack).await.ok().filter(|rssi| *rssi < 20),
        }))
    }

    /// The tag's handles, asked for once in the robot's life.
    async fn handles(&self, client: &Client<'a, C>, tag: TagAddress) -> Result<Handles, Fault> {
        if let Some(known) = self.handles.borrow().get(&tag) {
            return Ok(*known);
        }
        let mut found = Handles::default();
        let declarations = |_: u16, declaration: &[u8]| {
            // Properties, handle of the value, UUID.
            let Some(([_, low, high], kind)) = declaration.split_first_chunk::<3>() else {
                return ControlFlow::Continue(());
            };
            let handle = u16::from_le_bytes([*low, *high]);
            for (wanted, slot) in [
                (gatt::RECORD_WRITE, &mut found.upload),
                (gatt::COMMAND, &mut found.command),
                (gatt::STATE, &mut found.state),
            ] {
                if kind == wanted.to_le_bytes() {
                    *slot = handle;
                }
            }
            match found.upload > 0 && found.command > 0 && found.state > 0 {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            }
        };
        client
            .read_by_type(1, u16::MAX, &CHARACTERISTIC.into(), declarations)
            .await
            .map_err(fault)?
            .ok_or(Fault::Refused("is no tag: it lacks the tag service".into()))?;
        self.handles.borrow_mut().insert(tag, found);
        Ok(found)
    }

    /// Writes, and forgets the tag's handles if it no longer knows this one.
    async fn write(
        &self,
        client: &Client<'a, C>,
        tag: TagAddress,
        handle: u16,
        value: &[u8],
    ) -> Result<(), Fault> {
        let written = client.write_handle(handle, value).await;
        if let Err(BleHostError::BleHost(Error::Att(
            AttErrorCode::INVALID_HANDLE | AttErrorCode::WRITE_NOT_PERMITTED,
        ))) = &written
        {
            self.handles.borrow_mut().remove(&tag);
            return Err(Fault::Lost);
        }
        written.map_err(fault)
    }

    async fn state(&self, client: &Client<'a, C>, handle: u16) -> Result<State, Fault> {
        let mut bytes = [0; 16];
        let length = client.read_handle(handle, &mut bytes).await.map_err(fault)?;
        State::decode(bytes.get(..length).unwrap_or_default())
            .ok_or(Fault::Refused("tells no state".into()))
    }

    async fn pair(&self, connection: &Connection<'a, HeapPool>, passkey: Option<u32>) -> Outcome {
        let io = match passkey {
            Some(_) => IoCapabilities::KeyboardOnly,
            None => IoCapabilities::NoInputNoOutput,
        };
        self.stack.set_io_capabilities(io);
        connection.set_bondable(true).map_err(|_| Fault::Lost)?;
        if connection.is_bonded_peer() {
            // An old bond would be used in place of a new pairing.
            let _ = self.stack.remove_bond_information(connection.peer_identity());
        }
        connection.request_security().map_err(|_| Fault::Lost)?;
        loop {
            match connection.next().await {
                ConnectionEvent::PassKeyInput => {
                    connection.pass_key_input(passkey.unwrap_or(0)).map_err(|_| Fault::Lost)?;
                }
                ConnectionEvent::PairingComplete { bond, .. } => {
                    return Ok(Answer::Paired(
                        bond.map(|b: BondInformation| Bond(encode_bond(&b))),
                    ));
                }
                ConnectionEvent::PairingFailed(reason) => {
                    return Err(Fault::Refused(format!("pairing failed: {reason:?}")));
                }
                // Not tried again: the tag counts failed pairings and answers ever later.
                ConnectionEvent::Disconnected { .. } => {
                    return Err(Fault::Refused("pairing failed: the link ended".into()));
                }
                _ => {}
            }
        }
    }
}
