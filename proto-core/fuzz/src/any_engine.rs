//! Any configuration, any inputs of a driver that keeps the contract (docs/driver.md)
//! or does not: the engine keeps its side of it, and does no more for one input than it may.

use proto_core::config::{Bus, FieldSpec, GatewayConfig, Parts, image};
use proto_core::engine::{BusState, Engine, Handled, Input, LinkId, LinkKind, OUTPUT_BUFFER, Output, PortId};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;

use crate::any_config::config;
use crate::any_frames::{self, Said};
use crate::source::{Random, Source, cut};

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
    said: [Said; 9],
    /// When the engine was called last.
    called: Instant,
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
            said: Default::default(),
            called: Instant::ZERO,
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
        match op % 16 {
            1..=4 => self.port_event(port, op),
            5..=8 => self.link_event(link, op),
            9 | 10 => self.field_frame(port, input, op),
            11 => {
                let bytes = input.take(pass as usize + 1).to_vec();
                self.port_bytes(port, &bytes);
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

    /// Something happens to a port.
    fn port_event(&mut self, port: PortId, op: u8) {
        let p = usize::from(port.0);
        match op % 16 {
            1 => {
                self.ports[p].up = true;
                self.said[p].awaits = None;
                self.handle(Input::PortUp { port });
            }
            2 => {
                self.ports[p] = Port::default();
                self.said[p].awaits = None;
                self.handle(Input::PortDown { port });
            }
            3 if !self.honest || self.ports[p].sending > 0 => {
                self.ports[p].sending = 0;
                self.reply_may_come(p);
                self.handle(Input::PortSent { port });
            }
            4 => {
                let state = [BusState::Active, BusState::Warning, BusState::Passive, BusState::BusOff]
                    [usize::from(op >> 6)];
                if state == BusState::BusOff {
                    // What was handed over is lost with it.
                    self.ports[p].sending = 0;
                    self.said[p].awaits = None;
                }
                self.handle(Input::PortBus { port, state });
            }
            _ => self.handle(Input::Tick),
        }
    }

    /// Something happens to a link.
    fn link_event(&mut self, link: LinkId, op: u8) {
        let (l, pass) = (usize::from(link.0), op >> 4);
        match op % 16 {
            5 if !self.honest || self.links[l].opening => {
                self.links[l].opening = false;
                self.links[l].up = true;
                self.handle(Input::LinkUp { link });
            }
            6 if !self.honest || self.links[l].up && !self.links[l].datagram => {
                let left = match pass {
                    0..8 => 0,
                    8 if !self.honest => u32::MAX,
                    _ => self.links[l].unacknowledged / 8 * (u32::from(pass) - 7),
                };
                self.links[l].unacknowledged = left;
                self.handle(Input::LinkAcked { link, left });
            }
            7 if !self.honest || self.links[l].opening || self.links[l].up => {
                self.links[l] = Link { datagram: self.links[l].datagram, ..Link::default() };
                self.closed(link);
                self.handle(Input::LinkDown { link });
            }
            8 if !self.honest || self.links[l].sending => {
                self.links[l].sending = false;
                if let Some(nth) = self.device_behind(link) {
                    self.reply_may_come(nth);
                }
                self.handle(Input::LinkSent { link });
            }
            _ => self.handle(Input::Tick),
        }
    }

    /// The port of Modbus TCP that a link is of.
    fn device_behind(&self, link: LinkId) -> Option<usize> {
        link.port().map(|port| usize::from(port.0)).filter(|port| any_frames::is_tcp(&self.config, *port))
    }

    /// A request has left a port: from now on the reply may come.
    fn reply_may_come(&mut self, port: usize) {
        if self.said[port].awaits.is_some() {
            self.said[port].awaits =
                any_frames::shortest_wait(&self.config, port).map(|wait| self.now + wait);
        }
    }

    /// A link is closed: nothing is answered on it any more.
    fn closed(&mut self, link: LinkId) {
        if let Some(nth) = self.device_behind(link) {
            self.said[nth].awaits = None;
        }
    }

    fn link_bytes(&mut self, link: LinkId, bytes: &[u8]) {
        if !self.honest || self.links[usize::from(link.0)].up {
            // Perhaps they are the reply.
            self.closed(link);
            self.handle(Input::LinkBytes { link, bytes });
        }
    }

    fn port_bytes(&mut self, port: PortId, bytes: &[u8]) {
        // Perhaps they are the reply.
        self.said[usize::from(port.0)].awaits = None;
        self.handle(Input::PortBytes { port, bytes });
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
        let nth = usize::from(port.0);
        let Some(of) = self.config.ports.get(nth) else { return };
        let recipe = &self.config.recipes[usize::from(of.recipe)];
        if self.config.view().is_device(recipe) || recipe.exchanges.len > 0 {
            if matches!(recipe.parts, Parts::Can { .. }) {
                if let Some(frame) = any_frames::can(&self.config, nth, input) {
                    return self.handle(Input::PortCan { port, frame });
                }
            } else if let Some(bytes) = any_frames::bytes(&self.config, nth, &self.said[nth], input) {
                if any_frames::is_tcp(&self.config, nth) {
                    let link = LinkId::of_port(port);
                    for piece in cut(&any_frames::over_tcp(&bytes, &self.said[nth], op), op) {
                        self.link_bytes(link, piece);
                    }
                    return;
                }
                for piece in cut(&bytes, op) {
                    self.port_bytes(port, piece);
                }
                return;
            }
        }
        let size = |span: proto_core::config::Span| -> usize {
            let specs = span.of(&self.config.fields);
            specs
                .iter()
                .map(|spec| match spec {
                    FieldSpec::System(var) => var.size(),
                    FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => ty.size(),
                    // Nor has a frame of others.
                    _ => 0,
                })
                .sum()
        };
        match &recipe.parts {
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
        if self.now.saturating_since(self.called) > HEARTBEAT {
            // It may have slept: what it waited for is forgotten.
            self.said.iter_mut().for_each(|said| said.awaits = None);
        }
        self.called = self.now;
        let (handled, wake) = (self.engine.handle(self.now, input), self.wake);
        let outputs = self.drain();
        if handled == Handled::Asleep {
            assert_eq!((outputs, self.wake), (0, wake), "{input:?} was said to lead to nothing");
        }
        // Only a tick lets deadlines pass: before it, they may lie in the past.
        let ticked = matches!(input, Input::Tick);
        assert!(!ticked || self.wake > self.now, "asked to be called at once again");
    }

    /// Carries out what the engine wants, and returns how much that was.
    fn drain(&mut self) -> usize {
        let mut out = [0xA5; OUTPUT_BUFFER];
        for outputs in 0..=MOST_OUTPUTS {
            match self.engine.poll_output(self.now, &mut out) {
                Output::Sleep { until } => {
                    assert!(
                        until <= self.now + HEARTBEAT || self.is_idle(),
                        "would not notice that it slept"
                    );
                    // What is due already waits for the tick that is late.
                    let needed = self.engine.deadline().max(self.now);
                    assert!(
                        until <= needed,
                        "would sleep until {until:?} at {:?}, through {needed:?}",
                        self.now
                    );
                    self.wake = until;
                    return outputs;
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
                    self.closed(link);
                    let link = &mut self.links[usize::from(link.0)];
                    *link = Link { datagram: link.datagram, ..Link::default() };
                }
                Output::LinkSend { link, bytes } => {
                    assert!(!bytes.is_empty());
                    if link == LinkId::MODBUS {
                        self.asked = bytes.to_vec();
                    }
                    if let Some(nth) = self.device_behind(link) {
                        let request = any_frames::request_over_tcp(bytes);
                        let Some((id, request)) = request else { panic!("no header: {bytes:02X?}") };
                        let before = std::mem::replace(&mut self.said[nth].transaction, id);
                        assert_ne!(id, before, "two requests with one id");
                        self.asks(nth, &request);
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
        assert!(!any_frames::is_tcp(&self.config, nth), "it has no line");
        assert!(
            !self.honest || self.ports[nth].up && self.ports[nth].sending == 0,
            "handed over before the last left"
        );
        self.ports[nth].sending = 1;
        self.asks(nth, bytes);
    }

    /// What is asked of the devices of a port.
    fn asks(&mut self, nth: usize, bytes: &[u8]) {
        assert!(
            any_frames::may_be_sent(&self.config, nth, bytes),
            "port {nth} has no such frame: {bytes:02X?}"
        );
        let said = &mut self.said[nth];
        let waits = any_frames::shortest_wait(&self.config, nth);
        assert!(
            !self.honest || said.awaits.is_none_or(|until| self.now >= until),
            "asked before the last was answered"
        );
        // Nobody answers a broadcast.
        said.awaits = waits.filter(|_| bytes.first() != Some(&0)).map(|_| Instant::NEVER);
        said.sent = bytes.to_vec();
    }

    fn can_sent(&mut self, port: PortId, frame: &CanFrame) {
        let nth = usize::from(port.0);
        assert!(
            any_frames::may_be_sent_can(&self.config, nth, frame),
            "port {nth} has no such frame: {frame:?}"
        );
        let recipe = any_frames::recipe_of(&self.config, nth);
        let Some(Parts::Can { output, .. }) = recipe.map(|recipe| &recipe.parts) else {
            panic!("port {nth} is no CAN port");
        };
        // A cycle's frames, or a request.
        let most = output.len().max(1);
        let port = &mut self.ports[nth];
        port.sending += 1;
        assert!(!self.honest || port.up && port.sending <= most, "more than a cycle's frames at once");
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
    seeds.extend(device_seeds());
    seeds
}

/// Each kind of recipe several times, with exchanges on its port.
fn device_seeds() -> Vec<Vec<u8>> {
    let mut random = Random::new(7);
    let mut seeds = Vec::new();
    // The last is a master over a connection.
    for (which, is_tcp) in (0..8).map(|which| (which, false)).chain([(5, true)]) {
        let mut found = 0;
        for _ in 0..2_000 {
            // One recipe with devices, of this kind.
            let mut input = vec![0x80, 1, which | (random.number() as u8) << 3];
            input.extend((0..120).map(|_| random.number() as u8));
            let mut source = Source::new(&input);
            let Some(config) = config(&mut source) else { continue };
            if config.validate().is_err()
                || config.recipes.iter().all(|recipe| recipe.exchanges.len == 0) && which > 2
            {
                continue;
            }
            if matches!(config.ports[0].bus, Bus::ModbusTcp { .. }) != is_tcp {
                continue;
            }
            let used = input.len() - source.rest().len();
            input.truncate(used);
            // Honest, and the port is there, or its link.
            let link = LinkId::of_port(PortId(0)).0;
            input.extend(if is_tcp { [0, 5, link] } else { [0, 1, 0] });
            let left = if is_tcp { [8, link] } else { [3, 0] };
            for _ in 0..20 {
                let [ask, answer, value] = [(); 3].map(|()| random.number() as u8);
                input.extend(left);
                input.extend([
                    ask & 0xF0 | 9,
                    0,
                    answer,
                    value,
                    [0x10, 0x20, 0x40, 0x60][usize::from(ask & 3)],
                ]);
            }
            seeds.push(input);
            found += 1;
            if found == 6 {
                break;
            }
        }
        assert!(found > 0, "no right recipe of kind {which}, over TCP: {is_tcp}");
    }
    seeds
}
