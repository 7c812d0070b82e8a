//! A slave on a Modbus RTU line with orders and queries of its own, written from the specification.

use proto_core::time::{Duration, Instant};

use super::device::{Answer, Machine};
use crate::device::Order;
use crate::rtu::{is_right, sealed};
use crate::{Device, SlaveDone};

/// An order or a query that a slave supports.
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
        let pdu = &frame[1..frame.len() - 2];
        let answer = answer(&mut self.machine, self.places, pdu);
        let reply = sealed(&[&[frame[0]], &answer[..]].concat());
        let tells = reply != frame;
        self.machine.reply(reply, tells, now);
    }
}

/// Executes a request to a device with these places, and returns the reply.
pub(super) fn answer(machine: &mut Machine, places: &[Place], pdu: &[u8]) -> Vec<u8> {
    execute(machine, places, pdu).unwrap_or_else(|code| vec![pdu[0] | 0x80, code])
}

fn execute(machine: &mut Machine, places: &[Place], pdu: &[u8]) -> Result<Vec<u8>, u8> {
    let word = |at: usize| pdu.get(at..at + 2).map(|two| u16::from_be_bytes([two[0], two[1]]));
    let (function, Some(address), Some(second)) = (pdu[0], word(1), word(3)) else { return Err(3) };
    let count = if matches!(function, 5 | 6) { 1 } else { second };
    let is_whole = match function {
        15 | 16 => pdu.len() == 6 + usize::from(*pdu.get(5).unwrap_or(&0)),
        _ => pdu.len() == 5,
    };
    if !is_whole {
        return Err(3);
    }
    let is_it = |place: &&Place| (place.function, place.address, place.count) == (function, address, count);
    match places.iter().find(is_it).ok_or(2)?.is {
        What::Value(nth) => {
            let [high, low] = machine.value(nth).to_be_bytes();
            Ok(vec![function, 2, high, low])
        }
        What::Order(order) => {
            let values = match function {
                5 => vec![u32::from(second == 0xFF00)],
                6 => vec![u32::from(second)],
                _ => (0..usize::from(count)).filter_map(|nth| word(6 + 2 * nth)).map(u32::from).collect(),
            };
            match machine.order(order, values, true) {
                Answer::Good => Ok(pdu[..5].to_vec()),
                Answer::Refused(code) => Err(code),
            }
        }
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

/// Bytes that are further apart belong to different frames.
const SILENCE: Duration = Duration::from_millis(5);
