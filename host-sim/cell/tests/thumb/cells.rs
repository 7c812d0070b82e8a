//! The cells whose engine is recorded, and what happens in them.

use proto_core::config::GatewayConfig;
use proto_core::time::Duration;
use proto_core::wire::can::CanFrame;
use proto_core::wire::can::CanId;
use recipe_cell::{Cell, Chunking, FaultInjector, FaultKind, PeriodicSender, Rng};
use recipe_config::SimConfig;
use recipe_config::file;
use recipe_test_kit::{example, repository, toml};

use crate::arithmetic;

/// A cell's name, and the function that makes its recording.
pub(crate) struct Recorded {
    pub(crate) name: String,
    pub(crate) record: fn(&str) -> Vec<u8>,
}

/// What a device of a cell sends.
enum Frames {
    /// This many bytes between head and tail.
    Stream { head: [u8; 2], payload: usize, tail: [u8; 2] },
    /// This many bytes with this id.
    Can { id: u16, payload: usize },
}

const FF: [u8; 2] = [0xFF, 0xFF];
const EE: [u8; 2] = [0xEE, 0xEE];

/// The example files with a field port, what its device sends, and at what rate per second.
const EXAMPLES: [(&str, Frames, u64); 9] = [
    ("rs485-user", Frames::Stream { head: FF, payload: 3, tail: EE }, 50),
    ("rs485-system", Frames::Stream { head: FF, payload: 1, tail: EE }, 100),
    ("can-user", Frames::Can { id: 1, payload: 3 }, 200),
    ("can-system", Frames::Can { id: 1, payload: 1 }, 200),
    ("udp-server", Frames::Stream { head: FF, payload: 1, tail: EE }, 100),
    // The controller's TCP client connects to the gateway.
    ("client", Frames::Stream { head: FF, payload: 1, tail: EE }, 100),
    // Payloads are random bits: some are no finite floats.
    ("force-sensor", Frames::Stream { head: [0x48, 0xAA], payload: 24, tail: [0x0D, 0x0A] }, 960),
    ("can-hand", Frames::Can { id: 0x502, payload: 4 }, 50),
    ("request-response", Frames::Stream { head: FF, payload: 3, tail: EE }, 20),
];

/// The cell whose instructions are counted; it is no example.
const FOUR_PORTS: &str = "four ports";

/// All cells: without faults, with faults, and one for arithmetic.
pub(crate) fn all() -> Vec<Recorded> {
    let names = || EXAMPLES.iter().map(|example| example.0).chain([FOUR_PORTS]);
    let without = names().map(|name| Recorded { name: name.to_owned(), record: without_faults });
    let with = names().map(|name| Recorded { name: format!("{name} with faults"), record: with_faults });
    let arithmetic = Recorded { name: "arithmetic".to_owned(), record: |_| arithmetic::record() };
    without.chain(with).chain([arithmetic]).collect()
}

fn without_faults(name: &str) -> Vec<u8> {
    let mut cell = talking(name, Chunking::Random(40));
    cell.run(Duration::from_millis(1_500));
    // The devices fall silent: timeouts and safe values.
    silence(&mut cell);
    cell.run(Duration::from_millis(700));
    cell.into_recording()
}

fn with_faults(name: &str) -> Vec<u8> {
    let mut cell = talking(name.trim_end_matches(" with faults"), Chunking::Random(9));
    cell.every_network(|network| {
        network.jitter = Duration::from_millis(1);
        network.longest_segment = Some(100);
    });
    let mut injector = FaultInjector::new(&mut cell, &FaultKind::ALL, Duration::from_millis(60));
    // Long faults would leave little for the others to act on.
    for _ in 0..4 {
        injector.run(&mut cell, Duration::from_secs(1));
        injector.end_all(&mut cell);
        cell.run(Duration::from_millis(700));
    }
    assert!(injector.counts().len() > 8, "{name}: {:?}", injector.counts());
    cell.into_recording()
}

