//! The JSON Schema of a file, for editors and linters.
//!
//! In: the tables of [`keys`](crate::keys). Out: a schema of draft 7 that accepts every file that the reader accepts.
//! It has no `null`, which TOML does not have. A key of another case is `false`, so that an editor points at it. Does
//! not know what depends on names, sizes or other parts of the file.

use serde_json::{Map, Value, json};

use crate::keys::{Case, Key, KeyTable, Limits, Need, Rule, Shape, TextKind, When, plain, top};
use proto_core::sysvar::SysVar;

/// Which of the two kinds of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    /// For the gateway.
    Gateway,
    /// For the simulated controller.
    Controller,
}

/// The schema of a kind of file: JSON Schema, draft 7.
pub fn schema(kind: FileKind) -> Value {
    let (table, title) = match kind {
        FileKind::Gateway => (&top::GATEWAY, "Gateway file of host-sim"),
        FileKind::Controller => (&top::CONTROLLER, "Controller file of host-sim"),
    };
    let mut made = Schema::default();
    let mut root = made.object(table);
    root.insert("$schema".into(), json!("http://json-schema.org/draft-07/schema#"));
    root.insert("title".into(), json!(title));
    root.insert("definitions".into(), Value::Object(made.definitions));
    Value::Object(root)
}

#[derive(Default)]
struct Schema {
    definitions: Map<String, Value>,
}

impl Schema {
    fn shape(&mut self, shape: &Shape) -> Value {
        match shape {
            Shape::Text(text) => of_text(*text),
            Shape::Words(words) => json!({ "type": "string", "enum": words() }),
            Shape::Integer(low, high) => json!({ "type": "integer", "minimum": low, "maximum": high }),
            Shape::Codes(codes) => json!({ "type": "integer", "enum": codes }),
            Shape::Number(Limits::Any) => json!({ "type": "number" }),
            Shape::Number(Limits::Within(low, high)) => {
                json!({ "type": "number", "minimum": number(*low), "maximum": number(*high) })
            }
            Shape::Number(Limits::AboveZero(high)) => {
                json!({ "type": "number", "exclusiveMinimum": 0, "maximum": number(*high) })
            }
            Shape::Bool => json!({ "type": "boolean" }),
            Shape::Bytes(least, most) => list(self.shape(&Shape::Integer(0, 255)), *least, *most),
            Shape::List(item, least, most) => {
                let item = self.shape(item);
                list(item, *least, *most)
            }
            Shape::Table(table) => self.defined(table),
            Shape::Map(value, least) => {
                let value = self.shape(value);
                let mut map = json!({ "type": "object", "additionalProperties": value });
                if *least > 0 {
                    map["minProperties"] = json!(least);
                }
                map
            }
            Shape::Either(shapes) => {
                let shapes: Vec<_> = shapes.iter().map(|shape| self.shape(shape)).collect();
                json!({ "anyOf": shapes })
            }
        }
    }

    /// The definition of a table by its name, which is made once.
    fn defined(&mut self, table: &KeyTable) -> Value {
        let name = table.name.replace(' ', "-");
        if !self.definitions.contains_key(&name) {
            let object = self.object(table);
            self.definitions.insert(name.clone(), Value::Object(object));
        }
        json!({ "$ref": format!("#/definitions/{name}") })
    }

    fn key(&mut self, key: &Key) -> Value {
        let mut value = self.shape(&key.shape);
        // Keywords beside a reference are ignored.
        if value.get("$ref").is_some() {
            return value;
        }
        value["description"] = json!(describe(key));
        match key.need {
            Need::Integer(default) => value["default"] = json!(default),
            Need::Word(default) => value["default"] = json!(default),
            Need::Bool(default) => value["default"] = json!(default),
            Need::Required | Need::Absent(_) => {}
        }
        value
    }

    fn object(&mut self, table: &KeyTable) -> Map<String, Value> {
        let mut object = Map::new();
        object.insert("type".into(), json!("object"));
        object.insert("additionalProperties".into(), json!(false));
        // Lists all keys, which an editor offers; the keys of other cases are refused below.
        let mut properties = Map::new();
        for key in table.keys() {
            let value = self.key(key);
            match properties.get_mut(key.name) {
                None => {
                    properties.insert(key.name.into(), value);
                }
                Some(before) if *before == value => {}
                Some(before) => {
                    *before = either(before, &value);
                    before["description"] = json!(describe(key));
                }
            }
        }
        // A common key is valid in all cases, which may only narrow it.
        for key in table.common {
            properties.insert(key.name.into(), self.key(key));
        }
        require(&mut object, table.common.iter());
        depend(&mut object, table.common.iter());
        let mut all: Vec<Value> = table.rules.iter().map(rule).collect();
        if let Some(cases) = self.cases(table, table.cases, &properties) {
            all.push(cases);
        }
        object.insert("properties".into(), Value::Object(properties));
        if !all.is_empty() {
            object.insert("allOf".into(), Value::Array(all));
        }
        object
    }

    /// The cases, each in the `else` of the previous one.
    fn cases(&mut self, table: &KeyTable, cases: &[Case], all: &Map<String, Value>) -> Option<Value> {
        let (case, rest) = cases.split_first()?;
        let mut own = Map::new();
        for key in case.keys() {
            let value = self.key(key);
            if all.get(key.name) != Some(&value) {
                own.insert(key.name.into(), value);
            }
        }
        let is_here = |name: &str| table.common.iter().chain(case.keys()).any(|key| key.name == name);
        for name in all.keys().filter(|name| !is_here(name)) {
            own.insert(name.clone(), json!(false));
        }
        let mut then = Map::new();
        if !own.is_empty() {
            then.insert("properties".into(), Value::Object(own));
        }
        require(&mut then, case.keys());
        depend(&mut then, case.keys());
        let then = Value::Object(then);
        if case.when.is_empty() {
            return Some(then);
        }
        let mut value = json!({ "if": condition(case.when), "then": then });
        if let Some(rest) = self.cases(table, rest, all) {
            value["else"] = rest;
        }
        Some(value)
    }
}

