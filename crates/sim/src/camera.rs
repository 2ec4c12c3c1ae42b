//! The camera: from linear light to grey frames.
//!
//! While a head rests the scene's light does not change, so the picture of every layer is kept per
//! head pose, blurred by the lens; a frame adds what varies: flicker of the lamps, the blinking
//! lights integrated over the exposure of their row, noise, response curve and quantisation.

use std::sync::Arc;

use nalgebra::{Point3, Vector3};
use rand::Rng;
use vergence_geometry::{Camera as Lens, Transform};
use vergence_imaging::{Image, codec, kernel};

use crate::config::{CameraSettings, LightSettings};
use crate::lights::{Flicker, Play};
use crate::noise::{normal_table, stream};
use crate::placement::to_single;
use crate::scene::{Emitter, LAYERS, Layer, Scene};
use crate::trace::{LANES, RayGrid, Rendering, Stage, clear_share, is_clear, render};

/// Exposure at which the lights' strengths are given (s).
pub const REFERENCE_EXPOSURE: f64 = 0.004;
/// Blur that the rough table adds to mirrored LEDs (px).
const MIRROR_SIGMA_PX: f64 = 1.5;

/// A blinking light and all it played lately.
#[derive(Debug, Clone)]
pub struct Blinker {
    /// The light.
    pub emitter: Emitter,
    /// What it plays.
    pub plays: Vec<Play>,
}

/// What a camera needs of the world to make one frame.
#[derive(Debug, Clone)]
pub struct Capture {
    /// Running number.
    pub sequence: u64,
    /// Start of the exposure of the first row (s).
    pub start: f64,
    /// `base_from_optical` of both cameras at the middle of the exposure.
    pub base_from_optical: [Transform; 2],
    /// Lights that may blink, those that are dark included.
    pub blinkers: Vec<Blinker>,
    /// What stands where.
    pub stage: Arc<Stage>,
}

/// Light of an emitter that reaches the sensor as one blurred point.
#[derive(Debug, Clone, Copy)]
struct Spot {
    blinker: usize,
    u: f64,
    v: f64,
    sigma_px: f64,
    amount: f64,
}

struct Still {
    base_from_optical: Transform,
    stage: Arc<Stage>,
    layers: Rendering,
    spots: Vec<Spot>,
}

/// Makes the frames of one camera.
pub struct Sensor {
    lens: Lens,
    grid: RayGrid,
    settings: CameraSettings,
    flicker: Flicker,
    response: Vec<f32>,
    seed: u64,
    side: usize,
    still: Option<Still>,
}

/// Entries of the response curve between black and white.
const RESPONSE: usize = 4096;

impl Sensor {
    /// A camera with this (true) lens.
    pub fn new(
        lens: Lens,
        settings: CameraSettings,
        light: &LightSettings,
        seed: u64,
        side: usize,
    ) -> Self {
        let response = (0..=RESPONSE + 1)
            .map(|k| 255.0 * (k as f64 / RESPONSE as f64).powf(1.0 / settings.gamma) as f32)
            .collect();
        let flicker = Flicker::new(light, seed);
        Sensor {
            lens,
            grid: RayGrid::new(&lens),
            settings,
            flicker,
            response,
            seed,
            side,
            still: None,
        }
    }

    /// The picture of a capture.
    pub fn picture(&mut self, capture: &Capture) -> Image<u8> {
        let base_from_optical = capture.base_from_optical[self.side];
        let fresh = self.still.as_ref().is_none_or(|still| {
            still.base_from_optical != base_from_optical
                || !Arc::ptr_eq(&still.stage, &capture.stage)
        });
        if fresh {
            self.still = Some(self.look(capture, base_from_optical));
        }
        let linear = self.expose(capture);
        let picture = self.digitise(&linear, capture.sequence);
        match self.settings.jpeg_quality {
            0 => picture,
            quality => codec::encode_jpeg(&picture, quality)
                .and_then(|bytes| codec::decode(&bytes))
                .unwrap_or(picture),
        }
    }

