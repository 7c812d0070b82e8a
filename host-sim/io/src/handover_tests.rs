//! Devices that go from one owner to the next, in one runtime.

use std::io::Write;

use proto_core::time::Duration;
use proto_core::wire::can::{CanFrame, CanId};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::task::yield_now;

use super::*;
use crate::exchange::STALE;
use crate::port::{BusSettings, OpenPort};
use crate::test_kit::{PortTask, Seen, TerminalClient, run, serial};
use crate::timer::now;

/// Ends the tasks of a port and keeps its device.
async fn hand_over(port: PortTask, hold: Hold) -> HandoverDevice {
    drop(port);
    for _ in 0..10 {
        yield_now().await;
    }
    hold.release().expect("it is not handed over")
}

async fn open(bind: &str, bus: BusSettings, handover: Option<HandoverDevice>) -> (PortTask, Hold) {
    let is_handed_over = handover.is_some();
    let port = OpenPort::open_or_adopt(&bind.parse().unwrap(), bus, handover).await.unwrap();
    assert_eq!(port.is_handed_over(), is_handed_over);
    let hold = port.hold().unwrap();
    (PortTask::of(port), hold)
}

#[test]
fn what_was_sent_between_two_owners_of_a_terminal_is_dropped() {
    run(async |dir| {
        let link = dir.join("line").display().to_string();
        let bind = format!("pty:{link}");
        let (port, hold) = open(&bind, serial(115_200), None).await;
        port.expect(Seen::Up).await;
        let mut client = TerminalClient::open(&link);
        client.0.write_all(b"first").unwrap();
        assert_eq!(port.bytes(5).await, b"first");
        let handover = hand_over(port, hold).await;
        client.0.write_all(&[0xA5; 3_000]).unwrap();
        let start = now();
        let (port, _) = open(&bind, serial(9_600), Some(handover)).await;
        let up = port.expect(Seen::Up).await;
        assert!(up.saturating_since(start) >= STALE);
        assert_eq!(port.tx.counters().dropped, 3_000);
        client.0.write_all(b"second").unwrap();
        assert_eq!(port.bytes(6).await, b"second");
        port.tx.send(b"answer");
        assert_eq!(client.read_exact(6).await, b"answer");
        let sent = port.expect(Seen::Sent).await;
        assert!(sent.saturating_since(up) >= Duration::from_micros(6_250), "at the new baud rate");
    });
}

#[test]
fn a_client_that_has_gone_between_two_owners_makes_room() {
    run(async |_| {
        let bind = "tcp-listen:127.0.0.1:0";
        let (port, hold) = open(bind, serial(115_200), None).await;
        let place = port.place.clone();
        let client = TcpStream::connect(&place).await.unwrap();
        port.expect(Seen::Up).await;
        let handover = hand_over(port, hold).await;
        drop(client);
        let (port, _) = open(bind, serial(115_200), Some(handover)).await;
        assert_eq!(port.place, place);
        let mut client = TcpStream::connect(&place).await.unwrap();
        port.expect(Seen::Up).await;
        client.write_all(b"here").await.unwrap();
        assert_eq!(port.bytes(4).await, b"here");
    });
}

#[test]
fn a_command_that_is_cut_by_the_change_becomes_no_other_frame() {
    run(async |dir| {
        let bus = BusSettings::Can { bitrate: 500_000 };
        let bind = format!("slcan-tcp-unpaced:127.0.0.1:0,{}", dir.join("can").display());
        let (port, hold) = open(&bind, bus, None).await;
        port.expect(Seen::Up).await;
        let mut client = TcpStream::connect(&port.place).await.unwrap();
        client.write_all(b"O\rt1230\rt1232AA").await.unwrap();
        let empty = |id| Seen::Frame(CanFrame::new(CanId::Standard(id), &[]).unwrap());
        port.expect(empty(0x123)).await;
        let handover = hand_over(port, hold).await;
        client.write_all(b"BB\rt1241CC\rt1252DD").await.unwrap();
        let (port, _) = open(&bind, bus, Some(handover)).await;
        port.expect(Seen::Up).await;
        // The channel is open still, and the first frame that comes is one that was sent from now on.
        tokio::time::sleep(std::time::Duration::from_millis(3 * STALE.as_millis())).await;
        client.write_all(b"EE\rt1260\r").await.unwrap();
        port.expect(Seen::Frame(CanFrame::new(CanId::Standard(0x125), &[0xDD, 0xEE]).unwrap())).await;
        port.expect(empty(0x126)).await;
        assert_eq!(port.tx.counters().dropped, 2);
        port.tx.send_frame(CanFrame::new(CanId::Standard(0x127), &[]).unwrap());
        let mut got = Vec::new();
        while !got.ends_with(b"t1270\r") {
            got.push(client.read_u8().await.unwrap());
        }
    });
}

#[test]
fn nothing_is_kept_that_a_task_still_uses() {
    run(async |dir| {
        let bind = format!("pty:{}", dir.join("line").display());
        let (port, hold) = open(&bind, serial(115_200), None).await;
        port.expect(Seen::Up).await;
        assert!(hold.release().is_none());
        let serial_device = OpenPort::open(&"tcp:127.0.0.1:1".parse().unwrap(), serial(9_600)).await.unwrap();
        assert!(serial_device.hold().is_none(), "nobody is connected to it");
    });
}
