//! Firmware on trial that does not run as it should (docs/update.md section 4), made of the real one: it hangs, it
//! crashes, a person restarts it. The board goes back to the one before, and says how the trial has ended.

use recipe_chip_model::device::{MILLI, SECOND};
use recipe_update::{IMAGE_OFFSET, NUCLEO_H743ZI as BOARD, Slot};
use serde_json::Value;

use crate::Bench;
use crate::client::{exchange, signed};
use crate::slots::{SEED, board, firmware, header, is_up, new_robot, post, program, restarted, send, state};

/// b . (Armv7-M ARM A7.7.12)
const FOR_EVER: [u8; 2] = [0xFE, 0xE7];
/// udf #0 (A7.7.194)
const UNDEFINED: [u8; 2] = [0x00, 0xDE];
/// The function that starts timers: a task waits with it first when the board's watchdog runs.
const TIMER: &str = "embassy_time::timer::Timer>::after";
/// The program's first one, before its watchdog runs.
const MAIN: &str = "main";

/// Tries the firmware with this code in place of the beginning of a function, signed like any other, until the board
/// runs the one before again. Returns what it says then.
fn tried(bench: &mut Bench, function: &str, code: &[u8]) -> Value {
    let program = program(Slot::B);
    let place = program.symbol(function).or_else(|| program.function(&[function])).expect("it is there") & !1;
    let mut image = firmware(Slot::B).to_vec();
    let at = (place - BOARD.slot(Slot::B) - IMAGE_OFFSET) as usize;
    image[at..at + code.len()].copy_from_slice(code);
    let sent = send(bench, &header(Slot::B, &image, &SEED), &image);
    assert_eq!(sent["incoming"]["state"], "ready", "{sent}");
    post(bench, "try").must_be(202);
    bench.chip.resets.clear();
    bench.chip.faults.clear();
    restarted(bench);
    bench.until("three resets by the watchdog", 60 * SECOND, |bench| bench.chip.resets.len() == 3);
    new_robot(bench);
    is_up(bench);
    state(bench)
}

fn is_back(bench: &mut Bench, now: &Value) {
    assert_eq!(
        (now["slot"].as_str(), now["good"].as_str(), now["trial"].is_null()),
        (Some("A"), Some("A"), true),
        "{now}"
    );
    assert_eq!(
        (now["last"]["slot"].as_str(), now["last"]["ended"].as_str()),
        (Some("B"), Some("failed")),
        "{now}"
    );
    let request = signed(bench, "GET /api/v1/revisions");
    assert_eq!(exchange(bench, &request).must_be(200).json()["live"], 1);
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn a_firmware_that_hangs_on_trial_has_three_starts() {
    let mut bench = board();
    // Before it has a watchdog of its own, the loader's ends it.
    let now = tried(&mut bench, MAIN, &FOR_EVER);
    is_back(&mut bench, &now);
    let [first, second, third] = bench.chip.resets[..] else { panic!("{:?}", bench.chip.resets) };
    for (from, to) in [(first, second), (second, third)] {
        assert!((8 * SECOND..11 * SECOND).contains(&(to - from)), "{} ms", (to - from) / MILLI);
    }
    // And in a task.
    let now = tried(&mut bench, TIMER, &FOR_EVER);
    is_back(&mut bench, &now);
    let [first, second, third] = bench.chip.resets[..] else { panic!("{:?}", bench.chip.resets) };
    for (from, to) in [(first, second), (second, third)] {
        assert!((4 * SECOND..7 * SECOND).contains(&(to - from)), "{} ms", (to - from) / MILLI);
    }
    assert!(bench.has_logged("previous run: the watchdog was not fed"), "{}", bench.history());
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn a_firmware_that_crashes_on_trial_has_three_starts_and_its_last_words_are_told() {
    let mut bench = board();
    let now = tried(&mut bench, TIMER, &UNDEFINED);
    is_back(&mut bench, &now);
    assert_eq!(bench.chip.faults.len(), 3);
    let place = program(Slot::B).function(&[TIMER]).expect("it is there");
    assert!(bench.has_logged(&format!("previous run: panic at {place:08X}")), "{}", bench.history());
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn a_person_who_restarts_a_board_on_trial_uses_up_its_starts() {
    let mut bench = board();
    let image = firmware(Slot::B);
    send(&mut bench, &header(Slot::B, image, &SEED), image);
    post(&mut bench, "try").must_be(202);
    restarted(&mut bench);
    // Three starts: that one, and two after the plug was pulled.
    for start in 1..=3 {
        is_up(&mut bench);
        let now = state(&mut bench);
        assert_eq!(
            (now["slot"].as_str(), now["trial"].is_object()),
            (Some("B"), true),
            "start {start}: {now}"
        );
        bench.chip.cut_power();
        new_robot(&mut bench);
    }
    is_up(&mut bench);
    let now = state(&mut bench);
    is_back(&mut bench, &now);
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
}
