//! Modbus RTU as a master on a port.

use proto_core::config::*;
use proto_core::engine::{Input, PortState, Rejection};
use proto_core::modbus::rtu::Operation;
use proto_core::time::{Duration, Instant};

use crate::line::*;
use crate::rig::*;

/// One slave whose register 0x10 is read each 20 ms.
fn scale() -> Line {
    let mut cell = Cell::new();
    let weight = reads(&mut cell, 9, &["WordInputReg[1]"], Triggers::every(MS(20)));
    let port = talking(&mut cell, &[weight]);
    cell.safe("WordInputReg[1]", 7.0);
    Line::new(&cell, port)
}

/// Writes 3 to register 1.
fn sets_mode(cell: &mut Cell, slave: u8, when: Triggers) -> Exchange {
    let order = proto_core::device::ByteOrder::Big;
    let word = proto_core::device::Encoding::scalar(proto_core::wire::scalar::ScalarType::Word);
    let written = cell.fields([FieldSpec::DeviceOutput {
        encoding: proto_core::device::Encoding { order, ..word },
        overflow: proto_core::device::Overflow::Usual,
        from: OutputBinding::Constant(3.0),
    }]);
    let operation = Operation::WriteRegister { address: 1 };
    never_late(Exchange::new(slave, Transaction::Rtu { operation, written, read: Span::default() }, when))
}

#[test]
fn a_register_is_read_each_period_and_reaches_the_robot() {
    let mut line = scale();
    let mut weight = 100;
    let asked = line.run(MS(95), |_| {
        weight += 1;
        Some((MS(3), registers(9, &[weight])))
    });
    let request = with_crc(&[9, 3, 0, 0x10, 0, 1]);
    assert!(asked.iter().all(|(_, sent)| *sent == request), "{asked:02X?}");
    assert!(asked.len() >= 4, "{asked:?}");
    let periods: Vec<_> = asked.windows(2).map(|pair| pair[1].0.saturating_since(pair[0].0)).collect();
    assert!(periods.iter().all(|period| *period == MS(20)), "{periods:?}");
    assert_eq!(line.rig.map.registers[8], weight);
    let counters = line.rig.counters(line.port);
    assert_eq!((counters.frames_in, counters.frames_out), (asked.len() as u32, asked.len() as u32));
}

#[test]
fn a_wrong_crc_never_reaches_the_robot_and_is_asked_again() {
    let mut line = scale();
    line.run(MS(30), |_| Some((MS(3), registers(9, &[5]))));
    line.rig.take_written();
    let mut nth = 0;
    let asked = line.run(MS(70), |_| {
        nth += 1;
        let mut reply = registers(9, &[6]);
        reply[4] ^= u8::from(nth == 1) * 0x40;
        Some((MS(3), reply))
    });
    let written = line.rig.take_written();
    assert!(written.len() > 1 && written.iter().all(|written| *written == Written::Registers(8, vec![6])));
    let counters = line.rig.counters(line.port);
    assert_eq!((counters.rejected_checksum, counters.unanswered), (1, 0));
    let again = asked[1].0.saturating_since(asked[0].0);
    assert!(again < MS(4), "behind the silence, long before the timeout: {again:?}");
}

#[test]
fn a_slave_that_falls_silent_gets_its_safe_value_to_the_robot_and_is_asked_less() {
    let mut line = scale();
    line.run(MS(45), |_| Some((MS(3), registers(9, &[5]))));
    assert_eq!(line.rig.map.registers[8], 5);
    let asked = line.run(MS(3_000), |_| None);
    assert_eq!(line.rig.map.registers[8], 7);
    assert_eq!(line.rig.engine.port_state(line.port), Some(PortState::Silent));
    assert!((2..12).contains(&asked.len()), "{}", asked.len());
    assert!(line.rig.counters(line.port).unanswered >= 2);
    line.run(MS(8_000), |_| Some((MS(3), registers(9, &[8]))));
    assert_eq!(
        (line.rig.map.registers[8], line.rig.engine.port_state(line.port)),
        (8, Some(PortState::Working))
    );
}

#[test]
fn a_refusal_is_told_and_the_line_goes_on() {
    let mut line = scale();
    let asked = line.run(MS(70), |_| Some((MS(2), with_crc(&[9, 0x83, 2]))));
    assert!(asked.len() >= 3);
    let now = line.rig.now;
    let status = line.rig.engine.status(now).ports().next().unwrap();
    let last = status.last_rejection.unwrap();
    assert_eq!((last.why, last.bytes()), (Rejection::Refused, &with_crc(&[9, 0x83, 2])[..]));
    let peer = status.peers().next().unwrap();
    assert_eq!((peer.number, peer.counters.refusal), (9, 2));
    assert_eq!(peer.counters.refused, asked.len() as u32);
    assert_eq!(line.rig.take_written(), []);
}

