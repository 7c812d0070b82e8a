//! The writers of variables: a table for a person who configures other tools.
//!
//! In: the frames of a file. Out: one row for each use of a variable, or for each field without one, as Markdown or
//! CSV: the variable with its place in the controller's Modbus map, the port, the frame, and where in the frame it is.

use proto_core::config::FieldSpec;
use proto_core::device::{Bits, ByteOrder, Digits, Element, Kind, Place, Text, TextWidth, Width};
use proto_core::sysvar::{Direction, ModbusPlace, SysVar};
use proto_core::wire::can::CanId;

use crate::model::{Format, FrameField, Model, Owner, PortModel};
use crate::uses::{describe_use, unit_of};

/// The format of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// A table of Markdown.
    Markdown,
    /// Comma-separated values (RFC 4180), with a heading.
    Csv,
}

const HEADINGS: [&str; 10] =
    ["variable", "Modbus", "unit", "written by", "port", "recipe", "frame", "bytes", "field", "conversion"];

type MapRow = [String; 10];

/// The table.
pub fn map(model: &Model, style: Style) -> String {
    let mut rows: Vec<(usize, MapRow)> = Vec::new();
    for port in &model.ports {
        let Some(recipe) = model.recipe_of(port) else { continue };
        for format in &recipe.formats {
            for field in &format.fields {
                add_field(&mut rows, model.owner, port, &recipe.name, format, field);
            }
        }
        for (value, var) in &port.health {
            let port_name = port.name.clone();
            let row = row(
                Some(*var),
                [&writer(model.owner, Direction::Input), &port_name, "", "", "", value, "the port's health"],
            );
            rows.push((var.ordinal(), row));
        }
        for (item, var, value) in &port.safe {
            let words = format!("{item} = {value} while the device is silent");
            let row =
                row(Some(*var), [&writer(model.owner, Direction::Input), &port.name, "", "", "", "", &words]);
            rows.push((var.ordinal(), row));
        }
    }
    // Sorted by variable, then in file order.
    rows.sort_by_key(|(ordinal, _)| *ordinal);
    let rows = rows.iter().map(|(_, row)| row);
    match style {
        Style::Markdown => markdown(rows),
        Style::Csv => csv(rows),
    }
}

fn add_field(
    rows: &mut Vec<(usize, MapRow)>,
    owner: Owner,
    port: &PortModel,
    recipe: &str,
    format: &Format,
    field: &FrameField,
) {
    if matches!(field.field.spec, FieldSpec::Padding { .. } | FieldSpec::Checksum(_))
        || field.name().is_empty()
    {
        return;
    }
    let element = field.element.and_then(|nth| format.frame.elements.get(nth));
    let frame = match format.id {
        None => format.role.name(),
        Some(CanId::Standard(id)) => format!("{} 0x{id:03X}", format.role.name()),
        Some(CanId::Extended(id)) => format!("{} 0x{id:08X}", format.role.name()),
    };
    let named = format!("{} ({})", field.name(), element.map(show_element).unwrap_or_default());
    let (place, uses) = (show_place(field.place), describe_use(field));
    let writer = writer(owner, format.direction);
    let rest = [&writer[..], &port.name, recipe, &frame, &place, &named, &uses];
    let mut variables: Vec<SysVar> = field.field.spec.variables().collect();
    variables.extend(field.system);
    // A constant needs no row: there is nothing to configure for it.
    if variables.is_empty() && field.constant().is_none() {
        rows.push((usize::MAX, row(None, rest)));
    }
    for var in variables {
        rows.push((var.ordinal(), row(Some(var), rest)));
    }
}

/// The writer of the value: what the owner of the file receives comes from its devices, what it sends from the
/// controller.
fn writer(owner: Owner, direction: Direction) -> String {
    match (owner, direction) {
        (Owner::Gateway, Direction::Input) => "field",
        (Owner::Controller, Direction::Input) => "user",
        (_, Direction::Output) => "controller",
    }
    .into()
}

fn row(var: Option<SysVar>, rest: [&str; 7]) -> MapRow {
    let name = var.map(|var| var.to_string()).unwrap_or_default();
    let place = var.and_then(SysVar::modbus).map(show_modbus).unwrap_or_default();
    let unit = var.map_or("", unit_of).to_owned();
    let [writer, port, recipe, frame, bytes, field, uses] = rest.map(str::to_owned);
    [name, place, unit, writer, port, recipe, frame, bytes, field, uses]
}

