//! The blue button B1, on PC13: high while it is pressed.

use embassy_stm32::Peri;
use embassy_stm32::gpio::{Input, Pull};
use embassy_stm32::peripherals::PC13;
use firmware::platform;

pub(crate) struct UserButton(Input<'static>);

impl UserButton {
    pub(super) fn new(pin: Peri<'static, PC13>) -> Self {
        // Additional pull-down: reads low even if the board's own resistor is missing.
        Self(Input::new(pin, Pull::Down))
    }
}

impl platform::Button for UserButton {
    fn is_pressed(&mut self) -> bool {
        self.0.is_high()
    }
}
