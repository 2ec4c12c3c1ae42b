//! The 2005 paper's recognition, steps 4 to 8, as written.
//!
//! - Step 4: edges of each picture by Canny's method with fixed thresholds.
//! - Step 5: template of the *bounding box* at the measured place; the landmark gives the place, so
//!   only the rotation is open.
//! - Step 6: the distance transform turns the edges into a contour-line picture.
//! - Step 7: the template's hidden lines are removed.
//! - Step 8: the correlation of template and contour-line picture, largest value wins.
//!
//! Where gravity is known the object is tried in every resting attitude, turned in even steps, as
//! the paper's objects stood on a table; else all rotations are tried on a grid. The result is as
//! fine as that grid, the covariance says so, and nothing is refused for being ambiguous: the paper
//! always answers. Known weakness: the correlation is a mean over the template, so a small
//! projection among many edges wins.

use nalgebra::{Matrix3, Matrix6, Point2, Point3, Unit, UnitQuaternion, Vector3};
use vergence_geometry::{GaussianPose, Transform, gaussian::skew};
use vergence_imaging::canvas::colour::GREEN;
use vergence_imaging::{Canvas, Image, kernel};

use crate::model::{Contour, Model};
use crate::types::{Alternative, ObjectPose, Query, Refusal, View, check};
use crate::{canny, distance, rotations};

/// Settings of the paper's method.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Standard deviation of the blur before Canny (px); one pixel is Canny's usual choice.
    pub blur_px: f32,
    /// Canny's lower threshold (L1 norm of Sobel derivatives): above sensor noise.
    pub low: i32,
    /// Canny's higher threshold: a step of about 25 grey levels.
    pub high: i32,
    /// Step of the turn about the vertical (rad); three degrees, as fine as 320x240 shows.
    pub turn_step: f64,
    /// Spacing of the grid of all rotations, used when gravity is not known (rad).
    pub grid_spacing: f64,
    /// Distances beyond this count as this (px): an edge that is not there should not cost more
    /// the further other edges are.
    pub reach_px: f32,
    /// Spacing of the template's points (px).
    pub step_px: f64,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            blur_px: 1.0,
            low: 40,
            high: 100,
            turn_step: 3f64.to_radians(),
            grid_spacing: 8f64.to_radians(),
            reach_px: 8.0,
            step_px: 2.0,
        }
    }
}

/// What the method saw on its way, for the pictures of `--save`.
#[derive(Debug, Clone, PartialEq)]
pub struct Stages {
    /// Edge pictures of steps 4, one a view.
    pub edges: Vec<Image<u8>>,
    /// Distance fields of step 6, one a view (px).
    pub fields: Vec<Image<f32>>,
}

/// Steps 4 and 6: edges and contour-line pictures.
pub fn stages(views: &[View], config: &Config) -> Stages {
    let edges: Vec<_> = views
        .iter()
        .map(|view| {
            let smooth = kernel::gaussian_blur(view.image, config.blur_px).map(|v| v.round() as u8);
            canny::canny(&smooth, config.low, config.high)
        })
        .collect();
    let fields = edges.iter().map(distance::transform).collect();
    Stages { edges, fields }
}

/// Pictures of steps 4 to 8 with the names of their files: edges, contour lines, template.
pub fn draw(views: &[View], query: &Query, config: &Config) -> Vec<(String, Canvas)> {
    let stages = stages(views, config);
    let model = Model::bounding_box(query.record);
    let found = recognise(views, query, config);
    let mut out = Vec::new();
    for (k, view) in views.iter().enumerate() {
        out.push((format!("view{k}-1-edges"), Canvas::from_gray(&stages.edges[k], 2)));
        let bright = |d: f32| (255.0 * (1.0 - d / (4.0 * config.reach_px))).clamp(0.0, 255.0) as u8;
        let field = stages.fields[k].map(bright);
        out.push((format!("view{k}-2-field"), Canvas::from_gray(&field, 2)));
        let mut canvas = Canvas::from_gray(view.image, 2);
        if let Ok(found) = &found {
            for [from, to] in template(view, &model, &found.pose.pose) {
                let at = |p: &nalgebra::Point2<f64>| (2.0 * p.x + 0.5, 2.0 * p.y + 0.5);
                canvas.line(at(&from), at(&to), GREEN);
            }
        }
        out.push((format!("view{k}-3-template"), canvas));
    }
    out
}

