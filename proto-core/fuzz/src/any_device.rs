//! Recipes of devices for `any_engine`: frames of their own, and exchanges of every kind.
//!
//! Most of them are right, because a wrong one is refused before anything happens. Some are not.

use proto_core::config::{
    Bus, CanFramePart, CommandWhen, Delimiter, Echo, Exchange, FieldSpec, FrameSpec, InputBinding, InputRule,
    Limits, LinkSource, MapEntry, NoText, OutputBinding, Outside, Parts, PortValue, Restarted, Span,
    StateValue, StreamPart, Transaction, Triggers, Words,
};
use proto_core::device::{
    Algorithm, Bits, Boundary, ByteOrder, Checksum, Counts, Encoding, Escape, Ignored, Kind, Length,
    Overflow, Text, TextWidth,
};
use proto_core::modbus::rtu::{Operation, Table};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use crate::rig::Cell;
use crate::source::Source;

/// Heads of frames, and the first bytes of requests.
const HEADS: [&[u8]; 4] = [b"\x02", b":R", b"", b"\xAA\x55"];
const TAILS: [&[u8]; 4] = [b"\r\n", b"", b"\x03", b"\n"];

/// A variable of any kind.
pub(crate) fn var(input: &mut Source<'_>, direction: Direction) -> SysVar {
    // Those of which there are many, and those with edges, alike.
    let groups: &[&str] = match direction {
        Direction::Input => {
            &["DigitalOutputCommand", "BitInputReg", "WordInputReg", "FloatInputReg", "ForceEnd", "ForceBase"]
        }
        Direction::Output => &[
            "DigitalSignalStatus",
            "RobotState",
            "BitOutputReg",
            "WordOutputReg",
            "FloatOutputReg",
            "RobotState",
        ],
    };
    let group = input.one_of(groups);
    let vars: Vec<SysVar> = SysVar::all().filter(|var| var.group() == group).collect();
    input.one_of(&vars)
}

/// A recipe of a device; `None` when there is no room for it.
pub(crate) fn recipe(cell: &mut Cell, input: &mut Source<'_>, table: Span) -> Option<()> {
    let kind = input.u8();
    let which = kind % 8;
    let is_on_can = matches!(which, 1 | 4);
    let parts = match which {
        // Without exchanges, or beside them.
        0 | 3 => Parts::Stream {
            input: (which == 0 || kind & 8 != 0)
                .then(|| part(cell, input, Direction::Input, table, which == 0))
                .flatten(),
            output: (kind & 16 != 0)
                .then(|| part(cell, input, Direction::Output, table, which == 0))
                .flatten(),
        },
        1 | 4 => {
            let mut frames = |first: u16, direction, count: u8| {
                let mut frames = heapless::Vec::new();
                for nth in 0..u16::from(count) {
                    let specs = fields(input, direction, table, true);
                    let fields = room(cell, specs)?;
                    frames.push(CanFramePart { id: CanId::Standard(first + nth), fields }).ok()?;
                }
                Some(frames)
            };
            Parts::Can {
                input: frames(1, Direction::Input, kind >> 3 & 1)?,
                output: frames(10, Direction::Output, kind >> 4 & 1)?,
            }
        }
        _ => Parts::Stream { input: None, output: None },
    };
    cell.recipe(Mode::User, parts);
    if which < 3 && kind & 32 == 0 {
        return Some(());
    }
    let start = cell.0.exchanges.len();
    for nth in 0..1 + input.below(3) as u16 {
        let exchange = match which {
            0..5 => frames(cell, input, table, nth, is_on_can)?,
            7 => served(cell, input, table, nth)?,
            _ => asked(cell, input, table, nth)?,
        };
        cell.0.exchanges.push(exchange).ok()?;
    }
    let len = cell.0.exchanges.len() - start;
    cell.last_recipe().exchanges = Span { start: start as u16, len: len as u16 };
    Some(())
}

