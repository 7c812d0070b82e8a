//! A CAN interface of the Linux kernel (docs/socketcan.md).
//!
//! In: frames to send, in order. Out: received frames, the interface's error state, and whether it exists.
//! Does not know recipes; the port's owner sets the ids to receive.
//!
//! A frame counts as sent when the kernel echoes it, which the interface's driver does after the frame was on the bus.
//! If no node acknowledges, only one cycle's frames wait and not a queue of old ones.

mod error_frame;
mod interface;
mod message;

use std::io;
use std::os::fd::AsFd;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use proto_core::engine::BusState;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use socketcan::{CanErrorFrame, CanFdSocket, CanFilter, EmbeddedFrame, Socket, SocketOptions};
use tokio::io::Interest;
use tracing::{debug, info, warn};

use self::error_frame::StateChange;
use self::interface::Interface;
use self::message::{CanMessage, Content};
use super::exchange::{Backlog, DeviceCounters, PortEvent, PortTx};
use crate::backoff::Backoff;
use crate::fairness::yield_fairly;
use crate::log_limit::LogLimit;
use crate::reactor::register;
use crate::timer::{Timer, now};

#[derive(Debug)]
pub(super) struct KernelCan {
    interface: String,
    /// Bit/s, from the configuration.
    bitrate: u32,
    ids: Option<Vec<CanId>>,
    tx: Rc<PortTx>,
}

impl KernelCan {
    pub(super) fn open(interface: &str, bitrate: u32, tx: Rc<PortTx>) -> io::Result<Self> {
        // Only to report errors early; the interface may still be down.
        match CanFdSocket::open(interface) {
            Ok(_) => Ok(Self { interface: interface.to_owned(), bitrate, ids: None, tx }),
            Err(error) => {
                let why = match error.raw_os_error() {
                    Some(libc::EAFNOSUPPORT) => "this kernel has no CAN".to_owned(),
                    Some(libc::ENODEV) => "no such CAN interface".to_owned(),
                    _ => error.to_string(),
                };
                let what = format!("{interface}: {why}; docs/socketcan.md says how to get one");
                Err(io::Error::new(error.kind(), what))
            }
        }
    }

    pub(super) fn place(&self) -> String {
        self.interface.clone()
    }

    pub(super) fn listen_to(&mut self, ids: Vec<CanId>) {
        self.ids = Some(ids);
    }

    /// Logs a difference. The administrator sets the interface's bit rate, so it is not an error.
    fn compare_bitrates(&self) {
        let (interface, configured) = (&self.interface, self.bitrate);
        // A controller's clock may not allow the exact rate.
        let tolerance = configured / 100;
        match Interface::of(interface).bitrate {
            Some(bitrate) if bitrate.abs_diff(configured) > tolerance => {
                warn!(interface, bitrate, configured, "the interface and the port have different bit rates");
            }
            _ => {}
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let interface = &self.interface;
        let mut backoff = Backoff::new(MIN_PAUSE, MAX_PAUSE);
        loop {
            match Attached::new(&self) {
                Ok(mut attached) => {
                    info!(interface, "up");
                    self.compare_bitrates();
                    backoff.reset();
                    self.tx.frames.borrow_mut().clear();
                    self.tx.count(|counters| counters.ups += 1);
                    events(PortEvent::Up);
                    let error = attached.work(&mut events).await;
                    warn!(interface, %error, "interface lost, will be reopened");
                    events(PortEvent::Down);
                }
                Err(error) => debug!(interface, %error, "cannot open the interface"),
            }
            backoff.wait().await;
        }
    }
}

/// An interface that is up, with a socket on it.
struct Attached<'a> {
    port: &'a KernelCan,
    socket: CanFdSocket,
    timer: Timer,
    state: BusState,
    // A limit for each state: a shorted bus changes its state many times a second.
    bus_off_log: LogLimit,
    passive_log: LogLimit,
    /// Frames that the kernel accepted and has not echoed.
    in_flight: usize,
    /// [`Self::lost`] when the kernel accepted the first frame in flight.
    lost_at_send: u32,
    /// Since when the kernel has refused the next frame.
    refused_since: Option<Instant>,
    /// Frames that the kernel dropped on this socket.
    lost: u32,
    /// When to call [`Self::check`]; never if nothing is pending.
    check_at: Instant,
    backlog: Backlog,
    /// Interval of checks of an interface that is bus-off.
    bus_off_polls: Backoff,
}

