//! The range of an input field's numbers that fit its variable.
//!
//! In: a field and its binding. Out: the range. A frame with a number out of it is rejected (D22).

use super::{FieldSpec, InputBinding};
use crate::device::{Encoding, Overflow};
use crate::image::{bind_to_variable, round};
use crate::sysvar::SysVar;
use crate::wire::scalar::{Scalar, ScalarType};

/// The numbers of an input field that fit its variable.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Fitting {
    /// The variable.
    pub var: SysVar,
    /// The smallest number that certainly fits, in the field's unit: before scale and offset.
    pub low: f64,
    /// The largest number that certainly fits.
    pub high: f64,
}

/// An input field that writes a variable as a whole and does not wrap.
struct WrittenVariable {
    encoding: Encoding,
    var: SysVar,
    scale: f32,
    offset: f32,
}

impl FieldSpec {
    fn written(&self) -> Option<WrittenVariable> {
        let (encoding, to) = match *self {
            Self::UserInput { ty, to } => (Encoding::scalar(ty), to),
            Self::DeviceInput { encoding, overflow: Overflow::Usual, to } => (encoding, to),
            _ => return None,
        };
        match to {
            InputBinding::Variable { var, scale, offset } => {
                Some(WrittenVariable { encoding, var, scale, offset })
            }
            _ => None,
        }
    }

    /// The numbers of an input field that fit its variable. `None` if all numbers of the field fit, if it writes no
    /// variable, or if the variable is a float, which only huge numbers do not fit. Ignores entries that follow the
    /// field.
    pub fn fitting(&self) -> Option<Fitting> {
        let WrittenVariable { encoding, var, scale, offset } = self.written()?;
        let (low, high) = fitting_numbers(&encoding, (var, var.ty()), scale, offset)?;
        Some(Fitting { var, low, high })
    }

    /// Whether a number fits the input field's variable; true for a field that writes none.
    pub fn takes(&self, value: Scalar) -> bool {
        self.written().is_none_or(|to| bind_to_variable(to.var, value, to.scale, to.offset).is_some())
    }

    /// The variable, if the input field can have negative numbers but the variable cannot take them, without an offset
    /// or a negative scale; otherwise `None`.
    pub fn rejects_negative(&self) -> Option<SysVar> {
        let WrittenVariable { encoding, var, scale, offset } = self.written()?;
        let is_signed = encoding.range().0 < 0.0;
        let is_unsigned = var.ty().range().0 >= 0.0;
        (is_signed && is_unsigned && scale > 0.0 && offset == 0.0).then_some(var)
    }
}

/// The numbers of a field that fit its variable, whose numbers have this type; `None` if all fit.
pub(crate) fn fitting_numbers(
    encoding: &Encoding,
    (var, ty): (SysVar, ScalarType),
    scale: f32,
    offset: f32,
) -> Option<(f64, f64)> {
    if matches!(ty, ScalarType::Float | ScalarType::Double) {
        return None;
    }
    let (scale, offset) = (f64::from(scale), f64::from(offset));
    let (low, high) = encoding.range();
    let (least, most) = match (ty, ty.range()) {
        (ScalarType::Byte, (least, most)) => (least, most.min(f64::from(var.valid_bits()))),
        (_, range) => range,
    };
    let between = |one: f64, other: f64| (one.min(other), one.max(other));
    // Rounded to the variable's numbers like in the engine.
    let (first, last) = between((least - 0.5 - offset) / scale, (most + 0.5 - offset) / scale);
    if first < low && last > high {
        return None;
    }
    // At the ends, where rounding decides, uses a number that certainly fits.
    let (first, last) = between((least - offset) / scale, (most - offset) / scale);
    let (first, last) = match encoding.reads_integers() {
        true => (ceil(first), -ceil(-last)),
        false => (first, last),
    };
    Some((first.max(low), last.min(high)))
}

/// Rounds up to an integer; `core` has no `ceil`.
fn ceil(value: f64) -> f64 {
    let rounded = round(value);
    if rounded < value { rounded + 1.0 } else { rounded }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(ty: ScalarType, var: &str, scale: f32, offset: f32) -> FieldSpec {
        let var = SysVar::parse(var).unwrap();
        FieldSpec::UserInput { ty, to: InputBinding::Variable { var, scale, offset } }
    }

    fn ends(field: FieldSpec) -> Option<(f64, f64)> {
        field.fitting().map(|fitting| (fitting.low, fitting.high))
    }

    #[test]
    fn what_fits_is_what_is_taken() {
        use ScalarType::{Byte, Char, Double, Float, Int, Short, Word};
        for (ty, var, scale, offset, fitting) in [
            (Word, "WordInputReg[1]", 1.0, 0.0, None),
            (Byte, "WordInputReg[1]", 1.0, 0.0, None),
            (Double, "FloatInputReg[1]", 1.0, 0.0, None),
            (Short, "WordInputReg[1]", 1.0, 0.0, Some((0.0, 32_767.0))),
            (Short, "WordInputReg[1]", 1.0, 32_768.0, None),
            (Char, "WordInputReg[1]", -2.0, -3.0, Some((-128.0, -2.0))),
            (Int, "WordInputReg[1]", 10.0, 5.0, Some((0.0, 6_553.0))),
            (Float, "WordInputReg[1]", 100.0, 32_768.0, Some((-327.68, 327.67))),
        ] {
            let field = field(ty, var, scale, offset);
            assert_eq!(ends(field), fitting, "{ty} to {var}");
            let (low, high) = fitting.unwrap_or_else(|| ty.range());
            for value in [low, high].into_iter().filter(|value| value.abs() < 1e30) {
                let value = Scalar::from_f64(ty, value).unwrap();
                assert!(field.takes(value), "{ty} to {var}: {value}");
            }
        }
        let force = field(Float, "WordInputReg[1]", 100.0, 32_768.0);
        assert!(!force.takes(Scalar::Float(400.0)) && !force.takes(Scalar::Float(-400.0)));
        assert!(!force.takes(Scalar::Float(f32::NAN)));
    }

    #[test]
    fn negative_numbers_need_an_offset() {
        use ScalarType::{Byte, Float, Short, Word};
        for (ty, var, scale, offset, rejects) in [
            (Float, "WordInputReg[1]", 1.0, 0.0, true),
            (Short, "WordInputReg[1]", 100.0, 0.0, true),
            (Short, "WordInputReg[1]", 1.0, 32_768.0, false),
            (Short, "WordInputReg[1]", -1.0, 0.0, false),
            (Float, "FloatInputReg[1]", 1.0, 0.0, false),
            (Word, "WordInputReg[1]", 1.0, 0.0, false),
            (Byte, "WordInputReg[1]", 1.0, 0.0, false),
        ] {
            assert_eq!(field(ty, var, scale, offset).rejects_negative().is_some(), rejects, "{ty} to {var}");
        }
    }
}
