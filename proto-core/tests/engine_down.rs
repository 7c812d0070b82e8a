//! Controller to field: cycles, sources, staleness, half duplex (docs/engine.md sections 4, 8).

mod rig;

use proto_core::config::{Bus, OnStale};
use proto_core::engine::{BusState, Input, LinkId, Output, PortId};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanId;
use rig::*;

fn pose_packet(pose: [f32; 6]) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    for (nth, value) in pose.iter().enumerate() {
        packet[368 + 4 * nth..][..4].copy_from_slice(&value.to_le_bytes());
    }
    packet
}

fn pose_frame(pose: &[f32]) -> Vec<u8> {
    let values = pose.iter().flat_map(|value| value.to_le_bytes());
    [255, 255].into_iter().chain(values).chain([254, 254]).collect()
}

/// Worked example 2's output part: RobotState[8..11] each cycle.
fn pose() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&[], &["RobotState[8..11]"]);
    let port = cell.rs485(recipe);
    (cell.rig(), port)
}

#[test]
fn nothing_is_sent_before_something_is_known() {
    let (mut rig, port) = pose();
    rig.run(MS(1_000));
    assert!(rig.sent_to(port).is_empty());
    assert!(rig.counters(port).stale_cycles > 200);
}

#[test]
fn the_pose_goes_out_each_cycle_on_the_grid() {
    let (mut rig, port) = pose();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &pose_packet([0.5, -0.25, 1.0, 2.0, 3.0, 4.0]));
    rig.log.clear();
    rig.run(MS(100));
    let times: Vec<_> = rig.log.iter().map(|(at, _)| at.as_micros()).collect();
    assert_eq!(times.len(), 25);
    assert!(times.iter().all(|at| at % 4_000 == 0), "a fixed grid: {times:?}");
    assert!(rig.sent_to(port).iter().all(|frame| *frame == pose_frame(&[0.5, -0.25, 1.0, 2.0])));
}

#[test]
fn a_state_packet_is_taken_in_any_pieces_and_half_of_one_never() {
    let (mut rig, port) = pose();
    rig.run(MS(10));
    let packet = pose_packet([1.0; 6]);
    for chunk in packet.chunks(7) {
        rig.link_bytes(LinkId::STATE, chunk);
    }
    rig.run(MS(4));
    assert_eq!(rig.sent_to(port), [pose_frame(&[1.0; 4])]);
    // Half a packet, then the connection is gone: the rest must not be taken for its second half.
    rig.link_bytes(LinkId::STATE, &pose_packet([7.0; 6])[..734]);
    rig.input(Input::LinkDown { link: LinkId::STATE });
    rig.run(MS(150));
    rig.link_bytes(LinkId::STATE, &pose_packet([2.0; 6]));
    rig.sent_to(port);
    rig.run(MS(4));
    assert_eq!(rig.sent_to(port), [pose_frame(&[2.0; 4])]);
}

#[test]
fn misaligned_packets_are_dropped_and_three_reopen_the_link() {
    let (mut rig, _) = pose();
    rig.run(MS(10));
    let mut bad = pose_packet([1.0; 6]);
    for joint in bad[..12].chunks_mut(4) {
        joint.copy_from_slice(&f32::NAN.to_le_bytes());
    }
    rig.link_bytes(LinkId::STATE, &bad);
    rig.link_bytes(LinkId::STATE, &bad);
    assert!(rig.take(|out| (*out == Out::Close(LinkId::STATE)).then_some(())).is_empty());
    rig.link_bytes(LinkId::STATE, &bad);
    assert_eq!(rig.take(|out| (*out == Out::Close(LinkId::STATE)).then_some(())).len(), 1);
    assert_eq!(rig.link(LinkId::STATE).counters.malformed, 3);
    rig.run(MS(200));
    rig.link_bytes(LinkId::STATE, &pose_packet([1.0; 6]));
    assert_eq!(rig.link(LinkId::STATE).counters.received, 1);
}

