//! Exchanges on field ports: requests, their replies, and missing replies.
//!
//! In: bytes and CAN frames of ports whose recipe has exchanges, the time. Out: values in the store, and requests. Does
//! not know which exchange is next ([`super::line`] does).

use super::bindings::{InputBind, Outputs};
use super::codec::{Codec, DeviceCodec, Reader};
use super::event::Outcome;
use super::events::{Events, Sources};
use super::exchanges::{Asks, ExchangeItem, OtherFormat, View};
use super::format::{DeviceFormat, elements, judge_can};
use super::frames::{Accepted, FrameContext};
use super::line::{ExchangeTable, Flight, Line, Over, Phase};
use super::modbus_tcp;
use super::output::FieldFrame;
use super::pending::{Heard, PendingReplies};
use super::port::{FieldPort, came, keep_why};
use super::requests::RequestBuilder;
use super::texts::TextBind;
use super::turns::{Cause, Ended, PeerChange};
use crate::device::{Found, Probe};
use crate::engine::counters::{PortCounters, add, bump};
use crate::engine::link::command::CommandLink;
use crate::engine::rejection::Rejection;
use crate::engine::tap::Tap;
use crate::engine::values::store::Store;
use crate::image::{GroupId, Image};
use crate::time::Instant;
use crate::wire::can::{CanFrame, CanId, CanKey};

impl FieldPort {
    /// The line of the exchanges, if the recipe has any.
    pub(crate) fn line(&self) -> Option<&Line> {
        match &self.codec {
            Codec::Device(device) => device.line.as_ref(),
            _ => None,
        }
    }

    pub(crate) fn line_mut(&mut self) -> Option<&mut Line> {
        match &mut self.codec {
            Codec::Device(device) => device.line.as_mut(),
            _ => None,
        }
    }

    fn is_on_can(&self) -> bool {
        matches!(&self.codec, Codec::Device(device) if device.reader.is_none())
    }

    /// When the port's exchanges have something to do without an input.
    pub(crate) fn exchange_deadline(&self) -> Instant {
        match self.line() {
            Some(line) if self.is_usable() => {
                let deadline = line.deadline(&self.line);
                // A request can only be sent once the line is free, which an input will report.
                let own = if self.sender.is_busy() && line.may_ask() { Instant::NEVER } else { deadline };
                own.min(line.expires_at).min(self.slave_deadline()).min(self.reply_deadline())
            }
            _ => Instant::NEVER,
        }
    }

