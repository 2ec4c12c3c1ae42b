//! Where a light is that is known to blink near a pixel, from a handful of frames.
//!
//! In: frames of a camera that rests, among which the light was on at least once and off at least
//! once, and about where it is. Out: the pixel with its covariance. A head that measures one light at
//! many angles needs this: three frames an angle instead of a whole decision.
//!
//! Method: of all pairs of frames the one whose difference has the highest peak within the radius;
//! the mean around the peak, which a flickering lamp leaves, is taken off, and the centroid of what
//! remains is the pixel. Whether the light is the tag's at all was decided before, by a
//! [`crate::Finder`]; here a light that blinks at that place is believed.

use nalgebra::{Matrix2, Point2, Vector2};
use vergence_imaging::{Frame, Image};

/// Half width of the centroid's window (px): a lens' spot of 0.6 px, saturated, fits.
const SPOT_PX: i64 = 3;
/// Half width of the ring from which the background is taken (px).
const RING_PX: i64 = 6;
/// Least peak over the ring's noise.
const LEAST_SNR: f64 = 8.0;
/// Least peak (grey levels): less is noise in a dark picture.
const LEAST_PEAK: f64 = 8.0;
/// What the centroid's place within the pixel may shift a saturated spot by (px).
const FLOOR_PX: f64 = 0.07;

/// Where the light is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// The spot's middle; (0, 0) is the centre of the top-left pixel.
    pub pixel: Point2<f64>,
    /// Covariance of `pixel` (px^2).
    pub covariance: Matrix2<f64>,
}

/// Looks for the light within `radius_px` of `expected`; `None` when none stands out there.
pub fn locate(frames: &[Frame], expected: &Point2<f64>, radius_px: f64) -> Option<Spot> {
    let pairs = frames.iter().enumerate().flat_map(|(k, a)| {
        let others = frames.iter().enumerate().filter(move |(j, _)| *j != k);
        others.map(move |(_, b)| (&a.image, &b.image))
    });
    let brightest = pairs
        .filter_map(|(lit, dark)| Some((peak(lit, dark, expected, radius_px)?, lit, dark)))
        .max_by(|a, b| a.0.0.total_cmp(&b.0.0))?;
    let ((height, place), lit, dark) = brightest;
    let (level, noise) = background(lit, dark, place)?;
    let least = LEAST_PEAK.max(LEAST_SNR * noise);
    if height - level < least { None } else { centroid(lit, dark, place, level, noise) }
}

fn difference(lit: &Image<u8>, dark: &Image<u8>, x: i64, y: i64) -> Option<f64> {
    let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
    Some(f64::from(lit.get(x, y)?) - f64::from(dark.get(x, y)?))
}

/// The highest difference within the radius, and where.
fn peak(
    lit: &Image<u8>,
    dark: &Image<u8>,
    expected: &Point2<f64>,
    radius_px: f64,
) -> Option<(f64, (i64, i64))> {
    let reach = radius_px.ceil() as i64;
    let (cx, cy) = (expected.x.round() as i64, expected.y.round() as i64);
    let around = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    around
        .filter(|(dx, dy)| ((dx * dx + dy * dy) as f64) <= radius_px * radius_px)
        .filter_map(|(dx, dy)| Some((difference(lit, dark, cx + dx, cy + dy)?, (cx + dx, cy + dy))))
        .max_by(|a, b| a.0.total_cmp(&b.0))
}

/// Mean and standard deviation of the difference in a ring around the spot.
fn background(lit: &Image<u8>, dark: &Image<u8>, (px, py): (i64, i64)) -> Option<(f64, f64)> {
    let (mut n, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for y in -RING_PX..=RING_PX {
        for x in -RING_PX..=RING_PX {
            if x.abs().max(y.abs()) <= SPOT_PX {
                continue;
            }
            if let Some(d) = difference(lit, dark, px + x, py + y) {
                (n, sum, squares) = (n + 1.0, sum + d, squares + d * d);
            }
        }
    }
    if n < 20.0 {
        return None;
    }
    let mean = sum / n;
    // Rounding to grey levels alone makes a third of a level.
    Some((mean, (squares / n - mean * mean).max(0.1).sqrt()))
}

fn centroid(
    lit: &Image<u8>,
    dark: &Image<u8>,
    (px, py): (i64, i64),
    level: f64,
    noise: f64,
) -> Option<Spot> {
    let (mut sum, mut first, mut second) = (0.0, Vector2::zeros(), Matrix2::zeros());
    for y in -SPOT_PX..=SPOT_PX {
        for x in -SPOT_PX..=SPOT_PX {
            let value = difference(lit, dark, px + x, py + y)? - level;
            // Noise far from the spot has long levers: what is within it counts for nothing.
            if value > 3.0 * noise {
                let at = Vector2::new(x as f64, y as f64);
                sum += value;
                first += at * value;
                second += at * at.transpose();
            }
        }
    }
    if sum <= 0.0 {
        return None;
    }
    let covariance = second * (noise / sum).powi(2) + Matrix2::identity() * FLOOR_PX * FLOOR_PX;
    let mean = first / sum;
    Some(Spot { pixel: Point2::new(px as f64 + mean.x, py as f64 + mean.y), covariance })
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::synthetic::{Light, Scene};
    use vergence_tag::{Pattern, pattern::Bits};

    fn frames(light: Point2<f64>, seed: u64, amplitude: f64) -> Vec<Frame> {
        let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(50)).unwrap();
        let mut scene = Scene::textured(64, 48, seed);
        scene.lights.push(Light { place: light, amplitude, pattern, phase: 0.0, rate: 1.0 });
        let mut film = scene.film(seed);
        (0..3).map(|_| film.next_frame().unwrap()).collect()
    }

    #[test]
    fn three_frames_give_the_pixel_within_its_covariance() {
        let mut nees = 0.0;
        const TRIALS: u32 = 40;
        for k in 0..TRIALS {
            let light = Point2::new(30.0 + 0.037 * f64::from(k), 20.3 + 0.021 * f64::from(k));
            let seen = frames(light, u64::from(k), 90.0);
            let spot = locate(&seen, &Point2::new(33.0, 18.0), 7.0).unwrap();
            let error = spot.pixel - light;
            assert!(error.norm() < 0.4, "{k}: {} for {light}", spot.pixel);
            nees += (error.transpose() * spot.covariance.try_inverse().unwrap() * error).x;
        }
        let nees = nees / f64::from(2 * TRIALS);
        assert!(nees < 1.6, "claims less than its error: {nees}");
    }

    #[test]
    fn what_does_not_blink_is_not_seen() {
        assert_eq!(
            locate(&frames(Point2::new(30.0, 20.0), 1, 0.0), &Point2::new(30.0, 20.0), 7.0),
            None
        );
        let away = frames(Point2::new(50.0, 20.0), 1, 90.0);
        assert_eq!(locate(&away, &Point2::new(30.0, 20.0), 7.0), None, "outside the radius");
        assert_eq!(locate(&[], &Point2::new(30.0, 20.0), 7.0), None);
    }
}