/// Adds these fields, if there is room for them.
fn room(cell: &mut Cell, specs: Vec<FieldSpec>) -> Option<Span> {
    (cell.0.fields.len() + specs.len() <= 1024).then(|| cell.fields(specs))
}

fn part(
    cell: &mut Cell,
    input: &mut Source<'_>,
    direction: Direction,
    table: Span,
    may_be_cut: bool,
) -> Option<StreamPart> {
    let kind = input.u8();
    let specs = fields(input, direction, table, false);
    let fields = room(cell, specs)?;
    let mut part = cell.part(HEADS[usize::from(kind & 3)], TAILS[usize::from(kind >> 2 & 3)], fields)?;
    if may_be_cut {
        part.framing = [Boundary::Fields, Boundary::Tail, Boundary::Silence][usize::from(kind >> 4) % 3];
        part.escape =
            [None, None, None, None, None, Some(Escape::Dle), Some(Escape::Slip), Some(Escape::Cobs)]
                [usize::from(kind >> 5)];
        // Two of these are refused.
        if part.escape.is_some() && kind & 3 != 0 || part.tail.is_empty() && part.framing == Boundary::Tail {
            part.framing = Boundary::Fields;
        }
    }
    Some(part)
}

fn encoding(input: &mut Source<'_>, is_small: bool) -> Encoding {
    let kind = input.u8();
    let order =
        [ByteOrder::Little, ByteOrder::Big, ByteOrder::BigSwapped, ByteOrder::Big][usize::from(kind >> 6)];
    match kind % 12 {
        0 => Encoding::scalar(ScalarType::Word).big_endian(),
        1 if !is_small => Encoding::scalar(ScalarType::Float).ordered(order),
        2 => Encoding::scalar(ScalarType::Byte),
        3 if !is_small => Encoding::decimal(1 + (kind >> 4)),
        4 if !is_small => Encoding::decimal_until(b','),
        5 => Encoding::hex(1 + (kind >> 6)),
        6 => Encoding::bcd(1 + (kind >> 7)),
        7 => Encoding::int24().big_endian(),
        8 | 9 => Encoding::bits(ScalarType::Byte, (kind >> 6)..=(kind >> 6) + 1),
        10 => Encoding::bit(ScalarType::Word, kind >> 4),
        _ => Encoding::scalar(ScalarType::Int).ordered(order),
    }
}

fn to(input: &mut Source<'_>, table: Span) -> InputBinding {
    let kind = input.u8();
    match kind % 5 {
        0 => InputBinding::Unused,
        1 => InputBinding::Commands {
            table,
            when: [CommandWhen::Change, CommandWhen::Frame, CommandWhen::Kept][usize::from(kind >> 4) % 3],
        },
        2 => InputBinding::Bit { var: var(input, Direction::Input), bit: kind >> 5 },
        _ => InputBinding::Variable { var: var(input, Direction::Input), scale: 1.0, offset: 0.0 },
    }
}

fn from(input: &mut Source<'_>) -> OutputBinding {
    let kind = input.u8();
    let any = if kind & 128 == 0 { Direction::Output } else { Direction::Input };
    match kind % 8 {
        0 => OutputBinding::Counter,
        1 => OutputBinding::Reply,
        2 => OutputBinding::Constant(f64::from(kind)),
        3 => OutputBinding::Bit { var: var(input, any), bit: kind >> 4 & 7 },
        4 => OutputBinding::Port {
            port: (kind & 64 == 0).then_some(kind >> 5 & 1),
            value: PortValue::NAMES[usize::from(kind >> 3) % PortValue::NAMES.len()].1,
            scale: 1.0,
            offset: 0.0,
        },
        5 if (0xE8..0xF0).contains(&kind) => {
            OutputBinding::Link { link: LinkSource::NAMES[usize::from(kind & 3)].1, scale: 1.0, offset: 0.0 }
        }
        5 if kind >= 0xF0 => OutputBinding::State { value: StateValue::SPEED, scale: 1.0, offset: 0.0 },
        _ => OutputBinding::Variable { var: var(input, any), scale: 1.0, offset: 0.0 },
    }
}

