//! Time per 640x480 frame of either method, for 1 to 64 patterns, over tag-free video.
//!
//! An iteration is a batch of frames: scans of the sequential method fall on some frames and not on
//! others, so the mean is what a camera's frame rate must beat.

use std::time::Duration;

use divan::Bencher;
use vergence_imaging::Frame;
use vergence_landmark::paper::PaperFinder;
use vergence_landmark::sequential::SequentialFinder;
use vergence_landmark::synthetic::Scene;
use vergence_landmark::{Finder, Request};
use vergence_tag::Pattern;
use vergence_tag::codebook::Rules;

/// Frames pushed per measurement, so that the rare scans are counted in full. None is shown twice:
/// noise that repeats is a pattern.
const BATCH: usize = 120;

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

fn video() -> Vec<Frame> {
    let scene = Scene::textured(640, 480, 1);
    let mut film = scene.film(2);
    (0..BATCH).map(|_| film.next_frame().expect("no compression, no error")).collect()
}

/// Pushes a batch of frames.
fn watch(finder: &mut dyn Finder, video: &[Frame]) {
    for frame in video {
        finder.push(frame).expect("frames are in order");
    }
}

#[divan::bench(args = [1, 16, 64], sample_count = 5, sample_size = 1)]
fn sequential_120_frames(bencher: Bencher, patterns: usize) {
    let video = video();
    let start = || SequentialFinder::new(requests(patterns), Default::default());
    bencher.counter(divan::counter::ItemsCount::new(BATCH)).bench_local(|| {
        let mut finder = start().expect("the requests differ");
        watch(&mut finder, &video);
    });
}

#[divan::bench(args = [1, 16], sample_count = 3, sample_size = 1)]
fn paper_120_frames(bencher: Bencher, patterns: usize) {
    let video = video();
    bencher.counter(divan::counter::ItemsCount::new(BATCH)).bench_local(|| {
        let config = vergence_landmark::paper::Config { frames: BATCH, ..Default::default() };
        let mut finder = PaperFinder::new(requests(patterns), config).expect("the requests differ");
        watch(&mut finder, &video);
    });
}
