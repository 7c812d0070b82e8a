//! The adapter's side of slcan, the serial-line CAN protocol (docs/wire/slcan.md).
//!
//! In: bytes of one client, and frames of the bus. Out: frames for the bus; answers and frame lines for the client.
//! Does not know devices, buses or clocks. Used by `host-sim`'s bus, and by boards with a serial line in place of a CAN
//! controller.

use core::fmt;

use heapless::Vec;

use crate::wire::can::{CanFrame, CanId, MAX_CAN_DATA};

/// Longest line without its CR: `T`, 8 digits of id, 1 of length, 16 of data, 4 of time (section 2).
pub const MAX_LINE: usize = 30;

/// A line with its CR.
pub type SlcanLine = Vec<u8, { MAX_LINE + 1 }>;

/// One client's channel to the bus.
#[derive(Debug, Clone)]
pub struct Channel {
    bus_bitrate: u32,
    bitrate: Option<u32>,
    state: ChannelState,
    timestamps: bool,
    overrun: bool,
    line: Vec<u8, MAX_LINE>,
    overlong: bool,
    refused: u64,
}

/// Whether a channel is open (section 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ChannelState {
    /// Frames do not pass.
    Closed,
    /// Frames pass both ways.
    Open,
    /// Frames pass to the client only.
    ListenOnly,
}

impl Channel {
    /// A closed channel to a bus of `bus_bitrate` bit/s.
    pub fn new(bus_bitrate: u32) -> Self {
        Self {
            bus_bitrate,
            bitrate: None,
            state: ChannelState::Closed,
            timestamps: false,
            overrun: false,
            line: Vec::new(),
            overlong: false,
            refused: 0,
        }
    }

    /// Whether the client has opened the channel.
    pub fn state(&self) -> ChannelState {
        self.state
    }

    /// Lines answered with BEL so far.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Records that a frame of the bus was dropped because the client's buffer was full; the status reports it once.
    pub fn note_overrun(&mut self) {
        self.overrun = true;
    }

    /// Takes bytes up to the end of the next line that is not empty. Call it until it returns `None`.
    pub fn receive(&mut self, bytes: &mut &[u8]) -> Option<Reaction> {
        while let Some((&byte, rest)) = bytes.split_first() {
            *bytes = rest;
            match byte {
                b'\r' => {
                    let line = core::mem::take(&mut self.line);
                    let overlong = core::mem::take(&mut self.overlong);
                    if line.is_empty() && !overlong {
                        continue;
                    }
                    let reaction = if overlong { Reaction::REFUSED } else { self.line(&line) };
                    self.refused = self.refused.saturating_add(u64::from(reaction == Reaction::REFUSED));
                    return Some(reaction);
                }
                // Some clients end lines with CR LF.
                b'\n' => {}
                _ => self.overlong |= self.line.push(byte).is_err(),
            }
        }
        None
    }

    /// The line that reports a frame on the bus at `millis` to the client; `None` if the channel is closed.
    pub fn deliver(&self, frame: &CanFrame, millis: u64) -> Option<SlcanLine> {
        let open = self.state != ChannelState::Closed;
        let stamp = u16::try_from(millis % TIMESTAMP_MODULUS).unwrap_or(0);
        open.then(|| encode(frame, self.timestamps.then_some(stamp)))
    }

    fn line(&mut self, line: &[u8]) -> Reaction {
        let closed = self.state == ChannelState::Closed;
        match line {
            [b't' | b'T' | b'r' | b'R', ..] => match decode(line) {
                Ok(frame) if self.state == ChannelState::Open => {
                    let extended = matches!(frame.id(), CanId::Extended(_));
                    let answer: &[u8] = if extended { b"Z\r" } else { b"z\r" };
                    Reaction { answer, frame: Some(frame) }
                }
                _ => Reaction::REFUSED,
            },
            [b'S', digit @ b'0'..=b'8'] if closed => {
                self.bitrate = BITRATES.get(usize::from(digit.wrapping_sub(b'0'))).copied();
                Reaction::DONE
            }
            [b's', digits @ ..]
                if closed && matches!(digits.len(), 4 | 6) && digits.iter().all(u8::is_ascii_hexdigit) =>
            {
                self.bitrate = None;
                Reaction::DONE
            }
            b"O" => self.open(ChannelState::Open),
            b"L" => self.open(ChannelState::ListenOnly),
            b"C" => {
                self.state = ChannelState::Closed;
                Reaction::DONE
            }
            b"Z0" | b"Z1" => {
                self.timestamps = line == b"Z1";
                Reaction::DONE
            }
            // Frames are always forwarded without polling.
            b"X1" => Reaction::DONE,
            b"V" => Reaction::answer(b"V1013\r"),
            b"v" => Reaction::answer(b"v1013\r"),
            b"N" => Reaction::answer(b"NRG01\r"),
            b"F" if core::mem::take(&mut self.overrun) => Reaction::answer(b"F08\r"),
            b"F" => Reaction::answer(b"F00\r"),
            _ => Reaction::REFUSED,
        }
    }

