//! The chip's Bluetooth controller: Nordic's SoftDevice controller on its multiprotocol service layer.

use embassy_executor::Spawner;
use embassy_nrf::mode::Async;
use embassy_nrf::peripherals::RNG;
use embassy_nrf::rng::Rng;
use embassy_nrf::{bind_interrupts, rng, saadc};
use nrf_mpsl::{Flash, MultiprotocolServiceLayer, SessionMem, raw};
use nrf_sdc::{Builder, Mem, Peripherals, SoftdeviceController};
use static_cell::StaticCell;

bind_interrupts!(pub struct Interrupts {
    EGU0_SWI0 => nrf_mpsl::LowPrioInterruptHandler;
    CLOCK_POWER => nrf_mpsl::ClockInterruptHandler;
    RADIO => nrf_mpsl::HighPrioInterruptHandler;
    TIMER0 => nrf_mpsl::HighPrioInterruptHandler;
    RTC0 => nrf_mpsl::HighPrioInterruptHandler;
    RNG => rng::InterruptHandler<RNG>;
    SAADC => saadc::InterruptHandler;
});

/// Packets of one link under way, each direction.
const PACKETS: u8 = 3;
/// Longest packet: what the firmware's guard takes.
const PACKET_BYTES: u16 = 251;
/// Memory of the controller: more than one link and one advertising set need.
const MEMORY: usize = 8192;

/// Starts the service layer, and the flash that it lends between radio events.
pub fn start(
    spawner: Spawner,
    peripherals: nrf_mpsl::Peripherals<'static>,
    flash: embassy_nrf::Peri<'static, embassy_nrf::peripherals::NVMC>,
) -> Option<(&'static MultiprotocolServiceLayer<'static>, Flash<'static>)> {
    // The 32 kHz crystal: its 20 ppm keep the light's chips in step with the robot's clock.
    let clock = raw::mpsl_clock_lfclk_cfg_t {
        source: raw::MPSL_CLOCK_LF_SRC_XTAL as u8,
        rc_ctiv: 0,
        rc_temp_ctiv: 0,
        accuracy_ppm: 50,
        skip_wait_lfclk_started: false,
    };
    static SLOTS: StaticCell<SessionMem<1>> = StaticCell::new();
    static LAYER: StaticCell<MultiprotocolServiceLayer<'static>> = StaticCell::new();
    let slots = SLOTS.init(SessionMem::new());
    let layer =
        MultiprotocolServiceLayer::with_timeslots(peripherals, Interrupts, clock, slots).ok()?;
    let layer: &'static _ = LAYER.init(layer);
    spawner.spawn(serve(layer).ok()?);
    Some((layer, Flash::take(layer, flash)))
}

#[embassy_executor::task]
async fn serve(layer: &'static MultiprotocolServiceLayer<'static>) -> ! {
    layer.run().await
}

/// A controller for one link as a peripheral.
pub fn controller(
    peripherals: Peripherals<'static>,
    random: Rng<'static, Async>,
    layer: &'static MultiprotocolServiceLayer<'static>,
) -> Option<SoftdeviceController<'static>> {
    static RANDOM: StaticCell<Rng<'static, Async>> = StaticCell::new();
    static MEM: StaticCell<Mem<MEMORY>> = StaticCell::new();
    Builder::new()
        .ok()?
        .support_adv()
        .support_peripheral()
        .support_dle_peripheral()
        .support_le_2m_phy()
        .support_phy_update_peripheral()
        .peripheral_count(1)
        .ok()?
        .buffer_cfg(PACKET_BYTES, PACKET_BYTES, PACKETS, PACKETS)
        .ok()?
        .build(peripherals, RANDOM.init(random), layer, MEM.init(Mem::new()))
        .ok()
}
