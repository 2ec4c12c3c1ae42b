//! The room: table, floor, walls, screen and lamps.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use vergence_geometry::Transform;

use super::TABLE;
use crate::config::LightSettings;
use crate::scene::{Body, Lamp, Layer, Material, Scene};
use crate::trace::{Solid, Texture, V3};

/// Table, floor, walls and lamps.
pub(super) fn room(light: &LightSettings, rng: &mut Pcg64Mcg) -> Scene {
    let slab = |half: V3, x: f64, y: f64, z: f64, material: Material| {
        let mut body = Body::new(Solid::Box(half), &Transform::translation(x, y, z), material);
        body.shadow = false;
        body
    };
    let seed: u32 = rng.random();
    let wood = Material::matt(0.34, Texture::Wood, seed).glossy(0.035);
    let wall = |albedo, k| Material::matt(albedo, Texture::Backdrop, seed.wrapping_add(k));
    let floor = Material::matt(0.2, Texture::Grain { size: 0.3, contrast: 0.6 }, seed);
    let half_x = (0.5 * (TABLE[1] - TABLE[0])) as f32;
    let mid_x = 0.5 * (TABLE[0] + TABLE[1]);
    let mut table = slab([half_x, TABLE[2] as f32, 0.02], mid_x, 0.0, -0.02, wood);
    table.mirror = true;
    let mut bodies = vec![
        table,
        slab([3.0, 3.0, 0.05], 1.0, 0.0, -0.8, floor),
        slab([0.05, 3.0, 1.8], 2.6, 0.0, 1.0, wall(0.55, 1)),
        slab([2.5, 0.05, 1.8], 0.8, 2.2, 1.0, wall(0.5, 2)),
        slab([2.5, 0.05, 1.8], 0.8, -2.2, 1.0, wall(0.5, 3)),
        slab([3.0, 3.0, 0.05], 1.0, 0.0, 2.7, Material::matt(0.7, Texture::Plain, seed)),
    ];
    if light.screen {
        let picture = Texture::Grain { size: 0.2, contrast: 0.9 };
        let dark = Material { glow: 0.5, ..Material::matt(0.5, picture, seed) };
        bodies.push(slab([0.01, 0.3, 0.17], 2.4, rng.random_range(-0.8..0.8), 0.35, dark));
    }
    let b = light.brightness as f32;
    let side = if rng.random::<bool>() { 1.0f32 } else { -1.0 };
    let at = |x: f32, y: f32, z: f32| [x, side * y, z];
    let lamps = vec![
        // A ceiling tube, flickering with the mains, and a window beside the table.
        Lamp {
            centre: at(rng.random_range(0.3..0.9), rng.random_range(0.1..0.6), 2.2),
            edges: [[0.6, 0.0, 0.0], [0.0, 0.06, 0.0]],
            intensity: 2.4 * b,
            layer: Layer::Lamp,
        },
        Lamp {
            centre: at(rng.random_range(-0.2..0.5), -1.9, 1.3),
            edges: [[0.16, 0.0, 0.0], [0.0, 0.0, 0.22]],
            intensity: 5.0 * b,
            layer: Layer::Steady,
        },
    ];
    Scene { bodies, lamps, ambient: [0.1 * b, 0.06 * b], table_height: 0.0 }
}
