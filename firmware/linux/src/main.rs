//! `vergence-tagd`: makes a real smart tag of any Linux board with Bluetooth and an LED.
//!
//! In: a settings file (see [`settings`]). It runs the firmware core on the board's Bluetooth
//! controller, drives infrared LEDs, and keeps record, bonds and address in a file. It runs until its
//! controller fails (status 1: the service manager starts it again) or until it is told to end
//! (SIGTERM, SIGINT), and leaves the lights dark.

mod flash;
mod guardian;
mod lights;
mod settings;

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use bt_hci::controller::ExternalController;
use bt_hci::transport::Transport;
use clap::Parser;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use vergence_air::{Executor, StreamTransport, TransportError};
use vergence_firmware::{Board, Store};
use vergence_link::HeapPool;
use vergence_tag::cbor::{self, MAX_BYTES};
use vergence_tag::{Record, Text};

use crate::flash::FileFlash;
use crate::guardian::{Guardian, PowerSupply};
use crate::lights::BoardLights;
use crate::settings::{ControllerAt, Settings};

/// HCI commands under way at once.
const COMMANDS: usize = 10;

/// Makes a smart tag of this board.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// The settings (TOML).
    settings: PathBuf,
    /// Record (TOML, or JSON when the name ends in .json) for a tag that holds none yet.
    #[arg(long)]
    record: Option<PathBuf>,
}

/// What ends the process.
type Failure = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let Err(error) = run(&Arguments::parse());
    eprintln!("vergence-tagd: {error}");
    ExitCode::FAILURE
}

fn run(arguments: &Arguments) -> Result<Infallible, Failure> {
    let settings = Settings::read(&arguments.settings)?;
    let flash = FileFlash::open(&settings.store)
        .map_err(|error| format!("{}: {error}", settings.store.display()))?;
    let config = settings.firmware(flash.address());
    let range = flash.range();
    let mut store = Store::new(flash, range)?;
    let executor = Executor::new();
    let record = executor.block_on(provide(&mut store, arguments.record.as_deref()))??;

    let lights = BoardLights::open(&settings.lights)?;
    let [a, b, c, d, e, f] = config.address;
    let holds = record.map_or("no record".into(), |id| format!("the record of \"{id}\""));
    let hello = format!("tag {f:02X}:{e:02X}:{d:02X}:{c:02X}:{b:02X}:{a:02X} holds {holds}");
    let mut tag = TagProcess { executor, config, store, lights, settings: &settings, hello };
    match &settings.controller {
        ControllerAt::Linux { linux } => {
            tag.serve(StreamTransport::user_channel(*linux).map_err(|error| {
                format!("hci{linux}: {error} (CAP_NET_ADMIN, powered off, bluetoothd stopped?)")
            })?)
        }
        ControllerAt::Serial { serial, baud } => tag.serve(
            StreamTransport::serial(serial, *baud)
                .map_err(|error| format!("{}: {error}", serial.display()))?,
        ),
        ControllerAt::Tcp { tcp } => {
            tag.serve(StreamTransport::connect(tcp).map_err(|error| format!("{tcp}: {error}"))?)
        }
    }
}

/// Everything that a tag is, but for its controller.
struct TagProcess<'a> {
    executor: Executor,
    config: vergence_firmware::Config<'static>,
    store: Store<FileFlash>,
    lights: BoardLights,
    settings: &'a Settings,
    /// What it says when it is up.
    hello: String,
}

impl TagProcess<'_> {
    /// Runs the firmware until the controller fails.
    fn serve<T>(&mut self, transport: T) -> Result<Infallible, Failure>
    where
        T: Transport<Error = TransportError>,
    {
        let controller: ExternalController<T, COMMANDS> = ExternalController::new(transport);
        // Not before the controller is there: a watchdog device that was started resets the board, and
        // one that waits for its controller would be reset for ever.
        let guardian = Guardian::start(self.settings.watchdog.as_deref())?;
        end_in_the_dark(self.lights.clone(), guardian.clone())?;
        let mut board = Board {
            lights: self.lights.clone(),
            battery: PowerSupply::new(self.settings.battery.as_deref()),
            watchdog: guardian.clone(),
        };
        eprintln!("{}", self.hello);
        guardian.ready();
        let stopped = self.executor.block_on(vergence_firmware::run::<_, HeapPool, _, _, _, _>(
            controller,
            &self.config,
            &mut self.store,
            &mut board,
        ));
        self.lights.darken();
        // The service manager starts the tag again; the board has done nothing wrong.
        guardian.dismiss();
        stopped?.map_err(|stopped| format!("the controller failed: {:?}", stopped.0).into())
    }
}

/// The object id of the stored record, after an empty tag was given `initial`.
async fn provide(
    store: &mut Store<FileFlash>,
    initial: Option<&Path>,
) -> Result<Option<Text>, Failure> {
    let mut bytes = [0; MAX_BYTES];
    let stored = store.record(&mut bytes).await?;
    if let (None, Some(path)) = (stored, initial) {
        let record = read_record(path).map_err(|error| format!("{}: {error}", path.display()))?;
        let mut bytes = Vec::new();
        cbor::encode(&record, &mut bytes)?;
        store.set_record(&bytes).await?;
        return Ok(Some(record.object_id));
    }
    let stored = stored.and_then(|length| bytes.get(..length));
    // A record that cannot be read is not served either; the tag waits for a new one.
    Ok(stored.and_then(|bytes| cbor::decode(bytes).ok()).map(|record| record.object_id))
}

fn read_record(path: &Path) -> Result<Record, Failure> {
    let text = std::fs::read_to_string(path)?;
    let record: Record = match path.extension().is_some_and(|extension| extension == "json") {
        true => serde_json::from_str(&text)?,
        false => toml::from_str(&text)?,
    };
    record.validate()?;
    Ok(record)
}

/// Switches the lights off and disarms the watchdog when the process is told to end.
fn end_in_the_dark(lights: BoardLights, guardian: Guardian) -> Result<(), Failure> {
    let mut signals = Signals::new([SIGTERM, SIGINT])?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        if signals.forever().next().is_some() {
            lights.darken();
            guardian.dismiss();
            std::process::exit(0);
        }
    })?;
    Ok(())
}
