//! The power cut in the operations of the flash of a whole update (docs/update.md section 5), with the loader and the
//! firmware as they are.
//!
//! One update from slot A to slot B is recorded. The flash that a cut leaves is made from what was recorded, and a
//! board starts with it: it has to run something whole, with its configuration, and to finish the update.
//!
//! With `CHIP_CUTS=N` all operations are cut that are no plain word of the image, and N of those, with every kind of
//! torn word; for each stage and kind one board finishes its update. `CHIP_CUTS_FROM=M` leaves out what comes before
//! operation M. Without `CHIP_CUTS` the kinds take turns. Of the stages after which the loader checks a whole firmware,
//! which takes long here, only the last operation is cut then; those boards finish, and one that is sent all again.

use std::collections::BTreeSet;

use recipe_chip_model::device::{MILLI, SECOND};
use recipe_chip_model::models::flash::{Contents, FlashOperation, Torn};
use recipe_update::{IMAGE_OFFSET, NUCLEO_H743ZI as BOARD, Slot};

use crate::Bench;
use crate::client::{exchange, signed};
use crate::slots::{SEED, board, firmware, header, is_up, new_robot, post, restarted, send, state};

const ALL: &str = "CHIP_CUTS";
/// Operations before this one are not cut.
const FROM: &str = "CHIP_CUTS_FROM";
/// Words of the image that are cut without that variable.
const WORDS: usize = 3;
const KINDS: [Torn; 3] = [Torn::Fault, Torn::Blank, Torn::Half];
const FLASH: u32 = 0x0800_0000;

/// Stage of the update that an operation belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum CutStage {
    /// The slot is erased.
    Erase,
    /// A word of the image.
    Image,
    /// A word of the header.
    Header,
    /// The mark of the trial.
    Mark,
    /// The loader counts a start.
    Start,
    /// The store is moved.
    Move,
    /// The mark of the confirmation.
    Confirm,
}

/// An update.
struct Recorded {
    before: Contents,
    operations: Vec<FlashOperation>,
    /// So many operations until the firmware was whole, until it was to be tried, and until the trial ran.
    whole: usize,
    marked: usize,
    moved: usize,
}

impl Recorded {
    fn new(bench: &mut Bench) -> Self {
        let before = bench.chip.devices().flash.contents().clone();
        let begun = bench.chip.devices().flash.operations();
        bench.chip.devices().flash.journal = Some(Vec::new());
        let count = |bench: &mut Bench| (bench.chip.devices().flash.operations() - begun) as usize;
        let image = firmware(Slot::B);
        assert_eq!(send(bench, &header(Slot::B, image, &SEED), image)["incoming"]["state"], "ready");
        let whole = count(bench);
        post(bench, "try").must_be(202);
        restarted(bench);
        let marked = count(bench);
        is_up(bench);
        // It answers once the store is moved.
        assert_eq!(state(bench)["slot"], "B");
        let moved = count(bench);
        bench.until_log("the firmware is confirmed", 30 * SECOND);
        bench.run(100 * MILLI);
        let operations = bench.chip.devices().flash.journal.take().expect("it was noted");
        Self { before, operations, whole, marked, moved }
    }

    fn stage(&self, nth: usize) -> CutStage {
        let image = BOARD.slot(Slot::B) + IMAGE_OFFSET - FLASH;
        let first_of_move = |operation: &FlashOperation| matches!(operation, FlashOperation::Erase { .. });
        let counted = self.operations[self.marked..].iter().position(first_of_move).expect("it is moved");
        match self.operations[nth] {
            _ if nth >= self.moved => CutStage::Confirm,
            _ if nth >= self.marked + counted => CutStage::Move,
            _ if nth >= self.marked => CutStage::Start,
            _ if nth >= self.whole => CutStage::Mark,
            FlashOperation::Erase { .. } => CutStage::Erase,
            FlashOperation::Program { address, .. } if address < image => CutStage::Header,
            FlashOperation::Program { .. } => CutStage::Image,
        }
    }

