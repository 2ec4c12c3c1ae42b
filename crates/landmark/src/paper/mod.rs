//! The paper's own method: on/off difference, projection histogram, commanded flicker frequency.
//!
//! In: frames of a camera at rest. Out: one place a request, or [`Decision::Absent`], after a fixed
//! number of frames, or after fewer when no more come; too few for a spectrum leave it undecided. Frames
//! whose stamps make no series start the watch anew. The steps bear the names of sections 2.2 and 2.3 of
//! the paper:
//! 1. images A and B, one with the LED on and one with it off: here two frames a chip apart, since
//!    camera and tag share no clock;
//! 2. blur, against the noise of a cheap camera (figure 6), and subtraction ([`difference`]);
//! 3. the place where a large difference is asserted continuously, by projection histogram analysis
//!    along x, then along y ([`histogram`]);
//! 4. choice among flickering things by the commanded frequency (figures 7, 8; [`spectrum`]).
//!
//! What it does not do is as much the paper's: no model of noise or of the camera's motion, no stated
//! rate of false alarms, positions good to about a pixel, codes known by their strongest line only.
//! It is the yardstick that [`crate::sequential`] is measured against.

pub mod difference;
pub mod histogram;
pub mod spectrum;

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::{Matrix2, Point2};
use vergence_imaging::{Frame, Image, kernel};

use crate::finder::{Sequence, check_requests};
use crate::{Decision, Finder, FinderError, Request, Sighting};
use difference::PersistentDifference;
use histogram::Projection;
use spectrum::{Line, Spectrum};

/// Fewest frames that are decided on when no more come: five flickers of three frames a chip, whose line
/// lies well above the entries of the spectrum that the background's drift covers.
const LEAST_FRAMES: usize = 30;

/// Settings of the paper's method. The paper gives no numbers; these are ours.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Standard deviation of the blur (px); about that of a small light's image.
    pub blur_px: f32,
    /// Frames over which a difference must persist before a request is decided.
    pub frames: usize,
    /// What counts as a large difference, in medians of the difference over the picture.
    pub large: f32,
    /// How many flickering places are tried for the commanded frequency, largest first.
    pub candidates: usize,
    /// How far the commanded line must stand above the median of the spectrum.
    pub line_ratio: f64,
}

impl Default for Config {
    fn default() -> Self {
        Config { blur_px: 1.0, frames: 90, large: 5.0, candidates: 8, line_ratio: 4.0 }
    }
}

/// The pictures of the method for one request.
#[derive(Debug, Clone, PartialEq)]
pub struct Evidence {
    /// Mean of the large differences |A - B| at every pixel (grey levels).
    pub difference: Image<f32>,
    /// Its projection histograms.
    pub projection: Projection,
    /// What flickers, largest first: place and spectrum of the brightness there.
    pub candidates: Vec<(Point2<f64>, Spectrum)>,
    /// The line that was commanded.
    pub line: Line,
    /// Which candidate shows it.
    pub chosen: Option<usize>,
}

/// The paper's method as a [`Finder`].
#[derive(Debug, Clone)]
pub struct PaperFinder {
    requests: Vec<Request>,
    config: Config,
    sequence: Sequence,
    /// Blurred frames and their times (s), as many as the longest chip needs.
    recent: VecDeque<(f64, Image<f32>)>,
    /// Every frame of the window with its time (s), for the spectra.
    window: Vec<(f64, Image<u8>)>,
    differences: Vec<PersistentDifference>,
    decisions: Vec<Decision>,
    evidence: Vec<Evidence>,
}

impl PaperFinder {
    /// A finder for these requests.
    pub fn new(requests: Vec<Request>, config: Config) -> Result<Self, FinderError> {
        check_requests(&requests)?;
        let differences = differences(&requests, &config);
        Ok(PaperFinder {
            decisions: vec![Decision::Undecided; requests.len()],
            requests,
            config,
            sequence: Sequence::default(),
            recent: VecDeque::new(),
            window: Vec::new(),
            differences,
            evidence: Vec::new(),
        })
    }

    /// The pictures behind the decisions, one a request; empty until they have fallen.
    pub fn evidence(&self) -> &[Evidence] {
        &self.evidence
    }

    fn decide(&mut self, stamp: Duration) {
        let times: Vec<f64> = self.window.iter().map(|(t, _)| *t).collect();
        if !spectrum::are_regular(&times) {
            self.differences = differences(&self.requests, &self.config);
            self.window.clear();
            self.recent.clear();
            return;
        }
        for (k, request) in self.requests.iter().enumerate() {
            let difference = self.differences[k].mean();
            let projection = Projection::of(&difference);
            let line = Line::strongest(&request.pattern);
            let places = histogram::places(&difference, self.config.candidates);
            let candidates: Vec<(Point2<f64>, Spectrum)> = places
                .into_iter()
                .map(|place| (place, Spectrum::new(&times, &brightness(&self.window, place))))
                .collect();
            let chosen = candidates
                .iter()
                .position(|(_, spectrum)| spectrum.shows(line.frequency, self.config.line_ratio));
            self.decisions[k] = match chosen {
                None => Decision::Absent,
                Some(c) => {
                    let (pixel, spectrum) = &candidates[c];
                    let last = times.last().copied().unwrap_or_default();
                    let phase = spectrum.time_into(&line, last);
                    Decision::Here(vec![Sighting {
                        pixel: *pixel,
                        // The paper names none; the peak of a histogram is good to half a pixel.
                        covariance: Matrix2::identity() * 0.25,
                        amplitude: spectrum.amplitude(line.frequency) / line.amplitude,
                        snr: spectrum.amplitude(line.frequency) / spectrum.median(),
                        phase: phase.rem_euclid(request.pattern.period().as_secs_f64()),
                        decided_at: stamp,
                        frames: times.len(),
                    }])
                }
            };
            self.evidence.push(Evidence { difference, projection, candidates, line, chosen });
        }
        self.window.clear();
        self.recent.clear();
    }
}

