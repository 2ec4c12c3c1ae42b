//! The tags' radio on the level of packets: a stand-in for Bluetooth.
//!
//! Tags advertise; a packet is lost with some probability and sent again at the next interval.
//! Commands act when they reach the tag, not when they are sent. A tag that is out of reach is
//! silent, and asking it times out.

use std::time::Duration;

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_devices::{Advertisement, DeviceError, LedCommand, TagAddress, TagLink, TagState};
use vergence_tag::Record;

use crate::camera::Blinker;
use crate::config::{LedSettings, RadioSettings};
use crate::lights::Play;
use crate::noise::{normal, stream};
use crate::placement::TaggedObject;
use crate::scene::Emitter;
use crate::world::{Shared, World, lock};

/// Bytes of a record that one packet carries.
const PAYLOAD: usize = 20;
/// Received strength at 1 m (dBm), and its loss per tenfold distance (dB).
const RSSI_AT_1M: f64 = -52.0;
const RSSI_PER_DECADE: f64 = 20.0;
/// Time between a lost packet and its repetition (s).
const RETRY: f64 = 0.03;

/// A tag.
#[derive(Debug, Clone)]
pub struct Tag {
    /// Address on the radio.
    pub address: TagAddress,
    /// Its record.
    pub record: Record,
    /// The record as it is stored.
    pub bytes: Vec<u8>,
    /// Seconds of its clock per second of the robot's.
    pub rate: f64,
    /// Battery (percent).
    pub battery: u8,
    /// What its LEDs play or played lately.
    pub plays: Vec<Play>,
}

impl Tag {
    /// Drops what no frame can show any more.
    pub fn forget_before(&mut self, time: f64) {
        self.plays.retain(|play| play.end >= time);
    }

    /// The tag's LEDs with what they play up to a time.
    pub fn blinkers(
        &self,
        object: &TaggedObject,
        led: &LedSettings,
        until: f64,
        out: &mut Vec<Blinker>,
    ) {
        for (index, site) in self.record.landmarks.iter().enumerate() {
            let plays = self
                .plays
                .iter()
                .filter(|play| usize::from(play.pattern.landmark) == index && play.begin <= until)
                .copied()
                .collect();
            let emitter = Emitter {
                position: object.landmark(site),
                normal: object.normal(site),
                lobe: led.lobe_exponent,
                diameter: led.diameter,
                flux_px: led.flux_px,
            };
            out.push(Blinker { emitter, plays });
        }
    }

    fn obey(&mut self, command: LedCommand, now: f64, longest: f64) -> TagState {
        for play in &mut self.plays {
            play.end = play.end.min(now);
        }
        if let LedCommand::Play(pattern) = command {
            let whole = pattern.repeats.map_or(f64::INFINITY, |repeats| {
                f64::from(repeats) * pattern.period().as_secs_f64() / self.rate
            });
            let end = now + whole.min(longest / self.rate);
            self.plays.push(Play { begin: now, end, pattern, rate: self.rate });
        }
        let playing = self.plays.iter().any(|play| play.end > now);
        TagState { playing, battery: Some(self.battery) }
    }
}

/// Randomness of the radio.
#[derive(Debug)]
pub struct Air {
    rng: Pcg64Mcg,
}

impl Air {
    /// The air of a seed.
    pub fn new(seed: u64) -> Self {
        Air { rng: stream(seed, "radio", 0) }
    }

    fn lost(&mut self, radio: &RadioSettings) -> bool {
        self.rng.random::<f64>() < radio.loss
    }

    /// Time until a packet has arrived, repetitions included (s).
    fn delivery(&mut self, radio: &RadioSettings) -> f64 {
        let mut time = radio.latency + radio.jitter * self.rng.random_range(-1.0..=1.0);
        while self.lost(radio) {
            time += RETRY;
        }
        time
    }
}

/// The robot's radio.
pub struct SimRadio {
    world: Shared,
}

impl SimRadio {
    pub(crate) fn new(world: Shared) -> Self {
        SimRadio { world }
    }
}

