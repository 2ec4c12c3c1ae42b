//! The radio on real time over TCP: a robot and tags as two programs would be.

mod support;

use std::net::TcpListener;
use std::time::Duration;

use support::{TIMEOUT, address, record, tag};
use vergence_air::AirConfig;
use vergence_devices::{DeviceError, LedCommand, TagLink};
use vergence_link::{HciLink, LinkConfig, TagServer};
use vergence_tag::{Pattern, pattern::Bits};

#[test]
fn robot_and_tags_over_tcp() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let target = listener.local_addr().unwrap().to_string();
    let tags = vec![tag("cup", 1), tag("can", 2)];
    let epoch = Duration::from_secs(100);
    let server =
        TagServer::start(listener, AirConfig::default(), tags, epoch, |_| Some(-45)).unwrap();
    let mut link = HciLink::tcp(&target, LinkConfig::default()).unwrap();
    let heard = link.scan(Duration::from_millis(600)).unwrap();
    assert_eq!(heard.len(), 2, "{heard:?}");
    assert_eq!(link.read_record(address(2), TIMEOUT).unwrap(), record("can"));
    let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap();
    assert!(link.command(address(1), LedCommand::Play(pattern), TIMEOUT).unwrap().playing);
    let [play] = server.plays().of(0)[..] else { panic!("one play") };
    assert!(play.begin > epoch && play.begin < epoch + TIMEOUT * 2, "{play:?}");
    // A robot that dies leaves no light burning.
    drop(link);
    std::thread::sleep(Duration::from_millis(2500));
    let [play] = server.plays().of(0)[..] else { panic!("one play") };
    assert!(play.end < play.begin + Duration::from_secs(5), "{play:?}");
}

#[test]
fn a_radio_that_is_not_there_is_named() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let target = listener.local_addr().unwrap().to_string();
    drop(listener);
    let Err(error) = HciLink::tcp(&target, LinkConfig::default()) else { panic!("connected") };
    assert!(error.to_string().contains(&target), "{error}");

    // One that hangs up fails at once, and for good.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let target = listener.local_addr().unwrap().to_string();
    let mut link = HciLink::tcp(&target, LinkConfig::default()).unwrap();
    drop(listener.accept().unwrap());
    for _ in 0..2 {
        let error = link.scan(Duration::from_millis(10)).unwrap_err();
        assert!(matches!(error, DeviceError::Disconnected { .. }), "{error}");
    }
}
