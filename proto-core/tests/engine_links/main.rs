//! Faults of the controller's side: each is counted, nothing is written that no device sent, and the
//! next good frame gets through (docs/engine.md sections 5, 9).

mod modbus;
#[path = "../rig/mod.rs"]
mod rig;

use std::collections::BTreeSet;

use proto_core::config::*;
use proto_core::engine::{Input, LinkId, PortId, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::time::Duration;
use proto_core::wire::scalar::ScalarType;
use rig::*;

/// A cell that uses every kind of link.
struct Full {
    rig: Rig,
    /// DigitalOutputCommand[1] and WordInputReg[1] up by Modbus; DI1..8 and RobotState[8] down.
    plc: PortId,
    /// ForceEnd[1..2] up by UDP 2011, in one frame with WordInputReg[32], which no device sends.
    sensor: PortId,
    /// Picks commands.
    panel: PortId,
    /// FloatInputReg[1] up by the controller's TCP client.
    hand: PortId,
    tcp: LinkId,
    /// What devices sent in valid frames.
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

    /// What the controller sends unasked, for this long.
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
        self.assert_nothing_invented();
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
    fn assert_nothing_invented(&mut self) {
        for write in self.rig.take_written() {
            match write {
                Written::Coils(192, bits) => assert!(self.bits.contains(&packed(&bits)), "{bits:?}"),
                Written::Registers(8, words) => {
                    assert!(words.len() == 1 && self.words.contains(&words[0]), "{words:?}");
                }
                other => panic!("no device sent this: {other:?}"),
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

/// Openings and closings of a link since the last call.
fn actions(rig: &mut Rig, link: LinkId) -> Vec<&'static str> {
    rig.take(|out| match out {
        Out::Open(id) if *id == link => Some("open"),
        Out::Close(id) if *id == link => Some("close"),
        _ => None,
    })
}

#[test]
fn everything_works_without_faults() {
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
        // Pauses of 100, 200, 400 .. 5000 ms: six more tries in ten seconds; a listener's do not grow.
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
fn half_a_recipe_frame_is_never_completed_by_another_connection() {
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
fn garbage_on_a_link_is_counted_and_ends_in_a_good_connection() {
    let garbage: Vec<u8> = (0..4_000_u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    for link in Full::new().all_links() {
        for chunk in [1, 7, 64, 1468, 4_000] {
            let mut full = Full::new();
            full.rig.run(MS(50));
            full.assert_nothing_invented();
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
