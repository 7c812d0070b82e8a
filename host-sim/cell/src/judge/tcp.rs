//! A Modbus TCP server with orders and queries of its own, written from the specification: the header, one or more
//! units, and the errors that servers make.

use proto_core::time::{Duration, Instant};

use super::device::{Fate, Machine};
use super::rtu::{Place, answer};
use crate::device::Act;
use crate::device::{Served, Server};
use crate::{Rng, SlaveDone};

/// A unit behind the address of the server.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unit {
    pub id: u8,
    /// Replies of this unit are logged: orders go to it.
    pub is_logged: bool,
    pub places: &'static [Place],
}

/// The server.
#[derive(Debug)]
pub(super) struct Units {
    machine: Machine,
    units: &'static [Unit],
    /// Received bytes that form no request yet.
    came: Vec<u8>,
    is_open: bool,
    leaving: Vec<(Instant, Served)>,
    /// When the second part of a reply is sent; nothing may be sent between the two parts.
    not_before: Instant,
}

impl Units {
    pub(super) fn new(machine: Machine, units: &'static [Unit]) -> Self {
        let (came, leaving) = (Vec::new(), Vec::new());
        Self { machine, units, came, is_open: false, leaving, not_before: Instant::ZERO }
    }

    /// Executes a complete request.
    fn handle(&mut self, frame: &[u8], now: Instant) {
        let (id, pdu) = (frame[6], &frame[7..]);
        let Some(unit) = self.units.iter().find(|unit| unit.id == id) else {
            // Exception 0x0A, as from a gateway that has no path to the unit.
            return self.leave(frame, vec![pdu[0] | 0x80, 0x0A], false, now);
        };
        let reply = answer(&mut self.machine, unit.places, pdu);
        self.leave(frame, reply, unit.is_logged, now);
    }

    /// Sends a reply, depending on the mood. `is_logged`: the reply is logged.
    fn leave(&mut self, request: &[u8], pdu: Vec<u8>, is_logged: bool, now: Instant) {
        let fate = self.machine.fate();
        let at = (now + fate.delay).max(self.not_before);
        if fate.is_lost || fate.is_wrong {
            if is_logged {
                self.machine.lose_reply(true);
            }
            if fate.is_wrong {
                let wrong = wrong(request, &pdu, &mut self.machine.rng);
                self.leaving.extend(wrong.into_iter().map(|served| (at, served)));
            }
            return;
        }
        let reply = framed(&request[..4], request[6], &pdu);
        self.leave_whole(reply, is_logged, fate, at);
    }

    /// Sends a valid reply; one in eight is sent in two parts.
    fn leave_whole(&mut self, mut reply: Vec<u8>, is_logged: bool, fate: Fate, mut at: Instant) {
        let rng = &mut self.machine.rng;
        let mut in_time = fate.in_time;
        if self.leaving.is_empty() && rng.below(8) == 0 {
            let rest = reply.split_off(rng.between(1, reply.len() as u64 - 1) as usize);
            self.leaving.push((at, Served::Bytes(reply, None)));
            at += rng.up_to(LONGEST_GAP);
            (reply, self.not_before, in_time) = (rest, at, false);
        }
        // Modbus TCP has no echo.
        let act = is_logged.then(|| self.machine.replied(true, true, in_time));
        self.leaving.push((at, Served::Bytes(reply, act)));
    }
}

/// What the server sends instead of a valid reply.
fn wrong(request: &[u8], pdu: &[u8], rng: &mut Rng) -> Vec<Served> {
    let unit = request[6];
    let own = framed(&request[..4], unit, pdu);
    let garbled = |bytes| Served::Bytes(bytes, Some(Act::Garbled));
    let changed = |at: usize, by: u8| {
        let mut frame = own.clone();
        frame[at] ^= by;
        garbled(frame)
    };
    let cut = |len: usize| garbled(own[..len].to_vec());
    let newest = u16::from_be_bytes([request[0], request[1]]);
    match rng.below(14) {
        // The transaction id of an earlier request.
        0 | 1 => {
            let [high, low] = newest.wrapping_sub(rng.between(1, 6) as u16).to_be_bytes();
            vec![garbled(framed(&[high, low, 0, 0], unit, pdu))]
        }
        2 => vec![changed(0, 0x55)],
        // Another unit, another function, another protocol.
        3 => vec![changed(6, if rng.below(2) == 0 { 0xFE } else { 2 })],
        4 => vec![changed(7, 0x03)],
        5 => vec![changed(3, 1)],
        // A length that is too long, too short, or invalid.
        6 => vec![changed(5, 0x08)],
        7 => vec![changed(5, 0x01)],
        8 => vec![changed(4, 0x40)],
        // Data of another length, in a frame with a matching header.
        9 => {
            let mut longer = pdu.to_vec();
            longer.push(0);
            vec![garbled(framed(&request[..4], unit, &longer))]
        }
        10 => vec![Served::Close],
        11 => vec![Served::Reset],
        12 => vec![cut(rng.between(1, own.len() as u64 - 1) as usize), Served::Close],
        _ => vec![cut(rng.between(1, own.len() as u64 - 1) as usize), Served::HalfClose],
    }
}

/// A reply of a unit with its header. `begin`: transaction and protocol id.
fn framed(begin: &[u8], unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = begin.to_vec();
    frame.extend((pdu.len() as u16 + 1).to_be_bytes());
    frame.push(unit);
    frame.extend(pdu);
    frame
}

impl Server for Units {
    fn opened(&mut self, _: Instant) {
        self.is_open = true;
        self.came.clear();
    }

    fn closed(&mut self, _: Instant) {
        self.is_open = false;
        self.came.clear();
        self.leaving.retain(|(_, served)| matches!(served, Served::PowerOff | Served::PowerOn));
        self.not_before = Instant::ZERO;
    }

    fn receive(&mut self, now: Instant, bytes: &[u8]) {
        self.came.extend_from_slice(bytes);
        while self.is_open && self.machine.is_on() {
            let &[_, _, p1, p0, l1, l0, ..] = &self.came[..] else { return };
            let len = usize::from(u16::from_be_bytes([l1, l0]));
            if (p1, p0) != (0, 0) || !(3..=254).contains(&len) {
                // Nothing after it can be parsed.
                self.leaving.push((now, Served::Reset));
                self.came.clear();
                return;
            }
            if self.came.len() < 6 + len {
                return;
            }
            let frame: Vec<u8> = self.came.drain(..6 + len).collect();
            self.handle(&frame, now);
        }
    }

    fn deadline(&self) -> Instant {
        let leaves = self.leaving.iter().map(|(at, _)| *at).min();
        leaves.unwrap_or(Instant::NEVER).min(self.machine.deadline())
    }

    fn poll(&mut self, now: Instant) -> Vec<Served> {
        let was_on = self.machine.is_on();
        self.machine.poll(now);
        let mut served = Vec::new();
        match (was_on, self.machine.is_on()) {
            (true, false) => {
                self.leaving.clear();
                served.push(Served::PowerOff);
            }
            (false, true) => served.push(Served::PowerOn),
            _ => {}
        }
        while let Some(nth) = self.leaving.iter().position(|(at, _)| *at <= now) {
            served.push(self.leaving.remove(nth).1);
        }
        served
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        self.machine.take_done()
    }
}

/// The longest gap between the parts of a reply.
const LONGEST_GAP: Duration = Duration::from_millis(40);
