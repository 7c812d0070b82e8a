//! An STM32 USART (with FIFOs, as in the H7) as an RS-485 line.
//!
//! In: register accesses through [`UsartBlock`], the line's settings, and calls of [`Usart::interrupt`].
//! Out: a [`Line`]. Does not know boards or pins.
//!
//! Interrupts are used instead of DMA, because each character with a parity or framing error has to be discarded: a
//! recipe's stream has no checksum. Corrupted characters are common when a half-duplex line changes direction, and must
//! not stop the reception of the next ones. The receive FIFO is emptied when it is a quarter full, or when the line is
//! idle for one character. It then has room for 12 more characters, that is 260 µs at 460800 baud. The hardware
//! controls driver-enable and releases it half a bit after the last stop bit.

use core::cell::RefCell;
use core::convert::Infallible;
use core::future::poll_fn;
use core::task::Poll;

use critical_section::Mutex;
use embassy_sync::waitqueue::WakerRegistration;
use embedded_io_async::{ErrorType, Read, Write};
use heapless::Deque;
use proto_core::config::{Parity, Rs485};

use super::line::{Line, LineErrors};

/// The registers of one USART, 32 bits each.
pub trait UsartBlock {
    /// Reads the register at `offset`.
    fn read(&self, offset: u8) -> u32;
    /// Writes the register at `offset`.
    fn write(&self, offset: u8, value: u32);
}

/// State shared by a line and its interrupt handler.
pub struct UsartShared(Mutex<RefCell<UsartState>>);

impl UsartShared {
    /// The state of a line that is not started.
    pub const fn new() -> Self {
        Self(Mutex::new(RefCell::new(UsartState {
            received: Deque::new(),
            waiting: Deque::new(),
            reader: WakerRegistration::new(),
            writer: WakerRegistration::new(),
            errors: LineErrors::NONE,
        })))
    }
}

impl Default for UsartShared {
    fn default() -> Self {
        Self::new()
    }
}

/// The USART does not support this baud rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BaudError {
    /// Requested baud rate, in bit/s.
    pub baud: u32,
    /// The USART's kernel clock, in Hz.
    pub clock: u32,
}

impl core::fmt::Display for BaudError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{} baud cannot be made from {} Hz", self.baud, self.clock)
    }
}

impl core::error::Error for BaudError {}

/// An RS-485 line.
pub struct Usart<R: 'static> {
    regs: R,
    shared: &'static UsartShared,
}

impl<R: UsartBlock> Usart<R> {
    /// Starts the USART after its reset. `clock` is its kernel clock in Hz. From here on its interrupt handler
    /// has to call [`Usart::interrupt`].
    ///
    /// # Errors
    /// [`BaudError`] if no divider gives the baud rate within 1 %.
    pub fn start(regs: R, shared: &'static UsartShared, line: &Rs485, clock: u32) -> Result<Self, BaudError> {
        let speed = Speed::of(line.baud, clock)?;
        regs.write(CR1, 0);
        regs.write(PRESC, speed.prescaler);
        regs.write(BRR, speed.divider);
        regs.write(CR2, if line.stop_bits == 2 { CR2_TWO_STOP_BITS } else { 0 });
        regs.write(CR3, CR3_DRIVER_ENABLE | CR3_RX_QUARTER | CR3_RX_THRESHOLD_IRQ | CR3_TX_HALF);
        // The parity bit counts as a bit of the word.
        let parity = match line.parity {
            Parity::None => 0,
            Parity::Even => CR1_NINE_BITS | CR1_PARITY,
            Parity::Odd => CR1_NINE_BITS | CR1_PARITY | CR1_ODD,
        };
        let cr1 = CR1_FIFO | CR1_TX | CR1_RX | CR1_IDLE_IRQ | CR1_DRIVER_TIMES | parity;
        regs.write(CR1, cr1);
        regs.write(CR1, cr1 | CR1_ENABLE);
        Ok(Self { regs, shared })
    }

    /// The interrupt handler.
    pub fn interrupt(regs: &R, shared: &UsartShared) {
        with(regs, shared, |line| {
            line.receive();
            if !line.state.received.is_empty() {
                line.state.reader.wake();
            }
            line.transmit();
        });
    }