#[test]
fn a_changed_value_is_written_once_and_not_before_it_is_known() {
    let mut cell = Cell::new();
    let when = Triggers { change: true, ..Triggers::NEVER };
    let speed = writes(&mut cell, 3, &["WordOutputReg[1]"], when);
    let port = talking(&mut cell, &[speed]);
    let mut line = Line::new(&cell, port);
    line.rig.modbus_answers = false;
    let done = |request: &[u8]| Some((MS(2), with_crc(&request[..6])));
    assert_eq!(line.run(MS(100), done), []);
    line.rig.modbus_answers = true;
    line.rig.map.registers[40] = 0x1234;
    let address = {
        let place = var("WordOutputReg[1]").modbus().unwrap();
        let proto_core::sysvar::ModbusPlace::Register { address } = place else { panic!() };
        usize::from(address)
    };
    line.rig.map.registers[address] = 0x1234;
    let asked = line.run(MS(6_000), done);
    let value = |sent: &[u8]| u16::from_be_bytes([sent[7], sent[8]]);
    assert_eq!(asked.iter().map(|(_, sent)| value(sent)).collect::<Vec<_>>(), [0x1234]);
    line.rig.map.registers[address] = 0x1235;
    let asked = line.run(MS(1_000), done);
    assert_eq!(asked.iter().map(|(_, sent)| value(sent)).collect::<Vec<_>>(), [0x1235]);
    // A slave that refuses to answer is asked until it has the value.
    line.rig.map.registers[address] = 0x1236;
    let asked = line.run(MS(1_000), |_| None);
    assert!(asked.len() >= 2);
    let asked = line.run(MS(10_000), done);
    assert_eq!(asked.iter().map(|(_, sent)| value(sent)).collect::<Vec<_>>(), [0x1236]);
}

#[test]
fn what_is_asked_at_the_start_is_asked_again_when_the_slave_or_the_port_is_back() {
    let mut cell = Cell::new();
    let mode = sets_mode(&mut cell, 4, Triggers { start: true, ..Triggers::NEVER });
    let poll = reads(&mut cell, 4, &["WordInputReg[1]"], Triggers::every(MS(50)));
    let port = talking(&mut cell, &[mode, poll]);
    let mut line = Line::new(&cell, port);
    let setting = with_crc(&[4, 6, 0, 1, 0, 3]);
    let done = |request: &[u8]| {
        let reply = if request[1] == 6 { request.to_vec() } else { registers(4, &[1]) };
        Some((MS(2), reply))
    };
    let count = |asked: &[(Instant, Vec<u8>)]| asked.iter().filter(|(_, sent)| *sent == setting).count();
    line.rig.log.clear();
    line.rig.input(Input::PortDown { port });
    line.rig.input(Input::PortUp { port });
    assert_eq!(count(&line.run(MS(500), done)), 1);
    assert_eq!(line.rig.engine.port_state(port), Some(PortState::Working));
    line.run(MS(2_900), |_| None);
    assert_eq!(
        count(&line.run(MS(8_000), done)),
        0,
        "replies were lost, it may have been there all the time"
    );
    let polls = |request: &[u8]| if request[1] == 6 { None } else { done(request) };
    line.rig.input(Input::PortDown { port });
    line.rig.input(Input::PortUp { port });
    assert_eq!(count(&line.run(MS(8_000), polls)), 1, "it may have been carried out");
    line.run(MS(6_000), |_| None);
    assert_eq!(count(&line.run(MS(8_000), done)), 1, "the slave is back");
    line.rig.input(Input::PortDown { port });
    assert_eq!(line.run(MS(500), done), []);
    line.rig.input(Input::PortUp { port });
    assert_eq!(count(&line.run(MS(500), done)), 1, "the port is back");
}

