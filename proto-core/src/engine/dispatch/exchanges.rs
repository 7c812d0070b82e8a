//! Exchanges on all ports: passes inputs to the right port, and finds the next request.

use super::EngineView;
use crate::engine::OUTPUT_BUFFER;
use crate::engine::clock::Dirty;
use crate::engine::field::bindings::wrapping_count;
use crate::engine::field::frames::Accepted;
use crate::engine::field::output::FieldFrame;
use crate::engine::field::port::{came, find_port, keep_why};
use crate::engine::io::{LinkId, Output, PortId};
use crate::engine::tap::TapPlace;
use crate::image::InputSet;
use crate::time::Instant;
use crate::wire::can::CanFrame;

impl EngineView<'_> {
    /// The output for a request; also records it in the tap.
    pub(crate) fn request_output<'b>(
        &mut self,
        (port, request): (PortId, FieldFrame),
        buf: &'b [u8; OUTPUT_BUFFER],
        now: Instant,
    ) -> Output<'b> {
        match request {
            FieldFrame::Bytes(len) => {
                let bytes = buf.get(..len).unwrap_or(&[]);
                self.tap.went(TapPlace::Port(port), None, bytes, now);
                match self.goes_over_link(port, now) {
                    true => Output::LinkSend { link: LinkId::of_port(port), bytes },
                    false => Output::PortSend { port, bytes },
                }
            }
            FieldFrame::Can(frame) => {
                self.tap.went(TapPlace::Port(port), Some(frame.id()), frame.data(), now);
                Output::PortSendCan { port, frame }
            }
        }
    }

    /// Takes bytes; false if the port's recipe has no exchanges.
    pub(crate) fn exchange_bytes(&mut self, id: PortId, bytes: &[u8], now: Instant) -> bool {
        let Some(port) = find_port(self.ports, id) else { return false };
        if port.line().is_none() {
            return false;
        }
        if self.clock.has_slept {
            port.discard(bytes, None, self.tap, now);
            return true;
        }
        port.heard(bytes, now);
        if port.hears_master(bytes, now) {
            self.after_exchange(id);
            return true;
        }
        let mut rest = bytes;
        loop {
            let (store, command) = (&mut *self.store, self.links.command.first_mut());
            let Some(port) = find_port(self.ports, id) else { return true };
            let (inputs, view) = (&self.bindings.inputs, self.exchanges.view());
            let accepted = port.exchange_frames(&mut rest, inputs, store, command, self.tap, view);
            self.after_exchange(id);
            self.note_overdue();
            self.after_field(id, &accepted, now);
            if rest.is_empty() {
                return true;
            }
        }
    }

    /// Takes a frame; false if the port's recipe has no exchanges.
    pub(crate) fn exchange_can(&mut self, id: PortId, frame: &CanFrame, now: Instant) -> bool {
        let (store, command) = (&mut *self.store, self.links.command.first_mut());
        let Some(port) = find_port(self.ports, id) else { return false };
        if port.line().is_none() {
            return false;
        }
        if self.clock.has_slept {
            port.discard(frame.data(), Some(frame.id()), self.tap, now);
            return true;
        }
        let mut accepted = Accepted::default();
        let (inputs, view) = (&self.bindings.inputs, self.exchanges.view());
        let verdict = port.exchange_frame(frame, inputs, store, command, view, &mut accepted);
        self.tap.record(|| came(id, now, verdict, Some(frame.id()), [frame.data(), &[], &[]]));
        if verdict.is_ok() || verdict.is_err_and(|why| port.is_news(why, now)) {
            keep_why(&mut port.last_rejection, verdict, self.store, Some(frame.id()), frame.data());
        }
        self.after_exchange(id);
        self.note_overdue();
        self.after_field(id, &accepted, now);
        true
    }

    /// Values in the image have changed: checks the bits that trigger requests, on all ports.
    pub(crate) fn check_events(&mut self) {
        let now = self.store.now;
        for nth in 0..self.ports.len() {
            let Some(port) = self.ports.get_mut(nth) else { break };
            if port.line().is_none() {
                continue;
            }
            let (id, links) = (port.id, self.links.view());
            let first_of_links = self.store.frames.len() as u8;
            let up_since = |group| links.up_since(group);
            let (image, view) = (&self.store.image, self.exchanges.view());
            // Only a tick lets a deadline pass.
            let was_due = port.has_failed(now);
            port.triggers(image, self.bindings.outputs(), view, (first_of_links, up_since), now);
            if !was_due && port.has_failed(now) {
                // A pending request yields to a stop.
                port.advance_exchange(self.exchanges.view(), now);
            }
            self.after_exchange(id);
        }
    }

    /// Reports the outcomes of events to the robot: the new ones, or all if `repeats`.
    pub(crate) fn report_outcomes(&mut self, repeats: bool) {
        let mut told = InputSet::EMPTY;
        for item in self.exchanges.items.iter_mut() {
            if !repeats && !item.is_news {
                continue;
            }
            item.is_news = false;
            let (to, state) = (item.outcome, item.reported);
            let values =
                [(to.to, state.outcome as u16), (to.code_to, state.code), (to.count_to, state.ended)];
            for (var, value) in values {
                let Some(var) = var else { continue };
                // Cannot fail: the value has the variable's type.
                let _ = self.store.image.set(var, wrapping_count(var.ty(), value.into()));
                told.insert(var);
            }
        }
        if !told.is_empty() {
            self.store.tell(&told);
            self.clock.dirty.add(Dirty::LINKS);
        }
    }

    /// Updates flags and deadlines after a change: the line may be free, or wait for something else.
    fn after_exchange(&mut self, id: PortId) {
        self.report_outcomes(false);
        self.clock.dirty.add(Dirty::PORTS);
        if let Some(port) = find_port(self.ports, id) {
            port.note_partial();
            // Armed one by one, because one that has passed must not hide the other.
            let (deadlines, has_failed) =
                ([port.deadline(), port.exchange_deadline()], port.has_failed(self.clock.now));
            deadlines.into_iter().for_each(|at| self.arm(at));
            if has_failed {
                // A wrong reply came before the request had left, and the line is already silent.
                self.tick_again();
            }
        }
    }

    /// A value is as old as the first request it may answer, so it may be overdue on arrival.
    fn note_overdue(&mut self) {
        if self.store.deadline() <= self.clock.now {
            self.tick_again();
        }
    }

    pub(crate) fn exchange_sent(&mut self, id: PortId) {
        if let Some(port) = find_port(self.ports, id) {
            port.exchange_sent(self.exchanges.view(), self.clock.now);
            self.after_exchange(id);
        }
    }

    /// The port's device is up.
    pub(crate) fn exchanges_begin(&mut self, id: PortId) {
        if let Some(port) = find_port(self.ports, id) {
            port.begin_exchange(self.exchanges.view(), self.clock.now);
            self.after_exchange(id);
        }
    }

    /// The port's device is gone.
    pub(crate) fn exchanges_end(&mut self, id: PortId) {
        if let Some(port) = find_port(self.ports, id) {
            port.abandon_exchange(self.exchanges.view(), self.clock.now);
        }
    }

    /// The gateway slept: abandons all exchanges.
    pub(crate) fn exchanges_slept(&mut self) {
        for port in self.ports.iter_mut() {
            port.abandon_exchange(self.exchanges.view(), self.clock.now);
        }
    }

    pub(crate) fn advance_exchange(&mut self, now: Instant) {
        for index in 0..self.ports.len() {
            let Some(port) = self.ports.get_mut(index) else { break };
            port.advance_exchange(self.exchanges.view(), now);
            if port.is_asked(now) {
                let id = port.id;
                self.serve(id, now);
            }
        }
    }

    /// A request of a master is complete.
    fn serve(&mut self, id: PortId, now: Instant) {
        self.show_health(now);
        let (store, command) = (&mut *self.store, self.links.command.first_mut());
        let Some(port) = find_port(self.ports, id) else { return };
        if self.clock.has_slept {
            return port.discard_partial(self.tap, now);
        }
        let bindings = (&self.bindings.inputs[..], self.bindings.outputs());
        let accepted = port.serve(bindings, store, command, self.tap, self.exchanges.view());
        self.after_exchange(id);
        self.after_field(id, &accepted, now);
    }

    /// The next request or reply, of any port.
    pub(crate) fn next_request(&mut self, out: &mut [u8], now: Instant) -> Option<(PortId, FieldFrame)> {
        if self.clock.has_slept {
            return None;
        }
        if self.ports.iter().any(|port| port.line().is_some_and(|line| line.is_free(now))) {
            self.show_health(now);
        }
        let mut first = Instant::NEVER;
        let mut found = None;
        for port in self.ports.iter_mut() {
            if found.is_none()
                && let Some(len) = port.next_reply(out, now)
            {
                found = Some((port.id, FieldFrame::Bytes(len)));
            }
            if found.is_some() || !port.line().is_some_and(|line| line.is_free(now)) {
                continue;
            }
            let view = self.exchanges.view();
            let request = port.next_request(&self.store.image, self.bindings.outputs(), view, out, now);
            found = request.map(|downward| (port.id, downward));
            // A deadline that has passed must not hide another port's.
            first = Some(port.exchange_deadline()).filter(|at| *at > now).map_or(first, |at| first.min(at));
        }
        self.arm(first);
        found
    }
}
