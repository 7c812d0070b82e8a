//! The worked examples and the example devices through the gateway, byte for byte: from a device's bytes
//! to the simulated controller's registers and back.

use proto_core::config::Bus;
use proto_core::engine::{LinkId, PortId, ReplyCode};
use proto_core::time::Duration;
use recipe_cell::{Cell, PeriodicSender, What};

use crate::kit::*;

/// A frame of floats with the output head and tail of the worked examples.
fn pose_frame(cell: &Cell, names: &[&str]) -> Vec<u8> {
    let floats = names.iter().flat_map(|name| (cell.value(name) as f32).to_le_bytes());
    [0xFF, 0xFF].into_iter().chain(floats).chain([0xFE, 0xFE]).collect()
}

const POSE: [&str; 6] = [
    "RobotState[8]",
    "RobotState[9]",
    "RobotState[10]",
    "RobotState[11]",
    "RobotState[12]",
    "RobotState[13]",
];

#[test]
fn example_1_three_bytes_and_the_answer() {
    let mut cell = cell("rs485-user");
    let line = cell.line_of("rs485-1");
    assert_eq!(heard(&mut cell, line), Vec::<Vec<u8>>::new(), "nothing is sent before a frame came");
    cell.send(line, &[0xFF, 0xFF, 0x01, 0x02, 0x03, 0xEE, 0xEE]);
    cell.run_ms(20);
    let registers = [1, 2, 3, 4].map(|n| cell.value(&format!("WordInputReg[{n}]")));
    assert_eq!(registers, [1.0, 2.0, 3.0, 0.0]);
    assert_eq!(heard(&mut cell, line), [[0xFF, 0xFF, 0x7D, 0x7D, 0x7D, 0xFE, 0xFE]]);
    cell.run_ms(500);
    assert_eq!(heard(&mut cell, line), Vec::<Vec<u8>>::new());
}

#[test]
fn example_2_the_pose_each_cycle_and_an_output() {
    let mut cell = cell("rs485-system");
    let line = cell.line_of("rs485-1");
    cell.line(line).take_heard();
    cell.run_ms(400);
    let frame = pose_frame(&cell, &POSE[..4]);
    assert_ne!(frame[2..18], [0; 16], "the arm stands somewhere");
    let frames = cell.line(line).take_heard();
    assert_eq!(frames.len(), 100, "one each 4 ms");
    assert!(frames.iter().all(|(_, bytes)| *bytes == frame));
    for pair in frames.windows(2) {
        assert_eq!(pair[1].0.saturating_since(pair[0].0), Duration::from_millis(4));
    }
    assert_eq!(cell.value("DO[1]"), 0.0);
    cell.send(line, &outputs(1));
    cell.run_ms(5);
    assert_eq!(cell.value("DO[1]"), 1.0);
    assert_eq!(cell.controller().counters().modbus.refusals, 0);
    outputs_get_through(&mut cell, line);
    assert_eq!(cell.port("rs485-1").skipped_cycles, 0);
}

#[test]
fn example_3_a_can_frame_and_the_answer() {
    let mut cell = cell("can-user");
    let bus = cell.bus_of("can-1");
    cell.send_can(bus, can(1, &[1, 2, 3]));
    cell.run_ms(20);
    let registers = [1, 2, 3].map(|n| cell.value(&format!("WordInputReg[{n}]")));
    assert_eq!(registers, [1.0, 2.0, 3.0]);
    let frames: Vec<_> = cell.bus(bus).take_heard().into_iter().map(|(_, frame)| frame).collect();
    assert_eq!(frames, [can(2, &[0x7D, 0x7D, 0x7D])]);
}

