//! Presence is of the device, not of an exchange; starting it is an event.

use proto_core::recipe::model::Mode;
use proto_core::wire::can::CanId;

use super::*;

const ACTIVATE: u16 = 0x03E8;

/// An activation at the start, a register that is read, and one that the device never answers.
fn cell(is_dead: bool) -> (Cell, PortId) {
    let mut cell = Cell::new();
    let start = Triggers { start: true, ..Triggers::NEVER };
    let mut activate = sets(&mut cell, 9, ACTIVATE, None, 1.0, start);
    let mut status = reads_at(&mut cell, 9, 0x10, "WordInputReg[1]", MS(50));
    (activate.late, status.late) = (None, None);
    let mut table = vec![activate, status];
    if is_dead {
        // Its reply is told from the other's by its length.
        let mut dead = reads(&mut cell, 9, &["WordInputReg[2]", "WordInputReg[3]"], Triggers::every(MS(100)));
        dead.late = None;
        table.push(dead);
    }
    let port = talking(&mut cell, &table);
    cell.last_port().timeout = MS(500);
    (cell, port)
}

fn activations(asked: &[(Instant, Vec<u8>)]) -> usize {
    asked.iter().filter(|(_, request)| request[1] == 16).count()
}

#[test]
fn a_register_that_is_never_answered_is_its_own_fault() {
    let (cell, port) = cell(true);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(20_000), |request| {
        (request[..4] != [9, 3, 0, 0x10] || request[5] == 1).then(|| (MS(2), answer(request, |_| 7)))
    });
    assert_eq!(activations(&asked), 1);
    let polls = asked.iter().filter(|(_, request)| request[1] == 3 && request[5] == 1).count();
    let dead = asked.iter().filter(|(_, request)| request[1] == 3 && request[5] == 2).count();
    assert!(polls > 250 && (5..40).contains(&dead), "{polls} polls, {dead} of the dead register");
    assert_eq!(line.peer(9).presence.name(), "up");
}

#[test]
fn lost_and_damaged_replies_start_nothing_again() {
    for (lost, damaged) in [(0, 6), (7, 0), (5, 4)] {
        let (cell, port) = cell(false);
        let mut line = Line::new(&cell, port);
        let mut nth = 0_u32;
        let asked = line.run(MS(60_000), |request| {
            nth += 1;
            let mut reply = answer(request, |_| 7);
            if lost > 0 && nth.is_multiple_of(lost) {
                return None;
            }
            if damaged > 0 && nth.is_multiple_of(damaged) {
                reply[3] ^= 0x10;
            }
            Some((MS(2), reply))
        });
        assert_eq!(activations(&asked), 1, "every {lost}th lost, every {damaged}th damaged");
    }
}

#[test]
fn a_device_that_was_away_long_enough_has_started_anew() {
    let (cell, port) = cell(false);
    let mut line = Line::new(&cell, port);
    let good = |request: &[u8]| Some((MS(2), answer(request, |_| 7)));
    assert_eq!(activations(&line.run(MS(3_000), good)), 1);
    line.run(MS(2_000), |_| None);
    assert_eq!(activations(&line.run(MS(10_000), good)), 0, "2 s may be a bad line");
    assert_eq!(line.peer(9).counters.starts, 0);
    line.run(MS(8_000), |_| None);
    assert_eq!(activations(&line.run(MS(10_000), good)), 1);
    assert_eq!(line.peer(9).counters.starts, 1);
}

#[test]
fn a_device_that_is_switched_on_behind_the_gateway_is_started_once() {
    for after in [1_300, 2_000, 5_000, 30_000] {
        let (cell, port) = cell(false);
        let mut line = Line::new(&cell, port);
        let before = activations(&line.run(MS(after), |_| None));
        let asked = line.run(MS(40_000), |request| Some((MS(2), answer(request, |_| 7))));
        // One that says nothing for 3 s may be one that does not before it was started.
        let in_vain = usize::from(after > 3_000);
        assert_eq!((before, activations(&asked)), (in_vain, 1), "on {after} ms behind the gateway");
    }
}

#[test]
fn lost_replies_at_the_start_of_the_gateway_start_nothing_again() {
    // Those of the first requests are lost, the activation's among them.
    for lost in 2..6 {
        let (cell, port) = cell(false);
        let mut line = Line::new(&cell, port);
        let mut nth = 0;
        let asked = line.run(MS(20_000), |request| {
            nth += 1;
            (nth == 1 || nth > lost).then(|| (MS(2), answer(request, |_| 7)))
        });
        assert_eq!(activations(&asked), 1, "{lost} without a reply");
    }
}

#[test]
fn a_device_that_says_nothing_before_it_was_started_is_started() {
    let (cell, port) = cell(false);
    let mut line = Line::new(&cell, port);
    let mut is_started = false;
    let asked = line.run(MS(20_000), |request| {
        is_started |= request[1] == 16;
        is_started.then(|| (MS(2), answer(request, |_| 7)))
    });
    let first = asked.iter().position(|(_, request)| request[1] == 16).unwrap();
    assert!(asked[first].0.saturating_since(asked[0].0) < MS(4_000), "{:?}", asked[first]);
    assert_eq!(activations(&asked), 1);
}

#[test]
fn an_activation_whose_reply_is_lost_is_not_repeated() {
    let (cell, port) = cell(false);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(30_000), |request| (request[1] == 3).then(|| (MS(2), answer(request, |_| 7))));
    assert_eq!(activations(&asked), 1);
}

