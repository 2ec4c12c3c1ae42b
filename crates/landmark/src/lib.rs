//! Video in, the places where requested light patterns blink out (or that they do not blink there).
//!
//! A [`Request`] names a pattern that a tag was told to play. A [`Finder`] takes frames one at a time
//! and keeps one [`Decision`] a request. Camera and tag share no clock: phase, background and
//! brightness are unknown, only the pattern and the length of its chip are known.
//!
//! Two methods stand behind the one interface, so that each is measured against the other:
//! [`paper`] is the on/off difference with projection histograms of the 2005 paper (sections 2.2 and
//! 2.3); [`sequential`] weighs soft evidence for every pattern and phase at every place and stops as
//! soon as a stated false-alarm rate allows.

mod finder;
pub mod near;
pub mod paper;
pub mod sequential;
pub mod synthetic;

pub use finder::{Decision, Finder, FinderError, Request, Sighting};