    fn with<T>(&self, f: impl FnOnce(&mut UsartAccess<'_, R>) -> T) -> T {
        with(&self.regs, self.shared, f)
    }
}

/// Calls `f` with the registers and the shared state, in a critical section.
fn with<R, T>(regs: &R, shared: &UsartShared, f: impl FnOnce(&mut UsartAccess<'_, R>) -> T) -> T {
    critical_section::with(|cs| f(&mut UsartAccess { regs, state: &mut shared.0.borrow_ref_mut(cs) }))
}

struct UsartState {
    received: Deque<u8, RX_RING>,
    waiting: Deque<u8, TX_RING>,
    reader: WakerRegistration,
    writer: WakerRegistration,
    errors: LineErrors,
}

struct UsartAccess<'a, R> {
    regs: &'a R,
    state: &'a mut UsartState,
}

impl<R: UsartBlock> UsartAccess<'_, R> {
    fn set(&self, register: u8, bits: u32) {
        self.regs.write(register, self.regs.read(register) | bits);
    }

    fn clear(&self, register: u8, bits: u32) {
        self.regs.write(register, self.regs.read(register) & !bits);
    }

    fn receive(&mut self) {
        // Cleared before the FIFO is emptied, so that a later idle line interrupts again.
        self.regs.write(ICR, IDLE);
        let errors = &mut self.state.errors;
        // Each character has its own error flags. They are cleared before the character is read, because afterwards
        // the flags belong to the next character.
        for _ in 0..MAX_AT_ONCE {
            let status = self.regs.read(ISR);
            if status & OVERRUN != 0 {
                errors.overruns = errors.overruns.wrapping_add(1);
                self.regs.write(ICR, OVERRUN);
            }
            if status & RX_NOT_EMPTY == 0 {
                break;
            }
            if status & CHARACTER_ERRORS != 0 {
                self.regs.write(ICR, CHARACTER_ERRORS);
            }
            let byte = self.regs.read(RDR) as u8;
            if status & FRAMING_ERROR != 0 {
                errors.framing = errors.framing.wrapping_add(1);
            } else if status & PARITY_ERROR != 0 {
                errors.parity = errors.parity.wrapping_add(1);
            } else if self.state.received.is_full() {
                errors.unread = errors.unread.wrapping_add(1);
            } else {
                let _ = self.state.received.push_back(byte);
            }
        }
    }

    /// Fills the transmit FIFO. Wakes the task in `flush` when all characters have left.
    fn transmit(&mut self) {
        while !self.state.waiting.is_empty() && self.regs.read(ISR) & TX_NOT_FULL != 0 {
            if let Some(byte) = self.state.waiting.pop_front() {
                self.regs.write(TDR, u32::from(byte));
            }
            self.state.writer.wake();
        }
        if self.state.waiting.is_empty() {
            self.clear(CR3, CR3_TX_THRESHOLD_IRQ);
            if self.regs.read(ISR) & TX_COMPLETE != 0 && self.regs.read(CR1) & CR1_TX_COMPLETE_IRQ != 0 {
                self.clear(CR1, CR1_TX_COMPLETE_IRQ);
                self.state.writer.wake();
            }
        } else {
            self.set(CR3, CR3_TX_THRESHOLD_IRQ);
        }
    }
}

impl<R: UsartBlock> ErrorType for Usart<R> {
    type Error = Infallible;
}

impl<R: UsartBlock> Read for Usart<R> {
    async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
        poll_fn(|cx| {
            self.with(|line| {
                // Read the FIFO here too: up to a quarter of it causes no interrupt until the line is idle.
                line.receive();
                if line.state.received.is_empty() && !buf.is_empty() {
                    line.state.reader.register(cx.waker());
                    return Poll::Pending;
                }
                let mut len = 0;
                for place in buf.iter_mut() {
                    let Some(byte) = line.state.received.pop_front() else { break };
                    *place = byte;
                    len += 1;
                }
                Poll::Ready(Ok(len))
            })
        })
        .await
    }
}

impl<R: UsartBlock> Write for Usart<R> {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        poll_fn(|cx| {
            self.with(|line| {
                if line.state.waiting.is_full() && !buf.is_empty() {
                    line.state.writer.register(cx.waker());
                    return Poll::Pending;
                }
                // The end of an earlier transmission must not be taken for the end of this one.
                line.regs.write(ICR, TX_COMPLETE);
                let taken = buf.iter().take_while(|&&byte| line.state.waiting.push_back(byte).is_ok());
                let len = taken.count();
                line.transmit();
                Poll::Ready(Ok(len))
            })
        })
        .await
    }

    /// Waits for the end of the last stop bit. The caller (`serial::run`) gives up waiting if the line does not accept
    /// the bytes; the next transmission then follows the rest of this one.
    async fn flush(&mut self) -> Result<(), Infallible> {
        poll_fn(|cx| {
            self.with(|line| {
                if line.state.waiting.is_empty() && line.regs.read(ISR) & TX_COMPLETE != 0 {
                    line.clear(CR1, CR1_TX_COMPLETE_IRQ);
                    return Poll::Ready(Ok(()));
                }
                line.state.writer.register(cx.waker());
                line.set(CR1, CR1_TX_COMPLETE_IRQ);
                Poll::Pending
            })
        })
        .await
    }
}

