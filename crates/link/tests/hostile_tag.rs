//! Hostile tags against the robot: whatever they answer, the robot's call ends in time, and its radio
//! works on.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

mod support;

use std::time::Duration;

use embassy_time::Timer;
use support::{RawHost, TIMEOUT, address, clock, record, tag};
use vergence_devices::{Clock, DeviceError, LedCommand, TagAddress, TagLink};
use vergence_link::{RadioConfig, VirtualRadio};
use vergence_tag::{Pattern, beacon, gatt, pattern::Bits};

const ROGUE: TagAddress = TagAddress([0xC0, 0xBA, 0xD0, 0, 0, 2]);

/// What a rogue answers to a request: frames with their channel. Nothing at all is an answer too.
type Answers = fn(&[u8]) -> Vec<(u16, Vec<u8>)>;

fn error(request: &[u8], code: u8) -> Vec<(u16, Vec<u8>)> {
    vec![(4, vec![0x01, request[0], 1, 0, code])]
}

/// Where a rogue that behaves for a while says that its characteristics are.
fn declarations() -> Vec<u8> {
    let mut answer = vec![0x09, 21];
    for (handle, properties, uuid) in [
        (2u16, 2u8, gatt::RECORD),
        (4, 8, gatt::RECORD_WRITE),
        (6, 8, gatt::COMMAND),
        (8, 2, gatt::STATE),
    ] {
        answer.extend(handle.to_le_bytes());
        answer.push(properties);
        answer.extend((handle + 1).to_le_bytes());
        answer.extend(uuid.to_le_bytes());
    }
    answer
}

/// A rogue's good manners: MTU and searches.
fn polite(request: &[u8]) -> Option<Vec<(u16, Vec<u8>)>> {
    match request {
        [0x02, ..] => Some(vec![(4, vec![0x03, 247, 0])]),
        [0x08, .., 0x03, 0x28] if request.len() == 7 => Some(vec![(4, declarations())]),
        _ => None,
    }
}

fn value(request: &[u8], value: &[u8]) -> Vec<(u16, Vec<u8>)> {
    match request[0] {
        0x08 => vec![(
            4,
            [&[0x09, (value.len().min(243) + 2) as u8, 3, 0][..], &value[..value.len().min(243)]]
                .concat(),
        )],
        0x0C => {
            let at = usize::from(u16::from_le_bytes([request[3], request[4]]));
            let part = value.get(at..).unwrap_or_default();
            vec![(4, [&[0x0D][..], &part[..part.len().min(246)]].concat())]
        }
        0x0A => vec![(4, [&[0x0B][..], &value[..value.len().min(246)]].concat())],
        0x12 => vec![(4, vec![0x13])],
        _ => error(request, 0x0A),
    }
}

/// What the robot's calls must come to.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Expected {
    /// An error that names the tag's fault.
    Refused,
    /// Time runs out, or the link breaks.
    Silence,
    /// Any error.
    Error,
}

fn cases() -> Vec<(&'static str, Answers, Expected)> {
    use Expected::{Error, Refused, Silence};
    vec![
        ("mute from the start", |_| vec![], Silence),
        ("empty answers", |_| vec![(4, vec![])], Silence),
        ("error to everything", |r| error(r, 0x0E), Refused),
        ("error with a stray code", |r| error(r, 0x00), Error),
        ("short error", |r| vec![(4, vec![0x01, r[0]])], Silence),
        (
            "MTU zero, then mute",
            |r| if r[0] == 2 { vec![(4, vec![3, 0, 0])] } else { vec![] },
            Silence,
        ),
        ("short MTU answer", |_| vec![(4, vec![3, 1])], Silence),
        ("opcode alone", |r| vec![(4, vec![r[0] + 1])], Silence),
        ("answers of another kind", |r| polite(r).unwrap_or(vec![(4, vec![0x13])]), Error),
        (
            "items of no length",
            |r| polite(r).filter(|_| r[0] == 2).unwrap_or(vec![(4, vec![0x09, 0, 1, 0])]),
            Silence,
        ),
        (
            "items of one byte",
            |r| polite(r).filter(|_| r[0] == 2).unwrap_or(vec![(4, vec![0x09, 1, 1, 0])]),
            Silence,
        ),
        (
            "no items",
            |r| polite(r).filter(|_| r[0] == 2).unwrap_or(vec![(4, vec![0x09, 7])]),
            Silence,
        ),
        (
            "last handle",
            |r| {
                polite(r)
                    .filter(|_| r[0] == 2)
                    .unwrap_or(vec![(4, vec![0x09, 4, 0xFF, 0xFF, 1, 2])])
            },
            Silence,
        ),
        (
            "the first handle for ever",
            |r| {
                polite(r)
                    .filter(|_| r[0] == 2)
                    .unwrap_or(vec![(4, vec![0x09, 9, 1, 0, 2, 2, 0, 0, 0x2A, 1, 2])])
            },
            Error,
        ),
        ("record of nothing", |r| polite(r).unwrap_or_else(|| value(r, &[])), Refused),
        (
            "endless record",
            |r| {
                polite(r).unwrap_or_else(|| match r[0] {
                    0x0C => vec![(4, [&[0x0D][..], &[7; 246]].concat())],
                    _ => value(r, &[7; 500]),
                })
            },
            Error,
        ),
        ("half a record", |r| polite(r).unwrap_or_else(|| value(r, &record("cup")[..60])), Error),
        (
            "record with a changed byte",
            |r| {
                let mut bytes = record("cup");
                bytes[9] ^= 0x80;
                polite(r).unwrap_or_else(|| value(r, &bytes))
            },
            Error,
        ),
        ("300 bytes of nothing", |r| polite(r).unwrap_or_else(|| value(r, &[0; 300])), Error),
        (
            "record of another object",
            |r| polite(r).unwrap_or_else(|| value(r, &record("can"))),
            Refused,
        ),
        (
            "record, but other channels",
            |r| {
                polite(r)
                    .map(|mut a| {
                        a.insert(0, (0x40, vec![1; 9]));
                        a
                    })
                    .unwrap_or_else(|| vec![(6, vec![0x0B, 5])])
            },
            Silence,
        ),
        (
            "signals between",
            |r| {
                polite(r)
                    .map(|mut a| {
                        a.insert(0, (5, vec![0x12, 1, 8, 0, 6, 0, 6, 0, 0, 0, 100, 0]));
                        a
                    })
                    .unwrap_or_default()
            },
            Silence,
        ),
        (
            "impossible timing",
            |r| {
                polite(r)
                    .map(|mut a| {
                        a.insert(0, (5, vec![0x12, 1, 8, 0, 0xFF, 0xFF, 0, 0, 0xFF, 0xFF, 0, 0]));
                        a
                    })
                    .unwrap_or_default()
            },
            Silence,
        ),
        (
            "flood of notifications",
            |r| {
                let mut flood = vec![(4, vec![0x1B, 9, 0, 1]); 500];
                flood.extend(polite(r).unwrap_or_default());
                flood
            },
            Silence,
        ),
        ("flood of indications", |_| vec![(4, vec![0x1D, 9, 0, 1]); 500], Silence),
        (
            "asks back",
            |_| vec![(4, vec![0x0A, 3, 0]), (4, vec![0x08, 1, 0, 0xFF, 0xFF, 0, 0x28])],
            Silence,
        ),
        (
            "every answer twice",
            |r| {
                let a = polite(r).unwrap_or_else(|| value(r, &[7; 9]));
                [a.clone(), a].concat()
            },
            Error,
        ),
        (
            "wants to pair",
            |r| [vec![(6, vec![0x0B, 0x0D])], polite(r).unwrap_or_default()].concat(),
            Silence,
        ),
        (
            "pairs nonsense",
            |r| {
                [
                    vec![
                        (6, vec![0x02, 3, 0, 9, 16, 0, 0]),
                        (6, [&[0x0C][..], &[0x55; 64]].concat()),
                    ],
                    polite(r).unwrap_or_default(),
                ]
                .concat()
            },
            Silence,
        ),
    ]
}

