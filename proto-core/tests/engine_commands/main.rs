//! Commands from bits, ranges and devices that are mostly silent (docs/engine.md section 7).

mod bits;
mod ranges;
mod replies;
#[path = "../rig/mod.rs"]
mod rig;
mod silence;

use proto_core::config::*;
use proto_core::device::{Bits, ByteOrder, Encoding, Kind, Overflow};
use proto_core::engine::{DropReason, DroppedCommand, LinkId, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use rig::*;

/// Bit `first` of a byte, which may have begun with the field before.
fn bit(first: u8, shared: bool, to: InputBinding) -> FieldSpec {
    let kind = Kind::Bits(Bits { bytes: 1, first, count: 1, signed: false });
    let encoding = Encoding { kind, order: ByteOrder::Little, shared };
    FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to }
}

/// A port whose frames are 0xA5 and these fields.
fn panel(cell: &mut Cell, fields: &[FieldSpec]) -> PortId {
    let fields = cell.fields(fields.iter().copied());
    let input = cell.part(&[0xA5], &[], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    cell.rs485(recipe)
}

/// Commands for ranges of values: first, last and text.
fn ranges(cell: &mut Cell, entries: &[(i64, i64, &str)]) -> Span {
    let start = cell.0.commands.len() as u16;
    for &(first, last, text) in entries {
        let text = heapless::String::try_from(text).unwrap();
        let mut entry = CommandEntry::new(first, text);
        entry.last = last;
        cell.0.commands.push(entry).unwrap();
    }
    Span { start, len: entries.len() as u16 }
}

/// The commands that were sent on a link since the last call.
fn sent(rig: &mut Rig, link: LinkId) -> Vec<String> {
    rig.sent_on(link).into_iter().map(|text| String::from_utf8(text).unwrap()).collect()
}

#[track_caller]
fn reply(rig: &Rig, port: PortId) -> ReplyCode {
    rig.engine.reply_code(port).unwrap()
}

/// Why a value of the first port gave no command: the reason, the field and the value.
fn not_given(rig: &Rig) -> Option<(DropReason, u8, i64)> {
    let status = rig.engine.status(rig.now);
    let last = status.ports().next().unwrap().last_dropped.copied();
    last.map(|DroppedCommand { why, field, value, .. }| (why, field, value))
}

/// The newest command that a value of the first port picked.
fn newest(rig: &Rig) -> Option<String> {
    let status = rig.engine.status(rig.now);
    status.ports().next().unwrap().command.map(|command| command.to_string())
}
