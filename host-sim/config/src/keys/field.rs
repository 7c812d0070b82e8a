//! The fields of user recipes, and what stands in their place.

use proto_core::config::{CommandWhen, InputRule, MAX_COMMAND_TEXT, NO_TEXT, Outside};
use proto_core::device::{ByteOrder, Counts, MAX_DIGITS, MAX_IGNORED, MAX_TEXT, Overflow};
use proto_core::wire::scalar::ScalarType;

use super::device::{ENDIAN, WORD_ORDER};
use super::{Case, Key, KeyTable, Limits, Rule, Shape, TextKind, When, words};

/// The name of a field.
pub const NAME: Key =
    Key::text_of("name", TextKind::Any).required().tells("its name in tools; a constant integer needs none");
const NAME_IF_ANY: Key = Key { need: super::Need::Absent("none"), ..NAME };
/// The types of fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Type {
    Scalar(ScalarType),
    Uint24,
    Int24,
    Bcd,
    Decimal,
    Hex,
    /// An unsigned number of so many bytes that is too wide for a value, but has bits.
    Wide(u8),
}

/// The types that only a device's frames have.
pub(crate) const OWN_TYPES: [(&str, Type); 9] = [
    ("uint24", Type::Uint24),
    ("int24", Type::Int24),
    ("bcd", Type::Bcd),
    ("decimal", Type::Decimal),
    ("hex", Type::Hex),
    ("uint40", Type::Wide(5)),
    ("uint48", Type::Wide(6)),
    ("uint56", Type::Wide(7)),
    ("uint64", Type::Wide(8)),
];
/// The type of a field.
pub const TYPE: Key = Key::words("type", || {
    ScalarType::ALL.iter().map(|ty| ty.name()).chain(OWN_TYPES.iter().map(|ty| ty.0)).collect()
})
.required()
.tells(
    "`byte`, `char`, `word`, `short`, `dword`, `int`, `float`, `double`; of a device also those below; of a text \
     `\"text\"`",
);
pub(crate) const PLAIN_TYPE: Key =
    Key { shape: Shape::Words(|| ScalarType::ALL.iter().map(|ty| ty.name()).collect()), ..TYPE };
const TEXT_TYPE: Key = Key { shape: Shape::Words(|| vec!["text"]), ..TYPE };

const OWN_ENDIAN: Key = ENDIAN.absent("of the part").is("the byte order of this field");
const OWN_WORD_ORDER: Key = WORD_ORDER.absent("of the part").is("the order of its words");
/// Some bits of a number.
pub const BITS: Key = Key::new(
    "bits",
    Shape::Either(&[Shape::Integer(0, 63), Shape::Text(TextKind::Pattern("^[0-9]+(\\.\\.[0-9]+)?$"))]),
)
.absent("all")
.tells(
    "`3` or `\"4..7\"` of a `byte`, `word`, `dword`, or of `uint24` to `uint64`; bit 0 is the lowest; up to 32 bits",
);
/// Whether they have a sign.
pub const SIGNED: Key = Key::bool("signed").beside(&["bits"]).tells("the highest of the bits is a sign");
/// Whether they begin a number.
pub const NEW: Key = Key::bool("new").beside(&["bits"]).tells(
    "begins a new number. Otherwise fields with `bits`, one after the other, of the same type and order, share one \
     number as long as their bits differ. `false`: shares it in another byte order too",
);
/// The width of digits.
pub const WIDTH: Key = Key::integer("width", 1, MAX_DIGITS as i64)
    .required()
    .tells("bytes of `bcd`, 1..=4; characters of `decimal`, 1..=16, or of `hex`, 1..=8");
const WIDTH_IF_ANY: Key = Key { need: super::Need::Absent("none"), ..WIDTH };
/// What ends digits.
pub const UNTIL: Key = Key::text_of("until", TextKind::Length(1, 1))
    .tells("`decimal` and `hex`: the character behind the field, instead of `width`");
/// Digits behind the point.
pub const DECIMALS: Key = Key::integer("decimals", 0, 9).or(0).is("of `decimal`: digits behind the point");
/// The words of `overflow`.
pub(crate) const OVERFLOWS: [(&str, Overflow); 1] = [("wrap", Overflow::Wrap)];
/// What happens to numbers that do not fit.
pub const OVERFLOW: Key = Key::words("overflow", words!(OVERFLOWS)).absent("absent").tells(
    "`\"wrap\"`: what does not fit wraps, as a counter does, from the field to its variable or from the variable to \
     the field. Otherwise a received field is rejected, and the nearest number is sent. Integers only",
);
/// The lowest number that is sent.
pub const MIN: Key = Key::new("min", Shape::Number(Limits::Any))
    .absent("of the field")
    .tells("output, with `from`: the lowest number that is sent, after `scale` and `offset`");
