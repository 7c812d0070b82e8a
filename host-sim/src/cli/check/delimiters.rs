//! Heads and tails that a frame can have where none is: inside its own values, or in each other.
//!
//! In: the recipes of a file. Out: a sentence for each delimiter that a receiver can take for another one, with the
//! values that make it so. Frames with a checksum, and those that escapes or silences tell apart, are left out: there
//! a false frame is refused.

use proto_core::config::FieldSpec;
use proto_core::device::{Boundary, Encoding, Kind};
use proto_core::sysvar::Direction;
use recipe_config::{AnyRecipe, DeviceRecipe, FrameEnds, SimParts, SimRecipe};

/// Values that come every day: at rest, counting, switched on, negative by a little, all bits set.
const EVERYDAY: [f64; 14] =
    [0.0, 1.0, -1.0, 2.0, 10.0, 100.0, 255.0, 256.0, 1000.0, 65_535.0, 0.5, -2.0, -10.0, -100.0];

/// A part with delimiters.
struct DelimitedPart<'r> {
    name: &'static str,
    head: &'r [u8],
    tail: &'r [u8],
    fields: Vec<(String, Bytes)>,
    /// Only the tail tells where frames are.
    by_tail: bool,
}

/// What a field can be.
enum Bytes {
    /// A number.
    Number(Encoding),
    /// Always the same.
    Constant(Vec<u8>),
    /// Characters, whose bytes and number nobody knows.
    Unknown,
}

/// What is dangerous in a recipe: the part's key, and a sentence.
pub(super) fn dangers(recipe: &AnyRecipe) -> Vec<(&'static str, String)> {
    let parts = match recipe {
        AnyRecipe::Plain(recipe) => plain_parts(recipe),
        AnyRecipe::Device(recipe) => device_parts(recipe),
    };
    let said = |part: &DelimitedPart<'_>| -> Vec<_> {
        part.dangers()
            .into_iter()
            .map(|danger| (part.name, format!("recipe {:?}, {}: {danger}", recipe.name(), part.name)))
            .collect()
    };
    parts.iter().flat_map(said).collect()
}

const PARTS: [(&str, Direction); 2] = [("input", Direction::Input), ("output", Direction::Output)];

fn plain_parts(recipe: &SimRecipe) -> Vec<DelimitedPart<'_>> {
    let SimParts::Stream { input, output } = &recipe.parts else { return Vec::new() };
    let parts = PARTS.iter().zip([input, output]);
    parts
        .filter_map(|((name, _), part)| {
            let part = part.as_ref()?;
            let fields = part
                .fields
                .iter()
                .map(|field| (field.name.clone(), Bytes::Number(Encoding::scalar(field.field.ty()))));
            Some(DelimitedPart {
                name,
                head: &part.head,
                tail: &part.tail,
                fields: fields.collect(),
                by_tail: false,
            })
        })
        .collect()
}

fn device_parts(recipe: &DeviceRecipe) -> Vec<DelimitedPart<'_>> {
    let mut parts = Vec::new();
    for (name, direction) in PARTS {
        let by_tail = match recipe.ends(direction) {
            FrameEnds { boundary: Boundary::Fields, escape: None } => false,
            FrameEnds { boundary: Boundary::Tail, escape: None } => true,
            _ => continue,
        };
        for frame in recipe.part(direction).iter().filter(|frame| frame.id.is_none()) {
            let is_checked = frame.fields.iter().any(|field| matches!(field.spec, FieldSpec::Checksum(_)));
            if is_checked && !by_tail {
                continue;
            }
            let own = frame.fields.iter().filter(|field| !field.repeats && !is_shared(&field.spec));
            let fields = own.map(|field| (field.name.clone(), bytes_of(&field.spec))).collect();
            parts.push(DelimitedPart { name, head: &frame.head, tail: &frame.tail, fields, by_tail });
        }
    }
    parts
}

/// Whether the field before has its bytes.
fn is_shared(spec: &FieldSpec) -> bool {
    spec.element().and_then(|element| element.encoding()).is_some_and(|encoding| encoding.shared)
}

