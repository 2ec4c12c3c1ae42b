//! Find: the nine steps of the paper (section 2), one function each, over device traits only.
//!
//! ```text
//! radio -> record -> blink -> search -> centre -> triangulate -> look -> recognise
//! ```
//!
//! In: an object's name. Out: a [`Report`]; it is complete also when the search ends early, and
//! then says why and what to do. Devices that fail end the run; the LED is told to stop in any case.

use std::time::Duration;

use vergence_devices::{Advertisement, DeviceError, LedCommand, Side, TagAddress};
use vergence_geometry::{GaussianPoint, Symmetry, Transform};
use vergence_head::ReaimConfig;
use vergence_imaging::Frame;
use vergence_landmark::FinderError;
use vergence_pose::{ObjectPose, Query, Refusal, View};
use vergence_tag::signature::Verdict;
use vergence_tag::{Pattern, Record, RecordError, Shown};

use crate::event::{Event, Observer};
use crate::report::{AlternativeReport, LandmarkReport, PoseReport, Report, Step, numbers};
use crate::system::System;

mod blink;
mod centre;
mod collect;
pub(crate) mod reaim;
pub(crate) mod search;

pub use collect::{CollectConfig, CollectError, LightMover, Placed, Session, collect};

/// Which recognition is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// As published in 2005: on/off differences, box template, distance transform, correlation.
    Paper,
    /// Sequential decision on coded light, directional distance fields, joint refinement.
    #[default]
    Directional,
}

/// Most of a frame interval between the two pictures of a pair: half of it without a common trigger, and
/// a little for uneven stamps.
const PAIRED: f64 = 0.7;

/// Settings of a find.
#[derive(Debug, Clone, PartialEq)]
pub struct FindConfig {
    /// Which recognition is used.
    pub method: Method,
    /// How long the radio listens for tags: a few advertising intervals of an idle tag (1 s each).
    pub scan_window: Duration,
    /// Longest wait for one answer of a tag: links come up within half a second, with retries.
    pub link_timeout: Duration,
    /// Times that a command or read is tried before the tag counts as lost.
    pub link_tries: usize,
    /// Searches that are started when a light turned out not to be the tag's.
    pub search_tries: usize,
    /// When the heads stop aiming again to see through the encoders' steps; the paper's method never
    /// begins.
    pub reaim: ReaimConfig,
    /// Seed for the choice of patterns. Whoever knows it knows what a tag will be told to blink: with
    /// real tags, draw it from the operating system's randomness.
    pub seed: u64,
}

impl Default for FindConfig {
    fn default() -> Self {
        FindConfig {
            method: Method::default(),
            scan_window: Duration::from_millis(2500),
            link_timeout: Duration::from_secs(2),
            link_tries: 3,
            search_tries: 3,
            reaim: ReaimConfig::default(),
            seed: 0,
        }
    }
}

/// Who was heard on the radio, for messages: the names come from the air.
pub fn names(heard: &[Advertisement]) -> String {
    let names: Vec<String> = heard.iter().map(|tag| Shown(&tag.object_id).to_string()).collect();
    if names.is_empty() { "nobody".into() } else { names.join(", ") }
}