    /// Takes the bytes if the gateway is the slave of this line; returns whether it is.
    pub(crate) fn hears_master(&mut self, bytes: &[u8], now: Instant) -> bool {
        let is_usable = self.is_usable();
        let Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. }) = &mut self.codec else {
            return false;
        };
        if is_usable {
            slave.received(bytes, now);
        } else {
            // When the port is back, no master waits for a reply any more.
            add(&mut self.counters.discarded_bytes, bytes.len());
        }
        true
    }

    /// Whether a request has failed and the tick that handles it is still to come.
    pub(crate) fn has_failed(&self, now: Instant) -> bool {
        self.is_usable() && self.line().is_some_and(|line| line.failure(&self.line, now).is_some())
    }

    /// Reads the frames in `rest`; stops after the first accepted one if the image has to be checked after each frame.
    pub(crate) fn exchange_frames(
        &mut self,
        rest: &mut &[u8],
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
        mut view: View<'_>,
    ) -> Accepted {
        let mut accepted = Accepted::default();
        let (now, usable, bytes) = (store.now, self.is_usable(), *rest);
        let mut left = core::mem::take(rest);
        let Codec::Device(DeviceCodec {
            formats,
            inputs,
            texts,
            reader: Some(Reader::Search(framer)),
            line: Some(line),
            ..
        }) = &mut self.codec
        else {
            return accepted;
        };
        let formats = formats.get(..usize::from(*inputs)).unwrap_or(&[]);
        let (items, mut table) = view.of(line);
        let mut frames = FrameContext::new(
            (self.id, self.mode),
            &mut self.reply,
            &mut self.counters,
            bindings,
            store,
            commands,
        );
        let first_frame = self.first_frame;
        loop {
            let pending = PendingReplies {
                formats,
                first_frame,
                items,
                rows: table.rows,
                flight: line.flight(),
                echo: line.echo,
                has_echo: line.has_echo == Some(true),
                bindings,
                now,
            };
            let is_tcp = line.transactions.is_some();
            let probe = |bytes: &[u8]| if is_tcp { modbus_tcp::probe(bytes) } else { pending.probe(bytes) };
            let Some(found) = framer.next_frame(&mut left, pending.effort(), probe) else { break };
            let (frame, heard) = match (found, &mut line.transactions) {
                (Found::Frame(frame), None) => (frame, pending.heard(frame).ok_or(Rejection::NoFrame)),
                (Found::Frame(frame), Some(all)) => {
                    (frame, pending.heard_on_tcp(all, frame).ok_or(Rejection::OtherDevice))
                }
                (Found::Other(frame), None) => (frame, Err(Rejection::OtherDevice)),
                (Found::Other(frame), Some(all)) => {
                    // No later frame on this connection can be found.
                    (all.is_lost, left) = (true, &[]);
                    (frame, Err(Rejection::Malformed))
                }
                (Found::Wrong(frame), _) => {
                    line.heard_wrong();
                    (frame, Err(Rejection::Checksum))
                }
            };
            if let Ok(Heard::Echo) = heard {
                line.echo = None;
                learn_echo(line, &mut table, true, now);
                continue;
            }
            let flight = pending.flight;
            let answer = Answer::of(frame, pending.expected().is_some(), is_tcp);
            let before = accepted.frames;
            let taken = match heard {
                Ok(heard) => apply_heard(&mut frames, texts, heard, (flight, frame, answer), &mut accepted),
                // Already counted by the search.
                Err(why @ Rejection::NoFrame) => Taken::nothing(Err(why)),
                Err(why) => Taken::nothing(frames.rejected(why)),
            };
            let verdict = taken.verdict;
            if apply_effect(line, items, &mut table, (bindings, frames.counters), taken, flight, now) {
                self.sender.sent();
            }
            tap.record(|| came(self.id, now, verdict, None, [frame, &[], &[]]));
            keep_why(&mut self.last_rejection, verdict, frames.store, None, frame);
            // The framer may hold more frames, so only the rest of the chunk is left for the next call.
            let may_change = verdict.is_ok() || accepted.frames != before;
            if may_change && frames.store.watches_bits && !left.is_empty() {
                break;
            }
        }
        *rest = left;
        self.note_skipped(bytes, tap, now);
        self.sender.frames_accepted(accepted.frames, usable, &mut self.counters, now);
        accepted
    }

    /// Reads a CAN frame.
    pub(crate) fn exchange_frame(
        &mut self,
        frame: &CanFrame,
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        mut view: View<'_>,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        let (now, usable) = (store.now, self.is_usable());
        add(&mut self.counters.bytes_in, frame.data().len());
        let Codec::Device(DeviceCodec { formats, inputs, texts, line: Some(line), .. }) = &mut self.codec
        else {
            return Ok(());
        };
        let formats = formats.get(..usize::from(*inputs)).unwrap_or(&[]);
        let (items, mut table) = view.of(line);
        let mut frames = FrameContext::new(
            (self.id, self.mode),
            &mut self.reply,
            &mut self.counters,
            bindings,
            store,
            commands,
        );
        if frame.is_remote() {
            return frames.rejected(Rejection::Remote);
        }
        if let Some(which) = booted_peer(items, &table, frame) {
            let nth = table.rows.iter().position(|row| row.peer == which).unwrap_or(0);
            line.turns(&mut table, |turns| turns.started(which, None, now));
            has_restarted(line, items, &mut table, (nth, which), now);
        }
        let flight = line.flight();
        let first_frame = self.first_frame;
        let (echo, has_echo) = (None, false);
        let pending = PendingReplies {
            formats,
            first_frame,
            items,
            rows: table.rows,
            flight,
            echo,
            has_echo,
            bindings,
            now,
        };
        let is = |format: &DeviceFormat| {
            let fields = elements(format.bindings.of(bindings));
            format.key == frame.key()
                && matches!(format.layout.probe_whole(fields, frame.data()), Probe::Frame(_))
        };
        let (answer, code) = match pending.answer(is) {
            Some(answer) => (Some(answer), 0),
            None => match sdo_abort(&pending, frame) {
                Some(code) => (Some(Heard::Refusal(None)), code),
                None => (None, 0),
            },
        };
        let of_reply = Answer { data: frame.data(), code, is_modbus: false, is_tcp: false };
        let taken = match pending.classify(answer, is, |_| false) {
            Some(heard) => apply_heard(&mut frames, texts, heard, (flight, frame.data(), of_reply), accepted),
            None => {
                let answers = pending.answers().map(|format| (None, format));
                let unasked = pending.unasked();
                let all = answers.chain(unasked.map(|(format, slot, nth)| (Some((slot, nth)), format)));
                let (place, format) = match judge_can(all, bindings, frame) {
                    Ok(found) => found,
                    Err(why) => return frames.rejected(why),
                };
                let (slot, nth) = place.unwrap_or((usize::MAX, None));
                frames.take_device(format, texts, frame.data(), slot, accepted)?;
                if let Some(nth) = nth {
                    look_for_restart(line, items, &mut table, bindings, (nth, frame.data()), now);
                }
                note_sign_of_life(line, items, &mut table, Effect::Unasked(nth), now);
                self.sender.frames_accepted(1, usable, &mut self.counters, now);
                return Ok(());
            }
        };
        let verdict = taken.verdict;
        apply_effect(line, items, &mut table, (bindings, frames.counters), taken, flight, now);
        verdict
    }

    /// The next request, if the line is free.
    pub(crate) fn next_request(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        mut view: View<'_>,
        out: &mut [u8],
        now: Instant,
    ) -> Option<FieldFrame> {
        if !self.is_usable() {
            return None;
        }
        let is_busy = self.sender.is_busy() || now < self.line.quiet_at();
        let Codec::Device(codec) = &mut self.codec else { return None };
        // Taken out, because the rest of the codec makes the frames.
        let mut line = codec.line.take()?;
        let (items, mut table, kept) = view.served(&line);
        let maker = RequestBuilder { image, bindings, codec, sender: &self.sender, reply: self.reply, now };
        let request = maker.next(&mut line, (items, &mut table, kept), &mut self.counters, is_busy, out);
        let is_on_can = codec.reader.is_none();
        if let (Some(_), Some(Reader::Search(framer))) = (&request, &mut codec.reader)
            && !line.hears_unasked
            && line.transactions.is_none()
        {
            // What is held is too old to be the reply.
            add(&mut self.counters.discarded_bytes, framer.discard());
        }
        codec.line = Some(line);
        let (item, len) = request?;
        self.note_partial();
        self.sender.handed_over_beside();
        self.counters.sent(len);
        if !is_on_can {
            return Some(FieldFrame::Bytes(len));
        }
        let item = view_item(&mut view, self.line()?, item)?;
        if let Asks::Remote { id, len } = item.asks {
            return CanFrame::remote(id, len.into()).map(FieldFrame::Can);
        }
        let frame = out.get(..len).unwrap_or(&[]);
        let id = item.request.as_ref()?.key.id();
        Some(FieldFrame::Can(CanFrame::cut(id, frame)))
    }

    /// The request has left.
    pub(crate) fn exchange_sent(&mut self, mut view: View<'_>, now: Instant) {
        let (timing, is_on_can) = (self.line, self.is_on_can());
        let Some(line) = self.line_mut() else { return };
        let (items, mut table) = view.of(line);
        let flight = line.flight();
        // On CAN others may send while a reply is pending.
        let is_pending = line.sent(&table, &timing, now);
        if let Some(flight) = flight.filter(|_| !is_pending) {
            // A request without a reply may not have been received. The steps that follow it are sent nevertheless.
            let nth = usize::from(flight.exchange);
            let mut events = Events { items, table: &mut table, line, now };
            if flight.cause == Cause::Event {
                events.end_unanswered(nth);
            }
        }
        if is_pending && !is_on_can {
            self.sender.hold();
        }
    }

    /// Handles what is due: ends pauses, fails missing replies and expires events.
    pub(crate) fn advance_exchange(&mut self, mut view: View<'_>, now: Instant) {
        let (timing, is_on_can) = (self.line, self.is_on_can());
        let Some(line) = self.line_mut() else { return };
        line.advance(now);
        let (items, mut table) = view.of(line);
        Events { items, table: &mut table, line, now }.expire();
        let Some(failure) = line.failure(&timing, now) else { return };
        let over = line.failed(&mut table, failure, now);
        let (nth, is_event) = (usize::from(failure.0.exchange), failure.0.cause == Cause::Event);
        let ended = match over {
            Over::Repeated => None,
            Over::GivenUp(_) => Some(Ended::Unclear),
            Over::Unconfirmed => Some(Ended::Unconfirmed),
        };
        let mut events = Events { items, table: &mut table, line, now };
        if let Some(ended) = ended {
            events.ended(nth, is_event, ended, 0);
        }
        if let Over::GivenUp(news) = over {
            events.note(nth, news);
        }
        // On CAN the sender was not held while the reply was pending: a frame of the cycle may be in transmission.
        if !is_on_can {
            self.sender.sent();
        }
        if matches!(over, Over::GivenUp(_)) {
            bump(&mut self.counters.unanswered);
        }
    }

    pub(crate) fn abandon_exchange(&mut self, mut view: View<'_>, now: Instant) {
        let is_on_can = self.is_on_can();
        let Some(line) = self.line_mut() else { return };
        let was_waiting = matches!(line.phase, Phase::Waiting(_));
        let (items, mut table) = view.of(line);
        let flight = line.abandon(&mut table, now);
        for item in &mut *items {
            if let Some(trigger) = &mut item.trigger {
                trigger.forget();
            }
        }
        let mut events = Events { items, table: &mut table, line, now };
        if let Some(flight) = flight.filter(|flight| flight.cause == Cause::Event) {
            events.end(usize::from(flight.exchange), Outcome::Unknown, 0);
        }
        events.end_waiting(None, Outcome::Away);
        if was_waiting && !is_on_can {
            self.sender.sent();
        }
    }

    /// Values in the image have changed: checks the bits that trigger requests.
    pub(crate) fn triggers(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        mut view: View<'_>,
        (first_of_links, up_since): (u8, impl Fn(GroupId) -> Instant),
        now: Instant,
    ) {
        let is_usable = self.is_usable();
        let Codec::Device(codec) = &mut self.codec else { return };
        let Some(mut line) = codec.line.take() else { return };
        let (items, mut table, kept) = view.served(&line);
        let stale_after = self.sender.stale_after();
        let maker = RequestBuilder { image, bindings, codec, sender: &self.sender, reply: self.reply, now };
        let sources = Sources { first_of_links, up_since, stale_after, is_usable };
        let mut events = Events { items, table: &mut table, line: &mut line, now };
        events.image_changed(&maker, &sources, kept);
        codec.line = Some(line);
    }

    pub(crate) fn begin_exchange(&mut self, mut view: View<'_>, now: Instant) {
        if let Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. }) = &mut self.codec {
            // What came while the line was down is too old to be answered.
            add(&mut self.counters.discarded_bytes, slave.discard());
        }
        let is_on_can = self.is_on_can();
        let Some(line) = self.line_mut() else { return };
        let was_waiting = matches!(line.phase, Phase::Waiting(_));
        let (items, mut table) = view.of(line);
        for item in items {
            (item.digest, item.is_owed) = (None, false);
            if let Some(effect) = &mut item.restart {
                effect.was_there = None;
            }
        }
        line.begin(&mut table, now);
        line.looks = line.looks.map(|grid| crate::schedule::Grid::starting_at(now, grid.period()));
        // The port was not reported down before, and its reply is no longer pending.
        if was_waiting && !is_on_can {
            self.sender.sent();
        }
    }
}

