//! slcan: any bytes of any client, against docs/wire/slcan.md read line by line.

use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::slcan::{Channel, ChannelState, decode, encode};

use crate::source::{Source, cut};

const BUS: u32 = 500_000;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let how = input.u8();
    let (mut channel, mut client) = (Channel::new(BUS), Client::default());
    let mut bytes = Vec::new();
    while !input.is_empty() {
        match input.u8() {
            0xF0 => {
                client.receive(&mut channel, &bytes, how);
                bytes.clear();
                let frame = bus_frame(&mut input);
                delivered(&channel, &client, &frame, input.u64());
            }
            0xF1 => {
                client.receive(&mut channel, &bytes, how);
                bytes.clear();
                channel.note_overrun();
                client.overrun = true;
            }
            byte => bytes.push(byte),
        }
    }
    client.receive(&mut channel, &bytes, how);
}

/// Sections 1 and 3: what a client has said so far.
#[derive(Default)]
struct Client {
    line: Vec<u8>,
    open: bool,
    listens: bool,
    wrong_rate: bool,
    times: bool,
    overrun: bool,
    refused: u64,
}

impl Client {
    fn receive(&mut self, channel: &mut Channel, bytes: &[u8], how: u8) {
        for chunk in cut(bytes, how) {
            let mut expected = Vec::new();
            for &byte in chunk {
                match byte {
                    b'\r' => {
                        let line = std::mem::take(&mut self.line);
                        if !line.is_empty() {
                            let (answer, frame) = if line.len() > 30 { refused() } else { self.line(&line) };
                            self.refused += u64::from(answer == [7]);
                            expected.push((answer, frame));
                        }
                    }
                    b'\n' => {}
                    _ => self.line.push(byte),
                }
            }
            let (mut rest, mut got) = (chunk, Vec::new());
            let mut before = rest.len();
            while let Some(reaction) = channel.receive(&mut rest) {
                assert!(rest.len() < before, "a line was found and nothing was taken");
                before = rest.len();
                got.push((reaction.answer.to_vec(), reaction.frame));
            }
            assert!(rest.is_empty(), "None means that all was taken");
            assert_eq!(got, expected);
            assert_eq!(channel.refused(), self.refused);
            let state = match (self.open, self.listens) {
                (false, _) => ChannelState::Closed,
                (true, false) => ChannelState::Open,
                (true, true) => ChannelState::ListenOnly,
            };
            assert_eq!(channel.state(), state);
        }
    }

    fn line(&mut self, line: &[u8]) -> (Vec<u8>, Option<CanFrame>) {
        let done = || (b"\r".to_vec(), None);
        let text = std::str::from_utf8(line).unwrap_or("?");
        let hex = |text: &str| text.chars().all(|digit| digit.is_ascii_hexdigit());
        match (text.chars().next(), text) {
            (Some('t' | 'T' | 'r' | 'R'), _) => match frame(text) {
                Some(frame) if self.open && !self.listens => {
                    let extended = matches!(frame.id(), CanId::Extended(_));
                    (if extended { b"Z\r" } else { b"z\r" }.to_vec(), Some(frame))
                }
                _ => refused(),
            },
            (_, "S0" | "S1" | "S2" | "S3" | "S4" | "S5" | "S6" | "S7" | "S8") if !self.open => {
                // 500k is S6.
                self.wrong_rate = text != "S6";
                done()
            }
            (Some('s'), _) if !self.open && [5, 7].contains(&text.len()) && hex(&text[1..]) => {
                self.wrong_rate = false;
                done()
            }
            (_, "O" | "L") if !self.wrong_rate => {
                (self.open, self.listens) = (true, text == "L");
                done()
            }
            (_, "C") => {
                self.open = false;
                done()
            }
            (_, "Z0" | "Z1") => {
                self.times = text == "Z1";
                done()
            }
            (_, "X1") => done(),
            (_, "V") => (b"V1013\r".to_vec(), None),
            (_, "v") => (b"v1013\r".to_vec(), None),
            (_, "N") => (b"NRG01\r".to_vec(), None),
            (_, "F") => {
                let dropped = std::mem::take(&mut self.overrun);
                (if dropped { b"F08\r" } else { b"F00\r" }.to_vec(), None)
            }
            _ => refused(),
        }
    }
}

fn refused() -> (Vec<u8>, Option<CanFrame>) {
    (vec![7], None)
}

