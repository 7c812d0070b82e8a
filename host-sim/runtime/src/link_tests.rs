//! Links against real sockets that behave like a controller.

use std::collections::VecDeque;
use std::rc::Rc;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::{JoinHandle, LocalSet, spawn_local};

use super::*;

/// A link's event, owned.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Seen {
    Up,
    Down,
    Bytes(Vec<u8>),
    Sent,
    Acked(u32),
}

/// A running link, controlled by the test in place of the engine.
pub(super) struct Running {
    pub(super) control: Rc<LinkControl>,
    pub(super) seen: Rc<Log>,
    task: JoinHandle<()>,
}

#[derive(Default)]
pub(super) struct Log {
    pub(super) events: RefCell<VecDeque<Seen>>,
    wake: Notify,
}

impl Running {
    pub(super) fn start(endpoint: LinkEndpoint) -> Self {
        let (control, seen) = (Rc::new(LinkControl::default()), Rc::new(Log::default()));
        let (own, log) = (Rc::clone(&control), Rc::clone(&seen));
        let task = spawn_local(async move {
            let is_frame = |datagram: &[u8]| !datagram.starts_with(GARBAGE);
            run("test", &endpoint, &own, is_frame, |event| {
                log.events.borrow_mut().push_back(match event {
                    LinkEvent::Up => Seen::Up,
                    LinkEvent::Down => Seen::Down,
                    LinkEvent::Bytes(bytes) => Seen::Bytes(bytes.to_vec()),
                    LinkEvent::Sent => Seen::Sent,
                    LinkEvent::Acked(left) => Seen::Acked(left),
                });
                log.wake.notify_one();
            })
            .await;
        });
        Self { control, seen, task }
    }

    /// The next event of any kind.
    pub(super) async fn next(&self) -> Seen {
        loop {
            if let Some(event) = self.seen.events.borrow_mut().pop_front() {
                return event;
            }
            self.seen.wake.notified().await;
        }
    }

    /// The next event that is no acknowledgement, whose timing depends on the system.
    #[track_caller]
    pub(super) fn expect(&self, expected: Seen) -> impl Future<Output = ()> {
        let at = std::panic::Location::caller();
        async move {
            let next = loop {
                match self.next().await {
                    Seen::Acked(_) => {}
                    next => break next,
                }
            };
            assert_eq!(next, expected, "at {at}");
        }
    }

    /// Whether there is no event but acknowledgements.
    pub(super) fn is_silent(&self) -> bool {
        self.seen.events.borrow().iter().all(|event| matches!(event, Seen::Acked(_)))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.task.abort();
    }
}

pub(super) fn inside(test: impl AsyncFnOnce()) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        tokio::time::timeout(Duration::from_secs(20), test()).await.expect("the test hangs");
    });
}

pub(super) fn tcp_listen(listener: TcpListener) -> LinkEndpoint {
    LinkEndpoint::TcpListen { listener, controller: "127.0.0.1".to_owned() }
}

fn udp_listen(socket: UdpSocket) -> LinkEndpoint {
    LinkEndpoint::UdpListen { socket, controller: "127.0.0.1".to_owned() }
}

pub(super) async fn server() -> (TcpListener, LinkEndpoint) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = listener.local_addr().unwrap();
    (listener, LinkEndpoint::Tcp { host: at.ip().to_string(), port: at.port() })
}

/// A TCP link that is up, its server, and the server's side of the connection.
pub(super) async fn connected() -> (Running, TcpListener, TcpStream) {
    let (listener, endpoint) = server().await;
    let link = Running::start(endpoint);
    link.control.open();
    let (peer, _) = listener.accept().await.unwrap();
    link.expect(Seen::Up).await;
    (link, listener, peer)
}

/// A link that waits for datagrams, and its address.
async fn udp_listening() -> (Running, std::net::SocketAddr) {
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let at = socket.local_addr().unwrap();
    let link = Running::start(udp_listen(socket));
    link.control.open();
    (link, at)
}

