//! The simulated controller on real sockets: what the runtime adds to the state machine, and what it refuses.

use std::io::{Read, Write};
use std::net::{TcpListener as StdListener, TcpStream as StdStream, UdpSocket as StdUdp};
use std::os::unix::fs::OpenOptionsExt;
use std::time::{Duration as StdDuration, Instant as StdInstant};

use proto_core::wire::state;
use tokio::io::AsyncReadExt;
use tokio::net::TcpSocket;
use tokio::task::LocalSet;

use super::*;
use recipe_config::file::load_controller;
use recipe_controller::{MAX_COMMAND_CONNECTIONS, MAX_STATE_CONNECTIONS};
use recipe_test_kit::{PATIENCE, SERVERS};

/// An example file, on free ports.
fn example(name: &str, overrides: &[&str]) -> SimConfig {
    let free = SERVERS.map(|server| format!("listen.{server}=0"));
    let all: Vec<String> = free.into_iter().chain(overrides.iter().map(|text| (*text).to_owned())).collect();
    load_controller(&recipe_test_kit::example(name), &all).unwrap()
}

fn bind(text: &str) -> Vec<Bind> {
    vec![text.parse().unwrap()]
}

fn connect(handle: &Handle, name: &str) -> StdStream {
    let stream = StdStream::connect(handle.place(name)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

#[track_caller]
fn ask(stream: &mut StdStream, request: &[u8], answer: &[u8]) {
    stream.write_all(request).unwrap();
    let mut got = vec![0; answer.len()];
    stream.read_exact(&mut got).unwrap();
    assert_eq!(String::from_utf8_lossy(&got), String::from_utf8_lossy(answer));
}

/// Waits until the counters are as expected, and returns them.
#[track_caller]
fn wait_for(handle: &Handle, wanted: impl Fn(&Value) -> bool) -> Value {
    let end = StdInstant::now() + PATIENCE;
    loop {
        let stats = handle.stats().expect("the controller has ended");
        if wanted(&stats) {
            return stats;
        }
        assert!(StdInstant::now() < end, "it never became so: {stats}");
        std::thread::sleep(StdDuration::from_millis(1));
    }
}

/// Whether the peer has closed the connection, by an end or a reset.
fn is_closed(stream: &mut StdStream) -> bool {
    !matches!(stream.read(&mut [0; 16]), Ok(1..))
}

/// Runs a test in the controller's own runtime, with access to its state.
fn inside(config: SimConfig, test: impl AsyncFnOnce(&Rc<ControllerRuntime>, &Value)) {
    let executor = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&executor, async {
        let running = RunningController::open(config, ControllerOptions::default()).await.unwrap();
        let (runtime, ready) = (Rc::clone(&running.runtime), running.ready.clone());
        tokio::select! {
            ended = running.run() => panic!("{ended:?}"),
            () = test(&runtime, &ready) => {}
            () = tokio::time::sleep(PATIENCE) => panic!("the test hangs"),
        }
    });
}

#[test]
fn the_two_example_ports_of_the_controller_answer() {
    let handle = start(example("udp-server-controller.toml", &[]), Vec::new()).unwrap();
    ask(&mut connect(&handle, "command"), b"state", b"6:0:5:2");
    let mut states = connect(&handle, "state");
    let mut packets = vec![0; 3 * state::LEN];
    states.read_exact(&mut packets).unwrap();
    for packet in packets.chunks(state::LEN) {
        assert_eq!(packet[1448..1452], [2, 6, 0, 5]);
    }
    // FC 3, holding registers 0..4, and FC 5 on coil 192, in one segment, with the second one truncated.
    let mut modbus = connect(&handle, "modbus");
    modbus.write_all(&[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 4, 0, 2, 0, 0, 0, 6, 1, 5, 0]).unwrap();
    modbus.write_all(&[192, 0xFF, 0]).unwrap();
    let mut answers = [0; 29];
    modbus.read_exact(&mut answers).unwrap();
    assert_eq!(answers[..17], [0, 1, 0, 0, 0, 11, 1, 3, 8, 0, 2, 0, 6, 0, 0, 0, 5]);
    assert_eq!(answers[17..], [0, 2, 0, 0, 0, 6, 1, 5, 0, 192, 0xFF, 0]);
    let stats = handle.stats().unwrap();
    assert_eq!(stats["registers"]["DigitalOutputCommand[1]"], 1.0);
    assert_eq!(stats["modbus"]["open"], 1);
    drop(modbus);
    wait_for(&handle, |stats| stats["modbus"]["open"] == 0);
}

#[test]
fn a_state_client_that_reads_nothing_for_two_seconds_is_dropped_and_others_lose_nothing() {
    inside(example("udp-server-controller.toml", &[]), async |runtime, ready| {
        let at: SocketAddr = ready["state"].as_str().unwrap().parse().unwrap();
        let slow = TcpSocket::new_v4().unwrap();
        slow.set_recv_buffer_size(4_096).unwrap();
        let _slow = slow.connect(at).await.unwrap();
        let mut good = tokio::net::TcpStream::connect(at).await.unwrap();
        let packet = [0x5A; state::LEN];
        let mut whole = vec![0; state::LEN];
        // The other client reads whole packets while the buffers of the slow one fill.
        let blocked_at = loop {
            good.read_exact(&mut whole).await.unwrap();
            let slow =
                runtime.connections.borrow().values().find_map(|client| client.connection.blocked_since());
            if let Some(since) = slow {
                break since;
            }
            runtime.send_state(&packet, now());
        };
        let patient = blocked_at + STATE_TIMEOUT - Duration::from_micros(1);
        runtime.send_state(&packet, patient);
        assert_eq!(runtime.counters.get().slow_clients, 0);
        assert!(runtime.counters.get().skipped_state_packets > 0);
        runtime.send_state(&packet, blocked_at + STATE_TIMEOUT);
        runtime.drain(now());
        assert_eq!(runtime.counters.get().slow_clients, 1);
        assert_eq!(runtime.controller.borrow().counters().state.open, 1);
        assert_eq!(runtime.connections.borrow().len(), 1);
        for _ in 0..3 {
            good.read_exact(&mut whole).await.unwrap();
        }
    });
}

#[test]
fn a_client_that_does_not_read_answers_is_not_read_and_loses_nothing() {
    let handle = start(example("udp-server-controller.toml", &[]), Vec::new()).unwrap();
    let mut modbus = connect(&handle, "modbus");
    modbus.set_nonblocking(true).unwrap();
    // Read 118 registers: 12 bytes ask for 245.
    let request = |transaction: u32| {
        let [high, low] = (transaction as u16).to_be_bytes();
        [high, low, 0, 0, 0, 6, 1, 3, 0, 0, 0, 118]
    };
    let mut asked = 0_u32;
    let mut rest = Vec::new();
    // Until the buffers of both sides are full.
    let mut answered = None;
    loop {
        if rest.is_empty() {
            rest.extend_from_slice(&request(asked));
            asked += 1;
        }
        match modbus.write(&rest) {
            Ok(count) => {
                rest.drain(..count);
                answered = None;
            }
            Err(error) => {
                assert_eq!(error.kind(), std::io::ErrorKind::WouldBlock);
                let requests = handle.stats().unwrap()["modbus"]["requests"].clone();
                if answered.replace(requests.clone()) == Some(requests) {
                    break;
                }
            }
        }
        assert!(asked < 3_000_000, "taken without bound");
    }
    // Another client is still served.
    let mut other = connect(&handle, "modbus");
    ask(&mut other, &[9, 9, 0, 0, 0, 6, 1, 3, 0, 1, 0, 1], &[9, 9, 0, 0, 0, 5, 1, 3, 2, 0, 6]);
    modbus.set_nonblocking(false).unwrap();
    let mut sender = modbus.try_clone().unwrap();
    let writer = std::thread::spawn(move || sender.write_all(&rest).unwrap());
    let mut answer = [0; 245];
    for transaction in 0..asked {
        modbus.read_exact(&mut answer).unwrap();
        assert_eq!(answer[..2], (transaction as u16).to_be_bytes());
    }
    writer.join().unwrap();
}

#[test]
fn of_too_many_closed_connections_that_still_send_the_oldest_is_aborted() {
    inside(example("udp-server-controller.toml", &[]), async |runtime, ready| {
        let at: SocketAddr = ready["command"].as_str().unwrap().parse().unwrap();
        let mut peers = Vec::new();
        for _ in 0..MAX_LINGERING + 3 {
            let peer = TcpSocket::new_v4().unwrap();
            peer.set_recv_buffer_size(4_096).unwrap();
            peers.push(peer.connect(at).await.unwrap());
        }
        while runtime.connections.borrow().len() < peers.len() {
            tokio::task::yield_now().await;
        }
        let conns: Vec<_> = runtime.connections.borrow().keys().copied().collect();
        for &conn in &conns {
            // Unread answers, until some wait in this process.
            let connection = Rc::clone(&runtime.connections.borrow()[&conn].connection);
            while connection.send(&[0; 4_096]) == Accepted::All {}
            runtime.execute(ControllerOutput::Close { conn });
        }
        assert_eq!(runtime.lingering.borrow().len(), MAX_LINGERING);
        assert_eq!(runtime.counters.get().cut_answers, 3);
        assert!(runtime.connections.borrow().is_empty());
        // The others end when their peers close.
        drop(peers);
        while !runtime.lingering.borrow().is_empty() {
            tokio::task::yield_now().await;
        }
    });
}

#[test]
fn one_client_too_many_is_refused() {
    let handle = start(example("udp-server-controller.toml", &[]), Vec::new()).unwrap();
    for (name, most) in [("command", MAX_COMMAND_CONNECTIONS), ("state", MAX_STATE_CONNECTIONS)] {
        let mut clients: Vec<_> = (0..most).map(|_| connect(&handle, name)).collect();
        wait_for(&handle, |stats| stats[name]["open"] == most);
        assert!(is_closed(&mut connect(&handle, name)));
        assert_eq!(handle.stats().unwrap()[name]["refused"], 1);
        drop(clients.pop());
        wait_for(&handle, |stats| stats[name]["open"] == most - 1);
        let _again = connect(&handle, name);
        wait_for(&handle, |stats| stats[name]["open"] == most);
    }
}

#[test]
fn clients_with_one_request_are_displaced_by_the_next_one() {
    let handle = start(example("udp-server-controller.toml", &[]), Vec::new()).unwrap();
    let mut clients: Vec<_> = (0..MAX_COMMAND_CONNECTIONS).map(|_| connect(&handle, "command")).collect();
    for client in &mut clients {
        ask(client, b"state\n", b"6:0:5:2");
    }
    // The packets of port 2001 tell the controller's time: from the first to the last, 5 s have passed.
    let mut states = connect(&handle, "state");
    let mut packet = vec![0; state::LEN];
    for _ in 0..=50 {
        states.read_exact(&mut packet).unwrap();
        ask(&mut clients[0], b"state\n", b"6:0:5:2");
    }
    let mut stop = connect(&handle, "command");
    ask(&mut stop, b"stop\n", b"stop fail");
    let stats = wait_for(&handle, |stats| stats["command"]["displaced"] == 1);
    assert_eq!(stats["command"]["open"], MAX_COMMAND_CONNECTIONS);
    assert!(is_closed(&mut clients[1]), "it asked longest ago");
    ask(&mut clients[0], b"state\n", b"6:0:5:2");
    ask(&mut stop, b"state\n", b"6:0:5:2");
}

#[test]
fn port_2000_accepts_as_many_clients_as_configured() {
    let config = |clients| example("udp-server-controller.toml", &[clients]);
    let handle = start(config("robot.command_clients=one"), Vec::new()).unwrap();
    let mut first = connect(&handle, "command");
    ask(&mut first, b"isprogfinish\n", b"1");
    assert!(is_closed(&mut connect(&handle, "command")));
    ask(&mut first, b"isprogfinish\n", b"1");
    let handle = start(config("robot.command_clients=newest"), Vec::new()).unwrap();
    let mut first = connect(&handle, "command");
    ask(&mut first, b"isprogfinish\n", b"1");
    ask(&mut connect(&handle, "command"), b"isprogfinish\n", b"1");
    assert!(is_closed(&mut first));
}

#[test]
fn shutting_down_over_port_2000_answers_and_ends() {
    let handle = start(example("udp-server-controller.toml", &["robot.power=off"]), Vec::new()).unwrap();
    let mut command = connect(&handle, "command");
    let mut modbus = connect(&handle, "modbus");
    ask(&mut command, b"shutdown\r\n", b"shutdown success");
    assert!(is_closed(&mut command));
    assert!(is_closed(&mut modbus));
    let at = handle.place("command").to_owned();
    handle.shutdown().unwrap();
    assert!(StdStream::connect(at).is_err());
}

#[test]
fn a_udp_client_is_streamed_to_until_its_port_is_unreachable() {
    let handle = start(example("udp-server-controller.toml", &[]), Vec::new()).unwrap();
    let client = StdUdp::bind("127.0.0.1:0").unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    client.connect(handle.place("udp2011")).unwrap();
    client.send(&[0xFF, 0xFF, 0x01, 0xEE, 0xEE]).unwrap();
    let mut frame = [0; 64];
    for _ in 0..3 {
        assert_eq!(client.recv(&mut frame).unwrap(), 28);
        assert_eq!(frame[..6], [0xFF, 0xFF, 0x39, 0x2F, 0x0B, 0xBF]);
    }
    assert_eq!(handle.stats().unwrap()["registers"]["DigitalOutputCommand[1]"], 1.0);
    let other = StdUdp::bind("127.0.0.1:0").unwrap();
    other.set_read_timeout(Some(PATIENCE)).unwrap();
    other.connect(handle.place("udp2011")).unwrap();
    other.send(b"?").unwrap();
    other.recv(&mut frame).unwrap();
    drop(client);
    wait_for(&handle, |stats| stats["ports"]["udp2011"]["clients_gone"] == 1);
    // The other client gets every frame: an ICMP error of the first one costs none.
    let before = handle.stats().unwrap();
    other.recv(&mut frame).unwrap();
    assert_eq!(before["connections"]["dropped_datagrams"], 0);
}

#[test]
fn client_ports_connect_and_reconnect() {
    // A loopback address of its own, so that no other test gets the port while nothing listens.
    let listener = StdListener::bind("127.0.0.77:0").unwrap();
    let at = listener.local_addr().unwrap();
    drop(listener);
    let udp = StdUdp::bind("127.0.0.1:0").unwrap();
    udp.set_read_timeout(Some(PATIENCE)).unwrap();
    let to = [format!("port.tcp1.to={at}"), format!("port.udp1.to={}", udp.local_addr().unwrap())];
    let config = example("client-controller.toml", &to.each_ref().map(String::as_str));
    let handle = start(config, Vec::new()).unwrap();
    assert_eq!(handle.place("ports/tcp1"), at.to_string());
    // UDP does not wait for a peer.
    let mut frame = [0; 64];
    let (count, controller) = udp.recv_from(&mut frame).unwrap();
    assert_eq!((count, &frame[..2], &frame[26..28]), (28, &[0xFF, 0xFF][..], &[0xFE, 0xFE][..]));
    udp.send_to(&[0xFF, 0xFF, 0x02, 0xEE, 0xEE], controller).unwrap();
    wait_for(&handle, |stats| stats["registers"]["DigitalOutputCommand[1]"] == 2.0);
    let listener = StdListener::bind(at).unwrap();
    for round in 1..=2 {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut frame = [0; 28];
        for _ in 0..3 {
            stream.read_exact(&mut frame).unwrap();
            assert_eq!((frame[0], frame[27]), (0xFF, 0xFE));
        }
        stream.write_all(&[0xFF, 0xFF, 4 * round, 0xEE, 0xEE]).unwrap();
        wait_for(&handle, |stats| stats["registers"]["DigitalOutputCommand[1]"] == f64::from(4 * round));
        assert_eq!(handle.stats().unwrap()["ports"]["tcp1"]["ups"], round);
    }
    // A peer that is gone neither fills memory nor stops the other port.
    drop(listener);
    udp.recv_from(&mut frame).unwrap();
}

#[test]
fn the_serial_and_can_ports_work_on_their_devices() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("rs485");
    let binds = bind(&format!("rs485=pty:{}", link.display()));
    let handle = start(example("rs485-system-controller.toml", &[]), binds).unwrap();
    assert_eq!(handle.place("ports/rs485"), link.to_str().unwrap());
    let mut line =
        std::fs::OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOCTTY).open(&link).unwrap();
    let mut frame = [0; 20];
    line.read_exact(&mut frame).unwrap();
    assert_eq!((frame[0], frame[1], frame[18], frame[19]), (0xFF, 0xFF, 0xFE, 0xFE));
    line.write_all(&[0xFF, 0xFF, 0x01, 0xEE, 0xEE]).unwrap();
    wait_for(&handle, |stats| stats["registers"]["DigitalOutputCommand[1]"] == 1.0);
    drop(line);
    handle.shutdown().unwrap();
    assert!(std::fs::symlink_metadata(&link).is_err());

    let handle =
        start(example("can-system-controller.toml", &[]), bind("can=slcan-tcp:127.0.0.1:0")).unwrap();
    let mut client = connect(&handle, "ports/can");
    ask(&mut client, b"C\rS6\r\rO\rO\r", b"\r\r\r\r");
    let mut lines = Vec::new();
    while !lines.windows(23).any(|line| line.starts_with(b"t0028EF54EF3EA7E7D13E\r")) {
        let mut chunk = [0; 256];
        let count = client.read(&mut chunk).unwrap();
        lines.extend_from_slice(&chunk[..count]);
    }
    client.write_all(b"t001101\r").unwrap();
    let stats = wait_for(&handle, |stats| stats["registers"]["DigitalOutputCommand[1]"] == 1.0);
    assert_eq!(stats["ports"]["can"]["device"]["frames_in"], 1);
}