/// Index of a tag that can be reached.
fn reach(world: &World, address: TagAddress) -> Option<usize> {
    let index = world.tags.iter().position(|tag| tag.address == address)?;
    let distance = world.objects.get(index)?.base_from_object.translation.vector.norm();
    (distance <= world.settings.radio.range).then_some(index)
}

/// Lets the radio work for some time; an error when it takes longer than allowed.
fn spend(
    world: &mut World,
    time: f64,
    deadline: f64,
    timeout: Duration,
) -> Result<(), DeviceError> {
    let end = world.seconds() + time;
    world.advance_to(Duration::from_secs_f64(end.min(deadline)));
    match end <= deadline {
        true => Ok(()),
        false => Err(DeviceError::Timeout { device: "tag radio".into(), timeout }),
    }
}

impl TagLink for SimRadio {
    fn scan(&mut self, window: Duration) -> Result<Vec<Advertisement>, DeviceError> {
        let mut world = lock(&self.world);
        let world = &mut *world;
        let radio = world.settings.radio;
        let packets = (window.as_secs_f64() / radio.advertising_interval).floor() as usize;
        let mut heard = Vec::new();
        for (tag, object) in world.tags.iter().zip(&world.objects) {
            let distance = object.base_from_object.translation.vector.norm().max(0.1);
            let arrived = (0..packets).filter(|_| !world.air.lost(&radio)).count();
            let fading = 2.0 * normal(&mut world.air.rng);
            if arrived == 0 || distance > radio.range {
                continue;
            }
            let rssi = RSSI_AT_1M - RSSI_PER_DECADE * distance.log10() + fading;
            heard.push(Advertisement {
                address: tag.address,
                object_id: tag.record.object_id.to_string(),
                rssi: rssi.round().clamp(-110.0, 0.0) as i8,
                battery: Some(tag.battery),
            });
        }
        world.pass(window);
        heard.sort_by(|a, b| b.rssi.cmp(&a.rssi).then(a.address.cmp(&b.address)));
        Ok(heard)
    }

    fn read_record(&mut self, tag: TagAddress, timeout: Duration) -> Result<Vec<u8>, DeviceError> {
        let mut world = lock(&self.world);
        let deadline = world.seconds() + timeout.as_secs_f64();
        let Some(index) = reach(&world, tag) else {
            spend(&mut world, f64::INFINITY, deadline, timeout)?;
            return Ok(Vec::new());
        };
        let packets = world.tags[index].bytes.len().div_ceil(PAYLOAD);
        for _ in 0..packets.max(1) {
            let radio = world.settings.radio;
            let time = world.air.delivery(&radio);
            spend(&mut world, time, deadline, timeout)?;
        }
        Ok(world.tags[index].bytes.clone())
    }

    fn command(
        &mut self,
        tag: TagAddress,
        command: LedCommand,
        timeout: Duration,
    ) -> Result<TagState, DeviceError> {
        let mut world = lock(&self.world);
        let deadline = world.seconds() + timeout.as_secs_f64();
        let Some(index) = reach(&world, tag) else {
            spend(&mut world, f64::INFINITY, deadline, timeout)?;
            return Ok(TagState { playing: false, battery: None });
        };
        if let LedCommand::Play(pattern) = command {
            let lights = world.tags[index].record.landmarks.len();
            if usize::from(pattern.landmark) >= lights {
                let what = format!("has no light {}, only {lights}", pattern.landmark);
                return Err(DeviceError::Unsupported { device: format!("tag {tag}"), what });
            }
        }
        let radio = world.settings.radio;
        let out = world.air.delivery(&radio);
        spend(&mut world, out, deadline, timeout)?;
        let (now, longest) = (world.seconds(), world.settings.led.longest_play);
        let state = world.tags[index].obey(command, now, longest);
        let back = world.air.delivery(&radio);
        spend(&mut world, back, deadline, timeout)?;
        Ok(state)
    }
}
