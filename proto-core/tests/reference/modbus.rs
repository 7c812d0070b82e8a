//! docs/wire/modbus.md sections 2 to 6, read literally: slow, obvious, and written without a look at
//! the code that does it.
#![allow(dead_code, unreachable_pub, reason = "each user takes its own part")]

use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers};

/// 300 coils and 200 registers, all writable: what the reference and the server work on.
#[derive(Debug, Clone, PartialEq)]
pub struct Bank {
    pub coils: Vec<bool>,
    pub words: Vec<u16>,
}

impl Bank {
    pub fn new() -> Self {
        Self { coils: (0..300).map(|n| n % 7 < 3).collect(), words: (0..200).map(|n| n * 0x0123).collect() }
    }
}

/// A bank is asked for at least one item, and for none behind the last address.
fn run<T>(items: &[T], first: u16, count: usize) -> Result<&[T], Exception> {
    assert!((1..=0x1_0000 - usize::from(first)).contains(&count));
    items.get(usize::from(first)..usize::from(first) + count).ok_or(Exception::IllegalDataAddress)
}

fn run_mut<T>(items: &mut [T], first: u16, count: usize) -> Result<&mut [T], Exception> {
    assert!((1..=0x1_0000 - usize::from(first)).contains(&count));
    items.get_mut(usize::from(first)..usize::from(first) + count).ok_or(Exception::IllegalDataAddress)
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let coils = run(&self.coils, address, usize::from(count))?;
        assert!(packed.iter().all(|&byte| byte == 0));
        // Whatever a bank leaves beyond the last coil, the server sends zeros there.
        packed.fill(0xFF);
        Coils::pack(coils.iter().copied(), packed).map(|_| ()).ok_or(Exception::DeviceFailure)?;
        let unused = 8 * packed.len() - coils.len();
        *packed.last_mut().unwrap() |= !(0xFF >> unused);
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let target = run_mut(&mut self.coils, address, usize::from(coils.count()))?;
        target.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let source = run(&self.words, address, words.len())?;
        words.iter_mut().zip(source).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        let target = run_mut(&mut self.words, address, usize::from(registers.count()))?;
        target.iter_mut().zip(registers.iter()).for_each(|(word, value)| *word = value);
        Ok(())
    }
}

impl Default for Bank {
    fn default() -> Self {
        Self::new()
    }
}

/// What a server answers to a whole connection's bytes, written down rule by rule: the answers, and
/// whether the connection is closed at the end.
pub fn server(bank: &mut Bank, stream: &[u8]) -> (Vec<u8>, bool) {
    let (mut sent, mut at) = (Vec::new(), 0);
    loop {
        let rest = &stream[at..];
        if rest.len() < 6 {
            return (sent, false);
        }
        let length = usize::from(rest[4]) * 256 + usize::from(rest[5]);
        if rest[2] != 0 || rest[3] != 0 || !(2..=254).contains(&length) {
            return (sent, true);
        }
        if rest.len() < 6 + length {
            return (sent, false);
        }
        let pdu = &rest[7..6 + length];
        let answer = match answer(bank, pdu) {
            Ok(answer) => answer,
            Err(code) => vec![pdu[0] | 0x80, code],
        };
        sent.extend([rest[0], rest[1], 0, 0, 0, answer.len() as u8 + 1, rest[6]]);
        sent.extend(answer);
        at += 6 + length;
    }
}

