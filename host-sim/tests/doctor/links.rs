//! Links that do not reach the controller, or reach something else.

use std::net::{TcpListener, UdpSocket};

use recipe_test_kit::{HostSim, example};

use super::{BINARY, Feeder, doctor, finds, logs};

/// A gateway for the first worked example, or the doctor, with this port of Modbus.
fn modbus(port: u16) -> (tempfile::TempDir, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let bind = format!("--bind=rs485-1=pty:{}", folder.path().join("line").display());
    (folder, vec![bind, format!("--set=controller.ports.modbus={port}")])
}

#[test]
fn a_closed_port() {
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let (_folder, arguments) = modbus(free);
    let words = [&*format!("link modbus: 127.0.0.1 port {free} (TCP) refuses the connection")];
    let file = example("rs485-user.toml");
    let gateway = HostSim::start(BINARY.run("gateway", &file).arg("-v").args(&arguments));
    logs(&gateway, &words);
    gateway.end();
    finds(&doctor(&file, &arguments), "refused", &words);
}

#[test]
fn something_else_at_the_port() {
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let arguments = [
        format!("--bind=rs485-1=pty:{}", folder.path().join("line").display()),
        format!("--set=controller.ports.state={}", other.local_addr().unwrap().port()),
    ];
    let file = example("rs485-system.toml");
    let words = ["is connected; 0 bytes, 0 packets", "ten packets a second"];
    let gateway = HostSim::start(BINARY.run("gateway", &file).arg("-v").args(&arguments));
    logs(&gateway, &[&["link state: "], &words[..]].concat());
    gateway.end();
    finds(&doctor(&file, &arguments), "link_silent", &words);
}

#[test]
fn a_wrong_udp_port() {
    // Something that takes datagrams and never answers, as a machine behind a firewall does.
    let other = UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = other.local_addr().unwrap().port();
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line");
    let arguments = [
        format!("--bind=rs485-1=pty:{}", line.display()),
        format!("--set=controller.recipe_link.udp={port}"),
    ];
    let file = example("udp-server.toml");
    let gateway = HostSim::start(BINARY.run("gateway", &file).arg("-v").args(&arguments));
    let _feeder = Feeder::start(&line, &[255, 255, 5, 238, 238]);
    logs(&gateway, &["link udp2011: ", " sent, 0 received at ", "Another UDP port"]);
    gateway.end();
    other.set_nonblocking(true).unwrap();
    while other.recv(&mut [0; 64]).is_ok() {}
    finds(&doctor(&file, &arguments), "one_way", &["was not tried"]);
    assert!(other.recv(&mut [0; 64]).is_err(), "the doctor has sent a datagram");
}

#[test]
fn a_closed_udp_port() {
    let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line");
    let file = example("udp-server.toml");
    let gateway = HostSim::start(
        BINARY
            .run("gateway", &file)
            .args(["-v", &format!("--set=controller.recipe_link.udp={free}")])
            .arg(format!("--bind=rs485-1=pty:{}", line.display())),
    );
    let _feeder = Feeder::start(&line, &[255, 255, 5, 238, 238]);
    logs(&gateway, &["link udp2011: ", &format!("127.0.0.1 port {free} (UDP) refuses datagrams")]);
    gateway.end();
}
