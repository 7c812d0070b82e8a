//! The process image: value, source and age of every system variable (docs/engine.md section 3).
//!
//! Values are packed little-endian in one byte array, in the order of the variable table, so that adjacent fields of a
//! recipe are one copy. A variable has the age of its group: of the frame, poll or packet that brings it. Does not know
//! recipes, ports or links.

mod bit_set;
mod set;

pub(crate) use bit_set::BitSet;
pub(crate) use set::{ExtraSet, InputSet, VarSet};

use crate::sysvar::{COUNT, IMAGE_BYTES, SysVar};
use crate::time::{Duration, Instant, Stamp};
use crate::wire::scalar::{Scalar, ScalarType};

/// The packed values.
pub(crate) type ImageBytes = [u8; IMAGE_BYTES];

/// Maximum number of groups of variables that arrive together.
pub(crate) const MAX_GROUPS: usize = 96;

/// Maximum number of fields that can be rejected at a time while the rest of their frame is accepted; each gets a group
/// of its own. Their ids follow the other groups'.
pub(crate) const WITHHELD_GROUPS: usize = 14;

/// Maximum number of extra values that ports show, besides the system variables.
pub(crate) const MAX_EXTRA: usize = 32;

/// A group of variables that arrive together and therefore have the same age: a field frame, a Modbus block or a
/// packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub(crate) struct GroupId(pub(crate) u8);

/// Value, source and age of every system variable.
#[derive(Debug, Clone)]
pub struct Image {
    bytes: ImageBytes,
    /// Number of the group + 1; 0 for a variable without a group.
    group: [u8; COUNT],
    /// When each group last arrived; [`Instant::NEVER`] before the first time.
    stamps: [Stamp; MAX_GROUPS + WITHHELD_GROUPS],
    /// Variables whose field was rejected in the newest frame of their owner; until accepted, they have a group of
    /// their own.
    withheld: InputSet,
    /// Variables whose newest value was unreadable, even if others of their group were readable.
    unreadable: VarSet,
    /// Whether `withheld`, `unreadable` or `unreadable_extra` may have entries.
    any_unreadable: bool,
    /// Extra values that ports show besides the system variables, and which of them are unreadable.
    extra: [f64; MAX_EXTRA],
    unreadable_extra: ExtraSet,
}

impl Image {
    /// An image with all values zero and unknown.
    pub(crate) const fn new() -> Self {
        Self {
            bytes: [0; IMAGE_BYTES],
            group: [0; COUNT],
            stamps: [Stamp::NEVER; MAX_GROUPS + WITHHELD_GROUPS],
            withheld: InputSet::EMPTY,
            unreadable: VarSet::EMPTY,
            any_unreadable: false,
            extra: [0.0; MAX_EXTRA],
            unreadable_extra: ExtraSet::EMPTY,
        }
    }

    /// The packed values.
    pub fn bytes(&self) -> &ImageBytes {
        &self.bytes
    }

    /// The packed values, to be written by a recipe or packet with a matching layout.
    pub(crate) fn bytes_mut(&mut self) -> &mut ImageBytes {
        &mut self.bytes
    }

    /// The variable's value; only valid if [`Self::is_known`].
    pub fn value(&self, var: SysVar) -> Scalar {
        let start = var.image_offset();
        let bytes = self.bytes.get(start..start.saturating_add(var.size())).unwrap_or(&[]);
        Scalar::decode(var.ty(), bytes).unwrap_or(Scalar::Byte(0))
    }

    /// Sets the value of the variable; reserved bits are masked (D22).
    ///
    /// # Errors
    /// [`NotForVariable`], with nothing changed, if the type is wrong or the value is not finite.
    pub(crate) fn set(&mut self, var: SysVar, value: Scalar) -> Result<(), NotForVariable> {
        if value.ty() != var.ty() || !value.is_finite() {
            return Err(NotForVariable { var, value });
        }
        let value = match value {
            Scalar::Byte(bits) => Scalar::Byte(bits & var.valid_bits()),
            other => other,
        };
        if let Some(place) = self.bytes.get_mut(var.image_offset()..) {
            value.encode(place);
        }
        Ok(())
    }

