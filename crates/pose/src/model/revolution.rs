//! Cylinders, cups and balls: rims as chords, limbs where the wall turns away from the eye.

use std::f64::consts::TAU;

use nalgebra::{Vector2, Vector3};

use super::{Hit, Kind, Line, Outline};

/// A frustum about z, centred: cylinder or cup.
///
/// A cup is open at the top; seen from above its inner wall appears, but the whole outer rim stays
/// visible as it does for a lid, so both are one model but for the kind of the rim's contour.
#[derive(Debug, Clone, PartialEq)]
pub struct Frustum {
    top: f64,
    bottom: f64,
    half_height: f64,
    open: bool,
}

impl Frustum {
    /// Radii at the top and at the bottom, the height (m), and whether the top is open.
    pub fn new(top: f64, bottom: f64, height: f64, open: bool) -> Self {
        Frustum { top, bottom, half_height: height / 2.0, open }
    }

    /// Outward normal of the wall (unit) where it is nearest to a direction.
    pub(super) fn wall(&self, direction: &Vector3<f64>) -> Vector3<f64> {
        let radial = direction.xy().try_normalize(1e-9).unwrap_or(Vector2::x());
        radial.push(-self.slope()).normalize()
    }

    /// How much the radius grows with the height.
    fn slope(&self) -> f64 {
        (self.top - self.bottom) / (2.0 * self.half_height)
    }

    /// Writes the visible contour with `chords` chords for a whole rim.
    pub(super) fn outline(&self, eye: &Vector3<f64>, chords: usize, out: &mut Outline) {
        // The wall's outward normal at azimuth t is (cos t, sin t, -slope); it faces the eye where
        // ex cos t + ey sin t > radius at the eye's own height, extrapolated along the wall.
        let slope = self.slope();
        let reach = (self.top + self.bottom) / 2.0 + slope * eye.z;
        let across = eye.x.hypot(eye.y);
        let towards = eye.y.atan2(eye.x);
        // Half the azimuth range of the wall that faces the eye.
        let cos_half = (reach / across.max(1e-12)).clamp(-1.0, 1.0);
        let half = cos_half.acos();
        // Where that range begins and ends. Rotations are made from what is known: the search asks
        // for thousands of outlines, and sines would take much of its time.
        let facing = match across > 0.0 {
            true => Vector2::new(eye.x, eye.y) / across,
            false => Vector2::x(),
        };
        let to_side = Vector2::new(cos_half, (1.0 - cos_half * cos_half).sqrt());
        let begin = turned(&facing, &Vector2::new(to_side.x, -to_side.y));
        let end = turned(&facing, &to_side);
        let near = Arc { start: towards - half, from: begin, length: 2.0 * half };
        let far = Arc { start: towards + half, from: end, length: TAU - 2.0 * half };
        let (top_seen, bottom_seen) = (eye.z > self.half_height, eye.z < -self.half_height);
        self.rim(self.top, self.half_height, top_seen, [near, far], chords, out);
        self.rim(self.bottom, -self.half_height, bottom_seen, [near, far], chords, out);
        if half > 0.0 && half < TAU / 2.0 {
            for (side, direction) in [begin, end].into_iter().enumerate() {
                let first = out.points.len() as u16;
                out.points.push((self.top * direction).push(self.half_height));
                out.points.push((self.bottom * direction).push(-self.half_height));
                let ends = [first, first + 1];
                let (away, part) = (Some(direction.push(-slope).normalize()), side as u16);
                out.lines.push(Line { ends, kind: Kind::Limb, away, part, along: 0.0 });
            }
        }
    }

    /// As [`super::Model::reach`].
    pub(super) fn reach(&self, direction: &Vector3<f64>) -> f64 {
        let (up, out) = (self.half_height * direction.z, direction.xy().norm());
        (self.top * out + up).max(self.bottom * out - up)
    }