/// Why a find ended without a pose.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Stop {
    #[error("no tag of \"{object}\" answers on the radio (heard: {heard})")]
    OutOfRange { object: String, heard: String },
    #[error("{count} tags claim to be \"{object}\"")]
    Ambiguous { object: String, count: usize },
    #[error("the tag's record is not usable: {0}")]
    Record(#[from] RecordError),
    #[error("the tag's record is refused: {0}")]
    Signature(Verdict),
    #[error("the tag advertises \"{advertised}\" but its record says \"{recorded}\"")]
    WrongRecord { advertised: String, recorded: String },
    #[error("the tag answers, but its light was not seen in {views} views by {missing}")]
    NotSeen { views: usize, missing: Missing },
    #[error("the light that the {0} head saw was lost or did not obey when it was centred")]
    Lost(&'static str),
    #[error("the two heads do not see one and the same light: {0}")]
    Triangulation(#[from] vergence_head::TriangulateError),
    #[error("the {0} camera's pictures were refused: {1}")]
    Frames(&'static str, FinderError),
    #[error("{0}")]
    Refused(#[from] Refusal),
    #[error("{0}")]
    Device(#[from] DeviceError),
}

/// Who did not see the light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Missing {
    /// Neither head did.
    Either,
    /// One did not while the other did.
    One(Side),
}

impl std::fmt::Display for Missing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Missing::Either => f.write_str("either head"),
            Missing::One(side) => write!(f, "the {} head", side.name()),
        }
    }
}

impl Stop {
    /// What a person can do about it.
    pub(crate) fn hint(&self) -> &'static str {
        match self {
            Stop::OutOfRange { .. } => {
                "move the robot closer, check the tag's battery and the spelling; `vergence tags` lists who answers"
            }
            Stop::Ambiguous { .. } => "switch one of the tags off, or write another id to it",
            Stop::Record(_) | Stop::WrongRecord { .. } => {
                "write a correct record to the tag; `vergence tags` lists what each one is"
            }
            Stop::Signature(_) => {
                "this robot wants records that are signed by a key of `trusted_keys`: `vergence tag write --sign`"
            }
            Stop::NotSeen { .. } => {
                "turn the object so that its landmark faces the cameras, or remove what hides it"
            }
            Stop::Lost(_) => {
                "keep the object still while it is being found; something else may blink like the tag"
            }
            Stop::Triangulation(_) => {
                "look for mirrors near the object; if it happens everywhere, calibrate the heads"
            }
            Stop::Frames(..) => "check the camera's format and its time stamps",
            Stop::Refused(_) => {
                "free the view of the object, add light, or check the record's size and shape"
            }
            Stop::Device(_) => "check cables, power and the configuration file",
        }
    }
}

/// Finds an object and recognises its pose.
pub fn find(
    system: &mut System,
    object: &str,
    config: &FindConfig,
    observer: &mut dyn Observer,
) -> Report {
    let mut run = Run::new(system, config, observer);
    let outcome = run.all(object);
    describe(object, run, outcome.as_ref())
}

/// What a find gives to whoever acts on it.
#[derive(Debug, Clone)]
pub(crate) struct Found {
    /// The pose and how sure it is.
    pub(crate) object: ObjectPose,
    /// The landmark (base).
    pub(crate) landmark: GaussianPoint,
    /// What the tag tells.
    pub(crate) record: Record,
    /// Whom to ask for light again.
    pub(crate) tag: TagAddress,
}

/// The report of a run that is over.
pub(crate) fn describe(object: &str, run: Run<'_>, outcome: Result<&Found, &Stop>) -> Report {
    let mut report = Report {
        object_id: object.into(),
        found: outcome.is_ok(),
        reason: None,
        hint: None,
        landmark: run.landmark,
        pose: None,
        confidence: None,
        symmetry: Symmetry::none(),
        alternatives: Vec::new(),
        grasp: None,
        timeline: run.timeline,
        truth: None,
    };
    match outcome {
        Ok(found) => {
            let object = &found.object;
            report.pose = Some(PoseReport::new(&object.pose));
            report.confidence = Some(object.confidence);
            report.symmetry = object.symmetry.clone();
            report.alternatives = object.alternatives.iter().map(alternative).collect();
        }
        Err(stop) => {
            report.reason = Some(stop.to_string());
            report.hint = Some(stop.hint());
        }
    }
    report
}

fn alternative(other: &vergence_pose::Alternative) -> AlternativeReport {
    let (position, orientation) = numbers(&other.pose);
    AlternativeReport { position, orientation, confidence: other.confidence }
}

/// One run: what the steps share.
pub(crate) struct Run<'a> {
    pub(crate) system: &'a mut System,
    config: &'a FindConfig,
    pub(crate) observer: &'a mut dyn Observer,
    timeline: Vec<Step>,
    pub(crate) landmark: Option<LandmarkReport>,
    /// Who answered on the radio.
    pub(crate) heard: Vec<Advertisement>,
    /// Time between two pictures, known when the tag blinks.
    interval: Duration,
    /// Standard deviation of the joints' zeros (rad) that positions are as uncertain by.
    pub(crate) zero_sd: f64,
}

