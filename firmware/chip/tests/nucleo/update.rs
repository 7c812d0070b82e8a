//! Another firmware over the network (docs/update.md), with the loader, in both slots: sent, tried, confirmed, taken
//! back; refused; and what does not run.

use std::sync::OnceLock;

use chip::Program;
use chip::device::{MILLI, SECOND};
use proto_core::config::image;
use recipe_config::SimConfig;
use recipe_test_kit::http::Response;
use recipe_update::{
    BoardName, Formats, HEADER, Header, IMAGE_OFFSET, NUCLEO_H743ZI as BOARD, Parts, Slot, Version,
};
use serde_json::Value;

use crate::Bench;
use crate::bench::image_of;
use crate::boot::CELL;
use crate::client::{ask, claim, exchange, signed, signed_with};
use crate::robot::Robot;

/// The private key of RFC 8032's third test. The loader of the tests is built for its public key.
const SEED: [u8; 32] = [
    0xC5, 0xAA, 0x8D, 0xF4, 0x3F, 0x9F, 0x83, 0x7B, 0xED, 0xB7, 0x44, 0x2F, 0x31, 0xDC, 0xB7, 0xB1, 0x66,
    0xD3, 0x85, 0x35, 0x07, 0x6F, 0x09, 0x4B, 0x85, 0xCE, 0x3A, 0x2E, 0x0B, 0x44, 0x58, 0xF7,
];
const PIECE: usize = 16 << 10;
/// In one slot, and in the other.
const PROGRAMS: [&str; 2] = ["CHIP_SLOT_A", "CHIP_SLOT_B"];

fn read(name: &str) -> Program {
    let path = std::env::var_os(name).unwrap_or_else(|| panic!("{name} does not say where the program is"));
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    Program::read(&bytes).expect("a program")
}

/// The loader, which knows the code of both firmwares.
fn loader() -> &'static Program {
    static PROGRAM: OnceLock<Program> = OnceLock::new();
    PROGRAM.get_or_init(|| read("CHIP_LOADER").knowing(PROGRAMS.map(read).into()))
}

/// The firmware of a slot.
fn firmware(slot: Slot) -> &'static [u8] {
    static IMAGES: [OnceLock<Vec<u8>>; 2] = [OnceLock::new(), OnceLock::new()];
    let nth = usize::from(slot.number());
    IMAGES[nth].get_or_init(|| {
        let start = BOARD.slot(slot) + IMAGE_OFFSET;
        let mut image = Vec::new();
        for (address, bytes) in read(PROGRAMS[nth]).segments {
            let at = (address - start) as usize;
            image.resize(image.len().max(at + bytes.len()), 0xFF);
            image[at..at + bytes.len()].copy_from_slice(&bytes);
        }
        image
    })
}

/// Signed with this key.
fn header(slot: Slot, image: &[u8], seed: &[u8; 32]) -> Header {
    let formats = Formats::new(image::OLDEST_VERSION, image::VERSION, image::VERSION).unwrap();
    let board = BoardName::parse(BOARD.board).unwrap();
    let version = Version::parse(env!("CARGO_PKG_VERSION")).unwrap();
    let parts = Parts { board, slot, version, formats, store: recipe_store::VERSION };
    Header::sign(parts, image, seed).unwrap()
}

/// A claimed board with the firmware in slot A, whose links are up.
fn board() -> Bench {
    let mut bench = Bench::of(loader(), &image_of(CELL)).with_robot();
    let image = firmware(Slot::A);
    let mut slot = header(Slot::A, image, &SEED).encode().to_vec();
    slot.resize(IMAGE_OFFSET as usize, 0xFF);
    slot.extend(image);
    bench.chip.load(BOARD.slot(Slot::A), &slot);
    bench.begin_again();
    is_up(&mut bench);
    claim(&mut bench);
    bench
}

/// Runs the board until its link to the controller is up, once more than before.
fn is_up(bench: &mut Bench) {
    bench.until_log("modbus: up (", 20 * SECOND);
    bench.run(100 * MILLI);
}

/// What the board says; while its store is being moved, for some seconds after a start, it says that it is busy.
fn state(bench: &mut Bench) -> Value {
    loop {
        let request = signed(bench, "GET /api/v1/update");
        let answer = exchange(bench, &request);
        if answer.status != 409 {
            return answer.must_be(200).json();
        }
        bench.run(200 * MILLI);
    }
}