    /// Where a ray from the eye first meets the body from outside. What is seen through an open top is
    /// no part of it.
    pub(super) fn first_hit(&self, eye: &Vector3<f64>, along: &Vector3<f64>) -> Option<Hit> {
        let (slope, middle) = (self.slope(), (self.top + self.bottom) / 2.0);
        // |x, y|^2 = radius(z)^2 along the ray.
        let (at_eye, grows) = (middle + slope * eye.z, slope * along.z);
        let a = along.xy().norm_squared() - grows * grows;
        let b = eye.xy().dot(&along.xy()) - at_eye * grows;
        let c = eye.xy().norm_squared() - at_eye * at_eye;
        // Not a number where the ray passes the wall by: then it is in no height.
        let wall = (-b - (b * b - a * c).sqrt()) / a;
        let meets = |distance: f64| eye + along * distance;
        if wall > 0.0 && meets(wall).z.abs() <= self.half_height {
            let normal = self.wall(&meets(wall));
            return Some(Hit { distance: wall, normal, part: 0 });
        }
        let up = eye.z.signum();
        let (radius, part) = if up > 0.0 { (self.top, TOP) } else { (self.bottom, BOTTOM) };
        let distance = (up * self.half_height - eye.z) / along.z;
        let met = distance > 0.0 && meets(distance).xy().norm() <= radius;
        let cap = met && eye.z.abs() > self.half_height && !(self.open && up > 0.0);
        cap.then_some(Hit { distance, normal: Vector3::z() * up, part })
    }

    /// One rim: where the wall below it is seen it borders cap and wall (a crease) or, with the cap
    /// turned away, wall and background; elsewhere only a visible cap shows it.
    fn rim(
        &self,
        radius: f64,
        z: f64,
        cap: bool,
        [near, far]: [Arc; 2],
        chords: usize,
        out: &mut Outline,
    ) {
        let outward = Vector3::new(0.0, 0.0, z.signum());
        let open = self.open && z > 0.0;
        let kind = match cap {
            true => (if open { Kind::Rim } else { Kind::Crease }, None),
            false => (Kind::Silhouette, Some(outward)),
        };
        near.chords(radius, z, kind, chords, out);
        if cap {
            let kind = (if open { Kind::Rim } else { Kind::Silhouette }, None);
            far.chords(radius, z, kind, chords, out);
        }
    }
}

/// Numbers of the rims; the wall's two sides come before.
const TOP: u16 = 2;
const BOTTOM: u16 = 3;

/// Where a ray from the eye first meets a ball.
pub(super) fn sphere_hit(radius: f64, eye: &Vector3<f64>, along: &Vector3<f64>) -> Option<Hit> {
    let (a, b) = (along.norm_squared(), eye.dot(along));
    let root = b * b - a * (eye.norm_squared() - radius * radius);
    let distance = (-b - root.sqrt()) / a;
    let met = root > 0.0 && distance > 0.0;
    met.then(|| Hit { distance, normal: (eye + along * distance) / radius, part: 0 })
}

/// A range of azimuths.
#[derive(Clone, Copy)]
struct Arc {
    /// Where it begins (rad), and the unit vector there.
    start: f64,
    from: Vector2<f64>,
    /// How far it goes on (rad).
    length: f64,
}

impl Arc {
    /// Writes a rim's chords over this range.
    fn chords(
        &self,
        radius: f64,
        z: f64,
        (kind, away): (Kind, Option<Vector3<f64>>),
        of_circle: usize,
        out: &mut Outline,
    ) {
        let n = (self.length / TAU * of_circle as f64).ceil() as usize;
        if n == 0 || self.length < 1e-9 {
            return;
        }
        let chord = self.length / n as f64;
        let (sin, cos) = chord.sin_cos();
        let step = Vector2::new(cos, sin);
        // Chords of the circle that is as far outside at the corners as inside at the middles.
        let middle = (0.5 * (1.0 + cos)).sqrt();
        let part = if z > 0.0 { TOP } else { BOTTOM };
        let mut p = self.from * (radius * 2.0 / (1.0 + middle));
        let start = self.start.rem_euclid(TAU);
        for k in 0..n {
            let first = out.points.len() as u16;
            out.points.push(p.push(z));
            let azimuth = start + chord * k as f64;
            let along = radius * if azimuth < TAU { azimuth } else { azimuth - TAU };
            out.lines.push(Line { ends: [first, first + 1], kind, away, part, along });
            p = turned(&p, &step);
        }
        out.points.push(p.push(z));
    }
}

