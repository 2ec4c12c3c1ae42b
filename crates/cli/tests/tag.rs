//! The tag commands against tags in the simulated workcell, and against tags on a Bluetooth
//! controller behind TCP, which outlive the command.

// Helpers outside of test functions fail a test by panicking, too.
#![allow(clippy::unwrap_used)]

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use serde_json::Value;
use vergence_air::AirConfig;
use vergence_devices::TagAddress;
use vergence_firmware::{Access, Config};
use vergence_link::{TagServer, VirtualTag};

fn vergence(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vergence")).args(args).output().unwrap()
}

/// The command's output, which must have been achieved.
fn achieved(args: &[&str]) -> String {
    let output = vergence(args);
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{args:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// What the command said when it failed with this status.
fn refused(args: &[&str], status: i32) -> String {
    let output = vergence(args);
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(status), "{args:?}: {errors}");
    assert!(errors.contains("what to do"), "{errors}");
    errors
}

fn folder(name: &str) -> PathBuf {
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    dir
}

fn record(id: &str) -> String {
    format!(
        "object_id = \"{id}\"\n\
         landmarks = [{{ position = [0.04, 0.0, 0.0], normal = [1.0, 0.0, 0.0] }}]\n\
         bounding_box = {{ width = 0.08, length = 0.08, height = 0.09 }}\n\
         shape = {{ kind = \"box\" }}\n"
    )
}

#[test]
fn simulated_tags_answer() {
    let info: Value = serde_json::from_str(&achieved(&["tag", "info", "cup", "--json"])).unwrap();
    assert_eq!((&info["model"], &info["has_record"]), (&"simulated tag".into(), &true.into()));
    let address = info["address"].as_str().unwrap();
    assert!(achieved(&["tag", "info", address]).contains("simulated tag"));
    achieved(&["tag", "blink", "cup", "--pattern", "10110", "--chip-ms", "33", "--seconds", "2"]);
    refused(&["tag", "blink", "cup", "--chip-ms", "0.1"], 2);
    for seconds in ["0", "-1", "nan", "65536"] {
        let said = refused(&["tag", "blink", "cup", &format!("--seconds={seconds}")], 2);
        assert!(said.contains("--seconds"), "{said}");
    }
    // A simulated tag ends a play after 30 s by itself.
    assert!(refused(&["tag", "blink", "cup", "--seconds", "40"], 1).contains("went dark"));
    assert!(refused(&["tag", "info", "teapot"], 1).contains("cup"));
    assert!(achieved(&["tag", "pair", "cup"]).contains("not kept"));
}

#[test]
fn a_record_is_checked_before_it_is_written() {
    let dir = folder("record");
    let file = dir.join("cup.toml");
    let path = file.to_str().unwrap();
    std::fs::write(&file, record("cup").replace("0.09", "-0.09")).unwrap();
    assert!(refused(&["tag", "write", path], 2).contains("cup.toml"));
    std::fs::write(&file, record("cup")).unwrap();
    assert!(refused(&["tag", "write", path], 1).contains("not paired"));
    assert!(achieved(&["tag", "write", path, "--pair"]).contains("\"cup\""));
}

#[test]
fn a_tag_behind_a_controller_is_paired_once_and_written_later() {
    let dir = folder("controller");
    let (config, kettle) = (dir.join("workcell.toml"), dir.join("kettle.toml"));
    achieved(&["workcell", dir.to_str().unwrap()]);
    std::fs::write(&kettle, record("kettle")).unwrap();
    let bytes = {
        let record: vergence_tag::Record = toml::from_str(&record("can")).unwrap();
        let mut bytes = Vec::new();
        vergence_tag::cbor::encode(&record, &mut bytes).unwrap();
        bytes
    };
    let tag = VirtualTag {
        address: TagAddress([0xC0, 1, 2, 3, 4, 5]),
        record: bytes,
        lights: 1,
        battery: 77,
        config: Config {
            passkey: Some(123_456),
            write_access: Access::Authenticated,
            ..Config::default()
        },
    };
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let air = AirConfig::default();
    let _server =
        TagServer::start(listener, air, vec![tag], Duration::ZERO, |_| Some(-50)).unwrap();
    let radio = format!("driver = \"hci\"\ntcp = \"127.0.0.1:{port}\"\nbonds = \"tags.bonds\"");
    let text = std::fs::read_to_string(&config).unwrap();
    let wired = text.replace("[radio]\ndriver = \"sim\"", &format!("[radio]\n{radio}"));
    assert!(wired != text);
    std::fs::write(&config, wired).unwrap();
    let (config, kettle) = (config.to_str().unwrap(), kettle.to_str().unwrap());

    let tags: Value =
        serde_json::from_str(&achieved(&["tags", "--config", config, "--json"])).unwrap();
    assert_eq!((&tags["tags"][0]["id"], &tags["tags"][0]["battery"]), (&"can".into(), &77.into()));
    let write = ["tag", "write", kettle, "--to", "C0:01:02:03:04:05", "--config", config];
    assert!(refused(&write, 1).contains("not paired"));
    let pair = ["tag", "pair", "can", "--passkey", "123456", "--config", config];
    assert!(!achieved(&pair).contains("not kept"));
    achieved(&write);
    let info = || achieved(&["tag", "info", "kettle", "--config", config]);
    assert!(info().contains("yes, not signed"), "{}", info());

    // The owner signs; who trusts his key is told so, who trusts another's as well.
    let (key, other) = (dir.join("owner.pem"), dir.join("other.pem"));
    let public = dir.join("third.pub");
    assert!(refused(&["tag", "key", public.to_str().unwrap()], 2).contains("third.pub"));
    assert!(!public.exists());
    std::fs::write(&public, "another's").unwrap();
    let private = dir.join("third.pem");
    assert!(refused(&["tag", "key", private.to_str().unwrap()], 1).contains("third.pub"));
    assert!(!private.exists());
    assert_eq!(std::fs::read_to_string(&public).unwrap(), "another's");
    for key in [&key, &other] {
        achieved(&["tag", "key", key.to_str().unwrap()]);
    }
    assert!(refused(&["tag", "key", key.to_str().unwrap()], 1).contains("owner.pem"));
    achieved(&[&write[..], &["--sign", key.to_str().unwrap()]].concat());
    let text = std::fs::read_to_string(config).unwrap();
    for (file, verdict) in [
        ("owner.pub", "yes, signed by owner"),
        ("other.pub", "yes, signed by a key that is not trusted"),
    ] {
        let radio = format!("[radio]\ntrusted_keys = [\"{file}\"]");
        std::fs::write(config, text.replace("[radio]", &radio)).unwrap();
        assert!(info().contains(verdict), "{}", info());
    }
    let tags: Value =
        serde_json::from_str(&achieved(&["tags", "--config", config, "--json"])).unwrap();
    assert_eq!(tags["tags"][0]["signature"], "signed by a key that is not trusted");
}

#[test]
fn a_robot_that_wants_signatures_finds_nothing_unsigned() {
    let dir = folder("unsigned");
    let config = dir.join("workcell.toml");
    achieved(&["workcell", dir.to_str().unwrap()]);
    let text = std::fs::read_to_string(&config).unwrap();
    let (path, find) = (config.to_str().unwrap(), |path| ["find", "cup", "--config", path]);
    std::fs::write(&config, text.replace("[radio]", "[radio]\nrequire_signature = true")).unwrap();
    assert!(refused(&find(path), 2).contains("trusts no key"));
    achieved(&["tag", "key", dir.join("owner.pem").to_str().unwrap()]);
    let radio = "[radio]\nrequire_signature = true\ntrusted_keys = [\"owner.pub\"]";
    std::fs::write(&config, text.replace("[radio]", radio)).unwrap();
    let output = vergence(&find(path));
    let said = String::from_utf8_lossy(&output.stdout).into_owned()
        + &String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("not signed") && said.contains("--sign"), "{said}");
}
