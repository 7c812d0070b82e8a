//! A port on which the gateway is a Modbus slave: the effect and the reply of each request of a master
//! (proto-core/docs/wire/modbus-rtu.md section 6 and modbus.md sections 3 to 5, docs/configuration.md section 4,
//! "Modbus RTU slave").
//!
//! Written from these pages, independent of the engine's slave.

use std::collections::BTreeMap;

use proto_core::modbus::rtu::Table;
use proto_core::time::Instant;

use crate::oracle::downward::Downward;
use crate::oracle::field::Verdict;
use crate::oracle::gateway::Leaving;
use crate::oracle::invariant::Wrong;
use crate::oracle::spec::served::{Block, ServedSpec};
use crate::oracle::{Invariant, Oracle};
use crate::rtu::{is_right, sealed};

/// The model of one such port.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct ServedWatch {
    held: Vec<u8>,
    /// More bytes arrived without a silence than a slave can hold.
    too_many: bool,
    heard: Instant,
    /// A reply that has not been sent.
    kept: Option<Vec<u8>>,
    /// The newest data that a master has written, by block.
    written: BTreeMap<usize, Vec<u8>>,
}

/// The exception code with which a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Exception(u8);

const FUNCTION: Exception = Exception(1);
const ADDRESS: Exception = Exception(2);
const VALUE: Exception = Exception(3);
const FAILURE: Exception = Exception(4);

impl ServedWatch {
    fn received(&mut self, spec: &ServedSpec, bytes: &[u8], now: Instant) {
        // Other bytes follow, so a reply that has not been sent is too late.
        self.kept = None;
        let began = now - spec.line.time_on_line(bytes.len());
        if !self.held.is_empty() && began >= self.heard + spec.line.idle_gap {
            // There was a silence before these bytes, so no master waits for the reply to earlier ones.
            self.held.clear();
            self.too_many = false;
        }
        self.heard = now;
        self.held.extend_from_slice(bytes);
        self.too_many |= self.held.len() > MOST;
        self.held.truncate(MOST);
    }

    /// Discards what was received, and the reply. Returns the number of bytes.
    pub(in crate::oracle) fn discard(&mut self) -> u64 {
        (self.kept, self.too_many) = (None, false);
        std::mem::take(&mut self.held).len() as u64
    }
}

impl Oracle {
    /// Bytes of a master or of other slaves were received.
    pub(in crate::oracle) fn served_bytes(&mut self, nth: usize, bytes: &[u8], now: Instant) {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        let Some(spec) = &port.served else { return };
        if watch.down.is_usable() {
            watch.served.received(spec, bytes, now);
        } else {
            watch.line.discarded += bytes.len() as u64;
        }
    }

    /// If the line is silent, a transmission has ended: executes its requests.
    pub(in crate::oracle) fn served_tick(&mut self, nth: usize, now: Instant) {
        let Some(spec) = &self.spec.ports[nth].served else { return };
        let watch = &mut self.ports[nth].served;
        if watch.held.is_empty() || now < watch.heard + spec.line.idle_gap {
            return;
        }
        let (own, too_many) = (spec.address, std::mem::take(&mut watch.too_many));
        let bytes = std::mem::take(&mut watch.held);
        let mut burst = Burst::read(&bytes, own, false);
        if let [0 | 0xFF, inner @ ..] = &bytes[..]
            && !too_many
            && let inner = Burst::read(inner, own, true)
            && inner.is_whole()
        {
            let is_either = burst.is_whole() && first_frame(&bytes, own, true).is_some();
            burst = if is_either { Burst { frames: Vec::new(), rest: &bytes } } else { inner };
        }
        let mut is_wrong = !burst.rest.is_empty();
        let (mut reply, mut others) = (None, 0);
        for (at, frame) in (1..).zip(&burst.frames) {
            let pdu = &frame[1..frame.len() - 2];
            match frame[0] {
                0 if matches!(pdu[0], 5 | 6 | 15 | 16 | 22) => drop(self.execute(nth, pdu, now)),
                address if address == own => {
                    // The master of an earlier request no longer waits for the reply.
                    if at == burst.frames.len() && burst.rest.is_empty() && !too_many {
                        reply = Some((pdu[0], self.execute(nth, pdu, now)));
                    }
                }
                _ => others += 1,
            }
        }
        is_wrong |= too_many && reply.is_none();
        let counters = &mut self.ports[nth].counters;
        let is_refused = matches!(reply, Some((_, Err(_))));
        match (is_wrong, is_refused) {
            (true, _) => counters.rejected_checksum += 1,
            (false, true) => counters.refused += 1,
            (false, false) => counters.rejected_other_device += u32::from(others > 0 && reply.is_none()),
        }
        self.ports[nth].served.kept = reply.map(|(function, answer)| {
            let answer = answer.unwrap_or_else(|Exception(code)| vec![function | 0x80, code]);
            sealed(&[&[own], &answer[..]].concat())
        });
    }

