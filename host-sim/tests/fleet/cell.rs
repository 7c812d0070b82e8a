//! A whole cell: a controller, a gateway with a device, a broker with TLS, and who reads there.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering::Relaxed};
use std::time::Duration;

use prost::Message;
use recipe_test_kit::{Binary, HostSim, example, until};
use rustix::process::Signal;

use crate::broker::{Plant, Way, is_written};
use crate::reader::{Metric, Payload, PropertyKind, Reader, Told, Value};

pub(crate) const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));

/// A controller, and a device on a line that sends a value all the time.
pub(crate) struct Cell {
    robot: HostSim,
    folder: tempfile::TempDir,
    /// What the device sends; 0: nothing.
    pub(crate) value: Arc<AtomicU8>,
}

impl Cell {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let bind = format!("--bind=rs485=pty:{}", folder.path().join("robot").display());
        let robot = BINARY.controller(&example("rs485-system-controller.toml"), &[&bind]);
        let value = Arc::new(AtomicU8::new(1));
        let (line, sent) = (folder.path().join("line"), Arc::downgrade(&value));
        std::thread::spawn(move || {
            // Ends with the cell.
            while let Some(value) = sent.upgrade().map(|value| value.load(Relaxed)) {
                if value != 0
                    && let Ok(mut line) = std::fs::File::options().write(true).open(&line)
                {
                    let _ = line.write_all(&[0xFF, 0xFF, value, 0xEE, 0xEE]);
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        Self { robot, folder, value }
    }

    pub(crate) fn gateway(&self, sparkplug: &Path) -> HostSim {
        let bind = format!("--bind=rs485-1=pty:{}", self.folder.path().join("line").display());
        let sparkplug = format!("--sparkplug={}", sparkplug.display());
        // The device's pauses are the machine's.
        let set = "--set=port.rs485-1.timeout_ms=3000";
        BINARY.gateway(&example("rs485-system.toml"), &self.robot, &[&bind, &sparkplug, set])
    }
}

pub(crate) const TLS: &str = "ca = \"ca.pem\"\nlogin = \"press.login\"";

/// The number of the session that a birth or a death tells.
fn bd_seq(told: &Told) -> u64 {
    match told.value("bdSeq") {
        Some(Value::Long(number)) => *number,
        other => panic!("{other:?}"),
    }
}

fn command(name: &str, value: bool) -> Vec<u8> {
    let metric = Metric {
        name: Some(name.into()),
        datatype: Some(11),
        value: Some(Value::Boolean(value)),
        ..Metric::default()
    };
    Payload { timestamp: Some(1), metrics: vec![metric], seq: None }.encode_to_vec()
}

#[test]
#[ignore = "needs mosquitto"]
fn a_plant_reads_a_cell_from_birth_to_death() {
    let plant = Plant::new(Way::Tls);
    let _broker = plant.broker();
    let mut reader = Reader::new(&plant);
    let cell = Cell::new();
    let file = plant.sparkplug(TLS, "bd_seq = \"bdseq\"", "values = [\"RobotState[1..2]\"]");
    let gateway = cell.gateway(&file);

    let (at, birth) = reader.verb(0, "NBIRTH");
    assert_eq!((at, bd_seq(&birth)), (0, 0), "births are the first messages");
    for name in [
        "Node Control/Rebirth",
        "Node Info/Version",
        "port/rs485-1/alive",
        "link/modbus/up",
        "controller/mode",
    ] {
        birth.metric(name);
    }
    assert_eq!(birth.value("Node Info/UTC"), Some(&Value::Boolean(true)));
    let joint = birth.metric("controller/RobotState/1").properties.clone().unwrap();
    let unit = joint.keys.iter().position(|key| key == "engUnit").map(|at| joint.values[at].value.clone());
    assert_eq!(unit.flatten(), Some(PropertyKind::Text("rad".into())));
    let (at, device) = reader.verb(at, "DBIRTH");
    assert_eq!(device.device.as_deref(), Some("rs485-1"));

    // Values are told when they change.
    let name = "DigitalOutputCommand/1";
    cell.value.store(6, Relaxed);
    let (at, _) = reader
        .next(at, "the new value", |told| told.verb == "DDATA" && told.value(name) == Some(&Value::Int(6)));
    let (at, data) =
        reader.next(at, "counters", |told| told.verb == "DDATA" && told.value("frames/in").is_some());
    assert!(data.value(name).is_none(), "it did not change: {data:?}");

    // A command is no way in, but for the request for births.
    plant.publish("spBv1.0/hall/NCMD/press", false, &command("controller/mode", true));
    plant.publish("spBv1.0/hall/NCMD/press", false, b"no payload");
    let refused = |told: &Told| told.value("gateway/commands_refused") == Some(&Value::Int(1));
    let (at, _) = reader.next(at, "the refusal", refused);
    plant.publish("spBv1.0/hall/NCMD/press", false, &command("Node Control/Rebirth", true));
    let (at, birth) = reader.verb(at, "NBIRTH");
    assert_eq!(bd_seq(&birth), 0);
    let (at, device) = reader.verb(at, "DBIRTH");
    assert_eq!(device.value(name), Some(&Value::Int(6)));

    // The device falls silent, and comes back.
    cell.value.store(0, Relaxed);
    let (at, _) = reader.verb(at, "DDEATH");
    cell.value.store(7, Relaxed);
    let (at, device) = reader.verb(at, "DBIRTH");
    assert_eq!(device.value("state"), Some(&Value::Text("working".into())));

    // Killed: the broker tells of the death. The next session has the next number.
    drop(gateway);
    let (at, death) = reader.verb(at, "NDEATH");
    assert_eq!(bd_seq(&death), 0);
    assert!(is_written(&plant.path("bdseq")));
    let gateway = cell.gateway(&file);
    let (at, birth) = reader.verb(at, "NBIRTH");
    assert_eq!(bd_seq(&birth), 1);
    // Ended: it tells so itself.
    gateway.ended_by(Signal::TERM);
    let (_, death) = reader.verb(at, "NDEATH");
    assert_eq!(bd_seq(&death), 1);
}

#[test]
#[ignore = "needs mosquitto"]
fn what_changes_while_the_broker_is_away_is_told_later() {
    let plant = Plant::new(Way::Tls);
    let mut broker = plant.broker();
    let mut reader = Reader::new(&plant);
    let cell = Cell::new();
    let gateway = cell.gateway(&plant.sparkplug(TLS, "primary_host = \"scada\"", ""));
    let state = |is_online: bool, at: u64| {
        let payload = format!("{{\"online\":{is_online},\"timestamp\":{at}}}");
        plant.publish("spBv1.0/STATE/scada", true, payload.as_bytes());
    };
    // Without the host the node is silent; whatever comes, it comes behind this.
    state(false, 1);
    gateway.fresh();
    state(true, 2);
    reader.verb(0, "DBIRTH");
    assert_eq!(reader.told[0].verb, "NBIRTH");

    broker.kill();
    until("the loss is logged", || {
        gateway.errors().iter().any(|line| line.contains("no session")).then_some(())
    });
    for value in 10..60 {
        cell.value.store(value, Relaxed);
        gateway.fresh();
    }
    let _broker = plant.broker();
    // It waits for the host, and the reader is there before.
    let mut reader = Reader::new(&plant);
    state(true, 3);
    let (at, birth) = reader.verb(0, "NBIRTH");
    assert!(at == 0 && bd_seq(&birth) >= 1, "{birth:?}");
    let name = "DigitalOutputCommand/1";
    let past = |told: &Told| {
        told.device.is_some() && told.values.iter().any(|(known, _, is_past)| known == name && *is_past)
    };
    let (_, past) = reader.next(at, "the past", past);
    let told: Vec<_> =
        past.payload.metrics.iter().zip(&past.values).filter(|(_, (known, ..))| known == name).collect();
    assert!(told.len() >= 3, "{told:?}");
    assert!(told.is_sorted_by_key(|(metric, _)| metric.timestamp));
    assert!(told.iter().all(|(metric, _)| metric.timestamp < birth.payload.timestamp));
    let values: Vec<_> = told.iter().map(|(_, (_, value, _))| value).collect();
    assert!(values.iter().all(|value| matches!(value, Some(Value::Int(10..60)))), "{values:?}");

    // The host goes: the node dies, and says so.
    state(false, 4);
    let (at, death) = reader.verb(at, "NDEATH");
    assert_eq!(bd_seq(&death), bd_seq(&birth));
    until("the reason is logged", || {
        gateway.errors().iter().any(|line| line.contains("the primary host is offline")).then_some(())
    });
    state(true, 5);
    let (_, again) = reader.verb(at, "NBIRTH");
    assert!(bd_seq(&again) > bd_seq(&birth));
}
