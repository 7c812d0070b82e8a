//! Hangs, faults and panics: the watchdog resets the chip, and the crash record is logged.

use recipe_chip_model::device::{MILLI, Picos, SECOND};

use crate::Bench;
use crate::boot::CELL;

const FOR_EVER: [u8; 2] = [0xFE, 0xE7];
const UNDEFINED: [u8; 2] = [0x00, 0xDE];
/// cpsid i; b .
const MASKED: [u8; 4] = [0x72, 0xB6, 0xFE, 0xE7];
/// push {r4-r7, lr}; b back.
const OVERFLOW: [u8; 4] = [0xF0, 0xB5, 0xFD, 0xE7];
/// cmp r0, r0; it ne; movne r0, #3; b back. At its address the emulator ends a basic block after `it`.
const IT_BLOCKS: [u8; 8] = [0x80, 0x42, 0x18, 0xBF, 0x03, 0x20, 0xFB, 0xE7];
const IT_BLOCKS_AT: u32 = 0x080F_FC00 - 4;
/// movw r0, #0xFBFD; movt r0, #0x080F; bx r0: jumps there.
const TO_IT_BLOCKS: [u8; 10] = [0x4F, 0xF6, 0xFD, 0x30, 0xC0, 0xF6, 0x0F, 0x00, 0x00, 0x47];

/// Patches `code` into the function that starts timers; returns the time.
fn break_it(bench: &mut Bench, code: &[u8]) -> Picos {
    bench.run(3 * SECOND);
    let place = bench.chip.program().function(&["embassy_time::timer::Timer>::after"]);
    let place = place.expect("the firmware waits");
    bench.chip.patch(place, code);
    bench.now()
}

/// Checks that the reset comes four seconds after the last feed.
fn check_reset(bench: &mut Bench, broken: Picos) {
    bench.until("a reset", 6 * SECOND, |bench| bench.chip.resets.len() == 1);
    let fed = bench.chip.devices().watchdog.feeds.iter().copied().filter(|at| *at <= broken + SECOND).max();
    let waited = bench.chip.resets[0] - fed.expect("it was fed");
    assert!((3_990 * MILLI..4_010 * MILLI).contains(&waited), "{} ms", waited / MILLI);
    bench.until_log("restarted by the watchdog", 100 * MILLI);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn it_feeds_its_watchdog_and_nothing_else_resets_it() {
    let mut bench = Bench::new(CELL).with_robot();
    bench.run(30 * SECOND);
    assert!(bench.chip.resets.is_empty() && bench.chip.faults.is_empty());
    let watchdog = &bench.chip.devices().watchdog;
    assert!((3_990 * MILLI..4_010 * MILLI).contains(&watchdog.period()));
    let gaps = watchdog.feeds.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(gaps.clone().all(|gap| gap <= 1_010 * MILLI), "{:?}", gaps.max());
    assert_eq!(watchdog.feeds.len(), 29);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_task_that_hangs_is_named() {
    let mut bench = Bench::new(CELL);
    let broken = break_it(&mut bench, &FOR_EVER);
    check_reset(&mut bench, broken);
    bench.until_log("previous run: the watchdog was not fed, task ", 100 * MILLI);
    // Then it runs normally.
    bench.run(10 * SECOND);
    assert_eq!(bench.chip.resets.len(), 1);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_hang_without_interrupts_has_no_words_and_does_not_repeat_old_ones() {
    let mut bench = Bench::new(CELL);
    let broken = break_it(&mut bench, &FOR_EVER);
    check_reset(&mut bench, broken);
    bench.until_log("previous run: ", 100 * MILLI);
    break_it(&mut bench, &MASKED);
    bench.until("another reset", 6 * SECOND, |bench| bench.chip.resets.len() == 2);
    bench.until_log("restarted by the watchdog", 100 * MILLI);
    bench.run(SECOND);
    assert_eq!(bench.times_logged("previous run"), 1, "{}", bench.history());
}

/// If the state of the IT block were kept, the first instruction of the handler would not be executed.
#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn an_interrupt_within_an_it_block_does_no_harm() {
    let mut bench = Bench::new(CELL);
    bench.chip.patch(IT_BLOCKS_AT, &IT_BLOCKS);
    let broken = break_it(&mut bench, &TO_IT_BLOCKS);
    let before = bench.chip.interrupts();
    bench.run(SECOND);
    assert!(bench.chip.faults.is_empty(), "{}", bench.history());
    assert!(bench.chip.interrupts() > before + 10, "nothing interrupts it");
    check_reset(&mut bench, broken);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn an_instruction_that_there_is_not_is_told_with_its_place() {
    let mut bench = Bench::new(CELL);
    let place = bench.chip.program().function(&["embassy_time::timer::Timer>::after"]).expect("it is there");
    let broken = break_it(&mut bench, &UNDEFINED);
    bench.run(SECOND);
    assert_eq!(bench.chip.devices().gpio[1].output(14), Some(true), "LD3 is lit");
    check_reset(&mut bench, broken);
    bench.until_log(&format!("previous run: panic at {place:08X}, from 08"), 100 * MILLI);
    assert!(bench.has_logged("CFSR 00010000, task "), "{}", bench.history());
    assert_eq!(bench.chip.devices().gpio[1].output(14), Some(false));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_stack_overflow_meets_the_guard() {
    let mut bench = Bench::new(CELL);
    let broken = break_it(&mut bench, &OVERFLOW);
    bench.run(SECOND);
    assert_eq!(bench.chip.faults.len(), 1);
    check_reset(&mut bench, broken);
    bench.until_log("previous run: fault at ", 100 * MILLI);
    // The part of the frame in the guard, below 0x20004000, could not be written.
    assert!(bench.has_logged("CFSR 00000092, address 20003F"), "{}", bench.history());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_fault_before_the_watchdog_runs_is_followed_by_a_reset_too() {
    let mut bench = Bench::new(CELL);
    let place = bench.chip.program().symbol("main").expect("the program begins") & !1;
    bench.chip.patch(place, &UNDEFINED);
    bench.until("a reset", SECOND, |bench| bench.chip.resets.len() == 1);
    bench.until_log(&format!("previous run: panic at {place:08X}"), 100 * MILLI);
    bench.run(5 * SECOND);
    assert_eq!(bench.chip.resets.len(), 1);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_panic_is_told_twice() {
    let mut bench = Bench::new(CELL);
    let panics =
        bench.chip.program().function(&["core::option::unwrap_failed"]).expect("something can panic");
    let place = bench.chip.program().function(&["embassy_time::timer::Timer>::after"]).expect("it is there");
    let broken = break_it(&mut bench, &jump(place, panics));
    bench.until_log("error: panicked at", SECOND);
    check_reset(&mut bench, broken);
    bench.until_log("previous run: panic at 08", 100 * MILLI);
}

/// B.W, encoding T4 (Armv7-M ARM A7.7.12).
fn jump(from: u32, to: u32) -> [u8; 4] {
    let offset = to.wrapping_sub(from + 4);
    let (sign, high, low) = (offset >> 24 & 1, offset >> 12 & 0x3FF, offset >> 1 & 0x7FF);
    let j = |place: u32| !(offset >> place) & 1 ^ sign;
    let first = 0xF000 | sign << 10 | high;
    let second = 0x9000 | j(23) << 13 | j(22) << 11 | low;
    let [a, b] = (first as u16).to_le_bytes();
    let [c, d] = (second as u16).to_le_bytes();
    [a, b, c, d]
}
