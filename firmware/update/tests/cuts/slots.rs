//! What a loader passes over, and what it runs then.

use recipe_store::{FlashWord, Slot, TrialEnd};
use recipe_update::{Chosen, Header, SlotMarks, begin_trial};

use crate::board::{SEED, SimulatedBoard, V1, image, parts};
use crate::model::{Nor, Torn};
use crate::{SMALL_SLOT, SMALL_STORE, V2, V3};

fn both() -> SimulatedBoard {
    let mut board = SimulatedBoard::new(SMALL_SLOT, SMALL_STORE, Torn::Fault, 1_500);
    board.probe(Slot::B, V2);
    board
}

fn blank(board: &mut SimulatedBoard) {
    board.stores.iter_mut().for_each(|part| part.nor = Nor::new(SMALL_STORE, Torn::Fault));
}

#[test]
fn the_first_slot_that_verifies_becomes_the_good_one() {
    let mut board = both();
    blank(&mut board);
    assert_eq!(board.try_start().unwrap().slot, Slot::A);
    assert_eq!(board.marks(), SlotMarks { good: Some(Slot::A), ..SlotMarks::default() });
    // Later a newer one in the other slot is no reason to run it.
    board.probe(Slot::B, V3);
    assert_eq!(board.try_start().unwrap().slot, Slot::A);
}

#[test]
fn a_damaged_firmware_is_passed_over_for_the_other_one() {
    for damage in [0_u16, 2, 32, 50] {
        let mut board = both();
        board.slots[0].nor.damage(FlashWord { sector: 0, word: damage });
        let chosen = board.try_start().unwrap();
        if damage == 0 {
            assert_eq!(chosen.slot, Slot::A, "the signature of the good one is not looked at");
            continue;
        }
        assert_eq!((chosen.slot, chosen.is_trial), (Slot::B, false), "{:?}", board.told);
        let says = if damage == 2 { "the header has version" } else { "damaged" };
        assert!(board.told[0].contains(says), "{:?}", board.told);
        assert_eq!(board.marks().good, Some(Slot::B));
        // And both.
        board.slots[1].nor.damage(FlashWord { sector: 1, word: 2 });
        assert_eq!(board.try_start(), None);
        assert_eq!(board.told.len(), 2);
    }
}

#[test]
fn a_word_of_zeros_that_cannot_be_read_is_damage() {
    let mut board = both();
    // Reading it gives zeros where there may be no faults, and running it is one.
    let zeros = FlashWord { sector: 0, word: 32 + 3 };
    assert_eq!(board.slots[0].nor.read_or_fault(zeros), Some([0; 32]));
    board.slots[0].nor.allow_rewrites();
    board.slots[0].nor.write_now(zeros, &[0; 32]);
    assert_eq!(board.try_start().unwrap().slot, Slot::B);
    assert_eq!(board.told, ["A: the firmware is damaged: word 35 of sector 0 cannot be read"]);
}

#[test]
fn a_foreign_firmware_never_runs() {
    let image = image(Slot::B, V2, 1_500);
    let foreign = Header::sign(parts(Slot::B, V2), &image, &[9; 32]).unwrap();
    let mut board = both();
    board.put(Slot::B, &foreign, &image);
    board.write_marks(begin_trial(board.marks(), Slot::B, 60, 0));
    let chosen = board.try_start().unwrap();
    assert_eq!((chosen.slot, chosen.is_trial), (Slot::A, false));
    assert_eq!(board.told, ["B: the firmware was not signed with the key of this board"]);
    assert_eq!(board.marks().last, Some((Slot::B, TrialEnd::Failed)));
    // Nor as the last resort.
    board.slots[0].nor.damage(FlashWord { sector: 0, word: 40 });
    assert_eq!(board.try_start(), None);
}

#[test]
fn an_image_that_was_exchanged_behind_its_header_never_runs_on_trial() {
    let mut board = both();
    let signed = Header::sign(parts(Slot::B, V2), &image(Slot::B, V2, 1_500), &SEED).unwrap();
    board.put(Slot::B, &signed, &image(Slot::B, V3, 1_500));
    board.write_marks(begin_trial(board.marks(), Slot::B, 60, 0));
    assert_eq!(board.try_start().unwrap().slot, Slot::A);
    assert_eq!(board.told, ["B: the firmware is damaged: its CRC differs"]);
}

#[test]
fn a_firmware_of_another_slot_or_board_never_runs() {
    let image_a = image(Slot::A, V2, 1_500);
    let mut board = both();
    board.put(Slot::B, &Header::sign(parts(Slot::A, V2), &image_a, &SEED).unwrap(), &image_a);
    board.write_marks(begin_trial(board.marks(), Slot::B, 60, 0));
    assert_eq!(board.try_start().unwrap().slot, Slot::A);
    assert_eq!(board.told, ["B: the firmware is linked for the other slot"]);
    let other = recipe_update::BoardName::parse("mps2-an500").unwrap();
    let parts = recipe_update::ImageFacts { board: other, ..parts(Slot::B, V2) };
    board.put(Slot::B, &Header::sign(parts, &image_a, &SEED).unwrap(), &image_a);
    board.write_marks(begin_trial(board.marks(), Slot::B, 60, 0));
    assert_eq!(board.try_start().unwrap().slot, Slot::A);
    assert_eq!(board.told, ["B: the firmware is for the board mps2-an500"]);
}

#[test]
fn without_a_store_the_first_slot_that_verifies_runs() {
    let mut board = both();
    let mut head = [0; 32];
    head[..4].copy_from_slice(b"RGSs");
    head[4] = 2;
    let check = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&head[..28]);
    head[28..].copy_from_slice(&check.to_le_bytes());
    blank(&mut board);
    board.stores.iter_mut().for_each(|part| part.nor.write_now(FlashWord { sector: 0, word: 0 }, &head));
    let Chosen { slot, header, is_trial } = board.try_start().unwrap();
    assert_eq!((slot, header.version(), is_trial), (Slot::A, V1, false));
}
