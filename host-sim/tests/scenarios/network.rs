//! A proxy between programs of this host that simulates an Ethernet cable, which can be pulled.
//!
//! While it is pulled nothing gets through and no end is told: connections stall and TCP keeps what was
//! sent, closes and resets do not arrive, connection requests get no answer, datagrams are lost.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use super::environment::Cable;

/// Filters the bytes of one direction of a connection: it may change or remove them.
pub(crate) type Filter = dyn FnMut(&mut Vec<u8>) -> Pass + Send;

/// Whether a connection goes on after these bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pass {
    /// It goes on.
    On,
    /// It ends here, in both directions.
    Cut,
}

/// A loss of all datagrams in both directions, which begins with a certain datagram; by default none are
/// lost.
#[derive(Debug, Default)]
pub(crate) struct Loss {
    first: Vec<u8>,
    lasting: Duration,
    begun: Mutex<Option<Instant>>,
}

impl Loss {
    pub(crate) fn new(first: &[u8], lasting: Duration) -> Arc<Self> {
        Arc::new(Self { first: first.to_vec(), lasting, begun: Mutex::default() })
    }

    /// When it began; `None` if it has not.
    pub(crate) fn begun(&self) -> Option<Instant> {
        *self.begun.lock().unwrap()
    }

    fn takes(&self, datagram: &[u8]) -> bool {
        let mut begun = self.begun.lock().unwrap();
        if begun.is_none() && !self.first.is_empty() && datagram == self.first {
            *begun = Some(Instant::now());
        }
        begun.is_some_and(|begun| begun.elapsed() < self.lasting)
    }
}

/// Paths through the cable. They end when it is dropped.
#[derive(Debug, Default)]
pub(crate) struct Network {
    shared: Arc<Shared>,
    listeners: Vec<Arc<TcpListener>>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    is_pulled: bool,
    has_ended: bool,
    /// Connections that fill the listeners' queues while the cable is pulled, and their addresses.
    fillers: Vec<TcpStream>,
    filled_from: Vec<SocketAddr>,
}

impl Network {
    /// Adds an address that leads to this TCP server.
    pub(crate) fn tcp(&mut self, to: SocketAddr) -> SocketAddr {
        self.tcp_through(to, |_| -> [Box<Filter>; 2] {
            [Box::new(|_: &mut Vec<u8>| Pass::On), Box::new(|_: &mut Vec<u8>| Pass::On)]
        })
    }

