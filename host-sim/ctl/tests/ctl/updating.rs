//! A rollout over boards that speak the API, as far as an update needs it.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use recipe_ctl::rollout::{
    BoardOutcome, Left, RolloutPlan, RolloutReport, RolloutStep, real_boards, roll_out, version_of,
};
use recipe_ctl::update::Downgrade;
use recipe_ctl::{Stop, Update};
use serde_json::{Value, json};

use crate::firmware::Folder;
use crate::server::*;

const PATIENT: Duration = Duration::from_secs(20);
const PLAN: RolloutPlan = RolloutPlan {
    batch: 2,
    stop_on_failure: false,
    patience: Duration::from_secs(2),
    settled: Duration::ZERO,
};

/// How a board does while the new firmware is on trial.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Well,
    Worse,
    /// It is a gateway on a host.
    Program,
    /// Its connection breaks after the first piece.
    Breaks,
    /// It runs the version of the update, in another build, and says which.
    Rebuilt,
    /// What it is given does not run.
    Fails,
}

#[derive(Debug, Default)]
struct Inside {
    is_updated: bool,
    on_trial: bool,
    received: Vec<u8>,
    has_broken: bool,
    confirm_s: Option<u64>,
    last: Option<&'static str>,
}

struct Board {
    server: Server,
    inside: Arc<Mutex<Inside>>,
}

impl Board {
    fn start(kind: Kind) -> Self {
        let inside = Arc::<Mutex<Inside>>::default();
        let within = Arc::clone(&inside);
        let server = Server::start(move |asked| answer(kind, &mut within.lock().unwrap(), asked));
        Self { server, inside }
    }

    /// How many requests were of this method.
    fn count(&self, method: &str) -> usize {
        self.server.asked().iter().filter(|asked| asked.method == method).count()
    }
}

fn answer(kind: Kind, inside: &mut Inside, asked: &Asked) -> Reply {
    let (path, query) = asked.path.split_once('?').unwrap_or((&asked.path, ""));
    if asked.method != "GET" && asked.signed_nonce().is_none() {
        return document(401, "", &json!({ "error": "the key is wrong" }));
    }
    if kind == Kind::Program && path.starts_with("update") {
        return document(501, "", &json!({ "error": "this gateway is a program" }));
    }
    match (asked.method.as_str(), path) {
        ("GET", "nonce") => ok(&json!({ "nonce": "0000000928a724da00000000c27868a9e87ad27a773140a5" })),
        ("GET", "status") => {
            let is_well = !(kind == Kind::Worse && inside.on_trial);
            ok(&json!({
                "health": if is_well { "running" } else { "link-down" },
                "links": { "modbus": { "state": if is_well { "up" } else { "down" } } },
                "ports": { "force": { "state": "working" } },
            }))
        }
        ("GET", "update") => ok(&said(kind, inside)),
        ("PUT", "update") => {
            let offset: usize = query.strip_prefix("offset=").unwrap().parse().unwrap();
            if offset > 0 && kind == Kind::Breaks && !std::mem::replace(&mut inside.has_broken, true) {
                return Reply::Bytes(Vec::new());
            }
            // The header of what is being received changes nothing.
            if offset == inside.received.len() {
                inside.received.extend(&asked.body);
            }
            ok(&said(kind, inside))
        }
        ("POST", "update/try") => {
            inside.confirm_s = asked.json()["confirm_s"].as_u64();
            inside.on_trial = kind != Kind::Fails;
            if kind == Kind::Fails {
                inside.last = Some("failed");
                // It has restarted, and knows nothing of what came before.
                inside.received.clear();
            }
            document(202, "", &said(kind, inside))
        }
        ("POST", "update/confirm") => {
            inside.is_updated = true;
            end_trial(kind, inside, "confirmed")
        }
        ("POST", "update/back") => {
            let before = document(202, "", &said(kind, inside));
            let _ = end_trial(kind, inside, "taken_back");
            before
        }
        _ => not_found(),
    }
}

fn end_trial(kind: Kind, inside: &mut Inside, how: &'static str) -> Reply {
    inside.on_trial = false;
    inside.last = Some(how);
    ok(&said(kind, inside))
}

/// The document `update`.
fn said(kind: Kind, inside: &Inside) -> Value {
    let is_new = inside.is_updated || inside.on_trial;
    let mut said = json!({
        "board": "nucleo-h743zi",
        "version": if is_new || kind == Kind::Rebuilt { "0.3.0" } else { "0.2.0" },
        "slot": if is_new { "B" } else { "A" },
    });
    if kind == Kind::Rebuilt {
        let hash = inside.received.get(96..104).filter(|_| is_new).unwrap_or(&[0x0B; 8]);
        said["sha512"] = hash.iter().map(|byte| format!("{byte:02x}")).collect::<String>().into();
    }
    if inside.on_trial {
        said["trial"] = json!({ "left_s": 60.0, "waits_for": "controller" });
    }
    if let Some(how) = inside.last {
        said["last"] = json!({ "slot": "B", "ended": how });
    }
    if let Some(length) = inside.received.get(76..80) {
        let length = 192 + u32::from_le_bytes(length.try_into().unwrap()) as usize;
        let state = if inside.received.len() < length { "receiving" } else { "ready" };
        let received = inside.received.len();
        said["incoming"] = json!({ "state": state, "sha512": "00", "length": length, "received": received });
    }
    said
}

