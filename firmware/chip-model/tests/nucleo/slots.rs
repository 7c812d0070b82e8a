//! The board with the loader and a firmware in each slot, and what a client does to update it (docs/update.md).

use std::sync::OnceLock;

use proto_core::config::image;
use recipe_chip_model::Program;
use recipe_chip_model::device::{MILLI, SECOND};
use recipe_config::SimConfig;
use recipe_test_kit::http::Response;
use recipe_update::{
    BoardName, Formats, HEADER, Header, IMAGE_OFFSET, ImageFacts, NUCLEO_H743ZI as BOARD, Slot, Version,
};
use serde_json::Value;

use crate::Bench;
use crate::bench::image_of;
use crate::boot::CELL;
use crate::client::{claim, exchange, signed, signed_with};
use crate::robot::Robot;

/// The private key of RFC 8032's third test. The loader of the tests is built for its public key.
pub(crate) const SEED: [u8; 32] = [
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
pub(crate) fn firmware(slot: Slot) -> &'static [u8] {
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

/// The program of a slot, with its symbols.
pub(crate) fn program(slot: Slot) -> Program {
    read(PROGRAMS[usize::from(slot.number())])
}

/// Signed with this key.
pub(crate) fn header(slot: Slot, image: &[u8], seed: &[u8; 32]) -> Header {
    let formats = Formats::new(image::OLDEST_VERSION, image::VERSION, image::VERSION).unwrap();
    let board = BoardName::parse(BOARD.board).unwrap();
    let version = Version::parse(env!("CARGO_PKG_VERSION")).unwrap();
    let parts = ImageFacts { board, slot, version, formats, store: recipe_store::VERSION };
    Header::sign(parts, image, seed).unwrap()
}

/// A claimed board with the firmware in slot A, whose links are up.
pub(crate) fn board() -> Bench {
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
pub(crate) fn is_up(bench: &mut Bench) {
    bench.until_log("modbus: up (", 20 * SECOND);
    bench.run(100 * MILLI);
}

/// What the board says; while its store is being moved, for some seconds after a start, it says that it is busy.
pub(crate) fn state(bench: &mut Bench) -> Value {
    loop {
        let request = signed(bench, "GET /api/v1/update");
        let answer = exchange(bench, &request);
        if answer.status != 409 {
            return answer.must_be(200).json();
        }
        bench.run(200 * MILLI);
    }
}

pub(crate) fn put(bench: &mut Bench, offset: usize, bytes: &[u8]) -> Response {
    let line = format!("PUT /api/v1/update?offset={offset}");
    let request = signed_with(bench, &line, "Content-Type: application/octet-stream", bytes);
    exchange(bench, &request)
}

pub(crate) fn post(bench: &mut Bench, operation: &str) -> Response {
    let body = if operation == "try" { &b"{\"confirm_s\": 60}"[..] } else { b"{}" };
    let line = format!("POST /api/v1/update/{operation}");
    let request = signed_with(bench, &line, "Content-Type: application/json", body);
    exchange(bench, &request)
}

/// Waits until `incoming` is no longer in this state.
pub(crate) fn after(bench: &mut Bench, stage: &str) -> Value {
    loop {
        let state = state(bench);
        if state["incoming"]["state"] != stage {
            return state;
        }
        bench.run(200 * MILLI);
    }
}

/// Sends a firmware; returns what the board says of it at last.
pub(crate) fn send(bench: &mut Bench, header: &Header, image: &[u8]) -> Value {
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
pub(crate) fn restarted(bench: &mut Bench) {
    let restarts = bench.chip.restarts.len();
    bench.until("a restart", 10 * SECOND, |bench| bench.chip.restarts.len() > restarts);
    new_robot(bench);
}

/// The controller of the cell begins anew: of a board that was restarted it would keep connections for hours, and it
/// takes two.
pub(crate) fn new_robot(bench: &mut Bench) {
    bench.robot = bench.robot.take().map(|_| Robot::new(&SimConfig::default()));
    bench.look_no_further_back();
}
