//! Higher tops further off.
//!
//! **In:** a pose refined from a search on reduced pictures. **Out:** the highest top about it. On a printed
//! object lines run along every edge of it, and what is right to a pixel of a reduced picture is several
//! pixels off: the refinement ends on lines of print, on a top that explains a good deal less than the right
//! one. As in RANSAC (Fischler and Bolles 1981) three edges, picked anywhere about the contour and taken to
//! be its own, fix how the object is turned, the landmark where it is. Of many such poses those that agree
//! with most edges are refined on their own, and from the best of them it goes on.

use nalgebra::{Matrix6, RowVector6, Vector6};

use super::neighbours::{CAUGHT_PX, moves_px};
use super::refine::{Refined, STRAY_DENSITY, absence, deviation, independent};
use super::search::Search;
use super::sites::Site;
use super::verdict::{Explained, add_gaussian};

/// Picks of edges, and how many edges make a pose: as many as it has turns.
const SAMPLES: usize = 800;
const PICKS: usize = 3;
/// Deviation (px) of an edge that is picked.
const PICK_SD_PX: f64 = 0.5;
/// Deviation (px) within which edges agree with a pose.
const AGREE_SD_PX: f64 = 1.0;
/// Poses that are refined, those that agree with most edges; on photographs 8 find a little less, 16 little
/// more.
const STARTS: usize = 12;
/// What a start may be behind (nats) before it is refined: here only what is higher counts.
const BEHIND: f64 = 3.0;
/// Fractional parts of the powers of its inverse spread points evenly over six dimensions (M. Roberts, "The
/// unreasonable effectiveness of quasirandom sequences", 2018): the root of `x^7 = x + 1`.
const SPREAD: f64 = 1.112_775_684_278_706;

/// Shifts (px) at which a site is asked, and their spacing: edges are looked for no further off.
const ASKED: usize = 49;
const SPACING_PX: f64 = 0.5;

/// What a site has to say on poses nearby.
struct Voice<'a> {
    site: &'a Site,
    /// Shift of the contour (px) by the pose's tangent.
    by_pose: RowVector6<f64>,
    /// Log-likelihood of its edges by how far the contour has moved.
    by_shift: [f64; ASKED],
}

impl<'a> Voice<'a> {
    fn new(site: &'a Site) -> Self {
        let sd = deviation(site, AGREE_SD_PX);
        let missing = absence(site);
        let here = (1.0 - missing) / site.places().count() as f64;
        let peak = here / (sd * std::f64::consts::TAU.sqrt());
        let mut density = [missing * STRAY_DENSITY; ASKED];
        for (place, _) in site.places() {
            for edge in site.edges() {
                let first = edge.offset - place + (ASKED / 2) as f64 * SPACING_PX;
                add_gaussian(&mut density, peak * edge.weight, first / sd, SPACING_PX / sd);
            }
        }
        Voice {
            site,
            by_pose: site.by_shared.fixed_columns::<6>(0).into_owned(),
            by_shift: density.map(|d| independent(site) * d.ln()),
        }
    }

    /// Log-likelihood of its edges when the pose moves by a tangent.
    fn of(&self, tangent: &Vector6<f64>) -> f64 {
        let shift = (self.by_pose * tangent).x / SPACING_PX + (ASKED / 2) as f64;
        self.by_shift[shift.clamp(0.0, (ASKED - 1) as f64).round() as usize]
    }
}

