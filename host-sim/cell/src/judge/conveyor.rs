//! The conveyor of `judged-modbus-tcp.toml`, with the same orders as the axis, and the rack of inputs behind the same
//! address.

use proto_core::time::{Duration, Instant};

use super::axis::{self, PLACES, TIMEOUT};
use super::device::Machine;
use super::rtu::{Place, What};
use super::rules::{Rules, var};
use super::tcp::{Unit, Units};
use crate::Rng;

pub(super) fn rules() -> Rules {
    let mut rules = axis::rules();
    rules.values.push(var("WordInputReg[3]"));
    rules.transport = Duration::from_secs(2);
    rules
}

pub(super) fn device(rng: Rng, start: Instant) -> Units {
    Units::new(Machine::new(rng, start, TIMEOUT, false), &UNITS)
}

const UNITS: [Unit; 2] =
    [Unit { id: 1, is_logged: true, places: &PLACES }, Unit { id: 255, is_logged: false, places: &RACK }];
const RACK: [Place; 1] = [Place { function: 4, address: 0x10, count: 1, is: What::Value(2) }];
