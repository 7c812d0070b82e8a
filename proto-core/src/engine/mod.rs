//! The gateway: one run loop over field ports and controller links, without I/O (docs/engine.md).
//!
//! One rule: change the engine once with [`Engine::handle`], then drain [`Engine::poll_output`]
//! until it returns [`Output::Sleep`]. Polling early is harmless. The engine never reads a clock,
//! never sleeps, never does I/O and never allocates; the work of a call is bounded by the size of
//! the configuration and of its input.
//!
//! Arrival decides what is late: only [`Input::Tick`] lets a deadline pass, so input that waited
//! while the driver was busy still counts. After more than [`ASLEEP`] without a call the age of
//! such input is unknown, and it is discarded.
//!
//! Errors of a device or of the controller are counted and skipped. They are never an error of the
//! run loop. Nothing is applied in part, but for frames of devices, whose fields are judged one by one.

mod accessors;
mod bits;
mod build;
mod build_error;
mod clock;
mod codecs;
mod command_link;
mod command_tables;
mod confirmed;
mod connection;
mod counters;
mod counts;
mod device_frame;
mod device_link;
mod device_port;
mod dropped;
mod events;
mod exchange;
mod exchanges;
mod failed;
mod field_output;
mod field_port;
mod flight;
mod frames;
mod io;
mod latency;
mod line;
mod line_timing;
mod link_input;
mod links;
mod modbus_link;
mod modbus_poll;
mod modbus_tcp;
mod other_text;
mod outbox;
mod outcome;
mod pending;
mod plan;
mod port_health;
mod rejection;
mod requests;
mod rules;
mod sender;
mod served;
mod session;
mod state_link;
mod status;
#[cfg(feature = "serde")]
mod status_serde;
mod stops;
mod store;
mod tap;
mod turns;
mod uplink;
mod user;
mod whole_port;
mod withheld;

pub use build_error::BuildError;
pub use clock::ASLEEP;
pub use counters::{LinkCounters, PortCounters};
pub use dropped::{DropReason, DroppedCommand};
pub use events::Outcome;
pub use failed::FailedCommand;
pub use io::{
    BusState, Endpoint, Handled, Input, LinkId, LinkKind, Output, PortId, PortState, ReplyCode, Transport,
};
pub use latency::Latency;
pub use line::{EventCounters, PeerCounters};
pub use links::LinkInfo;
pub use other_text::{MAX_OTHER_TEXT, OtherText};
pub use plan::{Plan, PlanError, Route, Source};
pub use rejection::{KEPT_BYTES, LastRejection, RejectedField, Rejection};
pub use rules::{Taken, judge_field};
pub use status::{ControllerStatus, FieldBus, Health, PeerStatus, PortStatus, Status, VariableStatus};
pub use stops::COMMAND_QUEUE;
pub use tap::{MAX_TAPPED, TAP_OVERHEAD, Tap, TapDirection, TapPlace, TapRecord, TapVerdict};

use heapless::Vec;

use clock::{Clock, Dirty};
use counters::add;
use exchanges::Exchanges;
use field_output::Downward;
use field_port::{FieldPort, find_port};
use frames::Accepted;
use links::Links;
use port_health::PortsHealth;
use store::{SafeBytes, Store};
use user::Bindings;

use crate::config::{MAX_EXCHANGES, MAX_SAFE_VALUES};
use crate::link::LinkAction;
use crate::recipe::model::MAX_STREAM_FRAME;
use crate::time::Instant;
use crate::wire::can::CanFrame;
use crate::wire::state::LEN;

/// Bytes that a driver may report before a frame is complete. More are likely to have its end.
const SHORT: usize = 16;

/// Size of the buffer for [`Engine::poll_output`]: the longest stream frame; every request to the
/// controller is shorter.
pub const OUTPUT_BUFFER: usize = MAX_STREAM_FRAME;

/// Size of a receive buffer that holds a state packet in one piece, and shows that a datagram is
/// longer than any frame. Bytes may be reported in pieces of any other size.
pub const INPUT_BUFFER: usize = 1536;
const _: () = assert!(INPUT_BUFFER >= LEN && INPUT_BUFFER > MAX_STREAM_FRAME);

