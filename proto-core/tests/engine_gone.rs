//! Commands of a device that is gone are dropped; its first frame afterwards is only a base
//! (docs/engine.md section 7).

mod rig;

use proto_core::config::*;
use proto_core::engine::{BusState, Input, LinkId, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;
use rig::*;

const RUN: u8 = 1;
const RESUME: u8 = 2;
const STOP: u8 = 3;
const NOTHING: u8 = 0;

const COMMAND: LinkId = LinkId::COMMAND;
const URGENT: LinkId = LinkId::URGENT;
/// On a serial line, silent after 20 s.
const LINE: PortId = PortId(0);
/// On a CAN bus, with a command field in each of two frames; silent after 100 ms.
const BUS: PortId = PortId(1);
const IDS: [u16; 2] = [1, 5];

fn panels() -> Rig {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume"), (3, "stop")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    assert_eq!(cell.rs485(recipe), LINE);
    cell.last_port().timeout = MS(20_000);
    let input = IDS.map(|id| CanFramePart {
        id: CanId::Standard(id),
        fields: cell.fields([user_in(ScalarType::Byte, to)]),
    });
    let parts = Parts::Can { input: input.into_iter().collect(), output: Default::default() };
    let recipe = cell.recipe(Mode::User, parts);
    assert_eq!(cell.can_port(recipe), BUS);
    let mut rig = cell.rig();
    rig.run(MS(10));
    press(&mut rig, NOTHING);
    for id in IDS {
        rig.can(BUS, id, &[NOTHING]);
    }
    rig
}

fn press(rig: &mut Rig, value: u8) {
    rig.bytes(LINE, &[255, 255, value, 238, 238]);
}

/// One port's run is in flight and its resume waits; another port's resume waits too.
fn busy(port: PortId) -> Rig {
    let mut rig = panels();
    let other = if port == LINE { BUS } else { LINE };
    for (port, value) in [(port, RUN), (port, RESUME), (other, RESUME)] {
        match port {
            LINE => press(&mut rig, value),
            _ => rig.can(BUS, IDS[0], &[value]),
        }
    }
    assert_eq!(rig.sent_on(COMMAND), [b"run(pick.jspf,50)"]);
    rig
}

#[track_caller]
fn reply(rig: &Rig, port: PortId) -> ReplyCode {
    rig.engine.reply_code(port).unwrap()
}

#[track_caller]
fn dropped(rig: &Rig, port: PortId) -> u32 {
    rig.counters(port).commands_dropped
}

/// When the run is answered, only the other port's resume is sent.
#[track_caller]
fn only_the_others_is_sent(rig: &mut Rig, gone: PortId) {
    let other = if gone == LINE { BUS } else { LINE };
    assert_eq!((reply(rig, gone), dropped(rig, gone)), (ReplyCode::NotSent, 1));
    assert_eq!((reply(rig, other), dropped(rig, other)), (ReplyCode::Pending, 0));
    rig.link_bytes(COMMAND, b"run start");
    assert_eq!(rig.sent_on(COMMAND), [b"resume"]);
    rig.link_bytes(COMMAND, b"resume success");
    assert_eq!((reply(rig, gone), reply(rig, other)), (ReplyCode::NotSent, ReplyCode::Success));
    rig.run(MS(2_000));
    assert!(rig.sent_on(COMMAND).is_empty());
}

#[test]
fn a_device_that_is_unplugged_takes_its_commands_with_it() {
    for port in [LINE, BUS] {
        let mut rig = busy(port);
        rig.input(Input::PortDown { port });
        only_the_others_is_sent(&mut rig, port);
    }
}

#[test]
fn a_bus_that_is_off_takes_its_commands_with_it() {
    let mut rig = busy(BUS);
    rig.input(Input::PortBus { port: BUS, state: BusState::Passive });
    assert_eq!(dropped(&rig, BUS), 0, "not yet");
    rig.input(Input::PortBus { port: BUS, state: BusState::BusOff });
    only_the_others_is_sent(&mut rig, BUS);
}

#[test]
fn a_frame_that_is_overduetakes_its_commands_with_it() {
    let mut rig = busy(BUS);
    rig.run(MS(50));
    rig.can(BUS, IDS[1], &[NOTHING]);
    rig.run(MS(49));
    assert_eq!(dropped(&rig, BUS), 0);
    rig.run(MS(1));
    assert_eq!(rig.counters(BUS).timeouts, 1, "of id 1");
    only_the_others_is_sent(&mut rig, BUS);
}

#[test]
fn a_frame_that_is_overdueleaves_those_of_the_other_id() {
    let mut rig = panels();
    rig.can(BUS, IDS[0], &[RUN]);
    rig.run(MS(50));
    rig.can(BUS, IDS[1], &[RESUME]);
    rig.run(MS(50));
    assert_eq!((rig.counters(BUS).timeouts, dropped(&rig, BUS)), (1, 0));
    rig.sent_on(COMMAND);
    rig.link_bytes(COMMAND, b"run start");
    assert_eq!(rig.sent_on(COMMAND), [b"resume"]);
}

#[test]
fn a_device_that_may_be_silent_for_long_is_missed_when_it_is_unplugged() {
    let mut rig = panels();
    press(&mut rig, RUN);
    press(&mut rig, RESUME);
    rig.run(MS(900));
    assert_eq!(reply(&rig, LINE), ReplyCode::Pending, "silent, and that is allowed");
    rig.input(Input::PortDown { port: LINE });
    assert_eq!((reply(&rig, LINE), dropped(&rig, LINE)), (ReplyCode::NotSent, 1), "at once");
    assert_eq!(rig.counters(LINE).timeouts, 0);
}

#[test]
fn what_was_sent_before_still_gets_its_reply() {
    let mut rig = panels();
    press(&mut rig, RUN);
    rig.input(Input::PortDown { port: LINE });
    assert_eq!(reply(&rig, LINE), ReplyCode::Pending);
    rig.link_bytes(COMMAND, b"run fail");
    assert_eq!((reply(&rig, LINE), dropped(&rig, LINE)), (ReplyCode::Fail, 0));
}

#[test]
fn its_first_value_is_only_a_base() {
    type Loses = fn(&mut Rig);
    let unplugged: Loses = |rig| {
        rig.input(Input::PortDown { port: BUS });
        rig.input(Input::PortUp { port: BUS });
    };
    let bus_off: Loses = |rig| {
        rig.input(Input::PortBus { port: BUS, state: BusState::BusOff });
        rig.input(Input::PortBus { port: BUS, state: BusState::Active });
    };
    let overdue: Loses = |rig| rig.run(MS(100));
    for lose in [unplugged, bus_off, overdue] {
        for value in [RUN, STOP] {
            let mut rig = panels();
            lose(&mut rig);
            for _ in 0..20 {
                rig.can(BUS, IDS[0], &[value]);
                rig.run(MS(10));
            }
            assert!(rig.sent_on(COMMAND).is_empty() && rig.sent_on(URGENT).is_empty(), "{value}");
            assert_eq!((reply(&rig, BUS), rig.counters(BUS).commands), (ReplyCode::None, 0));
            rig.can(BUS, IDS[0], &[NOTHING]);
            rig.can(BUS, IDS[0], &[value]);
            assert_eq!(rig.counters(BUS).commands, 1, "now it is pressed");
        }
    }
}

#[test]
fn bus_off_once_more_is_no_news() {
    let mut rig = panels();
    rig.input(Input::PortBus { port: BUS, state: BusState::BusOff });
    rig.can(BUS, IDS[0], &[NOTHING]);
    rig.input(Input::PortBus { port: BUS, state: BusState::BusOff });
    rig.can(BUS, IDS[0], &[RUN]);
    assert_eq!((rig.counters(BUS).bus_offs, rig.counters(BUS).commands), (1, 1));
}

/// A stop waits: there is no connection.
fn waiting_stop() -> Rig {
    let mut rig = panels();
    rig.reachable.clear();
    for link in [COMMAND, URGENT] {
        rig.input(Input::LinkDown { link });
    }
    press(&mut rig, STOP);
    rig.run(MS(5_000));
    assert_eq!(reply(&rig, LINE), ReplyCode::Pending);
    rig.log.clear();
    rig
}

#[test]
fn its_stop_waits_a_second_more() {
    let mut rig = waiting_stop();
    rig.input(Input::PortDown { port: LINE });
    rig.run(MS(999));
    assert_eq!((reply(&rig, LINE), dropped(&rig, LINE)), (ReplyCode::Pending, 0));
    rig.run(MS(1));
    assert_eq!((reply(&rig, LINE), dropped(&rig, LINE)), (ReplyCode::NotSent, 1));
    rig.reachable = (0..16).collect();
    rig.run(MS(10_000));
    assert!(rig.sent_on(COMMAND).is_empty() && rig.sent_on(URGENT).is_empty());
}

#[test]
fn its_stop_is_sent_within_that_second() {
    let mut rig = panels();
    rig.input(Input::LinkDown { link: COMMAND });
    rig.input(Input::LinkDown { link: URGENT });
    press(&mut rig, STOP);
    rig.input(Input::PortDown { port: LINE });
    rig.run(MS(100));
    let sent = [rig.sent_on(COMMAND), rig.sent_on(URGENT)].concat();
    assert_eq!(sent, [b"stop"], "it was pressed");
}

#[test]
fn a_stop_of_a_device_that_falls_silent_waits_a_second_more() {
    let mut rig = waiting_stop();
    // 20 s after its frame it is overdue.
    rig.run(MS(14_999));
    assert_eq!(rig.counters(LINE).timeouts, 0);
    rig.run(MS(1));
    assert_eq!((rig.counters(LINE).timeouts, reply(&rig, LINE)), (1, ReplyCode::Pending));
    rig.run(MS(999));
    assert_eq!(reply(&rig, LINE), ReplyCode::Pending);
    rig.run(MS(1));
    assert_eq!(reply(&rig, LINE), ReplyCode::NotSent);
}

#[test]
fn a_stop_of_a_device_that_is_gone_is_not_sent_again() {
    let mut rig = panels();
    press(&mut rig, STOP);
    assert_eq!(rig.sent_on(URGENT), [b"stop"]);
    rig.input(Input::PortDown { port: LINE });
    rig.input(Input::LinkDown { link: URGENT });
    assert_eq!(reply(&rig, LINE), ReplyCode::NoReply);
    rig.run(MS(10_000));
    assert!(rig.sent_on(COMMAND).is_empty() && rig.sent_on(URGENT).is_empty());
}
