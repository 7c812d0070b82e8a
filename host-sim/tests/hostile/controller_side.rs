//! The simulated controller's servers and ports under attack.

use std::io::{Read, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use recipe_test_kit::HostSim;

use crate::attack::{self, Attack, Ports};
use crate::clients::{Clients, connect};
use crate::process::host_sim;
use crate::{ATTACK, QUIET, Scene, alone, in_one_of_several_tries};

const READ_WORDS: &[u8] = &[9, 9, 0, 0, 0, 6, 1, 3, 0, 0, 0, 118];
const READ_ONE: &[u8] = &[9, 9, 0, 0, 0, 6, 1, 3, 0, 1, 0, 1];
const READ_ONE_ANSWER: &[u8] = &[9, 9, 0, 0, 0, 5, 1, 3, 2, 0, 6];

/// A controller with servers and ports of every kind.
pub(crate) fn controller(to: SocketAddr) -> HostSim {
    HostSim::start(
        host_sim("controller", "robot.toml")
            .args(["--bind=rs485=tcp-listen:127.0.0.1:0", "--bind=can=slcan-tcp:127.0.0.1:0"])
            .arg(format!("--set=port.tcp1.to={to}")),
    )
}

/// A client for each of its servers.
pub(crate) fn attach(process: &HostSim, clients: &mut Clients) {
    clients.udp2011(process.at("udp2011"));
    clients.state(process.at("state"));
    clients.request_answer("command", process.at("command"), b"state\n", b"6:0:5:2");
    clients.request_answer("modbus", process.at("modbus"), READ_ONE, READ_ONE_ANSWER);
}

/// Some of each attack.
pub(crate) fn everything(process: &HostSim) -> Vec<Attack> {
    vec![
        attack::scan(process.at("command")),
        attack::hoard(process.at("state"), 10),
        attack::pour(process.at("command"), 1, b"getlasterror\n"),
        attack::pour(process.at("modbus"), 1, READ_WORDS),
        attack::pour(process.at("control"), 1, b"{\"do\":\"programs\"}\n"),
        attack::never_read(process.at("modbus"), 20, READ_WORDS),
        attack::never_read(process.at("command"), 10, b"state\n"),
        attack::drip(process.at("command"), 5, b"run(a", Duration::from_secs(1)),
        attack::pour(process.at("ports/rs485"), 1, &[1, 2, 3, 1, 2, 0, 0, 3]),
        attack::pour(process.at("ports/can"), 1, b"O\rt00120102\rgarbage\r"),
        attack::datagrams(process.at("udp2011"), Ipv4Addr::new(127, 0, 0, 2), DATAGRAMS, Ports::New),
    ]
}

/// Requests that the controller accepts, and others.
const DATAGRAMS: &[&[u8]] = &[&[0xFF, 0xFF, 0x02, 0xEE, 0xEE], b"", b"?", &[0; 4_000]];

fn robot_with(to: SocketAddr) -> Scene {
    let alone = alone();
    let process = controller(to);
    let mut clients = Clients::default();
    attach(&process, &mut clients);
    Scene::new(alone, process, clients)
}

fn robot() -> Scene {
    robot_with(NOBODY)
}

pub(crate) const NOBODY: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 9);

#[test]
fn a_port_scan_of_every_server() {
    let mut scene = robot();
    let at = scene.process.at("command");
    scene.joined_by(|clients| clients.newcomers("newcomers", at, b"state\n", b"6:0:5:2"));
    let servers = ["command", "state", "modbus", "ports/rs485", "ports/can"];
    let attacks = servers.map(|server| attack::scan(scene.process.at(server))).into();
    scene.survives(attacks);
}

#[test]
fn requests_without_end_at_the_control_socket() {
    let scene = robot();
    let control = scene.process.at("control");
    scene.survives(vec![
        attack::scan(control),
        attack::hoard(control, 4),
        attack::pour(control, 2, b"{\"do\":\"state\"}\n"),
        attack::pour(control, 1, b"GET / HTTP/1.1\r\n"),
        attack::never_read(control, 4, b"{\"do\":\"events\"}\n"),
        attack::drip(control, 2, b"{\"do\":", Duration::from_secs(1)),
    ]);
}

#[test]
fn connections_that_are_kept_and_say_nothing() {
    let scene = robot();
    let servers = ["command", "state", "modbus", "ports/can"];
    let attacks = servers.map(|server| attack::hoard(scene.process.at(server), 200)).into();
    scene.survives(attacks);
}

#[test]
fn requests_without_end() {
    let scene = robot();
    let attacks = vec![
        attack::pour(scene.process.at("command"), 2, b"getlasterror\n"),
        attack::pour(scene.process.at("modbus"), 2, READ_WORDS),
    ];
    scene.survives(attacks);
}

#[test]
fn short_unknown_commands_without_end() {
    let scene = robot();
    let attacks = vec![attack::pour(scene.process.at("command"), 4, b"x\n")];
    scene.survives(attacks);
}

