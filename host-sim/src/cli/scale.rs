//! What becomes of a field's number on its way, as `check` shows it: scale, offset, and the numbers that fit.
//!
//! In: a field and its binding. Out: the end of its line, empty if the number stays as it is and always fits.

use proto_core::config::{FieldSpec, InputBinding, OutputBinding};
use proto_core::device::{Encoding, Overflow};
use proto_core::wire::scalar::ScalarType;

/// ` = value * 0.1 + 5, if in 0..=655300`.
pub(super) fn of_input(spec: &FieldSpec, to: &InputBinding) -> String {
    let InputBinding::Variable { var, scale, offset } = *to else { return String::new() };
    let (encoding, overflow) = match *spec {
        FieldSpec::UserInput { ty, .. } => (Encoding::scalar(ty), Overflow::Usual),
        FieldSpec::DeviceInput { encoding, overflow, .. } => (encoding, overflow),
        _ => return String::new(),
    };
    let formula = match formula("value", scale, offset) {
        formula if formula.is_empty() => formula,
        formula => format!(" = {formula}"),
    };
    if overflow == Overflow::Wrap {
        return format!("{formula}, wraps");
    }
    match fitting(&encoding, var.ty(), f64::from(scale), f64::from(offset)) {
        Some((low, high)) => format!("{formula}, if in {}..={}", number(low), number(high)),
        None => formula,
    }
}

/// ` * 0.1 + 5`, behind the source.
pub(super) fn of_output(spec: &FieldSpec) -> String {
    let wraps = match spec {
        FieldSpec::DeviceOutput { overflow: Overflow::Wrap, .. } => ", wraps",
        _ => "",
    };
    let scaled = match spec.source() {
        Some(
            OutputBinding::Variable { scale, offset, .. }
            | OutputBinding::State { scale, offset, .. }
            | OutputBinding::Port { scale, offset, .. },
        ) => formula("", scale, offset),
        _ => String::new(),
    };
    scaled + wraps
}

/// `value * 0.1 + 5`; empty if nothing is to be done.
fn formula(value: &str, scale: f32, offset: f32) -> String {
    let times = if scale == 1.0 { String::new() } else { format!(" * {scale}") };
    let plus = match offset {
        0.0 => String::new(),
        offset if offset < 0.0 => format!(" - {}", -offset),
        offset => format!(" + {offset}"),
    };
    if times.is_empty() && plus.is_empty() { String::new() } else { format!("{value}{times}{plus}") }
}

/// The field's numbers that fit the variable, if others do not. A frame with another one is rejected.
fn fitting(encoding: &Encoding, ty: ScalarType, scale: f64, offset: f64) -> Option<(f64, f64)> {
    if matches!(ty, ScalarType::Float | ScalarType::Double) {
        // Only a huge number would not fit.
        return None;
    }
    let (low, high) = encoding.range();
    // Of the variable, rounded as the engine rounds.
    let (least, most) = ty.range();
    let ends = [(least - 0.5 - offset) / scale, (most + 0.5 - offset) / scale];
    let (first, last) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
    if first < low && last > high {
        return None;
    }
    // Next to the end, where rounding decides, the number that surely fits.
    let exact = [(least - offset) / scale, (most - offset) / scale];
    let (first, last) = (exact[0].min(exact[1]), exact[0].max(exact[1]));
    let whole = encoding.is_integer();
    let first = if whole { first.ceil() } else { first };
    let last = if whole { last.floor() } else { last };
    Some((first.max(low), last.min(high)))
}

/// Without the digits that only the way to binary and back makes.
fn number(value: f64) -> String {
    let rounded = format!("{value:.6}").parse().unwrap_or(value);
    // A sum with 0 has no negative zero.
    format!("{}", rounded + 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proto_core::sysvar::SysVar;

    #[track_caller]
    fn input(ty: ScalarType, var: &str, scale: f32, offset: f32) -> String {
        let var = SysVar::parse(var).unwrap();
        let to = InputBinding::Variable { var, scale, offset };
        of_input(&FieldSpec::UserInput { ty, to }, &to)
    }

    #[test]
    fn what_stays_as_it_is_needs_no_words() {
        assert_eq!(input(ScalarType::Word, "WordInputReg[1]", 1.0, 0.0), "");
        assert_eq!(input(ScalarType::Byte, "WordInputReg[1]", 1.0, 0.0), "");
        assert_eq!(input(ScalarType::Double, "FloatInputReg[1]", 1.0, 0.0), "");
    }

    #[test]
    fn scales_offsets_and_the_numbers_that_fit_are_shown() {
        assert_eq!(input(ScalarType::Short, "FloatInputReg[1]", 0.01, 0.0), " = value * 0.01");
        assert_eq!(input(ScalarType::Short, "WordInputReg[1]", 1.0, 0.0), ", if in 0..=32767");
        assert_eq!(input(ScalarType::Short, "WordInputReg[1]", 1.0, 32768.0), " = value + 32768");
        assert_eq!(
            input(ScalarType::Char, "WordInputReg[1]", -2.0, -3.0),
            " = value * -2 - 3, if in -128..=-2"
        );
        assert_eq!(input(ScalarType::Int, "WordInputReg[1]", 10.0, 5.0), " = value * 10 + 5, if in 0..=6553");
        assert_eq!(
            input(ScalarType::Float, "WordInputReg[1]", 100.0, 0.0),
            " = value * 100, if in 0..=655.35"
        );
    }
}
