//! Stopping never waits: urgent commands go ahead of everything, by a connection of their own where
//! the controller takes one (docs/engine.md section 7, docs/wire/command.md, D26).

mod crowded;
#[path = "../rig/mod.rs"]
mod rig;
mod sharing;

use std::collections::BTreeMap;

use proto_core::command::{CommandServer, ServerEvent};
use proto_core::config::*;
use proto_core::engine::{COMMAND_QUEUE, Input, LinkId, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::time::Instant;
use proto_core::wire::scalar::ScalarType;
use rig::*;

const TABLE: [(i64, &str); 8] = [
    (1, "run(pick.jspf,50)"),
    (2, "resume"),
    (3, "stop"),
    (4, "pause"),
    (5, "disable"),
    (6, "poweroff"),
    (7, "state"),
    (8, "getlasterror"),
];
const RUN: u8 = 1;
const RESUME: u8 = 2;
const STOP: u8 = 3;
const PAUSE: u8 = 4;
const DISABLE: u8 = 5;
const NOTHING: u8 = 0;

const COMMAND: LinkId = LinkId::COMMAND;
const URGENT: LinkId = LinkId::URGENT;
const A: PortId = PortId(0);
const B: PortId = PortId(1);

/// Two button boxes with the same table, that act when their value changes.
fn cell(when: CommandWhen) -> Cell {
    let mut cell = Cell::new();
    let table = cell.commands(&TABLE);
    for _ in [A, B] {
        let fields = cell.fields([user_in(ScalarType::Byte, InputBinding::Commands { table, when })]);
        let input = cell.part(&[255, 255], &[238, 238], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
        cell.rs485(recipe);
        cell.last_port().timeout = MS(60_000);
    }
    cell
}

/// Both connections are up, nothing is pressed.
fn panels() -> Rig {
    let mut rig = cell(CommandWhen::Change).rig();
    rig.run(MS(10));
    press(&mut rig, A, NOTHING);
    press(&mut rig, B, NOTHING);
    rig
}

/// The same with a controller that takes one client, some time after that was found out.
fn shared() -> Rig {
    let mut rig = panels();
    rig.reachable.remove(&URGENT.0);
    rig.input(Input::LinkDown { link: URGENT });
    rig.run(MS(20_000));
    assert_eq!(state(&rig, URGENT), "shared");
    rig.log.clear();
    rig
}

fn press(rig: &mut Rig, port: PortId, value: u8) {
    rig.bytes(port, &[255, 255, value, 238, 238]);
}

#[track_caller]
fn reply(rig: &Rig, port: PortId) -> ReplyCode {
    rig.engine.reply_code(port).unwrap()
}

fn state(rig: &Rig, link: LinkId) -> &'static str {
    rig.link(link).state.name()
}

/// Texts that were handed over to a link since the last look, without what ends the one before.
fn sent(rig: &mut Rig, link: LinkId) -> Vec<String> {
    let texts = rig.sent_on(link).into_iter().map(|text| String::from_utf8(text).unwrap());
    texts.map(|text| text.trim().to_owned()).collect()
}

fn down(rig: &mut Rig, link: LinkId) {
    rig.input(Input::LinkDown { link });
}

/// No connection to port 2000.
fn unplug(rig: &mut Rig) {
    rig.reachable.clear();
    down(rig, COMMAND);
    down(rig, URGENT);
    rig.log.clear();
}

fn plug(rig: &mut Rig) {
    rig.reachable = (0..16).collect();
}

#[test]
fn the_second_connection_is_there_when_something_can_stop() {
    for (_, text) in TABLE {
        let mut cell = Cell::new();
        let table = cell.commands(&[(1, text)]);
        let to = InputBinding::Commands { table, when: CommandWhen::Change };
        let fields = cell.fields([user_in(ScalarType::Byte, to)]);
        let input = cell.part(&[255, 255], &[238, 238], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
        cell.rs485(recipe);
        let mut rig = cell.rig();
        let is_urgent = ["stop", "pause", "disable", "poweroff"].contains(&text);
        let links: Vec<LinkId> = rig.engine.links().map(|link| link.id).collect();
        assert_eq!(links == [COMMAND, URGENT], is_urgent, "{text}");
        rig.run(MS(1));
        let opened = rig.take(|out| matches!(out, Out::Open(_)).then_some(()));
        assert_eq!(opened.len(), links.len(), "opened together");
    }
}

// What goes first.

#[test]
fn each_kind_goes_over_its_own_connection_beside_an_unanswered_run() {
    for (value, text) in TABLE.into_iter().skip(2).take(4) {
        let mut rig = panels();
        press(&mut rig, A, RUN);
        assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)"]);
        rig.run(MS(5));
        press(&mut rig, B, value as u8);
        assert_eq!(sent(&mut rig, URGENT), [text], "in the same pass");
        assert!(sent(&mut rig, COMMAND).is_empty());
        rig.link_bytes(URGENT, format!("{text} success").as_bytes());
        assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::Pending, ReplyCode::Success));
        rig.link_bytes(COMMAND, b"run start");
        assert_eq!(reply(&rig, A), ReplyCode::Success);
        assert_eq!(rig.closed(), [], "what the controller has is not taken back");
    }
}

