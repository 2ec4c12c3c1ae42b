//! `vergence-tagd` as a process: a robot reaches it over the virtual air on TCP, its LED is a file, and
//! killing it at any time loses no record.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use vergence_air::{Air, AirConfig, Executor, serve};
use vergence_devices::{LedCommand, TagAddress, TagLink};
use vergence_link::{HciLink, LinkConfig};
use vergence_tag::{Pattern, Record, cbor, pattern::Bits};

/// Long, for a computer that is busy with other tests.
const TIMEOUT: Duration = Duration::from_secs(30);
const PASSKEY: u32 = 271_828;

/// Controllers on TCP that hear each other.
fn air() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        let executor = Executor::new();
        let air = Air::new(AirConfig::default());
        executor.spawn(air.clone().run());
        let _ = executor.block_on(serve(air, listener));
    });
    address
}

/// A board: its LED class and its settings in a folder.
struct BoardFiles {
    dir: PathBuf,
}

impl BoardFiles {
    fn new(name: &str, air: &str) -> Self {
        let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = fs::remove_dir_all(&dir);
        let led = dir.join("leds/ir");
        fs::create_dir_all(&led).unwrap();
        fs::write(led.join("max_brightness"), "255\n").unwrap();
        fs::write(led.join("brightness"), "255\n").unwrap();
        fs::create_dir(dir.join("battery")).unwrap();
        fs::write(dir.join("battery/capacity"), "64\n").unwrap();
        let settings = format!(
            "store = {:?}\npasskey = {PASSKEY}\ncontroller = {{ tcp = {air:?} }}\n\
             lights = [{{ led = {led:?} }}]\nbattery = {:?}\n",
            dir.join("tag.flash"),
            dir.join("battery"),
        );
        fs::write(dir.join("tag.toml"), settings).unwrap();
        fs::write(dir.join("cup.toml"), toml::to_string(&record("cup")).unwrap()).unwrap();
        BoardFiles { dir }
    }

    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_vergence-tagd"));
        command.arg(self.dir.join("tag.toml")).arg("--record").arg(self.dir.join("cup.toml"));
        command.stderr(Stdio::piped());
        command
    }

    fn start(&self) -> Tag {
        Tag::start(&mut self.command())
    }

    fn brightness(&self) -> String {
        loop {
            let text = fs::read_to_string(self.dir.join("leds/ir/brightness")).unwrap();
            // Unlike one of the kernel's, this file is empty for a moment while it is written.
            if !text.is_empty() {
                return text;
            }
        }
    }
}

struct Tag {
    process: Child,
    /// What it said when it was up.
    hello: String,
}

impl Drop for Tag {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Tag {
    fn start(command: &mut Command) -> Self {
        let mut process = command.spawn().unwrap();
        let mut hello = String::new();
        BufReader::new(process.stderr.take().unwrap()).read_line(&mut hello).unwrap();
        Tag { process, hello }
    }
}

fn record(id: &str) -> Record {
    toml::from_str(&format!(
        "object_id = \"{id}\"\n\
         landmarks = [{{ position = [0.04, 0.0, 0.0], normal = [1.0, 0.0, 0.0] }}]\n\
         bounding_box = {{ width = 0.08, length = 0.08, height = 0.09 }}\n\
         shape = {{ kind = \"box\" }}\n"
    ))
    .unwrap()
}

fn encoded(id: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    cbor::encode(&record(id), &mut bytes).unwrap();
    bytes
}

fn robot(air: &str) -> HciLink {
    let config = LinkConfig {
        interval: Duration::from_micros(7500),
        supervision_timeout: Duration::from_millis(400),
        ..LinkConfig::default()
    };
    HciLink::tcp(air, config).unwrap()
}

fn only_tag(robot: &mut HciLink) -> TagAddress {
    for _ in 0..20 {
        let heard = robot.scan(Duration::from_millis(500)).unwrap();
        match &heard[..] {
            [] => {}
            [tag] => return tag.address,
            _ => panic!("{heard:?}"),
        }
    }
    panic!("no tag was heard");
}

/// Waits until something is so.
fn soon(what: &str, mut so: impl FnMut() -> bool) {
    let start = Instant::now();
    while !so() {
        assert!(start.elapsed() < TIMEOUT, "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_robot_reads_commands_pairs_and_writes() {
    let air = air();
    let board = BoardFiles::new("commands", &air);
    let inbox = board.dir.join("notify");
    let manager = UnixDatagram::bind(&inbox).unwrap();
    manager.set_read_timeout(Some(TIMEOUT)).unwrap();
    let mut tag = Tag::start(board.command().env("NOTIFY_SOCKET", &inbox));
    assert!(tag.hello.contains("holds the record of \"cup\""), "{}", tag.hello);
    // The service manager hears that it is up, and that it is alive.
    let mut words: Vec<String> = Vec::new();
    while !["READY=1", "WATCHDOG=1"].iter().all(|word| words.contains(&(*word).into())) {
        let mut word = [0; 64];
        let length = manager.recv(&mut word).unwrap();
        words.push(String::from_utf8_lossy(&word[..length]).into_owned());
    }

    let mut robot = robot(&air);
    let address = only_tag(&mut robot);
    assert!(tag.hello.contains(&address.to_string()), "{}", tag.hello);
    let info = robot.info(address, TIMEOUT).unwrap();
    assert_eq!((info.model.as_str(), info.battery), ("Linux board", Some(64)));
    assert_eq!(robot.read_record(address, TIMEOUT).unwrap(), encoded("cup"));

    assert_eq!(board.brightness(), "0", "dark from the start");
    let mut pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(40)).unwrap();
    pattern.brightness = 200;
    robot.play_for(address, pattern, Duration::from_secs(20), TIMEOUT).unwrap();
    for expected in ["200", "0", "200", "0"] {
        soon("the LED flickers", || board.brightness() == expected);
    }
    robot.command(address, LedCommand::Stop, TIMEOUT).unwrap();
    soon("the LED goes dark", || board.brightness() == "0");

    let refused = robot.write_record(address, &encoded("mug"), TIMEOUT).unwrap_err();
    assert!(refused.to_string().contains("not paired"), "{refused}");
    robot.pair(address, Some(PASSKEY)).unwrap();
    robot.write_record(address, &encoded("mug"), TIMEOUT).unwrap();

    // Told to end while the light plays, it leaves the board dark; started again, it knows the robot.
    robot.play_for(address, pattern, Duration::from_secs(20), TIMEOUT).unwrap();
    soon("the LED is on", || board.brightness() == "200");
    let id = tag.process.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &id]).status().unwrap().success());
    assert_eq!(tag.process.wait().unwrap().code(), Some(0));
    assert_eq!(board.brightness(), "0");
    let tag = board.start();
    assert!(tag.hello.contains("holds the record of \"mug\""), "{}", tag.hello);
    robot.write_record(address, &encoded("jug"), TIMEOUT).unwrap();
    assert_eq!(robot.read_record(address, TIMEOUT).unwrap(), encoded("jug"));
}