impl<'a> Attached<'a> {
    fn new(port: &'a KernelCan) -> io::Result<Self> {
        let socket = CanFdSocket::open(&port.interface)?;
        socket.set_nonblocking(true)?;
        if let Some(ids) = &port.ids {
            let filters: Vec<CanFilter> = ids.iter().map(|&id| filter(id)).collect();
            socket.set_filters(&filters)?;
        }
        socket.set_error_filter_accept_all()?;
        socket.set_recv_own_msgs(true)?;
        // As large as the system allows; beyond it the kernel drops and counts frames.
        let (level, forced) = (libc::SOL_SOCKET, libc::SO_RCVBUFFORCE);
        if socket.set_socket_option_int(level, forced, RECEIVE_BUFFER).is_err() {
            let _ = socket.set_socket_option_int(level, libc::SO_RCVBUF, RECEIVE_BUFFER);
        }
        // A socket on an interface that is down has an error from the start.
        if let Some(error) = socket.as_raw_socket().take_error()? {
            return Err(error);
        }
        // Forget the counters of the previous controller.
        port.tx.count(|counters| (counters.tx_error_counter, counters.rx_error_counter) = (None, None));
        Ok(Self {
            port,
            socket,
            timer: Timer::new()?,
            state: Interface::of(&port.interface).bus(),
            bus_off_log: LogLimit::default(),
            passive_log: LogLimit::default(),
            in_flight: 0,
            lost_at_send: 0,
            refused_since: None,
            lost: 0,
            check_at: Instant::ZERO,
            backlog: Backlog::new(&port.tx),
            bus_off_polls: Backoff::new(MIN_POLL, MAX_POLL),
        })
    }

