//! Classifies the frames that arrive on a port with exchanges.
//!
//! In: the request in flight, exchanges whose replies may still arrive, and unsolicited frames. Out: the part of a
//! frame in its exchange. Applies nothing.

use super::bindings::InputBind;
use super::exchanges::{Asks, ExchangeItem, InputFormat, OtherFormat};
use super::format::{DeviceFormat, better, elements, probe};
use super::line::{Flight, OwnRequest};
use super::modbus_tcp::Transactions;
use super::turns::Row;
use crate::device::Probe;
use crate::modbus::adu::PREFIX_LEN;
use crate::modbus::rtu::{self, Expected, MAX_ADU, REFUSAL_LEN};
use crate::time::Instant;

/// The meaning of a received frame.
pub(crate) enum Heard<'i> {
    /// The echo of the gateway's request.
    Echo,
    /// The expected reply, with the format of its data if it has any.
    Reply(Option<&'i InputFormat>),
    /// The expected reply, or the echo of the gateway's request.
    ReplyOrEcho,
    /// The device is still processing the request; its reply follows.
    Pending(&'i OtherFormat),
    /// The device refuses the request; with the format of its frame, except on Modbus.
    Refusal(Option<&'i OtherFormat>),
    /// A reply to an earlier request of this exchange that arrived too late, or its pending answer.
    Late { exchange: u8, is_pending: bool },
    /// A reply to one of several requests; nothing tells which.
    Ambiguous,
    /// An unsolicited frame, its place in the store, and its exchange if it belongs to one.
    Unasked(&'i DeviceFormat, usize, Option<u8>),
}

/// The frames that may arrive now.
#[derive(Clone, Copy)]
pub(crate) struct PendingReplies<'i> {
    /// The frames of the recipe's input part.
    pub formats: &'i [DeviceFormat],
    pub first_frame: u8,
    pub items: &'i [ExchangeItem],
    pub rows: &'i [Row],
    pub flight: Option<Flight>,
    /// The echo of the request that comes, or may come, before its reply.
    pub echo: Option<OwnRequest>,
    /// Whether the echo is certain.
    pub has_echo: bool,
    pub bindings: &'i [InputBind],
    pub now: Instant,
}

impl<'i> PendingReplies<'i> {
    pub(crate) fn asked(&self) -> Option<&'i ExchangeItem> {
        self.items.get(usize::from(self.flight?.exchange))
    }

    /// The expected reply of a Modbus slave.
    pub(crate) fn expected(&self) -> Option<Expected> {
        self.flight?.expected
    }

    /// Whether nothing but the echo can come yet.
    fn waits_for_echo(&self) -> bool {
        self.has_echo && self.echo.is_some()
    }

    /// The possible replies to the request in flight, apart from Modbus frames.
    pub(crate) fn answers(&self) -> impl Iterator<Item = &'i DeviceFormat> {
        self.asked().filter(|_| !self.waits_for_echo()).into_iter().flat_map(answers_of)
    }

    /// The exchanges whose replies may still arrive, except the one in flight.
    fn outstanding(&self) -> impl Iterator<Item = (u8, &'i Row, &'i ExchangeItem)> {
        let (own, now) = (self.flight.map(|flight| flight.exchange), self.now);
        let all = (0_u8..).zip(self.rows).zip(self.items).map(|((nth, row), item)| (nth, row, item));
        all.filter(move |(nth, row, _)| Some(*nth) != own && row.is_outstanding(now))
    }

    pub(crate) fn unasked(&self) -> impl Iterator<Item = (&'i DeviceFormat, usize, Option<u8>)> {
        let part =
            (usize::from(self.first_frame)..).zip(self.formats).map(|(slot, format)| (format, slot, None));
        let others = (0_u8..).zip(self.items).filter(|(_, item)| matches!(item.asks, Asks::Nothing));
        let others = others.filter_map(|(nth, item)| Some((nth, item.reply.as_ref()?)));
        part.chain(others.map(|(nth, reply)| (&reply.format, usize::from(reply.slot), Some(nth))))
    }

    /// Matches bytes of a line.
    pub(crate) fn probe(&self, bytes: &[u8]) -> Probe {
        let mut best = match self.expected().filter(|_| !self.waits_for_echo()) {
            Some(expected) => probe_reply(&expected, bytes),
            None => Probe::No(1),
        };
        if let Some(echo) = &self.echo {
            best = if self.has_echo { echo.probe(bytes) } else { better(best, echo.probe(bytes)) };
        }
        for (_, row, _) in self.outstanding() {
            if let Some(expected) = &row.expected {
                best = better(best, right_reply(expected, bytes));
            }
        }
        for format in self.all() {
            best = better(best, probe(format, self.bindings, bytes));
        }
        let Probe::Other(_) = best else { return best };
        // One of our frames may happen to begin like a shorter frame of another device, if its byte at the place of
        // that frame's checksum is right by chance.
        let begun = |format: &DeviceFormat| match probe(format, self.bindings, bytes) {
            Probe::Partial(missing) => {
                let fields = elements(format.bindings.of(self.bindings));
                format.layout.agrees(fields, bytes).then_some(missing)
            }
            _ => None,
        };
        self.all().filter_map(begun).min().map_or(best, Probe::Partial)
    }

    /// The frames that may arrive, except those of Modbus.
    pub(crate) fn all(&self) -> impl Iterator<Item = &'i DeviceFormat> {
        let late = self.outstanding().flat_map(|(_, _, item)| answers_of(item));
        self.answers().chain(self.unasked().map(|(format, ..)| format)).chain(late)
    }

    /// Rough number of steps to see that bytes are none of the frames that may arrive.
    pub(crate) fn effort(&self) -> usize {
        self.all().map(DeviceFormat::effort).fold(MAX_ADU, usize::saturating_add)
    }

    /// The meaning of a frame that [`Self::probe`] has found.
    pub(crate) fn heard(&self, frame: &[u8]) -> Option<Heard<'i>> {
        let is = |format: &DeviceFormat| format.is_frame(self.bindings, frame);
        let is_echo = self.echo.is_some_and(|echo| echo.probe(frame) == Probe::Frame(frame.len()));
        if is_echo && self.has_echo {
            return Some(Heard::Echo);
        }
        let answer = self.expected().filter(|_| !self.waits_for_echo()).and_then(|expected| {
            match expected.probe(frame) {
                rtu::Probe::Reply(_) => Some(Heard::Reply(self.asked()?.reply.as_ref())),
                rtu::Probe::Refused(_) => Some(Heard::Refusal(None)),
                _ => None,
            }
        });
        let answer = answer.or_else(|| self.answer(is));
        match answer {
            Some(Heard::Reply(_)) if is_echo => return Some(Heard::ReplyOrEcho),
            None if is_echo => return Some(Heard::Echo),
            _ => {}
        }
        let is_right = |expected: &Expected| {
            matches!(expected.probe(frame), rtu::Probe::Reply(_) | rtu::Probe::Refused(_))
        };
        self.classify(answer, is, |row| row.expected.as_ref().is_some_and(is_right)).or_else(|| {
            let (format, slot, nth) = self.unasked().find(|(format, ..)| is(format))?;
            Some(Heard::Unasked(format, slot, nth))
        })
    }

    /// The meaning of a Modbus TCP frame that [`modbus_tcp::probe`](super::modbus_tcp::probe) has found; `None` if it
    /// answers no request.
    pub(crate) fn heard_on_tcp(&self, all: &mut Transactions, frame: &[u8]) -> Option<Heard<'i>> {
        let (&[t1, t0, ..], body) = frame.split_first_chunk::<PREFIX_LEN>()?;
        let id = u16::from_be_bytes([t1, t0]);
        if id != all.newest || self.flight.is_none() {
            return all.take(id).map(|exchange| Heard::Late { exchange, is_pending: false });
        }
        let is_good = self.expected()?.judge(body)?;
        all.take(id);
        if is_good { Some(Heard::Reply(self.asked()?.reply.as_ref())) } else { Some(Heard::Refusal(None)) }
    }

    /// The answer, or [`Heard::Ambiguous`] if it may also be another request's refusal or pending answer; without an
    /// answer, a late reply. `is` matches device frames, `is_expected` Modbus frames.
    pub(crate) fn classify(
        &self,
        answer: Option<Heard<'i>>,
        is: impl Fn(&DeviceFormat) -> bool,
        is_expected: impl Fn(&Row) -> bool,
    ) -> Option<Heard<'i>> {
        if let Some(Heard::Reply(_)) = answer {
            return answer;
        }
        let late = self.outstanding().find_map(|(exchange, row, item)| {
            let found = place_of(item, &is);
            let is_pending = found == Some(1);
            (found.is_some() || is_expected(row)).then_some(Heard::Late { exchange, is_pending })
        });
        match answer {
            Some(answer) => Some(if late.is_some() { Heard::Ambiguous } else { answer }),
            None => late,
        }
    }

    pub(crate) fn answer(&self, is: impl Fn(&DeviceFormat) -> bool) -> Option<Heard<'i>> {
        let item = self.asked().filter(|_| !self.waits_for_echo())?;
        match place_of(item, &is)? {
            0 => Some(Heard::Reply(item.reply.as_ref())),
            1 => item.pending.as_ref().map(Heard::Pending),
            _ => Some(Heard::Refusal(item.refusal.as_ref())),
        }
    }
}

