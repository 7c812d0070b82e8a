//! Late is judged by arrival: what waited while the driver was busy counts before deadlines pass, what
//! waited while the gateway itself slept counts for nothing, and old values of our own ports are old
//! (docs/architecture.md sections 3 and 8).

mod rig;

use std::collections::VecDeque;

use proto_core::config::*;
use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId, PortState, ReplyCode};
use proto_core::recipe::CanFrame;
use proto_core::recipe::model::{CanId, Mode};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;
use rig::*;

const ON: &[u8] = &[255, 255, 1, 238, 238];
const OFF: &[u8] = &[255, 255, 0, 238, 238];
const MODBUS: LinkId = LinkId::MODBUS;
const COMMAND: LinkId = LinkId::COMMAND;
const STATE: LinkId = LinkId::STATE;
const UDP: LinkId = LinkId::RECIPE_UDP;

fn coils(address: u16, byte: u8) -> Written {
    Written::Coils(address, (0..8).map(|bit| byte >> bit & 1 == 1).collect())
}

/// Nobody calls the engine; what is told next is told before the tick that is due.
fn stall(rig: &mut Rig, millis: u64) {
    tick(rig);
    rig.now += MS(millis);
}

fn tick(rig: &mut Rig) {
    rig.input(Input::Tick);
}

// The driver was busy.

/// DigitalOutputCommand[1] with a safe value; its owner may be silent for 100 ms.
fn guarded() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

#[test]
fn a_frame_that_waited_while_the_driver_was_busy_was_not_late() {
    for busy in [60, 100, 101, 200, 450, 499] {
        let (mut rig, port) = guarded();
        for nth in 0..20 {
            rig.bytes(port, if nth % 2 == 0 { ON } else { OFF });
            stall(&mut rig, busy);
            rig.bytes(port, if nth % 2 == 0 { ON } else { OFF });
            tick(&mut rig);
        }
        assert_eq!(rig.counters(port).timeouts, 0, "{busy} ms");
        assert_eq!(rig.engine.sleeps(), 0);
        assert!(!rig.take_written().contains(&coils(192, 4)), "{busy} ms: its owner was there");
        assert_eq!(rig.engine.port_state(port), Some(PortState::Working));
    }
}

#[test]
fn a_tick_that_comes_first_lets_the_deadline_pass() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.take_written();
    stall(&mut rig, 100);
    tick(&mut rig);
    assert_eq!(rig.counters(port).timeouts, 1);
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}

#[test]
fn without_a_tick_nothing_passes_whatever_else_is_told_or_asked() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.take_written();
    for _ in 0..20 {
        rig.now += MS(100);
        let links: Vec<LinkId> = rig.engine.links().map(|link| link.id).collect();
        for link in links {
            rig.input(Input::LinkSent { link });
            rig.input(Input::LinkAcked { link, left: 0 });
        }
        rig.input(Input::PortSent { port });
        assert_eq!(rig.counters(port).timeouts, 0);
        assert!(rig.wake <= rig.now, "asks for a tick");
        let mut buf = [0; OUTPUT_BUFFER];
        let early = Output::Sleep { until: rig.wake };
        assert_eq!(rig.engine.poll_output(rig.now + MS(400), &mut buf), early, "asking lets nothing pass");
    }
    assert_eq!(rig.take_written(), []);
    tick(&mut rig);
    assert_eq!(rig.counters(port).timeouts, 1);
}

#[test]
fn a_frame_in_two_parts_is_whole_however_late_the_second_is_told() {
    for busy in [49, 50, 60, 450] {
        for cut in 1..ON.len() {
            let (mut rig, port) = guarded();
            rig.bytes(port, &ON[..cut]);
            stall(&mut rig, busy);
            rig.bytes(port, &ON[cut..]);
            assert_eq!(rig.take_written(), [coils(192, 1)], "cut at {cut}, {busy} ms");
            tick(&mut rig);
            assert_eq!(rig.counters(port).discarded_bytes, 0);
        }
    }
    let (mut rig, port) = guarded();
    rig.bytes(port, &ON[..3]);
    stall(&mut rig, 50);
    tick(&mut rig);
    rig.bytes(port, &ON[3..]);
    assert_eq!((rig.take_written(), rig.counters(port).discarded_bytes), (vec![], 3), "that was silence");
}

