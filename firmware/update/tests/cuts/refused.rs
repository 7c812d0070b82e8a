//! What is refused before anything is erased, and what is found before the header is written.

use embassy_futures::block_on;
use recipe_store::{Flash as _, FlashWord, Slot};
use recipe_update::{
    BadImage, BoardName, Downgrade, FileError, Formats, Gap, Header, ImageFacts, Receive, ReceiveError,
    ReceiveStep, RunningFirmware, SlotMarks, UpdateFile, UpdateRefused, Version, begin_trial, may_keep,
};

use crate::board::{SEED, SimulatedBoard, V1, file, image, parts};
use crate::model::Torn;
use crate::{SMALL_SLOT, SMALL_STORE, V2, V3};

const LEN: usize = 1_500;

fn signed(parts: ImageFacts, len: usize) -> Header {
    Header::sign(parts, &image(parts.slot, parts.version, len), &SEED).unwrap()
}

#[track_caller]
fn refusal(
    parts: ImageFacts,
    len: usize,
    running: &RunningFirmware,
    marks: SlotMarks,
    downgrade: Downgrade,
) -> Option<UpdateRefused> {
    let board = SimulatedBoard::new(SMALL_SLOT, SMALL_STORE, Torn::Fault, LEN);
    Receive::begin(signed(parts, len), running, marks, downgrade, &board.slots[1]).err()
}

#[test]
fn updates_that_cannot_run_are_refused_before_anything_is_erased() {
    let running = SimulatedBoard::running(Slot::A, V2);
    let good = SlotMarks { good: Some(Slot::A), ..SlotMarks::default() };
    let refused = |parts, len| refusal(parts, len, &running, good, Downgrade::Refused);
    let right = parts(Slot::B, V3);
    assert_eq!(refused(right, LEN), None);
    assert_eq!(refused(parts(Slot::B, V2), LEN), None, "the same once more");
    assert_eq!(refused(parts(Slot::A, V3), LEN), Some(UpdateRefused::Bad(BadImage::Slot)));
    let board = BoardName::parse("mps2-an500").unwrap();
    assert_eq!(refused(ImageFacts { board, ..right }, LEN), Some(UpdateRefused::Bad(BadImage::Board(board))));
    let room = 2 * 64 * 32 - 1024;
    assert_eq!(refused(right, room as usize), None);
    let long = BadImage::Long { length: room + 1, room };
    assert_eq!(refused(right, room as usize + 1), Some(UpdateRefused::Bad(long)));
    assert_eq!(refused(ImageFacts { store: 2, ..right }, LEN), Some(UpdateRefused::Store { offered: 2 }));
}

#[test]
fn a_downgrade_has_to_be_asked_for() {
    let running = SimulatedBoard::running(Slot::A, V2);
    let good = SlotMarks { good: Some(Slot::A), ..SlotMarks::default() };
    let older = parts(Slot::B, V1);
    let error = UpdateRefused::Older { offered: V1, running: V2 };
    assert_eq!(refusal(older, LEN, &running, good, Downgrade::Refused), Some(error));
    assert_eq!(refusal(older, LEN, &running, good, Downgrade::Allowed), None);
    // It still has to read the configuration.
    let formats = Formats::new(1, 2, 2).unwrap();
    let error = UpdateRefused::Format { kept: 3, reads: formats };
    assert_eq!(
        refusal(ImageFacts { formats, ..older }, LEN, &running, good, Downgrade::Allowed),
        Some(error)
    );
}

#[test]
fn an_update_reads_every_configuration_that_may_run() {
    let good = SlotMarks { good: Some(Slot::A), ..SlotMarks::default() };
    let refused = |kept, oldest, newest, written| {
        let formats = Formats::new(oldest, newest, written).unwrap();
        let running = RunningFirmware { kept, ..SimulatedBoard::running(Slot::A, V2) };
        refusal(ImageFacts { formats, ..parts(Slot::B, V3) }, LEN, &running, good, Downgrade::Refused)
    };
    assert_eq!(refused(Some((1, 3)), 1, 4, 4), None);
    assert_eq!(refused(None, 9, 9, 9), None, "a board without a configuration");
    for (kept, oldest, newest) in [((1, 3), 2, 4), ((3, 3), 4, 4), ((1, 4), 1, 3)] {
        assert!(
            matches!(refused(Some(kept), oldest, newest, newest), Some(UpdateRefused::Format { .. })),
            "{kept:?}"
        );
    }
}

#[test]
fn while_a_firmware_is_on_trial_both_read_what_is_kept() {
    let [old, new] = [Formats::new(1, 3, 3).unwrap(), Formats::new(2, 4, 4).unwrap()];
    let good = SlotMarks { good: Some(Slot::A), ..SlotMarks::default() };
    let trial = begin_trial(good, Slot::B, 60, 0);
    for (version, on_trial, confirmed) in
        [(1, false, false), (2, true, true), (3, true, true), (4, false, true), (5, false, false)]
    {
        assert_eq!(may_keep(version, &new, Some(&old), trial), on_trial, "{version}");
        assert_eq!(may_keep(version, &new, Some(&old), good), confirmed, "{version}");
        assert_eq!(may_keep(version, &new, None, trial), confirmed, "{version}: there is no way back");
    }
}