/// The highest number that is sent.
pub const MAX: Key = Key::new("max", Shape::Number(Limits::Any))
    .absent("of the field")
    .tells("output, with `from`: the highest number that is sent");
/// The words of `outside`.
pub(crate) const OUTSIDES: [(&str, Outside); 2] = [("refuse", Outside::Refuse), ("clamp", Outside::Clamp)];
/// What becomes of others.
pub const OUTSIDE: Key = Key::words("outside", words!(OUTSIDES)).or_word("refuse").tells(
    "with `min` or `max`, what becomes of a number below or above. `\"refuse\"`: the frame is not sent; `\"clamp\"`: \
     the nearer of the two is sent",
);
/// What is sent for values.
pub const MAP: Key = Key::new("map", Shape::Map(&Shape::Number(Limits::Any), 1)).tells(
    "output, with `from`: what is sent for values of the source or ranges of them, such as `{ 0 = 1, \"1..7\" = 2 }`; \
     with another value the frame is not sent",
);
/// The words of `as`.
pub(crate) const AS_WORDS: [(&str, InputRule); 1] = [("int16", InputRule::Int16)];
/// How a variable has a number.
pub const AS: Key = Key::words("as", words!(AS_WORDS)).beside(&["to"]).absent("absent").tells(
    "input, with a word register: `\"int16\"`: the register has -32768..=32767 in two's complement, as the program reads \
     it with its sign. Without it a negative number is rejected",
);
const MIN_IN: Key =
    MIN.beside(&["to"]).tells("input: the lowest number that is taken, before `scale` and `offset`");
const MAX_IN: Key = MAX.beside(&["to"]).tells("input: the highest number that is taken");
const OUTSIDE_IN: Key = OUTSIDE.tells(
    "with `min` or `max`, what becomes of a number below or above. `\"refuse\"`: the field is rejected; `\"clamp\"`: the \
     nearer of the two is taken",
);
const MAP_IN: Key = MAP.beside(&["to"]).tells(
    "input: what the variable becomes for values of the field or ranges of them, such as `{ 0 = 1, \"1..7\" = 2, else = 9 }`; \
     without `else` the field is rejected with another value",
);
/// What says that there is no value.
pub const NO_VALUE: Key = Key::new(
    "no_value",
    Shape::List(&Shape::Either(&[Shape::Number(Limits::Any), Shape::Text(TextKind::Length(1, NO_TEXT))]), 1, usize::MAX),
)
.beside(&["to"])
.tells(
    "input: numbers, and for `decimal` and `hex` also texts of up to 8 characters, that say that there is no value now, such \
     as `[0x7FFF]` or `[\"----\"]`. No error: the variable keeps its value for `timeout_ms`, and the field is counted \
     (`fields_without_value`)",
);
/// What says whether there is one.
pub const VALID_TO: Key = Key::text_of("valid_to", TextKind::VariableOrBit).beside(&["to"]).tells(
    "input: a bit or a word register that is 1 while the field's newest value was taken, and 0 when it was rejected, had \
     none, or is overdue",
);
/// The words of `point`.
pub(crate) const POINTS: [(&str, Option<InputRule>); 2] = [(".", None), (",", Some(InputRule::Comma))];
/// The point of digits.
pub const POINT: Key = Key::words("point", words!(POINTS))
    .or_word(".")
    .beside(&["to"])
    .tells("of `decimal`, input: `\",\"` if the digits have a comma where others have `\".\"`");
/// What tells that the device has restarted.
pub const RESTARTED: Key = Key::new("restarted", Shape::Number(Limits::Any)).absent("none").tells(
    "input, in the reply of an exchange: when the field becomes this number, and was another one in the reply before, the \
     device has restarted: what is asked at its start is asked again. It needs no `to`",
);
pub(crate) const RULES_IN: &[Key] = &[AS, MIN_IN, MAX_IN, OUTSIDE_IN, MAP_IN, NO_VALUE, VALID_TO, POINT];
/// A constant that is received.
pub const EQUALS: Key = Key::integer("equals", i32::MIN as i64, u32::MAX as i64)
    .absent("absent")
    .tells("input: a constant. A frame with another value is not this frame. The field needs no `name`");
