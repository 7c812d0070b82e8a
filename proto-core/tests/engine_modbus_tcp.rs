//! Ports of Modbus TCP: devices at the other end of a connection, in virtual time (docs/engine.md section 13).

#[path = "engine_exchanges/line.rs"]
#[allow(dead_code, reason = "each test binary uses its own part")]
mod line;
#[path = "rig/mod.rs"]
mod rig;

use proto_core::config::*;
use proto_core::device::Encoding;
use proto_core::engine::{
    EventCounters, FieldBus, Health, Input, LinkId, PeerStatus, PortId, PortState, Rejection, Transport,
};
use proto_core::link::LinkState;
use proto_core::modbus::rtu::Operation;
use proto_core::recipe::model::Mode;
use proto_core::sysvar::ModbusPlace;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;

use line::{reads, writes};
use rig::*;

/// Bit 0 of this byte starts, bit 1 stops.
const BITS: &str = "BitOutputReg[3]";

fn rising(bit: u8) -> Triggers {
    Triggers { rising: Some((var(BITS), bit)), ..Triggers::NEVER }
}

fn every(millis: u64) -> Triggers {
    Triggers::every(MS(millis))
}

fn place_of(name: &str) -> usize {
    match var(name).modbus() {
        Some(ModbusPlace::Register { address }) => address.into(),
        Some(ModbusPlace::Coils { first, .. }) => first.into(),
        other => panic!("{name}: {other:?}"),
    }
}

/// A request as a device gets it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Asked {
    at: Instant,
    id: u16,
    /// Unit id, function code and data.
    body: Vec<u8>,
}

impl Asked {
    fn new(at: Instant, frame: &[u8]) -> Self {
        let len = usize::from(u16::from_be_bytes([frame[4], frame[5]]));
        assert_eq!((&frame[2..4], frame.len()), (&[0, 0][..], 6 + len), "{frame:02X?}");
        Self { at, id: u16::from_be_bytes([frame[0], frame[1]]), body: frame[6..].to_vec() }
    }

    fn address(&self) -> u16 {
        u16::from_be_bytes([self.body[2], self.body[3]])
    }

    /// The good answer of a device, all of whose registers hold this.
    fn good(&self, word: u16) -> Vec<u8> {
        match self.body[1] {
            3 => {
                let count = self.body[5];
                let mut body = vec![self.body[0], 3, count * 2];
                (0..count).for_each(|_| body.extend(word.to_be_bytes()));
                adu(self.id, &body)
            }
            _ => adu(self.id, &self.body[..6]),
        }
    }

    fn refused(&self, code: u8) -> Vec<u8> {
        adu(self.id, &[self.body[0], self.body[1] | 0x80, code])
    }
}

fn adu(id: u16, body: &[u8]) -> Vec<u8> {
    [&id.to_be_bytes()[..], &[0, 0], &(body.len() as u16).to_be_bytes(), body].concat()
}

/// A device, its connection, and what is on its way from it.
struct Device {
    rig: Rig,
    port: PortId,
    link: LinkId,
    coming: Vec<(Instant, Vec<u8>)>,
}

impl Device {
    /// A port with these exchanges.
    fn new(make: impl FnOnce(&mut Cell) -> Vec<Exchange>) -> Self {
        Self::with(make, |_| ())
    }

