//! The cell, and a model of it that knows only what was received and when.
//!
//! It keeps every accepted value of every variable, and looks at each value on its way to the
//! controller: who sent it, when, and was the link up when it came?

#![allow(unreachable_pub, reason = "a module of a test binary")]

use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use proto_core::config::GatewayConfig;
use proto_core::engine::{LinkId, PortId};
use proto_core::time::{Duration, Instant};

use super::rig::*;

pub const IDLE_GAP: Duration = Duration::from_millis(50);
pub const READ_BACK: Duration = Duration::from_millis(500);
pub const DISCARDS_FOR: Duration = Duration::from_millis(50);
pub const UDP: LinkId = LinkId::RECIPE_UDP;

/// Modbus: a bit byte that becomes safe, and a word that holds.
pub const PLC: PortId = PortId(0);
/// CAN, Modbus: a bit byte in one frame, two words in another; all hold.
pub const BUS: PortId = PortId(1);
/// UDP: a force, which cannot be read back, and a bit byte, both hold.
pub const SENSOR: PortId = PortId(2);
/// UDP: a float that becomes safe.
pub const KNOB: PortId = PortId(3);

pub const OUT1: &str = "DigitalOutputCommand[1]";
pub const OUT2: &str = "DigitalOutputCommand[2]";
pub const BITS3: &str = "BitInputReg[3]";
pub const WORD1: &str = "WordInputReg[1]";
pub const WORD2: &str = "WordInputReg[2]";
pub const WORD3: &str = "WordInputReg[3]";
pub const WORD32: &str = "WordInputReg[32]";
pub const FORCE: &str = "ForceEnd[1]";
pub const FLOAT: &str = "FloatInputReg[1]";

/// The ports' timeouts: some longer than the shortest wait for a link, some not.
pub const TIMEOUTS: [Duration; 4] = [
    Duration::from_millis(1_500),
    Duration::from_millis(100),
    Duration::from_millis(700),
    Duration::from_millis(300),
];

/// The frames that devices send, each with its variables.
pub const FRAMES: [(PortId, &[&str]); 5] = [
    (PLC, &[OUT1, WORD1]),
    (BUS, &[BITS3]),
    (BUS, &[WORD2, WORD3]),
    (SENSOR, &[FORCE, OUT2]),
    (KNOB, &[FLOAT]),
];
pub const SAFE_OUT1: u32 = 0x5A;
pub const SAFE_FLOAT: f32 = -0.5;

pub fn cell() -> GatewayConfig {
    let mut cell = Cell::new();
    let up = cell.stream(&[FORCE, OUT2, WORD32, FLOAT], &["RobotState[26]"]);
    cell.recipe_link(up);
    let recipe = cell.stream(&[OUT1, WORD1], &["DigitalSignalStatus[1]"]);
    assert_eq!(cell.rs485(recipe), PLC);
    cell.safe(OUT1, f64::from(SAFE_OUT1));
    let recipe =
        cell.can(&[(1, &[BITS3]), (5, &[WORD2, WORD3])], &[(9, &["RobotState[8]"]), (8, &["RobotState[9]"])]);
    assert_eq!(cell.can_port(recipe), BUS);
    let recipe = cell.stream(&[FORCE, OUT2], &[]);
    assert_eq!(cell.rs485(recipe), SENSOR);
    let recipe = cell.stream(&[FLOAT], &["RobotState[26]"]);
    assert_eq!(cell.rs485(recipe), KNOB);
    cell.safe(FLOAT, f64::from(SAFE_FLOAT));
    for (port, timeout) in cell.0.ports.iter_mut().zip(TIMEOUTS) {
        port.timeout = timeout;
    }
    cell.0
}

/// What the model knows of a variable that a device owns.
#[derive(Debug, Clone, Default)]
pub struct Known {
    /// Every accepted value, and in between the safe value each time the owner fell silent.
    pub received: Vec<(Instant, u32)>,
    /// How many of `received` the writes so far have used up.
    pub used: usize,
    pub last_written: Option<u32>,
    /// What was written, without repetitions, since the test last looked.
    pub steps: Vec<u32>,
    pub newest_at: Option<Instant>,
    /// The owner has fallen silent since.
    pub silent: bool,
}

