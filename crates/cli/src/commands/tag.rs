//! `vergence tag ...`: work on one tag over the radio: what it is, its light, its record, pairing.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use serde::Serialize;
use serde_json::json;
use vergence_devices::{DeviceError, TagAddress};
use vergence_tag::command::LONGEST_LIMIT;
use vergence_tag::{Pattern, Record, Shown, cbor, pattern::Bits};

use crate::failure::Failure;
use crate::output::{outln, told};
use crate::radio::Radio;
use crate::robot::RobotArgs;
use crate::signing;

/// Work on one tag: write its record, blink its light, pair with it, ask what it is.
#[derive(Args)]
pub struct Tag {
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand)]
enum Action {
    /// Give a tag a new record.
    Write(Write),
    /// Play a pattern on a tag's light.
    Blink(Blink),
    /// Pair with a tag: its owner's proof that this robot may command it.
    Pair(Pair),
    /// Tell what a tag is and how it does.
    Info(Info),
    /// Make a pair of keys for signing records.
    Key(Key),
}

#[derive(Args)]
struct Write {
    /// The record (TOML, or JSON when the name ends in .json).
    file: PathBuf,
    /// The tag's address; else the tag that carries the record's object id now.
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    to: Option<TagAddress>,
    /// Pair first with the six digits that are printed on the tag.
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=999_999))]
    passkey: Option<u32>,
    /// Pair first, with a tag that has no passkey.
    #[arg(long, conflicts_with = "passkey")]
    pair: bool,
    /// Sign the record with this private key (PEM).
    #[arg(long, value_name = "KEY")]
    sign: Option<PathBuf>,
    #[command(flatten)]
    robot: RobotArgs,
}

#[derive(Args)]
struct Blink {
    /// Object id or address of the tag.
    id: String,
    /// Chips in order of time: 1 is on, 0 is off.
    #[arg(long, default_value = "10")]
    pattern: Bits,
    /// How long a chip lasts (ms).
    #[arg(long, default_value_t = 100.0)]
    chip_ms: f64,
    /// How long the light plays (s); a tag may be set to end it earlier.
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    #[command(flatten)]
    robot: RobotArgs,
}

#[derive(Args)]
struct Pair {
    /// Object id or address of the tag.
    id: String,
    /// The six digits that are printed on the tag; without them the pairing proves nothing.
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=999_999))]
    passkey: Option<u32>,
    #[command(flatten)]
    robot: RobotArgs,
}