fn view_item<'v>(view: &'v mut View<'_>, line: &Line, nth: u8) -> Option<&'v ExchangeItem> {
    view.of(line).0.get(usize::from(nth))
}

/// What a frame says about the exchanges.
#[derive(Clone, Copy)]
enum Effect {
    Nothing,
    /// A reply to the request in flight, with the code of a refusal.
    Answer(Ended, u16),
    /// The peer is still processing the request.
    Pending,
    ReplyOrEcho,
    /// A late reply to an earlier request of this exchange, or its pending answer.
    Late {
        exchange: u8,
        is_pending: bool,
    },
    Ambiguous,
    /// An unsolicited frame, of this exchange if it belongs to one.
    Unasked(Option<u8>),
}

/// The reply in a frame.
#[derive(Clone, Copy)]
struct Answer<'f> {
    /// The data of a Modbus frame, else the whole frame.
    data: &'f [u8],
    /// The code of a refusal.
    code: u16,
    is_modbus: bool,
    /// Over TCP, the transaction id tells which request the reply belongs to.
    is_tcp: bool,
}

impl<'f> Answer<'f> {
    /// The reply in a frame from a stream.
    fn of(frame: &'f [u8], is_modbus: bool, is_tcp: bool) -> Self {
        if !is_modbus {
            return Self { data: frame, code: 0, is_modbus, is_tcp: false };
        }
        let (data, code) = match is_tcp {
            true => modbus_tcp::content(frame),
            false => (frame.get(3..frame.len().saturating_sub(2)).unwrap_or(&[]), frame.get(2).copied()),
        };
        Self { data, code: code.unwrap_or(0).into(), is_modbus, is_tcp }
    }
}

