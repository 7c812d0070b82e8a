//! A JSON serializer for serde without an allocator, which writes to any [`core::fmt::Write`].
//!
//! Numbers that are not finite become `null`, as JSON has none. Bytes become an array of numbers. Writing fails only
//! if the writer has no room, or if a map has a key that is neither a text nor a number.

use core::fmt::{self, Write};

use serde::ser::{self, Impossible, Serialize, Serializer};

use crate::number::{Shortest, Signed, Whole};

/// Why a value was not written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JsonError {
    /// The writer has no room.
    NoRoom,
    /// A key of a map is neither a text nor a number, or a value refuses to be serialized.
    Unsupported,
}

impl fmt::Display for JsonError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NoRoom => "no room for the text",
            Self::Unsupported => "not to be written as JSON",
        })
    }
}

impl core::error::Error for JsonError {}

impl ser::Error for JsonError {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Unsupported
    }
}

impl From<fmt::Error> for JsonError {
    fn from(_: fmt::Error) -> Self {
        Self::NoRoom
    }
}

/// Writes a value.
///
/// # Errors
/// If there is no room, or a key of a map is neither a text nor a number.
pub fn write(out: &mut impl Write, value: &(impl Serialize + ?Sized)) -> Result<(), JsonError> {
    value.serialize(Json(out))
}

/// Writes a text as a quoted JSON string.
pub fn write_text(out: &mut impl Write, text: impl fmt::Display) -> fmt::Result {
    out.write_char('"')?;
    write!(Escaped(out), "{text}")?;
    out.write_char('"')
}

/// Escapes the characters that a JSON string must not contain.
struct Escaped<'w, W>(&'w mut W);

impl<W: Write> Write for Escaped<'_, W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        // Characters that need no escape are written in runs.
        let mut rest = text;
        while let Some(at) = rest.find(|c: char| matches!(c, '"' | '\\') || c < ' ') {
            let (plain, behind) = rest.split_at_checked(at).ok_or(fmt::Error)?;
            self.0.write_str(plain)?;
            let mut chars = behind.chars();
            match chars.next() {
                Some('\n') => self.0.write_str("\\n")?,
                Some(c @ ('"' | '\\')) => write!(self.0, "\\{c}")?,
                Some(c) => write!(self.0, "\\u{:04x}", u32::from(c))?,
                None => {}
            }
            rest = chars.as_str();
        }
        self.0.write_str(rest)
    }
}

struct Json<'w, W>(&'w mut W);

/// An array or object that is being written.
struct Items<'w, W> {
    out: &'w mut W,
    is_first: bool,
    end: &'static str,
}

impl<'w, W: Write> Items<'w, W> {
    fn begin(out: &'w mut W, start: &'static str, end: &'static str) -> Result<Self, JsonError> {
        out.write_str(start)?;
        Ok(Self { out, is_first: true, end })
    }

    fn comma(&mut self) -> fmt::Result {
        match core::mem::take(&mut self.is_first) {
            true => Ok(()),
            false => self.out.write_char(','),
        }
    }

    fn item(&mut self, value: &(impl Serialize + ?Sized)) -> Result<(), JsonError> {
        self.comma()?;
        value.serialize(Json(&mut *self.out))
    }

    fn entry(&mut self, key: &str, value: &(impl Serialize + ?Sized)) -> Result<(), JsonError> {
        self.comma()?;
        write_text(self.out, key)?;
        self.out.write_char(':')?;
        value.serialize(Json(&mut *self.out))
    }

    fn finish(self) -> Result<(), JsonError> {
        Ok(self.out.write_str(self.end)?)
    }
}

macro_rules! whole_numbers {
    ($($method:ident: $type:ty),*) => {
        $(fn $method(self, value: $type) -> Result<(), JsonError> {
            self.serialize_u64(value.into())
        })*
    };
}

