//! Faults of the controller's side: each is counted, nothing is written that nobody sent, and the
//! next good frame gets through (docs/engine.md sections 5, 9).

mod rig;

use std::collections::BTreeSet;

use proto_core::config::*;
use proto_core::engine::{Input, LinkId, PortId, ReplyCode};
use proto_core::modbus::Exception;
use proto_core::recipe::model::Mode;
use proto_core::time::Duration;
use proto_core::wire::scalar::{Scalar, ScalarType};
use rig::*;

/// A cell that uses every kind of link.
struct Full {
    rig: Rig,
    /// DigitalOutputCommand[1] and WordInputReg[1] up by Modbus; DI1..8 and RobotState[8] down.
    plc: PortId,
    /// ForceEnd[1..2] up by UDP 2011, in one frame with WordInputReg[32], which nobody sends.
    sensor: PortId,
    /// Picks commands.
    panel: PortId,
    /// FloatInputReg[1] up by the controller's TCP client.
    hand: PortId,
    tcp: LinkId,
    /// What devices sent in frames that were right.
    bits: BTreeSet<u8>,
    words: BTreeSet<u16>,
    forces: BTreeSet<u32>,
    nth: u16,
}

const UDP: LinkId = LinkId::RECIPE_UDP;

impl Full {
    fn new() -> Self {
        let mut cell = Cell::new();
        let up = cell.stream(&["ForceEnd[1..2]", "WordInputReg[32]"], &[]);
        cell.recipe_link(up);
        let recipe = cell.stream(
            &["DigitalOutputCommand[1]", "WordInputReg[1]"],
            &["DigitalSignalStatus[1]", "RobotState[8]"],
        );
        let plc = cell.rs485(recipe);
        let recipe = cell.stream(&["ForceEnd[1..2]"], &[]);
        let sensor = cell.rs485(recipe);
        let table = cell.commands(&[(1, "run(pick.jspf,50)"), (2, "resume")]);
        let to = InputBinding::Commands { table, when: CommandWhen::Frame };
        let fields = cell.fields([user_in(ScalarType::Byte, to)]);
        let input = cell.part(&[255, 255], &[238, 238], fields);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
        let panel = cell.rs485(recipe);
        let recipe = cell.stream(&["FloatInputReg[1]"], &["RobotState[26]"]);
        let listen = heapless::String::try_from("127.0.0.1:50000").unwrap();
        let tcp = LinkId::of_port(cell.port(Bus::TcpListen { listen }, recipe));
        let recipe = cell.stream(&["FloatInputReg[1]"], &["RobotState[26]"]);
        let hand = cell.rs485(recipe);
        let mut full = Self {
            rig: cell.rig(),
            plc,
            sensor,
            panel,
            hand,
            tcp,
            bits: BTreeSet::new(),
            words: BTreeSet::new(),
            forces: BTreeSet::new(),
            nth: 0,
        };
        full.rig.run(MS(10));
        full.state();
        full
    }

    /// A state packet: the pose, and WordInputReg[32] as the controller has it.
    fn state(&mut self) {
        let mut packet = vec![0; 1468];
        packet[368..372].copy_from_slice(&0.5_f32.to_le_bytes());
        packet[1310..1312].copy_from_slice(&0x3232_u16.to_le_bytes());
        self.rig.link_bytes(LinkId::STATE, &packet);
    }

    /// What the controller sends by itself, for a while.
    fn live(&mut self, millis: u64) {
        for _ in 0..millis.div_ceil(50) {
            self.rig.run(MS(50));
            self.state();
            self.rig.link_bytes(self.tcp, &[&[255, 255][..], &9.0_f32.to_le_bytes(), &[254, 254]].concat());
        }
    }

    /// The next frame of the PLC, with values of its own.
    fn plc(&mut self) -> (u8, u16) {
        self.nth += 1;
        let (bits, word) = (self.nth as u8 | 0x80, self.nth | 0x4000);
        self.bits.insert(bits);
        self.words.insert(word);
        let [low, high] = word.to_le_bytes();
        self.rig.bytes(self.plc, &[255, 255, bits, low, high, 238, 238]);
        (bits, word)
    }

    /// The next frame of the sensor, as it has to arrive over UDP.
    fn sensor(&mut self) -> Vec<u8> {
        self.nth += 1;
        let force = f32::from(self.nth) + 0.5;
        self.forces.insert(force.to_bits());
        let values = [force.to_le_bytes(), force.to_le_bytes()].concat();
        self.rig.bytes(self.sensor, &[&[255, 255][..], &values, &[238, 238]].concat());
        [&[255, 255][..], &values, &[0x32, 0x32, 238, 238]].concat()
    }

