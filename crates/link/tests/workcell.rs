//! Robot and tags over the virtual air: what a robot does with tags, on virtual time.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::Arc;
use std::time::Duration;

use vergence_air::AirConfig;
use vergence_devices::{Clock, DeviceError, LedCommand, TagAddress, TagLink};
use vergence_firmware::{Access, Config};
use vergence_link::{HciLink, RadioConfig, VirtualRadio, VirtualTag};
use vergence_tag::{Pattern, Record, cbor, pattern::Bits};

const TIMEOUT: Duration = Duration::from_secs(5);

#[derive(Default)]
struct TestClock(AtomicU64);

impl Clock for TestClock {
    fn now(&self) -> Duration {
        Duration::from_micros(self.0.load(Ordering::SeqCst))
    }

    fn sleep(&self, duration: Duration) {
        self.0.fetch_add(duration.as_micros() as u64, Ordering::SeqCst);
    }
}

fn record(id: &str) -> Vec<u8> {
    let text = format!(
        r#"{{"object_id": "{id}", "landmarks": [{{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}}],
        "bounding_box": {{"width": 0.08, "length": 0.08, "height": 0.09}}, "shape": {{"kind": "box"}}}}"#
    );
    let record: Record = serde_json::from_str(&text).unwrap();
    let mut bytes = Vec::new();
    cbor::encode(&record, &mut bytes).unwrap();
    bytes
}

fn address(number: u8) -> TagAddress {
    TagAddress([0xC0, 1, 2, 3, 4, number])
}

fn tag(id: &str, number: u8) -> VirtualTag {
    VirtualTag {
        address: address(number),
        record: record(id),
        lights: 1,
        battery: 80 + number,
        config: Config::default(),
    }
}

struct World {
    radio: VirtualRadio,
    link: HciLink,
    clock: Arc<TestClock>,
}

fn world(tags: Vec<VirtualTag>, hearing: impl Fn(usize) -> Option<i8> + Send + 'static) -> World {
    let clock = Arc::new(TestClock::default());
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
    assert_eq!(ids, [("can", -40, Some(82)), ("cup", -70, Some(81))]);
    let before = w.clock.now();
    assert_eq!(w.link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
    let took = w.clock.now() - before;
    assert!(took < Duration::from_millis(500), "connect to record took {took:?}");

    let state = w.link.command(address(1), LedCommand::Play(flicker()), TIMEOUT).unwrap();
    assert!(state.playing);
    let plays = w.radio.plays(0);
    assert_eq!(plays.len(), 1);
    assert_eq!(plays[0].pattern, flicker());
    assert!(plays[0].begin <= w.clock.now() && plays[0].begin > before);
    assert_eq!(plays[0].end - plays[0].begin, Duration::from_secs(120), "the tag's longest");

    w.clock.sleep(Duration::from_secs(3));
    let state = w.link.command(address(1), LedCommand::Stop, TIMEOUT).unwrap();
    assert!(!state.playing);
    let [play] = w.radio.plays(0)[..] else { panic!("one play") };
    assert!(play.end < w.clock.now() && play.end > play.begin + Duration::from_secs(3));
}
