//! Between a port's device and the port's owner: events, a handle for sending, and the device's counters.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;

use proto_core::engine::BusState;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use serde::Serialize;
use tokio::sync::Notify;

use recipe_net::log_limit::LogLimit;
use recipe_net::timer::now;

/// An event of a device.
#[derive(Debug, PartialEq)]
pub enum PortEvent<'a> {
    /// The device can be used from now on.
    Up,
    /// The device cannot be used any more.
    Down,
    /// Bytes arrived.
    Bytes(&'a [u8]),
    /// A CAN frame arrived.
    Frame {
        /// The frame.
        frame: CanFrame,
    },
    /// The error state of a CAN controller; reported after each [`PortEvent::Up`], if it is known, and when
    /// it changes.
    Bus(BusState),
    /// Everything handed over has left.
    Sent,
}

/// The sending side of a port. Data that does not fit is dropped and counted.
#[derive(Debug, Default)]
pub struct PortTx {
    pub(super) bytes: RefCell<Vec<u8>>,
    pub(super) frames: RefCell<VecDeque<CanFrame>>,
    pub(super) wake: Notify,
    pub(super) counters: Cell<DeviceCounters>,
    /// For lines about clients.
    pub(super) log_limit: LogLimit,
    /// Data read before this instant may have waited while the process slept.
    stale_until: Cell<Instant>,
    pub(super) slept: Notify,
    pub(super) looked: Notify,
}

impl PortTx {
    /// Makes a serial line or an slcan terminal look for received bytes now: the kernel passes on a
    /// terminal's bytes later, unless they are asked for.
    pub fn look(&self) {
        self.looked.notify_one();
    }

    /// The process slept until now, so the age of data waiting in the device is unknown. The port's owner
    /// discards everything for [`STALE`]; no old data may be left then.
    pub fn note_sleep(&self, now: Instant) {
        self.stale_until.set(now + STALE);
        self.slept.notify_one();
    }

    /// Whether the port's owner discards data read now, since it may have waited while the process
    /// slept.
    pub(super) fn is_stale(&self) -> bool {
        self.stale_until.get() != Instant::ZERO && now() < self.stale_until.get()
    }

    /// Hands bytes over to a serial port.
    pub fn send(&self, bytes: &[u8]) {
        let mut queue = self.bytes.borrow_mut();
        if queue.len() + bytes.len() > MAX_QUEUED_BYTES {
            self.count(|counters| counters.dropped += 1);
        } else {
            queue.extend_from_slice(bytes);
        }
        self.wake.notify_one();
    }

    /// Hands a frame over to a CAN port.
    pub fn send_frame(&self, frame: CanFrame) {
        let mut queue = self.frames.borrow_mut();
        if queue.len() == MAX_QUEUED_FRAMES {
            self.count(|counters| counters.dropped += 1);
        } else {
            queue.push_back(frame);
        }
        self.wake.notify_one();
    }

    /// The counters of the device.
    pub fn counters(&self) -> DeviceCounters {
        self.counters.get()
    }

    pub(super) fn count(&self, change: impl FnOnce(&mut DeviceCounters)) {
        let mut counters = self.counters.get();
        change(&mut counters);
        self.counters.set(counters);
    }
}

/// Data that waited while the process slept. A peer's system may hold megabytes for a connection,
/// more than can be read while the port's owner discards it.
#[derive(Debug, Default)]
pub(super) struct Backlog {
    /// There was more than could be read in that time.
    is_behind: bool,
    /// Since when there was no more than could be read at once.
    small_since: Option<Instant>,
}

impl Backlog {
    /// Whether data read now may be part of it: then it may be read in larger pieces.
    pub(super) fn is_open(&self, tx: &PortTx) -> bool {
        self.is_behind || tx.is_stale()
    }

    /// Whether data just read is part of it and not discarded by the port's owner. `is_more` if
    /// there was more than was read.
    pub(super) fn has(&mut self, tx: &PortTx, is_more: bool) -> bool {
        if tx.is_stale() {
            self.is_behind = is_more;
            return false;
        }
        if !self.is_behind {
            return false;
        }
        let now = now();
        // A peer's system may pause before it sends more of it.
        let since = *self.small_since.get_or_insert(now);
        if is_more {
            self.small_since = None;
        }
        let is_over = !is_more && now.saturating_since(since) >= PAUSE;
        // A peer that never pauses is read again after some time.
        self.is_behind = !is_over && now.saturating_since(tx.stale_until.get()) < MAX_BACKLOG;
        self.is_behind
    }
}

/// The counters of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct DeviceCounters {
    /// Bytes received; of a CAN port, data bytes.
    pub bytes_in: u64,
    /// Bytes sent; of a CAN port, data bytes.
    pub bytes_out: u64,
    /// CAN frames received.
    pub frames_in: u64,
    /// CAN frames sent.
    pub frames_out: u64,
    /// Bytes sent while no client was connected.
    pub unheard: u64,
    /// Bytes that a client did not read in time, whole frames sent while the queue was full, and
    /// data that waited while the process slept and was read too late for the engine to discard it.
    pub dropped: u64,
    /// Clients refused because there was one already, or too many.
    pub refused: u64,
    /// Failed accepts, probably for lack of descriptors.
    pub accept_failures: u64,
    /// Times the device became usable.
    pub ups: u64,
    /// Frames that the kernel dropped because they were not read in time (SO_RXQ_OVFL).
    pub overruns: u64,
    /// Times the kernel did not accept a CAN frame, which was then retried.
    pub refusals: u64,
    /// Error frames of a CAN interface.
    pub error_frames: u64,
    /// Times a CAN interface reported that it had lost received frames.
    pub overflows: u64,
    /// Times a CAN controller was started again after bus-off.
    pub restarts: u64,
    /// The newest transmit error counter of a CAN controller.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tx_error_counter: Option<u8>,
    /// Its receive error counter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rx_error_counter: Option<u8>,
    /// CAN FD frames, which no recipe takes.
    pub fd_frames: u64,
    /// A CAN controller's error state, where it is known: active, warning, passive or bus-off.
    #[serde(skip_serializing_if = "str::is_empty")]
    pub bus: &'static str,
}

/// The minimum time for which the engine discards input after sleep.
pub const STALE: Duration = Duration::from_millis(50);
/// A backlog ends after this long with less data than can be read at once: systems may pause within
/// one. The engine's links are not up earlier.
const PAUSE: Duration = Duration::from_millis(100);
/// A longer backlog counts as new data after this.
const MAX_BACKLOG: Duration = Duration::from_secs(10);
/// A frame of every port's recipe fits several times; a port waits for one to leave.
const MAX_QUEUED_BYTES: usize = 4_096;
/// Twice the maximum number of ids in a recipe's part.
const MAX_QUEUED_FRAMES: usize = 64;
