//! A board with two slots and two places for a store, a loader, and a firmware that takes an update.

use std::cell::Cell;
use std::fmt;
use std::rc::Rc;

use embassy_futures::block_on;
use recipe_store::{Flash, FlashWord, Geometry, Marks, Newest, Side, SlotMarks, Word, newest};
use recipe_update::{
    BoardName, Chosen, Downgrade, Formats, Header, ImageFacts, Machine, PublicKey, Receive, ReceiveStep,
    RunningFirmware, Slot, SlotFlash, Stores, Version, begin_trial, choose, confirm, file_head, link_padding,
};

use crate::model::{Nor, Torn};

pub(crate) const SEED: [u8; 32] = [0x42; 32];
pub(crate) const V1: Version = Version::new(0, 1, 0);

pub(crate) fn key() -> PublicKey {
    PublicKey::of_seed(&SEED)
}

pub(crate) fn name() -> BoardName {
    BoardName::parse("nucleo-h743zi").unwrap()
}

pub(crate) fn parts(slot: Slot, version: Version) -> ImageFacts {
    let formats = Formats::new(1, 3, 3).unwrap();
    ImageFacts { board: name(), slot, version, formats, store: recipe_store::VERSION }
}

/// An image that tells version, slot and place of each byte, with words of zeros and ones in it.
pub(crate) fn image(slot: Slot, version: Version, len: usize) -> Vec<u8> {
    let number = u32::from(version.minor) << 1 | u32::from(slot.number());
    let byte = |at: u32| match at / 32 % 9 {
        3 => 0,
        5 => 0xFF,
        _ => (number.wrapping_mul(2_654_435_761).wrapping_add(at.wrapping_mul(40_503)) >> 13) as u8,
    };
    (0..len as u32).map(byte).collect()
}

