//! QEMU's boards, each with the flash of its slots in a file (firmware/README.md).

use std::path::Path;
use std::process::Child;

use recipe_ctl::Slot;
use recipe_test_kit::Process;
use serde_json::{Value, json};

use super::releases::{
    Built, OTHER_TEXT, Releases, TEXT, another_text, that_crashes, that_hangs, that_restarts, unchanged,
};
use super::{Slotted, gets_another_firmware, patiently};
use crate::board::{Board, Surroundings};
use crate::qemu::{emulate, kill, let_go, log, press};
use crate::target::Target;

/// On the first line its panel.
struct Qemu {
    around: Surroundings,
    qemu: Option<Child>,
}

impl Board for Qemu {
    fn around(&self) -> &Surroundings {
        &self.around
    }

    fn around_mut(&mut self) -> &mut Surroundings {
        &mut self.around
    }

    fn start(&mut self, file: &Path) {
        let loader = Surroundings::named("QEMU_LOADER");
        self.qemu = Some(emulate(&self.around, &loader, file, &[&self.around.path(SLOTS)]));
    }

    fn press(&self) {
        press(&self.around);
    }

    fn let_go(&self) {
        let_go(&self.around);
    }

    fn kill(&mut self) {
        kill(&mut self.qemu);
    }

    fn short_trial_s(&self) -> u32 {
        60
    }
}

impl Slotted for Qemu {
    const BUILT: Built = Built {
        board: "mps2-an500",
        images: [(Slot::A, 0x0010_0400), (Slot::B, 0x0020_0400)],
        variables: "QEMU",
    };

    fn new(slot_a: &Path) -> Self {
        let around = Surroundings::new();
        // Slot A is the beginning of the file; what is behind its end is blank.
        std::fs::copy(slot_a, around.path(SLOTS)).unwrap();
        Self { around, qemu: None }
    }

    fn restarts(&self) -> u64 {
        log(&self.around).matches("loader: slot").count() as u64
    }
}

impl Qemu {
    /// Pulls its plug, and puts it in again.
    #[track_caller]
    fn loses_power(&mut self) {
        Board::kill(self);
        self.switch_on();
    }

    /// Whether slot B has a header, which is written when all else is there.
    fn has_header_in_b(&self) -> bool {
        let flash = std::fs::read(self.around.path(SLOTS)).unwrap();
        flash.get(SLOT_SIZE..).is_some_and(|slot| slot.get(64..68) == Some(b"RGFW"))
    }
}

impl Drop for Qemu {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the log of a board:\n{}", log(&self.around));
        }
        self.pull();
        Board::kill(self);
    }
}

/// A board with this firmware in slot A, and its updates.
fn bought() -> (Qemu, Releases, String) {
    let releases = Releases::new(Qemu::BUILT);
    let first = releases.sign("first.rgu", unchanged);
    (Qemu::in_service(&releases.flat(&first)), releases, first)
}

#[test]
#[ignore = "needs QEMU_LOADER, QEMU_SLOT_A, QEMU_SLOT_B and qemu-system-arm"]
fn a_plant_of_boards_in_qemu_gets_another_firmware() {
    gets_another_firmware::<Qemu>();
}

/// Three starts, each of which the watchdog or the firmware's own fault handler ends; a person reads why.
#[test]
#[ignore = "needs QEMU_LOADER, QEMU_SLOT_A, QEMU_SLOT_B and qemu-system-arm"]
fn a_board_in_qemu_goes_back_from_what_hangs_or_crashes_and_refuses_what_is_older() {
    let (board, releases, _) = bought();
    let ctl = board.ctl();
    let revisions = ctl.json(&["revisions"]);
    for (name, change, words) in [
        ("hangs", that_hangs as fn(&mut [u8], u32), "the watchdog was not fed"),
        ("crashes", that_crashes, "hard fault at 002"),
    ] {
        let file = releases.sign(name, change);
        let printed = ctl.run(&["update", &file, "--try"]).must_be(1);
        assert!(printed.err.contains("the firmware did not run, and the one before does"), "{printed:?}");
        board.runs("A", TEXT);
        assert_eq!(board.firmware()["last"], json!({ "slot": "B", "ended": "failed" }));
        let log = log(&board.around);
        // Of the second firmware, what the log has behind the end of the first.
        let log = log.rsplit_once("it has used up its starts").unwrap().0;
        let log = log.rsplit_once("it has used up its starts").map_or(log, |(_, behind)| behind);
        assert_eq!(log.matches("loader: slot B runs on trial").count(), 3, "{name}: {log}");
        assert_eq!(log.matches(words).count(), 3, "{name}: {log}");
        ctl.until(0, &["status"]);
    }
    assert_eq!(ctl.json(&["revisions"])["live"], revisions["live"]);

    let older = releases.sign_as("older.rgu", "the.key", "0.1.0", that_restarts);
    let printed = ctl.run(&["update", &older, "--try"]).must_be(2);
    assert!(printed.err.contains("the firmware 0.1.0 is older than the one that runs"), "{printed:?}");
    board.runs("A", TEXT);
}

