//! Ray tracing in packets of eight.
//!
//! In: a [`Scene`] and a view (directions of the pixels, pose of the camera). Out: linear light per
//! pixel, one picture per [`crate::scene::Layer`], white = 1, before the lens's blur and the sensor.
//!
//! Method: packets of eight pixels find the nearest body among those whose bounding sphere meets
//! the tile's cone; every hit is lit by an ambient term with contact shading and by rectangular
//! lamps, each probed with four shadow rays whose targets are interleaved over 2x2 pixels; pixels
//! where the body or the surface changes against a neighbour are sampled eight times over.

// One index runs over the lanes of several arrays at once; iterators would hide that.
#![allow(clippy::needless_range_loop)]

mod facets;
mod lightmap;
mod packet;
mod render;
mod shade;
mod shape;
mod texture;

pub use facets::Facets;
pub use packet::{LANES, V3};
pub use render::{RayGrid, Rendering, render};
pub use shade::{clear_share, is_clear};
pub use shape::{Placed, Solid};
pub use texture::Texture;

use crate::scene::Scene;

/// A scene that stands still, with what is known of its light.
#[derive(Debug)]
pub struct Stage {
    /// What stands where.
    pub scene: Scene,
    table_light: lightmap::Lightmap,
}

impl Stage {
    /// Prepares a scene for rendering.
    pub fn new(scene: Scene) -> Self {
        let table_light = lightmap::Lightmap::new(&scene);
        Stage { scene, table_light }
    }
}
