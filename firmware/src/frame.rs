//! Which L2CAP frames are well formed: the check behind [`Guard`](crate::Guard).
//!
//! Only what the two hosts here rely on is checked: lengths, counts and the order of handles, as
//! Bluetooth Core 5.4 (volume 3, parts A, F and H) has them. A peer that sends anything else is
//! broken or hostile, and its frame is worth no answer.

/// Fixed channels.
const ATT: u16 = 4;
const SIGNALLING: u16 = 5;
const SECURITY: u16 = 6;
/// Smallest ATT MTU.
const SMALLEST_MTU: u16 = 23;

/// Checks a whole frame of a channel. An exchange of too small an MTU is raised to the smallest.
pub fn well_formed(channel: u16, payload: &mut [u8]) -> bool {
    match channel {
        ATT => attribute(payload),
        SIGNALLING => signal(payload),
        SECURITY => security(payload),
        // Channels that were never opened.
        _ => false,
    }
}

fn word(bytes: &[u8]) -> u16 {
    match bytes {
        [low, high, ..] => u16::from_le_bytes([*low, *high]),
        _ => 0,
    }
}

fn attribute(pdu: &mut [u8]) -> bool {
    let length = pdu.len();
    match pdu.first() {
        None => false,
        // MTU request and response.
        Some(0x02 | 0x03) => {
            let good = length == 3;
            if good && word(&pdu[1..]) < SMALLEST_MTU {
                pdu[1..].copy_from_slice(&SMALLEST_MTU.to_le_bytes());
            }
            good
        }
        // Error; Find Information, Read, Read Blob requests; Write and Execute Write responses.
        Some(0x01 | 0x04 | 0x0C) => length == 5,
        Some(0x0A) => length == 3,
        Some(0x13 | 0x19 | 0x1E) => length == 1,
        Some(0x18) => length == 2,
        // Find By Type Value; Read By Type with a 16- or 128-bit type. Groups have 16-bit types only,
        // and trouble-host 0.8 reads one byte too many of a longer one.
        Some(0x06) => length >= 7,
        Some(0x08) => length == 7 || length == 21,
        Some(0x10) => length == 7,
        // Read Multiple: at least two handles.
        Some(0x0E | 0x20) => length >= 5 && length % 2 == 1,
        // Writes, notification, indication: a handle. Prepare Write: a handle and an offset.
        Some(0x12 | 0x52 | 0x1B | 0x1D) => length >= 3,
        Some(0x16 | 0x17) => length >= 5,
        // Signed write: a handle and a signature.
        Some(0xD2) => length >= 15,
        // Lists of answers.
        Some(0x05) => match pdu.get(1) {
            Some(1) => ascending(&pdu[2..], 4, 1),
            Some(2) => ascending(&pdu[2..], 18, 1),
            _ => false,
        },
        Some(0x07) => ascending(&pdu[1..], 4, 2),
        Some(0x09) => pdu.get(1).is_some_and(|l| *l >= 2 && ascending(&pdu[2..], *l, 1)),
        Some(0x11) => pdu.get(1).is_some_and(|l| *l >= 6 && ascending(&pdu[2..], *l, 2)),
        Some(_) => true,
    }
}

/// A list of one or more items that begin with one or two handles, which rise from item to item and
/// never reach the last handle, behind which a search could not continue.
fn ascending(list: &[u8], item: u8, handles: usize) -> bool {
    let item = usize::from(item);
    if list.is_empty() || !list.len().is_multiple_of(item) {
        return false;
    }
    let mut last = 0;
    list.chunks_exact(item).all(|entry| {
        (0..handles).all(|k| {
            let handle = word(&entry[2 * k..]);
            // The end of a group may be its beginning; a group may end at the last handle.
            let rises = handle > last || k > 0 && handle == last;
            let below = handle < u16::MAX || k > 0;
            last = handle;
            rises && below
        })
    })
}

/// One command: code, identifier, length, and that many bytes.
fn signal(frame: &[u8]) -> bool {
    let Some((head, data)) = frame.split_first_chunk::<4>() else { return false };
    let length = usize::from(word(&head[2..]));
    let exact = match head[0] {
        // Parameter update request and response.
        0x12 => length == 8,
        0x13 => length == 2,
        // Rejection: a reason and perhaps more.
        0x01 => length >= 2,
        // Nothing here opens channels.
        _ => false,
    };
    exact && data.len() == length
}

/// Length of every Security Manager packet by its code (part H, 3.3).
fn security(pdu: &[u8]) -> bool {
    let expected = match pdu.first() {
        Some(0x01 | 0x02) => 7,
        Some(0x03 | 0x04 | 0x06 | 0x08 | 0x0A | 0x0D) => 17,
        Some(0x05 | 0x0B | 0x0E) => 2,
        Some(0x07) => 11,
        Some(0x09) => 8,
        Some(0x0C) => 65,
        _ => return false,
    };
    pdu.len() == expected
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::*;
    use std::vec::Vec;

    fn good(pdu: &[u8]) -> bool {
        well_formed(ATT, &mut Vec::from(pdu))
    }

    #[test]
    fn short_requests_are_refused() {
        assert!(!good(&[]));
        for opcode in [0x02, 0x04, 0x06, 0x08, 0x0A, 0x0C, 0x0E, 0x10, 0x12, 0x16, 0x18, 0x52, 0xD2]
        {
            assert!(!good(&[opcode]), "opcode {opcode:#x}");
        }
        assert!(good(&[0x0A, 3, 0]) && !good(&[0x0A, 3]) && !good(&[0x0A, 3, 0, 0]));
    }

    #[test]
    fn lists_rise_and_have_whole_items() {
        assert!(good(&[0x09, 3, 1, 0, 7, 2, 0, 8]));
        assert!(!good(&[0x09, 0, 1, 0]), "items of no length");
        assert!(!good(&[0x09, 3, 1, 0, 7, 1, 0, 8]), "the same handle twice");
        assert!(!good(&[0x09, 3, 1, 0, 7, 2, 0]), "half an item");
        assert!(!good(&[0x09, 3]), "no item");
        assert!(!good(&[0x09, 3, 0xFF, 0xFF, 7]), "the last handle");
        assert!(good(&[0x07, 5, 0, 9, 0]) && !good(&[0x07, 9, 0, 5, 0]) && !good(&[0x07]));
        assert!(good(&[0x11, 6, 1, 0, 0xFF, 0xFF, 0x0A, 0x18]));
        assert!(!good(&[0x05, 3, 1, 0, 2, 0]), "unknown format");
    }

    #[test]
    fn a_small_mtu_is_raised() {
        let mut pdu = [0x02, 1, 0];
        assert!(well_formed(ATT, &mut pdu));
        assert_eq!(pdu, [0x02, 23, 0]);
    }

    #[test]
    fn other_channels() {
        assert!(!well_formed(0x40, &mut [0; 8]));
        assert!(well_formed(SIGNALLING, &mut [0x13, 1, 2, 0, 0, 0]));
        assert!(!well_formed(SIGNALLING, &mut [0x13, 1, 2, 0, 0]));
        assert!(!well_formed(SECURITY, &mut [0x0C; 40]));
        assert!(well_formed(SECURITY, &mut [0x0C; 65]));
    }
}
