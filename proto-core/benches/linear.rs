//! What finding frames costs against the length of the line, up to 1 MiB, on the worst lines there are
//! (docs/wire/recipes.md section 4). Twice the bytes have to cost twice as much, whatever they are.
//! `-- instructions` counts instead of measuring time, and fails where a byte costs more on a longer
//! line, or more than [`MOST`].

mod instructions;

use std::fmt;
use std::hint::black_box;
use std::process::ExitCode;

use divan::Bencher;
use divan::counter::BytesCount;
use instructions::Work;
use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{Deframer, StreamLayout};
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;

/// Instructions that a byte may cost, at the worst.
const MOST: f64 = 150.0;
/// How much more a byte may cost on the longest line than on a shorter one.
const GROWTH: f64 = 1.02;
const LENGTHS: [u64; 3] = [1 << 14, 1 << 17, 1 << 20];

/// A recipe with bytes of payload, and a line that is made of a pattern.
struct Case {
    name: &'static str,
    head: &'static [u8],
    tail: &'static [u8],
    payload: usize,
    pattern: &'static [u8],
    /// The pattern is cut or filled up with zeros to so many bytes.
    every: usize,
}

const ALMOST: &[u8] = &[255, 255, 255, 255, 255, 255, 255, 254];

const CASES: &[Case] = &[
    // 28-byte frames one behind the other, nothing wrong with them.
    Case {
        name: "good frames",
        head: &[0x48, 0xAA],
        tail: &[0, 0],
        payload: 24,
        pattern: &[0x48, 0xAA],
        every: 28,
    },
    // Every byte begins a frame whose tail is wrong in its last byte.
    Case { name: "all heads", head: &[255; 8], tail: ALMOST, payload: 496, pattern: &[255], every: 1 },
    // Every head breaks in its last byte.
    Case {
        name: "heads that break late",
        head: ALMOST,
        tail: ALMOST,
        payload: 496,
        pattern: &[255],
        every: 1,
    },
    // A head that begins anew in its own middle.
    Case { name: "heads in heads", head: b"ABABABAC", tail: b"C", payload: 64, pattern: b"AB", every: 2 },
    // Every byte may begin a frame.
    Case { name: "no head", head: &[], tail: ALMOST, payload: 496, pattern: &[255], every: 1 },
    // Frames that were cut and begin in one another.
    Case {
        name: "nested frames",
        head: &[255, 255],
        tail: &[238, 238],
        payload: 300,
        pattern: &[255, 255, 1, 2, 3],
        every: 5,
    },
    // Payloads full of tails.
    Case {
        name: "tails in payloads",
        head: &[255],
        tail: &[0, 255],
        payload: 300,
        pattern: &[0, 255, 255],
        every: 3,
    },
];

/// Bytes of a chunk: one by one as from an interrupt, and as from a socket.
const CHUNKS: [usize; 2] = [1, 1460];

impl Case {
    fn layout(&self) -> StreamLayout {
        let rules = Rules { mode: Mode::User, direction: Direction::Input };
        let mut types = vec![ScalarType::Double; self.payload / 8];
        types.resize(self.payload / 8 + self.payload % 8, ScalarType::Byte);
        StreamLayout::new(rules, self.head, self.tail, types.into_iter().map(Field::User), Framing::Bytes)
            .expect("a part that the rules allow")
    }

    fn line(&self, len: usize) -> Vec<u8> {
        let mut pattern = self.pattern.to_vec();
        pattern.resize(self.every, 0);
        let mut line = pattern.repeat(len.div_ceil(self.every));
        line.truncate(len);
        line
    }
}

/// The frames in a line that comes in chunks.
fn receive(layout: &StreamLayout, line: &[u8], chunk: usize) -> usize {
    let mut deframer = Deframer::new();
    let mut frames = 0;
    for mut rest in line.chunks(chunk) {
        while let Some(payload) = deframer.next_frame(layout, &mut rest) {
            black_box(payload);
            frames += 1;
        }
    }
    frames
}

fn count<const CASE: usize, const CHUNK: usize>(len: u64) {
    let case = &CASES[CASE];
    black_box(receive(&case.layout(), &case.line(len as usize), CHUNKS[CHUNK]));
}

macro_rules! works {
    ($($nth:literal)*) => {
        [$(
            Work { name: concat!($nth, " bytewise"), limit: None, run: count::<$nth, 0> },
            Work { name: concat!($nth, " in chunks"), limit: None, run: count::<$nth, 1> },
        )*]
    };
}

fn main() -> ExitCode {
    let works = works! { 0 1 2 3 4 5 6 };
    assert_eq!(works.len(), CASES.len() * CHUNKS.len());
    if std::env::args().nth(1).as_deref() == Some("instructions") {
        return against_length(&works);
    }
    instructions::main(&works).unwrap_or_else(|| {
        divan::main();
        ExitCode::SUCCESS
    })
}

/// Instructions a byte between two lengths each, so that start-up does not count.
fn against_length(works: &[Work]) -> ExitCode {
    let [short, middle, long] = LENGTHS;
    println!("{:<36}{:>16}{:>16}", "instructions a byte", "16 K to 128 K", "128 K to 1 M");
    let mut code = ExitCode::SUCCESS;
    for (nth, work) in works.iter().enumerate() {
        let counts: Option<Vec<u64>> =
            LENGTHS.iter().map(|&len| instructions::count(work.name, len)).collect();
        let Some([few, more, most]) = counts.as_deref() else {
            eprintln!("skipped: valgrind does not run here, so no instructions were counted");
            return ExitCode::SUCCESS;
        };
        let before = (more - few) as f64 / (middle - short) as f64;
        let behind = (most - more) as f64 / (long - middle) as f64;
        let wrong = behind > MOST || behind > GROWTH * before;
        let name = format!("{}, {} bytes a chunk", CASES[nth / 2].name, CHUNKS[nth % 2]);
        println!(
            "{name:<36}{before:>16.1}{behind:>16.1}{}",
            if wrong { "  NOT LINEAR, or over the limit" } else { "" }
        );
        if wrong {
            code = ExitCode::FAILURE;
        }
    }
    code
}

/// One line of the timed table.
#[derive(Clone, Copy)]
struct Length {
    case: usize,
    len: u64,
}

impl fmt::Display for Length {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, {} KiB", CASES[self.case].name, self.len >> 10)
    }
}

fn lengths() -> Vec<Length> {
    (0..CASES.len()).flat_map(|case| LENGTHS.map(|len| Length { case, len })).collect()
}

#[divan::bench(args = lengths(), sample_count = 10)]
fn bytewise(bencher: Bencher<'_, '_>, length: Length) {
    timed(bencher, length, CHUNKS[0]);
}

#[divan::bench(args = lengths(), sample_count = 10)]
fn in_chunks(bencher: Bencher<'_, '_>, length: Length) {
    timed(bencher, length, CHUNKS[1]);
}

fn timed(bencher: Bencher<'_, '_>, Length { case, len }: Length, chunk: usize) {
    let case = &CASES[case];
    let (layout, line) = (case.layout(), case.line(len as usize));
    bencher.counter(BytesCount::new(len)).bench_local(|| receive(&layout, black_box(&line), chunk));
}