    fn with(make: impl FnOnce(&mut Cell) -> Vec<Exchange>, change: impl FnOnce(&mut Cell)) -> Self {
        let mut cell = Cell::new();
        let exchanges = make(&mut cell);
        let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output: None });
        cell.0.exchanges.extend(exchanges.iter().copied());
        cell.last_recipe().exchanges = Span { start: 0, len: exchanges.len() as u16 };
        let port = cell.port(Bus::ModbusTcp { host: "plc.cell".try_into().unwrap(), port: 1502 }, recipe);
        cell.last_port().timeout = MS(300);
        change(&mut cell);
        let link = LinkId::of_port(port);
        Self { rig: cell.rig(), port, link, coming: Vec::new() }
    }

    /// Something comes by itself, so much later.
    fn comes(&mut self, delay: Duration, bytes: Vec<u8>) {
        self.coming.push((self.rig.now + delay, bytes));
    }

    /// Runs for a time; what is asked, and `says` what comes after it, each so much later.
    fn run(&mut self, millis: u64, mut says: impl FnMut(&Asked) -> Vec<(u64, Vec<u8>)>) -> Vec<Asked> {
        let Self { rig, link, coming, .. } = self;
        let end = rig.now + MS(millis);
        let mut all = Vec::new();
        loop {
            for frame in rig.sent_on(*link) {
                let asked = Asked::new(rig.now, &frame);
                coming.extend(says(&asked).into_iter().map(|(delay, reply)| (rig.now + MS(delay), reply)));
                all.push(asked);
            }
            coming.sort_by_key(|(at, _)| *at);
            let next = coming.first().map_or(Instant::NEVER, |(at, _)| *at);
            if next.min(rig.wake) > end {
                rig.now = end;
                return all;
            }
            if next <= rig.wake {
                rig.now = next.max(rig.now);
                let (_, reply) = coming.remove(0);
                rig.link_bytes(*link, &reply);
            } else {
                rig.now = rig.wake.max(rig.now);
                rig.input(Input::Tick);
            }
        }
    }

    fn lose(&mut self) {
        self.coming.clear();
        self.rig.input(Input::LinkDown { link: self.link });
    }

    fn bit(&mut self, bit: usize, on: bool) {
        self.rig.map.coils[place_of(BITS) + bit] = on;
    }

    fn set(&mut self, name: &str, value: u16) {
        self.rig.map.registers[place_of(name)] = value;
    }

    /// What the robot's register shows.
    fn shown(&self, name: &str) -> u16 {
        self.rig.map.registers[place_of(name)]
    }

    fn peer(&self, unit: u8) -> PeerStatus {
        let status = self.rig.engine.status(self.rig.now);
        let port = status.ports().next().unwrap();
        assert_eq!(port.bus, FieldBus::ModbusTcp);
        port.peers().find(|peer| peer.number == unit).unwrap()
    }

    fn events(&self) -> EventCounters {
        self.peer(3).counters.events
    }

    fn is_up(&self) -> bool {
        matches!(self.rig.link(self.link).state, LinkState::Up { .. })
    }

    fn last_rejection(&self) -> Rejection {
        let status = self.rig.engine.status(self.rig.now);
        status.ports().next().unwrap().last_rejection.unwrap().why
    }
}

fn good(asked: &Asked) -> Vec<(u64, Vec<u8>)> {
    vec![(2, asked.good(7))]
}

/// Polls a register each 50 ms, and writes one when bit 0 rises; bit 1 stops.
fn axis(cell: &mut Cell) -> Vec<Exchange> {
    let mut start = writes(cell, 3, &["WordOutputReg[1]"], rising(0));
    start.outcome = OutcomeTo { to: Some(var("WordInputReg[5]")), ..OutcomeTo::NONE };
    let mut stop = writes(cell, 3, &["WordOutputReg[2]"], rising(1));
    let Transaction::Rtu { operation, .. } = &mut stop.transaction else { panic!() };
    (*operation, stop.stop) = (Operation::WriteRegisters { address: 0x30, count: 1 }, true);
    vec![reads(cell, 3, &["WordInputReg[1]"], every(50)), start, stop]
}

/// Those of the requests that start the axis.
fn starts(asked: &[Asked]) -> usize {
    asked.iter().filter(|asked| asked.body[1] == 16 && asked.address() == 0x20).count()
}

#[test]
fn bits_of_a_register_are_confirmed_by_all_of_their_request() {
    for (said, outcome) in [(8, 2), (6, 5), (7, 5)] {
        let mut device = Device::new(|cell| {
            let mut write = writes(cell, 3, &["WordOutputReg[1]"], rising(0));
            write.outcome = OutcomeTo { to: Some(var("WordInputReg[5]")), ..OutcomeTo::NONE };
            let Transaction::Rtu { operation, written, .. } = &mut write.transaction else { panic!() };
            *operation = Operation::MaskWriteRegister { address: 0x20, mask: 0x0FF0 };
            let FieldSpec::DeviceOutput { encoding, .. } = &mut cell.0.fields[usize::from(written.start)]
            else {
                panic!()
            };
            *encoding = Encoding::bits(ScalarType::Word, 4..=11).big_endian();
            vec![write]
        });
        device.set("WordOutputReg[1]", 0x12);
        assert_eq!(device.run(300, good), []);
        device.bit(0, true);
        let asked = device.run(2_000, |asked| vec![(2, adu(asked.id, &asked.body[..said]))]);
        let bodies: Vec<&[u8]> = asked.iter().map(|asked| &asked.body[..]).collect();
        assert_eq!(bodies, [&[3, 22, 0, 0x20, 0xF0, 0x0F, 0x01, 0x20][..]]);
        assert_eq!(device.shown("WordInputReg[5]"), outcome, "{said} bytes");
    }
}

