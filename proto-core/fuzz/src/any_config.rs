//! Any configuration, right or wrong, for `any_engine` and `image`.

use proto_core::config::{
    Bus, CommandWhen, FieldSpec, GatewayConfig, InputBinding, OnStale, OutputBinding, Parts, SendOn,
};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use crate::any_device::{self, var};
use crate::rig::Cell;
use crate::source::Source;

/// A configuration; `None` when there is no room for what the input asks.
pub(crate) fn config(input: &mut Source<'_>) -> Option<Box<GatewayConfig>> {
    let mut cell = Cell::new();
    let count = input.u8();
    let (recipes, has_devices) = (1 + usize::from(count & 0x7F) % 5, count & 0x80 != 0);
    for _ in 0..recipes {
        if has_devices && input.flag() {
            let table = commands(&mut cell);
            any_device::recipe(&mut cell, input, table)?;
        } else {
            recipe(&mut cell, input)?;
        }
    }
    let kind = input.u8();
    if kind & 1 == 1 {
        let recipe = input.below(recipes);
        // One of a device is refused.
        if !has_devices || cell.0.recipes[recipe].mode == Mode::Realtime {
            cell.recipe_link(recipe as u8);
        }
    }
    for _ in 0..=(kind >> 5) {
        port(&mut cell, input, recipes, has_devices)?;
    }
    Some(Box::new(cell.0))
}

/// The commands that values pick; none when there are many already.
fn commands(cell: &mut Cell) -> proto_core::config::Span {
    if cell.0.commands.len() >= 20 {
        return proto_core::config::Span::default();
    }
    cell.commands(&[
        (0, "stop"),
        (1, "run(pick.jspf,50)"),
        (2, "state"),
        (3, "getlasterror"),
        (4, "pause"),
        (5, "poweroff"),
    ])
}

fn fields(
    input: &mut Source<'_>,
    mode: Mode,
    direction: Direction,
    table: proto_core::config::Span,
    most: usize,
) -> Vec<FieldSpec> {
    let count = 1 + input.below(most);
    let mut fields = Vec::new();
    for _ in 0..count {
        let kind = input.u8();
        let ty = ScalarType::ALL[usize::from(kind & 7)];
        let (scale, offset) = ([1.0, 0.5, -2.0, 1000.0][usize::from(kind >> 6)], f32::from(kind >> 5 & 1));
        let which = kind >> 3 & 3;
        let any = if input.flag() { Direction::Input } else { Direction::Output };
        let field = match (mode, direction) {
            (Mode::Realtime, direction) => {
                let first = var(input, direction);
                let range = (first.ordinal()..first.ordinal() + usize::from(kind >> 5) + 1)
                    .map_while(SysVar::from_ordinal);
                fields
                    .extend(range.skip(1).filter(|var| var.direction() == direction).map(FieldSpec::System));
                FieldSpec::System(first)
            }
            (Mode::User, Direction::Input) => FieldSpec::UserInput {
                ty,
                to: match which {
                    0 => InputBinding::Unused,
                    1 => InputBinding::Commands {
                        table,
                        when: match kind >> 5 & 3 {
                            0 => CommandWhen::Change,
                            2 => CommandWhen::Kept,
                            _ => CommandWhen::Frame,
                        },
                    },
                    2 if kind >> 6 == 3 => {
                        InputBinding::Bit { var: var(input, Direction::Input), bit: input.u8() & 7 }
                    }
                    _ => InputBinding::Variable { var: var(input, Direction::Input), scale, offset },
                },
            },
            (Mode::User, Direction::Output) => FieldSpec::UserOutput {
                ty,
                from: match which {
                    0 => OutputBinding::Counter,
                    1 => OutputBinding::Reply,
                    2 => OutputBinding::Constant(f64::from(kind)),
                    _ if kind >> 6 == 3 => OutputBinding::Bit { var: var(input, any), bit: input.u8() & 7 },
                    _ => OutputBinding::Variable { var: var(input, any), scale, offset },
                },
            },
        };
        fields.push(field);
    }
    fields
}

