//! Light at the points where rays end.

use super::packet::{LANES, Lane3, NEAR, Packet, V3, add_scaled, dot, normalize, sub};
use super::shape::Solid;
use super::texture::Extent;
use crate::scene::{LAYERS, Lamp, Layer, Scene};

/// Light of every layer at the eight ends of a packet.
pub type Light = [[f32; LAYERS]; LANES];

/// What the shading of a packet needs to know of a hit.
#[derive(Clone, Copy, Default)]
struct Surface {
    point: V3,
    normal: V3,
    view: V3,
    albedo: f32,
    body: usize,
    hit: bool,
}

/// Which sample of a 2x2 pattern a ray takes, so that neighbours see other parts of a lamp.
pub type Phase = [u8; LANES];

/// Finds the nearest bodies, out of `candidates`, for the packet.
#[inline(always)]
pub fn cast(scene: &Scene, candidates: &[u16], packet: &mut Packet) {
    for &index in candidates {
        if let Some(body) = scene.bodies.get(usize::from(index)) {
            body.placed.intersect(packet, u32::from(index));
        }
    }
}

/// Lights what the packet has hit. `pixel` is the angle of a pixel (rad), for texture filtering;
/// `mirror` allows reflections of the scene in mirroring bodies.
#[inline(always)]
pub fn shade(
    scene: &Scene,
    packet: &Packet,
    phase: &Phase,
    pixel: f32,
    mirror: bool,
    scratch: &mut Vec<u16>,
) -> Light {
    let mut light = [[0.0; LAYERS]; LANES];
    let mut surfaces = [Surface::default(); LANES];
    for i in 0..LANES {
        if let Some(s) = surface(scene, packet, i, pixel) {
            let material = &scene.bodies[s.body].material;
            light[i][Layer::Screen as usize] = material.glow * s.albedo;
            let up = 0.5 + 0.5 * s.normal[2];
            let sky = scene.ambient[0] * up + scene.ambient[1] * (1.0 - up);
            light[i][Layer::Steady as usize] = s.albedo * sky;
            surfaces[i] = s;
        }
    }
    contact(scene, &surfaces, &mut light, scratch);
    for lamp in &scene.lamps {
        illuminate(scene, lamp, &surfaces, phase, &mut light, scratch);
    }
    if mirror {
        reflect(scene, &surfaces, phase, pixel, &mut light);
    }
    light
}

fn surface(scene: &Scene, packet: &Packet, i: usize, pixel: f32) -> Option<Surface> {
    let index = packet.body[i] as usize;
    let body = scene.bodies.get(index)?;
    let (point, view) = (packet.point(i), packet.heading(i));
    let local = body.placed.local(point);
    let (mut n, part) = body.placed.normal(local, packet.part[i]);
    let mut normal = body.placed.outward(n);
    if dot(normal, view) > 0.0 {
        normal = normal.map(|x| -x);
        n = n.map(|x| -x);
    }
    let material = &body.material;
    let extent = match body.placed.solid {
        Solid::Box(half) => Extent::Flat(half),
        Solid::Frustum { bottom, top, .. } | Solid::Cup { bottom, top, .. } => {
            Extent::Round(0.5 * (bottom + top))
        }
        Solid::Sphere(radius) | Solid::Capsule { radius, .. } => Extent::Round(radius),
    };
    let footprint = packet.t[i] * pixel;
    let plain_inside = part >= 2 && !matches!(body.placed.solid, Solid::Box(_));
    let factor = match plain_inside {
        true => 1.0,
        false => material.texture.factor(local, n, extent, footprint, material.seed),
    };
    let albedo = (material.albedo * factor).min(0.95);
    Some(Surface { point, normal, view, albedo, body: index, hit: true })
}

