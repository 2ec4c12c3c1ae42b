//! What self-calibration is fed with: the blinking light at several places, each seen by both heads from
//! many angles.
//!
//! In: a robot, a tag's object and a [`LightMover`] that moves the light from place to place. Out: a
//! [`Session`] for [`vergence_head::calibrate`]. At each place the heads search the light as a find
//! does, then look around it, so that it crosses the whole picture while all four joints turn; every
//! move ends upwards in both joints, against backlash. The light tells which bright spot is meant:
//! nothing else in the picture has to be known, and nothing but angles and pixels is taken.

use std::time::Duration;

use nalgebra::{Point2, Point3};
use vergence_devices::{DeviceError, JointReading, LedCommand, TagAddress};
use vergence_head::calibration::{KnownLength, LightPlace};
use vergence_head::{Fixation, FixatorConfig, PanTiltHead, run_up};
use vergence_landmark::Sighting;
use vergence_tag::Pattern;

use super::centre::fixation;
use super::{FindConfig, Run, Stop};
use crate::event::Observer;
use crate::system::System;

/// The light plays at least so long after a command; tags go dark by themselves some time after.
const LIGHT_LASTS: Duration = Duration::from_secs(8);
/// Part of the picture's half width and height over which the light is spread.
const SPREAD: f64 = 0.7;
/// Sightings further (px) from where the description expects them are mirror images: a description
/// that is off by 10 % of focal length and 3 degrees of roll misses by half of this.
const GATE_PX: f64 = 40.0;
/// A place that either head saw from fewer of the angles than this part is not taken.
const LEAST_SEEN: f64 = 0.5;

/// Where the light is now, as far as something other than the heads knows.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Placed {
    /// Its position in base and the sigma of each coordinate (m), when an arm holds it.
    pub known: Option<(Point3<f64>, f64)>,
    /// How far it is from the place before and the sigma of that (m), when a ruler was used.
    pub from_previous: Option<(f64, f64)>,
}

/// Whoever moves the light: a person, an arm, the simulator.
pub trait LightMover {
    /// Brings the light to its next place and lets it rest there; `None` when there are no more.
    fn next_place(&mut self) -> Result<Option<Placed>, DeviceError>;
}

/// How much is looked at.
#[derive(Debug, Clone, PartialEq)]
pub struct CollectConfig {
    /// Angles from which each head looks at each place. Sixteen spread the light over the picture; each
    /// takes about a second.
    pub views: usize,
    /// The search and the radio, as in a find.
    pub find: FindConfig,
}

impl Default for CollectConfig {
    fn default() -> Self {
        CollectConfig { views: 16, find: FindConfig::default() }
    }
}

/// What was seen.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Session {
    /// The light's places.
    pub places: Vec<LightPlace>,
    /// Known distances between them.
    pub lengths: Vec<KnownLength>,
    /// Looks that did not show the light.
    pub missed: usize,
}

/// Why the light could not be collected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{reason}")]
pub struct CollectError {
    /// What happened.
    pub reason: String,
    /// What a person can do about it.
    pub hint: &'static str,
}

impl From<Stop> for CollectError {
    fn from(stop: Stop) -> Self {
        CollectError { reason: stop.to_string(), hint: stop.hint() }
    }
}

/// Looks at the light wherever it is put. The light is told to stop in any case.
pub fn collect(
    system: &mut System,
    object: &str,
    mover: &mut dyn LightMover,
    config: &CollectConfig,
    observer: &mut dyn Observer,
) -> Result<Session, CollectError> {
    let mut run = Run::new(system, &config.find, observer);
    let tag = run.step("radio", |run| run.radio(object))?.address;
    let mut session = Session::default();
    let outcome = run.places(tag, mover, config.views, &mut session);
    let stopped = run.step("stop", |run| run.command(tag, LedCommand::Stop));
    outcome?;
    stopped?;
    Ok(session)
}

