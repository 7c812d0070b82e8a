//! Another firmware over the network (docs/update.md), with the loader, in both slots: sent, tried, confirmed, taken
//! back; refused; and what does not run.

use recipe_chip_model::device::{MILLI, SECOND};
use recipe_config::SimConfig;
use recipe_update::{IMAGE_OFFSET, NUCLEO_H743ZI as BOARD, Slot};

use crate::client::{exchange, signed};
use crate::robot::Robot;
use crate::slots::{SEED, after, board, firmware, header, is_up, post, put, restarted, send, state};

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn a_firmware_is_sent_tried_and_confirms_itself_and_the_next_is_taken_back() {
    let mut bench = board();
    let begin = bench.now();
    let before = state(&mut bench);
    assert_eq!((before["slot"].as_str(), before["good"].as_str()), (Some("A"), Some("A")), "{before}");
    let image = firmware(Slot::B);
    let ready = send(&mut bench, &header(Slot::B, image, &SEED), image);
    assert_eq!(ready["incoming"]["state"], "ready", "{ready}");
    println!("{} bytes in {} ms", image.len(), (bench.now() - begin) / MILLI);
    assert_eq!(bench.chip.resets.len() + bench.chip.restarts.len(), 0);
    let tried = bench.now();
    post(&mut bench, "try").must_be(202);
    restarted(&mut bench);
    is_up(&mut bench);
    println!("again with the controller after {} ms", (bench.now() - tried) / MILLI);
    let on_trial = after(&mut bench, "");
    assert_eq!((on_trial["slot"].as_str(), on_trial["good"].as_str()), (Some("B"), Some("A")), "{on_trial}");
    assert!(on_trial["trial"]["left_s"].as_f64().is_some_and(|left| left < 60.0), "{on_trial}");
    assert!(bench.has_logged("the store is moved out of the bank"));
    // By itself.
    bench.until_log("the firmware is confirmed", 30 * SECOND);
    let kept = state(&mut bench);
    assert_eq!(
        (kept["good"].as_str(), kept["last"]["ended"].as_str()),
        (Some("B"), Some("confirmed")),
        "{kept}"
    );
    assert!(kept["trial"].is_null());
    // The configuration came along.
    let request = signed(&mut bench, "GET /api/v1/revisions");
    assert_eq!(exchange(&mut bench, &request).must_be(200).json()["live"], 1);
    post(&mut bench, "back").must_be(409);
    // From B to A, and back by a person.
    let image = firmware(Slot::A);
    assert_eq!(send(&mut bench, &header(Slot::A, image, &SEED), image)["incoming"]["state"], "ready");
    post(&mut bench, "try").must_be(202);
    restarted(&mut bench);
    is_up(&mut bench);
    assert_eq!(state(&mut bench)["slot"], "A");
    post(&mut bench, "back").must_be(202);
    restarted(&mut bench);
    is_up(&mut bench);
    let back = state(&mut bench);
    assert_eq!(
        (back["slot"].as_str(), back["last"]["ended"].as_str()),
        (Some("B"), Some("taken_back")),
        "{back}"
    );
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn what_is_changed_or_foreign_never_runs() {
    let mut bench = board();
    let image = firmware(Slot::B);
    // Linked for the slot that runs.
    put(&mut bench, 0, &header(Slot::A, image, &SEED).encode()).must_be(422);
    put(&mut bench, 192, &image[..64]).must_be(409);
    let mut changed = image.to_vec();
    changed[1_000] ^= 4;
    let failed = send(&mut bench, &header(Slot::B, image, &SEED), &changed);
    assert_eq!(failed["incoming"]["state"], "failed", "{failed}");
    post(&mut bench, "try").must_be(409);
    assert_eq!(send(&mut bench, &header(Slot::B, image, &[9; 32]), image)["incoming"]["state"], "ready");
    let refused = post(&mut bench, "try").must_be(422).json();
    assert!(refused["error"].as_str().is_some_and(|why| why.contains("not signed")), "{refused}");
    restarted(&mut bench);
    is_up(&mut bench);
    let still = state(&mut bench);
    assert_eq!((still["slot"].as_str(), still["trial"].is_null()), (Some("A"), true), "{still}");
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn a_firmware_without_its_controller_is_taken_back_and_so_is_one_that_restarts() {
    let mut bench = board();
    let image = firmware(Slot::B);
    send(&mut bench, &header(Slot::B, image, &SEED), image);
    post(&mut bench, "try").must_be(202);
    bench.robot = None;
    restarted(&mut bench);
    bench.until_log("this firmware is on trial", 20 * SECOND);
    bench.until_log("was not confirmed in time: back to the one before", 70 * SECOND);
    restarted(&mut bench);
    bench.robot = Some(Robot::new(&SimConfig::default()));
    is_up(&mut bench);
    let back = state(&mut bench);
    assert_eq!(
        (back["slot"].as_str(), back["last"]["ended"].as_str()),
        (Some("A"), Some("not_confirmed")),
        "{back}"
    );
    // A program that asks for a reset at once (Armv7-M ARM A7.7): ldr r0, [pc, #4]; ldr r1, [pc, #8]; str r1, [r0]; b .
    let code: [u16; 4] = [0x4801, 0x4902, 0x6001, 0xE7FE];
    let start = BOARD.slot(Slot::B) + IMAGE_OFFSET;
    let mut crash = [0x2002_0000_u32, start + 9].map(u32::to_le_bytes).concat();
    crash.extend(code.iter().flat_map(|half| half.to_le_bytes()));
    crash.extend([0xE000_ED0C_u32, 0x05FA_0004].iter().flat_map(|word| word.to_le_bytes()));
    crash.resize(8 << 10, 0);
    let restarts = bench.chip.restarts.len();
    send(&mut bench, &header(Slot::B, &crash, &SEED), &crash);
    post(&mut bench, "try").must_be(202);
    restarted(&mut bench);
    is_up(&mut bench);
    let back = state(&mut bench);
    assert_eq!(
        (back["slot"].as_str(), back["last"]["ended"].as_str()),
        (Some("A"), Some("failed")),
        "{back}"
    );
    assert_eq!(bench.chip.restarts.len() - restarts, 4, "one of the firmware, and three starts");
}
