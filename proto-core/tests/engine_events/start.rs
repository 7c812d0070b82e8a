//! Presence is of the device, not of an exchange; starting it is an event.

use super::*;

const ACTIVATE: u16 = 0x03E8;

/// An activation at the start, a register that is read, and one that the device never answers.
fn cell(is_dead: bool) -> (Cell, PortId) {
    let mut cell = Cell::new();
    let start = AskWhen { start: true, ..AskWhen::NEVER };
    let mut activate = sets(&mut cell, 9, ACTIVATE, None, 1.0, start);
    let mut status = reads_at(&mut cell, 9, 0x10, "WordInputReg[1]", MS(50));
    (activate.late, status.late) = (None, None);
    let mut table = vec![activate, status];
    if is_dead {
        // Its reply is told from the other's by its length.
        let mut dead = reads(&mut cell, 9, &["WordInputReg[2]", "WordInputReg[3]"], AskWhen::every(MS(100)));
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
        assert_eq!((before >= 1, activations(&asked)), (true, 1), "on {after} ms behind the gateway");
    }
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
