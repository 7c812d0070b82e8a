//! Recipe ports: what is accepted, what is counted, and when they send.

use proto_core::wire::can::MAX_CAN_DATA;

use super::*;
use ScalarType::{Byte, Float};

const ON: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];
const OFF: [u8; 5] = [0xFF, 0xFF, 0x00, 0xEE, 0xEE];

fn system_port(bus: SimBus) -> SimConfig {
    one_port(
        bus,
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..11]"])),
    )
}

fn do1(cell: &TestController) -> bool {
    cell.value("DO[1]") == 1.0
}

#[test]
fn frames_are_found_in_any_pieces_and_in_garbage() {
    for bus in [rs485(), SimBus::TcpClient { to: String::new() }] {
        for cut in 0..=ON.len() {
            let mut cell = robot(&system_port(bus.clone()));
            cell.port_bytes(0, &ON[..cut]);
            cell.port_bytes(0, &ON[cut..]);
            assert!(do1(&cell), "cut at {cut}");
        }
        let mut cell = robot(&system_port(bus));
        let noise = [0x00, 0xFF, 0xEE, 0xFF, 0xFF, 0x7F];
        cell.port_bytes(0, &[&noise[..], &ON, &noise[..3], &OFF, &ON].concat());
        assert!(do1(&cell));
        let counters = cell.counters("p");
        assert_eq!((counters.frames_in, counters.skipped_bytes), (3, 9));
        assert!(counters.tail_mismatches > 0);
    }
}

#[test]
fn a_partial_frame_does_not_survive_silence() {
    let mut cell = robot(&system_port(rs485()));
    cell.port_bytes(0, &ON[..3]);
    cell.run_ms(49);
    cell.port_bytes(0, &ON[3..]);
    assert!(do1(&cell), "within the gap it does");
    cell.port_bytes(0, &OFF[..3]);
    cell.run_ms(50);
    cell.port_bytes(0, &OFF[3..]);
    assert!(do1(&cell), "it was dropped");
    assert_eq!(cell.counters("p").discarded_bytes, 3);
    cell.port_bytes(0, &OFF);
    assert!(!do1(&cell));
}

#[test]
fn invalid_values_are_rejected_or_masked() {
    let input = system(&["ForceEnd[1..6]", "DigitalOutputCommand[3]"]);
    let recipe = stream_recipe(Mode::Realtime, input, system(&["RobotState[14..19]"]));
    let mut cell = robot(&one_port(rs485(), recipe));
    let frame = |force: f32, bits: u8| {
        let floats = [force, 2.0, 3.0, 0.4, 0.5, 0.6].into_iter().flat_map(f32::to_le_bytes);
        [0xFF, 0xFF].into_iter().chain(floats).chain([bits, 0xEE, 0xEE]).collect::<Vec<u8>>()
    };
    cell.port_bytes(0, &frame(1.0, 0xFF));
    assert_eq!(cell.value("DigitalOutputCommand[3]"), 3.0, "six bits are reserved");
    assert_eq!((cell.value("RobotState[14]"), cell.value("RobotState[19]")), (1.0, f64::from(0.6_f32)));
    cell.port_bytes(0, &frame(f32::NAN, 0));
    assert_eq!(cell.value("DigitalOutputCommand[3]"), 3.0, "nothing of the frame is taken");
    let counters = cell.counters("p");
    assert_eq!((counters.masked_fields, counters.rejected_values), (1, 1));
    cell.state_client();
    cell.run_ms(100);
    assert_eq!(cell.packets[0].1.flange_force, [1.0, 2.0, 3.0, 0.4, 0.5, 0.6]);
}

#[test]
fn a_slow_line_skips_cycles_and_stays_on_the_grid() {
    let mut cell = robot(&system_port(rs485()));
    cell.line_time = Duration::from_micros(9_500);
    cell.run_ms(40);
    let times: Vec<_> = cell.sent.iter().map(|sent| sent.0.as_micros() - 1_000_000).collect();
    assert_eq!(times, [4_000, 16_000, 28_000, 40_000]);
    assert_eq!(cell.counters("p").skipped_cycles, 6);
    assert_eq!(cell.counters("p").frames_out, 4);
}