    fn hand(&mut self) -> Vec<u8> {
        self.nth += 1;
        let float = f32::from(self.nth) + 0.25;
        self.forces.insert(float.to_bits());
        let frame = [&[255, 255][..], &float.to_le_bytes(), &[238, 238]].concat();
        self.rig.bytes(self.hand, &frame);
        frame
    }

    fn panel(&mut self, value: u8) {
        self.rig.bytes(self.panel, &[255, 255, value, 238, 238]);
    }

    /// A frame of each device gets through at once, by every link.
    #[track_caller]
    fn assert_all_gets_through(&mut self) {
        self.assert_nothing_made_up();
        self.rig.log.clear();
        self.state();
        let (bits, word) = self.plc();
        let written = self.rig.take_written();
        assert!(written.contains(&coils(192, bits)), "{bits} by Modbus: {written:?}");
        assert!(written.contains(&Written::Registers(8, vec![word])), "{word} by Modbus: {written:?}");
        let frame = self.sensor();
        assert_eq!(self.rig.sent_on(UDP), [frame], "by UDP");
        let frame = self.hand();
        assert_eq!(self.rig.sent_on(self.tcp), [frame], "by TCP");
        self.panel(2);
        assert_eq!(self.rig.sent_on(LinkId::COMMAND), [b"resume"], "by the command port");
        self.rig.link_bytes(LinkId::COMMAND, b"resume success");
        assert_eq!(self.rig.engine.reply_code(self.panel), Some(ReplyCode::Success));
        self.rig.map.coils[176] = true;
        self.rig.run(MS(8));
        let down = [&[255, 255, 1][..], &0.5_f32.to_le_bytes(), &[254, 254]].concat();
        assert_eq!(self.rig.sent_to(self.plc).last(), Some(&down), "bits and the pose to the field");
    }

    /// Everything that went up so far was in a frame that a device sent, or was read back.
    #[track_caller]
    fn assert_nothing_made_up(&mut self) {
        for write in self.rig.take_written() {
            match write {
                Written::Coils(192, bits) => assert!(self.bits.contains(&packed(&bits)), "{bits:?}"),
                Written::Registers(8, words) => {
                    assert!(words.len() == 1 && self.words.contains(&words[0]), "{words:?}");
                }
                other => panic!("nobody sends this: {other:?}"),
            }
        }
        for frame in self.rig.sent_on(UDP) {
            assert_eq!(frame.len(), 14);
            let force = u32::from_le_bytes(*frame[2..].first_chunk().unwrap());
            assert!(self.forces.contains(&force) && frame[2..6] == frame[6..10], "{frame:?}");
            assert_eq!(frame[10..12], [0x32, 0x32], "the neighbour is as it was read back");
        }
        for frame in self.rig.sent_on(self.tcp) {
            let float = u32::from_le_bytes(*frame[2..].first_chunk().unwrap());
            assert!(self.forces.contains(&float), "{frame:?}");
        }
    }

    fn all_links(&self) -> Vec<LinkId> {
        self.rig.engine.links().map(|link| link.id).collect()
    }
}

fn packed(bits: &[bool]) -> u8 {
    bits.iter().rev().fold(0, |byte, &on| byte << 1 | u8::from(on))
}

fn coils(address: u16, byte: u8) -> Written {
    Written::Coils(address, (0..8).map(|bit| byte >> bit & 1 == 1).collect())
}

/// Openings and closings of a link since the last look.
fn actions(rig: &mut Rig, link: LinkId) -> Vec<&'static str> {
    rig.take(|out| match out {
        Out::Open(id) if *id == link => Some("open"),
        Out::Close(id) if *id == link => Some("close"),
        _ => None,
    })
}

#[test]
fn everything_works_at_first() {
    let mut full = Full::new();
    assert_eq!(full.all_links().len(), 5);
    full.assert_all_gets_through();
    for link in full.rig.engine.links() {
        assert_eq!((link.history.connects, link.history.losses), (1, 0), "{:?}", link.kind);
    }
}

