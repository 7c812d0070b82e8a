//! Cells under random faults: only values that were sent, none of them older than one before, and
//! afterwards everything works again. A failing seed is printed; it repeats the run.

use proto_core::engine::{LinkId, LinkKind};
use proto_core::link::LinkState;
use proto_core::time::Duration;
use recipe_cell::{Cell, FaultInjector, FaultKind, LineId, PeriodicSender};
use recipe_test_kit::toml;

use crate::kit::*;

/// The first `few` seeds, or as many as `CELL_SEEDS` says.
fn seeds(few: u64) -> std::ops::Range<u64> {
    let wanted = std::env::var("CELL_SEEDS").ok().and_then(|count| count.parse().ok());
    0..wanted.unwrap_or(few)
}

/// All faults but those that make wrong values which no check of the format can detect, and restarts that
/// are not counted as such.
fn honest() -> Vec<FaultKind> {
    let lies = [FaultKind::Noise, FaultKind::Garbage, FaultKind::Dialect];
    FaultKind::ALL.into_iter().filter(|kind| !lies.contains(kind)).collect()
}

/// Checks that all links are up, each with one connection at the controller, and that it has no others.
#[track_caller]
fn assert_whole(cell: &Cell, seed: u64) {
    let counters = cell.controller().counters();
    let open = [counters.command.open, counters.state.open, counters.modbus.open];
    // A link that a controller with a single client has refused is not opened again.
    let is_shared = |id: LinkId| cell.link(id).state == LinkState::Shared;
    let needed = [&[LinkId::COMMAND, LinkId::URGENT][..], &[LinkId::STATE], &[LinkId::MODBUS]]
        .map(|ids| cell.link_ids().filter(|link| ids.contains(link) && !is_shared(*link)).count());
    assert_eq!(open, needed, "seed {seed}");
    for link in cell.engine().links() {
        let may_wait =
            matches!(link.kind, LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. });
        let up = matches!(link.state, LinkState::Up { .. } | LinkState::Shared);
        assert!(up || may_wait, "seed {seed}: {link:?}");
    }
}

/// A minute of all faults, and time to recover from them.
#[track_caller]
fn survive(cell: &mut Cell, seed: u64) {
    let mut injector = FaultInjector::new(cell, &FaultKind::ALL, Duration::from_millis(500));
    injector.run(cell, Duration::from_secs(60));
    injector.end_all(cell);
    cell.run(RECOVERY);
    assert_whole(cell, seed);
}

/// Enough for backoff and TCP's timeouts.
const RECOVERY: Duration = Duration::from_secs(40);