/// How a frame was taken.
struct Taken<'f> {
    verdict: Result<(), Rejection>,
    effect: Effect,
    /// The exchange whose reply was taken, and the reply's data.
    reply_data: Option<(u8, &'f [u8])>,
}

impl Taken<'_> {
    /// A frame that says nothing about the exchanges.
    const fn nothing(verdict: Result<(), Rejection>) -> Self {
        Self { verdict, effect: Effect::Nothing, reply_data: None }
    }
}

/// Takes the values of a classified frame.
fn apply_heard<'f>(
    frames: &mut FrameContext<'_>,
    texts: &[TextBind],
    heard: Heard<'_>,
    (flight, frame, answer): (Option<Flight>, &'f [u8], Answer<'f>),
    accepted: &mut Accepted,
) -> Taken<'f> {
    let mut reply_data = None;
    let (verdict, effect) = match heard {
        Heard::Reply(Some(reply)) => {
            reply_data = flight.map(|flight| (flight.exchange, answer.data));
            let slot = usize::from(reply.slot);
            let verdict = frames.take_device(&reply.format, texts, answer.data, slot, accepted);
            let since = flight.filter(|_| !answer.is_tcp).and_then(|flight| flight.unanswered());
            if let Some(since) = since {
                frames.store.was_asked(slot, since);
            }
            (verdict, Effect::Answer(Ended::Good, 0))
        }
        // A confirmed write.
        Heard::Reply(None) => (Ok(()), Effect::Answer(Ended::Good, 0)),
        Heard::ReplyOrEcho => (Ok(()), Effect::ReplyOrEcho),
        Heard::Pending(pending) => {
            (take_other(frames, Some(pending), texts, frame, accepted), Effect::Pending)
        }
        Heard::Refusal(refusal) => (
            take_other(frames, refusal, texts, frame, accepted).and(Err(Rejection::Refused)),
            Effect::Answer(refused_with(answer.code, answer.is_modbus), answer.code),
        ),
        Heard::Late { exchange, is_pending } => (Err(Rejection::Late), Effect::Late { exchange, is_pending }),
        Heard::Ambiguous => (Err(Rejection::Late), Effect::Ambiguous),
        Heard::Unasked(format, slot, nth) => {
            reply_data = nth.map(|nth| (nth, frame));
            (frames.take_device(format, texts, frame, slot, accepted), Effect::Unasked(nth))
        }
        Heard::Echo => (Err(Rejection::NoFrame), Effect::Nothing),
    };
    Taken { verdict, effect, reply_data }
}

