//! A smart tag on a Nordic nRF52840 with a 32 kHz crystal: the firmware core on the chip's own radio.
//!
//! Infrared LEDs hang on P0.13 and P0.14 (high is on); the battery is the chip's supply. The passkey
//! that is printed on the tag stands in the first customer register of its UICR (address 0x10001080),
//! so that one image serves all tags; an erased register means none. A panic, a controller that fails
//! and a hang (by the watchdog) reset the chip; the record and the bonds are in flash.
#![no_std]
#![no_main]

mod board;
mod radio;

use core::ops::Range;
use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use embassy_executor::Spawner;
use embassy_nrf::interrupt::Priority;
use embassy_nrf::pac;
use embassy_nrf::pwm::{Prescaler, SimpleConfig, SimplePwm};
use embassy_nrf::rng::Rng;
use embassy_nrf::saadc::{ChannelConfig, Saadc, VddInput};
use embassy_nrf::wdt;
use trouble_host::prelude::DefaultPacketPool;
use vergence_firmware::{Access, Board, Config, Store};

use crate::board::{ChipWatchdog, PwmLights, SupplyVoltage, TOP};
use crate::radio::Interrupts;

/// Pages of flash for record and bonds, behind the program (`memory.x`).
const STORE: Range<u32> = 0xF_C000..0x10_0000;
/// The watchdog's patience (32 kHz ticks): 30 s; the firmware feeds it every 8 s.
const PATIENCE: u32 = 30 * 32_768;
/// LEDs.
const LIGHTS: usize = 2;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    // Whatever ends the tag, starting anew is the cure.
    run(spawner).await;
    SCB::sys_reset();
}

async fn run(spawner: Spawner) -> Option<()> {
    let mut chip = embassy_nrf::config::Config::default();
    // The service layer needs the higher priorities for itself.
    chip.time_interrupt_priority = Priority::P2;
    chip.dcdc.reg1 = true;
    let p = embassy_nrf::init(chip);

    let mut patience = wdt::Config::default();
    patience.timeout_ticks = PATIENCE;
    // A debugger may hold the chip for as long as it likes.
    patience.action_during_debug_halt = wdt::HaltConfig::Pause;
    let (_, [watchdog]) = wdt::Watchdog::try_new(p.WDT, patience).ok()?;

    let layer =
        nrf_mpsl::Peripherals::new(p.RTC0, p.TIMER0, p.TEMP, p.PPI_CH19, p.PPI_CH30, p.PPI_CH31);
    let (layer, flash) = radio::start(spawner, layer, p.NVMC)?;
    let controller = nrf_sdc::Peripherals::new(
        p.PPI_CH17, p.PPI_CH18, p.PPI_CH20, p.PPI_CH21, p.PPI_CH22, p.PPI_CH23, p.PPI_CH24,
        p.PPI_CH25, p.PPI_CH26, p.PPI_CH27, p.PPI_CH28, p.PPI_CH29,
    );
    let controller = radio::controller(controller, Rng::new(p.RNG, Interrupts), layer)?;

    let mut pwm = SimpleConfig::default();
    pwm.max_duty = TOP;
    pwm.prescaler = Prescaler::Div1;
    let pwm = SimplePwm::new_2ch(p.PWM0, p.P0_13, p.P0_14, &pwm);
    let supply = ChannelConfig::single_ended(VddInput);
    let supply = Saadc::new(p.SAADC, Interrupts, Default::default(), [supply]);
    let mut board = Board {
        lights: PwmLights::<LIGHTS>::new(pwm),
        battery: SupplyVoltage(supply),
        watchdog: ChipWatchdog(watchdog),
    };
    let mut store = Store::new(flash, STORE).ok()?;
    let config = owner();
    let stopped = vergence_firmware::run::<_, DefaultPacketPool, _, _, _, _>(
        controller, &config, &mut store, &mut board,
    );
    stopped.await.ok().map(|never| match never {})
}

/// Who may do what: with a passkey only those who know it may write.
fn owner() -> Config<'static> {
    let passkey = pac::UICR.customer(0).read();
    let passkey = (passkey <= 999_999).then_some(passkey);
    let write_access = match passkey {
        Some(_) => Access::Authenticated,
        None => Access::Encrypted,
    };
    Config { address: address(), model: "nRF52840", passkey, write_access, ..Config::default() }
}

/// The random static address that the chip was made with.
fn address() -> [u8; 6] {
    let [low, high] = [0, 1].map(|k| pac::FICR.deviceaddr(k).read());
    let [a, b, c, d] = low.to_le_bytes();
    let [e, f, ..] = high.to_le_bytes();
    [a, b, c, d, e, f | 0xC0]
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
