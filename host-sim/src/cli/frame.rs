//! The frames of a device as `check` draws them: which bytes are what.

use proto_core::config::{FieldSpec, OutputBinding};
use proto_core::device::{Algorithm, Bits, ByteOrder, Checksum, Digits, Encoding, Kind, Width};
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;
use recipe_config::{DeviceField, DeviceRecipe, NamedFrame};

use super::text;

/// One line of the picture.
struct Row {
    place: String,
    name: String,
    what: String,
}

/// The frames of one part, a line for each run of bytes.
pub(super) fn show(recipe: &DeviceRecipe, part: Direction) -> String {
    let mut report = String::new();
    for frame in recipe.part(part) {
        if let Some(id) = frame.id {
            report += &format!("    id {}\n", text::show_id(id));
        }
        let rows = rows(frame, part);
        let width = |column: fn(&Row) -> &String| {
            rows.iter().map(|row| column(row).chars().count()).max().unwrap_or(0)
        };
        let (places, names) = (width(|row| &row.place), width(|row| &row.name));
        for Row { place, name, what } in &rows {
            report += &format!("    {place:places$}  {name:names$}  {what}\n");
        }
    }
    report
}

fn rows(frame: &NamedFrame, part: Direction) -> Vec<Row> {
    let mut rows = Vec::new();
    let mut cursor = Cursor { at: Some(0), before: String::new() };
    let mut add =
        |place: String, name: &str, what: String| rows.push(Row { place, name: name.to_owned(), what });
    if !frame.head.is_empty() {
        add(cursor.step(Some(frame.head.len())), "head", text::hex(&frame.head));
    }
    let mut fields = &frame.fields[..];
    while let Some((field, rest)) = fields.split_first() {
        fields = rest;
        let text = text_of(std::iter::once(field).chain(rest));
        if text.len() > 1 {
            add(cursor.step(Some(text.len())), "text", format!("{text:?}"));
            fields = &rest[text.len() - 1..];
            continue;
        }
        match field.spec {
            FieldSpec::Checksum(sum) => {
                let place = cursor.step(Some(sum.len()));
                add(place, "checksum", show_checksum(&sum));
            }
            FieldSpec::Padding { len, fill } => {
                let what = match part {
                    Direction::Input => "any bytes".to_owned(),
                    Direction::Output => format!("{fill:02X}"),
                };
                add(cursor.step(Some(usize::from(len))), "padding", what);
            }
            spec => {
                let Some(encoding) = spec.element().and_then(|element| element.encoding()) else { continue };
                let place =
                    if encoding.shared { cursor.before.clone() } else { cursor.step(encoding.size()) };
                let uses = if field.picks_commands { " -> commands".to_owned() } else { show_use(&spec) };
                add(place, &field.name, show_encoding(&encoding) + uses.as_str());
            }
        }
    }
    if !frame.tail.is_empty() {
        add(cursor.step(Some(frame.tail.len())), "tail", text::hex(&frame.tail));
    }
    rows
}

/// Where the next bytes are, while that is known.
struct Cursor {
    at: Option<usize>,
    before: String,
}

impl Cursor {
    /// The place of the next field; `None` is a length that varies.
    fn step(&mut self, len: Option<usize>) -> String {
        self.before = match (self.at, len) {
            (Some(at), Some(1)) => at.to_string(),
            (Some(at), Some(len)) => format!("{at}..{}", at + len - 1),
            (Some(at), None) => format!("{at}.."),
            (None, _) => "then".into(),
        };
        self.at = self.at.zip(len).map(|(at, len)| at + len);
        self.before.clone()
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
            let number = ["", "byte", "word", "", "dword"].get(usize::from(bytes)).copied().unwrap_or("");
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

/// The constant, the variable or the bit behind how the field is written.
fn show_use(spec: &FieldSpec) -> String {
    if let Some(bit) = spec.bit() {
        let is_input = matches!(spec, FieldSpec::UserInput { .. } | FieldSpec::DeviceInput { .. });
        return format!(" {} {bit}", if is_input { "->" } else { "<-" });
    }
    match (*spec, spec.variable()) {
        (FieldSpec::Fixed { value, .. }, _) => format!(" = {value}"),
        (FieldSpec::UserInput { .. } | FieldSpec::DeviceInput { .. }, Some(var)) => format!(" -> {var}"),
        (_, Some(var)) => format!(" <- {var}"),
        (FieldSpec::UserOutput { from, .. } | FieldSpec::DeviceOutput { from, .. }, None) => match from {
            OutputBinding::Constant(value) => format!(" = {value}"),
            OutputBinding::Counter => " <- counter".into(),
            OutputBinding::Reply => " <- reply".into(),
            OutputBinding::State { value, .. } => format!(" <- {value}"),
            OutputBinding::Port { value, .. } => format!(" <- {} of the port", value.name()),
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
    let covered = match (sum.first, sum.last()) {
        (0, None) => "all bytes before it".to_owned(),
        (first, None) => format!("bytes from {first} up to it"),
        (first, Some(last)) => format!("bytes {first}..{last}"),
    };
    format!("{algorithm}{order}{digits}, over {covered}")
}