/// Applies what a frame says about the exchanges. Returns whether the line waited for it.
fn apply_effect(
    line: &mut Line,
    items: &mut [ExchangeItem],
    table: &mut ExchangeTable<'_>,
    (bindings, counters): (&[InputBind], &mut PortCounters),
    taken: Taken<'_>,
    flight: Option<Flight>,
    now: Instant,
) -> bool {
    if let Some(reply_data) = taken.reply_data.filter(|_| taken.verdict.is_ok()) {
        look_for_restart(line, items, table, bindings, reply_data, now);
    }
    match (taken.effect, flight) {
        (Effect::Pending, Some(flight)) => still_processing(line, items, table, flight, now),
        (Effect::Answer(ended, code), Some(flight)) => {
            // After a repetition, two identical frames may be the replies to both requests.
            let is_sure = !flight.is_repetition() && !is_outstanding(table, flight, now);
            if is_sure && (flight.may_be_echo || line.echo.is_some()) {
                learn_echo(line, table, flight.may_be_echo, now);
            }
            let was_waiting = matches!(line.phase, Phase::Waiting(_));
            answered(line, items, table, counters, flight, (ended, code), now);
            return was_waiting;
        }
        (Effect::ReplyOrEcho, _) => line.heard_reply_or_echo(),
        (effect, _) => note_sign_of_life(line, items, table, effect, now),
    }
    false
}

