//! One engine in virtual time, with a controller and devices that do what a test says.
#![allow(dead_code, unreachable_pub, reason = "each test binary uses its own part of the rig")]

use std::collections::BTreeSet;

use proto_core::config::*;
use proto_core::device::Algorithm;
use proto_core::engine::{
    Engine, Handled, Input, LinkId, LinkInfo, LinkKind, OUTPUT_BUFFER, Output, PortCounters, PortId,
};
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::server::{RegisterBank, Server};
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{SysVar, VarRange};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;

pub fn var(name: &str) -> SysVar {
    SysVar::parse(name).unwrap()
}

pub const MS: fn(u64) -> Duration = Duration::from_millis;

/// A frame with the CRC of Modbus RTU behind it.
pub fn with_crc(bytes: &[u8]) -> Vec<u8> {
    let crc = Algorithm::named("crc16-modbus").unwrap().of([bytes]) as u16;
    [bytes, &crc.to_le_bytes()].concat()
}

/// Builds configurations in a few words.
pub struct Cell(pub GatewayConfig);

impl Cell {
    pub fn new() -> Self {
        let mut config = GatewayConfig::empty();
        config.set_controller("").unwrap();
        Self(config)
    }

    /// DigitalOutputCommand[1] by Modbus, with a safe value; its owner may be silent for 100 ms.
    pub fn guarded() -> (Self, PortId) {
        let mut cell = Self::new();
        let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
        let port = cell.rs485(recipe);
        cell.safe("DigitalOutputCommand[1]", 4.0);
        (cell, port)
    }

    pub fn fields(&mut self, fields: impl IntoIterator<Item = FieldSpec>) -> Span {
        let start = self.0.fields.len() as u16;
        self.0.fields.extend(fields);
        Span { start, len: self.0.fields.len() as u16 - start }
    }

    pub fn system(&mut self, names: &[&str]) -> Span {
        let vars = names.iter().flat_map(|name| VarRange::parse(name).unwrap().iter());
        let fields: Vec<_> = vars.map(FieldSpec::System).collect();
        self.fields(fields)
    }

    pub fn part(&mut self, head: &[u8], tail: &[u8], fields: Span) -> Option<StreamPart> {
        let bytes = |bytes| Delimiter::from_slice(bytes).unwrap();
        Some(StreamPart::new(bytes(head), bytes(tail), fields))
    }

    pub fn recipe(&mut self, mode: Mode, parts: Parts) -> u8 {
        let index = self.0.recipes.len() as u8;
        let name = Name::try_from(recipe_name(index).as_str()).unwrap();
        self.0.recipes.push(Recipe::new(name, mode, parts)).unwrap();
        index
    }

    /// A realtime stream recipe with the specification's heads and tails.
    pub fn stream(&mut self, input: &[&str], output: &[&str]) -> u8 {
        let name = recipe_name(self.0.recipes.len() as u8);
        let mut recipe = Recipe::realtime(&name);
        if !input.is_empty() {
            recipe = recipe.stream_input(&[255, 255], &[238, 238], input);
        }
        if !output.is_empty() {
            recipe = recipe.stream_output(&[255, 255], &[254, 254], output);
        }
        self.0.add_recipe(&recipe).unwrap()
    }

    pub fn can(&mut self, input: &[(u16, &[&str])], output: &[(u16, &[&str])]) -> u8 {
        let name = recipe_name(self.0.recipes.len() as u8);
        let [input, output] = [input, output].map(|frames| {
            frames.iter().map(|&(id, names)| CanFields::standard(id, names)).collect::<Vec<_>>()
        });
        self.0.add_recipe(&Recipe::realtime(&name).can_input(&input).can_output(&output)).unwrap()
    }

    pub fn last_recipe(&mut self) -> &mut Recipe {
        self.0.recipes.last_mut().unwrap()
    }

    pub fn last_port(&mut self) -> &mut Port {
        self.0.ports.last_mut().unwrap()
    }

    pub fn port(&mut self, bus: Bus, recipe: u8) -> PortId {
        let index = self.0.ports.len() as u8;
        let name = Name::try_from(format!("port{index}").as_str()).unwrap();
        let mut port = Port::new(name, bus, recipe);
        port.on_timeout.start = self.0.safe_values.len() as u16;
        self.0.ports.push(port).unwrap();
        PortId(index)
    }