    /// The value of a byte variable, even if unknown.
    pub(crate) fn byte(&self, var: SysVar) -> u8 {
        self.bytes.get(var.image_offset()).copied().unwrap_or(0)
    }

    /// A bit of a byte variable, 0 or 1, even if unknown.
    pub(crate) fn bit(&self, var: SysVar, bit: u8) -> f64 {
        f64::from(self.byte(var).checked_shr(bit.into()).unwrap_or(0) & 1)
    }

    /// Sets the bits in `mask` of a byte variable.
    pub(crate) fn set_bits(&mut self, var: SysVar, mask: u8, value: u8) {
        if let Some(byte) = self.bytes.get_mut(var.image_offset()).filter(|_| var.is_bits()) {
            *byte = *byte & !mask | value & mask;
        }
    }

    pub(crate) fn assign(&mut self, var: SysVar, group: GroupId) {
        if let Some(slot) = self.group.get_mut(var.ordinal()) {
            *slot = group.0.saturating_add(1);
        }
    }

    pub(crate) fn group(&self, var: SysVar) -> Option<GroupId> {
        self.group.get(var.ordinal()).and_then(|slot| slot.checked_sub(1)).map(GroupId)
    }

    pub(crate) fn stamp(&mut self, group: GroupId, now: Instant) {
        if let Some(stamp) = self.stamps.get_mut(usize::from(group.0)) {
            *stamp = Stamp::at(now);
        }
    }

    pub(crate) fn stamp_of(&self, group: GroupId) -> Option<Instant> {
        self.stamps.get(usize::from(group.0)).filter(|&&at| at != Stamp::NEVER).map(|at| at.get())
    }

    /// Sets the variable to a value from its source. An unreadable value makes the variable unknown until a readable
    /// one arrives. Returns whether the value was readable.
    pub(crate) fn receive(&mut self, var: SysVar, value: Scalar) -> bool {
        let readable = self.set(var, value).is_ok();
        if !readable || self.any_unreadable {
            self.note_readable(var, readable);
        }
        readable
    }

    fn note_readable(&mut self, var: SysVar, readable: bool) {
        if readable {
            self.all_readable(core::iter::once(var));
        } else {
            self.unreadable.insert(var);
            self.any_unreadable = true;
        }
    }

    /// Records that the newest values of all these variables were readable.
    pub(crate) fn all_readable(&mut self, vars: impl Iterator<Item = SysVar>) {
        if self.any_unreadable {
            vars.for_each(|var| self.unreadable.remove(var));
            self.note_unreadable();
        }
    }

    fn note_unreadable(&mut self) {
        self.any_unreadable = !self.unreadable.is_empty()
            || self.unreadable_extra != ExtraSet::EMPTY
            || !self.withheld.is_empty();
    }

    /// The variables that have the age of their own newest value instead of their owner's frame.
    pub(crate) fn withheld(&self) -> InputSet {
        self.withheld
    }

    /// The variable's field was rejected: until it is accepted again, the variable has the age of this group.
    pub(crate) fn withhold(&mut self, var: SysVar, group: GroupId) {
        self.assign(var, group);
        self.withheld.insert(var);
        self.any_unreadable = true;
    }

    /// The variable's field is accepted again: the variable has the age of its frame's group.
    pub(crate) fn readmit(&mut self, var: SysVar, frame: GroupId) {
        self.assign(var, frame);
        self.withheld.remove(var);
        self.note_unreadable();
    }

    /// Whether the newest value of any variable or extra value was unreadable or rejected.
    pub(crate) fn has_unreadable(&self) -> bool {
        self.any_unreadable
    }

