//! Stopping goes first at devices too.

use super::*;

const STOP: u16 = 0x7C;

/// The axis with a write that stops it when bit 1 rises.
fn axis(change: impl FnOnce(&mut Cell, &mut Exchange, &mut Exchange) -> Vec<Exchange>) -> Axis {
    Axis::new(|cell, start| {
        let mut stop = sets(cell, 3, STOP, None, 1.0, rising(1));
        stop.stop = true;
        let others = change(cell, start, &mut stop);
        [vec![stop], others].concat()
    })
}

fn stops(axis: &mut Axis) -> Vec<Instant> {
    let stops = axis.done.iter().filter(|(_, address, _)| *address == STOP).map(|(at, ..)| *at).collect();
    axis.done.clear();
    stops
}

#[test]
fn a_stop_is_repeated_until_it_is_confirmed() {
    let mut axis = axis(|_, _, _| vec![]);
    let mut lost = 5;
    axis.line.bit(1, true);
    axis.run(3_000, |request| match write_in(request) {
        Some((STOP, 1)) if lost > 0 => {
            lost -= 1;
            None
        }
        _ => good(request),
    });
    assert_eq!(stops(&mut axis).len(), 6);
    axis.run(3_000, good);
    assert_eq!(stops(&mut axis).len(), 0);
}

#[test]
fn a_stop_cancels_what_waits_for_its_device_and_nothing_moves_before_it_is_confirmed() {
    let mut axis = axis(|_, start, _| {
        start.trigger = Some(MS(1_000));
        vec![]
    });
    axis.line.bit(0, true);
    axis.line.bit(1, true);
    let deaf = |request: &[u8]| if write_in(request).is_some() { None } else { good(request) };
    axis.run(500, deaf);
    axis.line.bit(0, false);
    axis.run(60, deaf);
    axis.line.bit(0, true);
    axis.run(60, deaf);
    assert!(axis.done.iter().all(|(_, address, _)| *address == STOP), "{:?}", axis.done);
    assert_eq!(axis.told()[0], 11);
    axis.run(2_000, good);
    assert_eq!(axis.taken(), []);
    axis.line.bit(0, false);
    axis.run(100, good);
    axis.pulse(good);
    assert_eq!(axis.taken(), [1_000], "it may move again");
}

#[test]
fn a_stop_to_a_device_that_is_away_goes_on_and_lets_others_go_on() {
    let mut axis = axis(|cell, _, _| {
        let other = reads_at(cell, 9, 0x30, "WordInputReg[2]", MS(50));
        vec![other]
    });
    let other = |request: &[u8]| if request[0] == 9 { good(request) } else { None };
    axis.run(3_000, other);
    axis.line.bit(1, true);
    let asked = axis.line.run(MS(4_000), |request| Some((MS(2), other(request)?)));
    let others = asked.iter().filter(|(_, request)| request[0] == 9).count();
    axis.note(asked);
    let times = stops(&mut axis);
    let longest = times.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap();
    assert!(times.len() >= 15 && longest < MS(400), "{} stops, {longest}", times.len());
    assert!(others > 15, "{others}");
    axis.run(1_000, good);
    assert_eq!(stops(&mut axis).len(), 1, "and then it is confirmed");
}

#[test]
fn a_stop_that_is_there_at_the_first_reading_stops() {
    let mut axis = axis(|_, _, _| vec![]);
    let link = axis.line.rig.engine.links().find(|link| link.name == "modbus").unwrap().id;
    axis.line.rig.input(proto_core::engine::Input::LinkDown { link });
    axis.line.bit(1, true);
    axis.run(2_000, good);
    assert_eq!(stops(&mut axis).len(), 1);
}

