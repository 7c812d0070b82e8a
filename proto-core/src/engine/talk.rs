//! Conversations on field ports: requests out, replies in, and what happens without them.
//!
//! In: bytes and CAN frames of ports whose recipe has exchanges, the time. Out: values in the store,
//! and requests. Which exchange is next is the line's business ([`super::line`]); ports without
//! exchanges do not come here.

use super::awaited::{Awaited, Heard};
use super::clock::Ask;
use super::command_link::CommandLink;
use super::counters::{PortCounters, add, bump};
use super::device_port::{DeviceCodec, DeviceFormat, elements, judge_can};
use super::exchanges::{Asks, Item, View};
use super::field_output::Downward;
use super::field_port::{Codec, FieldPort, came, keep_why};
use super::frames::{Accepted, Frames};
use super::io::{Output, PortId};
use super::line::{Flight, Line, Phase, Talks};
use super::rejection::Rejection;
use super::requests::Maker;
use super::store::Store;
use super::tap::{Tap, TapPlace};
use super::user::{InputBind, Outputs};
use super::whole_port::Reader;
use super::{Engine, OUTPUT_BUFFER, find_port};
use crate::device::{Found, Probe};
use crate::image::Image;
use crate::modbus::rtu::MAX_ADU;
use crate::time::Instant;
use crate::wire::can::CanFrame;

impl FieldPort {
    /// The conversation, if the recipe has exchanges.
    pub(super) fn line(&self) -> Option<&Line> {
        match &self.codec {
            Codec::Device(device) => device.line.as_ref(),
            _ => None,
        }
    }

    fn line_mut(&mut self) -> Option<&mut Line> {
        match &mut self.codec {
            Codec::Device(device) => device.line.as_mut(),
            _ => None,
        }
    }

    fn is_on_can(&self) -> bool {
        matches!(&self.codec, Codec::Device(device) if device.reader.is_none())
    }

    /// When its conversation has something to do without an input.
    pub(super) fn talk_deadline(&self) -> Instant {
        match self.line() {
            Some(line) if self.is_usable() => {
                let deadline = line.deadline(&self.line);
                // Until the line is free, there is only that to wait for.
                let own = if self.sender.is_busy() && line.may_ask() { Instant::NEVER } else { deadline };
                own.min(self.slave_deadline()).min(self.reply_deadline())
            }
            _ => Instant::NEVER,
        }
    }

