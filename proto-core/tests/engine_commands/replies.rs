//! Replies of newer controllers, and replies in words that nobody knows (docs/engine.md section 7).

use proto_core::engine::{Input, OtherText};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;

use super::*;

const TABLE: [(i64, i64, &str); 6] = [
    (1, 1, "poweron"),
    (2, 2, "enable"),
    (3, 3, "run(pick.jspf)"),
    (4, 4, "stop"),
    (5, 5, "disable"),
    (6, 6, "poweroff"),
];
const POWERON: u8 = 1;
const ENABLE: u8 = 2;
const RUN: u8 = 3;
const STOP: u8 = 4;
const DISABLE: u8 = 5;
const POWEROFF: u8 = 6;
const NOTHING: u8 = 0;

const COMMAND: LinkId = LinkId::COMMAND;
const URGENT: LinkId = LinkId::URGENT;
const A: PortId = PortId(0);
const B: PortId = PortId(1);

/// Two button boxes; both connections are up, nothing is pressed.
fn panels() -> Rig {
    let mut cell = Cell::new();
    let table = ranges(&mut cell, &TABLE);
    let to = InputBinding::Commands { table, when: CommandWhen::Change };
    for _ in [A, B] {
        panel(&mut cell, &[user_in(ScalarType::Byte, to)]);
        cell.last_port().timeout = MS(60_000);
    }
    let mut rig = cell.rig();
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
    assert_eq!(rig.link(URGENT).state.name(), "shared");
    rig.log.clear();
    rig
}

fn press(rig: &mut Rig, port: PortId, value: u8) {
    rig.bytes(port, &[0xA5, value]);
}

/// The texts handed over since the last look, on both connections.
fn all_sent(rig: &mut Rig) -> Vec<String> {
    let all = [sent(rig, COMMAND), sent(rig, URGENT)].concat();
    all.into_iter().map(|text| text.trim().to_owned()).collect()
}

/// Time passes at a controller that answers as `answer` says, each command 10 ms after it was sent.
/// Returns what it heard.
fn talk(rig: &mut Rig, span: Duration, answer: impl Fn(&str) -> Option<&'static str>) -> Vec<String> {
    let (end, mut heard) = (rig.now + span, Vec::new());
    while rig.now < end {
        let fresh = [COMMAND, URGENT].map(|link| sent(rig, link));
        rig.run(MS(10));
        for (link, texts) in [COMMAND, URGENT].into_iter().zip(fresh) {
            for text in texts {
                let text = text.trim().to_owned();
                if let Some(reply) = answer(&text) {
                    rig.link_bytes(link, reply.as_bytes());
                }
                heard.push(text);
            }
        }
    }
    heard
}

/// A robot that is on and enabled, and whose controller says so.
fn is_on(text: &str) -> Option<&'static str> {
    Some(match text {
        "poweron" => "already poweron",
        "enable" => "already enable",
        "run(pick.jspf)" => "run start",
        "stop" => "stop success",
        "disable" => "disable success",
        _ => "poweroff success",
    })
}

/// One that is off.
fn is_off(text: &str) -> Option<&'static str> {
    Some(match text {
        "disable" => "already disable",
        "poweroff" => "already poweroff",
        _ => "unknown command",
    })
}

/// A controller that speaks in other words of whatever stops the robot.
fn is_foreign(text: &str) -> Option<&'static str> {
    match text {
        "run(pick.jspf)" => Some("run start"),
        "poweron" | "enable" => Some("the arm is ready\r\n"),
        _ => Some("nothing to halt\r\n"),
    }
}

#[track_caller]
fn other_text(rig: &Rig, link: LinkId) -> Option<(Instant, String, Option<String>)> {
    let owned = |other: OtherText<'_>| {
        (other.at, other.text.to_owned(), other.command.map(|command| command.to_string()))
    };
    rig.link(link).other_text.map(owned)
}

fn closed(rig: &mut Rig) -> usize {
    rig.take(|out| matches!(out, Out::Close(_)).then_some(())).len()
}

