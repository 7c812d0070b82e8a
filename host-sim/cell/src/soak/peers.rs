//! Simulated devices with frames of their own that answer requests: all peers of a port in one device.
//!
//! In: the exchanges of a port and a seed. Out: replies, most of them right and in time, and unsolicited frames. Each
//! peer changes its behaviour every few seconds: prompt, slow, late, refusing, dead, or with replies that are damaged,
//! cut short, lost, behind noise, or to another request. No reply takes three times the timeout: after that, no master
//! could tell it from a reply to the next request.

use proto_core::config::{DeviceFrame, FieldSpec, GatewayConfig, OutputBinding, Parts, Port, Transaction};
use proto_core::device::{Carrier, Probe};
use proto_core::sysvar::Direction;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar;

use super::behaviour::{Behaves, Behaviour, Change};
use super::template::{Template, changed};
use crate::{Device, Done, Rng, SlaveDone};

/// The devices of a line or bus.
#[derive(Debug)]
pub(super) struct Peers {
    rng: Rng,
    peers: Vec<Peer>,
    asks: Vec<Ask>,
    /// Unsolicited frames: those of the port's input part that belong to no exchange.
    unasked: Vec<(Option<usize>, Sends)>,
    next_unasked: Instant,
    /// Received bytes that form no request yet.
    held: Vec<u8>,
    held_until: Instant,
    /// Replies that will be sent, and when.
    leaving: Vec<(Instant, Made)>,
    done: Vec<SlaveDone>,
}

#[derive(Debug)]
struct Peer {
    number: u8,
    behaves: Behaves,
}

/// One exchange with a request.
#[derive(Debug)]
struct Ask {
    /// Index of the exchange on the port.
    exchange: usize,
    peer: usize,
    request: Request,
    reply: Option<Sends>,
    refusal: Option<Sends>,
    timeout: Duration,
}

#[derive(Debug)]
enum Request {
    Remote(CanId),
    Frame {
        id: Option<CanId>,
        frame: Box<DeviceFrame>,
        /// Elements that are the same in every request.
        constants: Vec<(usize, f64)>,
    },
}

/// A frame that a device sends, with its newest values.
#[derive(Debug)]
struct Sends {
    template: Template,
    values: Vec<Scalar>,
}

/// A message that is to be sent.
#[derive(Debug, Clone)]
struct Made {
    id: Option<CanId>,
    bytes: Vec<u8>,
}

impl Peers {
    /// The peers of a port; `None` if its recipe has no exchanges with frames.
    pub(super) fn new(config: &GatewayConfig, port: &Port, start: Instant, mut rng: Rng) -> Option<Self> {
        let recipe = config.recipes.get(usize::from(port.recipe))?;
        let is_on_can = port.bus.is_can();
        let mut unasked: Vec<(Option<usize>, Sends)> = Vec::new();
        match &recipe.parts {
            Parts::Stream { input: Some(part), .. } => {
                let fields = part.fields.of(&config.fields);
                unasked.push((None, Sends::new(config, None, (&part.head, &part.tail), fields)));
            }
            Parts::Can { input, .. } => unasked.extend(input.iter().map(|part| {
                (None, Sends::new(config, Some(part.id), (&[], &[]), part.fields.of(&config.fields)))
            })),
            Parts::Stream { .. } => {}
        }
        let (mut peers, mut asks): (Vec<Peer>, Vec<Ask>) = (Vec::new(), Vec::new());
        for (exchange, spec) in config.view().exchanges_of(recipe).iter().enumerate() {
            let Transaction::Frames { request, reply, refusal } = spec.transaction else { return None };
            let frame = |nth: Option<u8>| config.frames.get(usize::from(nth?));
            let sends = |nth: Option<u8>| {
                let frame = frame(nth)?;
                let fields = frame.fields.of(&config.fields);
                Some(Sends::new(config, frame.id, (&frame.head, &frame.tail), fields))
            };
            let number = spec.peer;
            let peer = peers.iter().position(|peer| peer.number == number).unwrap_or(peers.len());
            if peer == peers.len() {
                peers.push(Peer { number, behaves: Behaves::new(start) });
            }
            let (reply, refusal) = (sends(reply), sends(refusal));
            let Some(request) = frame(request) else {
                unasked.extend(reply.map(|reply| (Some(exchange), reply)));
                continue;
            };
            let request = match request.id {
                Some(id) if request.remote => Request::Remote(id),
                id => {
                    let delimiters = (&request.head[..], &request.tail[..]);
                    Request::new(id, delimiters, is_on_can, request.fields.of(&config.fields))?
                }
            };
            asks.push(Ask { exchange, peer, request, reply, refusal, timeout: spec.timeout });
        }
        if asks.is_empty() {
            return None;
        }
        let next_unasked = if unasked.is_empty() { Instant::NEVER } else { start + rng.up_to(UNASKED) };
        Some(Self {
            rng,
            peers,
            asks,
            unasked,
            next_unasked,
            held: Vec::new(),
            held_until: Instant::NEVER,
            leaving: Vec::new(),
            done: Vec::new(),
        })
    }

