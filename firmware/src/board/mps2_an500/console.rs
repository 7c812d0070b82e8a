//! The console: UART 3, without interrupts. Text that cannot be sent at once is dropped, because the log must not delay
//! the buses.
//!
//! The loader compiles this file too (firmware/boot/src/board/mps2_an500/mod.rs).

use core::fmt::{self, Write};

use super::registers::{UARTS, read, write};

const UART: u32 = UARTS[3];
const STATE: u32 = UART + 0x4;
const STATE_TX_FULL: u32 = 1;

pub(crate) fn start() {
    write(UART + 0x10, 16);
    write(UART + 0x8, 1);
}

struct ConsoleUart;

impl Write for ConsoleUart {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for byte in text.bytes() {
            if read(STATE) & STATE_TX_FULL == 0 {
                write(UART, u32::from(byte));
            }
        }
        Ok(())
    }
}

pub(crate) fn print(text: fmt::Arguments<'_>) {
    let _ = ConsoleUart.write_fmt(text);
}
