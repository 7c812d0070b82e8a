//! The page that is served is the one that was built, and knows the same variables as the core.

use std::fs;
use std::io::Read;

use flate2::read::GzDecoder;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::wire::dialect::Dialect;

#[test]
fn the_compressed_page_is_the_built_one() {
    let mut page = Vec::new();
    GzDecoder::new(&recipe_console::PAGE[..]).read_to_end(&mut page).unwrap();
    assert_eq!(page, fs::read("dist/index.html").unwrap());
    assert!(page.starts_with(b"<!doctype html>"));
}

#[test]
fn nothing_is_asked_of_another_server() {
    let page = fs::read_to_string("dist/index.html").unwrap();
    for address in page.split(['"', '\'', '`', ' ', '(']).filter(|text| text.contains("://")) {
        assert!(address.starts_with("http://www.w3.org/"), "{address}");
    }
    assert!(recipe_console::POLICY.contains("default-src 'none'"), "{}", recipe_console::POLICY);
    assert!(!recipe_console::POLICY.contains("unsafe"), "{}", recipe_console::POLICY);
}

/// `row("WordInputReg", 1, 32, "word", true, "about", "unit")` of `web/src/variables.ts`.
#[test]
fn its_variables_are_those_of_the_core() {
    let source = fs::read_to_string("web/src/variables.ts").unwrap();
    let mut listed = Vec::new();
    for line in source.lines().filter_map(|line| line.trim().strip_prefix("row(\"")) {
        let (group, rest) = line.split_once("\", ").unwrap();
        let mut parts = rest.splitn(5, ", ");
        let mut next = || parts.next().unwrap().trim_matches('"').to_owned();
        let (first, last): (u16, u16) = (next().parse().unwrap(), next().parse().unwrap());
        let (ty, is_input) = (next(), next() == "true");
        let texts: Vec<_> = parts.next().unwrap().split('"').collect();
        let (about, unit) = (texts[1], texts.get(3).copied().unwrap_or(""));
        for index in first..=last {
            listed.push(format!("{group}[{index}] {ty} {is_input} {about} {unit}"));
        }
    }
    let known: Vec<_> = SysVar::all()
        .map(|var| {
            let ty = format!("{:?}", var.ty()).to_lowercase();
            format!(
                "{var} {ty} {} {} {}",
                var.direction() == Direction::Input,
                var.span().interface,
                var.unit()
            )
        })
        .collect();
    assert_eq!(listed, known);
}

#[test]
fn its_dialects_are_those_of_the_core() {
    let source = fs::read_to_string("web/src/compile.ts").unwrap();
    let (_, words) = source.split_once("controller.word(\"dialect\", [").unwrap();
    let (words, _) = words.split_once(']').unwrap();
    let listed: Vec<_> = words.split(", ").map(|word| word.trim_matches('"')).collect();
    assert_eq!(listed, Dialect::NAMES);
}