#[test]
fn eight_slaves_of_which_two_are_dead_keep_their_periods() {
    let mut cell = Cell::new();
    let periods = [20, 20, 50, 50, 100, 100, 200, 500];
    let exchanges: Vec<_> = (1..=8)
        .zip(periods)
        .map(|(slave, every)| {
            let name = format!("WordInputReg[{slave}]");
            let poll = reads(&mut cell, slave, &[&name], Triggers::every(MS(every)));
            Exchange { timeout: MS(10), retries: 0, ..poll }
        })
        .collect();
    let port = talking(&mut cell, &exchanges);
    cell.last_port().timeout = MS(1_500);
    let mut line = Line::new(&cell, port);
    let is_dead = |slave: u8| slave == 2 || slave == 5;
    let answer = |request: &[u8]| {
        let slave = request[0];
        // 8 characters to the slave and 7 back at 115 200 bit/s are 1.4 ms.
        (!is_dead(slave)).then(|| (Duration::from_micros(1_400), registers(slave, &[slave.into()])))
    };
    line.run(MS(2_000), answer);
    let asked = line.run(MS(20_000), answer);
    for (slave, every) in (1..=8).zip(periods) {
        let times: Vec<_> = asked.iter().filter(|(_, sent)| sent[0] == slave).map(|(at, _)| *at).collect();
        if is_dead(slave) {
            assert!((10..60).contains(&times.len()), "slave {slave}: {}", times.len());
            continue;
        }
        let wanted = 20_000 / every as usize;
        assert!((wanted - 1..=wanted + 1).contains(&times.len()), "slave {slave}: {}", times.len());
        let late = times.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap();
        assert!(late < MS(every + 12), "slave {slave}: {late:?}");
        assert_eq!(line.rig.map.registers[7 + usize::from(slave)], slave.into());
    }
    let now = line.rig.now;
    let status = line.rig.engine.status(now).ports().next().unwrap();
    assert_eq!(status.state, PortState::Silent, "two of them are");
    for peer in status.peers() {
        assert_eq!(peer.missed_periods, 0, "slave {}", peer.number);
    }
}

#[test]
fn the_echo_of_a_request_is_no_reply() {
    let mut cell = Cell::new();
    let when = Triggers { start: true, ..Triggers::NEVER };
    let mut write = reads(&mut cell, 3, &["WordInputReg[1]"], when);
    write.when = Triggers::every(MS(20));
    let port = talking(&mut cell, &[write]);
    let Bus::Rs485(settings) = &mut cell.last_port().bus else { panic!() };
    settings.echo = Echo::Yes;
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(95), |request| {
        let mut heard = request.to_vec();
        heard.extend(registers(3, &[77]));
        Some((MS(3), heard))
    });
    let counters = line.rig.counters(line.port);
    assert_eq!((counters.frames_in, counters.resync_bytes), (asked.len() as u32, 0));
    assert_eq!(line.rig.map.registers[8], 77);
}

#[test]
fn a_late_reply_is_not_taken_for_another_exchange() {
    // Two blocks of one slave whose replies look alike.
    let mut cell = Cell::new();
    let late = |cell: &mut Cell, name, address| {
        let mut exchange = reads(cell, 5, &[name], Triggers::every(MS(40)));
        let Transaction::Rtu { operation, .. } = &mut exchange.transaction else { panic!() };
        *operation = Operation::ReadHoldingRegisters { address, count: 1 };
        Exchange { timeout: MS(30), late: None, ..exchange }
    };
    let table = [late(&mut cell, "WordInputReg[1]", 1), late(&mut cell, "WordInputReg[2]", 2)];
    let port = talking(&mut cell, &table);
    for delay in (1..28).map(|step| MS(step * 2)) {
        let mut line = Line::new(&cell, port);
        let answer =
            |delay| move |request: &[u8]| Some((delay, registers(5, &[u16::from(request[3]) + 100])));
        line.run(MS(300), answer(MS(1)));
        line.rig.take_written();
        line.run(MS(4_005), |request| answer(delay)(request));
        for written in line.rig.take_written() {
            let Written::Registers(address, words) = written else { panic!() };
            for (at, word) in (address..).zip(words) {
                assert_eq!(word, at - 7 + 100, "delay {delay:?}");
            }
        }
    }
}