/// One for each request, nothing gathered yet.
fn differences(requests: &[Request], config: &Config) -> Vec<PersistentDifference> {
    let lag = |r: &Request| r.pattern.chip.as_secs_f64();
    requests.iter().map(|r| PersistentDifference::new(lag(r), config.large)).collect()
}

/// Mean of the 3x3 pixels at a place in every frame.
fn brightness(window: &[(f64, Image<u8>)], place: Point2<f64>) -> Vec<f64> {
    let (x, y) = (place.x.round() as usize, place.y.round() as usize);
    let mean = |image: &Image<u8>| {
        let near = |dy: usize, dx: usize| {
            image.get((x + dx).saturating_sub(1), (y + dy).saturating_sub(1)).map(f64::from)
        };
        let (sum, count) = (0..9)
            .filter_map(|i| near(i / 3, i % 3))
            .fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
        sum / f64::max(count, 1.0)
    };
    window.iter().map(|(_, image)| mean(image)).collect()
}

impl Finder for PaperFinder {
    fn push(&mut self, frame: &Frame) -> Result<(), FinderError> {
        let time = self.sequence.accept(frame)?;
        if !self.evidence.is_empty() {
            return Ok(());
        }
        let blurred = kernel::gaussian_blur(&frame.image, self.config.blur_px);
        for difference in &mut self.differences {
            difference.push(time, &blurred, &self.recent);
        }
        self.recent.push_back((time, blurred));
        let reach = self.differences.iter().map(|d| d.lag()).fold(0.0, f64::max);
        // One frame older than the longest lag stays, so that the nearest to it is always there.
        while self.recent.len() > 2 && self.recent[1].0 < time - reach {
            self.recent.pop_front();
        }
        self.window.push((time, frame.image.clone()));
        if self.window.len() >= self.config.frames {
            self.decide(frame.stamp);
        }
        Ok(())
    }

    fn finish(&mut self) {
        let last = self.sequence.last_stamp();
        if let (Some(stamp), true) = (last, self.window.len() >= LEAST_FRAMES) {
            self.decide(stamp);
        }
    }

    fn decisions(&self) -> &[Decision] {
        &self.decisions
    }
}

#[cfg(test)]
mod tests {
    use vergence_tag::Pattern;

    use super::*;
    use crate::synthetic::{Light, Scene};

    /// A light that flickers at 10 frames a second before the finder.
    fn film(frames: usize) -> (PaperFinder, Vec<Frame>) {
        let pattern = Pattern::new("10".parse().unwrap(), Duration::from_millis(300)).unwrap();
        let request = Request { id: "cup".into(), pattern, clock_tolerance: 2e-4 };
        let place = Point2::new(20.0, 25.0);
        let light = Light { place, amplitude: 60.0, pattern, phase: 0.1, rate: 1.0 };
        let scene = Scene { lights: vec![light], frame_rate: 10.0, ..Scene::flat(48, 40) };
        let mut film = scene.film(3);
        let frames = (0..frames).map(|_| film.next_frame().unwrap()).collect();
        (PaperFinder::new(vec![request], Config::default()).unwrap(), frames)
    }

    #[test]
    fn a_slow_camera_is_decided_on_with_the_frames_that_came() {
        let (mut finder, frames) = film(60);
        frames.iter().for_each(|frame| finder.push(frame).unwrap());
        assert_eq!(finder.decisions(), [Decision::Undecided]);
        finder.finish();
        let sighting = finder.decisions()[0].brightest().unwrap();
        assert!((sighting.pixel - Point2::new(20.0, 25.0)).norm() < 1.5, "{sighting:?}");
        assert_eq!(sighting.frames, 60);
    }

    #[test]
    fn too_few_frames_are_not_decided_on() {
        let (mut finder, frames) = film(LEAST_FRAMES - 1);
        frames.iter().for_each(|frame| finder.push(frame).unwrap());
        finder.finish();
        assert_eq!(finder.decisions(), [Decision::Undecided]);
    }

    #[test]
    fn a_clock_that_jumps_by_hours_starts_the_watch_anew() {
        let (mut finder, mut frames) = film(180);
        for (k, frame) in frames.iter_mut().enumerate() {
            frame.stamp = match k {
                0..60 => Duration::from_micros(k as u64),
                _ => frame.stamp + Duration::from_secs(36_000),
            };
        }
        for (k, frame) in frames.iter().enumerate() {
            finder.push(frame).unwrap();
            assert_eq!(finder.is_done(), k == 179, "frame {k}: {:?}", finder.decisions());
        }
        assert!(finder.decisions()[0].brightest().is_some());
    }
}
