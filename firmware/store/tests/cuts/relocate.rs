//! The store is moved between two places, with the power cut at every operation.

use embassy_futures::block_on;
use recipe_store::{
    Flash as _, FlashWord, Geometry, Marks, MountError, Newest, RecordKey, Side, Slot, SlotMarks, SlotTrial,
    Store, TrialEnd, newest,
};

use crate::bench::{Change, StoreContents, image, life};
use crate::model::{Nor, TORN, Torn};
use crate::{SECTORS, SMALL, TWO};

/// Two places of flash with one supply, and what the store has to hold.
#[derive(Debug, Clone)]
struct TwoPlaces {
    places: [Nor; 2],
    expected: StoreContents,
    slots: SlotMarks,
    generation: u64,
}

fn index(side: Side) -> usize {
    match side {
        Side::First => 0,
        Side::Second => 1,
    }
}

fn marks(number: u32) -> SlotMarks {
    let slot = Slot::ALL[number as usize % 2];
    let trial =
        SlotTrial { slot, attempts: (number % 4) as u8, confirm_s: number as u16, before: number as u8 };
    SlotMarks {
        good: Some(slot.other()),
        trial: (!number.is_multiple_of(3)).then_some(trial),
        last: (!number.is_multiple_of(5)).then_some((slot, TrialEnd::Failed)),
    }
}

impl TwoPlaces {
    fn new(geometry: Geometry, torn: Torn) -> Self {
        Self {
            places: [Nor::new(geometry, torn), Nor::new(geometry, torn)],
            expected: StoreContents::default(),
            slots: SlotMarks::default(),
            generation: 0,
        }
    }

    #[track_caller]
    fn start(&mut self) -> Newest {
        self.places.iter_mut().for_each(Nor::power);
        let [first, second] = &self.places;
        let found = newest(first, second).expect("it always starts");
        assert_eq!(StoreContents::read(&found.store, &self.places[index(found.side)]), self.expected);
        assert_eq!(found.store.slots(), self.slots);
        found
    }

    #[track_caller]
    fn change(&mut self, change: &Change) {
        let mut found = self.start();
        assert!(change.attempt(&mut found.store, &mut self.places[index(found.side)]), "{change:?}");
        self.expected = self.expected.after(change);
        self.start();
    }

    #[track_caller]
    fn mark(&mut self, marks: SlotMarks) {
        let mut found = self.start();
        let put = found.store.mark_slots(marks).expect("there is room");
        block_on(put.execute(&mut self.places[index(found.side)])).expect("there is power");
        self.slots = marks;
        self.start();
    }

    /// Whether it was moved.
    fn attempt(&mut self) -> bool {
        let [first, second] = &self.places;
        let found = newest(first, second).expect("it always starts");
        let [first, second] = &mut self.places;
        let (from, to) = match found.side {
            Side::First => (first, second),
            Side::Second => (second, first),
        };
        let moved = block_on(found.store.relocate().execute(from, to));
        let Ok(moved) = moved else { return false };
        if !to.is_off() {
            assert_eq!(StoreContents::read(&moved, to), self.expected);
        }
        true
    }

    #[track_caller]
    fn relocate(&mut self) {
        let side = self.start().side;
        assert!(self.attempt());
        self.generation += 1;
        let found = self.start();
        assert_ne!(found.side, side);
        assert_eq!((found.store.generation(), found.may_move), (self.generation, true));
    }

    fn cut_after(&mut self, left: u32, seed: u64) {
        let to = self.start().side;
        self.places[1 - index(to)].cut_after(left, seed);
    }

    fn operations(&self) -> u32 {
        self.places.iter().map(Nor::operations).sum()
    }
}

