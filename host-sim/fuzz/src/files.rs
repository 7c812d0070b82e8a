//! Configuration files, damaged or not, with `--set` overrides: either one line says what is wrong, or an
//! engine and a board accept the configuration (docs/configuration.md).

use proto_core::config::GatewayConfig;
use proto_core::config::image::{MAX_IMAGE, decode, encode};
use proto_core::engine::{BuildError, Engine};
use recipe_config::file::{Config, FileError, Text, parse, parse_controller, parse_gateway, parse_recipes};
use recipe_fuzz::source::Source;
use recipe_test_kit::toml::PIECES;
use toml::{Table, Value};

const NAME: &str = "fuzz.toml";

/// Values of overrides.
const VALUES: [&str; 24] = [
    "0",
    "1",
    "-1",
    "4",
    "65535",
    "65536",
    "9600",
    "500000",
    "1.5",
    "nan",
    "true",
    "can",
    "rs485",
    "stream",
    "\"user\"",
    "[]",
    "[1, 2]",
    "{}",
    "{ a = 1 }",
    "[\"RobotState[8]\"]",
    "",
    "a\nb",
    "\"",
    "10.0.0.2",
];

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let kind = input.u8();
    let text = match kind & 1 {
        0 => String::from_utf8_lossy(input.run()).into_owned(),
        _ => damaged(&mut input),
    };
    let text = if kind & 2 == 0 { text } else { text + &*String::from_utf8_lossy(input.rest()) };
    alone(&text);
    let table = text.parse::<Table>();
    if let (Ok(_), Err(error)) = (parse_text(&text, &[]), &table) {
        panic!("taken, and is no TOML: {error}");
    }
    let overrides: Vec<Override> =
        (0..kind >> 6).map(|_| Override::read(&mut input, table.as_ref().ok())).collect();
    let texts: Vec<String> = overrides.iter().map(|one| one.text.clone()).collect();
    if let Err(error) = parse_text(&text, &texts) {
        one_line(&error);
    }
    if let Ok(table) = table {
        against_the_file(&table, &overrides);
    }
}

/// One of the example files with pieces inserted and removed.
fn damaged(input: &mut Source<'_>) -> String {
    let mut text = input.one_of(&FILES).to_owned();
    for _ in 0..input.below(5) {
        let place = usize::from(input.u16()) % (text.len() + 1);
        let place = (0..=place).rev().find(|&place| text.is_char_boundary(place)).unwrap_or(0);
        let end = (place + input.below(40)).min(text.len());
        let end = (end..=text.len()).find(|&end| text.is_char_boundary(end)).unwrap_or(place);
        text.replace_range(place..end, input.one_of(&PIECES));
    }
    text
}

fn parse_text(text: &str, overrides: &[String]) -> Result<Config, FileError> {
    parse(Text { name: NAME, toml: text }, overrides)
}

fn one_line(error: &FileError) {
    let message = error.to_string();
    assert!(message.starts_with("fuzz.toml:") || message.starts_with("--set "), "{message}");
    assert!(!message.chars().any(char::is_control), "{message:?}");
}

/// Checks the file without overrides.
fn alone(text: &str) {
    let read = parse_text(text, &[]);
    let named = Text { name: NAME, toml: text };
    let (gateway, controller) = (parse_gateway(named, &[]), parse_controller(named, &[]));
    let recipes = parse_recipes(named, &[]);
    match &read {
        Ok(Config::Gateway(config)) => {
            assert_eq!(gateway.as_ref(), Ok(config));
            assert!(controller.is_err() && recipes.is_ok());
            usable(config);
        }
        Ok(Config::Controller(config)) => {
            assert_eq!(controller.as_ref(), Ok(&**config));
            assert!(gateway.is_err() && recipes.is_ok());
        }
        // A file with sections of neither kind is of the kind that the caller expects.
        Err(_) => assert!(gateway.is_err() || controller.is_err()),
    }
    for error in [read.err(), gateway.err(), controller.err(), recipes.err()].into_iter().flatten() {
        one_line(&error);
    }
}

