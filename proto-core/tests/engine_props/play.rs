//! What may happen to the cell, and whether the model agrees with what the engine does then.

#![allow(unreachable_pub, reason = "a module of a test binary")]

use proptest::prelude::*;
use proto_core::engine::{ASLEEP, BusState, Input, LinkId, PortId};
use proto_core::modbus::Exception;
use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};

use super::model::*;
use super::rig::*;

/// What may happen.
#[derive(Debug, Clone)]
pub enum Op {
    /// A device sends a frame, in pieces of this size.
    Frame {
        nth: usize,
        values: [u16; 2],
        finite: bool,
        piece: usize,
    },
    /// A device sends frame after frame, with changing values.
    Stream {
        nth: usize,
        every: Duration,
        count: u16,
    },
    /// Three frames in one chunk.
    Burst {
        values: [u8; 3],
    },
    /// A device sends only the beginning of a frame.
    Cut {
        nth: usize,
        len: usize,
    },
    Noise {
        port: PortId,
        bytes: Vec<u8>,
    },
    WrongCan {
        id: u16,
        len: usize,
        remote: bool,
    },
    Wait(Duration),
    /// The driver does not call the engine for a while; what comes next is reported before the tick that
    /// is due. After half a second the gateway slept.
    Late(Duration),
    Port {
        port: PortId,
        up: bool,
    },
    Bus(BusState),
    /// The controller can be reached by this link, or not; and the connection breaks.
    Reachable {
        link: LinkId,
        yes: bool,
    },
    /// Modbus requests are answered at once, or only by `Answer`.
    Answers(bool),
    /// The answer to the newest unanswered request, or to one before it.
    Answer {
        newest: bool,
    },
    Refuse(bool),
    /// Ports and links report at once what was sent, or later.
    Reports(bool),
    Sent,
    /// The controller's TCP acknowledges at once, or not.
    Acks(bool),
    Acked,
    State {
        outputs: u8,
        word: u16,
        float: u16,
        good: bool,
        /// Bit 0: the pose, bit 1: the float register cannot be read.
        unreadable: u8,
    },
    /// What the controller's UDP server says; `None`: it cannot be read.
    Down {
        value: Option<u16>,
    },
}

pub struct Test {
    rig: Rig,
    model: Model,
    unanswered: Vec<Vec<u8>>,
    /// Everything was taken and acknowledged at once so far.
    prompt: bool,
}

impl Test {
    pub fn new() -> Self {
        let mut rig = Rig::new(&cell());
        rig.logs_ticks = true;
        Self { rig, model: Model::new(), unanswered: Vec::new(), prompt: true }
    }

    /// An input is about to be reported: did the gateway sleep?
    fn wake(&mut self) {
        if self.rig.now.saturating_since(self.rig.called) > ASLEEP {
            self.model.slept(self.rig.now);
            self.unanswered.clear();
        }
        self.rig.called = self.rig.now;
    }

    fn input(&mut self, input: Input<'_>) -> Result<(), TestCaseError> {
        self.wake();
        self.rig.input(input);
        self.look()
    }

    fn run(&mut self, span: Duration) -> Result<(), TestCaseError> {
        self.wake();
        self.rig.run(span);
        self.look()
    }

