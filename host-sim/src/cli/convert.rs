//! `encode` and `decode`: frames as text to values as text, and back.
//!
//! In: hex bytes or candump lines; or the lines that `decode` prints, which `encode` turns into the same
//! bytes again. Out: the other form.

pub(super) mod codec;
mod device;

use std::collections::BTreeMap;
use std::io::{BufRead, Write};

use proto_core::recipe::{CanReject, Deframer, StreamLayout, datagram};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar;

use super::scale;
use super::text::{self, CanLine, Prefix};
use codec::{CompiledPart, FrameValues, Layout, NamedField};

type CliResult = Result<(), String>;

/// Parses a CAN id: decimal, or hexadecimal with `0x`.
pub(super) fn parse_id(text: &str) -> Result<u32, String> {
    let id = match text.strip_prefix("0x") {
        Some(hex) => u32::from_str_radix(hex, 16),
        None => text.parse(),
    };
    id.map_err(|_| format!("{text:?} is not an id; write 2 or 0x501"))
}

/// Writes the frame with these values.
pub(super) fn encode_values(
    part: &CompiledPart,
    id: Option<u32>,
    values: &[String],
    out: &mut dyn Write,
) -> CliResult {
    let wanted = id.map(Wanted::Number);
    write_line(out, &encode(part, wanted, &Prefix::default(), values)?)
}

/// Writes a frame for each line that `decode` printed, or for each line of values.
pub(super) fn encode_lines(
    part: &CompiledPart,
    id: Option<u32>,
    input: impl BufRead,
    out: &mut dyn Write,
) -> CliResult {
    for (number, line) in numbered(input) {
        let at = |message| format!("line {number}: {message}");
        let line = line.map_err(|error| at(error.to_string()))?;
        if line.trim().is_empty() {
            continue;
        }
        let (prefix, mut tokens) = text::split_prefix(&line).map_err(at)?;
        let mut wanted = id.map(Wanted::Number);
        if part.is_can()
            && let Some(text) = tokens.first().and_then(|token| token.strip_prefix("id="))
        {
            wanted = Some(Wanted::Exactly(text::parse_can_id(text.trim_start_matches("0x")).map_err(at)?));
            tokens.remove(0);
        }
        write_line(out, &encode(part, wanted, &prefix, &tokens).map_err(at)?)?;
    }
    Ok(())
}

/// Writes the values of every frame in `input`; counts other input in `notes`.
pub(super) fn decode_lines(
    part: &CompiledPart,
    input: impl BufRead,
    out: &mut dyn Write,
    notes: &mut dyn Write,
) -> CliResult {
    let frames = match &part.layout {
        Layout::Stream(layout) => decode_stream(part, layout, input, out, notes)?,
        Layout::Datagram(layout) => decode_datagrams(part, layout, input, out, notes)?,
        Layout::Device(device) if !part.is_can() => device.decode_stream(numbered(input), out, notes)?,
        Layout::Can(_) | Layout::Device(_) => decode_can(part, input, out, notes)?,
    };
    if frames == 0 { Err("the input has no frame of this recipe".into()) } else { Ok(()) }
}

/// Selects a frame of a CAN part.
enum Wanted {
    /// From an argument: the recipe decides whether it is a standard or an extended id.
    Number(u32),
    Exactly(CanId),
}

fn encode(
    part: &CompiledPart,
    wanted: Option<Wanted>,
    prefix: &Prefix,
    values: &[String],
) -> Result<String, String> {
    match &part.layout {
        Layout::Stream(layout) | Layout::Datagram(layout) => {
            let Some(frame) = part.frames.first() else { return Err("no fields".into()) };
            let bytes = part.encode_stream(layout, &scalars(frame, values)?)?;
            Ok(text::hex(&bytes))
        }
        Layout::Device(device) if !part.is_can() => Ok(text::hex(&device.encode(0, values)?)),
        Layout::Device(device) => {
            let index = find_frame(part, wanted)?;
            let id = part.frames.get(index).and_then(|frame| frame.id).ok_or("no such frame")?;
            Ok(text::can_line(prefix, id, &device.encode(index, values)?))
        }
        Layout::Can(layout) => {
            let index = find_frame(part, wanted)?;
            let Some(frame) = part.frames.get(index) else { return Err("no such frame".into()) };
            let frame = part.encode_can(layout, index, &scalars(frame, values)?)?;
            Ok(text::can_line(prefix, frame.id(), frame.data()))
        }
    }
}

