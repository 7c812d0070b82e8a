//! The controller's replies (docs/wire/command.md sections 3 and 4).
//!
//! In: a [`Reply`] to format as a [`Dialect`] requires, or the text of one to parse.
//! [`CommandClient`](super::CommandClient) finds the end of a reply.

use core::fmt;

use super::percent::Percent;
use super::request::{Action, Keyword};
use super::text::{CountingWriter, NoTextSpace, is_terminator, trim};
use crate::wire::dialect::{Dialect, RunReply, SpeedReply, Terminator};
use crate::wire::state::{OperationMode, ProgramState, RobotState, SafetyState};

/// The result of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ActionOutcome {
    /// Executed, or started.
    Success,
    /// Refused.
    Fail,
}

impl ActionOutcome {
    /// The word on the wire.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Success => "success",
            Self::Fail => "fail",
        }
    }
}

/// One reply, or the one unsolicited text.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Reply<'a> {
    /// To `run`: `run start`, `run success` or `run fail`.
    Run(ActionOutcome),
    /// To an executed `speed`: `set success`, or `set speed 50%`. `None` if parsed from `set success`, which has no
    /// value; it is then written as `set success` in every dialect.
    SpeedSet(Option<Percent>),
    /// To a refused `speed`: `set fail`.
    SpeedRefused,
    /// To an action.
    Did {
        /// The action.
        action: Action,
        /// The result.
        outcome: ActionOutcome,
    },
    /// To an action whose state is already reached, such as `already poweron`. As good as success.
    Already(Action),
    /// To `state`.
    State(StateCodes),
    /// To `isprogfinish`: whether the program has finished.
    ProgramFinished(bool),
    /// To `getlasterror`.
    LastError {
        /// The error's number, hexadecimal on the wire.
        id: u32,
        /// Its text; not always UTF-8.
        message: &'a [u8],
    },
    /// To anything that is not a command (D5).
    UnknownCommand,
    /// A program that was started from port 2000 has ended.
    ScriptFinish,
}

/// The codes of the four state machines, as `state` reports them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StateCodes {
    /// Robot state; see [`Dialect::robot_state`].
    pub robot: u8,
    /// Program state.
    pub program: u8,
    /// Safety state; see [`Dialect::safety_state`].
    pub safety: u8,
    /// Operation mode.
    pub mode: u8,
}

impl StateCodes {
    /// The codes of these states in `dialect`.
    pub fn new(
        dialect: &Dialect,
        robot: RobotState,
        program: ProgramState,
        safety: SafetyState,
        mode: OperationMode,
    ) -> Self {
        Self {
            robot: dialect.robot_code(robot),
            program: program.code(),
            safety: dialect.safety_code(safety),
            mode: mode.code(),
        }
    }
}

impl fmt::Display for StateCodes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}:{}:{}", self.robot, self.program, self.safety, self.mode)
    }
}

/// The kind of a reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReplyKind {
    /// The command was executed.
    Success,
    /// The command was refused.
    Fail,
    /// A query was answered.
    Value,
    /// The controller does not know the command.
    UnknownCommand,
}

impl<'a> Reply<'a> {
    /// The kind of the reply; [`ReplyKind::Value`] for the unsolicited text.
    pub const fn kind(&self) -> ReplyKind {
        match self {
            Self::Run(ActionOutcome::Success)
            | Self::SpeedSet(_)
            | Self::Did { outcome: ActionOutcome::Success, .. }
            | Self::Already(_) => ReplyKind::Success,
            Self::Run(ActionOutcome::Fail)
            | Self::SpeedRefused
            | Self::Did { outcome: ActionOutcome::Fail, .. } => ReplyKind::Fail,
            Self::UnknownCommand => ReplyKind::UnknownCommand,
            Self::State(_) | Self::ProgramFinished(_) | Self::LastError { .. } | Self::ScriptFinish => {
                ReplyKind::Value
            }
        }
    }