    /// Without a turnaround: tests say when a line was silent.
    pub fn rs485(&mut self, recipe: u8) -> PortId {
        let line = Rs485 { turnaround: Duration::ZERO, ..Rs485::default() };
        self.port(Bus::Rs485(line), recipe)
    }

    pub fn can_port(&mut self, recipe: u8) -> PortId {
        self.port(Bus::Can { bitrate: Bus::BITRATE }, recipe)
    }

    pub fn recipe_link(&mut self, recipe: u8) {
        self.0.controller.recipe_link = Some(RecipeLink { udp_port: 2011, recipe });
    }

    pub fn safe(&mut self, name: &str, value: f64) {
        let var = var(name);
        let value = proto_core::wire::scalar::Scalar::from_f64(var.ty(), value).unwrap();
        self.0.safe_values.push(SafeValue::new(var, value)).unwrap();
        self.last_port().on_timeout.len += 1;
    }

    pub fn commands(&mut self, entries: &[(i64, &str)]) -> Span {
        let start = self.0.commands.len() as u16;
        for &(value, text) in entries {
            let text = heapless::String::try_from(text).unwrap();
            self.0.commands.push(CommandEntry::new(value, text)).unwrap();
        }
        Span { start, len: entries.len() as u16 }
    }

    pub fn rig(&self) -> Rig {
        Rig::new(&self.0)
    }
}

/// The cell of [`Cell::guarded`], running.
pub fn guarded() -> (Rig, PortId) {
    let (cell, port) = Cell::guarded();
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

fn recipe_name(index: u8) -> String {
    format!("recipe{index}")
}

pub fn user_in(ty: ScalarType, to: InputBinding) -> FieldSpec {
    FieldSpec::UserInput { ty, to }
}

pub fn user_out(ty: ScalarType, from: OutputBinding) -> FieldSpec {
    FieldSpec::UserOutput { ty, from }
}

/// A write that the controller's Modbus server carried out.
#[derive(Debug, Clone, PartialEq)]
pub enum Written {
    Coils(u16, Vec<bool>),
    Registers(u16, Vec<u16>),
}

/// A write of eight coils, the first in the least significant bit.
pub fn coils(address: u16, byte: u8) -> Written {
    Written::Coils(address, (0..8).map(|bit| byte >> bit & 1 == 1).collect())
}

/// The controller's Modbus map, as far as a test needs it.
pub struct Map {
    pub coils: [bool; 232],
    pub registers: [u16; 118],
    pub written: Vec<Written>,
    pub exception: Option<Exception>,
}

impl RegisterBank for Map {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let wanted = self.coils.get(usize::from(address)..usize::from(address + count));
        let coils = wanted.ok_or(Exception::IllegalDataAddress)?;
        for (nth, &on) in coils.iter().enumerate() {
            packed[nth / 8] |= u8::from(on) << (nth % 8);
        }
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        if let Some(exception) = self.exception {
            return Err(exception);
        }
        let values: Vec<bool> = coils.iter().collect();
        self.coils[usize::from(address)..][..values.len()].copy_from_slice(&values);
        self.written.push(Written::Coils(address, values));
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        for (word, value) in words.iter_mut().zip(&self.registers[usize::from(address)..]) {
            *word = value.to_be_bytes();
        }
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        if let Some(exception) = self.exception {
            return Err(exception);
        }
        let values: Vec<u16> = registers.iter().collect();
        self.registers[usize::from(address)..][..values.len()].copy_from_slice(&values);
        self.written.push(Written::Registers(address, values));
        Ok(())
    }
}

/// What the engine handed over.
#[derive(Debug, Clone, PartialEq)]
pub enum Out {
    Port(PortId, Vec<u8>),
    Can(PortId, CanFrame),
    Open(LinkId),
    Close(LinkId),
    Link(LinkId, Vec<u8>),
    /// No output: a tick was reported. Only with [`Rig::logs_ticks`].
    Tick,
}

