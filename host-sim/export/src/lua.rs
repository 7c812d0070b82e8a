//! A dissector for Wireshark and tshark, in Lua.
//!
//! In: the frames of a file. Out: the text of a plugin that shows the frames of a capture by name: frames of serial
//! ports in captures of `host-sim gateway --capture`, where the interface has the port's name, and CAN frames in any
//! capture. Without an interface name, every frame of the file is tried.

use std::collections::BTreeMap;

use proto_core::device::{Bits, ByteOrder, Digits, Element, Encoding, Kind, Text, TextWidth};
use proto_core::sysvar::Direction;
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::ScalarType;

use crate::model::{BusModel, Format, FrameField, Model};
use crate::names::{Collision, Names, mangle};
use crate::uses::{describe_use, unit_of};

/// The plugin.
///
/// # Errors
/// [`Collision`] of two names of one recipe.
pub fn lua(model: &Model) -> Result<String, Collision> {
    let mut writer = LuaWriter::default();
    let mut of_recipe: Vec<Vec<usize>> = Vec::new();
    let mut recipes = Names::default();
    for recipe in &model.recipes {
        let name = recipes.add(&recipe.name)?;
        let mut indexes = Vec::new();
        for format in recipe.formats.iter().filter(|format| !format.is_remote) {
            writer.format(&recipe.name, &name, format);
            indexes.push(writer.count);
        }
        of_recipe.push(indexes);
    }
    let mut text = String::from("-- Made by: host-sim export lua\n");
    text += &format!("local proto_fields = {{\n{}}}\n", writer.proto_fields);
    text += &format!("local formats = {{\n{}}}\n", writer.formats);
    text += "local ports = {\n";
    let mut all = Vec::new();
    for port in &model.ports {
        let indexes = port.recipe.and_then(|recipe| of_recipe.get(recipe)).cloned().unwrap_or_default();
        let can = matches!(port.bus, BusModel::Can { .. });
        text +=
            &format!("  [{}] = {{ can = {can}, formats = {{ {} }} }},\n", quoted(&port.name), list(&indexes));
        all.extend(indexes);
    }
    all.sort_unstable();
    all.dedup();
    text += "}\n";
    text += &format!("local all_formats = {{ {} }}\n", list(&all));
    let ids = || model.recipes.iter().flat_map(|recipe| &recipe.formats).filter_map(|format| format.id);
    let (mut standard, mut extended) = (Vec::new(), Vec::new());
    for id in ids() {
        match id {
            CanId::Standard(id) => standard.push(usize::from(id)),
            CanId::Extended(id) => extended.push(id as usize),
        }
    }
    for (name, mut ids) in [("standard_ids", standard), ("extended_ids", extended)] {
        ids.sort_unstable();
        ids.dedup();
        text += &format!("local {name} = {{ {} }}\n", list(&ids));
    }
    Ok(text + include_str!("lua/dissector.lua"))
}

#[derive(Default)]
struct LuaWriter {
    proto_fields: String,
    proto_count: usize,
    /// The definition of each abbreviation, and its index.
    known: BTreeMap<String, (String, usize)>,
    formats: String,
    count: usize,
}

impl LuaWriter {
    fn format(&mut self, recipe: &str, mangled: &str, format: &Format) {
        let (shortest, longest) = format.frame.layout.lengths();
        let id = match format.id {
            None => String::new(),
            Some(CanId::Standard(id)) => format!("id = {id}, "),
            Some(CanId::Extended(id)) => format!("id = {id}, "),
        };
        let direction = if format.direction == Direction::Input { 1 } else { 2 };
        let (head, tail) = &format.delimiters;
        self.formats += &format!(
            "  {{ recipe = {}, role = {}, {id}direction = {direction}, shortest = {shortest}, longest = {longest}, head = {}, tail = {}, fields = {{\n",
            quoted(recipe),
            quoted(&format.role.name()),
            raw(head),
            raw(tail)
        );
        let role = mangle(&format.role.name());
        for (nth, field) in format.fields.iter().enumerate() {
            let behind = behind(&format.fields[nth + 1..]) + tail.len();
            let line = self.field(&format!("rgw.{mangled}.{role}"), format, field, behind);
            self.formats += &format!("    {{ {line} }},\n");
        }
        self.formats += "  } },\n";
        self.count += 1;
    }

    fn field(&mut self, prefix: &str, format: &Format, field: &FrameField, behind: usize) -> String {
        let Some(element) = field.element.and_then(|nth| format.frame.elements.get(nth)) else {
            return format!("kind = \"checksum\", len = {}", field.place.len.unwrap_or(0));
        };
        let mut parts = Vec::new();
        let (kind, ty) = kind_of(element);
        parts.push(format!("kind = \"{kind}\""));
        match width_of(element) {
            Wide::Fixed(len) => parts.push(format!("len = {len}")),
            Wide::Until(end) => parts.push(format!("ends = {end}")),
            Wide::Rest => parts.push(format!("behind = {behind}")),
        }
        if let Some(encoding) = element.encoding() {
            let order = match encoding.order {
                ByteOrder::Little => "L",
                ByteOrder::Big => "B",
                ByteOrder::BigSwapped => "BS",
                ByteOrder::LittleSwapped => "LS",
            };
            parts.push(format!("order = \"{order}\""));
            parts.extend(encoding.shared.then(|| "shared = true".to_owned()));
            if let Kind::Bits(Bits { first, count, .. }) = encoding.kind {
                parts.push(format!("first = {first}, count = {count}"));
            }
            parts.extend(is_signed(&encoding).then(|| "signed = true".to_owned()));
        }
        if let Element::Fixed { value, .. } = element {
            parts.push(format!("fixed = {value}"));
        }
        if let Element::Text(Text { fill: Some(fill), width: TextWidth::Fixed(_) }) = element {
            parts.push(format!("fill = {fill}"));
        }
        if !field.name().is_empty() && !field.field.repeats && !matches!(element, Element::Padding { .. }) {
            let index = self.proto_field(prefix, format, field, ty);
            parts.push(format!("field = {index}, name = {}", quoted(field.name())));
            let uses = describe_use(field);
            if !uses.is_empty() && field.system.is_none() {
                parts.push(format!("use = {}", quoted(&uses)));
            }
        }
        parts.join(", ")
    }