    /// Writes the reply, with the dialect's terminator, to the front of `out` and returns its length. Control
    /// characters in an error's message become blanks.
    ///
    /// # Errors
    /// [`NoTextSpace`] if `out` is too short.
    pub fn encode(&self, dialect: &Dialect, out: &mut [u8]) -> Result<usize, NoTextSpace> {
        let mut writer = CountingWriter::new(out);
        let mut terminator = dialect.reply_terminator;
        match *self {
            Self::Run(ActionOutcome::Success) => writer.push_str(match dialect.run_reply {
                RunReply::Start => RUN_START,
                RunReply::Success => RUN_SUCCESS,
            }),
            Self::Run(ActionOutcome::Fail) => writer.push_str(RUN_FAIL),
            Self::SpeedSet(Some(percent)) if dialect.speed_reply == SpeedReply::Percent => {
                writer.push_str(SET_SPEED);
                percent.write(&mut writer);
                writer.push_str("%");
            }
            Self::SpeedSet(_) => writer.push_str(SET_SUCCESS),
            Self::SpeedRefused => writer.push_str(SET_FAIL),
            Self::Did { action, outcome } => {
                writer.push_str(action.word());
                writer.push_str(" ");
                writer.push_str(outcome.word());
            }
            Self::Already(action) => {
                writer.push_str(ALREADY);
                writer.push_str(action.word());
            }
            Self::State(StateCodes { robot, program, safety, mode }) => {
                writer.push_number::<10>(robot.into());
                for code in [program, safety, mode] {
                    writer.push_str(":");
                    writer.push_number::<10>(code.into());
                }
            }
            Self::ProgramFinished(finished) => writer.push_str(if finished { "1" } else { "0" }),
            Self::LastError { id, message } => {
                writer.push_number::<16>(id);
                writer.push_str(":");
                for &byte in message {
                    writer.push(&[if byte.is_ascii_control() { b' ' } else { byte }]);
                }
                // This reply ends with a terminator in every version (D4).
                if terminator == Terminator::None {
                    terminator = Terminator::Lf;
                }
            }
            Self::UnknownCommand => writer.push_str(UNKNOWN_COMMAND),
            Self::ScriptFinish => writer.push_str(SCRIPT_FINISH),
        }
        writer.push_str(terminator.text());
        writer.finish()
    }

    /// Parses the whole text of a reply to `keyword`, in the form of any dialect, with or without a terminator. A text
    /// that names the command and contains `fail`, `failed` or `error` is a failure, whatever else it says. `None` if
    /// the text is not a reply to `keyword`.
    pub fn parse(keyword: Keyword, text: &'a [u8]) -> Option<Self> {
        let text = trim(text);
        let whole = |found: Match<'a>| match found {
            Match::Complete { len, reply } | Match::Open { len, reply, .. } if len == text.len() => {
                Some(reply)
            }
            _ => None,
        };
        whole(match_value(keyword, text))
            .or_else(|| whole(match_fixed(text)))
            .filter(|reply| reply.answers(keyword) || *reply == Self::ScriptFinish)
            .or_else(|| failure(keyword, text))
    }

    /// Whether this can be a reply to `keyword`.
    pub(super) fn answers(&self, keyword: Keyword) -> bool {
        match *self {
            Self::Run(_) => keyword == Keyword::Run,
            Self::SpeedSet(_) | Self::SpeedRefused => keyword == Keyword::Speed,
            Self::Did { action, .. } | Self::Already(action) => keyword == Keyword::Do(action),
            Self::State(_) => keyword == Keyword::State,
            Self::ProgramFinished(_) => keyword == Keyword::IsProgFinish,
            Self::LastError { .. } => keyword == Keyword::GetLastError,
            Self::UnknownCommand => true,
            Self::ScriptFinish => false,
        }
    }
}

