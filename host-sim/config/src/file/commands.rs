//! The command table of an input field in a gateway file.
//!
//! In: `commands`, and the keys that say when a value selects a command. Out: ranges of values, each with the command
//! that it selects.

use proto_core::config::CommandWhen;

use super::reader::{Result, Spot, TableReader, TableValue};
use crate::device::FieldCommands;
use crate::keys::field::{BASES, IDLE, WHEN, WHENS};

/// The commands of a field, and the places of the entries.
pub(super) type FileCommands = (FieldCommands, Vec<Spot>);

/// First and last value, the command, and its place; the command is empty for values that select none.
type FileCommand = ((i64, i64, String), Spot);

fn with_places(when: CommandWhen, entries: Vec<FileCommand>) -> FileCommands {
    let (entries, spots) = entries.into_iter().unzip();
    (FieldCommands { when, entries }, spots)
}

/// An edge or a level of a one-bit field, instead of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum BitKey {
    Rising,
    Falling,
    Level,
}

const BIT_KEYS: [(&str, BitKey); 3] =
    [("rising", BitKey::Rising), ("falling", BitKey::Falling), ("level", BitKey::Level)];

pub(super) fn read(field: &TableReader<'_>, commands: &TableValue<'_>) -> Result<FileCommands> {
    let table = commands.any_table()?;
    let keys: Vec<_> = table.entries().filter_map(|(key, ..)| bit_key(key)).collect();
    if keys.is_empty() {
        return read_values(field, commands, &table);
    }
    read_bit(field, &table, &keys)
}

fn read_values(
    field: &TableReader<'_>,
    commands: &TableValue<'_>,
    table: &TableReader<'_>,
) -> Result<FileCommands> {
    let mut entries = table.entries().map(read_command).collect::<Result<Vec<_>>>()?;
    if entries.is_empty() {
        return Err(commands.error("no commands; write for example { 1 = \"run(pick.jspf,50)\" }"));
    }
    let mut when = field.word_or(&WHEN, &WHENS)?;
    if let Some(item) = keeps_base(field)? {
        if when == CommandWhen::Frame {
            return Err(item.error("allowed only with when = \"change\": each frame picks its command here"));
        }
        when = CommandWhen::Kept;
    }
    if let Some(item) = field.optional("idle") {
        let value = item.integer(IDLE.integers())?;
        entries.push(((value, value, String::new()), item.spot));
    }
    Ok(with_places(when, entries))
}

/// Reads the commands for the edges or the level of one bit.
fn read_bit(field: &TableReader<'_>, table: &TableReader<'_>, keys: &[BitKey]) -> Result<FileCommands> {
    let is_level = keys.contains(&BitKey::Level);
    let mut entries = Vec::new();
    for (key, key_spot, item) in table.entries() {
        let wrong = |why: &str| item.clone().at(key_spot.clone()).error(why);
        let value = match bit_key(key) {
            _ if !has_one_bit(field) => {
                return Err(wrong("allowed only for a field with one bit, such as bits = 3"));
            }
            None => return Err(wrong("a value, beside the edges of a bit; allowed: rising, falling")),
            Some(BitKey::Level) if keys.len() > 1 => {
                return Err(wrong("a level, beside edges; allowed: level alone, or rising and falling"));
            }
            Some(BitKey::Rising | BitKey::Level) => 1,
            Some(BitKey::Falling) => 0,
        };
        entries.push(((value, value, read_text(&item)?), item.spot));
    }
    for key in ["when", "idle"] {
        if let Some(item) = field.optional(key) {
            return Err(item.error("not allowed together with rising, falling or level, which say it"));
        }
    }
    let when = match keeps_base(field)? {
        Some(item) if is_level => {
            return Err(item.error("not allowed together with level: each frame picks its command"));
        }
        Some(_) => CommandWhen::Kept,
        None if is_level => CommandWhen::Frame,
        None => CommandWhen::Change,
    };
    if keys == [BitKey::Falling] {
        // The bit is set in the idle state.
        entries.push(((1, 1, String::new()), table.spot.clone()));
    }
    Ok(with_places(when, entries))
}

/// `base`, if the field's base survives a timeout.
fn keeps_base<'a>(field: &TableReader<'a>) -> Result<Option<TableValue<'a>>> {
    let Some(item) = field.optional("base") else { return Ok(None) };
    let keeps = item.choice(&BASES)?;
    Ok(keeps.then_some(item))
}

fn bit_key(key: &str) -> Option<BitKey> {
    BIT_KEYS.into_iter().find(|(name, _)| *name == key).map(|(_, key)| key)
}

/// Whether a field has one bit: `bits = 3`, `bits = "3..3"`, or a coil, which has no type. Does not check `bits`,
/// which is read later.
fn has_one_bit(field: &TableReader<'_>) -> bool {
    let Some(item) = field.optional("bits") else { return field.optional("type").is_none() };
    match item.as_string() {
        None => true,
        Some(range) => range.split_once("..").is_some_and(|(first, last)| first.trim() == last.trim()),
    }
}

