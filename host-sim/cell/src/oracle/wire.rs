//! Traffic between the gateway and the controller: an independent parser of Modbus (proto-core/docs/wire/modbus.md),
//! and checks that the data that arrives is the data that was sent.

use std::collections::{BTreeMap, VecDeque};

use proto_core::sysvar::{COUNT, Direction, ModbusPlace, SysVar};
use proto_core::time::{Duration, Instant};

use super::Invariant;
use super::field::Coils;
use super::frame::Raw;
use super::invariant::Wrong;
use super::spec::Spec;

/// A request without a reply is given up after this time.
const ANSWER: Duration = Duration::from_millis(500);

/// The content of a request.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Asked {
    Read { coils: bool, first: u16, count: u16 },
    Write(Vec<(SysVar, Raw)>),
    WriteBits(Coils),
}

/// Coils or registers that are read.
#[derive(Debug, Clone, Copy)]
struct Reads {
    coils: bool,
    first: u16,
    count: u16,
}

/// The safe values in a write.
#[derive(Debug, Clone, Default)]
pub(super) struct Safe {
    pub vars: Vec<SysVar>,
    /// Bits as pairs: the share, and the bit in it.
    pub bits: Vec<(usize, u8)>,
}

impl Safe {
    pub(super) fn is_empty(&self) -> bool {
        self.vars.is_empty() && self.bits.is_empty()
    }

    pub(super) fn extend(&mut self, other: Self) {
        self.vars.extend(other.vars);
        self.bits.extend(other.bits);
    }
}

/// The one transaction in flight.
#[derive(Debug, Clone, Default)]
pub(super) struct Modbus {
    /// The transaction id, what is read, and when the request was sent.
    in_flight: Option<([u8; 2], Option<Reads>, Instant)>,
    /// The safe values in the write in flight.
    safe: Safe,
    held: Vec<u8>,
}

impl Modbus {
    pub(super) fn is_free(&self) -> bool {
        self.in_flight.is_none()
    }

    /// Gives up a request that was not answered in time; returns the safe values in it.
    pub(super) fn tick(&mut self, now: Instant) -> Safe {
        if self.in_flight.as_ref().is_none_or(|asked| now < asked.2 + ANSWER) {
            return Safe::default();
        }
        self.in_flight = None;
        std::mem::take(&mut self.safe)
    }

    /// The connection is lost; returns the safe values in flight.
    pub(super) fn lost(&mut self) -> Safe {
        std::mem::take(self).safe
    }

    /// The write that was just sent has these safe values.
    pub(super) fn carries_safe(&mut self, safe: Safe) {
        self.safe = safe;
    }

    /// Checks a request that the gateway sends, and returns its content.
    pub(super) fn sent(&mut self, map: &Map, bytes: &[u8], now: Instant) -> Result<Asked, Wrong> {
        let wrong = |what: &str| (Invariant::Ownership, format!("a Modbus request that {what}"));
        if self.in_flight.is_some() {
            return Err((Invariant::Line, "a Modbus request before the previous one was over".to_owned()));
        }
        let (head, pdu) = bytes.split_at_checked(7).ok_or_else(|| wrong("has no header"))?;
        let asked = map.request(pdu).ok_or_else(|| wrong("touches addresses that are not a variable"))?;
        self.safe = Safe::default();
        let read = match asked {
            Asked::Read { coils, first, count } => Some(Reads { coils, first, count }),
            Asked::Write(_) | Asked::WriteBits(_) => None,
        };
        self.in_flight = Some(([head[0], head[1]], read, now));
        Ok(asked)
    }

    /// Handles bytes from the controller; `read` gets the values that were read. Returns the safe values that were
    /// refused.
    pub(super) fn received(&mut self, map: &Map, bytes: &[u8], mut read: impl FnMut(SysVar, Raw)) -> Safe {
        self.held.extend_from_slice(bytes);
        let (mut at, mut refused) = (0, Safe::default());
        while let Some(len) = frame_len(&self.held[at..]) {
            let frame = &self.held[at..at + len];
            at += len;
            let Some((id, asked, _)) = &self.in_flight else { continue };
            if frame[..2] != *id {
                continue;
            }
            if let (Some(reads), Some(data)) = (*asked, frame.get(9..))
                && frame[7] & 0x80 == 0
            {
                map.read(reads, data, &mut read);
            }
            let safe = std::mem::take(&mut self.safe);
            if frame[7] & 0x80 != 0 {
                refused.extend(safe);
            }
            self.in_flight = None;
        }
        self.held.drain(..at);
        refused
    }
}