/// A tag that advertises as "cup" and answers as it likes.
async fn rogue(mut host: RawHost, answers: Answers) {
    loop {
        let scan_response = beacon::scan_response("cup", Some(50), false);
        host.accept(&beacon::advertisement("cup"), &scan_response).await;
        while let Some(request) = host.attribute().await {
            if request.is_empty() || request[0] % 2 == 1 {
                continue;
            }
            for (channel, frame) in answers(&request) {
                host.frame(channel, &frame);
            }
        }
        Timer::after_millis(10).await;
    }
}

fn radio_with(answers: Answers) -> VirtualRadio {
    VirtualRadio::with_guests(
        RadioConfig::default(),
        vec![tag("kettle", 1)],
        Duration::ZERO,
        |_| Some(-60),
        move |executor, air| {
            executor.spawn(rogue(RawHost::new(air, ROGUE), answers));
        },
    )
    .unwrap()
}

#[test]
fn rogue_answers_do_not_harm() {
    for (name, answers, expected) in cases() {
        let radio = radio_with(answers);
        let time = clock();
        let mut link = radio.link(time.clone());
        assert_eq!(link.scan(Duration::from_secs(1)).unwrap().len(), 2, "{name}");
        let start = time.now();
        let outcome = link.read_record(ROGUE, TIMEOUT);
        let error = match outcome {
            Err(error) => error,
            Ok(bytes) if expected == Expected::Error => {
                // Bytes that are no record: the reader says so.
                assert!(vergence_tag::cbor::decode(&bytes).is_err(), "{name}: {bytes:?}");
                DeviceError::Fault { device: String::new(), fault: String::new() }
            }
            Ok(bytes) => panic!("{name}: {bytes:?}"),
        };
        match expected {
            Expected::Refused => {
                assert!(matches!(error, DeviceError::Fault { .. }), "{name}: {error}")
            }
            Expected::Silence => assert!(
                matches!(error, DeviceError::Timeout { .. } | DeviceError::Disconnected { .. }),
                "{name}: {error}"
            ),
            Expected::Error => {}
        }
        assert!(time.now() - start <= TIMEOUT + Duration::from_millis(1), "{name}");
        let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap();
        let _ = link.command(ROGUE, LedCommand::Play(pattern), TIMEOUT);
        let _ = link.info(ROGUE, TIMEOUT);
        let _ = link.pair(ROGUE, None);
        assert_eq!(
            link.read_record(address(1), TIMEOUT).unwrap(),
            record("kettle"),
            "after {name}"
        );
    }
}

#[test]
fn a_record_of_another_object_is_named() {
    let radio = radio_with(|r| polite(r).unwrap_or_else(|| value(r, &record("can"))));
    let mut link = radio.link(clock());
    link.scan(Duration::from_secs(1)).unwrap();
    let error = link.read_record(ROGUE, TIMEOUT).unwrap_err().to_string();
    assert!(error.contains("advertises \"cup\" but holds the record of \"can\""), "{error}");
}
