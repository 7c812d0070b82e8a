//! Hostile peers. Each attack is a few threads at the lowest priority, so that it takes from other clients
//! what the attacked process gives it, and not the processor.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::net::{AddressFamily, SocketType, sockopt};

/// A running attack; it ends when it is dropped.
pub(crate) struct Attack {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

/// What an attack's threads share.
#[derive(Default)]
pub(crate) struct Shared {
    stop: AtomicBool,
    pause: AtomicBool,
    done: AtomicU64,
}

impl Shared {
    fn goes_on(&self) -> bool {
        while self.pause.load(Ordering::Relaxed) && !self.stop.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
        }
        !self.stop.load(Ordering::Relaxed)
    }

    fn count(&self, done: u64) {
        self.done.fetch_add(done, Ordering::Relaxed);
    }
}

impl Attack {
    /// Starts `threads` threads; each gets its number.
    fn start(threads: usize, run: impl Fn(usize, &Shared) + Clone + Send + 'static) -> Self {
        let shared = Arc::new(Shared::default());
        let begin = |nth| {
            let (run, shared) = (run.clone(), Arc::clone(&shared));
            std::thread::spawn(move || {
                let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
                run(nth, &shared);
            })
        };
        let threads = (0..threads).map(begin).collect();
        Self { shared, threads }
    }

    /// Pauses it; it keeps its connections.
    pub(crate) fn pause(&self) {
        self.shared.pause.store(true, Ordering::Relaxed);
    }

    /// Ends the pause.
    pub(crate) fn resume(&self) {
        self.shared.pause.store(false, Ordering::Relaxed);
    }

    /// Progress: number of connections made, or of bytes or datagrams sent.
    pub(crate) fn done(&self) -> u64 {
        self.shared.done.load(Ordering::Relaxed)
    }
}

impl Drop for Attack {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Connects and resets, as a port scan does, as fast as it can.
pub(crate) fn scan(at: SocketAddr) -> Attack {
    Attack::start(1, move |_, shared| {
        while shared.goes_on() {
            if let Ok(stream) = TcpStream::connect(at) {
                let _ = sockopt::set_socket_linger(&stream, Some(Duration::ZERO));
                shared.count(1);
            }
        }
    })
}

/// Opens more and more connections and keeps them; those that are closed are opened again.
pub(crate) fn hoard(at: SocketAddr, most: usize) -> Attack {
    Attack::start(1, move |_, shared| {
        let mut held: Vec<TcpStream> = Vec::new();
        while shared.goes_on() {
            if let Ok(stream) = TcpStream::connect(at) {
                let _ = stream.set_nonblocking(true);
                shared.count(1);
                held.push(stream);
            }
            if held.len() > most {
                held.retain(|mut stream| !matches!(stream.read(&mut [0; 64]), Ok(0)));
                held.drain(..held.len().saturating_sub(most));
            }
        }
    })
}

/// `clients` that send as fast as the server reads, and read its answers.
pub(crate) fn pour(at: SocketAddr, clients: usize, bytes: &'static [u8]) -> Attack {
    let chunk = filled(bytes);
    Attack::start(clients, move |_, shared| {
        while shared.goes_on() {
            if let Some(stream) = small(at) {
                let _ = stream.set_nonblocking(true);
                pour_into(stream, &chunk, shared);
            }
        }
    })
}

/// Same, through a device.
pub(crate) fn pour_device(path: PathBuf, bytes: &'static [u8]) -> Attack {
    let chunk = filled(bytes);
    Attack::start(1, move |_, shared| {
        let flags = libc::O_NOCTTY | libc::O_NONBLOCK;
        let device = std::fs::OpenOptions::new().read(true).write(true).custom_flags(flags).open(&path);
        pour_into(device.unwrap(), &chunk, shared);
    })
}

/// What a server does with clients that it has answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Hold {
    /// It keeps the connection.
    Open,
    /// It closes.
    Close,
}