/// Darkens the ambient light near other bodies: each hides the share of the sky that its bounding
/// sphere covers.
#[inline(always)]
fn contact(scene: &Scene, surfaces: &[Surface; LANES], light: &mut Light, near: &mut Vec<u16>) {
    let Some((centre, spread)) = extent_of(surfaces) else { return };
    near.clear();
    for (index, body) in scene.bodies.iter().enumerate() {
        let d = sub(body.placed.centre(), centre);
        let reach = spread + 3.0 * body.placed.bound();
        if body.shadow && dot(d, d) < reach * reach {
            near.push(index as u16);
        }
    }
    for (s, l) in surfaces.iter().zip(light.iter_mut()).filter(|(s, _)| s.hit) {
        let mut open = 1.0;
        for &index in near.iter().filter(|&&k| usize::from(k) != s.body) {
            let placed = &scene.bodies[usize::from(index)].placed;
            let d = sub(placed.centre(), s.point);
            let d2 = dot(d, d);
            // The bounding sphere is larger than the body: 0.6 of its section is about right.
            let share = 0.6 * placed.bound() * placed.bound() / d2;
            let cos = dot(d, s.normal) / d2.sqrt();
            open *= 1.0 - (share * cos.max(0.0)).min(0.75);
        }
        l[Layer::Steady as usize] *= open;
    }
}

/// Middle and radius of the points hit.
#[inline(always)]
fn extent_of(surfaces: &[Surface; LANES]) -> Option<(V3, f32)> {
    let count = surfaces.iter().filter(|s| s.hit).count();
    if count == 0 {
        return None;
    }
    let mut centre = [0.0; 3];
    for s in surfaces.iter().filter(|s| s.hit) {
        centre = add_scaled(centre, s.point, 1.0 / count as f32);
    }
    let mut spread2 = 0.0f32;
    for s in surfaces.iter().filter(|s| s.hit) {
        let d = sub(s.point, centre);
        spread2 = spread2.max(dot(d, d));
    }
    Some((centre, spread2.sqrt()))
}

/// Places of the shadow probes on a lamp, in units of its half edges; four a pixel, another four
/// for each of the 2x2 pixels: a (4, 4) net of sixteen.
const PROBES: [[[f32; 2]; 4]; 4] = {
    let a = [-0.75, -0.25, 0.25, 0.75];
    [
        [[a[0], a[1]], [a[2], a[0]], [a[1], a[3]], [a[3], a[2]]],
        [[a[1], a[0]], [a[3], a[1]], [a[0], a[2]], [a[2], a[3]]],
        [[a[0], a[0]], [a[2], a[1]], [a[1], a[2]], [a[3], a[3]]],
        [[a[1], a[1]], [a[3], a[0]], [a[0], a[3]], [a[2], a[2]]],
    ]
};

/// Adds a lamp's diffuse light and highlight with soft shadows.
#[inline(always)]
fn illuminate(
    scene: &Scene,
    lamp: &Lamp,
    surfaces: &[Surface; LANES],
    phase: &Phase,
    light: &mut Light,
    near: &mut Vec<u16>,
) {
    let Some((centre, spread)) = extent_of(surfaces) else { return };
    let size = lamp.edges.iter().map(|e| dot(*e, *e)).sum::<f32>().sqrt();
    between(scene, centre, spread, lamp.centre, size, near);
    for probe in 0..4 {
        let (mut origin, mut direction) =
            ([[0.0; LANES]; 3], [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]; 3]);
        let mut reach = [0.0; LANES];
        for (i, s) in surfaces.iter().enumerate().filter(|(_, s)| s.hit) {
            let [u, v] = PROBES[usize::from(phase[i] & 3)][probe];
            let target = add_scaled(add_scaled(lamp.centre, lamp.edges[0], u), lamp.edges[1], v);
            let from = add_scaled(s.point, s.normal, NEAR);
            let to = sub(target, from);
            let distance = dot(to, to).sqrt();
            for k in 0..3 {
                origin[k][i] = from[k];
                direction[k][i] = to[k] / distance;
            }
            reach[i] = distance;
        }
        let mut packet = Packet::new(origin, direction, reach);
        cast(scene, near, &mut packet);
        for (i, s) in surfaces.iter().enumerate() {
            let d = packet.heading(i);
            let cos = dot(s.normal, d);
            if !s.hit || packet.body[i] != u32::MAX || cos <= 0.0 {
                continue;
            }
            let material = &scene.bodies[s.body].material;
            let strength = 0.25 * lamp.intensity / (reach[i] * reach[i]).max(1e-3);
            let mirrored = add_scaled(s.view, s.normal, -2.0 * dot(s.view, s.normal));
            let shine = match material.gloss > 0.0 {
                true => {
                    let along = dot(mirrored, d).max(0.0);
                    material.gloss
                        * 0.5
                        * (material.shininess + 2.0)
                        * along.powf(material.shininess)
                }
                false => 0.0,
            };
            light[i][lamp.layer as usize] += strength * cos * (s.albedo + shine);
        }
    }
}

