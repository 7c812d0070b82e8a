//! Bytes one by one, as a UART brings them, are what they are in chunks: a byte that completes nothing takes the fast
//! path, and nobody can tell whether one did.
//!
//! Three engines hear the same line. `Swift` hears each byte. `Plain` does too, but before each one it is told something
//! that it ignores, after which nothing takes the fast path. `Chunked` hears at once what came at once, cut where a
//! frame ended. Whatever they hand over, and when, is compared; and where frames end is what D19 says, read literally.

mod reference;
mod rig;

use proto_core::config::*;
use proto_core::device::Encoding;
use proto_core::engine::{Engine, Handled, Input, LinkId, OUTPUT_BUFFER, Output, PortCounters, PortId};
use proto_core::recipe::StreamLayout;
use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::sysvar::{Direction, VarRange};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;
use reference::PlainDeframer;
use rig::{Cell, MS, var, with_crc};

/// Streams with head and tail, with floats, without a tail, without a head; a device with a checksum; a bus.
const STREAMS: [(&[u8], &[u8], &str); 4] = [
    (&[255, 255], &[238, 238], "WordInputReg[1..4]"),
    (&[0x48, 0xAA], &[0x0D, 0x0A], "ForceEnd[1..6]"),
    (&[7], &[], "WordInputReg[5..6]"),
    (&[], &[9, 9, 7], "WordInputReg[7..8]"),
];
/// When silence ends a frame of them: before the next cycle, and behind it.
const GAPS: [Duration; STREAMS.len()] = [
    Duration::from_millis(5),
    Duration::from_millis(50),
    Duration::from_millis(50),
    Duration::from_millis(12),
];
const DEVICE: PortId = PortId(4);
const BUS: PortId = PortId(5);
/// Of no configuration: what is reported of it is ignored, but the engine looks at all links.
const NOTHING: Input<'_> = Input::LinkDown { link: LinkId(99) };

type Gateway = Engine<8, 2, 64, 65_536, 0>;

fn cell() -> GatewayConfig {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..6]"], &[]);
    cell.recipe_link(up);
    for ((head, tail, names), gap) in STREAMS.into_iter().zip(GAPS) {
        let fields = cell.system(&[names]);
        let input = cell.part(head, tail, fields);
        let recipe = cell.recipe(Mode::Realtime, Parts::Stream { input, output: None });
        cell.rs485(recipe);
        cell.last_port().timeout = MS(100);
        let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!("a line") };
        line.idle_gap = gap;
    }
    // The last of them is shown what the state stream says.
    let fields = cell.system(&["RobotState[8..13]"]);
    let shown = cell.part(&[255, 255], &[254, 254], fields);
    if let Parts::Stream { output, .. } = &mut cell.last_recipe().parts {
        *output = shown;
    }
    cell.last_port().cycle = MS(20);
    let to = InputBinding::Variable { var: var("WordInputReg[9]"), scale: 1.0, offset: 0.0 };
    let fixed = |value| FieldSpec::Fixed { encoding: Encoding::scalar(ScalarType::Byte), value };
    let word = Encoding::scalar(ScalarType::Word);
    let word = FieldSpec::DeviceInput { encoding: word, overflow: proto_core::device::Overflow::Usual, to };
    let crc = proto_core::device::Algorithm::named("crc16-modbus").unwrap();
    let crc = FieldSpec::Checksum(proto_core::device::Checksum::standard(crc));
    let fields = cell.fields([fixed(9), fixed(3), word, crc]);
    let input = cell.part(&[], &[], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    assert_eq!(cell.rs485(recipe), DEVICE);
    // Before anything else is due.
    let Bus::Rs485(line) = &mut cell.last_port().bus else { panic!("a line") };
    line.idle_gap = MS(6);
    let recipe = cell.can(&[(0x100, &["WordInputReg[13]"]), (0x101, &["WordInputReg[14]"])], &[]);
    assert_eq!(cell.can_port(recipe), BUS);
    cell.0
}

/// splitmix64
struct Dice(u64);

impl Dice {
    fn below(&mut self, count: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ mixed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ mixed >> 31) % count
    }

    fn byte(&mut self) -> u8 {
        self.below(256) as u8
    }

    fn of<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.below(all.len() as u64) as usize]
    }
}

/// An engine, a driver and a controller that does what it is told.
struct Side {
    engine: Box<Gateway>,
    /// What was handed over, and when; beside it, until when the engine slept.
    out: Vec<(Instant, String)>,
    sleeps: Vec<Instant>,
    wake: Instant,
    /// Told before each byte.
    disturbed: bool,
    /// What became of outputs and is reported later; if it is not reported at once.
    later: Option<Vec<Report>>,
}

/// What became of an output.
#[derive(Clone, Copy)]
enum Report {
    Up(LinkId),
    Taken(LinkId),
    Answered([u8; 12]),
    Left(PortId),
}

