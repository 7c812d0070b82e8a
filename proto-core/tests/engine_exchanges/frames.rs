//! Exchanges with frames of a device's own, on lines and on CAN.

use proto_core::config::*;
use proto_core::device::{Algorithm, ByteOrder, Checksum, Encoding, Overflow};
use proto_core::engine::{Input, PortId, Rejection};
use proto_core::recipe::model::Mode;
use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType as T;

use crate::line::*;
use crate::rig::*;

fn byte_to_nothing() -> FieldSpec {
    FieldSpec::DeviceInput { encoding: byte(), overflow: Overflow::Usual, to: InputBinding::Unused }
}

fn asks(request: Option<u8>, reply: Option<u8>, refusal: Option<u8>, when: Triggers) -> Exchange {
    never_late(Exchange::new(0, Transaction::Frames { request, reply, refusal }, when))
}

/// A screwdriver: `Q` asks for torque and angle, which `A` answers and `N` refuses with a code. It says
/// `E` with a number when somebody presses its lever.
fn screwdriver(cell: &mut Cell) -> PortId {
    let request = frame_of(cell, None, &[], b"\r", vec![fixed(0x51)]);
    let reply =
        frame_of(cell, None, b"A", b"\r", vec![byte_to("WordInputReg[1]"), byte_to("WordInputReg[2]")]);
    let refusal = frame_of(cell, None, b"N", b"\r", vec![FieldSpec::Padding { len: 1, fill: 0 }]);
    let event = frame_of(cell, None, b"E", b"\r", vec![byte_to("WordInputReg[4]")]);
    let table =
        [asks(request, reply, refusal, Triggers::every(MS(50))), asks(None, event, None, Triggers::NEVER)];
    talking(cell, &table)
}

#[test]
fn a_reply_a_refusal_and_what_comes_unasked_are_told_apart() {
    let mut cell = Cell::new();
    let port = screwdriver(&mut cell);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(120), |request| {
        assert_eq!(request, b"Q\r");
        Some((MS(5), b"E\x07\rA\x0B\x16\r".to_vec()))
    });
    assert!(asked.len() >= 2);
    assert_eq!(line.rig.map.registers[8..12], [11, 22, 0, 7]);
    line.run(MS(100), |_| Some((MS(5), b"N\x63\r".to_vec())));
    assert_eq!(line.rig.map.registers[8..12], [11, 22, 0, 7]);
    let counters = line.rig.counters(port);
    assert!(counters.refused >= 1 && counters.unanswered == 0, "{counters:?}");
    line.run(MS(30), |_| None);
    // A reply that nobody waits for is no frame: it may be any age.
    let port = line.port;
    line.run(MS(300), |_| None);
    let before = line.rig.counters(port).frames_in;
    while !line.rig.sent_to(port).is_empty() {}
    line.rig.run(MS(1));
    let resync = line.rig.counters(port).resync_bytes;
    line.rig.bytes(port, b"A\x01\x02\r");
    let counters = line.rig.counters(port);
    let is_waiting = counters.frames_in > before;
    assert!(is_waiting || counters.resync_bytes == resync + 4);
    line.rig.bytes(port, b"E\x09\r");
    assert_eq!(line.rig.map.registers[11], 9);
}

/// A CRC's frame goes on with a right CRC if the next byte is the CRC's own first one. So a refusal with
/// this code begins as the reply of another device would be.
#[test]
fn a_refusal_that_begins_as_a_shorter_frame_of_another_device_is_taken() {
    let mut cell = Cell::new();
    let sum = || FieldSpec::Checksum(Checksum::standard(Algorithm::CRC16_MODBUS).over(1, None));
    let request = frame_of(&mut cell, None, b"Q", b"", vec![fixed(1), sum()]);
    let reply = frame_of(&mut cell, None, b"A", b"", vec![fixed(0x20), sum()]);
    let refusal = frame_of(&mut cell, None, b"A", b"", vec![fixed(0xA0), byte_to_nothing(), sum()]);
    let table = [asks(request, reply, refusal, Triggers::every(MS(50)))];
    let port = talking(&mut cell, &table);
    let mut line = Line::new(&cell, port);
    let seal = |bytes: &[u8]| {
        let crc = Algorithm::CRC16_MODBUS.of([&bytes[1..]]) as u16;
        [bytes, &crc.to_le_bytes()].concat()
    };
    let first = seal(&[b'A', 0xA0])[2];
    let refused = seal(&[b'A', 0xA0, first]);
    assert_eq!(refused[..4], seal(&[b'A', 0xA0]));
    line.run(MS(120), |_| Some((MS(5), refused.clone())));
    let counters = line.rig.counters(port);
    assert!(counters.refused >= 2 && counters.unanswered == 0, "{counters:?}");
    // One of another device is still told apart, when the line goes on.
    line.run(MS(120), |_| Some((MS(5), [seal(&[b'A', 0x30]), seal(&[b'A', 0x20])].concat())));
    let counters = line.rig.counters(port);
    assert!(counters.rejected_other_device >= 2 && counters.unanswered == 0, "{counters:?}");
}

