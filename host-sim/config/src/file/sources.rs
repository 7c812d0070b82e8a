//! Sources of output fields other than variables, and the variables that show a port's health.
//!
//! In: `controller.mode`, `port.alive`, `port.NAME.alive`, `link.modbus.up`, and `health = { ... }` of a port. Out: the
//! bindings and variables of the configuration.

use proto_core::config::{LinkSource, OutputBinding, PortHealth, PortValue, StateValue};
use proto_core::sysvar::SysVar;

use super::names::{did_you_mean, meant_variable};
use super::reader::{Result, Spot, TableValue};
use crate::keys::gateway::HEALTH_TABLE;

/// Values that the gateway requests on port 2000 only when a device selects the command.
const ASKED: [&str; 3] = ["last_error", "state", "isprogfinish"];

/// A source. If it belongs to a port, also the port's name and place, because the port may come after the recipe in the
/// file.
pub(super) type FileSource = (OutputBinding, Option<(String, Spot)>);

/// Whether the text names a source of this kind.
pub(super) fn is_source(text: &str) -> bool {
    ["controller.", "port.", "link."].iter().any(|kind| text.starts_with(kind))
}

/// Reads the source of an output field.
pub(super) fn read(item: &TableValue<'_>, text: &str, scale: f32, offset: f32) -> Result<FileSource> {
    if let Some(name) = text.strip_prefix("controller.") {
        if ASKED.contains(&name) {
            return Err(item.error(format!(
                "{text:?} is not in the state packet, and replies of port 2000 are no source; \
                 the packet has controller.error_code, .robot_state and .program_state"
            )));
        }
        let value = StateValue::parse(name).map_err(|error| item.error(format!("{text:?}: {error}")))?;
        return Ok((OutputBinding::State { value, scale, offset }, None));
    }
    if let Some(rest) = text.strip_prefix("link.") {
        return read_link(item, text, rest, (scale, offset));
    }
    let rest = text.strip_prefix("port.").unwrap_or(text);
    let (name, value) = match rest.rsplit_once('.') {
        Some((name, value)) => (Some(name), value),
        None => (None, rest),
    };
    let value = read_value(item, value)?;
    let binding = OutputBinding::Port { port: None, value, scale, offset };
    Ok((binding, name.map(|name| (name.to_owned(), item.spot.clone()))))
}

/// `link.modbus.up`, or `link.NAME.up` of a listening port.
fn read_link(
    item: &TableValue<'_>,
    text: &str,
    rest: &str,
    (scale, offset): (f32, f32),
) -> Result<FileSource> {
    let Some((name, "up")) = rest.rsplit_once('.') else {
        return Err(
            item.error(format!("{text:?} is not known of a link; write for example \"link.modbus.up\""))
        );
    };
    if let Some(link) = LinkSource::named(name) {
        return Ok((OutputBinding::Link { link, scale, offset }, None));
    }
    let binding = OutputBinding::Link { link: LinkSource::Listening(0), scale, offset };
    Ok((binding, Some((name.to_owned(), item.spot.clone()))))
}

fn read_value(item: &TableValue<'_>, name: &str) -> Result<PortValue> {
    PortValue::named(name).ok_or_else(|| {
        let names = PortValue::NAMES.map(|(name, _)| name);
        let meant = did_you_mean(name, names.into_iter());
        item.error(format!("{name:?} is not known of a port; allowed: {}{meant}", names.join(", ")))
    })
}

pub(super) fn of_port(
    binding: OutputBinding,
    name: &str,
    ports: &[String],
) -> std::result::Result<OutputBinding, String> {
    let index = ports.iter().position(|port| port == name);
    match (binding, index.and_then(|index| u8::try_from(index).ok())) {
        (OutputBinding::Port { value, scale, offset, .. }, Some(index)) => {
            Ok(OutputBinding::Port { port: Some(index), value, scale, offset })
        }
        (OutputBinding::Link { scale, offset, .. }, Some(index)) => {
            Ok(OutputBinding::Link { link: LinkSource::Listening(index), scale, offset })
        }
        (OutputBinding::Link { .. }, None) => {
            let names = LinkSource::NAMES.map(|(name, _)| name);
            let meant = did_you_mean(name, names.into_iter().chain(ports.iter().map(String::as_str)));
            Err(format!(
                "there is no link {name:?}; there are {}, and the ports that listen{meant}",
                names.join(", ")
            ))
        }
        (OutputBinding::Port { .. }, None) => {
            let meant = did_you_mean(name, ports.iter().map(String::as_str));
            Err(format!("there is no port {name:?}; there are {}{meant}", ports.join(", ")))
        }
        _ => Ok(binding),
    }
}

/// Reads the variables that show a port's health.
pub(super) fn read_health(item: &TableValue<'_>) -> Result<PortHealth> {
    let table = item.table(&HEALTH_TABLE)?;
    let mut health = PortHealth::NONE;
    for (name, value) in PortValue::NAMES {
        let Some(item) = table.optional(name) else { continue };
        let text = item.string()?;
        if text.rsplit_once("].").is_some() {
            return Err(item.error(format!(
                "{text:?} is a bit; the health of a port goes to whole words and floats: WordInputReg, \
                 FloatInputReg"
            )));
        }
        let var = SysVar::parse(text)
            .map_err(|error| item.error(format!("{text:?}: {error}{}", meant_variable(text))))?;
        health.set(value, var);
    }
    Ok(health)
}
