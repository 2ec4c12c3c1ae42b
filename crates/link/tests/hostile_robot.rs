//! Hostile robots against the real firmware: whatever they send, the tag serves the next robot.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

mod support;

use std::sync::Arc;
use std::sync::mpsc::{self, Sender};
use std::time::Duration;

use embassy_time::Timer;
use support::{RawHost, TIMEOUT, TestClock, address, clock, record, tag};
use vergence_devices::{TagAddress, TagLink};
use vergence_link::{HciLink, RadioConfig, VirtualRadio};

/// One thing that the attacker does.
#[derive(Clone)]
enum Act {
    /// A frame on a channel.
    Frame(u16, Vec<u8>),
    /// A raw fragment; true begins a frame.
    Fragment(bool, Vec<u8>),
    /// Waits for the tag's answers.
    Pause,
    /// Hangs up.
    Leave,
}

use Act::{Fragment, Frame, Leave, Pause};

const ATTACKER: TagAddress = TagAddress([0xC0, 0xBA, 0xD0, 0, 0, 1]);

fn att(pdu: &[u8]) -> Vec<Act> {
    vec![Frame(4, pdu.to_vec()), Pause]
}

fn attribute_cases() -> Vec<(String, Vec<Act>)> {
    let mut cases: Vec<(String, Vec<Act>)> = Vec::new();
    for mtu in [0u16, 1, 22, 24, 247, 65535] {
        let [low, high] = mtu.to_le_bytes();
        let acts = [att(&[0x02, low, high]), att(&[0x08, 1, 0, 0xFF, 0xFF, 3, 0x28])].concat();
        cases.push((format!("MTU {mtu}"), acts));
    }
    cases.push(("empty PDU".into(), att(&[])));
    // Every opcode alone, with one byte and with twenty.
    for opcode in 0..=0x24 {
        for length in [0, 1, 2, 3, 20] {
            let pdu = [&[opcode][..], &vec![0xFF; length]].concat();
            cases.push((format!("opcode {opcode:#x} with {length} bytes"), att(&pdu)));
        }
    }
    for opcode in [0x52, 0xD2, 0x5F, 0xFF] {
        cases.push((format!("opcode {opcode:#x} alone"), att(&[opcode])));
        cases.push((format!("opcode {opcode:#x} with bytes"), att(&[opcode, 1, 0, 9, 9])));
    }
    // Writes of every size to every attribute, with and without response.
    for length in [0, 1, 2, 19, 20, 21, 240] {
        let writes = (1..40u16).flat_map(|handle| {
            let [low, high] = handle.to_le_bytes();
            let write = |opcode| Frame(4, [&[opcode, low, high][..], &vec![1; length]].concat());
            [write(0x12), Pause, write(0x52)]
        });
        cases.push((format!("writes of {length} bytes"), writes.chain([Pause]).collect()));
    }
    // Reads across every end.
    for offset in [0u16, 1, 511, 512, 513, 0xFFFF] {
        let reads = (0..40u16).flat_map(|handle| {
            let ([a, b], [c, d]) = (handle.to_le_bytes(), offset.to_le_bytes());
            [Frame(4, vec![0x0C, a, b, c, d]), Pause]
        });
        cases.push((format!("reads at {offset}"), reads.collect()));
    }
    cases.push(("long prepared write".into(), {
        let piece = |offset: u16| {
            let [low, high] = offset.to_le_bytes();
            Frame(4, [&[0x16, 9, 0, low, high][..], &[7; 18]].concat())
        };
        (0..60).flat_map(|k| [piece(k * 18), Pause]).chain(att(&[0x18, 1])).collect()
    }));
    cases
}

fn channel_cases() -> Vec<(String, Vec<Act>)> {
    let mut cases: Vec<(String, Vec<Act>)> = Vec::new();
    for length in [0u16, 1, 3, 250, 0xFFFF] {
        let [low, high] = length.to_le_bytes();
        let lie = vec![Fragment(true, vec![low, high, 4, 0, 0x0A, 3, 0]), Pause];
        cases.push((format!("frame of 3 bytes that claims {length}"), lie));
    }
    for length in 0..5 {
        let acts = vec![Fragment(true, vec![3, 0, 4, 0, 0][..length].to_vec()), Pause];
        cases.push((format!("fragment of {length} bytes"), acts));
    }
    cases.push(("stray continuation".into(), vec![Fragment(false, vec![1; 20]), Pause]));
    cases.push(("empty continuation".into(), vec![Fragment(false, vec![]), Pause]));
    let half = Fragment(true, vec![200, 0, 4, 0, 0x12, 3, 0]);
    cases.push((
        "half a frame, then another".into(),
        [vec![half.clone()], att(&[0x0A, 3, 0])].concat(),
    ));
    cases.push(("half a frame, then gone".into(), vec![half.clone(), Leave]));
    let endless = std::iter::once(half).chain((0..50).map(|_| Fragment(false, vec![0; 251])));
    cases.push(("endless frame".into(), endless.chain([Pause]).collect()));
    for channel in [0u16, 1, 2, 3, 7, 0x3A, 0x40, 0x7F, 0xFFFF] {
        cases.push((format!("channel {channel}"), vec![Frame(channel, vec![1; 30]), Pause]));
    }
    // Signalling: every code with lengths that fit and that do not.
    for code in 0..=0x1A {
        for length in [0u8, 2, 8, 10, 200] {
            let frame = [&[code, 1, length, 0][..], &[0xFF; 8]].concat();
            cases.push((format!("signal {code:#x} of {length}"), vec![Frame(5, frame), Pause]));
        }
    }
    // Security: every code alone, at its length, and too long; a point that is not on the curve.
    for code in 0..=0x0F {
        for length in [0, 1, 6, 16, 64, 100] {
            let pdu = [&[code][..], &vec![0x55; length]].concat();
            cases.push((format!("SMP {code:#x} of {length}"), vec![Frame(6, pdu), Pause]));
        }
    }
    let request = Frame(6, vec![1, 3, 0, 0x09, 16, 1, 1]);
    let key = Frame(6, [&[0x0C][..], &[0x55; 64]].concat());
    cases.push(("off-curve key".into(), vec![request.clone(), Pause, key.clone(), Pause, Pause]));
    cases.push(("key before the request".into(), vec![key, Pause, request.clone(), Pause]));
    cases.push(("pairing, then gone".into(), vec![request.clone(), Leave]));
    cases.push(("two pairings".into(), vec![request.clone(), request, Pause]));
    cases
}

