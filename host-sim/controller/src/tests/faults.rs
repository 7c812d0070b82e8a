//! Faults: what a gateway sees of a controller that misbehaves.

use proto_core::modbus::Exception;

use super::*;

#[test]
fn a_mute_server_carries_out_requests_without_answers() {
    let mut cell = robot(&with_power(SimConfig::default(), Power::Off));
    let (c, m, _) = (cell.command_client(), cell.modbus_client(), cell.state_client());
    for link in [Link::Command, Link::Modbus, Link::State] {
        cell.controller.mute(link);
    }
    assert_eq!(cell.ask(c, "poweron"), "");
    cell.input(ControllerInput::ModbusBytes { conn: m, bytes: &[0, 1, 0, 0, 0, 6, 1, 5, 0, 192, 0xFF, 0] });
    assert_eq!(cell.take(m), b"");
    cell.run_ms(300);
    assert_eq!(cell.packets, []);
    for link in [Link::Command, Link::Modbus, Link::State] {
        cell.controller.unmute(link);
    }
    assert_eq!(cell.ask(c, "state"), "5:0:5:2");
    assert_eq!(cell.modbus(m, &[1, 0, 192, 0, 1]), [1, 1, 1]);
    cell.run_ms(100);
    assert_eq!(cell.packets.len(), 1);
    let counters = cell.controller.counters();
    assert_eq!((counters.command.muted, counters.modbus.muted, counters.state.muted), (1, 1, 3));
}

#[test]
fn a_refusing_server_closes_new_connections() {
    let mut cell = robot(&SimConfig::default());
    cell.controller.refuse(Link::Modbus);
    let refused = cell.modbus_client();
    assert_eq!(cell.closed, [refused]);
    let c = cell.command_client();
    assert_eq!(cell.ask(c, "isprogfinish"), "1", "the other servers are as they were");
    cell.controller.accept(Link::Modbus);
    let m = cell.modbus_client();
    assert_eq!(cell.modbus(m, &[3, 0, 1, 0, 1]), [3, 2, 0, 6]);
    cell.controller.disconnect(Link::Command);
    cell.drain();
    assert_eq!(cell.closed, [refused, c]);
}

#[test]
fn port_2000_may_take_one_client_only() {
    let mut config = with_power(SimConfig::default(), Power::Off);
    config.robot.command_clients = CommandClients::RefuseSecond;
    let mut cell = robot(&config);
    let first = cell.command_client();
    let second = cell.command_client();
    assert_eq!(cell.closed, [second]);
    assert_eq!(cell.ask(second, "state"), "");
    assert_eq!(cell.order(first, "poweron"), "poweron success");
    let (m, s) = (cell.modbus_client(), cell.state_client());
    assert_eq!(cell.modbus(m, &[3, 0, 1, 0, 1]), [3, 2, 0, 5], "the other servers are as they were");
    cell.modbus_client();
    cell.input(ControllerInput::CommandClosed { conn: first });
    let third = cell.command_client();
    assert_eq!(cell.ask(third, "state"), "5:0:5:2");
    cell.run_ms(60_000);
    let fourth = cell.command_client();
    assert_eq!(cell.closed, [second, fourth], "nor does an idle one make room");

    // Or the newest only: the answer that the first one waits for is dropped with it.
    cell.controller.command_clients(CommandClients::DropFirst);
    cell.ask(third, "enable");
    let fifth = cell.command_client();
    assert_eq!(cell.closed, [second, fourth, third]);
    cell.run_ms(200);
    assert_eq!(cell.ask(fifth, "state"), "6:0:5:2");
    assert_eq!(cell.take(third), b"");
    let counters = cell.controller.counters().command;
    assert_eq!((counters.refused, counters.displaced, counters.open), (2, 1, 1));
    cell.controller.refuse(Link::Command);
    let refused = cell.command_client();
    assert_eq!(cell.closed.last(), Some(&refused), "refused before it could displace anybody");
    cell.controller.accept(Link::Command);

    // It remains after a restart.
    cell.controller.restart(cell.now);
    cell.drain();
    assert!(cell.closed.ends_with(&[fifth, s, m, ConnId(6)]), "{:?}", cell.closed);
    let (a, b) = (cell.command_client(), cell.command_client());
    assert_eq!((cell.ask(a, "isprogfinish").as_str(), cell.ask(b, "isprogfinish").as_str()), ("", "1"));
    cell.controller.command_clients(CommandClients::Many);
    let c = cell.command_client();
    assert_eq!((cell.ask(b, "isprogfinish").as_str(), cell.ask(c, "isprogfinish").as_str()), ("1", "1"));
}

