//! A servo: trapezoidal moves in steps of the encoder, latency, backlash.
//!
//! The motor follows a trapezoidal speed profile into the encoder step nearest to the goal and stops
//! somewhere within it: the controller knows no better, and the reading is that step's middle. A
//! command into the step where the motor rests moves nothing. The load (the camera) hangs on the
//! motor with play: it stays where it is until the motor has taken up the dead band, so that its
//! angle depends on the side it came from. A servo's own dead band is no larger than its kind's.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use crate::config::ServoSettings;

/// A servo's own slack as a share of what its maker states for the kind.
const OWN_SLACK: std::ops::RangeInclusive<f64> = 0.7..=1.0;

/// One axis.
#[derive(Debug, Clone)]
pub struct Servo {
    resolution: f64,
    acceleration: f64,
    /// What the maker states; and this one's own.
    stated_backlash: f64,
    backlash: f64,
    rng: Pcg64Mcg,
    latency: f64,
    /// Speed limit of the joint, and that of the move under way (rad/s).
    limit: f64,
    speed: f64,
    /// Move under way: from, to (rad), began at (s).
    from: f64,
    to: f64,
    began: f64,
    /// Goals that have not reached the motor yet: when they will (s), where to (rad), how fast (rad/s).
    pending: Vec<(f64, f64, f64)>,
    /// State at `time`.
    time: f64,
    motor: f64,
    load: f64,
}

impl Servo {
    /// At rest at zero. `speed` is the joint's limit (rad/s); `rng` decides where in a step it stops.
    pub fn new(settings: &ServoSettings, speed: f64, mut rng: Pcg64Mcg) -> Self {
        let stated_backlash = settings.backlash_deg.to_radians();
        Servo {
            resolution: settings.resolution_deg.to_radians(),
            acceleration: settings.acceleration,
            stated_backlash,
            backlash: stated_backlash * rng.random_range(OWN_SLACK),
            rng,
            latency: settings.latency,
            limit: speed.max(1e-3),
            speed: speed.max(1e-3),
            from: 0.0,
            to: 0.0,
            began: 0.0,
            pending: Vec::new(),
            time: 0.0,
            motor: 0.0,
            load: 0.0,
        }
    }

    /// Commands an angle at time `now` (s).
    pub fn command(&mut self, now: f64, goal: f64) {
        self.drive(now, goal, self.limit);
    }

    /// Commands an angle and a speed (rad/s) at time `now` (s).
    pub fn drive(&mut self, now: f64, goal: f64, speed: f64) {
        self.pending.push((now + self.latency, goal, speed.clamp(1e-3, self.limit)));
    }

    /// Stops where it is: without torque nothing moves, the gears hold the camera.
    pub fn release(&mut self) {
        self.pending.clear();
        (self.from, self.to, self.began) = (self.motor, self.motor, self.time);
    }

    /// Moves on to a time (s); going back is ignored.
    pub fn advance(&mut self, time: f64) {
        while let Some(&(at, goal, speed)) = self.pending.first().filter(|p| p.0 <= time) {
            self.settle(at.max(self.time));
            let to = self.rest(goal);
            (self.from, self.to, self.began) = (self.motor, to, at);
            self.speed = speed;
            self.pending.remove(0);
        }
        self.settle(time);
    }

    /// Where a move to `goal` ends: anywhere within the encoder's step, where it is when it is there.
    fn rest(&mut self, goal: f64) -> f64 {
        let step = (goal / self.resolution).round();
        if step == (self.motor / self.resolution).round() && self.motor == self.to {
            return self.motor;
        }
        (step + self.rng.random_range(-0.499..0.499)) * self.resolution
    }

    fn settle(&mut self, time: f64) {
        if time <= self.time {
            return;
        }
        self.motor = self.profile(time);
        self.load =
            self.load.clamp(self.motor - 0.5 * self.backlash, self.motor + 0.5 * self.backlash);
        self.time = time;
    }

    /// Motor angle of the move under way.
    fn profile(&self, time: f64) -> f64 {
        let way = (self.to - self.from).abs();
        let (t, a) = ((time - self.began).max(0.0), self.acceleration);
        let ramp = (self.speed / a).min((way / a).sqrt());
        let peak = a * ramp;
        let cruise = if peak > 0.0 { (way - peak * ramp) / peak } else { 0.0 };
        let total = 2.0 * ramp + cruise;
        let done = if t >= total {
            return self.to;
        } else if t < ramp {
            0.5 * a * t * t
        } else if t < ramp + cruise {
            0.5 * a * ramp * ramp + peak * (t - ramp)
        } else {
            way - 0.5 * a * (total - t).powi(2)
        };
        self.from + done * (self.to - self.from).signum()
    }