#[test]
fn an_answer_that_waited_is_in_time() {
    let (mut rig, port) = guarded();
    rig.modbus_answers = false;
    rig.bytes(port, ON);
    let request = rig.sent_on(MODBUS).remove(0);
    rig.run(MS(90));
    rig.bytes(port, ON);
    stall(&mut rig, 450);
    let answer = rig.answer(&request);
    rig.bytes(port, ON);
    rig.link_bytes(MODBUS, &answer);
    tick(&mut rig);
    let link = rig.link(MODBUS);
    assert_eq!((link.counters.timeouts, link.counters.received), (0, 1));
    assert_eq!((link.counters.unacknowledged, link.history.losses), (0, 0));
}

#[test]
fn an_acknowledgement_that_waited_is_in_time() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1]"], &[]);
    let listen = heapless::String::try_from("0.0.0.0:50000").unwrap();
    let link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let port = cell.rs485(recipe);
    for (left, closings) in [(0, 0), (1, 1)] {
        let mut rig = cell.rig();
        rig.run(MS(10));
        rig.acknowledges = false;
        rig.bytes(port, &[255, 255, 0, 0, 0, 0, 238, 238]);
        stall(&mut rig, 400);
        rig.input(Input::LinkAcked { link, left });
        assert_eq!(rig.closed().len(), 0, "nothing passes yet");
        tick(&mut rig);
        assert_eq!(rig.closed().len(), closings);
    }
}

#[test]
fn a_connection_that_came_up_while_the_driver_was_busy_is_up() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.unanswered.insert(MODBUS.0);
    rig.run(MS(1_900));
    stall(&mut rig, 400);
    rig.input(Input::LinkUp { link: MODBUS });
    tick(&mut rig);
    assert_eq!(rig.link(MODBUS).state.name(), "up");
    assert_eq!(rig.link(MODBUS).history.failed_opens, 0);
}

#[test]
fn a_stream_that_waited_was_not_silent() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&[], &["RobotState[8]"]);
    cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(1_800));
    stall(&mut rig, 400);
    rig.link_bytes(STATE, &[0; 1468]);
    tick(&mut rig);
    assert_eq!((rig.link(STATE).history.silences, rig.link(STATE).history.losses), (0, 0));
}

/// A button box with the codes of the source: 1 runs, 2 resumes, 3 stops, 7 asks for the state.
fn panel() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume"), (3, "stop"), (7, "state")]);
    let to = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = cell.fields([user_in(ScalarType::Byte, to)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(20_000);
    let mut rig = cell.rig();
    rig.run(MS(10));
    press(&mut rig, port, 0);
    (rig, port)
}

fn press(rig: &mut Rig, port: PortId, value: u8) {
    rig.bytes(port, &[255, 255, value, 238, 238]);
}

#[track_caller]
fn reply(rig: &Rig, port: PortId) -> ReplyCode {
    rig.engine.reply_code(port).unwrap()
}

#[test]
fn a_reply_that_waited_is_in_time_and_the_rest_of_one_belongs_to_it() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 1);
    rig.run(MS(9_900));
    stall(&mut rig, 300);
    rig.link_bytes(COMMAND, b"run start");
    tick(&mut rig);
    assert_eq!((reply(&rig, port), rig.closed()), (ReplyCode::Success, vec![]));
    // Silence would complete the number; what waited goes on with it.
    press(&mut rig, port, 7);
    rig.link_bytes(COMMAND, b"6:0:5:2");
    stall(&mut rig, 100);
    rig.link_bytes(COMMAND, b"55\n");
    tick(&mut rig);
    assert_eq!(reply(&rig, port), ReplyCode::Success);
    assert_eq!(rig.link(COMMAND).counters.malformed, 0);
}

