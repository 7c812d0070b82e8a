//! Faults of the controller's side: the gateway counts them, recovers by itself, replays nothing old, and
//! the next valid field frame reaches the controller's registers.

use proto_core::engine::{LinkId, PortId};
use proto_core::link::LinkState;
use proto_core::modbus::Exception;
use proto_core::time::Duration;
use recipe_cell::{Cell, LineId, PeriodicSender, Way};
use recipe_controller::Link;

use crate::kit::*;

/// Worked example 2: outputs go up over Modbus, the pose comes down on the state stream.
fn system() -> (Cell, LineId) {
    let mut cell = cell("rs485-system");
    let line = cell.line_of("rs485-1");
    cell.run_ms(50);
    outputs_get_through(&mut cell, line);
    (cell, line)
}

#[track_caller]
fn wait_for_up(cell: &mut Cell, link: LinkId, limit_ms: u64) {
    let up = |cell: &Cell| matches!(cell.link(link).state, LinkState::Up { .. });
    let found = cell.run_until(Duration::from_millis(limit_ms), up);
    assert!(found, "{link:?} is not up: {:?}", cell.link(link));
}

/// Checks that the pose on the line follows the controller's.
#[track_caller]
fn pose_gets_through(cell: &mut Cell, line: LineId) {
    cell.run_ms(150);
    cell.line(line).take_heard();
    cell.run_ms(8);
    let x = cell.value("RobotState[8]") as f32;
    let frames = heard(cell, line);
    assert_eq!(frames.len(), 2);
    assert_eq!(frames[1][2..6], x.to_le_bytes());
}

#[test]
fn refused_while_frames_go_on_and_nothing_is_replayed() {
    let (mut cell, line) = system();
    cell.refuse(LinkId::MODBUS);
    cell.reset(LinkId::MODBUS);
    for n in 0..100_u32 {
        cell.send(line, &outputs(n as u8 | 0x80));
        cell.run_ms(30);
    }
    let port = *cell.port("rs485-1");
    assert_eq!(port.undelivered, 100);
    let history = *cell.link(LinkId::MODBUS).history;
    // 0.1 + 0.2 + 0.4 + 0.8 + 1.6 s.
    assert_eq!((history.losses, history.failed_opens), (1, 4));
    cell.run_ms(500);
    cell.admit(LinkId::MODBUS);
    wait_for_up(&mut cell, LinkId::MODBUS, 5_100);
    cell.run_ms(1_000);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0, "old frames are not replayed");
    outputs_get_through(&mut cell, line);
    assert_eq!(cell.port("rs485-1").undelivered, 100);
}

