//! A serial line on a pseudoterminal, a serial device or a TCP byte stream.
//!
//! Only a serial device has a real line. On the others a transmission takes as long as it would on the
//! wire: `Sent` comes when the last stop bit would have left, so cycles behave alike everywhere.

use std::cell::RefCell;
use std::io;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use proto_core::config::{Parity, Rs485};
use proto_core::time::{Duration, Instant};
use tokio::net::TcpListener;
use tokio::task::yield_now;
use tokio_serial::{SerialPortBuilderExt, SerialStream};
use tracing::{debug, info, warn};

use super::bind::{Device, HostPort, Pace};
use super::exchange::{Backlog, PortEvent, PortTx};
use super::pty::Pty;
use super::stream::{ByteStream, accept};
use recipe_net::backoff::Backoff;
use recipe_net::connect::connect;
use recipe_net::peer;
use recipe_net::timer::{Timer, now};
use recipe_net::turns::give_way;

/// A serial port's device.
#[derive(Debug)]
pub(super) struct LinePort {
    source: Source,
    settings: Rs485,
    tx: Rc<PortTx>,
}

#[derive(Debug)]
enum Source {
    Pty(Pty, Pace),
    Serial(String, SerialStream),
    Connect(HostPort),
    Listen(TcpListener),
}

impl LinePort {
    pub(super) async fn open(device: &Device, settings: Rs485, tx: Rc<PortTx>) -> io::Result<Self> {
        let source = match device {
            Device::Pty { link, pace } => Source::Pty(Pty::open(link)?, *pace),
            Device::Serial { path } => {
                let path = path.display().to_string();
                let stream = open_serial(&path, settings)
                    .map_err(|error| io::Error::new(error.kind(), format!("{path}: {error}")))?;
                Source::Serial(path, stream)
            }
            Device::Tcp { to } => Source::Connect(to.clone()),
            Device::TcpListen { listen } => {
                let listener = TcpListener::bind((listen.host.as_str(), listen.port)).await;
                let listener =
                    listener.map_err(|error| io::Error::new(error.kind(), format!("{listen}: {error}")))?;
                peer::bound(&listener);
                Source::Listen(listener)
            }
            Device::SocketCan { .. } | Device::SlcanPty { .. } | Device::SlcanTcp { .. } => {
                let what = format!("`{device}` is a CAN device; the port is a serial line");
                return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
            }
        };
        Ok(Self { source, settings, tx })
    }

