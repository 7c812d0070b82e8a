//! docs/wire/command.md, read literally: slow, obvious, and written without a look at the code that
//! does it. Times are in microseconds.
#![allow(dead_code, unreachable_pub, reason = "each user takes its own part")]

use std::sync::LazyLock;

const BARE: [&str; 11] = [
    "stop",
    "pause",
    "resume",
    "poweron",
    "poweroff",
    "enable",
    "disable",
    "shutdown",
    "state",
    "isprogfinish",
    "getlasterror",
];
const WITH_ARGUMENT: [&str; 2] = ["run", "speed"];
const LONGEST_COMMAND: usize = 256;
const LONGEST_REPLY: usize = 320;

fn is_end(byte: u8) -> bool {
    [b'\r', b'\n', 0].contains(&byte)
}

fn is_blank(byte: u8) -> bool {
    byte == b' ' || byte == b'\t' || is_end(byte)
}

fn trim(text: &str) -> &str {
    text.trim_matches(|c: char| c.is_ascii() && is_blank(c as u8))
}

fn trim_bytes(text: &[u8]) -> &[u8] {
    let Some(first) = text.iter().position(|&byte| !is_blank(byte)) else { return &[] };
    let last = text.iter().rposition(|&byte| !is_blank(byte)).unwrap();
    &text[first..=last]
}

/// One command: section 2.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    Run { name: String, speed: Option<f32> },
    Speed(Option<f32>),
    Bare(&'static str),
}

impl Command {
    pub fn read(text: &[u8]) -> Option<Self> {
        let text = trim(std::str::from_utf8(text).ok()?);
        if text.len() > LONGEST_COMMAND {
            return None;
        }
        let Some(open) = text.find('(') else {
            return BARE.into_iter().find(|word| *word == text).map(Self::Bare);
        };
        let (word, argument) = (trim(&text[..open]), text[open + 1..].strip_suffix(')')?);
        if argument.contains(['(', ')']) {
            return None;
        }
        let speed = |text: &str| trim(text).parse().ok().filter(|speed| *speed > 0.0 && *speed <= 100.0);
        match word {
            "run" => {
                let name = trim(argument.split(',').next().unwrap());
                let quoted = name.len() >= 2 && name.starts_with('"') && name.ends_with('"');
                let name = if quoted { &name[1..name.len() - 1] } else { name };
                let behind = argument.find(',').map(|comma| &argument[comma + 1..]);
                Some(Self::Run { name: name.to_owned(), speed: behind.and_then(speed) })
            }
            "speed" => Some(Self::Speed(speed(argument))),
            _ if trim(argument).is_empty() => BARE.into_iter().find(|bare| *bare == word).map(Self::Bare),
            _ => None,
        }
    }
}

/// Whether some bytes behind `text`, which has no blanks before it, make it a command.
fn can_become_command(text: &[u8]) -> bool {
    let begins = |word: &str| {
        let Some(behind) = text.strip_prefix(word.as_bytes()) else {
            return word.as_bytes().starts_with(text);
        };
        let blanks = behind.iter().take_while(|&&byte| is_blank(byte)).count();
        let Some((b'(', argument)) = behind[blanks..].split_first() else {
            // `()` has to fit.
            return behind.len() == blanks && text.len() + 2 <= LONGEST_COMMAND;
        };
        let readable = match std::str::from_utf8(argument) {
            Ok(argument) => !argument.contains(['(', ')']),
            // A letter of several bytes may be cut at the end.
            Err(error) => {
                error.error_len().is_none() && !argument.contains(&b'(') && !argument.contains(&b')')
            }
        };
        let taken = WITH_ARGUMENT.contains(&word) || trim_bytes(argument).is_empty();
        readable && taken && text.len() < LONGEST_COMMAND
    };
    BARE.iter().chain(&WITH_ARGUMENT).any(|word| begins(word))
}

/// What a server hears.
#[derive(Debug, Clone, PartialEq)]
pub enum Heard {
    Command(Command),
    Unknown(Vec<u8>),
    TooLong,
}

/// Section 5.
#[derive(Debug, Clone, Default)]
pub struct Server {
    text: Vec<u8>,
    dropping: bool,
    /// Silence ended a keyword, and its parentheses may still come.
    pair_may_come: bool,
    newest: u64,
}

impl Server {
    /// When silence will end something.
    pub fn deadline(&self) -> Option<u64> {
        let text = trim_bytes(&self.text);
        let gap = if self.dropping {
            100_000
        } else if text.is_empty() {
            return None;
        } else if BARE.iter().any(|word| word.as_bytes() == text) {
            20_000
        } else if can_become_command(&self.text) || self.pair_may_come && text == b"(" {
            10_000_000
        } else {
            100_000
        };
        Some(self.newest + gap)
    }

