//! Reads the `checksum` of a frame in a gateway file.
//!
//! In: the table, and the fields of the frame so far. Out: the fields with the checksum at its place.

use proto_core::config::FieldSpec;
use proto_core::device::{Algorithm, Checksum, Crc, DataId, Element, MAX_DATA_ID, TextWidth};
use proto_core::recipe::model::MAX_STREAM_FRAME;

use super::encoding::refuse;
use super::model::FileField;
use super::names::meant_checksum;
use super::reader::{Result, TableReader, TableValue};
use crate::keys::device::{self, CHECKSUM_FORMS, CHECKSUM_ORDERS, DATA_ID_PLACES};

/// Reads the checksum of a frame and inserts it at its place among the fields.
pub(super) fn read_checksum(frame: &TableReader<'_>, head: usize, fields: &mut Vec<FileField>) -> Result<()> {
    let Some(item) = frame.optional("checksum") else { return Ok(()) };
    if item.as_string().is_some() {
        return Err(item.error("expected a table, such as { kind = \"crc16-modbus\" }, found a string"));
    }
    let table = item.any_table()?;
    let algorithm = read_algorithm(&table)?;
    let mut sum = Checksum::standard(algorithm);
    if let Some(item) = table.optional("over") {
        let (first, last) = read_covered(&item)?;
        sum = sum.over(first, last);
    }
    sum.order = table.word(&device::ORDER, &CHECKSUM_ORDERS)?.unwrap_or(sum.order);
    sum.text = table.word_or(&device::AS, &CHECKSUM_FORMS)?;
    sum.data_id = read_data_id(&table)?;
    let nth = match table.optional("at") {
        Some(item) => find_place(&item, head, fields)?,
        None => fields.len(),
    };
    fields.insert(nth, FileField::new(item.spot, String::new(), FieldSpec::Checksum(sum)));
    Ok(())
}

/// Reads `data_id`: a number such as `0x1234`, low byte first, or a list of bytes.
fn read_data_id(table: &TableReader<'_>) -> Result<DataId> {
    let Some(item) = table.optional("data_id") else {
        refuse(table, &["data_id_at"], "allowed only together with data_id")?;
        return Ok(DataId::NONE);
    };
    let bytes: Vec<u8> = if item.is_integer() {
        item.integer::<u16>(0..=0xFFFF)?.to_le_bytes().to_vec()
    } else {
        let list = item.array("of bytes, such as [0x34, 0x12], or a number")?;
        list.iter().map(|item| item.integer(0..=255)).collect::<Result<_>>()?
    };
    let id = DataId::new(&bytes).filter(|id| !id.bytes().is_empty());
    let id = id.ok_or_else(|| {
        let hint = if bytes.len() == LIST_OF_IDS {
            "; data ids that change with the counter, one for each of its numbers, are not supported"
        } else {
            ""
        };
        item.error(format!("{} bytes; allowed: 1 to {MAX_DATA_ID}{hint}", bytes.len()))
    })?;
    Ok(if table.word_or(&device::DATA_ID_AT, &DATA_ID_PLACES)? { id.behind() } else { id })
}

/// Number of data ids in profiles 2 and 22 of AUTOSAR's end-to-end protection: one for each value of the counter.
const LIST_OF_IDS: usize = 16;

fn read_algorithm(table: &TableReader<'_>) -> Result<Algorithm> {
    let kind = table.required("kind", "the algorithm, such as \"crc16-modbus\"")?;
    let name = kind.string()?;
    if name != "crc" {
        let algorithm = Algorithm::named(name).ok_or_else(|| {
            let known: Vec<_> = Algorithm::names().collect();
            let shown: Vec<_> = known.iter().map(|name| format!("{name:?}")).collect();
            let meant = meant_checksum(name, &known);
            let shown = shown.join(", ");
            kind.error(format!("{name:?} is unknown; allowed: {shown}, \"crc\" (with its parameters){meant}"))
        })?;
        table.check(&device::CHECKSUM_TABLE)?;
        return Ok(algorithm);
    }
    table.check(&device::CHECKSUM_TABLE)?;
    let width: u8 = table.integer_needed(&device::WIDTH, "the number of bits, 1..=32")?;
    let most = i64::from(u32::MAX >> (32 - u32::from(width)));
    let number = |key| table.optional(key).map_or(Ok(0), |item| item.integer(0..=most));
    table.required("poly", "the polynomial without its highest term, such as 0x1021")?;
    let refin = table.flag(&device::REFIN)?;
    Ok(Algorithm::Crc(Crc {
        width,
        poly: number("poly")?,
        init: number("init")?,
        xorout: number("xorout")?,
        refin,
        refout: table.optional("refout").map_or(Ok(refin), |item| item.bool())?,
    }))
}

/// Reads the covered bytes, `"1.."` or `"1..7"`: the first byte, and the last one if given.
fn read_covered(item: &TableValue<'_>) -> Result<(u16, Option<u16>)> {
    let text = item.string()?;
    let number = |text: &str| text.parse::<u16>().ok().filter(|&at| usize::from(at) < MAX_STREAM_FRAME);
    let range = text.split_once("..").and_then(|(first, last)| {
        let last = if last.is_empty() { None } else { Some(number(last)?) };
        Some((number(first)?, last))
    });
    match range {
        Some((first, last)) if last.is_none_or(|last| first <= last) => Ok((first, last)),
        Some(_) => Err(item.error(format!("{text:?} runs backwards; write the first byte, then the last one"))),
        None => Err(item.error(format!(
            "{text:?} is not a range of bytes; write \"1..7\", or \"1..\" for all up to the checksum; byte 0 is \
             the first of the frame"
        ))),
    }
}

/// The number of fields before the byte that `item` names.
fn find_place(item: &TableValue<'_>, head: usize, fields: &[FileField]) -> Result<usize> {
    let at: usize = item.integer(device::AT.integers())?;
    // Places between two fields; bytes after a field of variable length have no number.
    let mut places = Vec::new();
    let mut offset = Some(head);
    for (nth, field) in fields.iter().enumerate() {
        let spec = field.spec();
        if spec.is_of_field_before() {
            continue;
        }
        let element = spec.element();
        let encoding = element.and_then(|element| element.encoding());
        if encoding.is_some_and(|encoding| encoding.shared) {
            continue;
        }
        places.extend(offset.map(|offset| (offset, nth)));
        let len = match (element, encoding) {
            (Some(Element::Padding { len, .. }), _) => Some(usize::from(len)),
            (Some(Element::Text(text)), _) => match text.width {
                TextWidth::Fixed(width) => Some(usize::from(width)),
                TextWidth::Until(_) | TextWidth::Rest => None,
            },
            (_, Some(encoding)) => encoding.size(),
            _ => Some(0),
        };
        offset = offset.zip(len).map(|(offset, len)| offset + len);
    }
    places.extend(offset.map(|offset| (offset, fields.len())));
    places.iter().find(|&&(offset, _)| offset == at).map(|&(_, nth)| nth).ok_or_else(|| {
        let places: Vec<_> = places.iter().map(|(offset, _)| offset.to_string()).collect();
        item.error(format!(
            "no field begins or ends at byte {at}; allowed: {}, or no at for the place behind the fields",
            places.join(", ")
        ))
    })
}
