//! The gripper of `judged-gripper.toml`.

use proto_core::time::{Duration, Instant};

use super::device::Machine;
use super::rtu::{Place, Slave, What};
use super::rules;
use super::rules::{Rules, Source, word};
use crate::Rng;
use crate::device::Order;

pub(super) fn rules() -> Rules {
    let moves = vec![word("WordOutputReg[1]"), word("WordOutputReg[2]"), Source::Constant(1)];
    let values = ["WordInputReg[1]", "WordInputReg[2]", "WordInputReg[3]"];
    rules::Rules::new(moves, &values, TIMEOUT).limit("WordOutputReg[1]", 1_000)
}

pub(super) fn device(rng: Rng, start: Instant) -> Slave {
    Slave::new(Machine::new(rng, start, TIMEOUT, false), 9, &PLACES)
}

const TIMEOUT: Duration = Duration::from_millis(60);
const PLACES: [Place; 6] = [
    Place { function: 16, address: 0x0110, count: 3, is: What::Order(Order::Move) },
    Place { function: 6, address: 0x0100, count: 1, is: What::Order(Order::Stop) },
    Place { function: 6, address: 0x0120, count: 1, is: What::Order(Order::Keep) },
    Place { function: 4, address: 0x10, count: 1, is: What::Value(0) },
    Place { function: 4, address: 0x20, count: 1, is: What::Value(1) },
    Place { function: 4, address: 0x30, count: 1, is: What::Value(2) },
];
