//! What can be asked about a running engine, and the tap.

use super::Engine;
use super::clock::Dirty;
use super::counters::PortCounters;
use super::io::{LinkId, PortId, PortState, ReplyCode};
use super::latency::Latency;
use super::line::PeerState;
use super::links::LinkInfo;
use super::status::Status;
use super::tap::Tap;
use crate::image::Image;
use crate::time::Instant;

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize, const TAP: usize, const EXCHANGES: usize>
    Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>
{
    /// The process image.
    pub fn image(&self) -> &Image {
        &self.store.image
    }

    /// Counters of a field port; `None` if no such port is configured.
    pub fn port_counters(&self, port: PortId) -> Option<&PortCounters> {
        self.ports.iter().find(|other| other.id == port).map(|port| &port.counters)
    }

    /// Health of a field port; `None` if no such port is configured.
    pub fn port_state(&self, port: PortId) -> Option<PortState> {
        let (index, port) = self.ports.iter().enumerate().find(|(_, other)| other.id == port)?;
        let mut own = self.store.frames.iter().filter(|frame| usize::from(frame.port) == index);
        let peers = port.line().map_or(&[][..], |line| line.peers.of(self.exchanges.peers()));
        Some(port.state(own.any(|frame| frame.is_overdue()) || peers.iter().any(PeerState::is_down)))
    }

    /// Result of the newest command that a port's values picked; `None` if no such port is configured.
    pub fn reply_code(&self, port: PortId) -> Option<ReplyCode> {
        self.ports.iter().find(|other| other.id == port).map(|port| port.reply)
    }

    /// The field ports, in configuration order.
    pub fn field_ports(&self) -> impl Iterator<Item = PortId> + '_ {
        self.ports.iter().map(|port| port.id)
    }

    /// The links that the configuration needs.
    pub fn links(&self) -> impl Iterator<Item = LinkInfo<'_>> + '_ {
        self.links.infos()
    }

    /// Whether a link is up; false if the configuration does not need it. [`Self::links`] tells more of it.
    pub fn is_up(&self, link: LinkId) -> bool {
        self.links.is_up(link)
    }

    /// Whether a datagram is a frame of the link's output part. The driver of a listening UDP link
    /// checks this before it answers another sender than before.
    pub fn is_frame(&self, link: LinkId, datagram: &[u8]) -> bool {
        self.links.recipes.iter().any(|other| other.id == link && other.is_frame(datagram))
    }

    /// How often the gateway itself slept: it was not called for longer than [`super::ASLEEP`], so waiting
    /// input was discarded. Wraps.
    pub fn sleeps(&self) -> u32 {
        self.clock.sleeps
    }

    /// Prepares the end of the engine: at the next [`super::Input::Tick`] every input frame that is not
    /// overdue yet becomes so, as if all devices were silent. Values that wait are dropped and safe values go
    /// out; a port that is never overdue keeps its values. The driver reports nothing more of its ports, and
    /// ends the engine when [`Self::is_safe`] says so, or after some time.
    pub fn make_safe(&mut self) {
        self.store.all_overdue();
        self.clock.timer_at = Instant::ZERO;
        self.clock.idle_until = Instant::ZERO;
        self.clock.dirty.add(Dirty::ALL);
    }

    /// Whether the controller is known to have every safe value that was sent to it. Where nothing shows a
    /// value, it is never known.
    pub fn is_safe(&self) -> bool {
        self.store.is_safe()
    }

    /// A snapshot of the whole gateway at `now`.
    pub fn status(&self, now: Instant) -> Status<'_> {
        Status {
            at: self.forward(now),
            ports: &self.ports,
            frames: &self.store.frames,
            health: &self.health,
            image: &self.store.image,
            inputs: &self.bindings.inputs,
            bits: &self.store.bits,
            links: self.links.view(),
            latency: &self.store.latency,
            sleeps: self.clock.sleeps,
            peers: self.exchanges.peers(),
        }
    }

    /// The latencies since the start.
    pub fn latency(&self) -> &Latency {
        &self.store.latency
    }

    /// The ring of records of everything that goes over ports and links.
    pub fn tap(&mut self) -> &mut Tap<TAP> {
        &mut self.tap
    }
}
