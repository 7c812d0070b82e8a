//! Which field of a rejected frame has a value that is not accepted, and the accepted values.
//!
//! In: a frame of the recipe, with head and tail. Out: the first field for which a gateway rejects the frame, in words,
//! and the bytes as they are on the line, as `host-sim decode` takes them.

use proto_core::config::{FieldSpec, Fitting, InputBinding, InputRule};
use proto_core::device::{Boundary, Encoding};
use proto_core::engine::{Taken, judge_field};
use proto_core::wire::scalar::Scalar;

use crate::shape::Shape;

/// A field whose value is not accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Misfit {
    /// For example `field 1, for WordInputReg[1], is 400`.
    pub(crate) seen: String,
    /// For example `-327.68..=327.67`.
    pub(crate) expected: String,
}

/// The first field of a frame that is not accepted; `None` if all are, or the frame is not of the recipe.
pub(crate) fn misfit(shape: &Shape<'_>, frame: &[u8]) -> Option<Misfit> {
    match &shape.device {
        Some((device, fields, _)) => {
            let values = device.layout.values(&device.elements, frame);
            let numbered = (0..fields.len()).filter(|&at| fields[at].element().is_some());
            // In the file, rules of a field are keys of the field.
            let nth = |at: usize| 1 + fields[..at].iter().filter(|field| !field.is_of_field_before()).count();
            numbered.zip(values).find_map(|(at, value)| match value {
                Ok(value) => not_taken_device(nth(at), &fields[at..], value?),
                Err(_) if has_own_digits(&fields[at..]) => None,
                Err(why) => Some(Misfit {
                    seen: format!("{}: {why}", named(nth(at), &fields[at])),
                    expected: "a number there".into(),
                }),
            })
        }
        None => {
            let mut rest = frame.strip_prefix(shape.head)?;
            (1..).zip(shape.fields).find_map(|(nth, field)| {
                let ty = match *field {
                    FieldSpec::System(var) => var.ty(),
                    FieldSpec::UserInput { ty, .. } => ty,
                    _ => return None,
                };
                let (bytes, after) = rest.split_at_checked(ty.size())?;
                rest = after;
                not_taken(nth, field, Encoding::scalar(ty).read(bytes).ok()?)
            })
        }
    }
}

/// Whether digits may be absent or have a comma, in which case only the gateway can tell.
fn has_own_digits(fields: &[FieldSpec]) -> bool {
    let behind = fields.iter().skip(1).take_while(|field| field.is_of_field_before());
    behind
        .into_iter()
        .any(|rule| matches!(rule, FieldSpec::InputRule(InputRule::NoText(_) | InputRule::Comma)))
}

/// The first of these fields of a device's frame.
fn not_taken_device(nth: usize, fields: &[FieldSpec], value: Scalar) -> Option<Misfit> {
    let field = fields.first()?;
    let Some((taken, allowed)) = judge_field(fields, Ok(value), &[]) else {
        return not_taken(nth, field, value);
    };
    let Taken::Rejected(_) = taken else { return None };
    let name = named(nth, field);
    if !value.is_finite() {
        return not_taken(nth, field, value);
    }
    let expected = match allowed {
        Some((low, high)) => format!("{}..={} there", number(low), number(high)),
        None => "a number that its variable takes".into(),
    };
    Some(Misfit { seen: format!("{name} is {}", number(value.as_f64())), expected })
}

fn not_taken(nth: usize, field: &FieldSpec, value: Scalar) -> Option<Misfit> {
    let name = named(nth, field);
    if !value.is_finite() {
        return Some(Misfit { seen: format!("{name} is {value}"), expected: "a finite number there".into() });
    }
    if field.takes(value) {
        return None;
    }
    let expected = match field.fitting() {
        Some(Fitting { low, high, .. }) => format!("{}..={} there", number(low), number(high)),
        None => "a number that fits its variable".into(),
    };
    Some(Misfit { seen: format!("{name} is {}", number(value.as_f64())), expected })
}

/// The field's number in the file and its variable: a configuration has no names of fields.
fn named(nth: usize, field: &FieldSpec) -> String {
    let var = match *field {
        FieldSpec::System(var)
        | FieldSpec::UserInput { to: InputBinding::Variable { var, .. }, .. }
        | FieldSpec::DeviceInput { to: InputBinding::Variable { var, .. }, .. } => Some(var),
        _ => None,
    };
    var.map_or_else(|| format!("field {nth}"), |var| format!("field {nth}, for {var},"))
}

/// Removes digits that only the conversion to binary and back has added.
fn number(value: f64) -> String {
    let rounded = format!("{value:.6}").parse().unwrap_or(value);
    // Adding 0 removes a negative zero.
    format!("{}", rounded + 0.0)
}

/// A frame as the engine recorded it, with the bytes around it on the line; `None` if these are unknown.
pub(crate) fn on_line(shape: &Shape<'_>, kept: &[u8]) -> Option<Vec<u8>> {
    if shape.device.is_none() {
        return Some([shape.head, kept, shape.tail].concat());
    }
    let mut frame = kept.to_vec();
    if shape.boundary == Boundary::Tail && !frame.ends_with(shape.tail) {
        frame.extend(shape.tail);
    }
    if let Some(escape) = shape.escape {
        let len = frame.len();
        frame.resize(escape.longest(len), 0);
        let len = escape.stuff(len, &mut frame)?;
        frame.truncate(len);
    }
    Some(frame)
}
