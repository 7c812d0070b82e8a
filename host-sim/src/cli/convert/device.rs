//! Frames of devices: values by name to bytes, and bytes to values.
//!
//! In: the frames of one part as the file has them. Out: what `encode` and `decode` write. What two
//! frames with the same values can differ in, such as padding, is kept in `raw=`.

use proto_core::config::{DeviceFrame, FieldSpec, InputRule, OutputBinding};
use proto_core::device::{Carrier, Cutter, Digits, Element, Encoding, Found, Framer, Kind, Piece, Probe};
use proto_core::modbus::rtu;
use proto_core::recipe::model::MAX_STREAM_FRAME;
use proto_core::sysvar::Direction;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar;
use recipe_config::{DeviceField, DeviceRecipe, ExchangeKind, FrameEnds, NamedExchange, NamedFrame};

use super::super::{scale, text};
use super::{note, write_line};

/// What keeps the bytes of a frame that its values do not tell.
const RAW: &str = "raw";

/// The frames of one part.
#[derive(Debug)]
pub(in super::super) struct DevicePart {
    direction: Direction,
    ends: FrameEnds,
    formats: Vec<Format>,
}

/// One frame.
#[derive(Debug)]
struct Format {
    id: Option<CanId>,
    frame: DeviceFrame,
    values: Vec<FieldValue>,
    tail: Vec<u8>,
    /// Its ends are known from outside.
    is_whole: bool,
    /// One of its fields is the coil of Modbus function 5.
    has_coil: bool,
}

/// What tells a frame from others.
#[derive(Debug, Clone, Copy, Default)]
struct FormatFlags {
    /// Its ends are known from outside.
    is_whole: bool,
    /// Its constants: there are others with its id.
    is_multiplexed: bool,
}

/// A field with a value.
#[derive(Debug)]
struct FieldValue {
    name: String,
    kind: ValueKind,
    /// What a gateway does with it, each use of its bytes.
    /// Each use of its bytes, with what stands behind it.
    specs: Vec<Vec<FieldSpec>>,
    /// Its elements: more than one if the bytes are used more than once.
    elements: Vec<usize>,
    /// What is sent if nothing else is asked for.
    constant: Option<f64>,
    /// The constant tells the frame from others with the same id, so there is nothing else.
    is_fixed: bool,
}

#[derive(Debug)]
enum ValueKind {
    Number(Encoding),
    Text,
}

/// What a field is to be.
#[derive(Debug, Clone)]
enum Given {
    Number(f64),
    Text(Vec<u8>),
}

/// What a field of a frame is, as it is shown.
struct DecodedFrame {
    shown: String,
    is_finite: bool,
    /// Of a number that the frame has.
    value: Option<Scalar>,
}

impl DevicePart {
    pub(super) fn new(recipe: &DeviceRecipe, direction: Direction) -> Result<Self, String> {
        let ends = recipe.ends(direction);
        let is_whole = ends != FrameEnds::default();
        let part = recipe.part(direction);
        let format = |named: &NamedFrame| {
            let same_id = part.iter().filter(|other| other.id.is_some() && other.id == named.id).count();
            Format::new(
                named,
                recipe.carrier,
                direction,
                FormatFlags { is_whole, is_multiplexed: same_id > 1 },
            )
        };
        let formats = part.iter().map(format).collect::<Result<_, _>>()?;
        Ok(Self { direction, ends, formats })
    }

    /// One frame of an exchange.
    pub(super) fn of_exchange(
        exchange: &NamedExchange,
        named: &NamedFrame,
        is_request: bool,
    ) -> Result<Self, String> {
        if exchange.remote && is_request {
            return Err("a remote request has no data".into());
        }
        // A slave receives requests.
        let direction = match exchange.kind {
            ExchangeKind::Slave(_) if is_request => Direction::Input,
            ExchangeKind::Slave(_) => Direction::Output,
            _ if is_request => Direction::Output,
            _ => Direction::Input,
        };
        let carrier = if named.id.is_some() { Carrier::Can } else { Carrier::Stream };
        let format = Format::new(named, carrier, direction, FormatFlags::default())?;
        Ok(Self { direction, ends: FrameEnds::default(), formats: vec![format] })
    }

