//! Boards with a loader, a firmware in slot A, get another one with `host-sim ctl update` (docs/update.md): NUCLEOs on
//! their modelled chips, and QEMU's.

mod nucleo;
mod qemu;
mod releases;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use recipe_ctl::update::{Downgrade, begin_trial, push};
use recipe_ctl::{Client, Stop, Update, key_file};
use serde_json::{Value, json};

use crate::BINARY;
use crate::board::Board;
use crate::ctl::{Ctl, Printed, TIMEOUT};
use crate::target::Target;
use releases::{Built, OTHER_TEXT, Releases, TEXT, another_text, that_restarts, unchanged};

/// A board with a loader.
trait Slotted: Board + Sized + Send + Sync {
    /// What was built for it.
    const BUILT: Built;

    /// One that was never started, with this in slot A.
    fn new(slot_a: &Path) -> Self;

    /// How often it has restarted by itself, since it has power.
    fn restarts(&self) -> u64;

    /// In service: claimed, its panel plugged in, everything works.
    fn in_service(slot_a: &Path) -> Self {
        let mut board = Self::new(slot_a);
        Releases::ctl(&["keygen", &board.around().path("key")]);
        std::fs::write(board.file(), board.config(500)).unwrap();
        // The loader checks what it has never run.
        board.switch_on();
        board.claim();
        board.plug();
        board.ctl().until(0, &["status"]);
        board
    }

    /// The file of the configuration that it is bought with.
    fn file(&self) -> PathBuf {
        self.around().path("first.toml").into()
    }

    /// Switches it on, and waits until it answers.
    #[track_caller]
    fn switch_on(&mut self) {
        let file = self.file();
        Board::start(self, &file);
        patiently("it answers", || {
            let printed = self.ctl().run(&["update"]);
            // One that has no key says so.
            (printed.code == 0 || printed.err.contains("key")).then_some(())
        });
    }

    fn key(&self) -> PathBuf {
        self.around().path("key").into()
    }

    fn ctl(&self) -> Ctl {
        Ctl { to: self.address(), host: self.host(), key: Some(self.key()), timeout: TIMEOUT }
    }

    /// A client that does what it is told, and checks nothing before.
    fn client(&self) -> Client {
        let (address, host) = (self.address().to_string(), self.host().expect("it is a board"));
        let key = key_file::read(&self.key()).unwrap();
        let client = Client::new(address.parse().unwrap(), Some(key), Duration::from_secs(20), Stop::new());
        client.unwrap().known_as(Some(host.parse().unwrap()))
    }

    /// What it says of its firmware.
    #[track_caller]
    fn firmware(&self) -> Value {
        self.ctl().json(&["update"])
    }

    /// Runs this firmware on trial, for a minute.
    #[track_caller]
    fn tries(&self, file: &str) {
        let printed = self.ctl().run(&["update", file, "--try", "--confirm-s", "60"]);
        // It is asked at once, and may not have its links yet.
        assert!(matches!(printed.code, 0 | 3) && printed.out.contains("runs on trial"), "{printed:?}");
    }

    /// Its slot, and what it answers to the end of a trial that there is not: another text in another build.
    #[track_caller]
    fn runs(&self, slot: &str, text: &str) {
        let now = self.firmware();
        assert_eq!(
            (&now["slot"], &now["good"], now["trial"].is_null()),
            (&json!(slot), &json!(slot), true),
            "{now}"
        );
        let printed = self.ctl().run(&["update", "--back"]).must_be(1);
        assert!(printed.err.contains(text), "{printed:?}");
    }
}

/// Two boards: one is updated and takes another update back, the other refuses what is wrong; then both in a rollout.
fn gets_another_firmware<B: Slotted>() {
    let releases = Releases::new(B::BUILT);
    let first = releases.sign("first.rgu", unchanged);
    let second = releases.sign("second.rgu", another_text);
    let broken = releases.sign("broken.rgu", that_restarts);
    let flat = releases.flat(&first);
    let (press, saw) = std::thread::scope(|scope| {
        let saw = scope.spawn(|| B::in_service(&flat));
        (B::in_service(&flat), saw.join().unwrap())
    });
    std::thread::scope(|scope| {
        scope.spawn(|| refuses_what_is_foreign_or_changed(&saw, &releases, &second));
        is_updated_and_taken_back(&press, &first, &second);
    });

    let entry = |name: &str, board: &B| {
        let (to, host, key) = (board.address(), board.host().unwrap(), board.key());
        let key = key.display();
        format!("[[gateway]]\nname = \"{name}\"\naddress = \"{to}\"\nhost = \"{host}\"\nkey = \"{key}\"\n")
    };
    let inventory = releases.path("plant.toml");
    std::fs::write(&inventory, entry("press", &press) + &entry("saw", &saw)).unwrap();
    // One has this build, the other the one before, of the same version.
    let (printed, report) = roll_out(&releases, &inventory, &second);
    let outcomes = |report: &Value| {
        let of = |gateway: &Value| gateway["outcome"].as_str().unwrap().to_owned();
        report["gateways"].as_array().unwrap().iter().map(of).collect::<Vec<_>>()
    };
    assert_eq!(
        (printed.code, outcomes(&report)),
        (0, vec!["already".to_owned(), "updated".to_owned()]),
        "{printed:?}"
    );
    saw.runs("B", OTHER_TEXT);
    // The next one does not run: the first board goes back, the second one is never begun.
    let (printed, report) = roll_out(&releases, &inventory, &broken);
    assert_eq!(
        (printed.code, outcomes(&report)),
        (1, vec!["failed".to_owned(), "not_begun".to_owned()]),
        "{printed:?}"
    );
    let failed = &report["gateways"][0];
    assert_eq!((&failed["step"], &failed["left"]), (&json!("try"), &json!("before")), "{failed}");
    assert!(failed["error"].as_str().unwrap().contains("the firmware did not run"), "{failed}");
    for board in [&press, &saw] {
        board.runs("B", OTHER_TEXT);
        board.ctl().until(0, &["status"]);
    }
    assert_eq!(press.firmware()["last"], json!({ "slot": "A", "ended": "failed" }));
}

