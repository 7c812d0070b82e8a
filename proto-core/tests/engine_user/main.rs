//! User-defined recipes on the gateway: bindings and triggers here, command tables and CAN beside it
//! (docs/engine.md sections 7, 8).

mod can;
mod commands;
#[path = "../rig/mod.rs"]
mod rig;

use proto_core::config::*;
use proto_core::engine::{Input, LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::{Scalar, ScalarType as T};
use rig::*;

fn to(name: &str, scale: f32, offset: f32) -> InputBinding {
    InputBinding::Variable { var: var(name), scale, offset }
}

fn from(name: &str, scale: f32, offset: f32) -> OutputBinding {
    OutputBinding::Variable { var: var(name), scale, offset }
}

/// One RS-485 port with a user-defined recipe, head and tail as in the specification's examples.
fn user(cell: &mut Cell, input: &[(T, InputBinding)], output: &[(T, OutputBinding)], send: SendOn) -> PortId {
    let input = (!input.is_empty()).then(|| {
        let fields = cell.fields(input.iter().map(|&(ty, to)| user_in(ty, to)));
        cell.part(&[255, 255], &[238, 238], fields).unwrap()
    });
    let output = (!output.is_empty()).then(|| {
        let fields = cell.fields(output.iter().map(|&(ty, from)| user_out(ty, from)));
        cell.part(&[255, 255], &[254, 254], fields).unwrap()
    });
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output });
    cell.last_recipe().send = send;
    cell.rs485(recipe)
}

fn frame(fields: &[u8]) -> Vec<u8> {
    [&[255, 255], fields, &[238, 238]].concat()
}

fn answer(fields: &[u8]) -> Vec<u8> {
    [&[255, 255], fields, &[254, 254]].concat()
}

/// The commands that were sent since the last call.
fn sent(rig: &mut Rig) -> Vec<String> {
    let texts = rig.sent_on(LinkId::COMMAND);
    texts.into_iter().map(|text| String::from_utf8(text).unwrap()).collect()
}

#[test]
fn bound_values_are_scaled_shifted_and_rounded() {
    let mut cell = Cell::new();
    let fields = [
        (T::Byte, to("WordInputReg[1]", 10.0, 5.0)),
        (T::Char, InputBinding::Unused),
        (T::Float, to("WordInputReg[2]", 1.0, 0.0)),
        (T::Short, to("BitInputReg[1]", -1.0, 0.0)),
    ];
    let port = user(&mut cell, &fields, &[], SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let float = 99.5_f32.to_le_bytes();
    rig.bytes(port, &frame(&[3, 0x80, float[0], float[1], float[2], float[3], 0xFE, 0xFF]));
    let mut written = rig.take_written();
    written.sort_by_key(|write| format!("{write:?}"));
    let bits = [false, true, false, false, false, false, false, false];
    assert_eq!(written, [Written::Coils(0, bits.into()), Written::Registers(8, vec![35, 100])]);
    assert_eq!(rig.counters(port).frames_in, 1);
}

#[test]
fn a_frame_with_one_value_that_does_not_fit_is_rejected_whole() {
    let mut cell = Cell::new();
    let fields = [
        (T::Byte, to("WordInputReg[1]", 1.0, 0.0)),
        (T::Short, to("WordInputReg[2]", 2.0, 0.0)),
        (T::Float, InputBinding::Unused),
        (T::Byte, to("DigitalOutputCommand[3]", 1.0, 0.0)),
    ];
    let port = user(&mut cell, &fields, &[], SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let values = |byte: u8, short: i16, float: f32, tool: u8| {
        let (short, float) = (short.to_le_bytes(), float.to_le_bytes());
        frame(&[&[byte][..], &short, &float, &[tool]].concat())
    };
    rig.bytes(port, &values(1, -1, 0.0, 0));
    rig.bytes(port, &values(2, i16::MAX, 0.0, 4));
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_out_of_range, counters.rejected_not_finite), (2, 0));
    rig.bytes(port, &values(3, 1, f32::NEG_INFINITY, 0));
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_out_of_range, counters.rejected_not_finite), (2, 1));
    assert_eq!(rig.take_written(), []);
    assert!(!rig.engine.image().is_known(var("WordInputReg[1]")));
    assert_eq!(rig.engine.image().value(var("WordInputReg[1]")), Scalar::Word(0), "not half of it");

    rig.bytes(port, &values(4, i16::MAX, 0.0, 3));
    let written = rig.take_written();
    assert!(written.contains(&Written::Registers(8, vec![4, 65_534])), "{written:?}");
    assert!(written.contains(&Written::Coils(216, vec![true, true])), "{written:?}");
    assert_eq!(rig.counters(port).frames_in, 1);
}

