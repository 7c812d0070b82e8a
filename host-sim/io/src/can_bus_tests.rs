//! The bus with real slcan clients, on TCP and a terminal.

use std::io::Write;

use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::super::exchange::STALE;
use super::super::port::{BusSettings, OpenPort};
use super::super::test_kit::{PortTask, Seen, TerminalClient, run};
use super::super::wire::{MAX_QUEUED, frame_bits};
use super::clients::MAX_CLIENTS;
use super::*;

const START: Instant = Instant::from_micros(1_000);
const BUS: BusSettings = BusSettings::Can { bitrate: 500_000 };

fn frame(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), data).unwrap()
}

/// An slcan client on TCP that opened its channel.
async fn client(port: &PortTask) -> TcpStream {
    let mut stream = TcpStream::connect(&port.place).await.unwrap();
    exchange(&mut stream, b"C\rS6\r\rO\rO\r", b"\r\r\r\r").await;
    stream
}

#[track_caller]
fn exchange(stream: &mut TcpStream, text: &[u8], answer: &[u8]) -> impl Future<Output = ()> {
    let at = std::panic::Location::caller();
    async move {
        stream.write_all(text).await.unwrap();
        let mut got = vec![0; answer.len()];
        stream.read_exact(&mut got).await.unwrap();
        assert_eq!(String::from_utf8_lossy(&got), String::from_utf8_lossy(answer), "at {at}");
    }
}

fn bus(pacing: Pacing) -> CanBus {
    CanBus::new(pacing, Rc::default(), Clock::real())
}

/// The next frame received at a node.
fn received(node: &BusNode) -> Option<CanFrame> {
    node.try_recv().map(|(_, frame)| frame)
}

#[test]
fn a_node_receives_all_others_and_never_itself() {
    let bus = bus(Pacing::AtOnce);
    let (a, b, c) = (bus.join(), bus.join(), bus.join());
    c.set_receiving(false);
    a.send(START, frame(1, &[])).unwrap();
    b.send(START, frame(2, &[])).unwrap();
    assert_eq!((received(&a), received(&a)), (Some(frame(2, &[])), None));
    assert_eq!((received(&b), received(&b)), (Some(frame(1, &[])), None));
    assert_eq!(received(&c), None);
    drop(b);
    c.set_receiving(true);
    a.send(START, frame(3, &[])).unwrap();
    assert_eq!(received(&c), Some(frame(3, &[])));
}

#[test]
fn a_node_that_does_not_read_keeps_the_oldest_frames_and_counts_the_rest() {
    let bus = bus(Pacing::AtOnce);
    let (fast, slow) = (bus.join(), bus.join());
    for id in 0..MAX_WAITING as u16 + 10 {
        fast.send(START, frame(id, &[])).unwrap();
    }
    assert_eq!((slow.dropped(), bus.shared.tx.counters().dropped), (10, 10));
    assert_eq!(received(&slow), Some(frame(0, &[])));
    assert_eq!(std::iter::from_fn(|| received(&slow)).count(), MAX_WAITING - 1);
}

#[test]
fn no_frame_is_received_before_its_end() {
    let bus = bus(Pacing::Bitrate(500_000));
    let (a, b) = (bus.join(), bus.join());
    a.send(START, frame(0, &[])).unwrap();
    // 53 bits of 2 us.
    let end = START + Duration::from_micros(106);
    bus.advance(START + Duration::from_micros(105));
    assert_eq!((b.try_recv(), a.waiting()), (None, 1));
    bus.advance(end + Duration::from_micros(70));
    assert_eq!((b.try_recv(), a.waiting()), (Some((end, frame(0, &[]))), 0));
}

