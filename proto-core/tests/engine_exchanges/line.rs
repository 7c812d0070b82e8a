//! A line in virtual time, with devices that answer as a test says.
#![allow(unreachable_pub, reason = "a module of a test binary")]

use proto_core::config::*;
use proto_core::device::{ByteOrder, Encoding, Overflow};
use proto_core::engine::PortId;
use proto_core::modbus::rtu::Operation;
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType as T;

use crate::rig::*;

pub fn to(name: &str) -> InputBinding {
    InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 }
}

pub fn from(name: &str) -> OutputBinding {
    OutputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 }
}

fn word() -> Encoding {
    Encoding { order: ByteOrder::Big, ..Encoding::scalar(T::Word) }
}

/// A register of a slave that becomes a variable, or a variable that becomes one.
pub fn register_to(name: &str) -> FieldSpec {
    FieldSpec::DeviceInput { encoding: word(), overflow: Overflow::Usual, to: to(name) }
}

pub fn register_from(name: &str) -> FieldSpec {
    FieldSpec::DeviceOutput { encoding: word(), overflow: Overflow::Usual, from: from(name) }
}

pub fn byte() -> Encoding {
    Encoding::scalar(T::Byte)
}

pub fn fixed(value: i64) -> FieldSpec {
    FieldSpec::Fixed { encoding: byte(), value }
}

pub fn byte_to(name: &str) -> FieldSpec {
    FieldSpec::DeviceInput { encoding: byte(), overflow: Overflow::Usual, to: to(name) }
}

/// Adds a frame of an exchange and returns its index.
pub fn frame_of(
    cell: &mut Cell,
    id: Option<u16>,
    head: &[u8],
    tail: &[u8],
    fields: Vec<FieldSpec>,
) -> Option<u8> {
    let fields = cell.fields(fields);
    let bytes = |bytes| Delimiter::from_slice(bytes).unwrap();
    let index = cell.0.frames.len() as u8;
    let (id, head, tail) = (id.map(CanId::Standard), bytes(head), bytes(tail));
    cell.0.frames.push(FrameSpec { id, remote: false, head, tail, fields }).unwrap();
    Some(index)
}

/// A port with these exchanges and without parts.
pub fn talking(cell: &mut Cell, exchanges: &[Exchange]) -> PortId {
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output: None });
    let start = cell.0.exchanges.len() as u16;
    cell.0.exchanges.extend(exchanges.iter().copied());
    cell.last_recipe().exchanges = Span { start, len: exchanges.len() as u16 };
    cell.rs485(recipe)
}

/// Reads holding registers from 0x10 on into these variables.
pub fn reads(cell: &mut Cell, slave: u8, names: &[&str], when: Triggers) -> Exchange {
    let read = cell.fields(names.iter().map(|name| register_to(name)));
    let operation = Operation::ReadHoldingRegisters { address: 0x10, count: names.len() as u16 };
    never_late(Exchange::new(slave, Transaction::Rtu { operation, written: Span::default(), read }, when))
}

/// No reply comes behind the timeout: nothing is waited for at the start, or behind a request without a reply.
pub fn never_late(exchange: Exchange) -> Exchange {
    Exchange { late: Some(Duration::ZERO), ..exchange }
}

/// Writes these variables to the registers from 0x20 on.
pub fn writes(cell: &mut Cell, slave: u8, names: &[&str], when: Triggers) -> Exchange {
    let written = cell.fields(names.iter().map(|name| register_from(name)));
    let operation = Operation::WriteRegisters { address: 0x20, count: names.len() as u16 };
    never_late(Exchange::new(slave, Transaction::Rtu { operation, written, read: Span::default() }, when))
}

/// The reply of a slave whose registers hold these words.
pub fn registers(slave: u8, words: &[u16]) -> Vec<u8> {
    let mut reply = vec![slave, 3, words.len() as u8 * 2];
    reply.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    with_crc(&reply)
}

/// A cell with one line, and the replies that are on their way to it.
pub struct Line {
    pub rig: Rig,
    pub port: PortId,
    coming: Vec<(Instant, Vec<u8>)>,
}

impl Line {
    pub fn new(cell: &Cell, port: PortId) -> Self {
        Self { rig: cell.rig(), port, coming: Vec::new() }
    }

    /// Something comes by itself, so much later.
    pub fn comes(&mut self, delay: Duration, bytes: &[u8]) {
        self.coming.push((self.rig.now + delay, bytes.to_vec()));
    }

    /// Runs for a time. `answer` says what comes after a request, and how much later. Returns the
    /// requests and when they were sent.
    pub fn run(
        &mut self,
        span: Duration,
        mut answer: impl FnMut(&[u8]) -> Option<(Duration, Vec<u8>)>,
    ) -> Vec<(Instant, Vec<u8>)> {
        let Self { rig, port, coming } = self;
        let end = rig.now + span;
        let mut requests = Vec::new();
        loop {
            for request in rig.sent_to(*port) {
                if let Some((delay, reply)) = answer(&request) {
                    coming.push((rig.now + delay, reply));
                }
                requests.push((rig.now, request));
            }
            coming.sort_by_key(|(at, _)| *at);
            let next = coming.first().map_or(Instant::NEVER, |(at, _)| *at);
            if next.min(rig.wake) > end {
                rig.now = end;
                return requests;
            }
            if next <= rig.wake {
                rig.now = next.max(rig.now);
                let (_, reply) = coming.remove(0);
                rig.bytes(*port, &reply);
            } else {
                rig.now = rig.wake.max(rig.now);
                rig.input(proto_core::engine::Input::Tick);
            }
        }
    }
}
