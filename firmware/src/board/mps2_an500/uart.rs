//! UARTs with interrupts and buffers in both directions.
//!
//! Received bytes are buffered; when the buffer is full, the next byte stays in the UART and QEMU stops the
//! sender, so nothing is lost.

use core::cell::RefCell;
use core::convert::Infallible;
use core::future::poll_fn;
use core::task::Poll;

use critical_section::Mutex;
use embassy_sync::waitqueue::WakerRegistration;
use embedded_io_async::{ErrorType, Read, Write};
use firmware::drivers::line::Line;
use heapless::Deque;

use super::Irq;
use super::registers::{UARTS, read, write};

const COUNT: usize = 3;
/// Bytes buffered in each direction.
const RING: usize = 2048;

const DATA: u32 = 0x0;
const STATE: u32 = 0x4;
const CTRL: u32 = 0x8;
const INTCLEAR: u32 = 0xC;
const BAUDDIV: u32 = 0x10;
const STATE_TX_FULL: u32 = 1;
const STATE_RX_FULL: u32 = 2;
const CTRL_TX: u32 = 1;
const CTRL_RX: u32 = 2;
const CTRL_TX_IRQ: u32 = 4;
const CTRL_RX_IRQ: u32 = 8;
const INT_TX: u32 = 1;
const INT_RX: u32 = 2;

/// The unique handle of a UART.
#[derive(Debug)]
pub(crate) struct Uart(usize);

struct UartState {
    received: Deque<u8, RING>,
    waiting: Deque<u8, RING>,
    reader: WakerRegistration,
    writer: WakerRegistration,
}

static STATES: [Mutex<RefCell<UartState>>; COUNT] =
    [const { Mutex::new(RefCell::new(UartState::new())) }; COUNT];

/// Calls `f` with the registers and the shared state, in a critical section.
fn with<T>(port: usize, f: impl FnOnce(&mut UartAccess<'_>) -> T) -> T {
    critical_section::with(|cs| {
        f(&mut UartAccess { base: UARTS[port], state: &mut STATES[port].borrow_ref_mut(cs) })
    })
}

impl UartState {
    const fn new() -> Self {
        Self {
            received: Deque::new(),
            waiting: Deque::new(),
            reader: WakerRegistration::new(),
            writer: WakerRegistration::new(),
        }
    }
}

struct UartAccess<'a> {
    base: u32,
    state: &'a mut UartState,
}

impl UartAccess<'_> {
    fn set(&self, bit: u32) {
        write(self.base + CTRL, read(self.base + CTRL) | bit);
    }

    fn clear(&self, bit: u32) {
        write(self.base + CTRL, read(self.base + CTRL) & !bit);
    }

    /// Reads the UART while there is room.
    fn drain(&mut self) {
        write(self.base + INTCLEAR, INT_RX);
        while read(self.base + STATE) & STATE_RX_FULL != 0 {
            if self.state.received.is_full() {
                self.clear(CTRL_RX_IRQ);
                return;
            }
            let _ = self.state.received.push_back(read(self.base + DATA) as u8);
            self.state.reader.wake();
        }
    }

    /// Writes to the UART while it has room.
    fn fill(&mut self) {
        write(self.base + INTCLEAR, INT_TX);
        while !self.state.waiting.is_empty() {
            if read(self.base + STATE) & STATE_TX_FULL != 0 {
                self.set(CTRL_TX_IRQ);
                if read(self.base + STATE) & STATE_TX_FULL != 0 {
                    return;
                }
            }
            if let Some(byte) = self.state.waiting.pop_front() {
                write(self.base + DATA, u32::from(byte));
            }
        }
        self.clear(CTRL_TX_IRQ);
        self.state.writer.wake();
    }
}

pub(super) fn on_rx<const PORT: usize>() {
    with(PORT, |uart| uart.drain());
}

pub(super) fn on_tx<const PORT: usize>() {
    with(PORT, |uart| uart.fill());
}

impl Uart {
    pub(super) fn open(port: usize) -> Self {
        with(port, |uart| {
            write(uart.base + BAUDDIV, 16);
            write(uart.base + CTRL, CTRL_TX | CTRL_RX | CTRL_RX_IRQ);
            uart.drain();
            // QEMU's multiplexer delivers input from before the start when the register is read, otherwise only after
            // the next byte.
            let _ = read(uart.base + DATA);
        });
        let irq = 2 * port as u16;
        Irq(irq).enable();
        Irq(irq + 1).enable();
        Self(port)
    }
}

impl ErrorType for Uart {
    type Error = Infallible;
}

impl Read for Uart {
    async fn read(&mut self, buf: &mut [u8]) -> Result<usize, Infallible> {
        poll_fn(|cx| {
            with(self.0, |uart| {
                if uart.state.received.is_empty() {
                    uart.state.reader.register(cx.waker());
                    return Poll::Pending;
                }
                let mut len = 0;
                for place in buf.iter_mut() {
                    let Some(byte) = uart.state.received.pop_front() else { break };
                    *place = byte;
                    len += 1;
                }
                if read(uart.base + CTRL) & CTRL_RX_IRQ == 0 {
                    uart.set(CTRL_RX_IRQ);
                    uart.drain();
                }
                Poll::Ready(Ok(len))
            })
        })
        .await
    }
}

impl Write for Uart {
    async fn write(&mut self, buf: &[u8]) -> Result<usize, Infallible> {
        poll_fn(|cx| {
            with(self.0, |uart| {
                let room = uart.state.waiting.capacity() - uart.state.waiting.len();
                if room == 0 && !buf.is_empty() {
                    uart.state.writer.register(cx.waker());
                    return Poll::Pending;
                }
                let len = room.min(buf.len());
                for &byte in &buf[..len] {
                    let _ = uart.state.waiting.push_back(byte);
                }
                uart.fill();
                Poll::Ready(Ok(len))
            })
        })
        .await
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        poll_fn(|cx| {
            with(self.0, |uart| {
                if uart.state.waiting.is_empty() {
                    return Poll::Ready(Ok(()));
                }
                uart.state.writer.register(cx.waker());
                Poll::Pending
            })
        })
        .await
    }
}

/// The emulated line has no driver-enable.
impl Line for Uart {}
