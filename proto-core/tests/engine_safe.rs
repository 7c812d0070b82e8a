//! A safe value is repeated until it is known to be there (docs/engine.md section 6).

mod rig;

use heapless::String;
use proto_core::config::*;
use proto_core::engine::{Input, LinkId, PortId};
use proto_core::modbus::Exception;
use proto_core::recipe::model::Mode;
use proto_core::time::Instant;
use proto_core::wire::scalar::ScalarType;
use rig::*;

const UDP: LinkId = LinkId::RECIPE_UDP;
const ON: &[u8] = &[255, 255, 1, 238, 238];
const SAFE: &[u8] = &[255, 255, 4, 238, 238];
/// All owners fall silent after this.
const SILENT: u64 = 100;

fn coils(address: u16, byte: u8) -> Written {
    Written::Coils(address, (0..8).map(|bit| byte >> bit & 1 == 1).collect())
}

fn float(value: f32) -> Vec<u8> {
    [&[255, 255][..], &value.to_le_bytes(), &[238, 238]].concat()
}

fn floats(a: f32, b: f32) -> Vec<u8> {
    [&[255, 255][..], &a.to_le_bytes(), &b.to_le_bytes(), &[238, 238]].concat()
}

/// A state packet with FloatInputReg[1] and [2].
fn packet(a: f32, b: f32) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    packet[832..836].copy_from_slice(&a.to_le_bytes());
    packet[836..840].copy_from_slice(&b.to_le_bytes());
    packet
}

/// Milliseconds after `since` at which the frame went out.
#[track_caller]
fn times(rig: &mut Rig, link: LinkId, since: Instant, frame: &[u8]) -> Vec<u64> {
    let sent = rig.sent_after(link, since);
    sent.into_iter()
        .filter(|(_, bytes)| *bytes != [0])
        .map(|(at, bytes)| {
            assert_eq!(bytes, frame, "{at} ms after it fell silent");
            at
        })
        .collect()
}

/// From one of these milliseconds to another, every so many.
fn every(step: usize, from: u64, to: u64) -> Vec<u64> {
    (from..=to).step_by(step).collect()
}

/// The owner sends one frame and falls silent; returns when its safe value falls due.
fn falls_silent(rig: &mut Rig, port: PortId, frame: &[u8]) -> Instant {
    rig.run(MS(10));
    rig.bytes(port, frame);
    rig.log.clear();
    rig.take_written();
    let due = rig.now + MS(SILENT);
    rig.run(MS(SILENT - 1));
    due
}

// By Modbus.

/// DigitalOutputCommand[1] by Modbus.
fn modbus() -> (Cell, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    (cell, port)
}

