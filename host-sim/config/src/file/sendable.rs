//! Restrictions of an output field of a device's frame: `min`, `max` and `outside`, or `map`.
//!
//! In: the field's table and its encoding. Out: the rules that follow the field in the configuration.

use proto_core::config::{FieldSpec, Limits, MapEntry, OutputBinding, check_sent};
use proto_core::device::{Encoding, Overflow};

use super::commands::read_range;
use super::encoding::refuse;
use super::model::FileField;
use super::reader::{Result, Spot, TableReader, TableValue};
use crate::keys::field::{OUTSIDE, OUTSIDES};

const KEYS: [&str; 4] = ["min", "max", "outside", "map"];

/// The rules that follow an output field, with the places of their keys.
pub(super) fn read(
    table: &TableReader<'_>,
    encoding: Encoding,
    overflow: Overflow,
    from: OutputBinding,
) -> Result<Vec<FileField>> {
    match from {
        OutputBinding::Constant(_) => {
            refuse(table, &KEYS, "allowed only together with from: a constant is what it is")?;
        }
        OutputBinding::Counter | OutputBinding::CounterTo { .. } => {
            refuse(table, &KEYS, "not allowed for a count, which wraps")?;
        }
        OutputBinding::Port { value, .. } if value.is_count() => {
            refuse(table, &KEYS, "not allowed for a count, which wraps")?;
        }
        _ => {}
    }
    if overflow == Overflow::Wrap {
        refuse(table, &KEYS, "not allowed together with overflow = \"wrap\", which sends any number")?;
    }
    if let Some(map) = table.optional("map") {
        let why = "not allowed together with map, which says what is sent";
        refuse(table, &["min", "max", "outside", "scale", "offset"], why)?;
        return read_map(&map, &encoding);
    }
    let limits = read_limits(table, &encoding, |item| read_number(item, &encoding))?;
    Ok(limits.into_iter().collect())
}

/// A rule that applies to the field before it.
pub(super) fn behind(spot: Spot, spec: FieldSpec) -> FileField {
    FileField::new(spot, String::new(), spec)
}

/// The limits of a field; `number` reads their values.
pub(super) fn read_limits(
    table: &TableReader<'_>,
    encoding: &Encoding,
    number: impl Fn(&TableValue<'_>) -> Result<f64>,
) -> Result<Option<FileField>> {
    let (min, max) = (table.optional("min"), table.optional("max"));
    let Some(first) = min.as_ref().or(max.as_ref()) else {
        refuse(table, &["outside"], "allowed only together with min or max")?;
        return Ok(None);
    };
    let spot = first.spot.clone();
    let (lowest, highest) = encoding.range();
    let read = |item: &Option<TableValue<'_>>, default| item.as_ref().map_or(Ok(default), &number);
    let (low, high) = (read(&min, lowest)?, read(&max, highest)?);
    if let Some(max) = max.filter(|_| low > high) {
        return Err(max.error(format!("max {high} is below min {low}")));
    }
    let outside = table.word_or(&OUTSIDE, &OUTSIDES)?;
    Ok(Some(behind(spot, FieldSpec::Limits(Limits { low, high, outside }))))
}

fn read_map(map: &TableValue<'_>, encoding: &Encoding) -> Result<Vec<FileField>> {
    let mut entries: Vec<(Spot, MapEntry)> = Vec::new();
    for (key, key_spot, item) in map.any_table()?.entries() {
        let keys = "values of the source, such as 1, or ranges of them, such as \"1..100\"";
        add_entry(&mut entries, (key, key_spot, &item), keys, || read_number(&item, encoding))?;
    }
    if entries.is_empty() {
        return Err(map.error("no entries; write for example { 0 = 1, \"1..7\" = 2 }"));
    }
    Ok(entries.into_iter().map(|(spot, entry)| behind(spot, FieldSpec::Mapped(entry))).collect())
}

/// Adds the map entry of a key, which no earlier entry may overlap; `keys` describes the keys.
pub(super) fn add_entry(
    entries: &mut Vec<(Spot, MapEntry)>,
    (key, key_spot, item): (&str, Spot, &TableValue<'_>),
    keys: &str,
    sent: impl FnOnce() -> Result<f64>,
) -> Result<()> {
    let wrong = |why: String| item.clone().at(key_spot.clone()).error(why);
    let Some((first, last)) = read_range(key) else {
        return Err(wrong(format!("{key:?} is not an integer; the keys of map are {keys}")));
    };
    if first > last {
        return Err(wrong(format!("{key:?} contains no value; allowed: \"{last}..{first}\"")));
    }
    let sent = sent()?;
    let mut others = entries.iter().map(|(_, other)| (first.max(other.first), last.min(other.last)));
    if let Some((value, _)) = others.find(|(first, last)| first <= last) {
        return Err(wrong(format!("an earlier entry already has the value {value}")));
    }
    entries.push((item.spot.clone(), MapEntry { first, last, sent }));
    Ok(())
}

/// A number that the field can have.
fn read_number(item: &TableValue<'_>, encoding: &Encoding) -> Result<f64> {
    let number = item.number()?;
    check_sent(encoding, number).map_err(|kind| item.error(kind))?;
    Ok(number)
}