fn value(input: &mut Source<'_>, direction: Direction, table: Span, encoding: Encoding) -> FieldSpec {
    let overflow = Overflow::Usual;
    match direction {
        Direction::Input => {
            let to = match to(input, table) {
                // The table has more values than one bit.
                InputBinding::Commands { .. } if matches!(encoding.kind, Kind::Bits(_)) => {
                    InputBinding::Unused
                }
                to => to,
            };
            FieldSpec::DeviceInput { encoding, overflow, to }
        }
        Direction::Output => FieldSpec::DeviceOutput { encoding, overflow, from: from(input) },
    }
}

/// What may stand behind an input field that writes a variable.
fn rules(input: &mut Source<'_>, spec: &FieldSpec) -> Vec<FieldSpec> {
    if !matches!(spec, FieldSpec::DeviceInput { to: InputBinding::Variable { .. }, .. }) {
        return Vec::new();
    }
    let kind = input.u8();
    let rule = FieldSpec::InputRule;
    let no_value = || rule(InputRule::NoNumber(f64::from(kind >> 4)));
    let valid = |input: &mut Source<'_>| {
        let bit = Some(kind >> 5);
        rule(InputRule::ValidTo { var: var(input, Direction::Input), bit })
    };
    let outside = if kind & 16 == 0 { Outside::Refuse } else { Outside::Clamp };
    let entry = |first, last| FieldSpec::Mapped(MapEntry { first, last, sent: f64::from(kind >> 6) });
    match kind & 15 {
        0 => vec![rule(InputRule::Int16)],
        1 => vec![FieldSpec::Limits(Limits { low: 1.0, high: f64::from(kind >> 2), outside })],
        2 => vec![entry(0, 3), entry(4, 9)],
        3 => vec![entry(0, 3), rule(InputRule::Else(1.0))],
        4 => vec![no_value(), valid(input)],
        5 => vec![valid(input)],
        6 => vec![rule(InputRule::Int16), no_value()],
        // Only digits have these.
        7 => NoText::new("--").map(|text| rule(InputRule::NoText(text))).into_iter().collect(),
        8 => vec![rule(InputRule::Comma)],
        _ => Vec::new(),
    }
}

fn words(input: &mut Source<'_>, direction: Direction, count: u8) -> Words {
    let name = match direction {
        Direction::Input => format!("WordInputReg[{}]", 1 + input.below(24)),
        Direction::Output => format!("WordOutputReg[{}]", 1 + input.below(24)),
    };
    Words { first: SysVar::parse(&name).expect("there are 32"), count, order: ByteOrder::Big }
}

fn text(input: &mut Source<'_>, direction: Direction, width: TextWidth) -> FieldSpec {
    let text = Text { width, fill: Some(b' ') };
    match direction {
        Direction::Input => {
            let to = Some(words(input, direction, 2));
            FieldSpec::TextInput { text, to, length_to: None, count_to: None, ignored: Ignored::NONE }
        }
        Direction::Output => {
            FieldSpec::TextOutput { text, from: words(input, direction, 2), length_from: None }
        }
    }
}