#[test]
fn killing_it_in_the_middle_of_a_write_loses_no_record() {
    let air = air();
    let board = BoardFiles::new("kill", &air);
    let mut robot = robot(&air);
    let mut tag = board.start();
    let address = only_tag(&mut robot);
    robot.pair(address, Some(PASSKEY)).unwrap();
    // Before the tag takes the next link it has stored the bond.
    robot.read_record(address, TIMEOUT).unwrap();
    let mut last = "cup".to_owned();
    let mut cut_short = 0;
    for (round, delay) in [10u64, 50, 63, 70, 78, 90, 105].into_iter().enumerate() {
        let next = format!("cup{round}");
        // The write goes on while the tag is killed.
        let writer = {
            let bytes = encoded(&next);
            std::thread::spawn(move || {
                let written = robot.write_record(address, &bytes, Duration::from_secs(1));
                (robot, written.is_ok())
            })
        };
        // Connecting takes up to 100 ms; the kill falls into it and into all that comes after.
        std::thread::sleep(Duration::from_millis(delay));
        drop(tag);
        let (back, written) = writer.join().unwrap();
        robot = back;
        cut_short += usize::from(!written);
        tag = board.start();
        let found = robot.read_record(address, TIMEOUT).unwrap();
        let whole = [encoded(&last), encoded(&next)].contains(&found);
        assert!(whole, "round {round}: neither \"{last}\" nor \"{next}\": {found:?}");
        assert!(!written || found == encoded(&next), "round {round}: a written record was lost");
        last = cbor::decode(&found).unwrap().object_id.to_string();
    }
    assert!(cut_short > 0, "no write was cut short");
}

#[test]
fn the_watchdog_resets_no_board_whose_controller_is_missing_or_fails() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let board = BoardFiles::new("watchdog", &listener.local_addr().unwrap().to_string());
    let device = board.dir.join("watchdog");
    fs::write(&device, "").unwrap();
    let settings = board.dir.join("tag.toml");
    let text = fs::read_to_string(&settings).unwrap();
    fs::write(&settings, format!("{text}watchdog = {device:?}\n")).unwrap();

    // A controller that hangs up at once.
    let hangs_up = std::thread::spawn(move || drop(listener.accept().unwrap()));
    let output = board.command().output().unwrap();
    hangs_up.join().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let words = fs::read(&device).unwrap();
    assert_eq!(words.last(), Some(&b'V'), "started and dismissed: {words:?}");

    // And none at all.
    fs::write(&device, "").unwrap();
    assert_eq!(board.command().output().unwrap().status.code(), Some(1));
    assert!(fs::read(&device).unwrap().is_empty(), "it was started");
}

#[test]
fn what_does_not_work_is_named() {
    let said = |board: &BoardFiles| {
        let output = board.command().output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let board = BoardFiles::new("faults", &free);
    assert!(said(&board).contains(&free), "a controller that is not there");
    let settings = board.dir.join("tag.toml");
    let text = fs::read_to_string(&settings).unwrap();
    fs::write(&settings, text.replace("passkey = 271828", "passkey = 2718281")).unwrap();
    assert!(said(&board).contains("six digits"));
    fs::write(&settings, text.replace("tcp =", "udp =")).unwrap();
    assert!(said(&board).contains("controller"));
    fs::write(&settings, &text).unwrap();
    fs::write(board.dir.join("tag.flash"), "something else").unwrap();
    assert!(said(&board).contains("not a tag's memory"));
}
