//! Serial ports on real terminals and sockets.

use std::io::Write;

use proto_core::config::Parity;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::super::exchange::STALE;
use super::super::port::{BusSettings, OpenPort};
use super::super::test_kit::{PortTask, Seen, TerminalClient, is_gone, run, serial};
use super::*;

#[test]
fn a_byte_takes_its_start_data_parity_and_stop_bits() {
    let BusSettings::Serial(mut settings) = serial(115_200) else { unreachable!() };
    let micros = |settings: Rs485| settings.time_on_line(28).as_micros();
    assert_eq!(micros(settings), 2_431);
    settings.parity = Parity::Even;
    settings.stop_bits = 2;
    assert_eq!(micros(settings), 2_917);
    for count in 0..600 {
        let time = settings.time_on_line(count);
        assert_eq!(bytes_in(&settings, time), count);
        assert!(count == 0 || bytes_in(&settings, time - Duration::from_micros(1)) < count);
    }
}

#[test]
fn a_pty_carries_both_ways_and_reports_sent_when_the_line_would_be_free() {
    run(async |dir| {
        let link = dir.join("rs485").display().to_string();
        let port = PortTask::start(&format!("pty:{link}"), serial(9_600)).await;
        assert_eq!(port.place, link);
        port.expect(Seen::Up).await;
        let mut client = TerminalClient::open(&link);
        client.0.write_all(&[0xFF, 0xFF, 1, 2, 3, 0xEE, 0xEE]).unwrap();
        assert_eq!(port.bytes(7).await, [0xFF, 0xFF, 1, 2, 3, 0xEE, 0xEE]);
        let start = now();
        port.tx.send(&[0x7D; 24]);
        assert_eq!(client.read_exact(24).await, [0x7D; 24]);
        let sent = port.expect(Seen::Sent).await;
        // 240 bits at 9600 bit/s.
        assert!(sent.saturating_since(start) >= Duration::from_micros(25_000));
        let counters = port.tx.counters();
        assert_eq!((counters.bytes_in, counters.bytes_out, counters.unheard), (7, 24, 0));
        drop(port);
        tokio::task::yield_now().await;
        assert!(is_gone(&link));
    });
}

#[test]
fn a_paced_pty_shows_no_byte_before_its_time() {
    run(async |dir| {
        let link = dir.join("rs485").display().to_string();
        let port = PortTask::start(&format!("pty-paced:{link}"), serial(9_600)).await;
        port.expect(Seen::Up).await;
        let mut client = TerminalClient::open(&link);
        let start = now();
        port.tx.send(&[0x55; 24]);
        let mut seen = 0;
        while seen < 24 {
            seen += client.read().len() as u64;
            let ended = now().saturating_since(start).as_micros() * 9_600 / 10_000_000;
            assert!(seen <= ended, "{seen} bytes but {ended} can have left");
            tokio::task::yield_now().await;
        }
        port.expect(Seen::Sent).await;
    });
}

#[test]
fn bytes_without_a_client_are_counted_and_the_next_client_gets_only_new_ones() {
    run(async |dir| {
        let link = dir.join("rs485").display().to_string();
        let port = PortTask::start(&format!("pty:{link}"), serial(115_200)).await;
        port.expect(Seen::Up).await;
        port.tx.send(b"lost");
        port.expect(Seen::Sent).await;
        assert_eq!(port.tx.counters().unheard, 4);
        let first = TerminalClient::open(&link);
        port.tx.send(b"unread");
        port.expect(Seen::Sent).await;
        drop(first);
        port.tx.send(b"lost too");
        port.expect(Seen::Sent).await;
        let mut second = TerminalClient::open(&link);
        port.tx.send(b"new");
        assert_eq!(second.read_exact(3).await, b"new");
        assert_eq!(port.tx.counters().unheard, 12);
    });
}

#[test]
fn a_client_that_does_not_read_loses_bytes_and_blocks_nothing() {
    run(async |dir| {
        let link = dir.join("rs485").display().to_string();
        let port = PortTask::start(&format!("pty:{link}"), serial(4_000_000)).await;
        port.expect(Seen::Up).await;
        let _client = TerminalClient::open(&link);
        let mut sent = 0;
        while port.tx.counters().dropped == 0 {
            port.tx.send(&[0; 4_000]);
            port.expect(Seen::Sent).await;
            sent += 4_000;
            assert!(sent < 4_000_000, "buffered without bound");
        }
        let counters = port.tx.counters();
        assert_eq!(counters.bytes_out + counters.dropped, sent);
    });
}

#[test]
fn two_transmissions_follow_each_other_and_too_much_is_dropped() {
    run(async |dir| {
        let link = dir.join("rs485").display().to_string();
        let port = PortTask::start(&format!("pty:{link}"), serial(1_000_000)).await;
        port.expect(Seen::Up).await;
        let mut client = TerminalClient::open(&link);
        port.tx.send(b"one");
        assert_eq!(client.read_exact(3).await, b"one");
        port.tx.send(b"two");
        port.tx.send(&[b'x'; 5_000]);
        assert_eq!(client.read_exact(3).await, b"two");
        port.expect(Seen::Sent).await;
        assert_eq!(port.tx.counters().dropped, 1);
    });
}

