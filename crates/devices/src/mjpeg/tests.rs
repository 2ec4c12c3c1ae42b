//! The driver against a small server in this process; an independent one is in
//! `scripts/check_mjpeg.py`.

use std::io::Write;
use std::net::{TcpListener, TcpStream};

use vergence_imaging::Image;

use super::*;
use crate::clock::SystemClock;

const HEAD: &str =
    "HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=frame\r\n\r\n";

fn jpeg(value: u8) -> Vec<u8> {
    codec::encode_jpeg(&Image::from_fn(32, 24, |_, _| value), 90).unwrap()
}

fn part(value: u8, stamp: f64) -> Vec<u8> {
    let body = jpeg(value);
    let head = format!("--frame\r\nContent-Length: {}\r\nX-Timestamp: {stamp}\r\n\r\n", body.len());
    [head.as_bytes(), &body, b"\r\n"].concat()
}

type Script = Box<dyn Fn(&mut TcpStream) + Send>;

/// Serves each connection by the next of `scripts`.
fn server(scripts: Vec<Script>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}/stream", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for script in scripts {
            let Ok((mut stream, _)) = listener.accept() else { return };
            let mut request = [0u8; 512];
            let _ = std::io::Read::read(&mut stream, &mut request);
            script(&mut stream);
        }
    });
    url
}

fn open(url: &str) -> Result<MjpegCamera, DeviceError> {
    let config = MjpegConfig { url: url.into(), exposure: 0.004, latency: 0.05 };
    MjpegCamera::open(&config, (32, 24), Arc::new(SystemClock::start()))
}

const SOON: Duration = Duration::from_secs(3);

#[test]
fn pictures_come_in_order_with_the_cameras_times() {
    let url = server(vec![Box::new(|stream| {
        stream.write_all(HEAD.as_bytes()).unwrap();
        for i in 0..3u8 {
            // Captured every 100 ms, sent with 0, 30 and 60 ms of delay.
            stream.write_all(&part(50 * i, 1000.0 + 0.1 * f64::from(i))).unwrap();
            std::thread::sleep(Duration::from_millis(130));
        }
    })]);
    let mut camera = open(&url).unwrap();
    let frames: Vec<Frame> = (0..3).map(|_| camera.next_frame(SOON).unwrap()).collect();
    for (i, frame) in frames.iter().enumerate() {
        assert_eq!(frame.sequence, i as u64);
        assert!(frame.image.data()[0].abs_diff(50 * i as u8) < 4);
        assert_eq!(frame.exposure, Duration::from_millis(4));
    }
    let gap = (frames[2].stamp - frames[0].stamp).as_secs_f64();
    assert!((gap - 0.2).abs() < 0.02, "the camera's 200 ms, not the network's 260: {gap}");
}

#[test]
fn a_broken_stream_is_taken_up_again() {
    let url = server(vec![
        Box::new(|stream| {
            stream.write_all(HEAD.as_bytes()).unwrap();
            let whole = part(10, 1.0);
            stream.write_all(&whole).unwrap();
            stream.write_all(&whole[..whole.len() / 2]).unwrap();
        }),
        Box::new(|stream| {
            stream.write_all(HEAD.as_bytes()).unwrap();
            stream.write_all(&part(200, 5.0)).unwrap();
            std::thread::sleep(Duration::from_millis(300));
        }),
    ]);
    let mut camera = open(&url).unwrap();
    assert!(camera.next_frame(SOON).unwrap().image.data()[0] < 20);
    assert!(camera.next_frame(SOON).unwrap().image.data()[0] > 180);
    // Nobody accepts a third time.
    let error = camera.next_frame(Duration::from_millis(900)).unwrap_err();
    assert!(matches!(error, DeviceError::Disconnected { .. }), "{error}");
}

#[test]
fn a_slow_reader_loses_old_pictures_and_knows_it() {
    let url = server(vec![Box::new(|stream| {
        stream.write_all(HEAD.as_bytes()).unwrap();
        for i in 0..20 {
            stream.write_all(&part(5 * i, f64::from(i))).unwrap();
        }
        std::thread::sleep(Duration::from_millis(800));
    })]);
    let mut camera = open(&url).unwrap();
    std::thread::sleep(Duration::from_millis(400));
    assert_eq!(camera.next_frame(SOON).unwrap().sequence, 20 - KEPT as u64);
}

