//! What every tag radio must do with the tags of the example `tag_server`: run on virtual time, over TCP,
//! and (by the example `bluez_probe`) on a real kernel with BlueZ.

use std::error::Error;
use std::time::{Duration, Instant};

use vergence_devices::{DeviceError, LedCommand, TagAddress};
use vergence_link::TagRadio;
use vergence_tag::{Pattern, cbor, pattern::Bits};

type Outcome = Result<String, Box<dyn Error>>;
type Check = fn(&mut dyn TagRadio) -> Outcome;

/// Open to everybody.
pub const CUP: TagAddress = TagAddress([0xC0, 1, 2, 3, 4, 1]);
/// Wants encryption.
pub const CAN: TagAddress = TagAddress([0xC0, 1, 2, 3, 4, 2]);
/// Wants its passkey.
pub const BOX: TagAddress = TagAddress([0xC0, 1, 2, 3, 4, 3]);
pub const PASSKEY: u32 = 123_456;
const NOBODY: TagAddress = TagAddress([0xC0, 9, 9, 9, 9, 9]);
/// An emulated processor is slow.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Runs all checks and prints one line for each; how many failed.
pub fn conform(link: &mut dyn TagRadio) -> usize {
    let mut failed = 0;
    let checks: [(&str, Check); 11] = [
        ("scan", scan),
        ("record", |link| record(link, CUP, "cup")),
        ("record once more", |link| record(link, CUP, "cup")),
        ("light", light),
        ("what the tag tells of itself", info),
        ("new record", new_record),
        ("pairing by Just Works", |link| pair(link, CAN, None, "can")),
        ("pairing by passkey", |link| pair(link, BOX, Some(PASSKEY), "box")),
        ("wrong passkey", wrong),
        ("tag that is not there", nobody),
        ("scan with tags that are known", scan),
    ];
    for (name, check) in checks {
        let begin = Instant::now();
        let outcome = check(link);
        let took = begin.elapsed().as_secs_f64() * 1e3;
        match outcome {
            Ok(figures) => println!("ok    {name} ({took:.0} ms): {figures}"),
            Err(error) => {
                failed += 1;
                println!("FAIL  {name} ({took:.0} ms): {error}");
            }
        }
    }
    println!("{} of {} checks passed", checks.len() - failed, checks.len());
    failed
}

fn ensure(good: bool, what: impl FnOnce() -> String) -> Result<(), Box<dyn Error>> {
    if good { Ok(()) } else { Err(what().into()) }
}

fn scan(link: &mut dyn TagRadio) -> Outcome {
    let heard = link.scan(Duration::from_secs(2))?;
    let mut ids: Vec<(&str, TagAddress, Option<u8>)> =
        heard.iter().map(|tag| (&*tag.object_id, tag.address, tag.battery)).collect();
    ids.sort();
    let truth = [("box", BOX, Some(80)), ("can", CAN, Some(80)), ("cup", CUP, Some(80))];
    ensure(ids == truth, || format!("{heard:?}"))?;
    ensure(heard.iter().all(|tag| tag.rssi == -50), || format!("{heard:?}"))?;
    Ok("three tags with id, battery 80 % and -50 dBm".into())
}

fn record(link: &mut dyn TagRadio, tag: TagAddress, id: &str) -> Outcome {
    let bytes = link.read_record(tag, TIMEOUT)?;
    let record = cbor::decode(&bytes)?;
    ensure(record.object_id == *id, || format!("{record:?}"))?;
    Ok(format!("{} bytes, object \"{}\"", bytes.len(), record.object_id))
}

fn light(link: &mut dyn TagRadio) -> Outcome {
    let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(50))?;
    let begin = Instant::now();
    let on = link.command(CUP, LedCommand::Play(pattern), TIMEOUT)?;
    let first = begin.elapsed();
    let begin = Instant::now();
    let off = link.command(CUP, LedCommand::Stop, TIMEOUT)?;
    ensure(on.playing && !off.playing, || format!("{on:?}, {off:?}"))?;
    let ms = |time: Duration| time.as_secs_f64() * 1e3;
    Ok(format!(
        "playing after {:.0} ms with a new link, stopped after {:.0} ms on the held one",
        ms(first),
        ms(begin.elapsed())
    ))
}

fn info(link: &mut dyn TagRadio) -> Outcome {
    let info = link.info(CUP, TIMEOUT)?;
    ensure(info.battery == Some(80) && info.has_record && !info.playing, || format!("{info:?}"))?;
    ensure(!info.firmware.is_empty(), || format!("{info:?}"))?;
    Ok(format!("{} {}, firmware {}", info.manufacturer, info.model, info.firmware))
}

fn new_record(link: &mut dyn TagRadio) -> Outcome {
    let old = link.read_record(CUP, TIMEOUT)?;
    let mut changed = cbor::decode(&old)?;
    changed.bounding_box.height += 0.01;
    let mut new = Vec::new();
    cbor::encode(&changed, &mut new)?;
    link.write_record(CUP, &new, TIMEOUT)?;
    let read = link.read_record(CUP, TIMEOUT)?;
    link.write_record(CUP, &old, TIMEOUT)?;
    ensure(read == new && new != old, || "another record than was written".into())?;
    Ok(format!("{} bytes written and read back", new.len()))
}

/// The fault that a call ends with.
fn fault<T>(outcome: Result<T, DeviceError>) -> Result<String, Box<dyn Error>> {
    match outcome {
        Err(DeviceError::Fault { fault, .. }) => Ok(fault),
        Err(error) => Err(error.into()),
        Ok(_) => Err("allowed".into()),
    }
}

fn pair(link: &mut dyn TagRadio, tag: TagAddress, passkey: Option<u32>, id: &str) -> Outcome {
    let begin = Instant::now();
    link.pair(tag, passkey)?;
    let took = begin.elapsed().as_secs_f64() * 1e3;
    let read = record(link, tag, id)?;
    let state = link.command(tag, LedCommand::Stop, TIMEOUT)?;
    ensure(!state.playing, || format!("{state:?}"))?;
    Ok(format!("paired in {took:.0} ms; {read}; commanded"))
}

/// After a wrong passkey the old bond is gone as well, and the tag refuses what it guards.
fn wrong(link: &mut dyn TagRadio) -> Outcome {
    let pairing = fault(link.pair(BOX, Some(PASSKEY + 1)).map(drop))?;
    let read = fault(link.read_record(BOX, TIMEOUT))?;
    let command = fault(link.command(BOX, LedCommand::Stop, TIMEOUT))?;
    Ok(format!("\"{pairing}\"; record: \"{read}\"; command: \"{command}\""))
}

fn nobody(link: &mut dyn TagRadio) -> Outcome {
    let limit = Duration::from_secs(3);
    let begin = Instant::now();
    let outcome = link.read_record(NOBODY, limit);
    let took = begin.elapsed();
    let Err(DeviceError::Timeout { .. }) = outcome else {
        return Err(format!("{outcome:?}").into());
    };
    ensure(took < limit * 2, || format!("{took:?}"))?;
    record(link, CUP, "cup")?;
    Ok(format!("given up after {:.1} s, the next tag is read all the same", took.as_secs_f64()))
}