#[test]
fn an_output_frame_carries_constants_a_counter_and_scaled_variables() {
    let mut cell = Cell::new();
    let fields = [
        (T::Char, OutputBinding::Constant(-3.0)),
        (T::Byte, OutputBinding::Counter),
        (T::Short, from("RobotState[8]", 1000.0, 1.0)),
        (T::Byte, from("RobotState[9]", 1.0, 0.0)),
    ];
    let port = user(&mut cell, &[], &fields, SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(20));
    assert!(rig.sent_to(port).is_empty(), "the pose is not known yet");
    let mut packet = vec![0; 1468];
    packet[368..372].copy_from_slice(&(-1.25_f32).to_le_bytes());
    packet[372..376].copy_from_slice(&1e9_f32.to_le_bytes());
    rig.link_bytes(LinkId::STATE, &packet);
    rig.run(MS(4 * 300));
    let frames = rig.sent_to(port);
    assert_eq!(frames.len(), 300);
    let short = (-1249_i16).to_le_bytes();
    for (nth, sent) in frames.iter().enumerate() {
        assert_eq!(*sent, answer(&[0xFD, nth as u8, short[0], short[1], 255]), "frame {nth}");
    }
}

#[test]
fn changes_are_sent_on_the_cycle_and_only_they() {
    let mut cell = Cell::new();
    let fields = [(T::Byte, OutputBinding::Counter), (T::Word, from("WordOutputReg[3]", 1.0, 0.0))];
    let port = user(&mut cell, &[], &fields, SendOn::Change);
    let mut rig = cell.rig();
    rig.map.registers[42] = 7;
    // The cycle before the start sends what is there at once; then the grid begins.
    rig.run(MS(1));
    assert_eq!(rig.sent_to(port).len(), 1);
    rig.run(MS(2_000));
    assert_eq!(rig.sent_to(port).len(), 500, "a counter is news each cycle");

    let mut cell = Cell::new();
    let fields = [(T::Word, from("WordOutputReg[3]", 1.0, 0.0))];
    let port = user(&mut cell, &[], &fields, SendOn::Change);
    let mut rig = cell.rig();
    rig.map.registers[42] = 7;
    rig.run(MS(2_000));
    assert_eq!(rig.sent_to(port), [answer(&[7, 0])]);
    rig.map.registers[42] = 8;
    rig.run(MS(12));
    assert_eq!(rig.sent_to(port), [answer(&[8, 0])]);
    rig.map.registers[42] = 7;
    rig.run(MS(12));
    assert_eq!(rig.sent_to(port), [answer(&[7, 0])]);
    assert_eq!(rig.counters(port).frames_out, 3);
    // A device that comes back gets the present values.
    rig.input(Input::PortDown { port });
    rig.run(MS(100));
    assert!(rig.sent_to(port).is_empty());
    rig.input(Input::PortUp { port });
    rig.run(MS(8));
    assert_eq!(rig.sent_to(port), [answer(&[7, 0])]);
}

