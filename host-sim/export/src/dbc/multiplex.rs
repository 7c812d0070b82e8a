//! Finds the constants that distinguish frames with the same id.

use std::collections::BTreeSet;

use proto_core::device::Element;

use super::{SignalShape, shape};
use crate::model::Format;

/// One constant that distinguishes frames, or two constants together.
#[derive(Debug, Clone)]
pub(super) struct Multiplex {
    pub(super) first: MultiplexKey,
    pub(super) second: Option<MultiplexKey>,
    first_values: Vec<u64>,
}

/// A constant that all frames have at the same place.
#[derive(Debug, Clone)]
pub(super) struct MultiplexKey {
    pub(super) name: String,
    pub(super) shape: SignalShape,
}

impl Multiplex {
    /// What distinguishes these frames; `None` for a single frame, or if nothing does.
    pub(super) fn of(formats: &[&Format]) -> Option<Self> {
        let (first_format, others) = formats.split_first().filter(|(_, others)| !others.is_empty())?;
        let everywhere =
            |key: &MultiplexKey| others.iter().all(|format| value_of(format, key.shape).is_some());
        let keys: Vec<MultiplexKey> =
            constants(first_format).map(|(key, _)| key).filter(everywhere).collect();
        let all_differ = |values: Vec<Option<(u64, u64)>>| {
            values.iter().all(Option::is_some) && values.iter().collect::<BTreeSet<_>>().len() == values.len()
        };
        let pair = |one: &MultiplexKey, other: &MultiplexKey, format: &Format| {
            Some((value_of(format, one.shape)?, value_of(format, other.shape)?))
        };
        let alone =
            keys.iter().find(|key| all_differ(formats.iter().map(|format| pair(key, key, format)).collect()));
        let found = alone.map(|key| (key.clone(), None)).or_else(|| {
            let pairs = keys.iter().flat_map(|one| keys.iter().map(move |other| (one, other)));
            let mut pairs = pairs.filter(|(one, other)| one.shape != other.shape);
            let differs = |one: &MultiplexKey, other: &MultiplexKey| {
                all_differ(formats.iter().map(|format| pair(one, other, format)).collect())
            };
            pairs
                .find(|(one, other)| differs(one, other))
                .map(|(one, other)| (one.clone(), Some(other.clone())))
        });
        let (first, second) = found?;
        let values: BTreeSet<u64> =
            formats.iter().filter_map(|format| value_of(format, first.shape)).collect();
        Some(Self { first, second, first_values: values.into_iter().collect() })
    }

    /// The distinct values of the first constant.
    pub(super) fn values(&self) -> impl Iterator<Item = u64> {
        self.first_values.iter().copied()
    }

    pub(super) fn first_of(&self, format: &Format) -> Option<u64> {
        value_of(format, self.first.shape)
    }

    pub(super) fn second_of(&self, format: &Format) -> Option<u64> {
        value_of(format, self.second.as_ref()?.shape)
    }
}

/// The integers that are the same in every frame of this format.
fn constants(format: &Format) -> impl Iterator<Item = (MultiplexKey, u64)> {
    format.fields.iter().filter_map(|field| {
        let element = format.frame.elements.get(field.element?)?;
        if matches!(element, Element::Padding { .. } | Element::Text(_)) {
            return None;
        }
        let shape =
            shape(field, element).filter(|shape| shape.value_type == 0 && !shape.order.swaps_words())?;
        let name = match field.name() {
            "" => format!("constant-{}", shape.start),
            name => name.to_owned(),
        };
        // The bits of a negative number.
        let mask = u64::MAX >> 64_usize.saturating_sub(shape.bits).min(63);
        Some((
            MultiplexKey { name, shape: SignalShape { signed: false, ..shape } },
            field.constant()? as u64 & mask,
        ))
    })
}

fn value_of(format: &Format, wanted: SignalShape) -> Option<u64> {
    constants(format).find(|(key, _)| key.shape == wanted).map(|(_, value)| value)
}