const COUNTING: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "count"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["WordInputReg[1]", "BitInputReg[3]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = ["RobotState[8..9]", "WordOutputReg[1]"]

[[port]]
name = "count"
bus = "rs485"
recipe = "count"
cycle_ms = 20
timeout_ms = 100
"#;

/// A cell with a device that counts: each frame's word is one more than the previous one.
fn counting(seed: u64) -> (Cell, LineId) {
    let mut cell = Cell::new(&toml::gateway(COUNTING), &recipe_config::SimConfig::default(), seed).unwrap();
    let line = cell.line_of("count");
    cell.attach(line, PeriodicSender::new(cell.now(), 40, u64::MAX, count_frame));
    (cell, line)
}

fn count_frame(n: u64) -> Vec<u8> {
    let [low, high] = (n as u16).to_le_bytes();
    vec![0xFF, 0xFF, low, high, low, 0xEE, 0xEE]
}

#[test]
fn values_are_never_made_up_and_never_go_back() {
    for seed in seeds(3) {
        let (mut cell, line) = counting(seed);
        cell.every_network(|network| {
            network.jitter = Duration::from_millis(2);
            network.longest_segment = Some(30);
        });
        let mut injector = FaultInjector::new(&mut cell, &honest(), Duration::from_millis(400));
        let (mut newest, mut restarts, mut cleared) = (0, 0, 0);
        for _ in 0..20_000 {
            injector.run(&mut cell, Duration::from_millis(2));
            let value = cell.value("WordInputReg[1]") as u64;
            assert!(value < cell.line(line).counters.device_sent.max(1), "seed {seed}: {value} was not sent");
            let times = |kind| injector.counts().get(&kind).copied().unwrap_or(0);
            let now = times(FaultKind::ControllerRestart);
            // After a power cut the controller starts at 0.
            let has_power_again = value < newest && value == 0 && cleared < times(FaultKind::PowerCut);
            cleared += u64::from(has_power_again);
            if now != restarts || has_power_again {
                (newest, restarts) = (0, now);
            }
            assert!(value >= newest, "seed {seed}: {value} after {newest} at {:?}", cell.now());
            newest = value;
        }
        injector.end_all(&mut cell);
        cell.run(RECOVERY);
        assert_whole(&cell, seed);
        let before = cell.value("WordInputReg[1]");
        cell.run(Duration::from_secs(1));
        let after = cell.value("WordInputReg[1]");
        assert!((39.0..=41.0).contains(&(after - before)), "seed {seed}: {before} to {after}");
    }
}

#[test]
fn every_example_survives_everything_and_works_again() {
    for name in ["rs485-user", "rs485-system", "udp-server", "client", "force-sensor", "request-response"] {
        for seed in seeds(1) {
            let (gateway, controller) = files(name);
            let mut cell = Cell::new(&gateway, &controller, seed).unwrap();
            let line = cell.lines().next().unwrap();
            let mut rng = cell.fork_rng();
            let frame: Vec<u8> = match name {
                "rs485-user" => vec![0xFF, 0xFF, 1, 2, 3, 0xEE, 0xEE],
                "force-sensor" => force_frame([1.0; 6]),
                "request-response" => vec![0xFF, 0xFF, 2, 1, 0, 0xEE, 0xEE],
                _ => outputs(3).to_vec(),
            };
            // Often enough for the force sensor's timeout of 20 ms, even if single frames are damaged.
            let device = PeriodicSender::new(cell.now(), 150, u64::MAX, move |_| match rng.below(20) {
                0 => rng.bytes(9),
                _ => frame.clone(),
            });
            cell.attach(line, device);
            survive(&mut cell, seed);
            let value = match name {
                "rs485-user" => cell.value("WordInputReg[3]") == 3.0,
                "force-sensor" => force(&cell) == [1.0; 6],
                "request-response" => cell.value("WordInputReg[1]") == 1.0,
                _ => cell.value("DigitalOutputCommand[1]") == 3.0,
            };
            assert!(value, "{name}, seed {seed}: the field's values do not get through");
            let sent = cell.line(line).counters.port_sent;
            cell.run(Duration::from_secs(1));
            let moves = cell.line(line).counters.port_sent - sent;
            assert!(moves > 0 || name == "force-sensor", "{name}, seed {seed}: nothing goes to the field");
        }
    }
}

#[test]
fn can_cells_survive_everything_and_work_again() {
    for name in ["can-user", "can-system", "can-hand"] {
        for seed in seeds(1) {
            let (gateway, controller) = files(name);
            let mut cell = Cell::new(&gateway, &controller, seed).unwrap();
            let bus = cell.buses().next().unwrap();
            let frame = match name {
                "can-user" => can(1, &[1, 2, 3]),
                "can-hand" => can(0x502, &[4, 0, 1, 1]),
                _ => can(1, &[3]),
            };
            let mut rng = cell.fork_rng();
            let device = PeriodicSender::new(cell.now(), 30, u64::MAX, move |_| match rng.below(20) {
                0 => can(rng.below(0x800) as u16 | 0x400, &rng.bytes(3)),
                _ => frame,
            });
            cell.attach_can(bus, device);
            survive(&mut cell, seed);
            let value = match name {
                "can-user" => cell.value("WordInputReg[3]") == 3.0,
                "can-hand" => cell.value("WordInputReg[1]") == 4.0,
                _ => cell.value("DigitalOutputCommand[1]") == 3.0,
            };
            assert!(value, "{name}, seed {seed}: the field's values do not get through");
            cell.bus(bus).take_heard();
            cell.run(Duration::from_secs(1));
            assert!(!cell.bus(bus).take_heard().is_empty(), "{name}, seed {seed}: nothing goes to the field");
        }
    }
}

#[test]
fn the_same_seed_breaks_the_same_things_at_the_same_time() {
    let run = |seed| {
        let (mut cell, _) = counting(seed);
        let mut injector = FaultInjector::new(&mut cell, &FaultKind::ALL, Duration::from_millis(200));
        injector.run(&mut cell, Duration::from_secs(30));
        (cell.trace().digest(), cell.trace().count(), injector.counts().clone())
    };
    assert_eq!(run(5), run(5));
    assert_ne!(run(5).0, run(6).0);
}
