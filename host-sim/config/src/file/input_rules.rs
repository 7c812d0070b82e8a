//! How the value of an input field is processed: `as`, `min`, `max` and `outside`, `map`, `no_value`, `valid_to`,
//! `point`.
//!
//! In: the field's table, its encoding, its variable. Out: the rules that follow the field in the configuration.

use proto_core::config::{FieldSpec, InputBinding, InputRule, MapEntry, NO_TEXT, NoText, check_read};
use proto_core::device::{Encoding, Kind, Overflow};
use proto_core::sysvar::{Direction, SysVar, VarBit};
use proto_core::wire::scalar::ScalarType;

use super::bindings::read_var;
use super::encoding::refuse;
use super::model::FileField;
use super::names::meant_variable;
use super::reader::{Result, Spot, TableReader, TableValue};
use super::sendable::{add_entry, behind, read_limits};
use crate::keys::field::{AS, AS_WORDS, POINT, POINTS, RESTARTED, RULES_IN};
use crate::keys::names;

/// The rules that follow an input field, with the places of their keys.
pub(super) fn read(
    table: &TableReader<'_>,
    encoding: Encoding,
    overflow: Overflow,
    to: Option<InputBinding>,
) -> Result<Vec<FileField>> {
    let var = match to {
        Some(InputBinding::Variable { var, .. }) => var,
        Some(InputBinding::Bit { .. }) => {
            let why = "not allowed for a bit: it is off for 0 and on for any other value";
            return refuse(table, &names(RULES_IN.iter()), why).map(|()| Vec::new());
        }
        _ => {
            return refuse(table, &names(RULES_IN.iter()), "allowed only together with to")
                .map(|()| Vec::new());
        }
    };
    if overflow == Overflow::Wrap {
        let why = "not allowed together with overflow = \"wrap\", which takes any number";
        refuse(table, &["as", "min", "max", "outside", "map"], why)?;
    }
    let mut rules = Vec::new();
    let rule = |item: &TableValue<'_>, rule| behind(item.spot.clone(), FieldSpec::InputRule(rule));
    if let Some(item) = table.optional("point") {
        if !matches!(encoding.kind, Kind::Decimal(_)) {
            return Err(item.error("only decimal has a point"));
        }
        if let Some(Some(comma)) = table.word(&POINT, &POINTS)? {
            if encoding.until() == Some(b',') {
                return Err(item.error("a comma ends the field (until), so it cannot be its point"));
            }
            rules.push(rule(&item, comma));
        }
    }
    if let (Some(item), Some(int16)) = (table.optional("as"), table.word(&AS, &AS_WORDS)?) {
        if var.ty() != ScalarType::Word {
            return Err(item.error(format!("{var} is no word register; allowed: WordInputReg")));
        }
        rules.push(rule(&item, int16));
    }
    let is_int16 = !rules.is_empty() && table.optional("as").is_some();
    if let Some(map) = table.optional("map") {
        let why = "not allowed together with map, which says what the variable becomes";
        refuse(table, &["min", "max", "outside", "scale", "offset"], why)?;
        read_map(&map, var, is_int16, &mut rules)?;
    } else {
        rules.extend(read_limits(table, &encoding, |item| read_number(item, &encoding))?);
    }
    if let Some(list) = table.optional("no_value") {
        for item in
            list.array("of numbers or texts that say that there is no value, such as [0x7FFF] or [\"----\"]")?
        {
            rules.push(rule(&item, read_no_value(&item, &encoding)?));
        }
    }
    if let Some(item) = table.optional("valid_to") {
        rules.push(rule(&item, read_valid_to(&item)?));
    }
    Ok(rules)
}

/// The number that reports that the device has restarted.
pub(super) fn read_restarted(table: &TableReader<'_>, encoding: &Encoding) -> Result<Option<(Spot, f64)>> {
    let Some(item) = table.optional(RESTARTED.name) else { return Ok(None) };
    Ok(Some((item.spot.clone(), read_number(&item, encoding)?)))
}

/// A number that the field can have.
fn read_number(item: &TableValue<'_>, encoding: &Encoding) -> Result<f64> {
    let number = item.number()?;
    check_read(encoding, number).map_err(|kind| item.error(kind))?;
    Ok(number)
}

fn read_map(map: &TableValue<'_>, var: SysVar, is_int16: bool, rules: &mut Vec<FileField>) -> Result<()> {
    let (mut entries, mut otherwise): (Vec<(Spot, MapEntry)>, _) = (Vec::new(), None);
    for (key, key_spot, item) in map.any_table()?.entries() {
        let sent = item.number()?;
        let (low, high) = match var.ty() {
            _ if is_int16 => ScalarType::Short.range(),
            ScalarType::Byte => (0.0, f64::from(var.valid_bits())),
            ty => ty.range(),
        };
        if !(low..=high).contains(&sent) || var.ty() != ScalarType::Float && sent.fract() != 0.0 {
            return Err(item.error(format!("{var} cannot be {sent}; allowed: {low}..={high}")));
        }
        if key == "else" {
            otherwise = Some(behind(item.spot.clone(), FieldSpec::InputRule(InputRule::Else(sent))));
            continue;
        }
        let keys = "values of the field, such as 1, ranges of them, such as \"1..100\", or else";
        add_entry(&mut entries, (key, key_spot, &item), keys, || Ok(sent))?;
    }
    if entries.is_empty() {
        return Err(map.error("no entries; write for example { 0 = 1, \"1..7\" = 2, else = 9 }"));
    }
    let entries = entries.into_iter().map(|(spot, entry)| behind(spot, FieldSpec::Mapped(entry)));
    rules.extend(entries.chain(otherwise));
    Ok(())
}

fn read_no_value(item: &TableValue<'_>, encoding: &Encoding) -> Result<InputRule> {
    let Some(text) = item.as_string() else {
        return read_number(item, encoding).map(InputRule::NoNumber);
    };
    if !encoding.is_digits() {
        return Err(item.error("a text is for fields of digits only: decimal, hex; write a number"));
    }
    NoText::new(text).map(InputRule::NoText).ok_or_else(|| {
        item.error(format!(
            "{text:?} is no such text; allowed: 1..={NO_TEXT} printable characters of ASCII, without blanks at the ends"
        ))
    })
}

fn read_valid_to(item: &TableValue<'_>) -> Result<InputRule> {
    let name = item.string()?;
    if let Some(bit) = VarBit::parse(name) {
        let VarBit { var, bit } =
            bit.map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
        return input(item, var).map(|()| InputRule::ValidTo { var, bit: Some(bit) });
    }
    let var = read_var(item)?;
    input(item, var)?;
    match var.ty() {
        ScalarType::Word => Ok(InputRule::ValidTo { var, bit: None }),
        _ => Err(item.error(format!(
            "{var} is no word register; allowed: WordInputReg, or a bit such as BitInputReg[3].4"
        ))),
    }
}

fn input(item: &TableValue<'_>, var: SysVar) -> Result<()> {
    match var.direction() {
        Direction::Input => Ok(()),
        Direction::Output => {
            Err(item.error(format!("{var} is an output of the controller; allowed: its inputs")))
        }
    }
}
