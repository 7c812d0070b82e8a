//! Soak runs: one seed gives one trace, on every machine and however the run is split.

use std::sync::Arc;

use proto_core::config::{FieldSpec, Transaction};
use proto_core::device::Encoding;
use proto_core::modbus::rtu::Operation;
use proto_core::time::Duration;
use proto_core::wire::scalar::ScalarType;
use recipe_cell::Invariant;
use recipe_cell::soak::{Batch, Level, Part, PartFailure, Scenario, Share, Soak, Total};

fn soaked(level: Level, seed: u64, span: Duration, jobs: usize) -> Total {
    ended(Batch::new(Scenario::all().unwrap(), level, seed, span), jobs).total()
}

fn ended(batch: Batch, jobs: usize) -> Arc<Batch> {
    let batch = Arc::new(batch);
    let workers: Vec<_> = (0..jobs)
        .map(|_| {
            let batch = Arc::clone(&batch);
            std::thread::spawn(move || batch.work())
        })
        .collect();
    workers.into_iter().for_each(|worker| worker.join().unwrap());
    assert_eq!(batch.failure(), None);
    batch
}

/// The documents of shares 1/3, 2/3 and 3/3, and that of one run.
fn shared(cells: &[&str], level: Level, span: Duration) -> ([Part; 3], Part) {
    let batch = || {
        let cells = cells.iter().map(|name| Scenario::named(name).unwrap().unwrap());
        Batch::new(cells.collect(), level, 42, span)
    };
    let part = |batch| {
        let part = Part::of(&ended(batch, 1), &[], 7);
        let text = serde_json::to_string(&part).unwrap();
        let read: Part = serde_json::from_str(&text).unwrap();
        assert_eq!(read, part);
        read
    };
    let share = |nth| part(batch().only(Share::new(nth, 3).unwrap()));
    ([1, 2, 3].map(share), part(batch()))
}

/// The hashes of these runs on every machine. Only a change of what the engine, the controller or the cell
/// does, or when, may change them; then enter the new ones here.
const HASHES: [(Level, u64); 2] =
    [(Level::None, 0x9713_580D_9A44_A969), (Level::Harsh, 0xB0E4_949E_8EF3_2B27)];

#[test]
fn a_seed_means_the_same_trace_on_every_machine() {
    let hashes = HASHES.map(|(level, _)| (level, soaked(level, 42, Duration::from_secs(120), 2).hash));
    assert_eq!(hashes, HASHES, "{hashes:#x?}");
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let span = Duration::from_secs(30);
    let one = soaked(Level::Harsh, 8, span, 1);
    assert_eq!(one, soaked(Level::Harsh, 8, span, 3));
    assert_eq!(one.span, span);
    assert!(one.cells.len() > 9 && one.writes > 500, "{one:?}");
    // Commands and safe values, and slaves, are checked in longer runs of the cells that have most of them.
    let mut checks = one.checks.clone();
    for (name, seeds, seconds) in
        [("orders", 1..=3, 180), ("modbus-line", 1..=2, 60), ("judged-axis", 1..=3, 180)]
    {
        let scenario = Scenario::named(name).unwrap().unwrap();
        for seed in seeds {
            let mut soak = Soak::new(&scenario, seed, Level::Harsh).unwrap();
            soak.run_to(Duration::from_secs(seconds));
            let report = soak.report();
            assert_eq!(report.violation, None);
            for (what, count) in report.checks {
                *checks.entry(what).or_default() += count;
            }
        }
    }
    let never: Vec<_> =
        checks.iter().filter(|(_, count)| **count == 0).map(|(what, _)| what.name()).collect();
    assert_eq!(never, [""; 0], "every invariant is looked at");
}

#[test]
fn how_a_run_is_cut_changes_nothing() {
    let scenario = Scenario::named("several-ports").unwrap().unwrap();
    let run = |step: u64| {
        let mut soak = Soak::new(&scenario, 5, Level::Harsh).unwrap();
        for at in (step..=12_000).step_by(step as usize) {
            soak.run_to(Duration::from_millis(at));
        }
        soak.report()
    };
    assert_eq!(run(12_000), run(75));
}