/// The same, with every other link beside it.
fn modbus_and_others() -> (Rig, PortId) {
    let (mut cell, port) = modbus();
    let table = cell.commands(&[(1, "stop")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe);
    let shows = cell.stream(&[], &["RobotState[8]"]);
    cell.rs485(shows);
    let up = cell.stream(&["FloatInputReg[1]"], &["RobotState[26]"]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    cell.rs485(recipe);
    (cell.rig(), port)
}

/// The controller goes on talking.
fn live(rig: &mut Rig, millis: u64) {
    for _ in 0..millis / 100 {
        rig.link_bytes(LinkId::STATE, &packet(0.0, 0.0));
        rig.run(MS(100));
    }
}

#[test]
fn by_modbus_it_is_written_until_it_is_answered() {
    let (cell, port) = modbus();
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
    let (cell, port) = modbus();
    let mut rig = cell.rig();
    let due = falls_silent(&mut rig, port, ON);
    rig.map.exception = Some(Exception::DeviceBusy);
    rig.run(MS(2_100));
    let sent: Vec<u64> = rig.sent_after(LinkId::MODBUS, due).into_iter().map(|(at, _)| at).collect();
    assert_eq!(sent, [0, 500, 1_000, 1_500, 2_000]);
    rig.map.exception = None;
    rig.run(MS(10_000));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
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
    let (cell, port) = modbus();
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

// By a recipe link, with the state stream.

/// FloatInputReg[1] from a port, [2] as it was read back; safe: -1.
fn seen_in_the_stream() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let up = cell.stream(&["FloatInputReg[1..2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("FloatInputReg[1]", -1.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &packet(0.0, 7.0));
    (rig, port)
}

#[test]
fn it_is_sent_every_4_ms_until_the_state_stream_shows_it() {
    let (mut rig, port) = seen_in_the_stream();
    let due = falls_silent(&mut rig, port, &float(5.0));
    // The stream goes on showing what was there before, for five seconds.
    for _ in 0..50 {
        rig.run(MS(100));
        rig.link_bytes(LinkId::STATE, &packet(5.0, 7.0));
    }
    let frame = floats(-1.0, 7.0);
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 4_999), "however long it takes");
    rig.run(MS(1));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.log.clear();
    rig.run(MS(10_000));
    assert_eq!(times(&mut rig, UDP, due, &frame), Vec::<u64>::new(), "it is there");
}

#[test]
fn what_the_stream_shows_no_more_soon_after_was_never_there() {
    let (mut rig, port) = seen_in_the_stream();
    falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(300));
    // A packet that was late on its way, of before the owner's last value.
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.run(MS(100));
    rig.log.clear();
    let now = rig.now;
    rig.link_bytes(LinkId::STATE, &packet(5.0, 7.0));
    rig.run(MS(10));
    assert_eq!(times(&mut rig, UDP, now, &floats(-1.0, 7.0)), every(4, 0, 8));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    // Much later it is another master who writes.
    for _ in 0..31 {
        rig.run(MS(100));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    }
    rig.log.clear();
    rig.link_bytes(LinkId::STATE, &packet(9.0, 7.0));
    rig.run(MS(100));
    assert_eq!(times(&mut rig, UDP, now, &[]), Vec::<u64>::new());
}

#[test]
fn what_the_stream_shows_too_soon_may_be_older() {
    let (mut rig, port) = seen_in_the_stream();
    let due = falls_silent(&mut rig, port, &float(-1.0));
    rig.run(MS(200));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.run(MS(1));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.run(MS(1_000));
    let frame = floats(-1.0, 7.0);
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 200), "199 ms are too soon, 200 are not");
}

#[test]
fn what_cannot_be_read_confirms_nothing() {
    let (mut rig, port) = seen_in_the_stream();
    let due = falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(301));
    rig.link_bytes(LinkId::STATE, &packet(f32::NAN, 7.0));
    rig.run(MS(99));
    assert_eq!(times(&mut rig, UDP, due, &floats(-1.0, 7.0)), every(4, 0, 399));
}

#[test]
fn without_its_neighbours_it_waits_and_with_them_it_goes_on() {
    let (mut rig, port) = seen_in_the_stream();
    rig.run(MS(90));
    rig.link_bytes(LinkId::STATE, &packet(0.0, 7.0));
    let due = falls_silent(&mut rig, port, &float(5.0));
    // The newest packet is 110 ms old now.
    rig.run(MS(1_000));
    let frame = floats(-1.0, 7.0);
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 390), "read back at most 500 ms ago");
    rig.link_bytes(LinkId::STATE, &packet(0.0, 8.0));
    rig.run(MS(8));
    assert_eq!(times(&mut rig, UDP, due, &floats(-1.0, 8.0)).len(), 3, "at once, and every 4 ms");
}

#[test]
fn the_owner_who_is_back_ends_it() {
    let (mut rig, port) = seen_in_the_stream();
    falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(51));
    rig.log.clear();
    rig.bytes(port, &float(6.0));
    assert_eq!(rig.sent_on(UDP), [floats(6.0, 7.0)]);
    rig.run(MS(99));
    assert!(rig.sent_on(UDP).is_empty(), "one frame, one frame");
    rig.run(MS(1));
    assert_eq!(rig.sent_on(UDP), [floats(-1.0, 7.0)], "and silent again");
}