fn recipe(cell: &mut Cell, input: &mut Source<'_>) -> Option<()> {
    let kind = input.u8();
    let mode = if kind & 1 == 0 { Mode::Realtime } else { Mode::User };
    let table = if mode == Mode::User { commands(cell) } else { proto_core::config::Span::default() };
    let room = |cell: &Cell, more: usize| (cell.0.fields.len() + more <= 1024).then_some(());
    let parts = if kind & 2 == 0 {
        let mut part = |which: u8, direction, delimiters: [&[u8]; 2]| {
            if which != 0 && kind & which == 0 {
                return Some(None);
            }
            let fields = fields(input, mode, direction, table, 12);
            room(cell, fields.len())?;
            let span = cell.fields(fields);
            Some(cell.part(delimiters[0], delimiters[1], span))
        };
        let head: &[u8] = if kind & 16 == 0 { &[255, 255] } else { &[] };
        let input = part(4, Direction::Input, [head, &[238, 238]])?;
        let output = part(if input.is_some() { 8 } else { 0 }, Direction::Output, [head, &[254, 254]])?;
        Parts::Stream { input, output }
    } else {
        let mut part = |first: u16, direction| {
            let count = input.below(6);
            let mut frames = heapless::Vec::new();
            for nth in 0..count as u16 {
                let fields = fields(input, mode, direction, table, 2);
                room(cell, fields.len())?;
                let id = if nth == 4 {
                    CanId::Extended(0x1FFF_FF00 | u32::from(nth))
                } else {
                    CanId::Standard(first + nth)
                };
                frames.push(proto_core::config::CanFramePart { id, fields: cell.fields(fields) }).ok()?;
            }
            Some(frames)
        };
        Parts::Can { input: part(1, Direction::Input)?, output: part(10, Direction::Output)? }
    };
    cell.recipe(mode, parts);
    cell.last_recipe().on_stale = if kind & 32 == 0 { OnStale::Hold } else { OnStale::Stop };
    if mode == Mode::User {
        cell.last_recipe().send = match kind >> 6 {
            0 => SendOn::Period,
            1 => SendOn::Change,
            2 => SendOn::Frame,
            _ => SendOn::Rising { var: var(input, Direction::Output), bit: input.u8() & 7 },
        };
    }
    Some(())
}

fn port(cell: &mut Cell, input: &mut Source<'_>, recipes: usize, has_devices: bool) -> Option<()> {
    let (kind, recipe) = (input.u8(), input.below(recipes) as u8);
    let listen = || heapless::String::try_from("0.0.0.0:50000").ok();
    let of = &cell.0.recipes[usize::from(recipe)];
    let (is_can, is_user) = (matches!(of.parts, Parts::Can { .. }), of.mode == Mode::User);
    match kind & 7 {
        // The bus that the recipe needs.
        bus if has_devices && is_can && (is_user || bus < 6) => drop(cell.can_port(recipe)),
        bus if has_devices && (is_user || bus < 6) => {
            cell.rs485(recipe);
            any_device::line(cell, input);
        }
        0..4 => drop(cell.rs485(recipe)),
        4 | 5 => drop(cell.can_port(recipe)),
        6 => drop(cell.port(Bus::TcpListen { listen: listen()? }, recipe)),
        _ => drop(cell.port(Bus::UdpListen { listen: listen()? }, recipe)),
    }
    let port = cell.last_port();
    port.cycle = Duration::from_millis([4, 5, 20, 100][usize::from(kind >> 3 & 3)]);
    port.timeout = Duration::from_millis([20, 100, 1_500][usize::from(kind >> 5) % 3]);
    if kind & 128 != 0 && cell.0.safe_values.len() < 60 {
        let var = var(input, Direction::Input);
        cell.safe(&var.to_string(), f64::from(input.u8() & 3));
    }
    Some(())
}