    /// What the encoder tells (rad).
    pub fn encoder(&self) -> f64 {
        (self.motor / self.resolution).round() * self.resolution
    }

    /// A move is under way or on its way.
    pub fn moving(&self) -> bool {
        !self.pending.is_empty() || self.motor != self.to
    }

    /// Where the camera really is (rad).
    pub fn load(&self) -> f64 {
        self.load
    }

    /// Dead band that the maker states (rad).
    pub fn stated_backlash(&self) -> f64 {
        self.stated_backlash
    }

    /// Encoder step (rad).
    pub fn resolution(&self) -> f64 {
        self.resolution
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn servo() -> Servo {
        Servo::new(&ServoSettings::default(), 3.6, crate::noise::stream(1, "servo", 0))
    }

    #[test]
    fn angles_are_multiples_of_the_step() {
        let mut servo = servo();
        servo.command(0.0, 0.1);
        servo.advance(2.0);
        let steps = servo.encoder() / 0.35f64.to_radians();
        assert!((steps - steps.round()).abs() < 1e-9 && (servo.encoder() - 0.1).abs() < 0.0031);
        let within = (servo.motor - servo.encoder()) / 0.35f64.to_radians();
        assert!(within.abs() < 0.5 && within != 0.0, "rests somewhere within the step: {within}");
        let there = servo.motor;
        servo.command(2.0, 0.1);
        servo.advance(3.0);
        assert_eq!(servo.motor, there, "a command into the same step moves nothing");
        assert!(!servo.moving());
    }

    #[test]
    fn speed_and_latency_are_kept() {
        let mut servo = servo();
        servo.command(0.0, 1.0);
        servo.advance(0.0079);
        assert_eq!(servo.motor, 0.0, "nothing moves before the latency");
        let mut fastest = 0.0f64;
        let mut last = 0.0;
        for k in 8..1000 {
            servo.advance(f64::from(k) * 1e-3);
            fastest = fastest.max((servo.motor - last) / 1e-3);
            last = servo.motor;
        }
        assert!(fastest <= 3.6 + 1e-6 && fastest > 3.5, "fastest {fastest}");
        // 1 rad at 3.6 rad/s and 40 rad/s^2: 0.278 s of cruise and 0.09 s of ramps.
        let mut again = self::servo();
        again.command(0.0, 1.0);
        again.advance(0.008 + 0.36);
        assert!(again.moving());
        again.advance(0.008 + 0.375);
        assert!(!again.moving());
    }

    #[test]
    fn the_load_lags_by_the_dead_band() {
        let mut servo = servo();
        let arrive = |servo: &mut Servo, at: f64, goal: f64| {
            servo.command(at, goal);
            servo.advance(at + 1.0);
            servo.load() - servo.motor
        };
        let half = 0.5 * servo.backlash;
        assert!(half > 0.052f64.to_radians() && half < 0.0751f64.to_radians());
        let step = 0.35f64.to_radians();
        assert!((arrive(&mut servo, 0.0, 20.0 * step) + half).abs() < 1e-12);
        assert!((arrive(&mut servo, 2.0, 40.0 * step) + half).abs() < 1e-12);
        assert!((arrive(&mut servo, 4.0, 20.0 * step) - half).abs() < 1e-12);
    }

    #[test]
    fn a_released_servo_stays_where_it_is() {
        let mut servo = servo();
        servo.drive(0.0, 1.0, 0.5);
        servo.advance(1.008);
        servo.release();
        let there = servo.motor;
        assert!((there - 0.5).abs() < 0.01, "half a radian in a second, not {there}");
        servo.advance(3.0);
        assert!(servo.motor == there && !servo.moving());
    }

    #[test]
    fn a_new_goal_takes_over() {
        let mut servo = servo();
        servo.command(0.0, 1.0);
        servo.advance(0.15);
        let there = servo.motor;
        assert!(there > 0.1 && there < 0.9);
        servo.command(0.15, 0.0);
        servo.advance(2.0);
        assert_eq!(servo.encoder(), 0.0);
    }
}
