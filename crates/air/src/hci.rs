//! The few parts of the Host Controller Interface that the virtual controllers speak: opcodes,
//! events and error codes (Bluetooth Core 5.4, volume 4, part E), as bytes with the H4 packet
//! indicator in front.

/// Command opcodes (OGF << 10 | OCF).
pub mod op {
    #![allow(missing_docs)] // The names are the specification's.
    pub const DISCONNECT: u16 = 0x0406;
    pub const READ_REMOTE_VERSION: u16 = 0x041D;
    pub const SET_EVENT_MASK: u16 = 0x0C01;
    pub const RESET: u16 = 0x0C03;
    pub const HOST_BUFFER_SIZE: u16 = 0x0C33;
    pub const SET_EVENT_MASK_2: u16 = 0x0C63;
    pub const READ_LOCAL_VERSION: u16 = 0x1001;
    pub const READ_LOCAL_COMMANDS: u16 = 0x1002;
    pub const READ_LOCAL_FEATURES: u16 = 0x1003;
    pub const READ_BUFFER_SIZE: u16 = 0x1005;
    pub const READ_BD_ADDR: u16 = 0x1009;
    pub const READ_RSSI: u16 = 0x1405;
    pub const LE_SET_EVENT_MASK: u16 = 0x2001;
    pub const LE_READ_BUFFER_SIZE: u16 = 0x2002;
    pub const LE_READ_LOCAL_FEATURES: u16 = 0x2003;
    pub const LE_SET_RANDOM_ADDRESS: u16 = 0x2005;
    pub const LE_SET_ADV_PARAMS: u16 = 0x2006;
    pub const LE_READ_ADV_TX_POWER: u16 = 0x2007;
    pub const LE_SET_ADV_DATA: u16 = 0x2008;
    pub const LE_SET_SCAN_RESPONSE: u16 = 0x2009;
    pub const LE_SET_ADV_ENABLE: u16 = 0x200A;
    pub const LE_SET_SCAN_PARAMS: u16 = 0x200B;
    pub const LE_SET_SCAN_ENABLE: u16 = 0x200C;
    pub const LE_CREATE_CONNECTION: u16 = 0x200D;
    pub const LE_CREATE_CONNECTION_CANCEL: u16 = 0x200E;
    pub const LE_READ_ACCEPT_LIST_SIZE: u16 = 0x200F;
    pub const LE_CLEAR_ACCEPT_LIST: u16 = 0x2010;
    pub const LE_ADD_TO_ACCEPT_LIST: u16 = 0x2011;
    pub const LE_REMOVE_FROM_ACCEPT_LIST: u16 = 0x2012;
    pub const LE_CONNECTION_UPDATE: u16 = 0x2013;
    pub const LE_READ_REMOTE_FEATURES: u16 = 0x2016;
    pub const LE_RAND: u16 = 0x2018;
    pub const LE_ENABLE_ENCRYPTION: u16 = 0x2019;
    pub const LE_LTK_REPLY: u16 = 0x201A;
    pub const LE_LTK_NEGATIVE_REPLY: u16 = 0x201B;
    pub const LE_READ_STATES: u16 = 0x201C;
    pub const LE_SET_DATA_LENGTH: u16 = 0x2022;
    pub const LE_READ_DEFAULT_DATA_LENGTH: u16 = 0x2023;
    pub const LE_WRITE_DEFAULT_DATA_LENGTH: u16 = 0x2024;
    pub const LE_ADD_TO_RESOLVING_LIST: u16 = 0x2027;
    pub const LE_REMOVE_FROM_RESOLVING_LIST: u16 = 0x2028;
    pub const LE_CLEAR_RESOLVING_LIST: u16 = 0x2029;
    pub const LE_READ_RESOLVING_LIST_SIZE: u16 = 0x202A;
    pub const LE_SET_ADDRESS_RESOLUTION: u16 = 0x202D;
    pub const LE_SET_RPA_TIMEOUT: u16 = 0x202E;
    pub const LE_READ_MAX_DATA_LENGTH: u16 = 0x202F;
    pub const LE_SET_DEFAULT_PHY: u16 = 0x2031;
    pub const LE_SET_PRIVACY_MODE: u16 = 0x204E;
}

/// Error codes (volume 1, part F).
pub mod status {
    #![allow(missing_docs)]
    pub const SUCCESS: u8 = 0x00;
    pub const UNKNOWN_COMMAND: u8 = 0x01;
    pub const UNKNOWN_CONNECTION: u8 = 0x02;
    pub const KEY_MISSING: u8 = 0x06;
    pub const SUPERVISION_TIMEOUT: u8 = 0x08;
    pub const DISALLOWED: u8 = 0x0C;
    pub const INVALID_PARAMETERS: u8 = 0x12;
    pub const LOCAL_HOST_TERMINATED: u8 = 0x16;
    pub const MIC_FAILURE: u8 = 0x3D;
}

