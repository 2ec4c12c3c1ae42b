//! Video of blinking lights with known truth: for tests, benches and the Monte Carlo command.
//!
//! A flat or textured background under pixel noise, with point lights that play patterns at their own
//! phase and clock rate, and what gets in the way: lamps, screens, shake, passing things, heavy-tailed
//! noise, lost frames, JPEG. Frames are integrated over the exposure of every row, as a camera does.
//! Seeded: the same seed gives the same frames.

use std::f64::consts::TAU;
use std::time::Duration;

use nalgebra::Point2;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vergence_imaging::{CodecError, Frame, Image, codec};
use vergence_tag::Pattern;

/// Standard deviation of a light's image (px).
const LIGHT_PX: f64 = 0.68;

/// A blinking point.
#[derive(Debug, Clone, PartialEq)]
pub struct Light {
    /// Where (px).
    pub place: Point2<f64>,
    /// Brightness of its peak when on (grey levels).
    pub amplitude: f64,
    /// What it plays.
    pub pattern: Pattern,
    /// Seconds into the pattern at the first frame.
    pub phase: f64,
    /// Its clock's rate relative to the camera's.
    pub rate: f64,
}

/// A rectangle whose brightness jumps to a random level at a fixed rate: a screen; or a grey thing
/// that passes, when it moves.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// Left, top, width, height at the first frame (px).
    pub rect: [f64; 4],
    /// Motion (px/s).
    pub speed: [f64; 2],
    /// Largest change of the background inside (grey levels).
    pub depth: f64,
    /// New levels a second; zero: it keeps its level.
    pub rate: f64,
}

/// What the camera looks at and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// The background (grey levels).
    pub background: Image<f32>,
    /// Blinking points.
    pub lights: Vec<Light>,
    /// Screens and passing things.
    pub patches: Vec<Patch>,
    /// Lamps: frequency of the flicker (Hz) and its depth relative to the background.
    pub lamps: Vec<(f64, f64)>,
    /// Standard deviation of the pixel noise (grey levels).
    pub noise: f64,
    /// Share of pixels with five times the noise.
    pub heavy_tail: f64,
    /// Standard deviation of the random shift of every frame (px).
    pub shake: f64,
    /// Share of frames that are lost.
    pub dropped: f64,
    /// Frames a second.
    pub frame_rate: f64,
    /// Exposure of a row (s).
    pub exposure: f64,
    /// Time between the starts of two rows (s).
    pub row_time: f64,
    /// JPEG quality; `None`: not compressed.
    pub jpeg: Option<u8>,
}

impl Scene {
    /// A flat grey background without anything, 30 frames/s, 5 ms exposure, noise of 2 grey levels.
    pub fn flat(width: usize, height: usize) -> Self {
        Scene {
            background: Image::filled(width, height, 90.0),
            lights: Vec::new(),
            patches: Vec::new(),
            lamps: Vec::new(),
            noise: 2.0,
            heavy_tail: 0.0,
            shake: 0.0,
            dropped: 0.0,
            frame_rate: 30.0,
            exposure: 0.005,
            row_time: 0.0,
            jpeg: None,
        }
    }

    /// The same with smooth texture and a few sharp edges, as a table with things on it has.
    pub fn textured(width: usize, height: usize, seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut waves = Vec::new();
        for _ in 0..6 {
            waves.push([
                rng.random::<f64>() * 0.3,
                rng.random::<f64>() * 0.3,
                rng.random::<f64>() * TAU,
            ]);
        }
        let box_of = |r: &mut Pcg64Mcg| {
            let (x, y) = (r.random::<f64>() * width as f64, r.random::<f64>() * height as f64);
            [x, y, x + 20.0 + 30.0 * r.random::<f64>(), y + 20.0 + 30.0 * r.random::<f64>()]
        };
        let boxes: Vec<([f64; 4], f64)> =
            (0..5).map(|_| (box_of(&mut rng), 80.0 * rng.random::<f64>() - 40.0)).collect();
        let level = |x: usize, y: usize| {
            let (u, v) = (x as f64, y as f64);
            let texture: f64 = waves.iter().map(|[a, b, p]| 6.0 * (a * u + b * v + p).sin()).sum();
            let inside = |b: &[f64; 4]| u >= b[0] && u < b[2] && v >= b[1] && v < b[3];
            let things: f64 = boxes.iter().filter(|(b, _)| inside(b)).map(|(_, d)| d).sum();
            (100.0 + texture + things).clamp(10.0, 220.0) as f32
        };
        Scene { background: Image::from_fn(width, height, level), ..Scene::flat(width, height) }
    }

    /// The camera's frames from time zero on, without end.
    pub fn film(&self, seed: u64) -> Film<'_> {
        Film { scene: self, rng: Pcg64Mcg::seed_from_u64(seed), index: 0, levels: Vec::new() }
    }
}

