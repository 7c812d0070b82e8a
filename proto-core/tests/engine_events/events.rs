//! A triggered write is carried out once, now, or not at all.

use proto_core::engine::Input;

use super::*;

#[test]
fn one_rise_is_one_write_with_the_values_of_the_rise() {
    let mut axis = Axis::new(|_, _| vec![]);
    assert_eq!(axis.told(), [0, 0, 0]);
    axis.pulse(good);
    assert_eq!(axis.taken(), [1_000]);
    assert_eq!(axis.told(), [2, 0, 1]);
    axis.run(3_000, good);
    assert_eq!(axis.taken(), [], "the bit is 0");
    axis.line.word("WordOutputReg[1]", 2_000);
    axis.line.bit(0, true);
    axis.run(3_000, good);
    assert_eq!((axis.taken(), axis.told()), (vec![2_000], [2, 0, 2]), "the bit stays 1");
}

#[test]
fn a_lost_reply_starts_nothing_twice() {
    let mut axis = Axis::new(|_, _| vec![]);
    let deaf = |request: &[u8]| if request[1] == 16 { None } else { good(request) };
    axis.pulse(deaf);
    axis.run(10_000, deaf);
    assert_eq!((axis.taken(), axis.told()), (vec![1_000], [5, 0, 1]));
    axis.run(10_000, good);
    assert_eq!(axis.taken(), []);
    assert_eq!(axis.line.events(3).unknown, 1);
    axis.pulse(good);
    assert_eq!((axis.taken(), axis.told()), (vec![1_000], [2, 0, 2]), "the next one is done");
}

#[test]
fn only_the_file_lets_an_event_be_repeated() {
    let mut axis = Axis::new(|_, start| {
        start.event_retries = 2;
        vec![]
    });
    axis.pulse(|request| if request[1] == 16 { None } else { good(request) });
    axis.run(2_000, |request| if request[1] == 16 { None } else { good(request) });
    assert_eq!(axis.taken(), [1_000; 3]);
}

#[test]
fn what_a_limit_refuses_is_not_sent_when_it_is_allowed_again() {
    let mut axis = Axis::new(|_, _| vec![]);
    axis.line.word("WordOutputReg[1]", 65_000);
    axis.pulse(good);
    assert_eq!((axis.taken(), axis.told()), (vec![], [7, 0, 1]));
    axis.line.word("WordOutputReg[1]", 20_000);
    axis.run(5_000, good);
    assert_eq!(axis.taken(), []);
    assert_eq!(axis.line.events(3).out_of_limits, 1);
}

#[test]
fn a_device_that_is_away_does_not_move_when_it_is_back() {
    let mut axis = Axis::new(|_, _| vec![]);
    axis.run(2_000, |_| None);
    axis.pulse(|_| None);
    assert_eq!((axis.taken(), axis.told()), (vec![], [9, 0, 1]));
    axis.run(20_000, good);
    assert_eq!(axis.taken(), []);
    axis.pulse(good);
    assert_eq!(axis.taken(), [1_000]);
}

#[test]
fn a_device_that_goes_away_while_an_event_waits_does_not_move() {
    let mut axis = Axis::new(|_, start| {
        start.trigger = Some(MS(1_000));
        vec![]
    });
    // The poll is on its way, and is not answered: the event waits for the line.
    while axis.line.run(MS(1), |_| None).is_empty() {}
    axis.line.bit(0, true);
    axis.run(3_000, |request| {
        assert_eq!(request[1], 3, "nothing is written");
        None
    });
    assert_eq!(axis.told()[0], 9);
    axis.run(20_000, good);
    assert_eq!(axis.taken(), []);
}

#[test]
fn what_cannot_be_sent_in_time_is_gone() {
    // The line is held by a request to another slave, which takes longer than the event may wait.
    let mut axis = Axis::new(|cell, start| {
        start.trigger = Some(MS(40));
        let mut slow = reads_at(cell, 9, 0x30, "WordInputReg[2]", MS(100));
        (slow.timeout, slow.retries) = (MS(90), 0);
        vec![slow]
    });
    let mut expired = 0;
    for _ in 0..40 {
        axis.pulse(|request| if request[0] == 9 { None } else { good(request) });
        expired += u32::from(axis.told()[0] == 6);
        axis.run(37, good);
    }
    let events = axis.line.events(3);
    assert_eq!(events.done as usize, axis.taken().len());
    assert_eq!((events.done + events.expired, events.expired), (40, expired));
}

