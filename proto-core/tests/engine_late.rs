//! Late is judged by arrival: what waited while the driver was busy counts before deadlines pass. And
//! values age, those of our own ports too (docs/engine.md sections 2 and 8).

mod rig;

use std::collections::VecDeque;

use proto_core::config::*;
use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId, PortState, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;
use rig::*;

const ON: &[u8] = &[255, 255, 1, 238, 238];
const OFF: &[u8] = &[255, 255, 0, 238, 238];
const MODBUS: LinkId = LinkId::MODBUS;
const COMMAND: LinkId = LinkId::COMMAND;
const STATE: LinkId = LinkId::STATE;

/// The driver does not call the engine for this long; the test's next input comes before the tick that
/// is due.
fn stall(rig: &mut Rig, millis: u64) {
    tick(rig);
    rig.now += MS(millis);
}

fn tick(rig: &mut Rig) {
    rig.input(Input::Tick);
}

// The driver was busy.

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
        assert_eq!(rig.engine.poll_output(rig.now + MS(400), &mut buf), early, "no deadline passes");
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
            tick(&mut rig);
            assert_eq!(rig.take_written(), [coils(192, 1)], "cut at {cut}, {busy} ms");
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
fn an_engine_without_a_field_port_is_called_for_its_links() {
    let mut cell = Cell::new();
    let up = cell.stream(&[], &["RobotState[26]"]);
    cell.recipe_link(up);
    let mut rig = cell.rig();
    rig.reachable.clear();
    rig.input(Input::Tick);
    assert!(rig.wake <= rig.now + MS(100), "{:?}", rig.wake);
    rig.run(MS(1_000));
    assert_eq!(rig.link(LinkId::RECIPE_UDP).history.failed_opens, 4, "at 0, 100, 300 and 700 ms");
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

/// A button box with the codes of the source: 1 runs, 2 resumes, 3 stops, 7 queries the state.
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
    assert_eq!(rig.take_written(), [], "the tick decides whether it may still go");
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
                Output::LinkOpen { link, .. } => {
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
            // Something still waits: it is reported before deadlines pass.
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