#[test]
fn a_stream_that_lost_four_bytes_shows_the_field_nothing() {
    let (mut rig, port) = pose();
    rig.run(MS(10));
    // A robot at rest, enabled: each packet is the same.
    let mut packet = pose_packet([0.41, -0.2, 0.63, 3.1, 0.02, -1.57]);
    packet[1448..1452].copy_from_slice(&[2, 6, 0, 5]);
    rig.link_bytes(LinkId::STATE, &packet);
    let turned = [&packet[4..], &packet[..4]].concat();
    for _ in 0..3 {
        rig.run(MS(20));
        rig.link_bytes(LinkId::STATE, &turned);
    }
    assert_eq!(rig.take(|out| (*out == Out::Close(LinkId::STATE)).then_some(())).len(), 1);
    let link = rig.link(LinkId::STATE).counters;
    assert_eq!((link.received, link.malformed), (1, 3));
    rig.run(MS(200));
    rig.link_bytes(LinkId::STATE, &packet);
    rig.run(MS(20));
    let shown = rig.sent_to(port);
    assert!(shown.len() > 10 && shown.iter().all(|frame| *frame == pose_frame(&[0.41, -0.2, 0.63, 3.1])));
    assert_eq!(rig.link(LinkId::STATE).counters.received, 2);
}

#[test]
fn a_silent_state_stream_is_reopened() {
    let (mut rig, _) = pose();
    rig.run(MS(10));
    rig.log.clear();
    rig.run(MS(2_500));
    let events = rig.take(|out| matches!(out, Out::Open(_) | Out::Close(_)).then(|| out.clone()));
    assert_eq!(events, [Out::Close(LinkId::STATE), Out::Open(LinkId::STATE)]);
    assert_eq!(rig.link(LinkId::STATE).history.silences, 1);
}

#[test]
fn stale_sources_are_held_or_stop_the_port() {
    for (on_stale, frames) in [(OnStale::Hold, 250), (OnStale::Stop, 125)] {
        let mut cell = Cell::new();
        let recipe = cell.stream(&[], &["RobotState[8..11]"]);
        cell.last_recipe().on_stale = on_stale;
        let port = cell.rs485(recipe);
        let mut rig = cell.rig();
        rig.run(MS(10));
        rig.link_bytes(LinkId::STATE, &pose_packet([1.0; 6]));
        rig.run(MS(1_000));
        let sent = rig.sent_to(port).len();
        assert!(sent.abs_diff(frames) <= 1, "{on_stale:?}: {sent}");
        rig.link_bytes(LinkId::STATE, &pose_packet([2.0; 6]));
        rig.run(MS(8));
        assert_eq!(rig.sent_to(port).last(), Some(&pose_frame(&[2.0; 4])), "and it comes back");
    }
}

#[test]
fn bits_and_words_are_polled_in_blocks_at_the_ports_cycle() {
    let mut cell = Cell::new();
    let names =
        ["DigitalSignalStatus[1..3]", "BitOutputReg[3]", "WordOutputReg[1..2]", "DigitalSignalStatus[6]"];
    let recipe = cell.stream(&[], &names);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.map.coils[176] = true;
    rig.map.coils[191] = true;
    rig.map.coils[209] = true;
    rig.map.coils[96 + 7] = true;
    rig.map.coils[216] = true;
    rig.map.registers[40] = 0x1234;
    rig.map.registers[41] = 0xFFFF;
    rig.run(MS(10));
    let frames = rig.sent_to(port);
    let expected = vec![255, 255, 1, 0x80, 2, 0x80, 0x34, 0x12, 0xFF, 0xFF, 1, 254, 254];
    assert_eq!(frames.last(), Some(&expected));
    rig.sent_on(LinkId::MODBUS);
    rig.run(MS(400));
    let polls = rig.sent_on(LinkId::MODBUS).len();
    assert_eq!(polls, 300, "three blocks, every 4 ms");
    assert!(rig.engine.links().all(|link| link.id == LinkId::MODBUS), "nothing else is needed");
}

#[test]
fn polls_and_writes_take_turns() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["WordInputReg[1]"], &["WordOutputReg[1]"]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    rig.log.clear();
    rig.run(MS(5));
    let mut kinds = Vec::new();
    for n in 0..6 {
        rig.bytes(port, &[255, 255, n, 0, 238, 238]);
        rig.run(MS(5));
        let request = rig.sent_on(LinkId::MODBUS).remove(0);
        kinds.push(request[7]);
        let answer = rig.answer(&request);
        rig.link_bytes(LinkId::MODBUS, &answer);
    }
    assert!(kinds.windows(2).all(|pair| pair[0] != pair[1]), "{kinds:?}");
}

