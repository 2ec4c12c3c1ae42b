//! From a view to pictures of linear light.

use multiversion::multiversion;
use nalgebra::Point2;
use vergence_geometry::{Camera, Transform};
use vergence_imaging::Image;

use super::Stage;
use super::packet::{LANES, Packet, V3, dot, normalize, sub};
use super::shade::{cast, shade};
use crate::scene::{LAYERS, Scene};

/// Side of a tile (px); a multiple of the packet.
const TILE: usize = 16;
/// Places of the eight samples within a pixel (px from its centre): eight rooks.
const ROOKS: [[f32; 2]; LANES] = [
    [-0.4375, 0.0625],
    [-0.3125, -0.3125],
    [-0.1875, 0.3125],
    [-0.0625, -0.1875],
    [0.0625, 0.1875],
    [0.1875, -0.4375],
    [0.3125, 0.4375],
    [0.4375, -0.0625],
];

/// Directions of a camera's pixels in its optical frame, lens distortion included.
#[derive(Debug, Clone)]
pub struct RayGrid {
    width: usize,
    height: usize,
    /// Directions with z = 1, one more column and row than pixels.
    directions: Vec<[f32; 2]>,
    /// Angle of a pixel (rad).
    pixel: f32,
}

impl RayGrid {
    /// Computes the directions of a camera.
    pub fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width, camera.height);
        let mut directions = Vec::with_capacity((width + 1) * (height + 1));
        for y in 0..=height {
            for x in 0..=width {
                let d = camera.unproject(&Point2::new(x as f64, y as f64));
                directions.push([(d.x / d.z) as f32, (d.y / d.z) as f32]);
            }
        }
        RayGrid { width, height, directions, pixel: (1.0 / camera.fx) as f32 }
    }

    /// Direction at a pixel plus an offset below one pixel.
    #[inline(always)]
    fn at(&self, x: usize, y: usize, offset: [f32; 2]) -> V3 {
        let stride = self.width + 1;
        let i = y * stride + x;
        let (d, dx, dy) = (self.directions[i], self.directions[i + 1], self.directions[i + stride]);
        let u = d[0] + offset[0] * (dx[0] - d[0]) + offset[1] * (dy[0] - d[0]);
        let v = d[1] + offset[0] * (dx[1] - d[1]) + offset[1] * (dy[1] - d[1]);
        [u, v, 1.0]
    }
}

/// Linear light, one picture a layer.
pub type Rendering = [Image<f32>; LAYERS];

/// A camera's place in single precision.
struct Eye {
    position: V3,
    rows: [V3; 3],
}

impl Eye {
    fn new(base_from_optical: &Transform) -> Self {
        let m = base_from_optical.rotation.to_rotation_matrix();
        let rows = [0, 1, 2].map(|r| [0, 1, 2].map(|c| m[(r, c)] as f32));
        let p = base_from_optical.translation.vector;
        Eye { position: [p.x as f32, p.y as f32, p.z as f32], rows }
    }

    #[inline(always)]
    fn turn(&self, d: V3) -> V3 {
        [dot(self.rows[0], d), dot(self.rows[1], d), dot(self.rows[2], d)]
    }
}

/// Bodies that a tile of pixels may show.
#[derive(Default)]
struct Candidates {
    direct: Vec<u16>,
    mirrored: Vec<u16>,
}

/// Renders what a camera sees.
pub fn render(stage: &Stage, grid: &RayGrid, base_from_optical: &Transform) -> Rendering {
    let eye = Eye::new(base_from_optical);
    let mut out = [(); LAYERS].map(|()| Image::filled(grid.width, grid.height, 0.0f32));
    let surface = sample_pixels(stage, grid, &eye, &mut out);
    refine_edges(stage, grid, &eye, &surface, &mut out);
    out
}

/// One sample a pixel; returns which surface each pixel shows.
#[multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn sample_pixels(stage: &Stage, grid: &RayGrid, eye: &Eye, out: &mut Rendering) -> Image<u64> {
    let scene = &stage.scene;
    let (width, height) = (grid.width, grid.height);
    let mut surface = Image::filled(width, height, 0u64);
    let mut candidates = Candidates::default();
    let mut scratch = Vec::new();
    for top in (0..height).step_by(TILE) {
        for left in (0..width).step_by(TILE) {
            tile_candidates(scene, grid, eye, left, top, &mut candidates);
            let right = (left + TILE).min(width);
            for y in top..(top + TILE).min(height) {
                for x in (left..right).step_by(LANES) {
                    let pixel = |i: usize| ((x + i).min(width - 1), y, [0.0, 0.0]);
                    let mut packet = primary(grid, eye, pixel);
                    cast(scene, &candidates.direct, &mut packet);
                    let phase = std::array::from_fn(|i| ((x + i) & 1 | (y & 1) << 1) as u8);
                    let light = shade(
                        stage,
                        &packet,
                        &phase,
                        grid.pixel,
                        &candidates.mirrored,
                        &mut scratch,
                    );
                    for i in 0..LANES.min(right - x) {
                        surface.set(x + i, y, identity(scene, &packet, i));
                        for (layer, value) in out.iter_mut().zip(light[i]) {
                            layer.set(x + i, y, value);
                        }
                    }
                }
            }
        }
    }
    surface
}

