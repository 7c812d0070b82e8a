//! An RS-485 line: what the chip put on it, and what others do.

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
    /// How long each bit was.
    pub bit: Picos,
    /// Its parity bit, if there is one.
    pub parity: Option<bool>,
    /// How many there were.
    pub stop_bits: u8,
    /// The driver was on from its beginning to its end: otherwise nobody has heard it.
    pub is_driven: bool,
}

/// How another device sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format {
    /// Bit/s.
    pub baud: u32,
    /// `Some(true)` for odd.
    pub odd_parity: Option<bool>,
    /// 1 or 2.
    pub stop_bits: u8,
}

/// The line.
#[derive(Debug, Default)]
pub struct Line {
    /// What the chip has sent.
    pub sent: Vec<Sent>,
    /// Each change of driver-enable, as the transceiver sees it.
    pub driver: Vec<(Picos, bool)>,
    /// Others have a pair of wires for themselves: the receiver hears them while the chip sends.
    pub is_four_wire: bool,
    /// What others do: edges and the level behind them. At rest it is high.
    edges: VecDeque<(Picos, bool)>,
    /// It is low before the first edge that is kept.
    is_low: bool,
    /// Up to here the receiver has heard it.
    heard: Picos,
}

impl Line {
    /// Another device sends these bytes, one behind the other, from then on. Returns when it has ended.
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

    /// Levels of so long each, from then on; the line is at rest behind them.
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

    /// Whether the chip's driver was on at that time.
    pub fn is_driven(&self, at: Picos) -> bool {
        let behind = self.driver.partition_point(|(time, _)| *time <= at);
        // At the very edge it is on.
        let before = behind.checked_sub(1).map(|index| self.driver[index]);
        before.is_some_and(|(time, is_on)| is_on || time == at)
    }

    /// What the chip's receiver sees: nothing of its own transmission.
    pub(super) fn level(&self, at: Picos) -> bool {
        let last = self.edges.iter().take_while(|(time, _)| *time <= at).last();
        !self.is_four_wire && self.is_driven(at) || last.map_or(!self.is_low, |(_, level)| *level)
    }

    /// The next falling edge that is not heard yet.
    pub(super) fn start_bit(&self, now: Picos) -> Option<Picos> {
        let falls = self.edges.iter().find(|(time, level)| !level && *time >= self.heard);
        falls.map(|(time, _)| *time).filter(|time| *time <= now)
    }

    pub(super) fn next_edge(&self, now: Picos) -> Option<Picos> {
        self.edges.iter().map(|(time, _)| *time).find(|time| *time > now)
    }

    pub(super) fn heard(&mut self, until: Picos) {
        self.heard = until;
        while let Some(&(time, level)) = self.edges.front()
            && time < until
        {
            self.is_low = !level;
            self.edges.pop_front();
        }
    }
}
