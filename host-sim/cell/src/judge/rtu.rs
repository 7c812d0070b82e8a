//! A slave of a Modbus RTU line with orders and questions of its own, written from the specification.

use proto_core::time::{Duration, Instant};

use super::Order;
use super::device::{Answer, Machine};
use crate::rtu::{is_right, sealed};
use crate::{Device, SlaveDone};

/// What a slave can be asked.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub function: u8,
    pub address: u16,
    pub count: u16,
    pub is: What,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum What {
    Order(Order),
    Value(usize),
}

/// The slave.
#[derive(Debug)]
pub(super) struct Slave {
    pub machine: Machine,
    address: u8,
    places: &'static [Place],
    held: Vec<u8>,
    newest: Instant,
}

impl Slave {
    pub(super) fn new(machine: Machine, address: u8, places: &'static [Place]) -> Self {
        Self { machine, address, places, held: Vec::new(), newest: Instant::ZERO }
    }

    fn handle(&mut self, frame: &[u8], now: Instant) {
        let word = |at: usize| u16::from_be_bytes([frame[at], frame[at + 1]]);
        let (function, address) = (frame[1], word(2));
        let count = if matches!(function, 5 | 6) { 1 } else { word(4) };
        let place = self
            .places
            .iter()
            .find(|place| (place.function, place.address, place.count) == (function, address, count));
        let refusal = |code: u8| sealed(&[frame[0], function | 0x80, code]);
        let reply = match place.map(|place| place.is) {
            None => refusal(2),
            Some(What::Value(nth)) => {
                let [high, low] = self.machine.value(nth).to_be_bytes();
                sealed(&[frame[0], function, 2, high, low])
            }
            Some(What::Order(order)) => {
                let values = match function {
                    5 => vec![u32::from(frame[4] == 0xFF)],
                    6 => vec![u32::from(word(4))],
                    _ => (0..usize::from(count)).map(|nth| u32::from(word(7 + 2 * nth))).collect(),
                };
                match self.machine.order(order, values, true) {
                    Answer::Good => sealed(&frame[..6]),
                    Answer::Refused(code) => refusal(code),
                }
            }
        };
        let tells = reply != frame;
        self.machine.reply(reply, tells, now);
    }
}

impl Device<Vec<u8>> for Slave {
    fn receive(&mut self, now: Instant, bytes: &Vec<u8>) -> Vec<Vec<u8>> {
        if now.saturating_since(self.newest) > SILENCE {
            self.held.clear();
        }
        self.newest = now;
        self.held.extend_from_slice(bytes);
        let len = match self.held[..] {
            [_, 15 | 16, _, _, _, _, count, ..] => 9 + usize::from(count),
            [_, 15 | 16, ..] => usize::MAX,
            _ => 8,
        };
        if self.held.len() < len {
            return Vec::new();
        }
        let frame: Vec<u8> = std::mem::take(&mut self.held);
        if frame.len() == len && frame[0] == self.address && is_right(&frame) && self.machine.is_on() {
            self.handle(&frame, now);
        }
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        self.machine.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        self.machine.poll(now).0
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        self.machine.take_done()
    }
}

/// Bytes that are further apart are of two frames.
const SILENCE: Duration = Duration::from_millis(5);