pub(crate) const COUNTER_MAX: Key =
    Key::integer("max", 1, u32::MAX as i64).required().is("the highest number of the counter");
/// `{ max = 14 }`.
pub const COUNTER_TABLE: KeyTable = KeyTable::of("counter", &[COUNTER_MAX]);
/// An alive counter.
pub const COUNTER: Key =
    Key::new("counter", Shape::Either(&[Shape::Bool, Shape::Table(&COUNTER_TABLE)])).or_bool(false).tells(
        "input: an alive counter; output: with `from = \"counter\"`, where it ends. `{ max = 14 }`: 14 is followed by \
         0; `true`: the highest number of the field is. Unsigned integers only",
    );

/// Where a value goes.
pub const TO: Key = Key::text_of("to", TextKind::VariableOrBit)
    .tells("input: a variable, such as `\"WordInputReg[1]\"`, or a bit, such as `\"BitInputReg[3].4\"`");
/// Its factor.
pub const SCALE: Key = Key::new("scale", Shape::Number(Limits::Any)).or(1);
/// What is added to it.
pub const OFFSET: Key = Key::new("offset", Shape::Number(Limits::Any)).or(0);
pub(crate) const SCALE_IN: Key = SCALE.beside(&["to"]).tells("with `to` or `from`: a factor, not 0");
pub(crate) const OFFSET_IN: Key = OFFSET.beside(&["to"]).tells("with `to` or `from`: what is added then");
const SCALE_OUT: Key = Key { beside: &["from"], ..SCALE_IN };
const OFFSET_OUT: Key = Key { beside: &["from"], ..OFFSET_IN };
/// Where a value comes from.
pub const FROM: Key = Key::text_of("from", TextKind::Source)
    .tells("output: a variable, a bit, or another of the sources below");
/// A constant that is sent.
pub const VALUE: Key = Key::new("value", Shape::Number(Limits::Any)).tells("output: a constant");

/// What values pick.
pub const COMMANDS: Key =
    Key::new("commands", Shape::Map(&Shape::Text(TextKind::Length(1, MAX_COMMAND_TEXT)), 1))
        .tells("input: commands by values, ranges of values, or `rising`, `falling` and `level`, as below");
/// The words of `when`.
pub(crate) const WHENS: [(&str, CommandWhen); 2] =
    [("change", CommandWhen::Change), ("frame", CommandWhen::Frame)];
/// When a value acts.
pub const WHEN: Key = Key::words("when", words!(WHENS)).or_word("change").beside(&["commands"]).tells(
    "`\"change\"`: the value acts if it differs from the previous frame; `\"frame\"`: with every frame",
);
/// The words of `base`, and whether the base is kept.
pub(crate) const BASES: [(&str, bool); 2] = [("reset", false), ("keep", true)];
/// What silence does.
pub const BASE: Key = Key::words("base", words!(BASES)).or_word("reset").beside(&["commands"]).tells(
    "what silence, an overdue frame, does with `when = \"change\"`. `\"reset\"`: the next value only sets the base, \
     which later ones differ from. `\"keep\"`: the value before the silence stays the base, for devices that send only \
     changes. Supervision is the same: `timeout_ms`, safe values. After the start, a lost device, bus-off or sleep the \
     first value only sets the base in any case; after sleep a stop in it is given",
);
/// A value that picks nothing.
pub const IDLE: Key = Key::integer("idle", i32::MIN as i64, u32::MAX as i64)
    .or(0)
    .beside(&["commands"])
    .tells("the value at which the device asks for nothing; one of the tables' 32 entries");

/// Bytes without a meaning.
pub const PAD: Key = Key::integer("pad", 1, 255).unit("bytes").required().is(
    "instead of a field, `{ pad = 3 }`: bytes without a meaning; any are taken. Of coils 1..=2000 of them",
);
pub(crate) const PAD_COILS: Key = Key { shape: Shape::Integer(1, 2000), ..PAD };
/// What is sent there.
pub const FILL: Key =
    Key::integer("fill", 0, 255).or(0).beside(&["pad"]).is("with `pad`: the bytes that are sent");
