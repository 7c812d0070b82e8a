//! User-defined recipes on the gateway: bindings, triggers and command tables
//! (docs/engine.md sections 7, 8).

mod rig;

use proto_core::config::*;
use proto_core::engine::{BusState, COMMAND_QUEUE, Input, LinkId, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanId;
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
    // Of the cycle before the start, whatever stands there is told at once; then the grid begins.
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
    // A device that comes back is told where things stand.
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
    assert!(rig.sent_to(port).is_empty(), "nobody asked");
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

/// DI3 going on sends a frame.
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

/// One byte that picks a command, and the reply code with each frame's answer.
fn commands(when: CommandWhen) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume"), (3, "state"), (-1, "pause")]);
    let input = [(T::Char, InputBinding::Commands { table, when })];
    let port = user(&mut cell, &input, &[(T::Byte, OutputBinding::Reply)], SendOn::Frame);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

/// The commands that were sent since the last look.
fn sent(rig: &mut Rig) -> Vec<String> {
    let texts = rig.sent_on(LinkId::COMMAND);
    texts.into_iter().map(|text| String::from_utf8(text).unwrap()).collect()
}

/// The same, of those that have a connection of their own.
fn urgent(rig: &mut Rig) -> Vec<String> {
    let texts = rig.sent_on(LinkId::URGENT);
    texts.into_iter().map(|text| String::from_utf8(text).unwrap()).collect()
}

/// The device goes on sending, and picks nothing.
fn idle(rig: &mut Rig, port: PortId, millis: u64) {
    for _ in 0..millis / 50 {
        rig.bytes(port, &frame(&[0]));
        rig.run(MS(50));
    }
    rig.bytes(port, &frame(&[0]));
    rig.run(MS(millis % 50));
}

#[track_caller]
fn reply(rig: &Rig, port: PortId) -> ReplyCode {
    rig.engine.reply_code(port).unwrap()
}

#[test]
fn a_changed_value_picks_a_command_and_the_first_is_only_a_base() {
    let (mut rig, port) = commands(CommandWhen::Change);
    rig.bytes(port, &frame(&[1]));
    rig.bytes(port, &frame(&[1]));
    assert!(sent(&mut rig).is_empty(), "a value that was there before we were is no order");
    assert_eq!(reply(&rig, port), ReplyCode::None);
    rig.bytes(port, &frame(&[2]));
    assert_eq!(sent(&mut rig), ["resume"]);
    assert_eq!(reply(&rig, port), ReplyCode::Pending);
    rig.bytes(port, &frame(&[2]));
    assert!(sent(&mut rig).is_empty());
    rig.link_bytes(LinkId::COMMAND, b"resume success");
    assert_eq!(reply(&rig, port), ReplyCode::Success);
    rig.sent_to(port);
    rig.bytes(port, &frame(&[2]));
    assert_eq!(rig.sent_to(port), [answer(&[ReplyCode::Success as u8])]);
    rig.bytes(port, &frame(&[0xFF]));
    assert_eq!(urgent(&mut rig), ["pause"]);
    assert!(sent(&mut rig).is_empty(), "it has a connection of its own");
    let counters = rig.counters(port);
    assert_eq!((counters.commands, counters.commands_dropped), (2, 0));
}

#[test]
fn with_every_frame_means_with_every_frame() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    for _ in 0..3 {
        rig.bytes(port, &frame(&[1]));
        assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);
        rig.link_bytes(LinkId::COMMAND, b"run start");
    }
    rig.bytes(port, &frame(&[0]));
    rig.bytes(port, &frame(&[4]));
    assert!(sent(&mut rig).is_empty(), "an unknown value does nothing");
    assert_eq!(rig.counters(port).commands, 3);
    assert_eq!(reply(&rig, port), ReplyCode::Success);
}

#[test]
fn after_silence_the_first_value_is_a_base_again() {
    let (mut rig, port) = commands(CommandWhen::Change);
    rig.bytes(port, &frame(&[0]));
    rig.run(MS(101));
    assert_eq!(rig.counters(port).timeouts, 1);
    rig.bytes(port, &frame(&[1]));
    assert!(sent(&mut rig).is_empty());
    rig.input(Input::PortDown { port });
    rig.input(Input::PortUp { port });
    rig.bytes(port, &frame(&[2]));
    assert!(sent(&mut rig).is_empty(), "a device that came back");
    rig.bytes(port, &frame(&[1]));
    assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);
}

