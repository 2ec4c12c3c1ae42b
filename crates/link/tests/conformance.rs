//! The conformance suite over the radio's trait: on virtual time, and over TCP on real time.
#![allow(clippy::unwrap_used)] // Outside of #[test] functions too: a test that cannot go on fails.

#[path = "support/conformance.rs"]
mod suite;
mod support;

use std::net::TcpListener;
use std::time::Duration;

use suite::{BOX, CAN, CUP, PASSKEY, conform};
use support::{clock, tag};
use vergence_air::AirConfig;
use vergence_firmware::{Access, Config};
use vergence_link::{HciLink, LinkConfig, RadioConfig, TagServer, VirtualRadio, VirtualTag};

fn tags() -> Vec<VirtualTag> {
    [
        ("cup", CUP, None, Access::Open),
        ("can", CAN, None, Access::Encrypted),
        ("box", BOX, Some(PASSKEY), Access::Authenticated),
    ]
    .map(|(id, address, passkey, access)| VirtualTag {
        address,
        config: Config {
            passkey,
            record_access: access,
            write_access: access,
            command_access: access,
            ..Config::default()
        },
        ..tag(id, 0)
    })
    .into()
}

#[test]
fn our_host_conforms_on_virtual_time() {
    let config = RadioConfig::default();
    let radio = VirtualRadio::new(config, tags(), Duration::ZERO, |_| Some(-50)).unwrap();
    assert_eq!(conform(&mut radio.link(clock())), 0);
}

#[test]
fn our_host_conforms_over_tcp() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let air = AirConfig::default();
    let _server = TagServer::start(listener, air, tags(), Duration::ZERO, |_| Some(-50)).unwrap();
    assert_eq!(conform(&mut HciLink::tcp(&address, LinkConfig::default()).unwrap()), 0);
}
