//! Corrupted frames of a device, by the hundred thousand: how many of each checksum's are taken for
//! frames, beside what the theory says.
//!
//!     cargo test --release -p proto-core --test engine_corruption -- --ignored --nocapture
//!
//! sends ten million for each checksum and prints the table of docs/performance.md.

use proto_core::config::*;
use proto_core::device::{Algorithm, Encoding};
use proto_core::engine::{Engine, Input, OUTPUT_BUFFER, Output, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType::Word;

const PORT: PortId = PortId(0);
const VARIABLES: [&str; 4] = ["WordInputReg[1]", "WordInputReg[2]", "WordInputReg[3]", "WordInputReg[4]"];
type Payload = [u8; 8];

/// What happens to a frame on its way.
const CORRUPTIONS: [Corruption; 4] =
    [Corruption::Flips, Corruption::Burst, Corruption::Shift, Corruption::Random];

#[derive(Clone, Copy)]
enum Corruption {
    /// One to eight bits change.
    Flips,
    /// Up to 32 neighbouring bits change, the first and the last of them for certain.
    Burst,
    /// One to three bytes are lost or come in, and the next frame follows at once.
    Shift,
    /// Every byte is a random one.
    Random,
}

/// splitmix64
struct Dice(u64);

impl Dice {
    fn number(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ mixed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ mixed >> 31
    }

    fn below(&mut self, count: usize) -> usize {
        (self.number() % count as u64) as usize
    }

    fn byte(&mut self) -> u8 {
        self.number() as u8
    }
}

/// A gateway with one port, whose frames are four words and the checksum: nothing else tells where a
/// frame begins.
struct Line {
    engine: Box<Engine<1, 0, 16>>,
    now: Instant,
    variables: [SysVar; 4],
    accepted: u32,
}

impl Line {
    fn new(checksum: &str) -> Self {
        let word = |var| InputField::variable(Encoding::from(Word).big_endian(), var);
        let [a, b, c, d] = VARIABLES;
        let fields = [word(a), word(b), word(c), word(d), InputField::checksum(checksum)];
        let config: GatewayConfig<1, 1, 5, 0, 0> = GatewayConfig::builder()
            .controller("192.168.12.138")
            .recipe(Recipe::user("device").stream_input(&[], &[], &fields))
            .port(Port::rs485("line", "device"))
            .build()
            .unwrap();
        let variables = VARIABLES.map(|name| SysVar::parse(name).unwrap());
        let engine = Box::new(Engine::new(&config).unwrap());
        let mut line = Self { engine, now: Instant::from_millis(1_000), variables, accepted: 0 };
        line.handle(Input::PortUp { port: PORT });
        line
    }

    fn handle(&mut self, input: Input<'_>) {
        self.engine.handle(self.now, input);
        let mut out = [0; OUTPUT_BUFFER];
        while !matches!(self.engine.poll_output(self.now, &mut out), Output::Sleep { .. }) {}
    }

    /// The payload of the frame that was accepted, at most one.
    fn receive(&mut self, bytes: &[u8]) -> Option<Payload> {
        self.engine.handle(self.now, Input::PortBytes { port: PORT, bytes });
        let accepted = self.engine.port_counters(PORT).unwrap().frames_in;
        let more = accepted.wrapping_sub(self.accepted);
        self.accepted = accepted;
        assert!(more <= 1, "{more} frames in {} bytes", bytes.len());
        (more == 1).then(|| {
            let mut payload = Payload::default();
            for (bytes, &var) in payload.chunks_exact_mut(2).zip(&self.variables) {
                bytes.copy_from_slice(&(self.engine.image().value(var).as_f64() as u16).to_be_bytes());
            }
            payload
        })
    }

    /// So long that a partial frame is discarded.
    fn silence(&mut self) {
        self.now += Duration::from_millis(51);
        self.handle(Input::Tick);
    }
}

fn frame(algorithm: &Algorithm, payload: Payload) -> Vec<u8> {
    let sum = algorithm.of([payload.as_slice()]).to_be_bytes();
    let mut sum = sum[4 - algorithm.len()..].to_vec();
    if algorithm.order() == proto_core::device::ByteOrder::Little {
        sum.reverse();
    }
    [&payload[..], &sum].concat()
}

/// How many of `count` corrupted frames were taken although no such frame was sent.
fn taken(name: &str, corruption: Corruption, count: u64) -> u64 {
    let algorithm = Algorithm::named(name).unwrap();
    let (mut line, mut dice, mut taken) = (Line::new(name), Dice(count ^ corruption as u64), 0);
    let good = [1, 2, 3, 4, 5, 6, 7, 8];
    assert_eq!(line.receive(&frame(&algorithm, good)), Some(good), "a right frame is taken");
    for _ in 0..count {
        let sent = [dice.number().to_be_bytes(), dice.number().to_be_bytes()];
        let mut bytes = frame(&algorithm, sent[0]);
        let bits = bytes.len() * 8;
        let flip = |bytes: &mut [u8], bit: usize| bytes[bit / 8] ^= 0x80 >> (bit % 8);
        match corruption {
            Corruption::Flips => (0..=dice.below(8)).for_each(|_| flip(&mut bytes, dice.below(bits))),
            Corruption::Burst => {
                let len = 2 + dice.below(31);
                let start = dice.below(bits - len + 1);
                let inside = dice.number();
                for bit in 0..len {
                    if bit == 0 || bit == len - 1 || inside >> bit & 1 == 1 {
                        flip(&mut bytes, start + bit);
                    }
                }
            }
            Corruption::Shift => {
                let is_lost = dice.below(2) == 0;
                for _ in 0..=dice.below(3) {
                    if is_lost {
                        bytes.remove(dice.below(bytes.len()));
                    } else {
                        bytes.insert(dice.below(bytes.len() + 1), dice.byte());
                    }
                }
                bytes.extend(frame(&algorithm, sent[1]));
            }
            Corruption::Random => bytes.iter_mut().for_each(|byte| *byte = dice.byte()),
        }
        // Byte by byte where there may be two frames.
        let piece = if matches!(corruption, Corruption::Shift) { 1 } else { bytes.len() };
        for piece in bytes.chunks(piece) {
            if line.receive(piece).is_some_and(|payload| !sent.contains(&payload)) {
                taken += 1;
            }
        }
        line.silence();
    }
    taken
}

fn bits(name: &str) -> i32 {
    Algorithm::named(name).unwrap().len() as i32 * 8
}

/// What a checksum of so many bits misses when it is as good as a random number.
fn expected(name: &str, count: u64) -> f64 {
    count as f64 * 0.5_f64.powi(bits(name))
}

/// 200 000 frames of all kinds together.
#[test]
fn corrupted_frames_are_taken_no_more_often_than_the_theory_says() {
    let names = ["crc8", "crc16-modbus", "crc16-ccitt-false", "crc32", "sum8"];
    for name in names {
        for corruption in CORRUPTIONS {
            let count = 10_000;
            let taken = taken(name, corruption, count);
            let is_crc = name.starts_with("crc");
            // Between two frames that were shifted, one could begin at each byte.
            let places = if matches!(corruption, Corruption::Shift) { 15.0 } else { 1.0 };
            let mean = expected(name, count) * places;
            let most = mean + 6.0 * mean.sqrt() + 1.0;
            let is_random = matches!(corruption, Corruption::Random);
            if is_crc || is_random {
                assert!((taken as f64) <= most, "{name}: {taken} taken, {mean} expected");
            }
            // The test itself works: what 8 bits must miss by chance is missed.
            if is_random && bits(name) == 8 {
                assert!(taken as f64 >= mean - 6.0 * mean.sqrt(), "{name}: {taken} of {mean}");
            }
        }
    }
}

/// The table.
#[test]
#[ignore = "ten million frames for each checksum; see the module's head"]
fn ten_million_corrupted_frames_of_each_checksum() {
    const COUNT: u64 = 2_500_000;
    println!("| checksum | 1 to 8 bits | burst | bytes lost or inserted | random bytes | 2^-n of each |");
    println!("|---|---|---|---|---|---|");
    let names =
        ["crc32", "crc16-modbus", "crc16-ccitt-false", "sum16", "crc8", "crc8-maxim", "sum8", "lrc", "xor8"];
    let rows: Vec<_> = std::thread::scope(|scope| {
        let all = names.map(|name| {
            let row = move || (name, CORRUPTIONS.map(|corruption| taken(name, corruption, COUNT)));
            scope.spawn(row)
        });
        all.into_iter().map(|row| row.join().unwrap()).collect()
    });
    for (name, [flips, burst, shift, random]) in rows {
        let theory = expected(name, COUNT);
        println!("| `{name}` | {flips} | {burst} | {shift} | {random} | {theory:.4} |");
        assert!((random as f64 - theory).abs() <= 6.0 * theory.sqrt() + 1.0, "{name}: {random} of {theory}");
    }
}
