//! The memory map and interrupt lines of the peripherals. RM0433, "Memory and bus architecture"; the clock
//! gates are those of RCC's registers AHB1ENR to APB4ENR.

use crate::device::{Peripheral, Picos, Pin};
use crate::models::ethernet::Ethernet;
use crate::models::fdcan::Fdcan;
use crate::models::flash::Flash;
use crate::models::gpio::Port;
use crate::models::iwdg::Watchdog;
use crate::models::rcc::{Gate, Rcc};
use crate::models::simple::{AXI, DBGMCU, Plain, Pwr, Rng, Syscfg};
use crate::models::timer::Timer;
use crate::models::usart::{Pins, Usart};

/// A device in [`MAP`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Id {
    Rcc,
    Pwr,
    Flash,
    Syscfg,
    Gpio(usize),
    Watchdog,
    Dbgmcu,
    Axi,
    Tim12,
    Usart2,
    Uart7,
    Can,
    CanRam,
    Ethernet,
    Rng,
}

pub(crate) struct DeviceEntry {
    pub(crate) base: u32,
    pub(crate) size: u32,
    pub(crate) name: &'static str,
    pub(crate) gate: Option<Gate>,
    pub(crate) id: Id,
    /// Number of its interrupt.
    pub(crate) line: Option<u16>,
}

impl DeviceEntry {
    /// Whether it has to be advanced when time passes.
    pub(crate) fn changes_with_time(&self) -> bool {
        !matches!(self.id, Id::Gpio(_) | Id::CanRam)
    }
}

const fn place(
    base: u32,
    size: u32,
    name: &'static str,
    gate: Option<Gate>,
    id: Id,
    line: Option<u16>,
) -> DeviceEntry {
    DeviceEntry { base, size, name, gate, id, line }
}

const fn gate(enable: u32, bits: u32) -> Option<Gate> {
    Some(Gate { enable, bits })
}

const fn port(index: usize, name: &'static str) -> DeviceEntry {
    place(0x5802_0000 + 0x400 * index as u32, 0x400, name, gate(0xE0, 1 << index), Id::Gpio(index), None)
}

/// Clock gate of FDCAN1 and its message RAM.
pub(crate) const CAN: Option<Gate> = gate(0xEC, 1 << 8);
/// The memory map. An access outside of it ends the run.
pub(crate) static MAP: [DeviceEntry; 25] = [
    place(0x4000_1800, 0x400, "TIM12", gate(0xE8, 1 << 6), Id::Tim12, Some(43)),
    place(0x4000_4400, 0x400, "USART2", gate(0xE8, 1 << 17), Id::Usart2, Some(38)),
    place(0x4000_7800, 0x400, "UART7", gate(0xE8, 1 << 30), Id::Uart7, Some(82)),
    place(0x4000_A000, 0xC00, "FDCAN1", CAN, Id::Can, Some(19)),
    place(0x4000_AC00, 0x2800, "message RAM", CAN, Id::CanRam, None),
    place(0x4002_8000, 0x2000, "ETH", gate(0xD8, 7 << 15), Id::Ethernet, Some(61)),
    place(0x4802_1800, 0x400, "RNG", gate(0xDC, 1 << 6), Id::Rng, None),
    place(0x5100_8000, 0x1000, "AXI", None, Id::Axi, None),
    place(0x5200_2000, 0x400, "FLASH", None, Id::Flash, None),
    place(0x5800_0400, 0x400, "SYSCFG", gate(0xF4, 1 << 1), Id::Syscfg, None),
    port(0, "GPIOA"),
    port(1, "GPIOB"),
    port(2, "GPIOC"),
    port(3, "GPIOD"),
    port(4, "GPIOE"),
    port(5, "GPIOF"),
    port(6, "GPIOG"),
    port(7, "GPIOH"),
    port(8, "GPIOI"),
    port(9, "GPIOJ"),
    port(10, "GPIOK"),
    place(0x5802_4400, 0x400, "RCC", None, Id::Rcc, None),
    place(0x5802_4800, 0x400, "PWR", None, Id::Pwr, None),
    place(0x5800_4800, 0x400, "IWDG1", None, Id::Watchdog, None),
    place(0x5C00_1000, 0x400, "DBGMCU", None, Id::Dbgmcu, None),
];

/// The user's LEDs of the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Led {
    /// LD1, green: PB0.
    Green,
    /// LD2, yellow: PE1.
    Yellow,
    /// LD3, red: PB14.
    Red,
}

impl Led {
    fn pin(self) -> Pin {
        match self {
            Self::Green => Pin('B', 0),
            Self::Yellow => Pin('E', 1),
            Self::Red => Pin('B', 14),
        }
    }
}

/// The user's button B1, between the supply and a pin that the board pulls down.
const BUTTON: Pin = Pin('C', 13);