#[test]
fn what_waits_is_dropped_and_its_port_is_told() {
    let mut rig = panels();
    press(&mut rig, A, RUN);
    press(&mut rig, A, RESUME);
    press(&mut rig, A, RUN);
    press(&mut rig, B, RESUME);
    rig.log.clear();
    press(&mut rig, B, STOP);
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::NotSent, ReplyCode::Pending));
    assert_eq!((rig.counters(A).commands_dropped, rig.counters(B).commands_dropped), (2, 1));
    rig.link_bytes(URGENT, b"stop success");
    rig.link_bytes(COMMAND, b"run start");
    rig.run(MS(2_000));
    assert!(sent(&mut rig, COMMAND).is_empty(), "they are gone");
    assert_eq!(reply(&rig, B), ReplyCode::Success);
}

#[test]
fn a_full_queue_is_no_matter() {
    let mut rig = cell(CommandWhen::Frame).rig();
    rig.run(MS(10));
    for _ in 0..COMMAND_QUEUE + 3 {
        press(&mut rig, A, RUN);
    }
    rig.log.clear();
    press(&mut rig, A, STOP);
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    assert_eq!(rig.counters(A).commands_dropped as usize, COMMAND_QUEUE + 2);
}

#[test]
fn in_one_chunk_only_what_came_before_it_is_dropped() {
    let mut rig = panels();
    press(&mut rig, A, RUN);
    rig.log.clear();
    let frames = [RESUME, RUN, STOP, RUN].map(|value| [255, 255, value, 238, 238]);
    rig.bytes(A, &frames.concat());
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    assert_eq!(rig.counters(A).commands_dropped, 2);
    assert_eq!(reply(&rig, A), ReplyCode::Pending);
    rig.link_bytes(COMMAND, b"run start");
    rig.link_bytes(URGENT, b"stop success");
    assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)"], "the one that was asked for after it");
}

#[test]
fn nothing_else_is_sent_while_it_is_unanswered() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    press(&mut rig, B, RUN);
    rig.run(MS(500));
    assert!(sent(&mut rig, COMMAND).is_empty());
    rig.link_bytes(URGENT, b"stop fail");
    assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)"]);
    assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::Fail, ReplyCode::Pending));
}

#[test]
fn what_waits_for_it_too_long_is_dropped() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    press(&mut rig, B, RUN);
    rig.run(MS(999));
    assert_eq!(reply(&rig, B), ReplyCode::Pending);
    rig.run(MS(1));
    assert_eq!(reply(&rig, B), ReplyCode::NotSent);
    rig.link_bytes(URGENT, b"stop success");
    assert!(sent(&mut rig, COMMAND).is_empty());
}

#[test]
fn a_run_that_could_overtake_it_goes_with_its_connection() {
    let mut rig = panels();
    rig.acknowledges = false;
    press(&mut rig, A, RUN);
    rig.run(MS(5));
    press(&mut rig, B, STOP);
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    assert_eq!(rig.closed(), [(rig.now, COMMAND)]);
    assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::NoReply, ReplyCode::Pending));
    let closed = rig.now;
    rig.acked(URGENT, 0);
    rig.log.clear();
    rig.run(MS(200));
    let opened: Vec<Instant> =
        rig.log.iter().filter(|(_, out)| *out == Out::Open(COMMAND)).map(|&(at, _)| at).collect();
    assert_eq!(opened, [closed + MS(100)]);
    assert_eq!(rig.link(COMMAND).counters.unacknowledged, 0, "it was not late");
}

#[test]
fn one_that_the_transport_has_not_even_taken_goes_too() {
    let mut rig = panels();
    rig.reports_sent = false;
    press(&mut rig, A, RUN);
    press(&mut rig, B, STOP);
    assert_eq!(rig.closed(), [(rig.now, COMMAND)]);
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
}