#[test]
fn garbage_without_end() {
    let scene = robot();
    let attacks = vec![
        attack::pour(scene.process.at("command"), 1, b"run(\x80garbage without an end "),
        attack::pour(scene.process.at("state"), 1, b"nobody reads this"),
        attack::pour(scene.process.at("modbus"), 1, b"\x00\x01\x00\x00\x00\x06\x01\x63garbage"),
        attack::pour(scene.process.at("ports/rs485"), 1, &[1, 2, 3, 1, 2, 0, 0, 3]),
        attack::pour(scene.process.at("ports/can"), 1, b"t001zz\rgarbage"),
    ];
    scene.survives(attacks);
}

#[test]
fn a_few_peers_that_ask_and_never_read() {
    // So few that they fill the kernel's buffers at once: what comes then, the process has to hold or drop.
    let scene = robot();
    let attacks = vec![
        attack::never_read(scene.process.at("command"), 2, b"getlasterror\n"),
        attack::never_read(scene.process.at("modbus"), 3, READ_WORDS),
    ];
    scene.survives(attacks);
}

#[test]
fn many_peers_that_ask_and_never_read() {
    let scene = robot();
    let attacks = vec![
        attack::never_read(scene.process.at("command"), 31, b"getlasterror\n"),
        attack::never_read(scene.process.at("modbus"), 100, READ_WORDS),
        attack::never_read(scene.process.at("state"), 31, b"?"),
        attack::never_read(scene.process.at("ports/can"), 32, b"O\rt00180102030405060708\r"),
    ];
    scene.survives(attacks);
}

#[test]
fn connections_that_break_the_protocol_one_after_the_other() {
    let scene = robot();
    let mut bytes = READ_WORDS.repeat(80);
    bytes.extend_from_slice(&[0, 0, 9, 9, 0, 6, 1, 3, 0, 0, 0, 1]);
    let attacks = vec![attack::ask_and_break(scene.process.at("modbus"), bytes.leak(), 2_000)];
    scene.survives(attacks);
}

#[test]
fn a_byte_now_and_then() {
    let scene = robot();
    let pause = Duration::from_millis(20);
    let attacks = vec![
        attack::drip(scene.process.at("command"), 31, b"run(a", pause),
        attack::drip(scene.process.at("modbus"), 127, &[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0], pause),
        attack::drip(scene.process.at("ports/rs485"), 1, &[1, 2, 0], pause),
        attack::drip(scene.process.at("ports/can"), 31, b"t0018", pause),
    ];
    scene.survives(attacks);
}

#[test]
fn datagrams_from_everywhere() {
    let scene = robot();
    // One host with many ports; another one with ports that are closed when the answers arrive.
    let many = Ipv4Addr::new(127, 0, 0, 2);
    let gone = Ipv4Addr::new(127, 0, 0, 3);
    let server = scene.process.at("udp2011");
    let attacks = vec![
        attack::datagrams(server, many, DATAGRAMS, Ports::Kept),
        attack::datagrams(server, gone, DATAGRAMS, Ports::New),
    ];
    scene.survives(attacks);
}

#[test]
fn a_host_that_the_controller_connects_to() {
    let (to, pours) = attack::server(b"\xFF\xFF\x02\xEE\xEE\xFF", attack::Hold::Open);
    let scene = robot_with(to);
    scene.survives(vec![pours]);
    let (to, closes) = attack::server(b"\xFF\xFF\x02\xEE\xEE\xFF", attack::Hold::Close);
    let scene = robot_with(to);
    scene.survives(vec![closes]);
}

#[test]
fn a_program_that_never_waits() {
    let _alone = alone();
    let process = controller(NOBODY);
    let mut clients = Clients::default();
    clients.udp2011(process.at("udp2011"));
    clients.state(process.at("state"));
    clients.request_answer("command", process.at("command"), b"getlasterror\n", b"0:no error\n");
    clients.request_answer("modbus", process.at("modbus"), READ_ONE, READ_ONE_ANSWER);
    clients.measure(QUIET);
    let quiet = clients.measure(QUIET);
    let mut command = connect(process.at("command"));
    let mut ask = |request: &[u8], answer: &[u8]| {
        command.write_all(request).unwrap();
        let mut got = vec![0; answer.len()];
        command.read_exact(&mut got).unwrap();
        assert_eq!(String::from_utf8_lossy(&got), String::from_utf8_lossy(answer));
    };
    ask(b"run(busy.jspf)\n", b"run start");
    in_one_of_several_tries(|| {
        let measure = clients.measure(ATTACK);
        println!("quiet {quiet}\nbusy  {measure}");
        measure.is_like(&quiet).and(measure.waits_at_most(Duration::from_millis(150)))
    });
    ask(b"state\n", b"6:2:5:2");
    ask(b"stop\n", b"stop success");
    drop(clients);
    process.end();
}