/// The fields of a frame of a device's own.
fn fields(input: &mut Source<'_>, direction: Direction, table: Span, is_small: bool) -> Vec<FieldSpec> {
    let kind = input.u8();
    let mut specs = Vec::new();
    if kind & 1 == 1 && !is_small {
        let encoding = Encoding::scalar(ScalarType::Byte);
        let counts = [Counts::Rest, Counts::Frame, Counts::Fields][usize::from(kind >> 1) % 3];
        specs.push(FieldSpec::Length(Length { encoding, counts, plus: 0 }));
    }
    for _ in 0..1 + usize::from(kind >> 6) {
        let which = input.u8();
        let spec = match which % 8 {
            0 => FieldSpec::Fixed {
                encoding: Encoding::scalar(ScalarType::Byte),
                value: i64::from(which >> 4),
            },
            1 => FieldSpec::Padding { len: 1 + (which >> 6), fill: which },
            2 if !is_small => text(input, direction, TextWidth::Fixed(1 + (which >> 5))),
            3 if !is_small => text(input, direction, TextWidth::Until(b';')),
            _ => {
                let encoding = encoding(input, is_small);
                if which & 64 != 0 && matches!(encoding.kind, Kind::Bits(Bits { bytes: 1, .. })) {
                    specs.push(value(input, direction, table, encoding));
                    let above = Encoding::bits(ScalarType::Byte, 5..=7).shared();
                    value(input, direction, table, above)
                } else {
                    value(input, direction, table, encoding)
                }
            }
        };
        let behind = rules(input, &spec);
        specs.push(spec);
        specs.extend(behind);
    }
    if kind & 1 == 1 && kind & 8 != 0 && !is_small {
        specs.push(text(input, direction, TextWidth::Rest));
    }
    if kind & 32 != 0 {
        let names = ["crc16-modbus", "xor8", "sum8", "crc32", "lrc8"];
        let algorithm = Algorithm::named(names[usize::from(kind >> 2) % names.len()]);
        let algorithm = algorithm.unwrap_or(Algorithm::CRC16_MODBUS);
        specs.push(FieldSpec::Checksum(Checksum::standard(algorithm)));
    }
    specs
}

/// Big-endian values that fill registers; how many registers.
fn registers(input: &mut Source<'_>, direction: Direction, table: Span) -> (Vec<FieldSpec>, u16) {
    let mut count = 0;
    let mut specs = Vec::new();
    for _ in 0..1 + input.below(3) {
        let which = input.u8();
        let (spec, size) = match which % 6 {
            0 => (FieldSpec::Padding { len: 2, fill: 0 }, 1),
            1 => (text(input, direction, TextWidth::Fixed(4)), 2),
            2 | 3 => {
                let order = if which & 64 == 0 { ByteOrder::Big } else { ByteOrder::BigSwapped };
                (value(input, direction, table, Encoding::scalar(ScalarType::Float).ordered(order)), 2)
            }
            _ => (value(input, direction, table, Encoding::scalar(ScalarType::Word).big_endian()), 1),
        };
        let behind = rules(input, &spec);
        specs.push(spec);
        specs.extend(behind);
        count += size;
    }
    (specs, count)
}

fn coils(input: &mut Source<'_>, direction: Direction, table: Span) -> (Vec<FieldSpec>, u16) {
    let count = 1 + input.below(8) as u8;
    let specs = (0..count).map(|nth| {
        let kind = Kind::Bits(Bits { bytes: 1, first: nth, count: 1, signed: false });
        value(input, direction, table, Encoding { kind, order: ByteOrder::Little, shared: nth > 0 })
    });
    (specs.collect(), count.into())
}

fn when(input: &mut Source<'_>) -> Triggers {
    let kind = input.u8();
    let every = [Some(5), Some(20), Some(100), None][usize::from(kind & 3)].map(Duration::from_millis);
    Triggers {
        every,
        start: every.is_none() || kind & 4 != 0,
        change: kind & 8 != 0,
        rising: (kind & 48 == 48).then(|| (var(input, Direction::Output), kind >> 6)),
    }
}

fn exchange(input: &mut Source<'_>, peer: u8, transaction: Transaction, when: Triggers) -> Exchange {
    let kind = input.u8();
    Exchange {
        timeout: Duration::from_millis([5, 20, 100, 1_000][usize::from(kind & 3)]),
        retries: kind >> 2 & 3,
        pause: Duration::from_millis([0, 0, 3, 50][usize::from(kind >> 4 & 3)]),
        ..Exchange::new(peer, transaction, when)
    }
}

