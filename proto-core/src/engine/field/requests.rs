//! The requests of exchanges: which is next, and its bytes.
//!
//! In: the image, the exchanges of a port, its line. Out: a request, unless one of its values is unknown or stale. The
//! request of an event was already made when it happened.

use core::num::NonZero;

use super::bindings::{OutputBind, Outputs};
use super::codec::DeviceCodec;
use super::event::{Event, Outcome};
use super::exchanges::{Asks, ExchangeItem, Piece};
use super::line::{ExchangeTable, Failure, Line};
use super::outgoing::Outgoing;
use super::sender::{DIGEST_SEED, Sender, digest};
use super::turns::Cause;
use crate::config::OutputBinding;
use crate::engine::counters::{PortCounters, bump};
use crate::engine::io::ReplyCode;
use crate::image::{GroupId, Image};
use crate::modbus::adu::PREFIX_LEN;
use crate::modbus::rtu::{Expected, MAX_ADU};
use crate::time::Instant;
use crate::wire::can::CanId;

pub(crate) struct RequestBuilder<'a> {
    pub image: &'a Image,
    pub bindings: Outputs<'a>,
    pub codec: &'a DeviceCodec,
    pub sender: &'a Sender,
    pub reply: ReplyCode,
    pub now: Instant,
}

impl RequestBuilder<'_> {
    /// Checks values that trigger requests, and makes the next request. Returns its exchange and its length in `out`. A
    /// request that cannot be repeated is counted in `counters`.
    pub(crate) fn next(
        &self,
        line: &mut Line,
        (items, table, kept): (&mut [ExchangeItem], &mut ExchangeTable<'_>, &[Piece]),
        counters: &mut PortCounters,
        is_busy: bool,
        out: &mut [u8],
    ) -> Option<(u8, usize)> {
        let now = self.now;
        if line.looks.as_mut().is_some_and(|grid| grid.due(now).is_some()) {
            for (nth, item) in items.iter_mut().enumerate() {
                if self.is_wanted(item, out) {
                    line.request(table, nth, now);
                }
            }
        }
        // Each exchange without values is skipped once.
        let at = if line.transactions.is_some() { PREFIX_LEN } else { 0 };
        for _ in 0..=items.len() {
            let body = out.get_mut(at..)?;
            if is_busy || !line.may_ask() {
                return None;
            }
            let flight = line.next(table, now)?;
            let nth = usize::from(flight.exchange);
            let item = items.get_mut(nth)?;
            let made = match (flight.cause, item.event) {
                (Cause::Event, Event::Ready { len, .. } | Event::Sent { len, .. }) => {
                    copy(item, kept, usize::from(len), body);
                    Some((usize::from(len), None))
                }
                (Cause::Event, _) => continue,
                _ => {
                    let content = if item.on_change { self.content(item, body) } else { None };
                    self.make(item, body).map(|len| (len, content))
                }
            };
            let peer = table.peer_of(flight)?;
            let Some((len, content)) = made else {
                bump(&mut peer.counters.unprepared);
                if flight.is_repetition() {
                    bump(&mut counters.unanswered);
                    line.give_up(table, flight, Failure::Timeout, now);
                } else {
                    item.is_owed |= matches!(flight.cause, Cause::State(Some(_)));
                    line.turns(table, |turns| turns.not_sent(nth, flight.cause, now));
                }
                continue;
            };
            let request = body.get(..len).unwrap_or(&[]);
            if line.transactions.is_none() && !flight.may_repeat(request) {
                // A late reply to the old value must not confirm the new one. The exchange is sent again when none can
                // come any more.
                bump(&mut counters.unanswered);
                line.give_up(table, flight, Failure::Timeout, now);
                continue;
            }
            bump(&mut peer.counters.requests);
            let expected = match item.asks {
                Asks::Rtu { operation, .. } => Expected::of(&operation, request),
                _ => None,
            };
            if flight.cause == Cause::Event {
                if let Event::Ready { len, until } = item.event {
                    item.event = Event::Sent { len, until };
                }
            } else {
                // What is sent now is no longer owed, nor a change.
                item.is_owed = false;
                item.digest = content;
            }
            let status_variables = (expected, sdo_of(item, request));
            line.handed_over(table, flight, status_variables, request, now);
            let len = match &mut line.transactions {
                Some(all) => all.begin(flight.exchange, len, out)?,
                None => len,
            };
            return Some((flight.exchange, len));
        }
        None
    }

    /// Whether a value of the request has changed, or the values it was waiting for are there.
    fn is_wanted(&self, item: &mut ExchangeItem, out: &mut [u8]) -> bool {
        let mut is_wanted = item.is_owed && self.make(item, out).is_some();
        item.is_owed &= !is_wanted;
        if item.on_change
            && let Some(content) = self.content(item, out)
        {
            is_wanted |= item.digest != Some(content);
            item.digest = Some(content);
        }
        is_wanted
    }

    /// Digest of the request without its frame counter, which changes every time.
    fn content(&self, item: &ExchangeItem, out: &mut [u8]) -> Option<NonZero<u64>> {
        let len = self.make_counted(item, 0, out).ok()?;
        Some(NonZero::<u64>::MIN | digest(DIGEST_SEED, out.get(..len).unwrap_or(&[])))
    }

    fn fields(&self, item: &ExchangeItem) -> &[OutputBind] {
        item.request.as_ref().map_or(&[], |format| format.bindings.of(self.bindings.binds))
    }

    pub(crate) fn groups_of(&self, item: &ExchangeItem) -> impl Iterator<Item = GroupId> {
        self.fields(item).iter().filter_map(|field| match field.from {
            OutputBinding::Variable { var, .. } | OutputBinding::Bit { var, .. } => self.image.group(var),
            _ => None,
        })
    }

    /// Writes the request of an event to the front of `out`; the error is why it cannot be sent.
    pub(crate) fn make_event(&self, item: &ExchangeItem, out: &mut [u8]) -> Result<usize, Outcome> {
        self.make_counted(item, self.sender.frames_sent, out)
    }

    /// Like [`Self::make_event`], with this value of the frame counter.
    fn make_counted(&self, item: &ExchangeItem, frames_sent: u32, out: &mut [u8]) -> Result<usize, Outcome> {
        if !self.fields(item).iter().all(|field| may_send(self.sender, self.image, field, self.now)) {
            return Err(Outcome::NoValue);
        }
        self.encode(item, frames_sent, out).ok_or(Outcome::OutOfLimits)
    }

    /// Writes a request to the front of `out`; `None` if one of its values is unknown or stale.
    fn make(&self, item: &ExchangeItem, out: &mut [u8]) -> Option<usize> {
        self.make_event(item, out).ok()
    }

    fn encode(&self, item: &ExchangeItem, frames_sent: u32, out: &mut [u8]) -> Option<usize> {
        let (texts, reply) = (&self.codec.texts, self.reply);
        let outgoing = Outgoing { image: self.image, bindings: self.bindings, texts, frames_sent, reply };
        match (item.asks, &item.request) {
            (Asks::Rtu { slave, operation }, format) => {
                operation.encode(slave, out.first_chunk_mut::<MAX_ADU>()?, |data| {
                    format.as_ref().is_none_or(|format| outgoing.write(format, data) == Some(data.len()))
                })
            }
            (Asks::Frame, Some(format)) => outgoing.encode(format, self.codec.escape, out),
            (Asks::Remote { .. }, _) => Some(0),
            _ => None,
        }
    }
}

