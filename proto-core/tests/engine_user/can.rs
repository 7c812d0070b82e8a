//! User-defined CAN recipes: each id has its own fields.

use proto_core::config::*;
use proto_core::engine::{BusState, Input, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType as T;

use super::rig::*;
use super::{from, sent, to};

/// Worked example 3's shape with two ids each way, on the gateway.
fn can_cell() -> (Cell, PortId) {
    let mut cell = Cell::new();
    let table = cell.commands(&[(7, "resume")]);
    let command = InputBinding::Commands { table, when: CommandWhen::Change };
    let parts = [
        (1, vec![user_in(T::Byte, to("WordInputReg[1]", 1.0, 0.0)), user_in(T::Byte, InputBinding::Unused)]),
        (5, vec![user_in(T::Byte, command), user_in(T::Word, to("WordInputReg[2]", 1.0, 0.0))]),
    ];
    let input = parts
        .into_iter()
        .map(|(id, fields)| CanFramePart { id: CanId::Standard(id), fields: cell.fields(fields) })
        .collect();
    let parts = [
        (2, vec![user_out(T::Byte, OutputBinding::Constant(125.0)), user_out(T::Byte, OutputBinding::Reply)]),
        (
            3,
            vec![
                user_out(T::Word, OutputBinding::Counter),
                user_out(T::Byte, from("WordInputReg[1]", 1.0, 0.0)),
            ],
        ),
    ];
    let output = parts
        .into_iter()
        .map(|(id, fields)| CanFramePart { id: CanId::Standard(id), fields: cell.fields(fields) })
        .collect();
    let recipe = cell.recipe(Mode::User, Parts::Can { input, output });
    cell.last_recipe().send = SendOn::Frame;
    let port = cell.can_port(recipe);
    (cell, port)
}

#[test]
fn can_ids_have_their_own_fields() {
    let (cell, port) = can_cell();
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 5, &[0, 0x34, 0x12]);
    assert_eq!(rig.take_written(), [Written::Registers(9, vec![0x1234])]);
    assert!(rig.can_sent_to(port).is_empty(), "one of the values to answer with is not known");
    assert_eq!(rig.counters(port).stale_cycles, 1);
    rig.can(port, 1, &[9, 7]);
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![9])]);
    let frames: Vec<_> = rig.can_sent_to(port).iter().map(|f| (f.id(), f.data().to_vec())).collect();
    let expected = [(2, vec![125, 0]), (3, vec![0, 0, 9])].map(|(id, data)| (CanId::Standard(id), data));
    assert_eq!(frames, expected);
    assert!(sent(&mut rig).is_empty(), "7 stood in the other id's field");

    rig.can(port, 5, &[7, 1, 0]);
    assert_eq!(sent(&mut rig), ["resume"]);
    let frames: Vec<_> = rig.can_sent_to(port).iter().map(|f| f.data().to_vec()).collect();
    assert_eq!(frames, [vec![125, ReplyCode::Pending as u8], vec![1, 0, 9]]);
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.frames_out), (3, 4));
    assert_eq!((counters.bytes_in, counters.bytes_out), (8, 10));
}

#[test]
fn one_can_id_that_falls_silent_leaves_the_others_commands_alone() {
    let (cell, port) = can_cell();
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 1, &[9, 0]);
    rig.can(port, 5, &[0, 0, 0]);
    rig.run(MS(60));
    rig.can(port, 5, &[0, 0, 0]);
    rig.run(MS(60));
    assert_eq!(rig.counters(port).timeouts, 1, "id 1 is overdue");
    rig.can(port, 5, &[7, 0, 0]);
    assert_eq!(sent(&mut rig), ["resume"], "id 5 is not");
}

#[test]
fn bus_off_forgets_what_was_due() {
    let (cell, port) = can_cell();
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 1, &[9, 7]);
    rig.can_sent_to(port);
    rig.input(Input::PortBus { port, state: BusState::BusOff });
    rig.can(port, 1, &[9, 7]);
    rig.run(MS(100));
    rig.input(Input::PortBus { port, state: BusState::Active });
    rig.run(MS(100));
    assert!(rig.can_sent_to(port).is_empty());
    rig.can(port, 1, &[9, 7]);
    assert_eq!(rig.can_sent_to(port).len(), 2);
}