#[test]
fn a_register_of_the_device_reaches_the_robot_and_back() {
    let mut device = Device::new(|cell| {
        let change = Triggers { change: true, ..Triggers::NEVER };
        vec![
            reads(cell, 3, &["WordInputReg[1]", "WordInputReg[2]"], every(50)),
            writes(cell, 4, &["WordOutputReg[1]"], change),
        ]
    });
    let info = device.rig.link(device.link);
    assert_eq!((info.name, info.kind.name(), info.endpoint.host), ("port0", "modbus-tcp", "plc.cell"));
    assert_eq!(info.endpoint.transport, Transport::Tcp { port: 1502 });
    device.set("WordOutputReg[1]", 0x1234);
    let asked = device.run(500, |asked| vec![(2, asked.good(0x0BEE))]);
    assert_eq!((device.shown("WordInputReg[1]"), device.shown("WordInputReg[2]")), (0x0BEE, 0x0BEE));
    let written: Vec<_> = asked.iter().filter(|asked| asked.body[0] == 4).collect();
    assert_eq!(written[0].body, [4, 16, 0, 0x20, 0, 1, 2, 0x12, 0x34]);
    assert_eq!(written.len(), 1);
    assert_eq!(asked.iter().find(|asked| asked.body[0] == 3).unwrap().body, [3, 3, 0, 0x10, 0, 2]);
    assert!(asked.windows(2).all(|pair| pair[1].id == pair[0].id + 1), "{asked:?}");
    assert_eq!(device.rig.engine.port_state(device.port), Some(PortState::Working));
}

#[test]
fn a_late_reply_is_counted_and_nothing_waits_for_it() {
    let mut device = Device::new(|cell| {
        let mut polls = ["WordInputReg[1]", "WordInputReg[2]"].map(|name| reads(cell, 3, &[name], every(20)));
        for (nth, poll) in polls.iter_mut().enumerate() {
            let Transaction::Rtu { operation, .. } = &mut poll.transaction else { panic!() };
            *operation = Operation::ReadHoldingRegisters { address: nth as u16, count: 1 };
            (poll.timeout, poll.late, poll.retries) = (MS(30), None, 0);
        }
        polls.to_vec()
    });
    // Every fifth reply to the first is late, and holds another value.
    let mut nth = 0;
    let asked = device.run(10_000, |asked| {
        nth += 1;
        match (asked.address(), nth % 5) {
            (0, 0) => vec![(75, asked.good(111))],
            (address, _) => vec![(2, asked.good(100 + address))],
        }
    });
    for written in device.rig.take_written() {
        let Written::Registers(address, words) = written else { panic!() };
        for (at, word) in (usize::from(address)..).zip(words) {
            let wanted = if at == place_of("WordInputReg[1]") { 100 } else { 101 };
            assert_eq!(word, wanted, "a value of another request");
        }
    }
    let counters = device.peer(3).counters;
    assert!(counters.late_replies > 50 && counters.late_replies + 1 >= counters.timeouts, "{counters:?}");
    let longest = |address| {
        let own = asked.iter().filter(|asked| asked.address() == address).collect::<Vec<_>>();
        own.windows(2).map(|pair| pair[1].at.saturating_since(pair[0].at)).max().unwrap()
    };
    assert!(longest(0) < MS(200) && longest(1) < MS(80), "{} {}", longest(0), longest(1));
    assert_eq!(device.last_rejection(), Rejection::Late);
}