#[test]
fn a_refused_link_is_tried_again_and_costs_only_what_it_carries() {
    for link in Full::new().all_links() {
        let mut full = Full::new();
        full.rig.reachable.remove(&link.0);
        full.rig.input(Input::LinkDown { link });
        full.rig.log.clear();
        // 100, 200, 400 .. 5000 ms: six more tries within ten seconds; a listener tries on.
        for _ in 0..200 {
            full.live(50);
            full.plc();
            full.sensor();
            full.hand();
        }
        let opened = actions(&mut full.rig, link).len();
        let expected = if link == full.tcp { 50..=101 } else { 6..=7 };
        assert!(expected.contains(&opened), "{link:?} was opened {opened} times");
        let info = full.rig.link(link);
        assert_eq!((info.history.connects, info.history.losses), (1, 1));
        assert_eq!(info.history.failed_opens as usize, opened);
        let undelivered = [full.plc, full.sensor, full.hand].map(|port| full.rig.counters(port).undelivered);
        let expected = [LinkId::MODBUS, UDP, full.tcp].map(|carrier| if carrier == link { 200 } else { 0 });
        assert_eq!(undelivered, expected, "{link:?}");
        full.panel(1);
        let expected = if link == LinkId::COMMAND { ReplyCode::NotSent } else { ReplyCode::Pending };
        assert_eq!(full.rig.engine.reply_code(full.panel), Some(expected));
        full.rig.link_bytes(LinkId::COMMAND, b"run start");

        full.rig.reachable.insert(link.0);
        full.live(6_000);
        full.assert_all_gets_through();
        assert_eq!(full.rig.link(link).history.connects, 2);
    }
}

#[test]
fn a_connection_that_never_comes_up_is_given_up_and_tried_again() {
    for link in [LinkId::COMMAND, LinkId::STATE, LinkId::MODBUS, UDP] {
        let mut full = Full::new();
        full.rig.unanswered.insert(link.0);
        full.rig.input(Input::LinkDown { link });
        full.rig.log.clear();
        full.rig.run(MS(2_300));
        assert_eq!(actions(&mut full.rig, link), ["open", "close", "open"], "{link:?}");
        // The first attempt's report comes late: it has been closed, so it is not taken for the second.
        full.rig.unanswered.clear();
        full.rig.input(Input::LinkUp { link });
        full.rig.run(MS(100));
        full.assert_all_gets_through();
        assert_eq!(full.rig.link(link).history.failed_opens, 1);
    }
}

#[test]
fn a_late_report_of_a_link_that_was_given_up_changes_nothing() {
    let mut full = Full::new();
    full.rig.unanswered.insert(LinkId::MODBUS.0);
    full.rig.input(Input::LinkDown { link: LinkId::MODBUS });
    full.rig.run(MS(2_150));
    assert_eq!(full.rig.link(LinkId::MODBUS).state.name(), "down");
    full.rig.input(Input::LinkUp { link: LinkId::MODBUS });
    assert_eq!(full.rig.link(LinkId::MODBUS).state.name(), "down");
    full.plc();
    assert_eq!(full.rig.take_written(), []);
    full.rig.unanswered.clear();
    full.live(6_000);
    full.assert_all_gets_through();
}

#[test]
fn a_reset_in_the_middle_of_an_answer_spoils_only_that_answer() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.sent_on(LinkId::MODBUS);
    let (bits, word) = full.plc();
    full.rig.run(MS(4));
    let request = full.rig.sent_on(LinkId::MODBUS).remove(0);
    let answer = full.rig.answer(&request);
    for cut in 0..answer.len() {
        full.rig.map.written.clear();
        full.rig.link_bytes(LinkId::MODBUS, &answer[..cut]);
        full.rig.input(Input::LinkDown { link: LinkId::MODBUS });
        // The rest belongs to the connection that is gone.
        full.rig.link_bytes(LinkId::MODBUS, &answer[cut..]);
        full.rig.modbus_answers = true;
        full.live(6_000);
        assert_eq!(full.rig.link(LinkId::MODBUS).counters.malformed, 0);
        full.assert_all_gets_through();
        full.rig.modbus_answers = false;
        full.rig.run(MS(4));
    }
    assert!(full.bits.contains(&bits) && full.words.contains(&word));
}

#[test]
fn half_a_state_packet_is_never_completed_by_another_connection() {
    let mut full = Full::new();
    let mut old = vec![0; 1468];
    old[368..372].copy_from_slice(&7.0_f32.to_le_bytes());
    old[1310..1312].copy_from_slice(&0x7777_u16.to_le_bytes());
    for cut in [1, 4, 28, 371, 734, 1311, 1467] {
        full.rig.link_bytes(LinkId::STATE, &old[..cut]);
        full.rig.input(Input::LinkDown { link: LinkId::STATE });
        full.rig.link_bytes(LinkId::STATE, &old[cut..]);
        full.live(6_000);
        full.assert_all_gets_through();
        assert_eq!(full.rig.link(LinkId::STATE).counters.malformed, 0, "cut at {cut}");
    }
    assert_eq!(
        full.rig.link(LinkId::STATE).history.losses,
        7 + full.rig.link(LinkId::STATE).history.silences
    );
}

