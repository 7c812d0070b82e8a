//! The gateway's field ports and listening links under attack.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use recipe_test_kit::{HostSim, free_servers, until_grown};

use crate::attack::{self, Attack, Hold, Ports};
use crate::clients::Clients;
use crate::process::host_sim;
use crate::{Scene, alone};

/// A gateway with ports of every kind, and its controller, which connects to it.
pub(crate) fn gateway(arguments: &[&str]) -> (HostSim, HostSim) {
    let given = |key: &str| arguments.iter().any(|argument| argument.contains(key));
    // The controller's other servers have to run before the gateway.
    let mut command = host_sim("controller", "../../configs/client-controller.toml");
    let free = free_servers();
    let ways = reserve();
    let robot = HostSim::start(
        command
            .args(free)
            .arg(format!("--set=port.tcp1.to={}", ways[0]))
            .arg(format!("--set=port.udp1.to={}", ways[1])),
    );
    let way = if given("udp-listen") { ways[1] } else { ways[0] };
    let mut command = host_sim("gateway", "cell.toml");
    command.arg(format!("--set=port.up.listen={way}")).args(arguments);
    for link in ["state", "modbus"].into_iter().filter(|link| !given(link)) {
        command.arg(format!("--set=controller.ports.{link}={}", robot.at(link).port()));
    }
    command.arg("--bind=rs485-1=tcp-listen:127.0.0.1:0");
    for (port, device) in [("rs485-2", "tcp-listen:127.0.0.1:0"), ("can-1", "slcan-tcp:127.0.0.1:0")] {
        if !given(&format!("--bind={port}")) {
            command.arg(format!("--bind={port}={device}"));
        }
    }
    (HostSim::start(&mut command), robot)
}

/// A device at the first line and one on the bus.
pub(crate) fn devices(process: &HostSim, clients: &mut Clients) {
    clients.field("field", process.at("ports/rs485-1"), &[0xFF, 0xFF, 1, 0xEE, 0xEE], 28, &[0xFF, 0xFF]);
    clients.slcan("can", process.at("ports/can-1"), b"t0028");
}

/// Some of each attack.
pub(crate) fn everything(process: &HostSim) -> Vec<Attack> {
    vec![
        attack::scan(process.at("ports/up")),
        attack::hoard(process.at("ports/rs485-1"), 10),
        attack::pour(process.at("ports/rs485-2"), 1, &[1, 2, 7, 0, 3, 4, 9]),
        attack::pour(process.at("ports/can-1"), 1, b"O\rt00120100\rt7FF0\rgarbage\r"),
        attack::never_read(process.at("ports/can-1"), 5, b"O\r"),
        attack::drip(process.at("ports/can-1"), 5, b"t0018", Duration::from_secs(1)),
    ]
}

fn cell(arguments: &[&str]) -> (Scene, HostSim) {
    let alone = alone();
    let (process, robot) = gateway(arguments);
    let mut clients = Clients::default();
    devices(&process, &mut clients);
    (Scene::new(alone, process, clients), robot)
}

const OWN: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 77);

/// Two addresses that stay free until someone listens there.
fn reserve() -> [SocketAddr; 2] {
    // A separate loopback address: no connection is given the port meanwhile.
    [(), ()].map(|()| std::net::TcpListener::bind((OWN, 0)).unwrap().local_addr().unwrap())
}

#[test]
fn a_port_scan_of_every_listener() {
    let (scene, _robot) = cell(&[]);
    let listeners = ["up", "rs485-1", "rs485-2", "can-1"].map(|port| format!("ports/{port}"));
    let attacks = listeners.map(|port| attack::scan(scene.process.at(&port))).into();
    scene.survives(attacks);
}

#[test]
fn connections_that_are_kept() {
    let (scene, _robot) = cell(&[]);
    let listeners = ["up", "rs485-1", "rs485-2", "can-1"].map(|port| format!("ports/{port}"));
    let attacks = listeners.map(|port| attack::hoard(scene.process.at(&port), 200)).into();
    scene.survives(attacks);
}

