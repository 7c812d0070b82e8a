//! The table of docs/wire/state.md section 2 says what the code's table says, line for line.

use proto_core::wire::scalar::ScalarType;
use proto_core::wire::state::{Content, FIELDS, FieldPlace};

/// Offset, name and type as the page's columns have them.
fn columns(field: &FieldPlace) -> [String; 3] {
    let ty = match (field.content, field.ty) {
        (Content::Bools { .. }, ScalarType::Byte) => "bool",
        (_, ty) => ty.name(),
    };
    [field.offset.to_string(), format!("`{}`", field.name), format!("{ty} x {}", field.count)]
}

#[test]
fn the_packet_is_documented() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/wire/state.md");
    let page = std::fs::read_to_string(path).unwrap();
    let section = page.split("\n## ").find(|section| section.starts_with("2. The packet")).unwrap();
    let rows = section.lines().filter(|line| line.starts_with('|')).skip(2);
    let written: Vec<[String; 3]> = rows
        .map(|row| {
            let mut cells = row.split('|').skip(1).map(|cell| cell.trim().to_string());
            std::array::from_fn(|_| cells.next().unwrap_or_default())
        })
        .collect();
    let expected: Vec<[String; 3]> = FIELDS.iter().map(columns).collect();
    assert_eq!(written, expected);
}
