//! The keys of the files: their types, units, ranges, defaults and meanings, each once.
//!
//! The reader takes from here which keys a table has, the ranges of its numbers, its words and its defaults;
//! [`schema`](fn@crate::schema) and the tables of docs/configuration.md are made from it. What depends on
//! other parts of a file, such as the names of recipes, is the reader's own.

pub mod controller;
pub mod device;
pub mod exchange;
pub mod field;
pub mod frame;
pub mod gateway;
pub mod inventory;
mod markdown;
pub mod recipe;
pub mod sparkplug;

use std::fmt;

use proto_core::config::MAX_TIME;
use proto_core::time::Duration;

pub use markdown::{DOCUMENTED, plain, rows};

/// One key of a table.
#[derive(Debug, Clone, Copy)]
pub struct Key {
    /// As files have it.
    pub name: &'static str,
    /// What it takes.
    pub shape: Shape,
    /// Whether it may be left out, and what is then.
    pub need: Need,
    /// Keys of which one must stand beside it; empty if it may stand alone.
    pub beside: &'static [&'static str],
    /// The unit of its numbers; empty if they have none.
    pub unit: &'static str,
    /// What it means, in the page's Markdown.
    pub text: &'static str,
    /// The text says what is allowed, so nothing has to be put before it.
    pub lists_allowed: bool,
}

/// Whether a key may be left out.
#[derive(Debug, Clone, Copy)]
pub enum Need {
    /// It may not.
    Required,
    /// An integer is taken then.
    Integer(i64),
    /// This word is.
    Word(&'static str),
    /// True or false is.
    Bool(bool),
    /// Something that is no single value: the page's words for it.
    Absent(&'static str),
}

/// The words that a key takes.
pub type Words = fn() -> Vec<&'static str>;

/// What a key takes.
#[derive(Debug, Clone, Copy)]
pub enum Shape {
    /// A string.
    Text(TextKind),
    /// One of several strings.
    Words(Words),
    /// An integer from the first to the last.
    Integer(i64, i64),
    /// One of these integers.
    Codes(&'static [i64]),
    /// A finite number within these limits.
    Number(Limits),
    /// `true` or `false`.
    Bool,
    /// A list of 0 to 255, with at least and at most so many.
    Bytes(usize, usize),
    /// A list, with at least and at most so many items.
    List(&'static Shape, usize, usize),
    /// A table.
    Table(&'static KeyTable),
    /// A table with any keys, with at least so many, and values of this shape.
    Map(&'static Shape, usize),
    /// One of these, which differ in their type.
    Either(&'static [Shape]),
}

/// What a string is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextKind {
    /// Anything.
    Any,
    /// With at least so many and at most so many bytes.
    Length(usize, usize),
    /// A name of a recipe or port.
    Name,
    /// One system variable.
    Variable,
    /// One system variable, or a bit of one.
    VariableOrBit,
    /// A system variable, or a range of them.
    Variables,
    /// What an output field sends.
    Source,
    /// Something else that a pattern of ECMA-262 tells.
    Pattern(&'static str),
}

/// The limits of a number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limits {
    /// None.
    Any,
    /// From the first to the last.
    Within(f64, f64),
    /// More than 0, at most so much.
    AboveZero(f64),
}

impl Limits {
    /// Whether a number is within them.
    pub fn take(self, number: f64) -> bool {
        match self {
            Self::Any => true,
            Self::Within(low, high) => (low..=high).contains(&number),
            Self::AboveZero(high) => number > 0.0 && number <= high,
        }
    }
}

/// As messages and the page have them.
impl fmt::Display for Limits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => f.write_str("any number"),
            Self::Within(low, high) => write!(f, "{low}..={high}"),
            Self::AboveZero(high) => write!(f, "above 0, at most {high}"),
        }
    }
}

/// A table of a file.
#[derive(Debug, Clone, Copy)]
pub struct KeyTable {
    /// Its name in the schema, unique.
    pub name: &'static str,
    /// What a message says behind an unknown key, such as ` of an exchange`.
    pub place: &'static str,
    /// The keys that it always has.
    pub common: &'static [Key],
    /// Further keys. The first case whose condition holds counts.
    pub cases: &'static [Case],
    /// Values of keys that need or exclude another key.
    pub rules: &'static [Rule],
}

/// Keys that a table has in one case.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    /// When it has them.
    pub when: &'static [When],
    /// The keys.
    pub keys: &'static [&'static [Key]],
}

/// A condition.
#[derive(Debug, Clone, Copy)]
pub enum When {
    /// The key has one of these words, or of these codes.
    Is(&'static str, &'static [&'static str], &'static [i64]),
    /// One of the keys is present.
    Has(&'static [&'static str]),
}

/// How one key depends on the word of another.
#[derive(Debug, Clone, Copy)]
pub enum Rule {
    /// The key is allowed only if the other one has one of the words.
    Only(&'static str, &'static str, &'static [&'static str]),
    /// With one of the words, one of the keys is required.
    Needs(&'static str, &'static [&'static str], &'static [&'static str]),
    /// Two keys exclude each other.
    NotBoth(&'static str, &'static str),
}

impl KeyTable {
    /// A table with these keys and no cases.
    pub(crate) const fn of(name: &'static str, common: &'static [Key]) -> Self {
        Self { name, place: "", common, cases: &[], rules: &[] }
    }

    pub(crate) const fn at(self, place: &'static str) -> Self {
        Self { place, ..self }
    }

    pub(crate) const fn cases(self, cases: &'static [Case]) -> Self {
        Self { cases, ..self }
    }

    pub(crate) const fn rules(self, rules: &'static [Rule]) -> Self {
        Self { rules, ..self }
    }

    /// The key that its cases depend on; `None` if they do not depend on a word.
    pub fn by(&self) -> Option<&'static str> {
        self.cases.first()?.when.iter().find_map(|when| match when {
            When::Is(key, ..) => Some(*key),
            When::Has(_) => None,
        })
    }

    /// Its keys where `key` has this word.
    pub fn keys_with(&self, key: &str, word: &str) -> impl Iterator<Item = &'static Key> {
        let holds = move |case: &&Case| {
            case.when.iter().all(|when| match when {
                When::Is(by, words, _) => *by != key || words.contains(&word),
                When::Has(_) => true,
            })
        };
        self.common.iter().chain(self.cases.iter().filter(holds).flat_map(Case::keys))
    }

    /// All its keys, those of all cases. The same name can come several times.
    pub fn keys(&self) -> impl Iterator<Item = &'static Key> {
        let (common, cases) = (self.common, self.cases);
        common.iter().chain(cases.iter().flat_map(Case::keys))
    }
}

