//! Pictures of how the light was found: the difference image with its projection histograms
//! (section 2.2 of the paper, figure 7) and the spectra at the candidate places (section 2.3,
//! figure 8). The frames of the last watch are run through the paper's finder once more, whichever
//! method found the light: its intermediate results are what can be looked at.

use vergence_imaging::canvas::{Canvas, colour};
use vergence_imaging::{Frame, Image};
use vergence_landmark::paper::{Config, Evidence, PaperFinder};
use vergence_landmark::{Finder, Request};
use vergence_tag::Pattern;

/// Magnification of the pictures.
pub const SCALE: usize = 2;
/// Height of a histogram or spectrum (px).
const PLOT: usize = 100;

/// What the paper's finder made of these frames; `None` when there were too few.
pub fn explain(frames: &[Frame], pattern: &Pattern) -> Option<Evidence> {
    let request = Request { id: "landmark".into(), pattern: *pattern, clock_tolerance: 2e-4 };
    let config = Config { frames: frames.len(), ..Config::default() };
    let mut finder = PaperFinder::new(vec![request], config).ok()?;
    for frame in frames {
        finder.push(frame).ok()?;
    }
    finder.evidence().first().cloned()
}

/// The persistent difference with its projections along x (below) and y (right).
pub fn difference(evidence: &Evidence) -> Canvas {
    let gray = stretched(&evidence.difference);
    let (width, height) = (gray.width() * SCALE, gray.height() * SCALE);
    let mut canvas = Canvas::new(width + PLOT, height + PLOT, colour::BLACK);
    canvas.blit_gray(&gray, 0, 0, SCALE);
    let along_x = &evidence.projection.along_x;
    canvas.plot([0, height, width, PLOT], along_x, 0.0, peak(along_x), colour::ORANGE);
    let along_y = &evidence.projection.along_y;
    let top = peak(along_y);
    let point = |k: usize| {
        let reach = (PLOT - 1) as f64;
        (width as f64 + along_y[k] / top * reach, (k as f64 + 0.5) * SCALE as f64)
    };
    for k in 1..along_y.len() {
        canvas.line(point(k - 1), point(k), colour::BLUE);
    }
    for (index, (place, _)) in evidence.candidates.iter().enumerate() {
        let chosen = evidence.chosen == Some(index);
        let colour = if chosen { colour::GREEN } else { colour::YELLOW };
        canvas.circle(on_canvas(place), 9.0, colour);
    }
    canvas.text(4, 4, 1, "on - off, persistent; projections along x and y", colour::WHITE);
    canvas
}

/// The spectrum at every candidate place; the line is the frequency that was commanded.
pub fn spectra(evidence: &Evidence) -> Canvas {
    let (width, row) = (480, PLOT + 16);
    let rows = evidence.candidates.len().max(1);
    let mut canvas = Canvas::new(width, rows * row, colour::BLACK);
    for (index, (place, spectrum)) in evidence.candidates.iter().enumerate() {
        let chosen = evidence.chosen == Some(index);
        let colour = if chosen { colour::GREEN } else { colour::YELLOW };
        let top = index * row;
        let bins = spectrum.amplitudes.len() as f64;
        let x = (evidence.line.frequency / spectrum.step + 0.5) / bins * width as f64;
        canvas.line((x, (top + 14) as f64), (x, (top + row - 2) as f64), colour::PURPLE);
        let high = peak(&spectrum.amplitudes);
        canvas.plot([0, top + 14, width, PLOT], &spectrum.amplitudes, 0.0, high, colour);
        let text = format!(
            "at ({:.0}, {:.0}): 0 to {:.1} Hz, commanded {:.2} Hz{}",
            place.x,
            place.y,
            spectrum.step * bins,
            evidence.line.frequency,
            if chosen { ", chosen" } else { "" }
        );
        canvas.text(4, top + 3, 1, &text, colour::WHITE);
    }
    canvas
}

/// A pixel position in a picture that is enlarged by [`SCALE`].
pub fn on_canvas(pixel: &nalgebra::Point2<f64>) -> (f64, f64) {
    let at = |v: f64| (v + 0.5) * SCALE as f64 - 0.5;
    (at(pixel.x), at(pixel.y))
}

fn peak(values: &[f64]) -> f64 {
    values.iter().fold(1e-9, |a: f64, b| a.max(*b))
}

/// Grey from zero to the largest value.
pub fn stretched(image: &Image<f32>) -> Image<u8> {
    let high = image.data().iter().fold(1e-6f32, |a, b| a.max(*b));
    image.map(|v| (255.0 * (v / high).clamp(0.0, 1.0)) as u8)
}
