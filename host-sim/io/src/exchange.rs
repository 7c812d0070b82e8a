//! Between a port's device and the port's owner: events, a handle to send with, and the device's counters.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;

use proto_core::engine::BusState;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use serde::Serialize;
use tokio::sync::Notify;

use crate::log_limit::LogLimit;
use crate::timer::now;

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
    /// The error state of a CAN controller, if known: after each [`PortEvent::Up`], and when it changes.
    Bus(BusState),
    /// Everything sent so far has left.
    Sent,
}

/// The sending side of a port. Data that does not fit is dropped and counted.
#[derive(Debug, Default)]
pub struct PortTx {
    pub(super) bytes: RefCell<Vec<u8>>,
    pub(super) frames: RefCell<VecDeque<CanFrame>>,
    pub(super) wake: Notify,
    pub(super) counters: Cell<DeviceCounters>,
    /// Limits log lines about clients.
    pub(super) log_limit: LogLimit,
    /// Data read before this instant may have waited while the process slept.
    stale_until: Cell<Instant>,
    sleeps: Cell<u32>,
    /// The device has failed and is not handed over.
    pub(super) has_failed: Cell<bool>,
    pub(super) slept: Notify,
    pub(super) looked: Notify,
}

impl PortTx {
    /// Makes a serial line or an slcan terminal check for received bytes now: otherwise the kernel passes a terminal's
    /// bytes on later.
    pub fn look(&self) {
        self.looked.notify_one();
    }

    /// The process slept until now, so the age of data waiting in the device is unknown. The port's owner discards all
    /// input for [`STALE`]; no old data may be left after that.
    pub fn note_sleep(&self, now: Instant) {
        self.stale_until.set(now + STALE);
        self.sleeps.set(self.sleeps.get().wrapping_add(1));
        // Several clients of a bus may wait. A client that is not waiting compares the count before it waits again.
        self.slept.notify_waiters();
    }

    /// The device was taken over, and nobody has read it until now. The device's task drops input for [`STALE`],
    /// because the port's owner knows nothing of the gap.
    pub(super) fn note_gap(&self, now: Instant) {
        self.stale_until.set(now + STALE);
    }

    /// How often the process slept.
    pub(super) fn sleeps(&self) -> u32 {
        self.sleeps.get()
    }

    /// Whether the port's owner discards data read now because it may have waited while the process slept.
    pub(super) fn is_stale(&self) -> bool {
        self.stale_until.get() != Instant::ZERO && now() < self.stale_until.get()
    }

    /// Sends bytes on a serial port.
    pub fn send(&self, bytes: &[u8]) {
        let mut queue = self.bytes.borrow_mut();
        if queue.len() + bytes.len() > MAX_QUEUED_BYTES {
            self.count(|counters| counters.dropped += 1);
        } else {
            queue.extend_from_slice(bytes);
        }
        self.wake.notify_one();
    }

    /// Sends a frame on a CAN port.
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

/// Data that waited while the process slept. A peer's kernel may hold megabytes for a connection, more than can be read
/// while the port's owner discards input. On a busy machine, a device's task may not run before the owner accepts input
/// again.
#[derive(Debug)]
pub(super) struct Backlog {
    /// The newest sleep after which the device was checked for waiting data.
    known: u32,
    /// Data was waiting at that check and has not been read yet.
    waits: bool,
    /// There was more data than could be read while the owner discarded it.
    is_behind: bool,
    /// Since when each read has returned less than its maximum.
    small_since: Option<Instant>,
}

impl Backlog {
    /// A device in which no data waits.
    pub(super) fn new(tx: &PortTx) -> Self {
        Self { known: tx.sleeps.get(), waits: false, is_behind: false, small_since: None }
    }

    /// A new connection. `known` is [`PortTx::sleeps`] when waiting for it began. Data that came while the process
    /// slept may wait in it, unless that was long ago.
    pub(super) fn accepted(tx: &PortTx, known: u32) -> Self {
        let is_long_ago = now().saturating_since(tx.stale_until.get()) >= MAX_BACKLOG;
        Self { known: if is_long_ago { tx.sleeps.get() } else { known }, ..Self::new(tx) }
    }

    /// Whether the process slept and the device has not been checked for waiting data since.
    pub(super) fn has_slept(&self, tx: &PortTx) -> bool {
        self.known != tx.sleeps.get()
    }

    /// Records whether data waits in the device after the newest sleep.
    pub(super) fn note(&mut self, tx: &PortTx, waits: bool) {
        (self.known, self.waits) = (tx.sleeps.get(), waits);
    }

    /// Whether data read now may belong to the backlog and so may be read in larger pieces.
    pub(super) fn is_open(&self, tx: &PortTx) -> bool {
        self.is_behind || self.waits || tx.is_stale()
    }

    /// Whether data just read belongs to the backlog and the port's owner does not discard it. `is_more`: there was
    /// more than was read.
    pub(super) fn has(&mut self, tx: &PortTx, is_more: bool) -> bool {
        let waited = self.waits || self.has_slept(tx);
        self.waits &= is_more;
        if tx.is_stale() {
            // Once there was more, a pause does not show that the backlog is over.
            self.is_behind |= is_more;
            self.small_since = None;
            return false;
        }
        if waited && !self.is_behind {
            (self.is_behind, self.small_since) = (true, None);
        }
        if !self.is_behind {
            return false;
        }
        let now = now();
        // A peer's kernel may pause before it sends more of the backlog.
        let since = *self.small_since.get_or_insert(now);
        if is_more {
            self.small_since = None;
        }
        let is_over = !is_more && now.saturating_since(since) >= PAUSE;
        // Data of a peer that never pauses counts as new after some time.
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
    /// Bytes that a client did not read in time, whole frames sent while the queue was full, and old data: it waited
    /// while the process slept and was read too late for the engine to discard it, or while one gateway replaced
    /// another.
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
    /// The newest receive error counter of a CAN controller.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rx_error_counter: Option<u8>,
    /// CAN FD frames, which no recipe uses.
    pub fd_frames: u64,
    /// A CAN controller's error state, where it is known: active, warning, passive or bus-off.
    #[serde(skip_serializing_if = "str::is_empty")]
    pub bus: &'static str,
}

/// Minimum time for which the engine discards input after sleep.
pub const STALE: Duration = Duration::from_millis(50);
/// A backlog ends after this long with less data than can be read at once: systems may pause within a backlog. The
/// engine's links are not up earlier.
const PAUSE: Duration = Duration::from_millis(100);
/// A longer backlog counts as new data after this.
const MAX_BACKLOG: Duration = Duration::from_secs(10);
/// Room for several frames of any port's recipe; a port sends the next frame only after the last one has left.
const MAX_QUEUED_BYTES: usize = 4_096;
/// Twice the maximum number of ids in a part of a recipe.
const MAX_QUEUED_FRAMES: usize = 64;