#[test]
fn a_rejected_frame_moves_no_base() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "resume")]);
    let when = CommandWhen::Change;
    let input = [(T::Byte, InputBinding::Commands { table, when }), (T::Float, InputBinding::Unused)];
    let port = user(&mut cell, &input, &[], SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let fields = |byte: u8, float: f32| frame(&[&[byte][..], &float.to_le_bytes()].concat());
    rig.bytes(port, &fields(0, 0.0));
    rig.bytes(port, &fields(1, f32::NAN));
    assert!(sent(&mut rig).is_empty());
    rig.bytes(port, &fields(1, 0.0));
    assert_eq!(sent(&mut rig), ["resume"], "the rejected 1 was no value");
}

#[test]
fn replies_are_understood_however_they_arrive() {
    for (reply_text, code) in [
        (&b"run start"[..], ReplyCode::Success),
        (b"run fail", ReplyCode::Fail),
        (b"unknown command", ReplyCode::Other),
    ] {
        for ending in [&b""[..], b"\r\n", b"\n"] {
            let text = [reply_text, ending].concat();
            for cut in 0..=text.len() {
                let (mut rig, port) = commands(CommandWhen::Frame);
                rig.bytes(port, &frame(&[1]));
                assert_eq!(sent(&mut rig).len(), 1);
                rig.link_bytes(LinkId::COMMAND, &text[..cut]);
                rig.link_bytes(LinkId::COMMAND, &text[cut..]);
                rig.run(MS(150));
                assert_eq!(reply(&rig, port), code, "{:?} cut at {cut}", String::from_utf8_lossy(&text));
                rig.bytes(port, &frame(&[2]));
                assert_eq!(sent(&mut rig), ["resume"], "the next one goes out");
            }
        }
    }
}

#[test]
fn two_replies_in_one_segment_answer_one_command() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.bytes(port, &frame(&[1]));
    rig.bytes(port, &frame(&[2]));
    assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);
    rig.link_bytes(LinkId::COMMAND, b"run startresume fail");
    // The second text came before its command was sent: it cannot be its answer.
    assert_eq!(sent(&mut rig), ["resume"]);
    assert_eq!(reply(&rig, port), ReplyCode::Pending);
    rig.link_bytes(LinkId::COMMAND, b"resume success\r\n");
    assert_eq!(reply(&rig, port), ReplyCode::Success);
    assert_eq!(rig.link(LinkId::COMMAND).counters.malformed, 1);
    assert_eq!(rig.link(LinkId::COMMAND).counters.received, 2);
}

#[test]
fn a_value_reply_is_a_success_too() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.bytes(port, &frame(&[3]));
    assert_eq!(sent(&mut rig), ["state"]);
    for piece in [&b"6:"[..], b"0:5", b":2"] {
        rig.link_bytes(LinkId::COMMAND, piece);
    }
    rig.run(MS(30));
    assert_eq!(reply(&rig, port), ReplyCode::Success);
    let link = rig.link(LinkId::COMMAND);
    assert_eq!((link.counters.sent, link.counters.received, link.counters.malformed), (1, 1, 0));
}

#[test]
fn no_command_is_handed_over_before_the_one_before_it_has_left() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.reports_sent = false;
    for value in [1, 2] {
        rig.bytes(port, &frame(&[value]));
    }
    rig.link_bytes(LinkId::COMMAND, b"run start");
    assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"], "its reply overtakes the transport's report");
    rig.input(Input::LinkSent { link: LinkId::COMMAND });
    assert_eq!(sent(&mut rig), ["resume"]);
}

#[test]
fn the_reply_code_is_that_of_the_newest_command() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.bytes(port, &frame(&[1]));
    rig.bytes(port, &frame(&[2]));
    assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);
    rig.link_bytes(LinkId::COMMAND, b"run start");
    assert_eq!(reply(&rig, port), ReplyCode::Pending, "the newest one has not been answered");
    rig.link_bytes(LinkId::COMMAND, b"resume fail");
    assert_eq!(reply(&rig, port), ReplyCode::Fail);
}