/// What two cases of a key have in common, as far as an editor needs it.
fn either(one: &Value, other: &Value) -> Value {
    let kind = |value: &Value| match value.get("$ref") {
        Some(_) => json!("object"),
        None => value.get("type").cloned().unwrap_or(Value::Null),
    };
    match (kind(one), kind(other)) {
        (kind, same) if kind != same || kind.is_null() => json!({}),
        (kind, _) if kind == "object" => json!({ "type": kind, "additionalProperties": true }),
        (kind, _) if kind == "array" => {
            let item = |list: &Value| list.get("items").cloned().unwrap_or(json!({}));
            json!({ "type": kind, "items": either(&item(one), &item(other)) })
        }
        (kind, _) => json!({ "type": kind }),
    }
}

fn condition(when: &[When]) -> Value {
    let mut all: Vec<_> = when
        .iter()
        .map(|when| match when {
            When::Is(key, words, codes) => {
                let words: Vec<Value> = words
                    .iter()
                    .map(|word| json!(word))
                    .chain(codes.iter().map(|code| json!(code)))
                    .collect();
                json!({ "properties": { *key: { "enum": words } }, "required": [key] })
            }
            When::Has(keys) => any_of(keys),
        })
        .collect();
    if all.len() == 1 { all.remove(0) } else { json!({ "allOf": all }) }
}

fn any_of(keys: &[&str]) -> Value {
    match keys {
        [key] => json!({ "required": [key] }),
        _ => json!({ "anyOf": keys.iter().map(|key| json!({ "required": [key] })).collect::<Vec<_>>() }),
    }
}

fn rule(rule: &Rule) -> Value {
    match rule {
        Rule::Only(key, other, words) => json!({
            "if": { "required": [key] },
            "then": { "properties": { *other: { "enum": words } } },
        }),
        Rule::Needs(key, words, others) => json!({
            "if": { "properties": { *key: { "enum": words } }, "required": [key] },
            "then": any_of(others),
        }),
        Rule::NotBoth(one, other) => json!({ "not": { "required": [one, other] } }),
    }
}

fn require<'k>(object: &mut Map<String, Value>, keys: impl Iterator<Item = &'k Key>) {
    let required: Vec<_> =
        keys.filter(|key| matches!(key.need, Need::Required)).map(|key| json!(key.name)).collect();
    if !required.is_empty() {
        object.insert("required".into(), Value::Array(required));
    }
}

fn depend<'k>(object: &mut Map<String, Value>, keys: impl Iterator<Item = &'k Key>) {
    let mut needed = Map::new();
    for key in keys.filter(|key| !key.beside.is_empty()) {
        let beside = match key.beside {
            [one] => json!([one]),
            several => any_of(several),
        };
        needed.insert(key.name.into(), beside);
    }
    if !needed.is_empty() {
        object.insert("dependencies".into(), Value::Object(needed));
    }
}

/// The meaning of a key, with its unit.
fn describe(key: &Key) -> String {
    let text = plain(key.text);
    match (key.unit, text.as_str()) {
        ("", _) => text,
        (unit, "") => unit.to_owned(),
        (unit, _) => format!("{text} [{unit}]"),
    }
}

fn of_text(text: TextKind) -> Value {
    let pattern = |pattern: &str| json!({ "type": "string", "pattern": pattern });
    let mut groups: Vec<&str> = Vec::new();
    for var in SysVar::all() {
        if groups.last() != Some(&var.group()) {
            groups.push(var.group());
        }
    }
    groups.sort_unstable();
    groups.dedup();
    let groups = groups.join("|");
    let var = format!("({groups})\\[[0-9]+\\]|__({groups})_[0-9]+");
    match text {
        TextKind::Any => json!({ "type": "string" }),
        TextKind::Length(least, usize::MAX) => json!({ "type": "string", "minLength": least }),
        // The length is in bytes, and a character can have several bytes; the reader counts them.
        TextKind::Length(least, most) => json!({ "type": "string", "minLength": least, "maxLength": most }),
        TextKind::Name => {
            json!({ "type": "string", "minLength": 1, "maxLength": 32, "pattern": "^[^ \"=\\t\\r\\n]+$" })
        }
        TextKind::Variable => pattern(&format!("^({var})$")),
        TextKind::VariableOrBit => pattern(&format!("^({var})(\\.[0-9]+)?$")),
        TextKind::Variables => pattern(&format!("^({var}|({groups})\\[[0-9]+\\.\\.[0-9]+\\])$")),
        TextKind::Source => pattern(&format!(
            "^(({var})(\\.[0-9]+)?|counter|reply|controller\\..+|port\\..+|link\\..+\\.up)$"
        )),
        TextKind::Pattern(own) => pattern(own),
    }
}

fn list(item: Value, least: usize, most: usize) -> Value {
    let mut list = json!({ "type": "array", "items": item });
    if least > 0 {
        list["minItems"] = json!(least);
    }
    if most < usize::MAX {
        list["maxItems"] = json!(most);
    }
    list
}

/// A number, without a fraction if it is whole.
fn number(value: f64) -> Value {
    if value.fract() == 0.0 { json!(value as i64) } else { json!(value) }
}