    /// What the engine handed over, in order.
    pub fn look(&mut self) -> Result<(), TestCaseError> {
        for (at, out) in std::mem::take(&mut self.rig.log) {
            match out {
                Out::Tick => self.model.tick(at),
                Out::Open(link) if self.rig.reachable.contains(&link.0) => {
                    self.model.up.insert(link, at);
                    if link == UDP {
                        self.model.handed_over = None;
                    }
                }
                Out::Open(_) => {}
                Out::Close(link) => {
                    self.model.up.remove(&link);
                    if link == LinkId::MODBUS {
                        self.unanswered.clear();
                    }
                }
                Out::Link(link, bytes) => {
                    *self.model.sent.entry(link).or_default() += u32::from(bytes != [0]);
                    if link == LinkId::MODBUS {
                        self.model.modbus(&bytes, at)?;
                        if !self.rig.modbus_answers {
                            self.unanswered.push(bytes);
                        }
                    } else {
                        prop_assert_eq!(link, UDP);
                        self.model.udp(&bytes, at)?;
                    }
                }
                Out::Port(port, bytes) => {
                    prop_assert!(self.model.port_up[usize::from(port.0)]);
                    self.model.out[usize::from(port.0)] += 1;
                    if port == KNOB {
                        prop_assert!(
                            self.model.shown.contains(&raw(&bytes[2..6])),
                            "{bytes:?} was never received"
                        );
                        prop_assert!(!self.model.knob_is_unreadable, "nobody knows it");
                    }
                }
                Out::Can(port, frame) => {
                    prop_assert!(self.model.port_up[usize::from(port.0)] && !self.model.bus_off);
                    prop_assert!(!self.model.bus_is_unreadable, "nobody knows it");
                    self.model.out[usize::from(port.0)] += 1;
                    prop_assert!(
                        self.model.shown.contains(&raw(frame.data())),
                        "{frame:?} was never received"
                    );
                }
            }
        }
        Ok(())
    }

    fn device(&mut self, frame: usize, payload: &[u8], piece: usize) -> Result<(), TestCaseError> {
        let (port, _) = FRAMES[frame];
        if port == BUS {
            self.wake();
            let id = CanId::Standard(if frame == 1 { 1 } else { 5 });
            match self.model.discards_until {
                Some(_) => self.model.asleep[usize::from(BUS.0)] += 1,
                None => self.model.accept(frame, payload, self.rig.now),
            }
            let frame = CanFrame::new(id, payload).unwrap();
            return self.input(Input::PortCan { port, frame });
        }
        let bytes = [&[255, 255], payload, &[238, 238]].concat();
        for piece in bytes.chunks(piece) {
            self.bytes(port, piece)?;
        }
        Ok(())
    }

    fn bytes(&mut self, port: PortId, bytes: &[u8]) -> Result<(), TestCaseError> {
        self.wake();
        self.model.line(port, bytes, self.rig.now);
        self.input(Input::PortBytes { port, bytes })
    }

