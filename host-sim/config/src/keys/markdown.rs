//! The keys as tables of docs/configuration.md.
//!
//! In: keys. Out: lines of Markdown, which a test compares with the page.

use super::{Key, Limits, Need, Shape, controller, device, exchange, field, frame, gateway, recipe};

/// The tables of the page, by the name that stands before them there.
pub const DOCUMENTED: &[(&str, &[&[Key]])] = &[
    (
        "recipe",
        &[
            &[gateway::NAME, recipe::KIND, recipe::MODE],
            recipe::PARTS,
            &[recipe::ON_STALE_OF_RECIPE, recipe::ADDRESS, recipe::BLOCK],
        ],
    ),
    ("stream part", &[recipe::REALTIME.common]),
    ("CAN frame", &[recipe::CAN_PART.common, recipe::CAN_REALTIME.common]),
    ("controller", &[gateway::CONTROLLER.common]),
    ("ports", &[gateway::PORTS.common]),
    ("recipe link", &[gateway::RECIPE_LINK.common]),
    ("network", &[gateway::NETWORK.common]),
    (
        "port",
        &[
            gateway::PORT.common,
            gateway::FIELD,
            gateway::LINE,
            &[gateway::ECHO, gateway::BITRATE, gateway::TO, gateway::LISTEN],
        ],
    ),
    ("health", &[gateway::HEALTH_TABLE.common]),
    (
        "binding",
        &[&[field::TO, field::COMMANDS, field::FROM, field::VALUE, field::SCALE_IN, field::OFFSET_IN]],
    ),
    ("limits and maps", &[&[field::MIN, field::MAX, field::OUTSIDE, field::MAP]]),
    ("received values", &[field::RULES_IN]),
    ("commands", &[&[field::WHEN, field::BASE, field::IDLE]]),
    ("output", &[&[recipe::SEND, recipe::ON_STALE]]),
    ("order of frames", &[&[frame::FRAME_NAME, frame::AFTER]]),
    ("device frame", &[frame::OF_FRAME]),
    (
        "device field",
        &[
            &[field::NAME, field::TYPE],
            field::WRITTEN,
            &[field::OVERFLOW, field::EQUALS, field::COUNTER, field::RESTARTED],
            field::PADDING,
            field::CONSTANT_TEXT,
        ],
    ),
    ("counter", &[field::COUNTER_TABLE.common]),
    (
        "checksum",
        &[
            device::CHECKSUM_TABLE.common,
            &[device::WIDTH, device::POLY, device::INIT, device::XOROUT, device::REFIN, device::REFOUT],
        ],
    ),
    ("framing", &[&[device::FRAMING, device::ESCAPE]]),
    (
        "text",
        &[&[
            field::TEXT_WIDTH,
            field::TEXT_UNTIL,
            field::TEXT_FILL,
            field::TEXT_TO,
            field::TEXT_ORDER,
            field::LENGTH_TO,
            field::COUNT_TO,
            field::IGNORE,
            field::TEXT_FROM,
            field::LENGTH_FROM,
        ]],
    ),
    ("length", &[&[field::LENGTH, field::COUNTS, field::PLUS]]),
    ("exchange", &[&[exchange::PEER], exchange::TIMING, exchange::FRAMES, &[exchange::REMOTE]]),
    ("reply", &[exchange::OF_REPLY_FRAME]),
    ("outcome", &[exchange::OUTCOME_TABLE.common]),
    (
        "Modbus exchange",
        &[
            exchange::OF_MODBUS.common,
            &[exchange::WRITE_ADDRESS, exchange::READ, exchange::WRITE, device::WORD_ORDER_OF_REGISTERS],
            exchange::OF_REPLY,
        ],
    ),
    ("block", &[exchange::BLOCK.common, &[exchange::BLOCK_FIELDS]]),
    ("listen", &[controller::LISTEN.common]),
    ("robot", &[controller::ROBOT.common]),
    ("functions", &[controller::FUNCTIONS.common]),
    ("controller port", &[controller::PORT.common, &[controller::TO]]),
    ("program", &[controller::PROGRAM.common]),
];

/// The lines of a table of these keys.
pub fn rows(keys: &[&[Key]]) -> String {
    let mut lines = String::from("| key | type | default | allowed |\n|---|---|---|---|\n");
    for key in keys.iter().copied().flatten() {
        let default = match key.need {
            Need::Required => "required".to_owned(),
            Need::Integer(value) => value.to_string(),
            Need::Word(word) => format!("`{word:?}`"),
            Need::Bool(value) => format!("`{value}`"),
            Need::Absent(text) => text.to_owned(),
        };
        let allowed = if key.lists_allowed { String::new() } else { allowed(&key.shape) };
        let unit =
            if key.unit.is_empty() || allowed.is_empty() { String::new() } else { format!(" {}", key.unit) };
        let between = match (allowed.is_empty(), key.text.is_empty() || key.text.starts_with('(')) {
            (true, _) => "",
            (false, true) => " ",
            (false, false) => "; ",
        };
        let cell = format!("{allowed}{unit}{between}{}", key.text);
        lines += &format!("| `{}` | {} | {default} | {} |\n", key.name, kind(&key.shape), cell.trim());
    }
    lines
}

fn kind(shape: &Shape) -> String {
    match shape {
        Shape::Text(_) | Shape::Words(_) => "string".into(),
        Shape::Integer(..) | Shape::Codes(_) => "integer".into(),
        Shape::Number(_) => "number".into(),
        Shape::Bool => "boolean".into(),
        Shape::Bytes(..) => "list of bytes".into(),
        Shape::List(..) => "list".into(),
        Shape::Table(_) | Shape::Map(..) => "table".into(),
        Shape::Either(shapes) => shapes.iter().map(kind).collect::<Vec<_>>().join(" or "),
    }
}

/// What a shape allows, as far as its type does not say it.
fn allowed(shape: &Shape) -> String {
    match shape {
        Shape::Words(words) => {
            words().iter().map(|word| format!("`{word:?}`")).collect::<Vec<_>>().join(", ")
        }
        Shape::Integer(low, high) => format!("{low}..={high}"),
        Shape::Number(Limits::Any) => String::new(),
        Shape::Number(limits) => limits.to_string(),
        Shape::Either(shapes) => shapes.iter().map(allowed).find(|text| !text.is_empty()).unwrap_or_default(),
        _ => String::new(),
    }
}

/// The text of a key without Markdown.
pub fn plain(text: &str) -> String {
    let mut plain = String::new();
    let mut rest = text;
    while let Some((before, behind)) = rest.split_once('[') {
        plain += before;
        match behind.split_once("](").and_then(|(shown, link)| Some((shown, link.split_once(')')?.1))) {
            Some((shown, behind)) if !shown.contains(']') => {
                plain += shown;
                rest = behind;
            }
            _ => {
                plain.push('[');
                rest = behind;
            }
        }
    }
    (plain + rest).replace('`', "")
}