#[test]
fn modbus_answers_with_an_exception_and_changes_nothing() {
    let mut cell = robot(&SimConfig::default());
    let m = cell.modbus_client();
    cell.controller.answer_modbus_with(Some(Exception::DeviceBusy));
    assert_eq!(cell.modbus(m, &[5, 0, 192, 0xFF, 0]), [0x85, 6]);
    assert_eq!(cell.modbus(m, &[3, 0, 0, 0, 4]), [0x83, 6]);
    assert_eq!(cell.modbus(m, &[6, 0, 8, 0, 4]), [0x86, 6]);
    cell.controller.answer_modbus_with(None);
    assert_eq!(cell.modbus(m, &[1, 0, 192, 0, 1]), [1, 1, 0]);
    assert_eq!(cell.modbus(m, &[3, 0, 8, 0, 1]), [3, 2, 0, 0]);
    assert_eq!(cell.controller.counters().modbus.refusals, 3);
}

#[test]
fn delayed_answers_keep_their_order_and_are_dropped_with_their_connection() {
    let mut cell = robot(&SimConfig::default());
    let (c, d) = (cell.command_client(), cell.command_client());
    cell.controller.delay_answers(Link::Command, Duration::from_millis(250));
    assert_eq!(cell.ask(c, "state"), "");
    assert_eq!(cell.ask(d, "state"), "");
    cell.run_ms(100);
    assert_eq!(cell.ask(c, "isprogfinish"), "");
    cell.input(ControllerInput::CommandClosed { conn: d });
    cell.run_ms(149);
    assert_eq!(cell.take(c), b"");
    cell.run_ms(1);
    assert_eq!(cell.take(c), b"6:0:5:2");
    cell.run_ms(100);
    assert_eq!(cell.take(c), b"1");
    assert_eq!(cell.take(d), b"");
    assert_eq!(cell.ask(c, "state"), "");
    cell.controller.delay_answers(Link::Command, Duration::ZERO);
    assert_eq!(cell.ask(c, "isprogfinish"), "", "it does not overtake");
    cell.run_ms(250);
    assert_eq!(cell.take(c), b"6:0:5:21");
    assert_eq!(cell.ask(c, "isprogfinish"), "1");
}

#[test]
fn half_a_state_packet_is_the_last_of_its_connection() {
    let mut cell = robot(&SimConfig::default());
    let (a, b) = (cell.state_client(), cell.state_client());
    cell.run_ms(100);
    assert_eq!((cell.take(a).len(), cell.take(b).len()), (1_468, 1_468));
    cell.controller.cut_next_state_packet(734);
    cell.run_ms(100);
    assert_eq!(cell.packets.len(), 1);
    assert_eq!((cell.take(a).len(), cell.take(b).len()), (734, 734));
    assert_eq!(cell.closed, [a, b]);
    cell.state_client();
    cell.run_ms(100);
    assert_eq!(cell.packets.len(), 2);
}

