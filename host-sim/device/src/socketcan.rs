//! A CAN interface of the Linux kernel (docs/socketcan.md).
//!
//! In: frames to send, in order. Out: frames, the interface's error state, and whether it is there. Refuses to know recipes: it is told which ids matter.
//!
//! A frame has left when the kernel gives it back: the interface's driver does that when the frame was
//! on the bus, so that a bus that nobody acknowledges holds one cycle's frames and not a queue of old
//! ones.

mod link;
mod message;
mod state;

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

use self::link::Link;
use self::message::{Content, Message};
use self::state::News;
use super::exchange::{DeviceCounters, PortEvent, PortTx};
use recipe_net::backoff::Backoff;
use recipe_net::quota::Quota;
use recipe_net::reactor::register;
use recipe_net::timer::{Timer, now};
use recipe_net::turns::give_way;

/// A port on an interface of the kernel.
#[derive(Debug)]
pub(super) struct KernelCan {
    interface: String,
    /// Bit/s, of the configuration.
    bitrate: u32,
    ids: Option<Vec<CanId>>,
    tx: Rc<PortTx>,
}

impl KernelCan {
    pub(super) fn open(interface: &str, bitrate: u32, tx: Rc<PortTx>) -> io::Result<Self> {
        // Only to say at once what is wrong; it may still be down.
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

    /// The interface's bit rate is the administrator's business, but a mistake is worth a word.
    fn compare_bitrates(&self) {
        let (interface, configured) = (&self.interface, self.bitrate);
        // A controller may not come nearer.
        let tolerance = configured / 100;
        match Link::of(interface).bitrate {
            Some(bitrate) if bitrate.abs_diff(configured) > tolerance => {
                warn!(interface, bitrate, configured, "the interface and the port have different bit rates");
            }
            _ => {}
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let interface = &self.interface;
        let mut backoff = Backoff::new(LEAST_PAUSE, MOST_PAUSE);
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
    /// Of each kind: a bus that is shorted changes its state many times a second.
    off_lines: Quota,
    passive_lines: Quota,
    /// Frames that the kernel took and did not give back yet.
    on_their_way: usize,
    /// [`Self::lost`] when the kernel took the first of them.
    lost_before: u32,
    /// Since when the kernel has not taken the next frame.
    refused_since: Option<Instant>,
    /// Frames that the kernel dropped on this socket.
    lost: u32,
    /// When to look after what is waited for, while something is.
    look_at: Instant,
    /// Pauses between looks at an interface that is bus-off.
    looks: Backoff,
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
        // As much as the system allows; what does not fit is dropped by the kernel, and counted.
        let (level, forced) = (libc::SOL_SOCKET, libc::SO_RCVBUFFORCE);
        if socket.set_socket_option_int(level, forced, RECEIVE_BUFFER).is_err() {
            let _ = socket.set_socket_option_int(level, libc::SO_RCVBUF, RECEIVE_BUFFER);
        }
        // A socket on an interface that is down begins with this error.
        if let Some(error) = socket.as_raw_socket().take_error()? {
            return Err(error);
        }
        // No longer those of the controller that was there before.
        port.tx.count(|counters| (counters.tx_error_counter, counters.rx_error_counter) = (None, None));
        Ok(Self {
            port,
            socket,
            timer: Timer::new()?,
            state: Link::of(&port.interface).bus(),
            off_lines: Quota::default(),
            passive_lines: Quota::default(),
            on_their_way: 0,
            lost_before: 0,
            refused_since: None,
            lost: 0,
            look_at: Instant::ZERO,
            looks: Backoff::new(LEAST_LOOK, MOST_LOOK),
        })
    }

    /// Moves frames both ways until the interface is gone.
    async fn work(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Error {
        let ready = match self.socket.as_fd().try_clone_to_owned().and_then(register) {
            Ok(ready) => ready,
            Err(error) => return error,
        };
        self.enter(self.state, events);
        loop {
            let mut left = Left::Nothing;
            let done = tokio::select! {
                // Waiting for data alone, as the crate's own async socket does, sleeps on when the
                // interface goes down: that is an error of the socket and no data.
                ready = ready.ready(Interest::READABLE | Interest::ERROR) => ready.and_then(|mut ready| {
                    left = self.receive_some(events)?;
                    if left == Left::Nothing {
                        ready.clear_ready();
                    }
                    Ok(())
                }),
                () = self.port.tx.wake.notified(), if !self.is_sending() => self.send(events),
                expired = self.timer.expired() => expired.and_then(|()| self.look(events)),
            };
            if let Err(error) = done.and_then(|()| self.timer.arm(self.deadline())) {
                return error;
            }
            if left == Left::Perhaps && !self.port.tx.is_stale() {
                give_way().await;
            }
        }
    }

    /// Takes what waits in the socket, but lets others run now and then.
    fn receive_some(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<Left> {
        for _ in 0..BATCH {
            match message::receive(self.socket.as_fd()) {
                Ok(message) => self.take(message, events)?,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.note_lost()?;
                    return Ok(Left::Nothing);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(Left::Perhaps)
    }

    fn take(&mut self, message: Message, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let tx = &self.port.tx;
        match message.content {
            Content::Frame(_) if message.is_own => {
                self.on_their_way = self.on_their_way.saturating_sub(1);
                return self.go_on(events);
            }
            Content::Frame(frame) => {
                tx.count(|counters| {
                    counters.frames_in += 1;
                    counters.bytes_in += frame.data().len() as u64;
                });
                // Who hears is on the bus. Adapters with an old firmware tell in no other way.
                if self.is_off() && !message.is_local && Link::of(&self.port.interface).has_carrier {
                    self.enter(BusState::Active, events);
                }
                events(PortEvent::Frame { frame });
            }
            Content::Error(frame) => self.take_error(frame, events),
            Content::Fd => tx.count(|counters| counters.fd_frames += 1),
            Content::Unknown => {}
        }
        Ok(())
    }

    fn take_error(&mut self, frame: CanErrorFrame, events: &mut impl FnMut(PortEvent<'_>)) {
        let tx = &self.port.tx;
        let told = state::counters(frame);
        tx.count(|counters| {
            counters.error_frames += 1;
            counters.overflows += u64::from(state::is_overflow(frame));
            if let Some((transmit, receive)) = told {
                (counters.tx_error_counter, counters.rx_error_counter) = (Some(transmit), Some(receive));
            }
        });
        match state::news(frame) {
            News::Restarted => {
                tx.count(|counters| counters.restarts += 1);
                self.enter(BusState::Active, events);
            }
            // Some drivers tell a milder state before the controller was started again.
            News::State(state) if self.is_off() && Link::of(&self.port.interface).is_off() => {
                debug!(?state, "state reported during bus-off");
            }
            News::State(state) if state != self.state => self.enter(state, events),
            News::State(_) | News::Other => {}
        }
    }

    /// The controller's state is this from now on.
    fn enter(&mut self, state: BusState, events: &mut impl FnMut(PortEvent<'_>)) {
        let interface = &self.port.interface;
        self.state = state;
        self.port.tx.count(|counters| counters.bus = state::name(state));
        let DeviceCounters { tx_error_counter, rx_error_counter, .. } = self.port.tx.counters();
        match state {
            BusState::BusOff => {
                if let Some(more) = self.off_lines.take(now()) {
                    warn!(interface, more, "bus-off: nothing is sent until the interface is restarted");
                }
            }
            BusState::Passive => {
                if let Some(more) = self.passive_lines.take(now()) {
                    let what = "error-passive: no node acknowledges, bit rates differ, or the cable is bad";
                    warn!(interface, more, tx_error_counter, rx_error_counter, "{what}");
                }
            }
            _ => info!(interface, state = state::name(state), "bus state"),
        }
        if state == BusState::BusOff {
            self.looks.reset();
            self.look_at = now() + pause(self.looks.pause());
            // What was under way will not leave, or would be old when it did.
            self.on_their_way = 0;
            self.give_up_queue();
        }
        events(PortEvent::Bus(state));
    }

    fn is_off(&self) -> bool {
        self.state == BusState::BusOff
    }

    fn is_sending(&self) -> bool {
        self.on_their_way > 0 || self.refused_since.is_some()
    }

    /// Hands the queue over to the kernel, in order, as far as it takes it.
    fn send(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        if self.is_off() {
            self.give_up_queue();
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
                    if self.on_their_way == 0 {
                        self.lost_before = self.lost;
                    }
                    self.on_their_way += 1;
                    self.look_at = now() + ECHO_TIME;
                    self.refused_since = None;
                }
                Err(error) if is_full(&error) => {
                    tx.count(|counters| counters.refusals += 1);
                    let since = *self.refused_since.get_or_insert_with(now);
                    if now().saturating_since(since) < PATIENCE {
                        self.look_at = now() + RETRY;
                        return Ok(());
                    }
                    // A whole cycle or nothing of its rest: the next one is newer.
                    self.give_up_queue();
                    return self.go_on(events);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Says that everything has left, once it has.
    fn go_on(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        if self.is_sending() {
            return Ok(());
        }
        if !self.port.tx.frames.borrow().is_empty() {
            return self.send(events);
        }
        events(PortEvent::Sent);
        Ok(())
    }

    fn give_up_queue(&mut self) {
        self.refused_since = None;
        let mut queue = self.port.tx.frames.borrow_mut();
        self.port.tx.count(|counters| counters.dropped += queue.len() as u64);
        queue.clear();
    }

    fn deadline(&self) -> Instant {
        if self.is_off() || self.is_sending() { self.look_at } else { Instant::NEVER }
    }

    /// Time has passed: what was waited for?
    fn look(&mut self, events: &mut impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        if self.is_off() {
            self.look_at = now() + pause(self.looks.pause());
            let link = Link::of(&self.port.interface);
            if !link.is_off() {
                self.enter(link.bus(), events);
            }
            return Ok(());
        }
        if self.refused_since.is_some() {
            return self.send(events);
        }
        self.look_at = now() + ECHO_TIME;
        self.note_lost()?;
        if self.on_their_way > 0 && self.lost != self.lost_before {
            // What was to tell that they have left may be among what was lost.
            self.on_their_way = 0;
            return self.go_on(events);
        }
        Ok(())
    }

    /// Counts what the kernel dropped because it was not read in time: the number that SO_RXQ_OVFL
    /// attaches to the next frame. Asking for it does not need one.
    fn note_lost(&mut self) -> io::Result<()> {
        let mut info = [0; MEMINFO];
        self.socket.get_socket_option_bytes(libc::SOL_SOCKET, libc::SO_MEMINFO, &mut info)?;
        let [.., a, b, c, d] = info;
        let lost = u32::from_ne_bytes([a, b, c, d]);
        let more = lost.wrapping_sub(self.lost);
        self.lost = lost;
        self.port.tx.count(|counters| counters.overruns += u64::from(more));
        Ok(())
    }
}

/// Whether a socket may have more to read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Left {
    Nothing,
    Perhaps,
}

/// Data and remote frames with this id.
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

/// Whether the interface's queue (ENOBUFS) or the socket's (EAGAIN) has no room for the moment. Nothing
/// tells when the former has some again.
fn is_full(error: &io::Error) -> bool {
    matches!(error.raw_os_error(), Some(libc::ENOBUFS | libc::EAGAIN | libc::EINTR))
}

fn pause(pause: StdDuration) -> Duration {
    Duration::from_micros(u64::try_from(pause.as_micros()).unwrap_or(u64::MAX))
}

/// Between two attempts to open an interface.
const LEAST_PAUSE: StdDuration = StdDuration::from_millis(20);
const MOST_PAUSE: StdDuration = StdDuration::from_millis(500);
/// Between two looks whether an interface is still bus-off, should nobody tell.
const LEAST_LOOK: StdDuration = StdDuration::from_millis(50);
const MOST_LOOK: StdDuration = StdDuration::from_secs(1);
/// Until a frame that the kernel did not take is tried again: about a frame's time on a usual bus.
const RETRY: Duration = Duration::from_micros(250);
/// How long the kernel may refuse the next frame before the rest of the cycle is given up.
const PATIENCE: Duration = Duration::from_millis(100);
/// How long a frame may be on its way before a look whether its return was lost.
const ECHO_TIME: Duration = Duration::from_millis(20);
/// Frames taken before others run.
const BATCH: usize = 64;
/// Bytes: half a second of a full bus at 500 kbit/s. Without privileges the system allows a fifth.
const RECEIVE_BUFFER: i32 = 1_024 * 1_024;
/// Nine numbers; the last is of dropped messages.
const MEMINFO: usize = 9 * 4;
