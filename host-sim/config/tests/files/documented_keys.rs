//! The tables of keys in docs/configuration.md and docs/fleet.md are those of the key table. `DOCS=write` writes them.

use std::collections::HashSet;
use std::fs;

use recipe_config::keys::{self, DOCUMENTED, Key, KeyTable, Need, Shape, When};
use recipe_test_kit::repository;

#[test]
fn the_page_has_the_tables_of_keys() {
    has_tables("docs/configuration.md", DOCUMENTED);
}

#[test]
fn the_page_of_the_fleet_has_its_tables() {
    has_tables("docs/fleet.md", keys::sparkplug::DOCUMENTED);
}

fn has_tables(page: &str, documented: &[(&str, &[&[Key]])]) {
    let path = repository().join(page);
    let page = fs::read_to_string(&path).unwrap();
    let mut made = String::new();
    let mut rest = page.as_str();
    let mut seen = Vec::new();
    while let Some((before, behind)) = rest.split_once("<!-- keys: ") {
        let (name, behind) = behind.split_once(" -->\n").expect("a name");
        let (_, behind) = behind.split_once("<!-- end -->\n").expect("an end");
        let (_, keys) = documented.iter().find(|(known, _)| *known == name).expect(name);
        made += &format!("{before}<!-- keys: {name} -->\n{}<!-- end -->\n", keys::rows(keys));
        seen.push(name);
        rest = behind;
    }
    made += rest;
    let names: Vec<_> = documented.iter().map(|(name, _)| *name).collect();
    assert_eq!(seen.iter().collect::<HashSet<_>>().len(), seen.len(), "{seen:?}");
    assert!(names.iter().all(|name| seen.contains(name)), "of {names:?} the page has {seen:?}");
    if std::env::var_os("DOCS").is_some() {
        fs::write(&path, made).unwrap();
        return;
    }
    let differs = page.lines().zip(made.lines()).position(|(page, made)| page != made);
    assert!(
        page == made,
        "line {differs:?} of {} is not that of the key table; DOCS=write writes it",
        path.display()
    );
}

/// Every table below this one, and itself, with a word for where it is.
fn tables(table: &'static KeyTable, all: &mut Vec<&'static KeyTable>) {
    if all.iter().any(|known| known.name == table.name) {
        return;
    }
    all.push(table);
    table.keys().for_each(|key| below(&key.shape, all));
}

fn below(shape: &'static Shape, all: &mut Vec<&'static KeyTable>) {
    match shape {
        Shape::Table(table) => tables(table, all),
        Shape::List(item, ..) | Shape::Map(item, _) => below(item, all),
        Shape::Either(shapes) => shapes.iter().for_each(|shape| below(shape, all)),
        _ => {}
    }
}

fn all_tables() -> Vec<&'static KeyTable> {
    static TOPS: [KeyTable; 2] = [keys::top::GATEWAY, keys::top::CONTROLLER];
    let mut all = Vec::new();
    TOPS.iter().for_each(|top| tables(top, &mut all));
    all
}

#[test]
fn the_page_has_every_key() {
    let documented: Vec<&Key> =
        DOCUMENTED.iter().flat_map(|(_, lists)| lists.iter().copied().flatten()).collect();
    for table in all_tables().into_iter().filter(|table| !table.name.ends_with(" file")) {
        for key in table.keys() {
            // The same key can have another default or range in another place.
            let same = documented.iter().any(|known| known.name == key.name);
            assert!(same, "{}.{} is not on the page", table.name, key.name);
        }
    }
}

#[test]
fn the_key_table_is_consistent() {
    for table in all_tables() {
        for key in table.keys() {
            let name = format!("{}.{}", table.name, key.name);
            assert!(
                !key.text.is_empty() || !key.unit.is_empty() || matches!(key.shape, Shape::Words(_)),
                "{name}"
            );
            if let Need::Word(word) = key.need
                && let Shape::Words(words) = key.shape
            {
                assert!(words().contains(&word), "{name}: the default is not allowed");
            }
            if let Need::Integer(value) = key.need {
                assert!(key.integers().contains(&value), "{name}: the default is not allowed");
                assert!(key.limits().take(value as f64), "{name}: the default is not allowed");
            }
            if let (true, Shape::Words(words)) = (key.lists_allowed, key.shape) {
                let is_told = |word: &&str| {
                    key.text.contains(&format!("\"{word}\"")) || key.text.contains(&format!("`{word}`"))
                };
                // What only some cases allow is told where all are.
                let untold: Vec<_> = words().into_iter().filter(|word| !is_told(word)).collect();
                assert!(untold.is_empty() || key.text.contains("below"), "{name}: {untold:?}");
            }
            for beside in key.beside {
                assert!(table.keys().any(|other| other.name == *beside), "{name}: there is no {beside}");
            }
        }
        for when in table.cases.iter().flat_map(|case| case.when) {
            let keys: &[&str] = match when {
                When::Is(key, ..) => &[key],
                When::Has(keys) => keys,
            };
            for key in keys {
                assert!(table.keys().any(|other| other.name == *key), "{}: there is no {key}", table.name);
            }
        }
    }
}

/// What a file leaves out is what the configuration has without it.
#[test]
fn defaults_are_those_of_the_configuration() {
    use proto_core::config::{Bus, ControllerLink, Port, Rs485};
    let gateway = recipe_config::file::parse_gateway(
        recipe_config::file::Text {
            name: "least.toml",
            toml: "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n\
                   [recipe.input]\nhead = [1]\nfields = [{ name = \"x\", type = \"byte\" }]\n\
                   [[port]]\nname = \"p\"\nbus = \"rs485\"\nrecipe = \"r\"\n",
        },
        &[],
    )
    .unwrap_or_else(|error| panic!("{error}"));
    let mut link = ControllerLink::default();
    link.address = gateway.controller.address.clone();
    assert_eq!(gateway.controller, link);
    let port = &gateway.ports[0];
    let mut least = Port::new(port.name.clone(), Bus::Rs485(Rs485::default()), 0);
    least.on_timeout = port.on_timeout;
    assert_eq!(*port, least);
}
