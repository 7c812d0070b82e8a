//! A TOML text and its overrides as one tree, with the place of everything in it.
//!
//! In: text, and `KEY=VALUE` overrides. Out: tables in file order. Does not know the keys of any file.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::error::{FileError, Source};
use super::names::did_you_mean;

/// The tree, and the texts that it was read from.
pub(super) struct SourceTree {
    name: String,
    text: String,
    overrides: Vec<String>,
    pub(super) root: TreeTable,
}

/// The place where something was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum At {
    /// Byte offset in the file.
    File(usize),
    /// Index of the override.
    Override(usize),
}

/// A value with its place.
#[derive(Debug, Clone)]
pub(super) struct TreeNode {
    pub(super) at: At,
    pub(super) value: TreeValue,
}

#[derive(Debug, Clone)]
pub(super) enum TreeValue {
    Str(String),
    /// A 64-bit integer of TOML, or the text of an integer that does not fit.
    Int(Result<i64, String>),
    Float(f64),
    Bool(bool),
    Datetime,
    Array(Vec<TreeNode>),
    Table(TreeTable),
}

impl TreeValue {
    /// The name of the kind with its article, for messages.
    pub(super) fn kind(&self) -> &'static str {
        match self {
            Self::Str(_) => "a string",
            Self::Int(_) => "an integer",
            Self::Float(_) => "a float",
            Self::Bool(_) => "true or false",
            Self::Datetime => "a date",
            Self::Array(_) => "an array",
            Self::Table(_) => "a table",
        }
    }
}

/// Entries in file order.
#[derive(Debug, Clone, Default)]
pub(super) struct TreeTable {
    pub(super) entries: Vec<TreeEntry>,
}

#[derive(Debug, Clone)]
pub(super) struct TreeEntry {
    pub(super) key: String,
    pub(super) at: At,
    pub(super) node: TreeNode,
}

impl TreeTable {
    pub(super) fn get(&self, key: &str) -> Option<&TreeEntry> {
        self.entries.iter().find(|entry| entry.key == key)
    }
}

impl SourceTree {
    /// Reads `text`, called `name` in messages, and applies the overrides.
    pub(super) fn parse(name: &str, text: &str, overrides: &[String]) -> Result<Self, FileError> {
        let mut document = Self {
            name: name.to_owned(),
            text: text.to_owned(),
            overrides: overrides.to_vec(),
            root: TreeTable::default(),
        };
        match DeTable::parse(text) {
            Ok(table) => document.root = convert_table(table.get_ref(), &At::File),
            Err(error) => {
                let place = error.span().map(|span| span.start);
                let hint = hexadecimal(text, place);
                let message = format!("invalid TOML: {}{hint}", one_line(error.message()));
                return Err(document.error(At::File(place.unwrap_or(0)), "", message));
            }
        }
        for (number, text) in overrides.iter().enumerate() {
            document.put(number, text)?;
        }
        Ok(document)
    }

    pub(super) fn error(&self, at: At, key: &str, message: impl Into<String>) -> FileError {
        let source = match at {
            At::File(offset) => {
                let before = self.text.get(..offset).unwrap_or(&self.text);
                let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
                Source::File {
                    file: self.name.clone(),
                    line: before.matches('\n').count() + 1,
                    column: before[line_start..].chars().count() + 1,
                }
            }
            At::Override(number) => Source::Override { text: self.overrides[number].clone() },
        };
        FileError { source, key: key.to_owned(), message: message.into() }
    }

    pub(super) fn whole_file_error(&self, message: impl Into<String>) -> FileError {
        let source = Source::WholeFile { file: self.name.clone() };
        FileError { source, key: String::new(), message: message.into() }
    }

