//! Frames on a stream, whose fields are known at run time only: what a user writes around nom, binrw and deku, which
//! read fields but find no frames.

use std::io::Cursor;

use binrw::BinRead;
use deku::prelude::*;
use nom::IResult;
use nom::number::complete::{le_f32, le_f64, le_i32, le_u8, le_u16};

use crate::workload::{FRAME, HEAD, PAYLOAD, Stream, TAIL};

/// The type of a field.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(dead_code, reason = "a file could name each of them")]
pub(crate) enum Kind {
    Byte,
    Word,
    Int,
    Float,
    Double,
}

/// What reads one field from the front of some bytes, and gives what is left.
pub(crate) type Read = fn(&[u8], Kind) -> Option<(f64, &[u8])>;

/// The line of the benchmark, and what waits for the end of a frame.
pub(crate) struct Line {
    line: Vec<u8>,
    chunks: Vec<usize>,
    kinds: Vec<Kind>,
    held: Vec<u8>,
    values: Vec<f64>,
}

impl Line {
    pub(crate) fn new() -> Self {
        let (line, chunks) = Stream::frames().into_line();
        let kinds = std::hint::black_box(vec![Kind::Float; PAYLOAD / 4]);
        let mut new = Self { line, chunks, kinds, held: Vec::with_capacity(4 * FRAME), values: Vec::new() };
        let last_values = [nom, binrw, deku].map(|read: Read| {
            new.decode(read);
            new.values.clone()
        });
        assert!(
            last_values.iter().all(|values| *values == last_values[0] && values.len() == new.kinds.len())
        );
        new
    }

    /// Finds every frame and keeps its values.
    pub(crate) fn decode(&mut self, read: Read) -> usize {
        let mut frames = 0;
        let mut rest = &self.line[..];
        for &size in &self.chunks {
            let chunk;
            (chunk, rest) = rest.split_at(size);
            self.held.extend_from_slice(chunk);
            let mut done = 0;
            loop {
                let bytes = &self.held[done..];
                let Some(at) = bytes.windows(HEAD.len()).position(|window| window == HEAD) else {
                    // The last byte may be the first one of a head.
                    done += bytes.len().saturating_sub(HEAD.len() - 1);
                    break;
                };
                done += at;
                let Some(frame) = self.held.get(done..done + FRAME) else { break };
                let (payload, tail) = frame[HEAD.len()..].split_at(PAYLOAD);
                if tail == TAIL && take(payload, &self.kinds, read, &mut self.values) {
                    frames += 1;
                    done += FRAME;
                } else {
                    done += 1;
                }
            }
            self.held.drain(..done);
        }
        frames
    }
}

#[inline]
fn take(mut payload: &[u8], kinds: &[Kind], read: Read, values: &mut Vec<f64>) -> bool {
    values.clear();
    for &kind in kinds {
        let Some((value, rest)) = read(payload, kind) else { return false };
        values.push(value);
        payload = rest;
    }
    payload.is_empty()
}

pub(crate) fn nom(bytes: &[u8], kind: Kind) -> Option<(f64, &[u8])> {
    let read: IResult<&[u8], f64> = match kind {
        Kind::Byte => le_u8(bytes).map(|(rest, value)| (rest, f64::from(value))),
        Kind::Word => le_u16(bytes).map(|(rest, value)| (rest, f64::from(value))),
        Kind::Int => le_i32(bytes).map(|(rest, value)| (rest, f64::from(value))),
        Kind::Float => le_f32(bytes).map(|(rest, value)| (rest, f64::from(value))),
        Kind::Double => le_f64(bytes),
    };
    read.ok().map(|(rest, value)| (value, rest))
}

// An enum whose variants assert the kind takes 14 times as many instructions: each that does not fit makes an error.
pub(crate) fn binrw(bytes: &[u8], kind: Kind) -> Option<(f64, &[u8])> {
    let mut cursor = Cursor::new(bytes);
    let value = match kind {
        Kind::Byte => u8::read_le(&mut cursor).map(f64::from),
        Kind::Word => u16::read_le(&mut cursor).map(f64::from),
        Kind::Int => i32::read_le(&mut cursor).map(f64::from),
        Kind::Float => f32::read_le(&mut cursor).map(f64::from),
        Kind::Double => f64::read_le(&mut cursor),
    };
    let read = usize::try_from(cursor.position()).ok()?;
    Some((value.ok()?, bytes.get(read..)?))
}

#[derive(DekuRead)]
#[deku(ctx = "kind: Kind", id = "kind", endian = "little")]
enum DekuValue {
    #[deku(id = "Kind::Byte")]
    Byte(u8),
    #[deku(id = "Kind::Word")]
    Word(u16),
    #[deku(id = "Kind::Int")]
    Int(i32),
    #[deku(id = "Kind::Float")]
    Float(f32),
    #[deku(id = "Kind::Double")]
    Double(f64),
}

pub(crate) fn deku(bytes: &[u8], kind: Kind) -> Option<(f64, &[u8])> {
    let mut cursor = deku::no_std_io::Cursor::new(bytes);
    let mut reader = Reader::new(&mut cursor);
    let value = match DekuValue::from_reader_with_ctx(&mut reader, kind).ok()? {
        DekuValue::Byte(value) => f64::from(value),
        DekuValue::Word(value) => f64::from(value),
        DekuValue::Int(value) => f64::from(value),
        DekuValue::Float(value) => f64::from(value),
        DekuValue::Double(value) => value,
    };
    let read = reader.bits_read / 8;
    Some((value, bytes.get(read..)?))
}
