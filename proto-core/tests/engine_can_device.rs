//! CAN ports with a device's own frames: several with one id, which constants tell apart.

mod rig;

use proto_core::config::*;
use proto_core::device::{Algorithm, Checksum, Encoding, LayoutError, Overflow};
use proto_core::engine::{PortId, Rejection};
use proto_core::recipe::PartError;
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{Direction, ModbusPlace};
use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType as T};
use rig::*;

fn byte() -> Encoding {
    Encoding::scalar(T::Byte)
}

fn to(name: &str) -> InputBinding {
    InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 }
}

fn input(ty: T, to: InputBinding) -> FieldSpec {
    FieldSpec::UserInput { ty, to }
}

fn fixed(value: i64) -> FieldSpec {
    FieldSpec::Fixed { encoding: byte(), value }
}

fn output(value: f64) -> FieldSpec {
    FieldSpec::UserOutput { ty: T::Byte, from: OutputBinding::Constant(value) }
}

/// A CAN port with these frames.
fn bus(cell: &mut Cell, frames: [&[(u16, Vec<FieldSpec>)]; 2]) -> PortId {
    let mut part = |frames: &[(u16, Vec<FieldSpec>)]| {
        let mut part = heapless::Vec::new();
        for (id, fields) in frames {
            let fields = cell.fields(fields.iter().copied());
            part.push(CanFramePart { id: CanId::Standard(*id), fields }).unwrap();
        }
        part
    };
    let parts = Parts::Can { input: part(frames[0]), output: part(frames[1]) };
    let recipe = cell.recipe(Mode::User, parts);
    cell.can_port(recipe)
}

/// A battery: the voltages of its cells two by two, then its temperature, all with id 0x200.
fn battery(cell: &mut Cell) -> PortId {
    let cells = |first, [one, two]: [&str; 2]| {
        (0x200, vec![fixed(first), input(T::Word, to(one)), input(T::Word, to(two))])
    };
    let temperature = (0x200, vec![fixed(9), input(T::Byte, to("WordInputReg[5]"))]);
    let frames = [
        cells(1, ["WordInputReg[1]", "WordInputReg[2]"]),
        cells(3, ["WordInputReg[3]", "WordInputReg[4]"]),
        temperature,
    ];
    bus(cell, [&frames, &[]])
}

#[test]
fn multiplexed_frames_are_told_apart_by_their_constant() {
    let mut cell = Cell::new();
    let port = battery(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 0x200, &[3, 30, 0, 40, 0]);
    rig.can(port, 0x200, &[9, 55]);
    rig.can(port, 0x200, &[1, 10, 0, 20, 0]);
    rig.run(MS(10));
    assert_eq!(rig.map.registers[8..13], [10, 20, 30, 40, 55]);
    assert_eq!(rig.counters(port).frames_in, 3);
}

#[test]
fn each_of_them_has_an_age_of_its_own() {
    let mut cell = Cell::new();
    let port = battery(&mut cell);
    let safe = SafeValue::new(var("WordInputReg[5]"), Scalar::Word(99));
    cell.0.safe_values.push(safe).unwrap();
    let config = &mut cell.0.ports[usize::from(port.0)];
    (config.on_timeout, config.timeout) = (Span { start: 0, len: 1 }, Duration::from_millis(100));
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 0x200, &[9, 55]);
    rig.can(port, 0x200, &[1, 10, 0, 20, 0]);
    for _ in 0..12 {
        rig.run(MS(10));
        rig.can(port, 0x200, &[1, 10, 0, 20, 0]);
    }
    rig.run(MS(10));
    assert_eq!(rig.map.registers[12], 99, "the temperature is silent");
    assert_eq!(rig.map.registers[8], 10);
}

#[test]
fn a_constant_that_no_frame_has_is_of_another_device_and_another_length_is_that() {
    let mut cell = Cell::new();
    let port = battery(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 0x200, &[5, 1, 0, 2, 0]);
    rig.can(port, 0x200, &[5, 1]);
    rig.can(port, 0x200, &[1, 1, 0]);
    rig.can(port, 0x201, &[1, 1, 0]);
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_other_device, counters.rejected_length, counters.rejected_id), (2, 1, 1));
    assert_eq!(counters.frames_in, 0);
}

