//! The parts of a frame that all kinds of recipes have: its id, its head and tail, its list of fields.
//!
//! In: tables. Out: ids, bytes and [`FileField`]s.

use proto_core::config::FieldSpec;
use proto_core::recipe::model::{Mode, Rules};
use proto_core::sysvar::VarRange;
use proto_core::wire::can::CanId;

use super::checksums;
use super::device::FieldReader;
use super::model::{FileField, Flavour};
use super::names::meant_variable;
use super::reader::{Result, Spot, TableReader, TableValue};
use crate::keys;

/// Reads a CAN id of 11 bits, or of 29 bits with `extended = true`.
pub(super) fn read_id(frame: &TableReader<'_>, item: &TableValue<'_>) -> Result<CanId> {
    let is_extended = frame.flag(&keys::frame::EXTENDED)?;
    let limit = if is_extended { "0x1FFFFFFF" } else { "0x7FF" };
    if !item.is_integer() {
        return Err(item.no_integer(&format!("0..={limit}")));
    }
    let number: i64 = item.integer(i64::MIN..=i64::MAX)?;
    let standard = || u16::try_from(number).ok().map(CanId::Standard);
    let extended = || u32::try_from(number).ok().map(CanId::Extended);
    let id = if is_extended { extended() } else { standard() };
    id.filter(|id| id.is_valid()).ok_or_else(|| {
        let hint = if extended().is_some_and(CanId::is_valid) {
            ", or 0..=0x1FFFFFFF with extended = true"
        } else {
            ""
        };
        let shown = if number < 0 { number.to_string() } else { format!("{number:#X}") };
        item.error(format!("{shown} is out of range; allowed: 0..={limit}{hint}"))
    })
}

pub(super) fn read_bytes(table: &TableReader<'_>, key: &str) -> Result<(Vec<u8>, Option<Spot>)> {
    let Some(item) = table.optional(key) else { return Ok((Vec::new(), None)) };
    let bytes = item
        .array("of bytes, such as [255, 255]")?
        .iter()
        .map(|item| item.integer(0..=255))
        .collect::<Result<_>>()?;
    Ok((bytes, Some(item.spot)))
}

/// The fields of a stream part, or of one CAN frame, after a head of this many bytes.
pub(super) fn read_fields(
    table: &TableReader<'_>,
    head: usize,
    rules: Rules,
    flavour: Flavour,
) -> Result<Vec<FileField>> {
    let mut reader = FieldReader::new(table, rules, flavour)?;
    let list = table.required("fields", "the list of the frame's fields")?;
    let mut fields = Vec::new();
    for item in list.array("of fields, such as [\"RobotState[8..13]\"]")? {
        match (rules.mode, item.as_string()) {
            (Mode::Realtime, Some(name)) => {
                let range = VarRange::parse(name)
                    .map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
                fields.extend(
                    range.iter().map(|var| {
                        FileField::new(item.spot.clone(), var.to_string(), FieldSpec::System(var))
                    }),
                );
            }
            (Mode::Realtime, None) => {
                return Err(item.error(
                    "the fields of a realtime recipe are names of system variables, such as \"RobotState[8]\"; \
                     for fields of your own set mode = \"user\"",
                ));
            }
            (Mode::User, Some(_)) => {
                return Err(item.error(
                    "the fields of a user recipe are tables, such as { name = \"grip\", type = \"byte\" }; \
                     for system variables set mode = \"realtime\"",
                ));
            }
            (Mode::User, None) => reader.read(&item, &mut fields)?,
        }
    }
    checksums::read_checksum(table, head, &mut fields)?;
    Ok(fields)
}
