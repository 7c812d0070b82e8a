//! The bindings of fields and the triggers of output parts in a gateway file.

use proto_core::config::{InputBinding, OnStale, OutputBinding, SendOn};
use proto_core::device::Encoding;
use proto_core::sysvar::SysVar;

use super::commands::{self, FileCommands};
use super::encoding::refuse;
use super::reader::{Item, Reader, Result, Spot};
use super::sources;

/// The binding of an input field.
pub(super) enum FileInput {
    Unused,
    Variable {
        var: SysVar,
        scale: f32,
        offset: f32,
    },
    Commands(FileCommands),
    /// An alive counter, which goes from this number to 0.
    Counter {
        max: u32,
    },
}

impl FileInput {
    /// The binding, if it needs no table of commands.
    pub(super) fn without_commands(&self) -> InputBinding {
        match *self {
            Self::Variable { var, scale, offset } => InputBinding::Variable { var, scale, offset },
            Self::Counter { max } => InputBinding::Counter { max },
            Self::Unused | Self::Commands(_) => InputBinding::Unused,
        }
    }
}

/// The source of an output field.
pub(super) enum FileOutput {
    /// A program of the controller sets it.
    Program,
    Bound(OutputBinding),
    /// The health of a port with this name, which may stand behind the recipe.
    PortNamed {
        name: String,
        spot: Spot,
        binding: OutputBinding,
    },
}

/// When an output part is sent.
#[derive(Default)]
pub(super) struct Sending {
    pub(super) on_stale: OnStale,
    pub(super) send: SendOn,
    pub(super) send_spot: Option<Spot>,
}

pub(super) fn read_sending(part: &Reader<'_>) -> Result<Sending> {
    let mut sending = Sending::default();
    if let Some(item) = part.optional("on_stale") {
        sending.on_stale = item.choice(&[("hold", OnStale::Hold), ("stop", OnStale::Stop)])?;
    }
    if let Some(item) = part.optional("send") {
        sending.send = read_send(&item)?;
        sending.send_spot = Some(item.spot);
    }
    Ok(sending)
}

fn read_send(item: &Item<'_>) -> Result<SendOn> {
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

/// `rising:BitOutputReg[3].0`; `others` are allowed too.
pub(super) fn read_rising(item: &Item<'_>, text: &str, others: &str) -> Result<(SysVar, u8)> {
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
    let var = SysVar::parse(name).map_err(|error| item.error(format!("{name:?}: {error}")))?;
    Ok((var, bit))
}

/// The bindings of an input field: `to`, `commands`, or both.
pub(super) fn read_input(field: &Reader<'_>) -> Result<(FileInput, Option<FileInput>)> {
    let (to, commands) = (field.optional("to"), field.optional("commands"));
    if to.is_none() {
        refuse(field, &["scale", "offset"], "allowed only together with to")?;
    }
    if commands.is_none() {
        refuse(field, &commands::KEYS, "allowed only together with commands")?;
    }
    let to = match to {
        Some(to) => {
            let (scale, offset) = read_scale(field)?;
            Some(FileInput::Variable { var: read_var(&to)?, scale, offset })
        }
        None => None,
    };
    let commands = commands.map(|item| commands::read(field, &item).map(FileInput::Commands)).transpose()?;
    Ok(match (to, commands) {
        (Some(to), commands) => (to, commands),
        (None, Some(commands)) => (commands, None),
        (None, None) => (FileInput::Unused, None),
    })
}

/// `counter = true` or `counter = { max = 14 }`: the number behind which the counter is 0 again.
pub(super) fn read_counter(field: &Reader<'_>, encoding: &Encoding) -> Result<Option<u32>> {
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
    let max = item.table(&["max"])?.required("max", "the highest number of the counter")?;
    max.integer(1..=i64::from(high)).map(Some)
}

pub(super) fn read_output(field: &Reader<'_>) -> Result<FileOutput> {
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
            _ => {
                let (scale, offset) = read_scale(field)?;
                OutputBinding::Variable { var: read_var(&from)?, scale, offset }
            }
        },
    };
    if !matches!(binding, OutputBinding::Variable { .. }) {
        refuse(
            field,
            &["scale", "offset"],
            "allowed only together with from = a variable or another value that it can scale",
        )?;
    }
    Ok(FileOutput::Bound(binding))
}

fn read_var(item: &Item<'_>) -> Result<SysVar> {
    let name = item.string()?;
    SysVar::parse(name).map_err(|error| item.error(format!("{name:?}: {error}")))
}

fn read_scale(field: &Reader<'_>) -> Result<(f32, f32)> {
    let read = |key, default| match field.optional(key) {
        Some(item) => {
            let value = item.number()? as f32;
            if value.is_finite() { Ok(value) } else { Err(item.error("out of range for a float")) }
        }
        None => Ok(default),
    };
    Ok((read("scale", 1.0)?, read("offset", 0.0)?))
}