/// Constant bytes.
pub const TEXT: Key = Key::text_of("text", TextKind::Length(1, usize::MAX))
    .tells("instead of a field, `{ text = \"ST,\" }`: constant bytes of ASCII");

/// The width of a text.
pub const TEXT_WIDTH: Key = Key::integer("width", 1, MAX_TEXT as i64).is(
    "of a text: its number of characters, or with `until = \";\"` the character behind it; with neither, all up to the \
     end of the frame, but for what stands behind it. A frame that is searched needs a `length` before such a text",
);
/// What ends a text.
pub const TEXT_UNTIL: Key =
    Key::text_of("until", TextKind::Length(1, 1)).tells("the character behind the text");
/// What fills a text.
pub const TEXT_FILL: Key = Key::text_of("fill", TextKind::Length(1, 1)).beside(&["width"]).tells(
    "with `width`: the character that stands behind a shorter text. It is taken off, and put there in an output",
);
/// The registers of a text.
pub const TEXT_TO: Key = Key::text_of("to", TextKind::Variables).tells(
    "`\"WordInputReg[1..8]\"`: the registers, two characters each, zeros behind the end. A longer text is rejected",
);
/// The words of `order` of a text.
pub(crate) const TEXT_ORDERS: [(&str, ByteOrder); 2] =
    [("high-first", ByteOrder::Big), ("low-first", ByteOrder::Little)];
/// The order of characters in a register.
pub const TEXT_ORDER: Key = Key::words("order", words!(TEXT_ORDERS))
    .or_word("high-first")
    .tells("`\"high-first\"`: the first character is the high byte; `\"low-first\"`");
const TEXT_ORDER_IN: Key = Key { beside: &["to"], ..TEXT_ORDER };
/// Where its length goes.
pub const LENGTH_TO: Key =
    Key::text_of("length_to", TextKind::Variable).tells("becomes the number of characters");
/// What counts texts.
pub const COUNT_TO: Key = Key::text_of("count_to", TextKind::Variable)
    .tells("the number of frames accepted on the port, wrapping: the same text twice is seen");
/// Texts that say nothing.
pub const IGNORE: Key =
    Key::new("ignore", Shape::List(&Shape::Text(TextKind::Length(0, MAX_IGNORED - 1)), 0, usize::MAX)).tells(
        "`[\"NOREAD\", \"?\"]`: texts that say that nothing was read: such a frame shows that the device is there, \
         changes nothing and is counted (`ignored`). `\"\"` is a frame without a text, such as a lone CR LF. Together at most 13 characters; each text after the first takes \
         one more",
    );
/// The registers that a text is sent from.
pub const TEXT_FROM: Key = Key::text_of("from", TextKind::Variables)
    .required()
    .tells("in an output: the registers, `\"WordOutputReg[1..8]\"`. A text that does not fit is not sent");
/// Its length.
pub const LENGTH_FROM: Key = Key::text_of("length_from", TextKind::Variable).tells(
    "in an output: the register with the number of characters; without it the text ends before the first zero",
);

/// The length of a frame.
pub const LENGTH: Key = Key::new("length", Shape::Bool).tells("`true`: the field is the length of the frame");
/// The words of `counts`.
pub(crate) const ALL_COUNTS: [(&str, Counts); 3] =
    [("rest", Counts::Rest), ("frame", Counts::Frame), ("fields", Counts::Fields)];
/// What it counts.
pub const COUNTS: Key = Key::words("counts", words!(ALL_COUNTS)).or_word("rest").beside(&["length"]).tells(
    "`\"rest\"`: everything behind it, checksum and tail included; `\"frame\"`: the whole frame; `\"fields\"`: the \
     fields behind it",
);
/// What is added to it.
pub const PLUS: Key =
    Key::integer("plus", -128, 127).or(0).beside(&["length"]).is("so many bytes more than it says");

/// How a field is written.
pub(crate) const WRITTEN: &[Key] =
    &[OWN_ENDIAN, OWN_WORD_ORDER, BITS, SIGNED, NEW, WIDTH_IF_ANY, UNTIL, DECIMALS];
/// What an input field is for.
pub(crate) const BOUND_IN: &[Key] = &[
    TO, COMMANDS, WHEN, BASE, IDLE, SCALE_IN, OFFSET_IN, EQUALS, COUNTER, AS, MIN_IN, MAX_IN, OUTSIDE_IN,
    MAP_IN, NO_VALUE, VALID_TO, POINT, RESTARTED,
];
/// What an output field is for.
pub(crate) const BOUND_OUT: &[Key] =
    &[FROM, VALUE, SCALE_OUT, OFFSET_OUT, COUNTER, MIN_OUT, MAX_OUT, OUTSIDE, MAP_OUT];
