//! A number in a reply tells that the device has restarted: what is asked at its start is asked again, once.

use super::*;

const ACTIVATE: u16 = 0x03E8;

/// An activation at the start, and a status that is read each 50 ms and is 0 behind a restart.
fn cell() -> (Cell, PortId) {
    let mut cell = Cell::new();
    let start = Triggers { start: true, ..Triggers::NEVER };
    let activate = sets(&mut cell, 9, ACTIVATE, None, 1.0, start);
    let mut status = reads_at(&mut cell, 9, 0x10, "WordInputReg[1]", MS(50));
    status.restarted = Some(Restarted { field: 0, value: 0.0 });
    let other = reads_at(&mut cell, 8, 0x10, "WordInputReg[2]", MS(50));
    let port = talking(&mut cell, &[activate, status, other]);
    cell.last_port().timeout = MS(500);
    (cell, port)
}

/// Runs a slave with this status; returns how often it was activated.
fn play(line: &mut Line, millis: u64, status: u16) -> usize {
    let asked = line.run(MS(millis), |request| Some((MS(2), answer(request, |_| status))));
    asked.iter().filter(|(_, request)| request[1] == 16).count()
}

#[test]
fn a_number_that_tells_of_a_restart_starts_the_device_once() {
    let (cell, port) = cell();
    let mut line = Line::new(&cell, port);
    assert_eq!(play(&mut line, 1_000, 1), 1);
    assert_eq!(play(&mut line, 3_000, 0), 1, "not again while the number stays");
    assert_eq!(line.peer(9).counters.starts, 1);
    assert_eq!(line.shown("WordInputReg[1]"), 0, "it is a value like any other");
    for number in [1, 2, 3, 2] {
        assert_eq!(play(&mut line, 500, number), 0);
    }
    assert_eq!(play(&mut line, 500, 0), 1);
    assert_eq!((line.peer(9).counters.starts, line.peer(8).counters.starts), (2, 0));
}

#[test]
fn the_first_number_is_no_restart() {
    let (cell, port) = cell();
    let mut line = Line::new(&cell, port);
    assert_eq!(play(&mut line, 2_000, 0), 1);
    assert_eq!(line.peer(9).counters.starts, 0);
}

/// Behind an absence that was a start already, the number of before says nothing.
#[test]
fn a_restart_that_is_known_already_is_none() {
    for away in [1_000, 8_000] {
        let (cell, port) = cell();
        let mut line = Line::new(&cell, port);
        assert_eq!(play(&mut line, 1_000, 1), 1);
        line.run(MS(away), |request| (request[0] == 8).then(|| (MS(2), answer(request, |_| 1))));
        assert_eq!(play(&mut line, 12_000, 0), 1, "away for {away} ms");
        assert_eq!(line.peer(9).counters.starts, 1, "away for {away} ms");
    }
}

/// The start was noticed by another exchange, before the number came.
#[test]
fn a_number_of_before_a_start_says_nothing() {
    let (mut cell, port) = cell();
    let other = reads_at(&mut cell, 9, 0x20, "WordInputReg[3]", MS(50));
    cell.0.exchanges.push(other).unwrap();
    cell.last_recipe().exchanges.len = 4;
    let mut line = Line::new(&cell, port);
    assert_eq!(play(&mut line, 1_000, 1), 1);
    line.run(MS(8_000), |_| None);
    let is_status = |request: &[u8]| request[1] == 3 && request[3] == 0x10;
    line.run(MS(12_000), |request| (!is_status(request)).then(|| (MS(2), answer(request, |_| 0))));
    assert_eq!(line.peer(9).counters.starts, 1);
    assert_eq!(play(&mut line, 12_000, 0), 0);
    assert_eq!(line.peer(9).counters.starts, 1);
    assert_eq!(line.shown("WordInputReg[1]"), 0, "the number came");
}

#[test]
fn a_port_that_comes_up_again_begins_with_no_number() {
    let (cell, port) = cell();
    let mut line = Line::new(&cell, port);
    assert_eq!(play(&mut line, 1_000, 1), 1);
    line.rig.input(proto_core::engine::Input::PortDown { port });
    line.rig.input(proto_core::engine::Input::PortUp { port });
    assert_eq!(play(&mut line, 2_000, 0), 1, "that of the port");
    assert_eq!(line.peer(9).counters.starts, 0);
}

/// What the device was to do, it has forgotten.
#[test]
fn what_waits_for_a_device_that_restarts_is_not_sent() {
    let (mut cell, port) = cell();
    let mut go = sets(&mut cell, 9, 0x90, None, 1.0, rising(0));
    // Kept back by the reply to it that may still come.
    (go.late, go.trigger) = (Some(MS(1_000)), Some(MS(1_000)));
    go.outcome.to = Some(var("WordInputReg[5]"));
    cell.0.exchanges.push(go).unwrap();
    cell.last_recipe().exchanges.len = 4;
    let mut line = Line::new(&cell, port);
    play(&mut line, 1_500, 1);
    line.bit(0, true);
    let is_go = |request: &[u8]| matches!(write_in(request), Some((0x90, _)));
    line.run(MS(300), |request| (!is_go(request)).then(|| (MS(2), answer(request, |_| 1))));
    assert_eq!(line.shown("WordInputReg[5]"), 5);
    line.bit(0, false);
    play(&mut line, 50, 1);
    line.bit(0, true);
    play(&mut line, 50, 1);
    assert_eq!(line.shown("WordInputReg[5]"), 1);
    play(&mut line, 300, 0);
    assert_eq!(line.shown("WordInputReg[5]"), 9);
}

/// A frame that comes unasked tells it, too; its value need not go anywhere.
#[test]
fn a_frame_that_comes_unasked_tells_of_a_restart() {
    let mut cell = Cell::new();
    let byte = Encoding::scalar(T::Byte);
    let mut frame = |head: &[u8], field| {
        let fields = cell.fields([FieldSpec::Padding { len: 1, fill: 0 }, field]);
        let (head, tail) = (Delimiter::from_slice(head).unwrap(), Delimiter::default());
        cell.0.frames.push(FrameSpec { id: None, remote: false, head, tail, fields }).unwrap();
        Some(cell.0.frames.len() as u8 - 1)
    };
    let fixed = FieldSpec::Fixed { encoding: byte, value: 7 };
    let bits = Encoding::bit(T::Byte, 3);
    let unused =
        FieldSpec::DeviceInput { encoding: bits, overflow: Overflow::Usual, to: InputBinding::Unused };
    let (go, done, state) = (frame(b"G", fixed), frame(b"D", fixed), frame(b"E", unused));
    let talk = |request, reply| Transaction::Frames { request, reply, refusal: None };
    let start = Triggers { start: true, ..Triggers::NEVER };
    let start = never_late(Exchange::new(1, talk(go, done), start));
    let mut unasked = never_late(Exchange::new(1, talk(None, state), Triggers::NEVER));
    unasked.restarted = Some(Restarted { field: 0, value: 1.0 });
    let port = talking(&mut cell, &[start, unasked]);
    let mut line = Line::new(&cell, port);
    let mut asked = Vec::new();
    for state in [0, 8, 9, 0xF7, 0x08, 0x08] {
        line.comes(MS(10), &[b'E', 0, state]);
        asked.push(line.run(MS(200), |_| Some((MS(2), b"D\0\x07".to_vec()))).len());
    }
    assert_eq!(asked, [1, 1, 0, 0, 1, 0]);
    assert_eq!(line.peer(1).counters.starts, 2);
}
