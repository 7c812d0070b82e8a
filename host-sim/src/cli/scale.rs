//! What becomes of a field's number on its way, as `check` shows it: scale, offset, and the numbers that fit.
//!
//! In: a field and its binding. Out: the end of its line, empty if the number stays as it is and always fits.

use proto_core::config::{
    FieldSpec, Fitting, InputBinding, InputRule, Limits, MapEntry, OutputBinding, Outside,
};
use proto_core::device::Overflow;
use proto_core::engine::{Taken, judge_field};
use proto_core::wire::scalar::Scalar;

/// ` = value * 0.1 + 5, if in 0..=655300`.
pub(super) fn of_input(spec: &FieldSpec, to: &InputBinding, behind: &[FieldSpec]) -> String {
    let InputBinding::Variable { scale, offset, .. } = *to else { return String::new() };
    let formula = match formula("value", scale, offset) {
        formula if formula.is_empty() => formula,
        formula => format!(" = {formula}"),
    };
    if matches!(spec, FieldSpec::DeviceInput { overflow: Overflow::Wrap, .. }) {
        return format!("{formula}, wraps");
    }
    // Values that these let pass are shown after it.
    let is_outside_shown =
        |rule: &FieldSpec| matches!(rule, FieldSpec::InputRule(InputRule::Int16) | FieldSpec::Mapped(_));
    match spec.fitting().filter(|_| !behind.iter().any(is_outside_shown)) {
        Some(fitting) => format!("{formula}, if in {}", range(&fitting)),
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
            | OutputBinding::Port { scale, offset, .. }
            | OutputBinding::Link { scale, offset, .. },
        ) => formula("", scale, offset),
        _ => String::new(),
    };
    scaled + wraps
}

/// `, if in 0..=100`, `, clamped to 0..=100`, or `, 0: 1, 1..7: 2`, behind all that; empty if any number is sent.
pub(super) fn of_sendable(sendable: &[FieldSpec]) -> String {
    let show = |spec: &FieldSpec| match *spec {
        FieldSpec::Limits(Limits { low, high, outside }) => {
            let how = match outside {
                Outside::Refuse => "if in",
                Outside::Clamp => "clamped to",
            };
            format!(", {how} {}..={}", number(low), number(high))
        }
        FieldSpec::Mapped(MapEntry { first, last, sent }) if first == last => {
            format!(", {first}: {}", number(sent))
        }
        FieldSpec::Mapped(MapEntry { first, last, sent }) => format!(", {first}..{last}: {}", number(sent)),
        FieldSpec::InputRule(rule) => match rule {
            InputRule::Int16 => ", as int16 if in -32768..=32767".into(),
            InputRule::Else(becomes) => format!(", else: {}", number(becomes)),
            InputRule::NoNumber(code) => format!(", no value: {}", number(code)),
            InputRule::NoText(text) => format!(", no value: {:?}", String::from_utf8_lossy(text.bytes())),
            InputRule::Comma => ", with a comma".into(),
            InputRule::ValidTo { var, bit: Some(bit) } => format!(", valid -> {var}.{bit}"),
            InputRule::ValidTo { var, bit: None } => format!(", valid -> {var}"),
            _ => String::new(),
        },
        _ => String::new(),
    };
    sendable.iter().map(show).collect()
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

/// Why a gateway rejects a field of a device's frame, the first of these, with this value; `None` if it takes it.
pub(super) fn refused_field(fields: &[FieldSpec], name: &str, value: Scalar) -> Option<String> {
    let (taken, allowed) = judge_field(fields, Ok(value), &[])?;
    if !value.is_finite() || !matches!(taken, Taken::Rejected(_)) {
        return None;
    }
    let value = number(value.as_f64());
    let var = fields.first().and_then(FieldSpec::variable)?;
    Some(match allowed {
        Some((low, high)) => format!("{name} is {value}; {var} takes {}..={}", number(low), number(high)),
        None => format!("{name} is {value}, which {var} does not take"),
    })
}

/// Why a gateway rejects a frame with this value of an input field; `None` if it takes it.
pub(super) fn refused(spec: &FieldSpec, name: &str, value: Scalar) -> Option<String> {
    if !value.is_finite() || spec.takes(value) {
        return None;
    }
    let allowed = match spec.fitting() {
        Some(fitting) => format!("{}; {} takes {}", number(value.as_f64()), fitting.var, range(&fitting)),
        None => format!("{}, which does not fit its variable", number(value.as_f64())),
    };
    Some(format!("{name} is {allowed}"))
}

/// `0..=655.35`.
pub(super) fn range(fitting: &Fitting) -> String {
    format!("{}..={}", number(fitting.low), number(fitting.high))
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
    use proto_core::wire::scalar::ScalarType;

    #[track_caller]
    fn input(ty: ScalarType, var: &str, scale: f32, offset: f32) -> String {
        let var = SysVar::parse(var).unwrap();
        let to = InputBinding::Variable { var, scale, offset };
        of_input(&FieldSpec::UserInput { ty, to }, &to, &[])
    }

    #[test]
    fn what_a_field_may_send_is_shown() {
        let limits = |outside| [FieldSpec::Limits(Limits { low: -0.5, high: 100.0, outside })];
        assert_eq!(of_sendable(&limits(Outside::Refuse)), ", if in -0.5..=100");
        assert_eq!(of_sendable(&limits(Outside::Clamp)), ", clamped to -0.5..=100");
        let entry = |first, last, sent| FieldSpec::Mapped(MapEntry { first, last, sent });
        assert_eq!(of_sendable(&[entry(0, 0, 1.0), entry(1, 7, 2.0)]), ", 0: 1, 1..7: 2");
        assert_eq!(of_sendable(&[]), "");
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
