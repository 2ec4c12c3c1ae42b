//! The watchdog and the battery of a Linux board.
//!
//! The firmware says every few seconds that all is well. A thread passes that on to whoever resets
//! the tag when it falls silent: systemd (`WatchdogSec=`), a watchdog device, and, as neither may be
//! there, the thread itself, which aborts the process.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use vergence_firmware::{Battery, Watchdog};

/// A firmware that was silent for this long hangs: it feeds every 8 s.
const PATIENCE: Duration = Duration::from_secs(30);
/// How often the word is passed on: often enough for a device of 10 s.
const ROUND: Duration = Duration::from_secs(2);

/// What the firmware feeds, and what is behind it.
#[derive(Clone)]
pub struct Guardian(Arc<Mutex<State>>);

struct State {
    fed: Instant,
    device: Option<File>,
    systemd: Option<Notify>,
}

impl Guardian {
    /// Opens the watchdog device, which starts it, and starts the thread.
    pub fn start(device: Option<&Path>) -> io::Result<Self> {
        let open = |path: &Path| File::options().write(true).open(path);
        let device = device.map(open).transpose()?;
        let state = State { fed: Instant::now(), device, systemd: Notify::from_environment() };
        let guardian = Guardian(Arc::new(Mutex::new(state)));
        let own = guardian.clone();
        std::thread::Builder::new().name("watchdog".into()).spawn(move || {
            loop {
                own.round();
                std::thread::sleep(ROUND);
            }
        })?;
        Ok(guardian)
    }

    /// Tells systemd that the tag is up.
    pub fn ready(&self) {
        if let Some(systemd) = &self.lock().systemd {
            systemd.tell("READY=1");
        }
    }

    /// Disarms the device, for an orderly end: "V" is the word of the kernel's watchdog interface.
    pub fn dismiss(&self) {
        // Closed under the lock: another word of the thread's would take this one back.
        if let Some(mut device) = self.lock().device.take() {
            let _ = device.write_all(b"V");
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn round(&self) {
        let mut state = self.lock();
        if state.fed.elapsed() > PATIENCE {
            eprintln!("vergence-tagd: the firmware hangs");
            std::process::abort();
        }
        if let Some(device) = &mut state.device {
            // A device that cannot be written resets the board, which is what it is for.
            let _ = device.write_all(b"\0");
        }
        if let Some(systemd) = &state.systemd {
            systemd.tell("WATCHDOG=1");
        }
    }
}

impl Watchdog for Guardian {
    fn feed(&mut self) {
        self.lock().fed = Instant::now();
    }
}

/// systemd's notification socket (`man 3 sd_notify`).
struct Notify {
    socket: UnixDatagram,
    to: SocketAddr,
}

impl Notify {
    fn from_environment() -> Option<Self> {
        let name = std::env::var("NOTIFY_SOCKET").ok()?;
        let to = match name.strip_prefix('@') {
            Some(name) => SocketAddr::from_abstract_name(name).ok()?,
            None => SocketAddr::from_pathname(name).ok()?,
        };
        Some(Notify { socket: UnixDatagram::unbound().ok()?, to })
    }

    fn tell(&self, word: &str) {
        // A manager that is gone cannot be told.
        let _ = self.socket.send_to_addr(word.as_bytes(), &self.to);
    }
}

/// A battery of the kernel's power supply class, or none.
pub struct PowerSupply(Option<PathBuf>);

impl PowerSupply {
    /// By its name in `/sys/class/power_supply`, or by path.
    pub fn new(name: Option<&Path>) -> Self {
        PowerSupply(name.map(|name| Path::new("/sys/class/power_supply").join(name)))
    }
}

impl Battery for PowerSupply {
    fn level(&mut self) -> Option<u8> {
        let text = fs::read_to_string(self.0.as_ref()?.join("capacity")).ok()?;
        text.trim().parse().ok().filter(|percent| *percent <= 100)
    }
}
