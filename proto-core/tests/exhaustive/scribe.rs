//! Fingerprints of states: two that behave alike from now on should get the same one.
//!
//! In: the `Debug` text of the engine and of the judge, as `core::fmt` writes it, piece by piece. Out:
//! 64 bits. The text has every field, so that nothing that is added to the engine is forgotten here.
//! What is left out or rewritten is named below, each with the reason why it cannot matter. A wrong
//! exception could only merge states that differ and hide what lies behind them; a test searches with
//! fingerprints and without, and the findings must be the same.
//!
//! - Instants are written as differences to now. The engine compares instants with each other and adds
//!   constant durations to them, so a shifted clock changes nothing. [`Instant::ZERO`], which says that
//!   nothing was ever told, stays: the clock starts long after it.
//! - Instants that nothing looks at any more: see [`Scribe::instant`].
//! - Counters and histories: the engine writes them and does not read them. The exception is how many
//!   commands a port picked, which is compared with the number that a command has: that is written as
//!   the difference.
//! - Buffers of partial frames, packets and replies that are empty: what is in them is overwritten
//!   before it is read. When one is not empty, the fingerprint is made unique.
//! - Bytes handed over on a connection are compared with marks on the same count: written as the
//!   difference. Modbus transactions are numbered; an answer carries the number of a request a few
//!   before the newest at most, and the engine tells numbers apart over 2^15.
//! - What only the status shows: latency, the newest rejection, states and commands, and since when
//!   something waits.
//! - Layouts and dialects: computed from the configuration, never changed.
//! - Of exchanges: what only a start of the device needs, which no cell has; when a request was taken last,
//!   but for which of two neighbours was first; the kept request of an event, when a request left and how
//!   long the line has been silent, which the judge has while they matter; what a framer holds.

use std::fmt::{Debug, Write};

use proto_core::time::{Duration, Instant};

pub struct Scribe {
    hash: u64,
    now: u64,
    /// How many commands the port has picked, or connections the controller has made.
    commands: u64,
    look_back: LookBack,
    /// Mixed in where states must not be merged.
    unique: u64,
    skip: Skip,
    field: Field,
    word: Word,
    /// The structs that are open.
    open: Vec<Kind>,
    total: u64,
    len: u64,
    up_for: u64,
    buffer_is_empty: bool,
    silence_is_normal: bool,
    has_slept: bool,
    /// The instant or the number before, of those that are written with the next one.
    before: u64,
}

/// The longest times for which a configuration looks back; what is longer ago is all alike.
#[derive(Clone, Copy)]
pub struct LookBack {
    /// At bits that wait: the port's timeout.
    pub bits: Duration,
    /// At what arrived: what makes it stale, or a controller that was away.
    pub stamps: Duration,
    /// At since when safe values are unconfirmed.
    pub unconfirmed: Duration,
    /// At when one was confirmed.
    pub confirmed: Duration,
}

/// What is left out.
#[derive(Clone, Copy, PartialEq)]
enum Skip {
    Nothing,
    /// Numbers, up to the closing bracket.
    Array,
    /// A struct, with so many braces open.
    Struct(u32),
}

/// The word before a colon, a brace or a parenthesis.
#[derive(Clone, Copy, PartialEq)]
enum Word {
    Field(Field),
    Struct(Kind),
    Instant,
}

/// Fields that are rewritten, or decide how others are.
#[derive(Clone, Copy, PartialEq)]
enum Field {
    Other,
    /// Numbers that the engine writes and never reads.
    Counter,
    /// What only the status shows: an instant, a number, or nothing.
    Shown,
    /// Arrays of bytes that are constant, empty, or read elsewhere.
    Buffer,
    Stamps,
    Unconfirmed,
    Confirmed,
    At,
    Since,
    Heard,
    Newest,
    Nth,
    Total,
    End,
    Len,
    HandedOut,
    Filled,
    Silence,
    Backoff,
    IsDeaf,
    DeafUntil,
    WayMade,
    /// Has it come, and when will it?
    Until,
    /// Of replies that may come: how many, until when.
    Outstanding,
    Taken,
    Connection,
    Failures,
    Start,
}