#[test]
fn example_4_the_pose_in_three_frames_and_an_output() {
    let mut cell = cell("can-system");
    let bus = cell.bus_of("can-1");
    // Until the bus is idle between two cycles.
    cell.run_ms(2);
    cell.bus(bus).take_heard();
    cell.run_ms(40);
    let frames: Vec<_> = cell.bus(bus).take_heard().into_iter().map(|(_, frame)| frame).collect();
    assert_eq!(frames.len(), 30, "three each 4 ms");
    // The captured frame.
    assert_eq!(frames[0], can(2, &[0xEF, 0x54, 0xEF, 0x3E, 0xA7, 0xE7, 0xD1, 0x3E]));
    let data = |pair: [&str; 2]| pair.map(|name| (cell.value(name) as f32).to_le_bytes()).concat();
    assert_eq!(frames[1], can(3, &data([POSE[2], POSE[3]])));
    assert_eq!(frames[2], can(4, &data([POSE[4], POSE[5]])));
    assert!(frames.chunks(3).all(|cycle| cycle == &frames[..3]));
    cell.send_can(bus, can(1, &[1]));
    cell.run_ms(5);
    assert_eq!(cell.value("DO[1]"), 1.0);
}

#[test]
fn example_5_udp_carries_both_ways() {
    let mut cell = cell("udp-server");
    let line = cell.line_of("rs485-1");
    cell.line(line).take_heard();
    cell.run_ms(40);
    let capture = [
        0xFF, 0xFF, 0x39, 0x2F, 0x0B, 0xBF, 0x86, 0x87, 0x13, 0x3F, 0xBF, 0xBD, 0x9D, 0x3F, 0x37, 0xFC, 0xC8,
        0xBF, 0x17, 0xA0, 0x1B, 0xBF, 0x59, 0xFC, 0xEA, 0xBE, 0xFE, 0xFE,
    ];
    let frames = heard(&mut cell, line);
    assert_eq!(frames.len(), 10);
    assert!(frames.iter().all(|frame| frame[..] == capture), "{:02x?}", frames[0]);
    outputs_get_through(&mut cell, line);
    cell.run_ms(500);
    let at_controller = cell.controller().counters().ports["udp2011"];
    assert_eq!(at_controller.frames_in, 3, "each field frame is one datagram");
    let link = cell.link(LinkId::RECIPE_UDP).counters;
    assert_eq!(u64::from(link.received), at_controller.frames_out);
    assert_eq!((link.sent, link.malformed), (3, 0));
    assert!(cell.link_ids().all(|link| link != LinkId::MODBUS), "Modbus is not needed");
}

#[test]
fn example_6_the_controllers_tcp_client_connects_and_comes_back() {
    let mut cell = cell("client");
    let line = cell.line_of("rs485-1");
    let link = LinkId::of_port(PortId(0));
    for lost in 0..3 {
        cell.line(line).take_heard();
        cell.run_ms(40);
        let frame = pose_frame(&cell, &POSE);
        let frames = heard(&mut cell, line);
        assert_eq!(frames.len(), 10);
        assert!(frames.iter().all(|bytes| *bytes == frame));
        outputs_get_through(&mut cell, line);
        let history = cell.link(link).history;
        assert_eq!((history.connects, history.losses), (lost + 1, lost));
        match lost {
            0 => cell.reset(link),
            _ => cell.controller_mut().close_port(0),
        }
        cell.run_ms(700);
    }
    assert_eq!(cell.controller().counters().ports["tcp1"].frames_in, 9);
}

#[test]
fn example_6_the_same_over_the_controllers_udp_client() {
    let (mut gateway, controller) = files("client");
    gateway.ports[0].bus = Bus::UdpListen { listen: "127.0.0.1:50001".try_into().unwrap() };
    let mut cell = Cell::new(&gateway, &controller, 1).unwrap();
    cell.run_ms(500);
    let line = cell.line_of("rs485-1");
    cell.line(line).take_heard();
    cell.run_ms(40);
    let frame = pose_frame(&cell, &POSE);
    assert_eq!(heard(&mut cell, line), vec![frame; 10]);
    outputs_get_through(&mut cell, line);
    assert_eq!(cell.controller().counters().ports["udp1"].frames_in, 3);
}