#[test]
fn a_recipe_link_beats_modbus_and_the_stream() {
    let mut cell = Cell::new();
    let up = cell.stream(&[], &["RobotState[8..9]", "WordOutputReg[1]", "RobotState[26]"]);
    cell.recipe_link(up);
    let recipe = cell.stream(&[], &["RobotState[8..9]", "WordOutputReg[1]", "RobotState[26]"]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    assert!(rig.engine.links().all(|link| link.id == LinkId::RECIPE_UDP));
    let greetings = rig.sent_on(LinkId::RECIPE_UDP);
    assert_eq!(greetings, [[0]], "the server streams to addresses that sent it something");
    let values =
        [&1.5_f32.to_le_bytes()[..], &2.5_f32.to_le_bytes(), &[7, 0], &3.0_f32.to_le_bytes()].concat();
    let frame = [&[255, 255], &values[..], &[254, 254]].concat();
    rig.link_bytes(LinkId::RECIPE_UDP, &frame[..frame.len() - 1]);
    rig.link_bytes(LinkId::RECIPE_UDP, &[&frame[..], &[0]].concat());
    rig.run(MS(8));
    assert!(rig.sent_to(port).is_empty(), "a datagram is one frame, neither more nor less");
    rig.link_bytes(LinkId::RECIPE_UDP, &frame);
    rig.run(MS(4));
    assert_eq!(rig.sent_to(port), [frame]);
    let link = rig.link(LinkId::RECIPE_UDP);
    assert_eq!((link.counters.received, link.counters.malformed), (1, 2));
    rig.run(MS(2_000));
    assert!(rig.sent_on(LinkId::RECIPE_UDP).len() >= 3, "asked again while nothing comes");
}

#[test]
fn the_controllers_own_tcp_client_is_a_recipe_link_too() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1]"], &["RobotState[8]"]);
    let listen = heapless::String::try_from("127.0.0.1:50000").unwrap();
    let tcp = cell.port(Bus::TcpListen { listen }, up);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &["RobotState[8]"]);
    let port = cell.rs485(recipe);
    let link = LinkId::of_port(tcp);
    let mut rig = cell.rig();
    rig.reachable.clear();
    rig.run(MS(60_000));
    assert!(rig.link(link).history.failed_opens <= 601, "nobody connects: we go on listening");
    rig.reachable.insert(link.0);
    rig.run(MS(200));
    let frame = pose_frame(&[0.75]);
    // One frame in two segments, with garbage before it.
    rig.link_bytes(link, &[&[1, 2, 3], &frame[..4]].concat());
    rig.link_bytes(link, &frame[4..]);
    rig.run(MS(4));
    assert_eq!(rig.sent_to(port), [frame]);
    rig.bytes(port, &[255, 255, 1, 238, 238]);
    assert_eq!(rig.sent_on(link), [[255, 255, 1, 238, 238]]);
}

#[test]
fn the_controllers_own_udp_client_may_fall_silent_and_come_back() {
    let mut cell = Cell::new();
    let up = cell.stream(&["DigitalOutputCommand[1]"], &["RobotState[8]"]);
    let listen = heapless::String::try_from("127.0.0.1:50000").unwrap();
    let udp = cell.port(Bus::UdpListen { listen }, up);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &["RobotState[8]"]);
    let port = cell.rs485(recipe);
    let link = LinkId::of_port(udp);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(link, &pose_frame(&[0.75]));
    rig.run(MS(4));
    assert_eq!(rig.sent_to(port), [pose_frame(&[0.75])]);
    rig.reachable.clear();
    rig.run(MS(2_100));
    assert_eq!(rig.link(link).history.silences, 1);
    rig.bytes(port, &[255, 255, 1, 238, 238]);
    assert!(rig.sent_on(link).is_empty(), "no client is connected");
    assert_eq!(rig.counters(port).undelivered, 1);
    rig.reachable.insert(link.0);
    rig.run(MS(200));
    rig.bytes(port, &[255, 255, 1, 238, 238]);
    assert_eq!(rig.sent_on(link), [[255, 255, 1, 238, 238]]);
}

