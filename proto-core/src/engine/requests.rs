//! The requests of exchanges: which is next, and its bytes.
//!
//! In: the image, the exchanges of a port, its line. Out: a request, unless a value of it is unknown or
//! stale.

use super::counters::{PortCounters, bump};
use super::device_port::DeviceCodec;
use super::exchanges::{Asks, Item};
use super::io::ReplyCode;
use super::line::{Line, Talks};
use super::sender::{DIGEST_SEED, Sender, digest};
use super::user::{OutputBind, Outputs};
use super::whole_port::Outgoing;
use crate::config::OutputBinding;
use crate::image::Image;
use crate::modbus::rtu::{Expected, MAX_ADU};
use crate::time::Instant;

/// Makes the frames of requests.
pub(super) struct Maker<'a> {
    pub image: &'a Image,
    pub bindings: Outputs<'a>,
    pub codec: &'a DeviceCodec,
    pub sender: &'a Sender,
    pub reply: ReplyCode,
    pub now: Instant,
}

impl Maker<'_> {
    /// Looks at values and bits that ask, and makes the next request. Returns its exchange and its
    /// length in `out`. A request that cannot be repeated is counted in `counters`.
    pub(super) fn next(
        &self,
        line: &mut Line,
        items: &mut [Item],
        talks: &mut Talks<'_>,
        counters: &mut PortCounters,
        is_busy: bool,
        out: &mut [u8],
    ) -> Option<(u8, usize)> {
        let now = self.now;
        if line.looks.as_mut().is_some_and(|grid| grid.due(now).is_some()) {
            for (nth, item) in items.iter_mut().enumerate() {
                if self.is_wanted(item, out) {
                    line.request(talks, nth, now);
                }
            }
        }
        // Each exchange that has no values yet is passed over once.
        for _ in 0..=items.len() {
            if is_busy || !line.may_ask() {
                return None;
            }
            let flight = line.next(talks, now)?;
            let item = items.get(usize::from(flight.exchange))?;
            let peer = talks.peer_of(flight)?;
            let Some(len) = self.make(item, out) else {
                bump(&mut peer.counters.unprepared);
                if flight.is_repetition() {
                    // A late reply to what was sent must not be taken for one to another request.
                    bump(&mut counters.unanswered);
                    line.give_up(talks, flight, item.times, now);
                } else if let Some(item) = items.get_mut(usize::from(flight.exchange)) {
                    item.is_owed |= flight.was_requested();
                }
                continue;
            };
            bump(&mut peer.counters.requests);
            let request = out.get(..len).unwrap_or(&[]);
            let expected = match item.asks {
                Asks::Rtu { operation, .. } => Expected::of(&operation, request),
                _ => None,
            };
            if let Some(item) = items.get_mut(usize::from(flight.exchange)) {
                // What goes out now is neither owed any more, nor a change.
                item.is_owed = false;
                item.digest = item.on_change.then(|| digest(DIGEST_SEED, request));
            }
            line.handed_over(flight, expected, request);
            return Some((flight.exchange, len));
        }
        None
    }

    /// Whether a value of the request has changed, or its bit has risen, or it waited for its values.
    fn is_wanted(&self, item: &mut Item, out: &mut [u8]) -> bool {
        let mut is_wanted = item.is_owed && self.make(item, out).is_some();
        item.is_owed &= !is_wanted;
        if item.on_change
            && let Some(len) = self.make(item, out)
        {
            let hash = digest(DIGEST_SEED, out.get(..len).unwrap_or(&[]));
            is_wanted |= item.digest != Some(hash);
            item.digest = Some(hash);
        }
        if let Some((var, bit)) = item.rising
            && self.image.is_known(var)
        {
            let on = self.image.bit(var, bit) == 1.0;
            is_wanted |= on && item.last_bit == Some(false);
            item.last_bit = Some(on);
        }
        is_wanted
    }

    /// Writes a request to the front of `out`; `None` if a value of it is unknown or stale.
    fn make(&self, item: &Item, out: &mut [u8]) -> Option<usize> {
        let fields = item.request.as_ref().map_or(&[][..], |format| format.bindings.of(self.bindings.binds));
        if !fields.iter().all(|field| may_send(self.sender, self.image, field, self.now)) {
            return None;
        }
        let (frames_sent, reply) = (self.sender.frames_sent, self.reply);
        let texts = &self.codec.texts;
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

/// Whether a field's value is known, and fresh unless the recipe holds.
pub(super) fn may_send(sender: &Sender, image: &Image, field: &OutputBind, now: Instant) -> bool {
    match field.from {
        OutputBinding::Variable { var, .. } | OutputBinding::Bit { var, .. } => {
            image.known_since(var).is_some_and(|at| sender.is_fresh(at, now))
        }
        OutputBinding::State { .. } => sender.may_show(image, now),
        _ => true,
    }
}
