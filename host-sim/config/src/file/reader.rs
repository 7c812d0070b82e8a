//! Typed access to a [`SourceTree`]. Every error has its place and the whole key.

use std::ops::RangeInclusive;

use super::document::{At, SourceTree, TreeNode, TreeTable, TreeValue};
use super::error::FileError;
use super::names::{did_you_mean, meant_key};
use crate::keys::{self, Key, Need};
use proto_core::time::Duration;

pub(super) type Result<T> = std::result::Result<T, FileError>;

/// A place in a file or an override, and the key there.
#[derive(Debug, Clone)]
pub(super) struct Spot {
    pub(super) at: At,
    pub(super) key: String,
}

impl Spot {
    pub(super) fn error(&self, document: &SourceTree, message: impl ToString) -> FileError {
        document.error(self.at, &self.key, message.to_string())
    }
}

/// A table whose keys have been checked against those allowed.
#[derive(Clone)]
pub(super) struct TableReader<'a> {
    pub(super) document: &'a SourceTree,
    /// The table itself.
    pub(super) spot: Spot,
    table: &'a TreeTable,
}

/// One value.
#[derive(Clone)]
pub(super) struct TableValue<'a> {
    document: &'a SourceTree,
    pub(super) spot: Spot,
    node: &'a TreeNode,
}

impl<'a> TableReader<'a> {
    pub(super) fn root(document: &'a SourceTree, table: &keys::KeyTable) -> Result<Self> {
        let spot = Spot { at: At::File(0), key: String::new() };
        let reader = Self { document, spot, table: &document.root };
        reader.check(table)?;
        Ok(reader)
    }

    /// Refuses a key that the table does not have, or that does not belong to the selected case of the table.
    pub(super) fn check(&self, table: &keys::KeyTable) -> Result<()> {
        let by = table.by().and_then(|by| Some((by, self.optional(by)?.as_string()?)));
        match by {
            Some((by, word)) if is_word(table, by, word) => {
                let on = if by == "bus" { "on" } else { "with" };
                let names = keys::names(table.keys_with(by, word));
                self.check_names(&names, &format!(" {on} {by} = {word:?}"), |key| {
                    table.keys().any(|known| known.name == key)
                })
            }
            _ => self.check_names(&keys::names(table.keys()), table.place, |_| false),
        }
    }

    /// Refuses a key that is not in these lists; `when` says what the lists depend on.
    pub(super) fn check_keys(&self, allowed: &[&[Key]], when: &str) -> Result<()> {
        let names = keys::names(allowed.iter().copied().flatten());
        self.check_names(&names, when, |_| false)
    }

    /// Refuses a key that is not one of the names, and suggests the nearest name. For a key for which `is_known` is
    /// true, it suggests none.
    pub(super) fn check_names(
        &self,
        allowed: &[&str],
        when: &str,
        is_known: impl Fn(&str) -> bool,
    ) -> Result<()> {
        let unknown = self.table.entries.iter().find(|entry| !allowed.contains(&entry.key.as_str()));
        let Some(entry) = unknown else { return Ok(()) };
        let spot = Spot { at: entry.at, key: self.path(&entry.key) };
        let meant = match is_known(&entry.key) {
            true => String::new(),
            false => meant_key(&entry.key, allowed),
        };
        let message = format!("unknown key{when}; allowed: {}{meant}", allowed.join(", "));
        Err(spot.error(self.document, message))
    }

    /// An error that concerns the whole table.
    pub(super) fn error(&self, message: impl ToString) -> FileError {
        self.spot.error(self.document, message)
    }