    /// Whether the variable's newest value was readable; true if there was none.
    pub(crate) fn is_readable(&self, var: SysVar) -> bool {
        !self.unreadable.contains(var)
    }

    /// Whether the newest values of all these variables and extra values were readable.
    pub(crate) fn can_read(&self, vars: &VarSet, extra: ExtraSet) -> bool {
        !self.any_unreadable || !self.unreadable.meets(vars) && !self.unreadable_extra.meets(extra)
    }

    /// The extra value with this number.
    pub(crate) fn extra(&self, nth: u8) -> f64 {
        self.extra.get(usize::from(nth)).copied().unwrap_or(f64::NAN)
    }

    /// Sets an extra value. A value that is not finite makes it unknown until a finite one arrives. Returns whether the
    /// value was finite.
    pub(crate) fn receive_extra(&mut self, nth: u8, value: f64) -> bool {
        let readable = value.is_finite();
        if let Some(place) = self.extra.get_mut(usize::from(nth))
            && readable
        {
            *place = value;
        }
        self.unreadable_extra.set(nth, !readable);
        if !readable {
            self.any_unreadable = true;
        } else if self.any_unreadable {
            self.all_readable(core::iter::empty());
        }
        readable
    }

    /// Age of the variable's value; `None` if no value has arrived or the newest was unreadable.
    pub fn age(&self, var: SysVar, now: Instant) -> Option<Duration> {
        self.known_since(var).map(|at| now.saturating_since(at))
    }

    /// Whether a value has arrived for the variable and the newest was readable.
    pub fn is_known(&self, var: SysVar) -> bool {
        self.known_since(var).is_some()
    }

    /// When the variable's value arrived; `None` if no value has arrived or the newest was unreadable.
    pub(crate) fn known_since(&self, var: SysVar) -> Option<Instant> {
        self.group(var).and_then(|group| self.stamp_of(group)).filter(|_| !self.unreadable.contains(var))
    }
}

/// A value that a variable cannot take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct NotForVariable {
    /// The variable.
    pub var: SysVar,
    /// The value.
    pub value: Scalar,
}

impl core::fmt::Display for NotForVariable {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let Self { var, value } = self;
        write!(f, "{var} needs a finite {}, not the {} {value}", var.ty(), value.ty())
    }
}

impl core::error::Error for NotForVariable {}

/// Applies the binding of a user-defined input field: `raw * scale + offset` as a value of `var`.
///
/// Integers are rounded to the nearest, halves away from zero. `None` if the result is not finite or out of the
/// variable's range: such a frame is rejected (D22).
pub(crate) fn bind_to_variable(var: SysVar, raw: Scalar, scale: f32, offset: f32) -> Option<Scalar> {
    let value = raw.as_f64() * f64::from(scale) + f64::from(offset);
    let value = if var.ty() == ScalarType::Float { value } else { round(value) };
    let scalar = Scalar::from_f64(var.ty(), value).ok()?;
    match scalar {
        Scalar::Byte(bits) if bits & !var.valid_bits() != 0 => None,
        scalar => scalar.is_finite().then_some(scalar),
    }
}

/// Applies the binding of a user-defined output field: `value * scale + offset` as type `ty`. Rounded like an input,
/// and saturated at the type's range. NaN becomes 0.
pub(crate) fn saturate_to_field(ty: ScalarType, value: f64, scale: f32, offset: f32) -> Scalar {
    let value = value * f64::from(scale) + f64::from(offset);
    let value = match ty {
        ScalarType::Float | ScalarType::Double => value,
        _ => round(value),
    };
    let (low, high) = ty.range();
    // `clamp` would panic if `low` were above `high`.
    let value = match value {
        _ if value.is_nan() => 0.0,
        _ if value < low => low,
        _ if value > high => high,
        _ => value,
    };
    Scalar::from_f64(ty, value).unwrap_or(Scalar::Byte(0))
}

