//! Any configuration, any inputs of a driver that keeps the contract (docs/driver.md)
//! or does not: the engine keeps its side of it, and does no more for one input than it may.

use proto_core::config::{
    Bus, CommandWhen, FieldSpec, GatewayConfig, InputBinding, OnStale, OutputBinding, Parts, SendOn, image,
};
use proto_core::engine::{BusState, Engine, Input, LinkId, LinkKind, OUTPUT_BUFFER, Output, PortId};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;

use crate::rig::Cell;
use crate::source::Source;

/// Inputs of one run.
const MOST: usize = 200;
/// What all ports and links may say at one instant: each port a frame or 32 CAN frames, each link an
/// action and a request.
const MOST_OUTPUTS: usize = 8 * 32 + 2 * LINKS;
/// A configured engine is called at least so often.
const HEARTBEAT: Duration = Duration::from_millis(250);
/// Command, state, Modbus, UDP 2011, a listening port each, urgent.
const LINKS: usize = 13;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let Some(config) = config(&mut input) else { return };
    let valid = config.validate();
    let engine = Engine::<8, 4, 512>::new(&*config);
    assert!(valid.is_ok() || engine.is_err(), "{valid:?}");
    let mut bytes = vec![0xA5; image::MAX_IMAGE];
    // The largest configurations have no image.
    if let Ok(len) = image::encode(&*config, &mut bytes) {
        match image::decode(&bytes[..len]) {
            Ok(read) => assert!(valid.is_ok() && read == *config),
            Err(error) => assert_eq!(Some(error), valid.err().map(image::ImageError::Config)),
        }
    }
    let Ok(engine) = engine else { return };
    let mut driver = Driver::new(config, engine, input.u8());
    for _ in 0..MOST {
        if input.is_empty() {
            break;
        }
        driver.step(&mut input);
    }
}

/// A configuration; `None` when there is no room for what the input asks.
pub(crate) fn config(input: &mut Source<'_>) -> Option<Box<GatewayConfig>> {
    let mut cell = Cell::new();
    let recipes = 1 + input.below(5);
    for _ in 0..recipes {
        recipe(&mut cell, input)?;
    }
    let kind = input.u8();
    if kind & 1 == 1 {
        cell.recipe_link(input.below(recipes) as u8);
    }
    for _ in 0..=(kind >> 5) {
        port(&mut cell, input, recipes)?;
    }
    Some(Box::new(cell.0))
}

fn var(input: &mut Source<'_>, direction: Direction) -> SysVar {
    // Those of which there are many, and those with edges, alike.
    let groups: &[&str] = match direction {
        Direction::Input => {
            &["DigitalOutputCommand", "BitInputReg", "WordInputReg", "FloatInputReg", "ForceEnd", "ForceBase"]
        }
        Direction::Output => &[
            "DigitalSignalStatus",
            "RobotState",
            "BitOutputReg",
            "WordOutputReg",
            "FloatOutputReg",
            "RobotState",
        ],
    };
    let group = input.one_of(groups);
    let vars: Vec<SysVar> = SysVar::all().filter(|var| var.group() == group).collect();
    input.one_of(&vars)
}