fn rolled_out(boards: &[Board], update: &Update) -> RolloutReport {
    let folder = tempfile::tempdir().unwrap();
    key_file(&folder, "the.key");
    let entry = |(nth, board): (usize, &Board)| {
        format!("[[gateway]]\nname = \"cell-{nth}\"\naddress = \"{}\"\nkey = \"the.key\"\n", board.server.at)
    };
    let path = folder.path().join("plant.toml");
    std::fs::write(&path, boards.iter().enumerate().map(entry).collect::<String>()).unwrap();
    let members = recipe_ctl::members(&path, &[]).unwrap();
    let boards = real_boards(&members, update, PATIENT, 60, Downgrade::Refused).unwrap();
    roll_out(&version_of(update).unwrap(), &boards, PLAN, &Stop::new(), &|_| {})
}

#[test]
fn boards_of_an_inventory_are_updated_and_one_that_does_worse_is_taken_back() {
    let folder = Folder::new();
    let update = folder.update();
    let boards = [Kind::Well, Kind::Worse, Kind::Program, Kind::Breaks].map(Board::start);
    let report = rolled_out(&boards, &update);
    let outcomes: Vec<_> = report.entries.iter().map(|entry| &entry.outcome).collect();
    assert_eq!(outcomes[0], &BoardOutcome::Updated);
    let BoardOutcome::Failed { step: RolloutStep::Health, why, left: Left::Before } = outcomes[1] else {
        panic!("{report:?}")
    };
    assert_eq!(why, "it does worse than before");
    let BoardOutcome::Failed { step: RolloutStep::Inspect, why, .. } = outcomes[2] else {
        panic!("{report:?}")
    };
    assert!(why.contains("this gateway is a program"), "{why}");
    assert_eq!(outcomes[3], &BoardOutcome::Updated);
    let (before, after) = (report.entries[1].before.as_ref(), report.entries[1].after.as_ref());
    assert_eq!(before.zip(after).map(|(before, after)| (before.links_up, after.links_up)), Some((1, 0)));

    // What each board was sent is the firmware for its free slot.
    let link = update.links()[1];
    for (board, is_updated) in [(&boards[0], true), (&boards[1], false), (&boards[3], true)] {
        let inside = board.inside.lock().unwrap();
        assert_eq!(inside.received, [link.header_bytes, link.image].concat());
        assert_eq!((inside.is_updated, inside.on_trial, inside.confirm_s), (is_updated, false, Some(60)));
    }
    assert_eq!((boards[2].count("PUT"), boards[2].count("POST")), (0, 0));

    // Again: who runs it is only asked.
    let sent = boards[0].count("PUT") + boards[0].count("POST");
    let report = rolled_out(&boards, &update);
    assert_eq!(report.entries[0].outcome, BoardOutcome::Already);
    assert_eq!(report.entries[3].outcome, BoardOutcome::Already);
    assert_eq!(boards[0].count("PUT") + boards[0].count("POST"), sent);
}

#[test]
fn another_build_of_the_same_version_is_sent_and_the_same_one_is_not() {
    let folder = Folder::new();
    let update = folder.update();
    let boards = [Kind::Rebuilt].map(Board::start);
    assert_eq!(rolled_out(&boards, &update).entries[0].outcome, BoardOutcome::Updated);
    let sent = boards[0].count("PUT");
    assert!(sent > 0);
    assert_eq!(rolled_out(&boards, &update).entries[0].outcome, BoardOutcome::Already);
    assert_eq!(boards[0].count("PUT"), sent);
}

/// The second end of a trial is told as the first one, although the board says the same of both.
#[test]
fn a_firmware_that_does_not_run_is_told_each_time() {
    let folder = Folder::new();
    let update = folder.update();
    let boards = [Kind::Fails].map(Board::start);
    for _ in 0..2 {
        let report = rolled_out(&boards, &update);
        let BoardOutcome::Failed { step: RolloutStep::Begin, why, .. } = &report.entries[0].outcome else {
            panic!("{report:?}")
        };
        assert!(why.contains("the firmware did not run"), "{why}");
    }
}

#[test]
fn a_firmware_for_another_board_is_not_sent() {
    let folder = Folder::new();
    let update = folder.update();
    let board = Server::start(|asked| match asked.path.as_str() {
        "update" => ok(&json!({ "board": "other-board", "version": "0.2.0", "slot": "A" })),
        _ => not_found(),
    });
    let board = Board { server: board, inside: Arc::default() };
    let report = rolled_out(std::slice::from_ref(&board), &update);
    let BoardOutcome::Failed { step: RolloutStep::Inspect, why, .. } = &report.entries[0].outcome else {
        panic!("{report:?}")
    };
    assert!(why.contains("this is a other-board; the firmware is for the board nucleo-h743zi"), "{why}");
    assert_eq!((board.count("PUT"), board.count("POST")), (0, 0));
}