#[test]
fn it_is_sent_again_after_each_link_that_came_up_until_it_is_seen_again() {
    for link in [LinkId::STATE, UDP] {
        let (mut rig, port) = seen_in_the_stream();
        falls_silent(&mut rig, port, &float(5.0));
        rig.run(MS(301));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
        rig.run(MS(4));
        rig.log.clear();
        rig.run(MS(100));
        assert!(rig.sent_on(UDP).is_empty(), "it is there");
        rig.input(Input::LinkDown { link });
        rig.run(MS(99));
        assert!(rig.sent_on(UDP).is_empty());
        let up = rig.now + MS(1);
        rig.run(MS(200));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
        rig.run(MS(1));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
        rig.run(MS(500));
        let frame = floats(-1.0, 7.0);
        assert_eq!(times(&mut rig, UDP, up, &frame), every(4, 0, 200), "{link:?} was away");
    }
}

#[test]
fn a_frame_of_a_safe_value_carries_what_the_other_owner_sent_last() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let silent = cell.rs485(recipe);
    cell.safe("ForceEnd[1]", -1.0);
    let recipe = cell.stream(&["ForceEnd[2]"], &[]);
    let alive = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(alive, &float(1.0));
    let due = falls_silent(&mut rig, silent, &float(5.0));
    for nth in 0..20_u8 {
        rig.bytes(alive, &float(f32::from(nth)));
        rig.run(MS(50));
        let sent = rig.sent_after(UDP, due);
        assert!(sent.len() >= 12, "{}", sent.len());
        let expected = floats(-1.0, f32::from(nth));
        assert!(sent.iter().all(|(at, frame)| *frame == expected || nth == 0 && *at == 0), "{sent:?}");
    }
}

// By a recipe link, with an output that shows what the input was set to.

/// DigitalOutputCommand[1] by the recipe link; DigitalSignalStatus[4] comes by Modbus, or the same way.
fn seen_in_an_output(by: LinkId) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let witness = ["DigitalSignalStatus[4]"];
    let up = cell.stream(&["DigitalOutputCommand[1]"], if by == UDP { &witness } else { &[] });
    cell.recipe_link(up);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    if by == LinkId::MODBUS {
        let recipe = cell.stream(&[], &witness);
        cell.rs485(recipe);
    }
    let rig = cell.rig();
    assert!(rig.engine.links().all(|link| [UDP, by].contains(&link.id)), "nothing else can show it");
    (rig, port)
}

#[test]
fn it_is_sent_until_a_poll_of_the_outputs_shows_it() {
    let (mut rig, port) = seen_in_an_output(LinkId::MODBUS);
    rig.map.coils[192] = true;
    let due = falls_silent(&mut rig, port, ON);
    rig.run(MS(3_000));
    assert_eq!(times(&mut rig, UDP, due, SAFE), every(4, 0, 2_999));
    (rig.map.coils[192], rig.map.coils[194]) = (false, true);
    rig.run(MS(9));
    rig.log.clear();
    rig.run(MS(5_000));
    assert_eq!(times(&mut rig, UDP, due, SAFE), Vec::<u64>::new());
}

#[test]
fn a_poll_too_soon_may_be_older() {
    let (mut rig, port) = seen_in_an_output(LinkId::MODBUS);
    rig.map.coils[194] = true;
    let due = falls_silent(&mut rig, port, SAFE);
    rig.run(MS(1_000));
    let times = times(&mut rig, UDP, due, SAFE);
    assert!((200..=208).contains(times.last().unwrap()), "the first poll of 200 ms or later: {times:?}");
}

#[test]
fn it_is_sent_until_a_frame_of_the_recipe_link_shows_it() {
    let (mut rig, port) = seen_in_an_output(UDP);
    let due = falls_silent(&mut rig, port, ON);
    let shows = |bits: u8| [255, 255, bits, 254, 254];
    for _ in 0..500 {
        rig.run(MS(4));
        rig.link_bytes(UDP, &shows(1));
    }
    assert_eq!(times(&mut rig, UDP, due, SAFE), every(4, 0, 1_999));
    rig.link_bytes(UDP, &shows(4));
    for _ in 0..2 {
        rig.run(MS(4));
        rig.link_bytes(UDP, &shows(4));
    }
    rig.log.clear();
    for _ in 0..500 {
        rig.run(MS(4));
        rig.link_bytes(UDP, &shows(4));
    }
    assert_eq!(times(&mut rig, UDP, due, SAFE), Vec::<u64>::new());
}

