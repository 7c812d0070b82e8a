//! The gateway in a process that runs late, or sleeps.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::OpenOptionsExt;
use std::time::Duration as StdDuration;

use proto_core::engine::{ASLEEP, PortCounters};
use proto_core::time::Duration;
use rustix::fs::OFlags;
use tokio::task::{LocalSet, spawn_local, yield_now};

use super::*;
use recipe_test_kit::toml;

/// A serial line and a CAN bus.
const CELL: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "word"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [1, 2]
tail = [3, 4]
fields = ["WordInputReg[1]"]

[[recipe]]
name = "can"
kind = "can"
mode = "realtime"
[[recipe.input.frame]]
id = 1
fields = ["WordInputReg[2]"]

[[port]]
name = "line"
bus = "rs485"
recipe = "word"
idle_gap_ms = 5
timeout_ms = 50

[[port]]
name = "can"
bus = "can"
recipe = "can"
timeout_ms = 50
"#;
const LINE: PortId = PortId(0);
const CAN: PortId = PortId(1);

/// A gateway without a controller.
struct Cell {
    core: Rc<Core>,
    places: Value,
}

impl Cell {
    /// Runs a test on the gateway's own thread, which the test may block. `line` is the line's device.
    fn run<T>(line: &str, test: impl AsyncFnOnce(Self) -> T) -> T {
        let folder = tempfile::tempdir().unwrap();
        let line = line.replace("FOLDER", folder.path().to_str().unwrap());
        let config = toml::gateway(CELL);
        let binds = [format!("line={line}"), "can=slcan-tcp:127.0.0.1:0".to_owned()];
        let binds = binds.map(|bind| bind.parse().unwrap());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let gateway =
                PreparedGateway::open(&config, Devices::own(&binds), TxPolicy::All, &Observers::default())
                    .await
                    .unwrap();
            let cell = Self { core: Rc::clone(&gateway.core), places: gateway.ready["ports"].clone() };
            let running = spawn_local(gateway.drive());
            let limit = StdDuration::from_secs(60);
            let result = tokio::time::timeout(limit, test(cell)).await.expect("the test hangs");
            running.abort();
            result
        })
    }

    /// Repeats a test in new cells until the machine leaves the gateway awake: after a sleep input is
    /// dropped for a while, so a single frame may never arrive.
    fn run_awake(line: &str, test: impl AsyncFn(Self) -> Result<(), Slept>) {
        let is_done = (0..MAX_ATTEMPTS).any(|_| Self::run(line, &test).is_ok());
        assert!(is_done, "the gateway slept in each of {MAX_ATTEMPTS} attempts");
    }

    fn place(&self, port: &str) -> &str {
        self.places[port].as_str().unwrap()
    }

    fn connect(&self, port: &str) -> TcpStream {
        let stream = TcpStream::connect(self.place(port)).unwrap();
        stream.set_nodelay(true).unwrap();
        stream
    }

    /// An slcan client with an open channel.
    async fn on_can(&self) -> TcpStream {
        let mut client = self.connect("can");
        client.write_all(b"O\r").unwrap();
        client.set_nonblocking(true).unwrap();
        let mut answer = [0];
        while client.read(&mut answer).is_err() {
            yield_now().await;
        }
        assert_eq!(&answer, b"\r");
        client
    }

    fn counters(&self, port: PortId) -> PortCounters {
        *self.core.engine.borrow().port_counters(port).unwrap()
    }

    fn sleeps(&self) -> u32 {
        self.core.engine.borrow().sleeps()
    }

    /// Sends a frame and waits until the port has accepted it.
    async fn accepts(&self, port: PortId, send: impl FnOnce()) -> Result<PortCounters, Slept> {
        let before = self.counters(port).frames_in;
        send();
        self.until(|cell| cell.counters(port).frames_in > before).await?;
        Ok(self.counters(port))
    }

    async fn until(&self, condition: impl Fn(&Self) -> bool) -> Result<(), Slept> {
        loop {
            if self.sleeps() > 0 {
                return Err(Slept);
            }
            if condition(self) {
                return Ok(());
            }
            yield_now().await;
        }
    }
}