#[test]
fn devices_that_are_asked_are_judged_at_what_they_have_and_at_the_robot() {
    let levels = [Level::None, Level::Harsh].into_iter();
    for (name, level) in levels.flat_map(|level| [("modbus-line", level), ("gripper-line", level)]) {
        let scenario = Scenario::named(name).unwrap().unwrap();
        let mut soak = Soak::new(&scenario, 12, level).unwrap();
        soak.run_to(Duration::from_secs(120));
        let report = soak.report();
        assert_eq!(report.violation, None);
        let looked_at = |invariant| report.checks[&invariant];
        assert!(looked_at(Invariant::Held) > 3_000, "{report:?}");
        assert!(looked_at(Invariant::Carried) > 200, "{report:?}");
        assert!(looked_at(Invariant::Periods) > 5_000, "{report:?}");
        assert!(level == Level::Harsh || looked_at(Invariant::Updated) > 10, "{report:?}");
        let (_, received, sent) = report.ports[0];
        assert!(received > 1_000 && sent > 1_000, "{report:?}");
    }
}

/// The lamp of one slave and the shift of all of them are bits of registers of which another master has the others.
#[test]
fn bits_of_shared_registers_are_judged() {
    for (level, seed) in [(Level::None, 12), (Level::Harsh, 12), (Level::Harsh, 13)] {
        let mut scenario = Scenario::named("modbus-line").unwrap().unwrap();
        let config = &mut scenario.gateway;
        let mut masked = 0;
        for exchange in &mut config.exchanges {
            let Transaction::Rtu { operation, written, .. } = &mut exchange.transaction else { continue };
            let Operation::WriteRegister { address } = *operation else { continue };
            *operation = Operation::MaskWriteRegister { address, mask: 0x7FF8 };
            let field = &mut config.fields[usize::from(written.start)];
            let FieldSpec::DeviceOutput { encoding, .. } = field else { panic!("{field:?}") };
            *encoding = Encoding::bits(ScalarType::Word, 3..=14).big_endian();
            masked += 1;
        }
        config.validate().unwrap();
        assert_eq!(masked, 2);
        let mut soak = Soak::new(&scenario, seed, level).unwrap();
        soak.run_to(Duration::from_secs(120));
        let report = soak.report();
        assert_eq!(report.violation, None);
        assert!(report.checks[&Invariant::Carried] > 200, "{report:?}");
        assert!(level == Level::Harsh || report.checks[&Invariant::Updated] > 10, "{report:?}");
    }
}

#[test]
fn a_reply_to_what_was_asked_before_a_restart_shifts_no_others() {
    let scenario = Scenario::named("gripper-line").unwrap().unwrap();
    for seed in [640_986_322_689, 1, 2, 3] {
        let mut soak = Soak::new(&scenario, seed, Level::Harsh).unwrap();
        soak.run_to(Duration::from_secs(60));
        assert_eq!(soak.report().violation, None, "seed {seed}");
    }
}

#[test]
fn frames_on_a_bus_are_told_apart_and_counted() {
    let scenario = Scenario::named("can-frames").unwrap().unwrap();
    let mut soak = Soak::new(&scenario, 7, Level::None).unwrap();
    soak.run_to(Duration::from_secs(120));
    assert_eq!(soak.report().violation, None);
    let drives = soak.cell().port("drives");
    assert!(drives.frames_in > 1_000 && drives.frames_out > 10_000, "{drives:?}");
    assert!(drives.rejected_counter > 20 && drives.counter_jumps > 20, "{drives:?}");
    assert!(drives.rejected_checksum > 5 && drives.rejected_other_device > 0, "{drives:?}");
    let node = soak.cell().port("node");
    assert!(node.unanswered > 5 && node.frames_out > 3_000, "{node:?}");
}