    pub(super) fn optional(&self, key: &str) -> Option<TableValue<'a>> {
        let entry = self.table.get(key)?;
        // An array of tables has no place of its own, only its values have.
        let spot = Spot { at: entry.node.at, key: self.path(key) };
        Some(TableValue { document: self.document, spot, node: &entry.node })
    }

    /// The value of `key`, which must be present; `what` describes it.
    pub(super) fn required(&self, key: &str, what: &str) -> Result<TableValue<'a>> {
        self.optional(key).ok_or_else(|| self.error(format!("{key} is missing; {what}")))
    }

    /// Every entry, in file order, with the place of its key.
    pub(super) fn entries(&self) -> impl Iterator<Item = (&'a str, Spot, TableValue<'a>)> {
        self.table.entries.iter().map(|entry| {
            let key = self.path(&entry.key);
            let spot = Spot { at: entry.node.at, key: key.clone() };
            let item = TableValue { document: self.document, spot, node: &entry.node };
            (entry.key.as_str(), Spot { at: entry.at, key }, item)
        })
    }

    /// The tables of the array `key`, with any keys, each with its name or number.
    pub(super) fn any_tables(&self, key: &str) -> Result<Vec<TableReader<'a>>> {
        let Some(item) = self.optional(key) else { return Ok(Vec::new()) };
        let items = item.array(&format!("of tables, written [[{key}]]"))?;
        items.iter().map(|item| item.named_table(key, &self.spot.key)).collect()
    }

    /// An integer in the range of its key; `None` if it is absent.
    pub(super) fn integer<T: TryFrom<i64>>(&self, key: &Key) -> Result<Option<T>> {
        self.optional(key.name).map(|item| item.integer(key.integers())).transpose()
    }

    /// An integer in the range of its key, or the key's default.
    pub(super) fn integer_or<T: TryFrom<i64>>(&self, key: &Key) -> Result<T> {
        match (self.integer(key)?, key.need) {
            (Some(value), _) => Ok(value),
            (None, Need::Integer(value)) => {
                T::try_from(value).map_err(|_| self.error(format!("{} is missing", key.name)))
            }
            (None, _) => Err(self.error(format!("{} is missing", key.name))),
        }
    }

    /// An integer that must be present; `what` describes it.
    pub(super) fn integer_needed<T: TryFrom<i64>>(&self, key: &Key, what: &str) -> Result<T> {
        self.required(key.name, what)?.integer(key.integers())
    }

    /// `true` or `false`; the key's default if it is absent.
    pub(super) fn flag(&self, key: &Key) -> Result<bool> {
        match self.optional(key.name) {
            Some(item) => item.bool(),
            None => Ok(matches!(key.need, Need::Bool(true))),
        }
    }

    /// A time within the limits of its key.
    pub(super) fn time(&self, key: &Key) -> Result<Option<Duration>> {
        self.optional(key.name).map(|item| item.time(key)).transpose()
    }

    /// A time within the limits of its key, or the key's default.
    pub(super) fn time_or(&self, key: &Key) -> Result<Duration> {
        match (self.time(key)?, key.need) {
            (Some(time), _) => Ok(time),
            (None, Need::Integer(value)) => Ok(keys::time(key, value as f64)),
            (None, _) => Err(self.error(format!("{} is missing", key.name))),
        }
    }

    /// The choice that a key's word selects; `None` if the key is absent.
    pub(super) fn word<T: Clone>(&self, key: &Key, choices: &[(&str, T)]) -> Result<Option<T>> {
        self.optional(key.name).map(|item| item.choice(choices)).transpose()
    }

    /// The choice that a key's word selects, or that of its default.
    pub(super) fn word_or<T: Clone>(&self, key: &Key, choices: &[(&str, T)]) -> Result<T> {
        let default = match key.need {
            Need::Word(word) => choices.iter().find(|(name, _)| *name == word),
            _ => None,
        };
        match (self.word(key, choices)?, default) {
            (Some(value), _) => Ok(value),
            (None, Some((_, value))) => Ok(value.clone()),
            (None, None) => Err(self.error(format!("{} is missing", key.name))),
        }
    }

    fn path(&self, key: &str) -> String {
        join(&self.spot.key, key)
    }
}

impl<'a> TableValue<'a> {
    pub(super) fn error(&self, message: impl ToString) -> FileError {
        self.spot.error(self.document, message)
    }

    /// The same value with another place, such as that of its key.
    pub(super) fn at(self, spot: Spot) -> Self {
        Self { spot, ..self }
    }

    pub(super) fn wrong_kind(&self, wanted: &str) -> FileError {
        self.error(format!("expected {wanted}, found {}", self.node.value.kind()))
    }

