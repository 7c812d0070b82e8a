//! Which clients a full server accepts, and which it displaces.

use std::net::IpAddr;

use super::*;

fn host(nth: u8) -> IpAddr {
    Ipv4Addr::new(192, 168, 12, nth).into()
}

fn open(cell: &mut TestController, link: Link, from: IpAddr) -> ConnId {
    let conn = cell.new_conn();
    cell.input(match link {
        Link::Command => ControllerInput::CommandOpened { conn, from },
        Link::State => ControllerInput::StateOpened { conn, from },
        Link::Modbus => ControllerInput::ModbusOpened { conn, from },
    });
    conn
}

/// Clients of port 2000 from one host.
fn several(cell: &mut TestController, count: usize, from: IpAddr) -> Vec<ConnId> {
    (0..count).map(|_| open(cell, Link::Command, from)).collect()
}

#[test]
fn connections_are_bounded() {
    let mut cell = robot(&SimConfig::default());
    let conns = several(&mut cell, MAX_COMMAND_CONNECTIONS, CLIENT_ADDRESS);
    assert_eq!(cell.closed, []);
    let refused = cell.command_client();
    assert_eq!(cell.closed, [refused]);
    assert_eq!(cell.ask(refused, "state"), "");
    cell.input(ControllerInput::CommandClosed { conn: conns[0] });
    let taken = cell.command_client();
    assert_eq!(cell.ask(taken, "state"), "6:0:5:2");
    let counters = cell.controller.counters().command;
    assert_eq!((counters.opened, counters.refused, counters.open), (33, 1, 32));
}

#[test]
fn an_idle_client_is_displaced_by_one_with_requests() {
    let mut cell = robot(&SimConfig::default());
    let good = cell.command_client();
    let idle = several(&mut cell, MAX_COMMAND_CONNECTIONS - 1, CLIENT_ADDRESS);
    cell.run_ms(1_000);
    assert_eq!(cell.ask(good, "state"), "6:0:5:2");
    // Single bytes are not a complete request.
    cell.input(ControllerInput::CommandBytes { conn: idle[0], bytes: b"run(" });
    cell.run_ms(3_999);
    let early = cell.command_client();
    assert_eq!(cell.closed, [early], "they may be about to ask");
    cell.run_ms(1);
    let new = cell.command_client();
    assert_eq!(cell.closed, [early, idle[0]]);
    assert_eq!(cell.ask(new, "state"), "6:0:5:2");
    assert_eq!(cell.ask(good, "state"), "6:0:5:2");
    let counters = cell.controller.counters().command;
    assert_eq!((counters.displaced, counters.refused, counters.open), (1, 1, MAX_COMMAND_CONNECTIONS));
}

#[test]
fn clients_with_one_request_are_displaced_for_the_next_ones_stop() {
    let config = with_program(SimConfig::default(), "t", "loop { wait_ms(10); }");
    let mut cell = robot(&config);
    let mut clients = several(&mut cell, MAX_COMMAND_CONNECTIONS, CLIENT_ADDRESS);
    assert_eq!(cell.ask(clients[0], "run(t)"), "run start");
    for &conn in &clients[1..] {
        cell.run_ms(10);
        assert_eq!(cell.ask(conn, "isprogfinish"), "0");
    }
    // The first client remains active; the second has the oldest request.
    cell.run_ms(4_000);
    assert_eq!(cell.ask(clients[0], "isprogfinish"), "0");
    cell.run_ms(1_000);
    let new = cell.command_client();
    assert_eq!(cell.closed, [clients[1]]);
    assert_eq!(cell.order(new, "stop"), "stop success");
    // A client that never sent a request is displaced first.
    let silent = cell.command_client();
    assert_eq!(cell.closed, [clients[1], clients[2]]);
    cell.run_ms(5_000);
    cell.command_client();
    assert_eq!(cell.closed[2..], [silent]);
    // Active clients are not displaced, however many connect.
    clients.drain(1..3);
    clients.push(new);
    for &conn in &clients {
        assert_eq!(cell.ask(conn, "isprogfinish"), "1");
    }
    let closed = cell.closed.len();
    for _ in 0..100 {
        cell.run_ms(40);
        cell.command_client();
    }
    let still = clients.iter().filter(|conn| !cell.closed.contains(conn)).count();
    assert_eq!(still, clients.len(), "4 s ago is not long ago");
    assert_eq!(cell.closed.len(), closed + 100);
}