/// While a request leaves, a wrong frame is heard; when it has left, the line has been silent behind that frame
/// for long enough.
#[test]
fn a_request_that_failed_while_it_was_leaving_is_repeated_at_once() {
    let mut cell = Cell::new();
    let sum = || FieldSpec::Checksum(Checksum::standard(Algorithm::CRC16_MODBUS).over(1, None));
    let request = frame_of(&mut cell, None, b"Q", b"", vec![fixed(1), sum()]);
    let reply = frame_of(&mut cell, None, b"A", b"", vec![fixed(0x20), byte_to("WordInputReg[1]"), sum()]);
    let exchange = asks(request, reply, None, Triggers::every(MS(200)));
    let port = talking(&mut cell, &[Exchange { timeout: MS(100), ..exchange }]);
    let mut rig = cell.rig();
    rig.reports_sent = false;
    rig.run(MS(1));
    rig.input(Input::PortSent { port });
    let seal = |bytes: &[u8]| {
        let crc = Algorithm::CRC16_MODBUS.of([&bytes[1..]]) as u16;
        [bytes, &crc.to_le_bytes()].concat()
    };
    assert_eq!(rig.sent_to(port), [seal(b"Q\x01")]);
    rig.bytes(port, &seal(b"A\x20\x07"));
    rig.run(MS(200));
    assert_eq!(rig.sent_to(port), [seal(b"Q\x01")], "the next period");
    let mut wrong = seal(b"A\x20\x08");
    wrong[2] ^= 1;
    rig.bytes(port, &wrong);
    rig.run(MS(10));
    rig.input(Input::PortSent { port });
    rig.run(Duration::from_micros(1));
    assert_eq!(rig.sent_to(port), [seal(b"Q\x01")], "its repetition");
    assert_eq!(rig.map.registers[8], 7);
}

/// A device that repeats what it is told, behind an adapter that does so as well.
#[test]
fn an_echo_behind_a_late_reply_is_no_reply() {
    let mut cell = Cell::new();
    let both = [0, 1].map(|_| frame_of(&mut cell, None, b"Q", b"", vec![fixed(1)]));
    let port = talking(&mut cell, &[asks(both[0], both[1], None, Triggers::every(MS(50)))]);
    let Bus::Rs485(settings) = &mut cell.last_port().bus else { panic!() };
    settings.echo = Echo::Yes;
    let mut line = Line::new(&cell, port);
    line.run(MS(220), |request| Some((MS(3), [b"Z\x01", request].concat())));
    let counters = line.rig.counters(port);
    assert!(counters.frames_in == 0 && counters.unanswered > 0, "{counters:?}");
    assert_eq!(counters.resync_bytes, counters.frames_out * 2, "{counters:?}");
    line.run(MS(2_000), |request| Some((MS(3), [b"Z\x01", request, request].concat())));
    assert!(line.rig.counters(port).frames_in > 10);
}

#[test]
fn a_request_and_its_reply_may_be_a_head_alone() {
    let mut cell = Cell::new();
    let sum = || vec![FieldSpec::Checksum(Checksum::standard(Algorithm::CRC16_MODBUS))];
    let request = frame_of(&mut cell, None, &[1, 3], b"", sum());
    let reply = frame_of(&mut cell, None, b"OK", b"\r", vec![]);
    let port = talking(&mut cell, &[asks(request, reply, None, Triggers::every(MS(50)))]);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(220), |_| Some((MS(3), b"OK\r".to_vec())));
    assert!(asked.len() >= 4 && asked.iter().all(|(_, sent)| *sent == with_crc(&[1, 3])), "{asked:02X?}");
    let counters = line.rig.counters(port);
    assert_eq!((counters.frames_in, counters.unanswered), (asked.len() as u32, 0), "{counters:?}");
}

