//! Modbus requests that are answered late, wrong or not at all.

use proto_core::engine::{Input, LinkId};
use proto_core::modbus::Exception;
use proto_core::wire::scalar::Scalar;

use super::rig::*;
use super::{Full, actions};

#[test]
fn a_reset_in_the_middle_of_an_answer_loses_only_that_answer() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.sent_on(LinkId::MODBUS);
    let (bits, word) = full.plc();
    full.rig.run(MS(4));
    let request = full.rig.sent_on(LinkId::MODBUS).remove(0);
    let answer = full.rig.answer(&request);
    for cut in 0..answer.len() {
        full.rig.map.written.clear();
        full.rig.link_bytes(LinkId::MODBUS, &answer[..cut]);
        full.rig.input(Input::LinkDown { link: LinkId::MODBUS });
        // The rest belongs to the old connection.
        full.rig.link_bytes(LinkId::MODBUS, &answer[cut..]);
        full.rig.modbus_answers = true;
        full.live(6_000);
        assert_eq!(full.rig.link(LinkId::MODBUS).counters.malformed, 0);
        full.assert_all_gets_through();
        full.rig.modbus_answers = false;
        full.rig.run(MS(4));
    }
    assert!(full.bits.contains(&bits) && full.words.contains(&word));
}

#[test]
fn three_requests_without_an_answer_reopen_the_link() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.run(MS(4));
    full.rig.log.clear();
    for _ in 0..30 {
        full.plc();
        full.rig.run(MS(49));
    }
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 2, "one transaction in flight at a time");
    let before = full.rig.link(LinkId::MODBUS).counters.timeouts;
    assert_eq!(before, 2);
    full.rig.run(MS(40));
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.timeouts, 3);
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["close"]);
    full.rig.modbus_answers = true;
    full.rig.run(MS(100));
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["open"]);
    full.assert_all_gets_through();
    assert_eq!(full.rig.link(LinkId::MODBUS).history.losses, 1);
}

#[test]
fn no_request_is_handed_over_before_the_one_before_it_has_left() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.log.clear();
    full.rig.modbus_answers = false;
    full.rig.reports_sent = false;
    // A poll is due.
    full.rig.run(MS(8));
    let requests = full.rig.sent_on(LinkId::MODBUS);
    assert_eq!(requests.len(), 1);
    // The answer comes before the transport's report.
    let answer = full.rig.answer(&requests[0]);
    full.rig.link_bytes(LinkId::MODBUS, &answer);
    full.plc();
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 0);
    full.rig.input(Input::LinkSent { link: LinkId::MODBUS });
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 1);
    // A request that does not leave in time must not be carried out later: the connection is closed.
    actions(&mut full.rig, LinkId::MODBUS);
    full.rig.run(MS(500));
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 0);
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["close"]);
    full.rig.reports_sent = true;
    full.rig.modbus_answers = true;
    full.rig.run(MS(200));
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["open"]);
}

#[test]
fn an_answered_request_restarts_the_count_of_timeouts() {
    let mut full = Full::new();
    for _ in 0..5 {
        full.rig.modbus_answers = false;
        full.rig.run(MS(1_010));
        full.rig.modbus_answers = true;
        for request in full.rig.sent_on(LinkId::MODBUS) {
            let answer = full.rig.answer(&request);
            full.rig.link_bytes(LinkId::MODBUS, &answer);
        }
        full.rig.run(MS(100));
    }
    let link = full.rig.link(LinkId::MODBUS);
    assert_eq!((link.counters.timeouts, link.history.losses), (10, 0));
}