#[test]
fn a_frame_of_the_controller_that_breaks_off_is_never_completed_by_another_connection() {
    let mut full = Full::new();
    let frame = |value: f32| [&[255, 255][..], &value.to_le_bytes(), &[254, 254]].concat();
    full.rig.link_bytes(full.tcp, &frame(7.0)[..5]);
    full.rig.input(Input::LinkDown { link: full.tcp });
    full.rig.run(MS(200));
    full.rig.link_bytes(full.tcp, &frame(7.0)[5..]);
    full.rig.run(MS(20));
    assert!(full.rig.sent_to(full.hand).is_empty());
    full.rig.link_bytes(full.tcp, &frame(3.0));
    full.rig.run(MS(4));
    assert_eq!(full.rig.sent_to(full.hand), [frame(3.0)]);
    full.assert_all_gets_through();
}

#[test]
fn three_requests_without_an_answer_reopen_the_link() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.run(MS(4));
    full.rig.log.clear();
    for _ in 0..30 {
        full.plc();
        full.rig.run(MS(49));
    }
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 2, "one transaction in flight at a time");
    let before = full.rig.link(LinkId::MODBUS).counters.timeouts;
    assert_eq!(before, 2);
    full.rig.run(MS(40));
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.timeouts, 3);
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["close"]);
    full.rig.modbus_answers = true;
    full.rig.run(MS(100));
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["open"]);
    full.assert_all_gets_through();
    assert_eq!(full.rig.link(LinkId::MODBUS).history.losses, 1);
}

#[test]
fn no_request_is_handed_over_before_the_one_before_it_has_left() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.log.clear();
    full.rig.modbus_answers = false;
    full.rig.reports_sent = false;
    // A poll is due.
    full.rig.run(MS(8));
    let requests = full.rig.sent_on(LinkId::MODBUS);
    assert_eq!(requests.len(), 1);
    // The answer overtakes the transport's report.
    let answer = full.rig.answer(&requests[0]);
    full.rig.link_bytes(LinkId::MODBUS, &answer);
    full.plc();
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 0);
    full.rig.input(Input::LinkSent { link: LinkId::MODBUS });
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 1);
    // One that does not leave in time is not left to be carried out later: the connection goes with it.
    actions(&mut full.rig, LinkId::MODBUS);
    full.rig.run(MS(500));
    assert_eq!(full.rig.sent_on(LinkId::MODBUS).len(), 0);
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["close"]);
    full.rig.reports_sent = true;
    full.rig.modbus_answers = true;
    full.rig.run(MS(200));
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["open"]);
}

#[test]
fn two_requests_without_an_answer_and_one_with_one_are_no_three() {
    let mut full = Full::new();
    for _ in 0..5 {
        full.rig.modbus_answers = false;
        full.rig.run(MS(1_010));
        full.rig.modbus_answers = true;
        for request in full.rig.sent_on(LinkId::MODBUS) {
            let answer = full.rig.answer(&request);
            full.rig.link_bytes(LinkId::MODBUS, &answer);
        }
        full.rig.run(MS(100));
    }
    let link = full.rig.link(LinkId::MODBUS);
    assert_eq!((link.counters.timeouts, link.history.losses), (10, 0));
}

#[test]
fn an_answer_that_comes_after_its_time_is_not_taken_for_the_next_one() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.sent_on(LinkId::MODBUS);
    full.rig.run(MS(4));
    // A poll of the inputs, answered when the next one is under way.
    let first = full.rig.sent_on(LinkId::MODBUS).remove(0);
    full.rig.map.coils[176] = true;
    let late = full.rig.answer(&first);
    full.rig.map.coils[176] = false;
    full.rig.run(MS(510));
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.timeouts, 1);
    let second = full.rig.sent_on(LinkId::MODBUS).remove(0);
    let known = full.rig.engine.image().value(var("DigitalSignalStatus[1]"));
    full.rig.link_bytes(LinkId::MODBUS, &late);
    assert_eq!(full.rig.engine.image().value(var("DigitalSignalStatus[1]")), known, "too late to count");
    assert!(full.rig.sent_on(LinkId::MODBUS).is_empty(), "the second one is still under way");
    full.rig.map.coils[177] = true;
    let answer = full.rig.answer(&second);
    full.rig.link_bytes(LinkId::MODBUS, &answer);
    assert_eq!(full.rig.engine.image().value(var("DigitalSignalStatus[1]")), Scalar::Byte(2));
    full.rig.map.coils[177] = false;
    full.rig.modbus_answers = true;
    full.rig.run(MS(510));
    full.assert_all_gets_through();
    let link = full.rig.link(LinkId::MODBUS);
    assert_eq!((link.counters.malformed, link.history.losses), (0, 0), "slow is not wrong");
}