    pub(super) fn string(&self) -> Result<&'a str> {
        match &self.node.value {
            TreeValue::Str(text) => Ok(text),
            _ => Err(self.wrong_kind("a string")),
        }
    }

    pub(super) fn as_string(&self) -> Option<&'a str> {
        match &self.node.value {
            TreeValue::Str(text) => Some(text),
            _ => None,
        }
    }

    pub(super) fn bool(&self) -> Result<bool> {
        match self.node.value {
            TreeValue::Bool(value) => Ok(value),
            _ => Err(self.wrong_kind("true or false")),
        }
    }

    pub(super) fn as_bool(&self) -> Option<bool> {
        match self.node.value {
            TreeValue::Bool(value) => Some(value),
            _ => None,
        }
    }

    pub(super) fn as_integer(&self) -> Option<i64> {
        match self.node.value {
            TreeValue::Int(Ok(value)) => Some(value),
            _ => None,
        }
    }

    /// A bit, written as 0 or 1, or as false or true.
    pub(super) fn bit(&self) -> Result<bool> {
        match self.as_bool() {
            Some(bit) => Ok(bit),
            None => self.integer::<u8>(0..=1).map(|bit| bit == 1).map_err(|mut error| {
                error.message.push_str(", false or true");
                error
            }),
        }
    }

    pub(super) fn integer<T: TryFrom<i64>>(&self, range: RangeInclusive<i64>) -> Result<T> {
        let refused = |shown: &str| {
            Err(self.error(format!("{shown} is out of range; allowed: {}..={}", range.start(), range.end())))
        };
        match &self.node.value {
            TreeValue::Int(Ok(value)) if range.contains(value) => match T::try_from(*value) {
                Ok(value) => Ok(value),
                Err(_) => refused(&value.to_string()),
            },
            TreeValue::Int(Ok(value)) => refused(&value.to_string()),
            TreeValue::Int(Err(text)) => refused(text),
            _ => Err(self.no_integer(&format!("{}..={}", range.start(), range.end()))),
        }
    }

    /// An error about a value that is not an integer; `allowed` is the range.
    pub(super) fn no_integer(&self, allowed: &str) -> FileError {
        let mut error = self.wrong_kind(&format!("an integer in {allowed}"));
        if let Some(number) = self.as_string().map(str::trim).filter(|text| is_number(text)) {
            error.message += &format!("; write {number} without quotes");
        }
        error
    }

    /// Any finite number.
    pub(super) fn number(&self) -> Result<f64> {
        match &self.node.value {
            TreeValue::Int(Ok(value)) => Ok(*value as f64),
            TreeValue::Int(Err(text)) => Err(self.error(format!("{text} is out of range"))),
            TreeValue::Float(value) if value.is_finite() => Ok(*value),
            TreeValue::Float(value) => Err(self.error(format!("expected a finite number, found {value}"))),
            _ => Err(self.wrong_kind("a number")),
        }
    }

    /// A duration within the limits of its key; fractions are rounded to the microsecond.
    pub(super) fn time(&self, key: &Key) -> Result<Duration> {
        let (value, limits) = (self.number()?, key.limits());
        match keys::time(key, value) {
            time if limits.take(value) && (limits.take(0.0) || time > Duration::ZERO) => Ok(time),
            _ => Err(self.error(format!("{value} is out of range; allowed: {limits} {}", key.unit))),
        }
    }

    pub(super) fn array(&self, hint: &str) -> Result<Vec<TableValue<'a>>> {
        let TreeValue::Array(items) = &self.node.value else {
            return Err(self.wrong_kind(&format!("an array {hint}")));
        };
        Ok(items
            .iter()
            .enumerate()
            .map(|(index, node)| {
                let spot = Spot { at: node.at, key: format!("{}[{}]", self.spot.key, index + 1) };
                TableValue { document: self.document, spot, node }
            })
            .collect())
    }

    pub(super) fn is_integer(&self) -> bool {
        matches!(self.node.value, TreeValue::Int(_))
    }

    pub(super) fn is_table(&self) -> bool {
        matches!(self.node.value, TreeValue::Table(_))
    }

    /// A table with the keys of this kind.
    pub(super) fn table(&self, table: &keys::KeyTable) -> Result<TableReader<'a>> {
        let reader = self.any_table()?;
        reader.check(table)?;
        Ok(reader)
    }

    pub(super) fn any_table(&self) -> Result<TableReader<'a>> {
        match &self.node.value {
            TreeValue::Table(table) => {
                Ok(TableReader { document: self.document, spot: self.spot.clone(), table })
            }
            _ => Err(self.wrong_kind("a table")),
        }
    }

    /// An item of an array of tables, called `KEY.NAME` if it has a name.
    fn named_table(&self, key: &str, parent: &str) -> Result<TableReader<'a>> {
        let TreeValue::Table(table) = &self.node.value else { return Err(self.wrong_kind("a table")) };
        let mut spot = self.spot.clone();
        if let Some(TreeValue::Str(name)) = table.get("name").map(|entry| &entry.node.value) {
            spot.key = join(parent, &format!("{key}.{}", if name.is_empty() { "\"\"" } else { name }));
        }
        Ok(TableReader { document: self.document, spot, table })
    }

    /// The choice that the string selects. The error for an unknown string suggests the nearest one.
    pub(super) fn choice<T: Clone>(&self, choices: &[(&str, T)]) -> Result<T> {
        self.choice_or(choices, |text| did_you_mean(text, choices.iter().map(|(name, _)| *name)))
    }

    /// As [`Self::choice`]; `meant` ends the message about an unknown word.
    pub(super) fn choice_or<T: Clone>(
        &self,
        choices: &[(&str, T)],
        meant: impl FnOnce(&str) -> String,
    ) -> Result<T> {
        let allowed = || choices.iter().map(|(name, _)| format!("{name:?}")).collect::<Vec<_>>().join(", ");
        let Some(text) = self.as_string() else {
            return Err(self.wrong_kind(&format!("one of {}", allowed())));
        };
        match choices.iter().find(|(name, _)| *name == text) {
            Some((_, value)) => Ok(value.clone()),
            None => Err(self.error(format!("{text:?} is unknown; allowed: {}{}", allowed(), meant(text)))),
        }
    }
}

/// Whether a text is a TOML integer.
fn is_number(text: &str) -> bool {
    match text.strip_prefix("0x") {
        Some(hex) => i64::from_str_radix(hex, 16).is_ok(),
        None => text.parse::<i64>().is_ok(),
    }
}

fn is_word(table: &keys::KeyTable, key: &str, word: &str) -> bool {
    let words = table.common.iter().filter(|known| known.name == key).map(|known| known.shape);
    words.into_iter().any(|shape| matches!(shape, keys::Shape::Words(words) if words().contains(&word)))
}

fn join(parent: &str, key: &str) -> String {
    if parent.is_empty() { key.to_owned() } else { format!("{parent}.{key}") }
}
