//! The tables of docs/wire/sysvars.md say what the code's table says, line for line.

use proto_core::sysvar::{Direction, ModbusPlace, SPANS, Span, SysVar};

/// The variables of a row, first and last.
fn ends(span: &Span) -> (SysVar, SysVar) {
    let var = |index| SysVar::named(span.group, u32::from(index)).unwrap();
    (var(span.first), var(span.last))
}

fn range(first: usize, last: usize) -> String {
    if first == last { first.to_string() } else { format!("{first}-{last}") }
}

fn modbus(first: SysVar, last: SysVar) -> String {
    match (first.modbus(), last.modbus()) {
        (Some(ModbusPlace::Coils { first, .. }), Some(ModbusPlace::Coils { first: last, count })) => {
            format!("coils {}", range(usize::from(first), usize::from(last + count) - 1))
        }
        (Some(ModbusPlace::Register { address }), Some(ModbusPlace::Register { address: last })) => {
            format!("holding {}", range(usize::from(address), usize::from(last)))
        }
        (
            Some(ModbusPlace::Scaled { address, per_unit }),
            Some(ModbusPlace::Scaled { address: last, .. }),
        ) => format!("holding {}, x {per_unit}", range(usize::from(address), usize::from(last))),
        _ => "none".into(),
    }
}

fn row(span: &Span) -> String {
    let (first, last) = ends(span);
    let name = if first == last {
        first.to_string()
    } else {
        format!("{}[{}..{}]", span.group, span.first, span.last)
    };
    let bits = match span.valid_bits {
        0xFF => String::new(),
        bits => format!(", bits {bits:#04x}"),
    };
    let stream = first.stream().map_or("none".into(), |place| place.offset.to_string());
    let image = range(first.image_offset(), last.image_offset() + last.size() - 1);
    format!(
        "| {name} | {}{bits} | {} | {} | {image} | {stream} | {} |",
        span.ty,
        span.interface,
        span.unit,
        modbus(first, last)
    )
}

#[track_caller]
fn assert_documents(direction: Direction, title: &str) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/wire/sysvars.md");
    let page = std::fs::read_to_string(path).unwrap();
    let section = page.split("\n## ").find(|section| section.starts_with(title)).expect(title);
    let written: Vec<&str> = section.lines().filter(|line| line.starts_with('|')).skip(2).collect();
    let rows = SPANS.iter().filter(|span| ends(span).0.direction() == direction);
    let expected: Vec<String> = rows.map(row).collect();
    assert_eq!(written, expected, "section {title:?} of {path} should read\n{}", expected.join("\n"));
}

#[test]
fn inputs_are_documented() {
    assert_documents(Direction::Input, "1. Inputs");
}

#[test]
fn outputs_are_documented() {
    assert_documents(Direction::Output, "2. Outputs");
}
