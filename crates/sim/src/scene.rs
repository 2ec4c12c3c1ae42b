//! What there is to see: bodies with their surfaces, lamps, and the small lights that blink.

use nalgebra::{Point3, Unit, Vector3};
use vergence_geometry::Transform;

use crate::trace::{Placed, Solid, Texture};

/// Light that varies with time is rendered apart, one picture a source, and scaled per frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layer {
    /// Daylight, ambient light and whatever does not flicker.
    Steady = 0,
    /// The ceiling lamp.
    Lamp = 1,
    /// The screen.
    Screen = 2,
}

/// Number of layers.
pub const LAYERS: usize = 3;

/// Surface of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Share of light given back diffusely.
    pub albedo: f32,
    /// How that varies.
    pub texture: Texture,
    /// Seed of the texture.
    pub seed: u32,
    /// Mirror-like share at normal incidence.
    pub gloss: f32,
    /// Own light on the layer [`Layer::Screen`], relative to white.
    pub glow: f32,
}

impl Material {
    /// A matt surface.
    pub fn matt(albedo: f32, texture: Texture, seed: u32) -> Self {
        Material { albedo, texture, seed, gloss: 0.0, glow: 0.0 }
    }

    /// The same surface with a shine.
    pub fn glossy(self, gloss: f32) -> Self {
        Material { gloss, ..self }
    }
}

/// A solid with its surface.
#[derive(Debug, Clone)]
pub struct Body {
    /// Form and place.
    pub placed: Placed,
    /// Surface.
    pub material: Material,
    /// Throws shadows; walls and floor need not.
    pub shadow: bool,
    /// Mirrors the scene (the table top), not only the lamps.
    pub mirror: bool,
}

impl Body {
    /// A body that throws shadows.
    pub fn new(solid: Solid, base_from_body: &Transform, material: Material) -> Self {
        Body { placed: Placed::new(solid, base_from_body), material, shadow: true, mirror: false }
    }
}

/// A rectangular lamp that shines downwards or along its normal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lamp {
    /// Centre (m, base).
    pub centre: [f32; 3],
    /// Half edges (m, base).
    pub edges: [[f32; 3]; 2],
    /// Irradiance on a surface that faces it at 1 m, relative to white.
    pub intensity: f32,
    /// Which layer it lights.
    pub layer: Layer,
}

/// A small light with a lobe: a tag's LED or a status light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Emitter {
    /// Centre of its disc (base).
    pub position: Point3<f64>,
    /// Axis of its lobe (base).
    pub normal: Unit<Vector3<f64>>,
    /// Exponent of the cosine lobe.
    pub lobe: f64,
    /// Diameter (m).
    pub diameter: f64,
    /// Sum of pixel values at 1 m on the axis at an exposure of 4 ms.
    pub flux_px: f64,
}

/// Everything that cameras see but the blinking itself.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// Bodies.
    pub bodies: Vec<Body>,
    /// Lamps.
    pub lamps: Vec<Lamp>,
    /// Ambient irradiance from above and from below.
    pub ambient: [f32; 2],
    /// Height of the table top (m, base), where LEDs are mirrored.
    pub table_height: f64,
}
