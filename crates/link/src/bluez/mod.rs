//! The tag radio through BlueZ, the Bluetooth daemon of desktop Linux, over D-Bus.
//!
//! [`BluezLink`] does what [`HciLink`](crate::HciLink) does, on a controller that keyboards and
//! headsets share. BlueZ keeps the bonds. Cargo feature `bluez`: building it needs libdbus.
//!
//! What BlueZ is known for, and what is done about it: calls that never return (every one has a
//! deadline of ours); connections that fail and are worth another try (they get it until the caller's
//! time is up); no pairing at all without an agent (we register our own, which answers only for the tag
//! that is being paired, and only by the passkey that the caller gave); devices remembered from
//! earlier (only those heard in the scan's own window are reported); links that take two seconds to end (they end behind
//! the caller's back, and the next task on the same tag finds them still there).

mod agent;
mod closing;
mod conversation;
mod fault;
mod scan;

use std::collections::BTreeSet;
use std::time::Duration;

use bluer::{Adapter, AdapterEvent, Address, Device, ErrorKind, Session};
use futures::StreamExt;
use tokio::runtime::Runtime;
use tokio::time::{Instant, sleep, timeout, timeout_at};
use vergence_devices::{Advertisement, DeviceError, LedCommand, TagAddress, TagLink, TagState};
use vergence_tag::{Command, Pattern};

use crate::ears::Ears;
use crate::job::{Answer, Bond, Fault, Outcome, TagInfo, Task, led_command, name, wrong_answer};
use crate::radio::TagRadio;
use agent::Passkeys;
use closing::Closing;
use fault::fault;

/// Bound on the daemon's answers to what needs no radio.
const PROMPT: Duration = Duration::from_secs(5);
/// Bound on one try to connect; BlueZ itself would try for much longer.
const CONNECT: Duration = Duration::from_secs(6);
/// Wait between looks at what the daemon may not tell by itself.
const POLL: Duration = Duration::from_millis(100);
/// Wait before a link that failed is tried again.
const RETRY: Duration = Duration::from_millis(200);
/// Bound on pairing, as for [`HciLink`](crate::HciLink).
const PAIRING: Duration = Duration::from_secs(30);

/// The tag radio of a computer whose Bluetooth belongs to BlueZ.
pub struct BluezLink {
    /// Ends after the rest: the connection to the daemon lives on it.
    runtime: Runtime,
    radio: Radio,
}

impl BluezLink {
    /// Opens an adapter (`hci0`), or the default one, and switches it on.
    pub fn open(adapter: Option<&str>) -> Result<Self, DeviceError> {
        let device = adapter.map_or("bluetooth".into(), |name| format!("bluetooth {name}"));
        let failed = |reason: String| DeviceError::Disconnected { device: device.clone(), reason };
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("tag radio")
            .enable_all()
            .build()
            .map_err(|e| failed(e.to_string()))?;
        let radio = runtime
            .block_on(async { timeout(PROMPT, Radio::open(adapter)).await })
            .map_err(|_| DeviceError::Timeout { device: device.clone(), timeout: PROMPT })?
            .map_err(|e| failed(e.to_string()))?;
        Ok(BluezLink { runtime, radio })
    }

    fn led(
        &mut self,
        tag: TagAddress,
        command: Command,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        match self.attend(tag, &Task::Command(command), timeout)? {
            Answer::State(state) => Ok(state),
            _ => Err(wrong_answer(tag)),
        }
    }

    fn attend(
        &mut self,
        tag: TagAddress,
        task: &Task,
        timeout: Duration,
    ) -> Result<Answer, DeviceError> {
        let outcome = self.runtime.block_on(self.radio.attend(tag, task, timeout));
        outcome.map_err(|fault| fault.device_error(name(tag), timeout))
    }
}

impl TagRadio for BluezLink {
    fn info(&mut self, tag: TagAddress, timeout: Duration) -> Result<TagInfo, DeviceError> {
        match self.attend(tag, &Task::Info, timeout)? {
            Answer::Info(info) => Ok(info),
            _ => Err(wrong_answer(tag)),
        }
    }