    fn look(&self, capture: &Capture, base_from_optical: Transform) -> Still {
        let sharp = render(&capture.stage, &self.grid, &base_from_optical);
        let taps = kernel::gaussian_taps(self.settings.psf_sigma_px as f32);
        let layers = sharp.map(|layer| kernel::convolve_separable(&layer, &taps));
        let mut spots = Vec::new();
        for (index, blinker) in capture.blinkers.iter().enumerate() {
            self.spots(
                &capture.stage.scene,
                &base_from_optical,
                index,
                &blinker.emitter,
                &mut spots,
            );
        }
        Still { base_from_optical, stage: capture.stage.clone(), layers, spots }
    }

    /// Where an emitter's light falls on the sensor, directly and by the glossy table.
    fn spots(
        &self,
        scene: &Scene,
        base_from_optical: &Transform,
        blinker: usize,
        emitter: &Emitter,
        out: &mut Vec<Spot>,
    ) {
        let eye = Point3::from(base_from_optical.translation.vector);
        let disc = disc_points(emitter);
        let from = disc.map(|p| to_single(&(p + emitter.normal.into_inner() * 1e-4)));
        let clear = is_clear(scene, &from, &[to_single(&eye); LANES]);
        let sigma_px = self.settings.psf_sigma_px;
        for (point, _) in disc.iter().zip(clear).filter(|(_, clear)| *clear) {
            let amount = lobe(emitter, &(eye - point)) / LANES as f64;
            let optical = base_from_optical.inverse_transform_point(point);
            if let (Some(pixel), true) = (self.lens.project(&optical), amount > 0.0) {
                out.push(Spot { blinker, u: pixel.x, v: pixel.y, sigma_px, amount });
            }
        }
        // The mirrored light: the image of the emitter below the table.
        let height = scene.table_height;
        let below =
            Point3::new(emitter.position.x, emitter.position.y, 2.0 * height - emitter.position.z);
        let Some(table) = scene.bodies.iter().find(|body| body.mirror) else { return };
        if eye.z <= height || emitter.position.z <= height {
            return;
        }
        let share = (eye.z - height) / (eye.z - below.z);
        let on_table = eye + (below - eye) * share;
        let lifted = on_table + Vector3::z() * 5e-4;
        if !table.placed.contains(&on_table, 1e-3) {
            return;
        }
        let [to_eye, to_light] = [to_single(&eye), to_single(&emitter.position)];
        let path = clear_share(scene, &[to_single(&lifted); LANES], &[to_eye; LANES])
            * clear_share(scene, &[to_single(&lifted); LANES], &[to_light; LANES]);
        let cos = (eye.z - below.z) / (eye - below).norm();
        let gloss = f64::from(table.material.gloss);
        let mirrored = gloss + (1.0 - gloss) * 0.6 * (1.0 - cos).powi(5);
        let reach = (eye - below).norm();
        let leaving = (on_table - emitter.position).normalize() * reach;
        let amount = path * mirrored * lobe(emitter, &leaving);
        let optical = base_from_optical.inverse_transform_point(&below);
        if let (Some(pixel), true) = (self.lens.project(&optical), amount > 0.0) {
            let sigma_px = sigma_px.hypot(MIRROR_SIGMA_PX);
            out.push(Spot { blinker, u: pixel.x, v: pixel.y, sigma_px, amount });
        }
    }

    /// Light that falls on the sensor during a frame's exposure, white = 1.
    fn expose(&self, capture: &Capture) -> Image<f32> {
        let (width, height) = (self.lens.width, self.lens.height);
        let mut linear = Image::filled(width, height, 0.0f32);
        let Some(still) = &self.still else { return linear };
        let scale = self.settings.exposure / REFERENCE_EXPOSURE * self.settings.gain;
        for y in 0..height {
            let from = capture.start + y as f64 * self.settings.row_time;
            let mut gains = [scale as f32; LAYERS];
            gains[Layer::Lamp as usize] *= self.flicker.lamp(from, self.settings.exposure) as f32;
            gains[Layer::Screen as usize] *= self.flicker.screen(from) as f32;
            let out = linear.row_mut(y);
            for (layer, gain) in still.layers.iter().zip(gains) {
                for (o, l) in out.iter_mut().zip(layer.row(y)) {
                    *o += gain * l;
                }
            }
        }
        for spot in &still.spots {
            let Some(blinker) = capture.blinkers.get(spot.blinker) else { continue };
            let row = spot.v.clamp(0.0, height as f64 - 1.0);
            let from = capture.start + row * self.settings.row_time;
            let share: f64 =
                blinker.plays.iter().map(|play| play.share(from, self.settings.exposure)).sum();
            if share > 0.0 {
                splat(&mut linear, spot, spot.amount * share * scale);
            }
        }
        linear
    }