#[test]
fn the_force_sensor_at_960_frames_a_second_loses_nothing_in_ten_seconds() {
    const FRAMES: u64 = 9_600;
    let values = |n: u64| std::array::from_fn(|axis| n as f32 * 0.25 - 100.0 * axis as f32);
    let mut cell = cell("force-sensor");
    let line = cell.line_of("force");
    let before = cell.controller().counters().ports["udp2011"];
    let sent_before = cell.link(LinkId::RECIPE_UDP).counters.sent;
    cell.keep_trace(200_000);
    let start = cell.now();
    cell.attach(line, PeriodicSender::new(start, 960, FRAMES, move |n| force_frame(values(n))));
    cell.run(Duration::from_secs(10) + Duration::from_millis(5));

    let on_the_line = cell.line(line).time_of(28);
    let device = cell.line(line).counters;
    let field = *cell.port("force");
    let link = cell.link(LinkId::RECIPE_UDP);
    let controller = cell.controller().counters().ports["udp2011"];
    assert_eq!((device.device_sent, device.device_bytes), (FRAMES, FRAMES * 28));
    assert_eq!((u64::from(field.frames_in), u64::from(field.bytes_in)), (FRAMES, FRAMES * 28));
    assert_eq!(u64::from(link.counters.sent - sent_before), FRAMES);
    assert_eq!(controller.frames_in - before.frames_in, FRAMES);
    assert_eq!(u64::from(link.counters.received), controller.frames_out);
    let refused = [field.resync_bytes, field.tail_mismatches, field.discarded_bytes, field.undelivered];
    assert_eq!((refused, field.withheld, field.values_expired), ([0; 4], 0, 0));
    assert_eq!((controller.rejected_values, controller.wrong_datagrams), (0, before.wrong_datagrams));

    // Each frame arrived unchanged, in order, and within a millisecond of its last byte.
    let arrived: Vec<_> =
        cell.trace().entries().iter().filter(|entry| entry.what == What::ControllerReceived).collect();
    let frames: Vec<_> = arrived.iter().filter(|entry| entry.bytes.len() == 28).collect();
    assert_eq!(frames.len() as u64, FRAMES);
    for (n, entry) in (0..).zip(frames) {
        let sent = force_frame(values(n));
        assert_eq!(entry.bytes[..2], [255, 255]);
        assert_eq!(entry.bytes[2..26], sent[2..26], "frame {n}");
        let began = start + Duration::from_micros(n * 1_000_000 / 960);
        assert!(entry.at.saturating_since(began + on_the_line) <= Duration::from_millis(1));
    }

    // The sensor falls silent: its forces are set to 0, once.
    assert_eq!(force(&cell), values(FRAMES - 1));
    cell.run_ms(50);
    assert_eq!(force(&cell), [0.0; 6]);
    assert_eq!(cell.port("force").timeouts, 1);
}

#[test]
fn the_hand_moves_reports_and_is_missed() {
    let mut cell = cell("can-hand");
    let bus = cell.bus_of("hand");
    assert_eq!(cell.send_command("run(grip.jspf)"), "run start");
    cell.run_ms(300);
    cell.bus(bus).take_heard();
    cell.attach_can(bus, PeriodicSender::new(cell.now(), 50, 25, |n| can(0x502, &[2, 0, n as u8, 1])));
    cell.run_ms(499);
    let frames = cell.bus(bus).take_heard();
    assert!((24..=25).contains(&frames.len()), "one each 20 ms: {}", frames.len());
    assert!(frames.iter().all(|(_, frame)| *frame == can(0x501, &[200; 6])));
    let state = ["WordInputReg[1]", "WordInputReg[2]", "WordInputReg[3]"].map(|name| cell.value(name));
    assert_eq!(state, [2.0, 0.0, f64::from(0x118)]);
    cell.run_ms(300);
    let state = ["WordInputReg[1]", "WordInputReg[3]"].map(|name| cell.value(name));
    assert_eq!(state, [0.0, f64::from(0x118)], "the hand is not there; what it said last is held");
    assert_eq!(cell.port("hand").timeouts, 1);
    // The fingers follow the registers within one poll and one cycle.
    cell.bus(bus).take_heard();
    cell.set_value("WordOutputReg[3]", 17.0);
    cell.run_ms(60);
    let frames = cell.bus(bus).take_heard();
    assert_eq!(frames.last().unwrap().1, can(0x501, &[200, 200, 17, 200, 200, 200]));
}

