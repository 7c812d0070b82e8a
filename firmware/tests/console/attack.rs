//! A cell whose board's console is attacked, beside the same cell a moment before: nothing that a device sends is lost.
//!
//! QEMU's time is the host's, so how late things are depends on what else the host does: the figures are printed. Exact
//! ones are those of the NUCLEO's binary in virtual time (firmware/chip-model/tests/nucleo/attack.rs).

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use recipe_test_kit::http::Client;
use recipe_test_kit::{Binary, HostSim, example, until};
use serde_json::Value;

use crate::board::{QemuBoard, variable};

/// Connections of the attack.
const CONNECTIONS: u32 = 1_000;
/// Between two frames of the device.
const EVERY: Duration = Duration::from_millis(10);
/// How long the cell is watched without an attack.
const QUIET: Duration = Duration::from_secs(3);

/// A device that sends `FF FF number EE EE` every 10 ms, and is sent a count and the value back every 4 ms.
fn cell(robot: &HostSim) -> String {
    let port = |server| robot.at(server).port();
    format!(
        r#"
[controller]
address = "127.0.0.1"
ports = {{ command = {}, state = {}, modbus = {} }}

[[recipe]]
name = "device"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [{{ name = "in", type = "word", to = "WordInputReg[1]" }}]
[recipe.output]
head = [255, 255]
tail = [254, 254]
on_stale = "stop"
fields = [
    {{ name = "number", type = "dword", from = "counter" }},
    {{ name = "out", type = "word", from = "WordOutputReg[1]" }},
]

[[port]]
name = "device"
bus = "rs485"
baud = 115200
recipe = "device"
idle_gap_ms = 1000
timeout_ms = 2000
"#,
        port("command"),
        port("state"),
        port("modbus"),
    )
}

/// The device.
struct ChattyDevice {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicU32>,
    threads: Vec<JoinHandle<()>>,
}

impl ChattyDevice {
    fn start(mut line: UnixStream) -> Self {
        let (stop, sent) = (Arc::<AtomicBool>::default(), Arc::<AtomicU32>::default());
        let mut back = line.try_clone().unwrap();
        back.set_read_timeout(Some(EVERY)).unwrap();
        let (ends, own_stop, own_sent) = (Arc::clone(&stop), Arc::clone(&stop), Arc::clone(&sent));
        // QEMU waits with a byte that nobody takes.
        let reader = std::thread::spawn(move || {
            while !ends.load(Relaxed) {
                let _ = back.read(&mut [0; 4_096]);
            }
        });
        let writer = std::thread::spawn(move || {
            let mut next = Instant::now();
            while !own_stop.load(Relaxed) {
                let [low, high, ..] = (own_sent.load(Relaxed) + 1).to_le_bytes();
                line.write_all(&[255, 255, low, high, 238, 238]).unwrap();
                own_sent.fetch_add(1, Relaxed);
                next += EVERY;
                std::thread::sleep(next.saturating_duration_since(Instant::now()));
            }
        });
        Self { stop, sent, threads: vec![reader, writer] }
    }

    /// Returns how many frames it has sent.
    fn end(&mut self) -> u32 {
        self.stop.store(true, Relaxed);
        for thread in self.threads.drain(..) {
            thread.join().unwrap();
        }
        self.sent.load(Relaxed)
    }
}

impl Drop for ChattyDevice {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
    }
}

/// One connection of somebody who means no good; the kinds take turns.
fn hostile(board: &Client, nth: u32) -> Option<()> {
    let mut stream = board.narrow_connection().ok()?;
    let says = match nth % 8 {
        0 => b"GET /api/v1/info HTTP/1.1\r\nHost: ".to_vec(),
        1 => board.bytes("GET /", &format!("X: {}", "x".repeat(4_000)), b""),
        // Not with a wrong signature: after five of them this address would have to wait, and so would the test.
        2 => board.bytes("GET /api/v1/status", "", b""),
        3 => vec![0xA5; 3_000],
        4 => board.bytes("PUT /api/v1/config", "Content-Type: application/octet-stream", &[0; 4_000]),
        5 => board.bytes("GET /", "Origin: http://evil.test", b""),
        // The page, of which little or nothing is read.
        6 => board.bytes("GET /", "", b""),
        _ => Vec::new(),
    };
    let _ = stream.write_all(&says);
    stream.set_read_timeout(Some(Duration::from_millis(20))).ok()?;
    let _ = stream.read(&mut [0; 512]);
    Some(())
}

/// The document; the board may have no place at the moment.
fn status(board: &QemuBoard) -> Value {
    until("the status", || board.client.try_get("status")).json()
}

/// By how much a number of the status has grown.
fn grown(before: &Value, after: &Value, path: &str) -> u64 {
    let number = |status: &Value| {
        let found = status.pointer(path).and_then(Value::as_u64);
        found.unwrap_or_else(|| panic!("{path} is not in {status}"))
    };
    number(after) - number(before)
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_thousand_hostile_connections_cost_the_cell_no_frame_and_no_link() {
    let program = Binary(variable("HOST_SIM").display().to_string().leak());
    let robot = program.controller(&example("force-sensor-controller.toml"), &[]);
    let board = QemuBoard::claimed(&cell(&robot));
    let mut device = ChattyDevice::start(board.line());
    let value = |number: u32| {
        robot.stats("a value", |stats| stats["registers"]["WordInputReg[1]"].as_u64() >= Some(number.into()));
    };
    value(1);
    let begin = status(&board);
    std::thread::sleep(QUIET);
    let quiet = status(&board);
    let begun = Instant::now();
    let nth = AtomicU32::new(0);
    let made = AtomicU32::new(0);
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                loop {
                    let nth = nth.fetch_add(1, Relaxed);
                    if nth >= CONNECTIONS {
                        return;
                    }
                    made.fetch_add(u32::from(hostile(&board.client, nth).is_some()), Relaxed);
                }
            });
        }
    });
    let took = begun.elapsed();
    let attacked = status(&board);
    let sent = device.end();
    value(sent);
    let end = status(&board);

    for (what, span, [before, after]) in
        [("quiet", QUIET, [&begin, &quiet]), ("attacked", took, [&quiet, &attacked])]
    {
        let counter = |name: &str| grown(before, after, &format!("/ports/device/counters/{name}"));
        println!(
            "{what}: {span:.1?}, {} frames in, {} out, {} cycles left out",
            counter("frames_in"),
            counter("frames_out"),
            counter("skipped_cycles"),
        );
    }
    let console = until("the console", || board.client.try_get("info")).json()["console"].clone();
    println!("{} connections made; latency {}; {console}", made.load(Relaxed), end["latency"]);
    let counters = &end["ports"]["device"]["counters"];
    assert_eq!((&counters["frames_in"], &counters["discarded_bytes"]), (&sent.into(), &0.into()), "{end}");
    assert_eq!(grown(&begin, &end, "/links/modbus/history/connects"), 0, "{end}");
    assert_eq!(grown(&begin, &end, "/sleeps"), 0, "{end}");
    assert_eq!(made.load(Relaxed), CONNECTIONS);
    // They were served, and not only turned away by the network.
    for counter in [&console["requests"]["without_key"], &console["counters"]["incomplete"]] {
        assert!(counter.as_u64() > Some(3), "{console}");
    }
}