const MIN_OUT: Key = MIN.beside(&["from"]);
const MAX_OUT: Key = MAX.beside(&["from"]);
const MAP_OUT: Key = MAP.beside(&["from"]);
/// Padding.
pub(crate) const PADDING: &[Key] = &[PAD, FILL];
/// Padding of coils.
pub(crate) const COIL_PADDING: &[Key] = &[PAD_COILS];
/// Constant bytes.
pub(crate) const CONSTANT_TEXT: &[Key] = &[TEXT];
/// A text that is received.
pub(crate) const TEXT_IN: &[Key] = &[
    NAME_IF_ANY,
    TEXT_TYPE,
    TEXT_WIDTH,
    TEXT_UNTIL,
    TEXT_FILL,
    TEXT_ORDER_IN,
    TEXT_TO,
    LENGTH_TO,
    COUNT_TO,
    IGNORE,
];
/// A text that is sent.
pub(crate) const TEXT_OUT: &[Key] =
    &[NAME_IF_ANY, TEXT_TYPE, TEXT_WIDTH, TEXT_UNTIL, TEXT_FILL, TEXT_ORDER, TEXT_FROM, LENGTH_FROM];
/// The length of a frame.
pub(crate) const LENGTHS: &[Key] = &[NAME_IF_ANY, TYPE, LENGTH, COUNTS, PLUS];
/// A field with a value.
pub(crate) const NAMED: &[Key] = &[NAME, TYPE];
const CONSTANT: &[Key] = &[NAME_IF_ANY, TYPE, EQUALS];
/// What only frames of devices have.
pub(crate) const OWN: &[&[Key]] = &[
    &[EQUALS, OVERFLOW, COUNTER],
    PADDING,
    CONSTANT_TEXT,
    &[LENGTH_TO, COUNT_TO, LENGTH_FROM, TEXT_ORDER, IGNORE],
    &[LENGTH, COUNTS, PLUS],
    WRITTEN,
    RULES_IN,
];
/// A coil with a value.
pub(crate) const COIL: &[Key] = &[NAME];

const WIDE: &[&str] = &["uint40", "uint48", "uint56", "uint64"];
const RULES: &[Rule] = &[
    Rule::Only("bits", "type", &["byte", "word", "dword", "uint24", "uint40", "uint48", "uint56", "uint64"]),
    Rule::Needs("type", WIDE, &["bits"]),
    Rule::Needs("type", &["bcd"], &["width"]),
    Rule::Needs("type", &["decimal", "hex"], &["width", "until"]),
    Rule::Only("width", "type", &["bcd", "decimal", "hex", "text"]),
    Rule::Only("until", "type", &["decimal", "hex", "text"]),
    Rule::Only("decimals", "type", &["decimal"]),
    Rule::Only("point", "type", &["decimal"]),
    Rule::Only("word_order", "type", &["dword", "int", "float", "double", "uint64"]),
    Rule::NotBoth("width", "until"),
    Rule::NotBoth("from", "value"),
    Rule::NotBoth("map", "min"),
    Rule::NotBoth("map", "max"),
    Rule::NotBoth("map", "outside"),
];

const IS_PAD: &[When] = &[When::Has(&["pad"])];
const IS_LENGTH: &[When] = &[When::Has(&["length"])];
const IS_TEXT: &[When] = &[When::Has(&["text"])];
const IS_CONSTANT: &[When] = &[When::Has(&["equals"])];
const IS_VALUE: &[When] = &[When::Has(&["value"])];
const TEXT_TYPED: &[When] = &[When::Is("type", &["text"], &[])];

/// A field of a controller's recipe.
pub const PLAIN: KeyTable = KeyTable::of("field of a controller", &[NAME, PLAIN_TYPE]);