/// The models.
#[derive(Debug)]
pub struct Devices {
    /// Clocks and resets.
    pub rcc: Rcc,
    /// Power control.
    pub pwr: Pwr,
    /// Selects MII or RMII.
    pub syscfg: Syscfg,
    /// Ports A to K.
    pub gpio: [Port; 11],
    /// The independent watchdog.
    pub watchdog: Watchdog,
    /// TIM12.
    pub tim12: Timer,
    /// USART2: RS-485 A.
    pub usart2: Usart,
    /// UART7: RS-485 B.
    pub uart7: Usart,
    /// FDCAN1.
    pub can: Fdcan,
    /// The Ethernet controller.
    pub ethernet: Ethernet,
    /// The random number generator.
    pub rng: Rng,
    /// Flash and its registers.
    pub flash: Flash,
    /// The chip's device and revision identifiers.
    pub dbgmcu: Plain,
    /// The AXI interconnect.
    pub axi: Plain,
}

impl Devices {
    pub(crate) fn new() -> Self {
        let pins = |tx, rx, de| Pins { tx, rx, de, function: 7 };
        let mut devices = Self {
            rcc: Rcc::new(),
            pwr: Pwr::new(),
            syscfg: Syscfg::new(),
            gpio: std::array::from_fn(|index| Port::new((b'A' + index as u8) as char)),
            watchdog: Watchdog::new(),
            tim12: Timer::new(),
            usart2: Usart::new(pins(Pin('D', 5), Pin('D', 6), Pin('D', 4))),
            uart7: Usart::new(pins(Pin('E', 8), Pin('E', 7), Pin('E', 9))),
            can: Fdcan::new(),
            ethernet: Ethernet::new(),
            rng: Rng::new(),
            flash: Flash::new(),
            dbgmcu: Plain::new(&DBGMCU),
            axi: Plain::new(&AXI),
        };
        devices.gpio[BUTTON.port()].drive(0, BUTTON.1, false);
        devices
    }

    /// Presses button B1 for `span`, from `at` on, which must not be before the end of an earlier press.
    pub fn press_button(&mut self, at: Picos, span: Picos) {
        let port = &mut self.gpio[BUTTON.port()];
        port.drive(at, BUTTON.1, true);
        port.drive(at + span, BUTTON.1, false);
    }

    /// When an LED was switched on (`true`) and off, in order.
    pub fn led(&self, led: Led) -> impl DoubleEndedIterator<Item = (Picos, bool)> {
        let pin = led.pin();
        let changes = self.gpio[pin.port()].changes.iter();
        changes.filter(move |(_, of, _)| *of == pin.1).map(|(at, _, is_lit)| (*at, *is_lit))
    }

    pub(crate) fn device(&mut self, id: Id) -> &mut dyn Peripheral {
        match id {
            Id::Rcc => &mut self.rcc,
            Id::Pwr => &mut self.pwr,
            Id::Flash => &mut self.flash,
            Id::Syscfg => &mut self.syscfg,
            Id::Gpio(index) => &mut self.gpio[index],
            Id::Watchdog => &mut self.watchdog,
            Id::Dbgmcu => &mut self.dbgmcu,
            Id::Axi => &mut self.axi,
            Id::Tim12 => &mut self.tim12,
            Id::Usart2 => &mut self.usart2,
            Id::Uart7 => &mut self.uart7,
            Id::Can | Id::CanRam => &mut self.can,
            Id::Ethernet => &mut self.ethernet,
            Id::Rng => &mut self.rng,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{Clocks, Context, Functions, MILLI};

    static NONE: Functions = [[None; 16]; 11];

    #[test]
    fn the_button_is_high_while_it_is_pressed_and_leds_are_told_apart() {
        const IDR: u32 = 0x10;
        const BSRR: u32 = 0x18;
        let mut devices = Devices::new();
        let at = |now| Context { now, clocks: Clocks::default(), functions: &NONE, is_rmii: false };
        devices.gpio[2].write(0, !(3 << 26), &at(0)).expect("PC13 becomes an input");
        devices.press_button(10 * MILLI, 5 * MILLI);
        devices.press_button(20 * MILLI, MILLI);
        let mut is_pressed = |ms| devices.gpio[2].read(IDR, &at(ms * MILLI)).expect("it can be read") != 0;
        let pressed: Vec<u64> = (0..30).filter(|ms| is_pressed(*ms)).collect();
        assert_eq!(pressed, [10, 11, 12, 13, 14, 20]);
        devices.gpio[1].write(BSRR, 1 << 14 | 1, &at(MILLI)).expect("LD3 and LD1");
        devices.gpio[1].write(BSRR, 1 << 16, &at(2 * MILLI)).expect("LD1");
        assert_eq!(devices.led(Led::Green).collect::<Vec<_>>(), [(MILLI, true), (2 * MILLI, false)]);
        assert_eq!(devices.led(Led::Red).collect::<Vec<_>>(), [(MILLI, true)]);
        assert_eq!(devices.led(Led::Yellow).count(), 0);
    }
}