#[test]
fn a_command_that_is_too_old_by_then_is_not_sent() {
    let (mut rig, port) = panel();
    press(&mut rig, port, 1);
    rig.log.clear();
    press(&mut rig, port, 2);
    rig.run(MS(700));
    stall(&mut rig, 301);
    // The reply waited: it is in time. The command behind it was picked more than a second ago.
    rig.link_bytes(COMMAND, b"run start");
    assert!(rig.sent_on(COMMAND).is_empty(), "a robot must not start later");
    tick(&mut rig);
    assert!(rig.sent_on(COMMAND).is_empty() && rig.engine.sleeps() == 0);
    assert_eq!((reply(&rig, port), rig.counters(port).commands_dropped), (ReplyCode::NotSent, 1));
}

#[test]
fn a_value_that_is_too_old_by_then_is_not_written() {
    let (mut rig, port) = guarded();
    rig.modbus_answers = false;
    rig.bytes(port, ON);
    let request = rig.sent_on(MODBUS).remove(0);
    rig.bytes(port, OFF);
    stall(&mut rig, 400);
    rig.modbus_answers = true;
    rig.take_written();
    // The answer waited. The edge behind it is older than its port's timeout, and its owner silent.
    let answer = rig.answer(&request);
    rig.take_written();
    rig.link_bytes(MODBUS, &answer);
    assert_eq!(rig.take_written(), [], "whether it may still go is for the tick to say");
    tick(&mut rig);
    assert_eq!(rig.take_written(), [coils(192, 4)]);
    rig.run(MS(1_000));
    assert_eq!(rig.take_written(), []);
    // Where its owner has spoken since, the newest value goes, and none that is too old.
    rig.modbus_answers = false;
    rig.bytes(port, OFF);
    let request = rig.sent_on(MODBUS).pop().unwrap();
    rig.bytes(port, ON);
    stall(&mut rig, 300);
    rig.modbus_answers = true;
    let answer = rig.answer(&request);
    rig.take_written();
    rig.link_bytes(MODBUS, &answer);
    rig.bytes(port, OFF);
    tick(&mut rig);
    assert_eq!(rig.take_written(), [coils(192, 0)]);
    assert_eq!(rig.counters(port).values_expired, 1);
}

/// The order of the crate page's run loop: one event of each source that waits, then the tick if it is
/// due, and everything handed over in between.
struct Loop {
    engine: Box<Engine>,
    now: Instant,
    ports: [VecDeque<(Instant, Vec<u8>)>; 2],
    frames_out: u32,
}

impl Loop {
    fn drain(&mut self) -> Instant {
        let mut buf = [0; OUTPUT_BUFFER];
        loop {
            let (port, link) = match self.engine.poll_output(self.now, &mut buf) {
                Output::Sleep { until } => return until,
                Output::LinkOpen { link } => {
                    self.engine.handle(self.now, Input::LinkUp { link });
                    continue;
                }
                Output::PortSend { port, .. } => (Some(port), None),
                Output::LinkSend { link, .. } => (None, Some(link)),
                other => panic!("{other:?}"),
            };
            if let Some(port) = port {
                self.frames_out += 1;
                self.engine.handle(self.now, Input::PortSent { port });
            }
            if let Some(link) = link {
                self.engine.handle(self.now, Input::LinkSent { link });
            }
        }
    }

    /// One turn: what waits, then the tick, then asleep until something is due, and `busy` longer.
    fn turn(&mut self, busy: Duration) {
        let mut until = self.drain();
        for nth in 0..2 {
            if self.ports[nth].front().is_some_and(|(at, _)| *at <= self.now) {
                let (_, bytes) = self.ports[nth].pop_front().unwrap();
                self.engine.handle(self.now, Input::PortBytes { port: PortId(nth as u8), bytes: &bytes });
                until = self.drain();
            }
        }
        if self.ports.iter().flatten().any(|(at, _)| *at <= self.now) {
            // Something still waits: it is told before deadlines pass.
            return;
        }
        if until <= self.now {
            self.engine.handle(self.now, Input::Tick);
            until = self.drain();
        }
        let next = self.ports.iter().flatten().map(|(at, _)| *at).min().unwrap_or(Instant::NEVER);
        self.now = until.min(next).max(self.now) + busy;
    }
}