#[test]
fn what_was_asked_before_the_start_may_be_answered_before_anything_is_asked() {
    let mut cell = Cell::new();
    let table = [1, 2].map(|address| {
        let name = format!("WordInputReg[{address}]");
        let mut exchange = reads(&mut cell, 5, &[&name], Triggers::every(MS(40)));
        let Transaction::Rtu { operation, .. } = &mut exchange.transaction else { panic!() };
        *operation = Operation::ReadHoldingRegisters { address, count: 1 };
        Exchange { timeout: MS(30), late: None, ..exchange }
    });
    let port = talking(&mut cell, &table);
    for delay in [1, 29, 400, 998] {
        let mut line = Line::new(&cell, port);
        let begin = line.rig.now;
        // A gateway before this one had asked for the second register.
        line.comes(MS(delay), &registers(5, &[102]));
        let asked =
            line.run(MS(1_300), |request| Some((MS(29), registers(5, &[u16::from(request[3]) + 100]))));
        let first = asked[0].0.saturating_since(begin);
        assert!((DEFAULT_LATE - MS(1)..DEFAULT_LATE + MS(5)).contains(&first), "{first}");
        for written in line.rig.take_written() {
            let Written::Registers(address, words) = written else { panic!() };
            for (at, word) in (address..).zip(words) {
                assert_eq!(word, at - 7 + 100, "at a delay of {delay} ms");
            }
        }
        assert_eq!(line.rig.map.registers[8..10], [101, 102], "at a delay of {delay} ms");
    }
}

#[test]
fn a_late_reply_that_comes_while_the_request_is_repeated_holds_others_back_too() {
    replies_come_late(None);
}

#[test]
fn a_late_reply_behind_noise_holds_others_back_too() {
    // The noise reads as a reply with a wrong checksum, so the request is repeated before its reply comes.
    let mut noise = registers(5, &[1]);
    noise[3] ^= 0x40;
    replies_come_late(Some(noise));
}

/// Two blocks of one slave whose replies look alike come late, behind what else comes.
fn replies_come_late(noise: Option<Vec<u8>>) {
    let mut cell = Cell::new();
    let mut table = [1, 2].map(|address| {
        let name = format!("WordInputReg[{address}]");
        let mut exchange = reads(&mut cell, 5, &[&name], Triggers::every(MS(40)));
        let Transaction::Rtu { operation, .. } = &mut exchange.transaction else { panic!() };
        *operation = Operation::ReadHoldingRegisters { address, count: 1 };
        exchange
    });
    table.iter_mut().for_each(|exchange| (exchange.timeout, exchange.late) = (MS(30), None));
    let port = talking(&mut cell, &table);
    let variables = ["WordInputReg[1]", "WordInputReg[2]"].map(var);
    for delay in (1..55).step_by(2) {
        let mut rig = cell.rig();
        rig.reports_sent = false;
        // Requests take 5 ms to leave. Until the first change the slave is prompt.
        let (begin, mut coming, mut nth) = (rig.now, Vec::new(), 0);
        while rig.now < begin + MS(1_500) {
            for request in rig.sent_to(port) {
                let left = rig.now + MS(5);
                let delay = if rig.now < begin + MS(300) { 1 } else { delay };
                coming.push((left, None));
                // Not each time, so that the slave stays there.
                if let Some(noise) = noise.as_ref().filter(|_| delay > 1 && nth % 3 == 0) {
                    coming.push((left + MS(1), Some(noise.clone())));
                }
                nth += 1;
                coming.push((left + MS(delay), Some(registers(5, &[u16::from(request[3]) + 100]))));
            }
            coming.sort_by_key(|(at, _)| *at);
            let next = coming.first().map_or(Instant::NEVER, |(at, _)| *at);
            rig.now = rig.now.max(next.min(rig.wake));
            if next > rig.now {
                rig.input(Input::Tick);
                continue;
            }
            let values = variables.map(|var| rig.engine.image().value(var));
            for (value, right) in values.into_iter().zip([101.0, 102.0]) {
                assert!([0.0, right].contains(&value.as_f64()), "{value} at a delay of {delay} ms");
            }
            match coming.remove(0).1 {
                None => rig.input(Input::PortSent { port }),
                Some(reply) => rig.bytes(port, &reply),
            }
        }
    }
}

