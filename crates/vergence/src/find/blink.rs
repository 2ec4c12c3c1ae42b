//! Step 1 of the paper: the tag blinks, and a view is watched until it is clear whether it does so
//! there.

use std::time::Duration;

use vergence_devices::{JointReading, LedCommand, Side, TagAddress};
use vergence_landmark::paper::PaperFinder;
use vergence_landmark::sequential::{self, SequentialFinder};
use vergence_landmark::{Decision, Finder, FinderError, Request, Sighting};
use vergence_tag::pattern::Bits;
use vergence_tag::{Pattern, codebook};

use super::{Method, Run, Stop};
use crate::event::Event;

/// Pictures from which the cameras' frame interval is taken: three intervals, the median counts.
const RATE_FRAMES: usize = 4;
/// Frames a chip of the paper's flicker lasts, so that either state is seen whole at least twice.
const FLICKER_FRAMES: u32 = 3;
/// How far a tag's crystal and a camera's may run apart (relative).
const CLOCK_TOLERANCE: f64 = 2e-4;
/// Longest watch of one view; a finder that has not decided by then has seen nothing.
const LONGEST_WATCH: Duration = Duration::from_secs(6);

impl Run<'_> {
    /// Chooses the pattern and has the tag play it with one of its lights.
    pub(crate) fn start_blinking(
        &mut self,
        tag: TagAddress,
        landmark: u8,
    ) -> Result<Pattern, Stop> {
        let interval = self.frame_interval()?;
        self.interval = interval;
        let rate = 1.0 / interval.as_secs_f64().max(1e-3);
        let pattern = match self.config.method {
            Method::Paper => Pattern::new(Bits::FLICKER, interval * FLICKER_FRAMES).ok(),
            Method::Directional => codebook::assign(0, rate),
        };
        let pattern = pattern.ok_or_else(|| rate_fault(interval))?;
        let pattern = Pattern { landmark, ..pattern };
        self.command(tag, LedCommand::Play(pattern))?;
        Ok(pattern)
    }

    /// Has the tag play a pattern that nobody can know beforehand. The heads look for it when they
    /// centre, so a lamp that happens to blink alike, another tag or a replay is lost there.
    pub(super) fn challenge(&mut self, tag: TagAddress, played: Pattern) -> Result<Pattern, Stop> {
        if self.config.method == Method::Paper {
            return Ok(played);
        }
        let seed = self.config.seed.wrapping_add(played.bits.raw());
        let drawn = codebook::challenge(seed, played.chip, &[played.bits]);
        let pattern = drawn.unwrap_or(played);
        self.command(tag, LedCommand::Play(pattern))?;
        Ok(pattern)
    }

    /// Time between two pictures of the left camera.
    fn frame_interval(&mut self) -> Result<Duration, Stop> {
        let mut stamps = Vec::with_capacity(RATE_FRAMES);
        for _ in 0..RATE_FRAMES {
            stamps.push(self.system.frame_since(0, Duration::ZERO)?.stamp);
        }
        let mut intervals: Vec<_> =
            stamps.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
        intervals.sort();
        Ok(intervals[intervals.len() / 2])
    }

    /// Watches through both cameras, the heads being still, until either knows whether the pattern
    /// is in its view. A side without a reading is not watched and sees nothing.
    pub(crate) fn watch(
        &mut self,
        pattern: &Pattern,
        joints: [Option<JointReading>; 2],
    ) -> Result<[Vec<Sighting>; 2], Stop> {
        let start = self.system.robot.clock.now();
        let finder = |side: Side| self.finder(pattern).map_err(|e| Stop::Frames(side.name(), e));
        let mut finders = [finder(Side::Left)?, finder(Side::Right)?];
        let mut open = joints.map(|j| j.is_some());
        while open.contains(&true) && self.system.robot.clock.now() < start + LONGEST_WATCH {
            for side in 0..2 {
                let Some(reading) = joints[side].filter(|_| open[side]) else { continue };
                let frame = self.system.frame_since(side, start)?;
                self.observer.notice(&Event::Frame(Side::BOTH[side], &frame, reading));
                finders[side].push(&frame).map_err(|e| Stop::Frames(Side::BOTH[side].name(), e))?;
                open[side] = !finders[side].is_done();
            }
        }
        finders.iter_mut().for_each(|finder| finder.finish());
        let seen = finders.map(|finder| match finder.decisions() {
            [Decision::Here(sightings), ..] => sightings.clone(),
            _ => Vec::new(),
        });
        for (side, reading) in joints.iter().enumerate() {
            if reading.is_some() {
                self.observer.notice(&Event::Watched(Side::BOTH[side], pattern, &seen[side]));
            }
        }
        Ok(seen)
    }

    fn finder(&self, pattern: &Pattern) -> Result<Box<dyn Finder>, FinderError> {
        let requests = vec![Request {
            id: "landmark".into(),
            pattern: *pattern,
            clock_tolerance: CLOCK_TOLERANCE,
        }];
        Ok(match self.config.method {
            Method::Paper => Box::new(PaperFinder::new(requests, Default::default())?),
            Method::Directional => {
                Box::new(SequentialFinder::new(requests, sequential::Config::default())?)
            }
        })
    }
}

fn rate_fault(interval: Duration) -> Stop {
    Stop::Device(vergence_devices::DeviceError::Fault {
        device: "left camera".into(),
        fault: format!("its pictures are {interval:?} apart, no rate that a tag can blink for"),
    })
}
