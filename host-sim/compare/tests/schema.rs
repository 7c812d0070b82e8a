//! The schema of configuration files, by a validator that others wrote: it takes every good file, and refuses no file
//! that the reader takes. What only the reader refuses is listed, with the reason.

use jsonschema::Validator;
use recipe_config::file::{Config, Text, parse};
use recipe_config::{FileKind, schema};
use recipe_test_kit::{examples, repository};
use serde_json::json;
use toml::{Table, Value};

/// What a schema cannot know, and why: pieces of a place and of the reader's message.
const BEYOND: &[(&str, &[(&str, &str)])] = &[
    (
        "names of other things in the file",
        &[("recipe", "there is no recipe"), ("follow", "there is no exchange")],
    ),
    (
        "which recipe a port takes, and what the port does with it",
        &[
            ("", "does not fit this port"),
            ("safe_at_start", "has no safe values"),
            ("on_timeout", "does not write"),
        ],
    ),
    (
        "ways of variables",
        &[("", "only the controller's own recipe ports"), ("", "its value would be invented")],
    ),
    (
        "variables and their types, in the keys of a table or behind a word",
        &[
            ("", "a system variable is written"),
            ("on_timeout", "does not fit in a"),
            ("on_timeout", "is not an integer, but"),
            ("on_timeout", "expected a number, found true or false"),
            ("on_timeout", "0..=1"),
            ("initial", "does not fit in a"),
            ("initial", "is not an integer, but"),
            ("initial", "expected a number, found true or false"),
            ("initial", "is out of range; allowed: 0..=1"),
            ("initial", "found a float, false or true"),
        ],
    ),
    (
        "numbers that the type of another key allows",
        &[
            ("equals", "is out of range; allowed: 0..="),
            ("", "does not fit in a"),
            ("", "the field cannot be"),
            ("value", "has a fraction"),
            ("map", "has a fraction"),
            ("map", "is not an integer; the keys of map"),
            ("restarted", "has a fraction"),
            ("max", "has a fraction"),
        ],
    ),
    (
        "the bytes of a frame",
        &[
            ("", "tells where a frame begins"),
            ("", "is another answer as well"),
            ("", "registers have two each"),
            ("", "a frame of"),
            ("", "the frame has no fields"),
            ("", "frame 1 has no fields"),
            ("", "a part needs"),
            ("", "a part on a byte stream needs a head or a tail"),
            ("", "a text at the beginning of a frame"),
            ("", "framing = \"tail\" needs a tail"),
            ("", "the checksum must cover bytes of head and fields"),
        ],
    ),
    (
        "commands and their values",
        &[("commands", "is not an integer; the keys of commands"), ("commands", "unknown command")],
    ),
    (
        "several keys that make sense together only",
        &[
            ("", "it would never be asked"),
            ("", "an exchange needs a request, a reply or both"),
            ("", "there is no reply to wait for"),
            ("follow", "has no reply"),
            ("restarted", "if one of its device has"),
            ("outcome", "no variable"),
            ("", "a recipe needs an input part"),
            ("", "no value to send"),
            ("request", "fields is missing"),
            ("send", "but the recipe has no input part"),
        ],
    ),
    (
        "addresses",
        &[
            ("address", "is not an IP address"),
            ("address", "is neither an IP address nor a host name"),
            ("listen", "not an address to listen on"),
            ("to", "is not HOST or HOST:PORT"),
        ],
    ),
];

struct Schemas {
    gateway: Validator,
    controller: Validator,
}

impl Schemas {
    fn new() -> Self {
        let valid = |kind| jsonschema::draft7::new(&schema(kind)).expect("a schema of draft 7");
        Self { gateway: valid(FileKind::Gateway), controller: valid(FileKind::Controller) }
    }

    fn of(&self, kind: FileKind) -> &Validator {
        if kind == FileKind::Gateway { &self.gateway } else { &self.controller }
    }
}

