//! Who may connect to a listening port.

use embassy_futures::select::Either;
use embassy_net::tcp::TcpSocket;
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_time::Timer;

use super::*;

/// Longer than keep-alives may be unanswered.
const LONG: Duration = Duration::from_secs(40);

/// Connects again and again to a listener that is busy at first.
async fn connect_after_refusals(socket: &mut TcpSocket<'_>, at: IpEndpoint) {
    let mut refused = 0;
    while socket.connect(at).await.is_err() {
        socket.abort();
        refused += 1;
    }
    assert!(refused > 0, "nothing was in its way");
}

#[test]
fn a_tcp_listener_takes_the_controller_only() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let Net { controller, other_host, .. } = net;
        let at = gateway_port();
        let mut buffers = [[0; 256]; 4];
        let [rx, tx, other_rx, other_tx] = &mut buffers;
        let mut other = TcpSocket::new(other_host, other_rx, other_tx);
        for round in 1..=3 {
            // The listener may still be refusing the one before.
            while other.connect(at).await.is_err() {
                other.abort();
            }
            assert!(!matches!(other.read(&mut [0; 8]).await, Ok(1..)));
            other.abort();
            net.seen(0, round).await;
        }
        let mut own = TcpSocket::new(controller, rx, tx);
        while own.connect(at).await.is_err() {
            own.abort();
        }
        net.seen(1, 3).await;
        // A silent controller stays connected.
        Timer::after(LONG).await;
        net.seen(1, 3).await;
        // The only socket is in use.
        assert!(other.connect(at).await.is_err());
        own.abort();
        let _ = own.flush().await;
    });
}

#[test]
fn a_connection_that_never_comes_about_does_not_keep_the_listener() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let Net { controller, other_host, wire, .. } = net;
        let at = gateway_port();
        let mut buffers = [[0; 256]; 4];
        let [rx, tx, other_rx, other_tx] = &mut buffers;
        let mut other = TcpSocket::new(other_host, other_rx, other_tx);
        other.connect(at).await.unwrap();
        net.seen(0, 1).await;
        other.abort();
        other.flush().await.unwrap();
        // ARP is done now. It sends a SYN and disappears before the answer.
        wire.no_receive.set(OTHER);
        let before = wire.frames_sent.get();
        let asked =
            poll_fn(|_| if wire.frames_sent.get() == before { Poll::Pending } else { Poll::Ready(()) });
        assert!(matches!(select(other.connect(at), asked).await, Either::Second(())));
        wire.no_send.set(OTHER);
        let mut own = TcpSocket::new(controller, rx, tx);
        connect_after_refusals(&mut own, at).await;
        net.seen(1, 1).await;
    });
}

#[test]
fn a_controller_that_was_switched_off_finds_the_listener_free_again() {
    among(&config(tcp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let Net { controller, wire, .. } = net;
        let at = gateway_port();
        let mut buffers = [[0; 256]; 2];
        let [rx, tx] = &mut buffers;
        let mut own = TcpSocket::new(controller, rx, tx);
        own.connect(at).await.unwrap();
        net.seen(1, 0).await;
        // It disappears without a notice.
        wire.no_send.set(CONTROLLER);
        own.abort();
        own.flush().await.unwrap();
        wire.no_send.set(0);
        connect_after_refusals(&mut own, at).await;
        net.seen(2, 0).await;
    });
}

#[test]
fn a_udp_listener_takes_the_controller_only() {
    among(&config(udp_listen(), FirstSpeaker::Nothing), listens, async |net| {
        let Net { controller, other_host, .. } = net;
        let at = gateway_port();
        let mut buffers = [[0; 256]; 4];
        let mut metadata = [[PacketMetadata::EMPTY; 4]; 4];
        let [rx, tx, other_rx, other_tx] = &mut buffers;
        let [rx_meta, tx_meta, other_rx_meta, other_tx_meta] = &mut metadata;
        let mut other = UdpSocket::new(other_host, other_rx_meta, other_rx, other_tx_meta, other_tx);
        other.bind(1).unwrap();
        for round in 1..=3 {
            other.send_to(&FRAME, at).await.unwrap();
            net.seen(0, round).await;
        }
        let mut own = UdpSocket::new(controller, rx_meta, rx, tx_meta, tx);
        own.bind(1).unwrap();
        own.send_to(&FRAME, at).await.unwrap();
        net.seen(1, 3).await;
        other.send_to(&FRAME, at).await.unwrap();
        net.seen(1, 4).await;
    });
}