/// As the master of a line.
fn asked(cell: &mut Cell, input: &mut Source<'_>, table: Span, nth: u16) -> Option<Exchange> {
    let kind = input.u8();
    let mut written = (Vec::new(), 0);
    let mut read = (Vec::new(), 0);
    let address = nth * 16;
    let (input_part, output_part) = (Direction::Input, Direction::Output);
    let word = |input: &mut Source<'_>| {
        vec![value(input, output_part, table, Encoding::scalar(ScalarType::Word).big_endian())]
    };
    // Bits 4 to 11 of a register.
    let mask = 0x0FF0;
    let bits = |input: &mut Source<'_>| {
        let encoding = Encoding::bits(ScalarType::Word, 4..=11).big_endian();
        vec![value(input, output_part, table, encoding)]
    };
    match kind % 10 {
        0 | 1 => read = coils(input, input_part, table),
        2 | 3 => read = registers(input, input_part, table),
        4 => written = (coils(&mut input.clone(), output_part, table).0[..1].to_vec(), 1),
        5 => written = (word(input), 1),
        6 => written = coils(input, output_part, table),
        7 => written = registers(input, output_part, table),
        8 => written = (bits(input), 1),
        _ => (read, written) = (registers(input, input_part, table), registers(input, output_part, table)),
    }
    let (count, write_count) = (read.1, written.1);
    let operation = match kind % 10 {
        0 => Operation::ReadCoils { address, count },
        1 => Operation::ReadDiscreteInputs { address, count },
        2 => Operation::ReadHoldingRegisters { address, count },
        3 => Operation::ReadInputRegisters { address, count },
        4 => Operation::WriteCoil { address },
        5 => Operation::WriteRegister { address },
        6 => Operation::WriteCoils { address, count: write_count },
        7 => Operation::WriteRegisters { address, count: write_count },
        8 => Operation::MaskWriteRegister { address, mask },
        _ => Operation::ReadWriteRegisters {
            read_address: address,
            read_count: count,
            write_address: address,
            write_count,
        },
    };
    let (written, read) = (room(cell, written.0)?, room(cell, read.0)?);
    let when = when(input);
    // Two slaves, and a broadcast where nothing is read.
    let peer = if kind >= 0xE0 && !operation.reads() { 0 } else { 7 + (kind >> 6 & 1) };
    Some(exchange(input, peer, Transaction::Rtu { operation, written, read }, when))
}

/// As a slave of a line.
fn served(cell: &mut Cell, input: &mut Source<'_>, table: Span, nth: u16) -> Option<Exchange> {
    let kind = input.u8();
    let tables = [Table::HoldingRegisters, Table::Coils, Table::InputRegisters, Table::DiscreteInputs];
    let of = tables[usize::from(kind & 3)];
    let is_written = kind & 2 == 0 && kind & 4 != 0;
    let part = if is_written { Direction::Input } else { Direction::Output };
    let (specs, count) = match of {
        Table::Coils | Table::DiscreteInputs => coils(input, part, table),
        _ => registers(input, part, table),
    };
    let address = nth * 8;
    let operation = match (of, is_written) {
        (Table::Coils, true) => Operation::WriteCoils { address, count },
        (Table::Coils, false) => Operation::ReadCoils { address, count },
        (Table::DiscreteInputs, _) => Operation::ReadDiscreteInputs { address, count },
        (Table::InputRegisters, _) => Operation::ReadInputRegisters { address, count },
        (Table::HoldingRegisters, true) => Operation::WriteRegisters { address, count },
        (Table::HoldingRegisters, false) => Operation::ReadHoldingRegisters { address, count },
    };
    let (span, none) = (room(cell, specs)?, Span::default());
    let (written, read) = if is_written { (span, none) } else { (none, span) };
    Some(Exchange::new(5, Transaction::Served { operation, written, read }, Triggers::NEVER))
}

