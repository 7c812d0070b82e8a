//! An RS-485 line: what the chip and other devices send.

use std::collections::VecDeque;

use crate::device::*;

/// A character that the chip has sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// Its data.
    pub byte: u8,
    /// The falling edge of its start bit.
    pub start: Picos,
    /// The end of its last stop bit.
    pub end: Picos,
    /// Bit time.
    pub bit: Picos,
    /// Parity bit; `None` without parity.
    pub parity: Option<bool>,
    /// Number of stop bits.
    pub stop_bits: u8,
    /// Whether the driver was enabled from its start to its end; otherwise it did not reach the line.
    pub is_driven: bool,
}

/// The serial format of another device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format {
    /// Bit/s.
    pub baud: u32,
    /// `None` without parity, `Some(true)` for odd parity.
    pub odd_parity: Option<bool>,
    /// 1 or 2.
    pub stop_bits: u8,
}

/// The line.
#[derive(Debug, Default)]
pub struct Line {
    /// Characters sent by the chip.
    pub sent: Vec<Sent>,
    /// Each change of driver-enable at the transceiver.
    pub driver: Vec<(Picos, bool)>,
    /// A pair of wires for each direction: the chip receives while it sends.
    pub has_four_wires: bool,
    /// The edges of other devices, each with the level after it. An idle line is high.
    edges: VecDeque<(Picos, bool)>,
    /// The level before the first of `edges` is low.
    is_low: bool,
    /// The receiver has sampled the line up to this time.
    consumed: Picos,
}

impl Line {
    /// Another device sends these bytes without gaps, starting at `from`. Returns the end of the last.
    pub fn send(&mut self, from: Picos, bytes: &[u8], format: Format) -> Picos {
        bytes.iter().fold(from, |start, byte| {
            let parity = format.odd_parity.map(|is_odd| byte.count_ones().is_multiple_of(2) == is_odd);
            let mut bits: Vec<bool> = vec![false];
            bits.extend((0..8).map(|index| byte >> index & 1 != 0));
            bits.extend(parity);
            bits.extend((0..format.stop_bits).map(|_| true));
            self.put(start, SECOND / Picos::from(format.baud), &bits)
        })
    }

    /// Another device drives these levels, `bit` long each, starting at `from`; then the line is idle.
    pub fn put(&mut self, from: Picos, bit: Picos, bits: &[bool]) -> Picos {
        let mut before = self.edges.back().is_none_or(|(_, level)| *level);
        for (index, level) in (0..).zip(bits) {
            if *level != before {
                self.edges.push_back((from + index * bit, *level));
                before = *level;
            }
        }
        let end = from + bits.len() as Picos * bit;
        if !before {
            self.edges.push_back((end, true));
        }
        end
    }

    pub(super) fn drive(&mut self, at: Picos, is_on: bool) {
        if self.driver.last().is_some_and(|(_, was_on)| *was_on) != is_on {
            self.driver.push((at, is_on));
        }
    }

    /// Takes the characters that the chip has sent, and drops old changes of driver-enable.
    pub fn take_sent(&mut self) -> std::vec::Drain<'_, Sent> {
        let old = self.driver.len().saturating_sub(DRIVER_KEPT);
        self.driver.drain(..old);
        self.sent.drain(..)
    }

    /// Whether driver-enable was active at a time.
    pub fn is_driven(&self, at: Picos) -> bool {
        let behind = self.driver.partition_point(|(time, _)| *time <= at);
        // At the time of an edge it counts as active.
        let before = behind.checked_sub(1).map(|index| self.driver[index]);
        before.is_some_and(|(time, is_on)| is_on || time == at)
    }

    /// The level at the chip's receiver, which is off while the chip's own driver is on.
    pub(super) fn level(&self, at: Picos) -> bool {
        let last = self.edges.iter().take_while(|(time, _)| *time <= at).last();
        !self.has_four_wires && self.is_driven(at) || last.map_or(!self.is_low, |(_, level)| *level)
    }

    /// The next falling edge that the receiver has not sampled yet, up to `now`.
    pub(super) fn start_bit(&self, now: Picos) -> Option<Picos> {
        let falls = self.edges.iter().find(|(time, level)| !level && *time >= self.consumed);
        falls.map(|(time, _)| *time).filter(|time| *time <= now)
    }

    /// As [`Self::start_bit`], also in the future.
    pub(super) fn next_start_bit(&self) -> Option<Picos> {
        self.start_bit(Picos::MAX)
    }

    pub(super) fn consume(&mut self, until: Picos) {
        self.consumed = until;
        while let Some(&(time, level)) = self.edges.front()
            && time < until
        {
            self.is_low = !level;
            self.edges.pop_front();
        }
    }
}

/// Number of changes of driver-enable that [`Line::take_sent`] keeps: more than there are in one character.
const DRIVER_KEPT: usize = 16;
