//! The frames of a device as `check` draws them: which bytes are what.

use proto_core::config::{DeviceFrame, FieldSpec, OutputBinding, Words};
use proto_core::device::{
    Algorithm, Bits, ByteOrder, Carrier, Checksum, Digits, Encoding, Kind, Place, Text, TextWidth, Width,
};
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
        report += &show_bytes(frame, part);
    }
    report
}

/// One frame, a line for each run of bytes.
pub(super) fn show_bytes(frame: &NamedFrame, part: Direction) -> String {
    let carrier = if frame.id.is_some() { Carrier::Can } else { Carrier::Whole };
    // Cannot fail but for a remote request: reading the file laid out the same frames.
    let Ok(laid_out) = frame.lay_out(carrier, part) else { return String::new() };
    let rows = rows(frame, &laid_out, part);
    let width =
        |column: fn(&Row) -> &String| rows.iter().map(|row| column(row).chars().count()).max().unwrap_or(0);
    let (places, names) = (width(|row| &row.place), width(|row| &row.name));
    let show = |Row { place, name, what }: &Row| format!("    {place:places$}  {name:names$}  {what}\n");
    rows.iter().map(show).collect()
}

fn rows(frame: &NamedFrame, laid_out: &DeviceFrame, part: Direction) -> Vec<Row> {
    let mut places = Vec::new();
    laid_out.layout.parts(&laid_out.elements, |_, place| places.push(place));
    // Head, fields with the checksum among them, tail: as below.
    let mut places = places.into_iter();
    let mut rows = Vec::new();
    let mut add = |place: Option<Place>, name: &str, what: String| {
        let place = place.map(show_place).unwrap_or_default();
        rows.push(Row { place, name: name.to_owned(), what });
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
            FieldSpec::TextInput { text, to, .. } => {
                let to = to.map(|words| format!(" -> {}", show_words(words)));
                add(place, &field.name, show_text(&text) + to.as_deref().unwrap_or(""));
            }
            FieldSpec::TextOutput { text, from, .. } => {
                add(place, &field.name, format!("{} <- {}", show_text(&text), show_words(from)));
            }
            FieldSpec::UserOutput { .. } | FieldSpec::DeviceOutput { .. } if field.is_coil => {
                add(place, &field.name, format!("FF for 1, 00 for 0{}", show_use(&field.spec)));
            }
            spec => {
                let Some(encoding) = spec.element().and_then(|element| element.encoding()) else { continue };
                let uses = if field.picks_commands { " -> commands".to_owned() } else { show_use(&spec) };
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

/// The constant, or the variable, behind how the field is written.
fn show_use(spec: &FieldSpec) -> String {
    match (*spec, spec.variable()) {
        (FieldSpec::Fixed { value, .. }, _) => format!(" = {value}"),
        (FieldSpec::UserInput { .. } | FieldSpec::DeviceInput { .. }, Some(var)) => format!(" -> {var}"),
        (_, Some(var)) => format!(" <- {var}"),
        (FieldSpec::UserOutput { from, .. } | FieldSpec::DeviceOutput { from, .. }, None) => match from {
            OutputBinding::Constant(value) => format!(" = {value}"),
            OutputBinding::Counter => " <- counter".into(),
            OutputBinding::CounterTo { max } => format!(" <- counter, 0..{max}"),
            OutputBinding::Reply => " <- reply".into(),
            OutputBinding::State { value, .. } => format!(" <- {value}"),
            OutputBinding::Port { value, .. } => format!(" <- {} of the port", value.name()),
            OutputBinding::Variable { .. } => String::new(),
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
        let shown = show(recipe, Direction::Input);
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
}
