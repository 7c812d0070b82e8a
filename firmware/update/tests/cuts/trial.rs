//! Trials that are not confirmed: the good firmware comes back, whatever is cut on the way.

use recipe_store::{Slot, TrialEnd};
use recipe_update::{STARTS, begin_trial, confirm, end_trial};

use crate::board::{SimulatedBoard, V1};
use crate::model::{TORN, Torn};
use crate::{SMALL_SLOT, SMALL_STORE, V2};

fn on_trial(torn: Torn) -> SimulatedBoard {
    let mut board = SimulatedBoard::new(SMALL_SLOT, SMALL_STORE, torn, 1_500);
    board.probe(Slot::B, V2);
    assert!(board.write_marks(begin_trial(board.marks(), Slot::B, 60, 0)));
    board
}

#[test]
fn a_firmware_that_never_confirms_has_so_many_starts() {
    let mut board = on_trial(Torn::Fault);
    for left in (0..STARTS).rev() {
        let chosen = board.start();
        assert_eq!((chosen.slot, chosen.is_trial, chosen.header.version()), (Slot::B, true, V2));
        assert_eq!(board.marks().trial.unwrap().attempts, left);
    }
    for _ in 0..3 {
        let chosen = board.start();
        assert_eq!((chosen.slot, chosen.is_trial, chosen.header.version()), (Slot::A, false, V1));
        let marks = board.marks();
        assert_eq!(
            (marks.good, marks.trial, marks.last),
            (Some(Slot::A), None, Some((Slot::B, TrialEnd::Failed)))
        );
    }
}

#[test]
fn every_start_of_a_trial_may_be_cut() {
    let mut cuts = 0;
    for torn in TORN {
        for left in 0..40 {
            let mut board = on_trial(torn);
            let (mut trials, mut starts) = (0, 0);
            loop {
                board.cut_after(left, left.into());
                let chosen = board.try_start();
                if board.is_off() {
                    cuts += 1;
                } else if chosen.unwrap().is_trial {
                    trials += 1;
                } else {
                    break;
                }
                board.power();
                board.start();
                starts += 1;
                assert!(starts < 10, "{torn:?}, {left}");
            }
            board.power();
            assert!(trials <= u32::from(STARTS));
            assert_eq!(board.start().slot, Slot::A);
        }
    }
    println!("{cuts} cuts");
    assert!(cuts > 30);
}

#[test]
fn a_trial_ends_when_somebody_says_so() {
    let mut board = on_trial(Torn::Fault);
    board.start();
    assert_eq!(confirm(board.marks(), Slot::A), None, "it does not run on trial");
    let marks = end_trial(board.marks(), TrialEnd::TakenBack).unwrap();
    assert!(board.write_marks(marks));
    assert_eq!(board.start().slot, Slot::A);
    assert_eq!(board.marks().last, Some((Slot::B, TrialEnd::TakenBack)));
    assert_eq!((end_trial(board.marks(), TrialEnd::Failed), confirm(board.marks(), Slot::B)), (None, None));
}

#[test]
fn a_start_that_cannot_be_counted_is_no_trial() {
    let mut board = on_trial(Torn::Fault);
    board.stores.iter_mut().for_each(|part| part.nor.wear_out(1));
    assert_eq!(board.try_start().unwrap().slot, Slot::A);
    assert_eq!(board.told, ["B: its start cannot be counted"]);
}
