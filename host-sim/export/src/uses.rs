//! Describes the use of a frame's field: where its value goes, or where it comes from.

use proto_core::config::{FieldSpec, InputBinding, OutputBinding};
use proto_core::sysvar::SysVar;

use crate::model::FrameField;

/// The use of a field's value, or its source; empty if there is none.
pub fn describe_use(field: &FrameField) -> String {
    let spec = &field.field.spec;
    if let Some(var) = field.system {
        return var.to_string();
    }
    if field.field.commands.is_some() {
        return "commands".into();
    }
    match spec {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => match *to {
            InputBinding::Variable { var, scale, offset } => format!("to {var}{}", formula(scale, offset)),
            InputBinding::Bit { var, bit } => format!("to {var}.{bit}"),
            InputBinding::Counter { max } => format!("counter, 0 to {max}"),
            InputBinding::Commands { .. } => "commands".into(),
            InputBinding::Unused => String::new(),
        },
        FieldSpec::UserOutput { from, .. } | FieldSpec::DeviceOutput { from, .. } => match *from {
            OutputBinding::Variable { var, scale, offset } => format!("from {var}{}", formula(scale, offset)),
            OutputBinding::Bit { var, bit } => format!("from {var}.{bit}"),
            OutputBinding::Constant(value) => format!("always {value}"),
            OutputBinding::Counter => "counter".into(),
            OutputBinding::CounterTo { max } => format!("counter, 0 to {max}"),
            OutputBinding::Reply => "result of the newest command".into(),
            OutputBinding::State { value, scale, offset } => format!("{value}{}", formula(scale, offset)),
            OutputBinding::Port { value, scale, offset, .. } => {
                let of =
                    field.field.of_port.as_ref().map_or("this port".into(), |port| format!("port {port}"));
                format!("{} of {of}{}", value.name(), formula(scale, offset))
            }
            OutputBinding::Link { link, scale, offset } => {
                let name = link.name().or(field.field.of_port.as_deref()).unwrap_or_default();
                format!("link {name} is up{}", formula(scale, offset))
            }
        },
        FieldSpec::Fixed { value, .. } => format!("always {value}"),
        FieldSpec::TextInput { to: Some(words), .. } => {
            format!("text to {} words from {}", words.count, words.first)
        }
        FieldSpec::TextInput { to: None, .. } => "text".into(),
        FieldSpec::TextOutput { from, .. } => format!("text from {} words from {}", from.count, from.first),
        FieldSpec::Length(_) => "length".into(),
        FieldSpec::System(_)
        | FieldSpec::Padding { .. }
        | FieldSpec::Checksum(_)
        // Not among the fields with names.
        | FieldSpec::Limits(_)
        | FieldSpec::Mapped(_)
        | FieldSpec::InputRule(_) => String::new(),
    }
}

/// ` = value * 0.1 + 5`; empty for the identity.
fn formula(scale: f32, offset: f32) -> String {
    if scale == 1.0 && offset == 0.0 {
        return String::new();
    }
    let times = if scale == 1.0 { String::new() } else { format!(" * {scale}") };
    let plus = match offset {
        0.0 => String::new(),
        offset if offset < 0.0 => format!(" - {}", -offset),
        offset => format!(" + {offset}"),
    };
    format!(" = value{times}{plus}")
}

/// The unit of a variable. Poses and forces have two units in the table: one for X, Y, Z and one for the rotations.
pub fn unit_of(var: SysVar) -> &'static str {
    match var.unit().split_once(", ") {
        None => var.unit(),
        Some((linear, angular)) => {
            if var.index().saturating_sub(var.span().first) < 3 {
                linear
            } else {
                angular
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_and_forces_have_two_units() {
        let unit = |name| unit_of(SysVar::parse(name).unwrap());
        assert_eq!((unit("RobotState[10]"), unit("RobotState[11]")), ("m", "rad"));
        assert_eq!((unit("ForceEnd[3]"), unit("ForceEnd[4]")), ("N", "Nm"));
        assert_eq!(
            (unit("RobotState[1]"), unit("RobotState[26]"), unit("WordInputReg[1]")),
            ("rad", "kg", "")
        );
    }
}