#[test]
fn a_driver_with_the_run_loop_of_the_crate_page_may_be_busy_for_450_ms() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..2]"], &[]);
    cell.recipe_link(up);
    for name in ["ForceEnd[1]", "ForceEnd[2]"] {
        let recipe = cell.stream(&[name], &[]);
        cell.rs485(recipe);
        cell.safe(name, 0.0);
    }
    let engine = Box::new(Engine::new(&cell.0).unwrap());
    let start = Instant::from_millis(5_000);
    let mut run = Loop { engine, now: start, ports: [VecDeque::new(), VecDeque::new()], frames_out: 0 };
    for port in [PortId(0), PortId(1)] {
        run.engine.handle(run.now, Input::PortUp { port });
    }
    // A frame every 20 and 30 ms for a minute, cut in two.
    for (nth, every) in [20, 30].into_iter().enumerate() {
        for at in 1..60_000 / every {
            let at = start + MS(at * every);
            let frame = [255, 255, 0, 0, 0, nth as u8, 238, 238];
            run.ports[nth].extend([(at, frame[..3].to_vec()), (at + MS(1), frame[3..].to_vec())]);
        }
    }
    let (mut seed, mut stalls) = (1_u64, 0);
    while run.ports.iter().any(|port| !port.is_empty()) {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        let busy = match seed >> 60 {
            0 => 60 + (seed >> 32) % 390,
            _ => 0,
        };
        stalls += u32::from(busy > 0);
        run.turn(MS(busy));
    }
    assert!(stalls > 100, "{stalls}");
    assert_eq!(run.engine.sleeps(), 0);
    for (port, frames) in [(PortId(0), 60_000 / 20 - 1), (PortId(1), 60_000 / 30 - 1)] {
        let counters = run.engine.port_counters(port).unwrap();
        assert_eq!((counters.frames_in, counters.timeouts, counters.discarded_bytes), (frames, 0, 0));
    }
}

// The gateway itself slept.

/// Everything at once: a PLC by Modbus both ways, a sensor by UDP, a panel, a CAN bus.
struct Full {
    rig: Rig,
    plc: PortId,
    sensor: PortId,
    panel: PortId,
    bus: PortId,
}

const FRAME: &[u8] = &[255, 255, 1, 7, 0, 238, 238];

impl Full {
    fn new() -> Self {
        let mut cell = Cell::new();
        let up = cell.stream(&["ForceEnd[1]", "FloatInputReg[1]"], &["RobotState[26]"]);
        cell.recipe_link(up);
        let recipe =
            cell.stream(&["DigitalOutputCommand[1]", "WordInputReg[1]"], &["DigitalSignalStatus[1]"]);
        let plc = cell.rs485(recipe);
        cell.safe("DigitalOutputCommand[1]", 4.0);
        let recipe = cell.stream(&["ForceEnd[1]"], &[]);
        let sensor = cell.rs485(recipe);
        cell.safe("ForceEnd[1]", 0.0);
        let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume"), (3, "stop")]);
        let to = InputBinding::Commands { table, when: CommandWhen::Change };
        let fields = cell.fields([user_in(ScalarType::Byte, to)]);
        let input = cell.part(&[255, 255], &[238, 238], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
        let panel = cell.rs485(recipe);
        cell.last_port().timeout = MS(20_000);
        let recipe = cell.can(&[(1, &["BitInputReg[1]"])], &[(2, &["RobotState[8]"])]);
        let bus = cell.can_port(recipe);
        let mut full = Self { rig: cell.rig(), plc, sensor, panel, bus };
        full.rig.run(MS(10));
        full.live(6_000);
        full
    }

    /// The controller and all devices talk.
    fn live(&mut self, millis: u64) {
        for _ in 0..millis / 50 {
            self.rig.link_bytes(STATE, &[0; 1468]);
            self.rig.link_bytes(UDP, &[255, 255, 0, 0, 0, 0, 254, 254]);
            self.rig.bytes(self.plc, FRAME);
            self.rig.bytes(self.sensor, &[255, 255, 0, 0, 128, 63, 238, 238]);
            self.rig.can(self.bus, 1, &[1]);
            self.press(0);
            self.rig.run(MS(50));
        }
    }

    fn press(&mut self, value: u8) {
        self.rig.bytes(self.panel, &[255, 255, value, 238, 238]);
    }

    fn sleep(&mut self, millis: u64) {
        self.rig.log.clear();
        self.rig.take_written();
        self.rig.now += MS(millis);
    }

    fn all_links(&self) -> Vec<LinkId> {
        self.rig.engine.links().map(|link| link.id).collect()
    }
}

#[test]
fn half_a_second_is_the_bound() {
    for (gap, sleeps) in [(500_000, 0), (500_001, 1), (60_000_000, 1)] {
        let (mut rig, _) = guarded();
        rig.now = rig.called + Duration::from_micros(gap);
        tick(&mut rig);
        assert_eq!(rig.engine.sleeps(), sleeps, "{gap} us");
    }
}

#[test]
fn the_first_call_is_never_late() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut engine: Box<Engine> = Box::new(Engine::new(&cell.0).unwrap());
    let now = Instant::from_millis(1_000_000);
    engine.handle(now, Input::PortUp { port });
    engine.handle(now, Input::PortBytes { port, bytes: ON });
    assert_eq!((engine.sleeps(), engine.port_counters(port).unwrap().frames_in), (0, 1));
    // Nor does a clock that goes back make it so.
    engine.handle(Instant::from_millis(1), Input::Tick);
    engine.handle(now + MS(400), Input::Tick);
    assert_eq!(engine.sleeps(), 0);
}