/// Rounds to the nearest integer, halves away from zero; `core` has no `round`.
pub(crate) fn round(value: f64) -> f64 {
    // Beyond 2^52 every binary64 is an integer, and the cast below could saturate.
    if !(-4.5e15..=4.5e15).contains(&value) {
        return value;
    }
    let half = if value < 0.0 { -0.5 } else { 0.5 };
    (value + half) as i64 as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn var(name: &str) -> SysVar {
        SysVar::parse(name).unwrap()
    }

    #[test]
    fn a_value_is_packed_masked_and_aged() {
        let mut image = Image::new();
        let tool = var("DigitalOutputCommand[3]");
        image.set(tool, Scalar::Byte(0xFF)).unwrap();
        assert_eq!(image.value(tool), Scalar::Byte(0b11), "six bits are reserved");
        let word = var("WordInputReg[2]");
        image.set(word, Scalar::Word(0xBEEF)).unwrap();
        assert_eq!(image.bytes()[word.image_offset()..][..2], [0xEF, 0xBE]);
        assert_eq!(image.value(var("WordInputReg[1]")), Scalar::Word(0), "the neighbour is untouched");

        let group = GroupId(3);
        image.assign(word, group);
        assert_eq!(image.age(word, Instant::from_millis(5)), None);
        image.stamp(group, Instant::from_millis(5));
        assert_eq!(image.age(word, Instant::from_millis(12)), Some(Duration::from_millis(7)));
        image.stamp(group, Instant::NEVER);
        assert!(!image.is_known(word));
    }

    #[test]
    fn a_value_of_another_type_or_not_finite_changes_nothing() {
        let mut image = Image::new();
        let force = var("ForceEnd[1]");
        image.set(force, Scalar::Float(2.0)).unwrap();
        assert!(image.set(force, Scalar::Float(f32::NAN)).is_err());
        assert!(image.set(force, Scalar::Word(1)).is_err());
        assert_eq!(image.value(force), Scalar::Float(2.0));
    }

    #[test]
    fn what_cannot_be_read_is_unknown_until_it_can() {
        let mut image = Image::new();
        let pose = var("RobotState[8]");
        image.assign(pose, GroupId(1));
        image.stamp(GroupId(1), Instant::from_millis(5));
        assert!(image.receive(pose, Scalar::Float(1.5)) && image.is_known(pose));
        assert!(!image.receive(pose, Scalar::Float(f32::INFINITY)));
        assert_eq!((image.is_known(pose), image.age(pose, Instant::from_millis(6))), (false, None));
        assert!(image.receive(pose, Scalar::Float(2.5)) && image.is_known(pose));
    }

    #[test]
    fn bindings_round_and_refuse_or_saturate() {
        let word = var("WordInputReg[1]");
        let bind = |raw, scale, offset| bind_to_variable(word, raw, scale, offset);
        assert_eq!(bind(Scalar::Float(1.25), 10.0, 0.0), Some(Scalar::Word(13)));
        assert_eq!(bind(Scalar::Short(-1), 1.0, 0.0), None);
        assert_eq!(bind(Scalar::Dword(65_535), 1.0, 1.0), None);
        assert_eq!(bind(Scalar::Float(f32::INFINITY), 1.0, 0.0), None);
        assert_eq!(bind_to_variable(var("DigitalOutputCommand[3]"), Scalar::Byte(4), 1.0, 0.0), None);
        assert_eq!(
            bind_to_variable(var("FloatInputReg[1]"), Scalar::Byte(3), 0.5, 1.0),
            Some(Scalar::Float(2.5))
        );

        let field = |value, scale| saturate_to_field(ScalarType::Char, value, scale, 0.0);
        assert_eq!(field(-1.5, 1.0), Scalar::Char(-2));
        assert_eq!(field(1e9, 1.0), Scalar::Char(127));
        assert_eq!(field(f64::NAN, 1.0), Scalar::Char(0));
        assert_eq!(saturate_to_field(ScalarType::Double, 1e300, 1.0, 0.0), Scalar::Double(1e300));
    }
}
