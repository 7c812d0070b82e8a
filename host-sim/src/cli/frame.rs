//! The frames of a device as `check` draws them: which bytes are what.

use proto_core::config::{DeviceFrame, FieldSpec, OutputBinding, Words};
use proto_core::device::{
    Algorithm, Bits, Boundary, ByteOrder, Carrier, Checksum, Counts, Digits, Encoding, Escape, Kind, Length,
    Place, Text, TextWidth, Width,
};
use proto_core::modbus::adu::HEADER_LEN;
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;
use recipe_config::{DeviceField, DeviceRecipe, FrameEnds, NamedFrame};
use serde::Serialize;

use super::{scale, text};

/// One line of the picture.
#[derive(Debug, Serialize)]
pub(super) struct FrameRow {
    /// `0`, `0..1`, `2..` for a length that varies, or `then` behind that.
    bytes: String,
    name: String,
    is: String,
}

/// The frames of one part.
#[derive(Debug, Default, Serialize)]
pub(super) struct Picture {
    /// What tells frames apart, if the fields do not.
    #[serde(skip_serializing_if = "Option::is_none")]
    ends: Option<&'static str>,
    frames: Vec<FrameTable>,
}

/// One frame.
#[derive(Debug, Serialize)]
struct FrameTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    rows: Vec<FrameRow>,
}

/// The rows of a frame of a Modbus line as it is over TCP: a header in front, and no checksum at the end.
pub(super) fn over_tcp(mut rows: Vec<FrameRow>) -> Vec<FrameRow> {
    // Without the unit id, which is the address of the slave.
    const HEADER: usize = HEADER_LEN - 1;
    rows.pop();
    for row in &mut rows {
        let places = row.bytes.split("..").map(|place| place.parse::<usize>().map(|place| place + HEADER));
        if let Ok(places) = places.collect::<Result<Vec<_>, _>>() {
            row.bytes = places.iter().map(ToString::to_string).collect::<Vec<_>>().join("..");
        }
    }
    let is = "transaction id, 0 and length, 2 bytes each".to_owned();
    rows.insert(0, FrameRow { bytes: format!("0..{}", HEADER - 1), name: "header".to_owned(), is });
    rows
}

/// The frames of one part, a line for each run of bytes.
pub(super) fn picture(recipe: &DeviceRecipe, part: Direction) -> Picture {
    let ends = match recipe.ends(part) {
        FrameEnds { escape: Some(Escape::Dle), .. } => Some("between DLE STX and DLE ETX"),
        FrameEnds { escape: Some(Escape::Slip), .. } => Some("with the escape bytes of SLIP"),
        FrameEnds { escape: Some(Escape::Cobs), .. } => Some("with the escape bytes of COBS"),
        FrameEnds { boundary: Boundary::Tail, .. } => Some("up to each tail"),
        FrameEnds { boundary: Boundary::Silence, .. } => Some("between silences of the line"),
        FrameEnds { boundary: Boundary::Fields, .. } => None,
    };
    let frame = |frame: &NamedFrame| FrameTable {
        id: frame.id.map(text::show_id),
        rows: rows(frame, recipe.carrier, part),
    };
    Picture { ends, frames: recipe.part(part).iter().map(frame).collect() }
}

impl Picture {
    /// As text.
    pub(super) fn show(&self) -> String {
        let mut report = self.ends.map_or_else(String::new, |ends| format!("    {ends}:\n"));
        for frame in &self.frames {
            if let Some(id) = &frame.id {
                report += &format!("    id {id}\n");
            }
            report += &show_rows(&frame.rows);
        }
        report
    }
}

/// Aligned lines.
pub(super) fn show_rows(rows: &[FrameRow]) -> String {
    let width = |column: fn(&FrameRow) -> &String| {
        rows.iter().map(|row| column(row).chars().count()).max().unwrap_or(0)
    };
    let (places, names) = (width(|row| &row.bytes), width(|row| &row.name));
    let show =
        |FrameRow { bytes, name, is }: &FrameRow| format!("    {bytes:places$}  {name:names$}  {is}\n");
    rows.iter().map(show).collect()
}

/// A line for each run of bytes of one frame.
pub(super) fn rows(frame: &NamedFrame, carrier: Carrier, part: Direction) -> Vec<FrameRow> {
    // Cannot fail: reading the file laid out the same frames.
    frame.lay_out(carrier, part).map_or_else(|_| Vec::new(), |laid_out| laid_out_rows(frame, &laid_out, part))
}

