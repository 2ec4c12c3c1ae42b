//! `vergence blink`: which of the requested tags blink in a recording, and where.
//!
//! In: a ROS 2 recording of one camera and a request (JSON: the patterns, the chip durations, the
//! clock tolerance, the exposure). Out: JSON with one detection for every tag that is seen.

mod bound;
mod picture;
mod report;
mod request;
mod tag_free;

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::value_parser;
use serde_json::json;
use vergence_landmark::{Finder, FinderError, paper, sequential};
use vergence_ros::recording::{self, RecordingError};

use self::report::Report;
use self::request::BlinkRequest;
use crate::failure::Failure;
use crate::output::{out, told};

/// Longest tag-free video that is simulated: a week.
const MOST_MINUTES: f64 = 10_080.0;

/// How the landmarks are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Method {
    /// The on/off difference with projection histograms of the 2005 paper.
    Paper,
    /// Soft evidence weighed frame by frame, with a stated rate of false alarms.
    Sequential,
}

/// Find blinking landmarks in a recording.
#[derive(clap::Args)]
pub struct Args {
    /// A ROS 2 recording (MCAP) with the images of one camera
    #[arg(required_unless_present_any = ["episodes", "bound"], requires = "request")]
    recording: Option<PathBuf>,
    /// What to look for (JSON)
    #[arg(long)]
    request: Option<PathBuf>,
    /// A folder of episodes, each a folder with recording.mcap and request.json; needs --out DIR
    #[arg(long, conflicts_with_all = ["recording", "request"], requires = "out")]
    episodes: Option<PathBuf>,
    /// Simulate instead: frames to a decision against Wald's bound, and false alarms
    #[arg(long, conflicts_with_all = ["recording", "request", "episodes", "method", "out"])]
    bound: bool,
    /// Runs for every signal-to-noise ratio of --bound
    #[arg(long, default_value_t = 100, requires = "bound", value_parser = value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// Minutes of tag-free video for --bound
    #[arg(long, default_value_t = 5.0, requires = "bound", value_parser = minutes)]
    minutes: f64,
    /// How to look
    #[arg(long, value_enum, default_value = "sequential")]
    method: Method,
    /// Print one JSON document instead of text
    #[arg(long, conflicts_with = "episodes")]
    json: bool,
    /// Write pictures of how each tag was found to this folder
    #[arg(long, conflicts_with_all = ["episodes", "bound"])]
    save: Option<PathBuf>,
    /// Write the JSON to this file (with --episodes: one file an episode in this folder)
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Runs the command; `true` when of every requested tag it is decided whether it is here.
pub fn run(args: Args) -> Result<bool, Failure> {
    if args.bound {
        let bound = told(bound::run(args.runs, args.minutes), args.json, json!({}))?;
        match args.json {
            true => crate::output::json(&bound)?,
            false => out!("{}", bound.text()),
        }
        return Ok(true);
    }
    if let (Some(set), Some(out)) = (&args.episodes, &args.out) {
        return run_set(set, out, args.method);
    }
    let (Some(recording), Some(request)) = (&args.recording, &args.request) else {
        return Err(Failure::misuse("no recording given", "name a recording and --request FILE"));
    };
    let looked = look(recording, request, args.method, args.save.as_deref());
    let report = told(looked, args.json, json!({ "detections": [] }))?;
    // What was seen is told first: it must not be lost to a full disk.
    match args.json {
        true => crate::output::json(&report)?,
        false => out!("{}", report.text()),
    }
    if let Some(out) = &args.out {
        write(out, &report)?;
    }
    Ok(report.is_complete())
}

/// Minutes of simulated video.
fn minutes(text: &str) -> Result<f64, String> {
    let minutes: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    match (0.0..=MOST_MINUTES).contains(&minutes) {
        true => Ok(minutes),
        false => Err(format!("not between 0 and {MOST_MINUTES}")),
    }
}

/// Every episode of a folder; the answers go to `<out>/<episode>.json`. True when of at least
/// one tag it is decided whether it is there, as the others are counted by who reads the answers. An episode
/// that cannot be read is told on standard error and stops no other.
fn run_set(set: &Path, out: &Path, method: Method) -> Result<bool, Failure> {
    let unreadable = |e| Failure::misuse(format!("{}: {e}", set.display()), "name a folder");
    let mut episodes: Vec<PathBuf> = std::fs::read_dir(set)
        .map_err(unreadable)?
        .filter_map(|entry| entry.ok().map(|e| e.path()))
        .filter(|path| path.join("request.json").is_file())
        .collect();
    episodes.sort();
    if episodes.is_empty() {
        let message = format!("{}: no episode in it", set.display());
        return Err(Failure::misuse(message, "an episode is a folder with a request.json"));
    }
    std::fs::create_dir_all(out).map_err(|e| {
        Failure::failed(format!("{}: {e}", out.display()), "name a folder that can be written")
    })?;
    let (mut answered, mut bad) = (false, Vec::new());
    for episode in &episodes {
        let (recording, request) = (episode.join("recording.mcap"), episode.join("request.json"));
        let name = episode.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let answer = out.join(format!("{name}.json"));
        match look(&recording, &request, method, None) {
            Ok(report) => {
                eprintln!("{name}: {}", report.line());
                write(&answer, &report)?;
                answered |= report.is_answered();
            }
            Err(failure) => {
                eprintln!("{name}: {}", failure.message);
                // What an earlier run answered would be read as this one's.
                let _ = std::fs::remove_file(&answer);
                bad.push(failure);
            }
        }
    }
    if let Some(first) = bad.first() {
        let (bad, episodes) = (bad.len(), episodes.len());
        let message = format!("{bad} of {episodes} episodes could not be read, as told above");
        let hint = "correct their recordings or requests".into();
        return Err(Failure { message, hint, status: first.status });
    }
    Ok(answered)
}

fn write(path: &Path, report: &Report) -> Result<(), Failure> {
    std::fs::write(path, report.json()).map_err(|e| {
        Failure::failed(format!("{}: {e}", path.display()), "name a file that can be written")
    })
}

/// Looks through one recording; pictures of what is found go to `save`.
fn look(
    recording: &Path,
    request: &Path,
    method: Method,
    save: Option<&Path>,
) -> Result<Report, Failure> {
    let request = BlinkRequest::read(request)?;
    let mut finder: Box<dyn Finder> = match method {
        Method::Paper => {
            let finder = paper::PaperFinder::new(request.tags.clone(), paper::Config::default());
            Box::new(finder.map_err(|e| refused(&e))?)
        }
        Method::Sequential => {
            let config = sequential::Config::default();
            let finder = sequential::SequentialFinder::new(request.tags.clone(), config);
            Box::new(finder.map_err(|e| refused(&e))?)
        }
    };
    let started = Instant::now();
    let (mut frames, mut first, mut kept) = (0, None, Vec::new());
    let unreadable = |e: RecordingError| {
        Failure::misuse(e, "name a ROS 2 recording (MCAP) and, as `camera`, its image topic")
    };
    let frames_of = recording::frames(recording, &request.camera, request.exposure);
    for frame in frames_of.map_err(unreadable)? {
        let mut frame = frame.map_err(unreadable)?;
        frame.row_time = request.row_time;
        first.get_or_insert(frame.stamp);
        finder.push(&frame).map_err(|e| refused(&e))?;
        frames += 1;
        if save.is_some() {
            kept.push(frame);
        }
    }
    finder.finish();
    let Some(first) = first else {
        let message = format!("{}: no image on `{}`", recording.display(), request.camera);
        return Err(Failure::misuse(message, "name the image topic as `camera` in the request"));
    };
    let seconds = started.elapsed().as_secs_f64();
    if let Some(dir) = save {
        picture::save(dir, &kept, &request.tags, finder.decisions())?;
    }
    Ok(Report::new(&request, finder.decisions(), first, frames, seconds))
}

fn refused(error: &FinderError) -> Failure {
    Failure::misuse(error, "correct the request or the recording")
}