/// A server that floods everyone who connects; returns its address.
pub(crate) fn server(bytes: &'static [u8], hold: Hold) -> (SocketAddr, Attack) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    listener.set_nonblocking(true).unwrap();
    let listener = Arc::new(listener);
    let chunk = filled(bytes);
    let attack = Attack::start(2, move |_, shared| {
        while shared.goes_on() {
            match listener.accept() {
                Ok((mut stream, _)) if hold == Hold::Close => {
                    // Counts like many bytes, since each makes the other side connect again.
                    shared.count(10);
                    let _ = stream.write_all(&chunk);
                }
                Ok((stream, _)) => {
                    let _ = stream.set_nonblocking(true);
                    pour_into(stream, &chunk, shared);
                }
                Err(_) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    });
    (at, attack)
}

/// Sends as fast as the other side reads, and reads what it sends, until it closes.
fn pour_into(mut to: impl Read + Write, chunk: &[u8], shared: &Shared) {
    let mut got = vec![0; 1 << 16];
    let mut rest = chunk;
    while shared.goes_on() {
        let mut idle = true;
        match to.write(rest) {
            Ok(count) => {
                shared.count(count as u64);
                rest = if count == rest.len() { chunk } else { &rest[count..] };
                idle = false;
            }
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            Err(_) => return,
        }
        match to.read(&mut got) {
            Ok(0) => return,
            Ok(_) => idle = false,
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            Err(_) => return,
        }
        if idle {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

/// `clients` that send as much as possible and never read; each connects again when it is closed.
pub(crate) fn never_read(at: SocketAddr, clients: usize, bytes: &'static [u8]) -> Attack {
    let chunk = filled(bytes);
    Attack::start(1, move |_, shared| {
        let mut streams: Vec<Option<TcpStream>> = (0..clients).map(|_| None).collect();
        while shared.goes_on() {
            let mut idle = true;
            for slot in &mut streams {
                if slot.is_none() {
                    *slot = small(at).filter(|stream| stream.set_nonblocking(true).is_ok());
                    idle = false;
                }
                let Some(stream) = slot else { continue };
                match stream.write(&chunk) {
                    Ok(count) => {
                        shared.count(count as u64);
                        idle = false;
                    }
                    Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
                    Err(_) => *slot = None,
                }
            }
            if idle {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    })
}

/// Connects, requests much data, then violates the protocol, and never reads: answers wait at connections
/// that are closed already. Repeats this, and keeps what it has opened.
pub(crate) fn ask_and_break(at: SocketAddr, bytes: &'static [u8], keep: usize) -> Attack {
    Attack::start(2, move |_, shared| {
        let mut held = std::collections::VecDeque::new();
        while shared.goes_on() {
            let Some(mut stream) = small(at) else { continue };
            if stream.write_all(bytes).is_ok() {
                shared.count(1);
            }
            held.push_back(stream);
            if held.len() > keep {
                held.pop_front();
            }
        }
    })
}

/// `clients` that send a byte every `pause`, and never a complete request.
pub(crate) fn drip(at: SocketAddr, clients: usize, bytes: &'static [u8], pause: Duration) -> Attack {
    Attack::start(1, move |_, shared| {
        let mut streams: Vec<TcpStream> = Vec::new();
        for nth in 0.. {
            if !shared.goes_on() {
                return;
            }
            while streams.len() < clients {
                match small(at) {
                    Some(stream) => streams.push(stream),
                    None => break,
                }
            }
            let byte = bytes[nth % bytes.len()];
            streams.retain_mut(|stream| {
                let sent = stream.write_all(&[byte]).is_ok();
                shared.count(u64::from(sent));
                sent
            });
            std::thread::sleep(pause);
        }
    })
}

/// Whether the sockets that datagrams come from stay open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ports {
    /// They stay open, and nobody reads them.
    Kept,
    /// Each datagram comes from another socket, which is closed after it.
    New,
}

/// Sends `datagrams` in turn from many ports.
pub(crate) fn datagrams(
    at: SocketAddr,
    source: Ipv4Addr,
    datagrams: &'static [&'static [u8]],
    ports: Ports,
) -> Attack {
    Attack::start(1, move |_, shared| {
        let bind = || UdpSocket::bind((source, 0)).unwrap();
        let mut sockets: Vec<_> = (0..64).map(|_| bind()).collect();
        for nth in 0_usize.. {
            if !shared.goes_on() {
                return;
            }
            let datagram = datagrams[nth % datagrams.len()];
            let place = nth % sockets.len();
            if ports == Ports::New {
                sockets[place] = bind();
            }
            if sockets[place].send_to(datagram, at).is_ok() {
                shared.count(1);
            }
        }
    })
}

/// A connection with the smallest receive buffer that the system allows.
fn small(at: SocketAddr) -> Option<TcpStream> {
    let socket = rustix::net::socket(AddressFamily::INET, SocketType::STREAM, None).ok()?;
    sockopt::set_socket_recv_buffer_size(&socket, 2_048).ok()?;
    rustix::net::connect(&socket, &at).ok()?;
    Some(TcpStream::from(socket))
}

/// About 16 KiB of copies.
fn filled(bytes: &[u8]) -> Vec<u8> {
    bytes.repeat((16 << 10) / bytes.len() + 1)
}