    /// Whether it is one frame that has no value to be given.
    pub(super) fn is_constant(&self) -> bool {
        let [format] = &self.formats[..] else { return false };
        format.values.iter().all(|value| value.constant.is_some())
    }

    pub(super) fn ids(&self) -> impl Iterator<Item = Option<CanId>> {
        self.formats.iter().map(|format| format.id)
    }

    /// The bytes of the frame with this index, from values in field order or by name; or of another one
    /// with the same id, if only that can have these values.
    pub(super) fn encode(&self, index: usize, tokens: &[String]) -> Result<Vec<u8>, String> {
        let format = self.formats.get(index).ok_or("no such frame")?;
        let others = self.formats.iter().filter(|other| other.id == format.id);
        let encoded: Vec<_> = others.map(|format| format.encode(tokens)).collect();
        if encoded.iter().filter(|result| result.is_ok()).count() > 1 {
            return Err("several frames with this id can have these values; say which constants it has, by \
                        name"
                .into());
        }
        let first = encoded.first().cloned();
        let found = encoded.into_iter().find(Result::is_ok).or(first);
        let mut bytes = found.unwrap_or(Err("no such frame".into()))?;
        if let Some(escape) = self.ends.escape {
            let len = bytes.len();
            bytes.resize(escape.longest(len), 0);
            let len = escape.stuff(len, &mut bytes).ok_or("the frame is too long")?;
            bytes.truncate(len);
        }
        Ok(bytes)
    }

    /// Writes the values of every frame in a stream, and returns the number of frames.
    pub(super) fn decode_stream(
        &self,
        lines: impl Iterator<Item = (usize, std::io::Result<String>)>,
        out: &mut dyn std::io::Write,
        notes: &mut dyn std::io::Write,
    ) -> Result<usize, String> {
        let format = self.formats.first().ok_or("no such frame")?;
        if let Some(cutter) = Cutter::new(self.ends.boundary, self.ends.escape) {
            return self.decode_pieces(format, cutter, lines, out, notes);
        }
        let effort = format.frame.layout.lengths().1 + format.frame.elements.len();
        let mut framer = Framer::new();
        let mut frames = 0;
        // Bytes of frames with a wrong checksum, which are reported of: all of them, and those that are held.
        let (mut reported, mut held) = (0, 0);
        for (number, line) in lines {
            let at = |message| format!("line {number}: {message}");
            let line = line.map_err(|error| at(error.to_string()))?;
            let bytes = text::parse_hex_line(&line).map_err(at)?;
            let mut chunk = &bytes[..];
            while let Some(found) = framer.next_frame(&mut chunk, effort, |bytes| format.probe(bytes)) {
                held = 0;
                match found {
                    Found::Frame(frame) => match format.show(frame) {
                        Ok(values) => {
                            frames += 1;
                            self.note_values(format, frame, number, notes);
                            write_line(out, &values)?;
                        }
                        Err(why) => note(notes, &at(format!("{}: {why}", text::hex(frame)))),
                    },
                    Found::Other(frame) => {
                        note(notes, &at(format!("{}: other constants, so not this frame", text::hex(frame))));
                    }
                    Found::Wrong(frame) => {
                        reported += frame.len();
                        held = frame.len() - 1;
                        note(notes, &at(format!("{}: {}", text::hex(frame), format.wrong_checksum(frame))));
                    }
                }
            }
        }
        let skipped = (framer.stats().skipped_bytes as usize).saturating_sub(reported);
        if skipped > 0 {
            note(notes, &format!("{skipped} bytes skipped outside of frames"));
        }
        let pending = framer.held().len();
        if pending > held {
            note(notes, &format!("{pending} bytes of an unfinished frame at the end"));
        }
        Ok(frames)
    }

