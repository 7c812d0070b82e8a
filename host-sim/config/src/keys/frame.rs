//! Keys of every frame, of a recipe's parts and of exchanges.

use proto_core::recipe::model::{MAX_DELIMITER, MAX_FIELDS};

use super::device::{CHECKSUM, ENDIAN, ESCAPE, FRAMING, WORD_ORDER};
use super::{Key, Shape, TextKind, field};

/// Bytes before the fields.
pub const HEAD: Key = delimiter("head");
/// Bytes behind them.
pub const TAIL: Key = delimiter("tail");

const fn delimiter(name: &'static str) -> Key {
    Key::new(name, Shape::Bytes(0, MAX_DELIMITER)).absent("`[]`").tells(
        "0..=8 bytes; on RS-485 and TCP at least one byte in head or tail, unless a checksum or a constant tells where \
         a frame begins (section 4)",
    )
}

/// The fields of a realtime recipe.
pub const VARIABLES: Key = Key::new("fields", Shape::List(&Shape::Text(TextKind::Variables), 1, MAX_FIELDS))
    .required()
    .tells("1..=128 fields; the whole frame at most 512 bytes, or 8 on CAN");

const fn fields(item: &'static Shape) -> Key {
    Key { shape: Shape::List(item, 0, usize::MAX), ..VARIABLES }
}

pub(super) const PLAIN_FIELDS: Key = fields(&Shape::Table(&field::PLAIN));
pub(crate) const INPUT_FIELDS: Key = fields(&Shape::Table(&field::INPUT));
pub(crate) const OUTPUT_FIELDS: Key = fields(&Shape::Table(&field::OUTPUT));

/// The id of a CAN frame.
pub const ID: Key = Key::integer("id", 0, 0x1FFF_FFFF)
    .required()
    .tells("0..=0x7FF, or 0..=0x1FFFFFFF with `extended`; unique in the part, but see section 4");
/// Whether it has 29 bits.
pub const EXTENDED: Key = Key::bool("extended").tells("29-bit ids, 0..=0x1FFFFFFF");

/// The name of an output frame.
pub const FRAME_NAME: Key = Key::text_of("name", TextKind::Name)
    .absent("none")
    .tells("of an output frame: its name for `after`, 1..=32 characters, unique in the part");
/// The frame that goes before it.
pub const AFTER: Key = Key::text_of("after", TextKind::Name).absent("order of the file").tells(
    "of an output frame: the name of the frame of the same cycle behind which it is sent, such as a control word \
     behind the target that it starts",
);

/// The device's keys of a stream part.
pub(crate) const OF_STREAM: &[Key] = &[ENDIAN, WORD_ORDER, CHECKSUM, FRAMING, ESCAPE];
/// Those of a CAN frame, and of a frame of an exchange.
pub(crate) const OF_FRAME: &[Key] = &[ENDIAN, WORD_ORDER, CHECKSUM];
