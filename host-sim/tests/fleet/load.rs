//! A board at full load that tells a broker, which dies and comes back, beside the same board that tells nobody.
//!
//! One after the other: each has the whole machine. QEMU moves the bytes of a UART one by one, so its host
//! decides how many get through, and how many cycles are kept; what got in is accounted for to the last frame.

use std::fmt;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use recipe_test_kit::{example, latency, until, until_grown};
use rustix::process::Signal;
use serde_json::Value as Json;

use crate::board::{Board as _, HERE, Surroundings};
use crate::broker::{Plant, Way};
use crate::ctl::{Ctl, TIMEOUT};
use crate::field::{CanClient, LineClient};
use crate::on_board::settings;
use crate::qemu::{Qemu, UARTS};
use crate::robot::Robot;
use crate::target::Target;
use crate::traffic::{Bus, CAN_RATE, CELL, Generator, Panel, SENSOR_RATE, can_frame, sensor_frame};

/// Of each run.
fn duration() -> Duration {
    let seconds = std::env::var("HOST_SIM_LOAD_SECONDS");
    Duration::from_secs_f64(seconds.map_or(3.0, |text| text.parse().expect("HOST_SIM_LOAD_SECONDS")))
}

/// When the broker dies and when it is started, as parts of a run.
const DEATHS: [(f64, bool); 4] = [(0.1, false), (0.3, true), (0.5, false), (0.7, true)];

/// What a board did.
#[derive(Debug)]
struct Did {
    /// Frames of the sensor and on CAN, all taken.
    taken: [u32; 2],
    /// Frames to the panel and on CAN, all heard.
    heard: [u64; 2],
    cycles: u64,
    skipped: u64,
    /// Of each histogram: name, samples, and the buckets of the median and of 99 %.
    latency: Vec<(&'static str, u64, [usize; 2])>,
}

const HISTOGRAMS: [&str; 4] = ["handed_over", "arrived", "lateness", "modbus"];

impl fmt::Display for Did {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([sensor, can], [panel, bus]) = (self.taken, self.heard);
        write!(
            f,
            "{sensor} frames of the sensor and {can} on CAN taken, {panel} to the panel and {bus} on CAN heard; "
        )?;
        write!(f, "{} of {} cycles left out", self.skipped, self.cycles + self.skipped)?;
        for (name, count, [median, most]) in &self.latency {
            write!(f, "\n  {name}: {count}, p50 < {} us, p99 < {} us", 1_u64 << median, 1_u64 << most)?;
        }
        Ok(())
    }
}

/// A board with the cell of the scenarios, before its controller says anything.
struct Cell {
    board: Qemu,
    ctl: Ctl,
    sensor: LineClient,
    panel: LineClient,
    bus: LineClient,
}

impl Cell {
    /// Claimed and restarted, with these settings of its edge node. Until its controller goes on it sends nothing, so
    /// its devices hear the first frame.
    fn new(plant: Option<&Plant>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let robot = Robot::of(&example("force-sensor-controller.toml"));
        let port = |name: &str| robot.0.at(name).port();
        let ports = format!(
            "address = \"{HERE}\"\nports = {{ command = {}, state = {}, modbus = {} }}",
            port("command"),
            port("state"),
            port("modbus"),
        );
        let text = CELL
            .replace("address = \"127.0.0.1\"", &ports)
            .replace("udp = 2011", &format!("udp = {}", port("udp2011")))
            // A host that is busy makes gaps in frames.
            .replace("idle_gap_ms = 5", "idle_gap_ms = 500");
        let file = folder.path().join("cell.toml");
        std::fs::write(&file, text).unwrap();
        let mut board = Qemu::with(Surroundings::with(folder, robot));
        Target::start(&mut board, &file);
        board.claim();
        let key = Some(board.folder().path().join("key"));
        let ctl = Ctl { to: board.address(), host: board.host(), key, timeout: TIMEOUT };
        if let Some(plant) = plant {
            let file = settings(plant, "values = [\"RobotState[1..12]\"]");
            ctl.done(&["edge", file.to_str().unwrap()]);
        }
        Target::kill(&mut board);
        board.around().robot.0.freeze();
        Target::start(&mut board, &file);
        let [sensor, panel, bus] = UARTS.map(|uart| UnixStream::connect(board.around().path(uart)).unwrap());
        Self {
            ctl,
            sensor: LineClient::new(Box::new(sensor)),
            panel: LineClient::new(Box::new(panel)),
            bus: CanClient::join(Box::new(bus)).into_line(),
            board,
        }
    }

    /// A document, whether all is well in it or not.
    fn document(&self, path: &str) -> Option<Json> {
        serde_json::from_str(&self.ctl.run(&["--json", path]).out).ok()
    }