#[test]
fn what_waited_when_the_connection_was_lost_is_not_written_after_it_is_back() {
    let (mut gateway, controller) = files("rs485-system");
    gateway.ports[0].timeout = Duration::from_secs(10);
    let mut cell = Cell::new(&gateway, &controller, 1).unwrap();
    let line = cell.line_of("rs485-1");
    cell.run_ms(500);
    outputs_get_through(&mut cell, line);
    // One write is in flight, two edges wait behind it.
    cell.hold(LinkId::MODBUS, Way::Up);
    for byte in [1, 2, 3] {
        cell.send(line, &outputs(byte));
        cell.run_ms(5);
    }
    let before = cell.controller().counters().modbus.requests;
    cell.reset(LinkId::MODBUS);
    cell.run_ms(2_000);
    assert_eq!(cell.link(LinkId::MODBUS).history.connects, 2);
    assert_eq!(cell.controller().counters().modbus.requests, before);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_server_that_closes_what_it_takes() {
    let (mut cell, line) = system();
    for server in [Link::Modbus, Link::State] {
        cell.controller_mut().refuse(server);
        cell.controller_mut().disconnect(server);
    }
    cell.run_ms(3_000);
    for link in [LinkId::MODBUS, LinkId::STATE] {
        let history = cell.link(link).history;
        assert!((4..=6).contains(&history.losses), "{history:?}: backoff must grow");
    }
    for server in [Link::Modbus, Link::State] {
        cell.controller_mut().accept(server);
    }
    cell.run_ms(5_100);
    outputs_get_through(&mut cell, line);
    pose_gets_through(&mut cell, line);
}

#[test]
fn no_answer_to_a_connection_is_given_up_and_tried_again() {
    let (mut cell, line) = system();
    cell.black_hole(LinkId::MODBUS);
    cell.reset(LinkId::MODBUS);
    cell.run_ms(5_000);
    // 0.1 s, then 2 s to connect and 0.2 s of backoff, then 2 s again.
    assert_eq!(cell.link(LinkId::MODBUS).history.failed_opens, 2);
    cell.admit(LinkId::MODBUS);
    wait_for_up(&mut cell, LinkId::MODBUS, 5_000);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_reset_at_every_byte_of_a_modbus_exchange() {
    // The answer to a write of 8 coils has 12 bytes, the request 14.
    for (way, most) in [(Way::Down, 12), (Way::Up, 14)] {
        for bytes in 0..=most {
            let (mut cell, line) = system();
            cell.reset_after(LinkId::MODBUS, way, bytes);
            cell.send(line, &outputs(0x11));
            cell.run_ms(20);
            assert_eq!(cell.link(LinkId::MODBUS).history.losses, 1, "{way:?} {bytes}");
            let expected = if way == Way::Up && bytes < most { 0.0 } else { 17.0 };
            assert_eq!(
                cell.value("DigitalOutputCommand[1]"),
                expected,
                "{way:?} {bytes}: whole or not at all"
            );
            wait_for_up(&mut cell, LinkId::MODBUS, 200);
            outputs_get_through(&mut cell, line);
            assert_eq!(cell.controller().counters().modbus.open, 1);
            assert_eq!(cell.link(LinkId::MODBUS).counters.malformed, 0, "half an answer is no answer");
        }
    }
}

#[test]
fn a_reset_within_a_state_packet() {
    for bytes in [0, 1, 2, 3, 367, 734, 1_466, 1_467, 1_468, 1_469] {
        let (mut cell, line) = system();
        cell.run_ms(20);
        let before = *cell.link(LinkId::STATE).counters;
        cell.reset_after(LinkId::STATE, Way::Down, bytes);
        cell.run_ms(450);
        let link = cell.link(LinkId::STATE);
        assert_eq!(link.history.losses, 1, "{bytes}");
        assert_eq!(link.counters.malformed, 0, "the next connection begins with its own first byte");
        assert!(link.counters.received > before.received + (bytes / 1_468) as u32, "{bytes}");
        pose_gets_through(&mut cell, line);
        outputs_get_through(&mut cell, line);
    }
}

#[test]
fn half_a_state_packet() {
    for len in [0, 1, 734, 1_467] {
        let (mut cell, line) = system();
        cell.controller_mut().cut_next_state_packet(len);
        cell.run_ms(100);
        assert_eq!(cell.link(LinkId::STATE).history.losses, 1);
        cell.run_ms(300);
        let link = cell.link(LinkId::STATE);
        assert_eq!((link.history.connects, link.counters.malformed), (2, 0));
        pose_gets_through(&mut cell, line);
        outputs_get_through(&mut cell, line);
    }
}

#[test]
fn a_state_stream_in_pieces_and_runs() {
    let (mut cell, line) = system();
    let network = cell.network(LinkId::STATE);
    network.longest_segment = Some(400);
    network.jitter = Duration::from_millis(90);
    let before = cell.link(LinkId::STATE).counters.received;
    cell.run_ms(20_000);
    let link = cell.link(LinkId::STATE);
    assert!((195..=201).contains(&(link.counters.received - before)), "{link:?}");
    assert_eq!((link.counters.malformed, link.history.losses), (0, 0));
    cell.network(LinkId::STATE).jitter = Duration::ZERO;
    cell.run_ms(1_000);
    pose_gets_through(&mut cell, line);
}

#[test]
fn a_mute_modbus_server_is_reopened_and_obeyed_again() {
    let (mut cell, line) = system();
    cell.controller_mut().mute(Link::Modbus);
    for n in 0..40 {
        cell.send(line, &outputs(n));
        cell.run_ms(50);
    }
    let link = cell.link(LinkId::MODBUS);
    assert!(link.counters.timeouts >= 3, "{:?}", link.counters);
    assert!(link.history.losses >= 1, "three in a row close the connection");
    cell.controller_mut().unmute(Link::Modbus);
    cell.run_ms(1_500);
    wait_for_up(&mut cell, LinkId::MODBUS, 2_000);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_mute_state_server_is_reopened_and_the_ports_show_it() {
    let (mut cell, line) = system();
    cell.controller_mut().mute(Link::State);
    cell.run_ms(10_000);
    let link = cell.link(LinkId::STATE);
    assert!((3..=5).contains(&link.history.silences), "{:?}", link.history);
    // This recipe holds stale values: the pose is still sent.
    cell.line(line).take_heard();
    cell.run_ms(40);
    assert_eq!(heard(&mut cell, line).len(), 10);
    outputs_get_through(&mut cell, line);
    cell.controller_mut().unmute(Link::State);
    cell.run_ms(2_500);
    pose_gets_through(&mut cell, line);
}

#[test]
fn a_half_open_connection_is_found_out() {
    for link in [LinkId::MODBUS, LinkId::STATE] {
        let (mut cell, line) = system();
        cell.half_open(link);
        for n in 0..60 {
            cell.send(line, &outputs(n));
            cell.run_ms(50);
        }
        assert_eq!(cell.link(link).history.losses, 1);
        assert_eq!(cell.link(link).history.connects, 2);
        outputs_get_through(&mut cell, line);
        pose_gets_through(&mut cell, line);
    }
}

#[test]
fn a_stalled_network_delivers_late_and_the_newest_wins() {
    let (mut cell, line) = system();
    cell.hold(LinkId::MODBUS, Way::Up);
    for n in 0..5 {
        cell.send(line, &outputs(1 << n));
        cell.run_ms(50);
    }
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0);
    cell.release(LinkId::MODBUS, Way::Up);
    cell.run_ms(20);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 16.0);
    let link = cell.link(LinkId::MODBUS);
    assert_eq!((link.history.losses, link.counters.timeouts), (0, 0));
    outputs_get_through(&mut cell, line);
}

#[test]
fn an_exception_is_counted_and_the_next_frame_gets_through() {
    for exception in [
        Exception::IllegalFunction,
        Exception::IllegalDataAddress,
        Exception::IllegalDataValue,
        Exception::DeviceFailure,
        Exception::DeviceBusy,
    ] {
        let (mut cell, line) = system();
        cell.controller_mut().answer_modbus_with(Some(exception));
        for n in 1..=20 {
            cell.send(line, &outputs(n));
            cell.run_ms(10);
        }
        let link = cell.link(LinkId::MODBUS);
        assert_eq!((link.counters.refused, link.history.losses), (20, 0), "{exception:?}");
        assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0);
        cell.controller_mut().answer_modbus_with(None);
        cell.run_ms(1_000);
        assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0, "what was refused is not tried again");
        outputs_get_through(&mut cell, line);
    }
}

