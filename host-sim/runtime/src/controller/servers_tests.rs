//! Connections of Modbus clients, from the socket to the answer.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream as StdStream;
use std::rc::Rc;

use serde_json::{Value, json};
use tokio::net::TcpSocket;
use tokio::task::{LocalSet, yield_now};

use super::*;
use crate::controller::{ControllerOptions, MAX_LINGERING, RunningController};
use crate::host::Runtime;
use recipe_config::file::{Text, parse_controller};
use recipe_controller::operations::Operation;
use recipe_test_kit::{PATIENCE, SERVERS};

/// Runs a test beside a controller, with its Modbus address.
fn beside(test: impl AsyncFnOnce(&Rc<ControllerRuntime>, SocketAddr)) {
    let free = SERVERS.map(|server| format!("listen.{server}=0"));
    // Without a port, which would have deadlines of its own.
    let config = parse_controller(Text { name: "controller", toml: "" }, &free).unwrap();
    let executor = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&executor, async {
        let running = RunningController::open(config, ControllerOptions::default()).await.unwrap();
        let (runtime, ready) = (Rc::clone(&running.runtime), running.ready.clone());
        let at = ready["modbus"].as_str().unwrap().parse().unwrap();
        tokio::select! {
            ended = running.run() => panic!("{ended:?}"),
            () = test(&runtime, at) => {}
            () = tokio::time::sleep(PATIENCE) => panic!("the test hangs"),
        }
    });
}

fn operation(operation: Value) -> Operation {
    let Value::Object(operation) = operation else { panic!("an object") };
    Operation::from_json(operation).unwrap()
}

fn connect(at: SocketAddr) -> StdStream {
    let stream = StdStream::connect(at).unwrap();
    stream.set_nonblocking(true).unwrap();
    stream
}

/// Reads so many bytes; fewer if the connection ends.
async fn read(stream: &mut StdStream, count: usize) -> Vec<u8> {
    let mut got = vec![0; count];
    let mut len = 0;
    while len < count {
        match stream.read(&mut got[len..]) {
            Ok(0) => break,
            Ok(more) => len += more,
            Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock),
        }
        yield_now().await;
    }
    got.truncate(len);
    got
}

/// Writes a coil that is an input register of the robot. The answer is the same.
fn write_coil(transaction: u8, is_on: bool) -> [u8; 12] {
    [0, transaction, 0, 0, 0, 6, 1, 5, 0, 32, if is_on { 0xFF } else { 0 }, 0]
}

#[test]
fn who_waits_hears_of_it_when_a_client_writes() {
    beside(async |runtime, at| {
        let mut client = connect(at);
        let Operation::Wait { until, .. } =
            operation(json!({ "do": "wait", "until": { "event": { "event": "write", "by": "modbus" } } }))
        else {
            panic!("a wait");
        };
        let write = async {
            // Whoever waits is there first.
            yield_now().await;
            client.write_all(&write_coil(1, true)).unwrap();
            assert_eq!(read(&mut client, 12).await, write_coil(1, true));
        };
        // Nothing else happens at the controller.
        let (held, ()) = tokio::join!(runtime.wait_for(until, PATIENCE.as_secs_f64() / 2.0), write);
        held.unwrap();
    });
}

#[test]
fn a_deadline_that_a_request_brings_is_kept() {
    beside(async |runtime, at| {
        let mut client = connect(at);
        runtime
            .operate(&operation(
                json!({ "do": "fault", "server": "modbus", "kind": "delay", "seconds": 0.05 }),
            ))
            .unwrap();
        client.write_all(&write_coil(1, true)).unwrap();
        // Nothing else has a deadline, and nobody else does anything.
        assert_eq!(read(&mut client, 12).await, write_coil(1, true));
    });
}

#[test]
fn answers_that_were_delayed_come_before_those_of_later_requests() {
    beside(async |runtime, at| {
        let mut client = connect(at);
        runtime
            .operate(&operation(
                json!({ "do": "fault", "server": "modbus", "kind": "delay", "seconds": 0.1 }),
            ))
            .unwrap();
        client.write_all(&write_coil(1, true)).unwrap();
        while runtime.controller.borrow().counters().modbus.requests == 0 {
            yield_now().await;
        }
        runtime.operate(&operation(json!({ "do": "heal", "server": "modbus" }))).unwrap();
        client.write_all(&write_coil(2, false)).unwrap();
        let answers = read(&mut client, 24).await;
        assert_eq!(answers, [write_coil(1, true), write_coil(2, false)].concat());
    });
}

#[test]
fn of_too_many_closed_connections_that_still_send_the_oldest_is_cut() {
    beside(async |runtime, at| {
        // The server limits the buffers of connections as soon as it runs.
        yield_now().await;
        let mut peers = Vec::new();
        for _ in 0..MAX_LINGERING + 3 {
            let peer = TcpSocket::new_v4().unwrap();
            peer.set_recv_buffer_size(4_096).unwrap();
            peers.push(peer.connect(at).await.unwrap());
        }
        // Each asks for more than all buffers on the way to it hold, and reads nothing.
        let requests = [0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 118].repeat(2_000);
        for peer in &peers {
            peer.writable().await.unwrap();
            peer.try_write(&requests).unwrap();
        }
        let requests = || runtime.controller.borrow().counters().modbus.requests;
        let mut before = 0;
        while before == 0 || before != requests() {
            before = requests();
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
        let close = operation(json!({ "do": "fault", "server": "modbus", "kind": "disconnect" }));
        runtime.operate(&close).unwrap();
        while runtime.counters.get().cut_answers < 3 {
            yield_now().await;
        }
        assert_eq!(runtime.counters.get().cut_answers, 3);
        assert_eq!(runtime.controller.borrow().counters().modbus.open, 0);
    });
}

#[test]
fn requests_before_the_end_of_a_connection_are_answered() {
    beside(async |_, at| {
        let mut client = connect(at);
        // More than is read at once.
        let requests: Vec<u8> = (0..100).flat_map(|nth| write_coil(nth, true)).collect();
        client.write_all(&requests).unwrap();
        client.shutdown(std::net::Shutdown::Write).unwrap();
        assert_eq!(read(&mut client, requests.len() + 1).await, requests);
    });
}
