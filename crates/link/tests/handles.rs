//! How fast a tag is met, known and unknown; and a tag whose attributes have moved since.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

mod support;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use embassy_time::Timer;
use support::{RawHost, TIMEOUT, address, clock, record, tag};
use vergence_devices::{Clock, LedCommand, TagAddress, TagLink};
use vergence_link::{RadioConfig, VirtualRadio};
use vergence_tag::{Command, Pattern, State, Upload, beacon, gatt, pattern::Bits};

fn flicker() -> Pattern {
    Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap()
}

/// Interval 15 ms, connection events timed as on a radio, the tag advertising every 100 ms.
#[test]
fn a_record_is_read_within_a_fifth_of_a_second() {
    let radio =
        VirtualRadio::new(RadioConfig::default(), vec![tag("cup", 1)], Duration::ZERO, |_| {
            Some(-50)
        });
    let time = clock();
    let mut link = radio.unwrap().link(time.clone());
    let mut took = [Vec::new(), Vec::new()];
    // At every phase of the advertising; a link keeps the tag awake, so that it stays fast.
    for k in 0..40u64 {
        time.sleep(Duration::from_millis(203 + 5 * k));
        let start = time.now();
        assert_eq!(link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
        took[0].push(time.now() - start);
        time.sleep(Duration::from_millis(303 + 5 * k));
        let start = time.now();
        link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap();
        took[1].push(time.now() - start);
        link.release(address(1)).unwrap();
    }
    let first_command = took[1].remove(0);
    for (what, mut times) in ["record", "command, handles known"].into_iter().zip(took) {
        times.sort();
        println!("connect to {what}: median {:?}, longest {:?}", times[20], times[times.len() - 1]);
        assert!(times[20] < Duration::from_millis(170), "{what}: {times:?}");
        assert!(times[times.len() - 1] < Duration::from_millis(240), "{what}: {times:?}");
        if what == "record" {
            assert!(times[times.len() - 1] < Duration::from_millis(200), "{what}: {times:?}");
        }
    }
    println!("connect to command, handles asked for: {first_command:?}");
    assert!(first_command < Duration::from_millis(500));
}

const MOVED: TagAddress = TagAddress([0xC0, 0xF1, 0xA5, 0, 0, 3]);

/// What the moving tag was told, and at which handle.
#[derive(Default)]
struct Told {
    links: u16,
    searches: usize,
    commands: Vec<u16>,
    records: Vec<u16>,
}

/// One answer of a tag whose handles lie `shift` further back than usual.
fn answer(request: &[u8], shift: u16, playing: &mut bool, told: &mut Told) -> Vec<u8> {
    let places = [
        (2u16, 2u8, gatt::RECORD),
        (4, 8, gatt::RECORD_WRITE),
        (6, 8, gatt::COMMAND),
        (8, 2, gatt::STATE),
    ];
    match request {
        [0x02, ..] => vec![0x03, 247, 0],
        [0x08, .., 0x03, 0x28] if request.len() == 7 => {
            told.searches += 1;
            let mut list = vec![0x09, 21];
            for (handle, properties, uuid) in places {
                list.extend((handle + shift).to_le_bytes());
                list.push(properties);
                list.extend((handle + 1 + shift).to_le_bytes());
                list.extend(uuid.to_le_bytes());
            }
            list
        }
        [0x08, _, _, _, _, uuid @ ..] if uuid == gatt::STATE.to_le_bytes() => {
            let state = State { playing: *playing, has_record: true, battery: Some(50) };
            [&[0x09, 4][..], &(9 + shift).to_le_bytes(), &state.encode()].concat()
        }
        [0x12, low, high, value @ ..] => {
            let handle = u16::from_le_bytes([*low, *high]);
            let refusal = |code| vec![0x01, 0x12, *low, *high, code];
            if handle == 7 + shift {
                let Ok(command) = Command::decode(value) else {
                    return refusal(gatt::ERROR_MALFORMED);
                };
                *playing = matches!(command, Command::Play { .. });
                told.commands.push(handle);
            } else if handle == 5 + shift {
                // A command looks like a piece of a record, and is taken without complaint.
                match Upload::decode(value) {
                    None => return refusal(gatt::ERROR_MALFORMED),
                    Some(Upload::Commit { .. }) => told.records.push(handle),
                    Some(Upload::Piece { .. }) => {}
                }
            } else {
                return refusal(0x01);
            }
            vec![0x13]
        }
        _ => vec![0x01, request[0], 1, 0, 0x0A],
    }
}

#[test]
fn a_tag_whose_attributes_moved_is_learned_anew() {
    // What was the command's handle becomes that of another value that takes writes, of one that does
    // not exist, and so on.
    for shifts in [[0, 2], [0, 1], [2, 0], [0, 40]] {
        let told = Arc::new(Mutex::new(Told::default()));
        let log = told.clone();
        let radio = VirtualRadio::with_guests(
            RadioConfig::default(),
            vec![],
            Duration::ZERO,
            |_| None,
            move |executor, air| {
                let mut host = RawHost::new(air, MOVED);
                executor.spawn(async move {
                    loop {
                        let response = beacon::scan_response("cup", None, false);
                        host.accept(&beacon::advertisement("cup"), &response).await;
                        let shift =
                            shifts[usize::from(log.lock().unwrap().links.min(4) / 2).min(1)];
                        log.lock().unwrap().links += 1;
                        let mut playing = false;
                        while let Some(request) = host.attribute().await {
                            let reply =
                                answer(&request, shift, &mut playing, &mut log.lock().unwrap());
                            host.frame(4, &reply);
                        }
                        Timer::after_millis(10).await;
                    }
                });
            },
        )
        .unwrap();
        let mut link = radio.link(clock());
        // Two links with the old firmware, two with the new one.
        for (round, searches) in [(0, 1), (1, 1), (2, 2), (3, 2)] {
            let state = link.command(MOVED, LedCommand::Play(flicker()), TIMEOUT).unwrap();
            assert!(state.playing, "{shifts:?}, round {round}");
            link.release(MOVED).unwrap();
            let told = told.lock().unwrap();
            assert_eq!(told.searches, searches, "{shifts:?}, round {round}");
            assert_eq!(told.commands.last(), Some(&(7 + shifts[round / 2])), "{shifts:?}");
        }
        // A record goes to the new place as well.
        link.write_record(MOVED, &record("mug"), TIMEOUT).unwrap();
        assert_eq!(told.lock().unwrap().records, [5 + shifts[1]]);
    }
}