/// Section 2.
fn frame(text: &str) -> Option<CanFrame> {
    let digits = if text.starts_with(['T', 'R']) { 8 } else { 3 };
    if !text.is_ascii()
        || !text[1..].chars().all(|digit| digit.is_ascii_hexdigit())
        || text.len() < digits + 2
    {
        return None;
    }
    let id = u32::from_str_radix(&text[1..=digits], 16).ok()?;
    let id = if digits == 8 { CanId::Extended(id) } else { CanId::Standard(id as u16) };
    let len = usize::from_str_radix(&text[digits + 1..digits + 2], 16).ok()?;
    let behind = &text[digits + 2..];
    if !id.is_valid() || len > 8 {
        return None;
    }
    let remote = text.starts_with(['r', 'R']);
    let data_len = if remote { 0 } else { 2 * len };
    if behind.len() != data_len && behind.len() != data_len + 4 {
        return None;
    }
    if remote {
        return CanFrame::remote(id, len);
    }
    let data: Option<Vec<u8>> =
        (0..len).map(|nth| u8::from_str_radix(&behind[2 * nth..][..2], 16).ok()).collect();
    CanFrame::new(id, &data?)
}

fn bus_frame(input: &mut Source<'_>) -> CanFrame {
    let kind = input.u8();
    let id = input.u32();
    let id =
        if kind & 1 == 0 { CanId::Standard(id as u16 & 0x7FF) } else { CanId::Extended(id & 0x1FFF_FFFF) };
    let data = input.take(usize::from(kind >> 4).min(8));
    let frame = if kind & 2 == 0 { CanFrame::new(id, data) } else { CanFrame::remote(id, data.len()) };
    frame.expect("the id fits its kind, and there are at most 8 bytes")
}

/// What the client hears of a frame on the bus.
fn delivered(channel: &Channel, client: &Client, frame: &CanFrame, millis: u64) {
    let Some(line) = channel.deliver(frame, millis) else { return assert!(!client.open) };
    assert!(client.open);
    let (kind, id) = match (frame.id(), frame.is_remote()) {
        (CanId::Standard(id), false) => ('t', format!("{id:03X}")),
        (CanId::Standard(id), true) => ('r', format!("{id:03X}")),
        (CanId::Extended(id), false) => ('T', format!("{id:08X}")),
        (CanId::Extended(id), true) => ('R', format!("{id:08X}")),
    };
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    let time = if client.times { format!("{:04X}", millis % 60_000) } else { String::new() };
    let len = embedded_can_len(frame);
    assert_eq!(String::from_utf8_lossy(&line), format!("{kind}{id}{len}{data}{time}\r"));
    assert_eq!(decode(&line[..line.len() - 1]), Ok(*frame));
    assert_eq!(decode(&encode(frame, None)[..line.len() - 1 - time.len()]), Ok(*frame));
}

fn embedded_can_len(frame: &CanFrame) -> usize {
    // A remote frame has no data, only the length that it asks for; its text shows it.
    let line = encode(frame, None);
    let digits = if matches!(frame.id(), CanId::Standard(_)) { 3 } else { 8 };
    let len = usize::from(line[digits + 1] - b'0');
    assert!(frame.is_remote() || len == frame.data().len());
    len
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let on_bus = |kind: u8, id: u32, data: &[u8]| {
        [&[0xF0, kind], &id.to_le_bytes()[..], data, &123_456_u64.to_le_bytes()].concat()
    };
    let lines: [&[u8]; 10] = [
        b"C\rS6\r\rO\rO\rt0013010203\r",
        b"\r\r\rC\r\nS6\r\nO\r\nT1FFFFFFF81122334455667788\r\nR000000010\r\n",
        b"S5\rO\rS6\rO\rS6\r",
        b"sABCD\rL\rt0010\rC\rsABCDEF\rsABC\rZ1\rZ0\rX1\rX0\r",
        b"V\rv\rN\rF\rP\rA\rM00000000\r",
        b"O\rt00131122331234\rt7FF0\rt8000\rt001\rtXYZ0\rt0019\rr0018\rr00181234\r",
        b"O\rtffff0\rT2000000000\rt001aAbBcC\rt0013aAbBcC\r",
        b"aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa\rO\r",
        b"aaaaaaaaaaaaaaaaaaaaaaaaaaaaaa\raaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa\r",
        b"OC\rO O\r \r\0\r\xFF\r\xF1F\rF\r",
    ];
    let mut seeds: Vec<Vec<u8>> =
        lines.iter().flat_map(|line| [[&[0], *line].concat(), [&[1], *line].concat()]).collect();
    seeds.push(
        [&b"\0O\rZ1\r"[..], &on_bus(0x30, 1, &[1, 2, 3]), &on_bus(0x83, 0x1FFF_FFFF, &[9; 8])].concat(),
    );
    seeds
        .push([&b"\x40L\r"[..], &on_bus(0x82, 0x7FF, &[0; 8]), b"\xF1F\r\rC\r", &on_bus(1, 5, &[])].concat());
    seeds
}