#[test]
fn the_reply_to_the_first_transmission_is_not_one_to_its_repetition() {
    let mut device = Device::new(|cell| {
        let mut poll = reads(cell, 3, &["WordInputReg[1]"], every(200));
        (poll.timeout, poll.retries) = (MS(50), 1);
        vec![poll]
    });
    device.run(1_000, good);
    let mut held = None;
    device.run(400, |asked| match held.take() {
        // The old reply comes while the repetition is on its way.
        Some(first) => vec![(10, first), (20, asked.good(8))],
        None => {
            held = Some(asked.good(999));
            vec![]
        }
    });
    assert_eq!(device.shown("WordInputReg[1]"), 8);
    let counters = device.peer(3).counters;
    assert!(counters.late_replies > 0 && counters.retries > 0, "{counters:?}");
    assert!(
        device
            .rig
            .take_written()
            .iter()
            .all(|one| !matches!(one, Written::Registers(_, words) if words.contains(&999)))
    );
}

#[test]
fn a_value_is_as_old_as_its_own_reply() {
    let mut device = Device::with(
        |cell| {
            let mut poll = reads(cell, 3, &["WordInputReg[1]"], every(500));
            (poll.timeout, poll.retries) = (MS(100), 1);
            vec![poll]
        },
        |cell| {
            cell.last_port().timeout = MS(150);
            cell.safe("WordInputReg[1]", 9.0);
        },
    );
    device.run(1_400, good);
    assert_eq!(device.shown("WordInputReg[1]"), 9, "it is asked seldom");
    let mut nth = 0;
    let mut second = |asked: &Asked| {
        nth += 1;
        if nth == 2 { good(asked) } else { vec![] }
    };
    while device.run(1, &mut second).is_empty() {}
    device.run(120, &mut second);
    assert_eq!(device.shown("WordInputReg[1]"), 7);
    device.run(100, &mut second);
    assert_eq!(device.shown("WordInputReg[1]"), 7, "the repetition is another request");
    device.run(60, &mut second);
    assert_eq!(device.shown("WordInputReg[1]"), 9);
}

#[test]
fn a_repetition_has_the_newest_value() {
    let mut device = Device::new(|cell| {
        let change = Triggers { change: true, ..Triggers::NEVER };
        vec![writes(cell, 3, &["WordOutputReg[1]"], change)]
    });
    device.set("WordOutputReg[1]", 1);
    device.run(500, good);
    device.set("WordOutputReg[1]", 2);
    while device.run(1, |_| vec![]).is_empty() {}
    device.run(50, |_| vec![]);
    device.set("WordOutputReg[1]", 3);
    let asked = device.run(80, good);
    assert!(!asked.is_empty() && asked.iter().all(|asked| asked.body[8] == 3), "{asked:?}");
}

#[test]
fn a_reply_with_a_transaction_id_that_nobody_sent_is_rejected() {
    let mut device = Device::new(|cell| vec![reads(cell, 3, &["WordInputReg[1]"], every(50))]);
    device.run(500, |asked| {
        let foreign = Asked { id: asked.id.wrapping_add(0x4000), ..asked.clone() };
        vec![(1, foreign.good(999)), (2, asked.good(7)), (3, asked.good(998))]
    });
    assert_eq!(device.shown("WordInputReg[1]"), 7);
    let counters = device.rig.counters(device.port);
    assert!(counters.rejected_other_device >= 18, "{counters:?}");
    assert_eq!(device.last_rejection(), Rejection::OtherDevice);
    assert!(device.is_up());
}

#[test]
fn a_reply_of_another_unit_or_function_or_length_is_rejected() {
    for spoil in [0, 1, 2] {
        let mut device = Device::new(|cell| vec![reads(cell, 3, &["WordInputReg[1]"], every(50))]);
        device.run(500, |asked| {
            let mut body = asked.good(999)[6..].to_vec();
            body[spoil] ^= 1;
            vec![(2, adu(asked.id, &body))]
        });
        let counters = device.peer(3).counters;
        assert_eq!((device.shown("WordInputReg[1]"), counters.replies), (0, 0), "{spoil}");
        assert!(counters.timeouts > 1 && device.is_up());
    }
}