#[test]
fn garbage_without_end_at_the_other_ports() {
    let (scene, _robot) = cell(&[]);
    let attacks = vec![
        attack::pour(scene.process.at("ports/rs485-2"), 1, &[1, 2, 3, 1, 2, 0, 0, 3]),
        attack::pour(scene.process.at("ports/can-1"), 2, b"t001zz\rgarbage"),
    ];
    scene.survives(attacks);
}

#[test]
fn frames_without_end_at_the_other_ports() {
    let (scene, _robot) = cell(&[]);
    let attacks = vec![
        attack::pour(scene.process.at("ports/rs485-2"), 1, &[1, 2, 7, 0, 3, 4]),
        attack::pour(scene.process.at("ports/can-1"), 1, b"O\rt00120100\rt7FF0\r"),
    ];
    scene.survives(attacks);
}

#[test]
fn peers_that_never_read() {
    let (scene, _robot) = cell(&[]);
    let attacks = vec![
        attack::never_read(scene.process.at("ports/rs485-2"), 1, &[1, 2, 7, 0, 3, 4]),
        attack::never_read(scene.process.at("ports/can-1"), 20, b"O\r"),
    ];
    scene.survives(attacks);
}

#[test]
fn a_byte_now_and_then() {
    let (scene, _robot) = cell(&[]);
    let attacks = vec![
        attack::drip(scene.process.at("ports/rs485-2"), 1, &[1, 2, 7], Duration::from_millis(20)),
        attack::drip(scene.process.at("ports/can-1"), 20, b"t0018", Duration::from_millis(20)),
    ];
    scene.survives(attacks);
}

#[test]
fn datagrams_of_strangers() {
    let (scene, _robot) = cell(&["--set=port.up.bus=udp-listen"]);
    let up = scene.process.at("ports/up");
    // A frame that the controller could send, and others.
    let frame: &[u8] = &[[0xFF; 2].as_slice(), &[0x41; 24], &[0xFE; 2]].concat().leak()[..];
    let kinds: &[&[u8]] = Vec::from([frame, b"?", b"", &[0; 2_000]]).leak();
    let stranger = Ipv4Addr::new(127, 0, 0, 2);
    let attacks = vec![
        attack::datagrams(up, stranger, kinds, Ports::Kept),
        attack::datagrams(up, stranger, kinds, Ports::New),
    ];
    scene.survives_until(attacks, |process| {
        until_grown("datagrams of strangers", 1_000, || {
            process.fresh()["links"]["up"]["strangers"].as_u64().unwrap()
        });
    });
}

#[test]
fn a_terminal_that_never_pauses() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line");
    let (scene, _robot) = cell(&[&format!("--bind=rs485-2=pty:{}", line.display())]);
    let attacks = vec![attack::pour_device(line, &[1, 2, 3, 1, 2, 7, 0, 3, 4])];
    scene.survives(attacks);
}

#[test]
fn a_bus_on_which_frames_take_no_time() {
    let (scene, _robot) = cell(&["--bind=can-1=slcan-tcp-unpaced:127.0.0.1:0"]);
    let attacks = vec![attack::pour(scene.process.at("ports/can-1"), 2, b"O\rt00120100\rt7FF0\r")];
    scene.survives(attacks);
}

#[test]
fn a_controller_that_talks_nonsense() {
    let (state, nonsense) = attack::server(b"\xFFnonsense", Hold::Open);
    let (modbus, closes) = attack::server(b"\x00\x01\x00\x00\x00\x04nonsense", Hold::Open);
    let ways = [("state", state), ("modbus", modbus)];
    let ways = ways.map(|(link, at)| format!("--set=controller.ports.{link}={}", at.port()));
    let (scene, _robot) = cell(&ways.each_ref().map(String::as_str));
    scene.survives(vec![nonsense, closes]);
}