pub struct Rig {
    pub engine: Box<Engine>,
    pub now: Instant,
    pub wake: Instant,
    /// When the engine was called last.
    pub called: Instant,
    pub map: Map,
    server: Server,
    /// A link was refused while outputs were drained.
    reacted: bool,
    /// Links that come up as soon as they are opened.
    pub reachable: BTreeSet<u8>,
    /// Links that neither come up nor are refused when they are opened.
    pub unanswered: BTreeSet<u8>,
    /// Whether Modbus requests are answered at once.
    pub modbus_answers: bool,
    /// Whether ports and links report at once that everything was sent.
    pub reports_sent: bool,
    /// Whether the controller's TCP acknowledges at once what has left.
    pub acknowledges: bool,
    /// Whether ticks are in the log.
    pub logs_ticks: bool,
    /// Everything handed over that no test has taken yet.
    pub log: Vec<(Instant, Out)>,
}

impl Rig {
    pub fn new(config: &GatewayConfig) -> Self {
        let engine = Engine::new(config).unwrap_or_else(|error| panic!("{error}: {error:?}"));
        let map = Map { coils: [false; 232], registers: [0; 118], written: Vec::new(), exception: None };
        let mut rig = Self {
            engine: Box::new(engine),
            now: Instant::from_millis(1_000_001),
            wake: Instant::ZERO,
            called: Instant::ZERO,
            map,
            server: Server::new(),
            reacted: false,
            reachable: (0..16).collect(),
            unanswered: BTreeSet::new(),
            modbus_answers: true,
            reports_sent: true,
            acknowledges: true,
            logs_ticks: false,
            log: Vec::new(),
        };
        let ports: Vec<_> = rig.engine.field_ports().collect();
        for port in ports {
            rig.input(Input::PortUp { port });
        }
        rig
    }

    /// One input, and everything that follows from it at this instant.
    pub fn input(&mut self, input: Input<'_>) {
        let (handled, before) = (self.engine.handle(self.now, input), (self.wake, self.log.len()));
        self.called = self.now;
        if self.logs_ticks && matches!(input, Input::Tick) {
            self.log.push((self.now, Out::Tick));
        }
        self.drain();
        if handled == Handled::Asleep {
            assert_eq!((self.wake, self.log.len()), before, "{input:?} was said to lead to nothing");
        }
        if matches!(input, Input::Tick) {
            if self.reacted && self.wake <= self.now {
                // What the controller did meanwhile is due at once.
                self.engine.handle(self.now, input);
                self.drain();
            }
            assert!(self.wake > self.now, "asked to be called at once again: {:?}", self.wake);
        }
    }

    pub fn bytes(&mut self, port: PortId, bytes: &[u8]) {
        self.input(Input::PortBytes { port, bytes });
    }

    pub fn can(&mut self, port: PortId, id: u16, data: &[u8]) {
        let frame = CanFrame::new(CanId::Standard(id), data).unwrap();
        self.input(Input::PortCan { port, frame });
    }

    pub fn link_bytes(&mut self, link: LinkId, bytes: &[u8]) {
        self.input(Input::LinkBytes { link, bytes });
    }

    /// Time passes; the engine is called whenever it asked to be.
    pub fn run(&mut self, span: Duration) {
        let end = self.now + span;
        while self.wake <= end {
            self.now = self.wake.max(self.now);
            self.input(Input::Tick);
        }
        self.now = end;
    }

    #[track_caller]
    pub fn counters(&self, port: PortId) -> PortCounters {
        *self.engine.port_counters(port).unwrap()
    }

