//! Shadows on the table, computed once per patch when it is first seen.
//!
//! The table fills most of every picture and its shadows do not depend on the viewer, so they are
//! stored in texels of 3 mm: how much of the sky is open, and which share of each lamp is seen.
//! Patches are filled on demand; their content does not depend on who asks first.

use std::sync::OnceLock;

use super::packet::{LANES, NEAR, Packet, V3};
use super::shade::{between, cast, lamp_point, neighbours, openness};
use super::shape::Solid;
use crate::scene::Scene;

/// Side of a texel (m).
const TEXEL: f32 = 0.003;
/// Texels along a patch; a multiple of the packet.
const PATCH: usize = 32;
/// Most lamps that are kept apart.
pub const LAMPS: usize = 2;
/// Openness to the sky, then the visible share of every lamp.
pub type Texel = [f32; 1 + LAMPS];

/// The light map of the mirroring body's upper face.
#[derive(Debug, Default)]
pub struct Lightmap {
    corner: V3,
    columns: usize,
    patches: Vec<OnceLock<Vec<Texel>>>,
}

impl Lightmap {
    /// An empty map for the scene's table.
    pub fn new(scene: &Scene) -> Self {
        let Some(table) = scene.bodies.iter().find(|body| body.mirror) else {
            return Lightmap::default();
        };
        let Solid::Box(half) = table.placed.solid else { return Lightmap::default() };
        let centre = table.placed.centre();
        // Tables stand along the axes of the base frame.
        let corner = [centre[0] - half[0], centre[1] - half[1], centre[2] + half[2]];
        let patches = |half: f32| (2.0 * half / (TEXEL * PATCH as f32)).ceil() as usize + 1;
        let (columns, rows) = (patches(half[0]), patches(half[1]));
        let patches = (0..columns * rows).map(|_| OnceLock::new()).collect();
        Lightmap { corner, columns, patches }
    }

    /// Light at a point of the table, interpolated.
    #[inline(always)]
    pub fn at(&self, scene: &Scene, p: V3) -> Texel {
        let u = ((p[0] - self.corner[0]) / TEXEL - 0.5).max(0.0);
        let v = ((p[1] - self.corner[1]) / TEXEL - 0.5).max(0.0);
        let (x, y) = (u as usize, v as usize);
        let (fx, fy) = (u - x as f32, v - y as f32);
        let mut out = [0.0; 1 + LAMPS];
        let corners = [
            (x, y, (1.0 - fx) * (1.0 - fy)),
            (x + 1, y, fx * (1.0 - fy)),
            (x, y + 1, (1.0 - fx) * fy),
            (x + 1, y + 1, fx * fy),
        ];
        for (x, y, weight) in corners {
            let texel = self.texel(scene, x, y);
            for (o, t) in out.iter_mut().zip(texel) {
                *o += weight * t;
            }
        }
        out
    }

    #[inline(always)]
    fn texel(&self, scene: &Scene, x: usize, y: usize) -> Texel {
        let (column, row) = ((x / PATCH).min(self.columns.saturating_sub(1)), y / PATCH);
        let Some(patch) = self.patches.get(row * self.columns + column) else {
            return [1.0; 1 + LAMPS];
        };
        let texels = patch.get_or_init(|| self.fill(scene, column, row));
        texels[(y % PATCH) * PATCH + x % PATCH]
    }

    fn fill(&self, scene: &Scene, column: usize, row: usize) -> Vec<Texel> {
        let place = |x: usize, y: usize| {
            [
                self.corner[0] + TEXEL * ((column * PATCH + x) as f32 + 0.5),
                self.corner[1] + TEXEL * ((row * PATCH + y) as f32 + 0.5),
                self.corner[2] + NEAR,
            ]
        };
        let middle = place(PATCH / 2, PATCH / 2);
        let spread = TEXEL * PATCH as f32 * 0.75;
        let mut texels = vec![[1.0; 1 + LAMPS]; PATCH * PATCH];
        let mut near = Vec::new();
        neighbours(scene, middle, spread, &mut near);
        for y in 0..PATCH {
            for x in 0..PATCH {
                let p = place(x, y);
                texels[y * PATCH + x][0] = openness(scene, &near, usize::MAX, p, [0.0, 0.0, 1.0]);
            }
        }
        for (k, lamp) in scene.lamps.iter().take(LAMPS).enumerate() {
            between(scene, middle, spread, lamp, &mut near);
            if near.is_empty() {
                continue;
            }
            for y in 0..PATCH {
                for left in (0..PATCH).step_by(LANES) {
                    let mut free = [0.0; LANES];
                    for probe in 0..8 {
                        let mut packet = Packet::idle();
                        for i in 0..LANES {
                            let phase = 2 * ((left + i + y) & 1) + probe / 4;
                            packet.aim(i, place(left + i, y), lamp_point(lamp, phase, probe));
                        }
                        cast(scene, &near, &mut packet);
                        for i in 0..LANES {
                            free[i] += if packet.body[i] == u32::MAX { 0.125 } else { 0.0 };
                        }
                    }
                    for (i, share) in free.into_iter().enumerate() {
                        texels[y * PATCH + left + i][1 + k] = share;
                    }
                }
            }
        }
        texels
    }
}