#[test]
fn slow_answers_slow_the_writes_and_lose_no_edge() {
    let (mut cell, line) = system();
    cell.controller_mut().delay_answers(Link::Modbus, Duration::from_millis(20));
    let before = cell.controller().counters().modbus.requests;
    for n in 1..=5 {
        cell.send(line, &outputs(n & 1));
        cell.run_ms(5);
    }
    cell.run_ms(150);
    assert_eq!(cell.controller().counters().modbus.requests, before + 5, "each edge is a write of its own");
    assert_eq!(cell.value("DO[1]"), 1.0);
    let link = cell.link(LinkId::MODBUS);
    assert!((20_000..21_000).contains(&link.counters.round_trip_us), "{:?}", link.counters);
    assert_eq!((link.counters.timeouts, link.history.losses), (0, 0));
    cell.controller_mut().delay_answers(Link::Modbus, Duration::ZERO);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_value_that_waited_longer_than_its_ports_timeout_is_not_written_any_more() {
    let (mut cell, line) = system();
    cell.controller_mut().delay_answers(Link::Modbus, Duration::from_millis(300));
    let before = cell.controller().counters().modbus.requests;
    for byte in [1, 0, 1] {
        cell.send(line, &outputs(byte));
        cell.run_ms(20);
    }
    cell.run_ms(1_000);
    assert_eq!(cell.controller().counters().modbus.requests, before + 1);
    assert_eq!(cell.port("rs485-1").values_expired, 2);
    assert_eq!(cell.value("DO[1]"), 1.0, "what the first frame said");
    cell.controller_mut().delay_answers(Link::Modbus, Duration::ZERO);
    outputs_get_through(&mut cell, line);
}

#[test]
fn answers_slower_than_the_gateways_patience_are_not_taken_for_others() {
    let (mut cell, line) = system();
    cell.controller_mut().delay_answers(Link::Modbus, Duration::from_millis(700));
    for n in 0..40 {
        cell.send(line, &outputs(n));
        cell.run_ms(100);
    }
    let link = cell.link(LinkId::MODBUS);
    assert!(link.counters.timeouts >= 3, "{:?}", link.counters);
    cell.controller_mut().delay_answers(Link::Modbus, Duration::ZERO);
    cell.run_ms(2_000);
    wait_for_up(&mut cell, LinkId::MODBUS, 5_000);
    outputs_get_through(&mut cell, line);
}

#[test]
fn the_controller_is_switched_off_and_on() {
    let (mut cell, line) = system();
    cell.send(line, &outputs(0x0F));
    cell.run_ms(10);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 15.0);
    cell.restart_controller();
    cell.run_ms(1);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0, "it starts afresh");
    cell.run_ms(1_000);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 0.0, "and nothing stale is replayed");
    for link in [LinkId::MODBUS, LinkId::STATE] {
        let history = cell.link(link).history;
        assert_eq!((history.losses, history.connects), (1, 2), "{link:?}");
    }
    outputs_get_through(&mut cell, line);
    pose_gets_through(&mut cell, line);
}

