//! What the finder saw, for people to look at: frames and a sighting in, pictures' contents out.
//!
//! The same steps as in the finder, but for one place and request at every frame, and for one request
//! at every pixel at the end. It decides nothing and costs seconds.

use nalgebra::Point2;
use vergence_imaging::{Frame, Image};

use super::evidence::{Evidence, Series, refine, weigh};
use super::front::Variation;
use super::history::{History, noise_share};
use super::motion::Reference;
use super::nuisance::{Lamps, Nuisance};
use super::scan::{BlockNoise, MARGIN};
use super::template::{Bank, rates};
use super::{Config, FIRST_FRAMES, past, verdict};
use crate::finder::{Sequence, check_requests};
use crate::{FinderError, Request, Sighting};

/// The evidence at one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// Seconds since the first frame.
    pub time: f64,
    /// Log likelihood ratio of the request.
    pub own: f64,
    /// That of the best other request; zero without any.
    pub rival: f64,
}

/// Brightness at one frame (grey levels), what changes it besides the tag taken out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Seconds since the first frame.
    pub time: f64,
    /// As measured.
    pub measured: f64,
    /// As the pattern at the best phase gives it.
    pub expected: f64,
}

/// What speaks for one sighting.
#[derive(Debug, Clone, PartialEq)]
pub struct Explanation {
    /// Log likelihood ratio of the request at every pixel over all frames; zero at the border.
    pub map: Image<f32>,
    /// Log likelihood ratio that presence needs.
    pub presence: f64,
    /// Lead over every other request that identity needs.
    pub margin: f64,
    /// The evidence at the place, frame by frame.
    pub course: Vec<Moment>,
    /// The light at the place, frame by frame.
    pub samples: Vec<Sample>,
}

/// Explains a sighting of `requests[request]` in these frames; they must be the frames that the
/// finder was given.
pub fn explain(
    frames: &[Frame],
    requests: &[Request],
    config: &Config,
    request: usize,
    sighting: &Sighting,
) -> Result<Explanation, FinderError> {
    check_requests(requests)?;
    let whole = Watcher::over(frames, |_| Ok(()))?;
    let (sx, sy) = whole.history.mean_shift();
    let place = Point2::new(sighting.pixel.x - sx, sighting.pixel.y - sy);
    let mut course = Vec::new();
    Watcher::over(frames, |now| {
        if now.history.len() >= FIRST_FRAMES {
            let level = |r: usize| now.weigh(place, &requests[r]).map_or(0.0, |e| e.log_ratio);
            let rivals = (0..requests.len()).filter(|r| *r != request).map(level);
            let time = now.history.times().last().map_or(0.0, |t| t.0);
            course.push(Moment { time, own: level(request), rival: rivals.fold(0.0, f64::max) });
        }
        Ok(())
    })?;
    let size = frames.first().map_or((0, 0), |f| (f.image.width(), f.image.height()));
    Ok(Explanation {
        map: whole.map(&requests[request], size),
        presence: verdict::presence::presence(size, requests.len(), config.false_alarm),
        margin: verdict::identity::margin(requests.len() - 1, config.wrong_identity),
        samples: whole.samples(place, &requests[request]),
        course,
    })
}

/// The front of the finder with a window that holds all frames.
struct Watcher {
    history: History,
    variation: Variation,
    noise: BlockNoise,
    nuisance: Nuisance,
}

impl Watcher {
    /// Takes all frames and calls `each` after every one.
    fn over(
        frames: &[Frame],
        mut each: impl FnMut(&Watcher) -> Result<(), FinderError>,
    ) -> Result<Watcher, FinderError> {
        let pixels = frames.first().map_or(0, |f| f.image.data().len());
        let history = History::new(frames.len().max(1));
        let nuisance = Nuisance::of(&history, &Lamps::default());
        let variation = Variation::new(pixels, frames.len().max(1));
        let mut watcher = Watcher { history, variation, noise: BlockNoise::default(), nuisance };
        let (mut sequence, mut reference) = (Sequence::default(), Reference::default());
        for frame in frames {
            let time = sequence.accept(frame)?;
            let (past, filtered) = past(&mut reference, frame, time, None);
            watcher.variation.push(filtered.data());
            watcher.history.push(past, &filtered)?;
            let (w, h) = watcher.history.size();
            let n = watcher.history.len();
            watcher.noise = BlockNoise::new(watcher.variation.energy(), w, h, n);
            watcher.nuisance = Nuisance::of(&watcher.history, &Lamps::of(&watcher.history));
            each(&watcher)?;
        }
        Ok(watcher)
    }

    fn bank(&self, request: &Request) -> Bank {
        let times = self.history.times();
        let span = times.last().map_or(0.0, |t| t.0);
        let rates = rates(&request.pattern, request.clock_tolerance, span);
        let mut bank = Bank::new(&request.pattern, &rates, times, self.history.len());
        bank.fit(times, self.history.numbers(), &self.nuisance);
        bank
    }

    fn series(&self, place: Point2<f64>) -> Series {
        let mut raw = Vec::new();
        self.history.series(place, &mut raw);
        let noise = self.noise.at(place.x as usize, place.y as usize) * noise_share(place);
        Series::new(&raw, &self.nuisance, Vec::new(), noise)
    }

    fn weigh(&self, place: Point2<f64>, request: &Request) -> Option<Evidence> {
        weigh(&self.series(place), &self.bank(request), 0.0, &mut Vec::new())
    }

    fn map(&self, request: &Request, (width, height): (usize, usize)) -> Image<f32> {
        let mut map = Image::filled(width, height, 0.0f32);
        let bank = self.bank(request);
        let (mut raw, mut scratch) = (Vec::new(), Vec::new());
        for y in MARGIN..height.saturating_sub(MARGIN) {
            for x in MARGIN..width.saturating_sub(MARGIN) {
                self.history.series_at((x, y), &mut raw);
                let series = Series::new(&raw, &self.nuisance, Vec::new(), self.noise.at(x, y));
                let evidence = weigh(&series, &bank, 0.0, &mut scratch);
                map.set(x, y, evidence.map_or(0.0, |e| e.log_ratio.max(0.0)) as f32);
            }
        }
        map
    }

    fn samples(&self, place: Point2<f64>, request: &Request) -> Vec<Sample> {
        let (bank, series) = (self.bank(request), self.series(place));
        let Some(start) = weigh(&series, &bank, 0.0, &mut Vec::new()) else { return Vec::new() };
        let (pattern, times) = (&request.pattern, self.history.times());
        let best = refine(&series, pattern, times, &self.nuisance, start, bank.step);
        let mut expected = Vec::new();
        series.expect(pattern, times, &best.best, &self.nuisance, &mut expected);
        let amplitude = best.amplitude();
        let sample = |((t, e), m): ((&(f64, f64), &f32), &f32)| Sample {
            time: t.0,
            measured: f64::from(*m),
            expected: amplitude * f64::from(*e),
        };
        times.iter().zip(&expected).zip(&series.values).map(sample).collect()
    }
}