/// The visible lines of the model in a picture (px).
fn template(view: &View, model: &Model, pose: &Transform) -> Vec<[Point2<f64>; 2]> {
    let optical_from_object = view.base_from_optical.inv_mul(pose);
    let eye = optical_from_object.inverse_transform_point(&Point3::origin());
    let mut contour = Contour::new();
    model.contour(&eye.coords, false, &mut contour);
    let project = |p| view.camera.project(&(optical_from_object * Point3::from(p)));
    contour.iter().filter_map(|s| Some([project(s.from)?, project(s.to)?])).collect()
}

/// The pose whose box template correlates best with the edges.
pub fn recognise(views: &[View], query: &Query, config: &Config) -> Result<ObjectPose, Refusal> {
    let (landmark, normal) = check(views, query)?;
    let fields = stages(views, config).fields;
    let model = Model::bounding_box(query.record);
    let mut scored: Vec<(f64, Transform)> = candidates(query, &model, config)
        .filter(|turn| faces_all(turn, &normal, views, query))
        .map(|turn| {
            let centre = query.landmark.position - turn * landmark;
            let pose = Transform::from_parts(centre.coords.into(), turn);
            (correlation(views, &fields, &model, &pose, config), pose)
        })
        .collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    let &(score, pose) = scored.first().ok_or(Refusal::NoAttitude)?;
    let symmetry = query.symmetry();
    let different = |p: &Transform| symmetry.angle_between(&pose.rotation, &p.rotation) > 0.3;
    let second = scored.iter().find(|(_, p)| different(p));
    let alternatives = second.map(|&(confidence, pose)| Alternative { pose, confidence });
    Ok(ObjectPose {
        pose: GaussianPose { pose, covariance: grid_covariance(query, &pose, &landmark, config) },
        confidence: score,
        coverage: score,
        alternatives: alternatives.into_iter().collect(),
        symmetry,
    })
}

fn candidates<'a>(
    query: &'a Query,
    model: &Model,
    config: &Config,
) -> Box<dyn Iterator<Item = UnitQuaternion<f64>> + 'a> {
    let steps = (std::f64::consts::TAU / config.turn_step).round() as usize;
    match (query.up, query.standing) {
        (Some(up), Some(true)) => Box::new(rotations::standing(up, -Vector3::z_axis(), steps)),
        (Some(up), None) => {
            let downs = model.resting_directions();
            let turns = move |down| rotations::standing(up, Unit::new_normalize(down), steps);
            Box::new(downs.into_iter().flat_map(turns))
        }
        _ => Box::new(rotations::spread(rotations::count_for_spacing(config.grid_spacing))),
    }
}

/// Whether an attitude turns the landmark's face to every camera.
fn faces_all(
    turn: &UnitQuaternion<f64>,
    normal: &Vector3<f64>,
    views: &[View],
    query: &Query,
) -> bool {
    let n = turn * normal;
    views.iter().all(|view| n.dot(&(view.eye() - query.landmark.position)) > 0.0)
}

