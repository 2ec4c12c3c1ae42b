//! Eight rays at a time.
//!
//! Plain `[f32; 8]` loops that the compiler turns into vector code; one packet holds eight pixels,
//! or eight samples of one pixel, lamp or LED. Vectors are written out: the closures of
//! `array::map` are not inlined into functions that are compiled for wider vector units.

/// Rays in a packet.
pub const LANES: usize = 8;
/// One number per ray.
pub type Lane = [f32; LANES];
/// One vector per ray, components apart.
pub type Lane3 = [Lane; 3];
/// A point or direction in single precision.
pub type V3 = [f32; 3];

/// Nothing closer than this counts as a hit (m): keeps a surface from shading itself.
pub const NEAR: f32 = 2e-4;

/// Rays with their nearest hit so far.
#[derive(Clone, Copy)]
pub struct Packet {
    /// Origins in the base frame.
    pub origin: Lane3,
    /// Directions in the base frame, unit length unless the caller says otherwise.
    pub direction: Lane3,
    /// Distance of the nearest hit, or the ray's end.
    pub t: Lane,
    /// Index of the body hit; `u32::MAX` when none.
    pub body: [u32; LANES],
    /// Part of the body's surface that was hit, see [`super::shape::Solid`].
    pub part: [u32; LANES],
}

impl Packet {
    /// Rays that end at `reach`.
    #[inline(always)]
    pub fn new(origin: Lane3, direction: Lane3, reach: Lane) -> Self {
        Packet { origin, direction, t: reach, body: [u32::MAX; LANES], part: [0; LANES] }
    }

    /// Rays of no length, to be aimed one by one.
    #[inline(always)]
    pub fn idle() -> Self {
        let up = [[0.0; LANES], [0.0; LANES], [1.0; LANES]];
        Packet::new([[0.0; LANES]; 3], up, [0.0; LANES])
    }

    /// Makes ray `i` run from one point to another.
    #[inline(always)]
    pub fn aim(&mut self, i: usize, from: V3, to: V3) {
        let way = sub(to, from);
        let length = dot(way, way).sqrt();
        for k in 0..3 {
            self.origin[k][i] = from[k];
            self.direction[k][i] = way[k] / length;
        }
        self.t[i] = length;
    }

    /// The point that ray `i` has reached.
    #[inline(always)]
    pub fn point(&self, i: usize) -> V3 {
        let (o, d, t) = (&self.origin, &self.direction, self.t[i]);
        [o[0][i] + t * d[0][i], o[1][i] + t * d[1][i], o[2][i] + t * d[2][i]]
    }

    /// Direction of ray `i`.
    #[inline(always)]
    pub fn heading(&self, i: usize) -> V3 {
        [self.direction[0][i], self.direction[1][i], self.direction[2][i]]
    }
}

/// Scalar product.
#[inline(always)]
pub fn dot(a: V3, b: V3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// `a - b`.
#[inline(always)]
pub fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// `a + s b`.
#[inline(always)]
pub fn add_scaled(a: V3, b: V3, s: f32) -> V3 {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

/// `s a`.
#[inline(always)]
pub fn scaled(a: V3, s: f32) -> V3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// Unit vector.
#[inline(always)]
pub fn normalize(a: V3) -> V3 {
    scaled(a, 1.0 / dot(a, a).sqrt().max(1e-20))
}
