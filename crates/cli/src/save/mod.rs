//! `--save DIR`: the picture of every step, and `recording.mcap`.
//!
//! ```text
//! 1-difference-{left,right}.png   on/off difference with projection histograms
//! 2-spectrum-{left,right}.png     spectra of what flickers, and the commanded frequency
//! 3-centred-{left,right}.png      the light in the image centre
//! 4-edges-{left,right}.png        edges of the pictures with the light off
//! 5-field-{left,right}.png        their distance transform
//! 6-template-{left,right}.png     the template, hidden lines removed, over the picture
//! directional-view{0,1}-*.png     what the default method saw: oriented edges, fields, best and
//!                                 second-best pose, residuals
//! recording.mcap                  images, camera info, joints, tf and the result for ROS 2 tools
//! result.json                     what --json prints
//! ```
//!
//! A grasp adds `7-{pregrasp,closed,lifted}-{left,right}.png`, and in simulation `stages.png` and
//! `replay.json`.

mod landmark;
mod pose;
mod recorder;

use std::path::{Path, PathBuf};

use nalgebra::Point2;
use vergence::{Event, Method, Observer, Report};
use vergence_devices::Side;
use vergence_imaging::canvas::{Canvas, colour};
use vergence_imaging::{CodecError, Frame, codec};
use vergence_pose::directional;

use crate::failure::Failure;
use crate::robot::Opened;
use landmark::{SCALE, on_canvas};
use recorder::Recorder;

/// Pictures that each side has.
const STEPS: [&str; 9] = [
    "1-difference",
    "2-spectrum",
    "3-centred",
    "4-edges",
    "5-field",
    "6-template",
    "7-pregrasp",
    "7-closed",
    "7-lifted",
];

/// Most frames that are kept of one watch, for the explanation of the landmark's finding.
const MOST_FRAMES: usize = 400;

/// Writes the pictures and the recording of one run.
pub struct Saver {
    dir: PathBuf,
    recorder: Recorder,
    /// How the object is recognised.
    method: Method,
    /// The newest frames.
    newest: [Option<Frame>; 2],
    /// Frames of the watch that is going on, by side.
    watched: [Vec<Frame>; 2],
    /// First thing that could not be written; reported at the end, the run goes on.
    failed: Option<Failure>,
}

impl Saver {
    /// Makes the folder and opens the recording in it.
    pub fn create(dir: &Path, robot: &Opened, method: Method) -> Result<Self, Failure> {
        fresh(dir, is_ours)?;
        let recorder = Recorder::create(&dir.join("recording.mcap"), robot)?;
        Ok(Saver {
            dir: dir.into(),
            recorder,
            method,
            newest: [None, None],
            watched: Default::default(),
            failed: None,
        })
    }

    /// Closes the recording and writes the result; the first failure of the run, if there was one.
    pub fn finish(mut self, report: &Report) -> Result<(), Failure> {
        self.recorder.finish(report)?;
        let path = self.dir.join("result.json");
        let text = serde_json::to_vec_pretty(report).map_err(|e| cannot_write(&path, e))?;
        std::fs::write(&path, text).map_err(|error| cannot_write(&path, error))?;
        self.failed.map_or(Ok(()), Err)
    }

    fn keep(&mut self, outcome: Result<(), Failure>) {
        if let Err(failure) = outcome {
            self.failed.get_or_insert(failure);
        }
    }

    fn picture(&mut self, name: &str, side: Side, canvas: &Canvas) {
        self.write(&format!("{name}-{}", side.name()), canvas);
    }

    fn write(&mut self, name: &str, canvas: &Canvas) {
        let name = format!("{name}.png");
        debug_assert!(is_ours(&name), "{name} would stay when the next run comes");
        let path = self.dir.join(name);
        let written = codec::write_canvas(&path, canvas).map_err(unwritten);
        self.keep(written);
    }

