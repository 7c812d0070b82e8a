//! A board: the firmware in QEMU, with a panel at its line and a controller, against the same mosquitto, read by the same
//! reader.
//!
//! Its settings are a file for `host-sim ctl edge`. UTC comes from a server of SNTP that the test plays.

use std::net::UdpSocket;
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use recipe_test_kit::until;
use serde_json::Value as Json;

use crate::broker::{Plant, Way};
use crate::ctl::{Ctl, TIMEOUT};
use crate::qemu::Qemu;
use crate::reader::{Reader, Told, Value};
use crate::target::Target;

/// Answers requests of SNTP with the machine's clock as long as the test runs; returns its port.
fn time_server() -> u16 {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = socket.local_addr().unwrap().port();
    std::thread::spawn(move || {
        let mut request = [0; 100];
        while let Ok((len, from)) = socket.recv_from(&mut request) {
            assert_eq!((len, request[0]), (48, 0x23));
            let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
            let mut reply = [0; 48];
            (reply[0], reply[1]) = (0x24, 2);
            reply[24..32].copy_from_slice(&request[40..48]);
            let seconds = (now.as_secs() + 2_208_988_800) as u32;
            let fraction = (u64::from(now.subsec_nanos()) << 32) / 1_000_000_000;
            reply[40..44].copy_from_slice(&seconds.to_be_bytes());
            reply[44..].copy_from_slice(&(fraction as u32).to_be_bytes());
            let _ = socket.send_to(&reply, from);
        }
    });
    port
}

fn bd_seq(told: &Told) -> u64 {
    match told.value("bdSeq") {
        Some(Value::Long(number)) => *number,
        other => panic!("{other:?}"),
    }
}

/// The board in its cell, claimed, with its panel.
fn board() -> (Qemu, Ctl) {
    let mut board = Qemu::new();
    let file = board.folder().path().join("cell.toml");
    std::fs::write(&file, board.config(3_000)).unwrap();
    board.start(&file);
    board.claim();
    board.plug();
    let key = Some(board.folder().path().join("key"));
    let ctl = Ctl { to: board.address(), host: board.host(), key, timeout: TIMEOUT };
    (board, ctl)
}

/// The Sparkplug file for the board, which reaches this machine by another address.
pub(crate) fn settings(plant: &Plant, rest: &str) -> PathBuf {
    let file = plant.sparkplug("plain = true\nlogin = \"press.login\"", "", rest);
    let text = std::fs::read_to_string(&file).unwrap().replace("localhost", "10.0.2.2");
    plant.write("board.toml", &text)
}

#[test]
#[ignore = "needs mosquitto, HOST_SIM_FIRMWARE and qemu-system-arm"]
fn a_plant_reads_a_board_and_its_broker_dies_and_comes_back() {
    let plant = Plant::new(Way::Plain);
    let mut broker = plant.broker();
    let mut reader = Reader::new(&plant);
    let (mut board, ctl) = board();
    assert_eq!(ctl.json(&["edge"]), serde_json::json!({ "state": "off" }));
    // What a board has not is refused before anything is sent.
    let tls = plant.write(
        "tls.toml",
        &std::fs::read_to_string(settings(&plant, "")).unwrap().replace("plain = true", "ca = \"ca.pem\""),
    );
    let refused = ctl.run(&["edge", tls.to_str().unwrap()]).must_be(2);
    assert!(refused.err.contains("a board speaks no TLS"), "{}", refused.err);

    let file = settings(
        &plant,
        &format!("values = [\"RobotState[1..2]\"]\n[time]\nserver = \"10.0.2.2:{}\"", time_server()),
    );
    let out = ctl.done(&["edge", file.to_str().unwrap(), "--restart"]);
    assert!(out.contains("online"), "{out}");
    let (at, birth) = reader.verb(0, "NBIRTH");
    assert_eq!((at, bd_seq(&birth)), (0, 0), "births are the first messages");
    for name in ["Node Info/Version", "port/device/alive", "link/modbus/up", "controller/RobotState/2"] {
        birth.metric(name);
    }
    // Once it knows the time it is born again; from then on the reader compares with its own clock.
    let with_utc = |told: &Told| told.value("Node Info/UTC") == Some(&Value::Boolean(true));
    let (at, birth) = reader.next(at, "a birth with UTC", |told| told.verb == "NBIRTH" && with_utc(told));
    assert_eq!(bd_seq(&birth), 0);
    let (at, device) = reader.next(at, "the panel's birth", |told| {
        told.verb == "DBIRTH" && told.device.as_deref() == Some("device")
    });
    assert_eq!(device.value("state"), Some(&Value::Text("working".into())));
    let is_growing = |told: &Told| told.verb == "DDATA" && told.value("frames/in").is_some();
    let (at, _) = reader.next(at, "its frames", is_growing);
    // The panel falls silent, and comes back.
    board.pull();
    let (at, _) = reader.verb(at, "DDEATH");
    board.plug();
    reader.verb(at, "DBIRTH");

    broker.kill();
    let state = |wanted: &str| {
        until(wanted, || {
            let document: Json = serde_json::from_str(&ctl.run(&["--json", "edge"]).out).ok()?;
            (document["state"] == wanted).then_some(document)
        })
    };
    let lost = state("offline");
    assert_eq!(lost["why"], "no connection", "{lost}");
    let _broker = plant.broker();
    let mut reader = Reader::new(&plant);
    let (at, birth) = reader.verb(0, "NBIRTH");
    assert!(at == 0 && bd_seq(&birth) >= 1 && with_utc(&birth), "{birth:?}");
    reader.verb(at, "DBIRTH");
    let document = state("online");
    assert!(document["counters"]["sessions"].as_u64() >= Some(2), "{document}");
    assert!(!document.to_string().contains("cold steel"));

    // Its plug is pulled: the broker tells of its death. The next session has the next number.
    let before = bd_seq(&birth);
    Target::kill(&mut board);
    let (at, death) = reader.verb(at, "NDEATH");
    assert_eq!(bd_seq(&death), before);
    let cell = board.folder().path().join("cell.toml");
    board.start(&cell);
    let (_, birth) = reader.verb(at, "NBIRTH");
    assert!(bd_seq(&birth) > before, "{birth:?}");

    // With a wrong password it says so.
    plant.write("press.login", "press\nlukewarm iron\n");
    let file = settings(&plant, "");
    let printed = ctl.run(&["edge", file.to_str().unwrap(), "--restart"]).must_be(3);
    assert!(
        printed.out.contains("the broker does not allow this client") || printed.out.contains("password"),
        "{printed:?}"
    );
    let out = ctl.done(&["edge", "--off", "--restart"]);
    assert!(out.contains("off"), "{out}");
}