/// Cuts the power in each operation of a move, or in one of `stride`; then once more, in the move that follows.
fn cut_everywhere(board: &TwoPlaces, stride: usize, seed: u64) -> (u32, u32) {
    let mut whole = board.clone();
    assert!(whole.attempt());
    let steps = whole.operations() - board.operations();
    let before = board.clone().start().side;
    let mut cuts = (0, 0);
    // The last ones decide.
    let last = steps.saturating_sub(6);
    for cut in (0..last).step_by(stride).chain(last..steps) {
        let mut dead = board.clone();
        dead.cut_after(cut, seed << 32 | u64::from(cut) << 8 | 0x55);
        dead.attempt();
        cuts.0 += 1;
        let moved = dead.start().side != before;
        assert!(!moved || cut + 1 == steps, "only with the last word: cut {cut} of {steps}");
        for second in [0, cut * 7 % steps, steps - 1] {
            let mut twice = dead.clone();
            if moved {
                continue;
            }
            twice.cut_after(second, u64::from(cut) << 16 | u64::from(second) << 3 | 5);
            twice.attempt();
            cuts.1 += 1;
            twice.start();
            // The store before is used, also by a loader.
            twice.mark(marks(cut));
            twice.change(&Change::Counter(1, u64::from(cut)));
            twice.generation = twice.start().store.generation();
            twice.relocate();
            twice.change(&Change::Counter(1, u64::from(second)));
        }
    }
    cuts
}

fn moved_to_and_fro(name: &str, geometry: Geometry, changes: &[Change], every: usize, stride: usize) {
    let mut total = (0, 0);
    for torn in TORN {
        let mut board = TwoPlaces::new(geometry, torn);
        for (nth, change) in changes.iter().enumerate() {
            board.change(change);
            board.mark(marks(nth as u32));
            if nth % every == 0 {
                let cuts = cut_everywhere(&board, stride, nth as u64);
                total = (total.0 + cuts.0, total.1 + cuts.1);
                board.relocate();
            }
        }
    }
    println!("moves, {name}: {} cuts, {} second cuts", total.0, total.1);
    assert!(total.0 > 100 && total.1 > 300, "{total:?}");
}

#[test]
fn small_sectors() {
    moved_to_and_fro("small sectors", SMALL, &life(60, &[300, 40, 0, 500, 96]), 6, 1);
}

#[test]
fn two_sectors() {
    moved_to_and_fro("two sectors", TWO, &life(40, &[200, 64, 33]), 5, 1);
}

#[test]
fn the_sectors_of_the_chip() {
    moved_to_and_fro("STM32H743", SECTORS, &life(20, &[2_000, 400]), 10, 5);
}

#[test]
fn a_store_that_was_never_moved_is_found_in_the_first_place() {
    let mut board = TwoPlaces::new(SMALL, Torn::Fault);
    assert_eq!(board.start().side, Side::First);
    // Something of another life lies in the second one.
    let mut other = Store::mount(&board.places[1]).unwrap();
    block_on(other.set_counter(0, 9).unwrap().execute(&mut board.places[1])).unwrap();
    board.change(&Change::Counter(0, 5));
    board.relocate();
    assert_eq!(board.start().store.counter(0), 5);
    board.change(&Change::Keep { number: 1, image: image(1, 100) });
    board.change(&Change::Mark(Marks { live: Some(1), ..Marks::default() }));
    board.relocate();
    assert_eq!((board.start().side, board.start().store.generation()), (Side::First, 2));
}

#[test]
fn a_place_of_a_newer_program_is_neither_used_nor_erased() {
    let mut board = TwoPlaces::new(SMALL, Torn::Fault);
    board.change(&Change::Counter(0, 5));
    let mut head = [0; 32];
    head[..4].copy_from_slice(b"RGSs");
    head[4] = 2;
    let check = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&head[..28]);
    head[28..].copy_from_slice(&check.to_le_bytes());
    board.places[1].write_now(FlashWord { sector: 1, word: 0 }, &head);
    let found = board.start();
    assert_eq!((found.side, found.may_move), (Side::First, false));
    let [first, second] = &board.places;
    let turned = newest(second, first).unwrap();
    assert_eq!((turned.side, turned.may_move), (Side::Second, false));
    assert_eq!(newest(second, second).unwrap_err(), MountError::Version { found: 2 });
}

#[test]
fn a_place_that_cannot_be_erased_leaves_the_store_where_it_was() {
    let mut board = TwoPlaces::new(SMALL, Torn::Fault);
    board.change(&Change::Keep { number: 1, image: image(1, 700) });
    let found = board.start();
    let (from, mut to) = (board.places[0].clone(), board.places[1].clone());
    to.wear_out(2);
    let error = block_on(found.store.relocate().execute(&from, &mut to)).unwrap_err();
    println!("{error}");
    let found = newest(&from, &to).unwrap();
    assert_eq!((found.side, found.store.find(RecordKey::Generation)), (Side::First, None));
    assert_eq!(StoreContents::read(&found.store, &from), board.expected);
    assert_eq!(from.geometry(), SMALL);
}
