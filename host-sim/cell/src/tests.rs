//! The cell itself: its clock, its networks, its lines.

use proto_core::engine::LinkId;
use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};

use super::*;
use recipe_config::file;
use recipe_test_kit::example;

pub(super) fn cell(name: &str, seed: u64) -> Cell {
    let gateway = file::load_gateway(&example(&format!("{name}.toml")), &[]).unwrap();
    let controller = file::load_controller(&example(&format!("{name}-controller.toml")), &[]).unwrap();
    Cell::new(&gateway, &controller, seed).unwrap()
}

const DO1: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];

#[test]
fn the_same_seed_is_the_same_run_and_another_is_not() {
    let run = |seed| {
        let mut cell = cell("rs485-system", seed);
        cell.every_network(|network| {
            network.jitter = Duration::from_millis(3);
            network.longest_segment = Some(600);
        });
        let line = cell.line_of("rs485-1");
        cell.line(line).noise_ppm = 5_000;
        cell.line(line).chunking = Chunking::Random(4);
        cell.attach(
            line,
            PeriodicSender::new(cell.now(), 50, 200, |n| vec![0xFF, 0xFF, (n & 1) as u8, 0xEE, 0xEE]),
        );
        cell.run(Duration::from_secs(4));
        (cell.trace().digest(), cell.trace().count())
    };
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
}

#[test]
fn how_time_is_cut_into_calls_changes_nothing() {
    let mut whole = cell("rs485-system", 3);
    let mut parts = cell("rs485-system", 3);
    whole.run_ms(1_000);
    for _ in 0..1_000 {
        parts.run_ms(1);
    }
    assert_eq!(whole.trace().digest(), parts.trace().digest());
}

#[test]
fn bytes_take_their_time_on_the_line() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(500);
    let line = cell.line_of("rs485-1");
    let began = cell.now();
    cell.send(line, &DO1);
    // 50 bits at 115200 baud.
    assert_eq!(cell.line(line).device_done_at(), began + Duration::from_micros(435));
    cell.run(Duration::from_micros(434));
    assert_eq!(cell.port("rs485-1").bytes_in, 0);
    cell.run(Duration::from_micros(1));
    assert_eq!(cell.port("rs485-1").frames_in, 1);
}

#[test]
fn two_on_one_pair_garble_each_other() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(500);
    let line = cell.line_of("rs485-1");
    cell.line(line).wiring = Wiring::TwoWire;
    // The gateway sends for 1.8 ms of each 4 ms.
    for _ in 0..100 {
        cell.send(line, &DO1);
        cell.run(Duration::from_micros(3_700));
    }
    let counters = cell.line(line).counters;
    assert!(counters.overlaps > 20, "{counters:?}");
    assert!(counters.garbled_bytes > 100, "{counters:?}");
    let frames = cell.port("rs485-1").frames_in;
    assert!((1..100).contains(&frames), "{frames} of 100");
}

#[test]
fn a_connection_held_delivers_everything_later_and_in_order() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(1_050);
    let before = cell.link(LinkId::STATE).counters.received;
    cell.hold(LinkId::STATE, Way::Down);
    cell.run_ms(1_000);
    assert_eq!(cell.link(LinkId::STATE).counters.received, before);
    cell.release(LinkId::STATE, Way::Down);
    cell.run_ms(1);
    assert_eq!(cell.link(LinkId::STATE).counters.received, before + 10);
    assert_eq!(cell.link(LinkId::STATE).counters.malformed, 0);
}

#[test]
fn a_reset_cuts_at_the_byte() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(1_000);
    let before = *cell.link(LinkId::STATE).counters;
    cell.reset_after(LinkId::STATE, Way::Down, 100);
    cell.run_ms(100);
    let link = cell.link(LinkId::STATE);
    assert_eq!(link.counters.bytes_in, before.bytes_in + 100);
    assert_eq!((link.counters.received, link.history.losses), (before.received, 1));
    assert_eq!(cell.controller().counters().state.open, 0);
    cell.run_ms(300);
    assert_eq!(cell.controller().counters().state.open, 1);
    assert!(cell.link(LinkId::STATE).counters.received > before.received);
}

#[test]
fn a_half_open_connection_is_noticed_by_both_in_the_end() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(1_000);
    cell.half_open(LinkId::STATE);
    cell.run_ms(2_500);
    assert_eq!(cell.link(LinkId::STATE).history.silences, 1);
    // The gateway has a new connection; the controller still has the old one.
    assert_eq!(cell.controller().counters().state.open, 2);
    cell.run(TCP_TIMEOUT);
    assert_eq!(cell.controller().counters().state.open, 1);
    assert_eq!(cell.link(LinkId::STATE).history.connects, 2);
}