/// The length of the first complete frame.
fn frame_len(bytes: &[u8]) -> Option<usize> {
    let len = 6 + usize::from(u16::from_be_bytes([*bytes.get(4)?, *bytes.get(5)?]));
    (bytes.len() >= len).then_some(len)
}

/// The variables in the controller's Modbus map.
#[derive(Debug, Clone)]
pub(super) struct Map {
    coils: Vec<Option<SysVar>>,
    inputs: [Option<SysVar>; 512],
    words: Vec<Option<SysVar>>,
    /// Bytes whose bits have separate owners.
    shared: Vec<SysVar>,
}

impl Map {
    pub(super) fn new(spec: &Spec) -> Self {
        let shared = spec.shares.iter().map(|share| share.var).collect();
        let mut map = Self { coils: vec![None; 512], inputs: [None; 512], words: vec![None; 512], shared };
        for var in SysVar::all() {
            match var.modbus() {
                Some(ModbusPlace::Coils { first, .. }) => {
                    let slot = if var.direction() == Direction::Input {
                        &mut map.inputs[..]
                    } else {
                        &mut map.coils[..]
                    };
                    slot[usize::from(first)] = Some(var);
                }
                Some(ModbusPlace::Register { address }) => map.words[usize::from(address)] = Some(var),
                _ => {}
            }
        }
        map
    }

    /// Parses a request. `None` if it is not one of the four that a gateway sends, or does not write whole variables or
    /// bits with owners.
    pub(super) fn request(&self, pdu: &[u8]) -> Option<Asked> {
        let word = |at: usize| Some(u16::from_be_bytes([*pdu.get(at)?, *pdu.get(at + 1)?]));
        let (first, count) = (word(1)?, word(3)?);
        match pdu.first()? {
            1 | 3 if pdu.len() == 5 => Some(Asked::Read { coils: pdu[0] == 1, first, count }),
            15 => {
                let packed = pdu.get(6..)?;
                if let Some(coils) = self.bits(first, count, packed) {
                    return Some(Asked::WriteBits(coils));
                }
                let mut written = Vec::new();
                let mut at = 0_u16;
                while at < count {
                    let var = (*self.inputs.get(usize::from(first + at))?)?;
                    let Some(ModbusPlace::Coils { count: bits, .. }) = var.modbus() else { return None };
                    let mut raw = Raw::default();
                    for bit in 0..bits {
                        let nth = usize::from(at + bit);
                        raw[0] |= (packed.get(nth / 8)? >> (nth % 8) & 1) << bit;
                    }
                    written.push((var, raw));
                    at += bits;
                }
                (at == count).then_some(Asked::Write(written))
            }
            16 => {
                let values = pdu.get(6..)?;
                let mut written = Vec::new();
                for nth in 0..usize::from(count) {
                    let var = (*self.words.get(usize::from(first) + nth)?)?;
                    if var.direction() != Direction::Input {
                        return None;
                    }
                    let (high, low) = (*values.get(2 * nth)?, *values.get(2 * nth + 1)?);
                    written.push((var, [low, high, 0, 0]));
                }
                Some(Asked::Write(written))
            }
            _ => None,
        }
    }

    /// The bits of a byte whose bits have separate owners.
    fn bits(&self, first: u16, count: u16, packed: &[u8]) -> Option<Coils> {
        self.shared.iter().find_map(|&var| {
            let Some(ModbusPlace::Coils { first: start, count: all }) = var.modbus() else { return None };
            let from = first.checked_sub(start).filter(|from| from + count <= all && count > 0)?;
            let mask = u8::MAX >> (8 - count) << from;
            Some(Coils { var, mask, on: packed.first()? << from & mask })
        })
    }