    pub fn apply(&mut self, op: &Op) -> Result<(), TestCaseError> {
        match op {
            Op::Frame { nth, values, finite, piece } => {
                return self.device(*nth, &payload(FRAMES[*nth].1, *values, *finite), *piece);
            }
            Op::Burst { values } => {
                let bytes: Vec<u8> =
                    values.iter().flat_map(|&value| [255, 255, value, value, 0, 238, 238]).collect();
                return self.bytes(PLC, &bytes);
            }
            Op::Stream { nth, every, count } => {
                for value in 0..*count {
                    self.device(*nth, &payload(FRAMES[*nth].1, [value * 7 % 3, value], true), 64)?;
                    self.run(*every)?;
                }
            }
            Op::Cut { nth, len } if FRAMES[*nth].0 != BUS => {
                let whole = [&[255, 255], &payload(FRAMES[*nth].1, [1, 1], true)[..], &[238, 238]].concat();
                return self.bytes(FRAMES[*nth].0, &whole[..(*len).min(whole.len() - 1)]);
            }
            Op::Cut { .. } => {}
            Op::Noise { port, bytes } => return self.bytes(*port, bytes),
            Op::WrongCan { id, len, remote } => {
                let right = matches!((id, len), (1, 1) | (5, 4));
                let id = CanId::Standard(*id);
                let frame =
                    if *remote { CanFrame::remote(id, *len) } else { CanFrame::new(id, &vec![1; *len]) };
                if *remote || !right {
                    self.wake();
                    match self.model.discards_until {
                        Some(_) => self.model.asleep[usize::from(BUS.0)] += 1,
                        None => self.model.wrong_can += 1,
                    }
                    return self.input(Input::PortCan { port: BUS, frame: frame.unwrap() });
                }
            }
            Op::Wait(span) => return self.run(*span),
            Op::Late(span) => {
                // What was due before is reported before.
                if self.rig.wake <= self.rig.now {
                    self.input(Input::Tick)?;
                }
                self.rig.now += *span;
            }
            Op::Port { port, up } => {
                self.wake();
                self.model.port_up[usize::from(port.0)] = *up;
                if *up {
                    return self.input(Input::PortUp { port: *port });
                }
                if let Some(line) = self.model.deframers.get_mut(port) {
                    line.dropped += line.held.len() as u32;
                    line.held.clear();
                }
                return self.input(Input::PortDown { port: *port });
            }
            Op::Bus(state) => {
                self.model.bus_off = *state == BusState::BusOff;
                return self.input(Input::PortBus { port: BUS, state: *state });
            }
            Op::Reachable { link, yes } => {
                if *yes {
                    self.rig.reachable.insert(link.0);
                } else {
                    self.rig.reachable.remove(&link.0);
                }
                self.model.up.remove(link);
                if *link == LinkId::MODBUS {
                    self.unanswered.clear();
                }
                return self.input(Input::LinkDown { link: *link });
            }
            Op::Answers(yes) => {
                self.rig.modbus_answers = *yes;
                while *yes && !self.unanswered.is_empty() {
                    self.answer(true)?;
                }
            }
            Op::Answer { newest } => return self.answer(*newest),
            Op::Refuse(yes) => self.rig.map.exception = yes.then_some(Exception::DeviceBusy),
            Op::Reports(yes) => {
                self.prompt &= *yes;
                self.rig.reports_sent = *yes;
                return self.report_sent();
            }
            Op::Sent => return self.report_sent(),
            Op::Acks(yes) => {
                self.prompt &= *yes;
                self.rig.acknowledges = *yes;
                return self.report_acked();
            }
            Op::Acked => return self.report_acked(),
            Op::State { outputs, word, float, good, unreadable } => {
                return self.state(*outputs, *word, f32::from(*float), *good, *unreadable);
            }
            Op::Down { value } => {
                self.wake();
                let float = value.map_or(f32::NAN, |value| f32::from(value) + 0.125);
                if self.model.up.contains_key(&UDP) {
                    self.model.heard(self.rig.now);
                    self.model.knob_is_unreadable = value.is_none();
                    match value {
                        Some(_) => drop(self.model.shown.insert(float.to_bits())),
                        None => *self.model.unreadable.entry(UDP).or_default() += 1,
                    }
                }
                let frame = [&[255, 255][..], &float.to_le_bytes(), &[254, 254]].concat();
                return self.input(Input::LinkBytes { link: UDP, bytes: &frame });
            }
        }
        self.look()
    }

    fn answer(&mut self, newest: bool) -> Result<(), TestCaseError> {
        if self.unanswered.is_empty() {
            return Ok(());
        }
        self.wake();
        let newest = if newest { self.unanswered.len().saturating_sub(1) } else { 0 };
        if newest >= self.unanswered.len() {
            // It slept, and the connection with it.
            return self.input(Input::Tick);
        }
        let request = self.unanswered.remove(newest);
        let answer = self.rig.answer(&request);
        self.input(Input::LinkBytes { link: LinkId::MODBUS, bytes: &answer })
    }

    fn report_sent(&mut self) -> Result<(), TestCaseError> {
        for port in [PLC, BUS, SENSOR, KNOB] {
            self.input(Input::PortSent { port })?;
        }
        for link in [LinkId::MODBUS, UDP] {
            self.input(Input::LinkSent { link })?;
        }
        if self.rig.acknowledges { self.report_acked() } else { Ok(()) }
    }

    fn report_acked(&mut self) -> Result<(), TestCaseError> {
        self.input(Input::LinkAcked { link: LinkId::MODBUS, left: 0 })
    }