/// The deframer of a port, by the letter of D19.
#[derive(Debug, Clone, Default)]
pub struct PortDeframer {
    pub held: Vec<u8>,
    pub heard: Option<Instant>,
    pub bytes: u32,
    pub dropped: u32,
}

pub struct Model {
    pub vars: BTreeMap<&'static str, Known>,
    pub deframers: BTreeMap<PortId, PortDeframer>,
    /// When links came up.
    pub up: BTreeMap<LinkId, Instant>,
    /// The newest good state packet: when, and what it said of variables that can be read back.
    pub packet: Option<Instant>,
    /// When anything came that the controller sends steadily.
    pub heard: Option<Instant>,
    /// When a frame last went up the recipe link to the controller as it is known now.
    pub handed_over: Option<Instant>,
    pub read_back: BTreeMap<&'static str, (Instant, u32)>,
    pub shown: BTreeSet<u32>,
    pub accepted: [u32; 4],
    pub not_finite: [u32; 4],
    pub timeouts: [u32; 4],
    pub undelivered: [u32; 4],
    pub out: [u32; 4],
    pub wrong_can: u32,
    pub sent: BTreeMap<LinkId, u32>,
    pub port_up: [bool; 4],
    pub bus_off: bool,
    pub sleeps: u32,
    /// The gateway slept: until a tick at or after this, nothing that arrives from the field counts.
    pub discards_until: Option<Instant>,
    pub asleep: [u32; 4],
    /// What the newest state packet or frame says of a shown variable cannot be read.
    pub bus_is_unreadable: bool,
    pub knob_is_unreadable: bool,
    pub unreadable: BTreeMap<LinkId, u32>,
}

pub fn timeout(port: PortId) -> Duration {
    TIMEOUTS[usize::from(port.0)]
}

pub fn owner(name: &str) -> PortId {
    FRAMES.iter().find(|(_, names)| names.contains(&name)).unwrap().0
}

pub fn safe_value(name: &str) -> Option<u32> {
    match name {
        OUT1 => Some(SAFE_OUT1),
        FLOAT => Some(SAFE_FLOAT.to_bits()),
        _ => None,
    }
}

pub fn carrier(name: &str) -> LinkId {
    if [FORCE, OUT2, FLOAT].contains(&name) { UDP } else { LinkId::MODBUS }
}

/// A frame's payload from small numbers.
pub fn payload(names: &[&str], values: [u16; 2], finite: bool) -> Vec<u8> {
    let fields = names.iter().zip(values).map(|(&name, value)| match name {
        FORCE | FLOAT if !finite => f32::NAN.to_le_bytes().to_vec(),
        FORCE | FLOAT => f32::from(value).to_le_bytes().to_vec(),
        WORD1 | WORD2 | WORD3 => value.to_le_bytes().to_vec(),
        _ => vec![value as u8],
    });
    fields.flatten().collect()
}

pub fn size(name: &str) -> usize {
    match name {
        FORCE | FLOAT => 4,
        WORD1 | WORD2 | WORD3 | WORD32 => 2,
        _ => 1,
    }
}

pub fn raw(bytes: &[u8]) -> u32 {
    bytes.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte))
}

impl Model {
    pub fn new() -> Self {
        let names = FRAMES.iter().flat_map(|(_, names)| names.iter().copied());
        Self {
            vars: names.map(|name| (name, Known::default())).collect(),
            deframers: BTreeMap::new(),
            up: BTreeMap::new(),
            packet: None,
            heard: None,
            handed_over: None,
            read_back: BTreeMap::new(),
            shown: BTreeSet::new(),
            accepted: [0; 4],
            not_finite: [0; 4],
            timeouts: [0; 4],
            undelivered: [0; 4],
            out: [0; 4],
            wrong_can: 0,
            sent: BTreeMap::new(),
            port_up: [true; 4],
            bus_off: false,
            sleeps: 0,
            discards_until: None,
            asleep: [0; 4],
            bus_is_unreadable: false,
            knob_is_unreadable: false,
            unreadable: BTreeMap::new(),
        }
    }

    /// A tick: deadlines pass.
    pub fn tick(&mut self, now: Instant) {
        self.discards_until = self.discards_until.filter(|&until| now < until);
        self.advance(now);
    }