/// Copies the request of an event as it was made.
fn copy(item: &ExchangeItem, kept: &[Piece], len: usize, out: &mut [u8]) {
    let kept = item.pieces.of(kept).iter().flatten().take(len);
    out.iter_mut().zip(kept).for_each(|(slot, &byte)| *slot = byte);
}

/// Index and subindex of an SDO request.
fn sdo_of(item: &ExchangeItem, request: &[u8]) -> Option<[u8; 3]> {
    let (request_id, reply_id) = (item.request.as_ref()?.key.id(), item.reply.as_ref()?.format.key.id());
    let (CanId::Standard(request_id @ 0x601..=0x67F), CanId::Standard(reply_id)) = (request_id, reply_id)
    else {
        return None;
    };
    let &[_, index @ .., _, _, _, _] = request.first_chunk::<8>()?;
    (request_id.checked_sub(0x80) == Some(reply_id) && item.refusal.is_none()).then_some(index)
}

/// Whether a field's value is known, and fresh unless the recipe holds.
pub(crate) fn may_send(sender: &Sender, image: &Image, field: &OutputBind, now: Instant) -> bool {
    match field.from {
        OutputBinding::Variable { var, .. } | OutputBinding::Bit { var, .. } => {
            image.known_since(var).is_some_and(|at| sender.is_fresh(at, now))
        }
        OutputBinding::State { .. } => sender.may_show(image, now),
        _ => true,
    }
}