macro_rules! signed_numbers {
    ($($method:ident: $type:ty),*) => {
        $(fn $method(self, value: $type) -> Result<(), JsonError> {
            self.serialize_i64(value.into())
        })*
    };
}

/// The serializers of all types with elements.
macro_rules! compounds {
    ($type:ty) => {
        type SerializeSeq = $type;
        type SerializeTuple = $type;
        type SerializeTupleStruct = $type;
        type SerializeTupleVariant = $type;
        type SerializeMap = $type;
        type SerializeStruct = $type;
        type SerializeStructVariant = $type;
    };
}

impl<'w, W: Write> Serializer for Json<'w, W> {
    type Ok = ();
    type Error = JsonError;

    compounds!(Items<'w, W>);

    whole_numbers!(serialize_u8: u8, serialize_u16: u16, serialize_u32: u32);

    fn serialize_u64(self, value: u64) -> Result<(), JsonError> {
        Ok(write!(self.0, "{}", Whole(value))?)
    }

    signed_numbers!(serialize_i8: i8, serialize_i16: i16, serialize_i32: i32);

    fn serialize_i64(self, value: i64) -> Result<(), JsonError> {
        Ok(write!(self.0, "{}", Signed(value))?)
    }

    fn serialize_bool(self, value: bool) -> Result<(), JsonError> {
        Ok(self.0.write_str(if value { "true" } else { "false" })?)
    }

    fn serialize_f32(self, value: f32) -> Result<(), JsonError> {
        match value.is_finite() {
            true => Ok(write!(self.0, "{}", Shortest(value))?),
            false => self.serialize_unit(),
        }
    }

    fn serialize_f64(self, value: f64) -> Result<(), JsonError> {
        match value.is_finite() {
            // Uses an exponent where that is shorter, unlike `Display`. No document of a board contains an `f64`.
            true => Ok(write!(self.0, "{value:?}")?),
            false => self.serialize_unit(),
        }
    }

    fn serialize_char(self, value: char) -> Result<(), JsonError> {
        Ok(write_text(self.0, value)?)
    }

    fn serialize_str(self, value: &str) -> Result<(), JsonError> {
        Ok(write_text(self.0, value)?)
    }

    fn serialize_bytes(self, value: &[u8]) -> Result<(), JsonError> {
        let mut items = Items::begin(self.0, "[", "]")?;
        value.iter().try_for_each(|byte| items.item(byte))?;
        items.finish()
    }

    fn serialize_none(self) -> Result<(), JsonError> {
        self.serialize_unit()
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), JsonError> {
        value.serialize(self)
    }

    fn serialize_unit(self) -> Result<(), JsonError> {
        Ok(self.0.write_str("null")?)
    }

    fn serialize_unit_struct(self, _: &'static str) -> Result<(), JsonError> {
        self.serialize_unit()
    }

    fn serialize_unit_variant(self, _: &'static str, _: u32, variant: &'static str) -> Result<(), JsonError> {
        self.serialize_str(variant)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), JsonError> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        value: &T,
    ) -> Result<(), JsonError> {
        let mut items = Items::begin(self.0, "{", "}")?;
        items.entry(variant, value)?;
        items.finish()
    }

    fn serialize_seq(self, _: Option<usize>) -> Result<Items<'w, W>, JsonError> {
        Items::begin(self.0, "[", "]")
    }

    fn serialize_tuple(self, _: usize) -> Result<Items<'w, W>, JsonError> {
        Items::begin(self.0, "[", "]")
    }

    fn serialize_tuple_struct(self, _: &'static str, _: usize) -> Result<Items<'w, W>, JsonError> {
        Items::begin(self.0, "[", "]")
    }

    fn serialize_tuple_variant(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        _: usize,
    ) -> Result<Items<'w, W>, JsonError> {
        self.0.write_char('{')?;
        write_text(self.0, variant)?;
        Items::begin(self.0, ":[", "]}")
    }

    fn serialize_map(self, _: Option<usize>) -> Result<Items<'w, W>, JsonError> {
        Items::begin(self.0, "{", "}")
    }

    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Items<'w, W>, JsonError> {
        Items::begin(self.0, "{", "}")
    }

    fn serialize_struct_variant(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        _: usize,
    ) -> Result<Items<'w, W>, JsonError> {
        self.0.write_char('{')?;
        write_text(self.0, variant)?;
        Items::begin(self.0, ":{", "}}")
    }

    fn collect_str<T: fmt::Display + ?Sized>(self, value: &T) -> Result<(), JsonError> {
        Ok(write_text(self.0, value)?)
    }
}

