//! The bindings of fields and the triggers of output parts in a gateway file.

use proto_core::config::{InputBinding, OnStale, OutputBinding, SendOn};
use proto_core::device::Encoding;
use proto_core::sysvar::{SysVar, VarBit};

use super::commands::{self, FileCommands};
use super::encoding::refuse;
use super::model::Sending;
use super::names::meant_variable;
use super::reader::{Result, TableReader, TableValue};
use super::sources::{self, FileSource};
use crate::keys::field::COUNTER_TABLE;
use crate::keys::recipe::ON_STALES;

pub(super) fn read_on_stale(item: &TableValue<'_>) -> Result<OnStale> {
    item.choice(&ON_STALES)
}

pub(super) fn read_sending(part: &TableReader<'_>) -> Result<Sending> {
    let mut sending = Sending::default();
    if let Some(item) = part.optional("on_stale") {
        sending.on_stale = read_on_stale(&item)?;
    }
    if let Some(item) = part.optional("send") {
        sending.send = read_send(&item)?;
        sending.send_spot = Some(item.spot);
    }
    Ok(sending)
}

fn read_send(item: &TableValue<'_>) -> Result<SendOn> {
    let text = item.string()?;
    match text {
        "period" => return Ok(SendOn::Period),
        "change" => return Ok(SendOn::Change),
        "frame" => return Ok(SendOn::Frame),
        _ => {}
    }
    let (var, bit) = read_rising(item, text, "\"period\", \"change\", \"frame\"")?;
    Ok(SendOn::Rising { var, bit })
}

/// Reads a trigger such as `rising:BitOutputReg[3].0`; `others` lists the other allowed texts for messages.
pub(super) fn read_rising(item: &TableValue<'_>, text: &str, others: &str) -> Result<(SysVar, u8)> {
    let Some(place) = text.strip_prefix("rising:") else {
        return Err(
            item.error(format!("{text:?} is unknown; allowed: {others}, \"rising:BitOutputReg[3].0\""))
        );
    };
    let bit = place.rsplit_once('.').and_then(|(name, bit)| Some((name, bit.parse::<u8>().ok()?)));
    let Some((name, bit)) = bit else {
        return Err(
            item.error(format!("{text:?} names no bit; write for example \"rising:BitOutputReg[3].0\""))
        );
    };
    let var = SysVar::parse(name)
        .map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
    Ok((var, bit))
}

/// Reads the bindings of an input field: `to`, `commands`, or both.
pub(super) fn read_input(field: &TableReader<'_>) -> Result<(Option<InputBinding>, Option<FileCommands>)> {
    let (to, commands) = (field.optional("to"), field.optional("commands"));
    if to.is_none() {
        refuse(field, &["scale", "offset"], "allowed only together with to")?;
    }
    if commands.is_none() {
        refuse(field, &["when", "base", "idle"], "allowed only together with commands")?;
    }
    let to = to.map(|to| read_to(field, &to)).transpose()?;
    Ok((to, commands.map(|item| commands::read(field, &item)).transpose()?))
}

/// Reads the target of an input field: a variable, or one bit of it.
fn read_to(field: &TableReader<'_>, to: &TableValue<'_>) -> Result<InputBinding> {
    let name = to.string()?;
    if let Some(bit) = VarBit::parse(name) {
        refuse(
            field,
            &["scale", "offset"],
            "not allowed for a bit: it is off for 0 and on for any other value",
        )?;
        let VarBit { var, bit } =
            bit.map_err(|error| to.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
        return Ok(InputBinding::Bit { var, bit });
    }
    let (scale, offset) = read_scale(field)?;
    Ok(InputBinding::Variable { var: read_var(to)?, scale, offset })
}

/// Reads `counter = true` or `counter = { max = 14 }`: the number after which the counter restarts at 0.
pub(super) fn read_counter(field: &TableReader<'_>, encoding: &Encoding) -> Result<Option<u32>> {
    let Some(item) = field.optional("counter") else { return Ok(None) };
    let (low, high) = encoding.range();
    if !encoding.is_integer() || low != 0.0 {
        return Err(item.error("a counter needs a field that has unsigned integers only"));
    }
    let high = high.min(f64::from(u32::MAX)) as u32;
    if !item.is_table() {
        return match item.bool()? {
            true => Ok(Some(high)),
            false => Ok(None),
        };
    }
    let max = item.table(&COUNTER_TABLE)?.required("max", "the highest number of the counter")?;
    max.integer(1..=i64::from(high)).map(Some)
}

pub(super) fn read_output(field: &TableReader<'_>) -> Result<FileSource> {
    let (from, value) = (field.optional("from"), field.optional("value"));
    let binding = match (from, value) {
        (None, None) => {
            return Err(field.error(
                "no value to send; add from = \"RobotState[8]\", from = \"counter\", from = \"reply\" \
                 or value = 125",
            ));
        }
        (Some(_), Some(value)) => return Err(value.error("a field takes from or value, not both")),
        (None, Some(value)) => OutputBinding::Constant(value.number()?),
        (Some(from), None) => match from.string()? {
            "counter" => OutputBinding::Counter,
            "reply" => OutputBinding::Reply,
            text if sources::is_source(text) => {
                let (scale, offset) = read_scale(field)?;
                return sources::read(&from, text, scale, offset);
            }
            name => match VarBit::parse(name) {
                Some(bit) => {
                    refuse(field, &["scale", "offset"], "not allowed for a bit: it is 0 or 1")?;
                    let VarBit { var, bit } = bit
                        .map_err(|error| from.error(format!("{name:?}: {error}{}", meant_variable(name))))?;
                    return Ok((OutputBinding::Bit { var, bit }, None));
                }
                None => {
                    let (scale, offset) = read_scale(field)?;
                    OutputBinding::Variable { var: read_var(&from)?, scale, offset }
                }
            },
        },
    };
    if !matches!(binding, OutputBinding::Variable { .. }) {
        refuse(
            field,
            &["scale", "offset"],
            "allowed only together with from = a variable or another value that it can scale",
        )?;
    }
    Ok((binding, None))
}

pub(super) fn read_var(item: &TableValue<'_>) -> Result<SysVar> {
    let name = item.string()?;
    SysVar::parse(name).map_err(|error| item.error(format!("{name:?}: {error}{}", meant_variable(name))))
}

fn read_scale(field: &TableReader<'_>) -> Result<(f32, f32)> {
    let read = |key, default| match field.optional(key) {
        Some(item) => {
            let value = item.number()? as f32;
            if value.is_finite() { Ok(value) } else { Err(item.error("out of range for a float")) }
        }
        None => Ok(default),
    };
    Ok((read("scale", 1.0)?, read("offset", 0.0)?))
}