    /// Whether the gateway is the slave of a line, which takes its bytes.
    fn hears_master(&mut self, bytes: &[u8], now: Instant) -> bool {
        let is_usable = self.is_usable();
        let Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. }) = &mut self.codec else {
            return false;
        };
        if is_usable {
            slave.received(bytes, now);
        } else {
            // When the port is back, nobody waits for an answer any more.
            add(&mut self.counters.discarded_bytes, bytes.len());
        }
        true
    }

    /// Whether a request has failed, and the tick that says so is still to come.
    fn has_failed(&self, now: Instant) -> bool {
        self.is_usable() && self.line().is_some_and(|line| line.failure(&self.line, now).is_some())
    }

    /// Reads the frames in `rest`; stops after the first accepted one if the image is to be checked
    /// after each frame.
    fn talk_frames<const PORTS: usize, const TAP: usize>(
        &mut self,
        rest: &mut &[u8],
        bindings: &[InputBind],
        store: &mut Store<PORTS>,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap<TAP>,
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
        let (items, mut talks) = view.of(line);
        let mut frames =
            Frames::new((self.id, self.mode), &mut self.reply, &mut self.counters, bindings, store, commands);
        let (first_frame, flight, echo) = (self.first_frame, line.flight(), line.echo);
        let mut awaited = Awaited { formats, first_frame, items, flight, echo, bindings };
        let effort = |awaited: &Awaited<'_>| {
            let all = awaited.answers().chain(awaited.unasked().map(|(format, _)| format));
            all.map(|format| format.layout.lengths().1.saturating_add(usize::from(format.bindings.len)))
                .fold(MAX_ADU, usize::saturating_add)
        };
        while let Some(found) = framer.next_frame(&mut left, effort(&awaited), |bytes| awaited.probe(bytes)) {
            let (frame, verdict) = match found {
                Found::Frame(frame) => {
                    let heard = awaited.heard(frame);
                    if let Some(Heard::Echo) = heard {
                        (line.echo, awaited.echo) = (None, None);
                        continue;
                    }
                    let verdict = match &heard {
                        Some(Heard::Reply(Some(reply))) => {
                            let data = match awaited.expected() {
                                Some(_) => frame.get(3..frame.len().saturating_sub(2)).unwrap_or(&[]),
                                None => frame,
                            };
                            frames.take_device(
                                &reply.format,
                                texts,
                                data,
                                usize::from(reply.slot),
                                &mut accepted,
                            )
                        }
                        Some(Heard::Unasked(format, slot)) => {
                            frames.take_device(format, texts, frame, *slot, &mut accepted)
                        }
                        // A write was carried out.
                        Some(Heard::Reply(None)) => Ok(()),
                        Some(Heard::Refusal) => Err(Rejection::Refused),
                        Some(Heard::Echo) | None => Err(Rejection::NoFrame),
                    };
                    if let (Some(Heard::Reply(_) | Heard::Refusal), Some(flight), Some(item)) =
                        (&heard, awaited.flight, awaited.asked())
                    {
                        let is_refused = matches!(heard, Some(Heard::Refusal));
                        let code = frame.get(2).copied().unwrap_or(0);
                        note_answer(&mut talks, frames.counters, flight, is_refused.then_some(code));
                        if matches!(line.phase, Phase::Waiting(_)) {
                            self.sender.sent();
                        }
                        line.answered(&mut talks, flight, item.times, now);
                    }
                    (frame, verdict)
                }
                Found::Other(frame) => (frame, frames.rejected(Rejection::OtherDevice)),
                Found::Wrong(frame) => {
                    line.heard_wrong();
                    (frame, frames.rejected(Rejection::Checksum))
                }
            };
            (awaited.flight, awaited.echo) = (line.flight(), line.echo);
            tap.record(|| came(self.id, now, verdict, None, [frame, &[], &[]]));
            keep_why(&mut self.last_rejection, verdict, frames.store, None, frame);
            // What is held can hold further frames, so only the rest of the chunk waits.
            if verdict.is_ok() && frames.store.watches_bits && !left.is_empty() {
                break;
            }
        }
        *rest = left;
        self.note_skipped(bytes, tap, now);
        self.sender.frames_accepted(accepted.frames, usable, &mut self.counters, now);
        accepted
    }

    /// A frame from the bus.
    fn talk_frame<const PORTS: usize>(
        &mut self,
        frame: &CanFrame,
        bindings: &[InputBind],
        store: &mut Store<PORTS>,
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
        let (items, mut talks) = view.of(line);
        let mut frames =
            Frames::new((self.id, self.mode), &mut self.reply, &mut self.counters, bindings, store, commands);
        if frame.is_remote() {
            return frames.rejected(Rejection::Remote);
        }
        let flight = line.flight();
        let first_frame = self.first_frame;
        let awaited = Awaited { formats, first_frame, items, flight, echo: None, bindings };
        let is = |format: &DeviceFormat| {
            let fields = elements(format.bindings.of(bindings));
            format.id == frame.id()
                && matches!(format.layout.probe_whole(fields, frame.data()), Probe::Frame(_))
        };
        if let Some(heard) = awaited.answer(is)
            && let (Some(flight), Some(item)) = (flight, awaited.asked())
        {
            let verdict = match heard {
                Heard::Reply(Some(reply)) => {
                    let slot = usize::from(reply.slot);
                    frames.take_device(&reply.format, texts, frame.data(), slot, accepted)
                }
                _ => Err(Rejection::Refused),
            };
            let is_refused = verdict == Err(Rejection::Refused);
            note_answer(&mut talks, frames.counters, flight, is_refused.then_some(0));
            line.answered(&mut talks, flight, item.times, now);
            return verdict;
        }
        let answers = awaited.answers().map(|format| (usize::MAX, format));
        let all = answers.chain(awaited.unasked().map(|(format, slot)| (slot, format)));
        let (slot, format) = match judge_can(all, bindings, frame) {
            Ok(found) => found,
            Err(why) => return frames.rejected(why),
        };
        frames.take_device(format, texts, frame.data(), slot, accepted)?;
        self.sender.frames_accepted(1, usable, &mut self.counters, now);
        Ok(())
    }

    /// The next request, if the line is free for one.
    fn next_request(
        &mut self,
        image: &Image,
        bindings: Outputs<'_>,
        mut view: View<'_>,
        out: &mut [u8],
        now: Instant,
    ) -> Option<Downward> {
        if !self.is_usable() {
            return None;
        }
        let is_busy = self.sender.is_busy() || now < self.line.quiet_at();
        let Codec::Device(codec) = &mut self.codec else { return None };
        // Apart from the rest of the codec, which makes the frames.
        let mut line = codec.line.take()?;
        let (items, mut talks) = view.of(&line);
        let maker = Maker { image, bindings, codec, sender: &self.sender, reply: self.reply, now };
        let request = maker.next(&mut line, items, &mut talks, &mut self.counters, is_busy, out);
        let is_on_can = codec.reader.is_none();
        if let (Some(_), Some(Reader::Search(framer))) = (&request, &mut codec.reader)
            && !line.hears_unasked
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
            return Some(Downward::Bytes(len));
        }
        let item = view_item(&mut view, self.line()?, item)?;
        if let Asks::Remote { id, len } = item.asks {
            return CanFrame::remote(id, len.into()).map(Downward::Can);
        }
        let frame = out.get(..len).unwrap_or(&[]);
        let id = item.request.as_ref()?.id;
        Some(Downward::Can(CanFrame::cut(id, frame)))
    }

    /// The request has left.
    fn talk_sent(&mut self, mut view: View<'_>, now: Instant) {
        let (timing, is_on_can) = (self.line, self.is_on_can());
        let Some(line) = self.line_mut() else { return };
        let (items, mut talks) = view.of(line);
        let times = |nth: u8| items.get(usize::from(nth)).map(|item| item.times);
        // A bus is free for others while a reply is awaited.
        if line.sent(&mut talks, times, &timing, now) && !is_on_can {
            self.sender.hold();
        }
    }

    /// Pauses end, and replies that have not come fail.
    fn advance_talk(&mut self, mut view: View<'_>, now: Instant) {
        let (timing, is_on_can) = (self.line, self.is_on_can());
        let Some(line) = self.line_mut() else { return };
        line.advance(now);
        let Some(failure) = line.failure(&timing, now) else { return };
        let (items, mut talks) = view.of(line);
        let Some(item) = items.get(usize::from(failure.0.exchange)) else { return };
        let is_over = line.failed(&mut talks, failure, item.times, now);
        // A bus was not held while the reply was awaited: a frame of the cycle may be on its way.
        if !is_on_can {
            self.sender.sent();
        }
        if is_over {
            bump(&mut self.counters.unanswered);
        }
    }

    fn abandon_talk(&mut self, mut view: View<'_>, now: Instant) {
        let is_on_can = self.is_on_can();
        let Some(line) = self.line_mut() else { return };
        let was_waiting = matches!(line.phase, Phase::Waiting(_));
        let (_, mut talks) = view.of(line);
        line.abandon(&mut talks, now);
        if was_waiting && !is_on_can {
            self.sender.sent();
        }
    }

    fn begin_talk(&mut self, mut view: View<'_>, now: Instant) {
        if let Codec::Device(DeviceCodec { reader: Some(Reader::Slave(slave)), .. }) = &mut self.codec {
            // What came while the line was not there is too old to be answered.
            add(&mut self.counters.discarded_bytes, slave.discard());
        }
        let Some(line) = self.line_mut() else { return };
        let (items, mut talks) = view.of(line);
        for item in items {
            (item.digest, item.last_bit, item.is_owed) = (None, None, false);
        }
        line.begin(&mut talks, now);
        line.looks = line.looks.map(|grid| crate::schedule::Grid::starting_at(now, grid.period()));
    }
}

