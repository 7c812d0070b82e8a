//! Acknowledgement of bytes that were sent, with peers whose buffers are too small for them.

use std::io::Read;
use std::os::fd::AsFd;

use rustix::net::sockopt;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpSocket;
use tokio::sync::Notify;
use tokio::task::yield_now;

use super::super::tests::{Running, Seen, connected, inside, tcp_listen};
use super::super::{LinkControl, LinkEndpoint, Refusals};
use super::*;

/// A link that is up, and its peer, which has a small receive buffer.
async fn pair() -> (Running, TcpListener, TcpStream) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(1).unwrap();
    socket.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let listener = socket.listen(4).unwrap();
    let at = listener.local_addr().unwrap();
    let link = Running::start(LinkEndpoint::Tcp { host: at.ip().to_string(), port: at.port() });
    link.control.open();
    let (peer, _) = listener.accept().await.unwrap();
    link.expect(Seen::Up).await;
    (link, listener, peer)
}

const PIECE: usize = 1_024;
const PIECES: u8 = 16;
const ALL: usize = PIECE * PIECES as usize;

/// Sends more than fits the peer's buffer, and less than fits ours.
async fn fill(link: &Running) {
    for piece in 1..=PIECES {
        link.control.send(&[piece; PIECE]);
        link.expect(Seen::Sent).await;
    }
}

/// The peer reads what its system had acknowledged, and then gets a reset.
async fn gets_nothing_more(mut peer: TcpStream) {
    let mut got = Vec::new();
    let ended = peer.read_to_end(&mut got).await;
    assert!(!got.contains(&PIECES), "{} bytes", got.len());
    assert_eq!(ended.unwrap_err().kind(), io::ErrorKind::ConnectionReset);
}

#[test]
fn acknowledgements_are_reported_before_later_data() {
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
        // Nothing is outstanding, so nothing is reported.
        peer.write_all(b"more").await.unwrap();
        assert_eq!(link.next().await, Seen::Bytes(b"more".to_vec()));
    });
}

#[test]
fn what_is_handed_over_is_sent_before_the_links_task_runs() {
    inside(async || {
        let (link, _listener, peer) = connected().await;
        // Blocking reads: no task runs until they return.
        let mut peer = peer.into_std().unwrap();
        peer.set_nonblocking(false).unwrap();
        peer.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        for round in 0..3_u8 {
            link.control.send(&[round; 5]);
            let mut got = [0; 5];
            peer.read_exact(&mut got).unwrap();
            assert_eq!(got, [round; 5]);
            assert!(link.is_silent());
            link.expect(Seen::Sent).await;
        }
    });
}

#[test]
fn what_does_not_fit_is_sent_by_the_task_in_order() {
    inside(async || {
        let (link, _listener, peer) = pair().await;
        // More than fits the buffers of both sides.
        const MUCH: usize = 8 << 20;
        link.control.send(&vec![1; MUCH]);
        assert!(link.control.waiting() > 0);
        // There is room for the second one before the task has sent the rest of the first one.
        let mut peer = peer.into_std().unwrap();
        peer.set_nonblocking(false).unwrap();
        peer.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut got = vec![0; MUCH + PIECE];
        let read = MUCH - link.control.waiting();
        peer.read_exact(&mut got[..read]).unwrap();
        link.control.send(&[2; PIECE]);
        assert!(link.control.waiting() > PIECE, "{}", link.control.waiting());
        peer.set_nonblocking(true).unwrap();
        let mut peer = TcpStream::from_std(peer).unwrap();
        peer.read_exact(&mut got[read..]).await.unwrap();
        assert!(got[..MUCH].iter().all(|byte| *byte == 1));
        assert_eq!(got[MUCH..], [2; PIECE]);
        link.expect(Seen::Sent).await;
        assert!(link.is_silent(), "once for both");
    });
}

#[test]
fn a_loss_that_is_found_when_something_is_handed_over_is_reported_once() {
    inside(async || {
        let (link, listener, peer) = connected().await;
        tcp_options::reset_on_close(&peer).unwrap();
        // Without a chance for the link's task, which would notice it by itself.
        drop(peer);
        link.control.send(b"to a peer that is gone");
        link.control.send(b"to a connection that has failed");
        link.expect(Seen::Down).await;
        assert!(link.is_silent());
        link.control.open();
        let (mut peer, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        link.control.send(b"new");
        let mut got = [0; 3];
        peer.read_exact(&mut got).await.unwrap();
        assert_eq!(&got, b"new");
    });
}

#[test]
fn a_late_acknowledgement_is_reported() {
    inside(async || {
        let (link, _listener, mut peer) = pair().await;
        fill(&link).await;
        sleep(3 * ACK_POLL).await;
        // Only the part that fits was reported.
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
fn bytes_that_the_link_still_holds_are_not_acknowledged_either() {
    inside(async || {
        let (link, _listener, mut peer) = pair().await;
        // More than fits the buffers of both sides.
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
fn the_systems_time_limit_stays_between_transmissions_and_goes_in_silence() {
    inside(async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut stream = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (mut peer, _) = listener.accept().await.unwrap();
        let socket = stream.as_fd().try_clone_to_owned().unwrap();
        let limit = || sockopt::tcp_user_timeout(&socket).unwrap();
        let control = LinkControl::default();
        control.open();
        let link = LinkTask { name: "link", control: &control };
        let (connection, reader) = LinkConnection::new(&link, control.session.get(), &mut stream).unwrap();
        let answered = Notify::new();
        let mut events = |event: LinkEvent<'_>| {
            if let LinkEvent::Bytes(_) = event {
                answered.notify_one();
            }
        };
        let timeline = async {
            assert_eq!(limit(), 0);
            for _ in 0..3 {
                control.send(b"request");
                // The connection sees that something is missing before it is answered.
                yield_now().await;
                peer.read_exact(&mut [0; 7]).await.unwrap();
                peer.write_all(b"answer").await.unwrap();
                answered.notified().await;
                assert_eq!(limit(), USER_TIMEOUT.as_millis() as u32);
            }
            let quiet = Instant::now();
            while limit() != 0 {
                sleep(Duration::from_millis(5)).await;
            }
            assert!(quiet.elapsed() >= QUIET / 2, "{:?}", quiet.elapsed());
            control.close();
        };
        let (ended, ()) = tokio::join!(connection.carry(reader, None, &mut events), timeline);
        ended.unwrap();
    });
}

#[test]
fn bytes_not_acknowledged_at_the_close_never_arrive() {
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
fn nor_do_those_not_acknowledged_at_the_end_of_the_gateway() {
    inside(async || {
        let (link, _listener, peer) = pair().await;
        fill(&link).await;
        drop(link);
        gets_nothing_more(peer).await;
    });
}

#[test]
fn nor_those_of_a_listening_link() {
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
fn a_connection_made_during_the_close_is_not_used_by_the_next_session() {
    inside(async || {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(LinkEndpoint::Tcp { host: at.ip().to_string(), port: at.port() });
        for round in 0..40_u8 {
            link.control.open();
            yield_now().await;
            // The link's task does not run until the connection is made and the engine has closed and opened
            // again.
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
fn the_system_ends_a_connection_whose_peer_acknowledges_nothing() {
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
fn a_client_that_connected_while_the_link_was_closed_must_connect_again() {
    inside(async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(tcp_listen(listener));
        // In the first session nothing is old: the gateway has just started.
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