fn show_modbus(place: ModbusPlace) -> String {
    match place {
        ModbusPlace::Coils { first, count } => format!("coils {first}..{}", first + count - 1),
        ModbusPlace::Register { address } => format!("register {address}"),
        ModbusPlace::Scaled { address, per_unit } => format!("register {address}, {per_unit} per unit"),
    }
}

fn show_place(place: Place) -> String {
    match (place.at, place.len) {
        (Some(at), Some(1)) => at.to_string(),
        (Some(at), Some(len)) => format!("{at}..{}", at + len - 1),
        (Some(at), None) => format!("{at}.."),
        (None, _) => "behind a field of varying length".into(),
    }
}

fn show_element(element: &Element) -> String {
    let Some(encoding) = element.encoding() else {
        return match element {
            Element::Text(Text { width: TextWidth::Fixed(width), .. }) => format!("text of {width}"),
            _ => "text".into(),
        };
    };
    let order = match encoding.order {
        _ if encoding.size().is_none_or(|size| size == 1) => "",
        ByteOrder::Little => ", little-endian",
        ByteOrder::Big => ", big-endian",
        ByteOrder::BigSwapped => ", big-endian, low word first",
        ByteOrder::LittleSwapped => ", little-endian, high word first",
    };
    let width = |width| match width {
        Width::Fixed(count) => format!("{count} characters"),
        Width::Until(end) => format!("up to {:?}", char::from(end)),
    };
    match encoding.kind {
        Kind::Scalar(ty) => format!("{}{order}", ty.name()),
        Kind::Uint24 => format!("uint24{order}"),
        Kind::Int24 => format!("int24{order}"),
        Kind::Bcd { bytes } => format!("BCD, {} digits{order}", 2 * bytes),
        Kind::Decimal(Digits { width: digits, .. }) => format!("decimal, {}", width(digits)),
        Kind::Hex(digits) => format!("hexadecimal, {}", width(digits)),
        Kind::Bits(Bits { first, count: 1, .. }) => format!("bit {first}{order}"),
        Kind::Bits(Bits { first, count, .. }) => format!("bits {first}..{}{order}", first + count - 1),
        _ => String::new(),
    }
}

fn markdown<'r>(rows: impl Iterator<Item = &'r MapRow>) -> String {
    let line = |cells: &[String]| {
        let cells: Vec<_> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let mut text = line(&HEADINGS.map(str::to_owned));
    text += &line(&HEADINGS.map(|_| "---".to_owned()));
    rows.for_each(|row| text += &line(row));
    text
}

fn csv<'r>(rows: impl Iterator<Item = &'r MapRow>) -> String {
    let cell = |cell: &String| {
        if cell.contains([',', '"', '\n', '\r']) {
            format!("\"{}\"", cell.replace('"', "\"\""))
        } else {
            cell.clone()
        }
    };
    let line = |cells: &[String]| cells.iter().map(cell).collect::<Vec<_>>().join(",") + "\r\n";
    let mut text = line(&HEADINGS.map(str::to_owned));
    rows.for_each(|row| text += &line(row));
    text
}

#[cfg(test)]
mod tests {
    use recipe_test_kit::example;

    use super::*;

    #[test]
    fn every_use_of_a_variable_has_a_row() {
        let model = Model::load(&example("can-hand.toml"), &[]).unwrap();
        let text = map(&model, Style::Csv);
        let rows: Vec<_> = text.lines().collect();
        assert_eq!(rows[0], HEADINGS.join(","));
        assert_eq!(
            rows[1],
            "WordInputReg[1],register 8,,field,hand,hand,input 0x502,0,state (byte),to WordInputReg[1]"
        );
        assert_eq!(
            rows[2],
            "WordInputReg[1],register 8,,field,hand,,,,,WordInputReg[1] = 0 while the device is silent"
        );
        assert_eq!(
            rows[4],
            "WordInputReg[3],register 10,,field,hand,hand,input 0x502,2..3,\"grip (word, little-endian)\",to WordInputReg[3]"
        );
        assert_eq!(rows.len(), 1 + 3 + 1 + 6);
    }

    #[test]
    fn cells_of_a_table_have_no_bars() {
        let row = std::array::from_fn(|_| "a|b".to_owned());
        let text = markdown([&row].into_iter());
        assert!(text.lines().nth(2).unwrap().starts_with("| a\\|b | a\\|b |"), "{text}");
    }
}