/// Which of the possible replies a frame is, by the order of [`answers_of`].
fn place_of(item: &ExchangeItem, is: &impl Fn(&DeviceFormat) -> bool) -> Option<u8> {
    (0..3).find(|nth| answer_of(item, *nth).is_some_and(is))
}

/// The device frames that may answer an exchange, in the order of matching: its reply, its pending answer, its refusal.
pub(crate) fn answers_of(item: &ExchangeItem) -> impl Iterator<Item = &DeviceFormat> {
    (0..3_u8).filter_map(|nth| answer_of(item, nth))
}

fn answer_of(item: &ExchangeItem, nth: u8) -> Option<&DeviceFormat> {
    if !matches!(item.asks, Asks::Frame | Asks::Remote { .. }) {
        return None;
    }
    match nth {
        0 => item.reply.as_ref().map(|reply| &reply.format),
        1 => item.pending.as_ref().map(|pending| &pending.format),
        _ => item.refusal.as_ref().map(|refusal| &refusal.format),
    }
}

fn probe_reply(expected: &Expected, bytes: &[u8]) -> Probe {
    match expected.probe(bytes) {
        rtu::Probe::No => Probe::No(1),
        rtu::Probe::Partial => Probe::Partial(1),
        rtu::Probe::Reply(len) => Probe::Frame(len),
        rtu::Probe::Refused(_) => Probe::Frame(REFUSAL_LEN),
        rtu::Probe::Wrong => Probe::Wrong(expected.len_of(bytes)),
    }
}

/// A late reply; one with a wrong checksum does not count.
fn right_reply(expected: &Expected, bytes: &[u8]) -> Probe {
    match probe_reply(expected, bytes) {
        Probe::Wrong(_) => Probe::No(1),
        probe => probe,
    }
}
