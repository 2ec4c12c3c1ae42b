//! Three tags on TCP: an open cup, a can that wants encryption, a box whose passkey is 123456.
//!
//! ```text
//! cargo run -p vergence-link --example tag_server -- 127.0.0.1:9100
//! ```
//! Any Bluetooth host that speaks H4 over TCP may connect; `scripts/check_bumble.py` does.

use std::net::TcpListener;
use std::time::Duration;

use vergence_air::AirConfig;
use vergence_devices::TagAddress;
use vergence_firmware::{Access, Config};
use vergence_link::{TagServer, VirtualTag};
use vergence_tag::{Record, cbor};

fn record(id: &str) -> Result<Vec<u8>, Box<dyn std::error::Error>> {
    let record: Record = serde_json::from_value(serde_json::json!({
        "object_id": id,
        "landmarks": [{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}],
        "bounding_box": {"width": 0.08, "length": 0.08, "height": 0.09},
        "shape": {"kind": "box"},
    }))?;
    let mut bytes = Vec::new();
    cbor::encode(&record, &mut bytes)?;
    Ok(bytes)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("127.0.0.1:9100".into());
    let mut tags = Vec::new();
    for (number, id, passkey, access) in [
        (1, "cup", None, Access::Open),
        (2, "can", None, Access::Encrypted),
        (3, "box", Some(123_456), Access::Authenticated),
    ] {
        let config = Config {
            passkey,
            record_access: access,
            write_access: access,
            command_access: access,
            ..Config::default()
        };
        tags.push(VirtualTag {
            address: TagAddress([0xC0, 1, 2, 3, 4, number]),
            record: record(id)?,
            lights: 1,
            battery: 80,
            config,
        });
    }
    let listener = TcpListener::bind(&address)?;
    println!("tags on {}", listener.local_addr()?);
    let _server =
        TagServer::start(listener, AirConfig::default(), tags, Duration::ZERO, |_| Some(-50))?;
    loop {
        std::thread::park();
    }
}
