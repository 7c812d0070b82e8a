//! Templates of `host-sim new` whose devices must be stopped, with these devices.

use std::sync::{Arc, Mutex};

use proto_core::engine::LinkId;
use proto_core::time::Duration;
use recipe_cell::{Cell, Responder};
use recipe_config::file;
use recipe_controller::Link;
use recipe_test_kit::{example, repository};

/// What a slave was asked to write: the address and the values.
type Written = Arc<Mutex<Vec<(u16, Vec<u16>)>>>;

/// The template's gateway, with a slave that answers everything with zeros.
fn with_slave(name: &str, port: &str) -> (Cell, Written) {
    let template = repository().join(format!("host-sim/templates/{name}.toml"));
    let gateway = file::load_gateway(&template, &[]).unwrap();
    let controller = file::load_controller(&example("rs485-system-controller.toml"), &[]).unwrap();
    let mut cell = Cell::new(&gateway, &controller, 3).unwrap();
    let line = cell.line_of(port);
    let written = Written::default();
    let log = Arc::clone(&written);
    cell.attach(line, Responder(move |_, request: &Vec<u8>| answer(request, &log).into_iter().collect()));
    (cell, written)
}

/// The whole frames of the gateway come as one message each.
fn answer(request: &[u8], log: &Written) -> Option<Vec<u8>> {
    let [slave, function, a, b, c, d, .., _, _] = *request else { return None };
    // A damaged one.
    if with_crc(request[..request.len() - 2].to_vec()) != request {
        return None;
    }
    let (address, count) = (u16::from_be_bytes([a, b]), u16::from_be_bytes([c, d]));
    let words = |bytes: &[u8]| bytes.chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect();
    let body = match function {
        3 | 4 => [vec![slave, function, 2 * d], vec![0; 2 * usize::from(count)]].concat(),
        5 | 6 => {
            log.lock().unwrap().push((address, vec![count]));
            request[..6].to_vec()
        }
        16 => {
            log.lock().unwrap().push((address, words(&request[7..request.len() - 2])));
            request[..6].to_vec()
        }
        _ => return None,
    };
    Some(with_crc(body))
}

