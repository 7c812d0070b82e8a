//! The engine independent of its capacities, and its dispatcher: which part handles an input, and which has the next
//! output.
//!
//! In: inputs of the driver, the time. Out: the next output. Does not know how the parts work.

mod device_links;
mod exchanges;
mod health;
mod links;
pub(crate) mod time;

use heapless::{Vec, VecView};

use crate::config::MAX_SAFE_VALUES;
use crate::engine::OUTPUT_BUFFER;
use crate::engine::clock::{Clock, Dirty};
use crate::engine::counters::add;
use crate::engine::field::bindings::Bindings;
use crate::engine::field::exchanges::Exchanges;
use crate::engine::field::frames::Accepted;
use crate::engine::field::health::PortsHealth;
use crate::engine::field::output::FieldFrame;
use crate::engine::field::port::{FieldPort, find_port};
use crate::engine::io::{BusState, Handled, Input, Output, PortId};
use crate::engine::link::links::Links;
use crate::engine::tap::{Tap, TapPlace};
use crate::engine::values::bits::SafeBytes;
use crate::engine::values::store::Store;
use crate::link::LinkAction;
use crate::time::Instant;
use crate::wire::can::CanFrame;

/// Longer input is likely to complete a frame, so it skips the fast path.
const SHORT: usize = 16;

/// The parts of an engine without its capacities, so that the code exists only once.
pub(crate) struct EngineView<'e> {
    pub clock: &'e mut Clock,
    pub links: Links<'e>,
    pub store: &'e mut Store,
    pub ports: &'e mut VecView<FieldPort>,
    pub bindings: Bindings<'e>,
    pub safe_values: &'e mut Vec<SafeBytes, MAX_SAFE_VALUES>,
    pub health: &'e mut PortsHealth,
    pub exchanges: Exchanges<'e>,
    pub tap: &'e mut Tap,
}

/// The fast path for bytes that begin or continue a frame without ending it, which are most calls of a driver that
/// reports every byte: at most they set the time at which silence ends the frame. `None` if the bytes have to be
/// examined; nothing was taken then.
// Without it, a frame byte by byte to UDP takes 10141 instructions.
#[inline(always)]
pub(crate) fn hold(
    clock: &mut Clock,
    ports: &mut [FieldPort],
    port: PortId,
    bytes: &[u8],
    now: Instant,
) -> Option<Handled> {
    if bytes.len() > SHORT {
        return None;
    }
    let deadline = find_port(ports, port)?.hold(bytes, now)?;
    clock.now = now;
    clock.partial_at = clock.partial_at.min(deadline);
    if deadline < clock.idle_until {
        clock.idle_until = Instant::ZERO;
        return Some(Handled::Poll);
    }
    Some(Handled::Asleep)
}

