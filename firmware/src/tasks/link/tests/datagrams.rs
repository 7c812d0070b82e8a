//! Destination and age of the datagrams of a listening port.

use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_time::{Instant, Timer};

use super::*;

macro_rules! socket {
    ($name:ident, $net:expr, $port:expr) => {
        let (mut rx_meta, mut tx_meta) = ([PacketMetadata::EMPTY; 16], [PacketMetadata::EMPTY; 4]);
        let (mut rx, mut tx) = ([0; 2048], [0; 256]);
        let mut $name = UdpSocket::new($net.controller, &mut rx_meta, &mut rx, &mut tx_meta, &mut tx);
        $name.bind($port).unwrap();
    };
}

/// The outputs that the next frame of the gateway switches.
async fn next(socket: &UdpSocket<'_>) -> u8 {
    let mut frame = [0; 256];
    let (len, _) = socket.recv_from(&mut frame).await.unwrap();
    assert_eq!(frame[..len], switching(frame[2]));
    frame[2]
}

#[test]
fn frames_go_to_whoever_sent_a_frame_last_and_to_nobody_for_less() {
    among(&config(udp_listen(), FirstSpeaker::Frames), listens, async |net| {
        let at = gateway_port();
        socket!(client, net, 1);
        socket!(other, net, 2);
        // The first datagram opens the link, whatever it contains.
        client.send_to(&[0; 3], at).await.unwrap();
        net.seen(1, 0).await;
        net.hear(&switching(1));
        assert_eq!(next(&client).await, 1);
        let mut malformed = net.link().2.malformed;
        for junk in [&[0; 3][..], &FRAME[..4], &[0; 1_500], &[]] {
            other.send_to(junk, at).await.unwrap_or_default();
            client.send_to(&FRAME, at).await.unwrap();
            let received = net.link().2.received + 1;
            until(|| net.link().2.received == received).await;
            net.hear(&switching(2));
            assert_eq!(next(&client).await, 2);
        }
        until(|| net.link().2.malformed > malformed + 1).await;
        malformed = net.link().2.malformed;
        other.send_to(&FRAME, at).await.unwrap();
        let received = net.link().2.received + 1;
        until(|| net.link().2.received == received).await;
        net.hear(&switching(3));
        assert_eq!(next(&other).await, 3);
        // And back.
        client.send_to(&FRAME, at).await.unwrap();
        until(|| net.link().2.received == received + 1).await;
        net.hear(&switching(4));
        assert_eq!(next(&client).await, 4);
        assert_eq!(net.link().2.malformed, malformed);
        assert!(!client.may_recv() && !other.may_recv());
    });
}

#[test]
fn what_waits_for_a_host_that_is_not_found_is_not_sent_when_it_is_old() {
    among(&config(udp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        socket!(client, net, 1);
        client.send_to(&FRAME, gateway_port()).await.unwrap();
        net.seen(1, 0).await;
        net.hear(&switching(1));
        assert_eq!(next(&client).await, 1);
        // Long enough for its ARP entry to expire.
        net.wire.cut_off(CONTROLLER, CONTROLLER);
        net.wire.step.set(Duration::from_millis(2));
        let end = Instant::now() + Duration::from_secs(70);
        while Instant::now() < end {
            net.hear(&switching(1));
            Timer::after(Duration::from_millis(20)).await;
        }
        let end = Instant::now() + Duration::from_millis(300);
        while Instant::now() < end {
            net.hear(&switching(2));
            Timer::after(Duration::from_millis(20)).await;
        }
        net.wire.cut_off(0, 0);
        net.wire.step.set(Duration::from_micros(200));
        let mut received = 0;
        while received < 50 {
            net.hear(&switching(2));
            Timer::after(Duration::from_millis(20)).await;
            while client.may_recv() {
                assert_eq!(next(&client).await, 2, "it is old");
                received += 1;
            }
        }
        assert_eq!(net.link().0, 1, "the link stays up");
    });
}
