//! One virtual controller: the commands of its host, and the byte stream to and from it.

use std::collections::{BTreeMap, VecDeque};
use std::convert::Infallible;
use std::fmt;
use std::future::poll_fn;
use std::task::{Poll, Waker};

use bt_hci_transport::{PacketKind, PacketToController, PacketToHost, ReadHciError, Transport};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::advertising::{Advertising, Initiating, Scanning};
use crate::hci::{self, Address, LinkTiming, kind, op, status};
use crate::medium::{Air, DeviceId, Medium};

/// Most addresses on an accept list.
const ACCEPT_LIST: usize = 16;

pub(crate) struct Device {
    pub powered: bool,
    public: [u8; 6],
    random: [u8; 6],
    pub advertising: Advertising,
    pub scanning: Scanning,
    pub initiating: Option<Initiating>,
    pub accept_list: Vec<Address>,
    pub handles: BTreeMap<u16, u32>,
    next_handle: u16,
    pub to_host: VecDeque<Vec<u8>>,
    host: Option<Waker>,
    rng: Pcg32,
}

impl Device {
    pub fn new(address: [u8; 6], seed: u64) -> Self {
        let mut public = address;
        public.reverse();
        Device {
            powered: true,
            public,
            random: [0; 6],
            advertising: Advertising::default(),
            scanning: Scanning::default(),
            initiating: None,
            accept_list: Vec::new(),
            handles: BTreeMap::new(),
            next_handle: 0,
            to_host: VecDeque::new(),
            host: None,
            rng: Pcg32::seed_from_u64(seed),
        }
    }

    /// Forgets what its host had set up. Links that were there die unheard.
    pub fn reset(&mut self) {
        self.advertising = self.advertising.stopped();
        self.scanning = Scanning::default();
        self.initiating = None;
        self.accept_list.clear();
        self.handles.clear();
        self.to_host.clear();
    }

    pub fn own_address(&self, kind: u8) -> Address {
        match kind & 1 {
            0 => Address { kind: 0, bytes: self.public },
            _ => Address { kind: 1, bytes: self.random },
        }
    }

    pub fn new_handle(&mut self, link: u32) -> u16 {
        // Handles have 12 bits; those in use are stepped over.
        while self.handles.contains_key(&self.next_handle) {
            self.next_handle = (self.next_handle + 1) % 0x0F00;
        }
        let handle = self.next_handle;
        self.next_handle = (self.next_handle + 1) % 0x0F00;
        self.handles.insert(handle, link);
        handle
    }

    pub fn send(&mut self, packet: Vec<u8>) {
        self.to_host.push_back(packet);
        self.wake();
    }

    pub fn wake(&mut self) {
        if let Some(host) = self.host.take() {
            host.wake();
        }
    }
}

/// A virtual controller as its host sees it: an HCI transport.
pub struct Controller {
    pub(crate) air: Air,
    pub(crate) device: usize,
}

impl Controller {
    /// Its number on the air.
    pub fn id(&self) -> DeviceId {
        DeviceId(self.device)
    }

    /// Takes one packet from the host, with its H4 indicator in front. What is no command and no
    /// data is ignored, as a controller's UART does after a loss of synchronisation.
    pub fn host_sends(&self, packet: &[u8]) {
        let mut medium = self.air.0.borrow_mut();
        if !medium.devices[self.device].powered {
            return;
        }
        match packet.split_first() {
            Some((&kind::COMMAND, command)) => medium.command(self.device, command),
            Some((&kind::ACL, data)) => medium.send_acl(self.device, data),
            _ => {}
        }
    }

    /// The next packet for the host, with its H4 indicator in front.
    pub async fn next_for_host(&self) -> Vec<u8> {
        poll_fn(|cx| {
            let mut medium = self.air.0.borrow_mut();
            let device = &mut medium.devices[self.device];
            match device.to_host.pop_front() {
                Some(packet) => Poll::Ready(packet),
                None => {
                    device.host = Some(cx.waker().clone());
                    Poll::Pending
                }
            }
        })
        .await
    }
}

/// A packet that its receiver could not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TransportError(ReadHciError<Infallible>);