    /// The place of the value at `path`, or of the nearest table around it.
    pub(super) fn find(&self, path: &[&str]) -> Option<At> {
        let (first, mut rest) = path.split_first()?;
        let mut node = &self.root.get(first)?.node;
        while let Some((key, after)) = rest.split_first() {
            let next = match &node.value {
                TreeValue::Table(table) => table.get(key).map(|entry| &entry.node),
                TreeValue::Array(items) => {
                    let named = items.iter().find(|item| name_of(item).is_some_and(|name| name == *key));
                    let number = || key.parse::<usize>().ok()?.checked_sub(1);
                    named.or_else(|| items.get(number()?))
                }
                _ => None,
            };
            match next {
                Some(next) => (node, rest) = (next, after),
                None => break,
            }
        }
        Some(node.at)
    }

    /// Applies one `KEY=VALUE` to the tree.
    fn put(&mut self, number: usize, text: &str) -> Result<(), FileError> {
        let at = At::Override(number);
        let Some((key, value)) = text.split_once('=') else {
            return Err(self.error(at, "", "no '='; write KEY=VALUE, such as port.rs485-1.baud=9600"));
        };
        let path = match split_path(key.trim()) {
            Some(path) => path,
            None => return Err(self.error(at, key, "not a key; write names separated by dots")),
        };
        let node = match parse_value(value.trim(), at) {
            Ok(node) => node,
            Err(message) => return Err(self.error(at, key, message)),
        };
        let mut root = std::mem::take(&mut self.root);
        let done = insert(&mut root, &path, node, at);
        self.root = root;
        done.map_err(|message| self.error(at, key, message))
    }
}

fn convert_table(table: &DeTable<'_>, at: &dyn Fn(usize) -> At) -> TreeTable {
    let mut entries: Vec<_> = table.iter().collect();
    entries.sort_by_key(|(key, _)| key.span().start);
    let entry = |(key, node): (&Spanned<_>, &Spanned<DeValue<'_>>)| {
        let name: &std::borrow::Cow<'_, str> = key.get_ref();
        TreeEntry { key: name.to_string(), at: at(key.span().start), node: convert(node, at) }
    };
    TreeTable { entries: entries.into_iter().map(entry).collect() }
}

fn convert(node: &Spanned<DeValue<'_>>, at: &dyn Fn(usize) -> At) -> TreeNode {
    let value = match node.get_ref() {
        DeValue::String(text) => TreeValue::Str(text.to_string()),
        DeValue::Integer(number) => TreeValue::Int(
            i64::from_str_radix(number.as_str(), number.radix()).map_err(|_| number.to_string()),
        ),
        // TOML's floats are Rust's, except for underscores, which the parser has removed.
        DeValue::Float(number) => TreeValue::Float(number.as_str().parse().unwrap_or(f64::NAN)),
        DeValue::Boolean(value) => TreeValue::Bool(*value),
        DeValue::Datetime(_) => TreeValue::Datetime,
        DeValue::Array(items) => TreeValue::Array(items.iter().map(|item| convert(item, at)).collect()),
        DeValue::Table(table) => TreeValue::Table(convert_table(table, at)),
    };
    TreeNode { at: at(node.span().start), value }
}

/// The value of an override: TOML if it looks like TOML, else the text itself. `controller.address=10.0.0.2` thus needs
/// no quotes, which a shell would remove.
fn parse_value(text: &str, at: At) -> Result<TreeNode, String> {
    match DeValue::parse(text) {
        Ok(value) => Ok(convert(&value, &|_| at)),
        Err(error) if text.starts_with(['[', '{', '"', '\'']) => {
            let hint = hexadecimal(text, error.span().map(|span| span.start));
            Err(format!("invalid TOML value: {}{hint}", one_line(error.message())))
        }
        Err(_) => Ok(TreeNode { at, value: TreeValue::Str(text.to_owned()) }),
    }
}

/// A hint for a list in which a hexadecimal byte lacks its `0x`, such as `[48, AA]`; otherwise empty.
fn hexadecimal(text: &str, place: Option<usize>) -> String {
    let Some((before, after)) = place.and_then(|place| text.split_at_checked(place)) else {
        return String::new();
    };
    let word = after.split(|c: char| !c.is_ascii_alphanumeric()).next().unwrap_or_default();
    let is_item =
        before.trim_end().ends_with(['[', ',']) && after[word.len()..].trim_start().starts_with([']', ',']);
    match word.len() {
        1 | 2 if is_item && word.chars().all(|c| c.is_ascii_hexdigit()) => {
            format!("; a hexadecimal byte is written 0x{}", word.to_ascii_uppercase())
        }
        _ => String::new(),
    }
}