fn fields(
    input: &mut Source<'_>,
    mode: Mode,
    direction: Direction,
    table: proto_core::config::Span,
    most: usize,
) -> Vec<FieldSpec> {
    let count = 1 + input.below(most);
    let mut fields = Vec::new();
    for _ in 0..count {
        let kind = input.u8();
        let ty = ScalarType::ALL[usize::from(kind & 7)];
        let (scale, offset) = ([1.0, 0.5, -2.0, 1000.0][usize::from(kind >> 6)], f32::from(kind >> 5 & 1));
        let which = kind >> 3 & 3;
        let any = if input.flag() { Direction::Input } else { Direction::Output };
        let field = match (mode, direction) {
            (Mode::Realtime, direction) => {
                let first = var(input, direction);
                let range = (first.ordinal()..first.ordinal() + usize::from(kind >> 5) + 1)
                    .map_while(SysVar::from_ordinal);
                fields
                    .extend(range.skip(1).filter(|var| var.direction() == direction).map(FieldSpec::System));
                FieldSpec::System(first)
            }
            (Mode::User, Direction::Input) => FieldSpec::UserInput {
                ty,
                to: match which {
                    0 => InputBinding::Unused,
                    1 => InputBinding::Commands {
                        table,
                        when: match kind >> 5 & 3 {
                            0 => CommandWhen::Change,
                            2 => CommandWhen::Kept,
                            _ => CommandWhen::Frame,
                        },
                    },
                    2 if kind >> 6 == 3 => {
                        InputBinding::Bit { var: var(input, Direction::Input), bit: input.u8() & 7 }
                    }
                    _ => InputBinding::Variable { var: var(input, Direction::Input), scale, offset },
                },
            },
            (Mode::User, Direction::Output) => FieldSpec::UserOutput {
                ty,
                from: match which {
                    0 => OutputBinding::Counter,
                    1 => OutputBinding::Reply,
                    2 => OutputBinding::Constant(f64::from(kind)),
                    _ if kind >> 6 == 3 => OutputBinding::Bit { var: var(input, any), bit: input.u8() & 7 },
                    _ => OutputBinding::Variable { var: var(input, any), scale, offset },
                },
            },
        };
        fields.push(field);
    }
    fields
}

fn recipe(cell: &mut Cell, input: &mut Source<'_>) -> Option<()> {
    let kind = input.u8();
    let mode = if kind & 1 == 0 { Mode::Realtime } else { Mode::User };
    let table = if mode == Mode::User && cell.0.commands.len() < 20 {
        cell.commands(&[
            (0, "stop"),
            (1, "run(pick.jspf,50)"),
            (2, "state"),
            (3, "getlasterror"),
            (4, "pause"),
            (5, "poweroff"),
        ])
    } else {
        proto_core::config::Span::default()
    };
    let room = |cell: &Cell, more: usize| (cell.0.fields.len() + more <= 1024).then_some(());
    let parts = if kind & 2 == 0 {
        let mut part = |which: u8, direction, delimiters: [&[u8]; 2]| {
            if which != 0 && kind & which == 0 {
                return Some(None);
            }
            let fields = fields(input, mode, direction, table, 12);
            room(cell, fields.len())?;
            let span = cell.fields(fields);
            Some(cell.part(delimiters[0], delimiters[1], span))
        };
        let head: &[u8] = if kind & 16 == 0 { &[255, 255] } else { &[] };
        let input = part(4, Direction::Input, [head, &[238, 238]])?;
        let output = part(if input.is_some() { 8 } else { 0 }, Direction::Output, [head, &[254, 254]])?;
        Parts::Stream { input, output }
    } else {
        let mut part = |first: u16, direction| {
            let count = input.below(6);
            let mut frames = heapless::Vec::new();
            for nth in 0..count as u16 {
                let fields = fields(input, mode, direction, table, 2);
                room(cell, fields.len())?;
                let id = if nth == 4 {
                    CanId::Extended(0x1FFF_FF00 | u32::from(nth))
                } else {
                    CanId::Standard(first + nth)
                };
                frames.push(proto_core::config::CanFramePart { id, fields: cell.fields(fields) }).ok()?;
            }
            Some(frames)
        };
        Parts::Can { input: part(1, Direction::Input)?, output: part(10, Direction::Output)? }
    };
    cell.recipe(mode, parts);
    cell.last_recipe().on_stale = if kind & 32 == 0 { OnStale::Hold } else { OnStale::Stop };
    if mode == Mode::User {
        cell.last_recipe().send = match kind >> 6 {
            0 => SendOn::Period,
            1 => SendOn::Change,
            2 => SendOn::Frame,
            _ => SendOn::Rising { var: var(input, Direction::Output), bit: input.u8() & 7 },
        };
    }
    Some(())
}