impl Run<'_> {
    fn places(
        &mut self,
        tag: TagAddress,
        mover: &mut dyn LightMover,
        views: usize,
        session: &mut Session,
    ) -> Result<(), Stop> {
        while let Some(placed) = mover.next_place()? {
            let pattern = self.step("blink", |run| run.start_blinking(tag, 0))?;
            let looked = self.step("look around", |run| run.look_until_seen(tag, &pattern, views));
            let place = match looked {
                // One place out of sight, or beside a mirror, does not undo the others.
                Err(Stop::NotSeen { .. } | Stop::Lost(_)) if !session.places.is_empty() => {
                    LightPlace::default()
                }
                looked => LightPlace { known: placed.known, ..looked? },
            };
            let index = session.places.len();
            session.missed += place.fixations.iter().map(|seen| views - seen.len()).sum::<usize>();
            session.places.push(place);
            if let (Some((length, sigma)), Some(before)) =
                (placed.from_previous, index.checked_sub(1))
            {
                session.lengths.push(KnownLength { places: [before, index], length, sigma });
            }
        }
        Ok(())
    }

    /// A light that was lost or seen by one head only is searched again, as in a find.
    fn look_until_seen(
        &mut self,
        tag: TagAddress,
        pattern: &Pattern,
        views: usize,
    ) -> Result<LightPlace, Stop> {
        let mut tries = 1;
        loop {
            match self.look_around(tag, pattern, views) {
                Err(Stop::NotSeen { .. } | Stop::Lost(_)) if tries < self.config.search_tries => {
                    tries += 1;
                    // A search may take as long as the tag plays.
                    self.command(tag, LedCommand::Play(*pattern))?;
                }
                outcome => return outcome,
            }
        }
    }

    /// Finds the light at its place and looks at it from `views` angles.
    fn look_around(
        &mut self,
        tag: TagAddress,
        pattern: &Pattern,
        views: usize,
    ) -> Result<LightPlace, Stop> {
        let seen = self.search(pattern)?;
        let first = [0, 1].map(|k| fixation(&seen[k].joints, &seen[k].sightings[0]));
        let heads = self.system.heads.clone();
        let centres = [0, 1].map(|k| heads[k].aim(first[k].angles, &first[k].pixel, None));
        let mut place = LightPlace::default();
        let mut lit = self.system.robot.clock.now();
        for view in 0..views {
            if self.system.robot.clock.now() > lit + LIGHT_LASTS {
                self.command(tag, LedCommand::Play(*pattern))?;
                lit = self.system.robot.clock.now();
            }
            let goals = [0, 1].map(|k| {
                let reach = reach(&heads[k]);
                // Different angles for the heads, spread evenly for every count.
                let at = [2, 3].map(|base| 2.0 * radical_inverse(view + 1 + k * views, base) - 1.0);
                heads[k].clamp([0, 1].map(|j| centres[k][j] + reach[j] * at[j]))
            });
            let joints = self.arrive(goals)?;
            let sightings = self.watch(pattern, joints.map(Some))?;
            for (k, found) in sightings.into_iter().enumerate() {
                let ray = heads[k].ray(first[k].angles, &first[k].pixel);
                let expected = heads[k].project([joints[k].pan, joints[k].tilt], &ray.at(1.0));
                if let Some(sighting) = expected.and_then(|pixel| nearest(found, &pixel)) {
                    // As a find corrects its angles, so that the joints' zeros fit it.
                    let angles = self.camera_angles(k, &joints[k]);
                    let seen = fixation(&joints[k], &sighting);
                    place.fixations[k].push(Fixation { angles, ..seen });
                }
            }
        }
        let least = (LEAST_SEEN * views as f64) as usize;
        match (0..2).find(|&k| place.fixations[k].len() < least) {
            Some(k) => Err(Stop::Lost(vergence_devices::Side::BOTH[k].name())),
            None => Ok(place),
        }
    }

    /// Turns both heads to their goals, so that every joint arrives from below.
    fn arrive(&mut self, goals: [[f64; 2]; 2]) -> Result<[JointReading; 2], Stop> {
        let now = self.system.joints()?.map(|j| [j.pan, j.tilt]);
        let via = [0, 1].map(|k| {
            let servos = &self.system.robot.heads[k].pan_tilt;
            let config = FixatorConfig {
                resolution: servos.resolution(),
                backlash: servos.backlash(),
                ..FixatorConfig::default()
            };
            run_up(&self.system.heads[k], now[k], goals[k], &config)
        });
        if via != [None, None] {
            self.system.turn(via)?;
        }
        Ok(self.system.turn(goals.map(Some))?)
    }
}

/// How far pan and tilt may turn from the light (rad) with the light still well in the picture.
fn reach(head: &PanTiltHead) -> [f64; 2] {
    let camera = &head.camera;
    [
        SPREAD * (0.5 * camera.width as f64 / camera.fx).atan(),
        SPREAD * (0.5 * camera.height as f64 / camera.fy).atan(),
    ]
}

fn nearest(found: Vec<Sighting>, expected: &Point2<f64>) -> Option<Sighting> {
    let off = |s: &Sighting| (s.pixel - expected).norm();
    found.into_iter().filter(|s| off(s) < GATE_PX).min_by(|a, b| off(a).total_cmp(&off(b)))
}

/// The digits of a number mirrored at the point (van der Corput): spreads evenly in 0 to 1.
fn radical_inverse(mut number: usize, base: usize) -> f64 {
    let (mut value, mut weight) = (0.0, 1.0 / base as f64);
    while number > 0 {
        value += weight * (number % base) as f64;
        weight /= base as f64;
        number /= base;
    }
    value
}
