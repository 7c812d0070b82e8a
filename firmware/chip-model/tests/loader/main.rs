//! The NUCLEO-H743ZI2's loader, unchanged, on the modelled chip, with small programs in the slots (docs/update.md).
//! Each test needs the emulator's library and the loader built for the key of `SEED` (`CHIP_UNICORN`, `CHIP_LOADER`).

mod bench;
mod image;

use bench::{GOOD_A, LoaderBench, mark_b};
use image::{Image, ProgramKind};
use recipe_chip_model::device::{MILLI, SECOND};
use recipe_chip_model::models::flash::Torn;
use recipe_update::{NUCLEO_H743ZI as BOARD, Slot, SlotMarks, TrialEnd};

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_LOADER"]
fn the_good_slot_runs_as_after_a_reset() {
    let mut bench = LoaderBench::new();
    bench.put(Slot::A, &Image::new(Slot::A, ProgramKind::Stay));
    bench.mark(GOOD_A);
    assert_eq!(bench.runs(), Slot::A);
    let [_, vectors, stack] = bench.left();
    assert_eq!((vectors, stack), (BOARD.slot(Slot::A) + 1024, image::STACK));
    let watchdog = &bench.chip.devices().watchdog;
    assert!(watchdog.is_running() && (8 * SECOND..9 * SECOND).contains(&watchdog.period()));
    let took = bench.chip.now();
    println!("{} ms until it runs, {} instructions", took / MILLI, bench.chip.instructions());
    assert_eq!(bench.chip.devices().flash.operations(), 0, "nothing is written");
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_LOADER"]
fn the_first_firmware_becomes_the_good_one() {
    for slot in Slot::ALL {
        let mut bench = LoaderBench::new();
        bench.put(slot, &Image::new(slot, ProgramKind::Stay));
        assert_eq!(bench.runs(), slot);
        let took = bench.chip.now();
        println!("{} ms until it runs, {} instructions", took / MILLI, bench.chip.instructions());
        assert_eq!(bench.marks(), SlotMarks { good: Some(slot), ..SlotMarks::default() });
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_LOADER"]
fn a_firmware_that_restarts_or_hangs_on_trial_has_three_starts() {
    for does in [ProgramKind::Restart, ProgramKind::Hang] {
        let mut bench = LoaderBench::new();
        bench.put(Slot::A, &Image::new(Slot::A, ProgramKind::Stay));
        bench.put(Slot::B, &Image::new(Slot::B, does));
        bench.mark(mark_b(3));
        assert_eq!(bench.runs(), Slot::A);
        let ended = if does == ProgramKind::Hang { &bench.chip.resets } else { &bench.chip.restarts };
        assert_eq!(ended.len(), 3);
        let last = Some((Slot::B, TrialEnd::Failed));
        assert_eq!(bench.marks(), SlotMarks { good: Some(Slot::A), trial: None, last });
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_LOADER"]
fn what_is_damaged_or_foreign_is_passed_over() {
    let mut bench = LoaderBench::new();
    let mut foreign = Image::new(Slot::B, ProgramKind::Stay);
    foreign.sign(&[9; 32]);
    bench.put(Slot::A, &Image::new(Slot::A, ProgramKind::Stay));
    bench.put(Slot::B, &foreign);
    bench.mark(mark_b(3));
    assert_eq!(bench.runs(), Slot::A);
    assert_eq!(bench.marks().last, Some((Slot::B, TrialEnd::Failed)));
    // A word of the good one cannot be read.
    bench.put(Slot::B, &Image::new(Slot::B, ProgramKind::Stay));
    bench.chip.tear(BOARD.slot(Slot::A) + 1024 + 20 * 32).expect("there is flash");
    bench.begin_again();
    assert_eq!(bench.runs(), Slot::B);
    assert_eq!(bench.marks().good, Some(Slot::B));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_LOADER"]
fn where_nothing_can_run_the_lamp_blinks() {
    let mut bench = LoaderBench::new();
    bench.chip.tear(BOARD.slot(Slot::A)).expect("there is flash");
    bench.run(2 * SECOND);
    let led = bench.red_led();
    assert!(led.len() > 3 && led.windows(2).all(|pair| pair[0].1 != pair[1].1), "{led:?}");
    assert!(
        led.windows(2).all(|pair| (200 * MILLI..700 * MILLI).contains(&(pair[1].0 - pair[0].0))),
        "{led:?}"
    );
    assert!(bench.chip.resets.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_LOADER"]
fn the_power_is_cut_at_every_operation_of_a_trial() {
    // One chip for all: a new one would translate the loader again.
    let mut bench = LoaderBench::new();
    let (stays, restarts) =
        (Image::new(Slot::A, ProgramKind::Stay), Image::new(Slot::B, ProgramKind::Restart));
    let prepare = |bench: &mut LoaderBench| {
        bench.blank();
        bench.put(Slot::A, &stays);
        bench.put(Slot::B, &restarts);
        bench.mark(mark_b(3));
        bench.begin_again();
    };
    prepare(&mut bench);
    let before = bench.chip.devices().flash.operations();
    assert_eq!(bench.runs(), Slot::A);
    let operations = bench.chip.devices().flash.operations() - before;
    for leaves in [Torn::Fault, Torn::Blank, Torn::Half] {
        for cut in 1..=operations {
            prepare(&mut bench);
            let before = bench.chip.devices().flash.operations();
            bench.chip.devices().flash.leaves = leaves;
            bench.chip.devices().flash.fails_during = Some(before + cut);
            assert_eq!(bench.runs(), Slot::A, "{leaves:?}, cut {cut}");
            assert_eq!(bench.chip.power_cuts, 1, "{leaves:?}, cut {cut}");
            assert!((2..=4).contains(&bench.chip.restarts.len()), "{leaves:?}, cut {cut}");
            let marks = bench.marks();
            assert_eq!((marks.good, marks.trial), (Some(Slot::A), None), "{leaves:?}, cut {cut}");
        }
    }
    println!("{operations} operations");
}
