//! The gateway's field ports and listening links under attack.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use crate::attack::{self, Ports};
use crate::process::{Process, host_sim};
use crate::witness::Witnesses;
use crate::{Scene, alone};

/// A gateway whose controller connects to it and whose field port gets frames each cycle.
fn gateway(sets: &[&str]) -> (Scene, Process) {
    let alone = alone();
    // The controller's other servers have to be there before the gateway is.
    let mut command = host_sim("controller", "../../configs/client-controller.toml");
    let free = ["command", "state", "modbus", "udp2011"].map(|port| format!("--set=listen.{port}=0"));
    let ways = reserve();
    let robot = Process::start(
        command
            .args(free)
            .arg(format!("--set=port.tcp1.to={}", ways[0]))
            .arg(format!("--set=port.udp1.to={}", ways[1])),
    );
    let way = if sets.iter().any(|set| set.contains("udp-listen")) { ways[1] } else { ways[0] };
    let ports =
        ["state", "modbus"].map(|name| format!("--set=controller.ports.{name}={}", robot.at(name).port()));
    let process = Process::start(
        host_sim("gateway", "cell.toml")
            .args(ports)
            .arg(format!("--set=port.up.listen={way}"))
            .args(sets.iter().map(|set| format!("--set={set}")))
            .args(["rs485-1", "rs485-2"].map(|port| format!("--bind={port}=tcp-listen:127.0.0.1:0")))
            .arg("--bind=can-1=slcan-tcp:127.0.0.1:0"),
    );
    let mut witnesses = Witnesses::default();
    witnesses.field("field", process.at("ports/rs485-1"), &[0xFF, 0xFF, 1, 0xEE, 0xEE], 28, &[0xFF, 0xFF]);
    witnesses.slcan("can", process.at("ports/can-1"), b"t0028");
    (Scene::new(alone, process, witnesses), robot)
}

const OWN: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 77);

/// Two places that are free and stay so until somebody listens there.
fn reserve() -> [SocketAddr; 2] {
    // An address of its own: no connection is given the port meanwhile.
    [(), ()].map(|()| std::net::TcpListener::bind((OWN, 0)).unwrap().local_addr().unwrap())
}

#[test]
fn a_port_scan_of_every_listener() {
    let (scene, _robot) = gateway(&[]);
    let listeners = ["up", "rs485-1", "rs485-2", "can-1"].map(|port| format!("ports/{port}"));
    scene.survives(listeners.map(|port| attack::scan(scene.process.at(&port))).into());
    scene.ends();
}

#[test]
fn connections_that_are_kept() {
    let (scene, _robot) = gateway(&[]);
    let listeners = ["up", "rs485-1", "rs485-2", "can-1"].map(|port| format!("ports/{port}"));
    scene.survives(listeners.map(|port| attack::hoard(scene.process.at(&port), 200)).into());
    scene.ends();
}

#[test]
fn garbage_without_end_at_the_other_ports() {
    let (scene, _robot) = gateway(&[]);
    scene.survives(vec![
        attack::pour(scene.process.at("ports/rs485-2"), 1, &[1, 2, 3, 1, 2, 0, 0, 3]),
        attack::pour(scene.process.at("ports/can-1"), 2, b"t001zz\rgarbage"),
    ]);
    scene.ends();
}

#[test]
fn frames_without_end_at_the_other_ports() {
    let (scene, _robot) = gateway(&[]);
    scene.survives(vec![
        attack::pour(scene.process.at("ports/rs485-2"), 1, &[1, 2, 7, 0, 3, 4]),
        attack::pour(scene.process.at("ports/can-1"), 1, b"O\rt00120100\rt7FF0\r"),
    ]);
    scene.ends();
}

#[test]
fn peers_that_never_read() {
    let (scene, _robot) = gateway(&[]);
    scene.survives(vec![
        attack::never_read(scene.process.at("ports/rs485-2"), 1, &[1, 2, 7, 0, 3, 4]),
        attack::never_read(scene.process.at("ports/can-1"), 20, b"O\r"),
    ]);
    scene.ends();
}

#[test]
fn a_byte_now_and_then() {
    let (scene, _robot) = gateway(&[]);
    scene.survives(vec![
        attack::drip(scene.process.at("ports/rs485-2"), 1, &[1, 2, 7], Duration::from_millis(20)),
        attack::drip(scene.process.at("ports/can-1"), 20, b"t0018", Duration::from_millis(20)),
    ]);
    scene.ends();
}

#[test]
fn datagrams_of_strangers() {
    let (scene, _robot) = gateway(&["port.up.bus=udp-listen"]);
    let up = scene.process.at("ports/up");
    // A frame as the controller sends it, and others.
    let frame: &[u8] = &[[0xFF; 2].as_slice(), &[0x41; 24], &[0xFE; 2]].concat().leak()[..];
    let kinds: &[&[u8]] = Vec::from([frame, b"?", b"", &[0; 2_000]]).leak();
    let stranger = Ipv4Addr::new(127, 0, 0, 2);
    scene.survives(vec![
        attack::datagrams(up, stranger, kinds, Ports::Kept),
        attack::datagrams(up, stranger, kinds, Ports::New),
    ]);
    let stats = scene.process.stats();
    assert!(stats["links"]["up"]["strangers"].as_u64().unwrap() > 1_000, "{stats}");
    scene.ends();
}