#[test]
fn the_start_sequence_on_a_robot_that_is_on_starts_the_program() {
    for mut rig in [panels(), shared()] {
        let begun = rig.now;
        let mut heard = Vec::new();
        for value in [POWERON, ENABLE, RUN] {
            press(&mut rig, A, value);
            while reply(&rig, A) == ReplyCode::Pending {
                heard.extend(talk(&mut rig, MS(10), is_on));
                assert!(rig.now < begun + MS(1_000), "{heard:?}");
            }
            assert_eq!(reply(&rig, A), ReplyCode::Success);
        }
        assert_eq!(heard, ["poweron", "enable", "run(pick.jspf)"]);
        assert!(rig.now <= begun + MS(100), "three replies of 10 ms");
        // And all at once, from a device that waits for nothing.
        for value in [POWERON, ENABLE, RUN] {
            press(&mut rig, B, value);
        }
        assert_eq!(talk(&mut rig, MS(100), is_on), ["poweron", "enable", "run(pick.jspf)"]);
        assert_eq!((reply(&rig, B), closed(&mut rig)), (ReplyCode::Success, 0));
        let counters = rig.counters(B);
        assert_eq!((counters.commands, counters.commands_dropped), (3, 0));
        assert_eq!(other_text(&rig, COMMAND), None);
        assert_eq!((rig.link(COMMAND).counters.malformed, rig.link(COMMAND).counters.refused), (0, 0));
    }
}

#[test]
fn what_is_off_already_is_done_and_costs_no_other_command() {
    for mut rig in [panels(), shared()] {
        for value in [DISABLE, POWEROFF] {
            // The device holds it.
            press(&mut rig, A, value);
            assert_eq!(talk(&mut rig, MS(20), is_off).len(), 1);
            assert_eq!(reply(&rig, A), ReplyCode::Success);
            press(&mut rig, B, RUN);
            assert_eq!(talk(&mut rig, MS(20), is_on), ["run(pick.jspf)"], "at once");
            press(&mut rig, B, NOTHING);
        }
        let again = talk(&mut rig, MS(30_000), is_off);
        assert_eq!((again, closed(&mut rig)), (vec![], 0));
        assert_eq!((rig.counters(A).commands_dropped, rig.counters(B).commands_dropped), (0, 0));
    }
}

#[test]
fn one_that_is_pressed_twice_is_sent_twice_and_both_are_done() {
    for mut rig in [panels(), shared()] {
        for value in [DISABLE, NOTHING, DISABLE] {
            press(&mut rig, A, value);
        }
        press(&mut rig, B, DISABLE);
        press(&mut rig, B, RUN);
        let heard =
            talk(&mut rig, MS(100), |text| if text == "disable" { is_off(text) } else { is_on(text) });
        assert_eq!(heard, ["disable", "disable", "disable", "run(pick.jspf)"]);
        assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::Success, ReplyCode::Success));
        assert_eq!((rig.counters(B).commands_dropped, closed(&mut rig)), (0, 0));
    }
}

#[test]
fn two_urgent_ones_on_one_connection_get_their_own_replies() {
    for [first, second] in [["already disable", "already poweroff"], ["already poweroff", "already disable"]]
    {
        let text = [first, second].concat();
        for cut in 0..=text.len() {
            let mut rig = shared();
            press(&mut rig, A, DISABLE);
            press(&mut rig, B, POWEROFF);
            assert_eq!(all_sent(&mut rig), ["disable", "poweroff"]);
            rig.link_bytes(COMMAND, &text.as_bytes()[..cut]);
            if cut == first.len() {
                let (done, open) = (ReplyCode::Success, ReplyCode::Pending);
                let expected = if first == "already disable" { (done, open) } else { (open, done) };
                assert_eq!((reply(&rig, A), reply(&rig, B)), expected);
            }
            rig.link_bytes(COMMAND, &text.as_bytes()[cut..]);
            assert_eq!((reply(&rig, A), reply(&rig, B)), (ReplyCode::Success, ReplyCode::Success), "{cut}");
            assert_eq!(rig.link(COMMAND).counters.malformed, 0);
        }
    }
}

