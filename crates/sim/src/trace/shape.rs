//! Solids and where rays meet them.
//!
//! In: a packet of rays in the base frame and a placed solid. Out: the packet with nearer hits. A
//! ray is taken to the solid's own frame, where every solid is centred on the origin and its axis
//! is z.

use std::sync::Arc;

use nalgebra::{Point3, Vector3};
use vergence_geometry::Transform;

use super::facets::Facets;
use super::packet::{
    LANES, Lane, Lane3, NEAR, Packet, V3, add_scaled, dot, normalize, scaled, sub,
};

/// Form of a solid; lengths in metres.
#[derive(Debug, Clone, PartialEq)]
pub enum Solid {
    /// Half sides.
    Box([f32; 3]),
    /// Cone frustum about z, closed.
    Frustum {
        /// Radius at the bottom.
        bottom: f32,
        /// Radius at the top.
        top: f32,
        /// Half height.
        half: f32,
    },
    /// Cone frustum about z, hollow and open at the top.
    Cup {
        /// Outer radius at the bottom.
        bottom: f32,
        /// Outer radius at the top.
        top: f32,
        /// Half height.
        half: f32,
        /// Thickness of wall and floor.
        wall: f32,
    },
    /// Radius.
    Sphere(f32),
    /// Cylinder about z with round ends.
    Capsule {
        /// Half length without the ends.
        half: f32,
        /// Radius.
        radius: f32,
    },
    /// A prism or a convex body.
    Faceted(Arc<Facets>),
}

impl Solid {
    /// Whether its wall is round.
    pub fn is_round(&self) -> bool {
        !matches!(self, Solid::Box(_) | Solid::Faceted(_))
    }
}

/// Part numbers of round solids; the parts of a box are told from the point, those of other flat bodies
/// are their facets.
pub mod part {
    /// Outer wall, or the only surface.
    pub const SIDE: u32 = 0;
    /// Flat bottom.
    pub const BOTTOM: u32 = 1;
    /// Flat top, or the rim of a cup.
    pub const TOP: u32 = 2;
    /// Inner wall of a cup.
    pub const INSIDE: u32 = 3;
    /// Inner floor of a cup.
    pub const FLOOR: u32 = 4;
}

/// A solid in its place.
#[derive(Debug, Clone)]
pub struct Placed {
    /// Form.
    pub solid: Solid,
    rotation: [V3; 3],
    centre: V3,
    bound: f32,
}

impl Placed {
    /// Puts a solid at a pose.
    pub fn new(solid: Solid, base_from_body: &Transform) -> Self {
        let m = base_from_body.rotation.to_rotation_matrix();
        // Rows of base_from_body's inverse: columns of its matrix.
        let rotation = [0, 1, 2].map(|k| {
            let axis: Vector3<f64> = m.matrix().column(k).into_owned();
            [axis.x as f32, axis.y as f32, axis.z as f32]
        });
        let c = base_from_body.translation.vector;
        let bound = match &solid {
            Solid::Box(half) => dot(*half, *half).sqrt(),
            Solid::Frustum { bottom, top, half } | Solid::Cup { bottom, top, half, .. } => {
                bottom.max(*top).hypot(*half)
            }
            Solid::Faceted(facets) => dot(facets.half(), facets.half()).sqrt(),
            Solid::Sphere(radius) => *radius,
            Solid::Capsule { half, radius } => half + radius,
        };
        Placed { solid, rotation, centre: [c.x as f32, c.y as f32, c.z as f32], bound }
    }

    /// The same solid after a motion in the base frame.
    pub fn moved(&self, motion: &Transform) -> Self {
        let double = |v: V3| Vector3::new(v[0], v[1], v[2]).map(f64::from);
        let single = |v: Vector3<f64>| [v.x as f32, v.y as f32, v.z as f32];
        Placed {
            rotation: self.rotation.map(|axis| single(motion.rotation * double(axis))),
            centre: single(motion.rotation * double(self.centre) + motion.translation.vector),
            ..self.clone()
        }
    }

    /// Centre of the bounding sphere.
    pub fn centre(&self) -> V3 {
        self.centre
    }

    /// Radius of the bounding sphere.
    pub fn bound(&self) -> f32 {
        self.bound
    }

    /// A point in the solid's own frame.
    #[inline(always)]
    pub fn local(&self, p: V3) -> V3 {
        self.local_direction(sub(p, self.centre))
    }

    /// A direction in the solid's own frame.
    #[inline(always)]
    pub fn local_direction(&self, v: V3) -> V3 {
        [dot(self.rotation[0], v), dot(self.rotation[1], v), dot(self.rotation[2], v)]
    }

