//! Time per 640x480 frame of either method, for 1, 16 and 64 patterns, over tag-free video.
//!
//! `sequential` and `paper`: an iteration is a frame, a sample the mean over 120 of them. The first sample
//! is the start, where scans come more often (mostly the slowest), the last one is frames 361 to 480.
//! `sequential_single`: a sample is one frame, so that its slowest is the worst frame of all. The memory
//! of the window is taken before the first frame.

use std::time::Duration;

use divan::Bencher;
use vergence_imaging::Frame;
use vergence_landmark::paper::{self, PaperFinder};
use vergence_landmark::sequential::SequentialFinder;
use vergence_landmark::synthetic::Scene;
use vergence_landmark::{Finder, Request};
use vergence_tag::Pattern;
use vergence_tag::codebook::Rules;

/// Columns and rows of a frame.
const WIDTH: usize = 640;
const HEIGHT: usize = 480;

/// Frames of a sample.
const BATCH: u32 = 120;

/// Samples of the sequential method.
const SAMPLES: u32 = 4;

fn main() {
    divan::main();
}

fn requests(count: usize) -> Vec<Request> {
    let rules = Rules { third_null: false, ..Rules::MANY };
    let chip = Duration::from_micros(33_333);
    let pattern = |bits| Pattern::new(bits, chip).expect("a code is a pattern");
    let request = |(k, bits)| Request {
        id: format!("tag-{k}"),
        pattern: pattern(bits),
        clock_tolerance: 2e-4,
    };
    rules.codes().take(count).enumerate().map(request).collect()
}

/// So many frames. None is shown twice: noise that repeats is a pattern.
fn video(frames: u32) -> Vec<Frame> {
    let scene = Scene::textured(WIDTH, HEIGHT, 1);
    let mut film = scene.film(2);
    (0..frames).map(|_| film.next_frame().expect("no compression, no error")).collect()
}

/// Times `push` for frame after frame; `start` makes a new finder whenever the video begins.
fn watch<F: Finder>(bencher: Bencher, video: &[Frame], start: impl Fn() -> F) {
    let (mut finder, mut frames) = (start(), video.iter());
    bencher.bench_local(|| {
        let frame = frames.next().unwrap_or_else(|| {
            (finder, frames) = (start(), video[1..].iter());
            &video[0]
        });
        finder.push(frame).expect("frames are in order");
    });
}

/// A finder that is ready for the first frame.
fn ready(patterns: usize) -> SequentialFinder {
    let finder = SequentialFinder::new(requests(patterns), Default::default());
    let mut finder = finder.expect("the requests differ");
    finder.prepare((WIDTH, HEIGHT)).expect("the pictures are small");
    finder
}

#[divan::bench(args = [1, 16, 64], sample_count = SAMPLES, sample_size = BATCH)]
fn sequential(bencher: Bencher, patterns: usize) {
    watch(bencher, &video(SAMPLES * BATCH), || ready(patterns));
}

#[divan::bench(args = [1, 16, 64], sample_count = SAMPLES * BATCH, sample_size = 1)]
fn sequential_single(bencher: Bencher, patterns: usize) {
    watch(bencher, &video(SAMPLES * BATCH), || ready(patterns));
}

#[divan::bench(args = [1, 16, 64], sample_count = 2, sample_size = BATCH)]
fn paper(bencher: Bencher, patterns: usize) {
    let config = paper::Config { frames: BATCH as usize, ..Default::default() };
    let start = || PaperFinder::new(requests(patterns), config.clone());
    watch(bencher, &video(BATCH), || start().expect("the requests differ"));
}