#[test]
fn half_a_run_that_is_acknowledged_could_overtake_it() {
    let mut rig = panels();
    rig.acknowledges = false;
    press(&mut rig, A, RUN);
    rig.acked(COMMAND, 1);
    press(&mut rig, B, STOP);
    assert_eq!(rig.closed(), [(rig.now, COMMAND)]);
}

#[test]
fn another_urgent_command_cannot_overtake_it() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    rig.acknowledges = false;
    press(&mut rig, B, PAUSE);
    assert_eq!(sent(&mut rig, COMMAND), ["pause"], "the other connection is busy");
    rig.link_bytes(URGENT, b"stop success");
    press(&mut rig, A, DISABLE);
    assert_eq!(sent(&mut rig, URGENT), ["stop", "disable"]);
    assert_eq!(rig.closed(), [], "it may go on stopping the robot");
    rig.link_bytes(COMMAND, b"pause success");
    assert_eq!(reply(&rig, B), ReplyCode::Success);
}

// Without a second connection.

#[test]
fn it_does_not_wait_behind_its_like_that_nobody_answers() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    rig.run(MS(500));
    press(&mut rig, A, NOTHING);
    press(&mut rig, A, STOP);
    rig.run(MS(499));
    assert_eq!(sent(&mut rig, COMMAND), Vec::<String>::new(), "the first one may still be answered");
    rig.run(MS(251));
    assert_eq!(sent(&mut rig, COMMAND), ["stop"], "somebody may have started the robot since");
    rig.link_bytes(COMMAND, b"stop success");
    assert_eq!(reply(&rig, A), ReplyCode::Success);
}

#[test]
fn while_the_second_connection_is_down_it_goes_over_the_first_at_once() {
    let mut rig = panels();
    rig.reachable.remove(&URGENT.0);
    down(&mut rig, URGENT);
    press(&mut rig, A, RUN);
    press(&mut rig, B, STOP);
    assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)", "stop"], "beside the unanswered run");
    assert_eq!(rig.closed(), [], "it cannot overtake what is before it");
}

#[test]
fn while_the_second_connection_is_opening_it_goes_over_the_first_at_once() {
    let mut rig = panels();
    rig.unanswered.insert(URGENT.0);
    down(&mut rig, URGENT);
    rig.run(MS(500));
    assert_eq!(state(&rig, URGENT), "opening");
    press(&mut rig, A, STOP);
    assert_eq!(sent(&mut rig, COMMAND), ["stop"]);
    // Nor does it go twice when that is up.
    rig.input(Input::LinkUp { link: URGENT });
    rig.run(MS(100));
    assert!(sent(&mut rig, URGENT).is_empty());
}

#[test]
fn replies_are_told_apart_by_their_keywords_in_both_orders() {
    for (first, second) in [("run start", "stop success"), ("stop success", "run start")] {
        for ending in ["", "\r\n"] {
            let text = [first, ending, second, ending].concat();
            for cut in 0..=text.len() {
                let mut rig = shared();
                press(&mut rig, A, RUN);
                press(&mut rig, B, STOP);
                rig.link_bytes(COMMAND, &text.as_bytes()[..cut]);
                rig.link_bytes(COMMAND, &text.as_bytes()[cut..]);
                let codes = (reply(&rig, A), reply(&rig, B));
                assert_eq!(codes, (ReplyCode::Success, ReplyCode::Success), "{text:?} cut at {cut}");
                let counters = rig.link(COMMAND).counters;
                assert_eq!((counters.received, counters.malformed), (2, 0));
            }
        }
    }
}

#[test]
fn an_answer_to_one_of_them_leaves_the_other_open() {
    for (text, expected) in [
        ("run fail", (ReplyCode::Fail, ReplyCode::Pending)),
        ("stop fail", (ReplyCode::Pending, ReplyCode::Fail)),
        // Nobody knows whose it is: that of the older.
        ("unknown command", (ReplyCode::Other, ReplyCode::Pending)),
        ("pause success", (ReplyCode::Pending, ReplyCode::Pending)),
        ("script finish", (ReplyCode::Pending, ReplyCode::Pending)),
    ] {
        let mut rig = shared();
        press(&mut rig, A, RUN);
        press(&mut rig, B, STOP);
        rig.log.clear();
        rig.link_bytes(COMMAND, text.as_bytes());
        assert_eq!((reply(&rig, A), reply(&rig, B)), expected, "{text}");
        press(&mut rig, A, RESUME);
        rig.run(MS(100));
        assert!(sent(&mut rig, COMMAND).is_empty(), "nothing is sent before both are answered");
    }
}