impl TransportError {
    /// The stream has ended.
    pub(crate) const CLOSED: TransportError =
        TransportError(ReadHciError::Read(embedded_io::ReadExactError::UnexpectedEof));
}

impl fmt::Display for TransportError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            TransportError::CLOSED => f.write_str("the connection to the controller has ended"),
            TransportError(error) => write!(f, "unreadable HCI packet: {error}"),
        }
    }
}

impl std::error::Error for TransportError {}

impl embedded_io::Error for TransportError {
    fn kind(&self) -> embedded_io::ErrorKind {
        embedded_io::Error::kind(&self.0)
    }
}

impl From<ReadHciError<Infallible>> for TransportError {
    fn from(error: ReadHciError<Infallible>) -> Self {
        TransportError(error)
    }
}

/// Reads a host's view of an H4 packet out of its bytes.
pub(crate) fn parse<'a, P: PacketToHost<'a>>(
    packet: &[u8],
    rx: &'a mut [u8],
) -> Result<P, TransportError> {
    let mut rest = packet;
    let narrowed = |error| match error {
        ReadHciError::BufferTooSmall => TransportError(ReadHciError::BufferTooSmall),
        _ => TransportError(ReadHciError::InvalidValue),
    };
    let kind = PacketKind::read(&mut rest).map_err(narrowed)?;
    P::read_hci(kind, &mut rest, rx).map_err(narrowed)
}

/// The H4 bytes of a packet to the controller.
pub(crate) fn serialise<P: PacketToController>(packet: &P) -> Vec<u8> {
    let mut bytes = vec![0; 1 + packet.size()];
    bytes[0] = P::KIND as u8;
    // The space is exactly what the packet says it needs.
    let _ = packet.write_hci(&mut bytes[1..]);
    bytes
}

impl embedded_io::ErrorType for Controller {
    type Error = TransportError;
}

impl Transport for Controller {
    async fn read<'a, P: PacketToHost<'a>>(&self, rx: &'a mut [u8]) -> Result<P, TransportError> {
        parse(&self.next_for_host().await, rx)
    }

    async fn write<P: PacketToController>(&self, packet: &P) -> Result<(), TransportError> {
        self.host_sends(&serialise(packet));
        Ok(())
    }
}

impl Medium {
    /// Carries out one command and sends its answer.
    fn command(&mut self, device: usize, command: &[u8]) {
        let Some((head, parameters)) = command.split_first_chunk::<3>() else { return };
        let opcode = u16::from_le_bytes([head[0], head[1]]);
        let parameters = &parameters[..parameters.len().min(usize::from(head[2]))];
        let answer = match self.link_command(device, opcode, parameters) {
            Some(answer) => answer,
            None => {
                let returned = self
                    .own_command(device, opcode, parameters)
                    .unwrap_or_else(|| vec![status::UNKNOWN_COMMAND]);
                hci::command_complete(opcode, &returned)
            }
        };
        let cancelled = opcode == op::LE_CREATE_CONNECTION_CANCEL && answer.last() == Some(&0);
        let device = &mut self.devices[device];
        device.send(answer);
        if cancelled {
            device.send(hci::not_connected(status::UNKNOWN_CONNECTION));
        }
    }

