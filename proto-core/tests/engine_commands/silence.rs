//! Panels that send only when something changes.

use super::*;
use proto_core::engine::{BusState, Input, PortState};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType as T;

/// A port that is overdue after 200 ms, with a safe value.
fn silent(when: CommandWhen) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf)"), (2, "stop"), (3, "resume")]);
    let lamp = InputBinding::Variable { var: var("WordInputReg[1]"), scale: 1.0, offset: 0.0 };
    let order = InputBinding::Commands { table, when };
    let port = panel(&mut cell, &[user_in(T::Byte, order), user_in(T::Byte, lamp)]);
    cell.last_port().timeout = MS(200);
    cell.safe("WordInputReg[1]", 7.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

fn state(rig: &Rig) -> PortState {
    rig.engine.status(rig.now).ports().next().unwrap().state
}

#[test]
fn a_kept_base_survives_silence_and_supervision_goes_on() {
    let (mut rig, port) = silent(CommandWhen::Kept);
    rig.bytes(port, &[0xA5, 0, 1]);
    rig.take_written();
    rig.run(MS(5_000));
    assert_eq!((state(&rig), rig.counters(port).timeouts), (PortState::Silent, 1));
    assert_eq!(rig.map.registers[8], 7, "the safe value");
    rig.bytes(port, &[0xA5, 1, 2]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), ["run(pick.jspf)"]);
    assert_eq!((state(&rig), rig.counters(port).commands_based), (PortState::Working, 0));
    rig.link_bytes(LinkId::COMMAND, b"run start");
    rig.run(MS(5_000));
    rig.bytes(port, &[0xA5, 1, 2]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0], "the same value again");
    rig.bytes(port, &[0xA5, 2, 2]);
    assert_eq!(sent(&mut rig, LinkId::URGENT), ["stop"]);
}

#[test]
fn without_it_the_value_after_silence_is_counted_and_told() {
    let (mut rig, port) = silent(CommandWhen::Change);
    rig.bytes(port, &[0xA5, 0, 1]);
    rig.run(MS(500));
    rig.bytes(port, &[0xA5, 1, 2]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0]);
    assert_eq!((rig.counters(port).commands_based, rig.counters(port).commands), (1, 0));
    assert_eq!(not_given(&rig), Some((DropReason::Based, 0, 1)));
    // A value at rest is no news.
    rig.run(MS(500));
    rig.bytes(port, &[0xA5, 0, 2]);
    assert_eq!(rig.counters(port).commands_based, 1);
}

#[test]
fn a_device_that_was_gone_only_sets_the_base() {
    for gone in [true, false] {
        let (mut rig, port) = silent(CommandWhen::Kept);
        rig.bytes(port, &[0xA5, 0, 1]);
        if gone {
            rig.input(Input::PortDown { port });
            rig.input(Input::PortUp { port });
        } else {
            rig.input(Input::PortBus { port, state: BusState::BusOff });
            rig.input(Input::PortBus { port, state: BusState::Active });
        }
        rig.bytes(port, &[0xA5, 1, 1]);
        assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0]);
        assert_eq!(not_given(&rig), Some((DropReason::Based, 0, 1)));
        rig.bytes(port, &[0xA5, 3, 1]);
        assert_eq!(sent(&mut rig, LinkId::COMMAND), ["resume"]);
    }
}

#[test]
fn a_gateway_that_slept_only_sets_the_base() {
    let (mut rig, port) = silent(CommandWhen::Kept);
    rig.bytes(port, &[0xA5, 0, 1]);
    rig.now += Duration::from_secs(60);
    rig.input(Input::Tick);
    rig.run(MS(500));
    rig.bytes(port, &[0xA5, 1, 1]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0]);
    assert_eq!(rig.counters(port).commands_based, 1);
}

#[test]
fn a_stop_is_asked_for_until_the_device_says_otherwise() {
    for (when, is_sent) in [(CommandWhen::Kept, true), (CommandWhen::Change, false)] {
        let (mut rig, port) = silent(when);
        rig.bytes(port, &[0xA5, 0, 1]);
        rig.reachable.clear();
        for link in [LinkId::COMMAND, LinkId::URGENT] {
            rig.input(Input::LinkDown { link });
        }
        rig.bytes(port, &[0xA5, 2, 1]);
        rig.run(MS(5_000));
        rig.reachable = (0..16).collect();
        rig.run(MS(6_000));
        let all = [sent(&mut rig, LinkId::COMMAND), sent(&mut rig, LinkId::URGENT)].concat();
        assert_eq!(all.first().is_some_and(|text| text == "stop"), is_sent, "{when:?}: {all:?}");
        if !is_sent {
            assert_eq!(not_given(&rig), Some((DropReason::TooOld, 0, 2)));
        }
    }
}

