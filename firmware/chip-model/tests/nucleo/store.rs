//! The store on the board (docs/store.md): what runs after a start, with the power cut at every operation of the
//! flash.

use embassy_futures::block_on;
use recipe_chip_model::CONFIG;
use recipe_chip_model::device::{MILLI, SECOND};
use recipe_chip_model::models::flash::Torn;
use recipe_store::{BLANK, Flash, FlashWord, Geometry, Marks, Store, Trial, WORD, Word};

use crate::Bench;
use crate::bench::image_of;
use crate::boot::CELL;

/// As memory.x and the board have them.
const SECTORS: [u32; 2] = [0x081A_0000, 0x081E_0000];
const WORDS: u16 = 4096;
const FLASH: u32 = 0x0800_0000;

/// The contents of the two sectors. It takes a write anywhere, like a debugger.
struct FlashCopy(Vec<Word>);

impl FlashCopy {
    fn blank() -> Self {
        Self(vec![BLANK; 2 * usize::from(WORDS)])
    }

    /// What the board's flash holds.
    fn of(bench: &mut Bench) -> Self {
        let flash = &bench.chip.devices().flash;
        let torn: Vec<u32> = flash.torn().collect();
        let words = SECTORS.iter().flat_map(|start| {
            let first = start - FLASH;
            let bytes = &flash.cells()[first as usize..][..usize::from(WORDS) * WORD];
            (first..).step_by(WORD).zip(bytes.as_chunks().0)
        });
        Self(words.map(|(at, word)| if torn.contains(&at) { [0; WORD] } else { *word }).collect())
    }

    fn load_into(&self, bench: &mut Bench) {
        for (start, words) in SECTORS.iter().zip(self.0.chunks(WORDS.into())) {
            bench.chip.load(*start, words.as_flattened());
        }
    }

    fn at(place: FlashWord) -> usize {
        usize::from(place.sector) * usize::from(WORDS) + usize::from(place.word)
    }
}

impl Flash for FlashCopy {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 2, words: WORDS }
    }

    fn read(&self, place: FlashWord) -> Word {
        self.0[Self::at(place)]
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.0[Self::at(place)] = *word;
    }

    async fn erase(&mut self, sector: u8) {
        self.0[usize::from(sector) * usize::from(WORDS)..][..usize::from(WORDS)].fill(BLANK);
    }
}

/// [`CELL`] with another constant, so that an image tells which one it is.
fn cell(constant: u8) -> Vec<u8> {
    image_of(&CELL.replace("value = 125", &format!("value = {constant}")))
}

/// A store with these images kept in order, and these marks.
fn store_with(images: &[Vec<u8>], marks: Marks) -> FlashCopy {
    let mut flash = FlashCopy::blank();
    let mut store = Store::mount(&flash).expect("it is empty");
    for (number, image) in (1..).zip(images) {
        block_on(store.keep(number, number, image, None).expect("there is room").execute(&mut flash))
            .expect("it is flash");
    }
    block_on(store.mark(marks).expect("they are kept").execute(&mut flash)).expect("it is flash");
    flash
}

/// A store that is so full that the next configuration begins another sector.
fn full_store(images: &[Vec<u8>], marks: Marks) -> FlashCopy {
    let mut flash = store_with(images, marks);
    let mut store = Store::mount(&flash).expect("it was written");
    let mut count = 0;
    while flash.0[FlashCopy::at(FlashWord { sector: 1, word: WORDS - 6 })] == BLANK {
        count += 1;
        block_on(store.set_counter(0, count).expect("there is room").execute(&mut flash))
            .expect("it is flash");
    }
    flash
}

/// The images that the store on the board holds as live, and before it.
fn live(bench: &mut Bench) -> Vec<Vec<u8>> {
    let flash = FlashCopy::of(bench);
    let store = Store::mount(&flash).expect("it was written");
    let mut buf = [0; recipe_store::MAX_DATA];
    let candidates = store.at_start().candidates;
    let mut image = |number| store.image(&flash, number, &mut buf).expect("it is kept").to_vec();
    candidates.iter().map(|(kept, _)| image(kept.number)).collect()
}