#[test]
fn a_configured_engine_asks_to_be_called_every_250_ms() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let listen = heapless::String::try_from("0.0.0.0:50000").unwrap();
    cell.port(Bus::UdpListen { listen }, recipe);
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    for step in [1, 20, 250, 133] {
        for _ in 0..20 {
            rig.now += MS(step);
            rig.input(Input::PortSent { port });
            assert!(rig.wake <= rig.now + MS(250), "{:?} at {:?}", rig.wake, rig.now);
            if rig.wake <= rig.now {
                tick(&mut rig);
            }
        }
    }
    rig.run(MS(60_000));
    assert_eq!(rig.engine.sleeps(), 0);
    let mut idle: Box<Engine> = Box::new(Engine::idle());
    idle.handle(Instant::from_millis(1), Input::Tick);
    let asleep = Output::Sleep { until: Instant::NEVER };
    assert_eq!(idle.poll_output(Instant::from_millis(1), &mut [0; OUTPUT_BUFFER]), asleep);
}

#[test]
fn what_waited_is_discarded_and_counted() {
    let mut full = Full::new();
    let (plc, bus) = (full.plc, full.bus);
    let before = (full.rig.counters(plc), full.rig.counters(bus));
    full.rig.bytes(plc, &FRAME[..3]);
    full.sleep(2_000);
    // No tick comes first: the driver reads what waits.
    full.rig.bytes(plc, &FRAME[3..]);
    full.rig.bytes(plc, FRAME);
    full.rig.can(bus, 1, &[9]);
    full.rig.can(bus, 7, &[9, 9]);
    let frame = CanFrame::remote(CanId::Standard(1), 1).unwrap();
    full.rig.input(Input::PortCan { port: bus, frame });
    full.rig.run(MS(49));
    full.rig.bytes(plc, FRAME);
    let (line, can) = (full.rig.counters(plc), full.rig.counters(bus));
    assert_eq!(full.rig.engine.sleeps(), 1);
    assert_eq!((line.asleep, can.asleep), (3, 3));
    assert_eq!(line.bytes_in - before.0.bytes_in, 7 + 7 + 7);
    assert_eq!(line.discarded_bytes - before.0.discarded_bytes, 7 + 7 + 7, "the beginning of a frame too");
    assert_eq!(can.bytes_in - before.1.bytes_in, 1 + 2);
    assert_eq!((line.frames_in, can.frames_in), (before.0.frames_in, before.1.frames_in));
    assert_eq!((can.rejected_id, can.rejected_remote), (0, 0), "they were not looked at");
    full.rig.run(MS(1));
    full.rig.bytes(plc, FRAME);
    full.rig.can(bus, 1, &[9]);
    let (line, can) = (full.rig.counters(plc), full.rig.counters(bus));
    assert_eq!((line.asleep, can.asleep), (3, 3));
    assert_eq!((line.frames_in, can.frames_in), (before.0.frames_in + 1, before.1.frames_in + 1));
}