#[test]
fn a_reply_is_not_taken_for_another_exchange_when_the_repetition_cannot_be_made() {
    // Two blocks of one slave whose replies look alike. The first request shows a value of the controller.
    let mut cell = Cell::new();
    let exchange = |cell: &mut Cell, shown, to, address| {
        let poll = reads(cell, 5, &[to], Triggers::every(MS(40)));
        let Transaction::Rtu { read, .. } = poll.transaction else { panic!() };
        let Transaction::Rtu { written, .. } = shown else { panic!() };
        let (read_address, write_address) = (address, address + 0x20);
        let operation =
            Operation::ReadWriteRegisters { read_address, read_count: 1, write_address, write_count: 1 };
        Exchange {
            timeout: MS(30),
            late: None,
            retries: 3,
            transaction: Transaction::Rtu { operation, written, read },
            ..poll
        }
    };
    let shown = writes(&mut cell, 5, &["WordOutputReg[1]"], Triggers::NEVER).transaction;
    let constant = sets_mode(&mut cell, 5, Triggers::NEVER).transaction;
    let table = [
        exchange(&mut cell, shown, "WordInputReg[1]", 1),
        exchange(&mut cell, constant, "WordInputReg[2]", 2),
    ];
    let port = talking(&mut cell, &table);
    cell.last_recipe().on_stale = OnStale::Stop;
    cell.last_port().stale_after = MS(100);
    let answer = |delay: Duration| {
        move |request: &[u8]| {
            let reply = [&[5, 23, 2], &(u16::from(request[3]) + 100).to_be_bytes()[..]].concat();
            Some((delay, with_crc(&reply)))
        }
    };
    let mut given_up = 0;
    for delay in (31..59).step_by(3) {
        for offset in (0..40).step_by(5) {
            let mut line = Line::new(&cell, port);
            line.run(MS(1_500 + offset), answer(MS(1)));
            // The controller falls silent, and then the slave is late.
            line.rig.modbus_answers = false;
            line.run(MS(70), answer(MS(1)));
            for _ in 0..200 {
                line.run(MS(1), answer(MS(delay)));
                let values = ["WordInputReg[1]", "WordInputReg[2]"]
                    .map(|name| line.rig.engine.image().value(var(name)).as_f64());
                assert_eq!(values, [101.0, 102.0], "{delay} ms, {offset} ms");
            }
            given_up += line.rig.counters(port).unanswered;
        }
    }
    assert!(given_up > 0, "a request that is not repeated is one without a reply");
}

#[test]
fn nothing_is_sent_for_a_while_after_a_request_to_all() {
    let mut cell = Cell::new();
    let shift = sets_mode(&mut cell, 0, Triggers::every(MS(300)));
    let poll = reads(&mut cell, 4, &["WordInputReg[1]"], Triggers::every(MS(20)));
    let port = talking(&mut cell, &[shift, poll]);
    let mut line = Line::new(&cell, port);
    let asked = line.run(MS(2_000), |request| (request[0] == 4).then(|| (MS(2), registers(4, &[1]))));
    let rests: Vec<Duration> = asked
        .windows(2)
        .filter(|pair| pair[0].1[0] == 0)
        .map(|pair| pair[1].0.saturating_since(pair[0].0))
        .collect();
    assert!(rests.len() > 5 && rests.iter().all(|rest| (MS(100)..MS(102)).contains(rest)), "{rests:?}");
}

#[test]
fn a_value_that_is_asked_once_is_not_missed_later() {
    let mut cell = Cell::new();
    let start = Triggers { start: true, ..Triggers::NEVER };
    let version = reads(&mut cell, 4, &["WordInputReg[1]"], start);
    let port = talking(&mut cell, &[version]);
    let mut line = Line::new(&cell, port);
    assert_eq!(line.run(MS(1_000), |_| Some((MS(2), registers(4, &[3])))).len(), 1);
    assert_eq!(line.rig.map.registers[8], 3);
    assert_eq!(line.rig.engine.port_state(port), Some(PortState::Working));
    // If the slave is not there, the port says so.
    line.rig.input(Input::PortDown { port });
    line.rig.input(Input::PortUp { port });
    line.run(MS(1_000), |_| None);
    assert_eq!(line.rig.engine.port_state(port), Some(PortState::Silent));
}