#[test]
fn a_udp_stream_that_was_silent_comes_from_a_controller_that_was_away() {
    let shows = [255, 255, 4, 254, 254];
    for (silence, is_sent_again) in [(400, false), (500, false), (501, true), (5_000, true)] {
        let (mut rig, port) = seen_in_an_output(UDP);
        rig.run(MS(10));
        rig.link_bytes(UDP, &shows);
        falls_silent(&mut rig, port, ON);
        rig.run(MS(301));
        rig.link_bytes(UDP, &shows);
        rig.run(MS(8));
        rig.link_bytes(UDP, &shows);
        rig.log.clear();
        rig.run(MS(silence));
        let back = rig.now;
        assert_eq!(times(&mut rig, UDP, back, SAFE), Vec::<u64>::new(), "it was there");
        rig.link_bytes(UDP, &shows);
        rig.run(MS(100));
        let expected = if is_sent_again { every(4, 0, 100) } else { vec![] };
        assert_eq!(times(&mut rig, UDP, back, SAFE), expected, "silent for {silence} ms");
    }
}

#[test]
fn a_udp_stream_that_was_away_has_the_modbus_values_written_too() {
    let (mut rig, port) = modbus_and_others();
    let shows = [&[255, 255][..], &1.0_f32.to_le_bytes(), &[254, 254]].concat();
    rig.run(MS(10));
    rig.link_bytes(UDP, &shows);
    falls_silent(&mut rig, port, ON);
    rig.run(MS(1));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
    for _ in 0..10 {
        rig.link_bytes(UDP, &shows);
        live(&mut rig, 300);
    }
    assert_eq!(rig.take_written(), []);
    live(&mut rig, 300);
    rig.link_bytes(UDP, &shows);
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}

// By a recipe link, where nothing shows it.

/// ForceEnd[1] by UDP or TCP.
fn never_seen(tcp: bool) -> (Rig, PortId, LinkId) {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1]"], &[]);
    let mut link = UDP;
    if tcp {
        let listen = String::try_from("0.0.0.0:50000").unwrap();
        link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    } else {
        cell.recipe_link(up);
    }
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("ForceEnd[1]", -1.0);
    let rig = cell.rig();
    assert_eq!(rig.engine.links().count(), 1);
    (rig, port, link)
}

#[test]
fn what_nothing_shows_is_sent_fast_for_a_second_and_then_ten_times_a_second() {
    for tcp in [false, true] {
        let (mut rig, port, link) = never_seen(tcp);
        let due = falls_silent(&mut rig, port, &float(5.0));
        rig.run(MS(60_001));
        let expected = [every(4, 0, 1_000), every(100, 1_100, 60_000)].concat();
        assert_eq!(times(&mut rig, link, due, &float(-1.0)), expected, "for as long as its owner is silent");
        rig.bytes(port, &float(6.0));
        rig.run(MS(99));
        assert_eq!(rig.sent_on(link), [float(6.0)]);
    }
}

#[test]
fn what_nothing_shows_is_sent_fast_again_when_the_link_was_away() {
    for tcp in [false, true] {
        let (mut rig, port, link) = never_seen(tcp);
        falls_silent(&mut rig, port, &float(5.0));
        rig.run(MS(5_001));
        rig.log.clear();
        rig.input(Input::LinkDown { link });
        rig.run(MS(99));
        assert!(rig.sent_on(link).is_empty());
        let up = rig.now + MS(1);
        rig.run(MS(2_001));
        let expected = [every(4, 0, 1_000), every(100, 1_100, 2_000)].concat();
        assert_eq!(times(&mut rig, link, up, &float(-1.0)), expected);
    }
}