#[derive(Args)]
struct Info {
    /// Object id or address of the tag.
    id: String,
    #[command(flatten)]
    robot: RobotArgs,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
struct Key {
    /// The private key's file; the public key, for the `trusted_keys` of robots, comes beside it.
    file: PathBuf,
}

#[derive(Serialize)]
struct InfoOutput {
    address: String,
    manufacturer: String,
    model: String,
    firmware: String,
    battery: Option<u8>,
    has_record: bool,
    /// What the record's signature says; absent when the record cannot be read.
    signature: Option<String>,
    playing: bool,
    rssi: Option<i8>,
}

/// How long the radio listens: idle tags advertise about once a second.
const WINDOW: Duration = Duration::from_millis(2500);
/// How long before a play's end the tag is asked whether it still plays.
const LAST_LOOK: Duration = Duration::from_millis(500);
/// Longest wait for one answer.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Runs the command.
pub fn run(args: &Tag) -> Result<bool, Failure> {
    match &args.action {
        Action::Write(args) => write(args),
        Action::Blink(args) => blink(args),
        Action::Pair(args) => pair(args),
        Action::Info(args) => info(args),
        Action::Key(args) => key(args),
    }
}

fn write(args: &Write) -> Result<bool, Failure> {
    let record = read_record(&args.file)?;
    let mut bytes = encoded(&record, &args.file)?;
    if let Some(path) = &args.sign {
        let signed = signing::owner_key(path)?.sign(&bytes);
        bytes = signed.map_err(|error| Failure::misuse(error, "use fewer vertices"))?;
    }
    let mut radio = args.robot.open_radio()?;
    let tag = match args.to {
        // Listening tells whether the address is a public one.
        Some(tag) => radio.link.scan(WINDOW).map(|_| tag).map_err(failed)?,
        None => find(&mut radio, &record.object_id)?,
    };
    if args.pair || args.passkey.is_some() {
        bond(&mut radio, tag, args.passkey)?;
    }
    radio.link.write_record(tag, &bytes, TIMEOUT).map_err(failed)?;
    outln!("{tag} now is \"{}\" ({} bytes)", record.object_id, bytes.len());
    Ok(true)
}

fn blink(args: &Blink) -> Result<bool, Failure> {
    let time = |value: f64, unit: f64, name: &str| {
        Duration::try_from_secs_f64(value * unit).map_err(|error| {
            Failure::misuse(format!("{name} {value}: {error}"), "give a positive number")
        })
    };
    let chip = time(args.chip_ms, 1e-3, "--chip-ms")?;
    let limit = time(args.seconds, 1.0, "--seconds")?;
    if limit.is_zero() || limit > LONGEST_LIMIT {
        let most = LONGEST_LIMIT.as_secs();
        return Err(Failure::misuse(
            format!("--seconds {} is no time that a tag can be told", args.seconds),
            format!("give more than 0 and at most {most}"),
        ));
    }
    let pattern = Pattern::new(args.pattern, chip)
        .map_err(|error| Failure::misuse(error, "choose another --chip-ms"))?;
    let mut radio = args.robot.open_radio()?;
    let tag = find(&mut radio, &args.id)?;
    radio.link.play_for(tag, pattern, limit, TIMEOUT).map_err(failed)?;
    eprintln!("{tag} plays {} for {:.1} s", args.pattern, limit.as_secs_f64());
    // The tag goes dark when its robot is gone, so that the robot must stay.
    let before_end = LAST_LOOK.min(limit / 2);
    radio.clock.sleep(limit - before_end);
    let plays = radio.link.info(tag, TIMEOUT).map_err(failed)?.playing;
    if plays {
        radio.clock.sleep(before_end);
    }
    radio.link.release(tag).map_err(failed)?;
    match plays {
        true => Ok(true),
        false => Err(Failure::failed(
            format!("{tag} went dark before {:.1} s had passed", limit.as_secs_f64()),
            "the tag's own longest play is shorter: ask for fewer --seconds",
        )),
    }
}

fn pair(args: &Pair) -> Result<bool, Failure> {
    let mut radio = args.robot.open_radio()?;
    let tag = find(&mut radio, &args.id)?;
    let kept = bond(&mut radio, tag, args.passkey)?;
    outln!("paired with {tag}");
    if !kept {
        outln!("  the key is not kept: add bonds = \"tags.bonds\" to [radio] of the configuration");
    }
    Ok(true)
}

fn info(args: &Info) -> Result<bool, Failure> {
    let output = told(ask(args), args.json, json!({}))?;
    match args.json {
        true => crate::output::json(&output)?,
        false => print(&output),
    }
    Ok(true)
}

/// What a tag tells of itself.
fn ask(args: &Info) -> Result<InfoOutput, Failure> {
    let mut radio = args.robot.open_radio()?;
    let tag = find(&mut radio, &args.id)?;
    let told = radio.link.info(tag, TIMEOUT).map_err(failed)?;
    // A record that is not for everybody is no fault of the tag.
    let record = radio.link.read_record(tag, TIMEOUT).ok();
    Ok(InfoOutput {
        address: tag.to_string(),
        manufacturer: told.manufacturer,
        model: told.model,
        firmware: told.firmware,
        battery: told.battery,
        has_record: told.has_record,
        signature: record.map(|bytes| radio.trusted.judge(&bytes).to_string()),
        playing: told.playing,
        rssi: told.rssi,
    })
}

fn print(output: &InfoOutput) {
    outln!("address   {}", output.address);
    outln!("tag       {} {}", Shown(&output.manufacturer), Shown(&output.model));
    outln!("firmware  {}", Shown(&output.firmware));
    outln!("battery   {}", output.battery.map_or("unknown".into(), |b| format!("{b} %")));
    outln!("signal    {}", output.rssi.map_or("unknown".into(), |r| format!("{r} dBm")));
    let record = match (output.has_record, &output.signature) {
        (false, _) => "none".into(),
        (true, Some(signature)) => format!("yes, {signature}"),
        (true, None) => "yes, not for this robot".into(),
    };
    outln!("record    {record}");
    outln!("light     {}", if output.playing { "plays" } else { "dark" });
}

fn key(args: &Key) -> Result<bool, Failure> {
    let public = signing::make_key(&args.file)?;
    outln!("{} signs records (`vergence tag write --sign`); keep it secret", args.file.display());
    outln!("{} goes to the `trusted_keys` of robots", public.display());
    Ok(true)
}

/// Pairs and keeps the bond; true when it outlasts this run.
fn bond(radio: &mut Radio, tag: TagAddress, passkey: Option<u32>) -> Result<bool, Failure> {
    let bond = radio.link.pair(tag, passkey).map_err(|error| {
        Failure::failed(error, "compare the passkey with the one printed on the tag; after a wrong one the tag makes every robot wait")
    })?;
    match bond {
        Some(bond) => radio.keep(&bond),
        None if radio.link.keeps_bonds() => Ok(true),
        None => Err(Failure::failed(
            format!("tag {tag} keeps no key: it will not know this robot again"),
            "pair once more; a tag that never keeps one needs other firmware",
        )),
    }
}

/// The tag of an object id or an address. One id on two tags is an error: one of them is not what
/// it says.
fn find(radio: &mut Radio, id: &str) -> Result<TagAddress, Failure> {
    let heard = radio.link.scan(WINDOW).map_err(failed)?;
    if let Ok(tag) = address(id) {
        return Ok(tag);
    }
    let tags: Vec<TagAddress> =
        heard.iter().filter(|tag| tag.may_be(id)).map(|tag| tag.address).collect();
    match tags[..] {
        [tag] => Ok(tag),
        [] => {
            let names = vergence::names(&heard);
            Err(Failure::failed(
                format!("no tag of \"{id}\" answers on the radio (heard: {names})"),
                "look at `vergence tags`; a tag without a record is named by its address",
            ))
        }
        _ => {
            let all: Vec<String> = tags.iter().map(TagAddress::to_string).collect();
            Err(Failure::failed(
                format!("{} tags say that they are \"{id}\": {}", all.len(), all.join(", ")),
                "name the one that is meant by its address",
            ))
        }
    }
}

/// Six bytes in hexadecimal with colons, as `vergence tags` shows them.
fn address(text: &str) -> Result<TagAddress, String> {
    let bytes: Option<Vec<u8>> = text
        .split(':')
        .map(|byte| (byte.len() == 2).then(|| u8::from_str_radix(byte, 16).ok()).flatten())
        .collect();
    let bytes = bytes.and_then(|bytes| <[u8; 6]>::try_from(bytes).ok());
    bytes.map(TagAddress).ok_or_else(|| "an address looks like C0:12:34:56:78:9A".into())
}

fn read_record(path: &Path) -> Result<Record, Failure> {
    let hint =
        "a record looks like those of `vergence tags --json`, and docs/record.cddl tells all";
    let wrong = |error: String| Failure::misuse(format!("{}: {error}", path.display()), hint);
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let record: Record = match path.extension().is_some_and(|extension| extension == "json") {
        true => serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?,
        false => toml::from_str(&text).map_err(|error| wrong(error.to_string()))?,
    };
    record.validate().map_err(|error| wrong(error.to_string()))?;
    Ok(record)
}

fn encoded(record: &Record, path: &Path) -> Result<Vec<u8>, Failure> {
    let mut bytes = Vec::new();
    let whole = cbor::encode(record, &mut bytes);
    match whole.is_ok() && bytes.len() <= cbor::MAX_BYTES {
        true => Ok(bytes),
        false => Err(Failure::misuse(
            format!("{}: the record has {} bytes", path.display(), bytes.len()),
            format!("a tag holds {}: use fewer vertices", cbor::MAX_BYTES),
        )),
    }
}

fn failed(error: DeviceError) -> Failure {
    let hint = match error {
        DeviceError::Fault { .. } => {
            "when the tag refuses robots that are not paired: `vergence tag pair`, or --passkey"
        }
        _ => "move the robot closer, check the tag's battery and `vergence tags`",
    };
    Failure::failed(error, hint)
}