    /// Noise, response curve, quantisation.
    fn digitise(&self, linear: &Image<f32>, sequence: u64) -> Image<u8> {
        let mut rng = stream(self.seed, ["left sensor", "right sensor"][self.side & 1], sequence);
        let table = normal_table();
        let shot = 1.0 / self.settings.full_well as f32;
        let read = (self.settings.read_noise / self.settings.full_well) as f32;
        let mut out = Image::filled(linear.width(), linear.height(), 0u8);
        for (pixels, values) in out.data_mut().chunks_mut(4).zip(linear.data().chunks(4)) {
            let mut bits = rng.next_u64();
            for (pixel, &value) in pixels.iter_mut().zip(values) {
                let sigma = (value * shot + read * read).sqrt();
                let noisy = value + sigma * table[(bits & 0xffff) as usize];
                bits >>= 16;
                let at = noisy.clamp(0.0, 1.0) * RESPONSE as f32;
                let k = at as usize;
                let low = self.response[k];
                let grey = low + (at - k as f32) * (self.response[k + 1] - low);
                *pixel = (grey + 0.5).clamp(0.0, 255.0) as u8;
            }
        }
        out
    }
}

/// Eight points that stand for the emitter's disc (same second moments).
fn disc_points(emitter: &Emitter) -> [Point3<f64>; LANES] {
    let n = emitter.normal.into_inner();
    let any = if n.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
    let a = n.cross(&any).normalize();
    let b = n.cross(&a);
    let radius = 0.5 * emitter.diameter * std::f64::consts::FRAC_1_SQRT_2;
    std::array::from_fn(|i| {
        let (sin, cos) = (std::f64::consts::TAU * i as f64 / LANES as f64).sin_cos();
        emitter.position + (a * cos + b * sin) * radius
    })
}

/// Light of an emitter along a path of the given direction and length.
fn lobe(emitter: &Emitter, path: &Vector3<f64>) -> f64 {
    let reach2 = path.norm_squared();
    let cos = emitter.normal.dot(path) / reach2.sqrt();
    if cos <= 0.0 { 0.0 } else { emitter.flux_px * cos.powf(emitter.lobe) / reach2 }
}

/// Adds a Gaussian spot, integrated over the pixels.
fn splat(linear: &mut Image<f32>, spot: &Spot, amount: f64) {
    let radius = (4.0 * spot.sigma_px).ceil();
    let weights = |centre: f64| {
        let first = (centre - radius).round() as i64;
        let last = (centre + radius).round() as i64;
        (first..=last)
            .map(|k| {
                let edge = |x: f64| erf((x - centre) / (spot.sigma_px * std::f64::consts::SQRT_2));
                (k, 0.5 * (edge(k as f64 + 0.5) - edge(k as f64 - 0.5)))
            })
            .collect::<Vec<_>>()
    };
    if !(-1e4..1e5).contains(&spot.u) || !(-1e4..1e5).contains(&spot.v) {
        return;
    }
    let columns = weights(spot.u);
    for (y, wy) in weights(spot.v) {
        let Some(y) = usize::try_from(y).ok().filter(|&y| y < linear.height()) else { continue };
        let row = linear.row_mut(y);
        for &(x, wx) in &columns {
            if let Some(pixel) = usize::try_from(x).ok().and_then(|x| row.get_mut(x)) {
                *pixel += (amount * wx * wy) as f32;
            }
        }
    }
}

