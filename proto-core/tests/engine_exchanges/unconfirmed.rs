//! Requests without a reply, to a peer that is asked with one as well: its replies say whether it is there.

use proto_core::config::*;
use proto_core::device::{ByteOrder, Encoding, Overflow};
use proto_core::engine::Input;
use proto_core::time::Duration;
use proto_core::wire::scalar::ScalarType as T;

use crate::line::*;
use crate::rig::*;

const ON_START: Triggers = Triggers { start: true, ..Triggers::NEVER };
const ON_CHANGE: Triggers = Triggers { change: true, ..Triggers::NEVER };
const ON_BOTH: Triggers = Triggers { start: true, ..ON_CHANGE };

fn frame(cell: &mut Cell, head: &[u8], fields: Vec<FieldSpec>) -> Option<u8> {
    frame_of(cell, None, head, b"\r", fields)
}

/// `C` and the command, which the gripper does not confirm.
fn command(cell: &mut Cell, when: Triggers) -> Exchange {
    let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(T::Word) };
    let field =
        FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from: from("WordOutputReg[1]") };
    let request = frame(cell, b"C", vec![field]);
    never_late(Exchange::new(1, Transaction::Frames { request, reply: None, refusal: None }, when))
}

/// A letter alone, confirmed with the same small letter or not at all.
fn letter(cell: &mut Cell, letter: u8, is_answered: bool, when: Triggers) -> Exchange {
    let fixed =
        |value: u8| vec![FieldSpec::Fixed { encoding: Encoding::scalar(T::Byte), value: value.into() }];
    let request = frame(cell, &[], fixed(letter));
    let small = fixed(letter.to_ascii_lowercase());
    let reply = is_answered.then(|| frame(cell, &[], small)).flatten();
    never_late(Exchange::new(1, Transaction::Frames { request, reply, refusal: None }, when))
}

/// A gripper that takes commands, and is asked for its position each 100 ms.
fn gripper(when: Triggers) -> Line {
    let mut cell = Cell::new();
    let commands = command(&mut cell, when);
    let position = letter(&mut cell, b'Q', true, Triggers::every(MS(100)));
    let port = talking(&mut cell, &[commands, position]);
    cell.last_port().absent = MS(1_000);
    let mut line = Line::new(&cell, port);
    set(&mut line, 1);
    line
}

/// The robot commands this.
fn set(line: &mut Line, value: u16) {
    let place = var("WordOutputReg[1]").modbus().unwrap();
    let proto_core::sysvar::ModbusPlace::Register { address } = place else { panic!() };
    line.rig.map.registers[usize::from(address)] = value;
}

/// Runs the line with a device that confirms, or is off; returns what it was told.
fn told(line: &mut Line, span: Duration, is_on: bool) -> Vec<Vec<u8>> {
    let asked = line.run(span, |request| {
        let is_confirmed = is_on && matches!(request[0], b'Q' | b'S');
        is_confirmed.then(|| (MS(2), request.to_ascii_lowercase()))
    });
    asked.into_iter().map(|(_, request)| request).collect()
}

/// The same, but only the commands.
fn commands(line: &mut Line, span: Duration, is_on: bool) -> Vec<u8> {
    let told = told(line, span, is_on);
    told.iter().filter(|request| request[0] == b'C').map(|request| request[2]).collect()
}

#[test]
fn a_change_waits_until_the_device_answers_and_is_sent_once() {
    let mut line = gripper(ON_CHANGE);
    assert_eq!(commands(&mut line, MS(1_000), true), [1]);
    assert_eq!(commands(&mut line, MS(1_000), false), []);
    set(&mut line, 6);
    assert_eq!(commands(&mut line, MS(1_000), false), []);
    set(&mut line, 7);
    assert_eq!(commands(&mut line, MS(1_000), false), [], "nobody would hear it");
    assert_eq!(commands(&mut line, MS(12_000), true), [7], "the newest");
}

#[test]
fn a_counter_in_a_request_is_no_change() {
    let mut cell = Cell::new();
    let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(T::Word) };
    let value =
        FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from: from("WordOutputReg[1]") };
    let encoding = Encoding::scalar(T::Byte);
    let counter =
        FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from: OutputBinding::Counter };
    let request = frame(&mut cell, b"C", vec![value, counter]);
    let each =
        never_late(Exchange::new(1, Transaction::Frames { request, reply: None, refusal: None }, ON_CHANGE));
    let position = letter(&mut cell, b'Q', true, Triggers::every(MS(100)));
    let port = talking(&mut cell, &[each, position]);
    let mut line = Line::new(&cell, port);
    for value in [1, 2, 3] {
        set(&mut line, value);
        assert_eq!(commands(&mut line, MS(2_000), true), [value as u8]);
    }
}

