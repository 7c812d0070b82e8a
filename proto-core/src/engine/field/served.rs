//! Field ports on which the gateway is a slave: a master reads and writes blocks of registers.
//!
//! In: requests that the slave of the line has received. Out: values in the store, and replies. A block is written as a
//! whole or not at all; a block with an unknown or stale value cannot be read. A block that a master writes is read
//! back as it was written. Does not know how requests are found.

use super::bindings::{InputBind, Outputs};
use super::codec::{Codec, DeviceCodec, Reader};
use super::exchanges::{Asks, ExchangeItem, InputFormat, Piece, View};
use super::frames::{Accepted, FrameContext};
use super::outgoing::Outgoing;
use super::port::{FieldPort, came, keep};
use super::requests::may_send;
use super::sender::Sender;
use super::texts::TextBind;
use crate::engine::counters::bump;
use crate::engine::link::command::CommandLink;
use crate::engine::rejection::Rejection;
use crate::engine::tap::Tap;
use crate::engine::values::store::Store;
use crate::modbus::rtu::{MAX_ADU, Table};
use crate::modbus::server::RegisterBank;
use crate::modbus::{Coils, Exception, Registers};
use crate::time::Instant;

/// Data of the longest block.
const MAX_DATA: usize = 256;

struct Blocks<'a> {
    items: &'a mut [ExchangeItem],
    written: &'a mut [Piece],
    texts: &'a [TextBind],
    outputs: Outputs<'a>,
    sender: &'a Sender,
    frames: FrameContext<'a>,
    accepted: &'a mut Accepted,
    now: Instant,
}

impl Blocks<'_> {
    /// The block of a table that contains this address, and the block's first address.
    fn block_at(&self, table: Table, at: u16) -> Result<(u16, &ExchangeItem), Exception> {
        let mut found = self.items.iter().filter_map(|item| match item.asks {
            Asks::Served { table: own, address, count } if own == table => {
                at.checked_sub(address).is_some_and(|nth| nth < count).then_some((address, item))
            }
            _ => None,
        });
        found.next().ok_or(Exception::IllegalDataAddress)
    }

    fn data<'o>(&self, item: &ExchangeItem, out: &'o mut [u8; MAX_DATA]) -> Result<&'o [u8], Exception> {
        let Some(format) = &item.request else { return self.kept(item, out) };
        let fields = format.bindings.of(self.outputs.binds);
        let image = &self.frames.store.image;
        if !fields.iter().all(|field| may_send(self.sender, image, field, self.now)) {
            return Err(Exception::DeviceFailure);
        }
        let (frames_sent, reply) = (self.sender.frames_sent, *self.frames.reply);
        let outgoing = Outgoing { image, bindings: self.outputs, texts: self.texts, frames_sent, reply };
        let len = outgoing.write(format, out).ok_or(Exception::DeviceFailure)?;
        out.get(..len).ok_or(Exception::DeviceFailure)
    }

    /// The block as a master has written it.
    fn kept<'o>(&self, item: &ExchangeItem, out: &'o mut [u8; MAX_DATA]) -> Result<&'o [u8], Exception> {
        let block = item.reply.as_ref().filter(|_| item.is_written).ok_or(Exception::DeviceFailure)?;
        let kept = item.pieces.of(self.written).iter().flatten();
        out.iter_mut().zip(kept).for_each(|(slot, &byte)| *slot = byte);
        out.get(..block.format.layout.lengths().1).ok_or(Exception::DeviceFailure)
    }

    fn registers(&self, table: Table, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let mut at = address;
        let mut words = words.iter_mut();
        let mut left = words.len();
        while left > 0 {
            let (first, item) = self.block_at(table, at)?;
            let mut buffer = [0; MAX_DATA];
            let data = self.data(item, &mut buffer)?;
            let behind = usize::from(at.saturating_sub(first)).saturating_mul(2);
            let (pairs, _) = data.get(behind..).unwrap_or(&[]).as_chunks::<2>();
            // Pairs before words, so that `zip` drops no word when the block ends.
            for (pair, word) in pairs.iter().zip(&mut words) {
                *word = *pair;
                at = at.wrapping_add(1);
                left = left.saturating_sub(1);
            }
            if pairs.is_empty() {
                return Err(Exception::DeviceFailure);
            }
        }
        Ok(())
    }

    fn coils(&self, table: Table, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let mut nth = 0;
        while nth < count {
            let at = address.wrapping_add(nth);
            let (block, item) = self.block_at(table, at)?;
            let mut buffer = [0; MAX_DATA];
            let data = self.data(item, &mut buffer)?;
            let Asks::Served { count: len, .. } = item.asks else { return Err(Exception::DeviceFailure) };
            // To the end of the block, and at least one.
            for bit in at.saturating_sub(block)..len {
                let is_on = data.get(usize::from(bit / 8)).is_some_and(|byte| byte >> (bit % 8) & 1 == 1);
                if let Some(byte) = packed.get_mut(usize::from(nth / 8)) {
                    *byte |= u8::from(is_on) << (nth % 8);
                }
                nth = nth.saturating_add(1);
                if nth >= count {
                    break;
                }
            }
        }
        Ok(())
    }

    /// Writes the block with exactly this address and number of registers or coils.
    fn write(&mut self, table: Table, address: u16, count: u16, data: &[u8]) -> Result<(), Exception> {
        let is_it = |asks: Asks| matches!(asks, Asks::Served { table: own, address: at, count: len } if (own, at, len) == (table, address, count));
        let item = self.items.iter_mut().find(|item| item.reply.is_some() && is_it(item.asks));
        let Some(ExchangeItem { reply: Some(InputFormat { format, slot }), pieces, is_written, .. }) = item
        else {
            return Err(Exception::IllegalDataAddress);
        };
        self.frames
            .take_block(format, self.texts, data, usize::from(*slot), self.accepted)
            .map_err(|_| Exception::IllegalDataValue)?;
        let kept = self.written.iter_mut().skip(usize::from(pieces.start)).take(usize::from(pieces.len));
        kept.flatten().zip(data).for_each(|(slot, &byte)| *slot = byte);
        *is_written = true;
        Ok(())
    }
}