    /// The index of the field's `ProtoField`. Frames of one part may have fields with the same name.
    fn proto_field(&mut self, prefix: &str, format: &Format, field: &FrameField, ty: &str) -> usize {
        let unit = field.system.map_or("", unit_of);
        let label =
            if unit.is_empty() { field.name().to_owned() } else { format!("{} [{unit}]", field.name()) };
        let commands = field.field.commands.iter().flat_map(|commands| &commands.entries);
        let named = commands.filter(|(first, last, text)| first == last && !text.is_empty());
        let named: String = named.map(|(value, _, text)| format!("[{value}] = {}, ", quoted(text))).collect();
        let more = match (ty, named.is_empty()) {
            ("uint32" | "int32", true) => ", base.DEC".to_owned(),
            ("uint32" | "int32", false) => format!(", base.DEC, {{ {named}}}"),
            _ => String::new(),
        };
        let mut abbreviation = format!("{prefix}.{}", mangle(field.name()));
        let made =
            |abbreviation: &str| format!("ProtoField.{ty}(\"{abbreviation}\", {}{more})", quoted(&label));
        match self.known.get(&abbreviation) {
            Some((known, index)) if *known == made(&abbreviation) => return *index,
            Some(_) => {
                let id = format.id.map_or(0, number);
                abbreviation = format!("{abbreviation}.{:x}_{}", id, self.count);
            }
            None => {}
        }
        self.proto_count += 1;
        let text = made(&abbreviation);
        self.proto_fields += &format!("  {text},\n");
        self.known.insert(abbreviation, (text, self.proto_count));
        self.proto_count
    }
}

fn number(id: CanId) -> u32 {
    match id {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id,
    }
}

enum Wide {
    Fixed(usize),
    Until(u8),
    Rest,
}

fn width_of(element: &Element) -> Wide {
    match element {
        Element::Padding { len, .. } => Wide::Fixed(usize::from(*len)),
        Element::Text(Text { width, .. }) => match width {
            TextWidth::Fixed(width) => Wide::Fixed(usize::from(*width)),
            TextWidth::Until(end) => Wide::Until(*end),
            TextWidth::Rest => Wide::Rest,
        },
        _ => {
            let encoding = element.encoding();
            let len = encoding.and_then(|encoding| encoding.size());
            let until = encoding.and_then(|encoding| encoding.until());
            len.map_or(Wide::Until(until.unwrap_or(0)), Wide::Fixed)
        }
    }
}

/// The total length of these fields in bytes. It is constant after a text that takes the rest of a frame.
fn behind(fields: &[FrameField]) -> usize {
    let is_shared = |field: &&FrameField| {
        field
            .field
            .spec
            .element()
            .and_then(|element| element.encoding())
            .is_some_and(|encoding| encoding.shared)
    };
    fields.iter().filter(|field| !is_shared(field)).map(|field| field.place.len.unwrap_or(0)).sum()
}

/// The plugin's name for the kind of a field, and the type in Wireshark.
fn kind_of(element: &Element) -> (&'static str, &'static str) {
    let Some(encoding) = element.encoding() else {
        return match element {
            Element::Text(_) => ("text", "string"),
            _ => ("pad", "bytes"),
        };
    };
    let integer = if is_signed(&encoding) { "int32" } else { "uint32" };
    match encoding.kind {
        Kind::Scalar(ScalarType::Float) => ("f", "float"),
        Kind::Scalar(ScalarType::Double) => ("f", "double"),
        Kind::Bcd { .. } => ("bcd", "uint32"),
        Kind::Decimal(Digits { .. }) => ("dec", "double"),
        Kind::Hex(_) => ("hex", "uint32"),
        Kind::Bits(_) => ("bits", integer),
        _ => ("int", integer),
    }
}

fn is_signed(encoding: &Encoding) -> bool {
    match encoding.kind {
        Kind::Scalar(ty) => matches!(ty, ScalarType::Char | ScalarType::Short | ScalarType::Int),
        Kind::Int24 => true,
        Kind::Bits(bits) => bits.signed,
        _ => false,
    }
}

fn list(numbers: &[usize]) -> String {
    numbers.iter().map(usize::to_string).collect::<Vec<_>>().join(", ")
}

/// A text as a string literal of Lua.
fn quoted(text: &str) -> String {
    raw(text.as_bytes())
}

fn raw(bytes: &[u8]) -> String {
    let shown = |&byte: &u8| match byte {
        b'"' | b'\\' => format!("\\{}", char::from(byte)),
        b' '..=b'~' => char::from(byte).to_string(),
        _ => format!("\\{byte:03}"),
    };
    format!("\"{}\"", bytes.iter().map(shown).collect::<String>())
}
