//! Robot and tags over the virtual air: what a robot does with tags, on virtual time.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

mod support;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use support::{TIMEOUT, TestClock, address, clock, record, tag};
use vergence_devices::{Clock, DeviceError, LedCommand, TagLink};
use vergence_firmware::{Access, Config};
use vergence_link::{HciLink, RadioConfig, VirtualRadio, VirtualTag};
use vergence_tag::{Pattern, Record, cbor, pattern::Bits};

struct World {
    radio: VirtualRadio,
    link: HciLink,
    clock: Arc<TestClock>,
}

fn world(tags: Vec<VirtualTag>, hearing: impl Fn(usize) -> Option<i8> + Send + 'static) -> World {
    let clock = clock();
    let radio = VirtualRadio::new(RadioConfig::default(), tags, Duration::ZERO, hearing).unwrap();
    let link = radio.link(clock.clone());
    World { radio, link, clock }
}

fn flicker() -> Pattern {
    Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap()
}

#[test]
fn a_robot_finds_reads_and_commands() {
    let tags = vec![tag("cup", 1), tag("can", 2)];
    let mut w = world(tags, |k| Some(if k == 0 { -70 } else { -40 }));
    let heard = w.link.scan(Duration::from_secs(1)).unwrap();
    let ids: Vec<_> = heard.iter().map(|a| (a.object_id.as_str(), a.rssi, a.battery)).collect();
    assert_eq!(ids, [("can", -40, Some(80)), ("cup", -70, Some(80))]);
    let before = w.clock.now();
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
    let took = w.clock.now() - before;
    println!("connect to record: {took:?}");
    assert!(took < Duration::from_millis(500), "connect to record took {took:?}");

    let state = w.link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap();
    assert!(state.playing);
    let plays = w.radio.plays().of(0);
    assert_eq!(plays.len(), 1);
    assert_eq!(plays[0].pattern, flicker());
    assert!(plays[0].begin <= w.clock.now() && plays[0].begin > before);
    assert_eq!(plays[0].end - plays[0].begin, Duration::from_secs(120), "the tag's longest");

    w.clock.sleep(Duration::from_secs(3));
    let state = w.link.command(address(1), LedCommand::Stop, TIMEOUT).unwrap();
    assert!(!state.playing);
    let [play] = w.radio.plays().of(0)[..] else { panic!("one play") };
    assert!(play.end < w.clock.now() && play.end > play.begin + Duration::from_secs(3));
}

#[test]
fn two_tags_of_one_object_are_both_reported() {
    let mut w = world(vec![tag("cup", 1), tag("cup", 2)], |_| Some(-50));
    let heard = w.link.scan(Duration::from_secs(1)).unwrap();
    let ids: Vec<_> = heard.iter().map(|a| (a.object_id.as_str(), a.address)).collect();
    assert_eq!(ids, [("cup", address(1)), ("cup", address(2))]);
}

#[test]
fn calls_end_in_time_when_nobody_answers() {
    let reachable = Arc::new(AtomicBool::new(true));
    let ear = reachable.clone();
    let mut w = world(vec![tag("cup", 1)], move |_| ear.load(Ordering::SeqCst).then_some(-60));
    let unknown = w.link.read_record(address(9), Duration::from_secs(2)).unwrap_err();
    assert!(matches!(unknown, DeviceError::Timeout { .. }), "{unknown}");
    assert_eq!(w.clock.now(), Duration::from_secs(2));

    w.link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap();
    reachable.store(false, Ordering::SeqCst);
    let start = w.clock.now();
    assert!(w.link.scan(Duration::from_secs(3)).unwrap().is_empty());
    // The link is lost after its supervision timeout of two seconds, and the light with it.
    let [play] = w.radio.plays().of(0)[..] else { panic!("one play") };
    let dark = play.end.saturating_sub(start);
    assert!(dark > Duration::from_millis(1900) && dark < Duration::from_millis(2200), "{dark:?}");
    let lost = w.link.command(address(1), LedCommand::Stop, Duration::from_secs(1)).unwrap_err();
    assert!(matches!(lost, DeviceError::Timeout { .. }), "{lost}");

    reachable.store(true, Ordering::SeqCst);
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
}

#[test]
fn plays_end_by_themselves() {
    let mut w = world(vec![tag("cup", 1)], |_| Some(-60));
    let thrice = Pattern { repeats: Some(3), ..flicker() };
    w.link.command(address(1), LedCommand::Play(thrice), TIMEOUT).unwrap();
    w.clock.sleep(Duration::from_secs(1));
    let state = w.link.play_for(address(1), flicker(), Duration::from_secs(2), TIMEOUT).unwrap();
    assert!(state.playing);
    let lengths: Vec<_> = w.radio.plays().of(0).iter().map(|p| p.end - p.begin).collect();
    assert_eq!(lengths, [Duration::from_millis(300), Duration::from_secs(2)]);
    w.clock.sleep(Duration::from_secs(3));
    assert!(!w.link.info(address(1), TIMEOUT).unwrap().playing);
    // The next command of a new robot, which never met the tag, works as well.
    w.link.release(address(1)).unwrap();
    assert!(w.link.command(address(1), LedCommand::Play(thrice), TIMEOUT).unwrap().playing);
}