#[test]
fn what_a_slave_is_asked_at_its_start_comes_first_and_in_order() {
    let mut cell = Cell::new();
    let start = Triggers { start: true, ..Triggers::NEVER };
    let at_start = |cell: &mut Cell, name, address| {
        let mut exchange = reads(cell, 4, &[name], start);
        let Transaction::Rtu { operation, .. } = &mut exchange.transaction else { panic!() };
        *operation = Operation::ReadHoldingRegisters { address, count: 1 };
        exchange
    };
    let command = writes(&mut cell, 4, &["WordOutputReg[1]"], Triggers { change: true, ..start });
    let poll = reads(&mut cell, 4, &["WordInputReg[1]"], Triggers::every(MS(5)));
    let table = [
        poll,
        at_start(&mut cell, "WordInputReg[2]", 0xA0),
        at_start(&mut cell, "WordInputReg[3]", 0xA1),
        command,
        // Another slave is not held up.
        reads(&mut cell, 5, &["WordInputReg[4]"], Triggers::every(MS(50))),
    ];
    let port = talking(&mut cell, &table);
    (cell.last_port().timeout, cell.last_port().absent) = (MS(500), MS(500));
    let mut line = Line::new(&cell, port);
    let done = |request: &[u8]| {
        let reply = if request[1] == 16 { with_crc(&request[..6]) } else { registers(request[0], &[1]) };
        Some((MS(1), reply))
    };
    let places = |asked: &[(Instant, Vec<u8>)]| -> Vec<u8> {
        asked.iter().filter(|(_, sent)| sent[0] == 4).map(|(_, sent)| sent[3]).collect()
    };
    // While its first question is not answered it is asked nothing else, the other slave is.
    let asked = line.run(MS(2_000), |request| if request[0] == 4 { None } else { done(request) });
    assert!(places(&asked).iter().all(|place| *place == 0xA0), "{asked:02X?}");
    assert!(asked.iter().filter(|(_, sent)| sent[0] == 5).count() > 20);
    for round in 0..4 {
        let asked = places(&line.run(MS(12_000), done));
        // What found it again may have been another question.
        let start = asked.iter().position(|place| *place == 0xA0).unwrap();
        assert!(start <= 1, "round {round}: {asked:02X?}");
        let first = asked.iter().position(|place| *place == 0xA1).unwrap();
        assert!(asked[start..first].iter().all(|place| *place == 0xA0), "round {round}: {asked:02X?}");
        assert_eq!((asked[first + 1], asked.len() > 1_000), (0x20, true), "the command, then polls");
        // It is away, and comes back at another moment in each round.
        line.run(MS(1_500 + round * 333), |request| if request[0] == 4 { None } else { done(request) });
    }
}

#[test]
fn what_is_asked_at_the_start_waits_until_its_values_are_fresh() {
    let start = Triggers { start: true, ..Triggers::NEVER };
    for when in [start, Triggers { change: true, ..start }] {
        let mut cell = Cell::new();
        let lamp = writes(&mut cell, 4, &["WordOutputReg[1]"], when);
        let poll = reads(&mut cell, 4, &["WordInputReg[1]"], Triggers::every(MS(50)));
        let port = talking(&mut cell, &[lamp, poll]);
        cell.last_recipe().on_stale = OnStale::Stop;
        cell.last_port().stale_after = MS(200);
        cell.last_port().absent = MS(500);
        let mut line = Line::new(&cell, port);
        let done = |request: &[u8]| {
            let reply = if request[1] == 16 { with_crc(&request[..6]) } else { registers(4, &[1]) };
            Some((MS(1), reply))
        };
        let count = |asked: &[(Instant, Vec<u8>)]| asked.iter().filter(|(_, sent)| sent[1] == 16).count();
        assert_eq!(count(&line.run(MS(3_000), done)), 1);
        // The slave loses its power, and the controller falls silent before the slave is back.
        line.run(MS(400), |_| None);
        line.rig.modbus_answers = false;
        line.run(MS(600), |_| None);
        assert_eq!(count(&line.run(MS(3_000), done)), 0, "its value is stale");
        line.rig.modbus_answers = true;
        assert_eq!(count(&line.run(MS(8_000), done)), 1, "the same value as before");
    }
}

#[test]
fn a_slow_slave_that_is_dead_does_not_hide_a_fast_one() {
    let mut cell = Cell::new();
    let rows: Vec<_> = [(1, 5, 8), (2, 10, 50), (3, 400, 50)]
        .into_iter()
        .map(|(slave, timeout, every)| {
            let poll =
                reads(&mut cell, slave, &[&format!("WordInputReg[{slave}]")], Triggers::every(MS(every)));
            Exchange { timeout: MS(timeout), retries: 0, ..poll }
        })
        .collect();
    let port = talking(&mut cell, &rows);
    let mut line = Line::new(&cell, port);
    // There is no gap in which a timeout of the dead ones fits.
    let answer = |request: &[u8]| (request[0] == 1).then(|| (MS(1), registers(1, &[1])));
    line.run(MS(60_000), answer);
    let asked = line.run(MS(60_000), answer);
    let times: Vec<_> = asked.iter().filter(|(_, sent)| sent[0] == 2).map(|(at, _)| *at).collect();
    let waits = times.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap();
    // It waits for 64 timeouts, and as long again for a gap; the other's timeout may come between.
    assert!(waits < MS(2 * 640 + 500), "{waits:?}");
}
