//! Safe values by Modbus: written until a write is answered.

use proto_core::engine::{Input, LinkId};
use proto_core::modbus::Exception;

use super::rig::*;
use super::{ON, falls_silent, live, modbus_and_others};

const OFF: &[u8] = &[255, 255, 0, 238, 238];

#[test]
fn by_modbus_it_is_written_until_it_is_answered() {
    let (cell, port) = Cell::guarded();
    let mut rig = cell.rig();
    falls_silent(&mut rig, port, ON);
    rig.modbus_answers = false;
    rig.run(MS(1));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 1);
    rig.run(MS(499));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 0);
    rig.run(MS(1));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 1, "no answer: again at once");
    rig.run(MS(250));
    let second = rig.sent_on(LinkId::MODBUS);
    assert_eq!(second.len(), 0);
    // The answer to the second one comes.
    rig.modbus_answers = true;
    rig.run(MS(250));
    assert_eq!(rig.take_written(), [coils(192, 4)], "the third is answered");
    rig.run(MS(10_000));
    assert_eq!((rig.take_written(), rig.sent_on(LinkId::MODBUS).len()), (vec![], 1), "it is there");
}

#[test]
fn by_modbus_a_refused_one_is_written_again_after_500_ms() {
    let (cell, port) = Cell::guarded();
    let mut rig = cell.rig();
    let due = falls_silent(&mut rig, port, ON);
    rig.map.exception = Some(Exception::DeviceBusy);
    rig.run(MS(2_100));
    let sent: Vec<u64> = rig.sent_after(LinkId::MODBUS, due).into_iter().map(|(at, _)| at).collect();
    assert_eq!(sent, [0, 500, 1_000, 1_500, 2_000]);
    rig.map.exception = None;
    rig.run(MS(10_000));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
    assert_eq!(rig.counters(port).timeouts, 1);
}

#[test]
fn by_modbus_it_is_written_again_after_each_link_that_came_up() {
    let (rig, _) = modbus_and_others();
    let links: Vec<LinkId> = rig.engine.links().map(|link| link.id).collect();
    assert_eq!(links.len(), 5, "command, urgent, state, Modbus, UDP");
    for link in links {
        let (mut rig, port) = modbus_and_others();
        falls_silent(&mut rig, port, ON);
        rig.run(MS(1));
        assert_eq!(rig.take_written(), [coils(192, 4)]);
        rig.input(Input::LinkDown { link });
        rig.run(MS(99));
        assert_eq!(rig.take_written(), [], "{link:?} is down");
        live(&mut rig, 1_000);
        assert_eq!(rig.take_written(), [coils(192, 4)], "{link:?} is back, the controller may be another");
        live(&mut rig, 11_000);
        assert_eq!(rig.take_written(), [], "once is enough");
        rig.input(Input::LinkDown { link });
        rig.run(MS(50));
        rig.bytes(port, ON);
        rig.run(MS(99));
        let written = rig.take_written();
        assert!(!written.contains(&coils(192, 4)), "{link:?}: its owner was back by then: {written:?}");
    }
}

#[test]
fn by_modbus_the_answer_to_what_the_owner_sent_confirms_nothing() {
    let (cell, port) = Cell::guarded();
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, ON);
    rig.run(MS(90));
    rig.modbus_answers = false;
    rig.bytes(port, ON);
    let request = rig.sent_on(LinkId::MODBUS).pop().unwrap();
    rig.run(MS(101));
    let answer = rig.answer(&request);
    rig.modbus_answers = true;
    rig.take_written();
    rig.link_bytes(LinkId::MODBUS, &answer);
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}

#[test]
fn a_refused_safe_value_gives_way_to_the_owner() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.map.exception = Some(Exception::DeviceBusy);
    rig.run(MS(101));
    rig.map.exception = None;
    rig.take_written();
    rig.bytes(port, OFF);
    assert_eq!(rig.take_written(), [coils(192, 0)]);
    for _ in 0..40 {
        rig.run(MS(50));
        rig.bytes(port, OFF);
    }
    assert!(rig.take_written().iter().all(|write| *write == coils(192, 0)), "the owner is back");
}

#[test]
fn an_owners_value_is_never_kept_as_if_it_were_safe() {
    let (mut cell, port) = Cell::guarded();
    cell.last_port().timeout = MS(1_000);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, ON);
    rig.modbus_answers = false;
    rig.take_written();
    // The safe value is under way when its owner comes back and the link breaks.
    rig.run(MS(1_001));
    rig.bytes(port, OFF);
    rig.bytes(port, ON);
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.modbus_answers = true;
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(900));
    assert_eq!(rig.link(LinkId::MODBUS).state.name(), "up");
    assert_eq!(rig.take_written(), [], "received before the link was lost");
    rig.run(MS(5_000));
    assert_eq!(rig.take_written(), [coils(192, 4)], "silent again: safe again");
}

#[test]
fn a_safe_value_whose_write_was_cut_off_is_written_on_the_next_connection() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.modbus_answers = false;
    rig.take_written();
    rig.run(MS(101));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 2);
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.modbus_answers = true;
    rig.run(MS(5_000));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}
