//! Gateways that break one promise each: the model reports the violated invariant.

use std::cell::RefCell;
use std::rc::Rc;

use proto_core::config::SendOn;
use proto_core::engine::{Input, LinkId, Output, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::*;
use crate::corruption::{Forged, Inward, Outward};
use crate::soak::Scenario;
use crate::{Cell, PeriodicSender};
use recipe_config::SimConfig;
use recipe_test_kit::toml;

/// DO1..8 and a word from a device, the pose back to it, nothing older than 300 ms.
pub(super) const CELL: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "device"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["DigitalOutputCommand[1]", "WordInputReg[1]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
on_stale = "stop"
fields = ["RobotState[8]", "FloatOutputReg[1]"]

[[port]]
name = "device"
bus = "rs485"
recipe = "device"
cycle_ms = 20
timeout_ms = 100
stale_after_ms = 300
"#;

/// A panel whose button starts a program.
const ORDERS: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "device"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [{ name = "order", type = "byte", commands = { 1 = "speed(10)", 2 = "speed(20)" } }]

[[port]]
name = "device"
bus = "rs485"
recipe = "device"
"#;

pub(super) const DEVICE: PortId = PortId(0);

pub(super) fn cell(toml: &str) -> Cell {
    let mut cell = Cell::new(&toml::gateway(toml), &SimConfig::default(), 1).unwrap();
    cell.watch();
    cell
}

/// The n-th frame: two bits that change each time, and a word that counts.
pub(super) fn frame(n: u64) -> Vec<u8> {
    let bits = if n.is_multiple_of(2) { 0b01 } else { 0b10 };
    let [low, high] = (n as u16).to_le_bytes();
    vec![0xFF, 0xFF, bits, low, high, 0xEE, 0xEE]
}

/// 25 frames a second for two seconds, and a second of silence.
fn run(mut cell: Cell) -> Option<Violation> {
    let line = cell.line_of("device");
    cell.attach(line, PeriodicSender::new(cell.now() + Duration::from_millis(510), 25, 50, frame));
    for nth in 0..6 {
        cell.set_value("FloatOutputReg[1]", f64::from(nth));
        cell.run_ms(500);
    }
    cell.violation().cloned()
}

#[track_caller]
fn caught(mut cell: Cell, inward: Option<Inward>, outward: Option<Outward>) -> Invariant {
    cell.corrupt(inward, outward);
    match run(cell) {
        Some(violation) => violation.invariant,
        None => panic!("nothing was noticed"),
    }
}

#[track_caller]
fn caught_out(
    outward: impl FnMut(Instant, &Input<'_>, &Output<'_>) -> Option<Vec<Forged>> + 'static,
) -> Invariant {
    caught(cell(CELL), None, Some(Box::new(outward)))
}

/// The bytes of a Modbus write.
pub(super) fn write_of(output: &Output<'_>) -> Option<Vec<u8>> {
    match *output {
        Output::LinkSend { link: LinkId::MODBUS, bytes } if bytes[7] >= 15 => Some(bytes.to_vec()),
        _ => None,
    }
}

pub(super) fn is_rest(output: &Output<'_>) -> bool {
    matches!(output, Output::Sleep { .. })
}

/// An FC 15 request for DO1..8.
pub(super) fn coils(bits: u8) -> Vec<u8> {
    vec![0x7F, 0, 0, 0, 0, 8, 1, 15, 0, 192, 0, 8, 1, bits]
}

pub(super) fn modbus(bytes: Vec<u8>) -> Option<Vec<Forged>> {
    Some(vec![Forged::Link(LinkId::MODBUS, bytes)])
}

#[test]
fn a_good_gateway_is_not_accused() {
    assert_eq!(run(cell(CELL)), None);
    assert_eq!(run(cell(ORDERS)), None);
}

#[test]
fn a_zero_before_the_first_frame() {
    let mut done = false;
    let found = caught_out(move |_, input, output| {
        let up = matches!(input, Input::LinkUp { link: LinkId::MODBUS });
        (up && is_rest(output) && !std::mem::replace(&mut done, true)).then(|| modbus(coils(0))).flatten()
    });
    assert_eq!(found, Invariant::FirstFrame);
}

#[test]
fn a_write_repeated_after_a_reconnect() {
    let newest = Rc::new(RefCell::new(None));
    let mut cell = cell(CELL);
    cell.corrupt(
        None,
        Some(Box::new(move |_, input, output| {
            if let Some(write) = write_of(output) {
                newest.replace(Some(write));
            }
            let up = matches!(input, Input::LinkUp { link: LinkId::MODBUS });
            newest.borrow().clone().filter(|_| up && is_rest(output)).and_then(modbus)
        })),
    );
    let line = cell.line_of("device");
    cell.attach(line, PeriodicSender::new(cell.now() + Duration::from_millis(510), 25, 25, frame));
    cell.run_ms(1_500);
    assert_eq!(cell.violation(), None);
    cell.reset(LinkId::MODBUS);
    cell.run_ms(2_000);
    assert_eq!(cell.violation().map(|broken| broken.invariant), Some(Invariant::NoReplay));
}

#[test]
fn a_write_after_the_owner_fell_silent() {
    let mut newest: Option<(Instant, Vec<u8>)> = None;
    let found = caught_out(move |now, _, output| {
        if let Some(write) = write_of(output) {
            newest = Some((now, write));
        }
        let late =
            |written: &(Instant, Vec<u8>)| now.saturating_since(written.0) > Duration::from_millis(300);
        newest
            .clone()
            .filter(|written| late(written) && is_rest(output))
            .and_then(|written| modbus(written.1))
    });
    assert_eq!(found, Invariant::InTime);
}

#[test]
fn a_write_repeated_at_once() {
    let (mut newest, mut is_busy) = (None, false);
    let found = caught_out(move |_, input, output| {
        if let Some(write) = write_of(output) {
            newest = Some(write);
            is_busy = true;
        }
        let answered = matches!(input, Input::LinkBytes { link: LinkId::MODBUS, .. });
        if !is_rest(output) || std::mem::take(&mut is_busy) || !answered {
            return None;
        }
        newest.clone().and_then(modbus)
    });
    assert_eq!(found, Invariant::Sent);
}

#[test]
fn two_bits_swapped() {
    let found = caught_out(|_, _, output| {
        let mut write = write_of(output).filter(|write| write[7] == 15)?;
        write[13] = write[13] & 0xFC | (write[13] & 1) << 1 | write[13] >> 1 & 1;
        modbus(write)
    });
    assert_eq!(found, Invariant::Sent);
}

#[test]
fn a_write_to_somebody_elses_variable() {
    let found = caught_out(|_, _, output| {
        let mut write = write_of(output).filter(|write| write[7] == 15)?;
        write[9] = 200;
        modbus(write)
    });
    assert_eq!(found, Invariant::Ownership);
}

#[test]
fn half_a_variable_written() {
    let found = caught_out(|_, _, output| {
        let mut write = write_of(output).filter(|write| write[7] == 15)?;
        write[11] = 4;
        modbus(write)
    });
    assert_eq!(found, Invariant::Ownership);
}

#[test]
fn a_write_that_is_forgotten() {
    let found = caught_out(|_, _, output| write_of(output).map(|_| Vec::new()));
    assert_eq!(found, Invariant::Delivered);
}

#[test]
fn an_edge_left_out() {
    let mut cell = cell(CELL);
    // Of three frames in one piece the engine sees the second one's bits in the first one as well.
    cell.corrupt(
        Some(Box::new(|_, input| match *input {
            Input::PortBytes { bytes, .. } if bytes.len() == 21 => {
                let mut bytes = bytes.to_vec();
                bytes[2] = bytes[9];
                Some(bytes)
            }
            _ => None,
        })),
        None,
    );
    cell.run_ms(600);
    let line = cell.line_of("device");
    cell.send(line, &frame(1));
    cell.run(Duration::from_micros(650));
    let three: Vec<u8> = [frame(2), frame(3), frame(4)].concat();
    cell.send(line, &three);
    cell.run_ms(100);
    assert_eq!(cell.violation().map(|broken| broken.invariant), Some(Invariant::Edges));
}

#[test]
fn a_frame_that_is_neither_applied_nor_counted() {
    let inward: Inward = Box::new(|_, input| match input {
        Input::PortBytes { .. } => Some(Vec::new()),
        _ => None,
    });
    let found = caught(cell(CELL), Some(inward), None);
    assert_eq!(found, Invariant::Counted);
}

#[test]
fn a_frame_to_the_field_before_its_values_are_known() {
    let found = caught_out(|now, input, output| {
        let on_grid = now.as_micros() % 20_000 == 0;
        let early = on_grid && matches!(input, Input::Tick) && is_rest(output);
        early.then(|| vec![Forged::Port(DEVICE, vec![0xFF, 0xFF, 0, 0, 0, 0, 0, 0, 0, 0, 0xFE, 0xFE])])
    });
    assert_eq!(found, Invariant::Known);
}

#[test]
fn an_old_frame_shown_again() {
    let mut first = None;
    let found = caught_out(move |_, _, output| match *output {
        Output::PortSend { bytes, .. } => {
            let first = first.get_or_insert_with(|| bytes.to_vec());
            Some(vec![Forged::Port(DEVICE, first.clone())])
        }
        _ => None,
    });
    assert_eq!(found, Invariant::Shown);
}

#[test]
fn two_transmissions_at_once() {
    let found = caught_out(|_, _, output| match *output {
        Output::PortSend { port, bytes } => Some(vec![Forged::Port(port, bytes.to_vec()); 2]),
        _ => None,
    });
    assert_eq!(found, Invariant::Line);
}

#[test]
fn a_gateway_that_does_not_stop_when_its_sources_are_stale() {
    let mut cell = cell(CELL);
    cell.run_ms(700);
    cell.refuse(LinkId::STATE);
    cell.reset(LinkId::STATE);
    let began = cell.now();
    cell.corrupt(
        None,
        Some(Box::new(move |now, input, output| {
            let late = now.saturating_since(began) > Duration::from_millis(500);
            let on_grid = now.as_micros() % 20_000 == 0 && matches!(input, Input::Tick);
            let bytes = vec![0xFF, 0xFF, 0, 0, 0, 0, 0, 0, 0, 0, 0xFE, 0xFE];
            (late && on_grid && is_rest(output)).then(|| vec![Forged::Port(DEVICE, bytes)])
        })),
    );
    cell.run_ms(1_000);
    assert_eq!(cell.violation().map(|broken| broken.invariant), Some(Invariant::Age));
}

#[test]
fn frames_faster_than_the_cycle() {
    let mut newest = None;
    let found = caught_out(move |_, input, output| {
        if let Output::PortSend { bytes, .. } = output {
            newest = Some(bytes.to_vec());
        }
        let free = matches!(input, Input::PortSent { .. }) && is_rest(output);
        newest.clone().filter(|_| free).map(|bytes| vec![Forged::Port(DEVICE, bytes)])
    });
    assert_eq!(found, Invariant::Cycle);
}

#[test]
fn a_cycle_left_out() {
    let mut sent = 0;
    let found = caught_out(move |_, _, output| match output {
        Output::PortSend { .. } => {
            sent += 1;
            (sent == 10).then(Vec::new)
        }
        _ => None,
    });
    assert_eq!(found, Invariant::Cycle);
}

#[test]
fn a_command_sent_twice() {
    let mut newest = None;
    let outward: Outward = Box::new(move |_, input, output| {
        if let Output::LinkSend { link: LinkId::COMMAND, bytes } = output {
            newest = Some(bytes.to_vec());
        }
        let answered = matches!(input, Input::LinkBytes { link: LinkId::COMMAND, .. }) && is_rest(output);
        newest.clone().filter(|_| answered).map(|bytes| vec![Forged::Link(LinkId::COMMAND, bytes)])
    });
    // The second frame differs from the first: that picks a command.
    let mut cell = cell(ORDERS);
    cell.corrupt(None, Some(outward));
    cell.run_ms(600);
    let line = cell.line_of("device");
    for order in [0, 1] {
        cell.send(line, &[0xFF, 0xFF, order, 0xEE, 0xEE]);
        cell.run_ms(50);
    }
    assert_eq!(cell.violation().map(|broken| broken.invariant), Some(Invariant::Once));
}

#[test]
fn work_without_an_end() {
    let found = caught_out(|_, input, output| {
        let once = matches!(input, Input::LinkUp { .. }) && is_rest(output);
        once.then(|| vec![Forged::Open(LinkId::STATE); 100])
    });
    assert_eq!(found, Invariant::Work);
}

#[test]
fn what_waits_without_a_bound() {
    let cell = cell(CELL);
    let mut oracle = Oracle::new(cell.gateway());
    oracle.rest(cell.now(), cell.engine(), Instant::NEVER, MAX_PENDING);
    assert_eq!(oracle.violation().map(|broken| broken.invariant), Some(Invariant::Memory));
}

#[test]
fn what_reaches_the_controller_and_was_not_sent() {
    let cell = cell(CELL);
    let (mut oracle, now) = (Oracle::new(cell.gateway()), cell.now());
    oracle.sent(7, LinkId::MODBUS, &coils(1), Duration::ZERO, now);
    let inputs = copied_inputs(cell.controller().registers().image());
    oracle.arrived(7, LinkId::MODBUS, &coils(2), (&inputs, &inputs), Duration::ZERO, now);
    assert_eq!(oracle.violation().map(|broken| broken.invariant), Some(Invariant::Transport));
}

#[test]
fn each_byte_that_reaches_the_controller_is_compared_with_those_sent() {
    let mut controller = wire::Controller::new();
    let sent: Vec<u8> = (0..200).collect();
    // Five bytes are always on their way, wherever the room for them begins.
    for (nth, byte) in sent.iter().enumerate() {
        controller.sent(7, &[*byte]);
        let Some(first) = (nth + 1).checked_sub(5) else { continue };
        let waiting = &sent[first..=nth];
        for wrong in 0..waiting.len() {
            let mut bytes = waiting.to_vec();
            bytes[wrong] ^= 1;
            assert!(controller.arrived(7, &bytes).is_err(), "{nth}, {wrong}");
        }
        assert!(controller.arrived(7, &[waiting, &[0]].concat()).is_err());
        assert_eq!(controller.clone().arrived(7, waiting), Ok(()));
        assert_eq!(controller.arrived(7, &waiting[..1]), Ok(()));
    }
}

#[test]
fn a_port_needs_what_its_frames_show_and_the_bit_that_triggers_them() {
    let mut triggers = 0;
    for scenario in Scenario::all().unwrap() {
        let spec = Spec::new(&scenario.gateway);
        for port in &spec.ports {
            let fields = port.outputs.iter().flat_map(|frame| &frame.fields);
            let mut expected: Vec<SysVar> = fields.flat_map(frame::shown).collect();
            if let SendOn::Rising { var, .. } = port.send {
                expected.push(var);
                triggers += 1;
            }
            assert_eq!(port.needed, expected, "{}", scenario.name);
        }
    }
    assert!(triggers > 0);
}

#[test]
fn only_floats_can_be_unreadable() {
    let cell = cell(CELL);
    let (mut up, now) = (Upward::new(&Spec::new(cell.gateway())), cell.now());
    let var = SysVar::parse("FloatOutputReg[1]").unwrap();
    let readable = 1.5_f32.to_le_bytes();
    for unreadable in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        up.received(var, readable, now);
        assert!(!up.known(var).unreadable);
        up.received(var, unreadable.to_le_bytes(), now);
        assert_eq!((up.known(var).unreadable, up.known(var).value), (true, Some((readable, now))));
    }
    let var = SysVar::parse("WordOutputReg[1]").unwrap();
    up.received(var, [0xFF, 0xFF, 0, 0], now);
    assert_eq!((up.known(var).unreadable, up.known(var).value), (false, Some(([0xFF, 0xFF, 0, 0], now))));
}

#[test]
fn data_of_a_link_may_be_in_flight_as_long_as_its_values_may_wait() {
    let mut found = [0; 2];
    for scenario in Scenario::all().unwrap() {
        let spec = Spec::new(&scenario.gateway);
        for link in &spec.links {
            let owned = spec.owned.iter().flatten().filter(|owned| owned.way == link.id);
            let shortest = owned.map(|owned| spec.ports[owned.port].timeout).min();
            let expected = match link.is_datagram {
                true => Duration::ZERO,
                false => shortest.unwrap_or_default().max(Duration::from_millis(250)),
            };
            assert_eq!(link.not_after, expected, "{}: {:?}", scenario.name, link.id);
            found[usize::from(link.is_datagram)] += 1;
        }
    }
    assert!(found.into_iter().all(|found| found > 0), "{found:?}");
}

#[test]
fn inputs_that_are_not_what_was_written() {
    let cell = cell(CELL);
    let (mut oracle, now) = (Oracle::new(cell.gateway()), cell.now());
    oracle.sent(7, LinkId::MODBUS, &coils(1), Duration::ZERO, now);
    let before = copied_inputs(cell.controller().registers().image());
    let mut after = before;
    after[0] = 3;
    oracle.arrived(7, LinkId::MODBUS, &coils(1), (&before, &after), Duration::ZERO, now);
    assert_eq!(oracle.violation().map(|broken| broken.invariant), Some(Invariant::Registers));
}