#[test]
fn a_restart_closes_everything_and_boots_to_power_off() {
    let recipe =
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..11]"]));
    let mut config = with_program(one_port(rs485(), recipe), "t", "loop { wait_ms(10); }");
    let tcp = SimBus::TcpClient { to: String::new() };
    config.ports.push(SimPort { name: "q".to_owned(), bus: tcp, ..config.ports[0].clone() });
    let mut cell = robot(&with_initial(config, &[("WordOutputReg[1]", 7.0)]));
    let (c, s, m) = (cell.command_client(), cell.state_client(), cell.modbus_client());
    cell.ask(c, "run(t)");
    cell.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
    cell.modbus(m, &[6, 0, 8, 0, 4]);
    cell.controller.restart(cell.now);
    cell.drain();
    assert_eq!(cell.closed, [c, s, m]);
    assert!(cell.sent.contains(&(cell.now, 1, Out::Closed)));
    let values = ["DO[1]", "WordInputReg[1]", "WordOutputReg[1]"].map(|name| cell.value(name));
    assert_eq!(values, [0.0, 0.0, 7.0]);
    let c = cell.command_client();
    let mut states = Vec::new();
    for _ in 0..80 {
        let state = cell.ask(c, "state");
        if states.last() != Some(&state) {
            states.push(state);
        }
        cell.run_ms(10);
    }
    assert_eq!(states, ["0:0:13:2", "1:0:0:2", "2:0:0:2", "3:0:0:2", "4:0:4:2"]);
    assert_eq!(cell.order(c, "poweron"), "poweron success");
    // The serial line continues; the TCP client port waits for its connection.
    cell.sent.clear();
    cell.run_ms(4);
    assert_eq!(cell.sent.iter().map(|sent| sent.1).collect::<Vec<_>>(), [0]);
}

#[test]
fn a_mute_port_goes_on_receiving() {
    let recipe =
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..11]"]));
    let mut cell = robot(&one_port(SimBus::TcpClient { to: String::new() }, recipe));
    cell.controller.mute_port(0);
    cell.run_ms(40);
    assert_eq!(cell.sent, []);
    cell.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
    assert_eq!(cell.value("DO[1]"), 1.0);
    cell.controller.unmute_port(0);
    cell.run_ms(8);
    assert_eq!(cell.sent.len(), 2);
    cell.controller.close_port(0);
    cell.drain();
    assert_eq!(cell.sent.last().unwrap().2, Out::Closed);
}

#[test]
fn floats_can_be_sent_with_other_values() {
    let recipe = stream_recipe(
        Mode::Realtime,
        system(&["DigitalOutputCommand[1]"]),
        system(&["RobotState[8..9]", "FloatOutputReg[1]"]),
    );
    let config = one_port(SimBus::TcpClient { to: String::new() }, recipe);
    let values = [("RobotState[9]", 0.5), ("FloatOutputReg[1]", 2.5), ("AI_V[1]", 3.5), ("ToolAI[2]", 4.5)];
    let mut cell = robot(&with_initial(config, &values));
    cell.state_client();
    cell.run_ms(100);
    let honest = cell.packets[0].1;
    let odd = f32::from_bits(0xFFC1_2345);
    assert!(odd.is_nan());
    let c = &mut cell.controller;
    c.corrupt("FloatOutputReg[1]", 7.0).unwrap();
    let all = [
        ("__RobotState_8", odd),
        ("FloatOutputReg[1]", f32::INFINITY),
        ("AI_V[1]", f32::NEG_INFINITY),
        ("ToolAI[2]", f32::MIN_POSITIVE / 2.0),
        ("joint_torque[7]", f32::NAN),
        ("RobotState[26]", f32::NAN),
    ];
    for (name, instead) in all {
        c.corrupt(name, instead).unwrap();
    }
    cell.sent.clear();
    cell.run_ms(100);
    let packet = cell.packets[1].1;
    assert_eq!(packet.tcp_pose[0].to_bits(), 0xFFC1_2345, "bit for bit");
    assert_eq!((packet.float_outputs[0], packet.analog_inputs[4]), (f32::INFINITY, f32::NEG_INFINITY));
    assert_eq!(packet.tool_analog_inputs, [0.0, f32::MIN_POSITIVE / 2.0]);
    assert!(packet.joint_torque[6].is_nan());
    // Everything else is unchanged.
    let mut rest = packet;
    rest.tcp_pose[0] = honest.tcp_pose[0];
    rest.float_outputs[0] = 2.5;
    rest.analog_inputs[4] = 3.5;
    rest.tool_analog_inputs[1] = 4.5;
    rest.joint_torque[6] = 0.0;
    assert_eq!(rest, honest);
    let Out::Bytes(frame) = &cell.sent[0].2 else { panic!("{:?}", cell.sent[0]) };
    let expected = [0xFFC1_2345_u32, 0.5_f32.to_bits(), f32::INFINITY.to_bits()].map(u32::to_le_bytes);
    assert_eq!(frame[2..14], expected.concat());
    // The values themselves are unchanged, and Modbus returns them.
    assert_eq!(cell.value("FloatOutputReg[1]"), 2.5);
    let m = cell.modbus_client();
    let x = (honest.tcp_pose[0] * 10_000.0).round() as i16;
    assert_eq!(cell.modbus(m, &[3, 0, 106, 0, 1])[2..], x.to_be_bytes());

    for (name, _) in all {
        cell.controller.heal(name).unwrap();
    }
    cell.sent.clear();
    cell.run_ms(100);
    assert_eq!(cell.packets[2].1, honest);
    let Out::Bytes(frame) = &cell.sent[0].2 else { panic!("{:?}", cell.sent[0]) };
    assert_eq!(frame[6..14], [0.5_f32, 2.5].map(f32::to_le_bytes).concat());

    for wrong in [
        "RobotState[33]",
        "WordOutputReg[1]",
        "DI[1]",
        "joint_torque[8]",
        "joint_torque[0]",
        "drive_error[1]",
        "robot_state",
        "x",
    ] {
        let error = cell.controller.corrupt(wrong, 1.0).unwrap_err();
        assert_eq!(error, NoSuchFloat(wrong.to_owned()));
        assert!(cell.controller.heal(wrong).is_err());
    }
    cell.run_ms(100);
    assert_eq!(cell.packets[3].1, honest);
}