#[test]
fn clients_on_tcp_and_the_port_are_one_bus() {
    run(async |_| {
        let port = PortTask::start("slcan-tcp:127.0.0.1:0", BUS).await;
        port.expect(Seen::Up).await;
        let mut one = client(&port).await;
        let mut two = client(&port).await;
        exchange(&mut one, b"t0013010203\r", b"z\r").await;
        exchange(&mut two, b"", b"t0013010203\r").await;
        port.expect(Seen::Frame(frame(1, &[1, 2, 3]))).await;
        let start = now();
        for id in 2..4 {
            port.tx.send_frame(frame(id, &[0x7D; 3]));
        }
        exchange(&mut one, b"", b"t00237D7D7D\rt00337D7D7D\r").await;
        exchange(&mut two, b"", b"t00237D7D7D\rt00337D7D7D\r").await;
        // Twice 71 bits and more at 500 kbit/s.
        assert!(port.expect(Seen::Sent).await.saturating_since(start) >= Duration::from_micros(284));
        drop(one);
        exchange(&mut two, b"T000000050\rr7FF0\r", b"").await;
        exchange(&mut two, b"C\r", b"Z\rz\r\r").await;
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
        let port = PortTask::start(&format!("slcan-pty:{link}"), BUS).await;
        assert_eq!(port.place, link);
        port.expect(Seen::Up).await;
        for round in 0..3 {
            let mut client = TerminalClient::open(&link);
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
        let port = PortTask::start("slcan-tcp-unpaced:127.0.0.1:0", BUS).await;
        port.expect(Seen::Up).await;
        let _slow = client(&port).await;
        let mut busy = client(&port).await;
        let mut count = 0_u64;
        while port.tx.counters().dropped == 0 {
            let burst: Vec<u8> = (0..200).flat_map(|_| b"t00181122334455667788\r".to_owned()).collect();
            exchange(&mut busy, &burst, &b"z\r".repeat(200)).await;
            count += 200;
            for _ in 0..200 {
                port.expect(Seen::Frame(frame(1, &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]))).await;
            }
            assert!(count < 2_000_000, "buffered without bound");
        }
        exchange(&mut busy, b"F\r", b"F00\r").await;
    });
}

/// Reads `count` frames, skipping `z` and CR answers; returns their ids.
async fn received_ids(stream: &mut TcpStream, count: usize) -> Vec<u16> {
    let mut ids = Vec::new();
    let mut line = Vec::new();
    while ids.len() < count {
        match stream.read_u8().await.unwrap() {
            b'\r' => {
                if let [b't', a, b, c, ..] = line.as_slice() {
                    ids.push(u16::from_str_radix(std::str::from_utf8(&[*a, *b, *c]).unwrap(), 16).unwrap());
                }
                line.clear();
            }
            byte => line.push(byte),
        }
    }
    ids
}

#[test]
fn bursts_of_two_clients_and_the_port_are_arbitrated_and_take_their_time() {
    run(async |dir| {
        let bus = BusSettings::Can { bitrate: 10_000 };
        let link = dir.join("can").display().to_string();
        let port = PortTask::start(&format!("slcan-tcp:127.0.0.1:0,{link}"), bus).await;
        port.expect(Seen::Up).await;
        let mut watcher = TcpStream::connect(&port.place).await.unwrap();
        let mut one = TcpStream::connect(&port.place).await.unwrap();
        let mut two = TerminalClient::open(&link);
        exchange(&mut watcher, b"O\r", b"\r").await;
        exchange(&mut one, b"O\r", b"\r").await;
        two.0.write_all(b"O\r").unwrap();
        assert_eq!(two.read_exact(1).await, b"\r");
        let start = now();
        // These win the arbitration and take a quarter of a second; the others are queued by then.
        for _ in 0..24 {
            port.tx.send_frame(frame(0, &[0x55; 8]));
        }
        for id in [0x250, 0x010, 0x400] {
            port.tx.send_frame(frame(id, &[]));
        }
        exchange(&mut one, b"t3000\rt1000\r", b"z\rz\r").await;
        two.0.write_all(b"t2000\rt2010\r").unwrap();
        // A client that disconnects at once has sent all the same.
        let mut brief = TcpStream::connect(&port.place).await.unwrap();
        exchange(&mut brief, b"O\rt3500\r", b"\rz\r").await;
        drop(brief);
        let order = [0x200, 0x201, 0x250, 0x010, 0x300, 0x100, 0x350, 0x400];
        assert_eq!(received_ids(&mut watcher, 24 + order.len()).await[24..], order);
        let bits = order.map(|id| frame_bits(&frame(id, &[]))).iter().sum::<u32>()
            + 24 * frame_bits(&frame(0, &[0x55; 8]));
        let took = now().saturating_since(start);
        assert!(took >= Duration::from_micros(100 * u64::from(bits)), "{took:?} for {bits} bits");
        let counters = port.tx.counters();
        assert_eq!((counters.frames_in, counters.frames_out, counters.dropped), (5, 27, 0));
    });
}