impl Report {
    fn input(&self) -> Input<'_> {
        match *self {
            Self::Up(link) => Input::LinkUp { link },
            Self::Taken(link) => Input::LinkSent { link },
            Self::Answered(ref answer) => Input::LinkBytes { link: LinkId::MODBUS, bytes: answer },
            Self::Left(port) => Input::PortSent { port },
        }
    }
}

impl Side {
    fn new(config: &GatewayConfig, disturbed: bool, Habits { listens, late }: Habits, now: Instant) -> Self {
        let engine = Box::new(Gateway::new(config).unwrap());
        let later = late.then(Vec::new);
        let mut side = Self { engine, out: Vec::new(), sleeps: Vec::new(), wake: now, disturbed, later };
        side.engine.tap().listen(listens);
        side.call(now, Input::Tick);
        for port in 0..6 {
            side.call(now, Input::PortUp { port: PortId(port) });
        }
        while side.report(now, 0) {}
        side
    }

    fn call(&mut self, now: Instant, input: Input<'_>) {
        if self.disturbed {
            assert_eq!(self.engine.handle(now, NOTHING), Handled::Poll);
        }
        let (handled, outputs, wake) = (self.engine.handle(now, input), self.out.len(), self.wake);
        self.drain(now);
        if handled == Handled::Asleep {
            assert!(!self.disturbed);
            assert_eq!((self.out.len(), self.wake), (outputs, wake), "{input:?} was said to lead to nothing");
        }
    }

    /// What became of an earlier output is reported; `false` if there is nothing to report.
    fn report(&mut self, now: Instant, nth: usize) -> bool {
        let Some(later) = self.later.as_mut().filter(|later| !later.is_empty()) else { return false };
        let report = later.remove(nth.min(later.len() - 1));
        self.call(now, report.input());
        true
    }

    fn drain(&mut self, now: Instant) {
        let mut buf = [0; OUTPUT_BUFFER];
        loop {
            let output = self.engine.poll_output(now, &mut buf);
            let mut reports = Vec::new();
            match output {
                Output::Sleep { until } => {
                    assert!(until <= self.engine.deadline().max(now));
                    self.wake = until;
                    self.sleeps.push(until);
                    return;
                }
                Output::LinkOpen { link, .. } => reports.push(Report::Up(link)),
                Output::LinkSend { link, bytes } => {
                    reports.push(Report::Taken(link));
                    if let (LinkId::MODBUS, Some(front)) = (link, bytes.first_chunk()) {
                        let mut answer = *front;
                        answer[5] = 6;
                        reports.push(Report::Answered(answer));
                    }
                }
                Output::PortSend { port, .. } => reports.push(Report::Left(port)),
                Output::LinkClose { link } => {
                    let is_gone = |report: &Report| match *report {
                        Report::Up(of) | Report::Taken(of) => of == link,
                        Report::Answered(_) => link == LinkId::MODBUS,
                        Report::Left(_) => false,
                    };
                    self.later.iter_mut().for_each(|later| later.retain(|report| !is_gone(report)));
                }
                _ => {}
            }
            self.out.push((now, format!("{output:?}")));
            match &mut self.later {
                Some(later) => later.extend(reports),
                None => reports.iter().for_each(|report| {
                    self.engine.handle(now, report.input());
                }),
            }
        }
    }

    fn counters(&self) -> Vec<PortCounters> {
        (0..6).map(|port| *self.engine.port_counters(PortId(port)).unwrap()).collect()
    }

    /// All counters but that of bytes: another one means that a frame ended, or that none had begun.
    fn ended(&self, port: PortId) -> PortCounters {
        let mut counters = *self.engine.port_counters(port).unwrap();
        counters.bytes_in = 0;
        counters
    }

    fn tapped(&mut self) -> Vec<String> {
        let mut room = [0; 512];
        let mut all = Vec::new();
        while let Some(record) = self.engine.tap().next(&mut room) {
            all.push(format!("{record:?}"));
        }
        all
    }

    fn health(&self, now: Instant) -> String {
        let status = self.engine.status(now);
        let ports: Vec<_> = status.ports().map(|port| format!("{port:?}")).collect();
        let links: Vec<_> = status.links().map(|link| format!("{link:?}")).collect();
        let variables: Vec<_> = status.variables().map(|variable| format!("{variable:?}")).collect();
        // The newest call's time.
        let called = self.engine.status(Instant::ZERO).at();
        format!("{called:?}\n{ports:#?}\n{links:#?}\n{variables:#?}")
    }
}

/// What drivers do: listen to the ring of frames, or not; report what became of an output at once, or later and not
/// always in the outputs' order.
#[derive(Clone, Copy)]
struct Habits {
    listens: bool,
    late: bool,
}