    /// A document that says so.
    #[track_caller]
    fn until(&self, what: &str, path: &str, is_so: impl Fn(&Json) -> bool) -> Json {
        until(what, || self.document(path).filter(&is_so))
    }
}

fn count(status: &Json, port: &str, counter: &str) -> u64 {
    let count = status["ports"][port]["counters"][counter].as_u64();
    count.unwrap_or_else(|| panic!("no {port}.{counter} in {status}"))
}

/// A run under full load. With a plant there is a broker at its begin and at its end.
fn run(plant: Option<&Plant>) -> Did {
    let mut cell = Cell::new(plant);
    let mut broker = plant.map(Plant::broker);
    cell.board.around().robot.0.signal(Signal::CONT);
    if plant.is_some() {
        cell.until("the edge node is online", "edge", |edge| edge["state"] == "online");
    }
    let is_up = |link: &Json| link["state"] == "up";
    let before = cell.until("all links are up", "status", |status| {
        status["links"].as_object().is_some_and(|links| links.values().all(is_up))
    });
    let (mut panel, mut bus) = (Panel::default(), Bus::default());
    let sensor = Generator::start(SENSOR_RATE, cell.sensor.take_writer(), sensor_frame);
    let can = Generator::start(CAN_RATE, cell.bus.take_writer(), can_frame);
    let (begin, length) = (Instant::now(), duration());
    let mut deaths = DEATHS.iter().filter(|_| plant.is_some()).peekable();
    while begin.elapsed() < length {
        if let Some((_, lives)) = deaths.next_if(|(part, _)| begin.elapsed() >= length.mul_f64(*part)) {
            broker = plant.filter(|_| *lives).map(Plant::broker);
        }
        panel.take(&cell.panel.take_some(Duration::from_millis(20)));
        bus.take(&cell.bus.take_all());
    }
    let after = cell.until("a status", "status", |_| true);
    let (sensor, can) = (sensor.end(), can.end());
    if let Some(plant) = plant {
        broker.get_or_insert_with(|| plant.broker());
        let edge = cell.until("the edge node is online again", "edge", |edge| edge["state"] == "online");
        assert!(edge["counters"]["sessions"].as_u64() >= Some(2), "{edge}");
    }

    // In: all that was sent was accepted, and the newest value is at the controller.
    let sent = [("force", sensor.frames), ("bus", can.frames)];
    for (port, frames) in sent {
        until_grown(&format!("frames from {port}"), frames.into(), || {
            cell.document("status").map_or(0, |status| count(&status, port, "frames_in"))
        });
    }
    let status = cell.until("a status", "status", |_| true);
    for (port, frames) in sent {
        assert_eq!(count(&status, port, "frames_in"), u64::from(frames), "{status}");
        let skipped = ["resync_bytes", "discarded_bytes"].map(|counter| count(&status, port, counter));
        assert_eq!(skipped, [0, 0], "{status}");
    }
    let robot = &cell.board.around().robot.0;
    for (name, value) in [
        ("WordInputReg[1]", f64::from((can.frames - 1) as u16)),
        ("WordInputReg[2]", f64::from(((can.frames - 1) >> 16) as u16)),
        ("ForceEnd[1]", f64::from((sensor.frames - 1) as f32)),
    ] {
        let is_there = |stats: &Json| stats["registers"][name].as_f64().unwrap_or(0.0) == value;
        robot.stats(&format!("{name} = {value}"), is_there);
    }
    // Out: it ends with the controller's state; then all that was sent was heard.
    robot.freeze();
    until("all that was sent is heard", || {
        panel.take(&cell.panel.take_all());
        bus.take(&cell.bus.take_all());
        let status = cell.document("status")?;
        let is_stopped = status["links"]["state"]["state"] != "up";
        let sent = ["panel", "bus"].map(|port| count(&status, port, "frames_out"));
        (is_stopped && sent == [panel.frames, bus.frames]).then_some(())
    });

    let grown = |port, counter| count(&after, port, counter) - count(&before, port, counter);
    let latency = HISTOGRAMS.map(|name| {
        let (count, [median, most, _]) = latency::grown(&before, &after, name);
        (name, count, [median, most])
    });
    Did {
        taken: [sensor.frames, can.frames],
        heard: [panel.frames, bus.frames],
        cycles: grown("panel", "frames_out"),
        skipped: grown("panel", "skipped_cycles"),
        latency: latency.into(),
    }
}

#[test]
#[ignore = "needs mosquitto, HOST_SIM_FIRMWARE and qemu-system-arm"]
fn a_board_at_full_load_loses_nothing_to_a_broker_that_dies_and_comes_back() {
    let plant = Plant::new(Way::Plain);
    let (alone, telling) = (run(None), run(Some(&plant)));
    println!("alone: {alone}\nwith an edge node: {telling}");
}