#[test]
fn a_serial_device_is_opened_with_any_rate_and_parity() {
    run(async |dir| {
        // A pseudoterminal replaces the device.
        let link = dir.join("device").display().to_string();
        let device = PortTask::start(&format!("pty:{link}"), serial(460_800)).await;
        device.expect(Seen::Up).await;
        let BusSettings::Serial(settings) = serial(460_800) else { unreachable!() };
        let even = BusSettings::Serial(Rs485 { parity: Parity::Even, ..settings });
        let port = PortTask::start(&format!("serial:{link}"), even).await;
        port.expect(Seen::Up).await;
        device.tx.send(b"to the port");
        assert_eq!(port.bytes(11).await, b"to the port");
        device.expect(Seen::Sent).await;
        port.tx.send(b"from it");
        port.expect(Seen::Sent).await;
        assert_eq!(device.bytes(7).await, b"from it");
    });
}

#[test]
fn a_serial_device_that_vanishes_is_opened_again() {
    run(async |dir| {
        let link = dir.join("device").display().to_string();
        let device = PortTask::start(&format!("pty:{link}"), serial(115_200)).await;
        let port = PortTask::start(&format!("serial:{link}"), serial(115_200)).await;
        port.expect(Seen::Up).await;
        drop(device);
        port.expect(Seen::Down).await;
        port.tx.send(b"into the void");
        let device = PortTask::start(&format!("pty:{link}"), serial(115_200)).await;
        device.expect(Seen::Up).await;
        port.expect(Seen::Up).await;
        port.tx.send(b"back");
        assert_eq!(device.bytes(4).await, b"back");
        assert_eq!(port.tx.counters().ups, 2);
    });
}

#[test]
fn a_tcp_port_connects_when_its_server_appears_and_again_after_a_loss() {
    run(async |_| {
        // A loopback address of its own, so that no other test gets the port while nothing listens.
        let listener = TcpListener::bind("127.0.0.78:0").await.unwrap();
        let at = listener.local_addr().unwrap();
        drop(listener);
        let port = PortTask::start(&format!("tcp:{at}"), serial(115_200)).await;
        assert_eq!(port.place, at.to_string());
        let listener = TcpListener::bind(at).await.unwrap();
        for _ in 0..2 {
            let (mut server, _) = listener.accept().await.unwrap();
            port.expect(Seen::Up).await;
            server.write_all(b"hello").await.unwrap();
            assert_eq!(port.bytes(5).await, b"hello");
            port.tx.send(b"world");
            let mut got = [0; 5];
            server.read_exact(&mut got).await.unwrap();
            assert_eq!(&got, b"world");
            port.expect(Seen::Sent).await;
            drop(server);
            port.expect(Seen::Down).await;
        }
        assert_eq!(port.tx.counters().ups, 2);
    });
}

#[test]
fn what_a_server_does_not_take_in_time_is_dropped_with_its_connection() {
    run(async |_| {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        tcp_options::limit_buffers(&listener);
        let at = listener.local_addr().unwrap();
        let port = PortTask::start(&format!("tcp:{at}"), serial(4_000_000)).await;
        // It acknowledges what it has room for, and reads nothing.
        let (mut server, _) = listener.accept().await.unwrap();
        port.expect(Seen::Up).await;
        let mut sent = 0;
        loop {
            port.tx.send(&[0x55; 1_024]);
            sent += 1_024;
            match port.next().await.1 {
                Seen::Sent => {}
                other => break assert_eq!(other, Seen::Down),
            }
        }
        // What it takes at last is not all, and behind it is a reset.
        let mut taken = 0;
        let end = loop {
            match server.read(&mut [0; 4_096]).await {
                Ok(0) => break None,
                Ok(len) => taken += len,
                Err(error) => break Some(error.kind()),
            }
        };
        assert!(end == Some(io::ErrorKind::ConnectionReset) && taken < sent, "{end:?}: {taken} of {sent}");
    });
}

#[test]
fn a_listening_port_has_one_client_at_a_time() {
    run(async |_| {
        let port = PortTask::start("tcp:127.0.0.1:0", serial(115_200)).await;
        let mut first = TcpStream::connect(&port.place).await.unwrap();
        port.expect(Seen::Up).await;
        let mut second = TcpStream::connect(&port.place).await.unwrap();
        assert_eq!(second.read(&mut [0; 8]).await.unwrap(), 0, "refused");
        assert_eq!(port.tx.counters().refused, 1);
        first.write_all(b"still here").await.unwrap();
        assert_eq!(port.bytes(10).await, b"still here");
        drop(first);
        port.expect(Seen::Down).await;
        let mut third = TcpStream::connect(&port.place).await.unwrap();
        port.expect(Seen::Up).await;
        port.tx.send(b"next");
        let mut got = [0; 4];
        third.read_exact(&mut got).await.unwrap();
        assert_eq!(&got, b"next");
    });
}