#[test]
fn what_a_tag_cannot_do_it_refuses() {
    let mut w = world(vec![tag("cup", 1)], |_| Some(-60));
    let second = Pattern { landmark: 1, ..flicker() };
    let refused = w.link.command(address(1), LedCommand::Play(second), TIMEOUT).unwrap_err();
    assert!(matches!(&refused, DeviceError::Fault { fault, .. } if fault.contains("cannot")));
    assert!(w.radio.plays().of(0).is_empty());
}

fn owned(id: &str, number: u8, passkey: Option<u32>, access: Access) -> VirtualTag {
    let config = Config {
        passkey,
        record_access: access,
        write_access: access,
        command_access: access,
        ..Config::default()
    };
    VirtualTag { config, ..tag(id, number) }
}

#[test]
fn a_new_record_is_kept_and_advertised() {
    let mut w = world(vec![owned("cup", 1, None, Access::Open)], |_| Some(-60));
    w.link.write_record(address(1), &record("kettle"), TIMEOUT).unwrap();
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("kettle"));
    assert_eq!(w.link.scan(Duration::from_secs(1)).unwrap()[0].object_id, "kettle");
    let refused = w.link.write_record(address(1), b"no record", TIMEOUT).unwrap_err();
    assert!(matches!(refused, DeviceError::Unsupported { .. }), "{refused}");
}

#[test]
fn records_longer_than_one_attribute_arrive_whole() {
    let vertices: Vec<[f64; 3]> = (0..44)
        .map(|k| {
            let angle = f64::from(k) * 0.3;
            [0.0391 * angle.cos(), 0.0391 * angle.sin(), 0.05 * f64::from(k % 2 * 2 - 1)]
        })
        .chain([[0.04, 0.0, 0.0], [-0.04, 0.0, 0.0], [0.0, 0.04, 0.0], [0.0, -0.04, 0.0]])
        .collect();
    let text = serde_json::json!({
        "object_id": "rock", "landmarks": [{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}],
        "bounding_box": {"width": 0.08, "length": 0.08, "height": 0.1},
        "shape": {"kind": "convex", "vertices": vertices},
    });
    let mut parsed: Record = serde_json::from_value(text).unwrap();
    if let vergence_tag::Shape::Convex { vertices } = &mut parsed.shape {
        vertices.iter_mut().flatten().for_each(|v| *v = f64::from(*v as f32));
    }
    let mut bytes = Vec::new();
    cbor::encode(&parsed, &mut bytes).unwrap();
    assert!(bytes.len() > 700 && bytes.len() < 1024, "{} bytes", bytes.len());
    let mut w = world(vec![owned("cup", 1, None, Access::Open)], |_| Some(-60));
    w.link.write_record(address(1), &bytes, TIMEOUT).unwrap();
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), bytes);
}

#[test]
fn a_tag_without_a_record_says_so() {
    let blank = VirtualTag { record: Vec::new(), ..tag("", 1) };
    let mut w = world(vec![blank], |_| Some(-60));
    let empty = w.link.read_record(address(1), TIMEOUT).unwrap_err();
    assert!(empty.to_string().contains("holds no record"), "{empty}");
    assert!(!w.link.info(address(1), TIMEOUT).unwrap().has_record);
}

#[test]
fn just_works_opens_what_is_encrypted() {
    let mut w = world(vec![owned("cup", 1, None, Access::Encrypted)], |_| Some(-60));
    let refused = w.link.read_record(address(1), TIMEOUT).unwrap_err();
    assert!(refused.to_string().contains("not paired"), "{refused}");
    let refused = w.link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap_err();
    assert!(refused.to_string().contains("not paired"), "{refused}");
    assert!(w.link.pair(address(1), None).unwrap().is_some());
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
    assert!(w.link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap().playing);
}

#[test]
fn a_passkey_proves_the_robot() {
    let tags = vec![owned("cup", 1, Some(123_456), Access::Authenticated)];
    let mut w = world(tags, |_| Some(-60));
    let wrong = w.link.pair(address(1), Some(123_457)).unwrap_err();
    assert!(wrong.to_string().contains("pairing failed"), "{wrong}");
    assert!(w.link.read_record(address(1), TIMEOUT).is_err());
    w.clock.sleep(Duration::from_secs(2));
    let bond = w.link.pair(address(1), Some(123_456)).unwrap().unwrap();
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
    w.link.write_record(address(1), &record("mug"), TIMEOUT).unwrap();
    assert!(!format!("{bond:?}").contains(char::is_numeric), "a bond is not to be logged");
}