#[test]
fn it_listens_again_with_a_tick_and_not_before() {
    let (mut rig, port) = guarded();
    rig.now += MS(1_000);
    tick(&mut rig);
    for _ in 0..10 {
        rig.now += MS(40);
        rig.bytes(port, ON);
    }
    assert_eq!((rig.counters(port).asleep, rig.counters(port).frames_in), (10, 0), "still no tick");
    tick(&mut rig);
    rig.bytes(port, ON);
    assert_eq!((rig.counters(port).asleep, rig.counters(port).frames_in), (10, 1));
}

#[test]
fn all_connections_begin_anew() {
    let mut full = Full::new();
    full.sleep(3_000);
    let woke = full.rig.now;
    full.rig.input(Input::PortSent { port: full.plc });
    let mut closed: Vec<LinkId> = full.rig.closed().into_iter().map(|(_, link)| link).collect();
    closed.sort_unstable();
    let mut links = full.all_links();
    links.sort_unstable();
    assert_eq!((closed, links.len()), (links, 5));
    assert!(full.rig.engine.links().all(|link| link.state.name() == "down"));
    full.rig.log.clear();
    full.rig.run(MS(99));
    assert!(full.rig.log.iter().all(|(_, out)| !matches!(out, Out::Open(_) | Out::Link(..))));
    full.rig.run(MS(1));
    let opened = full.rig.log.iter().filter(|(at, out)| matches!(out, Out::Open(_)) && *at == woke + MS(100));
    assert_eq!(opened.count(), 5, "100 ms later");
    for link in full.rig.engine.links() {
        assert_eq!((link.state.name(), link.history.connects, link.history.losses), ("up", 2, 1));
    }
}

#[test]
fn a_connection_that_was_opening_begins_anew() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.unanswered.insert(MODBUS.0);
    rig.run(MS(500));
    rig.log.clear();
    rig.now += MS(600);
    // It came up meanwhile, but that is as old.
    rig.input(Input::LinkUp { link: MODBUS });
    assert_eq!(rig.closed(), [(rig.now, MODBUS)]);
    assert_eq!(rig.link(MODBUS).state.name(), "down");
}

#[test]
fn overdue_safe_values_go_first() {
    let mut full = Full::new();
    // Something of each waits.
    full.rig.modbus_answers = false;
    full.rig.bytes(full.plc, FRAME);
    full.rig.bytes(full.plc, &[255, 255, 2, 9, 0, 238, 238]);
    full.sleep(5_000);
    tick(&mut full.rig);
    assert_eq!(full.rig.counters(full.plc).timeouts, 1);
    assert_eq!(full.rig.counters(full.sensor).timeouts, 1);
    full.rig.modbus_answers = true;
    full.rig.run(MS(99));
    full.rig.take_written();
    full.rig.log.clear();
    full.rig.run(MS(1));
    full.rig.link_bytes(STATE, &[0; 1468]);
    let first = full.rig.take_written();
    assert_eq!(first[..1], [coils(192, 4)], "before any poll, and nothing of what waited");
    assert_eq!(full.rig.sent_on(UDP).last().unwrap()[..6], [255, 255, 0, 0, 0, 0], "the force too");
    let written = |written: &[Written]| written.iter().all(|write| *write == coils(192, 4));
    full.rig.run(MS(5_000));
    assert!(written(&full.rig.take_written()), "values of before are never written");
}

#[test]
fn who_may_be_silent_for_longer_is_not_overdue() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(3_000);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, ON);
    rig.take_written();
    rig.now += MS(2_000);
    tick(&mut rig);
    rig.run(MS(200));
    assert_eq!((rig.counters(port).timeouts, rig.take_written()), (0, vec![]));
    rig.bytes(port, OFF);
    assert_eq!(rig.take_written(), [coils(192, 0)]);
    rig.run(MS(3_000));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}

