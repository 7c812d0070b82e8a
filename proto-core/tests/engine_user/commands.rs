//! Command tables: which value picks a command, and what becomes of its reply.

use proto_core::config::*;
use proto_core::engine::{COMMAND_QUEUE, Input, LinkId, PortId, ReplyCode};
use proto_core::wire::scalar::ScalarType as T;

use super::rig::*;
use super::{answer, frame, sent, user};

/// One byte picks a command; each frame is answered with the reply code.
fn commands(when: CommandWhen) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume"), (3, "state"), (-1, "pause")]);
    let input = [(T::Char, InputBinding::Commands { table, when })];
    let port = user(&mut cell, &input, &[(T::Byte, OutputBinding::Reply)], SendOn::Frame);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

/// The same for urgent commands, which have a connection of their own.
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
    assert!(sent(&mut rig).is_empty(), "a value that was there before the start is no command");
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
fn with_when_frame_each_frame_picks_a_command() {
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
fn commands_in_flight_and_waiting_end_with_their_link() {
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
    assert_eq!(reply(&rig, port), ReplyCode::NoReply, "it was sent, and its outcome is unknown");
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
    // A late reply belongs to the old connection; the next command gets its own.
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