    pub fn receive(&mut self, now: u64, bytes: &[u8]) -> Vec<Heard> {
        let mut heard = Vec::new();
        if self.deadline().is_some_and(|deadline| now >= deadline) {
            if !self.dropping {
                heard.push(self.end());
                self.pair_may_come = matches!(heard[0], Heard::Command(_));
            }
            self.dropping = false;
        }
        for &byte in bytes {
            self.newest = now;
            if self.dropping {
                self.dropping = !is_end(byte);
                continue;
            }
            if self.text.is_empty() && is_blank(byte) {
                continue;
            }
            if is_end(byte) {
                heard.push(self.end());
                continue;
            }
            if self.text.len() == LONGEST_COMMAND {
                self.text.clear();
                (self.dropping, self.pair_may_come) = (true, false);
                heard.push(Heard::TooLong);
                continue;
            }
            self.text.push(byte);
            if byte == b')' && self.text.contains(&b'(') {
                let pair: Vec<u8> = self.text.iter().copied().filter(|&byte| !is_blank(byte)).collect();
                if self.pair_may_come && pair == b"()" {
                    self.text.clear();
                    self.pair_may_come = false;
                } else {
                    heard.push(self.end());
                }
            }
        }
        heard
    }

    fn end(&mut self) -> Heard {
        self.pair_may_come = false;
        let text = std::mem::take(&mut self.text);
        let text = trim_bytes(&text);
        Command::read(text).map_or_else(|| Heard::Unknown(text.to_vec()), Heard::Command)
    }
}

/// An event in the bytes that a client received.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// To the older request, or to the one beside it.
    Reply(Turn, Vec<u8>),
    ScriptFinish,
    /// With the request whose reply it may be.
    Unsolicited(Vec<u8>, Option<Turn>),
    Timeout,
}

/// A request in flight.
#[derive(Debug, Clone)]
pub struct Asked {
    pub word: String,
    since: u64,
    until: u64,
    has_text: bool,
}

