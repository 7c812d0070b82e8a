//! Devices and gateways that break what is promised of exchanges: the model reports it.

use std::collections::VecDeque;

use proto_core::engine::{Input, LinkId, Output, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::super::tests::{cell, is_rest};
use super::super::upward::Carried;
use super::super::{Invariant, Oracle, copied_inputs};
use crate::corruption::{Forged, Outward};
use crate::due::Due;
use crate::rtu::sealed;
use crate::{Cell, Device, Done, PeriodicSender, SlaveDone, Violation};
use recipe_config::InitialTarget;
use recipe_controller::ControllerInput;

/// A slave that is read at two places, whose replies look alike, and told two values together.
const SLAVE: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "line"
kind = "modbus-rtu"
on_stale = "stop"

[[recipe.exchange]]
slave = 2
function = "read-input-registers"
address = 0x10
every_ms = 100
timeout_ms = 40
retries = 0
read = [{ name = "one", type = "word", to = "WordInputReg[1]" }]

[[recipe.exchange]]
slave = 2
function = "read-input-registers"
address = 0x20
every_ms = 100
timeout_ms = 40
retries = 0
read = [{ name = "other", type = "word", to = "WordInputReg[2]" }]

[[recipe.exchange]]
slave = 2
function = "write-registers"
address = 0x30
every_ms = 100
timeout_ms = 40
retries = 0
write = [
    { name = "left", type = "word", from = "WordOutputReg[1]" },
    { name = "right", type = "word", from = "WordOutputReg[2]" },
]

[[port]]
name = "device"
bus = "modbus-rtu"
recipe = "line"
timeout_ms = 1000
stale_after_ms = 300
"#;

/// A device with frames of its own: a reset at the start, then a question and an order.
const PEER: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "line"
kind = "stream"
mode = "user"
on_stale = "stop"

[[recipe.exchange]]
peer = 1
on = ["start"]
timeout_ms = 40
request = { head = [1], checksum = { kind = "crc16-modbus" }, fields = [{ type = "byte", name = "do", value = 1 }] }
reply = { head = [1], checksum = { kind = "crc16-modbus" }, fields = [{ type = "byte", equals = 1 }] }

[[recipe.exchange]]
peer = 1
every_ms = 100
timeout_ms = 40
request = { head = [1], checksum = { kind = "crc16-modbus" }, fields = [{ type = "byte", name = "do", value = 2 }] }
[recipe.exchange.reply]
head = [1]
checksum = { kind = "crc16-modbus" }
fields = [{ type = "byte", equals = 2 }, { name = "value", type = "word", to = "WordInputReg[1]" }]

[[recipe.exchange]]
peer = 1
every_ms = 100
timeout_ms = 40
reply = { head = [1], checksum = { kind = "crc16-modbus" }, fields = [{ type = "byte", equals = 3 }] }
[recipe.exchange.request]
head = [1]
checksum = { kind = "crc16-modbus" }
fields = [{ name = "do", type = "byte", value = 3 }, { name = "speed", type = "word", from = "WordOutputReg[1]" }]

[[port]]
name = "device"
bus = "rs485"
recipe = "line"
timeout_ms = 1000
stale_after_ms = 300
"#;

/// The gateway is a slave, and shows one register.
const SERVED: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "plc"
kind = "modbus-rtu-slave"
address = 5

[[recipe.block]]
table = "input-registers"
address = 0
fields = [{ name = "parts", type = "word", from = "WordOutputReg[1]" }]

[[recipe.block]]
table = "holding-registers"
address = 9
fields = [{ name = "speed", type = "word", to = "WordInputReg[1]" }]

[[port]]
name = "device"
bus = "modbus-rtu-slave"
recipe = "plc"
"#;

const PORT: PortId = PortId(0);
const MS: fn(u64) -> Duration = Duration::from_millis;

/// The device of one of these lines. It answers at once, and reports what it does; `bend` changes the
/// delay and the report.
struct Honest<F> {
    bend: F,
    asked: u16,
    leaving: VecDeque<(Instant, Vec<u8>)>,
    done: Vec<SlaveDone>,
}

impl<F: FnMut(Instant, &mut Duration, &mut Vec<Done>)> Honest<F> {
    const fn new(bend: F) -> Self {
        Self { bend, asked: 0, leaving: VecDeque::new(), done: Vec::new() }
    }

    /// Its reply to a whole request, and what it reports.
    fn answer(&mut self, request: &[u8]) -> (Vec<u8>, Vec<Done>) {
        self.asked += 1;
        let [high, low] = self.asked.to_be_bytes();
        let word = |at: usize| u16::from_be_bytes([request[at], request[at + 1]]);
        match request[..2] {
            [2, 4] => {
                let reply = sealed(&[2, 4, 2, high, low]);
                let done = Done::Answered { address: word(2), count: 1, reply: reply.clone() };
                (reply, vec![done])
            }
            [2, 16] => {
                let reply = sealed(&request[..6]);
                let values = vec![word(7), word(9)];
                let wrote = Done::Wrote { coils: false, address: 0x30, values };
                (reply.clone(), vec![wrote, Done::Answered { address: 0x30, count: 2, reply }])
            }
            [1, what] => {
                let exchange = usize::from(what) - 1;
                let reply = if what == 2 { sealed(&[1, 2, low, high]) } else { sealed(&[1, what]) };
                let took = Done::Took { exchange, request: request.to_vec() };
                (reply.clone(), vec![took, Done::Replied { exchange, frame: reply }])
            }
            _ => panic!("asked {request:02x?}"),
        }
    }
}

impl<F: FnMut(Instant, &mut Duration, &mut Vec<Done>)> Device<Vec<u8>> for Honest<F> {
    fn receive(&mut self, now: Instant, request: &Vec<u8>) -> Vec<Vec<u8>> {
        let (reply, mut done) = self.answer(request);
        let mut delay = MS(2);
        (self.bend)(now, &mut delay, &mut done);
        let slave = request[0];
        self.done.extend(done.into_iter().map(|what| SlaveDone { slave, what }));
        self.leaving.push_back((now + delay, reply));
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        self.leaving.front().map_or(Instant::NEVER, |(at, _)| *at)
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        self.leaving.pop_front_if(|(at, _)| *at <= now).map(|(_, reply)| reply).into_iter().collect()
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        std::mem::take(&mut self.done)
    }
}

/// Five seconds with this device; values of the controller change meanwhile.
fn run(
    toml: &str,
    outward: Option<Outward>,
    bend: impl FnMut(Instant, &mut Duration, &mut Vec<Done>) + 'static,
) -> Cell {
    let mut cell = cell(toml);
    cell.corrupt(None, outward);
    let line = cell.line_of("device");
    cell.attach(line, Honest::new(bend));
    for nth in 1..=10 {
        cell.set_value("WordOutputReg[1]", f64::from(nth));
        cell.set_value("WordOutputReg[2]", f64::from(nth));
        cell.run_ms(500);
    }
    cell
}

#[track_caller]
fn caught(toml: &str, bend: impl FnMut(Instant, &mut Duration, &mut Vec<Done>) + 'static) -> Violation {
    match run(toml, None, bend).violation() {
        Some(violation) => violation.clone(),
        None => panic!("nothing was noticed"),
    }
}

#[track_caller]
fn caught_out(
    toml: &str,
    outward: impl FnMut(Instant, &Input<'_>, &Output<'_>) -> Option<Vec<Forged>> + 'static,
) -> Invariant {
    match run(toml, Some(Box::new(outward)), |_, _, _| ()).violation() {
        Some(violation) => violation.invariant,
        None => panic!("nothing was noticed"),
    }
}

/// A second and more after the start, when nothing is left of what was asked before.
fn is_late(now: Instant) -> bool {
    now.as_micros() % 1_000_000_000 > 1_000_000
}

#[test]
fn honest_devices_are_not_accused() {
    for toml in [SLAVE, PEER] {
        let cell = run(toml, None, |_, _, _| ());
        assert_eq!(cell.violation(), None);
        let looked_at = |invariant| cell.checks()[&invariant];
        assert!(looked_at(Invariant::Held) > 40 && looked_at(Invariant::Carried) > 20);
    }
}

#[test]
fn a_slave_that_answers_late_is_understood_within_its_late_time_only() {
    for millis in [42, 122, 900] {
        let cell = run(SLAVE, None, move |now, delay, _| {
            if is_late(now) {
                *delay = MS(millis);
            }
        });
        assert_eq!(cell.violation(), None, "{millis} ms");
    }
    // The reply to the first question comes when the second has been asked.
    let violation = caught(SLAVE, |now, delay, _| {
        if is_late(now) {
            *delay = MS(1_010);
        }
    });
    assert_eq!(violation.invariant, Invariant::Held, "{violation}");
}

#[test]
fn a_reply_that_the_device_did_not_make() {
    for toml in [SLAVE, PEER] {
        let violation = caught(toml, |now, _, done| {
            if is_late(now) {
                done.retain(|done| !matches!(done, Done::Answered { .. } | Done::Replied { .. }));
            }
        });
        assert_eq!(violation.invariant, Invariant::Held, "{violation}");
    }
}

#[test]
fn a_repetition_that_is_held_back() {
    let mut cell = cell(&SLAVE.replace("retries = 0", "retries = 2"));
    let mut newest = Vec::new();
    let outward: Outward = Box::new(move |_, _, output| {
        let Output::PortSend { bytes, .. } = output else { return None };
        let is_repeated = std::mem::replace(&mut newest, bytes.to_vec()) == *bytes;
        is_repeated.then(Vec::new)
    });
    cell.corrupt(None, Some(outward));
    let line = cell.line_of("device");
    cell.attach(line, Honest::new(|_, _, _| ()));
    cell.run_ms(1_500);
    assert_eq!(cell.violation(), None);
    cell.cut(line);
    cell.run_ms(200);
    assert_eq!(cell.violation().map(|broken| broken.invariant), Some(Invariant::Periods));
}

#[test]
fn what_changes_while_the_controller_is_asked_for_its_outputs_is_seen_at_the_next_step() {
    let mut cell = cell(SLAVE);
    cell.run_ms(10);
    let var = SysVar::parse("WordOutputReg[1]").unwrap();
    for value in [7, 8] {
        cell.controller_input(ControllerInput::Tick);
        cell.controller.force(InitialTarget::Var(var), f64::from(value)).unwrap();
        let now = cell.now();
        cell.queue.push(now, Due::Survey);
        cell.run(Duration::from_micros(0));
        let newest = cell.oracle.as_ref().unwrap().truth.had(var).unwrap().back().copied();
        assert_eq!(newest, Some((now, [value, 0, 0, 0])));
    }
}

#[test]
fn values_that_nobody_told_the_device() {
    let violation = caught(SLAVE, |now, _, done| {
        if let (Some(Done::Wrote { values, .. }), true) = (done.first_mut(), is_late(now)) {
            values[0] += 1;
        }
    });
    assert_eq!(violation.invariant, Invariant::Carried, "{violation}");
    let violation = caught(PEER, |now, _, done| {
        if let (Some(Done::Took { exchange: 2, request }), true) = (done.first_mut(), is_late(now)) {
            request[2] ^= 1;
        }
    });
    assert_eq!(violation.invariant, Invariant::Carried, "{violation}");
}

#[test]
fn an_order_that_is_carried_out_twice() {
    for toml in [SLAVE, PEER] {
        let violation = caught(toml, |now, _, done| {
            let order = done.first().filter(|_| is_late(now)).cloned();
            done.extend(order.filter(|done| matches!(done, Done::Wrote { .. } | Done::Took { .. })));
        });
        assert_eq!(violation.invariant, Invariant::Carried, "{violation}");
    }
}

/// An oracle of the slave's line, to which the controller has shown these pairs of values, one a second.
fn shown(pairs: &[(u16, u16)]) -> (Oracle, Instant) {
    let cell = cell(SLAVE);
    let mut oracle = Oracle::new(cell.gateway());
    let mut now = cell.now();
    for (one, other) in pairs {
        now += MS(1_000);
        let mut image = cell.controller().registers().image().to_vec();
        for (name, value) in [("WordOutputReg[1]", one), ("WordOutputReg[2]", other)] {
            let at = SysVar::parse(name).unwrap().image_offset();
            image[at..at + 2].copy_from_slice(&value.to_le_bytes());
        }
        oracle.sees_controller(&image, now);
    }
    (oracle, now)
}

/// What the model says of a slave that takes these values after the gateway has asked for them.
fn taken(oracle: &mut Oracle, values: [u8; 2], now: Instant) -> Option<Invariant> {
    let request = sealed(&[2, 16, 0, 0x30, 0, 2, 4, 0, values[0], 0, values[1]]);
    let row = oracle.spec.ports[0].exchanges.as_ref().unwrap().rows[2].clone();
    oracle.truth.asks(0, 2, &row, &request, now);
    let values = values.map(u16::from).to_vec();
    let what = Done::Wrote { coils: false, address: 0x30, values };
    oracle.slave_did(0, SlaveDone { slave: 2, what }, now + MS(5));
    oracle.violation().map(|broken| broken.invariant)
}

#[test]
fn values_that_the_controller_had_one_after_the_other() {
    let (mut oracle, now) = shown(&[(1, 1), (2, 2)]);
    assert_eq!(taken(&mut oracle, [2, 2], now + MS(100)), None);
    let (mut oracle, now) = shown(&[(1, 1), (3, 3), (2, 2)]);
    assert_eq!(taken(&mut oracle, [1, 2], now + MS(100)), Some(Invariant::Carried), "never together");
}

#[test]
fn values_that_the_controller_had_too_long_ago() {
    // 300 ms until they are stale, 500 ms for the poll, 500 ms for a stall.
    let (mut oracle, now) = shown(&[(1, 1), (2, 2)]);
    assert_eq!(taken(&mut oracle, [1, 1], now + MS(1_200)), None);
    let (mut oracle, now) = shown(&[(1, 1), (2, 2)]);
    assert_eq!(taken(&mut oracle, [1, 1], now + MS(1_400)), Some(Invariant::Carried));
}

/// What the model says when this value of the first register reaches the robot, `age` after the slave
/// held 7.
fn arrives(value: u8, age: Duration) -> Option<Invariant> {
    let cell = cell(SLAVE);
    let (mut oracle, held) = (Oracle::new(cell.gateway()), cell.now());
    let reply = sealed(&[2, 4, 2, 0, 7]);
    let what = Done::Answered { address: 0x10, count: 1, reply };
    oracle.slave_did(0, SlaveDone { slave: 2, what }, held);
    let (var, now) = (SysVar::parse("WordInputReg[1]").unwrap(), held + age);
    let carried = Carried::Of { arrived: now, timeout: MS(1_000) };
    oracle.robot.note_sent(var, [value, 0, 0, 0], carried);
    let write = [0, 0, 0, 0, 0, 9, 1, 16, 0, 128, 0, 1, 2, 0, value];
    oracle.sent(7, LinkId::MODBUS, &write, Duration::ZERO, now);
    let inputs = copied_inputs(cell.controller().registers().image());
    oracle.arrived(7, LinkId::MODBUS, &write, (&inputs, &inputs), Duration::ZERO, now);
    oracle.violation().map(|broken| broken.invariant)
}

#[test]
fn values_at_the_robot_that_their_slave_did_not_hold() {
    assert_eq!(arrives(7, MS(1_500)), None);
    assert_eq!(arrives(8, MS(10)), Some(Invariant::Held));
    // A second until it is overdue, half for the request to the controller, three timeouts to be asked.
    assert_eq!(arrives(7, MS(1_700)), Some(Invariant::Held));
}

#[test]
fn an_exchange_before_what_is_asked_at_the_start() {
    let found = caught_out(PEER, |_, _, output| match output {
        Output::PortSend { bytes, .. } if bytes[..2] == [1, 1] => {
            Some(vec![Forged::Port(PORT, sealed(&[1, 3, 0, 7]))])
        }
        _ => None,
    });
    assert_eq!(found, Invariant::Cycle);
}

#[test]
fn a_start_before_a_sign_of_life() {
    let mut is_first = true;
    let found = caught_out(PEER, move |_, _, output| match output {
        Output::PortSend { .. } if std::mem::take(&mut is_first) => {
            Some(vec![Forged::Port(PORT, sealed(&[1, 1]))])
        }
        _ => None,
    });
    assert_eq!(found, Invariant::Cycle);
}

#[test]
fn a_request_while_a_reply_is_awaited() {
    let found = caught_out(PEER, |_, input, output| {
        let has_left = matches!(input, Input::PortSent { .. }) && is_rest(output);
        has_left.then(|| vec![Forged::Port(PORT, sealed(&[1, 2]))])
    });
    assert_eq!(found, Invariant::Line);
}

#[test]
fn a_request_that_is_in_no_exchange() {
    let found = caught_out(PEER, |_, _, output| match output {
        Output::PortSend { .. } => Some(vec![Forged::Port(PORT, sealed(&[1, 9]))]),
        _ => None,
    });
    assert_eq!(found, Invariant::Shown);
}

#[test]
fn a_request_with_another_value() {
    let found = caught_out(PEER, |_, _, output| match *output {
        Output::PortSend { bytes, .. } if bytes[1] == 3 => {
            Some(vec![Forged::Port(PORT, sealed(&[1, 3, bytes[2] ^ 1, bytes[3]]))])
        }
        _ => None,
    });
    assert_eq!(found, Invariant::Shown);
}

/// A master that reads and writes by turns for two seconds.
fn asked_by_a_master(outward: Option<Outward>) -> Cell {
    let mut cell = cell(SERVED);
    cell.corrupt(None, outward);
    cell.set_value("WordOutputReg[1]", 7.0);
    let line = cell.line_of("device");
    let start = cell.now() + MS(500);
    cell.attach(
        line,
        PeriodicSender::new(start, 20, 30, |n| match n % 2 {
            0 => sealed(&[5, 4, 0, 0, 0, 1]),
            _ => sealed(&[5, 6, 0, 9, 0, n as u8]),
        }),
    );
    cell.run_ms(2_500);
    cell
}

#[test]
fn a_slave_that_answers_right_is_not_accused() {
    let cell = asked_by_a_master(None);
    assert_eq!(cell.violation(), None);
    assert_eq!((cell.value("WordInputReg[1]"), cell.port("device").frames_out), (29.0, 30));
}

#[test]
fn a_slave_that_shows_another_value_says_nothing_or_answers_nobody() {
    let reply = |output: &Output<'_>| match *output {
        Output::PortSend { bytes, .. } => Some(bytes.to_vec()),
        _ => None,
    };
    let found = |outward: Outward| asked_by_a_master(Some(outward)).violation().map(|found| found.invariant);
    let other = found(Box::new(move |_, _, output| {
        let bytes = reply(output).filter(|bytes| bytes[1] == 4)?;
        Some(vec![Forged::Port(PORT, sealed(&[5, 4, 2, bytes[3], bytes[4] ^ 1]))])
    }));
    assert_eq!(other, Some(Invariant::Shown));
    let none = found(Box::new(move |_, _, output| reply(output).map(|_| Vec::new())));
    assert_eq!(none, Some(Invariant::Cycle));
    let nobody = found(Box::new(|_, input, output| {
        let has_left = matches!(input, Input::PortSent { .. }) && is_rest(output);
        has_left.then(|| vec![Forged::Port(PORT, sealed(&[5, 4, 2, 0, 7]))])
    }));
    assert_eq!(nobody, Some(Invariant::Cycle));
}
