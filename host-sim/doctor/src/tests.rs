//! Each finding, from an engine on a virtual clock; and that what works is not blamed.

use proto_core::config::GatewayConfig;
use proto_core::engine::{BusState, Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::link::LinkState;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::state::{LEN, StatePacket};
use recipe_api::documents::{Document, Pieces};
use recipe_config::file::{self, Text};

use super::*;

mod any;
mod commands;
mod given;
mod pieces;

const LINE: PortId = PortId(0);

struct Bench {
    config: Box<GatewayConfig>,
    engine: Box<Engine>,
    record: PortRecord,
    links: Vec<LinkFacts>,
    looked: Option<States>,
    now: Instant,
    started: Instant,
    noted: Instant,
}

impl Bench {
    fn example(name: &str) -> Self {
        Self::new(&std::fs::read_to_string(recipe_test_kit::example(name)).unwrap())
    }

    #[track_caller]
    fn new(toml: &str) -> Self {
        let config = file::parse_gateway(Text { name: "test.toml", toml }, &[]).unwrap();
        let engine = Box::new(Engine::new(&*config).unwrap());
        let started = Instant::from_micros(1_000_000);
        let mut bench = Self {
            config,
            engine,
            record: PortRecord::new(LINE),
            links: Vec::new(),
            looked: None,
            now: started,
            started,
            noted: started,
        };
        bench.input(Input::PortUp { port: LINE });
        bench
    }

    /// Reports an input; returns the texts that were sent to the command port, and the requests to the line.
    fn input(&mut self, input: Input<'_>) -> Vec<Vec<u8>> {
        let mut requests = Vec::new();
        self.engine.handle(self.now, input);
        let mut buf = [0; OUTPUT_BUFFER];
        let mut sent = Vec::new();
        loop {
            match self.engine.poll_output(self.now, &mut buf) {
                Output::Sleep { .. } => break,
                Output::PortSend { port, bytes } => {
                    requests.push(bytes.to_vec());
                    sent.push(Input::PortSent { port });
                }
                Output::LinkSend { link, .. } => sent.push(Input::LinkSent { link }),
                _ => {}
            }
        }
        for input in sent {
            requests.extend(self.input(input));
        }
        requests
    }

    /// Lets time pass; the engine is called each millisecond.
    fn pass(&mut self, ms: u64) -> Vec<Vec<u8>> {
        let mut requests = Vec::new();
        for _ in 0..ms {
            self.now += Duration::from_millis(1);
            requests.extend(self.input(Input::Tick));
            if self.now.saturating_since(self.noted) >= Duration::from_millis(1000) {
                self.noted = self.now;
                let counters = self.engine.status(self.now).ports().next().map(|port| *port.counters);
                self.record.note(self.now, &counters.unwrap());
            }
        }
        requests
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.record.heard(bytes);
        self.input(Input::PortBytes { port: LINE, bytes });
    }

    /// The device sends these every 20 ms for 7 s.
    fn streams(&mut self, bytes: &[u8]) {
        for _ in 0..350 {
            self.bytes(bytes);
            self.pass(20);
        }
    }

    fn frame(&mut self, id: CanId, data: &[u8]) {
        let frame = CanFrame::new(id, data).unwrap();
        self.record.frame(&frame);
        self.input(Input::PortCan { port: LINE, frame });
    }

    fn up(&mut self, link: LinkId) {
        self.input(Input::LinkUp { link });
    }

    fn states(&mut self, change: impl FnOnce(&mut StatePacket)) {
        let mut packet = StatePacket::parse(&[0; LEN]).unwrap();
        (packet.operation_mode, packet.robot_state, packet.safety_state) = (2, 6, 5);
        change(&mut packet);
        self.input(Input::LinkBytes { link: LinkId::STATE, bytes: &packet.to_bytes() });
    }

    /// What is found from the engine, which is the same as from its document.
    #[track_caller]
    fn findings(&self) -> Vec<Finding> {
        let found = |status: State, ports: &[PortRecord]| {
            examine(&Case {
                config: self.config.view(),
                status,
                ports,
                links: &self.links,
                running: self.now.saturating_since(self.started),
                looked: self.looked,
            })
        };
        let status = self.engine.status(self.now);
        let mut text = String::new();
        Pieces::of(Document::Status).write_all(status, &mut text).unwrap();
        let document: StatusDocument = serde_json::from_str(&text).unwrap();
        let up_for = |name: &str| {
            let link = status.links().find(|link| link.name == name);
            match link.map(|link| link.state) {
                Some(LinkState::Up { since }) => self.now.saturating_since(since),
                _ => Duration::ZERO,
            }
        };
        let read = document.state(&self.config, up_for).unwrap();
        let records = std::slice::from_ref(&self.record);
        // Without a record of bytes the newest rejection counts.
        for ports in [&[], records] {
            assert_eq!(found(read.clone(), ports), found(status.into(), ports), "{text}");
        }
        found(status.into(), records)
    }

    /// The findings about ports.
    fn of_ports(&self) -> Vec<Finding> {
        let mut findings = self.findings();
        findings.retain(|finding| matches!(finding.place, FindingPlace::Port(_)));
        findings
    }

    /// The port has this one finding, with these words.
    #[track_caller]
    fn says(&self, cause: Cause, words: &[&str]) {
        let findings = self.of_ports();
        let [finding] = &findings[..] else { panic!("{findings:#?}") };
        has(finding, cause, words);
    }

    /// A link or the controller has this finding.
    #[track_caller]
    fn says_also(&self, cause: Cause, words: &[&str]) {
        let findings = self.findings();
        let finding = findings.iter().find(|finding| finding.cause == cause);
        has(finding.unwrap_or_else(|| panic!("{findings:#?}")), cause, words);
    }
}

#[track_caller]
fn has(finding: &Finding, cause: Cause, words: &[&str]) {
    let text = finding.to_string();
    assert_eq!(finding.cause, cause, "{text}");
    for word in words {
        assert!(text.contains(word), "{word:?} is not in: {text}");
    }
}

/// A frame of the force sensor with these bytes around six floats.
fn force(head: &[u8], tail: &[u8], float: impl Fn(f32) -> [u8; 4]) -> Vec<u8> {
    let mut frame = head.to_vec();
    for value in [1.25_f32, -0.5, 12.75, 0.031, -2.5, 100.0] {
        frame.extend(float(value));
    }
    frame.extend(tail);
    frame
}

const HEAD: [u8; 2] = [0x48, 0xAA];
const TAIL: [u8; 2] = [0x0D, 0x0A];

#[test]
fn a_sensor_that_works_is_not_blamed() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&force(&HEAD, &TAIL, f32::to_le_bytes));
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn no_bytes() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.pass(2_000);
    assert_eq!(bench.of_ports(), [], "too early");
    bench.pass(4_000);
    bench.says(Cause::NoBytes, &["0 bytes in 6 s", "begin with 48 AA", "power"]);
    bench.record.device = "serial:/dev/ttyUSB0".into();
    bench.says(Cause::NoBytes, &["at serial:/dev/ttyUSB0"]);
}