#[test]
fn nothing_is_commanded_from_what_was_asked_before() {
    // What waits or is under way at the time: a run, a run and a resume, a stop.
    for (values, expected) in [
        (&[1][..], ReplyCode::NoReply),
        (&[1, 2], ReplyCode::NotSent),
        (&[3], ReplyCode::NoReply),
        (&[1, 3], ReplyCode::NoReply),
    ] {
        let mut full = Full::new();
        for &value in values {
            full.press(value);
        }
        full.sleep(700);
        let held = *values.last().unwrap();
        full.press(held);
        assert_eq!(full.rig.engine.reply_code(full.panel), Some(expected), "{values:?}");
        full.rig.run(MS(60));
        for _ in 0..100 {
            full.press(held);
            full.rig.run(MS(50));
        }
        let commands = [full.rig.sent_on(COMMAND), full.rig.sent_on(LinkId::URGENT)].concat();
        assert!(commands.is_empty(), "{values:?}: {held} is held, and was no order: {commands:?}");
        full.press(0);
        full.press(2);
        assert_eq!(full.rig.sent_on(COMMAND), [b"resume"], "what is asked for now counts");
    }
}

#[test]
fn a_stop_that_waited_without_a_connection_is_dropped_too() {
    let mut full = Full::new();
    full.rig.reachable.clear();
    full.rig.input(Input::LinkDown { link: COMMAND });
    full.rig.input(Input::LinkDown { link: LinkId::URGENT });
    full.press(3);
    full.sleep(700);
    tick(&mut full.rig);
    let dropped = full.rig.counters(full.panel).commands_dropped;
    assert_eq!((full.rig.engine.reply_code(full.panel), dropped), (Some(ReplyCode::NotSent), 1));
    full.rig.reachable = (0..16).collect();
    full.rig.run(MS(10_000));
    assert!(full.rig.sent_on(COMMAND).is_empty() && full.rig.sent_on(LinkId::URGENT).is_empty());
}

#[test]
fn what_was_handed_over_for_sending_is_still_reported() {
    let mut full = Full::new();
    full.rig.log.clear();
    full.rig.reports_sent = false;
    full.rig.run(MS(4));
    assert_eq!((full.rig.sent_to(full.plc).len(), full.rig.can_sent_to(full.bus).len()), (1, 1));
    full.sleep(1_000);
    tick(&mut full.rig);
    full.rig.run(MS(100));
    assert!(full.rig.sent_to(full.plc).is_empty(), "the one before has not left");
    assert!(full.rig.can_sent_to(full.bus).is_empty());
    full.rig.reports_sent = true;
    full.rig.input(Input::PortSent { port: full.plc });
    full.rig.input(Input::PortSent { port: full.bus });
    full.live(100);
    assert!(full.rig.sent_to(full.plc).len() >= 24 && full.rig.can_sent_to(full.bus).len() >= 24);
}

#[test]
fn what_was_due_for_the_field_then_is_not_sent_now() {
    let mut cell = Cell::new();
    let fields = cell.fields([user_out(ScalarType::Byte, OutputBinding::Counter)]);
    let output = cell.part(&[1], &[2], fields);
    let fields = cell.fields([user_in(ScalarType::Byte, InputBinding::Unused)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output });
    cell.last_recipe().send = SendOn::Frame;
    let asks = cell.rs485(recipe);
    if let Bus::Rs485(line) = &mut cell.last_port().bus {
        line.turnaround = MS(100);
    }
    let fields = cell.fields([user_out(ScalarType::Byte, OutputBinding::Counter)]);
    let output = cell.part(&[1], &[2], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    let cycles = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(11));
    rig.bytes(asks, &[255, 255, 9, 238, 238]);
    rig.sent_to(cycles);
    rig.now += Duration::from_micros(700_500);
    tick(&mut rig);
    assert!(rig.sent_to(cycles).is_empty(), "not between two cycles");
    rig.run(MS(4));
    assert_eq!(rig.sent_to(cycles).len(), 1, "the next one on the grid");
    rig.run(MS(1_000));
    assert!(rig.sent_to(asks).is_empty(), "whoever asked then does not wait any more");
    rig.bytes(asks, &[255, 255, 9, 238, 238]);
    rig.run(MS(200));
    assert_eq!(rig.sent_to(asks).len(), 1);
}