    fn state(
        &mut self,
        outputs: u8,
        word: u16,
        float: f32,
        good: bool,
        unreadable: u8,
    ) -> Result<(), TestCaseError> {
        self.wake();
        let nth = |bit: u8| unreadable >> bit & 1 == 1;
        let (pose, register) =
            (if nth(0) { f32::NAN } else { float }, if nth(1) { f32::INFINITY } else { float });
        let mut packet = vec![0; 1468];
        if !good {
            packet[..12].copy_from_slice(&[f32::NAN.to_le_bytes(); 3].concat());
        }
        for bit in 0..8 {
            packet[760 + bit] = outputs >> bit & 1;
        }
        packet[832..836].copy_from_slice(&register.to_le_bytes());
        packet[1310..1312].copy_from_slice(&word.to_le_bytes());
        packet[368..372].copy_from_slice(&pose.to_le_bytes());
        if good && self.model.up.contains_key(&LinkId::STATE) {
            let now = self.rig.now;
            self.model.heard(now);
            self.model.packet = Some(now);
            self.model.bus_is_unreadable = !pose.is_finite();
            self.model.shown.insert(0);
            let mut wrong = 0;
            if pose.is_finite() {
                self.model.shown.insert(pose.to_bits());
            } else {
                wrong += 1;
            }
            self.model.read_back.insert(WORD32, (now, u32::from(word)));
            for (name, value) in [(OUT2, u32::from(outputs)), (FLOAT, register.to_bits())] {
                if self.model.live(name) {
                    continue;
                }
                if name == FLOAT && !register.is_finite() {
                    self.model.read_back.remove(name);
                    wrong += 1;
                } else {
                    self.model.read_back.insert(name, (now, value));
                }
            }
            *self.model.unreadable.entry(LinkId::STATE).or_default() += wrong;
        }
        self.input(Input::LinkBytes { link: LinkId::STATE, bytes: &packet })
    }

    pub fn counters_add_up(&self) -> Result<(), TestCaseError> {
        let model = &self.model;
        for port in [PLC, BUS, SENSOR, KNOB] {
            let nth = usize::from(port.0);
            let counters = self.rig.counters(port);
            prop_assert_eq!(counters.frames_in, model.accepted[nth], "{:?} frames in", port);
            prop_assert_eq!(counters.rejected_not_finite, model.not_finite[nth], "{:?} not finite", port);
            prop_assert_eq!(counters.timeouts, model.timeouts[nth], "{:?} timeouts", port);
            prop_assert_eq!(counters.undelivered, model.undelivered[nth], "{:?} undelivered", port);
            prop_assert_eq!(counters.frames_out, model.out[nth], "{:?} frames out", port);
            prop_assert_eq!(counters.asleep, model.asleep[nth], "{:?} asleep", port);
            prop_assert!(counters.withheld <= counters.frames_in);
            if port == BUS {
                let rejected = counters.rejected_id + counters.rejected_length + counters.rejected_remote;
                prop_assert_eq!(rejected, model.wrong_can);
            } else if let Some(line) = model.deframers.get(&port) {
                let whole = counters.bytes_in - counters.resync_bytes - counters.discarded_bytes;
                prop_assert_eq!(counters.bytes_in, line.bytes);
                prop_assert_eq!(counters.resync_bytes + counters.discarded_bytes, line.dropped, "{:?}", port);
                let frame = FRAMES.iter().find(|(of, _)| *of == port).unwrap().1;
                let len = 4 + frame.iter().map(|name| size(name)).sum::<usize>() as u32;
                let frames = counters.frames_in + counters.rejected_not_finite;
                prop_assert_eq!(whole, frames * len + line.held.len() as u32);
            }
        }
        prop_assert_eq!(self.rig.engine.sleeps(), model.sleeps);
        for link in self.rig.engine.links() {
            let unreadable = model.unreadable.get(&link.id).copied().unwrap_or(0);
            prop_assert_eq!(link.counters.unreadable, unreadable, "{:?}", link.kind);
            let up = link.history.connects - link.history.losses;
            prop_assert_eq!(up == 1, model.up.contains_key(&link.id), "{:?}", link);
            let sent = model.sent.get(&link.id).copied().unwrap_or(0);
            prop_assert_eq!(link.counters.sent, sent, "{:?}", link.kind);
            if link.id == LinkId::MODBUS {
                let ended = link.counters.received + link.counters.timeouts;
                prop_assert!(ended <= sent && sent <= ended + 1 + link.history.losses, "{link:?}");
                let reset = link.counters.unacknowledged;
                prop_assert!(reset <= link.counters.timeouts.min(link.history.losses), "{link:?}");
                prop_assert!(reset == 0 || !self.prompt, "{link:?}");
            } else {
                prop_assert_eq!(link.counters.unacknowledged, 0, "{:?}", link.kind);
            }
        }
        Ok(())
    }