#[test]
fn a_burst_longer_than_the_queue_waits_in_its_connection_and_nothing_is_lost() {
    run(async |_| {
        let port = PortTask::start("slcan-tcp:127.0.0.1:0", BusSettings::Can { bitrate: 1_000_000 }).await;
        port.expect(Seen::Up).await;
        let mut one = TcpStream::connect(&port.place).await.unwrap();
        let count = 5 * MAX_QUEUED as u16;
        let burst: String = (0..count).map(|id| format!("t{id:03X}0\r")).collect();
        let start = now();
        one.write_all(format!("O\r{burst}C\r").as_bytes()).await.unwrap();
        for id in 0..count {
            port.expect(Seen::Frame(frame(id, &[]))).await;
        }
        let bits: u32 = (0..count).map(|id| frame_bits(&frame(id, &[]))).sum();
        assert!(now().saturating_since(start) >= Duration::from_micros(bits.into()));
        exchange(&mut one, b"", format!("\r{}\r", "z\r".repeat(count.into())).as_bytes()).await;
    });
}

#[test]
fn a_client_that_reads_loses_nothing_of_an_unpaced_burst() {
    run(async |_| {
        let port = PortTask::start("slcan-tcp-unpaced:127.0.0.1:0", BUS).await;
        let (mut one, mut two) = (client(&port).await, client(&port).await);
        one.write_all(&b"t0010\r".repeat(2_000)).await.unwrap();
        assert_eq!(received_ids(&mut two, 2_000).await, [1; 2_000]);
        assert_eq!(port.tx.counters().dropped, 0);
    });
}

/// A client that connected and sent while the process slept was not even accepted then.
#[test]
fn what_waited_in_a_connection_that_waited_itself_is_dropped() {
    run(async |_| {
        let port = PortTask::start("slcan-tcp:127.0.0.1:0", BUS).await;
        port.expect(Seen::Up).await;
        for _ in 0..4 {
            let mut client = std::net::TcpStream::connect(&port.place).unwrap();
            client.write_all(b"C\rS6\rO\rt0011AA\r").unwrap();
            port.tx.note_sleep(now());
            // The machine does something else.
            std::thread::sleep(std::time::Duration::from_millis(2 * STALE.as_millis()));
            let id = loop {
                client.write_all(b"t0021BB\r").unwrap();
                tokio::time::sleep(std::time::Duration::from_millis(20)).await;
                match port.try_next() {
                    Some(Seen::Frame(frame)) => break frame.id(),
                    other => assert_eq!(other, None),
                }
            };
            assert_eq!(id, CanId::Standard(2));
            drop(client);
            // Those that it sent while it was waited for.
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
            while port.try_next().is_some() {}
        }
    });
}

#[test]
fn more_clients_than_the_maximum_are_refused() {
    run(async |_| {
        let port = PortTask::start("slcan-tcp:127.0.0.1:0", BUS).await;
        let mut clients = Vec::new();
        for _ in 0..MAX_CLIENTS {
            clients.push(client(&port).await);
        }
        let mut late = TcpStream::connect(&port.place).await.unwrap();
        assert_eq!(late.read(&mut [0; 8]).await.unwrap(), 0);
        assert_eq!(port.tx.counters().refused, 1);
        let mut first = clients.swap_remove(0);
        exchange(&mut first, b"V\r", b"V1013\r").await;
    });
}

#[test]
fn an_unsuitable_device_is_refused_by_name() {
    run(async |_| {
        let refused =
            async |device: &str| OpenPort::open(&device.parse().unwrap(), BUS).await.unwrap_err().to_string();
        assert!(refused("pty:x").await.contains("is a serial device"));
        // With and without CAN interfaces on this machine.
        let why = refused("socketcan:no-such-can").await;
        assert!(
            why.starts_with("no-such-can: ") && why.ends_with("docs/socketcan.md says how to get one"),
            "{why}"
        );
    });
}