    /// Those that are cut, in their order: all, or those for `.ci/run`.
    fn chosen(&self, words: Option<usize>) -> BTreeSet<usize> {
        let is_image = |nth: &usize| self.stage(*nth) == CutStage::Image;
        let (image, others): (Vec<_>, Vec<_>) = (0..self.operations.len()).partition(is_image);
        let is_last = |nth: usize| self.operations.len() == nth + 1 || self.stage(nth + 1) != self.stage(nth);
        let is_cut = |nth: &usize| words.is_some() || self.stage(*nth) < CutStage::Start || is_last(*nth);
        let mut chosen: BTreeSet<_> = others.into_iter().filter(is_cut).collect();
        // The first word, the last one, and any others.
        chosen.extend(image.first().into_iter().chain(image.last()));
        let mut random = 0x5EED_u32;
        chosen.extend((2..words.unwrap_or(WORDS)).map(|_| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            image[(random >> 8) as usize % image.len()]
        }));
        chosen
    }
}

/// Prints what was cut if a check fails.
struct PrintOnPanic(String);

impl Drop for PrintOnPanic {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("{}", self.0);
        }
    }
}

/// A board begins with this flash.
fn start_with(bench: &mut Bench, contents: &Contents) {
    bench.chip.hold(contents);
    bench.begin_again();
    bench.chip.restarts.clear();
    new_robot(bench);
}

/// Whether what runs is whole, and has its configuration.
fn judge(bench: &mut Bench, recorded: &Recorded, nth: usize) {
    is_up(bench);
    let now = state(bench);
    let (slot, good) = (now["slot"].as_str(), now["good"].as_str());
    if nth < recorded.marked {
        assert_eq!((slot, good, now["trial"].is_null()), (Some("A"), Some("A"), true), "{now}");
        assert_eq!(now["other"].is_object(), nth >= recorded.whole, "{now}");
    } else {
        assert_eq!((slot, good, now["trial"].is_null()), (Some("B"), Some("A"), false), "{now}");
    }
    let request = signed(bench, "GET /api/v1/revisions");
    let revisions = exchange(bench, &request).must_be(200).json();
    assert_eq!((&revisions["live"], &revisions["running"]), (&1.into(), &1.into()), "{revisions}");
    assert!(bench.chip.faults.is_empty() && bench.chip.resets.is_empty(), "{}", bench.history());
}

/// The update is complete.
fn finish(bench: &mut Bench) {
    if state(bench)["slot"] == "A" {
        let image = firmware(Slot::B);
        assert_eq!(send(bench, &header(Slot::B, image, &SEED), image)["incoming"]["state"], "ready");
        post(bench, "try").must_be(202);
        restarted(bench);
        is_up(bench);
        assert_eq!(state(bench)["slot"], "B");
    }
    bench.until_log("the firmware is confirmed", 40 * SECOND);
    let kept = state(bench);
    assert_eq!(
        (kept["good"].as_str(), kept["last"]["ended"].as_str()),
        (Some("B"), Some("confirmed")),
        "{kept}"
    );
    let request = signed(bench, "GET /api/v1/revisions");
    assert_eq!(exchange(bench, &request).must_be(200).json()["live"], 1);
}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn the_power_is_cut_in_each_operation_of_an_update() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<usize>().expect("a number"));
    let (words, from) = (number(ALL), number(FROM).unwrap_or(0));
    let mut bench = board();
    let recorded = Recorded::new(&mut bench);
    let chosen = recorded.chosen(words);
    let (mut flash, mut starts, mut finished) = (recorded.before.clone(), 0, BTreeSet::new());
    let mut cuts = std::collections::BTreeMap::<CutStage, u32>::new();
    for (operation, nth) in recorded.operations.iter().zip(0..) {
        if nth >= from && chosen.contains(&nth) {
            let kinds = if words.is_some() { &KINDS[..] } else { &KINDS[nth % KINDS.len()..][..1] };
            for leaves in kinds {
                let stage = recorded.stage(nth);
                let _telling = PrintOnPanic(format!("cut {nth}, {stage:?}, {leaves:?}: {operation:X?}"));
                let mut cut = flash.clone();
                cut.interrupt(operation, *leaves, nth as u32);
                start_with(&mut bench, &cut);
                judge(&mut bench, &recorded, nth);
                // Without the variable one of which all is missing, and each that is on trial.
                let is_to_finish = match words {
                    Some(_) => finished.insert((stage, format!("{leaves:?}"))),
                    None if stage == CutStage::Image => finished.insert((stage, String::new())),
                    None => stage >= CutStage::Start,
                };
                if is_to_finish {
                    finish(&mut bench);
                }
                *cuts.entry(stage).or_default() += 1;
                starts += 1;
            }
        }
        flash.execute(operation);
    }
    println!("{} operations, {starts} cuts: {cuts:?}", recorded.operations.len());
    assert!(cuts.len() == 7 || from > 0, "a stage was not cut");
}