#[test]
fn a_restart_brings_initial_values_back_or_not() {
    let set = [
        ("WordOutputReg[1]", 7.0),
        ("BitOutputReg[3]", 5.0),
        ("FloatInputReg[2]", 1.5),
        ("DO[1]", 1.0),
        ("ToolDO[2]", 1.0),
        ("FDO[1]", 1.0),
        ("ForceEnd[1]", 3.0),
    ];
    let wired = [("DI[3]", 1.0), ("AI_V[1]", 2.5), ("RobotState[20]", 0.25), ("RobotState[26]", 1.5)];
    let config = with_initial(SimConfig::default(), &[&set[..], &wired].concat());
    let mut cell = robot(&config);
    let m = cell.modbus_client();
    cell.modbus(m, &[6, 0, 8, 0, 4]);
    cell.modbus(m, &[6, 0, 80, 0, 9]);
    let now = |cell: &TestController, all: &[(&str, f64)]| {
        all.iter().map(|(name, _)| cell.value(name)).collect::<Vec<_>>()
    };
    let as_set = |all: &[(&str, f64)]| all.iter().map(|item| item.1).collect::<Vec<_>>();
    cell.controller.restart(cell.now);
    cell.drain();
    assert_eq!(now(&cell, &set), as_set(&set));
    assert_eq!(cell.value("WordInputReg[1]"), 0.0, "what was written is gone");
    cell.controller.restart_cleared(cell.now);
    cell.drain();
    assert_eq!(now(&cell, &set), [0.0; 7]);
    assert_eq!(now(&cell, &wired), as_set(&wired));
    let status = ["DigitalSignalStatus[4]", "DigitalSignalStatus[6]", "DigitalSignalStatus[8]"];
    assert_eq!(status.map(|name| cell.value(name)), [0.0; 3], "outputs show it");
    assert_eq!(cell.value("RobotState[14]"), 0.0, "no force");
    let m = cell.modbus_client();
    assert_eq!(cell.modbus(m, &[3, 0, 80, 0, 1]), [3, 2, 0, 0]);
    let c = cell.command_client();
    assert_eq!(cell.ask(c, "state"), "0:0:13:2", "it starts");
}
