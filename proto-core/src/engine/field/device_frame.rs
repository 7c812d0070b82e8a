//! Applies device frames field by field.
//!
//! In: a frame that was found, with its format. Out: values in the store, commands, and counters. A field whose value
//! is not taken is rejected alone: its variable keeps its value and ages on its own. A frame of which nothing is taken,
//! or with a wrong alive counter, is rejected as a whole (docs/engine.md section 11). Does not know how frames are
//! found.

use super::bindings::{InputBind, InputTo, Written};
use super::format::{DeviceFormat, elements};
use super::frames::{Accepted, FrameContext};
use super::rules::{Rules, Taken};
use super::texts::TextBind;
use crate::device::{Encoding, Overflow, Unreadable};
use crate::engine::counters::{add, bump};
use crate::engine::rejection::{FieldRejection, Rejection};
use crate::engine::values::withheld::FieldSet;
use crate::image::bind_to_variable;
use crate::sysvar::SysVar;
use crate::wire::scalar::Scalar;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Verdict {
    /// It is a field without a value, such as padding.
    Nothing,
    Taken,
    /// The device says that it has no value now.
    NoValue,
    Rejected(Rejection),
}

/// The fields of a frame, sorted by verdict.
#[derive(Debug, Clone, Copy, Default)]
struct Sorted {
    taken: FieldSet,
    /// Fields without a value now, for whatever reason.
    without: FieldSet,
    /// Number of rejected fields, and the first of them.
    rejected: usize,
    first: Option<FieldRejection>,
    /// Number of fields for which the device says that it has no value.
    no_value: usize,
    /// A variable shows whether a field was taken.
    tells: bool,
}

