//! Small programs for a slot, signed as a firmware is.

use recipe_update::{
    BoardName, Formats, Header, IMAGE_OFFSET, ImageFacts, NUCLEO_H743ZI as BOARD, Slot, Version,
};

/// The private key of RFC 8032's third test. The loader of the tests is built for its public key.
pub(crate) const SEED: [u8; 32] = [
    0xC5, 0xAA, 0x8D, 0xF4, 0x3F, 0x9F, 0x83, 0x7B, 0xED, 0xB7, 0x44, 0x2F, 0x31, 0xDC, 0xB7, 0xB1, 0x66,
    0xD3, 0x85, 0x35, 0x07, 0x6F, 0x09, 0x4B, 0x85, 0xCE, 0x3A, 0x2E, 0x0B, 0x44, 0x58, 0xF7,
];
/// Where a program that stays leaves its mark, its vector table and its stack.
pub(crate) const LEAVES: u32 = 0x2400_0000;
pub(crate) const STACK: u32 = 0x2401_0000;

/// What a program does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ProgramKind {
    /// Leaves its mark and loops forever.
    Stay,
    /// Asks for a reset.
    Restart,
    /// Sets the watchdog to 2 ms, and does not feed it.
    Hang,
}

pub(crate) struct Image {
    slot: Slot,
    pub(crate) bytes: Vec<u8>,
    pub(crate) header: Header,
}

/// The mark of the program in this slot.
pub(crate) fn mark(slot: Slot) -> u32 {
    0x5107_0000 | u32::from(slot.number())
}

/// Instructions and, behind them, the words that they load (Armv7-M ARM A7.7).
fn code(does: ProgramKind, slot: Slot) -> (Vec<u16>, Vec<u32>) {
    // ldr r0, the first; ldr r1, the second; str r1, [r0]
    let begin = [(0, 0), (1, 1)];
    match does {
        ProgramKind::Stay => {
            let mut code = loads(&begin, 10);
            // str r1, [r0]; ldr r2, the third; ldr r1, [r2]; str r1, [r0, #4]; mov r1, sp; str r1, [r0, #8]; b .
            code.push(0x6001);
            code.push(load(2, 2, code.len(), 10));
            code.extend([0x6811, 0x6041, 0x4669, 0x6081, 0xE7FE, 0xBF00]);
            (code, vec![LEAVES, mark(slot), 0xE000_ED08])
        }
        ProgramKind::Restart => {
            let mut code = loads(&begin, 4);
            code.extend([0x6001, 0xE7FE]);
            (code, vec![0xE000_ED0C, 0x05FA_0004])
        }
        ProgramKind::Hang => {
            let mut code = loads(&begin, 8);
            // str r1, [r0]; movs r1, #0; str r1, [r0, #4]; movs r1, #15; str r1, [r0, #8]; b .
            code.extend([0x6001, 0x2100, 0x6041, 0x210F, 0x6081, 0xE7FE]);
            (code, vec![0x5800_4800, 0x5555])
        }
    }
}

fn loads(all: &[(u16, usize)], len: usize) -> Vec<u16> {
    all.iter().enumerate().map(|(at, (register, nth))| load(*register, *nth, at, len)).collect()
}

/// `ldr` of the nth word behind `len` instructions, as the instruction at `at`. The code begins at 8 in the image.
fn load(register: u16, nth: usize, at: usize, len: usize) -> u16 {
    let pc = (8 + 2 * at + 4) & !3;
    let word = 8 + 2 * len.next_multiple_of(2) + 4 * nth;
    0x4800 | register << 8 | ((word - pc) / 4) as u16
}

impl Image {
    pub(crate) fn new(slot: Slot, does: ProgramKind) -> Self {
        let start = BOARD.slot(slot) + IMAGE_OFFSET;
        let (code, words) = code(does, slot);
        let mut bytes: Vec<u8> = [STACK, start + 8 + 1].iter().flat_map(|word| word.to_le_bytes()).collect();
        bytes.extend(code.iter().flat_map(|half| half.to_le_bytes()));
        bytes.extend(words.iter().flat_map(|word| word.to_le_bytes()));
        bytes.extend((bytes.len()..3_000).map(|at| (at / 7) as u8));
        let mut image = Self { slot, header: header(slot, &bytes, &SEED), bytes };
        image.sign(&SEED);
        image
    }

    pub(crate) fn sign(&mut self, seed: &[u8; 32]) {
        self.header = header(self.slot, &self.bytes, seed);
    }
}

fn header(slot: Slot, bytes: &[u8], seed: &[u8; 32]) -> Header {
    let board = BoardName::parse(BOARD.board).expect("a name");
    let formats = Formats::new(1, 3, 3).expect("they fit");
    let parts =
        ImageFacts { board, slot, version: Version::new(0, 3, 0), formats, store: recipe_store::VERSION };
    Header::sign(parts, bytes, seed).expect("it is not empty")
}
