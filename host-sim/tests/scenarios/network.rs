//! An Ethernet cable between programs of this host, which can be pulled.
//!
//! While it is pulled nothing gets through and nobody is told: connections stall, what their ends send is
//! kept as TCP keeps it, a connection's end or reset is not heard on the other side, connection requests
//! remain without an answer, datagrams are lost.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use super::environment::Cable;

/// What becomes of the bytes of one way of a connection. It may change them, or leave none.
pub(crate) type Filter = dyn FnMut(&mut Vec<u8>) -> Pass + Send;

/// What becomes of a connection with what it carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pass {
    /// It goes on.
    On,
    /// It ends here, both ways.
    Cut,
}

/// Datagrams that are lost, both ways, from the first one on that is a certain one; by default none.
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

    /// Since when, once it has begun.
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

/// Ways through the cable. They end when it is dropped.
#[derive(Debug, Default)]
pub(crate) struct Network {
    shared: Arc<Shared>,
    doors: Vec<Arc<TcpListener>>,
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
    /// Connections that fill the doors while the cable is pulled, and where they come from.
    fillers: Vec<TcpStream>,
    filled_from: Vec<SocketAddr>,
}

impl Network {
    /// A place that leads to this TCP server.
    pub(crate) fn tcp(&mut self, to: SocketAddr) -> SocketAddr {
        self.tcp_through(to, |_| -> [Box<Filter>; 2] {
            [Box::new(|_: &mut Vec<u8>| Pass::On), Box::new(|_: &mut Vec<u8>| Pass::On)]
        })
    }

    /// The same through filters: what they are for the connection with this number, counted from 0;
    /// first the one of what the client says, then the one of what it is told.
    pub(crate) fn tcp_through(
        &mut self,
        to: SocketAddr,
        mut filters: impl FnMut(u32) -> [Box<Filter>; 2] + Send + 'static,
    ) -> SocketAddr {
        let door = TcpListener::bind("127.0.0.1:0").unwrap();
        door.set_nonblocking(true).unwrap();
        let place = door.local_addr().unwrap();
        let door = Arc::new(door);
        self.doors.push(Arc::clone(&door));
        let shared = Arc::clone(&self.shared);
        std::thread::spawn(move || {
            let mut number = 0;
            while let Some(client) = shared.next_client(&door) {
                // A server that is not there refuses; here it closes.
                let Ok(server) = TcpStream::connect(to) else { continue };
                for stream in [&client, &server] {
                    stream.set_nodelay(true).unwrap();
                    stream.set_read_timeout(Some(TURN)).unwrap();
                }
                let (client, server) = (Arc::new(client), Arc::new(server));
                let [said, told] = filters(number);
                number += 1;
                let ways = [(Arc::clone(&client), Arc::clone(&server), said), (server, client, told)];
                for (from, to, filter) in ways {
                    let shared = Arc::clone(&shared);
                    std::thread::spawn(move || shared.carry(&from, &to, filter));
                }
            }
        });
        place
    }

    /// A place that leads to this UDP server; answers go to whoever sent last.
    pub(crate) fn udp(&self, to: SocketAddr) -> SocketAddr {
        self.udp_losing(to, &Arc::default())
    }

    /// The same, with datagrams that are lost on the way.
    pub(crate) fn udp_losing(&self, to: SocketAddr, loss: &Arc<Loss>) -> SocketAddr {
        let (door, way) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        way.connect(to).unwrap();
        let place = door.local_addr().unwrap();
        let ends = [door, way].map(|socket| {
            socket.set_read_timeout(Some(TURN)).unwrap();
            Arc::new(socket)
        });
        let client = Arc::<Mutex<Option<SocketAddr>>>::default();
        for is_request in [true, false] {
            let shared = Arc::clone(&self.shared);
            let ([door, way], client, loss) = (ends.clone(), Arc::clone(&client), Arc::clone(loss));
            std::thread::spawn(move || {
                let mut datagram = [0; 2048];
                while !shared.lock().has_ended {
                    let from = if is_request { &door } else { &way };
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
                        Some(peer) => door.send_to(&datagram[..len], peer),
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
                for door in &self.doors {
                    // A full queue drops further requests without an answer.
                    rustix::net::listen(door, 0).unwrap();
                    let place = door.local_addr().unwrap();
                    while let Ok(filler) = TcpStream::connect_timeout(&place, TURN) {
                        state.filled_from.push(filler.local_addr().unwrap());
                        state.fillers.push(filler);
                    }
                }
            }
            Cable::Plugged => {
                state.fillers.clear();
                for door in &self.doors {
                    rustix::net::listen(door, 64).unwrap();
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

    /// The next one who comes through the door; `None` at the end.
    fn next_client(&self, door: &TcpListener) -> Option<TcpStream> {
        let mut state = self.lock();
        while !state.has_ended {
            if !state.is_pulled
                && let Ok((client, from)) = door.accept()
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
            // What was on its way when the sender gave the connection up is lost with it.
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

/// How long nobody looks whether the cable was pulled meanwhile.
const TURN: Duration = Duration::from_millis(20);