/// One that does worse than the firmware before does not confirm itself.
#[test]
#[ignore = "needs QEMU_LOADER, QEMU_SLOT_A, QEMU_SLOT_B and qemu-system-arm"]
fn a_board_in_qemu_goes_back_from_what_nobody_confirms() {
    let (mut board, releases, _) = bought();
    let second = releases.sign("second.rgu", another_text);
    board.ctl().done(&["update", &second]);
    board.runs("A", TEXT);
    // The trial knows that the port worked.
    board.tries(&second);
    // Long before it would confirm itself.
    board.pull();
    patiently("it waits for its port", || {
        board.ctl().run(&["update"]).out.contains("waits for: ports").then_some(())
    });
    patiently("it goes back", || board.ctl().run(&["update"]).out.contains("in slot A").then_some(()));
    board.runs("A", TEXT);
    assert_eq!(board.firmware()["last"], json!({ "slot": "B", "ended": "not_confirmed" }));
    board.plug();
    board.ctl().until(0, &["status"]);
}

/// While an update is received, on trial, and after it was confirmed.
#[test]
#[ignore = "needs QEMU_LOADER, QEMU_SLOT_A, QEMU_SLOT_B and qemu-system-arm"]
fn a_board_in_qemu_loses_power_during_an_update() {
    let (mut board, releases, first) = bought();
    let second = releases.sign("second.rgu", another_text);
    let ctl = board.ctl();
    let live = ctl.json(&["revisions"])["live"].clone();

    // The same command goes on when the board is back, from the beginning.
    let mut sending = Process::start(&mut ctl.command(&["update", &second]));
    patiently("some of it is there", || {
        sending.must_run();
        // The one that sends has most of the board's attention.
        let shown: Value = serde_json::from_str(&ctl.run(&["--json", "update"]).out).ok()?;
        (shown["incoming"]["received"].as_u64()? > 50_000).then_some(())
    });
    Board::kill(&mut board);
    assert!(!board.has_header_in_b(), "nothing that can run");
    board.switch_on();
    board.runs("A", TEXT);
    patiently("all of it is sent", || sending.has_ended().then_some(()));
    assert!(sending.ended().success(), "{}", sending.all_errors());
    assert!(board.has_header_in_b());

    // Its starts are used up, and it goes back.
    board.tries(&second);
    for _ in 0..2 {
        assert_eq!(board.firmware()["slot"], "B");
        board.loses_power();
        assert!(board.firmware()["trial"].is_object(), "{}", board.firmware());
    }
    board.loses_power();
    board.runs("A", TEXT);
    assert!(log(&board.around).contains("loader: slot B is not run: it has used up its starts"));
    assert_eq!(board.firmware()["last"], json!({ "slot": "B", "ended": "failed" }));

    // With one start left it is kept.
    board.tries(&second);
    board.loses_power();
    ctl.done(&["update", "--confirm"]);
    board.loses_power();
    board.runs("B", OTHER_TEXT);
    assert_eq!(ctl.json(&["revisions"])["live"], live, "its configuration came along");
    // And the other way round.
    ctl.done(&["update", &first, "--try", "--confirm"]);
    board.loses_power();
    board.runs("A", TEXT);
    ctl.until(0, &["status"]);
}

/// The file with the flash of the slots, and where slot B begins in it.
const SLOTS: &str = "slots";
const SLOT_SIZE: usize = 640 << 10;