pub fn answer(bank: &mut Bank, pdu: &[u8]) -> Result<Vec<u8>, u8> {
    let function = pdu[0];
    if ![1, 3, 5, 6, 15, 16].contains(&function) {
        return Err(1);
    }
    if pdu.len() < 5 {
        return Err(3);
    }
    let word = |at: usize| usize::from(pdu[at]) * 256 + usize::from(pdu[at + 1]);
    let (first, count) = (word(1), word(3));
    let limit = match function {
        1 => 2000,
        3 => 125,
        15 => 1968,
        16 => 123,
        _ => usize::MAX,
    };
    let data = if function == 15 { count.div_ceil(8) } else { 2 * count };
    if function == 5 && ![0, 0xFF00].contains(&count) {
        return Err(3);
    }
    if ![5, 6].contains(&function) && (count == 0 || count > limit) {
        return Err(3);
    }
    let expected_len = if function > 6 { 6 + data } else { 5 };
    if pdu.len() != expected_len || function > 6 && usize::from(pdu[5]) != data {
        return Err(3);
    }
    let touched = if [5, 6].contains(&function) { 1 } else { count };
    let space = if [1, 5, 15].contains(&function) { bank.coils.len() } else { bank.words.len() };
    if first + touched > space {
        return Err(2);
    }
    match function {
        1 => {
            let mut bytes = vec![0; count.div_ceil(8)];
            for nth in 0..count {
                if bank.coils[first + nth] {
                    bytes[nth / 8] |= 1 << (nth % 8);
                }
            }
            return Ok([vec![1, bytes.len() as u8], bytes].concat());
        }
        3 => {
            let words = bank.words[first..first + count].iter();
            let bytes: Vec<u8> = words.flat_map(|word| [(word >> 8) as u8, *word as u8]).collect();
            return Ok([vec![3, bytes.len() as u8], bytes].concat());
        }
        5 => bank.coils[first] = count != 0,
        6 => bank.words[first] = count as u16,
        15 => {
            for nth in 0..count {
                bank.coils[first + nth] = pdu[6 + nth / 8] >> (nth % 8) & 1 == 1;
            }
        }
        _ => {
            for nth in 0..count {
                bank.words[first + nth] = word(6 + 2 * nth) as u16;
            }
        }
    }
    Ok(pdu[..5].to_vec())
}

/// What a client makes of one received frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Got {
    /// The PDU answers the request.
    Response(Vec<u8>),
    Exception(u8),
    Violation,
}

/// Section 6: a connection's client side.
#[derive(Debug, Clone)]
pub struct Client {
    unit: u8,
    held: Vec<u8>,
    newest: u16,
    /// Function code, address, count or value.
    pub in_flight: Option<(u8, u16, u16)>,
    pub stale: u32,
}

impl Client {
    pub fn new(unit: u8) -> Self {
        Self { unit, held: Vec::new(), newest: 0, in_flight: None, stale: 0 }
    }

    /// A request goes out; the id of its transaction.
    pub fn start(&mut self, function: u8, address: u16, count_or_value: u16) -> u16 {
        self.newest = self.newest.wrapping_add(1);
        self.in_flight = Some((function, address, count_or_value));
        self.newest
    }

    pub fn reset(&mut self) {
        self.held.clear();
        self.in_flight = None;
    }

    pub fn receive(&mut self, chunk: &[u8]) -> Vec<Got> {
        self.held.extend(chunk);
        let mut all = Vec::new();
        while self.held.len() >= 6 {
            let length = usize::from(self.held[4]) * 256 + usize::from(self.held[5]);
            let whole = if self.held[2] != 0 || self.held[3] != 0 || !(2..=254).contains(&length) {
                None
            } else if self.held.len() < 6 + length {
                break;
            } else {
                Some(self.held.drain(..6 + length).collect::<Vec<u8>>())
            };
            let got = match whole {
                None => Some(Got::Violation),
                Some(frame) => self.frame(&frame),
            };
            if got == Some(Got::Violation) {
                self.reset();
            }
            all.extend(got);
        }
        all
    }

    fn frame(&mut self, frame: &[u8]) -> Option<Got> {
        let id = u16::from(frame[0]) * 256 + u16::from(frame[1]);
        let (function, address, asked) = match self.in_flight {
            Some(request) if id == self.newest => request,
            // The half circle behind the newest id, itself included.
            _ if (0..0x8000).any(|back| self.newest.wrapping_sub(back) == id) => {
                self.stale += 1;
                return None;
            }
            _ => return Some(Got::Violation),
        };
        if frame[6] != self.unit {
            return Some(Got::Violation);
        }
        self.in_flight = None;
        let pdu = &frame[7..];
        let data = match function {
            1 => usize::from(asked).div_ceil(8),
            _ => 2 * usize::from(asked),
        };
        let echo = [address.to_be_bytes(), asked.to_be_bytes()].concat();
        Some(match pdu {
            [code, exception] if *code == function + 0x80 => Got::Exception(*exception),
            [code, len, behind @ ..]
                if *code == function && function < 5 && usize::from(*len) == data && behind.len() == data =>
            {
                Got::Response(pdu.to_vec())
            }
            [code, behind @ ..] if *code == function && function >= 5 && *behind == echo[..] => {
                Got::Response(pdu.to_vec())
            }
            _ => Got::Violation,
        })
    }
}
