//! Slaves that are late, refuse, garble or babble, and adapters that echo.

use proto_core::modbus::Exception;
use proto_core::modbus::rtu::{Echo, Exchange, Failure, Operation, Presence, Timing, When};
use proto_core::time::Duration;

use crate::line::{Line, MS, Told, original, read, write};

const FAST: Timing = Timing::new(115_200, 11);

/// Each told value is what its own slave has at its own address.
#[track_caller]
fn values_are_where_they_belong(line: &Line, table: &[Exchange]) {
    for (_, told) in &line.told {
        if let Told::Registers(exchange, words) = told {
            let Operation::ReadHoldingRegisters { address, .. } = table[*exchange].operation else {
                panic!()
            };
            let expected = (address..).take(words.len()).map(|at| original(table[*exchange].slave, at));
            assert!(words.iter().copied().eq(expected), "exchange {exchange}: {words:x?}");
        }
    }
}

#[test]
fn late_replies_are_never_taken_for_those_of_another_exchange() {
    // Two blocks of the same length of one slave: their replies look alike.
    for retries in [0, 1, 2] {
        // Up to twice the timeout, with the time of request and reply.
        for delay in (0..28).map(|step| Duration::from_micros(step * 2_000 + 1_350)) {
            let late = |address| Exchange { retries, ..read(5, address, 4, 40) };
            let table = [late(0), late(100), read(6, 0, 4, 40)];
            let mut line = Line::new(FAST, Echo::Absent, &[5, 6], &table);
            line.run(MS(300));
            line.node(5).delay = delay;
            line.run(MS(8_000));
            values_are_where_they_belong(&line, &table);
            assert!(line.replies(2) > 100, "delay {delay}: the other slave has {} replies", line.replies(2));
        }
    }
}

#[test]
fn a_slow_slave_within_its_timeout_is_fine() {
    let table = [Exchange { timeout: MS(400), ..read(5, 0, 4, 1000) }, read(6, 0, 4, 500)];
    let mut line = Line::new(FAST, Echo::Absent, &[5, 6], &table);
    line.node(5).delay = MS(380);
    line.run(MS(20_500));
    assert_eq!((line.replies(0), line.status(5).counters.timeouts), (21, 0));
    assert_eq!(line.status(6).missed_periods, 0);
    assert_eq!(line.collisions, 0);
}

#[test]
fn a_wrong_crc_is_counted_and_the_request_repeated_at_once() {
    let table = [Exchange { retries: 2, timeout: MS(500), ..read(5, 0, 4, 100) }];
    let mut line = Line::new(FAST, Echo::Absent, &[5], &table);
    line.run(MS(50));
    line.node(5).garble = 2;
    line.run(MS(100));
    let counters = line.status(5).counters;
    assert_eq!((counters.checksums, counters.retries, counters.timeouts), (2, 2, 0));
    assert_eq!(counters.replies, 2, "the third time was right, long before the timeout");

    line.node(5).garble = 3;
    line.run(MS(100));
    assert!(line.told.iter().any(|(_, told)| *told == Told::Failed(0, Failure::Checksum)));
    assert_eq!(line.status(5).presence, Presence::Down);
    line.run(MS(3_000));
    assert_eq!(line.status(5).presence, Presence::Up);
    values_are_where_they_belong(&line, &table);
}

#[test]
fn a_refusal_is_counted_and_not_repeated_and_the_slave_is_up() {
    let table = [Exchange { retries: 3, ..read(5, 190, 20, 100) }];
    let mut line = Line::new(FAST, Echo::Absent, &[5], &table);
    line.run(MS(450));
    let status = line.status(5);
    assert_eq!((status.presence, status.counters.exceptions, status.counters.requests), (Presence::Up, 5, 5));
    assert_eq!(status.counters.newest_exception, Some(Exception::IllegalDataAddress));
    let refused = Failure::Exception(Exception::IllegalDataAddress);
    assert_eq!(line.take_told().last(), Some(&Told::Failed(0, refused)));
    assert_eq!(line.node(5).slave.counters().refused, 5);
}