/// The cell of these files, with devices that send.
fn talking(name: &str, chunking: Chunking) -> Cell {
    if name == FOUR_PORTS {
        return four_ports(chunking);
    }
    let (gateway, controller) = files(name);
    let mut cell = recorded(&gateway, &controller);
    let Some((_, frames, rate)) = EXAMPLES.iter().find(|example| example.0 == name) else {
        panic!("no example {name}");
    };
    let mut rng = Rng::new(rate * 7);
    let start = cell.now() + Duration::from_millis(20);
    match *frames {
        Frames::Stream { head, payload, tail } => {
            let line = cell.lines().next().expect("a line");
            cell.line(line).chunking = chunking;
            let frame = move |_| [&head[..], &rng.bytes(payload), &tail].concat();
            cell.attach(line, PeriodicSender::new(start, *rate, u64::MAX, frame));
        }
        Frames::Can { id, payload } => {
            let bus = cell.buses().next().expect("a bus");
            // Sometimes another id, or another length.
            let frame = move |nth| match nth % 16 {
                14 => can(id + 1, &rng.bytes(payload)),
                15 => can(id, &rng.bytes(payload + 1)),
                _ => can(id, &rng.bytes(payload)),
            };
            cell.attach_can(bus, PeriodicSender::new(start, *rate, u64::MAX, frame));
        }
    }
    cell
}

/// All kinds of ports: a PLC to Modbus, a force sensor to UDP, CAN in both directions, a display.
fn four_ports(chunking: Chunking) -> Cell {
    let path = repository().join("firmware/examples/counts.toml");
    let set = ["plc.timeout_ms=50", "sensor.timeout_ms=20", "devices.timeout_ms=100", "devices.cycle_ms=4"];
    let set = set.into_iter().chain(["display.cycle_ms=4"]).map(|set| format!("port.{set}"));
    let gateway = file::load_gateway(&path, &set.collect::<Vec<_>>());
    let gateway = gateway.unwrap_or_else(|error| panic!("{error}"));
    let mut cell = recorded(&gateway, &toml::controller(FORCES));
    let start = cell.now() + Duration::from_millis(20);
    let mut rng = Rng::new(4);
    for (port, rate, head, tail) in [("plc", 150, FF, EE), ("sensor", 960, [0x48, 0xAA], [0x0D, 0x0A])] {
        let line = cell.line_of(port);
        cell.line(line).chunking = chunking;
        let mut rng = rng.fork();
        let frame = move |_| [&head[..], &rng.bytes(24), &tail].concat();
        cell.attach(line, PeriodicSender::new(start, rate, u64::MAX, frame));
    }
    let bus = cell.bus_of("devices");
    let frame = move |_| can(0x500 + rng.below(14) as u16, &rng.bytes(2));
    cell.attach_can(bus, PeriodicSender::new(start, 500, u64::MAX, frame));
    cell
}

/// The controller of the cell with four ports: its UDP server receives forces.
const FORCES: &str = r#"
[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["ForceEnd[1..6]"]

[[port]]
name = "udp2011"
bus = "udp-server"
recipe = "up"
"#;

fn silence(cell: &mut Cell) {
    let start = cell.now();
    for line in cell.lines().collect::<Vec<_>>() {
        cell.attach(line, PeriodicSender::new(start, 1, 0, |_| Vec::new()));
    }
    for bus in cell.buses().collect::<Vec<_>>() {
        cell.attach_can(bus, PeriodicSender::new(start, 1, 0, |_| can(0, &[])));
    }
}

/// The gateway's example file of this name, and the controller's.
fn files(name: &str) -> (Box<GatewayConfig>, SimConfig) {
    let gateway = file::load_gateway(&example(&format!("{name}.toml")), &[]);
    let controller = file::load_controller(&example(&format!("{name}-controller.toml")), &[]);
    (gateway.unwrap_or_else(|error| panic!("{error}")), controller.unwrap_or_else(|error| panic!("{error}")))
}

pub(crate) fn can(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), data).unwrap()
}

/// A cell that is recorded, switched on just now.
pub(crate) fn recorded(gateway: &GatewayConfig, controller: &SimConfig) -> Cell {
    Cell::recorded(gateway, controller, 42).unwrap_or_else(|error| panic!("{error}"))
}