macro_rules! sequences {
    ($($trait:ident $method:ident),*) => {
        $(impl<W: Write> ser::$trait for Items<'_, W> {
            type Ok = ();
            type Error = JsonError;

            fn $method<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), JsonError> {
                self.item(value)
            }

            fn end(self) -> Result<(), JsonError> {
                self.finish()
            }
        })*
    };
}

sequences!(
    SerializeSeq serialize_element,
    SerializeTuple serialize_element,
    SerializeTupleStruct serialize_field,
    SerializeTupleVariant serialize_field
);

macro_rules! structs {
    ($($trait:ident),*) => {
        $(impl<W: Write> ser::$trait for Items<'_, W> {
            type Ok = ();
            type Error = JsonError;

            fn serialize_field<T: Serialize + ?Sized>(&mut self, key: &'static str, value: &T) -> Result<(), JsonError> {
                self.entry(key, value)
            }

            fn end(self) -> Result<(), JsonError> {
                self.finish()
            }
        })*
    };
}

structs!(SerializeStruct, SerializeStructVariant);

impl<W: Write> ser::SerializeMap for Items<'_, W> {
    type Ok = ();
    type Error = JsonError;

    fn serialize_key<T: Serialize + ?Sized>(&mut self, key: &T) -> Result<(), JsonError> {
        self.comma()?;
        key.serialize(JsonKey(&mut *self.out))
    }

    fn serialize_value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), JsonError> {
        self.out.write_char(':')?;
        value.serialize(Json(&mut *self.out))
    }

    fn end(self) -> Result<(), JsonError> {
        self.finish()
    }
}

/// A key of an object, always in quotes.
struct JsonKey<'w, W>(&'w mut W);

macro_rules! keys {
    ($($method:ident: $type:ty),*) => {
        $(fn $method(self, value: $type) -> Result<(), JsonError> {
            Ok(write_text(self.0, value)?)
        })*
    };
}

macro_rules! no_keys {
    ($($method:ident($($arg:ty),*) -> $ok:ty),* $(,)?) => {
        $(fn $method(self, $(_: $arg),*) -> Result<$ok, JsonError> {
            Err(JsonError::Unsupported)
        })*
    };
}

type Never = Impossible<(), JsonError>;