#[test]
fn a_late_call_never_sends_missed_cycles() {
    let mut cell = robot(&system_port(rs485()));
    cell.run_ms(1);
    cell.now += Duration::from_millis(14);
    cell.drain();
    assert_eq!(cell.sent.len(), 1);
    assert_eq!(cell.counters("p").skipped_cycles, 2);
    cell.run_ms(1);
    assert_eq!(cell.sent.last().unwrap().0, Instant::from_millis(1_016));
}

#[test]
fn a_half_duplex_line_is_driven_only_after_silence() {
    let mut cell = robot(&system_port(rs485()));
    cell.run(Duration::from_micros(3_900));
    cell.port_bytes(0, &ON[..2]);
    cell.run(Duration::from_micros(150));
    assert_eq!(cell.sent, [], "4 ms have come while a frame arrives");
    cell.port_bytes(0, &ON[2..]);
    cell.run_ms(4);
    let times: Vec<_> = cell.sent.iter().map(|sent| sent.0.as_micros() - 1_000_000).collect();
    assert_eq!(times, [4_350, 8_000], "300 µs after the last byte, then on the grid again");
    // Bytes that arrive while the port sends are accepted and counted.
    cell.port_bytes(0, &OFF);
    assert!(!do1(&cell));
    assert_eq!(cell.counters("p").bytes_while_sending, 5);
}

#[test]
fn datagrams_are_frames_or_nothing() {
    let mut cell = robot(&system_port(SimBus::UdpClient { to: String::new() }));
    cell.port_bytes(0, &[&ON[..], &ON].concat());
    cell.port_bytes(0, &ON[..4]);
    cell.port_bytes(0, &[0xFF, 0xFE, 1, 0xEE, 0xEE]);
    cell.port_bytes(0, &[0xFF, 0xFF, 1, 0xEE, 0xEF]);
    assert!(!do1(&cell));
    assert_eq!(cell.counters("p").wrong_datagrams, 4);
    cell.port_bytes(0, &ON);
    assert!(do1(&cell));
}

#[test]
fn the_udp_server_keeps_eight_clients_and_displaces_a_silent_one() {
    let mut cell = robot(&system_port(SimBus::UdpServer));
    for nth in 0..8 {
        cell.input(ControllerInput::Udp2011 { peer: peer(5_000 + nth), bytes: &[] });
        cell.run_ms(1);
    }
    cell.input(ControllerInput::Udp2011 { peer: peer(5_000), bytes: &[] });
    cell.input(ControllerInput::Udp2011 { peer: peer(6_000), bytes: &[] });
    cell.sent.clear();
    cell.run_ms(4);
    let mut clients: Vec<_> = cell
        .sent
        .iter()
        .map(|sent| match &sent.2 {
            Out::Datagram(peer, _) => peer.port(),
            other => panic!("{other:?}"),
        })
        .collect();
    clients.sort_unstable();
    assert_eq!(clients, [5_000, 5_002, 5_003, 5_004, 5_005, 5_006, 5_007, 6_000], "5001 was silent longest");
    for peer_port in 5_000..6_001 {
        cell.input(ControllerInput::Udp2011Unreachable { peer: peer(peer_port) });
    }
    cell.sent.clear();
    cell.run_ms(8);
    assert_eq!(cell.sent, []);
    let counters = cell.counters("p");
    assert_eq!((counters.clients_displaced, counters.clients_gone), (1, 8));

    let mut cell = robot(&SimConfig::default());
    cell.input(ControllerInput::Udp2011 { peer: peer(1), bytes: &ON });
    assert_eq!(cell.controller.counters().stray_datagrams, 1);
}

/// The receivers of datagrams since the last call.
fn streamed_to(cell: &mut TestController) -> Vec<u16> {
    let port = |sent: (Instant, usize, Out)| match sent.2 {
        Out::Datagram(peer, _) => peer.port(),
        other => panic!("{other:?}"),
    };
    std::mem::take(&mut cell.sent).into_iter().map(port).collect()
}