fn laid_out_rows(frame: &NamedFrame, laid_out: &DeviceFrame, part: Direction) -> Vec<FrameRow> {
    let mut places = Vec::new();
    laid_out.layout.parts(&laid_out.elements, |_, place| places.push(place));
    // Head, fields with the checksum among them, tail: as below.
    let mut places = places.into_iter();
    let mut rows = Vec::new();
    let mut add = |place: Option<Place>, name: &str, what: String| {
        let bytes = place.map(show_place).unwrap_or_default();
        rows.push(FrameRow { bytes, name: name.to_owned(), is: what });
    };
    if !frame.head.is_empty() {
        add(places.next(), "head", text::hex(&frame.head));
    }
    let mut fields = &frame.fields[..];
    while let Some((field, rest)) = fields.split_first() {
        fields = rest;
        let place = places.next();
        let text = text_of(std::iter::once(field).chain(rest));
        if text.len() > 1 {
            let place = place.map(|place| Place { len: Some(text.len()), ..place });
            add(place, "text", format!("{text:?}"));
            fields = &rest[text.len() - 1..];
            places.nth(text.len() - 2);
            continue;
        }
        match field.spec {
            FieldSpec::Checksum(sum) => add(place, "checksum", show_checksum(&sum)),
            FieldSpec::Padding { fill, .. } => {
                let what = match part {
                    Direction::Input => "any bytes".to_owned(),
                    Direction::Output => format!("{fill:02X}"),
                };
                add(place, "padding", what);
            }
            FieldSpec::TextInput { text, to, ignored, .. } => {
                let to = to.map_or(String::new(), |words| format!(" -> {}", show_words(words)));
                let ignored: Vec<_> =
                    ignored.iter().map(|text| format!("{:?}", String::from_utf8_lossy(text))).collect();
                let but =
                    if ignored.is_empty() { String::new() } else { format!(", but {}", ignored.join(", ")) };
                add(place, &field.name, format!("{}{to}{but}", show_text(&text)));
            }
            FieldSpec::TextOutput { text, from, .. } => {
                add(place, &field.name, format!("{} <- {}", show_text(&text), show_words(from)));
            }
            FieldSpec::Length(length) => add(place, &field.name, show_length(&length)),
            _ if field.is_coil => {
                add(place, &field.name, format!("FF for 1, 00 for 0{}", show_use(field)));
            }
            spec => {
                let Some(encoding) = spec.element().and_then(|element| element.encoding()) else { continue };
                let uses = if field.commands.is_some() { " -> commands".to_owned() } else { show_use(field) };
                add(place, &field.name, show_encoding(&encoding) + uses.as_str());
            }
        }
    }
    if !frame.tail.is_empty() {
        add(places.next(), "tail", text::hex(&frame.tail));
    }
    rows
}

/// `0`, `0..1`, `2..` for a length that varies, or `then` behind that.
fn show_place(place: Place) -> String {
    match (place.at, place.len) {
        (Some(at), Some(1)) => at.to_string(),
        (Some(at), Some(len)) => format!("{at}..{}", at + len - 1),
        (Some(at), None) => format!("{at}.."),
        (None, _) => "then".into(),
    }
}

/// The characters that constant bytes without names at the front are.
fn text_of<'f>(fields: impl Iterator<Item = &'f DeviceField>) -> String {
    let byte = |field: &DeviceField| match field.spec {
        FieldSpec::Fixed { encoding, value } if encoding == Encoding::scalar(ScalarType::Byte) => {
            let byte = u8::try_from(value).ok().filter(|byte| byte.is_ascii_graphic() || *byte == b' ')?;
            field.name.is_empty().then_some(char::from(byte))
        }
        _ => None,
    };
    fields.map_while(byte).collect()
}

fn show_text(text: &Text) -> String {
    match text.width {
        TextWidth::Fixed(1) => "text, 1 character".to_owned(),
        TextWidth::Fixed(count) => format!("text, {count} characters"),
        TextWidth::Until(end) => format!("text, characters up to {:?}", char::from(end)),
        TextWidth::Rest => "text, all that is left".to_owned(),
    }
}

fn show_length(length: &Length) -> String {
    let counts = match length.counts {
        Counts::Rest => "of what follows",
        Counts::Frame => "of the frame",
        Counts::Fields => "of the fields behind it",
    };
    let plus = match length.plus {
        0 => String::new(),
        plus => format!(", plus {plus}"),
    };
    format!("{}, the length {counts}{plus}", show_encoding(&length.encoding))
}

