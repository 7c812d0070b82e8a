//! Faults of a CAN bus, on the bus in user space.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use recipe_test_kit::{HostSim, example};

use super::{BINARY, Feeder, doctor, finds, logs};

/// A node that sends this line of slcan again and again, at a port of this machine.
fn node(port: u16, line: &'static str) -> Feeder {
    let ends = std::sync::Arc::<std::sync::atomic::AtomicBool>::default();
    let own = std::sync::Arc::clone(&ends);
    let thread = std::thread::spawn(move || {
        let mut bus: Option<TcpStream> = None;
        while !own.load(Relaxed) {
            if bus.is_none() {
                bus = TcpStream::connect(("127.0.0.1", port)).ok();
                if let Some(bus) = &mut bus {
                    bus.set_nonblocking(true).unwrap();
                    let _ = bus.write_all(b"O\r");
                }
            }
            if let Some(stream) = &mut bus {
                let sent = stream.write_all(line.as_bytes());
                while matches!(stream.read(&mut [0; 256]), Ok(len) if len > 0) {}
                if sent.is_err() {
                    bus = None;
                }
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    Feeder { ends, thread: Some(thread) }
}

/// What is said of a node that sends this.
#[track_caller]
fn said(line: &'static str, cause: &str, words: &[&str]) {
    let file = example("can-user.toml");
    let gateway =
        HostSim::start(BINARY.run("gateway", &file).args(["-v", "--bind=can-1=slcan-tcp:127.0.0.1:0"]));
    let place = gateway.at("ports/can-1");
    let feeder = (!line.is_empty()).then(|| node(place.port(), line));
    logs(&gateway, &[&["port can-1: "], words].concat());
    gateway.end();
    drop(feeder);
    // A port that was free a moment ago.
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let _feeder = (!line.is_empty()).then(|| node(free.port(), line));
    finds(&doctor(&file, &[format!("--bind=can-1=slcan-tcp:{free}")]), cause, words);
}

#[test]
fn no_frames() {
    said("", "no_bytes", &["0 frames in ", "id 0x001"]);
}

#[test]
fn an_id_that_no_recipe_has() {
    said("t1813010203\r", "foreign_ids", &["id 0x181 seen ", " times; expected id 0x001"]);
}

#[test]
fn an_id_of_the_other_kind() {
    said("T000000013010203\r", "id_kind", &["id 0x00000001 (extended) seen ", "expected id 0x001"]);
}

#[test]
fn a_frame_of_another_length() {
    said("t00120102\r", "can_length", &["id 0x001 with 2 bytes; expected 3 bytes"]);
}
