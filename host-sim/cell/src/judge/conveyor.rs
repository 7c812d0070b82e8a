//! The conveyor of `judged-modbus-tcp.toml`, and the rack of inputs behind the same address.

use proto_core::time::{Duration, Instant};

use super::Order;
use super::device::Machine;
use super::rtu::{Place, What};
use super::rules::{Rules, Source, word};
use super::tcp::{Unit, Units};
use crate::Rng;

pub(super) fn rules() -> Rules {
    // The target is two registers, and the robot's one is below 65536.
    let moves = vec![Source::Constant(0), word("WordOutputReg[1]"), word("WordOutputReg[2]")];
    let values = ["WordInputReg[1]", "WordInputReg[2]", "WordInputReg[3]"];
    let trigger = Duration::from_millis(400);
    let mut rules = Rules::new(moves, &values, TIMEOUT).limit("WordOutputReg[1]", 50_000);
    rules.moves.1 = trigger;
    rules.step = Some((vec![word("WordOutputReg[4]")], trigger));
    rules.transport = Duration::from_secs(2);
    rules
}

pub(super) fn device(rng: Rng, start: Instant) -> Units {
    Units::new(Machine::new(rng, start, TIMEOUT, false), &UNITS)
}

const TIMEOUT: Duration = Duration::from_millis(80);
const UNITS: [Unit; 2] =
    [Unit { id: 1, is_told: true, places: &CONVEYOR }, Unit { id: 255, is_told: false, places: &RACK }];
const CONVEYOR: [Place; 7] = [
    Place { function: 6, address: 0x0200, count: 1, is: What::Order(Order::Start) },
    Place { function: 5, address: 0x0001, count: 1, is: What::Order(Order::Stop) },
    Place { function: 16, address: 0x0210, count: 3, is: What::Order(Order::Move) },
    Place { function: 6, address: 0x0220, count: 1, is: What::Order(Order::Step) },
    Place { function: 6, address: 0x0230, count: 1, is: What::Order(Order::Keep) },
    Place { function: 3, address: 0x10, count: 1, is: What::Value(0) },
    Place { function: 3, address: 0x20, count: 1, is: What::Value(1) },
];
const RACK: [Place; 1] = [Place { function: 4, address: 0x10, count: 1, is: What::Value(2) }];