fn read_command((key, key_spot, item): (&str, Spot, TableValue<'_>)) -> Result<FileCommand> {
    let Some((first, last)) = read_range(key) else {
        return Err(item.at(key_spot).error(format!(
            "{key:?} is not an integer; the keys of commands are values of the field, such as 1, or ranges of them, \
             such as \"1..100\""
        )));
    };
    Ok(((first, last, read_text(&item)?), item.spot))
}

/// Reads a value such as `1`, or a range such as `1..100`; `None` if it is neither.
pub(super) fn read_range(key: &str) -> Option<(i64, i64)> {
    match key.split_once("..") {
        Some((first, last)) => read_value(first).zip(read_value(last)),
        None => read_value(key).map(|value| (value, value)),
    }
}

fn read_value(text: &str) -> Option<i64> {
    match text.strip_prefix("0x") {
        Some(hex) => i64::from_str_radix(hex, 16),
        None => text.parse(),
    }
    .ok()
}

fn read_text(item: &TableValue<'_>) -> Result<String> {
    match item.string()? {
        "" => Err(item.error("the command is empty")),
        text => match misspelled(text) {
            Some(meant) => Err(item.error(meant)),
            None => Ok(text.to_owned()),
        },
    }
}

/// Corrects commands written in the syntax of other programs.
fn misspelled(text: &str) -> Option<String> {
    let text = text.trim();
    if let Some((word @ ("run" | "speed"), argument)) = text.split_once([' ', '\t', '=', ':'])
        && !argument.contains('(')
    {
        return Some(format!("{text:?} is no command; write \"{word}({})\"", argument.trim()));
    }
    let argument = text.strip_prefix("run")?.trim_start().strip_prefix('(')?;
    let name = argument.split([',', ')']).next()?.trim();
    let bare = name.strip_prefix('\'')?.strip_suffix('\'')?;
    Some(format!("the controller would take the quotes for a part of the name; write {bare} without them"))
}

#[cfg(test)]
mod tests {
    use super::super::document::SourceTree;
    use super::*;

    /// The entries, when they act, or the message, of a field with these keys.
    type Entries = Vec<(i64, i64, String)>;

    fn field(text: &str) -> std::result::Result<(Entries, CommandWhen), String> {
        let document = SourceTree::parse("field.toml", text, &[]).unwrap();
        let field = TableReader::root(&document, &crate::keys::field::INPUT).unwrap();
        let commands = field.optional("commands").unwrap();
        let read = read(&field, &commands).map_err(|error| error.to_string())?;
        Ok((read.0.entries, read.0.when))
    }

    #[test]
    fn ranges_and_idle_values_are_read() {
        let text = "commands = { 1 = 'stop', '-5..0x10' = 'speed({value})' }\nidle = 255\nbase = 'keep'";
        let entries =
            [(1, 1, "stop".into()), (-5, 16, "speed({value})".into()), (255, 255, String::new())].to_vec();
        assert_eq!(field(text), Ok((entries, CommandWhen::Kept)));
        assert_eq!(field("commands = { 1 = 'stop' }\nbase = 'reset'").unwrap().1, CommandWhen::Change);
        // These are spelled as a controller reads them.
        for text in ["run (pick.jspf)", "run(\"pick it.jspf\" , 50)", "run(it's.jspf)"] {
            let entries = field(&format!("commands = {{ 1 = \"\"\"{text}\"\"\" }}")).unwrap().0;
            assert_eq!(entries, [(1, 1, text.to_owned())]);
        }
    }

    #[test]
    fn edges_and_levels_of_a_bit_are_values_of_it() {
        let stop = |value: i64| (value, value, "stop".to_owned());
        let run = (1, 1, "run(a)".to_owned());
        for (text, entries, when) in [
            ("{ rising = 'stop' }\nbits = 3", vec![stop(1)], CommandWhen::Change),
            ("{ rising = 'stop' }\nbits = '3..3'\nbase = 'keep'", vec![stop(1)], CommandWhen::Kept),
            ("{ rising = 'run(a)', falling = 'stop' }\nbits = 0", vec![run, stop(0)], CommandWhen::Change),
            ("{ falling = 'stop' }\nbits = 3", vec![stop(0), (1, 1, String::new())], CommandWhen::Change),
            ("{ level = 'stop' }\nbits = 3", vec![stop(1)], CommandWhen::Frame),
        ] {
            assert_eq!(field(&format!("commands = {text}")), Ok((entries, when)), "{text}");
        }
    }

    #[test]
    fn what_does_not_go_together_is_said() {
        for (text, said) in [
            ("{ rising = 'stop' }\nbits = '3..4'", "allowed only for a field with one bit"),
            ("{ rising = 'stop', 2 = 'resume' }\nbits = 3", "a value, beside the edges of a bit"),
            ("{ rising = 'resume', level = 'stop' }\nbits = 3", "allowed: level alone"),
            ("{ level = 'stop' }\nbits = 3\nwhen = 'frame'", "which say it"),
            ("{ falling = 'stop' }\nbits = 3\nidle = 1", "which say it"),
            ("{ level = 'stop' }\nbits = 3\nbase = 'keep'", "not allowed together with level"),
            ("{ rising = '' }\nbits = 3", "the command is empty"),
            ("{ 1 = 'run pick.jspf' }", "\"run pick.jspf\" is no command; write \"run(pick.jspf)\""),
            ("{ 1 = 'speed 50' }", "write \"speed(50)\""),
            ("{ 1 = \"run('pick.jspf',50)\" }", "a part of the name; write pick.jspf without them"),
        ] {
            let message = field(&format!("commands = {text}")).unwrap_err();
            assert!(message.contains(said), "{text}: {message}");
        }
    }
}
