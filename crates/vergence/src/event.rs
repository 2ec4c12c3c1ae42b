//! What happens during a run, for progress, pictures and recordings.

use std::time::Duration;

use vergence_devices::{Advertisement, GripperReading, JointReading, LedCommand, Side, TagAddress};
use vergence_geometry::{GaussianPoint, Trajectory};
use vergence_imaging::Frame;
use vergence_landmark::Sighting;
use vergence_pose::{ObjectPose, Query, Refusal, View};
use vergence_tag::{Pattern, Record};

use crate::report::Step;

/// One thing that happened, in order.
pub enum Event<'a> {
    /// A step of the timeline begins.
    Begun(&'static str),
    /// A step of the timeline is over.
    Done(&'a Step),
    /// Tags that answered on the radio.
    Heard(&'a [Advertisement]),
    /// The record of the wanted object.
    Record(TagAddress, &'a Record),
    /// The LED was told to do this.
    Led(LedCommand),
    /// A picture and the head's encoder angles while it was taken.
    Frame(Side, &'a Frame, JointReading),
    /// A head has watched one view to the end: where the pattern was seen, brightest first.
    Watched(Side, &'a Pattern, &'a [Sighting]),
    /// A head holds the landmark in its image centre.
    Centred(Side, JointReading, &'a Sighting),
    /// The triangulated landmark and the distance by equation (1) of the paper.
    Landmark(&'a GaussianPoint, f64),
    /// The arm is about to move.
    Motion {
        /// When (robot's clock).
        start: Duration,
        /// The arm's joints.
        names: &'a [String; 6],
        /// What it is told.
        trajectory: &'a Trajectory,
    },
    /// The arm has moved, and stands still.
    Moved {
        /// When it began (robot's clock).
        start: Duration,
        /// When it stopped: before the trajectory's end when something stopped it.
        end: Duration,
        /// The arm's joints.
        names: &'a [String; 6],
        /// What it followed until then.
        trajectory: &'a Trajectory,
    },
    /// The fingers have moved.
    Gripped(&'a GripperReading),
    /// A stage of a grasp, worth a picture: the newest pictures show it.
    Stage(&'static str),
    /// The recogniser has seen these views and decided.
    Recognised(&'a [View<'a>], &'a Query<'a>, Result<&'a ObjectPose, &'a Refusal>),
}

/// Someone who watches a run.
pub trait Observer {
    /// Takes notice of an event; must not take long, devices wait.
    fn notice(&mut self, event: &Event<'_>);
}

/// Nobody watches.
impl Observer for () {
    fn notice(&mut self, _: &Event<'_>) {}
}

impl<A: Observer, B: Observer> Observer for (A, B) {
    fn notice(&mut self, event: &Event<'_>) {
        self.0.notice(event);
        self.1.notice(event);
    }
}

impl<O: Observer> Observer for Option<O> {
    fn notice(&mut self, event: &Event<'_>) {
        if let Some(observer) = self {
            observer.notice(event);
        }
    }
}