#[test]
fn a_failure_in_other_words_is_a_failure() {
    let mut rig = panels();
    press(&mut rig, A, ENABLE);
    rig.link_bytes(COMMAND, b"enable error: brake 3\r\n");
    assert_eq!(reply(&rig, A), ReplyCode::Fail);
    assert_eq!(rig.link(COMMAND).counters.refused, 1);
    press(&mut rig, A, RUN);
    rig.link_bytes(COMMAND, b"script error");
    assert_eq!(reply(&rig, A), ReplyCode::Fail);
    // A stop that failed is over, although its device still asks for it.
    press(&mut rig, A, STOP);
    rig.link_bytes(URGENT, b"Error: cannot stop\r\n");
    assert_eq!(reply(&rig, A), ReplyCode::Fail);
    all_sent(&mut rig);
    rig.run(MS(30_000));
    assert_eq!((all_sent(&mut rig), closed(&mut rig)), (vec![], 0));
    assert_eq!(other_text(&rig, COMMAND), None);
}

#[test]
fn other_words_are_told_and_end_neither_command_nor_connection() {
    for (make, value, link, text) in [
        (panels as fn() -> Rig, POWERON, COMMAND, "poweron"),
        (panels, STOP, URGENT, "stop"),
        (shared, DISABLE, COMMAND, "disable"),
    ] {
        for silence in [false, true] {
            let mut rig = make();
            press(&mut rig, A, value);
            assert_eq!(all_sent(&mut rig), [text]);
            rig.run(MS(5));
            rig.link_bytes(link, if silence { b"the arm rests" } else { b"the arm rests\r\n" });
            let heard = if silence { rig.now + MS(20) } else { rig.now };
            rig.run(MS(9_900));
            assert_eq!(reply(&rig, A), ReplyCode::Pending);
            assert_eq!(rig.link(link).counters.malformed, 1);
            let told = (heard, "the arm rests".to_owned(), Some(text.to_owned()));
            assert_eq!(other_text(&rig, link), Some(told));
            assert_eq!((all_sent(&mut rig), closed(&mut rig)), (vec![], 0));
            // Its reply still counts.
            rig.link_bytes(link, format!("{text} success").as_bytes());
            assert_eq!(reply(&rig, A), ReplyCode::Success);
            rig.run(MS(20_000));
            assert_eq!((all_sent(&mut rig), closed(&mut rig)), (vec![], 0));
        }
    }
}

#[test]
fn a_stop_that_was_answered_in_other_words_is_not_sent_again() {
    // The time is up, or the connection is lost before.
    for lost in [None, Some(MS(100)), Some(MS(5_000))] {
        for (mut rig, link) in [(panels(), URGENT), (shared(), COMMAND)] {
            for value in [STOP, DISABLE, POWEROFF] {
                let text = TABLE[usize::from(value) - 1].2;
                press(&mut rig, A, value);
                let begun = rig.now;
                assert_eq!(talk(&mut rig, MS(20), is_foreign), [text]);
                assert_eq!(closed(&mut rig), 0);
                match lost {
                    None => rig.run(MS(10_000 - 20)),
                    Some(after) => {
                        rig.run(after);
                        rig.input(Input::LinkDown { link });
                    }
                }
                assert_eq!(
                    reply(&rig, A),
                    ReplyCode::Other,
                    "{text} after {:?}",
                    rig.now.saturating_since(begun)
                );
                assert_eq!(closed(&mut rig), usize::from(lost.is_none()));
                // Although the device still asks for it.
                rig.run(MS(15_000));
                assert_eq!((all_sent(&mut rig), closed(&mut rig)), (vec![], 0));
                let counters = rig.counters(A);
                assert_eq!(counters.commands_dropped, 0);
            }
        }
    }
}

