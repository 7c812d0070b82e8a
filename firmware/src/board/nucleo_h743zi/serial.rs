//! RS-485: USART2 and UART7, with driver-enable by hardware.

use embassy_stm32::gpio::{AfType, Flex, OutputType, Pull, Speed};
use embassy_stm32::interrupt::typelevel::{self, Handler, Interrupt};
use embassy_stm32::pac::{UART7, USART2, usart};
use embassy_stm32::peripherals::{PD4, PD5, PD6, PE7, PE8, PE9};
use embassy_stm32::{Peri, peripherals, rcc};
use firmware::drivers::usart::{BaudError, Usart, UsartBlock, UsartShared};
use proto_core::config::Rs485;

pub(crate) type SerialDevice = Usart<UsartRegisters>;

#[derive(Clone, Copy)]
pub(crate) struct UsartRegisters(usart::Usart);

impl UsartBlock for UsartRegisters {
    fn read(&self, offset: u8) -> u32 {
        // SAFETY: the driver passes only offsets of USART registers, which are multiples of 4 and within the
        // peripheral.
        unsafe { self.0.as_ptr().cast::<u8>().add(usize::from(offset)).cast::<u32>().read_volatile() }
    }

    fn write(&self, offset: u8, value: u32) {
        // SAFETY: the driver passes only offsets of USART registers, which are multiples of 4 and within the
        // peripheral. No DMA is used, so the USART accesses no memory.
        unsafe { self.0.as_ptr().cast::<u8>().add(usize::from(offset)).cast::<u32>().write_volatile(value) }
    }
}

static USART2_STATE: UsartShared = UsartShared::new();
static UART7_STATE: UsartShared = UsartShared::new();

pub(super) struct Usart2Interrupt;
pub(super) struct Uart7Interrupt;

impl Handler<typelevel::USART2> for Usart2Interrupt {
    unsafe fn on_interrupt() {
        Usart::interrupt(&UsartRegisters(USART2), &USART2_STATE);
    }
}

impl Handler<typelevel::UART7> for Uart7Interrupt {
    unsafe fn on_interrupt() {
        Usart::interrupt(&UsartRegisters(UART7), &UART7_STATE);
    }
}

/// The pins of both lines: transmit, receive, driver-enable.
pub(super) struct UartPins {
    pub(super) usart2: (Peri<'static, PD5>, Peri<'static, PD6>, Peri<'static, PD4>),
    pub(super) uart7: (Peri<'static, PE8>, Peri<'static, PE7>, Peri<'static, PE9>),
}

/// Lines that have not been handed out.
pub(super) struct Lines {
    usart2: Option<[Flex<'static>; 3]>,
    uart7: Option<[Flex<'static>; 3]>,
}

impl Lines {
    pub(super) fn new(pins: UartPins) -> Self {
        let UartPins { usart2: (tx, rx, de), uart7 } = pins;
        Self {
            usart2: Some([Flex::new(tx), Flex::new(rx), Flex::new(de)]),
            uart7: Some([Flex::new(uart7.0), Flex::new(uart7.1), Flex::new(uart7.2)]),
        }
    }

    /// Starts the next line.
    pub(super) fn next(&mut self, line: &Rs485) -> Option<Result<SerialDevice, BaudError>> {
        if let Some(pins) = self.usart2.take() {
            rcc::enable_and_reset::<peripherals::USART2>();
            let clock = rcc::frequency::<peripherals::USART2>().0;
            let started = Usart::start(UsartRegisters(USART2), &USART2_STATE, line, clock);
            connect(pins);
            enable::<typelevel::USART2>();
            return Some(started);
        }
        let pins = self.uart7.take()?;
        rcc::enable_and_reset::<peripherals::UART7>();
        let clock = rcc::frequency::<peripherals::UART7>().0;
        let started = Usart::start(UsartRegisters(UART7), &UART7_STATE, line, clock);
        connect(pins);
        enable::<typelevel::UART7>();
        Some(started)
    }
}

/// Connects transmit, receive and driver-enable to the USART. The USART must be running already, because its
/// driver-enable output is active before that. The receive pin has a pull-up: the transceiver's output floats while it
/// sends, and must not be taken for a start bit.
fn connect(pins: [Flex<'static>; 3]) {
    const FUNCTION: u8 = 7;
    let output = AfType::output(OutputType::PushPull, Speed::High);
    for (mut pin, kind) in pins.into_iter().zip([output, AfType::input(Pull::Up), output]) {
        pin.set_as_af_unchecked(FUNCTION, kind);
        core::mem::forget(pin);
    }
}

fn enable<I: Interrupt>() {
    // SAFETY: both callers' interrupts have a bound handler. Critical sections disable all interrupts with PRIMASK, so
    // unmasking one in the NVIC does not break them.
    unsafe { I::enable() }
}
