//! Well-behaved clients, each on a thread: an attack is judged by how they are served meanwhile.

use std::collections::BTreeMap;
use std::io::{BufRead, Read, Write};
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use recipe_test_kit::PATIENCE;

/// How a client was served so far.
#[derive(Default)]
struct Tally {
    count: AtomicU64,
    /// The longest wait since the newest measurement began, in microseconds.
    worst: AtomicU64,
    stop: AtomicBool,
    error: Mutex<Option<String>>,
}

/// The clients.
#[derive(Default)]
pub(crate) struct Clients {
    clients: BTreeMap<&'static str, Client>,
}

struct Client {
    tally: Arc<Tally>,
    paced_by: PacedBy,
    _thread: JoinHandle<()>,
}

/// Who decides how often a client is served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PacedBy {
    /// The process, at a fixed rate, which an attack must not change.
    Process,
    /// The client, which sends the next request after each answer. It shares the server with others, and must
    /// not wait long.
    Client,
}

/// How the clients were served within some time.
pub(crate) struct Service {
    took: f64,
    clients: BTreeMap<&'static str, (PacedBy, f64, Duration)>,
}

impl Clients {
    /// Adds a client, which is served whenever `next` returns; an error ends it.
    fn watch(
        &mut self,
        name: &'static str,
        paced_by: PacedBy,
        mut next: impl FnMut() -> std::io::Result<()> + Send + 'static,
    ) {
        let tally = Arc::new(Tally::default());
        let own = Arc::clone(&tally);
        let thread = std::thread::spawn(move || {
            while !own.stop.load(Ordering::Relaxed) {
                let begin = Instant::now();
                if let Err(error) = next() {
                    *own.error.lock().unwrap() = Some(error.to_string());
                    return;
                }
                own.worst.fetch_max(begin.elapsed().as_micros() as u64, Ordering::Relaxed);
                own.count.fetch_add(1, Ordering::Relaxed);
            }
        });
        self.clients.insert(name, Client { tally, paced_by, _thread: thread });
    }

    /// A client that reads chunks of a stream, each of which begins with `begin`.
    #[track_caller]
    pub(crate) fn stream(&mut self, name: &'static str, at: SocketAddr, len: usize, begin: &'static [u8]) {
        let mut stream = connect(at);
        let mut chunk = vec![0; len];
        self.watch(name, PacedBy::Process, move || {
            stream.read_exact(&mut chunk)?;
            if chunk.starts_with(begin) { Ok(()) } else { Err(std::io::Error::other("misaligned")) }
        });
    }

    /// A field device that sends a frame after each one that it receives.
    #[track_caller]
    pub(crate) fn field(
        &mut self,
        name: &'static str,
        at: SocketAddr,
        sends: &'static [u8],
        len: usize,
        begin: &'static [u8],
    ) {
        let mut stream = connect(at);
        let mut chunk = vec![0; len];
        stream.write_all(sends).unwrap();
        self.watch(name, PacedBy::Process, move || {
            stream.read_exact(&mut chunk)?;
            stream.write_all(sends)?;
            if chunk.starts_with(begin) { Ok(()) } else { Err(std::io::Error::other("misaligned")) }
        });
    }

    /// An slcan client that waits for frames that begin with `begin`.
    #[track_caller]
    pub(crate) fn slcan(&mut self, name: &'static str, at: SocketAddr, begin: &'static [u8]) {
        let mut stream = connect(at);
        stream.write_all(b"S6\rO\r").unwrap();
        let mut lines = std::io::BufReader::new(stream);
        let mut line = Vec::new();
        self.watch(name, PacedBy::Process, move || {
            loop {
                line.clear();
                match lines.read_until(b'\r', &mut line)? {
                    0 => return Err(std::io::ErrorKind::UnexpectedEof.into()),
                    _ if line.starts_with(begin) => return Ok(()),
                    _ => {}
                }
            }
        });
    }

    /// A client of port 2001.
    #[track_caller]
    pub(crate) fn state(&mut self, at: SocketAddr) {
        self.stream("state", at, 1_468, &[]);
    }

    /// A client of UDP 2011.
    #[track_caller]
    pub(crate) fn udp2011(&mut self, at: SocketAddr) {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        socket.connect(at).unwrap();
        socket.send(&[0xFF, 0xFF, 0x01, 0xEE, 0xEE]).unwrap();
        let mut frame = [0; 64];
        let mut count = 0_u32;
        self.watch("udp2011", PacedBy::Process, move || {
            // The server forgets a client that is silent for a minute.
            count += 1;
            if count.is_multiple_of(1_000) {
                socket.send(&[0xFF, 0xFF, 0x01, 0xEE, 0xEE])?;
            }
            match socket.recv(&mut frame)? {
                28 if frame[..2] == [0xFF, 0xFF] => Ok(()),
                count => Err(std::io::Error::other(format!("a frame of {count} bytes"))),
            }
        });
    }