#[test]
fn the_lowest_id_wins_the_bus() {
    let mut cell = cell("can-system", 1);
    cell.run_ms(1);
    let bus = cell.bus_of("can-1");
    let frame = |id| CanFrame::new(id, &[1]).unwrap();
    let ids = [CanId::Extended(0x3FF << 18), CanId::Standard(0x400), CanId::Standard(0x3FF)];
    let order: Vec<_> = {
        let bus = cell.bus(bus);
        bus.send(Instant::ZERO, End::Device, frame(CanId::Standard(0)));
        for id in ids {
            bus.send(Instant::ZERO, End::Port, frame(id));
        }
        bus.send(Instant::ZERO, End::Device, frame(CanId::Standard(0x3FF)));
        std::iter::from_fn(|| {
            let crossed = bus.finish(Instant::ZERO)?;
            bus.arbitrate(Instant::ZERO);
            Some((crossed.from, crossed.frame.id()))
        })
        .collect()
    };
    // Each end's frames keep their order; between the ends the lower id wins.
    let expected_from = [End::Device, End::Device, End::Port, End::Port, End::Port];
    assert_eq!(order.iter().map(|(from, _)| *from).collect::<Vec<_>>(), expected_from);
}

#[test]
fn every_kind_of_fault_and_the_cell_recovers() {
    let mut kinds = std::collections::BTreeSet::new();
    for name in ["rs485-system", "udp-server", "can-system"] {
        let mut cell = cell(name, 42);
        let start = cell.now();
        if let Some(line) = cell.lines().next() {
            let frame = |n: u64| vec![0xFF, 0xFF, (n & 1) as u8, 0xEE, 0xEE];
            cell.attach(line, PeriodicSender::new(start, 20, u64::MAX, frame));
        }
        if let Some(bus) = cell.buses().next() {
            let frame = |n: u64| CanFrame::new(CanId::Standard(1), &[(n & 1) as u8]).unwrap();
            cell.attach_can(bus, PeriodicSender::new(start, 20, u64::MAX, frame));
        }
        let mut injector = FaultInjector::new(&mut cell, &FaultKind::ALL, Duration::from_millis(300));
        injector.run(&mut cell, Duration::from_secs(80));
        injector.end_all(&mut cell);
        kinds.extend(injector.counts().keys().copied());
        cell.run(Duration::from_secs(40));
        let mut seen = [0, 0];
        for _ in 0..20 {
            cell.run_ms(50);
            seen[cell.value("DO[1]") as usize] += 1;
        }
        assert!(seen.iter().all(|&n| n > 5), "{name}: field frames get through: {seen:?}");
        let counters = cell.controller().counters();
        let open = [counters.command.open, counters.state.open, counters.modbus.open];
        let wanted = [LinkId::COMMAND, LinkId::STATE, LinkId::MODBUS]
            .map(|id| cell.link_ids().filter(|link| *link == id).count());
        assert_eq!(open, wanted, "{name}: no connection is left over, none is missing");
        assert!(cell.conns.len() == wanted.iter().sum::<usize>(), "{name}: {:?}", cell.conns);
    }
    // These cells have no port that listens for datagrams.
    let all = FaultKind::ALL.into_iter().filter(|kind| *kind != FaultKind::Stranger);
    assert!(kinds.into_iter().eq(all));
}

#[test]
fn an_adapter_gathers_what_the_device_sends_and_hands_it_over_at_once() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(500);
    let line = cell.line_of("rs485-1");
    cell.line(line).chunking = Chunking::Gathered(Duration::from_millis(16));
    let begin = cell.now();
    let past = Duration::from_micros(begin.as_micros() % 16_000);
    cell.run(Duration::from_micros(16_000 - past.as_micros()));
    cell.send(line, &DO1);
    cell.send(line, &DO1);
    cell.run(Duration::from_micros(15_999));
    assert_eq!(cell.port("rs485-1").bytes_in, 0, "it lies in the adapter");
    cell.keep_trace(100);
    cell.run(Duration::from_micros(1));
    let received: Vec<usize> = {
        let entries = cell.trace().entries().iter();
        entries.filter(|entry| entry.what == What::PortReceived).map(|entry| entry.bytes.len()).collect()
    };
    assert_eq!(received, [10]);
    cell.send(line, &DO1);
    cell.run_ms(1);
    cell.unplug(line);
    cell.plug_in(line);
    cell.run_ms(50);
    assert_eq!(cell.port("rs485-1").frames_in, 2, "what was in the adapter went with it");
}

#[test]
fn a_bus_off_controller_hears_nothing() {
    let mut cell = cell("can-system", 1);
    cell.run_ms(500);
    let bus = cell.bus_of("can-1");
    let frame = CanFrame::new(CanId::Standard(1), &[3]).unwrap();
    cell.bus_off(bus);
    cell.send_can(bus, frame);
    cell.run_ms(10);
    assert_eq!(cell.port("can-1").frames_in, 0);
    cell.bus_on(bus);
    cell.send_can(bus, frame);
    cell.run_ms(10);
    assert_eq!(cell.port("can-1").frames_in, 1);
}

#[test]
fn a_controller_of_another_dialect_takes_the_place_of_the_one_before() {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(500);
    cell.replace_controller("v2.6");
    assert_eq!(cell.controller().dialect(), "v2.6");
    cell.run(Duration::from_secs(30));
    let line = cell.line_of("rs485-1");
    cell.send(line, &DO1);
    cell.run_ms(50);
    assert_eq!(cell.value("DO[1]"), 1.0, "values go through all the same");
}
