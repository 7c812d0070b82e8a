//! The frames of a device as `check` draws them: which bytes are what.

use proto_core::config::{FieldSpec, OutputBinding, Words};
use proto_core::device::{
    Algorithm, Bits, Boundary, ByteOrder, Checksum, Counts, Digits, Encoding, Escape, Kind, Length, Text,
    TextWidth, Width,
};
use proto_core::sysvar::{Direction, SysVar};
use proto_core::wire::scalar::ScalarType;
use recipe_config::{DeviceField, DeviceRecipe, FrameEnds, NamedFrame};

use super::text;

/// One line of the picture.
struct Row {
    place: String,
    name: String,
    what: String,
}

/// The frames of one part, a line for each run of bytes.
pub(super) fn show(recipe: &DeviceRecipe, part: Direction) -> String {
    let mut report = match recipe.ends(part) {
        FrameEnds { escape: Some(Escape::Dle), .. } => "    between DLE STX and DLE ETX:\n",
        FrameEnds { escape: Some(Escape::Slip), .. } => "    with the escape bytes of SLIP:\n",
        FrameEnds { escape: Some(Escape::Cobs), .. } => "    with the escape bytes of COBS:\n",
        FrameEnds { boundary: Boundary::Tail, .. } => "    up to each tail:\n",
        FrameEnds { boundary: Boundary::Silence, .. } => "    between silences of the line:\n",
        FrameEnds { boundary: Boundary::Fields, .. } => "",
    }
    .to_owned();
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
            FieldSpec::TextInput { text, to, length_to, count_to } => {
                let uses = [
                    (to.map(show_words), "-> "),
                    (length_to.map(show_name), "length -> "),
                    (count_to.map(show_name), "count -> "),
                ];
                add(cursor.step(text_len(&text)), &field.name, show_text(&text) + show_uses(uses).as_str());
            }
            FieldSpec::TextOutput { text, from, length_from } => {
                let uses =
                    [(Some(show_words(from)), "<- "), (length_from.map(show_name), "length <- "), (None, "")];
                add(cursor.step(text_len(&text)), &field.name, show_text(&text) + show_uses(uses).as_str());
            }
            FieldSpec::Length(length) => {
                let encoding = &length.encoding;
                let place =
                    if encoding.shared { cursor.before.clone() } else { cursor.step(encoding.size()) };
                add(place, &field.name, show_length(&length));
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

/// The number of bytes, if it is always the same.
fn text_len(text: &Text) -> Option<usize> {
    match text.width {
        TextWidth::Fixed(width) => Some(usize::from(width)),
        TextWidth::Until(_) | TextWidth::Rest => None,
    }
}

fn show_text(text: &Text) -> String {
    let fill = text.fill.map(|fill| format!(", filled up with {:?}", char::from(fill))).unwrap_or_default();
    match text.width {
        TextWidth::Fixed(width) => format!("text, {width} characters{fill}"),
        TextWidth::Until(end) => format!("text, characters up to {:?}", char::from(end)),
        TextWidth::Rest => "text, all characters".into(),
    }
}

fn show_name(var: SysVar) -> String {
    var.to_string()
}

fn show_words(words: Words) -> String {
    let first = words.first.to_string();
    match (words.count, words.iter().last()) {
        (2.., Some(last)) => format!("{}..{}]", first.trim_end_matches(']'), last.index()),
        _ => first,
    }
}

/// The variables of a text.
fn show_uses(uses: [(Option<String>, &str); 3]) -> String {
    let shown = uses.into_iter().filter_map(|(var, arrow)| Some(format!(" {arrow}{}", var?)));
    shown.collect::<Vec<_>>().join(",")
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

/// The constant, or the variable, behind how the field is written.
fn show_use(spec: &FieldSpec) -> String {
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
    let covered = match (sum.first, sum.last()) {
        (0, None) => "all bytes before it".to_owned(),
        (first, None) => format!("bytes from {first} up to it"),
        (first, Some(last)) => format!("bytes {first}..{last}"),
    };
    format!("{algorithm}{order}{digits}, over {covered}")
}

#[cfg(test)]
mod tests {
    use recipe_config::AnyRecipe;
    use recipe_config::file::{Text, parse_recipes};

    use super::*;

    /// The picture of a stream part with these lines.
    #[track_caller]
    fn picture(part: &str, lines: &str) -> String {
        let toml = format!(
            "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n\
             [recipe.{part}]\n{lines}"
        );
        let recipes = parse_recipes(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
        let part = if part == "input" { Direction::Input } else { Direction::Output };
        match &recipes[0] {
            AnyRecipe::Device(recipe) => show(recipe, part),
            AnyRecipe::Plain(_) => panic!("a recipe of the controller"),
        }
    }

    #[test]
    fn texts_and_lengths_have_places() {
        let lines = r#"
            head = [2]
            fields = [
                { type = "word", endian = "big", length = true, counts = "frame", plus = 2 },
                { name = "lot", type = "text", width = 4, fill = " ", to = "WordInputReg[1..2]" },
                { name = "n", type = "byte" },
                { name = "code", type = "text", to = "WordInputReg[3..4]", length_to = "WordInputReg[5]" },
                { name = "last", type = "byte", equals = 3 },
            ]"#;
        let expected = "    0     head  02\n    1..2        word, big-endian, the length of the frame, plus 2\n    \
                        3..6  lot   text, 4 characters, filled up with ' ' -> WordInputReg[1..2]\n    \
                        7     n     byte\n    \
                        8..   code  text, all characters -> WordInputReg[3..4], length -> WordInputReg[5]\n    \
                        then  last  byte = 3\n";
        assert_eq!(picture("input", lines), expected);
    }

    #[test]
    fn the_ends_of_frames_stand_above_them() {
        let fields = |keys: &str| format!("{keys}\nfields = [{{ name = \"a\", type = \"byte\" }}]");
        let ends = |keys| picture("input", &fields(keys)).lines().next().unwrap().to_owned();
        assert_eq!(ends("escape = \"dle\""), "    between DLE STX and DLE ETX:");
        assert_eq!(ends("escape = \"slip\""), "    with the escape bytes of SLIP:");
        assert_eq!(ends("escape = \"cobs\""), "    with the escape bytes of COBS:");
        assert_eq!(ends("framing = \"silence\""), "    between silences of the line:");
        let text = "{ name = \"t\", type = \"text\", until = \";\", from = \"WordOutputReg[1]\", \
                    length_from = \"WordOutputReg[2]\" }";
        let sent = picture("output", &format!("tail = [13]\nfields = [{text}]"));
        assert_eq!(
            sent,
            "    0..   t     text, characters up to ';' <- WordOutputReg[1], length <- WordOutputReg[2]\n    \
             then  tail  0D\n"
        );
    }
}