    /// Commands about a link, answered by Command Status and an event, or by their handle.
    fn link_command(&mut self, device: usize, opcode: u16, p: &[u8]) -> Option<Vec<u8>> {
        let handle = p.first_chunk::<2>().map(|h| u16::from_le_bytes(*h));
        let word = |at: usize| u16::from_le_bytes([p[at], p[at + 1]]);
        let known = handle.and_then(|h| self.find_link(device, h));
        let [low, high] = handle.unwrap_or(0).to_le_bytes();
        let missing = if known.is_some() { status::SUCCESS } else { status::UNKNOWN_CONNECTION };
        let state = match (opcode, handle) {
            (op::LE_CREATE_CONNECTION, _) => p
                .first_chunk()
                .map_or(status::INVALID_PARAMETERS, |p| self.create_connection(device, p)),
            (op::DISCONNECT, Some(handle)) if p.len() == 3 => self.disconnect(device, handle, p[2]),
            (op::LE_CONNECTION_UPDATE, Some(handle)) if p.len() == 14 => {
                let timing = LinkTiming { interval: word(4), latency: word(6), timeout: word(8) };
                self.request_update(device, handle, timing)
            }
            (op::LE_ENABLE_ENCRYPTION, Some(handle)) if p.len() == 28 => {
                let (mut rand, mut key) = ([0; 8], [0; 16]);
                rand.copy_from_slice(&p[2..10]);
                key.copy_from_slice(&p[12..]);
                self.start_encryption(device, handle, &rand, &[p[10], p[11]], key)
            }
            (op::LE_READ_REMOTE_FEATURES | op::READ_REMOTE_VERSION, Some(handle)) => {
                let event = match opcode {
                    op::READ_REMOTE_VERSION => hci::remote_version(handle),
                    _ => hci::remote_features(handle),
                };
                self.devices[device].send(hci::command_status(opcode, missing));
                if known.is_some() {
                    return Some(event);
                }
                missing
            }
            (op::LE_LTK_REPLY | op::LE_LTK_NEGATIVE_REPLY, Some(handle)) => {
                let key = p.get(2..18).map(|k| {
                    let mut key = [0; 16];
                    key.copy_from_slice(k);
                    key
                });
                let state = self.answer_key(device, handle, key);
                return Some(hci::command_complete(opcode, &[state, low, high]));
            }
            (op::READ_RSSI, Some(_)) => {
                let rssi = known.and_then(|(id, side)| {
                    let link = self.links.get(&id)?;
                    self.rssi(link.ends[1 - side].device, device)
                });
                // 127: cannot be told.
                let rssi = rssi.unwrap_or(127) as u8;
                return Some(hci::command_complete(opcode, &[missing, low, high, rssi]));
            }
            (op::LE_SET_DATA_LENGTH, Some(_)) => {
                return Some(hci::command_complete(opcode, &[missing, low, high]));
            }
            _ => return None,
        };
        Some(hci::command_status(opcode, state))
    }

    /// Commands about the controller itself: the returned parameters; `None` when unknown.
    fn own_command(&mut self, device: usize, opcode: u16, p: &[u8]) -> Option<Vec<u8>> {
        let (length, packets) = (self.config.acl_bytes.to_le_bytes(), self.config.acl_packets);
        let bad = status::INVALID_PARAMETERS;
        let on = p.first() == Some(&1);
        let state = match opcode {
            op::LE_SET_ADV_PARAMS => {
                p.first_chunk().map_or(bad, |p| self.set_advertising(device, p))
            }
            op::LE_SET_ADV_DATA => self.set_advertising_data(device, p, false),
            op::LE_SET_SCAN_RESPONSE => self.set_advertising_data(device, p, true),
            op::LE_SET_ADV_ENABLE => self.enable_advertising(device, on),
            op::LE_SET_SCAN_PARAMS => p.first_chunk().map_or(bad, |p| self.set_scanning(device, p)),
            op::LE_SET_SCAN_ENABLE => self.enable_scanning(device, on, p.get(1) == Some(&1)),
            op::LE_CREATE_CONNECTION_CANCEL => self.cancel_connection(device),
            op::RESET => {
                self.devices[device].reset();
                status::SUCCESS
            }
            op::LE_SET_RANDOM_ADDRESS => p.first_chunk().map_or(bad, |address| {
                self.devices[device].random = *address;
                status::SUCCESS
            }),
            op::LE_CLEAR_ACCEPT_LIST
            | op::LE_ADD_TO_ACCEPT_LIST
            | op::LE_REMOVE_FROM_ACCEPT_LIST => self.devices[device].edit_accept_list(opcode, p),
            op::SET_EVENT_MASK
            | op::SET_EVENT_MASK_2
            | op::HOST_BUFFER_SIZE
            | op::LE_SET_EVENT_MASK
            | op::LE_WRITE_DEFAULT_DATA_LENGTH
            | op::LE_ADD_TO_RESOLVING_LIST
            | op::LE_REMOVE_FROM_RESOLVING_LIST
            | op::LE_CLEAR_RESOLVING_LIST
            | op::LE_SET_ADDRESS_RESOLUTION
            | op::LE_SET_RPA_TIMEOUT
            | op::LE_SET_DEFAULT_PHY
            | op::LE_SET_PRIVACY_MODE => status::SUCCESS,
            op::LE_RAND => {
                let random: [u8; 8] = self.devices[device].rng.random();
                return Some([&[status::SUCCESS][..], &random].concat());
            }
            op::READ_BD_ADDR => {
                return Some([&[status::SUCCESS][..], &self.devices[device].public].concat());
            }
            op::LE_READ_BUFFER_SIZE => return Some(vec![0, length[0], length[1], packets]),
            op::READ_BUFFER_SIZE => {
                return Some(vec![0, length[0], length[1], 0, packets, 0, 0, 0]);
            }
            _ => return constant(opcode),
        };
        Some(vec![state])
    }
}