fn port(cell: &mut Cell, input: &mut Source<'_>, recipes: usize) -> Option<()> {
    let (kind, recipe) = (input.u8(), input.below(recipes) as u8);
    let listen = || heapless::String::try_from("0.0.0.0:50000").ok();
    match kind & 7 {
        0..4 => drop(cell.rs485(recipe)),
        4 | 5 => drop(cell.can_port(recipe)),
        6 => drop(cell.port(Bus::TcpListen { listen: listen()? }, recipe)),
        _ => drop(cell.port(Bus::UdpListen { listen: listen()? }, recipe)),
    }
    let port = cell.last_port();
    port.cycle = Duration::from_millis([4, 5, 20, 100][usize::from(kind >> 3 & 3)]);
    port.timeout = Duration::from_millis([20, 100, 1_500][usize::from(kind >> 5) % 3]);
    if kind & 128 != 0 && cell.0.safe_values.len() < 60 {
        let var = var(input, Direction::Input);
        cell.safe(&var.to_string(), f64::from(input.u8() & 3));
    }
    Some(())
}

struct Driver {
    config: Box<GatewayConfig>,
    engine: Box<Engine<8, 4, 512>>,
    now: Instant,
    wake: Instant,
    /// Whether it keeps its side of the contract.
    honest: bool,
    ports: [Port; 9],
    links: [Link; LINKS],
    /// The newest Modbus request.
    asked: Vec<u8>,
}

#[derive(Clone, Copy, Default)]
struct Port {
    up: bool,
    sending: usize,
}

#[derive(Clone, Copy, Default)]
struct Link {
    opening: bool,
    up: bool,
    sending: bool,
    datagram: bool,
    /// Bytes that the peer has not acknowledged.
    unacknowledged: u32,
}

impl Driver {
    fn new(config: Box<GatewayConfig>, engine: Engine<8, 4, 512>, kind: u8) -> Self {
        let mut driver = Self {
            config,
            engine: Box::new(engine),
            now: Instant::from_millis(5_000),
            wake: Instant::ZERO,
            honest: kind & 3 != 3,
            ports: [Port::default(); 9],
            links: [Link::default(); LINKS],
            asked: Vec::new(),
        };
        for info in driver.engine.links() {
            let datagram = matches!(info.kind, LinkKind::RecipeUdp | LinkKind::RecipeUdpListen { .. });
            driver.links[usize::from(info.id.0)].datagram = datagram;
        }
        driver.handle(Input::Tick);
        driver
    }

