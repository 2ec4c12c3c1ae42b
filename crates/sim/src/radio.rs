//! The tags' radio: every tag is the real firmware on virtual Bluetooth, and so is the robot's side.
//!
//! In: where the tags are and their settings. Out: the robot's link, and what every LED plays when.
//! Who hears whom is decided here, a transmission at a time: strength by distance with some fading,
//! silence out of reach, losses by chance. Everything else (advertising, connection events, repeats,
//! lost links) is what `vergence-link` and the firmware make of it.
//!
//! The radio's time is the world's, shifted by the time that the tags were on before the robot came.
//! A tag's own clock is off by some parts per million: that shows in the chips of its light, which
//! drift from the robot's clock, and is left out where it would come to a millisecond once.

use std::io;
use std::net::TcpListener;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_devices::{Clock, TagAddress};
use vergence_firmware::{Access, Config};
use vergence_link::{HciLink, LinkConfig, Plays, RadioConfig, TagServer, VirtualRadio, VirtualTag};
use vergence_tag::cbor::{self, MAX_BYTES};

use crate::camera::Blinker;
use crate::config::{LedSettings, ObjectSettings, SimConfig};
use crate::error::SimError;
use crate::lights::Play;
use crate::noise::{normal, stream};
use crate::placement::TaggedObject;
use crate::scene::Emitter;
use crate::world::{Shared, lock};

/// Received strength at 1 m (dBm), its loss per tenfold distance (dB), and the standard deviation
/// of the fading (dB).
const RSSI_AT_1M: f64 = -52.0;
const RSSI_PER_DECADE: f64 = 20.0;
const FADING: f64 = 2.0;
/// How long the tags were on at least before the robot came (s): they advertise slowly by then.
const AWAKE: f64 = 60.0;

/// All tags on their air.
pub struct Radio {
    radio: VirtualRadio,
    /// The tags on real time, for whoever connects; the ones above then play no part.
    served: Option<TagServer>,
    tags: Vec<VirtualTag>,
    /// Of every tag: seconds of its clock per second of the robot's.
    rates: Vec<f64>,
    /// The radio's time when the robot's clock was zero.
    epoch: Duration,
}

impl Radio {
    /// The tags of these objects, switched on.
    pub fn new(
        settings: &SimConfig,
        objects: &[TaggedObject],
        seed: u64,
    ) -> Result<Self, SimError> {
        let mut rng = stream(seed, "tags", 0);
        let mut tags = Vec::new();
        let mut rates = Vec::new();
        for (object, choices) in objects.iter().zip(&settings.objects) {
            let mut address: [u8; 6] = rng.random();
            address[0] |= 0xC0; // a random static address
            rates.push(1.0 + 1e-6 * settings.led.clock_ppm * normal(&mut rng));
            tags.push(VirtualTag {
                address: TagAddress(address),
                record: encoded(object)?,
                lights: u8::try_from(object.record.landmarks.len()).unwrap_or(u8::MAX),
                battery: rng.random_range(40..=100),
                config: owner(settings, choices),
            });
        }
        let radio = settings.radio;
        let mut rng = stream(seed, "radio", 0);
        let mut config = RadioConfig {
            link: LinkConfig {
                interval: Duration::from_secs_f64(radio.connection_interval),
                ..LinkConfig::default()
            },
            ..RadioConfig::default()
        };
        config.air.seed = rng.random();
        // The robot comes at any time between two advertisements.
        let idle = AWAKE + radio.advertising_interval * rng.random::<f64>();
        let epoch = Duration::from_micros((1e6 * idle) as u64);
        let hearing = hearing(settings, objects, rng);
        let radio = VirtualRadio::new(config, tags.clone(), Duration::ZERO, hearing)
            .map_err(SimError::Radio)?;
        Ok(Radio { radio, served: None, tags, rates, epoch })
    }

    /// Takes the tags to real time and to a TCP listener, where everybody who connects gets a
    /// Bluetooth controller. `now` is the world's time.
    pub fn serve(
        &mut self,
        settings: &SimConfig,
        objects: &[TaggedObject],
        seed: u64,
        listener: TcpListener,
        now: Duration,
    ) -> io::Result<()> {
        let mut rng = stream(seed, "radio", 1);
        let air = vergence_air::AirConfig { seed: rng.random(), ..Default::default() };
        let hearing = hearing(settings, objects, rng);
        let server = TagServer::start(listener, air, self.tags.clone(), now, hearing)?;
        self.served = Some(server);
        self.epoch = Duration::ZERO;
        Ok(())
    }