/// Structs whose fields' names say too little.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Other,
    LeftOut,
    /// A command that was handed over.
    Sent,
    /// A link's state.
    Up,
    /// A serial line's timing.
    Line,
    /// A byte variable's value that waits.
    Bit,
    /// The client of port 2000.
    Client,
    /// What gathers frames or packets.
    Gatherer,
    /// The same of a line with exchanges.
    Framer,
    /// A bit as it was read last.
    Reading,
}

const NEVER: u64 = u64::MAX;
/// What the engine asks of a link that was lost: was another lost within this time? And of a command
/// that is unanswered: has it been so for as long?
const TOGETHER: u64 = 1_000_000;
/// And had it been up for this long?
const SETTLED: u64 = 5_000_000;
/// The longest wait of an exchange grows no more.
const MOST_FAILURES: u64 = 6;
/// The shortest wait of a link.
const SHORTEST_WAIT: u64 = 100_000;

impl Scribe {
    /// `commands` is how many the port has picked; `unique` differs in every call.
    pub fn new(now: Instant, commands: u32, look_back: LookBack, unique: u64) -> Self {
        Self {
            hash: 0x9E37_79B9_7F4A_7C15,
            now: now.as_micros(),
            commands: u64::from(commands),
            look_back,
            unique,
            skip: Skip::Nothing,
            field: Field::Other,
            word: Word::Field(Field::Other),
            open: Vec::with_capacity(16),
            total: 0,
            len: 0,
            up_for: 0,
            buffer_is_empty: false,
            silence_is_normal: false,
            has_slept: false,
            before: 0,
        }
    }

    pub fn describe(&mut self, of: &impl Debug) {
        write!(self, "{of:?}").expect("hashing does not fail");
    }

    pub fn bytes(&mut self, bytes: &[u8]) {
        let mut chunks = bytes.chunks_exact(8);
        for chunk in &mut chunks {
            self.mix(u64::from_le_bytes(chunk.try_into().expect("eight bytes")));
        }
        let rest = chunks.remainder();
        if !rest.is_empty() {
            let mut word = [0; 8];
            word[..rest.len()].copy_from_slice(rest);
            self.mix(u64::from_le_bytes(word));
        }
    }

    pub fn finish(self) -> u64 {
        self.hash
    }

    fn mix(&mut self, word: u64) {
        let product = u128::from(self.hash ^ word) * 0xA076_1D64_78BD_642F;
        self.hash = (product as u64) ^ ((product >> 64) as u64) ^ word.rotate_left(32);
    }

    fn kind(&self) -> Kind {
        self.open.last().copied().unwrap_or(Kind::Other)
    }

    fn instant(&mut self, at: u64) {
        if self.field == Field::Shown {
            return;
        }
        match self.field {
            Field::Until if at != NEVER => return self.mix(at.saturating_sub(self.now)),
            // How many there were does not matter any more.
            Field::Outstanding if at <= self.now => return self.mix(0),
            Field::Outstanding => self.mix(self.before),
            Field::Taken => {
                let before = std::mem::replace(&mut self.before, at);
                return self.mix(u64::from(before < at) + 2 * u64::from(before > at));
            }
            _ => {}
        }
        if at == NEVER || at == 0 {
            return self.mix(at ^ 0x5555);
        }
        let ago = self.now.saturating_sub(at);
        let ago = match (self.field, self.kind()) {
            // When a command was sent: one that stops is sent again behind it a second later.
            (Field::At, Kind::Sent) => ago.min(TOGETHER + 1),
            // Silence of a line counts for partial frames, and before sending where one has to wait.
            (Field::Heard, Kind::Line) => return,
            (Field::Heard, _) if self.silence_is_normal => return,
            (Field::Newest, Kind::Client) if self.buffer_is_empty => return,
            (Field::DeafUntil, _) if !self.has_slept => return,
            // Has it come?
            (Field::WayMade, _) => ago.min(1),
            // Looked at with the backoff, which follows.
            (Field::Since, Kind::Up) => {
                self.up_for = ago;
                return;
            }
            (Field::At, Kind::Bit) => ago.min(self.look_back.bits.as_micros() + 1),
            (Field::Unconfirmed, _) => ago.min(self.look_back.unconfirmed.as_micros() + 1),
            (Field::Confirmed, _) => ago.min(self.look_back.confirmed.as_micros() + 1),
            (Field::Stamps, _) | (Field::At, Kind::Reading) => ago.min(self.look_back.stamps.as_micros() + 1),
            _ => ago,
        };
        self.mix(ago);
        self.mix(at.saturating_sub(self.now));
    }

