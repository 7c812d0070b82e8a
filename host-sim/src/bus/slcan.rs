//! The adapter's side of slcan, the serial-line CAN protocol (docs/wire/slcan.md).
//!
//! Bytes of one client go in; frames for the bus and answers for the client come out, and frames of the
//! bus become lines. No device, no bus and no clock is known here.

use heapless::Vec as Bounded;
use proto_core::recipe::can::CanFrame;
use proto_core::recipe::model::CanId;

/// Longest line without its CR: `T`, 8 digits of id, the length, 16 digits of data, 4 of time
/// (section 2).
pub const MAX_LINE: usize = 30;

/// A line with its CR.
pub type Line = Bounded<u8, { MAX_LINE + 1 }>;

/// One client's channel to the bus.
#[derive(Debug, Clone)]
pub struct Channel {
    bus_bitrate: u32,
    bitrate: Option<u32>,
    state: ChannelState,
    timestamps: bool,
    overrun: bool,
    line: Bounded<u8, MAX_LINE>,
    overlong: bool,
    refused: u64,
}

/// Whether a channel is open (section 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChannelState {
    /// No frame passes.
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
            line: Bounded::new(),
            overlong: false,
            refused: 0,
        }
    }

    /// Whether the client has opened it.
    pub fn state(&self) -> ChannelState {
        self.state
    }

    /// Lines answered with BEL so far.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Notes that a frame of the bus could not be kept for the client; the status tells it once.
    pub fn note_overrun(&mut self) {
        self.overrun = true;
    }

    /// Takes bytes up to the next frame for the bus; call it until it returns `None`. Answers are
    /// appended to `answers`, at most eight bytes a line.
    pub fn receive(&mut self, bytes: &mut &[u8], answers: &mut Vec<u8>) -> Option<CanFrame> {
        while let Some((&byte, rest)) = bytes.split_first() {
            *bytes = rest;
            match byte {
                b'\r' => {
                    let line = core::mem::take(&mut self.line);
                    let answer = match core::mem::take(&mut self.overlong) {
                        true => Answer::Refused,
                        false => self.line(&line),
                    };
                    match answer {
                        Answer::None => {}
                        Answer::Done => answers.push(b'\r'),
                        Answer::Refused => {
                            self.refused += 1;
                            answers.push(BEL);
                        }
                        Answer::Text(text) => answers.extend_from_slice(text),
                        Answer::Sent(frame) => {
                            let extended = matches!(frame.id(), CanId::Extended(_));
                            answers.extend_from_slice(if extended { b"Z\r" } else { b"z\r" });
                            return Some(frame);
                        }
                    }
                }
                // Of a client that ends its lines with CR LF.
                b'\n' => {}
                _ => self.overlong |= self.line.push(byte).is_err(),
            }
        }
        None
    }

    /// The line that tells the client of a frame on the bus at `millis`; `None` while it is closed.
    pub fn deliver(&self, frame: &CanFrame, millis: u64) -> Option<Line> {
        let open = self.state != ChannelState::Closed;
        let stamp = u16::try_from(millis % TIMESTAMP_MODULUS).unwrap_or(0);
        open.then(|| encode(frame, self.timestamps.then_some(stamp)))
    }

    fn line(&mut self, line: &[u8]) -> Answer {
        let closed = self.state == ChannelState::Closed;
        match line {
            [] => Answer::None,
            [b't' | b'T' | b'r' | b'R', ..] => match decode(line) {
                Ok(frame) if self.state == ChannelState::Open => Answer::Sent(frame),
                _ => Answer::Refused,
            },
            [b'S', digit @ b'0'..=b'8'] if closed => {
                self.bitrate = BITRATES.get(usize::from(digit - b'0')).copied();
                Answer::Done
            }
            [b's', digits @ ..]
                if closed && matches!(digits.len(), 4 | 6) && digits.iter().all(u8::is_ascii_hexdigit) =>
            {
                self.bitrate = None;
                Answer::Done
            }
            b"O" => self.open(ChannelState::Open),
            b"L" => self.open(ChannelState::ListenOnly),
            b"C" => {
                self.state = ChannelState::Closed;
                Answer::Done
            }
            b"Z0" | b"Z1" => {
                self.timestamps = line == b"Z1";
                Answer::Done
            }
            // Frames are always passed on without being asked for.
            b"X1" => Answer::Done,
            b"V" => Answer::Text(b"V1013\r"),
            b"v" => Answer::Text(b"v1013\r"),
            b"N" => Answer::Text(b"NRG01\r"),
            b"F" => Answer::Text(if core::mem::take(&mut self.overrun) { b"F08\r" } else { b"F00\r" }),
            _ => Answer::Refused,
        }
    }

    fn open(&mut self, state: ChannelState) -> Answer {
        if self.bitrate.is_some_and(|bitrate| bitrate != self.bus_bitrate) {
            return Answer::Refused;
        }
        self.state = state;
        Answer::Done
    }
}