#[test]
fn a_wrong_header_closes_the_connection_which_is_opened_again_with_back_off() {
    let good_frame = |asked: &Asked| asked.good(7);
    type Spoil = fn(&mut Vec<u8>);
    let spoils: [Spoil; 4] = [
        |frame| frame[3] = 1,
        |frame| (frame[4], frame[5]) = (1, 0),
        |frame| frame[5] = 1,
        |frame| frame[5] = 0,
    ];
    for spoil in spoils {
        let mut device = Device::new(|cell| vec![reads(cell, 3, &["WordInputReg[1]"], every(50))]);
        device.run(6_000, good);
        let before = device.rig.link(device.link).counters.malformed;
        device.rig.closed();
        let mut left = 3;
        let mut opened = Vec::new();
        let mut last = Instant::ZERO;
        device.run(2_000, |asked| {
            let mut frame = good_frame(asked);
            if left > 0 {
                left -= 1;
                spoil(&mut frame);
                // What stands behind it is not read.
                frame.extend(asked.good(999));
                opened.push(asked.at.saturating_since(last));
                last = asked.at;
            }
            vec![(1, frame)]
        });
        let info = device.rig.link(device.link);
        assert_eq!((info.counters.malformed - before, info.history.connects), (3, 4));
        assert_eq!(device.rig.counters(device.port).rejected_length, 3);
        // 100 ms after a connection that held, then longer.
        assert!(opened[1] >= MS(100) && opened[2] >= MS(200) && device.is_up(), "{opened:?}");
        assert_eq!(device.rig.closed().len(), 3);
        assert_eq!((device.shown("WordInputReg[1]"), device.last_rejection()), (7, Rejection::Malformed));
    }
}

#[test]
fn replies_may_come_in_pieces_and_together() {
    let mut device = Device::new(|cell| vec![reads(cell, 3, &["WordInputReg[1]"], every(50))]);
    device.run(500, |asked| asked.good(7).iter().map(|&byte| (2, vec![byte])).collect());
    assert_eq!((device.shown("WordInputReg[1]"), device.peer(3).counters.timeouts), (7, 0));
    // One that nobody asked for and the beginning of the reply, then its end.
    device.run(500, |asked| {
        let (reply, other) = (asked.good(8), Asked { id: 0x7000, ..asked.clone() }.good(9));
        let (front, back) = reply.split_at(5);
        vec![(2, [&other[..], front].concat()), (4, back.to_vec())]
    });
    assert_eq!((device.shown("WordInputReg[1]"), device.peer(3).counters.timeouts), (8, 0));
}

#[test]
fn half_a_frame_that_ends_later_is_still_the_same_frame() {
    let mut device = Device::new(|cell| {
        let mut polls = ["WordInputReg[1]", "WordInputReg[2]"].map(|name| reads(cell, 3, &[name], every(50)));
        for (nth, poll) in polls.iter_mut().enumerate() {
            let Transaction::Rtu { operation, .. } = &mut poll.transaction else { panic!() };
            *operation = Operation::ReadHoldingRegisters { address: nth as u16, count: 1 };
            (poll.timeout, poll.retries) = (MS([30, 100][nth]), 0);
        }
        polls.to_vec()
    });
    device.run(500, good);
    // The rest comes when the next request is on its way, whose reply is behind it.
    let mut left = 1;
    let asked = device.run(300, |asked| match asked.address() {
        0 if left > 0 => {
            left -= 1;
            let reply = asked.good(999);
            vec![(2, reply[..7].to_vec()), (60, reply[7..].to_vec())]
        }
        0 => vec![(2, asked.good(8))],
        _ => vec![(55, asked.good(9))],
    });
    let first = asked.iter().find(|asked| asked.address() == 0).unwrap().at;
    assert!(asked.iter().any(|asked| asked.at > first && asked.at < first + MS(60)), "it is asked between");
    assert_eq!((device.shown("WordInputReg[1]"), device.shown("WordInputReg[2]")), (8, 9));
    let counters = device.peer(3).counters;
    assert_eq!((counters.timeouts, counters.late_replies), (1, 1));
    // Half a frame of a connection that is lost does not go on in the next one.
    device.rig.link_bytes(device.link, &adu(1, &[3, 3, 2, 0, 0])[..9]);
    device.lose();
    device.run(500, |asked| vec![(2, asked.good(5))]);
    assert_eq!((device.shown("WordInputReg[1]"), device.peer(3).counters.timeouts), (5, 1));
    assert_eq!(device.rig.link(device.link).counters.malformed, 0);
}

