//! The power is cut at every operation of the flash, and once more after that.

mod bench;
mod compared;
mod model;
mod random;
mod relocate;
mod room;

use bench::{Change, StoreBench, Totals, life};
use model::TORN;
use recipe_store::Geometry;

/// Of the STM32H743.
const SECTORS: Geometry = Geometry { sectors: 2, words: 4096 };
/// Small, so that sectors are changed all the time.
const SMALL: Geometry = Geometry { sectors: 3, words: 160 };
const TWO: Geometry = Geometry { sectors: 2, words: 256 };

/// Every operation of these changes, for every way in which a word can be torn.
fn cut_everywhere(name: &str, geometry: Geometry, changes: &[Change], restarts: bool) -> Totals {
    let mut totals = Totals::default();
    for torn in TORN {
        let mut bench = StoreBench::new(geometry, torn);
        for (nth, change) in changes.iter().enumerate() {
            if restarts {
                bench.restart();
            }
            bench.cut_everywhere(change, changes.get(nth + 1), nth as u64, restarts, &mut totals);
            bench.execute(change);
        }
    }
    println!("{name}: {totals}");
    totals
}

#[test]
fn small_sectors() {
    let totals = cut_everywhere("small sectors", SMALL, &life(150, &[300, 40, 0, 500, 96]), false);
    assert!(totals.cuts > 1_500 && totals.erase_cuts > 100, "{totals}");
}

#[test]
fn small_sectors_with_a_restart_before_each_change() {
    let totals = cut_everywhere("small sectors, restarts", SMALL, &life(150, &[300, 40, 0, 500, 96]), true);
    assert!(totals.cuts > 1_500 && totals.refused > 100, "{totals}");
}

#[test]
fn two_sectors() {
    cut_everywhere("two sectors", TWO, &life(40, &[200, 64, 33]), true);
}

#[test]
fn the_sectors_of_the_chip() {
    let totals = cut_everywhere("STM32H743", SECTORS, &life(24, &[2_000, 400]), true);
    assert!(totals.cuts > 800 && totals.new > 0, "{totals}");
}