/// `update` over both boards, one after the other; what it printed, and its report.
fn roll_out(releases: &Releases, inventory: &Path, file: &str) -> (Printed, Value) {
    let report = releases.path("report.json");
    let mut command = BINARY.command();
    command.args(["ctl", "--timeout", TIMEOUT, "--inventory"]).arg(inventory).args(["update", file]);
    command.args(["--batch", "1", "--stop-on-failure", "--confirm-s", "120", "--report"]).arg(&report);
    let printed = Printed::of(command.output().unwrap());
    let text = std::fs::read_to_string(&report).unwrap_or_else(|error| panic!("{error}: {printed:?}"));
    (printed, serde_json::from_str(&text).unwrap())
}

/// Sent, tried and confirmed; then the one before, which is taken back.
fn is_updated_and_taken_back<B: Slotted>(board: &B, first: &str, second: &str) {
    let ctl = board.ctl();
    let before = board.firmware();
    board.runs("A", TEXT);
    let revisions = ctl.json(&["revisions"]);
    let done = ctl.done(&["update", second, "--try", "--confirm"]);
    assert!(done.contains("runs and is confirmed"), "{done}");
    board.runs("B", OTHER_TEXT);
    let after = board.firmware();
    assert!(after["version"] == before["version"] && after["sha512"] != before["sha512"], "{after}");
    assert_eq!(after["last"], json!({ "slot": "B", "ended": "confirmed" }));
    assert_eq!(ctl.json(&["revisions"])["live"], revisions["live"], "its configuration came along");
    let again = ctl.done(&["update", second, "--try", "--confirm"]);
    assert!(again.contains("nothing was sent"), "{again}");
    board.tries(first);
    assert_eq!(board.firmware()["slot"], "A");
    ctl.done(&["update", "--back"]);
    board.runs("B", OTHER_TEXT);
    assert_eq!(board.firmware()["last"], json!({ "slot": "A", "ended": "taken_back" }));
    ctl.until(0, &["status"]);
}

/// Refused by `ctl`, which sends nothing; and by the board, when all is sent.
fn refuses_what_is_foreign_or_changed<B: Slotted>(board: &B, releases: &Releases, second: &str) {
    let ctl = board.ctl();
    let (before, restarts) = (board.firmware(), board.restarts());
    Releases::ctl(&["keygen", "--signing", releases.path("other.key").to_str().unwrap()]);
    let foreign = releases.sign_as("foreign.rgu", "other.key", env!("CARGO_PKG_VERSION"), another_text);
    let mut changed = std::fs::read(second).unwrap();
    let last = changed.len() - 100_000;
    changed[last] ^= 1;
    let changed_file = releases.path("changed.rgu").display().to_string();
    std::fs::write(&changed_file, &changed).unwrap();
    for (file, why) in [(&foreign, "not signed with the key"), (&changed_file, "CRC differs")] {
        let printed = ctl.run(&["update", file, "--try"]);
        assert!(printed.code != 0 && printed.err.contains(why), "{printed:?}");
    }
    assert_eq!(board.firmware(), before, "nothing was sent");

    let client = board.client();
    let whole = Update::read(second.as_ref()).unwrap();
    let mut link = whole.links()[1];
    let mut image = link.image.to_vec();
    image[300_000] ^= 1;
    link.image = &image;
    let failure = push(&client, &link, Downgrade::Refused, &mut |_| {}).unwrap_err();
    assert!(failure.message().contains("CRC differs"), "{failure:?}");
    let update = Update::read(foreign.as_ref()).unwrap();
    push(&client, &update.links()[1], Downgrade::Refused, &mut |_| {}).unwrap();
    let failure = begin_trial(&client, 60, Downgrade::Refused, &mut |_| {}).unwrap_err();
    assert!(failure.message().contains("not signed with the key"), "{failure:?}");
    patiently("it restarts with what it had", || (board.restarts() > restarts).then_some(()));
    patiently("it answers", || (ctl.run(&["update"]).code == 0).then_some(()));
    board.runs("A", TEXT);
    assert!(board.firmware()["last"].is_null(), "nothing was on trial");
}

/// Calls `look` until it returns something: two emulated boards share a machine with other programs, and what takes a
/// second there may take many here.
#[track_caller]
fn patiently<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + Duration::from_secs(180);
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "never: {what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}