#[test]
fn an_event_whose_connection_is_lost_is_unknown_and_never_sent_again() {
    let mut device = Device::new(axis);
    device.set("WordOutputReg[1]", 1_000);
    device.run(500, good);
    device.bit(0, true);
    // It is heard and not answered.
    let asked = device.run(100, |asked| if asked.body[1] == 16 { vec![] } else { good(asked) });
    assert_eq!(starts(&asked), 1);
    device.lose();
    assert_eq!(
        (device.events().unknown, device.rig.engine.port_state(device.port)),
        (1, Some(PortState::Gone))
    );
    let asked = device.run(5_000, good);
    assert!(device.is_up() && asked.len() > 50);
    assert_eq!((starts(&asked), device.events().unknown, device.shown("WordInputReg[5]")), (0, 1, 5));
    // The next rise is one of its own.
    device.bit(0, false);
    device.run(100, good);
    device.bit(0, true);
    assert_eq!((starts(&device.run(300, good)), device.events().done), (1, 1));
}

#[test]
fn a_bit_of_before_the_controller_and_the_device_were_lost_does_not_rise() {
    let mut device = Device::new(axis);
    device.set("WordOutputReg[1]", 1_000);
    device.run(500, good);
    // First the controller's connection, then the device's; both are back at once. What is written on the first one has
    // an answer before the bit is read, and the newest value of the bit is still the 0 of before.
    device.rig.input(Input::LinkDown { link: LinkId::MODBUS });
    device.run(7, good);
    device.lose();
    device.bit(0, true);
    let asked = device.run(500, good);
    assert!(device.is_up() && asked.len() > 5);
    assert_eq!((starts(&asked), device.events()), (0, EventCounters::default()));
    // The next rise is one.
    device.bit(0, false);
    device.run(100, good);
    device.bit(0, true);
    assert_eq!(starts(&device.run(300, good)), 1);
}

#[test]
fn an_event_without_a_connection_is_not_sent_later() {
    let mut device = Device::new(axis);
    device.set("WordOutputReg[1]", 1_000);
    device.run(500, good);
    device.rig.reachable.remove(&device.link.0);
    device.lose();
    device.run(100, good);
    device.bit(0, true);
    device.run(200, good);
    device.rig.reachable.insert(device.link.0);
    let asked = device.run(3_000, good);
    assert!(device.is_up());
    assert_eq!((starts(&asked), device.events().away), (0, 1));
}

#[test]
fn an_event_that_the_devices_tcp_does_not_acknowledge_is_not_delivered_later() {
    let mut device = Device::with(axis, |cell| {
        cell.0.exchanges[1].trigger = Some(MS(120));
        cell.0.exchanges[1].timeout = MS(2_000);
    });
    device.set("WordOutputReg[1]", 1_000);
    device.run(500, good);
    device.rig.closed();
    device.rig.acknowledges = false;
    device.bit(0, true);
    let mut sent = Instant::ZERO;
    device.run(100, |asked| {
        if asked.body[1] == 16 {
            sent = asked.at;
            return vec![];
        }
        good(asked)
    });
    assert_ne!(sent, Instant::ZERO);
    device.run(150, |_| vec![]);
    let closed = device.rig.closed();
    let (at, link) = closed[0];
    assert_eq!((link, closed.len()), (device.link, 1));
    assert!(at.saturating_since(sent) <= MS(120), "{}", at.saturating_since(sent));
    assert_eq!((device.events().unknown, device.rig.link(link).counters.unacknowledged), (1, 1));
    device.rig.acknowledges = true;
    assert_eq!(starts(&device.run(3_000, good)), 0);
}

#[test]
fn exceptions_mean_what_they_mean_on_a_line() {
    for (code, counted) in [(2, [1, 0, 0]), (5, [0, 1, 0]), (10, [0, 0, 1]), (11, [0, 0, 1])] {
        let mut device = Device::new(axis);
        device.set("WordOutputReg[1]", 1_000);
        device.run(500, good);
        device.bit(0, true);
        let asked = device.run(1_000, |asked| match asked.body[1] {
            16 => vec![(2, asked.refused(code))],
            _ => good(asked),
        });
        let EventCounters { refused, accepted, unknown, .. } = device.events();
        assert_eq!((starts(&asked), [refused, accepted, unknown]), (1, counted), "{code}");
        assert_eq!(device.peer(3).counters.refusal, code);
    }
    // Busy: sent again, in its time.
    let mut device = Device::new(axis);
    device.set("WordOutputReg[1]", 1_000);
    device.run(500, good);
    device.bit(0, true);
    let mut left = 1;
    let asked = device.run(1_000, |asked| match asked.body[1] {
        16 if left > 0 => {
            left -= 1;
            vec![(2, asked.refused(6))]
        }
        _ => good(asked),
    });
    assert_eq!((starts(&asked), device.events().done), (2, 1));
}