    fn number(&mut self, digits: &[u8]) {
        // No other instant has as many digits, and there are a hundred of these.
        let number = if digits.len() == 20 { NEVER } else { value(digits) };
        if self.word == Word::Instant {
            self.word = Word::Field(Field::Other);
            return self.instant(number);
        }
        match (self.field, self.kind()) {
            (Field::Counter | Field::Shown, _) => return,
            (Field::Nth, _) => return self.mix(self.commands.wrapping_sub(number)),
            (Field::Total, _) => {
                self.total = number;
                return;
            }
            // What it holds is the damaged reply of which the judge knows.
            (Field::End, Kind::Framer) => return self.mix(number - self.before),
            (Field::End, _) => return self.mix(u64::from(self.total.wrapping_sub(number) as u32)),
            (Field::Len, Kind::Client) => {
                self.len = number;
                return;
            }
            (Field::HandedOut, Kind::Client) => {
                self.buffer_is_empty = number == self.len;
                if !self.buffer_is_empty {
                    self.mix(self.unique);
                }
                return;
            }
            (Field::Outstanding, _) | (Field::Start, Kind::Framer) => {
                self.before = number;
                return;
            }
            (Field::Connection, _) => return self.mix(self.commands.wrapping_sub(number).min(1)),
            (Field::Failures, _) => return self.mix(number.min(MOST_FAILURES)),
            (Field::Len | Field::Filled, Kind::Gatherer) if number != 0 => return self.mix(self.unique),
            (Field::Backoff, _) => {
                let most = if number == SHORTEST_WAIT { TOGETHER } else { SETTLED };
                self.mix(self.up_for.min(most + 1));
                self.up_for = 0;
            }
            _ => {}
        }
        self.mix(number ^ 0xAAAA);
    }

