//! The client's requests (docs/wire/command.md section 2).
//!
//! In: the text of one command, from [`CommandServer`](super::CommandServer) or a command table. Out: a [`Request`].
//! And back, in a [`Dialect`]'s form.

use core::fmt;

use super::MAX_COMMAND;
use super::percent::Percent;
use super::text::{CountingWriter, NoTextSpace, trim, trim_start, trim_str};
use crate::wire::ascii::split_once;
use crate::wire::dialect::{Dialect, Parentheses, Quotes};

/// One command.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request<'a> {
    /// `run(NAME)` or `run(NAME,SPEED)`.
    Run {
        /// The program's name as written, without quotes (D3). May be empty if received.
        program: &'a str,
        /// `None` if the speed was absent or invalid: the current speed is used.
        speed: Option<Percent>,
    },
    /// `speed(V)`; `None` if V was not a valid speed, which the controller refuses.
    Speed(Option<Percent>),
    /// A keyword for an action; the reply reports success or failure.
    Do(Action),
    /// `state`
    State,
    /// `isprogfinish`
    IsProgFinish,
    /// `getlasterror`
    GetLastError,
}

/// The actions: keywords whose reply is the keyword with `success` or `fail`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Action {
    /// `stop`
    Stop,
    /// `pause`
    Pause,
    /// `resume`
    Resume,
    /// `poweron`
    PowerOn,
    /// `poweroff`
    PowerOff,
    /// `enable`
    Enable,
    /// `disable`
    Disable,
    /// `shutdown`
    Shutdown,
}

impl Action {
    /// All actions.
    pub const ALL: [Self; 8] = [
        Self::Stop,
        Self::Pause,
        Self::Resume,
        Self::PowerOn,
        Self::PowerOff,
        Self::Enable,
        Self::Disable,
        Self::Shutdown,
    ];

    /// The word on the wire.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Stop => "stop",
            Self::Pause => "pause",
            Self::Resume => "resume",
            Self::PowerOn => "poweron",
            Self::PowerOff => "poweroff",
            Self::Enable => "enable",
            Self::Disable => "disable",
            Self::Shutdown => "shutdown",
        }
    }
}

/// The first word of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Keyword {
    /// `run`
    Run,
    /// `speed`
    Speed,
    /// One of the actions.
    Do(Action),
    /// `state`
    State,
    /// `isprogfinish`
    IsProgFinish,
    /// `getlasterror`
    GetLastError,
}

impl Keyword {
    /// All keywords. None is a prefix of another, so a complete one is never ambiguous.
    pub const ALL: [Self; 13] = [
        Self::Run,
        Self::Speed,
        Self::Do(Action::Stop),
        Self::Do(Action::Pause),
        Self::Do(Action::Resume),
        Self::Do(Action::PowerOn),
        Self::Do(Action::PowerOff),
        Self::Do(Action::Enable),
        Self::Do(Action::Disable),
        Self::Do(Action::Shutdown),
        Self::State,
        Self::IsProgFinish,
        Self::GetLastError,
    ];

    /// The word on the wire.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Run => "run",
            Self::Speed => "speed",
            Self::Do(action) => action.word(),
            Self::State => "state",
            Self::IsProgFinish => "isprogfinish",
            Self::GetLastError => "getlasterror",
        }
    }

    /// Whether the command is urgent: it stops or switches off, and precedes all others (D26).
    pub const fn is_urgent(self) -> bool {
        matches!(self, Self::Do(Action::Stop | Action::Pause | Action::Disable | Action::PowerOff))
    }

    /// Whether the command has no arguments.
    pub(crate) const fn is_bare(self) -> bool {
        !matches!(self, Self::Run | Self::Speed)
    }

    /// The keyword with exactly this spelling; case matters (D2).
    pub fn from_word(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|keyword| keyword.word() == word)
    }
}

/// Why a text is not a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ParseError {
    /// Nothing but blanks.
    Empty,
    /// Longer than [`MAX_COMMAND`].
    TooLong {
        /// Its length in bytes.
        len: usize,
    },
    /// Not UTF-8.
    NotText {
        /// Offset of the first byte that is not UTF-8.
        at: usize,
    },
    /// The first word is not a keyword.
    UnknownWord,
    /// The parentheses are not closed at the end, or opened twice.
    Parentheses,
    /// `run` or `speed` without an argument.
    MissingArgument {
        /// The keyword.
        keyword: Keyword,
    },
    /// An argument after a keyword that takes none.
    UnexpectedArgument {
        /// The keyword.
        keyword: Keyword,
    },
    /// A speed that is not a number in (0, 100]; only from [`Request::parse_strict`].
    InvalidSpeed,
    /// A program without a name; only from [`Request::parse_strict`].
    NoProgram,
}

