//! The board's three LEDs: LD1 shows the status, LD2 is on while the Ethernet link is up, LD3 is on after a panic
//! or a fault, until the watchdog resets the board.

use embassy_stm32::Peri;
use embassy_stm32::gpio::{Level, Output, Speed};
use embassy_stm32::pac::gpio::vals::Moder;
use embassy_stm32::pac::{GPIOB, RCC};
use embassy_stm32::peripherals::{PB0, PB14, PE1};
use firmware::platform::StatusLed;

pub(crate) struct BoardLed(Output<'static>);

impl StatusLed for BoardLed {
    fn set(&mut self, is_lit: bool) {
        self.0.set_level(is_lit.into());
    }
}

/// LEDs that are handed out.
pub(super) struct Leds {
    pub(super) status: BoardLed,
    pub(super) link: BoardLed,
}

impl Leds {
    pub(super) fn new(
        green: Peri<'static, PB0>,
        yellow: Peri<'static, PE1>,
        red: Peri<'static, PB14>,
    ) -> Self {
        // [`fault`] sets it through its registers.
        core::mem::forget(Output::new(red, Level::Low, Speed::Low));
        Self {
            status: BoardLed(Output::new(green, Level::Low, Speed::Low)),
            link: BoardLed(Output::new(yellow, Level::Low, Speed::Low)),
        }
    }
}

/// Switches LD3 on. Works even if the fault occurred before the pins were set up.
pub(super) fn fault() {
    RCC.ahb4enr().modify(|w| w.set_gpioben(true));
    // Enabling the clock takes two cycles.
    RCC.ahb4enr().read();
    GPIOB.moder().modify(|w| w.set_moder(14, Moder::OUTPUT));
    GPIOB.bsrr().write(|w| w.set_bs(14, true));
}
