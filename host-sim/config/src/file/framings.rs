//! Reads the framing of a part, texts and lengths in a gateway file.
//!
//! In: the tables of a part and of its fields. Out: the configuration's own types.

use proto_core::config::{FieldSpec, Words};
use proto_core::device::{
    Boundary, ByteOrder, Encoding, Escape, Ignored, Length, MAX_IGNORED, Text, TextWidth,
};
use proto_core::sysvar::{Direction, SysVar, VarRange};

use super::encoding::refuse;
use super::names::meant_variable;
use super::reader::{Result, TableReader, TableValue};
use crate::keys::device::{ESCAPE, ESCAPES, FRAMING, FRAMINGS};
use crate::keys::field::{ALL_COUNTS, COUNTS, PLUS, TEXT_IN, TEXT_ORDER, TEXT_ORDERS, TEXT_OUT, TEXT_WIDTH};

pub(super) const PART_KEYS: [&str; 2] = ["framing", "escape"];
/// The keys of a text beyond those of other fields.
pub(super) const TEXT_KEYS: [&str; 5] = ["length_to", "count_to", "length_from", "order", "ignore"];
/// The keys of a length.
pub(super) const LENGTH_KEYS: [&str; 3] = ["length", "counts", "plus"];

/// Reads `framing` and `escape` of a stream part.
pub(super) fn read_part(part: &TableReader<'_>) -> Result<(Boundary, Option<Escape>)> {
    let framing = part.word(&FRAMING, &FRAMINGS)?;
    let escape = part.word(&ESCAPE, &ESCAPES)?;
    if let (Some(_), Some(item)) = (escape, part.optional("framing")) {
        return Err(item.error("escape bytes tell frames apart already; framing is not needed beside them"));
    }
    if framing == Some(Boundary::Tail) && part.optional("tail").is_none() {
        return Err(part.error("framing = \"tail\" needs a tail, such as tail = [13, 10]"));
    }
    Ok((framing.unwrap_or_default(), escape))
}

/// Reads a field with `type = "text"`.
pub(super) fn read_text(field: &TableReader<'_>, direction: Direction) -> Result<FieldSpec> {
    let keys = if direction == Direction::Input { TEXT_IN } else { TEXT_OUT };
    field.check_keys(&[keys], " in a text")?;
    let width = match (field.optional("width"), field.optional("until")) {
        (Some(_), Some(until)) => return Err(until.error("a text takes width or until, not both")),
        (Some(width), None) => TextWidth::Fixed(width.integer(TEXT_WIDTH.integers())?),
        (None, Some(until)) => TextWidth::Until(one_character(&until)?),
        (None, None) => TextWidth::Rest,
    };
    if !matches!(width, TextWidth::Fixed(_)) {
        refuse(field, &["fill"], "allowed only together with width")?;
    }
    let fill = field.optional("fill").map(|item| one_character(&item)).transpose()?;
    let text = Text { width, fill };
    let order = field.word_or(&TEXT_ORDER, &TEXT_ORDERS)?;
    let var = |key| field.optional(key).map(|item| read_var(&item)).transpose();
    if direction == Direction::Output {
        let from = field.required("from", "the registers of the text, such as \"WordOutputReg[1..8]\"")?;
        return Ok(FieldSpec::TextOutput {
            text,
            from: read_words(&from, order)?,
            length_from: var("length_from")?,
        });
    }
    let to = field.optional("to");
    if to.is_none() {
        refuse(field, &["order"], "allowed only together with to")?;
    }
    Ok(FieldSpec::TextInput {
        text,
        to: to.map(|item| read_words(&item, order)).transpose()?,
        length_to: var("length_to")?,
        count_to: var("count_to")?,
        ignored: field.optional("ignore").map_or(Ok(Ignored::NONE), |item| read_ignored(&item, width))?,
    })
}

/// Reads `ignore = ["NOREAD"]`, whose texts must fit into a field of this width.
fn read_ignored(item: &TableValue<'_>, width: TextWidth) -> Result<Ignored> {
    let items = item.array("of texts, such as [\"NOREAD\"]")?;
    let mut texts = Vec::new();
    for item in &items {
        let text = item.string()?;
        if let Some(c) = text.chars().find(|c| !c.is_ascii()) {
            return Err(item.error(format!("{c:?} is not ASCII; allowed: characters of one byte, 0..=127")));
        }
        match width {
            TextWidth::Fixed(width) if text.len() > usize::from(width) => {
                let len = text.len();
                return Err(item.error(format!(
                    "{len} characters, but the field has {width}: a frame with this text has another length and is \
                     rejected; without width a field takes texts of any length"
                )));
            }
            _ => texts.push(text.as_bytes()),
        }
    }
    Ignored::new(&texts).ok_or_else(|| {
        item.error(format!(
            "too long; allowed: {} characters in one text, each further text takes one more",
            MAX_IGNORED - 1
        ))
    })
}

/// Reads a field with `length = true` and this encoding.
pub(super) fn read_length(field: &TableReader<'_>, encoding: Encoding) -> Result<FieldSpec> {
    let item = field.required("length", "true, for the field that tells the frame's length")?;
    if !item.bool()? {
        return Err(item.error("allowed: true; a field without it is a value"));
    }
    if !encoding.is_integer() || encoding.size().is_none() {
        return Err(item.error("a length is an integer in a fixed number of bytes"));
    }
    let counts = field.word_or(&COUNTS, &ALL_COUNTS)?;
    let plus = field.integer_or(&PLUS)?;
    Ok(FieldSpec::Length(Length { encoding, counts, plus }))
}

fn one_character(item: &TableValue<'_>) -> Result<u8> {
    let text = item.string()?;
    let mut characters = text.chars();
    match (characters.next(), characters.next()) {
        (Some(character), None) if character.is_ascii() => Ok(character as u8),
        _ => Err(item.error(format!("{text:?} is not one character of ASCII, such as \",\" or \"\\r\""))),
    }
}

fn read_var(item: &TableValue<'_>) -> Result<SysVar> {
    let name = item.string()?;
    SysVar::parse(name).map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))
}

fn read_words(item: &TableValue<'_>, order: ByteOrder) -> Result<Words> {
    let name = item.string()?;
    let range = VarRange::parse(name)
        .map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
    let mut vars = range.iter();
    let count = vars.len() as u8;
    let first = vars.next().ok_or_else(|| item.error("names no variable"))?;
    Ok(Words { first, count, order })
}
