//! The edge node on the board: settings by the API, births, data, commands, a broker that dies, refuses, is silent,
//! sends garbage or takes nothing; and what all this costs the cell, which is nothing.
//!
//! Everything is in virtual time, so the same happens in every run.

use proto_core::sysvar::VarRange;
use proto_core::time::Duration;
use recipe_chip_model::device::{MICRO, MILLI, Picos, SECOND};
use recipe_sparkplug::document::{Host, MAX_DOCUMENT, NodeDocument, OFF};
use recipe_sparkplug::node::{Credential, Settings};
use recipe_sparkplug::topic::Id;
use recipe_test_kit::http::Response;
use serde_json::Value;

use crate::Bench;
use crate::broker::{Broker, BrokerMode, EdgeMessages};
use crate::client::{ask_signed, claim, exchange, signed_with};
use crate::load::work;
use crate::page::cyclic;

/// How much later a cycle may be for an edge node: a part of a sample, or a piece of a birth.
const LATER: Picos = 500 * MICRO;
/// `Node Control/Rebirth` = true, as a host sends it.
const REBIRTH: &[u8] = b"\x12\x1a\x0a\x14Node Control/Rebirth\x20\x0b\x70\x01";

fn settings() -> Vec<u8> {
    let id = |name| Id::new(name).expect("a name");
    let mut settings = Settings::new(id("hall"), id("press"));
    settings.login = Credential::new("press").zip(Credential::new("cold steel"));
    settings.keep_alive = Duration::from_secs(5);
    let host = Host::try_from("192.168.12.10").expect("an address");
    let mut document = NodeDocument { host: host.clone(), port: 1883, settings, ..NodeDocument::empty() };
    document.time_server = Some((host, 123));
    let time = Duration::from_millis(100);
    (document.sample, document.interval, document.counter_interval) = (time, time, time);
    let joints = VarRange::parse("RobotState[1..12]").expect("variables");
    document.values.push(joints).expect("there is room");
    document.encode(&mut [0; MAX_DOCUMENT]).expect("right settings").to_vec()
}

#[track_caller]
fn put(bench: &mut Bench, line: &str, body: &[u8]) -> Response {
    let request = signed_with(bench, line, "Content-Type: application/octet-stream", body);
    exchange(bench, &request)
}

fn state(bench: &mut Bench) -> Value {
    ask_signed(bench, "GET /api/v1/edge").json()
}

/// A claimed board in a cell whose links are up.
fn claimed() -> Bench {
    let mut bench = cyclic();
    claim(&mut bench);
    bench
}

/// Restarts the board with these settings or none.
#[track_caller]
fn restart(bench: &mut Bench, settings: &[u8]) {
    put(bench, "PUT /api/v1/edge?restart=yes", settings).must_be(202);
    bench.look_no_further_back();
    bench.until_log("address", 10 * SECOND);
}

/// The same, until its links are up.
fn restarted(mut bench: Bench, settings: &[u8]) -> (Bench, Broker) {
    let mut broker = Broker::new(&mut bench);
    restart(&mut bench, settings);
    bench.until("a Modbus connection", 10 * SECOND, |bench| {
        broker.go_on(bench);
        bench.robot.as_ref().is_some_and(|robot| robot.counters().modbus.open == 1)
    });
    run(&mut bench, &mut broker, SECOND);
    (bench, broker)
}

fn run(bench: &mut Bench, broker: &mut Broker, span: Picos) {
    let end = bench.now() + span;
    while bench.now() < end {
        broker.go_on(bench);
        bench.run(MILLI);
    }
}

/// Runs until the broker has such a message behind `from`; returns its place.
#[track_caller]
fn until_told(
    bench: &mut Bench,
    broker: &mut Broker,
    from: usize,
    what: &str,
    is_it: impl Fn(&EdgeMessages) -> bool,
) -> usize {
    let mut found = None;
    bench.until(what, 60 * SECOND, |bench| {
        broker.go_on(bench);
        found = (from..broker.told.len()).find(|at| is_it(&broker.told[*at]));
        found.is_some()
    });
    found.expect("it was found")
}