/// With frames of the device's own.
fn frames(
    cell: &mut Cell,
    input: &mut Source<'_>,
    table: Span,
    nth: u16,
    is_on_can: bool,
) -> Option<Exchange> {
    let kind = input.u8();
    let mut add = |input: &mut Source<'_>, first: u16, direction, table| {
        let bytes = input.u8();
        let remote = is_on_can && first == 20 && kind & 32 != 0;
        let specs = if remote { Vec::new() } else { fields(input, direction, table, is_on_can) };
        let fields = room(cell, specs)?;
        let delimiter = |bytes| Delimiter::from_slice(bytes).unwrap_or_default();
        let is_bare = is_on_can || first >= 60;
        let spec = FrameSpec {
            id: is_on_can.then(|| CanId::Standard(first + nth)),
            remote,
            head: if first == 60 {
                delimiter(b"E")
            } else if first == 80 {
                delimiter(b"F")
            } else {
                delimiter(HEADS[usize::from(bytes & 3)])
            },
            tail: if is_bare { delimiter(b"") } else { delimiter(TAILS[usize::from(bytes >> 2 & 3)]) },
            fields,
        };
        let spec = if is_on_can { FrameSpec { head: delimiter(b""), ..spec } } else { spec };
        cell.0.frames.push(spec).ok()?;
        Some(cell.0.frames.len() as u8 - 1)
    };
    let request = if kind & 3 == 0 { None } else { Some(add(input, 20, Direction::Output, table)?) };
    let reply = if kind & 3 == 1 { None } else { Some(add(input, 40, Direction::Input, table)?) };
    let mut other = |input: &mut Source<'_>, first, is_there: bool| match is_there {
        true => add(input, first, Direction::Input, Span::default()).map(Some),
        false => Some(None),
    };
    let pending = other(input, 80, kind & 15 == 15)?;
    let refusal = other(input, 60, kind & 7 == 7)?;
    let when = if request.is_some() { when(input) } else { Triggers::NEVER };
    for nth in [pending, refusal].into_iter().flatten() {
        // They pick no commands, and have no counter.
        let span = cell.0.frames[usize::from(nth)].fields;
        let (start, len) = (usize::from(span.start), usize::from(span.len));
        for field in &mut cell.0.fields[start..start + len] {
            if let FieldSpec::DeviceInput { to, .. } = field
                && matches!(to, InputBinding::Commands { .. } | InputBinding::Counter { .. })
            {
                *to = InputBinding::Unused;
            }
        }
    }
    let transaction = Transaction::Frames { request, reply, refusal };
    let mut exchange = Exchange { pending, ..exchange(input, kind >> 6, transaction, when) };
    let restarted = input.u8();
    if restarted & 3 == 0 {
        exchange.restarted = Some(Restarted { field: restarted >> 6, value: f64::from(restarted >> 2 & 15) });
    }
    Some(exchange)
}

/// What a line with devices is like.
pub(crate) fn line(cell: &mut Cell, input: &mut Source<'_>) {
    let kind = input.u8();
    let recipe = usize::from(cell.last_port().recipe);
    let exchanges = cell.0.recipes[recipe].exchanges.of(&cell.0.exchanges);
    let has_exchanges = !exchanges.is_empty();
    let is_master =
        has_exchanges && exchanges.iter().all(|one| matches!(one.transaction, Transaction::Rtu { .. }));
    let port = cell.last_port();
    if let Bus::Rs485(line) = &mut port.bus {
        line.echo = match kind {
            _ if !has_exchanges => Echo::No,
            kind if kind & 1 == 1 => Echo::Yes,
            kind if kind & 2 == 2 => Echo::Auto,
            _ => Echo::No,
        };
        line.turnaround = Duration::from_micros([0, 100, 1_750, 4_000][usize::from(kind >> 1 & 3)]);
        line.idle_gap = Duration::from_micros([50_000, 1_750, 50_000, 5_000][usize::from(kind >> 3 & 3)]);
    }
    // The master of a line may as well be the client of a server.
    if is_master && kind & 0x18 == 0x18 {
        let host = heapless::String::try_from("10.0.0.9").unwrap_or_default();
        port.bus = Bus::ModbusTcp { host, port: Bus::MODBUS_TCP };
    }
    // These need safe values, and a part that is sent on change.
    port.safe_at_start = kind & 0x70 == 0x70;
    port.refresh = (kind & 0xF0 == 0x80).then_some(Duration::from_millis(100));
}
