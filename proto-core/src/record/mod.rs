//! Recordings of an engine: every input with its instant, and every output, to be replayed by another engine
//! (docs/cortex-m7.md section 1).
//!
//! In: an engine's inputs and outputs, or a recording. Out: the other. A recording that is cut or changed is refused;
//! no content can cause a panic. Does not know files or clocks.

mod replay;

pub use replay::{ReplayError, Replayed, replay};

use core::net::SocketAddr;

use embedded_can::Frame;
use heapless::Vec;

use crate::engine::{BusState, Endpoint, Engine, Input, LinkId, Output, PortId, Transport};
use crate::time::Instant;
use crate::wire::can::{CanFrame, CanId, MAX_CAN_DATA};

/// The first bytes of every recording; the last of them is the format's version.
pub const MAGIC: [u8; 4] = *b"RGR\x03";

/// Longest [`Entry::Totals`].
pub(crate) const MAX_TOTALS: usize = 3072;

/// One entry of a recording.
#[derive(Debug, Clone, Copy)]
pub enum Entry<'a> {
    /// An engine starts with this configuration image.
    Start {
        /// The image ([`crate::config::image`]).
        image: &'a [u8],
    },
    /// [`Engine::handle`] was called.
    Input {
        /// When.
        at: Instant,
        /// With what.
        input: Input<'a>,
    },
    /// [`Engine::poll_output`] returned this.
    Output(Output<'a>),
    /// [`Engine::make_safe`] was called.
    MakeSafe,
    /// The engine's counters and the contents of its image: see [`totals`].
    Totals(&'a [u8]),
}

impl<'a> Entry<'a> {
    /// Splits the first entry from `bytes`, and returns the rest too; `None` if `bytes` do not begin with an entry.
    pub fn parse(bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let mut body = EntryReader(bytes);
        let entry = match body.byte()? {
            tag::START => Self::Start { image: body.bytes()? },
            tag::TOTALS => Self::Totals(body.bytes()?),
            tag::MAKE_SAFE => Self::MakeSafe,
            tag @ 0x10..0x20 => {
                let at = body.instant()?;
                Self::Input { at, input: body.input(tag)? }
            }
            tag => Self::Output(body.output(tag)?),
        };
        Some((entry, body.0))
    }

    /// Writes the entry, in up to two pieces.
    pub fn encode(&self, mut write: impl FnMut(&[u8])) {
        let mut head = EntryHead::default();
        let tail = match *self {
            Self::Start { image } => head.tag(tag::START).len_of(image),
            Self::Totals(totals) => head.tag(tag::TOTALS).len_of(totals),
            Self::MakeSafe => {
                head.tag(tag::MAKE_SAFE);
                &[]
            }
            Self::Input { at, input } => head.input(at, input),
            Self::Output(output) => head.output(output),
        };
        write(&head.0);
        if !tail.is_empty() {
            write(tail);
        }
    }
}

/// The counters of every field port and link, and the values of the image: the state that the inputs led to, besides
/// the outputs.
///
/// For each port and link its number and its counters in postcard format, then the image.
pub fn totals<
    const PORTS: usize,
    const UPLINKS: usize,
    const FIELDS: usize,
    const TAP: usize,
    const EXCHANGES: usize,
>(
    engine: &Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>,
) -> Vec<u8, MAX_TOTALS> {
    let mut totals = Vec::new();
    let mut scratch = [0; 256];
    for port in engine.field_ports() {
        if let Some(counters) = engine.port_counters(port) {
            let bytes = postcard::to_slice(&(port.0, counters), &mut scratch);
            let _ = totals.extend_from_slice(bytes.as_deref().unwrap_or(&[]));
        }
    }
    for link in engine.links() {
        let bytes = postcard::to_slice(&(link.id.0, link.history, link.counters), &mut scratch);
        let _ = totals.extend_from_slice(bytes.as_deref().unwrap_or(&[]));
    }
    let _ = totals.extend_from_slice(engine.image().bytes());
    totals
}

mod tag {
    pub(super) const START: u8 = 0x01;
    pub(super) const TOTALS: u8 = 0x02;
    pub(super) const MAKE_SAFE: u8 = 0x03;

    pub(super) const PORT_UP: u8 = 0x10;
    pub(super) const PORT_DOWN: u8 = 0x11;
    pub(super) const PORT_BYTES: u8 = 0x12;
    pub(super) const PORT_CAN: u8 = 0x13;
    pub(super) const PORT_SENT: u8 = 0x14;
    pub(super) const PORT_BUS: u8 = 0x15;
    pub(super) const LINK_UP: u8 = 0x16;
    pub(super) const LINK_DOWN: u8 = 0x17;
    pub(super) const LINK_BYTES: u8 = 0x18;
    pub(super) const LINK_SENT: u8 = 0x19;
    pub(super) const TICK: u8 = 0x1A;
    pub(super) const LINK_ACKED: u8 = 0x1B;

    pub(super) const SLEEP: u8 = 0x20;
    pub(super) const PORT_SEND: u8 = 0x21;
    pub(super) const PORT_SEND_CAN: u8 = 0x22;
    pub(super) const LINK_OPEN: u8 = 0x23;
    pub(super) const LINK_CLOSE: u8 = 0x24;
    pub(super) const LINK_SEND: u8 = 0x25;
}

/// Bit 31 of a recorded CAN id: an extended id. Bit 30: a remote frame.
const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;

/// Longest address in postcard format: its kind, an IPv6 address, a port.
const MAX_ADDRESS: usize = 1 + 16 + 3;

/// An entry without the bytes at its end. The longest one has a tag, two numbers of up to ten bytes, a port and a CAN
/// frame.
#[derive(Default)]
struct EntryHead(Vec<u8, 40>);

impl EntryHead {
    fn tag(&mut self, tag: u8) -> &mut Self {
        self.byte(tag)
    }

    fn byte(&mut self, byte: u8) -> &mut Self {
        let _ = self.0.push(byte);
        self
    }

    /// Seven bits per byte, lowest first; bit 7 is set in all but the last.
    fn number(&mut self, mut number: u64) -> &mut Self {
        while number > 0x7F {
            self.byte(number as u8 | 0x80);
            number >>= 7;
        }
        self.byte(number as u8)
    }

    fn len_of<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        self.number(bytes.len() as u64);
        bytes
    }

    fn frame<'a>(&mut self, frame: &CanFrame) -> &'a [u8] {
        let id = match frame.id() {
            CanId::Standard(id) => u32::from(id),
            CanId::Extended(id) => id | EXTENDED,
        };
        let id = if frame.is_remote() { id | REMOTE } else { id };
        let _ = self.0.extend_from_slice(&id.to_le_bytes());
        let _ = self.byte(frame.dlc() as u8).0.extend_from_slice(frame.data());
        &[]
    }

    fn transport(&mut self, transport: Transport) -> &mut Self {
        match transport {
            Transport::Tcp { port } => self.byte(0).number(port.into()),
            Transport::Udp { port } => self.byte(1).number(port.into()),
            Transport::TcpListen { local } => self.byte(2).address(local),
            Transport::UdpListen { local } => self.byte(3).address(local),
        }
    }

    fn address(&mut self, address: SocketAddr) -> &mut Self {
        let mut scratch = [0; MAX_ADDRESS];
        let bytes = postcard::to_slice(&address, &mut scratch);
        let _ = self.0.extend_from_slice(bytes.as_deref().unwrap_or(&[]));
        self
    }

    fn input<'a>(&mut self, at: Instant, input: Input<'a>) -> &'a [u8] {
        let (tag, subject) = match input {
            Input::PortUp { port } => (tag::PORT_UP, port.0),
            Input::PortDown { port } => (tag::PORT_DOWN, port.0),
            Input::PortBytes { port, .. } => (tag::PORT_BYTES, port.0),
            Input::PortCan { port, .. } => (tag::PORT_CAN, port.0),
            Input::PortSent { port } => (tag::PORT_SENT, port.0),
            Input::PortBus { port, .. } => (tag::PORT_BUS, port.0),
            Input::LinkUp { link } => (tag::LINK_UP, link.0),
            Input::LinkDown { link } => (tag::LINK_DOWN, link.0),
            Input::LinkBytes { link, .. } => (tag::LINK_BYTES, link.0),
            Input::LinkSent { link } => (tag::LINK_SENT, link.0),
            Input::LinkAcked { link, .. } => (tag::LINK_ACKED, link.0),
            Input::Tick => (tag::TICK, 0),
        };
        self.tag(tag).number(at.as_micros()).byte(subject);
        match input {
            Input::PortBytes { bytes, .. } | Input::LinkBytes { bytes, .. } => self.len_of(bytes),
            Input::PortCan { frame, .. } => self.frame(&frame),
            Input::PortBus { state, .. } => {
                self.byte(match state {
                    BusState::Active => 0,
                    BusState::Warning => 1,
                    BusState::Passive => 2,
                    BusState::BusOff => 3,
                });
                &[]
            }
            Input::LinkAcked { left, .. } => {
                self.number(left.into());
                &[]
            }
            _ => &[],
        }
    }

    fn output<'a>(&mut self, output: Output<'a>) -> &'a [u8] {
        match output {
            Output::Sleep { until } => {
                self.tag(tag::SLEEP).number(until.as_micros());
                &[]
            }
            Output::PortSend { port, bytes } => self.tag(tag::PORT_SEND).byte(port.0).len_of(bytes),
            Output::PortSendCan { port, frame } => self.tag(tag::PORT_SEND_CAN).byte(port.0).frame(&frame),
            Output::LinkOpen { link, to } => {
                self.tag(tag::LINK_OPEN).byte(link.0).transport(to.transport).len_of(to.host.as_bytes())
            }
            Output::LinkClose { link } => {
                self.tag(tag::LINK_CLOSE).byte(link.0);
                &[]
            }
            Output::LinkSend { link, bytes } => self.tag(tag::LINK_SEND).byte(link.0).len_of(bytes),
        }
    }
}