impl EngineView<'_> {
    /// Removes the configuration. The caller empties the store.
    pub(crate) fn clear(&mut self) {
        *self.clock = Clock::START;
        let Links { host, command, state, modbus, recipes, devices } = &mut self.links;
        host.clear();
        command.clear();
        state.clear();
        modbus.clear();
        recipes.clear();
        devices.clear();
        self.ports.clear();
        let Bindings { inputs, outputs, sendable } = &mut self.bindings;
        inputs.clear();
        outputs.clear();
        sendable.clear();
        self.safe_values.clear();
        self.health.clear();
        let Exchanges { items, rows, peers, written: _ } = &mut self.exchanges;
        items.clear();
        rows.clear();
        peers.clear();
    }

    /// See [`crate::engine::Engine::make_safe`].
    pub(crate) fn make_safe(&mut self) {
        self.store.all_overdue();
        self.clock.timer_at = Instant::ZERO;
        self.clock.idle_until = Instant::ZERO;
        self.clock.dirty.add(Dirty::ALL);
    }

    /// See [`crate::engine::Engine::handle`].
    pub(crate) fn handle(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        let was_asleep = self.clock.is_asleep(now);
        let now = self.begin(was_asleep, now);
        // Any input may set an earlier deadline. A deadline that becomes later is noticed when the old one passes.
        match *input {
            Input::PortBytes { port, bytes } => self.port_bytes(port, bytes, now),
            Input::PortCan { port, ref frame } => self.port_can(port, frame, now),
            Input::PortSent { port } => self.port_sent(port),
            // Such a port is up while its connection is.
            Input::PortUp { port } | Input::PortDown { port } if self.has_connection(port) => {}
            Input::PortUp { port } => self.port_up(port),
            Input::PortDown { port } => self.port_down(port, now),
            Input::PortBus { port, state } => self.port_bus(port, state, now),
            Input::LinkUp { link } => self.link_up(link),
            Input::LinkDown { link } => self.link_down(link),
            Input::LinkBytes { link, bytes } => self.link_bytes(link, bytes, now),
            Input::LinkSent { link } => self.link_sent(link),
            Input::LinkAcked { link, left } => self.link_acked(link, left),
            Input::Tick => self.tick(now),
        }
        self.end(was_asleep)
    }

    /// The next output.
    pub(crate) fn poll_work<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        self.clock.idle_until = Instant::ZERO;
        let now = self.clock.forward(now);
        if now >= self.clock.timer_at {
            self.clock.dirty.add(Dirty::ALL);
        }
        if self.clock.dirty.has(Dirty::LINKS) && !self.clock.is_overdue {
            // A connection may have to be closed before a command can be sent.
            self.clock.dirty.add(Dirty::ACTIONS.when(!self.links.command.is_empty()));
            self.store.now = now;
            let upward = self.links.next_link_frame(&mut self.clock.dirty, self.store, &mut buf[..]);
            self.pass_on_outcomes();
            if let Some((link, len, deadline)) = upward {
                self.arm(deadline);
                let bytes = buf.get(..len).unwrap_or(&[]);
                self.tap.went(TapPlace::Link(link), None, bytes, now);
                return Output::LinkSend { link, bytes };
            }
            // Commands that stop the robot are checked in every call, even before a deadline.
            self.clock.dirty.remove(Dirty::LINKS);
            self.clock.dirty.add(Dirty::LINKS.when(self.links.has_stops()));
        }
        if self.clock.dirty.has(Dirty::ACTIONS) {
            if let Some((link, action)) = self.links.next_action() {
                return match action {
                    LinkAction::Open => {
                        Output::LinkOpen { link, to: self.links.endpoint(link, &mut buf[..]) }
                    }
                    LinkAction::Close => Output::LinkClose { link },
                };
            }
            self.clock.dirty.remove(Dirty::ACTIONS);
        }
        if self.clock.dirty.has(Dirty::PORTS) && !self.clock.is_overdue {
            match self.next_field_frame(&mut buf[..], now) {
                Some((port, FieldFrame::Bytes(len))) => {
                    let bytes = buf.get(..len).unwrap_or(&[]);
                    self.tap.went(TapPlace::Port(port), None, bytes, now);
                    return Output::PortSend { port, bytes };
                }
                Some((port, FieldFrame::Can(frame))) => {
                    self.tap.went(TapPlace::Port(port), Some(frame.id()), frame.data(), now);
                    return Output::PortSendCan { port, frame };
                }
                None if self.exchanges.is_used() => return self.poll_request(now, buf),
                None => self.clock.dirty.remove(Dirty::PORTS),
            }
        }
        debug_assert!(
            self.clock.is_overdue || self.all_are_silent(&mut buf[..], now),
            "a port or link that was not asked has an output"
        );
        self.poll_sleep()
    }

    /// The next request to a device, or sleep.
    #[cold]
    fn poll_request<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        if let Some(request) = self.next_request(&mut buf[..], now) {
            return self.request_output(request, buf, now);
        }
        self.clock.dirty.remove(Dirty::PORTS);
        debug_assert!(self.all_are_silent(&mut buf[..], now), "a port that was asked has an output");
        self.poll_sleep()
    }

    /// For assertions: whether the ports and links that were not checked really have no output.
    pub(crate) fn all_are_silent(&mut self, out: &mut [u8], now: Instant) -> bool {
        self.links.next_link_frame(&mut { Dirty::ALL }, self.store, out).is_none()
            && self.links.next_action().is_none()
            && self.next_field_frame(out, now).is_none()
            && !(self.exchanges.is_used() && self.next_request(out, now).is_some())
    }

    fn port_bytes(&mut self, id: PortId, bytes: &[u8], now: Instant) {
        // After sleep the age of the bytes is unknown.
        if !self.clock.has_slept && hold(self.clock, self.ports, id, bytes, now).is_some() {
            return;
        }
        if self.exchanges.is_used() && self.exchange_bytes(id, bytes, now) {
            return;
        }
        let (mut rest, mut is_first) = (bytes, true);
        loop {
            let (store, command) = (&mut *self.store, self.links.command.first_mut());
            let Some(port) = find_port(self.ports, id) else { return };
            if is_first {
                if self.clock.has_slept {
                    return port.discard(bytes, None, self.tap, now);
                }
                port.heard(bytes, now);
                is_first = false;
            }
            let accepted = port.frames(&mut rest, self.bindings.inputs, store, command, self.tap);
            if let Some(deadline) = port.deadline_of_heard(&mut self.clock.dirty) {
                self.arm(deadline);
            }
            self.after_frame(id, &accepted, now);
            if rest.is_empty() {
                return;
            }
        }
    }

    /// The line was silent, which ends a device frame. The caller arms the timer.
    pub(crate) fn port_silent(&mut self, id: PortId, now: Instant) {
        if self.clock.has_slept {
            // The age of the partial frame is unknown.
            if let Some(port) = find_port(self.ports, id) {
                port.discard_partial(self.tap, now);
                // What remains of the frame ends with a silence counted from now.
                port.heard(&[], now);
            }
            return;
        }
        let (store, command) = (&mut *self.store, self.links.command.first_mut());
        let Some(port) = find_port(self.ports, id) else { return };
        let accepted = port.device_frames(&mut &[][..], self.bindings.inputs, store, command, self.tap);
        port.note_partial();
        self.after_field(id, &accepted, now);
    }

    fn port_can(&mut self, id: PortId, frame: &CanFrame, now: Instant) {
        if self.exchanges.is_used() && self.exchange_can(id, frame, now) {
            return;
        }
        let (store, command) = (&mut *self.store, self.links.command.first_mut());
        let Some(port) = find_port(self.ports, id) else { return };
        if self.clock.has_slept {
            return port.discard(frame.data(), Some(frame.id()), self.tap, now);
        }
        let accepted = port.can(frame, self.bindings.inputs, store, command, self.tap);
        if accepted.frames == 0 {
            // Most frames are for other nodes of the bus.
            return;
        }
        if let Some(deadline) = port.deadline_of_heard(&mut self.clock.dirty) {
            self.arm(deadline);
        }
        self.after_frame(id, &accepted, now);
    }

    pub(crate) fn port_sent(&mut self, id: PortId) {
        self.change_port(id, |port| port.sender.sent());
        if self.exchanges.is_used() {
            self.exchange_sent(id);
        }
    }

    pub(crate) fn port_up(&mut self, id: PortId) {
        self.change_port(id, FieldPort::up);
        self.exchanges_begin(id);
        self.report_alive(self.clock.now);
    }

    pub(crate) fn port_down(&mut self, id: PortId, now: Instant) {
        let Some(port) = find_port(self.ports, id) else { return };
        self.clock.dirty.add(Dirty::ALL);
        port.down(self.bindings.inputs, self.links.command.first_mut(), self.tap, now);
        self.exchanges_end(id);
        self.drop_commands_of_gone(now);
        self.report_alive(now);
    }

    fn port_bus(&mut self, id: PortId, state: BusState, now: Instant) {
        let Some(port) = find_port(self.ports, id) else { return };
        self.clock.dirty.add(Dirty::ALL);
        let was_off = port.bus == BusState::BusOff;
        port.bus_state(state, self.bindings.inputs, self.links.command.first_mut(), now);
        let deadline = port.deadline();
        self.arm(deadline);
        match (was_off, state == BusState::BusOff) {
            (false, true) => self.exchanges_end(id),
            (true, false) => self.exchanges_begin(id),
            _ => {}
        }
        self.drop_commands_of_gone(now);
        self.report_alive(now);
    }

    /// Drops commands of devices that are gone.
    pub(crate) fn drop_commands_of_gone(&mut self, now: Instant) {
        if let Some(command) = self.links.command.first_mut() {
            command.drop_commands_of_gone(now);
            let deadline = command.deadline();
            self.arm(deadline);
        }
        self.pass_on_outcomes();
    }

    fn change_port(&mut self, id: PortId, change: impl FnOnce(&mut FieldPort)) {
        if let Some(port) = find_port(self.ports, id) {
            change(port);
            self.clock.dirty.add(Dirty::PORTS);
            let deadline = port.deadline();
            self.arm(deadline);
        }
    }

    /// Reports dropped values and results of commands to their ports.
    pub(crate) fn carry_results(&mut self) {
        self.pass_on_outcomes();
        if self.store.take_has_lost() {
            for (port, queue) in self.ports.iter_mut().zip(self.store.edges.iter_mut()) {
                add(&mut port.counters.values_expired, core::mem::take(&mut queue.lost) as usize);
            }
        }
    }

    pub(crate) fn pass_on_outcomes(&mut self) {
        let Some(command) = self.links.command.first_mut() else { return };
        command.outcomes.take(|outcome| {
            if let Some(port) = find_port(self.ports, outcome.port) {
                port.command_ended(outcome);
            }
        });
    }

    /// [`Self::after_frame`] out of line, for callers that can afford a call.
    pub(crate) fn after_field(&mut self, port: PortId, accepted: &Accepted, now: Instant) {
        self.after_frame(port, accepted, now);
    }

    /// After a field frame: checks trigger bits, and frames that wait for others.
    #[inline(always)]
    fn after_frame(&mut self, port: PortId, accepted: &Accepted, now: Instant) {
        if accepted.frames == 0 {
            return;
        }
        self.clock.dirty.add(Dirty::LINKS.when(!self.links.command.is_empty()));
        let mut deadline = self.store.deadline();
        if deadline <= now {
            self.expire_waiting();
            deadline = self.store.deadline();
        }
        self.arm(deadline);
        if let Some(command) = self.links.command.first_mut() {
            command.drop_overtaken(now);
            let deadline = command.deadline();
            self.arm(deadline);
        }
        self.pass_on_outcomes();
        self.image_changed();
        let dirty = self.store.outbox.dirty();
        let (state, mut waits) = (&self.links.state, false);
        for link in self.links.recipes.iter_mut() {
            let wanted = dirty.and(&link.writes);
            if wanted.is_empty() {
                continue;
            }
            self.clock.dirty.add(Dirty::RECIPES);
            if !wanted.and(&accepted.set).is_empty() {
                link.offered.or_at(now);
                let state = || state.first().map(|state| state.group);
                waits = waits || link.supervisor.is_up() && !link.is_ready(self.store, state);
            }
        }
        if let Some(link) = self.links.modbus.first_mut() {
            let wanted = dirty.and(&link.writes);
            self.clock.dirty.add(Dirty::MODBUS.when(!wanted.is_empty()));
            if !wanted.and(&accepted.set).is_empty() {
                link.offered.or_at(now);
            }
        }
        if waits && let Some(port) = find_port(self.ports, port) {
            add(&mut port.counters.withheld, accepted.frames as usize);
        }
    }

    /// Values in the image changed: checks for rising trigger bits.
    pub(crate) fn image_changed(&mut self) {
        if self.store.watches_bits {
            self.check_triggers();
        }
    }

    #[cold]
    fn check_triggers(&mut self) {
        self.show_health(self.store.now);
        if self.exchanges.is_used() {
            self.check_events();
        }
        self.clock.dirty.add(Dirty::PORTS);
        let mut first = Instant::NEVER;
        for port in self.ports.iter_mut() {
            let usable = port.is_usable();
            port.sender.image_changed(&self.store.image, usable, &mut port.counters, self.store.now);
            first = first.min(port.deadline());
        }
        self.arm(first);
    }

    /// The next frame to the field.
    fn next_field_frame(&mut self, out: &mut [u8], now: Instant) -> Option<(PortId, FieldFrame)> {
        let (image, bindings) = (&self.store.image, self.bindings.outputs());
        let mut left = self.ports.len();
        for port in self.ports.iter_mut() {
            left = left.wrapping_sub(1);
            if port.may_send(now)
                && let Some(downward) = port.next_output(image, bindings, out, now)
            {
                port.sender.take_due_since().record(now, &mut self.store.latency.lateness);
                // The ports before it had nothing to send.
                if left == 0 && !port.sender.is_due() && !self.exchanges.is_used() {
                    self.clock.dirty.remove(Dirty::PORTS);
                }
                return Some((port.id, downward));
            }
        }
        None
    }
}