#[test]
fn a_udp_client_that_is_silent_for_a_minute_is_removed() {
    let mut cell = robot(&system_port(SimBus::UdpServer));
    let send = |cell: &mut TestController, from: u16, bytes: &[u8]| {
        cell.input(ControllerInput::Udp2011 { peer: peer(from), bytes });
    };
    send(&mut cell, 1, b"");
    send(&mut cell, 2, &ON);
    cell.run_ms(30_000);
    // Any datagram counts.
    send(&mut cell, 2, b"?");
    cell.run_ms(29_992);
    streamed_to(&mut cell);
    cell.run_ms(4);
    assert_eq!(streamed_to(&mut cell), [1, 2]);
    cell.run_ms(4);
    assert_eq!(streamed_to(&mut cell), [2], "a minute after its only datagram");
    cell.run_ms(29_996);
    assert!(streamed_to(&mut cell).iter().all(|&port| port == 2));
    cell.run_ms(1_000);
    assert!(streamed_to(&mut cell).is_empty());
    assert_eq!(cell.counters("p").clients_silent, 2);
    // A client that sends again is added at once.
    send(&mut cell, 1, b"");
    cell.run_ms(4);
    assert_eq!(streamed_to(&mut cell), [1]);
    // Silent clients are removed before one is displaced.
    cell.run_ms(60_000);
    for from in 10..18 {
        send(&mut cell, from, b"");
    }
    let counters = cell.counters("p");
    assert_eq!((counters.clients_silent, counters.clients_displaced), (3, 0));
}

#[test]
fn without_an_input_part_a_udp_client_has_nothing_to_send() {
    let mut config = system_port(SimBus::UdpServer);
    if let SimParts::Stream { input, .. } = &mut config.recipes[0].parts {
        *input = None;
    }
    let mut cell = robot(&config);
    cell.input(ControllerInput::Udp2011 { peer: peer(1), bytes: &[] });
    cell.run_ms(600_000);
    streamed_to(&mut cell);
    cell.run_ms(4);
    assert_eq!(streamed_to(&mut cell), [1]);
    cell.input(ControllerInput::Udp2011Unreachable { peer: peer(1) });
    cell.run_ms(4);
    assert!(streamed_to(&mut cell).is_empty());
    assert_eq!(cell.counters("p").clients_silent, 0);
}

#[test]
fn can_frames_of_no_recipe_are_counted_and_ignored() {
    let recipe = can_recipe(Mode::Realtime, vec![can(1, system(&["DigitalOutputCommand[1]"]))], vec![]);
    let mut cell = robot(&one_port(SimBus::Can { bitrate: 500_000 }, recipe));
    let send =
        |cell: &mut TestController, frame: CanFrame| cell.input(ControllerInput::PortCan { port: 0, frame });
    send(&mut cell, CanFrame::new(CanId::Standard(2), &[1]).unwrap());
    send(&mut cell, CanFrame::new(CanId::Extended(1), &[1]).unwrap());
    send(&mut cell, CanFrame::new(CanId::Standard(1), &[1; MAX_CAN_DATA]).unwrap());
    send(&mut cell, CanFrame::new(CanId::Standard(1), &[]).unwrap());
    send(&mut cell, CanFrame::remote(CanId::Standard(1), 1).unwrap());
    assert!(!do1(&cell));
    let counters = cell.counters("p");
    assert_eq!((counters.unknown_ids, counters.wrong_lengths, counters.remote_frames), (2, 2, 1));
    send(&mut cell, CanFrame::new(CanId::Standard(1), &[1]).unwrap());
    assert!(do1(&cell));
    cell.run_ms(20);
    assert_eq!(cell.sent, [], "there is no output part");
}

#[test]
fn an_idle_port_counts_bytes_and_does_nothing() {
    let mut config = system_port(rs485());
    config.ports[0].recipe = None;
    let mut cell = robot(&config);
    cell.port_bytes(0, &ON);
    cell.run_ms(20);
    assert!(!do1(&cell));
    assert_eq!((cell.sent.len(), cell.counters("p").unexpected_bytes), (0, 5));
    // An input for a port that does not exist is ignored.
    cell.port_bytes(7, &ON);
    cell.input(ControllerInput::PortUp { port: 7 });
    cell.input(ControllerInput::PortSent { port: 7 });
}