    /// A direction of the solid's frame in the base frame.
    #[inline(always)]
    pub fn outward(&self, v: V3) -> V3 {
        let [x, y, z] = self.rotation;
        add_scaled(add_scaled(scaled(x, v[0]), y, v[1]), z, v[2])
    }

    /// True when a point (base frame) lies within the solid grown by `margin`; hollows count as in, and so
    /// does all of the box around facets.
    pub fn contains(&self, p: &Point3<f64>, margin: f32) -> bool {
        let [x, y, z] = self.local([p.x as f32, p.y as f32, p.z as f32]);
        let rho = x.hypot(y);
        let within =
            |h: V3| x.abs() < h[0] + margin && y.abs() < h[1] + margin && z.abs() < h[2] + margin;
        match &self.solid {
            Solid::Box(half) => within(*half),
            Solid::Faceted(facets) => within(facets.half()),
            Solid::Frustum { bottom, top, half } | Solid::Cup { bottom, top, half, .. } => {
                z.abs() < half + margin && rho < bottom.max(*top) + margin
            }
            Solid::Sphere(radius) => rho.hypot(z) < radius + margin,
            Solid::Capsule { half, radius } => {
                rho.hypot((z.abs() - half).max(0.0)) < radius + margin
            }
        }
    }

    /// Outward normal in the solid's frame at a surface point of it, and the part hit.
    #[inline(always)]
    pub fn normal(&self, p: V3, part: u32) -> (V3, u32) {
        match &self.solid {
            Solid::Faceted(facets) => (facets.normal(part), part),
            Solid::Box(h) => {
                let q = [p[0].abs() - h[0], p[1].abs() - h[1], p[2].abs() - h[2]];
                let k = (0..3).fold(0, |best, k| if q[k] > q[best] { k } else { best });
                let mut n = [0.0; 3];
                n[k] = p[k].signum();
                (n, 2 * k as u32 + u32::from(p[k] < 0.0))
            }
            Solid::Frustum { bottom, top, half } | Solid::Cup { bottom, top, half, .. } => {
                let slope = (top - bottom) / (2.0 * half);
                let rho = p[0].hypot(p[1]).max(1e-9);
                let side = normalize([p[0] / rho, p[1] / rho, -slope]);
                let n = match part {
                    part::SIDE => side,
                    part::BOTTOM => [0.0, 0.0, -1.0],
                    part::INSIDE => scaled(side, -1.0),
                    _ => [0.0, 0.0, 1.0],
                };
                (n, part)
            }
            Solid::Sphere(_) => (normalize(p), part),
            Solid::Capsule { half, .. } => {
                (normalize([p[0], p[1], p[2] - p[2].clamp(-*half, *half)]), part)
            }
        }
    }

    /// Shortens the rays of a packet that meet this solid.
    #[inline(always)]
    pub fn intersect(&self, packet: &mut Packet, index: u32) {
        let (mut o, mut d) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        for k in 0..3 {
            let r = self.rotation[k];
            for i in 0..LANES {
                o[k][i] = r[0] * (packet.origin[0][i] - self.centre[0])
                    + r[1] * (packet.origin[1][i] - self.centre[1])
                    + r[2] * (packet.origin[2][i] - self.centre[2]);
                d[k][i] = r[0] * packet.direction[0][i]
                    + r[1] * packet.direction[1][i]
                    + r[2] * packet.direction[2][i];
            }
        }
        let mut best = packet.t;
        let mut part = [0u32; LANES];
        match &self.solid {
            Solid::Faceted(facets) => facets.intersect(&o, &d, &mut best, &mut part),
            &Solid::Box(half) => slabs(&o, &d, half, &mut best),
            &Solid::Frustum { bottom, top, half } => {
                cone(&o, &d, [bottom, top], [-half, half], part::SIDE, &mut best, &mut part);
                disc(&o, &d, -half, [0.0, bottom], part::BOTTOM, &mut best, &mut part);
                disc(&o, &d, half, [0.0, top], part::TOP, &mut best, &mut part);
            }
            &Solid::Cup { bottom, top, half, wall } => {
                let floor = -half + wall;
                let foot = bottom + (top - bottom) * wall / (2.0 * half) - wall;
                cone(&o, &d, [bottom, top], [-half, half], part::SIDE, &mut best, &mut part);
                cone(&o, &d, [foot, top - wall], [floor, half], part::INSIDE, &mut best, &mut part);
                disc(&o, &d, -half, [0.0, bottom], part::BOTTOM, &mut best, &mut part);
                disc(&o, &d, floor, [0.0, foot], part::FLOOR, &mut best, &mut part);
                disc(&o, &d, half, [top - wall, top], part::TOP, &mut best, &mut part);
            }
            &Solid::Sphere(radius) => ball(&o, &d, 0.0, radius, &mut best),
            &Solid::Capsule { half, radius } => {
                cone(&o, &d, [radius; 2], [-half, half], part::SIDE, &mut best, &mut part);
                ball(&o, &d, half, radius, &mut best);
                ball(&o, &d, -half, radius, &mut best);
            }
        }
        for i in 0..LANES {
            let nearer = best[i] < packet.t[i];
            packet.t[i] = best[i];
            packet.body[i] = if nearer { index } else { packet.body[i] };
            packet.part[i] = if nearer { part[i] } else { packet.part[i] };
        }
    }
}