impl RegisterBank for Blocks<'_> {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        self.coils(Table::Coils, address, count, packed)
    }

    fn read_discrete(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        self.coils(Table::DiscreteInputs, address, count, packed)
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        self.registers(Table::HoldingRegisters, address, words)
    }

    fn read_input(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        self.registers(Table::InputRegisters, address, words)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let mut data = [0; MAX_DATA];
        let mut len = 0_usize;
        for first in (0..coils.count()).step_by(8) {
            if let (Some(slot), Some(byte)) = (data.get_mut(len), coils.byte(first)) {
                *slot = byte;
                len = len.saturating_add(1);
            }
        }
        self.write(Table::Coils, address, coils.count(), data.get(..len).unwrap_or(&[]))
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        self.write(Table::HoldingRegisters, address, registers.count(), registers.as_be_bytes())
    }
}

impl FieldPort {
    /// Whether a complete request is to be served.
    pub(crate) fn is_asked(&self, now: Instant) -> bool {
        self.slave_deadline() <= now
    }

    /// When a master's request ends; [`Instant::NEVER`] if none has begun, and on other ports.
    pub(crate) fn slave_deadline(&self) -> Instant {
        match &self.codec {
            Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. }) => slave.deadline(),
            _ => Instant::NEVER,
        }
    }

    /// Executes a master's request; the reply is kept until the line is free.
    pub(crate) fn serve(
        &mut self,
        (inputs, outputs): (&[InputBind], Outputs<'_>),
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
        mut view: View<'_>,
    ) -> Accepted {
        let mut accepted = Accepted::default();
        let now = store.now;
        let Codec::Device(DeviceCodec {
            texts, reader: Some(Reader::Slave(slave)), line: Some(line), ..
        }) = &mut self.codec
        else {
            return accepted;
        };
        let (items, table, written) = view.served(line);
        let frames = FrameContext::new(
            (self.id, self.mode),
            &mut self.reply,
            &mut self.counters,
            inputs,
            store,
            commands,
        );
        let sender = &self.sender;
        let mut blocks =
            Blocks { items, written, texts, outputs, sender, frames, accepted: &mut accepted, now };
        let (before, mut request, mut reply) = (slave.counters(), [0; MAX_ADU], [0; MAX_ADU]);
        let heard = slave.copy_to(&mut request);
        let len = slave.poll(now, &mut blocks, &mut reply);
        let after = slave.counters();
        if let Some(len) = len {
            slave.keep(reply.get(..len).unwrap_or(&[]));
        }
        if let Some(peer) = table.peers.first_mut() {
            peer.counters.requests = after.answered;
            peer.counters.replies = after.answered.wrapping_sub(after.refused);
            peer.counters.refused = after.refused;
            peer.counters.checksums = after.wrong;
            if after.refused != before.refused {
                peer.counters.refusal = reply.get(2).copied().unwrap_or(0);
            }
        }
        let verdict = if after.wrong != before.wrong {
            bump(&mut self.counters.rejected_checksum);
            Err(Rejection::Checksum)
        } else if after.refused != before.refused {
            bump(&mut self.counters.refused);
            Err(Rejection::Refused)
        } else if after.others != before.others && len.is_none() {
            bump(&mut self.counters.rejected_other_device);
            Err(Rejection::OtherDevice)
        } else {
            Ok(())
        };
        let request = request.get(..heard).unwrap_or(&[]);
        tap.record(|| came(self.id, now, verdict, None, [request, &[], &[]]));
        if let Err(why) = verdict
            && why != Rejection::OtherDevice
        {
            keep(&mut self.last_rejection, why, None, request, now);
        }
        if let (Some(field), Some(last)) = (store.rejected_field.pop(), &mut self.last_rejection) {
            last.field = Some(field);
        }
        accepted
    }

    /// The reply that waits for the line.
    pub(crate) fn next_reply(&mut self, out: &mut [u8], now: Instant) -> Option<usize> {
        let may_send = self.is_usable() && !self.sender.is_busy() && now >= self.line.quiet_at();
        let Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. }) = &mut self.codec else {
            return None;
        };
        let len = if may_send { slave.take_kept(out)? } else { return None };
        self.sender.handed_over_beside();
        self.counters.sent(len);
        Some(len)
    }

    /// When a waiting reply may be sent.
    pub(crate) fn reply_deadline(&self) -> Instant {
        match &self.codec {
            Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. })
                if slave.has_kept() && !self.sender.is_busy() =>
            {
                self.line.quiet_at()
            }
            _ => Instant::NEVER,
        }
    }
}