#[test]
fn the_gateway_is_switched_off_and_on() {
    let (mut cell, line) = system();
    cell.send(line, &outputs(0x0F));
    cell.run_ms(10);
    cell.restart_gateway();
    cell.run_ms(1_000);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 15.0, "nothing is written before a field frame");
    let counters = cell.controller().counters();
    assert_eq!((counters.modbus.open, counters.state.open), (1, 1));
    outputs_get_through(&mut cell, line);
    pose_gets_through(&mut cell, line);
}

#[test]
fn datagrams_that_get_lost_cost_only_themselves() {
    let mut cell = cell("force-sensor");
    let line = cell.line_of("force");
    cell.network(LinkId::RECIPE_UDP).loss_ppm = 300_000;
    let value = |n: u64| n as f32 + 0.5;
    cell.attach(line, PeriodicSender::new(cell.now(), 500, 1_000, move |n| force_frame([value(n); 6])));
    cell.run_ms(2_005);
    let arrived = cell.controller().counters().ports["udp2011"];
    assert!((600..800).contains(&arrived.frames_in), "{arrived:?}");
    assert_eq!(cell.port("force").frames_in, 1_000);
    cell.network(LinkId::RECIPE_UDP).loss_ppm = 0;
    cell.run_ms(500);
    cell.send(line, &force_frame([-7.0; 6]));
    cell.run_ms(3);
    assert_eq!(force(&cell), [-7.0; 6]);
    // Frames from the controller start again by themselves: the gateway repeats its greeting when none come.
    let before = cell.link(LinkId::RECIPE_UDP).counters.received;
    cell.run_ms(1_000);
    assert!(cell.link(LinkId::RECIPE_UDP).counters.received >= before + 249);
}

