//! Targets on stable Rust, in `cargo fuzz-inputs`: everything that is kept, then a fixed number of inputs
//! made of it by chance, always the same ones.

use std::ffi::OsString;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};

use crate::source::Random;

/// One fuzz target.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// What it is called.
    pub name: &'static str,
    /// Takes one input; panics when something is not as it has to be.
    pub run: fn(&[u8]),
    /// Inputs to begin with: the vectors of `docs/wire`, and what once was a bug.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Inputs by chance in `cargo fuzz-inputs`, unless `FUZZ_RUNS` says otherwise.
    pub runs: usize,
    /// Longest input made by chance, in bytes.
    pub longest: usize,
}

impl Target {
    /// Seeds, what `corpus` keeps of the inputs that coverage led to, and inputs by chance.
    ///
    /// `FUZZ_FILE` names one file to be run instead. `FUZZ_SEEDS` names a folder that all that is kept
    /// is written to, `FUZZ_KEEP` one whose files are kept from now on. `FUZZ_RUNS` and `FUZZ_SEED` are
    /// numbers.
    ///
    /// # Panics
    /// As the target does. The input is then in a file that the panic names.
    pub fn check(&self, corpus: &Path) {
        if let Some(file) = std::env::var_os("FUZZ_FILE") {
            return (self.run)(&std::fs::read(at_root(file)).expect("FUZZ_FILE can be read"));
        }
        let kept = corpus.join(self.name);
        if let Some(folder) = std::env::var_os("FUZZ_KEEP") {
            return keep(&at_root(folder), &kept);
        }
        let mut known = (self.seeds)();
        known.extend(unpack(&kept));
        if let Some(folder) = std::env::var_os("FUZZ_SEEDS") {
            return write_out(&known, &at_root(folder));
        }
        assert!(!known.is_empty(), "{} has nothing to begin with", self.name);
        with_room(|| {
            for input in &known {
                self.run_one(input);
            }
            let mut random = Random::new(number("FUZZ_SEED").unwrap_or(1));
            for _ in 0..number("FUZZ_RUNS").map_or(self.runs, |runs| runs as usize) {
                self.run_one(&self.vary(&known, &mut random));
            }
        });
    }

    fn run_one(&self, input: &[u8]) {
        if let Err(panic) = catch_unwind(AssertUnwindSafe(|| (self.run)(input))) {
            let file = std::env::temp_dir().join(format!("fuzz-{}-failed", self.name));
            match std::fs::write(&file, input) {
                Ok(()) => eprintln!("the input is in {0}; FUZZ_FILE={0} runs it alone", file.display()),
                Err(error) => eprintln!("the input {input:02X?} cannot be kept: {error}"),
            }
            resume_unwind(panic);
        }
    }

    fn vary(&self, known: &[Vec<u8>], random: &mut Random) -> Vec<u8> {
        let mut input = known[random.below(known.len())].clone();
        for _ in 0..=random.below(6) {
            let at = random.below(input.len() + 1);
            let end = (at + random.below(16)).min(input.len());
            match random.below(10) {
                0 if at < input.len() => input[at] ^= 1 << random.below(8),
                1 if at < input.len() => input[at] = random.number() as u8,
                2 if at < input.len() => input[at] = TELLING[random.below(TELLING.len())],
                3 => drop(input.drain(at..end)),
                4 => drop(input.splice(at..at, (0..random.below(8)).map(|_| 0).collect::<Vec<_>>())),
                5 => {
                    let noise: Vec<u8> = (0..random.below(24)).map(|_| random.number() as u8).collect();
                    drop(input.splice(at..at, noise));
                }
                6 => {
                    let copy = input[at..end].to_vec();
                    let to = random.below(input.len() + 1);
                    drop(input.splice(to..to, copy));
                }
                7 => input.truncate(at),
                _ => {
                    let other = &known[random.below(known.len())];
                    let from = random.below(other.len() + 1);
                    let part = &other[from..(from + random.below(200)).min(other.len())];
                    drop(input.splice(at..end, part.iter().copied()));
                }
            }
        }
        input.truncate(self.longest);
        input
    }
}

/// On a stack that has room for several of the largest configurations, also without optimisation: a
/// test's own has not.
fn with_room(run: impl FnOnce() + Send) {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().stack_size(STACK).spawn_scoped(scope, run);
        if let Err(panic) = thread.expect("a thread can be started").join() {
            resume_unwind(panic);
        }
    });
}

const STACK: usize = 32 * 1024 * 1024;

/// Bytes of inputs that are kept in the repository for a target.
const KEPT: usize = 32 * 1024;

/// Bytes at which things change.
const TELLING: &[u8] =
    &[0, 1, 2, 3, 4, 8, 9, 16, 32, 64, 127, 128, 129, 253, 254, 255, b'\r', b'\n', b'(', b')'];

fn number(name: &str) -> Option<u64> {
    let text = std::env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

/// Cargo runs tests in their package's folder; people name files from the workspace's.
fn at_root(name: OsString) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(name)
}

fn write_out(inputs: &[Vec<u8>], folder: &Path) {
    for (nth, input) in inputs.iter().enumerate() {
        std::fs::write(folder.join(format!("kept-{nth:04}")), input).expect("the folder can be written to");
    }
}

/// Puts files of a folder into one: each as its length, two bytes, and its bytes. When they are more
/// than [`KEPT`] bytes, only every so many-th is taken, of short ones and long ones alike.
fn keep(folder: &Path, kept: &Path) {
    let entries = std::fs::read_dir(folder).expect("FUZZ_KEEP can be listed");
    let read = |entry: std::io::Result<std::fs::DirEntry>| {
        std::fs::read(entry.expect("FUZZ_KEEP can be listed").path()).expect("its files can be read")
    };
    let mut inputs: Vec<Vec<u8>> = entries.map(read).collect();
    inputs.sort_by_key(|input| (input.len(), input.clone()));
    let every = inputs.iter().map(Vec::len).sum::<usize>().div_ceil(KEPT).max(1);
    let pack = |input: &Vec<u8>| {
        let len = u16::try_from(input.len()).expect("no input is that long");
        [&len.to_le_bytes()[..], input].concat()
    };
    std::fs::create_dir_all(kept.parent().expect("a folder")).expect("the corpus has a folder");
    std::fs::write(kept, inputs.iter().step_by(every).flat_map(pack).collect::<Vec<u8>>())
        .expect("the corpus can be written to");
}

fn unpack(kept: &Path) -> Vec<Vec<u8>> {
    let packed = std::fs::read(kept).unwrap_or_default();
    let mut inputs = Vec::new();
    let mut rest = &packed[..];
    while let Some((len, behind)) = rest.split_first_chunk() {
        let (input, next) = behind.split_at(usize::from(u16::from_le_bytes(*len)));
        inputs.push(input.to_vec());
        rest = next;
    }
    inputs
}
