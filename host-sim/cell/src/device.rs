//! Devices at the far end of a line or bus.

use proto_core::time::{Duration, Instant};

/// A device: `M` is `Vec<u8>` on an RS-485 line and a CAN frame on a bus.
///
/// Returned messages are sent in order, each as soon as the device's previous one has left.
pub trait Device<M> {
    /// A message arrived: a chunk of bytes as the line delivers it, or a CAN frame.
    fn receive(&mut self, now: Instant, message: &M) -> Vec<M> {
        let _ = (now, message);
        Vec::new()
    }

    /// When to call [`Self::poll`]. Only [`Self::poll`] and [`Self::receive`] change it.
    fn deadline(&self) -> Instant {
        Instant::NEVER
    }

    /// The deadline has come; the next one must be later than `now`.
    fn poll(&mut self, now: Instant) -> Vec<M> {
        let _ = now;
        Vec::new()
    }

    /// The actions of polled devices since the last call, in order. The model compares the gateway's values with them.
    fn take_done(&mut self) -> Vec<SlaveDone> {
        Vec::new()
    }
}

/// A device that is a TCP server, such as of Modbus TCP. It has one connection at a time: a new connection replaces the
/// previous one.
pub trait Server {
    /// A connection was opened.
    fn opened(&mut self, now: Instant);

    /// The connection is gone, and its unsent data is lost.
    fn closed(&mut self, now: Instant);

    /// Bytes arrived on the connection, in pieces of any size.
    fn receive(&mut self, now: Instant, bytes: &[u8]);

    /// When to call [`Self::poll`].
    fn deadline(&self) -> Instant;

    /// The deadline has come; the next one must be later than `now`.
    fn poll(&mut self, now: Instant) -> Vec<Served>;

    /// The entries of its log since the last call, in order.
    fn take_done(&mut self) -> Vec<SlaveDone>;
}

/// An entry in a device's own log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Act {
    /// It received a whole request in its own format: an order or a query.
    Heard(Option<Order>),
    /// It executed an order with these values.
    Did(Order, Vec<u32>),
    /// It refused an order with a code.
    Refused(Order, u8),
    /// A reply was sent, or was due but not sent.
    Replied {
        /// The order that was replied to, if any.
        order: Option<Order>,
        /// The reply differs from the request, so it cannot be taken for an echo.
        tells: bool,
        /// The reply was sent unchanged.
        is_whole: bool,
        /// The reply was certainly at the gateway in time.
        in_time: bool,
    },
    /// Something that is not a reply arrived from the device; the gateway may or may not take it for a sign of life.
    Garbled,
    /// The variable with this number has this value from now on.
    Holds(usize, u16),
    /// It lost its power, and everything that it was told.
    PowerOff,
    /// It has power again.
    PowerOn,
}

/// What a device can be ordered to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Order {
    /// To move: an event.
    Move,
    /// The second step of a dialogue that began with [`Self::Move`].
    Step,
    /// To stop.
    Stop,
    /// What it gets at its start, and what moves it: homing, a mode.
    Start,
    /// A value that it stores.
    Keep,
}

/// An action of a TCP server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Served {
    /// It sends bytes. The act is logged once the last byte has arrived.
    Bytes(Vec<u8>, Option<Act>),
    /// It closes its connection, in both directions.
    Close,
    /// It closes its sending side, and still receives.
    HalfClose,
    /// It resets its connection.
    Reset,
    /// It loses its power: its connection disappears without notice.
    PowerOff,
    /// It has power again.
    PowerOn,
}

/// An action of a polled device: a slave of a Modbus line, or a peer with frames of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SlaveDone {
    /// Address or number of the device.
    pub slave: u8,
    /// The action.
    pub what: Done,
}

/// An action of a slave.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Done {
    /// It made a reply, which may be changed or lost before it is sent.
    Answered {
        /// The first register or coil that was read or written.
        address: u16,
        /// Number of registers or coils.
        count: u16,
        /// The whole frame.
        reply: Vec<u8>,
    },
    /// It accepted values, from a request to itself or to all.
    Wrote {
        /// Coils, otherwise holding registers.
        coils: bool,
        /// The first register or coil.
        address: u16,
        /// The registers, or 0 and 1 for coils.
        values: Vec<u16>,
    },
    /// It made a frame of its own, which may be changed or lost before it is sent: a reply, or an unsolicited frame.
    Replied {
        /// The exchange, counted from 0 on the port.
        exchange: usize,
        /// The whole frame.
        frame: Vec<u8>,
    },
    /// It took a request of its own frames.
    Took {
        /// The exchange, counted from 0 on the port.
        exchange: usize,
        /// The whole frame.
        request: Vec<u8>,
    },
    /// It lost its power, and with it everything that was written.
    Forgot,
    /// An entry in the log of a device of a judged cell.
    Acted(Act),
}

/// Sends at a rate: the n-th message is `make(n)` and leaves at `start + n * 1 s / rate`, rounded down
/// to the microsecond. No rounding errors accumulate.
#[derive(Debug, Clone)]
pub struct PeriodicSender<F> {
    start: Instant,
    per_second: u64,
    sent: u64,
    count: u64,
    make: F,
}

impl<F> PeriodicSender<F> {
    /// `per_second` messages per second from `start` on, `count` in total.
    ///
    /// The rate must be from 1 to 1 000 000.
    pub fn new(start: Instant, per_second: u64, count: u64, make: F) -> Self {
        assert!((1..=1_000_000).contains(&per_second), "{per_second} messages a second");
        Self { start, per_second, sent: 0, count, make }
    }
}

impl<M, F: FnMut(u64) -> M> Device<M> for PeriodicSender<F> {
    fn deadline(&self) -> Instant {
        if self.sent >= self.count {
            return Instant::NEVER;
        }
        let micros = u128::from(self.sent) * 1_000_000 / u128::from(self.per_second);
        self.start + Duration::from_micros(u64::try_from(micros).unwrap_or(u64::MAX))
    }

    fn poll(&mut self, now: Instant) -> Vec<M> {
        let mut messages = Vec::new();
        while Device::<M>::deadline(self) <= now {
            messages.push((self.make)(self.sent));
            self.sent += 1;
        }
        messages
    }
}

/// Answers what it receives.
#[derive(Debug, Clone)]
pub struct Responder<F>(pub F);

impl<M, F: FnMut(Instant, &M) -> Vec<M>> Device<M> for Responder<F> {
    fn receive(&mut self, now: Instant, message: &M) -> Vec<M> {
        (self.0)(now, message)
    }
}
