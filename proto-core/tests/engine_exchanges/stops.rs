//! Writes that stop a device: a state that is wanted until it is confirmed, and that nothing overtakes.

use proto_core::config::*;
use proto_core::engine::{Input, PortId};
use proto_core::modbus::rtu::Operation;
use proto_core::sysvar::{ModbusPlace, SysVar};

use crate::line::*;
use crate::rig::*;

/// A write of this register's constant that a bit of `BitOutputReg[3]` asks for.
fn asked_by(cell: &mut Cell, bit: u8, address: u16) -> Exchange {
    let order = proto_core::device::ByteOrder::Big;
    let word = proto_core::device::Encoding::scalar(proto_core::wire::scalar::ScalarType::Word);
    let written = cell.fields([FieldSpec::DeviceOutput {
        encoding: proto_core::device::Encoding { order, ..word },
        overflow: proto_core::device::Overflow::Usual,
        from: OutputBinding::Constant(1.0),
    }]);
    let when = Triggers { rising: Some((var("BitOutputReg[3]"), bit)), ..Triggers::NEVER };
    let operation = Operation::WriteRegister { address };
    never_late(Exchange::new(9, Transaction::Rtu { operation, written, read: Span::default() }, when))
}

/// A motion in two steps that bit 0 asks for, and a stop by bit 1: registers 1, 2 and 3. A register is read, so that it
/// is known that nothing of the line is heard twice.
fn axis() -> (Line, PortId) {
    let mut cell = Cell::new();
    let first = asked_by(&mut cell, 0, 1);
    let second = asked_by(&mut cell, 0, 2);
    let stop = Exchange { stop: true, ..asked_by(&mut cell, 1, 3) };
    let position = reads(&mut cell, 9, &["WordInputReg[1]"], Triggers::every(MS(500)));
    let port = talking(&mut cell, &[first, second, stop, position]);
    let mut line = Line::new(&cell, port);
    line.run(MS(100), |request| Some((MS(2), answer(request))));
    (line, port)
}

fn answer(request: &[u8]) -> Vec<u8> {
    if request[1] == 3 { registers(9, &[5]) } else { request.to_vec() }
}

fn set(line: &mut Line, bit: u8, on: bool) {
    let bits: SysVar = var("BitOutputReg[3]");
    let Some(ModbusPlace::Coils { first, .. }) = bits.modbus() else { panic!() };
    line.rig.map.coils[usize::from(first) + usize::from(bit)] = on;
}

/// The registers that were written.
fn written(requests: &[(proto_core::time::Instant, Vec<u8>)]) -> Vec<u8> {
    requests.iter().filter(|(_, request)| request[1] == 6).map(|(_, request)| request[3]).collect()
}

#[test]
fn a_stop_that_is_asked_for_while_the_port_is_away_is_sent_when_it_is_back() {
    let (mut line, port) = axis();
    line.rig.input(Input::PortDown { port });
    set(&mut line, 1, true);
    line.run(MS(100), |_| None);
    line.rig.input(Input::PortUp { port });
    let asked = line.run(MS(100), |request| Some((MS(2), answer(request))));
    assert_eq!(written(&asked), [3]);
}

#[test]
fn the_step_behind_one_that_is_on_its_way_is_not_carried_out_after_a_stop() {
    let (mut line, _) = axis();
    set(&mut line, 0, true);
    // The first step is answered slowly, and the stop comes meanwhile.
    let mut asked = line.run(MS(40), |request| Some((MS(60), answer(request))));
    set(&mut line, 1, true);
    asked.extend(line.run(MS(300), |request| Some((MS(2), answer(request)))));
    assert_eq!(written(&asked), [1, 3]);
}

#[test]
fn a_stop_on_its_way_is_sent_again_when_the_port_is_reported_again() {
    let (mut line, port) = axis();
    set(&mut line, 1, true);
    line.run(MS(40), |_| None);
    line.rig.input(Input::PortUp { port });
    let asked = line.run(MS(300), |request| Some((MS(2), answer(request))));
    assert_eq!(written(&asked).first(), Some(&3));
}

#[test]
fn an_event_that_only_an_echo_answered_is_not_sent_again_when_the_echo_is_learned() {
    let mut cell = Cell::new();
    let event = asked_by(&mut cell, 0, 1);
    let other = reads(&mut cell, 8, &["WordInputReg[1]"], Triggers::every(MS(100)));
    let port = talking(&mut cell, &[event, other]);
    let mut line = Line::new(&cell, port);
    line.run(MS(100), |_| None);
    set(&mut line, 0, true);
    let asked = line.run(MS(250), |request| (request[1] == 6).then(|| (MS(1), request.to_vec())));
    assert_eq!(written(&asked), [1]);
    let echoed = |request: &[u8]| Some((MS(1), [request, &registers(8, &[5])].concat()));
    let asked = line.run(MS(3_000), |request| if request[1] == 3 { echoed(request) } else { None });
    assert_eq!(written(&asked), [0; 0]);
}
