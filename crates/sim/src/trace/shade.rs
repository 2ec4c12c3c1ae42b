//! Light at the points where rays end.

use super::Stage;
use super::packet::{LANES, NEAR, Packet, V3, add_scaled, dot, normalize, scaled, sub};
use super::shape::{Solid, part};
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
    kind: Kind,
}

/// How a surface is lit.
#[derive(Clone, Copy, Default, PartialEq)]
enum Kind {
    /// The ray met nothing.
    #[default]
    Nothing,
    /// By shadow rays.
    Object,
    /// From the light map, with reflections.
    Table,
    /// Without shadows.
    Room,
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
/// `mirrored` are the bodies that the table may mirror.
#[inline(always)]
pub fn shade(
    stage: &Stage,
    packet: &Packet,
    phase: &Phase,
    pixel: f32,
    mirrored: &[u16],
    scratch: &mut Vec<u16>,
) -> Light {
    let scene = &stage.scene;
    let surfaces = surfaces(scene, packet, pixel);
    let mut light = [[0.0; LAYERS]; LANES];
    for (s, l) in surfaces.iter().zip(&mut light) {
        match s.kind {
            Kind::Nothing | Kind::Object => {}
            Kind::Table => on_table(stage, s, l),
            Kind::Room => in_the_open(scene, s, l),
        }
    }
    if let Some(cluster) = Cluster::of(&surfaces) {
        contact(scene, &surfaces, &cluster, &mut light, scratch);
        for lamp in &scene.lamps {
            illuminate(scene, lamp, &surfaces, &cluster, phase, &mut light, scratch);
        }
    }
    if surfaces.iter().any(|s| s.kind == Kind::Table) {
        reflect(scene, &surfaces, mirrored, pixel, &mut light);
    }
    light
}

/// Ambient light on a surface that nothing covers.
#[inline(always)]
fn ambient(scene: &Scene, s: &Surface) -> f32 {
    let up = 0.5 + 0.5 * s.normal[2];
    s.albedo * (scene.ambient[0] * up + scene.ambient[1] * (1.0 - up))
}

/// Light that a surface sends to the viewer for a unit of light from direction `d`.
#[inline(always)]
fn response(scene: &Scene, s: &Surface, d: V3) -> f32 {
    let cos = dot(s.normal, d);
    if cos <= 0.0 {
        return 0.0;
    }
    let material = &scene.bodies[s.body].material;
    let mut share = s.albedo;
    if material.gloss > 0.0 {
        let mirrored = add_scaled(s.view, s.normal, -2.0 * dot(s.view, s.normal));
        let along = dot(mirrored, d).max(0.0);
        // Phong's lobe with exponent 32, normalised.
        let a2 = along * along;
        let a8 = (a2 * a2) * (a2 * a2);
        share += material.gloss * 17.0 * (a8 * a8) * (a8 * a8);
    }
    cos * share
}

/// A surface lit by all lamps without shadows: walls, floor, and whatever is seen in a mirror.
#[inline(always)]
fn in_the_open(scene: &Scene, s: &Surface, light: &mut [f32; LAYERS]) {
    let material = &scene.bodies[s.body].material;
    light[Layer::Screen as usize] += material.glow * s.albedo;
    light[Layer::Steady as usize] += ambient(scene, s);
    for lamp in &scene.lamps {
        let to = sub(lamp.centre, s.point);
        let distance2 = dot(to, to).max(0.1);
        let d = scaled(to, 1.0 / distance2.sqrt());
        light[lamp.layer as usize] += lamp.intensity / distance2 * response(scene, s, d);
    }
}

/// The table: shadows from the light map.
#[inline(always)]
fn on_table(stage: &Stage, s: &Surface, light: &mut [f32; LAYERS]) {
    let scene = &stage.scene;
    let texel = stage.table_light.at(scene, s.point);
    light[Layer::Steady as usize] += ambient(scene, s) * texel[0];
    for (lamp, visible) in scene.lamps.iter().zip(&texel[1..]) {
        let to = sub(lamp.centre, s.point);
        let distance2 = dot(to, to).max(0.1);
        let d = scaled(to, 1.0 / distance2.sqrt());
        light[lamp.layer as usize] += visible * lamp.intensity / distance2 * response(scene, s, d);
    }
}

/// What the eight rays have met.
#[inline(always)]
fn surfaces(scene: &Scene, packet: &Packet, pixel: f32) -> [Surface; LANES] {
    let mut surfaces = [Surface::default(); LANES];
    let (mut local, mut normals) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
    let mut plain = [false; LANES];
    for (i, s) in surfaces.iter_mut().enumerate() {
        let index = packet.body[i] as usize;
        let Some(body) = scene.bodies.get(index) else { continue };
        let (point, view) = (packet.point(i), packet.heading(i));
        let p = body.placed.local(point);
        let (mut n, part) = body.placed.normal(p, packet.part[i]);
        let mut normal = body.placed.outward(n);
        if dot(normal, view) > 0.0 {
            normal = scaled(normal, -1.0);
            n = scaled(n, -1.0);
        }
        for k in 0..3 {
            local[k][i] = p[k];
            normals[k][i] = n[k];
        }
        plain[i] = part >= part::TOP && body.placed.solid.is_round();
        let kind = match (body.mirror, body.shadow) {
            (true, _) if normal[2] > 0.9 => Kind::Table,
            (_, true) => Kind::Object,
            _ => Kind::Room,
        };
        *s = Surface { point, normal, view, albedo: 0.0, body: index, kind };
    }
    // A pixel is longer on a surface that is seen at a flat angle.
    let mut footprint = [0.0; LANES];
    for (i, s) in surfaces.iter().enumerate() {
        footprint[i] = packet.t[i] * pixel / (-dot(s.view, s.normal)).max(0.25);
    }
    // Textures of all eight lanes at once; packets rarely show more than one body.
    let mut done = [false; LANES];
    for i in 0..LANES {
        if done[i] || surfaces[i].kind == Kind::Nothing {
            continue;
        }
        let index = surfaces[i].body;
        let body = &scene.bodies[index];
        let material = &body.material;
        let extent = match &body.placed.solid {
            Solid::Box(half) => Extent::Flat(*half),
            Solid::Faceted(facets) => Extent::Flat(facets.half()),
            Solid::Frustum { bottom, top, .. } | Solid::Cup { bottom, top, .. } => {
                Extent::Round(0.5 * (bottom + top))
            }
            Solid::Sphere(radius) | Solid::Capsule { radius, .. } => Extent::Round(*radius),
        };
        let factors = material.texture.factors(&local, &normals, extent, &footprint, material.seed);
        for j in i..LANES {
            if surfaces[j].kind != Kind::Nothing && surfaces[j].body == index {
                done[j] = true;
                let factor = if plain[j] { 1.0 } else { factors[j] };
                surfaces[j].albedo = (material.albedo * factor).min(0.95);
            }
        }
    }
    surfaces
}

/// The points of a packet that lie on objects: middle and radius.
struct Cluster {
    centre: V3,
    spread: f32,
}

impl Cluster {
    #[inline(always)]
    fn of(surfaces: &[Surface; LANES]) -> Option<Self> {
        let on_objects = || surfaces.iter().filter(|s| s.kind == Kind::Object);
        let count = on_objects().count();
        if count == 0 {
            return None;
        }
        let mut centre = [0.0; 3];
        for s in on_objects() {
            centre = add_scaled(centre, s.point, 1.0 / count as f32);
        }
        let mut spread2 = 0.0f32;
        for s in on_objects() {
            let d = sub(s.point, centre);
            spread2 = spread2.max(dot(d, d));
        }
        Some(Cluster { centre, spread: spread2.sqrt() })
    }
}

/// Ambient light on objects, less what their neighbours cover.
#[inline(always)]
fn contact(
    scene: &Scene,
    surfaces: &[Surface; LANES],
    cluster: &Cluster,
    light: &mut Light,
    near: &mut Vec<u16>,
) {
    neighbours(scene, cluster.centre, cluster.spread, near);
    for (s, l) in surfaces.iter().zip(light.iter_mut()).filter(|(s, _)| s.kind == Kind::Object) {
        let open = openness(scene, near, s.body, s.point, s.normal);
        l[Layer::Steady as usize] += ambient(scene, s) * open;
    }
}

/// Bodies near enough to darken points around a place.
pub fn neighbours(scene: &Scene, centre: V3, spread: f32, near: &mut Vec<u16>) {
    near.clear();
    for (index, body) in scene.bodies.iter().enumerate() {
        let d = sub(body.placed.centre(), centre);
        let reach = spread + 4.0 * body.placed.bound();
        if body.shadow && dot(d, d) < reach * reach {
            near.push(index as u16);
        }
    }
}

/// Share of the sky that neighbours leave open: each hides what its bounding sphere covers.
#[inline(always)]
pub fn openness(scene: &Scene, near: &[u16], own: usize, point: V3, normal: V3) -> f32 {
    let mut open = 1.0;
    for &index in near.iter().filter(|&&k| usize::from(k) != own) {
        let placed = &scene.bodies[usize::from(index)].placed;
        let d = sub(placed.centre(), point);
        let d2 = dot(d, d).max(1e-6);
        // The bounding sphere is larger than the body: 0.6 of its section is about right.
        let share = 0.6 * placed.bound() * placed.bound() / d2;
        let cos = dot(d, normal) / d2.sqrt();
        open *= 1.0 - (share * cos.max(0.0)).min(0.75);
    }
    open
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

/// Target of a shadow ray on a lamp.
#[inline(always)]
pub fn lamp_point(lamp: &Lamp, phase: usize, probe: usize) -> V3 {
    let [u, v] = PROBES[phase & 3][probe & 3];
    add_scaled(add_scaled(lamp.centre, lamp.edges[0], u), lamp.edges[1], v)
}

/// Adds a lamp's light on objects, with soft shadows.
#[inline(always)]
fn illuminate(
    scene: &Scene,
    lamp: &Lamp,
    surfaces: &[Surface; LANES],
    cluster: &Cluster,
    phase: &Phase,
    light: &mut Light,
    near: &mut Vec<u16>,
) {
    between(scene, cluster.centre, cluster.spread, lamp, near);
    for probe in 0..4 {
        let mut packet = Packet::idle();
        for (i, s) in surfaces.iter().enumerate().filter(|(_, s)| s.kind == Kind::Object) {
            let from = add_scaled(s.point, s.normal, NEAR);
            packet.aim(i, from, lamp_point(lamp, usize::from(phase[i]), probe));
        }
        let reach = packet.t;
        cast(scene, near, &mut packet);
        for (i, s) in surfaces.iter().enumerate().filter(|(_, s)| s.kind == Kind::Object) {
            if packet.body[i] == u32::MAX {
                let strength = 0.25 * lamp.intensity / (reach[i] * reach[i]).max(0.1);
                light[i][lamp.layer as usize] += strength * response(scene, s, packet.heading(i));
            }
        }
    }
}

/// Reflections of the scene in the table (Schlick's law).
#[inline(always)]
fn reflect(
    scene: &Scene,
    surfaces: &[Surface; LANES],
    mirrored: &[u16],
    pixel: f32,
    light: &mut Light,
) {
    let mut packet = Packet::idle();
    let mut share = [0.0; LANES];
    for (i, s) in surfaces.iter().enumerate().filter(|(_, s)| s.kind == Kind::Table) {
        let cos = -dot(s.view, s.normal);
        let direction = normalize(add_scaled(s.view, s.normal, 2.0 * cos));
        for k in 0..3 {
            packet.origin[k][i] = s.point[k] + NEAR * s.normal[k];
            packet.direction[k][i] = direction[k];
        }
        packet.t[i] = f32::INFINITY;
        let gloss = scene.bodies[s.body].material.gloss;
        share[i] = gloss + (1.0 - gloss) * 0.6 * (1.0 - cos).clamp(0.0, 1.0).powi(5);
    }
    cast(scene, mirrored, &mut packet);
    // A rough table blurs what it mirrors: textures are filtered as if ten pixels wide.
    let seen = self::surfaces(scene, &packet, 10.0 * pixel);
    for (i, s) in seen.iter().enumerate().filter(|(_, s)| s.kind != Kind::Nothing) {
        let mut mirrored = [0.0; LAYERS];
        in_the_open(scene, s, &mut mirrored);
        for (l, m) in light[i].iter_mut().zip(mirrored) {
            *l += share[i] * m;
        }
    }
}

/// Bodies that may throw a shadow between a cluster of points and a lamp.
#[inline(always)]
pub fn between(scene: &Scene, from: V3, spread: f32, lamp: &Lamp, near: &mut Vec<u16>) {
    near.clear();
    let size = lamp.edges.iter().map(|e| dot(*e, *e)).sum::<f32>().sqrt();
    let axis = sub(lamp.centre, from);
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