/// A field that is received, or what stands in its place.
pub const INPUT: KeyTable = KeyTable::of("input field", &[]).at(" in an input field").rules(RULES).cases(&[
    Case { when: IS_PAD, keys: &[PADDING] },
    Case { when: TEXT_TYPED, keys: &[TEXT_IN] },
    Case { when: IS_LENGTH, keys: &[LENGTHS, WRITTEN] },
    Case { when: IS_TEXT, keys: &[CONSTANT_TEXT] },
    Case { when: IS_CONSTANT, keys: &[CONSTANT, WRITTEN] },
    Case { when: &[], keys: &[NAMED, VALUE_IN, RULES_IN, &[OVERFLOW_IN, RESTARTED], WRITTEN] },
]);
const VALUE_IN: &[Key] = &[TO, COMMANDS, WHEN, BASE, IDLE, SCALE_IN, OFFSET_IN, COUNTER];
const OVERFLOW_IN: Key = OVERFLOW.beside(&["to"]);

/// A field that is sent, or what stands in its place.
pub const OUTPUT: KeyTable =
    KeyTable::of("output field", &[]).at(" in an output field").rules(RULES).cases(&[
        Case { when: IS_PAD, keys: &[PADDING] },
        Case { when: TEXT_TYPED, keys: &[TEXT_OUT] },
        Case { when: IS_LENGTH, keys: &[LENGTHS, WRITTEN] },
        Case { when: IS_TEXT, keys: &[CONSTANT_TEXT] },
        Case { when: IS_VALUE, keys: &[&[NAME_IF_ANY, TYPE], BOUND_OUT, &[OVERFLOW_OUT], WRITTEN] },
        Case { when: &[], keys: &[NAMED, BOUND_OUT, &[OVERFLOW_OUT], WRITTEN] },
    ]);
const OVERFLOW_OUT: Key = OVERFLOW.beside(&["from"]);

/// A coil that is received.
pub const COIL_IN: KeyTable = KeyTable::of("coil that is read", &[]).at(" of a coil").cases(&[
    Case { when: IS_PAD, keys: &[COIL_PADDING] },
    Case { when: IS_CONSTANT, keys: &[&[NAME_IF_ANY, EQUALS]] },
    Case { when: &[], keys: &[COIL, VALUE_IN, RULES_IN, &[RESTARTED]] },
]);

/// A coil that is sent.
pub const COIL_OUT: KeyTable =
    KeyTable::of("coil that is written", &[]).at(" of a coil").rules(RULES).cases(&[
        Case { when: IS_PAD, keys: &[COIL_PADDING] },
        Case { when: IS_VALUE, keys: &[&[NAME_IF_ANY], BOUND_OUT] },
        Case { when: &[], keys: &[COIL, BOUND_OUT] },
    ]);

const GOES_UP: &[When] = &[When::Has(&["to", "commands", "equals", "length_to", "count_to"])];

const COIL_GOES_UP: &[When] = &[When::Has(&["to", "commands"])];

/// A field in a block that is read or written by its master.
pub const IN_BLOCK: KeyTable = KeyTable::of("field of a block", &[]).rules(RULES).cases(&[
    Case { when: IS_PAD, keys: &[PADDING] },
    Case { when: &[When::Is("type", &["text"], &[]), When::Has(&["from"])], keys: &[TEXT_OUT] },
    Case { when: TEXT_TYPED, keys: &[TEXT_IN] },
    Case { when: IS_TEXT, keys: &[CONSTANT_TEXT] },
    Case { when: IS_CONSTANT, keys: &[CONSTANT, WRITTEN] },
    Case { when: GOES_UP, keys: &[NAMED, VALUE_IN, RULES_IN, &[OVERFLOW_IN], WRITTEN] },
    Case { when: IS_VALUE, keys: &[&[NAME_IF_ANY, TYPE], BOUND_OUT, &[OVERFLOW_OUT], WRITTEN] },
    Case { when: &[], keys: &[NAMED, BOUND_OUT, &[OVERFLOW_OUT], WRITTEN] },
]);

/// A coil in such a block.
pub const COIL_IN_BLOCK: KeyTable =
    KeyTable::of("coil of a block", &[]).at(" of a coil").rules(RULES).cases(&[
        Case { when: IS_PAD, keys: &[COIL_PADDING] },
        Case { when: IS_CONSTANT, keys: &[&[NAME_IF_ANY, EQUALS]] },
        Case { when: COIL_GOES_UP, keys: &[COIL, VALUE_IN, RULES_IN] },
        Case { when: IS_VALUE, keys: &[&[NAME_IF_ANY], BOUND_OUT] },
        Case { when: &[], keys: &[COIL, BOUND_OUT] },
    ]);
