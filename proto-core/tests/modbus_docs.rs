//! The tables of docs/wire/modbus.md say what the code's map says, line for line.

use proto_core::modbus::map::{Access, MAP, MapRun, Space};

fn row(item: &MapRun) -> String {
    let last = item.end() - 1;
    let addresses = if item.first == last { last.to_string() } else { format!("{}-{last}", item.first) };
    let access = match item.access {
        Access::ReadOnly => "R",
        Access::ReadWrite => "R/W",
    };
    let counts = match (item.space, item.per_unit) {
        (Space::Coils, _) => String::new(),
        (Space::Holding, 0) => " |".into(),
        (Space::Holding, per_unit) => format!(" {per_unit} |"),
    };
    format!("| {addresses} | {} | {access} |{counts}", item.content)
}

#[track_caller]
fn assert_documents(space: Space, title: &str) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/wire/modbus.md");
    let page = std::fs::read_to_string(path).unwrap();
    let section = page.split("\n## ").find(|section| section.starts_with(title)).expect(title);
    let written: Vec<&str> = section.lines().filter(|line| line.starts_with('|')).skip(2).collect();
    let expected: Vec<String> = MAP.iter().filter(|item| item.space == space).map(row).collect();
    assert_eq!(written, expected, "the table should be:\n{}\n", expected.join("\n"));
}

#[test]
fn the_coil_table_is_the_codes() {
    assert_documents(Space::Coils, "7. Coils");
}

#[test]
fn the_holding_register_table_is_the_codes() {
    assert_documents(Space::Holding, "8. Holding registers");
}
