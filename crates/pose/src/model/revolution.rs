//! Cylinders, cups and balls: rims as chords, limbs where the wall turns away from the eye.

use std::f64::consts::TAU;

use nalgebra::Vector3;

use super::{Contour, Kind, Segment};

/// A frustum about z, centred: cylinder or cup.
///
/// A cup is open at the top; seen from above its inner wall appears, but the whole outer rim stays
/// visible as it does for a lid, and the wall's thickness is not known, so both are one model.
#[derive(Debug, Clone, PartialEq)]
pub struct Frustum {
    top: f64,
    bottom: f64,
    half_height: f64,
}

impl Frustum {
    /// Radii at the top and at the bottom, and the height (m).
    pub fn new(top: f64, bottom: f64, height: f64) -> Self {
        Frustum { top, bottom, half_height: height / 2.0 }
    }

    /// Appends the visible contour with `chords` chords for a whole rim.
    pub fn contour(&self, eye: &Vector3<f64>, chords: usize, out: &mut Contour) {
        // The wall's outward normal at azimuth t is (cos t, sin t, -slope); it faces the eye where
        // ex cos t + ey sin t > radius at the eye's own height, extrapolated along the wall.
        let slope = (self.top - self.bottom) / (2.0 * self.half_height);
        let reach = (self.top + self.bottom) / 2.0 + slope * eye.z;
        let across = eye.x.hypot(eye.y);
        let towards = eye.y.atan2(eye.x);
        // Half the azimuth range of the wall that faces the eye.
        let half = (reach / across.max(1e-12)).clamp(-1.0, 1.0).acos();
        let (top_seen, bottom_seen) = (eye.z > self.half_height, eye.z < -self.half_height);
        self.rim(self.top, self.half_height, top_seen, towards, half, chords, out);
        self.rim(self.bottom, -self.half_height, bottom_seen, towards, half, chords, out);
        if half > 0.0 && half < TAU / 2.0 {
            for t in [towards - half, towards + half] {
                let (sin, cos) = t.sin_cos();
                out.push(Segment {
                    from: Vector3::new(self.top * cos, self.top * sin, self.half_height),
                    to: Vector3::new(self.bottom * cos, self.bottom * sin, -self.half_height),
                    kind: Kind::Silhouette,
                    away: None,
                });
            }
        }
    }

    /// One rim: where the wall below it is seen it borders cap and wall (a crease) or, with the cap
    /// turned away, wall and background; elsewhere only a visible cap shows it.
    fn rim(
        &self,
        radius: f64,
        z: f64,
        cap: bool,
        towards: f64,
        half: f64,
        chords: usize,
        out: &mut Contour,
    ) {
        let outward = Vector3::new(0.0, 0.0, z.signum());
        let near = match cap {
            true => (Kind::Crease, None),
            false => (Kind::Silhouette, Some(outward)),
        };
        arc(radius, z, towards - half, 2.0 * half, near, chords, out);
        if cap {
            let far = (Kind::Silhouette, None);
            arc(radius, z, towards + half, TAU - 2.0 * half, far, chords, out);
        }
    }
}

fn arc(
    radius: f64,
    z: f64,
    start: f64,
    length: f64,
    (kind, away): (Kind, Option<Vector3<f64>>),
    chords: usize,
    out: &mut Contour,
) {
    let n = (length / TAU * chords as f64).ceil() as usize;
    if n == 0 || length < 1e-9 {
        return;
    }
    let (sin, cos) = (length / n as f64).sin_cos();
    // Chords of the circle that is as far outside at the corners as inside at the middles.
    let r = radius * 2.0 / (1.0 + (length / (2.0 * n as f64)).cos());
    let mut p = Vector3::new(r * start.cos(), r * start.sin(), z);
    for _ in 0..n {
        let next = Vector3::new(p.x * cos - p.y * sin, p.x * sin + p.y * cos, z);
        out.push(Segment { from: p, to: next, kind, away });
        p = next;
    }
}

/// Appends the outline of a ball: the circle where the lines of sight touch it.
pub fn sphere_outline(radius: f64, eye: &Vector3<f64>, chords: usize, out: &mut Contour) {
    let distance = eye.norm();
    if distance <= radius {
        return;
    }
    let axis = eye / distance;
    let height = radius * radius / distance;
    let r = (radius * radius - height * height).sqrt();
    let other = if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let u = axis.cross(&other).normalize();
    let v = axis.cross(&u);
    let at = |k: usize| {
        let (sin, cos) = (TAU * k as f64 / chords as f64).sin_cos();
        axis * height + (u * cos + v * sin) * r
    };
    for k in 0..chords {
        out.push(Segment { from: at(k), to: at(k + 1), kind: Kind::Silhouette, away: None });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limbs_touch_the_line_of_sight() {
        let cup = Frustum::new(0.05, 0.03, 0.1);
        let eye = Vector3::new(0.4, -0.3, 0.25);
        let mut out = Contour::new();
        cup.contour(&eye, 72, &mut out);
        let limbs: Vec<_> = out.iter().filter(|s| (s.from.z - s.to.z).abs() > 0.05).collect();
        assert_eq!(limbs.len(), 2);
        for limb in limbs {
            let azimuth = limb.from.y.atan2(limb.from.x);
            let normal = Vector3::new(azimuth.cos(), azimuth.sin(), -0.2);
            for p in [limb.from, limb.to] {
                assert!(normal.dot(&(eye - p)).abs() < 1e-12, "{}", normal.dot(&(eye - p)));
            }
        }
    }

    #[test]
    fn a_lid_shows_its_whole_rim_and_half_of_the_foot() {
        let can = Frustum::new(0.04, 0.04, 0.1);
        let mut out = Contour::new();
        can.contour(&Vector3::new(10.0, 0.0, 10.0), 72, &mut out);
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
        sphere_outline(0.05, &eye, 24, &mut out);
        for s in &out {
            assert!((s.from.norm() - 0.05).abs() < 1e-12);
            assert!(s.from.dot(&(eye - s.from)).abs() < 1e-12);
        }
    }
}
