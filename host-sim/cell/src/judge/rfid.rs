//! The RFID head of `judged-rfid.toml`. A request is `$`, a letter, four hexadecimal digits, a CRC of four more digits,
//! and a carriage return. The reply has `!` in place of `$`; a refusal has `?` and two digits.

use proto_core::time::{Duration, Instant};

use super::device::{Answer, Machine};
use super::rules::{Rules, word};
use crate::device::Order;
use crate::rtu::sealed;
use crate::{Device, Rng, SlaveDone};

pub(super) fn rules() -> Rules {
    let mut rules =
        Rules::new(vec![word("WordOutputReg[1]")], &["WordInputReg[1]", "WordInputReg[2]"], TIMEOUT)
            .limit("WordOutputReg[1]", 60_000);
    rules.step = Some((vec![word("WordOutputReg[2]")], Duration::from_secs(1)));
    rules.keeps = None;
    rules
}

/// The head.
#[derive(Debug)]
pub(super) struct Head {
    machine: Machine,
    held: Vec<u8>,
}

impl Head {
    pub(super) fn new(rng: Rng, start: Instant) -> Self {
        Self { machine: Machine::new(rng, start, TIMEOUT, false), held: Vec::new() }
    }

    fn handle(&mut self, letter: u8, number: u16, now: Instant) {
        let order = match letter {
            b'S' => Some(Order::Move),
            b'W' => Some(Order::Step),
            b'H' => Some(Order::Stop),
            _ => None,
        };
        let answer = match order {
            Some(order) => match self.machine.order(order, vec![u32::from(number)], false) {
                // A stop cannot be refused.
                Answer::Refused(_) if order == Order::Stop => return,
                Answer::Good => text(b'!', letter, &format!("{number:04X}")),
                Answer::Refused(code) => text(b'?', letter, &format!("{code:02X}")),
            },
            None if letter == b'R' && matches!(number, 1 | 2) => {
                let value = self.machine.value(usize::from(number) - 1);
                text(b'!', letter, &format!("{value:04X}"))
            }
            None => return,
        };
        self.machine.reply(answer, true, now);
    }
}

impl Device<Vec<u8>> for Head {
    fn receive(&mut self, now: Instant, bytes: &Vec<u8>) -> Vec<Vec<u8>> {
        for &byte in bytes {
            if byte == b'$' {
                self.held.clear();
            }
            self.held.push(byte);
            if byte != b'\r' {
                continue;
            }
            let held = std::mem::take(&mut self.held);
            if let Some((letter, number)) = read(&held)
                && self.machine.is_on()
            {
                self.handle(letter, number, now);
            }
        }
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        self.machine.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        self.machine.poll(now).0
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        self.machine.take_done()
    }
}

/// Makes a frame: ends it with the CRC in digits, its low byte first, and a carriage return.
fn text(first: u8, letter: u8, digits: &str) -> Vec<u8> {
    let mut bytes = vec![first, letter];
    bytes.extend_from_slice(digits.as_bytes());
    let whole = sealed(&bytes);
    let sum: String = whole[bytes.len()..].iter().map(|byte| format!("{byte:02X}")).collect();
    bytes.extend_from_slice(sum.as_bytes());
    bytes.push(b'\r');
    bytes
}

/// Parses the letter and the number of a request.
fn read(frame: &[u8]) -> Option<(u8, u16)> {
    let &[b'$', letter, a, b, c, d, _, _, _, _, b'\r'] = frame else { return None };
    let digits = String::from_utf8(vec![a, b, c, d]).ok()?;
    let number = u16::from_str_radix(&digits, 16).ok()?;
    (text(b'$', letter, &digits) == frame).then_some((letter, number))
}

const TIMEOUT: Duration = Duration::from_millis(80);
