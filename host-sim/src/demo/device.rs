//! Field devices of the demo: a serial line on a pseudoterminal or a TCP connection, a CAN adapter with
//! slcan, a UDP socket.
//!
//! In: bytes. Out: bytes. They use blocking system calls, each wait with a deadline, and do not know
//! recipes.

use std::fs::File;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};

/// How long a device waits for what should come at once: longer than the busiest machine needs.
pub(super) const PATIENCE: Duration = Duration::from_secs(30);

/// A stream of bytes: a serial line, or a TCP connection.
pub(super) struct FieldStream<S> {
    stream: S,
    received: Vec<u8>,
}

impl FieldStream<File> {
    /// Opens the slave end of a pseudoterminal, as a serial port is opened.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let fd = open(path, OFlags::RDWR | OFlags::NOCTTY, Mode::empty())?;
        Ok(Self { stream: File::from(fd), received: Vec::new() })
    }
}

impl FieldStream<TcpStream> {
    /// Connects to a server.
    pub(super) fn connect(address: SocketAddr) -> io::Result<Self> {
        let stream = TcpStream::connect_timeout(&address, PATIENCE)?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, received: Vec::new() })
    }

    /// Accepts a connection.
    pub(super) fn accept(listener: &TcpListener) -> io::Result<Self> {
        wait_readable(listener.as_fd(), Instant::now() + PATIENCE)?;
        let (stream, _) = listener.accept()?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, received: Vec::new() })
    }
}

impl<S: Read + Write + AsFd> FieldStream<S> {
    pub(super) fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.stream.write_all(bytes)
    }

    /// Reads until `found` returns something. It gets all received bytes, and returns its result and the
    /// number of bytes to remove.
    pub(super) fn wait_for<T>(
        &mut self,
        mut found: impl FnMut(&[u8]) -> Option<(T, usize)>,
    ) -> io::Result<T> {
        let deadline = Instant::now() + PATIENCE;
        let mut chunk = [0; 1024];
        loop {
            if let Some((what, used)) = found(&self.received) {
                self.received.drain(..used);
                return Ok(what);
            }
            wait_readable(self.stream.as_fd(), deadline)?;
            match self.stream.read(&mut chunk)? {
                0 => return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the line was closed")),
                len => self.received.extend_from_slice(&chunk[..len]),
            }
        }
    }

    /// Waits for the next frame with this head, tail and length.
    pub(super) fn frame(&mut self, head: &[u8], tail: &[u8], len: usize) -> io::Result<Vec<u8>> {
        self.wait_for(|received| {
            let is_frame = |frame: &&[u8]| frame.starts_with(head) && frame.ends_with(tail);
            let at = received.windows(len).position(|frame| is_frame(&frame))?;
            Some((received[at..at + len].to_vec(), at + len))
        })
    }
}

/// A CAN adapter: slcan on a TCP connection.
pub(super) struct Adapter {
    line: FieldStream<TcpStream>,
}

impl Adapter {
    /// Connects and opens the channel at 500 kbit/s.
    pub(super) fn connect(address: SocketAddr) -> io::Result<Self> {
        let mut line = FieldStream::connect(address)?;
        line.send(b"C\rS6\rO\r")?;
        Ok(Self { line })
    }

    /// Sends a data frame with a standard id.
    pub(super) fn send(&mut self, id: u16, data: &[u8]) -> io::Result<()> {
        let data: String = data.iter().map(|byte| format!("{byte:02X}")).collect();
        self.line.send(format!("t{id:03X}{:X}{data}\r", data.len() / 2).as_bytes())
    }

    /// Waits for the next data frame with this standard id.
    pub(super) fn frame(&mut self, id: u16) -> io::Result<Vec<u8>> {
        let wanted = format!("t{id:03X}");
        loop {
            let line = self.line.wait_for(|received| {
                let end = received.iter().position(|&byte| byte == b'\r' || byte == 7)?;
                Some((String::from_utf8_lossy(&received[..end]).into_owned(), end + 1))
            })?;
            let Some(rest) = line.strip_prefix(&wanted) else { continue };
            let digits = rest.get(1..).unwrap_or("");
            let bytes = (0..digits.len() / 2).map(|nth| u8::from_str_radix(&digits[2 * nth..][..2], 16));
            return bytes.collect::<Result<_, _>>().map_err(io::Error::other);
        }
    }
}

/// A UDP socket that talks to one peer.
pub(super) struct Datagrams {
    socket: UdpSocket,
}

impl Datagrams {
    pub(super) fn connect(address: SocketAddr) -> io::Result<Self> {
        let socket = UdpSocket::bind(("127.0.0.1", 0))?;
        socket.connect(address)?;
        Ok(Self { socket })
    }

    /// A socket bound to any free port, and that port's address.
    pub(super) fn bind() -> io::Result<(Self, SocketAddr)> {
        let socket = UdpSocket::bind(("127.0.0.1", 0))?;
        let address = socket.local_addr()?;
        Ok((Self { socket }, address))
    }

    pub(super) fn send(&self, bytes: &[u8]) -> io::Result<()> {
        self.socket.send(bytes).map(drop)
    }

    /// Waits for the next datagram, and connects the socket to its sender.
    pub(super) fn receive(&self) -> io::Result<Vec<u8>> {
        wait_readable(self.socket.as_fd(), Instant::now() + PATIENCE)?;
        let mut datagram = vec![0; 2048];
        let (len, peer) = self.socket.recv_from(&mut datagram)?;
        self.socket.connect(peer)?;
        datagram.truncate(len);
        Ok(datagram)
    }
}

/// Waits until there is something to read; returns an error of kind `TimedOut` after the deadline.
fn wait_readable(fd: BorrowedFd<'_>, deadline: Instant) -> io::Result<()> {
    let mut fds = [PollFd::new(&fd, PollFlags::IN)];
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        match poll(&mut fds, Some(&timeout)) {
            Ok(0) => return Err(io::Error::new(io::ErrorKind::TimedOut, "nothing came in time")),
            Ok(_) => return Ok(()),
            Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
}