#[test]
fn the_controller_understands_both_however_close_they_come() {
    for dialect in ["v2.3", "v2.6"] {
        for (value, text) in TABLE.into_iter().filter(|(value, _)| !(3..=6).contains(value)) {
            let mut cell = cell(CommandWhen::Change);
            cell.0.controller.dialect = heapless::String::try_from(dialect).unwrap();
            let mut rig = cell.rig();
            rig.reachable.remove(&URGENT.0);
            rig.run(MS(10));
            press(&mut rig, A, NOTHING);
            press(&mut rig, B, NOTHING);
            press(&mut rig, A, value as u8);
            press(&mut rig, B, STOP);
            // TCP may deliver them as one piece.
            let bytes = rig.sent_on(COMMAND).concat();
            let (mut server, mut rest, mut heard) = (CommandServer::new(), &bytes[..], Vec::new());
            for now in [0, 1_000] {
                while let Some(event) = server.receive(Instant::from_millis(now), &mut rest) {
                    let ServerEvent::Request(request) = event else { panic!("{bytes:?}: {event:?}") };
                    heard.push(request.keyword().word());
                }
            }
            let expected = text.split('(').next().unwrap();
            assert_eq!(heard, [expected, "stop"], "{dialect}");
        }
    }
}

#[test]
fn one_goes_beside_and_the_next_when_that_is_answered() {
    let mut rig = shared();
    press(&mut rig, A, RUN);
    press(&mut rig, B, STOP);
    press(&mut rig, B, PAUSE);
    press(&mut rig, B, DISABLE);
    assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)", "stop"]);
    rig.link_bytes(COMMAND, b"stop success");
    assert_eq!(sent(&mut rig, COMMAND), ["pause"], "in the order of being asked for");
    rig.link_bytes(COMMAND, b"pause success");
    assert_eq!(sent(&mut rig, COMMAND), ["disable"]);
    assert_eq!(reply(&rig, B), ReplyCode::Pending);
    rig.link_bytes(COMMAND, b"disable success");
    assert_eq!(reply(&rig, B), ReplyCode::Success);
}

#[test]
fn it_waits_for_a_transport_that_is_full() {
    let mut rig = shared();
    rig.reports_sent = false;
    press(&mut rig, A, RUN);
    press(&mut rig, B, STOP);
    assert_eq!(sent(&mut rig, COMMAND), ["run(pick.jspf,50)"]);
    rig.input(Input::LinkSent { link: COMMAND });
    assert_eq!(sent(&mut rig, COMMAND), ["stop"]);
}

// While it is asked for.

#[test]
fn it_waits_as_long_as_it_is_asked_for() {
    for first in [COMMAND, URGENT] {
        let mut rig = panels();
        unplug(&mut rig);
        press(&mut rig, A, STOP);
        for _ in 0..300 {
            rig.run(MS(1_000));
            press(&mut rig, A, STOP);
            assert_eq!(reply(&rig, A), ReplyCode::Pending);
        }
        rig.reachable.insert(first.0);
        rig.run(MS(6_000));
        assert_eq!(sent(&mut rig, first), ["stop"], "after five minutes");
        rig.link_bytes(first, b"stop success");
        assert_eq!(reply(&rig, A), ReplyCode::Success);
        plug(&mut rig);
        rig.run(MS(10_000));
        assert!(sent(&mut rig, COMMAND).is_empty() && sent(&mut rig, URGENT).is_empty(), "once");
        assert_eq!((rig.counters(A).commands, rig.counters(A).commands_dropped), (1, 0));
    }
}

#[test]
fn a_link_that_is_lost_before_the_reply_has_it_sent_again() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    rig.run(MS(300));
    down(&mut rig, URGENT);
    assert_eq!(sent(&mut rig, COMMAND), ["stop"], "at once by the other");
    rig.run(MS(1_500));
    down(&mut rig, COMMAND);
    assert_eq!(sent(&mut rig, URGENT), ["stop"], "which is up again");
    unplug(&mut rig);
    assert_eq!(reply(&rig, A), ReplyCode::Pending);
    rig.run(MS(30_000));
    plug(&mut rig);
    rig.run(MS(6_000));
    let all = [sent(&mut rig, COMMAND), sent(&mut rig, URGENT)].concat();
    assert_eq!(all, ["stop"]);
    assert_eq!((rig.counters(A).commands, rig.counters(A).commands_dropped), (1, 0));
}

#[test]
fn one_that_is_not_asked_for_any_more_is_not_sent_again() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    press(&mut rig, A, NOTHING);
    rig.log.clear();
    down(&mut rig, URGENT);
    assert_eq!(reply(&rig, A), ReplyCode::NoReply);
    rig.run(MS(10_000));
    assert!(sent(&mut rig, COMMAND).is_empty() && sent(&mut rig, URGENT).is_empty());
}