/// Checks that an engine and a board accept a configuration that was read.
fn usable(config: &GatewayConfig) {
    config.validate().expect("it was checked");
    let engine = Engine::<8, 4, 512>::new(config);
    assert!(!matches!(engine, Err(BuildError::Config(_))), "{:?}", engine.map(|_| ()));
    let mut image = vec![0; MAX_IMAGE];
    if let Ok(len) = encode(config, &mut image) {
        assert_eq!(decode(&image[..len]).as_ref(), Ok(config));
    }
}

/// An override, and its equivalent in the file where there is a simple one.
struct Override {
    text: String,
    means: Option<(Vec<String>, String)>,
}

impl Override {
    fn read(input: &mut Source<'_>, table: Option<&Table>) -> Self {
        let value = match input.u8() {
            nth if usize::from(nth) < VALUES.len() => VALUES[usize::from(nth)].to_owned(),
            _ => String::from_utf8_lossy(input.run()).into_owned(),
        };
        let Some(path) = table.and_then(|table| path(input, table)) else {
            let key = String::from_utf8_lossy(input.run()).into_owned();
            return Self {
                text: format!("{key}{}{value}", ["=", ""][usize::from(key.ends_with('='))]),
                means: None,
            };
        };
        let quoted = |name: &String| if name.contains('.') { format!("\"{name}\"") } else { name.clone() };
        let key = path.iter().map(quoted).collect::<Vec<_>>().join(".");
        // A name that is empty or has quotes has no simple form.
        let plain = path
            .iter()
            .all(|name| !name.is_empty() && !name.contains(['"', '=', '[', ']']) && name.trim() == name);
        Self { text: format!("{key}={value}"), means: plain.then_some((path, value)) }
    }
}

/// The path of keys to a random value of the file, or to a new one.
fn path(input: &mut Source<'_>, table: &Table) -> Option<Vec<String>> {
    let mut path = Vec::new();
    let mut at = &Value::Table(table.clone());
    loop {
        let turn = input.u8();
        match at {
            Value::Table(table) if turn < 240 => {
                let (name, inner) = table.iter().nth(usize::from(turn) % table.len().max(1))?;
                path.push(name.clone());
                at = inner;
            }
            Value::Table(_) => {
                path.push(
                    ["cycle_ms", "name", "ports", "input", "timeout_ms", "1"][usize::from(turn) % 6]
                        .to_owned(),
                );
                return Some(path);
            }
            Value::Array(items) if turn < 200 && !items.is_empty() => {
                let nth = usize::from(turn / 2) % items.len();
                let name = items[nth].get("name").and_then(Value::as_str);
                path.push(
                    name.filter(|_| turn.is_multiple_of(2))
                        .map_or_else(|| (nth + 1).to_string(), str::to_owned),
                );
                at = &items[nth];
            }
            _ => return (!path.is_empty()).then_some(path),
        }
        if turn % 16 == 15 {
            return Some(path);
        }
    }
}

/// Section 1: an override has the same effect as the same text in the file.
fn against_the_file(table: &Table, overrides: &[Override]) {
    // Serialized again, so that the keys have the same order in both.
    let text = toml::to_string(table).expect("what was read can be written");
    assert_eq!(parse_text(&text, &[]).is_ok(), parse_text(&table.to_string(), &[]).is_ok());
    let mut changed = table.clone();
    let mut fits = true;
    for one in overrides {
        let Some((path, value)) = &one.means else { return };
        // The order of lines in this table matters, and a new one would be the last.
        if path.iter().any(|name| name == "to" || name == "initial" || name == "on_timeout") {
            return;
        }
        let value = match format!("x = {value}").parse::<Table>() {
            _ if value.contains('\n') => return,
            Ok(mut table) => table.remove("x").expect("it was just put in"),
            Err(_) if value.trim().starts_with(['[', '{', '"', '\'']) => {
                fits = false;
                break;
            }
            Err(_) => Value::String(value.trim().to_owned()),
        };
        fits &= put(&mut changed, path, value);
    }
    let texts: Vec<String> = overrides.iter().map(|one| one.text.clone()).collect();
    let by_override = parse_text(&text, &texts);
    if !fits {
        return assert!(by_override.is_err(), "{texts:?} cannot be put in: {by_override:?}");
    }
    let changed = toml::to_string(&changed).expect("what was read can be written");
    let in_the_file = parse_text(&changed, &[]);
    match (&by_override, &in_the_file) {
        (Ok(one), Ok(other)) => assert_eq!(sorted(one), sorted(other), "{texts:?}"),
        (Err(_), Err(_)) => {}
        (one, other) => panic!("{texts:?}: {one:?}\nas a file: {other:?}\n{changed}"),
    }
}