    fn saw(&mut self, event: &Event<'_>) {
        match event {
            // Each step's pictures are explained by themselves.
            Event::Begun(_) => self.watched = Default::default(),
            Event::Stage(stage) => {
                for side in Side::BOTH {
                    if let Some(frame) = &self.newest[side as usize] {
                        let canvas = Canvas::from_gray(&frame.image, SCALE);
                        self.picture(&format!("7-{stage}"), side, &canvas);
                    }
                }
            }
            Event::Frame(side, frame, _) => {
                self.newest[*side as usize] = Some((*frame).clone());
                let frames = &mut self.watched[*side as usize];
                if frames.len() < MOST_FRAMES {
                    frames.push((*frame).clone());
                }
            }
            Event::Watched(side, pattern, sightings) => {
                let frames = std::mem::take(&mut self.watched[*side as usize]);
                if sightings.is_empty() {
                    return;
                }
                if let Some(evidence) = landmark::explain(&frames, pattern) {
                    self.picture("1-difference", *side, &landmark::difference(&evidence));
                    self.picture("2-spectrum", *side, &landmark::spectra(&evidence));
                }
                if let Some(last) = frames.last() {
                    let seen: Vec<Point2<f64>> = sightings.iter().map(|s| s.pixel).collect();
                    self.picture("3-centred", *side, &centred(last, &seen));
                }
            }
            Event::Recognised(views, query, outcome) => {
                let guess = match outcome {
                    Ok(pose) => Some(*pose),
                    Err(refusal) => refusal.best_guess(),
                };
                for (view, side) in views.iter().zip(Side::BOTH) {
                    let pictures = pose::pictures(view, query, guess);
                    self.picture("4-edges", side, &pictures.edges);
                    self.picture("5-field", side, &pictures.field);
                    self.picture("6-template", side, &pictures.template);
                }
                // The recognition runs once more: only that keeps what it saw on its way.
                if self.method == Method::Directional
                    && let Ok((_, trace)) =
                        directional::recognise_traced(views, query, &Default::default())
                {
                    for (name, canvas) in directional::picture::draw(&trace) {
                        self.write(&format!("directional-{name}"), &canvas);
                    }
                }
            }
            _ => {}
        }
    }
}

impl Observer for Saver {
    fn notice(&mut self, event: &Event<'_>) {
        let recorded = self.recorder.record(event);
        self.keep(recorded);
        self.saw(event);
    }
}

/// The picture with the image centre (cross) and where the light was seen (circles).
fn centred(frame: &Frame, seen: &[Point2<f64>]) -> Canvas {
    let mut canvas = Canvas::from_gray(&frame.image, SCALE);
    let centre = Point2::new(
        (frame.image.width() as f64 - 1.0) / 2.0,
        (frame.image.height() as f64 - 1.0) / 2.0,
    );
    canvas.cross(on_canvas(&centre), 24.0, colour::BLUE);
    for (index, pixel) in seen.iter().enumerate() {
        let colour = if index == 0 { colour::ORANGE } else { colour::PURPLE };
        canvas.circle(on_canvas(pixel), 10.0, colour);
    }
    canvas.text(4, 4, 1, "cross: image centre; circle: the light", colour::WHITE);
    canvas
}

/// A folder for the files of one run: made, and rid of those that an earlier run left, by their names, so that
/// pictures of two runs never lie side by side.
pub fn fresh(dir: &Path, ours: impl Fn(&str) -> bool) -> Result<(), Failure> {
    let clear = || {
        std::fs::create_dir_all(dir)?;
        let mut left = Vec::new();
        for entry in std::fs::read_dir(dir)? {
            let entry = entry?;
            let named = entry.file_name().to_str().is_some_and(&ours);
            if named && !entry.file_type()?.is_dir() {
                left.push(entry.path());
            }
        }
        left.into_iter().try_for_each(std::fs::remove_file)
    };
    clear().map_err(|error: std::io::Error| cannot_write(dir, error))
}

/// Whether a find or a grasp writes a file of this name.
pub fn is_ours(name: &str) -> bool {
    let Some(stem) = name.strip_suffix(".png") else {
        return ["recording.mcap", "result.json", "replay.json"].contains(&name);
    };
    let of_side = Side::BOTH.iter().find_map(|side| {
        let step = stem.strip_suffix(side.name())?.strip_suffix('-')?;
        Some(STEPS.contains(&step))
    });
    of_side.unwrap_or(stem == "stages" || stem.starts_with("directional-view"))
}

/// What is said of a picture that could not be written; the error names it.
pub fn unwritten(error: CodecError) -> Failure {
    Failure::failed(error, "check the folder given with --save: is it writable, is the disk full?")
}

/// What is said of a file that could not be written.
pub fn cannot_write(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::failed(
        format!("cannot write {}: {error}", path.display()),
        "check the folder given with --save: is it writable, is the disk full?",
    )
}