/// A vector turned by the angle of a unit vector.
fn turned(v: &Vector2<f64>, by: &Vector2<f64>) -> Vector2<f64> {
    Vector2::new(v.x * by.x - v.y * by.y, v.x * by.y + v.y * by.x)
}

/// Parts of a ball's outline. Where it is lit from the side its wall darkens towards the outline, and
/// what is seen lies further inside than where it is lit from before: no part is off like all others.
const ARCS: u16 = 6;

/// Writes the outline of a ball: the circle where the lines of sight touch it.
pub(super) fn sphere_outline(radius: f64, eye: &Vector3<f64>, chords: usize, out: &mut Outline) {
    let distance = eye.norm();
    if distance <= radius {
        return;
    }
    let axis = eye / distance;
    let height = radius * radius / distance;
    let r = (radius * radius - height * height).sqrt();
    // Eyes that see a ball together look the same way, and seldom along x: the arcs have the same
    // numbers for both.
    let other = if axis.x.abs() < 0.95 { Vector3::x() } else { Vector3::y() };
    let u = axis.cross(&other).normalize();
    let v = axis.cross(&u);
    let at = |k: usize| {
        let (sin, cos) = (TAU * k as f64 / chords as f64).sin_cos();
        axis * height + (u * cos + v * sin) * r
    };
    out.points.extend((0..chords).map(at));
    for k in 0..chords as u16 {
        let ends = [k, (k + 1) % chords as u16];
        let along = r * TAU * f64::from(k) / chords as f64;
        let part = ARCS * k / chords as u16;
        let middle = out.points[usize::from(ends[0])] + out.points[usize::from(ends[1])];
        let away = Some(middle.normalize());
        out.lines.push(Line { ends, kind: Kind::Limb, away, part, along });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Contour, Model};

    #[test]
    fn limbs_touch_the_line_of_sight() {
        let cup = Frustum::new(0.05, 0.03, 0.1, true);
        let eye = Vector3::new(0.4, -0.3, 0.25);
        let mut out = Contour::new();
        Model::Frustum(cup).contour(&eye, true, &mut out);
        let limbs: Vec<_> = out.iter().filter(|s| (s.from.z - s.to.z).abs() > 0.05).collect();
        assert_eq!(limbs.len(), 2);
        for limb in limbs {
            let normal = limb.away.unwrap();
            let azimuth = limb.from.y.atan2(limb.from.x);
            let across = Vector3::new(azimuth.cos(), azimuth.sin(), -0.2).normalize();
            assert!((normal - across).norm() < 1e-12);
            assert_eq!(limb.kind, Kind::Limb);
            for p in [limb.from, limb.to] {
                assert!(normal.dot(&(eye - p)).abs() < 1e-12, "{}", normal.dot(&(eye - p)));
            }
        }
    }

    #[test]
    fn a_lid_shows_its_whole_rim_and_half_of_the_foot() {
        let can = Frustum::new(0.04, 0.04, 0.1, false);
        let mut out = Contour::new();
        Model::Frustum(can).contour(&Vector3::new(10.0, 0.0, 10.0), true, &mut out);
        let length = |z: f64| {
            out.iter()
                .filter(|s| s.from.z == z && s.to.z == z)
                .map(|s| (s.to - s.from).norm())
                .sum::<f64>()
        };
        assert!((length(0.05) / (TAU * 0.04) - 1.0).abs() < 0.01);
        assert!((length(-0.05) / (TAU * 0.02) - 1.0).abs() < 0.01);
    }

    #[test]
    fn a_ball_is_touched_by_every_line_of_sight() {
        let eye = Vector3::new(0.3, 0.5, -0.2);
        let mut out = Contour::new();
        Model::Sphere(0.05).contour(&eye, true, &mut out);
        for s in &out {
            assert!((s.from.norm() - 0.05).abs() < 1e-12);
            assert!(s.from.dot(&(eye - s.from)).abs() < 1e-12);
        }
    }
}