#[test]
fn what_nothing_shows_is_sent_fast_again_when_another_link_was_away() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["ForceEnd[1]"], &["DigitalSignalStatus[1]"]);
    let port = cell.rs485(recipe);
    cell.safe("ForceEnd[1]", -1.0);
    let mut rig = cell.rig();
    falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(5_031));
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.run(MS(99));
    rig.log.clear();
    let up = rig.now + MS(1);
    rig.run(MS(2_001));
    let expected = [every(4, 0, 1_000), every(100, 1_100, 2_000)].concat();
    assert_eq!(times(&mut rig, UDP, up, &float(-1.0)), expected);
}

#[test]
fn by_tcp_it_goes_to_the_next_connection_when_nobody_acknowledges() {
    let (mut rig, port, link) = never_seen(true);
    let due = falls_silent(&mut rig, port, &float(5.0));
    rig.acknowledges = false;
    rig.run(MS(1_000));
    let closed = rig.closed();
    assert_eq!(closed[0], (due + MS(250), link));
    let sent = times(&mut rig, link, due, &float(-1.0));
    assert_eq!(sent[..63], every(4, 0, 248), "up to there");
    assert_eq!(sent[63], 350, "and from 100 ms later on");
    assert!(closed.len() >= 2, "{closed:?}");
    rig.acknowledges = true;
    rig.run(MS(6_000));
    assert_eq!(rig.link(link).state.name(), "up");
    rig.sent_on(link);
    rig.run(MS(1_000));
    assert_eq!(rig.sent_on(link).len(), 10);
}

#[test]
fn a_transport_that_is_full_gets_one_and_not_a_row_of_them() {
    let (mut rig, port, link) = never_seen(true);
    rig.run(MS(10));
    rig.bytes(port, &float(5.0));
    rig.reports_sent = false;
    rig.sent_on(link);
    rig.bytes(port, &float(5.0));
    assert_eq!(rig.sent_on(link).len(), 1);
    rig.acked(link, 0);
    rig.run(MS(1_000));
    assert!(rig.sent_on(link).is_empty());
    rig.input(Input::LinkSent { link });
    assert_eq!(rig.sent_on(link), [float(-1.0)]);
}

// All of them.

#[test]
fn nothing_is_safe_before_an_owner_has_spoken() {
    let (mut rig, _, link) = never_seen(false);
    rig.run(MS(5_000));
    rig.input(Input::LinkDown { link });
    rig.run(MS(5_000));
    assert!(rig.sent_on(link).is_empty());
}

#[test]
fn a_safe_value_that_fell_due_while_its_link_was_down_goes_first_when_it_is_up() {
    let (mut rig, port, link) = never_seen(false);
    rig.run(MS(10));
    rig.bytes(port, &float(5.0));
    rig.reachable.remove(&link.0);
    rig.input(Input::LinkDown { link });
    rig.log.clear();
    rig.run(MS(3_000));
    assert!(rig.sent_on(link).is_empty());
    rig.reachable.insert(link.0);
    rig.run(MS(5_000));
    let sent = rig.sent_on(link);
    assert!(sent.len() > 250 && sent.iter().all(|frame| *frame == float(-1.0)), "{}", sent.len());
}

#[test]
fn a_variable_that_is_seen_does_not_speed_up_one_that_is_not() {
    let mut cell = Cell::new();
    let up = cell.stream(&["FloatInputReg[1]", "ForceEnd[1]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]", "ForceEnd[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("FloatInputReg[1]", -1.0);
    cell.safe("ForceEnd[1]", -2.0);
    let shows = cell.stream(&[], &["RobotState[8]"]);
    cell.rs485(shows);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let due = falls_silent(&mut rig, port, &floats(5.0, 6.0));
    let frame = floats(-1.0, -2.0);
    for _ in 0..30 {
        rig.run(MS(100));
        rig.link_bytes(LinkId::STATE, &packet(0.0, 0.0));
    }
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 2_999), "one of them can be seen, and is not");
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 0.0));
    rig.run(MS(2_001));
    assert_eq!(times(&mut rig, UDP, due, &frame), every(100, 3_000, 5_000), "the other cannot");
}
