//! Updates on a model of the flash, with the power cut at every operation.

mod board;
#[path = "../../../store/tests/cuts/model.rs"]
#[allow(dead_code, reason = "the tests of the store use all of it")]
mod model;
mod refused;
mod slots;
mod trial;

use board::SimulatedBoard;
use model::TORN;
use recipe_store::Geometry;
use recipe_update::Version;

const SMALL_SLOT: Geometry = Geometry { sectors: 2, words: 64 };
const SMALL_STORE: Geometry = Geometry { sectors: 3, words: 40 };
/// Of the STM32H743.
const SLOT: Geometry = Geometry { sectors: 4, words: 4096 };
const STORE: Geometry = Geometry { sectors: 2, words: 4096 };

const V2: Version = Version::new(0, 2, 0);
const V3: Version = Version::new(0, 3, 0);

/// Cuts the power at each operation of an update, or at one of `stride`, and in one of what follows; returns the
/// numbers of first and second cuts.
fn cut_everywhere(board: &SimulatedBoard, version: Version, stride: usize) -> (u32, u32) {
    let mut whole = board.clone();
    let before = whole.operations();
    whole.live_until(version);
    let steps = whole.operations() - before;
    let mut cuts = (0, 0);
    for cut in (0..steps).step_by(stride).chain(steps.saturating_sub(12)..steps) {
        let mut dead = board.clone();
        dead.cut_after(cut, u64::from(cut) << 8 | 0x55);
        dead.live_until(version);
        assert!(dead.is_off());
        cuts.0 += 1;
        for second in [cut * 7 % 20, cut * 5 % (steps + 3)] {
            let mut twice = dead.clone();
            twice.power();
            twice.start();
            twice.cut_after(second, u64::from(cut) << 16 | u64::from(second) << 3 | 5);
            twice.live_until(version);
            cuts.1 += u32::from(twice.is_off());
            twice.power();
            twice.live_until(version);
            twice.is_confirmed(version);
        }
    }
    cuts
}

#[test]
fn the_power_is_cut_at_every_operation_of_an_update() {
    let mut total = (0, 0);
    for torn in TORN {
        let mut board = SimulatedBoard::new(SMALL_SLOT, SMALL_STORE, torn, 1_900);
        for version in [V2, V3] {
            let cuts = cut_everywhere(&board, version, 1);
            total = (total.0 + cuts.0, total.1 + cuts.1);
            board.live_until(version);
            board.is_confirmed(version);
        }
    }
    println!("{} cuts, {} second cuts", total.0, total.1);
    assert!(total.0 > 500 && total.1 > 500, "{total:?}");
}

#[test]
fn the_slots_of_the_chip() {
    let mut board = SimulatedBoard::new(SLOT, STORE, model::Torn::Mixed, 300_000);
    let cuts = cut_everywhere(&board, V2, 997);
    println!("STM32H743: {} cuts, {} second cuts", cuts.0, cuts.1);
    board.live_until(V2);
    board.is_confirmed(V2);
}
