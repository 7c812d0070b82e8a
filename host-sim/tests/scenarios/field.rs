//! Field devices on a serial line or a CAN bus.

use std::io::{Read, Write};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use recipe_test_kit::PATIENCE;

/// A connection that can be read and written at the same time.
pub(crate) trait Stream: Send {
    fn split(self: Box<Self>) -> (Box<dyn Read + Send>, Box<dyn Write + Send>);
}

macro_rules! stream {
    ($($name:ty),*) => {
        $(impl Stream for $name {
            fn split(self: Box<Self>) -> (Box<dyn Read + Send>, Box<dyn Write + Send>) {
                (Box::new(self.try_clone().unwrap()), self)
            }
        })*
    };
}
stream!(std::fs::File, std::net::TcpStream, std::os::unix::net::UnixStream);

/// Received bytes, and a signal that more have come.
#[derive(Default)]
struct Inbox {
    bytes: Mutex<Vec<u8>>,
    arrived: Condvar,
}

/// A device on a serial line. It reads continuously.
pub(crate) struct LineClient {
    writer: Box<dyn Write + Send>,
    inbox: Arc<Inbox>,
    received: Vec<u8>,
}

impl LineClient {
    pub(crate) fn new(stream: Box<dyn Stream>) -> Self {
        let (mut reader, writer) = stream.split();
        let inbox = Arc::<Inbox>::default();
        let sink = Arc::clone(&inbox);
        std::thread::spawn(move || {
            let mut piece = [0; 4096];
            while let Ok(len @ 1..) = reader.read(&mut piece) {
                sink.bytes.lock().unwrap().extend_from_slice(&piece[..len]);
                sink.arrived.notify_one();
            }
        });
        Self { writer, inbox, received: Vec::new() }
    }

    #[track_caller]
    pub(crate) fn send(&mut self, bytes: &[u8]) {
        self.writer.write_all(bytes).unwrap();
    }

    /// Moves the sending half out; this client can no longer send.
    pub(crate) fn take_writer(&mut self) -> Box<dyn Write + Send> {
        std::mem::replace(&mut self.writer, Box::new(std::io::sink()))
    }

    /// All bytes that have come so far.
    pub(crate) fn take_all(&mut self) -> Vec<u8> {
        self.more(Duration::ZERO);
        std::mem::take(&mut self.received)
    }

    /// What has come, or what comes within `patience`.
    pub(crate) fn take_some(&mut self, patience: Duration) -> Vec<u8> {
        self.more(patience);
        std::mem::take(&mut self.received)
    }

    /// Waits for bytes; returns false if none came.
    fn more(&mut self, patience: Duration) -> bool {
        let bytes = self.inbox.bytes.lock().unwrap();
        let (mut bytes, _) =
            self.inbox.arrived.wait_timeout_while(bytes, patience, |bytes| bytes.is_empty()).unwrap();
        self.received.append(&mut bytes);
        !self.received.is_empty()
    }

    /// Drops what has come so far.
    pub(crate) fn forget(&mut self) {
        self.more(Duration::ZERO);
        self.received.clear();
    }

    /// Takes the first `len` bytes, once they are there.
    #[track_caller]
    pub(crate) fn take(&mut self, len: usize) -> Vec<u8> {
        let deadline = Instant::now() + PATIENCE;
        while self.received.len() < len {
            assert!(Instant::now() < deadline, "only {:02X?} of {len} bytes came", self.received);
            let mut before = std::mem::take(&mut self.received);
            self.more(PATIENCE);
            before.append(&mut self.received);
            self.received = before;
        }
        let rest = self.received.split_off(len);
        std::mem::replace(&mut self.received, rest)
    }

    /// Waits until these bytes have come, and drops what came before them.
    #[track_caller]
    pub(crate) fn until(&mut self, wanted: &[u8]) {
        let deadline = Instant::now() + PATIENCE;
        let mut newest = Vec::new();
        while newest != wanted {
            assert!(Instant::now() < deadline, "{wanted:02X?} never came; the newest: {newest:02X?}");
            if newest.len() == wanted.len() {
                newest.remove(0);
            }
            newest.extend(self.take(1));
        }
    }

    /// Checks that nothing comes for this long.
    #[track_caller]
    pub(crate) fn is_silent(&mut self, time: Duration) {
        if self.more(time) {
            let begin = &self.received[..self.received.len().min(64)];
            panic!("{begin:02X?} came from a line that has to be silent");
        }
    }
}

/// A node on a CAN bus, connected by slcan (proto-core/docs/wire/slcan.md).
pub(crate) struct CanClient(LineClient);

impl CanClient {
    /// Opens the channel.
    #[track_caller]
    pub(crate) fn join(stream: Box<dyn Stream>) -> Self {
        let mut line = LineClient::new(stream);
        line.send(b"C\rO\r");
        assert_eq!(line.take(2), b"\r\r", "answers to closing and opening");
        Self(line)
    }

    /// The next frame with this id.
    #[track_caller]
    pub(crate) fn frame(&mut self, id: u16) -> Vec<u8> {
        loop {
            let (next, data) = self.next();
            if next == id {
                return data;
            }
        }
    }

    /// The next frame.
    #[track_caller]
    pub(crate) fn next(&mut self) -> (u16, Vec<u8>) {
        loop {
            let mut text = String::new();
            while !text.ends_with('\r') {
                text.push(char::from(self.0.take(1)[0]));
            }
            // A `z` confirms a frame that was sent.
            let text = text.trim_start_matches('z').trim_end();
            let Some(frame) = text.strip_prefix('t') else { continue };
            let id = u16::from_str_radix(&frame[..3], 16).unwrap();
            let hex = &frame[4..];
            let bytes = (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap());
            let bytes: Vec<u8> = bytes.collect();
            assert_eq!(bytes.len().to_string(), frame[3..4], "length of {text}");
            return (id, bytes);
        }
    }

    #[track_caller]
    pub(crate) fn send(&mut self, id: u16, data: &[u8]) {
        self.0.send(slcan(id, data).as_bytes());
    }

    /// Sends bytes, which need not be valid slcan.
    #[track_caller]
    pub(crate) fn send_raw(&mut self, bytes: &[u8]) {
        self.0.send(bytes);
    }

    /// The serial line itself.
    pub(crate) fn into_line(self) -> LineClient {
        self.0
    }

    /// Drops what has come so far.
    pub(crate) fn forget(&mut self) {
        self.0.forget();
    }
}

/// A frame as a line of slcan.
pub(crate) fn slcan(id: u16, data: &[u8]) -> String {
    let hex: String = data.iter().map(|byte| format!("{byte:02X}")).collect();
    format!("t{id:03X}{}{hex}\r", data.len())
}
