//! What a tag says into the air: its advertisement and its scan response.
//!
//! The advertisement holds flags, the UUID of the tag service (a list, which discovery filters
//! match) and a short id: a hash of the object id under the company number that is reserved for
//! tests. The scan response holds the name, which is the object id as far as it fits, and battery and
//! LED state as BTHome version 2 (service data 0xFCD2), so that home gateways show them without
//! connecting. Both fit the 31 bytes of legacy advertising.

use core::str::from_utf8;

use crate::gatt;

/// Most bytes of one legacy advertisement.
pub const MAX_ADVERTISEMENT: usize = 31;
/// Most bytes of the object id that fit the scan response.
pub const MAX_NAME: usize = 20;

const FLAGS: u8 = 0x01;
const UUIDS_128: u8 = 0x07;
const SHORT_NAME: u8 = 0x08;
const NAME: u8 = 0x09;
const SERVICE_DATA: u8 = 0x16;
const MANUFACTURER: u8 = 0xFF;
const BTHOME: [u8; 2] = [0xD2, 0xFC];
const BTHOME_BATTERY: u8 = 0x01;
const BTHOME_BOOLEAN: u8 = 0x0F;
const TEST_COMPANY: [u8; 2] = [0xFF, 0xFF];

/// Bytes of an advertisement.
pub type Packet = heapless::Vec<u8, MAX_ADVERTISEMENT>;

/// Six bytes that stand for an object id (FNV-1a, 64 bits, folded).
pub fn short_id(object_id: &str) -> [u8; 6] {
    let hash = object_id.bytes().fold(0xCBF2_9CE4_8422_2325u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3)
    });
    let [a, b, c, d, e, f, g, h] = hash.to_le_bytes();
    [a ^ g, b ^ h, c, d, e, f]
}

/// The advertisement of a tag.
pub fn advertisement(object_id: &str) -> Packet {
    let mut packet = Packet::new();
    // General discoverable, no BR/EDR.
    entry(&mut packet, FLAGS, &[&[0x06]]);
    entry(&mut packet, UUIDS_128, &[&gatt::SERVICE.to_le_bytes()]);
    entry(&mut packet, MANUFACTURER, &[&TEST_COMPANY, &short_id(object_id)]);
    packet
}

/// The scan response of a tag.
pub fn scan_response(object_id: &str, battery: Option<u8>, playing: bool) -> Packet {
    let mut packet = Packet::new();
    let mut end = object_id.len().min(MAX_NAME);
    while !object_id.is_char_boundary(end) {
        end -= 1;
    }
    let kind = if end == object_id.len() { NAME } else { SHORT_NAME };
    entry(&mut packet, kind, &[&object_id.as_bytes()[..end]]);
    // Version 2, not encrypted, sent at intervals.
    let head = [BTHOME[0], BTHOME[1], 0x40];
    let state = [BTHOME_BOOLEAN, u8::from(playing)];
    match battery {
        Some(level) => {
            let level = [BTHOME_BATTERY, level.min(100)];
            entry(&mut packet, SERVICE_DATA, &[&head, &level, &state]);
        }
        None => entry(&mut packet, SERVICE_DATA, &[&head, &state]),
    }
    packet
}

/// Appends one structure; everything that is built here fits, by [`MAX_NAME`].
fn entry(packet: &mut Packet, kind: u8, parts: &[&[u8]]) {
    let length = 1 + parts.iter().map(|part| part.len()).sum::<usize>();
    let _ = packet.extend_from_slice(&[length as u8, kind]);
    for part in parts {
        let _ = packet.extend_from_slice(part);
    }
}

/// What was heard of one tag, from one or both of its packets.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Beacon {
    /// It advertises the tag service.
    pub is_tag: bool,
    /// Hash of its object id.
    pub short_id: Option<[u8; 6]>,
    /// Its object id, or the beginning of it.
    pub name: Option<heapless::String<MAX_NAME>>,
    /// Battery level (percent).
    pub battery: Option<u8>,
    /// The LED is playing.
    pub playing: Option<bool>,
}

