//! The knobs: what a gateway meets when a controller misbehaves.

use proto_core::modbus::Exception;

use super::*;

#[test]
fn a_mute_server_carries_out_and_says_nothing() {
    let mut cell = Cell::new(&with_power(SimConfig::default(), Power::Off));
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
fn a_refusing_server_closes_what_comes() {
    let mut cell = Cell::new(&SimConfig::default());
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
    let mut cell = Cell::new(&config);
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

    // Or the newest only: what the first one waits for gets lost with it.
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

    // It outlives a restart.
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
    let mut cell = Cell::new(&SimConfig::default());
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
fn delayed_answers_keep_their_order_and_die_with_their_connection() {
    let mut cell = Cell::new(&SimConfig::default());
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
    let mut cell = Cell::new(&SimConfig::default());
    let (a, b) = (cell.state_client(), cell.state_client());
    cell.run_ms(100);
    assert_eq!(cell.packets.len(), 1);
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
    let mut cell = Cell::new(&with_initial(config, &[("WordOutputReg[1]", 7.0)]));
    let (c, s, m) = (cell.command_client(), cell.state_client(), cell.modbus_client());
    cell.ask(c, "run(t)");
    cell.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
    cell.modbus(m, &[6, 0, 8, 0, 4]);
    cell.controller.restart(cell.now);
    cell.drain();
    assert_eq!(cell.closed, [c, s, m]);
    assert!(cell.sent.contains(&(cell.now, 1, Out::Closed)));
    let values = ["DO[1]", "WordInputReg[1]", "WordOutputReg[1]"].map(|name| value(&cell, name));
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
    // The serial line goes on, the TCP client waits for its connection.
    cell.sent.clear();
    cell.run_ms(4);
    assert_eq!(cell.sent.iter().map(|sent| sent.1).collect::<Vec<_>>(), [0]);
}

#[test]
fn a_mute_port_goes_on_receiving() {
    let recipe =
        stream_recipe(Mode::Realtime, system(&["DigitalOutputCommand[1]"]), system(&["RobotState[8..11]"]));
    let mut cell = Cell::new(&one_port(SimBus::TcpClient { to: String::new() }, recipe));
    cell.controller.mute_port(0);
    cell.run_ms(40);
    assert_eq!(cell.sent, []);
    cell.port_bytes(0, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]);
    assert_eq!(value(&cell, "DO[1]"), 1.0);
    cell.controller.unmute_port(0);
    cell.run_ms(8);
    assert_eq!(cell.sent.len(), 2);
    cell.controller.close_port(0);
    cell.drain();
    assert_eq!(cell.sent.last().unwrap().2, Out::Closed);
}