    /// The gateway slept: deadlines pass, nothing of what had begun is continued.
    pub fn slept(&mut self, now: Instant) {
        self.sleeps += 1;
        self.advance(now);
        for line in self.deframers.values_mut() {
            line.dropped += line.held.len() as u32;
            line.held.clear();
        }
        self.up.clear();
        self.discards_until = Some(now + DISCARDS_FOR);
    }

    pub fn live(&self, name: &str) -> bool {
        self.vars[name].newest_at.is_some() && (!self.vars[name].silent || safe_value(name).is_some())
    }

    /// Owners that have fallen silent by `now`, and parts of frames that nobody completed.
    fn advance(&mut self, now: Instant) {
        for (port, names) in FRAMES {
            let overdue = self.vars[names[0]].newest_at.is_some_and(|at| now >= at + timeout(port));
            if !overdue || self.vars[names[0]].silent {
                continue;
            }
            self.timeouts[usize::from(port.0)] += 1;
            for &name in names {
                let known = self.vars.get_mut(name).unwrap();
                known.silent = true;
                if let Some(safe) = safe_value(name) {
                    known.received.push((now, safe));
                } else {
                    self.read_back.remove(name);
                }
            }
        }
        for line in self.deframers.values_mut() {
            if line.heard.is_some_and(|heard| now >= heard + IDLE_GAP) {
                line.dropped += line.held.len() as u32;
                line.held.clear();
            }
        }
    }

    pub fn accept(&mut self, frame: usize, payload: &[u8], now: Instant) {
        let (port, names) = FRAMES[frame];
        let nth = usize::from(port.0);
        let mut rest = payload;
        let mut values = Vec::new();
        for name in names {
            let (value, after) = rest.split_at(size(name));
            values.push(raw(value));
            rest = after;
        }
        let finite = |(name, value): (&&str, &u32)| size(name) < 4 || f32::from_bits(*value).is_finite();
        if !names.iter().zip(&values).all(finite) {
            self.not_finite[nth] += 1;
            return;
        }
        self.accepted[nth] += 1;
        self.undelivered[nth] += u32::from(names.iter().any(|name| !self.up.contains_key(&carrier(name))));
        for (&name, value) in names.iter().zip(values) {
            let known = self.vars.get_mut(name).unwrap();
            known.received.push((now, value));
            known.newest_at = Some(now);
            known.silent = false;
        }
    }

    pub fn line(&mut self, port: PortId, bytes: &[u8], now: Instant) {
        let frame = FRAMES.iter().position(|&(of, _)| of == port).unwrap();
        let len = 4 + FRAMES[frame].1.iter().map(|name| size(name)).sum::<usize>();
        let line = self.deframers.entry(port).or_default();
        line.heard = Some(now);
        line.bytes += bytes.len() as u32;
        if self.discards_until.is_some() {
            line.dropped += bytes.len() as u32;
            self.asleep[usize::from(port.0)] += 1;
            return;
        }
        line.held.extend(bytes);
        loop {
            let held = &mut self.deframers.get_mut(&port).unwrap();
            let begins = held.held.iter().zip([255, 255]).all(|(a, b)| *a == b);
            if held.held.is_empty() || begins && held.held.len() < len {
                return;
            }
            if begins && held.held[len - 2..len] == [238, 238] {
                let frame_bytes: Vec<u8> = held.held.drain(..len).collect();
                self.accept(frame, &frame_bytes[2..len - 2], now);
            } else {
                held.held.remove(0);
                held.dropped += 1;
            }
        }
    }