    fn step(&mut self, input: &mut Source<'_>) {
        let op = input.u8();
        // Time passes, and the engine is called when it asked to be, or later.
        let pass = u64::from(op >> 4);
        if op.is_multiple_of(16) {
            let end = self.now + Duration::from_micros(pass * pass * pass * 300 + 1);
            if matches!(pass, 11 | 13) {
                // Nobody calls the engine for 0.4 s, or for 0.66 s: what comes next is told before the tick.
                self.now = end;
                return;
            }
            for _ in 0..100 {
                if self.wake > end {
                    break;
                }
                self.now = self.now.max(self.wake);
                self.handle(Input::Tick);
            }
            self.now = end;
            return self.handle(Input::Tick);
        }
        let id = input.u8();
        let (port, link) = (PortId(id % 9), LinkId(id % LINKS as u8));
        let p = usize::from(port.0);
        let l = usize::from(link.0);
        match op % 16 {
            1 => {
                self.ports[p].up = true;
                self.handle(Input::PortUp { port });
            }
            2 => {
                self.ports[p] = Port::default();
                self.handle(Input::PortDown { port });
            }
            3 if !self.honest || self.ports[p].sending > 0 => {
                self.ports[p].sending = 0;
                self.handle(Input::PortSent { port });
            }
            4 => {
                let state = [BusState::Active, BusState::Warning, BusState::Passive, BusState::BusOff]
                    [usize::from(op >> 6)];
                if state == BusState::BusOff {
                    // What was handed over is lost with it.
                    self.ports[p].sending = 0;
                }
                self.handle(Input::PortBus { port, state });
            }
            5 if !self.honest || self.links[l].opening => {
                self.links[l].opening = false;
                self.links[l].up = true;
                self.handle(Input::LinkUp { link });
            }
            6 if !self.honest || self.links[l].up && !self.links[l].datagram => {
                let left = match pass {
                    0..8 => 0,
                    8 if !self.honest => u32::MAX,
                    _ => self.links[l].unacknowledged / 8 * (pass as u32 - 7),
                };
                self.links[l].unacknowledged = left;
                self.handle(Input::LinkAcked { link, left });
            }
            7 if !self.honest || self.links[l].opening || self.links[l].up => {
                self.links[l] = Link { datagram: self.links[l].datagram, ..Link::default() };
                self.handle(Input::LinkDown { link });
            }
            8 if !self.honest || self.links[l].sending => {
                self.links[l].sending = false;
                self.handle(Input::LinkSent { link });
            }
            9 | 10 => self.field_frame(port, input, op),
            11 => {
                let bytes = input.take(pass as usize + 1).to_vec();
                self.handle(Input::PortBytes { port, bytes: &bytes });
            }
            12 => {
                let bytes = input.take(pass as usize + 1).to_vec();
                self.link_bytes(link, &bytes);
            }
            13 => self.link_bytes(LinkId::STATE, &[[0; 1460].as_slice(), &[0; 8]].concat()),
            14 => {
                let answers: [&[u8]; 7] = [
                    b"run start",
                    b"stop success",
                    b"6:0:5:2\n",
                    b"1f:x\n",
                    b"script finish",
                    b"pause fail",
                    b"poweroff success",
                ];
                let link = if id & 1 == 0 { LinkId::COMMAND } else { LinkId::URGENT };
                self.link_bytes(link, answers[usize::from(op >> 4) % 7]);
            }
            15 if pass < 10 => self.modbus_answer(op),
            15 => {
                // Answers of the newest ids: some fit.
                let (id, function) = (input.u8(), input.one_of(&[1, 3, 5, 6, 15, 16, 0x90]));
                let len = input.u8() % 40;
                let mut answer = vec![0, id, 0, 0, 0, len + 3, 1, function, len];
                answer.resize(9 + usize::from(len), op);
                self.link_bytes(LinkId::MODBUS, &answer);
            }
            _ => self.handle(Input::Tick),
        }
    }

    fn link_bytes(&mut self, link: LinkId, bytes: &[u8]) {
        if !self.honest || self.links[usize::from(link.0)].up {
            self.handle(Input::LinkBytes { link, bytes });
        }
    }

    /// The right answer to the newest Modbus request.
    fn modbus_answer(&mut self, op: u8) {
        let mut answer = self.asked.clone();
        let Some(&function) = answer.get(7) else { return };
        let count = usize::from(answer[10]) * 256 + usize::from(answer[11]);
        answer.truncate(12);
        if function < 5 {
            let len = if function == 1 { count.div_ceil(8) } else { 2 * count };
            answer.truncate(8);
            answer.push(len as u8);
            answer.resize(9 + len, op);
        }
        answer[5] = (answer.len() - 6) as u8;
        self.link_bytes(LinkId::MODBUS, &answer);
    }