#[test]
fn garbage() {
    let mut bench = Bench::example("force-sensor.toml");
    let mut seed = 7_u32;
    for _ in 0..350 {
        let noise: Vec<u8> = (0..28)
            .map(|_| {
                seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (seed >> 24) as u8
            })
            .filter(|byte| *byte != 0xAA)
            .collect();
        bench.bytes(&noise);
        bench.pass(20);
    }
    bench.says(
        Cause::NoHead,
        &["0 frames", "the head 48 AA", "baud rate or parity", "460800 baud, no parity"],
    );
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&[0x00, 0xFF, 0x80, 0x00, 0xF8, 0x00]);
    bench.says(Cause::NoHead, &["the baud rate is wrong"]);
}

#[test]
fn a_swapped_head() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&force(&[0xAA, 0x48], &TAIL, f32::to_le_bytes));
    bench.says(Cause::HeadSwapped, &["first seen AA 48; expected the head 48 AA", "head = [0xAA, 0x48]"]);
}

#[test]
fn another_head() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&force(&[0x55, 0xA5], &TAIL, f32::to_le_bytes));
    bench.says(Cause::HeadDiffers, &["frames begin with 55 A5"]);
}

#[test]
fn a_wrong_tail() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&force(&HEAD, &[0x0A, 0x0D], f32::to_le_bytes));
    bench.says(Cause::TailDiffers, &["end with 0A 0D; expected the tail 0D 0A"]);
}