enum Answer {
    None,
    Done,
    Refused,
    Text(&'static [u8]),
    Sent(CanFrame),
}

/// Why a line is not a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum LineError {
    /// It does not begin with `t`, `T`, `r` or `R`.
    NotAFrame,
    /// A digit is missing or is not one, or something follows the frame.
    Malformed,
    /// The id has more than 29 bits, or more than 11 in a standard frame.
    Id,
    /// The length is more than 8.
    Length,
}

/// Reads a frame's line, without its CR (section 2). A timestamp after the frame is accepted.
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
    if len > 8 {
        return Err(LineError::Length);
    }
    let (digits, stamp) = rest.split_at_checked(if remote { 0 } else { 2 * len }).ok_or(malformed)?;
    if !matches!(stamp.len(), 0 | 4) || !stamp.iter().all(u8::is_ascii_hexdigit) {
        return Err(malformed);
    }
    let mut data: Bounded<u8, 8> = Bounded::new();
    for pair in digits.chunks(2) {
        let byte = hex(pair).and_then(|value| u8::try_from(value).ok()).ok_or(malformed)?;
        data.push(byte).map_err(|_| LineError::Length)?;
    }
    let id = if extended { CanId::Extended(id) } else { CanId::Standard(id as u16) };
    if remote { CanFrame::remote(id, len) } else { CanFrame::new(id, &data) }.ok_or(LineError::Id)
}

/// Writes a frame's line with its CR, and the time in milliseconds within a minute when given.
pub fn encode(frame: &CanFrame, timestamp: Option<u16>) -> Line {
    let mut line = Line::new();
    let (kind, id, digits) = match frame.id() {
        CanId::Standard(id) => (if frame.is_remote() { b'r' } else { b't' }, u32::from(id), 3),
        CanId::Extended(id) => (if frame.is_remote() { b'R' } else { b'T' }, id, 8),
    };
    // MAX_LINE holds the longest line, so no push is refused.
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

fn push_hex(line: &mut Line, value: u32, digits: u32) {
    for place in (0..digits).rev() {
        let digit = (value >> (4 * place)) as usize & 0xF;
        let _ = line.push(b"0123456789ABCDEF"[digit]);
    }
}

/// Up to eight hexadecimal digits of either case.
fn hex(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |value: u32, &digit| Some(value << 4 | char::from(digit).to_digit(16)?))
}

