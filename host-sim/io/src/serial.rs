//! A serial port on a pseudoterminal, a serial device or a TCP byte stream.
//!
//! Only a serial device has a real line. On the others a transmission takes as long as on a line: `Sent` is
//! reported when the last stop bit would have left, so that cycles have the same timing everywhere.

use std::cell::RefCell;
use std::io;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use proto_core::config::Rs485;
use proto_core::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::yield_now;
use tracing::{debug, info, warn};

use super::bind::{Device, HostPort, Pace};
use super::exchange::{Backlog, PortEvent, PortTx};
use super::handover::{HandoverState, Held};
use super::pty::Pty;
use super::stream::{self, ByteStream, accept};
use crate::backoff::Backoff;
use crate::clock::{Alarm, Clock};
use crate::connect::connect;
use crate::fairness::{Either, Order, either, give_way, yield_fairly};
use crate::tcp_options;
use crate::timer::now;
use crate::tty::Tty;

#[derive(Debug)]
pub(super) struct SerialPort {
    source: SerialSource,
    /// The device was taken over, and old input may wait in it.
    is_handed_over: bool,
    settings: Rs485,
    tx: Rc<PortTx>,
    /// The clock that determines when the last bit has left the line.
    pub(super) clock: Clock,
}

#[derive(Debug)]
enum SerialSource {
    Pty(Rc<Pty>, Pace),
    Serial(String, Tty),
    Connect(HostPort),
    Listen(Rc<TcpListener>, Rc<RefCell<Option<Rc<TcpStream>>>>),
}

impl SerialPort {
    pub(super) async fn open(
        device: &Device,
        settings: Rs485,
        tx: Rc<PortTx>,
        handover: Option<HandoverState>,
    ) -> io::Result<Self> {
        let is_handed_over = handover.is_some();
        let source = match device {
            Device::Pty { link, pace } => {
                let pty = match handover {
                    Some(HandoverState::Pty(handover)) => handover.attach()?,
                    _ => Pty::open(link)?,
                };
                SerialSource::Pty(Rc::new(pty), *pace)
            }
            Device::Serial { path } => {
                let path = path.display().to_string();
                let device = Tty::open(&path, settings)
                    .map_err(|error| io::Error::new(error.kind(), format!("{path}: {error}")))?;
                SerialSource::Serial(path, device)
            }
            Device::Tcp { to } => SerialSource::Connect(to.clone()),
            Device::TcpListen { listen } => {
                let (listener, client) = match handover {
                    Some(HandoverState::Listen(listener, client)) => {
                        let client = client.map(TcpStream::from_std).transpose()?;
                        (TcpListener::from_std(listener)?, client.map(Rc::new))
                    }
                    _ => (stream::listen(listen).await?, None),
                };
                SerialSource::Listen(Rc::new(listener), Rc::new(RefCell::new(client)))
            }
            Device::SocketCan { .. } | Device::SlcanPty { .. } | Device::SlcanTcp { .. } => {
                let what = format!("`{device}` is a CAN device; the port is a serial line");
                return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
            }
        };
        Ok(Self { source, is_handed_over, settings, tx, clock: Clock::real() })
    }

    pub(super) fn place(&self) -> String {
        match &self.source {
            SerialSource::Pty(pty, _) => pty.link().display().to_string(),
            SerialSource::Serial(path, _) => path.clone(),
            SerialSource::Connect(to) => to.to_string(),
            SerialSource::Listen(listener, _) => stream::address_of(listener),
        }
    }