#[test]
fn an_unsuitable_device_is_refused_by_name() {
    run(async |dir| {
        let refused = async |device: &str| {
            OpenPort::open(&device.parse().unwrap(), serial(115_200)).await.unwrap_err().to_string()
        };
        assert!(refused("slcan-tcp:127.0.0.1:0").await.contains("is a CAN device"));
        let missing = dir.join("ttyUSB9").display().to_string();
        assert!(refused(&format!("serial:{missing}")).await.starts_with(&missing));
        let held = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
        let held_open = TcpListener::bind(held).await.unwrap();
        assert!(refused(&format!("tcp-listen:{held}")).await.starts_with(&held.to_string()));
        drop(held_open);
    });
}

const OLD: &[u8] = b"old old old old";

/// What waited while the process slept is not handed over by a task that runs only when the engine accepts input
/// again; what is sent later is.
async fn old_bytes_are_dropped(port: &PortTask, mut write: impl FnMut(&[u8])) {
    for _ in 0..MANY_ROUNDS {
        write(OLD);
        port.tx.note_sleep(now());
        // The machine does something else.
        std::thread::sleep(StdDuration::from_millis(2 * STALE.as_millis()));
        // All is new a little later.
        let mut bytes = Vec::new();
        while !bytes.ends_with(b"!") {
            tokio::time::sleep(StdDuration::from_millis(20)).await;
            write(b"n!");
            while let Some(seen) = port.try_next() {
                let Seen::Bytes(more) = seen else { panic!("{seen:?}") };
                bytes.extend(more);
            }
        }
        assert!(bytes.iter().all(|byte| b"n!".contains(byte)), "{}", bytes.escape_ascii());
    }
}

/// After a sleep in which nothing came the first bytes are handed over, however late they come.
async fn bytes_after_an_empty_sleep_are_taken(port: &PortTask, mut write: impl FnMut(&[u8])) {
    port.tx.note_sleep(now());
    tokio::time::sleep(StdDuration::from_millis(2 * STALE.as_millis())).await;
    write(b"a button");
    assert_eq!(port.bytes(8).await, b"a button");
    assert_eq!(port.tx.counters().dropped, 0);
}

#[test]
fn what_waited_on_a_terminal_is_dropped_by_a_task_that_runs_late() {
    run(async |dir| {
        let link = dir.join("rs485").display().to_string();
        let port = PortTask::start(&format!("pty:{link}"), serial(115_200)).await;
        port.expect(Seen::Up).await;
        let mut client = TerminalClient::open(&link);
        bytes_after_an_empty_sleep_are_taken(&port, |bytes| client.0.write_all(bytes).unwrap()).await;
        old_bytes_are_dropped(&port, |bytes| client.0.write_all(bytes).unwrap()).await;
    });
}

#[test]
fn what_waited_in_a_connection_is_dropped_by_a_task_that_runs_late() {
    run(async |_| {
        let port = PortTask::start("tcp-listen:127.0.0.1:0", serial(115_200)).await;
        let mut client = std::net::TcpStream::connect(&port.place).unwrap();
        port.expect(Seen::Up).await;
        bytes_after_an_empty_sleep_are_taken(&port, |bytes| client.write_all(bytes).unwrap()).await;
        old_bytes_are_dropped(&port, |bytes| client.write_all(bytes).unwrap()).await;
        let dropped = port.tx.counters().dropped;
        assert!(dropped >= (MANY_ROUNDS * OLD.len()) as u64, "{dropped}");
    });
}

/// A client that connected meanwhile was not even accepted then.
#[test]
fn what_waited_in_a_connection_that_waited_itself_is_dropped() {
    run(async |_| {
        let port = PortTask::start("tcp-listen:127.0.0.1:0", serial(115_200)).await;
        tokio::task::yield_now().await;
        for _ in 0..MANY_ROUNDS {
            let mut client = std::net::TcpStream::connect(&port.place).unwrap();
            client.write_all(OLD).unwrap();
            port.tx.note_sleep(now());
            // The machine does something else.
            std::thread::sleep(StdDuration::from_millis(2 * STALE.as_millis()));
            port.expect(Seen::Up).await;
            let mut bytes = Vec::new();
            while !bytes.ends_with(b"!") {
                tokio::time::sleep(StdDuration::from_millis(20)).await;
                client.write_all(b"n!").unwrap();
                while let Some(seen) = port.try_next() {
                    let Seen::Bytes(more) = seen else { panic!("{seen:?}") };
                    bytes.extend(more);
                }
            }
            assert!(bytes.iter().all(|byte| b"n!".contains(byte)), "{}", bytes.escape_ascii());
            drop(client);
            while port.next().await.1 != Seen::Down {}
        }
    });
}

/// Two tasks of a select are ready then, and it takes either.
const MANY_ROUNDS: usize = 8;