fn bytes_of(spec: &FieldSpec) -> Bytes {
    match spec {
        FieldSpec::Fixed { encoding, value } => {
            Bytes::Constant(written(encoding, *value as f64).unwrap_or_default())
        }
        FieldSpec::Padding { len, fill } => Bytes::Constant(vec![*fill; usize::from(*len)]),
        _ => match spec.element().and_then(|element| element.encoding()) {
            // Digits of ASCII are no numbers on the line.
            Some(encoding) if !matches!(encoding.kind, Kind::Decimal(_) | Kind::Hex(_)) => {
                Bytes::Number(encoding)
            }
            _ => Bytes::Unknown,
        },
    }
}

/// A number as the field has it; `None` if it does not fit.
fn written(encoding: &Encoding, value: f64) -> Option<Vec<u8>> {
    let (low, high) = encoding.range();
    if value < low || value > high || (encoding.is_integer() && value.fract() != 0.0) {
        return None;
    }
    let mut bytes = vec![0; encoding.size()?];
    encoding.write(value, &mut bytes)?;
    Some(bytes)
}

impl DelimitedPart<'_> {
    fn dangers(&self) -> Vec<String> {
        let (head, tail) = (self.head, self.tail);
        let mut dangers = Vec::new();
        if self.by_tail {
            dangers.extend(self.inside("tail", tail));
            return dangers;
        }
        match (head, tail) {
            ([], []) => {}
            _ if head == tail => dangers.push(format!(
                "head and tail are both {}, so between two frames a receiver takes one for the other",
                hex(head)
            )),
            _ if !head.is_empty() && tail.ends_with(head) => dangers.push(format!(
                "the tail {} ends with the head {}, so a receiver can begin in it",
                hex(tail),
                hex(head)
            )),
            _ if !head.is_empty() && tail.starts_with(head) => dangers.push(format!(
                "the tail {} begins with the head {}, so a receiver can begin in it",
                hex(tail),
                hex(head)
            )),
            _ => {}
        }
        for (what, bytes) in [("head", head), ("tail", tail)] {
            dangers.extend(self.inside(what, bytes));
        }
        dangers
    }

    /// Whether the values of every day have the delimiter in their bytes.
    fn inside(&self, what: &str, delimiter: &[u8]) -> Option<String> {
        let short = match (delimiter, self.fields.iter().any(|(_, bytes)| matches!(bytes, Bytes::Number(_))))
        {
            ([], _) => return None,
            ([_], true) => "; with two bytes or more, or a checksum, it is rare",
            _ => "",
        };
        EVERYDAY.iter().find_map(|&value| {
            let frame = self.frame(value);
            let at = (0..frame.len()).find(|&at| {
                let Some(here) = frame.get(at..at + delimiter.len()) else { return false };
                let is_same = here.iter().zip(delimiter).all(|(byte, wanted)| byte.0 == Some(*wanted));
                is_same && here.iter().any(|byte| byte.2)
            })?;
            let mut names: Vec<&str> = Vec::new();
            for (_, field, is_value) in &frame[at..at + delimiter.len()] {
                let name = self.fields.get(*field).map_or("", |(name, _)| name);
                if *is_value && !names.contains(&name) {
                    names.push(name);
                }
            }
            let are = if names.len() == 1 { "is" } else { "are" };
            Some(format!(
                "the {what} {} is also in the values: when {} {are} {value}{short}",
                hex(delimiter),
                names.join(", ")
            ))
        })
    }

    /// The bytes between head and tail with all fields at one value, as far as it fits them: the byte if it is known,
    /// the field, and whether it belongs to a value.
    fn frame(&self, value: f64) -> Vec<(Option<u8>, usize, bool)> {
        let mut frame = Vec::new();
        for (nth, (_, bytes)) in self.fields.iter().enumerate() {
            match bytes {
                Bytes::Number(encoding) => {
                    let len = encoding.size().unwrap_or(1);
                    match written(encoding, value) {
                        Some(bytes) => frame.extend(bytes.into_iter().map(|byte| (Some(byte), nth, true))),
                        None => frame.extend(std::iter::repeat_n((None, nth, true), len)),
                    }
                }
                Bytes::Constant(bytes) => frame.extend(bytes.iter().map(|byte| (Some(*byte), nth, false))),
                Bytes::Unknown => frame.push((None, nth, true)),
            }
        }
        frame
    }
}

