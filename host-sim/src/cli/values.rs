//! What becomes of a port's values, as `check` shows it: commands, and what happens when nothing comes.
//!
//! In: a checked configuration and the names of its fields. Out: aligned lines below the frames of a port.

use proto_core::config::{CommandWhen, GatewayConfig, OnStale, Port, SafeValue};
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::Duration;
use recipe_config::{DeviceRecipe, ExchangeKind, FieldCommands, NamedFrame};
use serde::Serialize;

use super::text;

/// What a value, or a range of values, of a field picks.
#[derive(Debug, Serialize)]
pub(super) struct Picks {
    field: String,
    /// `becomes`, `is`.
    when: &'static str,
    first: i64,
    last: i64,
    /// Absent for values that pick nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    command: Option<String>,
    /// `keep`, if the field keeps its base over a silence.
    #[serde(skip_serializing_if = "Option::is_none")]
    base: Option<&'static str>,
}

/// What becomes of a port's inputs without frames, and of its outputs without a source.
#[derive(Debug, Serialize)]
pub(super) struct Times {
    #[serde(skip_serializing_if = "Option::is_none")]
    timeout: Option<After>,
    #[serde(skip_serializing_if = "Option::is_none")]
    stale: Option<After>,
}

#[derive(Debug, Serialize)]
struct After {
    /// Absent if it never comes.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "millis")]
    after_ms: Option<Duration>,
    /// What happens then.
    then: String,
}

fn millis<S: serde::Serializer>(time: &Option<Duration>, to: S) -> Result<S::Ok, S::Error> {
    time.map(|time| time.as_micros() as f64 / 1e3).serialize(to)
}

/// Each command, or range of values that is idle.
pub(super) fn commands(recipe: &DeviceRecipe) -> Vec<Picks> {
    let asked = recipe.exchanges.iter().flat_map(|exchange| match exchange.kind {
        // What the master writes; the reply repeats it.
        ExchangeKind::Slave(_) => exchange.request.as_ref(),
        _ => exchange.reply.as_ref(),
    });
    recipe.part(Direction::Input).iter().chain(asked).flat_map(picks_of).collect()
}

fn picks_of(frame: &NamedFrame) -> impl Iterator<Item = Picks> {
    let fields = frame.fields.iter().filter_map(|field| Some((&field.name, field.commands.as_ref()?)));
    fields.flat_map(|(name, commands)| {
        commands.entries.iter().map(|(first, last, command)| Picks {
            field: name.clone(),
            when: verb(commands),
            first: *first,
            last: *last,
            command: (!command.is_empty()).then(|| command.clone()),
            base: (commands.when == CommandWhen::Kept).then_some("keep"),
        })
    })
}

/// A line for each command.
pub(super) fn show_commands(commands: &[Picks]) -> String {
    let row = |Picks { field, when, first, last, command, .. }: &Picks| {
        let values = if first == last { first.to_string() } else { format!("{first}..{last}") };
        let command = command.as_deref().unwrap_or("none, idle");
        [field.clone(), format!("{when} {values}"), command.to_owned()]
    };
    let rows: Vec<_> = commands.iter().map(row).collect();
    let width = |column: fn(&[String; 3]) -> &String| {
        rows.iter().map(|row| column(row).chars().count()).max().unwrap_or(0)
    };
    let (names, values) = (width(|row| &row[0]), width(|row| &row[1]));
    let line =
        |[name, value, command]: &[String; 3]| format!("    {name:names$}  {value:values$}  {command}\n");
    let lines: String = rows.iter().map(line).collect();
    let mut kept: Vec<_> =
        commands.iter().filter(|one| one.base.is_some()).map(|one| &one.field[..]).collect();
    kept.dedup();
    let kept = match &kept[..] {
        [] => String::new(),
        names => format!(
            "    over a silence, the last value of {} counts on; after the start, the first one picks nothing\n",
            names.join(", ")
        ),
    };
    if lines.is_empty() { lines } else { format!("  commands\n{lines}{kept}") }
}