    /// A client that sends a request, reads the answer, and waits a little.
    #[track_caller]
    pub(crate) fn request_answer(
        &mut self,
        name: &'static str,
        at: SocketAddr,
        request: &'static [u8],
        answer: &'static [u8],
    ) {
        let mut stream = connect(at);
        let mut got = vec![0; answer.len()];
        self.watch(name, PacedBy::Client, move || {
            stream.write_all(request)?;
            stream.read_exact(&mut got)?;
            if got != answer {
                return Err(std::io::Error::other(format!("{:?}", String::from_utf8_lossy(&got))));
            }
            std::thread::sleep(Duration::from_millis(2));
            Ok(())
        });
    }

    /// Clients one after the other: each connects, sends a request, reads the answer and closes.
    pub(crate) fn newcomers(
        &mut self,
        name: &'static str,
        at: SocketAddr,
        request: &'static [u8],
        answer: &'static [u8],
    ) {
        let mut got = vec![0; answer.len()];
        self.watch(name, PacedBy::Client, move || {
            let mut stream = TcpStream::connect(at)?;
            stream.set_read_timeout(Some(PATIENCE))?;
            stream.write_all(request)?;
            stream.read_exact(&mut got)?;
            std::thread::sleep(Duration::from_millis(2));
            if got == answer { Ok(()) } else { Err(std::io::Error::other("another answer")) }
        });
    }

    /// Measures how the clients are served during the next `window`.
    #[track_caller]
    pub(crate) fn measure(&self, window: Duration) -> Service {
        let begin = Instant::now();
        let before: Vec<_> = self.clients.values().map(|client| client.tally.begin()).collect();
        std::thread::sleep(window);
        let took = begin.elapsed().as_secs_f64();
        let mut clients = BTreeMap::new();
        for ((name, client), before) in self.clients.iter().zip(before) {
            let error = client.tally.error.lock().unwrap().clone();
            assert_eq!(error, None, "{name}");
            let count = client.tally.count.load(Ordering::Relaxed) - before;
            let worst = Duration::from_micros(client.tally.worst.load(Ordering::Relaxed));
            clients.insert(*name, (client.paced_by, count as f64 / took, worst));
        }
        Service { took, clients }
    }
}

impl Tally {
    fn begin(&self) -> u64 {
        self.worst.store(0, Ordering::Relaxed);
        self.count.load(Ordering::Relaxed)
    }
}

impl Drop for Clients {
    fn drop(&mut self) {
        for client in self.clients.values() {
            client.tally.stop.store(true, Ordering::Relaxed);
        }
    }
}

impl Service {
    /// Raises low rates to a quarter of the rates `before`: a client that is hardly served although no attack
    /// goes on was lost to an earlier one.
    pub(crate) fn at_least(mut self, before: &Self) -> Self {
        for (name, (_, own, _)) in &mut self.clients {
            *own = own.max(before.clients[name].1 / 4.0);
        }
        self
    }

    /// Checks that no client waited longer than `limit`.
    pub(crate) fn waits_at_most(&self, limit: Duration) -> Result<(), String> {
        let late = self.clients.iter().find(|(_, (_, _, worst))| *worst > limit);
        late.map_or(Ok(()), |(name, (_, _, worst))| Err(format!("{name} waited {worst:?}")))
    }

    /// Checks that the clients were served about as well as `before`. An attack that takes their share would
    /// leave hardly anything.
    pub(crate) fn is_like(&self, before: &Self) -> Result<(), String> {
        for (name, &(paced_by, own, worst)) in &self.clients {
            let least = match paced_by {
                // One may be just after the end.
                PacedBy::Process => before.clients[name].1 * LEAST_SHARE - 1.0 / self.took,
                PacedBy::Client => LEAST_ANSWERS.min(before.clients[name].1 * LEAST_SHARE),
            };
            if own < least {
                return Err(format!("{name}: {own:.1}/s, at least {least:.1}/s expected"));
            }
            if worst > LONGEST_WAIT {
                return Err(format!("{name} waited {worst:?}"));
            }
        }
        Ok(())
    }
}

impl std::fmt::Display for Service {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (name, (_, per_second, worst)) in &self.clients {
            write!(f, "{name} {per_second:.1}/s, worst {worst:.1?}; ")?;
        }
        Ok(())
    }
}

#[track_caller]
pub(crate) fn connect(at: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.set_nodelay(true).unwrap();
    stream
}

const LEAST_SHARE: f64 = 0.3;
/// Per second, for clients that send requests.
const LEAST_ANSWERS: f64 = 5.0;
const LONGEST_WAIT: Duration = Duration::from_secs(2);