impl FrameContext<'_> {
    /// Applies a frame and counts it in `accepted`.
    pub(crate) fn take_device(
        &mut self,
        format: &DeviceFormat,
        texts: &[TextBind],
        frame: &[u8],
        slot: usize,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        if self.is_ignored(texts, format, frame) {
            bump(&mut self.counters.ignored);
            self.store.not_overdue(slot);
            // No variables are set, but an output that answers every frame answers this one, too.
            accepted.frames = accepted.frames.wrapping_add(1);
            return Ok(());
        }
        if !self.is_whole(format, texts, frame) {
            return self.take_in_part(format, texts, frame, slot, false, accepted);
        }
        if self.store.withheld.is_used {
            let sorted = self.sort(format, texts, frame);
            self.store.readmit(slot, &sorted.taken);
        }
        self.apply(format, texts, frame, None);
        accepted.frames = accepted.frames.wrapping_add(1);
        accepted.set = self.store.accepted_apart(slot, self.counters);
        Ok(())
    }

    /// Applies what a master writes: as a whole or not at all, because the master gets one reply for all of it.
    pub(crate) fn take_block(
        &mut self,
        format: &DeviceFormat,
        texts: &[TextBind],
        data: &[u8],
        slot: usize,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        if self.is_ignored(texts, format, data) || self.is_whole(format, texts, data) {
            return self.take_device(format, texts, data, slot, accepted);
        }
        self.take_in_part(format, texts, data, slot, true, accepted)
    }

    /// Whether all fields of a frame are taken.
    fn is_whole(&self, format: &DeviceFormat, texts: &[TextBind], frame: &[u8]) -> bool {
        let bindings = format.bindings.of(self.bindings);
        let values = bindings.iter().zip(format.layout.values(elements(bindings), frame));
        (0..).zip(values).all(|(nth, (binding, value))| match (value, binding.to) {
            (Ok(Some(value)), InputTo::Variable { .. }) => {
                value.is_finite() && bound(binding, value).is_some()
            }
            (Ok(Some(value)), InputTo::Counter(nth)) => {
                value.is_finite() && self.store.counts.check(nth, value).is_ok()
            }
            (value, InputTo::Ruled { .. }) => {
                matches!(
                    self.verdict(format, frame, (nth, binding), value),
                    Verdict::Taken | Verdict::Nothing
                )
            }
            (Ok(value), _) => value.is_none_or(|value| value.is_finite()),
            (Err(_), _) => false,
        }) && self.texts(texts, format, frame).all(|(.., found)| found.is_ok())
    }

    /// The verdict on the value of the `nth` field.
    fn verdict(
        &self,
        format: &DeviceFormat,
        frame: &[u8],
        (nth, binding): (usize, &InputBind),
        value: Result<Option<Scalar>, Unreadable>,
    ) -> Verdict {
        let value = match value {
            Ok(None) => return Verdict::Nothing,
            Ok(Some(value)) => Ok(value),
            Err(why) => Err(why),
        };
        if let Some(rules) = Rules::of(binding, self.bindings) {
            let bindings = format.bindings.of(self.bindings);
            return match rules.take(value, || format.layout.bytes_of(elements(bindings), frame, nth)) {
                Taken::Value(_) => Verdict::Taken,
                Taken::NoValue => Verdict::NoValue,
                Taken::Rejected(why) => Verdict::Rejected(why),
            };
        }
        match value {
            Err(_) => Verdict::Rejected(Rejection::Unreadable),
            Ok(value) if !value.is_finite() => Verdict::Rejected(Rejection::NotFinite),
            Ok(value) => match binding.to {
                InputTo::Variable { .. } if bound(binding, value).is_none() => {
                    Verdict::Rejected(Rejection::OutOfRange)
                }
                InputTo::Counter(nth) => {
                    self.store.counts.check(nth, value).map_or_else(Verdict::Rejected, |()| Verdict::Taken)
                }
                _ => Verdict::Taken,
            },
        }
    }

    /// Sorts the fields of a frame by verdict.
    fn sort(&self, format: &DeviceFormat, texts: &[TextBind], frame: &[u8]) -> Sorted {
        let mut sorted = Sorted::default();
        let bindings = format.bindings.of(self.bindings);
        let values = bindings.iter().zip(format.layout.values(elements(bindings), frame));
        for (nth, (binding, value)) in (0_u8..).zip(values) {
            let verdict = self.verdict(format, frame, (usize::from(nth), binding), value);
            let place = match verdict {
                Verdict::Nothing => continue,
                Verdict::Taken => &mut sorted.taken,
                Verdict::NoValue | Verdict::Rejected(_) => &mut sorted.without,
            };
            match binding.to {
                InputTo::Variable { var, .. } | InputTo::Ruled { var, .. } => place.whole.insert(var),
                InputTo::Bits { var, .. } => place.bits.insert(var),
                InputTo::Command(field) => place.insert_command(field),
                InputTo::Unused | InputTo::Counter(_) | InputTo::Fixed { .. } | InputTo::Rule(_) => {}
            }
            if let Some((var, mask)) = Rules::of(binding, self.bindings).and_then(Rules::valid_to) {
                sorted.tells = true;
                match mask {
                    0 => sorted.taken.whole.insert(var),
                    _ => sorted.taken.bits.insert(var),
                }
            }
            match verdict {
                Verdict::NoValue => sorted.no_value = sorted.no_value.saturating_add(1),
                Verdict::Rejected(why) => {
                    sorted.rejected = sorted.rejected.saturating_add(1);
                    let value = value.ok().flatten().map_or(f64::NAN, Scalar::as_f64);
                    let binding = format.bindings.start.saturating_add(nth.into());
                    sorted.first = sorted.first.or(Some(FieldRejection { value, binding, why }));
                }
                Verdict::Nothing | Verdict::Taken => {}
            }
        }
        for (at, text, found) in self.texts(texts, format, frame) {
            let place = if found.is_ok() { &mut sorted.taken } else { &mut sorted.without };
            text.variables().for_each(|var| place.whole.insert(var));
            if let Err(why) = found {
                sorted.rejected = sorted.rejected.saturating_add(1);
                let binding = format.bindings.start.saturating_add(at as u16);
                let new = FieldRejection { value: f64::NAN, binding, why };
                sorted.first = sorted.first.or(Some(new));
            }
        }
        // The bits that a frame writes in one byte belong together.
        sorted.taken.bits = sorted.taken.bits.minus(&sorted.without.bits);
        sorted
    }

    /// Applies a frame with fields that are not taken. If `is_block`, a rejected field rejects all of it.
    fn take_in_part(
        &mut self,
        format: &DeviceFormat,
        texts: &[TextBind],
        frame: &[u8],
        slot: usize,
        is_block: bool,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        let bindings = format.bindings.of(self.bindings);
        for (nth, (binding, value)) in
            bindings.iter().zip(format.layout.values(elements(bindings), frame)).enumerate()
        {
            if let InputTo::Counter(_) = binding.to
                && let Verdict::Rejected(why) = self.verdict(format, frame, (nth, binding), value)
            {
                return self.rejected(why);
            }
        }
        let sorted = self.sort(format, texts, frame);
        let is_nothing = sorted.taken.is_empty() && sorted.no_value == 0 && !sorted.tells;
        self.store.rejected_field.clear();
        self.store.rejected_field.extend(sorted.first);
        let is_refused = sorted.first.is_some() && (is_block || is_nothing);
        if is_refused || !self.store.withhold(slot, &sorted.without) {
            return self.rejected(sorted.first.map_or(Rejection::OutOfRange, |first| first.why));
        }
        self.store.readmit(slot, &sorted.taken);
        self.apply(format, texts, frame, Some(&sorted));
        add(&mut self.counters.rejected_fields, sorted.rejected);
        add(&mut self.counters.fields_without_value, sorted.no_value);
        accepted.frames = accepted.frames.wrapping_add(1);
        accepted.set = self.store.accepted_apart(slot, self.counters);
        Ok(())
    }

    /// Puts the values of a frame into their variables and counts the frame. `sorted` says which fields are not taken,
    /// if any.
    fn apply(&mut self, format: &DeviceFormat, texts: &[TextBind], frame: &[u8], sorted: Option<&Sorted>) {
        let all = self.bindings;
        let bindings = format.bindings.of(all);
        for (nth, (binding, value)) in
            bindings.iter().zip(format.layout.values(elements(bindings), frame)).enumerate()
        {
            if let Some(rules) = Rules::of(binding, all) {
                let value = value.and_then(|value| value.ok_or(Unreadable::Length));
                self.apply_ruled((binding, rules), value, || {
                    format.layout.bytes_of(elements(bindings), frame, nth)
                });
                continue;
            }
            let Ok(Some(value)) = value else { continue };
            if sorted.is_some() && !value.is_finite() {
                continue;
            }
            match (bound(binding, value), binding.to) {
                (Some((var, value)), _) => {
                    // Cannot fail: the value fits, by `bound`.
                    let _ = self.store.image.set(var, value);
                }
                (None, InputTo::Counter(nth)) => {
                    if self.store.counts.take(nth, value) {
                        bump(&mut self.counters.counter_jumps);
                    }
                }
                (None, InputTo::Bits { var, .. })
                    if sorted.is_some_and(|sorted| sorted.without.bits.contains(var)) => {}
                (None, _) => self.apply_user(&binding.to, value),
            }
        }
        self.take_texts(texts, format, frame);
        if let Some(link) = &mut self.commands {
            link.frame_ends();
        }
        bump(&mut self.counters.frames_in);
    }

    fn apply_ruled<'f>(
        &mut self,
        (binding, rules): (&InputBind, Rules<'f>),
        value: Result<Scalar, Unreadable>,
        bytes: impl FnOnce() -> Option<&'f [u8]>,
    ) {
        let taken = rules.take(value, bytes);
        if let (Taken::Value(value), InputTo::Ruled { var, .. }) = (taken, binding.to) {
            let _ = self.store.image.set(var, value);
        }
        if let Some((var, mask)) = rules.valid_to() {
            let is_valid = matches!(taken, Taken::Value(_));
            match mask {
                0 => _ = self.store.image.set(var, Scalar::Word(u16::from(is_valid))),
                _ => self.store.image.set_bits(var, mask, if is_valid { mask } else { 0 }),
            }
        }
    }
}

/// The variable and its new value for a field's value; `None` if the value does not fit, or the field is not for a
/// variable.
fn bound(binding: &InputBind, value: Scalar) -> Option<(SysVar, Scalar)> {
    let InputTo::Variable { var, scale, offset } = binding.to else { return None };
    let Written::Value { overflow: Overflow::Wrap, .. } = binding.written else {
        return binding.to.bound(value);
    };
    let number = value.as_f64() * f64::from(scale) + f64::from(offset);
    let number = Encoding::scalar(var.ty()).fit(number, Overflow::Wrap)?;
    bind_to_variable(var, Scalar::Double(number), 1.0, 0.0).map(|value| (var, value))
}