fn verb(commands: &FieldCommands) -> &'static str {
    match commands.when {
        CommandWhen::Change | CommandWhen::Kept => "becomes",
        CommandWhen::Frame => "is",
    }
}

/// What happens to inputs without frames, and to an output without a source. A listening port has neither.
pub(super) fn times(config: &GatewayConfig, port: &Port) -> Times {
    let view = config.view();
    let Some(recipe) = config.recipes.get(usize::from(port.recipe)).filter(|_| port.bus.is_field()) else {
        return Times::NONE;
    };
    let written: Vec<SysVar> =
        view.written_by(recipe).chain(view.bits_written_by(recipe).map(|bit| bit.var)).collect();
    let has_input = view.fields_of(recipe, Direction::Input).next().is_some();
    let timeout = has_input.then(|| {
        let safe = port.on_timeout.of(&config.safe_values);
        let then = match (safe, written.is_empty()) {
            _ if port.timeout == Port::NEVER => "all values hold".to_owned(),
            ([], true) => String::new(),
            ([], false) => "all values hold".to_owned(),
            (safe, _) => {
                let bits = view.bits_written_by(recipe).count() + view.written_by(recipe).count();
                let others = if safe.len() < bits { "; others hold" } else { "" };
                format!("{}{others}", show_safe_values(safe))
            }
        };
        After { after_ms: Some(port.timeout).filter(|timeout| *timeout != Port::NEVER), then }
    });
    let shown =
        view.fields_of(recipe, Direction::Output).any(|(_, _, field)| field.variables().next().is_some());
    let stale = shown.then(|| {
        let then = match recipe.on_stale {
            OnStale::Hold => "the last values are sent",
            OnStale::Stop => "nothing is sent",
        };
        After { after_ms: Some(port.stale_after), then: then.to_owned() }
    });
    Times { timeout, stale }
}

impl Times {
    /// Of a port that has none.
    pub(super) const NONE: Self = Self { timeout: None, stale: None };

    /// As text.
    pub(super) fn show(&self) -> String {
        let mut report = String::new();
        if let Some(After { after_ms, then }) = &self.timeout {
            let then = if then.is_empty() { String::new() } else { format!(": {then}") };
            report += &match after_ms {
                None => format!("  timeout  never{then}\n"),
                Some(timeout) => format!("  timeout  {timeout} without a frame{then}\n"),
            };
        }
        if let Some(After { after_ms: Some(after), then }) = &self.stale {
            report += &format!("  stale    {after} without a source: {then}\n");
        }
        report
    }
}