#[test]
fn a_wrong_checksum_in_one_of_them_is_that() {
    let mut cell = Cell::new();
    let sum = FieldSpec::Checksum(Checksum::standard(Algorithm::named("xor8").unwrap()));
    let summed = |mux, name| (0x300, vec![fixed(mux), input(T::Byte, to(name)), sum]);
    let frames = [summed(1, "WordInputReg[1]"), summed(2, "WordInputReg[2]")];
    let port = bus(&mut cell, [&frames, &[]]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(port, 0x300, &[2, 7, 5]);
    rig.can(port, 0x300, &[2, 7, 6]);
    rig.can(port, 0x300, &[4, 7, 3]);
    let counters = rig.counters(port);
    let rejected = (counters.rejected_checksum, counters.rejected_other_device);
    assert_eq!((counters.frames_in, rejected), (1, (1, 1)));
}

#[test]
fn frames_with_one_id_are_sent_one_after_the_other_in_a_cycle() {
    let mut cell = Cell::new();
    let frames = [(0x10, vec![output(1.0), output(7.0)]), (0x10, vec![output(2.0), output(8.0)])];
    let port = bus(&mut cell, [&[], &frames]);
    let mut rig = cell.rig();
    rig.run(MS(50));
    let sent = rig.can_sent_to(port);
    let data: Vec<_> = sent.iter().map(|frame| frame.data().to_vec()).collect();
    assert!(data.len() >= 4, "{data:?}");
    assert!(data.chunks_exact(2).all(|pair| pair == [vec![1, 7], vec![2, 8]]), "{data:?}");
}

#[test]
fn frames_with_one_id_that_no_constant_tells_apart_are_refused() {
    let refused = |frames: [&[(u16, Vec<FieldSpec>)]; 2]| {
        let mut cell = Cell::new();
        bus(&mut cell, frames);
        cell.0.validate().err()
    };
    let error = |part, frame, first| {
        let error = PartError::Indistinguishable { frame, first, id: CanId::Standard(5) };
        let place = Place::Frame { recipe: 0, part, frame };
        Some(ConfigError { place, kind: ConfigErrorKind::Part(error) })
    };
    let word = |name: &str| input(T::Word, to(name));
    let frame = |constant, name: &str| (5, vec![fixed(constant), word(name)]);
    let (one, two) = (frame(1, "WordInputReg[1]"), frame(2, "WordInputReg[2]"));
    let three = frame(1, "WordInputReg[3]");
    assert_eq!(refused([&[one.clone(), two.clone()], &[]]), None);
    assert_eq!(refused([&[one.clone(), two.clone(), three], &[]]), error(Direction::Input, 2, 0));
    // The constants stand at different places.
    let behind = (5, vec![word("WordInputReg[4]"), fixed(2)]);
    assert_eq!(refused([&[one.clone(), behind], &[]]), error(Direction::Input, 1, 0));
    let plain = (5, vec![word("WordInputReg[4]")]);
    assert_eq!(refused([&[plain.clone(), one], &[]]), error(Direction::Input, 1, 0));
    let out = |value| (5, vec![output(value)]);
    assert_eq!(refused([&[], &[out(1.0), out(2.0)]]), None);
    assert_eq!(refused([&[], &[out(1.0), out(1.0)]]), error(Direction::Output, 1, 0));
    // Bits of one byte tell frames apart, if they are the same bits.
    let bits = |first, count, value| {
        let kind = proto_core::device::Kind::Bits(proto_core::device::Bits {
            bytes: 1,
            first,
            count,
            signed: false,
        });
        let encoding = Encoding { kind, ..byte() };
        let data =
            FieldSpec::DeviceInput { encoding: byte(), overflow: Overflow::Usual, to: InputBinding::Unused };
        (5, vec![FieldSpec::Fixed { encoding, value }, data])
    };
    assert_eq!(refused([&[bits(4, 4, 1), bits(4, 2, 2)], &[]]), None);
    assert_eq!(refused([&[bits(4, 4, 1), bits(0, 4, 2)], &[]]), error(Direction::Input, 1, 0));
    assert_eq!(refused([&[bits(0, 3, 7), bits(2, 1, 0)], &[]]), None);
}

#[test]
fn a_port_hears_the_ids_of_its_exchanges() {
    let mut cell = Cell::new();
    bus(&mut cell, [&[(0x181, vec![input(T::Byte, to("WordInputReg[1]"))])], &[]]);
    let mut frame = |id: u16, fields: Vec<FieldSpec>| {
        let fields = cell.fields(fields);
        let (head, tail) = (Delimiter::new(), Delimiter::new());
        let id = Some(CanId::Standard(id));
        cell.0.frames.push(FrameSpec { id, remote: false, head, tail, fields }).unwrap();
        Some(cell.0.frames.len() as u8 - 1)
    };
    let request = frame(0x601, vec![output(0.0)]);
    let reply = frame(0x581, vec![fixed(0x43), input(T::Byte, to("WordInputReg[2]"))]);
    let refusal = frame(0x581, vec![fixed(0x80), input(T::Byte, InputBinding::Unused)]);
    let heartbeat = frame(0x701, vec![input(T::Byte, to("WordInputReg[3]"))]);
    let asked = Transaction::Frames { request, reply, refusal };
    let unasked = Transaction::Frames { request: None, reply: heartbeat, refusal: None };
    cell.0.exchanges.push(Exchange::new(0, asked, Triggers::every(MS(100)))).unwrap();
    cell.0.exchanges.push(Exchange::new(0, unasked, Triggers::NEVER)).unwrap();
    cell.last_recipe().exchanges = Span { start: 0, len: 2 };
    cell.0.validate().unwrap();
    let view = cell.0.view();
    let ids = |part| view.can_ids(&view.recipes[0], part).collect::<Vec<_>>();
    let standard = |ids: &[u16]| ids.iter().map(|&id| CanId::Standard(id)).collect::<Vec<_>>();
    assert_eq!(ids(Direction::Input), standard(&[0x181, 0x581, 0x701]));
    assert_eq!(ids(Direction::Output), standard(&[0x601]));
    // A refusal that is always taken for the reply is refused, and so is a reply that is not told from what comes unasked.
    let refused = |cell: &Cell| match cell.0.validate() {
        Err(ConfigError { place: Place::Exchange { exchange, key, .. }, kind }) => (exchange, key, kind),
        other => panic!("{other:?}"),
    };
    let kind = |id| ConfigErrorKind::Exchange(ExchangeError::Indistinguishable { id: CanId::Standard(id) });
    let mut same = Cell(cell.0.clone());
    let fields = same.fields([fixed(0x43), input(T::Byte, InputBinding::Unused)]);
    same.0.frames[usize::from(refusal.unwrap())].fields = fields;
    let hidden = ConfigErrorKind::Exchange(ExchangeError::Hidden);
    assert_eq!(refused(&same), (0, ExchangeKey::Refusal, hidden));
    let mut unasked = cell;
    unasked.0.frames[usize::from(heartbeat.unwrap())].id = Some(CanId::Standard(0x581));
    assert_eq!(refused(&unasked), (1, ExchangeKey::Reply, kind(0x581)));
    unasked.0.frames[usize::from(heartbeat.unwrap())].id = Some(CanId::Standard(0x181));
    assert_eq!(refused(&unasked), (1, ExchangeKey::Reply, kind(0x181)));
}

/// A sensor that counts its frames from 0 to 14, with a value that is 0 when it is silent.
fn counting(cell: &mut Cell) -> PortId {
    let counter = InputBinding::Counter { max: 14 };
    let port =
        bus(cell, [&[(0x50, vec![input(T::Byte, counter), input(T::Byte, to("WordInputReg[1]"))])], &[]]);
    let safe = SafeValue::new(var("WordInputReg[1]"), Scalar::Word(0));
    cell.0.safe_values.push(safe).unwrap();
    let config = &mut cell.0.ports[usize::from(port.0)];
    (config.on_timeout, config.timeout) = (Span { start: 0, len: 1 }, Duration::from_millis(100));
    port
}

#[test]
fn a_frozen_device_falls_silent_although_its_frames_come() {
    let mut cell = Cell::new();
    let port = counting(&mut cell);
    let mut rig = cell.rig();
    for count in 0..40_u8 {
        rig.run(MS(10));
        rig.can(port, 0x50, &[count % 15, 7]);
    }
    rig.run(MS(10));
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_counter, counters.counter_jumps), (40, 0, 0));
    assert_eq!(rig.map.registers[8], 7);
    for _ in 0..30 {
        rig.run(MS(10));
        rig.can(port, 0x50, &[39 % 15, 7]);
    }
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_counter, counters.timeouts), (40, 30, 1));
    assert_eq!(rig.map.registers[8], 0, "its safe value");
    let now = rig.now;
    let last = rig.engine.status(now).ports().next().unwrap().last_rejection.unwrap();
    assert_eq!(last.why, Rejection::Repeated);
    // It lives again.
    rig.can(port, 0x50, &[10, 8]);
    rig.run(MS(10));
    assert_eq!(rig.map.registers[8], 8);
}