/// The registers of a text.
fn show_words(words: Words) -> String {
    match words.iter().last().filter(|_| words.count > 1) {
        Some(last) => format!("{} to {last}", words.first),
        None => words.first.to_string(),
    }
}

fn show_encoding(encoding: &Encoding) -> String {
    let order = match (encoding.order, encoding.size()) {
        (_, None | Some(1)) => "",
        _ if matches!(encoding.kind, Kind::Decimal(_) | Kind::Hex(_)) => "",
        (ByteOrder::Little, _) => ", little-endian",
        (ByteOrder::Big, _) => ", big-endian",
        (ByteOrder::BigSwapped, _) => ", big-endian, low word first",
        (ByteOrder::LittleSwapped, _) => ", little-endian, high word first",
    };
    let width = |width| match width {
        Width::Fixed(1) => "1 character".to_owned(),
        Width::Fixed(count) => format!("{count} characters"),
        Width::Until(end) => format!("characters up to {:?}", char::from(end)),
    };
    let kind = match encoding.kind {
        Kind::Scalar(ty) => ty.name().to_owned(),
        Kind::Uint24 => "uint24".into(),
        Kind::Int24 => "int24".into(),
        Kind::Bcd { bytes } => format!("BCD, {} digits", 2 * bytes),
        Kind::Hex(digits) => format!("hexadecimal, {}", width(digits)),
        Kind::Decimal(Digits { width: digits, decimals: 0 }) => format!("decimal, {}", width(digits)),
        Kind::Decimal(Digits { width: digits, decimals }) => {
            format!("decimal, {}, {decimals} decimals", width(digits))
        }
        Kind::Bits(Bits { bytes, first, count, signed }) => {
            const NAMES: [&str; 9] =
                ["", "byte", "word", "uint24", "dword", "uint40", "uint48", "uint56", "uint64"];
            let number = NAMES.get(usize::from(bytes)).copied().unwrap_or("");
            let sign = if signed { ", signed" } else { "" };
            match count {
                1 => format!("bit {first} of a {number}{sign}"),
                _ => format!("bits {first}..{} of a {number}{sign}", first + count - 1),
            }
        }
        _ => String::new(),
    };
    kind + order
}

/// The constant, the variable or the bit behind how the field is written, and what may be sent of it.
fn show_use(field: &DeviceField) -> String {
    show_source(field) + scale::of_sendable(&field.sendable).as_str()
}

fn show_source(field: &DeviceField) -> String {
    let spec = &field.spec;
    if let Some(bit) = spec.bit() {
        let is_input = matches!(spec, FieldSpec::UserInput { .. } | FieldSpec::DeviceInput { .. });
        return format!(" {} {bit}", if is_input { "->" } else { "<-" });
    }
    match (*spec, spec.variable()) {
        (FieldSpec::Fixed { value, .. }, _) => format!(" = {value}"),
        (FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. }, Some(var)) => {
            format!(" -> {var}{}", scale::of_input(spec, &to, &field.sendable))
        }
        (_, Some(var)) => format!(" <- {var}{}", scale::of_output(spec)),
        (FieldSpec::UserOutput { from, .. } | FieldSpec::DeviceOutput { from, .. }, None) => match from {
            OutputBinding::Constant(value) => format!(" = {value}"),
            OutputBinding::Counter => " <- counter".into(),
            OutputBinding::CounterTo { max } => format!(" <- counter, 0..{max}"),
            OutputBinding::Reply => " <- reply".into(),
            OutputBinding::State { value, .. } => format!(" <- {value}{}", scale::of_output(spec)),
            OutputBinding::Port { value, .. } => {
                let of = field.of_port.as_ref().map_or("the port".to_owned(), |port| format!("port {port}"));
                format!(" <- {} of {of}{}", value.name(), scale::of_output(spec))
            }
            OutputBinding::Link { link, .. } => {
                let name = link.name().or(field.of_port.as_deref()).unwrap_or_default();
                format!(" <- link {name} is up{}", scale::of_output(spec))
            }
            OutputBinding::Variable { .. } | OutputBinding::Bit { .. } => String::new(),
        },
        _ => String::new(),
    }
}