#[test]
fn a_slow_controller_is_served_at_its_own_pace() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.modbus_answers = false;
    full.rig.map.written.clear();
    let mut newest = (0, 0);
    // Every answer takes 80 ms, the PLC sends every 10 ms.
    for nth in 0..400 {
        newest = full.plc();
        full.rig.run(MS(10));
        if nth % 8 == 7 {
            for request in full.rig.sent_on(LinkId::MODBUS) {
                let answer = full.rig.answer(&request);
                full.rig.link_bytes(LinkId::MODBUS, &answer);
            }
        }
    }
    full.rig.modbus_answers = true;
    for request in full.rig.sent_on(LinkId::MODBUS) {
        let answer = full.rig.answer(&request);
        full.rig.link_bytes(LinkId::MODBUS, &answer);
    }
    let written: Vec<u16> = full
        .rig
        .map
        .written
        .iter()
        .filter_map(|write| match write {
            Written::Registers(8, words) => Some(words[0]),
            _ => None,
        })
        .collect();
    assert!(written.is_sorted(), "never an older value after a newer one: {written:?}");
    assert_eq!(written.last(), Some(&newest.1), "and the newest in the end");
    assert!(written.len() >= 10, "{}", written.len());
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.timeouts, 0);
    let counters = full.rig.counters(full.plc);
    assert!(counters.values_expired > 0, "edges older than the port's timeout were dropped and counted");
    full.rig.run(MS(200));
    full.assert_all_gets_through();
}

#[test]
fn exceptions_are_counted_and_change_nothing_else() {
    for exception in [
        Exception::IllegalFunction,
        Exception::IllegalDataAddress,
        Exception::IllegalDataValue,
        Exception::DeviceBusy,
        Exception::Unknown(0x7F),
    ] {
        let mut full = Full::new();
        full.rig.map.exception = Some(exception);
        for _ in 0..5 {
            full.plc();
            full.rig.run(MS(10));
        }
        let link = full.rig.link(LinkId::MODBUS);
        assert_eq!((link.counters.refused, link.counters.malformed, link.history.losses), (10, 0, 0));
        assert_eq!(full.rig.take_written(), []);
        full.rig.map.exception = None;
        full.rig.run(MS(100));
        assert_eq!(full.rig.take_written(), [], "what was refused is not repeated");
        full.assert_all_gets_through();
    }
}

/// A port whose output has a safe value.
fn guarded() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

const ON: &[u8] = &[255, 255, 1, 238, 238];
const OFF: &[u8] = &[255, 255, 0, 238, 238];

#[test]
fn a_refused_safe_value_is_written_again_until_it_is_taken() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.map.exception = Some(Exception::DeviceBusy);
    rig.take_written();
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(2_500));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 5, "every 500 ms, not as fast as it is refused");
    rig.map.exception = None;
    rig.run(MS(10_000));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
    assert_eq!(rig.counters(port).timeouts, 1);
}

#[test]
fn a_refused_safe_value_gives_way_to_the_owner() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.map.exception = Some(Exception::DeviceBusy);
    rig.run(MS(101));
    rig.map.exception = None;
    rig.take_written();
    rig.bytes(port, OFF);
    assert_eq!(rig.take_written(), [coils(192, 0)]);
    for _ in 0..40 {
        rig.run(MS(50));
        rig.bytes(port, OFF);
    }
    assert!(rig.take_written().iter().all(|write| *write == coils(192, 0)), "the owner is back");
}

#[test]
fn an_owners_value_is_never_kept_as_if_it_were_safe() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(1_000);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, ON);
    rig.modbus_answers = false;
    rig.take_written();
    // The safe value is under way when its owner comes back and the link breaks.
    rig.run(MS(1_001));
    rig.bytes(port, OFF);
    rig.bytes(port, ON);
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.modbus_answers = true;
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(900));
    assert_eq!(rig.link(LinkId::MODBUS).state.name(), "up");
    assert_eq!(rig.take_written(), [], "received before the link was lost");
    rig.run(MS(5_000));
    assert_eq!(rig.take_written(), [coils(192, 4)], "silent again: safe again");
}