impl Case {
    /// Its keys.
    pub fn keys(&self) -> impl Iterator<Item = &'static Key> + use<> {
        self.keys.iter().flat_map(|keys| keys.iter())
    }
}

impl Key {
    pub(crate) const fn new(name: &'static str, shape: Shape) -> Self {
        let need = Need::Absent("none");
        Self { name, shape, need, beside: &[], unit: "", text: "", lists_allowed: false }
    }

    pub(crate) const fn words(name: &'static str, words: Words) -> Self {
        Self::new(name, Shape::Words(words))
    }

    pub(crate) const fn text_of(name: &'static str, text: TextKind) -> Self {
        Self::new(name, Shape::Text(text))
    }

    pub(crate) const fn bool(name: &'static str) -> Self {
        Self::new(name, Shape::Bool).or_bool(false)
    }

    pub(crate) const fn integer(name: &'static str, low: i64, high: i64) -> Self {
        Self::new(name, Shape::Integer(low, high))
    }

    /// A time in ms.
    pub(crate) const fn millis(name: &'static str, limits: Limits) -> Self {
        Self::new(name, Shape::Number(limits)).unit("ms")
    }

    /// The integers that it takes; all if it takes none.
    pub fn integers(&self) -> std::ops::RangeInclusive<i64> {
        let of = |shape: &Shape| match shape {
            Shape::Integer(low, high) => Some(*low..=*high),
            _ => None,
        };
        let found = match self.shape {
            Shape::Either(shapes) => shapes.iter().find_map(of),
            shape => of(&shape),
        };
        found.unwrap_or(i64::MIN..=i64::MAX)
    }

    /// The limits of its numbers.
    pub fn limits(&self) -> Limits {
        let of = |shape: &Shape| match shape {
            Shape::Number(limits) => Some(*limits),
            _ => None,
        };
        let found = match self.shape {
            Shape::Either(shapes) => shapes.iter().find_map(of),
            shape => of(&shape),
        };
        found.unwrap_or(Limits::Any)
    }

