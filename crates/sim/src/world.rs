//! The one state of the simulated world and its time.
//!
//! Everything that happens is ordered on one virtual clock: devices move it ahead, and on its way
//! the world notes, for every frame, where the cameras were in the middle of the exposure and what
//! the lights played. Pictures are rendered from these notes later, so that it does not matter who
//! reads which camera when.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use vergence_geometry::{Camera as Lens, Chain, Transform};

use crate::camera::{Blinker, Capture};
use crate::config::SimConfig;
use crate::placement::TaggedObject;
use crate::radio::{self, Radio};
use crate::scene::Body;
use crate::servo::Servo;
use crate::trace::{Solid, Stage};

/// A head as it really is.
#[derive(Debug, Clone)]
pub struct TrueHead {
    /// True kinematics.
    pub chain: Chain,
    /// True lens.
    pub lens: Lens,
    /// Pan, tilt.
    pub servos: [Servo; 2],
}

impl TrueHead {
    /// Where the camera is now.
    pub fn base_from_optical(&self) -> Transform {
        self.chain.forward(&[self.servos[0].load(), self.servos[1].load()])
    }
}

/// Times of the frames.
#[derive(Debug, Clone, Copy)]
pub struct Shutter {
    /// Start of frame 0 (s).
    pub phase: f64,
    /// Time between frames (s).
    pub period: f64,
    /// Exposure of a row (s).
    pub exposure: f64,
    /// From the start of the first row to that of the last (s).
    pub readout: f64,
}

impl Shutter {
    /// When the exposure of a frame's first row begins (s).
    pub fn start(&self, frame: u64) -> f64 {
        self.phase + frame as f64 * self.period
    }

    fn middle(&self, frame: u64) -> f64 {
        self.start(frame) + 0.5 * (self.exposure + self.readout)
    }

    /// When a frame is complete.
    pub fn end(&self, frame: u64) -> f64 {
        self.start(frame) + self.exposure + self.readout
    }
}

/// The state of everything.
pub struct World {
    pub(crate) settings: SimConfig,
    pub(crate) heads: [TrueHead; 2],
    pub(crate) objects: Vec<TaggedObject>,
    /// Number of objects on the table; the tag on the gripper comes after them.
    pub(crate) on_table: usize,
    /// Which bodies of the scene belong to each object.
    pub(crate) bodies_of: Vec<Range<usize>>,
    /// Number of bodies of the scene that are not the arm's; those come last.
    pub(crate) without_arm: usize,
    /// Untagged things on the table.
    pub(crate) clutter: Vec<(Transform, Solid)>,
    pub(crate) radio: Radio,
    pub(crate) status: Option<Blinker>,
    pub(crate) stage: Arc<Stage>,
    pub(crate) shutter: Shutter,
    pub(crate) now: Duration,
    /// Number of the frame that is being exposed or comes next.
    pub(crate) frame: u64,
    /// Camera poses of that frame once its middle has passed.
    pub(crate) exposing: Option<[Transform; 2]>,
    pub(crate) captures: VecDeque<Capture>,
}

/// The world as devices share it.
pub type Shared = Arc<Mutex<World>>;

/// Locks the world; a panic elsewhere leaves plain data, which stays usable.
pub fn lock(world: &Shared) -> MutexGuard<'_, World> {
    world.lock().unwrap_or_else(PoisonError::into_inner)
}

impl World {
    /// Now (s).
    pub fn seconds(&self) -> f64 {
        self.now.as_secs_f64()
    }

    /// Lets time pass.
    pub fn pass(&mut self, duration: Duration) {
        self.advance_to(self.now.saturating_add(duration));
    }

    /// Moves the clock to a time; the past is ignored.
    pub fn advance_to(&mut self, time: Duration) {
        // The lights first: frames show them as they are until then.
        self.radio.advance_to(time);
        let until = time.as_secs_f64();
        loop {
            if self.exposing.is_none() {
                let middle = self.shutter.middle(self.frame);
                if middle > until {
                    break;
                }
                self.move_servos(middle);
                self.exposing = Some([0, 1].map(|side| self.heads[side].base_from_optical()));
            }
            if self.shutter.end(self.frame) > until {
                break;
            }
            self.finish_frame();
        }
        self.move_servos(until);
        self.now = self.now.max(time);
    }

    /// Moves a tagged object with all its bodies; frames that are complete keep what they saw.
    pub fn place_object(&mut self, id: &str, base_from_object: &Transform) -> bool {
        let Some(index) = self.objects.iter().position(|o| o.record.object_id.as_str() == id)
        else {
            return false;
        };
        let object = &mut self.objects[index];
        let motion = base_from_object * object.base_from_object.inverse();
        object.base_from_object = *base_from_object;
        let mut scene = self.stage.scene.clone();
        for body in scene.bodies.get_mut(self.bodies_of[index].clone()).into_iter().flatten() {
            body.placed = body.placed.moved(&motion);
        }
        self.stage = Arc::new(Stage::new(scene));
        true
    }

    /// Shows an arm, in place of the one that was shown.
    pub fn show_arm(&mut self, parts: impl Iterator<Item = Body>) {
        let mut scene = self.stage.scene.clone();
        scene.bodies.truncate(self.without_arm);
        scene.bodies.extend(parts);
        self.stage = Arc::new(Stage::new(scene));
    }

    fn move_servos(&mut self, time: f64) {
        self.heads.iter_mut().flat_map(|head| &mut head.servos).for_each(|s| s.advance(time));
    }

    fn finish_frame(&mut self) {
        let (start, end) = (self.shutter.start(self.frame), self.shutter.end(self.frame));
        if let Some(base_from_optical) = self.exposing.take() {
            let mut blinkers = Vec::new();
            self.radio.forget_plays_before(start);
            for (index, object) in self.objects.iter().enumerate() {
                let plays = self.radio.plays(index, end);
                blinkers.extend(radio::blinkers(object, &self.settings.led, &plays));
            }
            blinkers.extend(self.status.clone());
            let stage = self.stage.clone();
            let sequence = self.frame;
            self.captures.push_back(Capture {
                sequence,
                start,
                base_from_optical,
                blinkers,
                stage,
            });
            while self.captures.len() > self.settings.camera.buffer_frames {
                self.captures.pop_front();
            }
        }
        self.frame += 1;
    }
}