fn find_frame(part: &CompiledPart, wanted: Option<Wanted>) -> Result<usize, String> {
    let ids = || part.frames.iter().filter_map(|frame| frame.id);
    let known = || ids().map(text::show_id).collect::<Vec<_>>().join(", ");
    let number = |id| match id {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id,
    };
    let (found, shown) = match wanted {
        None if part.frames.len() == 1 => (Some(0), String::new()),
        None => return Err(format!("several frames; choose one with --id ID: {}", known())),
        Some(Wanted::Number(wanted)) => (ids().position(|id| number(id) == wanted), format!("{wanted:#x}")),
        Some(Wanted::Exactly(wanted)) => (ids().position(|id| id == wanted), text::show_id(wanted)),
    };
    found.ok_or_else(|| format!("id {shown} is not in this part; there are {}", known()))
}

/// Parses values in field order or as `NAME=VALUE`; a field's unit may follow its value.
fn scalars(frame: &FrameValues, tokens: &[String]) -> Result<Vec<Scalar>, String> {
    let mut values: Vec<Option<Scalar>> = vec![None; frame.fields.len()];
    let mut newest: Option<&NamedField> = None;
    for token in tokens {
        if newest.take().is_some_and(|field| !field.unit.is_empty() && field.unit == token) {
            continue;
        }
        let (name, text) = match token.split_once('=') {
            Some((name, text)) => (Some(name), text),
            None => (None, token.as_str()),
        };
        let is_meant = |(field, value): (&NamedField, &Option<Scalar>)| {
            value.is_none() && name.is_none_or(|name| name == field.name)
        };
        let place = frame.fields.iter().zip(&values).position(is_meant).ok_or_else(|| {
            let names: Vec<_> = frame.fields.iter().map(|field| field.name.as_str()).collect();
            match name {
                Some(name) if names.contains(&name) => format!("field {name:?} is given twice"),
                Some(name) => format!("there is no field {name:?}; there are {}", names.join(", ")),
                None => format!("too many values, from {text:?} on; the fields are {}", names.join(", ")),
            }
        })?;
        let field = &frame.fields[place];
        values[place] =
            Some(text::parse_scalar(field.ty, text).map_err(|error| format!("{}: {error}", field.name))?);
        newest = Some(field);
    }
    let missing: Vec<_> = frame
        .fields
        .iter()
        .zip(&values)
        .filter(|(_, value)| value.is_none())
        .map(|(field, _)| field.name.as_str())
        .collect();
    if missing.is_empty() {
        Ok(values.into_iter().flatten().collect())
    } else {
        Err(format!("no value for {}", missing.join(", ")))
    }
}

fn decode_stream(
    part: &CompiledPart,
    layout: &StreamLayout,
    input: impl BufRead,
    out: &mut dyn Write,
    notes: &mut dyn Write,
) -> Result<usize, String> {
    let mut deframer = Deframer::new();
    let mut frames = 0;
    for (number, line) in numbered(input) {
        let at = |message| format!("line {number}: {message}");
        let line = line.map_err(|error| at(error.to_string()))?;
        let bytes = text::parse_hex_line(&line).map_err(at)?;
        let mut chunk = &bytes[..];
        while let Some(payload) = deframer.next_frame(layout, &mut chunk) {
            frames += 1;
            show_stream(part, layout, payload, number, out, notes)?;
        }
    }
    let (pending, stats) = (deframer.pending(), deframer.stats());
    if stats.skipped_bytes > 0 {
        note(notes, &format!("{} bytes skipped outside of frames", stats.skipped_bytes));
    }
    if stats.tail_mismatches > 0 {
        note(notes, &format!("{} heads without a tail", stats.tail_mismatches));
    }
    if pending > 0 {
        note(notes, &format!("{pending} bytes of an unfinished frame at the end"));
    }
    Ok(frames)
}

/// One line is one datagram.
fn decode_datagrams(
    part: &CompiledPart,
    layout: &StreamLayout,
    input: impl BufRead,
    out: &mut dyn Write,
    notes: &mut dyn Write,
) -> Result<usize, String> {
    let mut frames = 0;
    for (number, line) in numbered(input) {
        let at = |message| format!("line {number}: {message}");
        let bytes = text::parse_hex_line(&line.map_err(|error| at(error.to_string()))?).map_err(at)?;
        if bytes.is_empty() {
            continue;
        }
        match datagram(layout, &bytes) {
            Ok(payload) => {
                frames += 1;
                show_stream(part, layout, payload, number, out, notes)?;
            }
            Err(error) => note(notes, &at(error.to_string())),
        }
    }
    Ok(frames)
}