#[test]
fn a_stop_goes_first_and_survives_the_loss_of_its_connection() {
    let mut device = Device::new(axis);
    device.run(500, good);
    device.bit(1, true);
    let is_stop = |asked: &Asked| asked.body[1] == 16 && asked.address() == 0x30;
    let asked = device.run(60, |asked| if is_stop(asked) { vec![] } else { good(asked) });
    assert!(asked.iter().any(is_stop));
    device.lose();
    let asked = device.run(1_000, good);
    assert!(is_stop(&asked[0]), "{:?}", asked[0]);
    assert_eq!(asked.iter().filter(|asked| is_stop(asked)).count(), 1, "it is confirmed");
}

#[test]
fn a_connection_that_is_back_soon_starts_nothing_again_and_an_absence_does() {
    let mut device = Device::new(|cell| {
        let poll = reads(cell, 3, &["WordInputReg[1]"], every(50));
        let start = Triggers { start: true, ..Triggers::NEVER };
        vec![poll, writes(cell, 3, &["WordOutputReg[1]"], start)]
    });
    device.set("WordOutputReg[1]", 1);
    assert_eq!(starts(&device.run(1_000, good)), 1);
    for _ in 0..5 {
        device.lose();
        assert_eq!(starts(&device.run(825, good)), 0, "a lost connection is no start of the device");
    }
    device.rig.reachable.remove(&device.link.0);
    device.lose();
    device.run(3_500, good);
    device.rig.reachable.insert(device.link.0);
    let asked = device.run(6_000, good);
    assert_eq!(starts(&asked), 1, "it was away for longer than 3 s");
    assert_eq!(device.peer(3).counters.starts, 1);
}

#[test]
fn a_value_that_waits_is_written_on_the_next_connection() {
    let mut device = Device::new(|cell| {
        let change = Triggers { change: true, ..Triggers::NEVER };
        vec![writes(cell, 3, &["WordOutputReg[1]"], change)]
    });
    device.set("WordOutputReg[1]", 1);
    device.run(500, good);
    device.set("WordOutputReg[1]", 2);
    let asked = device.run(150, |_| vec![]);
    assert!(!asked.is_empty());
    device.lose();
    let asked = device.run(1_000, good);
    assert_eq!(asked.last().unwrap().body[7..], [0, 2]);
}

#[test]
fn a_device_that_is_gone_leaves_its_registers_to_their_safe_values() {
    let mut device = Device::with(
        |cell| vec![reads(cell, 3, &["WordInputReg[1]"], every(50))],
        |cell| cell.safe("WordInputReg[1]", 9.0),
    );
    device.run(500, good);
    assert_eq!(device.shown("WordInputReg[1]"), 7);
    device.rig.reachable.remove(&device.link.0);
    device.lose();
    device.run(400, good);
    assert_eq!(device.shown("WordInputReg[1]"), 9);
    // The robot's own link is not the device's.
    assert_eq!(device.rig.engine.status(device.rig.now).health(), Health::PortSilent);
    assert_eq!(device.rig.link(LinkId::MODBUS).history.losses, 0);
}

#[test]
fn the_gateway_that_slept_opens_the_connection_again() {
    let mut device = Device::new(axis);
    device.run(500, good);
    device.rig.closed();
    device.rig.now += Duration::from_secs(5);
    device.rig.input(Input::Tick);
    assert!(device.rig.closed().iter().any(|(_, link)| *link == device.link));
    let asked = device.run(2_000, good);
    assert!(device.is_up() && asked.len() > 10, "{}", asked.len());
}

#[test]
fn the_driver_has_no_say_in_whether_the_port_is_there() {
    let mut device = Device::new(axis);
    device.run(100, good);
    device.rig.input(Input::PortDown { port: device.port });
    assert!(device.run(200, good).len() >= 3);
    device.comes(MS(1), adu(9, &[3, 3, 2, 0, 9]));
    device.rig.reachable.remove(&device.link.0);
    device.lose();
    device.rig.input(Input::PortUp { port: device.port });
    assert_eq!(device.run(200, good), []);
}