    pub(super) fn place(&self) -> String {
        match &self.source {
            Source::Pty(pty, _) => pty.link().display().to_string(),
            Source::Serial(path, _) => path.clone(),
            Source::Connect(to) => to.to_string(),
            Source::Listen(listener) => {
                listener.local_addr().map_or_else(|_| String::new(), |at| at.to_string())
            }
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let Self { source, settings, tx } = self;
        let mut sender = Sender::new(settings, Rc::clone(&tx))?;
        match source {
            Source::Pty(pty, pace) => {
                sender.paced = pace == Pace::Line;
                sender.up(&mut events);
                Err(pump(&pty, &mut sender, &mut events).await)
            }
            Source::Serial(path, stream) => {
                let mut stream = Some(stream);
                let mut backoff = Backoff::new(StdDuration::from_millis(100), StdDuration::from_secs(2));
                loop {
                    let device = match stream.take().map_or_else(|| open_serial(&path, settings), Ok) {
                        Ok(device) => RefCell::new(device),
                        Err(error) => {
                            debug!(%path, %error, "cannot open the device");
                            backoff.wait().await;
                            continue;
                        }
                    };
                    backoff.reset();
                    sender.up(&mut events);
                    let error = pump(&device, &mut sender, &mut events).await;
                    warn!(%path, %error, "device lost, will be reopened");
                    sender.down(&mut events);
                }
            }
            Source::Connect(to) => {
                let mut backoff = Backoff::new(StdDuration::from_millis(20), StdDuration::from_secs(2));
                loop {
                    match connect((to.host.as_str(), to.port)).await {
                        Ok(stream) => {
                            info!(%to, "connected");
                            backoff.reset();
                            peer::watch(&stream);
                            sender.up(&mut events);
                            let error = pump(&stream, &mut sender, &mut events).await;
                            info!(%to, %error, "connection lost");
                            sender.down(&mut events);
                        }
                        Err(error) => debug!(%to, %error, "cannot connect"),
                    }
                    backoff.wait().await;
                }
            }
            Source::Listen(listener) => loop {
                let (stream, peer) = accept(&listener, &tx).await;
                info!(%peer, "client connected");
                peer::watch(&stream);
                sender.up(&mut events);
                tokio::select! {
                    error = pump(&stream, &mut sender, &mut events) => info!(%peer, %error, "client disconnected"),
                    () = refuse_all(&listener, &tx) => {}
                }
                sender.down(&mut events);
            },
        }
    }
}

async fn refuse_all(listener: &TcpListener, tx: &PortTx) {
    loop {
        let (stream, peer) = accept(listener, tx).await;
        drop(stream);
        tx.count(|counters| counters.refused += 1);
        if let Some(more) = tx.complaints.take(now()) {
            warn!(%peer, more, "refused: the line already has a client");
        }
        give_way().await;
    }
}

fn open_serial(path: &str, settings: Rs485) -> io::Result<SerialStream> {
    let parity = match settings.parity {
        Parity::None => tokio_serial::Parity::None,
        Parity::Even => tokio_serial::Parity::Even,
        Parity::Odd => tokio_serial::Parity::Odd,
    };
    let stop_bits =
        if settings.stop_bits == 2 { tokio_serial::StopBits::Two } else { tokio_serial::StopBits::One };
    let builder = tokio_serial::new(path, settings.baud).stop_bits(stop_bits);
    match builder.clone().parity(parity).open_native_async() {
        // Pseudoterminals have no parity bit; some systems say so instead of ignoring it.
        Err(_) if settings.parity != Parity::None => {
            let stream = builder.open_native_async()?;
            warn!(path, "the device does not support parity; used without");
            Ok(stream)
        }
        opened => Ok(opened?),
    }
}

/// Moves bytes both ways until the device fails.
async fn pump(
    device: &impl ByteStream,
    sender: &mut Sender,
    events: &mut impl FnMut(PortEvent<'_>),
) -> io::Error {
    let mut buf = vec![0; OLD_CHUNK];
    let mut backlog = Backlog::default();
    loop {
        let most = if backlog.is_open(&sender.tx) { OLD_CHUNK } else { CHUNK };
        let done = tokio::select! {
            read = device.receive(&mut buf[..most]) => match read {
                Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(count) => {
                    let is_full = count == most;
                    sender.tx.count(|counters| counters.bytes_in += count as u64);
                    if backlog.has(&sender.tx, is_full) {
                        sender.tx.count(|counters| counters.dropped += count as u64);
                    } else {
                        events(PortEvent::Bytes(&buf[..count]));
                    }
                    // A device that never pauses must not keep everybody else waiting. What is refused takes
                    // little time, and has to be gone soon.
                    let is_much = is_full && !sender.tx.is_stale();
                    if is_much { give_way().await } else { yield_now().await }
                    Ok(())
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => Ok(()),
                Err(error) => Err(error),
            },
            () = sender.tx.slept.notified() => {
                swallow(device, &sender.tx, &mut buf, events);
                Ok(())
            }
            () = sender.tx.wake.notified(), if !sender.sending => sender.begin(device, events),
            expired = sender.timer.expired(), if sender.sending && !sender.blocked => {
                expired.and_then(|()| sender.advance(device, events))
            }
            ready = device.writable(), if sender.blocked => {
                ready.and_then(|()| sender.advance(device, events))
            }
            () = tokio::time::sleep(STALE_LOOK), if device.may_be_stale() => {
                device.is_heard();
                Ok(())
            }
        };
        if let Err(error) = done {
            return error;
        }
    }
}

/// Tells what waited while the process slept, which is refused and counted, and throws away what of it cannot be
/// read yet: a terminal's system makes it readable piece by piece, when it has the time.
fn swallow(device: &impl ByteStream, tx: &PortTx, buf: &mut [u8], events: &mut impl FnMut(PortEvent<'_>)) {
    for _ in 0..MOST_SWALLOWED {
        let Ok(count @ 1..) = device.try_read(buf) else { break };
        tx.count(|counters| counters.bytes_in += count as u64);
        events(PortEvent::Bytes(&buf[..count]));
    }
    device.discard_unread();
}

/// The transmission under way on a line, and the time it takes.
struct Sender {
    tx: Rc<PortTx>,
    line: Rs485,
    timer: Timer,
    paced: bool,
    bytes: Vec<u8>,
    written: usize,
    start: Instant,
    sending: bool,
    blocked: bool,
}

impl Sender {
    fn new(settings: Rs485, tx: Rc<PortTx>) -> io::Result<Self> {
        Ok(Self {
            tx,
            line: settings,
            timer: Timer::new()?,
            paced: false,
            bytes: Vec::new(),
            written: 0,
            start: Instant::ZERO,
            sending: false,
            blocked: false,
        })
    }

    fn up(&mut self, events: &mut impl FnMut(PortEvent<'_>)) {
        self.tx.bytes.borrow_mut().clear();
        self.tx.count(|counters| counters.ups += 1);
        events(PortEvent::Up);
    }

    fn down(&mut self, events: &mut impl FnMut(PortEvent<'_>)) {
        self.sending = false;
        self.blocked = false;
        events(PortEvent::Down);
    }

    /// Begins the next transmission with everything handed over so far.
    fn begin(&mut self, device: &impl ByteStream, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        self.bytes.clear();
        self.bytes.append(&mut self.tx.bytes.borrow_mut());
        if self.bytes.is_empty() {
            return Ok(());
        }
        self.written = 0;
        self.start = now();
        self.sending = true;
        self.advance(device, events)
    }

    /// Writes what is due and sets the timer to what comes next.
    fn advance(
        &mut self,
        device: &impl ByteStream,
        events: &mut impl FnMut(PortEvent<'_>),
    ) -> io::Result<()> {
        let at = now();
        let end = self.start + self.line.time_on_line(self.bytes.len());
        let due = match self.paced {
            true => bytes_in(&self.line, at.saturating_since(self.start)).min(self.bytes.len()),
            false => self.bytes.len(),
        };
        self.write_up_to(due, device)?;
        if self.blocked {
            return Ok(());
        }
        if self.written < self.bytes.len() {
            let next = self.start + self.line.time_on_line(self.written + 1);
            return self.timer.arm(next.max(at + CLUMP).min(end));
        }
        if at < end {
            return self.timer.arm(end);
        }
        if device.is_draining() {
            return self.timer.arm(at + DRAIN_LOOK);
        }
        self.sending = false;
        if self.tx.bytes.borrow().is_empty() {
            events(PortEvent::Sent);
        } else {
            self.tx.wake.notify_one();
        }
        Ok(())
    }

    fn write_up_to<D: ByteStream>(&mut self, due: usize, device: &D) -> io::Result<()> {
        self.blocked = false;
        if self.written < due && !device.is_heard() {
            let lost = (due - self.written) as u64;
            self.tx.count(|counters| counters.unheard += lost);
            self.written = due;
        }
        while self.written < due {
            match device.try_write(&self.bytes[self.written..due]) {
                Ok(count) => {
                    self.tx.count(|counters| counters.bytes_out += count as u64);
                    self.written += count;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    if !D::LOSSY {
                        self.blocked = true;
                        return Ok(());
                    }
                    let lost = (due - self.written) as u64;
                    self.tx.count(|counters| counters.dropped += lost);
                    self.written = due;
                }
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

/// How many bytes have ended on the line after `time`.
fn bytes_in(line: &Rs485, time: Duration) -> usize {
    let bits = u128::from(time.as_micros()) * u128::from(line.baud) / 1_000_000;
    usize::try_from(bits / u128::from(line.bits_per_character())).unwrap_or(usize::MAX)
}

/// Most bytes read at once: the frames in them go through the engine before anybody else has a turn.
const CHUNK: usize = 512;
/// The same of what waited while the process slept.
const OLD_CHUNK: usize = 16 * 1_024;
/// Reads at the end of a sleep before others have a turn.
const MOST_SWALLOWED: usize = 64;
/// Paced bytes closer together than this appear together, as out of a UART's FIFO.
const CLUMP: Duration = Duration::from_micros(500);
/// Between two looks at what a serial device still holds.
const DRAIN_LOOK: Duration = Duration::from_micros(200);
/// Between two looks for a client that went away and left bytes behind.
const STALE_LOOK: StdDuration = StdDuration::from_millis(100);

#[cfg(test)]
#[path = "line_tests.rs"]
mod tests;
