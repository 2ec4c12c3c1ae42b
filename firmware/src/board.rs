//! What the firmware needs of a board: lights, a battery gauge, a watchdog.

use embassy_time::Instant;
use embedded_hal::pwm::SetDutyCycle;
use vergence_tag::Pattern;

/// A play of a pattern, told when it begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Play {
    /// What is played.
    pub pattern: Pattern,
    /// When its first chip begins.
    pub begin: Instant,
    /// When it ends by itself; a stop or a lost link may end it earlier.
    pub end: Instant,
}

/// The tag's infrared LEDs.
pub trait Lights {
    /// How many there are; the others refuse commands.
    fn count(&self) -> u8;

    /// Drives one LED: 0 dark, 255 full.
    fn set(&mut self, led: u8, level: u8);

    /// A play begins, or (`None`) has ended. For boards that show or log it; the light itself is
    /// made by [`Lights::set`].
    fn playing(&mut self, play: Option<&Play>) {
        let _ = play;
    }
}

/// One PWM output an LED.
impl<P: SetDutyCycle, const N: usize> Lights for [P; N] {
    fn count(&self) -> u8 {
        N as u8
    }

    fn set(&mut self, led: u8, level: u8) {
        if let Some(output) = self.get_mut(usize::from(led)) {
            // An LED that cannot be driven is dark, and nothing here can repair it.
            let _ = output.set_duty_cycle_fraction(u16::from(level), 255);
        }
    }
}

/// The battery gauge.
pub trait Battery {
    /// Level (percent); `None` when it cannot be told.
    fn level(&mut self) -> Option<u8>;
}

/// The watchdog: resets the tag when it is not fed for some time (more than 20 s).
pub trait Watchdog {
    /// All is well.
    fn feed(&mut self);
}

/// A board.
pub struct Board<L, B, W> {
    /// Its lights.
    pub lights: L,
    /// Its battery gauge.
    pub battery: B,
    /// Its watchdog.
    pub watchdog: W,
}