    /// A frame of the port's recipe, its values from the input.
    fn field_frame(&mut self, port: PortId, input: &mut Source<'_>, op: u8) {
        let Some(of) = self.config.ports.get(usize::from(port.0)) else { return };
        let size = |span: proto_core::config::Span| -> usize {
            let specs = span.of(&self.config.fields);
            specs
                .iter()
                .map(|spec| match spec {
                    FieldSpec::System(var) => var.size(),
                    FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => ty.size(),
                    // This configuration has none.
                    _ => 0,
                })
                .sum()
        };
        match &self.config.recipes[usize::from(of.recipe)].parts {
            Parts::Stream { input: Some(part), .. } => {
                let mut payload = input.take(1 + usize::from(op >> 4)).to_vec();
                payload.resize(size(part.fields), 0);
                let frame = [&part.head[..], &payload, &part.tail].concat();
                if of.bus.is_field() {
                    self.handle(Input::PortBytes { port, bytes: &frame });
                } else {
                    self.link_bytes(LinkId::of_port(port), &frame);
                }
            }
            Parts::Can { input: part, .. } if !part.is_empty() => {
                let frame = part[input.below(part.len())];
                let mut data = input.take(usize::from(op >> 4)).to_vec();
                data.resize(size(frame.fields).min(8), 0);
                if let Some(frame) = CanFrame::new(frame.id, &data) {
                    self.handle(Input::PortCan { port, frame });
                }
            }
            _ => {}
        }
    }

    fn handle(&mut self, input: Input<'_>) {
        self.engine.handle(self.now, input);
        self.drain();
        // Only a tick lets deadlines pass: before it, they may lie in the past.
        let ticked = matches!(input, Input::Tick);
        assert!(!ticked || self.wake > self.now, "asked to be called at once again");
    }

    fn drain(&mut self) {
        let mut out = [0xA5; OUTPUT_BUFFER];
        for _ in 0..=MOST_OUTPUTS {
            match self.engine.poll_output(self.now, &mut out) {
                Output::Sleep { until } => {
                    assert!(
                        until <= self.now + HEARTBEAT || self.is_idle(),
                        "would not notice that it slept"
                    );
                    // What is due already waits for the tick that is late.
                    let needed = self.engine.deadline().max(self.now);
                    assert!(until <= needed, "would sleep through a deadline");
                    self.wake = until;
                    return;
                }
                Output::PortSend { port, bytes } => {
                    let bytes = bytes.to_vec();
                    self.sent(port, &bytes);
                }
                Output::PortSendCan { port, frame } => self.can_sent(port, &frame),
                Output::LinkOpen { link, .. } => {
                    let link = &mut self.links[usize::from(link.0)];
                    assert!(!self.honest || !link.opening && !link.up, "opened twice");
                    link.opening = true;
                }
                Output::LinkClose { link } => {
                    let link = &mut self.links[usize::from(link.0)];
                    *link = Link { datagram: link.datagram, ..Link::default() };
                }
                Output::LinkSend { link, bytes } => {
                    assert!(!bytes.is_empty());
                    if link == LinkId::MODBUS {
                        self.asked = bytes.to_vec();
                    }
                    let link = &mut self.links[usize::from(link.0)];
                    assert!(
                        !self.honest || link.up && !link.sending,
                        "nothing goes to a link that has not sent yet"
                    );
                    link.sending = true;
                    link.unacknowledged = link.unacknowledged.wrapping_add(bytes.len() as u32);
                }
                other => panic!("{other:?}"),
            }
        }
        panic!("no end of outputs");
    }

    /// Without a field port there is nothing that could be late.
    fn is_idle(&self) -> bool {
        self.engine.field_ports().next().is_none()
    }

    fn sent(&mut self, port: PortId, bytes: &[u8]) {
        let nth = usize::from(port.0);
        let Parts::Stream { output: Some(part), .. } =
            &self.config.recipes[usize::from(self.config.ports[nth].recipe)].parts
        else {
            panic!("port {nth} has no output part");
        };
        assert!(bytes.starts_with(&part.head) && bytes.ends_with(&part.tail));
        assert!(
            !self.honest || self.ports[nth].up && self.ports[nth].sending == 0,
            "handed over before the last left"
        );
        self.ports[nth].sending = 1;
    }