    fn word(&mut self, text: &[u8]) {
        match text {
            b"None" | b"Some" if self.field == Field::Shown => return,
            // Whether there is one is only shown, too.
            b"LastRejection" | b"LastText" => {
                self.word = Word::Struct(Kind::LeftOut);
                return;
            }
            _ => {}
        }
        // The next word is the name of the next field.
        match std::mem::replace(&mut self.field, Field::Other) {
            Field::Silence => self.silence_is_normal = text == b"None",
            Field::IsDeaf => self.has_slept = text == b"true",
            field => self.field = field,
        }
        self.bytes(text);
        self.word = match text {
            b"Instant" => Word::Instant,
            b"PortCounters" | b"LinkCounters" | b"LinkHistory" | b"DeframerStats" | b"StreamLayout"
            | b"CanLayout" | b"Dialect" | b"Latency" | b"Tap" | b"PeerCounters" | b"Times" | b"RowTimes"
            | b"RowKind" | b"DeviceFormat" | b"FramerStats" | b"Told" | b"OutcomeTo" => {
                Word::Struct(Kind::LeftOut)
            }
            b"Sent" => Word::Struct(Kind::Sent),
            b"Up" => Word::Struct(Kind::Up),
            b"LineTiming" => Word::Struct(Kind::Line),
            b"BitSlot" | b"Edge" => Word::Struct(Kind::Bit),
            b"CommandClient" => Word::Struct(Kind::Client),
            b"Framer" => Word::Struct(Kind::Framer),
            b"Reading" => Word::Struct(Kind::Reading),
            b"Deframer" | b"StateStream" | b"AduReader" => Word::Struct(Kind::Gatherer),
            _ if text[0].is_ascii_uppercase() => Word::Struct(Kind::Other),
            b"transaction" | b"stale" | b"sleeps" | b"frames_sent" | b"packets" | b"misaligned"
            | b"dropped" | b"counted" | b"credit" | b"missed" => Word::Field(Field::Counter),
            b"bytes" | b"group" | b"ring" | b"buffer" | b"mask" | b"codes" | b"picked" | b"written" => {
                Word::Field(Field::Buffer)
            }
            b"last_rejection" | b"last_text" | b"offered" | b"due_since" | b"born" | b"failing" | b"sent" => {
                Word::Field(Field::Shown)
            }
            b"stamps" | b"packet_at" | b"source_at" | b"frame_at" => Word::Field(Field::Stamps),
            b"unconfirmed_since" => Word::Field(Field::Unconfirmed),
            b"confirmed_at" => Word::Field(Field::Confirmed),
            b"at" => Word::Field(Field::At),
            b"since" => Word::Field(Field::Since),
            b"heard" => Word::Field(Field::Heard),
            b"newest" => Word::Field(Field::Newest),
            b"nth" => Word::Field(Field::Nth),
            b"total" => Word::Field(Field::Total),
            b"end" => Word::Field(Field::End),
            b"len" => Word::Field(Field::Len),
            b"handed_out" => Word::Field(Field::HandedOut),
            b"filled" => Word::Field(Field::Filled),
            b"silence" => Word::Field(Field::Silence),
            b"backoff" => Word::Field(Field::Backoff),
            b"has_slept" => Word::Field(Field::IsDeaf),
            b"former" | b"look_at" | b"expires_at" => Word::Field(Field::Until),
            b"outstanding" => Word::Field(Field::Outstanding),
            b"taken" => Word::Field(Field::Taken),
            b"connection" => Word::Field(Field::Connection),
            b"failures" => Word::Field(Field::Failures),
            b"start" => Word::Field(Field::Start),
            b"way_made_until" => Word::Field(Field::WayMade),
            b"slept_until" => Word::Field(Field::DeafUntil),
            _ => Word::Field(Field::Other),
        };
    }
}

impl Write for Scribe {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        let text = text.as_bytes();
        let Some(&first) = text.first() else { return Ok(()) };
        match self.skip {
            Skip::Array => {
                if first == b']' {
                    self.skip = Skip::Nothing;
                }
                return Ok(());
            }
            Skip::Struct(depth) => {
                match text {
                    b" { " => self.skip = Skip::Struct(depth + 1),
                    b" }" if depth == 1 => self.skip = Skip::Nothing,
                    b" }" => self.skip = Skip::Struct(depth - 1),
                    _ => {}
                }
                return Ok(());
            }
            Skip::Nothing => {}
        }
        match first {
            b'0'..=b'9' => self.number(text),
            b':' => {
                if let Word::Field(field) = self.word {
                    self.field = field;
                }
            }
            b'[' if self.field == Field::Buffer => self.skip = Skip::Array,
            b' ' if text == b" { " => {
                let kind = if let Word::Struct(kind) = self.word { kind } else { Kind::Other };
                if kind == Kind::LeftOut {
                    self.skip = Skip::Struct(1);
                } else {
                    self.open.push(kind);
                }
            }
            b' ' => {
                self.open.pop();
            }
            // Where a list or an option ends is told: what follows it is another field.
            b']' => self.mix(1),
            b',' | b'(' | b')' | b'[' | b'"' => {}
            _ => self.word(text),
        }
        Ok(())
    }
}

fn value(digits: &[u8]) -> u64 {
    digits.iter().fold(0, |sum: u64, digit| sum.wrapping_mul(10).wrapping_add(u64::from(digit & 15)))
}