    /// Moves frames in both directions until the interface is gone.
    async fn work(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Error {
        let ready = match self
            .socket
            .as_fd()
            .try_clone_to_owned()
            .and_then(|fd| register(fd, Interest::READABLE | Interest::WRITABLE))
        {
            Ok(ready) => ready,
            Err(error) => return error,
        };
        self.enter_state(self.state, events);
        loop {
            if self.backlog.has_slept(&self.port.tx)
                && let Err(error) = self.discard_backlog(events)
            {
                return error;
            }
            let mut more = MoreData::No;
            let done = tokio::select! {
                // The crate's own async socket waits only for data. It would miss that the interface went down, which
                // is an error of the socket without data.
                ready = ready.ready(Interest::READABLE | Interest::ERROR) => ready.and_then(|mut ready| {
                    more = self.receive_some(events)?;
                    if more == MoreData::No {
                        ready.clear_ready();
                    }
                    Ok(())
                }),
                () = self.port.tx.slept.notified() => Ok(()),
                () = self.port.tx.wake.notified(), if !self.is_sending() => self.send(events),
                expired = self.timer.expired() => expired.and_then(|()| self.check(events)),
            };
            if let Err(error) = done.and_then(|()| self.timer.arm(self.deadline())) {
                return error;
            }
            if more == MoreData::Maybe && !self.port.tx.is_stale() {
                yield_fairly().await;
            }
        }
    }

    /// Reads a batch of waiting frames from the socket.
    fn receive_some(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<MoreData> {
        for _ in 0..BATCH {
            match message::receive(self.socket.as_fd()) {
                Ok(message) => self.take(message, events)?,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.count_lost()?;
                    return Ok(MoreData::No);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(MoreData::Maybe)
    }

    /// Reads everything that can have waited while the process slept, so that the engine counts and discards it. Drops
    /// what the engine no longer discards.
    fn discard_backlog(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        for _ in 0..MAX_WAITING {
            match message::receive(self.socket.as_fd()) {
                Ok(message) => self.take(message, events)?,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        self.backlog.note(&self.port.tx, false);
        Ok(())
    }

    fn take(&mut self, message: CanMessage, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let tx = &self.port.tx;
        match message.content {
            Content::Frame(_) if message.is_own => {
                self.in_flight = self.in_flight.saturating_sub(1);
                return self.continue_sending(events);
            }
            Content::Frame(frame) => {
                tx.count(|counters| {
                    counters.frames_in += 1;
                    counters.bytes_in += frame.data().len() as u64;
                });
                // A node that receives is not bus-off. Adapters with old firmware report the recovery in no other way.
                if self.is_off() && !message.is_local && Interface::of(&self.port.interface).has_carrier {
                    self.enter_state(BusState::Active, events);
                }
                if self.backlog.has_slept(tx) && !tx.is_stale() {
                    tx.count(|counters| counters.dropped += 1);
                } else {
                    events(PortEvent::Frame { frame });
                }
            }
            Content::Error(frame) => self.take_error(frame, events),
            Content::Fd => tx.count(|counters| counters.fd_frames += 1),
            Content::Unknown => {}
        }
        Ok(())
    }

    fn take_error(&mut self, frame: CanErrorFrame, events: &mut impl FnMut(PortEvent<'_>)) {
        let tx = &self.port.tx;
        let counters_of_frame = error_frame::counters(frame);
        tx.count(|counters| {
            counters.error_frames += 1;
            counters.overflows += u64::from(error_frame::is_overflow(frame));
            if let Some((transmit, receive)) = counters_of_frame {
                (counters.tx_error_counter, counters.rx_error_counter) = (Some(transmit), Some(receive));
            }
        });
        match error_frame::state_change(frame) {
            StateChange::Restarted => {
                tx.count(|counters| counters.restarts += 1);
                self.enter_state(BusState::Active, events);
            }
            // Some drivers report a better state before the controller is restarted.
            StateChange::State(state) if self.is_off() && Interface::of(&self.port.interface).is_off() => {
                debug!(?state, "state reported during bus-off");
            }
            StateChange::State(state) if state != self.state => self.enter_state(state, events),
            StateChange::State(_) | StateChange::Other => {}
        }
    }

    /// Sets and reports the controller's state.
    fn enter_state(&mut self, state: BusState, events: &mut impl FnMut(PortEvent<'_>)) {
        let interface = &self.port.interface;
        self.state = state;
        self.port.tx.count(|counters| counters.bus = error_frame::name(state));
        let DeviceCounters { tx_error_counter, rx_error_counter, .. } = self.port.tx.counters();
        match state {
            BusState::BusOff => {
                if let Some(more) = self.bus_off_log.allow(now()) {
                    warn!(interface, more, "bus-off: nothing is sent until the interface is restarted");
                }
            }
            BusState::Passive => {
                if let Some(more) = self.passive_log.allow(now()) {
                    let what = "error-passive: no node acknowledges, bit rates differ, or the cable is bad";
                    warn!(interface, more, tx_error_counter, rx_error_counter, "{what}");
                }
            }
            _ => info!(interface, state = error_frame::name(state), "bus state"),
        }
        if state == BusState::BusOff {
            self.bus_off_polls.reset();
            self.check_at = now() + pause(self.bus_off_polls.pause());
            // Frames in flight will be sent too late or never.
            self.in_flight = 0;
            self.drop_queue();
        }
        events(PortEvent::Bus(state));
    }

    fn is_off(&self) -> bool {
        self.state == BusState::BusOff
    }

    fn is_sending(&self) -> bool {
        self.in_flight > 0 || self.refused_since.is_some()
    }

    /// Sends queued frames in order until the kernel refuses one.
    fn send(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        if self.is_off() {
            self.drop_queue();
            return Ok(());
        }
        let tx = &self.port.tx;
        loop {
            let next = tx.frames.borrow().front().copied();
            let Some(frame) = next else { return Ok(()) };
            match self.socket.write_frame(&kernel_frame(&frame)?) {
                Ok(()) => {
                    tx.frames.borrow_mut().pop_front();
                    tx.count(|counters| {
                        counters.frames_out += 1;
                        counters.bytes_out += frame.data().len() as u64;
                    });
                    if self.in_flight == 0 {
                        self.lost_at_send = self.lost;
                    }
                    self.in_flight += 1;
                    self.check_at = now() + ECHO_TIMEOUT;
                    self.refused_since = None;
                }
                Err(error) if is_full(&error) => {
                    tx.count(|counters| counters.refusals += 1);
                    let since = *self.refused_since.get_or_insert_with(now);
                    if now().saturating_since(since) < MAX_REFUSED {
                        self.check_at = now() + RETRY;
                        return Ok(());
                    }
                    // The rest of the cycle is dropped: the next cycle is newer.
                    self.drop_queue();
                    return self.continue_sending(events);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Sends the next frames, or reports that everything was sent.
    fn continue_sending(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        if self.is_sending() {
            return Ok(());
        }
        if !self.port.tx.frames.borrow().is_empty() {
            return self.send(events);
        }
        events(PortEvent::Sent);
        Ok(())
    }

    fn drop_queue(&mut self) {
        self.refused_since = None;
        let mut queue = self.port.tx.frames.borrow_mut();
        self.port.tx.count(|counters| counters.dropped += queue.len() as u64);
        queue.clear();
    }

    fn deadline(&self) -> Instant {
        if self.is_off() || self.is_sending() { self.check_at } else { Instant::NEVER }
    }

    /// Handles the timer: polls a bus-off interface, retries a refused frame, or looks for lost echoes.
    fn check(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        if self.is_off() {
            self.check_at = now() + pause(self.bus_off_polls.pause());
            let interface = Interface::of(&self.port.interface);
            if !interface.is_off() {
                self.enter_state(interface.bus(), events);
            }
            return Ok(());
        }
        if self.refused_since.is_some() {
            return self.send(events);
        }
        self.check_at = now() + ECHO_TIMEOUT;
        self.count_lost()?;
        if self.in_flight > 0 && self.lost != self.lost_at_send {
            // The lost messages may include their echoes.
            self.in_flight = 0;
            return self.continue_sending(events);
        }
        Ok(())
    }

    /// Counts messages that the kernel dropped because they were not read in time. SO_RXQ_OVFL would report
    /// the same number, but only with the next frame.
    fn count_lost(&mut self) -> io::Result<()> {
        let mut info = [0; MEMINFO_LEN];
        self.socket.get_socket_option_bytes(libc::SOL_SOCKET, libc::SO_MEMINFO, &mut info)?;
        let [.., a, b, c, d] = info;
        let lost = u32::from_ne_bytes([a, b, c, d]);
        let more = lost.wrapping_sub(self.lost);
        self.lost = lost;
        self.port.tx.count(|counters| counters.overruns += u64::from(more));
        Ok(())
    }
}

/// Whether a socket may have more data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MoreData {
    No,
    Maybe,
}

/// A filter for data and remote frames with this id.
fn filter(id: CanId) -> CanFilter {
    match id {
        CanId::Standard(id) => CanFilter::new(u32::from(id), libc::CAN_SFF_MASK | libc::CAN_EFF_FLAG),
        CanId::Extended(id) => {
            CanFilter::new(id | libc::CAN_EFF_FLAG, libc::CAN_EFF_MASK | libc::CAN_EFF_FLAG)
        }
    }
}

fn kernel_frame(frame: &CanFrame) -> io::Result<socketcan::CanFrame> {
    let (id, len) = (embedded_can::Frame::id(frame), embedded_can::Frame::dlc(frame));
    let made = if frame.is_remote() {
        socketcan::CanFrame::new_remote(id, len)
    } else {
        socketcan::CanFrame::new(id, frame.data())
    };
    made.ok_or_else(|| io::ErrorKind::InvalidInput.into())
}

/// Whether the queue of the interface (ENOBUFS) or of the socket (EAGAIN) is full. The kernel does not report when the
/// interface's queue has room again.
fn is_full(error: &io::Error) -> bool {
    matches!(error.raw_os_error(), Some(libc::ENOBUFS | libc::EAGAIN | libc::EINTR))
}

fn pause(pause: StdDuration) -> Duration {
    Duration::from_micros(u64::try_from(pause.as_micros()).unwrap_or(u64::MAX))
}

/// Pause between attempts to open an interface.
const MIN_PAUSE: StdDuration = StdDuration::from_millis(20);
const MAX_PAUSE: StdDuration = StdDuration::from_millis(500);
/// Interval at which a bus-off interface is checked, in case its restart is not reported.
const MIN_POLL: StdDuration = StdDuration::from_millis(50);
const MAX_POLL: StdDuration = StdDuration::from_secs(1);
/// Time until a refused frame is retried: about one frame on a usual bus.
const RETRY: Duration = Duration::from_micros(250);
/// How long the kernel may refuse the next frame before the rest of the cycle is dropped.
const MAX_REFUSED: Duration = Duration::from_millis(100);
/// Time after which a frame's echo may have been lost.
const ECHO_TIMEOUT: Duration = Duration::from_millis(20);
const BATCH: usize = 64;
/// Bytes: half a second of a full bus at 500 kbit/s. Without privileges the system allows a fifth of it.
const RECEIVE_BUFFER: i32 = 1_024 * 1_024;
/// More frames than that buffer holds: the kernel counts more bytes than this for each.
const MAX_WAITING: usize = RECEIVE_BUFFER as usize / 128;
/// Length of SO_MEMINFO: nine numbers, the last of which counts dropped messages.
const MEMINFO_LEN: usize = 9 * 4;