    /// A value goes to the controller.
    pub fn written(&mut self, name: &'static str, value: u32, now: Instant) -> Result<(), TestCaseError> {
        let up = self.up.get(&carrier(name)).copied();
        prop_assert!(up.is_some(), "{name} on a link that is down");
        let live = self.live(name);
        let known = self.vars.get_mut(name).unwrap();
        // A safe value stands until its owner is back; it is still to be written only if the link was
        // up when that happened.
        let until = |nth: usize| known.received.get(nth + 1).map_or(Instant::NEVER, |&(at, _)| at);
        let stood = |(nth, &(_, of)): (usize, &(Instant, u32))| of == value && Some(until(nth)) >= up;
        let safe = safe_value(name) == Some(value) && known.received.iter().enumerate().any(stood);
        let came =
            |&&(at, of): &&(Instant, u32)| of == value && now.saturating_since(at) <= timeout(owner(name));
        if carrier(name) == LinkId::MODBUS {
            // What came before the connection is not replayed on it.
            let fresh = known.received.iter().filter(came).any(|&(at, _)| Some(at) >= up);
            prop_assert!(fresh || safe, "{name} = {value:#x} at {now:?}: {known:?}");
        } else if live {
            prop_assert!(known.received.iter().any(|r| came(&r)) || safe, "{name} = {value:#x}: {known:?}");
        } else if name == FORCE {
            // Nothing to read back: what its owner sent last is held.
            prop_assert_eq!(Some(value), known.received.last().map(|r| r.1), "{} is held", name);
            let is_there = self.handed_over.is_some() && self.handed_over >= known.newest_at;
            prop_assert!(is_there, "{name} = {value:#x} was never given to this controller");
            let is_young = self.heard.is_some_and(|at| now.saturating_since(at) <= READ_BACK);
            prop_assert!(is_young, "{name} = {value:#x}: is the controller there?");
            return Ok(());
        } else {
            let read = self.read_back.get(name);
            prop_assert!(read.is_some_and(|&(_, of)| of == value), "{name} = {value:#x}, not {read:?}");
            prop_assert!(self.packet.is_some_and(|at| now.saturating_since(at) <= READ_BACK));
            return Ok(());
        }
        // In the order in which it was received; repeating the same value is no step back.
        if known.last_written != Some(value) {
            let next = known.received[known.used..].iter().position(|&(_, of)| of == value);
            prop_assert!(next.is_some(), "{name} = {value:#x} is a step back: {known:?}");
            known.used += next.map_or(0, |next| next + 1);
            known.last_written = Some(value);
            known.steps.push(value);
        }
        Ok(())
    }

    /// A packet came from the controller, or a frame of the recipe link.
    pub fn heard(&mut self, now: Instant) {
        if self.heard.replace(now).is_none_or(|at| now.saturating_since(at) > READ_BACK) {
            // It may have begun anew.
            self.handed_over = None;
        }
    }

    pub fn modbus(&mut self, request: &[u8], now: Instant) -> Result<(), TestCaseError> {
        let mut address = u16::from_be_bytes([request[8], request[9]]);
        let mut data = &request[13.min(request.len())..];
        match request[7] {
            0x0F => {
                while let Some((&byte, rest)) = data.split_first() {
                    let name = match address {
                        192 => OUT1,
                        32 => BITS3,
                        other => return Err(TestCaseError::fail(format!("nobody sends coil {other}"))),
                    };
                    self.written(name, u32::from(byte), now)?;
                    (data, address) = (rest, address + 8);
                }
            }
            0x10 => {
                while let Some((word, rest)) = data.split_first_chunk() {
                    let name = match address {
                        8 => WORD1,
                        9 => WORD2,
                        10 => WORD3,
                        other => return Err(TestCaseError::fail(format!("nobody sends register {other}"))),
                    };
                    self.written(name, u32::from(u16::from_be_bytes(*word)), now)?;
                    (data, address) = (rest, address + 1);
                }
            }
            1 | 3 => {}
            other => return Err(TestCaseError::fail(format!("function {other}"))),
        }
        Ok(())
    }

    pub fn udp(&mut self, datagram: &[u8], now: Instant) -> Result<(), TestCaseError> {
        if datagram == [0] {
            return Ok(());
        }
        prop_assert_eq!(
            (datagram.len(), &datagram[..2], &datagram[13..]),
            (15, &[255, 255][..], &[238, 238][..])
        );
        self.written(FORCE, raw(&datagram[2..6]), now)?;
        self.written(OUT2, raw(&datagram[6..7]), now)?;
        self.written(FLOAT, raw(&datagram[9..13]), now)?;
        self.handed_over = Some(now);
        let read = self.read_back.get(WORD32);
        prop_assert!(read.is_some_and(|&(_, value)| value == raw(&datagram[7..9])), "{datagram:?} {read:?}");
        prop_assert!(self.packet.is_some_and(|at| now.saturating_since(at) <= READ_BACK));
        Ok(())
    }
}
