//! What waited while the gateway itself slept (stopped, suspended, in a debugger) is discarded
//! (docs/engine.md section 2).

mod rig;

use proto_core::config::*;
use proto_core::device::Boundary;
use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;
use rig::*;

const ON: &[u8] = &[255, 255, 1, 238, 238];
const OFF: &[u8] = &[255, 255, 0, 238, 238];
const MODBUS: LinkId = LinkId::MODBUS;
const COMMAND: LinkId = LinkId::COMMAND;
const STATE: LinkId = LinkId::STATE;
const UDP: LinkId = LinkId::RECIPE_UDP;

fn tick(rig: &mut Rig) {
    rig.input(Input::Tick);
}

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

    /// The controller and all devices send.
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
fn a_frame_that_had_begun_is_not_completed() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(3_000);
    if let Bus::Rs485(line) = &mut cell.last_port().bus {
        line.idle_gap = MS(1_000);
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &ON[..3]);
    rig.now += MS(600);
    tick(&mut rig);
    assert_eq!(rig.counters(port).discarded_bytes, 3, "though its silence may be longer");
    rig.run(MS(60));
    rig.bytes(port, &ON[3..]);
    assert_eq!(rig.counters(port).frames_in, 0);
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
fn a_report_of_before_is_none_of_the_connection_that_is_opened_now() {
    for up in [false, true] {
        let (mut rig, _) = guarded();
        rig.reachable.remove(&MODBUS.0);
        rig.input(Input::LinkDown { link: MODBUS });
        rig.run(MS(1_000));
        assert_eq!(rig.link(MODBUS).state.name(), "down");
        rig.reachable.insert(MODBUS.0);
        rig.log.clear();
        rig.now += MS(4_000);
        rig.input(if up { Input::LinkUp { link: MODBUS } } else { Input::LinkDown { link: MODBUS } });
        tick(&mut rig);
        let opened = rig.take(|out| (*out == Out::Open(MODBUS)).then_some(()));
        assert_eq!((opened.len(), rig.link(MODBUS).state.name()), (1, "up"));
    }
}

#[test]
fn overdue_safe_values_go_first() {
    let mut full = Full::new();
    // Something of each waits.
    full.rig.modbus_answers = false;
    full.rig.bytes(full.plc, FRAME);
    full.rig.bytes(full.plc, &[255, 255, 2, 9, 0, 238, 238]);
    full.sleep(5_000);
    full.rig.bytes(full.plc, FRAME);
    assert_eq!(full.rig.counters(full.plc).timeouts, 1, "with the first call");
    assert_eq!(full.rig.counters(full.sensor).timeouts, 1);
    tick(&mut full.rig);
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
    let (mut cell, port) = Cell::guarded();
    cell.last_port().timeout = MS(3_000);
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
fn a_stop_that_is_asked_for_after_sleep_is_given() {
    // Of the frames that waited, and of those that came until the next tick, nobody knows the age.
    for pressed_before in [false, true] {
        let mut full = Full::new();
        if pressed_before {
            full.press(3);
            full.rig.link_bytes(LinkId::URGENT, b"stop success");
        }
        full.sleep(700);
        full.press(3);
        full.rig.run(MS(300));
        assert!(full.rig.sent_on(LinkId::URGENT).is_empty(), "from what was discarded");
        let based = full.rig.counters(full.panel).commands_based;
        full.press(3);
        full.rig.run(MS(20));
        assert_eq!(full.rig.sent_on(LinkId::URGENT), [b"stop"], "pressed before: {pressed_before}");
        full.rig.link_bytes(LinkId::URGENT, b"stop success");
        full.press(3);
        full.rig.run(MS(300));
        assert_eq!(full.rig.sent_on(LinkId::URGENT).len(), 0, "once");
        assert_eq!(full.rig.counters(full.panel).commands_based, based);
    }
}

#[test]
fn a_stop_after_sleep_is_no_order_of_a_device_that_was_gone_or_never_there() {
    let mut full = Full::new();
    full.sleep(700);
    tick(&mut full.rig);
    full.rig.run(MS(60));
    full.rig.input(Input::PortDown { port: full.panel });
    full.rig.input(Input::PortUp { port: full.panel });
    full.press(3);
    full.rig.run(MS(200));
    assert!(full.rig.sent_on(LinkId::URGENT).is_empty());
    assert_eq!(full.rig.counters(full.panel).commands_based, 1);
}

#[test]
fn nothing_is_commanded_from_what_was_asked_before() {
    // What waits or is under way at the time: a run, a run and a resume.
    for (values, expected) in [(&[1][..], ReplyCode::NoReply), (&[1, 2], ReplyCode::NotSent)] {
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
        assert_eq!(full.rig.sent_on(COMMAND), [b"resume"], "a command that is picked now counts");
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
    assert!(rig.sent_to(asks).is_empty(), "that request is too old to be answered");
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

#[test]
fn a_frame_that_silence_ends_is_cut_by_a_sleep_and_asks_for_no_call_at_once() {
    let mut cell = Cell::new();
    let fields = cell.fields([user_in(
        ScalarType::Byte,
        InputBinding::Variable { var: var("WordInputReg[1]"), scale: 1.0, offset: 0.0 },
    )]);
    let mut part = cell.part(&[], &[], fields).unwrap();
    part.framing = Boundary::Silence;
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: Some(part), output: None });
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[7]);
    rig.now += MS(700);
    // The rig fails when the engine asks to be called at once again.
    rig.input(Input::Tick);
    rig.run(MS(1_000));
    rig.take_written();
    rig.bytes(port, &[8]);
    rig.run(MS(100));
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![8])]);
}