#[test]
fn it_may_sleep_again_and_again() {
    let mut full = Full::new();
    for nth in 1..=20 {
        full.sleep(501 + 40 * nth);
        if nth % 3 == 0 {
            full.rig.bytes(full.plc, FRAME);
        } else {
            tick(&mut full.rig);
        }
        full.rig.run(MS(nth * 13));
        assert_eq!(u64::from(full.rig.engine.sleeps()), nth);
    }
    full.live(12_000);
    full.rig.take_written();
    full.rig.bytes(full.plc, FRAME);
    assert!(full.rig.take_written().contains(&coils(192, 1)), "all is well again");
    assert!(full.rig.engine.links().all(|link| link.state.name() == "up"));
}

#[test]
fn a_new_configuration_has_never_slept() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.now += MS(2_000);
    tick(&mut rig);
    assert_eq!(rig.engine.sleeps(), 1);
    rig.engine.configure(&cell.0).unwrap();
    assert_eq!(rig.engine.sleeps(), 0);
    rig.now += MS(2_000);
    rig.input(Input::PortUp { port });
    rig.bytes(port, ON);
    assert_eq!((rig.engine.sleeps(), rig.counters(port).frames_in), (0, 1), "it was not called before");
}

// Values of our own ports.

/// A display of what another port sends, and how often it sent in the last second.
fn own_value(on_stale: OnStale, safe: bool) -> (Rig, PortId, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["WordInputReg[1]"], &[]);
    let owner = cell.rs485(recipe);
    if safe {
        cell.safe("WordInputReg[1]", 5.0);
    }
    let word = OutputBinding::Variable { var: var("WordInputReg[1]"), scale: 1.0, offset: 0.0 };
    let fields = cell.fields([user_out(ScalarType::Byte, word)]);
    let output = cell.part(&[1], &[2], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.last_recipe().on_stale = on_stale;
    let shows = cell.rs485(recipe);
    cell.last_port().stale_after = MS(400);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, owner, shows)
}

#[test]
fn an_old_value_of_our_own_is_old() {
    for safe in [false, true] {
        let (mut rig, owner, shows) = own_value(OnStale::Stop, safe);
        assert!(rig.sent_to(shows).is_empty(), "never sent");
        let before = rig.counters(shows).stale_cycles;
        rig.bytes(owner, &[255, 255, 7, 0, 238, 238]);
        rig.run(MS(1_000));
        let sent = rig.sent_to(shows);
        assert_eq!(sent.len(), 100, "400 ms");
        assert_eq!(sent.last().unwrap()[1], if safe { 5 } else { 7 }, "safe after 100 ms, old after 400");
        assert_eq!(rig.counters(shows).stale_cycles - before, 150);
        rig.bytes(owner, &[255, 255, 8, 0, 238, 238]);
        rig.run(MS(4));
        assert_eq!(rig.sent_to(shows), [[1, 8, 2]], "and it is back");
    }
}

#[test]
fn held_values_of_our_own_are_held() {
    let (mut rig, owner, shows) = own_value(OnStale::Hold, false);
    rig.bytes(owner, &[255, 255, 7, 0, 238, 238]);
    rig.run(MS(5_000));
    assert_eq!(rig.sent_to(shows).len(), 1_250);
}

#[test]
fn each_can_frame_of_our_own_has_its_own_age() {
    let mut cell = Cell::new();
    let recipe = cell.can(&[(1, &["WordInputReg[1]"]), (2, &["WordInputReg[2]"])], &[]);
    let owner = cell.can_port(recipe);
    let mut shows = Vec::new();
    for name in ["WordInputReg[1]", "WordInputReg[2]"] {
        let word = OutputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 };
        let fields = cell.fields([user_out(ScalarType::Byte, word)]);
        let output = cell.part(&[1], &[2], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
        cell.last_recipe().on_stale = OnStale::Stop;
        shows.push(cell.rs485(recipe));
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.can(owner, 1, &[7, 0]);
    for _ in 0..20 {
        rig.can(owner, 2, &[8, 0]);
        rig.run(MS(50));
    }
    let sent: Vec<usize> = shows.iter().map(|&port| rig.sent_to(port).len()).collect();
    assert_eq!(sent, [125, 250], "stale after 500 ms");
}
