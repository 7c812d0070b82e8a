//! What becomes of bytes that were handed over, with peers whose cable is pulled.

use std::io::Read;
use std::os::fd::AsRawFd;

use tokio::io::AsyncWriteExt;
use tokio::net::TcpSocket;
use tokio::task::yield_now;

use super::super::tests::{Running, Seen, inside, server, tcp_listen};
use super::super::{Endpoint, TurnedAway};
use super::*;

/// Pulls the cable at this end: no segment that comes reaches it, no reset either.
fn pull(peer: &TcpStream) {
    let mut drop_all = libc::sock_filter { code: (libc::BPF_RET | libc::BPF_K) as u16, jt: 0, jf: 0, k: 0 };
    let program = libc::sock_fprog { len: 1, filter: &raw mut drop_all };
    set(peer, libc::SO_ATTACH_FILTER, &program);
}

fn plug(peer: &TcpStream) {
    set(peer, libc::SO_DETACH_FILTER, &0_i32);
}

fn set<T>(socket: &TcpStream, name: libc::c_int, value: &T) {
    let len = size_of::<T>() as libc::socklen_t;
    // SAFETY: the descriptor is open while `socket` is borrowed; `value`, and what a filter's value leads to,
    // outlive the call, which copies them.
    let done = unsafe {
        libc::setsockopt(socket.as_raw_fd(), libc::SOL_SOCKET, name, (&raw const *value).cast(), len)
    };
    assert_eq!(done, 0, "{}", io::Error::last_os_error());
}

/// A link that is up, and its peer.
async fn pair() -> (Running, TcpListener, TcpStream) {
    let (listener, endpoint) = server().await;
    let link = Running::start(endpoint);
    link.control.open();
    let (peer, _) = listener.accept().await.unwrap();
    link.expect(Seen::Up).await;
    (link, listener, peer)
}

/// Whether the system still has the other end of this connection, be it of no process any more.
fn has_other_end(peer: &TcpStream) -> bool {
    let end = |at: std::net::SocketAddr| format!("0100007F:{:04X}", at.port());
    let (own, other) = (end(peer.local_addr().unwrap()), end(peer.peer_addr().unwrap()));
    let table = std::fs::read_to_string("/proc/self/net/tcp").unwrap();
    table.lines().any(|line| line.contains(&format!("{other} {own} ")))
}

/// Once plugged in, the peer learns that the connection is over, and never gets another byte.
async fn gets_nothing(mut peer: TcpStream) {
    // The link's task needs a few turns; a system that still tried to deliver would do so for seconds.
    for _ in 0..100 {
        yield_now().await;
    }
    assert!(!has_other_end(&peer), "it would be delivered later");
    plug(&peer);
    // Nobody is there to answer: that is a reset.
    peer.write_all(b"?").await.unwrap();
    let mut got = Vec::new();
    let ended = tokio::io::AsyncReadExt::read_to_end(&mut peer, &mut got).await;
    assert_eq!((ended.unwrap_err().kind(), got), (io::ErrorKind::ConnectionReset, vec![]));
}

#[test]
fn what_was_acknowledged_is_told_before_what_arrived() {
    inside(async || {
        let (link, _listener, mut peer) = pair().await;
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
        pull(&peer);
        for _ in 0..3 {
            link.control.send(b"frame");
            assert_eq!(link.next().await, Seen::Sent);
        }
        sleep(3 * LOOK).await;
        assert!(link.seen.events.borrow().is_empty(), "nothing has changed");
        plug(&peer);
        let mut got = [0; 15];
        peer.read_exact(&mut got).await.unwrap();
        assert_eq!(&got, b"frameframeframe");
        loop {
            match link.next().await {
                Seen::Acked(0) => break,
                Seen::Acked(left) => assert!(left < 15, "{left}"),
                other => panic!("{other:?}"),
            }
        }
    });
}

#[test]
fn what_the_link_itself_still_holds_is_not_acknowledged_either() {
    inside(async || {
        let small = TcpSocket::new_v4().unwrap();
        small.set_recv_buffer_size(4_096).unwrap();
        small.bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let listener = small.listen(4).unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(Endpoint::Tcp { host: at.ip().to_string(), port: at.port() });
        link.control.open();
        let (mut peer, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        // More than the buffers of both ends take.
        const ALL: u32 = 16 << 20;
        link.control.send(&vec![0; ALL as usize]);
        let Seen::Acked(mut left) = link.next().await else { panic!("sent") };
        assert!((ALL / 2..ALL).contains(&left), "{left}");
        let mut is_sent = false;
        let reading = async {
            let mut read = 0;
            let mut chunk = vec![0; 1 << 16];
            while read < ALL as usize {
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
        pull(&peer);
        link.control.send(b"old");
        assert_eq!(link.next().await, Seen::Sent);
        link.control.close();
        link.control.open();
        let (_fresh, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        gets_nothing(peer).await;
        assert!(link.is_silent());
    });
}

#[test]
fn nor_does_what_was_handed_over_when_the_gateway_ended() {
    inside(async || {
        let (link, _listener, peer) = pair().await;
        pull(&peer);
        link.control.send(b"old");
        assert_eq!(link.next().await, Seen::Sent);
        drop(link);
        gets_nothing(peer).await;
    });
}

#[test]
fn nor_what_a_listening_link_sent() {
    inside(async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(tcp_listen(listener));
        link.control.open();
        let peer = TcpStream::connect(at).await.unwrap();
        link.expect(Seen::Up).await;
        pull(&peer);
        link.control.send(b"old");
        assert_eq!(link.next().await, Seen::Sent);
        link.control.close();
        gets_nothing(peer).await;
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
        pull(&peer);
        let begin = Instant::now();
        link.control.send(b"frame");
        assert_eq!(link.next().await, Seen::Sent);
        assert_eq!(link.next().await, Seen::Down);
        assert!(begin.elapsed() >= PATIENCE / 2, "{:?}", begin.elapsed());
        gets_nothing(peer).await;
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
        assert_eq!(link.control.turned_away(), TurnedAway { strangers: 0, refused: 1 });
    });
}
