//! What becomes of bytes that were handed over, with peers that have no room for them: what does not fit
//! there is not acknowledged.

use std::io::Read;

use tokio::io::AsyncWriteExt;
use tokio::net::TcpSocket;
use tokio::task::yield_now;

use super::super::tests::{Running, Seen, connected, inside, tcp_listen};
use super::super::{Endpoint, Refusals};
use super::*;

/// A link that is up, and its peer, whose system takes little.
async fn pair() -> (Running, TcpListener, TcpStream) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(1).unwrap();
    socket.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let listener = socket.listen(4).unwrap();
    let at = listener.local_addr().unwrap();
    let link = Running::start(Endpoint::Tcp { host: at.ip().to_string(), port: at.port() });
    link.control.open();
    let (peer, _) = listener.accept().await.unwrap();
    link.expect(Seen::Up).await;
    (link, listener, peer)
}

const PIECE: usize = 1_024;
const PIECES: u8 = 16;
const ALL: usize = PIECE * PIECES as usize;

/// Hands over more than the peer's system takes and less than ours does.
async fn fill(link: &Running) {
    for piece in 1..=PIECES {
        link.control.send(&[piece; PIECE]);
        link.expect(Seen::Sent).await;
    }
}

/// Who reads on now finds what its system had acknowledged, and then a reset.
async fn gets_nothing_more(mut peer: TcpStream) {
    let mut got = Vec::new();
    let ended = peer.read_to_end(&mut got).await;
    assert!(!got.contains(&PIECES), "{} bytes", got.len());
    assert_eq!(ended.unwrap_err().kind(), io::ErrorKind::ConnectionReset);
}

#[test]
fn what_was_acknowledged_is_told_before_what_arrived() {
    inside(async || {
        let (link, _listener, mut peer) = connected().await;
        for round in 0..50_u8 {
            link.control.send(&[round; 5]);
            assert_eq!(link.next().await, Seen::Sent);
            peer.read_exact(&mut [0; 5]).await.unwrap();
            peer.write_all(&[round]).await.unwrap();
            assert_eq!(link.next().await, Seen::Acked(0));
            assert_eq!(link.next().await, Seen::Bytes(vec![round]));
        }
        // Nothing is outstanding, so nothing is said of it.
        peer.write_all(b"more").await.unwrap();
        assert_eq!(link.next().await, Seen::Bytes(b"more".to_vec()));
    });
}

#[test]
fn what_is_taken_and_not_acknowledged_is_told_when_it_is() {
    inside(async || {
        let (link, _listener, mut peer) = pair().await;
        fill(&link).await;
        sleep(3 * ACK_POLL).await;
        // All that was said is how little there was room for.
        let mut left = ALL as u32;
        while let Some(event) = link.seen.events.borrow_mut().pop_front() {
            match event {
                Seen::Acked(now_left) => left = now_left,
                other => panic!("{other:?}"),
            }
        }
        assert!((ALL as u32 / 2..=ALL as u32).contains(&left), "{left}");
        let mut got = vec![0; ALL];
        peer.read_exact(&mut got).await.unwrap();
        assert_eq!(got.last(), Some(&PIECES));
        while left > 0 {
            match link.next().await {
                Seen::Acked(now_left) if now_left < left => left = now_left,
                other => panic!("{other:?} after {left}"),
            }
        }
    });
}

#[test]
fn what_the_link_itself_still_holds_is_not_acknowledged_either() {
    inside(async || {
        let (link, _listener, mut peer) = pair().await;
        // More than the buffers of both ends take.
        const MUCH: u32 = 16 << 20;
        link.control.send(&vec![0; MUCH as usize]);
        let Seen::Acked(mut left) = link.next().await else { panic!("sent") };
        assert!((MUCH / 2..MUCH).contains(&left), "{left}");
        let mut is_sent = false;
        let reading = async {
            let mut read = 0;
            let mut chunk = vec![0; 1 << 16];
            while read < MUCH as usize {
                read += peer.read(&mut chunk).await.unwrap();
            }
        };
        let watching = async {
            while left > 0 {
                match link.next().await {
                    Seen::Acked(now_left) => {
                        assert!(now_left < left);
                        left = now_left;
                    }
                    Seen::Sent => is_sent = true,
                    other => panic!("{other:?}"),
                }
            }
        };
        tokio::join!(reading, watching);
        assert!(is_sent);
    });
}

#[test]
fn what_was_not_acknowledged_when_the_link_was_closed_never_arrives() {
    inside(async || {
        let (link, listener, peer) = pair().await;
        fill(&link).await;
        link.control.close();
        link.control.open();
        let (_fresh, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        gets_nothing_more(peer).await;
        assert!(link.is_silent());
    });
}

#[test]
fn nor_does_what_was_handed_over_when_the_gateway_ended() {
    inside(async || {
        let (link, _listener, peer) = pair().await;
        fill(&link).await;
        drop(link);
        gets_nothing_more(peer).await;
    });
}

#[test]
fn nor_what_a_listening_link_sent() {
    inside(async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(tcp_listen(listener));
        link.control.open();
        let socket = TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(1).unwrap();
        let peer = socket.connect(at).await.unwrap();
        link.expect(Seen::Up).await;
        fill(&link).await;
        link.control.close();
        gets_nothing_more(peer).await;
    });
}

#[test]
fn a_connection_that_is_made_in_the_moment_of_the_close_is_not_taken_for_the_next() {
    inside(async || {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(Endpoint::Tcp { host: at.ip().to_string(), port: at.port() });
        for round in 0..40_u8 {
            link.control.open();
            yield_now().await;
            // The link's task does not run until it is made and the engine has changed its mind twice.
            let (mut first, _) = listener.accept().unwrap();
            link.control.close();
            link.control.open();
            assert_eq!(link.next().await, Seen::Up);
            link.control.send(&[round]);
            link.expect(Seen::Sent).await;
            let (mut second, _) = listener.accept().unwrap();
            second.read_exact(&mut [0]).unwrap();
            assert!(!matches!(first.read(&mut [0]), Ok(1..)), "round {round}");
            assert!(link.is_silent(), "round {round}: {:?}", link.seen.events.borrow());
            link.control.close();
            yield_now().await;
            link.seen.events.borrow_mut().clear();
        }
    });
}

#[test]
fn the_system_gives_up_a_peer_that_acknowledges_nothing() {
    inside(async || {
        let (link, _listener, peer) = pair().await;
        let begin = Instant::now();
        fill(&link).await;
        link.expect(Seen::Down).await;
        assert!(begin.elapsed() >= USER_TIMEOUT / 2, "{:?}", begin.elapsed());
        gets_nothing_more(peer).await;
    });
}

#[test]
fn who_connected_while_the_link_was_closed_has_to_do_it_again() {
    inside(async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(tcp_listen(listener));
        // Before the first opening nothing was closed: the gateway just started.
        let mut first = TcpStream::connect(at).await.unwrap();
        first.write_all(b"early").await.unwrap();
        link.control.open();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"early".to_vec())).await;
        drop(first);
        link.expect(Seen::Down).await;
        let mut waiting = TcpStream::connect(at).await.unwrap();
        waiting.write_all(b"stale").await.unwrap();
        link.control.open();
        assert!(!matches!(waiting.read(&mut [0; 8]).await, Ok(1..)));
        let mut again = TcpStream::connect(at).await.unwrap();
        again.write_all(b"fresh").await.unwrap();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"fresh".to_vec())).await;
        assert_eq!(link.control.refusals(), Refusals { strangers: 0, refused: 1 });
    });
}