/// The frames of a scene.
#[derive(Debug, Clone)]
pub struct Film<'a> {
    scene: &'a Scene,
    rng: Pcg64Mcg,
    index: u64,
    /// Level of every patch and when it was drawn.
    levels: Vec<(f64, f64)>,
}

impl Film<'_> {
    /// The next frame that is not lost.
    pub fn next_frame(&mut self) -> Result<Frame, CodecError> {
        let scene = self.scene;
        while self.index > 0 && self.rng.random::<f64>() < scene.dropped {
            self.index += 1;
        }
        let time = self.index as f64 / scene.frame_rate;
        let shift = [normal(&mut self.rng), normal(&mut self.rng)].map(|n| n * scene.shake);
        let mut picture = scene.background.clone();
        if scene.shake > 0.0 {
            let (w, h) = (picture.width(), picture.height());
            picture = Image::from_fn(w, h, |x, y| {
                scene.background.sample(x as f32 - shift[0] as f32, y as f32 - shift[1] as f32)
            });
        }
        self.patches(&mut picture, time);
        scene.lamp_light(&mut picture, time);
        scene.point_lights(&mut picture, time, shift);
        let mut image = self.expose(&picture);
        if let Some(quality) = scene.jpeg {
            image = codec::decode(&codec::encode_jpeg(&image, quality)?)?;
        }
        let frame = Frame {
            image,
            stamp: Duration::from_secs(100) + Duration::from_secs_f64(time),
            exposure: Duration::from_secs_f64(scene.exposure),
            row_time: None,
            sequence: self.index,
        };
        self.index += 1;
        Ok(frame)
    }

    fn patches(&mut self, picture: &mut Image<f32>, time: f64) {
        let scene = self.scene;
        self.levels.resize(scene.patches.len(), (1.0, f64::NEG_INFINITY));
        for (patch, (level, since)) in scene.patches.iter().zip(&mut self.levels) {
            if patch.rate > 0.0 && (time - *since) * patch.rate >= 1.0 {
                (*level, *since) = (2.0 * self.rng.random::<f64>() - 1.0, time);
            }
            let [left, top, width, height] = patch.rect;
            let left = left + patch.speed[0] * time;
            let top = top + patch.speed[1] * time;
            for y in 0..picture.height() {
                for (x, value) in picture.row_mut(y).iter_mut().enumerate() {
                    let (u, v) = (x as f64 - left, y as f64 - top);
                    if u >= 0.0 && v >= 0.0 && u < width && v < height {
                        *value += (*level * patch.depth) as f32;
                    }
                }
            }
        }
    }

    /// Noise and rounding.
    fn expose(&mut self, picture: &Image<f32>) -> Image<u8> {
        let (noise, tail) = (self.scene.noise, self.scene.heavy_tail);
        let rng = &mut self.rng;
        picture.map(|value| {
            let wide = if tail > 0.0 && rng.random::<f64>() < tail { 5.0 } else { 1.0 };
            (f64::from(value) + noise * wide * normal(rng)).round().clamp(0.0, 255.0) as u8
        })
    }
}

impl Scene {
    fn lamp_light(&self, picture: &mut Image<f32>, time: f64) {
        if self.lamps.is_empty() {
            return;
        }
        for y in 0..picture.height() {
            let start = time + y as f64 * self.row_time;
            let gain: f64 = self
                .lamps
                .iter()
                .map(|&(hz, depth)| {
                    let omega = TAU * hz;
                    let mean = if self.exposure > 0.0 {
                        ((omega * start).cos() - (omega * (start + self.exposure)).cos())
                            / (omega * self.exposure)
                    } else {
                        (omega * start).sin()
                    };
                    depth * mean
                })
                .sum();
            picture.row_mut(y).iter_mut().for_each(|v| *v *= 1.0 + gain as f32);
        }
    }

    fn point_lights(&self, picture: &mut Image<f32>, time: f64, shift: [f64; 2]) {
        for light in &self.lights {
            let centre = (light.place.x + shift[0], light.place.y + shift[1]);
            let range = |c: f64, n: usize| {
                let low = (c - 5.0).max(0.0) as usize;
                low..((c + 6.0).max(0.0) as usize).min(n)
            };
            for y in range(centre.1, picture.height()) {
                let start = light.phase + light.rate * (time + y as f64 * self.row_time);
                let on = light.pattern.on_fraction(start, light.rate * self.exposure);
                for x in range(centre.0, picture.width()) {
                    let r2 = (x as f64 - centre.0).powi(2) + (y as f64 - centre.1).powi(2);
                    let value = light.amplitude * on * (-r2 / (2.0 * LIGHT_PX * LIGHT_PX)).exp();
                    picture.row_mut(y)[x] += value as f32;
                }
            }
        }
    }
}

/// A standard normal number (Box-Muller, one of the pair).
fn normal(rng: &mut impl Rng) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (TAU * rng.random::<f64>()).cos()
}