#[test]
fn a_request_waits_for_a_frame_of_the_part_to_leave_and_the_part_for_the_reply() {
    let mut cell = Cell::new();
    let request = frame_of(&mut cell, None, &[], &[], vec![fixed(0x51)]);
    let reply = frame_of(&mut cell, None, b"A", b"", vec![byte_to("WordInputReg[1]")]);
    let lamp = cell.fields([fixed(0x4C), fixed(1)]);
    let output = cell.part(&[], &[], lamp);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.0.exchanges.push(asks(request, reply, None, Triggers::every(MS(10)))).unwrap();
    cell.last_recipe().exchanges = Span { start: 0, len: 1 };
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.reports_sent = false;
    rig.log.clear();
    rig.input(Input::PortSent { port });
    let mut sent = Vec::new();
    for _ in 0..200 {
        rig.run(MS(1));
        let now = rig.sent_to(port);
        assert!(now.len() <= 1, "two frames at once: {now:?}");
        let Some(frame) = now.first().cloned() else { continue };
        rig.run(MS(1));
        assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new(), "{frame:?} has not left");
        rig.input(Input::PortSent { port });
        if frame == b"Q" {
            assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new(), "the reply is awaited");
            rig.run(MS(2));
            assert_eq!(rig.sent_to(port), Vec::<Vec<u8>>::new(), "the reply is awaited");
            rig.bytes(port, b"A\x05");
        }
        sent.push(frame);
    }
    assert!(sent.iter().filter(|frame| *frame == b"Q").count() > 10, "{sent:?}");
    assert!(sent.iter().filter(|frame| *frame == b"L\x01").count() > 10, "{sent:?}");
    assert_eq!(rig.counters(port).unanswered, 0);
}

/// A CANopen encoder, node 5: NMT start, its position by SDO, its heartbeat.
fn encoder(cell: &mut Cell) -> PortId {
    let start = frame_of(cell, Some(0), &[], &[], vec![fixed(1), fixed(5)]);
    let upload =
        |sub| vec![fixed(0x40), fixed(0x04), fixed(0x60), fixed(sub), FieldSpec::Padding { len: 4, fill: 0 }];
    let request = frame_of(cell, Some(0x605), &[], &[], upload(0));
    let position = FieldSpec::DeviceInput {
        encoding: Encoding { order: ByteOrder::Little, ..Encoding::scalar(T::Dword) },
        overflow: Overflow::Usual,
        to: to("WordInputReg[1]"),
    };
    let reply =
        frame_of(cell, Some(0x585), &[], &[], vec![fixed(0x43), fixed(4), fixed(0x60), fixed(0), position]);
    let abort = vec![fixed(0x80), fixed(4), fixed(0x60), fixed(0), FieldSpec::Padding { len: 4, fill: 0 }];
    let refusal = frame_of(cell, Some(0x585), &[], &[], abort);
    let heartbeat = frame_of(cell, Some(0x705), &[], &[], vec![byte_to("WordInputReg[2]")]);
    let once = Triggers { start: true, ..Triggers::NEVER };
    let table = [
        asks(start, None, None, once),
        asks(request, reply, refusal, Triggers::every(MS(20))),
        asks(None, heartbeat, None, Triggers::NEVER),
    ];
    let parts = Parts::Can { input: Default::default(), output: Default::default() };
    let recipe = cell.recipe(Mode::User, parts);
    cell.0.exchanges.extend(table);
    cell.last_recipe().exchanges = Span { start: 0, len: 3 };
    cell.can_port(recipe)
}

#[test]
fn a_canopen_node_is_started_and_asked_by_sdo() {
    let mut cell = Cell::new();
    let port = encoder(&mut cell);
    let mut rig = cell.rig();
    let (mut starts, mut uploads) = (0, 0_u8);
    for step in 0..100_u8 {
        rig.run(MS(5));
        for frame in rig.can_sent_to(port) {
            match (frame.id(), frame.data()) {
                (CanId::Standard(0), [1, 5]) => starts += 1,
                (CanId::Standard(0x605), [0x40, 4, 0x60, 0, 0, 0, 0, 0]) => {
                    uploads += 1;
                    // Another object's reply is not ours.
                    rig.can(port, 0x585, &[0x43, 5, 0x60, 0, 99, 0, 0, 0]);
                    rig.can(port, 0x585, &[0x43, 4, 0x60, 0, step, 1, 0, 0]);
                }
                other => panic!("{other:02X?}"),
            }
        }
        if step % 20 == 0 {
            rig.can(port, 0x705, &[5]);
        }
    }
    assert_eq!(starts, 1);
    assert!(uploads > 20, "{uploads}");
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_other_device, counters.unanswered), (u32::from(uploads), 0));
    assert!(rig.map.registers[8] > 256 && rig.map.registers[9] == 5);
    // An abort is told.
    rig.run(MS(20));
    assert!(!rig.can_sent_to(port).is_empty());
    rig.can(port, 0x585, &[0x80, 4, 0x60, 0, 0, 0, 2, 6]);
    assert_eq!(rig.counters(port).refused, 1);
    // After bus-off the node may have restarted.
    rig.input(Input::PortBus { port, state: proto_core::engine::BusState::BusOff });
    rig.input(Input::PortBus { port, state: proto_core::engine::BusState::Active });
    let start = CanFrame::new(CanId::Standard(0), &[1, 5]).unwrap();
    rig.run(MS(50));
    let sent = rig.can_sent_to(port);
    assert!(!sent.contains(&start), "nothing says that it is there: {sent:?}");
    rig.can(port, 0x585, &[0x43, 4, 0x60, 0, 1, 1, 0, 0]);
    rig.run(MS(50));
    let again = rig.can_sent_to(port);
    assert!(again.contains(&start), "{again:?}");
}