#[test]
fn silence_wrong_sizes_and_wrong_addresses_are_told() {
    let url = server(vec![Box::new(|stream| {
        stream.write_all(HEAD.as_bytes()).unwrap();
        let body = codec::encode_jpeg(&Image::from_fn(16, 16, |_, _| 0), 90).unwrap();
        let head = format!("--frame\r\nContent-Length: {}\r\n\r\n", body.len());
        stream.write_all(&[head.as_bytes(), &body].concat()).unwrap();
        std::thread::sleep(Duration::from_millis(500));
    })]);
    let mut camera = open(&url).unwrap();
    let error = camera.next_frame(SOON).unwrap_err().to_string();
    assert!(error.contains("16x16, the configuration says 32x24"), "{error}");
    let silent = camera.next_frame(Duration::from_millis(50)).unwrap_err();
    assert!(matches!(silent, DeviceError::Timeout { .. }), "{silent}");
    assert!(matches!(open("ftp://x"), Err(DeviceError::Unsupported { .. })));
    assert!(matches!(open("http://127.0.0.1:1/x"), Err(DeviceError::Disconnected { .. })));
}

/// A part whose picture is cut off in its head.
fn torn() -> Vec<u8> {
    let body = &jpeg(7)[..40];
    let head = format!("--frame\r\nContent-Length: {}\r\n\r\n", body.len());
    [head.as_bytes(), body, b"\r\n"].concat()
}

#[test]
fn a_picture_that_cannot_be_decoded_is_made_up_for_by_the_next() {
    let url = server(vec![Box::new(|stream| {
        stream.write_all(HEAD.as_bytes()).unwrap();
        stream.write_all(&torn()).unwrap();
        stream.write_all(&part(200, 1.0)).unwrap();
        std::thread::sleep(Duration::from_millis(100));
        stream.write_all(&torn()).unwrap();
        std::thread::sleep(Duration::from_millis(1500));
    })]);
    let mut camera = open(&url).unwrap();
    assert!(camera.next_frame(SOON).unwrap().image.data()[0] > 180);
    let error = camera.next_frame(Duration::from_millis(400)).unwrap_err();
    assert!(
        matches!(&error, DeviceError::Fault { fault, .. } if fault.contains("nothing readable"))
    );
}

#[test]
fn a_camera_that_freezes_or_loses_pictures_is_told() {
    let url = server(vec![Box::new(|stream| {
        stream.write_all(HEAD.as_bytes()).unwrap();
        for i in [0, 1, 2, 3, 4, 5, 9] {
            stream.write_all(&part(10 * i, 0.02 * f64::from(i))).unwrap();
            std::thread::sleep(Duration::from_millis(30));
        }
        // From here on the pictures stay what they are; only their times go on.
        for i in 10..40 {
            stream.write_all(&part(90, 0.02 * f64::from(i))).unwrap();
            std::thread::sleep(Duration::from_millis(20));
        }
    })]);
    let mut camera = open(&url).unwrap();
    let numbers: Vec<u64> = (0..7).map(|_| camera.next_frame(SOON).unwrap().sequence).collect();
    assert_eq!(numbers, [0, 1, 2, 3, 4, 5, 9]);
    let error = camera.next_frame(Duration::from_millis(300)).unwrap_err();
    assert!(matches!(&error, DeviceError::Disconnected { reason, .. } if reason.contains("froze")));
}

#[test]
fn our_own_server_is_a_camera_too() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let server = MjpegServer::start(listener, &["/left", "/right"]).unwrap();
    let at = |path: &str| format!("http://{}{path}", server.address());
    let mut camera = open(&at("/right?any")).unwrap();
    assert!(!server.watched(0));
    for i in 0..5u8 {
        while !server.watched(1) {
            std::thread::sleep(Duration::from_millis(2));
        }
        server.show(1, jpeg(40 * i), Duration::from_millis(100 * u64::from(i)));
        let frame = camera.next_frame(SOON).unwrap();
        assert!(frame.image.data()[0].abs_diff(40 * i) < 4);
    }
    let mut nowhere = open(&at("/up")).unwrap();
    let error = nowhere.next_frame(Duration::from_millis(500)).unwrap_err().to_string();
    assert!(error.contains("404"), "{error}");
    drop(server);
    let error = camera.next_frame(Duration::from_millis(500)).unwrap_err();
    assert!(matches!(error, DeviceError::Disconnected { .. }), "{error}");
}