fn view_item<'v>(view: &'v mut View<'_>, line: &Line, nth: u8) -> Option<&'v Item> {
    view.of(line).0.get(usize::from(nth))
}

/// Counts an answer at its port and peer; a refusal comes with its code.
fn note_answer(talks: &mut Talks<'_>, counters: &mut PortCounters, flight: Flight, refusal: Option<u8>) {
    if refusal.is_some() {
        bump(&mut counters.refused);
    }
    let Some(peer) = talks.peer_of(flight) else { return };
    match refusal {
        None => bump(&mut peer.counters.replies),
        Some(code) => {
            bump(&mut peer.counters.refused);
            peer.counters.refusal = code;
        }
    }
}

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize, const TAP: usize, const EXCHANGES: usize>
    Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>
{
    /// The output of a request, with its record.
    #[cold]
    #[inline(never)]
    pub(super) fn request_output<'b>(
        &mut self,
        (port, request): (PortId, Downward),
        buf: &'b [u8; OUTPUT_BUFFER],
        now: Instant,
    ) -> Output<'b> {
        match request {
            Downward::Bytes(len) => {
                let bytes = buf.get(..len).unwrap_or(&[]);
                self.tap.went(TapPlace::Port(port), None, bytes, now);
                Output::PortSend { port, bytes }
            }
            Downward::Can(frame) => {
                self.tap.went(TapPlace::Port(port), Some(frame.id()), frame.data(), now);
                Output::PortSendCan { port, frame }
            }
        }
    }

    /// Takes bytes; false if the port's recipe has no exchanges.
    #[cold]
    #[inline(never)]
    pub(super) fn talk_bytes(&mut self, id: PortId, bytes: &[u8], now: Instant) -> bool {
        let Some(port) = find_port(&mut self.ports, id) else { return false };
        if port.line().is_none() {
            return false;
        }
        if self.clock.is_deaf {
            port.discard(bytes, None, &mut self.tap, now);
            return true;
        }
        port.heard(bytes, now);
        if port.hears_master(bytes, now) {
            self.after_talk(id);
            return true;
        }
        let mut rest = bytes;
        loop {
            let (store, command) = (&mut self.store, self.links.command.first_mut());
            let Some(port) = find_port(&mut self.ports, id) else { return true };
            let (inputs, view) = (&self.bindings.inputs, self.exchanges.view());
            let accepted = port.talk_frames(&mut rest, inputs, store, command, &mut self.tap, view);
            self.after_talk(id);
            self.after_field(id, &accepted, now);
            if rest.is_empty() {
                return true;
            }
        }
    }

    /// Takes a frame; false if the port's recipe has no exchanges.
    #[cold]
    #[inline(never)]
    pub(super) fn talk_can(&mut self, id: PortId, frame: &CanFrame, now: Instant) -> bool {
        let (store, command) = (&mut self.store, self.links.command.first_mut());
        let Some(port) = find_port(&mut self.ports, id) else { return false };
        if port.line().is_none() {
            return false;
        }
        if self.clock.is_deaf {
            port.discard(frame.data(), Some(frame.id()), &mut self.tap, now);
            return true;
        }
        let mut accepted = Accepted::default();
        let (inputs, view) = (&self.bindings.inputs, self.exchanges.view());
        let verdict = port.talk_frame(frame, inputs, store, command, view, &mut accepted);
        self.tap.record(|| came(id, now, verdict, Some(frame.id()), [frame.data(), &[], &[]]));
        if verdict.is_ok() || verdict.is_err_and(|why| port.is_news(why, now)) {
            keep_why(&mut port.last_rejection, verdict, &mut self.store, Some(frame.id()), frame.data());
        }
        self.after_talk(id);
        self.after_field(id, &accepted, now);
        true
    }

    /// The line may be free, or wait for something else.
    fn after_talk(&mut self, id: PortId) {
        self.clock.ask.add(Ask::PORTS);
        if let Some(port) = find_port(&mut self.ports, id) {
            port.note_partial();
            // Each by itself: what is due already must not hide the other.
            let (deadlines, has_failed) =
                ([port.deadline(), port.talk_deadline()], port.has_failed(self.clock.now));
            deadlines.into_iter().for_each(|at| self.arm(at));
            if has_failed {
                // A wrong reply came before the request had left, and the line is silent already.
                self.clock.timer_at = self.clock.timer_at.min(self.clock.now);
            }
        }
    }

    #[cold]
    #[inline(never)]
    pub(super) fn talk_sent(&mut self, id: PortId) {
        if let Some(port) = find_port(&mut self.ports, id) {
            port.talk_sent(self.exchanges.view(), self.clock.now);
            self.after_talk(id);
        }
    }

    /// The device is there.
    pub(super) fn talk_begins(&mut self, id: PortId) {
        if let Some(port) = find_port(&mut self.ports, id) {
            port.begin_talk(self.exchanges.view(), self.clock.now);
            self.after_talk(id);
        }
    }

    /// The device is gone.
    pub(super) fn talk_ends(&mut self, id: PortId) {
        if let Some(port) = find_port(&mut self.ports, id) {
            port.abandon_talk(self.exchanges.view(), self.clock.now);
        }
    }

    /// The gateway slept.
    pub(super) fn talk_slept(&mut self) {
        for port in &mut self.ports {
            port.abandon_talk(self.exchanges.view(), self.clock.now);
        }
    }

    #[cold]
    #[inline(never)]
    pub(super) fn advance_talk(&mut self, now: Instant) {
        for index in 0..self.ports.len() {
            let Some(port) = self.ports.get_mut(index) else { break };
            port.advance_talk(self.exchanges.view(), now);
            if port.is_asked(now) {
                let id = port.id;
                self.serve(id, now);
            }
        }
    }

    /// A master's request has ended.
    fn serve(&mut self, id: PortId, now: Instant) {
        self.show_health(now);
        let (store, command) = (&mut self.store, self.links.command.first_mut());
        let Some(port) = find_port(&mut self.ports, id) else { return };
        if self.clock.is_deaf {
            return port.discard_partial(&mut self.tap, now);
        }
        let bindings = (&self.bindings.inputs[..], self.bindings.outputs());
        let accepted = port.serve(bindings, store, command, &mut self.tap, self.exchanges.view());
        self.after_talk(id);
        self.after_field(id, &accepted, now);
    }

    #[cold]
    #[inline(never)]
    pub(super) fn talk_deadline(&self) -> Instant {
        if self.clock.is_deaf {
            return Instant::NEVER;
        }
        self.ports.iter().map(FieldPort::talk_deadline).min().unwrap_or(Instant::NEVER)
    }

    /// The next request of a port.
    #[cold]
    #[inline(never)]
    pub(super) fn next_request(&mut self, out: &mut [u8], now: Instant) -> Option<(PortId, Downward)> {
        if self.clock.is_deaf {
            return None;
        }
        if self.ports.iter().any(|port| port.line().is_some_and(|line| line.is_free(now))) {
            self.show_health(now);
        }
        let mut first = Instant::NEVER;
        let mut found = None;
        for port in &mut self.ports {
            if found.is_none()
                && let Some(len) = port.next_reply(out, now)
            {
                found = Some((port.id, Downward::Bytes(len)));
            }
            if found.is_some() || !port.line().is_some_and(|line| line.is_free(now)) {
                continue;
            }
            let view = self.exchanges.view();
            let request = port.next_request(&self.store.image, self.bindings.outputs(), view, out, now);
            found = request.map(|downward| (port.id, downward));
            // What is due already must not hide another port's.
            first = Some(port.talk_deadline()).filter(|at| *at > now).map_or(first, |at| first.min(at));
        }
        self.arm(first);
        found
    }
}