#[test]
fn the_udp_server_forgets_its_client_when_it_restarts_and_is_asked_again() {
    let mut cell = cell("udp-server");
    let line = cell.line_of("rs485-1");
    outputs_get_through(&mut cell, line);
    cell.restart_controller();
    cell.run_ms(1_000);
    let before = cell.link(LinkId::RECIPE_UDP).counters.received;
    cell.run_ms(400);
    assert!(cell.link(LinkId::RECIPE_UDP).counters.received >= before + 99);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_gateway_that_restarts_is_a_new_udp_client_and_the_old_one_is_dropped() {
    let mut cell = cell("udp-server");
    let line = cell.line_of("rs485-1");
    for restarts in 1..=20 {
        outputs_get_through(&mut cell, line);
        cell.restart_gateway();
        cell.run_ms(1_000);
        assert_eq!(cell.controller().counters().ports["udp2011"].clients_gone, restarts);
    }
    outputs_get_through(&mut cell, line);
    assert_eq!(cell.controller().counters().ports["udp2011"].clients_displaced, 0);
}

#[test]
fn a_tcp_client_whose_stream_is_cut_at_every_byte_of_a_frame() {
    let link = LinkId::of_port(PortId(0));
    // The frame of six floats has 28 bytes.
    for bytes in 0..=28 {
        let mut cell = cell("client");
        let line = cell.line_of("rs485-1");
        cell.reset_after(link, Way::Down, bytes);
        cell.run_ms(1_000);
        let info = cell.link(link);
        assert_eq!((info.history.losses, info.history.connects), (1, 2), "{bytes}");
        assert_eq!((info.counters.malformed, info.counters.resync_bytes), (0, 0), "{bytes}");
        outputs_get_through(&mut cell, line);
    }
}

#[test]
fn a_tcp_client_that_falls_silent_is_dropped_and_may_come_back() {
    let mut cell = cell("client");
    let line = cell.line_of("rs485-1");
    let link = LinkId::of_port(PortId(0));
    cell.controller_mut().mute_port(0);
    cell.run_ms(3_000);
    assert_eq!(cell.link(link).history.silences, 1);
    cell.controller_mut().unmute_port(0);
    cell.run_ms(2_600);
    outputs_get_through(&mut cell, line);
}

#[test]
fn a_recipe_swap_on_the_controllers_side_is_counted_and_shows_nothing_wrong() {
    // The controller's port has a recipe with one float less.
    let (gateway, mut controller) = files("udp-server");
    if let recipe_config::SimParts::Stream { output: Some(output), .. } = &mut controller.recipes[0].parts {
        output.fields.pop();
    }
    let mut cell = Cell::new(&gateway, &controller, 1).unwrap();
    let line = cell.line_of("rs485-1");
    cell.run_ms(2_000);
    let link = cell.link(LinkId::RECIPE_UDP).counters;
    assert_eq!(link.received, 0);
    assert!(link.malformed > 300, "{link:?}");
    assert_eq!(heard(&mut cell, line), Vec::<Vec<u8>>::new(), "nothing is shown that was not received");
}

#[test]
fn a_slow_command_server_says_so_and_no_reply_is_taken_for_another() {
    let mut cell = cell("request-response");
    let line = cell.line_of("station");
    let send_command = |cell: &mut Cell, order: u8| {
        cell.line(line).take_heard();
        cell.send(line, &[0xFF, 0xFF, order, 0, 0, 0xEE, 0xEE]);
        cell.run_ms(60);
        heard(cell, line)[0][3]
    };
    cell.controller_mut().mute(Link::Command);
    // The stop uses the urgent link, and is no longer requested.
    assert_eq!(send_command(&mut cell, 9), 1);
    assert_eq!(send_command(&mut cell, 0), 1);
    cell.run_ms(10_000);
    assert_eq!(send_command(&mut cell, 0), 5, "no reply");
    let link = cell.link(LinkId::URGENT);
    assert_eq!((link.counters.timeouts, link.history.losses), (1, 1));
    assert_eq!(cell.link(LinkId::COMMAND).history.losses, 0);
    cell.controller_mut().unmute(Link::Command);
    cell.run_ms(500);
    assert_eq!(send_command(&mut cell, 1), 1);
    assert_eq!(send_command(&mut cell, 0), 2, "the program was started");
    // Late, but within the time limit.
    cell.run_ms(1_000);
    cell.controller_mut().delay_answers(Link::Command, Duration::from_millis(500));
    assert_eq!(send_command(&mut cell, 1), 1);
    assert_eq!(send_command(&mut cell, 0), 1);
    cell.run_ms(500);
    assert_eq!(send_command(&mut cell, 0), 2);
}