fn floods() -> Vec<(String, Vec<Act>)> {
    let commands = std::iter::repeat_n(Frame(4, vec![0x52, 9, 0, 0]), 2000);
    let reads = std::iter::repeat_n(Frame(4, vec![0x0A, 3, 0]), 200);
    let lists = std::iter::repeat_n(Frame(4, vec![0x08, 1, 0, 0xFF, 0xFF, 3, 0x28]), 200);
    vec![
        ("2000 write commands".into(), commands.chain([Pause, Pause]).collect()),
        ("200 reads at once".into(), reads.chain([Pause, Pause]).collect()),
        ("a read, then gone".into(), vec![Frame(4, vec![0x0A, 3, 0]), Leave]),
        ("200 searches, then gone".into(), lists.chain([Leave]).collect()),
        ("nothing at all".into(), vec![Pause, Leave]),
    ]
}

/// Carries out the cases, each on a link of its own.
async fn attack(mut host: RawHost, cases: Vec<(String, Vec<Act>)>, done: Sender<String>) {
    for (name, acts) in cases {
        host.connect(address(1)).await;
        for act in acts {
            match act {
                Frame(channel, payload) => host.frame(channel, &payload),
                Fragment(first, data) => host.fragment(first, &data),
                Pause => Timer::after_millis(45).await,
                Leave => break,
            }
        }
        host.disconnect();
        // Until the link has ended, and whatever the tag had to say is read.
        while host.attribute().await.is_some() {}
        let _ = done.send(name);
    }
}

/// Runs cases against a tag with a passkey, and shows that it serves a robot between all of them.
fn withstand(cases: Vec<(String, Vec<Act>)>) {
    let count = cases.len();
    let (done, finished) = mpsc::channel();
    let victim = tag("cup", 1);
    let radio = VirtualRadio::with_guests(
        RadioConfig::default(),
        vec![victim],
        Duration::ZERO,
        |_| Some(-50),
        move |executor, air| {
            executor.spawn(attack(RawHost::new(air, ATTACKER), cases, done));
        },
    )
    .unwrap();
    let time: Arc<TestClock> = clock();
    let mut link: HciLink = radio.link(time);
    let mut names = Vec::new();
    // The tag is shared: robot and attacker get it in turn.
    for _ in 0..20 * count + 100 {
        let read = link.read_record(address(1), TIMEOUT * 4);
        names.extend(finished.try_iter());
        match read {
            Ok(bytes) => assert_eq!(bytes, record("cup"), "after {:?}", names.last()),
            Err(error) => panic!("after {:?} ({} of {count}): {error}", names.last(), names.len()),
        }
        if names.len() == count {
            return;
        }
    }
    panic!("only {} of {count} cases came to an end", names.len());
}

#[test]
fn malformed_attribute_requests() {
    withstand(attribute_cases());
}

#[test]
fn malformed_frames_and_other_channels() {
    withstand(channel_cases());
}

#[test]
fn floods_and_silence() {
    withstand(floods());
}

#[test]
fn whoever_holds_the_tag_is_thrown_out() {
    let radio = VirtualRadio::with_guests(
        RadioConfig::default(),
        vec![tag("cup", 1)],
        Duration::ZERO,
        |_| Some(-50),
        |executor, air| {
            let mut host = RawHost::new(air, ATTACKER);
            executor.spawn(async move {
                host.connect(address(1)).await;
                host.attribute().await;
            });
        },
    )
    .unwrap();
    let mut link = radio.link(clock());
    link.scan(Duration::from_secs(1)).unwrap();
    assert!(link.scan(Duration::from_secs(5)).unwrap().is_empty(), "the attacker has it");
    // Idle links end after thirty seconds.

    assert_eq!(link.read_record(address(1), Duration::from_secs(40)).unwrap(), record("cup"));
}