    /// Calls `found` with each variable that is completely in the range that was read.
    fn read(&self, reads: Reads, data: &[u8], mut found: impl FnMut(SysVar, Raw)) {
        let Reads { coils, first, count } = reads;
        for address in first..first.saturating_add(count) {
            let nth = usize::from(address - first);
            if !coils {
                if let (Some(Some(var)), Some(pair)) =
                    (self.words.get(usize::from(address)), data.get(2 * nth..2 * nth + 2))
                {
                    found(*var, [pair[1], pair[0], 0, 0]);
                }
                continue;
            }
            let place = usize::from(address);
            let both = [self.coils.get(place), self.inputs.get(place)];
            for var in both.into_iter().flatten().filter_map(|var| *var) {
                let Some(ModbusPlace::Coils { count: bits, .. }) = var.modbus() else { continue };
                if address - first + bits > count {
                    continue;
                }
                let bit =
                    |bit: usize| data.get((nth + bit) / 8).map_or(0, |byte| byte >> ((nth + bit) % 8) & 1);
                let packed = (0..usize::from(bits)).fold(0, |sum, at| sum | bit(at) << at);
                found(var, [packed, 0, 0, 0]);
            }
        }
    }
}

/// Sent data that has not arrived yet, and partial frames at the controller.
#[derive(Debug, Clone)]
pub(super) struct Controller {
    sent: BTreeMap<u64, VecDeque<u8>>,
    /// The newest datagrams of each link.
    datagrams: BTreeMap<u64, VecDeque<Vec<u8>>>,
    held: BTreeMap<u64, Vec<u8>>,
}

/// Maximum number of datagrams that may still arrive.
const DATAGRAMS: usize = 4_096;

impl Controller {
    pub(super) fn new() -> Self {
        Self { sent: BTreeMap::new(), datagrams: BTreeMap::new(), held: BTreeMap::new() }
    }

    pub(super) fn sent(&mut self, conn: u64, bytes: &[u8]) {
        self.sent.entry(conn).or_default().extend(bytes);
    }

    pub(super) fn sent_datagram(&mut self, link: u64, bytes: &[u8]) {
        let kept = self.datagrams.entry(link).or_default();
        if kept.len() >= DATAGRAMS {
            kept.pop_front();
        }
        kept.push_back(bytes.to_vec());
    }

    pub(super) fn gone(&mut self, conn: u64) {
        self.sent.remove(&conn);
        self.held.remove(&conn);
    }

    pub(super) fn arrived(&mut self, conn: u64, bytes: &[u8]) -> Result<(), Wrong> {
        let sent = self.sent.entry(conn).or_default();
        let (front, back) = sent.as_slices();
        let (begin, rest) = bytes.split_at(bytes.len().min(front.len()));
        if !front.starts_with(begin) || !back.starts_with(rest) {
            return Err((
                Invariant::Transport,
                "the controller received bytes that were not sent".to_owned(),
            ));
        }
        sent.drain(..bytes.len());
        Ok(())
    }

    pub(super) fn arrived_datagram(&self, link: u64, bytes: &[u8]) -> Result<(), Wrong> {
        let kept = self.datagrams.get(&link);
        if kept.is_some_and(|kept| kept.iter().rev().any(|sent| sent == bytes)) {
            return Ok(());
        }
        Err((Invariant::Transport, "the controller received a datagram that was not sent".to_owned()))
    }

    /// Finds the complete Modbus requests in the data that has arrived.
    pub(super) fn requests(&mut self, conn: u64, bytes: &[u8], mut each: impl FnMut(&[u8])) {
        let held = self.held.entry(conn).or_default();
        held.extend_from_slice(bytes);
        let mut at = 0;
        while let Some(len) = frame_len(&held[at..]) {
            each(&held[at + 7..at + len]);
            at += len;
        }
        held.drain(..at);
    }

    /// The received bytes of a recipe connection, in which the caller finds the frames.
    pub(super) fn held(&mut self, conn: u64) -> &mut Vec<u8> {
        self.held.entry(conn).or_default()
    }

    /// Number of bytes remembered.
    pub(super) fn size(&self) -> usize {
        self.sent.values().map(VecDeque::len).sum::<usize>() + self.held.values().map(Vec::len).sum::<usize>()
    }
}

/// The input variables in the controller's image.
pub(crate) fn inputs_of(image: &[u8]) -> &[u8] {
    &image[..INPUT_BYTES]
}

/// A copy of the input variables in the controller's image.
pub(crate) fn copied_inputs(image: &[u8]) -> Inputs {
    let mut inputs = [0; INPUT_BYTES];
    inputs.copy_from_slice(inputs_of(image));
    inputs
}

/// The controller's input variables.
pub(crate) type Inputs = [u8; INPUT_BYTES];
/// Inputs come first in the image (proto-core/docs/wire/sysvars.md section 1).
const INPUT_BYTES: usize = 253;

const _: () = assert!(COUNT < 512);