/// Entry into an axis-parallel box (exit when the ray starts inside).
#[inline(always)]
fn slabs(o: &Lane3, d: &Lane3, half: V3, best: &mut Lane) {
    let (mut near, mut far) = ([f32::NEG_INFINITY; LANES], [f32::INFINITY; LANES]);
    for k in 0..3 {
        for i in 0..LANES {
            let dk = if d[k][i].abs() < 1e-12 { 1e-12 } else { d[k][i] };
            let inverse = 1.0 / dk;
            let a = (-half[k] - o[k][i]) * inverse;
            let b = (half[k] - o[k][i]) * inverse;
            near[i] = near[i].max(a.min(b));
            far[i] = far[i].min(a.max(b));
        }
    }
    for i in 0..LANES {
        let t = if near[i] > NEAR { near[i] } else { far[i] };
        let hit = near[i] <= far[i] && t > NEAR && t < best[i];
        best[i] = if hit { t } else { best[i] };
    }
}

/// Lateral surface of a frustum with radii at the lower and upper end.
#[inline(always)]
fn cone(
    o: &Lane3,
    d: &Lane3,
    radii: [f32; 2],
    ends: [f32; 2],
    which: u32,
    best: &mut Lane,
    part: &mut [u32; LANES],
) {
    let slope = (radii[1] - radii[0]) / (ends[1] - ends[0]);
    let axis = radii[0] - slope * ends[0];
    for i in 0..LANES {
        let (ox, oy, oz, dx, dy, dz) = (o[0][i], o[1][i], o[2][i], d[0][i], d[1][i], d[2][i]);
        let radius = axis + slope * oz;
        let a = dx * dx + dy * dy - slope * slope * dz * dz;
        let a = if a.abs() < 1e-9 { 1e-9 } else { a };
        let b = ox * dx + oy * dy - slope * dz * radius;
        let c = ox * ox + oy * oy - radius * radius;
        let root2 = b * b - a * c;
        let root = root2.max(0.0).sqrt();
        let inverse = 1.0 / a;
        let (first, second) = ((-b - root) * inverse, (-b + root) * inverse);
        let (near, far) = (first.min(second), first.max(second));
        let valid = |t: f32| {
            let z = oz + t * dz;
            (z >= ends[0]) & (z <= ends[1]) & (t > NEAR)
        };
        let t = if valid(near) { near } else { far };
        let hit = valid(t) & (root2 > 0.0) & (t < best[i]);
        best[i] = if hit { t } else { best[i] };
        part[i] = if hit { which } else { part[i] };
    }
}

/// Flat ring (or disc) across z.
#[inline(always)]
fn disc(
    o: &Lane3,
    d: &Lane3,
    z: f32,
    radii: [f32; 2],
    which: u32,
    best: &mut Lane,
    part: &mut [u32; LANES],
) {
    for i in 0..LANES {
        let dz = if d[2][i].abs() < 1e-12 { 1e-12 } else { d[2][i] };
        let t = (z - o[2][i]) / dz;
        let (x, y) = (o[0][i] + t * d[0][i], o[1][i] + t * d[1][i]);
        let r2 = x * x + y * y;
        let inside = r2 <= radii[1] * radii[1] && r2 >= radii[0] * radii[0];
        let hit = inside && t > NEAR && t < best[i];
        best[i] = if hit { t } else { best[i] };
        part[i] = if hit { which } else { part[i] };
    }
}

/// Sphere on the z axis.
#[inline(always)]
fn ball(o: &Lane3, d: &Lane3, z: f32, radius: f32, best: &mut Lane) {
    for i in 0..LANES {
        let oz = o[2][i] - z;
        let a = d[0][i] * d[0][i] + d[1][i] * d[1][i] + d[2][i] * d[2][i];
        let b = o[0][i] * d[0][i] + o[1][i] * d[1][i] + oz * d[2][i];
        let c = o[0][i] * o[0][i] + o[1][i] * o[1][i] + oz * oz - radius * radius;
        let root2 = b * b - a * c;
        let root = root2.max(0.0).sqrt();
        let t = if -b - root > NEAR * a { (-b - root) / a } else { (-b + root) / a };
        let hit = root2 > 0.0 && t > NEAR && t < best[i];
        best[i] = if hit { t } else { best[i] };
    }
}
