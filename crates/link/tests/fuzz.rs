//! Sessions over a link that mangles what it carries: one fragment in six, both ways. Every call ends
//! in time, nobody panics, and a tag that is left alone again serves its record.

mod support;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use support::{TIMEOUT, address, clock, record, tag};
use vergence_air::{AirConfig, Fate, Fragment};
use vergence_devices::{Clock, LedCommand, TagLink};
use vergence_firmware::{Access, Config};
use vergence_link::{RadioConfig, VirtualRadio, VirtualTag};
use vergence_tag::{Pattern, pattern::Bits};

const SESSIONS: u64 = 1000;

fn mangle(rng: &mut Pcg32, fragment: &Fragment<'_>) -> Fate {
    if rng.random_range(0..6) != 0 {
        return Fate::Deliver;
    }
    let mut data = fragment.data.to_vec();
    match rng.random_range(0..10) {
        0 => return Fate::Lose,
        1 => return Fate::Delay(Duration::from_millis(rng.random_range(1..500))),
        2 => return Fate::Kill(0x08),
        3 => data.truncate(rng.random_range(0..=data.len())),
        4 => data.extend((0..rng.random_range(1..40)).map(|k| k as u8)),
        5 if data.len() > 4 => {
            // The payload is cut and the length with it: well-formed lies.
            data.truncate(rng.random_range(4..=data.len()));
            let length = (data.len() - 4) as u16;
            data[..2].copy_from_slice(&length.to_le_bytes());
        }
        _ => {
            for _ in 0..rng.random_range(1..4) {
                if !data.is_empty() {
                    let at = rng.random_range(0..data.len());
                    data[at] = rng.random();
                }
            }
        }
    }
    Fate::Replace(data)
}

fn session(seed: u64) {
    let mut rng = Pcg32::seed_from_u64(seed);
    let passkey = rng.random_bool(0.5).then_some(111_222);
    let access = [Access::Open, Access::Encrypted][rng.random_range(0..2)];
    let config = Config { passkey, record_access: access, ..Config::default() };
    let victim = VirtualTag { config, ..tag("cup", 1) };
    let air = AirConfig {
        acl_bytes: if rng.random_bool(0.5) { 27 } else { 251 },
        seed,
        ..AirConfig::default()
    };
    let faulty = Arc::new(AtomicBool::new(true));
    let fault = faulty.clone();
    let mut fault_rng = Pcg32::seed_from_u64(seed + 1);
    let radio = VirtualRadio::with_guests(
        RadioConfig { air, ..RadioConfig::default() },
        vec![victim],
        Duration::ZERO,
        |_| Some(-60),
        move |_, air| {
            air.set_fault(move |fragment| match fault.load(Ordering::SeqCst) {
                true => mangle(&mut fault_rng, fragment),
                false => Fate::Deliver,
            });
        },
    )
    .unwrap();
    let time = clock();
    let mut link = radio.link(time.clone());
    let bound = Duration::from_secs(3);
    let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap();
    for _ in 0..3 {
        let start = time.now();
        match rng.random_range(0..5) {
            0 => drop(link.read_record(address(1), bound)),
            1 => drop(link.command(address(1), LedCommand::Play(pattern), bound)),
            2 => drop(link.info(address(1), bound)),
            3 => drop(link.write_record(address(1), &record("mug"), bound)),
            _ => drop(link.pair(address(1), passkey)),
        }
        let longest = Duration::from_secs(31);
        assert!(time.now() - start < longest, "seed {seed}: a call took {:?}", time.now() - start);
    }
    faulty.store(false, Ordering::SeqCst);
    // Mangled pairings may have left bonds that no longer match; a new pairing mends that.
    time.sleep(Duration::from_secs(40));
    let _ = link.release(address(1));
    let mut read = link.read_record(address(1), TIMEOUT);
    if read.is_err() {
        let _ = link.pair(address(1), passkey);
        read = link.read_record(address(1), TIMEOUT);
    }
    let bytes = read.unwrap_or_else(|error| panic!("seed {seed}: {error}"));
    assert!([record("cup"), record("mug")].contains(&bytes), "seed {seed}: {bytes:?}");
}

#[test]
fn mangled_sessions_end_and_heal() {
    (0..SESSIONS).for_each(session);
}