#[test]
fn a_client_that_waits_for_an_answer_is_not_idle() {
    let mut cell = robot(&with_power(SimConfig::default(), Power::Off));
    cell.controller.delay_transitions(Duration::from_secs(60));
    let waits = cell.command_client();
    assert_eq!(cell.ask(waits, "poweron"), "");
    assert_eq!(cell.ask(waits, "state"), "");
    let others = several(&mut cell, MAX_COMMAND_CONNECTIONS - 1, CLIENT_ADDRESS);
    for _ in 0..7 {
        cell.run_ms(1_000);
        for &conn in &others {
            cell.ask(conn, "isprogfinish");
        }
    }
    // Answered with fail two seconds ago.
    let refused = cell.command_client();
    assert_eq!(cell.closed, [refused]);
    cell.run_ms(3_000);
    for &conn in &others {
        cell.ask(conn, "isprogfinish");
    }
    cell.command_client();
    assert_eq!(cell.closed, [refused, waits]);
}

#[test]
fn a_host_with_many_connections_displaces_its_own_and_is_displaced_by_others() {
    let mut cell = robot(&SimConfig::default());
    // Two idle clients of another host, such as a gateway without values to write.
    let gateway = several(&mut cell, 2, host(1));
    cell.run_ms(60_000);
    several(&mut cell, MAX_COMMAND_CONNECTIONS - 2, host(2));
    let (mut newest, mut refused) = (Vec::new(), 0);
    for _ in 0..1_000 {
        let conn = open(&mut cell, Link::Command, host(2));
        refused += usize::from(cell.closed.contains(&conn));
        newest.push(conn);
        cell.run_ms(20);
    }
    assert!(gateway.iter().all(|conn| !cell.closed.contains(conn)), "not its, though it is idle longer");
    assert!(refused < 1_000 && cell.closed.len() > refused, "its own make room when they are idle");

    // Active clients only prevent further ones of their own host.
    let mut cell = robot(&SimConfig::default());
    let gateway = several(&mut cell, 2, host(1));
    cell.ask(gateway[0], "state");
    let busy = several(&mut cell, MAX_COMMAND_CONNECTIONS - 2, host(2));
    let ask_all = |cell: &mut TestController| {
        for &conn in &busy {
            cell.ask(conn, "isprogfinish");
        }
    };
    ask_all(&mut cell);
    let own = open(&mut cell, Link::Command, host(2));
    assert_eq!(cell.closed, [own]);
    cell.run_ms(10);
    ask_all(&mut cell);
    let panel = open(&mut cell, Link::Command, host(3));
    assert_eq!(cell.closed, [own, busy[0]], "more than half of all places are its");
    assert_eq!(cell.ask(panel, "state"), "6:0:5:2");
    assert_eq!(cell.ask(gateway[1], "state"), "6:0:5:2");
}

#[test]
fn an_active_host_with_its_share_is_not_displaced() {
    let mut cell = robot(&SimConfig::default());
    let half = several(&mut cell, MAX_COMMAND_CONNECTIONS / 2, host(1));
    let other_half = several(&mut cell, MAX_COMMAND_CONNECTIONS / 2, host(2));
    for nth in 0..100 {
        cell.run_ms(50);
        for &conn in half.iter().chain(&other_half) {
            cell.ask(conn, "isprogfinish");
        }
        let new = open(&mut cell, Link::Command, host(3 + nth));
        assert_eq!(cell.closed.last(), Some(&new));
    }
    assert_eq!(cell.closed.len(), 100);
}

#[test]
fn the_state_stream_and_modbus_have_the_same_rules() {
    // A client of port 2001 never sends a request, but is not idle.
    let mut cell = robot(&SimConfig::default());
    let listeners: Vec<_> =
        (0..MAX_STATE_CONNECTIONS).map(|_| open(&mut cell, Link::State, host(1))).collect();
    cell.run_ms(60_000);
    let own = open(&mut cell, Link::State, host(1));
    assert_eq!(cell.closed, [own]);
    // But a new host displaces a client of the host that has most.
    open(&mut cell, Link::State, host(2));
    assert_eq!(cell.closed, [own, listeners[0]]);
    assert_eq!(cell.controller.counters().state.open, MAX_STATE_CONNECTIONS);

    let mut cell = robot(&SimConfig::default());
    let masters: Vec<_> =
        (0..MAX_MODBUS_CONNECTIONS).map(|_| open(&mut cell, Link::Modbus, host(1))).collect();
    cell.run_ms(5_000);
    for &conn in &masters[1..] {
        cell.modbus(conn, &[3, 0, 1, 0, 1]);
    }
    let new = open(&mut cell, Link::Modbus, host(1));
    assert_eq!(cell.closed, [masters[0]]);
    assert_eq!(cell.modbus(new, &[3, 0, 1, 0, 1]), [3, 2, 0, 6]);
}