/// First byte of an H4 packet.
pub mod kind {
    #![allow(missing_docs)]
    pub const COMMAND: u8 = 1;
    pub const ACL: u8 = 2;
    pub const EVENT: u8 = 4;
}

fn event(code: u8, parameters: &[u8]) -> Vec<u8> {
    // An event's length is one byte; every event built here is shorter.
    let mut packet = vec![kind::EVENT, code, parameters.len() as u8];
    packet.extend_from_slice(parameters);
    packet
}

fn le_event(subevent: u8, parameters: &[u8]) -> Vec<u8> {
    event(0x3E, &[&[subevent], parameters].concat())
}

/// Command Complete: `returned` begins with the status.
pub fn command_complete(opcode: u16, returned: &[u8]) -> Vec<u8> {
    let [low, high] = opcode.to_le_bytes();
    event(0x0E, &[&[1, low, high], returned].concat())
}

/// Command Status.
pub fn command_status(opcode: u16, status: u8) -> Vec<u8> {
    let [low, high] = opcode.to_le_bytes();
    event(0x0F, &[status, 1, low, high])
}

/// Disconnection Complete.
pub fn disconnected(handle: u16, reason: u8) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    event(0x05, &[0, low, high, reason])
}

/// Number Of Completed Packets, one packet.
pub fn completed(handle: u16) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    event(0x13, &[1, low, high, 1, 0])
}

/// Encryption Change.
pub fn encryption_change(handle: u16, status: u8, on: bool) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    event(0x08, &[status, low, high, u8::from(on)])
}

/// Encryption Key Refresh Complete.
pub fn key_refreshed(handle: u16) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    event(0x30, &[0, low, high])
}

/// Read Remote Version Information Complete: 5.4, no company.
pub fn remote_version(handle: u16) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    event(0x0C, &[0, low, high, 0x0D, 0xFF, 0xFF, 0, 0])
}

/// A Bluetooth address with its kind (0 public, 1 random), least significant byte first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Address {
    /// 0 public, 1 random.
    pub kind: u8,
    /// Least significant byte first, as on the wire.
    pub bytes: [u8; 6],
}

/// Timing of a link in the units of the interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkTiming {
    /// Connection interval (1.25 ms).
    pub interval: u16,
    /// Peripheral latency (events).
    pub latency: u16,
    /// Supervision timeout (10 ms).
    pub timeout: u16,
}

impl LinkTiming {
    fn bytes(self) -> [u8; 6] {
        let ([a, b], [c, d]) = (self.interval.to_le_bytes(), self.latency.to_le_bytes());
        let [e, f] = self.timeout.to_le_bytes();
        [a, b, c, d, e, f]
    }
}

/// LE Connection Complete, successful.
pub fn connected(handle: u16, peripheral: bool, peer: Address, timing: LinkTiming) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    let head = [0, low, high, u8::from(peripheral), peer.kind];
    le_event(0x01, &[&head[..], &peer.bytes, &timing.bytes(), &[0]].concat())
}

/// LE Connection Complete that tells of a connection that was not made.
pub fn not_connected(status: u8) -> Vec<u8> {
    let mut parameters = [0; 18];
    parameters[0] = status;
    le_event(0x01, &parameters)
}

/// LE Advertising Report of one advertisement or scan response (31 bytes at most).
pub fn advertising_report(event_type: u8, from: Address, data: &[u8], rssi: i8) -> Vec<u8> {
    let head = [1, event_type, from.kind];
    let length = [data.len() as u8];
    le_event(0x02, &[&head[..], &from.bytes, &length, data, &[rssi as u8]].concat())
}

/// LE Connection Update Complete.
pub fn connection_updated(handle: u16, timing: LinkTiming) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    le_event(0x03, &[&[0, low, high][..], &timing.bytes()].concat())
}

/// LE Read Remote Features Complete: encryption only.
pub fn remote_features(handle: u16) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    le_event(0x04, &[0, low, high, 1, 0, 0, 0, 0, 0, 0, 0])
}

/// LE Long Term Key Request.
pub fn key_request(handle: u16, rand: &[u8; 8], ediv: &[u8; 2]) -> Vec<u8> {
    let [low, high] = handle.to_le_bytes();
    le_event(0x05, &[&[low, high][..], rand, ediv].concat())
}
