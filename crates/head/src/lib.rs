//! The stereo pan-tilt head: two cameras, each on a pan and a tilt servo.
//!
//! In come joint angles (rad) and pixels, out come a point in the `base` frame with its covariance,
//! and the angles to turn to next. Nothing here touches a device: the orchestration moves servos and
//! asks these functions what follows.
//!
//! ```text
//! Search  -> where to look next until both heads see the light
//! Fixator -> from the residual pixel to the next angles, until the light is centred
//! triangulate / paper_distance -> where the light is
//! Reaim -> where to look again until its distance is known well enough
//! calibrate -> the head as it is, from the head as it is described
//! ```
//!
//! Pairs are in the order left, right. `angles` are always `[pan, tilt]`, pan positive to the left,
//! tilt positive downwards.

// An index names a head or a joint in several arrays at once; zipped iterators would hide which.
#![allow(clippy::needless_range_loop)]

mod bounded;
pub mod calibration;
pub mod evaluation;
mod fixation;
mod kinematics;
mod paper;
mod reaim;
mod search;
mod triangulation;

pub use calibration::{Calibration, CalibrationConfig, calibrate};
pub use fixation::{Fixator, FixatorConfig, NextMove, run_up};
pub use kinematics::{HeadError, PanTiltHead};
pub use paper::{PaperAngles, paper_distance};
pub use reaim::{Reaim, ReaimConfig};
pub use search::{Field, Search, SearchConfig};
pub use triangulation::{
    Fixation, GATE_SIGMAS, Landmark, Noise, TriangulateError, epipolar_gap, triangulate,
    triangulate_many,
};

#[cfg(test)]
mod testing;