/// The station's request.
fn order(order: u8, part: u16) -> Vec<u8> {
    let [low, high] = part.to_le_bytes();
    vec![0xFF, 0xFF, order, low, high, 0xEE, 0xEE]
}

/// Sends a request and returns the answer's code and busy bits.
#[track_caller]
fn send_command(cell: &mut Cell, request: &[u8]) -> (u8, u8) {
    let line = cell.line_of("station");
    cell.line(line).take_heard();
    cell.send(line, request);
    cell.run_ms(60);
    let answers = heard(cell, line);
    assert_eq!(answers.len(), 1, "one answer a request: {answers:02x?}");
    let [0xFF, 0xFF, _, code, busy, 0xFE, 0xFE] = answers[0][..] else { panic!("{answers:02x?}") };
    (code, busy)
}

#[test]
fn a_station_starts_programs_and_reads_the_reply_code() {
    let code = |code: ReplyCode| code as u8;
    let mut cell = cell("request-response");
    assert_eq!(send_command(&mut cell, &order(0, 7)), (code(ReplyCode::None), 0), "no order, no command");
    assert_eq!(cell.value("WordInputReg[1]"), 7.0);
    assert_eq!(send_command(&mut cell, &order(1, 42)).0, code(ReplyCode::Pending));
    assert_eq!(send_command(&mut cell, &order(0, 42)), (code(ReplyCode::Success), 1), "pick runs");
    assert_eq!(cell.controller().counters().programs_started, 1);
    assert_eq!(cell.value("WordInputReg[1]"), 42.0);
    // Only one program at a time: the second one is refused, and the answer says so.
    assert_eq!(send_command(&mut cell, &order(2, 42)).0, code(ReplyCode::Pending));
    assert_eq!(send_command(&mut cell, &order(0, 42)).0, code(ReplyCode::Fail));
    cell.run_ms(500);
    assert_eq!(send_command(&mut cell, &order(0, 42)), (code(ReplyCode::Fail), 0), "pick has ended");
    assert_eq!(send_command(&mut cell, &order(2, 42)).0, code(ReplyCode::Pending));
    assert_eq!(send_command(&mut cell, &order(9, 42)).0, code(ReplyCode::Pending));
    assert_eq!(send_command(&mut cell, &order(0, 42)).0, code(ReplyCode::Success), "stopped");
    assert_eq!(cell.controller().counters().programs_started, 2);
    let port = cell.port("station");
    assert_eq!((port.commands, port.commands_dropped, port.frames_out), (4, 0, port.frames_in));
    let link = cell.link(LinkId::COMMAND).counters;
    assert_eq!((link.sent, link.received, link.refused, link.timeouts), (3, 3, 1, 0));
    let link = cell.link(LinkId::URGENT).counters;
    assert_eq!((link.sent, link.received, link.refused, link.timeouts), (1, 1, 0, 0), "stopping never waits");
    // Without the controller an order is refused at once, and not executed later.
    cell.refuse(LinkId::COMMAND);
    cell.reset(LinkId::COMMAND);
    assert_eq!(send_command(&mut cell, &order(1, 1)).0, code(ReplyCode::NotSent));
    cell.admit(LinkId::COMMAND);
    cell.run_ms(6_000);
    assert_eq!(cell.controller().counters().programs_started, 2);
    assert_eq!(send_command(&mut cell, &order(1, 1)).0, code(ReplyCode::Pending));
    assert_eq!(send_command(&mut cell, &order(0, 1)), (code(ReplyCode::Success), 1));
}