#[test]
fn a_button_that_is_released_is_remembered_for_a_second() {
    let mut rig = panels();
    unplug(&mut rig);
    press(&mut rig, A, STOP);
    rig.run(MS(5_000));
    press(&mut rig, A, NOTHING);
    rig.run(MS(999));
    assert_eq!(reply(&rig, A), ReplyCode::Pending);
    rig.run(MS(1));
    assert_eq!((reply(&rig, A), rig.counters(A).commands_dropped), (ReplyCode::NotSent, 1));
    plug(&mut rig);
    rig.run(MS(10_000));
    assert!(sent(&mut rig, COMMAND).is_empty() && sent(&mut rig, URGENT).is_empty());

    // Within that second it is sent.
    let mut rig = panels();
    unplug(&mut rig);
    plug(&mut rig);
    press(&mut rig, A, STOP);
    press(&mut rig, A, NOTHING);
    rig.run(MS(100));
    let all = [sent(&mut rig, COMMAND), sent(&mut rig, URGENT)].concat();
    assert_eq!(all, ["stop"]);
}

#[test]
fn a_button_that_is_pressed_again_counts_anew() {
    let mut rig = panels();
    unplug(&mut rig);
    for _ in 0..20 {
        press(&mut rig, A, STOP);
        rig.run(MS(400));
        press(&mut rig, A, NOTHING);
        rig.run(MS(400));
    }
    assert_eq!(reply(&rig, A), ReplyCode::Pending);
    plug(&mut rig);
    press(&mut rig, A, STOP);
    rig.run(MS(6_000));
    let all = [sent(&mut rig, COMMAND), sent(&mut rig, URGENT)].concat();
    assert_eq!(all, ["stop"], "one waits");
    assert_eq!((rig.counters(A).commands, rig.counters(A).commands_dropped), (21, 0));
    let link =
        if state(&rig, URGENT) == "up" && rig.link(URGENT).counters.sent > 0 { URGENT } else { COMMAND };
    rig.link_bytes(link, b"stop success");
    assert_eq!(reply(&rig, A), ReplyCode::Success, "of the newest");
}

#[test]
fn one_of_each_kind_and_port_waits() {
    let mut rig = panels();
    unplug(&mut rig);
    for value in [STOP, PAUSE, STOP] {
        press(&mut rig, A, value);
    }
    press(&mut rig, B, STOP);
    plug(&mut rig);
    let mut heard: BTreeMap<String, u32> = BTreeMap::new();
    for _ in 0..40 {
        rig.run(MS(20));
        for link in [COMMAND, URGENT] {
            for text in sent(&mut rig, link) {
                rig.link_bytes(link, format!("{text} success").as_bytes());
                *heard.entry(text).or_default() += 1;
            }
        }
    }
    assert_eq!(heard, BTreeMap::from([("pause".to_owned(), 1), ("stop".to_owned(), 2)]));
    assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::Success, ReplyCode::Success));
}

#[test]
fn with_every_frame_one_is_under_way_and_one_waits() {
    let mut rig = cell(CommandWhen::Frame).rig();
    rig.run(MS(10));
    for _ in 0..100 {
        press(&mut rig, A, STOP);
        rig.run(MS(4));
    }
    assert_eq!(sent(&mut rig, URGENT), ["stop"]);
    rig.link_bytes(URGENT, b"stop success");
    assert_eq!(sent(&mut rig, URGENT), ["stop"], "the newest");
    rig.link_bytes(URGENT, b"stop success");
    assert!(sent(&mut rig, URGENT).is_empty());
    assert_eq!((rig.counters(A).commands, rig.counters(A).commands_dropped), (100, 0));
}

#[test]
fn without_a_reply_for_10_s_it_is_sent_again_if_it_is_asked_for() {
    for (value, again) in [(STOP, true), (NOTHING, false)] {
        let mut rig = panels();
        press(&mut rig, A, STOP);
        let at = rig.now;
        press(&mut rig, A, value);
        rig.log.clear();
        rig.run(MS(9_999));
        assert_eq!((rig.closed(), reply(&rig, A)), (vec![], ReplyCode::Pending));
        rig.run(MS(1));
        assert_eq!(rig.closed(), [(at + MS(10_000), URGENT)]);
        assert_eq!(rig.link(URGENT).counters.timeouts, 1);
        assert_eq!(sent(&mut rig, COMMAND).len(), usize::from(again));
        assert_eq!(reply(&rig, A), if again { ReplyCode::Pending } else { ReplyCode::NoReply });
    }
}