impl Search<'_> {
    /// Goes on to the highest top around, where the search could not see the pictures' own pixels. With two
    /// views lines of print seldom agree: at half their scale there never was a higher top.
    pub(super) fn ascend(&self, found: &mut (Refined, Explained)) {
        if self.scale() > self.sights.len() as f64 {
            let starts = |top: &Refined, around: &[Site], metric: &Matrix6<f64>| {
                self.agreeing(top, around, metric)
            };
            *found = self.tops(found, starts, BEHIND).swap_remove(0);
        }
    }

    /// Tangents to poses that agree with many of the edges around a top, those with most first.
    fn agreeing(&self, top: &Refined, around: &[Site], metric: &Matrix6<f64>) -> Vec<Vector6<f64>> {
        let voices: Vec<Voice> = around.iter().map(Voice::new).collect();
        let heard: Vec<&Voice> = voices.iter().filter(|v| v.site.count > 0).collect();
        let (known, pull) = self.known(top);
        let mut samples: Vec<(f64, Vector6<f64>)> = (1..=SAMPLES)
            .filter_map(|k| {
                let (mut a, mut b) = (known, pull);
                let mut step = k as f64;
                // A place on the contour and an edge there, both as even as the samples.
                let mut pick = |of: usize| {
                    step /= SPREAD;
                    ((step.fract() * of as f64) as usize).min(of.saturating_sub(1))
                };
                for _ in 0..PICKS {
                    let voice = heard.get(pick(heard.len()))?;
                    let edge = voice.site.edges()[pick(voice.site.count)];
                    let weighed = voice.by_pose.transpose() / PICK_SD_PX.powi(2);
                    a += weighed * voice.by_pose;
                    b += weighed * edge.offset;
                }
                let tangent = a.cholesky()?.solve(&b);
                let edges: f64 = voices.iter().map(|voice| voice.of(&tangent)).sum();
                let prior = tangent.dot(&pull) - 0.5 * tangent.dot(&(known * tangent));
                Some((edges + prior, tangent))
            })
            .collect();
        samples.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut starts: Vec<Vector6<f64>> = Vec::new();
        for (_, tangent) in samples {
            if starts.iter().all(|start| moves_px(metric, &(start - tangent)) > CAUGHT_PX) {
                starts.push(tangent);
            }
            if starts.len() == STARTS {
                break;
            }
        }
        starts
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directional::{Config, prepare, track};
    use crate::model::Model;
    use crate::types::{Query, View};
    use nalgebra::{Matrix3, Point2, Point3, UnitQuaternion, Vector3};
    use vergence_geometry::gaussian::perturb;
    use vergence_geometry::{Camera, GaussianPoint, Transform};
    use vergence_imaging::Image;
    use vergence_tag::Record;

    const HALF: Vector3<f64> = Vector3::new(0.07, 0.03, 0.1);

    /// A box with frames printed on its faces, all along the edges.
    fn picture(model: &Model, camera: &Camera, optical_from_object: &Transform) -> Image<u8> {
        let object_from_optical = optical_from_object.inverse();
        let eye = object_from_optical.translation.vector;
        let level = |x: f64, y: f64| {
            let ray = object_from_optical.rotation * camera.unproject(&Point2::new(x, y));
            let Some(hit) = model.first_hit(&eye, &ray) else { return 90.0 };
            let mut inside = (HALF - (eye + ray * hit.distance).abs()).data.0[0];
            inside.sort_by(f64::total_cmp);
            // The least is how far the face is off itself, the next how far the nearest edge is.
            if (inside[1] / 0.004) % 1.0 < 0.4 { 60.0 } else { 130.0 + 60.0 * hit.normal.y }
        };
        Image::from_fn(camera.width, camera.height, |x, y| {
            let part = |k: usize| (k as f64 - 1.0) / 3.0;
            let rays = (0..9).map(|k| (x as f64 + part(k % 3), y as f64 + part(k / 3)));
            (rays.map(|(x, y)| level(x, y)).sum::<f64>() / 9.0) as u8
        })
    }

    /// Calls back with a picture of a printed box, what is known of it and its true pose.
    fn with_print(check: impl FnOnce(&[View], &Query, &Transform)) {
        let text = r#"{"object_id": "printed", "landmarks": [{"position": [0.02, -0.03, 0.03], "normal": [0, -1, 0]}],
            "bounding_box": {"width": 0.14, "length": 0.06, "height": 0.2}, "shape": {"kind": "box"}}"#;
        let record: Record = serde_json::from_str(text).unwrap();
        let (model, camera) = (Model::new(&record), Camera::centred(640, 480, 600.0));
        let turn = UnitQuaternion::from_euler_angles(1.2, 0.0, 0.0)
            * UnitQuaternion::from_euler_angles(0.0, 0.0, 0.5);
        let truth = Transform::from_parts(Vector3::new(0.01, 0.0, 0.55).into(), turn);
        let image = picture(&model, &camera, &truth);
        let base_from_optical = Transform::identity();
        let views = [View { image: &image, camera, base_from_optical, turn_sd: 0.0 }];
        let seen = truth * Point3::from(record.landmarks[0].position);
        let position = seen + Vector3::new(0.0005, -0.001, 0.002);
        let covariance = Matrix3::from_diagonal(&Vector3::new(1e-6, 1e-6, 9e-6));
        let landmark = GaussianPoint { position, covariance };
        let query =
            Query { record: &record, landmark, landmark_index: 0, up: None, standing: None };
        check(&views, &query, &truth);
    }

    /// A pose turned by so much (rad) about all axes, to one of eight sides.
    fn turned(truth: &Transform, k: usize, by: f64) -> Transform {
        let side = |bit: usize| if k & bit == 0 { -by } else { by };
        perturb(truth, &Vector6::new(side(1), side(2), side(4), 0.0, 0.0, 0.0))
    }

    fn degrees(a: &Transform, b: &Transform) -> f64 {
        a.rotation.angle_to(&b.rotation).to_degrees()
    }

    /// What is left from the truth itself (0.6 degrees), for the light and the size are not quite what they
    /// seem, and a little.
    const RIGHT_DEG: f64 = 0.9;

    #[test]
    fn from_lines_of_print_it_goes_on_to_the_contour() {
        with_print(|views, query, truth| {
            let (landmark, normal) = query.landmark_in_object().unwrap();
            let (config, model) = (Config::default(), Model::new(query.record));
            let sights = prepare(views, query, landmark, &config, false);
            let search = Search::new(&sights, &model, query, (landmark, normal), &config);
            assert!(search.scale() > 1.0, "the picture would not be reduced");
            let (mut before, mut after) = (Vec::new(), Vec::new());
            for k in 0..8 {
                let (rough, _) = search.refine_roughly(&turned(truth, k, 0.02), false);
                let mut found = search.refine_finely(rough);
                before.push(degrees(&found.0.pose, truth));
                let evidence = found.1.evidence;
                search.ascend(&mut found);
                assert!(found.1.evidence >= evidence);
                after.push(degrees(&found.0.pose, truth));
            }
            assert!(before.iter().all(|&deg| deg > 1.2), "nothing to do: {before:.2?}");
            assert!(after.iter().all(|&deg| deg < RIGHT_DEG), "{after:.2?}, before {before:.2?}");
        });
    }

    #[test]
    fn tracking_stays_on_the_contour() {
        with_print(|views, query, truth| {
            for k in 0..8 {
                let found = track(views, query, &turned(truth, k, 0.002), &Config::default());
                let deg = degrees(&found.unwrap().pose.pose, truth);
                assert!(deg < RIGHT_DEG, "to side {k} off by {deg:.2} degrees");
            }
        });
    }
}
