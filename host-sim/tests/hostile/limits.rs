//! A process at its limits: no descriptors left, output that nobody reads, as many clients as allowed.

use std::io::Read;
use std::net::TcpStream;
use std::process::Stdio;
use std::time::Duration;

use recipe_test_kit::HostSim;
use rustix::process::Signal;

use crate::clients::{Clients, connect};
use crate::process::{host_sim, usage};
use crate::{MAX_GROWTH_KIB, alone, attack, in_one_of_several_tries, within_bounds};

const ROBOT: [&str; 2] = ["--bind=rs485=tcp-listen:127.0.0.1:0", "--bind=can=slcan-tcp:127.0.0.1:0"];

/// Whether a client is served at port 2000.
fn answers(process: &HostSim) -> Option<TcpStream> {
    let mut stream = connect(process.at("command"));
    let mut answer = [0; 7];
    std::io::Write::write_all(&mut stream, b"state\n").ok()?;
    stream.read_exact(&mut answer).ok()?;
    (&answer == b"6:0:5:2").then_some(stream)
}

#[test]
fn out_of_descriptors_those_that_are_in_go_on_and_others_come_when_there_is_room() {
    let alone = alone();
    let mut command = std::process::Command::new("sh");
    let inner = host_sim("controller", "robot.toml");
    command.args(["-c", "ulimit -n 48; exec \"$0\" \"$@\""]).arg(inner.get_program()).args(inner.get_args());
    command.args(ROBOT).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut process = HostSim::start(&mut command);
    let mut clients = Clients::default();
    clients.udp2011(process.at("udp2011"));
    clients.state(process.at("state"));
    clients.measure(Duration::from_millis(100));
    let quiet = clients.measure(Duration::from_millis(500));
    let hoard = attack::hoard(process.at("modbus"), 100);
    process.next_stats(|stats| stats["connections"]["accept_failures"].as_u64() > Some(3));
    in_one_of_several_tries(|| clients.measure(Duration::from_millis(500)).is_like(&quiet));
    drop(hoard);
    process.next_stats(|stats| stats["modbus"]["open"] == 0);
    assert!(answers(&process).is_some());
    drop(clients);
    process.end_by(Signal::TERM);
    let said = process.all_errors();
    assert!(said.contains("cannot accept a connection"), "{said}");
    assert!(said.lines().count() < 20, "a line for each:\n{said}");
    drop(alone);
}

#[test]
fn a_reader_that_does_not_read_keeps_nothing_from_going_on() {
    let _alone = alone();
    // Everything is logged; neither stdout nor stderr is read.
    let mut command = host_sim("controller", "robot.toml");
    command.args(ROBOT).arg("-vv").stderr(Stdio::piped());
    let file = tempfile::NamedTempFile::new().unwrap();
    command.arg("--ready").arg(file.path());
    let mut process = HostSim::unread(&mut command, file.path());
    let mut clients = Clients::default();
    clients.udp2011(process.at("udp2011"));
    clients.state(process.at("state"));
    clients.request_answer("command", process.at("command"), b"state\n", b"6:0:5:2");
    let quiet = clients.measure(Duration::from_millis(500));
    // Two lines per connection soon fill pipes and queues.
    let scan = attack::scan(process.at("command"));
    while scan.done() < 1_000 {
        clients.measure(Duration::from_millis(50));
    }
    in_one_of_several_tries(|| clients.measure(Duration::from_millis(500)).is_like(&quiet));
    drop(scan);
    in_one_of_several_tries(|| {
        let before = usage(&process);
        clients.measure(Duration::from_millis(500));
        let after = usage(&process);
        within_bounds(&after);
        let flat = after.rss_kib <= before.rss_kib + MAX_GROWTH_KIB;
        if flat { Ok(()) } else { Err(format!("{before:?} grew to {after:?}")) }
    });
    drop(clients);
    process.end_by(Signal::INT);
}
