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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Body, Layer, Material};
    use crate::trace::{Solid, Texture};
    use nalgebra::Point3;

    /// Covered area and centroid of a single glowing body.
    fn silhouette(solid: Solid, at: Point3<f64>, lens: &Camera) -> (f64, Point2<f64>) {
        let glowing = Material { glow: 1.0, ..Material::matt(0.5, Texture::Plain, 0) };
        let mut body = Body::new(solid, &Transform::translation(at.x, at.y, at.z), glowing);
        body.shadow = false;
        let stage = Stage::new(Scene { bodies: vec![body], ..Scene::default() });
        let out = render(&stage, &RayGrid::new(lens), &Transform::identity());
        let image = &out[Layer::Screen as usize];
        let (mut area, mut u, mut v) = (0.0, 0.0, 0.0);
        for y in 0..image.height() {
            for (x, &value) in image.row(y).iter().enumerate() {
                // The plain texture still has a little grain: coverage is what counts.
                let value = f64::from(value / 0.5).min(1.0);
                (area, u, v) = (area + value, u + value * x as f64, v + value * y as f64);
            }
        }
        (area, Point2::new(u / area, v / area))
    }

    fn lens() -> Camera {
        Camera {
            distortion: vergence_geometry::Distortion { k1: -0.1, ..Default::default() },
            ..Camera::centred(320, 240, 300.0)
        }
    }

    #[test]
    fn silhouettes_agree_with_the_projection() {
        // A small ball is seen where its centre projects; a thin plate covers its projected area.
        for at in [Point3::new(0.0, 0.0, 0.8), Point3::new(0.25, -0.15, 0.8)] {
            let (area, centre) = silhouette(Solid::Sphere(0.02), at, &lens());
            let expected = lens().project(&at).unwrap();
            assert!((centre - expected).norm() < 0.1, "{centre} for {expected}, area {area}");
        }
        let at = Point3::new(0.1, 0.05, 0.7);
        let (area, _) = silhouette(Solid::Box([0.1, 0.06, 1e-4]), at, &lens());
        let corner = |x, y| lens().project(&(at + nalgebra::Vector3::new(x, y, 0.0))).unwrap();
        // Shoelace over the outline, which distortion bends.
        let side = |k: usize, t: f64| match k {
            0 => corner(-0.1 + 0.2 * t, -0.06),
            1 => corner(0.1, -0.06 + 0.12 * t),
            2 => corner(0.1 - 0.2 * t, 0.06),
            _ => corner(-0.1, 0.06 - 0.12 * t),
        };
        let outline: Vec<_> =
            (0..4).flat_map(|k| (0..50).map(move |j| side(k, f64::from(j) / 50.0))).collect();
        let expected: f64 = (0..200)
            .map(|i| (outline[i], outline[(i + 1) % 200]))
            .map(|(a, b)| 0.5 * (a.x * b.y - a.y * b.x))
            .sum();
        // The grain of the surface is 4 %, at most 2 % on average.
        assert!((area / expected - 1.0).abs() < 0.03, "{area} px for {expected}");
    }

    #[test]
    fn a_lamp_throws_a_shadow() {
        let lamp = crate::scene::Lamp {
            centre: [0.0, 0.0, 2.0],
            edges: [[0.05, 0.0, 0.0], [0.0, 0.05, 0.0]],
            intensity: 2.0,
            layer: Layer::Lamp,
        };
        let matt = Material::matt(0.5, Texture::Plain, 0);
        let mut table =
            Body::new(Solid::Box([0.5, 0.5, 0.02]), &Transform::translation(0.0, 0.0, -0.02), matt);
        (table.shadow, table.mirror) = (false, true);
        let plate =
            Body::new(Solid::Box([0.1, 0.1, 0.001]), &Transform::translation(0.0, 0.0, 0.5), matt);
        let scene = Scene { bodies: vec![table, plate], lamps: vec![lamp], ..Scene::default() };
        let stage = Stage::new(scene);
        // From below the plate, looking down: the middle is dark, the rim is lit.
        let down = nalgebra::UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, 0.0);
        let pose = Transform::from_parts(Point3::new(0.0, 0.0, 0.45).coords.into(), down);
        let grid = RayGrid::new(&Camera::centred(320, 240, 150.0));
        let light = &render(&stage, &grid, &pose)[Layer::Lamp as usize];
        let (middle, rim) = (light.sample(160.0, 120.0), light.sample(10.0, 120.0));
        assert!(middle < 0.01 * rim && rim > 0.1, "{middle} in the shadow, {rim} outside");
    }
}