impl fmt::Display for ParseError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Empty => f.write_str("the command is empty"),
            Self::TooLong { len } => write!(f, "the command has {len} bytes; at most {MAX_COMMAND}"),
            Self::NotText { at } => write!(f, "the command is not UTF-8 from byte {at} on"),
            Self::UnknownWord => {
                f.write_str("unknown command; the commands are")?;
                for (nth, keyword) in Keyword::ALL.iter().enumerate() {
                    write!(f, "{} {}", if nth == 0 { "" } else { "," }, keyword.word())?;
                }
                Ok(())
            }
            Self::Parentheses => f.write_str("the command's parentheses do not match"),
            Self::MissingArgument { keyword } => {
                write!(f, "{} needs an argument, as in {0}(...)", keyword.word())
            }
            Self::UnexpectedArgument { keyword } => write!(f, "{} takes no argument", keyword.word()),
            Self::InvalidSpeed => f.write_str("the speed is not a number above 0 and at most 100"),
            Self::NoProgram => f.write_str("run needs the name of a program"),
        }
    }
}

impl core::error::Error for ParseError {}

/// Why a [`Request`] cannot be encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum EncodeError {
    /// The buffer is too small.
    NoSpace(NoTextSpace),
    /// The command would be longer than [`MAX_COMMAND`].
    TooLong {
        /// Its length in bytes.
        len: usize,
    },
    /// The program's name is empty, or begins or ends with a blank.
    ProgramName,
    /// The program's name contains a byte that ends the name or the command.
    ProgramByte {
        /// The first such byte.
        byte: u8,
    },
    /// `speed` without a valid speed.
    NoSpeed,
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NoSpace(error) => error.fmt(f),
            Self::TooLong { len } => write!(f, "the command has {len} bytes; at most {MAX_COMMAND}"),
            Self::ProgramName => {
                f.write_str("a program's name cannot be empty, or begin or end with a space")
            }
            Self::ProgramByte { byte } => write!(f, "a program's name cannot contain byte {byte:#04x}"),
            Self::NoSpeed => f.write_str("speed needs a number above 0 and at most 100"),
        }
    }
}

impl core::error::Error for EncodeError {}

impl From<NoTextSpace> for EncodeError {
    fn from(error: NoTextSpace) -> Self {
        Self::NoSpace(error)
    }
}

impl<'a> Request<'a> {
    /// Parses a command as a controller does: an invalid speed counts as absent.
    ///
    /// # Errors
    /// [`ParseError`] for all texts that are answered with `unknown command`.
    pub fn parse(text: &'a [u8]) -> Result<Self, ParseError> {
        let (keyword, argument) = split(text)?;
        match keyword {
            Keyword::Run => {
                let argument = argument.ok_or(ParseError::MissingArgument { keyword })?;
                let (name, speed) = match split_once(argument, b',') {
                    Some((name, speed)) => (name, Percent::parse(speed)),
                    None => (argument, None),
                };
                Ok(Self::Run { program: unquoted(trim_str(name)), speed })
            }
            Keyword::Speed => {
                let argument = argument.ok_or(ParseError::MissingArgument { keyword })?;
                Ok(Self::Speed(Percent::parse(argument)))
            }
            _ if argument.is_some_and(|argument| !trim_str(argument).is_empty()) => {
                Err(ParseError::UnexpectedArgument { keyword })
            }
            Keyword::Do(action) => Ok(Self::Do(action)),
            Keyword::State => Ok(Self::State),
            Keyword::IsProgFinish => Ok(Self::IsProgFinish),
            Keyword::GetLastError => Ok(Self::GetLastError),
        }
    }

    /// Parses a command to be sent: like [`Request::parse`], but refuses an invalid speed or a missing program name
    /// instead of leaving this to the controller.
    ///
    /// # Errors
    /// [`ParseError`].
    pub fn parse_strict(text: &'a [u8]) -> Result<Self, ParseError> {
        let request = Self::parse(text)?;
        match request {
            Self::Run { program: "", .. } => Err(ParseError::NoProgram),
            Self::Run { speed: None, .. } if text.contains(&b',') => Err(ParseError::InvalidSpeed),
            Self::Speed(None) => Err(ParseError::InvalidSpeed),
            _ => Ok(request),
        }
    }