/// The file of an update.
pub(crate) fn file(links: &[(Header, Vec<u8>)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (header, image) in links {
        bytes.extend(header.encode());
        bytes.extend(image);
        bytes.resize(bytes.len() + link_padding(image.len()), 0xFF);
    }
    let head = file_head(links.len() as u32, (bytes.len() + recipe_update::FILE_HEAD) as u32);
    [&head[..], &bytes].concat()
}

/// The supply of all flash.
#[derive(Debug, Default)]
struct Power {
    left: Cell<Option<u32>>,
    seed: Cell<u64>,
    is_off: Cell<bool>,
    operations: Cell<u32>,
}

/// Flash with the supply of the board.
#[derive(Debug, Clone)]
pub(crate) struct Part {
    pub(crate) nor: Nor,
    power: Rc<Power>,
}

impl Part {
    fn operate(&mut self, operation: impl FnOnce(&mut Nor)) {
        if self.power.is_off.get() {
            return;
        }
        self.power.operations.set(self.power.operations.get() + 1);
        match self.power.left.get() {
            Some(0) => {
                self.nor.cut_after(0, self.power.seed.get());
                self.power.is_off.set(true);
            }
            left => self.power.left.set(left.map(|left| left - 1)),
        }
        operation(&mut self.nor);
    }
}

impl Flash for Part {
    fn geometry(&self) -> Geometry {
        self.nor.geometry()
    }

    fn read(&self, place: FlashWord) -> Word {
        self.nor.read(place)
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.operate(|nor| nor.write_now(place, word));
    }

    async fn erase(&mut self, sector: u8) {
        self.operate(|nor| nor.erase_now(sector));
    }
}

impl SlotFlash for Part {
    fn whole(&self, place: FlashWord) -> Option<Word> {
        self.nor.read_or_fault(place)
    }
}

#[derive(Debug)]
pub(crate) struct SimulatedBoard {
    pub(crate) slots: [Part; 2],
    pub(crate) stores: [Part; 2],
    power: Rc<Power>,
    len: usize,
    /// What the loader passed over.
    pub(crate) told: Vec<String>,
}

impl Clone for SimulatedBoard {
    fn clone(&self) -> Self {
        let power = Rc::new(Power::default());
        power.is_off.set(self.power.is_off.get());
        power.operations.set(self.power.operations.get());
        let part = |part: &Part| Part { nor: part.nor.clone(), power: Rc::clone(&power) };
        let (slots, stores) = (self.slots.each_ref().map(part), self.stores.each_ref().map(part));
        Self { slots, stores, power, len: self.len, told: Vec::new() }
    }
}

/// What the configuration of every board is.
const CONFIGURATION: &[u8] = b"a configuration that must never be lost";

impl SimulatedBoard {
    /// With version 0.1.0 in slot A, and a configuration.
    pub(crate) fn new(slot: Geometry, store: Geometry, torn: Torn, len: usize) -> Self {
        let power = Rc::new(Power::default());
        let part = |geometry| Part { nor: Nor::new(geometry, torn), power: Rc::clone(&power) };
        let (slots, stores) = ([part(slot), part(slot)], [part(store), part(store)]);
        let mut board = Self { slots, stores, power: Rc::clone(&power), len, told: Vec::new() };
        board.probe(Slot::A, V1);
        let mut found = board.newest();
        let part = board.store_mut(&found);
        block_on(found.store.keep(1, 7, CONFIGURATION, None).unwrap().execute(part)).unwrap();
        let marks = Marks { live: Some(1), ..Marks::default() };
        block_on(found.store.mark(marks).unwrap().execute(part)).unwrap();
        assert_eq!(board.start().slot, Slot::A);
        board
    }

    /// As a probe does it.
    pub(crate) fn probe(&mut self, slot: Slot, version: Version) {
        let image = image(slot, version, self.len);
        let header = Header::sign(parts(slot, version), &image, &SEED).unwrap();
        self.put(slot, &header, &image);
    }

    pub(crate) fn put(&mut self, slot: Slot, header: &Header, image: &[u8]) {
        let part = &mut self.slots[usize::from(slot.number())];
        let Geometry { sectors, words } = part.geometry();
        (0..sectors).for_each(|sector| part.nor.erase_now(sector));
        let mut bytes = header.encode().to_vec();
        bytes.resize(1024, 0xFF);
        bytes.extend(image);
        bytes.resize(bytes.len().next_multiple_of(32), 0xFF);
        for (word, at) in bytes.as_chunks().0.iter().zip(0..) {
            // What is blank is not written.
            if *word != [0xFF; 32] {
                part.nor.write_now(FlashWord { sector: (at / words) as u8, word: at % words }, word);
            }
        }
    }

    pub(crate) fn newest(&self) -> Newest {
        newest(&self.stores[0], &self.stores[1]).expect("there is a store")
    }

    fn store_mut(&mut self, found: &Newest) -> &mut Part {
        match found.side {
            Side::First => &mut self.stores[0],
            Side::Second => &mut self.stores[1],
        }
    }

    pub(crate) fn marks(&self) -> SlotMarks {
        self.newest().store.slots()
    }

    pub(crate) fn write_marks(&mut self, marks: SlotMarks) -> bool {
        let mut found = self.newest();
        let part = self.store_mut(&found);
        found.store.mark_slots(marks).is_ok_and(|put| block_on(put.execute(part)).is_ok()) && !self.is_off()
    }

    pub(crate) fn cut_after(&mut self, left: u32, seed: u64) {
        self.power.left.set(Some(left));
        self.power.seed.set(seed);
    }

    pub(crate) fn power(&mut self) {
        self.power.left.set(None);
        self.power.is_off.set(false);
        self.slots.iter_mut().chain(&mut self.stores).for_each(|part| part.nor.power());
    }

    pub(crate) fn is_off(&self) -> bool {
        self.power.is_off.get()
    }

    pub(crate) fn operations(&self) -> u32 {
        self.power.operations.get()
    }

    /// The loader; what it runs is whole, and the configuration is there.
    #[track_caller]
    pub(crate) fn start(&mut self) -> Chosen {
        let chosen = self.try_start().expect("something always runs");
        let found = self.newest();
        let part = self.store_mut(&found).clone();
        let mut buf = [0; 100];
        let live = found.store.at_start().candidates.first().expect("a configuration").0.number;
        assert_eq!(found.store.image(&part, live, &mut buf), Some(CONFIGURATION));
        let Chosen { slot, header, .. } = chosen;
        let image = image(slot, header.version(), self.len);
        let part = &self.slots[usize::from(slot.number())];
        let words = u32::from(part.geometry().words);
        for (word, at) in image.chunks(32).zip(32..) {
            let place = FlashWord { sector: (at / words) as u8, word: (at % words) as u16 };
            let read = part.whole(place).expect("every word can be read");
            assert_eq!(word, &read[..word.len()], "{place:?}");
        }
        chosen
    }

    pub(crate) fn try_start(&mut self) -> Option<Chosen> {
        self.told.clear();
        let marks = newest(&self.stores[0], &self.stores[1]).ok().map(|found| found.store.slots());
        choose(self, marks, &name(), &key())
    }

    /// The running firmware moves the store into the bank that it does not run from.
    pub(crate) fn move_store(&mut self, slot: Slot) {
        let found = self.newest();
        let [first, second] = &mut self.stores;
        let (from, to) = match found.side {
            Side::First => (first, second),
            Side::Second => (second, first),
        };
        if found.side != Stores::of(slot) {
            assert!(found.may_move);
            let _ = block_on(found.store.relocate().execute(from, to));
        }
    }

    /// The running firmware receives this version for the other slot, in pieces; whether it is there.
    pub(crate) fn receive(
        &mut self,
        running: &RunningFirmware,
        header: Header,
        image: &[u8],
    ) -> Result<bool, recipe_update::UpdateRefused> {
        let marks = self.marks();
        let part = &mut self.slots[usize::from(running.slot.other().number())];
        let mut receive = Receive::begin(header, running, marks, Downgrade::Refused, part)?;
        let mut piece = 1;
        loop {
            match receive.next(part) {
                ReceiveStep::Erase(sector) => block_on(part.erase(sector)),
                ReceiveStep::Write(place, word) => block_on(part.write(place, &word)),
                ReceiveStep::Take { offset } => {
                    piece = piece * 5 % 97 + 1;
                    let rest = &image[offset as usize..];
                    let taken = receive.take(offset, &rest[..rest.len().min(piece)]).expect("the next ones");
                    assert!(taken > 0);
                }
                ReceiveStep::Again => {}
                ReceiveStep::End(result) => return Ok(result.is_ok() && !part.power.is_off.get()),
            }
            if part.power.is_off.get() {
                return Ok(false);
            }
        }
    }

    pub(crate) fn running(slot: Slot, version: Version) -> RunningFirmware {
        RunningFirmware { board: name(), slot, version, kept: Some((3, 3)) }
    }

    /// Starts and works until this version was confirmed, or the power is off.
    #[track_caller]
    pub(crate) fn live_until(&mut self, version: Version) {
        for _ in 0..12 {
            if self.is_off() {
                return;
            }
            let Some(chosen) = self.try_start() else {
                assert!(self.is_off(), "something always runs");
                return;
            };
            if self.is_off() {
                return;
            }
            let Chosen { slot, header, is_trial } = chosen;
            self.move_store(slot);
            if self.is_off() {
                return;
            }
            if is_trial {
                assert_eq!(header.version(), version, "only this one was put on trial");
                let marks = confirm(self.marks(), slot).expect("it is on trial");
                self.write_marks(marks);
            } else if header.version() != version {
                let next = slot.other();
                let image = image(next, version, self.len);
                let header = Header::sign(parts(next, version), &image, &SEED).unwrap();
                let running = Self::running(slot, chosen.header.version());
                if self.receive(&running, header, &image).expect("it is allowed") {
                    self.write_marks(begin_trial(self.marks(), next, 60, 0));
                }
            } else {
                return;
            }
        }
        panic!("it does not end");
    }

    #[track_caller]
    pub(crate) fn is_confirmed(&mut self, version: Version) {
        let chosen = self.start();
        assert_eq!((chosen.header.version(), chosen.is_trial), (version, false));
        assert_eq!(self.marks().good, Some(chosen.slot));
        assert_eq!(self.marks().trial, None);
        self.move_store(chosen.slot);
        assert_eq!(self.newest().side, Stores::of(chosen.slot));
    }
}

impl Machine for SimulatedBoard {
    type Flash = Part;

    fn flash(&self, slot: Slot) -> &Part {
        &self.slots[usize::from(slot.number())]
    }

    fn mark(&mut self, marks: SlotMarks) -> bool {
        self.write_marks(marks)
    }

    fn passed_over(&mut self, slot: Slot, why: &dyn fmt::Display) {
        self.told.push(format!("{slot:?}: {why}"));
    }
}