#[test]
fn a_busy_device_is_started_when_it_has_time() {
    let (cell, port) = cell(false);
    let mut line = Line::new(&cell, port);
    let mut busy = 4;
    let asked = line.run(MS(30_000), |request| {
        let is_busy = request[1] == 16 && busy > 0;
        busy -= i32::from(is_busy);
        Some((MS(2), if is_busy { exception(request, 6) } else { answer(request, |_| 7) }))
    });
    assert_eq!(activations(&asked), 5, "four times it was not carried out");
}

#[test]
fn an_absent_slave_is_found_within_64_timeouts() {
    let mut cell = Cell::new();
    let live = reads_at(&mut cell, 1, 0x10, "WordInputReg[1]", MS(50));
    let absent = reads_at(&mut cell, 2, 0x10, "WordInputReg[2]", MS(50));
    let port = talking(&mut cell, &[live, absent]);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(120_000), |request| (request[0] == 1).then(|| (MS(2), answer(request, |_| 7))));
    let times: Vec<_> = asked.iter().filter(|(_, request)| request[0] == 2).map(|(at, _)| *at).collect();
    let longest = times.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap();
    assert!(longest <= MS(6_400 + 250), "{longest}");
}

/// A CANopen node, 5: an object that is set at the start, and one that is read each 50 ms.
fn node() -> (Cell, PortId) {
    let mut cell = Cell::new();
    let byte = |value: i64| FieldSpec::Fixed { encoding: Encoding::scalar(T::Byte), value };
    let mut frame = |id: u16, fields: Vec<FieldSpec>| {
        let fields = cell.fields(fields);
        let index = cell.0.frames.len() as u8;
        let (id, none) = (Some(CanId::Standard(id)), Delimiter::from_slice(&[]).unwrap());
        cell.0.frames.push(FrameSpec { id, remote: false, head: none.clone(), tail: none, fields }).unwrap();
        Some(index)
    };
    let pad = |len| FieldSpec::Padding { len, fill: 0 };
    let value = FieldSpec::DeviceInput {
        encoding: Encoding::scalar(T::Byte),
        overflow: Overflow::Usual,
        to: to("WordInputReg[1]"),
    };
    let set = frame(0x605, vec![byte(0x2F), byte(0x17), byte(0x10), byte(0), byte(1), pad(3)]);
    let is_set = frame(0x585, vec![byte(0x60), byte(0x17), byte(0x10), byte(0), pad(4)]);
    let read = frame(0x605, vec![byte(0x40), byte(0x01), byte(0x10), byte(0), pad(4)]);
    let is_read = frame(0x585, vec![byte(0x4F), byte(0x01), byte(0x10), byte(0), value, pad(3)]);
    let exchange = |request, reply, when| {
        never_late(Exchange::new(5, Transaction::Frames { request, reply, refusal: None }, when))
    };
    let start = Triggers { start: true, ..Triggers::NEVER };
    let table = [exchange(set, is_set, start), exchange(read, is_read, Triggers::every(MS(50)))];
    let parts = Parts::Can { input: Default::default(), output: Default::default() };
    let recipe = cell.recipe(Mode::User, parts);
    cell.0.exchanges.extend(table);
    cell.last_recipe().exchanges = Span { start: 0, len: 2 };
    let port = cell.can_port(recipe);
    (cell, port)
}

/// Runs a node that answers good, or with an SDO abort; returns how often the object was set.
fn play(rig: &mut Rig, port: PortId, millis: u64, is_set: bool) -> usize {
    let mut sets = 0;
    for _ in 0..millis {
        rig.run(MS(1));
        for frame in rig.can_sent_to(port) {
            let data = frame.data();
            let is_write = data[0] == 0x2F;
            sets += usize::from(is_write);
            let reply = match (is_write, is_set) {
                (true, true) => [0x60, data[1], data[2], data[3], 0, 0, 0, 0],
                (true, false) => [0x80, data[1], data[2], data[3], 0x11, 0, 9, 6],
                (false, _) => [0x4F, data[1], data[2], data[3], 7, 0, 0, 0],
            };
            rig.can(port, 0x585, &reply);
        }
    }
    sets
}

#[test]
fn an_sdo_abort_that_no_file_describes_is_an_answer() {
    let (cell, port) = node();
    let mut rig = cell.rig();
    assert_eq!(play(&mut rig, port, 5_000, false), 1);
    let status = rig.engine.status(rig.now);
    let peer = status.ports().next().unwrap().peers().next().unwrap();
    assert_eq!((peer.counters.refused, peer.presence.name(), peer.counters.timeouts), (1, "up", 0));
    assert_eq!(rig.map.registers[8], 7, "the rest of the node is read");
}

#[test]
fn a_node_that_says_that_it_has_booted_is_set_again() {
    let (cell, port) = node();
    let mut rig = cell.rig();
    assert_eq!(play(&mut rig, port, 1_000, true), 1);
    // It was away for less than a request takes.
    rig.can(port, 0x705, &[0]);
    assert_eq!(play(&mut rig, port, 1_000, true), 1);
    for (id, data) in [(0x705, &[5][..]), (0x706, &[0]), (0x705, &[0, 0])] {
        rig.can(port, id, data);
        assert_eq!(play(&mut rig, port, 1_000, true), 0, "{id:X} {data:?}");
    }
}
