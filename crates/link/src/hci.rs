//! The robot's tag radio: a plain object on top, the Bluetooth host on a thread of its own below.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::time::Duration;

use bt_hci::controller::ExternalController;
use bt_hci::transport::Transport;
use vergence_air::{Executor, StreamTransport, TransportError};
use vergence_devices::{
    Advertisement, Clock, DeviceError, LedCommand, TagAddress, TagLink, TagState,
};
use vergence_tag::Command;

use crate::central::{self, LinkConfig};
use crate::job::{
    Answer, Bond, Fault, Inbox, Job, Outcome, TagInfo, Task, led_command, name, wrong_answer,
};

/// HCI commands under way at once.
const COMMANDS: usize = 10;
/// How much later than a job's own timeout its thread is given up.
const GRACE: Duration = Duration::from_secs(4);
/// The longest time for work on a tag that the device traits do not name.
const PAIRING: Duration = Duration::from_secs(30);

/// A controller over a transport.
pub(crate) type Hci<T> = ExternalController<T, COMMANDS>;

/// A request to the thread of a simulated radio: when it is made, and what for (`None`: only to bring
/// everything up to that time). The thread answers with the outcome and the time at which it came.
pub(crate) type SimulatedRequest = (Duration, Option<Job>, Sender<(Outcome, Duration)>);

enum Drive {
    /// The thread runs by itself on real time.
    RealTime(Inbox),
    /// The thread runs on virtual time, only while a request is under way.
    Simulated { requests: Sender<SimulatedRequest>, clock: Arc<dyn Clock> },
}

/// The tag radio over Bluetooth Low Energy.
pub struct HciLink {
    drive: Drive,
}

impl Drop for HciLink {
    fn drop(&mut self) {
        if let Drive::RealTime(inbox) = &self.drive {
            inbox.close();
        }
    }
}

impl HciLink {
    /// A radio whose controller speaks H4 over TCP, for example a simulated workcell.
    pub fn tcp(address: &str, config: LinkConfig) -> Result<Self, DeviceError> {
        let target = address.to_owned();
        let opened = Self::open(move || StreamTransport::connect(&target), config);
        opened.map_err(|reason| not_opened(address, reason))
    }

    /// A radio whose controller speaks H4 over a serial line at this speed (baud), with hardware flow
    /// control, or over a pseudo-terminal.
    pub fn serial(path: &Path, baud: u32, config: LinkConfig) -> Result<Self, DeviceError> {
        let target = path.to_owned();
        let opened = Self::open(move || StreamTransport::serial(&target, baud), config);
        opened.map_err(|reason| not_opened(&path.to_string_lossy(), reason))
    }

    /// A radio on a controller of this computer (0 is `hci0`), taken from the kernel's own host: it must
    /// be off and left alone by bluetoothd; the caller needs CAP_NET_ADMIN.
    pub fn linux(controller: u16, config: LinkConfig) -> Result<Self, DeviceError> {
        Self::open(move || StreamTransport::user_channel(controller), config)
            .map_err(|reason| not_opened(&format!("hci{controller}"), reason))
    }

    /// A radio over any transport, which is made on the radio's own thread.
    pub fn open<T>(
        transport: impl FnOnce() -> io::Result<T> + Send + 'static,
        config: LinkConfig,
    ) -> io::Result<Self>
    where
        T: Transport<Error = TransportError> + 'static,
    {
        let inbox = Inbox::default();
        let jobs = inbox.clone();
        let (opened, outcome) = mpsc::channel();
        std::thread::Builder::new().name("tag radio".into()).spawn(move || {
            let transport = match transport() {
                Ok(transport) => transport,
                Err(error) => {
                    let _ = opened.send(Err(error));
                    return;
                }
            };
            let _ = opened.send(Ok(()));
            // On real time something can always still come: the executor never stalls.
            let _ = Executor::new().block_on(central::run(Hci::new(transport), config, jobs));
        })?;
        outcome.recv().map_err(|_| io::Error::other("the radio thread died"))??;
        Ok(HciLink { drive: Drive::RealTime(inbox) })
    }

    pub(crate) fn simulated(requests: Sender<SimulatedRequest>, clock: Arc<dyn Clock>) -> Self {
        HciLink { drive: Drive::Simulated { requests, clock } }
    }