#[test]
fn frames_that_are_missing_are_counted_and_a_rejected_frame_moves_no_counter() {
    let mut cell = Cell::new();
    let port = counting(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for (count, value) in [(3, 1), (5, 2), (4, 3), (4, 4), (15, 5), (5, 6)] {
        rig.can(port, 0x50, &[count, value]);
    }
    let counters = rig.counters(port);
    let rejected = (counters.rejected_counter, counters.rejected_out_of_range);
    assert_eq!((counters.frames_in, counters.counter_jumps, rejected), (4, 2, (1, 1)));
    rig.run(MS(10));
    assert_eq!(rig.map.registers[8], 6);
}

#[test]
fn counters_of_multiplexed_frames_are_their_own_and_checked_only_in_frames_that_are_right() {
    let mut cell = Cell::new();
    let sum = FieldSpec::Checksum(Checksum::standard(Algorithm::named("xor8").unwrap()));
    let counter = || input(T::Byte, InputBinding::Counter { max: 255 });
    let frame = |mux, name| (0x60, vec![fixed(mux), counter(), input(T::Byte, to(name)), sum]);
    let frames = [frame(1, "WordInputReg[1]"), frame(2, "WordInputReg[2]")];
    let port = bus(&mut cell, [&frames, &[]]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let mut send = |mux: u8, count: u8, value: u8, wrong: u8| {
        rig.can(port, 0x60, &[mux, count, value, mux ^ count ^ value ^ wrong]);
        let counters = rig.counters(port);
        (counters.frames_in, counters.rejected_counter, counters.rejected_checksum, counters.counter_jumps)
    };
    assert_eq!(send(1, 254, 1, 0), (1, 0, 0, 0));
    assert_eq!(send(2, 7, 1, 0), (2, 0, 0, 0));
    assert_eq!(send(1, 255, 1, 9), (2, 0, 1, 0));
    assert_eq!(send(1, 255, 1, 0), (3, 0, 1, 0));
    assert_eq!(send(1, 0, 1, 0), (4, 0, 1, 0));
    assert_eq!(send(2, 7, 1, 0), (4, 1, 1, 0));
}

#[test]
fn a_sent_counter_goes_from_its_highest_number_to_zero() {
    let mut cell = Cell::new();
    let counter = FieldSpec::UserOutput { ty: T::Byte, from: OutputBinding::CounterTo { max: 14 } };
    let port = bus(&mut cell, [&[], &[(0x70, vec![counter, fixed(1)])]]);
    let mut rig = cell.rig();
    rig.run(MS(400));
    let sent: Vec<_> = rig.can_sent_to(port).iter().map(|frame| frame.data()[0]).collect();
    assert!(sent.len() > 32, "{sent:?}");
    assert!(sent.windows(2).all(|pair| pair[1] == (pair[0] + 1) % 15), "{sent:?}");
}

#[test]
fn a_counter_needs_unsigned_integers() {
    let refused = |ty, max| {
        let mut cell = Cell::new();
        bus(&mut cell, [&[(5, vec![input(ty, InputBinding::Counter { max })])], &[]]);
        cell.0.validate().err().map(|error| error.kind)
    };
    assert_eq!(refused(T::Byte, 255), None);
    assert_eq!(refused(T::Dword, u32::MAX), None);
    assert_eq!(refused(T::Byte, 256), Some(ConfigErrorKind::Counter { max: 256, high: 255.0 }));
    assert_eq!(refused(T::Byte, 0), Some(ConfigErrorKind::Counter { max: 0, high: 255.0 }));
    for ty in [T::Char, T::Float, T::Int] {
        assert_eq!(refused(ty, 14), Some(ConfigErrorKind::Counter { max: 14, high: -1.0 }), "{ty:?}");
    }
}

/// Two frames of a cycle: a counter, and a register with what it may send.
fn limited(allowed: &[FieldSpec]) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let from = OutputBinding::Variable { var: var("WordOutputReg[1]"), scale: 0.5, offset: 0.0 };
    let register = FieldSpec::UserOutput { ty: T::Byte, from };
    let counter = FieldSpec::UserOutput { ty: T::Byte, from: OutputBinding::Counter };
    let second = [&[register], allowed].concat();
    let port = bus(&mut cell, [&[], &[(0x10, vec![counter]), (0x11, second)]]);
    let rig = cell.rig();
    (rig, port)
}

/// What the second frame has with this value of the register, if the cycle is sent.
fn sends(rig: &mut Rig, port: PortId, register: u16) -> Option<u8> {
    let ModbusPlace::Register { address } = var("WordOutputReg[1]").modbus().unwrap() else { panic!() };
    rig.map.registers[usize::from(address)] = register;
    rig.run(MS(100));
    rig.can_sent_to(port);
    rig.run(MS(40));
    let sent = rig.can_sent_to(port);
    let [.., first, second] = &sent[..] else {
        assert_eq!(sent, [], "all frames of a cycle or none");
        return None;
    };
    assert_eq!((first.id(), second.id()), (CanId::Standard(0x10), CanId::Standard(0x11)));
    Some(second.data()[0])
}

#[test]
fn a_number_outside_of_its_limits_is_not_sent_nor_is_its_cycle() {
    let limits = |outside| [FieldSpec::Limits(Limits { low: 10.0, high: 110.0, outside })];
    let (mut rig, port) = limited(&limits(Outside::Refuse));
    rig.run(MS(2_000));
    let before = rig.counters(port).stale_cycles;
    assert_eq!(sends(&mut rig, port, 220), Some(110));
    assert_eq!(rig.counters(port).stale_cycles, before);
    for (register, sent) in [(222, None), (20, Some(10)), (18, None), (60_000, None), (100, Some(50))] {
        assert_eq!(sends(&mut rig, port, register), sent, "{register}");
    }
    assert!(rig.counters(port).stale_cycles > before + 10);
    let (mut rig, port) = limited(&limits(Outside::Clamp));
    rig.run(MS(2_000));
    for (register, sent) in [(222, 110), (20, 10), (18, 10), (60_000, 110), (100, 50)] {
        assert_eq!(sends(&mut rig, port, register), Some(sent), "{register}");
    }
}

#[test]
fn a_map_sends_its_own_numbers_and_nothing_else() {
    let entry = |first, last, sent| FieldSpec::Mapped(MapEntry { first, last, sent });
    let mut cell = Cell::new();
    let from = OutputBinding::Variable { var: var("WordOutputReg[1]"), scale: 1.0, offset: 0.0 };
    let register = FieldSpec::UserOutput { ty: T::Byte, from };
    let fields = vec![register, entry(0, 0, 9.0), entry(1, 7, 2.0), fixed(0x55)];
    let counter = FieldSpec::UserOutput { ty: T::Byte, from: OutputBinding::Counter };
    let port = bus(&mut cell, [&[], &[(0x10, vec![counter]), (0x11, fields)]]);
    let mut rig = cell.rig();
    rig.run(MS(2_000));
    for (register, sent) in [(0, Some(9)), (1, Some(2)), (7, Some(2)), (8, None), (65_535, None)] {
        assert_eq!(sends(&mut rig, port, register), sent, "{register}");
    }
}

#[test]
fn what_makes_no_sense_behind_a_field_is_refused_with_its_place() {
    let limits = |low, high| FieldSpec::Limits(Limits { low, high, outside: Outside::Refuse });
    let entry = |first, last, sent| FieldSpec::Mapped(MapEntry { first, last, sent });
    let source = |scale| OutputBinding::Variable { var: var("WordOutputReg[1]"), scale, offset: 0.0 };
    let number = |scale| FieldSpec::UserOutput { ty: T::Byte, from: source(scale) };
    let decimal = FieldSpec::DeviceOutput {
        encoding: Encoding::decimal(5).decimals(1),
        overflow: Overflow::Usual,
        from: source(1.0),
    };
    let wraps = FieldSpec::DeviceOutput { encoding: byte(), overflow: Overflow::Wrap, from: source(1.0) };
    let counter = FieldSpec::UserOutput { ty: T::Byte, from: OutputBinding::Counter };
    for (fields, field, said) in [
        (vec![fixed(1), limits(0.0, 1.0)], 1, "only an output field with a source"),
        (vec![output(5.0), limits(0.0, 1.0)], 1, "only an output field with a source"),
        (
            vec![number(1.0), FieldSpec::Padding { len: 1, fill: 0 }, limits(0.0, 1.0)],
            2,
            "only an output field",
        ),
        (vec![number(1.0), limits(0.0, 256.0)], 1, "the field cannot be 256; allowed: 0..=255"),
        (vec![number(1.0), limits(9.0, 8.0)], 1, "min 9 is above max 8"),
        (vec![number(1.0), limits(0.5, 8.0)], 1, "0.5 has a fraction"),
        (vec![number(1.0), limits(0.0, 8.0), limits(0.0, 8.0)], 2, "min, max and outside"),
        (vec![number(1.0), limits(0.0, 8.0), entry(1, 1, 2.0)], 2, "min, max and outside"),
        (vec![number(1.0), entry(1, 1, 2.0), limits(0.0, 8.0)], 2, "min, max and outside"),
        (
            vec![number(1.0), entry(1, 4, 2.0), entry(4, 5, 3.0)],
            2,
            "an earlier entry already has the value 4",
        ),
        (vec![number(1.0), entry(4, 1, 2.0)], 1, "4..1 contains no value; allowed: 1..4"),
        (vec![number(1.0), entry(4, 4, 300.0)], 1, "the field cannot be 300"),
        (vec![number(0.5), entry(4, 4, 3.0)], 1, "scale and offset are not allowed"),
        (vec![wraps, limits(0.0, 8.0)], 1, "overflow = \"wrap\""),
        (vec![counter, limits(0.0, 8.0)], 1, "a count wraps"),
        (vec![decimal, limits(0.0, 8.25)], 1, "8.25 has more than the field's 1 digits"),
    ] {
        let mut cell = Cell::new();
        bus(&mut cell, [&[], &[(0x10, fields.clone())]]);
        let error = cell.0.view().validate().unwrap_err();
        assert_eq!(
            error.place,
            Place::Field { recipe: 0, part: Direction::Output, frame: 0, field },
            "{fields:?}"
        );
        assert!(error.kind.to_string().contains(said), "{fields:?}: {}", error.kind);
    }
}

#[test]
fn a_cycle_is_handed_over_in_its_order_with_a_frame_without_data() {
    let mut cell = Cell::new();
    let frames = [(0x310, vec![output(44.0), output(1.0)]), (0x210, vec![output(15.0)]), (0x80, vec![])];
    let port = bus(&mut cell, [&[], &frames]);
    let mut rig = cell.rig();
    rig.run(MS(300));
    let sent = rig.can_sent_to(port);
    let cycle = [(0x310, &[44, 1][..]), (0x210, &[15]), (0x80, &[])];
    let cycle = cycle.map(|(id, data)| CanFrame::new(CanId::Standard(id), data).unwrap());
    assert!(sent.len() > 3 && sent.len().is_multiple_of(3), "{sent:?}");
    assert!(sent.chunks(3).all(|frames| frames == cycle), "{sent:?}");
}

#[test]
fn a_request_on_can_may_be_without_data() {
    let mut cell = Cell::new();
    let port = bus(&mut cell, [&[(0x181, vec![input(T::Byte, to("WordInputReg[1]"))])], &[]]);
    let fields = cell.fields([]);
    let (id, head, tail) = (Some(CanId::Standard(0x80)), Delimiter::new(), Delimiter::new());
    cell.0.frames.push(FrameSpec { id, remote: false, head, tail, fields }).unwrap();
    let sync = Transaction::Frames { request: Some(0), reply: None, refusal: None };
    cell.0.exchanges.push(Exchange::new(0, sync, Triggers::every(MS(20)))).unwrap();
    cell.last_recipe().exchanges = Span { start: 0, len: 1 };
    let mut rig = cell.rig();
    rig.run(MS(300));
    let sent = rig.can_sent_to(port);
    let sync = CanFrame::new(CanId::Standard(0x80), &[]).unwrap();
    assert!(sent.len() >= 10 && sent.iter().all(|frame| *frame == sync), "{sent:?}");
}

#[test]
fn what_is_received_on_can_has_a_field() {
    let mut cell = Cell::new();
    bus(&mut cell, [&[(0x181, vec![])], &[(0x80, vec![])]]);
    let ConfigError { kind, .. } = cell.0.validate().unwrap_err();
    assert!(matches!(kind, ConfigErrorKind::Layout(LayoutError::Empty)), "{kind:?}");
}