    /// The keyword of the command.
    pub const fn keyword(&self) -> Keyword {
        match self {
            Self::Run { .. } => Keyword::Run,
            Self::Speed(_) => Keyword::Speed,
            Self::Do(action) => Keyword::Do(*action),
            Self::State => Keyword::State,
            Self::IsProgFinish => Keyword::IsProgFinish,
            Self::GetLastError => Keyword::GetLastError,
        }
    }

    /// Writes the command, with the dialect's terminator, to the front of `out` and returns its length.
    ///
    /// # Errors
    /// [`EncodeError`] if the request cannot be encoded, or `out` is too short.
    pub fn encode(&self, dialect: &Dialect, out: &mut [u8]) -> Result<usize, EncodeError> {
        let terminator = dialect.terminator.text();
        let mut writer = CountingWriter::new(out);
        writer.push_str(self.keyword().word());
        match *self {
            Self::Run { program, speed } => {
                check_program(program)?;
                let quote = match dialect.quotes {
                    Quotes::None => "",
                    Quotes::Double => "\"",
                };
                for part in ["(", quote, program, quote] {
                    writer.push_str(part);
                }
                if let Some(speed) = speed {
                    writer.push_str(",");
                    speed.write(&mut writer);
                }
                writer.push_str(")");
            }
            Self::Speed(speed) => {
                writer.push_str("(");
                speed.ok_or(EncodeError::NoSpeed)?.write(&mut writer);
                writer.push_str(")");
            }
            Self::Do(_) | Self::State | Self::IsProgFinish | Self::GetLastError => {
                if dialect.parentheses == Parentheses::Empty {
                    writer.push_str("()");
                }
            }
        }
        if writer.len() > MAX_COMMAND {
            return Err(EncodeError::TooLong { len: writer.len() });
        }
        writer.push_str(terminator);
        Ok(writer.finish()?)
    }
}

/// Whether more bytes can make `text` (without leading blanks) a command.
pub(super) fn may_become_command(text: &[u8]) -> bool {
    let room = MAX_COMMAND.saturating_sub(text.len());
    Keyword::ALL.into_iter().any(|keyword| {
        let word = keyword.word().as_bytes();
        match text.strip_prefix(word) {
            Some(rest) => match trim_start(rest).split_first() {
                None => room >= 2,
                // A keyword without arguments, followed by an argument, is not a command.
                Some((b'(', argument)) if keyword.is_bare() => room >= 1 && trim(argument).is_empty(),
                Some((b'(', argument)) => room >= 1 && may_become_argument(argument),
                Some(_) => false,
            },
            None => word.starts_with(text),
        }
    })
}

/// Whether there is no second parenthesis, and valid UTF-8 except for an incomplete last character.
fn may_become_argument(argument: &[u8]) -> bool {
    let readable = core::str::from_utf8(argument).map_or_else(|error| error.error_len().is_none(), |_| true);
    readable && !argument.contains(&b'(')
}

fn split(text: &[u8]) -> Result<(Keyword, Option<&str>), ParseError> {
    let text = trim(text);
    if text.len() > MAX_COMMAND {
        return Err(ParseError::TooLong { len: text.len() });
    }
    let text = core::str::from_utf8(text).map_err(|error| ParseError::NotText { at: error.valid_up_to() })?;
    if text.is_empty() {
        return Err(ParseError::Empty);
    }
    let (word, argument) = match split_once(text, b'(') {
        Some((word, rest)) => (trim_str(word), Some(rest)),
        None => (text, None),
    };
    let keyword = Keyword::from_word(word).ok_or(ParseError::UnknownWord)?;
    let argument = match argument {
        None => None,
        Some(rest) => match rest.strip_suffix(')') {
            Some(inner) if !inner.contains([')', '(']) => Some(inner),
            _ => return Err(ParseError::Parentheses),
        },
    };
    Ok((keyword, argument))
}

/// `name` without double quotes around it (D3).
fn unquoted(name: &str) -> &str {
    name.strip_prefix('"').and_then(|name| name.strip_suffix('"')).unwrap_or(name)
}

fn check_program(program: &str) -> Result<(), EncodeError> {
    if program.is_empty() || trim_str(program).len() != program.len() {
        return Err(EncodeError::ProgramName);
    }
    let bad = |byte: &u8| matches!(byte, b'(' | b')' | b',' | b'"') || byte.is_ascii_control();
    match program.bytes().find(bad) {
        Some(byte) => Err(EncodeError::ProgramByte { byte }),
        None => Ok(()),
    }
}
