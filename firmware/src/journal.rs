//! The newest lines of the log, for a client of the console.
//!
//! In: the messages of [`info!`](crate::info) to [`error!`](crate::error), on every board as text. Out: lines, the
//! oldest first. Bounded: the oldest lines are dropped and long messages truncated.

use core::cell::RefCell;
use core::fmt::{self, Write};

use critical_section::Mutex;
use heapless::{Deque, String};

/// Level of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// A normal event.
    Info,
    /// A fault that the firmware handles.
    Warn,
    /// Something cannot be done.
    Error,
}

/// Capacity of the journal in bytes.
pub const CAPACITY: usize = 4096;
/// Maximum length of a line in bytes, with its end.
pub const MAX_LINE: usize = 192;

struct Ring {
    bytes: Deque<u8, CAPACITY>,
    /// Number of bytes that were dropped since the start; it wraps.
    dropped: u32,
}

static RING: Mutex<RefCell<Ring>> = Mutex::new(RefCell::new(Ring { bytes: Deque::new(), dropped: 0 }));

/// Appends a line, in a critical section. Not to be called by interrupts with tight deadlines.
#[inline(never)]
pub fn note(level: Level, message: fmt::Arguments<'_>) {
    let mut line = String::<{ MAX_LINE - 1 }>::new();
    let micros = embassy_time::Instant::now().as_micros();
    let (seconds, rest) = (micros / 1_000_000, micros % 1_000_000);
    let level = match level {
        Level::Info => "INFO ",
        Level::Warn => "WARN ",
        Level::Error => "ERROR",
    };
    let _ = write!(Truncated(&mut line), "{seconds:5}.{rest:06} {level} {message}");
    critical_section::with(|cs| {
        let mut ring = RING.borrow_ref_mut(cs);
        ring.push(line.as_bytes());
    });
}

/// Position of the last `lines` lines.
pub fn last(lines: usize) -> u32 {
    critical_section::with(|cs| RING.borrow_ref(cs).last(lines))
}

/// Copies bytes from a position on into `out` and returns their number and the position behind them. Bytes that were
/// dropped meanwhile are skipped.
pub fn read(from: u32, into: &mut [u8]) -> (usize, u32) {
    critical_section::with(|cs| RING.borrow_ref(cs).read(from, into))
}

impl Ring {
    fn push(&mut self, line: &[u8]) {
        while self.bytes.capacity().saturating_sub(self.bytes.len()) < line.len().saturating_add(1) {
            // Drop whole lines only.
            while let Some(byte) = self.bytes.pop_front() {
                self.dropped = self.dropped.wrapping_add(1);
                if byte == b'\n' {
                    break;
                }
            }
        }
        for &byte in line {
            // A line break in a message would look like two messages.
            let _ = self.bytes.push_back(if byte < b' ' { b' ' } else { byte });
        }
        let _ = self.bytes.push_back(b'\n');
    }

    fn last(&self, lines: usize) -> u32 {
        let mut left = lines.saturating_add(1);
        let is_before = |&(_, byte): &(usize, &u8)| {
            left = left.saturating_sub(usize::from(*byte == b'\n'));
            left == 0
        };
        let found = self.bytes.iter().enumerate().rev().find(is_before);
        let start = found.map_or(0, |(at, _)| at.saturating_add(1));
        self.dropped.wrapping_add(start as u32)
    }

    fn read(&self, from: u32, into: &mut [u8]) -> (usize, u32) {
        // A distance of more than the capacity means that the bytes at this position were dropped.
        let skipped = from.wrapping_sub(self.dropped);
        let skipped = if skipped as usize > CAPACITY { 0 } else { skipped };
        let mut count = 0_usize;
        for (place, byte) in into.iter_mut().zip(self.bytes.iter().skip(skipped as usize)) {
            *place = *byte;
            count = count.saturating_add(1);
        }
        (count, self.dropped.wrapping_add(skipped).wrapping_add(count as u32))
    }
}

/// Writes text and truncates it at the capacity.
pub(crate) struct Truncated<'a, const N: usize>(pub(crate) &'a mut String<N>);

impl<const N: usize> Write for Truncated<'_, N> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for letter in text.chars() {
            self.0.push(letter).map_err(|_| fmt::Error)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::string::String as Text;

    use super::*;

    fn ring() -> Ring {
        Ring { bytes: Deque::new(), dropped: 0 }
    }

    /// Reads everything from a position on, in pieces.
    fn all<const N: usize>(ring: &Ring, mut from: u32) -> Text {
        let mut text = Text::new();
        loop {
            let mut piece = [0; N];
            let (len, behind) = ring.read(from, &mut piece);
            if len == 0 {
                return text;
            }
            from = behind;
            text.push_str(str::from_utf8(&piece[..len]).unwrap());
        }
    }

    #[test]
    fn the_last_lines_are_read_in_pieces_of_any_size() {
        let mut ring = ring();
        assert_eq!(all::<8>(&ring, ring.last(3)), "");
        for line in ["one", "two", "three"] {
            ring.push(line.as_bytes());
        }
        for (lines, text) in
            [(0, ""), (1, "three\n"), (2, "two\nthree\n"), (3, "one\ntwo\nthree\n"), (9, "one\ntwo\nthree\n")]
        {
            assert_eq!(all::<1>(&ring, ring.last(lines)), text);
            assert_eq!(all::<100>(&ring, ring.last(lines)), text);
        }
    }

    #[test]
    fn the_oldest_lines_give_way_as_a_whole_and_a_reader_goes_on_behind_them() {
        let mut ring = ring();
        let line = |nth: usize| std::format!("{nth:099}");
        for nth in 0..50 {
            ring.push(line(nth).as_bytes());
        }
        let text = all::<64>(&ring, ring.last(usize::MAX));
        assert_eq!(text.lines().next(), Some(&*line(10)));
        let (_, place) = ring.read(ring.last(40), &mut [0; 100]);
        for nth in 50..60 {
            ring.push(line(nth).as_bytes());
        }
        assert_eq!(all::<64>(&ring, place).lines().next(), Some(&*line(20)));
    }

    #[test]
    fn a_message_is_one_line_and_is_cut() {
        let mut ring = ring();
        ring.push(b"two\r\nlines");
        assert_eq!(all::<64>(&ring, 0), "two  lines\n");
        let mut long = String::<{ MAX_LINE - 1 }>::new();
        assert!(write!(Truncated(&mut long), "{}", "x".repeat(500)).is_err());
        assert_eq!(long.len(), MAX_LINE - 1);
    }
}