#[test]
fn a_second_rise_while_one_is_open_is_gone() {
    let mut axis = Axis::new(|_, start| {
        start.timeout = MS(400);
        vec![]
    });
    let slow = |request: &[u8]| if request[1] == 16 { None } else { good(request) };
    for _ in 0..2 {
        axis.line.bit(0, true);
        axis.run(60, slow);
        axis.line.bit(0, false);
        axis.run(60, slow);
    }
    axis.run(2_000, good);
    assert_eq!(axis.taken(), [1_000]);
    let events = axis.line.events(3);
    assert_eq!((events.still_open, events.unknown), (1, 1));
}

#[test]
fn a_value_that_is_read_apart_is_read_after_the_rise() {
    let mut axis = Axis::new(|_, _| vec![]);
    for target in [3_000, 4_000, 5_000] {
        // The robot sets both at once, between the reading of the registers and that of the bits.
        for offset in 0..8 {
            axis.run(97 + offset, good);
            axis.line.word("WordOutputReg[1]", target + u16::try_from(offset).unwrap());
            axis.pulse(good);
            assert_eq!(axis.taken(), [target + u16::try_from(offset).unwrap()]);
        }
    }
}

#[test]
fn a_bit_that_is_1_after_a_reconnect_has_not_risen() {
    let mut axis = Axis::new(|_, _| vec![]);
    let link = axis.line.rig.engine.links().find(|link| link.name == "modbus").unwrap().id;
    axis.line.rig.input(Input::LinkDown { link });
    axis.line.bit(0, true);
    axis.run(3_000, good);
    assert_eq!((axis.taken(), axis.told()), (vec![], [0, 0, 0]));
    axis.line.bit(0, false);
    axis.run(100, good);
    axis.pulse(good);
    assert_eq!(axis.taken(), [1_000]);
}

#[test]
fn a_0_that_is_old_is_no_beginning_of_a_rise() {
    let mut axis = Axis::new(|_, _| vec![]);
    // The controller does not answer for longer than values are fresh, over the same connection.
    axis.line.rig.modbus_answers = false;
    axis.run(600, good);
    axis.line.bit(0, true);
    axis.line.rig.modbus_answers = true;
    axis.run(3_000, good);
    assert_eq!(axis.taken(), []);
}

#[test]
fn a_gateway_that_slept_starts_nothing() {
    let mut axis = Axis::new(|_, _| vec![]);
    axis.line.rig.now += MS(5_000);
    axis.line.bit(0, true);
    axis.line.rig.input(Input::Tick);
    axis.run(3_000, good);
    assert_eq!(axis.taken(), []);
}

#[test]
fn a_short_pulse_is_seen_at_each_reading_and_not_each_cycle() {
    let mut axis = Axis::new(|cell, _| {
        // Another port has the bit read each 4 ms.
        let fields = cell.fields([FieldSpec::DeviceOutput {
            encoding: Encoding::scalar(T::Byte),
            overflow: Overflow::Usual,
            from: from(BITS),
        }]);
        let output = cell.part(&[1], &[2], fields);
        let recipe =
            cell.recipe(proto_core::recipe::model::Mode::User, Parts::Stream { input: None, output });
        cell.rs485(recipe);
        vec![]
    });
    axis.line.bit(0, true);
    axis.run(9, good);
    axis.line.bit(0, false);
    axis.run(200, good);
    assert_eq!(axis.taken().len(), 1);
}

#[test]
fn a_busy_device_is_asked_again_within_the_time_of_the_event() {
    let mut axis = Axis::new(|_, start| {
        start.trigger = Some(MS(1_000));
        vec![]
    });
    let mut busy = 2;
    let mut twice_busy = |request: &[u8]| match request[1] {
        16 if busy > 0 => {
            busy -= 1;
            Some(exception(request, 6))
        }
        _ => good(request),
    };
    axis.pulse(&mut twice_busy);
    axis.run(1_000, &mut twice_busy);
    assert_eq!((axis.taken(), axis.told()), (vec![1_000; 3], [2, 0, 1]), "twice it was not carried out");
    let busy = |request: &[u8]| if request[1] == 16 { Some(exception(request, 6)) } else { good(request) };
    axis.pulse(busy);
    axis.run(3_000, busy);
    assert!(axis.taken().len() > 1);
    assert_eq!(axis.told(), [6, 6, 2], "expired, with the code");
    axis.run(3_000, good);
    assert_eq!(axis.taken(), []);
}