/// Reflections of the scene in mirroring bodies (Schlick's law).
#[inline(always)]
fn reflect(
    scene: &Scene,
    surfaces: &[Surface; LANES],
    phase: &Phase,
    pixel: f32,
    light: &mut Light,
) {
    let mirrors = |s: &Surface| s.hit && scene.bodies[s.body].mirror;
    if !surfaces.iter().any(mirrors) {
        return;
    }
    let (mut origin, mut direction): (Lane3, Lane3) = ([[0.0; LANES]; 3], [[1.0; LANES]; 3]);
    let mut reach = [0.0; LANES];
    let mut share = [0.0; LANES];
    for (i, s) in surfaces.iter().enumerate().filter(|(_, s)| mirrors(s)) {
        let cos = -dot(s.view, s.normal);
        let mirrored = normalize(add_scaled(s.view, s.normal, 2.0 * cos));
        for k in 0..3 {
            origin[k][i] = s.point[k] + NEAR * s.normal[k];
            direction[k][i] = mirrored[k];
        }
        reach[i] = f32::INFINITY;
        let gloss = scene.bodies[s.body].material.gloss;
        share[i] = gloss + (1.0 - gloss) * 0.6 * (1.0 - cos).clamp(0.0, 1.0).powi(5);
    }
    let mut packet = Packet::new(origin, direction, reach);
    for (index, body) in scene.bodies.iter().enumerate() {
        body.placed.intersect(&mut packet, index as u32);
    }
    // A rough table blurs what it mirrors: textures are filtered as if ten pixels wide.
    let mut scratch = Vec::new();
    let mirrored = shade(scene, &packet, phase, 10.0 * pixel, false, &mut scratch);
    for i in 0..LANES {
        if share[i] > 0.0 {
            for (l, m) in light[i].iter_mut().zip(mirrored[i]) {
                *l += share[i] * m;
            }
        }
    }
}

/// Bodies that may throw a shadow between a cluster of points and a lamp.
#[inline(always)]
fn between(scene: &Scene, from: V3, spread: f32, to: V3, size: f32, near: &mut Vec<u16>) {
    near.clear();
    let axis = sub(to, from);
    let length2 = dot(axis, axis).max(1e-9);
    for (index, body) in scene.bodies.iter().enumerate().filter(|(_, b)| b.shadow) {
        let c = sub(body.placed.centre(), from);
        let along = (dot(c, axis) / length2).clamp(0.0, 1.0);
        let off = add_scaled(c, axis, -along);
        let reach = body.placed.bound() + spread + size * along;
        if dot(off, off) < reach * reach {
            near.push(index as u16);
        }
    }
}

/// Which of eight segments are free of bodies.
pub fn is_clear(scene: &Scene, from: &[V3; LANES], to: &[V3; LANES]) -> [bool; LANES] {
    let (mut origin, mut direction) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
    for i in 0..LANES {
        for k in 0..3 {
            origin[k][i] = from[i][k];
            direction[k][i] = to[i][k] - from[i][k];
        }
    }
    let mut packet = Packet::new(origin, direction, [1.0; LANES]);
    for (index, body) in scene.bodies.iter().enumerate() {
        body.placed.intersect(&mut packet, index as u32);
    }
    packet.body.map(|body| body == u32::MAX)
}

/// Share of eight segments that are free of bodies.
pub fn clear_share(scene: &Scene, from: &[V3; LANES], to: &[V3; LANES]) -> f64 {
    is_clear(scene, from, to).iter().filter(|&&free| free).count() as f64 / LANES as f64
}
