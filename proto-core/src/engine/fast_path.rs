//! Inputs of which nothing comes while the engine sleeps and no deadline has come: bytes that continue a frame and do not
//! end it, CAN frames for other nodes, pieces of a state packet, reports that something was sent, ticks before anything is due
//! (docs/engine.md section 1).
//!
//! In: any input. Out: it is kept and counted here, or it goes the long way, with nothing changed. Does not know what
//! comes of frames.

use super::Engine;
use super::find_port;
use super::io::{Handled, Input, LinkId, PortId};
use crate::recipe::Found;
use crate::time::Instant;

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize, const TAP: usize, const EXCHANGES: usize>
    Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>
{
    // Each has its own function, and goes on to the next one as a jump: nothing pays for another's registers.
    #[inline(never)]
    pub(super) fn handle_other(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        match *input {
            Input::PortBytes { bytes, .. } if bytes.len() <= SHORT => self.handle_chunk(now, input),
            Input::PortBytes { .. } => self.handle_bytes(now, input),
            Input::PortCan { .. } => self.handle_can(now, input),
            Input::PortSent { .. } => self.handle_port_sent(now, input),
            Input::LinkBytes { link: LinkId::STATE, .. } => self.handle_state(now, input),
            Input::LinkSent { .. } => self.handle_link_sent(now, input),
            Input::Tick => self.handle_tick(now, input),
            _ => self.handle_any(now, input),
        }
    }

    /// A byte or a short chunk that begins or continues a frame sets at most the time at which silence ends it.
    #[inline(never)]
    fn handle_chunk(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        if let Input::PortBytes { port, bytes } = *input
            && self.clock.is_idle(now)
            && let Some(port) = find_port(&mut self.ports, port)
            && let Some(deadline) = port.hold(bytes, now)
        {
            self.clock.now = now;
            self.clock.partial_at = self.clock.partial_at.min(deadline);
            if deadline < self.clock.idle_until {
                self.clock.idle_until = Instant::ZERO;
                return Handled::Poll;
            }
            return Handled::Asleep;
        }
        self.handle_bytes(now, input)
    }

    /// Most CAN frames of a busy bus are for other nodes.
    #[inline(never)]
    fn handle_can(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        if let Input::PortCan { port, ref frame } = *input
            && self.clock.is_idle(now)
            && !self.tap.is_listening()
            && let Some(port) = find_port(&mut self.ports, port)
            && let Some(found) = port.find_can(frame)
        {
            if found == Found::NONE && port.passes_by(frame, now) {
                self.clock.now = now;
                return Handled::Asleep;
            }
            return self.handle_frame(found, now, input);
        }
        self.handle_unseen(now, input)
    }

    // On its own, so that a frame that was looked up does not pay for having been.
    #[cold]
    #[inline(never)]
    fn handle_unseen(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        self.handle_frame(Found::NOT_LOOKED_UP, now, input)
    }

    /// Most pieces of the state stream do not complete a packet.
    #[inline(never)]
    fn handle_state(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        if let Input::LinkBytes { bytes, .. } = *input
            && self.clock.is_idle(now)
            && !self.tap.is_listening()
            && let Some(link) = self.links.state.first_mut()
            && link.hold(bytes, now)
        {
            self.clock.now = now;
            return Handled::Asleep;
        }
        self.handle_any(now, input)
    }

    /// Most ticks come before anything is due.
    #[inline(never)]
    fn handle_tick(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        if self.clock.is_idle(now) {
            self.clock.now = now;
            self.announce_anew();
            return Handled::Poll;
        }
        self.handle_any(now, input)
    }

    /// Most transmissions are over before the port has something else to send.
    #[inline(never)]
    fn handle_port_sent(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        if let Input::PortSent { port } = *input
            && self.clock.is_asleep(now)
            && !self.exchanges.is_used()
            && let Some(port) = find_port(&mut self.ports, port)
            && port.sender.sent_before_next()
        {
            self.clock.now = now;
            return Handled::Asleep;
        }
        self.handle_any(now, input)
    }

    /// The same of a link.
    #[inline(never)]
    fn handle_link_sent(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        if let Input::LinkSent { link } = *input
            && self.clock.is_asleep(now)
            && let Some(deadline) =
                self.links.sent_before_next(link, &self.store.outbox, self.clock.idle_until)
        {
            self.clock.now = now;
            self.arm(deadline);
            return Handled::Asleep;
        }
        self.handle_any(now, input)
    }

    /// Takes bytes that only continue or begin a frame, which are most calls of a driver that reports each byte.
    /// `false` if they have to be looked at; then nothing was taken.
    #[inline(never)]
    pub(super) fn hold(&mut self, id: PortId, bytes: &[u8], now: Instant) -> bool {
        if self.clock.has_slept {
            return false;
        }
        let Some(port) = find_port(&mut self.ports, id) else { return false };
        let Some(deadline) = port.hold(bytes, now) else { return false };
        self.clock.partial_at = self.clock.partial_at.min(deadline);
        true
    }
}

/// Bytes that a driver may report before a frame is complete. More are likely to have its end.
pub(super) const SHORT: usize = 16;
