//! How lights vary with time: patterns that LEDs play, mains flicker, a screen.

use rand::RngExt;
use vergence_tag::Pattern;

use crate::config::LightSettings;
use crate::noise::stream;

/// A stretch of time in which an LED plays a pattern.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Play {
    /// Start (s, the robot's clock).
    pub begin: f64,
    /// End (s); infinite for a light that never stops.
    pub end: f64,
    /// What is played.
    pub pattern: Pattern,
    /// Seconds of the tag's clock per second of the robot's.
    pub rate: f64,
}

impl Play {
    /// Mean drive (0 to 1) over an exposure.
    pub fn share(&self, from: f64, exposure: f64) -> f64 {
        let (low, high) = (from.max(self.begin), (from + exposure).min(self.end));
        if high <= low {
            return 0.0;
        }
        let on = self.pattern.on_fraction((low - self.begin) * self.rate, (high - low) * self.rate);
        on * (high - low) / exposure * f64::from(self.pattern.brightness) / 255.0
    }
}

/// The lights that flicker by themselves.
#[derive(Debug, Clone)]
pub struct Flicker {
    lamp_hz: f64,
    depth: f64,
    phase: f64,
    seed: u64,
}

impl Flicker {
    /// Phases are chosen by the seed.
    pub fn new(light: &LightSettings, seed: u64) -> Self {
        let phase = stream(seed, "mains", 0).random::<f64>();
        Flicker { lamp_hz: light.lamp_hz, depth: light.lamp_depth, phase, seed }
    }

    /// Mean of the lamp's light over an exposure, 1 on average: the flickering share goes as the
    /// rectified mains voltage, |sin|.
    pub fn lamp(&self, from: f64, exposure: f64) -> f64 {
        let half_waves = |t: f64| {
            let x = self.lamp_hz * t + self.phase;
            let whole = x.floor();
            whole + 0.5 * (1.0 - (std::f64::consts::PI * (x - whole)).cos())
        };
        let mean = (half_waves(from + exposure) - half_waves(from)) / (self.lamp_hz * exposure);
        1.0 - self.depth + self.depth * mean
    }

    /// Brightness of the screen: another picture every 0.7 s.
    pub fn screen(&self, at: f64) -> f64 {
        let cut = (at.max(0.0) / 0.7) as u64;
        0.5 + stream(self.seed, "screen", cut).random::<f64>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;
    use vergence_tag::pattern::Bits;

    fn play(end: f64) -> Play {
        let pattern = Pattern::new(Bits::FLICKER, Duration::from_millis(100)).unwrap();
        Play { begin: 1.0, end, pattern, rate: 1.0 }
    }

    #[test]
    fn an_exposure_integrates_the_pattern() {
        let play = play(f64::INFINITY);
        assert!((play.share(1.05, 0.02) - 1.0).abs() < 1e-9);
        assert!(play.share(1.12, 0.02).abs() < 1e-9);
        assert!((play.share(1.095, 0.01) - 0.5).abs() < 1e-9, "half in, half out");
        assert!((play.share(0.99, 0.02) - 0.5).abs() < 1e-9, "dark before the start");
        assert!(self::play(1.21).share(1.2, 0.02) - 0.5 < 1e-9, "dark after the end");
    }

    #[test]
    fn a_fast_clock_runs_ahead() {
        let fast = Play { rate: 1.001, ..play(f64::INFINITY) };
        // 100 s on, the fast tag is a whole chip ahead.
        assert!(fast.share(101.02, 0.02) < 1e-6 && play(f64::INFINITY).share(101.02, 0.02) > 0.99);
    }

    #[test]
    fn the_lamp_is_one_on_average_and_aliases() {
        let flicker = Flicker::new(&LightSettings::default(), 3);
        assert!((flicker.lamp(0.3, 0.01) - 1.0).abs() < 1e-9, "a whole half wave");
        let gains: Vec<f64> = (0..3).map(|k| flicker.lamp(f64::from(k) / 30.0, 0.004)).collect();
        let next = flicker.lamp(0.1, 0.004);
        assert!((gains[0] - next).abs() < 1e-9, "100 Hz at 30 Hz repeats every third frame");
        assert!((gains[0] - gains[1]).abs() + (gains[1] - gains[2]).abs() > 0.05, "{gains:?}");
    }
}