#[test]
fn a_safe_value_whose_write_was_cut_off_is_written_on_the_next_connection() {
    let (mut rig, port) = guarded();
    rig.bytes(port, ON);
    rig.modbus_answers = false;
    rig.take_written();
    rig.run(MS(101));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 2);
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.modbus_answers = true;
    rig.run(MS(5_000));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}

#[test]
fn garbage_on_a_link_is_counted_and_ends_in_a_good_connection() {
    let garbage: Vec<u8> = (0..4_000_u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    for link in Full::new().all_links() {
        for chunk in [1, 7, 64, 1468, 4_000] {
            let mut full = Full::new();
            full.rig.run(MS(50));
            full.assert_nothing_made_up();
            for piece in garbage.chunks(chunk) {
                full.rig.link_bytes(link, piece);
            }
            full.live(6_000);
            full.assert_all_gets_through();
            let info = full.rig.link(link);
            let noticed = info.counters.malformed + info.counters.resync_bytes + info.history.losses;
            assert!(noticed > 0, "{link:?} in pieces of {chunk}: {:?}", info.counters);
            assert!(info.counters.bytes_in > 0);
            let others = full.rig.engine.links().filter(|other| other.id != link);
            for other in others.filter(|other| ![LinkId::STATE, full.tcp].contains(&other.id)) {
                assert_eq!(other.history.losses, 0, "{:?} has nothing to do with {link:?}", other.kind);
            }
        }
    }
}

#[test]
fn a_wrong_header_closes_the_modbus_link_at_once() {
    let mut full = Full::new();
    full.rig.run(MS(100));
    full.rig.log.clear();
    full.rig.link_bytes(LinkId::MODBUS, &[0, 1, 0, 1, 0, 3, 1, 0x83, 2]);
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["close"]);
    full.plc();
    assert_eq!(full.rig.counters(full.plc).undelivered, 1);
    full.rig.run(MS(100));
    assert_eq!(actions(&mut full.rig, LinkId::MODBUS), ["open"]);
    assert_eq!(full.rig.link(LinkId::MODBUS).counters.malformed, 1);
    full.assert_all_gets_through();
}

#[test]
fn a_controller_that_restarts_gets_nothing_stale() {
    let mut full = Full::new();
    full.assert_all_gets_through();
    full.rig.reachable.clear();
    for link in full.all_links() {
        full.rig.input(Input::LinkDown { link });
    }
    full.rig.map.coils = [false; 232];
    full.rig.map.registers = [0; 118];
    // Ten seconds down; the devices go on and one picks a command.
    for _ in 0..100 {
        full.plc();
        full.sensor();
        full.hand();
        full.rig.run(MS(100));
    }
    full.panel(1);
    assert_eq!(full.rig.take_written(), []);
    assert!(full.rig.sent_on(UDP).is_empty() && full.rig.sent_on(full.tcp).is_empty());
    full.rig.run(MS(200));
    full.rig.log.clear();
    full.rig.reachable = (0..16).collect();
    full.live(6_000);
    assert_eq!(full.rig.take_written(), [], "all devices have been silent since before it was back");
    assert!(full.rig.sent_on(UDP).is_empty() && full.rig.sent_on(full.tcp).is_empty());
    assert!(full.rig.sent_on(LinkId::COMMAND).is_empty());
    full.assert_all_gets_through();
    for (port, frames) in [(full.plc, 100), (full.sensor, 100), (full.hand, 100)] {
        assert_eq!(full.rig.counters(port).undelivered, frames);
    }
}

#[test]
fn links_that_come_and_go_all_the_time_do_no_harm() {
    let mut full = Full::new();
    let links = full.all_links();
    for round in 0..500_usize {
        let link = links[round * 7 % links.len()];
        full.rig.input(if round % 3 == 0 { Input::LinkDown { link } } else { Input::LinkUp { link } });
        full.rig.modbus_answers = round % 5 != 0;
        full.plc();
        full.sensor();
        full.hand();
        full.rig.run(Duration::from_micros(7_777));
        if round % 10 == 0 {
            full.state();
        }
    }
    full.rig.modbus_answers = true;
    full.live(6_000);
    full.assert_all_gets_through();
}
