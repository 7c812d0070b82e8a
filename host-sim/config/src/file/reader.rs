//! Typed access to a [`Document`]: every error has the place and the whole key.

use std::ops::RangeInclusive;

use super::document::{At, Document, Node, Table, Value};
use super::error::FileError;
use super::names::did_you_mean;
use proto_core::time::Duration;

pub(super) type Result<T> = std::result::Result<T, FileError>;

/// A place and the key there.
#[derive(Debug, Clone)]
pub(super) struct Spot {
    pub(super) at: At,
    pub(super) key: String,
}

impl Spot {
    pub(super) fn error(&self, document: &Document, message: impl ToString) -> FileError {
        document.error(self.at, &self.key, message.to_string())
    }
}

/// A table whose keys have been checked against those allowed.
#[derive(Clone)]
pub(super) struct Reader<'a> {
    pub(super) document: &'a Document,
    /// The table itself.
    pub(super) spot: Spot,
    table: &'a Table,
}

/// One value.
#[derive(Clone)]
pub(super) struct Item<'a> {
    document: &'a Document,
    pub(super) spot: Spot,
    node: &'a Node,
}

impl<'a> Reader<'a> {
    pub(super) fn root(document: &'a Document, allowed: &[&str]) -> Result<Self> {
        let spot = Spot { at: At::File(0), key: String::new() };
        let reader = Self { document, spot, table: &document.root };
        reader.check_keys(allowed, "")?;
        Ok(reader)
    }

    /// Refuses a key that is not in `allowed`; `when` says what the list depends on.
    pub(super) fn check_keys(&self, allowed: &[&str], when: &str) -> Result<()> {
        match self.table.entries.iter().find(|entry| !allowed.contains(&entry.key.as_str())) {
            None => Ok(()),
            Some(entry) => {
                let spot = Spot { at: entry.at, key: self.path(&entry.key) };
                let message = format!("unknown key{when}; allowed: {}", allowed.join(", "));
                Err(spot.error(self.document, message))
            }
        }
    }

    /// Same as [`Self::check_keys`]; says as well which of them was probably meant.
    pub(super) fn check_keys_nearly(&self, allowed: &[&str], when: &str) -> Result<()> {
        self.check_keys(allowed, when).map_err(|mut error| {
            let key = error.key.rsplit('.').next().unwrap_or("");
            error.message += &did_you_mean(key, allowed.iter().copied());
            error
        })
    }

    /// An error that concerns the whole table.
    pub(super) fn error(&self, message: impl ToString) -> FileError {
        self.spot.error(self.document, message)
    }

    /// The value of `key`, if it is present.
    pub(super) fn optional(&self, key: &str) -> Option<Item<'a>> {
        let entry = self.table.get(key)?;
        // An array of tables has no place of its own; its values do.
        let spot = Spot { at: entry.node.at, key: self.path(key) };
        Some(Item { document: self.document, spot, node: &entry.node })
    }

    /// The value of `key`, which must be present; `what` says what it should be.
    pub(super) fn required(&self, key: &str, what: &str) -> Result<Item<'a>> {
        self.optional(key).ok_or_else(|| self.error(format!("{key} is missing; {what}")))
    }

    /// Every entry, in file order, with the place of its key.
    pub(super) fn entries(&self) -> impl Iterator<Item = (&'a str, Spot, Item<'a>)> {
        self.table.entries.iter().map(|entry| {
            let key = self.path(&entry.key);
            let spot = Spot { at: entry.node.at, key: key.clone() };
            let item = Item { document: self.document, spot, node: &entry.node };
            (entry.key.as_str(), Spot { at: entry.at, key }, item)
        })
    }

    /// The tables of the array `key`, each with its name or its number.
    pub(super) fn tables(&self, key: &str, allowed: &[&str]) -> Result<Vec<Reader<'a>>> {
        let readers = self.any_tables(key)?;
        readers.iter().try_for_each(|reader| reader.check_keys(allowed, ""))?;
        Ok(readers)
    }

    /// Same as [`Self::tables`], with any keys.
    pub(super) fn any_tables(&self, key: &str) -> Result<Vec<Reader<'a>>> {
        let Some(item) = self.optional(key) else { return Ok(Vec::new()) };
        let items = item.array(&format!("of tables, written [[{key}]]"))?;
        items.iter().map(|item| item.named_table(key, &self.spot.key)).collect()
    }

    fn path(&self, key: &str) -> String {
        join(&self.spot.key, key)
    }
}

impl<'a> Item<'a> {
    pub(super) fn error(&self, message: impl ToString) -> FileError {
        self.spot.error(self.document, message)
    }

    /// The same value with another place, such as that of its key.
    pub(super) fn at(self, spot: Spot) -> Self {
        Self { spot, ..self }
    }

    fn wrong_kind(&self, wanted: &str) -> FileError {
        self.error(format!("expected {wanted}, found {}", self.node.value.kind()))
    }