    /// Writes the values of every frame in a stream whose frames do not end by their fields. Silence
    /// is where a line ends.
    fn decode_pieces(
        &self,
        format: &Format,
        mut cutter: Cutter,
        lines: impl Iterator<Item = (usize, std::io::Result<String>)>,
        out: &mut dyn std::io::Write,
        notes: &mut dyn std::io::Write,
    ) -> Result<usize, String> {
        let mut frames = 0;
        for (number, line) in lines {
            let at = |message| format!("line {number}: {message}");
            let line = line.map_err(|error| at(error.to_string()))?;
            let bytes = text::parse_hex_line(&line).map_err(at)?;
            let mut chunk = &bytes[..];
            loop {
                let piece = match cutter.next_piece(&mut chunk, &format.tail) {
                    Some(piece) => piece,
                    None => match cutter.silence() {
                        Some(piece) => piece,
                        None => break,
                    },
                };
                match format.look_at(piece) {
                    Ok((frame, values)) => {
                        frames += 1;
                        self.note_values(format, frame, number, notes);
                        write_line(out, &values)?;
                    }
                    Err(why) => note(notes, &at(why)),
                }
            }
        }
        if cutter.skipped_bytes() > 0 {
            note(notes, &format!("{} bytes skipped outside of frames", cutter.skipped_bytes()));
        }
        if !cutter.held().is_empty() {
            note(notes, &format!("{} bytes of an unfinished frame at the end", cutter.held().len()));
        }
        Ok(frames)
    }

    /// The values of a CAN frame, or why it is none of this part.
    pub(super) fn decode_can(
        &self,
        frame: &CanFrame,
        line: usize,
        notes: &mut dyn std::io::Write,
    ) -> Result<String, String> {
        let id = text::show_id(frame.id());
        let data = frame.data();
        let formats = || self.formats.iter().filter(|format| format.id == Some(frame.id()));
        let fits = |format: &&Format| format.probe(data) == Probe::Frame(data.len());
        let format = formats().find(fits).or_else(|| formats().next());
        let format = format.ok_or_else(|| format!("id {id} is not in the recipe"))?;
        match format.probe(data) {
            Probe::Frame(len) if len == data.len() => {
                let values = format.show(data).map_err(|why| format!("id {id}: {why}"))?;
                self.note_values(format, data, line, notes);
                Ok(format!("id={id} {values}"))
            }
            Probe::Wrong(len) if len == data.len() => {
                note(notes, &format!("line {line}: {}: {}", text::hex(data), format.wrong_checksum(data)));
                Err(format!("id {id}: a wrong checksum"))
            }
            Probe::Other(_) | Probe::No(_) if data.len() == format.frame.layout.lengths().0 => {
                Err(format!("id {id}: other constants, so not this frame"))
            }
            _ => Err(format!("id {id}: {} bytes instead of {}", data.len(), format.frame.layout.lengths().0)),
        }
    }

    /// Says which fields of a frame a gateway rejects for their values.
    fn note_values(&self, format: &Format, frame: &[u8], line: usize, notes: &mut dyn std::io::Write) {
        let Ok(values) = format.values(frame) else { return };
        if self.direction != Direction::Input {
            return;
        }
        let why = |(value, seen): (&FieldValue, DecodedFrame)| {
            let refused = |uses: &Vec<FieldSpec>| scale::refused_field(uses, &value.name, seen.value?);
            match seen.is_finite {
                false => Some(format!("{} is not finite", value.name)),
                true => value.specs.iter().find_map(refused),
            }
        };
        for why in format.values.iter().zip(values).filter_map(why) {
            note(notes, &format!("line {line}: a gateway rejects this field: {why}"));
        }
    }
}

/// A field, and what stands behind it.
fn uses(field: &DeviceField) -> Vec<FieldSpec> {
    [field.spec].into_iter().chain(field.sendable.iter().copied()).collect()
}