#[test]
fn a_babbling_slave_leaves_the_line_to_the_others() {
    for babble in [1, 3, 9, 300] {
        let table = [read(5, 0, 4, 100), read(6, 0, 4, 100)];
        let mut line = Line::new(FAST, Echo::Absent, &[5, 6], &table);
        line.node(5).babble = babble;
        line.run(MS(30_000));
        assert_eq!(line.status(5).presence, Presence::Down, "{babble}");
        assert_eq!(line.replies(0), 0);
        assert_eq!(line.status(6).missed_periods, 0, "{babble}");
        assert!(line.replies(1) >= 299, "{babble}: {}", line.replies(1));
        assert!(line.master.stray_bytes() >= babble as u32);
        values_are_where_they_belong(&line, &table);
    }
}

#[test]
fn adapters_that_echo_are_no_slaves() {
    let coil = Exchange {
        slave: 5,
        operation: Operation::WriteCoil { address: 3 },
        when: When::every(MS(50)),
        timeout: MS(30),
        retries: 0,
    };
    let register = Exchange { operation: Operation::WriteRegister { address: 7 }, ..coil };
    let table = [coil, register, write(5, 0, 2, When::every(MS(50))), read(5, 50, 4, 50)];
    let mut line = Line::new(FAST, Echo::Heard, &[5, 6], &table);
    line.values = vec![(0, vec![1]), (1, vec![0x12, 0x34]), (2, vec![0, 1, 0, 2])];
    line.run(MS(1_040));
    for exchange in 0..4 {
        assert_eq!(line.replies(exchange), 21, "exchange {exchange}");
    }
    assert_eq!(line.node(5).bank.words[7], 0x1234);
    assert!(line.node(5).bank.coils[3]);
    let (own, other) = (line.node(5).slave.counters(), line.node(6).slave.counters());
    assert_eq!((own.answered, own.others, own.wrong), (84, 0, 0), "its own echoes are nothing to it");
    assert_eq!((other.others, other.wrong), (168, 0), "{other:?}");
    assert_eq!((line.collisions, line.master.stray_bytes()), (0, 0));
    values_are_where_they_belong(&line, &table);

    line.node(5).alive = false;
    line.run(MS(1_000));
    let before: Vec<usize> = (0..4).map(|exchange| line.replies(exchange)).collect();
    line.run(MS(10_000));
    let after: Vec<usize> = (0..4).map(|exchange| line.replies(exchange)).collect();
    assert_eq!(before, after, "an echo is not a reply");
    assert_eq!(line.status(5).presence, Presence::Down);
}

#[test]
fn each_function_of_a_slave_is_asked_and_answered() {
    let row = |operation| Exchange { slave: 5, operation, when: When::START, timeout: MS(30), retries: 0 };
    let table = [
        Operation::WriteCoils { address: 0, count: 10 },
        Operation::WriteCoil { address: 9 },
        Operation::WriteRegister { address: 0 },
        Operation::WriteRegisters { address: 1, count: 123 },
        Operation::ReadCoils { address: 0, count: 11 },
        Operation::ReadHoldingRegisters { address: 0, count: 125 },
        Operation::ReadInputRegisters { address: 0, count: 1 },
    ]
    .map(row);
    let mut line = Line::new(FAST, Echo::Absent, &[4, 5, 6], &table);
    let registers: Vec<u8> = (1..=123_u16).flat_map(|value| (value * 0x0101).to_be_bytes()).collect();
    line.values = vec![(0, vec![0b1010_1010, 0xFF]), (1, vec![0]), (2, vec![0xAB, 0xCD]), (3, registers)];
    line.run(MS(500));
    assert_eq!(line.collisions, 0);
    let told = line.take_told();
    let told: Vec<&Told> = told.iter().filter(|told| !matches!(told, Told::Sent(_))).collect();
    let coils = [false, true, false, true, false, true, false, true, true, false, false].to_vec();
    let words = [0xABCD].into_iter().chain((1..=123).map(|value| value * 0x0101)).chain([original(5, 124)]);
    assert_eq!(
        told,
        [
            &Told::Written(0),
            &Told::Written(1),
            &Told::Written(2),
            &Told::Written(3),
            &Told::Coils(4, coils),
            &Told::Registers(5, words.collect()),
            &Told::Failed(6, Failure::Exception(Exception::IllegalFunction)),
        ]
    );
    let others = line.node(4).slave.counters();
    assert_eq!((others.others, others.wrong, others.answered), (14, 0, 0));
}
