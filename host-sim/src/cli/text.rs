//! Frames and values as text: hex bytes, candump lines, numbers that are read back exactly.

use std::fmt;

use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};

/// What precedes a frame in a log: a time, an interface.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Prefix {
    /// With its parentheses.
    time: Option<String>,
    interface: Option<String>,
}

impl fmt::Display for Prefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for text in [&self.time, &self.interface].into_iter().flatten() {
            write!(f, "{text} ")?;
        }
        Ok(())
    }
}

/// A frame of a CAN log; `Err` names a kind of frame that no recipe accepts.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct CanLine {
    pub(super) prefix: Prefix,
    pub(super) frame: Result<CanFrame, &'static str>,
}

/// Splits a line into time and interface, and the `NAME=VALUE` or values behind them.
pub(super) fn split_prefix(line: &str) -> Result<(Prefix, Vec<String>), String> {
    let (time, rest) = split_time(line)?;
    let mut tokens: Vec<String> = rest.split_whitespace().map(str::to_owned).collect();
    let is_interface =
        |token: &String| token.starts_with(|c: char| c.is_ascii_alphabetic()) && !token.contains(['=', ':']);
    let has_values = tokens.get(1).is_some_and(|token| token.contains('='));
    let interface = (has_values && tokens.first().is_some_and(is_interface)).then(|| tokens.remove(0));
    Ok((Prefix { time, interface }, tokens))
}

fn split_time(line: &str) -> Result<(Option<String>, &str), String> {
    let line = line.trim();
    if !line.starts_with('(') {
        return Ok((None, line));
    }
    let (time, rest) = line.split_once(')').ok_or("a time without ')'")?;
    Ok((Some(format!("{time})")), rest.trim_start()))
}

/// Parses what candump prints, with or without `-L`, and what cansend accepts. `None` for an empty line or
/// a comment.
pub(super) fn parse_can_line(line: &str) -> Result<Option<CanLine>, String> {
    if line.trim().is_empty() || line.trim_start().starts_with('#') {
        return Ok(None);
    }
    let (time, rest) = split_time(line)?;
    let tokens: Vec<&str> = rest.split_whitespace().collect();
    let not_can = || {
        format!(
            "{:?} is not a CAN frame; write 123#AABB, (time) can0 123#AABB, or can0 123 [2] AA BB",
            line.trim()
        )
    };
    let (interface, frame) = match tokens.as_slice() {
        [frame, ..] if frame.contains('#') => (None, parse_compact(frame)?),
        [interface, frame, ..] if frame.contains('#') => (Some(*interface), parse_compact(frame)?),
        [interface, id, len, data @ ..] => {
            let len = len
                .strip_prefix('[')
                .and_then(|len| len.strip_suffix(']'))
                .and_then(|len| len.parse::<usize>().ok())
                .ok_or_else(not_can)?;
            (Some(*interface), parse_columns(id, len, data)?)
        }
        _ => return Err(not_can()),
    };
    let prefix = Prefix { time, interface: interface.map(str::to_owned) };
    Ok(Some(CanLine { prefix, frame }))
}

type FrameOrNot = Result<CanFrame, &'static str>;

const FD: &str = "a CAN FD frame";
const ERROR: &str = "an error frame";
const REMOTE: &str = "a remote frame";

/// `123#AABB`, `123#R`, `123##1AABB`.
fn parse_compact(text: &str) -> Result<FrameOrNot, String> {
    let (id, data) = text.split_once('#').ok_or("no '#'")?;
    if data.starts_with('#') {
        return Ok(Err(FD));
    }
    if is_error(id) {
        return Ok(Err(ERROR));
    }
    let id = parse_can_id(id)?;
    if data.starts_with(['R', 'r']) {
        return Ok(Err(REMOTE));
    }
    let bytes = parse_hex(&data.replace('.', ""))?;
    CanFrame::new(id, &bytes).map(Ok).ok_or_else(|| format!("{text:?}: more than 8 bytes"))
}

/// `123   [2]  AA BB`.
fn parse_columns(id: &str, len: usize, data: &[&str]) -> Result<FrameOrNot, String> {
    if is_error(id) {
        return Ok(Err(ERROR));
    }
    let id = parse_can_id(id)?;
    if data.first().is_some_and(|word| word.eq_ignore_ascii_case("remote")) {
        return Ok(Err(REMOTE));
    }
    if len > 8 {
        return Ok(Err(FD));
    }
    // An ASCII column may follow the bytes.
    let bytes = data.get(..len).ok_or_else(|| format!("fewer than {len} bytes"))?;
    let bytes = parse_hex(&bytes.concat())?;
    CanFrame::new(id, &bytes).map(Ok).ok_or_else(|| "more than 8 bytes".into())
}

/// candump marks an error frame by a bit above the 29 bits of an id.
fn is_error(id: &str) -> bool {
    id.len() == 8 && u32::from_str_radix(id, 16).is_ok_and(|id| id & 0x2000_0000 != 0)
}

/// As in candump, up to three hexadecimal digits are a standard id, eight an extended one.
pub(super) fn parse_can_id(digits: &str) -> Result<CanId, String> {
    let refused =
        || format!("{digits:?} is not a CAN id; write three hexadecimal digits, or eight for an extended id");
    let id = u32::from_str_radix(digits, 16).map_err(|_| refused())?;
    let id = match digits.len() {
        1..=3 => CanId::Standard(id as u16),
        8 => CanId::Extended(id),
        _ => return Err(refused()),
    };
    if id.is_valid() { Ok(id) } else { Err(refused()) }
}