impl Asked {
    fn new(word: &str, now: u64) -> Self {
        Self { word: word.to_owned(), since: now, until: now + 10_000_000, has_text: false }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Turn {
    InTurn,
    Beside,
}

/// What stands at the front of received bytes.
enum Front {
    /// Complete with its last byte.
    Complete(usize),
    /// Complete after so much silence.
    Open(u64),
    Beginning,
    Other,
}

/// Section 6.
#[derive(Debug, Clone, Default)]
pub struct Client {
    bytes: Vec<u8>,
    pub waiting: Option<Asked>,
    /// A younger, urgent request that was not kept waiting.
    pub beside: Option<Asked>,
    dropping: bool,
    newest: u64,
    pub dropped: u32,
}

impl Client {
    pub fn start(&mut self, now: u64, word: &str) {
        if !b"script finish".starts_with(&self.bytes) {
            self.bytes.clear();
        }
        self.waiting = Some(Asked::new(word, now));
    }

    pub fn start_beside(&mut self, now: u64, word: &str) {
        if self.waiting.is_none() {
            return self.start(now, word);
        }
        self.beside = Some(Asked::new(word, now));
    }

    /// When the older one is given up.
    fn until(&self) -> Option<u64> {
        [&self.waiting, &self.beside].into_iter().flatten().map(|asked| asked.until).min()
    }

    pub fn abort(&mut self) {
        *self = Self { newest: self.newest, dropped: self.dropped, ..Self::default() };
    }

    pub fn deadline(&self) -> Option<u64> {
        let silence = self.silence().map(|gap| self.newest + gap);
        silence.into_iter().chain(self.until()).min()
    }

    /// How much silence ends what is there.
    fn silence(&self) -> Option<u64> {
        match self.front() {
            _ if self.dropping => Some(100_000),
            _ if self.bytes.is_empty() => None,
            Front::Open(gap) => Some(gap),
            Front::Other => Some(20_000),
            Front::Complete(_) | Front::Beginning => None,
        }
    }

    pub fn receive(&mut self, now: u64, bytes: &[u8]) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(now, &mut events);
        for &byte in bytes {
            self.newest = now;
            if self.dropping {
                self.dropped += 1;
                self.dropping = !is_end(byte);
                continue;
            }
            self.bytes.push(byte);
            self.settle(now, &mut events);
        }
        if self.until().is_some_and(|until| now >= until) {
            (self.waiting, self.beside) = (None, None);
            events.push(Event::Timeout);
            // What was the beginning of a reply is now a text that nobody asked for.
            self.settle(now, &mut events);
        }
        events
    }

    /// Hands out what is complete at the front, as often as something is.
    fn settle(&mut self, now: u64, events: &mut Vec<Event>) {
        loop {
            let blanks = self.bytes.iter().take_while(|&&byte| is_blank(byte)).count();
            self.bytes.drain(..blanks);
            let silent = self.silence().is_some_and(|gap| now >= self.newest + gap);
            if self.dropping && silent {
                self.dropping = false;
                continue;
            }
            let (len, full) = (self.bytes.len(), self.bytes.len() == LONGEST_REPLY);
            match (self.front(), self.bytes.iter().position(|&byte| is_end(byte))) {
                _ if self.bytes.is_empty() => return,
                (Front::Complete(len), _) => self.hand_out(len, events),
                (Front::Other, Some(end)) => self.hand_out(end, events),
                (Front::Open(_) | Front::Other, _) if full || silent => {
                    // The rest of a message goes nowhere; a text that we do not know comes in pieces.
                    self.dropping = full && matches!(self.front(), Front::Open(_));
                    self.hand_out(len, events);
                }
                _ => return,
            }
        }
    }

    fn hand_out(&mut self, len: usize, events: &mut Vec<Event>) {
        let front = self.front();
        let mut len = len;
        if let Front::Other = front {
            // A text reply may be glued to its end.
            let glued = (1..len).find(|&at| text_reply(&self.bytes[at..]).is_some());
            len = glued.unwrap_or(len);
        }
        let text: Vec<u8> = self.bytes.drain(..len).collect();
        // What answers both is the answer to the one in turn.
        if matches!(front, Front::Other) {
            return self.hear_words(text, events);
        }
        let answers =
            |request: &Option<Asked>| request.as_ref().is_some_and(|asked| answers(&asked.word, &text));
        events.push(if text == b"script finish" {
            Event::ScriptFinish
        } else if answers(&self.waiting) {
            self.waiting = self.beside.take();
            Event::Reply(Turn::InTurn, text)
        } else if answers(&self.beside) {
            self.beside = None;
            Event::Reply(Turn::Beside, text)
        } else {
            Event::Unsolicited(text, None)
        });
    }

    /// Words that are no reply, unless they name a request and say that it failed.
    fn hear_words(&mut self, text: Vec<u8>, events: &mut Vec<Event>) {
        let words = words(&text);
        let newest = self.newest;
        let place_of_name = |asked: &Option<Asked>| {
            let asked = asked.as_ref().filter(|asked| asked.since <= newest)?;
            words.iter().position(|word| *word == asked.word || asked.word == "speed" && word == "set")
        };
        let named = match (place_of_name(&self.waiting), place_of_name(&self.beside)) {
            (Some(older), Some(beside)) if beside < older => Some(Turn::Beside),
            (Some(_), _) => Some(Turn::InTurn),
            (None, Some(_)) => Some(Turn::Beside),
            (None, None) => None,
        };
        let can_fail = |asked: &Option<Asked>| {
            let is_question = |asked: &Asked| BARE[8..].contains(&asked.word.as_str());
            asked.as_ref().is_some_and(|asked| !is_question(asked))
        };
        let fails = words.iter().any(|word| ["fail", "failed", "error"].contains(&word.as_str()));
        match named {
            Some(Turn::InTurn) if fails && can_fail(&self.waiting) => {
                self.waiting = self.beside.take();
                return events.push(Event::Reply(Turn::InTurn, text));
            }
            Some(Turn::Beside) if fails && can_fail(&self.beside) => {
                self.beside = None;
                return events.push(Event::Reply(Turn::Beside, text));
            }
            _ => {}
        }
        let has_none = |asked: &Option<Asked>| {
            asked.as_ref().is_some_and(|asked| asked.since <= newest && !asked.has_text)
        };
        let to = named
            .or_else(|| has_none(&self.waiting).then_some(Turn::InTurn))
            .or_else(|| has_none(&self.beside).then_some(Turn::Beside));
        match to {
            Some(Turn::InTurn) => self.waiting.iter_mut().for_each(|asked| asked.has_text = true),
            Some(Turn::Beside) => self.beside.iter_mut().for_each(|asked| asked.has_text = true),
            None => {}
        }
        events.push(Event::Unsolicited(text, to));
    }

    fn front(&self) -> Front {
        let bytes = &self.bytes[..];
        if let Some(len) = text_reply(bytes) {
            return Front::Complete(len);
        }
        let word = self.waiting.as_ref().map_or("", |asked| &asked.word);
        let value = match word {
            "state" => state(bytes),
            "isprogfinish" if is_flag(bytes) => Front::Complete(1),
            "getlasterror" => last_error(bytes),
            _ => Front::Other,
        };
        match value {
            Front::Other if is_beginning(bytes) => Front::Beginning,
            value => value,
        }
    }
}

/// Section 3 without the values, and section 4.
static TEXTS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let fixed = [
        "run start",
        "run success",
        "run fail",
        "script error",
        "set success",
        "set fail",
        "unknown command",
        "script finish",
    ];
    let did = BARE[..8].iter().flat_map(|word| [format!("{word} success"), format!("{word} fail")]);
    let already = BARE[..8].iter().map(|word| format!("already {word}"));
    fixed.into_iter().map(str::to_owned).chain(did).chain(already).collect()
});