#[test]
fn the_way_back_is_never_overwritten() {
    let running = SimulatedBoard::running(Slot::A, V2);
    let good = SlotMarks { good: Some(Slot::A), ..SlotMarks::default() };
    let refused = |marks| refusal(parts(Slot::B, V3), LEN, &running, marks, Downgrade::Refused);
    assert_eq!(refused(begin_trial(good, Slot::B, 60, 0)), Some(UpdateRefused::OnTrial));
    // The running one is on trial, and the other the good one.
    let marks = SlotMarks { good: Some(Slot::B), ..SlotMarks::default() };
    assert_eq!(refused(begin_trial(marks, Slot::A, 60, 0)), Some(UpdateRefused::OnTrial));
    assert_eq!(refused(marks), Some(UpdateRefused::NotGood));
    assert_eq!(refused(SlotMarks::default()), Some(UpdateRefused::NotGood));
}

/// Follows all steps with the bytes of this image; how it ended.
fn follow(board: &mut SimulatedBoard, receive: &mut Receive, image: &[u8]) -> Result<(), ReceiveError> {
    let part = &mut board.slots[1];
    loop {
        match receive.next(part) {
            ReceiveStep::Erase(sector) => block_on(part.erase(sector)),
            ReceiveStep::Write(place, word) => block_on(part.write(place, &word)),
            ReceiveStep::Take { offset } => {
                assert_eq!(receive.take(offset + 1, image), Err(Gap { expected: offset }));
                if offset > 0 {
                    assert_eq!(receive.take(offset - 1, image), Err(Gap { expected: offset }));
                }
                let taken = receive.take(offset, &image[offset as usize..]).unwrap();
                assert!((1..=32).contains(&taken));
                assert_eq!(receive.taken(), offset + taken as u32);
            }
            ReceiveStep::Again => {}
            ReceiveStep::End(result) => return result,
        }
    }
}

fn begun(len: usize) -> (SimulatedBoard, Receive) {
    let board = SimulatedBoard::new(SMALL_SLOT, SMALL_STORE, Torn::Fault, len);
    let running = SimulatedBoard::running(Slot::A, V1);
    let header = signed(parts(Slot::B, V2), len);
    let receive =
        Receive::begin(header, &running, board.marks(), Downgrade::Refused, &board.slots[1]).unwrap();
    (board, receive)
}

#[test]
fn images_of_every_length_arrive() {
    for len in (1..100).chain([1_023, 1_024, 1_025, 3_071, 3_072]) {
        let (mut board, mut receive) = begun(len);
        assert_eq!(follow(&mut board, &mut receive, &image(Slot::B, V2, len)), Ok(()), "{len}");
        assert!(board.write_marks(begin_trial(board.marks(), Slot::B, 60, 0)));
        let chosen = board.start();
        assert_eq!((chosen.slot, chosen.header.length()), (Slot::B, len as u32));
    }
}

#[test]
fn another_image_has_no_header() {
    let (mut board, mut receive) = begun(LEN);
    let mut changed = image(Slot::B, V2, LEN);
    changed[LEN - 1] ^= 1;
    assert_eq!(follow(&mut board, &mut receive, &changed), Err(ReceiveError::Bad(BadImage::Crc)));
    assert_eq!(receive.next(&board.slots[1]), ReceiveStep::End(Err(ReceiveError::Bad(BadImage::Crc))));
    let header = (0..6).map(|word| board.slots[1].read(FlashWord { sector: 0, word }));
    assert!(header.into_iter().all(|word| word == [0xFF; 32]));
}

#[test]
fn a_word_that_is_not_kept_ends_it() {
    let (mut board, mut receive) = begun(LEN);
    board.slots[1].nor.wear_out(20);
    let error = follow(&mut board, &mut receive, &image(Slot::B, V2, LEN)).unwrap_err();
    assert!(matches!(error, ReceiveError::Worn(_)), "{error}");
}

#[test]
fn a_file_has_the_same_firmware_for_each_slot() {
    let link = |slot, version, len| (signed(parts(slot, version), len), image(slot, version, len));
    let (a, b) = (link(Slot::A, V2, LEN), link(Slot::B, V2, LEN + 1));
    let bytes = file(&[b.clone(), a.clone()]);
    let read = UpdateFile::parse(&bytes).unwrap();
    assert_eq!(read.links().map(|link| link.header.slot()).collect::<Vec<_>>(), Slot::ALL);
    for (slot, (header, image)) in [(Slot::A, &a), (Slot::B, &b)] {
        let link = read.link(slot).unwrap();
        assert_eq!((link.header, link.image, *link.header_bytes), (*header, &image[..], header.encode()));
        assert_eq!(link.check(), Ok(()));
    }
    for (links, error) in [
        (vec![], FileError::Links { found: 0 }),
        (vec![a.clone(), b.clone(), a.clone()], FileError::Links { found: 3 }),
        (vec![a.clone(), a.clone()], FileError::Twice { slot: Slot::A }),
        (vec![a.clone(), link(Slot::B, V3, LEN)], FileError::Different),
    ] {
        assert_eq!(UpdateFile::parse(&file(&links)).unwrap_err(), error);
    }
    for cut in 0..bytes.len() {
        assert!(UpdateFile::parse(&bytes[..cut]).is_err(), "{cut}");
    }
    let longer = [&bytes[..], &[0xFF]].concat();
    assert!(matches!(UpdateFile::parse(&longer), Err(FileError::Length { .. })));
    let mut changed = bytes.clone();
    let last = changed.len() - 1;
    changed[last] = 0;
    assert_eq!(UpdateFile::parse(&changed), Err(FileError::Image { slot: Slot::A }));
    let mut changed = bytes;
    changed[16 + 192 + 5] ^= 1;
    let read = UpdateFile::parse(&changed).unwrap();
    assert_eq!(read.link(Slot::B).unwrap().check(), Err(BadImage::Crc));
    assert_eq!(Version::parse("0.2.0"), Some(V2));
}