/// Rays through pixels given per lane.
#[inline(always)]
fn primary(grid: &RayGrid, eye: &Eye, pixel: impl Fn(usize) -> (usize, usize, [f32; 2])) -> Packet {
    let mut direction = [[0.0; LANES]; 3];
    for i in 0..LANES {
        let (x, y, offset) = pixel(i);
        let d = normalize(eye.turn(grid.at(x, y, offset)));
        for k in 0..3 {
            direction[k][i] = d[k];
        }
    }
    let p = eye.position;
    let origin = [[p[0]; LANES], [p[1]; LANES], [p[2]; LANES]];
    Packet::new(origin, direction, [f32::INFINITY; LANES])
}

/// Bodies whose bounding sphere meets the cone around a tile.
fn tile_candidates(
    scene: &Scene,
    grid: &RayGrid,
    eye: &Eye,
    left: usize,
    top: usize,
    out: &mut Candidates,
) {
    let (right, bottom) = ((left + TILE).min(grid.width), (top + TILE).min(grid.height));
    let at = |x, y| normalize(eye.turn(grid.at(x, y, [0.0; 2])));
    let axis = at((left + right) / 2, (top + bottom) / 2);
    let corners = [(left, top), (right - 1, top), (left, bottom - 1), (right - 1, bottom - 1)];
    let cos = corners.iter().map(|&(x, y)| dot(axis, at(x, y))).fold(1.0, f32::min);
    let half = cos.clamp(-1.0, 1.0).acos() + 1.5 * grid.pixel;
    out.direct.clear();
    out.mirrored.clear();
    let meets = |centre: V3, bound: f32| {
        let to = sub(centre, eye.position);
        let distance = dot(to, to).sqrt();
        distance <= bound || {
            let angle = (dot(to, axis) / distance).clamp(-1.0, 1.0).acos();
            angle <= half + (bound / distance).asin()
        }
    };
    let height = scene.table_height as f32;
    for (index, body) in scene.bodies.iter().enumerate() {
        let (centre, bound) = (body.placed.centre(), body.placed.bound());
        if meets(centre, bound) {
            out.direct.push(index as u16);
        }
        // Seen in the table, a body stands as deep below its top as it really stands above.
        let image = [centre[0], centre[1], 2.0 * height - centre[2]];
        if !body.mirror && meets(image, bound) {
            out.mirrored.push(index as u16);
        }
    }
}

/// A number that changes where one surface ends and the next begins.
#[inline(always)]
fn identity(scene: &Scene, packet: &Packet, i: usize) -> u64 {
    let index = packet.body[i];
    let Some(body) = scene.bodies.get(index as usize) else { return u64::MAX };
    let local = body.placed.local(packet.point(i));
    let (_, part) = body.placed.normal(local, packet.part[i]);
    u64::from(index) << 8 | u64::from(part)
}

/// Samples pixels at the edges of surfaces eight times.
#[multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn refine_edges(
    stage: &Stage,
    grid: &RayGrid,
    eye: &Eye,
    surface: &Image<u64>,
    out: &mut Rendering,
) {
    let scene = &stage.scene;
    let (width, height) = (grid.width, grid.height);
    let mut candidates = Candidates::default();
    let mut scratch = Vec::new();
    for top in (0..height).step_by(TILE) {
        for left in (0..width).step_by(TILE) {
            let mut listed = false;
            for y in top..(top + TILE).min(height) {
                for x in left..(left + TILE).min(width) {
                    if !at_edge(surface, x, y) {
                        continue;
                    }
                    if !listed {
                        tile_candidates(scene, grid, eye, left, top, &mut candidates);
                        listed = true;
                    }
                    let mut packet = primary(grid, eye, |i| (x, y, ROOKS[i]));
                    cast(scene, &candidates.direct, &mut packet);
                    let phase = std::array::from_fn(|i| i as u8);
                    let light = shade(
                        stage,
                        &packet,
                        &phase,
                        grid.pixel,
                        &candidates.mirrored,
                        &mut scratch,
                    );
                    for (k, layer) in out.iter_mut().enumerate() {
                        let sum: f32 = light.iter().map(|l| l[k]).sum();
                        layer.set(x, y, sum / LANES as f32);
                    }
                }
            }
        }
    }
}

fn at_edge(surface: &Image<u64>, x: usize, y: usize) -> bool {
    let here = surface.get(x, y);
    let around = [(x + 1, y), (x.wrapping_sub(1), y), (x, y + 1), (x, y.wrapping_sub(1))];
    around.iter().any(|&(x, y)| surface.get(x, y).is_some_and(|other| Some(other) != here))
}