#[test]
fn a_reply_that_may_be_late_does_not_confirm_a_stop() {
    // The same register starts and stops: the replies to both are the same.
    let mut axis = axis(|cell, start, stop| {
        start.late = None;
        let field = FieldSpec::DeviceOutput {
            encoding: word(),
            overflow: Overflow::Usual,
            from: OutputBinding::Constant(0.0),
        };
        let written = cell.fields([field]);
        let operation = Operation::WriteRegisters { address: TARGET, count: 1 };
        stop.transaction = Transaction::Rtu { operation, written, read: Span::default() };
        stop.late = None;
        vec![]
    });
    axis.run(1_000, good);
    axis.line.bit(0, true);
    // Its reply comes 250 ms later, when the stop was sent and lost.
    let port = axis.line.port;
    let mut is_lost = true;
    let asked = axis.line.run(MS(150), |request| match write_in(request) {
        Some((TARGET, 1_000)) => Some((MS(250), answer(request, |_| 7))),
        _ => Some((MS(2), answer(request, |_| 7))),
    });
    axis.note(asked);
    axis.line.bit(1, true);
    let asked = axis.line.run(MS(2_000), |request| match write_in(request) {
        Some((TARGET, 0)) if is_lost => {
            is_lost = false;
            None
        }
        _ => Some((MS(2), answer(request, |_| 7))),
    });
    axis.note(asked);
    let told: Vec<_> = axis.done.iter().map(|(.., value)| *value).collect();
    assert_eq!((told[0], told[1..].iter().all(|value| *value == 0)), (1_000, true), "{told:?} on {port:?}");
    assert!(told.len() > 2, "the late reply to the start is none to the stop: {told:?}");
}

#[test]
fn a_device_that_was_away_is_stopped_once_when_it_is_back() {
    let mut axis = axis(|_, _, stop| {
        stop.late = None;
        vec![]
    });
    axis.run(2_000, good);
    axis.line.bit(1, true);
    axis.run(3_000, |_| None);
    assert!(stops(&mut axis).len() > 10, "it is wanted all the time");
    axis.run(3_000, good);
    assert_eq!(stops(&mut axis).len(), 1, "whichever of them was answered, it has stopped since");
}

#[test]
fn a_stop_goes_before_the_repetition_of_another_request() {
    let mut axis = axis(|cell, _, _| {
        let mut slow = reads_at(cell, 3, 0x30, "WordInputReg[2]", MS(300));
        slow.retries = 5;
        vec![slow]
    });
    let deaf = |request: &[u8]| if request[3] == 0x30 { None } else { good(request) };
    while axis
        .line
        .run(MS(1), |request| Some((MS(2), deaf(request)?)))
        .iter()
        .all(|(_, asked)| asked[3] != 0x30)
    {}
    axis.line.bit(1, true);
    let asked = axis.line.run(MS(400), |request| Some((MS(2), deaf(request)?)));
    let next = &asked[0].1;
    assert_eq!(
        write_in(next),
        Some((STOP, 1)),
        "{next:?}: the read waits for its reply, and not for five more"
    );
    let stopped = asked[0].0;
    axis.note(asked);
    assert_eq!(stops(&mut axis), [stopped]);
}

#[test]
fn a_stop_that_another_reply_seemed_to_answer_may_still_be_answered() {
    // Start and stop write the same register: the replies to both are the same.
    let mut axis = axis(|cell, start, stop| {
        start.late = None;
        stop.late = None;
        let field = FieldSpec::DeviceOutput {
            encoding: word(),
            overflow: Overflow::Usual,
            from: OutputBinding::Constant(0.0),
        };
        let written = cell.fields([field]);
        let operation = Operation::WriteRegisters { address: TARGET, count: 1 };
        stop.transaction = Transaction::Rtu { operation, written, read: Span::default() };
        vec![]
    });
    axis.run(1_000, good);
    axis.line.bit(0, true);
    let stops = std::cell::Cell::new(0);
    let slow = |request: &[u8]| {
        let delay = match write_in(request) {
            // Of the first start and the first stop: the start's comes while the stop is on its way.
            Some((TARGET, 1_000)) => MS(250),
            Some((TARGET, 0)) => {
                stops.set(stops.get() + 1);
                if stops.get() == 1 { MS(950) } else { MS(2) }
            }
            _ => MS(2),
        };
        Some((delay, answer(request, |_| 7)))
    };
    axis.line.run(MS(170), slow);
    axis.line.bit(1, true);
    axis.line.bit(0, false);
    axis.line.run(MS(940), slow);
    assert!(stops.get() > 1);
    // The device ignores this one.
    axis.line.bit(0, true);
    let asked = axis.line.run(MS(1_000), |request| {
        if write_in(request).is_some_and(|(_, value)| value != 0) { None } else { slow(request) }
    });
    axis.note(asked);
    assert!(axis.taken().iter().filter(|value| **value != 0).count() <= 1);
    assert_ne!(axis.told()[0], 2, "the late reply to the stop is none to the start");
    axis.line.bit(0, false);
    axis.run(3_000, good);
    axis.taken();
    axis.pulse(good);
    assert_eq!((axis.taken(), axis.told()[0]), (vec![1_000], 2), "it may move again");
}
