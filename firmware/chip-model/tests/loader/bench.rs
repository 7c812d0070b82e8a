//! The chip with the loader, slots and stores.

use std::sync::OnceLock;

use embassy_futures::block_on;
use recipe_chip_model::device::{MILLI, Picos, SECOND};
use recipe_chip_model::{Chip, Program};
use recipe_store::{BLANK, Flash, FlashWord, Geometry, Side, WORD, Word, newest};
use recipe_update::{
    IMAGE_OFFSET, NUCLEO_H743ZI as BOARD, NUCLEO_H743ZI_STORES as STORES, Slot, SlotMarks, SlotTrial,
};

use crate::image::{Image, LEAVES, mark};

pub(crate) const GOOD_A: SlotMarks = SlotMarks { good: Some(Slot::A), trial: None, last: None };

/// A is good, and B on trial with so many starts.
pub(crate) fn mark_b(attempts: u8) -> SlotMarks {
    SlotMarks { trial: Some(SlotTrial { slot: Slot::B, attempts, confirm_s: 60, before: 0 }), ..GOOD_A }
}

fn program() -> &'static Program {
    const ELF: &str = "CHIP_LOADER";
    static PROGRAM: OnceLock<Program> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let path = std::env::var_os(ELF).unwrap_or_else(|| panic!("{ELF} does not say where the loader is"));
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        Program::read(&bytes).expect("the loader")
    })
}

/// The contents of a place for the store. It takes a write anywhere, like a debugger.
struct FlashCopy(Vec<Word>);

const WORDS: u16 = 4096;
const FLASH: u32 = 0x0800_0000;

impl Flash for FlashCopy {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 2, words: WORDS }
    }

    fn read(&self, FlashWord { sector, word }: FlashWord) -> Word {
        self.0[usize::from(sector) * usize::from(WORDS) + usize::from(word)]
    }

    async fn write(&mut self, FlashWord { sector, word }: FlashWord, new: &Word) {
        self.0[usize::from(sector) * usize::from(WORDS) + usize::from(word)] = *new;
    }

    async fn erase(&mut self, sector: u8) {
        self.0[usize::from(sector) * usize::from(WORDS)..][..usize::from(WORDS)].fill(BLANK);
    }
}

pub(crate) struct LoaderBench {
    pub(crate) chip: Chip,
}

impl LoaderBench {
    pub(crate) fn new() -> Self {
        Self { chip: Chip::new(program(), &[]).unwrap_or_else(|error| panic!("{error}")) }
    }

    /// A probe writes a slot.
    pub(crate) fn put(&mut self, slot: Slot, image: &Image) {
        let mut bytes = image.header.encode().to_vec();
        bytes.resize(IMAGE_OFFSET as usize, 0xFF);
        bytes.extend(&image.bytes);
        bytes.resize(BOARD.slot_size() as usize, 0xFF);
        self.chip.load(BOARD.slot(slot), &bytes);
    }

    /// Everything but the loader is blank.
    pub(crate) fn blank(&mut self) {
        let all = BOARD.slots.iter().map(|start| (*start, BOARD.slot_size()));
        let stores = STORES.0.as_flattened().iter().map(|start| (*start, BOARD.sector));
        let all: Vec<_> = all.chain(stores).collect();
        for (start, len) in all {
            self.chip.load(start, &vec![0xFF; len as usize]);
        }
    }

    fn place(&mut self, side: Side) -> FlashCopy {
        let flash = &self.chip.devices().flash;
        let torn: Vec<u32> = flash.torn().collect();
        let words = STORES.sectors(side).into_iter().flat_map(|start| {
            let first = start - FLASH;
            let bytes = &flash.cells()[first as usize..][..BOARD.sector as usize];
            (first..).step_by(WORD).zip(bytes.as_chunks().0)
        });
        FlashCopy(words.map(|(at, word)| if torn.contains(&at) { [0; WORD] } else { *word }).collect())
    }

    /// The marks of the store.
    pub(crate) fn marks(&mut self) -> SlotMarks {
        let (first, second) = (self.place(Side::First), self.place(Side::Second));
        newest(&first, &second).expect("there is a store").store.slots()
    }

    /// Writes marks into the first place.
    pub(crate) fn mark(&mut self, marks: SlotMarks) {
        let mut first = self.place(Side::First);
        let mut store = recipe_store::Store::mount(&first).expect("it can be one");
        block_on(store.mark_slots(marks).expect("there is room").execute(&mut first)).expect("it is flash");
        for (start, words) in STORES.sectors(Side::First).into_iter().zip(first.0.chunks(WORDS.into())) {
            self.chip.load(start, words.as_flattened());
        }
    }

    /// Switches the board off and on, and forgets what it has done.
    pub(crate) fn begin_again(&mut self) {
        self.chip.cut_power();
        self.chip.power_cuts = 0;
        self.chip.restarts.clear();
        self.chip.resets.clear();
    }

    #[track_caller]
    pub(crate) fn run(&mut self, span: Picos) {
        let end = self.chip.now() + span;
        if let Err(stopped) = self.chip.run_until(end) {
            panic!("{stopped}");
        }
    }

    /// What a program that stays has left: its mark, its vector table, its stack.
    pub(crate) fn left(&self) -> [u32; 3] {
        [0, 4, 8].map(|offset| self.chip.engine().word(LEAVES + offset))
    }

    /// Runs until a program stays; its slot.
    #[track_caller]
    pub(crate) fn runs(&mut self) -> Slot {
        let end = self.chip.now() + 20 * SECOND;
        loop {
            let [left, ..] = self.left();
            if let Some(slot) = Slot::ALL.into_iter().find(|slot| mark(*slot) == left) {
                return slot;
            }
            assert!(
                self.chip.now() < end,
                "nothing runs: at {}, faults {:X?}",
                self.chip.place(),
                self.chip.faults
            );
            self.run(MILLI);
        }
    }

    /// When LD3 was switched.
    pub(crate) fn red_led(&mut self) -> Vec<(Picos, bool)> {
        self.chip.devices().led(recipe_chip_model::Led::Red).collect()
    }
}