    fn open(&mut self, state: ChannelState) -> Reaction {
        if self.bitrate.is_some_and(|bitrate| bitrate != self.bus_bitrate) {
            return Reaction::REFUSED;
        }
        self.state = state;
        Reaction::DONE
    }
}

/// The effect of one line of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reaction {
    /// The answer to the client, at most eight bytes.
    pub answer: &'static [u8],
    /// The frame for the bus.
    pub frame: Option<CanFrame>,
}

impl Reaction {
    const DONE: Self = Self::answer(b"\r");
    const REFUSED: Self = Self::answer(&[BEL]);

    const fn answer(answer: &'static [u8]) -> Self {
        Self { answer, frame: None }
    }
}

/// Why a line is not a valid frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum LineError {
    /// It does not begin with `t`, `T`, `r` or `R`.
    NotAFrame,
    /// A digit is missing or wrong, or something follows the frame.
    Malformed,
    /// The id has more than 29 bits, or more than 11 in a standard frame.
    Id,
    /// The length is more than 8.
    Length,
}

impl fmt::Display for LineError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotAFrame => "not a frame: it does not begin with t, T, r or R",
            Self::Malformed => "a hexadecimal digit is missing or wrong, or something follows the frame",
            Self::Id => "the id is too large for its kind",
            Self::Length => "a frame has at most 8 bytes",
        })
    }
}

impl core::error::Error for LineError {}

/// Parses a frame's line without its CR (section 2). A timestamp after the frame is accepted.
///
/// # Errors
/// See [`LineError`].
pub fn decode(line: &[u8]) -> Result<CanFrame, LineError> {
    let (&kind, rest) = line.split_first().ok_or(LineError::NotAFrame)?;
    let (extended, remote) = match kind {
        b't' => (false, false),
        b'T' => (true, false),
        b'r' => (false, true),
        b'R' => (true, true),
        _ => return Err(LineError::NotAFrame),
    };
    let malformed = LineError::Malformed;
    let (id, rest) = rest.split_at_checked(if extended { 8 } else { 3 }).ok_or(malformed)?;
    let id = hex(id).ok_or(malformed)?;
    let (len, rest) = rest.split_at_checked(1).ok_or(malformed)?;
    let len = hex(len).ok_or(malformed)? as usize;
    if len > MAX_CAN_DATA {
        return Err(LineError::Length);
    }
    let (digits, stamp) =
        rest.split_at_checked(if remote { 0 } else { len.saturating_mul(2) }).ok_or(malformed)?;
    if !matches!(stamp.len(), 0 | 4) || !stamp.iter().all(u8::is_ascii_hexdigit) {
        return Err(malformed);
    }
    let mut data: Vec<u8, MAX_CAN_DATA> = Vec::new();
    for pair in digits.chunks(2) {
        let byte = hex(pair).and_then(|value| u8::try_from(value).ok()).ok_or(malformed)?;
        data.push(byte).map_err(|_| LineError::Length)?;
    }
    let id = if extended { CanId::Extended(id) } else { CanId::Standard(id as u16) };
    if remote { CanFrame::remote(id, len) } else { CanFrame::new(id, &data) }.ok_or(LineError::Id)
}

/// Formats a frame's line with its CR, and with the time in milliseconds within a minute if given.
pub fn encode(frame: &CanFrame, timestamp: Option<u16>) -> SlcanLine {
    let mut line = SlcanLine::new();
    let (kind, id, digits) = match frame.id() {
        CanId::Standard(id) => (if frame.is_remote() { b'r' } else { b't' }, u32::from(id), 3),
        CanId::Extended(id) => (if frame.is_remote() { b'R' } else { b'T' }, id, 8),
    };
    // The capacity is MAX_LINE, so no push fails.
    let _ = line.push(kind);
    push_hex(&mut line, id, digits);
    push_hex(&mut line, embedded_can::Frame::dlc(frame) as u32, 1);
    for &byte in frame.data() {
        push_hex(&mut line, u32::from(byte), 2);
    }
    if let Some(time) = timestamp {
        push_hex(&mut line, u32::from(time), 4);
    }
    let _ = line.push(b'\r');
    line
}

fn push_hex(line: &mut SlcanLine, value: u32, digits: u32) {
    for place in (0..digits).rev() {
        let digit = value.unbounded_shr(place.saturating_mul(4)) & 0xF;
        let _ = char::from_digit(digit, 16).map(|digit| line.push(digit.to_ascii_uppercase() as u8));
    }
}

/// Up to eight hexadecimal digits of either case.
fn hex(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |value: u32, &digit| Some(value << 4 | char::from(digit).to_digit(16)?))
}

const BEL: u8 = 0x07;
/// Timestamps are milliseconds within a minute.
const TIMESTAMP_MODULUS: u64 = 60_000;
/// Bit rates of S0 to S8 (section 3), bit/s.
const BITRATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

#[cfg(test)]
mod tests;