fn put(table: &mut Table, path: &[String], value: Value) -> bool {
    let (name, rest) = path.split_first().expect("no path is empty");
    if rest.is_empty() {
        table.insert(name.clone(), value);
        return true;
    }
    let inner = table.entry(name.clone()).or_insert_with(|| Value::Table(Table::new()));
    put_into(inner, rest, value)
}

fn put_into(inner: &mut Value, path: &[String], value: Value) -> bool {
    match inner {
        Value::Table(table) => put(table, path, value),
        Value::Array(items) => {
            let named =
                items.iter().position(|item| item.get("name").and_then(Value::as_str) == Some(&path[0]));
            let number = || path[0].parse::<usize>().ok().filter(|nth| (1..=items.len()).contains(nth));
            let Some(nth) = named.or_else(|| number().map(|number| number - 1)) else { return false };
            if path.len() == 1 {
                items[nth] = value;
                return true;
            }
            put_into(&mut items[nth], &path[1..], value)
        }
        _ => false,
    }
}

/// The configuration with those items sorted whose order has no meaning.
fn sorted(config: &Config) -> Config {
    match config.clone() {
        Config::Controller(mut config) => {
            config.initial.sort_by_key(|one| format!("{one:?}"));
            config.functions.inputs.sort_by_key(|one| format!("{one:?}"));
            config.functions.outputs.sort_by_key(|one| format!("{one:?}"));
            Config::Controller(config)
        }
        gateway => gateway,
    }
}

macro_rules! files {
    ($($name:literal)*) => {
        const FILES: [&str; [$($name),*].len()] = [$(include_str!(concat!("../../configs/", $name, ".toml"))),*];
    };
}

files! {
    "can-hand" "can-hand-controller" "can-system" "can-system-controller" "can-user" "can-user-controller"
    "client" "client-controller" "force-sensor" "force-sensor-controller" "request-response"
    "request-response-controller" "rs485-system" "rs485-system-controller" "rs485-user" "rs485-user-controller"
    "udp-server" "udp-server-controller"
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for nth in 0..FILES.len() as u8 {
        // Unchanged; with overrides of existing items by name and by index, and of new ones.
        seeds.push(vec![1, nth, 0]);
        for turns in
            [[0, 0, 0, 0], [1, 1, 1, 1], [2, 0, 5, 0], [2, 1, 7, 250], [3, 2, 240, 250], [31, 0, 0, 0]]
        {
            for value in [0, 4, 9, 11, 15, 17, 22] {
                seeds.push([&[0x41, nth, 0, value], &turns[..]].concat());
            }
        }
        seeds.push([&[0xC1, nth, 1, 50, 1, 7, 21], &[5, 1, 0, 2, 3, 6, 2, 0, 2, 5, 21, 0, 15][..]].concat());
    }
    // The examples of section 1, on a file with these items.
    for text in [
        "controller.address",
        "controller.ports.modbus",
        "port.rs485-1.baud",
        "recipe.hand.input.frame.1.id",
        "program.\"echo.jspf\".script",
    ] {
        seeds.push([&[0x40, 0, 2, text.len() as u8], text.as_bytes()].concat());
    }
    // Other files, without overrides.
    for text in [
        "",
        "[controller]\naddress = 1",
        "[listen]\n[robot]\n",
        "a = \"\\u0000\"",
        "[[recipe]]\n",
        "[controller]\n[robot]",
    ] {
        seeds.push([&[0, text.len() as u8], text.as_bytes()].concat());
        seeds.push([&[2, 0], text.as_bytes()].concat());
    }
    seeds
}
