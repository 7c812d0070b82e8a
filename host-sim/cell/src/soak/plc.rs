//! A simulated PLC: the master of a Modbus RTU line on which the gateway is a slave.
//!
//! In: the blocks of a port's recipe and a seed. Out: requests at random times. Most address registers of the blocks;
//! some address other registers or slaves, are broadcasts, or are damaged.

use proto_core::config::{Bus, GatewayConfig, Port, Transaction};
use proto_core::modbus::rtu::Table;
use proto_core::time::{Duration, Instant};

use crate::rtu::sealed;
use crate::{Device, Rng};

/// The master.
#[derive(Debug)]
pub(super) struct Plc {
    rng: Rng,
    /// The address of the gateway as a slave.
    slave: u8,
    blocks: Vec<Block>,
    behaviour: Behaviour,
    behaviour_ends: Instant,
    next: Instant,
    silence: Duration,
}

#[derive(Debug)]
struct Block {
    table: Table,
    first: u16,
    count: u16,
    is_written: bool,
    /// The values that were written last.
    values: Vec<u16>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behaviour {
    Steady,
    /// The master does not wait for replies.
    Hasty,
    Silent,
    /// Some requests are wrong.
    Careless,
}

impl Plc {
    /// The master of a port; `None` if the gateway is not a slave there.
    pub(super) fn new(config: &GatewayConfig, port: &Port, start: Instant, rng: Rng) -> Option<Self> {
        let recipe = config.recipes.get(usize::from(port.recipe))?;
        let Bus::Rs485(line) = &port.bus else { return None };
        let exchanges = config.view().exchanges_of(recipe);
        let mut blocks = Vec::new();
        for exchange in exchanges {
            let Transaction::Served { operation, written, .. } = exchange.transaction else { return None };
            let (table, first, count) = operation.place();
            let values = vec![0; usize::from(count)];
            blocks.push(Block { table, first, count, is_written: written.len > 0, values });
        }
        let slave = exchanges.first()?.peer;
        let (behaviour, silence) = (Behaviour::Steady, line.idle_gap);
        let next = start + Duration::from_millis(100);
        Some(Self { rng, slave, blocks, behaviour, behaviour_ends: start, next, silence })
    }

    fn change_behaviour(&mut self, now: Instant) {
        let (behaviour, most) = match self.rng.below(16) {
            0..10 => (Behaviour::Steady, 20_000),
            10 => (Behaviour::Hasty, 500),
            11 => (Behaviour::Silent, 5_000),
            _ => (Behaviour::Careless, 4_000),
        };
        self.behaviour = behaviour;
        self.behaviour_ends = now + self.rng.up_to(Duration::from_millis(most));
    }

    /// A request for a block: slave address and PDU.
    fn request(&mut self) -> (u8, Vec<u8>) {
        let rng = &mut self.rng;
        let nth = rng.below(self.blocks.len() as u64) as usize;
        let is_careless = self.behaviour == Behaviour::Careless;
        let address = match rng.below(12) {
            0 if is_careless => 0,
            1 | 2 if is_careless => self.slave % 247 + 1,
            _ => self.slave,
        };
        if is_careless && rng.below(8) == 0 {
            let function = [7, 23, 43, 99, 3][rng.below(5) as usize];
            let more = rng.below(12) as usize;
            return (address, [vec![function], rng.bytes(more)].concat());
        }
        let block = &mut self.blocks[nth];
        let (mut first, mut count) = (block.first, block.count);
        if is_careless && rng.below(3) == 0 {
            first = first.wrapping_add(rng.below(3) as u16);
            count = 1 + rng.below(u64::from(count) + 2) as u16;
        }
        let is_coils = matches!(block.table, Table::Coils | Table::DiscreteInputs);
        if block.is_written && rng.below(4) > 0 {
            for value in &mut block.values {
                *value = match (is_coils, rng.below(8)) {
                    (true, 0..3) => 1 - *value,
                    (false, 0) => rng.below(65_536) as u16,
                    (false, 1..4) => rng.below(4) as u16,
                    _ => *value,
                };
            }
            let values = block.values.iter().copied().chain(std::iter::repeat(0)).take(count.into());
            return (address, write(is_coils, first, values.collect()));
        }
        if !block.is_written && rng.below(3) == 0 {
            // A part of the block, or more than the block.
            first += rng.below(count.into()) as u16;
            count = 1 + rng.below(u64::from(count) + 1) as u16;
        }
        let function = match block.table {
            Table::Coils => 1,
            Table::DiscreteInputs => 2,
            Table::HoldingRegisters => 3,
            Table::InputRegisters => 4,
        };
        (address, pdu(function, first, count))
    }
}

impl Device<Vec<u8>> for Plc {
    fn deadline(&self) -> Instant {
        self.next
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        if now >= self.behaviour_ends {
            self.change_behaviour(now);
        }
        if self.behaviour == Behaviour::Silent {
            self.next = self.behaviour_ends.max(now + Duration::from_micros(1));
            return Vec::new();
        }
        let (address, pdu) = self.request();
        let mut frame = sealed(&[&[address], &pdu[..]].concat());
        let silence = self.silence.as_micros();
        let rng = &mut self.rng;
        let pause = match self.behaviour {
            Behaviour::Hasty => rng.between(1_000, silence + 10_000),
            // Time for the end of the request and for the longest reply.
            _ => silence * 2 + rng.between(40_000, 150_000),
        };
        if self.behaviour == Behaviour::Careless {
            let len = frame.len() as u64;
            match rng.below(10) {
                0 => frame[rng.below(len) as usize] ^= 1 << rng.below(8),
                1 => frame.truncate(rng.between(1, len) as usize),
                // Two requests without silence between them: the newest counts.
                2 => frame = [&frame[..], &frame].concat(),
                3 => frame = [sealed(&[self.slave % 247 + 1, 6, 0, 1, 0, 2]), frame].concat(),
                4 => frame = [&[0, 0][..], &frame].concat(),
                _ => {}
            }
        }
        // A line can produce such a byte while its direction changes.
        let false_byte = |rng: &mut Rng| match rng.below(8) {
            0 => vec![0],
            1 => vec![0xFF],
            _ => vec![],
        };
        let frame = [false_byte(rng), frame, false_byte(rng)].concat();
        self.next = now + Duration::from_micros(pause);
        vec![frame]
    }
}

fn pdu(function: u8, first: u16, number: u16) -> Vec<u8> {
    [&[function][..], &first.to_be_bytes(), &number.to_be_bytes()].concat()
}

/// Writes these registers or coils, with the shortest function code.
fn write(is_coils: bool, first: u16, values: Vec<u16>) -> Vec<u8> {
    match (is_coils, &values[..]) {
        (true, &[coil]) => pdu(5, first, if coil != 0 { 0xFF00 } else { 0 }),
        (false, &[word]) => pdu(6, first, word),
        (true, _) => {
            let byte = |bits: &[u16]| bits.iter().rev().fold(0, |byte, bit| byte << 1 | u8::from(*bit != 0));
            let packed: Vec<u8> = values.chunks(8).map(byte).collect();
            [pdu(15, first, values.len() as u16), vec![packed.len() as u8], packed].concat()
        }
        (false, _) => {
            let words = values.iter().flat_map(|word| word.to_be_bytes()).collect::<Vec<u8>>();
            [pdu(16, first, values.len() as u16), vec![words.len() as u8], words].concat()
        }
    }
}