/// The length of the text reply that `bytes` begin with.
fn text_reply(bytes: &[u8]) -> Option<usize> {
    let fixed = TEXTS.iter().find(|text| bytes.starts_with(text.as_bytes())).map(|text| text.len());
    fixed.or_else(|| {
        let number = bytes.strip_prefix(b"set speed ")?;
        let end = number.iter().position(|&byte| byte == b'%')?;
        is_percent(&number[..end]).then_some("set speed ".len() + end + 1)
    })
}

/// A number above 0 and at most 100 in digits, perhaps with a point, at most 16 of them.
fn is_percent(number: &[u8]) -> bool {
    let text = std::str::from_utf8(number).unwrap_or("x");
    let plain = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.' || byte == b' ');
    plain && trim(text).parse().is_ok_and(|percent: f32| percent > 0.0 && percent <= 100.0)
}

fn is_beginning(bytes: &[u8]) -> bool {
    let speed = || {
        let number = bytes.strip_prefix(b"set speed ").unwrap_or(b"x");
        number.len() <= 16 && number.iter().all(|byte| byte.is_ascii_digit() || [b'.', b' '].contains(byte))
    };
    TEXTS.iter().any(|text| text.as_bytes().starts_with(bytes)) || b"set speed ".starts_with(bytes) || speed()
}

/// `0` or `1`, and not a longer number.
fn is_flag(bytes: &[u8]) -> bool {
    let more = bytes.get(1).is_some_and(|byte| byte.is_ascii_digit() || *byte == b':');
    matches!(bytes.first(), Some(b'0' | b'1')) && !more
}

/// `6:0:5:2`, each number a byte.
fn state(bytes: &[u8]) -> Front {
    let end = bytes.iter().position(|byte| !byte.is_ascii_digit() && *byte != b':').unwrap_or(bytes.len());
    let numbers: Vec<&[u8]> = bytes[..end].split(|&byte| byte == b':').collect();
    let is_byte = |number: &&[u8]| std::str::from_utf8(number).unwrap().parse::<u8>().is_ok();
    let (whole, rest) = numbers.split_at(numbers.len().min(4));
    let (last, before) = whole.split_last().unwrap();
    if !before.iter().all(is_byte) {
        return Front::Other;
    }
    let all = whole.len() == 4 && is_byte(last);
    match (all, end == bytes.len() && rest.is_empty()) {
        (true, true) => Front::Open(20_000),
        // A colon behind the fourth number is no digit either.
        (true, false) => {
            Front::Complete(before.iter().map(|number| number.len() + 1).sum::<usize>() + last.len())
        }
        (false, true) if is_byte(last) || last.is_empty() => Front::Beginning,
        _ => Front::Other,
    }
}

/// `1F:message`.
fn last_error(bytes: &[u8]) -> Front {
    let number = bytes.strip_prefix(b"0x").unwrap_or(bytes);
    let digits = number.iter().take_while(|byte| byte.is_ascii_hexdigit()).count();
    match number.get(digits) {
        None if digits <= 8 => Front::Beginning,
        Some(b':')
            if digits > 0
                && u32::from_str_radix(std::str::from_utf8(&number[..digits]).unwrap(), 16).is_ok() =>
        {
            match bytes.iter().position(|&byte| is_end(byte)) {
                Some(end) => Front::Complete(end),
                None => Front::Open(100_000),
            }
        }
        // The beginning of 0x.
        _ => Front::Other,
    }
}

fn answers(word: &str, text: &[u8]) -> bool {
    let text = String::from_utf8_lossy(text);
    match word {
        _ if text == "unknown command" => true,
        "run" => text.starts_with("run ") || text == "script error",
        "speed" => text.starts_with("set "),
        "state" => text.contains(':'),
        "isprogfinish" => text == "0" || text == "1",
        "getlasterror" => text.contains(':'),
        _ => text.starts_with(&format!("{word} ")) || text == format!("already {word}"),
    }
}

/// Its words in small letters.
fn words(text: &[u8]) -> Vec<String> {
    let letters = text.iter().map(|&byte| if byte.is_ascii_alphanumeric() { byte as char } else { ' ' });
    let text: String = letters.collect();
    text.to_lowercase().split(' ').map(str::to_owned).collect()
}