fn with_crc(mut frame: Vec<u8>) -> Vec<u8> {
    let crc = frame.iter().fold(0xFFFF_u16, |crc, &byte| {
        (0..8).fold(crc ^ u16::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    });
    frame.extend(crc.to_le_bytes());
    frame
}

fn taken(written: &Written) -> Vec<(u16, Vec<u16>)> {
    std::mem::take(&mut written.lock().unwrap())
}

const COMMAND: u16 = 0x2000;
const RUN: u16 = 0x12;
const STOP: u16 = 1;
const NO_FUNCTION: u16 = 0;

/// The drive of delta-ms300, which runs.
fn running() -> (Cell, Written) {
    let (mut cell, written) = with_slave("delta-ms300", "drive");
    cell.set_value("WordOutputReg[2]", 5_000.0);
    cell.set_value("WordOutputReg[1]", STOP.into());
    cell.run_ms(2_000);
    // It is stopped until the robot is found.
    assert_eq!(taken(&written)[0], (COMMAND, vec![STOP]));
    cell.set_value("WordOutputReg[1]", RUN.into());
    cell.run_ms(200);
    assert_eq!(taken(&written), [(COMMAND, vec![RUN, 5_000])]);
    (cell, written)
}

type Fault = fn(&mut Cell);

#[test]
fn the_gateway_stops_a_drive_when_it_has_lost_the_robot() {
    let faults: [(Fault, u64); 4] = [
        (
            |cell| {
                cell.refuse(LinkId::MODBUS);
                cell.reset(LinkId::MODBUS);
            },
            100,
        ),
        // Nobody says so: a request that is not acknowledged does, or three that are not answered.
        (|cell| cell.cut_cable(LinkId::MODBUS), 550),
        (|cell| cell.half_open(LinkId::MODBUS), 550),
        (|cell| cell.controller_mut().mute(Link::Modbus), 1_700),
    ];
    for (nth, (fault, within_ms)) in faults.into_iter().enumerate() {
        let (mut cell, written) = running();
        // Twice, because each loss counts.
        for _ in 0..2 {
            fault(&mut cell);
            cell.run_until(Duration::from_millis(within_ms), |_| !written.lock().unwrap().is_empty());
            assert_eq!(written.lock().unwrap()[..1], [(COMMAND, vec![STOP])], "fault {nth}");
            cell.run_ms(50);
            cell.admit(LinkId::MODBUS);
            cell.repair_cable(LinkId::MODBUS);
            if nth == 3 {
                cell.controller_mut().unmute(Link::Modbus);
            }
            cell.run_ms(10_000);
            // It does not run because the robot is back, but because the robot says so again.
            assert_eq!(taken(&written)[1..], [(COMMAND, vec![NO_FUNCTION])], "fault {nth}");
            cell.set_value("WordOutputReg[1]", STOP.into());
            cell.run_ms(100);
            cell.set_value("WordOutputReg[1]", RUN.into());
            cell.run_ms(100);
            assert_eq!(taken(&written), [(COMMAND, vec![STOP, 5_000]), (COMMAND, vec![RUN, 5_000])]);
        }
    }
}

#[test]
fn a_gateway_that_starts_stops_the_drive_and_then_sends_what_the_robot_says() {
    let (mut cell, written) = running();
    cell.restart_gateway();
    cell.run_ms(3_000);
    let mut words: Vec<_> = taken(&written).into_iter().map(|(_, values)| values).collect();
    // A reply in the first 0.3 s may be an older one's, so the last of the writes that stop is repeated: that is 0.
    words.dedup();
    let run = vec![RUN, 5_000];
    assert_eq!(words, [vec![STOP], vec![NO_FUNCTION], run, vec![NO_FUNCTION]]);
}

#[test]
fn a_drive_does_not_run_with_a_command_of_a_robot_that_is_gone() {
    let (mut cell, written) = running();
    cell.set_value("WordOutputReg[1]", STOP.into());
    cell.run_ms(100);
    taken(&written);
    let line = cell.line_of("drive");
    cell.cut(line);
    cell.run_ms(1_000);
    cell.set_value("WordOutputReg[1]", RUN.into());
    cell.run_ms(1_000);
    cell.cut_cable(LinkId::MODBUS);
    cell.run_ms(5_000);
    cell.repair(line);
    cell.run_ms(10_000);
    let writes = taken(&written);
    assert!(!writes.is_empty() && writes.iter().all(|(_, values)| *values == [STOP]), "{writes:?}");
}

#[test]
fn a_drive_with_a_watchdog_is_asked_often_enough() {
    let (mut cell, _) = running();
    let line = cell.line_of("drive");
    cell.line(line).noise_ppm = 6_000;
    // Some 3 % of the replies are lost.
    let mut requests = Vec::new();
    for _ in 0..600 {
        cell.run_ms(100);
        requests.extend(cell.line(line).take_heard().into_iter().map(|(at, _)| at));
    }
    let longest = requests.windows(2).map(|pair| pair[1].saturating_since(pair[0])).max().unwrap();
    // Pr.09-03 is 1 s.
    assert!(longest < Duration::from_millis(500), "{longest}");
    assert!(cell.port("drive").unanswered >= 3, "{:?}", cell.port("drive"));
}

#[test]
fn a_stop_comes_first_and_cancels_the_motion() {
    for (name, port, motion, stop, wanted) in [
        ("delta-ms300", "drive", 1, 1, (0x2000, 1)),
        ("iai-robo-cylinder", "axis", 2, 3, (0x042C, 0xFF00)),
        ("leadshine-cs2rs", "axis", 0, 1, (0x6002, 0x40)),
        ("onrobot-rg2", "gripper", 0, 1, (2, 8)),
    ] {
        let (mut cell, written) = with_slave(name, port);
        cell.run_ms(2_000);
        taken(&written);
        cell.set_value("BitOutputReg[3]", f64::from(1 << motion | 1 << stop));
        cell.run_ms(2_000);
        assert_eq!(taken(&written), [(wanted.0, vec![wanted.1])], "{name}");
        cell.set_value("BitOutputReg[3]", 0.0);
        cell.run_ms(200);
        assert_eq!(taken(&written), [], "{name}");
        if motion != stop {
            cell.set_value("BitOutputReg[3]", f64::from(1 << motion));
            cell.run_ms(200);
            assert_eq!(taken(&written).len(), 1, "{name}: it can move again");
        }
    }
}