#[test]
fn a_failed_start_is_one_message_and_leaves_nothing() {
    let refused = |config: SimConfig, binds: &[&str]| {
        let binds = binds.iter().map(|text| text.parse().unwrap()).collect();
        start(config, binds).unwrap_err().to_string()
    };
    let serial = || example("rs485-system-controller.toml", &[]);
    let message = refused(serial(), &[]);
    assert!(message.starts_with("port rs485 is a serial line without a device: add --bind rs485=DEVICE"));
    let message = refused(serial(), &["rs485-1=pty:/dev/null/x"]);
    assert!(message.contains("there is no such port; ports that take a device: rs485"), "{message}");
    let message = refused(serial(), &["rs485=slcan-tcp:127.0.0.1:0"]);
    assert!(message.contains("is a CAN device; the port is a serial line"), "{message}");
    let message = refused(example("udp-server-controller.toml", &[]), &["udp2011=pty:/dev/null/x"]);
    assert!(message.contains("takes no device"), "{message}");
    let message = refused(serial(), &["rs485=pty:/dev/null/x"]);
    assert!(message.starts_with("--bind rs485=pty:/dev/null/x: "), "{message}");

    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("rs485").display().to_string();
    let once = format!("rs485=pty:{link}");
    assert!(refused(serial(), &[&once, &once]).contains("the port is already bound"));
    // The device was opened before a server's port was found in use.
    let held = StdListener::bind("127.0.0.1:0").unwrap();
    let mut config = serial();
    config.listen.modbus = held.local_addr().unwrap().port();
    let message = refused(config, &[&once]);
    assert!(message.starts_with(&format!("listen.modbus: {}: ", held.local_addr().unwrap())), "{message}");
    assert!(std::fs::symlink_metadata(&link).is_err());
}