    pub(crate) const fn required(self) -> Self {
        Self { need: Need::Required, ..self }
    }

    pub(crate) const fn or(self, value: i64) -> Self {
        Self { need: Need::Integer(value), ..self }
    }

    /// A default of a key in ms.
    pub(crate) const fn or_time(self, time: Duration) -> Self {
        self.or(time.as_millis() as i64)
    }

    pub(crate) const fn or_word(self, word: &'static str) -> Self {
        Self { need: Need::Word(word), ..self }
    }

    pub(crate) const fn or_bool(self, value: bool) -> Self {
        Self { need: Need::Bool(value), ..self }
    }

    /// What the page says where a key is absent.
    pub(crate) const fn absent(self, text: &'static str) -> Self {
        Self { need: Need::Absent(text), ..self }
    }

    pub(crate) const fn beside(self, beside: &'static [&'static str]) -> Self {
        Self { beside, ..self }
    }

    pub(crate) const fn unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    /// Its meaning, behind what is allowed.
    pub(crate) const fn is(self, text: &'static str) -> Self {
        Self { text, lists_allowed: false, ..self }
    }

    /// Its meaning, which says what is allowed.
    pub(crate) const fn tells(self, text: &'static str) -> Self {
        Self { text, lists_allowed: true, ..self }
    }
}

/// The names of choices.
macro_rules! words {
    ($choices:expr) => {
        || $choices.iter().map(|choice| choice.0).collect()
    };
}
pub(crate) use words;

/// The names of keys, each once.
pub(crate) fn names<'k>(keys: impl Iterator<Item = &'k Key>) -> Vec<&'static str> {
    let mut names = Vec::new();
    for key in keys {
        if !names.contains(&key.name) {
            names.push(key.name);
        }
    }
    names
}

/// A number of a key with a unit of time, rounded to the microsecond.
pub(crate) fn time(key: &Key, value: f64) -> Duration {
    let micros = if key.unit == "ms" { 1e3 } else { 1.0 };
    Duration::from_micros((value * micros).round() as u64)
}

/// A time in ms.
pub(crate) const fn ms(time: Duration) -> f64 {
    time.as_micros() as f64 / 1000.0
}

/// The longest time of most keys, in ms.
pub(crate) const HOUR_MS: f64 = ms(MAX_TIME);

/// The tables at the top of the files.
pub mod top {
    use super::{Key, KeyTable, Shape, controller, gateway, recipe};
    use proto_core::config::{MAX_PORTS, MAX_RECIPES};

    /// A gateway file.
    pub const GATEWAY: KeyTable = KeyTable::of(
        "gateway file",
        &[
            Key::new("controller", Shape::Table(&gateway::CONTROLLER))
                .required()
                .is("the robot's controller"),
            Key::new("network", Shape::Table(&gateway::NETWORK))
                .is("a board's own address; without it, DHCP"),
            Key::new("recipe", Shape::List(&Shape::Table(&recipe::OF_GATEWAY), 0, MAX_RECIPES))
                .is("what frames consist of"),
            Key::new("port", Shape::List(&Shape::Table(&gateway::PORT), 0, MAX_PORTS))
                .is("where devices and links are"),
        ],
    );

    /// A controller file.
    pub const CONTROLLER: KeyTable = KeyTable::of(
        "controller file",
        &[
            Key::new("listen", Shape::Table(&controller::LISTEN)).is("where its servers are"),
            Key::new("robot", Shape::Table(&controller::ROBOT)).is("the robot at the start"),
            Key::new("initial", Shape::Map(&controller::INITIAL, 0)).is("values at the start"),
            Key::new("functions", Shape::Table(&controller::FUNCTIONS)).is("functional inputs and outputs"),
            Key::new("recipe", Shape::List(&Shape::Table(&recipe::OF_CONTROLLER), 0, usize::MAX))
                .is("what frames consist of"),
            Key::new("port", Shape::List(&Shape::Table(&controller::PORT), 0, usize::MAX)).is("recipe ports"),
            Key::new("program", Shape::List(&Shape::Table(&controller::PROGRAM), 0, usize::MAX))
                .is("programs in Rhai"),
        ],
    );
}