/// The meaning of a refusal; on Modbus its code decides (docs/wire/modbus-rtu.md section 4).
const fn refused_with(code: u16, is_modbus: bool) -> Ended {
    match code {
        5 if is_modbus => Ended::Accepted,
        6 if is_modbus => Ended::Busy,
        4 | 8 | 10 | 11 if is_modbus => Ended::Unclear,
        _ => Ended::Refused,
    }
}

/// The peer whose CANopen node reports that it has booted: the node that an exchange accesses with SDO.
fn booted_peer(items: &[ExchangeItem], table: &ExchangeTable<'_>, frame: &CanFrame) -> Option<u8> {
    let (CanId::Standard(id @ 0x701..=0x77F), [0]) = (frame.id(), frame.data()) else { return None };
    let sdo = CanKey::of(CanId::Standard(id.wrapping_sub(0x100)));
    let is_of_node = |item: &ExchangeItem| item.request.as_ref().is_some_and(|request| request.key == sdo);
    let nth = items.iter().position(is_of_node)?;
    table.rows.get(nth).map(|row| row.peer)
}

/// The low half of the abort code, if the frame is an SDO abort of the request in flight.
fn sdo_abort(pending: &PendingReplies<'_>, frame: &CanFrame) -> Option<u16> {
    let multiplexer = pending.flight?.sdo?;
    let reply = pending.asked()?.reply.as_ref()?;
    let &[0x80, a, b, c, low, high, _, _] = frame.data().first_chunk::<8>()? else { return None };
    (frame.key() == reply.format.key && [a, b, c] == multiplexer).then_some(u16::from_le_bytes([low, high]))
}

/// Whether a reply to an earlier request of the same exchange may still arrive.
fn is_outstanding(table: &ExchangeTable<'_>, flight: Flight, now: Instant) -> bool {
    table.rows.get(usize::from(flight.exchange)).is_some_and(|row| row.is_outstanding(now))
}

/// It is now known whether the line echoes: requests that were unconfirmed because of this are sent again if it does,
/// and confirmed if not.
fn learn_echo(line: &mut Line, table: &mut ExchangeTable<'_>, has_echo: bool, now: Instant) {
    if !line.learn_echo(has_echo) {
        return;
    }
    // Not the request in flight: its own reply decides.
    let own = line.flight().map(|flight| usize::from(flight.exchange));
    for nth in (0..table.rows.len()).filter(|nth| Some(*nth) != own) {
        let Some(row) = table.rows.get_mut(nth) else { break };
        let was_unconfirmed = core::mem::take(&mut row.is_unconfirmed);
        if was_unconfirmed && has_echo && row.is_state() {
            line.request(table, nth, now);
        }
    }
}

/// The request in flight is answered: counts the reply at its port and peer, and updates the events.
fn answered(
    line: &mut Line,
    items: &mut [ExchangeItem],
    table: &mut ExchangeTable<'_>,
    counters: &mut PortCounters,
    flight: Flight,
    (ended, code): (Ended, u16),
    now: Instant,
) {
    let is_refused = ended != Ended::Good;
    if is_refused {
        bump(&mut counters.refused);
    }
    if let Some(peer) = table.peer_of(flight) {
        if is_refused {
            bump(&mut peer.counters.refused);
            peer.counters.refusal = code as u8;
        } else {
            bump(&mut peer.counters.replies);
        }
    }
    let (ended, news) = line.answered(table, flight, ended, now);
    let nth = usize::from(flight.exchange);
    let mut events = Events { items, table, line, now };
    events.note(nth, news);
    events.ended(nth, flight.cause == Cause::Event, ended, code);
}

