//! What a robot asks its radio thread for, and what comes back.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Poll, Waker};
use std::time::Duration;

use trouble_host::att::AttErrorCode;
use trouble_host::{BleHostError, Error};
use vergence_devices::{Advertisement, DeviceError, LedCommand, TagAddress, TagState};
use vergence_firmware::store::decode_bond;
use vergence_tag::cbor::{self, MAX_BYTES};
use vergence_tag::{Command, gatt};

/// Work on one tag over a link.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Task {
    /// Read the record.
    Record,
    /// Command the LED.
    Command(Command),
    /// Write a record.
    Write(Vec<u8>),
    /// Read what the tag tells of itself.
    Info,
    /// Pair, with the passkey on the tag or without.
    Pair(Option<u32>),
    /// End a link that is held for a light.
    Release,
}

impl Task {
    /// Writes a record that is one; the tag checks it once more.
    pub fn write(tag: TagAddress, record: &[u8]) -> Result<Self, DeviceError> {
        let unfit = |what: String| DeviceError::Unsupported { device: name(tag), what };
        if record.len() > MAX_BYTES {
            return Err(unfit(format!("a record has {MAX_BYTES} bytes at most")));
        }
        cbor::decode(record).map_err(|error| unfit(error.to_string()))?;
        Ok(Task::Write(record.to_vec()))
    }
}

/// What a tag is told for a command of its light, which plays until the tag's own limit.
pub(crate) fn led_command(command: LedCommand) -> Command {
    match command {
        LedCommand::Play(pattern) => Command::Play { pattern, limit: None },
        LedCommand::Stop => Command::Stop,
    }
}

/// A tag in errors.
pub(crate) fn name(tag: TagAddress) -> String {
    format!("tag {tag}")
}

pub(crate) fn wrong_answer(tag: TagAddress) -> DeviceError {
    DeviceError::Fault { device: name(tag), fault: "another answer than was asked for".into() }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Job {
    Scan(Duration),
    Attend { tag: TagAddress, task: Task, timeout: Duration },
    AddBond(Bond),
}

/// What a tag tells of itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TagInfo {
    /// Manufacturer.
    pub manufacturer: String,
    /// Model.
    pub model: String,
    /// Firmware version.
    pub firmware: String,
    /// Battery level (percent), when it is known.
    pub battery: Option<u8>,
    /// The tag holds a record.
    pub has_record: bool,
    /// The LED is playing.
    pub playing: bool,
    /// Signal strength of the tag at the robot (dBm).
    pub rssi: Option<i8>,
}

/// A pairing that is to outlast the process: the key and the tag it belongs to. Secret.
#[derive(Clone, PartialEq, Eq)]
pub struct Bond(pub(crate) [u8; BOND_BYTES]);

/// Bytes of a [`Bond`].
pub const BOND_BYTES: usize = vergence_firmware::store::BOND_BYTES;

impl Bond {
    /// From [`Bond::to_bytes`].
    pub fn from_bytes(bytes: [u8; BOND_BYTES]) -> Self {
        Bond(bytes)
    }

    /// Both are of the same tag, so that the later one is the one that counts.
    pub fn is_of_same_tag(&self, other: &Bond) -> bool {
        let identity = |bond: &Bond| decode_bond(&bond.0).map(|bond| bond.identity);
        match (identity(self), identity(other)) {
            (Some(own), Some(other)) => own.match_identity(&other),
            _ => false,
        }
    }

    /// For a file that nobody else reads.
    pub fn to_bytes(&self) -> [u8; BOND_BYTES] {
        self.0
    }
}

impl std::fmt::Debug for Bond {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Bond(secret)")
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Answer {
    Heard(Vec<Advertisement>),
    Record(Vec<u8>),
    State(TagState),
    Info(TagInfo),
    /// The bond, unless the tag makes none.
    Paired(Option<Bond>),
    Done,
}

/// Why a job failed.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Fault {
    /// Its time was up.
    Late,
    /// The link broke or was never made; worth another try.
    Lost,
    /// The tag refuses or answers nonsense; another try would not help.
    Refused(String),
    /// A pairing with a passkey that went without it; the bond was dropped.
    Unproven,
    /// The tag ended the link after a pairing without its passkey.
    Unwanted,
    /// The controller is gone.
    Dead(String),
}

/// A failure of the host in words.
pub(crate) fn describe<E: core::fmt::Debug>(error: &BleHostError<E>) -> String {
    match error {
        BleHostError::Controller(error) => format!("{error:?}"),
        BleHostError::BleHost(error) => format!("{error:?}"),
    }
}

impl Fault {
    /// What a failure of the host means for the job.
    pub fn of<E: core::fmt::Debug>(error: BleHostError<E>) -> Self {
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
                Error::Disconnected
                | Error::Timeout
                | Error::NotFound
                | Error::ConnectionLimitReached,
            ) => Fault::Lost,
            other => Fault::Refused(format!("answers nonsense ({})", describe(&other))),
        }
    }

    /// As callers of the device traits see it.
    pub fn device_error(self, device: String, timeout: Duration) -> DeviceError {
        match self {
            Fault::Late => DeviceError::Timeout { device, timeout },
            Fault::Lost => DeviceError::Disconnected { device, reason: "the link broke".into() },
            Fault::Refused(fault) => DeviceError::Fault { device, fault },
            Fault::Unproven => {
                let fault = "pairing failed: it did not ask for the passkey, so that nothing proves \
                             it; is it this tag, and has it a passkey?";
                DeviceError::Fault { device, fault: fault.into() }
            }
            Fault::Unwanted => {
                let fault = "pairing failed: the tag ended the link afterwards; pair with its \
                             passkey if it has one";
                DeviceError::Fault { device, fault: fault.into() }
            }
            Fault::Dead(reason) => DeviceError::Disconnected { device, reason },
        }
    }
}

pub(crate) type Outcome = Result<Answer, Fault>;

/// Jobs on their way to the radio thread.
#[derive(Clone, Default)]
pub(crate) struct Inbox(Arc<Mutex<Queue>>);

#[derive(Default)]
struct Queue {
    jobs: VecDeque<(Job, Sender<Outcome>)>,
    waker: Option<Waker>,
    closed: bool,
}

impl Inbox {
    fn lock(&self) -> std::sync::MutexGuard<'_, Queue> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands over a job; its outcome goes to `reply`.
    pub fn push(&self, job: Job, reply: Sender<Outcome>) {
        let mut queue = self.lock();
        queue.jobs.push_back((job, reply));
        queue.wake();
    }

    /// Nothing more will come.
    pub fn close(&self) {
        let mut queue = self.lock();
        queue.closed = true;
        queue.wake();
    }

    /// The next job; `None` when the inbox is closed.
    pub async fn next(&self) -> Option<(Job, Sender<Outcome>)> {
        poll_fn(|cx| {
            let mut queue = self.lock();
            match queue.jobs.pop_front() {
                Some(job) => Poll::Ready(Some(job)),
                None if queue.closed => Poll::Ready(None),
                None => {
                    queue.waker = Some(cx.waker().clone());
                    Poll::Pending
                }
            }
        })
        .await
    }
}

impl Queue {
    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }
}
