//! Update files of what was built once, made several builds of: one in which a text is different, and some that do not
//! run.

use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;

use recipe_ctl::Slot;
use tempfile::TempDir;

use crate::BINARY;
use crate::board::Surroundings;

/// What was built for a board.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Built {
    /// The board's name.
    pub(crate) board: &'static str,
    /// Where images begin, 1 KiB behind their slots.
    pub(crate) images: [(Slot, u32); 2],
    /// What the names of the variables with the built programs begin with: `_SLOT_A` and `_SLOT_B` follow.
    pub(crate) variables: &'static str,
}

impl Built {
    /// The program that was built for a slot.
    pub(crate) fn program(&self, slot: Slot) -> PathBuf {
        Surroundings::named(&format!("{}_SLOT_{slot:?}", self.variables))
    }
}

/// The private key of RFC 8032's third test. The loaders of the tests are built for its public key.
const SEED: &str = "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7";
/// A text of the firmware, and that of another build in its place.
pub(crate) const TEXT: &str = "no firmware is on trial";
pub(crate) const OTHER_TEXT: &str = "no firmware is on TRIAL";

/// Update files for one board.
pub(crate) struct Releases {
    built: Built,
    folder: TempDir,
}

impl Releases {
    pub(crate) fn new(built: Built) -> Self {
        let releases = Self { built, folder: tempfile::tempdir().unwrap() };
        let mut key = std::fs::OpenOptions::new();
        let mut key = key.write(true).create_new(true).mode(0o600).open(releases.path(KEY)).unwrap();
        std::io::Write::write_all(&mut key, SEED.as_bytes()).unwrap();
        releases
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// `ctl` without a board.
    #[track_caller]
    pub(crate) fn ctl(args: &[&str]) {
        let made = BINARY.command().arg("ctl").args(args).output().unwrap();
        assert!(made.status.success(), "{made:?}");
    }

    /// An update of what was built, changed in both links and signed with the key of the loader; returns its path.
    pub(crate) fn sign(&self, name: &str, change: impl Fn(&mut [u8], u32)) -> String {
        self.sign_as(name, KEY, env!("CARGO_PKG_VERSION"), change)
    }

    /// The same, signed with another key or as another version.
    pub(crate) fn sign_as(
        &self,
        name: &str,
        key: &str,
        version: &str,
        change: impl Fn(&mut [u8], u32),
    ) -> String {
        let linked = self.built.images.map(|(slot, start)| {
            let built = self.built.program(slot);
            let mut elf =
                std::fs::read(&built).unwrap_or_else(|error| panic!("{}: {error}", built.display()));
            change(&mut elf, start);
            let path = self.path(&format!("{name}-{slot:?}.elf"));
            std::fs::write(&path, elf).unwrap();
            path.display().to_string()
        });
        let (key, file) = (self.path(key).display().to_string(), self.path(name).display().to_string());
        let [a, b] = &linked;
        let what = ["--board", self.built.board, "--version", version];
        let files = ["--signing-key", &key, "--slot-a", a, "--slot-b", b, "-o", &file];
        Self::ctl(&[&["sign"], &what[..], &files].concat());
        file
    }

    /// What belongs at the beginning of slot A, as a file.
    pub(crate) fn flat(&self, update: &str) -> PathBuf {
        let flat = self.path("slot-a.bin");
        Self::ctl(&["inspect", update, "--slot", "a", "-o", flat.to_str().unwrap()]);
        flat
    }
}

pub(crate) fn unchanged(_: &mut [u8], _: u32) {}

/// Another text in its place.
pub(crate) fn another_text(elf: &mut [u8], _: u32) {
    let places: Vec<_> =
        (0..elf.len() - TEXT.len()).filter(|at| elf[*at..].starts_with(TEXT.as_bytes())).collect();
    assert!(!places.is_empty(), "the firmware has no text {TEXT:?}");
    for at in places {
        elf[at..at + TEXT.len()].copy_from_slice(OTHER_TEXT.as_bytes());
    }
}

/// It asks for a reset with its first instructions (Armv7-M ARM A7.7): ldr r0, [pc, #4]; ldr r1, [pc, #8];
/// str r1, [r0]; b .
pub(crate) fn that_restarts(elf: &mut [u8], start: u32) {
    let words = [0xE000_ED0C_u32, 0x05FA_0004];
    let words: Vec<u16> = words.iter().flat_map(|word| [*word as u16, (*word >> 16) as u16]).collect();
    begin_with(elf, start, &[&[0x4801, 0x4902, 0x6001, 0xE7FE], &words[..]].concat());
}

/// b .
pub(crate) fn that_hangs(elf: &mut [u8], start: u32) {
    begin_with(elf, start, &[0xE7FE]);
}

/// udf #0
pub(crate) fn that_crashes(elf: &mut [u8], start: u32) {
    begin_with(elf, start, &[0xDE00]);
}

/// Puts this code, which is aligned to words, where the program starts.
fn begin_with(elf: &mut [u8], start: u32, code: &[u16]) {
    let vectors = place(elf, start);
    let reset = number(elf, vectors + 4) & !1;
    let padding: &[u16] = if reset % 4 == 2 { &[0xBF00] } else { &[] };
    let bytes: Vec<u8> = [padding, code].concat().iter().flat_map(|half| half.to_le_bytes()).collect();
    let at = place(elf, reset);
    elf[at..at + bytes.len()].copy_from_slice(&bytes);
}

/// Where a byte of flash is in an ELF file.
fn place(elf: &[u8], address: u32) -> usize {
    let half = |at: usize| usize::from(u16::from_le_bytes([elf[at], elf[at + 1]]));
    let (headers, size, count) = (number(elf, 28) as usize, half(42), half(44));
    let segments = (0..count).map(|nth| headers + nth * size);
    let found =
        segments.map(|at| [1, 3, 4].map(|word| number(elf, at + 4 * word))).find_map(|[from, paddr, len]| {
            let behind = address.checked_sub(paddr).filter(|behind| *behind < len)?;
            Some((from + behind) as usize)
        });
    found.expect("it is in the program")
}

fn number(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// The file of the private key.
const KEY: &str = "the.key";