    /// Same, with filters. `filters` gets the connection's number, from 0, and returns those to the server and
    /// to the client.
    pub(crate) fn tcp_through(
        &mut self,
        to: SocketAddr,
        mut filters: impl FnMut(u32) -> [Box<Filter>; 2] + Send + 'static,
    ) -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let place = listener.local_addr().unwrap();
        let listener = Arc::new(listener);
        self.listeners.push(Arc::clone(&listener));
        let shared = Arc::clone(&self.shared);
        std::thread::spawn(move || {
            let mut number = 0;
            while let Some(client) = shared.next_client(&listener) {
                // A missing server would refuse; here the connection is closed.
                let Ok(server) = TcpStream::connect(to) else { continue };
                for stream in [&client, &server] {
                    stream.set_nodelay(true).unwrap();
                    stream.set_read_timeout(Some(POLL_INTERVAL)).unwrap();
                }
                let (client, server) = (Arc::new(client), Arc::new(server));
                let [to_server, to_client] = filters(number);
                number += 1;
                let ways =
                    [(Arc::clone(&client), Arc::clone(&server), to_server), (server, client, to_client)];
                for (from, to, filter) in ways {
                    let shared = Arc::clone(&shared);
                    std::thread::spawn(move || shared.carry(&from, &to, filter));
                }
            }
        });
        place
    }

    /// Adds an address that leads to this UDP server; answers go to the newest sender.
    pub(crate) fn udp(&self, to: SocketAddr) -> SocketAddr {
        self.udp_losing(to, &Arc::default())
    }

    /// Same, with a loss of datagrams.
    pub(crate) fn udp_losing(&self, to: SocketAddr, loss: &Arc<Loss>) -> SocketAddr {
        let (listener, way) =
            (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        way.connect(to).unwrap();
        let place = listener.local_addr().unwrap();
        let ends = [listener, way].map(|socket| {
            socket.set_read_timeout(Some(POLL_INTERVAL)).unwrap();
            Arc::new(socket)
        });
        let client = Arc::<Mutex<Option<SocketAddr>>>::default();
        for is_request in [true, false] {
            let shared = Arc::clone(&self.shared);
            let ([listener, way], client, loss) = (ends.clone(), Arc::clone(&client), Arc::clone(loss));
            std::thread::spawn(move || {
                let mut datagram = [0; 2048];
                while !shared.lock().has_ended {
                    let from = if is_request { &listener } else { &way };
                    let Ok((len, sender)) = from.recv_from(&mut datagram) else { continue };
                    if is_request {
                        *client.lock().unwrap() = Some(sender);
                    }
                    if loss.takes(&datagram[..len]) || shared.lock().is_pulled {
                        continue;
                    }
                    let peer = *client.lock().unwrap();
                    let _ = match peer {
                        _ if is_request => way.send(&datagram[..len]),
                        Some(peer) => listener.send_to(&datagram[..len], peer),
                        None => Ok(0),
                    };
                }
            });
        }
        place
    }

    /// Pulls the cable or plugs it in.
    pub(crate) fn set(&self, cable: Cable) {
        let mut state = self.shared.lock();
        match cable {
            Cable::Pulled => {
                state.is_pulled = true;
                for listener in &self.listeners {
                    // A full queue drops further requests without an answer.
                    rustix::net::listen(listener, 0).unwrap();
                    let place = listener.local_addr().unwrap();
                    while let Ok(filler) = TcpStream::connect_timeout(&place, POLL_INTERVAL) {
                        state.filled_from.push(filler.local_addr().unwrap());
                        state.fillers.push(filler);
                    }
                }
            }
            Cable::Plugged => {
                state.fillers.clear();
                for listener in &self.listeners {
                    rustix::net::listen(listener, 64).unwrap();
                }
                state.is_pulled = false;
            }
        }
        self.shared.changed.notify_all();
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        self.shared.lock().has_ended = true;
        self.shared.changed.notify_all();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }

    /// The next client; `None` at the end.
    fn next_client(&self, listener: &TcpListener) -> Option<TcpStream> {
        let mut state = self.lock();
        while !state.has_ended {
            if !state.is_pulled
                && let Ok((client, from)) = listener.accept()
            {
                if !state.filled_from.contains(&from) {
                    client.set_nonblocking(false).unwrap();
                    return Some(client);
                }
            } else {
                state = self.changed.wait_timeout(state, Duration::from_millis(2)).unwrap().0;
            }
        }
        None
    }

    /// Carries one direction of a connection to its end.
    fn carry(&self, mut from: &TcpStream, mut to: &TcpStream, mut filter: Box<Filter>) {
        let mut piece = [0; 4096];
        while !self.lock().has_ended {
            let len = match from.read(&mut piece) {
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => continue,
                result => result,
            };
            // If the sender gives up the connection meanwhile, these bytes are lost with it.
            let mut state = self.lock();
            let was_held = state.is_pulled;
            while state.is_pulled && !state.has_ended {
                state = self.changed.wait(state).unwrap();
            }
            drop(state);
            let was_reset = was_held && matches!(from.take_error(), Ok(Some(_)));
            match len {
                Ok(len @ 1..) if !was_reset => {
                    let mut bytes = piece[..len].to_vec();
                    if filter(&mut bytes) == Pass::Cut || to.write_all(&bytes).is_err() {
                        break;
                    }
                }
                Ok(0) => {
                    let _ = to.shutdown(Shutdown::Write);
                    return;
                }
                _ => break,
            }
        }
        for stream in [from, to] {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

/// How often a blocked thread checks for the end.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