/// Runs until the board has a configuration; returns the line that says which one of the store it is.
#[track_caller]
fn starts(bench: &mut Bench) -> String {
    let begin = bench.chip.log.len();
    bench.until_log("field ports", 10 * SECOND);
    if !bench.chip.faults.is_empty() || !bench.chip.resets.is_empty() {
        let history = bench.history();
        panic!("{:X?}\n{history}", bench.chip.faults);
    }
    let lines = bench.chip.log[begin..].iter().map(|(_, line)| line);
    lines.rev().find(|line| line.contains("of the store")).cloned().unwrap_or_default()
}

const TAKEN_OVER: &str = "the store has taken over the configuration";

/// The number of operations of an undisturbed start with a new image; then one start with a cut in each, for each
/// kind of torn word, and a second cut in the start after it. Each time the board runs a configuration at once, the
/// store holds one of `whole` as the live one (none, if it was `prepared` without one), and at last the first of
/// them.
fn cut_everywhere(prepared: &FlashCopy, image: &[u8], whole: &[&[u8]]) -> u64 {
    // One chip for all: a new one would translate the program again.
    let mut bench = Bench::with_image(image);
    let start = |bench: &mut Bench| {
        bench.begin_again();
        prepared.load_into(bench);
    };
    start(&mut bench);
    let before = bench.chip.devices().flash.operations();
    starts(&mut bench);
    bench.until_log(TAKEN_OVER, 10 * SECOND);
    let operations = bench.chip.devices().flash.operations() - before;
    assert_eq!(live(&mut bench)[0], whole[0]);
    for leaves in [Torn::Fault, Torn::Blank, Torn::Half] {
        // Of the kinds that are cut everywhere on the model of the flash, a part.
        for cut in (1..=operations).filter(|cut| leaves == Torn::Fault || cut % 6 == 0) {
            start(&mut bench);
            let before = bench.chip.devices().flash.operations();
            bench.chip.devices().flash.leaves = leaves;
            bench.chip.devices().flash.fails_during = Some(before + cut);
            bench.until("the cut", 10 * SECOND, |bench| bench.chip.power_cuts == 1);
            // Once more, somewhere in the same work.
            let second = cut + 1 + cut * 7 % operations;
            bench.chip.devices().flash.fails_during = Some(before + second);
            starts(&mut bench);
            let is_over = |bench: &mut Bench| {
                bench.chip.power_cuts == 2
                    || bench.has_logged(TAKEN_OVER)
                    || bench.has_logged("of the store, the live one")
            };
            bench.until("the second cut, or the end", 10 * SECOND, is_over);
            bench.chip.devices().flash.fails_during = None;
            let found = live(&mut bench);
            let is_whole = match found.first() {
                Some(found) => whole.contains(&&found[..]),
                None => whole.len() == 1,
            };
            assert!(is_whole, "{leaves:?}, cut {cut}, then {second}");
            bench.chip.cut_power();
            starts(&mut bench);
            bench.until("the new one", 10 * SECOND, |bench| {
                bench.run(10 * MILLI);
                live(bench).first().is_some_and(|live| live == whole[0])
            });
        }
    }
    operations
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn what_a_probe_wrote_is_taken_over_once() {
    let mut bench = Bench::with_image(&cell(1));
    assert_eq!(starts(&mut bench), "", "it runs before the store has it");
    bench.until_log(TAKEN_OVER, 3 * SECOND);
    let operations = bench.chip.devices().flash.operations();
    bench.chip.cut_power();
    assert!(starts(&mut bench).contains("configuration 1 of the store, the live one"), "{}", bench.history());
    bench.run(SECOND);
    assert_eq!(bench.chip.devices().flash.operations(), operations, "nothing is written at the next start");
    // The probe writes another one.
    bench.chip.load(CONFIG, &[0xFF; 4096]);
    bench.chip.load(CONFIG, &cell(2));
    bench.chip.cut_power();
    starts(&mut bench);
    bench.until_log(TAKEN_OVER, SECOND);
    assert_eq!(live(&mut bench), [cell(2), cell(1)]);
    // Without it, the store is enough.
    bench.chip.load(CONFIG, &[0xFF; 4096]);
    bench.chip.cut_power();
    assert!(starts(&mut bench).contains("configuration 2 of the store, the live one"));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn the_power_is_cut_at_every_operation_of_the_first_start() {
    let image = cell(1);
    let operations = cut_everywhere(&FlashCopy::blank(), &image, &[&image]);
    println!("{operations} operations");
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn the_power_is_cut_at_every_operation_while_a_sector_is_begun() {
    let (old, new) = (cell(1), cell(2));
    let marks = Marks { live: Some(1), ..Marks::default() };
    let operations = cut_everywhere(&full_store(std::slice::from_ref(&old), marks), &new, &[&new, &old]);
    println!("{operations} operations");
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_trial_is_over_when_its_starts_are_used_up() {
    let trial = Some(Trial { number: 2, attempts: 2, confirm_s: 3_600 });
    let marks = Marks { live: Some(1), trial, ..Marks::default() };
    let mut bench = Bench::blank();
    store_with(&[cell(1), cell(2)], marks).load_into(&mut bench);
    for _ in 0..2 {
        assert!(starts(&mut bench).contains("configuration 2 of the store, on trial for 3600 s"));
        bench.chip.cut_power();
    }
    for _ in 0..2 {
        assert!(starts(&mut bench).contains("configuration 1 of the store, the live one"));
        bench.chip.cut_power();
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_trial_that_nobody_confirms_ends_with_a_restart_into_the_live_one() {
    let trial = Some(Trial { number: 2, attempts: 2, confirm_s: 3 });
    let marks = Marks { live: Some(1), previous: None, trial, last: None };
    let mut bench = Bench::blank().with_robot();
    store_with(&[cell(1), cell(2)], marks).load_into(&mut bench);
    assert!(starts(&mut bench).contains("configuration 2 of the store, on trial for 3 s"));
    let is_connected =
        |bench: &mut Bench| bench.robot.as_ref().is_some_and(|robot| robot.counters().modbus.open == 1);
    bench.until("a Modbus connection", 2 * SECOND, is_connected);
    let told =
        bench.until_log("the configuration was not confirmed in time: back to the live one", 4 * SECOND);
    bench.until("a restart", SECOND, |bench| bench.chip.restarts.len() == 1);
    assert!(bench.chip.restarts[0] >= told + 100 * MILLI, "time for the log");
    // It is no fault, so there are no last words.
    bench.until_log("info: started", 100 * MILLI);
    assert!(starts(&mut bench).contains("configuration 1 of the store, the live one"), "{}", bench.history());
    assert_eq!(bench.times_logged("previous run"), 0);
    // The controller's end of the old connection makes way for a new one.
    bench.until_log(&format!("link {}: up (1)", "modbus"), 10 * SECOND);
    bench.run(5 * SECOND);
    assert_eq!((bench.chip.restarts.len(), bench.chip.power_cuts), (1, 0));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_newer_image_is_refused_with_its_number_and_the_one_before_runs() {
    let mut newer = cell(1);
    newer[4] = 9;
    let marks = Marks { live: Some(2), previous: Some(1), ..Marks::default() };
    let mut bench = Bench::blank();
    store_with(&[cell(1), newer.clone()], marks).load_into(&mut bench);
    assert!(starts(&mut bench).contains("configuration 1 of the store, the one before the live one"));
    assert!(bench.has_logged("configuration 2 of the store cannot run: the image has version 9"));
    // With nothing else, the buses stay silent and the log says why.
    let mut bench = Bench::blank();
    let marks = Marks { live: Some(1), ..Marks::default() };
    store_with(&[newer], marks).load_into(&mut bench);
    bench.until_log("nothing runs: the image has version 9", SECOND);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn images_of_the_version_before_run() {
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/../../proto-core/tests/golden/v3");
    for file in ["serial.img", "can.img"] {
        let image = std::fs::read(format!("{golden}/{file}")).expect("a golden image");
        let marks = Marks { live: Some(1), ..Marks::default() };
        let mut bench = Bench::blank();
        store_with(std::slice::from_ref(&image), marks).load_into(&mut bench);
        assert!(starts(&mut bench).contains("configuration 1 of the store, the live one"), "{file}");
    }
}
