//! Shared by findings about commands.

use proto_core::config::{FieldSpec, InputBinding};
use proto_core::time::Duration;

/// ` 12 s ago`, to append to an event.
pub(crate) fn ago(age: Duration) -> String {
    format!(" {} s ago", age.as_millis() / 1000)
}

/// How long a failed command is reported.
pub(crate) const REPORTED_FOR: Duration = Duration::from_secs(60);

/// Whether a value of the field can pick a command.
pub(crate) fn is_command(field: &FieldSpec) -> bool {
    match field {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => {
            matches!(to, InputBinding::Commands { .. })
        }
        _ => false,
    }
}