impl Device {
    fn edit_accept_list(&mut self, opcode: u16, p: &[u8]) -> u8 {
        let entry = p
            .first_chunk::<7>()
            .map(|[kind, bytes @ ..]| Address { kind: kind & 1, bytes: *bytes });
        match (opcode, entry) {
            (op::LE_CLEAR_ACCEPT_LIST, _) => self.accept_list.clear(),
            (_, None) => return status::INVALID_PARAMETERS,
            (op::LE_REMOVE_FROM_ACCEPT_LIST, Some(entry)) => {
                self.accept_list.retain(|e| *e != entry);
            }
            (_, Some(_)) if self.accept_list.len() >= ACCEPT_LIST => return 0x07,
            (_, Some(entry)) => self.accept_list.push(entry),
        }
        status::SUCCESS
    }
}

/// What every one of these controllers answers.
fn constant(opcode: u16) -> Option<Vec<u8>> {
    Some(match opcode {
        // HCI and LMP 5.4, no company.
        op::READ_LOCAL_VERSION => vec![0, 0x0D, 0, 0, 0x0D, 0xFF, 0xFF, 0, 0],
        // LE supported, BR/EDR not.
        op::READ_LOCAL_FEATURES => vec![0, 0, 0, 0, 0, 0x60, 0, 0, 0],
        op::READ_LOCAL_COMMANDS => supported_commands(),
        // Encryption.
        op::LE_READ_LOCAL_FEATURES => vec![0, 1, 0, 0, 0, 0, 0, 0, 0],
        op::LE_READ_ADV_TX_POWER => vec![0, 0],
        op::LE_READ_ACCEPT_LIST_SIZE => vec![0, ACCEPT_LIST as u8],
        op::LE_READ_RESOLVING_LIST_SIZE => vec![0, 0],
        op::LE_READ_STATES => vec![0, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x03, 0, 0],
        op::LE_READ_DEFAULT_DATA_LENGTH => vec![0, 251, 0, 0x48, 0x08],
        op::LE_READ_MAX_DATA_LENGTH => vec![0, 251, 0, 0x48, 0x08, 251, 0, 0x48, 0x08],
        _ => return None,
    })
}

/// Bits of Read Local Supported Commands (volume 4, part E, 6.27) for what is understood here.
fn supported_commands() -> Vec<u8> {
    let mut answer = vec![0; 65];
    for (octet, bits) in [
        (0, 0x20),  // Disconnect
        (2, 0x80),  // Read Remote Version Information
        (5, 0xC0),  // Set Event Mask, Reset
        (10, 0x40), // Host Buffer Size
        (14, 0xA8), // Read Local Version, Features, Buffer Size
        (15, 0x22), // Read BD_ADDR, Read RSSI
        (25, 0xF7), // LE Set Event Mask to LE Set Advertising Data, without the reserved one
        (26, 0xFF), // LE Set Scan Response Data to LE Clear Accept List
        (27, 0xE7), // Accept list, connection update, remote features, rand, encryption
        (28, 0x0F), // Long-term keys, states
    ] {
        answer[octet + 1] = bits;
    }
    answer
}