#[test]
fn a_tcp_link_opens_carries_and_reports_its_loss_once() {
    inside(async || {
        let (listener, endpoint) = server().await;
        let link = Running::start(endpoint);
        for round in 0..3_u8 {
            link.control.open();
            let (mut peer, _) = listener.accept().await.unwrap();
            link.expect(Seen::Up).await;
            link.control.send(&[round, 1]);
            link.expect(Seen::Sent).await;
            let mut got = [0; 2];
            peer.read_exact(&mut got).await.unwrap();
            assert_eq!(got, [round, 1]);
            peer.write_all(&[round, 2]).await.unwrap();
            link.expect(Seen::Bytes(vec![round, 2])).await;
            if round == 1 {
                // A reset, no orderly end.
                rustix::net::sockopt::set_socket_linger(&peer, Some(Duration::ZERO)).unwrap();
            }
            drop(peer);
            link.expect(Seen::Down).await;
        }
        assert!(link.is_silent());
    });
}

#[test]
fn a_refused_connection_is_reported_and_retried_only_on_request() {
    inside(async || {
        let (listener, endpoint) = server().await;
        let at = listener.local_addr().unwrap();
        drop(listener);
        let link = Running::start(endpoint);
        link.control.open();
        link.expect(Seen::Down).await;
        let listener = TcpListener::bind(at).await.unwrap();
        link.control.open();
        link.expect(Seen::Up).await;
        drop(listener);
    });
}

#[test]
fn after_a_close_nothing_is_reported_and_nothing_old_is_sent() {
    inside(async || {
        let (link, listener, mut peer) = connected().await;
        peer.write_all(b"late").await.unwrap();
        link.control.send(b"old");
        link.control.close();
        // Too late.
        link.control.send(b"older");
        let mut rest = Vec::new();
        // Bytes in flight reset the connection.
        let _ = peer.read_to_end(&mut rest).await;
        assert_eq!(rest, b"old", "it was at the peer before the close");
        link.control.open();
        let (mut peer, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        link.control.send(b"new");
        let mut got = [0; 3];
        peer.read_exact(&mut got).await.unwrap();
        assert_eq!(&got, b"new");
        link.expect(Seen::Sent).await;
    });
}

#[test]
fn a_peer_that_reads_nothing_does_not_prevent_the_close() {
    inside(async || {
        let small = TcpSocket::new_v4().unwrap();
        small.set_recv_buffer_size(4_096).unwrap();
        small.bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let listener = small.listen(4).unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(LinkEndpoint::Tcp { host: at.ip().to_string(), port: at.port() });
        link.control.open();
        let (mut idle_peer, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        // More than any buffer holds, so this is never sent.
        link.control.send(&vec![0; 64 << 20]);
        idle_peer.read_exact(&mut [0]).await.unwrap();
        link.control.close();
        link.control.open();
        let (_fresh, _) = listener.accept().await.unwrap();
        link.expect(Seen::Up).await;
        assert!(link.is_silent());
        // It never gets what it has not read by now, which would be old.
        let ended = idle_peer.read_to_end(&mut Vec::new()).await;
        assert_eq!(ended.unwrap_err().kind(), io::ErrorKind::ConnectionReset);
    });
}

#[test]
fn a_listening_link_accepts_one_connection_at_a_time() {
    inside(async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = listener.local_addr().unwrap();
        let link = Running::start(tcp_listen(listener));
        link.control.open();
        let mut first = TcpStream::connect(at).await.unwrap();
        link.expect(Seen::Up).await;
        let mut second = TcpStream::connect(at).await.unwrap();
        assert_eq!(second.read(&mut [0; 4]).await.unwrap(), 0, "turned away");
        assert_eq!(link.control.refusals(), Refusals { strangers: 0, refused: 1 });
        first.write_all(b"here").await.unwrap();
        link.expect(Seen::Bytes(b"here".to_vec())).await;
        drop(first);
        link.expect(Seen::Down).await;
        link.control.open();
        tokio::task::yield_now().await;
        let mut third = TcpStream::connect(at).await.unwrap();
        link.expect(Seen::Up).await;
        link.control.send(b"hello");
        let mut got = [0; 5];
        third.read_exact(&mut got).await.unwrap();
        assert_eq!(&got, b"hello");
    });
}

#[test]
fn a_udp_link_is_down_if_the_peer_is_unreachable() {
    inside(async || {
        let peer = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let at = peer.local_addr().unwrap();
        let link = Running::start(LinkEndpoint::Udp { host: at.ip().to_string(), port: at.port() });
        link.control.open();
        link.expect(Seen::Up).await;
        link.control.send(b"frame");
        link.expect(Seen::Sent).await;
        let mut got = [0; 16];
        let (len, gateway) = peer.recv_from(&mut got).await.unwrap();
        assert_eq!(&got[..len], b"frame");
        peer.send_to(b"answer", gateway).await.unwrap();
        link.expect(Seen::Bytes(b"answer".to_vec())).await;
        drop(peer);
        link.control.send(b"frame");
        link.expect(Seen::Sent).await;
        link.expect(Seen::Down).await;
    });
}

#[test]
fn a_udp_link_is_down_if_that_is_found_when_something_is_handed_over() {
    inside(async || {
        let peer = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let at = peer.local_addr().unwrap();
        let link = Running::start(LinkEndpoint::Udp { host: at.ip().to_string(), port: at.port() });
        link.control.open();
        link.expect(Seen::Up).await;
        // The task has a socket to lend.
        tokio::task::yield_now().await;
        drop(peer);
        // The first one is refused, and the system says so to the second one, and to nobody else.
        link.control.send(b"frame");
        link.control.send(b"frame");
        link.expect(Seen::Down).await;
        assert!(link.is_silent());
    });
}

#[test]
fn a_listening_udp_link_answers_the_sender_of_the_newest_frame() {
    inside(async || {
        let (link, at) = udp_listening().await;
        let (one, two) =
            (UdpSocket::bind("127.0.0.1:0").await.unwrap(), UdpSocket::bind("127.0.0.1:0").await.unwrap());
        one.send_to(b"first", at).await.unwrap();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"first".to_vec())).await;
        two.send_to(b"second", at).await.unwrap();
        link.expect(Seen::Bytes(b"second".to_vec())).await;
        link.control.send(b"to the second");
        link.expect(Seen::Sent).await;
        let mut got = [0; 32];
        let (len, _) = two.recv_from(&mut got).await.unwrap();
        assert_eq!(&got[..len], b"to the second");
    });
}