#[test]
fn a_recipe_that_a_port_cannot_carry_is_refused_by_name() {
    let stream = || stream_recipe(Mode::User, user(&[Byte]), user(&[Float]));
    let can = || can_recipe(Mode::Realtime, vec![can(1, system(&["DigitalOutputCommand[1]"]))], vec![]);
    let refused = |bus: SimBus, recipe| Controller::new(&one_port(bus, recipe)).unwrap_err().to_string();
    let tcp = || SimBus::TcpClient { to: String::new() };
    assert_eq!(refused(tcp(), stream()), "port p: TCP and UDP ports take realtime recipes only");
    assert_eq!(refused(SimBus::UdpServer, stream()), "port p: TCP and UDP ports take realtime recipes only");
    let kind = "port p: CAN ports take CAN recipes, all others stream recipes";
    assert_eq!(refused(rs485(), can()), kind);
    assert_eq!(refused(SimBus::Can { bitrate: 1 }, stream()), kind);
    let wrong_way = stream_recipe(Mode::Realtime, system(&["RobotState[1]"]), system(&["RobotState[1]"]));
    assert!(refused(rs485(), wrong_way).starts_with("port p: input part: "));
    let mut config =
        one_port(SimBus::UdpServer, stream_recipe(Mode::Realtime, system(&["ForceEnd[1]"]), vec![]));
    if let SimParts::Stream { output, .. } = &mut config.recipes[0].parts {
        *output = None;
    }
    config.ports.push(SimPort { name: "q".to_owned(), ..config.ports[0].clone() });
    let error = Controller::new(&config).unwrap_err().to_string();
    assert_eq!(error, "port q: another port is the UDP server already");
    let error = Controller::new(&with_program(SimConfig::default(), "x", "let = 1;")).unwrap_err();
    assert!(error.to_string().starts_with("program x: "), "{error}");
    let error = Controller::new(&with_initial(SimConfig::default(), &[("RobotState[1]", 7.0)])).unwrap_err();
    assert_eq!(error.to_string(), "RobotState[1]: a joint position is within ±6.2832 rad");
    let error = Controller::new(&with_dialect(SimConfig::default(), "v9")).unwrap_err();
    assert_eq!(error.to_string(), "there is no dialect v9; there are v2.3, v2.6");
}

#[test]
fn another_recipe_applies_at_once_and_drops_the_old_ones_bytes() {
    let mut config = system_port(SimBus::UdpServer);
    config.recipes.push(stream_recipe(
        Mode::Realtime,
        system(&["BitInputReg[1]"]),
        system(&["BitOutputReg[1]"]),
    ));
    config.recipes.push(stream_recipe(Mode::User, user(&[Byte]), user(&[Byte])));
    config.ports.push(SimPort { name: "q".to_owned(), bus: rs485(), ..config.ports[0].clone() });
    let mut cell = robot(&config);
    cell.input(ControllerInput::Udp2011 { peer: peer(1), bytes: &[] });
    cell.port_bytes(1, &ON[..3]);
    for port in [0, 1] {
        cell.controller.assign_recipe(cell.now, port, Some(1)).unwrap();
    }
    cell.sent.clear();
    cell.port_bytes(1, &ON[3..]);
    cell.port_bytes(1, &ON);
    assert_eq!((do1(&cell), cell.value("BitInputReg[1]")), (false, 1.0));
    cell.run_ms(4);
    let sent: Vec<_> = cell.sent.iter().map(|sent| (sent.1, sent.2.clone())).collect();
    assert_eq!(sent, [(1, Out::Bytes(vec![0xFF, 0xFF, 0, 0xFE, 0xFE]))], "UDP clients have to ask again");
    let refused = cell.controller.assign_recipe(cell.now, 0, Some(2));
    assert_eq!(refused, Err(RecipeError::UserOnNetwork));
    cell.input(ControllerInput::Udp2011 { peer: peer(1), bytes: &OFF });
    assert_eq!(cell.value("BitInputReg[1]"), 0.0, "it still has the one before");
    cell.controller.assign_recipe(cell.now, 1, None).unwrap();
    cell.sent.clear();
    cell.port_bytes(1, &ON);
    cell.run_ms(8);
    assert!(cell.sent.iter().all(|sent| sent.1 != 1));
    assert_eq!(cell.value("BitInputReg[1]"), 0.0);
}
