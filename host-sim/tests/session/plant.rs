//! Two boards with a loader, the NUCLEO's firmware in slot A, get another one with `host-sim ctl update`
//! (docs/update.md): on their modelled chips in real time (docs/chip.md section 5).
//!
//! What is built once is made several builds of: one in which a text is different, and one that does not run.

use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use recipe_ctl::update::{Downgrade, begin_trial, push};
use recipe_ctl::{Client, Slot, Stop, Update, key_file};
use recipe_test_kit::{Process, chip};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::BINARY;
use crate::board::{Board, Surroundings};
use crate::ctl::{Ctl, Printed, TIMEOUT};
use crate::nucleo::{control, emulate};
use crate::target::Target;

/// The private key of RFC 8032's third test. The loader of the tests is built for its public key.
const SEED: &str = "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7";
/// A text of the firmware, and that of another build in its place.
const TEXT: &str = "no firmware is on trial";
const OTHER_TEXT: &str = "no firmware is on TRIAL";
/// An image begins so far behind its slot.
const SLOTS: [(Slot, u32); 2] = [(Slot::A, 0x0802_0400), (Slot::B, 0x0810_0400)];

/// A board with the loader, on RS-485 A its panel.
struct Slotted {
    around: Surroundings,
    /// What a probe has written into slot A.
    slot_a: PathBuf,
    chip: Option<Process>,
}

impl Board for Slotted {
    fn around(&self) -> &Surroundings {
        &self.around
    }

    fn around_mut(&mut self) -> &mut Surroundings {
        &mut self.around
    }

    fn start(&mut self, file: &Path) {
        let mut more = vec!["--load".into(), format!("0x08020000={}", self.slot_a.display()).into()];
        for slot in ["CHIP_SLOT_A", "CHIP_SLOT_B"] {
            more.extend(["--knows".into(), Surroundings::named(slot).into()]);
        }
        self.chip = Some(emulate(&self.around, &Surroundings::named("CHIP_LOADER"), file, &more));
    }

    fn press(&self) {
        chip::command(&self.control(), "press 200");
    }

    fn kill(&mut self) {
        chip::command(&self.control(), "power");
    }

    fn short_trial_s(&self) -> u32 {
        60
    }
}

impl Slotted {
    /// In service: claimed, its panel plugged in, everything works.
    fn in_service(slot_a: &Path) -> Self {
        let mut board = Self { around: Surroundings::new(), slot_a: slot_a.to_owned(), chip: None };
        let made = BINARY.command().args(["ctl", "keygen"]).arg(board.around.path("key")).output().unwrap();
        assert!(made.status.success(), "{made:?}");
        let file = PathBuf::from(board.around.path("first.toml"));
        std::fs::write(&file, board.config(500)).unwrap();
        // The loader checks what it has never run.
        Board::start(&mut board, &file);
        patiently("it answers", || {
            let printed = board.ctl().run(&["update"]);
            // One that has no key says so.
            (printed.code == 0 || printed.err.contains("key")).then_some(())
        });
        board.claim();
        board.plug();
        board.ctl().until(0, &["status"]);
        board
    }

    fn control(&self) -> PathBuf {
        control(&self.around)
    }

    fn key(&self) -> PathBuf {
        self.around.path("key").into()
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

impl Drop for Slotted {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let log = self.chip.as_ref().map_or_else(String::new, |chip| chip.lines().join("\n"));
            eprintln!("the log of a board:\n{log}");
        }
        self.pull();
    }
}

/// Update files.
struct Releases(TempDir);