/// The machine stopped the gateway for longer than [`ASLEEP`].
#[derive(Debug)]
struct Slept;

/// Attempts of a test that a sleep makes void.
const MAX_ATTEMPTS: usize = 20;

/// Blocks the thread, so that nothing else in the gateway runs.
fn block(time: StdDuration) {
    std::thread::sleep(time);
}

fn frame(value: u16) -> Vec<u8> {
    let [low, high] = value.to_le_bytes();
    vec![1, 2, low, high, 3, 4]
}

fn on_bus(value: u16) -> String {
    let [low, high] = value.to_le_bytes();
    format!("t0012{low:02X}{high:02X}\r")
}

/// Longer than the ports' timeouts, shorter than [`ASLEEP`].
const BLOCKED_MS: [u64; 4] = [60, 120, 250, 400];

/// Blocks the thread until the port's frames are overdue, with one waiting: they must not time out.
async fn counts_as_in_time(cell: &Cell, port: PortId, mut send: impl FnMut(u16)) -> Result<(), Slept> {
    for millis in BLOCKED_MS {
        let before = loop {
            let accepted = cell.accepts(port, || send(1)).await?;
            // Until every task waits for the system again.
            for _ in 0..10 {
                yield_now().await;
            }
            // On a busy machine that may take until the next frame is overdue.
            if cell.counters(port).timeouts == accepted.timeouts {
                break accepted;
            }
        };
        block(StdDuration::from_millis(millis));
        let after = cell.accepts(port, || send(2)).await?;
        assert_eq!(after.frames_in, before.frames_in + 1);
        assert_eq!(after.timeouts, before.timeouts, "blocked for {millis} ms");
    }
    // They do time out when nothing comes.
    let timeouts = cell.counters(port).timeouts;
    cell.until(|cell| cell.counters(port).timeouts > timeouts).await
}

#[test]
fn a_frame_that_waited_for_a_blocked_thread_is_in_time() {
    Cell::run_awake("tcp-listen:127.0.0.1:0", async |cell| {
        let mut device = cell.connect("line");
        counts_as_in_time(&cell, LINE, |value| device.write_all(&frame(value)).unwrap()).await
    });
}

#[test]
fn so_is_one_behind_more_than_is_read_at_once() {
    Cell::run_awake("tcp-listen:127.0.0.1:0", async |cell| {
        let mut device = cell.connect("line");
        let garbage = [0xA5; 3_000];
        counts_as_in_time(&cell, LINE, |value| {
            if value == 2 {
                device.write_all(&garbage).unwrap();
            }
            device.write_all(&frame(value)).unwrap();
        })
        .await
    });
}

#[test]
fn so_is_one_that_has_to_cross_a_bus() {
    Cell::run_awake("tcp-listen:127.0.0.1:0", async |cell| {
        let mut device = cell.on_can().await;
        // Other frames come first: 30 take 7.4 ms on the bus.
        let others: String = (0..30).map(|_| "t7FF80102030405060708\r").collect();
        counts_as_in_time(&cell, CAN, |value| {
            if value == 2 {
                device.write_all(others.as_bytes()).unwrap();
            }
            device.write_all(on_bus(value).as_bytes()).unwrap();
            let _ = device.read(&mut [0; 4_096]);
        })
        .await
    });
}

