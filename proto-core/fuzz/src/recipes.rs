//! Recipe parts out of an input, and what the rules say of them (docs/wire/recipes.md section 2).

use proto_core::recipe::StreamLayout;
use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::sysvar::{Direction, SysVar};
use proto_core::wire::scalar::ScalarType;

use crate::source::Source;

/// A stream part as it would be configured, right or wrong.
pub(crate) struct Part {
    pub(crate) rules: Rules,
    pub(crate) head: Vec<u8>,
    pub(crate) tail: Vec<u8>,
    pub(crate) fields: Vec<Field>,
    pub(crate) framing: Framing,
}

impl Part {
    /// One byte for mode, direction and framing; head and tail with their lengths before them; then
    /// the fields.
    pub(crate) fn read(input: &mut Source<'_>) -> Self {
        let kind = input.u8();
        let rules = rules(kind);
        let framing = if kind & 4 == 0 { Framing::Bytes } else { Framing::Datagram };
        let mut delimiter = || {
            let len = input.below(10);
            input.take(len).to_vec()
        };
        let (head, tail) = (delimiter(), delimiter());
        let fields = fields(input, rules, 130);
        Self { rules, head, tail, fields, framing }
    }

    /// Section 2 and 5: whether this may be a part.
    pub(crate) fn is_right(&self) -> bool {
        let Self { rules, head, tail, fields, framing } = self;
        let len = fields.iter().map(|field| field.ty().size()).sum::<usize>() + head.len() + tail.len();
        let bounded = framing == &Framing::Datagram || !head.is_empty() || !tail.is_empty();
        let carried = framing == &Framing::Bytes || rules.mode == Mode::Realtime;
        head.len() <= 8
            && tail.len() <= 8
            && bounded
            && carried
            && (1..=128).contains(&fields.len())
            && len <= 512
            && no_input_twice(*rules, fields)
    }

    /// The compiled part; `None`, and rightly so, when a rule is broken.
    pub(crate) fn layout(&self) -> Option<StreamLayout> {
        let Self { rules, head, tail, fields, framing } = self;
        let layout = StreamLayout::new(*rules, head, tail, fields.iter().copied(), *framing);
        assert_eq!(layout.is_ok(), self.is_right(), "{:?}", layout.map(|_| ()));
        layout.ok()
    }
}

/// Mode and direction in two bits.
pub(crate) fn rules(kind: u8) -> Rules {
    Rules {
        mode: if kind & 1 == 0 { Mode::User } else { Mode::Realtime },
        direction: if kind & 2 == 0 { Direction::Input } else { Direction::Output },
    }
}

/// A count up to `most`; then user-defined types, two a byte and repeated, or runs of neighbouring
/// variables.
pub(crate) fn fields(input: &mut Source<'_>, rules: Rules, most: usize) -> Vec<Field> {
    let count = input.below(most + 1);
    let mut fields = Vec::new();
    if rules.mode == Mode::User {
        let kinds = 1 + input.below(8);
        let kinds: Vec<u8> = input.take(kinds).iter().flat_map(|&byte| [byte & 7, byte >> 4 & 7]).collect();
        fields.extend(
            kinds.iter().cycle().take(count).map(|&kind| Field::User(ScalarType::ALL[usize::from(kind)])),
        );
        fields.resize(count, Field::User(ScalarType::Byte));
        return fields;
    }
    let all: Vec<SysVar> = SysVar::all().filter(|var| var.direction() == rules.direction).collect();
    while fields.len() < count {
        let first = input.below(all.len());
        let len = (1 + input.below(40)).min(count - fields.len());
        fields.extend((first..first + len).map(|nth| Field::System(all[nth % all.len()])));
    }
    fields
}

pub(crate) fn no_input_twice(rules: Rules, fields: &[Field]) -> bool {
    let twice = |(nth, field): (usize, &Field)| fields[..nth].contains(field);
    rules.mode == Mode::User || rules.direction == Direction::Output || !fields.iter().enumerate().any(twice)
}