fn show_stream(
    part: &CompiledPart,
    layout: &StreamLayout,
    payload: &[u8],
    line: usize,
    out: &mut dyn Write,
    notes: &mut dyn Write,
) -> CliResult {
    if let Err(error) = layout.check(payload) {
        note(notes, &format!("line {line}: a receiver rejects this frame: {error}"));
    }
    match part.frames.first() {
        Some(frame) => {
            note_refused(frame, layout.values(payload), line, notes);
            write_line(out, &show_values(frame, layout.values(payload)))
        }
        None => Ok(()),
    }
}

fn decode_can(
    part: &CompiledPart,
    input: impl BufRead,
    out: &mut dyn Write,
    notes: &mut dyn Write,
) -> Result<usize, String> {
    let mut frames = 0;
    let mut rejected: BTreeMap<String, usize> = BTreeMap::new();
    for (number, line) in numbered(input) {
        let at = |message| format!("line {number}: {message}");
        let line = line.map_err(|error| at(error.to_string()))?;
        let Some(CanLine { prefix, frame }) = text::parse_can_line(&line).map_err(at)? else { continue };
        let shown = match frame {
            Ok(frame) => show_can(part, &frame, number, notes),
            Err(other) => Err(other.to_owned()),
        };
        match shown {
            Ok(values) => {
                frames += 1;
                write_line(out, &format!("{prefix}{values}"))?;
            }
            Err(reason) => *rejected.entry(reason).or_default() += 1,
        }
    }
    for (reason, count) in rejected {
        note(notes, &format!("{count} rejected: {reason}"));
    }
    Ok(frames)
}

fn show_can(
    part: &CompiledPart,
    frame: &CanFrame,
    line: usize,
    notes: &mut dyn Write,
) -> Result<String, String> {
    let layout = match &part.layout {
        Layout::Can(layout) => layout,
        Layout::Device(device) => return device.decode_can(frame, line, notes),
        Layout::Stream(_) | Layout::Datagram(_) => return Err("not a CAN recipe".into()),
    };
    let index = layout.accept(frame).map_err(|reject| match reject {
        CanReject::UnknownId { id } => format!("id {} is not in the recipe", text::show_id(id)),
        CanReject::Remote { id } => format!("id {}: a remote frame", text::show_id(id)),
        CanReject::WrongLength { expected, got, .. } => {
            format!("id {}: {got} bytes instead of {expected}", text::show_id(frame.id()))
        }
        other => format!("{other}"),
    })?;
    let (Some(fields), Some(entry)) = (part.frames.get(index), layout.frame(index)) else {
        return Err("no such frame".into());
    };
    if let Err(error) = entry.check(frame.data()) {
        note(notes, &format!("line {line}: a receiver rejects this frame: {error}"));
    }
    note_refused(fields, entry.values(frame.data()), line, notes);
    let values = show_values(fields, entry.values(frame.data()));
    Ok(format!("id={} {values}", text::show_id(frame.id())))
}

/// Says if a gateway rejects the frame for a value that does not fit its variable.
fn note_refused(
    frame: &FrameValues,
    values: impl Iterator<Item = Scalar>,
    line: usize,
    notes: &mut dyn Write,
) {
    let refused =
        |(field, value): (&NamedField, Scalar)| scale::refused(field.spec.as_ref()?, &field.name, value);
    if let Some(why) = frame.fields.iter().zip(values).find_map(refused) {
        note(notes, &format!("line {line}: a gateway rejects this frame: {why}"));
    }
}

fn show_values(frame: &FrameValues, values: impl Iterator<Item = Scalar>) -> String {
    let shown = frame.fields.iter().zip(values).map(|(field, value)| {
        let unit = if field.unit.is_empty() { String::new() } else { format!(" {}", field.unit) };
        format!("{}={}{unit}", field.name, text::show_scalar(value))
    });
    shown.collect::<Vec<_>>().join(" ")
}

fn numbered<R: BufRead>(input: R) -> impl Iterator<Item = (usize, std::io::Result<String>)> {
    (1..).zip(input.lines())
}

fn write_line(out: &mut dyn Write, line: &str) -> CliResult {
    writeln!(out, "{line}").map_err(|error| error.to_string())
}

/// Writes a note; errors are ignored, since notes are no result.
fn note(notes: &mut dyn Write, message: &str) {
    let _ = writeln!(notes, "{message}");
}

#[cfg(test)]
mod device_tests;
#[cfg(test)]
mod tests;