#[test]
fn without_any_words_it_is_sent_again() {
    let mut rig = panels();
    press(&mut rig, A, STOP);
    assert_eq!(all_sent(&mut rig), ["stop"]);
    // A late reply to something else, and the end of a program, say nothing about it.
    rig.link_bytes(URGENT, b"run startscript finish");
    rig.input(Input::LinkDown { link: URGENT });
    assert_eq!(all_sent(&mut rig), ["stop"]);
    // Nor does what was on its way before it had arrived.
    let mut rig = panels();
    rig.acknowledges = false;
    press(&mut rig, A, STOP);
    rig.link_bytes(URGENT, b"welcome\r\n");
    rig.input(Input::LinkDown { link: URGENT });
    assert_eq!(all_sent(&mut rig), ["stop", "stop"].map(str::to_owned));
    assert_eq!(other_text(&rig, URGENT).unwrap().1, "welcome");
}

#[test]
fn a_stop_that_was_answered_in_other_words_delays_no_other_command() {
    let mut rig = panels();
    for _ in 0..5 {
        press(&mut rig, A, STOP);
        assert_eq!(talk(&mut rig, MS(20), is_foreign), ["stop"]);
        press(&mut rig, A, RUN);
        assert_eq!(talk(&mut rig, MS(20), is_foreign), ["run(pick.jspf)"]);
        assert_eq!(reply(&rig, A), ReplyCode::Success);
        // The end of its time closes its own connection only.
        rig.run(MS(11_000));
        assert_eq!(rig.link(URGENT).state.name(), "up");
    }
    assert_eq!((rig.counters(A).commands, rig.counters(A).commands_dropped), (10, 0));
    assert_eq!(rig.link(COMMAND).history.losses, 0);
    // As long as it is not answered at all, nothing else is sent.
    press(&mut rig, A, STOP);
    press(&mut rig, A, RUN);
    assert_eq!(talk(&mut rig, MS(2_000), |_| None), ["stop"]);
    assert_eq!(reply(&rig, A), ReplyCode::NotSent);
}

#[test]
fn a_start_that_was_answered_in_other_words_holds_back_what_follows() {
    let mut rig = panels();
    press(&mut rig, A, POWERON);
    press(&mut rig, A, ENABLE);
    assert_eq!(talk(&mut rig, MS(500), is_foreign), ["poweron"], "nobody knows whether the arm has power");
    rig.run(MS(600));
    assert_eq!(reply(&rig, A), ReplyCode::NotSent);
    press(&mut rig, A, STOP);
    assert_eq!(all_sent(&mut rig), ["stop"], "a stop does not wait");
    rig.link_bytes(URGENT, b"stop success");
    rig.run(MS(9_000));
    assert_eq!(closed(&mut rig), 1, "after 10 s without a reply");
    press(&mut rig, A, ENABLE);
    assert_eq!(talk(&mut rig, MS(100), is_on), ["enable"]);
    assert_eq!(reply(&rig, A), ReplyCode::Success);
}

#[test]
fn the_newest_words_are_kept_with_and_without_a_command() {
    let mut rig = panels();
    rig.link_bytes(COMMAND, b"welcome\r\n");
    assert_eq!(other_text(&rig, COMMAND), Some((rig.now, "welcome".into(), None)));
    rig.link_bytes(COMMAND, b"stop success");
    assert_eq!(other_text(&rig, COMMAND).map(|other| other.1).as_deref(), Some("stop success"));
    press(&mut rig, A, POWERON);
    rig.link_bytes(COMMAND, &[b'x'; 200]);
    rig.run(MS(20));
    let (_, text, command) = other_text(&rig, COMMAND).unwrap();
    assert_eq!((text, command.as_deref()), ("x".repeat(48), Some("poweron")), "cut");
    assert_eq!(other_text(&rig, URGENT), None);
    // It stays over the loss of the connection, for whoever looks later.
    rig.input(Input::LinkDown { link: COMMAND });
    rig.run(MS(1_000));
    assert_eq!(other_text(&rig, COMMAND).unwrap().1.len(), 48);
}