impl<W: Write> Serializer for JsonKey<'_, W> {
    type Ok = ();
    type Error = JsonError;

    compounds!(Never);

    keys!(
        serialize_i8: i8,
        serialize_i16: i16,
        serialize_i32: i32,
        serialize_u8: u8,
        serialize_u16: u16,
        serialize_u32: u32,
        serialize_char: char,
        serialize_str: &str
    );

    fn serialize_i64(self, value: i64) -> Result<(), JsonError> {
        Ok(write_text(self.0, Signed(value))?)
    }

    fn serialize_u64(self, value: u64) -> Result<(), JsonError> {
        Ok(write_text(self.0, Whole(value))?)
    }

    no_keys!(
        serialize_bool(bool) -> (),
        serialize_f32(f32) -> (),
        serialize_f64(f64) -> (),
        serialize_bytes(&[u8]) -> (),
        serialize_none() -> (),
        serialize_unit() -> (),
        serialize_unit_struct(&'static str) -> (),
        serialize_seq(Option<usize>) -> Never,
        serialize_tuple(usize) -> Never,
        serialize_tuple_struct(&'static str, usize) -> Never,
        serialize_tuple_variant(&'static str, u32, &'static str, usize) -> Never,
        serialize_map(Option<usize>) -> Never,
        serialize_struct(&'static str, usize) -> Never,
        serialize_struct_variant(&'static str, u32, &'static str, usize) -> Never,
    );

    fn serialize_some<T: Serialize + ?Sized>(self, _: &T) -> Result<(), JsonError> {
        Err(JsonError::Unsupported)
    }

    fn serialize_unit_variant(self, _: &'static str, _: u32, variant: &'static str) -> Result<(), JsonError> {
        self.serialize_str(variant)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), JsonError> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: &T,
    ) -> Result<(), JsonError> {
        Err(JsonError::Unsupported)
    }

    fn collect_str<T: fmt::Display + ?Sized>(self, value: &T) -> Result<(), JsonError> {
        Ok(write_text(self.0, value)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::Value;
    use std::collections::BTreeMap;
    use std::string::String;
    use std::vec::Vec;

    #[derive(serde::Serialize)]
    enum Any {
        Unit,
        New(i64),
        Tuple(u8, String),
        Struct { one: Option<bool>, two: () },
    }

    #[derive(serde::Serialize)]
    struct All {
        numbers: (u64, i8, f64),
        text: String,
        letter: char,
        list: Vec<Any>,
        by_number: BTreeMap<u16, String>,
        by_text: BTreeMap<String, [u8; 2]>,
    }

    fn written(value: &impl Serialize) -> String {
        let mut text = String::new();
        write(&mut text, value).unwrap();
        text
    }

    proptest! {
        #[test]
        fn it_is_what_another_library_reads_and_writes(
            (number, small, eighths) in any::<(u64, i8, i32)>(),
            text in ".*",
            letter in any::<char>(),
            other in "[\\x00-\\x7f]{0,20}",
        ) {
            let list = std::vec![
                Any::Unit,
                Any::New(i64::MIN),
                Any::Tuple(3, other.clone()),
                Any::Struct { one: Some(true), two: () },
                Any::Struct { one: None, two: () },
            ];
            // The other library reads long numbers inexactly.
            let numbers = (number, small, f64::from(eighths) / 8.0);
            let by_number = [(0, other.clone()), (65535, String::new())].into();
            let by_text = [(other, [1, 2]), (text.clone(), [3, 4])].into();
            let all = All { numbers, text, letter, list, by_number, by_text };
            let ours: Value = serde_json::from_str(&written(&all)).unwrap();
            let theirs: Value = serde_json::from_str(&serde_json::to_string(&all).unwrap()).unwrap();
            prop_assert_eq!(ours, theirs);
        }

        /// Some numbers have two shortest texts of the same length, so the test compares values.
        #[test]
        fn a_number_of_32_bits_is_read_as_the_same(number in any::<f32>()) {
            prop_assert_eq!(written(&number).parse(), Ok(number));
        }

        #[test]
        fn a_number_of_64_bits_is_read_as_the_same(number in any::<f64>()) {
            prop_assert_eq!(written(&number).parse(), Ok(number));
        }
    }

    #[test]
    fn what_is_not_finite_is_null() {
        assert_eq!(
            written(&[f32::NAN, f32::INFINITY, 1.0, 0.1, 1e30, -0.0]),
            "[null,null,1.0,0.1,1e30,-0.0]"
        );
        assert_eq!(written(&f64::NEG_INFINITY), "null");
    }

    #[test]
    fn too_little_room_and_keys_that_are_no_text_are_errors() {
        let mut small = heapless::String::<4>::new();
        assert_eq!(write(&mut small, "1234"), Err(JsonError::NoRoom));
        let map: BTreeMap<Option<u8>, u8> = [(None, 1)].into();
        assert_eq!(write(&mut String::new(), &map), Err(JsonError::Unsupported));
    }
}