/// `0x123` or `0x00000123`.
pub(super) fn show_id(id: CanId) -> String {
    match id {
        CanId::Standard(id) => format!("0x{id:03X}"),
        CanId::Extended(id) => format!("0x{id:08X}"),
    }
}

/// A frame in candump's log format if there is a time, in its screen format if there is only an interface,
/// otherwise in cansend's format.
pub(super) fn can_line(prefix: &Prefix, id: CanId, data: &[u8]) -> String {
    let digits = show_id(id).split_off(2);
    let compact = || data.iter().map(|byte| format!("{byte:02X}")).collect::<String>();
    match (&prefix.time, &prefix.interface) {
        (None, Some(interface)) => format!("  {interface}  {digits}   [{}]  {}", data.len(), hex(data)),
        _ => format!("{prefix}{digits}#{}", compact()),
    }
}

/// Hex bytes with spaces between them.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// Parses hex bytes with or without spaces, commas and `0x`; skips comments and the headers of `socat -x`.
pub(super) fn parse_hex_line(line: &str) -> Result<Vec<u8>, String> {
    if line.trim_start().starts_with(['#', '<', '>']) {
        return Ok(Vec::new());
    }
    let mut bytes = Vec::new();
    for token in line.split([' ', '\t', ',', '\r']).filter(|token| !token.is_empty()) {
        bytes.extend(parse_hex(token.strip_prefix("0x").unwrap_or(token))?);
    }
    Ok(bytes)
}

fn parse_hex(digits: &str) -> Result<Vec<u8>, String> {
    let refused = || format!("{digits:?} is not hexadecimal with two digits for each byte");
    if !digits.is_ascii() || !digits.len().is_multiple_of(2) {
        return Err(refused());
    }
    let byte = |pair: &[u8]| {
        let digit = |digit: u8| char::from(digit).to_digit(16);
        Some((digit(*pair.first()?)? * 16 + digit(*pair.last()?)?) as u8)
    };
    digits.as_bytes().chunks(2).map(|pair| byte(pair).ok_or_else(refused)).collect()
}

/// A value in the form that [`parse_scalar`] reads back exactly.
pub(super) fn show_scalar(value: Scalar) -> String {
    match value {
        Scalar::Float(v) if v.is_nan() => format!("nan:{:#010X}", v.to_bits()),
        Scalar::Double(v) if v.is_nan() => format!("nan:{:#018X}", v.to_bits()),
        other => other.to_string(),
    }
}

/// A text without blanks: `\x20` is a byte that is no letter, digit or sign of ASCII.
pub(super) fn show_text(text: &[u8]) -> String {
    let show = |&byte: &u8| match byte {
        b'\\' => "\\\\".to_owned(),
        _ if byte.is_ascii_graphic() => char::from(byte).to_string(),
        _ => format!("\\x{byte:02X}"),
    };
    text.iter().map(show).collect()
}

/// Parses what [`show_text`] writes.
pub(super) fn parse_text(shown: &str) -> Result<Vec<u8>, String> {
    let mut text = Vec::new();
    let mut rest = shown.as_bytes();
    while let Some((&byte, behind)) = rest.split_first() {
        rest = behind;
        if byte != b'\\' {
            text.push(byte);
            continue;
        }
        let digits = |two: &[u8]| u8::from_str_radix(std::str::from_utf8(two).ok()?, 16).ok();
        let (byte, behind) = match rest {
            [b'\\', behind @ ..] => (Some(b'\\'), behind),
            [b'x', high, low, behind @ ..] => (digits(&[*high, *low]), behind),
            _ => (None, rest),
        };
        rest = behind;
        text.push(byte.ok_or_else(|| format!("{shown:?}: a backslash stands only in \\\\ and \\x20"))?);
    }
    Ok(text)
}

/// Parses a value of type `ty`: decimal, `0x1F` for integers, `inf` and `nan:0x7FC00000` for floats.
pub(super) fn parse_scalar(ty: ScalarType, text: &str) -> Result<Scalar, String> {
    let not_a_number = || format!("{text:?} is not a number");
    match ty {
        ScalarType::Float | ScalarType::Double => parse_float(ty, text).ok_or_else(not_a_number),
        _ => {
            let number = match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
                Some(digits) => u32::from_str_radix(digits, 16).ok().map(f64::from),
                None => text.parse::<f64>().ok(),
            };
            Scalar::from_f64(ty, number.ok_or_else(not_a_number)?).map_err(|error| error.to_string())
        }
    }
}

fn parse_float(ty: ScalarType, text: &str) -> Option<Scalar> {
    let bits = text.strip_prefix("nan:").map(|bits| bits.trim_start_matches("0x").trim_start_matches("0X"));
    let is_infinity = text.trim_start_matches(['-', '+']) == "inf";
    // Parsing a float as a double would round twice.
    if ty == ScalarType::Float {
        let value = match bits {
            Some(bits) => f32::from_bits(u32::from_str_radix(bits, 16).ok()?),
            None => text.parse::<f32>().ok()?,
        };
        let is_meant = value.is_finite() || is_infinity || bits.is_some();
        return is_meant.then_some(Scalar::Float(value));
    }
    let value = match bits {
        Some(bits) => f64::from_bits(u64::from_str_radix(bits, 16).ok()?),
        None => text.parse::<f64>().ok()?,
    };
    (value.is_finite() || is_infinity || bits.is_some()).then_some(Scalar::Double(value))
}