#[test]
fn a_frame_waits_for_the_line_and_a_cycle_that_is_lost_is_counted() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["WordInputReg[1]"], &["RobotState[8..11]"]);
    let port = cell.rs485(recipe);
    if let Bus::Rs485(line) = &mut cell.last_port().bus {
        line.turnaround = MS(1);
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &pose_packet([1.0; 6]));
    rig.run(MS(5));
    rig.sent_to(port);
    // The device talks just before our cycle: we wait until the line has been silent for 1 ms.
    let due = Instant::from_micros((rig.now.as_micros() + 1).next_multiple_of(4_000));
    rig.run(due.saturating_since(rig.now) - Duration::from_micros(200));
    rig.sent_to(port);
    rig.bytes(port, &[255, 255, 1, 0, 238, 238]);
    rig.log.clear();
    rig.run(MS(2));
    assert_eq!(rig.log.iter().map(|(at, _)| *at).collect::<Vec<_>>(), [due + Duration::from_micros(800)]);

    // The driver is still sending when the next two cycles come.
    rig.run(MS(4));
    rig.reports_sent = false;
    rig.sent_to(port);
    let before = rig.counters(port).skipped_cycles;
    rig.run(MS(12));
    assert_eq!(rig.sent_to(port).len(), 1);
    assert_eq!(rig.counters(port).skipped_cycles, before + 1);
    rig.reports_sent = true;
    rig.input(Input::PortSent { port });
    assert_eq!(rig.sent_to(port).len(), 1, "the newest one goes out at once");
}

#[test]
fn can_frames_go_out_in_declared_order_and_bus_off_stops_them() {
    let mut cell = Cell::new();
    let recipe =
        cell.can(&[], &[(4, &["RobotState[8..9]"]), (2, &["RobotState[10..11]"]), (3, &["RobotState[12]"])]);
    let port = cell.can_port(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let captured = f32::from_le_bytes([0xEF, 0x54, 0xEF, 0x3E]);
    rig.link_bytes(LinkId::STATE, &pose_packet([captured, 0.25, 3.0, 4.0, 5.0, 6.0]));
    rig.run(MS(4));
    let frames = rig.can_sent_to(port);
    let ids: Vec<_> = frames.iter().map(|frame| frame.id()).collect();
    assert_eq!(ids, [4, 2, 3].map(CanId::Standard));
    assert_eq!(frames[0].data(), [0xEF, 0x54, 0xEF, 0x3E, 0, 0, 0x80, 0x3E]);
    assert_eq!(frames[2].data(), 5.0_f32.to_le_bytes());

    rig.input(Input::PortBus { port, state: BusState::BusOff });
    rig.run(MS(1_000));
    assert!(rig.can_sent_to(port).is_empty());
    rig.link_bytes(LinkId::STATE, &pose_packet([9.0; 6]));
    rig.input(Input::PortBus { port, state: BusState::Active });
    assert!(rig.can_sent_to(port).is_empty(), "it goes on with the next cycle");
    rig.run(MS(4));
    let frames = rig.can_sent_to(port);
    assert_eq!(frames.len(), 3);
    assert_eq!(frames[2].data(), 9.0_f32.to_le_bytes(), "nothing stale after recovery");
    assert_eq!(rig.counters(port).bus_offs, 1);
}

#[test]
fn a_port_without_a_device_sends_nothing_and_starts_again_when_it_is_back() {
    let (mut rig, port) = pose();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &pose_packet([1.0; 6]));
    rig.input(Input::PortDown { port });
    rig.run(MS(400));
    assert!(rig.sent_to(port).is_empty());
    rig.input(Input::PortUp { port });
    rig.run(MS(8));
    assert_eq!(rig.sent_to(port).len(), 2);
    assert_eq!(rig.counters(port).downs, 1);
    assert_eq!(rig.counters(port).skipped_cycles, 0);
}

#[test]
fn an_engine_that_is_called_late_counts_what_it_missed() {
    let (mut rig, port) = pose();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &pose_packet([1.0; 6]));
    rig.run(MS(8));
    rig.sent_to(port);
    rig.now += MS(41);
    rig.input(Input::Tick);
    assert_eq!(rig.sent_to(port).len(), 1, "one frame, no burst");
    assert_eq!(rig.counters(port).skipped_cycles, 10);
}

#[test]
fn polling_early_is_harmless() {
    let (mut rig, _) = pose();
    rig.run(MS(10));
    let mut buf = [0; proto_core::engine::OUTPUT_BUFFER];
    for _ in 0..1_000 {
        let out = rig.engine.poll_output(rig.now, &mut buf);
        assert!(matches!(out, Output::Sleep { until } if until > rig.now), "{out:?}");
    }
}

#[test]
fn four_ports_and_a_recipe_link_take_less_than_42_kib() {
    let size = size_of::<proto_core::engine::Engine<4, 1, 128, 0, 0>>();
    assert!(size <= 42 * 1024, "{size} bytes");
}