    pub(super) fn held(&self) -> Option<Held> {
        match &self.source {
            SerialSource::Pty(pty, _) => Some(Held::Pty(Rc::clone(pty))),
            SerialSource::Listen(listener, client) => {
                Some(Held::Listen(Rc::clone(listener), Rc::clone(client)))
            }
            SerialSource::Serial(..) | SerialSource::Connect(_) => None,
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let Self { source, is_handed_over, settings, tx, clock } = self;
        let mut sender = Sender::new(settings, Rc::clone(&tx), clock)?;
        match source {
            SerialSource::Pty(pty, pace) => {
                sender.paced = pace == Pace::BitRate;
                if is_handed_over {
                    drain(&*pty, &tx).await?;
                }
                sender.up(&mut events);
                let backlog = Backlog::new(&tx);
                Err(pump(&*pty, &mut sender, backlog, &mut events).await)
            }
            SerialSource::Serial(path, device) => {
                let mut opened = Some(device);
                let mut backoff = Backoff::new(StdDuration::from_millis(100), StdDuration::from_secs(2));
                loop {
                    let device = match opened.take().map_or_else(|| Tty::open(&path, settings), Ok) {
                        Ok(device) => device,
                        Err(error) => {
                            debug!(%path, %error, "cannot open the device");
                            backoff.wait().await;
                            continue;
                        }
                    };
                    backoff.reset();
                    sender.up(&mut events);
                    let error = pump(&device, &mut sender, Backlog::new(&tx), &mut events).await;
                    warn!(%path, %error, "device lost, will be reopened");
                    sender.down(&mut events);
                }
            }
            SerialSource::Connect(to) => {
                let mut backoff = Backoff::new(StdDuration::from_millis(20), StdDuration::from_secs(2));
                loop {
                    let known = tx.sleeps();
                    match connect((to.host.as_str(), to.port)).await {
                        Ok(stream) => {
                            info!(%to, "connected");
                            backoff.reset();
                            tcp_options::deliver_in_time(&stream, DELIVERY);
                            sender.up(&mut events);
                            let backlog = Backlog::accepted(&tx, known);
                            let error = pump(&stream, &mut sender, backlog, &mut events).await;
                            info!(%to, %error, "connection lost");
                            sender.down(&mut events);
                        }
                        Err(error) => debug!(%to, %error, "cannot connect"),
                    }
                    backoff.wait().await;
                }
            }
            SerialSource::Listen(listener, client) => {
                let mut resumed = client.borrow().clone();
                let mut known = tx.sleeps();
                loop {
                    let (stream, backlog) = match resumed.take() {
                        Some(stream) => match drain(&*stream, &tx).await {
                            Ok(()) => (stream, Backlog::new(&tx)),
                            Err(error) => {
                                info!(%error, "the client disconnected meanwhile");
                                client.take();
                                continue;
                            }
                        },
                        None => {
                            let (stream, peer) = accept(&listener, &tx).await;
                            info!(%peer, "client connected");
                            tcp_options::deliver_in_time(&stream, DELIVERY);
                            let stream = Rc::new(stream);
                            client.replace(Some(Rc::clone(&stream)));
                            (stream, Backlog::accepted(&tx, known))
                        }
                    };
                    known = tx.sleeps();
                    sender.up(&mut events);
                    tokio::select! {
                        error = pump(&*stream, &mut sender, backlog, &mut events) => {
                            info!(peer = %stream::peer_of(&stream), %error, "client disconnected");
                        }
                        () = refuse_all(&listener, &tx) => {}
                    }
                    client.take();
                    sender.down(&mut events);
                }
            }
        }
    }
}

async fn refuse_all(listener: &TcpListener, tx: &PortTx) {
    loop {
        let (stream, peer) = accept(listener, tx).await;
        drop(stream);
        tx.count(|counters| counters.refused += 1);
        if let Some(more) = tx.log_limit.allow(now()) {
            warn!(%peer, more, "refused: the line already has a client");
        }
        yield_fairly().await;
    }
}

/// Moves bytes in both directions until the device fails.
async fn pump<D: ByteStream>(
    device: &D,
    sender: &mut Sender,
    mut backlog: Backlog,
    events: &mut impl FnMut(PortEvent<'_>),
) -> io::Error {
    let mut buf = vec![0; BACKLOG_CHUNK];
    // Input goes first, unless it went first the last time too: a line that never pauses would starve the rest.
    let mut order = Order::LeftFirst;
    loop {
        if backlog.has_slept(&sender.tx) {
            discard_backlog(device, &sender.tx, &mut backlog, &mut buf, events);
        }
        let most = if backlog.is_open(&sender.tx) { BACKLOG_CHUNK } else { CHUNK };
        let next = either(device.receive(&mut buf[..most]), other(device, sender), order).await;
        order = if matches!(next, Either::Left(_)) { Order::RightFirst } else { Order::LeftFirst };
        let done = match next {
            Either::Left(Ok(0)) => Err(io::ErrorKind::UnexpectedEof.into()),
            Either::Left(Ok(count)) => {
                let is_full = count == most;
                take(&buf[..count], is_full, &sender.tx, &mut backlog, events);
                // A device that never pauses must not delay other tasks. Bytes that the engine discards take little
                // time, and must be read before it accepts input again.
                let is_much = is_full && !sender.tx.is_stale();
                if is_much {
                    yield_fairly().await
                } else {
                    give_way().await
                }
                Ok(())
            }
            Either::Left(Err(error)) if error.kind() == io::ErrorKind::Interrupted => Ok(()),
            Either::Left(Err(error)) => Err(error),
            Either::Right(Other::Slept) => Ok(()),
            Either::Right(Other::Looked) => look(device, &sender.tx, &mut backlog, &mut buf[..most], events),
            Either::Right(Other::HandedOver) => sender.begin(device, events),
            Either::Right(Other::Due(due)) => due.and_then(|()| sender.advance(device, events)),
            Either::Right(Other::MayHaveGone) => {
                device.has_client();
                Ok(())
            }
        };
        if let Err(error) = done {
            return error;
        }
    }
}

/// What a port waits for besides bytes.
enum Other {
    Slept,
    /// Received bytes are requested from the driver.
    Looked,
    HandedOver,
    /// The transmission can continue.
    Due(io::Result<()>),
    /// A client may have gone and left bytes unread.
    MayHaveGone,
}

async fn other<D: ByteStream>(device: &D, sender: &Sender) -> Other {
    tokio::select! {
        () = sender.tx.slept.notified() => Other::Slept,
        () = sender.tx.looked.notified(), if D::LATE => Other::Looked,
        () = sender.tx.wake.notified(), if !sender.sending => Other::HandedOver,
        expired = sender.timer.expired(), if sender.sending && !sender.blocked => Other::Due(expired),
        ready = device.writable(), if sender.blocked => Other::Due(ready),
        () = tokio::time::sleep(CLIENT_POLL), if device.may_hold_unread() => Other::MayHaveGone,
    }
}

/// Reads and drops input from before the takeover, whose age is unknown. That takes [`STALE`](super::exchange::STALE),
/// and longer while there is more than can be read at once, as after sleep.
async fn drain(device: &impl ByteStream, tx: &PortTx) -> io::Result<()> {
    let mut buf = vec![0; BACKLOG_CHUNK];
    let mut backlog = Backlog::new(tx);
    tx.note_gap(now());
    while backlog.is_open(tx) {
        tokio::select! {
            read = device.receive(&mut buf) => match read {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(count) => {
                    tx.count(|counters| {
                        counters.bytes_in += count as u64;
                        counters.dropped += count as u64;
                    });
                    backlog.has(tx, count == BACKLOG_CHUNK);
                    yield_now().await;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            },
            () = tokio::time::sleep(DRAIN_LOOK) => {
                if !tx.is_stale() {
                    backlog.has(tx, false);
                }
            }
        }
    }
    device.discard_unread();
    Ok(())
}

/// Reports bytes just read, or drops them if they may have waited while the process slept and the engine no longer
/// discards them.
fn take(
    bytes: &[u8],
    is_full: bool,
    tx: &PortTx,
    backlog: &mut Backlog,
    events: &mut impl FnMut(PortEvent<'_>),
) {
    tx.count(|counters| counters.bytes_in += bytes.len() as u64);
    if backlog.has(tx, is_full) {
        tx.count(|counters| counters.dropped += bytes.len() as u64);
    } else {
        events(PortEvent::Bytes(bytes));
    }
}

/// Reports what can be read at once.
fn look(
    device: &impl ByteStream,
    tx: &PortTx,
    backlog: &mut Backlog,
    buf: &mut [u8],
    events: &mut impl FnMut(PortEvent<'_>),
) -> io::Result<()> {
    match device.try_read(buf) {
        Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
        Ok(count) => {
            take(buf.get(..count).unwrap_or(buf), count == buf.len(), tx, backlog, events);
            Ok(())
        }
        Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {
            Ok(())
        }
        Err(error) => Err(error),
    }
}

/// Reads what waited while the process slept, so that the engine counts and discards it, and drops the rest: the kernel
/// makes a terminal's bytes readable in pieces, some of them later.
fn discard_backlog(
    device: &impl ByteStream,
    tx: &PortTx,
    backlog: &mut Backlog,
    buf: &mut [u8],
    events: &mut impl FnMut(PortEvent<'_>),
) {
    for _ in 0..MAX_BACKLOG_READS {
        let Ok(count @ 1..) = device.try_read(buf) else { break };
        take(&buf[..count], count == buf.len(), tx, backlog, events);
    }
    device.discard_unread();
    // The runtime may not know yet what the kernel holds.
    backlog.note(tx, device.has_unread());
}

/// The transmission in progress, and its timing.
struct Sender {
    tx: Rc<PortTx>,
    settings: Rs485,
    clock: Clock,
    timer: Alarm,
    paced: bool,
    bytes: Vec<u8>,
    written: usize,
    start: Instant,
    sending: bool,
    blocked: bool,
}

impl Sender {
    fn new(settings: Rs485, tx: Rc<PortTx>, clock: Clock) -> io::Result<Self> {
        Ok(Self {
            tx,
            settings,
            timer: clock.alarm()?,
            clock,
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
        // Disarming cannot fail. A stale deadline would stop a stepped clock.
        let _ = self.timer.arm(Instant::NEVER);
        events(PortEvent::Down);
    }

    /// Starts a transmission of everything queued so far.
    fn begin(&mut self, device: &impl ByteStream, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        self.bytes.clear();
        self.bytes.append(&mut self.tx.bytes.borrow_mut());
        if self.bytes.is_empty() {
            return Ok(());
        }
        self.written = 0;
        self.start = self.clock.now();
        self.sending = true;
        self.advance(device, events)
    }

    /// Writes what is due and sets the timer for the next step.
    fn advance(
        &mut self,
        device: &impl ByteStream,
        events: &mut impl FnMut(PortEvent<'_>),
    ) -> io::Result<()> {
        let at = self.clock.now();
        let end = self.start + self.settings.time_on_line(self.bytes.len());
        let due = match self.paced {
            true => bytes_in(&self.settings, at.saturating_since(self.start)).min(self.bytes.len()),
            false => self.bytes.len(),
        };
        self.write_up_to(due, device)?;
        if self.blocked {
            return Ok(());
        }
        if self.written < self.bytes.len() {
            let next = self.start + self.settings.time_on_line(self.written + 1);
            return self.timer.arm(next.max(at + MIN_WRITE_INTERVAL).min(end));
        }
        if at < end {
            return self.timer.arm(end);
        }
        if device.is_draining() {
            return self.timer.arm(at + DRAIN_POLL);
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
        if self.written < due && !device.has_client() {
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

/// Number of bytes that have left the line after `time`.
fn bytes_in(settings: &Rs485, time: Duration) -> usize {
    let bits = u128::from(time.as_micros()) * u128::from(settings.baud) / 1_000_000;
    usize::try_from(bits / u128::from(settings.bits_per_character())).unwrap_or(usize::MAX)
}

/// Maximum number of bytes per read: the engine handles all frames in them before another task runs.
const CHUNK: usize = 512;
/// The same for bytes that waited while the process slept.
const BACKLOG_CHUNK: usize = 16 * 1_024;
/// Interval of checks of a drained device while nothing arrives.
const DRAIN_LOOK: StdDuration = StdDuration::from_millis(10);
/// Maximum number of reads after a sleep before other tasks run.
const MAX_BACKLOG_READS: usize = 64;
/// Bytes sent over TCP arrive within this time or are dropped with their connection.
const DELIVERY: StdDuration = StdDuration::from_secs(1);
/// Paced bytes closer together than this are written together, as if from a UART's FIFO.
const MIN_WRITE_INTERVAL: Duration = Duration::from_micros(500);
/// Interval at which a serial device's output buffer is checked.
const DRAIN_POLL: Duration = Duration::from_micros(200);
/// Interval of checks whether a client has gone and left bytes unread.
const CLIENT_POLL: StdDuration = StdDuration::from_millis(100);

#[cfg(test)]
#[path = "serial_tests.rs"]
mod tests;