fn hex(bytes: &[u8]) -> String {
    super::super::text::hex(bytes)
}

#[cfg(test)]
mod tests {
    use recipe_config::file::{Text, parse_recipes};

    use super::*;

    /// What is said of an input part with these lines.
    #[track_caller]
    fn said(lines: &str) -> Vec<String> {
        let toml = format!(
            "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n\
             [recipe.input]\n{lines}"
        );
        let recipes = parse_recipes(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
        let all = recipes.iter().flat_map(dangers);
        all.map(|(_, text)| text.trim_start_matches("recipe \"r\", input: ").to_owned()).collect()
    }

    const TWO: &str = "fields = [{ name = \"a\", type = \"short\" }, { name = \"x\", type = \"float\" }]";

    #[test]
    fn a_delimiter_inside_the_values_is_found_with_the_values() {
        let inside = said(&format!("head = [255, 255]\ntail = [0x80, 0x3F]\n{TWO}"));
        assert_eq!(
            inside,
            [
                "the head FF FF is also in the values: when a is -1",
                "the tail 80 3F is also in the values: when x is 1",
            ]
        );
        let both = said(
            "head = [1, 1]\nfields = [{ name = \"a\", type = \"byte\" }, { name = \"b\", type = \"byte\" }]",
        );
        assert_eq!(both, ["the head 01 01 is also in the values: when a, b are 1"]);
        assert_eq!(said(&format!("head = [0xA5, 0x5A]\n{TWO}")), [""; 0]);
        // A checksum refuses a false frame.
        assert_eq!(
            said(&format!("head = [255, 255]\nchecksum = {{ kind = \"crc16-modbus\" }}\n{TWO}")),
            [""; 0]
        );
        assert_eq!(said(&format!("head = [255, 255]\nescape = \"dle\"\n{TWO}")), [""; 0]);
    }

    #[test]
    fn a_head_of_one_byte_is_a_value() {
        let one = said(&format!("head = [1]\n{TWO}"));
        assert_eq!(
            one,
            [
                "the head 01 is also in the values: when a is 1; with two bytes or more, or a checksum, it is rare"
            ]
        );
        let text = "head = [2]\ntail = [3]\nfields = [{ name = \"a\", type = \"decimal\", width = 4 }]";
        assert_eq!(said(text), [""; 0], "characters are no numbers");
    }

    #[test]
    fn a_head_and_a_tail_that_are_alike_are_found() {
        let said = |head: &str, tail: &str| said(&format!("head = {head}\ntail = {tail}\n{TWO}")).remove(0);
        assert!(said("[0xA5, 0x5A]", "[0xA5, 0x5A]").starts_with("head and tail are both A5 5A"));
        assert!(said("[0xA5, 0x5A]", "[7, 0xA5, 0x5A]").starts_with("the tail 07 A5 5A ends with the head"));
        assert!(
            said("[0xA5, 0x5A]", "[0xA5, 0x5A, 7]").starts_with("the tail A5 5A 07 begins with the head")
        );
    }

    #[test]
    fn a_tail_that_cuts_is_found_inside_constants_and_values_too() {
        let cut = said(
            "framing = \"tail\"\ntail = [13, 10]\nfields = [{ name = \"a\", type = \"word\" }, { text = \"x\" }]",
        );
        assert_eq!(cut, [""; 0]);
        let cut = said(
            "framing = \"tail\"\ntail = [0, 1]\nfields = [{ name = \"a\", type = \"word\" }, { text = \"x\" }]",
        );
        assert_eq!(cut, ["the tail 00 01 is also in the values: when a is 256"]);
    }
}
