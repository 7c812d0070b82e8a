//! The bus with real slcan clients on TCP and a terminal.

use std::io::Write;

use proto_core::recipe::model::CanId;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::super::port::{Port, PortBus};
use super::super::test_kit::{Client, Running, Seen, run};
use super::*;

const BUS: PortBus = PortBus::Can { bitrate: 500_000 };

fn frame(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), data).unwrap()
}

/// An slcan client on TCP that opened its channel.
async fn client(port: &Running) -> TcpStream {
    let mut stream = TcpStream::connect(&port.place).await.unwrap();
    say(&mut stream, b"C\rS6\r\rO\rO\r", b"\r\r\r\r").await;
    stream
}

#[track_caller]
fn say(stream: &mut TcpStream, text: &[u8], answer: &[u8]) -> impl Future<Output = ()> {
    let at = std::panic::Location::caller();
    async move {
        stream.write_all(text).await.unwrap();
        let mut got = vec![0; answer.len()];
        stream.read_exact(&mut got).await.unwrap();
        assert_eq!(String::from_utf8_lossy(&got), String::from_utf8_lossy(answer), "at {at}");
    }
}

#[test]
fn a_node_hears_all_others_and_never_itself() {
    let bus = CanBus::default();
    let (a, b, c) = (bus.join(), bus.join(), bus.join());
    c.set_hears(false);
    a.send(frame(1, &[]));
    b.send(frame(2, &[]));
    assert_eq!((a.try_recv(), a.try_recv()), (Some(frame(2, &[])), None));
    assert_eq!((b.try_recv(), b.try_recv()), (Some(frame(1, &[])), None));
    assert_eq!(c.try_recv(), None);
    drop(b);
    c.set_hears(true);
    a.send(frame(3, &[]));
    assert_eq!(c.try_recv(), Some(frame(3, &[])));
}

#[test]
fn a_node_that_does_not_read_keeps_the_oldest_frames_and_counts_the_rest() {
    let bus = CanBus::default();
    let (fast, slow) = (bus.join(), bus.join());
    for id in 0..MAX_WAITING as u16 + 10 {
        fast.send(frame(id, &[]));
    }
    assert_eq!(slow.dropped(), 10);
    assert_eq!(slow.try_recv(), Some(frame(0, &[])));
    assert_eq!(std::iter::from_fn(|| slow.try_recv()).count(), MAX_WAITING - 1);
}

#[test]
fn a_frame_takes_its_bits_on_the_bus() {
    let micros = |frame| frame_time(&frame, 500_000).as_micros();
    assert_eq!(micros(frame(1, &[0; 8])), 222);
    assert_eq!(micros(CanFrame::new(CanId::Extended(1), &[0; 8]).unwrap()), 262);
    assert_eq!(micros(CanFrame::remote(CanId::Standard(1), 8).unwrap()), 94);
}

#[test]
fn clients_on_tcp_and_the_port_are_one_bus() {
    run(async |_| {
        let port = Running::start("slcan-tcp:127.0.0.1:0", BUS).await;
        port.expect(Seen::Up).await;
        let mut one = client(&port).await;
        let mut two = client(&port).await;
        say(&mut one, b"t0013010203\r", b"z\r").await;
        say(&mut two, b"", b"t0013010203\r").await;
        port.expect(Seen::Frame(frame(1, &[1, 2, 3]))).await;
        let start = now();
        for id in 2..4 {
            port.tx.send_frame(frame(id, &[0x7D; 3]));
        }
        say(&mut one, b"", b"t00237D7D7D\rt00337D7D7D\r").await;
        say(&mut two, b"", b"t00237D7D7D\rt00337D7D7D\r").await;
        // Twice 71 bits at 500 kbit/s.
        assert!(port.expect(Seen::Sent).await.saturating_since(start) >= Duration::from_micros(284));
        drop(one);
        say(&mut two, b"T000000050\rr7FF0\r", b"").await;
        say(&mut two, b"C\r", b"Z\rz\r\r").await;
        port.expect(Seen::Frame(CanFrame::new(CanId::Extended(5), &[]).unwrap())).await;
        port.expect(Seen::Frame(CanFrame::remote(CanId::Standard(0x7FF), 0).unwrap())).await;
        let counters = port.tx.counters();
        assert_eq!((counters.frames_in, counters.frames_out, counters.bytes_in), (3, 2, 3));
    });
}

#[test]
fn a_client_on_a_terminal_joins_too() {
    run(async |dir| {
        let link = dir.join("can").display().to_string();
        let port = Running::start(&format!("slcan-pty:{link}"), BUS).await;
        assert_eq!(port.place, link);
        port.expect(Seen::Up).await;
        for round in 0..3 {
            let mut client = Client::open(&link);
            client.0.write_all(b"C\rS6\r\rO\rO\r").unwrap();
            assert_eq!(client.read_exact(4).await, b"\r\r\r\r");
            client.0.write_all(b"t0012AB0").unwrap();
            client.0.write_all(&[b'0' + round, b'\r']).unwrap();
            port.expect(Seen::Frame(frame(1, &[0xAB, round]))).await;
            port.tx.send_frame(frame(2, &[round]));
            assert_eq!(client.read_exact(10).await, format!("z\rt00210{round}\r").as_bytes());
            port.expect(Seen::Sent).await;
            drop(client);
            port.tx.send_frame(frame(3, b"lost"));
            port.expect(Seen::Sent).await;
        }
    });
}

#[test]
fn a_client_that_does_not_read_loses_frames_and_others_do_not() {
    run(async |_| {
        let port = Running::start("slcan-tcp:127.0.0.1:0", BUS).await;
        port.expect(Seen::Up).await;
        let _lazy = client(&port).await;
        let mut busy = client(&port).await;
        let mut count = 0_u64;
        while port.tx.counters().dropped == 0 {
            let burst: Vec<u8> = (0..200).flat_map(|_| b"t00181122334455667788\r".to_owned()).collect();
            say(&mut busy, &burst, &b"z\r".repeat(200)).await;
            count += 200;
            for _ in 0..200 {
                port.expect(Seen::Frame(frame(1, &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]))).await;
            }
            assert!(count < 2_000_000, "buffered without bound");
        }
        say(&mut busy, b"F\r", b"F00\r").await;
    });
}

#[test]
fn more_clients_than_the_bound_are_turned_away() {
    run(async |_| {
        let port = Running::start("slcan-tcp:127.0.0.1:0", BUS).await;
        let mut clients = Vec::new();
        for _ in 0..MAX_CLIENTS {
            clients.push(client(&port).await);
        }
        let mut late = TcpStream::connect(&port.place).await.unwrap();
        assert_eq!(late.read(&mut [0; 8]).await.unwrap(), 0);
        assert_eq!(port.tx.counters().refused, 1);
        let mut first = clients.swap_remove(0);
        say(&mut first, b"V\r", b"V1013\r").await;
    });
}

#[test]
fn what_does_not_suit_the_bus_is_refused_by_name() {
    run(async |_| {
        let refused =
            async |device: &str| Port::open(&device.parse().unwrap(), BUS).await.unwrap_err().to_string();
        assert!(refused("pty:x").await.contains("is a serial device"));
        // Whether this machine has CAN interfaces or not.
        let why = refused("socketcan:no-such-can").await;
        assert!(
            why.starts_with("no-such-can: ") && why.ends_with("docs/socketcan.md says how to get one"),
            "{why}"
        );
    });
}