/// The fields with a value, each once.
fn values_of(named: &NamedFrame, is_multiplexed: bool) -> Vec<FieldValue> {
    let mut values: Vec<FieldValue> = Vec::new();
    let elements = named.fields.iter().filter_map(|field| Some((field, field.spec.element()?)));
    for (nth, (field, element)) in elements.enumerate() {
        let constant = match field.spec {
            FieldSpec::UserOutput { from: OutputBinding::Constant(value), .. }
            | FieldSpec::DeviceOutput { from: OutputBinding::Constant(value), .. } => Some(value),
            FieldSpec::Fixed { value, .. } if is_multiplexed && !field.name.is_empty() => Some(value as f64),
            FieldSpec::Fixed { .. } | FieldSpec::Padding { .. } | FieldSpec::Length(_) => continue,
            _ => None,
        };
        let kind = match (element.encoding(), element) {
            (Some(encoding), _) => ValueKind::Number(encoding),
            (None, Element::Text(_)) => ValueKind::Text,
            (None, _) => continue,
        };
        match values.last_mut() {
            Some(before) if field.repeats => {
                before.elements.push(nth);
                before.specs.push(uses(field));
            }
            _ => {
                let is_fixed = is_multiplexed && constant.is_some();
                let name = field.name.clone();
                let specs = vec![uses(field)];
                values.push(FieldValue { name, kind, specs, elements: vec![nth], constant, is_fixed });
            }
        }
    }
    values
}

impl Format {
    fn new(
        named: &NamedFrame,
        carrier: Carrier,
        direction: Direction,
        FormatFlags { is_whole, is_multiplexed }: FormatFlags,
    ) -> Result<Self, String> {
        // Cannot fail for the frames of files: reading the file laid them out.
        let frame = named.lay_out(carrier, direction).map_err(|error| error.to_string())?;
        let has_coil = named.fields.iter().any(|field| field.is_coil);
        let (values, tail) = (values_of(named, is_multiplexed), named.tail.clone());
        Ok(Self { id: named.id, frame, values, tail, is_whole, has_coil })
    }

    /// Makes the coil of Modbus function 5 what it is on the line: FF for 1.
    fn switch_coil(&self, frame: &mut [u8]) {
        if !self.has_coil {
            return;
        }
        // Behind slave, function and address; the CRC is the end.
        if let [head @ .., low, high] = frame {
            if let Some(coil) = head.get_mut(4) {
                *coil = if *coil & 1 == 1 { 0xFF } else { 0 };
            }
            [*low, *high] = rtu::checksum(head).to_le_bytes();
        }
    }

    fn probe(&self, bytes: &[u8]) -> Probe {
        let DeviceFrame { layout, elements } = &self.frame;
        if self.is_whole { layout.probe_whole(elements, bytes) } else { layout.probe(elements, bytes) }
    }

