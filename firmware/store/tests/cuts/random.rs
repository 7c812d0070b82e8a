//! Random changes, cut at random, thousands of times in a row: what was acknowledged is never lost.

use crate::SMALL;
use crate::bench::{Change, StoreBench, image, life};
use crate::model::TORN;

fn run(seed: u64, starts: u32) -> (u32, u32) {
    let mut bench = StoreBench::new(SMALL, TORN[seed as usize % TORN.len()]);
    let mut random = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut next = |of: u64| {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random % of
    };
    let mut changes = life(usize::MAX >> 54, &[10, 250, 600, 90]).into_iter();
    let (mut cuts, mut done) = (0, 0);
    for _ in 0..starts {
        // Often so early that nothing succeeds.
        let left = if next(3) == 0 { next(4) } else { next(120) };
        bench.flash.cut_after(left as u32, next(u64::MAX));
        loop {
            let change = match next(4) {
                0 => Change::Counter(next(3) as u8, next(u64::MAX)),
                1 => Change::BirthSequence(next(256) as u8),
                _ => changes.next().unwrap_or_else(|| Change::Keep {
                    number: 2_000 + next(100) as u32,
                    image: image(3, next(600) as usize),
                }),
            };
            if !bench.is_possible(&change) {
                continue;
            }
            let is_done = bench.attempt(&change);
            if bench.flash.is_off() {
                cuts += 1;
                bench.start_after_cut(&change);
                break;
            }
            assert!(is_done, "seed {seed}: {change:?}");
            done += 1;
            bench.expected = bench.expected.after(&change);
            bench.check();
        }
    }
    (cuts, done)
}

#[test]
fn what_the_flash_does_not_keep_is_written_again() {
    let (mut done, mut failed) = (0, 0);
    for torn in TORN {
        let mut bench = StoreBench::new(SMALL, torn);
        bench.flash.wear_out(40);
        for change in life(300, &[10, 250, 90]) {
            if !bench.is_possible(&change) {
                continue;
            }
            if bench.attempt(&change) {
                done += 1;
                bench.expected = bench.expected.after(&change);
            } else {
                failed += 1;
            }
            bench.check();
        }
    }
    println!("one write of 40 goes wrong: {done} changes done, {failed} refused");
    assert!(done > 900 && failed < 100, "{done} {failed}");
}

#[test]
fn random_changes_and_cuts() {
    let (mut cuts, mut done) = (0, 0);
    for seed in 0..40 {
        let (more_cuts, more_done) = run(seed, 250);
        (cuts, done) = (cuts + more_cuts, done + more_done);
    }
    println!("{cuts} cuts between {done} changes");
}