/// Names separated by dots; a name that contains dots is in double quotes.
fn split_path(key: &str) -> Option<Vec<String>> {
    let mut path = vec![String::new()];
    // The dots of `RobotState[8..13]` and `BitInputReg[3].4` are part of the name.
    let (mut quoted, mut bracket) = (false, false);
    let mut chars = key.chars().peekable();
    while let Some(c) = chars.next() {
        let is_bit = || path.last().is_some_and(|name| name.ends_with(']'));
        match c {
            '"' => quoted = !quoted,
            '.' if !quoted && is_bit() && chars.peek().is_some_and(char::is_ascii_digit) => {
                path.last_mut()?.push(c);
            }
            '.' if !quoted && !bracket => path.push(String::new()),
            _ => {
                bracket = if quoted { bracket } else { c == '[' || (bracket && c != ']') };
                path.last_mut()?.push(c);
            }
        }
    }
    (!quoted && path.iter().all(|name| !name.is_empty())).then_some(path)
}

fn insert(table: &mut TreeTable, path: &[String], node: TreeNode, at: At) -> Result<(), String> {
    let Some((key, rest)) = path.split_first() else { return Ok(()) };
    let place = match table.entries.iter().position(|entry| entry.key == *key) {
        Some(place) => place,
        None => {
            let value =
                if rest.is_empty() { node.value.clone() } else { TreeValue::Table(TreeTable::default()) };
            table.entries.push(TreeEntry { key: key.clone(), at, node: TreeNode { at, value } });
            table.entries.len() - 1
        }
    };
    let entry = &mut table.entries[place];
    if rest.is_empty() {
        *entry = TreeEntry { key: key.clone(), at, node };
        return Ok(());
    }
    match &mut entry.node.value {
        TreeValue::Table(inner) => insert(inner, rest, node, at),
        TreeValue::Array(items) => insert_into_item(key, items, rest, node, at),
        other => Err(format!("{key} is {} and has no keys", other.kind())),
    }
}

/// Items of an array of tables are selected by their `name`, or by their number, counted from 1.
fn insert_into_item(
    key: &str,
    items: &mut [TreeNode],
    path: &[String],
    node: TreeNode,
    at: At,
) -> Result<(), String> {
    let Some((wanted, rest)) = path.split_first() else { return Ok(()) };
    let names: Vec<_> = items.iter().map(|item| name_of(item).map(str::to_owned)).collect();
    let by_number = || wanted.parse::<usize>().ok().filter(|number| (1..=items.len()).contains(number));
    let place = names
        .iter()
        .position(|name| name.as_ref() == Some(wanted))
        .or_else(|| by_number().map(|number| number - 1));
    let Some(place) = place else {
        let meant = did_you_mean(wanted, names.iter().flatten().map(String::as_str));
        let names: Vec<_> = names.into_iter().flatten().map(|name| format!("{name:?}")).collect();
        return Err(match names.len() {
            0 => format!("there is no {key} {wanted:?}; write its number, 1..={}", items.len()),
            _ => format!("there is no {key} {wanted:?}; there are {}{meant}", names.join(", ")),
        });
    };
    match (&mut items[place], rest) {
        (item, []) => {
            *item = node;
            Ok(())
        }
        (TreeNode { value: TreeValue::Table(table), .. }, rest) => insert(table, rest, node, at),
        (TreeNode { value, .. }, _) => Err(format!("{key} {wanted} is {} and has no keys", value.kind())),
    }
}

fn name_of(item: &TreeNode) -> Option<&str> {
    match &item.value {
        TreeValue::Table(table) => match &table.get("name")?.node.value {
            TreeValue::Str(name) => Some(name),
            _ => None,
        },
        _ => None,
    }
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}
