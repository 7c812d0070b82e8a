//! Shortens texts of scripts to one line for a log or a reply.

use rhai::{EvalAltResult, Position};

use super::script::CALL_PROGRAM;

/// The text on one line, cut to the length of a log line.
pub(super) fn one_line(text: &str) -> String {
    let mut line: String =
        text.chars().map(|c| if c.is_control() { ' ' } else { c }).take(MAX_LINE).collect();
    line.truncate(line.trim_end().len());
    line
}

/// The error and its place on one line. A long text is cut in the middle; the place in the script and the places of the
/// calls are always complete.
pub(super) fn described(error: EvalAltResult) -> String {
    let mut callers = Vec::new();
    let mut error = error;
    while let EvalAltResult::ErrorInFunctionCall(name, _, inner, place) = error {
        let what = if name.starts_with(CLOSURE) {
            "in a closure".to_owned()
        } else {
            format!("in function {}", shortened(&name, MAX_NAME))
        };
        callers.push(format!(", {what} called at {}", shown(place)));
        error = *inner;
    }
    // The innermost calls are nearest to the error.
    let hidden = callers.len().saturating_sub(MAX_CALLERS);
    let mut places = callers.split_off(hidden);
    places.reverse();
    let more = if hidden > 0 { ", ..." } else { "" };
    let place = error.take_position();
    let text = match &error {
        EvalAltResult::ErrorTerminated(token, _) => token.to_string(),
        other => other.to_string().replace(CALL_PROGRAM, "call"),
    };
    let place = format!(" ({}{}{more})", shown(place), places.concat());
    format!("{}{place}", shortened(&text, MAX_ERROR.saturating_sub(place.len())))
}

fn shown(place: Position) -> String {
    if place.is_none() { "place unknown".to_owned() } else { place.to_string() }
}

/// At most `max` bytes on one line, with the middle omitted.
pub(crate) fn shortened(text: &str, max: usize) -> String {
    let line: String = text.trim_end().chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if line.len() <= max {
        return line;
    }
    let half = max.saturating_sub(GAP.len()) / 2;
    let head = line.floor_char_boundary(half);
    let tail = line.ceil_char_boundary(line.len() - half);
    format!("{}{GAP}{}", &line[..head], &line[tail..])
}

/// Maximum length of a log line, in characters.
const MAX_LINE: usize = 200;
/// Maximum length of an error with its places, in bytes. Together with a program's name, it fits into the reply to
/// `getlasterror` that clients accept (proto-core/docs/wire/command.md section 6).
const MAX_ERROR: usize = 240;
/// Maximum length of a function's name in an error.
const MAX_NAME: usize = 24;
/// Maximum number of calls in an error.
const MAX_CALLERS: usize = 2;
/// Replaces omitted text.
const GAP: &str = " ... ";
/// The prefix of closures' names.
const CLOSURE: &str = "anon$";
