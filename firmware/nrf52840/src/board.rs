//! The parts of the board that the firmware asks for: lights, battery gauge, watchdog.

use embassy_futures::block_on;
use embassy_nrf::pwm::{DutyCycle, SimplePwm};
use embassy_nrf::saadc::Saadc;
use embassy_nrf::wdt::WatchdogHandle;
use vergence_firmware::{Battery, Lights, Watchdog};

/// Infrared LEDs, each behind a transistor on one channel of a PWM unit, lit while the pin is high.
pub struct PwmLights<const N: usize> {
    pwm: SimplePwm<'static>,
    levels: [u8; N],
}

/// Top of the PWM counter; with the prescaler of [`PwmLights::new`] 16 MHz / 255, 63 kHz, far above
/// what a camera sees.
pub const TOP: u16 = 255;

impl<const N: usize> PwmLights<N> {
    /// On the first `N` channels of a unit that counts to [`TOP`].
    pub fn new(pwm: SimplePwm<'static>) -> Self {
        pwm.disable();
        PwmLights { pwm, levels: [0; N] }
    }
}

impl<const N: usize> Lights for PwmLights<N> {
    fn count(&self) -> u8 {
        N as u8
    }

    fn set(&mut self, led: u8, level: u8) {
        let Some(own) = self.levels.get_mut(usize::from(led)) else { return };
        *own = level;
        // The unit keeps the fast clock running: 0.4 mA that a dark tag does not pay.
        if self.levels.iter().all(|level| *level == 0) {
            self.pwm.disable();
            return;
        }
        self.pwm.enable();
        self.pwm.set_duty(usize::from(led), DutyCycle::inverted(u16::from(level)));
    }
}

/// Tells the charge of a lithium coin cell from the supply voltage.
pub struct SupplyVoltage(pub Saadc<'static, 1>);

/// Full scale of the converter with its default gain of 1/6 and the internal reference of 0.6 V (mV).
const FULL_SCALE_MV: i32 = 3600;
/// Counts at full scale: 12 bits.
const COUNTS: i32 = 4096;
/// Resting voltage of a CR2032 (mV) and what is left of its charge (percent).
const DISCHARGE: [(i32, i32); 5] = [(3000, 100), (2900, 80), (2800, 60), (2700, 40), (2000, 0)];

impl Battery for SupplyVoltage {
    fn level(&mut self) -> Option<u8> {
        let mut sample = [0i16];
        // 10 us; the converter's own waker is not needed for so short a wait.
        block_on(self.0.sample(&mut sample));
        let millivolts = i32::from(sample[0]) * FULL_SCALE_MV / COUNTS;
        let [(full, most), .., (empty, _)] = DISCHARGE;
        let clamped = millivolts.clamp(empty, full);
        let span = DISCHARGE.windows(2).find(|pair| clamped >= pair[1].0);
        let percent = span.map_or(most, |pair| {
            let ((high, more), (low, less)) = (pair[0], pair[1]);
            less + (clamped - low) * (more - less) / (high - low)
        });
        u8::try_from(percent).ok()
    }
}

/// The chip's watchdog.
pub struct ChipWatchdog(pub WatchdogHandle);

impl Watchdog for ChipWatchdog {
    fn feed(&mut self) {
        self.0.pet();
    }
}
