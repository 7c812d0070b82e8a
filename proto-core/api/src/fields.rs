//! The fields of a struct of counters, by name: names are written once, in the struct.

use core::fmt;

use serde::ser::{self, Impossible, Serialize, Serializer};

/// Calls `found` with each field that is an unsigned number.
pub(crate) fn each(counters: &impl Serialize, found: impl FnMut(&'static str, u64)) {
    // What has no such fields has none to report.
    let _ = counters.serialize(FieldVisitor(found));
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

struct FieldVisitor<F>(F);

impl<F: FnMut(&'static str, u64)> ser::SerializeStruct for FieldVisitor<F> {
    type Ok = ();
    type Error = NoFields;

    fn serialize_field<T: Serialize + ?Sized>(
        &mut self,
        key: &'static str,
        value: &T,
    ) -> Result<(), NoFields> {
        if let Ok(value) = value.serialize(UnsignedSerializer) {
            (self.0)(key, value);
        }
        Ok(())
    }

    fn end(self) -> Result<(), NoFields> {
        Ok(())
    }
}

/// Takes unsigned numbers alone.
struct UnsignedSerializer;

macro_rules! refused {
    ($ok:ty: $($method:ident($($arg:ty),*)),* $(,)?) => {
        $(fn $method(self, $(_: $arg),*) -> Result<$ok, NoFields> {
            Err(NoFields)
        })*
    };
}

macro_rules! serializer {
    ($type:ty, $ok:ty, $struct:ty, { $($own:item)* }) => {
        type Ok = $ok;
        type Error = NoFields;
        type SerializeSeq = Impossible<$ok, NoFields>;
        type SerializeTuple = Impossible<$ok, NoFields>;
        type SerializeTupleStruct = Impossible<$ok, NoFields>;
        type SerializeTupleVariant = Impossible<$ok, NoFields>;
        type SerializeMap = Impossible<$ok, NoFields>;
        type SerializeStruct = $struct;
        type SerializeStructVariant = Impossible<$ok, NoFields>;

        $($own)*

        refused!($ok: serialize_bool(bool), serialize_i8(i8), serialize_i16(i16), serialize_i32(i32), serialize_i64(i64),
            serialize_f32(f32), serialize_f64(f64), serialize_char(char), serialize_str(&str), serialize_bytes(&[u8]),
            serialize_none(), serialize_unit(), serialize_unit_struct(&'static str),
            serialize_unit_variant(&'static str, u32, &'static str));
        refused!(Impossible<$ok, NoFields>: serialize_seq(Option<usize>), serialize_tuple(usize),
            serialize_tuple_struct(&'static str, usize), serialize_map(Option<usize>),
            serialize_tuple_variant(&'static str, u32, &'static str, usize),
            serialize_struct_variant(&'static str, u32, &'static str, usize));

        fn serialize_some<T: Serialize + ?Sized>(self, _: &T) -> Result<$ok, NoFields> {
            Err(NoFields)
        }

        fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &'static str, _: &T) -> Result<$ok, NoFields> {
            Err(NoFields)
        }

        fn serialize_newtype_variant<T: Serialize + ?Sized>(
            self, _: &'static str, _: u32, _: &'static str, _: &T,
        ) -> Result<$ok, NoFields> {
            Err(NoFields)
        }

        fn collect_str<T: fmt::Display + ?Sized>(self, _: &T) -> Result<$ok, NoFields> {
            Err(NoFields)
        }
    };
}

impl Serializer for UnsignedSerializer {
    serializer!(UnsignedSerializer, u64, Impossible<u64, NoFields>, {
        fn serialize_u8(self, value: u8) -> Result<u64, NoFields> {
            Ok(value.into())
        }

        fn serialize_u16(self, value: u16) -> Result<u64, NoFields> {
            Ok(value.into())
        }

        fn serialize_u32(self, value: u32) -> Result<u64, NoFields> {
            Ok(value.into())
        }

        fn serialize_u64(self, value: u64) -> Result<u64, NoFields> {
            Ok(value)
        }

        fn serialize_struct(self, _: &'static str, _: usize) -> Result<Impossible<u64, NoFields>, NoFields> {
            Err(NoFields)
        }
    });
}

impl<F: FnMut(&'static str, u64)> Serializer for FieldVisitor<F> {
    serializer!(FieldVisitor<F>, (), Self, {
        fn serialize_u8(self, _: u8) -> Result<(), NoFields> {
            Err(NoFields)
        }

        fn serialize_u16(self, _: u16) -> Result<(), NoFields> {
            Err(NoFields)
        }

        fn serialize_u32(self, _: u32) -> Result<(), NoFields> {
            Err(NoFields)
        }

        fn serialize_u64(self, _: u64) -> Result<(), NoFields> {
            Err(NoFields)
        }

        fn serialize_struct(self, _: &'static str, _: usize) -> Result<Self, NoFields> {
            Ok(self)
        }
    });
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