/// The first bytes of a datagram that is no frame.
const GARBAGE: &[u8] = b"?";

#[test]
fn a_datagram_that_is_no_frame_is_reported_and_does_not_change_the_peer() {
    inside(async || {
        let (link, at) = udp_listening().await;
        let (robot, other) =
            (UdpSocket::bind("127.0.0.1:0").await.unwrap(), UdpSocket::bind("127.0.0.1:0").await.unwrap());
        robot.send_to(b"frame", at).await.unwrap();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"frame".to_vec())).await;
        other.send_to(b"?", at).await.unwrap();
        link.expect(Seen::Bytes(b"?".to_vec())).await;
        link.control.send(b"to the robot");
        link.expect(Seen::Sent).await;
        let mut got = [0; 32];
        let (len, _) = robot.recv_from(&mut got).await.unwrap();
        assert_eq!(&got[..len], b"to the robot");
    });
}

#[test]
fn the_sender_of_the_first_datagram_is_answered_whatever_it_sent() {
    inside(async || {
        let (link, at) = udp_listening().await;
        let robot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        robot.send_to(b"? hello", at).await.unwrap();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"? hello".to_vec())).await;
        link.control.send(b"answer");
        let mut got = [0; 32];
        let (len, _) = robot.recv_from(&mut got).await.unwrap();
        assert_eq!(&got[..len], b"answer");
    });
}

