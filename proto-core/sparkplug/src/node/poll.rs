//! What a node does next.

use proto_core::time::{Duration, Instant};

use super::messages::BirthPiece;
use super::{Birth, EdgeNode, Maybe, NodeOutput, NodePhase, Owner, SessionFailure, Stage, has, owners};
use crate::bytes::ByteWriter;
use crate::catalog::Catalog;
use crate::mqtt;

impl<const METRICS: usize, const HISTORY: usize> EdgeNode<METRICS, HISTORY> {
    /// What is to be done next; asked for until it is [`NodeOutput::Sleep`]. `buf` has at least
    /// [`MIN_BUFFER`](super::MIN_BUFFER) bytes.
    pub fn poll_output<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        buf: &'b mut [u8],
    ) -> NodeOutput<'b> {
        if self.must_close {
            return self.close(now);
        }
        match self.phase {
            NodePhase::Ended => NodeOutput::Sleep { until: Instant::NEVER },
            NodePhase::Idle { .. } if self.is_ending => {
                self.phase = NodePhase::Ended;
                NodeOutput::Sleep { until: Instant::NEVER }
            }
            NodePhase::Idle { until } if now < until => NodeOutput::Sleep { until },
            NodePhase::Idle { .. } => {
                self.phase = NodePhase::Opening { until: now + OPEN_TIME };
                NodeOutput::Open
            }
            NodePhase::Opening { until } | NodePhase::Connecting { until } => {
                if self.is_ending {
                    return self.close(now);
                }
                self.wait_for_answer(now, until)
            }
            NodePhase::Keep => {
                self.phase = NodePhase::Connect;
                NodeOutput::Keep { bd_seq: self.bd_seq.unwrap_or(0) }
            }
            NodePhase::Connect => {
                self.phase = NodePhase::Connecting { until: now + ANSWER_TIME };
                let packet = self.write_connect(now, buf);
                self.send(now, packet)
            }
            NodePhase::Birth(birth) => self.poll_birth(now, catalog, birth, buf),
            NodePhase::Death => {
                self.phase = NodePhase::Disconnect;
                let packet = self.write_death(now, buf);
                self.send(now, packet)
            }
            NodePhase::Disconnect => {
                self.must_close = true;
                let packet = short(buf, mqtt::DISCONNECT, None);
                self.send(now, packet)
            }
            NodePhase::Subscribe | NodePhase::Subscribing { .. } | NodePhase::Waiting | NodePhase::Online => {
                self.poll_session(now, catalog, buf)
            }
        }
    }

    /// What may come between two packets of a session.
    fn poll_session<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        buf: &'b mut [u8],
    ) -> NodeOutput<'b> {
        if self.is_ending {
            self.phase = NodePhase::Death;
            return self.poll_output(now, catalog, buf);
        }
        if self.phase == NodePhase::Online && self.is_host_gone() {
            self.note(SessionFailure::HostOffline);
            let packet = self.write_death(now, buf);
            self.phase = NodePhase::Disconnect;
            return self.send(now, packet);
        }
        if self.pong_until.is_some_and(|until| now >= until) {
            self.note(SessionFailure::Silent);
            return self.close(now);
        }
        if let Some(id) = self.acks.pop_front() {
            let packet = short(buf, mqtt::PUBACK, Some(id));
            return self.send(now, packet);
        }
        if now >= self.ping_at && self.pong_until.is_none() {
            let interval = self.settings.ping_interval();
            (self.ping_at, self.pong_until) = (now + interval, Some(now + interval));
            let packet = short(buf, mqtt::PINGREQ, None);
            return self.send(now, packet);
        }
        let next = self.pong_until.unwrap_or(self.ping_at);
        match self.phase {
            NodePhase::Subscribe => {
                self.phase = NodePhase::Subscribing { until: now + ANSWER_TIME };
                let packet = self.write_subscribe(buf);
                self.send(now, packet)
            }
            NodePhase::Subscribing { until } => self.wait_for_answer(now, until.min(next)),
            NodePhase::Online => self.poll_online(now, catalog, buf, next),
            _ => NodeOutput::Sleep { until: next },
        }
    }

    fn poll_online<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        buf: &'b mut [u8],
        next: Instant,
    ) -> NodeOutput<'b> {
        if self.is_rebirth_wanted {
            let may_at = self.birth_at.map_or(Instant::ZERO, |at| at + BIRTH_PAUSE);
            // Nothing is told in the meantime.
            if now < may_at {
                return NodeOutput::Sleep { until: may_at.min(next) };
            }
            self.counters.rebirths = self.counters.rebirths.saturating_add(1);
            self.is_rebirth_wanted = false;
            let birth = Birth { owner: Owner::Node, stage: Stage::Begin };
            return self.poll_birth(now, catalog, birth, buf);
        }
        let mut next = next;
        for nth in (0_u8..).take(catalog.devices()) {
            match (has(self.alive, nth), has(self.born, nth)) {
                (false, true) => {
                    self.born &= !bit(nth);
                    let packet = self.write_device_death(now, catalog, nth, buf);
                    return self.send(now, packet);
                }
                (true, false) => {
                    let last = self.device_births.get(usize::from(nth)).copied().flatten();
                    let may_at = last.map_or(Instant::ZERO, |at| at + BIRTH_PAUSE);
                    if now >= may_at {
                        let birth = Birth { owner: Owner::Device(nth), stage: Stage::Begin };
                        return self.poll_birth(now, catalog, birth, buf);
                    }
                    next = next.min(may_at);
                }
                _ => {}
            }
        }
        if self.history.len() > 0 && self.has_history() {
            let packet = self.write_history(now, catalog, buf);
            return self.send(now, packet);
        }
        let told = owners(catalog.devices()).find(|owner| self.has_data(*owner));
        match told {
            Some(owner) => {
                let packet = self.write_data(now, catalog, owner, buf);
                self.send(now, packet)
            }
            None => NodeOutput::Sleep { until: next },
        }
    }

    /// The next piece of a birth, and what follows the last one.
    fn poll_birth<'b>(
        &mut self,
        now: Instant,
        catalog: &impl Catalog,
        mut birth: Birth,
        buf: &'b mut [u8],
    ) -> NodeOutput<'b> {
        let is_first = birth.stage == Stage::Begin;
        if is_first {
            match birth.owner {
                Owner::Node => {
                    (self.born, self.birth_at) = (0, Some(now));
                    self.counters.births = self.counters.births.saturating_add(1);
                }
                Owner::Device(nth) => {
                    self.born |= bit(nth);
                    if let Some(at) = self.device_births.get_mut(usize::from(nth)) {
                        *at = Some(now);
                    }
                }
            }
        }
        match self.write_birth(now, catalog, &mut birth, buf) {
            BirthPiece::Later => {
                self.phase = NodePhase::Birth(birth);
                NodeOutput::Busy
            }
            BirthPiece::Part(bytes) => {
                self.phase = NodePhase::Birth(birth);
                NodeOutput::Send(bytes)
            }
            BirthPiece::Last(bytes) => {
                // In the sequence of births all that are alive follow at once.
                let next = (0_u8..).take(catalog.devices());
                let next = next.filter(|nth| has(self.alive, *nth) && !has(self.born, *nth));
                let is_sequence = self.phase != NodePhase::Online || birth.owner == Owner::Node;
                self.phase = match next.min().filter(|_| is_sequence && !self.is_interrupted()) {
                    Some(nth) => NodePhase::Birth(Birth { owner: Owner::Device(nth), stage: Stage::Begin }),
                    None => NodePhase::Online,
                };
                if self.phase == NodePhase::Online {
                    self.online_since.get_or_insert(now);
                    self.failure = Maybe::Nothing;
                }
                NodeOutput::Send(bytes)
            }
            BirthPiece::Broken => {
                self.note(SessionFailure::Broken);
                self.close(now)
            }
        }
    }

    /// Whether the sequence of births is not to be finished.
    fn is_interrupted(&self) -> bool {
        self.is_ending || self.is_host_gone()
    }

    fn has_data(&self, owner: Owner) -> bool {
        let is_born = match owner {
            Owner::Node => true,
            Owner::Device(nth) => has(self.born, nth),
        };
        let places = self.places(owner);
        let mut slots = self.slots.iter().take(places.end).skip(places.start);
        is_born && slots.any(|slot| slot.is_pending)
    }

    /// Whether there are values of the past of somebody who was born.
    fn has_history(&self) -> bool {
        self.history.iter().any(|past| match super::messages::owner_of(&self.starts, past.place) {
            Owner::Node => true,
            Owner::Device(nth) => has(self.born, nth),
        })
    }

    fn wait_for_answer(&mut self, now: Instant, until: Instant) -> NodeOutput<'static> {
        if now < until {
            return NodeOutput::Sleep { until };
        }
        self.note(SessionFailure::Silent);
        self.close(now)
    }

    fn close(&mut self, now: Instant) -> NodeOutput<'static> {
        self.leave_session(now);
        NodeOutput::Close
    }

    /// A packet that has no room is a mistake of the driver's.
    fn send<'b>(&mut self, now: Instant, packet: Option<&'b [u8]>) -> NodeOutput<'b> {
        match packet {
            Some(bytes) => NodeOutput::Send(bytes),
            None => {
                self.note(SessionFailure::Broken);
                self.close(now)
            }
        }
    }
}

/// A packet without content, or with a number.
fn short(buf: &mut [u8], kind: u8, id: Option<u16>) -> Option<&[u8]> {
    let mut out = ByteWriter::new(buf);
    mqtt::packet(&mut out, kind, |out| {
        if let Some(id) = id {
            out.put(&id.to_be_bytes());
        }
    });
    out.finish()
}

fn bit(nth: u8) -> u32 {
    1_u32.checked_shl(nth.into()).unwrap_or(0)
}

/// How long a connection may take.
const OPEN_TIME: Duration = Duration::from_secs(30);
/// How long an answer of the server may take.
const ANSWER_TIME: Duration = Duration::from_secs(10);
/// The least time between two births of the node, or of a device that comes and goes.
const BIRTH_PAUSE: Duration = Duration::from_secs(1);
