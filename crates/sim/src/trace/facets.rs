//! Where rays meet solids with flat faces.

use super::packet::{LANES, Lane, Lane3, NEAR, V3, dot};
use crate::faces::Face;

/// A closed surface of plane polygons.
#[derive(Debug, Clone, PartialEq)]
pub struct Facets {
    facets: Vec<Facet>,
    /// Half sides of the box around the origin that holds it.
    half: V3,
}

/// One polygon.
#[derive(Debug, Clone, PartialEq)]
struct Facet {
    normal: V3,
    /// Distance of its plane from the origin, outwards.
    offset: f32,
    /// The axes that it is looked at across: the normal's largest is left out.
    axes: [usize; 2],
    /// Corners along those.
    corners: Vec<[f32; 2]>,
}

impl Facets {
    /// The surface of these faces.
    pub fn new(faces: &[Face]) -> Self {
        let corners = || faces.iter().flat_map(|face| &face.corners);
        let reach = |k: usize| corners().map(|c| c[k].abs()).fold(0.0, f64::max) as f32;
        Facets {
            facets: faces.iter().map(Facet::new).collect(),
            half: [reach(0), reach(1), reach(2)],
        }
    }

    /// Half sides of the box around the origin that holds it.
    pub fn half(&self) -> V3 {
        self.half
    }

    /// Outward normal of a facet by its number.
    #[inline(always)]
    pub fn normal(&self, facet: u32) -> V3 {
        self.facets.get(facet as usize).map_or([0.0, 0.0, 1.0], |facet| facet.normal)
    }

    /// Shortens the rays that meet it; `part` becomes the number of the facet.
    pub fn intersect(&self, o: &Lane3, d: &Lane3, best: &mut Lane, part: &mut [u32; LANES]) {
        for (which, facet) in self.facets.iter().enumerate() {
            for i in 0..LANES {
                let (from, way) = ([o[0][i], o[1][i], o[2][i]], [d[0][i], d[1][i], d[2][i]]);
                let across = dot(facet.normal, way);
                let t = (facet.offset - dot(facet.normal, from)) / across;
                // No ray within the plane: its t is not a number or endless.
                if t > NEAR && t < best[i] && facet.holds(&from, &way, t) {
                    best[i] = t;
                    part[i] = which as u32;
                }
            }
        }
    }
}

impl Facet {
    fn new(face: &Face) -> Self {
        let n = face.normal;
        let out = n.iamax();
        let axes = [(out + 1) % 3, (out + 2) % 3];
        let corners = face.corners.iter().map(|c| axes.map(|k| c[k] as f32));
        Facet {
            normal: [n.x as f32, n.y as f32, n.z as f32],
            offset: face.offset() as f32,
            axes,
            corners: corners.collect(),
        }
    }

    /// Whether a ray is within the polygon where it passes the plane: a line from there crosses the outline
    /// an odd number of times.
    fn holds(&self, from: &V3, way: &V3, t: f32) -> bool {
        let [x, y] = self.axes.map(|k| from[k] + t * way[k]);
        let mut inside = false;
        let mut a = self.corners[self.corners.len() - 1];
        for &b in &self.corners {
            if (a[1] > y) != (b[1] > y) && x < a[0] + (b[0] - a[0]) * (y - a[1]) / (b[1] - a[1]) {
                inside = !inside;
            }
            a = b;
        }
        inside
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::Point3;
    use rand::RngExt;
    use vergence_geometry::Transform;
    use vergence_tag::Shape;

    use super::super::packet::Packet;
    use super::super::shape::{Placed, Solid};
    use super::*;
    use crate::faces::{faces, hull};
    use crate::noise::stream;

    fn faceted(faces: &[Face]) -> Placed {
        let solid = Solid::Faceted(Arc::new(Facets::new(faces)));
        Placed::new(solid, &Transform::translation(0.1, 0.2, 0.3))
    }

    /// Distance and normal where a ray from one point to another meets a solid; `None` when it does not.
    fn met(placed: &Placed, from: V3, to: V3) -> Option<(f32, V3)> {
        let mut packet = Packet::idle();
        packet.aim(0, from, to);
        placed.intersect(&mut packet, 7);
        let local = placed.local(packet.point(0));
        (packet.body[0] == 7).then(|| (packet.t[0], placed.normal(local, packet.part[0]).0))
    }

    #[test]
    fn the_hull_of_a_box_is_met_where_the_box_is() {
        let half = [0.03, 0.04, 0.05f32];
        let corner = |k: usize| [0, 1, 2].map(|a| if k >> a & 1 == 1 { half[a] } else { -half[a] });
        let corners: Vec<_> = (0..8).map(|k| Point3::from(corner(k).map(f64::from))).collect();
        let hull = faceted(&hull(&corners));
        let reference = Placed::new(Solid::Box(half), &Transform::translation(0.1, 0.2, 0.3));
        let mut rng = stream(1, "facets", 0);
        let mut hits = 0;
        for _ in 0..2000 {
            let mut point =
                |reach: f32| [0.1, 0.2, 0.3].map(|c: f32| c + rng.random_range(-reach..reach));
            let (from, to) = (point(0.3), point(0.06));
            match (met(&hull, from, to), met(&reference, from, to)) {
                (None, None) => {}
                (Some((t, normal)), Some((expected, same))) => {
                    hits += 1;
                    assert!((t - expected).abs() < 1e-5, "{t} instead of {expected}");
                    assert!(dot(normal, same) > 0.999, "{normal:?} instead of {same:?}");
                }
                different => panic!("{from:?} to {to:?}: {different:?}"),
            }
        }
        assert!((500..1999).contains(&hits), "{hits}");
    }

    #[test]
    fn a_ray_passes_through_the_notch_of_an_angle_iron() {
        let corners = [(-4, -4), (4, -4), (4, -2), (-2, -2), (-2, 4), (-4, 4)];
        let outline = corners.iter().map(|c| [0.01 * f64::from(c.0), 0.01 * f64::from(c.1)]);
        let shape = Shape::Prism { outline: outline.collect(), height: 0.1 };
        let iron = faceted(&faces(&shape).unwrap());
        let along = |x: f32, y: f32| met(&iron, [0.1 + x, 0.2 + y, 0.6], [0.1 + x, 0.2 + y, 0.0]);
        assert_eq!(along(0.01, 0.01), None);
        for (x, y) in [(-0.03, 0.03), (0.03, -0.03), (-0.03, -0.03)] {
            let (t, normal) = along(x, y).unwrap();
            assert!((t - 0.25).abs() < 1e-6 && normal == [0.0, 0.0, 1.0], "{t} {normal:?}");
        }
        // Into the notch, onto its inner walls.
        let (t, normal) = met(&iron, [0.14, 0.21, 0.3], [0.0, 0.21, 0.3]).unwrap();
        assert!((t - 0.06).abs() < 1e-6 && normal == [1.0, 0.0, 0.0], "{t} {normal:?}");
    }
}
