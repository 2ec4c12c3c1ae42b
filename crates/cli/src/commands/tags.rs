//! `vergence tags`: who answers on the radio, and what the records say.

use std::time::Duration;

use clap::Args;
use serde::Serialize;
use serde_json::json;
use vergence_tag::{Record, Shown};

use crate::failure::Failure;
use crate::output::{outln, told};
use crate::radio::Radio;
use crate::robot::RobotArgs;

/// List the tags in radio range with their records.
#[derive(Args)]
pub struct Tags {
    #[command(flatten)]
    robot: RobotArgs,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// How long the radio listens: idle tags advertise about once a second.
const WINDOW: Duration = Duration::from_millis(2500);
/// Longest wait for one record.
const TIMEOUT: Duration = Duration::from_secs(2);

#[derive(Serialize)]
struct Output {
    tags: Vec<Tag>,
}

#[derive(Serialize)]
struct Tag {
    id: String,
    address: String,
    rssi: i8,
    battery: Option<u8>,
    record: Option<Record>,
    /// What the record's signature says.
    #[serde(skip_serializing_if = "Option::is_none")]
    signature: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// Runs the command.
pub fn run(args: &Tags) -> Result<bool, Failure> {
    let tags = told(listen(args), args.json, json!({ "tags": [] }))?;
    let found = !tags.is_empty();
    match args.json {
        true => crate::output::json(&Output { tags })?,
        false => print(&tags),
    }
    Ok(found)
}

/// Who answers.
fn listen(args: &Tags) -> Result<Vec<Tag>, Failure> {
    let Radio { link: mut radio, trusted, .. } = args.robot.open_radio()?;
    let hint = "check the radio's driver in the configuration";
    let heard = radio.scan(WINDOW).map_err(|error| Failure::failed(error, hint))?;
    let tags = heard
        .into_iter()
        .map(|tag| {
            let bytes = radio.read_record(tag.address, TIMEOUT).map_err(|error| error.to_string());
            let signature = bytes.as_ref().ok().map(|bytes| trusted.judge(bytes).to_string());
            let record = bytes.and_then(|bytes| {
                vergence_tag::cbor::decode(&bytes).map_err(|error| error.to_string())
            });
            let error = record.as_ref().err().cloned();
            let (id, address) = (tag.object_id, tag.address.to_string());
            let (rssi, battery) = (tag.rssi, tag.battery);
            Tag { id, address, rssi, battery, record: record.ok(), signature, error }
        })
        .collect();
    Ok(tags)
}

fn print(tags: &[Tag]) {
    if tags.is_empty() {
        outln!("no tag answers within radio range");
        outln!("  what to do: move the robot closer, check the tags' batteries");
        return;
    }
    outln!("{:<12} {:>5} {:>8}  {:<18} object", "id", "dBm", "battery", "address");
    for tag in tags {
        let battery = tag.battery.map_or("?".into(), |percent| format!("{percent} %"));
        let object = match (&tag.record, &tag.error) {
            (Some(record), _) => {
                let [w, l, h] = record.bounding_box.sides().map(|side| 1e3 * side);
                let weight = record.physical.weight;
                let weight = weight.map_or(String::new(), |kg| format!(", {:.0} g", 1e3 * kg));
                let signature = match tag.signature.as_deref() {
                    None | Some("not signed") => String::new(),
                    Some(verdict) => format!(", {verdict}"),
                };
                format!("{} {w:.0} x {l:.0} x {h:.0} mm{weight}{signature}", record.semantic.name)
            }
            (None, error) => error.clone().unwrap_or_default(),
        };
        let id = Shown(&tag.id).to_string();
        outln!("{id:<12} {:>5} {battery:>8}  {:<18} {object}", tag.rssi, tag.address);
    }
}
