//! The fields of a struct of counters by name, so their names are written only once, in the struct.

use core::fmt;

use serde::ser::{self, Impossible, Serialize, Serializer};

/// Calls `found` with each field that is an unsigned integer.
pub(crate) fn each(counters: &impl Serialize, mut found: impl FnMut(&'static str, u64)) {
    // A type without such fields reports none.
    let _ = counters.serialize(FieldVisitor { field: None, found: &mut found });
}

#[derive(Debug)]
struct NoFields;

impl fmt::Display for NoFields {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("no fields with numbers")
    }
}

impl core::error::Error for NoFields {}

impl ser::Error for NoFields {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self
    }
}

struct FieldVisitor<'f, F> {
    /// `None` for the struct itself.
    field: Option<&'static str>,
    found: &'f mut F,
}

impl<F: FnMut(&'static str, u64)> ser::SerializeStruct for FieldVisitor<'_, F> {
    type Ok = ();
    type Error = NoFields;

    fn serialize_field<T: Serialize + ?Sized>(
        &mut self,
        key: &'static str,
        value: &T,
    ) -> Result<(), NoFields> {
        // Fields that are not unsigned integers are skipped.
        let _ = value.serialize(FieldVisitor { field: Some(key), found: &mut *self.found });
        Ok(())
    }

    fn end(self) -> Result<(), NoFields> {
        Ok(())
    }
}

macro_rules! numbers {
    ($($method:ident($type:ty)),*) => {
        $(fn $method(self, value: $type) -> Result<(), NoFields> {
            self.serialize_u64(value.into())
        })*
    };
}

macro_rules! refused {
    ($ok:ty: $($method:ident($($arg:ty),*)),* $(,)?) => {
        $(fn $method(self, $(_: $arg),*) -> Result<$ok, NoFields> {
            Err(NoFields)
        })*
    };
}

type Never = Impossible<(), NoFields>;

impl<F: FnMut(&'static str, u64)> Serializer for FieldVisitor<'_, F> {
    type Ok = ();
    type Error = NoFields;
    type SerializeSeq = Never;
    type SerializeTuple = Never;
    type SerializeTupleStruct = Never;
    type SerializeTupleVariant = Never;
    type SerializeMap = Never;
    type SerializeStruct = Self;
    type SerializeStructVariant = Never;

    numbers!(serialize_u8(u8), serialize_u16(u16), serialize_u32(u32));

    fn serialize_u64(self, value: u64) -> Result<(), NoFields> {
        (self.found)(self.field.ok_or(NoFields)?, value);
        Ok(())
    }

    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Self, NoFields> {
        if self.field.is_none() { Ok(self) } else { Err(NoFields) }
    }

    refused!((): serialize_bool(bool), serialize_i8(i8), serialize_i16(i16), serialize_i32(i32), serialize_i64(i64),
        serialize_f32(f32), serialize_f64(f64), serialize_char(char), serialize_str(&str), serialize_bytes(&[u8]),
        serialize_none(), serialize_unit(), serialize_unit_struct(&'static str),
        serialize_unit_variant(&'static str, u32, &'static str));
    refused!(Never: serialize_seq(Option<usize>), serialize_tuple(usize),
        serialize_tuple_struct(&'static str, usize), serialize_map(Option<usize>),
        serialize_tuple_variant(&'static str, u32, &'static str, usize),
        serialize_struct_variant(&'static str, u32, &'static str, usize));

    fn serialize_some<T: Serialize + ?Sized>(self, _: &T) -> Result<(), NoFields> {
        Err(NoFields)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &'static str, _: &T) -> Result<(), NoFields> {
        Err(NoFields)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: &T,
    ) -> Result<(), NoFields> {
        Err(NoFields)
    }

    fn collect_str<T: fmt::Display + ?Sized>(self, _: &T) -> Result<(), NoFields> {
        Err(NoFields)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Serialize)]
    struct SampleCounters {
        first: u32,
        text: &'static str,
        second: u8,
    }

    #[test]
    fn fields_come_in_order_and_only_numbers_count() {
        let mut found = std::vec::Vec::new();
        each(&SampleCounters { first: 7, text: "x", second: 8 }, |name, value| found.push((name, value)));
        assert_eq!(found, [("first", 7), ("second", 8)]);
        each(&7_u32, |_, _| panic!("a number has no fields"));
    }
}
