//! Size model + edges of one or two pictures + landmark -> 6-DOF pose of the object.
//!
//! **In:** [`View`]s (grey picture, camera, where the camera was) and a [`Query`] (the tag's record
//! and the triangulated landmark in the base frame). **Out:** [`ObjectPose`], `base_from_object`
//! with a covariance, a confidence and the other poses that come near, or a [`Refusal`] that says
//! why there is none.
//!
//! The landmark gives a point of the object; nothing gives the rotation. Two methods find it:
//!
//! - [`paper`]: the 2005 paper's steps 4 to 8. Canny, template of the bounding box at the measured
//!   distance with hidden lines removed, distance transform, largest correlation.
//! - [`directional`]: the default. Oriented sub-pixel edges, directional distance fields,
//!   a search over all rotations, refinement of all six unknowns, and a verdict.
//!
//! Pixels, frames and tangents follow [`vergence_geometry`]. Object frame: origin in the middle of
//! the bounding box, x along width, y along length, z along height.

pub mod canny;
pub mod directional;
pub mod distance;
pub mod model;
pub mod paper;
pub mod rotations;
mod types;

pub use model::{Contour, Kind, Model, Segment};
pub use types::{Alternative, ObjectPose, Query, Refusal, View};