#[test]
fn a_byte_more_or_less() {
    for (len, word) in [(29, "1 byte longer"), (27, "1 byte shorter"), (30, "2 bytes longer")] {
        let mut frame = force(&HEAD, &[], f32::to_le_bytes);
        frame.resize(len - 2, 7);
        frame.extend(TAIL);
        let mut bench = Bench::example("force-sensor.toml");
        bench.streams(&frame);
        bench.says(Cause::LengthDiffers, &[&format!("frames of {len} bytes"), word, "frames of 28 bytes"]);
    }
}

#[test]
fn a_frame_that_breaks_off() {
    let mut bench = Bench::new(
        "controller = { address = \"127.0.0.1\" }
        [[recipe]]
        name = \"r\"
        kind = \"stream\"
        mode = \"user\"
        input = { head = [255, 254], fields = [{ name = \"a\", type = \"int\", to = \"WordInputReg[1]\" }] , tail = [238] }
        [[port]]
        name = \"line\"
        bus = \"rs485\"
        recipe = \"r\"",
    );
    bench.bytes(&[255, 254, 1, 0]);
    bench.pass(500);
    bench.says(Cause::BrokenOff, &["after the head FF FE came 4 bytes, then silence", "idle_gap_ms"]);
}

#[test]
fn the_other_byte_order() {
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&force(&HEAD, &TAIL, f32::to_be_bytes));
    bench.says(Cause::ByteOrder, &["little-endian floats", "The device sends big-endian"]);
}

#[test]
fn values_that_are_tiny_are_no_other_byte_order() {
    let mut bench = Bench::example("force-sensor.toml");
    // Noise around zero: some of it makes sense the other way round by chance.
    let tiny = |value: f32| (value * 1e-9).to_le_bytes();
    bench.streams(&force(&HEAD, &TAIL, tiny));
    assert_eq!(bench.of_ports(), []);
    let mut bench = Bench::example("force-sensor.toml");
    let mut mixed = force(&HEAD, &TAIL, tiny);
    mixed[2..6].copy_from_slice(&1.0_f32.to_be_bytes());
    bench.streams(&mixed);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn damaged_frames_among_right_ones() {
    let right = force(&HEAD, &TAIL, f32::to_le_bytes);
    let damaged = force(&HEAD, &[0x0D, 0x8A], f32::to_le_bytes);
    let mut bench = Bench::example("force-sensor.toml");
    bench.streams(&[right.clone(), damaged.clone()].concat());
    bench.says(Cause::Noise, &["right frames and ", "damaged ones", "termination"]);
    // One in forty happens.
    let mut bench = Bench::example("force-sensor.toml");
    for _ in 0..7 {
        bench.bytes(&damaged);
        for _ in 0..40 {
            bench.bytes(&right);
            bench.pass(20);
        }
    }
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn seven_data_bits() {
    let mut bench = Bench::example("force-sensor.toml");
    let odd = |byte: &u8| byte & 0x7F | if (byte & 0x7F).count_ones().is_multiple_of(2) { 0x80 } else { 0 };
    let frame: Vec<u8> = force(&HEAD, &TAIL, f32::to_le_bytes).iter().map(odd).collect();
    bench.streams(&frame);
    bench.says(Cause::SevenBits, &["8 data bits"]);
}

fn with_checksum(kind: &str) -> String {
    format!(
        "controller = {{ address = \"127.0.0.1\" }}
        [[recipe]]
        name = \"r\"
        kind = \"stream\"
        mode = \"user\"
        [recipe.input]
        head = [0x20, 0x4E]
        checksum = {{ kind = \"{kind}\" }}
        fields = [
            {{ name = \"number\", type = \"byte\", equals = 9 }},
            {{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }},
            {{ name = \"b\", type = \"word\", to = \"WordInputReg[2]\" }},
        ]
        [[port]]
        name = \"line\"
        bus = \"rs485\"
        recipe = \"r\"
        timeout_ms = 100"
    )
}

/// A frame of a device with a CRC as Modbus has it.
fn with_crc(bytes: &[u8]) -> Vec<u8> {
    let sum = proto_core::device::Algorithm::CRC16_MODBUS.of([bytes]) as u16;
    [bytes, &sum.to_le_bytes()].concat()
}

#[test]
fn another_checksum() {
    let frame = with_crc(&[0x20, 0x4E, 9, 1, 2, 3, 4]);
    let mut bench = Bench::new(&with_checksum("crc16-xmodem"));
    bench.streams(&frame);
    bench.says(Cause::ChecksumKind, &["right as crc16-modbus, low byte first"]);
    let mut bench = Bench::new(&with_checksum("crc16-modbus"));
    bench.streams(&frame);
    assert_eq!(bench.of_ports(), []);
    let mut swapped = frame.clone();
    swapped.swap(7, 8);
    let mut bench = Bench::new(&with_checksum("crc16-modbus"));
    bench.streams(&swapped);
    bench.says(Cause::ChecksumKind, &["crc16-modbus, high byte first"]);
    let mut bench = Bench::new(&with_checksum("crc16-modbus"));
    bench.streams(
        &with_crc(&[0x20, 0x4E, 9, 1, 2, 3, 4])
            .iter()
            .map(|b| if *b == 3 { 2 } else { *b })
            .collect::<Vec<_>>(),
    );
    bench.says(Cause::ChecksumWrong, &["wrong checksum"]);
}

#[test]
fn another_device() {
    let mut bench = Bench::new(&with_checksum("crc16-modbus"));
    bench.streams(&with_crc(&[0x20, 0x4E, 8, 1, 2, 3, 4]));
    bench.says(Cause::OtherDevice, &["with 08 in byte 3; expected 09 there", "address"]);
}

/// Forces of a sensor as hundredths in a word, with an offset.
const FORCES: &str = "controller = { address = \"127.0.0.1\" }
    [[recipe]]
    name = \"force\"
    kind = \"stream\"
    mode = \"user\"
    [recipe.input]
    head = [0x48, 0xAA]
    tail = [0x0D, 0x0A]
    fields = [
        { name = \"Fx\", type = \"float\", to = \"WordInputReg[1]\", scale = 100, offset = 32768 },
        { name = \"Fy\", type = \"float\", to = \"WordInputReg[2]\" },
    ]
    [[port]]
    name = \"line\"
    bus = \"rs485\"
    recipe = \"force\"";

#[test]
fn a_value_that_does_not_fit_is_named() {
    let frame = |x: f32, y: f32| [&HEAD[..], &x.to_le_bytes(), &y.to_le_bytes(), &TAIL].concat();
    let says = |toml: &str, frame: &[u8], words: &[&str]| {
        let mut bench = Bench::new(toml);
        bench.streams(frame);
        bench.says(Cause::BadValue, words);
        // A board that was not heard has kept the beginning of the frame.
        bench.record = PortRecord::new(LINE);
        bench.says(Cause::BadValue, words);
    };
    let range = "field 1, for WordInputReg[1], is 400; expected -327.68..=327.67 there";
    let command = "host-sim decode FILE --recipe force --part input 48 AA 00 00 C8 43 00 00 80 3F 0D 0A.";
    says(FORCES, &frame(400.0, 1.0), &[range, command]);
    let not_a_number = "field 2, for WordInputReg[2], is NaN; expected a finite number there";
    says(FORCES, &frame(1.0, f32::NAN), &[not_a_number]);
    // The same as the frame of a device.
    let device = FORCES.replace("fields = [", "checksum = { kind = \"sum8\" }\nfields = [");
    let mut summed = frame(400.0, 1.0);
    let sum = summed[..10].iter().fold(0, |sum: u8, byte| sum.wrapping_add(*byte));
    summed.insert(10, sum);
    let command = format!("--part input {}.", HexBytes(&summed));
    says(&device, &summed, &[range, &command]);
}

const MASTER: &str = "controller = { address = \"127.0.0.1\" }
    [[recipe]]
    name = \"r\"
    kind = \"modbus-rtu\"
    [[recipe.exchange]]
    slave = 9
    function = \"read-holding-registers\"
    address = 1
    every_ms = 100
    read = [{ name = \"a\", type = \"word\", to = \"WordInputReg[1]\" }]
    [[port]]
    name = \"line\"
    bus = \"modbus-rtu\"
    recipe = \"r\"
    timeout_ms = 1000";

/// What a slave answers to a request, if it answers.
fn slave(answer: impl Fn(&[u8]) -> Vec<u8>) -> Bench {
    let mut bench = Bench::new(MASTER);
    for _ in 0..7_000 {
        for request in bench.pass(1) {
            bench.pass(5);
            bench.bytes(&answer(&request));
        }
    }
    bench
}

#[test]
fn slaves_that_do_not_answer_as_asked() {
    let works = slave(|_| with_crc(&[9, 3, 2, 0, 7]));
    assert_eq!(works.of_ports(), []);
    slave(|_| Vec::new()).says(Cause::PeerSilent, &["slave 9 asked", "no byte of it", "power"]);
    slave(|_| with_crc(&[8, 3, 2, 0, 7])).says(Cause::PeerOther, &["a right frame of slave 8", "slave = 8"]);
    slave(<[u8]>::to_vec).says(Cause::Echo, &["the request itself is heard", "echo = true"]);
    slave(|_| with_crc(&[9, 0x83, 2])).says(Cause::PeerRefuses, &["illegal data address", "code 2"]);
    let asked = std::cell::Cell::new(0);
    let unplugged = |_: &[u8]| {
        asked.set(asked.get() + 1);
        if asked.get() < 30 { with_crc(&[9, 3, 2, 0, 7]) } else { Vec::new() }
    };
    slave(unplugged).says(Cause::PeerSilent, &["29 good replies; it has answered before", "power"]);
    slave(|_| vec![1, 2, 3, 4]).says(Cause::PeerSilent, &["heard: 01 02 03 04", "baud rate"]);
}

#[test]
fn can_ids_lengths_and_the_bus() {
    let standard = CanId::Standard;
    let mut bench = Bench::example("can-user.toml");
    bench.pass(4_000);
    bench.says(Cause::NoBytes, &["0 frames in 4 s", "id 0x001", "500000 bit/s"]);
    for _ in 0..312 {
        bench.frame(standard(0x181), &[1, 2, 3]);
        bench.pass(10);
    }
    bench.says(Cause::ForeignIds, &["id 0x181 seen 312 times; expected id 0x001"]);
    let mut bench = Bench::example("can-user.toml");
    bench.frame(CanId::Extended(1), &[1, 2, 3]);
    bench.says(Cause::IdKind, &["id 0x00000001 (extended) seen 1 times", "11 bit"]);
    let mut bench = Bench::example("can-user.toml");
    bench.frame(standard(1), &[1, 2]);
    bench.says(Cause::CanLength, &["id 0x001 with 2 bytes; expected 3 bytes"]);
    let mut bench = Bench::example("can-user.toml");
    bench.frame(standard(1), &[1, 2, 3]);
    bench.frame(standard(0x700), &[]);
    assert_eq!(bench.of_ports(), [], "a bus has other nodes");
    bench.input(Input::PortBus { port: LINE, state: BusState::BusOff });
    bench.says(Cause::BusOff, &["bus-off", "120 ohm"]);
    bench.input(Input::PortBus { port: LINE, state: BusState::Passive });
    bench.says(Cause::BusErrors, &["error-passive"]);
}

#[test]
fn a_device_that_is_gone() {
    let mut bench = Bench::example("can-user.toml");
    bench.input(Input::PortDown { port: LINE });
    bench.says(Cause::DeviceGone, &["is not there"]);
}

#[test]
fn links_that_are_not_reached() {
    for (reach, cause, words) in [
        (Some(Reach::Refused), Cause::Refused, "refuses the connection"),
        (Some(Reach::NoAnswer), Cause::Unreachable, "no answer from 127.0.0.1 port 502"),
        (Some(Reach::NoSuchHost), Cause::NoSuchHost, "the name 127.0.0.1 is not known"),
        (Some(Reach::Failed("no route to host".into())), Cause::Unreachable, "no route to host"),
    ] {
        let mut bench = Bench::example("rs485-user.toml");
        bench.pass(3_000);
        bench.links = vec![LinkFacts { link: LinkId::MODBUS, reach, strangers: 0 }];
        bench.says_also(cause, &[words]);
    }
    let mut bench = Bench::example("rs485-user.toml");
    bench.up(LinkId::MODBUS);
    bench.pass(100);
    assert!(bench.findings().iter().all(|finding| finding.place != FindingPlace::Link("modbus".into())));
}

#[test]
fn links_that_are_silent_or_speak_something_else() {
    let mut bench = Bench::example("rs485-system.toml");
    bench.pass(100);
    bench.up(LinkId::STATE);
    bench.pass(1_900);
    bench.says_also(Cause::LinkSilent, &["0 packets", "ten packets a second"]);
    let mut bench = Bench::example("udp-server.toml");
    bench.pass(10);
    bench.up(LinkId::RECIPE_UDP);
    for value in 0..120 {
        bench.bytes(&[255, 255, value, 238, 238]);
        bench.pass(20);
    }
    bench.says_also(Cause::OneWay, &["sent, 0 received at 127.0.0.1 port 2011 (UDP)", "Another UDP port"]);
}

#[test]
fn a_finding_begins_and_ends_once() {
    let mut watch = Watch::new();
    let mut bench = Bench::example("force-sensor.toml");
    bench.pass(6_000);
    let findings = bench.of_ports();
    let at = |s: u64| Instant::from_micros(s * 1_000_000);
    assert_eq!(watch.update(at(1), &findings), [], "it may be gone at once");
    assert_eq!(watch.update(at(2), &findings), [Change::Begins(findings[0].clone())]);
    assert_eq!(watch.update(at(3), &findings), []);
    assert_eq!(watch.update(at(7), &[]), []);
    let end = Change::Ends { place: findings[0].place.clone(), cause: Cause::NoBytes };
    assert_eq!(watch.update(at(8), &[]), [end]);
    assert_eq!(watch.update(at(9), &findings), []);
    assert_eq!(watch.update(at(10), &findings), [], "not again within a minute");
    // After a long time it is told again, once it was there twice.
    let mut watch = Watch::new();
    (1..=100).for_each(|s| drop(watch.update(at(s), &findings)));
    assert_eq!(watch.update(at(105), &[]).len(), 1);
    assert_eq!(watch.update(at(106), &findings), [], "it may be gone at once");
    assert_eq!(watch.update(at(107), &findings).len(), 1);
}

#[test]
fn every_cause_has_a_name_of_its_own() {
    let mut names: Vec<_> = Cause::ALL.iter().map(|cause| cause.name()).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), Cause::ALL.len());
    let page = std::fs::read_to_string(recipe_test_kit::repository().join("docs/trouble.md")).unwrap();
    for name in names {
        assert!(page.contains(&format!("| `{name}` |")), "docs/trouble.md does not know {name}");
    }
}