/// Steps 5, 7 and 8: mean over the visible template of one minus the capped distance.
fn correlation(
    views: &[View],
    fields: &[Image<f32>],
    model: &Model,
    pose: &Transform,
    config: &Config,
) -> f64 {
    let (mut sum, mut points) = (0.0, 0usize);
    for (view, field) in views.iter().zip(fields) {
        for [from, to] in template(view, model, pose) {
            // A line that passes close by the camera may be endless: it is followed in larger steps.
            let most = 3.0 * (view.camera.width + view.camera.height) as f64;
            let length = (to - from).norm().min(most);
            let n = (length / config.step_px).ceil().max(1.0) as usize;
            points += n;
            for k in 0..n {
                let p = from + (to - from) * ((k as f64 + 0.5) / n as f64);
                if !view.camera.contains(&p, 0.0) {
                    continue;
                }
                let distance = field.get(p.x.round() as usize, p.y.round() as usize);
                let distance = distance.unwrap_or(config.reach_px).min(config.reach_px);
                sum += f64::from(1.0 - distance / config.reach_px);
            }
        }
    }
    if points == 0 { 0.0 } else { sum / points as f64 }
}

/// Covariance of a pose on the grid: an even error of one step in rotation, and the centre's from
/// the landmark's and the lever between them.
fn grid_covariance(
    query: &Query,
    pose: &Transform,
    landmark: &Vector3<f64>,
    config: &Config,
) -> Matrix6<f64> {
    let upright = query.up.is_some() && query.standing != Some(false);
    let step = if upright { config.turn_step } else { config.grid_spacing };
    let turn = Matrix3::identity() * (step * step);
    // centre = landmark - R lever: a turn w shifts it by -w x (R lever) = [R lever]x w.
    let lever = skew(&(pose.rotation * landmark));
    let mut covariance = Matrix6::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    covariance.fixed_view_mut::<3, 3>(3, 0).copy_from(&(lever * turn));
    covariance.fixed_view_mut::<3, 3>(0, 3).copy_from(&(turn * lever.transpose()));
    let centre = query.landmark.covariance + lever * turn * lever.transpose();
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&centre);
    covariance
}

#[cfg(test)]
mod tests {
    use super::*;
    use vergence_geometry::{Camera, GaussianPoint};
    use vergence_tag::Record;

    #[test]
    fn a_pose_is_stated_as_finely_as_its_attitude_was_tried() {
        let text = r#"{"object_id": "box", "landmarks": [{"position": [0.05, 0.03, 0.01], "normal": [1, 0, 0]}],
            "bounding_box": {"width": 0.10, "length": 0.16, "height": 0.07}, "shape": {"kind": "box"}}"#;
        let record: Record = serde_json::from_str(text).unwrap();
        // Whatever the picture shows, the method answers; a coarse grid suffices.
        let config = Config { grid_spacing: 0.5, turn_step: 0.1, ..Config::default() };
        let camera = Camera::centred(40, 30, 30.0);
        let image = Image::filled(camera.width, camera.height, 90u8);
        let view =
            View { image: &image, camera, base_from_optical: Transform::identity(), turn_sd: 0.0 };
        let covariance = Matrix3::identity() * 1e-6;
        let landmark = GaussianPoint { position: Point3::new(0.0, 0.0, 0.6), covariance };
        // The camera looks along z, so up is to its -y.
        let vertical = Some(-Vector3::y_axis());
        for (up, standing, step) in [
            (vertical, Some(true), config.turn_step),
            (vertical, None, config.turn_step),
            (vertical, Some(false), config.grid_spacing),
            (None, None, config.grid_spacing),
        ] {
            let query = Query { record: &record, landmark, landmark_index: 0, up, standing };
            let found = recognise(&[view], &query, &config).unwrap().pose;
            let stated = found.covariance.fixed_view::<3, 3>(0, 0) / (step * step);
            let off = (stated - Matrix3::identity()).norm();
            assert!(off < 1e-9, "{up:?}, {standing:?}: {stated} squared steps");
            // The lever of a coarser turn makes the place uncertain too.
            let lever = found.pose.rotation * Vector3::from(record.landmarks[0].position);
            let place = found.covariance.fixed_view::<3, 3>(3, 3).trace();
            let expected = 3e-6 + 2.0 * (step * lever.norm()).powi(2);
            assert!((place / expected - 1.0).abs() < 1e-9, "{place} m^2, not {expected}");
        }
    }
}