#[test]
fn any_other_command_waits_1_s_at_most() {
    for when in [CommandWhen::Kept, CommandWhen::Change] {
        let (mut rig, port) = silent(when);
        for value in [0, 3, 1] {
            rig.bytes(port, &[0xA5, value, 1]);
        }
        assert_eq!(sent(&mut rig, LinkId::COMMAND), ["resume"]);
        rig.run(MS(500));
        let why = (when == CommandWhen::Change).then_some((DropReason::DeviceGone, 0, 1));
        assert_eq!(not_given(&rig), why, "{when:?}");
        rig.run(MS(501));
        rig.link_bytes(LinkId::COMMAND, b"resume success");
        assert_eq!(sent(&mut rig, LinkId::COMMAND), [""; 0]);
        assert_eq!(rig.counters(port).commands_dropped, 1);
        let why = if when == CommandWhen::Kept { DropReason::TooOld } else { DropReason::DeviceGone };
        assert_eq!(not_given(&rig), Some((why, 0, 1)));
    }
}

#[test]
fn every_other_reason_is_told_too() {
    let (mut rig, port) = silent(CommandWhen::Frame);
    for _ in 0..10 {
        rig.bytes(port, &[0xA5, 3, 1]);
    }
    assert_eq!(not_given(&rig), Some((DropReason::QueueFull, 0, 3)));
    rig.reachable.clear();
    rig.input(Input::LinkDown { link: LinkId::COMMAND });
    assert_eq!(not_given(&rig), Some((DropReason::NoLink, 0, 3)), "lost while they waited");
    rig.bytes(port, &[0xA5, 1, 1]);
    assert_eq!(not_given(&rig), Some((DropReason::NoLink, 0, 1)));
    rig.bytes(port, &[0xA5, 2, 1]);
    rig.now += Duration::from_secs(60);
    rig.input(Input::Tick);
    let texts: Vec<_> = DropReason::ALL.map(DropReason::text).to_vec();
    assert!(texts.iter().all(|text| texts.iter().filter(|other| *other == text).count() == 1));
}

#[test]
fn a_port_that_is_never_overdue_works_from_the_start_and_forgets_nothing() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf)")]);
    let lamp = InputBinding::Variable { var: var("WordInputReg[1]"), scale: 1.0, offset: 0.0 };
    let order = InputBinding::Commands { table, when: CommandWhen::Change };
    let port = panel(&mut cell, &[user_in(T::Byte, order), user_in(T::Byte, lamp)]);
    cell.last_port().timeout = Port::NEVER;
    cell.0.validate().unwrap();
    let mut rig = cell.rig();
    rig.run(MS(1_000));
    let overdue = |rig: &Rig| rig.engine.status(rig.now).ports().next().unwrap().overdue;
    assert_eq!((state(&rig), overdue(&rig)), (PortState::Working, 0), "nothing came, and nothing is missed");
    rig.bytes(port, &[0xA5, 0, 9]);
    rig.run(MS(20_000));
    assert_eq!((state(&rig), overdue(&rig), rig.counters(port).timeouts), (PortState::Working, 0, 0));
    assert_eq!(rig.map.registers[8], 9);
    rig.bytes(port, &[0xA5, 1, 9]);
    assert_eq!(sent(&mut rig, LinkId::COMMAND), ["run(pick.jspf)"], "the base is that of the frame before");
}

#[test]
fn never_is_no_instant_of_its_own() {
    let fifty_years = Instant::from_micros(50 * 365 * 86_400_000_000);
    assert!(fifty_years + Port::NEVER < Instant::NEVER);
    let mut cell = Cell::new();
    panel(&mut cell, &[user_in(T::Byte, InputBinding::Unused)]);
    for (timeout, is_valid) in [(Port::NEVER, true), (Duration::MAX, false), (MS(3_600_001), false)] {
        cell.last_port().timeout = timeout;
        assert_eq!(cell.0.validate().is_ok(), is_valid, "{timeout}");
    }
}