/// The match of received bytes with the known replies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Match<'a> {
    /// The bytes begin with a complete reply of `len` bytes; further bytes cannot change it.
    Complete { len: usize, reply: Reply<'a> },
    /// All `len` bytes are a reply, but further bytes could extend it.
    Open { len: usize, reply: Reply<'a> },
    /// The beginning of a reply.
    Partial,
    /// No reply.
    No,
}

/// Matches replies whose text does not depend on a value; none is a prefix of another.
pub(super) fn match_fixed(bytes: &[u8]) -> Match<'static> {
    let texts = [
        (RUN_START, Reply::Run(ActionOutcome::Success)),
        (RUN_SUCCESS, Reply::Run(ActionOutcome::Success)),
        (RUN_FAIL, Reply::Run(ActionOutcome::Fail)),
        (SCRIPT_ERROR, Reply::Run(ActionOutcome::Fail)),
        (SET_SUCCESS, Reply::SpeedSet(None)),
        (SET_FAIL, Reply::SpeedRefused),
        (UNKNOWN_COMMAND, Reply::UnknownCommand),
        (SCRIPT_FINISH, Reply::ScriptFinish),
    ];
    let mut partial = false;
    for (text, reply) in texts {
        match front(bytes, text) {
            Front::Whole(_) => return Match::Complete { len: text.len(), reply },
            Front::Beginning => partial = true,
            Front::Other => {}
        }
    }
    for action in Action::ALL {
        for outcome in [ActionOutcome::Success, ActionOutcome::Fail] {
            let found = match front(bytes, action.word()) {
                Front::Whole(rest) => match front(rest, " ") {
                    Front::Whole(rest) => front(rest, outcome.word()),
                    other => other,
                },
                other => other,
            };
            match found {
                Front::Whole(rest) => {
                    let len = bytes.len().saturating_sub(rest.len());
                    return Match::Complete { len, reply: Reply::Did { action, outcome } };
                }
                Front::Beginning => partial = true,
                Front::Other => {}
            }
        }
    }
    match front(bytes, ALREADY) {
        Front::Whole(rest) => {
            for action in Action::ALL {
                match front(rest, action.word()) {
                    Front::Whole(rest) => {
                        let len = bytes.len().saturating_sub(rest.len());
                        return Match::Complete { len, reply: Reply::Already(action) };
                    }
                    Front::Beginning => partial = true,
                    Front::Other => {}
                }
            }
        }
        Front::Beginning => partial = true,
        Front::Other => {}
    }
    match front(bytes, SET_SPEED) {
        Front::Whole(rest) => match match_percent(rest) {
            Match::Complete { len, reply } => {
                return Match::Complete { len: len.saturating_add(SET_SPEED.len()), reply };
            }
            Match::Partial => partial = true,
            _ => {}
        },
        Front::Beginning => partial = true,
        Front::Other => {}
    }
    if partial { Match::Partial } else { Match::No }
}

/// Matches replies that are values, if `keyword` requests one.
pub(super) fn match_value(keyword: Keyword, bytes: &[u8]) -> Match<'_> {
    match keyword {
        Keyword::State => match_state(bytes),
        Keyword::IsProgFinish => match bytes {
            [] => Match::Partial,
            // A longer number is no reply.
            [_, b'0'..=b'9' | b':', ..] => Match::No,
            [b'0', ..] => Match::Complete { len: 1, reply: Reply::ProgramFinished(false) },
            [b'1', ..] => Match::Complete { len: 1, reply: Reply::ProgramFinished(true) },
            _ => Match::No,
        },
        Keyword::GetLastError => match_error(bytes),
        Keyword::Run | Keyword::Speed | Keyword::Do(_) => Match::No,
    }
}

fn match_percent(bytes: &[u8]) -> Match<'static> {
    match bytes.iter().position(|byte| !matches!(byte, b'0'..=b'9' | b'.' | b' ')) {
        Some(at) if bytes.get(at) == Some(&b'%') => {
            let percent = bytes.get(..at).and_then(|digits| core::str::from_utf8(digits).ok());
            match percent.and_then(Percent::parse) {
                Some(percent) => {
                    Match::Complete { len: at.saturating_add(1), reply: Reply::SpeedSet(Some(percent)) }
                }
                None => Match::No,
            }
        }
        Some(_) => Match::No,
        None if bytes.len() <= LONGEST_PERCENT => Match::Partial,
        None => Match::No,
    }
}

fn match_state(bytes: &[u8]) -> Match<'static> {
    let mut codes = [0u8; 4];
    let mut rest = bytes;
    let last = codes.len().saturating_sub(1);
    for (nth, code) in codes.iter_mut().enumerate() {
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let Some((number, behind)) = rest.split_at_checked(digits) else { return Match::No };
        let parsed = core::str::from_utf8(number).ok().and_then(|number| number.parse().ok());
        match (parsed, behind.first()) {
            (None, None) if digits == 0 => return Match::Partial,
            (None, _) => return Match::No,
            (Some(number), _) if nth == last => *code = number,
            (Some(_), None) => return Match::Partial,
            (Some(number), Some(b':')) => *code = number,
            (Some(_), Some(_)) => return Match::No,
        }
        rest = if nth == last { behind } else { behind.get(1..).unwrap_or(&[]) };
    }
    let [robot, program, safety, mode] = codes;
    let reply = Reply::State(StateCodes { robot, program, safety, mode });
    let len = bytes.len().saturating_sub(rest.len());
    if rest.is_empty() { Match::Open { len, reply } } else { Match::Complete { len, reply } }
}