    /// Lets everything happen up to a time of the robot's clock.
    pub fn advance_to(&self, time: Duration) {
        if self.served.is_none() {
            self.radio.advance_to(time.saturating_add(self.epoch));
        }
    }

    fn log(&self) -> &Plays {
        self.served.as_ref().map_or_else(|| self.radio.plays(), TagServer::plays)
    }

    /// Forgets what ended before a time (s), which no frame can show any more.
    pub fn forget_plays_before(&self, time: f64) {
        let time = Duration::try_from_secs_f64(time).unwrap_or_default();
        self.log().forget_before(time + self.epoch);
    }

    /// What the LEDs of a tag play or played lately, but for what begins after a time (s).
    pub fn plays(&self, tag: usize, until: f64) -> Vec<Play> {
        let rate = self.rates.get(tag).copied().unwrap_or(1.0);
        let epoch = self.epoch.as_secs_f64();
        self.log()
            .of(tag)
            .iter()
            .map(|play| Play {
                begin: play.begin.as_secs_f64() - epoch,
                end: play.end.as_secs_f64() - epoch,
                pattern: play.pattern,
                rate,
            })
            .filter(|play| play.begin <= until)
            .collect()
    }
}

/// Who hears which tag how strongly, a transmission at a time.
fn hearing(
    settings: &SimConfig,
    objects: &[TaggedObject],
    rng: Pcg64Mcg,
) -> impl Fn(usize) -> Option<i8> + Send + 'static {
    let radio = settings.radio;
    let distances: Vec<f64> =
        objects.iter().map(|o| o.base_from_object.translation.vector.norm()).collect();
    let chance = Mutex::new(rng);
    move |tag: usize| {
        let distance = *distances.get(tag)?;
        let mut chance = chance.lock().unwrap_or_else(PoisonError::into_inner);
        let lost = chance.random::<f64>() < radio.loss;
        let fading = FADING * normal(&mut chance);
        if lost || distance > radio.range {
            return None;
        }
        let rssi = RSSI_AT_1M - RSSI_PER_DECADE * distance.max(0.1).log10() + fading;
        Some(rssi.round().clamp(-110.0, 0.0) as i8)
    }
}

/// The record as the tag stores it.
fn encoded(object: &TaggedObject) -> Result<Vec<u8>, SimError> {
    let mut bytes = Vec::new();
    let whole = cbor::encode(&object.record, &mut bytes);
    match whole.is_ok() && bytes.len() <= MAX_BYTES {
        true => Ok(bytes),
        false => Err(SimError::RecordSize {
            id: object.record.object_id.to_string(),
            bytes: bytes.len(),
        }),
    }
}

/// What the owner of a tag chose.
fn owner(settings: &SimConfig, object: &ObjectSettings) -> Config<'static> {
    let time = |seconds: f64| embassy_time::Duration::from_micros((1e6 * seconds) as u64);
    let defaults = Config::default();
    let slow_interval = time(settings.radio.advertising_interval);
    Config {
        model: "simulated tag",
        passkey: object.passkey,
        write_access: match object.passkey {
            Some(_) => Access::Authenticated,
            None => Access::Encrypted,
        },
        longest_play: time(settings.led.longest_play),
        fast_interval: defaults.fast_interval.min(slow_interval),
        slow_interval,
        ..defaults
    }
}

/// The LEDs of a tag with what they play.
pub fn blinkers<'a>(
    object: &'a TaggedObject,
    led: &'a LedSettings,
    plays: &'a [Play],
) -> impl Iterator<Item = Blinker> + 'a {
    object.record.landmarks.iter().enumerate().map(move |(index, site)| {
        let own = plays.iter().filter(|play| usize::from(play.pattern.landmark) == index);
        let emitter = Emitter {
            position: object.landmark(site),
            normal: object.normal(site),
            lobe: led.lobe_exponent,
            diameter: led.diameter,
            flux_px: led.flux_px,
        };
        Blinker { emitter, plays: own.copied().collect() }
    })
}

/// The robot's radio.
pub fn link(world: &Shared) -> HciLink {
    let held = lock(world);
    let clock = RadioClock { world: world.clone(), epoch: held.radio.epoch };
    held.radio.radio.link(Arc::new(clock))
}

/// The world's clock as the radio counts it.
struct RadioClock {
    world: Shared,
    epoch: Duration,
}

impl Clock for RadioClock {
    fn now(&self) -> Duration {
        lock(&self.world).now.saturating_add(self.epoch)
    }

    fn sleep(&self, duration: Duration) {
        lock(&self.world).pass(duration);
    }
}