/// Error function to 1.5e-7 (Abramowitz and Stegun 7.1.26).
fn erf(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x.abs());
    let series = t
        * (0.254_829_592
            + t * (-0.284_496_736
                + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    (1.0 - series * (-x * x).exp()).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Body, Material};
    use crate::trace::{Solid, Texture};
    use nalgebra::{Translation3, Unit};
    use vergence_geometry::optical_from_body;

    /// A camera at the origin that looks along +x, and a light at 1 m that faces it.
    fn frame_with(bodies: Vec<Body>, lit: bool) -> Image<f32> {
        frame_at(bodies, if lit { 0.1 } else { 1.1 }, 0.0)
    }

    /// The light is on in the first second and dark in the next.
    fn frame_at(bodies: Vec<Body>, start: f64, row_time: f64) -> Image<f32> {
        let emitter = Emitter {
            position: Point3::new(1.0, 0.05, -0.02),
            normal: Unit::new_normalize(Vector3::new(-1.0, 0.0, 0.0)),
            lobe: 1.0,
            diameter: 0.003,
            flux_px: 2.0,
        };
        let pattern = vergence_tag::Pattern::new(
            vergence_tag::pattern::Bits::FLICKER,
            std::time::Duration::from_secs(1),
        )
        .unwrap();
        let play = Play { begin: 0.0, end: f64::INFINITY, pattern, rate: 1.0 };
        let pose = Transform::from_parts(Translation3::identity(), optical_from_body().inverse());
        let capture = Capture {
            sequence: 0,
            start,
            base_from_optical: [pose; 2],
            blinkers: vec![Blinker { emitter, plays: vec![play] }],
            stage: Arc::new(Stage::new(Scene { bodies, ..Scene::default() })),
        };
        let lens = Lens::centred(320, 240, 300.0);
        let light = LightSettings::default();
        let settings = CameraSettings { row_time, ..CameraSettings::default() };
        let mut sensor = Sensor::new(lens, settings, &light, 1, 0);
        sensor.picture(&capture);
        sensor.expose(&capture)
    }

    fn total(image: &Image<f32>) -> f32 {
        image.data().iter().sum()
    }

    fn wall_at(x: f64, z: f64) -> Body {
        let matt = Material::matt(0.5, Texture::Plain, 1);
        let place = Transform::translation(x, 0.05, z);
        Body::new(Solid::Box([0.01, 0.05, 0.05]), &place, matt)
    }

    #[test]
    fn a_body_in_between_hides_the_light() {
        // Nearly on the axis: cos is 0.9986, the squared distance 1.0029.
        let open = total(&frame_with(vec![], true));
        assert!((open - 2.0 * 0.9986 / 1.0029).abs() < 2e-3, "{open}");
        assert_eq!(total(&frame_with(vec![], false)), 0.0, "dark chip");
        assert_eq!(total(&frame_with(vec![wall_at(0.5, -0.01)], true)), 0.0, "hidden");
        assert_eq!(total(&frame_with(vec![wall_at(1.2, -0.01)], true)), open, "behind");
        // The wall's upper edge passes through the middle of the disc as the camera sees it.
        let half = total(&frame_with(vec![wall_at(0.99, -0.0198 - 0.05)], true));
        assert!(half > 0.2 * open && half < 0.8 * open, "half hidden: {half} of {open}");
    }

    #[test]
    fn a_rolling_shutter_exposes_the_lights_row_later() {
        // The light is seen in row 126; 0.1 ms a row, that is 12.6 ms after the first row.
        let first_row = 0.992;
        assert!(total(&frame_at(vec![], first_row, 0.0)) > 1.9, "whole exposure lit");
        assert_eq!(total(&frame_at(vec![], first_row, 1e-4)), 0.0, "after the light went out");
        let half = total(&frame_at(vec![], 0.998 - 0.012_55, 1e-4));
        assert!((half - 1.0).abs() < 0.1, "goes out in the middle of the row's exposure: {half}");
    }

    #[test]
    fn noise_follows_the_settings() {
        let lens = Lens::centred(320, 240, 300.0);
        let settings = CameraSettings { gamma: 1.0, ..CameraSettings::default() };
        let sensor = Sensor::new(lens, settings, &LightSettings::default(), 1, 0);
        let picture = sensor.digitise(&Image::filled(320, 240, 0.25), 7);
        let values: Vec<f64> = picture.data().iter().map(|p| f64::from(*p)).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        // 3000 electrons of shot noise and 8 of read noise; rounding adds 1/12.
        let expected = (255.0f64 / 12000.0).powi(2) * (3000.0 + 64.0) + 1.0 / 12.0;
        assert!((mean - 63.75).abs() < 0.05, "mean {mean}");
        assert!((variance / expected - 1.0).abs() < 0.03, "{variance} for {expected}");
    }
}