/// Good files: the examples, the templates, and those that have every key.
fn good_files() -> Vec<(String, String)> {
    let of = |folder: &str| {
        let folder = repository().join(folder);
        recipe_test_kit::names(&folder)
            .into_iter()
            .filter(|name| name.ends_with(".toml"))
            .map(move |name| folder.join(name))
            .collect::<Vec<_>>()
    };
    let mut paths = examples();
    paths.extend(of("host-sim/templates"));
    paths.extend(of("host-sim/config/tests/files/good"));
    let read = |path: std::path::PathBuf| {
        (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read_to_string(&path).unwrap())
    };
    paths.into_iter().map(read).collect()
}

fn to_json(value: &Value) -> serde_json::Value {
    match value {
        Value::String(text) => json!(text),
        Value::Integer(number) => json!(number),
        Value::Float(number) => json!(number),
        Value::Boolean(value) => json!(value),
        Value::Datetime(time) => json!(time.to_string()),
        Value::Array(items) => items.iter().map(to_json).collect(),
        Value::Table(table) => serde_json::Value::Object(
            table.iter().map(|(key, value)| (key.clone(), to_json(value))).collect(),
        ),
    }
}

fn kind_of(name: &str, toml: &str) -> FileKind {
    match parse(Text { name, toml }, &[]) {
        Ok(Config::Gateway(_)) => FileKind::Gateway,
        Ok(Config::Controller(_)) => FileKind::Controller,
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn every_good_file_is_valid() {
    let schemas = Schemas::new();
    let files = good_files();
    assert!(files.len() > 50, "only {} files", files.len());
    for (name, toml) in files {
        let validator = schemas.of(kind_of(&name, &toml));
        let value = to_json(&Value::Table(toml.parse().unwrap()));
        let wrong: Vec<_> = validator
            .iter_errors(&value)
            .map(|error| format!("{}: {error}", error.instance_path()))
            .collect();
        assert!(wrong.is_empty(), "{name}: {wrong:#?}");
    }
}

/// A path to a value: keys, and numbers of items.
type Path = Vec<String>;

/// Every value of a file, and a shape of its place: items of a list count once.
fn places(value: &Value, path: &mut Path, all: &mut Vec<Path>) {
    match value {
        Value::Table(table) => {
            for (key, value) in table {
                path.push(key.clone());
                all.push(path.clone());
                places(value, path, all);
                path.pop();
            }
        }
        Value::Array(items) => {
            for (nth, item) in items.iter().enumerate() {
                path.push(nth.to_string());
                all.push(path.clone());
                places(item, path, all);
                path.pop();
            }
        }
        _ => {}
    }
}

fn at<'v>(value: &'v mut Value, path: &[String]) -> &'v mut Value {
    path.iter().fold(value, |value, key| match value {
        Value::Table(table) => table.get_mut(key).unwrap(),
        Value::Array(items) => &mut items[key.parse::<usize>().unwrap()],
        _ => panic!("no value at {path:?}"),
    })
}

/// Every single mistake at a place: what it is, and the file with it.
fn mistakes(file: &Value, path: &Path) -> Vec<(String, Value)> {
    let (last, parent) = path.split_last().unwrap();
    let mut all = Vec::new();
    let old = at(&mut file.clone(), path).clone();
    let mut with = |what: &str, change: &dyn Fn(&mut Value)| {
        let mut file = file.clone();
        change(at(&mut file, parent));
        all.push((format!("{}: {what}", path.join(".")), file));
    };
    let put = |new: Value| {
        move |around: &mut Value| match around {
            Value::Table(table) => {
                table.insert(last.clone(), new.clone());
            }
            Value::Array(items) => items[last.parse::<usize>().unwrap()] = new.clone(),
            _ => {}
        }
    };
    with("dropped", &|around| match around {
        Value::Table(table) => {
            table.remove(last);
        }
        Value::Array(items) => {
            items.remove(last.parse().unwrap());
        }
        _ => {}
    });
    with("renamed", &|around| {
        if let Value::Table(table) = around {
            let value = table.remove(last).unwrap();
            table.insert(format!("{last}x"), value);
        }
    });
    let others = [
        Value::String("?".into()),
        Value::Integer(-1),
        Value::Integer(99_999_999_999),
        Value::Float(0.5),
        Value::Boolean(true),
        Value::Array(vec![]),
        Value::Table(Table::new()),
    ];
    for other in others {
        if other != old {
            with(&format!("{other:?}"), &put(other.clone()));
        }
    }
    all
}

