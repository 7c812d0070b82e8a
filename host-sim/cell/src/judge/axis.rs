//! The axis of `judged-axis.toml`.

use proto_core::time::{Duration, Instant};

use super::device::Machine;
use super::rtu::{Place, Slave, What};
use super::rules::{Rules, Source, word};
use crate::Rng;
use crate::device::Order;

pub(super) fn rules() -> Rules {
    // The target has two registers. The robot's value is one word, below 65536, so the high register is 0.
    let moves = vec![Source::Constant(0), word("WordOutputReg[1]"), word("WordOutputReg[2]")];
    let trigger = Duration::from_millis(400);
    let mut rules =
        Rules::new(moves, &["WordInputReg[1]", "WordInputReg[2]"], TIMEOUT).limit("WordOutputReg[1]", 50_000);
    rules.moves.1 = trigger;
    rules.step = Some((vec![word("WordOutputReg[4]")], trigger));
    rules
}

pub(super) fn device(rng: Rng, start: Instant) -> Slave {
    Slave::new(Machine::new(rng, start, TIMEOUT, false), 5, &PLACES)
}

pub(super) const TIMEOUT: Duration = Duration::from_millis(80);
pub(super) const PLACES: [Place; 7] = [
    Place { function: 6, address: 0x0200, count: 1, is: What::Order(Order::Start) },
    Place { function: 5, address: 0x0001, count: 1, is: What::Order(Order::Stop) },
    Place { function: 16, address: 0x0210, count: 3, is: What::Order(Order::Move) },
    Place { function: 6, address: 0x0220, count: 1, is: What::Order(Order::Step) },
    Place { function: 6, address: 0x0230, count: 1, is: What::Order(Order::Keep) },
    Place { function: 3, address: 0x10, count: 1, is: What::Value(0) },
    Place { function: 3, address: 0x20, count: 1, is: What::Value(1) },
];