    /// Handles a request.
    fn asked(&mut self, nth: usize, request: Vec<u8>, now: Instant) {
        let Self { rng, peers, asks, leaving, done, .. } = self;
        let (number, exchange) = (peers[asks[nth].peer].number, asks[nth].exchange);
        let behaves = &mut peers[asks[nth].peer].behaves;
        if behaves.update(now, rng) == Some(Change::Forgets) {
            done.push(SlaveDone { slave: number, what: Done::Forgot });
        }
        if behaves.like == Behaviour::Dead {
            return;
        }
        let refuses = behaves.like == Behaviour::Refusing && rng.below(2) == 0;
        let ask = &mut asks[nth];
        let timeout = ask.timeout;
        let answer = match &mut ask.refusal {
            Some(refusal) if refuses => Some(refusal),
            _ => {
                done.push(SlaveDone { slave: number, what: Done::Took { exchange, request } });
                ask.reply.as_mut()
            }
        };
        let Some(answer) = answer else { return };
        let mut made = answer.next(rng);
        done.push(SlaveDone { slave: number, what: Done::Replied { exchange, frame: made.bytes.clone() } });
        let has_checksum = answer.template.has_checksum();
        let template = answer.template.clone();
        let delay = behaves.delay(timeout, rng);
        let happens = rng.below(2) == 0;
        let len = made.bytes.len() as u64;
        let is_on_can = made.id.is_some();
        match behaves.like {
            _ if !happens => {}
            // On a bus frames are not damaged; elsewhere nobody could detect damage without a checksum.
            Behaviour::Damaged | Behaviour::Short | Behaviour::Noisy if is_on_can || !has_checksum => return,
            Behaviour::Damaged => made.bytes[rng.below(len) as usize] ^= 1 << rng.below(8),
            Behaviour::Short => made.bytes.truncate(rng.between(1, len - 1) as usize),
            Behaviour::Losing => return,
            Behaviour::Mistaken => {
                let other = rng.below(asks.len() as u64) as usize;
                // No master could tell a late reply in another device's name from that device's own reply.
                if other == nth || asks[other].peer != asks[nth].peer {
                    return;
                }
                let Some(other) = asks[other].reply.as_mut().map(|reply| reply.next(rng)) else { return };
                if template.begins(&other.bytes) && other.id == made.id {
                    return;
                }
                made = other;
            }
            Behaviour::Noisy => {
                let more = rng.between(1, 6) as usize;
                made.bytes = [rng.bytes(more), made.bytes].concat();
            }
            _ => {}
        }
        if template.begins(&made.bytes) {
            // A checksum in hexadecimal digits still matches after only the case of a letter has changed.
            done.push(SlaveDone {
                slave: number,
                what: Done::Replied { exchange, frame: made.bytes.clone() },
            });
        }
        leaving.push((now + delay, made));
    }

    /// The exchange whose request these bytes are.
    fn request_of(&self, id: Option<CanId>, bytes: &[u8]) -> Option<usize> {
        self.asks.iter().position(|ask| ask.request.is(id, bytes))
    }

    fn deadline(&self) -> Instant {
        let leaving = self.leaving.iter().map(|(at, _)| *at).min().unwrap_or(Instant::NEVER);
        leaving.min(self.held_until).min(self.next_unasked)
    }