    /// The frame that came between two ends, with its values, or why it is none.
    fn look_at<'a>(&self, piece: Piece<'a>) -> Result<(&'a [u8], String), String> {
        let (bytes, why) = match piece {
            Piece::Whole(bytes) => match self.probe(bytes) {
                Probe::Frame(_) => match self.show(bytes) {
                    Ok(values) => return Ok((bytes, values)),
                    Err(why) => (bytes, why),
                },
                Probe::Wrong(_) => (bytes, self.wrong_checksum(bytes)),
                _ => (bytes, "another length or other constants, so not this frame".into()),
            },
            Piece::TooLong(bytes) => (bytes, "longer than any frame".into()),
            Piece::BadEscape(bytes) => (bytes, "then escape bytes that mean nothing".into()),
            Piece::Cut(bytes) => (bytes, "the end of a frame".into()),
        };
        Err(format!("{}: {why}", text::hex(bytes)))
    }

    /// The values of a frame, each once.
    fn values(&self, frame: &[u8]) -> Result<Vec<DecodedFrame>, String> {
        let DeviceFrame { layout, elements } = &self.frame;
        let mut all: Vec<_> = layout.values(elements, frame).collect();
        for value in &self.values {
            let rules = value.specs.iter().flatten();
            let has_comma = rules.clone().any(|rule| *rule == FieldSpec::InputRule(InputRule::Comma));
            let Some(nth) = value.elements.first().copied().filter(|_| has_comma) else { continue };
            let Some(bytes) = layout.bytes_of(elements, frame, nth) else { continue };
            // As it would be with a point.
            let turned: Vec<u8> = bytes.iter().map(|byte| if *byte == b',' { b'.' } else { *byte }).collect();
            if let (ValueKind::Number(encoding), Some(read)) = (&value.kind, all.get_mut(nth)) {
                *read = encoding.read(&turned).map(Some);
            }
        }
        let value = |value: &FieldValue| {
            let nth = value.elements.first().copied().unwrap_or(usize::MAX);
            match (&value.kind, all.get(nth)) {
                (ValueKind::Text, _) => {
                    let text = layout.text(elements, frame, nth);
                    let text = text.ok_or_else(|| format!("{}: no text", value.name))?;
                    Ok(DecodedFrame { shown: text::show_text(text), is_finite: true, value: None })
                }
                (ValueKind::Number(_), Some(Ok(Some(scalar)))) => Ok(DecodedFrame {
                    shown: text::show_scalar(*scalar).to_string(),
                    is_finite: scalar.is_finite(),
                    value: Some(*scalar),
                }),
                // The probe has compared it.
                (_, Some(Ok(None))) if value.is_fixed => {
                    let constant = value.constant.unwrap_or(f64::NAN);
                    Ok(DecodedFrame {
                        shown: text::show_scalar(Scalar::Double(constant)).to_string(),
                        is_finite: true,
                        value: None,
                    })
                }
                (_, Some(Err(error))) => Err(format!("{}: {error}", value.name)),
                _ => Err(format!("{}: no value", value.name)),
            }
        };
        self.values.iter().map(value).collect()
    }

    fn named_values(&self, frame: &[u8]) -> Result<Vec<String>, String> {
        let values = self.values(frame)?;
        let shown = self.values.iter().zip(values);
        Ok(shown.map(|(value, seen)| format!("{}={}", value.name, seen.shown)).collect())
    }

    /// The line that [`Self::encode`] turns into the same bytes.
    fn show(&self, frame: &[u8]) -> Result<String, String> {
        let mut shown = self.named_values(frame)?;
        if self.encode(&shown).ok().as_deref() != Some(frame) || shown.is_empty() {
            let digits: String = frame.iter().map(|byte| format!("{byte:02X}")).collect();
            shown.push(format!("{RAW}={digits}"));
        }
        Ok(shown.join(" "))
    }

    fn encode(&self, tokens: &[String]) -> Result<Vec<u8>, String> {
        let has_raw = self.values.iter().all(|value| value.name != RAW);
        let raw = |token: &&String| has_raw && token.starts_with("raw=");
        if let Some(token) = tokens.iter().find(raw) {
            let bytes = text::parse_hex_line(token.trim_start_matches("raw="))?;
            let others: Vec<&String> = tokens.iter().filter(|token| !raw(token)).collect();
            let is_frame = self.probe(&bytes) == Probe::Frame(bytes.len());
            let same =
                self.named_values(&bytes).is_ok_and(|values| others.is_empty() || values.iter().eq(others));
            return match (is_frame, same) {
                (true, true) => Ok(bytes),
                (false, _) => Err(format!("{token} is not this frame")),
                (true, false) => {
                    Err(format!("{token} has other values; leave it out to make a frame from the values"))
                }
            };
        }
        let given = self.given(tokens)?;
        let mut out = [0; MAX_STREAM_FRAME];
        let of = |nth: usize| {
            let of = self.values.iter().zip(&given).find(|(value, _)| value.elements.contains(&nth));
            of.map(|(_, given)| given)
        };
        let number = |nth: usize| match of(nth) {
            Some(Given::Number(number)) => *number,
            _ => f64::NAN,
        };
        let characters = |nth: usize, out: &mut [u8]| match of(nth) {
            Some(Given::Text(text)) => {
                out.get_mut(..text.len())?.copy_from_slice(text);
                Some(text.len())
            }
            _ => None,
        };
        match self.frame.layout.encode_with(&self.frame.elements, number, characters, &mut out) {
            Some(len) => {
                let mut frame = out.get(..len).unwrap_or(&[]).to_vec();
                self.switch_coil(&mut frame);
                Ok(frame)
            }
            None if self.values.iter().any(|value| matches!(value.kind, ValueKind::Text)) => {
                Err("a text does not fit its field, or a value is not a number".into())
            }
            None => Err("a value is not a number, which no gateway sends".into()),
        }
    }

    /// What each value is to be, given in order or as `NAME=VALUE`. Constants may be left out, and are
    /// given by name only.
    fn given(&self, tokens: &[String]) -> Result<Vec<Given>, String> {
        let mut all: Vec<Option<Given>> = vec![None; self.values.len()];
        for token in tokens {
            let (name, shown) = match token.split_once('=') {
                Some((name, shown)) => (Some(name), shown),
                None => (None, token.as_str()),
            };
            let is_meant = |(value, given): (&FieldValue, &Option<Given>)| {
                given.is_none() && name.map_or(value.constant.is_none(), |name| name == value.name)
            };
            let place = self.values.iter().zip(&all).position(is_meant).ok_or_else(|| {
                let names: Vec<_> = self.values.iter().map(|value| value.name.as_str()).collect();
                match name {
                    Some(name) if names.contains(&name) => format!("field {name:?} is given twice"),
                    Some(name) => format!("there is no field {name:?}; there are {}", names.join(", ")),
                    None => {
                        format!("too many values, from {shown:?} on; the fields are {}", names.join(", "))
                    }
                }
            })?;
            let value = &self.values[place];
            let given = match &value.kind {
                ValueKind::Number(encoding) => parse(encoding, shown).map(Given::Number),
                ValueKind::Text => text::parse_text(shown).map(Given::Text),
            };
            let given = given.map_err(|error| format!("{}: {error}", value.name))?;
            if value.is_fixed && !matches!(given, Given::Number(number) if value.constant == Some(number)) {
                return Err(format!("{}: this frame has another constant", value.name));
            }
            all[place] = Some(given);
        }
        let constant = |value: &FieldValue| value.constant.map(Given::Number);
        let all =
            self.values.iter().zip(&all).map(|(value, given)| given.clone().or_else(|| constant(value)));
        let missing: Vec<_> =
            self.values.iter().zip(all.clone()).filter(|(_, number)| number.is_none()).collect();
        if missing.is_empty() {
            Ok(all.flatten().collect())
        } else {
            let names: Vec<_> = missing.iter().map(|(value, _)| value.name.as_str()).collect();
            Err(format!("no value for {}", names.join(", ")))
        }
    }

    /// What is wrong with the checksum of a frame.
    fn wrong_checksum(&self, frame: &[u8]) -> String {
        match self.frame.layout.checksums(&self.frame.elements, frame) {
            Some((found, right)) => {
                let (found, right) = (text::hex(found), text::hex(&right));
                format!("the checksum is {found} instead of {right}, so a receiver rejects the frame")
            }
            None => "the checksum is wrong, so a receiver rejects the frame".into(),
        }
    }
}

/// A number that a field can have, as decimal or as `0x1F`.
fn parse(encoding: &Encoding, shown: &str) -> Result<f64, String> {
    if let Kind::Scalar(ty) = encoding.kind {
        return text::parse_scalar(ty, shown).map(Scalar::as_f64);
    }
    let number = match shown.strip_prefix("0x").or(shown.strip_prefix("0X")) {
        Some(digits) => u32::from_str_radix(digits, 16).ok().map(f64::from),
        None => shown.parse::<f64>().ok().filter(|number| number.is_finite()),
    };
    let number = number.ok_or_else(|| format!("{shown:?} is not a number"))?;
    let (low, high) = encoding.range();
    if !(low..=high).contains(&number) {
        return Err(format!("{number} does not fit; allowed: {low}..={high}"));
    }
    let decimals = match encoding.kind {
        Kind::Decimal(Digits { decimals, .. }) => decimals,
        _ => 0,
    };
    let scaled = number * 10_f64.powi(i32::from(decimals));
    if (scaled - scaled.round()).abs() > 1e-6 {
        return Err(match decimals {
            0 => format!("{number} is not an integer, but this field must be"),
            _ => format!("{number} has more than {decimals} decimals"),
        });
    }
    Ok(number)
}