impl Releases {
    fn new() -> Self {
        let releases = Self(tempfile::tempdir().unwrap());
        let mut key = std::fs::OpenOptions::new();
        let mut key = key.write(true).create_new(true).mode(0o600).open(releases.path("the.key")).unwrap();
        std::io::Write::write_all(&mut key, SEED.as_bytes()).unwrap();
        releases
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// `ctl` without a board.
    #[track_caller]
    fn ctl(args: &[&str]) {
        let made = BINARY.command().arg("ctl").args(args).output().unwrap();
        assert!(made.status.success(), "{made:?}");
    }

    /// An update of what was built, changed in both links and signed with this key; returns its path.
    fn sign(&self, name: &str, key: &str, change: impl Fn(&mut [u8], u32)) -> String {
        let linked = SLOTS.map(|(slot, start)| {
            let built = Surroundings::named(&format!("CHIP_SLOT_{slot:?}"));
            let mut elf =
                std::fs::read(&built).unwrap_or_else(|error| panic!("{}: {error}", built.display()));
            change(&mut elf, start);
            let path = self.path(&format!("{name}-{slot:?}.elf"));
            std::fs::write(&path, elf).unwrap();
            path.display().to_string()
        });
        let (key, file) = (self.path(key).display().to_string(), self.path(name).display().to_string());
        let [a, b] = &linked;
        let what = ["--board", "nucleo-h743zi", "--version", env!("CARGO_PKG_VERSION")];
        let files = ["--signing-key", &key, "--slot-a", a, "--slot-b", b, "-o", &file];
        Self::ctl(&[&["sign"], &what[..], &files].concat());
        file
    }
}

/// Another text in its place.
fn another_text(elf: &mut [u8], _: u32) {
    let places: Vec<_> =
        (0..elf.len() - TEXT.len()).filter(|at| elf[*at..].starts_with(TEXT.as_bytes())).collect();
    assert!(!places.is_empty(), "the firmware has no text {TEXT:?}");
    for at in places {
        elf[at..at + TEXT.len()].copy_from_slice(OTHER_TEXT.as_bytes());
    }
}

/// It asks for a reset with its first instructions (Armv7-M ARM A7.7): ldr r0, [pc, #4]; ldr r1, [pc, #8];
/// str r1, [r0]; b .
fn that_does_not_run(elf: &mut [u8], start: u32) {
    let vectors = place(elf, start);
    let reset = number(elf, vectors + 4) & !1;
    let mut code: Vec<u16> = Vec::new();
    if reset % 4 == 2 {
        code.push(0xBF00);
    }
    code.extend([0x4801, 0x4902, 0x6001, 0xE7FE]);
    let mut bytes: Vec<u8> = code.iter().flat_map(|half| half.to_le_bytes()).collect();
    bytes.extend([0xE000_ED0C_u32, 0x05FA_0004].iter().flat_map(|word| word.to_le_bytes()));
    let at = place(elf, reset);
    elf[at..at + bytes.len()].copy_from_slice(&bytes);
}

/// Where a byte of flash is in an ELF file.
fn place(elf: &[u8], address: u32) -> usize {
    let half = |at: usize| usize::from(u16::from_le_bytes([elf[at], elf[at + 1]]));
    let (headers, size, count) = (number(elf, 28) as usize, half(42), half(44));
    let segments = (0..count).map(|nth| headers + nth * size);
    let found =
        segments.map(|at| [1, 3, 4].map(|word| number(elf, at + 4 * word))).find_map(|[from, paddr, len]| {
            let behind = address.checked_sub(paddr).filter(|behind| *behind < len)?;
            Some((from + behind) as usize)
        });
    found.expect("it is in the program")
}

fn number(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn unchanged(_: &mut [u8], _: u32) {}

#[test]
#[ignore = "needs CHIP_UNICORN, CHIP_LOADER, CHIP_SLOT_A, CHIP_SLOT_B and qemu-system-arm"]
fn a_plant_of_nucleos_gets_another_firmware() {
    let releases = Releases::new();
    let first = releases.sign("first.rgu", "the.key", unchanged);
    let second = releases.sign("second.rgu", "the.key", another_text);
    let broken = releases.sign("broken.rgu", "the.key", that_does_not_run);
    let flat = releases.path("slot-a.bin");
    Releases::ctl(&["inspect", &first, "--slot", "a", "-o", flat.to_str().unwrap()]);
    let (press, saw) = std::thread::scope(|scope| {
        let saw = scope.spawn(|| Slotted::in_service(&flat));
        (Slotted::in_service(&flat), saw.join().unwrap())
    });
    std::thread::scope(|scope| {
        scope.spawn(|| refuses_what_is_foreign_or_changed(&saw, &releases, &second));
        is_updated_and_taken_back(&press, &first, &second);
    });

    let entry = |name: &str, board: &Slotted| {
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
fn is_updated_and_taken_back(board: &Slotted, first: &str, second: &str) {
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
    let tried = ctl.done(&["update", first, "--try"]);
    assert!(tried.contains("runs on trial"), "{tried}");
    assert_eq!(board.firmware()["slot"], "A");
    ctl.done(&["update", "--back"]);
    board.runs("B", OTHER_TEXT);
    assert_eq!(board.firmware()["last"], json!({ "slot": "A", "ended": "taken_back" }));
    ctl.until(0, &["status"]);
}

/// Refused by `ctl`, which sends nothing; and by the board, when all is sent.
fn refuses_what_is_foreign_or_changed(board: &Slotted, releases: &Releases, second: &str) {
    let ctl = board.ctl();
    let (before, restarts) = (board.firmware(), figures(board)["restarts"].as_u64().unwrap());
    Releases::ctl(&["keygen", "--signing", releases.path("other.key").to_str().unwrap()]);
    let foreign = releases.sign("foreign.rgu", "other.key", another_text);
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
    patiently("it restarts with what it had", || {
        (figures(board)["restarts"].as_u64()? > restarts).then_some(())
    });
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

fn figures(board: &Slotted) -> Value {
    serde_json::from_str(&chip::request(&board.control(), "figures")).unwrap()
}
