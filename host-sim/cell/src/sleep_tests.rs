//! A gateway that is not called for a while.

use proto_core::engine::LinkId;
use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};

use super::tests::cell;
use super::*;

const DO1: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];

fn system(chunking: Chunking) -> (Cell, LineId) {
    let mut cell = cell("rs485-system", 1);
    cell.watch();
    let line = cell.line_of("rs485-1");
    cell.line(line).chunking = chunking;
    cell.run_ms(505);
    (cell, line)
}

#[test]
fn what_comes_in_a_short_stall_is_told_before_time_passes() {
    let (mut cell, line) = system(Chunking::Pieces(3));
    let frame = |n: u64| vec![0xFF, 0xFF, (n & 1) as u8, 0xEE, 0xEE];
    cell.attach(line, PeriodicSender::new(cell.now(), 50, u64::MAX, frame));
    cell.run_ms(200);
    let before = *cell.port("rs485-1");
    cell.stall_gateway(Duration::from_millis(490));
    assert!(cell.is_asleep());
    cell.run_ms(489);
    assert_eq!(*cell.port("rs485-1"), before, "nobody calls it");
    cell.run_ms(30);
    let after = *cell.port("rs485-1");
    assert!((24..=26).contains(&(after.frames_in - before.frames_in)), "{after:?}");
    assert_eq!((after.timeouts, after.asleep, cell.engine().sleeps()), (0, 0, 0));
    assert_eq!(cell.violation(), None);
}

#[test]
fn a_line_keeps_no_more_than_a_kernel_does() {
    let (mut cell, line) = system(Chunking::Whole);
    cell.stall_gateway(Duration::from_millis(499));
    for _ in 0..1_000 {
        cell.send(line, &DO1);
    }
    cell.run_ms(600);
    let after = *cell.port("rs485-1");
    assert!((4_096..6_300).contains(&after.bytes_in), "{after:?}");
    assert_eq!(cell.violation(), None);
}

#[test]
fn nothing_comes_of_what_waited_for_a_gateway_that_slept() {
    let (mut cell, line) = system(Chunking::Whole);
    cell.send(line, &[0xFF, 0xFF, 0x00, 0xEE, 0xEE]);
    cell.run_ms(20);
    cell.stall_gateway(Duration::from_millis(800));
    cell.run_ms(400);
    cell.send(line, &DO1);
    cell.run_ms(500);
    assert_eq!((cell.engine().sleeps(), cell.port("rs485-1").asleep), (1, 1));
    assert_eq!(cell.port("rs485-1").discarded_bytes, 5);
    cell.run_ms(2_000);
    assert_eq!(cell.value("DO[1]"), 0.0);
    let history = cell.link(LinkId::MODBUS).history;
    assert_eq!((history.losses, history.connects), (1, 2), "every link begins anew");
    cell.send(line, &DO1);
    cell.run_ms(20);
    assert_eq!(cell.value("DO[1]"), 1.0);
    assert_eq!(cell.violation(), None);
}

#[test]
fn the_kernel_goes_on_without_the_gateway() {
    let (mut cell, line) = system(Chunking::Whole);
    cell.cut_cable(LinkId::MODBUS);
    cell.send(line, &DO1);
    cell.run_ms(1);
    cell.stall_gateway(Duration::from_millis(400));
    cell.repair_cable(LinkId::MODBUS);
    cell.run_ms(250);
    assert_eq!(cell.value("DO[1]"), 1.0, "it was sent again");
    cell.run_ms(160);
    let link = cell.link(LinkId::MODBUS);
    assert_eq!((link.counters.timeouts, link.history.losses), (0, 0), "the answer waited");
    assert_eq!(cell.violation(), None);
}

#[test]
fn a_bus_keeps_no_more_than_a_kernel_does() {
    let mut cell = cell("can-system", 1);
    cell.watch();
    cell.run_ms(505);
    let bus = cell.bus_of("can-1");
    cell.stall_gateway(Duration::from_millis(450));
    for n in 0..300 {
        cell.send_can(bus, CanFrame::new(CanId::Standard(1), &[n as u8 & 1]).unwrap());
    }
    cell.run_ms(440);
    cell.wake_gateway();
    cell.run_ms(1);
    assert_eq!(cell.port("can-1").frames_in, 256);
    assert_eq!(cell.violation(), None);
}

#[test]
fn of_two_stalls_the_longer_one_counts_and_a_restart_ends_it() {
    let (mut cell, _) = system(Chunking::Whole);
    cell.stall_gateway(Duration::from_millis(400));
    cell.stall_gateway(Duration::from_millis(100));
    cell.run_ms(300);
    assert!(cell.is_asleep());
    cell.run_ms(101);
    assert!(!cell.is_asleep());
    cell.stall_gateway(Duration::from_secs(5));
    cell.restart_gateway();
    assert!(!cell.is_asleep());
    cell.run_ms(6_000);
    assert_eq!((cell.engine().sleeps(), cell.violation()), (0, None));
}