    fn can_sent(&mut self, port: PortId, frame: &CanFrame) {
        let nth = usize::from(port.0);
        let Parts::Can { output, .. } =
            &self.config.recipes[usize::from(self.config.ports[nth].recipe)].parts
        else {
            panic!("port {nth} is no CAN port");
        };
        assert!(output.iter().any(|part| part.id == frame.id()) && !frame.is_remote());
        let port = &mut self.ports[nth];
        port.sending += 1;
        assert!(
            !self.honest || port.up && port.sending <= output.len(),
            "more than a cycle's frames at once"
        );
    }
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    // Every kind of recipe by itself, then all of them, each with a life of its ports and links.
    let life = |ports: u8| {
        let mut life = vec![0];
        for port in 0..ports {
            life.extend([1, port, 0x99, port, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]);
        }
        for link in 0..LINKS as u8 {
            life.extend([5, link]);
        }
        life.extend([0x0D, 2, 0x90]);
        for port in 0..ports {
            life.extend([
                0x49, port, 3, 0, 0, 0, 0, 3, port, 0x99, port, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0x50, 3, port,
            ]);
        }
        life.extend([
            0x0F, 0, 0x10, 0x1F, 0, 0x49, 0, 1, 8, 2, 0x1F, 0, 8, 2, 0xFF, 0, 1, 4, 0, 8, 2, 8, 0, 0x0E, 0,
            7, 2, 0xF0, 2, 1, 0xF0,
        ]);
        life
    };
    let kinds: [&[u8]; 6] = [
        // Realtime stream with both parts; output only; CAN.
        &[4 | 8, 3, 0, 0, 0, 0, 0x60, 0, 2, 1, 0x20, 0, 3, 2, 0, 0, 1, 8, 0, 0, 2, 3],
        &[8, 1, 0xE0, 0, 1, 7, 0, 0, 3, 3],
        &[2, 2, 0, 0, 0, 0, 1, 0, 0, 0, 1, 4, 1, 0, 0, 1, 8, 0],
        // User stream with commands, request and response; on a rising bit; user CAN.
        &[1 | 4 | 8 | 0x80, 2, 0x08, 0, 0x11, 0, 2, 4, 1, 0x00, 0, 0x08, 0],
        &[1 | 8 | 0xC0, 1, 0x18, 1, 1, 7, 0x10, 0, 0, 0, 3],
        &[3, 1, 0, 0x08, 0, 1, 0, 0x02, 0],
    ];
    let mut seeds = Vec::new();
    for (nth, kind) in kinds.iter().enumerate() {
        for (link, bus) in [(0, 0), (0, 4), (1, 6), (1, 7)] {
            let setup = [link, bus | (nth as u8) << 3 | 0x80, 0, 1, 2];
            seeds.push([&[0][..], kind, &setup, &life(2)].concat());
        }
    }
    // A stop beside a command that is not answered, before and after the gateway slept.
    let mut stops = vec![0];
    stops.extend(kinds[3]);
    stops.extend([0, 0, 0]);
    stops.extend(life(1));
    stops.extend([
        9, 0, 1, 9, 0, 0, 0x0E, 1, 6, 0, 6, 12, 0xB0, 9, 0, 4, 0x10, 0xD0, 9, 0, 0, 0x10, 0xF0, 9, 0, 4,
    ]);
    seeds.push(stops);
    // Two commands, a reply that overtakes the transport's report, the report.
    let two_commands =
        [0, 5, 0, 0x28, 0, 0, 0, 0, 0, 1, 0, 5, 0, 9, 0, 1, 9, 0, 0, 14, 0, 8, 0, 0x1E, 0, 8, 0];
    seeds.push(two_commands.to_vec());
    let mut all = vec![4];
    kinds[..5].iter().for_each(|kind| all.extend(*kind));
    all.extend([0x80, 0, 0, 0, 1, 4, 2, 0, 3, 0, 4]);
    all.extend(life(5));
    seeds.push(all);
    seeds
}