/// The engines, and the frames of each stream read literally.
struct Line {
    swift: Side,
    plain: Side,
    chunked: Side,
    reference: Vec<PlainDeframer>,
    /// When each of them had its newest byte; its frame is given up after the gap.
    heard: [Instant; STREAMS.len()],
    now: Instant,
    /// The driver was on time, and the devices were there.
    is_reference_right: bool,
}

impl Line {
    fn new(habits: Habits) -> Self {
        let (config, now) = (cell(), Instant::from_millis(5_000));
        let side = |disturbed| Side::new(&config, disturbed, habits, now);
        let rules = Rules { mode: Mode::Realtime, direction: Direction::Input };
        let reference = STREAMS.iter().map(|(head, tail, names)| {
            let fields = VarRange::parse(names).unwrap().iter().map(Field::System);
            PlainDeframer::new(&StreamLayout::new(rules, head, tail, fields, Framing::Bytes).unwrap())
        });
        let reference = reference.collect();
        let (swift, plain, chunked) = (side(false), side(true), side(false));
        let heard = [now; STREAMS.len()];
        Self { swift, plain, chunked, reference, heard, now, is_reference_right: true }
    }

    fn all(&mut self, input: Input<'_>) {
        self.swift.call(self.now, input);
        self.plain.call(self.now, input);
        self.chunked.call(self.now, input);
    }

    /// A driver reports what became of an earlier output.
    fn report(&mut self, nth: usize) {
        for side in [&mut self.swift, &mut self.plain, &mut self.chunked] {
            side.report(self.now, nth);
        }
    }

    /// Bytes that came at once, on the way that each of the engines has.
    fn bytes(&mut self, port: PortId, bytes: &[u8]) {
        let mut piece = Vec::new();
        for &byte in bytes {
            let before = self.swift.ended(port);
            self.swift.call(self.now, Input::PortBytes { port, bytes: &[byte] });
            self.plain.call(self.now, Input::PortBytes { port, bytes: &[byte] });
            piece.push(byte);
            let after = self.swift.ended(port);
            if let Some(line) =
                self.reference.get_mut(usize::from(port.0)).filter(|_| self.is_reference_right)
            {
                let heard = std::mem::replace(&mut self.heard[usize::from(port.0)], self.now);
                if self.now >= heard + GAPS[usize::from(port.0)] {
                    line.silence();
                }
                let found = line.receive(&[byte]).len();
                let rejected = |counters: &PortCounters| counters.frames_in + counters.rejected_not_finite;
                assert_eq!(rejected(&after) - rejected(&before), found as u32, "at {:?}", self.now);
            }
            if after != before {
                self.chunked.call(self.now, Input::PortBytes { port, bytes: &piece });
                piece.clear();
            }
        }
        if !piece.is_empty() {
            self.chunked.call(self.now, Input::PortBytes { port, bytes: &piece });
        }
    }

    /// A packet of the state stream, whole or in pieces that arrive at once.
    fn state(&mut self, packet: &[u8], piece: usize) {
        for bytes in packet.chunks(piece) {
            self.swift.call(self.now, Input::LinkBytes { link: LinkId::STATE, bytes });
            self.plain.call(self.now, Input::LinkBytes { link: LinkId::STATE, bytes });
        }
        self.chunked.call(self.now, Input::LinkBytes { link: LinkId::STATE, bytes: packet });
    }

    fn can(&mut self, dice: &mut Dice) {
        let (id, len) = (dice.of(&[0x100, 0x101, 0x102, 0x7FF]), dice.of(&[0, 2, 2, 2, 8]));
        let frame = match dice.below(6) {
            0 => CanFrame::remote(CanId::Standard(id), len),
            1 => CanFrame::new(CanId::Extended(id.into()), &[7; 8][..len]),
            _ => CanFrame::new(CanId::Standard(id), &[7; 8][..len]),
        };
        for _ in 0..1 + dice.below(4) {
            self.all(Input::PortCan { port: BUS, frame: frame.unwrap() });
        }
    }

    /// Time passes, and a driver that is on time reports each tick.
    fn wait(&mut self, span: Duration) {
        let end = self.now + span;
        while self.swift.wake.min(self.chunked.wake) <= end {
            self.now = self.swift.wake.min(self.chunked.wake).max(self.now);
            self.all(Input::Tick);
        }
        self.now = end;
    }

    fn look(&mut self) {
        assert_eq!(self.swift.out, self.plain.out);
        assert_eq!(self.swift.sleeps, self.plain.sleeps);
        assert_eq!(self.swift.health(self.now), self.plain.health(self.now));
        assert_eq!(self.swift.tapped(), self.plain.tapped());
        assert_eq!(self.swift.out, self.chunked.out);
        assert_eq!(self.swift.counters(), self.chunked.counters());
        assert_eq!(self.swift.engine.image().bytes(), self.chunked.engine.image().bytes());
        self.chunked.tapped();
        for side in [&mut self.swift, &mut self.plain, &mut self.chunked] {
            side.out.clear();
            side.sleeps.clear();
        }
    }
}