impl<'a> Run<'a> {
    /// A run in which nothing has happened yet.
    pub(crate) fn new(
        system: &'a mut System,
        config: &'a FindConfig,
        observer: &'a mut dyn Observer,
    ) -> Self {
        let zero_sd = system.zero_sd;
        Run {
            system,
            config,
            observer,
            timeline: Vec::new(),
            landmark: None,
            heard: Vec::new(),
            interval: Duration::ZERO,
            zero_sd,
        }
    }
}

impl Run<'_> {
    /// All steps of a find.
    pub(crate) fn all(&mut self, object: &str) -> Result<Found, Stop> {
        let tag = self.step("radio", |run| run.radio(object))?;
        let record = self.step("record", |run| run.record(&tag, object))?;
        let pattern = self.step("blink", |run| run.start_blinking(tag.address, 0))?;
        let landmark = self.locate(tag.address, pattern);
        // The light must go out whether or not it was seen: for the pictures, and for the battery.
        let stopped = self.step("stop", |run| run.command(tag.address, LedCommand::Stop));
        let (landmark, angles) = landmark?;
        stopped?;
        let frames = self.step("look", Self::look)?;
        let object =
            self.step("recognise", |run| run.recognise(&record, landmark, &frames, angles))?;
        Ok(Found { object, landmark, record, tag: tag.address })
    }

    /// Search, centring and triangulation, while the light blinks. A light that only one head sees,
    /// that does not obey the challenge, or that the heads see at two places, was not the tag's: the
    /// search goes on with a new pattern, which what misled it does not play.
    fn locate(
        &mut self,
        tag: TagAddress,
        mut pattern: Pattern,
    ) -> Result<(GaussianPoint, [[f64; 2]; 2]), Stop> {
        let mut tries = 1;
        loop {
            let seen = self.step("search", |run| run.search(&pattern));
            if !matches!(seen, Err(Stop::NotSeen { missing: Missing::Either, .. })) {
                pattern = self.step("challenge", |run| run.challenge(tag, pattern))?;
            }
            match seen.and_then(|seen| self.fixate(tag, &pattern, seen)) {
                Err(
                    Stop::Lost(_)
                    | Stop::Triangulation(_)
                    | Stop::NotSeen { missing: Missing::One(_), .. },
                ) if tries < self.config.search_tries => {
                    tries += 1;
                }
                outcome => return outcome,
            }
        }
    }

    /// Centres the light and measures where it is; gives the heads' angles too.
    fn fixate(
        &mut self,
        tag: TagAddress,
        pattern: &Pattern,
        seen: [search::Seen; 2],
    ) -> Result<(GaussianPoint, [[f64; 2]; 2]), Stop> {
        let held = self.step("centre", |run| run.centre(pattern, seen))?;
        let first = self.step("triangulate", |run| run.triangulate(&held))?;
        if self.config.method == Method::Paper {
            return Ok((first, held.map(|fixation| fixation.angles)));
        }
        self.step("aim again", |run| run.reaim(tag, &held, first))
    }

    /// Runs one step and enters its times in the timeline.
    fn step<T>(
        &mut self,
        name: &'static str,
        work: impl FnOnce(&mut Self) -> Result<T, Stop>,
    ) -> Result<T, Stop> {
        let start = self.begin(name);
        let outcome = work(self);
        self.end(name, start);
        outcome
    }

    /// Tells that a step begins; gives the time (s).
    pub(crate) fn begin(&mut self, name: &'static str) -> f64 {
        self.observer.notice(&Event::Begun(name));
        self.now()
    }

    /// Enters a step that is over in the timeline.
    pub(crate) fn end(&mut self, name: &'static str, start: f64) {
        let step = Step { step: name, start, end: self.now() };
        self.observer.notice(&Event::Done(&step));
        self.timeline.push(step);
    }

    fn now(&self) -> f64 {
        self.system.robot.clock.now().as_secs_f64()
    }

    /// Who answers on the radio and is the wanted object.
    fn radio(&mut self, object: &str) -> Result<Advertisement, Stop> {
        let heard = self.system.robot.radio.scan(self.config.scan_window)?;
        self.observer.notice(&Event::Heard(&heard));
        self.heard.clone_from(&heard);
        let mut wanted = heard.iter().filter(|tag| tag.may_be(object));
        match (wanted.next(), wanted.count()) {
            (Some(tag), 0) => Ok(tag.clone()),
            (Some(_), others) => Err(Stop::Ambiguous { object: object.into(), count: others + 1 }),
            (None, _) => Err(Stop::OutOfRange { object: object.into(), heard: names(&heard) }),
        }
    }

    /// The object's record, which has to be of the wanted object.
    pub(crate) fn record(&mut self, tag: &Advertisement, object: &str) -> Result<Record, Stop> {
        let timeout = self.config.link_timeout;
        let bytes = self.retry(|radio| radio.read_record(tag.address, timeout))?;
        let verdict = self.system.required_signers.as_ref().map(|keys| keys.judge(&bytes));
        if let Some(verdict) = verdict.filter(|verdict| !matches!(verdict, Verdict::Trusted(_))) {
            return Err(Stop::Signature(verdict));
        }
        let record = vergence_tag::cbor::decode(&bytes)?;
        if record.object_id.as_str() != object {
            let (advertised, recorded) = (tag.object_id.clone(), record.object_id.to_string());
            return Err(Stop::WrongRecord { advertised, recorded });
        }
        self.observer.notice(&Event::Record(tag.address, &record));
        Ok(record)
    }

    pub(crate) fn command(&mut self, tag: TagAddress, command: LedCommand) -> Result<(), Stop> {
        let timeout = self.config.link_timeout;
        self.retry(|radio| radio.command(tag, command, timeout))?;
        self.observer.notice(&Event::Led(command));
        Ok(())
    }

    /// Radio links fail now and then: tries again before giving up.
    fn retry<T>(
        &mut self,
        mut call: impl FnMut(&mut dyn vergence_devices::TagLink) -> Result<T, DeviceError>,
    ) -> Result<T, Stop> {
        let mut tries = 1;
        loop {
            match call(self.system.robot.radio.as_mut()) {
                Err(DeviceError::Timeout { .. } | DeviceError::Disconnected { .. })
                    if tries < self.config.link_tries =>
                {
                    tries += 1;
                }
                other => return Ok(other?),
            }
        }
    }

    /// One picture of either camera with the light off.
    pub(crate) fn look(&mut self) -> Result<[Frame; 2], Stop> {
        let since = self.system.robot.clock.now();
        let joints = self.system.joints()?;
        let [left, right] = self.system.pair_since(since, self.interval.mul_f64(PAIRED))?;
        self.observer.notice(&Event::Frame(Side::Left, &left, joints[0]));
        self.observer.notice(&Event::Frame(Side::Right, &right, joints[1]));
        Ok([left, right])
    }

    /// Steps 4 to 9 of the paper: the object's pose from both pictures, its size and the landmark.
    pub(crate) fn recognise(
        &mut self,
        record: &Record,
        landmark: GaussianPoint,
        frames: &[Frame; 2],
        angles: [[f64; 2]; 2],
    ) -> Result<ObjectPose, Stop> {
        let poses: [Transform; 2] =
            std::array::from_fn(|k| self.system.heads[k].base_from_optical(angles[k]));
        let noise = self.noise();
        let views: [View<'_>; 2] = std::array::from_fn(|k| View {
            image: &frames[k].image,
            camera: self.system.heads[k].camera,
            base_from_optical: poses[k],
            turn_sd: noise.step_sigma.hypot(noise.common_sigma),
        });
        let query = Query {
            record,
            landmark,
            landmark_index: 0,
            up: Some(nalgebra::Vector3::z_axis()),
            standing: None,
        };
        let outcome = match self.config.method {
            Method::Paper => vergence_pose::paper::recognise(&views, &query, &Default::default()),
            Method::Directional => {
                vergence_pose::directional::recognise(&views, &query, &Default::default())
            }
        };
        self.observer.notice(&Event::Recognised(&views, &query, outcome.as_ref()));
        Ok(outcome?)
    }
}
