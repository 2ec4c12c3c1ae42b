//! Pictures of how a tag was found: where the evidence is, how it grew, and the light itself.

use std::path::{Path, PathBuf};

use vergence_imaging::canvas::{Canvas, colour};
use vergence_imaging::{Frame, Image, codec};
use vergence_landmark::sequential::Config;
use vergence_landmark::sequential::explain::{Explanation, Moment, explain};
use vergence_landmark::{Decision, Request};

use crate::failure::Failure;
use crate::save::{fresh, unwritten};

/// Magnification of the evidence map.
const SCALE: usize = 2;
/// Width and height of a plot (px).
const PLOT: (usize, usize) = (640, 200);
/// Height of a plot's caption (px).
const CAPTION: usize = 14;
/// Longest stretch of the light that is drawn (frames).
const SHOWN: usize = 90;

const EVIDENCE: &str = "evidence";
const DECISION: &str = "decision";
const LIGHT: &str = "light";
/// The pictures of a tag.
const KINDS: [&str; 3] = [EVIDENCE, DECISION, LIGHT];

/// Writes three pictures for every tag that is seen: `<tag>-evidence.png`, `<tag>-decision.png` and
/// `<tag>-light.png`.
pub fn save(
    dir: &Path,
    frames: &[Frame],
    requests: &[Request],
    decisions: &[Decision],
) -> Result<(), Failure> {
    // Names of tags can be anything: only all three together are surely an earlier run's.
    fresh(dir, |name| {
        let parts = name.strip_suffix(".png").and_then(|stem| stem.rsplit_once('-'));
        parts.is_some_and(|(tag, kind)| {
            KINDS.contains(&kind) && KINDS.iter().all(|kind| picture(dir, tag, kind).exists())
        })
    })?;
    let config = Config::default();
    for (k, (request, decision)) in requests.iter().zip(decisions).enumerate() {
        let Some(sighting) = decision.brightest() else { continue };
        let found =
            explain(frames, requests, &config, k, sighting).map_err(|e| super::refused(&e))?;
        let name: String =
            request.id.chars().map(|c| if c.is_alphanumeric() { c } else { '-' }).collect();
        let write = |kind: &str, canvas: &Canvas| {
            codec::write_canvas(&picture(dir, &name, kind), canvas).map_err(unwritten)
        };
        let place = (sighting.pixel.x, sighting.pixel.y);
        let Some(first) = frames.first() else { continue };
        write(EVIDENCE, &evidence(&first.image, &found, place))?;
        let decided = sighting.decided_at.saturating_sub(first.stamp).as_secs_f64();
        write(DECISION, &decision_plot(&found, decided))?;
        write(LIGHT, &light(&found))?;
    }
    Ok(())
}

fn picture(dir: &Path, tag: &str, kind: &str) -> PathBuf {
    dir.join(format!("{tag}-{kind}.png"))
}

/// The picture beside the log likelihood ratio at every pixel: grey up to the threshold, orange above.
fn evidence(picture: &Image<u8>, found: &Explanation, place: (f64, f64)) -> Canvas {
    let (width, height) = (picture.width() * SCALE, picture.height() * SCALE);
    let mut canvas = Canvas::new(2 * width, height + CAPTION, colour::BLACK);
    canvas.blit_gray(picture, 0, CAPTION, SCALE);
    let share = found.map.map(|v| f64::from(v) / found.presence);
    let gray = share.map(|s| (200.0 * s.clamp(0.0, 1.0)) as u8);
    canvas.blit_gray(&gray, width, CAPTION, SCALE);
    for y in 0..picture.height() {
        for x in 0..picture.width() {
            if share.row(y)[x] >= 1.0 {
                canvas.fill(width + x * SCALE, CAPTION + y * SCALE, SCALE, SCALE, colour::ORANGE);
            }
        }
    }
    let at = |v: f64| (v + 0.5) * SCALE as f64 - 0.5;
    for left in [0.0, width as f64] {
        canvas.circle((left + at(place.0), CAPTION as f64 + at(place.1)), 12.0, colour::GREEN);
    }
    canvas.text(4, 3, 1, "first frame", colour::WHITE);
    let text = format!("log likelihood ratio; orange: above {:.1}", found.presence);
    canvas.text(width + 4, 3, 1, &text, colour::WHITE);
    canvas
}

/// The evidence over time, for the tag and for the best other pattern at the same place.
fn decision_plot(found: &Explanation, decided: f64) -> Canvas {
    let mut canvas = Canvas::new(PLOT.0, PLOT.1 + CAPTION, colour::BLACK);
    let values = |of: fn(&Moment) -> f64| found.course.iter().map(of).collect::<Vec<f64>>();
    let (own, rival) = (values(|m| m.own), values(|m| m.rival));
    let high = 3.0 * found.presence;
    let rect = [0, CAPTION, PLOT.0, PLOT.1];
    let level = |v: f64| (CAPTION + PLOT.1) as f64 - 1.0 - v / high * (PLOT.1 as f64 - 1.0);
    let line = |canvas: &mut Canvas, v: f64, colour| {
        canvas.line((0.0, level(v)), (PLOT.0 as f64, level(v)), colour);
    };
    line(&mut canvas, found.presence, colour::YELLOW);
    canvas.plot(rect, &rival, 0.0, high, colour::BLUE);
    canvas.plot(rect, &own, 0.0, high, colour::GREEN);
    let before = found.course.iter().filter(|m| m.time <= decided).count() as f64;
    let x = before / found.course.len().max(1) as f64 * PLOT.0 as f64;
    canvas.line((x, CAPTION as f64), (x, (CAPTION + PLOT.1) as f64), colour::WHITE);
    let text = format!(
        "green: this pattern. blue: best other. yellow: presence, {:.1}. identity: {:.1} apart. decided after {decided:.2} s",
        found.presence, found.margin
    );
    canvas.text(4, 3, 1, &text, colour::WHITE);
    canvas
}

/// The light at the place, as measured and as the pattern gives it.
fn light(found: &Explanation) -> Canvas {
    let mut canvas = Canvas::new(PLOT.0, PLOT.1 + CAPTION, colour::BLACK);
    let samples = &found.samples[..found.samples.len().min(SHOWN)];
    let expected: Vec<f64> = samples.iter().map(|s| s.expected).collect();
    let reach = samples.iter().map(|s| s.measured.abs().max(s.expected.abs())).fold(1e-9, f64::max);
    canvas.plot([0, CAPTION, PLOT.0, PLOT.1], &expected, -reach, reach, colour::GREEN);
    for (k, sample) in samples.iter().enumerate() {
        let x = (k as f64 + 0.5) * PLOT.0 as f64 / samples.len() as f64;
        let y = (1.0 - sample.measured / reach) / 2.0 * (PLOT.1 as f64 - 1.0) + CAPTION as f64;
        canvas.circle((x, y), 2.0, colour::ORANGE);
    }
    let text =
        format!("orange: measured. green: the pattern. full height {:.1} grey levels", 2.0 * reach);
    canvas.text(4, 3, 1, &text, colour::WHITE);
    canvas
}