#[test]
fn a_command_of_the_start_is_repeated_once_when_the_device_is_back() {
    let mut line = gripper(ON_BOTH);
    assert_eq!(commands(&mut line, MS(1_000), true), [1]);
    assert_eq!(commands(&mut line, MS(3_000), false), [], "no probe repeats it");
    assert_eq!(commands(&mut line, MS(12_000), true), [1]);
    assert_eq!(commands(&mut line, MS(3_000), false), []);
    set(&mut line, 2);
    assert_eq!(commands(&mut line, MS(12_000), true), [2], "for the return and the change together");
}

#[test]
fn a_device_that_is_off_at_the_start_is_told_once_when_it_comes() {
    let mut line = gripper(ON_BOTH);
    // Whether it is there is not known yet.
    assert_eq!(commands(&mut line, MS(4_000), false), [1]);
    assert_eq!(commands(&mut line, MS(12_000), true), [1]);
}

#[test]
fn what_comes_first_at_the_start_comes_first_when_the_device_is_back() {
    let mut cell = Cell::new();
    let table = [
        letter(&mut cell, b'R', false, ON_START),
        letter(&mut cell, b'S', true, ON_START),
        letter(&mut cell, b'T', false, ON_START),
        letter(&mut cell, b'Q', true, Triggers::every(MS(100))),
    ];
    let port = talking(&mut cell, &table);
    cell.last_port().absent = MS(1_000);
    let mut line = Line::new(&cell, port);
    let letters = |told: Vec<Vec<u8>>| told.iter().map(|request| request[0]).collect::<Vec<_>>();
    // The first answer tells that it is there.
    assert_eq!(letters(told(&mut line, MS(250), true))[..5], *b"QRSTQ");
    let silent = letters(told(&mut line, MS(3_000), false));
    assert!(silent.len() > 2 && silent.iter().all(|letter| *letter == b'Q'), "{silent:?}");
    let back = letters(told(&mut line, MS(12_000), true));
    assert_eq!(back[..5], *b"QRSTQ", "{back:?}");
    assert!(back[5..].iter().all(|letter| *letter == b'Q'), "{back:?}");
}

#[test]
fn a_device_that_never_answers_anything_is_told_each_period() {
    let mut cell = Cell::new();
    let lamp = letter(&mut cell, b'L', false, Triggers::every(MS(100)));
    let port = talking(&mut cell, &[lamp]);
    let mut line = Line::new(&cell, port);
    let count = told(&mut line, MS(1_000), false).len();
    assert!((9..=11).contains(&count), "{count}");
}

#[test]
fn a_value_that_has_been_sent_is_no_change() {
    let mut cell = Cell::new();
    let when = Triggers { every: Some(MS(70)), ..ON_CHANGE };
    let each = command(&mut cell, when);
    let port = talking(&mut cell, &[each]);
    // Changes are looked for seldom, so that the period sends one first; the other port has it polled often.
    cell.last_port().cycle = MS(1_000);
    let other = command(&mut cell, ON_CHANGE);
    talking(&mut cell, &[other]);
    let mut line = Line::new(&cell, port);
    set(&mut line, 1);
    assert!(commands(&mut line, MS(1_505), true).len() > 5);
    set(&mut line, 2);
    let asked = line.run(MS(1_000), |_| None);
    let gaps: Vec<_> = asked.windows(2).map(|pair| pair[1].0.saturating_since(pair[0].0)).collect();
    assert!(gaps.len() > 10 && gaps.iter().all(|gap| *gap >= MS(60)), "{gaps:?}");
}

#[test]
fn a_command_that_is_leaving_when_the_gateway_sleeps_is_not_sent_again() {
    let mut line = gripper(ON_BOTH);
    line.rig.reports_sent = false;
    assert_eq!(commands(&mut line, MS(200), true), [1]);
    line.rig.now += MS(700);
    line.rig.input(Input::Tick);
    line.rig.reports_sent = true;
    line.rig.input(Input::PortSent { port: line.port });
    assert_eq!(commands(&mut line, MS(2_000), true), []);
    assert_eq!(line.rig.engine.sleeps(), 1);
}