/// Fills all buffers between the device and the gateway while the process sleeps. Nothing of that may be
/// believed; what is sent a little later is.
async fn is_not_believed(
    cell: &Cell,
    port: PortId,
    device: &mut (impl Read + Write),
    frame: impl Fn(u16) -> Vec<u8>,
) -> Result<(), Slept> {
    const OLD: u16 = 0x1111;
    const NEW: u16 = 0x2222;
    let word = |cell: &Cell| {
        let var = format!("WordInputReg[{}]", port.0 + 1).parse().unwrap();
        cell.core.engine.borrow().image().value(var).as_f64() as u16
    };
    let before = cell.accepts(port, || device.write_all(&frame(1)).unwrap()).await?;
    assert_eq!(word(cell), 1);
    block(StdDuration::from_micros(ASLEEP.as_micros() + 100_000));
    let old = frame(OLD).repeat(64);
    let mut waiting = 0;
    while let Ok(count @ 1..) = device.write(&old) {
        waiting += count;
    }
    assert!(waiting > 4_096, "{waiting} bytes");
    let begin = now();
    let mut sent_at = begin;
    let mut read = [0; 4_096];
    while word(cell) != NEW {
        yield_now().await;
        assert_ne!(word(cell), OLD, "{waiting} bytes, after {:?}", now().saturating_since(begin));
        // A device goes on sending.
        if now().saturating_since(sent_at) >= Duration::from_millis(20) {
            sent_at = now();
            let _ = device.write(&frame(NEW));
        }
        let _ = device.read(&mut read);
    }
    let after = cell.counters(port);
    assert!(after.frames_in <= before.frames_in + 2, "{after:?}");
    // A system that hands the bytes over late does so after the engine has noted the sleep: then the device discards them.
    let dropped = cell.core.ports[&port].1.counters().dropped;
    assert!(after.asleep > 0 || dropped > 0, "{dropped} {after:?}");
    assert!(cell.sleeps() > 0);
    Ok(())
}

#[test]
fn what_waited_on_a_terminal_while_the_process_slept_is_not_believed() {
    Cell::run_awake("pty:FOLDER/line", async |cell| {
        let flags = (OFlags::NOCTTY | OFlags::NONBLOCK).bits() as i32;
        let mut options = std::fs::OpenOptions::new();
        let options = options.read(true).write(true).custom_flags(flags);
        let mut device = options.open(cell.place("line")).unwrap();
        is_not_believed(&cell, LINE, &mut device, frame).await
    });
}

#[test]
fn nor_what_waited_in_a_connection() {
    Cell::run_awake("tcp-listen:127.0.0.1:0", async |cell| {
        let mut device = cell.connect("line");
        device.set_nonblocking(true).unwrap();
        is_not_believed(&cell, LINE, &mut device, frame).await
    });
}

#[test]
fn nor_what_waited_to_go_on_a_bus() {
    Cell::run_awake("tcp-listen:127.0.0.1:0", async |cell| {
        let mut device = cell.on_can().await;
        is_not_believed(&cell, CAN, &mut device, |value| on_bus(value).into_bytes()).await
    });
}

/// The line's counters after these pieces, each reported later than the idle gap by a driver whose timer
/// does not get to run.
fn reported_late(pieces: &[&[u8]]) -> PortCounters {
    let config = toml::gateway(CELL);
    let binds =
        ["line=tcp-listen:127.0.0.1:0", "can=slcan-tcp:127.0.0.1:0"].map(|bind| bind.parse().unwrap());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async move {
        let core = PreparedGateway::open(&config, Devices::own(&binds), TxPolicy::All, &Observers::default())
            .await
            .unwrap()
            .core;
        core.input(Input::Tick);
        core.port_event(LINE, PortEvent::Up);
        for piece in pieces {
            core.port_event(LINE, PortEvent::Bytes(piece));
            block(StdDuration::from_millis(10));
        }
        let engine = core.engine.borrow();
        *engine.port_counters(LINE).unwrap()
    })
}

#[test]
fn bytes_that_are_reported_late_do_not_make_a_silence() {
    let counters = reported_late(&[&[1, 2, 7], &[0, 3, 4]]);
    assert_eq!((counters.frames_in, counters.discarded_bytes, counters.resync_bytes), (1, 0, 0));
}

#[test]
fn a_frame_behind_a_partial_one_is_found() {
    let counters = reported_late(&[&[1, 2, 7], &[1, 2, 7, 0, 3, 4]]);
    assert_eq!((counters.frames_in, counters.resync_bytes), (1, 3));
}
