//! The radio on real time over TCP and over a serial line: a robot and tags as two programs would be.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

mod support;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::AsRawFd;
use std::sync::Arc;
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

/// A controller that is reached over TCP, at the far end of a serial line; gives the near end's path.
fn on_a_line(target: &str) -> std::path::PathBuf {
    let (far, near) = serial2::SerialPort::pair().unwrap();
    let path = std::fs::read_link(format!("/proc/self/fd/{}", near.as_raw_fd())).unwrap();
    let mut from_controller = TcpStream::connect(target).unwrap();
    let mut to_controller = from_controller.try_clone().unwrap();
    let far = Arc::new(far);
    let line = far.clone();
    std::thread::spawn(move || {
        // Somebody must hold the near end open, or the far end reports that everybody is gone.
        let _near = near;
        let mut buffer = [0; 512];
        loop {
            match line.read(&mut buffer) {
                Ok(count) => to_controller.write_all(&buffer[..count]).unwrap(),
                Err(error) if error.kind() == std::io::ErrorKind::TimedOut => {}
                Err(_) => return,
            }
        }
    });
    std::thread::spawn(move || {
        let mut buffer = [0; 512];
        while let Ok(count @ 1..) = from_controller.read(&mut buffer) {
            far.write_all(&buffer[..count]).unwrap();
        }
    });
    path
}

#[test]
fn robot_and_tags_over_a_serial_line() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let target = listener.local_addr().unwrap().to_string();
    let epoch = Duration::from_secs(100);
    let _server =
        TagServer::start(listener, AirConfig::default(), vec![tag("cup", 1)], epoch, |_| Some(-45))
            .unwrap();
    let line = on_a_line(&target);
    let mut link = HciLink::serial(&line, 115_200, LinkConfig::default()).unwrap();
    let heard = link.scan(Duration::from_millis(600)).unwrap();
    assert_eq!(heard.len(), 1, "{heard:?}");
    assert_eq!(link.read_record(address(1), TIMEOUT).unwrap(), record("cup"));
    let nowhere = std::path::Path::new("/dev/does-not-exist");
    let Err(error) = HciLink::serial(nowhere, 115_200, LinkConfig::default()) else {
        panic!("opened")
    };
    assert!(error.to_string().contains("does-not-exist"), "{error}");
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
