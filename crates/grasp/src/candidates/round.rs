//! Round bodies: cylinders and cups from the side, over an end and over the rim, and balls.
//!
//! **Unknown handle.** A record's cup may have a handle at an azimuth that nobody tells. The place of
//! a landmark's housing is free of it, and so are the azimuths that the caller has seen free. A finger
//! may only come down outside a cup where no handle can be: at the azimuth of a housing that is at
//! least as wide as the finger, above or below it, or within a free range. So a cup is held by its rim
//! above its landmark unless more is known.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};

use nalgebra::Vector3;
use vergence_geometry::Solid;
use vergence_tag::Shape;

use super::{
    Grasp, HOUSING_GAP, Hold, LEAST_CONTACT, Maker, PALM_GAP, Pinch, Reserve, SPREAD, frame,
};
use crate::gripper::Levers;
use crate::object;

/// How deep fingers reach over a rim (m).
const RIM_DEPTH: f64 = 0.028;

impl Maker<'_> {
    pub(super) fn of_revolution(&self, height: f64) -> Vec<Grasp> {
        let mut grasps = Vec::new();
        for n in 0..24 {
            let azimuth = n as f64 * TAU / 24.0;
            let outward = radial(azimuth);
            let closing = radial(azimuth + FRAC_PI_2);
            if !self.no_handle(azimuth + FRAC_PI_2, None)
                || !self.no_handle(azimuth - FRAC_PI_2, None)
            {
                continue;
            }
            for tilt in [-60.0f64, -30.0, 0.0, 30.0, 60.0].map(f64::to_radians) {
                let approach = -outward * tilt.cos() - Vector3::z() * tilt.sin();
                for z in [0.0, 0.2, -0.2, 0.35, -0.35].map(|s| s * height) {
                    grasps.extend(self.across(azimuth, approach, closing, z, height));
                }
            }
            if n < 12 {
                for end in [1.0, -1.0] {
                    grasps.extend(self.over_the_end(closing, end, height));
                }
            }
        }
        grasps
    }

    fn across(
        &self,
        azimuth: f64,
        approach: Vector3<f64>,
        closing: Vector3<f64>,
        z: f64,
        height: f64,
    ) -> Option<Grasp> {
        // The palm must not meet a handle either.
        if !self.no_handle(azimuth, None) {
            return None;
        }
        let lateral = approach.cross(&closing);
        let radius = object::radius_at(self.record, z)?;
        let (level, upright) = (lateral.z.abs(), approach.z.abs());
        let solid = Solid::Cylinder { radius, half_height: height / 2.0 - z.abs() };
        // Across: up and down the wall when the hand is level; a tilted pad also leaves the round.
        let along = (height / 2.0 - z.abs()) * level + self.gripper.width / 2.0 * upright - 0.003;
        self.pinch(Pinch {
            hold: Hold::Side,
            centre: Vector3::z() * z,
            closing,
            approach,
            width: 2.0 * radius,
            front: radius * level + f64::min(solid.support(&approach), radius * upright),
            back: radius * level,
            across: along,
        })
    }

    fn over_the_end(&self, closing: Vector3<f64>, end: f64, height: f64) -> Option<Grasp> {
        let depth = f64::min(self.gripper.depth - PALM_GAP, height * 0.6);
        let z = end * (height / 2.0 - depth / 2.0);
        let width = [z, end * height / 2.0, end * (height / 2.0 - depth)]
            .into_iter()
            .filter_map(|z| object::radius_at(self.record, z))
            .fold(0.0, f64::max)
            * 2.0;
        self.pinch(Pinch {
            hold: Hold::Top,
            centre: Vector3::z() * z,
            closing,
            approach: -Vector3::z() * end,
            width,
            front: depth / 2.0,
            back: depth / 2.0,
            across: self.gripper.width / 2.0 - 0.002,
        })
    }

    /// One finger inside the cup, one outside; the tip above the wall, its y axis outwards. The hand
    /// leans with the wall, so that both pads lie flat on it: on an edge they would turn the cup.
    pub(super) fn of_rim(&self, height: f64) -> Vec<Grasp> {
        let landmarks = self.record.landmarks.iter().map(|s| s.position[1].atan2(s.position[0]));
        let azimuths: Vec<f64> = landmarks.chain((0..24).map(|n| n as f64 * TAU / 24.0)).collect();
        azimuths.into_iter().filter_map(|azimuth| self.over_the_rim(azimuth, height)).collect()
    }

    fn over_the_rim(&self, azimuth: f64, height: f64) -> Option<Grasp> {
        let g = self.gripper;
        let top = height / 2.0;
        let room = self.room_above_housing(azimuth, height);
        let inside = height - self.assumed.wall - 0.004;
        // Half way between holding too little of the wall and touching housing or bottom.
        let balanced = |space: f64| (space + HOUSING_GAP + LEAST_CONTACT / 2.0) / 2.0;
        let depth = RIM_DEPTH.min(balanced(room)).min(balanced(inside));
        if depth < LEAST_CONTACT || !self.no_handle(azimuth, Some(top - depth / 2.0)) {
            return None;
        }
        let outer = object::radius_at(self.record, top - depth / 2.0)?;
        let tip = object::radius_at(self.record, top - depth)?.min(outer);
        // The inner finger in the middle of the hole at the depth of its tip.
        let hole = 2.0 * (tip - self.assumed.wall);
        let inner = (hole - g.thickness) / 2.0;
        let side = inner.min(SPREAD).min((g.opening - self.assumed.wall) / 2.0);
        let rim = object::radius_at(self.record, top)?;
        let lean = (rim - object::radius_at(self.record, top - depth)?).atan2(depth);
        let (sin, cos) = lean.sin_cos();
        let down = -Vector3::z() * cos - radial(azimuth) * sin;
        let outwards = radial(azimuth) * cos - Vector3::z() * sin;
        let middle = outer - self.assumed.wall / 2.0;
        Some(Grasp {
            hold: Hold::Rim,
            object_from_tip: frame(
                radial(azimuth) * middle
                    + Vector3::z() * (top - depth / 2.0)
                    + down * (depth / 2.0),
                down,
                outwards,
            ),
            width: self.assumed.wall,
            opening: self.assumed.wall + 2.0 * side,
            reserve: Reserve {
                // A flat pad on a round wall keeps its hold while it meets it within its width.
                across: g.width / 2.0,
                closing: side,
                approach: f64::min(depth - LEAST_CONTACT / 2.0, inside - depth + HOUSING_GAP)
                    .min(room - depth + HOUSING_GAP)
                    .min(g.depth - depth),
            },
            levers: Levers { twist: 0.0, pry: middle, contact: depth * 0.7 },
        })
    }

    /// Length of wall between the rim and the nearest housing below the finger (m).
    fn room_above_housing(&self, azimuth: f64, height: f64) -> f64 {
        let radius = self.assumed.housing;
        let below = |site: &vergence_tag::LandmarkSite| {
            let at = Vector3::from(site.position);
            let across = at.dot(&radial(azimuth + FRAC_PI_2)).abs();
            let outside = at.dot(&radial(azimuth)) > 0.0;
            (outside && across < radius + self.gripper.width / 2.0)
                .then(|| height / 2.0 - at.z - radius - HOUSING_GAP)
        };
        self.record.landmarks.iter().filter_map(below).fold(height, f64::min)
    }

    /// Whether a cup certainly has no handle where a finger comes down outside it. With `height`, the
    /// place above or below a housing counts as free.
    fn no_handle(&self, azimuth: f64, height: Option<f64>) -> bool {
        if !matches!(self.record.shape, Shape::Cup { .. }) {
            return true;
        }
        let Some(radius) = object::radius_at(self.record, height.unwrap_or(0.0)) else {
            return true;
        };
        let taken = (self.gripper.width / 2.0 + self.assumed.handle) / radius;
        let taken = taken.min(1.0).asin();
        let inside = |&(from, to): &(f64, f64)| {
            let span = (to - from).rem_euclid(TAU);
            let at = (azimuth - from).rem_euclid(TAU);
            at >= taken && at + taken <= span
        };
        let by_housing = |site: &vergence_tag::LandmarkSite| {
            // No handle's middle is nearer to a landmark than both half widths together.
            let kept = ((self.assumed.housing + self.assumed.handle) / radius).min(1.0).asin();
            let off = azimuth - site.position[1].atan2(site.position[0]);
            ((off + PI).rem_euclid(TAU) - PI).abs() <= kept - taken
        };
        self.free.iter().any(inside)
            || (height.is_some() && self.record.landmarks.iter().any(by_housing))
    }

    pub(super) fn of_sphere(&self, diameter: f64) -> Vec<Grasp> {
        let mut grasps = Vec::new();
        for n in 0..12 {
            let azimuth = n as f64 * TAU / 12.0;
            let closing = radial(azimuth + FRAC_PI_2);
            for tilt in [0.0, FRAC_PI_4, FRAC_PI_2] {
                let approach = -radial(azimuth) * tilt.cos() - Vector3::z() * tilt.sin();
                grasps.extend(self.pinch(Pinch {
                    hold: Hold::Side,
                    centre: Vector3::zeros(),
                    closing,
                    approach,
                    width: diameter,
                    front: diameter / 2.0,
                    back: diameter / 2.0,
                    across: self.gripper.width / 2.0 - 0.002,
                }));
            }
        }
        grasps
    }
}

fn radial(azimuth: f64) -> Vector3<f64> {
    Vector3::new(azimuth.cos(), azimuth.sin(), 0.0)
}
