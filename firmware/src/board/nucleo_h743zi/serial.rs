//! RS-485: USART2 and UART7, with driver-enable by the hardware.

use embassy_stm32::gpio::{AfType, Flex, OutputType, Pull, Speed};
use embassy_stm32::interrupt::typelevel::{self, Handler, Interrupt};
use embassy_stm32::pac::{UART7, USART2, usart};
use embassy_stm32::peripherals::{PD4, PD5, PD6, PE7, PE8, PE9};
use embassy_stm32::{Peri, peripherals, rcc};
use firmware::drivers::usart::{BaudError, Registers, Shared, Usart};
use proto_core::config::Rs485;

/// An RS-485 line.
pub(crate) type SerialDevice = Usart<UsartRegisters>;

/// The registers of a USART.
#[derive(Clone, Copy)]
pub(crate) struct UsartRegisters(usart::Usart);

impl Registers for UsartRegisters {
    fn read(&self, offset: u8) -> u32 {
        // SAFETY: the driver's offsets are registers of the USART, aligned.
        unsafe { self.0.as_ptr().cast::<u8>().add(usize::from(offset)).cast::<u32>().read_volatile() }
    }

    fn write(&self, offset: u8, value: u32) {
        // SAFETY: as above; without DMA a USART touches no memory.
        unsafe { self.0.as_ptr().cast::<u8>().add(usize::from(offset)).cast::<u32>().write_volatile(value) }
    }
}

static FIRST: Shared = Shared::new();
static SECOND: Shared = Shared::new();

/// USART2's interrupt.
pub(super) struct FirstInterrupt;
/// UART7's.
pub(super) struct SecondInterrupt;

impl Handler<typelevel::USART2> for FirstInterrupt {
    unsafe fn on_interrupt() {
        Usart::interrupt(&UsartRegisters(USART2), &FIRST);
    }
}

impl Handler<typelevel::UART7> for SecondInterrupt {
    unsafe fn on_interrupt() {
        Usart::interrupt(&UsartRegisters(UART7), &SECOND);
    }
}

/// The pins of both lines: transmit, receive, driver-enable.
pub(super) struct Pins {
    pub(super) first: (Peri<'static, PD5>, Peri<'static, PD6>, Peri<'static, PD4>),
    pub(super) second: (Peri<'static, PE8>, Peri<'static, PE7>, Peri<'static, PE9>),
}

/// The lines that nobody has yet.
pub(super) struct Lines {
    first: Option<[Flex<'static>; 3]>,
    second: Option<[Flex<'static>; 3]>,
}

impl Lines {
    pub(super) fn new(pins: Pins) -> Self {
        let Pins { first: (tx, rx, de), second } = pins;
        Self {
            first: Some([Flex::new(tx), Flex::new(rx), Flex::new(de)]),
            second: Some([Flex::new(second.0), Flex::new(second.1), Flex::new(second.2)]),
        }
    }

    /// Starts the next line.
    pub(super) fn next(&mut self, line: &Rs485) -> Option<Result<SerialDevice, BaudError>> {
        if let Some(pins) = self.first.take() {
            rcc::enable_and_reset::<peripherals::USART2>();
            let clock = rcc::frequency::<peripherals::USART2>().0;
            let started = Usart::start(UsartRegisters(USART2), &FIRST, line, clock);
            connect(pins);
            enable::<typelevel::USART2>();
            return Some(started);
        }
        let pins = self.second.take()?;
        rcc::enable_and_reset::<peripherals::UART7>();
        let clock = rcc::frequency::<peripherals::UART7>().0;
        let started = Usart::start(UsartRegisters(UART7), &SECOND, line, clock);
        connect(pins);
        enable::<typelevel::UART7>();
        Some(started)
    }
}

/// Hands transmit, receive and driver-enable over to the USART, for ever; it has to run, because before
/// that its driver-enable is raised. The transceiver lets its output float while it sends: that must not
/// be taken for a start bit.
fn connect(pins: [Flex<'static>; 3]) {
    const FUNCTION: u8 = 7;
    let output = AfType::output(OutputType::PushPull, Speed::High);
    for (mut pin, kind) in pins.into_iter().zip([output, AfType::input(Pull::Up), output]) {
        pin.set_as_af_unchecked(FUNCTION, kind);
        core::mem::forget(pin);
    }
}

fn enable<I: Interrupt>() {
    // SAFETY: its handler is bound, and masks no critical section.
    unsafe { I::enable() }
}