#[test]
fn the_schema_refuses_nothing_that_the_reader_takes_and_the_reader_little_that_the_schema_takes() {
    let schemas = Schemas::new();
    let mut seen = std::collections::HashSet::new();
    let (mut tried, mut both, mut reader_only) = (0, 0, 0);
    let (mut too_strict, mut not_listed) = (Vec::new(), Vec::new());
    let mut used = std::collections::HashSet::new();
    for (name, toml) in good_files() {
        let kind = kind_of(&name, &toml);
        let file = Value::Table(toml.parse().unwrap());
        let mut paths = Vec::new();
        places(&file, &mut Vec::new(), &mut paths);
        for path in paths {
            // The same keys around the same place: once is enough.
            let around = at(&mut file.clone(), &path[..path.len() - 1]).clone();
            let keys: Vec<String> = around.as_table().map_or(vec![], |table| table.keys().cloned().collect());
            let words: Vec<_> = ["bus", "kind", "mode", "type", "function", "table"]
                .iter()
                .filter_map(|key| Some(around.as_table()?.get(*key)?.to_string()))
                .collect();
            let shape: Vec<_> = path.iter().filter(|key| key.parse::<usize>().is_err()).cloned().collect();
            if !seen.insert((kind == FileKind::Gateway, shape, keys, words)) {
                continue;
            }
            for (what, wrong) in mistakes(&file, &path) {
                let Value::Table(table) = &wrong else { unreachable!() };
                let text = toml::to_string(table).unwrap();
                let read = parse(Text { name: &name, toml: &text }, &[]);
                let is_valid = schemas.of(kind).is_valid(&to_json(&wrong));
                tried += 1;
                match (read, is_valid) {
                    (Ok(_), true) => {}
                    (Err(_), false) => both += 1,
                    (Ok(_), false) => {
                        let value = to_json(&wrong);
                        let errors: Vec<_> = schemas
                            .of(kind)
                            .iter_errors(&value)
                            .map(|error| format!("{}: {error}", error.instance_path()))
                            .collect();
                        too_strict.push(format!("{name}: {what}: {}", errors.join("; ")));
                    }
                    (Err(error), true) => {
                        reader_only += 1;
                        let is_listed = |listed: &&(&str, &str)| {
                            error.key.contains(listed.0) && error.message.contains(listed.1)
                        };
                        match BEYOND.iter().flat_map(|(_, listed)| *listed).find(is_listed) {
                            Some(listed) => {
                                used.insert(*listed);
                            }
                            None => not_listed.push(format!("{what}: {error}")),
                        }
                    }
                }
            }
        }
    }
    println!("{tried} mistakes: both refuse {both}, only the reader {reader_only}");
    assert!(too_strict.is_empty(), "{} too strict:\n{}", too_strict.len(), too_strict.join("\n"));
    assert!(not_listed.is_empty(), "{} not listed:\n{}", not_listed.len(), not_listed.join("\n"));
    let all = BEYOND.iter().flat_map(|(_, listed)| *listed);
    let idle: Vec<_> = all.filter(|listed| !used.contains(*listed)).collect();
    assert!(idle.is_empty(), "listed, but never needed: {idle:#?}");
    assert!(both > 10 * reader_only, "{tried} mistakes: both refuse {both}, only the reader {reader_only}");
}