impl<R: UsartBlock> Line for Usart<R> {
    fn errors(&self) -> LineErrors {
        self.with(|line| line.state.errors)
    }
}

/// How the USART's clock is divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Speed {
    /// Index in [`PRESCALERS`], the value of the register.
    prescaler: u32,
    divider: u32,
}

impl Speed {
    fn of(baud: u32, clock: u32) -> Result<Self, BaudError> {
        let error = BaudError { baud, clock };
        let whole = baud.max(1);
        let (prescaler, rate, divider) = (0..)
            .zip(PRESCALERS)
            .map(|(index, prescaler)| {
                let clock = clock / prescaler;
                (index, clock, clock.saturating_add(whole / 2) / whole)
            })
            .find(|(.., divider)| *divider <= MAX_DIVIDER)
            .ok_or(error)?;
        let off_by = (rate / divider.max(1)).abs_diff(baud);
        if divider < MIN_DIVIDER || off_by > baud / 100 {
            return Err(error);
        }
        Ok(Self { prescaler, divider })
    }
}

/// Characters buffered for the task: 22 ms at 460800 baud.
const RX_RING: usize = 1024;
/// Characters buffered for the line: the longest frame.
const TX_RING: usize = 512;
/// Maximum number of characters per call of the interrupt handler: more than fit into the FIFO.
const MAX_AT_ONCE: usize = 32;

const PRESCALERS: [u32; 12] = [1, 2, 4, 6, 8, 10, 12, 16, 32, 64, 128, 256];
const MIN_DIVIDER: u32 = 16;
const MAX_DIVIDER: u32 = 0xFFFF;

const CR1: u8 = 0x00;
const CR2: u8 = 0x04;
const CR3: u8 = 0x08;
const BRR: u8 = 0x0C;
const ISR: u8 = 0x1C;
const ICR: u8 = 0x20;
const RDR: u8 = 0x24;
const TDR: u8 = 0x28;
const PRESC: u8 = 0x2C;

const CR1_ENABLE: u32 = 1;
const CR1_RX: u32 = 1 << 2;
const CR1_TX: u32 = 1 << 3;
const CR1_IDLE_IRQ: u32 = 1 << 4;
const CR1_TX_COMPLETE_IRQ: u32 = 1 << 6;
const CR1_ODD: u32 = 1 << 9;
const CR1_PARITY: u32 = 1 << 10;
const CR1_NINE_BITS: u32 = 1 << 12;
/// Half a bit before the first start bit and half a bit after the last stop bit.
const CR1_DRIVER_TIMES: u32 = 8 << 16 | 8 << 21;
const CR1_FIFO: u32 = 1 << 29;
const CR2_TWO_STOP_BITS: u32 = 2 << 12;
const CR3_DRIVER_ENABLE: u32 = 1 << 14;
const CR3_TX_THRESHOLD_IRQ: u32 = 1 << 23;
const CR3_RX_QUARTER: u32 = 1 << 25;
const CR3_RX_THRESHOLD_IRQ: u32 = 1 << 28;
/// Threshold of the transmit interrupt: half of the FIFO is free.
const CR3_TX_HALF: u32 = 2 << 29;

// Flags of ISR, and in ICR the bits that clear them.
const PARITY_ERROR: u32 = 1;
const FRAMING_ERROR: u32 = 1 << 1;
const NOISE: u32 = 1 << 2;
const OVERRUN: u32 = 1 << 3;
const IDLE: u32 = 1 << 4;
const TX_COMPLETE: u32 = 1 << 6;
// Flags of ISR only.
const RX_NOT_EMPTY: u32 = 1 << 5;
const TX_NOT_FULL: u32 = 1 << 7;
/// Errors of a character, to be cleared. Noise is not counted, because the USART then takes the majority of the bit's
/// samples.
const CHARACTER_ERRORS: u32 = PARITY_ERROR | FRAMING_ERROR | NOISE;

#[cfg(test)]
mod tests;