fn show_checksum(sum: &Checksum) -> String {
    let algorithm = match sum.algorithm {
        Algorithm::Crc(crc) if sum.algorithm.name().is_none() => {
            format!("CRC of {} bits, polynomial {:#X}", crc.width, crc.poly)
        }
        _ => sum.algorithm.name().unwrap_or_default().to_owned(),
    };
    let order = match (sum.algorithm.len(), sum.order) {
        (1, _) => "",
        (_, ByteOrder::Little) => ", low byte first",
        _ => ", high byte first",
    };
    let digits = if sum.text { ", as hexadecimal digits" } else { "" };
    let id = match (sum.data_id.bytes(), sum.data_id.is_behind()) {
        ([], _) => String::new(),
        (id, false) => format!(" behind the data id {}", text::hex(id)),
        (id, true) => format!(" and the data id {}", text::hex(id)),
    };
    let covered = match (sum.first, sum.last()) {
        (0, None) => "all bytes before it".to_owned(),
        (first, None) => format!("bytes from {first} up to it"),
        (first, Some(last)) => format!("bytes {first}..{last}"),
    };
    format!("{algorithm}{order}{digits}, over {covered}{id}")
}

#[cfg(test)]
mod tests {
    use recipe_config::AnyRecipe;
    use recipe_config::file::{Text, parse_recipes};

    use super::*;

    const READER: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "reader"
kind = "stream"
mode = "user"
[recipe.input]
head = [2]
tail = [13, 10]
checksum = { kind = "crc16-modbus" }
fields = [
    { name = "station", type = "byte" },
    { name = "code", type = "text", width = 8, to = "WordInputReg[1..4]" },
    { text = "OK" },
    { name = "name", type = "text", until = ",", to = "WordInputReg[5]" },
    { name = "count", type = "word", to = "WordInputReg[6]" },
]

[[port]]
name = "reader"
bus = "rs485"
recipe = "reader"
"#;

    #[test]
    fn texts_have_their_bytes() {
        let recipes = parse_recipes(Text { name: "reader.toml", toml: READER }, &[]).unwrap();
        let [AnyRecipe::Device(recipe)] = &recipes[..] else { panic!("{recipes:?}") };
        let shown = super::picture(recipe, Direction::Input).show();
        let shown: Vec<_> = shown.lines().map(str::trim).collect();
        assert_eq!(
            shown,
            [
                "0       head      02",
                "1       station   byte",
                "2..9    code      text, 8 characters -> WordInputReg[1] to WordInputReg[4]",
                "10..11  text      \"OK\"",
                "12..    name      text, characters up to ',' -> WordInputReg[5]",
                "then    count     word, little-endian -> WordInputReg[6]",
                "then    checksum  crc16-modbus, low byte first, over all bytes before it",
                "then    tail      0D 0A",
            ]
        );
    }

    /// The picture of a stream input with these lines.
    #[track_caller]
    fn picture(lines: &str) -> String {
        let toml = format!(
            "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n\
             [recipe.input]\n{lines}"
        );
        let recipes = parse_recipes(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
        let [AnyRecipe::Device(recipe)] = &recipes[..] else { panic!("{recipes:?}") };
        super::picture(recipe, Direction::Input).show()
    }

    #[test]
    fn a_length_has_its_bytes() {
        let lines = r#"
            head = [2]
            fields = [
                { type = "word", endian = "big", length = true, counts = "frame", plus = 2 },
                { name = "code", type = "text", to = "WordInputReg[1..4]" },
                { name = "last", type = "byte", equals = 3 },
            ]"#;
        let expected = "    0     head  02\n    \
                        1..2        word, big-endian, the length of the frame, plus 2\n    \
                        3..   code  text, all that is left -> WordInputReg[1] to WordInputReg[4]\n    \
                        then  last  byte = 3\n";
        assert_eq!(picture(lines), expected);
    }

    #[test]
    fn the_ends_of_frames_stand_above_them() {
        let first = |keys| {
            let picture = picture(&format!("{keys}\nfields = [{{ name = \"a\", type = \"byte\" }}]"));
            picture.lines().next().unwrap().to_owned()
        };
        assert_eq!(first("escape = \"dle\""), "    between DLE STX and DLE ETX:");
        assert_eq!(first("escape = \"slip\""), "    with the escape bytes of SLIP:");
        assert_eq!(first("escape = \"cobs\""), "    with the escape bytes of COBS:");
        assert_eq!(first("framing = \"silence\""), "    between silences of the line:");
        assert_eq!(first("framing = \"tail\"\ntail = [3]"), "    up to each tail:");
    }
}