#[test]
fn a_command_for_a_link_that_is_down_is_never_sent() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.reachable.clear();
    rig.input(Input::LinkDown { link: LinkId::COMMAND });
    rig.bytes(port, &frame(&[1]));
    assert_eq!(reply(&rig, port), ReplyCode::NotSent);
    rig.reachable = (0..16).collect();
    rig.run(MS(10_000));
    assert!(rig.link(LinkId::COMMAND).history.connects == 2);
    assert!(sent(&mut rig).is_empty(), "a robot must not start later");
    assert_eq!(rig.counters(port).commands_dropped, 1);
    rig.bytes(port, &frame(&[2]));
    assert_eq!(sent(&mut rig), ["resume"]);
}

#[test]
fn commands_under_way_and_waiting_are_over_when_the_link_is_lost() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    for value in [1, 2, 2] {
        rig.bytes(port, &frame(&[value]));
    }
    rig.input(Input::LinkDown { link: LinkId::COMMAND });
    assert_eq!(reply(&rig, port), ReplyCode::NotSent, "the newest never left");
    assert_eq!(rig.counters(port).commands_dropped, 2);
    rig.run(MS(5_000));
    assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);

    rig.bytes(port, &frame(&[2]));
    rig.input(Input::LinkDown { link: LinkId::COMMAND });
    assert_eq!(reply(&rig, port), ReplyCode::NoReply, "it left, and nobody knows what became of it");
}

#[test]
fn a_command_without_a_reply_reconnects() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.bytes(port, &frame(&[1]));
    rig.link_bytes(LinkId::COMMAND, b"run st");
    rig.log.clear();
    rig.run(MS(9_900));
    assert_eq!(reply(&rig, port), ReplyCode::Pending);
    rig.run(MS(200));
    assert_eq!(reply(&rig, port), ReplyCode::NoReply);
    rig.run(MS(200));
    let actions = rig.take(|out| matches!(out, Out::Open(_) | Out::Close(_)).then(|| out.clone()));
    assert_eq!(actions, [Out::Close(LinkId::COMMAND), Out::Open(LinkId::COMMAND)]);
    assert_eq!(rig.link(LinkId::COMMAND).counters.timeouts, 1);
    assert!(sent(&mut rig).is_empty(), "and is not repeated");
    // The late reply is of a connection that is gone; the next command gets its own.
    rig.bytes(port, &frame(&[2]));
    assert_eq!(sent(&mut rig), ["resume"]);
    rig.link_bytes(LinkId::COMMAND, b"resume success");
    assert_eq!(reply(&rig, port), ReplyCode::Success);
}

#[test]
fn a_command_that_cannot_be_sent_soon_is_dropped() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.bytes(port, &frame(&[1]));
    idle(&mut rig, port, 500);
    rig.bytes(port, &frame(&[2]));
    idle(&mut rig, port, 999);
    assert_eq!(reply(&rig, port), ReplyCode::Pending);
    rig.run(MS(1));
    assert_eq!(reply(&rig, port), ReplyCode::NotSent);
    rig.link_bytes(LinkId::COMMAND, b"run start");
    assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);
    assert_eq!(reply(&rig, port), ReplyCode::NotSent, "of the newest command");
    assert_eq!(rig.counters(port).commands_dropped, 1);
}

#[test]
fn a_full_queue_refuses_the_newest_command() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    for _ in 0..COMMAND_QUEUE + 1 {
        rig.bytes(port, &frame(&[1]));
        assert_eq!(reply(&rig, port), ReplyCode::Pending);
    }
    rig.bytes(port, &frame(&[2]));
    assert_eq!(reply(&rig, port), ReplyCode::NotSent);
    for _ in 0..COMMAND_QUEUE + 1 {
        assert_eq!(sent(&mut rig), ["run(pick.jspf,50)"]);
        rig.link_bytes(LinkId::COMMAND, b"run fail");
    }
    assert!(sent(&mut rig).is_empty(), "the refused one never goes out");
    assert_eq!(reply(&rig, port), ReplyCode::NotSent);
    let counters = rig.counters(port);
    assert_eq!((counters.commands, counters.commands_dropped), (10, 1));
    assert_eq!(rig.link(LinkId::COMMAND).counters.refused, 9);
}

#[test]
fn a_finished_script_answers_nothing() {
    let (mut rig, port) = commands(CommandWhen::Frame);
    rig.bytes(port, &frame(&[2]));
    rig.link_bytes(LinkId::COMMAND, b"script finish");
    rig.run(MS(100));
    assert_eq!(reply(&rig, port), ReplyCode::Pending);
    rig.link_bytes(LinkId::COMMAND, b"script finishresume success");
    assert_eq!(reply(&rig, port), ReplyCode::Success);
}

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