struct EntryReader<'a>(&'a [u8]);

impl<'a> EntryReader<'a> {
    fn byte(&mut self) -> Option<u8> {
        let (byte, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*byte)
    }

    fn number(&mut self) -> Option<u64> {
        let mut number = 0_u64;
        for shift in (0..64_u32).step_by(7) {
            let byte = self.byte()?;
            let bits = u64::from(byte & 0x7F);
            let placed = bits.checked_shl(shift)?;
            if placed.checked_shr(shift) != Some(bits) {
                return None;
            }
            number |= placed;
            if byte & 0x80 == 0 {
                return Some(number);
            }
        }
        None
    }

    fn instant(&mut self) -> Option<Instant> {
        self.number().map(Instant::from_micros)
    }

    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let (bytes, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(bytes)
    }

    fn bytes(&mut self) -> Option<&'a [u8]> {
        let len = usize::try_from(self.number()?).ok()?;
        self.take(len)
    }

    fn port(&mut self) -> Option<PortId> {
        self.byte().map(PortId)
    }

    fn link(&mut self) -> Option<LinkId> {
        self.byte().map(LinkId)
    }

    fn frame(&mut self) -> Option<CanFrame> {
        let word = u32::from_le_bytes(*self.take(4)?.first_chunk()?);
        let id = word & !(EXTENDED | REMOTE);
        let id =
            if word & EXTENDED == 0 { CanId::Standard(u16::try_from(id).ok()?) } else { CanId::Extended(id) };
        let len = usize::from(self.byte()?);
        if word & REMOTE != 0 {
            return CanFrame::remote(id, len);
        }
        (len <= MAX_CAN_DATA).then_some(())?;
        CanFrame::new(id, self.take(len)?)
    }

    fn transport(&mut self) -> Option<Transport> {
        Some(match self.byte()? {
            0 => Transport::Tcp { port: u16::try_from(self.number()?).ok()? },
            1 => Transport::Udp { port: u16::try_from(self.number()?).ok()? },
            2 => Transport::TcpListen { local: self.address()? },
            3 => Transport::UdpListen { local: self.address()? },
            _ => return None,
        })
    }

    fn address(&mut self) -> Option<SocketAddr> {
        let (address, rest) = postcard::take_from_bytes(self.0).ok()?;
        self.0 = rest;
        Some(address)
    }

    fn input(&mut self, tag: u8) -> Option<Input<'a>> {
        Some(match tag {
            tag::PORT_UP => Input::PortUp { port: self.port()? },
            tag::PORT_DOWN => Input::PortDown { port: self.port()? },
            tag::PORT_BYTES => Input::PortBytes { port: self.port()?, bytes: self.bytes()? },
            tag::PORT_CAN => Input::PortCan { port: self.port()?, frame: self.frame()? },
            tag::PORT_SENT => Input::PortSent { port: self.port()? },
            tag::PORT_BUS => {
                let port = self.port()?;
                let state = match self.byte()? {
                    0 => BusState::Active,
                    1 => BusState::Warning,
                    2 => BusState::Passive,
                    3 => BusState::BusOff,
                    _ => return None,
                };
                Input::PortBus { port, state }
            }
            tag::LINK_UP => Input::LinkUp { link: self.link()? },
            tag::LINK_DOWN => Input::LinkDown { link: self.link()? },
            tag::LINK_BYTES => Input::LinkBytes { link: self.link()?, bytes: self.bytes()? },
            tag::LINK_SENT => Input::LinkSent { link: self.link()? },
            tag::LINK_ACKED => {
                Input::LinkAcked { link: self.link()?, left: u32::try_from(self.number()?).ok()? }
            }
            tag::TICK => self.byte().map(|_| Input::Tick)?,
            _ => return None,
        })
    }

    fn output(&mut self, tag: u8) -> Option<Output<'a>> {
        Some(match tag {
            tag::SLEEP => Output::Sleep { until: self.instant()? },
            tag::PORT_SEND => Output::PortSend { port: self.port()?, bytes: self.bytes()? },
            tag::PORT_SEND_CAN => Output::PortSendCan { port: self.port()?, frame: self.frame()? },
            tag::LINK_OPEN => {
                let (link, transport) = (self.link()?, self.transport()?);
                let host = core::str::from_utf8(self.bytes()?).ok()?;
                Output::LinkOpen { link, to: Endpoint::new(transport, host) }
            }
            tag::LINK_CLOSE => Output::LinkClose { link: self.link()? },
            tag::LINK_SEND => Output::LinkSend { link: self.link()?, bytes: self.bytes()? },
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests;
