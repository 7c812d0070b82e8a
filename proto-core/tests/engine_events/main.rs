//! What reaches a device is fresh or not sent at all, and what comes from it is what was asked (docs/engine.md
//! section 13).

mod answers;
mod dialogues;
mod echo;
mod events;
mod late;
#[path = "../engine_exchanges/line.rs"]
#[allow(dead_code, reason = "each test binary uses its own part")]
mod line;
mod masked;
mod restarted;
#[path = "../rig/mod.rs"]
mod rig;
mod start;
mod stops;

use proto_core::config::*;
use proto_core::device::{ByteOrder, Encoding, Overflow};
use proto_core::engine::{EventCounters, PeerStatus, PortId};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::ModbusPlace;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType as T;

use line::*;
use rig::*;

/// Bit 0 of this byte starts, bit 1 stops.
const BITS: &str = "BitOutputReg[3]";

fn rising(bit: u8) -> Triggers {
    Triggers { rising: Some((var(BITS), bit)), ..Triggers::NEVER }
}

fn register_of(name: &str) -> usize {
    let Some(ModbusPlace::Register { address }) = var(name).modbus() else { panic!() };
    address.into()
}

fn word() -> Encoding {
    Encoding { order: ByteOrder::Big, ..Encoding::scalar(T::Word) }
}

/// Writes one register, such as a target, from a variable that may be up to 50 000, or with a constant.
fn sets(
    cell: &mut Cell,
    slave: u8,
    address: u16,
    from_var: Option<&str>,
    value: f64,
    when: Triggers,
) -> Exchange {
    let source = from_var.map_or(OutputBinding::Constant(value), from);
    let field = FieldSpec::DeviceOutput { encoding: word(), overflow: Overflow::Usual, from: source };
    let limits = Limits { low: 0.0, high: 50_000.0, outside: Outside::Refuse };
    let written = match from_var {
        Some(_) => cell.fields([field, FieldSpec::Limits(limits)]),
        None => cell.fields([field]),
    };
    let operation = Operation::WriteRegisters { address, count: 1 };
    never_late(Exchange::new(slave, Transaction::Rtu { operation, written, read: Span::default() }, when))
}

/// Reads one register at an address.
fn reads_at(cell: &mut Cell, slave: u8, address: u16, name: &str, every: Duration) -> Exchange {
    let mut exchange = reads(cell, slave, &[name], Triggers::every(every));
    let Transaction::Rtu { operation, .. } = &mut exchange.transaction else { panic!() };
    *operation = Operation::ReadHoldingRegisters { address, count: 1 };
    exchange
}

impl Line {
    fn bit(&mut self, bit: u8, on: bool) {
        let Some(ModbusPlace::Coils { first, .. }) = var(BITS).modbus() else { panic!() };
        self.rig.map.coils[usize::from(first) + usize::from(bit)] = on;
    }

    fn word(&mut self, name: &str, value: u16) {
        self.rig.map.registers[register_of(name)] = value;
    }

    fn shown(&self, name: &str) -> u16 {
        self.rig.map.registers[register_of(name)]
    }

    fn peer(&self, number: u8) -> PeerStatus {
        let status = self.rig.engine.status(self.rig.now);
        let port = status.ports().next().unwrap();
        port.peers().find(|peer| peer.number == number).unwrap()
    }

    fn events(&self, number: u8) -> EventCounters {
        self.peer(number).counters.events
    }
}

/// What a slave has done: when, where it wrote, and what.
type Done = Vec<(Instant, u16, u16)>;

/// The good answer of a slave with these registers; writes are carried out.
fn answer(request: &[u8], read: impl Fn(u16) -> u16) -> Vec<u8> {
    let address = u16::from_be_bytes([request[2], request[3]]);
    match request[1] {
        3 => {
            let count = u16::from_be_bytes([request[4], request[5]]);
            registers(request[0], &(address..address + count).map(read).collect::<Vec<_>>())
        }
        6 => request.to_vec(),
        _ => with_crc(&request[..6]),
    }
}

fn exception(request: &[u8], code: u8) -> Vec<u8> {
    with_crc(&[request[0], request[1] | 0x80, code])
}

/// The write in a request: where, and the first word.
fn write_in(request: &[u8]) -> Option<(u16, u16)> {
    let address = u16::from_be_bytes([request[2], request[3]]);
    match request[1] {
        6 => Some((address, u16::from_be_bytes([request[4], request[5]]))),
        16 => Some((address, u16::from_be_bytes([request[7], request[8]]))),
        _ => None,
    }
}

/// An axis: its position is read each 50 ms; bit 0 starts it to the target in a register.
struct Axis {
    line: Line,
    done: Done,
}

const TARGET: u16 = 0x58;

impl Axis {
    /// `change` changes the start, and adds exchanges behind it.
    fn new(change: impl FnOnce(&mut Cell, &mut Exchange) -> Vec<Exchange>) -> Self {
        let mut cell = Cell::new();
        let poll = reads_at(&mut cell, 3, 0x10, "WordInputReg[1]", MS(50));
        let mut start = sets(&mut cell, 3, TARGET, Some("WordOutputReg[1]"), 0.0, rising(0));
        start.outcome = OutcomeTo {
            to: Some(var("WordInputReg[5]")),
            code_to: Some(var("WordInputReg[6]")),
            count_to: Some(var("WordInputReg[7]")),
        };
        let others = change(&mut cell, &mut start);
        let port = talking(&mut cell, &[vec![poll, start], others].concat());
        cell.last_port().timeout = MS(300);
        let mut line = Line::new(&cell, port);
        line.word("WordOutputReg[1]", 1_000);
        let mut axis = Self { line, done: Vec::new() };
        axis.run(500, |request| Some(answer(request, |_| 7)));
        assert_eq!(axis.taken(), []);
        axis
    }

    /// Runs with a device that answers after 2 ms, or not at all.
    fn run(&mut self, millis: u64, mut says: impl FnMut(&[u8]) -> Option<Vec<u8>>) {
        let asked = self.line.run(MS(millis), |request| Some((MS(2), says(request)?)));
        self.note(asked);
    }

    fn note(&mut self, asked: Vec<(Instant, Vec<u8>)>) {
        let writes = asked.iter().filter_map(|(at, request)| Some((*at, write_in(request)?)));
        self.done.extend(writes.map(|(at, (address, value))| (at, address, value)));
    }

    /// The targets to which it was started since this was asked last.
    fn taken(&mut self) -> Vec<u16> {
        self.done.drain(..).filter(|(_, address, _)| *address == TARGET).map(|(.., value)| value).collect()
    }

    /// The robot's bit is 1 for 100 ms.
    fn pulse(&mut self, mut says: impl FnMut(&[u8]) -> Option<Vec<u8>>) {
        self.line.bit(0, true);
        self.run(100, &mut says);
        self.line.bit(0, false);
        self.run(100, &mut says);
    }

    /// Outcome, code and count as the robot's registers have them.
    fn told(&self) -> [u16; 3] {
        ["WordInputReg[5]", "WordInputReg[6]", "WordInputReg[7]"].map(|name| self.line.shown(name))
    }
}

fn good(request: &[u8]) -> Option<Vec<u8>> {
    Some(answer(request, |_| 7))
}