#[test]
fn a_remote_request_polls_a_node() {
    let mut cell = Cell::new();
    let poll = frame_of(&mut cell, Some(0x181), &[], &[], vec![]);
    cell.0.frames.last_mut().unwrap().remote = true;
    let reply = frame_of(&mut cell, Some(0x181), &[], &[], vec![byte_to("WordInputReg[1]")]);
    let recipe =
        cell.recipe(Mode::User, Parts::Can { input: Default::default(), output: Default::default() });
    cell.0.exchanges.push(asks(poll, reply, None, Triggers::every(MS(15)))).unwrap();
    cell.last_recipe().exchanges = Span { start: 0, len: 1 };
    let port = cell.can_port(recipe);
    let mut rig = cell.rig();
    for _ in 0..10 {
        rig.run(MS(10));
        for frame in rig.can_sent_to(port) {
            assert_eq!(frame, CanFrame::remote(CanId::Standard(0x181), 1).unwrap());
            rig.can(port, 0x181, &[42]);
        }
    }
    assert_eq!(rig.map.registers[8], 42);
    // Unasked, its age is not known.
    rig.run(MS(1));
    assert_eq!(rig.can_sent_to(port), []);
    rig.can(port, 0x181, &[43]);
    let now = rig.now;
    let last = rig.engine.status(now).ports().next().unwrap().last_rejection.unwrap();
    assert_eq!((last.why, rig.map.registers[8]), (Rejection::ForeignId, 42));
}

#[test]
fn a_frame_on_its_way_still_is_when_a_node_does_not_answer() {
    let mut cell = Cell::new();
    let poll = frame_of(&mut cell, Some(0x181), &[], &[], vec![]);
    cell.0.frames.last_mut().unwrap().remote = true;
    let reply = frame_of(&mut cell, Some(0x181), &[], &[], vec![byte_to("WordInputReg[1]")]);
    let counter =
        FieldSpec::DeviceOutput { encoding: byte(), overflow: Overflow::Usual, from: OutputBinding::Counter };
    let fields = cell.fields([counter]);
    let mut output = heapless::Vec::new();
    output.push(CanFramePart { id: CanId::Standard(0x201), fields }).unwrap();
    let recipe = cell.recipe(Mode::User, Parts::Can { input: Default::default(), output });
    let silent = asks(poll, reply, None, Triggers::every(MS(50)));
    cell.0.exchanges.push(Exchange { timeout: MS(5), ..silent }).unwrap();
    cell.last_recipe().exchanges = Span { start: 0, len: 1 };
    let port = cell.can_port(recipe);
    cell.last_port().cycle = MS(20);
    let mut rig = cell.rig();
    rig.reports_sent = false;
    // The bus is so full that a frame needs longer than the timeout.
    let mut on_its_way = 0;
    for step in 0..60 {
        rig.run(MS(4));
        on_its_way += rig.can_sent_to(port).len();
        assert!(on_its_way <= 1, "a frame was handed over before the last had left");
        if step % 3 == 2 && on_its_way > 0 {
            rig.input(Input::PortSent { port });
            on_its_way = rig.can_sent_to(port).len();
        }
    }
    assert!(rig.counters(port).unanswered > 0);
}

#[test]
fn the_line_is_silent_between_requests_that_nobody_answers() {
    let mut cell = Cell::new();
    let table = [0x51, 0x52].map(|letter| {
        let request = frame_of(&mut cell, None, &[], b"\r", vec![fixed(letter)]);
        asks(request, None, None, Triggers::every(MS(20)))
    });
    let port = talking(&mut cell, &table);
    let Bus::Rs485(settings) = &mut cell.last_port().bus else { panic!() };
    settings.turnaround = MS(3);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(200), |_| None);
    let rests: Vec<_> = asked.windows(2).map(|pair| pair[1].0.saturating_since(pair[0].0)).collect();
    assert!(rests.len() > 15 && rests.iter().all(|rest| *rest >= MS(3)), "{rests:?}");
}
