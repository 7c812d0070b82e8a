//! The encoding of Protocol Buffers, as far as payloads of Sparkplug B need it.
//!
//! In: fields, or received bytes. Out: bytes, or their fields, one after the other. The reader is strict: it stops at a
//! field that is cut off or has an unknown wire type.

use crate::bytes::ByteWriter;

/// Writes a number in groups of seven bits, the lowest first.
pub(crate) fn varint(out: &mut ByteWriter<'_>, mut value: u64) {
    while value > 0x7F {
        // The cast keeps the low byte, and the mask its lowest seven bits.
        out.byte((value & 0x7F) as u8 | 0x80);
        value >>= 7;
    }
    out.byte((value & 0x7F) as u8);
}

fn key(out: &mut ByteWriter<'_>, field: u8, form: u8) {
    varint(out, u64::from(field) << 3 | u64::from(form));
}

/// Writes a field with an integer.
pub(crate) fn number(out: &mut ByteWriter<'_>, field: u8, value: u64) {
    key(out, field, VARINT);
    varint(out, value);
}

pub(crate) fn float(out: &mut ByteWriter<'_>, field: u8, value: f32) {
    key(out, field, FIXED32);
    out.put(&value.to_le_bytes());
}

pub(crate) fn double(out: &mut ByteWriter<'_>, field: u8, value: f64) {
    key(out, field, FIXED64);
    out.put(&value.to_le_bytes());
}

/// Writes a field with text or bytes.
pub(crate) fn bytes(out: &mut ByteWriter<'_>, field: u8, value: &[u8]) {
    key(out, field, LENGTH);
    varint(out, value.len() as u64);
    out.put(value);
}

/// Writes a field with an embedded message. Calls `write` twice: to measure and to write.
pub(crate) fn message(out: &mut ByteWriter<'_>, field: u8, write: impl Fn(&mut ByteWriter<'_>)) {
    key(out, field, LENGTH);
    varint(out, ByteWriter::count(&write) as u64);
    write(out);
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ProtobufField<'a> {
    Number(u64),
    /// Four or eight bytes.
    Fixed,
    /// Text, bytes or a message.
    Bytes(&'a [u8]),
}

/// The bytes are no valid message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Malformed;

/// The fields of a message with their numbers. Ends after the first error.
#[derive(Debug, Clone)]
pub(crate) struct ProtobufFields<'a> {
    rest: &'a [u8],
}

impl<'a> ProtobufFields<'a> {
    pub(crate) const fn of(message: &'a [u8]) -> Self {
        Self { rest: message }
    }

    fn varint(&mut self) -> Result<u64, Malformed> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let (&byte, rest) = self.rest.split_first().ok_or(Malformed)?;
            self.rest = rest;
            let bits = u64::from(byte & 0x7F);
            // The tenth byte has room for one bit.
            if shift == 63 && bits > 1 {
                return Err(Malformed);
            }
            value |= bits.checked_shl(shift).unwrap_or(0);
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(Malformed)
    }

    fn take(&mut self, len: usize) -> Result<&'a [u8], Malformed> {
        let (taken, rest) = self.rest.split_at_checked(len).ok_or(Malformed)?;
        self.rest = rest;
        Ok(taken)
    }

    fn field(&mut self) -> Result<(u64, ProtobufField<'a>), Malformed> {
        let key = self.varint()?;
        let field = match (key & 7) as u8 {
            VARINT => ProtobufField::Number(self.varint()?),
            FIXED64 => self.take(8).map(|_| ProtobufField::Fixed)?,
            FIXED32 => self.take(4).map(|_| ProtobufField::Fixed)?,
            LENGTH => {
                let len = usize::try_from(self.varint()?).map_err(|_| Malformed)?;
                ProtobufField::Bytes(self.take(len)?)
            }
            _ => return Err(Malformed),
        };
        match key >> 3 {
            0 => Err(Malformed),
            number => Ok((number, field)),
        }
    }
}

impl<'a> Iterator for ProtobufFields<'a> {
    type Item = Result<(u64, ProtobufField<'a>), Malformed>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        let field = self.field();
        if field.is_err() {
            self.rest = &[];
        }
        Some(field)
    }
}

/// Wire types.
const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const LENGTH: u8 = 2;
const FIXED32: u8 = 5;

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    fn written(write: impl Fn(&mut ByteWriter<'_>)) -> Vec<u8> {
        let mut buf = [0xA5; 64];
        let mut out = ByteWriter::new(&mut buf);
        write(&mut out);
        let bytes = out.finish().unwrap().to_vec();
        assert_eq!(bytes.len(), ByteWriter::count(&write));
        bytes
    }

    #[test]
    fn fields_have_the_bytes_of_the_specification() {
        assert_eq!(written(|out| number(out, 1, 150)), [0x08, 0x96, 0x01]);
        assert_eq!(written(|out| bytes(out, 2, b"testing")), b"\x12\x07testing");
        assert_eq!(written(|out| message(out, 3, |out| number(out, 1, 150))), [0x1A, 3, 0x08, 0x96, 0x01]);
        assert_eq!(written(|out| float(out, 12, 1.0)), [0x65, 0, 0, 0x80, 0x3F]);
        assert_eq!(written(|out| double(out, 13, 1.0)), [0x69, 0, 0, 0, 0, 0, 0, 0xF0, 0x3F]);
        assert_eq!(written(|out| varint(out, u64::MAX)).len(), 10);
    }

    #[test]
    fn what_is_written_is_read_and_mistakes_end_it() {
        let message = written(|out| {
            number(out, 1, u64::MAX);
            bytes(out, 2, b"a");
            float(out, 12, 0.5);
            double(out, 13, 0.5);
        });
        let fields: Result<Vec<_>, _> = ProtobufFields::of(&message).collect();
        let expected = [
            (1, ProtobufField::Number(u64::MAX)),
            (2, ProtobufField::Bytes(b"a")),
            (12, ProtobufField::Fixed),
            (13, ProtobufField::Fixed),
        ];
        assert_eq!(fields.unwrap(), expected);
        for wrong in [
            &[0x08][..],
            &[0x0A, 2, 0],
            &[0x0B],
            &[0x00, 0],
            &[0x65, 0, 0],
            &[0x08, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x02],
            &[0x08, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0],
        ] {
            let mut fields = ProtobufFields::of(wrong);
            assert_eq!((fields.next(), fields.next()), (Some(Err(Malformed)), None), "{wrong:?}");
        }
    }
}