#[test]
fn each_exception_has_its_meaning() {
    for (code, outcome) in [(1, 3), (2, 3), (3, 3), (4, 5), (5, 4), (7, 3), (8, 5), (10, 5), (11, 5)] {
        let mut axis = Axis::new(|_, _| vec![]);
        let refuses =
            |request: &[u8]| if request[1] == 16 { Some(exception(request, code)) } else { good(request) };
        axis.pulse(refuses);
        axis.run(5_000, refuses);
        assert_eq!((axis.taken(), axis.told()), (vec![1_000], [outcome, code.into(), 1]), "exception {code}");
    }
}

#[test]
fn a_busy_device_gets_a_value_that_changed() {
    let mut cell = Cell::new();
    let poll = reads_at(&mut cell, 3, 0x10, "WordInputReg[1]", MS(50));
    let when = Triggers { change: true, ..Triggers::NEVER };
    let speed = sets(&mut cell, 3, 0x20, Some("WordOutputReg[1]"), 0.0, when);
    let port = talking(&mut cell, &[poll, speed]);
    for code in [4, 6, 8, 10, 11] {
        let mut line = Line::new(&cell, port);
        let mut refusals = 3;
        let asked = line.run(MS(5_000), |request| {
            let is_refused = request[1] == 16 && refusals > 0;
            refusals -= i32::from(is_refused);
            Some((MS(2), if is_refused { exception(request, code) } else { answer(request, |_| 7) }))
        });
        let writes = asked.iter().filter(|(_, request)| request[1] == 16).count();
        assert_eq!(writes, 4, "exception {code}: three refusals, and then it has it");
    }
    // Refused for good, or accepted: it is over.
    for code in [2, 5] {
        let mut line = Line::new(&cell, port);
        let asked = line.run(MS(5_000), |request| {
            Some((MS(2), if request[1] == 16 { exception(request, code) } else { answer(request, |_| 7) }))
        });
        assert_eq!(asked.iter().filter(|(_, request)| request[1] == 16).count(), 1, "exception {code}");
    }
}

#[test]
fn a_port_that_goes_while_an_event_is_on_its_way_does_not_send_it_again() {
    let mut axis = Axis::new(|_, _| vec![]);
    axis.line.bit(0, true);
    let port = axis.line.port;
    axis.run(60, |request| if request[1] == 16 { None } else { good(request) });
    assert_eq!(axis.taken(), [1_000]);
    axis.line.rig.input(Input::PortDown { port });
    axis.line.rig.input(Input::PortUp { port });
    axis.run(3_000, good);
    assert_eq!((axis.taken(), axis.told()[0], axis.line.events(3).unknown), (vec![], 5, 1));
    // One that waits when the port goes is not sent either.
    axis.line.bit(0, false);
    axis.run(60, good);
    while axis.line.run(MS(1), |_| None).is_empty() {}
    axis.line.bit(0, true);
    axis.run(20, |_| None);
    axis.line.rig.input(Input::PortDown { port });
    axis.line.rig.input(Input::PortUp { port });
    axis.run(3_000, good);
    assert_eq!((axis.taken(), axis.told()[0]), (vec![], 9));
}

#[test]
fn a_device_that_has_moved_before_and_is_away_does_not_move_either() {
    let mut axis = Axis::new(|_, _| vec![]);
    axis.pulse(good);
    assert_eq!(axis.taken(), [1_000]);
    axis.run(2_000, |_| None);
    axis.pulse(|_| None);
    assert_eq!((axis.taken(), axis.told()[0]), (vec![], 9));
}

#[test]
fn one_lost_reply_to_an_event_does_not_make_a_device_away_that_is_asked_with_a_period() {
    let mut axis = Axis::new(|_, _| vec![]);
    axis.pulse(good);
    axis.pulse(|request| if request[1] == 16 { None } else { good(request) });
    assert_eq!(axis.line.peer(3).presence.name(), "up");
    axis.pulse(good);
    assert_eq!(axis.taken(), [1_000; 3]);
}

#[test]
fn a_device_that_is_only_told_something_now_and_then_is_told_it_again() {
    let mut cell = Cell::new();
    let start = sets(&mut cell, 3, TARGET, Some("WordOutputReg[1]"), 0.0, rising(0));
    let port = talking(&mut cell, &[start]);
    let mut axis = Axis { line: Line::new(&cell, port), done: vec![] };
    axis.line.word("WordOutputReg[1]", 1_000);
    axis.run(200, good);
    axis.pulse(|_| None);
    axis.run(2_000, good);
    assert_eq!(axis.taken(), [1_000]);
    // Nobody would have noticed that it is back.
    axis.pulse(good);
    assert_eq!((axis.taken(), axis.line.events(3).done), (vec![1_000], 1));
}