    fn poll(&mut self, now: Instant) -> Vec<Made> {
        if now >= self.held_until {
            self.held.clear();
            self.held_until = Instant::NEVER;
        }
        let mut leave = Vec::new();
        while let Some(nth) = self.leaving.iter().position(|(at, _)| *at <= now) {
            leave.push(self.leaving.remove(nth).1);
        }
        if now >= self.next_unasked {
            let rng = &mut self.rng;
            self.next_unasked = now + Duration::from_micros(1) + rng.up_to(UNASKED);
            let nth = rng.below(self.unasked.len() as u64) as usize;
            let (exchange, sends) = &mut self.unasked[nth];
            let made = sends.next(rng);
            if let Some(exchange) = *exchange {
                let what = Done::Replied { exchange, frame: made.bytes.clone() };
                self.done.push(SlaveDone { slave: 0, what });
            }
            leave.push(made);
        }
        leave
    }
}

impl Device<Vec<u8>> for Peers {
    fn receive(&mut self, now: Instant, bytes: &Vec<u8>) -> Vec<Vec<u8>> {
        self.held.extend_from_slice(bytes);
        match self.request_of(None, &self.held) {
            Some(nth) => {
                let request = std::mem::take(&mut self.held);
                self.held_until = Instant::NEVER;
                self.asked(nth, request, now);
            }
            None => self.held_until = now + SILENCE,
        }
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        self.poll(now).into_iter().map(|made| made.bytes).collect()
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        std::mem::take(&mut self.done)
    }
}

impl Device<CanFrame> for Peers {
    fn receive(&mut self, now: Instant, frame: &CanFrame) -> Vec<CanFrame> {
        let nth = match frame.is_remote() {
            true => self.asks.iter().position(|ask| ask.request.is_remote(frame.id())),
            false => self.request_of(Some(frame.id()), frame.data()),
        };
        if let Some(nth) = nth {
            self.asked(nth, frame.data().to_vec(), now);
        }
        Vec::new()
    }

    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<CanFrame> {
        let made = self.poll(now).into_iter();
        made.filter_map(|made| CanFrame::new(made.id.unwrap_or(CanId::Standard(0)), &made.bytes)).collect()
    }

    fn take_done(&mut self) -> Vec<SlaveDone> {
        std::mem::take(&mut self.done)
    }
}

impl Request {
    fn new(
        id: Option<CanId>,
        delimiters: (&[u8], &[u8]),
        is_on_can: bool,
        fields: &[FieldSpec],
    ) -> Option<Self> {
        let carrier = if is_on_can { Carrier::Can } else { Carrier::Stream };
        let frame = DeviceFrame::new(carrier, Direction::Output, delimiters, fields).ok()?;
        let elements = fields.iter().filter(|field| field.element().is_some()).enumerate();
        let constants = elements.filter_map(|(nth, field)| match field.source() {
            Some(OutputBinding::Constant(value)) => Some((nth, value)),
            _ => None,
        });
        let constants = constants.collect();
        Some(Self::Frame { id, frame: Box::new(frame), constants })
    }

    fn is_remote(&self, id: CanId) -> bool {
        matches!(self, Self::Remote(own) if *own == id)
    }

    fn is(&self, from: Option<CanId>, bytes: &[u8]) -> bool {
        let Self::Frame { id, frame, constants } = self else { return false };
        let DeviceFrame { elements, layout } = &**frame;
        if *id != from || layout.probe_whole(elements, bytes) != Probe::Frame(bytes.len()) {
            return false;
        }
        let values: Vec<_> = layout.values(elements, bytes).collect();
        constants.iter().all(|(nth, constant)| {
            matches!(values.get(*nth), Some(Ok(Some(value))) if value.as_f64() == *constant)
        })
    }
}

impl Sends {
    fn new(
        config: &GatewayConfig,
        id: Option<CanId>,
        delimiters: (&[u8], &[u8]),
        fields: &[FieldSpec],
    ) -> Self {
        let template = Template::new(config, id, delimiters, fields);
        let values = template.zeros();
        Self { template, values }
    }

    /// Changes some values, and returns the frame with the new values.
    fn next(&mut self, rng: &mut Rng) -> Made {
        for (value, content) in self.values.iter_mut().zip(&self.template.fields) {
            if rng.below(3) == 0 {
                *value = changed(rng, content, *value);
            }
        }
        Made { id: self.template.id, bytes: self.template.whole(&self.values) }
    }
}

/// The longest pause between unsolicited frames.
const UNASKED: Duration = Duration::from_millis(500);
/// Bytes that form no request within this time are discarded.
const SILENCE: Duration = Duration::from_millis(8);
