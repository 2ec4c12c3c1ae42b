//! What the tests of this crate share: records, a clock, and a Bluetooth host without any manners.
#![allow(dead_code)] // Every test program uses its part.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use vergence_air::{Air, Controller};
use vergence_devices::{Clock, TagAddress};
use vergence_firmware::Config;
use vergence_link::VirtualTag;
use vergence_tag::{Record, cbor};

pub const TIMEOUT: Duration = Duration::from_secs(5);

#[derive(Default)]
pub struct TestClock(AtomicU64);

impl Clock for TestClock {
    fn now(&self) -> Duration {
        Duration::from_micros(self.0.load(Ordering::SeqCst))
    }

    fn sleep(&self, duration: Duration) {
        self.0.fetch_add(duration.as_micros() as u64, Ordering::SeqCst);
    }
}

pub fn clock() -> Arc<TestClock> {
    Arc::new(TestClock::default())
}

pub fn record(id: &str) -> Vec<u8> {
    let text = format!(
        r#"{{"object_id": "{id}", "landmarks": [{{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}}],
        "bounding_box": {{"width": 0.08, "length": 0.08, "height": 0.09}}, "shape": {{"kind": "box"}}}}"#
    );
    let record: Record = serde_json::from_str(&text).unwrap();
    let mut bytes = Vec::new();
    cbor::encode(&record, &mut bytes).unwrap();
    bytes
}

pub fn address(number: u8) -> TagAddress {
    TagAddress([0xC0, 1, 2, 3, 4, number])
}

pub fn tag(id: &str, number: u8) -> VirtualTag {
    VirtualTag {
        address: address(number),
        record: record(id),
        lights: 1,
        battery: 80,
        config: Config::default(),
    }
}

/// A host that sends whatever it likes.
pub struct RawHost {
    controller: Controller,
    pub handle: u16,
}

impl RawHost {
    pub fn new(air: &Air, address: TagAddress) -> Self {
        let host = RawHost { controller: air.controller(address.0), handle: 0 };
        host.command(0x0C03, &[]);
        let mut own = address.0;
        own.reverse();
        host.command(0x2005, &own);
        host
    }

    pub fn command(&self, opcode: u16, parameters: &[u8]) {
        let [low, high] = opcode.to_le_bytes();
        let head = [1, low, high, parameters.len() as u8];
        self.controller.host_sends(&[&head, parameters].concat());
    }

    /// The next packet that is no answer to a command.
    pub async fn next(&self) -> Vec<u8> {
        loop {
            let packet = self.controller.next_for_host().await;
            if !matches!(packet[..], [4, 0x0E | 0x0F | 0x13, ..]) {
                return packet;
            }
        }
    }

    async fn connected(&mut self) {
        loop {
            if let [4, 0x3E, _, 0x01, 0, low, high, ..] = self.next().await[..] {
                self.handle = u16::from_le_bytes([low, high]);
                return;
            }
        }
    }

    /// Connects to a tag at 15 ms with a supervision timeout of 2 s.
    pub async fn connect(&mut self, tag: TagAddress) {
        let mut peer = tag.0;
        peer.reverse();
        let scan = [0x30, 0, 0x30, 0, 0, 1];
        let timing = [1, 12, 0, 12, 0, 0, 0, 200, 0, 0, 0, 0, 0];
        self.command(0x200D, &[&scan[..], &peer, &timing].concat());
        self.connected().await;
    }

    /// Advertises with these data, and waits for a robot.
    pub async fn accept(&mut self, data: &[u8], response: &[u8]) {
        let padded = |bytes: &[u8]| {
            let mut out = [0; 32];
            out[0] = bytes.len() as u8;
            out[1..1 + bytes.len()].copy_from_slice(bytes);
            out
        };
        self.command(0x2006, &[0xA0, 0, 0xA0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 7, 0]);
        self.command(0x2008, &padded(data));
        self.command(0x2009, &padded(response));
        self.command(0x200A, &[1]);
        self.connected().await;
    }

    pub fn disconnect(&self) {
        let [low, high] = self.handle.to_le_bytes();
        self.command(0x0406, &[low, high, 0x13]);
    }

    /// One HCI data packet as it is.
    pub fn fragment(&self, first: bool, data: &[u8]) {
        let handle = self.handle | if first { 0 } else { 0x1000 };
        let head = [&[2][..], &handle.to_le_bytes(), &(data.len() as u16).to_le_bytes()].concat();
        self.controller.host_sends(&[&head[..], data].concat());
    }

    /// A whole L2CAP frame, in pieces of 251 bytes.
    pub fn frame(&self, channel: u16, payload: &[u8]) {
        let head = [(payload.len() as u16).to_le_bytes(), channel.to_le_bytes()].concat();
        let frame = [&head[..], payload].concat();
        for (k, piece) in frame.chunks(251).enumerate() {
            self.fragment(k == 0, piece);
        }
    }

    /// The next attribute PDU from the other side; `None` when the link has ended.
    pub async fn attribute(&self) -> Option<Vec<u8>> {
        loop {
            match &self.next().await[..] {
                [4, 0x05, ..] => return None,
                [2, _, _, _, _, _, _, 4, 0, pdu @ ..] => return Some(pdu.to_vec()),
                _ => {}
            }
        }
    }
}