fn match_error(bytes: &[u8]) -> Match<'_> {
    let number = bytes.strip_prefix(b"0x").unwrap_or(bytes);
    let digits = number.iter().take_while(|byte| byte.is_ascii_hexdigit()).count();
    let Some((digits, rest)) = number.split_at_checked(digits) else { return Match::No };
    let Some((colon, message)) = rest.split_first() else {
        // `0x` alone is a beginning too.
        return if digits.len() <= 8 { Match::Partial } else { Match::No };
    };
    let id = core::str::from_utf8(digits).ok().and_then(|digits| u32::from_str_radix(digits, 16).ok());
    let (b':', Some(id)) = (*colon, id) else {
        return if bytes == b"0x" { Match::Partial } else { Match::No };
    };
    match message.iter().position(|&byte| is_terminator(byte)) {
        Some(end) => {
            let message = message.get(..end).unwrap_or(&[]);
            let header = bytes.len().saturating_sub(rest.len()).saturating_add(1);
            let reply = Reply::LastError { id, message };
            Match::Complete { len: header.saturating_add(message.len()), reply }
        }
        None => Match::Open { len: bytes.len(), reply: Reply::LastError { id, message } },
    }
}

/// Index of the first word in `text` that names the command.
pub(super) fn named_at(keyword: Keyword, text: &[u8]) -> Option<usize> {
    let is_name = |word: &[u8]| {
        word.eq_ignore_ascii_case(keyword.word().as_bytes())
            || keyword == Keyword::Speed && word.eq_ignore_ascii_case(SET)
    };
    words(text).position(is_name)
}

/// The failure of `keyword` that an unknown text reports; `None` if it reports none. Queries have no failure.
pub(super) fn failure<'a>(keyword: Keyword, text: &[u8]) -> Option<Reply<'a>> {
    let is_failure = |word: &[u8]| FAILURES.iter().any(|failure| word.eq_ignore_ascii_case(failure));
    named_at(keyword, text)?;
    words(text).find(|word| is_failure(word))?;
    match keyword {
        Keyword::Run => Some(Reply::Run(ActionOutcome::Fail)),
        Keyword::Speed => Some(Reply::SpeedRefused),
        Keyword::Do(action) => Some(Reply::Did { action, outcome: ActionOutcome::Fail }),
        Keyword::State | Keyword::IsProgFinish | Keyword::GetLastError => None,
    }
}

fn words(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    text.split(|byte| !byte.is_ascii_alphanumeric())
}

/// How `bytes` match a text.
enum Front<'a> {
    /// They begin with the text; the rest follows.
    Whole(&'a [u8]),
    /// They are a prefix of the text.
    Beginning,
    /// Neither.
    Other,
}

fn front<'a>(bytes: &'a [u8], text: &str) -> Front<'a> {
    let text = text.as_bytes();
    match bytes.strip_prefix(text) {
        Some(rest) => Front::Whole(rest),
        None if text.starts_with(bytes) => Front::Beginning,
        None => Front::Other,
    }
}

const RUN_START: &str = "run start";
const RUN_SUCCESS: &str = "run success";
const RUN_FAIL: &str = "run fail";
const SCRIPT_ERROR: &str = "script error";
const ALREADY: &str = "already ";
const SET_SUCCESS: &str = "set success";
const SET_FAIL: &str = "set fail";
const SET_SPEED: &str = "set speed ";
const UNKNOWN_COMMAND: &str = "unknown command";
pub(super) const SCRIPT_FINISH: &str = "script finish";

/// The name of `speed` in its replies.
const SET: &[u8] = b"set";
/// Words that report a failure.
const FAILURES: [&[u8]; 3] = [b"fail", b"failed", b"error"];

/// Longest number in `set speed V%`.
const LONGEST_PERCENT: usize = 16;