    fn write_record(
        &mut self,
        tag: TagAddress,
        record: &[u8],
        timeout: Duration,
    ) -> Result<(), DeviceError> {
        self.attend(tag, &Task::write(tag, record)?, timeout).map(drop)
    }

    fn play_for(
        &mut self,
        tag: TagAddress,
        pattern: Pattern,
        limit: Duration,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        self.led(tag, Command::Play { pattern, limit: Some(limit) }, timeout)
    }

    /// BlueZ keeps the bond; an older one with this tag is forgotten.
    fn pair(&mut self, tag: TagAddress, passkey: Option<u32>) -> Result<Option<Bond>, DeviceError> {
        self.attend(tag, &Task::Pair(passkey), PAIRING).map(|_| None)
    }

    fn add_bond(&mut self, _bond: Bond) -> Result<(), DeviceError> {
        let what = "BlueZ takes no bonds of other radios: pair again".into();
        Err(DeviceError::Unsupported { device: self.radio.adapter.name().into(), what })
    }

    fn keeps_bonds(&self) -> bool {
        true
    }

    fn release(&mut self, tag: TagAddress) -> Result<(), DeviceError> {
        self.attend(tag, &Task::Release, PROMPT).map(drop)
    }
}

impl TagLink for BluezLink {
    fn scan(&mut self, window: Duration) -> Result<Vec<Advertisement>, DeviceError> {
        // Tags with a link do not advertise.
        self.runtime.block_on(self.radio.closing.end_all());
        let radio = &self.radio;
        let bound = window + PROMPT;
        let scan = async { timeout(bound, scan::scan(&radio.adapter, &radio.ears, window)).await };
        let device = || format!("bluetooth {}", radio.adapter.name());
        match self.runtime.block_on(scan) {
            Ok(Ok(())) => Ok(self.radio.ears.tags()),
            Ok(Err(error)) => Err(fault(error).device_error(device(), bound)),
            Err(_) => Err(DeviceError::Timeout { device: device(), timeout: bound }),
        }
    }

    fn read_record(&mut self, tag: TagAddress, timeout: Duration) -> Result<Vec<u8>, DeviceError> {
        match self.attend(tag, &Task::Record, timeout)? {
            Answer::Record(record) => Ok(record),
            _ => Err(wrong_answer(tag)),
        }
    }

    fn command(
        &mut self,
        tag: TagAddress,
        command: LedCommand,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        self.led(tag, led_command(command), timeout)
    }
}

impl Drop for BluezLink {
    fn drop(&mut self) {
        // BlueZ would hold links, and so lights, that nobody asks for any more.
        self.runtime.block_on(self.radio.end_all());
    }
}

/// The daemon's adapter and what we know of tags.
struct Radio {
    _session: Session,
    adapter: Adapter,
    passkeys: Passkeys,
    _agent: bluer::agent::AgentHandle,
    ears: Ears,
    /// Tags whose light plays.
    held: BTreeSet<TagAddress>,
    closing: Closing,
}

impl Radio {
    async fn open(adapter: Option<&str>) -> bluer::Result<Self> {
        let session = Session::new().await?;
        let adapter = match adapter {
            Some(name) => session.adapter(name)?,
            None => session.default_adapter().await?,
        };
        if !adapter.is_powered().await? {
            adapter.set_powered(true).await?;
        }
        let passkeys = Passkeys::default();
        let agent = session.register_agent(passkeys.agent()).await?;
        Ok(Radio {
            _session: session,
            adapter,
            passkeys,
            _agent: agent,
            ears: Ears::default(),
            held: BTreeSet::new(),
            closing: Closing::default(),
        })
    }