#[test]
fn datagrams_that_came_while_the_link_was_closed_are_never_reported() {
    inside(async || {
        let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let at = socket.local_addr().unwrap();
        let link = Running::start(udp_listen(socket));
        let robot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        // In the first session nothing is old: the gateway has just started.
        robot.send_to(b"early", at).await.unwrap();
        link.control.open();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"early".to_vec())).await;
        for round in 0..20_u8 {
            link.control.close();
            tokio::task::yield_now().await;
            for _ in 0..round {
                robot.send_to(b"stale", at).await.unwrap();
            }
            link.control.open();
            // Datagrams after the opening are reported.
            tokio::task::yield_now().await;
            robot.send_to(&[round], at).await.unwrap();
            link.expect(Seen::Up).await;
            link.expect(Seen::Bytes(vec![round])).await;
        }
    });
}

/// Another host on the same machine.
const STRANGER: &str = "127.0.0.2:0";

#[test]
fn only_the_controller_is_accepted_and_others_do_it_no_harm() {
    inside(async || {
        let listener = TcpListener::bind("0.0.0.0:0").await.unwrap();
        let at = SocketAddr::from(([127, 0, 0, 1], listener.local_addr().unwrap().port()));
        let link = Running::start(tcp_listen(listener));
        link.control.open();
        let knock = async || {
            let socket = TcpSocket::new_v4().unwrap();
            socket.bind(STRANGER.parse().unwrap()).unwrap();
            let mut stranger = socket.connect(at).await.unwrap();
            assert_eq!(stranger.read(&mut [0; 4]).await.unwrap(), 0, "turned away");
        };
        knock().await;
        let mut controller = TcpStream::connect(at).await.unwrap();
        link.expect(Seen::Up).await;
        knock().await;
        controller.write_all(b"here").await.unwrap();
        link.expect(Seen::Bytes(b"here".to_vec())).await;
        assert_eq!(link.control.refusals(), Refusals { strangers: 2, refused: 0 });
    });
}

#[test]
fn a_strangers_datagrams_are_neither_reported_nor_answered() {
    inside(async || {
        let socket = UdpSocket::bind("0.0.0.0:0").await.unwrap();
        let at = SocketAddr::from(([127, 0, 0, 1], socket.local_addr().unwrap().port()));
        let link = Running::start(udp_listen(socket));
        link.control.open();
        let stranger = UdpSocket::bind(STRANGER).await.unwrap();
        let controller = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        stranger.send_to(b"first", at).await.unwrap();
        controller.send_to(b"here", at).await.unwrap();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"here".to_vec())).await;
        stranger.send_to(b"last", at).await.unwrap();
        controller.send_to(b"again", at).await.unwrap();
        link.expect(Seen::Bytes(b"again".to_vec())).await;
        link.control.send(b"to the controller");
        link.expect(Seen::Sent).await;
        let mut got = [0; 32];
        let (len, _) = controller.recv_from(&mut got).await.unwrap();
        assert_eq!(&got[..len], b"to the controller");
        assert_eq!(link.control.refusals().strangers, 2);
    });
}

#[test]
fn a_program_on_this_host_may_replace_the_controller() {
    inside(async || {
        let elsewhere = || "192.0.2.1".to_owned();
        for address in ["127.0.0.1:0", "[::1]:0"] {
            let Ok(listener) = TcpListener::bind(address).await else { continue };
            let at = listener.local_addr().unwrap();
            let link = Running::start(LinkEndpoint::TcpListen { listener, controller: elsewhere() });
            link.control.open();
            let _peer = TcpStream::connect(at).await.unwrap();
            link.expect(Seen::Up).await;
        }
        let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let at = socket.local_addr().unwrap();
        let link = Running::start(LinkEndpoint::UdpListen { socket, controller: elsewhere() });
        link.control.open();
        let peer = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        peer.send_to(b"here", at).await.unwrap();
        link.expect(Seen::Up).await;
        link.expect(Seen::Bytes(b"here".to_vec())).await;
        assert_eq!(link.control.refusals(), Refusals::default());
    });
}