#[test]
fn just_works_does_not_open_what_is_authenticated() {
    let mut w = world(vec![owned("cup", 1, None, Access::Authenticated)], |_| Some(-60));
    w.link.pair(address(1), None).unwrap();
    let refused = w.link.read_record(address(1), TIMEOUT).unwrap_err();
    assert!(refused.to_string().contains("not paired"), "{refused}");
}

#[test]
fn guessing_a_passkey_takes_ever_longer() {
    let tags = vec![owned("cup", 1, Some(123_456), Access::Authenticated)];
    let mut w = world(tags, |_| Some(-60));
    let mut refused = 0;
    for (guess, wait) in [(1, 0), (2, 1), (3, 2), (4, 3), (5, 4)] {
        w.clock.sleep(Duration::from_secs(wait));
        let error = w.link.pair(address(1), Some(guess)).unwrap_err();
        refused += u32::from(error.to_string().contains("the link ended"));
    }
    assert_eq!(refused, 2, "waits of two and of four seconds");
    let error = w.link.pair(address(1), Some(123_456)).unwrap_err();
    assert!(error.to_string().contains("the link ended"), "even the right one must wait: {error}");
    w.clock.sleep(Duration::from_secs(16));
    w.link.pair(address(1), Some(123_456)).unwrap();
}

#[test]
fn pairing_without_the_passkey_clears_no_guesses_and_costs_no_bond() {
    let tags = vec![owned("cup", 1, Some(123_456), Access::Authenticated)];
    let mut w = world(tags, |_| Some(-60));
    let bond = w.link.pair(address(1), Some(123_456)).unwrap().unwrap();
    let mut waited = 0;
    for guess in 1..=6 {
        let error = w.link.pair(address(1), Some(guess)).unwrap_err();
        waited += u32::from(error.to_string().contains("the link ended"));
        let refused = w.link.pair(address(1), None).unwrap_err();
        assert!(refused.to_string().contains("pair with its passkey"), "{refused}");
    }
    assert!(waited >= 3, "only {waited} of 6 guesses had to wait");
    // Robots have one address: the tag must still hold the bond that was made under it first.
    w.link.add_bond(bond).unwrap();
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
}

#[test]
fn a_tag_that_does_not_ask_for_the_passkey_is_not_believed() {
    let mut w = world(vec![owned("cup", 1, None, Access::Encrypted)], |_| Some(-60));
    let unproven = w.link.pair(address(1), Some(123_456)).unwrap_err();
    assert!(unproven.to_string().contains("did not ask for the passkey"), "{unproven}");
    let refused = w.link.read_record(address(1), TIMEOUT).unwrap_err();
    assert!(refused.to_string().contains("not paired"), "the bond was dropped: {refused}");
    w.link.pair(address(1), None).unwrap();
}

#[test]
fn a_run_repeats_exactly() {
    let run = || {
        let mut w = world(vec![tag("cup", 1), tag("can", 2), tag("box", 3)], |_| Some(-60));
        let heard = w.link.scan(Duration::from_millis(700)).unwrap();
        let bytes = w.link.read_record(address(2), TIMEOUT).unwrap();
        w.link.command(address(3), LedCommand::Play(flicker()), TIMEOUT).unwrap();
        w.link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap();
        (heard, bytes, w.radio.plays().of(0), w.radio.plays().of(2), w.clock.now())
    };
    assert_eq!(run(), run());
}

#[test]
fn a_hundred_tags_share_the_air() {
    let tags = (0..100).map(|k| VirtualTag { battery: 50, ..tag(&format!("tag{k}"), k) }).collect();
    let mut w = world(tags, |k| Some(-40 - (k as i8) / 2));
    let heard = w.link.scan(Duration::from_secs(1)).unwrap();
    assert_eq!(heard.len(), 100);
    assert_eq!(heard[99].object_id.parse::<String>().unwrap(), "tag99");
    assert_eq!(w.link.read_record(address(99), TIMEOUT).unwrap(), record("tag99"));
    // As many blink at once as there are links, less the one for talking.
    for k in 0..7 {
        w.link.command(address(k), LedCommand::Play(flicker()), TIMEOUT).unwrap();
    }
    let eighth = w.link.command(address(8), LedCommand::Play(flicker()), TIMEOUT).unwrap_err();
    assert!(eighth.to_string().contains("others are blinking"), "{eighth}");
    assert!(w.link.command(address(3), LedCommand::Play(flicker()), TIMEOUT).unwrap().playing);
}