#[test]
fn each_accepted_frame_is_answered_once_after_the_turnaround() {
    let mut cell = Cell::new();
    let input = [(T::Byte, to("WordInputReg[1]", 1.0, 0.0))];
    let output = [(T::Byte, OutputBinding::Counter), (T::Byte, OutputBinding::Constant(9.0))];
    let port = user(&mut cell, &input, &output, SendOn::Frame);
    if let Bus::Rs485(line) = &mut cell.last_port().bus {
        line.turnaround = Duration::from_micros(300);
    }
    let mut rig = cell.rig();
    rig.run(MS(1_000));
    assert!(rig.sent_to(port).is_empty(), "no request came");
    rig.log.clear();
    let asked = rig.now;
    rig.bytes(port, &frame(&[1]));
    rig.run(MS(50));
    let sent_at: Vec<Instant> =
        rig.log.iter().filter(|(_, out)| matches!(out, Out::Port(..))).map(|&(at, _)| at).collect();
    assert_eq!(sent_at, [asked + Duration::from_micros(300)]);
    assert_eq!(rig.sent_to(port), [answer(&[0, 9])]);
    rig.bytes(port, &frame(&[1])[..4]);
    rig.bytes(port, &[0; 3]);
    rig.run(MS(50));
    assert!(rig.sent_to(port).is_empty(), "a broken frame is not answered");
    // Five requests in one chunk, from an adapter that held them back: one answer, four skipped.
    rig.bytes(port, &frame(&[2]).repeat(5));
    rig.run(MS(50));
    assert_eq!(rig.sent_to(port), [answer(&[1, 9])]);
    assert_eq!(rig.counters(port).skipped_cycles, 4);
    assert_eq!(rig.counters(port).frames_in, 6);
}

/// A frame is sent when DI3 goes on.
fn on_rising_bit() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let fields = [(T::Byte, OutputBinding::Counter)];
    let send = SendOn::Rising { var: var("DigitalSignalStatus[1]"), bit: 2 };
    let port = user(&mut cell, &[], &fields, send);
    (cell.rig(), port)
}

#[test]
fn a_rising_bit_sends_once() {
    let (mut rig, port) = on_rising_bit();
    rig.run(MS(100));
    for round in 0..3 {
        rig.map.coils[178] = false;
        rig.map.coils[177] = true;
        rig.run(MS(100));
        assert!(rig.sent_to(port).is_empty(), "neither the other bit nor going off");
        rig.map.coils[178] = true;
        rig.run(MS(100));
        assert_eq!(rig.sent_to(port), [answer(&[round])]);
    }
}

#[test]
fn a_bit_that_is_on_from_the_start_has_not_risen() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let switch = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 1.0);
    let send = SendOn::Rising { var: var("DigitalOutputCommand[1]"), bit: 0 };
    let port = user(&mut cell, &[], &[(T::Byte, OutputBinding::Counter)], send);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(switch, &frame(&[1]));
    rig.bytes(switch, &frame(&[0]));
    assert!(rig.sent_to(port).is_empty());
    rig.bytes(switch, &frame(&[1]));
    assert_eq!(rig.sent_to(port), [answer(&[0])], "another port's bit");
    rig.bytes(switch, &frame(&[0]));
    rig.run(MS(100));
    assert_eq!(rig.sent_to(port), [answer(&[1])], "its safe value is on");
}

#[test]
fn what_fell_due_while_the_port_was_gone_is_not_sent_later() {
    let (mut rig, port) = on_rising_bit();
    rig.run(MS(100));
    rig.input(Input::PortDown { port });
    rig.map.coils[178] = true;
    rig.run(MS(100));
    rig.input(Input::PortUp { port });
    rig.run(MS(100));
    assert!(rig.sent_to(port).is_empty());
    rig.map.coils[178] = false;
    rig.run(MS(100));
    rig.map.coils[178] = true;
    rig.run(MS(100));
    assert_eq!(rig.sent_to(port), [answer(&[0])]);
}
