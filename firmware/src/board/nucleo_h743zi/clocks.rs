//! Clocks: 400 MHz for the core, 200 MHz for the buses, 100 MHz for the UARTs, 80 MHz for the CAN controller, all
//! from the 8 MHz clock of the board's debugger.

use embassy_stm32::Config;
use embassy_stm32::pac::{DBGMCU, RCC};
use embassy_stm32::rcc::{
    AHBPrescaler, APBPrescaler, HSIPrescaler, Hse, HseMode, Pll, PllDiv, PllMul, PllPreDiv, PllSource,
    Sysclk, VoltageScale, mux,
};
use embassy_stm32::time::Hertz;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ClockSource {
    /// The 8 MHz of the debugger's crystal.
    External,
    /// The chip's own 64 MHz, within 1 %: good enough for everything but CAN.
    Internal,
}

/// Returns the external clock if it runs. The check is needed because the initialisation would wait for it forever.
pub(super) fn source() -> ClockSource {
    RCC.cr().modify(|w| w.set_hsebyp(true));
    RCC.cr().modify(|w| w.set_hseon(true));
    // The external clock is ready after a few of its cycles; this loop takes some milliseconds.
    for _ in 0..50_000 {
        if RCC.cr().read().hserdy() {
            return ClockSource::External;
        }
    }
    RCC.cr().modify(|w| w.set_hseon(false));
    RCC.cr().modify(|w| w.set_hsebyp(false));
    ClockSource::Internal
}

pub(super) fn config(source: ClockSource) -> Config {
    let mut config = Config::default();
    let rcc = &mut config.rcc;
    rcc.hsi = Some(HSIPrescaler::DIV1);
    // For the random number generator.
    rcc.hsi48 = Some(Default::default());
    // 2 MHz times 400, divided by 2 and by 10.
    let (source, prediv) = match source {
        ClockSource::External => {
            rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Bypass });
            (PllSource::HSE, PllPreDiv::DIV4)
        }
        ClockSource::Internal => (PllSource::HSI, PllPreDiv::DIV32),
    };
    rcc.pll1 = Some(Pll {
        source,
        prediv,
        mul: PllMul::MUL400,
        fracn: None,
        divp: Some(PllDiv::DIV2),
        divq: Some(PllDiv::DIV10),
        divr: None,
    });
    rcc.sys = Sysclk::PLL1_P;
    rcc.voltage_scale = VoltageScale::Scale1;
    rcc.ahb_pre = AHBPrescaler::DIV2;
    rcc.apb1_pre = APBPrescaler::DIV2;
    rcc.apb2_pre = APBPrescaler::DIV2;
    rcc.apb3_pre = APBPrescaler::DIV2;
    rcc.apb4_pre = APBPrescaler::DIV2;
    rcc.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    rcc.mux.rngsel = mux::Rngsel::HSI48;
    config
}

/// Limits AXI SRAM to one read at a time on chips of revision Y (errata ES0392, "reading from AXI SRAM may lead to
/// data read corruption"). Must be called before any DMA starts.
pub(super) fn errata() {
    const AXI_TARG7_FN_MOD: usize = 0x5100_8108;
    const REVISION_Y: u16 = 0x1003;
    if DBGMCU.idc().read().rev_id() <= REVISION_Y {
        // SAFETY: the address of an aligned 32-bit register of the AXI interconnect, which nothing else uses.
        unsafe { core::ptr::with_exposed_provenance_mut::<u32>(AXI_TARG7_FN_MOD).write_volatile(1) }
    }
}