    /// What the tag tells of itself.
    pub fn info(&mut self, tag: TagAddress, timeout: Duration) -> Result<TagInfo, DeviceError> {
        match self.attend(tag, Task::Info, timeout)? {
            Answer::Info(info) => Ok(info),
            _ => Err(wrong_answer(tag)),
        }
    }

    /// Gives the tag a new record. It is checked here first, and by the tag once more.
    pub fn write_record(
        &mut self,
        tag: TagAddress,
        record: &[u8],
        timeout: Duration,
    ) -> Result<(), DeviceError> {
        self.attend(tag, Task::write(tag, record)?, timeout).map(drop)
    }

    /// Plays a pattern no longer than `limit`, whatever the tag's own longest time is.
    pub fn play_for(
        &mut self,
        tag: TagAddress,
        pattern: vergence_tag::Pattern,
        limit: Duration,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        self.led(tag, Command::Play { pattern, limit: Some(limit) }, timeout)
    }

    /// Pairs with a tag: with the passkey that is printed on it, or ("Just Works") with none. The
    /// bond is in force at once; give it to [`HciLink::add_bond`] after a restart.
    pub fn pair(
        &mut self,
        tag: TagAddress,
        passkey: Option<u32>,
    ) -> Result<Option<Bond>, DeviceError> {
        match self.attend(tag, Task::Pair(passkey), PAIRING)? {
            Answer::Paired(bond) => Ok(bond),
            _ => Err(wrong_answer(tag)),
        }
    }

    /// Takes up a bond of an earlier run.
    pub fn add_bond(&mut self, bond: Bond) -> Result<(), DeviceError> {
        self.call(Job::AddBond(bond), Duration::from_secs(1))
            .map(drop)
            .map_err(|fault| fault.device_error("bond".into(), Duration::from_secs(1)))
    }

    /// Ends the link that is held for a tag whose light plays; the light goes out.
    pub fn release(&mut self, tag: TagAddress) -> Result<(), DeviceError> {
        self.attend(tag, Task::Release, Duration::from_secs(1)).map(drop)
    }

    fn led(
        &mut self,
        tag: TagAddress,
        command: Command,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        match self.attend(tag, Task::Command(command), timeout)? {
            Answer::State(state) => Ok(state),
            _ => Err(wrong_answer(tag)),
        }
    }

    fn attend(
        &mut self,
        tag: TagAddress,
        task: Task,
        timeout: Duration,
    ) -> Result<Answer, DeviceError> {
        self.call(Job::Attend { tag, task, timeout }, timeout)
            .map_err(|fault| fault.device_error(name(tag), timeout))
    }

    fn call(&mut self, job: Job, timeout: Duration) -> Outcome {
        match &self.drive {
            Drive::RealTime(inbox) => {
                let (reply, outcome) = mpsc::channel();
                inbox.push(job, reply);
                match outcome.recv_timeout(timeout + GRACE) {
                    Ok(outcome) => outcome,
                    Err(RecvTimeoutError::Timeout) => Err(Fault::Late),
                    Err(RecvTimeoutError::Disconnected) => Err(dead()),
                }
            }
            Drive::Simulated { requests, clock } => {
                let (reply, outcome) = mpsc::channel();
                let now = clock.now();
                requests.send((now, Some(job), reply)).map_err(|_| dead())?;
                let (outcome, end) = outcome.recv().map_err(|_| dead())?;
                clock.sleep(end.saturating_sub(now));
                outcome
            }
        }
    }
}

impl TagLink for HciLink {
    fn scan(&mut self, window: Duration) -> Result<Vec<Advertisement>, DeviceError> {
        match self.call(Job::Scan(window), window + GRACE) {
            Ok(Answer::Heard(tags)) => Ok(tags),
            Ok(_) => Ok(Vec::new()),
            Err(fault) => Err(fault.device_error("tag radio".into(), window)),
        }
    }

    fn read_record(&mut self, tag: TagAddress, timeout: Duration) -> Result<Vec<u8>, DeviceError> {
        match self.attend(tag, Task::Record, timeout)? {
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

fn dead() -> Fault {
    Fault::Dead("the radio thread ended".into())
}

fn not_opened(target: &str, reason: io::Error) -> DeviceError {
    DeviceError::Disconnected { device: format!("tag radio {target}"), reason: reason.to_string() }
}