#[test]
fn a_master_asks_the_gateway_and_lines_echo() {
    let scenario = Scenario::named("panel-line").unwrap().unwrap();
    for level in [Level::None, Level::Harsh] {
        let mut soak = Soak::new(&scenario, 9, level).unwrap();
        soak.run_to(Duration::from_secs(60));
        let report = soak.report();
        assert_eq!(report.violation, None);
        let looked_at = |invariant| report.checks[&invariant];
        assert!(looked_at(Invariant::Held) > 500 && looked_at(Invariant::Carried) > 200, "{report:?}");
        let [meters, scale, plc] = &report.ports[..] else { panic!("{report:?}") };
        assert!(meters.1 > 100 && scale.1 > 100 && plc.1 > 50 && plc.2 > 100, "{report:?}");
    }
}

#[test]
fn shares_of_three_machines_make_what_one_machine_makes() {
    let all = Scenario::all().unwrap();
    let cells: Vec<_> = all.iter().map(|cell| cell.name.as_str()).collect();
    for level in [Level::None, Level::Mild, Level::Harsh] {
        let span = Duration::from_secs(24);
        let ([first, second, third], whole) = shared(&cells, level, span);
        let merged = Part::merge(&[third, first, second]).unwrap();
        assert_eq!(merged, whole);
        assert_eq!(merged.total().unwrap(), soaked(level, 42, span, 2));
    }
}

/// Cells that are quick, one run each.
const FOUR: [&str; 4] = ["client", "witness", "orders", "rs485-system"];

#[test]
fn shares_that_are_not_one_run_are_refused() {
    let ([first, second, third], _) = shared(&FOUR, Level::None, Duration::from_secs(4));
    let refused = |parts: &[&Part]| {
        let parts: Vec<_> = parts.iter().map(|&part| part.clone()).collect();
        Part::merge(&parts).unwrap_err().to_string()
    };
    let changed = |change: &dyn Fn(&mut Part)| {
        let mut part = second.clone();
        change(&mut part);
        refused(&[&first, &part, &third])
    };
    insta::assert_snapshot!(
        [
            refused(&[]),
            refused(&[&first]),
            refused(&[&first, &third]),
            refused(&[&first, &second, &second, &third]),
            changed(&|part| part.soak = 1),
            changed(&|part| part.version = "0.1.0".into()),
            changed(&|part| part.seed = 43),
            changed(&|part| part.faults = "harsh".into()),
            changed(&|part| part.virtual_us -= 1),
            changed(&|part| part.shard = "2/4".into()),
            changed(&|part| part.shard = "4/3".into()),
            changed(&|part| part.shard = "3/3".into()),
            changed(&|part| part.cells[1].name = "saw".into()),
            changed(&|part| part.cells[1].fingerprint = "0".into()),
            changed(&|part| part.digests[0] = None),
            changed(&|part| {
                part.digests[0] = None;
                part.sums.cells.get_mut("witness").unwrap().0 = 0;
            }),
            changed(&|part| part.digests[0] = Some("+123456789abcdef".into())),
            changed(&|part| part.digests.push(None)),
            changed(&|part| part.first_run = 0),
            changed(&|part| {
                part.sums.checks.insert("luck".into(), 1);
            }),
            changed(&|part| {
                part.sums.faults.insert("luck".into(), 1);
            }),
        ]
        .join("\n")
    );
}

#[test]
fn a_failure_of_a_share_is_the_failure_of_all() {
    let ([first, mut second, mut third], _) = shared(&FOUR, Level::None, Duration::from_secs(4));
    let failure = |run| PartFailure {
        run,
        seed: run as u64,
        cell: "client".into(),
        after_us: 5,
        what: "ownership: it wrote what nobody owns".into(),
    };
    // A share that has failed has stopped: some of its runs are not there.
    third.digests.fill(None);
    third.sums = Default::default();
    third.failure = Some(failure(3));
    second.failure = Some(failure(1));
    let merged = Part::merge(&[third, second, first]).unwrap();
    assert_eq!(merged.failure, Some(failure(1)));
    assert_eq!(merged.total().unwrap().runs, 2);
}