    fn all_send(&mut self, value: u16) -> Result<(), TestCaseError> {
        for (nth, (_, names)) in FRAMES.iter().enumerate() {
            self.device(nth, &payload(names, [value, value], true), 64)?;
        }
        Ok(())
    }

    /// Once everything works again, the newest values of all devices arrive, bits in all their steps.
    pub fn settles(&mut self) -> Result<(), TestCaseError> {
        self.rig.reachable = (0..16).collect();
        self.rig.map.exception = None;
        for op in [Op::Reports(true), Op::Acks(true), Op::Answers(true), Op::Bus(BusState::Active)] {
            self.apply(&op)?;
        }
        for port in [PLC, BUS, SENSOR, KNOB] {
            self.apply(&Op::Port { port, up: true })?;
        }
        // Longer than the longest wait of a link, with the controller talking.
        for _ in 0..120 {
            self.state(0, 7, 0.0, true, 0)?;
            self.apply(&Op::Wait(MS(50)))?;
        }
        self.state(0, 7, 0.0, true, 0)?;
        self.all_send(0xA0)?;
        self.model.vars.values_mut().for_each(|known| known.steps.clear());
        // The controller takes its time.
        for op in [Op::Reports(false), Op::Answers(false)] {
            self.apply(&op)?;
        }
        for value in [0xA1, 0xA2, 0xA1, 0xA3] {
            self.all_send(value)?;
        }
        for op in [Op::Reports(true), Op::Answers(true)] {
            self.apply(&op)?;
        }
        for name in [OUT1, BITS3, OUT2] {
            prop_assert_eq!(
                &self.model.vars[name].steps,
                &[0xA1, 0xA2, 0xA1, 0xA3],
                "{} misses a step",
                name
            );
        }
        for (name, known) in &self.model.vars {
            let newest = known.received.last().map(|newest| newest.1);
            prop_assert_eq!(known.last_written, newest, "{} is up to date", name);
        }
        Ok(())
    }

    /// All devices fall silent: the safe values arrive, and are repeated until the controller shows
    /// them.
    pub fn becomes_safe(&mut self) -> Result<(), TestCaseError> {
        let frames = |test: &Self| test.model.sent.get(&UDP).copied().unwrap_or(0);
        for _ in 0..40 {
            self.state(0, 7, 0.0, true, 0)?;
            self.run(MS(50))?;
        }
        for (name, safe) in [(OUT1, SAFE_OUT1), (FLOAT, SAFE_FLOAT.to_bits())] {
            prop_assert_eq!(self.model.vars[name].last_written, Some(safe), "{} is safe", name);
        }
        let before = frames(self);
        self.run(MS(100))?;
        prop_assert_eq!(frames(self), before + 25, "every 4 ms");
        self.state(0, 7, SAFE_FLOAT, true, 0)?;
        self.run(MS(4))?;
        let before = frames(self);
        self.run(MS(100))?;
        prop_assert_eq!(frames(self), before, "the controller has it");
        self.apply(&Op::Reachable { link: LinkId::STATE, yes: true })?;
        self.run(MS(6_000))?;
        let before = frames(self);
        self.state(0, 7, 0.0, true, 0)?;
        self.run(MS(10))?;
        prop_assert_eq!(frames(self), before, "it was away, and nobody knows the force since");
        self.device(3, &payload(FRAMES[3].1, [1, 1], true), 64)?;
        self.run(MS(10))?;
        prop_assert!(frames(self) > before + 2, "it was away");
        Ok(())
    }
}