    /// Executes a request and returns its reply.
    fn execute(&mut self, nth: usize, pdu: &[u8], now: Instant) -> Result<Vec<u8>, Exception> {
        let function = pdu[0];
        let word = |at: usize| Some(u16::from_be_bytes([*pdu.get(at)?, *pdu.get(at + 1)?]));
        let (table, most) = match function {
            1 => (Table::Coils, 2_000),
            2 => (Table::DiscreteInputs, 2_000),
            3 => (Table::HoldingRegisters, 125),
            4 => (Table::InputRegisters, 125),
            5 | 6 => (if function == 5 { Table::Coils } else { Table::HoldingRegisters }, 1),
            15 => (Table::Coils, 1_968),
            16 => (Table::HoldingRegisters, 123),
            _ => return Err(FUNCTION),
        };
        let (first, number) = (word(1).ok_or(VALUE)?, word(3).ok_or(VALUE)?);
        let count = if matches!(function, 5 | 6) { 1 } else { number };
        let data = match function {
            15 => usize::from(count.div_ceil(8)),
            16 => 2 * usize::from(count),
            _ => 0,
        };
        let is_whole = match function {
            15 | 16 => pdu.len() == 6 + data && usize::from(pdu[5]) == data,
            5 => pdu.len() == 5 && matches!(number, 0 | 0xFF00),
            _ => pdu.len() == 5,
        };
        if !is_whole || !(1..=most).contains(&count) {
            return Err(VALUE);
        }
        if u32::from(first) + u32::from(count) > 0x1_0000 {
            return Err(ADDRESS);
        }
        match function {
            1..=4 => {
                let data = self.read_served(nth, table, (first, count), now)?;
                Ok([&[function, data.len() as u8], &data[..]].concat())
            }
            _ => {
                let data = match function {
                    5 => vec![u8::from(number != 0)],
                    6 => pdu[3..5].to_vec(),
                    _ => pdu[6..].to_vec(),
                };
                self.write_served(nth, table, (first, count), data, now)?;
                Ok(pdu[..5].to_vec())
            }
        }
    }

    fn read_served(
        &self,
        nth: usize,
        table: Table,
        (first, count): (u16, u16),
        now: Instant,
    ) -> Result<Vec<u8>, Exception> {
        let spec = self.spec.ports[nth].served.as_ref().ok_or(FAILURE)?;
        let is_coils = matches!(table, Table::Coils | Table::DiscreteInputs);
        let bytes = if is_coils { usize::from(count.div_ceil(8)) } else { 2 * usize::from(count) };
        let mut out = vec![0; bytes];
        let mut nth_read = 0;
        while nth_read < count {
            let at = first + nth_read;
            let (place, block) = spec.block_at(table, at).ok_or(ADDRESS)?;
            let data = self.data_of(nth, place, block, now)?;
            for inside in at - block.first..block.count {
                if nth_read == count {
                    break;
                }
                let (from, to) = (usize::from(inside), usize::from(nth_read));
                if is_coils {
                    out[to / 8] |= (data[from / 8] >> (from % 8) & 1) << (to % 8);
                } else {
                    out[2 * to..2 * to + 2].copy_from_slice(&data[2 * from..2 * from + 2]);
                }
                nth_read += 1;
            }
        }
        Ok(out)
    }

    /// The current data of a block.
    fn data_of(&self, nth: usize, place: usize, block: &Block, now: Instant) -> Result<Vec<u8>, Exception> {
        let (port, watch) = (&self.spec.ports[nth], &self.ports[nth]);
        let Some(output) = &block.output else {
            return watch.served.written.get(&place).cloned().ok_or(FAILURE);
        };
        let vars = output.shown.iter().copied();
        Downward::may_show_all(port, &self.up, vars, now).map_err(|_| FAILURE)?;
        watch.down.made(output, &self.up).ok_or(FAILURE)
    }