    /// Carries out a task; tries again while the time lasts if the link fails.
    async fn attend(&mut self, tag: TagAddress, task: &Task, time: Duration) -> Outcome {
        let deadline = Instant::now() + time;
        let device = self.adapter.device(Address(tag.0)).map_err(fault)?;
        if *task == Task::Release {
            if self.held.remove(&tag) {
                closing::end(&device).await;
            }
            return Ok(Answer::Done);
        }
        let tries = async {
            self.closing.before_use(tag).await;
            loop {
                match self.attempt(tag, task).await {
                    Err(Fault::Lost) => {
                        closing::end(&device).await;
                        sleep(RETRY).await;
                    }
                    outcome => return outcome,
                }
            }
        };
        let outcome = timeout_at(deadline, tries).await.unwrap_or(Err(Fault::Late));
        let plays = matches!(task, Task::Command(Command::Play { .. })) && outcome.is_ok();
        if plays {
            self.held.insert(tag);
        } else {
            self.held.remove(&tag);
            self.closing.after_use(tag, device);
        }
        outcome
    }

    /// One try of a task.
    async fn attempt(&self, tag: TagAddress, task: &Task) -> Outcome {
        if let Task::Pair(passkey) = task {
            return self.pair(tag, *passkey).await;
        }
        let device = self.connect(tag).await?;
        conversation::converse(&device, task, self.ears.object_id(tag)).await
    }

    /// A link to the tag, which BlueZ may have to hear first.
    async fn connect(&self, tag: TagAddress) -> Result<Device, Fault> {
        let device = self.adapter.device(Address(tag.0)).map_err(fault)?;
        match device.is_connected().await {
            Ok(true) => return Ok(device),
            Ok(false) => {}
            Err(error) if error.kind == ErrorKind::NotFound => self.hear(tag).await?,
            Err(error) => return Err(fault(error)),
        }
        match timeout(CONNECT, device.connect()).await {
            Ok(Ok(())) => Ok(device),
            Ok(Err(error)) if error.kind == ErrorKind::AlreadyConnected => Ok(device),
            Ok(Err(error)) => Err(fault::of_connecting(error)),
            Err(_) => Err(Fault::Lost),
        }
    }

    /// Listens until BlueZ knows the tag.
    async fn hear(&self, tag: TagAddress) -> Result<(), Fault> {
        self.adapter.set_discovery_filter(scan::filter()).await.map_err(fault)?;
        let mut events = self.adapter.discover_devices().await.map_err(fault)?;
        while let Some(event) = events.next().await {
            if event_is_of(&event, tag) {
                return Ok(());
            }
        }
        Err(Fault::Lost)
    }

    async fn pair(&self, tag: TagAddress, passkey: Option<u32>) -> Outcome {
        let known = self.adapter.device(Address(tag.0)).map_err(fault)?;
        if known.is_paired().await.unwrap_or(false) {
            // An old bond would be used in place of a new pairing.
            self.adapter.remove_device(Address(tag.0)).await.map_err(fault)?;
        }
        let device = self.connect(tag).await?;
        // BlueZ forgets to answer when it is still finding out what the tag serves.
        let _ = timeout(CONNECT, device.services()).await;
        let permit = self.passkeys.permit(tag, passkey);
        let paired = async {
            while !device.is_paired().await? {
                sleep(POLL).await;
            }
            Ok(())
        };
        let outcome = tokio::select! {
            outcome = device.pair() => outcome,
            outcome = paired => outcome,
        };
        let proven = passkey.is_none() || permit.was_used();
        drop(permit);
        match outcome {
            Ok(()) if !proven => {
                // BlueZ keeps the bond of a tag that never asked, unless it is told to forget it.
                self.adapter.remove_device(Address(tag.0)).await.map_err(fault)?;
                Err(Fault::Unproven)
            }
            Ok(()) => Ok(Answer::Paired(None)),
            Err(error) => Err(fault::of_pairing(error)),
        }
    }

    async fn end_all(&mut self) {
        for tag in std::mem::take(&mut self.held) {
            if let Ok(device) = self.adapter.device(Address(tag.0)) {
                closing::end(&device).await;
            }
        }
        self.closing.end_all().await;
    }
}

fn event_is_of(event: &AdapterEvent, tag: TagAddress) -> bool {
    matches!(event, AdapterEvent::DeviceAdded(address) if address.0 == tag.0)
}