/// The peer is still processing the request, so it is up.
fn still_processing(
    line: &mut Line,
    items: &mut [ExchangeItem],
    table: &mut ExchangeTable<'_>,
    flight: Flight,
    now: Instant,
) {
    line.heard_pending(table, now);
    let nth = usize::from(flight.exchange);
    let Some(which) = table.rows.get(nth).map(|row| row.peer) else { return };
    let news = line.turns(table, |turns| turns.heard(which, Some(nth), now));
    Events { items, table, line, now }.note(nth, news);
}

/// Takes the values of a pending answer or a refusal, if it has any.
fn take_other(
    frames: &mut FrameContext<'_>,
    other: Option<&OtherFormat>,
    texts: &[TextBind],
    frame: &[u8],
    accepted: &mut Accepted,
) -> Result<(), Rejection> {
    match other.and_then(|other| Some((&other.format, usize::from(other.slot?)))) {
        Some((format, slot)) => frames.take_device(format, texts, frame, slot, accepted),
        None => Ok(()),
    }
}

/// Checks an accepted reply for the value that shows that the peer has restarted: it has if the previous reply had
/// another value. Its start exchanges are repeated then.
fn look_for_restart(
    line: &mut Line,
    items: &mut [ExchangeItem],
    table: &mut ExchangeTable<'_>,
    bindings: &[InputBind],
    (exchange, data): (u8, &[u8]),
    now: Instant,
) {
    let nth = usize::from(exchange);
    let Some(ExchangeItem { restart: Some(effect), reply: Some(reply), .. }) = items.get_mut(nth) else {
        return;
    };
    let fields = elements(reply.format.bindings.of(bindings));
    let found = reply.format.layout.values(fields, data).nth(usize::from(effect.element));
    let Some(Ok(Some(value))) = found else { return };
    let is_there = value.as_f64() == effect.value;
    if effect.was_there.replace(is_there) != Some(false) || !is_there {
        return;
    }
    let Some(which) = table.rows.get(nth).map(|row| row.peer) else { return };
    let own = line.flight().map(|flight| usize::from(flight.exchange)).filter(|own| *own == nth);
    line.turns(table, |turns| {
        // If its failures also show a restart, it is the same one.
        if turns.heard(which, own, now) != PeerChange::Started {
            turns.started(which, own, now);
        }
    });
    has_restarted(line, items, table, (nth, which), now);
}

/// The peer of this exchange has reported a restart, which its turns already know.
fn has_restarted(
    line: &mut Line,
    items: &mut [ExchangeItem],
    table: &mut ExchangeTable<'_>,
    (nth, which): (usize, u8),
    now: Instant,
) {
    line.look(now);
    let mut events = Events { items, table, line, now };
    events.note(nth, PeerChange::Started);
    // The peer has lost everything it was asked to do before.
    events.end_waiting(Some(which), Outcome::Away);
}

/// A frame that is no reply to the request in flight shows that its peer is up.
fn note_sign_of_life(
    line: &mut Line,
    items: &mut [ExchangeItem],
    table: &mut ExchangeTable<'_>,
    effect: Effect,
    now: Instant,
) {
    let nth = match (effect, line.flight()) {
        (Effect::Late { exchange, .. }, _) | (Effect::Unasked(Some(exchange)), _) => usize::from(exchange),
        (Effect::Ambiguous, Some(flight)) => usize::from(flight.exchange),
        _ => return,
    };
    let Some(row) = table.rows.get_mut(nth) else { return };
    let which = row.peer;
    if matches!(effect, Effect::Late { is_pending: false, .. }) {
        row.late_reply_came();
    }
    if !matches!(effect, Effect::Unasked(_))
        && let Some(peer) = table.peers.get_mut(usize::from(which))
    {
        bump(&mut peer.counters.late_replies);
    }
    // A late reply shows that the peer has executed the request.
    let own = matches!(effect, Effect::Late { is_pending: false, .. }).then_some(nth);
    let news = line.turns(table, |turns| turns.heard(which, own, now));
    line.look(now);
    Events { items, table, line, now }.note(nth, news);
}