    fn write_served(
        &mut self,
        nth: usize,
        table: Table,
        (first, count): (u16, u16),
        mut data: Vec<u8>,
        now: Instant,
    ) -> Result<(), Exception> {
        let port = &self.spec.ports[nth];
        let spec = port.served.as_ref().ok_or(FAILURE)?;
        let is_it = |block: &Block| (block.table, block.first, block.count) == (table, first, count);
        let found = spec.blocks.iter().enumerate().find(|(_, block)| is_it(block) && block.input.is_some());
        let (place, frame) = found.and_then(|(at, block)| Some((at, block.input?))).ok_or(ADDRESS)?;
        if let (Table::Coils, Some(last), left @ 1..) = (table, data.last_mut(), count % 8) {
            // Bits after the last coil have no meaning.
            *last &= (1 << left) - 1;
        }
        let verdict = self.ports[nth].line.judge_block(&port.inputs[frame], frame, &data);
        let is_taken = matches!(verdict, Verdict::Accepted(_));
        if is_taken {
            self.ports[nth].served.written.insert(place, data);
        }
        self.take(nth, [verdict], now);
        if is_taken { Ok(()) } else { Err(VALUE) }
    }

    /// The gateway sends on such a port.
    pub(in crate::oracle) fn served_send(
        &mut self,
        nth: usize,
        sent: &Leaving<'_>,
        now: Instant,
    ) -> Result<(), Wrong> {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        if !watch.down.is_usable() || watch.down.is_busy() {
            return Err((Invariant::Line, "a reply while the line is gone or busy".to_owned()));
        }
        if now < watch.down.heard + port.turnaround {
            return Err((Invariant::Line, "a reply before the line was silent for long enough".to_owned()));
        }
        let Some(kept) = watch.served.kept.take() else {
            return Err((Invariant::Cycle, format!("{:02x?} answers no request", sent.bytes)));
        };
        if kept != sent.bytes {
            let what = format!("the reply is {:02x?}, not {kept:02x?}", sent.bytes);
            return Err((Invariant::Shown, what));
        }
        watch.down.asked(sent.bytes.len());
        Ok(())
    }

    /// Checks that no reply waits although it could be sent.
    pub(in crate::oracle) fn served_rests(&self, nth: usize, now: Instant) -> Result<(), Wrong> {
        let (port, watch) = (&self.spec.ports[nth], &self.ports[nth]);
        if watch.served.kept.is_none() {
            return Ok(());
        }
        let may_send = watch.down.is_usable()
            && !watch.down.is_busy()
            && self.discards_until.is_none()
            && now >= watch.down.heard + port.turnaround;
        if may_send {
            return Err((Invariant::Cycle, "a reply waits although the line is free".to_owned()));
        }
        Ok(())
    }
}

/// A transmission between two silences: frames with a valid CRC, and the bytes after the last of them.
#[derive(Debug)]
struct Burst<'a> {
    frames: Vec<&'a [u8]>,
    rest: &'a [u8],
}

impl<'a> Burst<'a> {
    /// `is_bare`: the byte before these was dropped.
    fn read(bytes: &'a [u8], own: u8, is_bare: bool) -> Self {
        let (mut frames, mut rest) = (Vec::new(), bytes);
        while let Some((len, is_request)) = first_frame(rest, own, is_bare) {
            let (frame, behind) = rest.split_at(len);
            frames.push(frame);
            let may_drop = is_request || !matches!(frame[0], 0) && frame[0] != own;
            rest = if may_drop && matches!(behind, [0 | 0xFF]) { &[] } else { behind };
        }
        Self { frames, rest }
    }

    fn is_whole(&self) -> bool {
        !self.frames.is_empty() && self.rest.is_empty()
    }
}

/// The length of the valid frame at the front of `bytes`, and whether a request has this length. Possible lengths are
/// those of a request and a reply with this function code, and that of all bytes.
fn first_frame(bytes: &[u8], own: u8, is_bare: bool) -> Option<(usize, bool)> {
    let counted = |at: usize, more: usize| bytes.get(at).map(|&count| usize::from(count) + more);
    let (request, reply) = match bytes.get(1)? {
        1..=4 => (Some(8), counted(2, 5)),
        5 | 6 => (Some(8), Some(8)),
        15 | 16 => (counted(6, 9), Some(8)),
        22 => (Some(10), Some(10)),
        23 => (counted(10, 13), counted(2, 5)),
        0x80.. => (None, Some(5)),
        _ => (None, None),
    };
    let all = Some(bytes.len()).filter(|_| !is_bare);
    let lengths = if matches!(bytes[0], 0) || bytes[0] == own {
        [request, all, reply.filter(|_| !is_bare)]
    } else {
        let mut known = [request, reply];
        known.sort();
        [all, known[0], known[1]]
    };
    let is_one = |len: usize| (4..=256).contains(&len) && bytes.get(..len).is_some_and(is_right);
    let len = lengths.into_iter().flatten().find(|&len| is_one(len))?;
    Some((len, Some(len) == request))
}

/// Bytes that a slave can hold: two frames of the maximum length.
const MOST: usize = 512;
