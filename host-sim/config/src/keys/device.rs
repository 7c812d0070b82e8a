//! Frames of devices: orders of bytes, what tells frames apart, checksums.

use proto_core::device::{Algorithm, Boundary, ByteOrder, Escape, MAX_DATA_ID};
use proto_core::recipe::model::MAX_STREAM_FRAME;

use super::{Case, Key, KeyTable, Shape, TextKind, When, words};

/// The words of `endian`, and whether they are big-endian.
pub(crate) const ORDERS: [(&str, bool); 2] = [("little", false), ("big", true)];
/// Order of bytes.
pub const ENDIAN: Key = Key::words("endian", words!(ORDERS))
    .or_word("little")
    .tells("`\"little\"`, `\"big\"`: byte order of its fields");
/// The words of `word_order`, and whether the low word is first.
pub(crate) const WORD_ORDERS: [(&str, bool); 2] = [("high-first", false), ("low-first", true)];
/// Order of words.
pub const WORD_ORDER: Key = Key::words("word_order", words!(WORD_ORDERS))
    .absent("as `endian`")
    .tells("of fields of 4 or 8 bytes, in words of 16 bits: `\"high-first\"`, `\"low-first\"`");
/// The same in registers of Modbus.
pub const WORD_ORDER_OF_REGISTERS: Key = WORD_ORDER.or_word("high-first");
/// A checksum.
pub const CHECKSUM: Key = Key::new("checksum", Shape::Table(&CHECKSUM_TABLE)).tells("see below");
/// The words of `framing`.
pub(crate) const FRAMINGS: [(&str, Boundary); 3] =
    [("fields", Boundary::Fields), ("tail", Boundary::Tail), ("silence", Boundary::Silence)];
/// What tells frames apart.
pub const FRAMING: Key = Key::words("framing", words!(FRAMINGS)).or_word("fields").tells(
    "`\"fields\"`: head, constants, lengths and checksum, searched at each byte; `\"tail\"`: a frame is what came \
     between two tails, and is taken or rejected as a whole; `\"silence\"`: a frame is what came between two silences \
     of `idle_gap_ms`",
);
/// The words of `escape`.
pub(crate) const ESCAPES: [(&str, Escape); 3] =
    [("dle", Escape::Dle), ("slip", Escape::Slip), ("cobs", Escape::Cobs)];
/// Escapes around frames.
pub const ESCAPE: Key = Key::words("escape", words!(ESCAPES)).tells(
    "`\"dle\"`: DLE STX, the frame with each DLE doubled, DLE ETX; `\"slip\"`: RFC 1055; `\"cobs\"`: COBS with a zero \
     behind each frame. Head, fields, checksum and tail are those of the frame without escapes. Instead of `framing`",
);

/// What makes a checksum.
pub const KIND: Key = Key::words("kind", || Algorithm::names().chain(["crc"]).collect()).required().tells(
    "CRCs: `crc8`, `crc8-autosar`, `crc8-gsm-a`, `crc8-maxim`, `crc8-nrsc-5`, `crc8-sae-j1850`, `crc16-arc`, \
     `crc16-ccitt-false`, `crc16-ccitt-aug`, `crc16-dnp`, `crc16-kermit`, `crc16-mcrf4xx`, `crc16-modbus`, \
     `crc16-umts`, `crc16-usb`, `crc16-x25`, `crc16-xmodem`, `crc32`, `crc32-mpeg-2`, `crc32c`; sums: `sum8`, \
     `sum16`, `xor8`, `lrc`; `crc` with its parameters",
);
/// The bytes that it covers.
pub const OVER: Key = Key::text_of("over", TextKind::Pattern("^[0-9]+\\.\\.[0-9]*$")).or_word("0..").tells(
    "the bytes that it covers: `\"1..7\"` with the last one, or `\"1..\"` up to the checksum. Byte 0 is the first of \
     the frame; the head counts",
);
/// Where it stands.
pub const AT: Key = Key::integer("at", 0, MAX_STREAM_FRAME as i64 - 1)
    .absent("behind the fields, before the tail")
    .is("the byte at which it stands, where a field begins or ends");
/// The words of `order` of a checksum.
pub(crate) const CHECKSUM_ORDERS: [(&str, ByteOrder); 2] =
    [("little", ByteOrder::Little), ("big", ByteOrder::Big)];
/// Its order of bytes.
pub const ORDER: Key = Key::words("order", words!(CHECKSUM_ORDERS)).absent("of the standard").tells(
    "`\"little\"`: low byte first, `\"big\"`. A reflected CRC, such as that of Modbus, has its low byte first, any \
     other checksum its high byte",
);
/// Bytes that are not in the frame.
pub const DATA_ID: Key = Key::new(
    "data_id",
    Shape::Either(&[Shape::Integer(0, 0xFFFF), Shape::Bytes(1, MAX_DATA_ID)]),
)
.tells(
    "bytes that it covers and that are not in the frame: `0x1234`, low byte first, or a list of 1 to 4 bytes",
);
/// The words of `data_id_at`, and whether the bytes are behind the frame's.
pub(crate) const DATA_ID_PLACES: [(&str, bool); 2] = [("start", false), ("end", true)];
/// Where they are.
pub const DATA_ID_AT: Key = Key::words("data_id_at", words!(DATA_ID_PLACES))
    .or_word("start")
    .beside(&["data_id"])
    .tells("`\"start\"`: they are before the bytes of the frame, `\"end\"`: behind them");
/// The words of `as`, and whether they are digits.
pub(crate) const CHECKSUM_FORMS: [(&str, bool); 2] = [("bytes", false), ("hex", true)];
/// How it is written.
pub const AS: Key = Key::words("as", words!(CHECKSUM_FORMS))
    .or_word("bytes")
    .is("`\"hex\"`: two digits of ASCII for each byte");
/// The width of a CRC.
pub const WIDTH: Key = Key::integer("width", 1, 32).unit("bits").required().is("of `crc`: number of bits");
/// Its polynomial.
pub const POLY: Key = number("poly").required().tells("of `crc`: polynomial without its highest term");
/// Its register at the start.
pub const INIT: Key = number("init").or(0).tells("of `crc`: the register at the start");
/// What the result is combined with.
pub const XOROUT: Key = number("xorout").or(0).tells("of `crc`: what the result is combined with");
/// Whether bytes are reflected.
pub const REFIN: Key = Key::bool("refin").tells("of `crc`: bytes are taken lowest bit first");
/// Whether the result is.
pub const REFOUT: Key = Key::bool("refout").absent("as `refin`").tells("of `crc`: the result is reflected");

const fn number(name: &'static str) -> Key {
    Key::integer(name, 0, u32::MAX as i64)
}

/// The table of a checksum.
pub const CHECKSUM_TABLE: KeyTable =
    KeyTable::of("checksum", &[KIND, OVER, AT, ORDER, AS, DATA_ID, DATA_ID_AT]).cases(&[Case {
        when: &[When::Is("kind", &["crc"], &[])],
        keys: &[&[WIDTH, POLY, INIT, XOROUT, REFIN, REFOUT]],
    }]);