/// The gateway engine for up to `PORTS` field ports, `UPLINKS` recipe links and, over all ports,
/// `FIELDS` user-defined input fields and as many output fields.
///
/// `TAP` bytes are for the ring of [`Engine::tap`], and `EXCHANGES` is the number of exchanges with
/// devices over all ports; 0 costs nothing. The defaults are the maximum of a file.
///
/// `Engine<4, 1, 128, 0, 0>` takes less than 42 KiB.
// In this order, because an engine is larger than what one instruction reaches: what every call looks at
// comes first, what only some configurations have comes last.
#[derive(Debug, Clone)]
#[repr(C)]
pub struct Engine<
    const PORTS: usize = 8,
    const UPLINKS: usize = 4,
    const FIELDS: usize = 512,
    const TAP: usize = 0,
    const EXCHANGES: usize = MAX_EXCHANGES,
> {
    clock: Clock,
    links: Links<UPLINKS>,
    store: Store<PORTS>,
    ports: Vec<FieldPort, PORTS>,
    bindings: Bindings<FIELDS>,
    safe_values: Vec<SafeBytes, MAX_SAFE_VALUES>,
    health: PortsHealth,
    exchanges: Exchanges<EXCHANGES>,
    tap: Tap<TAP>,
}

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize, const TAP: usize, const EXCHANGES: usize>
    Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>
{
    /// Maximum number of links of this engine: port 2000 twice, port 2001, Modbus, and the recipe
    /// links.
    pub const MAX_LINKS: usize = UPLINKS.saturating_add(4);

    /// Reports an event, or that time has passed. `now` is the present; an instant earlier than
    /// that of the previous call counts as the previous one.
    ///
    /// Inputs for a port or link that the configuration does not have are ignored.
    ///
    /// The answer spares a driver [`Self::poll_output`] where nothing comes of an input; it may be ignored.
    pub fn handle(&mut self, now: Instant, input: Input<'_>) -> Handled {
        let handled = match input {
            _ if !self.clock.is_idle(now) => None,
            Input::PortBytes { port, bytes } => self.hold(port, bytes, now),
            _ => self.handle_idle(now, &input),
        };
        handled.unwrap_or_else(|| self.handle_awake(now, &input))
    }

    // Out of line to keep its stack frame off the fast path.
    #[inline(never)]
    fn handle_awake(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        let was_asleep = self.clock.is_asleep(now);
        let now = self.begin(was_asleep, now);
        // Any input may set an earlier deadline; one that becomes later is noticed in time.
        match *input {
            Input::PortBytes { port, bytes } => self.port_bytes(port, bytes, now),
            Input::PortCan { port, ref frame } => self.port_can(port, frame, now),
            Input::PortSent { port } => self.port_sent(port),
            // A port is there while its connection is.
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

    /// The fast path for bytes that begin or continue a frame and do not end it, which are most calls of a driver that
    /// reports each byte: they set at most the time at which silence ends it. `None` if they have to be looked at; then
    /// nothing was taken.
    // A frame byte by byte to UDP takes 10141 instructions without it, 5033 out of line, and 4313 inline.
    #[inline(always)]
    fn hold(&mut self, port: PortId, bytes: &[u8], now: Instant) -> Option<Handled> {
        if bytes.len() > SHORT {
            return None;
        }
        let deadline = find_port(&mut self.ports, port)?.hold(bytes, now)?;
        self.clock.now = now;
        self.clock.partial_at = self.clock.partial_at.min(deadline);
        if deadline < self.clock.idle_until {
            self.clock.idle_until = Instant::ZERO;
            return Some(Handled::Poll);
        }
        Some(Handled::Asleep)
    }

    /// The fast path for other inputs of which nothing comes while the engine sleeps and no deadline has come: frames for
    /// other nodes, which are most of a busy CAN bus, pieces of a state packet, and transmissions that are over before
    /// something else is to be sent. `None` if the input has to be handled; then nothing was changed.
    // A frame to UDP takes 1257 instructions without it, and 1024 with it.
    #[inline(never)]
    fn handle_idle(&mut self, now: Instant, input: &Input<'_>) -> Option<Handled> {
        let mut handled = Handled::Asleep;
        match *input {
            Input::PortCan { port, ref frame } if !self.tap.is_listening() => {
                find_port(&mut self.ports, port)?.passes_by(frame, now).then_some(())?;
            }
            Input::LinkBytes { link: LinkId::STATE, bytes } if !self.tap.is_listening() => {
                self.links.state.first_mut()?.hold(bytes, now).then_some(())?;
            }
            // An engine without ports may have missed a beat.
            Input::PortSent { .. } | Input::LinkSent { .. } if now >= self.clock.beat_at => return None,
            Input::PortSent { port } if !self.exchanges.is_used() => {
                find_port(&mut self.ports, port)?.sender.sent_before_next().then_some(())?;
            }
            Input::LinkSent { link } => {
                let until = self.clock.idle_until;
                let deadline = self.links.sent_before_next(link, &self.store.outbox, until)?;
                self.arm(deadline);
            }
            Input::Tick => {
                self.announce_anew();
                handled = Handled::Poll;
            }
            _ => return None,
        }
        self.clock.now = now;
        Some(handled)
    }

    /// The next output for the driver. Call it again until it is [`Output::Sleep`]. Nothing is sent
    /// between a deadline and the [`Input::Tick`] that lets it pass.
    ///
    /// What stops the robot comes first, then what brings field values to the controller, then what
    /// keeps links up, then what goes to the field.
    // In a driver's loop, the addresses of all that it may need would be worked out before each pass. A board has a
    // function of its own around this one (firmware/engine): one call is enough there.
    #[cfg_attr(not(target_os = "none"), inline(never))]
    pub fn poll_output<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        if now < self.clock.idle_until {
            debug_assert!(self.clock.is_quiet(now) && !self.clock.is_overdue);
            debug_assert!(self.all_are_silent(&mut buf[..], now), "a sleeping engine has an output");
            return Output::Sleep { until: self.clock.idle_until };
        }
        if self.clock.is_quiet(now) {
            return self.sleep();
        }
        self.poll_work(now, buf)
    }

    /// The next output, if something may have one.
    #[inline(never)]
    fn poll_work<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        self.clock.idle_until = Instant::ZERO;
        let now = self.forward(now);
        if now >= self.clock.timer_at {
            self.ask_all();
        }
        if self.clock.dirty.has(Dirty::LINKS) && !self.clock.is_overdue {
            // To send a command, a connection may have to be closed first.
            self.clock.dirty.add(Dirty::ACTIONS.when(!self.links.command.is_empty()));
            self.store.now = now;
            let upward = self.links.next_upward(&mut self.clock.dirty, &mut self.store, &mut buf[..]);
            self.carry_outcomes();
            if let Some((link, len, deadline)) = upward {
                self.arm(deadline);
                let bytes = buf.get(..len).unwrap_or(&[]);
                self.tap.went(TapPlace::Link(link), None, bytes, now);
                return Output::LinkSend { link, bytes };
            }
            // Commands that stop the robot are checked in every call, even before their deadline.
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
            match self.next_downward(&mut buf[..], now) {
                Some((port, Downward::Bytes(len))) => {
                    let bytes = buf.get(..len).unwrap_or(&[]);
                    self.tap.went(TapPlace::Port(port), None, bytes, now);
                    return Output::PortSend { port, bytes };
                }
                Some((port, Downward::Can(frame))) => {
                    self.tap.went(TapPlace::Port(port), Some(frame.id()), frame.data(), now);
                    return Output::PortSendCan { port, frame };
                }
                // On its own, so that nothing else pays for its registers.
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

    // On its own, so that what is asked is read only once, behind it.
    #[inline(never)]
    fn ask_all(&mut self) {
        self.clock.dirty.add(Dirty::ALL);
    }

    /// The next request to a device, or sleep.
    #[cold]
    #[inline(never)]
    fn poll_request<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        if let Some(request) = self.next_request(&mut buf[..], now) {
            return self.request_output(request, buf, now);
        }
        self.clock.dirty.remove(Dirty::PORTS);
        debug_assert!(self.all_are_silent(&mut buf[..], now), "a port that was asked has an output");
        self.poll_sleep()
    }

    /// Whether ports and links that are not asked really have no output.
    fn all_are_silent(&mut self, out: &mut [u8], now: Instant) -> bool {
        self.links.next_upward(&mut { Dirty::ALL }, &mut self.store, out).is_none()
            && self.links.next_action().is_none()
            && self.next_downward(out, now).is_none()
            && !(self.exchanges.is_used() && self.next_request(out, now).is_some())
    }

    fn port_bytes(&mut self, id: PortId, bytes: &[u8], now: Instant) {
        // After a sleep their age is unknown.
        if !self.clock.has_slept && self.hold(id, bytes, now).is_some() {
            return;
        }
        if self.exchanges.is_used() && self.exchange_bytes(id, bytes, now) {
            return;
        }
        let (mut rest, mut is_first) = (bytes, true);
        loop {
            let (store, command) = (&mut self.store, self.links.command.first_mut());
            let Some(port) = find_port(&mut self.ports, id) else { return };
            if is_first {
                if self.clock.has_slept {
                    return port.discard(bytes, None, &mut self.tap, now);
                }
                port.heard(bytes, now);
                is_first = false;
            }
            let accepted = port.frames(&mut rest, &self.bindings.inputs, store, command, &mut self.tap);
            if let Some(deadline) = port.deadline_of_heard(&mut self.clock.dirty) {
                self.arm(deadline);
            }
            self.after_frame(id, &accepted, now);
            if rest.is_empty() {
                return;
            }
        }
    }

    /// The line was silent, which ends a device's frame. The timer is not armed.
    #[cold]
    #[inline(never)]
    fn port_silent(&mut self, id: PortId, now: Instant) {
        if self.clock.has_slept {
            // Nobody knows how long it has waited.
            if let Some(port) = find_port(&mut self.ports, id) {
                port.discard_partial(&mut self.tap, now);
                // What is left of it ends with a silence that is counted from now on.
                port.heard(&[], now);
            }
            return;
        }
        let (store, command) = (&mut self.store, self.links.command.first_mut());
        let Some(port) = find_port(&mut self.ports, id) else { return };
        let accepted = port.device_frames(&mut &[][..], &self.bindings.inputs, store, command, &mut self.tap);
        port.note_partial();
        self.after_field(id, &accepted, now);
    }

    fn port_can(&mut self, id: PortId, frame: &CanFrame, now: Instant) {
        if self.exchanges.is_used() && self.exchange_can(id, frame, now) {
            return;
        }
        let (store, command) = (&mut self.store, self.links.command.first_mut());
        let Some(port) = find_port(&mut self.ports, id) else { return };
        if self.clock.has_slept {
            return port.discard(frame.data(), Some(frame.id()), &mut self.tap, now);
        }
        let accepted = port.can(frame, &self.bindings.inputs, store, command, &mut self.tap);
        if accepted.frames == 0 {
            // Most are for other nodes of the bus.
            return;
        }
        if let Some(deadline) = port.deadline_of_heard(&mut self.clock.dirty) {
            self.arm(deadline);
        }
        self.after_frame(id, &accepted, now);
    }

    fn port_sent(&mut self, id: PortId) {
        self.change_port(id, |port| port.sender.sent());
        if self.exchanges.is_used() {
            self.exchange_sent(id);
        }
    }

    #[cold]
    fn port_up(&mut self, id: PortId) {
        self.change_port(id, FieldPort::up);
        self.exchanges_begin(id);
        self.tell_alive(self.clock.now);
    }

    #[cold]
    fn port_down(&mut self, id: PortId, now: Instant) {
        let Some(port) = find_port(&mut self.ports, id) else { return };
        self.clock.dirty.add(Dirty::ALL);
        port.down(&self.bindings.inputs, self.links.command.first_mut(), &mut self.tap, now);
        self.exchanges_end(id);
        self.drop_forgotten(now);
        self.tell_alive(now);
    }

    #[cold]
    fn port_bus(&mut self, id: PortId, state: BusState, now: Instant) {
        let Some(port) = find_port(&mut self.ports, id) else { return };
        self.clock.dirty.add(Dirty::ALL);
        let was_off = port.bus == BusState::BusOff;
        port.bus_state(state, &self.bindings.inputs, self.links.command.first_mut(), now);
        let deadline = port.deadline();
        self.arm(deadline);
        match (was_off, state == BusState::BusOff) {
            (false, true) => self.exchanges_end(id),
            (true, false) => self.exchanges_begin(id),
            _ => {}
        }
        self.drop_forgotten(now);
        self.tell_alive(now);
    }

    /// Drops commands whose device is gone.
    fn drop_forgotten(&mut self, now: Instant) {
        if let Some(command) = self.links.command.first_mut() {
            command.drop_forgotten(now);
            let deadline = command.deadline();
            self.arm(deadline);
        }
        self.carry_outcomes();
    }

    fn change_port(&mut self, id: PortId, change: impl FnOnce(&mut FieldPort)) {
        if let Some(port) = find_port(&mut self.ports, id) {
            change(port);
            self.clock.dirty.add(Dirty::PORTS);
            let deadline = port.deadline();
            self.arm(deadline);
        }
    }

    /// Passes the results of values and commands on a link on to their ports.
    fn carry_results(&mut self) {
        self.carry_outcomes();
        let Some(lost) = self.store.take_lost() else { return };
        for (port, dropped) in self.ports.iter_mut().zip(lost) {
            add(&mut port.counters.values_expired, dropped as usize);
        }
    }

    fn carry_outcomes(&mut self) {
        let Some(command) = self.links.command.first_mut() else { return };
        command.outcomes.take(|outcome| {
            if let Some(port) = find_port(&mut self.ports, outcome.port) {
                port.command_ended(outcome);
            }
        });
    }

    /// [`Self::after_frame`], on its own, where it matters less.
    #[inline(never)]
    fn after_field(&mut self, port: PortId, accepted: &Accepted, now: Instant) {
        self.after_frame(port, accepted, now);
    }

    /// After a field frame: checks bits that trigger, and frames that wait for their neighbours.
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
        self.carry_outcomes();
        self.image_changed();
        let dirty = self.store.outbox.dirty();
        let (state, mut waits) = (&self.links.state, false);
        for link in &mut self.links.recipes {
            let wanted = dirty.and(&link.writes);
            if wanted.is_empty() {
                continue;
            }
            self.clock.dirty.add(Dirty::RECIPES);
            if !wanted.and(&accepted.set).is_empty() {
                link.offered.or_at(now);
                let state = || state.first().map(|state| state.group);
                waits = waits || link.supervisor.is_up() && !link.is_ready(&self.store, state);
            }
        }
        if let Some(link) = self.links.modbus.first_mut() {
            let wanted = dirty.and(&link.writes);
            self.clock.dirty.add(Dirty::MODBUS.when(!wanted.is_empty()));
            if !wanted.and(&accepted.set).is_empty() {
                link.offered.or_at(now);
            }
        }
        if waits && let Some(port) = find_port(&mut self.ports, port) {
            add(&mut port.counters.withheld, accepted.frames as usize);
        }
    }

    /// Values in the image changed: checks for rising bits that trigger.
    fn image_changed(&mut self) {
        if self.store.watches_bits {
            self.check_triggers();
        }
    }

    // On its own, so that engines without triggers do not pay for its registers.
    #[inline(never)]
    fn check_triggers(&mut self) {
        self.show_health(self.store.now);
        if self.exchanges.is_used() {
            self.check_events();
        }
        self.clock.dirty.add(Dirty::PORTS);
        let mut first = Instant::NEVER;
        for port in &mut self.ports {
            let usable = port.is_usable();
            port.sender.image_changed(&self.store.image, usable, &mut port.counters, self.store.now);
            first = first.min(port.deadline());
        }
        self.arm(first);
    }

    /// The next output to the field.
    fn next_downward(&mut self, out: &mut [u8], now: Instant) -> Option<(PortId, Downward)> {
        let (image, bindings) = (&self.store.image, self.bindings.outputs());
        let mut left = self.ports.len();
        for port in &mut self.ports {
            left = left.wrapping_sub(1);
            if port.may_send(now)
                && let Some(downward) = port.next_output(image, bindings, out, now)
            {
                port.sender.take_due_since().record(now, &mut self.store.latency.lateness);
                // Those before it had nothing.
                if left == 0 && !port.sender.is_due() && !self.exchanges.is_used() {
                    self.clock.dirty.remove(Dirty::PORTS);
                }
                return Some((port.id, downward));
            }
        }
        None
    }
}
