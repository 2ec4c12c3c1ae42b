//! What the method saw, as pictures: edges, field, best and second-best pose, residuals and print.
//!
//! **In:** a [`Trace`]. **Out:** drawings by name, one of each kind a view, over the enlarged part
//! of the picture that was worked on.

use std::f64::consts::PI;

use nalgebra::Point3;
use vergence_geometry::Transform;
use vergence_imaging::canvas::colour::{BLUE, GREEN, ORANGE, PURPLE, YELLOW};
use vergence_imaging::{Canvas, Image};

use super::Trace;
use super::edges::edgels;
use super::field::{CAP_PX, DIRECTIONS};
use super::search::Sight;
use super::sites::Site;
use crate::model::{Contour, Kind, Model};

/// The drawings of one recognition with the names of their files.
pub fn draw(trace: &Trace) -> Vec<(String, Canvas)> {
    let mut out = Vec::new();
    for (view, sight) in trace.sights.iter().enumerate() {
        let scale = magnification(sight);
        out.push((format!("view{view}-1-edges"), edge_picture(sight)));
        out.push((format!("view{view}-2-field"), field_picture(sight)));
        for (rank, name) in [(0, "3-best"), (1, "4-second")] {
            let Some(pose) = trace.poses.get(rank) else { continue };
            let mut canvas = Canvas::from_gray(sight.view.image, scale);
            let colours = if rank == 0 { [GREEN, BLUE] } else { [ORANGE, YELLOW] };
            wireframe(&mut canvas, sight, &trace.model, pose, scale, colours);
            out.push((format!("view{view}-{name}"), canvas));
        }
        let mut canvas = Canvas::from_gray(sight.view.image, scale);
        for site in trace.sites.iter().filter(|s| s.view == view) {
            residual(&mut canvas, site, scale);
        }
        // Squares of print have their places in the first view.
        let squares = if view == 0 { &trace.patches[..] } else { &[] };
        for patch in squares {
            let colour = if patch.on_ground() { PURPLE } else { BLUE };
            canvas.circle(enlarged(scale, patch.pixel.x, patch.pixel.y), 1.0, colour);
        }
        out.push((format!("view{view}-5-residuals"), canvas));
    }
    out
}

/// Whole factor that makes a picture about 1280 pixels wide.
fn magnification(sight: &Sight) -> usize {
    (1280 / sight.view.camera.width.max(1)).clamp(1, 4)
}

/// Every edge point in the colour of its direction.
fn edge_picture(sight: &Sight) -> Canvas {
    let level = &sight.coarse;
    let mut canvas = Canvas::new(4 * level.width(), 4 * level.height(), [0; 3]);
    for e in edgels(level) {
        let phase = 2.0 * f64::from(e.direction);
        let channel = |shift: f64| (140.0 + 110.0 * (phase + shift).cos()) as u8;
        let colour = [channel(0.0), channel(2.0 * PI / 3.0), channel(4.0 * PI / 3.0)];
        canvas.fill(4 * usize::from(e.x), 4 * usize::from(e.y), 4, 4, colour);
    }
    canvas
}

/// The fields of level and upright lines, side by side; bright is near an edge.
fn field_picture(sight: &Sight) -> Canvas {
    let (width, height) = (sight.coarse.width(), sight.coarse.height());
    let shade = |direction: usize| {
        Image::from_fn(width, height, |x, y| {
            (255.0 * (1.0 - sight.field.value(direction, x, y) / CAP_PX)).clamp(0.0, 255.0) as u8
        })
    };
    let mut canvas = Canvas::new(4 * width + 2, 2 * height, [0; 3]);
    canvas.blit_gray(&shade(0), 0, 0, 2);
    canvas.blit_gray(&shade(DIRECTIONS / 2), 2 * width + 2, 0, 2);
    canvas
}

/// Silhouettes in the first colour, creases in the second.
fn wireframe(
    canvas: &mut Canvas,
    sight: &Sight,
    model: &Model,
    pose: &Transform,
    scale: usize,
    colours: [[u8; 3]; 2],
) {
    let optical_from_object = sight.optical_from_base * pose;
    let eye = optical_from_object.inverse_transform_point(&Point3::origin());
    let mut contour = Contour::new();
    model.contour(&eye.coords, true, &mut contour);
    for segment in &contour {
        let ends = [segment.from, segment.to]
            .map(|p| sight.view.camera.project(&(optical_from_object * Point3::from(p))));
        let [Some(a), Some(b)] = ends else { continue };
        let colour = if segment.kind == Kind::Crease { colours[1] } else { colours[0] };
        canvas.line(enlarged(scale, a.x, a.y), enlarged(scale, b.x, b.y), colour);
    }
}

/// From the contour to the nearest edge, three times enlarged; sites without an edge as orange dots.
fn residual(canvas: &mut Canvas, site: &Site, scale: usize) {
    let (x, y) = site.pixel;
    let nearest = site.edges().iter().map(|c| c.offset).min_by(|a, b| a.abs().total_cmp(&b.abs()));
    let from = enlarged(scale, x, y);
    match nearest {
        Some(offset) => {
            let k = 3.0 * offset;
            let to = enlarged(scale, x + site.normal.0 * k, y + site.normal.1 * k);
            canvas.line(from, to, if site.contact { YELLOW } else { GREEN });
        }
        None => canvas.circle(from, 1.0, ORANGE),
    }
}

fn enlarged(scale: usize, x: f64, y: f64) -> (f64, f64) {
    let s = scale as f64;
    ((x + 0.5) * s - 0.5, (y + 0.5) * s - 0.5)
}