#[test]
fn an_answer_that_comes_after_its_time_is_not_taken_for_the_next_one() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.sent_on(LinkId::MODBUS);
    full.rig.run(MS(4));
    // A poll of the inputs, answered when the next one is under way.
    let first = full.rig.sent_on(LinkId::MODBUS).remove(0);
    full.rig.map.coils[176] = true;
    let late = full.rig.answer(&first);
    full.rig.map.coils[176] = false;
    full.rig.run(MS(510));
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.timeouts, 1);
    let second = full.rig.sent_on(LinkId::MODBUS).remove(0);
    let known = full.rig.engine.image().value(var("DigitalSignalStatus[1]"));
    full.rig.link_bytes(LinkId::MODBUS, &late);
    assert_eq!(full.rig.engine.image().value(var("DigitalSignalStatus[1]")), known, "too late to count");
    assert!(full.rig.sent_on(LinkId::MODBUS).is_empty(), "the second one is still under way");
    full.rig.map.coils[177] = true;
    let answer = full.rig.answer(&second);
    full.rig.link_bytes(LinkId::MODBUS, &answer);
    assert_eq!(full.rig.engine.image().value(var("DigitalSignalStatus[1]")), Scalar::Byte(2));
    full.rig.map.coils[177] = false;
    full.rig.modbus_answers = true;
    full.rig.run(MS(510));
    full.assert_all_gets_through();
    let link = full.rig.link(LinkId::MODBUS);
    assert_eq!((link.counters.malformed, link.history.losses), (0, 0), "slow is not wrong");
}

#[test]
fn a_slow_controller_is_served_at_its_own_pace() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.map.written.clear();
    let mut newest = (0, 0);
    // Every answer takes 80 ms, the PLC sends every 10 ms.
    for nth in 0..400 {
        newest = full.plc();
        full.rig.run(MS(10));
        if nth % 8 == 7 {
            for request in full.rig.sent_on(LinkId::MODBUS) {
                let answer = full.rig.answer(&request);
                full.rig.link_bytes(LinkId::MODBUS, &answer);
            }
        }
    }
    full.rig.modbus_answers = true;
    for request in full.rig.sent_on(LinkId::MODBUS) {
        let answer = full.rig.answer(&request);
        full.rig.link_bytes(LinkId::MODBUS, &answer);
    }
    let written: Vec<u16> = full
        .rig
        .map
        .written
        .iter()
        .filter_map(|write| match write {
            Written::Registers(8, words) => Some(words[0]),
            _ => None,
        })
        .collect();
    assert!(written.is_sorted(), "never an older value after a newer one: {written:?}");
    assert_eq!(written.last(), Some(&newest.1), "and the newest in the end");
    assert!(written.len() >= 10, "{}", written.len());
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.timeouts, 0);
    let counters = full.rig.counters(full.plc);
    assert!(counters.values_expired > 0, "edges older than the port's timeout were dropped and counted");
    full.rig.run(MS(200));
    full.assert_all_gets_through();
}

#[test]
fn exceptions_are_counted_and_change_nothing_else() {
    for exception in [
        Exception::IllegalFunction,
        Exception::IllegalDataAddress,
        Exception::IllegalDataValue,
        Exception::DeviceBusy,
        Exception::Unknown(0x7F),
    ] {
        let mut full = Full::new();
        full.rig.map.exception = Some(exception);
        for _ in 0..5 {
            full.plc();
            full.rig.run(MS(10));
        }
        let link = full.rig.link(LinkId::MODBUS);
        assert_eq!((link.counters.refused, link.counters.malformed, link.history.losses), (10, 0, 0));
        assert_eq!(full.rig.take_written(), []);
        full.rig.map.exception = None;
        full.rig.run(MS(100));
        assert_eq!(full.rig.take_written(), [], "what was refused is not repeated");
        full.assert_all_gets_through();
    }
}

#[test]
fn a_wrong_header_closes_the_modbus_link_at_once() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.log.clear();
    full.rig.link_bytes(LinkId::MODBUS, &[0, 1, 0, 1, 0, 3, 1, 0x83, 2]);
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["close"]);
    full.plc();
    assert_eq!(full.rig.counters(full.plc).undelivered, 1);
    full.rig.run(MS(100));
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["open"]);
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.malformed, 1);
    full.assert_all_gets_through();
}