fn put(bench: &mut Bench, offset: usize, bytes: &[u8]) -> Response {
    let line = format!("PUT /api/v1/update?offset={offset}");
    let request = signed_with(bench, &line, "Content-Type: application/octet-stream", bytes);
    exchange(bench, &request)
}

fn post(bench: &mut Bench, operation: &str) -> Response {
    let body = if operation == "try" { &b"{\"confirm_s\": 60}"[..] } else { b"{}" };
    let line = format!("POST /api/v1/update/{operation}");
    let request = signed_with(bench, &line, "Content-Type: application/json", body);
    exchange(bench, &request)
}

/// Waits until `incoming` is no longer in this state.
fn after(bench: &mut Bench, stage: &str) -> Value {
    loop {
        let state = state(bench);
        if state["incoming"]["state"] != stage {
            return state;
        }
        bench.run(200 * MILLI);
    }
}

/// Sends a firmware; returns what the board says of it at last.
fn send(bench: &mut Bench, header: &Header, image: &[u8]) -> Value {
    put(bench, 0, &header.encode()).must_be(200);
    let begun = after(bench, "erasing");
    if begun["incoming"]["state"] == "ready" {
        // It is in its slot from before.
        return begun;
    }
    for (bytes, at) in image.chunks(PIECE).zip((HEADER..).step_by(PIECE)) {
        put(bench, at, bytes).must_be(200);
    }
    after(bench, "checking")
}

/// Runs the board until it has begun again.
fn restarted(bench: &mut Bench) {
    let restarts = bench.chip.restarts.len();
    bench.until("a restart", 10 * SECOND, |bench| bench.chip.restarts.len() > restarts);
    new_robot(bench);
}

/// The controller of the cell begins anew: of a board that was restarted it would keep connections for hours, and it
/// takes two.
fn new_robot(bench: &mut Bench) {
    bench.robot = bench.robot.take().map(|_| Robot::new(&SimConfig::default()));
    bench.look_no_further_back();
}

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

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A and CHIP_SLOT_B"]
fn the_power_fails_on_the_way_and_something_whole_runs() {
    let mut bench = board();
    let image = firmware(Slot::B);
    let head = header(Slot::B, image, &SEED);
    // While it is erased, and while it is written.
    for cut in [2, 9, 200] {
        put(&mut bench, 0, &head.encode()).must_be(200);
        if cut > 5 {
            after(&mut bench, "erasing");
        }
        let before = bench.chip.devices().flash.operations();
        bench.chip.devices().flash.fails_during = Some(before + cut);
        let cuts = bench.chip.power_cuts;
        if cut > 5 {
            // Nobody answers.
            let line = format!("PUT /api/v1/update?offset={HEADER}");
            let fields = "Content-Type: application/octet-stream";
            let request = signed_with(&mut bench, &line, fields, &image[..7 << 10]);
            ask(&mut bench, &request, 1 << 10);
        }
        bench.until("a power cut", 10 * SECOND, |bench| bench.chip.power_cuts > cuts);
        new_robot(&mut bench);
        is_up(&mut bench);
        let still = state(&mut bench);
        assert_eq!((still["slot"].as_str(), still["incoming"].is_null()), (Some("A"), true), "{still}");
    }
    // In the trial's first start: by the loader, and while the store is moved.
    assert_eq!(send(&mut bench, &head, image)["incoming"]["state"], "ready");
    post(&mut bench, "try").must_be(202);
    restarted(&mut bench);
    let before = bench.chip.devices().flash.operations();
    bench.chip.devices().flash.fails_during = Some(before + 6);
    let cuts = bench.chip.power_cuts;
    bench.until("a power cut", 20 * SECOND, |bench| bench.chip.power_cuts > cuts);
    new_robot(&mut bench);
    is_up(&mut bench);
    assert_eq!(state(&mut bench)["slot"], "B");
    bench.until_log("the firmware is confirmed", 40 * SECOND);
    let request = signed(&mut bench, "GET /api/v1/revisions");
    assert_eq!(exchange(&mut bench, &request).must_be(200).json()["live"], 1);
}