const BEL: u8 = 0x07;
/// Timestamps count milliseconds of a minute.
const TIMESTAMP_MODULUS: u64 = 60_000;
/// S0 to S8 (section 3), bit/s.
const BITRATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Everything a channel makes of `bytes` given in chunks of `size`.
    fn feed(channel: &mut Channel, bytes: &[u8], size: usize) -> (Vec<CanFrame>, Vec<u8>) {
        let (mut frames, mut answers) = (Vec::new(), Vec::new());
        for mut chunk in bytes.chunks(size) {
            while let Some(frame) = channel.receive(&mut chunk, &mut answers) {
                frames.push(frame);
            }
            assert!(chunk.is_empty());
        }
        (frames, answers)
    }

    #[track_caller]
    fn session(bytes: &[u8], expected_answers: &[u8]) -> Vec<CanFrame> {
        let whole = feed(&mut Channel::new(500_000), bytes, bytes.len());
        for size in 1..bytes.len() {
            assert_eq!(feed(&mut Channel::new(500_000), bytes, size), whole, "chunks of {size}");
        }
        let text = String::from_utf8_lossy;
        assert_eq!(text(&whole.1), text(expected_answers));
        whole.0
    }

    fn standard(id: u16, data: &[u8]) -> CanFrame {
        CanFrame::new(CanId::Standard(id), data).unwrap()
    }

    #[test]
    fn python_can_opens_with_an_empty_line_and_twice() {
        let frames = session(b"C\rS6\r\rO\rO\rt0013010203\r", b"\r\r\r\rz\r");
        assert_eq!(frames, [standard(1, &[1, 2, 3])]);
    }

    #[test]
    fn every_kind_of_frame_is_read() {
        let frames = session(b"O\rt7FF0\rT1FFFFFFF2aBcD\rr0018\rR000000003\r", b"\rz\rZ\rz\rZ\r");
        assert_eq!(
            frames,
            [
                standard(0x7FF, &[]),
                CanFrame::new(CanId::Extended(0x1FFF_FFFF), &[0xAB, 0xCD]).unwrap(),
                CanFrame::remote(CanId::Standard(1), 8).unwrap(),
                CanFrame::remote(CanId::Extended(0), 3).unwrap(),
            ]
        );
    }

    #[test]
    fn what_is_wrong_gets_a_bell_and_the_next_line_passes() {
        for wrong in [
            "t",
            "t00",
            "t0019",
            "t00110",
            "t001111zz",
            "t80010",
            "T2000000010",
            "t0011000",
            "t00111+1",
            "x",
            "S9",
            "S",
            "O1",
            "Z2",
            "P",
            "M00000000",
            "s12",
            "t00180102030405060708000011",
            "\u{e9}",
        ] {
            let mut channel = Channel::new(500_000);
            feed(&mut channel, b"O\r", 9);
            let bytes = format!("{wrong}\rt0010\r");
            let (frames, answers) = feed(&mut channel, bytes.as_bytes(), 5);
            assert_eq!(frames, [standard(1, &[])], "{wrong:?}");
            assert_eq!(answers, b"\x07z\r", "{wrong:?}");
            assert_eq!(channel.refused(), 1);
        }
    }

    #[test]
    fn a_line_without_end_takes_no_memory_and_one_bell() {
        let mut channel = Channel::new(500_000);
        let mut bytes = b"O\r".to_vec();
        bytes.extend(std::iter::repeat_n(b't', 100_000));
        bytes.extend_from_slice(b"\rt0010\r");
        let (frames, answers) = feed(&mut channel, &bytes, 777);
        assert_eq!((frames.len(), answers.as_slice()), (1, b"\r\x07z\r".as_slice()));
    }

    #[test]
    fn frames_pass_only_where_the_channel_is_open() {
        let mut channel = Channel::new(500_000);
        let frame = standard(2, &[0x7D]);
        let send = |channel: &mut Channel, bytes: &[u8]| feed(channel, bytes, 99).1;
        assert_eq!(send(&mut channel, b"t0010\r"), b"\x07");
        assert_eq!(channel.deliver(&frame, 0), None);
        assert_eq!(send(&mut channel, b"L\rt0010\r"), b"\r\x07");
        assert_eq!(channel.deliver(&frame, 0).unwrap(), b"t00217D\r");
        assert_eq!(send(&mut channel, b"Z1\rS6\r"), b"\r\x07");
        assert_eq!(channel.deliver(&frame, 60_000 + 0x1234).unwrap(), b"t00217D1234\r");
        assert_eq!(send(&mut channel, b"C\r"), b"\r");
        assert_eq!(channel.deliver(&frame, 0), None);
    }

    #[test]
    fn a_client_at_another_bit_rate_is_not_let_onto_the_bus() {
        let mut channel = Channel::new(500_000);
        assert_eq!(feed(&mut channel, b"S5\rO\rL\r", 99).1, b"\r\x07\x07");
        assert_eq!(channel.state(), ChannelState::Closed);
        assert_eq!(feed(&mut channel, b"s031C\rO\rC\rS6\rO\r", 99).1, b"\r\r\r\r\r");
        assert_eq!(channel.state(), ChannelState::Open);
    }

    #[test]
    fn queries_are_answered_and_an_overrun_is_told_once() {
        let mut channel = Channel::new(500_000);
        channel.note_overrun();
        assert_eq!(feed(&mut channel, b"V\rv\rN\rF\rF\rX1\r", 1).1, b"V1013\rv1013\rNRG01\rF08\rF00\r\r");
    }

    fn any_frame() -> impl Strategy<Value = CanFrame> {
        let id = prop_oneof![
            (0..=0x7FF_u16).prop_map(CanId::Standard),
            (0..=0x1FFF_FFFF_u32).prop_map(CanId::Extended)
        ];
        (id, any::<bool>(), proptest::collection::vec(any::<u8>(), 0..=8)).prop_map(|(id, remote, data)| {
            if remote { CanFrame::remote(id, data.len()) } else { CanFrame::new(id, &data) }.unwrap()
        })
    }

    proptest! {
        #[test]
        fn a_frame_survives_its_line(frame in any_frame(), time in proptest::option::of(0..60_000_u16)) {
            let line = encode(&frame, time);
            let (end, text) = line.split_last().unwrap();
            prop_assert_eq!(*end, b'\r');
            prop_assert!(text.len() <= MAX_LINE);
            prop_assert_eq!(decode(text), Ok(frame));
        }

        #[test]
        fn whatever_comes_in_the_chunks_do_not_matter(
            bytes in proptest::collection::vec(prop_oneof![
                any::<u8>(),
                proptest::sample::select(b"tTrR0123fFOCLSZVN\r\r\r".to_vec()),
            ], 0..200),
            size in 1..20_usize,
        ) {
            let (mut one, mut other) = (Channel::new(500_000), Channel::new(500_000));
            let whole = feed(&mut one, &bytes, bytes.len().max(1));
            prop_assert_eq!(&feed(&mut other, &bytes, size), &whole);
            // Whatever was sent came from a line that says exactly this frame.
            let lines: Vec<_> = bytes.split(|&byte| byte == b'\r').collect();
            prop_assert!(whole.0.len() <= lines.len());
        }

        #[test]
        fn a_line_is_refused_or_means_one_frame(line in "[tTrR][0-9a-fA-F]{0,30}") {
            if let Ok(frame) = decode(line.as_bytes()) {
                let canonical = encode(&frame, None);
                let text = &canonical[..canonical.len() - 1];
                prop_assert!(line.to_ascii_uppercase().as_bytes().starts_with(&text.to_ascii_uppercase()));
                prop_assert!(line.len() == text.len() || line.len() == text.len() + 4);
            }
        }
    }
}