/// A packet of the state stream, with values that change.
fn packet(dice: &mut Dice) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    (packet[1448], packet[1449], packet[1451]) = (2, 6, 5);
    for value in packet[368..392].as_chunks_mut::<4>().0 {
        *value = dice.of(&[0.5_f32, -0.25, 1.0, 1.5, f32::NAN, 2.0, 3.0, 4.0]).to_le_bytes();
    }
    packet
}

/// What a device may send: frames, pieces of frames, and noise that looks like them.
fn sent(dice: &mut Dice, port: PortId) -> Vec<u8> {
    let frame = |dice: &mut Dice| match STREAMS.get(usize::from(port.0)) {
        Some((head, tail, names)) => {
            let size = VarRange::parse(names).unwrap().iter().map(|var| var.size()).sum::<usize>();
            let special = dice.below(8) == 0;
            let payload = (0..size).map(|_| if special { 255 } else { dice.of(&[0, 1, 2, 7, 9, 64, 255]) });
            let payload: Vec<u8> = payload.collect();
            [head, &payload[..], tail].concat()
        }
        None => with_crc(&[9, 3, dice.byte(), dice.of(&[0, 3, 9])]),
    };
    let mut bytes = frame(dice);
    match dice.below(8) {
        0 => bytes.truncate(dice.below(bytes.len() as u64 + 1) as usize),
        1 => {
            let at = dice.below(bytes.len() as u64) as usize;
            bytes[at] ^= dice.byte();
        }
        2 => {
            bytes =
                (0..1 + dice.below(40)).map(|_| dice.of(&[255, 255, 238, 0x48, 0xAA, 7, 9, 3, 0])).collect()
        }
        3 => bytes.extend(frame(dice)),
        _ => {}
    }
    bytes
}

fn run(seed: u64, steps: usize) -> u32 {
    let mut dice = Dice(seed);
    let mut line = Line::new(Habits { listens: seed.is_multiple_of(4), late: seed % 2 == 1 });
    for _ in 0..steps {
        let port = PortId(dice.below(5) as u8);
        for _ in 0..dice.below(6) {
            line.report(dice.below(2) as usize);
        }
        match dice.below(24) {
            0 => line.can(&mut dice),
            1 => {
                // The driver was late: what has arrived is reported before the tick that is due.
                line.now += dice.of(&[MS(1), MS(6), MS(40), MS(120), MS(350)]);
                // Whether a gap that nobody reported ended a frame depends on ticks.
                line.is_reference_right = false;
            }
            2 if dice.below(8) == 0 => {
                line.now += MS(700);
                line.is_reference_right = false;
                // What waited meanwhile, and what comes a little later.
                for _ in 0..dice.below(4) {
                    line.can(&mut dice);
                    line.now += dice.of(&[MS(0), MS(20), MS(45)]);
                    line.bytes(port, &sent(&mut dice, port));
                }
            }
            5 => {
                let packet = packet(&mut dice);
                line.state(&packet, dice.of(&[1468, 536, 100, 33, 1]));
            }
            3 => {
                let input = dice.of(&[Input::PortDown { port }, Input::PortUp { port }, Input::Tick]);
                line.all(input);
                line.is_reference_right &= matches!(input, Input::Tick);
            }
            4 => line.wait(dice.of(&[MS(5), MS(60), MS(300)])),
            _ => {
                let bytes = sent(&mut dice, port);
                match dice.below(3) {
                    // At once, or one by one at the line's speed; always on time.
                    0 => line.bytes(port, &bytes),
                    _ => {
                        for byte in bytes {
                            line.bytes(port, &[byte]);
                            line.wait(Duration::from_micros(87));
                        }
                    }
                }
            }
        }
        if dice.below(3) > 0 {
            line.wait(MS(60));
            // Every line was silent for longer than its gap, and the driver said so.
            line.reference.iter_mut().for_each(PlainDeframer::silence);
            line.is_reference_right = true;
        }
        line.look();
    }
    line.swift.counters().iter().map(|counters| counters.frames_in).sum()
}

#[test]
fn nobody_can_tell_on_which_way_a_byte_went() {
    let frames: u32 = (0..24).map(|seed| run(seed, 120)).sum();
    assert!(frames > 1_000, "{frames}");
}

#[test]
#[ignore = "minutes"]
fn nobody_can_tell_on_which_way_a_byte_went_for_long() {
    let frames: u32 = (1_000..3_000).map(|seed| run(seed, 200)).sum();
    assert!(frames > 100_000, "{frames}");
}