/// `ForceEnd[1..6] = 0, BitInputReg[3].0,1 = 0`: neighbours and bits with the same value together.
fn show_safe_values(safe: &[SafeValue]) -> String {
    let mut runs: Vec<(SysVar, SysVar, Vec<u32>, String)> = Vec::new();
    for value in safe {
        let bit = (!value.is_whole()).then(|| value.mask.trailing_zeros());
        let number = match bit {
            Some(_) => u8::from(value.value.as_f64() != 0.0).to_string(),
            None => text::show_scalar(value.value),
        };
        match runs.last_mut() {
            Some((first, _, bits, same)) if *same == number && *first == value.var && !bits.is_empty() => {
                bits.extend(bit);
            }
            Some((_, last, bits, same))
                if *same == number
                    && bit.is_none()
                    && bits.is_empty()
                    && last.group() == value.var.group()
                    && last.ordinal() + 1 == value.var.ordinal() =>
            {
                *last = value.var;
            }
            _ => runs.push((value.var, value.var, bit.into_iter().collect(), number)),
        }
    }
    let show = |(first, last, bits, number): &(SysVar, SysVar, Vec<u32>, String)| {
        let bits: Vec<_> = bits.iter().map(u32::to_string).collect();
        match bits.is_empty() {
            false => format!("{first}.{} = {number}", bits.join(",")),
            true if first == last => format!("{first} = {number}"),
            true => format!("{}[{}..{}] = {number}", first.group(), first.index(), last.index()),
        }
    };
    runs.iter().map(show).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use proto_core::sysvar::VarBit;
    use proto_core::wire::scalar::Scalar;

    use super::*;

    fn var(name: &str) -> SysVar {
        SysVar::parse(name).unwrap()
    }

    fn bit(name: &str, on: bool) -> SafeValue {
        SafeValue::bit(VarBit::parse(name).unwrap().unwrap(), on)
    }

    #[test]
    fn neighbours_and_bits_with_the_same_safe_value_stand_together() {
        let float = |name: &str, value| SafeValue::new(var(name), Scalar::Float(value));
        let safe = [
            float("ForceEnd[1]", 0.0),
            float("ForceEnd[2]", 0.0),
            float("ForceEnd[3]", 1.5),
            float("ForceEnd[5]", 1.5),
            bit("BitInputReg[3].0", false),
            bit("BitInputReg[3].7", false),
            bit("BitInputReg[3].4", true),
            bit("BitInputReg[4].4", true),
        ];
        assert_eq!(
            show_safe_values(&safe),
            "ForceEnd[1..2] = 0, ForceEnd[3] = 1.5, ForceEnd[5] = 1.5, BitInputReg[3].0,7 = 0, \
             BitInputReg[3].4 = 1, BitInputReg[4].4 = 1"
        );
    }

    /// What a port with these keys shows, with a field for three commands and one for a variable.
    #[track_caller]
    fn shown(field: &str, port: &str) -> String {
        let toml = format!(
            "[controller]\naddress = \"a\"\n[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n\
             [recipe.input]\nhead = [1]\nfields = [{{ name = \"order\", type = \"byte\", {field} }},\n\
             {{ name = \"part\", type = \"word\", to = \"WordInputReg[1]\" }}]\n\
             [[port]]\nname = \"p\"\nbus = \"rs485\"\nrecipe = \"r\"\n{port}"
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("test.toml");
        std::fs::write(&path, toml).unwrap();
        let config = recipe_config::file::load_gateway(&path, &[]).unwrap();
        let frames = recipe_config::file::load_frames(&path, &[]).unwrap();
        [show_commands(&commands(frames[0].as_ref().unwrap())), times(&config, &config.ports[0]).show()]
            .concat()
    }

    #[test]
    fn commands_have_their_values_and_when_they_act() {
        let values = "commands = { \"1..100\" = \"speed({value})\", 200 = \"stop\" }";
        let safe = "on_timeout = { \"WordInputReg[1]\" = 7 }";
        assert_eq!(
            shown(&format!("{values}, idle = 255"), safe),
            "  commands\n    order  becomes 1..100  speed({value})\n    order  becomes 200     stop\n    \
             order  becomes 255     none, idle\n  timeout  100 ms without a frame: WordInputReg[1] = 7\n"
        );
        let kept = shown(&format!("{values}, base = \"keep\""), "");
        assert!(
            kept.contains(
                "order  becomes 200     stop\n    over a silence, the last value of order counts on; after the \
                 start, the first one picks nothing\n"
            ),
            "{kept}"
        );
        let level = shown("bits = 3, commands = { level = \"stop\" }", "timeout_ms = 250");
        assert_eq!(
            level,
            "  commands\n    order  is 1  stop\n  timeout  250 ms without a frame: all values hold\n"
        );
    }

    #[test]
    fn a_port_that_is_never_overdue_says_so() {
        let shown = shown("to = \"WordInputReg[2]\"", "timeout_ms = \"never\"");
        assert_eq!(shown, "  timeout  never: all values hold\n");
    }

    #[test]
    fn values_without_a_safe_value_hold() {
        let two = "to = \"WordInputReg[2]\"";
        let shown = shown(two, "on_timeout = { \"WordInputReg[2]\" = 0 }");
        assert_eq!(shown, "  timeout  100 ms without a frame: WordInputReg[2] = 0; others hold\n");
    }
}