    pub(super) fn string(&self) -> Result<&'a str> {
        match &self.node.value {
            Value::Str(text) => Ok(text),
            _ => Err(self.wrong_kind("a string")),
        }
    }

    /// One of several strings; says as well which of them was probably meant.
    pub(super) fn choice_nearly<T: Clone>(&self, choices: &[(&str, T)]) -> Result<T> {
        self.choice(choices).map_err(|mut error| {
            if let Some(text) = self.as_string() {
                error.message += &did_you_mean(text, choices.iter().map(|(name, _)| *name));
            }
            error
        })
    }

    /// The string, if it is one.
    pub(super) fn as_string(&self) -> Option<&'a str> {
        match &self.node.value {
            Value::Str(text) => Some(text),
            _ => None,
        }
    }

    pub(super) fn bool(&self) -> Result<bool> {
        match self.node.value {
            Value::Bool(value) => Ok(value),
            _ => Err(self.wrong_kind("true or false")),
        }
    }

    /// The value as true or false, if it is a bool.
    pub(super) fn as_bool(&self) -> Option<bool> {
        match self.node.value {
            Value::Bool(value) => Some(value),
            _ => None,
        }
    }

    /// The integer, if it is one.
    pub(super) fn as_integer(&self) -> Option<i64> {
        match self.node.value {
            Value::Int(Ok(value)) => Some(value),
            _ => None,
        }
    }

    /// 0 or 1, false or true.
    pub(super) fn bit(&self) -> Result<bool> {
        match self.as_bool() {
            Some(bit) => Ok(bit),
            None => self.integer::<u8>(0..=1).map(|bit| bit == 1).map_err(|mut error| {
                error.message.push_str(", false or true");
                error
            }),
        }
    }

    /// An integer in `range`.
    pub(super) fn integer<T: TryFrom<i64>>(&self, range: RangeInclusive<i64>) -> Result<T> {
        let refused = |shown: &str| {
            Err(self.error(format!("{shown} is out of range; allowed: {}..={}", range.start(), range.end())))
        };
        match &self.node.value {
            Value::Int(Ok(value)) if range.contains(value) => match T::try_from(*value) {
                Ok(value) => Ok(value),
                Err(_) => refused(&value.to_string()),
            },
            Value::Int(Ok(value)) => refused(&value.to_string()),
            Value::Int(Err(text)) => refused(text),
            _ => Err(self.wrong_kind(&format!("an integer in {}..={}", range.start(), range.end()))),
        }
    }

    /// Any finite number.
    pub(super) fn number(&self) -> Result<f64> {
        match &self.node.value {
            Value::Int(Ok(value)) => Ok(*value as f64),
            Value::Int(Err(text)) => Err(self.error(format!("{text} is out of range"))),
            Value::Float(value) if value.is_finite() => Ok(*value),
            Value::Float(value) => Err(self.error(format!("expected a finite number, found {value}"))),
            _ => Err(self.wrong_kind("a number")),
        }
    }

    /// A span of time in units of `unit_us` µs; fractions are rounded to the microsecond.
    pub(super) fn time(&self, unit_us: f64) -> Result<Duration> {
        let value = self.number()?;
        if value < 0.0 {
            return Err(self.error(format!("{value} is negative; a time cannot be")));
        }
        Ok(Duration::from_micros((value * unit_us).round() as u64))
    }

    pub(super) fn array(&self, hint: &str) -> Result<Vec<Item<'a>>> {
        let Value::Array(items) = &self.node.value else {
            return Err(self.wrong_kind(&format!("an array {hint}")));
        };
        Ok(items
            .iter()
            .enumerate()
            .map(|(index, node)| {
                let spot = Spot { at: node.at, key: format!("{}[{}]", self.spot.key, index + 1) };
                Item { document: self.document, spot, node }
            })
            .collect())
    }

    pub(super) fn is_integer(&self) -> bool {
        matches!(self.node.value, Value::Int(_))
    }

    pub(super) fn is_table(&self) -> bool {
        matches!(self.node.value, Value::Table(_))
    }

    pub(super) fn table(&self, allowed: &[&str]) -> Result<Reader<'a>> {
        let reader = self.any_table()?;
        reader.check_keys(allowed, "")?;
        Ok(reader)
    }

    /// A table with any keys.
    pub(super) fn any_table(&self) -> Result<Reader<'a>> {
        match &self.node.value {
            Value::Table(table) => Ok(Reader { document: self.document, spot: self.spot.clone(), table }),
            _ => Err(self.wrong_kind("a table")),
        }
    }

    /// An item of an array of tables, called `KEY.NAME` if it has a name.
    fn named_table(&self, key: &str, parent: &str) -> Result<Reader<'a>> {
        let Value::Table(table) = &self.node.value else { return Err(self.wrong_kind("a table")) };
        let mut spot = self.spot.clone();
        if let Some(Value::Str(name)) = table.get("name").map(|entry| &entry.node.value) {
            spot.key = join(parent, &format!("{key}.{}", if name.is_empty() { "\"\"" } else { name }));
        }
        Ok(Reader { document: self.document, spot, table })
    }

    /// One of several strings.
    pub(super) fn choice<T: Clone>(&self, choices: &[(&str, T)]) -> Result<T> {
        let allowed = || choices.iter().map(|(name, _)| format!("{name:?}")).collect::<Vec<_>>().join(", ");
        let Some(text) = self.as_string() else {
            return Err(self.wrong_kind(&format!("one of {}", allowed())));
        };
        match choices.iter().find(|(name, _)| *name == text) {
            Some((_, value)) => Ok(value.clone()),
            None => Err(self.error(format!("{text:?} is unknown; allowed: {}", allowed()))),
        }
    }
}

fn join(parent: &str, key: &str) -> String {
    if parent.is_empty() { key.to_owned() } else { format!("{parent}.{key}") }
}