    #[track_caller]
    pub fn link(&self, id: LinkId) -> LinkInfo<'_> {
        self.engine.links().find(|link| link.id == id).expect("the plan needs this link")
    }

    /// What was handed over to one port since the last call of this kind.
    pub fn sent_to(&mut self, port: PortId) -> Vec<Vec<u8>> {
        self.take(|out| match out {
            Out::Port(to, bytes) if *to == port => Some(bytes.clone()),
            _ => None,
        })
    }

    pub fn can_sent_to(&mut self, port: PortId) -> Vec<CanFrame> {
        self.take(|out| match out {
            Out::Can(to, frame) if *to == port => Some(*frame),
            _ => None,
        })
    }

    pub fn sent_on(&mut self, link: LinkId) -> Vec<Vec<u8>> {
        self.take(|out| match out {
            Out::Link(to, bytes) if *to == link => Some(bytes.clone()),
            _ => None,
        })
    }

    /// What was handed over to one link since the last call of this kind, and how many milliseconds
    /// after `since`.
    pub fn sent_after(&mut self, link: LinkId, since: Instant) -> Vec<(u64, Vec<u8>)> {
        let sent = |entry: &(Instant, Out)| match entry {
            (at, Out::Link(to, bytes)) if *to == link => Some((*at, bytes.clone())),
            _ => None,
        };
        let all: Vec<_> = self.log.iter().filter_map(sent).collect();
        self.log.retain(|entry| sent(entry).is_none());
        all.into_iter().map(|(at, bytes)| (at.saturating_since(since).as_millis(), bytes)).collect()
    }

    /// When links were closed since the last call of this kind.
    pub fn closed(&mut self) -> Vec<(Instant, LinkId)> {
        let closed = |&(at, ref out): &(Instant, Out)| match out {
            Out::Close(link) => Some((at, *link)),
            _ => None,
        };
        let closings = self.log.iter().filter_map(closed).collect();
        self.log.retain(|entry| closed(entry).is_none());
        closings
    }

    /// The peer's transport has acknowledged all but so many bytes.
    pub fn acked(&mut self, link: LinkId, left: usize) {
        self.input(Input::LinkAcked { link, left: left as u32 });
    }

    pub fn take<T>(&mut self, pick: impl Fn(&Out) -> Option<T>) -> Vec<T> {
        let picked = self.log.iter().filter_map(|(_, out)| pick(out)).collect();
        self.log.retain(|(_, out)| pick(out).is_none());
        picked
    }

    pub fn take_written(&mut self) -> Vec<Written> {
        std::mem::take(&mut self.map.written)
    }

    fn drain(&mut self) {
        self.reacted = false;
        let mut buf = [0xA5; OUTPUT_BUFFER];
        // Far more than one input can lead to: what never ends is a bug.
        for _ in 0..10_000 {
            let out = match self.engine.poll_output(self.now, &mut buf) {
                Output::Sleep { until } => {
                    let needed = self.engine.deadline();
                    // What is due already waits for the tick that is late.
                    assert!(until <= needed.max(self.now), "sleeps until {until:?} and misses {needed:?}");
                    self.wake = until;
                    return;
                }
                Output::PortSend { port, bytes } => Out::Port(port, bytes.to_vec()),
                Output::PortSendCan { port, frame } => Out::Can(port, frame),
                Output::LinkOpen { link, .. } => Out::Open(link),
                Output::LinkClose { link } => Out::Close(link),
                Output::LinkSend { link, bytes } => Out::Link(link, bytes.to_vec()),
                other => panic!("{other:?}"),
            };
            self.log.push((self.now, out.clone()));
            self.react(out);
        }
        panic!("the engine does not come to rest");
    }

    fn react(&mut self, out: Out) {
        match out {
            Out::Open(link) if self.unanswered.contains(&link.0) => {}
            Out::Open(link) if self.reachable.contains(&link.0) => {
                self.engine.handle(self.now, Input::LinkUp { link });
            }
            Out::Open(link) => {
                self.reacted = true;
                self.engine.handle(self.now, Input::LinkDown { link });
            }
            Out::Port(port, _) | Out::Can(port, _) if self.reports_sent => {
                self.engine.handle(self.now, Input::PortSent { port });
            }
            Out::Link(link, bytes) => {
                if self.reports_sent {
                    self.engine.handle(self.now, Input::LinkSent { link });
                }
                let is_tcp = |info: &LinkInfo<'_>| {
                    !matches!(info.kind, LinkKind::RecipeUdp | LinkKind::RecipeUdpListen { .. })
                };
                if self.reports_sent && self.acknowledges && is_tcp(&self.link(link)) {
                    self.engine.handle(self.now, Input::LinkAcked { link, left: 0 });
                }
                if link == LinkId::MODBUS && self.modbus_answers {
                    let answer = self.answer(&bytes);
                    self.engine.handle(self.now, Input::LinkBytes { link, bytes: &answer });
                }
            }
            _ => {}
        }
    }

    /// What the controller's Modbus server answers.
    pub fn answer(&mut self, request: &[u8]) -> Vec<u8> {
        let mut rest = request;
        let mut answers = Vec::new();
        let mut out = [0; MAX_ADU];
        while let Some(answer) = self.server.receive(&mut rest, &mut self.map, &mut out) {
            answers.extend_from_slice(&out[..answer.unwrap()]);
        }
        answers
    }
}