#[track_caller]
fn until_verb(bench: &mut Bench, broker: &mut Broker, from: usize, verb: &str) -> usize {
    let part = format!("/{verb}/");
    until_told(bench, broker, from, verb, |told| told.topic.contains(&part))
}

/// Runs with the broker until the document says so.
#[track_caller]
fn until_state(bench: &mut Bench, broker: &mut Broker, what: &str, is_it: impl Fn(&Value) -> bool) -> Value {
    for _ in 0..100 {
        run(bench, broker, SECOND);
        let document = state(bench);
        if is_it(&document) {
            return document;
        }
    }
    panic!("{what}: {}\n{}", state(bench), bench.history())
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_plant_reads_the_board_from_birth_to_the_next_session() {
    let mut bench = claimed();
    assert_eq!(state(&mut bench), serde_json::json!({ "state": "off" }));
    for (wrong, status) in [(&b"RGWE\x01\x01"[..], 422), (b"", 422), (&[0; 4_000], 422)] {
        put(&mut bench, "PUT /api/v1/edge", wrong).must_be(status);
    }
    // Stored; no connection is opened before a restart.
    put(&mut bench, "PUT /api/v1/edge", &settings()).must_be(200);
    assert_eq!(state(&mut bench), serde_json::json!({ "state": "off", "next": "other" }));
    let (mut bench, mut broker) = restarted(bench, &settings());

    let birth = until_verb(&mut bench, &mut broker, 0, "NBIRTH");
    assert_eq!(birth, 0, "it is the first message");
    assert!(!bench.history().contains("no connection"), "{}", bench.history());
    assert_eq!(broker.connects, [("press".into(), "cold steel".into(), 0)]);
    let told = broker.told[birth].clone();
    assert_eq!((told.topic.as_str(), told.seq), ("spBv1.0/hall/NBIRTH/press", Some(0)));
    let metric = |told: &EdgeMessages, name: &str| {
        let found = told.metrics.iter().find(|metric| metric.name.as_deref() == Some(name));
        found.unwrap_or_else(|| panic!("{name}: {told:?}")).clone()
    };
    assert_eq!(metric(&told, "Node Info/UTC").value, Some(0));
    metric(&told, "controller/RobotState/12");
    // Once the time is known all births are repeated.
    let utc_ms = 1_790_000_000_000;
    broker.utc_ms = Some(utc_ms);
    let again = until_verb(&mut bench, &mut broker, birth + 1, "NBIRTH");
    assert_eq!(metric(&broker.told[again], "Node Info/UTC").value, Some(1));

    // A device's birth follows its first frame; its values are published when they change.
    broker.device = Some(9);
    let device = until_told(&mut bench, &mut broker, again, "a device's birth", |told| {
        told.topic == "spBv1.0/hall/DBIRTH/press/rs485-1"
    });
    let value = metric(&broker.told[device], "WordInputReg/1");
    assert_eq!(value.value, Some(9));
    broker.device = Some(10);
    until_told(&mut bench, &mut broker, device, "its new value", |told| {
        let is_value =
            |metric: &crate::broker::Metric| metric.alias == value.alias && metric.value == Some(10);
        told.topic == "spBv1.0/hall/DDATA/press/rs485-1" && told.metrics.iter().any(is_value)
    });

    // Commands are ignored except the request for births.
    let from = broker.told.len();
    broker.publish(&mut bench, "spBv1.0/hall/NCMD/press", b"\x12\x13\x0a\x0dcontroller/x1\x20\x0b\x70\x01");
    broker.publish(&mut bench, "spBv1.0/hall/NCMD/press", REBIRTH);
    until_verb(&mut bench, &mut broker, from, "NBIRTH");
    let document = until_state(&mut bench, &mut broker, "online", |document| document["state"] == "online");
    assert_eq!((&document["counters"]["refused"], &document["utc"]), (&1.into(), &true.into()), "{document}");
    assert_eq!((&document["broker"], &document["bd_seq"]), (&"192.168.12.10:1883".into(), &0.into()));
    assert!(!document.to_string().contains("cold steel"));
    assert!(broker.pings > 0);

    // The power fails: the next session has the next number.
    let from = broker.told.len();
    bench.begin_again();
    broker.kill(&mut bench);
    until_verb(&mut bench, &mut broker, from, "NBIRTH");
    assert_eq!(broker.connects.last().map(|connect| connect.2), Some(1));

    // Switched off from the next start on.
    put(&mut bench, "PUT /api/v1/edge", &OFF).must_be(200);
    assert_eq!(state(&mut bench)["next"], "off");
    let connects = broker.connects.len();
    restart(&mut bench, &OFF);
    assert_eq!(state(&mut bench), serde_json::json!({ "state": "off" }));
    run(&mut bench, &mut broker, 5 * SECOND);
    assert_eq!(broker.connects.len(), connects);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn why_nothing_is_told_is_said_and_the_node_comes_back() {
    let (mut bench, mut broker) = restarted(claimed(), &settings());
    until_verb(&mut bench, &mut broker, 0, "NBIRTH");
    for (mood, why) in [
        (BrokerMode::Gone, "no connection"),
        (BrokerMode::Refuses(4), "the broker refuses the user or the password"),
        (BrokerMode::Refuses(5), "the broker does not allow this client"),
        (BrokerMode::Silent, "the broker does not answer"),
        (BrokerMode::Garbage, "the broker does not speak MQTT 3.1.1"),
    ] {
        broker.mood = mood;
        broker.kill(&mut bench);
        let document = until_state(&mut bench, &mut broker, why, |document| document["why"] == why);
        assert_eq!(document["state"], "offline", "{document}");
    }
    // Changes meanwhile are published after the births, with their own timestamps.
    broker.device = Some(77);
    run(&mut bench, &mut broker, SECOND);
    let from = broker.told.len();
    broker.mood = BrokerMode::Well;
    broker.kill(&mut bench);
    let birth = until_verb(&mut bench, &mut broker, from, "NBIRTH");
    until_told(&mut bench, &mut broker, birth, "the past", |told| {
        told.metrics.iter().any(|metric| metric.is_historical)
    });
    let numbers: Vec<u64> = broker.connects.iter().map(|connect| connect.2).collect();
    assert!(numbers.windows(2).all(|pair| pair[0] < pair[1]), "{numbers:?}");
    assert!(bench.chip.faults.is_empty());
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_broker_that_dies_and_comes_back_costs_the_cell_no_frame_and_no_cycle() {
    let span = 12 * SECOND;
    let (mut bench, _) = restarted(claimed(), &OFF);
    let alone = work(&mut bench, span, |_| {});
    let (mut bench, mut broker) = restarted(claimed(), &settings());
    until_verb(&mut bench, &mut broker, 0, "NBIRTH");
    let begin = bench.now();
    // All modes in turn; a failed node waits at most two seconds before it retries.
    let moods = [
        (0, BrokerMode::Well),
        (1_500, BrokerMode::Full),
        (2_500, BrokerMode::Gone),
        (3_000, BrokerMode::Garbage),
        (4_500, BrokerMode::Silent),
        (5_000, BrokerMode::Well),
    ];
    let mut asked = 0;
    let edge = work(&mut bench, span, |bench| {
        let ms = (bench.now() - begin) / MILLI;
        let mood = moods.iter().rev().find(|(from, _)| *from <= ms).expect("from 0 on").1;
        if std::mem::replace(&mut broker.mood, mood) != mood {
            broker.kill(bench);
        }
        broker.go_on(bench);
        // Births again and again.
        if mood == BrokerMode::Well && broker.is_connected(bench) && ms / 300 != asked {
            asked = ms / 300;
            broker.publish(bench, "spBv1.0/hall/NCMD/press", REBIRTH);
        }
    });
    let births = (0..broker.told.len()).filter(|at| broker.told[*at].topic.contains("/NBIRTH/")).count();
    println!("{} messages, {births} births, {} connections", broker.told.len(), broker.connects.len());
    edge.is_like(&alone, "with an edge node", LATER);
    assert!(births >= 3 && broker.connects.len() >= 2, "{births} births, {:?}", broker.connects);
    assert!(bench.chip.faults.is_empty());
}