impl Beacon {
    /// Adds what a packet tells. Packets that are not well formed are read as far as they are.
    pub fn hear(&mut self, packet: &[u8]) {
        let mut rest = packet;
        while let [length, tail @ ..] = rest {
            let length = usize::from(*length);
            let Some((structure, next)) = tail.split_at_checked(length) else { return };
            rest = next;
            let [kind, data @ ..] = structure else { return };
            self.note(*kind, data);
        }
    }

    fn note(&mut self, kind: u8, data: &[u8]) {
        match kind {
            UUIDS_128 => {
                self.is_tag |= data.chunks_exact(16).any(|u| u == gatt::SERVICE.to_le_bytes());
            }
            MANUFACTURER => {
                if let Some(id) = data.strip_prefix(&TEST_COMPANY) {
                    self.short_id = id.try_into().ok().or(self.short_id);
                }
            }
            NAME | SHORT_NAME => {
                let name = from_utf8(data).ok().and_then(|n| n.try_into().ok());
                self.name = name.or(self.name.take());
            }
            SERVICE_DATA => {
                let Some([_, objects @ ..]) = data.strip_prefix(&BTHOME) else { return };
                for object in objects.chunks_exact(2) {
                    match object[0] {
                        BTHOME_BATTERY => self.battery = (object[1] <= 100).then_some(object[1]),
                        BTHOME_BOOLEAN => self.playing = Some(object[1] != 0),
                        // Objects of unknown size follow.
                        _ => return,
                    }
                }
            }
            _ => {}
        }
    }

    /// The claimed object id, when name and short id were heard and agree.
    pub fn object_id(&self) -> Option<&str> {
        let name = self.name.as_deref()?;
        let whole = self.short_id.is_none_or(|id| id == short_id(name));
        // The hash of a name that was cut is another.
        (whole || may_be_cut(name)).then_some(name)
    }
}

/// A name of full length may be the beginning of a longer one; a character has up to four bytes.
fn may_be_cut(name: &str) -> bool {
    name.len() + 4 > MAX_NAME
}

/// What is advertised under this name may be this object: of a long id only the beginning fits the
/// air, so that no more than the record can tell.
pub fn may_be(name: &str, object_id: &str) -> bool {
    name == object_id || may_be_cut(name) && object_id.starts_with(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn what_is_said_is_heard(id in "[a-zA-Z0-9 äµ-]{1,48}", battery in prop::option::of(0u8..=100), playing: bool) {
            let mut beacon = Beacon::default();
            let (first, second) = (advertisement(&id), scan_response(&id, battery, playing));
            prop_assert!(first.len() <= MAX_ADVERTISEMENT);
            prop_assert_eq!(usize::from(second[0]) + usize::from(second[usize::from(second[0]) + 1]) + 2, second.len());
            beacon.hear(&first);
            prop_assert!(beacon.is_tag);
            prop_assert_eq!(beacon.object_id(), None);
            beacon.hear(&second);
            prop_assert_eq!(beacon.short_id, Some(short_id(&id)));
            let name = beacon.object_id().unwrap();
            prop_assert!(may_be(name, &id));
            prop_assert!(!may_be("cup", "cupboard"));
            prop_assert!(id.starts_with(name) && (name.len() == id.len() || name.len() > MAX_NAME - 4));
            prop_assert_eq!((beacon.battery, beacon.playing), (battery, Some(playing)));
        }

        #[test]
        fn no_packet_panics(packet in prop::collection::vec(any::<u8>(), 0..64)) {
            Beacon::default().hear(&packet);
        }
    }

    #[test]
    fn a_name_that_does_not_match_its_hash_is_no_id() {
        let mut beacon = Beacon::default();
        beacon.hear(&advertisement("cup"));
        beacon.hear(&scan_response("can", None, false));
        assert_eq!(beacon.object_id(), None);
    }
}
