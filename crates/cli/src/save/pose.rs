//! Pictures of the recognition, the paper's steps 4 to 8 and its figures 10 and 11: edges, their
//! distance transform, and the winning template with hidden lines removed over the picture.

use nalgebra::Vector3;
use vergence_geometry::Transform;
use vergence_imaging::canvas::{Canvas, Rgb, colour};
use vergence_pose::{Contour, Kind, Model, ObjectPose, Query, View, paper};

use super::landmark::{SCALE, on_canvas, stretched};

/// Distance (px) that is drawn white in the picture of the distance transform.
const FIELD_WHITE_PX: f32 = 24.0;

/// The pictures of one view.
pub struct Pictures {
    /// Canny's edges.
    pub edges: Canvas,
    /// Distance to the nearest edge.
    pub field: Canvas,
    /// The picture with the best pose (orange, creases yellow), the best other one (blue) and the
    /// landmark (green).
    pub template: Canvas,
}

/// Draws what the recogniser saw in one view and what it took it for.
pub fn pictures(view: &View<'_>, query: &Query<'_>, guess: Option<&ObjectPose>) -> Pictures {
    let stages = paper::stages(&[*view], &Default::default());
    let edges = Canvas::from_gray(&stages.edges[0], SCALE);
    let field =
        Canvas::from_gray(&stretched(&stages.fields[0].map(|d| d.min(FIELD_WHITE_PX))), SCALE);
    let mut template = Canvas::from_gray(view.image, SCALE);
    let model = Model::new(query.record);
    if let Some(other) = guess.and_then(|guess| guess.alternatives.first()) {
        outline(&mut template, view, &model, &other.pose, [colour::BLUE; 2]);
    }
    if let Some(guess) = guess {
        let colours = [colour::ORANGE, colour::YELLOW];
        outline(&mut template, view, &model, &guess.pose.pose, colours);
    }
    let landmark = view.base_from_optical.inverse_transform_point(&query.landmark.position);
    if let Some(pixel) = view.camera.project(&landmark) {
        template.cross(on_canvas(&pixel), 8.0, colour::GREEN);
    }
    template.text(4, 4, 1, "orange: best pose; blue: best other; green: landmark", colour::WHITE);
    Pictures { edges, field, template }
}

/// Draws the visible contour of a pose: silhouette in the first colour, creases in the second.
fn outline(
    canvas: &mut Canvas,
    view: &View<'_>,
    model: &Model,
    base_from_object: &Transform,
    [silhouette, crease]: [Rgb; 2],
) {
    let optical_from_object = view.base_from_optical.inverse() * base_from_object;
    let eye = optical_from_object.inverse().translation.vector;
    let mut contour = Contour::default();
    model.contour(&eye, true, &mut contour);
    let project =
        |p: &Vector3<f64>| view.camera.project(&(optical_from_object * nalgebra::Point3::from(*p)));
    for segment in &contour {
        let colour = if segment.kind == Kind::Crease { crease } else { silhouette };
        if let (Some(from), Some(to)) = (project(&segment.from), project(&segment.to)) {
            canvas.line(on_canvas(&from), on_canvas(&to), colour);
        }
    }
}
